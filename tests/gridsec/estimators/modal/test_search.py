"""The subset search against brute force, and naming."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.modal import search as s
from gridsec.estimators.modal.model import modes
from gridsec.estimators.modal.search import SearchProblem, Tableau
from tests.gridsec.estimators.modal.test_detector import FEEDER, busbar


def problem(seed: int, p: int = 8, others: int = 2, liars: int = 2, size: float = 1.0) -> SearchProblem:
    """Scores of random faults whose information is that of correlated readings."""
    random = np.random.default_rng(seed)
    q, common = p + others, random.standard_normal((p + others, 3))
    F = np.linalg.inv(0.02 * np.eye(q) + 0.3 * common @ common.T)
    f = np.zeros(q)
    f[random.choice(p, liars, replace=False)] = size * random.choice([-1.0, 1.0], liars)
    y = F @ f + np.linalg.cholesky(F) @ random.standard_normal(q)
    charge = np.where(np.arange(q) < p, 0.0, 10.0)
    return SearchProblem(y, F, np.full(q, 1.0), p, charge, np.full(q, np.inf))


def every(given: SearchProblem) -> list[tuple[float, Bools]]:
    """All sets with their costs, by determinants and solves; independent amounts or amounts alike."""
    q, p, out = given.y.size, given.meters, []
    for k in range(q + 1):
        for some in combinations(range(q), k):
            at = list(some)
            n = sum(j < p for j in at)
            beyond = sum(max(0.0, 9.0 - 2.0 * np.log((p - i) / (i + 1))) for i in range(max(1, p // 3), n))
            penalty = 2.0 * np.log(comb(p, n)) + beyond + given.charge[at].sum()
            both = []
            for share, charge in ((0.0, 0.0), (0.99, given.charge.max())) if n > 1 else ((0.0, 0.0),):
                V = np.diag(given.std[at] ** 2)
                for i in range(n):
                    for j in range(n):
                        V[i, j] *= 1.0 if i == j else 0.0
                        V[i, j] += share * given.std[at[i]] * given.std[at[j]] * (i != j)
                F = given.F[np.ix_(at, at)]
                fit = given.y[at] @ np.linalg.solve(np.linalg.inv(V) + F, given.y[at]) if at else 0.0
                both.append(-fit + np.linalg.slogdet(np.eye(k) + V @ F)[1] + penalty + charge)
            cost = both[0] if n < 2 else 2.0 * (np.log(2.0) - np.logaddexp(*(-0.5 * np.array(both))))
            out.append((cost, np.isin(np.arange(q), at)))
    return sorted(out, key=lambda each: each[0])


def total(given: SearchProblem, chosen: Bools) -> float:
    """Cost of one set, with amounts alike as likely as not."""
    one = s.cost(given, chosen)
    if np.count_nonzero(chosen[: given.meters]) < 2:
        return one
    return 2.0 * (np.log(2.0) - np.logaddexp(-0.5 * one, -0.5 * s.costs(given, chosen[None], s.ALIKE)[0]))


@pytest.mark.parametrize("seed", range(6))
def test_costs_changes_and_exchanges_are_exact(seed: int) -> None:
    """Every entry of the tableau against the cost of the set it stands for."""
    given, random = problem(seed), np.random.default_rng(seed)
    tableau = Tableau(given)
    for _ in range(12):
        tableau.toggle(int(random.integers(given.y.size)))
        assert tableau.cost == pytest.approx(s.cost(given, tableau.chosen), abs=1e-8)
        for j, change in enumerate(tableau.changes()):
            other = tableau.chosen.copy()
            other[j] = not other[j]
            assert tableau.cost + change == pytest.approx(s.cost(given, other), abs=1e-7)
        out = np.flatnonzero(tableau.chosen)
        both = tableau.exchanges(out)
        assert both.shape == (out.size, given.y.size)
        for i, j in zip(*np.nonzero(np.isfinite(both)), strict=True):
            other = tableau.chosen.copy()
            other[out[i]], other[j] = False, True
            assert tableau.cost + both[i, j] == pytest.approx(s.cost(given, other), abs=1e-7)
        free = np.flatnonzero(~tableau.chosen[: given.meters])[:3]
        if free.size:
            other = tableau.chosen.copy()
            other[free] = True
            change = tableau.group(np.arange(given.meters)[None], other[None, : given.meters])[0]
            for n, found in enumerate(change):
                some = np.append(other[: n + 1], np.zeros(other.size - n - 1, dtype=np.bool_))
                some |= tableau.chosen
                several = np.count_nonzero(some & ~tableau.chosen) > 1
                assert not several or tableau.cost + found == pytest.approx(s.cost(given, some), abs=1e-7)
                assert several or np.isinf(found)
    some = random.random((5, given.meters)) < 0.5
    changes = tableau.toggled(np.tile(np.arange(given.meters), (5, 1)), some)
    for each, change in zip(some, changes, strict=True):
        other = tableau.chosen ^ np.append(each, np.zeros(given.y.size - given.meters, dtype=np.bool_))
        assert tableau.cost + change == pytest.approx(s.cost(given, other), abs=1e-7)
    assert np.isfinite(tableau.A).all()
    again = Tableau(given).pivot(tableau.chosen)
    assert np.allclose(again.A, tableau.A, atol=1e-8 * np.abs(tableau.A).max())
    assert again.cost == pytest.approx(tableau.cost, abs=1e-8)


@pytest.mark.canary("0-0", "2-0", "3-7")
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("liars", [0, 1, 2, 3])
def test_the_best_set_is_that_of_brute_force(seed: int, liars: int) -> None:
    """Ten faults, all 1024 subsets: the cheapest one is found, and with it at least 95 % of the weight."""
    given = problem(seed, liars=liars)
    found = s.search(given)
    sets = every(found.problems[0])
    assert total(found.problems[0], found.chosen[0]) == pytest.approx(sets[0][0], abs=1e-8)
    costs = np.array([each for each, _ in sets])
    weight = np.exp(-0.5 * (costs - costs[0]))
    weight /= weight.sum()
    kept = {each.tobytes(): w for each, w in zip(found.chosen, found.weight, strict=True)}
    missed = sum(w for w, (_, chosen) in zip(weight, sets, strict=True) if chosen.tobytes() not in kept)
    assert missed < 0.05
    without = np.array(
        [weight @ np.array([not chosen[j] for _, chosen in sets]) for j in range(given.meters)]
    )
    # What brute force doubts by far more than the limit is never named.
    assert not (found.named & (without > 10.0 * s.DOUBT)).any()


@pytest.mark.parametrize("seed", range(3))
def test_costs_of_many_sets_are_those_of_each(seed: int) -> None:
    """Stacked sets of different sizes, the empty one included."""
    given, random = problem(seed), np.random.default_rng(seed)
    sets = random.random((30, given.y.size)) < np.linspace(0.0, 0.9, 30)[:, None]
    assert np.allclose(s.costs(given, sets), [s.cost(given, each) for each in sets], atol=1e-8)
    with_some = sets | np.isin(np.arange(given.y.size), [1, 2, 9])
    assert np.allclose(s.costs(given, with_some), [s.cost(given, each) for each in with_some], atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_costs_of_amounts_alike_are_exact(seed: int) -> None:
    """A share of the variance in common; sets with nothing, and with three faults, that all of them have."""
    given, random, p = problem(seed), np.random.default_rng(seed), 8
    given = replace(given, std=random.uniform(0.5, 2.0, given.y.size))
    sets = random.random((20, given.y.size)) < 0.5
    for some in (sets, sets | np.isin(np.arange(given.y.size), [1, 2, 9])):
        for chosen, found in zip(some, s.costs(given, some, s.ALIKE), strict=True):
            at = np.flatnonzero(chosen)
            alike = np.where(np.equal.outer(at, at), 1.0, s.ALIKE) * np.logical_and.outer(at < p, at < p)
            V = np.outer(given.std[at], given.std[at]) * np.where(np.equal.outer(at, at), 1.0, alike)
            F, y = given.F[np.ix_(at, at)], given.y[at]
            exact = np.linalg.slogdet(np.eye(at.size) + V @ F)[1]
            exact -= y @ np.linalg.solve(np.eye(at.size) + V @ F, V @ y)
            exact += s.penalties(p)[np.count_nonzero(at < p)] + given.charge[at].sum() + given.charge.max()
            assert found == pytest.approx(exact, abs=1e-7)


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_costs_of_one_amount_are_exact(seed: int, whole: bool) -> None:
    """Every toggle against the cost of one fault that is the sum of the columns."""
    given, random = problem(seed), np.random.default_rng(seed)
    p = given.meters
    lateral = np.arange(p) < (5 if whole else 0)

    def exact(inside: Bools) -> float:
        k, kept = int(inside.sum()), int((inside & lateral).sum())
        if not k:
            return np.inf
        u = np.append(inside.astype(np.float64), np.zeros(given.y.size - p))
        one = SearchProblem(
            np.array([u @ given.y]), np.array([[u @ given.F @ u]]), given.std[:1], 1, np.zeros(1), np.ones(1)
        )
        exceptions = 2.0 * np.log(comb(5, kept) * comb(p - 5, k - kept)) if whole else s.penalties(p)[k]
        return s.cost(one, np.ones(1, dtype=np.bool_)) + exceptions

    common = s.Common(given, lateral, random.random(p) < 0.4)
    before = common.cost
    for j, found in enumerate(common.toggled()):
        assert found == pytest.approx(exact(common.inside ^ (np.arange(p) == j)), abs=1e-8)
    common.descend()
    assert common.cost <= before
    assert common.cost == pytest.approx(exact(common.inside), abs=1e-8)


def test_a_lateral_with_exceptions_has_the_least_penalty() -> None:
    """By binomials; meters without readings are no exceptions, and no laterals change nothing."""
    laterals = np.zeros((2, 30))
    laterals[0, :8], laterals[1, 10:14] = 1.0, 1.0
    read = np.arange(30) != 29
    sets = np.zeros((4, 30), dtype=np.bool_)
    sets[0, 1:8], sets[1, 20], sets[2, [*range(8), 25, 29]], sets[3, :11] = True, True, True, True
    got, by_number = s.coded(sets, laterals, read), s.penalties(30)[[7, 1, 10, 11]]
    assert got[0] == pytest.approx(2.0 * np.log(2 * 8))
    assert got[2] == pytest.approx(2.0 * np.log(2 * 21))
    assert np.allclose(got[[1, 3]], by_number[[1, 3]])
    assert np.allclose(s.coded(sets, laterals[:0], read), by_number)


@pytest.mark.parametrize("seed", range(4))
def test_a_group_that_is_off_by_one_amount_is_one_hypothesis(seed: int) -> None:
    """Twelve neighbours of 48, each hardly beyond noise: the descent ends at them, or at a cheaper set."""
    random, p = np.random.default_rng(seed), 48
    groups = tuple(np.arange(k, k + n) for n in (2, 3, 6, 12) for k in range(0, p, n))
    F = np.linalg.inv(0.5 * np.eye(p) + 0.02)
    f = np.where(np.arange(p) // 12 == 2, 2.0, 0.0)
    y = F @ f + np.linalg.cholesky(F) @ random.standard_normal(p)
    given, truth = SearchProblem(y, F, np.ones(p), p, np.zeros(p), np.full(p, np.inf)), f > 0.0
    laterals = np.array([np.isin(np.arange(p), each) for each in groups])
    found = s.in_common(given, laterals.astype(np.float64), np.zeros(p, dtype=np.bool_))
    assert s.costs(given, found, s.ALIKE).min() <= s.costs(given, truth[None], s.ALIKE)[0] + 1e-9
    assert s.costs(given, truth[None], s.ALIKE)[0] < s.cost(given, truth)
    assert not (s.search(given, groups, (), laterals).named & ~truth).any()


def test_large_faults_are_named_and_nothing_else() -> None:
    """Three of nine, far beyond noise: these and no others."""
    for seed in range(4):
        given = problem(seed, p=9, liars=3, size=4.0)
        found = s.search(given)
        truth = every(found.problems[0])[0][1][:9]
        assert (found.named <= truth).all()
        assert found.named.sum() >= 2


def test_honest_scores_name_nothing() -> None:
    """Scores without a fault: the named of 200 draws."""
    named = sum(int(s.search(problem(seed, liars=0)).named.any()) for seed in range(200))
    assert named <= 2


@pytest.mark.parametrize("some", [(), (1,), (0, 3, 9)])
def test_mean_amounts_are_those_of_the_posterior(some: tuple[int, ...]) -> None:
    given = problem(2)
    chosen = np.isin(np.arange(given.y.size), some)
    assert np.allclose(s.mean_amounts(given, chosen), s.amounts(given, chosen)[0], atol=1e-9)


def test_impossible_amounts_are_not_chosen() -> None:
    """A power that would have to be beyond its bound is left out, and a meter explains it."""
    F = np.array([[50.0, 49.0], [49.0, 50.0]])
    f = np.array([0.0, 3.0])
    given = SearchProblem(F @ f, F, np.ones(2), 1, np.array([0.0, 1.0]), np.array([np.inf, 0.5]))
    assert not s.search(given).chosen[0][1]
    free = SearchProblem(F @ f, F, np.ones(2), 1, np.array([0.0, 1.0]), np.array([np.inf, np.inf]))
    assert s.search(free).chosen[0][1]


def test_amounts_that_become_impossible_are_removed() -> None:
    """A power that is possible beside a meter, but not without it: it is barred when the meter goes."""
    given = problem(3, p=6, others=2, liars=2, size=3.0)
    tight = SearchProblem(
        given.y, given.F, given.std, 6, np.zeros(8), np.where(np.arange(8) < 6, np.inf, 0.05)
    )
    tableau = Tableau(tight)
    tableau.toggle(7)
    end = s.descend(tableau)
    amount = s.amounts(tight, end.chosen)[0]
    assert (np.abs(amount) <= tight.bound[end.chosen]).all()


def test_sequences_contain_every_group_once() -> None:
    """Nested groups, and groups that overlap: each is the beginning of one sequence."""
    made = modes(busbar())
    for some in (s.groups(made), (np.array([1, 2, 3]), np.array([2, 3, 4]), np.array([2, 3])), ()):
        found = [
            frozenset(members[k, : n + 1].tolist())
            for members, inside, ends in s.together(some)
            for k, n in zip(*np.nonzero(ends), strict=True)
            if inside[k, : n + 1].all()
        ]
        assert len(found) == len(some)
        assert set(found) == {frozenset(each.tolist()) for each in some}


def test_groups_are_nested_and_cover_neighbours() -> None:
    made = modes(busbar())
    found = s.groups(made)
    assert all(2 <= each.size <= made.size // 2 for each in found)
    for one, other in combinations(found, 2):
        shared = np.intersect1d(one, other).size
        assert shared in {0, one.size, other.size}
    parent = np.concatenate([[-1], FEEDER.parent])
    # The two nearest meters are neighbours on the tree.
    i, j = (int(FEEDER.bus[k]) for k in found[0])
    assert parent[i] == j or parent[j] == i or parent[i] == parent[j]
