"""Command line. Every command is a thin layer over one module.

Exit codes: 0 done; 1 a check failed or an unexpected error; 2 wrong usage or settings; 3 a feeder is invalid
or cannot be monitored; 4 the database cannot be used; 5 an address cannot be used (HTTP or zenoh); 6 a file
is not a recording or another tool's network, or cannot be written; 7 the writer's lock of the database is
lost.
"""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # has no stubs

from gridsec.errors import GridsecError, raise_if_any
from service.cli import (
    access,
    backup,
    console,
    doctor,
    feeders,
    notify,
    pki,
    replay,
    reproduce,
    serve,
    session,
    study_calibrate,
    study_campaign,
    study_compare,
    study_droop,
    study_planning,
    study_report,
)
from service.cli.console import (
    ADDRESS,
    DATABASE,
    FAILED,
    FEEDER,
    FILE,
    LEASE_LOST,
    USAGE,
    WRITER_LOST,
    Feeder,
    print_error,
    read_all,
)
from service.cli.paths import check_paths
from service.cli.serve import Endpoints
from service.cli.study_planning import as_usage_error

BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""Variables of the number of threads of BLAS."""

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.simulation.attacks import AttackKind
    from feeders.simulation.scenario import Scenario
    from gridsec.attack import Attack, InverterAttack


study_app = typer.Typer(no_args_is_help=True)


@study_app.callback()
def study(context: typer.Context) -> None:
    """Study feeders and estimators."""
    context.call_on_close(session.exit_on_signal())


study_app.command("redundancy")(study_planning.redundancy)
study_app.command("protect")(study_planning.protect)
study_app.command("detectable")(study_planning.detectable)
study_app.command("calibrate")(study_calibrate.calibrate)
study_app.command("campaign")(study_campaign.campaign)
study_app.command("droop")(study_droop.droop)
study_app.command("report")(study_report.report)
study_app.command("compare")(study_compare.compare)


app = typer.Typer(
    name="gridsec",
    no_args_is_help=True,
    rich_markup_mode="markdown",  # plain brackets in help texts
    pretty_exceptions_enable=False,
    add_completion=False,
)


def _print_version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        console.out.print(f"gridsec {metadata.version('gridsec')}")
        raise typer.Exit


@app.callback()
def gridsec(
    *,
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """Monitors the voltages of distribution feeders and identifies manipulated meters."""


app.add_typer(feeders.app, name="feeders")
app.add_typer(access.key_app, name="key")
app.add_typer(access.audit_app, name="audit")
app.add_typer(notify.app, name="notify")
app.command("convert")(feeders.convert)
app.command()(doctor.doctor)
app.command()(backup.backup)
app.command()(backup.restore)
app.add_typer(study_app, name="study")
app.add_typer(pki.app, name="pki")
app.command("zenoh-config")(pki.zenoh_config)
app.command()(replay.replay)
app.command()(reproduce.reproduce)
app.command()(serve.serve)
app.command()(serve.worker)


def main() -> None:
    """Run the command line; anticipated errors become one message and an exit code."""
    _limit_blas()
    try:
        app()
    except GridsecError as error:
        print_error(str(error))
        sys.exit(exit_code(error))
    except OSError as error:
        print_error(f"{error.filename or ''}: {error.strerror or error}".removeprefix(": "))
        sys.exit(FILE)


EXIT_CODES: Final = {
    "service.settings.SettingsInvalid": USAGE,
    "gridsec.errors.FeederInvalid": FEEDER,
    "gridsec.errors.NotObservable": FEEDER,
    "gridsec.errors.DesignInfeasible": FEEDER,
    "feeders.convert.provenance.BusbarUnclear": FEEDER,
    "service.store.schema.WriterLost": WRITER_LOST,
    "service.store.schema.LeaseLost": LEASE_LOST,
    "service.store.schema.StoreUnavailable": DATABASE,
    "service.app.AddressUnavailable": ADDRESS,
    "service.ingest.queues.BusUnavailable": ADDRESS,
    "feeders.simulation.recording.RecordingInvalid": FILE,
    "feeders.convert.provenance.SourceUnreadable": FILE,
    "service.cli.paths.Unusable": FILE,
}
"""Exit codes by class. Names: importing all these modules takes 2 s of processor time."""


def exit_code(error: GridsecError) -> int:
    """Return the exit code of an error: that of the most special class in `EXIT_CODES`."""
    names = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(error).__mro__)
    return next((EXIT_CODES[name] for name in names if name in EXIT_CODES), FAILED)


# ----------------------------------------------------------------------------------------------------- demo


@app.command()
def demo(
    *,
    feeder: Annotated[str, typer.Option(help="Folder or name of a feeder.")] = "simbench-lv-rural1",
    duration: Annotated[float, typer.Option(min=30.0, help="Duration, s.")] = 120.0,
    attacked: Annotated[int, typer.Option(min=1, help="Number of manipulated meters.")] = 2,
    size: Annotated[
        float, typer.Option(help="Smallest size, as a part of the nominal voltage; 0.03 is 3 %.")
    ] = 0.03,
    kind: Annotated[
        str, typer.Option(help="bias, scaling, drift, stuck, replay, random, coordinated, coordinated-power.")
    ] = "bias",
    seed: Annotated[int, typer.Option(min=0, help="Seed of meters, loads and errors.")] = 1,
    http: Annotated[
        str, typer.Option(help="Address of the web page; another free port if it is in use.")
    ] = "127.0.0.1:8000",
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Exit 0 only if exactly the manipulated meters are named and all alarms clear."
        ),
    ] = False,
    keep: Annotated[bool, typer.Option("--keep", help="Continue until interrupted.")] = False,
) -> None:
    """Run a demonstration: a service, virtual meters on zenoh, an attack on some of them, and a web page."""
    from service.cli.demo import DemoPlan, run, verdict

    _see_kind(kind, check=check)
    _see_size(size)
    plan = DemoPlan(feeder, duration, attacked, size, kind, seed, http)
    try:
        outcome = run(plan, console.out, check=check, keep=keep)
    except KeyboardInterrupt:
        console.out.print("Interrupted.")
        raise typer.Exit(130) from None
    console.out.print(f"Manipulated:          {', '.join(sorted(outcome.lied)) or 'none'}")
    console.out.print(f"Named by the service: {', '.join(sorted(outcome.named)) or 'none'}")
    if check:
        problems = verdict(outcome)
        for problem in problems:
            print_error(problem)
        if problems:
            raise typer.Exit(FAILED)
        console.out.print("[green]Exactly the manipulated meters were named, and all alarms have cleared.[/]")


def _see_kind(kind: str, *, check: bool) -> None:
    """Refuse unknown kinds, and with `--check` those that may not become visible during the demo."""
    from feeders.simulation.attacks import RANDOM_KINDS, AttackKind

    if kind not in RANDOM_KINDS:
        raise typer.BadParameter(
            f"{kind!r} is not known; expected one of {', '.join(RANDOM_KINDS)}", param_hint="--kind"
        )
    if check and kind in {AttackKind.STUCK, AttackKind.REPLAY}:
        raise typer.BadParameter(
            f"{kind} is visible only after the voltage has left the repeated values, which may take longer "
            "than the demo; until then such meters are correctly not named. Leave out --check",
            param_hint="--kind",
        )


def _see_size(size: float) -> None:
    """Refuse invalid sizes, and sizes in per cent."""
    from feeders.simulation.attacks import no_size

    problems = no_size(size) if 0.0 < size < math.inf else [f"{size:g}; expected a positive part of nominal"]
    if problems:
        raise typer.BadParameter("; ".join(problems), param_hint="--size")


# ------------------------------------------------------------------------------------------------- simulate

PREFIX: Final = "gridsec"

Attacks = Annotated[
    list[str] | None,
    typer.Option(
        "--attack",
        help="kind:count:size:from:to, e.g. bias:2:0.03:20:55 (size as a part of nominal: 0.03 is 3 %, "
        "times in s after the start); may be repeated. With 'substation' in place of the count, the "
        "attack is on the busbar meter, with exactly this size, which may be negative: "
        "bias:substation:0.03:20:55.",
    ),
]


InverterAttacks = Annotated[
    list[str] | None,
    typer.Option(
        "--inverter-attack",
        help="customer:kvar:from:to, e.g. 'load-6:-4:20:55': the customer's inverter injects this reactive "
        "power beyond its droop curve (times in s after the start); may be repeated.",
    ),
]


@app.command()
def simulate(
    feeder: Feeder,
    *,
    connect: Endpoints = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Write a recording (Parquet) instead of publishing; it replaces simulated ones only."
        ),
    ] = None,
    duration: Annotated[float, typer.Option(min=0.0, help="Duration, s; 0 is without end.")] = 600.0,
    dt: Annotated[
        float | None, typer.Option(help="Interval between readings, s. [default: the tick]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    season: Annotated[
        str, typer.Option(help="Loads and generation of winter, spring, summer or autumn.")
    ] = "summer",
    attack: Attacks = None,
    inverter_attack: InverterAttacks = None,
    start: Annotated[
        float | None, typer.Option(help="Unix time of the first tick, s. [default: now]")
    ] = None,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Virtual seconds per second; 0 is without limit.")
    ] = 1.0,
    lockstep: Annotated[
        int | None,
        typer.Option(min=2, help="Largest lead over the service's published estimates, ticks."),
    ] = None,
    loss: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of lost readings.")] = 0.0,
    report_q: Annotated[bool, typer.Option("--report-q", help="Meters report reactive power.")] = False,
    prefix: Annotated[str, typer.Option(help="First chunks of all keys.")] = PREFIX,
) -> None:
    """Simulate a feeder's meters by full AC power flow: onto zenoh, or into a file.

    Faster than real time needs a service with `--clock events`.
    """
    from feeders.model.site import load
    from feeders.simulation.plant import Channel, MeterErrors
    from feeders.simulation.recording import record, truth_path
    from feeders.simulation.scenario import Scenario, Season
    from feeders.simulation.scenario import check as see_attacks
    from gridsec.errors import no_choice

    site = load(feeder)
    length = duration or math.inf
    problems = _wrong_times(dt, start)
    if out is not None:
        if math.isinf(length):
            problems.append("--duration: a recording needs an end")
        live = {
            "--connect": connect,
            "--lockstep": lockstep,
            "--speed": speed != 1.0,
            "--prefix": prefix != PREFIX,
        }
        problems += [f"{name} goes with publishing, not with --out" for name, given in live.items() if given]
    problems += no_choice("--season", Season, season)
    lies = read_all("--attack", attack, _lie, problems)
    wrong = read_all("--inverter-attack", inverter_attack, partial(_injection, site), problems)
    if problems:
        raise typer.BadParameter("; ".join(problems))
    if out is not None:
        check_paths(simulated={"--out": out, "--out, its truth": truth_path(out)})
    tick = site.tables.meta.monitor.tick_s if dt is None else dt
    first = math.ceil(time.time() / tick) * tick if start is None else start
    with as_usage_error():
        scenario = Scenario(
            seed=seed,
            start=first,
            duration_s=length,
            dt_s=tick,
            errors=MeterErrors(report_q=report_q),
            channel=Channel(loss=loss),
            season=Season(season),
        )
        scenario = _attacked(site, scenario, lies, wrong)
        see_attacks(site, scenario)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        recording = record(site, scenario, out)
        console.out.print(f"{recording.path}: {recording.count} readings of {site.feeder.name}")
        return
    _publish(site, scenario, tuple(connect or ("tcp/127.0.0.1:7447",)), prefix, (speed or math.inf, lockstep))


def _wrong_times(dt: float | None, start: float | None) -> list[str]:
    """Problems of the times of a scenario."""
    from feeders.simulation.scenario import LATEST_S

    problems = []
    if dt is not None and not 0.0 < dt < math.inf:
        problems.append(f"--dt is {dt:g}; expected a positive number of seconds")
    if start is not None and not 0.0 <= start < LATEST_S:
        problems.append(f"--start is {start:g}; expected a Unix time in seconds")
    return problems


def _span(begin: float, end: float) -> tuple[float, float]:
    """Two times in ascending order, s after the start."""
    if not (math.isfinite(begin) and begin < end and end > 0.0):
        raise ValueError(
            f"expected a start before the end, and an end after the start, not {begin:g} and {end:g}"
        )
    return begin, end


@dataclass(frozen=True, slots=True)
class _Lie:
    """Parsed value of --attack; without a count, an attack on the busbar meter."""

    kind: AttackKind
    count: int | None
    size: float
    begin: float
    end: float


def _lie(text: str) -> _Lie:
    """Parse `kind:count:size:from:to`."""
    from feeders.simulation.attacks import RANDOM_KINDS, AttackKind, no_size
    from service.report.report import BUSBAR

    try:
        name, count, size, begin, end = text.split(":")
        many, part = None if count == BUSBAR else int(count), float(size)
        kind = RANDOM_KINDS[RANDOM_KINDS.index(name)]
        times = float(begin), float(end)
    except ValueError:
        raise ValueError(
            f"expected kind:count:size:from:to with a kind of {', '.join(RANDOM_KINDS)}"
        ) from None
    on, off = _span(*times)
    if many is not None and many < 1:
        raise ValueError(f"{many} is not a number of meters; expected 1 or more")
    # The size of a stuck or replayed reading follows from later changes, not from the option.
    sized = many is not None and kind not in (AttackKind.STUCK, AttackKind.REPLAY)
    if not math.isfinite(part) or (sized and part <= 0.0):
        what = "positive" if sized else "finite"
        raise ValueError(f"its size is {size}; expected a {what} part of nominal")
    if kind not in (AttackKind.STUCK, AttackKind.REPLAY):
        raise_if_any(no_size(part))
    if kind is AttackKind.DRIFT and math.isinf(off):
        raise ValueError("a drift needs an end, which determines its speed")
    return _Lie(kind, many, part, on, off)


def _injection(site: Site, text: str) -> InverterAttack:
    """Parse `customer:kvar:from:to`; times are s after the start."""
    import numpy as np

    from gridsec.attack import InverterAttack

    owners = [site.feeder.customers[int(c)] for c in site.droop.customer]
    try:
        customer, kvar, begin, end = text.rsplit(":", 3)
        which, q = owners.index(customer), float(kvar) / site.feeder.base_kva
        times = float(begin), float(end)
    except ValueError:
        known = f"a customer with an inverter: {', '.join(owners)}"
        expected = known if owners else f"an inverter, and {site.feeder.name} has none"
        raise ValueError(f"expected customer:kvar:from:to with {expected}") from None
    return InverterAttack(np.array([which], dtype=np.intp), np.array([q]), *_span(*times))


def _attacked(site: Site, scenario: Scenario, lies: list[_Lie], wrong: list[InverterAttack]) -> Scenario:
    """The scenario with its attacks on meters and inverters."""
    from feeders.simulation.attacks import busbar_attack, random_attacks

    attacks: list[Attack] = []
    on_busbar: list[Attack] = []
    for number, lie in enumerate(lies):
        on, off = scenario.start + lie.begin, scenario.start + lie.end
        if lie.count is None:
            on_busbar.append(busbar_attack(site, lie.kind, lie.size, t_on=on, t_off=off))
            continue
        seed = scenario.seed + number
        attacks += random_attacks(
            site, seed, lie.kind, lie.count, lie.size, t_on=on, t_off=off, scenario=scenario
        )
    begin = scenario.start
    moved = (replace(each, t_on=begin + each.t_on, t_off=begin + each.t_off) for each in wrong)
    return replace(
        scenario, attacks=tuple(attacks), busbar_attacks=tuple(on_busbar), inverter_attacks=tuple(moved)
    )


def _publish(
    site: Site, scenario: Scenario, connect: tuple[str, ...], prefix: str, pace: tuple[float, int | None]
) -> None:
    from service.cli.simulate import OutOfStep, Pace, play
    from service.ingest.queues import BusConfig
    from service.ingest.zenoh_bus import MeterClient

    ticks = 0
    if pace[0] == 1.0:
        time.sleep(max(0.0, scenario.start - time.time()))
    try:
        with MeterClient(BusConfig("client", connect=connect), prefix) as meters:
            for _ in play(site, scenario, meters, Pace(*pace)):
                ticks += 1
    except OutOfStep as error:
        print_error(f"the service is out of step: {error}")
        raise typer.Exit(FAILED) from None
    except KeyboardInterrupt:
        pass
    console.out.print(f"{ticks} ticks of {len(site.meter_ids)} meters and the busbar published")


def _limit_blas() -> None:
    """Let BLAS use one thread, unless the environment states a number.

    The observers are memory-bound: more threads wait for each other in a loop. The environment holds for
    child processes and for libraries that are loaded later; those of the imports above have read it already.
    """
    given = [name for name in BLAS_THREADS if name in os.environ]
    for variable in BLAS_THREADS:
        os.environ.setdefault(variable, "1")
    if not given:
        threadpool_limits(limits=1, user_api="blas")
