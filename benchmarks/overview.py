"""List of feeders over HTTP and on the page, for several numbers of feeders.

    python -m benchmarks.overview [feeders ...] [--page]

Every feeder is the network simbench-lv-rural1 with its own name, a monitor and a real report: steps of its
estimator on full AC power flow. One in fifty has two manipulated meters. HTTP application, store
(SQLite), routes and monitors are those of the service. Printed per number of feeders, medians of 15 requests
over a real connection, gzip included:

- all: `GET /feeders`, time and size of the JSON;
- page: `GET /feeders?order=worst&limit=50`, the request of the web page;
- numbers: `GET /feeders?limit=0`, the request by which the page follows verdicts;
- ratio: of the first two times.

With `--page` a browser (Chromium) shows them. Printed besides: time from the navigation to the first
contentful paint and to the first row of the list (medians of 3), time from a stored verdict to its number
above the list (median of 5), time of a scroll step with layout (median of 20), and the number of elements.
"""

from __future__ import annotations

import asyncio
import math
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import AsyncGenerator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import uvicorn

from benchmarks._arguments import arguments
from feeders import registry
from feeders.model.site import Site, load
from feeders.simulation.attacks import AttackKind, AttackSpec, manipulations
from feeders.simulation.scenario import Scenario, SimulatedTick, simulate
from service.alarms.state_machine import AlarmBook
from service.api.routes import create_api
from service.engine.feeder_monitor import FeederMonitor, TickResult, align_rules
from service.engine.runtime import Runtime
from service.ingest.align import Clock, Tick
from service.ingest.reading import Reading
from service.report.report import FeederReport
from service.report.tick_state import TickState
from service.store import Store
from tests.service.ticks import tick_of

FEEDER = "simbench-lv-rural1"
EVERY = 50  # One feeder in as many is attacked.
TICKS = 20  # Ticks of a monitor before the measurement.
REQUESTS = 15
VIEWS, CHANGES = 3, 5  # Measurements in the browser.
HEAD = {"order": "worst", "limit": "50"}  # Request of the web page.
NUMBERS = {"limit": "0"}  # Request of its numbers by verdict.


def ticks_of(site: Site, attack: AttackSpec | None) -> list[Tick]:
    """Readings of a simulated minute, with meter errors, as the service aligns them."""
    scenario = Scenario(seed=3, duration_s=float(TICKS))
    scenario = replace(scenario, attacks=manipulations(site, attack, scenario)[0])
    return [_tick(site.feeder.name, sample) for sample in simulate(site, scenario)]


def _tick(feeder: str, sample: SimulatedTick) -> Tick:
    found = {each.meter: each for each in sample.readings}

    def reading(meter: str) -> Reading | None:
        one = found.get(meter)
        if one is None:
            return None
        p, q = (math.nan if value is None else value for value in (one.p_kw, one.q_kvar))
        return Reading(feeder, meter or None, sample.t, one.v_volt, p, q)

    return tick_of(sample.t, tuple(map(reading, sample.meter_ids)), reading(""), ())


class Fleet:
    """Backend of the HTTP application with `count` feeders; its list is made by the methods of `Runtime`."""

    feeders, feeder, known, unloaded, report, summary = (
        Runtime.feeders,
        Runtime.feeder,
        Runtime.known,
        Runtime.unloaded,
        Runtime.report,
        Runtime.summary,
    )
    shelve_most_s = 86_400.0

    def __init__(self, store: Store, count: int) -> None:
        self.store = store
        site = load(FEEDER)
        finished = registry.design(site)
        self.monitors: dict[str, FeederMonitor] = {}
        for k in range(count):
            name = f"feeder-{k:04d}"
            named = replace(site, feeder=replace(site.feeder, name=name))  # type: ignore[arg-type]
            rules = align_rules(named, Clock.WALL)
            monitor = FeederMonitor(named, rules, AlarmBook(named.feeder.name))
            monitor.install(finished)
            self.monitors[monitor.name] = monitor
        self._engine: Any = SimpleNamespace(monitors=self.monitors, unloaded={})
        self.attacked = ticks_of(site, AttackSpec(AttackKind.BIAS, 2, 4.0, onset_s=0.0))
        clean = self._play(next(iter(self.monitors.values())), ticks_of(site, None))[-1].state
        for k, name in enumerate(self.monitors):
            if k % EVERY == EVERY // 2:
                self.attack(name)
            else:
                self._show(name, replace(clean, site=self.monitors[name].site))
        self.loop: asyncio.AbstractEventLoop | None = None
        self.queues: set[asyncio.Queue[dict[str, Any] | None]] = set()

    def _play(self, monitor: FeederMonitor, ticks: list[Tick]) -> list[TickResult]:
        monitor.pending.extend(ticks)
        return [monitor.judge() for _ in ticks]

    def attack(self, name: str) -> None:
        """Evaluate the attacked readings for a feeder, and store its alarms."""
        self._show(name, None)
        for result in self._play(self.monitors[name], self.attacked):
            self.store.commit(result.transitions, reports=[result.report])

    def tick(self) -> None:
        """Renew the report of every feeder."""
        for name, monitor in self.monitors.items():
            if monitor.latest is not None:
                self._show(
                    name, replace(monitor.latest, tick=replace(monitor.latest.tick, t=monitor.latest.t + 1.0))
                )

    def _show(self, name: str, state: TickState | None) -> None:
        self.monitors[name].latest = state

    def age(self, report: FeederReport | TickState) -> float:
        """Age of a report, s."""
        newest = self.monitors[report.feeder].latest
        return 0.0 if newest is None else newest.t - report.t

    def commissioning(self, name: str) -> Any:
        """Progress of the learning."""
        return self.monitors[name].commissioning.progress()

    def unstored(self) -> tuple[int, str | None]:
        """Waiting alarm changes: none."""
        return 0, None

    async def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        """Wake-ups, until the server stops."""
        queue: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        self.queues.add(queue)
        while (event := await queue.get()) is not None:
            yield event


