"""Decisions of the forwarder: ids, scope, feeders during a take-over, slots."""

from __future__ import annotations

import asyncio
import gc
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request
from starlette.responses import Response

from service.access.identity import Identity, Role
from service.alarms.state_machine import AlarmUnknown
from service.cluster import forward as module
from service.cluster.forward import Forwarder, Workers, get
from service.cluster.messages import Caller, Envelope, rest_key
from service.errors import NoOwner, WorkerBusy
from service.store import Store
from service.store.store import Reader
from tests.codes import refused
from tests.service.stored import an_alarm, raised

ALARM = an_alarm()
BULK = "/api/v1/alarms/ack"
ADA = Identity("Ada", Role.OPERATOR, frozenset({ALARM.feeder}), "key 7")
EVE = Identity("Eve", Role.OPERATOR, frozenset({"town"}), "key 8")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(f"sqlite:///{tmp_path}/g.db") as made:
        made.commit([raised(ALARM)])
        yield made


async def nothing() -> None:
    pass


def forwarder(store: Reader) -> Forwarder:
    """A forwarder without workers."""
    envelope = Envelope(b"secret")
    return Forwarder(Workers(), store, Caller(lambda *_: [], envelope), names=dict, refresh=nothing)


def forwarded(
    made: Forwarder, method: str, path: str, who: Identity, *, route: str = "", body: Any = None, **ids: str
) -> Response | None:
    scope = {"type": "http", "method": method, "path": path, "query_string": b"", "headers": []}
    request = Request({**scope, "path_params": ids})
    return asyncio.run(made(request, who, f"{method} {route or path}", json.dumps(body).encode()))


def on_alarm(made: Forwarder, number: str, who: Identity) -> Response | None:
    path = f"/api/v1/alarms/{number}/ack"
    return forwarded(made, "POST", path, who, route="/api/v1/alarms/{alarm_id}/ack", alarm_id=number)


WRONG = ["", "a" * 26, "0" * 25, "0" * 27, "0" * 25 + "\n", "0" * 100_000]


@pytest.mark.parametrize("number", WRONG, ids=range(len(WRONG)))
def test_invalid_ids_are_not_looked_up(number: str) -> None:
    # Every look-up fails.
    made = forwarder(object.__new__(Reader))
    assert forwarded(made, "POST", BULK, ADA, body={"alarms": [number]}) is None
    assert forwarded(made, "POST", "/api/v1/shelves", ADA, body={"alarm": number}) is None
    assert on_alarm(made, number, ADA) is None


@pytest.mark.parametrize("count", [0, 1001])
def test_bulk_commands_have_a_limit(count: int) -> None:
    made = forwarder(object.__new__(Reader))
    assert forwarded(made, "POST", BULK, ADA, body={"alarms": [ALARM.id] * count}) is None


def test_a_missing_owner_is_told_within_the_scope_only(store: Store) -> None:
    made, bulk = forwarder(store), {"alarms": [ALARM.id]}
    with refused(NoOwner, "no-owner"):
        on_alarm(made, ALARM.id, ADA)
    with refused(NoOwner, "no-owner"):
        forwarded(made, "POST", BULK, ADA, body=bulk)
    # The front itself answers that the alarm is not known.
    assert on_alarm(made, ALARM.id, EVE) is None
    with refused(AlarmUnknown, "unknown-alarm"):
        forwarded(made, "POST", BULK, EVE, body=bulk)


def test_a_busy_worker_does_not_block_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FORWARDS", 1)
    monkeypatch.setattr(module, "SLOT_S", 0.05)
    ended = threading.Event()

    def ask(key: str, _message: bytes, _limit_s: float) -> list[bytes]:
        if key == rest_key("slow"):
            ended.wait(5.0)
        return []

    envelope = Envelope(b"secret")
    made = Forwarder(Workers(), object.__new__(Reader), Caller(ask, envelope), names=dict, refresh=nothing)

    async def run() -> None:
        slow = asyncio.create_task(made.ask_worker("slow", get("/healthz")))
        await asyncio.sleep(0)
        with refused(WorkerBusy, "worker-busy"):
            await made.ask_worker("slow", get("/healthz"))
        assert await made.ask_worker("fast", get("/healthz")) is None
        ended.set()
        assert await slow is None
        assert await made.ask_worker("slow", get("/healthz")) is None

    asyncio.run(run())
    gc.collect()  # cycles of the error
    assert dict(made._slots) == {}
