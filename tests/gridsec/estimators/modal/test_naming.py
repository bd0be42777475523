"""Names of a part of an explanation: what is left without the readings of masked meters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import naming
from gridsec.estimators.modal.costs import SearchProblem, cost, informed
from gridsec.estimators.modal.search import Identification, identified, mixed
from tests.gridsec.estimators.modal.test_costs import problem

NO_LATERALS = np.zeros((0, 8), dtype=np.bool_)


def mask(*at: int, size: int = 8) -> Bools:
    return np.isin(np.arange(size), at)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_left_is_that_of_the_readings_of_the_others(seed: int) -> None:
    """Scores and information of all meters, from the marginal covariance of the others' readings."""
    random, p = np.random.default_rng(seed), 8
    L, m = random.standard_normal((p, p)), random.standard_normal(p)
    V, a = L @ L.T + 0.1 * np.eye(p), random.standard_normal((p, 2))
    H = np.hstack([np.eye(p), a])

    def of(seen: Bools) -> tuple[Floats, Floats]:
        rows = H[seen].T @ np.linalg.inv(V[np.ix_(seen, seen)])
        return rows @ m[seen], rows @ H[seen]

    y, F = of(np.ones(p, dtype=np.bool_))
    given = SearchProblem(y, F, np.ones(p + 2), p, np.zeros(p + 2), np.full(p + 2, np.inf))
    left, (y, F) = naming.without(given, mask(1, 4, 5)), of(~mask(1, 4, 5))
    assert np.allclose(left.y, y, atol=1e-4)
    assert np.allclose(left.F, F, atol=1e-4)
    assert (informed(left) == ~mask(1, 4, 5)).all()


def two(given: SearchProblem, first: Bools, other: Bools, weight: float) -> Identification:
    """Explanations by two sets, the first with the larger weight."""
    costs = {first.tobytes(): 0.0, other.tobytes(): -2.0 * float(np.log(weight))}
    return identified((given,), (costs,))


def colluding() -> tuple[SearchProblem, Bools, Bools]:
    """Two meters off by 1, six neighbours off by 1 as well, a power that moves these six, and its charge.

    The six are hidden beside the power: only the amount that they have in common with the two tells.
    """
    p = 8
    H = np.hstack([np.eye(p), (np.arange(p) >= 2)[:, None] * 1.0])
    F, f = 400.0 * H.T @ H, np.append(np.ones(p), 0.0)
    charge = np.append(np.zeros(p), 4.0)
    given = SearchProblem(F @ f, F, np.ones(p + 1), p, charge, np.full(p + 1, np.inf))
    return given, mask(*range(p), size=p + 1), mask(0, 1, 8, size=p + 1)


def test_a_part_is_not_masked_where_a_power_then_explains_the_rest() -> None:
    """The evidence that the rest is off by the same amount would be lost with the readings of the part."""
    given, all_meters, with_power = colluding()
    left = naming.without(given, mask(0, 1))
    assert cost(left, with_power & ~mask(0, 1, size=9)) < cost(left, all_meters & ~mask(0, 1, size=9))
    found = two(given, all_meters, with_power, 0.01)
    assert not naming.separable(found, mask(0, 1), NO_LATERALS)
    assert naming.separable(found, mask(*range(8)), NO_LATERALS)
    streak = np.full(8, naming.SEVERAL)
    assert not naming.final(found, None, mask(0, 1), streak, (), NO_LATERALS).any()
    later = np.full(8, naming.WHOLE)
    assert naming.final(found, None, mask(0, 1), later, (), NO_LATERALS).tolist() == mask(0, 1).tolist()


@pytest.mark.parametrize(("settled", "searches"), [(True, naming.CONFIRM), (False, naming.SEVERAL)])
def test_an_explanation_that_leaves_misfit_names_later(settled: bool, searches: int) -> None:
    given = problem(3, p=8, others=0)
    found = two(given, mask(0, 1, 2), mask(0, 1, 3), 0.5)
    for streak in range(1, naming.SEVERAL + 1):
        turns = np.full(8, streak)
        named = naming.confirmed(found, None, mask(0, 1), turns, (), settled=settled)
        assert named.tolist() == (mask(0, 1) & (streak >= searches)).tolist()


def test_a_part_is_masked_where_the_rest_stays_likely() -> None:
    """Faults far apart: each explains its own readings, whatever else is read."""
    given = problem(1)
    given = replace(given, y=np.where(mask(2, 6, size=10), 300.0, 0.0), F=100.0 * np.eye(10))
    found = two(given, mask(2, 6, size=10), mask(2, size=10), 1e-4)
    assert naming.separable(found, mask(2), NO_LATERALS)
    assert (
        naming.final(found, None, mask(2), np.full(8, naming.SEVERAL), (), NO_LATERALS).tolist()
        == mask(2).tolist()
    )


def test_a_part_is_not_masked_where_the_rest_would_count_as_honest() -> None:
    """A rest that is not worth its penalty alone is not left behind."""
    given, all_meters, _ = colluding()
    F = np.diag(400.0 * np.array([1.0, 1.0, *(6 * [0.005]), 0.0]))
    given = replace(given, y=F @ np.ones(9), F=F)
    found = two(given, all_meters, mask(0, 1, size=9), 0.01)
    left = naming.without(given, mask(0, 1))
    rest = all_meters & ~mask(0, 1, size=9)
    own, nothing = mixed(left, np.stack([rest, rest & False]))
    assert own > nothing
    assert not naming.separable(found, mask(0, 1), NO_LATERALS)


def test_a_part_is_masked_where_the_rest_is_doubtful_anyway() -> None:
    """The limits of both weights, on either side."""
    given, all_meters, with_power = colluding()
    for weight, separable in ((0.04, False), (0.06, True)):
        found = two(given, all_meters, with_power, weight)
        assert naming.separable(found, mask(0, 1), NO_LATERALS) is separable


def test_masked_meters_alone() -> None:
    """The best set has masked meters only; a set with another one weighs a hundredth, or twice as much."""
    given, *_ = colluding()
    for weight, sure in ((0.01, True), (2.0, False)):
        found = two(given, mask(0, 1, size=9), mask(0, 3, size=9), weight)
        assert (naming.alone(found, mask(0, 1, 2)) == (mask(0, 1) & sure)).all()
    # A power is no masked meter.
    assert not naming.alone(two(given, mask(0, 8, size=9), mask(0, 1, size=9), 0.01), mask(0, 1, 2)).any()
