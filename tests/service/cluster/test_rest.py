"""Requests from a front to a worker: real zenoh, the real HTTP application, a small service."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from starlette.requests import Request

from service.access.identity import OPEN, Identity, Role
from service.api.routes import create_api
from service.cluster.forward import Forwarder, Workers, get
from service.cluster.messages import (
    Call,
    Caller,
    CallServer,
    Entry,
    Envelope,
    RestCalls,
    WorkerState,
    rest_key,
)
from service.errors import NoOwner
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import Bus
from service.store import OutcomeUnknown
from service.store.leases import shard_of
from tests.codes import refused
from tests.service.asking import LIE, T0
from tests.service.conftest import SmallService, Village
from tests.service.running import free_port, until

JSON = (("content-type", "application/json"),)
ADA = Identity("Ada", Role.OPERATOR, frozenset({"village"}), "key 7")


def bus(config: BusConfig) -> Bus:
    return Bus(config, "gridsec", lambda _: None, max_payload=1000, lossless=False, everything=False)


class Pair:
    """A worker `w0` with a small service, and the way to it."""

    def __init__(self, service: SmallService, worker: Bus, front: Bus) -> None:
        self.service = service
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.key = rest_key("w0")
        envelope = Envelope(b"secret")
        take = RestCalls(create_api(service)).take
        worker.serve(self.key, CallServer(self.key, envelope, self.loop, take))
        self.front, self.envelope = front, envelope
        self.workers = Workers()
        self.worker = worker
        self.names: set[str] = set()
        self.messages = 0
        self.forwarder = Forwarder(
            self.workers,
            service.store,
            Caller(front.ask, envelope),
            names=lambda: dict.fromkeys(self.names),
            refresh=self.refresh,
        )

    def report(self, *feeders: str) -> None:
        """State of the worker: the leases of `village` and `farm`, and entries of taken-over feeders."""
        shards = {shard_of(name): 1 for name in ("village", "farm")}
        entries = {name: Entry({"name": name}, {}) for name in feeders}
        self.messages += 1
        state = WorkerState("w0", (1, self.messages), shards, entries, 0, None, ())
        self.workers.take(state)

    def status(self, feeder: str) -> int:
        """Status of a forwarded read of a feeder."""
        path, route = f"/api/v1/feeders/{feeder}", "GET /api/v1/feeders/{feeder}"
        scope = {"type": "http", "method": "GET", "path": path, "query_string": b"", "headers": []}
        request = Request({**scope, "path_params": {"feeder": feeder}})
        answer = asyncio.run(self.forwarder(request, OPEN, route, b""))
        assert answer is not None
        return answer.status_code

    async def refresh(self) -> None:
        pass

    def ask(self, call: Call) -> tuple[int, dict[str, object]]:
        answer = self.forwarder.ask_blocking("w0", call, 5.0)
        assert answer is not None
        return answer.status, json.loads(answer.body)

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(5.0)
        self.loop.close()


@pytest.fixture
def pair(small_service: Callable[..., SmallService]) -> Iterator[Pair]:
    end = f"tcp/127.0.0.1:{free_port()}"
    with bus(BusConfig(listen=(end,))) as front, bus(BusConfig("client", connect=(end,))) as worker:
        made = Pair(small_service(Village(), Village("town")), worker, front)
        until(lambda: list(front.ask(made.key, b"", 5.0)), "the declaration of the worker at the front")
        yield made
        made.close()


def test_a_worker_answers_as_its_own_http_would(pair: Pair) -> None:
    status, body = pair.ask(get("/api/v1/feeders/village/state"))
    assert (status, body["instance"]) == (503, "/api/v1/feeders/village/state")
    village = pair.service.villages["village"]
    for k in range(4):
        pair.service.tick(village.report(T0 + k, lies=LIE))
    status, body = pair.ask(get("/api/v1/feeders/village/state"))
    assert (status, body["verdict"], body["t"]) == (200, "attacked", T0 + 3)
    status, body = pair.ask(get("/api/v1/feeders", "limit=1&colour=red"))
    assert status == 422


def test_the_identity_of_the_front_counts(pair: Pair) -> None:
    village = pair.service.villages["village"]
    for k in range(4):
        pair.service.tick(village.report(T0 + k, lies=LIE))
    (alarm,), _ = pair.service.store.alarms()

    def acknowledge(identity: Identity, body: dict[str, str]) -> tuple[int, dict[str, object]]:
        path = f"/api/v1/alarms/{alarm.id}/ack"
        return pair.ask(Call("POST", path, "", JSON, json.dumps(body).encode(), identity))

    stranger = Identity("Eve", Role.OPERATOR, frozenset({"town"}), "key 8")
    assert acknowledge(stranger, {"comment": ""})[0] == 404
    assert acknowledge(OPEN, {"comment": ""})[0] == 422
    status, body = acknowledge(ADA, {"comment": "seen"})
    assert (status, body["acknowledged_by"]) == (200, "Ada")


def test_without_the_secret_nothing_is_executed_or_believed(pair: Pair) -> None:
    call = get("/api/v1/feeders")
    forged = Envelope(b"guess").seal(f"call {pair.key}", call.content())
    assert list(pair.front.ask(pair.key, forged, 5.0)) == [b""]
    message = pair.envelope.seal(f"call {pair.key}", call.content())
    (first,) = pair.front.ask(pair.key, message, 5.0)
    assert first
    # A repetition is not executed.
    assert list(pair.front.ask(pair.key, message, 5.0)) == [b""]


def test_a_feeder_is_not_absent_during_its_take_over(pair: Pair) -> None:
    pair.names = {"village", "farm"}
    pair.report("village")
    assert pair.status("village") == 200
    with refused(NoOwner, "no-owner"):
        pair.status("farm")
    pair.names.remove("farm")
    assert pair.status("farm") == 404


def test_a_worker_that_is_gone_gives_no_answer(pair: Pair) -> None:
    assert pair.forwarder.ask_blocking("w1", get("/healthz"), 5.0) is None


def test_a_request_does_not_outlast_its_owner(pair: Pair) -> None:
    workers = Workers()

    def report(worker: str, epoch: int) -> None:
        state = WorkerState(worker, (1, epoch), {shard_of("village"): epoch}, {}, 0, None, ())
        workers.take(state)

    unanswered: list[Callable[[bytes], None]] = []
    pair.worker.serve(rest_key("deaf"), lambda _, respond: unanswered.append(respond))
    forwarder = Forwarder(
        workers, pair.service.store, Caller(pair.front.ask, pair.envelope), names=dict, refresh=pair.refresh
    )

    async def ask(method: str) -> None:
        report("deaf", 1)
        asked = asyncio.create_task(
            forwarder.ask("village", replace(get("/api/v1/feeders"), method=method), 5.0)
        )
        await asyncio.sleep(0.2)
        assert not asked.done()
        report("gone", 2)
        await asked

    with refused(NoOwner, "no-owner"):
        asyncio.run(ask("GET"))
    workers = Workers()
    forwarder._workers = workers
    with refused(OutcomeUnknown, "outcome-unknown"):
        asyncio.run(ask("POST"))
