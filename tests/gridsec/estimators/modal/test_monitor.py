"""The monitor: final names; errors of registers in proportion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.modal.costs import SearchProblem
from gridsec.estimators.modal.monitor import design, init, own_errors, step
from gridsec.estimators.modal.naming import CONFIRM, SEVERAL, confirmed
from gridsec.estimators.modal.replay import Reading
from gridsec.estimators.modal.search import Identification
from gridsec.estimators.modal.verdict import combined
from gridsec.interface import Decision, Explanation
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.street import Street, make_plant

P = 5


def mask(*at: int, size: int = P) -> Bools:
    return np.isin(np.arange(size), at)


def found(*faults: int) -> Identification:
    """Explanation by some of the meters, a power (5) and the busbar (6)."""
    every = mask(*faults, size=P + 2)[None]
    return Identification(every, np.zeros(1, np.intp), np.ones(1), every[0, :P], ())


def ticks(*seen: Bools | None) -> list[Reading]:
    return [(float(k), np.zeros(P), one, None) for k, one in enumerate(seen)]


NONE = np.zeros(P, dtype=np.intp)


def test_a_sole_fault_with_two_readings_is_named_by_one_search() -> None:
    assert confirmed(found(2), None, mask(2), NONE + mask(2), ticks(None, None)).tolist() == mask(2).tolist()


@pytest.mark.parametrize(
    "since",
    [ticks(None), ticks(mask(0, 1), mask(0, 1), None), ticks(mask(0), mask(2))],
    ids=["one tick", "after a gap", "silent"],
)
def test_one_reading_of_the_meter_is_not_enough(since: list[Reading]) -> None:
    assert not confirmed(found(2), None, mask(2), NONE + mask(2), since).any()


@pytest.mark.parametrize(("amount", "passes"), [(0.5, True), (0.7, True), (1.0, False), (0.0, False)])
def test_a_sole_fault_that_the_last_reading_has_not_waits(amount: float, passes: bool) -> None:
    """Means of two readings after 1 for the first one: the second has 0, 0.4, 1 and -1."""

    def problem(x: float, F: float) -> SearchProblem:
        y = F * x * mask(2, size=P + 2)
        return SearchProblem(y, F * np.eye(P + 2), np.ones(P + 2), P, np.zeros(P + 2), np.full(P + 2, np.inf))

    before, now = replace(found(2), problems=(problem(1.0, 9.0),)), found(2)
    now = replace(now, problems=(problem(amount, 7.0),))
    since = ticks(None, None)
    assert confirmed(now, before, mask(2), CONFIRM * mask(2), since).any() != passes
    assert confirmed(now, before, mask(2), SEVERAL * mask(2), since).tolist() == mask(2).tolist()
    # A transition is no model of the search before.
    other = replace(now, model=np.ones(1, np.intp), problems=(*now.problems, problem(amount, 7.0)))
    assert confirmed(other, before, mask(2), CONFIRM * mask(2), since).tolist() == mask(2).tolist()


@pytest.mark.parametrize("faults", [(1, 2), (2, 5), (2, 6)], ids=["meter", "power", "busbar"])
def test_a_part_of_several_faults_needs_searches_in_turn(faults: tuple[int, ...]) -> None:
    several, since = found(*faults), ticks(None, None, None)
    named = replace(several, named=mask(2)).named
    assert not confirmed(several, None, named, NONE + named, since).any()
    assert confirmed(several, None, named, CONFIRM * named, since).tolist() == named.tolist()


def test_meters_that_are_named_by_turns_of_different_length_are_apart() -> None:
    """An explanation is named whole; after `SEVERAL` searches in turn a meter is named by itself."""
    streak, since = CONFIRM * mask(1) + mask(3), ticks(None, None)
    assert confirmed(found(1, 3), None, mask(1, 3), streak + mask(3), since).tolist() == mask(1, 3).tolist()
    assert not confirmed(found(1, 3), None, mask(1, 3), streak, since).any()
    later = streak + (SEVERAL - CONFIRM) * mask(1)
    assert confirmed(found(1, 3), None, mask(1, 3), later, since).tolist() == mask(1).tolist()


def test_a_meter_that_is_accused_but_not_named_is_not_final() -> None:
    """Searches in turn count for the likeliest explanation; the last one has to name the meter."""
    streak = CONFIRM * mask(1, 3)
    assert confirmed(found(1, 3), None, mask(3), streak, ticks(None, None)).tolist() == mask(3).tolist()


def test_masked_meters_leave_no_fault_alone() -> None:
    """Without the ticks since the onset, a sole fault needs searches in turn."""
    assert not confirmed(found(2), None, mask(2), NONE + mask(2), []).any()


def test_errors_of_registers_follow_the_voltage() -> None:
    """The voltage falls by 5 % once errors are learned: 20 standard deviations of 500 readings, and CLEAN."""
    plant = make_plant(
        np.random.default_rng(5), customers=12, drop=0.03, inverters=np.zeros(0, dtype=np.intp)
    )
    front = front_end(plant)
    made = design(plant, doubt=front.doubt, step_s=1.0)
    street, largest = Street(plant, np.random.default_rng(6)), 0.0
    state = init(made, street.t)
    for k in range(900):
        street.advance(1.0)
        street.v0 = 1.0 if k < 400 else 0.95
        state, _, verdict = step(made, state, street.frame())
        largest = max(largest, state.core.detector.log_m)
        # At the step itself a reading may be of the moment before.
        assert verdict.decision is Decision.CLEAN or k < 10 or k == 400
    assert largest < 0.6 * made.core.limit
    off = own_errors(made, state.core) - 2.0 * street.bias
    # All meters share the error of the busbar's.
    assert np.abs(off - off.mean()).max() < 5e-4


def test_explanations_of_voltages_and_of_reported_powers_multiply() -> None:
    """Equal sets are one, and inverters named in any case are in each."""

    def way(meter: int, inverter: int, power: int, probability: float) -> Explanation:
        return Explanation(mask(meter), mask(inverter, size=3), probability, mask(power), mask(size=1))

    rivals = (way(1, -1, -1, 0.6), way(-1, 0, -1, 0.4))
    cases = (way(-1, 0, -1, 0.7), way(-1, -1, 2, 0.3))
    told = combined(rivals, cases, mask(1, size=3))
    assert [round(each.probability, 6) for each in told] == [0.42, 0.28, 0.18, 0.12]
    assert all(each.inverters[1] for each in told)
    assert told[0].meters[1]
    assert told[3].powers[2]
    assert told[3].inverters[0]
    twice = combined((way(1, -1, -1, 0.6), way(1, 0, -1, 0.4)), (way(-1, 0, -1, 1.0),), mask(0, size=3))
    assert [each.probability for each in twice] == [1.0]
    assert twice[0].meters.tolist() == mask(1).tolist()
    assert twice[0].inverters.tolist() == mask(0, size=3).tolist()
    (alone,) = combined((way(1, -1, -1, 1.0),), (way(-1, 0, -1, 0.9),), mask(2, size=3))
    assert alone.meters[1]
    assert alone.inverters.tolist() == mask(0, 2, size=3).tolist()
    assert combined((), cases, mask(1, size=3)) is cases
    assert combined(rivals, (), mask(size=3)) is rivals
