"""Feeder, radial, meshed or in three phases, with its single-phase parts, for calibration.

References: docs/theory-studies.md, Calibration.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from feeders.format.tables import FeederTables
from feeders.model.site import Site, find, from_tables
from feeders.model.three_phase import ThreePhaseSite, spanned
from feeders.studies.calibrate.readings import Frames
from feeders.studies.operating import line_rows
from gridsec.arrays import Bools, Floats, Ints, Phasors
from gridsec.errors import FeederInvalid, Problem
from gridsec.grid import three_phase as three
from gridsec.grid.devices import voltage_curve
from gridsec.grid.meshed import MeshedFeeder, impedances
from gridsec.grid.radial import Feeder
from gridsec.grid.three_phase import PHASES, ThreePhaseFeeder, lindist3flow
from gridsec.planning.calibration import Field, Places, PriorUncertainty, Series
from gridsec.planning.droop.ac_sensitivity import lines

__all__ = ["Lateral", "MergedNetwork", "network", "site_of"]


@dataclass(frozen=True, slots=True, eq=False)
class Lateral:
    """Part of a feeder behind a single-phase line from a bus of several phases; or a customer there."""

    customers: Ints  # all its customers, by index
    lines: tuple[int, ...]  # indices into the tables, the first line first; none for a customer
    phase: str
    place: int  # place that feeds it
    others: Mapping[str, int]  # places of the other phases at the same bus, by phase

    def to(self, phase: str) -> tuple[Ints, int, int]:
        """Customers, place that feeds the part, and place of another phase there."""
        return self.customers, self.place, self.others[phase]


def laterals(feeder: ThreePhaseFeeder, lines: Sequence[tuple[int, ...]], place: Ints) -> tuple[Lateral, ...]:
    """Single-phase laterals of a tree.

    `lines` are those of each branch, indices into the tables; `place`, (Q, 2), has bus and phase of each
    place.
    """
    at = {(bus, PHASES[phase]): q for q, (bus, phase) in enumerate(place.tolist())}
    above, own = feeder.phases[feeder.parent], feeder.phases[1:]
    buses = np.arange(len(feeder.buses))
    out = []
    for k in np.flatnonzero((own.sum(axis=1) == 1) & (above.sum(axis=1) > 1)).tolist():
        fed, was = int(feeder.parent[k]), PHASES[int(own[k].argmax())]
        below = [bus - 1 for bus in np.flatnonzero(_below(feeder, buses, k + 1)).tolist() if bus != k + 1]
        out.append(
            Lateral(
                customers=np.flatnonzero(_below(feeder, feeder.bus, k + 1)),
                lines=tuple(row for branch in (k, *below) for row in lines[branch]),
                phase=was,
                place=at[fed, was],
                others={phase: at[fed, phase] for phase in PHASES if phase != was and (fed, phase) in at},
            )
        )
    return tuple(out)


def alone(feeder: ThreePhaseFeeder, phases: Sequence[str], place: Ints) -> tuple[Lateral, ...]:
    """Single-phase customers at buses of several phases; `place` as in `laterals`."""
    at = {(bus, PHASES[phase]): q for q, (bus, phase) in enumerate(place.tolist())}
    out = []
    for k, (bus, own) in enumerate(zip(feeder.bus.tolist(), phases, strict=True)):
        others = {phase: at[bus, phase] for phase in PHASES if phase != own and (bus, phase) in at}
        if len(own) == 1 and others:
            out.append(Lateral(np.array([k]), (), own, at[bus, own], others))
    return tuple(out)


def _below(feeder: ThreePhaseFeeder, buses: Ints, first: int) -> Bools:
    """Mask of the buses that are this one or behind it."""
    start = feeder.walk.start[buses]
    return np.asarray((feeder.walk.start[first] <= start) & (start < feeder.walk.stop[first]))


MOST_BUSES: Final = 150  # above it lines in series without customers between them are merged
IDLE: Final = 0.25  # assumed load of an unmetered customer, relative to its peak
HIDDEN: Final = 3.0**-0.5  # std of the load hidden by generation, relative to its limit: uniform
CLOUDS: Final = 0.1  # part of it that varies in time
STEEP_PU: Final = 0.003  # half of the voltage range for the slope of an inverter's curve, pu

_STEPS: Final = 2
_ROUNDS: Final = 4
_CHUNK: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class MergedNetwork:
    """Feeder, in which lines in series are merged if it is large."""

    site: Site | ThreePhaseSite  # feeder of the files
    feeder: Model  # its tree, merged; or with closed loops
    lines: tuple[tuple[int, ...], ...]  # (L,) branches, then lines that close loops: indices into the tables
    ends: Ints  # (L, 2) their buses, of a branch the one nearer to the busbar first
    place: Ints  # (Q, 2) bus of the feeder and phase of each place
    places: Places  # model of the readings
    laterals: tuple[Lateral, ...]  # single-phase laterals
    parts: tuple[Lateral, ...]  # laterals, and single-phase customers at buses of several phases

    def weight(self, bus: int, phases: str) -> Floats:
        """Weights (Q,) of a customer at a bus of the feeder."""
        at = self.place[:, 0] == bus
        if self.places.phase.max() > 0:
            at &= np.isin(self.place[:, 1], [PHASES.index(phase) for phase in phases])
        return np.asarray(at / at.sum())

    def reaches(self, bus: int, phases: str) -> bool:
        """True if a bus of the feeder has these phases."""
        if isinstance(self.feeder, ThreePhaseFeeder):
            return bool(all(self.feeder.phases[bus][PHASES.index(phase)] for phase in phases))
        return True


def site_of(path_or_name: Path | str) -> Site | ThreePhaseSite:
    """Load a feeder, balanced or in three phases, as `feeders.model.site.load`.

    Raises FeederInvalid as there, and for closed loops in three phases.
    """
    return _site(find(path_or_name))


def _site(tables: FeederTables) -> Site | ThreePhaseSite:
    if not tables.in_phases:
        return from_tables(tables)
    site, ties = spanned(tables)
    if ties.ends.size:
        text = (
            "lines: closed lines form loops; in three phases calibration requires a radial feeder: in a loop "
            "a longer line changes all phases everywhere, without a model of it"
        )
        raise FeederInvalid([Problem("not-radial", text)])
    return site


def network(tables: FeederTables) -> MergedNetwork:
    """Prepare a feeder for calibration; single-phase customers or zero-sequence impedances need three phases.

    Raises FeederInvalid with every problem of the files; if closed lines form loops in three phases.
    """
    site = _site(tables)
    feeder, rows = _merged(_model(site), tuple((row,) for row in line_rows(site)))
    single, parts = tuple[Lateral, ...](), tuple[Lateral, ...]()
    if isinstance(feeder, ThreePhaseFeeder):
        place = np.argwhere(feeder.phases)
        ends = np.column_stack([feeder.parent, np.arange(1, len(feeder.buses))])
        single = laterals(feeder, rows, place)
        parts = (*single, *alone(feeder, [row.phases for row in tables.customers], place))
    else:
        place = np.column_stack([np.arange(len(feeder.buses)), np.zeros(len(feeder.buses))]).astype(np.intp)
        ends = lines(feeder)[0]
    return MergedNetwork(site, feeder, rows, ends, place, _places(site, feeder, place), single, parts)


Model = Feeder | MeshedFeeder | ThreePhaseFeeder


def _model(site: Site | ThreePhaseSite) -> Model:
    """Feeder of a site, in three phases a tree."""
    if isinstance(site.feeder, MeshedFeeder):
        return site.feeder
    return site.tree if isinstance(site, Site) else site.feeder


def _merged(feeder: Model, rows: tuple[tuple[int, ...], ...]) -> tuple[Model, tuple[tuple[int, ...], ...]]:
    """Merge lines in series without customers between them, in large feeders without loops."""
    count = len(feeder.buses)
    if count <= MOST_BUSES or isinstance(feeder, MeshedFeeder):
        return feeder, rows
    children = np.bincount(feeder.parent, minlength=count)
    keep = children != 1
    keep[0] = True
    keep[feeder.bus] = True
    if isinstance(feeder, ThreePhaseFeeder):
        for k, above in enumerate(feeder.parent.tolist()):
            keep[above] |= bool((feeder.phases[k + 1] != feeder.phases[above]).any())
    new = np.cumsum(keep) - 1
    above_of, chain = np.zeros(count, dtype=np.intp), list[tuple[int, ...]]([()] * count)
    own = ("r", "x", "charging") if isinstance(feeder, Feeder) else ("z", "charging")
    impedances = {name: np.array(getattr(feeder, name)) for name in own}
    for k, above in enumerate(feeder.parent.tolist()):
        chain[k + 1] = rows[k]
        above_of[k + 1] = above
        if not keep[above]:
            chain[k + 1] = chain[above] + rows[k]
            above_of[k + 1] = above_of[above]
            for values in impedances.values():
                values[k] += values[above - 1]
    kept = np.flatnonzero(keep)
    change: dict[str, Any] = {name: values[kept[1:] - 1] for name, values in impedances.items()}
    change |= {"parent": new[above_of[kept[1:]]], "bus": new[feeder.bus]}
    change |= {"buses": tuple(feeder.buses[k] for k in kept)}
    if isinstance(feeder, ThreePhaseFeeder):
        change["phases"] = feeder.phases[kept]
    return replace(feeder, **change), tuple(chain[k] for k in kept[1:])


def _places(site: Site | ThreePhaseSite, feeder: Model, place: Ints) -> Places:
    bus, phase = place.T
    ids = tuple(map(str, range(bus.size)))
    weight = np.zeros((len(feeder.customers), bus.size))
    if isinstance(feeder, MeshedFeeder):
        Z = impedances(feeder, bus)
        active, reactive = 2.0 * Z.real, 2.0 * Z.imag
        weight[np.arange(feeder.bus.size), feeder.bus] = 1.0
    elif isinstance(feeder, Feeder):
        flow = replace(feeder, bus=bus, customers=ids).linear()
        active, reactive = 2.0 * flow.R, 2.0 * flow.X
        weight[np.arange(feeder.bus.size), feeder.bus] = 1.0
    else:
        everywhere = replace(feeder, bus=bus, customers=ids, connected=phase[:, None] == np.arange(3))
        flow3 = lindist3flow(everywhere)
        # Powers in units of the three-phase base rather than a third of it.
        active, reactive = 6.0 * flow3.R, 6.0 * flow3.X
        at = {(int(k), int(f)): q for q, (k, f) in enumerate(place)}
        where = [at[int(k), int(f)] for k, f in zip(feeder.at, feeder.phase, strict=True)]
        weight[feeder.of, where] = feeder.share
    buses = site.spanning.buses if isinstance(site, Site) else site.feeder.buses
    own = {name: k for k, name in enumerate(buses)}
    volt = site.base_volt.reshape(len(own), -1)[[own[feeder.buses[k]] for k in bus], phase]
    unit = site.customer_volt[site.meters]
    return Places(active, reactive, phase, _shares(feeder, bus), weight, site.meters, volt, unit)


def _shares(feeder: Model, bus: Ints) -> Floats | Phasors:
    """Share of each line's drop at each place, (Q, L): 1 behind a line and 0 elsewhere, or complex in loops.

    A longer line of impedance z from i to j is equivalent to a voltage source in it: bus k has ``(Z_kj -
    Z_ki) / z`` of its drop.
    """
    if isinstance(feeder, MeshedFeeder):
        (one, other), z = lines(feeder)[0].T, lines(feeder)[1]
        Z = impedances(feeder, np.arange(len(feeder.buses)))[bus]
        return np.asarray((Z[:, other] - Z[:, one]) / z)
    start = feeder.walk.start[bus][:, None]
    behind = (feeder.walk.start[1:] <= start) & (start < feeder.walk.stop[1:])
    return behind.astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class CustomerPowers:
    """Customers' powers by the readings and the files. T frames, N customers, pu.

    `p`, `q`, `load`, `roof`, `steep`, (T, N), are those of `gridsec.planning.calibration.Series`.
    """

    p: Floats
    q: Floats
    load: Floats
    roof: Floats
    steep: Floats
    metered_q: Bools  # (N,) customers with metered reactive power
    missing: Bools  # (T, N) interpolated powers of metered customers


def powers(site: Site | ThreePhaseSite, given: Frames) -> CustomerPowers:
    """Compute the powers of all customers.

    Without a reading of q it is that of the load, by the middle of the limits of its power factor, less the
    injection of the inverter's curve at the voltage read.
    """
    model, base, T = site.loads, site.feeder.base_kva, given.t.size
    N = model.load_peak.size
    order = [given.meter_ids.index(name) for name in site.meter_ids]
    draws = np.broadcast_to(IDLE * model.load_peak, (T, N)).copy()
    missing = np.zeros((T, N), dtype=np.bool_)
    metered_q = np.zeros(N, dtype=np.bool_)
    q_read, v = np.zeros((T, N)), np.tile(site.customer_volt, (T, 1))
    for j, customer in zip(order, site.meters.tolist(), strict=True):
        there = np.isfinite(given.p_kw[:, j])
        if there.any():
            draws[:, customer] = np.interp(given.t, given.t[there], given.p_kw[there, j]) / base
            missing[:, customer] = ~there
        there = np.isfinite(given.q_kvar[:, j])
        metered_q[customer] = 2 * there.sum() > T
        if metered_q[customer]:
            q_read[:, customer] = np.interp(given.t, given.t[there], given.q_kvar[there, j]) / base
        there = np.isfinite(given.v_volt[:, j])
        if there.any():
            v[:, customer] = np.interp(given.t, given.t[there], given.v_volt[there, j])
    v /= site.customer_volt
    low = np.maximum(draws, 0.0)
    tan = 0.5 * (model.tan_min + model.tan_max)
    roof = model.pv_peak * _sun(draws, model.pv_peak)[:, None]
    most = np.maximum(low, np.minimum(draws + model.pv_peak, model.load_peak))
    load = np.clip(draws + roof, low, most)
    q = tan * load
    steep = np.zeros((T, N))
    own = site.droop.customer
    if own.size:
        at = v[:, own]
        q[:, own] -= voltage_curve(site.droop, at)
        slope = voltage_curve(site.droop, at + STEEP_PU) - voltage_curve(site.droop, at - STEEP_PU)
        steep[:, own] = slope / (2.0 * STEEP_PU) / (2.0 * at)
    return CustomerPowers(
        p=-draws,
        q=-np.where(metered_q, q_read, q),
        load=np.where(metered_q, 0.0, load),
        roof=np.where(metered_q, 0.0, tan * (most - low)),
        steep=np.where(metered_q, 0.0, steep),
        metered_q=metered_q,
        missing=missing,
    )


def _sun(draws: Floats, pv_peak: Floats) -> Floats:
    """Generation relative to its peak, (T,): the largest feed-in of any roof beyond its load."""
    roofs = pv_peak > 0.0
    feeds = -draws[:, roofs] / pv_peak[roofs]
    return np.asarray(np.clip(feeds.max(axis=1, initial=0.0), 0.0, 1.0))


def series(net: MergedNetwork, given: Frames, drawn: CustomerPowers, excluded: Collection[str]) -> Series:
    """Readings and power flow of a feeder, without the voltages of the excluded meters."""
    site = net.site
    order = [given.meter_ids.index(name) for name in site.meter_ids]
    v = given.v_volt[:, order] / net.places.unit
    seen = np.isfinite(v) & ~np.isin(site.meter_ids, list(excluded))
    busbar = given.v0_volt
    if isinstance(net.feeder, ThreePhaseFeeder):
        # Unread phases are not used, and their effect on the others is of second order.
        busbar = np.where(np.isfinite(given.v0_phases), given.v0_phases, busbar[:, None])
    U, drop = _voltages(net, drawn.p, drawn.q, busbar / site.feeder.base_volt)
    bus, phase = net.place.T
    return Series(
        t=given.t,
        y=np.where(seen, v**2, 1.0),
        seen=seen,
        p=drawn.p,
        q=drawn.q,
        load=drawn.load,
        roof=drawn.roof,
        steep=drawn.steep,
        places=U[:, phase, bus],
        drop=drop,
    )


def _voltages(net: MergedNetwork, p: Floats, q: Floats, v0: Floats) -> tuple[Floats, Floats | Phasors]:
    """Squared voltages of all buses with their losses, (T, F, b + 1), and `Series.drop`, (T, F, L).

    The input is the busbar voltage (T,) or (T, 3).
    """
    feeder, (one, other) = net.feeder, net.ends.T
    if isinstance(feeder, MeshedFeeder):
        V = _phasors(feeder, p + 1j * q, v0)
        apart = V[:, one] - V[:, other]
        return (V.real**2 + V.imag**2)[:, None], (np.conj(V[:, one] + V[:, other]) * apart)[:, None]
    if isinstance(feeder, Feeder):
        U = feeder.bus_voltages(p, q, v0**2, steps=_STEPS)[:, None, :]
    else:
        parts = [slice(k, k + _CHUNK) for k in range(0, len(v0), _CHUNK)]
        # 1 pu of a phase's power is a third of the feeder's base.
        p3, q3 = (3.0 * feeder.connections(power) for power in (p, q))
        U = np.concatenate(
            [three.bus_voltages(feeder, p3[some], q3[some], v0[some] ** 2, steps=_STEPS) for some in parts]
        )
    return U, U[:, :, one] - U[:, :, other]


def _phasors(feeder: MeshedFeeder, s: Phasors, v0: Floats) -> Phasors:
    """Complex voltages of all buses, (T, b + 1); `Meshed.bus_voltages` has their squares."""
    idle = v0[:, None] * feeder.idle
    here = V = idle[:, feeder.bus]
    for _ in range(_ROUNDS):
        V = here + np.conj(s / V) @ feeder.transfer_between.T
    return np.asarray(idle + np.conj(s / V) @ feeder.transfer.T)


def doubts(
    net: MergedNetwork, drawn: CustomerPowers, tolerance: float, free: Collection[int], spread: float
) -> PriorUncertainty:
    """Prior standard deviations of the errors of the files, uniform within the stated limits.

    `tolerance` is the relative error of lengths that counts as correct, 1 sigma. The branches `free` have
    estimated lengths, with relative errors of the prior standard deviation `spread`.
    """
    site, model = net.site, net.site.loads
    without = np.ones(model.load_peak.size, dtype=np.bool_)
    without[site.meters] = False
    unmetered = ~drawn.metered_q
    length = np.full(len(net.lines), tolerance)
    length[list(free)] = spread
    half = 0.5 * (model.tan_max - model.tan_min)
    root = np.sqrt(3.0)
    return PriorUncertainty(
        bias=np.hypot(site.accuracy.class_fraction, site.accuracy.busbar_class) / root,
        p_gain=np.where(without, 0.0, model.p_fraction / root),
        q_gain=np.where(unmetered, 0.0, model.q_fraction / root),
        tan=np.where(unmetered, half / root, 0.0),
        roof=np.where(unmetered & (model.pv_peak > 0.0), HIDDEN, 0.0),
        p_level=np.where(without, IDLE * model.load_peak, 0.0),
        q_level=np.where(unmetered, model.q_floor / root, 0.0),
        length=length,
    )


def field(net: MergedNetwork, drawn: CustomerPowers) -> Field:
    """Effect of load errors at the meters."""
    site, model = net.site, net.site.loads
    A, B = net.places.at_meters
    metered = np.zeros(model.load_peak.size)
    metered[site.meters] = 1.0
    hidden_q = CLOUDS**2 * np.mean(drawn.roof**2, axis=0)
    hidden_p = np.where(metered > 0.0, 0.0, (IDLE * model.load_peak) ** 2)
    return Field(
        active=(A * metered) @ A.T,
        reactive=(B * metered) @ B.T,
        known=(A * hidden_p) @ A.T + (B * hidden_q) @ B.T,
    )


def meter_noise(net: MergedNetwork, given: Frames) -> tuple[Floats, Floats]:
    """Variances of the readings' own noise (T, p), squared pu^2, and effect of the busbar's, (T, p, F).

    Each phase of the busbar has a register of its own, and a place has the error of its own phase.
    """
    site, accuracy = net.site, net.site.accuracy
    order = [given.meter_ids.index(name) for name in site.meter_ids]
    own = 4.0 * (accuracy.jitter**2 + accuracy.resolution**2 / 12.0)
    busbar = 4.0 * (accuracy.busbar_jitter**2 + accuracy.busbar_resolution**2 / 12.0)
    count = np.maximum(given.count[:, order], 1.0)
    std = np.sqrt(busbar / np.maximum(given.count[:, -1], 1.0))
    return own / count, std[:, None, None] * net.places.of_phases


def gaps(net: MergedNetwork, drawn: CustomerPowers) -> list[Floats]:
    """Effect of interpolated powers in each frame, T times (p, g): their changes from frame to frame."""
    A, B = net.places.at_meters
    change_p, change_q = (np.diff(power, axis=0).std(axis=0) for power in (drawn.p, drawn.q))
    effect = A * change_p + B * np.where(drawn.metered_q, change_q, 0.0)
    return [effect[:, np.flatnonzero(row)] for row in drawn.missing]
