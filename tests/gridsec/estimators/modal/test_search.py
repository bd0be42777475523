"""The subset search against brute force, and naming."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.modal import search as s
from gridsec.estimators.modal.costs import SearchProblem, Tableau, amounts, cost, costs
from tests.gridsec.estimators.modal.test_costs import problem


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
    one = cost(given, chosen)
    if np.count_nonzero(chosen[: given.meters]) < 2:
        return one
    return 2.0 * (np.log(2.0) - np.logaddexp(-0.5 * one, -0.5 * costs(given, chosen[None], s.ALIKE)[0]))


@pytest.mark.canary("3-7")
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("liars", [0, 1, 2, 3])
def test_the_best_set_is_that_of_brute_force(seed: int, liars: int) -> None:
    """Ten faults, all 1024 subsets: the cheapest one is found, and with it at least 95 % of the weight."""
    given = problem(seed, liars=liars)
    found = s.search(given)
    sets = every(found.problems[0])
    assert total(found.problems[0], found.chosen[0]) == pytest.approx(sets[0][0], abs=1e-8)
    every_cost = np.array([each for each, _ in sets])
    weight = np.exp(-0.5 * (every_cost - every_cost[0]))
    weight /= weight.sum()
    kept = {each.tobytes(): w for each, w in zip(found.chosen, found.weight, strict=True)}
    missed = sum(w for w, (_, chosen) in zip(weight, sets, strict=True) if chosen.tobytes() not in kept)
    assert missed < 0.05
    without = np.array(
        [weight @ np.array([not chosen[j] for _, chosen in sets]) for j in range(given.meters)]
    )
    # What brute force doubts by far more than the limit is never named.
    assert not (found.named & (without > 10.0 * s.DOUBT)).any()


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", range(4))
def test_large_faults_are_named_and_nothing_else(seed: int) -> None:
    """Three of nine, far beyond noise: these and no others."""
    given = problem(seed, p=9, liars=3, size=4.0)
    found = s.search(given)
    truth = every(found.problems[0])[0][1][:9]
    assert (found.named <= truth).all()
    assert found.named.sum() >= 2


def test_honest_scores_name_nothing() -> None:
    """Scores without a fault: the named of 200 draws."""
    named = sum(int(s.search(problem(seed, liars=0)).named.any()) for seed in range(200))
    assert named <= 2


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
    amount = amounts(tight, end.chosen)[0]
    assert (np.abs(amount) <= tight.bound[end.chosen]).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_set_of_an_earlier_search_counts_with_the_size_that_suits_it(seed: int) -> None:
    """Sets of one meter and of three, beside a problem with a far smaller size; the truth is kept."""
    given = replace(problem(seed, liars=3), std=np.concatenate([np.full(8, 0.05), np.ones(2)]))
    truth = s.search(problem(seed, liars=3)).chosen[0]
    known = np.array([[0, 0, 0, 1, 0, 0, 0, 0, 0, 0], truth, truth], dtype=np.bool_)
    found: dict[bytes, float] = {np.zeros(10, dtype=np.bool_).tobytes(): 1e6}
    out = s._recalled(given, found, known)
    for chosen in known[:2]:
        mean, cov = amounts(given, chosen)
        count = int(chosen[:8].sum())
        size = float(np.sqrt(np.mean((mean**2 + np.diag(cov))[:count])))
        suited = replace(given, std=np.concatenate([np.full(8, size), np.ones(2)]))
        both = np.exp(-0.5 * np.array([total(given, chosen), total(suited, chosen)]))
        expected = -2.0 * np.log(0.9 * both[0] + 0.1 * both[1])
        assert found[chosen.tobytes()] == pytest.approx(expected)
        if found[chosen.tobytes()] == min(found.values()):
            assert out.std[0] == pytest.approx(size)
    assert min(found.values()) < 1e6
    kept = s.search(given, known=known)
    assert truth.tobytes() in {each.tobytes() for each in kept.chosen}


@pytest.mark.parametrize("confirmed", [True, False])
def test_a_name_needs_the_likeliest_set_under_the_loads_as_stated(confirmed: bool) -> None:
    """A rival outweighs the problem, and needs one meter: named where the problem's best set has it, too."""
    p = 9
    given = problem(0, p=p, liars=0)
    f = np.zeros((2, given.y.size))
    f[0, 2 if confirmed else 5], f[1, 2] = 6.0, 6.0
    plain, rival = (replace(given, y=given.y + given.F @ one) for one in f)
    found = s.search(plain, rivals=[(rival, -1e4)])
    assert found.model[0] == 1
    assert found.weight @ ~found.chosen[:, 2] < s.DOUBT
    assert found.named.tolist() == [confirmed and j == 2 for j in range(p)]
    assert (found.certain[:p] == found.named).all()


def test_sets_with_impossible_amounts_are_not_recalled() -> None:
    """The bound of a power is a tenth of what the readings say."""
    given, chosen = problem(1), np.isin(np.arange(10), [9])
    amount = float(amounts(given, chosen)[0][0])
    bound = np.where(np.arange(10) == 9, 0.1 * abs(amount), np.inf)
    for each, count in ((given, 2), (replace(given, bound=bound), 1)):
        found = {np.zeros(10, dtype=np.bool_).tobytes(): 1e6}
        s._recalled(each, found, chosen[None])
        assert len(found) == count


def test_a_group_without_readings_is_no_step() -> None:
    """Scores and information of two meters are 0: a search with their group finds the same explanations."""
    given, unread = problem(2, p=8, others=1), np.isin(np.arange(9), [5, 6])
    given = replace(
        given, y=np.where(unread, 0.0, given.y), F=np.where(unread[:, None] | unread, 0.0, given.F)
    )
    groups = (np.array([0, 1]), np.array([2, 3, 4]))
    some, other = s.search(given, groups), s.search(given, (np.array([5, 6]), *groups))
    assert (some.chosen == other.chosen).all()
    assert not other.chosen[:, [5, 6]].any()
