"""Voltage band for all loads within their limits, and hosting capacity of a droop fleet.

A band is proven by limits of the AC power flow with the fleet (`gridsec.planning.droop.equilibrium`), or
refuted by loads with which the AC power flow of `feeders.simulation.powerflow` leaves the band.

Hosting has generation at its peak and loads at a small share of theirs. Every operating point is an AC power
flow with the inverters in equilibrium.

References: chong2020, (13); docs/theory-studies.md, section on the droop fleet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from feeders.model.site import Site
from feeders.simulation.powerflow import PowerFlowDiverged
from feeders.studies.droop.fleets import KVA_PER_KW, made, point
from feeders.studies.droop.verdict import CLEARLY, Subject, judge
from feeders.studies.operating import Bases, line_rows
from feeders.studies.unobservable import customer_indices
from gridsec.arrays import Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.planning.droop.ac_sensitivity import (
    Complex,
    InjectionBox,
    PhasorNetwork,
    currents,
    sensitivity,
    solve,
)
from gridsec.planning.droop.equilibrium import Band, always, at_rest, injected, rest
from gridsec.planning.droop.stability import Update, growth, slopes

__all__ = [
    "BandGuarantee",
    "Conditions",
    "DroopPlan",
    "Safety",
    "capacity",
    "checked",
    "curve",
    "draw",
    "ratings_pu",
    "safety",
    "shares_of",
    "without_inverters",
]


EXACT: Final = 1e-6  # largest difference between set-points and a witness's injections, pu


class BandGuarantee(StrEnum):
    """Proof status of the band."""

    KEPT = "kept"
    VIOLATED = "violated"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class Safety:
    """Proof status of a fleet's voltages.

    `rows` has one row for each customer; `witness` too, with loads that violate the band, if found.
    """

    rest: BandGuarantee  # for load changes that are slow against the time constants
    always: BandGuarantee  # for arbitrary load changes within the limits
    why: str  # reason for missing bounds; empty with bounds
    low_volt: float  # extremes of the proven limits; NaN without any
    high_volt: float
    low_rest_volt: float
    high_rest_volt: float
    rows: list[dict[str, Any]]
    witness: list[dict[str, Any]]


def without_inverters(droop: Droop) -> Droop:
    """Fleet without inverters, for comparison."""
    return droop.take(np.zeros(0, dtype=np.intp))


def safety(subject: Subject, droop: Droop, loads: InjectionBox, limits: tuple[float, float]) -> Safety:
    """Prove or refute that no voltage leaves a band, relative to the nominal voltage.

    `loads` are the injections without the fleet; customers vary independently within them. The fleet starts
    from an equilibrium with any of these loads.
    """
    bases, reasons = Bases.of(subject.site), list[str]()
    within = bases.band(*limits)
    ever = _or_none(always, subject.net, droop, loads, reasons)
    still = _or_none(at_rest, subject.net, droop, loads, reasons)
    still = ever if still is None else still
    found = {
        name: None if _inside(band, within) else _witness(subject, droop, loads, within, jump=jump)
        for name, band, jump in (("rest", still, False), ("always", ever, True))
    }
    # A violation in equilibrium is also one for arbitrary changes.
    found["always"] = found["always"] or found["rest"]
    nothing = Band(*np.full((2, loads.p_low.size), np.nan))
    e, r = ever or nothing, still or nothing
    volt, names = bases.volt, subject.site.feeder.customers
    rows = [
        {
            "customer": names[k],
            "low_volt": float(volt[k] * e.low[k]),
            "high_volt": float(volt[k] * e.high[k]),
            "low_rest_volt": float(volt[k] * r.low[k]),
            "high_rest_volt": float(volt[k] * r.high[k]),
            "kept": bool(e.low[k] >= within[0][k] and e.high[k] <= within[1][k]),
            "kept_rest": bool(r.low[k] >= within[0][k] and r.high[k] <= within[1][k]),
        }
        for k in range(len(names))
    ]
    return Safety(
        rest=_verdict(still, within, found["rest"]),
        always=_verdict(ever, within, found["always"]),
        why="; ".join(dict.fromkeys(reasons)),
        low_volt=bases.extremes(e.low)[0],
        high_volt=bases.extremes(e.high)[1],
        low_rest_volt=bases.extremes(r.low)[0],
        high_rest_volt=bases.extremes(r.high)[1],
        rows=rows,
        witness=(found["rest"] or found["always"] or []),
    )


def _or_none(
    bound: Callable[[PhasorNetwork, Droop, InjectionBox], Band],
    net: PhasorNetwork,
    droop: Droop,
    loads: InjectionBox,
    reasons: list[str],
) -> Band | None:
    try:
        return bound(net, droop, loads)
    except DesignInfeasible as error:
        reasons.append(str(error))
        return None


Limits = tuple[Floats, Floats]  # band, pu of every customer


def _inside(band: Band | None, limits: Limits) -> bool:
    return band is not None and bool(np.all(band.low >= limits[0]) and np.all(band.high <= limits[1]))


def _verdict(band: Band | None, limits: Limits, witness: list[dict[str, Any]] | None) -> BandGuarantee:
    if _inside(band, limits):
        return BandGuarantee.KEPT
    return BandGuarantee.VIOLATED if witness else BandGuarantee.UNDECIDED


def _witness(
    subject: Subject, droop: Droop, loads: InjectionBox, limits: Limits, *, jump: bool
) -> list[dict[str, Any]] | None:
    """Loads in the box with a voltage outside the band, in equilibrium or after a jump of all loads."""
    s, v0 = _candidates(subject.net, droop, loads)
    x, V = rest(subject.net, droop, s, v0)
    if jump:
        # From the equilibrium at the other end of the box: pairs (low, high), (high, low).
        x = x[np.arange(len(x)) ^ 1]
        V = solve(subject.net, injected(droop, s, x), v0)
    beyond = np.max(np.maximum(limits[0] - np.abs(V), np.abs(V) - limits[1]), axis=1)
    order = np.argsort(-np.where(np.isfinite(beyond), beyond, -np.inf))
    for k in order[:3]:
        if beyond[k] > 0.0:
            rows = _confirmed(subject, droop, (s[k], float(v0[k]), x[k]), limits, jump=jump)
            if rows:
                return rows
    return None


def _candidates(net: PhasorNetwork, droop: Droop, loads: InjectionBox) -> tuple[Complex, Floats]:
    """Corners of the box in pairs (low, high): of all loads, and by the sensitivities of each voltage."""
    low, high = loads.p_low + 1j * loads.q_low, loads.p_high + 1j * loads.q_high
    middle: Complex = np.asarray(0.5 * (low + high))
    v0 = 0.5 * (loads.v0_low + loads.v0_high)
    x, V = rest(net, droop, middle, v0)
    corners = [low, high]
    if np.isfinite(V).all():
        at, own = sensitivity(net, injected(droop, middle, x), V), droop.customer
        D = slopes(droop, np.full(own.size, 0.0), np.full(own.size, 9.0))
        closed = np.eye(V.size)
        np.add.at(closed.T, own, (at.dv_dq[:, own] * D).T)
        J = np.linalg.solve(closed, np.hstack([at.v[:, None] * at.p.real, at.dv_dq]))
        for row in J:
            up_p, up_q = row[: V.size] >= 0.0, row[V.size :] >= 0.0
            corners.append(np.where(up_p, low.real, high.real) + 1j * np.where(up_q, low.imag, high.imag))
            corners.append(np.where(up_p, high.real, low.real) + 1j * np.where(up_q, high.imag, low.imag))
    return np.array(corners), np.tile([loads.v0_low, loads.v0_high], len(corners) // 2)


def _confirmed(
    subject: Subject,
    droop: Droop,
    at: tuple[Complex, float, Floats],
    limits: Limits,
    *,
    jump: bool,
) -> list[dict[str, Any]]:
    """Witness as rows, if the power flow of `feeders.simulation.powerflow` confirms it; otherwise none."""
    (s, v0, x), feeder = at, subject.site.feeder
    net = injected(droop, s, x)
    try:
        volts, _ = subject.flow.solve(
            -feeder.base_kva * net.real, -feeder.base_kva * net.imag, v0 * feeder.base_volt
        )
    except PowerFlowDiverged:
        return []
    v = volts / subject.site.customer_volt
    beyond = (v < limits[0]) | (v > limits[1])
    off = np.max(np.abs(voltage_curve(droop, v[droop.customer]) - x), initial=0.0)
    if not beyond.any() or (not jump and off > EXACT):
        return []
    return [
        {
            "when": "after a jump of all loads" if jump else "at rest",
            "customer": feeder.customers[k],
            "p_kw": -feeder.base_kva * float(s[k].real),
            "q_kvar": -feeder.base_kva * float(s[k].imag),
            "inverter_kvar": feeder.base_kva * float(net[k].imag - s[k].imag),
            "busbar_volt": v0 * feeder.base_volt,
            "v_volt": float(volts[k]),
            "beyond": bool(beyond[k]),
        }
        for k in range(v.size)
    ]


RESOLUTION: Final = 1e-3  # relative accuracy of a capacity
MOST: Final = 2.0**14  # upper limit of the search for a capacity, kW per possible customer


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions at the peak of generation."""

    load: float  # relative to its peak, the same for all, 1
    v0: float  # voltage of the busbar, pu
    v_min: float  # the band, relative to the nominal voltage
    v_max: float
    update: Update  # sampling of the inverters


