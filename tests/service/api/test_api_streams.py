"""Streams of alarms and states over HTTP."""

from __future__ import annotations

import json
import socket
import sqlite3
import time

import fastapi.routing
import pytest

from gridsec.interface import Cause
from service.alarms.state_machine import AlarmTransition, Change
from service.report.report import to_json as report_json
from tests.service.asking import T0, Setup, Stream, is_problem
from tests.service.running import PATIENCE_S, until


def test_alarms_arrive_as_they_happen(setup: Setup) -> None:
    stream = Stream(setup, "/alarms/stream")
    assert stream.response.headers["content-type"].startswith("text/event-stream")
    assert stream.next() == {"comment": "connected", "id": "0", "retry": "2000"}
    setup.attack()
    event = stream.next()
    assert json.loads(event["data"])["alarm"].items() <= setup.one().items()
    setup.http.post(f"/api/v1/alarms/{setup.one()['id']}/ack", json={"who": "Ada"})
    assert stream.alarms(1) == [(2, "acknowledged")]
    setup.calm(T0 + 10)
    assert stream.alarms(1) == [(3, "cleared")]
    stream.close()


def test_a_client_that_comes_back_misses_nothing(setup: Setup) -> None:
    setup.attack()
    stream = Stream(setup, "/alarms/stream?after=0")
    assert stream.alarms(1) == [(1, "raised")]
    stream.close()
    for k in range(1, 4):
        setup.calm(T0 + 1000 * k)
        setup.attack(T0 + 1000 * k + 20)
    again = Stream(setup, "/alarms/stream?after=0", **{"Last-Event-ID": "1"})
    expected = [(n, "cleared" if n % 2 == 0 else "raised") for n in range(2, 8)]
    assert again.alarms(6) == expected
    again.close()


def test_a_number_from_another_database_begins_now(setup: Setup) -> None:
    setup.attack()
    stream = Stream(setup, "/alarms/stream", **{"Last-Event-ID": "999999999999999999999"})
    assert stream.next()["id"] == "1"
    setup.calm(T0 + 10)
    assert stream.alarms(1) == [(2, "cleared")]
    stream.close()


def test_a_stream_of_one_feeder(setup: Setup) -> None:
    stream = Stream(setup, "/alarms/stream?feeder=town")
    setup.attack()
    town = setup.service.villages["town"]
    for k in range(4):
        setup.service.tick(town.report(T0 + k, lies={"H1": 9.0}))
    assert stream.alarms(1) == [(2, "raised")]
    stream.close()


def test_states_arrive_and_begin_with_the_latest(setup: Setup) -> None:
    setup.attack(ticks=3)
    stream = Stream(setup, "/feeders/village/stream")
    assert stream.next()["comment"] == "connected"
    first = stream.next()
    assert first["event"] == "state"
    told = json.loads(first["data"])
    assert 0.0 <= told.pop("age_s") < 20.0
    assert told == report_json(setup.service.report("village")) | {"owner": None, "epoch": None}
    setup.calm(T0 + 5, 1)
    assert json.loads(stream.next()["data"])["t"] == T0 + 5
    stream.close()


def test_a_quiet_stream_has_a_heartbeat(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fastapi.routing, "_PING_INTERVAL", 0.1)
    stream = Stream(setup, "/alarms/stream")
    assert [stream.next()["comment"] for _ in range(3)] == ["connected", "ping", "ping"]
    stream.close()


def test_a_slow_client_costs_nothing_and_loses_nothing(setup: Setup) -> None:
    setup.attack()
    alarm = setup.service.books["village"].active[0]
    transition = AlarmTransition(alarm, Change.RAISED, T0, None, "x" * 60_000)
    with socket.create_connection(("127.0.0.1", setup.server.port)) as client:
        client.sendall(b"GET /api/v1/alarms/stream?after=1 HTTP/1.1\r\nHost: x\r\n\r\n")
        until(lambda: setup.service.queues, "the stream")
        for _ in range(20):  # 18 MB for a client that reads nothing, more than the sockets hold
            setup.service.store.commit([transition] * 15)
            setup.service.wake({"type": "alarm", "data": None})
            assert setup.http.get("/healthz", timeout=5).status_code == 200
        assert max(queue.qsize() for queue in setup.service.queues) <= 8
        client.settimeout(20)
        data = b""
        while data.count(b"\nid: ") < 301:
            data += client.recv(1 << 20)
    seen = [int(line[4:]) for line in data.split(b"\n") if line.startswith(b"id: ")]
    assert seen == list(range(1, 302))


def test_streams_are_counted(setup: Setup) -> None:
    setup.server.api.state.max_streams = 2
    one, two = Stream(setup, "/alarms/stream"), Stream(setup, "/feeders/village/stream")
    assert one.next()["comment"] == two.next()["comment"] == "connected"
    is_problem(setup.get("/alarms/stream"), 503)
    two.close()
    deadline = time.monotonic() + PATIENCE_S
    while True:
        third = Stream(setup, "/alarms/stream")
        if third.response.status_code == 200:
            break
        third.close()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert third.next()["comment"] == "connected"
    third.close()
    one.close()


def test_streams_end_when_the_service_stops(setup: Setup) -> None:
    stream = Stream(setup, "/alarms/stream")
    assert stream.next()["comment"] == "connected"
    until(lambda: setup.service.queues, "the stream")
    begun = time.perf_counter()
    setup.server.stop()
    assert stream.next() == {"end": "true"}
    assert time.perf_counter() - begun < 5
    assert setup.service.queues == set()
    stream.close()


def test_a_stream_gives_way_when_the_store_fails(setup: Setup) -> None:
    stream = Stream(setup, "/alarms/stream")
    assert stream.next()["comment"] == "connected"
    raw = sqlite3.connect(setup.service.store.name.removeprefix("sqlite:///"))
    setup.attack(ticks=2)
    setup.service.queues, quiet = set(), setup.service.queues
    setup.attack(T0 + 2, ticks=1)
    raw.execute("ALTER TABLE event RENAME TO away")
    setup.service.queues = quiet
    setup.service.wake({"type": "alarm", "data": None})
    assert stream.next() == {"end": "true"}
    raw.execute("ALTER TABLE away RENAME TO event")
    raw.close()
    again = Stream(setup, "/alarms/stream", **{"Last-Event-ID": "0"})
    assert again.alarms(1) == [(1, "raised")]
    again.close()
    stream.close()


def test_undecided_is_shown_as_such(setup: Setup) -> None:
    setup.attack(ticks=1, lies={}, cause=Cause.AMBIGUOUS)
    state = setup.get("/feeders/village/state").json()
    assert (state["verdict"], state["cause"]) == ("undecided", "ambiguous")
