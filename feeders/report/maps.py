"""Maps of a feeder: layout, streets, customers, and marks from tables.

In a tree every street is a row, with its customers below it. A row follows the branch with the most
customers; other branches have rows of their own, as near as possible.

Customers differ in shape and size, and have a word or a number beside them; colour is an addition. In three
phases every customer has one leg of a star, that of its phase: a to the upper right, b downwards, c to the
upper left.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.report.drawing import STEPS, Area, Disc, Drawing, Mark, Polyline, Text, regular, width_of
from feeders.report.text import number

if TYPE_CHECKING:
    import pandas as pd

    from feeders.model.site import Site
    from gridsec.arrays import Floats


Point = tuple[float, float]

FEW: Final = 8
"""Number of customers up to which a map has at most HALF_PAGE px: two maps with captions fit on A4."""
HALF_PAGE: Final = 400.0


@dataclass(frozen=True, slots=True)
class Placed:
    """Layout of a feeder on a sheet, px."""

    # Size of the sheet.
    width: float
    height: float
    # Polylines of lines, and of the connections of customers.
    wires: tuple[tuple[Point, ...], ...]
    drops: tuple[tuple[Point, ...], ...]
    ties: tuple[tuple[Point, ...], ...]  # polylines of the lines that close loops
    busbar: tuple[Point, Point]  # both ends of the busbar
    customers: tuple[Point, ...]  # position of each customer
    room: float  # available room of a customer
    real: bool  # True: positions of the files


def has_places(site: Site) -> bool:
    """True if the files have positions of all buses, and most of them are different."""
    return site.xy is not None and len({tuple(row) for row in site.xy.tolist()}) > len(site.xy) / 4


def place(site: Site, width: float) -> Placed:
    """Lay out a feeder on a sheet `width` px wide; on narrow sheets trees grow downwards."""
    return _real(site, width) if has_places(site) else _tree(site, width)


def _real(site: Site, width: float) -> Placed:
    assert site.xy is not None  # noqa: S101  # `has_places`
    xy = np.array(site.xy, dtype=np.float64)
    span = np.ptp(xy, axis=0)
    if np.abs(xy[:, 0]).max() <= 180.0 and np.abs(xy[:, 1]).max() <= 90.0 and span.max() < 1.0:
        xy[:, 0] *= math.cos(math.radians(float(xy[:, 1].mean())))  # degrees: equal metres in both directions
        span = np.ptp(xy, axis=0)
    pad = 34.0
    span = np.where(span > 0.0, span, 1.0)
    most = 0.5 * width + 180.0
    if site.feeder.bus.size <= FEW:
        most = min(most, HALF_PAGE)
    height = min(max(240.0, (width - 2 * pad) * float(span[1] / span[0]) + 2 * pad), most)
    factor = min((width - 2 * pad) / span[0], (height - 2 * pad) / span[1])
    low = xy.min(axis=0)
    x = 0.5 * (width - factor * span[0]) + factor * (xy[:, 0] - low[0])
    y = height - 0.5 * (height - factor * span[1]) - factor * (xy[:, 1] - low[1])
    at: list[Point] = [(float(a), float(b)) for a, b in zip(x, y, strict=True)]
    wires = tuple((at[int(p)], at[k + 1]) for k, p in enumerate(site.spanning.parent))
    spots, drops = _fans(at, site.spanning.bus.tolist())
    ties = tuple((at[one], at[other]) for one, other in site.ties.tolist())
    bx, by = at[0]
    ends = ((bx - 9.0, by), (bx + 9.0, by))
    return Placed(width, height, wires, drops, ties, ends, spots, _room(spots), real=True)


def _room(spots: Sequence[Point]) -> float:
    """Room of a customer: lower decile of the distances to the nearest neighbour, within limits."""
    at = np.array(spots)
    apart = np.hypot(*(at[:, None, :] - at[None, :, :]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    return float(np.clip(1.7 * np.quantile(np.minimum(apart.min(axis=1), 60.0), 0.1), 11.0, 24.0))


def _fans(at: Sequence[Point], bus: Sequence[int]) -> tuple[tuple[Point, ...], tuple[tuple[Point, ...], ...]]:
    """Positions of several customers of one bus around it."""
    here: dict[int, list[int]] = {}
    for customer, k in enumerate(bus):
        here.setdefault(k, []).append(customer)
    spots: list[Point] = [(0.0, 0.0)] * len(bus)
    drops: list[tuple[Point, ...]] = []
    for k, who in here.items():
        x, y = at[k]
        radius = 0.0 if len(who) == 1 and k else max(15.0, 3.4 * len(who))
        for j, customer in enumerate(who):
            angle = 2.0 * math.pi * (j + 0.5) / len(who)
            spots[customer] = (x + radius * math.sin(angle), y + radius * math.cos(angle))
            if radius:
                drops.append(((x, y), spots[customer]))
    return tuple(spots), tuple(drops)


@dataclass(slots=True)
class _Items:
    """Parts of a tree on a grid: columns along a street, rows across."""

    customers: list[tuple[int, int, int]] = field(default_factory=list)  # customer, column, row
    streets: list[tuple[int, int, int]] = field(default_factory=list)  # first column, last column, row
    poles: list[tuple[int, int, int]] = field(default_factory=list)  # bus, column, row
    ties: list[tuple[int, int, int, int]] = field(default_factory=list)  # column, row above, column, row

    def take(self, other: _Items, rows: int) -> None:
        """Add another block, `rows` rows lower."""
        self.customers += [(k, x, row + rows) for k, x, row in other.customers]
        self.streets += [(a, b, row + rows) for a, b, row in other.streets]
        self.poles += [(bus, x, row + rows) for bus, x, row in other.poles]
        self.ties += [(x0, r0 + rows, x1, r1 + rows) for x0, r0, x1, r1 in other.ties]


class _Grid:
    """Layout of a feeder's tree on a grid."""

    def __init__(self, site: Site) -> None:
        parent = site.spanning.parent.tolist()
        count = len(parent) + 1
        self.children: list[list[int]] = [[] for _ in range(count)]
        self.at: list[list[int]] = [[] for _ in range(count)]
        for k, bus in enumerate(site.spanning.bus.tolist()):
            self.at[bus].append(k)
        self.weight = [len(here) for here in self.at]
        self.depth = [1] * count
        order = _outwards(parent)
        for k in reversed(order):
            up = parent[k - 1]
            self.weight[up] += self.weight[k]
            self.depth[up] = max(self.depth[up], self.depth[k] + 1)
        for k in order:
            self.children[parent[k - 1]].append(k)

    def place(self) -> tuple[_Items, int, int]:
        """All parts, and their numbers of rows and columns."""
        every, row, columns = _Items(), 0, 1
        if self.at[0]:
            every.customers += [(who, 1 + k, 0) for k, who in enumerate(self.at[0])]
            every.streets.append((0, len(self.at[0]), 0))
            columns, row = len(self.at[0]) + 1, 1
        for child in sorted(self.children[0]):
            inner, taken = self._block(child, 1)
            inner.streets.append((0, 1, 0))
            every.take(inner, row)
            columns = max([columns, *(b + 1 for spans in taken for _, b in spans)])
            row += len(taken)
        return every, max(row, 1), columns

    def _block(self, start: int, x0: int) -> tuple[_Items, list[list[tuple[int, int]]]]:
        """Street with its branches, and the occupied columns in each of its rows."""
        items, branches, x = _Items(), [], x0
        bus: int | None = start
        while bus is not None:
            following = sorted(self.children[bus], key=lambda k: (-self.weight[k], -self.depth[k], k))
            ahead = [k for k in following if self.children[k]][:1] or following[:1]
            if ahead and not self.children[ahead[0]] and not self.at[bus] and len(following) > 1:
                ahead = []  # last pole of a street: all its houses are below it
            others = [k for k in following if k not in ahead]
            slots = self.at[bus] + [who for k in others if not self.children[k] for who in self.at[k]]
            sides = [k for k in others if self.children[k]]
            branches += [(side, x) for side in sides]
            items.poles += [(k, x, 0) for k in (bus, *others) if k not in sides]
            x += 1 if sides else 0
            items.customers += [(who, x + k, 0) for k, who in enumerate(slots)]
            x += max(len(slots), 0 if sides else 1) if (slots or len(self.children[bus]) != 1) else 0
            bus = ahead[0] if ahead else None
        last = max(x - 1, x0)
        items.streets.append((x0, last, 0))
        taken = [[(x0, last)]]
        for side, origin in reversed(branches):  # far branches first: connections then cross no row
            inner, spans = self._block(side, origin + 1)
            wider = [[(a - 1, b) for a, b in row] for row in spans]
            offset = 1
            while _collides(taken, wider, offset):
                offset += 1
            items.take(inner, offset)
            items.ties.append((origin, 0, origin + 1, offset))
            taken += [[] for _ in range(offset + len(wider) - len(taken))]
            for k, row in enumerate(wider):
                taken[offset + k] += row
            for k in range(1, offset):
                taken[k].append((origin, origin))
        return items, taken


