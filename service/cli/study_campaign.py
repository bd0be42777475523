"""`gridsec study campaign`: thousands of simulated attacks, on all cores or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import numpy as np
import typer

from gridsec.errors import raise_if_any
from service.cli import console
from service.cli.console import Studied, finite, options_of, read_all
from service.cli.paths import check_paths, write_tables
from service.cli.session import JournalAt, Keeping, NoJournal, keeping
from service.cli.sources import converted
from service.cli.study_planning import Out, as_usage_error, bar
from service.cli.study_words import Output, Plot

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from feeders.studies.campaign.plan import AttackClass, CampaignPlan
    from feeders.studies.campaign.study import Campaign
    from feeders.studies.running import Runner


SHORTEST: Final = 10  # smallest number of readings of a scenario: attacks start after a tenth of it

FILES: Final = "feeder's files"


def planned(
    site: Site,
    *,
    step: float | None,
    duration: float | None = None,
    load_error_kw: float | None,
    load_error_kvar: float | None,
    **chosen: Any,
) -> CampaignPlan:
    """Return the plan of a campaign; all problems of its options are raised at once.

    None stands for the values of the files. With one of the load errors the other is zero. `chosen` are
    attributes of the plan by name.

    Raises ValueError if a scenario is too short for the interval of the readings, a setting is unknown, or as
        for `CampaignPlan`.
    """
    from feeders.simulation.trial import LoadError
    from feeders.studies.campaign.plan import CampaignPlan, wrong_settings

    problems: list[str] = [*wrong_settings(site, chosen.get("settings") or ())]
    step_s = step or site.tables.meta.monitor.tick_s
    if duration is not None and duration < SHORTEST * step_s:
        problems.append(
            f"--duration: {duration:g} s are too short for one reading every {step_s:g} s "
            f"({FILES if step is None else '--step'}): at least {SHORTEST * step_s:g} s, or more frequent "
            "readings with --step"
        )
        duration = None
    chosen |= {"step_s": step, "duration_s": duration}
    if load_error_kw is not None or load_error_kvar is not None:
        chosen["load_error"] = LoadError(load_error_kw or 0.0, load_error_kvar or 0.0)
    try:
        plan = CampaignPlan.of(site, **{name: value for name, value in chosen.items() if value is not None})
    except ValueError as error:
        raise_if_any([*problems, str(error)])
        raise
    raise_if_any(problems)
    return plan


def sources(site: Site, plan: CampaignPlan, given: Mapping[str, object]) -> str:
    """Summary of a campaign, with the origin of its parameters: files, or options with a value."""
    from feeders.model.site import load_doubt

    some = {option for option, value in given.items() if value is not None}
    asked = "--step", "--estimator", "--alarms-per-year"
    step, estimator, rate = (option if option in some else FILES for option in asked)
    if "--promised" in some and "--estimator" not in some:
        estimator = "--promised"
    rates = ", ".join(f"{each:g}" for each in plan.alarms_per_year)
    loads = [option for option in ("--load-error-kw", "--load-error-kvar") if option in some]
    doubt, base = load_doubt(plan.trial(site, plan.moment(0)).stated), site.feeder.base_kva
    kw, kvar = (float(np.median(each[site.meters])) * base for each in (doubt.p, doubt.q))
    return (
        f"{site.feeder.name}: {plan.scenarios} scenarios of {plan.duration_s / plan.step_s:.0f} readings, "
        f"one every {plan.step_s:g} s ({step}), monitored by {plan.estimator} "
        f"({estimator}); allowed false alarms a year: {rates} ({rate}); powers of "
        f"metered customers within {kw:.2g} kW and {kvar:.2g} kvar, medians of 1 sigma "
        f"({', '.join(loads) or FILES})"
    )


Scenarios = Annotated[
    int,
    typer.Option(
        help="Number, rounded up to whole scenes; the first of each scene is without an attack.", min=1
    ),
]
Together = Annotated[
    int,
    typer.Option(
        help="Scenarios of a scene, the first without an attack; 2: a separate scene for each attack.",
        min=1,
    ),
]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.", min=0)]
Kinds = Annotated[
    list[str] | None,
    typer.Option(
        help="An attack kind and its sizes, like bias:1,3; may be repeated. bias, together, scaling: % of "
        "nominal; drift: % per minute; coordinated, coordinated-power, power: % by which a false load moves "
        "the least affected meter; replay, clock-shift: s; inverter: % of its rating; stuck: no size. "
        "[default: six kinds]"
    ),
]
Promised = Annotated[
    bool,
    typer.Option(
        "--promised",
        help="Attacks of the sizes that `study detectable` finds, for M = 2, in place of the six kinds, and "
        "the number of its guarantees that hold; the estimator is modal if --estimator states no other.",
    ),
]
Liars = Annotated[
    list[int] | None,
    typer.Option(help="Number of manipulated meters; may be repeated. [default: 1 and 3]", min=1),
]
Places = Annotated[
    list[str] | None,
    typer.Option(help="random, street, sensitive or colluding; may be repeated. [default: all]"),
]
Seasons = Annotated[list[str] | None, typer.Option(help="May be repeated. [default: all four]")]
Duration = Annotated[
    float | None,
    typer.Option(help="Length of a scenario, s. [default: 600 readings]", min=30.0, callback=finite),
]
Step = Annotated[
    float | None,
    typer.Option(
        help="Interval of the readings, s. [default: as in the feeder's files]", min=0.1, callback=finite
    ),
]
DesignOf = Annotated[str, typer.Option(help="factorial or random combinations.")]
EstimatorName = Annotated[
    str | None,
    typer.Option(help="Estimator, see `gridsec feeders estimators`. [default: as in the feeder's files]"),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        help="A setting of [monitor], like max_attacked=2; may be repeated. [default: the feeder's]"
    ),
]
AlarmsPerYear = Annotated[
    list[float] | None,
    typer.Option(
        help="Allowed false alarms per year; may be repeated, for a curve. [default: as in the files]"
    ),
]
Learned = Annotated[
    float,
    typer.Option(
        help="Hours of learning the meters' fixed errors before the scenario.", min=0.0, callback=finite
    ),
]
MetersAs = Annotated[str, typer.Option(help="Errors of the meters: site, real or white.")]
LoadErrorKw = Annotated[
    float,
    typer.Option(help="Uncertainty of each customer's active power, 1 sigma.", min=0.0, callback=finite),
]
LoadErrorKvar = Annotated[
    float,
    typer.Option(help="Uncertainty of each customer's reactive power, 1 sigma.", min=0.0, callback=finite),
]
KnownKw = Annotated[
    float | None,
    typer.Option(
        help="Uncertainty of each metered customer's active power, 1 sigma; correlated over ten minutes. "
        "[default: as the files state for registers; with --load-error-kvar, none]",
        min=0.0,
        callback=finite,
    ),
]
KnownKvar = Annotated[
    float | None,
    typer.Option(
        help="Uncertainty of its reactive power. [default: as the files state for power factors; with "
        "--load-error-kw, none]",
        min=0.0,
        callback=finite,
    ),
]
Workers = Annotated[int | None, typer.Option(help="Processes. [default: all cores]", min=1)]
DaskAt = Annotated[str | None, typer.Option(help="Address of a Dask scheduler, in place of processes here.")]


def campaign(
    feeder: Studied = "simbench-lv-rural1",
    *,
    scenarios: Scenarios = 160,
    together: Together = 16,
    seed: Seed = 0,
    kind: Kinds = None,
    promised: Promised = False,
    liars: Liars = None,
    place: Places = None,
    season: Seasons = None,
    duration: Duration = None,
    step: Step = None,
    design: DesignOf = "factorial",
    estimator: EstimatorName = None,
    setting: Settings = None,
    alarms_per_year: AlarmsPerYear = None,
    learned: Learned = 0.0,
    meters: MetersAs = "site",
    load_error_kw: KnownKw = None,
    load_error_kvar: KnownKvar = None,
    workers: Workers = None,
    dask: DaskAt = None,
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    out: Out = None,
    plot: Plot = None,
) -> None:
    """Simulate attacks over days of profiles: meters named correctly, missed or named falsely, and delays."""
    from feeders.model.site import load
    from feeders.profiles import Season
    from feeders.registry import MODAL
    from feeders.simulation.trial import TrialMeterErrors
    from feeders.studies.campaign.plan import Design, Place
    from feeders.studies.campaign.study import campaign as study

    check_paths(folders={"--out": out}, files={"--journal": journal}, replaced={"--plot": plot})
    site, count = load(converted(feeder, out)), min(scenarios, together)
    problems = ["--workers: a Dask cluster has its own workers"] * (dask is not None and workers is not None)
    if count == 1:
        lies = {"--kind": kind, "--promised": promised, "--liars": liars, "--place": place}
        if told := [option for option, value in lies.items() if value]:
            problems.append(f"{', '.join(told)}: {NO_LIES}")
    kinds = read_all("--kind", kind, partial(_kind, step_s=step or site.tables.meta.monitor.tick_s), problems)
    settings = read_all("--setting", setting, _setting, problems)
    places = _each("--place", Place, place, problems)
    seasons = _each("--season", Season, season, problems)
    (drawn,) = _each("--design", Design, [design], problems) or (None,)
    (quality,) = _each("--meters", TrialMeterErrors, [meters], problems) or (None,)
    with keeping("campaign", feeder, journal, without=no_journal) as kept, as_usage_error():
        plan = options_of(
            lambda: planned(
                site,
                step=step,
                duration=duration,
                load_error_kw=load_error_kw,
                load_error_kvar=load_error_kvar,
                scenes=-(-scenarios // count),
                together=count,
                seed=seed,
                kinds=tuple(kinds) or None,
                liars=tuple(liars or (1, 3)),
                places=places,
                design=drawn,
                seasons=seasons,
                # The sizes of `study detectable` are those of this estimator.
                estimator=estimator or (MODAL if promised else None),
                alarms_per_year=tuple(sorted(set(alarms_per_year))) if alarms_per_year else None,
                learn_s=3600.0 * learned,
                settings=tuple(settings),
                meters=quality,
            ),
            problems,
        )
        given = {
            "--step": step,
            "--estimator": estimator,
            "--promised": promised or None,
            "--alarms-per-year": alarms_per_year,
            "--load-error-kw": load_error_kw,
            "--load-error-kvar": load_error_kvar,
        }
        console.say(sources(site, plan, given))
        if promised:
            plan = _with_promised(site, plan, plan.kinds if kind else (), kept)
        with bar("scenarios") as report_progress:
            found = study(site, plan, runner=_runner(workers, dask), journal=kept, progress=report_progress)
        output = Output("campaign")
        _print(found, output)
        write_tables(out, "campaign", found.tables)
        output.end(site, found, plot)


NO_LIES = (
    "one scenario of each scene is the control scenario without an attack; expected --scenarios and "
    "--together of 2 or more"
)
"""Refused: the result would suggest that attacks were missed."""


def _print(found: Campaign, output: Output) -> None:
    plan, impossible = found.plan, int((found.scenarios["reason"] != "").sum())
    told = f"{plan.scenarios} scenarios of {plan.duration_s:g} s monitored by {plan.estimator}"
    note = f"; {impossible} cannot be played, see `reason`" if impossible else ""
    console.say(f"{found.feeder}: {told}{note}")
    if not found.promises.empty:
        output.table("Guarantees of `study detectable`", found.promises)
    output.table("By kind and size", _short(found.by_size))
    output.table("By place", _short(found.by_place))
    output.table("By number of manipulated meters", _short(found.by_liars))
    output.table("False accusations without an attack, and manipulated meters named", found.false_names)


def _with_promised(
    site: Site, plan: CampaignPlan, others: tuple[AttackClass, ...], kept: Keeping
) -> CampaignPlan:
    from feeders.studies.campaign.guarantees import earliest_s, promised
    from feeders.studies.detectable import detectable, workers

    stated = plan.trial(site, plan.moment(0)).stated
    with bar("attacks on meters, errors of customers") as report_progress:
        found = detectable(
            stated, max_attacked=2, runner=workers(stated, None), journal=kept, progress=report_progress
        )
    low, high = plan.onset_s
    least = earliest_s(stated)
    onset_s = max(low, least), max(high, least)
    return replace(plan, kinds=(*others, *promised(stated, found)), onset_s=onset_s)


def _short(table: pd.DataFrame) -> pd.DataFrame:
    """Columns that fit on a terminal; the files contain all of them."""
    limits = [name for name in table.columns if name.endswith(("_low", "_high")) and name != "false_high"]
    return table.drop(columns=[*limits, "liars_told", "error_liars_worst", "error_others_worst"])


Choice = TypeVar("Choice", bound=StrEnum)


def _each(
    option: str, known: type[Choice], chosen: list[str] | None, problems: list[str]
) -> tuple[Choice, ...] | None:
    """Chosen values; None without a choice, or if a problem was added."""
    from gridsec.errors import no_choice

    wrong = no_choice(option, known, *(chosen or ()))
    problems += wrong
    return None if wrong or not chosen else tuple(known(name) for name in dict.fromkeys(chosen))


def _kind(text: str, step_s: float) -> AttackClass:
    from feeders.simulation.attacks import AttackKind
    from feeders.studies.campaign.plan import KINDS, AttackClass

    name, _, sizes = text.partition(":")
    if name not in tuple(AttackKind):
        raise ValueError(f"expected one of {', '.join(AttackKind)}")
    trick = AttackKind(name)
    if not sizes:
        usual = [kind.every(step_s) for kind in KINDS if kind.trick is trick]
        sizes = ",".join(str(size) for kind in usual for size in kind.sizes)
    try:
        return AttackClass(name, trick, tuple(float(size) for size in sizes.split(",")))
    except ValueError as error:
        raise ValueError("expected something like bias:1,3") from error


def _setting(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise ValueError("expected NAME=NUMBER") from error


def _runner(workers: int | None, dask: str | None) -> Runner:
    from feeders.studies.running import Dask, cores

    return cores(workers) if dask is None else Dask(dask)
