"""One frame made fit for the observers: no NaN gets past here, and every error has a size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec import detect
from gridsec.arrays import Bools, Floats
from gridsec.detect import Uncertainty
from gridsec.feeder import corrected, loss_correction
from gridsec.lure import known_input
from gridsec.network import by_place
from gridsec.online import Cause, Decision, Estimate, Frame, Verdict
from gridsec.plant import Plant, Setting


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """One frame, cleaned. No NaN gets past here."""

    live: Bools  # (p,)
    y: Floats  # (p,) 0 where not live
    z: Floats  # (p,)
    w: Floats  # (N,)
    net: Floats | None  # (p,) metered net reactive injection minus the assumed load's; NaN where unused
    q: Floats  # (N,) without the inverters, whatever is metered
    v0_squared: float
    busbar: bool
    correction: Floats  # (b + 1,) at the last estimate
    now: Uncertainty


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """What the last step left that the next frame is cleaned with. m inverters, p meters.

    Attributes
    ----------
    x : (m,)
        Estimated injections, pu.
    v0_squared
        Squared busbar voltage, pu.
    named : (p,)
        Meters named as manipulated.
    """

    x: Floats
    v0_squared: float
    named: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """The voltages that a set of injections explains. N customers, b + 1 buses.

    Attributes
    ----------
    v2_bus, v2 : (b + 1,), (N,)
        Squared voltages of all buses, and of the customers', pu.
    correction : (b + 1,)
        What losses add to the linear model in them, squared pu.
    """

    v2_bus: Floats
    v2: Floats
    correction: Floats


def nothing_new(  # noqa: PLR0917  # what there was, and what there is to say without it
    plant: Plant,
    frame: Frame,
    t: float,
    last: tuple[Estimate, Verdict] | None,
    v0_squared: Floats | float,
    x: Floats,
) -> tuple[Estimate, Verdict]:
    """The answer to a frame that is not later than the last one: nothing new, and certainly not CLEAN.

    Parameters
    ----------
    plant, frame
        What is watched, and the frame.
    t
        Time of the last frame that was used, Unix s.
    last
        What was answered then; None: there was none.
    v0_squared, x
        Squared busbar voltage (or one for each phase) and injections, pu, to be answered without one.
    """
    reason = f"A frame of time {frame.t} is not later than the last one, {t}; it was not used."
    if last is not None:
        estimate, verdict = last
        return estimate, replace(verdict, decision=Decision.UNDECIDED, cause=Cause.SETTLING, reason=reason)
    at, p = plant.feeder.bus, plant.meters.size
    v2_bus, nobody = by_place(plant.feeder, v0_squared), np.zeros(p, dtype=np.bool_)
    estimate = Estimate(t, v2_bus[at], np.full(at.size, NO_VOLTAGE), v2_bus, nobody, x)
    score, threshold = np.full(p, np.nan), np.full(p, NO_VOLTAGE)
    verdict = Verdict(Decision.UNDECIDED, Cause.SETTLING, reason, nobody, score, threshold, np.zeros(p))
    return estimate, verdict


def known(frame: Frame) -> Frame:
    """The frame with powers that are numbers: of all others nothing is known, and their errors say so.

    Parameters
    ----------
    frame
        Everything known at one tick.
    """
    p, p_error = _power(frame.p, frame.p_error)
    q, q_error = _power(frame.q, frame.q_error)
    told = np.isfinite(frame.q_net) & (frame.q_net_error >= 0.0) & (frame.q_net_error <= NO_POWER)
    if p is frame.p and q is frame.q and bool((told | np.isnan(frame.q_net)).all()):
        return frame
    q_net = np.where(told, frame.q_net, np.nan)
    return replace(frame, p=p, p_error=p_error, q=q, q_error=q_error, q_net=q_net)


def _power(power: Floats, error: Floats) -> tuple[Floats, Floats]:
    good, sure = np.abs(power) <= NO_POWER, (error >= 0.0) & (error <= NO_POWER)
    if bool((good & sure).all()):
        return power, error
    return np.where(good, power, 0.0), np.where(good & sure, error, NO_POWER)


def reconstruct(setting: Setting, frame: Frame, inputs: Inputs, q: Floats) -> Reconstruction:
    """Voltages for given injections, with the loss correction at just these; chong2020 (19).

    Parameters
    ----------
    setting, frame, inputs
        What the frame was cleaned with, the frame, and what came of it.
    q : (N,)
        Net reactive injections, pu; see `injections`.
    """
    plant, model, correction = setting.plant, setting.model, inputs.correction
    if plant.loss_correction:
        with np.errstate(all="ignore"):
            correction = loss_correction(
                plant.balanced, frame.p, q, inputs.v0_squared, steps=plant.loss_correction
            )
        correction = np.where(np.isfinite(correction), correction, inputs.correction)
    v2_bus = inputs.v0_squared + 2.0 * (model.R_bus @ frame.p + model.X_bus @ q) + correction
    return Reconstruction(v2_bus, v2_bus[plant.feeder.bus], correction)


def clean(setting: Setting, past: Past, frame: Frame) -> Inputs:
    """Clean one frame, and say how uncertain what is left of it is.

    Parameters
    ----------
    setting
        The feeder, and the numbers that decide.
    past
        What the last step left.
    frame
        Everything known at one tick.
    """
    plant, model, options = setting.plant, setting.model, setting.options
    at = plant.meters
    live = frame.seen & np.isfinite(frame.y)
    y = np.where(live, np.clip(frame.y, 0.0, NO_VOLTAGE), 0.0)
    low, high = options.v2_limits
    busbar = bool(np.isfinite(frame.v0_squared) and low <= frame.v0_squared <= high)
    # Without a busbar voltage the meters have to imply it, and then nobody's reactive power is believed.
    told = live & _credible(setting, frame) & busbar
    net = np.where(told, frame.q_net[at] - frame.q[at], np.nan) if told.any() else None
    q_all = injections(plant, frame, past.x, told)
    q_error = frame.q_error.copy()
    q_error[at] = np.where(told, frame.q_net_error[at], q_error[at])
    v0 = frame.v0_squared if busbar else past.v0_squared
    correction, rest = _losses(plant, frame.p, q_all, v0, p_error=frame.p_error, q_error=q_error)
    base = setting.errors.R2 @ frame.p_error + setting.errors.X2 @ q_error + rest
    rise = 2.0 * (model.R @ frame.p + model.X @ q_all) + correction[plant.feeder.bus]
    reading = detect.reading_error(plant.accuracy, v0 + rise[at] + base[at] + _ROOM, options.sigmas)
    extra = np.where(told, np.maximum(frame.q_error[at] - frame.q_net_error[at], 0.0), 0.0)
    now = Uncertainty(np.minimum(base, NO_VOLTAGE), reading, live, told, extra)
    if busbar:
        error = detect.busbar_error(plant.accuracy, v0, options.sigmas)
    else:
        v0, error = _implied(setting, past, now, y - rise[at], v0)
    now = replace(now, base=np.minimum(now.base + error, NO_VOLTAGE))
    w = known_input(model, plant.droop.vbar, frame.p, frame.q, v0, correction[plant.feeder.bus])
    z = plant.droop.vbar**2 - y
    return Inputs(live, y, z, w, net, frame.q, v0, busbar, correction, now)


# Room for what inverters did since the last estimate, where only a meter's accuracy depends on it.
_ROOM = 0.05
# Errors of squared voltages end here: no voltage is above 2 pu.
NO_VOLTAGE = 4.0
# Powers beyond this many pu are none.
NO_POWER = 1e4


def _credible(setting: Setting, frame: Frame) -> Bools:
    """Whose net reactive power is what its load and its inverter can produce together; (p,)."""
    plant = setting.plant
    if not setting.believes_q:
        return np.zeros(plant.meters.size, dtype=np.bool_)
    count_ = frame.q.size
    most = np.bincount(plant.droop.customer, weights=plant.droop.q[:, 0], minlength=count_)
    least = np.bincount(plant.droop.customer, weights=plant.droop.q[:, 3], minlength=count_)
    room = frame.q_error + np.nan_to_num(frame.q_net_error)
    rest = np.nan_to_num(frame.q_net) - frame.q
    credible = np.isfinite(frame.q_net) & (least - room <= rest) & (rest <= most + room)
    return np.asarray(credible[plant.meters])


def injections(plant: Plant, frame: Frame, x: Floats, told: Bools) -> Floats:
    """Net reactive injection of every customer: metered where told, otherwise load plus inverter; (N,)."""
    q = frame.q + np.bincount(plant.droop.customer, weights=x, minlength=frame.q.size)
    at = plant.meters[told]
    q[at] = frame.q_net[at]
    return np.asarray(q)


def _losses(
    plant: Plant, p: Floats, q: Floats, v0: float, *, p_error: Floats, q_error: Floats
) -> tuple[Floats, Floats]:
    """Loss correction (b + 1,), and how far it can be from the truth at each customer (N,)."""
    feeder, steps = plant.balanced, plant.loss_correction
    # The correction is nearly quadratic in the loads: its ends are where all of them err the same way.
    ends = np.array([0.0, -1.0, 1.0])[:, None]
    with np.errstate(all="ignore"):
        three, left = corrected(feeder, p + ends * p_error, q + ends * q_error, v0, steps=max(steps, 1))
    # What is left grows with the cube of the load, so the centre says nothing about the ends.
    rest = left.max(axis=0)
    three = np.nan_to_num(three, nan=0.0, posinf=0.0, neginf=0.0)
    moved = np.abs(three[1:] - three[0]).max(axis=0)[feeder.bus]
    rest = np.nan_to_num(rest, nan=NO_VOLTAGE, posinf=NO_VOLTAGE)
    if steps == 0:
        rest = rest + np.abs(three[0][feeder.bus])
        return np.zeros(three.shape[1]), np.minimum(rest + moved, NO_VOLTAGE)
    return np.asarray(three[0]), np.minimum(rest + moved, NO_VOLTAGE)


def _implied(
    setting: Setting, past: Past, now: Uncertainty, implied: Floats, last: float
) -> tuple[float, float]:
    """Squared busbar voltage that the meters imply, and its error.

    The median lies between honest values as long as liars are fewer than half, and then its error is
    at most the largest honest one.
    """
    use = now.live & ~past.named
    if np.count_nonzero(use) <= 2 * setting.max_attacked:
        use = now.live
    if np.count_nonzero(use) <= 2 * setting.max_attacked:
        return last, NO_VOLTAGE
    # The estimate of the injections is that of the last frame; in between each may have moved by its span.
    stale = detect.gap(setting.errors, now, detect.widest(setting.errors))[setting.plant.meters]
    return float(np.median(implied[use])), float(np.max((stale + now.reading)[use]))