@contextmanager
def served(fleet: Fleet) -> Iterator[str]:
    """Address of a server in a thread of its own."""
    config = uvicorn.Config(
        create_api(fleet),  # type: ignore[arg-type]  # routes of the benchmark only
        host="127.0.0.1",
        port=0,
        log_level="critical",
        timeout_graceful_shutdown=1,
        lifespan="off",
    )
    server = uvicorn.Server(config)

    async def run() -> None:
        fleet.loop = asyncio.get_running_loop()
        await server.serve()

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        for queue in fleet.queues:
            fleet.loop.call_soon_threadsafe(queue.put_nowait, None)  # type: ignore[union-attr]
        thread.join()


def request(client: httpx.Client, fleet: Fleet, query: dict[str, str]) -> tuple[float, int]:
    """Median time of a request, ms, and the size of its JSON, bytes."""
    times = []
    for _ in range(REQUESTS):
        fleet.tick()
        begun = time.perf_counter()
        answer = client.get("/api/v1/feeders", params=query)
        times.append(1e3 * (time.perf_counter() - begun))
        answer.raise_for_status()
    return statistics.median(times), len(answer.content)


def in_browser(url: str, fleet: Fleet) -> str:
    """Times of the page, in a line."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        options = ["--headless", "--no-sandbox", "--disable-gpu"]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=options)
        first, painted = [], []
        for _ in range(VIEWS):
            page = browser.new_page()
            begun = time.perf_counter()
            page.goto(url, wait_until="commit")
            page.wait_for_selector("#fleet-rows tr")
            first.append(time.perf_counter() - begun)
            painted.append(
                page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
            )
        changes = []
        clean = [name for name, one in fleet.monitors.items() if one.latest and one.latest.verdict == "clean"]
        total = len(fleet.monitors) - len(clean)
        for name in clean[1 : CHANGES + 1]:
            fleet.attack(name)
            total += 1
            begun = time.perf_counter()
            page.wait_for_selector(f'#fleet-counts [data-state="attacked"]:text-is("{total} attacked")')
            changes.append(time.perf_counter() - begun)
        page.locator("#fleet-all summary").click()
        page.wait_for_timeout(500)
        drawn = page.evaluate(
            """() => {
                const box = document.querySelector('#fleet-scroll');
                const times = [];
                for (let k = 0; k < 20; k += 1) {
                    const begun = performance.now();
                    box.scrollTop = 200 * k;
                    box.dispatchEvent(new Event('scroll'));
                    document.body.getBoundingClientRect();
                    times.push(performance.now() - begun);
                }
                return times.sort((a, b) => a - b)[10];
            }"""
        )
        elements = page.evaluate("document.querySelectorAll('*').length")
        browser.close()
    return (
        f"first paint {statistics.median(painted):.0f} ms, "
        f"first rows {1e3 * statistics.median(first):.0f} ms, change shown after "
        f"{statistics.median(changes):.1f} s (at most {max(changes):.1f} s), a scroll step {drawn:.1f} ms, "
        f"{elements} elements"
    )


def main() -> None:
    """Print the times."""
    given = arguments(__doc__, feeders=("100", "1000", "5000"), page=False)
    print(f"{'feeders':>8}{'all, ms':>9}{'kB':>7}{'page, ms':>10}{'kB':>6}{'numbers, ms':>13}{'ratio':>7}")
    for count in map(int, given.feeders):
        with tempfile.TemporaryDirectory() as folder, Store(f"sqlite:///{Path(folder)}/gridsec.db") as store:
            fleet = Fleet(store, count)
            with served(fleet) as url:
                with httpx.Client(base_url=url, timeout=60) as client:
                    whole, size = request(client, fleet, {})
                    part, small = request(client, fleet, HEAD)
                    numbers, _ = request(client, fleet, NUMBERS)
                row = f"{count:8}{whole:9.1f}{size / 1e3:7.0f}{part:10.1f}{small / 1e3:6.0f}{numbers:13.1f}"
                print(f"{row}{whole / part:7.1f}", flush=True)
                if given.page:
                    print(f"         {in_browser(url, fleet)}", flush=True)


if __name__ == "__main__":
    main()
