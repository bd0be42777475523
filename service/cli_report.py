"""`gridsec study report`: what all studies say of a feeder, on one page for people who decide."""

from __future__ import annotations

import math
import os
from dataclasses import MISSING, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from feeders.command_line import command_line
from service import console
from service.cli_campaign import Estimator, KnownKvar, KnownKw, Seed, Step
from service.cli_droop import Allowed, Preset
from service.cli_plan import BusbarUnknown, GoalOf, LieVolt, Silent, Unknown, bar
from service.console import FAILED, Studied, complain
from service.foreign import converted
from service.keeping import keeping
from service.options import options_of, read_all

if TYPE_CHECKING:
    from service.study_report import Asked


Page = Annotated[
    Path, typer.Option(help="The page; figures, tables and journals go into a folder beside it.")
]
Studies = Annotated[
    str | None,
    typer.Option(help="Names of studies, with commas between them. [default: all there is data for]"),
]
MaxAttacked = Annotated[int, typer.Option(help="M: how many meters lie together at most.", min=1)]
Scenarios = Annotated[int, typer.Option(help="How many attacks are simulated.", min=1)]
Workers = Annotated[
    int | None, typer.Option(help="Processes for simulated attacks. [default: all cores]", min=1)
]
BusbarLimits = Annotated[
    tuple[float, float] | None, typer.Option(help="Limits of the busbar's voltage, pu. [default: 1 1]")
]
Hosting = Annotated[bool, typer.Option("--hosting", help="Look for hosting capacities too.")]
Readings = Annotated[
    Path | None, typer.Option(help="A recording (Parquet or CSV) to compare the files with.")
]
At = Annotated[
    str | None,
    typer.Option(help="Date and time that the report bears, like 2026-11-21T12:00Z. [default: now]"),
]


def report(
    feeder: Studied = "simbench-lv-rural1",
    *,
    out: Page = Path("report.html"),
    studies: Studies = None,
    max_attacked: MaxAttacked = 2,
    goal: GoalOf = None,
    lie_volt: LieVolt = None,
    unknown: Unknown = None,
    silent: Silent = None,
    busbar_unknown: BusbarUnknown = False,
    scenarios: Scenarios = 160,
    seed: Seed = 0,
    workers: Workers = None,
    step: Step = None,
    estimator: Estimator = None,
    load_error_kw: KnownKw = None,
    load_error_kvar: KnownKvar = None,
    preset: Preset = None,
    busbar: BusbarLimits = None,
    band: Allowed = None,
    hosting: Hosting = False,
    readings: Readings = None,
    at: At = None,
) -> None:
    """Run studies and write a report on the feeder: one HTML file, to print or to send.

    Interrupted, the same command goes on where it was. What a study cannot answer, the report says.
    """
    from feeders.columns import ESTIMATORS
    from feeders.studies.protect import check as see_question
    from gridsec.choices import no_choice
    from gridsec.droop import PRESETS
    from service.study_report import STUDIES, Asked, misplaced

    problems: list[str] = []
    chosen = _studies(studies, tuple(STUDIES), recorded=readings is not None, problems=problems)
    problems += no_choice("--preset", PRESETS, *([preset] if preset else []))
    problems += no_choice("--estimator", ESTIMATORS, *([estimator] if estimator else []))
    problems += [*_no_limits("--busbar", busbar), *_no_limits("--band", band, apart=True)]
    moments = [_now()] if at is None else read_all("--at", [at], _moment, problems)
    asked = Asked(
        feeder=feeder,
        max_attacked=max_attacked,
        goal=goal,
        lie_volt=math.nan if lie_volt is None else lie_volt,
        unknown=None if not unknown else tuple(unknown),
        silent=tuple(silent or ()),
        busbar_unknown=busbar_unknown,
        scenarios=scenarios,
        seed=seed,
        workers=workers or os.cpu_count() or 1,
        step=step,
        estimator=estimator,
        load_error_kw=load_error_kw,
        load_error_kvar=load_error_kvar,
        preset=preset,
        busbar=busbar,
        band=band,
        hosting=hosting,
        readings=readings,
    )
    if chosen:
        problems += misplaced(asked, chosen)
    options_of(
        lambda: see_question(
            max_attacked=max_attacked,
            goal=goal,
            lie_volt=asked.lie_volt,
            unknown=unknown,
            busbar_known=not busbar_unknown,
        ),
        problems,
        replaced={"--out": out},
        folders={f"--out, {name}": _beside(out) / name for name in ("figures", "tables", "journals")},
        read={"--readings": readings},
    )
    _make(asked, chosen, out, made=moments[0], command=_command(asked, out, studies))


