"""Maps of a feeder: its streets, its customers, and something about each of them.

A customer is told apart by shape and size, and by a word or a number beside it; colour comes on top. In three
phases everybody has one leg of a star, that of the phase: a to the upper right, b downwards, c to the upper
left.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.report.drawing import STEPS, Area, Disc, Drawing, Line, Mark, Text, regular, width_of
from feeders.report.layout import Placed, place

if TYPE_CHECKING:
    from feeders.load import Site
    from gridsec.arrays import Floats

__all__ = ["Scale", "Shape", "Spot", "draw_map", "legend_of", "steps_of"]


class Shape(Enum):
    """What a customer looks like."""

    METER = "meter"
    SUN = "meter with an inverter"
    NONE = "no meter"
    PROTECTED = "protected meter"
    ALARM = "alarm"
    OPEN = "not known"
    STEP = "size on a scale"


@dataclass(frozen=True, slots=True)
class Spot:
    """What a map says of a customer.

    Attributes
    ----------
    shape
        What it is.
    label
        Beside it; empty: nothing.
    tip
        For whoever points at it.
    step
        For a size on a scale: which step.
    weight
        Labels of heavier customers get their place first.
    phase
        Its phase, a, b or c, where the feeder has several; empty: none is shown.
    """

    shape: Shape
    label: str = ""
    tip: str = ""
    step: int = 0
    weight: float = 0.0
    phase: str = ""


LEGS: Final = {"a": 60.0, "b": 180.0, "c": 300.0}
"""Where the leg of a phase points, degrees clockwise from above."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Limits of the steps of a scale, ascending, STEPS + 1 of them, and how they are written."""

    limits: tuple[float, ...]
    unit: str

    def step(self, value: float) -> int:
        """Which step a finite value is on."""
        return bisect_right(self.limits[1:-1], value)

    def names(self) -> list[str]:
        """What each step means."""
        digits = _digits(self.limits[1] - self.limits[0])
        return [
            f"{a:.{digits}f}–{b:.{digits}f} {self.unit}"
            for a, b in zip(self.limits, self.limits[1:], strict=False)
        ]


def steps_of(values: Sequence[float], unit: str) -> Scale:
    """A scale of even steps of a round size over finite values.

    Parameters
    ----------
    values, unit
        What it is for, at least one finite value, and its unit.
    """
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
            # What makes all but no difference is on one step, not on two.
            apart = same and least // step != most // step
            if first + STEPS * step >= high * (1.0 - 1e-12) and not apart:
                return Scale(tuple(first + k * step for k in range(STEPS + 1)), unit)
        size *= 10.0


def _digits(step: float) -> int:
    digits = max(0, -math.floor(math.log10(step)))
    return digits + int(abs(step * 10.0**digits - round(step * 10.0**digits)) > 1e-6)


def legend_of(meanings: Mapping[str, Shape], spots: Sequence[Spot]) -> dict[str, Spot]:
    """What the shapes mean that are on a map.

    Parameters
    ----------
    meanings
        Shapes by what they mean.
    spots
        What the map shows.
    """
    there = {spot.shape for spot in spots}
    return {name: Spot(shape) for name, shape in meanings.items() if shape in there}


def draw_map(
    site: Site, spots: Sequence[Spot], width: float, *, legend: Mapping[str, Spot], note: str = ""
) -> Drawing:
    """Draw a feeder.

    Parameters
    ----------
    site, spots
        The feeder, and what to say of each of its customers.
    width
        Of the sheet, px.
    legend
        What looks mean.
    note
        Above the picture.
    """
    at = place(site, width)
    top = 22.0 if note else 0.0
    at = replace(
        at,
        height=at.height + top,
        wires=tuple(_down(points, top) for points in at.wires),
        drops=tuple(_down(points, top) for points in at.drops),
        ties=tuple(_down(points, top) for points in at.ties),
        busbar=(_moved(at.busbar[0], top), _moved(at.busbar[1], top)),
        customers=tuple(_moved(point, top) for point in at.customers),
    )
    marks: list[Mark] = [Text(8.0, 15.0, note, "quiet", size=12.0)] if note else []
    marks += [Line(points, "drop") for points in at.drops]
    marks += [Line(points, "wire") for points in at.wires]
    marks += [Line(points, "line-wire") for points in at.ties]
    marks.append(Line(at.busbar, "busbar", tip=f"busbar: {site.feeder.buses[0]}"))
    spots, legend = _with_phases(site, spots, legend)
    size = min(max(at.room / 3.4, 3.2), 7.5)
    order = sorted(range(len(spots)), key=lambda k: (spots[k].step, spots[k].weight))
    for k in order:
        marks += _glyph(spots[k], *at.customers[k], size)
    marks += _labels(spots, at, size, top)
    lines, height = _legend(legend, at.height, width)
    return Drawing(width, height, (*marks, *lines))


