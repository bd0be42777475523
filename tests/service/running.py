"""A running service for tests: in this process with a thread of its own, on free ports."""

from __future__ import annotations

import asyncio
import json
import random
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from service.app import Running, serve
from service.ingest.queues import BusConfig, BusCounts, Value
from service.ingest.zenoh_bus import MeterClient
from service.settings import settings

FEEDER = "simbench-lv-rural1"
PATIENCE_S = 60.0

DESIGNING = "design of the monitor is not finished"
"""Part of a reason of `/readyz`."""


def free_port() -> int:
    """Return a port that is free and stays free: below those that the system hands out by itself."""
    for _ in range(100):
        port = random.SystemRandom().randrange(12_000, 32_000)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError("no free port")


def until(condition: Callable[[], Any], what: str = "it", patience_s: float = PATIENCE_S) -> Any:
    """Return the first truthy value of a condition."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    raise AssertionError(f"{what} did not happen within {patience_s:g} s")


class Outlet:
    """Keeps what is published; confirms it at once, or when told to."""

    def __init__(self, *, confirms: bool = True) -> None:
        self.failure: str | None = None
        self.counts = BusCounts()
        self.estimates: list[dict[str, Any]] = []
        self.events: list[tuple[dict[str, Any], bool]] = []
        self.incidents: list[tuple[dict[str, Any], bool]] = []
        self.answers: list[str] = []
        self.withdrawn: list[str] = []
        self.confirms = confirms
        self.followed: set[str] = set()

    def follow(self, feeder: str) -> None:
        self.followed.add(feeder)

    def unfollow(self, feeder: str) -> None:
        self.followed.remove(feeder)

    def discard(self, feeders: Collection[str]) -> None:
        self.discarded = feeders

    def telemetry(self, key: str, payload: Value) -> None:
        assert key == f"{FEEDER}/estimate"
        self.estimates.append(json.loads(payload if isinstance(payload, bytes) else payload()))

    def event(
        self,
        key: str,
        payload: bytes,
        *,
        last: bool,
        number: int,
        done: Callable[[], None] | None = None,
    ) -> bool:
        assert number > 0
        found = json.loads(payload)
        if "incident" in found:
            assert key == f"{FEEDER}/incident/{found['incident']['id']}"
            self.incidents.append((found, last))
        else:
            assert key == f"{FEEDER}/alarm/{found['id']}"
            self.events.append((found, last))
        if self.confirms and done is not None:
            done()
        return True

    def answer(self, key: str, payload: bytes) -> None:
        found = json.loads(payload)
        if "incident" not in found:
            self.answers.append(f"{key} {found['id']}")

    def withdraw(self, feeder: str) -> None:
        self.withdrawn.append(feeder)


class InProcess:
    """A service, an HTTP client of it, and a zenoh client of it."""

    def __init__(self, http: httpx.Client, meters: MeterClient, zenoh: str) -> None:
        self.http, self.meters, self.zenoh = http, meters, zenoh

    def get(self, path: str, **params: Any) -> Any:
        answer = self.http.get(path, params=params)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def state(self, feeder: str = FEEDER) -> dict[str, Any]:
        answer = self.http.get(f"/api/v1/feeders/{feeder}/state")
        return dict(answer.json()) if answer.status_code == 200 else {}

    def alarms(self, **params: Any) -> list[dict[str, Any]]:
        return list(self.get("/api/v1/alarms", **params)["alarms"])

    def rejected(self) -> list[dict[str, Any]]:
        return list(self.get("/api/v1/bad-readings")["readings"])

    def metric(self, name: str, **labels: str) -> float:
        """Return the value of a metric, 0 if it is not there."""
        for line in self.http.get("/metrics").text.splitlines():
            key, _, value = line.rpartition(" ")
            if key.partition("{")[0] == name and all(f'{k}="{v}"' in key for k, v in labels.items()):
                return float(value)
        return 0.0

    def put(self, key: str, payload: object, encoding: str = "application/json") -> None:
        self.meters.put(
            key, payload if isinstance(payload, bytes) else json.dumps(payload).encode(), encoding
        )


@contextmanager
def service(
    folder: Path,
    feeders: Iterable[str] = (FEEDER,),
    *,
    wall: Callable[[], float] = time.time,
    client: BusConfig | None = None,
    **given: Any,
) -> Iterator[InProcess]:
    """Run a service until the block ends. With `client`, the meters' session, it needs `zenoh_config`.

    The block begins after the design of all monitors: the number of UNDECIDED ticks before it depends on
    the machine.
    """
    zenoh = f"tcp/127.0.0.1:{free_port()}"
    chosen = settings(
        {
            "feeders": tuple(feeders),
            "zenoh_listen": (zenoh,) if client is None else (),
            "http": "127.0.0.1:0",
            "database": f"sqlite:///{folder / 'gridsec.db'}",
            **given,
        }
    )
    up = threading.Event()
    found: dict[str, Any] = {}

    def announce(running: Running) -> None:
        found.update(running=running, loop=asyncio.get_running_loop())
        up.set()

    def run() -> None:
        try:
            asyncio.run(serve(chosen, announce=announce, signals=False, wall=wall))
        except Exception as error:  # noqa: BLE001 - handed over to the test
            found["error"] = error
            up.set()

    thread = threading.Thread(target=run, name="service under test")
    thread.start()
    try:
        assert up.wait(PATIENCE_S)
        if "error" in found:
            raise found["error"]
        config = client or BusConfig("client", connect=(zenoh,))
        with (
            httpx.Client(base_url=found["running"].url, timeout=10.0) as http,
            MeterClient(config, chosen.prefix) as meters,
        ):
            until(lambda: DESIGNING not in http.get("/readyz").text, "the design of the monitors")
            yield InProcess(http, meters, zenoh)
    finally:
        if "loop" in found:
            found["loop"].call_soon_threadsafe(found["running"].stop)
        thread.join(timeout=PATIENCE_S)
        assert not thread.is_alive()
    if "error" in found:
        raise found["error"]
