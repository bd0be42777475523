"""Stable, unstable or undecided: what is proven of a fleet at an operating point, and its margins.

References
----------
docs/theory-studies.md, section on the droop fleet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from feeders.powerflow import PowerFlow
from feeders.powerflow_unbalanced import PlacesFlow, power_flow
from feeders.studies.droop_fleets import inverter_names
from feeders.studies.droop_steps import Outcome, simulate
from gridsec.arrays import Floats
from gridsec.droop import Droop
from gridsec.errors import DesignInfeasible, FeederInvalid
from gridsec.network import InPhases
from gridsec.studies.droop_network import Box, Network, network, sensitivity
from gridsec.studies.droop_rest import Share, injected, rest, shares, shares_of_gain
from gridsec.studies.droop_stability import Loop, Update, growth, loop, proof, reach, slopes, steepened

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = [
    "Judgement",
    "Subject",
    "Verdict",
    "edge",
    "inverter_rows",
    "judge",
    "longest_interval",
    "margin",
    "worst",
]

KICK: Final = 1e-3
"""Largest deviation from rest from which an unstable fleet is simulated, part of each limit."""

CLEARLY: Final = 1e-4
"""Growth in one update must be beyond 1 by this before a fleet counts as unstable."""

_AWAY: Final = 80
"""Updates in which a fleet that grows is simulated."""

MOST: Final = 1024.0
"""Slopes grow up to this factor."""

PLACES: Final = 4
"""How often an interval of factor 2 is halved: factors are found to 4 %."""


class Verdict(StrEnum):
    """What is known of a fleet."""

    STABLE = "stable"
    UNSTABLE = "unstable"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """A feeder whose fleets are judged: its power flow twice, for simulation and for proofs.

    Attributes
    ----------
    site
        The feeder.
    flow
        AC power flow for simulation.
    net
        AC power flow for proofs.
    """

    site: Site
    flow: PowerFlow | PlacesFlow
    net: Network

    @classmethod
    def of(cls, site: Site) -> Subject:
        """Both power flows of a feeder."""
        return cls(site, power_flow(site), network(site.feeder))


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is proven of a fleet with given loads.

    Attributes
    ----------
    verdict
        STABLE: from every state the fleet comes to the same rest. UNSTABLE: rest is unstable, and the
        simulation moves away from it for good. UNDECIDED: neither is proven.
    proof
        The certificate, as in `gridsec.studies.droop_stability.Proof`.
    gain
        Largest gain of the loop at rest within reach, 1; NaN if nothing can be said of what is within reach.
    growth
        Factor by which a small deviation from rest grows in one update; NaN for loads in a box, or no rest.
    outcome
        What the simulation of an unstable fleet did after a small deviation from rest.
    why
        Why nothing is proven.
    """

    verdict: Verdict
    proof: str
    gain: float
    growth: float
    outcome: str = ""
    why: str = ""


def judge(subject: Subject, droop: Droop, update: Update, loads: Box, *, seed: int = 0) -> Judgement:
    """Judge a fleet with constant loads, somewhere in a box or at a point.

    Parameters
    ----------
    subject
        The feeder.
    droop, update
        The fleet, and when it acts.
    loads
        Injections without it.
    seed
        Chooses the deviation from rest that is simulated.
    """
    given, why = _loop(subject.net, droop, update, loads)
    gain = math.nan if given is None else given.gain
    pointlike = _pointlike(loads)
    steady = _linearised(subject.net, droop, update, loads) if pointlike else None
    grows = (math.nan, math.nan) if steady is None else steady[1]
    if given is not None:
        found = proof(given)
        if found.kind:
            return Judgement(Verdict.STABLE, found.kind, gain, grows[1])
        why = f"the loop gain may be {gain:.3g}, and the certificates end at {found.factor:.3g} of it"
    if not pointlike:
        return Judgement(Verdict.UNDECIDED, "", gain, math.nan, why=why)
    if steady is None:
        return Judgement(Verdict.UNDECIDED, "", gain, math.nan, why=f"{why}; no equilibrium was found")
    if grows[0] > 1.0 + CLEARLY:
        x, plant = _kicked(droop, steady[0], seed), (subject.site, subject.flow)
        run = simulate(plant, droop, update, loads, x, gain=0.0 if math.isnan(gain) else gain, updates=_AWAY)
        if run.outcome in {Outcome.OSCILLATES, Outcome.COLLAPSES}:
            return Judgement(Verdict.UNSTABLE, "", gain, grows[0], str(run.outcome))
        why += f"; rest is unstable, but the simulation {run.outcome}"
    return Judgement(Verdict.UNDECIDED, "", gain, grows[1], why=why)


