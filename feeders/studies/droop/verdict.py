"""Stability of a droop fleet at an operating point: proofs, margins, step responses.

The inverters are those of `gridsec.planning.droop.stability`: sampled, with dead time. Continuous filters are
simulated at intervals of a small part of their time constants. The power flow is that of
`feeders.simulation.powerflow`, which is independent of the proofs.

References: docs/theory-studies.md, section on the droop fleet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

import numpy as np
import pandas as pd

from feeders.model.site import Site
from feeders.simulation.powerflow import PlacesFlow, PowerFlow, PowerFlowDiverged, power_flow
from feeders.studies.droop.fleets import inverter_names, point
from feeders.studies.operating import Bases
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, FeederInvalid
from gridsec.grid.devices import Droop, voltage_curve
from gridsec.planning.droop.ac_sensitivity import InjectionBox, PhasorNetwork, network, sensitivity
from gridsec.planning.droop.equilibrium import Share, injected, rest, shares, shares_of_gain
from gridsec.planning.droop.stability import Loop, Update, growth, loop, proof, reach, slopes, steepened

__all__ = [
    "FleetOutcome",
    "FleetVerdict",
    "StepResponse",
    "Subject",
    "edge",
    "inverter_rows",
    "judge",
    "longest_interval",
    "margin",
    "simulate",
    "step_rows",
    "steps",
    "trajectories",
    "worst",
]


FINE: Final = 40.0  # simulation intervals in the shortest time constant / (1 + gain)
SETTLED: Final = 1e-6  # largest movement within a window, relative to the largest limit
DECAYS: Final = 0.9  # smallest ratio of movements in successive windows that do not decay
BAND: Final = 0.02  # largest distance of settled voltages from the final one, relative to the change
LEAST_PU: Final = 1e-5  # voltage change that counts as zero, pu


class FleetOutcome(StrEnum):
    """Outcome of a simulation of a fleet."""

    SETTLES = "settles"
    OSCILLATES = "oscillates"
    COLLAPSES = "collapses"
    OPEN = "open"


@dataclass(frozen=True, slots=True, eq=False)
class StepChange:
    """Sudden change of loads, generation or busbar, from an equilibrium.

    Both are operating points without the inverters' reactive power.
    """

    before: InjectionBox
    after: InjectionBox


@dataclass(frozen=True, slots=True, eq=False)
class StepResponse:
    """One simulated step. T + 1 instants."""

    outcome: FleetOutcome
    t: Floats  # (T + 1,) s; the step is at 0
    v: Floats  # (T + 1, N) voltages of the customers, pu; the first row just after the step
    x: Floats  # (T + 1, m) reactive injections, pu


def steps(site: Site, v0: float = 1.0, *, tap: float = 0.025) -> dict[str, StepChange]:
    """Steps of the study, at a busbar voltage `v0`, pu.

    Load: from 0.2 to 0.8 of the peak, no generation. Cloud: generation from its peak to 0.2 of it, at 0.2 of
    the load. Tap: the busbar up by `tap`, pu, at the same load and full generation.
    """
    noon = point(site, 0.2, 1.0, v0)
    return {
        "load": StepChange(point(site, 0.2, 0.0, v0), point(site, 0.8, 0.0, v0)),
        "cloud": StepChange(noon, point(site, 0.2, 0.2, v0)),
        "tap": StepChange(noon, replace(noon, v0_low=v0 + tap, v0_high=v0 + tap)),
    }


def simulate(
    plant: tuple[Site, PowerFlow | PlacesFlow],
    droop: Droop,
    update: Update,
    loads: InjectionBox,
    x: Floats,
    *,
    gain: float = 0.0,
    updates: int = 400,
) -> StepResponse:
    """Simulate the inverters on the AC power flow with constant loads, until equilibrium or `updates`.

    `x`, (m,), are the initial injections and last set-points, pu. `gain` is that of the loop in equilibrium;
    it determines the interval of continuous filters only.
    """
    site, flow = plant
    base_kva, own = site.feeder.base_kva, droop.customer
    base_volt, v0_volt = site.customer_volt, site.feeder.base_volt * loads.v0_low
    owner = np.equal.outer(own, np.arange(loads.p_low.size)).astype(np.float64)
    if not update.interval_s:
        update = Update(float(np.min(droop.tau)) / FINE / (1.0 + gain))
    alpha = update.share(droop.tau)
    asked = [x] * update.dead
    xs: list[Floats] = [x]
    vs: list[Floats] = []
    outcome = FleetOutcome.OPEN
    still = SETTLED * max(float(np.max(droop.limit, initial=0.0)), 1e-12)
    window = max(16, updates // 8)
    for k in range(updates + 1):
        try:
            q = loads.q_low + x @ owner
            v = flow.solve(-base_kva * loads.p_low, -base_kva * q, v0_volt)[0] / base_volt
        except PowerFlowDiverged:
            outcome = FleetOutcome.COLLAPSES
            break
        vs.append(v)
        if k == updates or (k >= window and _moved(xs[-window:]) <= still):
            break
        asked.append(voltage_curve(droop, v[own]))
        x = (1.0 - alpha) * x + alpha * asked.pop(0)
        xs.append(x)
    if outcome is FleetOutcome.OPEN:
        outcome = _told(xs, window, still)
    xs = xs[: len(vs)]
    t = update.interval_s * np.arange(len(vs), dtype=np.float64)
    return StepResponse(outcome, t, np.array(vs), np.array(xs))


def _moved(xs: list[Floats]) -> float:
    return float(np.max(np.ptp(np.array(xs), axis=0), initial=0.0))


def _told(xs: list[Floats], window: int, still: float) -> FleetOutcome:
    """Outcome by the last two windows."""
    late, before = _moved(xs[-window:]), _moved(xs[-2 * window : -window])
    if late <= still:
        return FleetOutcome.SETTLES
    return FleetOutcome.OSCILLATES if late >= DECAYS * before else FleetOutcome.OPEN


def step_rows(site: Site, runs: Mapping[str, StepResponse]) -> list[dict[str, Any]]:
    """Settling time, overshoot and extreme voltages of steps, one row each."""
    rows: list[dict[str, Any]] = []
    bases = Bases.of(site)
    for name, run in runs.items():
        row: dict[str, Any] = {"step": name, "outcome": str(run.outcome)}
        if not len(run.v):
            rows.append(row)
            continue
        v = bases.ratio * run.v  # relative to the nominal voltage
        end = v[-1] if run.outcome is not FleetOutcome.OSCILLATES else v[len(v) // 2 :].mean(axis=0)
        change = end - v[0]
        most = int(np.argmax(np.abs(change)))
        size = float(np.abs(change[most]))
        away = np.max(np.abs(v - end), axis=1, initial=0.0)
        late = np.flatnonzero(away > max(BAND * size, LEAST_PU))
        past = np.max((v - end) * np.sign(change), initial=0.0)
        low, high = bases.extremes(end / bases.ratio)
        settles = run.outcome is FleetOutcome.SETTLES
        row |= {
            "settling_s": (float(run.t[late[-1] + 1]) if late.size else 0.0) if settles else math.nan,
            "overshoot_percent": 100.0 * float(past) / size if size > LEAST_PU else 0.0,
            "change_volt": size * float(bases.nominal[most]),
            "end_low_volt": low,
            "end_high_volt": high,
            "worst_customer": site.feeder.customers[int(np.argmax(np.abs(end - 1.0)))],
        }
        rows.append(row)
    return rows


def trajectories(site: Site, runs: Mapping[str, StepResponse]) -> pd.DataFrame:
    """Voltages over time, for plots: one row for each step, instant and customer."""
    parts = []
    for name, run in runs.items():
        instants, customers = run.v.shape
        parts.append(
            pd.DataFrame(
                {
                    "step": name,
                    "t_s": np.repeat(run.t, customers),
                    "customer": list(site.feeder.customers) * instants,
                    "v_volt": (site.customer_volt * run.v).ravel(),
                }
            )
        )
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


KICK: Final = 1e-3  # largest deviation from equilibrium in simulations, relative to each limit
CLEARLY: Final = 1e-4  # smallest growth per update beyond 1 of an unstable fleet
_AWAY: Final = 80  # number of updates in simulations of an unstable fleet
MOST: Final = 1024.0  # largest factor on slopes
PLACES: Final = 4  # number of bisections of an interval of factor 2: factors have an accuracy of 4 %


class FleetVerdict(StrEnum):
    """Stability of a fleet."""

    STABLE = "stable"
    UNSTABLE = "unstable"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """Feeder of the study, with one AC power flow for simulations and one for proofs."""

    site: Site
    flow: PowerFlow | PlacesFlow
    net: PhasorNetwork

    @classmethod
    def of(cls, site: Site) -> Subject:
        """Both power flows of a feeder."""
        return cls(site, power_flow(site), network(site.feeder))


@dataclass(frozen=True, slots=True)
class Judgement:
    """Stability of a fleet with given loads."""

    # STABLE: the fleet converges from every state to the same equilibrium. UNSTABLE: the equilibrium is
    # unstable, and the simulation moves away from it permanently. UNDECIDED: neither is proven.
    verdict: FleetVerdict
    proof: str  # the certificate, as in `gridsec.planning.droop.stability.Proof`
    gain: float  # largest gain of the loop within the reachable voltages, 1; NaN without bounds of these
    # growth factor of a small deviation from equilibrium in one update; NaN for a box of loads, or without an
    # equilibrium
    growth: float
    # outcome of the simulation of an unstable fleet after a small deviation from equilibrium
    outcome: str = ""
    why: str = ""  # reason for a missing proof


def judge(subject: Subject, droop: Droop, update: Update, loads: InjectionBox, *, seed: int = 0) -> Judgement:
    """Determine the stability of a fleet with constant loads, anywhere in a box or at a point.

    `loads` are the injections without the fleet; `seed` is that of the simulated deviation from equilibrium.
    """
    given, why = _loop(subject.net, droop, update, loads)
    gain = math.nan if given is None else given.gain
    pointlike = _pointlike(loads)
    steady = _linearised(subject.net, droop, update, loads) if pointlike else None
    grows = (math.nan, math.nan) if steady is None else steady[1]
    if given is not None:
        found = proof(given)
        if found.kind:
            return Judgement(FleetVerdict.STABLE, found.kind, gain, grows[1])
        why = f"the loop gain may be {gain:.3g}; the certificates are valid up to {found.factor:.3g} of it"
    if not pointlike:
        return Judgement(FleetVerdict.UNDECIDED, "", gain, math.nan, why=why)
    if steady is None:
        return Judgement(FleetVerdict.UNDECIDED, "", gain, math.nan, why=f"{why}; no equilibrium found")
    if grows[0] > 1.0 + CLEARLY:
        x, plant = _kicked(droop, steady[0], seed), (subject.site, subject.flow)
        run = simulate(plant, droop, update, loads, x, gain=0.0 if math.isnan(gain) else gain, updates=_AWAY)
        if run.outcome in {FleetOutcome.OSCILLATES, FleetOutcome.COLLAPSES}:
            return Judgement(FleetVerdict.UNSTABLE, "", gain, grows[0], str(run.outcome))
        why += f"; the equilibrium is unstable, but the simulation: {run.outcome}"
    return Judgement(FleetVerdict.UNDECIDED, "", gain, grows[1], why=why)


def _pointlike(loads: InjectionBox) -> bool:
    ends = ((loads.p_low, loads.p_high), (loads.q_low, loads.q_high), (loads.v0_low, loads.v0_high))
    return all(np.array_equal(low, high) for low, high in ends)


def _loop(net: PhasorNetwork, droop: Droop, update: Update, loads: InjectionBox) -> tuple[Loop | None, str]:
    try:
        return loop(droop, reach(net, droop, loads), update), ""
    except DesignInfeasible as error:
        return None, str(error)


def _linearised(
    net: PhasorNetwork, droop: Droop, update: Update, loads: InjectionBox
) -> tuple[Floats, tuple[float, float]] | None:
    """Injections in equilibrium, and least and largest growth around it, which differ only on breakpoints."""
    s, own = loads.p_low + 1j * loads.q_low, droop.customer
    x, V = rest(net, droop, s, loads.v0_low)
    if not np.isfinite(x).all():
        return None
    J = sensitivity(net, injected(droop, s, x), V).dv_dq[np.ix_(own, own)]
    v, near = np.abs(V[own]), 1e-7
    below, above = slopes(droop, v - 2.0 * near, v - near), slopes(droop, v + near, v + 2.0 * near)
    both = [growth(J, some(below, above), droop.tau, update) for some in (np.minimum, np.maximum)]
    return x, (min(both), max(both))


def _kicked(droop: Droop, x: Floats, seed: int) -> Floats:
    """Small deviation from equilibrium, in every direction."""
    kick = KICK * np.random.default_rng(seed).choice([-1.0, 1.0], x.size) * droop.limit
    return np.asarray(np.clip(x + kick, droop.q[:, 3], droop.q[:, 0]))


# --- margins --------------------------------------------------------------------------------------------


def edge(
    subject: Subject,
    droop: Droop,
    update: Update,
    loads: InjectionBox,
    change: Callable[[Droop, float], Droop] = steepened,
) -> tuple[float, float]:
    """Factors on all slopes at which a fleet ceases to be stable, by doubling and bisection.

    `change` makes the slopes `steepened` with the same limits, or `enlarged` with the same breakpoints.

    Returns tuple: the largest factor found with a proof of stability, 0 without one; the smallest found with
        an unstable equilibrium, infinity if none up to 1024.
    """

    def proven(times: float) -> bool:
        try:
            given, _ = _loop(subject.net, change(droop, times), update, loads)
        except FeederInvalid:
            return False
        return given is not None and bool(proof(given).kind)

    def grows(times: float) -> bool:
        steady = _linearised(subject.net, change(droop, times), update, loads)
        return steady is not None and steady[1][0] > 1.0 + CLEARLY

    certified = _last(proven, PLACES)
    # Deviations do not grow up to the certified factor: no second test is needed there.
    unstable = _last(lambda times: times <= certified or not grows(times), PLACES)
    return certified, math.inf if unstable >= MOST else unstable * 2.0 ** (0.5**PLACES)


def _last(holds: Callable[[float], bool], places: int) -> float:
    """Largest factor found with the property, 0 without it at a quarter."""
    times = 1.0
    while times >= 0.25 and not holds(times):
        times *= 0.5
    if times < 0.25:
        return 0.0
    while times < MOST and holds(2.0 * times):
        times *= 2.0
    if times >= MOST:
        return times
    step = 2.0
    for _ in range(places):
        step = math.sqrt(step)
        if holds(step * times):
            times *= step
    return times


def longest_interval(subject: Subject, droop: Droop, update: Update, loads: InjectionBox) -> float:
    """Longest sampling interval found with a proof of stability, s.

    Infinity: the certificate covers every interval. The time constants may be shorter in the same ratio.
    """
    try:
        within = reach(subject.net, droop, loads)
    except DesignInfeasible:
        return 0.0
    longest = float(np.max(droop.tau, initial=0.0))

    def proven(interval: float) -> bool:
        return bool(proof(loop(droop, within, replace(update, interval_s=interval))).kind)

    jumping = loop(droop, within, replace(update, interval_s=50.0 * longest))
    # e^-50 is negligible: inverters jump to their set-points.
    if proof(jumping).kind and jumping.covers_shorter:
        return math.inf
    start = update.interval_s or 1e-3 * float(np.min(droop.tau))
    return start * _last(lambda times: proven(start * times), 5)


def inverter_rows(
    subject: Subject, droop: Droop, update: Update, loads: InjectionBox, where: str
) -> list[dict[str, Any]]:
    """Share of each inverter in the loop gain, and admissible factor on its slope alone."""
    given, _ = _loop(subject.net, droop, update, loads)
    if given is None:
        return []
    own = _shares(subject.site, given)
    names = inverter_names(subject.site, droop, given.rows)
    order = np.argsort(-own.part)
    return [
        {
            "point": where,
            "customer": names[k],
            "limit_kvar": float(droop.limit[given.rows[k]]) * subject.site.feeder.base_kva,
            "part": float(own.part[k]),
            "alone": float(own.factor[k]),
        }
        for k in order
    ]


def _shares(site: Site, given: Loop) -> Share:
    """Shares by common modes of the loop of reactances; in three phases by absolute values of its gain."""
    limit = proof(given).factor
    if site.feeder.busbar_phases == 1:
        return shares(given, limit * float(np.linalg.norm(0.5 * (given.S + given.S.T), 2)))
    own = shares_of_gain(given)
    # A factor that is admissible for all is admissible for one.
    return replace(own, factor=np.fmax(own.factor, limit if limit >= 1.0 else math.nan))


def margin(subject: Subject, droop: Droop, update: Update, loads: InjectionBox) -> float:
    """Factor on the steepest slopes up to which all curves with the same limits are proven stable, or 0."""
    try:
        within = reach(subject.net, droop, loads, rounds=0)
    except DesignInfeasible:
        return 0.0
    size = within.region.low.size
    wide = replace(within.region, low=np.zeros(size), high=np.full(size, np.inf))
    return proof(loop(droop, replace(within, region=wide), update)).factor


def worst(verdicts: Iterable[str]) -> FleetVerdict:
    """Combined verdict: unstable if one is, stable if all are."""
    known = set(verdicts)
    if FleetVerdict.UNSTABLE in known:
        return FleetVerdict.UNSTABLE
    return FleetVerdict.STABLE if known == {FleetVerdict.STABLE} else FleetVerdict.UNDECIDED
