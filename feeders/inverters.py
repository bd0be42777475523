"""Droop inverters in closed loop with the full AC power flow.

    tau_i dx_i/dt = -x_i + K_i(v_i),   v from AC power flow with the injections x

The reactive set-point is taken as linear in time over a step of length h, which gives the implicit
exponential trapezoid

    x+ = e^(-h/tau) x + (1 - e^(-h/tau) - c) K(v) + c K(v+),   c = 1 - (1 - e^(-h/tau)) tau / h.

It is of second order for h << tau and turns into the quasi-static answer x+ = K(v+) for h >> tau, without a
limit on h for stability. A step and an equilibrium are the same problem, x = a + c K(v(x)), the latter with
a = 0 and c = 1; `ClosedLoop.settle` solves it, by plain iteration while that contracts and by Newton's
method with the feeder's measured sensitivities where it does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from feeders.powerflow import PowerFlow, PowerFlowDiverged
from feeders.powerflow_unbalanced import PlacesFlow
from feeders.variation import Demand
from gridsec.arrays import Floats
from gridsec.droop import Droop
from gridsec.errors import GridsecError

TOLERANCE_PU: Final = 1e-7
"""How far x may be from solving its equation, pu of the base power: 0.01 var of 100 kVA."""

MAX_ITERATIONS: Final = 200

CONTRACTS: Final = 0.3
"""Plain iteration goes on while the residual falls at least by this factor from one solve to the next."""

SMALLEST_SHARE: Final = 2.0**-7
"""A Newton step is not shortened below this share of itself."""

PROBE_PU: Final = 1e-3
"""Reactive power by which the sensitivities are measured, pu of the base power."""


class NoEquilibrium(GridsecError):
    """The inverters and the feeder found no common answer."""

    code = "not-converged"


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """What customers draw without their inverters' reactive power. N customers.

    Attributes
    ----------
    p_kw : (N,)
        Net active import, kW.
    q_kvar : (N,)
        Reactive import, kvar.
    v0_volt
        Busbar voltage, V; in three phases (3,).
    """

    p_kw: Floats
    q_kvar: Floats
    v0_volt: Floats | float


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """The feeder at one instant. N customers, b + 1 buses, m inverters.

    Attributes
    ----------
    x : (m,)
        Reactive injection of each inverter, pu.
    setpoint : (m,)
        What each inverter's curve asks for at this voltage, K(v), pu.
    v_volt : (N,)
        Voltage at each customer, V.
    v_bus_volt : (b + 1,)
        Voltage at each bus, V.
    """

    x: Floats
    setpoint: Floats
    v_volt: Floats
    v_bus_volt: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A point, by how much it misses x = kept + new K(v), and the largest entry of that, pu."""

    point: Point
    defect: Floats
    size: float