def _pointlike(loads: Box) -> bool:
    ends = ((loads.p_low, loads.p_high), (loads.q_low, loads.q_high), (loads.v0_low, loads.v0_high))
    return all(np.array_equal(low, high) for low, high in ends)


def _loop(net: Network, droop: Droop, update: Update, loads: Box) -> tuple[Loop | None, str]:
    try:
        return loop(droop, reach(net, droop, loads), update), ""
    except DesignInfeasible as error:
        return None, str(error)


def _linearised(
    net: Network, droop: Droop, update: Update, loads: Box
) -> tuple[Floats, tuple[float, float]] | None:
    """Injections at rest; least and largest growth around it, which differ only on breakpoints."""
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
    """A small deviation from rest, in every direction."""
    kick = KICK * np.random.default_rng(seed).choice([-1.0, 1.0], x.size) * droop.limit
    return np.asarray(np.clip(x + kick, droop.q[:, 3], droop.q[:, 0]))


# --- margins --------------------------------------------------------------------------------------------


def edge(
    subject: Subject,
    droop: Droop,
    update: Update,
    loads: Box,
    change: Callable[[Droop, float], Droop] = steepened,
) -> tuple[float, float]:
    """Between which factors on all slopes a fleet ceases to be stable, by doubling and bisection.

    Parameters
    ----------
    subject, droop, update
        As in `judge`.
    loads
        An operating point.
    change
        How slopes grow: `steepened` with the same limits, or `enlarged` with the same breakpoints.

    Returns
    -------
    tuple
        The largest factor found with which the fleet is proven to be stable, 0 if none; the smallest found
        with which its rest is unstable, infinity if none up to 1024.
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
    # Up to there nothing grows: what is proven need not be looked at again.
    unstable = _last(lambda times: times <= certified or not grows(times), PLACES)
    return certified, math.inf if unstable >= MOST else unstable * 2.0 ** (0.5**PLACES)


def _last(holds: Callable[[float], bool], places: int) -> float:
    """The largest factor found at which something holds, 0 if it does not even at a quarter."""
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


def longest_interval(subject: Subject, droop: Droop, update: Update, loads: Box) -> float:
    """The longest sampling interval found with which the fleet is proven to be stable, s.

    Infinity: the certificate covers every interval. The time constants may be shorter in the same ratio.

    Parameters
    ----------
    subject, droop, update, loads
        As in `judge`.
    """
    try:
        within = reach(subject.net, droop, loads)
    except DesignInfeasible:
        return 0.0
    longest = float(np.max(droop.tau, initial=0.0))

    def proven(interval: float) -> bool:
        return bool(proof(loop(droop, within, replace(update, interval_s=interval))).kind)

    jumping = loop(droop, within, replace(update, interval_s=50.0 * longest))
    # e^-50 is nothing: as if inverters jumped to their set-points.
    if proof(jumping).kind and jumping.covers_shorter:
        return math.inf
    start = update.interval_s or 1e-3 * float(np.min(droop.tau))
    return start * _last(lambda times: proven(start * times), 5)


def inverter_rows(
    subject: Subject, droop: Droop, update: Update, loads: Box, where: str
) -> list[dict[str, Any]]:
    """Who contributes how much to the loop gain, and how much steeper each alone may be.

    Parameters
    ----------
    subject, droop, update, loads
        As in `judge`.
    where
        Name of the operating point.
    """
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
    """By the modes of a loop of reactances in common; in three phases by its gain without regard to sign."""
    limit = proof(given).factor
    if not isinstance(site.feeder, InPhases):
        return shares(given, limit * float(np.linalg.norm(0.5 * (given.S + given.S.T), 2)))
    own = shares_of_gain(given)
    # What all may do together, one may do alone.
    return replace(own, factor=np.fmax(own.factor, limit if limit >= 1.0 else math.nan))


def margin(subject: Subject, droop: Droop, update: Update, loads: Box) -> float:
    """Factor on the steepest slopes up to which all curves with the same limits are proven to be stable.

    Parameters
    ----------
    subject, droop, update, loads
        As in `judge`.

    Returns
    -------
    float
        0 if nothing can be said of all that such curves can do.
    """
    try:
        within = reach(subject.net, droop, loads, rounds=0)
    except DesignInfeasible:
        return 0.0
    size = within.region.low.size
    wide = replace(within.region, low=np.zeros(size), high=np.full(size, np.inf))
    return proof(loop(droop, replace(within, region=wide), update)).factor


def worst(verdicts: Iterable[str]) -> Verdict:
    """One verdict of several: unstable if one is, stable if all are.

    Parameters
    ----------
    verdicts
        At least one.
    """
    known = set(verdicts)
    if Verdict.UNSTABLE in known:
        return Verdict.UNSTABLE
    return Verdict.STABLE if known == {Verdict.STABLE} else Verdict.UNDECIDED
