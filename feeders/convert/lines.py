"""Connections of another tool's network, and its lines as rows of lines.csv."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from feeders.convert.customers import Draw, rounded
from feeders.convert.provenance import WHOLE, Changes, ConversionChange
from feeders.format.columns import SERIES_NAMES, SHUNT_NAMES, LineRow
from feeders.format.validation import cells_of, columns_of, passive, shunt_us
from feeders.model.three_phase import series_of, shunt_of
from gridsec.arrays import Floats, Ints, Phasors


@dataclass(frozen=True, slots=True, eq=False)
class Coupling:
    """Transformer, or another element that joins buses and is not a line."""

    # Kind and name, and the buses that it joins
    name: str
    buses: tuple[str, ...]
    power_kva: tuple[Phasors, ...]  # Power into it from each bus, by phase, kVA
    # Equivalent line from the first of its two buses to the second, with its tap relative to their nominal
    # voltages, without `to_volt`; None without an equivalent
    line: LineRow | None = None
    idle: Draw | None = None  # No-load power beside that line
    turn: float = 0.0  # Phase shift from the first bus to the second, degrees


def reached(start: str, rows: Iterable[LineRow], without: Collection[str] = ()) -> dict[str, int]:
    """Buses that closed lines connect to `start`, with their distances in lines; ways end at `without`."""
    near: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        if row.closed:
            near[row.from_bus].append(row.to_bus)
            near[row.to_bus].append(row.from_bus)
    level = {start: 0}
    order = [start]
    for bus in order:
        for other in near[bus]:
            if other not in level and bus not in without:
                level[other] = level[bus] + 1
                order.append(other)
    return level


def fused_with(bus: str, rows: Iterable[LineRow]) -> dict[str, int]:
    """Buses that closed switches fuse with a bus."""
    return reached(bus, (row for row in rows if row.fuses))


def as_rows(couplings: Iterable[Coupling]) -> list[LineRow]:
    """Couplings as lines, for questions of connection only."""
    return [
        LineRow(each.name, each.buses[0], other, 0.0, 0.0) for each in couplings for other in each.buses[1:]
    ]


def above_busbar(
    busbar: str, sources: Iterable[str], rows: list[LineRow], couplings: Iterable[Coupling]
) -> set[str]:
    """Buses that are connected to the sources without passing the busbar."""
    fused = fused_with(busbar, rows)
    everything = [*rows, *as_rows(couplings)]
    return {bus for source in sources for bus in reached(source, everything, without=fused)}


VOLT_DIGITS: Final = 6
"""Decimals of nominal voltages."""

CYCLIC: Final = 1e-7
"""Deviation from cyclic symmetry, relative to the largest impedance, up to which a line is symmetric."""


def line_row(
    name: str,
    ends: tuple[str, str],
    phases: Ints,
    *,
    series: Phasors,
    shunt: Floats,
    changes: Changes,
) -> LineRow:
    """Row of a line with matrices: series impedances (k, k), ohm, and total shunt susceptances (k, k), S.

    Cyclically symmetric series impedances become sequence values. Charging that is equal in every phase and
    goes to earth only becomes one number. `phases` (k,) are ascending, 0 for a.
    """
    own, mutual = _means(series)
    row = LineRow(
        name,
        *ends,
        rounded((own - mutual).real),
        rounded((own - mutual).imag),
        phases=_NAMES[tuple(phases.tolist())],
        **charging_cells(name, phases, shunt, changes),
    )
    if len(phases) == 1:
        return row
    like_each_other = cyclic(series)
    if not like_each_other and not passive(series.real):
        effect = "its resistances generate power; taken as transposed"
        changes.note(f"line {name}", "impedance matrix", "approximated", effect)
        like_each_other = True
    if like_each_other:
        zero = own + 2.0 * mutual
        return replace(row, r0_ohm=rounded(zero.real), x0_ohm=rounded(zero.imag))
    return replace(row, **_cells("r", "ohm", series.real, phases), **_cells("x", "ohm", series.imag, phases))


ALL: Final = np.arange(3)
"""All phases."""

_NAMES: Final = {(0,): "a", (1,): "b", (2,): "c", (0, 1): "ab", (1, 2): "bc", (0, 2): "ca", (0, 1, 2): "abc"}


def cyclic(matrix: Phasors | Floats) -> bool:
    """True for interchangeable phases: one value on the diagonal, one beside it."""
    own, mutual = _means(matrix)
    alike = np.full(matrix.shape, mutual)
    np.fill_diagonal(alike, own)
    return bool(np.abs(matrix - alike).max() <= CYCLIC * np.abs(matrix).max())


def _means(matrix: Phasors | Floats) -> tuple[complex, complex]:
    """Mean of the diagonal and of the other entries."""
    count = len(matrix)
    own = complex(np.trace(matrix)) / count
    return own, (complex(matrix.sum()) - count * own) / max(count * (count - 1), 1)


def _cells(symbol: str, unit: str, matrix: Floats, phases: Ints) -> dict[str, Any]:
    whole = np.zeros((3, 3))
    whole[np.ix_(phases, phases)] = 0.5 * (matrix + matrix.T)
    found = columns_of(symbol, unit, whole, np.isin(np.arange(3), phases))
    return {name: rounded(value) for name, value in found.items()}


def charging_cells(name: str, phases: Ints, shunt: Floats, changes: Changes) -> dict[str, Any]:
    """Cells of a line's charging: one number, or a matrix beside its positive sequence; as of `line_row`."""
    own, mutual = (part.real for part in _means(shunt))
    one = {"b_us": rounded(max(own - mutual, 0.0) * 1e6)}
    if len(phases) == 1 or (cyclic(shunt) and abs(mutual) <= CYCLIC * abs(own)):
        return one
    if not passive(shunt):
        changes.note(f"line {name}", CHARGING, "approximated", "no capacitances; " + IN_EVERY_PHASE)
        return one
    return one | _cells("b", "us", 1e6 * shunt, phases)


