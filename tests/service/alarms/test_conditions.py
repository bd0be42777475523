"""What a report says of a feeder: conditions, of which alarms are made."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import replace

import pytest

from gridsec.estimators.front import LearningReason
from gridsec.interface import Cause
from service.alarms.state_machine import (
    AlarmBook,
    AlarmEvidence,
    AlarmKind,
    AlarmRules,
    Condition,
    Severity,
    advance,
    conditions,
)
from service.alarms.state_machine import from_json as alarm_from_json
from service.alarms.state_machine import to_json as alarm_json
from service.report.report import BUSBAR, LearningReport, StalledMeter, with_learning
from tests.service.reports import FEEDER, inverter, meter, report, with_inverters

UNDECIDED_CAUSES = [cause for cause in Cause if cause not in (Cause.AGREEMENT, Cause.RESIDUALS)]


def said(found: Iterable[Condition]) -> dict[tuple[str, str | None], bool]:
    return {(str(c.kind), c.meter): c.known for c in found}


def test_a_clean_feeder_has_no_conditions() -> None:
    assert conditions(report(meter("m1"), meter("m2"))) == []


def test_a_suspect_is_a_condition_with_its_numbers() -> None:
    liar = meter("m2", suspect=True, score=9e-3, v_volt_reported=240.0, attack_volt_estimated=10.0)
    (found,) = conditions(report(meter("m1"), liar, cause=Cause.RESIDUALS))
    assert (found.kind, found.meter, found.known) == (AlarmKind.METER_MANIPULATED, "m2", True)
    assert found.severity is Severity.CRITICAL
    assert found.evidence == AlarmEvidence(9e-3, 2e-3, 240.0, 230.0, 10.0)
    assert "240.0 V" in found.reason
    assert "230.0 V" in found.reason


def test_evidence_says_what_a_manipulation_looks_like() -> None:
    liar = meter("m2", suspect=True, kind="drift")
    (found,) = conditions(report(liar, cause=Cause.RESIDUALS))
    assert found.evidence.kind == "drift"


def test_a_manipulated_inverter_is_a_condition_of_its_customer() -> None:
    wrong = inverter(suspect=True, attack_kvar_estimated=-6.25)
    other = inverter("Lovelace", meter=None)
    (found,) = conditions(with_inverters(report(meter("m1"), cause=Cause.RESIDUALS), wrong, other))
    assert (found.kind, found.subject, found.meter) == (AlarmKind.INVERTER_MANIPULATED, "Miller", "m1")
    assert (found.severity, found.known) == (Severity.CRITICAL, True)
    assert found.evidence == AlarmEvidence(attack_kvar_estimated=-6.25)
    assert "the inverter of Miller injects -6.2 kvar" in found.reason


@pytest.mark.parametrize("cause", [*UNDECIDED_CAUSES, Cause.AGREEMENT])
def test_who_does_not_judge_inverters_says_nothing_about_them(cause: Cause) -> None:
    """Neither an estimator that only knows meters nor an undecided one clears an inverter's alarm."""
    judged = cause is not Cause.AGREEMENT
    found = conditions(with_inverters(report(meter("m1"), cause=cause), inverter(judged=judged)))
    assert [(c.subject, c.known) for c in found if c.kind is AlarmKind.INVERTER_MANIPULATED] == [
        ("Miller", False)
    ]


@pytest.mark.parametrize("cause", UNDECIDED_CAUSES)
def test_undecided_says_nothing_about_any_meter(cause: Cause) -> None:
    found = said(conditions(report(meter("m1", suspect=True), meter("m2"), cause=cause)))
    assert found["meter-manipulated", "m1"] is False
    assert found["meter-manipulated", "m2"] is False


@pytest.mark.parametrize("cause", [Cause.AGREEMENT, Cause.RESIDUALS])
def test_a_silent_meter_is_neither_manipulated_nor_honest(cause: Cause) -> None:
    unseen = meter("m2", seen=False, score=None, v_volt_reported=None)
    found = said(conditions(report(meter("m1"), unseen, cause=cause)))
    assert found["meter-manipulated", "m2"] is False
    assert ("meter-manipulated", "m1") not in found


def test_a_lying_meter_raises_no_voltage_alarm() -> None:
    liar = meter("m1", suspect=True, v_volt_reported=260.0, v_volt_estimated=231.0)
    found = said(conditions(report(liar, cause=Cause.RESIDUALS)))
    assert found == {("meter-manipulated", "m1"): True}


