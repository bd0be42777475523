"""Incidents: grouping of alarms, shelves, planned work. The oracle recounts the alarms of each incident."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridsec.interface import Cause
from service.alarms.incidents import (
    Assign,
    Comment,
    EndWork,
    Incident,
    IncidentBook,
    IncidentChange,
    IncidentChanged,
    IncidentEvent,
    IncidentKind,
    IncidentState,
    IncidentTransition,
    IncidentUnknown,
    PlannedWork,
    Shelf,
    ShelfUnknown,
    Unshelve,
    WorkUnknown,
    advance,
    cause_of,
    due,
    event_json,
    incident_json,
    incident_of,
)
from service.alarms.state_machine import (
    Alarm,
    AlarmKind,
    AlarmState,
    AlarmTransition,
    Change,
    Severity,
    acknowledged,
    commented,
    conditions,
    unacknowledged,
)
from tests.codes import refused
from tests.service.reports import FEEDER, meter, report
from tests.service.stored import T0, an_alarm, raised

MANIPULATED, LOST, UNDECIDED = AlarmKind.METER_MANIPULATED, AlarmKind.DATA_LOSS, AlarmKind.UNDECIDED
C = IncidentChange


def alarm(number: int, t: float = T0, **changes: object) -> Alarm:
    return an_alarm(number, t_event=t - 2, t_raised=t, meter=f"m{number}", **changes)


def cleared(one: Alarm, t: float) -> AlarmTransition:
    return AlarmTransition(replace(one, state=AlarmState.CLEARED, t_cleared=t), Change.CLEARED, t)


def again(one: Alarm, t: float) -> AlarmTransition:
    return raised(replace(one, state=AlarmState.RAISED, t_raised=t, count=one.count + 1))


def run(
    *steps: AlarmTransition, now: float = T0, book: IncidentBook | None = None
) -> tuple[IncidentBook, list[IncidentTransition]]:
    """The book after single steps, each in a commit of its own."""
    book, happened = book or IncidentBook("village"), []
    for step in steps:
        book, new = advance(book, [step], now)
        happened += new
    return book, happened


def changes(happened: Sequence[IncidentTransition]) -> list[IncidentChange]:
    return [item.change for item in happened]


def only(book: IncidentBook) -> Incident:
    (incident,) = book.incidents.values()
    return incident


def test_forty_alarms_of_one_attack_are_one_incident_with_one_opening() -> None:
    attack = [raised(alarm(k, T0 + 0.5 * k)) for k in range(40)]
    book, happened = advance(IncidentBook("village"), attack, T0)
    incident = only(book)
    assert changes(happened) == [C.OPENED]
    assert (incident.alarms, incident.active, incident.unacknowledged, incident.count) == (40, 40, 40, 40)
    assert incident.meters == tuple(f"m{k}" for k in range(40))
    assert (incident.kind, incident.severity) == (IncidentKind.MANIPULATION, Severity.CRITICAL)
    assert (incident.t_first, incident.t_last, incident.t_cleared) == (T0 - 2, T0 + 19.5, None)
    one_by_one, grown = run(*attack)
    assert one_by_one == book
    assert changes(grown) == [C.OPENED] + [C.EXTENDED] * 39
    book, happened = advance(book, [cleared(item.alarm, T0 + 100) for item in attack], T0 + 100)
    assert changes(happened) == [C.CLEARED]
    assert (only(book).state, only(book).t_cleared) == (IncidentState.CLEARED, T0 + 100)


@pytest.mark.parametrize(("gap", "count"), [(59.0, 1), (60.0, 1), (61.0, 2), (-59.0, 1), (-61.0, 2)])
def test_the_window_is_a_minute(gap: float, count: int) -> None:
    book, _ = run(raised(alarm(1)), raised(alarm(2, T0 + gap)))
    assert len(book.incidents) == count


def test_slow_feeders_have_a_wider_window() -> None:
    slow = replace(raised(alarm(2, T0 + 900)), window_s=1800.0)
    assert len(run(raised(alarm(1)), slow)[0].incidents) == 1


def test_causes_are_separate_and_undecided_belongs_to_both() -> None:
    steps = [
        raised(alarm(1)),
        raised(alarm(2, kind=LOST, severity=Severity.MINOR)),
        raised(alarm(3, kind=AlarmKind.VOLTAGE_LIMIT)),
        raised(alarm(4, kind=AlarmKind.CLOCK_OFFSET)),
    ]
    assert len(run(*steps)[0].incidents) == 4
    for other, kind in ((MANIPULATED, IncidentKind.MANIPULATION), (LOST, IncidentKind.DATA_LOSS)):
        two = [raised(alarm(1, kind=UNDECIDED)), raised(alarm(2, T0 + 5, kind=other))]
        for order in (two, two[::-1]):
            assert only(run(*order)[0]).kind is kind
    assert {cause_of(kind) for kind in AlarmKind} == set(IncidentKind)


def test_a_flapping_alarm_reopens_its_incident_and_a_recent_one_takes_it() -> None:
    one = alarm(1)
    book, happened = run(raised(one), cleared(one, T0 + 10), again(one, T0 + 300))
    assert changes(happened) == [C.OPENED, C.CLEARED, C.REOPENED]
    assert (only(book).count, only(book).alarms, only(book).state) == (2, 1, IncidentState.RAISED)
    # Another incident is open when the alarm returns: it belongs to the present cause.
    other = alarm(2, T0 + 290)
    book, happened = run(raised(one), cleared(one, T0 + 10), raised(other), again(one, T0 + 300))
    first, second = sorted(book.incidents.values(), key=lambda each: each.t_first)
    assert (first.alarms, second.alarms, second.count) == (0, 2, 2)
    assert changes(happened) == [C.OPENED, C.CLEARED, C.OPENED, C.EXTENDED]


def test_severity_rises_and_stays() -> None:
    minor, major = alarm(1, kind=LOST, severity=Severity.MINOR), alarm(2, kind=LOST, severity=Severity.MAJOR)
    book, happened = run(raised(minor), raised(replace(major, reason="worse")), cleared(major, T0 + 9))
    assert changes(happened) == [C.OPENED, C.ESCALATED, C.UPDATED]
    assert (only(book).severity, only(book).reason) == (Severity.MAJOR, "worse")


def test_acknowledging_all_withdrawing_one_and_raising_another() -> None:
    one, two = alarm(1), alarm(2)
    yes = [acknowledged(each, "Ada", "van sent", T0 + 5) for each in (one, two)]
    book, happened = run(raised(one), raised(two), *yes)
    assert changes(happened)[2:] == [C.UPDATED, C.ACKNOWLEDGED]
    assert (happened[-1].who, happened[-1].comment, happened[-1].t) == ("Ada", "van sent", T0 + 5)
    assert (only(book).state, only(book).acknowledged_by) == (IncidentState.ACKNOWLEDGED, "Ada")
    both, at_once = advance(run(raised(one), raised(two))[0], yes, T0 + 5)
    assert (changes(at_once), both) == ([C.ACKNOWLEDGED], book)
    back = unacknowledged(yes[0].alarm, "Eve", "not yet", T0 + 8)
    book, happened = run(back, book=book)
    assert changes(happened) == [C.UNACKNOWLEDGED]
    assert (happened[0].who, only(book).state, only(book).acknowledged_by) == ("Eve", "raised", None)
    book, happened = run(raised(alarm(3)), book=both)
    assert (changes(happened), only(book).state) == ([C.EXTENDED], IncidentState.RAISED)


def test_a_comment_on_an_alarm_changes_no_incident() -> None:
    _book, happened = run(raised(alarm(1)), commented(alarm(1), "Ada", "seen", T0 + 1))
    assert changes(happened) == [C.OPENED]


def test_an_alarm_without_its_raising_has_an_opening_and_an_end() -> None:
    """A full queue keeps the newest transition of an alarm only."""
    book, happened = run(cleared(alarm(1), T0 + 9))
    assert changes(happened) == [C.OPENED, C.CLEARED]
    book, happened = run(acknowledged(replace(alarm(1), count=2), "Ada", "", T0 + 20), book=book)
    assert (changes(happened), only(book).count) == ([C.REOPENED], 2)


# ------------------------------------------------------------------ shelves


def shelf(until: float = T0 + 3600, **given: object) -> Shelf:
    made = Shelf("S" * 26, "village", None, None, None, None, Severity.CRITICAL, "Ada", "known", T0, until)
    return replace(made, **given)  # type: ignore[arg-type]


def act(book: IncidentBook, action: object, now: float = T0) -> tuple[IncidentBook, list[IncidentTransition]]:
    book, happened = advance(book, [], now, [action])  # type: ignore[list-item]
    return book, list(happened)


def test_a_shelf_suppresses_until_its_end() -> None:
    book, _ = run(raised(alarm(1)), raised(alarm(2)))
    book, happened = act(book, shelf(incident=only(book).id))
    assert (changes(happened), happened[0].notify, happened[0].who) == ([C.SHELVED], False, "Ada")
    assert (happened[0].comment, only(book).shelved_until, due(book)) == ("known", T0 + 3600, T0 + 3600)
    # A further alarm of the incident is shelved too.
    book, happened = run(raised(alarm(3)), book=book)
    assert (changes(happened), happened[0].notify) == ([C.EXTENDED], False)
    book, happened = run(now=T0 + 3599, book=book)
    assert advance(book, [], T0 + 3599) == (book, ())
    book, ended = advance(book, [], T0 + 3600)
    assert (changes(ended), ended[0].notify, ended[0].who) == ([C.UNSHELVED], True, None)
    assert (only(book).shelved_until, due(book)) == (None, None)


def test_a_shelf_of_one_meter_leaves_the_others() -> None:
    book, _ = run(raised(alarm(1)))
    book, happened = act(book, shelf(meter="m1"))
    assert changes(happened) == [C.SHELVED]
    book, happened = run(raised(alarm(2)), book=book)
    assert (happened[0].notify, only(book).shelved_until) == (True, None)
    book, _ = run(cleared(alarm(2), T0 + 5), book=book)
    assert only(book).shelved_until == T0 + 3600


def test_a_shelf_of_a_kind_covers_later_incidents() -> None:
    book, happened = act(IncidentBook("village"), shelf(kind=LOST, severity=Severity.MINOR))
    assert happened == []
    book, happened = run(raised(alarm(1, kind=LOST, severity=Severity.MINOR)), book=book)
    assert (changes(happened), happened[0].notify) == ([C.OPENED], False)
    _, happened = run(raised(alarm(2)), book=book)
    assert happened[0].notify


def test_a_higher_severity_ends_a_shelf_of_all_its_incidents() -> None:
    minor = {"kind": LOST, "severity": Severity.MINOR}
    book, _ = act(IncidentBook("village"), shelf(kind=LOST, severity=Severity.MINOR))
    book, _ = run(raised(alarm(1, **minor)), raised(alarm(2, T0 + 300, **minor)), book=book)
    book, happened = run(raised(alarm(3, T0 + 310, kind=LOST, severity=Severity.MAJOR)), book=book)
    assert [(item.change, item.notify) for item in happened] == [(C.ESCALATED, True), (C.UNSHELVED, True)]
    (ended,) = book.shelves.values()
    assert (ended.escalated, ended.t_ended, ended.ended_by) == (True, T0, None)


def test_a_shelf_ends_early_once() -> None:
    book, _ = run(raised(alarm(1)))
    book, _ = act(book, shelf(alarm=alarm(1).id))
    book, happened = act(book, Unshelve("village", "S" * 26, "Eve", "back"))
    assert [(i.change, i.who, i.comment, i.notify) for i in happened] == [(C.UNSHELVED, "Eve", "back", True)]
    # It ended between the request and its turn.
    assert act(book, Unshelve("village", "S" * 26, "Bob")) == (book, [])
    with refused(ShelfUnknown, "unknown-shelf"):
        act(book, Unshelve("village", "T" * 26, "Eve"))


def test_an_alarm_outside_of_the_shelf_ends_the_suppression_of_its_incident() -> None:
    one, two = alarm(1), alarm(2)
    book, _ = run(raised(one), raised(two))
    book, _ = run(cleared(two, T0 + 5), book=book)
    book, happened = act(book, shelf(meter="m1"))
    assert (changes(happened), only(book).notify) == ([C.SHELVED], False)
    book, happened = run(again(two, T0 + 300), now=T0 + 300, book=book)
    assert [(item.change, item.notify, item.t) for item in happened] == [(C.UNSHELVED, True, T0 + 300)]
    assert only(book).shelved_until is None
    # A further one: the incident notifies already.
    _, happened = run(raised(alarm(3, T0 + 310)), now=T0 + 310, book=book)
    assert changes(happened) == [C.EXTENDED]


def test_of_two_shelves_the_later_one_counts() -> None:
    book, _ = run(raised(alarm(1)))
    book, _ = act(book, shelf(T0 + 100, meter="m1"))
    book, happened = act(book, shelf(T0 + 200, meter="m1", id="T" * 26))
    assert (changes(happened), only(book).shelved_until) == ([C.SHELVED], T0 + 200)
    book, happened = act(book, Unshelve("village", "T" * 26, "Eve"))
    assert [(item.change, item.notify) for item in happened] == [(C.UPDATED, False)]
    assert only(book).shelved_until == T0 + 100


# ------------------------------------------------------------- planned work


def planned(t_from: float = T0 + 100, t_until: float = T0 + 200, **given: object) -> PlannedWork:
    made = PlannedWork("W" * 26, "village", t_from, t_until, "Ada", "cable renewed", T0)
    return replace(made, **given)  # type: ignore[arg-type]


def test_planned_work_marks_its_alarms_and_suppresses_until_its_end() -> None:
    book, _ = run(raised(alarm(1)))
    book, happened = act(book, planned())
    assert (happened, due(book)) == ([], T0 + 100)
    book, begun = advance(book, [], T0 + 100)
    assert [(i.change, i.notify, i.comment) for i in begun] == [(C.WORK_BEGUN, False, "cable renewed")]
    assert due(book) == T0 + 200
    later = alarm(2, T0 + 110, kind=LOST)
    book, happened = run(raised(later), now=T0 + 110, book=book)
    assert [(i.change, i.notify) for i in happened] == [(C.OPENED, False)]
    assert book.members[later.id].work == happened[0].incident.planned_work == "W" * 26
    assert book.members[alarm(1).id].work is None
    book, ended = advance(book, [], T0 + 200)
    assert [(i.change, i.notify) for i in ended] == [(C.WORK_ENDED, True)] * 2
    assert (due(book), book.works["W" * 26].t_ended) == (None, T0 + 200)


def test_planned_work_begins_at_once_and_ends_early() -> None:
    book, _ = run(raised(alarm(1)))
    book, happened = act(book, planned(T0 - 5))
    assert [(i.change, i.who) for i in happened] == [(C.WORK_BEGUN, "Ada")]
    book, happened = act(book, EndWork("village", "W" * 26, "Eve", "done"))
    assert [(i.change, i.who, i.notify) for i in happened] == [(C.WORK_ENDED, "Eve", True)]
    assert act(book, EndWork("village", "W" * 26, "Bob")) == (book, [])
    with refused(WorkUnknown, "unknown-planned-work"):
        act(book, EndWork("village", "V" * 26, "Eve"))


def test_missed_work_begins_and_ends_together() -> None:
    """The service was not running during the work."""
    book, _ = act(run(raised(alarm(1)))[0], planned())
    book, happened = advance(book, [], T0 + 1000)
    assert changes(happened) == [C.WORK_BEGUN, C.WORK_ENDED]
    assert only(book).planned_until is None


# ------------------------------------------------------- assignment, comments


def test_assignment_and_comments() -> None:
    book, _ = run(raised(alarm(1)))
    name = only(book).id
    book, happened = act(book, Assign("village", name, "Bob", "Ada", "please"))
    assert [(i.change, i.who, i.comment) for i in happened] == [(C.ASSIGNED, "Ada", "please")]
    book, happened = act(book, Comment("village", name, "Bob", "on site"), T0 + 60)
    assert [(i.change, i.who, i.comment, i.t) for i in happened] == [(C.COMMENTED, "Bob", "on site", T0 + 60)]
    assert only(book).assigned_to == "Bob"
    assert incident_of(incident_json(only(book))) == only(book)
    book, _ = act(book, Assign("village", name, None, "Ada"))
    assert only(book).assigned_to is None
    with refused(IncidentUnknown, "unknown-incident"):
        act(book, Comment("village", "X" * 26, "Bob", ""))


def test_an_event_as_json_and_an_answer_to_an_earlier_state() -> None:
    _, (opened,) = run(raised(alarm(1)))
    event = IncidentEvent(7, T0, opened.change, None, None, True, opened.incident)
    shown = event_json(event)
    assert (shown["seq"], shown["change"], shown["notify"]) == (7, "opened", True)
    assert incident_of(shown["incident"]) == opened.incident
    error = IncidentChanged(opened.incident, 3)
    assert (error.code, error.incident) == ("incident-changed", opened.incident)


# ------------------------------------------------------------ silence of a feeder


def silent(*names: str, of: int = 5, cause: Cause = Cause.TOO_FEW_METERS) -> dict[str | None, bool]:
    """Conditions of data loss, by meter, and whether they are known."""
    meters = [meter(f"m{k}", seen=f"m{k}" not in names) for k in range(of)]
    now = report(*meters, cause=cause, silent=tuple((name, 12.0) for name in names))
    found = [one for one in conditions(now) if one.kind is LOST]
    assert all(one.feeder == FEEDER for one in found)
    return {one.meter: one.known for one in found}


def test_the_silence_of_most_meters_is_one_condition() -> None:
    assert silent("m0", "m1") == {"m0": True, "m1": True}
    assert silent("m0", "m1", of=2) == {"m0": True, "m1": True}
    assert silent("m0", "m1", "m2") == {None: True, "m0": False, "m1": False, "m2": False}
    assert silent("m0", "m1", "m2", of=6) == {"m0": True, "m1": True, "m2": True}


@pytest.mark.parametrize("connecting", [False, True])
@pytest.mark.parametrize("cause", [Cause.AMBIGUOUS, Cause.DESIGN_INVALID, Cause.TOO_FEW_METERS])
def test_undecided_is_unknown_while_meters_connect(connecting: bool, cause: Cause) -> None:
    """A monitor that does not exist raises its alarm at once."""
    now = report(meter("m0"), meter("m1", seen=False), cause=cause)
    (found,) = [one for one in conditions(now, connecting=connecting) if one.kind is UNDECIDED]
    assert found.known == (not connecting or cause is Cause.DESIGN_INVALID)


# --------------------------------------------------------- any course of alarms

STEP = st.tuples(
    st.integers(0, 5), st.floats(0.0, 90.0), st.sampled_from(["toggle", "toggle", "toggle", "ack", "unack"])
)
KINDS = (MANIPULATED, MANIPULATED, LOST, LOST, UNDECIDED, AlarmKind.VOLTAGE_LIMIT)


def course(steps: Sequence[tuple[int, float, str]]) -> list[AlarmTransition]:
    """Transitions of six alarms as the alarms' state machine makes them."""
    t, alarms, out = T0, dict[int, Alarm](), list[AlarmTransition]()
    for k, wait, what in steps:
        t += wait
        old = alarms.get(k)
        if what == "toggle" and old is None:
            item = raised(alarm(k, t, kind=KINDS[k], severity=list(Severity)[k % 3]))
        elif what == "toggle" and old is not None:
            item = cleared(old, t) if old.active else again(replace(old, acknowledged_by=None), t)
        elif what == "ack" and old is not None and old.acknowledged_by is None:
            item = acknowledged(old, "Ada", "", t)
        elif what == "unack" and old is not None and old.acknowledged_by is not None:
            item = unacknowledged(old, "Eve", "", t)
        else:
            continue
        alarms[k] = item.alarm
        out.append(item)
    return out


