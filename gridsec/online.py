"""The online vocabulary: what goes into and what comes out of every estimator's `step`.

Every estimator family is three functions with these types at their borders::

    design(...)                 -> Design                      offline; may raise a GridsecError
    init(design, t)             -> State
    step(design, state, frame)  -> (State, Estimate, Verdict)  online; never raises on data

Outcomes are values. UNDECIDED is an answer of its own: no answer must never look like no attack.
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
    """The three answers."""

    CLEAN = "clean"
    ATTACKED = "attacked"
    UNDECIDED = "undecided"


class Cause(StrEnum):
    """Why a verdict is what it is, for programs; `Verdict.reason` says it for people."""

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


class Kind(StrEnum):
    """What a manipulation looks like, where the data tell."""

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
    """A reading beyond the declared load or generation, believed in part or not at all."""
    LATE = 3
    """A reading older than the voltage beside it, and than the files state."""


def _none() -> Bools:
    return np.zeros(0, dtype=np.bool_)


def _nothing() -> Floats:
    return np.zeros(0)


@dataclass(frozen=True, slots=True)
class Explanation:
    """One way to explain the readings. p meters, m inverters, N customers.

    Attributes
    ----------
    meters : (p,)
        Who would be manipulated.
    inverters : (m,)
        Which inverters would be.
    probability
        Its share among the explanations given, from 0 to 1.
    powers : (N,)
        Whose powers would not be what they are said to be; empty where that is never supposed.
    busbar : (b,)
        Phases of the busbar, one on a balanced feeder, whose meter would be manipulated; empty likewise.
    """

    meters: Bools
    inverters: Bools
    probability: float
    powers: Bools = field(default_factory=_none)
    busbar: Bools = field(default_factory=_none)


@dataclass(frozen=True, slots=True)
class Frame:
    """Everything that is known at one tick, in per unit. N customers, p meters.

    Attributes
    ----------
    t
        Unix time of the tick, s.
    y : (p,)
        Squared voltage that each meter reports, pu; NaN where `seen` is False.
    seen : (p,)
        Whether a usable reading of the meter belongs to this tick.
    v0_squared
        Squared busbar voltage as metered, pu; NaN if there is none. In three phases the mean of them.
    p : (N,)
        Net active injection of each customer (generation positive), pu; always finite.
    p_error : (N,)
        Half-width of the interval around `p` that holds the truth, pu.
    q : (N,)
        Reactive injection of each customer *without* its droop inverter, pu; always finite.
    q_error : (N,)
        Half-width for `q`, pu.
    q_net : (N,)
        Metered net reactive injection, inverter included, pu; NaN where not reported.
    q_net_error : (N,)
        Half-width for `q_net`, pu; ignored where `q_net` is NaN.
    v0_phases : (3,) or None
        Squared busbar voltage of each phase, pu, NaN where there is none; None on a balanced feeder.
    p_std, q_std : (N,) or None
        Standard deviation of the truth about `p` and `q` where it is known apart from the intervals, as that
        of forecasts is, pu; NaN, or None for all, where it is that of a uniform distribution in the interval.
    p_origin : (N,) or None
        `PowerOrigin` of `p`; None: `READ` everywhere. A voltage reading beside an unread power of the same
        meter is not checked by that power.
    clock_offset : (p,) or None
        By how much each meter's clock is ahead, s; NaN, or None for all, where that is not measurable.
    busbar_offset
        By how much the clock of the busbar's meter is ahead, s; NaN where that is not measurable.
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
    """The reconstructed state of the feeder. N customers, m inverters, b + 1 buses.

    Attributes
    ----------
    t
        Unix time, s.
    v2 : (N,)
        Reconstructed squared voltage of each customer, pu.
    bound : (N,)
        Half-width of the interval around `v2` that holds the truth while the design's assumptions
        hold, pu.
    v2_bus : (b + 1,)
        Reconstructed squared voltage of every bus, the busbar first, pu. In three phases (3 (b + 1),), the
        phases of a bus side by side.
    trusted : (p,)
        The meters that the estimate rests on.
    x : (m,)
        Estimated reactive injection of the droop inverters, pu.
    std : (N,)
        Standard deviation of `v2`, squared pu; (0,) from estimators that only bound.
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
    """Who lies. p meters.

    Attributes
    ----------
    decision
        CLEAN, ATTACKED or UNDECIDED.
    cause
        AGREEMENT goes with CLEAN, RESIDUALS with ATTACKED, every other cause with UNDECIDED.
    reason
        Why, in one sentence, ready to be shown to an operator.
    suspects : (p,)
        The meters named as manipulated. May be non-empty with UNDECIDED, when more meters disagree
        than the design can tell apart.
    score : (p,)
        Absolute output residual |y - y_hat|, squared pu; NaN for unseen meters.
    threshold : (p,)
        The largest score an honest meter can reach, squared pu: `score > threshold` is evidence.
    attack : (p,)
        Reconstructed additive attack on the squared voltage, pu; 0 for meters that are no suspects.
    inverters : (m,)
        The droop inverters named as manipulated; (0,) from estimators that do not judge inverters.
    inverter_attack : (m,)
        Reconstructed wrong part of their set points, pu of reactive power; (0,) likewise.
    kinds : (p,)
        What each suspect's manipulation looks like, None where nobody can tell; () from estimators that
        do not ask.
    explanations
        Where several explanations fit the data about equally well, those, the likeliest first.
    unjudged : (m,)
        Inverters about which the data say nothing though inverters are judged; (0,) for none.
    busbar : (b,)
        Phases of the busbar, one on a balanced feeder, whose meter is named as manipulated; (0,) from
        estimators that believe it or do without.
    busbar_attack : (b,)
        What it reads too much, squared pu; 0 where it is not named; (0,) likewise.
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
    kinds: tuple[Kind | None, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    unjudged: Bools = field(default_factory=_none)
    busbar: Bools = field(default_factory=_none)
    busbar_attack: Floats = field(default_factory=_nothing)