class ClosedLoop:
    """A feeder with its droop inverters.

    Parameters
    ----------
    flow
        AC power flow of the feeder.
    droop
        The inverters; their curves are evaluated here as piecewise linear functions of the voltage.
    base_kva, base_volt
        What 1 pu means for `droop`; the voltage as one number, or for each customer, (N,).
    """

    def __init__(
        self, flow: PowerFlow | PlacesFlow, droop: Droop, base_kva: float, base_volt: Floats | float
    ) -> None:
        self.flow = flow
        self.tau = droop.tau
        self.count = droop.tau.size
        self._base_kva = base_kva
        self._base_volt = np.broadcast_to(base_volt, flow.grid.customer_bus.shape)[droop.customer]
        self._customer = droop.customer
        self._owner = np.eye(flow.grid.customer_bus.size)[droop.customer]
        # One ramp between each pair of neighbouring breakpoints, (m, 3).
        self._low, self._high = droop.v[:, :-1], droop.v[:, 1:]
        self._start = droop.q[:, 0]
        width = self._high - self._low
        self._ramp = np.divide(np.diff(droop.q, axis=1), width, out=np.zeros_like(width), where=width > 0.0)
        self._sensitivity: Floats | None = None

    def reactive(self, q_kvar: Floats, x: Floats) -> Floats:
        """Net reactive import (…, N), kvar: the loads' q (…, N) minus what inverters inject, x (…, m)."""
        return q_kvar - self._base_kva * (x @ self._owner)

    def setpoint(self, v_volt: Floats) -> Floats:
        """K(v) of every inverter (…, m), pu, from the customers' voltages (…, N), V."""
        v = (v_volt[..., self._customer] / self._base_volt)[..., None]
        climbed: Floats = ((np.clip(v, self._low, self._high) - self._low) * self._ramp).sum(axis=-1)
        return self._start + climbed

    def point(self, loads: Loads, x: Floats) -> Point:
        """The feeder with given injections x, pu, whatever the inverters would like."""
        v_volt, v_bus_volt = self.flow.solve(loads.p_kw, self.reactive(loads.q_kvar, x), loads.v0_volt)
        return Point(x, self.setpoint(v_volt), v_volt, v_bus_volt)

    def held(self, demand: Demand, rows: slice, x: Floats) -> tuple[Floats, Floats, Floats]:
        """The feeder at many instants at once with given injections x (T, m), pu.

        Returns
        -------
        v_volt (T, N), v_bus_volt (T, b + 1)
            Voltages, V.
        setpoint (T, m)
            K(v), pu.
        """
        q = self.reactive(demand.q_kvar[rows], x)
        v_volt, v_bus_volt = self.flow.solve_batch(demand.p_kw[rows], q, demand.v0_volt[rows])
        return v_volt, v_bus_volt, self.setpoint(v_volt)

    def equilibrium(self, loads: Loads, start: Floats | None = None) -> Point:
        """The point where every inverter injects what its curve asks for: x = K(v(x)).

        Parameters
        ----------
        loads
            What the customers draw.
        start : (m,)
            Where to begin, pu; zero by default.
        """
        zero, one = np.zeros(self.count), np.ones(self.count)
        return self.settle(loads, zero, one, zero if start is None else start)

    def advance(self, loads: Loads, now: Point, before: Point | None, h: float) -> Point:
        """The feeder one step later.

        Parameters
        ----------
        loads
            What the customers draw at the end of the step.
        now
            The feeder at its beginning.
        before
            One equal step earlier, if known. Only helps to guess.
        h
            Length of the step, s, > 0.
        """
        decay, old, new = self.weights(h)
        kept = decay * now.x + old * now.setpoint
        ahead = now.setpoint if before is None else 2.0 * now.setpoint - before.setpoint
        return self.settle(loads, kept, new, kept + new * ahead)

    def weights(self, h: float) -> tuple[Floats, Floats, Floats]:
        """Weights of x, K(v) and K(v+) in a step of h seconds; each (m,), together 1."""
        decay = np.exp(-h / self.tau)
        new = 1.0 + np.expm1(-h / self.tau) * self.tau / h
        return decay, 1.0 - decay - new, new

    def settle(self, loads: Loads, kept: Floats, new: Floats, guess: Floats) -> Point:
        """Solve x = kept + new K(v(x)).

        Parameters
        ----------
        loads
            What the customers draw.
        kept, new : (m,)
            The coefficients: pu, and 1 between 0 and 1.
        guess : (m,)
            First x, pu.

        Raises
        ------
        NoEquilibrium
            When no x solves it within TOLERANCE_PU after MAX_ITERATIONS solves.
        PowerFlowDiverged
            When the feeder has no voltages at all for these loads.
        """
        here = self._trial(loads, kept, new, guess)
        for _ in range(MAX_ITERATIONS):
            if here.size <= TOLERANCE_PU:
                return here.point
            there = self._attempt(loads, kept, new, here.point.x + here.defect)
            if there is None or there.size > CONTRACTS * here.size:
                there = self._newton(loads, kept, new, here)
            here = there
        raise NoEquilibrium(
            f"inverters and feeder do not settle: {here.size:.2g} pu of reactive power are left over"
        )

    def _trial(self, loads: Loads, kept: Floats, new: Floats, x: Floats) -> _Trial:
        point = self.point(loads, x)
        defect = kept + new * point.setpoint - x
        return _Trial(point, defect, float(np.max(np.abs(defect), initial=0.0)))

    def _attempt(self, loads: Loads, kept: Floats, new: Floats, x: Floats) -> _Trial | None:
        """A trial that may overshoot to where the feeder has no voltages at all: then None."""
        try:
            return self._trial(loads, kept, new, x)
        except PowerFlowDiverged:
            return None

    def _newton(self, loads: Loads, kept: Floats, new: Floats, here: _Trial) -> _Trial:
        """One damped Newton step of `settle`; the curves' slopes are those at the present voltages."""
        if self._sensitivity is None:
            self._sensitivity = self._measure(loads, here.point)
        slope = new * self._slope(here.point.v_volt)
        step = np.linalg.solve(np.eye(self.count) - slope[:, None] * self._sensitivity, here.defect)
        share = 1.0
        while share > SMALLEST_SHARE:
            there = self._attempt(loads, kept, new, here.point.x + share * step)
            if there is not None and there.size < (1.0 - 0.1 * share) * here.size:
                return there
            share *= 0.5
        # The last resort moves all the same, so that a kink at which no step helps is left behind.
        return self._trial(loads, kept, new, here.point.x + share * step)

    def _slope(self, v_volt: Floats) -> Floats:
        """dK/dv of every inverter, 1, <= 0."""
        v = (v_volt[self._customer] / self._base_volt)[:, None]
        slope: Floats = np.where((v >= self._low) & (v < self._high), self._ramp, 0.0).sum(axis=1)
        return slope

    def _measure(self, loads: Loads, here: Point) -> Floats:
        """dv/dx between all inverters by AC power flow, 1, (m, m)."""
        probes = here.x + PROBE_PU * np.eye(self.count)
        q = self.reactive(loads.q_kvar, probes)
        p = np.broadcast_to(loads.p_kw, q.shape)
        v, _ = self.flow.solve_batch(p, q, np.repeat(np.asarray(loads.v0_volt)[None], self.count, axis=0))
        change = (v - here.v_volt)[:, self._customer]
        return (change / (PROBE_PU * self._base_volt)).T
