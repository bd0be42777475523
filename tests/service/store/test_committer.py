"""What waits for the database is bounded, and no alarm's state is ever lost by it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridsec.interface import Cause, Decision
from service.alarms.state_machine import (
    Alarm,
    AlarmEvidence,
    AlarmKind,
    AlarmState,
    AlarmTransition,
    Change,
    Severity,
)
from service.report.report import FeederReport
from service.store import Rejected, committer
from service.store.committer import WriteQueue

KIND, LEVEL = AlarmKind.METER_MANIPULATED, Severity.CRITICAL
RAISED = Alarm("", KIND, "f", "m", LEVEL, AlarmState.RAISED, 1, 0, 0, None, "", AlarmEvidence(),
    None, None, None)  # fmt: skip


def raised(name: str, count: int = 1, by: str | None = None) -> AlarmTransition:
    return AlarmTransition(replace(RAISED, id=name, count=count, acknowledged_by=by), Change.RAISED, 0.0)


def cleared(name: str, count: int = 1, by: str | None = None) -> AlarmTransition:
    alarm = replace(RAISED, id=name, count=count, state=AlarmState.CLEARED, t_cleared=1.0, acknowledged_by=by)
    return AlarmTransition(alarm, Change.CLEARED, 1.0)


def report(t: float) -> FeederReport:
    return FeederReport("f", t, Decision.CLEAN, "", Cause.AGREEMENT, 1, (), (), (), 0.0, 1.0)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(committer, "TRANSITIONS_KEPT", 20)
    monkeypatch.setattr(committer, "RECORDS_KEPT", 5)


@pytest.mark.usefixtures("small")
def test_a_flapping_alarm_keeps_its_newest_state() -> None:
    lost: Counter[str] = Counter()
    book = WriteQueue(lambda what, count: lost.update({what: count}))
    for count in range(1, 100):
        book.add(transitions=[raised("a", count), cleared("a", count)])
    book.add(transitions=[raised("a", 100)])
    assert len(book) <= 20
    batch = book.take()
    assert batch.transitions[-1].alarm == raised("a", 100).alarm
    assert len(book) == len(batch.transitions)
    assert lost["transition"] == book.given_up == 199 - len(batch.transitions)
    book.stored()
    assert (book.given_up, len(book)) == (0, 0)


@pytest.mark.usefixtures("small")
def test_alarms_that_came_and_went_unheard_go_first_and_are_counted() -> None:
    lost: Counter[str] = Counter()
    book = WriteQueue(lambda what, count: lost.update({what: count}))
    # The database knows these: one has been answered, one cleared unanswered while the database was away.
    book.add(transitions=[cleared("answered", 1, "Ada"), cleared("known", 3), raised("standing")])
    for k in range(200):
        book.add(transitions=[raised(f"n{k:03}"), cleared(f"n{k:03}")])
        assert len(book) <= 20
    last = {item.alarm.id: item.alarm.state for item in book.take().transitions}
    assert last["answered"] == last["known"] == AlarmState.CLEARED
    assert last["standing"] == AlarmState.RAISED
    assert last["n199"] == AlarmState.CLEARED
    assert lost["transition"] == book.given_up > 300


@pytest.mark.usefixtures("small")
def test_what_stands_is_kept_beyond_the_limit() -> None:
    book = WriteQueue(lambda *_: None)
    book.add(transitions=[raised(f"s{k}") for k in range(100)])
    book.add(transitions=[raised(f"s{k}", 2) for k in range(150)])
    assert {item.alarm.id for item in book.take().transitions} == {f"s{k}" for k in range(150)}


@pytest.mark.usefixtures("small")
def test_records_that_were_not_stored_come_back_in_order_and_the_oldest_go() -> None:
    lost: Counter[str] = Counter()
    book = WriteQueue(lambda what, count: lost.update({what: count}))
    book.add(reports=[report(t) for t in (1.0, 2.0, 3.0)], rejected=[Rejected(1.0, "k", "r")])
    first = book.take()
    book.add(reports=[report(t) for t in (4.0, 5.0, 6.0)])
    book.give_back(first)
    batch = book.take()
    assert [r.t for r in batch.reports] == [2.0, 3.0, 4.0, 5.0, 6.0]
    assert batch.rejected == first.rejected
    assert lost == {"report": 1}


Steps = st.lists(
    st.sampled_from("abcdefghij0123456789") | st.sampled_from(["take", "store", "fail"]), max_size=150
)


@given(Steps)
def test_the_database_ends_with_the_state_of_every_alarm_that_stands(steps: list[str]) -> None:
    """Alarms flip at random while the database comes and goes; a dictionary is the oracle."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(committer, "TRANSITIONS_KEPT", 8)
        book = WriteQueue(lambda *_: None)
        truth: dict[str, Alarm] = {}
        database: dict[str, Alarm] = {}
        flying = None
        for step in [*steps, "store", "take", "store"]:
            if step == "take":
                flying = book.take() if flying is None else flying
            elif step == "fail" and flying is not None:
                book.give_back(flying)
                flying = None
            elif step == "store" and flying is not None:
                database.update((item.alarm.id, item.alarm) for item in flying.transitions)
                book.stored()
                flying = None
            elif len(step) == 1:
                old = truth.get(step)
                count = 1 if old is None else old.count + (not old.active)
                item = cleared(step, count) if old is not None and old.active else raised(step, count)
                truth[step] = item.alarm
                book.add(transitions=[item])
        assert {k for k, a in database.items() if a.active} == {k for k, a in truth.items() if a.active}
        assert all(database[name] == truth[name] for name in database)