def _outwards(parent: Sequence[int]) -> list[int]:
    """Buses except the busbar, each after its parent."""
    depth = [0] * (len(parent) + 1)
    for k in range(1, len(depth)):
        steps, at = 0, k
        while at:
            at, steps = parent[at - 1], steps + 1
        depth[k] = steps
    return sorted(range(1, len(depth)), key=lambda k: (depth[k], k))


def _collides(taken: list[list[tuple[int, int]]], rows: list[list[tuple[int, int]]], offset: int) -> bool:
    return any(
        a <= d and c <= b
        for k, row in enumerate(rows)
        if offset + k < len(taken)
        for a, b in row
        for c, d in taken[offset + k]
    )


def _tree(site: Site, width: float) -> Placed:
    items, rows, columns = _Grid(site).place()
    upright = width < 500.0 and columns > 8
    pad = 26.0
    lengths, breadths = (rows, columns) if upright else (columns, rows)
    step = (width - 2.0 * pad) / max(lengths - (0 if upright else 1), 1)
    along = 19.0 if upright else min(step, 60.0)
    across = min(step, 90.0) if upright else 62.0
    hang = 16.0 if upright else 20.0

    def at(x: float, row: float) -> Point:
        return (pad + row * across, pad + x * along) if upright else (pad + x * along, pad + row * across)

    def below(point: Point) -> Point:
        return (point[0] + hang, point[1]) if upright else (point[0], point[1] + hang)

    wires = [(at(a, row), at(b, row)) for a, b, row in items.streets]
    ties = [(at(x0, r0), at(x0, r1), at(x1, r1)) for x0, r0, x1, r1 in items.ties]
    spots: list[Point] = [(0.0, 0.0)] * site.feeder.bus.size
    drops: list[tuple[Point, ...]] = []
    for who, x, row in items.customers:
        spots[who] = below(at(x, row))
        drops.append((at(x, row), spots[who]))
    poles = {bus: (x, row) for bus, x, row in items.poles}
    closing = []
    for one, other in site.ties.tolist():
        # The busbar's end of a tie is in the row of the other end.
        a, b = (at(*poles.get(k, (0, poles.get(far, (0, 0))[1]))) for k, far in ((one, other), (other, one)))
        mid = (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]))
        closing.append((a, (mid[0] - 14.0, mid[1]) if upright else (mid[0], mid[1] - 14.0), b))
    first, last = at(0, 0), at(0, rows - 1)
    ends = (
        ((first[0] - 10, first[1]), (last[0] + 10, last[1]))
        if upright
        else ((first[0], first[1] - 10), (last[0], last[1] + 10))
    )
    height = 2.0 * pad + (breadths - 1) * (along if upright else across) + (8.0 if upright else hang + 8.0)
    return Placed(
        width,
        height,
        (*wires, *ties),
        tuple(drops),
        tuple(closing),
        ends,
        tuple(spots),
        min(along, 60.0),
        real=False,
    )


