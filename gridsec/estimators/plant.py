"""Plant, options and checks that estimators share, and the inputs that they take from one frame.

After the preparation of a frame no NaN passes, and every error has a bound.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of
from gridsec.errors import Problem, raise_if_any
from gridsec.estimators import detection
from gridsec.estimators.detection import ErrorModel, TickUncertainty, error_model
from gridsec.grid.devices import Droop, MeterAccuracy, busbar_error, reading_error
from gridsec.grid.network import LinDistFlow, Network
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """Physical feeder of an estimator. N customers, m inverters, p meters.

    Raises ValueError with every problem found; `check_plant` checks that meters, feeder and accuracy are
        consistent.
    """

    feeder: Network  # the feeder with its customers: radial, meshed or in three phases
    droop: Droop  # the customers' inverters and their curves
    meters: Ints  # (p,) customer of each voltage meter; at most one meter per customer
    accuracy: MeterAccuracy  # accuracy of the meters by their data sheets
    # DistFlow fixed-point steps that correct LinDistFlow for branch losses; 0 leaves it linear
    loss_correction: int = 1

    @property
    def meter_names(self) -> tuple[str, ...]:
        """Customer of each meter by name, (p,)."""
        return tuple(self.feeder.customers[c] for c in self.meters)

    def __post_init__(self) -> None:
        meters, problems = np.asarray(self.meters), []
        if meters.ndim != 1 or (meters.size and meters.dtype.kind not in "iu"):
            problems.append(Problem("not-integer", "meters must be whole numbers, one for each meter"))
        if not _whole(self.loss_correction, 0):
            problems.append(
                Problem(
                    "not-integer",
                    f"loss_correction is {self.loss_correction}; it must be a whole number from 0 on",
                )
            )
        raise_if_any(problems)


@dataclass(frozen=True, slots=True)
class Options:
    """Tuning parameters.

    Raises ValueError with every problem found.
    """

    # Jitter allowance of an unmanipulated reading in standard deviations. At 4, one reading in 16 000 exceeds
    # it, which matters only for a meter at the limit of its class.
    sigmas: float = 4.0
    confirm: int = 2  # readings above the threshold until a meter is named
    # Consecutive readings below it until a meter is neither named nor suspect. An attack on at least every
    # `release`-th reading is named; docs/theory-detection.md, section 5.
    release: int = 6
    # the verdict is SETTLING until the remaining effect of the unknown initial state is below this fraction
    # of every threshold
    settled: float = 0.1
    # sets count as equal if their disagreements pi differ by at most this fraction of the largest saturation
    # limit; residuals decide between them
    tie: float = 1e-6
    widest: float = 0.1  # largest threshold of a meter that is judged, squared pu: 0.1 is 5 % of the voltage
    # range of valid squared busbar voltages, pu; a reading outside it is not used
    v2_limits: tuple[float, float] = (0.25, 2.25)

    def __post_init__(self) -> None:
        raise_if_any(
            [
                *(
                    Problem(
                        "negative",
                        f"{name} is {getattr(self, name)}; it must be a finite number that is not negative",
                    )
                    for name in ("sigmas", "tie")
                    if not 0.0 <= getattr(self, name) < np.inf
                ),
                *(
                    Problem(
                        "not-integer", f"{name} is {getattr(self, name)}; it must be a whole number from 1 on"
                    )
                    for name in ("confirm", "release")
                    if not _whole(getattr(self, name), 1)
                ),
                *judging_problems(self.settled, self.widest, self.v2_limits),
            ]
        )


def usual_options(step_s: float) -> Options:
    """Default options for an interval between frames, s: above 30 s, four readings clear a meter, not six."""
    return Options() if step_s <= 30.0 else Options(release=4)


def judging_problems(settled: float, widest: float, v2_limits: tuple[float, float]) -> list[Problem]:
    """Problems of the options `settled`, `widest` and `v2_limits`, see `Options`."""
    problems = []
    if not 0.0 < settled <= 1.0:
        problems.append(
            Problem(
                "out-of-range", f"settled is {settled}; it must be a part of a threshold, above 0 and up to 1"
            )
        )
    if not widest > 0.0:
        problems.append(Problem("not-positive", f"widest is {widest}; it must be a positive number"))
    if not 0.0 <= v2_limits[0] < v2_limits[1]:
        problems.append(
            Problem(
                "order", f"v2_limits is {v2_limits}; it must be two ascending numbers that are not negative"
            )
        )
    return problems


def _whole(value: object, least: int) -> bool:
    """True for a whole number that is not below `least`."""
    return isinstance(value, int | np.integer) and int(value) >= least


def check_plant(plant: Plant, *, max_attacked: int, step_s: float, more: Iterable[Problem] = ()) -> None:
    """Refuse a plant that no estimator supports, before anything is computed.

    max_attacked: M, largest number of simultaneously manipulated meters.
    step_s: expected interval between frames, s.
    Raises ValueError with every problem: meters at no customer, two at one, accuracy of other meters, numbers
        out of range.
    """
    meters, customers, problems = np.asarray(plant.meters), plant.feeder.bus.size, []
    nowhere = meters[(meters < 0) | (meters >= customers)]
    if nowhere.size:
        problems.append(
            Problem("unknown-index", f"meters {nowhere.tolist()} are at no customer: there are {customers}")
        )
    if np.unique(meters).size != meters.size:
        problems.append(Problem("duplicate", "two meters at one customer: combine them before"))
    if plant.accuracy.class_fraction.shape != meters.shape:
        given = plant.accuracy.class_fraction.size
        problems.append(Problem("shape", f"accuracy is given for {given} meters of {meters.size}"))
    if not _whole(max_attacked, 0):
        problems.append(
            Problem(
                "not-integer",
                f"max_attacked is {max_attacked}; it must be a whole number that is not negative",
            )
        )
    if not (np.isfinite(step_s) and step_s > 0):
        problems.append(
            Problem("not-positive", f"step_s is {step_s}; it must be a positive number of seconds")
        )
    raise_if_any([*problems, *more])


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorContext:
    """Plant with its derived models, common to all estimators of a feeder."""

    plant: Plant
    model: LinDistFlow  # linear power flow of the plant
    errors: ErrorModel  # propagation of errors
    options: Options
    max_attacked: int  # M
    uses_reported_q: bool  # True if metered net reactive power replaces that of load and inverter


def estimator_context(
    plant: Plant, *, max_attacked: int, options: Options | None = None, uses_reported_q: bool = False
) -> EstimatorContext:
    """Compute the setting of a plant; `options` are the defaults if None."""
    model = plant.feeder.linear()
    errors = error_model(plant.droop, model, plant.meters, max_attacked)
    return EstimatorContext(
        plant, model, errors, Options() if options is None else options, max_attacked, uses_reported_q
    )


# --- Inputs of one frame ---


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Prepared inputs of one frame, without NaN except in `net`."""

    live: Bools  # (p,)
    y: Floats  # (p,) 0 where unavailable
    z: Floats  # (p,)
    w: Floats  # (N,)
    net: Floats | None  # (p,) metered net reactive injection minus the assumed load; NaN where unused
    q: Floats  # (N,) without the inverters and without metered net powers
    v0_squared: Floats | float  # in three phases (3,)
    busbar: bool
    correction: Floats  # (n,) at the last estimate
    now: TickUncertainty


