"""Where the buses and customers of a feeder stand in a picture: where they are, or as a clean tree.

The tree: every street becomes a row, customers hang below it. Along a row goes the branch with the most
customers; what branches off gets a row of its own, as near as it fits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["Placed", "has_places", "place"]

Point = tuple[float, float]

FEW: Final = 8
"""Maps of so many customers at most get no more than HALF_PAGE, px: two of them, with captions, fit on A4."""
HALF_PAGE: Final = 400.0


@dataclass(frozen=True, slots=True)
class Placed:
    """A feeder on a sheet, px.

    Attributes
    ----------
    width, height
        Of the sheet.
    wires, drops
        Polylines of lines, and of the last metres to customers.
    ties
        Polylines of the lines that close loops.
    busbar
        The busbar's two ends.
    customers
        Place of each customer.
    room
        How much room a customer has.
    real
        Whether places are those of the files.
    """

    width: float
    height: float
    wires: tuple[tuple[Point, ...], ...]
    drops: tuple[tuple[Point, ...], ...]
    ties: tuple[tuple[Point, ...], ...]
    busbar: tuple[Point, Point]
    customers: tuple[Point, ...]
    room: float
    real: bool


def has_places(site: Site) -> bool:
    """Whether the files place every bus, and not most of them on top of each other.

    Parameters
    ----------
    site
        The feeder.
    """
    return site.xy is not None and len({tuple(row) for row in site.xy.tolist()}) > len(site.xy) / 4


def place(site: Site, width: float) -> Placed:
    """Place a feeder on a sheet of a given width.

    Parameters
    ----------
    site
        The feeder.
    width
        Of the sheet, px; narrow sheets get trees that grow downwards.
    """
    return _real(site, width) if has_places(site) else _tree(site, width)


def _real(site: Site, width: float) -> Placed:
    assert site.xy is not None  # noqa: S101  # `has_places`
    xy = np.array(site.xy, dtype=np.float64)
    span = np.ptp(xy, axis=0)
    if np.abs(xy[:, 0]).max() <= 180.0 and np.abs(xy[:, 1]).max() <= 90.0 and span.max() < 1.0:
        xy[:, 0] *= math.cos(math.radians(float(xy[:, 1].mean())))  # degrees: a meridian's metres for both
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
    """Distance from customers to their nearest neighbour; nine in ten have more, within reason."""
    at = np.array(spots)
    apart = np.hypot(*(at[:, None, :] - at[None, :, :]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    return float(np.clip(1.7 * np.quantile(np.minimum(apart.min(axis=1), 60.0), 0.1), 11.0, 24.0))


def _fans(at: Sequence[Point], bus: Sequence[int]) -> tuple[tuple[Point, ...], tuple[tuple[Point, ...], ...]]:
    """Customers of one bus stand around it."""
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
        """Add another block, so many rows lower."""
        self.customers += [(k, x, row + rows) for k, x, row in other.customers]
        self.streets += [(a, b, row + rows) for a, b, row in other.streets]
        self.poles += [(bus, x, row + rows) for bus, x, row in other.poles]
        self.ties += [(x0, r0 + rows, x1, r1 + rows) for x0, r0, x1, r1 in other.ties]


class _Grid:
    """Places the tree of a feeder on a grid."""

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
        """All parts, and how many rows and columns they take."""
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
        """A street with what branches off it, and the columns taken in each of its rows."""
        items, branches, x = _Items(), [], x0
        bus: int | None = start
        while bus is not None:
            following = sorted(self.children[bus], key=lambda k: (-self.weight[k], -self.depth[k], k))
            ahead = [k for k in following if self.children[k]][:1] or following[:1]
            if ahead and not self.children[ahead[0]] and not self.at[bus] and len(following) > 1:
                ahead = []  # the last pole of a street: all its houses hang
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
        for side, origin in reversed(branches):  # far ones first: no tie then crosses a row
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
    """Buses but the busbar, each after its parent."""
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
        # The busbar is met in the row of the other end.
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
