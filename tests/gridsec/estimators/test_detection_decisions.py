"""Who is named when, and which answer comes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gridsec.estimators.detection import Counters, DecisionInputs, count, decide, residual_excess
from gridsec.interface import Cause, Decision

FRESH = Counters(np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp), np.zeros(1, dtype=bool))


@given(
    history=st.lists(st.sampled_from(["over", "under", "silent"]), max_size=30),
    confirm=st.integers(1, 4),
    release=st.integers(1, 4),
)
def test_named_by_readings_under_suspicion(history: list[str], confirm: int, release: int) -> None:
    """Against the plain reading of all that was heard; silence is no reading.

    A suspicion is what follows the last run of `release` readings below; it names with `confirm` above.
    """
    tally, named, heard = FRESH, False, []
    for what in history:
        live, over = np.array([what != "silent"]), np.array([what == "over"])
        tally = count(tally, over, live, confirm=confirm, release=release)
        if what != "silent":
            heard.append(what)
            runs = [
                i for i in range(release, len(heard) + 1) if heard[i - release : i] == ["under"] * release
            ]
            suspicion = heard[runs[-1] if runs else 0 :].count("over")
            named = suspicion >= confirm
            assert (tally.above[0] > 0) == (suspicion > 0)
        assert tally.named[0] == named


@given(gap=st.integers(0, 8), start=st.integers(0, 5))
def test_flicker_is_named_with_its_second_flash(gap: int, start: int) -> None:
    """A lie on every second, third, ... reading, down to one in `release`, and never free in between."""
    tally = FRESH
    flashes = 0
    for k in range(start + 10 * (gap + 1)):
        over = np.array([k >= start and (k - start) % (gap + 1) == 0])
        flashes += bool(over[0])
        tally = count(tally, over, np.array([True]), confirm=2, release=9)
        assert tally.named[0] == (flashes >= 2)
        assert (tally.above[0] > 0) == (flashes >= 1)


def calm() -> DecisionInputs:
    no = np.zeros(5, dtype=bool)
    return DecisionInputs(
        names=tuple("abcde"),
        max_attacked=1,
        live=~no,
        suspected=no,
        named=no,
        wide=no,
        valid=True,
        settled=True,
        busbar=True,
    )


def only(*places: int) -> np.ndarray:
    return np.isin(np.arange(5), places)


def test_clean_needs_everything_to_be_right() -> None:
    assert decide(calm())[:2] == (Decision.CLEAN, Cause.AGREEMENT)


def test_order_of_answers() -> None:
    """Each flaw hides all that come after it, and none of them leaves CLEAN."""
    flaws: list[tuple[Cause, dict[str, object]]] = [
        (Cause.AMBIGUOUS, {"wide": only(3)}),
        (Cause.AMBIGUOUS, {"suspected": only(2)}),
        (Cause.SETTLING, {"settled": False}),
        (Cause.SILENT_METERS, {"live": ~only(4)}),
        (Cause.RESIDUALS, {"named": only(1)}),
        (Cause.TOO_MANY_SUSPECTS, {"named": only(0, 1)}),
        (Cause.NO_BUSBAR, {"busbar": False}),
        (Cause.TOO_FEW_METERS, {"live": only(0, 1)}),
        (Cause.DESIGN_INVALID, {"valid": False}),
    ]
    piled = calm()
    for cause, flaw in flaws:
        for situation in (replace(calm(), **flaw), piled := replace(piled, **flaw)):
            decision, given_cause, reason = decide(situation)
            assert given_cause is cause
            assert decision is (Decision.ATTACKED if cause is Cause.RESIDUALS else Decision.UNDECIDED)
            assert reason.endswith(".")


def test_who_is_silent_contradicts_nobody() -> None:
    """One of two that are named says nothing: what is left can be told apart."""
    two = replace(calm(), named=only(0, 1), suspected=only(0, 1))
    assert decide(two)[1] is Cause.TOO_MANY_SUSPECTS
    assert decide(replace(two, live=~only(1)))[:2] == (Decision.ATTACKED, Cause.RESIDUALS)


def test_reasons_name_the_meters() -> None:
    assert "b, d" in decide(replace(calm(), max_attacked=2, named=only(1, 3)))[2]
    assert "c" in decide(replace(calm(), live=~only(2)))[2]
    many = replace(calm(), names=tuple(f"m{i}" for i in range(5)), named=only(0, 1, 2, 3, 4), max_attacked=5)
    assert "m4" in decide(replace(many, live=np.ones(5, dtype=bool), max_attacked=2))[2]


def test_residual_excess() -> None:
    score, threshold = np.array([1.0, 3.0, 9.0, 2.0]), np.array([2.0, 2.0, 2.0, 0.0])
    live = np.array([True, True, False, True])
    np.testing.assert_allclose(residual_excess(score, threshold, live), [0.0, 0.5, 0.0, 0.0])
