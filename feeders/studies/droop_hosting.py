"""How much generation a feeder hosts before a voltage, a line or the stability of its droop fleet is broken.

Generation runs at its peak while loads draw a small share of theirs. Every operating point is an AC power
flow with the inverters at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from feeders.powerflow import PowerFlowDiverged
from feeders.studies.bases import Bases, line_rows
from feeders.studies.droop_fleets import KVA_PER_KW, made, point
from feeders.studies.droop_verdict import CLEARLY, Subject, judge
from feeders.studies.hidden import customer_indices
from gridsec.arrays import Floats, Ints
from gridsec.droop import Droop
from gridsec.studies.droop_network import Box, currents, sensitivity
from gridsec.studies.droop_rest import injected, rest
from gridsec.studies.droop_stability import Update, growth, slopes

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["Conditions", "Plan", "capacity", "checked", "curve", "draw", "ratings_pu", "shares_of"]

RESOLUTION: Final = 1e-3
"""Relative accuracy of a capacity."""

MOST: Final = 2.0**14
"""Largest capacity that is looked for, kW for each customer who may have generation."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """When generation is at its peak.

    Attributes
    ----------
    load
        Share of its peak that every load draws.
    v0
        Voltage of the busbar, pu.
    v_min, v_max
        The band, parts of the nominal voltage.
    update
        When inverters act.
    """

    load: float
    v0: float
    v_min: float
    v_max: float
    update: Update


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Who gets generation, and what inverters they have.

    Attributes
    ----------
    share : (N,)
        Every customer's part of the generation; together 1.
    preset
        Droop preset of all of them; empty: inverters without reactive power.
    """

    share: Floats
    preset: str


def shares_of(site: Site, customers: Sequence[str] | None) -> Floats:
    """How generation is distributed: as in the feeder's files, or equally among customers, (N,).

    Parameters
    ----------
    site
        The feeder.
    customers
        Who gets it; by default those who have some, in proportion, or everybody if nobody has.

    Raises
    ------
    ValueError
        If there is no such customer.
    """
    out = np.array([row.pv_kw for row in site.tables.customers])
    if customers is not None:
        out = np.zeros(out.size)
        out[customer_indices(site, customers)] = 1.0
    if not out.any():
        out = np.ones(out.size)
    return np.asarray(out / out.sum())


def ratings_pu(site: Site) -> Floats:
    """Largest current of every conductor of every line, pu; infinity where the files give none, (L, k).

    In the order and the units of `gridsec.studies.droop_network.currents`.
    """
    lines = [site.tables.lines[k] for k in line_rows(site)]
    amps = np.array([np.inf if line.rating_a is None else line.rating_a for line in lines])
    # An ideal transformer is at from_bus: the impedance is in the base of to_bus.
    behind = [site.bus_of_file[line.to_bus] for line in lines]
    volt = site.base_volt.reshape(len(site.spanning.buses), -1)[behind]
    return np.asarray(amps[:, None] * 3.0 * volt / (1000.0 * site.feeder.base_kva))


def _fleet(site: Site, plan: Plan, kw: float) -> Droop:
    own = np.flatnonzero(plan.share > 0.0) if plan.preset and kw > 0.0 else np.zeros(0, dtype=np.intp)
    return made(site, own, plan.preset or "ieee1547-b", KVA_PER_KW * kw * plan.share[own])


def _loads(site: Site, plan: Plan, kw: float, at: Conditions) -> Box:
    drawn = point(site, at.load, 0.0, at.v0)
    p = drawn.p_low + kw / site.feeder.base_kva * plan.share
    return Box(p, p, drawn.q_low, drawn.q_high, at.v0, at.v0)


