"""`gridsec study redundancy`, `protect`, `detectable`: planning of meters."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.cli import console
from service.cli.console import Studied, finite
from service.cli.paths import check_paths, write_tables
from service.cli.session import JournalAt, NoJournal, keeping
from service.cli.sources import converted
from service.cli.study_words import Output, Plot, cell_text

if TYPE_CHECKING:
    from feeders.studies.protect import Protect
    from feeders.studies.running import Progress as Tell

Unknown = Annotated[
    list[str] | None,
    typer.Option(help="A customer with unknown powers; may be repeated. [default: those without a meter]"),
]
Silent = Annotated[list[str] | None, typer.Option(help="A meter that is missing; may be repeated.")]
BusbarUnknown = Annotated[bool, typer.Option("--busbar-unknown", help="The busbar's voltage is not metered.")]
CurvesAt = Annotated[str, typer.Option(help="Operating point of the inverters: steepest or deadband.")]
Out = Annotated[Path | None, typer.Option(help="Write the tables into this folder, as CSV and Parquet.")]


GoalOf = Annotated[
    str | None,
    typer.Option(
        help="identify: manipulated meters are named; notice: an attack is detected; bound: attacks stay "
        "small with true powers; contain: also with false powers. [default: identify if attacks can be "
        "invisible, otherwise contain]"
    ),
]
LieVolt = Annotated[
    float | None,
    typer.Option(
        help="For bound and contain: largest hidden attack, V of the busbar's level. "
        "[contain: half of the increase by further meters and false powers]"
    ),
]

NO_ANSWER = (
    "The goal counts attacks that fit exactly to exactly known powers, and no attack does. Attacks within "
    "honest errors: --goal contain. Attacks behind an unknown load: --unknown CUSTOMER. Attacks that decay "
    "with the inverters within seconds: --attack any."
)


def redundancy(
    feeder: Studied = "simbench-lv-rural1",
    *,
    unknown: Unknown = None,
    silent: Silent = None,
    busbar_unknown: BusbarUnknown = False,
    curves: CurvesAt = "steepest",
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    out: Out = None,
    plot: Plot = None,
) -> None:
    """Count the manipulated meters of invisible attacks: in all, by meter, by part, with missing meters."""
    from feeders.model.site import load
    from feeders.studies.redundancy import redundancy as study

    check_paths(folders={"--out": out}, files={"--journal": journal}, replaced={"--plot": plot})
    with keeping("redundancy", feeder, journal, without=no_journal) as kept:
        site = load(converted(feeder, out))
        with bar("search for invisible attacks") as report_progress, as_usage_error():
            found = study(
                site,
                unknown=unknown,
                silent=silent or (),
                busbar_known=not busbar_unknown,
                curves=curves,
                journal=kept,
                progress=report_progress,
            )
        shown = ", ".join(found.unknown) or "none"
        console.say(f"{found.feeder}: customers with unknown powers: {shown}")
        output = Output("redundancy")
        output.table("Manipulated meters of invisible attacks", found.summary)
        output.table("By meter", found.meters)
        output.table("Invisible attacks inside one part", found.parts)
        if found.silent:
            output.table(f"Changes without {', '.join(found.silent)}", found.changes)
        write_tables(out, "redundancy", found.tables)
        output.end(site, found, plot)


def protect(
    feeder: Studied = "simbench-lv-rural1",
    *,
    max_attacked: Annotated[
        int, typer.Option(help="Largest number of manipulated meters among the others.", min=1)
    ] = 2,
    goal: GoalOf = None,
    lie_volt: LieVolt = None,
    attack: Annotated[str, typer.Option(help="Attacks that count: persistent or any.")] = "persistent",
    unknown: Unknown = None,
    busbar_unknown: BusbarUnknown = False,
    never: Annotated[
        list[str] | None, typer.Option(help="A meter that cannot be protected; may be repeated.")
    ] = None,
    greedy: Annotated[
        bool, typer.Option("--greedy", help="For large feeders: fewest not proven; with the gap.")
    ] = False,
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    out: Out = None,
    plot: Plot = None,
) -> None:
    """Find the fewest meters to protect so that attacks are identified, detected, or bounded."""
    from feeders.model.site import load
    from feeders.studies.protect import Goal, check
    from feeders.studies.protect import protect as study
    from feeders.studies.unobservable import Attack

    asked: dict[str, Any] = {
        "max_attacked": max_attacked,
        "lie_volt": math.nan if lie_volt is None else lie_volt,
        "unknown": unknown,
        "busbar_known": not busbar_unknown,
    }
    with as_usage_error():
        check(goal=goal, attack=attack, **asked)
    check_paths(folders={"--out": out}, files={"--journal": journal}, replaced={"--plot": plot})
    with keeping("protect", feeder, journal, without=no_journal) as kept:
        site = load(converted(feeder, out))
        with bar("meters protected, against attacks") as report_progress, as_usage_error():
            found = study(
                site,
                goal=Goal(goal) if goal else None,
                attack=Attack(attack),
                never=never or (),
                exact=not greedy,
                journal=kept,
                progress=lambda known, done: report_progress(done, known),
                **asked,
            )
        output = Output("protect")
        _tell_protection(found, len(site.meter_ids), output)
        write_tables(out, "protect", found.tables)
        output.end(site, found, plot)


def _tell_protection(found: Protect, of: int, output: Output) -> None:
    count = len(found.meters)
    if found.no_answer:
        console.say(f"{found.feeder}: {found.goal} requires no protection here; that is no safety")
        console.out.print(NO_ANSWER)
        return
    proof = "no fewer suffice" if not found.gap else f"at least {found.least} are needed"
    measure = "largest hidden attack, V" if found.goal.in_volts else "fewest meters of an invisible attack"
    console.say(f"{found.feeder}: protect {count} of {of} meters; {proof}")
    none = " (∞: no set of meters)" if math.inf in (found.before, found.after) else ""
    console.out.print(f"{measure}: {cell_text(found.before)} before, {cell_text(found.after)} after{none}")
    if found.goal.in_volts:
        console.out.print(
            f"required ({found.goal}): at most {cell_text(found.lie_volt)}; "
            f"one meter hides {cell_text(found.alone)} alone, with true powers, whatever others are protected"
        )
    if count:
        output.table("Protect", found.meters)
        output.table("Attacks that require them", found.attacks)


def detectable(
    feeder: Studied = "simbench-lv-rural1",
    *,
    max_attacked: Annotated[
        int, typer.Option(help="Largest number of meters manipulated together.", min=1)
    ] = 2,
    share: Annotated[
        float, typer.Option(help="Load of every customer, share of its peak.", min=0.0, callback=finite)
    ] = 0.5,
    risk: Annotated[float, typer.Option(help="Neglected probability, at one moment.")] = 1e-3,
    trials: Annotated[int, typer.Option(help="Simulated attacks of each size.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the simulated attacks.", min=0)] = 0,
    workers: Annotated[
        int | None, typer.Option(help="Processes. [default: all cores, from 50 meters on]", min=1)
    ] = None,
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    out: Out = None,
    plot: Plot = None,
) -> None:
    """Compute the largest hidden attacks, the smallest found and named ones, and their errors; in V."""
    from feeders.model.site import load
    from feeders.studies.campaign.guarantees import rehearse
    from feeders.studies.detectable import detectable as study
    from feeders.studies.detectable import workers as where

    check_paths(folders={"--out": out}, files={"--journal": journal}, replaced={"--plot": plot})
    with keeping("detectable", feeder, journal, without=no_journal) as kept:
        site = load(converted(feeder, out))
        with bar("attacks on meters, errors of customers") as tell, as_usage_error():
            found = study(
                site,
                max_attacked=max_attacked,
                share=share,
                risk=risk,
                runner=where(site, workers),
                journal=kept,
                progress=tell,
            )
        more = found.max_attacked - 1
        places = ["customer", "bus"]
        output = Output("detectable")
        output.table(
            f"Attacks, V: each meter alone, and with {more} more", found.meters.drop(columns=places).round(3)
        )
        output.table(
            f"Errors of the voltage with {more + 1} hidden manipulated meters, V", found.customers.round(3)
        )
        write_tables(out, "detectable", found.tables)
        if trials:
            with bar("simulated attacks") as report_progress:
                seen = rehearse(
                    site, found, trials=trials, seed=seed, share=share, journal=kept, progress=report_progress
                )
            console.out.print(
                f"{seen.trials} attacks up to the hidden size: {seen.hidden_named} with a meter named\n"
                f"{seen.trials} attacks from the named size on: {seen.large_missed} missed, "
                f"{seen.honest_named} with an honest meter named"
            )
            write_tables(out, "detectable", {**found.tables, "trials": seen.table})
        output.end(site, found, plot)


@contextmanager
def bar(what: str) -> Iterator[Tell]:
    """A progress bar on the terminal, with the name of the counted pieces of work."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console.err,
        transient=True,
        disable=not console.err.is_terminal,
    ) as shown:
        task = shown.add_task(escape(what), total=None)
        yield lambda done, total: shown.update(task, completed=done, total=total)


@contextmanager
def as_usage_error() -> Iterator[None]:
    """Convert a ValueError to a usage error."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
