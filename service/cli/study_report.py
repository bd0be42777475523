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
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from feeders.util import command_line, replace_file, word
from gridsec.errors import GridsecError, InputInvalid, Problem
from service.cli import console
from service.cli.console import FAILED, Studied, options_of, print_error, read_all
from service.cli.paths import write_tables
from service.cli.session import keeping
from service.cli.sources import converted
from service.cli.study_campaign import EstimatorName, KnownKvar, KnownKw, Seed, Step, planned, sources
from service.cli.study_droop import Allowed, Preset
from service.cli.study_planning import BusbarUnknown, GoalOf, LieVolt, Silent, Unknown, bar

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.report.build import Report
    from feeders.report.html import Result, StudyOutcome
    from feeders.studies.campaign.plan import CampaignPlan
    from feeders.studies.running import Progress
    from service.cli.session import Keeping


LIBRARIES: Final = (
    *("gridsec", "numpy", "scipy", "pandas", "cvxpy", "clarabel", "highspy", "power-grid-model"),
    *("pyarrow", "matplotlib"),
)


@dataclass(frozen=True, slots=True)
class Asked:
    """Options of a report; every study uses those that concern it."""

    feeder: str  # as on the command line
    max_attacked: int = 2  # M
    goal: str | None = None  # of the protection; None: that of the study
    lie_volt: float = math.nan  # bound of an attack
    unknown: tuple[str, ...] | None = None  # customers with unknown powers
    silent: tuple[str, ...] = ()  # missing meters
    busbar_unknown: bool = False
    scenarios: int = 160
    seed: int = 0  # of all random numbers
    workers: int = 1
    step: float | None = None  # of the simulated attacks, s; None, here and below: the feeder's files
    estimator: str | None = None
    load_error_kw: float | None = None
    load_error_kvar: float | None = None
    preset: str | None = None  # options of the inverters' study; None: its defaults
    busbar: tuple[float, float] | None = None
    band: tuple[float, float] | None = None
    hosting: bool = False
    readings: Path | None = None  # a recording to compare with the files


@dataclass(frozen=True, slots=True)
class Study:
    """Properties of a study in a report."""

    run: Callable[..., Result]  # of a feeder and options, with a journal and a progress
    options: Callable[[Asked], list[str]]  # equivalent options of its own command
    what: str  # name of the counted pieces of work, for the progress bar
    seeded: bool = False  # uses the seed


def _detectable(site: Site, asked: Asked, **kept: Any) -> Result:
    from feeders.studies.detectable import detectable, workers

    runner = workers(site, None if asked.workers > 1 else 1)
    return detectable(site, max_attacked=asked.max_attacked, runner=runner, **kept)


def _protect(site: Site, asked: Asked, **kept: Any) -> Result:
    from feeders.studies.protect import Goal, protect

    return protect(
        site,
        max_attacked=asked.max_attacked,
        goal=None if asked.goal is None else Goal(asked.goal),
        lie_volt=asked.lie_volt,
        unknown=asked.unknown,
        busbar_known=not asked.busbar_unknown,
        journal=kept["journal"],
        progress=lambda known, done: kept["progress"](done, known),
    )


def _redundancy(site: Site, asked: Asked, **kept: Any) -> Result:
    from feeders.studies.redundancy import redundancy

    busbar_known = not asked.busbar_unknown
    return redundancy(site, unknown=asked.unknown, silent=asked.silent, busbar_known=busbar_known, **kept)


def _droop(site: Site, asked: Asked, **kept: Any) -> Result:
    from feeders.studies.droop.study import DroopOptions, droop

    low, high = asked.busbar or (1.0, 1.0)
    least, most = asked.band or (None, None)
    options = DroopOptions(
        preset=asked.preset, v0_low=low, v0_high=high, v_min=least, v_max=most, hosting=asked.hosting
    )
    return droop(site, options, seed=asked.seed, **kept)


def _calibrate(site: Site, asked: Asked, **kept: Any) -> Result:
    from feeders.studies.calibrate.study import calibrate

    if asked.readings is None:
        raise InputInvalid([Problem("missing", "recorded readings are missing")])
    return calibrate(site, asked.readings, **kept)


def _campaign(site: Site, asked: Asked, **kept: Any) -> Result:
    from feeders.studies.campaign.study import campaign
    from feeders.studies.running import cores

    return campaign(site, plan(site, asked), runner=cores(asked.workers), **kept)