def _with_phases(
    site: Site, spots: Sequence[Spot], legend: Mapping[str, Spot]
) -> tuple[Sequence[Spot], Mapping[str, Spot]]:
    """Spots and legend with everybody's phase, where there are several."""
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


def _moved(point: tuple[float, float], down: float) -> tuple[float, float]:
    return (point[0], point[1] + down)


def _down(points: Sequence[tuple[float, float]], down: float) -> tuple[tuple[float, float], ...]:
    return tuple(_moved(point, down) for point in points)


def _glyph(spot: Spot, x: float, y: float, size: float) -> list[Mark]:
    match spot.shape:
        case Shape.NONE:
            marks: list[Mark] = [Disc(x, y, 0.55 * size, "none", spot.tip)]
        case Shape.PROTECTED:
            r = 1.35 * size
            outline = [(-1, -0.8), (0, -1.15), (1, -0.8), (0.9, 0.2), (0, 1.15), (-0.9, 0.2)]
            tick = ((x - 0.45 * r, y), (x - 0.1 * r, y + 0.4 * r), (x + 0.5 * r, y - 0.4 * r))
            shield = tuple((x + r * a, y + r * b) for a, b in outline)
            marks = [Area(shield, "shield", spot.tip), Line(tick, "tick")]
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
    """From below its glyph to a little beyond it."""
    if not spot.phase:
        return []
    angle = math.radians(LEGS[spot.phase])
    far = size * (1.3 if spot.shape is Shape.NONE else 2.1)
    return [Line(((x, y), (x + far * math.sin(angle), y - far * math.cos(angle))), "line-ink")]


Box = tuple[float, float, float, float]


def _labels(spots: Sequence[Spot], at: Placed, size: float, top: float) -> list[Mark]:
    """Labels where there is room, off the lines if possible: right, left, below, above, in this order.

    Those of trees are below first.
    """
    lit = np.array([(*a, *b) for wire in (*at.wires, *at.ties, *at.drops) for a, b in pairwise(wire)])
    taken: list[Box] = [_around(x, y, size) for x, y in at.customers]
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
                box[0] >= 1.0 and box[2] <= at.width - 1.0 and box[1] >= top and box[3] <= at.height + 6.0
            )
            if inside and not any(_overlap(box, other) for other in taken):
                free.append((Text(tx, ty, spots[k].label, "label", anchor, letters), box))
        if free:
            mark, box = next((each for each in free if not _crossed(each[1], lit)), free[0])
            taken.append(box)
            marks.append(mark)
    return marks


def _around(x: float, y: float, r: float) -> Box:
    return (x - r, y - r, x + r, y + r)


def _crossed(box: Box, lines: Floats) -> bool:
    """Whether any of the lines, (n, 4) from x, y to x, y, crosses a box."""
    if not lines.size:
        return False
    x0, y0, x1, y1 = lines.T
    near = (np.minimum(x0, x1) < box[2]) & (np.maximum(x0, x1) > box[0])
    near &= (np.minimum(y0, y1) < box[3]) & (np.maximum(y0, y1) > box[1])
    # A line misses a box that it is near to where all corners are on one side of it.
    sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x in box[::2] for y in box[1::2]]
    apart = (np.min(sides, axis=0) > 0.0) | (np.max(sides, axis=0) < 0.0)
    return bool(np.any(near & ~apart))


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _legend(legend: Mapping[str, Spot], top: float, width: float) -> tuple[list[Mark], float]:
    """Glyphs with their meanings, in as many rows as they need; and where the sheet ends."""
    x, y, marks = 14.0, top + 18.0, list[Mark]()
    for meaning, spot in legend.items():
        long = 18.0 + width_of(meaning, 12.0)
        if x > 14.0 and x + long > width - 6.0:
            x, y = 14.0, y + 22.0
        marks += [*_glyph(replace(spot, tip=""), x, y - 4.0, 6.5), Text(x + 13.0, y, meaning, "quiet")]
        x += long + 16.0
    return marks, (y + 12.0 if legend else top)
