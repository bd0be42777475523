"""State of the front end between frames, and the records of it that survive a restart.

References
----------
docs/theory-front.md, sections 2 and 6.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.front.attack_kind import AttackKinds, no_kinds
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.device_checks import BusbarTrust, InverterChecks, no_checks, trusted_busbar
from gridsec.estimators.front.measurements import (
    BusbarHistory,
    ClockSkew,
    FrameUncertainty,
    PowerErrors,
    nominal_uncertainty,
)
from gridsec.estimators.front.meter_bias import Commission, Learned, Learning, initial
from gridsec.estimators.plant import NO_VOLTAGE, Plant, nothing_new
from gridsec.interface import Estimate, Frame, Verdict
from gridsec.observers.lure import Lure, LureTransition


@dataclass(frozen=True, slots=True, eq=False)
class TrustState:
    """Trust of the meters. p meters."""

    trusted: Bools  # (p,) meters used by the estimate
    named: Bools  # (p,) meters named as manipulated

    @staticmethod
    def initial(meters: int) -> TrustState:
        """Every meter trusted."""
        no = np.zeros(meters, dtype=np.bool_)
        return TrustState(~no, no)

    @property
    def clear(self) -> bool:
        """True if no meter is suspect or named."""
        return all_of(self.trusted) and not any_of(self.named)

    def replaced(self, meters: Bools) -> TrustState:
        """After some meters, (p,), were replaced: trusted, not named."""
        return TrustState(self.trusted | meters, self.named & ~meters)


# --- Errors of the injections ---


@dataclass(frozen=True, slots=True, eq=False)
class InjectionError:
    """Errors of the observed injections. m inverters."""

    error: Floats  # (m,) half-widths, pu
    input: Floats  # (m,) squared voltage at each input at the last frame, pu
    width: Floats  # (m,) largest error of that, squared pu
    span: Floats  # (m,) distance between the saturated values of each curve, pu: no error is larger

    def reset(self, which: Bools) -> InjectionError:
        """Errors with inverters `which` (m,) at their span: a manipulated meter drove them."""
        return replace(self, error=np.where(which, self.span, self.error)) if any_of(which) else self


def unknown_injections(plant: Plant, given: Floats) -> InjectionError:
    """Errors before the first frame: injections within saturation. given: (m,) inputs, squared pu."""
    span = plant.droop.span
    return InjectionError(span, given, np.full(span.size, NO_VOLTAGE), span)


# --- State between frames ---


@dataclass(frozen=True, slots=True, eq=False)
class ModelDriven:
    """Prepared loop of the model-driven inverters, reused for the same inverters and step."""

    rows: Ints  # (k,) inverters
    loop: Lure  # their mutual loop; its input is the effect of all other injections and loads
    transition: LureTransition  # of the loop, for the last step's length


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """One frame by the model. m inverters, n places, p meters."""

    x: Floats  # (m,) injections of the inverters, pu
    model_driven: ModelDriven | None  # prepared loop of the inverters without a trusted meter
    injection_error: InjectionError  # errors of the injections
    powers: PowerErrors  # net injections of the model, and their errors
    v2_bus: Floats  # (n,) squared voltages, pu
    transient: Floats  # (p,) remainder of unknown injections, squared pu


@dataclass(frozen=True, slots=True, eq=False)
class FrontState:
    """State between frames. N customers, m inverters, p meters."""

    t: float  # time of the last frame used, s
    frame: Frame | None  # last frame used; None before the first
    ticks: int  # frames used
    x: Floats | None  # (m,) injections, pu; None before the first frame
    transient: Floats  # (p,) remainder of unknown injections in the squared voltages of the meters, pu
    model_driven: ModelDriven | None  # prepared loop of the inverters without a trusted meter
    injection_error: InjectionError  # errors of the injections
    v0_squared: Floats | float  # last trusted squared busbar voltage, pu; (3,) in three phases
    busbar: BusbarTrust  # trust of the busbar's meter
    trust: TrustState  # trust of the meters
    uncertainty: FrameUncertainty  # uncertainty of the frames
    model: Floats | None  # (p,) squared voltages of the model at the meters, pu; None before the first frame
    clock_skew: ClockSkew | None  # voltage changes within clock offsets; None while none counts
    busbar_history: (
        BusbarHistory | None
    )  # readings for the busbar's clock offset; None while it is not measured
    learning: Learning | None  # sums of the commissioning; None once complete
    learned: Learned  # fixed errors of the meters
    inverter_checks: InverterChecks  # comparison of metered reactive powers with the droop curves
    attack_kinds: AttackKinds  # reading history and kinds of the manipulations
    last: tuple[Estimate, Verdict] | None  # last output


def repeated(design: FrontDesign, state: FrontState, frame: Frame) -> tuple[Estimate, Verdict] | None:
    """Answer of `plant.nothing_new` to a frame that is not later than the last one; None for a later one."""
    if np.isfinite(frame.t) and (state.x is None or frame.t > state.t):
        return None
    none = np.zeros(design.plant.droop.tau.size)
    estimate, answer = nothing_new(design.plant, frame, state.t, state.last, state.v0_squared, none)
    return (replace(estimate, std=estimate.bound) if state.last is None else estimate), answer


def init(
    design: FrontDesign, t: float, learned: Learned | None = None, learning: Learning | None = None
) -> FrontState:
    """Initial state at Unix time t, s, with errors learned before; the observer starts at the first frame."""
    known = initial(design, t) if learned is None else Commission(learned, learning)
    p, m = design.plant.meters.size, design.plant.droop.tau.size
    return FrontState(
        t=t,
        frame=None,
        ticks=0,
        x=None,
        transient=design.inverter_reach,
        model_driven=None,
        injection_error=unknown_injections(design.plant, np.zeros(m)),
        v0_squared=design.plant.droop.vbar**2,
        busbar=trusted_busbar(design.busbar_incidence.shape[1]),
        trust=TrustState.initial(p),
        uncertainty=nominal_uncertainty(design),
        model=None,
        clock_skew=None,
        busbar_history=None,
        learning=known.learning,
        learned=known.learned,
        inverter_checks=no_checks(p, m),
        attack_kinds=no_kinds(p),
        last=None,
    )


# --- Record of the observer that survives a restart ---


@dataclass(frozen=True, slots=True, eq=False)
class ObserverRecord:
    """Observer of the inverters after a frame. m inverters."""

    t: float  # time of the frame, s
    x: Floats  # (m,) injections, pu
    input: Floats  # (m,) squared voltage at each inverter, pu
    error: float  # largest error of an injection, as a part of its span
    transient: float  # largest remainder of unknown injections, as a part of their whole effect on a meter


def observed(design: FrontDesign, state: FrontState) -> ObserverRecord | None:
    """Observer of a state; None before the first frame, and where no inverter moves a meter."""
    reach, before = design.inverter_reach, state.injection_error
    if state.x is None or not any_of(reach > 0.0):
        return None
    error = np.divide(before.error, before.span, out=np.zeros_like(before.span), where=before.span > 0.0)
    left = np.divide(state.transient, reach, out=np.zeros_like(reach), where=reach > 0.0)
    return ObserverRecord(
        state.t, state.x, before.input, min(float(error.max()), 1.0), min(float(left.max()), 1.0)
    )


def resume(design: FrontDesign, state: FrontState, before: ObserverRecord) -> FrontState:
    """State from `init` with the observer of an earlier run; the same state if the record is too old.

    The time since the record is a pause, and ends with the first frame. Nothing is assumed about the voltages
    in it: until then the errors of the injections approach their spans. `step` adds the effect of the change
    of the voltages to the transient, so that the verdict stays UNDECIDED where it matters.

    A record is too old after `settling_s`, when the inverters have forgotten it, and unless it precedes
    `state.t`, the time of the first frame.
    """
    if not 0.0 < state.t - before.t <= settling_s(design):
        return state
    span = design.plant.droop.span
    unknown = np.full(span.size, NO_VOLTAGE)
    return replace(
        state,
        t=before.t,
        x=before.x,
        injection_error=InjectionError(before.error * span, before.input, unknown, span),
        transient=before.transient * design.inverter_reach,
    )


# --- Record of suspects that survives a restart ---


@dataclass(frozen=True, slots=True, eq=False)
class SuspicionRecord:
    """Suspects. p meters, m inverters, b busbar phases (1 on a balanced feeder)."""

    scale_s: Floats  # (p,) time scale of each suspect's detection, s; NaN for trusted meters
    repeats_s: Floats  # (p,) time after which it repeats its readings, s; NaN for others, and in new records
    named: Bools  # (p,) meters named as manipulated; all of them are suspects
    inverters: Bools  # (m,) inverters named as manipulated
    busbar_scale_s: Floats = field(default_factory=lambda: np.full(1, np.nan))  # (b,) s; NaN if trusted
    busbar_named: Bools = field(default_factory=lambda: np.zeros(1, dtype=np.bool_))  # (b,) named
    busbar_off: Floats = field(default_factory=lambda: np.zeros(1))  # (b,) excess reading, squared pu

    @property
    def is_empty(self) -> bool:
        """True if every meter, inverter and busbar phase is trusted."""
        scales_s = (self.scale_s, self.busbar_scale_s)
        return not (self.inverters.any() or any(np.isfinite(scale_s).any() for scale_s in scales_s))

    def same(self, other: SuspicionRecord) -> bool:
        """True if the suspects are the same; the deviation of the busbar's meter does not count."""
        return self is other or (
            np.array_equal(self.scale_s, other.scale_s, equal_nan=True)
            and np.array_equal(self.repeats_s, other.repeats_s, equal_nan=True)
            and np.array_equal(self.named, other.named)
            and np.array_equal(self.inverters, other.inverters)
            and np.array_equal(self.busbar_scale_s, other.busbar_scale_s, equal_nan=True)
            and np.array_equal(self.busbar_named, other.busbar_named)
        )

    def without(self, which: Bools) -> SuspicionRecord:
        """Record without meters that were replaced, (p,)."""
        scale_s, repeats_s = (np.where(which, np.nan, each) for each in (self.scale_s, self.repeats_s))
        return replace(self, scale_s=scale_s, repeats_s=repeats_s, named=self.named & ~which)

    @staticmethod
    @lru_cache(maxsize=256)
    def empty(meters: int, inverters: int, phases: int = 1) -> SuspicionRecord:
        """Record without suspects; its arrays are read-only."""
        no, none, here = (np.zeros(count, dtype=np.bool_) for count in (meters, inverters, phases))
        never, unnamed, off = np.full(meters, np.nan), np.full(phases, np.nan), np.zeros(phases)
        for each in (no, none, here, never, unnamed, off):
            each.flags.writeable = False
        return SuspicionRecord(never, never, no, none, unnamed, here, off)


