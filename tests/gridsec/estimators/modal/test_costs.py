"""Costs of sets of faults against determinants and solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal.alike import Alike
from gridsec.estimators.modal.costs import (
    SearchProblem,
    Tableau,
    amounts,
    cost,
    costs,
    explained,
    mean_amounts,
    penalties,
)
from gridsec.estimators.modal.search import ALIKE


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


@pytest.mark.parametrize("seed", range(3))
def test_costs_of_many_sets_are_those_of_each(seed: int) -> None:
    """Stacked sets of different sizes, the empty one included."""
    given, random = problem(seed), np.random.default_rng(seed)
    sets = random.random((30, given.y.size)) < np.linspace(0.0, 0.9, 30)[:, None]
    assert np.allclose(costs(given, sets), [cost(given, each) for each in sets], atol=1e-8)
    with_some = sets | np.isin(np.arange(given.y.size), [1, 2, 9])
    assert np.allclose(costs(given, with_some), [cost(given, each) for each in with_some], atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_costs_of_amounts_alike_are_exact(seed: int) -> None:
    """A share of the variance in common; sets with nothing, and with three faults, that all of them have."""
    given, random, p = problem(seed), np.random.default_rng(seed), 8
    given = replace(given, std=random.uniform(0.5, 2.0, given.y.size))
    sets = random.random((20, given.y.size)) < 0.5
    for some in (sets, sets | np.isin(np.arange(given.y.size), [1, 2, 9])):
        for chosen, found in zip(some, costs(given, some, ALIKE), strict=True):
            at = np.flatnonzero(chosen)
            alike = np.where(np.equal.outer(at, at), 1.0, ALIKE) * np.logical_and.outer(at < p, at < p)
            V = np.outer(given.std[at], given.std[at]) * np.where(np.equal.outer(at, at), 1.0, alike)
            F, y = given.F[np.ix_(at, at)], given.y[at]
            exact = np.linalg.slogdet(np.eye(at.size) + V @ F)[1]
            exact -= y @ np.linalg.solve(np.eye(at.size) + V @ F, V @ y)
            exact += penalties(p)[np.count_nonzero(at < p)] + given.charge[at].sum() + given.charge.max()
            assert found == pytest.approx(exact, abs=1e-7)


def far_apart(given: SearchProblem, random: np.random.Generator) -> Bools:
    """Sets beside one of twenty meters, sets beside another one, single faults, and nothing."""
    q, each = given.y.size, list[Bools]()
    for first in (0, given.meters - 20):
        one = (np.arange(q) >= first) & (np.arange(q) < first + 20)
        each += [one ^ (random.random(q) < 0.05) for _ in range(8 if first else 14)]
    singles = np.eye(q, dtype=np.bool_)[:3]
    return np.vstack([each, singles, np.zeros((1, q), dtype=np.bool_)])


@pytest.mark.parametrize("share", [0.0, ALIKE])
def test_costs_of_sets_that_are_far_apart_are_those_of_each(share: float) -> None:
    given, random = problem(1, p=44, others=4, liars=20), np.random.default_rng(1)
    sets = far_apart(given, random)
    found = costs(given, sets, share)
    assert np.allclose(found, [costs(given, each[None], share)[0] for each in sets], atol=1e-6)
    if not share:
        assert np.allclose(found, [cost(given, each) for each in sets], atol=1e-6)


def test_effects_of_many_sets_are_those_of_each() -> None:
    """Means and variances of ``T f`` against the inverse of each set's information."""
    given, random = problem(2, p=44, others=4, liars=20), np.random.default_rng(2)
    sets = far_apart(given, random)
    weight, T = random.random(len(sets)), random.normal(size=(7, given.y.size))
    mean, variance = explained(given, sets, weight, T)
    expected = np.zeros(7)
    for chosen, one, w in zip(sets, mean, weight, strict=True):
        f, cov = amounts(given, chosen)
        assert one == pytest.approx(T[:, chosen] @ f, abs=1e-7)
        expected += w * np.einsum("nk,kj,nj->n", T[:, chosen], cov, T[:, chosen])
    assert variance == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("some", [(), (1,), (0, 3, 9)])