class Shape(Enum):
    """Kind of mark of a customer."""

    METER = "meter"
    SUN = "meter with an inverter"
    NONE = "no meter"
    PROTECTED = "protected meter"
    ALARM = "alarm"
    OPEN = "not known"
    STEP = "size on a scale"


@dataclass(frozen=True, slots=True)
class Spot:
    """Mark of a customer on a map."""

    shape: Shape  # kind of mark
    label: str = ""  # text beside it, or empty
    tip: str = ""  # text of the tooltip
    step: int = 0  # step of a size on a scale
    weight: float = 0.0  # priority of the label's position
    phase: str = ""  # phase a, b or c on a feeder of several phases; empty: none shown


LEGS: Final = {"a": 60.0, "b": 180.0, "c": 300.0}
"""Direction of the leg of a phase, degrees clockwise from above."""


@dataclass(frozen=True, slots=True)
class ColorScale:
    """Scale with STEPS + 1 ascending limits of its steps, and their unit."""

    limits: tuple[float, ...]
    unit: str

    def step(self, value: float) -> int:
        """Step of a finite value."""
        return bisect_right(self.limits[1:-1], value)

    def names(self) -> list[str]:
        """Text of each step."""
        digits = _digits(self.limits[1] - self.limits[0])
        return [
            f"{a:.{digits}f}–{b:.{digits}f} {self.unit}"
            for a, b in zip(self.limits, self.limits[1:], strict=False)
        ]


