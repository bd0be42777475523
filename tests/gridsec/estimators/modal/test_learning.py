"""State and reason of each meter's learning, and the time after which it is stalled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gridsec.errors import InputInvalid
from gridsec.estimators.front import Commission, LearningReason, LearningState
from gridsec.estimators.front.measurements import nominal_uncertainty
from gridsec.estimators.front.meter_bias import (
    COUNTED,
    REASONS,
    Learned,
    Learning,
    LearningTick,
    no_readings,
    usable,
)
from gridsec.estimators.modal.monitor import (
    ModalDesign,
    ModalState,
    from_arrays,
    init,
    progress,
    renew,
    to_arrays,
)
from gridsec.interface import Frame, PowerOrigin
from tests.codes import refused
from tests.gridsec.estimators.modal.streets import prepare, watch
from tests.gridsec.street import Street, make_plant

P = 9
NEEDED = 60.0
EXPECTED = 61.0
"""One tick without an interval before it, and 60 of 1 s, s."""
ODD = 4
WIDE = 1.0
"""Half-width of powers that say next to nothing: 100 kW, pu."""
OTHERS = np.arange(P) != ODD


def scene(seed: int = 3) -> tuple[ModalDesign, Street]:
    """A street of nine meters that are learned in 60 s."""
    plant = make_plant(np.random.default_rng(seed), customers=P, drop=0.02)
    return prepare(plant, commission_s=NEEDED), Street(plant, np.random.default_rng(seed + 1))


def states(design: ModalDesign, state: ModalState) -> list[str]:
    return [str(one) for one in progress(design, state.commission).state]


def reasons(design: ModalDesign, state: ModalState) -> list[str | None]:
    return [None if one is None else str(one) for one in progress(design, state.commission).reason]


# ------------------------------------------------------------------- states


def test_learning_on_schedule_takes_the_expected_time_and_has_no_reason() -> None:
    design, street = scene()
    state, t0 = init(design, street.t), street.t
    assert states(design, state) == ["waiting"] * P
    state, _ = watch(street, design, 2, state=state)
    assert states(design, state) == ["learning"] * P
    assert reasons(design, state) == [None] * P
    state, _ = watch(street, design, 58, state=state)
    assert states(design, state) == ["learning"] * P
    state, _ = watch(street, design, 1, state=state)
    found = progress(design, state.commission)
    assert found.expected_s == EXPECTED
    assert set(found.state) == {LearningState.LEARNED}
    assert set(found.reason) == {None}
    np.testing.assert_array_equal(state.front.learned.at, t0 + EXPECTED)


@pytest.mark.parametrize(
    ("commission_s", "step_s", "expected"),
    [
        (60.0, 1.0, 61.0),
        (86_400.0, 1.0, 86_401.0),
        (100.0, 60.0, 180.0),
        (0.3, 0.1, 0.4),
        (10.0, 900.0, 1800.0),
    ],
)
def test_the_expected_time_is_a_whole_number_of_frames(
    commission_s: float, step_s: float, expected: float
) -> None:
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    design = prepare(plant, step_s=step_s, commission_s=commission_s)
    found = progress(design, init(design, 0.0).commission)
    assert found.expected_s == pytest.approx(expected)


def test_a_silent_meter_is_stalled_after_twice_the_expected_time_and_learned_later() -> None:
    """The first frame has no interval: 122 s of ticks are 123 frames."""
    design, street = scene()
    state, _ = watch(street, design, 61, silent=(ODD,))
    assert states(design, state) == ["waiting" if k == ODD else "learned" for k in range(P)]
    assert reasons(design, state) == ["silent" if k == ODD else None for k in range(P)]
    state, _ = watch(street, design, 61, state=state, silent=(ODD,))
    assert states(design, state)[ODD] == "waiting"
    state, _ = watch(street, design, 1, state=state, silent=(ODD,))
    assert states(design, state)[ODD] == "stalled"
    assert state.front.learning is not None
    assert state.front.learning.watched_s[ODD] == 2.0 * EXPECTED
    assert state.front.learning.lost_s[REASONS.index(LearningReason.SILENT), ODD] == 2.0 * EXPECTED
    state, _ = watch(street, design, 59, state=state)
    assert (states(design, state)[ODD], reasons(design, state)[ODD]) == ("stalled", "silent")
    state, _ = watch(street, design, 1, state=state)
    assert states(design, state) == ["learned"] * P
    assert reasons(design, state) == [None] * P


def test_a_renewed_meter_has_the_whole_time_again() -> None:
    design, street = scene()
    state, _ = watch(street, design, 130, silent=(ODD,))
    assert states(design, state)[ODD] == "stalled"
    state = renew(design, state, ~OTHERS)
    assert (states(design, state)[ODD], reasons(design, state)[ODD]) == ("waiting", None)


def test_a_pause_of_the_frames_stalls_no_meter() -> None:
    """A pause counts as one interval."""
    design, street = scene()
    state, _ = watch(street, design, 10, silent=(ODD,))
    state, _ = watch(street, design, 1, h=50_000.0, state=state, silent=(ODD,))
    assert state.front.learning is not None
    assert state.front.learning.watched_s[ODD] == 10.0
    assert states(design, state)[ODD] == "waiting"


def test_without_learning_all_meters_are_learned() -> None:
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    design = prepare(plant, commission_s=0.0)
    found = progress(design, init(design, 0.0).commission)
    assert set(found.state) == {LearningState.LEARNED}
    assert set(found.reason) == {None}


# ------------------------------------------------------------------ reasons


def wide_p(frame: Frame, origin: PowerOrigin | None = None) -> Frame:
    made = replace(frame, p_error=np.full(P, WIDE))
    return made if origin is None else replace(made, p_origin=np.full(P, origin))


CHANGES: dict[str, Callable[[Frame], Frame]] = {
    "no-busbar": lambda frame: replace(frame, v0_squared=np.nan),
    "unread-powers": lambda frame: wide_p(frame, PowerOrigin.UNREAD),
    "load-beyond-declared": lambda frame: wide_p(frame, PowerOrigin.BEYOND),
    "active-uncertainty": lambda frame: wide_p(frame, PowerOrigin.READ),
    "reactive-uncertainty": lambda frame: replace(frame, q_error=np.full(P, WIDE)),
}


@pytest.mark.parametrize("reason", list(CHANGES))
def test_what_the_voltages_lack_is_the_reason(reason: str) -> None:
    design, street = scene()
    state, _ = watch(street, design, 20, change=CHANGES[reason])
    assert states(design, state) == ["waiting"] * P
    assert reasons(design, state) == [reason] * P
    assert state.front.learning is not None
    assert (state.front.learning.count == 0).all()
    np.testing.assert_array_equal(state.front.learning.lost_s.sum(axis=0), 19.0)


def test_powers_of_unknown_origin_count_as_read() -> None:
    design, street = scene()
    state, _ = watch(street, design, 20, change=wide_p)
    assert reasons(design, state) == ["active-uncertainty"] * P


@pytest.mark.parametrize(("p", "q", "reason"), [(1.0, 0.05, "active"), (0.05, 1.0, "reactive")])
def test_the_larger_of_two_uncertainties_is_the_reason(p: float, q: float, reason: str) -> None:
    """Resistances are at least 1.9 times the reactances here: 20 times the width decides."""

    def wide(frame: Frame) -> Frame:
        return replace(frame, p_error=np.full(P, p), q_error=np.full(P, q))

    design, street = scene()
    state, _ = watch(street, design, 20, change=wide)
    assert reasons(design, state) == [f"{reason}-uncertainty"] * P


def test_a_named_meter_is_suspected_and_the_others_are_learned() -> None:
    design, street = scene()
    state, answers = watch(street, design, 75, lies={ODD: 0.03})
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [ODD]
    assert reasons(design, state) == ["suspected" if k == ODD else None for k in range(P)]
    found = states(design, state)
    assert [found[k] for k in np.flatnonzero(OTHERS)] == ["learned"] * (P - 1)
    assert found[ODD] != "learned"


def lost(design: ModalDesign, before: Learning, tick: LearningTick) -> tuple[list[bool], list[str | None]]:
    """Meters for which a tick counts, and the reasons where it does not."""
    use, why = usable(design.front, before, tick)
    return use.tolist(), [None if k == COUNTED else str(REASONS[k]) for k in why]


def test_an_accused_power_holds_up_all_meters_and_silence_goes_first() -> None:
    design, street = scene()
    every = np.ones(P, dtype=np.bool_)
    frame = street.frame(silent=(ODD,))
    start = no_readings(every, street.t)
    calm = LearningTick(
        frame, frame.seen, every, accused=False, uncertainty=nominal_uncertainty(design.front)
    )
    silent = ["silent" if k == ODD else None for k in range(P)]
    assert lost(design, start, calm) == (OTHERS.tolist(), silent)
    held = [one or "others-suspected" for one in silent]
    assert lost(design, start, replace(calm, accused=True)) == ([False] * P, held)
    suspect = np.arange(P) != 1
    held[1] = "suspected"
    assert lost(design, start, replace(calm, accused=True, trusted=suspect)) == ([False] * P, held)


def test_a_meter_with_time_enough_waits_for_suspects() -> None:
    """Its readings still count; what keeps it from being learned is another meter."""
    design, street = scene()
    every, frame = np.ones(P, dtype=np.bool_), street.frame()
    start = replace(no_readings(every, street.t), time_s=np.where(OTHERS, NEEDED, 0.0))
    tick = LearningTick(
        frame, frame.seen, OTHERS, accused=False, uncertainty=nominal_uncertainty(design.front)
    )
    reason = ["others-suspected" if k != ODD else "suspected" for k in range(P)]
    assert lost(design, start, tick) == (OTHERS.tolist(), reason)


def gathered(time_s: float, watched_s: float, **lost: float) -> Commission:
    """Nine meters with the same sums, by hand."""
    start, every = no_readings(np.ones(P, dtype=np.bool_), 0.0), np.ones(P)
    lost_s = np.array([lost.get(reason.replace("-", "_"), 0.0) * every for reason in REASONS])
    blank = Learned(*(np.zeros(P),) * 3, np.full(P, np.nan), np.zeros(P))
    learning = replace(start, time_s=time_s * every, watched_s=watched_s * every, lost_s=lost_s)
    return Commission(blank, learning)


@pytest.mark.parametrize(
    ("commission", "state", "reason"),
    [
        # More than 80 % of the ticks counted: on schedule.
        (gathered(30.0, 36.0, silent=6.0), "learning", None),
        (gathered(30.0, 40.0, silent=4.0, suspected=6.0), "learning", "suspected"),
        (gathered(0.0, 121.9, no_busbar=121.9), "waiting", "no-busbar"),
        (gathered(0.0, 122.0, no_busbar=122.0), "stalled", "no-busbar"),
        # Time enough, and not concluded: a meter that is neither named nor trusted.
        (gathered(60.0, 70.0, others_suspected=10.0), "learning", "others-suspected"),
        (gathered(60.0, 122.0, others_suspected=62.0), "stalled", "others-suspected"),
        # A persistent state of an earlier version: no reason is known.
        (gathered(20.0, 122.0), "stalled", None),
    ],
)
def test_state_and_reason_of_sums(commission: Commission, state: str, reason: str | None) -> None:
    design, _ = scene()
    found = progress(design, commission)
    assert {str(one) for one in found.state} == {state}
    assert {None if one is None else str(one) for one in found.reason} == {reason}


# --------------------------------------------------------------- persistence


def test_times_survive_and_earlier_texts_load() -> None:
    """Earlier versions lack the watched and the lost times: the watched time is that which counted."""
    design, street = scene()
    state, _ = watch(street, design, 30, silent=(ODD,))
    arrays = to_arrays(design, state.commission)
    again = from_arrays(design, arrays).learning
    assert again is not None
    assert state.front.learning is not None
    np.testing.assert_array_equal(again.watched_s, state.front.learning.watched_s)
    np.testing.assert_array_equal(again.lost_s, state.front.learning.lost_s)
    new = {"watched_s", *(f"lost_s.{reason}" for reason in LearningReason)}
    assert new <= arrays.keys()
    old = from_arrays(design, {name: each for name, each in arrays.items() if name not in new})
    assert old.learning is not None
    np.testing.assert_array_equal(old.learning.watched_s, np.where(OTHERS, 29.0, 0.0))
    assert (old.learning.lost_s == 0.0).all()
    assert {str(one) for one in progress(design, old).state} == {"waiting", "learning"}


@pytest.mark.parametrize("name", ["watched_s", "lost_s.silent"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_times_that_cannot_be_are_refused(name: str, value: float) -> None:
    design, _ = scene()
    arrays: dict[str, Any] = to_arrays(design, init(design, 0.0).commission)
    arrays[name] = np.where(OTHERS, 0.0, value)
    with refused(InputInvalid, "negative") as caught:
        from_arrays(design, arrays)
    (problem,) = caught.value.problems
    assert problem.startswith(name)
    assert problem.endswith(f"(meters {ODD})")