def checked(subject: Subject, plan: Plan, kw: float, at: Conditions, ratings: Floats) -> dict[str, Any]:
    """What so much generation does: extreme voltages, the fullest line, and what is broken.

    Parameters
    ----------
    subject
        The feeder.
    plan
        Who gets it.
    kw
        All of it, kW.
    at
        Loads, busbar, limits.
    ratings : (L, k)
        From `ratings_pu`.

    Returns
    -------
    dict
        `v_low_volt`, `v_high_volt`, `line_percent`, `growth` and `broken`: empty, `no power flow`, `voltage
        high`, `voltage low`, `line ...` or `unstable`.
    """
    site, droop = subject.site, _fleet(subject.site, plan, kw)
    loads, bases = _loads(site, plan, kw, at), Bases.of(site)
    s = loads.p_low + 1j * loads.q_low
    x, V = rest(subject.net, droop, s, at.v0)
    if not np.isfinite(V).all():
        nan = float("nan")
        return {
            "v_low_volt": nan,
            "v_high_volt": nan,
            "line_percent": nan,
            "growth": nan,
            "broken": "no power flow",
        }
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
    """A line of `currents` in words."""
    tree = site.spanning
    if line < tree.parent.size:
        return f"line to {tree.buses[line + 1]}"
    one, other = site.ties[line - tree.parent.size]
    return f"line from {tree.buses[one]} to {tree.buses[other]}"


def _largest(holds: Callable[[float], bool], most: float) -> float:
    """The largest amount found at which nothing is broken, to a thousandth; 0 if something is without any."""
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


def capacity(subject: Subject, plan: Plan, at: Conditions, *, seed: int = 0) -> dict[str, Any]:
    """The most generation before something is broken, by bisection; confirmed by the other power flow.

    Parameters
    ----------
    subject, plan, at
        As in `checked`.
    seed
        As in `judge`.

    Returns
    -------
    dict
        `capacity_kw`, `limit` (what breaks next), `verdict` and `proof` (is the fleet stable there?),
        `v_high_volt`, `v_low_volt`, `line_percent`, and `confirmed`: the largest difference of a voltage in
        the power flow of `feeders.powerflow`, V.
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
        "confirmed_volt": _confirmed(subject, droop, loads),
    }


def _confirmed(subject: Subject, droop: Droop, loads: Box) -> float:
    """Largest difference between the two power flows, V; infinity where the second finds none."""
    feeder, s = subject.site.feeder, loads.p_low + 1j * loads.q_low
    x, V = rest(subject.net, droop, s, loads.v0_low)
    net = -feeder.base_kva * injected(droop, s, x)
    try:
        volts, _ = subject.flow.solve(net.real, net.imag, feeder.base_volt * loads.v0_low)
    except PowerFlowDiverged:
        return float("inf")
    return float(np.max(np.abs(volts - subject.site.customer_volt * np.abs(V))))


def curve(subject: Subject, plan: Plan, amounts: Sequence[float], at: Conditions) -> list[dict[str, Any]]:
    """What growing generation does, one row for each amount.

    Parameters
    ----------
    subject, plan, at
        As in `checked`.
    amounts
        Of all generation, kW.
    """
    ratings = ratings_pu(subject.site)
    return [
        {"preset": plan.preset or "none", "pv_kw": float(kw), **checked(subject, plan, kw, at, ratings)}
        for kw in amounts
    ]


def draw(  # noqa: PLR0917  # which feeder, which fleet, which order of places
    subject: Subject, preset: str, unit_kw: float, at: Conditions, seed: int, number: int
) -> dict[str, Any]:
    """How many units of generation a feeder hosts that come to its customers in a random order.

    Every customer gets one before anybody gets a second. The order is that of `seed` and `number` alone, so
    that all presets see the same ones.

    Parameters
    ----------
    subject, at
        As in `checked`.
    preset
        As in `Plan`.
    unit_kw
        Size of a unit, kW.
    seed, number
        Choose the order.
    """
    count = len(subject.site.feeder.customers)
    order: Ints = np.random.default_rng([seed, number]).permutation(count)
    ratings = ratings_pu(subject.site)

    def plan(units: int) -> Plan:
        has = np.full(count, units // count, dtype=np.float64)
        has[order[: units % count]] += 1.0
        return Plan(has / max(units, 1), preset)

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