@dataclass(frozen=True, slots=True, eq=False)
class DroopPlan:
    """Distribution of generation, and its inverters."""

    share: Floats  # (N,) share of the generation of each customer; sum 1
    preset: str  # of all inverters; empty: without reactive power


def shares_of(site: Site, customers: Sequence[str] | None) -> Floats:
    """Distribution of generation, (N,): equal among customers; by default as in the files, or equal.

    Raises ValueError for an unknown customer.
    """
    out = np.array([row.pv_kw for row in site.tables.customers])
    if customers is not None:
        out = np.zeros(out.size)
        out[customer_indices(site, customers)] = 1.0
    if not out.any():
        out = np.ones(out.size)
    return np.asarray(out / out.sum())


def ratings_pu(site: Site) -> Floats:
    """Largest current of every conductor of every line, pu, (L, k); infinity for an empty rating.

    Order and units are those of `gridsec.planning.droop.ac_sensitivity.currents`.
    """
    lines = [site.tables.lines[k] for k in line_rows(site)]
    amps = np.array([np.inf if line.rating_a is None else line.rating_a for line in lines])
    # An ideal transformer is at from_bus: the impedance is in the base of to_bus.
    behind = [site.bus_of_file[line.to_bus] for line in lines]
    volt = site.base_volt.reshape(len(site.spanning.buses), -1)[behind]
    return np.asarray(amps[:, None] * 3.0 * volt / (1000.0 * site.feeder.base_kva))


