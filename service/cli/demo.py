"""Demonstration: a service, virtual meters with an attack, and the reaction of the service.

The service is a separate process; the meters are its zenoh client, driven by full AC power flow. The
displayed and checked data come over HTTP, as for an operator.
"""

from __future__ import annotations

import http.client
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from feeders.model.site import Site, load
from feeders.simulation.scenario import Scenario, SimulatedTick, random_attacks
from gridsec.errors import GridsecError
from service.cli.simulate import Pace, play
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import MeterClient

START_WITHIN_S = 120.0
"""Longest start of the service, s: the first one compiles all modules, which takes 30 s on a busy machine."""
CLEAR_WITHIN_S = 30.0
FEEDER = "simbench-lv-rural1"
ADDRESS_CODE = 5
"""Exit code of a service with an address in use (see `cli`)."""


class DemoFailed(GridsecError):
    """The service could not be started, or ended."""

    code = "demo-failed"


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """Parameters of the demo."""

    feeder: str = FEEDER  # folder or name
    duration_s: float = 120.0  # duration of the simulation, s
    attacked: int = 2  # number of manipulated meters
    size: float = 0.03  # smallest size of the manipulation, pu
    kind: str = "bias"  # attack kind (see `feeders.simulation.attacks.RANDOM_KINDS`)
    seed: int = 1  # seed of meters, loads and errors
    http: str = "127.0.0.1:8000"  # address of the web page; if it is in use, another free port

    @property
    def attack(self) -> tuple[float, float]:
        """Start and end of the attack, s after the start: 20 and 55, earlier in a short demo."""
        return min(20.0, 0.25 * self.duration_s), min(55.0, 0.6 * self.duration_s)


@dataclass(slots=True)
class DemoResult:
    """Results over HTTP: manipulated meters, meters named as manipulated, and problems."""

    lied: set[str] = field(default_factory=set)
    named: set[str] = field(default_factory=set)
    problems: list[str] = field(default_factory=list)


class Service:
    """A service in a separate process, and HTTP requests to it."""

    def __init__(self, process: subprocess.Popen[str], url: str, zenoh: str) -> None:
        self.process = process
        self.url = url
        self.zenoh = zenoh

    def get(self, path: str) -> Any:
        """Return the JSON of a path. Raises DemoFailed if the response is missing or has another status."""
        parts = urlsplit(self.url)
        connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=10.0)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            body = answer.read()
        except OSError as error:
            raise DemoFailed(f"the service does not answer: {error}", code="service-silent") from error
        finally:
            connection.close()
        if answer.status not in {200, 503}:
            raise DemoFailed(f"{path}: HTTP {answer.status}", code="http-status")
        return json.loads(body)