def plan(site: Site, asked: Asked) -> CampaignPlan:
    """Return the simulated attacks of a report."""
    from feeders.studies.campaign.plan import CampaignPlan

    together = min(asked.scenarios, CampaignPlan().together)
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
    """Summary of the simulated attacks of a report, with the origin of their parameters: files or options."""
    names = ("step", "estimator", "load_error_kw", "load_error_kvar")
    return sources(site, plan(site, asked), {option_of(name): getattr(asked, name) for name in names})


def _words(asked: Asked, *names: str) -> list[str]:
    """Options with other values than the defaults, as words of a command line."""
    words: list[str] = []
    defaults = {each.name: each.default for each in fields(Asked)}
    for name in names:
        value, option = getattr(asked, name), option_of(name)
        if value in (defaults[name], None, ()) or (isinstance(value, float) and math.isnan(value)):
            continue
        if value is True:
            words.append(option)
        elif name in ("unknown", "silent"):
            words += [each for one in value for each in (option, one)]
        else:
            words += [option, *map(word, value if isinstance(value, tuple) else (value,))]
    return words


def _m(asked: Asked) -> list[str]:
    return ["--max-attacked", str(asked.max_attacked)]


def _campaigned(asked: Asked) -> list[str]:
    count = [each for number in sorted({1, asked.max_attacked}) for each in ("--liars", str(number))]
    setting = ["--setting", f"max_attacked={asked.max_attacked}"]
    watched = _words(asked, "step", "estimator", "load_error_kw", "load_error_kvar")
    return ["--scenarios", str(asked.scenarios), "--seed", str(asked.seed), *count, *setting, *watched]


def option_of(name: str) -> str:
    """Name of an attribute of `Asked` on the command line."""
    return f"--{name.replace('_', '-')}"


STUDIES: Final[dict[str, Study]] = {
    "detectable": Study(_detectable, _m, "attacks on meters, errors of customers"),
    "protect": Study(
        _protect,
        lambda asked: _m(asked) + _words(asked, "goal", "lie_volt", "unknown", "busbar_unknown"),
        "meters protected, against attacks",
    ),
    "droop": Study(
        _droop,
        lambda asked: ["--seed", str(asked.seed), *_words(asked, "preset", "busbar", "band", "hosting")],
        "fleets, steps and loads",
        seeded=True,
    ),
    "campaign": Study(_campaign, _campaigned, "simulated attacks", seeded=True),
    "redundancy": Study(
        _redundancy,
        lambda asked: _words(asked, "silent", "unknown", "busbar_unknown"),
        "search for invisible attacks",
    ),
    "calibrate": Study(_calibrate, lambda asked: _words(asked, "readings"), "possible errors of the files"),
}
"""Studies of a report, in the order of its sections."""


def misplaced(asked: Asked, chosen: Collection[str]) -> list[str]:
    """Return the options that none of the chosen studies uses, one sentence each."""
    problems = []
    for each in fields(asked):
        if each.default is MISSING:
            continue
        without = replace(asked, **{each.name: each.default})
        takers = [name for name, study in STUDIES.items() if study.options(asked) != study.options(without)]
        if takers and not set(takers) & set(chosen):
            problems.append(f"{option_of(each.name)} goes with {', '.join(takers)}")
    return problems


def outcome(
    name: str,
    site: Site,
    asked: Asked,
    *,
    kept: Keeping,
    bar: Callable[[str], AbstractContextManager[Progress]],
) -> StudyOutcome:
    """Run a study of STUDIES by its name; a failure becomes part of the report."""
    from feeders.report.html import StudyOutcome
    from feeders.studies.droop.fleets import NOTHING, NoInverters

    study = STUDIES[name]
    words = ["gridsec", "study", name, asked.feeder, *study.options(asked)]
    start = time.perf_counter()
    found: Result | None = None
    problem, absent = "", False
    with bar(study.what) as report_progress:
        try:
            found = study.run(site, asked, journal=kept, progress=report_progress)
        except NoInverters as error:
            absent = not asked.hosting
            problem = NOTHING if absent else str(error)
        except (GridsecError, ValueError) as error:
            problem = str(error)
    duration = time.perf_counter() - start
    return StudyOutcome(
        name, found, problem, command_line(words), duration, resumed=name in kept.resumed, absent=absent
    )


def see_readings(names: Iterable[str], site: Site, asked: Asked) -> None:
    """Refuse readings that cannot be compared with the files before the other studies run.

    Raises RecordingInvalid if the file has no readings of this feeder.
    """
    if "calibrate" in names and asked.readings is not None:
        from feeders.studies.calibrate.readings import frames

        frames(site, asked.readings)