def _fleet(site: Site, plan: DroopPlan, kw: float) -> Droop:
    own = np.flatnonzero(plan.share > 0.0) if plan.preset and kw > 0.0 else np.zeros(0, dtype=np.intp)
    return made(site, own, plan.preset or "ieee1547-b", KVA_PER_KW * kw * plan.share[own])


def _loads(site: Site, plan: DroopPlan, kw: float, at: Conditions) -> InjectionBox:
    drawn = point(site, at.load, 0.0, at.v0)
    p = drawn.p_low + kw / site.feeder.base_kva * plan.share
    return InjectionBox(p, p, drawn.q_low, drawn.q_high, at.v0, at.v0)


def checked(subject: Subject, plan: DroopPlan, kw: float, at: Conditions, ratings: Floats) -> dict[str, Any]:
    """Effect of `kw` of generation: extreme voltages, fullest line, and first violated limit.

    `ratings` are those of `ratings_pu`. The keys are `v_low_volt`, `v_high_volt`, `line_percent`, `growth`
    and `broken`: empty, `no power flow`, `voltage high`, `voltage low`, `line ...` or `unstable`.
    """
    site, droop = subject.site, _fleet(subject.site, plan, kw)
    loads, bases = _loads(site, plan, kw, at), Bases.of(site)
    s = loads.p_low + 1j * loads.q_low
    x, V = rest(subject.net, droop, s, at.v0)
    if not np.isfinite(V).all():
        unknown = dict.fromkeys(("v_low_volt", "v_high_volt", "line_percent", "growth"), float("nan"))
        return unknown | {"broken": "no power flow"}
    net, own, v = injected(droop, s, x), droop.customer, np.abs(V)
    full = (currents(site.feeder, subject.net, net, V, at.v0) / ratings).max(axis=1)
    near = 1e-7
    steep = slopes(droop, v[own] - near, v[own] + near)
    J = sensitivity(subject.net, net, V).dv_dq[np.ix_(own, own)]
    grows = growth(J, steep, droop.tau, at.update)
    worst = int(np.argmax(full))
    lowest, highest = bases.band(at.v_min, at.v_max)
    broken = (
        "voltage high" * bool((v > highest).any())
        or "voltage low" * bool((v < lowest).any())
        or _named(site, worst) * bool(full[worst] > 1.0)
        or "unstable" * bool(grows > 1.0 + CLEARLY)
    )
    low_volt, high_volt = bases.extremes(v)
    return {
        "v_low_volt": low_volt,
        "v_high_volt": high_volt,
        "line_percent": 100.0 * float(full[worst]),
        "growth": grows,
        "broken": broken,
    }


