"""Is every customer's voltage within the band, whatever loads do within their limits: chong2020 (13).

Proven by limits of the AC power flow with the fleet (`gridsec.studies.droop_rest`), or refuted by loads with
which the AC power flow of `feeders.powerflow` leaves the band.

References
----------
chong2020, (13); docs/theory-studies.md, section on the droop fleet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from feeders.powerflow import PowerFlowDiverged
from feeders.studies.bases import Bases
from feeders.studies.droop_verdict import Subject
from gridsec.arrays import Floats
from gridsec.droop import Droop, voltage_curve
from gridsec.errors import DesignInfeasible
from gridsec.studies.droop_network import Box, Complex, Network, sensitivity, solve
from gridsec.studies.droop_rest import Band, always, at_rest, injected, rest
from gridsec.studies.droop_stability import slopes

__all__ = ["Kept", "Safety", "nobody", "safety"]

EXACT: Final = 1e-6
"""How far set-points by the second power flow may be from the injections of a witness, pu."""


class Kept(StrEnum):
    """What is known of the band."""

    KEPT = "kept"
    VIOLATED = "violated"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True)
class Safety:
    """What is known of a fleet's voltages.

    Attributes
    ----------
    rest
        While loads move slowly against the time constants.
    always
        At all times, however loads move within their limits.
    why
        What kept the bounds from being found; empty if they were.
    low_volt, high_volt, low_rest_volt, high_rest_volt
        The extremes of the proven limits, V; NaN if there are none.
    rows
        One for each customer.
    witness
        One for each customer: the loads that break the band, if such were found.
    """

    rest: Kept
    always: Kept
    why: str
    low_volt: float
    high_volt: float
    low_rest_volt: float
    high_rest_volt: float
    rows: list[dict[str, Any]]
    witness: list[dict[str, Any]]


def nobody(droop: Droop) -> Droop:
    """A fleet without inverters, to compare with."""
    return droop.take(np.zeros(0, dtype=np.intp))


def safety(subject: Subject, droop: Droop, loads: Box, limits: tuple[float, float]) -> Safety:
    """Prove or refute that no voltage leaves a band.

    Parameters
    ----------
    subject
        The feeder.
    droop
        The fleet, from rest with any loads of the box.
    loads
        Limits of the injections without the fleet; every customer moves in them as it likes.
    limits
        The band, parts of the nominal voltage.
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
    # What happens at rest happens.
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
    bound: Callable[[Network, Droop, Box], Band], net: Network, droop: Droop, loads: Box, reasons: list[str]
) -> Band | None:
    try:
        return bound(net, droop, loads)
    except DesignInfeasible as error:
        reasons.append(str(error))
        return None


Limits = tuple[Floats, Floats]
"""The band, pu of every customer."""


def _inside(band: Band | None, limits: Limits) -> bool:
    return band is not None and bool(np.all(band.low >= limits[0]) and np.all(band.high <= limits[1]))


def _verdict(band: Band | None, limits: Limits, witness: list[dict[str, Any]] | None) -> Kept:
    if _inside(band, limits):
        return Kept.KEPT
    return Kept.VIOLATED if witness else Kept.UNDECIDED


def _witness(
    subject: Subject, droop: Droop, loads: Box, limits: Limits, *, jump: bool
) -> list[dict[str, Any]] | None:
    """Loads in the box with which a voltage is beyond the band, at rest or after a jump of all loads."""
    s, v0 = _candidates(subject.net, droop, loads)
    x, V = rest(subject.net, droop, s, v0)
    if jump:
        # From rest at the other end of the box: pairs (low, high), (high, low).
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


def _candidates(net: Network, droop: Droop, loads: Box) -> tuple[Complex, Floats]:
    """Corners of the box in pairs (low, high): of all loads, and what one customer's voltage asks for."""
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
    """The witness as rows, if the power flow of `feeders.powerflow` agrees; none otherwise."""
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
