"""`gridsec study campaign`: thousands of simulated attacks, on all cores or on a Dask cluster."""

from __future__ import annotations

import os
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from rich.markup import escape

from service import console
from service.cli_plan import bar, said, show
from service.console import Feeder
from service.tables import write_tables

if TYPE_CHECKING:
    import pandas as pd

    from feeders.load import Site
    from feeders.studies.campaign_plan import Kind, Plan
    from feeders.studies.campaign_run import Runner

TOGETHER = 16
"""Scenarios of a scene, where more than as many are asked for."""


def campaign(
    feeder: Feeder = "simbench-lv-rural1",
    *,
    scenarios: Annotated[
        int, typer.Option(help="How many, about a sixteenth of them without a lie.", min=1)
    ] = 160,
    seed: Annotated[int, typer.Option(help="Chooses everything random.", min=0)] = 0,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            help="A kind of lie and its sizes, like bias:1,3; may be repeated. [default: six kinds]"
        ),
    ] = None,
    promised: Annotated[
        bool,
        typer.Option(
            "--promised",
            help="Lies of the sizes that `study detectable` finds, for M = 2, in place of the six kinds.",
        ),
    ] = False,
    liars: Annotated[
        list[int] | None, typer.Option(help="How many lie; may be repeated. [default: 1 and 3]", min=1)
    ] = None,
    place: Annotated[
        list[str] | None,
        typer.Option(help="random, street, sensitive or colluding; may be repeated. [default: all]"),
    ] = None,
    season: Annotated[list[str] | None, typer.Option(help="May be repeated. [default: all four]")] = None,
    duration: Annotated[float, typer.Option(help="Length of a scenario, s.", min=30.0)] = 600.0,
    design: Annotated[str, typer.Option(help="factorial or random combinations.")] = "factorial",
    estimator: Annotated[
        str, typer.Option(help="Who watches; see `gridsec feeders estimators`.")
    ] = "sequential",
    setting: Annotated[
        list[str] | None,
        typer.Option(
            help="A setting of [monitor], like max_attacked=2; may be repeated. [default: the feeder's]"
        ),
    ] = None,
    alarms_per_year: Annotated[
        list[float] | None,
        typer.Option(help="False alarms it may raise in a year; may be repeated, for a curve. [default: 1]"),
    ] = None,
    learned: Annotated[
        float, typer.Option(help="Hours over which it has learned its meters' fixed errors before.", min=0.0)
    ] = 0.0,
    meters: Annotated[str, typer.Option(help="Errors of the meters: site, real or white.")] = "site",
    load_error_kw: Annotated[
        float, typer.Option(help="What nobody knows of each customer's active power, 1 sigma.", min=0.0)
    ] = 0.1,
    load_error_kvar: Annotated[
        float, typer.Option(help="The same of its reactive power, 1 sigma.", min=0.0)
    ] = 0.05,
    workers: Annotated[int | None, typer.Option(help="Processes. [default: all cores]", min=1)] = None,
    dask: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, in place of processes here.")
    ] = None,
    journal: Annotated[
        Path | None, typer.Option(help="Keep finished work in this file, and go on from it.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write the tables into this folder, as CSV and Parquet.")
    ] = None,
) -> None:
    """Simulate attacks over days of profiles: who is named, missed or falsely named, and how soon."""
    from feeders.load import load
    from feeders.profiles import Season
    from feeders.studies.campaign import campaign as study
    from feeders.studies.campaign_plan import KINDS, Design, Place, Plan
    from feeders.trials import LoadError, Meters

    site = load(feeder)
    together = min(scenarios, TOGETHER)
    with said():
        plan = Plan(
            scenes=-(-scenarios // together),
            together=together,
            seed=seed,
            kinds=tuple(_kind(each) for each in kind or ()) or KINDS,
            liars=tuple(liars or (1, 3)),
            places=_each(place, Place, "--place"),
            design=_each([design], Design, "--design")[0],
            duration_s=duration,
            onset_s=(0.1 * duration, 0.3 * duration),
            lying_s=0.5 * duration,
            seasons=_each(season, Season, "--season"),
            estimator=estimator,
            alarms_per_year=tuple(sorted(set(alarms_per_year or (1.0,)))),
            learn_s=3600.0 * learned,
            settings=tuple(_setting(each) for each in setting or ()),
            meters=_each([meters], Meters, "--meters")[0],
            load_error=LoadError(load_error_kw, load_error_kvar),
        )
        if promised:
            plan = _with_promised(site, plan, plan.kinds if kind else ())
        with bar("scenarios") as tell:
            found = study(site, plan, runner=_runner(workers, dask), journal=journal, progress=tell)
    impossible = int((found.scenarios["reason"] != "").sum())
    console.out.print(
        escape(f"{found.feeder}: {plan.scenarios} scenarios of {duration:g} s watched by {plan.estimator}")
        + (f"; {impossible} cannot be played, see `reason`" if impossible else "")
    )
    show("By kind and size", _short(found.by_size))
    show("By place", _short(found.by_place))
    show("By number of liars", _short(found.by_liars))
    show("False names while nobody lies, and liars named", found.false_names)
    write_tables(out, found.tables)


def _with_promised(site: Site, plan: Plan, others: tuple[Kind, ...]) -> Plan:
    from feeders.studies.campaign_plan import promised
    from feeders.studies.detectable import detectable

    stated = plan.trial(site, plan.moment(0)).stated
    with bar("lies of meters, errors of customers") as tell:
        found = detectable(stated, max_attacked=2, progress=tell)
    return replace(plan, kinds=(*others, *promised(found)))


def _short(table: pd.DataFrame) -> pd.DataFrame:
    """What fits on a terminal; everything is in the files."""
    limits = [name for name in table.columns if name.endswith(("_low", "_high")) and name != "false_high"]
    return table.drop(columns=[*limits, "liars_told", "error_liars_worst", "error_others_worst"])


Choice = TypeVar("Choice", bound=StrEnum)


def _each(chosen: list[str] | None, known: type[Choice], option: str) -> tuple[Choice, ...]:
    if chosen is None:
        return tuple(known)
    for name in chosen:
        if name not in tuple(known):
            raise typer.BadParameter(f"{name!r}: expected one of {', '.join(known)}", param_hint=option)
    return tuple(known(name) for name in dict.fromkeys(chosen))


def _kind(text: str) -> Kind:
    from feeders.lies import Trick
    from feeders.studies.campaign_plan import Kind

    name, _, sizes = text.partition(":")
    (trick,) = _each([name], Trick, "--kind")
    try:
        return Kind(name, trick, tuple(float(size) for size in sizes.split(",")) if sizes else (0.0,))
    except ValueError as error:
        raise typer.BadParameter(
            f"{text!r}: expected something like bias:1,3", param_hint="--kind"
        ) from error


def _setting(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: expected NAME=NUMBER", param_hint="--setting") from error


def _runner(workers: int | None, dask: str | None) -> Runner:
    from feeders.studies.campaign_run import Dask, Here, Processes

    if dask is not None:
        if workers is not None:
            raise typer.BadParameter("a Dask cluster has its own workers", param_hint="--workers")
        return Dask(dask)
    count = workers or os.cpu_count() or 1
    return Processes(count) if count > 1 else Here()
