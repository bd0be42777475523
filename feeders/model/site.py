"""Feeder model in per unit from tables, frames from readings in SI, and the uncertainty of the loads.

A load follows a first-order process with the standard deviation sigma of its range, or of its forecast, and
the correlation time tau = `[load] correlation_s`. Single devices switch the whole difference J between the
reading and the farther end of the range at once. The change over an age a > 0 has the standard deviation

    s(a) = sqrt(2 sigma^2 (1 - exp(-a / tau)) + (J / SWITCHED)^2).

A power with s of sigma or more is no better than no reading.

This module alone converts between SI and per unit, and from the wire's sign (net import positive) to the
model's (injection positive).

References
----------
docs/theory-front.md, section 7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Final

import numpy as np

from feeders.format.columns import (
    CUSTOMER_COLUMNS,
    META_COLUMNS,
    CellInvalid,
    Column,
    CustomerRow,
    FeederTables,
    Number,
)
from feeders.format.tables import validate
from feeders.format.validation import Tree
from feeders.model.equipment import (
    Equipment,
    LoadModel,
    Referred,
    equipment,
    find,
    indices,
    names,
    not_radial,
    refer,
    without_impedance,
)
from feeders.model.forecast import Forecast, always, forecast
from feeders.model.three_phase import spanned_valid, unsupported
from gridsec.arrays import Bools, Floats, Ints, all_of, any_of, frozen
from gridsec.errors import FeederInvalid, InputInvalid, Problem
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.plant import Plant
from gridsec.grid import AnyNetwork
from gridsec.grid.meshed import MeshedFeeder, PhasedMesh
from gridsec.grid.network import Power
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import PHASES, ThreePhaseFeeder
from gridsec.interface import Frame, PowerOrigin, usable_offset

__all__ = [
    "ABSURD_PU",
    "RENEWAL_TICKS",
    "SWITCHED",
    "Late",
    "LoadModel",
    "PowerAges",
    "Registered",
    "Site",
    "Snapshot",
    "change",
    "expected",
    "find",
    "forecast_errors",
    "from_history",
    "from_tables",
    "late",
    "load",
    "load_doubt",
    "names",
    "plant",
    "registered",
    "spread",
    "tell",
    "to_frame",
    "unread",
    "volts",
]


SWITCHED: Final = 5.0
"""Difference to the end of the range by the standard deviation of switching it, 1.