@dataclass(frozen=True, slots=True, eq=False)
class PreviousStep:
    """State of the last step that prepares the next frame. m inverters, p meters."""

    x: Floats  # (m,) estimated injections, pu
    v0_squared: Floats | float  # squared busbar voltage, pu; in three phases one or (3,)
    named: Bools  # (p,) meters named as manipulated


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """Voltages reconstructed from a set of injections. N customers, n places."""

    # v2_bus, v2 (n,), (N,): squared voltages of all places and of the customers, pu
    v2_bus: Floats
    v2: Floats
    moved: Floats  # (N,) change of the loss correction since the last estimate, squared pu


def nothing_new(  # noqa: PLR0917  # the last answer, and the values without one
    plant: Plant,
    frame: Frame,
    t: float,
    last: tuple[Estimate, Verdict] | None,
    v0_squared: Floats | float,
    x: Floats,
) -> tuple[Estimate, Verdict]:
    """Answer to a frame that is not later than the last one: the last answer, never CLEAN.

    t: time of the last frame that was used, Unix s.
    v0_squared, x: squared busbar voltage (or one for each phase) and injections, pu, for the answer without a
        last one.
    """
    reason = f"A frame of time {frame.t} is not later than the last one, {t}; it was not used."
    if last is not None:
        estimate, verdict = last
        return estimate, replace(verdict, decision=Decision.UNDECIDED, cause=Cause.SETTLING, reason=reason)
    at, p = plant.feeder.bus, plant.meters.size
    v2_bus, no_meters = plant.feeder.broadcast_busbar(v0_squared), np.zeros(p, dtype=np.bool_)
    estimate = Estimate(t, v2_bus[at], np.full(at.size, NO_VOLTAGE), v2_bus, no_meters, x)
    score, threshold = np.full(p, np.nan), np.full(p, NO_VOLTAGE)
    verdict = Verdict(Decision.UNDECIDED, Cause.SETTLING, reason, no_meters, score, threshold, np.zeros(p))
    return estimate, verdict


