"""`gridsec study calibrate`: comparison of recorded readings with a feeder's files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli import console
from service.cli.console import Studied, refuse_options
from service.cli.paths import write_tables
from service.cli.session import JournalAt, NoJournal, keeping
from service.cli.sources import converted
from service.cli.study_planning import Out, as_usage_error, bar
from service.cli.study_words import Output, Plot

if TYPE_CHECKING:
    from feeders.studies.calibrate.study import Calibrate


def calibrate(
    feeder: Studied = "simbench-lv-rural1",
    *,
    readings: Annotated[
        Path, typer.Option(help="A recording (Parquet), or a CSV table with columns meter, t, v_volt, p_kw.")
    ],
    risk: Annotated[
        float, typer.Option(help="Probability of any proposal if the files are right.", min=1e-9, max=0.5)
    ] = 0.05,
    tolerance: Annotated[
        float, typer.Option(help="Accepted error of lines' lengths, 1 sigma, relative.")
    ] = 0.02,
    exclude: Annotated[list[str] | None, typer.Option(help="A meter to exclude; may be repeated.")] = None,
    look_for: Annotated[
        list[str] | None,
        typer.Option(help="bus, phase, swap, length or meter; may be repeated. [default: all]"),
    ] = None,
    write: Annotated[
        Path | None, typer.Option(help="Write a corrected copy of the feeder into this new folder.")
    ] = None,
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    out: Out = None,
    plot: Plot = None,
) -> None:
    """Compare recorded readings with a feeder's files: places, phases, lengths, meters, loads.

    `--write` makes a copy with the significant corrections only; the feeder itself is never changed.
    """
    from feeders.model.site import load
    from feeders.studies.calibrate.feeder import site_of
    from feeders.studies.calibrate.search import FileErrorKind
    from feeders.studies.calibrate.study import calibrate as study
    from feeders.studies.calibrate.study import wrong_numbers
    from gridsec.errors import no_choice

    refuse_options(
        [*no_choice("--look-for", FileErrorKind, *(look_for or ())), *wrong_numbers(risk, tolerance)],
        folders={"--out": out},
        new={"--write": write},
        files={"--journal": journal},
        replaced={"--plot": plot},
        read={"--readings": readings},
    )
    with keeping("calibrate", feeder, journal, without=no_journal) as kept:
        feeder = converted(feeder, out)
        site = site_of(feeder)
        with bar("possible errors of the files") as report_progress, as_usage_error():
            found = study(
                site,
                readings,
                risk=risk,
                tolerance=tolerance,
                exclude=exclude or (),
                kinds=[kind for kind in FileErrorKind if not look_for or kind in look_for],
                journal=kept,
                progress=report_progress,
            )
        output = Output("calibrate")
        _tell(found, output)
        write_tables(out, "calibrate", found.tables)
        if write is not None:
            found.corrected(feeder, write)
            console.say(f"{write}: {found.feeder} with {len(found.corrections)} corrections")
        output.end(load(feeder), found, plot)


def _tell(found: Calibrate, output: Output) -> None:
    from feeders.studies.calibrate.study import UNREAD

    console.say(
        f"{found.feeder}: {found.frames} moments in {found.span_h:.4g} h; any proposal would be "
        f"wrong with probability {found.risk:g} at most"
    )
    if found.unread:
        count, phases = int((found.meters["verdict"] == UNREAD).sum()), " and ".join(found.unread)
        console.out.print(
            f"left out: {count} of {len(found.meters)} meters, as the busbar's readings have no voltage of "
            f"phase {phases} (column v_phases)"
        )
    if found.proposals.empty:
        console.out.print("nothing to propose")
    else:
        output.table("Proposals", found.proposals.drop(columns=["low", "high"]))
    output.table("Meters", found.meters.drop(columns=["low_percent", "high_percent"]))
    output.table("Lines", found.lines)
    output.table("Customers", found.customers)
    output.table("Loads", found.loads)
    output.table("Errors of powers and meters", found.errors)
