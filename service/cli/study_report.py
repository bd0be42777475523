"""`gridsec study report`: studies of a report with their journals, and the report's files."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import MISSING, dataclass, fields, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.markup import escape

from feeders.util import command_line, replace_file, word
from gridsec.errors import GridsecError, InputInvalid, Problem
from service.cli import console
from service.cli.console import FAILED, Studied, complain, options_of, read_all
from service.cli.paths import write_tables
from service.cli.session import keeping
from service.cli.sources import converted
from service.cli.study_campaign import Estimator, KnownKvar, KnownKw, Seed, Step, planned, sources
from service.cli.study_droop import Allowed, Preset
from service.cli.study_planning import BusbarUnknown, GoalOf, LieVolt, Silent, Unknown, bar

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.report.build import Report
    from feeders.report.html import Outcome, Result
    from feeders.studies.campaign.plan import Plan
    from feeders.studies.journal import Progress, Where
    from service.cli.session import Keeping

__all__ = [
    "STUDIES",
    "Asked",
    "At",
    "BusbarLimits",
    "Hosting",
    "MaxAttacked",
    "Page",
    "Readings",
    "Scenarios",
    "Studies",
    "Study",
    "Workers",
    "misplaced",
    "outcome",
    "report",
    "versions",
    "write",
]


LIBRARIES: Final = (
    *("gridsec", "numpy", "scipy", "pandas", "cvxpy", "clarabel", "highspy", "power-grid-model"),
    *("pyarrow", "matplotlib"),
)


@dataclass(frozen=True, slots=True)
class Asked:
    """What a report is about; every study takes what concerns it.

    Attributes
    ----------
    feeder
        As on the command line.
    max_attacked
        M.
    goal, lie_volt
        What protection is for, by default as the study has it, and the bound of a lie, V.
    unknown, silent, busbar_unknown
        What nobody knows; meters that are missing.
    scenarios, seed, workers
        Of simulated attacks; the seed is for all that is random.
    step, estimator, load_error_kw, load_error_kvar
        Of simulated attacks: interval of the readings, s, who watches, and what nobody knows of powers; None:
        as the feeder's files say.
    preset, busbar, band
        Of the inverters' study, as in `DroopOptions`; None: as there.
    hosting
        Whether to look for hosting capacities.
    readings
        A recording to compare the files with.
    """

    feeder: str
    max_attacked: int = 2
    goal: str | None = None
    lie_volt: float = math.nan
    unknown: tuple[str, ...] | None = None
    silent: tuple[str, ...] = ()
    busbar_unknown: bool = False
    scenarios: int = 160
    seed: int = 0
    workers: int = 1
    step: float | None = None
    estimator: str | None = None
    load_error_kw: float | None = None
    load_error_kvar: float | None = None
    preset: str | None = None
    busbar: tuple[float, float] | None = None
    band: tuple[float, float] | None = None
    hosting: bool = False
    readings: Path | None = None


@dataclass(frozen=True, slots=True)
class Study:
    """How a report runs a study.

    Attributes
    ----------
    run
        Runs it.
    options
        The options of its own command that do the same.
    what
        For the progress bar: which pieces of work are counted.
    seeded
        Whether it uses the seed.
    """

    run: Callable[[Site, Asked, Where, Progress | None], Result]
    options: Callable[[Asked], list[str]]
    what: str
    seeded: bool = False


def _detectable(site: Site, asked: Asked, journal: Where, tell: Progress | None) -> Result:
    from feeders.studies.detectable import detectable, workers

    runner = workers(site, None if asked.workers > 1 else 1)
    return detectable(site, max_attacked=asked.max_attacked, runner=runner, journal=journal, progress=tell)


def _protect(site: Site, asked: Asked, journal: Where, tell: Progress | None) -> Result:
    from feeders.studies.protect import Goal, protect

    return protect(
        site,
        max_attacked=asked.max_attacked,
        goal=None if asked.goal is None else Goal(asked.goal),
        lie_volt=asked.lie_volt,
        unknown=asked.unknown,
        busbar_known=not asked.busbar_unknown,
        journal=journal,
        progress=None if tell is None else lambda known, done: tell(done, known),
    )


def _redundancy(site: Site, asked: Asked, journal: Where, tell: Progress | None) -> Result:
    from feeders.studies.redundancy import redundancy

    return redundancy(
        site,
        unknown=asked.unknown,
        silent=asked.silent,
        busbar_known=not asked.busbar_unknown,
        journal=journal,
        progress=tell,
    )


def _droop(site: Site, asked: Asked, journal: Where, tell: Progress | None) -> Result:
    from feeders.studies.droop.study import DroopOptions, droop

    low, high = asked.busbar or (1.0, 1.0)
    least, most = asked.band or (None, None)
    options = DroopOptions(
        preset=asked.preset, v0_low=low, v0_high=high, v_min=least, v_max=most, hosting=asked.hosting
    )
    return droop(site, options, seed=asked.seed, journal=journal, progress=tell)


def _calibrate(site: Site, asked: Asked, journal: Where, tell: Progress | None) -> Result:
    from feeders.studies.calibrate.study import calibrate

    if asked.readings is None:
        raise InputInvalid([Problem("missing", "there are no recorded readings to compare with")])
    return calibrate(site, asked.readings, journal=journal, progress=tell)


def _campaign(site: Site, asked: Asked, journal: Where, tell: Progress | None) -> Result:
    from feeders.studies.campaign.study import campaign
    from feeders.studies.workers import cores

    return campaign(site, plan(site, asked), runner=cores(asked.workers), journal=journal, progress=tell)


def plan(site: Site, asked: Asked) -> Plan:
    """The simulated attacks of a report.

    Parameters
    ----------
    site, asked
        The feeder, and what was asked.
    """
    from feeders.studies.campaign.plan import Plan

    together = min(asked.scenarios, Plan().together)
    return planned(
        site,
        step=asked.step,
        load_error_kw=asked.load_error_kw,
        load_error_kvar=asked.load_error_kvar,
        scenes=-(-asked.scenarios // together),
        together=together,
        seed=asked.seed,
        liars=tuple(sorted({1, asked.max_attacked})),
        estimator=asked.estimator,
        settings=(("max_attacked", asked.max_attacked),),
    )


def attacks(site: Site, asked: Asked) -> str:
    """What the simulated attacks of a report take from the feeder's files, and what from options.

    Parameters
    ----------
    site, asked
        The feeder, and what was asked.
    """
    names = ("step", "estimator", "load_error_kw", "load_error_kvar")
    return sources(site, plan(site, asked), {option(name): getattr(asked, name) for name in names})


def _liars(asked: Asked) -> list[str]:
    return ["--max-attacked", str(asked.max_attacked)]


def _known(asked: Asked) -> list[str]:
    who = [word for name in asked.unknown or () for word in ("--unknown", name)]
    return who + ["--busbar-unknown"] * asked.busbar_unknown


def _protection(asked: Asked) -> list[str]:
    bound = [] if math.isnan(asked.lie_volt) else ["--lie-volt", word(asked.lie_volt)]
    goal = [] if asked.goal is None else ["--goal", asked.goal]
    return [*_liars(asked), *goal, *bound, *_known(asked)]


def _campaigned(asked: Asked) -> list[str]:
    count = [word for number in sorted({1, asked.max_attacked}) for word in ("--liars", str(number))]
    setting = ["--setting", f"max_attacked={asked.max_attacked}"]
    watched = _given(asked, "step", "estimator", "load_error_kw", "load_error_kvar")
    return ["--scenarios", str(asked.scenarios), "--seed", str(asked.seed), *count, *setting, *watched]


def _fleet(asked: Asked) -> list[str]:
    words = _given(asked, "preset", "busbar", "band")
    return ["--seed", str(asked.seed), *words] + ["--hosting"] * asked.hosting


def _given(asked: Asked, *names: str) -> list[str]:
    """Options whose values are not the usual ones."""
    words = []
    for name in names:
        value = getattr(asked, name)
        if value is not None:
            values = value if isinstance(value, tuple) else (value,)
            words += [option(name), *map(word, values)]
    return words


def option(name: str) -> str:
    """What an attribute of `Asked` is called on the command line.

    Parameters
    ----------
    name
        The attribute.
    """
    return f"--{name.replace('_', '-')}"


STUDIES: Final[dict[str, Study]] = {
    "detectable": Study(_detectable, _liars, "lies of meters, errors of customers"),
    "protect": Study(_protect, _protection, "meters protected, against attacks"),
    "droop": Study(_droop, _fleet, "fleets, steps and loads", seeded=True),
    "campaign": Study(_campaign, _campaigned, "simulated attacks", seeded=True),
    "redundancy": Study(
        _redundancy,
        lambda asked: [word for name in asked.silent for word in ("--silent", name)] + _known(asked),
        "searching for liars that stay invisible",
    ),
    "calibrate": Study(
        _calibrate,
        lambda asked: [] if asked.readings is None else ["--readings", str(asked.readings)],
        "errors that the readings may speak for",
    ),
}
"""Studies of a report, in the order of its sections."""


def misplaced(asked: Asked, chosen: Collection[str]) -> list[str]:
    """Return what was asked of none of the chosen studies, one sentence each.

    Parameters
    ----------
    asked, chosen
        What was asked, and names of studies.
    """
    problems = []
    for each in fields(asked):
        if each.default is MISSING:
            continue
        without = replace(asked, **{each.name: each.default})
        takers = [name for name, study in STUDIES.items() if study.options(asked) != study.options(without)]
        if takers and not set(takers) & set(chosen):
            problems.append(f"{option(each.name)} goes with {', '.join(takers)}")
    return problems


def outcome(
    name: str,
    site: Site,
    asked: Asked,
    *,
    kept: Keeping,
    bar: Callable[[str], AbstractContextManager[Progress]],
) -> Outcome:
    """Run a study; whatever goes wrong with it becomes part of the report.

    Parameters
    ----------
    name
        One of STUDIES.
    site, asked
        The feeder, and what was asked.
    kept
        Keeps finished work.
    bar
        Shows how far it is.
    """
    from feeders.report.html import Outcome
    from feeders.studies.droop.fleets import NOTHING, NoInverters

    study = STUDIES[name]
    words = ["gridsec", "study", name, asked.feeder, *study.options(asked)]
    start = time.perf_counter()
    found: Result | None = None
    problem, absent = "", False
    with bar(study.what) as tell:
        try:
            found = study.run(site, asked, kept, tell)
        except NoInverters as error:
            absent = not asked.hosting
            problem = NOTHING if absent else str(error)
        except (GridsecError, ValueError) as error:
            problem = str(error)
    duration = time.perf_counter() - start
    return Outcome(
        name, found, problem, command_line(words), duration, resumed=name in kept.resumed, absent=absent
    )


def see_readings(names: Iterable[str], site: Site, asked: Asked) -> None:
    """Refuse readings that cannot be compared with before the other studies, and not after them.

    Parameters
    ----------
    names, site, asked
        The studies, the feeder, and what was asked.

    Raises
    ------
    RecordingInvalid
        If they are no readings of this feeder.
    """
    if "calibrate" in names and asked.readings is not None:
        from feeders.studies.calibrate.readings import frames

        frames(site, asked.readings)


def versions() -> dict[str, str]:
    """Versions of everything that numbers and pictures depend on."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def write(made: Report, out: Path, folder: Path) -> None:
    """Write the files of a report; the page last, when all that it speaks of is there, and nothing else.

    Parameters
    ----------
    made
        The report.
    out, folder
        The page, and the folder beside it.

    Raises
    ------
    OSError
        If something cannot be written.
    """
    from feeders.report.html import FEEDER

    figures = folder / "figures"
    out.parent.mkdir(parents=True, exist_ok=True)
    figures.mkdir(parents=True, exist_ok=True)
    for name, data in made.pictures.items():
        (figures / name).write_bytes(data)
    for part in (*STUDIES, FEEDER):
        for old in figures.glob(f"{part}-*"):
            if old.suffix in {".svg", ".png"} and old.name not in made.pictures:
                old.unlink()
        whose = f"{part}-"
        tables = {name.removeprefix(whose): t for name, t in made.tables.items() if name.startswith(whose)}
        write_tables(folder / "tables", part, tables)
    replace_file(out, lambda new: new.write_text(made.html, encoding="utf-8"))


def seeds(names: Iterable[str], asked: Asked) -> Mapping[str, int]:
    """With what everything random began, by study.

    Parameters
    ----------
    names, asked
        The studies, and what was asked.
    """
    return {name: asked.seed for name in names if STUDIES[name].seeded}


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
    from feeders.format.columns import ESTIMATORS
    from feeders.studies.protect import check as see_question
    from gridsec.errors import no_choice
    from gridsec.grid.droop import PRESETS

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
    from feeders.convert.provenance import origin
    from feeders.model.site import load
    from feeders.report.build import report as make
    from feeders.report.html import About

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
    from gridsec.errors import no_choice

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
