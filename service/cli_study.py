"""`gridsec study`: what estimators do on a feeder, measured in simulation."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from service import cli_calibrate, cli_campaign, cli_droop, cli_plan, cli_report, console
from service.console import Studied
from service.foreign import converted

if TYPE_CHECKING:
    from feeders.comparison import Plan, Row
    from feeders.load import Site

app = typer.Typer(no_args_is_help=True, help="Study feeders and estimators.")
app.command("redundancy")(cli_plan.redundancy)
app.command("protect")(cli_plan.protect)
app.command("detectable")(cli_plan.detectable)
app.command("calibrate")(cli_calibrate.calibrate)
app.command("campaign")(cli_campaign.campaign)
app.command("droop")(cli_droop.droop)
app.command("report")(cli_report.report)


@app.callback()
def study() -> None:
    """Study feeders and estimators."""


@app.command("compare")
def study_compare(
    feeder: Studied = "simbench-lv-rural1",
    *,
    family: Annotated[
        list[str] | None, typer.Option(help="An estimator; may be repeated. [default: all]")
    ] = None,
    case: Annotated[list[str] | None, typer.Option(help="A case; may be repeated. [default: all]")] = None,
    max_attacked: Annotated[
        int, typer.Option(help="How many meters lie, and estimators are to withstand.", min=1)
    ] = 2,
    seeds: Annotated[int, typer.Option(help="Runs of each case.", min=1)] = 3,
    duration: Annotated[float, typer.Option(help="Length of a run, s.", min=70.0)] = 480.0,
    meters: Annotated[str, typer.Option(help="Errors of the meters: site, real or white.")] = "site",
    load_error_kw: Annotated[
        float, typer.Option(help="What nobody knows of each customer's active power, 1 sigma.", min=0.0)
    ] = 0.1,
    load_error_kvar: Annotated[
        float, typer.Option(help="The same of its reactive power, 1 sigma.", min=0.0)
    ] = 0.05,
    report_q: Annotated[bool, typer.Option(help="Meters report the net reactive power.")] = False,
    csv: Annotated[Path | None, typer.Option(help="Write all numbers into this file.")] = None,
    write: Annotated[
        Path | None, typer.Option(help="Replace the tables between the markers of this Markdown file.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes for matrix inequalities. [default: all cores]", min=1)
    ] = None,
) -> None:
    """Let all estimators watch the same simulated attacks, and tell who did what.

    The truth is full AC power flow; what the estimators know of loads and meters is as uncertain as it is
    stated to be. Estimators that cannot watch the feeder are listed with the reason.
    """
    from feeders.comparison import CASES, Plan, compare, markdown, splice, write_csv
    from feeders.estimators import FAMILIES
    from feeders.load import load
    from feeders.trials import LoadError, Meters

    plan = Plan(
        max_attacked=max_attacked,
        seeds=seeds,
        duration_s=duration,
        load_error=LoadError(load_error_kw, load_error_kvar),
        meters=Meters(_known([meters], tuple(Meters), "--meters")[0]),
        report_q=report_q,
        families=_known(family, tuple(FAMILIES), "--family"),
        cases=_known(case, tuple(each.name for each in CASES), "--case"),
        workers=workers or os.cpu_count() or 1,
    )
    before = None if write is None else write.read_text(encoding="utf-8")
    if before is not None:
        splice(before, "")  # a document without markers is refused before the work, not after it
    site = load(converted(feeder, None))
    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=console.err,
        transient=True,
        disable=not console.err.is_terminal,
    ) as bar:
        task = bar.add_task("", total=None)
        rows = compare(site, plan, progress=lambda what: bar.update(task, description=escape(what)))
    _show(rows, plan)
    if csv is not None:
        write_csv(rows, csv)
    if write is not None and before is not None:
        write.write_text(splice(before, f"{_told(site, plan)}\n\n{markdown(rows, plan)}"), encoding="utf-8")


def _known(chosen: list[str] | None, known: tuple[str, ...], option: str) -> tuple[str, ...]:
    """Check names given as an option; all of them, if none is given."""
    for name in chosen or ():
        if name not in known:
            raise typer.BadParameter(f"{name!r}: expected one of {', '.join(known)}", param_hint=option)
    return tuple(name for name in known if not chosen or name in chosen)


def _told(site: Site, plan: Plan) -> str:
    """What the tables hold for, in one sentence."""
    error, runs = plan.load_error, "one run" if plan.seeds == 1 else f"{plan.seeds} runs"
    return (
        f"{site.tables.meta.title or site.feeder.name}: {len(site.meter_ids)} meters "
        f"(errors: {plan.meters}{', with q' * plan.report_q}), {site.droop.tau.size} inverters, "
        f"M = {plan.max_attacked}, "
        f"{runs} of {plan.duration_s:g} s at {plan.step_s:g} s per case, powers known within "
        f"{error.p_kw:g} kW and {error.q_kvar:g} kvar (1 sigma, correlated over {error.correlation_s:g} s).\n"
        f"Measured by:\n\n    {_command(site, plan)}"
    )


def _command(site: Site, plan: Plan) -> str:
    """The command line that measures all this again."""
    from feeders.comparison import Plan

    usual = Plan()
    options = {
        "--max-attacked": (plan.max_attacked, usual.max_attacked),
        "--seeds": (plan.seeds, usual.seeds),
        "--duration": (plan.duration_s, usual.duration_s),
        "--meters": (str(plan.meters), str(usual.meters)),
        "--load-error-kw": (plan.load_error.p_kw, usual.load_error.p_kw),
        "--load-error-kvar": (plan.load_error.q_kvar, usual.load_error.q_kvar),
    }
    words = ["gridsec study compare", site.feeder.name]
    words += [f"{name} {value}" for name, (value, default) in options.items() if value != default]
    words += ["--report-q"] * plan.report_q
    for name, chosen, every in (
        ("--family", plan.families, usual.families),
        ("--case", plan.cases, usual.cases),
    ):
        words += [f"{name} {each}" for each in chosen if chosen != every]
    return " ".join(words)


def _show(rows: list[Row], plan: Plan) -> None:
    """Print one table for each case; reasons stand below it."""
    from feeders.comparison import CASES, HEADERS, cells

    meanings = {case.name: case.told(plan.max_attacked) for case in CASES}
    for name in dict.fromkeys(row.case for row in rows):
        table = Table(*HEADERS, title_justify="left", title=f"[bold]{name}[/]: {meanings[name]}")
        reasons: list[str] = []
        for row in rows:
            if row.case != name:
                continue
            if row.reason:
                reasons.append(f"{row.family}: {row.reason}")
            else:
                table.add_row(*map(escape, cells(row)))
        console.out.print(table, soft_wrap=False)
        for reason in reasons:
            console.out.print(escape(reason))
