"""Who is named when, and which answer comes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gridsec.judge import Situation, Tally, count, decide, residual_excess
from gridsec.online import Cause, Decision

FRESH = Tally(np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp), np.zeros(1, dtype=bool))


@given(
    history=st.lists(st.sampled_from(["over", "under", "silent"]), max_size=30),
    confirm=st.integers(1, 4),
    release=st.integers(1, 4),
)
def test_named_by_runs(history: list[str], confirm: int, release: int) -> None:
    """Against the plain reading: silence is no reading, and only runs of readings change anything."""
    tally, named, heard = FRESH, False, []
    for what in history:
        live, over = np.array([what != "silent"]), np.array([what == "over"])
        tally = count(tally, over, live, confirm=confirm, release=release)
        if what != "silent":
            heard.append(what)
            if heard[-confirm:] == ["over"] * confirm:
                named = True
            if heard[-release:] == ["under"] * release:
                named = False
        assert tally.named[0] == named


def calm() -> Situation:
    no = np.zeros(5, dtype=bool)
    return Situation(
        names=tuple("abcde"),
        max_attacked=1,
        live=~no,
        over=no,
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
        (Cause.AMBIGUOUS, {"over": only(2)}),
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


def test_reasons_name_the_meters() -> None:
    assert "b, d" in decide(replace(calm(), max_attacked=2, named=only(1, 3)))[2]
    assert "c" in decide(replace(calm(), live=~only(2)))[2]
    many = replace(calm(), names=tuple(f"m{i}" for i in range(5)), named=only(0, 1, 2, 3, 4), max_attacked=5)
    assert "m4" in decide(replace(many, live=np.ones(5, dtype=bool), max_attacked=2))[2]


def test_residual_excess() -> None:
    score, threshold = np.array([1.0, 3.0, 9.0, 2.0]), np.array([2.0, 2.0, 2.0, 0.0])
    live = np.array([True, True, False, True])
    np.testing.assert_allclose(residual_excess(score, threshold, live), [0.0, 0.5, 0.0, 0.0])
