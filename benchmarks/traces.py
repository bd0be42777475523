"""Files that a trip through the program enters, and changes from file to file on the way.

    python -m benchmarks.traces

Trips: ticks of 14 samples from zenoh to an alarm in REST; a calm frame and a frame that names two meters in
the default monitor; a feeder's folder to a `Site`, and that to a design; `gridsec study campaign` with four
scenarios. Columns: files of the three packages that are entered, functions, and calls into another file than
the last call of the same thread. Only functions called at run time count: not bodies of modules and classes,
nor calls made while a module is imported.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

# Before NumPy loads its libraries.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import httpx
import numpy as np

from benchmarks._arguments import arguments
from feeders.model.site import Snapshot, load, to_frame
from feeders.registry import design
from feeders.simulation.scenario import Scenario, random_attacks, simulate
from service.app import Running, serve
from service.cli.main import main as gridsec
from service.cli.simulate import Pace, play
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from service.settings import settings

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = tuple(str(ROOT / name) + os.sep for name in ("gridsec", "feeders", "service"))
FEEDER = "simbench-lv-rural1"
"""13 meters; with the busbar's, a tick has 14 samples."""
ONSET_S, WARM_S, ATTACKED, SIZE_PU = 100.0, 90.0, 2, 0.05
"""Begin of the manipulation and of the trace, s; manipulated meters; their least deviation, pu."""
PATIENCE_S, ALARMS = 60.0, "/api/v1/alarms"
START = 1_750_000_000.0


