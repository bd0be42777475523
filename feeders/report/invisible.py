"""Section of the study of redundancy: who can lie without ever being noticed."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

from feeders.report.drawing import Drawing
from feeders.report.figure import Figure
from feeders.report.maps import Shape, Spot, draw_map, legend_of
from feeders.report.section import Question, Section
from feeders.report.spots import names_of
from feeders.report.words import Finding, Sentence, Standing, Value, listed, number

if TYPE_CHECKING:
    import pandas as pd

    from feeders.load import Site
    from feeders.studies.redundancy import Redundancy

__all__ = ["redundancy"]


def redundancy(site: Site, found: Redundancy) -> Section:
    """Who can lie without ever being noticed.

    Parameters
    ----------
    site, found
        The feeder, and what was found.
    """
    first = found.meters[found.meters["case"] == "all live"]
    return Section(
        title="Who can lie without ever being noticed",
        answers={Question.INVISIBLE: _invisible(found)},
        figures=(
            Figure(
                "redundancy-map",
                "How many must lie together to stay invisible",
                "At each meter: the fewest liars, itself among them, whose lies stay invisible, by any "
                "attack (∞: no set of liars; ?: the search gave up).",
                partial(_index_map, site, first),
            ),
        ),
        tables=found.tables,
        columns={
            "index": "fewest liars that stay invisible; ∞: there are none",
            "attack": "persistent: its effect stays; any: those too that the inverters forget by themselves",
            "patterns": "dimensions in which a lie can hide",
            "detected, identified": "most liars that cannot hide, and that can be told who they are",
            "critical": "without this meter nobody else sees some pattern",
            "identified without": "most liars that are identified by the others once this meter is silent",
            "with": "meters that it can stay invisible together with, by an attack whose effect stays",
            "branch": "whether the part begins at the busbar",
            "blind": "customers whose voltage no meter tells, whoever lies",
        },
        assumptions=(
            f"Nobody knows the powers of: {listed(found.unknown) or 'nobody; all are known'}.",
            f"Inverters on their {'steepest slopes' if str(found.curves) == 'steepest' else 'deadbands'}.",
            "Whoever looks knows the feeder, all other loads and all meters' errors exactly: the best that "
            "any method could do. How large a lie must be to stand out of honest errors is another question.",
        ),
    )


def _invisible(found: Redundancy) -> Finding:
    sentences: list[Sentence] = []
    open_ = False
    for k, row in enumerate(found.summary.to_dict("records")):
        index, case = float(row["index"]), str(row["case"])
        value = Value(index, number(index), f"redundancy-summary:index:row {k}")
        kind = (
            "by attacks whose effect stays"
            if row["attack"] == "persistent"
            else "by any attack, those included that the inverters forget within seconds"
        )
        by = f"B{kind[1:]}"
        prefix = "" if case == "all live" else f"Without {listed(found.silent)}: "
        if math.isnan(index):
            open_ = True
            gave_up = "how many liars it takes is not proved: the search gave up. Some may well be able to"
            sentences.append((f"{prefix}{by}, {gave_up}.",))
        elif math.isinf(index):
            sentences.append((f"{prefix}{by}, no number of liars can stay invisible.",))
        else:
            who = f": {listed(str(row['liars']).split(' '))}" if row["liars"] else ""
            verb = "liar can" if index == 1 else "liars together can"
            sentences.append(
                (
                    prefix,
                    value,
                    f" {verb} stay invisible {kind}{who}{'' if index == 1 else '; fewer cannot'}.",
                )
            )
        if row["blind"]:
            sentences.append((f"{prefix}No meter tells the voltage of {row['blind']}.",))
    return Finding(Standing.OPEN if open_ else Standing.PROVED, tuple(dict.fromkeys(sentences)))


def _index_map(site: Site, meters: pd.DataFrame, width: float) -> Drawing:
    by_meter = dict(zip(meters["meter"].astype(str), meters["index_any"].astype(float), strict=True))
    spots = []
    for name in names_of(site, "meter"):
        value = by_meter.get(name, math.nan)
        shown = number(value)
        if name not in by_meter:
            spots.append(Spot(Shape.NONE, tip=name))
        elif math.isnan(value):
            spots.append(Spot(Shape.OPEN, f"{name}: ?", f"{name}: not known", weight=2.0))
        elif math.isfinite(value):
            spots.append(Spot(Shape.ALARM, f"{name}: {shown}", f"{name}: {shown}", weight=1.0 / value))
        else:
            spots.append(Spot(Shape.METER, f"{name}: {shown}", f"{name}: {shown}"))
    meanings = {
        "can stay invisible, with so many": Shape.ALARM,
        "cannot": Shape.METER,
        "not known": Shape.OPEN,
        "no meter": Shape.NONE,
    }
    return draw_map(site, spots, width, legend=legend_of(meanings, spots))
