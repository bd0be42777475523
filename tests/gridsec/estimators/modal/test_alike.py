"""Sets of meters with amounts nearly alike: costs by dense covariances, and the search by enumeration."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import inf

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.modal.alike import Alike, bounded_minimum, opposed
from gridsec.estimators.modal.costs import SearchProblem, penalties
from gridsec.estimators.modal.search import ALIKE, search
from tests.gridsec.estimators.modal.test_costs import problem


def prior(given: SearchProblem, at: Ints, share: float) -> Floats:
    """Covariance of the amounts of some faults, those of meters with a share in common."""
    meter = at < given.meters
    alike = np.where(np.logical_and.outer(meter, meter), share, 0.0)
    alike[np.diag_indices(at.size)] = 1.0
    return np.asarray(np.outer(given.std[at], given.std[at]) * alike)


def dense(given: SearchProblem, chosen: Bools, share: float = ALIKE) -> float:
    """Cost of a set by determinants and solves."""
    at = np.flatnonzero(chosen)
    A = np.eye(at.size) + prior(given, at, share) @ given.F[np.ix_(at, at)]
    fit = given.y[at] @ np.linalg.solve(A, prior(given, at, share) @ given.y[at])
    charge = given.charge[at].sum() + (given.charge.max() if share else 0.0)
    count = np.count_nonzero(at < given.meters)
    return float(np.linalg.slogdet(A)[1] - fit + penalties(given.meters)[count] + charge)


def means(given: SearchProblem, chosen: Bools) -> Floats:
    """Posterior means of the amounts of a set, (k,)."""
    at = np.flatnonzero(chosen)
    V = prior(given, at, ALIKE)
    return np.asarray(np.linalg.solve(np.eye(at.size) + V @ given.F[np.ix_(at, at)], V @ given.y[at]))


def toggled(chosen: Bools, *faults: int) -> Bools:
    out = chosen.copy()
    out[list(faults)] ^= True
    return out


@pytest.mark.parametrize("seed", range(4))
def test_changes_and_exchanges_are_those_of_dense_covariances(seed: int) -> None:
    """Every entry along a random path through sets, the empty one included; powers are among the faults."""
    random = np.random.default_rng(seed)
    given = problem(seed)
    given = replace(given, std=random.uniform(0.5, 2.0, given.y.size))
    tableau = Alike(given, ALIKE)
    for _ in range(10):
        assert tableau.whole == pytest.approx(dense(given, tableau.chosen), abs=1e-7)
        assert tableau.amount[tableau.chosen] == pytest.approx(means(given, tableau.chosen), abs=1e-8)
        for j, change in enumerate(tableau.changes()):
            exact = dense(given, toggled(tableau.chosen, j))
            assert tableau.whole + change == pytest.approx(exact, abs=1e-6)
        out = np.flatnonzero(tableau.chosen)
        both = tableau.exchanges(out)
        for i, j in zip(*np.nonzero(np.isfinite(both)), strict=True):
            exact = dense(given, toggled(tableau.chosen, int(out[i]), int(j)))
            assert tableau.whole + both[i, j] == pytest.approx(exact, abs=1e-6)
        tableau.toggle(int(random.integers(given.y.size)))
    again = Alike(given, ALIKE).pivot(tableau.chosen)
    assert again.whole == pytest.approx(tableau.whole, abs=1e-7)
    assert tableau.copy().changes() == pytest.approx(tableau.changes())


@pytest.mark.parametrize("seed", range(3))
def test_a_part_of_the_faults_costs_what_it_does_beside_barred_ones(seed: int) -> None:
    given = problem(seed)
    p, q = given.meters, given.y.size
    used = np.arange(q) < p
    few, whole = Alike(given, ALIKE, used), Alike(given, ALIKE)
    whole.barred = ~used
    for j in (1, 4, 6, 4):
        few.toggle(j)
        whole.toggle(j)
        assert few.whole == pytest.approx(whole.whole, abs=1e-8)
        assert few.copy().whole == few.whole
        assert few.changes() == pytest.approx(whole.changes()[:p], abs=1e-8)
        assert few.amount[few.chosen] == pytest.approx(whole.amount[whole.chosen], abs=1e-8)
    assert (few.relaxed() == whole.relaxed()[:p]).all()


@pytest.mark.parametrize("seed", range(4))
def test_groups_are_those_of_dense_covariances(seed: int) -> None:
    """All beginnings of a random sequence of meters beside a random set."""
    random, given = np.random.default_rng(seed), problem(seed)
    chosen = random.random(given.y.size) < 0.3
    order = random.permutation(given.meters)
    tableau = Alike(given, ALIKE).pivot(chosen)
    change = tableau.group(order[None], np.ones((1, order.size), dtype=np.bool_))[0]
    for n, found in enumerate(change):
        some = chosen.copy()
        some[order[: n + 1]] = True
        if np.count_nonzero(some & ~chosen) > 1:
            assert tableau.whole + found == pytest.approx(dense(given, some), abs=1e-6)
        else:
            assert np.isinf(found)


@pytest.mark.parametrize("seed", range(4))
def test_impossible_amounts_are_those_of_the_posterior_mean(seed: int) -> None:
    """A power is barred exactly where its mean, with the common amount, is beyond its bound."""
    given, p = problem(seed, others=3), 8
    chosen = np.random.default_rng(seed).random(given.y.size) < 0.5
    chosen[p:] = [True, False, False]
    added, exchanged = (means(given, toggled(chosen, *some))[-1] for some in ((p + 1,), (p, p + 1)))
    for factor, possible in ((1.001, True), (0.999, False)):
        bound = np.full(given.y.size, np.inf)
        bound[p + 1] = factor * abs(added)
        tableau = Alike(replace(given, bound=bound), ALIKE).pivot(chosen)
        assert bool(np.isfinite(tableau.changes()[p + 1])) is possible
        bound[p + 1] = factor * abs(exchanged)
        tableau = Alike(replace(given, bound=bound), ALIKE).pivot(chosen)
        assert bool(np.isfinite(tableau.exchanges(np.array([p]))[0, p + 1])) is possible


def test_the_relaxation_is_below_every_set() -> None:
    """Six meters, all 64 corners; the minimum has no descent inside the bounds."""
    random = np.random.default_rng(0)
    L = random.standard_normal((6, 6))
    A, v = L @ L.T, L @ random.standard_normal(6)
    share = bounded_minimum(A, v, np.full(6, 0.5))
    least = 0.5 * share @ A @ share - v @ share
    corners = np.array(list(product([0.0, 1.0], repeat=6)))
    assert least <= (0.5 * np.vecdot(corners @ A, corners) - corners @ v).min() + 1e-6
    slope = A @ share - v
    assert (slope[share < 1.0 - 1e-9] > -1e-8).all()
    assert (slope[share > 1e-9] < 1e-8).all()


@pytest.mark.parametrize("most", [1.0, inf])
def test_bounded_minimum_against_active_sets(most: float) -> None:
    """Oracle: bounded least squares of SciPy, up to 60 components of very different curvature."""
    random = np.random.default_rng(3)
    for k in (1, 2, 5, 20, 60):
        L = random.standard_normal((k, k)) * np.geomspace(1.0, 30.0, k)
        A, v = L @ L.T, 3.0 * (L @ random.standard_normal(k))
        found = bounded_minimum(A, v, np.full(k, 0.5), most)
        exact = lsq_linear(L.T, np.linalg.solve(L, v), (0.0, most), method="bvls", tol=1e-14).x
        assert found == pytest.approx(exact, abs=1e-6)
    assert not bounded_minimum(np.zeros((0, 0)), np.zeros(0), np.zeros(0)).size


def street(seed: int, p: int = 8, powers: int = 2) -> SearchProblem:
    """A street of p meters with loads and an unread power; contiguous ones are off by one amount."""
    random = np.random.default_rng(seed)
    x = np.sort(random.uniform(0.0, 1.0, p))
    at = random.choice(p, powers, replace=False)
    H = np.hstack([np.eye(p), np.minimum.outer(x, x[at])])
    unread = np.minimum(x, x[random.integers(p)])
    V = 0.02 * np.minimum.outer(x, x) + 0.02**2 * np.eye(p) + 4.0 * np.outer(unread, unread)
    first, k, f = int(random.integers(1, p - 3)), p // 3 + 1, np.zeros(p)
    f[first : first + k] = -0.6 * (1.0 + 0.05 * random.standard_normal(k))
    m = f + np.linalg.cholesky(V) @ random.standard_normal(p)
    F, q = H.T @ np.linalg.solve(V, H), p + powers
    charge = np.where(np.arange(q) < p, 0.0, 2.0 * np.log(p))
    y = H.T @ np.linalg.solve(V, m)
    return SearchProblem(y, 0.5 * (F + F.T) + 1e-9 * np.eye(q), np.ones(q), p, charge, np.full(q, np.inf))


def mixed(given: SearchProblem, chosen: Bools) -> float:
    """Cost of a set, with amounts alike as likely as independent ones where it has several meters."""
    own = dense(given, chosen, 0.0)
    if np.count_nonzero(chosen[: given.meters]) < 2:
        return own
    return float(2.0 * (np.log(2.0) - np.logaddexp(-0.5 * own, -0.5 * dense(given, chosen))))


@pytest.mark.canary("0", "3")
@pytest.mark.parametrize("seed", range(12))
def test_no_set_of_all_is_cheaper_than_the_best_one_beside_an_unread_power(seed: int) -> None:
    """Ten faults, all 1024 subsets."""
    given = street(seed)
    nested = tuple(np.arange(i, i + n) for n in (2, 4) for i in range(0, given.meters - n + 1, n))
    found = search(given, nested)
    best = found.problems[0]
    sets = np.array(list(product([False, True], repeat=given.y.size)))
    least = min(mixed(best, chosen) for chosen in sets)
    assert mixed(best, found.chosen[0]) == pytest.approx(least, abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_opposed_amounts_bound_the_costs_of_all_sets(seed: int) -> None:
    """All sets of meters by enumeration, and any meters that may oppose the common amount."""
    given, random = problem(seed), np.random.default_rng(seed)
    p, none = given.meters, np.zeros(given.y.size - given.meters, dtype=np.bool_)
    least = min(
        dense(given, np.append(np.array(some), none))
        for some in product([False, True], repeat=p)
        if any(some)
    )
    for share in (0.2, 0.5, 1.0):
        against = random.random(p) < share
        found = [opposed(given, ALIKE, against, sign) for sign in (1.0, -1.0)]
        assert np.isfinite(found).all()
        assert min(found) <= least
        # Amounts without any prior cost least.
        free = given.charge.max() - given.y[:p] @ np.linalg.solve(given.F[:p, :p], given.y[:p])
        assert min(found) >= free - 1e-9


def test_amounts_of_both_signs_are_far_from_alike() -> None:
    """Meters off by 1 and by -1 alternately: both bounds are above the cost of independent amounts."""
    p = 8
    amount = np.where(np.arange(p) % 2, 1.0, -1.0)
    F = 1e4 * np.eye(p)
    given = SearchProblem(F @ amount, F, np.ones(p), p, np.zeros(p), np.full(p, np.inf))
    independent = dense(given, np.ones(p, dtype=np.bool_), 0.0)
    for sign in (1.0, -1.0):
        assert opposed(given, ALIKE, sign * amount < 0.0, sign) > independent