def free_address(wanted: str) -> str:
    """Return the given `host:port` if it is free, otherwise one with a free port."""
    host, _, port = wanted.rpartition(":")
    for candidate in (int(port), 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
            except OSError:
                continue
            return f"{host}:{probe.getsockname()[1]}"
    raise DemoFailed(f"no free port on {host}", code="no-free-port")


@contextmanager
def started(feeder: str, address: str) -> Iterator[Service]:
    """Start a service with a separate database and end it in any case.

    Raises DemoFailed if it does not start; with its output.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gridsec-demo-")))
        log = stack.enter_context((folder / "log").open("w+", encoding="utf-8"))
        database = f"sqlite:///{folder / 'demo.db'}"
        host = address.rpartition(":")[0]
        # Another program may take the port in the meantime.
        for http_wanted, zenoh_wanted in [(address, "127.0.0.1:7447"), *[(f"{host}:0", "127.0.0.1:0")] * 2]:
            zenoh = "tcp/" + free_address(zenoh_wanted)
            ends = ("--zenoh-listen", zenoh, "--http", free_address(http_wanted))
            options = ("--feeder", feeder, *ends, "--database", database, "--until-eof")
            process = _launch(options, log)
            stack.callback(_end, process)
            line = _first_line(process)
            if line.startswith("http://") or process.wait(timeout=5.0) != ADDRESS_CODE:
                break
        if not line.startswith("http://"):
            log.seek(0)
            why = log.read().strip() or f"no address within {START_WITHIN_S:g} s"
            raise DemoFailed(f"the service did not start:\n{why}", code="not-started")
        service = Service(process, line, zenoh)
        _wait_ready(service)
        yield service


def _launch(options: tuple[str, ...], log: IO[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from service.cli.main import main; main()", "serve", *options]
    return subprocess.Popen(  # noqa: S603 - fixed interpreter and arguments
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
    )


def _first_line(process: subprocess.Popen[str]) -> str:
    """Read the URL that the service prints; a service without output within `START_WITHIN_S` is ended."""
    timer = threading.Timer(START_WITHIN_S, process.kill)
    timer.start()
    try:
        return "" if process.stdout is None else process.stdout.readline().strip()
    finally:
        timer.cancel()


def _wait_ready(service: Service) -> None:
    give_up = time.monotonic() + START_WITHIN_S
    while not (answer := service.get("/readyz"))["ok"]:
        if time.monotonic() > give_up:
            raise DemoFailed(f"the service is not ready: {'; '.join(answer['reasons'])}", code="not-ready")
        time.sleep(0.1)


def _end(process: subprocess.Popen[str]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    process.terminate()
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


def run(plan: DemoPlan, console: Console, *, check: bool, keep: bool) -> DemoResult:
    """Run the demo.

    With `check` it lasts until every alarm has cleared, with `keep` until it is interrupted. Raises
    DemoFailed, FeederInvalid, BusUnavailable if it cannot run.
    """
    site = load(plan.feeder)
    with started(plan.feeder, plan.http) as service:
        tick = site.tables.meta.monitor.tick_s
        start = (int(time.time() / tick) + 1) * tick
        on, off = plan.attack
        quiet = Scenario(seed=plan.seed, start=start, duration_s=float("inf"), dt_s=tick)
        attacks = random_attacks(
            site,
            plan.seed,
            plan.kind,
            plan.attacked,
            plan.size,
            t_on=start + on,
            t_off=start + off,
            scenario=quiet,
        )
        scenario = Scenario(seed=plan.seed, start=start, duration_s=float("inf"), dt_s=tick, attacks=attacks)
        _introduce(site, service, plan, console)
        time.sleep(max(0.0, start - time.time()))
        with (
            MeterClient(BusConfig("client", connect=(service.zenoh,)), "gridsec") as meters,
            _screen(console) as show,
        ):
            story = _Story(site, service, start, console=console, show=show)
            for sample in play(site, scenario, meters, Pace(1.0)):
                story.tell(sample)
                if _over(sample.t - start, plan, story, check=check, keep=keep):
                    break
    return story.outcome


@contextmanager
def _screen(console: Console) -> Iterator[Callable[[Table], None] | None]:
    """Update a table below the messages, on a terminal."""
    if not console.is_terminal:
        yield None
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield lambda table: live.update(table, refresh=True)


def _over(elapsed: float, plan: DemoPlan, story: _Story, *, check: bool, keep: bool) -> bool:
    if elapsed < plan.duration_s or keep:
        return False
    if not check or not story.standing:
        return True
    if elapsed < plan.duration_s + CLEAR_WITHIN_S:
        return False
    story.outcome.problems.append(f"alarms still active: {', '.join(sorted(story.standing))}")
    return True


def verdict(outcome: DemoResult) -> tuple[str, ...]:
    """Return the failures of a demo; empty for a success."""
    problems = list(outcome.problems)
    if missed := outcome.lied - outcome.named:
        problems.append(f"manipulated and not named: {', '.join(sorted(missed))}")
    if wrong := outcome.named - outcome.lied:
        problems.append(f"named and not manipulated: {', '.join(sorted(wrong))}")
    if not outcome.lied:
        problems.append("no meter was manipulated")
    return tuple(problems)


def _introduce(site: Site, service: Service, plan: DemoPlan, console: Console) -> None:
    on, off = plan.attack
    title = site.tables.meta.title or site.feeder.name
    console.print(
        f"[bold]{escape(title)}[/]: {len(site.feeder.customers)} customers, {len(site.meter_ids)} meters, "
        f"monitored by the {site.tables.meta.monitor.estimator} estimator."
    )
    console.print(
        f"Web page: [bold cyan]{service.url}/[/]   REST: {service.url}/api/v1/feeders", highlight=False
    )
    console.print(
        f"Virtual meters publish over zenoh on {service.zenoh}. From {on:.0f} s to {off:.0f} s "
        f"{plan.attacked} of them are manipulated; after {plan.duration_s:.0f} s the demo ends."
    )


class _Story:
    """Prints the events: manipulations of the meters, and alarms of the service."""

    def __init__(
        self,
        site: Site,
        service: Service,
        start: float,
        *,
        console: Console,
        show: Callable[[Table], None] | None,
    ) -> None:
        self.outcome = DemoResult()
        self.standing: set[str] = set()
        self._site = site
        self._service = service
        self._start = start
        self._console = console
        self._show = show
        self._lying: set[str] = set()
        self._states: dict[str, str] = {}

    def tell(self, sample: SimulatedTick) -> None:
        """Print the changes since the last tick."""
        lying = {self._site.meter_ids[k] for k in np.flatnonzero(sample.manipulated)}
        self.outcome.lied |= lying
        if lying - self._lying:
            shifts = dict(zip(self._site.meter_ids, sample.shift_volt, strict=True))
            told = ", ".join(f"{meter} by {shifts[meter]:+.1f} V" for meter in sorted(lying))
            self._say(sample.t, "red", f"attack starts: {told}")
        if self._lying - lying:
            self._say(sample.t, "green", f"attack ends: {', '.join(sorted(self._lying - lying))}")
        self._lying = lying
        self._alarms()
        self._picture(sample)

    def _alarms(self) -> None:
        alarms = self._service.get("/api/v1/alarms?limit=1000")["alarms"]
        for alarm in reversed(alarms):
            about = f"{alarm['kind']} {alarm['meter'] or alarm['feeder']}"
            state = "cleared" if alarm["t_cleared"] is not None else "standing"
            if alarm["kind"] == "meter-manipulated":
                self.outcome.named.add(alarm["meter"])
            if self._states.get(alarm["id"]) != state:
                if state == "standing":
                    self._say(alarm["t_raised"], "yellow", f"alarm: {about}: {alarm['reason']}")
                elif alarm["id"] in self._states:
                    self._say(alarm["t_cleared"], "green", f"alarm cleared: {about}")
                self._states[alarm["id"]] = state
        self.standing = {
            f"{alarm['kind']} {alarm['meter'] or alarm['feeder']}"
            for alarm in alarms
            if alarm["t_cleared"] is None
        }

    def _picture(self, sample: SimulatedTick) -> None:
        if self._show is None:
            return
        state = self._service.get(f"/api/v1/feeders/{self._site.feeder.name}/state")
        if "meters" not in state:
            return
        table = Table(title=f"{sample.t - self._start:.0f} s: {state['verdict']}", title_justify="left")
        for name in ("meter", "reported V", "reconstructed V", "true V", ""):
            table.add_column(name, justify="right" if name.endswith("V") else "left")
        true = dict(zip(self._site.meter_ids, sample.v_volt[self._site.meters], strict=True))
        for meter in state["meters"]:
            table.add_row(
                meter["meter"],
                _volt(meter["v_volt_reported"]),
                _volt(meter["v_volt_estimated"]),
                _volt(float(true[meter["meter"]])),
                "manipulated" if meter["suspect"] else "",
                style="bold red" if meter["suspect"] else None,
            )
        self._show(table)

    def _say(self, t: float, colour: str, text: str) -> None:
        self._console.print(f"[{colour}]{t - self._start:6.1f} s  {escape(text)}[/]", highlight=False)


def _volt(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
