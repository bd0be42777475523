"""`gridsec study droop`: stability of the droop fleet, voltage band, and hosting capacity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gridsec.errors import FeederInvalid
from service.cli import console
from service.cli.console import Studied, options_of
from service.cli.paths import write_tables
from service.cli.session import JournalAt, Keeping, NoJournal, keeping
from service.cli.sources import converted
from service.cli.study_planning import Out, as_usage_error, bar
from service.cli.study_words import Output, Plot

if TYPE_CHECKING:
    from feeders.model.site import Site
    from feeders.studies.droop.study import DroopOptions, DroopStudy

TITLES = {
    "stability": "Stability",
    "inverters": "Loop gain by inverter",
    "steps": "Steps, simulated",
    "band": "Voltage band, proven limits, V",
    "witness": "Loads that violate the band",
    "presets": "Presets",
    "time_constants": "Time constants",
    "hosting": "Hosting capacity",
}
"""Printed tables; --out writes all of them."""


Preset = Annotated[
    str | None, typer.Option(help="Equip customers with this preset. [default: the feeder's inverters]")
]
Equipped = Annotated[str, typer.Option(help="Customers that presets equip: pv (with generation) or all.")]
Interval = Annotated[
    float, typer.Option(help="Sampling interval of inverters, s; 0: continuous filters.", min=0.0)
]
Dead = Annotated[int, typer.Option(help="Dead time of inverters, whole intervals.", min=0)]
Busbar = Annotated[tuple[float, float], typer.Option(help="Limits of the busbar's voltage, pu.")]
Allowed = Annotated[
    tuple[float, float] | None,
    typer.Option(help="Permitted voltages, pu. [default: as in the file]"),
]
LoadHigh = Annotated[float, typer.Option(help="Largest load, share of the peak.", min=0.0)]
PvHigh = Annotated[float, typer.Option(help="Largest generation, share of the peak.", min=0.0)]
Compare = Annotated[
    list[str] | None, typer.Option(help="A preset to compare; may be repeated. [default: all]")
]
Also = Annotated[list[str] | None, typer.Option(help="Compare presets on this feeder too; may be repeated.")]
TauFactor = Annotated[
    list[float] | None, typer.Option(help="Factor on all time constants to compare; may be repeated.")
]
Hosting = Annotated[bool, typer.Option("--hosting", help="Compute hosting capacities.")]
HostingPreset = Annotated[
    list[str] | None,
    typer.Option(help="Preset of new inverters, or none; may be repeated. [default: none, ieee1547-b]"),
]
HostingLoad = Annotated[float, typer.Option(help="Loads for hosting capacities, share of the peak.", min=0.0)]
HostingAt = Annotated[
    list[str] | None,
    typer.Option(help="A customer with the new generation; may be repeated. [default: as in the files]"),
]
UnitKw = Annotated[float, typer.Option(help="Generation per random place, kW.")]
Draws = Annotated[int, typer.Option(help="Number of random orders of places.", min=0)]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.", min=0)]


def droop(
    feeder: Studied = "simbench-lv-rural1",
    *,
    preset: Preset = None,
    who: Equipped = "pv",
    interval: Interval = 1.0,
    dead: Dead = 0,
    busbar: Busbar = (1.0, 1.0),
    band: Allowed = None,
    load_high: LoadHigh = 1.0,
    pv_high: PvHigh = 1.0,
    compare: Compare = None,
    also: Also = None,
    tau_factor: TauFactor = None,
    hosting: Hosting = False,
    hosting_preset: HostingPreset = None,
    hosting_load: HostingLoad = 0.1,
    at: HostingAt = None,
    unit_kw: UnitKw = 5.0,
    draws: Draws = 30,
    seed: Seed = 0,
    journal: JournalAt = None,
    no_journal: NoJournal = False,
    out: Out = None,
    plot: Plot = None,
) -> None:
    """Study the volt/VAR fleet: stability with margins, voltage band, and hosting capacity."""
    from feeders.studies.droop.fleets import NOTHING, Equipped, NoInverters
    from feeders.studies.droop.study import DroopOptions
    from gridsec.errors import no_choice
    from gridsec.grid.devices import PRESETS

    fleets = hosting_preset or ["none", "ieee1547-b"]
    existing = ("none", *PRESETS)
    problems = [*no_choice("--who", Equipped, who), *no_choice("--hosting-preset", existing, *fleets)]
    usual = DroopOptions()
    options = options_of(
        lambda: DroopOptions(
            preset=preset,
            who=Equipped(who) if who in tuple(Equipped) else usual.who,
            interval_s=interval,
            dead=dead,
            v0_low=busbar[0],
            v0_high=busbar[1],
            v_min=band[0] if band else None,
            v_max=band[1] if band else None,
            load_high=load_high,
            pv_high=pv_high,
            presets=tuple(compare) if compare else usual.presets,
            tau_factors=tuple(tau_factor) if tau_factor else usual.tau_factors,
            hosting=hosting,
            hosting_presets=tuple("" if name == "none" else name for name in fleets if name in existing),
            hosting_load=hosting_load,
            hosting_customers=tuple(at) if at else None,
            unit_kw=unit_kw,
            draws=draws,
        ),
        problems,
        folders={"--out": out},
        files={"--journal": journal},
        replaced={"--plot": plot},
    )
    with keeping("droop", feeder, journal, without=no_journal) as kept:
        site, *others = _loaded([(feeder, out), *((name, None) for name in also or ())])
        try:
            found = _studied(site, others, options, seed, kept)
        except NoInverters:
            if hosting:
                raise
            console.say(f"{site.feeder.name}: {NOTHING} (--preset equips customers with some)")
            Output("droop").nothing(site, "as there is no fleet", plot)
            return
        output = Output("droop")
        _tell(found, options, output)
        write_tables(out, "droop", found.tables)
        output.end(site, found, plot)


def _studied(
    site: Site, others: Sequence[Site], options: DroopOptions, seed: int, kept: Keeping
) -> DroopStudy:
    """The study, with the presets on other feeders appended to its own."""
    import pandas as pd

    from feeders.studies.droop.study import droop as study
    from feeders.studies.droop.study import presets_of

    with bar("fleets, steps and loads") as report_progress, as_usage_error():
        found = study(site, options, seed=seed, journal=kept, progress=report_progress)
        if others:
            theirs = presets_of(others, options, seed=seed, journal=kept, progress=report_progress)
            found.tables["presets"] = pd.concat([found.tables["presets"], theirs], ignore_index=True)
    return found


def _loaded(names: Sequence[tuple[str, Path | None]]) -> list[Site]:
    """Feeders by name, each with the folder of its results; all problems are raised at once."""
    from feeders.model.site import load

    sites: list[Site] = []
    problems: list[str] = []
    for name, out in names:
        try:
            sites.append(load(converted(name, out)))
        except FeederInvalid as error:
            problems += error.problems
    if problems:
        raise FeederInvalid(problems)
    return sites


def _tell(found: DroopStudy, options: DroopOptions, output: Output) -> None:
    """Print the result and its tables."""
    sampled = f"sampled every {options.interval_s:g} s" if options.interval_s else "continuous"
    console.say(f"{found.feeder}: the fleet ({sampled}) is {found.verdict}")
    console.out.print(f"Voltage band: {found.rest} for slow load changes, {found.always} for arbitrary ones.")
    for name, title in TITLES.items():
        if name in found.tables:
            output.table(title, found.tables[name])
    if "hosting_draws" in found.tables:
        draws = found.tables["hosting_draws"].groupby("preset", sort=False)["capacity_kw"]
        output.table("Random places, kW", draws.describe(percentiles=[0.1, 0.5, 0.9]).reset_index())