def by_sequence(one: float, zero: float) -> Floats:
    """Susceptances (3, 3) of equal phases from sequence values, S; not coupled if the zero one is NaN."""
    apart = zero if np.isfinite(zero) else one
    return np.asarray(one * np.eye(3) + (apart - one) / 3.0)


CHARGING: Final = "charging between phases"
IN_EVERY_PHASE: Final = "the positive-sequence charging in every phase; exact where the voltages are balanced"


def balanced_charging(lines: Sequence[LineRow], changes: Changes) -> list[LineRow]:
    """Reduce charging to its positive sequence, if nothing needs three phases; all customers have them."""
    matrices = [shunt_us(cells_of(row)) for row in lines]
    if any(
        row.phases != "abc" or row.r_aa_ohm is not None or row.tap_a is not None for row in lines
    ) or not all(matrix is None or cyclic(matrix) for matrix in matrices):
        return list(lines)
    given = [row.line for row, matrix in zip(lines, matrices, strict=True) if matrix is not None]
    changes.extend(
        ConversionChange(f"line {name}", CHARGING, "approximated", IN_EVERY_PHASE) for name in given
    )
    nothing: dict[str, Any] = dict.fromkeys(SHUNT_NAMES)
    return [replace(row, **nothing) if row.line in given else row for row in lines]


def capacitor(name: str, bus: str, siemens: float | Floats, phases: str = "abc") -> LineRow:
    """Capacitor as the charging of a line to nowhere, so short that its voltage is that of its bus.

    `siemens` is the susceptance per phase, S, or the matrix (k, k) of its phases.
    """
    here = np.array(["abc".index(phase) for phase in sorted(phases)])
    shunt = siemens * np.eye(here.size) if isinstance(siemens, float) else siemens
    ohm = (1.0 + 1j) * 1e-7 / float(shunt.diagonal().max())
    series = np.diag(np.full(here.size, ohm, dtype=np.complex128))
    return line_row(name, (bus, f"{bus} {name}"), here, series=series, shunt=shunt, changes=Changes())


def open_end(row: LineRow, bus: str, volt: float) -> LineRow | None:
    """Line that is closed at `bus` only, as a line to nowhere with its charging; None if negligible.

    Below a nominal voltage of 1000 V charging is negligible.
    """
    if row.b_us == 0 or volt < 1000.0 or row.fuses:
        return None
    name = f"{row.line} open end"
    return replace(row, line=name, from_bus=bus, to_bus=f"{bus} {name}", closed=True)


