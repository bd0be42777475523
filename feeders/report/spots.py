"""Spots of maps: what a table says of each customer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from feeders.report.drawing import Drawing
from feeders.report.maps import Shape, Spot, draw_map, steps_of
from feeders.report.words import number

if TYPE_CHECKING:
    import pandas as pd

    from feeders.load import Site

__all__ = ["comparable", "names_of", "single_phase", "size_map", "spots_by_size"]

FEW: Final = 40
"""Up to so many numbers stand in a map themselves."""


def size_map(
    site: Site, table: pd.DataFrame, width: float, *, who: str, column: str, unit: str = "V"
) -> Drawing:
    """A map of the feeder with a number for each customer or meter.

    Parameters
    ----------
    site
        The feeder.
    width
        Of the sheet, px.
    table, who, column, unit
        As in `spots_by_size`.
    """
    spots, legend = spots_by_size(site, table, who, column, unit)
    return draw_map(site, spots, width, legend=legend)


def spots_by_size(
    site: Site, table: pd.DataFrame, who: str, column: str, unit: str
) -> tuple[list[Spot], dict[str, Spot]]:
    """Spots of a map, each as large as a number of a table says, and their legend.

    Parameters
    ----------
    site
        The feeder.
    table, who, column, unit
        The numbers, the column that says whose they are ("meter" or "customer"), theirs, and their unit.
    """
    names = names_of(site, who)
    sizes = dict(zip(table[who].astype(str), table[column].astype(float), strict=True))
    finite = [v for v in sizes.values() if math.isfinite(v)]
    scale = steps_of(finite, unit) if finite else None
    spots = []
    for name in names:
        value = sizes.get(name, math.nan)
        if math.isnan(value) or scale is None:
            spots.append(Spot(Shape.NONE, tip=f"{name}: not known" if name in sizes else name))
        elif math.isinf(value):
            spots.append(Spot(Shape.ALARM, name, f"{name}: no bound", weight=math.inf))
        else:
            tip = f"{name}: {number(value)} {unit}"
            label = _short(name, names) + (f": {number(value)}" if len(sizes) <= FEW else "")
            spots.append(Spot(Shape.STEP, label, tip, scale.step(value), value))
    used = {spot.step for spot in spots if spot.shape is Shape.STEP}
    steps = enumerate(scale.names()) if scale is not None else ()
    legend = {name: Spot(Shape.STEP, step=k) for k, name in steps if k in used}
    if any(spot.shape is Shape.ALARM for spot in spots):
        legend["no bound"] = Spot(Shape.ALARM)
    if any(spot.shape is Shape.NONE for spot in spots):
        legend["no number"] = Spot(Shape.NONE)
    return spots, legend


def comparable(site: Site, table: pd.DataFrame) -> tuple[pd.DataFrame, str]:
    """A table of volts and their unit: in parts of the nominal voltage where there are several.

    Parameters
    ----------
    site
        The feeder.
    table
        With a column `customer`; columns of numbers whose name ends in `_s` stay as they are.
    """
    if bool((site.nominal_volt == site.nominal_volt[0]).all()):
        return table, "V"
    nominal = dict(zip(site.feeder.customers, site.customer_nominal, strict=True))
    share = 100.0 / table["customer"].map(nominal).astype(float)
    sizes = table.select_dtypes("number").mul(share, axis="index")
    volts = {str(name): sizes[name] for name in sizes if not str(name).endswith("_s")}
    return table.assign(**volts), "% of nominal"


def single_phase(site: Site) -> bool:
    """Whether a balanced feeder is spoken of, by its single-phase equivalent.

    Parameters
    ----------
    site
        The feeder.
    """
    return all(row.phases == "abc" for row in site.tables.customers)


def names_of(site: Site, who: str) -> list[str]:
    """What each customer is called: its own id, or its meter's; empty where there is none.

    Parameters
    ----------
    site, who
        The feeder, and "customer" or "meter".
    """
    if who == "customer":
        return list(site.feeder.customers)
    ids = dict(zip(site.meters.tolist(), site.meter_ids, strict=True))
    return [ids.get(k, "") for k in range(site.feeder.bus.size)]


def _short(name: str, names: Sequence[str]) -> str:
    """A name with only the last of the words that all of them begin with."""
    some = [each for each in names if each]
    words = name.split(" ")
    same = 0
    while same < len(words) - 1 and all(each.split(" ")[: same + 1] == words[: same + 1] for each in some):
        same += 1
    return " ".join(words[max(same - 1, 0) :])