def steps_of(values: Sequence[float], unit: str) -> ColorScale:
    """Scale of equal steps of a round size over values, at least one of them finite."""
    finite = [value for value in values if math.isfinite(value)]
    least, most = min(finite), max(finite)
    same = most - least < 0.05 * max(abs(most), abs(least))
    low, high = (min(least, 0.0), max(most, 0.0)) if same else (least, most)
    step = (high - low) / STEPS or 1.0
    size = 10.0 ** math.floor(math.log10(step))
    while True:
        for factor in (1.0, 2.0, 2.5, 5.0, 10.0):
            step = factor * size
            first = math.floor(low / step + 1e-9) * step
            # Nearly equal values are on one step, not on two.
            apart = same and least // step != most // step
            if first + STEPS * step >= high * (1.0 - 1e-12) and not apart:
                return ColorScale(tuple(first + k * step for k in range(STEPS + 1)), unit)
        size *= 10.0


def _digits(step: float) -> int:
    digits = max(0, -math.floor(math.log10(step)))
    return digits + int(abs(step * 10.0**digits - round(step * 10.0**digits)) > 1e-6)


def legend_of(meanings: Mapping[str, Shape], spots: Sequence[Spot]) -> dict[str, Spot]:
    """Those of the shapes, by meaning, that are on a map."""
    there = {spot.shape for spot in spots}
    return {name: Spot(shape) for name, shape in meanings.items() if shape in there}


def draw_map(site: Site, spots: Sequence[Spot], width: float, *, legend: Mapping[str, Spot]) -> Drawing:
    """Draw a feeder on a sheet `width` px wide, with the mark of each customer, and a legend by meaning."""
    at = place(site, width)
    marks: list[Mark] = [Polyline(points, "drop") for points in at.drops]
    marks += [Polyline(points, "wire") for points in at.wires]
    marks += [Polyline(points, "line-wire") for points in at.ties]
    marks.append(Polyline(at.busbar, "busbar", tip=f"busbar: {site.feeder.buses[0]}"))
    spots, legend = _with_phases(site, spots, legend)
    size = min(max(at.room / 3.4, 3.2), 7.5)
    order = sorted(range(len(spots)), key=lambda k: (spots[k].step, spots[k].weight))
    for k in order:
        marks += _glyph(spots[k], *at.customers[k], size)
    marks += _labels(spots, at, size)
    lines, height = _legend(legend, at.height, width)
    return Drawing(width, height, (*marks, *lines))