def test_mean_amounts_are_those_of_the_posterior(some: tuple[int, ...]) -> None:
    given = problem(2)
    chosen = np.isin(np.arange(given.y.size), some)
    assert np.allclose(mean_amounts(given, chosen), amounts(given, chosen)[0], atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_costs_changes_and_exchanges_are_exact(seed: int) -> None:
    """Every entry of the tableau against the cost of the set it stands for."""
    given, random = problem(seed), np.random.default_rng(seed)
    tableau = Tableau(given)
    for _ in range(12):
        tableau.toggle(int(random.integers(given.y.size)))
        assert tableau.cost == pytest.approx(cost(given, tableau.chosen), abs=1e-8)
        for j, change in enumerate(tableau.changes()):
            other = tableau.chosen.copy()
            other[j] = not other[j]
            assert tableau.cost + change == pytest.approx(cost(given, other), abs=1e-7)
        out = np.flatnonzero(tableau.chosen)
        both = tableau.exchanges(out)
        assert both.shape == (out.size, given.y.size)
        for i, j in zip(*np.nonzero(np.isfinite(both)), strict=True):
            other = tableau.chosen.copy()
            other[out[i]], other[j] = False, True
            assert tableau.cost + both[i, j] == pytest.approx(cost(given, other), abs=1e-7)
        free = np.flatnonzero(~tableau.chosen[: given.meters])[:3]
        if free.size:
            other = tableau.chosen.copy()
            other[free] = True
            change = tableau.group(np.arange(given.meters)[None], other[None, : given.meters])[0]
            for n, found in enumerate(change):
                some = np.append(other[: n + 1], np.zeros(other.size - n - 1, dtype=np.bool_))
                some |= tableau.chosen
                several = np.count_nonzero(some & ~tableau.chosen) > 1
                assert not several or tableau.cost + found == pytest.approx(cost(given, some), abs=1e-7)
                assert several or np.isinf(found)
    some = random.random((5, given.meters)) < 0.5
    changes = tableau.toggled(np.tile(np.arange(given.meters), (5, 1)), some)
    for each, change in zip(some, changes, strict=True):
        other = tableau.chosen ^ np.append(each, np.zeros(given.y.size - given.meters, dtype=np.bool_))
        assert tableau.cost + change == pytest.approx(cost(given, other), abs=1e-7)
    for each in (tableau, Tableau(given).pivot(tableau.chosen)):
        assert each.cost == pytest.approx(cost(given, tableau.chosen), abs=1e-8)
        assert_swept(each)


def swept(given: SearchProblem, chosen: Bools) -> Floats:
    """The whole tableau with the scores as its border, by the inverse of a set's information."""
    q, J = given.y.size, np.flatnonzero(chosen)
    A = np.zeros((q + 1, q + 1))
    A[:q, :q], A[q, :q], A[:q, q] = given.F + np.diag(given.std**-2.0), given.y, given.y
    inverse = np.linalg.inv(A[np.ix_(J, J)])
    out = A - A[:, J] @ inverse @ A[J]
    out[:, J] = A[:, J] @ inverse
    out[J] = out[:, J].T
    out[np.ix_(J, J)] = -inverse
    return out


def assert_swept(tableau: Tableau) -> None:
    """All that a tableau keeps, and the entries that follow from it."""
    expected, q = swept(tableau.problem, tableau.chosen), tableau.chosen.size
    close, every = {"atol": 1e-8 * float(np.abs(expected).max())}, np.random.default_rng(0).permutation(q)
    out = np.flatnonzero(tableau.chosen)
    assert np.allclose(tableau.diagonal, expected.diagonal()[:q], **close)
    assert np.allclose(tableau.borders[:, 0], expected[:, q], **close)
    assert np.allclose(tableau.beside, expected[:, tableau.order], **close)
    assert np.allclose(tableau.of(out), expected[out, :q], **close)
    assert np.allclose(tableau.part(every), expected[np.ix_(every, every)], **close)


@pytest.mark.parametrize("share", [0.0, ALIKE])
def test_costs_after_a_removal_and_another_change_are_exact(share: float) -> None:
    """Second changes by a tableau of either prior, against the costs of the sets."""
    given = problem(3, p=9, others=3, liars=4)
    tableau = (Alike(given, share) if share else Tableau(given)).pivot(np.arange(12) % 3 != 1)
    tableau.barred[1] = True
    out = np.flatnonzero(tableau.chosen)
    found = tableau.seconds(out)
    for i, j in np.ndindex(found.shape):
        other = tableau.chosen.copy()
        other[out[i]], other[j] = False, not other[j]
        if j in {1, out[i]}:
            assert np.isinf(found[i, j])
        else:
            assert tableau.whole + found[i, j] == pytest.approx(cost(given, other, share), abs=1e-7)


def test_tableau_has_room_for_all_faults() -> None:
    """Faults that are added one by one, beyond the room of the columns, and removed again."""
    given, random = problem(4, p=40, others=6), np.random.default_rng(4)
    tableau = Tableau(given)
    for j in (*random.permutation(46), *random.permutation(46)[:30]):
        tableau.toggle(int(j))
    assert np.count_nonzero(tableau.chosen) == 16
    assert_swept(tableau)
