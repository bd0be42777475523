"""One cause on a running service is one incident, one message of a webhook and one of Alertmanager."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from feeders.model.site import load
from feeders.simulation.scenario import Scenario, random_attacks
from service.cli.simulate import Pace, play
from tests.service.receiver import Receiver, receiving
from tests.service.running import FEEDER, InProcess, service, until

LARGE = "kerber-vorstadtnetz"
START = 1_795_212_000.0
SETTLED_S = 3.0
"""Time after the last message without a further one, s."""


def targets(folder: Path, hook: str, manager: str) -> Path:
    path = folder / "targets.toml"
    path.write_text(
        f'[[webhook]]\nname = "hook"\nurl = "{hook}"\nprivate_addresses = true\n'
        f'secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"\n'
        f'[[alertmanager]]\nname = "am"\nurl = "{manager}"\nprivate_addresses = true\n'
    )
    return path


def attack(live: InProcess, feeder: str, meters: int, seconds: float) -> None:
    """Publish readings over zenoh, of which those of some meters are scaled from the sixth second on."""
    site = load(feeder)
    attacks = random_attacks(site, 5, "scaling", meters, 0.03, t_on=START + 6, t_off=START + 1000)
    scenario = Scenario(seed=4, start=START, duration_s=seconds, attacks=attacks)
    for _ in play(site, scenario, live.meters, Pace(float("inf"), ahead=3)):
        pass


def delivered(live: InProcess) -> bool:
    """All events were processed by all targets."""
    found = live.get("/api/v1/notifications")["targets"]
    return len(found) == 2 and all(each["waiting"] == 0 and each["position"] > 0 for each in found)


def the_incident(live: InProcess) -> dict[str, Any]:
    (found,) = live.get("/api/v1/incidents")["incidents"]
    return dict(found)


def types(receiver: Receiver) -> list[str]:
    return [str(json.loads(each.body)["type"]) for each in receiver.got]


def test_an_attack_on_some_meters(tmp_path: Path) -> None:
    with receiving() as hook, receiving() as manager:
        with service(tmp_path, clock="events", notify=targets(tmp_path, hook.url, manager.url)) as live:
            attack(live, FEEDER, 4, 12.0)
            until(lambda: delivered(live), "the messages")
            found = the_incident(live)
            assert (found["kind"], found["alarms"], len(found["meters"])) == ("manipulation", 4, 4)
        assert types(hook) == ["incident.opened"]
        alerts = [each for got in manager.got for each in json.loads(got.body)]
        assert {each["labels"]["id"] for each in alerts} == {found["id"]}


@pytest.mark.acceptance
@pytest.mark.alertmanager
def test_an_attack_on_40_meters_of_a_large_feeder(tmp_path: Path, manager: str, page: Receiver) -> None:
    """Alertmanager itself sends one notification of one firing alert."""
    with (
        receiving() as hook,
        service(tmp_path, (LARGE,), clock="events", notify=targets(tmp_path, hook.url, manager)) as live,
    ):
        attack(live, LARGE, 40, 30.0)
        until(lambda: delivered(live), "the messages")
        found = the_incident(live)
        assert (found["feeder"], found["state"], found["severity"]) == (LARGE, "raised", "critical")
        assert found["alarms"] >= 40
        until(lambda: page.got, "Alertmanager's notification")
        time.sleep(SETTLED_S)
        assert types(hook) == ["incident.opened"]
        firing = [alert for got in page.got for alert in json.loads(got.body)["alerts"]]
        assert [alert["labels"]["id"] for alert in firing] == [found["id"]]
        (alert,) = httpx.get(f"{manager}/api/v2/alerts").json()
        assert alert["labels"]["feeder"] == LARGE


@pytest.mark.acceptance
def test_an_outage_of_a_large_feeder(tmp_path: Path) -> None:
    """All readings end. The verdict is undecided before data loss takes over its incident."""
    site = load(LARGE)
    with receiving() as hook, receiving() as manager:
        with service(tmp_path, (LARGE,), notify=targets(tmp_path, hook.url, manager.url)) as live:
            for _ in play(site, Scenario(seed=1, start=time.time(), duration_s=8.0), live.meters, Pace()):
                pass
            assert live.alarms() == []
            until(lambda: live.alarms(kind="data-loss"), "the alarm")
            time.sleep(SETTLED_S)
            until(lambda: delivered(live), "the messages")
            found = the_incident(live)
            assert (found["kind"], found["state"]) == ("data-loss", "raised")
            (lost,) = live.alarms(kind="data-loss")
            assert lost["meter"] is None
        assert types(hook) == ["incident.opened"]