def known(frame: Frame) -> Frame:
    """The frame with finite powers: others are replaced, with the largest error as their interval."""
    p, p_error = _power(frame.p, frame.p_error)
    q, q_error = _power(frame.q, frame.q_error)
    told = (np.abs(frame.q_net) <= NO_POWER) & (frame.q_net_error >= 0.0) & (frame.q_net_error <= NO_POWER)
    if p is frame.p and q is frame.q and bool((told | np.isnan(frame.q_net)).all()):
        return frame
    q_net = np.where(told, frame.q_net, np.nan)
    return replace(frame, p=p, p_error=p_error, q=q, q_error=q_error, q_net=q_net)


def usual(frame: Frame) -> Frame:
    """The frame for estimators that derive deviations from intervals: widths by the usual deviations.

    A reactive power reported without the active one keeps its whole interval: readings are compared with
    everything that is possible.
    """
    if frame.p_std is None or frame.q_std is None:
        return frame
    p_std, q_std = frame.p_std, np.where(np.isnan(frame.q_net), frame.q_std, np.nan)
    root = np.sqrt(3.0)
    return replace(
        frame,
        p_error=np.where(np.isnan(p_std), frame.p_error, root * p_std),
        q_error=np.where(np.isnan(q_std), frame.q_error, root * q_std),
    )


def _power(power: Floats, error: Floats) -> tuple[Floats, Floats]:
    good, sure = np.abs(power) <= NO_POWER, (error >= 0.0) & (error <= NO_POWER)
    if bool((good & sure).all()):
        return power, error
    return np.where(good, power, 0.0), np.where(good & sure, error, NO_POWER)


def reconstruct(setting: EstimatorContext, frame: Frame, inputs: Inputs, q: Floats) -> Reconstruction:
    """Voltages for given injections, with the loss correction at these; chong2020 (19)."""
    plant, model, correction = setting.plant, setting.model, inputs.correction
    if plant.loss_correction:
        with np.errstate(all="ignore"):
            correction = plant.feeder.loss_correction(
                frame.p, q, inputs.v0_squared, steps=plant.loss_correction
            )
        correction = np.where(np.isfinite(correction), correction, inputs.correction)
    base = plant.feeder.broadcast_busbar(inputs.v0_squared)
    v2_bus = base + 2.0 * (model.R_bus @ frame.p + model.X_bus @ q) + correction
    at = plant.feeder.bus
    return Reconstruction(v2_bus, v2_bus[at], np.abs(correction - inputs.correction)[at])


