"""Inverters of the model, and readings that may be false at their inputs.

    driven(...) -> (SequentialState, Measurements, Prediction)  no inverter follows a reading that jumps
    followed(...) -> InjectionError                             every tick
    accused(...) -> InjectionError                              where a meter loses its trust

A manipulated reading that drives an inverter of the model moves the residuals of all others. An inverter
without a trusted meter follows the last estimate, moved by the model. The error z of its input has the
deviation s of the estimate in place of the error of the reading:

    e' = -(e - K sqrt(3) s - mismatch) / tau,   K the slope of the curve

The front end's own error of such an inverter is an interval of everything possible, for `Estimate.bound`.
As a deviation it is far too wide: an injection that is unknown hides the readings of its neighbours.

A meter that loses its trust has driven its inverter by a false reading. Its injection is unknown then, and
stays so for some time constants of the inverter.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np

from gridsec.arrays import Bools, Floats, any_of, changed
from gridsec.estimators.modal import verdict
from gridsec.estimators.modal.core import Core, CoreState
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.measurements import Measurements, measurements
from gridsec.estimators.sequential.state import InjectionError, Prediction, SequentialState
from gridsec.estimators.sequential.step import injection_target, predict, relaxed

JUMP = 6.0
"""Standard deviations of an innovation beyond which a reading does not drive an inverter, 1."""


def expected(v2: Floats, own: Floats) -> Floats:
    """Readings by the model without the error of each register at 1 pu, (p,), squared pu.

    Parameters
    ----------
    v2, own : (p,)
        Squared voltages by the model, pu, and own errors of the meters at 1 pu.
    """
    return v2 + own * (v2 - 1.0)


def driven(  # noqa: PLR0917  # the state, and one frame
    front: SequentialDesign,
    core: Core,
    state: CoreState,
    given: SequentialState,
    measured: Measurements,
    sizes: Floats,
    own: Floats,
) -> tuple[SequentialState, Measurements, Prediction]:
    """Front end, measurements and prediction without inverters driven by a reading that jumps.

    A reading beyond `JUMP` standard deviations of its innovation counts as not trusted at this tick.

    Parameters
    ----------
    front, core
        The front end and the core.
    state, given
        The state of the core, and that of the front end.
    measured, sizes
        The measurements of the frame, and sizes of false powers.
    own : (p,)
        Own errors of the meters.
    """
    predicted = predict(front, given, measured, sizes)
    if state.update is None or not front.meter_of.size or given.x is None:
        return given, measured, predicted
    m = measured.y - expected(predicted.v2_bus[front.prior.meters], own)
    # The variance is at least that of the white errors.
    far = np.abs(verdict.offsets(core, state, m)) > JUMP * core.modes.noise_std
    if not any_of(far):
        return given, measured, predicted
    drives = np.zeros(m.size, dtype=np.bool_)
    drives[front.meter_of[front.meter_of >= 0]] = True
    drives &= measured.available & given.trust.trusted
    if not any_of(drives & far):
        return given, measured, predicted
    off, std = verdict.deviations(core, state, m)
    jumps = drives & (np.abs(off) > JUMP * std)
    if not 0 < np.count_nonzero(jumps) <= front.max_attacked:
        # Where most readings jump, the busbar's or the loads have; then no inverter can do without them.
        return given, measured, predicted
    trusted = given.trust.trusted & ~jumps
    given = changed(given, trust=replace(given.trust, trusted=trusted))
    measured = measurements(front, measured.frame, trusted, given.busbar.trusted, given.v0_squared)
    return given, measured, predict(front, given, measured, sizes)


def followed(  # noqa: PLR0917  # the state, and one frame
    front: SequentialDesign,
    before: InjectionError,
    given: SequentialState,
    measured: Measurements,
    now: Prediction,
    h: float,
) -> InjectionError:
    """Errors of the injections after a tick, as deviations times ``sqrt(3)``.

    Parameters
    ----------
    front, before
        The front end, and the errors before.
    given
        Its state before the tick, with the trust of the tick.
    measured, now
        The measurements of the frame, and the frame by the model.
    h
        Interval, s.
    """
    own, meter, at = now.injection_error, front.meter_of, front.plant.droop.customer
    if not meter.size or given.last is None:
        return own
    trusted, width = given.trust.trusted[meter], own.width
    free = (meter >= 0) & ~trusted
    if any_of(free):
        width = np.where(free, sqrt(3.0) * given.last[0].std[at], width)
    target = injection_target(front, before, own.input, width)
    errors = relaxed(front, before, own.input, width, target, h)
    # A metered power that no curve allows is not used, and then the injection is unknown.
    return errors.reset((measured.reports_q & ~measured.uses_q)[at] & trusted)


def accused(front: SequentialDesign, errors: InjectionError, which: Bools) -> InjectionError:
    """Errors of the injections where meters `which` (p,) lose their trust: a false reading drove them.

    Parameters
    ----------
    front, errors
        The front end, and the errors of the tick.
    which : (p,)
        Meters accused at this tick.
    """
    return errors.reset((front.meter_of >= 0) & which[front.meter_of]) if any_of(which) else errors
