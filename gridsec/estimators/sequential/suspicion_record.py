"""Record of suspects that survives a restart.

Means over many ticks are empty after a restart, and small manipulations that only long means show would pass
for honest. A detection therefore stands until its scale has enough readings for another result.

References
----------
docs/theory-sequential.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.sequential.busbar_meter import BusbarTrust
from gridsec.estimators.sequential.confirmation import MAX_INVERTER_TICKS
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.replay import BLOCKS, ROWS, detection_readings
from gridsec.estimators.sequential.state import SequentialState
from gridsec.estimators.sequential.time_scales import min_readings


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
        return (
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
    def empty(meters: int, inverters: int, phases: int = 1) -> SuspicionRecord:
        """Record without suspects."""
        no, none, here = (np.zeros(count, dtype=np.bool_) for count in (meters, inverters, phases))
        never = np.full(meters, np.nan)
        return SuspicionRecord(never, never, no, none, np.full(phases, np.nan), here, np.zeros(phases))


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
        _settling(design, state),
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


def _settling(design: SequentialDesign, state: SequentialState) -> Ints:
    """Ticks until the unknown initial state is negligible at each meter, (p,)."""
    least = design.options.settled * np.maximum(state.learned.allowed, np.finfo(np.float64).tiny)
    more = np.log(np.maximum(design.inverter_reach / least, 1.0))
    rate = design.certificate.rate * design.step_s
    return np.asarray(np.where(more > 0.0, np.ceil(more / rate), 0.0)).astype(np.intp)
