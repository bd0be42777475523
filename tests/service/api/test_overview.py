"""`GET /feeders`: status, order, filters, pages, numbers by status, numbers of alarms."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest

from gridsec.interface import Cause
from service.api.overview import Order, Standing, page, standing
from service.report.feeder_info import FeederStatus, numbers, status_of
from service.store import AlarmCounts
from tests.service.asking import T0, Setup

WORST = ["attacked", "undecided", "no-data", "not-monitored", "clean"]


def fleet(village: type, count: int, seed: int) -> list[Standing]:
    """Feeders with random verdicts, ages, suspects and alarms."""
    draw, found = random.Random(seed), []
    for k in range(count):
        made = village(f"f{k:03d}", 4)
        kind = draw.choice(["none", "clean", "attacked", "undecided", "stale", "failed"])
        lies = {f"H{i}": 9.0 for i in range(draw.randrange(1, 4))} if kind == "attacked" else {}
        cause = Cause.AMBIGUOUS if kind == "undecided" else None
        report = None if kind == "none" else made.report(T0, lies=lies, cause=cause)
        if report is not None:
            report = replace(report, since=T0 - draw.randrange(100))
        fields = {"name": made.name, "title": f"Street {k}", "patience_s": 5.0}
        fields["phase"] = "failed" if kind == "failed" else "watching"
        active = draw.randrange(4)
        alarms = AlarmCounts(active, draw.randrange(active + 1))
        age_s = 9.0 if kind == "stale" else 1.0
        found.append(standing(fields, {} if report is None else numbers(report, age_s), alarms))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_pages_in_order_make_the_whole_list(village: type, seed: int) -> None:
    found = fleet(village, 60, seed)

    def asked(**changes: Any) -> Any:
        usual: dict[str, Any] = {"order": Order.WORST, "text": "", "status": [], "include": None}
        return page(found, **{**usual, "part": (0, None), **changes})

    whole = asked()
    assert whole.total == 60
    names = [one.name for one in whole.feeders]
    assert sorted(names) == sorted(one.name for one in found)
    parts = [[one.name for one in asked(part=(k, 7)).feeders] for k in range(0, 60, 7)]
    assert [name for part in parts for name in part] == names
    statuses = [str(one.status) for one in whole.feeders]
    assert [WORST.index(status) for status in statuses] == sorted(map(WORST.index, statuses))
    assert {str(k): n for k, n in whole.counts.items()} == {s: statuses.count(s) for s in WORST}
    for a, b in zip(whole.feeders, whole.feeders[1:], strict=False):
        if a.status == b.status:
            assert (-a.suspects, -a.raised) <= (-b.suspects, -b.raised)
    some = asked(status=[FeederStatus.ATTACKED, FeederStatus.CLEAN])
    assert [one.name for one in some.feeders] == [
        one.name for one in whole.feeders if one.status in ("attacked", "clean")
    ]
    assert some.counts == whole.counts
    assert [one.name for one in asked(text="  STREET 7 ").feeders] == ["f007"]
    assert asked(text="f00").total == 10
    last = names[-1]
    assert [one.name for one in asked(part=(0, 3), include=last).feeders] == [*names[:3], last]
    assert [one.name for one in asked(part=(0, 3), include=names[1]).feeders] == names[:3]
    assert asked(part=(100, 5)).feeders == []
    assert [one.name for one in asked(order=Order.GIVEN).feeders] == [one.name for one in found]


def test_only_present_readings_make_a_verdict(village: type) -> None:
    report = village("village").report(T0, lies={"H1": 9.0})
    now = numbers(report, 1.0)
    assert status_of(now, 5.0) is FeederStatus.ATTACKED
    assert status_of(numbers(report, 5.1), 5.0) is FeederStatus.NO_DATA
    assert status_of(numbers(replace(report, model_only=True), 1.0), 5.0) is FeederStatus.NO_DATA
    assert status_of({}, 5.0) is FeederStatus.NO_DATA
    assert status_of(now, 5.0, failed=True) is FeederStatus.NOT_MONITORED
    assert status_of(now, None) is FeederStatus.ATTACKED
    for cause in ("overload", "no-owner"):
        for more in ({}, {"model_only": True}, {"age_s": 99.0}):
            assert status_of({**now, "cause": cause, **more}, 5.0) is FeederStatus.UNDECIDED


def test_the_list_over_http(setup: Setup) -> None:
    service, http = setup.service, setup.http
    town = service.villages["town"]
    for k in range(4):
        service.tick(town.report(T0 + k, lies={"H1": 9.0, "H2": 9.0}))
    service.tick(service.villages["village"].report(T0))
    answer = http.get("/api/v1/feeders").json()
    assert [one["name"] for one in answer["feeders"]] == ["village", "town"]
    assert answer["total"] == 2
    assert answer["counts"] == {"attacked": 1, "undecided": 0, "no-data": 0, "not-monitored": 0, "clean": 1}
    first = http.get("/api/v1/feeders", params={"order": "worst", "limit": 1, "include": "village"}).json()
    assert [one["name"] for one in first["feeders"]] == ["town", "village"]
    worst = first["feeders"][0]
    assert (worst["status"], worst["suspects"], worst["alarms"], worst["raised"]) == ("attacked", 2, 2, 2)
    assert [one["incidents"] for one in first["feeders"]] == [1, 0]
    (alarm, _) = http.get("/api/v1/alarms").json()["alarms"]
    assert http.post(f"/api/v1/alarms/{alarm['id']}/ack", json={"who": "Ada"}).status_code == 200
    after = http.get("/api/v1/feeders", params={"status": ["attacked", "no-data"]}).json()
    keys = ("name", "alarms", "raised", "incidents")
    assert [tuple(one[key] for key in keys) for one in after["feeders"]] == [("town", 2, 1, 1)]
    for k in range(4, 20):
        service.tick(town.report(T0 + k))
    assert [one["incidents"] for one in http.get("/api/v1/feeders").json()["feeders"]] == [0, 0]
    assert http.get("/api/v1/feeders", params={"text": "VILL"}).json()["feeders"][0]["status"] == "clean"
    for wrong in ({"order": "best"}, {"limit": -1}, {"offset": -1}, {"status": "bad"}, {"worst": 1}):
        assert http.get("/api/v1/feeders", params=wrong).status_code == 422


def test_a_limit_of_zero_returns_the_numbers_and_the_included_feeder(setup: Setup) -> None:
    setup.calm(T0, 1)
    whole = setup.get("/feeders").json()
    found = setup.get("/feeders", params={"limit": 0, "include": "town"}).json()
    assert found["counts"] == whole["counts"]
    assert found["total"] == 2
    assert [one["name"] for one in found["feeders"]] == ["town"]
    assert setup.get("/feeders", params={"limit": 0}).json()["feeders"] == []