@dataclass(slots=True)
class Trip:
    """Calls of all threads while the trace is on."""

    files: Counter[str] = field(default_factory=Counter)
    functions: set[CodeType] = field(default_factory=set)
    changes: int = 0
    on: bool = False
    last: dict[int, str] = field(default_factory=dict)
    imports: Counter[int] = field(default_factory=Counter)  # modules being imported, by thread

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Count one call; the signature is that of `sys.setprofile`."""
        code, thread = frame.f_code, threading.get_ident()
        if code.co_name == "<module>" and event in ("call", "return"):
            self.imports[thread] += 1 if event == "call" else -1
        if not self.on or event != "call" or not code.co_filename.startswith(PACKAGES):
            return
        # Bodies of modules and classes are not optimised code; calls below a module body are its import.
        if not code.co_flags & CO_OPTIMIZED or self.imports[thread] > 0:
            return
        name = code.co_filename
        self.files[name] += 1
        self.functions.add(code)
        self.changes += self.last.get(thread, name) != name
        self.last[thread] = name

    @contextmanager
    def traced(self) -> Iterator[None]:
        """Trace this thread until the block ends."""
        sys.setprofile(self)
        try:
            yield
        finally:
            sys.setprofile(None)

    @contextmanager
    def traced_threads(self) -> Iterator[None]:
        """Trace the threads that start before the block ends."""
        threading.setprofile(self)
        try:
            yield
        finally:
            threading.setprofile(None)

    def row(self, name: str) -> str:
        """Return the row of the table."""
        return f"| {name} | {len(self.files)} | {len(self.functions)} | {self.changes} |"


def of(run: Callable[[], object]) -> Trip:
    """Return the trip of a function."""
    trip = Trip(on=True)
    with trip.traced():
        run()
    return trip


def sample_to_alarm() -> Trip:
    """Return the trip of one tick, from zenoh to `GET /api/v1/alarms`."""
    trip, found, up = Trip(), {}, threading.Event()

    def announce(running: Running) -> None:
        found.update(running=running, loop=asyncio.get_running_loop())
        up.set()

    with tempfile.TemporaryDirectory() as folder, socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        zenoh = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        probe.close()
        given = {"zenoh_listen": (zenoh,), "http": "127.0.0.1:0", "clock": "events"}
        chosen = settings({"feeders": (FEEDER,), "database": f"sqlite:///{folder}/traces.db", **given})
        with trip.traced_threads():
            thread = threading.Thread(
                target=lambda: asyncio.run(serve(chosen, announce=announce, signals=False))
            )
            thread.start()
            try:
                if not up.wait(PATIENCE_S):
                    raise RuntimeError("the service does not start")
                with httpx.Client(base_url=found["running"].url, timeout=10.0) as http:
                    _until(lambda: http.get("/readyz").json()["ok"])
                    with MeterClient(BusConfig("client", connect=(zenoh,)), chosen.prefix) as meters:
                        _raise_alarm(trip, http, meters)
            finally:
                found["loop"].call_soon_threadsafe(found["running"].stop)
                thread.join()
    return trip


def _raise_alarm(trip: Trip, http: httpx.Client, meters: MeterClient) -> None:
    """Play a manipulation in step with the service; trace from its onset to the alarm in REST."""
    site = load(FEEDER)
    quiet = Scenario(seed=1, start=START, duration_s=float("inf"), dt_s=site.tables.meta.monitor.tick_s)
    attacks = random_attacks(
        site, 1, "bias", ATTACKED, SIZE_PU, t_on=START + ONSET_S, t_off=START + 1e6, scenario=quiet
    )
    scenario = Scenario(seed=1, start=START, duration_s=float("inf"), dt_s=quiet.dt_s, attacks=attacks)
    with contextlib.closing(play(site, scenario, meters, Pace(speed=float("inf"), ahead=2))) as samples:
        for sample in samples:
            trip.on = sample.t - START >= ONSET_S
            if trip.on and any(a["kind"] == "meter-manipulated" for a in http.get(ALARMS).json()["alarms"]):
                break
    trip.on = False


def _until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError("the service is not ready")
        time.sleep(0.05)


def frames() -> tuple[Trip, Trip]:
    """Return the trips of a calm frame and of the frame that names two meters."""
    site = load(FEEDER)
    watcher = design(site)
    quiet = Scenario(seed=1, start=START, duration_s=ONSET_S + 60.0, dt_s=1.0)
    attacks = random_attacks(
        site, 1, "bias", ATTACKED, SIZE_PU, t_on=START + ONSET_S, t_off=START + 1e6, scenario=quiet
    )
    scenario = Scenario(seed=1, start=START, duration_s=ONSET_S + 60.0, dt_s=1.0, attacks=attacks)
    state, calm = watcher.init(START - 1.0), Trip()
    for sample in simulate(site, scenario):
        voltages = {reading.meter: reading for reading in sample.readings}
        row = [voltages[meter] for meter in site.meter_ids]
        busbar = next(r for r in sample.readings if r.meter not in site.meter_ids)
        v, p, q = (
            np.array([np.nan if x is None else x for x in column])
            for column in zip(*((r.v_volt, r.p_kw, r.q_kvar) for r in row), strict=True)
        )
        frame = to_frame(site, Snapshot(sample.t, v, p, q, busbar.v_volt))
        trip = Trip(on=True)
        with trip.traced():
            state, _, verdict = watcher.step(state, frame)
        if sample.t - START == WARM_S:
            calm = trip
        if np.count_nonzero(verdict.suspects) >= ATTACKED:
            return calm, trip
    raise RuntimeError("the manipulation is not named")


def campaign() -> Trip:
    """Return the trip of the command, in this process and without its own output."""

    def run() -> None:
        before, sys.argv = (
            sys.argv,
            ["gridsec", "study", "campaign", FEEDER, "--scenarios", "4", "--workers", "1"],
        )
        with (
            open(os.devnull, "w") as sink,
            contextlib.redirect_stdout(sink),
            contextlib.redirect_stderr(sink),
        ):
            try:
                gridsec()
            except SystemExit as end:
                if end.code:
                    raise RuntimeError(f"exit code {end.code}") from end
            finally:
                sys.argv = before

    return of(run)


def main() -> int:
    """Print the table."""
    print("| trip | files | functions | changes of file |\n|---|---|---|---|")
    print(sample_to_alarm().row("samples to GET /alarms"), flush=True)
    calm, names = frames()
    print(calm.row("calm frame"))
    print(names.row("frame that names two meters"), flush=True)
    loaded = of(lambda: load(FEEDER))
    site = load(FEEDER)
    print(loaded.row("folder to site"))
    print(of(lambda: design(site)).row("site to design"), flush=True)
    print(campaign().row("study campaign, 4 scenarios"))
    return 0


if __name__ == "__main__":
    arguments(__doc__)
    sys.exit(main())
