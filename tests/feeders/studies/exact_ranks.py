"""Security indices of a feeder by ranks in exact arithmetic: no tolerance, nothing that rounds."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import combinations
from math import lcm

import numpy as np

from feeders.format.tables import CustomerRow, FeederTables, LineRow
from feeders.model.site import Site, from_tables, load
from tests.gridsec.exact_pairs import exact_rank

Row = list[Fraction]
BASE = load("kerber-landnetz").tables


def two_streets(seed: int) -> Site:
    """A meter at the busbar, two streets, loads without a meter, some inverters; x / r differs by street."""
    rng = np.random.default_rng(seed)
    lines = [("root", "a0"), ("root", "b0")]
    lines += [(f"a{rng.integers(k)}", f"a{k}") for k in (1, 2)]
    lines += [(f"b{rng.integers(k)}", f"b{k}") for k in (1, 2, 3)]
    lost = rng.choice(["a1", "b2", "b3"], rng.integers(1, 3), replace=False)

    def row(bus: str) -> CustomerRow:
        plain = CustomerRow(
            customer=bus, bus=bus, load_kw=3.0, load_profile="H0-A", meter="" if bus in lost else f"m-{bus}"
        )
        own = {"pv_kw": 4.0, "pv_profile": "PV1", "inverter_kva": 5.0, "droop": "ieee1547-b"}
        return replace(plain, **own) if rng.random() < 0.4 else plain

    wires = []
    for above, below in lines:
        r = round(float(rng.uniform(0.01, 0.2)), 4)
        x = round(0.25 * r, 6) if below[0] == "a" else round(float(rng.uniform(0.005, 0.05)), 4)
        wires.append(LineRow(line=below, from_bus=above, to_bus=below, r_ohm=r, x_ohm=x, closed=True))
    customers = [row(bus) for bus in ("root", *(below for _, below in lines))]
    return from_tables(
        FeederTables(replace(BASE.meta, name="two", busbar="root"), tuple(wires), tuple(customers))
    )


class Exact:
    """What stays of unknown powers at all customers, inverters on the steepest part: ``T [R_U, X_U]``.

    T solves ``(1 + 2 X K) v = w``; the lines' ohms are the decimals of the file, K is positive and as large
    as it is.
    """

    def __init__(self, site: Site, unknown: list[int], silent: list[int]) -> None:
        rows = site.tables.lines
        up = {row.to_bus: (row.from_bus, str(row.r_ohm), str(row.x_ohm)) for row in rows if row.closed}
        paths = []
        for customer in site.tables.customers:
            bus, path = customer.bus, {}
            while bus in up:
                above, r, x = up[bus]
                path[bus] = (Fraction(r), Fraction(x))
                bus = above
            paths.append(path)
        shared = [[(p.keys() & q.keys(), p) for q in paths] for p in paths]
        R, X = (
            [[sum((path[bus][k] for bus in both), Fraction(0)) for both, path in line] for line in shared]
            for k in (0, 1)
        )
        count = len(paths)
        matrix = [[Fraction(int(i == j)) for j in range(count)] for i in range(count)]
        ohm = Fraction(site.feeder.base_kva / (1e-3 * site.feeder.base_volt**2))
        for at, slope in zip(site.droop.customer, site.droop.slope, strict=True):
            for i in range(count):
                matrix[i][at] += 2 * ohm * X[i][at] * Fraction(float(slope))
        right = [[line[j] for line in (R[i], X[i]) for j in unknown] for i in range(count)]
        self.effect = solved(matrix, right)
        self.meters = site.meters.tolist()
        self.live = [j for j in range(len(self.meters)) if j not in silent]

    def rank(self, meters: list[int]) -> int:
        return rank([self.effect[self.meters[j]] for j in meters])

    def index(self, must: int | None = None) -> float:
        """The fewest meters without which the others see less; with `must`, of which it sees that too."""
        whole = self.rank(self.live)
        for count in range(1, len(self.live) + 1):
            for liars in combinations(self.live, count):
                rest = [j for j in self.live if j not in liars]
                left = self.rank(rest)
                if (must is None and left < whole) or (must in liars and self.rank([*rest, must]) > left):
                    return count
        return np.inf

    def blind(self) -> list[int]:
        """Customers whose voltage something moves that no live meter sees."""
        seen = [self.effect[self.meters[j]] for j in self.live]
        return [i for i, row in enumerate(self.effect) if rank([*seen, row]) > rank(seen)]


def solved(matrix: list[Row], right: list[Row]) -> list[Row]:
    """Gauss-Jordan; the matrix is regular."""
    work, n = [[*a, *b] for a, b in zip(matrix, right, strict=True)], len(matrix)
    for k in range(n):
        pivot = next(i for i in range(k, n) if work[i][k])
        work[k], work[pivot] = work[pivot], work[k]
        work[k] = [value / work[k][k] for value in work[k]]
        for i in set(range(n)) - {k}:
            work[i] = [a - work[i][k] * b for a, b in zip(work[i], work[k], strict=True)]
    return [row[n:] for row in work]


def rank(rows: list[Row]) -> int:
    """As `exact_rank`, of rows that are made whole first."""
    whole = [lcm(*(value.denominator for value in row)) for row in rows]
    return exact_rank([[int(value * by) for value in row] for row, by in zip(rows, whole, strict=True)])
