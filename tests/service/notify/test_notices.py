"""Notices of incidents: one for many alarms, none while suppressed, on SQLite and PostgreSQL."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.alarms.incidents import PlannedWork, Shelf
from service.alarms.state_machine import Alarm, AlarmState, AlarmTransition, Change, Severity
from service.notify.delivery import Delivery, channel_of
from service.notify.notices import IncidentSource
from service.notify.targets import Target, Webhook
from service.store import Store
from service.store.deliveries import DeadLetter, DeliveryStore, Position
from tests.service.databases import both
from tests.service.receiver import receiving
from tests.service.stored import T0, an_alarm, raised

ALARMS = 40
SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"


def cleared(alarm: Alarm, t: float) -> AlarmTransition:
    return AlarmTransition(replace(alarm, state=AlarmState.CLEARED, t_cleared=t), Change.CLEARED, t)


def sent(store: Store, **changes: Any) -> list[tuple[int, str, str]]:
    """Number, type and severity of the notices that a target receives, in order."""
    fields = {"name": "a", "url": "https://a.example", "secret": SECRET} | changes
    target: Target = Webhook.model_validate(fields)
    found = IncidentSource(store).after(0, 1000)
    return [(each.number, each.type, each.severity) for each in found if target.selects(each)]


@both
def test_forty_alarms_of_one_attack_are_one_notification(url: str) -> None:
    alarms = [an_alarm(k, meter=f"m{k}") for k in range(ALARMS)]
    with receiving() as receiver, Store(url) as store, DeliveryStore(url) as kept:
        fields = {"name": "a", "url": receiver.url, "secret": SECRET, "private_addresses": True}
        channel = channel_of(Webhook.model_validate(fields), "")
        delivery = Delivery(channel, IncidentSource(store), kept, None, random=lambda: 0.5)
        now = T0
        for k in range(0, ALARMS, 10):
            store.commit(list(map(raised, alarms[k : k + 10])))
            now = max(now, delivery.step(now))
        for k in range(0, ALARMS, 10):
            store.commit([cleared(alarm, T0 + 100.0 + k) for alarm in alarms[k : k + 10]])
            now = max(now, delivery.step(now))
        for _ in range(5):
            now = max(now + 1e-3, delivery.step(now))
        messages = [json.loads(each.body) for each in receiver.got]
        assert [each["type"] for each in messages] == ["incident.opened", "incident.cleared"]
        assert messages[1]["data"]["incident"]["meters"] == [f"m{k}" for k in range(ALARMS)]
        assert delivery.waiting == 0
        assert kept.positions()["a"].position == store.last_incident_event


@both
def test_the_database_of_notifications(url: str) -> None:
    letter = DeadLetter("a", 7, "msg_7", "incident.opened", T0, T0 + 1.0, 3, "status 400", '{"ö": 1}')
    with DeliveryStore(url) as one, DeliveryStore(url) as two:
        one.keep("a", Position(7, T0, T0 + 1.0, 2, "x" * 9999), [letter, replace(letter, number=8)])
        found = two.positions()["a"]
        assert (found.position, found.delivered, found.failing_since, found.attempts) == (7, T0, T0 + 1.0, 2)
        assert (len(found.problem or ""), two.counts()) == (500, {"a": 2})
        first, second = two.letters(target="a")
        assert replace(first, id=0) == letter
        assert two.letters(after=first.id) == [second]
        assert (two.resend(ids=[first.id]), two.resend(target="b")) == (1, 0)
        assert [each.id for each in one.letters(resend=True)] == [first.id]
        assert [each.id for each in one.letters(resend=False, limit=5)] == [second.id]
        one.failed_again(first, "status 500")
        again = two.letters(limit=1)[0]
        assert (again.attempts, again.problem, again.resend) == (4, "status 500", False)
        assert (two.discard(ids=[second.id]), two.discard()) == (1, 1)
        assert (two.forget("a"), two.forget("a"), one.positions()) == (True, False, {})


def test_dead_letters_are_bounded(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("service.store.deliveries.LETTERS_KEPT", 3)
    with DeliveryStore(f"sqlite:///{tmp_path}/g.db") as store:
        for k in range(5):
            letter = DeadLetter("a", k, f"msg_{k}", "t", T0, T0, 1, "", "{}")
            store.keep("a", Position(k), [letter, replace(letter, target="b")])
        assert [each.number for each in store.letters(target="a")] == [2, 3, 4]
        assert len(store.letters(target="b")) == 5


def test_an_escalation_reaches_a_target_of_high_severities_only(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        store.commit([raised(an_alarm(0, severity=Severity.MAJOR))])
        store.commit([raised(an_alarm(1, severity=Severity.CRITICAL, meter="m2"))])
        assert sent(store, severities=["critical"]) == [(2, "incident.escalated", "critical")]
        assert [each[0] for each in sent(store)] == [1, 2]
        assert sent(store, changes=["extended"]) == []


def test_a_shelf_suppresses_notices_and_its_end_is_one(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        shelf = Shelf("s" * 26, "village", None, None, "m1", None, Severity.CRITICAL, "Ada", "known",
                      T0 - 10.0, T0 + 50.0)  # fmt: skip
        store.commit(actions=[shelf], now=T0 - 10.0)
        alarm = an_alarm(0)
        store.commit([raised(alarm)], now=T0)
        assert sent(store) == []
        assert IncidentSource(store).active() == []
        store.commit(now=T0 + 51.0)
        assert [each[1] for each in sent(store)] == ["incident.unshelved"]
        (active,) = IncidentSource(store).active()
        assert (active.feeder, active.active, active.meters) == ("village", True, ("m1",))
        store.commit([cleared(alarm, T0 + 60.0)], now=T0 + 60.0)
        assert [each[1] for each in sent(store)] == ["incident.unshelved", "incident.cleared"]


def test_planned_work_leaves_no_notice(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        work = PlannedWork("w" * 26, "village", T0 - 10.0, T0 + 1000.0, "Ada", "new cable", T0 - 20.0)
        store.commit(actions=[work], now=T0 - 20.0)
        alarm = an_alarm(0)
        store.commit([raised(alarm)], now=T0)
        store.commit([cleared(alarm, T0 + 60.0)], now=T0 + 60.0)
        assert sent(store) == []
        found = IncidentSource(store).after(0, 100)
        assert {each.active for each in found} == {False}


def test_the_end_of_an_announced_incident_is_a_notice_under_planned_work(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        alarm = an_alarm(0)
        store.commit([raised(alarm)], now=T0)
        work = PlannedWork("w" * 26, "village", T0 + 5.0, T0 + 1000.0, "Ada", "new cable", T0 + 2.0)
        store.commit(actions=[work], now=T0 + 2.0)
        store.commit(now=T0 + 6.0)
        store.commit([cleared(alarm, T0 + 60.0)], now=T0 + 60.0)
        assert [each[1] for each in sent(store)] == ["incident.opened", "incident.cleared"]
