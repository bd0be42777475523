"""Loads and generators of other tools as rows of customers.csv."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from feeders.convert.provenance import WHOLE, Changes
from feeders.format.tables import CustomerRow
from feeders.profiles import envelopes
from gridsec.arrays import Phasors

HOUSEHOLDS: Final = ("H0-A", "H0-B", "H0-C", "H0-G", "H0-L")
# Trade and agriculture with reactive power close to proportional to active power, as of large loads.
TRADE: Final = ("G1-A", "G2-A", "G6-A", "L1-A", "L2-A")
HOUSEHOLD_KW: Final = 30.0
USUAL_POWER_FACTOR: Final = 0.93
LEAST_POWER_FACTOR: Final = 0.01
"""Smallest power factor of customers.csv."""

SMALL_KVA: Final = 4.6


def rounded(value: float) -> float:
    """Round to nine significant digits: exact enough for any cable, and without rounding errors of units."""
    return float(f"{value:.9g}")


def usual_profile(number: int, *, household: bool) -> str:
    """Profile of the load of this number, by turns in the order of the loads."""
    kinds = HOUSEHOLDS if household else TRADE
    return kinds[number % len(kinds)]


def reactive(customer: CustomerRow, power_factor: float | None) -> CustomerRow:
    """Set power factors and reactive floor from the history of the load's profile.

    `power_factor` is that at the peak, lagging; None: the usual one.
    """
    factor = USUAL_POWER_FACTOR if power_factor is None else max(round(power_factor, 4), LEAST_POWER_FACTOR)
    tan = math.tan(math.acos(factor))
    history = envelopes()[customer.load_profile]
    # Rounded outwards, so that the interval still contains the history.
    return replace(
        customer,
        power_factor=factor,
        power_factor_min=min(
            factor,
            max(math.floor(1e4 * math.cos(math.atan(history.high * tan))) / 1e4, LEAST_POWER_FACTOR),
        ),
        power_factor_max=max(factor, math.ceil(1e4 * math.cos(math.atan(history.low * tan))) / 1e4),
        q_floor_kvar=math.ceil(1e4 * history.floor * tan * customer.load_kw) / 1e4,
    )


def droop_preset(kva: float) -> str:
    """Droop curve of an inverter of this size without a known curve."""
    return "vde4105" if kva > SMALL_KVA else "vde4105-small"


def with_meters(rows: list[CustomerRow]) -> list[CustomerRow]:
    """Give every customer a meter: m01, m02, ... in order."""
    digits = max(2, len(str(len(rows))))
    return [replace(row, meter=f"m{k:0{digits}d}") for k, row in enumerate(rows, start=1)]


@dataclass(frozen=True, slots=True)
class Fleet:
    """Synthetic PV inverters for a source without any."""

    every: int
    """Interval among the customers without generation, from the first one on."""
    kva: float
    """Rating, kVA; 0: half of the customer's load_kw."""
    droop: str = "ieee1547-b"


def with_fleet(customers: list[CustomerRow], fleet: Fleet, changes: Changes) -> list[CustomerRow]:
    """Add synthetic inverters to customers without one."""
    rows = list(customers)
    bare = [k for k, row in enumerate(rows) if row.inverter_kva == 0.0]
    for k in bare[:: fleet.every]:
        kva = fleet.kva or rounded(0.5 * rows[k].load_kw)
        if kva > 0:
            row = replace(rows[k], pv_kw=rounded(0.9 * kva), pv_profile=f"PV{k % 8 + 1}")
            rows[k] = replace(row, inverter_kva=kva, droop=fleet.droop)
            effect = f"synthetic, with droop curve {fleet.droop}; not in the source"
            changes.note(rows[k].customer, f"PV inverter of {kva:g} kVA", "added", effect)
    return rows


def base_kva(volt: float, load_kw: float) -> float:
    """Base power of the per-unit system for a feeder of this voltage and load."""
    return 100.0 if volt < 1000.0 else 10.0 ** max(2, math.ceil(math.log10(max(load_kw, 1.0))))


NO_POWER: Final = 1e-9
"""Relative power below which a load's power is a rounding error of a solver."""