The limits of one meter begin at 5.2: no single device exceeds them. A larger value names honest meters, a
smaller one hides attacks.
"""

RENEWAL_TICKS: Final = 2.5
"""Delay of a renewed power by lost readings, ticks: the age at which a reading is not usable at a tick."""


@dataclass(frozen=True, slots=True, eq=False)
class Late:
    """Late powers of one tick. N customers."""

    which: Bools  # (N,), customers with a late power that is better than none
    useless: Bools  # (N,), customers with a power that is too late to be better than none
    stated: Bools  # (N,), customers with a power no older than `[meters] p_interval_s`
    std: Floats  # (N,), standard deviation of the change of the active power, pu; 0 elsewhere
    reach: Floats  # (N,), largest change, pu

    def widen(self, site: Site, frame: Frame) -> Frame:
        """Frame of the readings with the uncertainty of the late powers.

        Intervals reach to the ends of the range. Metered reactive powers of the same age are not used.
        """
        loads, which, none = site.loads, self.which, np.full(self.std.size, np.nan)
        root, tan = np.sqrt(3.0), np.maximum(np.abs(loads.tan_min), np.abs(loads.tan_max))
        low, high = -loads.q_floor, loads.load_peak * loads.tan_max + loads.q_floor
        q = -frame.q
        p_std = np.hypot(frame.p_error / root, self.std)
        q_std = np.hypot(frame.q_error / root, tan * np.minimum(self.std, loads.load_peak))
        told = (none if std is None else std for std in (frame.p_std, frame.q_std))
        origin = np.zeros(q.size, dtype=np.intp) if frame.p_origin is None else frame.p_origin
        late = which & ~self.stated & (origin == PowerOrigin.READ)
        return replace(
            frame,
            p_error=np.where(which, np.maximum(frame.p_error, self.reach), frame.p_error),
            q_error=np.where(which, np.maximum(frame.q_error, np.maximum(q - low, high - q)), frame.q_error),
            q_net=np.where(which | self.useless, np.nan, frame.q_net),
            p_std=np.where(which, p_std, next(told)),
            q_std=np.where(which, q_std, next(told)),
            p_origin=np.where(late, PowerOrigin.LATE, origin).astype(np.intp),
        )


def late(site: Site, snapshot: Snapshot) -> Late | None:
    """Late powers of a tick; None if all have the time of their voltage.

    `[meters] p_interval_s` of the feeder's file is the age of powers without a time of their own. A clock
    offset beyond `usable_offset` adds to the age: power and voltage are those of another moment.
    """
    meta, told, off = site.tables.meta, snapshot.p_age_s, np.zeros(site.meters.size)
    if snapshot.clock_offset_s is not None:
        off = np.nan_to_num(np.abs(snapshot.clock_offset_s))
        off = np.where(off > usable_offset(meta.monitor.tick_s), off, 0.0)
    interval = meta.meters.p_interval_s
    if told is None and interval == 0.0 and not any_of(off):
        return None
    told = np.full(off.size, np.nan) if told is None else told
    age = np.where(np.isnan(told), interval, np.maximum(told, 0.0)) + off
    aged = (age > 0.0) & np.isfinite(snapshot.p_kw)
    if not any_of(aged):
        return None
    ages, p = np.zeros((2, site.loads.load_peak.size))
    ages[site.meters] = np.where(aged, age, 0.0)
    p[site.meters] = np.where(aged, snapshot.p_kw / site.feeder.base_kva, 0.0)
    reach = np.maximum(site.loads.load_peak - p, p + site.loads.pv_peak)
    std = change(site, ages, reach)
    useless = (ages > 0.0) & (std >= spread(site))
    which = (ages > 0.0) & ~useless
    return Late(which, useless, ages <= interval, np.where(which, std, 0.0), np.where(which, reach, 0.0))


class PowerAges:
    """Ages of powers that stay bit-identical for longer than `[meters] p_interval_s`.

    A power without a time of its own is renewed once in each interval. An unchanged one is then as old as its
    first reading. Readings may be lost: the rule starts `RENEWAL_TICKS` ticks after the interval. Without a
    stated interval, and for powers with a time of their own, it has no effect.

    site: the feeder.
    """

    def __init__(self, site: Site) -> None:
        meta = site.tables.meta
        self._interval = meta.meters.p_interval_s
        self._unchanged = self._interval + RENEWAL_TICKS * meta.monitor.tick_s
        self._powers = np.full((2, site.meters.size), np.nan)
        self._since = np.full(site.meters.size, np.nan)

    def apply(self, snapshot: Snapshot) -> Snapshot:
        """Add the ages of unchanged powers to the readings of the next tick."""
        if self._interval == 0.0:
            return snapshot
        powers = np.array([snapshot.p_kw, snapshot.q_kvar])
        same = (powers == self._powers) | np.isnan(powers) & np.isnan(self._powers)
        renewed = np.isfinite(snapshot.p_kw) & ~same.all(axis=0)
        self._powers[:, renewed] = powers[:, renewed]
        self._since[renewed] = snapshot.t
        told = np.full(renewed.size, np.nan) if snapshot.p_age_s is None else snapshot.p_age_s
        age = snapshot.t - self._since
        old = np.isnan(told) & np.isfinite(snapshot.p_kw) & (age > self._unchanged)
        return replace(snapshot, p_age_s=np.where(old, age, told)) if old.any() else snapshot


def change(site: Site, age_s: Floats | float, reach: Floats) -> Floats:
    """Standard deviation of the change of each customer's active power over an age, s, (N,), pu; 0 at age 0.

    `reach` (N,) is the distance to the farther end of the range, pu.
    """
    slow = -2.0 * np.expm1(-np.asarray(age_s) / site.tables.meta.load.correlation_s)
    moved = np.hypot(np.sqrt(slow) * spread(site), reach / SWITCHED)
    return np.asarray(np.where(np.asarray(age_s) > 0.0, moved, 0.0))


def spread(site: Site) -> Floats:
    """Standard deviation of each customer's active power without a reading, (N,), pu."""
    if site.forecast is not None:
        return site.forecast.p_std
    return np.asarray((site.loads.load_peak + site.loads.pv_peak) / np.sqrt(12.0))


