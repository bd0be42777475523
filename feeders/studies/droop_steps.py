"""A droop fleet's answer to steps, by full AC power flow: does it settle, how soon, and past what.

The inverters are those of `gridsec.studies.droop_stability`: sampled, with dead time. Continuous filters are
simulated with intervals of a small part of their time constants. The power flow is that of
`feeders.powerflow`, which shares nothing with the proofs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd

from feeders.powerflow import PowerFlow, PowerFlowDiverged
from feeders.powerflow_unbalanced import PlacesFlow
from feeders.studies.bases import Bases
from feeders.studies.droop_fleets import point
from gridsec.arrays import Floats
from gridsec.droop import Droop, voltage_curve
from gridsec.studies.droop_network import Box
from gridsec.studies.droop_stability import Update

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["Outcome", "Run", "Step", "simulate", "step_rows", "steps", "trajectories"]

FINE: Final = 40.0
"""Continuous filters are simulated with so many intervals in the shortest time constant / (1 + gain)."""

SETTLED: Final = 1e-6
"""Injections that move by less than this part of the largest limit within a window have settled."""

DECAYS: Final = 0.9
"""A movement that is not smaller than this part of what it was a window before does not die out."""

BAND: Final = 0.02
"""Voltages have settled when they stay this near to their end, as a part of the largest change."""

LEAST_PU: Final = 1e-5
"""Changes of voltages below this are none, pu."""


class Outcome(StrEnum):
    """What became of a simulated fleet."""

    SETTLES = "settles"
    OSCILLATES = "oscillates"
    COLLAPSES = "collapses"
    OPEN = "open"


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A sudden change of loads, generation or busbar. From rest before it.

    Attributes
    ----------
    before, after
        Operating points without the inverters' reactive power.
    """

    before: Box
    after: Box


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One simulated step. T + 1 instants.

    Attributes
    ----------
    outcome
        How it ended.
    t : (T + 1,)
        Time, s; the step comes at 0.
    v : (T + 1, N)
        Voltages of the customers, pu; the first row is right after the step, before any inverter has moved.
    x : (T + 1, m)
        Reactive injections, pu.
    """

    outcome: Outcome
    t: Floats
    v: Floats
    x: Floats


def steps(site: Site, v0: float = 1.0, *, tap: float = 0.025) -> dict[str, Step]:
    """The steps that are looked at.

    Load: from 0.2 to 0.8 of the peak, no generation. Cloud: generation from its peak to 0.2 of it, at 0.2
    of the load. Tap: the busbar up by one tap, at the same load and full generation.

    Parameters
    ----------
    site
        The feeder.
    v0
        Voltage of the busbar, pu.
    tap
        Height of a tap, pu.
    """
    noon = point(site, 0.2, 1.0, v0)
    return {
        "load": Step(point(site, 0.2, 0.0, v0), point(site, 0.8, 0.0, v0)),
        "cloud": Step(noon, point(site, 0.2, 0.2, v0)),
        "tap": Step(noon, replace(noon, v0_low=v0 + tap, v0_high=v0 + tap)),
    }


def simulate(
    plant: tuple[Site, PowerFlow | PlacesFlow],
    droop: Droop,
    update: Update,
    loads: Box,
    x: Floats,
    *,
    gain: float = 0.0,
    updates: int = 400,
) -> Run:
    """Let the inverters act on the AC power flow with constant loads, until they rest or time is up.

    Parameters
    ----------
    plant
        The feeder, and its AC power flow.
    droop, update
        The fleet, and when it acts.
    loads
        Operating point, a box without width.
    x : (m,)
        Injections at the beginning, and what the inverters last asked for, pu.
    gain
        Gain of the loop at rest; only continuous filters need it, for the interval.
    updates
        How many updates at most.
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
    outcome = Outcome.OPEN
    still = SETTLED * max(float(np.max(droop.limit, initial=0.0)), 1e-12)
    window = max(16, updates // 8)
    for k in range(updates + 1):
        try:
            q = loads.q_low + x @ owner
            v = flow.solve(-base_kva * loads.p_low, -base_kva * q, v0_volt)[0] / base_volt
        except PowerFlowDiverged:
            outcome = Outcome.COLLAPSES
            break
        vs.append(v)
        if k == updates or (k >= window and _moved(xs[-window:]) <= still):
            break
        asked.append(voltage_curve(droop, v[own]))
        x = (1.0 - alpha) * x + alpha * asked.pop(0)
        xs.append(x)
    if outcome is Outcome.OPEN:
        outcome = _told(xs, window, still)
    xs = xs[: len(vs)]
    t = update.interval_s * np.arange(len(vs), dtype=np.float64)
    return Run(outcome, t, np.array(vs), np.array(xs))


def _moved(xs: list[Floats]) -> float:
    return float(np.max(np.ptp(np.array(xs), axis=0), initial=0.0))


def _told(xs: list[Floats], window: int, still: float) -> Outcome:
    """What the last two windows say."""
    late, before = _moved(xs[-window:]), _moved(xs[-2 * window : -window])
    if late <= still:
        return Outcome.SETTLES
    return Outcome.OSCILLATES if late >= DECAYS * before else Outcome.OPEN


def step_rows(site: Site, runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """Settling time, overshoot and extreme voltages of steps, one row each.

    Parameters
    ----------
    site
        The feeder.
    runs
        By name.
    """
    rows: list[dict[str, Any]] = []
    bases = Bases.of(site)
    for name, run in runs.items():
        row: dict[str, Any] = {"step": name, "outcome": str(run.outcome)}
        if not len(run.v):
            rows.append(row)
            continue
        v = bases.ratio * run.v  # parts of the nominal voltage
        end = v[-1] if run.outcome is not Outcome.OSCILLATES else v[len(v) // 2 :].mean(axis=0)
        change = end - v[0]
        most = int(np.argmax(np.abs(change)))
        size = float(np.abs(change[most]))
        away = np.max(np.abs(v - end), axis=1, initial=0.0)
        late = np.flatnonzero(away > max(BAND * size, LEAST_PU))
        past = np.max((v - end) * np.sign(change), initial=0.0)
        low, high = bases.extremes(end / bases.ratio)
        settles = run.outcome is Outcome.SETTLES
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


def trajectories(site: Site, runs: Mapping[str, Run]) -> pd.DataFrame:
    """Voltages and reactive power over time, for plots: one row for each step, instant and customer.

    Parameters
    ----------
    site, runs
        As in `step_rows`.
    """
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
