"""Report of a feeder: page, figures and tables from the results of its studies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from feeders.format.validation import told
from feeders.report.drawing import WIDE, Drawing, Figure, png, svg
from feeders.report.html import CONVERSION, FEEDER, About, Chapter, StudyOutcome, page, section
from feeders.report.maps import Shape, Spot, draw_map, has_places, legend_of
from gridsec.papers import draw

if TYPE_CHECKING:
    import pandas as pd

    from feeders.convert.provenance import Origin
    from feeders.model.site import Site


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """Report of a feeder."""

    html: str  # the page
    pictures: dict[str, bytes]  # figure files by name: SVG, and PNG with matplotlib
    tables: dict[str, pd.DataFrame]  # tables by file name


def report(
    site: Site, outcomes: Sequence[StudyOutcome], about: About, origin: Origin | None = None
) -> Report:
    """Build the report, with sections in the order of `outcomes`; equal arguments give equal bytes."""
    chapters = [Chapter(outcome, section(site, outcome)) for outcome in outcomes]
    chart = _chart(site)
    title = site.tables.meta.title or site.feeder.name
    figures = [chart, *(figure for chapter in chapters for figure in chapter.section.figures)]
    tables = {
        f"{chapter.outcome.study}-{name}": table
        for chapter in chapters
        for name, table in chapter.section.tables.items()
    }
    if origin is not None:
        tables[f"{FEEDER}-{CONVERSION}"] = origin.changes
    html = page(title, _facts(site), chart, chapters, about, origin=origin)
    return Report(html, {name: data for figure in figures for name, data in _files(figure)}, tables)


def _files(figure: Figure) -> list[tuple[str, bytes]]:
    drawing = figure.draw(WIDE)
    text = svg(drawing, title=figure.title, text=figure.text, key=figure.name, alone=True)
    out = [(f"{figure.name}.svg", text.encode())]
    if draw.available():
        out.append((f"{figure.name}.png", png(drawing, title=figure.title, text=figure.text)))
    return out


def _facts(site: Site) -> dict[str, str]:
    rows, meta = site.tables.customers, site.tables.meta
    kva = sum(row.inverter_kva for row in rows)
    classes = np.unique(site.accuracy.class_fraction * 100.0)
    spread = " to ".join(f"{value:g}" for value in dict.fromkeys((classes.min(), classes.max())))
    each = Counter(row.phases for row in rows)
    phased = {"abc"} != each.keys()
    return {
        "feeder": site.feeder.name,
        "customers": f"{len(rows)} customers",
        **({"phases": ", ".join(f"{each[p]} on {p}" for p in sorted(each))} if phased else {}),
        "meters": f"{site.meters.size} meters, class {spread} %",
        "inverters": f"{site.droop.tau.size} inverters, {kva:.4g} kVA",
        "peak of all loads": f"{sum(row.load_kw for row in rows):.4g} kW",
        "nominal voltage": told(site.nominal_volt),
        "voltage band": f"{meta.limits.v_min_pu:g} to {meta.limits.v_max_pu:g} pu",
        "busbar": str(site.spanning.buses[0]),
        "content (SHA-256)": site.digest[:16],
    }


def _chart(site: Site) -> Figure:
    real = "at their positions" if has_places(site) else "as a tree"
    return Figure(
        "feeder-map",
        "Map",
        f"Lines and customers, {real}; {site.meters.size} meters, {site.droop.tau.size} inverters.",
        partial(_feeder_map, site),
    )


def _feeder_map(site: Site, width: float) -> Drawing:
    ids = dict(zip(site.meters.tolist(), site.meter_ids, strict=True))
    inverters = set(site.droop.customer.tolist())
    spots = []
    for k, name in enumerate(site.feeder.customers):
        meter, inverter = ids.get(k, ""), k in inverters
        tip = f"{name}: {f'meter {meter}' if meter else 'no meter'}{', inverter' if inverter else ''}"
        shape = (Shape.SUN if inverter else Shape.METER) if meter else Shape.NONE
        spots.append(Spot(shape, meter, tip))
    meanings = {
        "meter": Shape.METER,
        "meter, with an inverter": Shape.SUN,
        "customer without a meter": Shape.NONE,
    }
    return draw_map(site, spots, width, legend=legend_of(meanings, spots))