def expected(site: Site) -> Floats:
    """Standard deviation of the change over `[meters] p_interval_s` in the design, (N,), pu."""
    if site.tables.meta.meters.p_interval_s == 0.0:
        return np.zeros(site.loads.load_peak.size)
    reach = site.loads.load_peak + site.loads.pv_peak
    return np.minimum(change(site, site.tables.meta.meters.p_interval_s, reach), spread(site))


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """Load powers of one tick, consumption positive, pu. N customers."""

    # (N,), centre and half-width of the interval of the net active power
    p: Floats
    p_error: Floats
    # (N,), the same of the load's reactive power
    q: Floats
    q_error: Floats
    known: Bools  # (N,), the interval rests on a reading
    origin: Ints  # (N,), `PowerOrigin` of `p`
    excess: Floats  # (N,), part of the reading beyond the declared load or generation


def registered(site: Site, metered: Floats) -> Registered:
    """Power intervals of the frame; `metered` (N,) is each register's net active power, pu, NaN without one.

    A reading is used up to ``LoadModel.credible``. Readings beyond the declared range are used only while the
    model error has a finite bound with all of them. Otherwise those with the largest voltage effect ``R_ii
    excess_i`` are replaced by the declared range, the fewest that restore the bound. The bound is at nominal
    busbar voltage, so that a busbar meter cannot affect it.
    """
    known = np.abs(metered) <= site.loads.credible  # False for NaN
    found = _intervals(site.loads, metered, known)
    over = np.flatnonzero(known & (found.excess > 0.0))
    if not over.size or _bounded(site, found):
        return found
    effect = site.feeder.self_impedance(Power.ACTIVE)[over] * found.excess[over]
    over = over[np.argsort(-effect, kind="stable")]

    def without(count: int) -> Registered:
        used = known.copy()
        used[over[:count]] = False
        return _intervals(site.loads, metered, used)

    few, enough = 0, over.size
    while enough - few > 1:
        middle = (few + enough) // 2
        few, enough = (few, middle) if _bounded(site, without(middle)) else (middle, enough)
    return without(enough)


def _bounded(site: Site, powers: Registered) -> bool:
    """True with a finite error bound of the loss-corrected model at nominal busbar voltage."""
    with np.errstate(all="ignore"):
        bound = site.feeder.model_error_bound(-powers.p, -powers.q, site.droop.vbar**2)
    return all_of(np.isfinite(bound))


def _intervals(model: LoadModel, metered: Floats, known: Bools) -> Registered:
    """Intervals of the powers, see `feeders.model.site.to_frame`; the declared range where not `known`."""
    p = np.where(known, metered, 0.5 * (model.load_peak - model.pv_peak))
    size = np.abs(p)
    own = model.p_fraction * size + model.p_floor
    beyond = np.isfinite(metered) & ~known
    if any_of((p > model.load_peak) | (-p > model.pv_peak)):
        excess = np.maximum(p - model.load_peak, 0.0) + np.maximum(-p - model.pv_peak, 0.0)
        own += np.minimum(2.0 * excess, size)
        beyond |= known & (excess > 0.0)
    else:
        excess = np.zeros(p.size)
    p_error = np.where(known, own, model.p_unread)
    low = np.maximum(p - p_error, 0.0)
    most = np.minimum(p + p_error + model.pv_peak, model.load_peak)
    high = np.maximum(np.maximum(most, p + p_error), 0.0)
    q_low = low * model.tan_min - model.q_floor
    q_high = high * model.tan_max + model.q_floor
    q_error = 0.5 * (q_high - q_low)
    origin = np.where(known, _READ, _UNREAD)
    if any_of(beyond):
        origin[beyond] = PowerOrigin.BEYOND
    return Registered(
        p=p,
        p_error=p_error,
        q=0.5 * (q_low + q_high),
        q_error=np.where(known, q_error, np.minimum(q_error, model.q_unread)),
        known=known,
        origin=origin,
        excess=excess,
    )


_READ, _UNREAD = np.intp(PowerOrigin.READ), np.intp(PowerOrigin.UNREAD)