_DETECTED_S = 60.0
"""Time scale of the detection that a record states, s."""


def distrusted(design: FrontDesign, state: FrontState) -> SuspicionRecord:
    """Suspects of a state after a tick."""
    trust, busbar = state.trust, state.busbar
    inverters = np.zeros(design.plant.droop.tau.size, dtype=np.bool_)
    if state.last is not None:
        inverters = state.last[1].inverters
    if all_of(trust.trusted) and all_of(busbar.trusted) and not any_of(inverters):
        return SuspicionRecord.empty(trust.trusted.size, inverters.size, busbar.trusted.size)
    return SuspicionRecord(
        np.where(trust.trusted, np.nan, _DETECTED_S),
        np.full(trust.trusted.size, np.nan),
        trust.named,
        inverters,
        np.where(busbar.trusted, np.nan, design.busbar_ticks * design.step_s),
        busbar.named,
        busbar.off,
    )


def warm_start(design: FrontDesign, state: FrontState, before: SuspicionRecord) -> FrontState:
    """State from `init` with the suspects of an earlier run, and the named phases of its busbar meter.

    A phase is trusted again as always, but not before the observer has settled. Its meter is compared with
    the others from its earlier mean.
    """
    which = np.isfinite(before.scale_s)
    out = before.busbar_named & np.isfinite(before.busbar_scale_s)
    settling = _ticks_to_settle(design, state.learned.allowed)
    owed = max(design.busbar_ticks, int(settling.max(initial=0)))
    return replace(
        state,
        busbar=BusbarTrust(
            trusted=~out,
            ticks_suspect=np.where(out, design.busbar_ticks, 0),
            ticks_agreeing=np.where(out, -owed, 0),
            off=np.where(out, before.busbar_off, 0.0),
        ),
        trust=TrustState(trusted=~which, named=before.named & which),
    )


def settling_s(design: FrontDesign) -> float:
    """Time until unknown injections are negligible at every meter within its class, s; whole ticks."""
    return float(_ticks_to_settle(design, design.allowed).max(initial=0)) * design.step_s


def _ticks_to_settle(design: FrontDesign, allowed: Floats) -> Ints:
    """Ticks until unknown injections are negligible beside the `allowed` errors of the meters, (p,)."""
    least = design.options.settled * np.maximum(allowed, np.finfo(np.float64).tiny)
    more = np.log(np.maximum(design.inverter_reach / least, 1.0))
    rate = design.certificate.rate * design.step_s
    return np.asarray(np.where(more > 0.0, np.ceil(more / rate), 0.0)).astype(np.intp)
