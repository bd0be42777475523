"""`gridsec replay`: alarms of the service for a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from gridsec.errors import FeederInvalid, Problem
from service.cli import console
from service.cli.console import FAILED, print_error, refuse_options
from service.cli.serve import EstimatorName, Grace, MaxSkew

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.simulation.recording import Recording


def replay(
    *,
    file: Annotated[Path, typer.Argument(help="A recording (Parquet).", metavar="FILE")],
    feeder: Annotated[
        str | None, typer.Option(help="Folder or name. [default: the feeder of the recording]")
    ] = None,
    estimator: EstimatorName = None,
    clock: Annotated[
        str,
        typer.Option(help="events: time of the readings; wall: time of their arrival, as in live operation."),
    ] = "events",
    max_skew: MaxSkew = None,
    grace: Grace = None,
    skipped: Annotated[
        list[str] | None,
        typer.Option(help="FROM:TO, Unix s: ticks that the live service skipped; may be repeated."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object per alarm transition.")] = False,
) -> None:
    """Run a recording through the chain of the live service, and print the resulting alarms.

    Use the `--estimator`, `--max-skew` and `--grace` of the live service, from its options or GRIDSEC_...
    variables: this command does not read the variables.
    """
    from feeders.registry import choose
    from feeders.simulation.recording import RecordingInvalid, read_recording
    from service.alarms.state_machine import to_json
    from service.engine.replay import ReplayCounts
    from service.engine.replay import replay as run
    from service.ingest.align import Clock

    refuse_options(_problems(clock, estimator, max_skew, grace, skipped or []))
    intervals = [interval for one in skipped or [] if (interval := _interval(one)) is not None]
    recording = read_recording(file)
    if clock == Clock.WALL and not recording.timed:
        raise RecordingInvalid(f"{file}: no column arrival, which --clock wall needs")
    site = choose(_site_of(recording, feeder), estimator=estimator)
    tally = ReplayCounts()
    began: float | None = None
    results = run(
        site,
        recording.readings(),
        tally,
        clock=Clock(clock),
        max_skew_s=max_skew,
        grace_s=grace,
        skipped=intervals,
    )
    for result in results:
        began = result.report.t if began is None else began
        for transition in result.transitions:
            alarm = transition.alarm
            if as_json:
                record = {"t": transition.t, "change": str(transition.change), "alarm": to_json(alarm)}
                print(json.dumps(record))
            else:
                about = escape(f"{alarm.kind} {alarm.meter or alarm.feeder}: {alarm.reason}")
                console.out.print(f"{transition.t - began:10.1f} s  {transition.change:<12} {about}")
    summary = console.err if as_json else console.out
    summary.print(f"ticks:    {_counts(tally.ticks)}, skipped {tally.skipped}")
    summary.print(f"readings: {_counts(tally.readings)}, never arrived {tally.lost}")
    if not tally.judged:
        print_error("no tick has a verdict: there is no answer on manipulation")
        raise typer.Exit(FAILED)


def _problems(
    clock: str, estimator: str | None, max_skew: float | None, grace: float | None, skipped: list[str]
) -> list[str]:
    """Problems of the options."""
    from feeders.format.columns import ESTIMATORS
    from gridsec.errors import no_choice
    from service.ingest.align import Clock

    out = no_choice("--clock", Clock, clock)
    out += no_choice("--estimator", ESTIMATORS, *([estimator] if estimator is not None else []))
    if max_skew is not None and not 0.0 < max_skew < float("inf"):
        out.append(f"--max-skew is {max_skew:g}; it must be a positive number")
    if grace is not None and not 0.0 <= grace < float("inf"):
        out.append(f"--grace is {grace:g}; it must be a number that is not negative")
    wrong = [one for one in skipped if _interval(one) is None]
    out += [f"--skipped is {one!r}; it must be FROM:TO, two Unix times in this order" for one in wrong]
    return out


def _interval(text: str) -> tuple[float, float] | None:
    """First and last time of `FROM:TO`, Unix s; None for another text."""
    try:
        first, last = map(float, text.split(":"))
    except ValueError:
        return None
    return (first, last) if first <= last else None


def _site_of(recording: Recording, feeder: str | None) -> Site:
    """The given feeder, or the feeder of the recording; a difference in its files is printed."""
    from feeders.model.site import load
    from feeders.simulation.recording import RecordingInvalid

    file = recording.path
    name = feeder or recording.feeder
    if name is None:
        raise typer.BadParameter("the file does not contain the name of its feeder", param_hint="--feeder")
    try:
        site = load(name)
    except FeederInvalid as error:
        if feeder is not None:
            raise
        where = f"{file} was recorded on {name!r}: give its folder with --feeder"
        raise FeederInvalid([Problem("recorded-feeder", where), *error.problems]) from error
    if recording.feeder not in {None, site.feeder.name}:
        raise RecordingInvalid(f"{file}: recorded on {recording.feeder}, not on {site.feeder.name}")
    if recording.digest not in {None, site.digest}:
        console.err.print(f"[yellow]{escape(name)} has changed since this was recorded.[/]")
    return site


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()) if count) or "none"