def _named(site: Site, line: int) -> str:
    """Name of a line of `currents`."""
    tree = site.spanning
    if line < tree.parent.size:
        return f"line to {tree.buses[line + 1]}"
    one, other = site.ties[line - tree.parent.size]
    return f"line from {tree.buses[one]} to {tree.buses[other]}"


def _largest(holds: Callable[[float], bool], most: float) -> float:
    """Largest amount without a violation, relative accuracy RESOLUTION; 0 if the amount 0 has one."""
    if not holds(0.0):
        return 0.0
    if holds(most):
        return most
    low, high = 0.0, most
    first = 1.0
    while first < most and holds(first):
        low, first = first, 2.0 * first
    high = min(first, most)
    while high - low > RESOLUTION * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def capacity(subject: Subject, plan: DroopPlan, at: Conditions, *, seed: int = 0) -> dict[str, Any]:
    """Largest generation without a violation, by bisection; confirmed by the other power flow.

    The keys are `capacity_kw`, `limit` (the next violation), `verdict` and `proof` (stability of the fleet
    there), `v_high_volt`, `v_low_volt`, `line_percent`, and `confirmed_volt`: the largest difference of a
    voltage in the power flow of `feeders.simulation.powerflow`, V.
    """
    site, ratings = subject.site, ratings_pu(subject.site)
    most = MOST * max(1, int(np.count_nonzero(plan.share)))
    kw = _largest(lambda some: not checked(subject, plan, some, at, ratings)["broken"], most)
    here = checked(subject, plan, kw, at, ratings)
    beyond = checked(subject, plan, kw * (1.0 + 2.0 * RESOLUTION) + RESOLUTION, at, ratings)
    droop, loads = _fleet(site, plan, kw), _loads(site, plan, kw, at)
    told = judge(subject, droop, at.update, loads, seed=seed) if droop.tau.size else None
    return {
        "preset": plan.preset or "none",
        "capacity_kw": kw,
        "limit": here["broken"] or beyond["broken"],
        "verdict": str(told.verdict) if told else "",
        "proof": told.proof if told else "",
        **{name: here[name] for name in ("v_low_volt", "v_high_volt", "line_percent")},
        "confirmed_volt": _confirmed_hosting(subject, droop, loads),
    }


def _confirmed_hosting(subject: Subject, droop: Droop, loads: InjectionBox) -> float:
    """Largest difference between the two power flows, V; infinity if the second has no solution."""
    feeder, s = subject.site.feeder, loads.p_low + 1j * loads.q_low
    x, V = rest(subject.net, droop, s, loads.v0_low)
    net = -feeder.base_kva * injected(droop, s, x)
    try:
        volts, _ = subject.flow.solve(net.real, net.imag, feeder.base_volt * loads.v0_low)
    except PowerFlowDiverged:
        return float("inf")
    return float(np.max(np.abs(volts - subject.site.customer_volt * np.abs(V))))


def curve(
    subject: Subject, plan: DroopPlan, amounts: Sequence[float], at: Conditions
) -> list[dict[str, Any]]:
    """Effect of increasing generation, one row for each amount, kW."""
    ratings = ratings_pu(subject.site)
    return [
        {"preset": plan.preset or "none", "pv_kw": float(kw), **checked(subject, plan, kw, at, ratings)}
        for kw in amounts
    ]


def draw(  # noqa: PLR0917  # which feeder, which fleet, which order of places
    subject: Subject, preset: str, unit_kw: float, at: Conditions, seed: int, number: int
) -> dict[str, Any]:
    """Number of generation units that a feeder hosts at customers in a random order.

    Every customer gets one unit before any gets a second. The order depends on `seed` and `number` alone, so
    that all presets have the same ones.
    """
    count = len(subject.site.feeder.customers)
    order: Ints = np.random.default_rng([seed, number]).permutation(count)
    ratings = ratings_pu(subject.site)

    def plan(units: int) -> DroopPlan:
        has = np.full(count, units // count, dtype=np.float64)
        has[order[: units % count]] += 1.0
        return DroopPlan(has / max(units, 1), preset)

    def broken(units: int) -> str:
        return str(checked(subject, plan(units), unit_kw * units, at, ratings)["broken"])

    low, high = 0, 1
    if not broken(0):
        while high < MOST and not broken(high):
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if broken(middle) else (middle, high)
    return {
        "preset": preset or "none",
        "draw": number,
        "units": low,
        "capacity_kw": low * unit_kw,
        "limit": broken(low) if low == 0 and broken(0) else broken(high),
    }