@pytest.mark.parametrize(
    ("volt", "third", "expected"),
    [
        (253.0, 0.5, None),  # on the limit is inside
        (253.1, 0.5, False),  # outside, but the truth may be inside: hold
        (254.6, 0.5, True),  # the whole interval is outside
        (254.5, 0.5, False),  # the interval just touches the limit
        (207.0, 0.5, None),
        (206.9, 0.5, False),
        (205.4, 0.5, True),
        (math.nan, 0.5, False),
        (None, 0.5, False),
        (260.0, None, False),
        (260.0, math.inf, False),
    ],
)
def test_voltage_limit_needs_the_whole_interval(
    volt: float | None, third: float | None, expected: bool | None
) -> None:
    found = said(conditions(report(meter(v_volt_estimated=volt, v_volt_std=third))))
    assert found.get(("voltage-limit", "m1")) is expected


@pytest.mark.parametrize("cause", list(Cause))
def test_voltage_limit_only_where_the_reconstruction_is_sound(cause: Cause) -> None:
    found = said(conditions(report(meter(v_volt_estimated=260.0), cause=cause)))
    unread = (Cause.SILENT_METERS, Cause.CLOCK_OFFSET, Cause.MISSING_POWERS)
    sound = cause in (Cause.AGREEMENT, Cause.RESIDUALS, *unread)
    assert found["voltage-limit", "m1"] is sound


def test_voltage_limit_says_which_side() -> None:
    high, low = conditions(report(meter("m1", v_volt_estimated=260.0), meter("m2", v_volt_estimated=190.0)))
    assert "above the limit of 253.0 V" in high.reason
    assert "below the limit of 207.0 V" in low.reason


def test_silence_is_data_loss_and_not_undecided() -> None:
    unseen = meter("m2", seen=False, score=None, v_volt_reported=None)
    found = conditions(report(meter("m1"), unseen, cause=Cause.SILENT_METERS, silent=(("m2", 12.0),)))
    loss = next(c for c in found if c.kind is AlarmKind.DATA_LOSS)
    assert (loss.meter, loss.known, loss.severity) == ("m2", True, Severity.MINOR)
    assert "12 s" in loss.reason
    assert said(found)["undecided", None] is False


def test_a_meter_that_was_never_heard_is_data_loss_with_words_for_it() -> None:
    unseen = meter("m1", seen=False)
    found = conditions(report(unseen, cause=Cause.SILENT_METERS, silent=(("m1", math.inf),)))
    loss = next(c for c in found if c.kind is AlarmKind.DATA_LOSS)
    assert loss.reason == "no usable reading yet"


def test_unseen_but_not_for_long_is_unknown() -> None:
    found = said(conditions(report(meter("m1", seen=False), cause=Cause.SILENT_METERS)))
    assert found["data-loss", "m1"] is False


def test_a_silent_busbar_is_worse() -> None:
    found = conditions(report(meter("m1"), cause=Cause.NO_BUSBAR, silent=((BUSBAR, 30.0),)))
    loss = next(c for c in found if c.kind is AlarmKind.DATA_LOSS)
    assert (loss.meter, loss.known, loss.severity) == (BUSBAR, True, Severity.MAJOR)


@pytest.mark.parametrize("cause", list(Cause))
def test_a_busbar_unseen_but_not_for_long_is_unknown(cause: Cause) -> None:
    """Whatever the estimator makes of it: one that replaces the busbar's voltage decides all the same."""
    seen = report(meter("m1"), cause=cause)
    unseen = replace(seen, busbar=replace(seen.busbar, seen=False))
    assert said(conditions(unseen))["data-loss", BUSBAR] is False
    assert (("data-loss", BUSBAR) in said(conditions(seen))) is (cause is Cause.NO_BUSBAR)


@pytest.mark.parametrize("cause", UNDECIDED_CAUSES)
def test_undecided_is_an_alarm_unless_something_else_says_it(cause: Cause) -> None:
    silent = (("m2", 12.0), (BUSBAR, 12.0))
    found = conditions(report(meter("m1"), meter("m2", seen=False), cause=cause, silent=silent))
    (undecided,) = (c for c in found if c.kind is AlarmKind.UNDECIDED)
    covered = cause in (Cause.SETTLING, Cause.SILENT_METERS, Cause.CLOCK_OFFSET, Cause.NO_BUSBAR)
    assert undecided.known is not covered
    assert undecided.reason == "the reason"
    assert undecided.meter is None