def clean(setting: EstimatorContext, past: PreviousStep, frame: Frame) -> Inputs:
    """Prepare one frame and compute the uncertainty of the result."""
    plant, model, options = setting.plant, setting.model, setting.options
    at = plant.meters
    live = frame.seen & np.isfinite(frame.y)
    y = np.where(live, np.clip(frame.y, 0.0, NO_VOLTAGE), 0.0)
    given, there = _busbar(plant.feeder, frame, options.v2_limits)
    busbar = bool(np.all(there))
    # Without a busbar voltage the meters have to imply it, and then no reported reactive power is used.
    told = live & _credible(setting, frame) & busbar
    net = np.where(told, frame.q_net[at] - frame.q[at], np.nan) if told.any() else None
    q_all = injections(plant, frame, past.x, told)
    q_error = frame.q_error.copy()
    q_error[at] = np.where(told, frame.q_net_error[at], q_error[at])
    v0 = given if busbar else np.where(there, given, past.v0_squared)
    here = _of_customers(plant.feeder, v0)
    correction, rest = losses(plant, frame.p, q_all, v0, p_error=frame.p_error, q_error=q_error)
    base = setting.errors.R2 @ frame.p_error + setting.errors.X2 @ q_error + rest
    rise = 2.0 * (model.R @ frame.p + model.X @ q_all) + correction[plant.feeder.bus]
    reading = reading_error(plant.accuracy, here[at] + rise[at] + base[at] + _ROOM, options.sigmas)
    extra = np.where(told, np.maximum(frame.q_error[at] - frame.q_net_error[at], 0.0), 0.0)
    now = TickUncertainty(np.minimum(base, NO_VOLTAGE), reading, live, told, extra)
    error = busbar_errors(plant, v0, options.sigmas)
    if not busbar:
        v0, error = _implied(setting, past, now, y - rise[at], (v0, error, there))
        here = _of_customers(plant.feeder, v0)
    now = replace(now, base=np.minimum(now.base + _of_customers(plant.feeder, error), NO_VOLTAGE))
    w = plant.droop.vbar**2 - here - 2.0 * (frame.p @ model.R.T + frame.q @ model.X.T)
    w = w - correction[plant.feeder.bus]
    z = plant.droop.vbar**2 - y
    return Inputs(live, y, z, w, net, frame.q, v0, busbar, correction, now)


def _busbar(
    feeder: Network, frame: Frame, limits: tuple[float, float]
) -> tuple[Floats | float, Bools | bool]:
    """Squared voltage of the busbar as given, and its validity; in three phases (3,) each."""
    low, high = limits
    if feeder.busbar_phases == 1:
        return frame.v0_squared, bool(np.isfinite(frame.v0_squared) and low <= frame.v0_squared <= high)
    if frame.v0_phases is None:
        # A mean determines no phase.
        return np.full(3, np.nan), np.zeros(3, dtype=np.bool_)
    return frame.v0_phases, (frame.v0_phases >= low) & (frame.v0_phases <= high)


def busbar_errors(plant: Plant, v0_squared: Floats | float, sigmas: float) -> Floats | float:
    """Largest error of the squared busbar voltage without manipulation; in three phases (3,) each."""
    if plant.feeder.busbar_phases == 1:
        return busbar_error(plant.accuracy, float(v0_squared), sigmas)
    each = np.broadcast_to(v0_squared, 3).tolist()
    return np.array([busbar_error(plant.accuracy, one, sigmas) for one in each])


def _of_customers(feeder: Network, of_busbar: Floats | float) -> Floats:
    """Value of the busbar, repeated for every customer, (N,)."""
    return np.asarray(feeder.broadcast_busbar(of_busbar)[feeder.bus])


