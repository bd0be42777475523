"""REST: feeders, alarms, errors, operations."""

from __future__ import annotations

import json
import math
import socket
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import httpx
import pytest
from pydantic import TypeAdapter

from gridsec.interface import Cause
from service.alarms.state_machine import Alarm
from service.api import models
from service.report.report import CustomerState, ExplanationReport, InverterState
from service.report.report import to_json as report_json
from service.store import Rejected, connect
from tests.service.asking import T0, Setup, Stream, is_problem

ACK = f"/api/v1/alarms/{'0' * 26}/ack"


# ----------------------------------------------------------------------- feeders


def test_feeders_and_their_verdicts(setup: Setup) -> None:
    setup.attack(ticks=1)
    found = models.Feeders.model_validate(setup.get("/feeders").json()).feeders
    assert [(f.name, f.verdict, f.t) for f in found] == [("village", "attacked", T0), ("town", None, None)]


def test_a_feeder_with_its_tree_and_an_etag(setup: Setup) -> None:
    first = setup.get("/feeders/village")
    detail = models.FeederDetail.model_validate(first.json())
    assert detail.layout.buses[0] == "busbar"
    assert detail.layout.parent[0] is None
    assert len(detail.layout.customers) == 13
    assert first.headers["etag"] == f'"{detail.revision}-{detail.max_attacked}"'
    again = setup.get("/feeders/village", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    other = setup.get("/feeders/town", headers={"If-None-Match": first.headers["etag"]})
    assert other.status_code == 200


def test_state_is_the_report(setup: Setup) -> None:
    is_problem(setup.get("/feeders/village/state"), 503)
    setup.attack(ticks=1)
    response = setup.get("/feeders/village/state")
    assert 0.0 <= response.json()["age_s"] < 20.0
    added = {"age_s": 0, "owner": None, "epoch": None}
    assert {**response.json(), "age_s": 0} == report_json(setup.service.report("village")) | added
    assert response.headers["cache-control"] == "no-store"
    contract = {"feeder", "t", "verdict", "reason", "max_attacked", "meters"}
    meter = {
        *("meter", "bus", "seen", "suspect", "score", "threshold", "v_volt_reported", "v_volt_estimated"),
        *("v_volt_std", "v2_pu_estimated", "attack_volt_estimated", "kind", "phase"),
        *("v_min_volt", "v_max_volt", "model_only", "learning_state", "learning_reason", "clock_offset_s"),
        "customer",
    }
    assert contract | {"customers", "inverters", "explanations"} <= set(response.json())
    assert all(set(item) == meter for item in response.json()["meters"])


def test_nan_never_leaves(setup: Setup) -> None:
    report = setup.village.report(T0)
    broken = replace(report.meters[0], score=math.nan, v_volt_estimated=math.inf, threshold=-math.inf)
    setup.service.tick(replace(report, meters=(broken, *report.meters[1:])))
    for path in ("state", "meters/H0", "history?meter=H0"):
        json.loads(setup.get(f"/feeders/village/{path}").text, parse_constant=pytest.fail)
    assert setup.get("/feeders/village/meters/H0").json()["score"] is None


def test_one_meter(setup: Setup) -> None:
    setup.attack(ticks=1)
    found = TypeAdapter(models.MeterNow).validate_python(setup.get("/feeders/village/meters/H3").json())
    assert (found.meter, found.feeder, found.verdict, found.suspect) == ("H3", "village", "attacked", True)
    is_problem(setup.get("/feeders/village/meters/nobody"), 404)
    is_problem(setup.get("/feeders/nowhere/meters/H3"), 404)


def test_history_of_a_feeder_and_of_a_meter(setup: Setup) -> None:
    setup.calm(T0, 30)
    setup.attack(T0 + 30, 10)
    whole = models.History.model_validate(setup.get("/feeders/village/history").json())
    assert [p.t - T0 for p in whole.points] == [0, 10, 20, 30]
    assert [p.suspects for p in whole.points] == [[], [], [], ["H3"]]
    last = whole.points[-1]
    assert last.meter is None
    assert last.seen == 13
    assert last.v_volt_lowest is not None
    assert last.v_volt_highest is not None
    assert 200 < last.v_volt_lowest < last.v_volt_highest < 240
    part = setup.get("/feeders/village/history", params={"meter": "H3", "since": T0 + 5, "until": T0 + 31})
    points = models.History.model_validate(part.json()).points
    assert [p.t - T0 for p in points] == [10, 20, 30]
    meter = points[-1].meter
    assert meter is not None
    assert meter.v_volt_reported == pytest.approx(meter.v_volt_estimated + 9.0, abs=1e-3)
    two = models.History.model_validate(setup.get("/feeders/village/history?limit=2").json())
    assert ([p.t - T0 for p in two.points], two.more) == ([20, 30], True)


def test_a_feeder_can_be_put(setup: Setup) -> None:
    made = setup.http.put("/api/v1/feeders/hamlet", json={"customers": 3})
    assert made.status_code == 200
    assert models.FeederDetail.model_validate(made.json()).name == "hamlet"
    assert [f["name"] for f in setup.get("/feeders").json()["feeders"]] == ["village", "town", "hamlet"]


def test_a_feeder_can_be_deleted_unless_it_was_given(setup: Setup) -> None:
    town = setup.service.villages["town"]
    setup.service.tick(town.report(T0))
    stream = Stream(setup, "/feeders/town/stream")
    assert [stream.next().get("event") for _ in range(2)] == [None, "state"]
    answer = setup.http.delete("/api/v1/feeders/town")
    assert (answer.status_code, answer.content) == (204, b"")
    assert stream.next() == {"end": "true"}
    stream.close()
    is_problem(setup.http.delete("/api/v1/feeders/town"), 404)
    is_problem(setup.get("/feeders/town"), 404)
    assert "cannot be deleted" in is_problem(setup.http.delete("/api/v1/feeders/village"), 409)["detail"]
    assert [f["name"] for f in setup.get("/feeders").json()["feeders"]] == ["village"]


def test_there_is_an_end_to_feeders(setup: Setup) -> None:
    for name, status in (("one", 200), ("one", 200), ("two", 409), ("town", 200)):
        assert setup.http.put(f"/api/v1/feeders/{name}", json={"customers": 3}).status_code == status
    is_problem(setup.http.put("/api/v1/feeders/two", json={"customers": 3}), 409)


def test_asking_for_a_feeder_s_state_does_not_build_its_tables(setup: Setup) -> None:
    setup.attack()
    setup.service.feeder = lambda _: pytest.fail("the tables were built")
    for path in ("state", "meters/H3", "history"):
        assert setup.get(f"/feeders/village/{path}").status_code == 200


def test_every_problem_of_a_feeder_is_told_at_once(setup: Setup) -> None:
    body = is_problem(setup.http.put("/api/v1/feeders/hamlet", json={}), 422)
    assert body["problems"] == ["customers.csv: missing", "lines.csv: missing"]
    nan = b'{"customers": [{"load_kw": NaN}]}'
    header = {"Content-Type": "application/json"}
    body = is_problem(setup.http.put("/api/v1/feeders/hamlet", content=nan, headers=header), 422)
    assert "NaN" in body["problems"][0]
    assert setup.get("/feeders/hamlet").status_code == 404


# ------------------------------------------------------------------------ alarms


def test_an_alarm_and_its_fields(setup: Setup) -> None:
    assert setup.get("/alarms").json() == {
        **{"alarms": [], "next": None, "last_event": 0},
        **{"raised": 0, "unstored": 0, "problem": None},
    }
    setup.attack()
    alarm = setup.one()
    contract = {
        *("id", "kind", "feeder", "meter", "severity", "state", "count", "t_event", "t_raised", "t_cleared"),
        "evidence",
    }
    assert contract <= set(alarm)
    assert set(alarm["evidence"]) == {
        *("score", "threshold", "v_volt_reported", "v_volt_estimated", "attack_volt_estimated"),
        *("kind", "attack_kvar_estimated", "explanations", "learning", "silent", "data_error", "customer"),
    }
    assert alarm["customer"] is None
    assert (alarm["kind"], alarm["meter"], alarm["state"]) == ("meter-manipulated", "H3", "raised")
    assert (alarm["t_event"], alarm["t_raised"], alarm["t_cleared"]) == (T0, T0 + 2, None)
    assert setup.get(f"/alarms/{alarm['id']}").json() == alarm
    setup.calm(T0 + 4)
    assert setup.one()["t_cleared"] == T0 + 9
    events = models.AlarmEvents.model_validate(setup.get(f"/alarms/{alarm['id']}/events").json()).events
    assert [(e.seq, e.change, e.t - T0) for e in events] == [(1, "raised", 2.0), (2, "cleared", 9.0)]
    assert events[0].alarm.state == "raised"


def test_an_inverter_and_an_ambiguity_are_shown(setup: Setup) -> None:
    inverter = InverterState("H7", "drop-7", None, True, True, 4.5, -6.0)
    explanations = (
        ExplanationReport(("H3",), (), 0.75),
        ExplanationReport((), ("H7",), 0.25, ("H5",)),
    )
    for k in range(4):
        report = setup.village.report(T0 + k, cause=Cause.RESIDUALS)
        customers = (CustomerState("H7", 229.0, 0.2), CustomerState("H8", None, None))
        setup.service.tick(replace(report, inverters=(inverter,), customers=customers))
    state = TypeAdapter(models.State).validate_python(setup.get("/feeders/village/state").json())
    assert [(i.customer, i.suspect, i.attack_kvar_estimated) for i in state.inverters] == [("H7", True, -6.0)]
    assert [(c.customer, c.v_volt_std) for c in state.customers] == [("H7", 0.2), ("H8", None)]
    alarm = TypeAdapter(Alarm).validate_python(setup.one())
    assert (alarm.kind, alarm.customer, alarm.meter) == ("inverter-manipulated", "H7", None)
    assert alarm.evidence.attack_kvar_estimated == -6.0
    assert setup.get("/alarms", params={"kind": "inverter-manipulated"}).json()["alarms"][0]["id"] == alarm.id
    answered = setup.http.post(
        f"/api/v1/alarms/{alarm.id}/ack", json={"who": "Ada", "comment": "switched off"}
    )
    assert answered.json()["state"] == "acknowledged"
    for k in range(4, 8):
        report = setup.village.report(T0 + k, cause=Cause.AMBIGUOUS)
        setup.service.tick(replace(report, explanations=explanations))
    undecided, held = setup.get("/alarms").json()["alarms"]
    assert (undecided["kind"], held["state"]) == ("undecided", "acknowledged")
    assert undecided["evidence"]["explanations"] == [
        {"meters": ["H3"], "inverters": [], "powers": [], "probability": 0.75},
        {"meters": [], "inverters": ["H7"], "powers": ["H5"], "probability": 0.25},
    ]


def test_filters_and_pages(setup: Setup) -> None:
    setup.attack(lies={f"H{k}": 8.0 for k in range(7)})
    setup.calm(T0 + 4)
    setup.attack(T0 + 1000, silent=("H9",))
    pages, cursor = [], None
    while True:
        parameters = {"limit": 4} | ({"cursor": cursor} if cursor else {})
        page = setup.get("/alarms", params=parameters).json()
        pages.append([a["id"] for a in page["alarms"]])
        cursor = page["next"]
        if cursor is None:
            break
    assert [len(page) for page in pages] == [4, 4, 1]
    ids = [name for page in pages for name in page]
    assert len(set(ids)) == 9
    assert ids == sorted(ids, reverse=True)

    def count(query: str) -> int:
        return len(setup.get(f"/alarms?{query}").json()["alarms"])

    assert count("state=cleared") == 7
    assert count("state=raised") == 2
    assert setup.get("/alarms?limit=1&state=cleared").json()["raised"] == 2
    assert count("state=raised&state=cleared") == 9
    assert count("kind=data-loss") == 1
    assert count("severity=critical&feeder=village") == 8
    assert count("feeder=town") == 0
    assert count("meter=H3") == 2
    assert count(f"since={T0 + 500}") == 2
    assert count(f"until={T0 + 500}") == 7


def test_the_list_is_not_sent_twice(setup: Setup) -> None:
    first = setup.get("/alarms")
    header = {"If-None-Match": first.headers["etag"]}
    assert setup.get("/alarms", headers=header).status_code == 304
    setup.service.waits = (2, "database: it is locked")
    assert setup.get("/alarms", headers=header).json()["unstored"] == 2
    setup.service.waits = (0, None)
    assert setup.get("/alarms", headers=header).status_code == 304
    setup.attack()
    assert setup.get("/alarms", headers=header).status_code == 200


def test_the_list_is_sent_again_before_the_process_knows_of_a_commit(setup: Setup) -> None:
    header = {"If-None-Match": setup.get("/alarms").headers["etag"]}
    store = setup.service.store
    before = store._last_event, store._last_incident_event
    setup.attack()
    # A commit is visible to readers earlier than to the properties of the store.
    store._last_event, store._last_incident_event = before
    assert setup.get("/alarms", headers=header).status_code == 200


def test_the_events_of_an_alarm_come_page_by_page(setup: Setup) -> None:
    for k in range(4):
        setup.attack(T0 + 12 * k)
        setup.calm(T0 + 12 * k + 4)
    path = f"/alarms/{setup.one()['id']}/events"
    whole = setup.get(path).json()
    assert ([e["seq"] for e in whole["events"]], whole["next"]) == (list(range(1, 9)), None)
    pages, after = [], 0
    while after is not None:
        page = setup.get(f"{path}?limit=3&after={after}").json()
        pages.append(page["events"])
        after = page["next"]
    assert [len(page) for page in pages] == [3, 3, 2]
    assert [event for page in pages for event in page] == whole["events"]
    assert setup.get(f"{path}?after=8").json() == {"events": [], "next": None}
    for wrong in ("limit=0", "limit=1001", "after=-1", f"after={1 << 63}"):
        is_problem(setup.get(f"{path}?{wrong}"), 422)


def test_an_answer_is_to_the_occurrence_that_was_seen(setup: Setup) -> None:
    setup.attack()
    seen = setup.one()
    setup.calm(T0 + 4)
    setup.attack(T0 + 12, lies={"H3": 40.0})
    now = setup.one()
    assert (now["id"], now["count"], now["state"]) == (seen["id"], 2, "raised")
    path = f"/api/v1/alarms/{seen['id']}/ack"
    refused = is_problem(setup.http.post(path, json={"who": "Ada", "count": seen["count"]}), 409)
    assert "raised 2 times" in refused["detail"]
    assert setup.one() == now
    answered = setup.http.post(path, json={"who": "Ada", "count": now["count"]})
    assert answered.json()["state"] == "acknowledged"
    assert is_problem(setup.http.post(path, json={"who": "Ada", "count": 0}), 422)


def test_acknowledging(setup: Setup) -> None:
    setup.attack()
    alarm = setup.one()
    path = f"/api/v1/alarms/{alarm['id']}/ack"
    answered = setup.http.post(path, json={"who": "  Ada ", "comment": "on my way"}).json()
    assert (answered["state"], answered["acknowledged_by"]) == ("acknowledged", "Ada")
    assert answered["comment"] == "on my way"
    assert setup.one() == alarm | answered
    assert "Ada" in is_problem(setup.http.post(path, json={"who": "Grace"}), 409)["detail"]
    event = setup.get(f"/alarms/{alarm['id']}/events").json()["events"][1]
    assert (event["change"], event["who"], event["comment"]) == ("acknowledged", "Ada", "on my way")
    is_problem(setup.http.post(f"/api/v1/alarms/{'0' * 26}/ack", json={"who": "Ada"}), 404)


# ------------------------------------------------------------------------ errors


JSON = {"Content-Type": "application/json"}

ERRORS: list[tuple[str, str, bytes | None, dict[str, str], int]] = [
    ("GET", "/nothing", None, {}, 404),
    ("GET", "/api/v1/nothing", None, {}, 404),
    ("GET", "/../service/api/routes.py", None, {}, 404),
    ("GET", "/api/v1/feeders/nowhere", None, {}, 404),
    ("GET", "/api/v1/feeders/nowhere/state", None, {}, 404),
    ("GET", "/api/v1/feeders/nowhere/stream", None, {}, 404),
    ("GET", "/api/v1/feeders/not%20a%20name", None, {}, 422),
    ("GET", "/api/v1/feeders/village/history?limit=0", None, {}, 422),
    ("GET", "/api/v1/feeders/village/history?since=nan", None, {}, 422),
    ("GET", "/api/v1/alarms?state=sleeping", None, {}, 422),
    ("GET", "/api/v1/alarms?limit=100000", None, {}, 422),
    ("GET", "/api/v1/alarms?cursor=%27;drop", None, {}, 422),
    ("GET", "/api/v1/alarms/short", None, {}, 422),
    ("GET", f"/api/v1/alarms/{'0' * 26}", None, {}, 404),
    ("GET", f"/api/v1/alarms/{'0' * 26}/events", None, {}, 404),
    ("GET", "/api/v1/alarms/stream?after=-1", None, {}, 422),
    ("GET", "/api/v1/alarms/stream", None, {"Last-Event-ID": "x"}, 422),
    ("DELETE", "/api/v1/feeders", None, {}, 405),
    ("POST", "/healthz", None, {}, 405),
    ("POST", "/index.html", None, {}, 405),
    ("PUT", "/api/v1/feeders/x", b"{}", {}, 415),
    ("PUT", "/api/v1/feeders/x", b"{}", {"Content-Type": "text/plain"}, 415),
    ("PUT", "/api/v1/feeders/x", b"{", JSON, 400),
    ("PUT", "/api/v1/feeders/x", b"\xff\xfe", JSON, 400),
    ("PUT", "/api/v1/feeders/x", b"[" * 100_000, JSON, 400),
    ("PUT", "/api/v1/feeders/x", b"[1]", JSON, 422),
    ("PUT", "/api/v1/feeders/x", b"", JSON, 422),
    ("PUT", "/api/v1/feeders/x", b" " * (5 << 20), JSON, 413),
    ("POST", "/api/v1/feeders/village/commissioning", b"[" * 100_000, JSON, 400),
    ("POST", ACK, b'{"who": " "}', JSON, 422),
    ("POST", ACK, b'{"who": 1}', JSON, 422),
    ("POST", ACK, b'{"who": "Ada\\u0000"}', JSON, 422),
    ("POST", ACK, b'{"who": "Ada", "comment": "a\\u001b[2J"}', JSON, 422),
    ("POST", ACK, b'{"who": "Ada", "state": "cleared"}', JSON, 422),
]


HOSTS = [
    ("127.0.0.1:8000", None, 200),
    ("[::1]:8000", "http://[::1]:8000", 200),
    ("localhost:8000", "http://localhost:8000", 200),
    (socket.gethostname(), None, 200),
    ("Grid.example", "https://grid.example", 200),
    ("127.0.0.1:8000", "https://grid.example", 200),
    ("127.0.0.1:8000", "https://grid.example:8443", 200),
    ("localhost:80", "http://localhost", 200),
    ("localhost", "http://localhost:80", 200),
    ("127.0.0.1:8000", "http://grid.example", 403),
    ("localhost:8000", "https://localhost:8000", 403),
    ("localhost:8000", "ftp://localhost:8000", 403),
    ("localhost:8000", "http://localhost:x", 403),
    ("localhost:x", "http://localhost:x", 403),
    ("evil.example:8000", "http://evil.example:8000", 421),
    ("evil.example:8000", None, 421),
    ("127.0.0.1.evil.example", None, 421),
    ("grid.example.evil.example", None, 421),
    ("localhost:8000", "http://localhost:9000", 403),
    ("localhost:8000", "http://evil.example", 403),
    ("localhost:8000", "null", 403),
]


def test_only_under_a_name_of_ours_is_anything_changed(setup: Setup) -> None:
    """A foreign page that gives its own name our address (DNS rebinding) may read, and change nothing."""
    path = "/api/v1/feeders/village/commissioning"
    for host, origin, status in HOSTS:
        headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
        done = setup.http.post(path, json={"who": "Ada", "reason": host}, headers=headers)
        assert done.status_code == status, (host, origin, done.text)
        if status != 200:
            is_problem(done, status)
        assert setup.get("/feeders", headers=headers).status_code == 200
    reasons = [
        event["reason"] for event in setup.get("/feeders/village/commissioning/events").json()["events"]
    ]
    assert reasons == [host for host, _, status in HOSTS if status == 200]


def test_every_error_is_a_problem(setup: Setup) -> None:
    for method, path, content, headers, status in ERRORS:
        response = setup.http.request(method, path, content=content, headers=headers)
        is_problem(response, status)
        assert response.headers["x-content-type-options"] == "nosniff", (method, path)
        if status == 405:
            assert "GET" in response.headers["allow"], (method, path)


def test_a_long_body_without_a_length_is_stopped(setup: Setup) -> None:
    sent = 0

    def endless() -> Iterator[bytes]:
        nonlocal sent
        while sent < 200 << 20:
            sent += 1 << 16
            yield b" " * (1 << 16)

    header = {"Content-Type": "application/json"}
    try:
        response = setup.http.put("/api/v1/feeders/x", content=endless(), headers=header)
        is_problem(response, 413)
    except httpx.WriteError:
        pass  # The server hung up while we were still talking.
    assert sent < 64 << 20
    assert setup.get("/feeders").status_code == 200


def test_what_nobody_foresaw_is_a_problem_without_details(setup: Setup) -> None:
    setup.service.metrics = lambda: 1 / 0
    response = setup.http.get("/metrics")
    assert "ZeroDivisionError" not in json.dumps(is_problem(response, 500))
    assert response.headers["connection"] == "close"
    assert setup.http.get("/healthz").status_code == 200


def test_a_store_that_cannot_be_used_is_503(setup: Setup) -> None:
    setup.attack()
    alarm = setup.one()
    path = setup.service.store.name.removeprefix("sqlite:///")
    raw = sqlite3.connect(path)
    raw.execute("ALTER TABLE alarm RENAME TO away")
    response = setup.get(f"/alarms/{alarm['id']}")
    detail = is_problem(response, 503)["detail"]
    assert "(read-failed)" in detail
    assert not any(word in detail for word in ("no such table", "sqlite", path))
    assert response.headers["retry-after"] == "5"
    is_problem(setup.http.post(f"/api/v1/alarms/{alarm['id']}/ack", json={"who": "Ada"}), 503)
    raw.execute("ALTER TABLE away RENAME TO alarm")
    raw.close()
    assert setup.get(f"/alarms/{alarm['id']}").json() == alarm


# ------------------------------------------------------------------- operations


def test_probes(setup: Setup) -> None:
    assert setup.http.get("/healthz").json() == {"ok": True, "reasons": []}
    assert setup.http.get("/readyz").json() == {"ok": True, "reasons": []}
    setup.service.is_ready = (False, ["feeder village has no design"])
    body = is_problem(setup.http.get("/readyz"), 503)
    assert (body["ok"], body["reasons"]) == (False, ["feeder village has no design"])
    assert [setup.http.head(path).status_code for path in ("/healthz", "/readyz")] == [200, 503]
    setup.service.is_healthy = (False, ["the runtime task has ended"])
    assert is_problem(setup.http.get("/healthz"), 503)["reasons"] == ["the runtime task has ended"]


def test_not_ready_while_the_store_cannot_be_written(
    monkeypatch: pytest.MonkeyPatch,
    village: type,
    small_service: Callable[..., Any],
    serve: Callable[..., Any],
) -> None:
    monkeypatch.setattr(connect, "BUSY_S", 0.2)
    service = small_service(village())
    server = serve(service)
    blocker = sqlite3.connect(service.store.name.removeprefix("sqlite:///"), isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    response = httpx.get(f"{server.url}/readyz")
    (reason,) = is_problem(response, 503)["reasons"]
    assert "(database-locked)" in reason
    assert "sqlite" not in reason
    blocker.execute("ROLLBACK")
    blocker.close()
    assert httpx.get(f"{server.url}/readyz").status_code == 200


def test_metrics_and_bad_readings(setup: Setup) -> None:
    response = setup.http.get("/metrics")
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert "gridsec_up 1.0" in response.text
    setup.service.store.commit(rejected=[Rejected(T0, "gridsec/x", "no JSON", b"\xff{")])
    (one,) = models.RejectedReadings.model_validate(setup.get("/bad-readings").json()).readings
    assert (one.key, one.reason, one.payload) == ("gridsec/x", "no JSON", "\ufffd{")


def test_the_description_tells_of_problems(setup: Setup) -> None:
    schema = setup.get("/openapi.json").json()
    operations = [op for path in schema["paths"].values() for op in path.values()]
    assert len(operations) == 48
    for operation in operations:
        assert list(operation["responses"]["default"]["content"]) == ["application/problem+json"]
        assert "422" not in operation["responses"]
        assert operation["description"]
    # Every reference leads somewhere.
    references = {part.split('"')[0] for part in json.dumps(schema).split("#/components/schemas/")[1:]}
    assert references <= set(schema["components"]["schemas"])


def test_the_page_allows_no_foreign_code(setup: Setup) -> None:
    response = setup.http.get("/")
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    policy = dict(
        part.strip().split(" ", 1) for part in response.headers["content-security-policy"].split(";")
    )
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "://" not in response.text
    again = setup.http.get("/", headers={"If-None-Match": response.headers["etag"]})
    assert again.status_code == 304
