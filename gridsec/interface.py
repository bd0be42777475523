"""Interface of the estimators: inputs and outputs of every `step`.

Every estimator family is three functions with these types at their borders::

    design(...)                 -> Design                      offline; may raise a GridsecError
    init(design, t)             -> State
    step(design, state, frame)  -> (State, Estimate, Verdict)  online; never raises on data

Outcomes are values. A frame that is not later than the last one returns the last estimate and UNDECIDED, and
the state as it was. UNDECIDED is a separate answer: a missing answer must never look like CLEAN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


USABLE_OFFSET_S: Final = 15.0
"""Largest clock offset of a usable reading at short ticks, s: at a larger one the loads have changed."""
OFFSET_PART: Final = 0.25
"""The same at long ticks, as a part of a tick."""


def usable_offset(tick_s: float, least_s: float = USABLE_OFFSET_S) -> float:
    """Largest clock offset of a usable reading, s: `least_s`, or `OFFSET_PART` of a tick if longer."""
    return max(least_s, OFFSET_PART * tick_s)


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
    OVERLOAD = "overload"
    NO_OWNER = "no-owner"


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
    """One explanation of the readings. p meters, m inverters, N customers."""

    meters: Bools  # (p,) meters manipulated in it
    inverters: Bools  # (m,) inverters manipulated in it
    probability: float  # its probability among the given explanations, from 0 to 1
    # (N,) customers with wrong stated powers in it; empty from estimators that trust all powers
    powers: Bools = field(default_factory=_none)
    # (b,) phases of the busbar, one on a balanced feeder, with a manipulated meter in it; empty likewise
    busbar: Bools = field(default_factory=_none)


@dataclass(frozen=True, slots=True)
class Frame:
    """Data of one tick, in per unit. N customers, p meters."""

    t: float  # Unix time of the tick, s
    y: Floats  # (p,) squared voltage reported by each meter, pu; NaN where `seen` is False
    seen: Bools  # (p,) True if the tick has a usable reading of the meter
    v0_squared: float  # Metered squared busbar voltage, pu; NaN if there is none. In three phases their mean.
    p: Floats  # (N,) net active injection of each customer (generation positive), pu; always finite
    p_error: Floats  # (N,) half-width of the interval around `p` that contains the true value, pu
    q: Floats  # (N,) reactive injection of each customer *without* its droop inverter, pu; always finite
    q_error: Floats  # (N,) half-width for `q`, pu
    q_net: Floats  # (N,) metered net reactive injection, inverter included, pu; NaN where not reported
    q_net_error: Floats  # (N,) half-width for `q_net`, pu; ignored where `q_net` is NaN
    # (3,) or None: squared busbar voltage of each phase, pu, NaN where missing; None on a balanced feeder
    v0_phases: Floats | None = None
    # p_std, q_std (N,) or None: standard deviation of the true values about `p` and `q` where known
    # independently of the intervals, as for forecasts, pu; NaN, or None for all, where it is that of a
    # uniform distribution in the interval
    p_std: Floats | None = None
    q_std: Floats | None = None
    # (N,) or None: `PowerOrigin` of `p`; None means `READ` everywhere. An unread power does not check the
    # voltage reading of the same meter.
    p_origin: Ints | None = None
    # (p,) or None: lead of each meter's clock, s; NaN, or None for all, where not measurable
    clock_offset: Floats | None = None
    busbar_offset: float = math.nan  # lead of the clock of the busbar's meter, s; NaN where not measurable


@dataclass(frozen=True, slots=True)
class Estimate:
    """Reconstructed state of the feeder. N customers, m inverters, b + 1 buses."""

    t: float  # Unix time, s
    v2: Floats  # (N,) reconstructed squared voltage of each customer, pu
    # (N,) half-width of the interval around `v2` that contains the true value while the design's assumptions
    # hold, pu
    bound: Floats
    # (b + 1,) Reconstructed squared voltage of every bus, the busbar first, pu. In three phases (3 (b + 1),),
    # the phases of a bus side by side.
    v2_bus: Floats
    trusted: Bools  # (p,) meters used by the estimate
    x: Floats  # (m,) estimated reactive injection of the droop inverters, pu
    # (N,) standard deviation of `v2`, squared pu; (0,) from estimators with bounds only
    std: Floats = field(default_factory=_nothing)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on meters and inverters at one tick. p meters."""

    decision: Decision  # CLEAN, ATTACKED or UNDECIDED
    cause: Cause  # AGREEMENT goes with CLEAN, RESIDUALS with ATTACKED, every other cause with UNDECIDED
    reason: str  # one sentence for the operator
    # (p,) Meters named as manipulated. May be non-empty with UNDECIDED, if more meters disagree than the
    # design can tell apart.
    suspects: Bools
    score: Floats  # (p,) absolute output residual |y - y_hat|, squared pu; NaN for unseen meters
    # (p,) largest possible score of an unmanipulated meter, squared pu; `score > threshold` is evidence
    threshold: Floats
    # (p,) reconstructed additive attack on the squared voltage, pu; 0 for meters that are not suspects
    attack: Floats
    # (m,) droop inverters named as manipulated; (0,) from estimators that do not judge inverters
    inverters: Bools = field(default_factory=_none)
    # (m,) reconstructed error of their set points, pu of reactive power; (0,) likewise
    inverter_attack: Floats = field(default_factory=_nothing)
    # (p,) class of each suspect's manipulation, None where unknown; () from estimators that do not classify
    kinds: tuple[ManipulationKind | None, ...] = ()
    # explanations that fit the data about equally well, likeliest first; () from estimators without any
    explanations: tuple[Explanation, ...] = ()
    # (m,) inverters that the data do not determine although inverters are judged; (0,) for none
    unjudged: Bools = field(default_factory=_none)
    # (b,) phases of the busbar, one on a balanced feeder, with a meter named as manipulated; (0,) from
    # estimators that trust it or do not use it
    busbar: Bools = field(default_factory=_none)
    # (b,) excess of its reading, squared pu; 0 where not named; (0,) likewise
    busbar_attack: Floats = field(default_factory=_nothing)