@pytest.mark.parametrize(
    ("cause", "silent", "covered"),
    [
        (Cause.SILENT_METERS, ("m2", "m3"), True),
        (Cause.SILENT_METERS, ("m2",), False),
        (Cause.SILENT_METERS, (BUSBAR,), False),
        (Cause.NO_BUSBAR, (BUSBAR,), True),
        (Cause.NO_BUSBAR, ("m2", "m3"), False),
    ],
)
def test_undecided_for_want_of_readings_is_told_unless_data_loss_tells_all_of_it(
    cause: Cause, silent: tuple[str, ...], covered: bool
) -> None:
    """Who is missing now and then is never silent, and the feeder may be undecided for ever over it."""
    meters = (meter("m1"), meter("m2", seen=False), meter("m3", seen=False))
    found = conditions(report(*meters, cause=cause, silent=tuple((name, 12.0) for name in silent)))
    (undecided,) = (c for c in found if c.kind is AlarmKind.UNDECIDED)
    assert (undecided.known, undecided.unheard) == (not covered, True)


# --------------------------------------------------------------------- clocks


def test_clocks_of_meters_and_of_the_busbar_meter() -> None:
    now = report(meter("m1", clock_offset_s=1.5), meter("m2", clock_offset_s=-2.0), meter("m3"))
    found = conditions(replace(now, busbar=replace(now.busbar, clock_offset_s=3.0)))
    assert [(one.subject, one.kind, one.severity) for one in found] == [
        (name, AlarmKind.CLOCK_OFFSET, Severity.MINOR) for name in ("m1", "m2", BUSBAR)
    ]
    assert ["ahead of" in one.reason for one in found] == [True, False, True]
    assert ["come later" in one.reason for one in found] == [False, True, False]


# ------------------------------------------------------------------- learning

SILENT, NO_BUSBAR = LearningReason.SILENT, LearningReason.NO_BUSBAR
STALLED = (StalledMeter("m2", SILENT, 30.0), StalledMeter("m3", NO_BUSBAR, 0.0))


def test_stalled_meters_are_one_condition_of_the_feeder() -> None:
    """With the number of meters for each reason, and the meters as evidence."""
    now = report(meter("m1"), meter("m2"), meter("m3"))
    learning = LearningReport(
        ("learned", "stalled", "stalled"), (None, "silent", "no-busbar"), 86_401.0, STALLED
    )
    (found,) = conditions(with_learning(now, learning))
    assert (found.kind, found.subject, found.known) == (AlarmKind.LEARNING_STALLED, None, True)
    assert found.severity is Severity.MINOR
    assert found.evidence == AlarmEvidence(learning=STALLED)
    assert found.reason == (
        "2 of 3 meters are not learned after twice the expected time of 86401 s: m2, m3; "
        "lost time: no-busbar (1), silent (1)"
    )


def test_at_most_five_stalled_meters_have_their_names() -> None:
    names = [f"m{k}" for k in range(8)]
    now = report(*(meter(name, customer=f"Load {name}") for name in names))
    stalled = tuple(StalledMeter(name, SILENT, 30.0) for name in names[:7])
    learning = LearningReport(("stalled",) * 8, (SILENT,) * 8, 61.0, stalled)
    (found,) = conditions(with_learning(now, learning))
    assert ": m0 · Load m0, m1 · Load m1, " in found.reason
    assert ", m4 · Load m4 and 2 more; " in found.reason


def test_a_stalled_meter_without_lost_time_has_words_for_it() -> None:
    learning = LearningReport(("stalled",), (None,), 61.0, (StalledMeter("m1", None, 20.0),))
    (found,) = conditions(with_learning(report(meter("m1")), learning))
    assert found.reason.endswith(": no time lost (1)")


@pytest.mark.parametrize("state", ["waiting", "learning", "learned"])
def test_learning_on_schedule_is_no_condition(state: str) -> None:
    assert conditions(with_learning(report(meter("m1")), LearningReport((state,), (None,), 61.0))) == []


def test_without_a_monitor_learning_is_unknown() -> None:
    """In contrast to an estimator that does not learn, where it is known that none is stalled."""
    assert conditions(report(meter("m1"))) == []
    (found,) = conditions(replace(report(meter("m1")), learning=None))
    assert (found.kind, found.known) == (AlarmKind.LEARNING_STALLED, False)


def test_an_alarm_keeps_its_stalled_meters_in_its_text() -> None:
    learning = LearningReport(("stalled",) * 2, (SILENT, NO_BUSBAR), 61.0, STALLED)
    now = with_learning(report(meter("m2"), meter("m3")), learning)
    book, _ = advance(AlarmBook(FEEDER), AlarmRules(on_delay_s=0.0), conditions(now), now.t)
    (alarm,) = book.active
    assert alarm.evidence.learning == STALLED
    text = json.dumps(alarm_json(alarm))
    assert alarm_from_json(json.loads(text)) == alarm
    # Alarms of earlier versions have no such field.
    old = json.loads(text)
    del old["evidence"]["learning"]
    assert alarm_from_json(old).evidence.learning == ()
