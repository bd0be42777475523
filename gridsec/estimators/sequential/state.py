"""State of the sequential monitor between frames: trust of the meters, and its record over a restart.

A meter becomes a suspect by a search or by repeating its readings. It is named by confirmation, and trusted
again after `release` successive readings without evidence, once it has given the readings that it owes. Its
age falls to zero only after the longest scale without evidence.

Means over many ticks are empty after a restart, and small manipulations that only long means show would pass
for honest. A detection therefore stands until its scale has enough readings for another result.

References
----------
docs/theory-sequential.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, all_of, any_of
from gridsec.estimators.plant import NO_VOLTAGE, Plant
from gridsec.estimators.sequential.attack_kind import AttackKinds, no_kinds
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.device_checks import BusbarTrust, InverterChecks, trusted_busbar
from gridsec.estimators.sequential.device_checks import no_checks as no_curves
from gridsec.estimators.sequential.measurements import (
    BusbarHistory,
    ClockSkew,
    FrameUncertainty,
    PowerErrors,
    nominal_uncertainty,
)
from gridsec.estimators.sequential.meter_bias import Commission, Learned, Learning, initial
from gridsec.estimators.sequential.meter_bias import renew as learn_anew
from gridsec.estimators.sequential.posterior import DoubtedPowers, Posterior, VouchedPosterior
from gridsec.estimators.sequential.reading_history import BLOCKS, ROWS, detection_readings, forget_readings
from gridsec.estimators.sequential.time_scales import Window, empty, forget, min_readings
from gridsec.interface import Estimate, Frame, Verdict
from gridsec.observers.lure import Lure, LureTransition

MAX_INVERTER_TICKS = 12
"""Largest count of an inverter's accusations.

