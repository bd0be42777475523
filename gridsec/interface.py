"""Interface of the estimators: inputs and outputs of every `step`.

Every estimator family is three functions with these types at their borders::

    design(...)                 -> Design                      offline; may raise a GridsecError
    init(design, t)             -> State
    step(design, state, frame)  -> (State, Estimate, Verdict)  online; never raises on data

Outcomes are values. UNDECIDED is a separate answer: a missing answer must never look like CLEAN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


class Decision(StrEnum):
    """Answers of an estimator."""

    CLEAN = "clean"
    ATTACKED = "attacked"
    UNDECIDED = "undecided"


class Cause(StrEnum):
    """Cause of a verdict, for programs; `Verdict.reason` is the sentence for operators."""

    AGREEMENT = "agreement"
    RESIDUALS = "residuals"
    SETTLING = "settling"
    SILENT_METERS = "silent-meters"
    CLOCK_OFFSET = "clock-offset"
    MISSING_POWERS = "missing-powers"
    TOO_FEW_METERS = "too-few-meters"
    NO_BUSBAR = "no-busbar"
    TOO_MANY_SUSPECTS = "too-many-suspects"
    AMBIGUOUS = "ambiguous"
    MISFIT = "misfit"
    DESIGN_INVALID = "design-invalid"


class ManipulationKind(StrEnum):
    """Class of a manipulation, where the data show it."""

    OFFSET = "offset"
    DRIFT = "drift"
    STUCK = "stuck"
    REPLAY = "replay"
    CLOCK_SHIFT = "clock-shift"
    COORDINATED = "coordinated"


class PowerOrigin(IntEnum):
    """Origin of a customer's active power in a frame."""

    READ = 0
    """A reading within the customer's declared load and generation."""
    UNREAD = 1
    """No usable reading: a range, or a forecast."""
    BEYOND = 2
    """A reading beyond the declared load or generation, used in part or not at all."""
    LATE = 3
    """A reading older than the voltage beside it, and than stated in the files."""


def _none() -> Bools:
    return np.zeros(0, dtype=np.bool_)


def _nothing() -> Floats:
    return np.zeros(0)


@dataclass(frozen=True, slots=True)
class Explanation:
    """One explanation of the readings. p meters, m inverters, N customers.

    Attributes
    ----------
    meters : (p,)
        Meters manipulated in it.
    inverters : (m,)
        Inverters manipulated in it.
    probability
        Its probability among the given explanations, from 0 to 1.
    powers : (N,)
        Customers with wrong stated powers in it; empty from estimators that trust all powers.
    busbar : (b,)
        Phases of the busbar, one on a balanced feeder, with a manipulated meter in it; empty likewise.
    """

    meters: Bools
    inverters: Bools
    probability: float
    powers: Bools = field(default_factory=_none)
    busbar: Bools = field(default_factory=_none)


@dataclass(frozen=True, slots=True)
class Frame:
    """Data of one tick, in per unit. N customers, p meters.

    Attributes
    ----------
    t
        Unix time of the tick, s.
    y : (p,)
        Squared voltage reported by each meter, pu; NaN where `seen` is False.
    seen : (p,)
        True if the tick has a usable reading of the meter.
    v0_squared
        Metered squared busbar voltage, pu; NaN if there is none. In three phases their mean.
    p : (N,)
        Net active injection of each customer (generation positive), pu; always finite.
    p_error : (N,)
        Half-width of the interval around `p` that contains the true value, pu.
    q : (N,)
        Reactive injection of each customer *without* its droop inverter, pu; always finite.
    q_error : (N,)
        Half-width for `q`, pu.
    q_net : (N,)
        Metered net reactive injection, inverter included, pu; NaN where not reported.
    q_net_error : (N,)
        Half-width for `q_net`, pu; ignored where `q_net` is NaN.
    v0_phases : (3,) or None
        Squared busbar voltage of each phase, pu, NaN where missing; None on a balanced feeder.
    p_std, q_std : (N,) or None
        Standard deviation of the true values about `p` and `q` where known independently of the intervals, as
        for forecasts, pu; NaN, or None for all, where it is that of a uniform distribution in the interval.
    p_origin : (N,) or None
        `PowerOrigin` of `p`; None means `READ` everywhere. An unread power does not check the voltage reading
        of the same meter.
    clock_offset : (p,) or None
        Lead of each meter's clock, s; NaN, or None for all, where not measurable.
    busbar_offset
        Lead of the clock of the busbar's meter, s; NaN where not measurable.
    """

    t: float
    y: Floats
    seen: Bools
    v0_squared: float
    p: Floats
    p_error: Floats
    q: Floats
    q_error: Floats
    q_net: Floats
    q_net_error: Floats
    v0_phases: Floats | None = None
    p_std: Floats | None = None
    q_std: Floats | None = None
    p_origin: Ints | None = None
    clock_offset: Floats | None = None
    busbar_offset: float = math.nan