@given(st.lists(STEP, max_size=25), st.lists(st.integers(0, 25), max_size=6))
def test_numbers_follow_the_alarms_and_commits_do_not_matter(
    steps: list[tuple[int, float, str]], cuts: list[int]
) -> None:
    transitions = course(steps)
    whole, _ = run(*transitions)
    parts, book = sorted({0, *cuts, len(transitions)}), IncidentBook("village")
    for begin, end in itertools.pairwise(parts):
        book, _ = advance(book, transitions[begin:end], T0)
    assert book == whole
    newest = {item.alarm.id: item.alarm for item in transitions}
    assert set(whole.members) == set(newest)
    raisings = sum(item.change is Change.RAISED for item in transitions)
    assert sum(incident.count for incident in whole.incidents.values()) == raisings
    for name, incident in whole.incidents.items():
        own = [newest[key] for key, member in whole.members.items() if member.incident == name]
        active = [one for one in own if one.active]
        assert incident.alarms == len(own)
        assert incident.active == len(active)
        assert incident.unacknowledged == sum(one.state is AlarmState.RAISED for one in active)
        assert incident.open == bool(active)
        assert (incident.state is IncidentState.ACKNOWLEDGED) == (
            bool(active) and all(one.state is AlarmState.ACKNOWLEDGED for one in active)
        )
        assert {one.meter for one in own} <= set(incident.meters)
        assert all(cause_of(one.kind) in {incident.kind, IncidentKind.UNDECIDED} for one in own)


@given(st.lists(STEP, max_size=25))
def test_every_opening_has_one_end(steps: list[tuple[int, float, str]]) -> None:
    """`opened` and `reopened` alternate with `cleared`; an event is that of the incident after it."""
    book, happened = run(*course(steps))
    for name, incident in book.incidents.items():
        own = [item for item in happened if item.incident.id == name]
        ends = [item.change for item in own if item.change in {C.OPENED, C.REOPENED, C.CLEARED}]
        assert ends[0] is C.OPENED
        assert all((one is C.CLEARED) != (two is C.CLEARED) for one, two in itertools.pairwise(ends))
        assert (ends[-1] is C.CLEARED) is not incident.open
        for item in own:
            assert (item.change is C.CLEARED) <= (not item.incident.open)
