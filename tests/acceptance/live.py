"""The real service as a process of its own, and a meter fleet that talks to it over zenoh.

Nothing of the service is used from inside: what these tests use is what an integrator has, zenoh keys, JSON
and HTTP.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import httpx
import zenoh

from feeders.simulation.scenario import SimulatedReading
from tests.service.running import free_port

START_S = 60.0
ECHO_S = 30.0


class Tick(Protocol):
    """What is reported at one tick."""

    @property
    def t(self) -> float: ...

    @property
    def readings(self) -> Iterable[SimulatedReading]: ...


T = TypeVar("T", bound=Tick)


@dataclass
class Live:
    """A running service."""

    feeder: str
    zenoh_port: int
    http: httpx.Client
    process: subprocess.Popen[bytes]
    log: Path

    def get(self, path: str, **params: Any) -> Any:
        answer = self.http.get(path, params=params)
        answer.raise_for_status()
        return answer.json()

    def alarms(self, **params: Any) -> list[dict[str, Any]]:
        """Every alarm, over all pages."""
        found: list[dict[str, Any]] = []
        cursor: str | None = None
        for _ in range(100):
            page = self.get(
                "/api/v1/alarms", **params, limit=100, **({} if cursor is None else {"cursor": cursor})
            )
            found += page["alarms"]
            cursor = page["next"]
            if cursor is None:
                return found
        raise AssertionError("the list of alarms does not end")

    def await_state(self, good: Callable[[Any], bool]) -> Any:
        """The feeder's state once it is good."""
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            answer = self.http.get(f"/api/v1/feeders/{self.feeder}/state")
            if answer.status_code == 200 and good(answer.json()):
                return answer.json()
            time.sleep(0.05)
        raise AssertionError(f"the state never was as expected: {answer.text[:2000]}")


@contextmanager
def serve(feeder: str, folder: Path, *options: str, clock: str = "events") -> Iterator[Live]:
    """Run `gridsec serve` for one feeder, by default with time told by the readings, until the block ends."""
    zenoh_port, http_port = free_port(), free_port()
    base = f"http://127.0.0.1:{http_port}"
    command = [
        str(Path(sys.executable).parent / "gridsec"),
        "serve",
        "--feeder",
        feeder,
        "--zenoh-listen",
        f"tcp/127.0.0.1:{zenoh_port}",
        "--http",
        f"127.0.0.1:{http_port}",
        "--database",
        f"sqlite:///{folder / 'alarms.db'}",
        "--clock",
        clock,
        *options,
    ]
    log = folder / "service.log"
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with log.open("wb") as out, httpx.Client(base_url=base, timeout=10.0) as http:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment)
        try:
            _await_ready(process, http, log)
            yield Live(feeder, zenoh_port, http, process, log)
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=15.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise AssertionError(f"the service did not stop:\n{log.read_text()[-3000:]}") from None


def _await_ready(process: subprocess.Popen[bytes], http: httpx.Client, log: Path) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        if process.poll() is not None:
            raise AssertionError(f"the service ended by itself:\n{log.read_text()[-3000:]}")
        try:
            if http.get("/readyz").status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.05)
    raise AssertionError(f"the service was not ready in {START_S} s:\n{log.read_text()[-3000:]}")


class Fleet:
    """All meters of a feeder as one zenoh client, which also listens to what the service says of them."""

    def __init__(self, live: Live) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{live.zenoh_port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")
        self.feeder = live.feeder
        self.session = zenoh.open(config)
        self.estimates = self.session.declare_subscriber(
            f"gridsec/{live.feeder}/estimate", zenoh.handlers.FifoChannel(4096)
        )

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def put(self, reading: SimulatedReading) -> None:
        where = f"meter/{reading.meter}" if reading.meter else "substation"
        values = {
            "t": reading.t,
            "seq": reading.seq,
            "v_volt": reading.v_volt,
            "p_kw": reading.p_kw,
            "q_kvar": reading.q_kvar,
        }
        self.session.put(
            f"gridsec/{self.feeder}/{where}/reading",
            json.dumps({k: v for k, v in values.items() if v is not None}),
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def play(self, samples: Iterable[T]) -> Iterator[tuple[T, dict[str, Any]]]:
        """Publish tick by tick, each once the estimate of the one before has been heard."""
        for sample in samples:
            for reading in sample.readings:
                self.put(reading)
            yield sample, self._estimate_at(sample.t)

    def pour(self, samples: Sequence[Tick], ahead: int = 4) -> list[dict[str, Any]]:
        """Publish many ticks, some ahead of what has been heard, and return their states, up to the last one.

        Not all at once: estimates are dropped beyond the 64 KiB that the sockets hold. The last tick
        must be complete: where the readings tell the time, an incomplete one stays open.
        """
        states = []
        for number, sample in enumerate(samples):
            for reading in sample.readings:
                self.put(reading)
            if number >= ahead:
                states.append(self._estimate_at(samples[number - ahead].t))
        return states + [self._estimate_at(sample.t) for sample in samples[len(states) :]]

    def first(self, good: Callable[[Any], bool]) -> Any:
        """The first good state of those that have been said since the last one that was asked for."""
        end = time.monotonic() + ECHO_S
        while time.monotonic() < end:
            heard = self.estimates.try_recv()
            if heard is None:
                time.sleep(0.01)
            elif good(state := json.loads(heard.payload.to_bytes())):
                return state
        raise AssertionError(f"no such state was heard in {ECHO_S} s")

    def _estimate_at(self, t: float) -> dict[str, Any]:
        end = time.monotonic() + ECHO_S
        while time.monotonic() < end:
            heard = self.estimates.try_recv()
            if heard is None:
                time.sleep(0.0002)
                continue
            state: dict[str, Any] = json.loads(heard.payload.to_bytes())
            assert state["t"] <= t, "an estimate is missing"
            if state["t"] == t:
                return state
        raise AssertionError(f"no estimate for {t} in {ECHO_S} s")