def _with_phases(
    site: Site, spots: Sequence[Spot], legend: Mapping[str, Spot]
) -> tuple[Sequence[Spot], Mapping[str, Spot]]:
    """Marks and legend with each customer's phase, for several phases."""
    phases = [row.phases for row in site.tables.customers]
    if not set(phases) <= LEGS.keys():
        return spots, legend
    own = [
        replace(spot, phase=phase, tip=f"{spot.tip}, phase {phase}" if spot.tip else f"phase {phase}")
        for spot, phase in zip(spots, phases, strict=True)
    ]
    return own, {
        **legend,
        **{f"phase {phase}": Spot(Shape.NONE, phase=phase) for phase in sorted(set(phases))},
    }


def _glyph(spot: Spot, x: float, y: float, size: float) -> list[Mark]:
    match spot.shape:
        case Shape.NONE:
            marks: list[Mark] = [Disc(x, y, 0.55 * size, "none", spot.tip)]
        case Shape.PROTECTED:
            r = 1.35 * size
            outline = [(-1, -0.8), (0, -1.15), (1, -0.8), (0.9, 0.2), (0, 1.15), (-0.9, 0.2)]
            tick = ((x - 0.45 * r, y), (x - 0.1 * r, y + 0.4 * r), (x + 0.5 * r, y - 0.4 * r))
            shield = tuple((x + r * a, y + r * b) for a, b in outline)
            marks = [Area(shield, "shield", spot.tip), Polyline(tick, "tick")]
        case Shape.ALARM:
            marks = [Area(regular(x, y, 1.3 * size, 4), "alarm", spot.tip)]
        case Shape.SUN:
            marks = [Disc(x, y, 1.25 * size, "plain", spot.tip), Disc(x, y, 0.72 * size, "solid", spot.tip)]
        case Shape.OPEN:
            marks = [Area(regular(x, y, 1.4 * size, 3), "plain", spot.tip)]
        case Shape.STEP:
            marks = [Disc(x, y, size * (0.62 + 0.16 * spot.step), f"step{spot.step}", spot.tip)]
        case Shape.METER:
            marks = [Disc(x, y, size, "solid", spot.tip)]
    return [*_leg(spot, x, y, size), *marks]


def _leg(spot: Spot, x: float, y: float, size: float) -> list[Mark]:
    """Leg of a phase, from below the mark to a little beyond it."""
    if not spot.phase:
        return []
    angle = math.radians(LEGS[spot.phase])
    far = size * (1.3 if spot.shape is Shape.NONE else 2.1)
    return [Polyline(((x, y), (x + far * math.sin(angle), y - far * math.cos(angle))), "line-ink")]


Box = tuple[float, float, float, float]


def _labels(spots: Sequence[Spot], at: Placed, size: float) -> list[Mark]:
    """Labels with enough room, off the lines if possible: right, left, below, above, in this order.

    Labels of trees are below first.
    """
    lit = np.array([(*a, *b) for wire in (*at.wires, *at.ties, *at.drops) for a, b in pairwise(wire)])
    taken: list[Box] = [(x - size, y - size, x + size, y + size) for x, y in at.customers]
    marks: list[Mark] = []
    letters = 11.0
    order = sorted((k for k, spot in enumerate(spots) if spot.label), key=lambda k: -spots[k].weight)
    for k in order:
        (x, y), long = at.customers[k], width_of(spots[k].label, letters)
        away = 1.5 * size + 3.0
        leg = 0.8 * size if spots[k].phase else 0.0
        places = {
            "right": (x + away, y + 4.0, "start", x + away),
            "left": (x - away, y + 4.0, "end", x - away - long),
            "below": (x, y + away + leg + 8.0, "middle", x - 0.5 * long),
            "above": (x, y - away, "middle", x - 0.5 * long),
        }
        wanted = ("right", "left", "below", "above") if at.real else ("below", "right")
        free: list[tuple[Text, Box]] = []
        for name in wanted:
            tx, ty, anchor, left = places[name]
            box = (left, ty - 9.0, left + long, ty + 2.0)
            inside = (
                box[0] >= 1.0 and box[2] <= at.width - 1.0 and box[1] >= 0.0 and box[3] <= at.height + 6.0
            )
            if inside and not any(_overlap(box, other) for other in taken):
                free.append((Text(tx, ty, spots[k].label, "label", anchor, letters), box))
        if free:
            mark, box = next((each for each in free if not _crossed(each[1], lit)), free[0])
            taken.append(box)
            marks.append(mark)
    return marks


