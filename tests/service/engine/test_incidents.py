"""Incidents in rounds over a real database: grouping, publication, actions of operators, their times."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import Site
from service.alarms.incidents import (
    Incident,
    IncidentChange,
    IncidentChanged,
    IncidentUnknown,
    ShelfUnknown,
    WorkUnknown,
    WrongTime,
)
from service.alarms.state_machine import AlarmKind, AlarmUnknown, NotAcknowledged, Severity
from service.engine.engine import Engine
from service.engine.operators import SHELVE_MOST_S, ShelfRequest
from service.ingest.queues import Sample
from service.store import OutcomeUnknown, Store, StoreUnavailable
from tests.codes import refused
from tests.service.engine.test_silence import QUIET_VOLT, Street
from tests.service.liars import FEEDER, START, rounds, until
from tests.service.running import Outlet

C = IncidentChange


def of(answer: Future[Any]) -> Any:
    return answer.result(timeout=0)


def only(store: Store) -> Incident:
    (found,) = store.incidents()[0]
    return found


def changes(store: Store) -> list[tuple[str, bool]]:
    return [(str(event.change), event.notify) for event in store.incident_events_after(0, limit=1000)]


def test_an_attack_is_one_incident_published_after_it_is_stored(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    before, after = until(attacked, 15.0)
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, Outlet(confirms=False))
        live.cycle(before)
        assert (only(store).alarms, len(store.incidents_unpublished())) == (2, 1)
    outlet = Outlet()
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        live.cycle(after)
        live.cycle([])
        told = [(event["change"], event["incident"]["active"], last) for event, last in outlet.incidents]
        assert told == [("opened", 2, False), ("cleared", 0, True)]
        assert store.incidents_unpublished() == []
        assert changes(store) == [("opened", True), ("cleared", True)]
        number = store.last_incident_event
        live.cycle([])
        assert (store.last_incident_event, live.committer.storing) == (number, False)


class Replies(Outlet):
    """An outlet with the present replies to queries."""

    def __init__(self) -> None:
        super().__init__()
        self.present: set[str] = set()

    def event(self, key: str, payload: bytes, *, last: bool, **options: Any) -> bool:
        (self.present.discard if last else self.present.add)(key)
        return super().event(key, payload, last=last, **options)

    def withdraw(self, feeder: str) -> None:
        super().withdraw(feeder)
        self.present = {key for key in self.present if not key.startswith(f"{feeder}/")}


def test_a_left_feeder_has_no_replies_also_of_its_last_commit(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    first, later = until(until(attacked, 15.0)[0], 2.0)
    outlet = Replies()
    pending: list[Callable[[], None]] = []
    with Store(f"sqlite:///{path}") as store:
        live = rounds(store, site, outlet)
        live.committer._apart = lambda write, then: pending.append(lambda: then(write()))
        live.cycle(first)
        live.cycle(later)  # its alarms wait for the write in progress
        pending.pop()()
        assert store.active() == []
        answer = live.resign([FEEDER])
        assert len(outlet.withdrawn) == 1
        pending.pop()()
        of(answer)
        assert len(store.active()) == len(outlet.events) == 2
        assert len(outlet.incidents) == 1
        assert outlet.present == set()


@pytest.fixture
def live(site: Site, attacked: list[Sample], path: Path) -> Any:
    """Rounds with two alarms of one attack."""
    with Store(f"sqlite:///{path}") as store:
        made = rounds(store, site)
        made.cycle(until(attacked, 15.0)[0])
        yield made


def shelf(**given: Any) -> ShelfRequest:
    empty = dict.fromkeys(("feeder", "alarm", "incident", "meter", "kind", "severity"))
    return ShelfRequest(**{**empty, "duration_s": 60.0, "reason": "known", **given})


def test_answers_reach_the_book_of_alarms(live: Engine, attacked: list[Sample]) -> None:
    act, store, book = live.operators, live.store, lambda: live.monitors[FEEDER].book.active
    name = only(store).id
    found = of(act.acknowledge_incident(name, "Ada", "van sent", count=2))
    assert (found.unacknowledged, found.acknowledged_by) == (0, "Ada")
    assert [one.comment for one in book()] == ["van sent"] * 2
    found = of(act.unacknowledge_incident(name, "Eve", "not yet"))
    assert (found.unacknowledged, [one.state for one in book()]) == (2, ["raised"] * 2)
    ids = [one.id for one in book()]
    assert [one.acknowledged_by for one in of(act.acknowledge(ids[:1], "Ada", ""))] == ["Ada"]
    of(act.unacknowledge(ids[0], "Eve", ""))
    of(act.comment(ids[0], "Bob", "seen"))
    assert [one.acknowledged_by for one in book()] == [None, None]
    of(act.acknowledge(ids, "Ada", "again"))
    live.cycle(until(attacked, 15.0)[1])
    assert {one.acknowledged_by for one in store.alarms()[0]} == {"Ada"}
    assert [change for change, _ in changes(store)] == [
        C.OPENED, C.ACKNOWLEDGED, C.UNACKNOWLEDGED, C.UPDATED, C.UPDATED, C.ACKNOWLEDGED, C.CLEARED,
    ]  # fmt: skip


def test_unknown_and_outdated_requests_change_nothing(live: Engine) -> None:
    act, number, none = live.operators, live.store.last_incident_event, "0" * 26
    name, alarm = only(live.store).id, live.monitors[FEEDER].book.active[0].id
    wrong: list[tuple[Callable[[], Future[Any]], type[Exception], str]] = [
        (lambda: act.acknowledge([alarm, none], "Ada", ""), AlarmUnknown, "unknown-alarm"),
        (lambda: act.unacknowledge(alarm, "Ada", ""), NotAcknowledged, "not-acknowledged"),
        (lambda: act.acknowledge_incident(none, "Ada", ""), IncidentUnknown, "unknown-incident"),
        (lambda: act.acknowledge_incident(name, "Ada", "", count=1), IncidentChanged, "incident-changed"),
        (lambda: act.assign(none, "Bob", "Ada", ""), IncidentUnknown, "unknown-incident"),
        (lambda: act.comment_incident(none, "Ada", "x"), IncidentUnknown, "unknown-incident"),
        (lambda: act.shelve(shelf(alarm=none), "Ada"), AlarmUnknown, "unknown-alarm"),
        (lambda: act.shelve(shelf(incident=none), "Ada"), IncidentUnknown, "unknown-incident"),
        (lambda: act.shelve(shelf(incident=name, duration_s=9e9), "Ada"), WrongTime, "wrong-time"),
        (lambda: act.unshelve(none, "Ada", ""), ShelfUnknown, "unknown-shelf"),
        (lambda: act.end_work(none, "Ada", ""), WorkUnknown, "unknown-planned-work"),
        (lambda: act.plan_work(FEEDER, None, START - 1.0, "Ada", ""), WrongTime, "wrong-time"),
    ]
    for run, kind, code in wrong:
        with refused(kind, code):  # type: ignore[arg-type]
            of(run())
    assert live.store.last_incident_event == number
    assert act.shelve_most_s == SHELVE_MOST_S


def test_an_answer_that_cannot_be_read_is_refused_and_stays_stored(
    live: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, look, committed = only(live.store).id, Store.incident, Store.commit

    def fail(_store: Store, _number: str) -> Incident:
        raise StoreUnavailable("connection lost")

    def commit(store: Store, changes: Any, **given: Any) -> Any:
        """Store; only the read after the commit of the acknowledgements fails."""
        if changes:
            monkeypatch.setattr(Store, "incident", fail)
        return committed(store, changes, **given)

    monkeypatch.setattr(Store, "commit", commit)
    answer = live.operators.acknowledge_incident(name, "Ada", "van sent")
    with pytest.raises(OutcomeUnknown, match="is stored"):
        of(answer)
    monkeypatch.setattr(Store, "incident", look)
    found = live.store.incident(name)
    assert found is not None
    assert (found.unacknowledged, found.acknowledged_by) == (0, "Ada")
    assert {one.acknowledged_by for one in live.monitors[FEEDER].book.active} == {"Ada"}


def test_shelves_and_work_end_by_the_wall_clock_and_survive_a_restart(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    wall = START

    def begin(store: Store) -> Engine:
        made = rounds(store, site)
        made.operators._wall = made.committer._wall = lambda: wall
        return made

    with Store(f"sqlite:///{path}") as store:
        live = begin(store)
        live.cycle(until(attacked, 15.0)[0])
        made = of(live.operators.shelve(shelf(feeder=FEEDER, kind=AlarmKind.METER_MANIPULATED), "Ada"))
        assert (made.severity, made.until) == (Severity.CRITICAL, START + 60.0)
        of(live.operators.plan_work(FEEDER, START + 30.0, START + 90.0, "Ada", "cable"))
        assert (only(store).shelved_until, store.open_incidents()) == (START + 60.0, 0)
    with Store(f"sqlite:///{path}") as store:
        live = begin(store)
        steps = [(29.0, None), (30.0, "work-begun"), (59.0, None), (60.0, "unshelved"), (90.0, "work-ended")]
        for t, change in steps:
            number, wall = store.last_incident_event, START + t
            live.cycle([])
            new = [str(event.change) for event in store.incident_events_after(number)]
            assert new == ([] if change is None else [change]), t
        assert changes(store) == [
            ("opened", True), ("shelved", False), ("work-begun", False), ("unshelved", False),
            ("work-ended", True),
        ]  # fmt: skip
        assert (store.open_incidents(), store.shelves(standing=True), store.works(standing=True)) == (
            1,
            [],
            [],
        )


def test_an_outage_is_one_incident_and_connecting_meters_are_none(site: Site, tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(site, store)
        street.go_on(4, lambda _s, _m: None)
        street.go_on(12, lambda _s, _m: (0.0, QUIET_VOLT))
        assert store.alarms()[0] == []
        street.go_on(20, lambda _s, _m: None)
        incident = only(store)
        assert street.standing() == {(AlarmKind.UNDECIDED, None), (AlarmKind.DATA_LOSS, None)}
        assert (incident.kind, incident.active, len(incident.meters)) == ("data-loss", 2, 14)
        (outage,) = store.alarms(kind=["data-loss"])[0]
        assert "13 of 13 meters have no usable reading" in outage.reason
        street.go_on(10, lambda _s, _m: (0.0, QUIET_VOLT))
        assert [change for change, _ in changes(store)] == [C.OPENED, C.EXTENDED, C.CLEARED]


def test_meters_that_never_connect_are_an_outage(site: Site, tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/gridsec.db") as store:
        street = Street(site, store)
        street.go_on(20, lambda _s, _m: None)
        assert street.standing() == {(AlarmKind.DATA_LOSS, None)}
        assert "no usable reading yet" in only(store).reason