def _beside(out: Path) -> Path:
    """The folder beside the page."""
    return out.with_name(f"{out.stem}-files")


def _no_limits(option: str, limits: tuple[float, float] | None, *, apart: bool = False) -> list[str]:
    """What the droop study would refuse of limits, before the work."""
    low, high = limits or (1.0, 2.0)
    if 0.0 < low <= high < math.inf and not (apart and low == high):
        return []
    return [f"{option}: expected two ascending numbers, not {low:g} and {high:g}"]


def _make(asked: Asked, chosen: tuple[str, ...], out: Path, *, made: str, command: str) -> None:
    """Run the studies and write the report."""
    from feeders.load import load
    from feeders.origin import origin
    from feeders.report.book import report as make
    from feeders.report.page import About
    from service.study_report import attacks, outcome, see_readings, seeds, versions, write

    folder = _beside(out)
    with keeping("report", asked.feeder, folder=folder / "journals") as kept:
        studied = converted(asked.feeder, folder)
        site, source = load(studied), origin(studied)
        see_readings(chosen, site, asked)
        if "campaign" in chosen:
            console.out.print(escape(attacks(site, asked)))
        outcomes = [outcome(name, site, asked, kept=kept, bar=bar) for name in chosen]
        about = About(made, command, versions(), seeds(chosen, asked), folder.name)
        write(make(site, outcomes, about, source), out, folder)
    console.out.print(escape(f"{out}: {len(outcomes)} studies; figures and tables in {folder}"))
    for each in outcomes:
        if each.absent:
            console.out.print(escape(f"{each.study}: {each.problem}"))
    failed = [each for each in outcomes if each.result is None and not each.absent]
    for each in failed:
        complain(f"{each.study}: {each.problem}")
    if failed:
        raise typer.Exit(FAILED)


def _studies(
    text: str | None, known: tuple[str, ...], *, recorded: bool, problems: list[str]
) -> tuple[str, ...]:
    """Names of studies, each once; calibration only where there are readings."""
    from gridsec.choices import no_choice

    if text is None:
        return tuple(name for name in known if recorded or name != "calibrate")
    names = [name.strip() for name in text.split(",")]
    problems += no_choice("--studies", known, *names)
    if "calibrate" in names and not recorded:
        problems.append("--studies: calibrate needs --readings")
    return tuple(name for name in known if name in names)


def _now() -> str:
    return _told(datetime.now(UTC))


def _moment(text: str) -> str:
    """The time that the report is to bear."""
    try:
        return _told(datetime.fromisoformat(text))
    except ValueError as error:
        raise ValueError("expected a date and time of ISO 8601") from error


def _told(given: datetime) -> str:
    return f"{given.astimezone(UTC) if given.tzinfo else given:%Y-%m-%d %H:%M} UTC"


def _command(asked: Asked, out: Path, studies: str | None) -> str:
    """The command line that makes the report again: what differs from the defaults."""
    usual = replace(
        asked, **{each.name: each.default for each in fields(asked) if each.default is not MISSING}
    )
    words: list[object] = ["gridsec", "study", "report", asked.feeder, "--out", out]
    words += [] if studies is None else ["--studies", studies]
    for each in fields(asked):
        value = getattr(asked, each.name)
        if each.name in ("feeder", "workers") or value in (getattr(usual, each.name), None):
            continue
        if isinstance(value, float) and math.isnan(value):
            continue
        option = f"--{each.name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif each.name in ("busbar", "band"):
            words += [option, *value]
        elif isinstance(value, tuple):
            words += [word for name in value for word in (option, name)]
        else:
            words += [option, value]
    return command_line(words)