# An absurd reading is evidence too, but its square must stay finite.
ABSURD_PU = 100.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Site(Equipment):
    """Feeder for monitoring and simulation. N customers, p meters, b + 1 buses.

    With single-phase lines or customers, or lines that are not transposed, it is in three phases, and each
    customer of `tables` has one phase. A customer of three phases becomes three, see `one_phase_each`.
    """

    feeder: AnyNetwork  # the radial tree, pu; or with closed ties, or in three phases
    # (n,) 1 pu of every place, V: the nominal voltage, times the taps' ratio behind taps, see
    # `feeders.model.equipment`
    base_volt: Floats
    # (n,) nominal voltage of every place, V; behind a transformer it differs from the busbar's
    nominal_volt: Floats
    forecast: Forecast | None = None  # forecast of unread powers; None: they have their range only

    @cached_property
    def customer_volt(self) -> Floats:
        """1 pu at every customer, V, (N,)."""
        return frozen(self.base_volt[self.feeder.bus])

    @cached_property
    def customer_nominal(self) -> Floats:
        """Nominal voltage of every customer, V, (N,)."""
        return frozen(self.nominal_volt[self.feeder.bus])

    @cached_property
    def meter_volt(self) -> Floats:
        """1 pu at every meter, V, (p,)."""
        return frozen(self.customer_volt[self.meters])

    @cached_property
    def meter_limits(self) -> tuple[Floats, Floats]:
        """Lowest and highest permitted voltage at every meter, V, (p,)."""
        limits, nominal = self.tables.meta.limits, self.customer_nominal[self.meters]
        return frozen(limits.v_min_pu * nominal), frozen(limits.v_max_pu * nominal)

    @property
    def spanning(self) -> Feeder | ThreePhaseFeeder:
        """Tree that reaches all buses with all their phases: all lines but the ties."""
        return self.feeder if isinstance(self.feeder, Feeder) else self.feeder.tree

    @property
    def ties(self) -> Ints:
        """Buses at both ends of the lines that close loops in `spanning`, (t, 2)."""
        return (
            self.feeder.ends
            if isinstance(self.feeder, MeshedFeeder | PhasedMesh)
            else np.zeros((0, 2), dtype=np.intp)
        )

    @property
    def tree(self) -> Feeder | ThreePhaseFeeder:
        """Tree of the buses, for methods of radial feeders.

        Raises FeederInvalid if closed lines form loops.
        """
        if isinstance(self.feeder, MeshedFeeder | PhasedMesh):
            raise not_radial()
        return self.spanning

    @property
    def balanced(self) -> Feeder:
        """Radial tree, for methods of balanced feeders.

        Raises FeederInvalid in three phases, or if closed lines form loops.
        """
        if isinstance(self.tree, Feeder):
            return self.tree
        raise FeederInvalid(
            [Problem("not-balanced", "lines, customers: in three phases; a balanced feeder is required")]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Readings of one tick in SI, as on the wire: net import positive. p meters."""

    t: float  # Unix time, s
    v_volt: Floats  # (p,) phase-to-neutral voltages, V; NaN where missing
    p_kw: Floats  # (p,) net active import of the customer, kW; NaN where missing
    q_kvar: Floats  # (p,) net reactive import, the inverter included, kvar; NaN where not reported
    v0_volt: Floats | float  # Busbar voltage, V; NaN where missing. In three phases (3,).
    # (p,) or None: age of the powers at the voltage readings beside them, s; NaN, or None for all, where not
    # stated
    p_age_s: Floats | None = None
    # (p,) or None: clock offset of each meter, s, positive ahead; NaN, or None for all, where not measurable
    clock_offset_s: Floats | None = None
    # clock offset of the busbar meter, s, positive ahead; NaN where not measurable
    busbar_offset_s: float = math.nan


def load(path_or_name: Path | str) -> Site:
    """Load a feeder: a folder, or the name of a bundled feeder (`names()`).

    Raises FeederInvalid with every problem of the files, or for an unknown feeder.
    """
    return from_tables(find(path_or_name))


def from_tables(tables: FeederTables) -> Site:
    """Build the per-unit model from a feeder's tables.

    With ``z_base = 3 V^2 / (1000 S)`` ohm for V volts phase to neutral and S kVA of all three phases:
    ``r = r_ohm / z_base``, ``b = 1e-6 b_us z_base``, and powers in kW divide by S. Behind taps V is that of
    `feeders.model.equipment`.

    Raises FeederInvalid for invalid tables, or for content that the model does not support.
    """
    problems = validate(tables)
    if not tables.in_phases:
        problems = problems or tuple(without_impedance(tables))
    else:  # rows and ids of the files, not of the channels
        problems = problems or tuple(_channels(tables)) or unsupported(tables)
    if problems:
        raise FeederInvalid(problems)
    return _in_phases(one_phase_each(tables)) if tables.in_phases else _in_one_phase(tables)


def one_phase_each(tables: FeederTables) -> FeederTables:
    """Split customers and meters of three phases into one for each phase, with its part of the power.

    A meter of three phases reads three voltages and three powers; they become the channels "X-a", "X-b" and
    "X-c". Standard deviations are split as those of independent phases. An inverter of three phases becomes
    three that follow the voltage of their own phase.
    """
    rows = [part for row in tables.customers for part in (_parts(row) if row.phases == "abc" else [row])]
    return replace(tables, customers=tuple(rows))


def _parts(row: CustomerRow) -> list[CustomerRow]:
    def part(value: float | None, divisor: float) -> float | None:
        return None if value is None else value / divisor

    return [
        replace(
            row,
            customer=f"{row.customer}-{phase}",
            phases=phase,
            meter=row.meter and f"{row.meter}-{phase}",
            load_kw=row.load_kw / 3.0,
            pv_kw=row.pv_kw / 3.0,
            inverter_kva=row.inverter_kva / 3.0,
            q_floor_kvar=part(row.q_floor_kvar, 3.0),
            p_std_kw=part(row.p_std_kw, 3.0**0.5),
            q_std_kvar=part(row.q_std_kvar, 3.0**0.5),
        )
        for phase in PHASES
    ]


def _channels(tables: FeederTables) -> list[Problem]:
    """Problems of ids that customers or meters of three phases give to their phases."""
    problems = []
    for column in (column for column in CUSTOMER_COLUMNS if column.name in {"customer", "meter"}):
        first: dict[str, str] = {}
        for number, row in enumerate(tables.customers, start=1):
            where = f"customers, row {number} ({row.customer})"
            ids = [getattr(part, column.name) for part in (_parts(row) if row.phases == "abc" else [row])]
            wrong = [problem for problem in map(partial(_wrong, column), ids) if problem]
            wrong += [
                Problem(
                    "duplicate",
                    f"{own!r} is already the id of {first[own]}; every id must be unique, as those of "
                    "the phases of three-phase customers",
                )
                for own in ids
                if own in first
            ]
            if wrong:
                problems.append(Problem(wrong[0].code, f"{where}, column {column.name}: {wrong[0]}"))
            first.update({own: where for own in ids if own})
    return problems


def _wrong(column: Column, cell: str) -> Problem | None:
    try:
        column.parse(cell)
    except CellInvalid as wrong:
        return wrong.problem
    return None


def _in_phases(tables: FeederTables) -> Site:
    """Site of a feeder with one phase per customer."""
    found, ties = spanned_valid(tables)
    parts = {f.name: getattr(found, f.name) for f in fields(found)}
    feeder = PhasedMesh(found.feeder, *ties) if ties.ends.size else PhasedFeeder(found.feeder)
    places = {
        "feeder": feeder,
        "base_volt": frozen(found.base_volt.ravel()),
        "nominal_volt": frozen(np.repeat(found.nominal_volt, len(PHASES))),
        "forecast": forecast(found.tables, found.loads),
    }
    return Site(**parts | places)


def _in_one_phase(tables: FeederTables) -> Site:
    """Site of a balanced feeder."""
    base, found = refer(tables)
    feeder, own = _feeder(tables, base, found), equipment(tables, base, found)
    return Site(
        feeder=_meshed(tables, feeder, base, found) if base.ties else feeder,
        base_volt=frozen(base.bus[:, 0]),
        nominal_volt=frozen(base.nominal),
        forecast=forecast(tables, own["loads"]),
        **own,
    )


def plant(site: Site) -> Plant:
    """Plant of the site, for the monitor's design."""
    return Plant(site.feeder, site.droop, site.meters, site.accuracy, 1)


def volts(base_volt: Floats, v2_pu: Floats) -> Floats:
    """Convert squared voltages (…, n), pu, to volts: ``v = base_volt sqrt(v2)``; a negative one gives 0."""
    return np.asarray(base_volt * np.sqrt(np.maximum(v2_pu, 0.0)), dtype=np.float64)


def to_frame(site: Site, snapshot: Snapshot) -> Frame:
    """Convert one tick's readings to a frame; valid for any readings, absurd ones included.

    Voltages: ``y = v |v|`` in pu, so that a negative reading stays implausible.

    Active power: a register of f = `p_error_percent` and steps of 2 h shows r; the truth is within ``(f |r| +
    h) / (1 - f)`` of it. Beyond the customer's largest load or generation the interval widens by twice the
    excess, at most by the reading itself. A false load can hide a common attack of voltage meters, and the
    connection limits its size. Without a finite bound of the model error the reading is not used
    (`feeders.model.site`). Without a reading, or with one that is not finite or implausible, the interval is
    from full generation without load to full load without generation. Its middle is p. `p_std_kw` of a
    customer without a meter is the standard deviation from the middle, and the half-width is `sqrt(3)` of it
    if that is less. With `forecast = "profiles"` p and q are those of `feeders.model.forecast`, with the
    whole range as interval about them. A power older than its voltage reading is widened by the load change
    in that time (`feeders.model.site`).

    Reactive power of the load, without the inverter's, which the observer estimates: with net import P, the
    load alone is in ``[max(P, 0), max(P, min(P + pv, load_kw))]``, each end widened by the error of P. Its
    reactive power is in ``[load_low tan_min - floor, load_high tan_max + floor]``. Without generation the
    load is P itself. The frame has centre and half-width of that interval. `q_std_kvar` of a customer without
    a meter narrows it as `p_std_kw` does.
    """
    base_kva, model = site.feeder.base_kva, site.loads
    seen = np.isfinite(snapshot.v_volt)
    v = np.minimum(np.maximum(snapshot.v_volt / site.meter_volt, -ABSURD_PU), ABSURD_PU)
    y = np.where(seen, v * np.abs(v), np.nan)
    v0_squared, v0_phases = _busbar(snapshot.v0_volt, site.feeder.base_volt)
    metered = np.full(model.load_peak.size, np.nan)
    metered[site.meters] = snapshot.p_kw / base_kva
    aged = late(site, snapshot)
    if aged is not None:
        metered[aged.useless] = np.nan
    load = registered(site, metered)
    q_net, size = np.full(model.load_peak.size, np.nan), np.zeros(model.load_peak.size)
    if not all_of(np.isnan(snapshot.q_kvar)):
        q_net[site.meters] = -snapshot.q_kvar / base_kva
        told = np.abs(q_net) <= model.credible
        q_net[~told] = np.nan
        size[told] = np.abs(q_net[told])
    frame = Frame(
        t=snapshot.t,
        y=y,
        seen=seen,
        v0_squared=v0_squared,
        p=-load.p,
        p_error=load.p_error,
        q=-load.q,
        q_error=load.q_error,
        q_net=q_net,
        q_net_error=np.maximum(model.q_error, model.q_fraction * size),
        v0_phases=v0_phases,
        p_origin=load.origin,
        clock_offset=snapshot.clock_offset_s,
        busbar_offset=snapshot.busbar_offset_s,
    )
    frame = frame if site.forecast is None else site.forecast.fill(frame, ~load.known)
    return frame if aged is None else aged.widen(site, frame)


def _busbar(v0_volt: Floats | float, base_volt: float) -> tuple[float, Floats | None]:
    """Squared busbar voltage, pu: the mean of the phases, and in three phases that of each."""
    if not isinstance(v0_volt, np.ndarray):
        one = min(max(v0_volt / base_volt, 0.0), ABSURD_PU) if math.isfinite(v0_volt) else math.nan
        return one * one, None
    v0 = np.clip(np.where(np.isfinite(v0_volt), v0_volt, np.nan) / base_volt, 0.0, ABSURD_PU) ** 2
    return float(v0.mean()), v0


# --- building -----------------------------------------------------------------------------------


def _feeder(tables: FeederTables, base: Referred, found: Tree) -> Feeder:
    meta, lines = tables.meta, base.lines
    z_base = 3.0 * base.branch[:, 0] ** 2 / (1000.0 * meta.base_kva)
    return Feeder(
        name=meta.name,
        parent=indices(found.parent),
        r=np.array([line.r_ohm for line in lines]) / z_base,
        x=np.array([line.x_ohm for line in lines]) / z_base,
        bus=indices([found.group[row.bus] for row in tables.customers]),
        customers=tuple(row.customer for row in tables.customers),
        buses=found.buses,
        base_volt=meta.voltage_volt,
        base_kva=meta.base_kva,
        charging=np.array([line.b_us for line in lines]) * (1e-6 * z_base),
    )


def _meshed(tables: FeederTables, feeder: Feeder, base: Referred, found: Tree) -> MeshedFeeder:
    meta, ties = tables.meta, base.ties
    z_base = 3.0 * base.tie[:, 0] ** 2 / (1000.0 * meta.base_kva)
    return MeshedFeeder(
        tree=feeder,
        ends=np.array([(found.group[tie.from_bus], found.group[tie.to_bus]) for tie in ties], dtype=np.intp),
        r=np.array([tie.r_ohm for tie in ties]) / z_base,
        x=np.array([tie.x_ohm for tie in ties]) / z_base,
        charging=np.array([tie.b_us for tie in ties]) * (1e-6 * z_base),
    )


# --- Load uncertainty ---


TYPICAL: Final = 0.5
"""Share of the peak at which errors that grow with the load are sized."""

ALIKE: Final = 0.5
"""Common share of the customers' variance: of reactive power known by power factors, and of unmetered powers.

Seasons, hours and habits move these together.
"""

LONGEST_S: Final = next(
    column.high
    for column in META_COLUMNS["load"]
    if column.name == "correlation_s" and isinstance(column, Number) and column.high
)
"""Longest correlation time of the format, s."""


def load_doubt(site: Site) -> LoadDoubt:
    """Standard deviations of the customers' powers by a feeder's files.

    Metered active power has the error of its register, the load's reactive power that of its power factor
    limits. Both are uniform within these limits and lasting: a register and a power factor err in one
    direction all the time. Unmetered powers are uniform in the range of `to_frame`, so that design and frames
    agree. `p_std_kw` and `q_std_kvar` take precedence; their errors have the correlation time
    `correlation_s`. They describe a metered customer's reported power, and the distance of an unmetered one
    from the middle of its range. With forecasts it is the distance from the forecast, by default that of the
    library. With `p_interval_s` the metered powers also have the load change over that interval.
    """
    rows, loads, base = site.tables.customers, site.loads, site.feeder.base_kva
    typical = TYPICAL * loads.load_peak
    p = (loads.p_fraction * np.maximum(typical, loads.pv_peak) + loads.p_floor) / np.sqrt(3.0)
    q = (0.5 * (loads.tan_max - loads.tan_min) * typical + loads.q_floor) / np.sqrt(3.0)
    frame, unmetered = unread(site), np.ones(p.size, dtype=np.bool_)
    unmetered[site.meters] = False
    p = np.where(unmetered, _usual(frame.p_error, frame.p_std), p)
    q = np.where(unmetered, _usual(frame.q_error, frame.q_std), q)
    told_p = np.array([np.nan if row.p_std_kw is None else row.p_std_kw for row in rows])
    told_q = np.array([np.nan if row.q_std_kvar is None else row.q_std_kvar for row in rows])
    by_limits = bool(np.isnan(told_q).any() or np.isnan(told_p).any())
    open_ = unmetered & np.isnan(told_p)
    changed = np.where(unmetered, 0.0, expected(site))
    return LoadDoubt(
        p=np.hypot(np.where(np.isnan(told_p), p, told_p / base), changed),
        q=np.hypot(np.where(np.isnan(told_q), q, told_q / base), loads.tan_max * changed),
        time_s=site.tables.meta.load.correlation_s,
        common_q=ALIKE if np.isnan(told_q[site.meters]).any() else 0.0,
        lasting=1.0 if by_limits else 0.0,
        together=np.where(open_, ALIKE, 0.0) if open_.any() else 0.0,
        sudden_p=changed if changed.any() else None,
        sudden_q=loads.tan_max * changed if changed.any() else None,
    )


def unread(site: Site) -> Frame:
    """Frame without readings of meters: powers have their range only.

    Intervals about forecasts hold at any time.
    """
    none = np.full(site.meters.size, np.nan)
    frame = to_frame(site, Snapshot(0.0, none, none, none, np.nan))
    return always(site.forecast, frame, np.ones(frame.p.size, dtype=np.bool_))


def _usual(half_width: Floats, std: Floats | None) -> Floats:
    """Standard deviation of a uniform error in an interval, or the stated one."""
    uniform = half_width / np.sqrt(3.0)
    return uniform if std is None else np.where(np.isnan(std), uniform, std)


def forecast_errors(site: Site, t: Floats, p_kw: Floats, q_kvar: Floats) -> tuple[Floats, Floats]:
    """Deviations of true powers from frames without readings, pu, (T, N): a history for `from_history`.

    `t` (T,) are Unix times, s; `p_kw` and `q_kvar` (T, N) the true net active import and the loads' reactive
    import.
    """
    none, base = np.full(site.meters.size, np.nan), site.feeder.base_kva
    frames = [to_frame(site, Snapshot(float(now), none, none, none, np.nan)) for now in t]
    p, q = (np.array([getattr(frame, name) for frame in frames]) for name in ("p", "q"))
    return p_kw / base + p, q_kvar / base + q


def tell(tables: FeederTables, doubt: LoadDoubt, base_kva: float) -> FeederTables:
    """Write standard deviations to customers without a meter, and the correlation time to `[load]`.

    The correlation time is at most LONGEST_S; `base_kva` is 1 pu of `doubt`.
    """
    told = zip(tables.customers, doubt.p * base_kva, doubt.q * base_kva, strict=True)
    rows = tuple(
        row if row.meter else replace(row, p_std_kw=float(p), q_std_kvar=float(q)) for row, p, q in told
    )
    load = replace(tables.meta.load, correlation_s=min(float(doubt.time_s), LONGEST_S))
    return replace(tables, meta=replace(tables.meta, load=load), customers=rows)


def from_history(error_p: Floats, error_q: Floats, step_s: float) -> LoadDoubt:
    """Estimate the load uncertainty from a history (T, N) of errors, pu: true powers less the assumed ones.

    The correlation time is that of a first-order process with the same correlation between successive
    samples: the median over the customers, at most the length of the history. The common share follows from
    the variance of the customers' mean beyond that of independent errors.

    Raises ValueError with fewer than three samples, or values that are not finite.
    """
    if error_p.ndim != 2 or error_p.shape != error_q.shape or len(error_p) < _FEWEST:
        raise InputInvalid(
            [
                Problem(
                    "shape", f"errors of shapes {error_p.shape} and {error_q.shape}; need (T, N) with T >= 3"
                )
            ]
        )
    if not (np.isfinite(error_p).all() and np.isfinite(error_q).all() and step_s > 0):
        raise InputInvalid(
            [Problem("not-finite", "errors and their interval must be finite, and the interval positive")]
        )
    return LoadDoubt(
        p=np.sqrt(np.mean(error_p**2, axis=0)),
        q=np.sqrt(np.mean(error_q**2, axis=0)),
        time_s=min(step_s / -float(np.log(_from_sample_to_sample(error_p))), step_s * len(error_p)),
        common_p=_common(error_p),
        common_q=_common(error_q),
    )


_FEWEST = 3
# Limits of the correlation between samples that a history can resolve.
_RANGE = (1e-3, 1.0 - 1e-6)


def _from_sample_to_sample(error: Floats) -> float:
    energy = np.sum(error[:-1] ** 2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.sum(error[1:] * error[:-1], axis=0) / energy
    share = share[np.isfinite(share)]
    return float(np.clip(np.median(share), *_RANGE)) if share.size else _RANGE[0]


def _common(error: Floats) -> float:
    """Share c of ``var(sum e / s) = N (1 - c) + N^2 c``."""
    std = np.sqrt(np.mean(error**2, axis=0))
    use = std > 0
    count = int(np.count_nonzero(use))
    if count < 2:
        return 0.0
    total = float(np.mean(np.sum(error[:, use] / std[use], axis=1) ** 2))
    return float(np.clip((total / count - 1.0) / (count - 1.0), 0.0, 1.0))