def turned(row: LineRow, nominal: Mapping[str, float]) -> LineRow:
    """Line in the reverse direction; a tap t becomes 1/t, with the impedance on its other side."""
    away = replace(row, from_bus=row.to_bus, to_bus=row.from_bus)
    level = 1.0
    if row.to_volt is not None:
        level = nominal[row.from_bus] / row.to_volt
        limit = None if row.rating_a is None else rounded(row.rating_a / level)
        away = replace(away, to_volt=round(nominal[row.from_bus], VOLT_DIGITS), rating_a=limit)
    elif set(row.taps) == {1.0}:
        return away
    if row.tap_a is None and row.tap_b is None and row.tap_c is None:
        up, down = (level * row.tap) ** 2, (level * row.tap) ** -2
        factor = dict.fromkeys(SERIES_NAMES, up) | dict.fromkeys(SHUNT_NAMES, down)
        factor |= dict.fromkeys(("r_ohm", "x_ohm", "r0_ohm", "x0_ohm"), up) | {"b_us": down}
        values = {name: (getattr(row, name), by) for name, by in factor.items()}
        cells: dict[str, Any] = {
            name: rounded(value * by) for name, (value, by) in values.items() if value is not None
        }
        return replace(away, tap=rounded(1.0 / row.tap), **cells)
    phases = phases_of(row)
    here = np.ix_(phases, phases)
    side = level**2 * np.outer(row.taps, row.taps)[here]
    scaled = line_row(
        row.line,
        (row.to_bus, row.from_bus),
        phases,
        series=series_of(row)[here] * side,
        shunt=1e-6 * shunt_of(row)[here] / side,
        changes=Changes(),
    )
    scaled = replace(scaled, closed=row.closed, rating_a=away.rating_a, to_volt=away.to_volt)
    return with_taps(scaled, 1.0 / np.array(row.taps))


def with_taps(row: LineRow, taps: Floats) -> LineRow:
    """Line with a transformer at its first end: one ratio, or if they differ one for each phase."""
    own = [rounded(float(tap)) for tap in taps]
    phases = phases_of(row)
    if len({own[phase] for phase in phases}) == 1:
        return replace(row, tap=own[phases[0]], tap_a=None, tap_b=None, tap_c=None)
    cells: dict[str, Any] = {f"tap_{'abc'[phase]}": own[phase] for phase in phases}
    return replace(row, tap=1.0, **cells)


def phases_of(row: LineRow) -> Ints:
    """Phases of a line, ascending, 0 for a."""
    return np.array(["abc".index(phase) for phase in sorted(row.phases)], dtype=np.intp)


def merged(
    lines: Sequence[LineRow], busbar: str, changes: Changes, nominal: Mapping[str, float]
) -> list[LineRow]:
    """Merge parallel lines to one, and open lines that switches short-circuit; `changes` receives both."""
    above: dict[str, str] = {busbar: busbar}

    def fused(bus: str) -> str:
        while above.setdefault(bus, bus) != bus:
            bus = above[bus]
        return bus

    rows: list[LineRow] = []
    for row in lines:
        solid = row.closed and row.fuses
        one, other = fused(row.from_bus), fused(row.to_bus)
        if solid and one == other:
            changes.note(f"switch {row.line}", "closed", "changed", "open; others join the same buses")
            row = replace(row, closed=False)  # noqa: PLW2901
        elif solid:
            above[other] = one
        rows.append(row)
    beside: dict[frozenset[str], list[int]] = defaultdict(list)
    for k, row in enumerate(rows):
        if row.closed and not row.fuses:
            beside[frozenset((fused(row.from_bus), fused(row.to_bus)))].append(k)
    gone: set[int] = set()
    for ends, members in beside.items():
        if len(ends) == 1:
            for k in members:
                rows[k] = replace(rows[k], closed=False)
                changes.note(f"line {rows[k].line}", "closed", "changed", "open; switches join its two ends")
        elif len(members) > 1:
            start = fused(rows[members[0]].from_bus)
            alike = [
                rows[k] if fused(rows[k].from_bus) == start else turned(rows[k], nominal) for k in members
            ]
            rows[members[0]] = _parallel(alike, changes)
            gone.update(members[1:])
    return [row for k, row in enumerate(rows) if k not in gone]


