"""Section of the calibration: errors of the files by recorded readings."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

from feeders.report.charts import Bar, ChartRow, rows
from feeders.report.drawing import Drawing, Figure
from feeders.report.maps import Shape, Spot, draw_map, legend_of
from feeders.report.text import (
    Finding,
    Question,
    Section,
    Sentence,
    Standing,
    Value,
    counted,
    listed,
    number,
    plural,
)

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from feeders.studies.calibrate.study import Calibrate


ROWS = 40
"""Largest number of meters in a chart: those with the largest errors."""

UNTOLD, PROPOSED, EXCLUDED, AS_FILED = "cannot be told", "proposed", "excluded", "as in the files"
# Words of `feeders.studies.calibrate.study`; a test in `tests/feeders/report` compares them.


def calibrate(site: Site, found: Calibrate) -> Section:
    """Section of the calibration."""
    unread = listed(found.unread)
    known = found.meters[[math.isfinite(v) for v in found.meters["std_percent"]]]
    figures = [
        Figure(
            "calibrate-map",
            "Doubtful places of customers",
            "Diamonds: the files need a correction. Triangles: not determined by the readings, or not fully "
            "searched. Discs: as in the files.",
            partial(_doubt_map, site, found.customers),
        )
    ]
    if len(known):
        shown = " Those with the largest errors." if len(known) > ROWS else ""
        figures.append(
            Figure(
                "calibrate-bias",
                "Errors of the meters",
                f"Error of each meter's voltage relative to the busbar meter, %, with 95 % intervals.{shown}",
                partial(_bias_chart, known),
            )
        )
    return Section(
        answers={Question.RECORDS: _said(found)},
        figures=tuple(figures),
        tables=found.tables,
        assumptions=(
            f"{found.frames} frames over {number(found.span_h, 1)} h were compared; for correct files "
            f"the probability of any proposal is {100.0 * found.risk:g} %.",
            "The files were not changed.",
            *(
                [f"The busbar has no voltages of phase {unread}: the meters on it are left out."]
                * bool(unread)
            ),
        ),
    )


def _said(found: Calibrate) -> Finding:
    def having(verdict: str, name: str = "proposals") -> tuple[pd.DataFrame, Value]:
        """Rows of a table with a verdict, and their number."""
        table = found.tables[name]
        some = table[table["verdict"] == verdict]
        return some, counted(len(some), f"calibrate-{name}:verdict:count {verdict}")

    sentences: list[Sentence] = [("No correction of the files is decided.",)]
    sure, count = having(PROPOSED)
    if len(sure):
        verb = plural(len(sure), "correction of the files is", "corrections of the files are")
        sentences = [(count, f" {verb} proposed: {proposals(sure)}.")]
    vague, count = having(UNTOLD)
    if len(vague):
        noun = plural(len(vague), "error")
        sentences.append((count, f" {noun} in the readings could be one of several."))
    changing, count = having(EXCLUDED)
    if len(changing):
        words = (
            f" {plural(len(changing), 'meter is', 'meters are')} inconsistent, and errors of the files "
            f"explain it less well: {proposals(changing)}. An attack has this effect. The voltages were not "
            "used."
        )
        sentences.append((count, words))
    outside, count = having("outside its class", "meters")
    if len(outside):
        verb = plural(len(outside), "meter is", "meters are")
        sentences.append((count, f" {verb} outside the accuracy class: {listed(outside['meter'].tolist())}."))
    silent: list[str | Value] = []
    for name in ("lines", "customers", "meters"):
        untold, count = having(UNTOLD, name)
        if len(untold):
            lead = ", " if silent else "Not determined by the readings: "
            silent += [lead, count, f" of {len(found.tables[name])} {name}"]
    if silent:
        sentences.append((*silent, ". These may be right or wrong."))
    return Finding(Standing.MEASURED, tuple(sentences))


def proposals(table: pd.DataFrame) -> str:
    """Corrections of a table of proposals, in a sentence."""
    return listed([f"{row['what']}: {row['proposed']}" for row in table.to_dict("records")])


def _doubt_map(site: Site, customers: pd.DataFrame, width: float) -> Drawing:
    verdicts = dict(zip(customers["customer"].astype(str), customers["verdict"].astype(str), strict=True))
    shapes = {PROPOSED: Shape.ALARM, AS_FILED: Shape.METER}
    spots = []
    for name in site.feeder.customers:
        # A customer of three phases is one row of the table, and three of the feeder.
        verdict = verdicts.get(name, verdicts.get(name[:-2], UNTOLD))
        shape = shapes.get(verdict, Shape.OPEN)
        spots.append(Spot(shape, name if shape is Shape.ALARM else "", f"{name}: {verdict}"))
    meanings = {"to be corrected": Shape.ALARM, "cannot be told": Shape.OPEN, AS_FILED: Shape.METER}
    return draw_map(site, spots, width, legend=legend_of(meanings, spots))


def _bias_chart(meters: pd.DataFrame, width: float) -> Drawing:
    order = meters["bias_percent"].abs().sort_values(ascending=False).index[:ROWS]
    table = meters.loc[order]
    mark = 0.006 * float(table["high_percent"].max() - table["low_percent"].min())
    data = [
        ChartRow(
            str(row["meter"]),
            (
                Bar(
                    float(row["low_percent"]),
                    float(row["high_percent"]),
                    "fill-wire",
                    "95 % interval",
                    inset=7.0,
                ),
                Bar(row["bias_percent"] - mark, row["bias_percent"] + mark, "fill-a", "estimate"),
            ),
            f"{number(float(row['bias_percent']))} %",
        )
        for row in table.to_dict("records")
    ]
    start = min(0.0, float(table["low_percent"].min()))
    return rows(data, width, axis="error of the meter, %", start=start)