UNSURE: Final = 0.5
"""Relative standard deviation of a transformer's no-load power: without a reading, a customer has half of it.
"""

SWITCHED_OFF: Final = (
    "in service",
    "changed",
    "switched off in the source; a customer with an expected load of zero",
)
"""Change of a load that is switched off: property, action, effect."""

ONLY_REACTIVE: Final = (
    "reactive power",
    "left out",
    "has no active power, to which the expected reactive power is proportional",
)
"""The same for a load of reactive power only."""

BY_DROOP: Final = (
    "reactive power",
    "left out",
    "its droop curve decides; in the check it is that of the source",
)
"""The same for the reactive power of a generator with an inverter."""

EVEN: Final = 1e-6
"""Spread of the phases' powers, relative to the largest, up to which a connection has three phases."""


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """Load or generator at a bus."""

    # Name and bus
    name: str
    bus: str
    power_kva: Phasors  # (3,), power from each phase at the source's operating point, P + jQ, kVA
    even: bool = True  # True for one connection of all three phases
    # Rating of a generator's inverter, kVA; 0: without inverter; None: not a generator
    rating_kva: float | None = None
    idle: bool = False  # True for a transformer's no-load power, which is unmetered
    peak_kw: float = 0.0  # Rated peak of a generator, kW; the present power may be less
    phases: str = "abc"  # Connected phases, with or without power
    noun: str = ""  # Noun for messages; empty: load or generator

    @property
    def label(self) -> str:
        """Noun and name for messages."""
        return f"{self.noun or ('load' if self.rating_kva is None else 'generator')} {self.name}"


def is_even(power: Phasors) -> bool:
    """True if all phases have the same nonzero power."""
    size = float(np.abs(power).max())
    return size > 0 and float(np.abs(power - power.mean()).max()) <= EVEN * size


def as_it_stands(power: Phasors) -> str:
    """Effect on a load or generator with a control of its own, from its power (3,) in the source, kVA."""
    p, q = (round(float(part), 6) + 0.0 for part in (power.sum().real, power.sum().imag))
    if p < 0:
        return f"a customer that feeds in {-p:.4g} kW and draws {q:.4g} kvar in the check"
    return f"a customer that draws {p:.4g} kW and {q:.4g} kvar"


def customers_of(
    draws: Iterable[Draw],
    nominal: Mapping[str, float],
    droop: str | None,
    changes: Changes,
    taken: Collection[str] = (),
) -> tuple[list[CustomerRow], dict[str, complex]]:
    """Rows of customers.csv, and the power of each at the source's operating point, kVA.

    `nominal` are the buses' voltages, V; `droop` is the generators' preset, None: by their size; `taken` are
    names of other customers.
    """
    rows: list[CustomerRow] = []
    power: dict[str, complex] = {}
    own = (draw for draw in draws if not draw.idle)
    for draw in sorted(own, key=lambda each: each.rating_kva is not None):
        connections = _connections(draw)
        if not connections:
            effect = "draws nothing in the source's power flow"
            changes.note(draw.label, WHOLE, "left out", effect)
        for phases, kva in connections:
            row = CustomerRow(_unique(draw, phases, {*taken, *power}), draw.bus, load_kw=0.0, phases=phases)
            power[row.customer] = kva
            takes = kva.real > EVEN * max(abs(kva), draw.peak_kw)
            if draw.rating_kva is None or takes:
                noun, volt = draw.noun or "load", nominal[draw.bus]
                row = _load(row, kva, len(rows), volt=volt, changes=changes, noun=noun)
            if draw.rating_kva is not None:
                row = _generator(row, kva, draw, len(rows), droop=droop, changes=changes)
            rows.append(row)
    return rows, power