The count rises at a tick that accuses it and falls at others with a trusted reading of a witness.
"""


@dataclass(frozen=True, slots=True, eq=False)
class TrustState:
    """Trust of meters and inverters. p meters, m inverters, s scales."""

    trusted: Bools  # (p,) meters used by the estimate
    scale: Ints  # (p,) scale of the detection of each suspect
    ticks_suspect: Ints  # (p,) ticks as a suspect; reset after the longest scale without evidence
    ticks_clear: Ints  # (p,) readings without evidence
    above_limit: Bools  # (s, p) residual above the limit at the last look
    above_release_limit: Bools  # (s, p) residual above the release limit at the last look
    readings_owed: Ints  # (p,) readings a suspect of an earlier run owes before its scale can release it
    repeat_lag: Ints  # (p,) ticks after which a suspect repeats its readings, 1 if stuck, 0 if none
    named: Bools  # (p,) meters named as manipulated
    accused: tuple[tuple[int, int], ...]  # other suspicions: index of the fault dictionary, scale
    inverter_ticks: Ints  # (m,) ticks that accuse each inverter, less those that do not
    inverters: Bools  # (m,) inverters named as manipulated
    clear: bool = field(init=False)  # derived: no suspicion, now or within the longest scale

    def __post_init__(self) -> None:
        # Later in-place writes concern meters that are not trusted: the state is not clear then either.
        evidence = any_of(self.above_limit) or any_of(self.above_release_limit)
        named = any_of(self.named) or any_of(self.inverters)
        lately = bool(self.accused) or any_of(self.ticks_suspect) or any_of(self.inverter_ticks)
        object.__setattr__(self, "clear", all_of(self.trusted) and not (evidence or named or lately))

    @staticmethod
    def initial(meters: int, inverters: int, scales: int) -> TrustState:
        """Every meter and inverter trusted."""
        zero, no = np.zeros(meters, dtype=np.intp), np.zeros(meters, dtype=np.bool_)
        none = np.zeros((scales, meters), dtype=np.bool_)
        ticks, named = np.zeros(inverters, dtype=np.intp), np.zeros(inverters, dtype=np.bool_)
        return TrustState(~no, zero, zero, zero, none, none, zero, zero, no, (), ticks, named)

    def writable(self) -> TrustState:
        """Copy with evidence that `record` can write."""
        return replace(
            self, above_limit=self.above_limit.copy(), above_release_limit=self.above_release_limit.copy()
        )

    def record(self, s: int, enough: Bools, above_limit: Bools, above_release_limit: Bools) -> None:
        """Write the evidence of scale s, (p,) each; with too few readings it keeps its earlier detection."""
        owed = (self.readings_owed > 0) & (self.scale == s)
        stands = np.where(enough, above_release_limit, self.above_release_limit[s]) | owed
        self.above_limit[s], self.above_release_limit[s] = above_limit & ~self.trusted, stands & ~self.trusted

    def suspected(self, trusted: Bools, s: int, accused: tuple[tuple[int, int], ...]) -> TrustState:
        """After a search on scale s: `trusted` (p,) meters, and accused faults with their scales."""
        new = self.trusted & ~trusted
        scale, ticks = np.where(new, s, self.scale), np.where(new, 0, self.ticks_clear)
        return replace(self, trusted=trusted, scale=scale, ticks_clear=ticks, accused=accused)

    def repeating(self, lags: Ints) -> TrustState:
        """With meters that repeat their readings, lags (p,) > 0, named."""
        if not any_of(lags):
            return self
        which = lags > 0
        return replace(
            self,
            trusted=self.trusted & ~which,
            ticks_clear=np.where(which, 0, self.ticks_clear),
            above_release_limit=self.above_release_limit | which,
            repeat_lag=np.where(which, lags, self.repeat_lag),
            named=self.named | which,
        )

    def without_evidence(self, meters: Bools) -> TrustState:
        """Without the evidence against some meters, (p,)."""
        return replace(
            self,
            above_limit=self.above_limit & ~meters,
            above_release_limit=self.above_release_limit & ~meters,
        )

    def counted(self, named: Bools, available: Bools, release: int, longest: int) -> TrustState:
        """With one more tick counted, and meters released after `release` readings without evidence.

        named: (p,) at the last tick. available: (p,) meters with a reading; silence releases none. longest:
        ticks of the longest scale.
        """
        clear = np.where(self.above_release_limit.any(axis=0), 0, self.ticks_clear + available)
        trusted = (self.trusted & ~named) | (clear >= release)
        # A meter detected again within the longest scale keeps its age.
        suspect = np.where(trusted & (clear > longest), 0, self.ticks_suspect + ~trusted)
        return replace(
            self,
            trusted=trusted,
            ticks_suspect=suspect,
            ticks_clear=clear,
            readings_owed=np.where(trusted, 0, np.maximum(self.readings_owed - available, 0)),
            repeat_lag=np.where(trusted, 0, self.repeat_lag),
            named=named & (clear < release),
        )

    def with_names(self, meters: Bools, inverter_ticks: Ints, inverters: Bools) -> TrustState:
        """With newly named meters, (p,), and the counts and names of the inverters, (m,)."""
        named = self.named | meters
        return replace(self, named=named, inverter_ticks=inverter_ticks, inverters=inverters)

    def without_names(self, meters: Bools) -> TrustState:
        """Without the names of some meters, (p,)."""
        return replace(self, named=self.named & ~meters) if any_of(meters) else self

    def replaced(self, meters: Bools) -> TrustState:
        """After some meters, (p,), were replaced: trusted, without evidence."""
        clear = self.without_evidence(meters)
        return replace(
            clear,
            trusted=self.trusted | meters,
            ticks_suspect=np.where(meters, 0, self.ticks_suspect),
            ticks_clear=np.where(meters, 0, self.ticks_clear),
            readings_owed=np.where(meters, 0, self.readings_owed),
            repeat_lag=np.where(meters, 0, self.repeat_lag),
            named=self.named & ~meters,
        )


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
class SequentialState:
    """State between frames. N customers, m inverters, p meters, s scales."""

    t: float  # time of the last frame used, s
    frame: Frame | None  # last frame used; None before the first
    ticks: int  # frames used
    x: Floats | None  # (m,) injections, pu; None before the first frame
    transient: Floats  # (p,) remainder of unknown injections in the squared voltages of the meters, pu
    model_driven: ModelDriven | None  # prepared loop of the inverters without a trusted meter
    injection_error: InjectionError  # errors of the injections
    v0_squared: Floats | float  # last trusted squared busbar voltage, pu; (3,) in three phases
    busbar: BusbarTrust  # trust of the busbar's meter
    window: Window  # residuals of the last ticks
    trust: TrustState  # trust of the meters
    posteriors: tuple[Posterior | None, ...]  # (s,) of the trusted meters; None without a test
    full_posteriors: tuple[Posterior | None, ...]  # (s,) kept, of all meters that reported
    vouched_posteriors: tuple[VouchedPosterior | None, ...]  # (s,) without meters that withhold a power
    inconsistent: tuple[bool, ...]  # (s,) trusted meters inconsistent at the last look, after the search
    doubted_powers: (
        DoubtedPowers | None
    )  # posterior with doubted powers of the suspects; None without suspects
    uncertainty: FrameUncertainty  # uncertainty of the frames
    clock_skew: ClockSkew | None  # voltage changes within clock offsets; None while no offset is measured
    busbar_history: (
        BusbarHistory | None
    )  # readings for the busbar's clock offset; None while it is not measured
    learning: Learning | None  # sums of the commissioning; None once complete
    learned: Learned  # fixed errors of the meters
    model_error: Floats  # (p,) largest error of the model, squared pu
    voltage_swing: float  # largest change of a squared voltage by powers when `model_error` was computed, pu
    inverter_checks: InverterChecks  # comparison of metered reactive powers with the droop curves
    attack_kinds: AttackKinds  # reading history and kinds of the manipulations
    last: tuple[Estimate, Verdict] | None  # last output

    @property
    def commission(self) -> Commission:
        """Fixed errors of the meters, known and being learned."""
        return Commission(self.learned, self.learning)


def init(
    design: SequentialDesign, t: float, learned: Learned | None = None, learning: Learning | None = None
) -> SequentialState:
    """Initial state at Unix time t, s, with errors learned before; the observer starts at the first frame."""
    known = initial(design, t) if learned is None else Commission(learned, learning)
    p, s = design.plant.meters.size, len(design.lengths)
    m = design.plant.droop.tau.size
    return SequentialState(
        t=t,
        frame=None,
        ticks=0,
        x=None,
        transient=design.inverter_reach,
        model_driven=None,
        injection_error=unknown_injections(design.plant, np.zeros(m)),
        v0_squared=design.plant.droop.vbar**2,
        busbar=trusted_busbar(design.busbar_incidence.shape[1]),
        window=empty(design.lengths, p),
        trust=TrustState.initial(p, m, s),
        posteriors=(None,) * s,
        full_posteriors=(None,) * s,
        vouched_posteriors=(None,) * s,
        inconsistent=(False,) * s,
        doubted_powers=None,
        uncertainty=nominal_uncertainty(design),
        clock_skew=None,
        busbar_history=None,
        learning=known.learning,
        learned=known.learned,
        model_error=np.zeros(p),
        voltage_swing=0.0,
        inverter_checks=no_curves(p, m),
        attack_kinds=no_kinds(p),
        last=None,
    )


def renew(design: SequentialDesign, state: SequentialState, which: Bools) -> SequentialState:
    """State after meters `which` (p,) were replaced: trusted again, with their errors to be learned."""
    known = learn_anew(design, state.commission, which, state.t)
    return replace(
        state,
        learned=known.learned,
        learning=known.learning,
        window=forget(state.window, which),
        posteriors=(None,) * len(state.posteriors),
        inverter_checks=state.inverter_checks.without_meters(which),
        attack_kinds=replace(state.attack_kinds, history=forget_readings(state.attack_kinds.history, which)),
        trust=state.trust.replaced(which),
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


def observed(design: SequentialDesign, state: SequentialState) -> ObserverRecord | None:
    """Observer of a state; None before the first frame, and where no inverter moves a meter."""
    reach, before = design.inverter_reach, state.injection_error
    if state.x is None or not any_of(reach > 0.0):
        return None
    error = np.divide(before.error, before.span, out=np.zeros_like(before.span), where=before.span > 0.0)
    left = np.divide(state.transient, reach, out=np.zeros_like(reach), where=reach > 0.0)
    return ObserverRecord(
        state.t, state.x, before.input, min(float(error.max()), 1.0), min(float(left.max()), 1.0)
    )


def resume(design: SequentialDesign, state: SequentialState, before: ObserverRecord) -> SequentialState:
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


def settling_s(design: SequentialDesign) -> float:
    """Time until unknown injections are negligible at every meter within its class, s; whole ticks."""
    return float(_ticks_to_settle(design, design.allowed).max(initial=0)) * design.step_s


# --- Record of suspects that survives a restart ---


@dataclass(frozen=True, slots=True, eq=False)
class SuspicionRecord:
    """Suspects. p meters, m inverters, b busbar phases (1 on a balanced feeder)."""

    scale_s: Floats  # (p,) time scale of each suspect's detection, s; NaN for trusted meters
    repeats_s: Floats  # (p,) time after which a suspect repeats its readings, s; NaN for others
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


def distrusted(design: SequentialDesign, state: SequentialState) -> SuspicionRecord:
    """Suspects of a state after a tick."""
    trust = state.trust
    inverters = trust.inverters if state.last is None else state.last[1].inverters
    busbar = state.busbar
    if trust.trusted.all() and busbar.trusted.all() and not inverters.any():
        return SuspicionRecord.empty(trust.trusted.size, inverters.size, busbar.trusted.size)
    scales_s = np.array(design.lengths) * design.step_s
    # Repetition shows on no scale; the longest one tests such a meter.
    repeats = ~trust.trusted & (trust.repeat_lag > 0)
    scale = np.where(repeats, len(design.lengths) - 1, trust.scale)
    return SuspicionRecord(
        np.where(trust.trusted, np.nan, scales_s[scale]),
        np.where(repeats, trust.repeat_lag * design.step_s, np.nan),
        trust.named,
        inverters,
        np.where(busbar.trusted, np.nan, scales_s[busbar.scale]),
        busbar.named,
        busbar.off,
    )


def warm_start(design: SequentialDesign, state: SequentialState, before: SuspicionRecord) -> SequentialState:
    """State from `init` with the suspects of an earlier run.

    A meter is released as always, but not before it has given the readings that its scale needs and the
    observer has settled; one that repeated itself, not before a repetition would be detected; a named
    inverter, not before the longest scale has its readings. The busbar's meter is compared with the others
    from its earlier mean.
    """
    if before.is_empty:
        return state
    trust, which = state.trust, np.isfinite(before.scale_s)
    scale = _closest(design, before.scale_s)
    need, settling = (
        np.array([min_readings(design, s) for s in range(len(design.lengths))]),
        _ticks_to_settle(design, state.learned.allowed),
    )
    still = trust.above_release_limit.copy()
    still[scale[which], np.flatnonzero(which)] = True
    repeats = np.isfinite(before.repeats_s)
    ticks = np.where(repeats, np.rint(before.repeats_s / design.step_s), 0.0)
    lag = np.where(repeats, np.clip(ticks, 1.0, ROWS * BLOCKS), 0.0).astype(np.intp)
    owed = np.maximum(np.maximum(need[scale], settling), detection_readings(design.references.limits, lag))
    longest = max(int(need[-1]), int(settling.max(initial=0)))
    return replace(
        state,
        busbar=_busbar(design, before, need, int(settling.max(initial=0))),
        trust=replace(
            trust,
            trusted=~which,
            scale=scale,
            ticks_suspect=np.where(before.named, design.confirmed[scale], which),
            above_release_limit=still,
            readings_owed=np.where(which, owed, 0),
            repeat_lag=np.where(which, lag, 0),
            named=before.named & which,
            inverter_ticks=np.where(before.inverters, longest + MAX_INVERTER_TICKS, 0),
            inverters=before.inverters,
        ),
    )


def _busbar(design: SequentialDesign, before: SuspicionRecord, need: Ints, settling: int) -> BusbarTrust:
    """Trust of the busbar's meter from a record."""
    out = np.isfinite(before.busbar_scale_s)
    scale = _closest(design, before.busbar_scale_s)
    known = before.busbar_named & out
    # The mean continues over the whole of its scale.
    length = np.maximum(design.confirmed, design.lengths)[scale]
    return BusbarTrust(
        trusted=~out,
        scale=scale,
        ticks_suspect=np.where(known, length, 0),
        ticks_agreeing=np.where(out, -np.maximum(need[scale], settling), 0),
        off=np.where(known, before.busbar_off, 0.0),
        named=known,
    )


def _closest(design: SequentialDesign, scale_s: Floats) -> Ints:
    """Scales closest to those of the detections, 0 for NaN: they may have changed since."""
    scales_s = np.array(design.lengths) * design.step_s
    far = np.abs(np.log(np.where(np.isfinite(scale_s), scale_s, scales_s[0])[:, None] / scales_s))
    return np.asarray(far.argmin(axis=1))


def _ticks_to_settle(design: SequentialDesign, allowed: Floats) -> Ints:
    """Ticks until unknown injections are negligible beside the `allowed` errors of the meters, (p,)."""
    least = design.options.settled * np.maximum(allowed, np.finfo(np.float64).tiny)
    more = np.log(np.maximum(design.inverter_reach / least, 1.0))
    rate = design.certificate.rate * design.step_s
    return np.asarray(np.where(more > 0.0, np.ceil(more / rate), 0.0)).astype(np.intp)