# Room for the motion of inverters since the last estimate, in the voltage that scales a meter's accuracy.
_ROOM = 0.05
# Limit of errors of squared voltages: no voltage is above 2 pu.
NO_VOLTAGE = 4.0
# Largest valid power, pu.
NO_POWER = 1e4


def _credible(setting: EstimatorContext, frame: Frame) -> Bools:
    """Mask (p,) of net reactive powers that load and inverter can produce together."""
    plant = setting.plant
    if not setting.uses_reported_q:
        return np.zeros(plant.meters.size, dtype=np.bool_)
    least, most = plant.droop.saturated(frame.q.size)
    room = frame.q_error + np.nan_to_num(frame.q_net_error)
    rest = np.nan_to_num(frame.q_net) - frame.q
    credible = np.isfinite(frame.q_net) & (least - room <= rest) & (rest <= most + room)
    return np.asarray(credible[plant.meters])


def injections(plant: Plant, frame: Frame, x: Floats, told: Bools) -> Floats:
    """Net reactive injection of every customer: metered in `told`, otherwise load plus inverter; (N,)."""
    q = frame.q + plant.droop.per_customer(x, frame.q.size)
    at = plant.meters[told]
    q[at] = frame.q_net[at]
    return np.asarray(q)


def losses(
    plant: Plant, p: Floats, q: Floats, v0: Floats | float, *, p_error: Floats, q_error: Floats
) -> tuple[Floats, Floats]:
    """Loss correction and a bound of its error for powers within intervals.

    p, q (N,): net injections, pu.
    v0: squared busbar voltage, pu; in three phases one or (3,).
    p_error, q_error (N,): largest errors of the injections, pu.
    Returns (n,), (N,): correction of the linear model at every place, and the bound at every customer,
        squared pu.
    """
    feeder, steps = plant.feeder, plant.loss_correction
    once, moved, rest = feeder.correction_bounds(
        p, q, v0, p_error=p_error, q_error=q_error, steps=max(steps, 1)
    )
    once = _finite(once, 0.0)
    rest = _finite(rest, NO_VOLTAGE)
    if steps == 0:
        rest = rest + np.abs(once[feeder.bus])
        return np.zeros(once.shape), np.minimum(rest + moved, NO_VOLTAGE)
    return np.asarray(once), np.minimum(rest + moved, NO_VOLTAGE)


def _finite(values: Floats, instead: float) -> Floats:
    """The values, with `instead` in place of those that are not finite; the copy is rarely needed."""
    finite = np.isfinite(values)
    return values if all_of(finite) else np.where(finite, values, instead)


def _implied(
    setting: EstimatorContext,
    past: PreviousStep,
    now: TickUncertainty,
    implied: Floats,
    busbar: tuple[Floats | float, Floats | float, Bools | bool],
) -> tuple[Floats | float, Floats | float]:
    """Squared busbar voltage and its error; an unmetered one is the median of the values implied by meters.

    The median lies between unmanipulated values while fewer than half are manipulated; then its error is
    at most the largest unmanipulated one. A phase is determined by its own meters only.
    """
    feeder, at = setting.plant.feeder, setting.plant.meters
    # Estimated injections are those of the last frame; each may have moved by its span since.
    stale = detection.gap(setting.errors, now, detection.widest(setting.errors))[at]
    v0, error, there = (np.atleast_1d(np.array(value)) for value in busbar)
    heard = np.equal.outer(feeder.bus[at] % 3, np.arange(3)) if there.size > 1 else np.ones((at.size, 1))
    for k in np.flatnonzero(~there).tolist():
        among = now.live & (heard[:, k] > 0)
        use = among & ~past.named
        if np.count_nonzero(use) <= 2 * setting.max_attacked:
            use = among
        if np.count_nonzero(use) <= 2 * setting.max_attacked:
            error[k] = NO_VOLTAGE
        else:
            v0[k], error[k] = np.median(implied[use]), np.max((stale + now.reading)[use])
    if feeder.busbar_phases == 3:
        return v0, error
    return float(v0[0]), float(error[0])
