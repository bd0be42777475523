"""Neighbourhoods, penalties of laterals, and sets with one amount against brute force."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.modal.costs import SearchProblem, cost, costs, penalties
from gridsec.estimators.modal.laterals import Common, coded, groups, in_common, together
from gridsec.estimators.modal.model import modes
from gridsec.estimators.modal.search import ALIKE, search
from tests.gridsec.estimators.modal.test_costs import problem
from tests.gridsec.estimators.modal.test_detector import FEEDER, busbar


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
        exceptions = 2.0 * np.log(comb(5, kept) * comb(p - 5, k - kept)) if whole else penalties(p)[k]
        return cost(one, np.ones(1, dtype=np.bool_)) + exceptions

    common = Common(given, np.stack([lateral] * 3), random.random((3, p)) < 0.4)
    before = common.cost
    for inside, each in zip(common.inside, common.toggled(), strict=True):
        for j, found in enumerate(each):
            assert found == pytest.approx(exact(inside ^ (np.arange(p) == j)), abs=1e-8)
    common.descend()
    assert (common.cost <= before).all()
    for inside, cost_of in zip(common.inside, common.cost, strict=True):
        assert cost_of == pytest.approx(exact(inside), abs=1e-8)


def test_a_lateral_with_exceptions_has_the_least_penalty() -> None:
    """By binomials; meters without readings are no exceptions, and no laterals change nothing."""
    laterals = np.zeros((2, 30))
    laterals[0, :8], laterals[1, 10:14] = 1.0, 1.0
    read = np.arange(30) != 29
    sets = np.zeros((4, 30), dtype=np.bool_)
    sets[0, 1:8], sets[1, 20], sets[2, [*range(8), 25, 29]], sets[3, :11] = True, True, True, True
    got, by_number = coded(sets, laterals, read), penalties(30)[[7, 1, 10, 11]]
    assert got[0] == pytest.approx(2.0 * np.log(2 * 8))
    assert got[2] == pytest.approx(2.0 * np.log(2 * 21))
    assert np.allclose(got[[1, 3]], by_number[[1, 3]])
    assert np.allclose(coded(sets, laterals[:0], read), by_number)


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
    found = in_common(given, laterals.astype(np.float64), np.zeros(p, dtype=np.bool_))
    assert costs(given, found, ALIKE).min() <= costs(given, truth[None], ALIKE)[0] + 1e-9
    assert costs(given, truth[None], ALIKE)[0] < cost(given, truth)
    assert not (search(given, groups, (), laterals).named & ~truth).any()


def test_sequences_contain_every_group_once() -> None:
    """Nested groups, and groups that overlap: each is the beginning of one sequence."""
    made = modes(busbar())
    for some in (groups(made), (np.array([1, 2, 3]), np.array([2, 3, 4]), np.array([2, 3])), ()):
        found = [
            frozenset(members[k, : n + 1].tolist())
            for members, inside, ends in together(some)
            for k, n in zip(*np.nonzero(ends), strict=True)
            if inside[k, : n + 1].all()
        ]
        assert len(found) == len(some)
        assert set(found) == {frozenset(each.tolist()) for each in some}


def test_groups_are_nested_and_cover_neighbours() -> None:
    made = modes(busbar())
    found = groups(made)
    assert all(2 <= each.size <= made.size // 2 for each in found)
    for one, other in combinations(found, 2):
        shared = np.intersect1d(one, other).size
        assert shared in {0, one.size, other.size}
    parent = np.concatenate([[-1], FEEDER.parent])
    # The two nearest meters are neighbours on the tree.
    i, j = (int(FEEDER.bus[k]) for k in found[0])
    assert parent[i] == j or parent[j] == i or parent[i] == parent[j]