def _crossed(box: Box, lines: Floats) -> bool:
    """True if any of the lines, (n, 4) from x, y to x, y, crosses a box."""
    if not lines.size:
        return False
    x0, y0, x1, y1 = lines.T
    near = (np.minimum(x0, x1) < box[2]) & (np.maximum(x0, x1) > box[0])
    near &= (np.minimum(y0, y1) < box[3]) & (np.maximum(y0, y1) > box[1])
    # A near line does not cross a box if all corners are on one side of it.
    sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x in box[::2] for y in box[1::2]]
    apart = (np.min(sides, axis=0) > 0.0) | (np.max(sides, axis=0) < 0.0)
    return bool(np.any(near & ~apart))


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _legend(legend: Mapping[str, Spot], top: float, width: float) -> tuple[list[Mark], float]:
    """Legend in the required number of rows, and the lower end of the sheet."""
    x, y, marks = 14.0, top + 18.0, list[Mark]()
    for meaning, spot in legend.items():
        long = 18.0 + width_of(meaning, 12.0)
        if x > 14.0 and x + long > width - 6.0:
            x, y = 14.0, y + 22.0
        marks += [*_glyph(replace(spot, tip=""), x, y - 4.0, 6.5), Text(x + 13.0, y, meaning, "quiet")]
        x += long + 16.0
    return marks, (y + 12.0 if legend else top)


FEW_LABELS: Final = 40
"""Number of values up to which a map shows them as labels."""


def size_map(
    site: Site, table: pd.DataFrame, width: float, *, who: str, column: str, unit: str = "V"
) -> Drawing:
    """Map of the feeder with a number for each customer or meter, as in `spots_by_size`."""
    spots, legend = spots_by_size(site, table, who, column, unit)
    return draw_map(site, spots, width, legend=legend)


def spots_by_size(
    site: Site, table: pd.DataFrame, who: str, column: str, unit: str
) -> tuple[list[Spot], dict[str, Spot]]:
    """Marks of a map with sizes from a column of a table, and their legend.

    The column `who` of the table, "meter" or "customer", has the ids.
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
            label = _short(name, names) + (f": {number(value)}" if len(sizes) <= FEW_LABELS else "")
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
    """Table of volts and its unit; with several nominal voltages relative to that of the column `customer`.

    Columns of numbers with a name in `_s` are not changed.
    """
    if bool((site.nominal_volt == site.nominal_volt[0]).all()):
        return table, "V"
    nominal = dict(zip(site.feeder.customers, site.customer_nominal, strict=True))
    share = 100.0 / table["customer"].map(nominal).astype(float)
    sizes = table.select_dtypes("number").mul(share, axis="index")
    volts = {str(name): sizes[name] for name in sizes if not str(name).endswith("_s")}
    return table.assign(**volts), "% of nominal"


def single_phase(site: Site) -> bool:
    """True for a balanced feeder, which has a single-phase equivalent."""
    return all(row.phases == "abc" for row in site.tables.customers)


def names_of(site: Site, who: str) -> list[str]:
    """Id of each customer, or of its meter; empty without one. `who` is "customer" or "meter"."""
    if who == "customer":
        return list(site.feeder.customers)
    ids = dict(zip(site.meters.tolist(), site.meter_ids, strict=True))
    return [ids.get(k, "") for k in range(site.feeder.bus.size)]


def _short(name: str, names: Sequence[str]) -> str:
    """Name with only the last of the words that are common to the begin of all names."""
    some = [each for each in names if each]
    words = name.split(" ")
    same = 0
    while same < len(words) - 1 and all(each.split(" ")[: same + 1] == words[: same + 1] for each in some):
        same += 1
    return " ".join(words[max(same - 1, 0) :])
