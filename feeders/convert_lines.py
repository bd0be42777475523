"""Lines of other tools as rows of lines.csv: impedance matrices as sequences, parallel lines as one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from feeders.convert_changes import WHOLE, Change
from feeders.convert_customers import rounded
from feeders.schema import LineRow
from gridsec.arrays import Floats, Ints, Phasors

CYCLIC: Final = 1e-7
"""Deviation from cyclic symmetry, as a share of the largest impedance, below which a line is symmetric."""


def line_row(
    name: str,
    ends: tuple[str, str],
    phases: Ints,
    *,
    series: Phasors,
    shunt: Floats,
    changes: list[Change],
) -> LineRow:
    """Return the row of a line given by matrices.

    A matrix of three phases becomes cyclically symmetric: the mean of its diagonal and of the rest. One of
    two phases is that of three whose third carries nothing. Of the charging the positive sequence remains.

    Parameters
    ----------
    name, ends
        Of the line.
    phases : (k,)
        Its phases, 0 for a.
    series : (k, k)
        Series impedances, ohm.
    shunt : (k, k)
        Total shunt susceptances, S.
    changes
        Takes what is not carried over exactly.
    """
    own, mutual = _means(series)
    b_own, b_mutual = (part.real for part in _means(shunt.astype(np.complex128)))
    label, count = f"line {name}", len(phases)
    if count == 1:
        return LineRow(
            name, *ends, rounded(own.real), rounded(own.imag), "abc"[phases[0]], b_us=_charging(b_own)
        )
    cyclic = np.full((count, count), mutual)
    np.fill_diagonal(cyclic, own)
    off = float(np.abs(series - cyclic).max() / np.abs(series).max())
    if off > CYCLIC:
        changes.append(
            Change(
                label,
                "impedance matrix",
                "approximated",
                f"taken as transposed; entries are up to {100 * off:.1g} % of the largest off their mean",
            )
        )
    if count == 2:
        changes.append(Change(label, "phases", "changed", "of two phases; its third carries nothing"))
    if abs(b_mutual) > CYCLIC * abs(b_own):
        changes.append(
            Change(
                label,
                "charging between phases",
                "approximated",
                "the positive-sequence charging in every phase; exact where the voltages are balanced",
            )
        )
    positive, zero = own - mutual, own + 2.0 * mutual
    return LineRow(
        name,
        *ends,
        rounded(positive.real),
        rounded(positive.imag),
        r0_ohm=rounded(zero.real),
        x0_ohm=rounded(zero.imag),
        b_us=_charging(b_own - b_mutual),
    )


def _means(matrix: Phasors) -> tuple[complex, complex]:
    """Mean of the diagonal and of the rest."""
    count = len(matrix)
    own = complex(np.trace(matrix)) / count
    return own, (complex(matrix.sum()) - count * own) / max(count * (count - 1), 1)


def _charging(siemens: float) -> float:
    return rounded(max(siemens, 0.0) * 1e6)


def capacitor(name: str, bus: str, siemens: float, phases: str = "abc") -> LineRow:
    """Return a capacitor as the charging of a line to nowhere, so short that its voltage is that of its bus.

    Parameters
    ----------
    name, bus
        Of the capacitor.
    siemens
        Its susceptance per phase, S.
    phases
        Phases it is connected to.
    """
    ohm = rounded(1e-7 / siemens)
    zero = ohm if phases == "abc" else None
    return LineRow(
        name, bus, f"{bus} {name}", ohm, ohm, phases, r0_ohm=zero, x0_ohm=zero, b_us=rounded(siemens * 1e6)
    )


def open_end(row: LineRow, bus: str, volt: float) -> LineRow | None:
    """Return a line that is open at one end only as a line to nowhere: its charging goes on.

    Parameters
    ----------
    row
        The line.
    bus
        Its closed end.
    volt
        Nominal voltage, V; below 1000 the charging is too small to matter.
    """
    if row.b_us == 0 or volt < 1000.0 or not (row.r_ohm or row.x_ohm):
        return None
    name = f"{row.line} open end"
    return replace(row, line=name, from_bus=bus, to_bus=f"{bus} {name}", closed=True)


def merged(lines: Sequence[LineRow], busbar: str, changes: list[Change]) -> list[LineRow]:
    """Return the lines with those in parallel as one, and those that switches short-circuit open.

    Parameters
    ----------
    lines
        Rows of a feeder.
    busbar
        Its busbar.
    changes
        Takes what was joined.
    """
    above: dict[str, str] = {busbar: busbar}

    def fused(bus: str) -> str:
        while above.setdefault(bus, bus) != bus:
            bus = above[bus]
        return bus

    rows: list[LineRow] = []
    for row in lines:
        solid = row.closed and row.r_ohm == row.x_ohm == 0.0
        one, other = fused(row.from_bus), fused(row.to_bus)
        if solid and one == other:
            changes.append(
                Change(f"switch {row.line}", "closed", "changed", "open; others join the same buses")
            )
            row = replace(row, closed=False)  # noqa: PLW2901
        elif solid:
            above[other] = one
        rows.append(row)
    beside: dict[frozenset[str], list[int]] = defaultdict(list)
    for k, row in enumerate(rows):
        if row.closed and (row.r_ohm or row.x_ohm):
            beside[frozenset((fused(row.from_bus), fused(row.to_bus)))].append(k)
    gone: set[int] = set()
    for ends, members in beside.items():
        if len(ends) == 1:
            for k in members:
                rows[k] = replace(rows[k], closed=False)
                changes.append(
                    Change(f"line {rows[k].line}", "closed", "changed", "open; switches join its two ends")
                )
        elif len(members) > 1:
            rows[members[0]] = _parallel([rows[k] for k in members], changes)
            gone.update(members[1:])
    return [row for k, row in enumerate(rows) if k not in gone]


def _parallel(rows: list[LineRow], changes: list[Change]) -> LineRow:
    """Join lines between the same buses."""
    names = " + ".join(row.line for row in rows)
    first = rows[0]
    if len({row.phases for row in rows}) > 1:
        return _side_by_side(rows, names, changes)
    changes.append(Change(f"lines {names}", WHOLE, "changed", f"in parallel; one line {first.line}"))
    positive = [complex(row.r_ohm, row.x_ohm) for row in rows]
    total = 1.0 / sum(1.0 / z for z in positive)
    limits = [
        row.rating_a * abs(z) / abs(total) for row, z in zip(rows, positive, strict=True) if row.rating_a
    ]
    joined = replace(
        first,
        r_ohm=rounded(total.real),
        x_ohm=rounded(total.imag),
        b_us=rounded(sum(row.b_us for row in rows)),
        rating_a=rounded(min(limits)) if len(limits) == len(rows) else None,
    )
    zeros = [
        complex(row.r0_ohm, row.x0_ohm) for row in rows if row.r0_ohm is not None and row.x0_ohm is not None
    ]
    if len(zeros) < len(rows) or not all(zeros):
        return replace(joined, r0_ohm=None, x0_ohm=None)
    zero = 1.0 / sum(1.0 / z for z in zeros)
    return replace(joined, r0_ohm=rounded(zero.real), x0_ohm=rounded(zero.imag))


def _side_by_side(rows: list[LineRow], names: str, changes: list[Change]) -> LineRow:
    """Join lines of single phases between the same buses: one of all phases without coupling."""
    own: dict[str, complex] = {}
    charge: dict[str, float] = defaultdict(float)
    for row in rows:
        for phase in row.phases:
            z = complex(row.r_ohm, row.x_ohm)
            own[phase] = z if phase not in own else 1.0 / (1.0 / own[phase] + 1.0 / z)
            charge[phase] += row.b_us
    mean = sum(own.values()) / len(own)
    apart = max(abs(z - mean) for z in own.values()) / abs(mean)
    alike = apart <= CYCLIC and all(len(row.phases) == 1 for row in rows)
    changes.append(
        Change(
            f"lines {names}",
            WHOLE,
            "changed" if alike else "approximated",
            f"side by side; one line {rows[0].line} of all phases"
            + ("" if alike else f" with their mean impedance, from which they differ by {100 * apart:.1g} %"),
        )
    )
    return replace(
        rows[0],
        phases="abc",
        r_ohm=rounded(mean.real),
        x_ohm=rounded(mean.imag),
        r0_ohm=rounded(mean.real),
        x0_ohm=rounded(mean.imag),
        b_us=rounded(sum(charge.values()) / len(own)),
        rating_a=min((row.rating_a for row in rows if row.rating_a is not None), default=None),
    )
