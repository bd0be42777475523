"""What is carried from tick to tick, and one tick as every pair of `unknown_input` sees it."""

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
    """Everything that is prepared offline. N customers, m inverters, p meters.

    Attributes
    ----------
    setting
        The feeder, and the numbers that decide.
    max_inverters
        How many inverters may be attacked at the same time, q_1 of yang2021.
    pairs
        The candidates.
    within : (c, c)
        Whether the first of two candidates suspects nobody whom the second does not.
    missing
        Pairs whose inverters voltages alone do not tell apart; they are tried as well.
    doubt
        How many may be attacked, and how far.
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
        """How many pairs are tried."""
        return len(self.pairs.meters)


@dataclass(frozen=True, slots=True, eq=False)
class UnknownInputState:
    """What is carried from frame to frame. m inverters, p meters.

    Attributes
    ----------
    t, began
        Time of the last frame that was used, and of the first one, s; of `init` before.
    tubes
        What is known of honest inverters; None before the first frame.
    contradicted
        Which pairs were contradicted lately; those named there are refuted.
    x : (m,)
        Estimated injections, wrong parts included, pu.
    v0_squared
        Last squared busbar voltage, pu; in three phases (3,).
    named, inverters : (p,), (m,)
        Meters and inverters named as manipulated.
    last
        The last estimate and verdict, for frames that cannot be used.
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
    """One tick as linear relations: who is suspected decides which intervals hold for inverters.

    Attributes
    ----------
    design, frame, inputs
        What watches, what came, and that cleaned.
    tubes
        What is known of honest inverters.
    v2, error : (N,)
        Squared voltages if no inverter injected, and how far they may be off, squared pu.
    rest : (N,)
        The part of that error that is nobody's load and not the busbar's.
    """

    design: UnknownInputDesign
    frame: Frame
    inputs: Inputs
    tubes: Tubes
    v2: Floats
    error: Floats
    rest: Floats

    def tube(self, meters: Bools) -> Tube:
        """Where honest inverters are if these meters lie.

        Parameters
        ----------
        meters : (p,)
            Who.
        """
        meter = self.design.setting.errors.meter_of
        believed = self.tubes.metered.copy()
        if meters.size:
            believed &= ~meters[meter]
        return self.tubes.driven.where(believed, self.tubes.free)

    def relation(self, meters: Bools) -> Relation:
        """The readings if these meters lie.

        Parameters
        ----------
        meters : (p,)
            Who.
        """
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
        """The readings of all but these meters.

        Parameters
        ----------
        meters : (p,)
            Who.
        """
        return believe(self.relation(meters), meters)

    def room(self, tube: Tube) -> Floats:
        """Largest wrong injection of each inverter; (m,).

        Parameters
        ----------
        tube
            Where honest ones are.
        """
        return self.design.doubt.reach + np.abs(tube.middle) + tube.half

    def trial(self, meters: Bools, inverters: Bools) -> Trial:
        """What a pair makes of the tick.

        Parameters
        ----------
        meters, inverters : (p,), (m,)
            Who is suspected.
        """
        return try_pair(self.believe(meters), inverters, self.room(self.tube(meters)))


# Readings are never more exact than this, pu.
_EXACT = 1e-9


def observe(design: UnknownInputDesign, state: UnknownInputState, frame: Frame) -> Tick:
    """Clean a frame, and move on what is known of honest inverters.

    Parameters
    ----------
    design, state
        What watches, and where it stands.
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
    """Squared voltages if no inverter injected (N,), their error (N,), and its part from the model (N,)."""
    now, plant = design.setting, design.setting.plant
    rest = inputs.now.base - now.errors.R2 @ frame.p_error - now.errors.X2 @ frame.q_error
    moved = np.zeros(rest.shape)
    if plant.loss_correction and state.x.size:
        moved = _with_inverters(design, state, frame, inputs)
    # The busbar moves all (of a phase) alike, and has an error of its own.
    busbar = by_place(plant.feeder, busbar_errors(plant, inputs.v0_squared, now.options.sigmas))
    rest = rest - busbar[plant.feeder.bus]
    rest = np.where(inputs.now.base < NO_VOLTAGE, np.maximum(rest, 0.0), NO_VOLTAGE)
    error = np.minimum(inputs.now.base + moved, NO_VOLTAGE)
    return plant.droop.vbar**2 - inputs.w, error, rest + moved


def _with_inverters(
    design: UnknownInputDesign, state: UnknownInputState, frame: Frame, inputs: Inputs
) -> Floats:
    """How far the loss correction moves with what inverters may inject, honest or not; (N,)."""
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
    # Losses depend on what inverters inject: all at either end, one beyond.
    ends = np.vstack([droop.limit, -droop.limit, state.x + np.diag(reach), state.x - np.diag(reach)])
    customers = np.zeros((droop.customer.size, frame.q.size))
    customers[np.arange(droop.customer.size), droop.customer] = 1.0
    with np.errstate(all="ignore"):
        found = loss_correction(feeder, frame.p, frame.q + ends @ customers, inputs.v0_squared, steps=steps)
    far_off = np.nan_to_num(np.abs(found - inputs.correction), nan=NO_VOLTAGE, posinf=NO_VOLTAGE)
    moved = far_off[:2].max(axis=0) + max(design.max_inverters, 1) * far_off[2:].max(axis=0)
    return np.asarray(moved[feeder.bus])


def _seen(design: UnknownInputDesign, inputs: Inputs, believed: Bools, v2: Floats, error: Floats) -> Seen:
    """The inverters' places. A named meter's word would go on to mislead after it was cleared."""
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
