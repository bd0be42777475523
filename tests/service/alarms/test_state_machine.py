"""Alarms: how they begin, stand, end, come back and are acknowledged."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridsec.errors import InputInvalid
from gridsec.estimators.data_errors import DataErrorKind
from gridsec.interface import Cause
from service.alarms.state_machine import (
    Alarm,
    AlarmBook,
    AlarmEvidence,
    AlarmKind,
    AlarmRules,
    AlarmState,
    AlarmTransition,
    AlarmUnknown,
    AlreadyAcknowledged,
    Change,
    Condition,
    NotAcknowledged,
    RaisedAgain,
    Severity,
    acknowledged,
    advance,
    carried,
    carry,
    close,
    conditions,
    from_json,
    hold,
    restore,
    to_json,
    unacknowledged,
)
from service.report.data_errors import DataErrorReport
from service.report.report import ExplanationReport
from tests.codes import refused
from tests.service.reports import FEEDER, T0, acknowledge, inverter, meter, report, with_inverters


def test_an_inverter_s_alarm_lives_like_any_other() -> None:
    """Raised after its delay, held while undecided, acknowledged, cleared; two inverters are two alarms."""
    wrong = [inverter(c, meter=None, suspect=True, attack_kvar_estimated=3.0) for c in ("Miller", "Lovelace")]
    clean = [inverter(c, meter=None) for c in ("Miller", "Lovelace")]
    book, seen = AlarmBook(FEEDER), []
    for k, (cause, inverters) in enumerate(
        [(Cause.RESIDUALS, wrong)] * 4 + [(Cause.AMBIGUOUS, clean)] * 20 + [(Cause.AGREEMENT, clean)] * 8
    ):
        now = with_inverters(report(meter("m1"), cause=cause, t=T0 + k), *inverters)
        book, transitions = advance(book, AlarmRules(), conditions(now), now.t)
        seen += [(k, t.alarm.customer, t.change) for t in transitions if t.alarm.customer]
        if k == 5:
            (mine,) = [a for a in book.active if a.customer == "Miller"]
            book, _ = acknowledge(book, mine.id, "Ada", "", now.t)
    assert seen == [
        (2, "Lovelace", Change.RAISED),
        (2, "Miller", Change.RAISED),
        (29, "Lovelace", Change.CLEARED),
        (29, "Miller", Change.CLEARED),
    ]
    assert {a.customer: a.acknowledged_by for a in book.alarms if a.customer} == {
        "Lovelace": None,
        "Miller": "Ada",
    }
    assert restore(FEEDER, book.alarms).alarms == book.alarms


# ------------------------------------------------------------- one condition's life

RULES = AlarmRules(on_delay_s=2.0, off_delay_s=5.0, memory_s=60.0)

TRUTHS = "PAU"  # present, absent, unknown


def tick(truth: str, name: str | None = "m1") -> list[Condition]:
    if truth == "A":
        return []
    kind = AlarmKind.METER_MANIPULATED
    return [Condition(kind, FEEDER, name, Severity.CRITICAL, AlarmEvidence(1.0), "why", known=truth == "P")]


Tick = tuple[float, str]


def run(
    ticks: Sequence[Tick], rules: AlarmRules = RULES, book: AlarmBook | None = None
) -> tuple[AlarmBook, list[AlarmTransition]]:
    book = book or AlarmBook(FEEDER)
    happened: list[AlarmTransition] = []
    for t, truth in ticks:
        book, new = advance(book, rules, tick(truth), t)
        happened += new
    return book, happened


def times(happened: Iterable[AlarmTransition]) -> list[tuple[float, Change]]:
    return [(item.t - T0, item.change) for item in happened]


def at_1_hz(truths: str) -> list[Tick]:
    return [(T0 + k, truth) for k, truth in enumerate(truths)]


def test_raised_after_the_on_delay_and_cleared_after_the_off_delay() -> None:
    book, happened = run(at_1_hz("AAPPPPPAAAAAAAA"))
    assert times(happened) == [(4.0, Change.RAISED), (12.0, Change.CLEARED)]
    (alarm,) = book.alarms
    assert (alarm.t_event, alarm.t_raised, alarm.t_cleared) == (T0 + 2, T0 + 4, T0 + 12)
    assert (alarm.state, alarm.count, book.active) == (AlarmState.CLEARED, 1, ())


def test_a_flicker_shorter_than_the_delay_is_no_alarm() -> None:
    book, happened = run(at_1_hz("PPAPPAPPA"))
    assert happened == []
    assert book.entries == {}


def test_no_answer_holds_an_alarm() -> None:
    book, happened = run(at_1_hz("PPP" + "U" * 1000))
    assert times(happened) == [(2.0, Change.RAISED)]
    assert len(book.active) == 1


def test_no_answer_confirms_nothing_and_forgets_nothing() -> None:
    _, happened = run(at_1_hz("PP" + "U" * 50 + "PP"))
    # Each of the two answers stood for a second, and the third raises.
    assert times(happened) == [(52.0, Change.RAISED)]


def test_an_answer_at_every_other_tick_is_enough() -> None:
    """Who is heard of now and then only neither escapes an alarm nor keeps one for ever."""
    _, happened = run(at_1_hz("PU" * 5 + "AU" * 10))
    assert times(happened) == [(4.0, Change.RAISED), (20.0, Change.CLEARED)]
    quarter_hours = [(T0 + 900.0 * k, truth) for k, truth in enumerate("UPUPUUAUAU")]
    assert times(run(quarter_hours)[1]) == [(2700.0, Change.RAISED), (7200.0, Change.CLEARED)]


def test_no_answer_does_not_count_for_clearing() -> None:
    _, happened = run(at_1_hz("PPP" + "AAA" + "U" * 50 + "AAAA"))
    assert times(happened) == [(2.0, Change.RAISED), (58.0, Change.CLEARED)]


def test_coming_back_soon_counts_up_coming_back_late_is_a_new_alarm() -> None:
    soon = "PPP" + "A" * 6 + "PPP"
    book, happened = run(at_1_hz(soon + "A" * 80 + "PPP"))
    first, _, second, _, third = (item.alarm for item in happened)
    assert first.id == second.id
    assert (first.count, second.count, third.count) == (1, 2, 1)
    assert third.id > first.id
    assert book.alarms == (third,)


def test_a_forgotten_alarm_leaves_the_book() -> None:
    book, _ = run(at_1_hz("PPP" + "A" * 100))
    assert book.entries == {}


def test_single_readings_far_apart_need_a_second_one() -> None:
    quarter_hours = [(T0 + 900.0 * k, truth) for k, truth in enumerate("APPAA")]
    _, happened = run(quarter_hours)
    assert times(happened) == [(1800.0, Change.RAISED), (3600.0, Change.CLEARED)]


def test_zero_delays_act_at_once() -> None:
    rules = AlarmRules(on_delay_s=0.0, off_delay_s=0.0)
    _, happened = run(at_1_hz("APAP"), rules)
    assert [item.change for item in happened] == [Change.RAISED, Change.CLEARED, Change.RAISED]


def test_each_kind_may_have_delays_of_its_own() -> None:
    rules = AlarmRules(
        on_delays_s={AlarmKind.METER_MANIPULATED: 0.0}, off_delays_s={AlarmKind.METER_MANIPULATED: 1.0}
    )
    _, happened = run(at_1_hz("PAA"), rules)
    assert times(happened) == [(0.0, Change.RAISED), (2.0, Change.CLEARED)]
    assert rules.on(AlarmKind.DATA_LOSS) == 2.0
    assert rules.off(AlarmKind.DATA_LOSS) == 5.0


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_rules_refuse_impossible_times(bad: float) -> None:
    with refused(InputInvalid, "negative"):
        AlarmRules(on_delay_s=bad)
    with refused(InputInvalid, "negative"):
        AlarmRules(off_delays_s={AlarmKind.UNDECIDED: bad})
    with refused(InputInvalid, "negative"):
        AlarmRules(silence_s=bad)


def test_for_want_of_readings_is_told_later_than_silence() -> None:
    for unheard, expected in ((False, 2.0), (True, 11.0)):
        book, rules, happened = AlarmBook(FEEDER), AlarmRules(silence_s=10.0), []
        condition = Condition(AlarmKind.UNDECIDED, FEEDER, None, Severity.MAJOR, unheard=unheard)
        for k in range(20):
            book, new = advance(book, rules, [condition], T0 + k)
            happened += new
        assert times(happened) == [(expected, Change.RAISED)]


def test_a_clock_set_back_holds() -> None:
    ticks = [(T0, "P"), (T0 + 1, "P"), (T0 - 3600, "P"), (T0 - 3599, "P")]
    _, happened = run(ticks)
    assert [item.t for item in happened] == [T0 - 3599]


@pytest.mark.parametrize(("back_s", "count"), [(40.0, 2), (3600.0, 1)])
def test_what_cleared_at_a_time_far_ahead_is_not_remembered(back_s: float, count: int) -> None:
    book, happened = run(at_1_hz("PPP" + 6 * "A"))
    assert times(happened) == [(2.0, Change.RAISED), (8.0, Change.CLEARED)]
    _, (again,) = run([(T0 - back_s + k, "P") for k in range(4)], book=book)
    assert again.alarm.count == count


def test_conditions_of_another_feeder_are_refused() -> None:
    with refused(InputInvalid, "other-feeder"):
        advance(AlarmBook("town"), RULES, tick("P"), T0)
    _, happened = run(at_1_hz("PPP"))
    with refused(InputInvalid, "other-feeder"):
        restore("town", [happened[0].alarm])


def test_meters_do_not_disturb_each_other_and_the_order_is_repeatable() -> None:
    book = AlarmBook(FEEDER)
    happened: list[AlarmTransition] = []
    for k in range(4):
        names = ["m2", None, "m1"] if k else ["m1"]
        book, new = advance(book, RULES, [c for name in names for c in tick("P", name)], T0 + k)
        happened += new
    assert [(item.t - T0, item.alarm.meter) for item in happened] == [(2.0, "m1"), (3.0, None), (3.0, "m2")]
    assert len({item.alarm.id for item in happened}) == 3


# ------------------------------------------------------------------ properties

steps = st.lists(
    st.tuples(st.sampled_from([0.25, 0.5, 1.0, 2.0, 3.0]), st.sampled_from("PPPAAAU")),
    max_size=60,
)

delays = st.sampled_from([0.0, 0.25, 1.0, 2.0, 5.0])

rules_of = st.builds(
    AlarmRules, on_delay_s=delays, off_delay_s=delays, memory_s=st.sampled_from([0.0, 4.0, 600.0])
)


def clocked(moves: list[tuple[float, str]]) -> list[Tick]:
    ticks, t = [], T0
    for dt, truth in moves:
        t += dt
        ticks.append((t, truth))
    return ticks


def seen_for(ticks: Sequence[Tick], k: int, truth: str) -> float:
    """Seconds for which ticks that say `truth` stand, back to the last one that says otherwise.

    Each stands until the next tick, unless that says otherwise.
    """
    first = k
    while first > 0 and ticks[first - 1][1] in (truth, "U"):
        first -= 1
    return sum(b[0] - a[0] for a, b in pairwise(ticks[first : k + 1]) if a[1] == truth)


def oracle(ticks: Sequence[Tick], rules: AlarmRules) -> list[tuple[float, Change]]:
    active, happened = False, []
    for k, (t, truth) in enumerate(ticks):
        if not active and truth == "P" and seen_for(ticks, k, "P") >= rules.on_delay_s:
            active = True
            happened.append((t - T0, Change.RAISED))
        elif active and truth == "A" and seen_for(ticks, k, "A") >= rules.off_delay_s:
            active = False
            happened.append((t - T0, Change.CLEARED))
    return happened


@given(steps, rules_of)
def test_transitions_are_those_of_the_definition(moves: list[tuple[float, str]], rules: AlarmRules) -> None:
    ticks = clocked(moves)
    _, happened = run(ticks, rules)
    assert times(happened) == oracle(ticks, rules)


@given(steps, rules_of)
def test_never_too_early(moves: list[tuple[float, str]], rules: AlarmRules) -> None:
    ticks = clocked(moves)
    _, happened = run(ticks, rules)
    for item in happened:
        against = "A" if item.change is Change.RAISED else "P"
        delay = rules.on_delay_s if item.change is Change.RAISED else rules.off_delay_s
        counter = [t for t, truth in ticks if truth == against and t <= item.t]
        begun = min(t for t, truth in ticks if truth not in (against, "U") and t > max(counter, default=0.0))
        assert item.t - begun >= delay
    assert all(a.change != b.change for a, b in pairwise(happened))


@given(steps, rules_of)
def test_a_replay_gives_the_same(moves: list[tuple[float, str]], rules: AlarmRules) -> None:
    ticks = clocked(moves)
    assert run(ticks, rules) == run(ticks, rules)


@given(steps, rules_of, st.integers(0, 60))
def test_ticks_that_know_nothing_change_nothing(
    moves: list[tuple[float, str]], rules: AlarmRules, extra: int
) -> None:
    book, _ = run(clocked(moves), rules)
    t = book.t or T0
    after, happened = run([(t + k, "U") for k in range(extra)], rules, book)
    assert happened == []
    assert after.alarms == book.alarms


@given(steps, steps, rules_of, st.booleans())
def test_a_restart_keeps_every_alarm_and_continues(
    before: list[tuple[float, str]], after: list[tuple[float, str]], rules: AlarmRules, answer: bool
) -> None:
    ticks = clocked(before + after)
    head, tail = ticks[: len(before)], ticks[len(before) :]
    book, _ = run(head, rules)
    if answer and book.active and book.active[0].state is AlarmState.RAISED:
        book, _ = acknowledge(book, book.active[0].id, "Ada", "seen", T0)
    again = restore(FEEDER, [from_json(to_json(alarm)) for alarm in book.alarms])
    assert again.alarms == book.alarms
    at_rest = all(e.present == (e.alarm is not None and e.alarm.active) for e in book.entries.values())
    there, here = run(tail, rules, again), run(tail, rules, book)
    if at_rest:
        assert there[1] == here[1]
        assert there[0].alarms == here[0].alarms
    # With a clock running, the restart is one more tick that knows nothing: it starts that clock anew, so
    # nothing comes earlier than without the restart.
    elif there[1]:
        assert here[1]
        assert there[1][0].t >= here[1][0].t


# -------------------------------------------------------------- acknowledgement


def raised() -> tuple[AlarmBook, Alarm]:
    book, happened = run(at_1_hz("PPP"))
    return book, happened[0].alarm


def test_acknowledging_keeps_the_alarm_and_says_who() -> None:
    book, alarm = raised()
    book, item = acknowledge(book, alarm.id, "Ada", "on my way", T0 + 10)
    assert item == AlarmTransition(book.active[0], Change.ACKNOWLEDGED, T0 + 10, "Ada", "on my way")
    assert item.alarm == replace(
        alarm,
        state=AlarmState.ACKNOWLEDGED,
        acknowledged_by="Ada",
        t_acknowledged=T0 + 10,
        comment="on my way",
    )


def test_the_second_operator_is_told_who_was_first() -> None:
    book, alarm = raised()
    book, _ = acknowledge(book, alarm.id, "Ada", "", T0 + 10)
    with refused(AlreadyAcknowledged, "already-acknowledged") as caught:
        acknowledge(book, alarm.id, "Grace", "", T0 + 11)
    assert (caught.value.alarm.id, caught.value.alarm.acknowledged_by) == (alarm.id, "Ada")


def test_an_unknown_alarm_cannot_be_acknowledged() -> None:
    book, alarm = raised()
    with refused(AlarmUnknown, "unknown-alarm"):
        acknowledge(book, "nothing", "Ada", "", T0)
    pending, _ = run(at_1_hz("P"))
    with pytest.raises(AlarmUnknown):
        acknowledge(pending, alarm.id, "Ada", "", T0)


def test_an_acknowledged_alarm_clears_and_remembers_who() -> None:
    book, alarm = raised()
    book, _ = acknowledge(book, alarm.id, "Ada", "", T0 + 10)
    book, (cleared,) = run([(T0 + 20 + k, "A") for k in range(6)], book=book)
    assert (cleared.alarm.state, cleared.alarm.acknowledged_by) == (AlarmState.CLEARED, "Ada")
    book, (again,) = run([(T0 + 30 + k, "P") for k in range(3)], book=book)
    assert (again.alarm.id, again.alarm.count) == (alarm.id, 2)
    assert (again.alarm.state, again.alarm.acknowledged_by) == (AlarmState.RAISED, None)


def test_a_cleared_alarm_can_still_be_answered_and_stays_cleared() -> None:
    book, alarm = raised()
    book, _ = run([(T0 + 20 + k, "A") for k in range(6)], book=book)
    book, item = acknowledge(book, alarm.id, "Ada", "", T0 + 30)
    assert (item.alarm.state, item.alarm.acknowledged_by) == (AlarmState.CLEARED, "Ada")
    with pytest.raises(AlreadyAcknowledged):
        acknowledged(book.alarms[0], "Grace", "", T0 + 31)


def test_an_answer_to_an_earlier_occurrence_is_refused() -> None:
    _, alarm = raised()
    later = replace(alarm, count=3)
    with refused(RaisedAgain, "raised-again") as caught:
        acknowledged(later, "Ada", "", T0, count=1)
    assert caught.value.alarm is later
    assert acknowledged(later, "Ada", "", T0, count=3).alarm.acknowledged_by == "Ada"


@pytest.mark.parametrize("ended", [False, True])
def test_an_acknowledgement_is_withdrawn_once(ended: bool) -> None:
    book, alarm = raised()
    book, answered = acknowledge(book, alarm.id, "Ada", "seen", T0 + 10)
    if ended:
        book, (answered, *_) = run([(T0 + 20 + k, "A") for k in range(6)], book=book)
    withdrawn = unacknowledged(answered.alarm, "Grace", "not yet", T0 + 30)
    assert (withdrawn.change, withdrawn.who, withdrawn.comment) == (
        Change.UNACKNOWLEDGED, "Grace", "not yet",
    )  # fmt: skip
    state = AlarmState.CLEARED if ended else AlarmState.RAISED
    assert (withdrawn.alarm.state, withdrawn.alarm.acknowledged_by) == (state, None)
    with refused(NotAcknowledged, "not-acknowledged") as caught:
        unacknowledged(withdrawn.alarm, "Grace", "", T0 + 31)
    assert caught.value.alarm is withdrawn.alarm


def test_a_stored_answer_is_carried_to_its_occurrence_only() -> None:
    book, alarm = raised()
    answered = acknowledged(alarm, "Ada", "", T0 + 10).alarm
    for other in (replace(answered, count=2), replace(answered, id="Z" * 26)):
        assert carry(book, other) is None
        assert carried(alarm, other) is alarm
    after = carry(book, answered)
    assert after is not None
    assert after.active == (answered,)
    withdrawn = unacknowledged(answered, "Ada", "", T0 + 11).alarm
    assert carried(answered, withdrawn) == alarm
    # The alarm has cleared meanwhile.
    ended = replace(alarm, state=AlarmState.CLEARED, t_cleared=T0 + 9)
    assert (carried(ended, answered).state, carried(ended, answered).acknowledged_by) == (
        AlarmState.CLEARED, "Ada",
    )  # fmt: skip


def test_skipped_ticks_hold_every_clock() -> None:
    book, _ = run(at_1_hz("P"))
    held = hold(book, T0 + 1)
    assert times(run([(T0 + 9, "P")], book=book)[1]) == [(9.0, Change.RAISED)]
    assert run([(T0 + 9, "P")], book=held)[1] == []
    (item,) = run([(T0 + 9, "P"), (T0 + 10, "P")], book=held)[1]
    assert times([item]) == [(10.0, Change.RAISED)]


def test_an_error_of_the_files_updates_the_evidence_when_it_is_new() -> None:
    """Also another kind, other customers or another proposal; the same error, or none, changes nothing."""
    first = DataErrorReport(DataErrorKind.PHASE, ("m1",), ("Miller", "Smith"), ("phase b",), "study", "text")
    steps = [
        (None, False),
        (first, True),
        (replace(first, text="other words", customers=("Smith", "Miller")), False),
        (None, False),
        (replace(first, proposed=("phase c",)), True),
        (replace(first, kind=DataErrorKind.BUS), True),
        (replace(first, kind=DataErrorKind.BUS, customers=("Miller",)), True),
    ]
    book, alarm = raised()
    for k, (error, updates) in enumerate(steps):
        (condition,) = tick("P")
        now = replace(condition, evidence=AlarmEvidence(data_error=error), reason=f"why {k}")
        book, happened = advance(book, RULES, [now], T0 + 10 + k)
        assert [item.change for item in happened] == [Change.UPDATED] * updates, k
        (standing,) = book.active
        assert (standing.id, standing.count, standing.t_raised) == (alarm.id, 1, alarm.t_raised)
        assert (standing.reason == f"why {k}") == updates


def test_alarms_without_a_monitor_are_closed() -> None:
    _, alarm = raised()
    ended = replace(alarm, id="Z" * 26, state=AlarmState.CLEARED, t_cleared=T0)
    (item,) = close([alarm, ended], T0 + 9, "removed")
    assert (item.alarm.id, item.change, item.comment) == (alarm.id, Change.CLEARED, "removed")
    assert (item.alarm.state, item.alarm.t_cleared) == (AlarmState.CLEARED, T0 + 9)


def test_another_feeder_has_no_place_in_a_book() -> None:
    _, alarm = raised()
    with refused(InputInvalid, "other-feeder"):
        restore("elsewhere", [alarm])
    with refused(InputInvalid, "other-feeder"):
        advance(AlarmBook("elsewhere"), RULES, tick("P"), T0)


def test_restore_takes_the_latest_of_a_kind() -> None:
    _, first = raised()
    later = replace(first, id="Z" * 26, count=7)
    assert restore(FEEDER, [later, first]).alarms == (later,)


def test_restore_takes_what_stands_before_what_began_later_and_has_cleared() -> None:
    """A clock that was ahead and has been set right: what began before that has the later times."""
    _, stands = raised()
    ahead = replace(stands, id="Z" * 26, t_raised=T0 + 3600)
    cleared = replace(ahead, state=AlarmState.CLEARED, t_cleared=T0 + 3700)
    for order in ([stands, cleared], [cleared, stands]):
        assert restore(FEEDER, order).alarms == (stands,)
    again = replace(stands, id="0" * 26, t_raised=T0 + 60)
    assert restore(FEEDER, [again, stands, cleared]).alarms == (again,)


# ------------------------------------------------------------------------- ids


def test_ids_are_ulids_that_sort_by_time() -> None:
    alphabet = set("0123456789ABCDEFGHJKMNPQRSTVWXYZ")
    ids = [run([(t + k, "P") for k in range(3)])[1][0].alarm.id for t in (0.0, 1.0, T0, T0 + 0.001, 4e9)]
    assert all(len(name) == 26 and set(name) <= alphabet for name in ids)
    assert ids == sorted(ids)
    # The first ten characters are the milliseconds in base 32, most significant first.
    digits = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
    value = 0
    for character in ids[2][:10]:
        value = value * 32 + digits.index(character)
    assert value == T0 * 1000


def test_json_and_back() -> None:
    _, alarm = raised()
    data = to_json(alarm)
    assert data["kind"] == "meter-manipulated"
    assert type(data["state"]) is str
    assert from_json({**data, "unknown": 1}) == alarm
    shown = (ExplanationReport(("m1", "m2"), ("Miller",), 0.5, ("Smith",)),)
    rich = replace(alarm, customer="Miller", evidence=AlarmEvidence(kind="stuck", explanations=shown))
    assert from_json(json.loads(json.dumps(to_json(rich)))) == rich


def test_json_from_before_inverters_had_alarms() -> None:
    _, alarm = raised()
    data = to_json(alarm)
    del data["customer"]
    old = ("score", "threshold", "v_volt_reported", "v_volt_estimated", "attack_volt_estimated")
    data["evidence"] = {name: data["evidence"][name] for name in old}
    assert from_json(data) == alarm
