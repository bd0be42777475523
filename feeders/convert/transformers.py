"""Transformers of other tools as lines: two-ports, regulators, stations.

Every tool describes transformers differently (short-circuit tests, tables of taps, equivalent circuits).
Balanced, a transformer is a linear two-port, and two power flows of it alone identify it: one without load,
one with an impedance. The equivalent circuit is a shunt at its first end, an ideal transformer of complex
ratio t and a series impedance behind that::

    V_1 = t (V_2 + z I_2),    I_1 = y V_1 + I_2 / t

t is the line's tap and phase shift, z its impedance, and the power of y is a customer. A lossless transformer
lacks the part of t's angle that comes from y rather than from the vector group. At a known operating point
the customer has the power that restores the balance.

A transformer is a line if its phases are not coupled. Its ratio is then a fixed tap and, for another nominal
voltage, `to_volt`. The vector group of a balanced feeder's transformer shifts all phases equally, without an
effect in a radial feeder. A transformer that closes a loop becomes two customers with the power through it.
It stays a line if the loop is requested and the ratios around it multiply to 1.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from feeders.convert.customers import Draw, is_even, rounded
from feeders.convert.lines import VOLT_DIGITS, Coupling, above_busbar, as_rows, fused_with, reached, turned
from feeders.convert.provenance import WHOLE, Changes, ConversionChange
from feeders.convert.source import SourceNetwork
from feeders.format.tables import LineRow
from feeders.format.validation import same_level
from gridsec.arrays import Phasors
from gridsec.errors import Problem

TAP_DIGITS: Final = 9
"""Decimals of a ratio, the same for equal transformers."""

TURN_DIGITS: Final = 6
"""Decimals of the phase shift in degrees."""

NO_LOAD_KVA: Final = 1e-6
"""Power below which a no-load power counts as zero, kVA."""


@dataclass(frozen=True, slots=True)
class TwoPort:
    """Balanced transformer."""

    ratio: complex  # Complex ratio t of the voltage at its first end to that behind it, without load
    series: complex  # Impedance z behind it, ohm

    @classmethod
    def measured(
        cls, names: Iterable[int], idle: tuple[Phasors, Phasors], loaded: tuple[Phasors, Phasors]
    ) -> dict[int, TwoPort]:
        """Identify transformers from two power flows, without load and loaded.

        Each has the voltages at both ends, (n, 2), V, and the currents out of the second end, (n,), A.
        """
        ports = {}
        for name, (a, b), (u, v), current in zip(names, idle[0], *loaded, strict=True):
            ratio = complex(a) / complex(b)
            ports[int(name)] = cls(ratio, (complex(u) / ratio - complex(v)) / complex(current))
        return ports

    @property
    def turn(self) -> float:
        """Phase shift, degrees."""
        return round(math.degrees(cmath.phase(self.ratio)), TURN_DIGITS)

    def line(self, name: str, ends: tuple[str, str], nominal: tuple[float, float]) -> LineRow | None:
        """Equivalent line, with its tap relative to the nominal voltages of its ends, V; None without one."""
        r, x = rounded(self.series.real), rounded(self.series.imag)
        if not (math.isfinite(r) and math.isfinite(x)) or min(r, x) < 0 or r == x == 0:
            return None
        tap = round(abs(self.ratio) * nominal[1] / nominal[0], TAP_DIGITS)
        return LineRow(name, *ends, r, x, tap=tap)

    def idle(self, name: str, bus: str, flows: tuple[Phasors, Phasors], volts: Phasors) -> Draw | None:
        """Power beyond the losses in z, as a draw at its first end `bus`; None if negligible.

        `flows` (3,) are the powers into it from each end, kVA; `volts` (3,) the voltages behind it, V.
        """
        into, back = flows
        power: Phasors = into + back - np.abs(back) ** 2 / np.abs(volts) ** 2 * self.series * 1e3
        if not np.isfinite(power).all() or np.abs(power).sum() < NO_LOAD_KVA:
            return None
        return Draw(f"{name} no-load", bus, power, even=is_even(power), idle=True)


def coupling_of(
    name: str,
    buses: tuple[str, ...],
    power_kva: tuple[Phasors, ...],
    *,
    port: TwoPort | None,
    rating_a: float,
    network: SourceNetwork,
) -> Coupling:
    """Transformer with its equivalent line, if there is one; `rating_a` is that at the second bus, A.

    `port` is the two-port between its first two buses; None if unknown.
    """
    if port is None:
        return Coupling(name, buses, power_kva)
    here, there = network.nominal[buses[0]], network.nominal[buses[1]]
    line = port.line(name, (buses[0], buses[1]), (here, there))
    if line is None:
        return Coupling(name, buses, power_kva)
    limit = rounded(rating_a) if math.isfinite(rating_a) and rating_a > 0 else None
    behind = network.volts.get(buses[1])
    idle = None if behind is None else port.idle(name, buses[0], (power_kva[0], power_kva[1]), behind)
    return Coupling(name, buses, power_kva, replace(line, rating_a=limit), idle, port.turn)


@dataclass(frozen=True, slots=True)
class Extent:
    """Extent of a feeder."""

    # True: only the busbar's nominal voltage; a transformer to another one is a customer
    one_voltage: bool = False
    meshed: bool = False  # True: transformers may close loops


EVERYTHING: Final = Extent()

AROUND: Final = 1e-9
"""Tolerance of the ratio around a loop, that of the feeder format."""

HERE: Final = "a line with the fixed ratio {} of the source's power flow"
THERE: Final = "a line to {:.6g} V, its ratio {} of the nominal one as in the source's power flow"


def transformed(
    network: SourceNetwork, rows: list[LineRow], busbar: str, extent: Extent, changes: Changes
) -> tuple[SourceNetwork, list[LineRow]]:
    """Replace transformers below the busbar by their equivalent lines, where possible."""
    fused = fused_with(busbar, rows)
    above = above_busbar(busbar, network.sources, rows, network.couplings)
    left: list[Coupling] = []
    lines: list[LineRow] = []
    draws: list[Draw] = []
    joined = _Joined(rows, loops=extent.meshed)
    away = reached(busbar, [*rows, *as_rows(network.couplings)])
    for each in network.couplings:
        if each.line is None or not above.isdisjoint(set(each.buses) - fused.keys()):
            left.append(each)
            continue
        here, there = (network.nominal[bus] for bus in each.buses)
        line = each.line if same_level(here, there) else replace(each.line, to_volt=round(there, VOLT_DIGITS))
        if line.to_volt is not None:
            wanted = not extent.one_voltage and _leads_on(network, rows, each, busbar)
            turn = cmath.exp(1j * math.radians(each.turn))
            if not (wanted and joined.takes(line, line.tap * turn * here / there)):
                left.append(each)
                continue
        lines.append(line)
        draws += [] if each.idle is None else [each.idle]
        backwards = away.get(line.from_bus, 0) > away.get(line.to_bus, 0)
        changes.append(_told(each, turned(line, network.nominal) if backwards else line))
        if each.idle is None and not network.volts:
            effect = "not known without the source's power flow"
            changes.note(each.name, "no-load current", "left out", effect)
    return replace(network, couplings=left, draws=[*network.draws, *draws]), [*rows, *lines]


def _told(each: Coupling, line: LineRow) -> ConversionChange:
    ratios = " ".join(f"{tap:.6g}" for tap in dict.fromkeys(line.taps))
    effect = HERE.format(ratios) if line.to_volt is None else THERE.format(line.to_volt, ratios)
    return ConversionChange(each.name, "tap" if line.to_volt is None else WHOLE, "changed", effect)


def _leads_on(network: SourceNetwork, rows: Iterable[LineRow], each: Coupling, busbar: str) -> bool:
    """True if lines begin behind a transformer; otherwise its customers are one load at its terminals."""
    beside = set(each.buses)
    others = [*rows, *as_rows(other for other in network.couplings if set(other.buses) != beside)]
    ways = [reached(bus, others) for bus in each.buses]
    behind = next((way for way in ways if busbar not in way), None)
    if behind is None:  # the transformer closes a loop
        return True
    return any(row.closed and not row.fuses and row.from_bus in behind for row in rows)


class _Joined:
    """Joined buses, and the complex ratios of their voltages; rows have no ratio other than their taps."""

    def __init__(self, rows: Iterable[LineRow], *, loops: bool) -> None:
        self._loops = loops
        self._all, self._solid = _Groups(), _Groups()
        self._pairs: set[frozenset[str]] = set()
        for row in rows:
            if row.closed:
                self._all.join(row.from_bus, row.to_bus, 1.0 / row.tap + 0j)
            if row.closed and row.fuses:
                self._solid.join(row.from_bus, row.to_bus, 1.0 + 0j)

    def takes(self, line: LineRow, ratio: complex) -> bool:
        """Add a transformer, ``V_from = ratio V_to``; False if it contradicts the joined buses."""
        pair = frozenset(self._solid.at(bus)[0] for bus in (line.from_bus, line.to_bus))
        (one, here), (other, there) = self._all.at(line.from_bus), self._all.at(line.to_bus)
        if one == other:
            return (self._loops or pair in self._pairs) and abs(there / here * ratio - 1.0) <= AROUND
        self._pairs.add(pair)
        self._all.join(line.from_bus, line.to_bus, 1.0 / ratio)
        return True


class _Groups:
    """Joined buses, each with the ratio of its voltage to that of its group's first bus."""

    def __init__(self) -> None:
        self._at: dict[str, tuple[str, complex]] = {}
        self._members: dict[str, list[str]] = {}

    def at(self, bus: str) -> tuple[str, complex]:
        """First bus of its group, and the ratio to it."""
        if bus not in self._at:
            self._at[bus], self._members[bus] = (bus, 1.0 + 0j), [bus]
        return self._at[bus]

    def join(self, near: str, far: str, ratio: complex) -> None:
        """Join two groups by ``V_far = ratio V_near``; the smaller one joins the larger."""
        (one, here), (other, there) = self.at(near), self.at(far)
        step = ratio * here / there
        if one == other:
            return
        if len(self._members[one]) < len(self._members[other]):
            one, other, step = other, one, 1.0 / step
        for bus in self._members.pop(other):
            self._at[bus] = one, self._at[bus][1] * step
            self._members[one].append(bus)


def levels_of(rows: Iterable[LineRow], nominal: Mapping[str, float]) -> list[Problem]:
    """Problems of the nominal voltages, V, that lines join."""
    return [
        Problem(
            "inconsistent",
            f"line {row.line!r} joins the buses {row.from_bus!r} of {nominal[row.from_bus]:.6g} V and "
            f"{row.to_bus!r} of {nominal[row.to_bus]:.6g} V nominal voltage; expected one voltage",
        )
        for row in rows
        if row.to_volt is None
        and {row.from_bus, row.to_bus} <= nominal.keys()
        and not same_level(nominal[row.from_bus], nominal[row.to_bus])
    ]
