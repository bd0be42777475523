"""`gridsec study compare`: all estimators on the same simulated attacks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from feeders.util import command_line
from service.cli import console
from service.cli.console import Studied, finite, refuse_options
from service.cli.session import JournalAt, Keeping, NoJournal, keeping
from service.cli.sources import converted
from service.cli.study_campaign import LoadErrorKvar, LoadErrorKw, MetersAs
from service.cli.study_words import Output, Plot

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.studies.comparison import ComparisonPlan, ComparisonRow

Families = Annotated[list[str] | None, typer.Option(help="An estimator; may be repeated. [default: all]")]
Cases = Annotated[list[str] | None, typer.Option(help="A case; may be repeated. [default: all]")]
MaxAttacked = Annotated[
    int, typer.Option(help="Number of manipulated meters, and M of the estimators.", min=1)
]
Seeds = Annotated[int, typer.Option(help="Runs of each case.", min=1)]
Duration = Annotated[float, typer.Option(help="Length of a run, s.", min=70.0, callback=finite)]
ReportQ = Annotated[bool, typer.Option(help="Meters report the net reactive power.")]
Csv = Annotated[Path | None, typer.Option(help="Write all numbers to this file.")]
Write = Annotated[
    Path | None, typer.Option(help="Replace the tables between the markers of this Markdown file.")
]
Workers = Annotated[
    int | None, typer.Option(help="Processes for matrix inequalities. [default: all cores]", min=1)
]


def compare(
    feeder: Studied = "simbench-lv-rural1",
    *,
    family: Families = None,
    case: Cases = None,
    max_attacked: MaxAttacked = 2,
    seeds: Seeds = 3,
    duration: Duration = 480.0,
    meters: MetersAs = "site",
    load_error_kw: LoadErrorKw = 0.1,
    load_error_kvar: LoadErrorKvar = 0.05,
    report_q: ReportQ = False,
    csv: Csv = None,
    write: Write = None,
    workers: Workers = None,
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    plot: Plot = None,
) -> None:
    """Compare all estimators on the same simulated attacks.

    The truth is full AC power flow; loads and meters are as uncertain as stated to the estimators. Estimators
    that cannot monitor the feeder are listed with the reason.
    """
    from feeders.model.site import load
    from feeders.registry import FAMILIES
    from feeders.simulation.trial import LoadError, TrialMeterErrors
    from feeders.studies.comparison import CASES, ComparisonPlan, markdown, splice, write_csv
    from feeders.util import replace_file
    from gridsec.errors import no_choice

    families, cases = tuple(FAMILIES), tuple(each.name for each in CASES)
    refuse_options(
        [
            *no_choice("--meters", TrialMeterErrors, meters),
            *no_choice("--family", families, *(family or ())),
            *no_choice("--case", cases, *(case or ())),
        ],
        files={"--journal": journal},
        replaced={"--csv": csv, "--write": write, "--plot": plot},
        read={"--write": write},
    )
    plan = ComparisonPlan(
        max_attacked=max_attacked,
        seeds=seeds,
        duration_s=duration,
        load_error=LoadError(load_error_kw, load_error_kvar),
        meters=TrialMeterErrors(meters),
        report_q=report_q,
        families=tuple(name for name in families if not family or name in family),
        cases=tuple(name for name in cases if not case or name in case),
        workers=workers or os.cpu_count() or 1,
    )
    if write is not None:
        splice(write.read_text(encoding="utf-8"), "")  # refuses a document without markers before the work
    with keeping("compare", feeder, journal, without=no_journal) as kept:
        site = load(converted(feeder, None))
        rows = _compared(site, plan, kept)
        output = Output("compare")
        _show(rows, plan, output)
        if csv is not None:
            write_csv(rows, csv)
        if write is not None:
            told = f"{_told(feeder, site, plan)}\n\n{markdown(rows, plan)}"
            # Read again: the document may have changed during the work.
            text = splice(write.read_text(encoding="utf-8"), told)
            replace_file(write, lambda new: new.write_text(text, encoding="utf-8"))
        output.end(site, rows, plot)


def _compared(site: Site, plan: ComparisonPlan, kept: Keeping) -> list[ComparisonRow]:
    """Run the comparison with a progress display."""
    from feeders.studies.comparison import compare as study

    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=console.err,
        transient=True,
        disable=not console.err.is_terminal,
    ) as bar:
        task = bar.add_task("", total=None)
        return study(
            site, plan, journal=kept, progress=lambda what: bar.update(task, description=escape(what))
        )


def _told(feeder: str, site: Site, plan: ComparisonPlan) -> str:
    """Conditions of the tables, in one sentence."""
    error, runs = plan.load_error, "one run" if plan.seeds == 1 else f"{plan.seeds} runs"
    return (
        f"{site.tables.meta.title or site.feeder.name}: {len(site.meter_ids)} meters "
        f"(errors: {plan.meters}{', with q' * plan.report_q}), {site.droop.tau.size} inverters, "
        f"M = {plan.max_attacked}, "
        f"{runs} of {plan.duration_s:g} s at {plan.step_s:g} s per case, powers known within "
        f"{error.p_kw:g} kW and {error.q_kvar:g} kvar (1 sigma, correlated over {error.correlation_s:g} s).\n"
        f"Measured by:\n\n    {_command(feeder, plan)}"
    )


def _command(feeder: str, plan: ComparisonPlan) -> str:
    """Command line of the same measurement."""
    from feeders.studies.comparison import ComparisonPlan

    usual = ComparisonPlan()
    options = {
        "--max-attacked": (plan.max_attacked, usual.max_attacked),
        "--seeds": (plan.seeds, usual.seeds),
        "--duration": (plan.duration_s, usual.duration_s),
        "--meters": (str(plan.meters), str(usual.meters)),
        "--load-error-kw": (plan.load_error.p_kw, usual.load_error.p_kw),
        "--load-error-kvar": (plan.load_error.q_kvar, usual.load_error.q_kvar),
    }
    words: list[object] = ["gridsec", "study", "compare", feeder]
    for name, (value, default) in options.items():
        words += [name, value] if value != default else []
    words += ["--report-q"] * plan.report_q
    for name, chosen, every in (
        ("--family", plan.families, usual.families),
        ("--case", plan.cases, usual.cases),
    ):
        words += [word for each in chosen if chosen != every for word in (name, each)]
    return command_line(words)


def _show(rows: list[ComparisonRow], plan: ComparisonPlan, output: Output) -> None:
    """Print one table for each case, with reasons below it."""
    from feeders.studies.comparison import CASES, HEADERS, cells

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
        output.explain(list(HEADERS))
        for reason in reasons:
            console.say(reason)
