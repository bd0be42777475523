"""Inverters of the model, and readings that may be false at their inputs.

    driven(...) -> (FrontState, Measurements, Prediction)  no inverter follows a reading that jumps
    followed(...) -> InjectionError                             every tick
    fitted(...) -> Fit                                          every tick

A manipulated reading that drives an inverter of the model moves the residuals of all others. An inverter
with a distrusted meter follows the last estimate, moved by the model. The error of its input has the
deviation s of the estimate in place of the error of the reading:

    e' = -(e - K sqrt(3) s - mismatch) / tau,   K the slope of the curve

The front end's own error of such an inverter is an interval of everything possible, for `Estimate.bound`.
As a deviation it is far too wide: an injection that is unknown hides the readings of its neighbours. While
meters collude, the estimate may err by more than its deviation, and for long. So e is an unknown direction of
the frame (`doubts`).

A meter that loses its trust at a tick at which it drove its inverter has done so by a false reading. The
injection is unknown then, and stays so for some time constants of the inverter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from gridsec.arrays import Bools, Floats, any_of, changed
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import FrameUncertainty, Measurements, measurements
from gridsec.estimators.front.observer import injection_target, predict, relaxed
from gridsec.estimators.front.state import FrontState, InjectionError, Prediction
from gridsec.estimators.modal import classes, doubts, verdict
from gridsec.estimators.modal.core import Core, CoreState
from gridsec.estimators.modal.filter import Interval

JUMP = 6.0
"""Standard deviations of an innovation beyond which a reading does not drive an inverter, 1."""
NEAR = 4.5
"""White deviations from the last tick's fit from which on innovations are computed, 1: `JUMP` less a margin.

The margin is for the flicker of the busbar's meter and the decay of the loads' errors.
"""
SHORT = 0.99
"""Least decay of the loads' errors in an interval over which the fit of the last tick counts, 1."""
LEARNING, RENEWED = 64, 16
"""First ticks at which the own errors are computed, and later the ticks from one to the next.

They enter the residuals times ``v2 - 1``: 16 ticks change a residual by less than a hundredth of its noise.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Readings by the filter after a tick. p meters.

    Attributes
    ----------
    own : (p,)
        Own errors of the meters at 1 pu, squared pu; with complete readings of up to `RENEWED` ticks before.
    residuals : (p,) or None
        Residuals by the filter, squared pu; None where readings are missing or meters suspected.
    """

    own: Floats
    residuals: Floats | None = None


def fitted(
    core: Core, state: CoreState, before: Fit | None = None, ticks: int = 0, mean: Floats | None = None
) -> Fit:
    """Readings by the filter after a tick, O(p) at most ticks, O(p^2) at the others.

    Parameters
    ----------
    core, state
        The core, and its state after the tick.
    before, ticks
        The same after the tick before, and the number of ticks so far; None and 0 before the first.
    mean : (p,)
        Errors of the model at the meters, squared pu; None where a fault is suspected.
    """
    if before is None or mean is None or state.filter.full is not None:
        return Fit(classes.means(core.classes, core.modes, state.filter, state.static))
    own = before.own
    if ticks <= LEARNING or ticks % RENEWED == 0:
        own = classes.means(core.classes, core.modes, state.filter, state.static)
    return Fit(own, mean + own)


def expected(v2: Floats, own: Floats) -> Floats:
    """Readings by the model without the error of each register at 1 pu, (p,), squared pu.

    Parameters
    ----------
    v2, own : (p,)
        Squared voltages by the model, pu, and own errors of the meters at 1 pu.
    """
    return v2 + own * (v2 - 1.0)


def driven(  # noqa: PLR0917  # the state, and one frame
    front: FrontDesign,
    core: Core,
    state: CoreState,
    given: FrontState,
    measured: Measurements,
    uncertainty: FrameUncertainty,
    before: InjectionError,
    fit: Fit,
) -> tuple[FrontState, Measurements, Prediction]:
    """Front end, measurements and prediction without inverters driven by a reading that jumps.

    A reading beyond `JUMP` standard deviations of its innovation counts as not trusted at this tick. What the
    frame leaves unknown is a part of the innovation.

    Parameters
    ----------
    front, core
        The front end and the core.
    state, given
        The state of the core, and that of the front end.
    measured, uncertainty
        The measurements of the frame, and its uncertainty beyond that of the design.
    before
        Errors of the injections before the tick.
    fit
        Readings by the filter after the last tick.
    """
    predicted = predict(front, given, measured, uncertainty.sizes)
    if state.update is None or not front.meter_of.size or given.x is None:
        return given, measured, predicted
    m, gap = (
        measured.y - expected(predicted.v2_bus[front.prior.meters], fit.own),
        Interval(measured.frame.t - given.t),
    )
    # The variance is at least that of the white errors.
    if fit.residuals is not None and gap.decay(core.modes)[0] > SHORT:
        far = np.abs(m - fit.residuals) > NEAR * core.modes.noise_std
    else:
        far = np.abs(verdict.offsets(core, state, m, gap)) > JUMP * core.modes.noise_std
    if not any_of(far):
        return given, measured, predicted
    drives = front.drives & measured.available & given.trust.trusted
    if not any_of(drives & far):
        return given, measured, predicted
    nu, std = verdict.deviations(core, state, m, gap)
    free = front.inverters_of(~given.trust.trusted)
    open_ = doubts.unknown(front, measured, uncertainty, before.error, free, given.clock_skew)
    if open_ is not None:
        std = np.sqrt(std**2 + (open_.wide**2).sum(axis=1))
    jumps = drives & (np.abs(nu) > JUMP * std)
    if not 0 < np.count_nonzero(jumps) <= front.max_attacked:
        # Where most readings jump, the busbar's or the loads have; then no inverter can do without them.
        return given, measured, predicted
    trusted = given.trust.trusted & ~jumps
    given = changed(given, trust=replace(given.trust, trusted=trusted))
    measured = measurements(front, measured.frame, trusted, given.busbar.trusted, given.v0_squared)
    return given, measured, predict(front, given, measured, uncertainty.sizes)


def followed(  # noqa: PLR0917  # the state, and one frame
    front: FrontDesign,
    before: InjectionError,
    given: FrontState,
    now: Prediction,
    free: Bools,
    h: float,
) -> InjectionError:
    """Errors of the injections after a tick, as deviations times ``sqrt(3)``.

    Parameters
    ----------
    front, before
        The front end, and the errors before.
    given, now
        Its state before the tick, and the frame by the model.
    free : (m,)
        Inverters with a distrusted meter at this tick.
    h
        Interval, s.
    """
    own, width = now.injection_error, now.injection_error.width
    if not front.meter_of.size:
        return own
    last, checks = given.last if any_of(free) else None, given.inverter_checks
    if before is given.injection_error and checks.idle and last is None:
        # No inverter has followed the estimate so far: the errors are those of the front end.
        return own
    if last is not None:
        width = np.where(free, sqrt(3.0) * last[0].std[front.plant.droop.customer], width)
    target = injection_target(front, before, own.input, width)
    errors = relaxed(front, before, own.input, width, target, h)
    # The voltages have decided that this inverter leaves its curve: its injection says nothing about others.
    return errors if checks.idle else errors.reset(checks.named(front))