def _generator(
    row: CustomerRow,
    kva: complex,
    draw: Draw,
    number: int,
    *,
    droop: str | None,
    changes: Changes,
) -> CustomerRow:
    """Give a customer a generator's peak, and its inverter."""
    parts = len(_connections(draw))
    rating = (draw.rating_kva or 0.0) / parts
    peak = rounded(max(draw.peak_kw / parts, -kva.real, 0.0))
    row = replace(row, pv_kw=peak, pv_profile=f"PV{number % 8 + 1}")
    if not rating > 0:
        effect = f"{row.pv_profile}, not in the source: a feeder's generation follows the sun"
        changes.note(draw.label, "profile", "added", effect)
        return row
    row = replace(row, inverter_kva=rounded(rating), droop=droop or droop_preset(rating))
    changes.note(draw.label, "droop curve", "added", f"{row.droop}, not in the source")
    if abs(kva.imag) > EVEN * rating:
        changes.note(draw.label, *BY_DROOP)
    return row


def idle_customers(
    draws: Iterable[Draw], taken: Collection[str]
) -> tuple[list[CustomerRow], dict[str, complex]]:
    """No-load powers of transformers as customers without meters, and their powers, kVA."""
    rows: list[CustomerRow] = []
    power: dict[str, complex] = {}
    for draw in draws:
        for phases, kva in _connections(draw) if draw.idle else ():
            row = CustomerRow(
                _unique(draw, phases, {*taken, *power}), draw.bus, load_kw=rounded(max(kva.real, 0.0))
            )
            factor = max(kva.real / abs(kva), LEAST_POWER_FACTOR)
            # Reactive power beyond the power factor: all of it without active power.
            beside = abs(kva.imag) - row.load_kw * math.tan(math.acos(factor))
            row = replace(row, phases=phases, q_floor_kvar=rounded(max(beside, 0.0)))
            one = rounded(factor)
            row = replace(row, power_factor=one, power_factor_min=one, power_factor_max=one)
            std = [rounded(UNSURE * abs(part)) for part in (kva.real, kva.imag)]
            rows.append(replace(row, p_std_kw=std[0], q_std_kvar=std[1]))
            power[row.customer] = kva
    return rows, power


def _connections(draw: Draw) -> list[tuple[str, complex]]:
    if draw.even:
        return [("abc", complex(draw.power_kva.sum()))]
    least = EVEN * float(np.abs(draw.power_kva).max())
    return [
        (phase, complex(kva))
        for phase, kva in zip("abc", draw.power_kva, strict=True)
        if abs(kva) > least or (draw.peak_kw > 0 and phase in draw.phases)
    ]


def in_star(pairs: Phasors, volts: Phasors) -> Phasors:
    """Powers of a load between phases, from each phase, (3,), kVA.

    The current between the phases k and k + 1 is ``conj(S_k / (V_k - V_k+1))``; the current of a phase is the
    difference of two of these. `pairs` (3,) are the powers between a and b, b and c, c and a, kVA.
    """
    between = np.conj(pairs / (volts - np.roll(volts, -1)))
    return np.asarray(volts * np.conj(between - np.roll(between, 1)), dtype=np.complex128)


def _unique(draw: Draw, phases: str, taken: Collection[str]) -> str:
    several = phases != "abc" and len(_connections(draw)) > 1
    name = (f"{draw.name}-{phases}" if several else draw.name)[:120]
    while name in taken:
        name += "'"
    return name


def expected_load(row: CustomerRow, kva: complex, label: str, prop: str, changes: Changes) -> CustomerRow:
    """Set the power factors of a load of this power; reports parts of it that the format lacks."""
    p, q = kva.real, kva.imag
    if p < 0:
        effect = "feeds in; its expected load is taken as 0"
        changes.note(label, prop, "changed", effect)
    if q < -NO_POWER * abs(kva):
        effect = "leading; expected to be 1"
        changes.note(label, "power factor", "approximated", effect)
    if p <= 0.0 and q > NO_POWER:
        changes.note(label, *ONLY_REACTIVE)
    return reactive(row, p / math.hypot(p, q) if p > 0 and q > 0 else None)


def _load(
    row: CustomerRow, kva: complex, number: int, *, volt: float, changes: Changes, noun: str
) -> CustomerRow:
    p = kva.real
    household = volt < 1000.0 and p <= HOUSEHOLD_KW
    row = replace(row, load_kw=rounded(max(p, 0.0)), load_profile=usual_profile(number, household=household))
    return expected_load(row, kva, f"{noun} {row.customer}", "p_kw", changes)