@dataclass(frozen=True, slots=True)
class Estimate:
    """Reconstructed state of the feeder. N customers, m inverters, b + 1 buses.

    Attributes
    ----------
    t
        Unix time, s.
    v2 : (N,)
        Reconstructed squared voltage of each customer, pu.
    bound : (N,)
        Half-width of the interval around `v2` that contains the true value while the design's assumptions
        hold, pu.
    v2_bus : (b + 1,)
        Reconstructed squared voltage of every bus, the busbar first, pu. In three phases (3 (b + 1),), the
        phases of a bus side by side.
    trusted : (p,)
        Meters used by the estimate.
    x : (m,)
        Estimated reactive injection of the droop inverters, pu.
    std : (N,)
        Standard deviation of `v2`, squared pu; (0,) from estimators with bounds only.
    """

    t: float
    v2: Floats
    bound: Floats
    v2_bus: Floats
    trusted: Bools
    x: Floats
    std: Floats = field(default_factory=_nothing)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on meters and inverters at one tick. p meters.

    Attributes
    ----------
    decision
        CLEAN, ATTACKED or UNDECIDED.
    cause
        AGREEMENT goes with CLEAN, RESIDUALS with ATTACKED, every other cause with UNDECIDED.
    reason
        One sentence for the operator.
    suspects : (p,)
        Meters named as manipulated. May be non-empty with UNDECIDED, if more meters disagree than the design
        can tell apart.
    score : (p,)
        Absolute output residual |y - y_hat|, squared pu; NaN for unseen meters.
    threshold : (p,)
        Largest possible score of an unmanipulated meter, squared pu; `score > threshold` is evidence.
    attack : (p,)
        Reconstructed additive attack on the squared voltage, pu; 0 for meters that are not suspects.
    inverters : (m,)
        Droop inverters named as manipulated; (0,) from estimators that do not judge inverters.
    inverter_attack : (m,)
        Reconstructed error of their set points, pu of reactive power; (0,) likewise.
    kinds : (p,)
        Class of each suspect's manipulation, None where unknown; () from estimators that do not classify.
    explanations
        Explanations that fit the data about equally well, likeliest first; () from estimators without any.
    unjudged : (m,)
        Inverters that the data do not determine although inverters are judged; (0,) for none.
    busbar : (b,)
        Phases of the busbar, one on a balanced feeder, with a meter named as manipulated; (0,) from
        estimators that trust it or do not use it.
    busbar_attack : (b,)
        Excess of its reading, squared pu; 0 where not named; (0,) likewise.
    """

    decision: Decision
    cause: Cause
    reason: str
    suspects: Bools
    score: Floats
    threshold: Floats
    attack: Floats
    inverters: Bools = field(default_factory=_none)
    inverter_attack: Floats = field(default_factory=_nothing)
    kinds: tuple[ManipulationKind | None, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    unjudged: Bools = field(default_factory=_none)
    busbar: Bools = field(default_factory=_none)
    busbar_attack: Floats = field(default_factory=_nothing)