def versions() -> dict[str, str]:
    """Versions of all libraries that affect numbers and figures."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def write(made: Report, out: Path, folder: Path) -> None:
    """Write the page of a report, and the folder beside it; the page comes last, after figures and tables.

    Raises OSError if a file cannot be written.
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
    """Seed of each study."""
    return {name: asked.seed for name in names if STUDIES[name].seeded}


Page = Annotated[
    Path, typer.Option(help="The page; figures, tables and journals go into a folder beside it.")
]
Studies = Annotated[
    str | None,
    typer.Option(help="Names of studies, separated by commas. [default: all with data]"),
]
MaxAttacked = Annotated[int, typer.Option(help="M: largest number of meters manipulated together.", min=1)]
Scenarios = Annotated[int, typer.Option(help="Number of simulated attacks.", min=1)]
Workers = Annotated[
    int | None, typer.Option(help="Processes for simulated attacks. [default: all cores]", min=1)
]
BusbarLimits = Annotated[
    tuple[float, float] | None, typer.Option(help="Limits of the busbar's voltage, pu. [default: 1 1]")
]
Hosting = Annotated[bool, typer.Option("--hosting", help="Compute hosting capacities, too.")]
Readings = Annotated[
    Path | None, typer.Option(help="A recording (Parquet or CSV) to compare with the files.")
]
At = Annotated[
    str | None,
    typer.Option(help="Date and time of the report, like 2026-11-21T12:00Z. [default: now]"),
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
    estimator: EstimatorName = None,
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

    After an interruption the same command continues. The report states questions that a study cannot answer.
    """
    from feeders.format.columns import ESTIMATORS
    from feeders.studies.protect import check as see_question
    from gridsec.errors import no_choice
    from gridsec.grid.devices import PRESETS

    problems: list[str] = []
    chosen = _studies(studies, tuple(STUDIES), recorded=readings is not None, problems=problems)
    problems += no_choice("--preset", PRESETS, *([preset] if preset else []))
    problems += no_choice("--estimator", ESTIMATORS, *([estimator] if estimator else []))
    problems += [*_no_limits("--busbar", busbar), *_no_limits("--band", band, apart=True)]
    moments = [_told(datetime.now(UTC))] if at is None else read_all("--at", [at], _moment, problems)
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
    """Folder beside the page."""
    return out.with_name(f"{out.stem}-files")


def _no_limits(option: str, limits: tuple[float, float] | None, *, apart: bool = False) -> list[str]:
    """Problems of limits that the droop study would refuse, before the work."""
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
            console.say(attacks(site, asked))
        outcomes = [outcome(name, site, asked, kept=kept, bar=bar) for name in chosen]
        about = About(made, command, versions(), seeds(chosen, asked), folder.name)
        write(make(site, outcomes, about, source), out, folder)
    console.say(f"{out}: {len(outcomes)} studies; figures and tables in {folder}")
    for each in outcomes:
        if each.absent:
            console.say(f"{each.study}: {each.problem}")
    failed = [each for each in outcomes if each.result is None and not each.absent]
    for each in failed:
        print_error(f"{each.study}: {each.problem}")
    if failed:
        raise typer.Exit(FAILED)


def _studies(
    text: str | None, known: tuple[str, ...], *, recorded: bool, problems: list[str]
) -> tuple[str, ...]:
    """Names of studies, each once; calibration only with readings."""
    from gridsec.errors import no_choice

    if text is None:
        return tuple(name for name in known if recorded or name != "calibrate")
    names = [name.strip() for name in text.split(",")]
    problems += no_choice("--studies", known, *names)
    if "calibrate" in names and not recorded:
        problems.append("--studies: calibrate needs --readings")
    return tuple(name for name in known if name in names)


def _moment(text: str) -> str:
    """Time of the report."""
    try:
        return _told(datetime.fromisoformat(text))
    except ValueError as error:
        raise ValueError("expected a date and time of ISO 8601") from error


def _told(given: datetime) -> str:
    return f"{given.astimezone(UTC) if given.tzinfo else given:%Y-%m-%d %H:%M} UTC"


def _command(asked: Asked, out: Path, studies: str | None) -> str:
    """Command line of the same report: options that differ from the defaults."""
    words: list[object] = ["gridsec", "study", "report", asked.feeder, "--out", out]
    words += [] if studies is None else ["--studies", studies]
    words += _words(asked, *(each.name for each in fields(asked) if each.name not in ("feeder", "workers")))
    return command_line(words)
