"""`gridsec feeders`: list, validation, conversion and design of feeders."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from gridsec.errors import FeederInvalid, raise_if_any
from service.cli.console import FEEDER, Feeder, err, out, print_error
from service.cli.paths import check_paths
from service.cli.sources import show_check, spared
from service.cli.study_planning import as_usage_error
from service.errors import prefixed

if TYPE_CHECKING:
    from feeders.convert.convert import Conversion

app = typer.Typer(no_args_is_help=True, help="List, show, validate, convert and design feeders.")

SHOWN = 40
"""Printed rows of the table of changes; the file contains all of them."""


@app.command("list")
def feeders_list() -> None:
    """List the feeders of the project."""
    from feeders.model.site import load, names

    table = Table("name", "title", "phases", "customers", "meters", "inverters", "M")
    for name in names(balanced=False):
        site = load(name)
        counts = (len(site.feeder.customers), len(site.meter_ids), site.droop.customer.size)
        cells = (*map(str, counts), str(site.tables.meta.monitor.max_attacked))
        phases = "single-phase" if site.feeder.busbar_phases == 3 else "balanced"
        table.add_row(name, escape(site.tables.meta.title), phases, *cells)
    out.print(table)


@app.command("show")
def feeders_show(feeder: Feeder) -> None:
    """Show a feeder and its customers."""
    from feeders.format.validation import told
    from feeders.model.site import load

    site = load(feeder)
    meta = site.tables.meta
    out.print(f"[bold]{escape(meta.name)}[/] {escape(meta.title)}")
    out.print(
        f"{told(site.nominal_volt, 'g')} phase to neutral, {len(site.spanning.buses)} buses, "
        + (f"{len(site.ties)} closed ties, " if site.ties.size else "")
        + f"{len(site.feeder.customers)} customers, {len(site.meter_ids)} meters, "
        f"monitored every {meta.monitor.tick_s:g} s for up to {meta.monitor.max_attacked} manipulated meters"
    )
    table = Table("customer", "bus", "phases", "meter", "load kW", "PV kW", "inverter kVA", "droop")
    for row in site.tables.customers:
        numbers = (f"{row.load_kw:g}", f"{row.pv_kw:g}", f"{row.inverter_kva:g}")
        table.add_row(escape(row.customer), escape(row.bus), row.phases, row.meter, *numbers, row.droop)
    out.print(table)


@app.command("estimators")
def feeders_estimators() -> None:
    """List the estimators."""
    from feeders.registry import FAMILIES, EstimatorUnusable

    table = Table("name", "summary")
    for name in FAMILIES:
        try:
            what = FAMILIES[name].summary
        except EstimatorUnusable as problem:
            what = str(problem)
        table.add_row(name, escape(what))
    out.print(table)


@app.command("validate")
def feeders_validate(
    folder: Annotated[list[Path], typer.Argument(help="Folders, or names of feeders of the project.")],
) -> None:
    """Validate feeders and print all problems."""
    from feeders.format.tables import examine
    from feeders.model.equipment import folder_of
    from feeders.model.site import from_tables

    invalid = False
    for path in folder:
        found = examine(folder_of(path) or path)
        problems: tuple[str, ...] = found.problems
        if found.tables is not None:
            try:
                from_tables(found.tables)
            except FeederInvalid as error:
                problems = error.problems
        for note in found.notes:
            out.print(f"{escape(str(path))}: note: {escape(note)}")
        if problems:
            invalid = True
            print_error(str(FeederInvalid(prefixed(f"{path}: ", problem) for problem in problems)))
        else:
            out.print(f"[green]{escape(str(path))}: valid[/]")
    if invalid:
        raise typer.Exit(FEEDER)


@app.command("design")
def feeders_design(
    feeder: Feeder,
    *,
    estimator: Annotated[
        str | None,
        typer.Option(help="See `feeders estimators`. [default: as in the file]"),
    ] = None,
    max_attacked: Annotated[
        int | None, typer.Option(help="Number M of manipulated meters. [default: as in the file]")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes for matrix inequalities. [default: all cores]", min=1)
    ] = None,
) -> None:
    """Design a feeder's estimator in advance; slow designs are cached for the next start."""
    from feeders.format.columns import ESTIMATORS
    from feeders.model.site import load
    from feeders.registry import choose, design
    from gridsec.errors import no_choice

    problems = no_choice("--estimator", ESTIMATORS, *([estimator] if estimator else []))
    if max_attacked is not None and max_attacked < 0:
        problems.append(f"--max-attacked is {max_attacked}; it must not be negative")
    with as_usage_error():
        raise_if_any(problems)
    site = choose(load(feeder), estimator=estimator, max_attacked=max_attacked)
    columns = (TextColumn("observers"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    started = time.monotonic()
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task("design", total=None, visible=False)
        finished = design(
            site,
            workers=workers or os.cpu_count() or 1,
            progress=lambda done, total: bar.update(task, completed=done, total=total, visible=True),
        )
    settings = site.tables.meta.monitor
    out.print(
        f"{escape(site.feeder.name)}: {settings.estimator}, M = {finished.max_attacked}, "
        f"{finished.observers} observers, {time.monotonic() - started:.2f} s"
    )
    if finished.proof:
        out.print(finished.proof)


@app.command("convert")
def convert(
    source: Annotated[
        str,
        typer.Argument(
            help="pandapower:NETWORK, simbench:CODE, a pandapower or power-grid-model JSON file, "
            "an OpenDSS master file (.dss), or a feeder's folder."
        ),
    ],
    folder: Annotated[Path, typer.Argument(help="Folder to write.")],
    *,
    root: Annotated[str | None, typer.Option(help="Bus of the metered busbar.")] = None,
    name: Annotated[
        str | None,
        typer.Option(help="Name of the feeder. [default: that of FOLDER, or of a source that is a feeder]"),
    ] = None,
    droop: Annotated[str | None, typer.Option(help="Droop preset of the source's generators.")] = None,
    opened: Annotated[
        list[str] | None, typer.Option("--open", help="A line to open; may be repeated.")
    ] = None,
    meshed: Annotated[bool, typer.Option("--meshed", help="Keep loops closed.")] = False,
    one_voltage: Annotated[
        bool,
        typer.Option(
            "--one-voltage", help="End at transformers to another voltage: each becomes a customer."
        ),
    ] = False,
) -> None:
    """Convert another tool's network into a feeder's folder, and check it by AC power flow against that tool.

    Changes of the conversion are printed, and written to conversion.csv and SOURCE.md. A feeder that was
    written by hand is never replaced; an earlier conversion that differs is kept as FOLDER-1.
    """
    from feeders.convert.convert import convert as run

    check_paths(over={"FOLDER": folder})
    with spared(folder):
        done = run(
            source,
            folder,
            root=root,
            name=name,
            droop=droop,
            opened=opened or (),
            meshed=meshed,
            one_voltage=one_voltage,
        )
    _show_changes(done)
    out.print(f"[green]{escape(str(folder))} written[/]")
    show_check(done)
    if done.check is not None:
        out.print(f"largest difference {done.check.largest_pu:.2e} pu, at bus {escape(done.check.at)}")


def _show_changes(done: Conversion) -> None:
    """Print the changes of a conversion, equal ones in one row."""
    if not done.changes:
        return
    fates: dict[tuple[str, str, str], list[str]] = {}
    for change in done.changes:
        fates.setdefault((change.prop, change.done, change.effect), []).append(change.element)
    table = Table("element", "property", "done", "effect", title="Left out, approximated, added, changed")
    for (prop, what, effect), elements in list(fates.items())[:SHOWN]:
        more = f" and {len(elements) - 3} more" if len(elements) > 3 else ""
        table.add_row(escape(", ".join(elements[:3]) + more), escape(prop), what, escape(effect))
    out.print(table)
    if len(fates) > SHOWN:
        out.print(f"and {len(fates) - SHOWN} more kinds of changes, in conversion.csv")
