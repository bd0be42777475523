"""Alertmanager of Debian on loopback: alerts appear, stay while they are renewed, and end."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.alarms.state_machine import AlarmState, AlarmTransition, Change, Severity
from service.notify import alertmanager
from service.notify.delivery import Delivery, channel_of
from service.notify.notices import IncidentSource, trial_notice
from service.notify.targets import Alertmanager
from service.store import Store
from service.store.deliveries import DeliveryStore
from tests.service.receiver import Receiver, receiving
from tests.service.running import until
from tests.service.stored import an_alarm, raised

RESEND_S = 2.0


def alerts(url: str) -> dict[str, dict[str, Any]]:
    """Active alerts by severity."""
    found = httpx.get(f"{url}/api/v2/alerts").raise_for_status().json()
    return {each["labels"]["severity"]: each for each in found}


@pytest.mark.alertmanager
def test_alerts_follow_the_alarms(tmp_path: Path, manager: str, page: Receiver) -> None:
    url = f"sqlite:///{tmp_path}/g.db"
    target = Alertmanager.model_validate(
        {"name": "am", "url": manager, "private_addresses": True, "resend_s": RESEND_S,
         "labels": {"site": "north"}}
    )  # fmt: skip
    with Store(url) as store, DeliveryStore(url) as kept:
        channel = channel_of(target, "https://grid.example")
        delivery = Delivery(channel, IncidentSource(store), kept, None, random=lambda: 0.5)
        begun = time.time()
        alarm = an_alarm(1, t_event=begun - 2.0, t_raised=begun, meter="m01")
        store.commit([raised(alarm)])
        delivery.step(begun)
        (found,) = until(lambda: alerts(manager), "the alert").values()
        assert found["labels"] == {
            "alertname": "Manipulation", "kind": "manipulation", "feeder": "village",
            "severity": "critical", "id": store.incidents()[0][0].id, "site": "north",
        }  # fmt: skip
        summary = f"village: manipulation: {alarm.reason}"
        assert found["annotations"] == {"summary": summary, "meters": "m01"}
        assert found["generatorURL"] == "https://grid.example/#village"
        until(lambda: page.got, "Alertmanager's notification")
        first_end = found["endsAt"]
        delivery.step(time.time() + RESEND_S + 1.0)  # the active alarm is sent again
        assert until(lambda: alerts(manager))["critical"]["endsAt"] > first_end
        cleared = replace(alarm, state=AlarmState.CLEARED, t_cleared=time.time())
        store.commit([AlarmTransition(cleared, Change.CLEARED, cleared.t_cleared or 0.0)])
        delivery.step(time.time())
        until(lambda: not alerts(manager), "the end of the alert")
        until(lambda: b'"status":"resolved"' in page.got[-1].body, "Alertmanager's end")
        assert kept.letters() == []
        assert kept.positions()["am"].position == 2


def test_an_alert_that_is_not_renewed_ends_by_itself() -> None:
    notice = replace(trial_notice(1000.0), active=True)
    (made,) = alertmanager.alerts(notice, {}, "", 1000.0, 60.0)
    assert made["startsAt"] == "1970-01-01T00:16:40.000Z"
    assert made["endsAt"] == "1970-01-01T00:20:40.000Z"
    assert "generatorURL" not in made


def test_an_escalation_ends_the_alerts_of_lower_severities() -> None:
    notice = replace(trial_notice(1000.0), active=True, change="escalated", severity=str(Severity.MAJOR))
    made = alertmanager.alerts(notice, {}, "", 1000.0, 60.0)
    ends = {each["labels"]["severity"]: each["endsAt"] for each in made}
    assert ends == {"major": "1970-01-01T00:20:40.000Z", "minor": "1970-01-01T00:16:40.000Z"}


def test_several_events_of_a_subject_are_one_alert() -> None:
    one, two = replace(trial_notice(1.0), number=1), replace(trial_notice(2.0), number=2, subject="b")
    last = replace(one, number=3, active=True)
    assert alertmanager.newest([one, two, last]) == [last, two]


def test_a_refused_alert_does_not_take_others_with_it(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/g.db"
    with receiving() as receiver, Store(url) as store, DeliveryStore(url) as kept:
        target = Alertmanager(name="am", url=receiver.url, private_addresses=True)
        delivery = Delivery(channel_of(target, ""), IncidentSource(store), kept, None, random=lambda: 0.5)
        receiver.answers.extend([400, 400, 400])
        now = time.time()
        times = {"t_event": now, "t_raised": now}
        store.commit([raised(an_alarm(k, feeder=f"feeder-{k}", **times)) for k in (1, 2, 3)])
        for _ in range(40):
            now = max(delivery.step(now), now + 0.1)
        assert [each.number for each in kept.letters()] == [1]
        assert kept.positions()["am"].position == 3
