"""Design and state of `unknown_input`, and one tick in the form used by every pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.families.pairs import Believed, Pairs, Relation, Trial, Unseen, believe, try_pair
from gridsec.families.tubes import Doubt, Seen, Tube, Tubes, advance
from gridsec.feeder import Feeder
from gridsec.frames import NO_VOLTAGE, Inputs, Past, busbar_errors, clean
from gridsec.judge import Tally
from gridsec.network import by_place, hangs_on, interval_bounds, loss_correction
from gridsec.online import Estimate, Frame, Verdict
from gridsec.plant import Setting


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputDesign:
    """Design of the unknown-input estimator. N customers, m inverters, p meters.

    Attributes
    ----------
    max_inverters
        Largest number of simultaneously attacked inverters, q_1 of yang2021.
    pairs
        The candidates.
    within : (c, c)
        True if the suspects of the first candidate are a subset of those of the second.
    missing
        Pairs with inverters that voltages alone do not distinguish; they are tried as well.
    doubt
        Assumed number and size of attacks.
    gain : (N, m)
        2X from inverters to all customers.
    """

    setting: Setting
    max_inverters: int
    pairs: Pairs
    within: Bools
    missing: tuple[Unseen, ...]
    doubt: Doubt
    gain: Floats

    @property
    def observers(self) -> int:
        """Number of pairs."""
        return len(self.pairs.meters)


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputState:
    """State between frames. m inverters, p meters.

    Attributes
    ----------
    t, began
        Time of the last used frame, and of the first one, s; that of `init` before.
    tubes
        Intervals of unmanipulated inverters; None before the first frame.
    contradicted
        Counters of contradictions of each pair; pairs named there are refuted.
    x : (m,)
        Estimated injections including attacks, pu.
    v0_squared
        Last squared busbar voltage, pu; in three phases (3,).
    named, inverters : (p,), (m,)
        Meters and inverters named as manipulated.
    last
        Last estimate and verdict, returned for unusable frames.
    """

    t: float
    began: float
    tubes: Tubes | None
    contradicted: Tally
    x: Floats
    v0_squared: Floats | float
    named: Bools
    inverters: Bools
    last: tuple[Estimate, Verdict] | None


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """One tick as linear relations; the suspected meters determine the intervals of inverters.

    Attributes
    ----------
    design, frame, inputs
        Design, received frame, and prepared frame.
    tubes
        Intervals of unmanipulated inverters.
    v2, error : (N,)
        Squared voltages without injections of inverters, and their error, squared pu.
    rest : (N,)
        The part of that error from neither loads nor busbar.
    """

    design: UnknownInputDesign
    frame: Frame
    inputs: Inputs
    tubes: Tubes
    v2: Floats
    error: Floats
    rest: Floats

    def tube(self, meters: Bools) -> Tube:
        """Intervals of unmanipulated inverters if the meters in the mask (p,) are manipulated."""
        meter = self.design.setting.errors.meter_of
        believed = self.tubes.metered.copy()
        if meters.size:
            believed &= ~meters[meter]
        return self.tubes.driven.where(believed, self.tubes.free)

    def relation(self, meters: Bools) -> Relation:
        """Relation of the readings if the meters in the mask (p,) are manipulated."""
        now, frame, inputs = self.design.setting, self.frame, self.inputs
        plant, tube = now.plant, self.tube(meters)
        live = np.flatnonzero(inputs.live)
        told = live[np.isfinite(frame.q_net[plant.meters[live]])]
        at, of = plant.meters[live], plant.meters[told]
        own = (of[:, None] == plant.droop.customer).astype(np.float64)
        gain = self.design.gain[at]
        net = (np.arange(frame.q.size) == of[:, None]).astype(np.float64)
        v, q, v0 = at.size, of.size, hangs_on(plant.feeder)[at]
        E = np.block(
            [
                [
                    2.0 * now.model.R[at],
                    2.0 * now.model.X[at],
                    gain,
                    np.eye(v),
                    np.zeros((v, q)),
                    v0,
                ],
                [
                    np.zeros((q, frame.p.size)),
                    net,
                    own,
                    np.zeros((q, v)),
                    np.eye(q),
                    np.zeros((q, v0.shape[1])),
                ],
            ]
        )
        busbar = np.atleast_1d(busbar_errors(plant, inputs.v0_squared, now.options.sigmas))
        half = np.concatenate(
            [
                frame.p_error,
                frame.q_error,
                tube.half,
                inputs.now.reading[live] + self.rest[at],
                frame.q_net_error[of],
                np.minimum(busbar, NO_VOLTAGE),
            ]
        )
        readings = slice(half.size - busbar.size - v - q, half.size - busbar.size)
        half[readings] = np.maximum(half[readings], _EXACT)
        r = np.concatenate(
            [
                inputs.y[live] - self.v2[at] - gain @ tube.middle,
                frame.q_net[of] - frame.q[of] - own @ tube.middle,
            ]
        )
        voltage = np.arange(v + q) < v
        return Relation(r, np.vstack([gain, own]), E, half, np.concatenate([live, told]), voltage)

    def believe(self, meters: Bools) -> Believed:
        """Readings of all meters outside the mask (p,)."""
        return believe(self.relation(meters), meters)

    def room(self, tube: Tube) -> Floats:
        """Largest wrong injection of each inverter (m,), for unmanipulated ones within `tube`."""
        return self.design.doubt.reach + np.abs(tube.middle) + tube.half

    def trial(self, meters: Bools, inverters: Bools) -> Trial:
        """Result of the pair of suspected meters (p,) and inverters (m,) for the tick."""
        return try_pair(self.believe(meters), inverters, self.room(self.tube(meters)))


# Smallest error of a reading, pu.
_EXACT = 1e-9


def observe(design: UnknownInputDesign, state: UnknownInputState, frame: Frame) -> Tick:
    """Prepare a frame, and advance the intervals of unmanipulated inverters.

    Parameters
    ----------
    frame
        Later than the last one.
    """
    inputs = clean(design.setting, Past(state.x, state.v0_squared, state.named), frame)
    h = 0.0 if state.tubes is None else frame.t - state.t
    v2, error, rest = _without_inverters(design, state, frame, inputs)
    seen = _seen(design, inputs, inputs.live & ~state.named, v2, error)
    tubes = advance(design.setting.errors, design.doubt, state.tubes, seen, h)
    return Tick(design, frame, inputs, tubes, v2, error, rest)


def _without_inverters(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame, inputs: Inputs
) -> tuple[Floats, Floats, Floats]:
    """Squared voltages (N,) without injections of inverters, their error, and its part from the model."""
    now, plant = design.setting, design.setting.plant
    rest = inputs.now.base - now.errors.R2 @ frame.p_error - now.errors.X2 @ frame.q_error
    moved = np.zeros(rest.shape)
    if plant.loss_correction and state.x.size:
        moved = _with_inverters(design, state, frame, inputs)
    # The busbar shifts all places (of a phase) alike, and has an error of its own.
    busbar = by_place(plant.feeder, busbar_errors(plant, inputs.v0_squared, now.options.sigmas))
    rest = rest - busbar[plant.feeder.bus]
    rest = np.where(inputs.now.base < NO_VOLTAGE, np.maximum(rest, 0.0), NO_VOLTAGE)
    error = np.minimum(inputs.now.base + moved, NO_VOLTAGE)
    return plant.droop.vbar**2 - inputs.w, error, rest + moved


def _with_inverters(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame, inputs: Inputs
) -> Floats:
    """Largest change of the loss correction by possible injections, attacked or not; (N,)."""
    plant, reach = design.setting.plant, design.doubt.reach
    feeder, droop, steps = plant.feeder, plant.droop, plant.loss_correction
    if not isinstance(feeder, Feeder):
        count_ = frame.q.size
        q = frame.q + droop.per_customer(state.x, count_)
        room = droop.per_customer(reach + np.abs(state.x), count_)
        far = interval_bounds(
            feeder, frame.p, q, inputs.v0_squared, p_error=frame.p_error, q_error=frame.q_error + room
        )
        return np.minimum(far[0] + 3.0 * far[1], NO_VOLTAGE)
    # Losses depend on the injections of inverters: all at either end, one beyond.
    ends = np.vstack([droop.limit, -droop.limit, state.x + np.diag(reach), state.x - np.diag(reach)])
    customers = np.zeros((droop.customer.size, frame.q.size))
    customers[np.arange(droop.customer.size), droop.customer] = 1.0
    with np.errstate(all="ignore"):
        found = loss_correction(feeder, frame.p, frame.q + ends @ customers, inputs.v0_squared, steps=steps)
    far_off = np.nan_to_num(np.abs(found - inputs.correction), nan=NO_VOLTAGE, posinf=NO_VOLTAGE)
    moved = far_off[:2].max(axis=0) + max(design.max_inverters, 1) * far_off[2:].max(axis=0)
    return np.asarray(moved[feeder.bus])


def _seen(design: UnknownInputDesign, inputs: Inputs, believed: Bools, v2: Floats, error: Floats) -> Seen:
    """Tick at the inverters' places; readings of named meters would mislead even after their clearance."""
    now, own = design.setting, design.setting.plant.droop.customer
    meter = now.errors.meter_of
    if not inputs.live.size:
        nothing = np.zeros(own.size)
        metered = np.zeros(own.size, dtype=np.bool_)
        return Seen(nothing, nothing, metered, now.plant.droop.vbar**2 - v2[own], error[own])
    return Seen(
        z=inputs.z[meter],
        z_error=inputs.now.reading[meter],
        metered=(meter >= 0) & believed[meter],
        rest=now.plant.droop.vbar**2 - v2[own],
        rest_error=error[own],
    )