def _parallel(rows: list[LineRow], changes: Changes) -> LineRow:
    """Merge lines between the same buses."""
    names = " + ".join(row.line for row in rows)
    first = rows[0]
    alike = len({row.phases for row in rows}) == 1
    tapped = len({row.taps for row in rows}) > 1
    if not alike or any((row.in_phases and len(row.phases) > 1) or tapped for row in rows):
        return _side_by_side(rows, names, changes)
    changes.note(f"lines {names}", WHOLE, "changed", f"in parallel; one line {first.line}")
    positive = [complex(row.r_ohm, row.x_ohm) for row in rows]
    total = 1.0 / sum(1.0 / z for z in positive)
    limit = _shared(rows, [abs(total) / abs(z) for z in positive])
    joined = replace(
        first,
        r_ohm=rounded(total.real),
        x_ohm=rounded(total.imag),
        b_us=rounded(sum(row.b_us for row in rows)),
        rating_a=None if math.isnan(limit) else rounded(limit),
    )
    zeros = [
        complex(row.r0_ohm, row.x0_ohm) for row in rows if row.r0_ohm is not None and row.x0_ohm is not None
    ]
    if len(zeros) < len(rows) or not all(zeros):
        return replace(joined, r0_ohm=None, x0_ohm=None)
    zero = 1.0 / sum(1.0 / z for z in zeros)
    return replace(joined, r0_ohm=rounded(zero.real), x0_ohm=rounded(zero.imag))


def _side_by_side(rows: list[LineRow], names: str, changes: Changes) -> LineRow:
    """Merge lines of any phases and matrices between the same buses: their admittances add up."""
    first = rows[0]
    each: list[Phasors] = []
    charge = np.zeros((3, 3))
    taps = np.full(3, np.nan)
    for row in rows:
        own = phases_of(row)
        here = np.ix_(own, own)
        each.append(np.zeros((3, 3), dtype=np.complex128))
        each[-1][here] = np.linalg.inv(series_of(row)[here])
        charge[here] += shunt_of(row)[here]
        taps[own] = np.where(np.isnan(taps[own]), np.array(row.taps)[own], taps[own])
        if np.abs(taps[own] - np.array(row.taps)[own]).max() > CYCLIC:
            effect = f"that of {first.line} beside it; the current that their difference drives is left out"
            changes.note(f"line {row.line}", "tap", "approximated", effect)
    admittance = np.sum(each, axis=0)
    phases = np.flatnonzero(admittance.diagonal())
    there = np.ix_(phases, phases)
    series = np.asarray(np.linalg.inv(admittance[there]))
    changes.note(f"lines {names}", WHOLE, "changed", f"side by side; one line {first.line}")
    joined = line_row(
        first.line,
        (first.from_bus, first.to_bus),
        phases,
        series=series,
        shunt=1e-6 * charge[there],
        changes=changes,
    )
    parts = [own[there] @ series for own in each]
    # Shares of balanced currents, to which ratings refer; single phases share by the diagonal.
    balanced = np.exp(-2j * np.pi / 3.0 * phases)
    limits = np.array([_shared(rows, share) for share in np.abs(parts @ balanced).T])
    limit = None if np.isnan(limits).any() else rounded(float(limits.min()))
    even = all(np.abs(part - np.diag(part.diagonal())).max() <= CYCLIC for part in parts)
    if limit is not None and not (even and np.ptp(limits) <= CYCLIC * limit):
        effect = f"{limit:g} A, the least of its conductors' in balanced currents"
        changes.note(f"lines {names}", "rating", "approximated", effect)
    joined = replace(joined, rating_a=limit, to_x=first.to_x, to_y=first.to_y, to_volt=first.to_volt)
    return with_taps(joined, taps)


def _shared(rows: Sequence[LineRow], shares: Sequence[float] | Floats) -> float:
    """Rating of lines in parallel, each with its share of the current; NaN if one of them has none."""
    if any(row.rating_a is None for row in rows):
        return math.nan
    limits = (
        row.rating_a / share
        for row, share in zip(rows, shares, strict=True)
        if row.rating_a is not None and share > 0.0
    )
    return float(min(limits))
