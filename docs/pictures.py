"""Pictures of the web page for the documents: a real service, 60 feeders, four attacks and an outage.

    python -m docs.pictures [folder] [--feeders 60]

Real meters publish over zenoh to a `gridsec serve` in a process of its own: full AC power flow, meter errors,
attacks and silent meters. Chromium shows each view at 1400 x 900 and 390 x 844, light and dark. The files are
`<view>-<desktop|phone>-<light|dark>.png`.
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from feeders.format.tables import write
from feeders.model.site import Site, load
from feeders.simulation.attacks import busbar_attack, random_attacks
from feeders.simulation.plant import BUSBAR
from feeders.simulation.scenario import Scenario, SimulatedReading, simulate
from service.cli.simulate import key_of, payload_of
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient
from tests.service.running import free_port

SMALL, LARGE = "simbench-lv-rural1", "simbench-lv-rural3"
STREETS = (
    *("Mill Lane", "Church Road", "Harbour Street", "Oak Avenue", "Station Road", "School Lane"),
    *("Bridge Street", "Meadow Way", "North Row", "Quarry Hill", "River Walk", "Old Market"),
)
ONSET_S, LASTS_S = 30.0, 3600.0
ATTACKED_S = 70.0
"""Time from the onset to the first picture: verdicts are displayed and silent meters are reported."""
SIZES = {"desktop": (1400, 900), "phone": (390, 844)}
SCHEMES = ("light", "dark")
COLOURS, EXACT, APART = 256, 32, 20
"""Colours of a picture; the most frequent ones are exact, the others apart, sum over red, green and blue."""
CALM_S = 5
"""Interval of the readings of stations without an event, s: a busy machine must not shed feeders."""


@dataclass(frozen=True)
class Station:
    """A feeder of the fleet, its attack and its silent meters."""

    name: str
    title: str
    like: str = SMALL
    attack: str = ""
    silent: float = 0.0  # share of its meters that stop at the onset

    @property
    def tick_s(self) -> int:
        """Interval of its readings, s."""
        return 1 if self.attack or self.silent else CALM_S


def fleet(count: int) -> list[Station]:
    """Stations: four attacked ones, one without data, one with a silent meter, the others clean."""
    special: dict[int, dict[str, Any]] = {
        7: {"attack": "bias"},
        15: {"silent": 1.0},
        23: {"attack": "coordinated", "like": LARGE},
        31: {"attack": "random"},
        42: {"attack": "busbar"},
        50: {"silent": 0.05},
    }
    return [
        Station(f"station-{k:02d}", f"Station {k:02d}, {STREETS[k % len(STREETS)]}", **special.get(k, {}))
        for k in range(1, count + 1)
    ]


def scenario_of(station: Station, site: Site, start: float) -> Scenario:
    """Simulated hour of a station."""
    scenario = Scenario(seed=3, start=start, duration_s=LASTS_S)
    t_on, t_off = start + ONSET_S, start + LASTS_S
    if station.attack == "busbar":
        return replace(scenario, busbar_attacks=(busbar_attack(site, "bias", 0.02, t_on=t_on, t_off=t_off),))
    if station.attack:
        count = 3 if station.attack == "coordinated" else 2
        found = random_attacks(
            site, 1, station.attack, count, 0.03, t_on=t_on, t_off=t_off, scenario=scenario
        )
        return replace(scenario, attacks=found)
    return scenario


class Meters(threading.Thread):
    """All meters of the fleet, one reading per second each."""

    def __init__(self, zenoh: str, sites: dict[Station, Site]) -> None:
        super().__init__(daemon=True)
        self.zenoh, self.sites = zenoh, sites
        self.ended = threading.Event()
        self.start_t = float(int(time.time()) + 2)

    def run(self) -> None:
        """Publish until the end."""
        calm = simulate(
            self.sites[next(iter(self.sites))], Scenario(seed=3, start=self.start_t, duration_s=LASTS_S)
        )
        own = {
            station: simulate(site, scenario_of(station, site, self.start_t))
            for station, site in self.sites.items()
            if station.attack or station.like != SMALL
        }
        with MeterClient(BusConfig("client", connect=(self.zenoh,)), "gridsec") as meters:
            for k in range(int(LASTS_S)):
                if self.ended.wait(max(0.0, self.start_t + k - time.time())):
                    return
                shared = next(calm).readings
                for station in self.sites:
                    if k % station.tick_s:
                        continue
                    readings = next(own[station]).readings if station in own else shared
                    for reading in self._heard(station, readings, float(k)):
                        meters.put(key_of(station.name, reading.meter), payload_of(reading))

    def _heard(self, station: Station, readings: Any, after: float) -> list[SimulatedReading]:
        if not station.silent or after < ONSET_S:
            return list(readings)
        left_out = round(station.silent * len(readings)) or 1
        return (
            []
            if station.silent >= 1.0
            else [r for r in readings if r.meter == BUSBAR]
            + [r for r in readings if r.meter != BUSBAR][left_out:]
        )


@contextmanager
def served(folder: Path, stations: list[Station]) -> Iterator[tuple[str, Path]]:
    """Run a service and all meters; yields its address and its database."""
    sites: dict[Station, Site] = {}
    for station in stations:
        site = load(station.like)
        meta = replace(site.tables.meta, name=station.name, title=station.title)
        meta = replace(meta, monitor=replace(meta.monitor, tick_s=float(station.tick_s)))
        write(replace(site.tables, meta=meta), folder / station.name)
        sites[station] = load(folder / station.name)
    zenoh, database = f"tcp/127.0.0.1:{free_port()}", folder / "pictures.db"
    feeders = [part for station in stations for part in ("--feeder", str(folder / station.name))]
    ends = ("--zenoh-listen", zenoh, "--http", f"127.0.0.1:{free_port()}")
    command = [sys.executable, "-c", "from service.cli.main import main; main()", "serve", *feeders, *ends]
    with ExitStack() as stack:
        log = stack.enter_context((folder / "log").open("w"))
        process = subprocess.Popen(  # noqa: S603 - fixed interpreter and arguments
            [*command, "--database", f"sqlite:///{database}"], stdout=subprocess.PIPE, stderr=log, text=True
        )
        stack.callback(process.wait, 30)
        stack.callback(process.terminate)
        url = process.stdout.readline().strip() if process.stdout else ""
        if not url.startswith("http://"):
            raise RuntimeError((folder / "log").read_text())
        meters = Meters(zenoh, sites)
        stack.callback(meters.join, 10)
        stack.callback(meters.ended.set)
        meters.start()
        time.sleep(max(0.0, meters.start_t + ONSET_S + ATTACKED_S - time.time()))
        yield url, database


def act(url: str) -> None:
    """Actions of two operators: an assignment, a comment, a shelf and planned work."""
    with httpx.Client(base_url=f"{url}/api/v1", timeout=30) as http:
        found = {one["feeder"]: one for one in http.get("/incidents").json()["incidents"]}

        def post(path: str, **body: Any) -> None:
            http.post(path, json={"who": "Ada Lovelace", **body}).raise_for_status()

        for name, one in found.items():
            if name == "station-31":
                post(f"/incidents/{one['id']}/ack", comment="The installer was on site.", count=one["count"])
                post(f"/incidents/{one['id']}/assign", to="Grace Hopper", comment="")
            if name == "station-15":
                post("/planned-work", feeder=name, t_from=time.time(), t_until=time.time() + 7200.0,
                     reason="The concentrator is exchanged.")  # fmt: skip
            if name == "station-42":
                post("/shelves", incident=one["id"], duration_s=14_400.0, reason="Second instrument ordered.")
            if name == "station-23":
                post(f"/incidents/{one['id']}/comment", comment="Three neighbours at once: no defect.")


# ------------------------------------------------------------------------ views


def to(page: Page, selector: str) -> None:
    """Scroll so that an element begins below the header."""
    page.evaluate(
        "s => { const top = document.querySelector('.top').offsetHeight;"
        " scrollTo(0, document.querySelector(s).getBoundingClientRect().top + scrollY - top - 8); }",
        selector,
    )


def overview(page: Page) -> None:
    """Top of the page of an attacked feeder."""
    page.locator("#fleet-rows tr").first.wait_for()


def clean(page: Page) -> None:
    """Top of the page of a clean feeder."""
    page.locator("#fleet-rows tr").first.wait_for()


def schematic(page: Page) -> None:
    """One-line view."""
    page.locator('#view [data-view="line"]').click()
    to(page, ".map")


def map_view(page: Page) -> None:
    """Map with three suspects."""
    page.locator('#view [data-view="map"]').click()
    to(page, ".map")


def alarms(page: Page) -> None:
    """Alarm list."""
    page.locator("#alarm-box > summary").click()
    page.locator("#alarm-list .alarm").first.wait_for()
    to(page, ".alarms")


def incident(page: Page) -> None:
    """Incident with its alarms and its log."""
    page.locator('.incident .line:has-text("station-23")').click()
    page.locator(".incident .alarm").first.wait_for()
    to(page, ".incidents")


def series(page: Page) -> None:
    """Time series of a suspect and another meter."""
    page.locator("#series-chart .panel").nth(1).wait_for()
    to(page, "#series")


def hand_over(page: Page) -> None:
    """Hand-over."""
    page.locator("#shift-open").click()
    page.locator("#shift-incidents li").first.wait_for()


def commissioning(page: Page) -> None:
    """A customer, and the form for its replaced meter."""
    page.locator("#chips .chip").first.click()
    page.locator("#replaced").click()


def customer(page: Page) -> None:
    """A suspect customer."""
    page.locator("#chips .chip").first.click()
    page.locator("#detail .trend").wait_for()
    to(page, "#detail-card")


def login(page: Page) -> None:
    """Login."""
    page.locator("#login").wait_for()


VIEWS: dict[str, tuple[str, Callable[[Page], None]]] = {
    "overview": ("station-07", overview),
    "clean": ("station-03", clean),
    "outage": ("station-15", clean),
    "schematic": ("station-07", schematic),
    "map": ("station-23", map_view),
    "alarms": ("station-07", alarms),
    "incident": ("station-23", incident),
    "series": ("station-07?series={suspect},{other}&span=420", series),
    "hand-over": ("station-07", hand_over),
    "customer": ("station-07", customer),
    "commissioning": ("station-07", commissioning),
}


def take(browser: Browser, url: str, path: Path) -> None:
    """Write the picture with the name of a file."""
    view, size, scheme = path.stem.rsplit("-", 2)
    address, prepare = VIEWS.get(view, ("", login))
    if "{" in address:
        address = address.format(**meters_of(url))
    width, height = SIZES[size]
    context = browser.new_context(
        viewport={"width": width, "height": height},
        color_scheme=scheme,  # type: ignore[arg-type]
        has_touch=size == "phone",
        reduced_motion="reduce",
        locale="en-GB",
    )
    page = context.new_page()
    page.set_default_timeout(30_000)
    page.goto(f"{url}/#{address}")
    if view != "login":
        page.locator("#verdict:not([data-verdict='none']), #main[data-fresh='no']").first.wait_for()
        page.wait_for_timeout(1500)
    prepare(page)
    page.mouse.move(width - 1, 1)
    page.wait_for_timeout(700)
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    reduced(image).save(path, optimize=True)
    wide = page.evaluate("document.documentElement.scrollWidth")
    print(
        f"{path} {path.stat().st_size / 1e3:.0f} kB{', WIDER THAN THE WINDOW' if wide > width else ''}",
        flush=True,
    )
    context.close()


def reduced(image: Image.Image) -> Image.Image:
    """Picture with the most frequent colours as palette; backgrounds, text and signs keep theirs exactly."""
    codes = np.asarray(image, dtype=np.int32) @ np.array([1 << 16, 1 << 8, 1])
    found, places, counts = np.unique(codes, return_inverse=True, return_counts=True)
    colours = np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1)
    order = np.argsort(-counts)
    chosen = colours[order[:EXACT]]
    for colour in colours[order[EXACT:]]:
        if len(chosen) < COLOURS and np.abs(chosen - colour).sum(axis=1).min() > APART:
            chosen = np.vstack([chosen, colour])
    nearest = np.abs(colours[:, None] - chosen).sum(axis=2).argmin(axis=1)
    made = Image.fromarray(nearest[places].reshape(codes.shape).astype(np.uint8), "P")
    made.putpalette(chosen.astype(np.uint8).tobytes())
    return made


def meters_of(url: str) -> dict[str, str]:
    """A suspect of the first attacked station, and another meter."""
    state = httpx.get(f"{url}/api/v1/feeders/station-07/state", timeout=30).json()
    suspects = [m["meter"] for m in state["meters"] if m["suspect"]]
    others = [m["meter"] for m in state["meters"] if not m["suspect"]]
    return {"suspect": (suspects or others[1:])[0], "other": others[0]}


def main() -> None:
    """Write all pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).with_name("page"))
    parser.add_argument("--feeders", type=int, default=60)
    parser.add_argument("--view", action="append", choices=[*VIEWS, "login"], help="these views only")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gridsec-pictures-")))
        url, database = stack.enter_context(served(folder, fleet(given.feeders)))
        act(url)
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox", "--disable-gpu"]
        )
        for view in given.view or [*VIEWS, "login"]:
            if view == "login":
                key = (
                    "key",
                    "add",
                    "Ada Lovelace",
                    "--role",
                    "operator",
                    "--database",
                    f"sqlite:///{database}",
                )
                run = "from service.cli.main import main; main()"
                subprocess.run([sys.executable, "-c", run, *key], check=True, capture_output=True)  # noqa: S603
                time.sleep(3.0)
            for size in SIZES:
                for scheme in SCHEMES:
                    take(browser, url, given.folder / f"{view}-{size}-{scheme}.png")
        browser.close()


if __name__ == "__main__":
    main()
