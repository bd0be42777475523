"""Bound of an estimate, and sentences for the operator.

The bound of the estimate covers all honest errors within their stated limits: an interval, not a probability.
Accuracy classes and power factors err in one direction for years, and all of them may err together. The
bound is a sum of worst cases:

    |v2 - model| <= 2 |R| dp + 2 |X| (dq + e) + losses + busbar      everywhere
    |v2 - y|     <= error of the reading                             at trusted meters

e is the error of the observed injections. Powers reported by customers of suspect meters may be false by the
sizes of `FrameUncertainty`. The busbar voltage is metered, or eliminated by the trusted meters.

References
----------
docs/theory-front.md, section 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import PENDING, Bools, Floats, Ints, all_of, any_of, deferred
from gridsec.estimators.front.design import FrontDesign
from gridsec.estimators.front.measurements import (
    ClockSkew,
    PowerErrors,
    largest_offset,
    unusable_offsets,
)
from gridsec.estimators.plant import NO_VOLTAGE, Plant, busbar_errors
from gridsec.grid.devices import told_error
from gridsec.grid.three_phase import PHASES
from gridsec.interface import Cause, Decision, Estimate, Explanation, Frame, PowerOrigin

# --- Sentences ---


def fault_sentence(design: FrontDesign, k: int, amount: float) -> str:
    """Sentence about one false power with its amount, pu; k: the customer, or N plus the inverter."""
    plant = design.plant
    power = f"{abs(amount) * plant.feeder.base_kva:.1f}"
    if k < design.customers:
        way = "feeds in" if amount > 0 else "draws"
        return f"It looks as if {plant.feeder.customers[k]} {way} {power} kW more than its readings say."
    owner = plant.feeder.customers[plant.droop.customer[k - design.customers]]
    return f"The inverter of {owner} may inject {power} kvar that its curve does not ask for."


def busbar_meter(which: Bools) -> str:
    """Name of the busbar's meter, with the phases `which` (b,) in three phases."""
    if which.size == 1:
        return "the meter of the busbar"
    names = [phase for phase, one in zip(PHASES, which, strict=True) if one]
    return f"the meter of the busbar (phase{'s' * (len(names) > 1)} {', '.join(names)})"


def busbar_deviation(off: Floats, v0_squared: Floats, which: Bools) -> str:
    """Largest deviation of the busbar's meter from the others, (b,) `off` beside `v0_squared`, squared pu."""
    parts = 100.0 * (np.sqrt(np.maximum(1.0 + off / v0_squared, 0.0)) - 1.0)[which]
    worst = float(parts[np.abs(parts).argmax()])
    return f"reads {abs(worst):.1f} % {'more' if worst > 0 else 'less'} than the meters of the feeder say"


def unread_sentence(
    names: tuple[str, ...], which: Bools, origins: Ints, percent: Floats, limit: float
) -> str:
    """Customers without a usable active power, and the precision of the voltage there.

    which, origins, percent: (p,) meters in question, `PowerOrigin`, and standard deviation of the voltage in
    % of nominal. limit: largest permitted one.
    """
    parts = []
    for origin, sentence in _ORIGINS.items():
        here = _where(names, which & (origins == origin))
        if here:
            parts.append(sentence.format(_list(here)))
    return (
        f"{' '.join(parts)} The standard deviation of the voltage there is {percent[which].max():.2g} %; "
        f"`[monitor] unread_std_percent` permits {limit:g} %."
    )


_ORIGINS = {
    PowerOrigin.UNREAD: "No active power from {}.",
    PowerOrigin.LATE: "The active power of {} is older than the voltage.",
    PowerOrigin.BEYOND: "The active power of {} is beyond the declared range.",
}
"""Sentence per origin; `READ` needs none."""


def clock_sentence(names: tuple[str, ...], which: Bools, limit_s: float) -> str:
    """Meters `which` (p,) with readings of another moment."""
    found = _list(_where(names, which))
    return (
        f"The clock offset of {found} is above {limit_s:g} s: no scale compares the readings with the feeder."
    )


def moved_sentence(names: tuple[str, ...], which: Bools) -> str:
    """Meters `which` (p,) with a voltage that changes within the clock offsets."""
    found = _list(_where(names, which))
    return f"The voltage of {found} changes within the clock offsets by more than the accuracy class."


_SHOWN = 5
"""Largest number of explanations in a sentence, and of names in each."""


def explanations_sentence(design: FrontDesign, explanations: tuple[Explanation, ...]) -> str:
    """Possible explanations in one sentence."""
    shown = [_explanation(design, each) for each in explanations[:_SHOWN]]
    if len(explanations) == 1:
        return f"Wrong is {shown[0]}; nothing else explains the readings."
    more, text = len(explanations) - len(shown), " or else ".join(shown)
    each = "both explain" if len(explanations) == 2 else "each of these explains"
    return f"Wrong are either {text}{f' or {more} more' if more else ''}; {each} the readings."


def _explanation(design: FrontDesign, explanation: Explanation) -> str:
    customers, owner = design.plant.feeder.customers, design.plant.droop.customer
    accused = (
        ("meter", _where(design.names, explanation.meters)),
        ("inverter", [customers[c] for c in owner[explanation.inverters]]),
        ("reported power", [customers[c] for c in np.flatnonzero(explanation.powers)]),
    )
    parts = [f"the {what}{'s' * (len(some) > 1)} of {_list(some)}" for what, some in accused if some]
    if explanation.busbar.any():
        parts.append(busbar_meter(explanation.busbar))
    return " and ".join(parts) if parts else "none of them"


def _where(names: tuple[str, ...], which: Bools) -> list[str]:
    return [names[k] for k in np.flatnonzero(which).tolist()]


def _list(names: list[str]) -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


# --- Findings ---

Finding = tuple[Decision, Cause, str]
"""Decision, cause and sentence."""
_LEAST_V2 = 1e-2
"""Least squared voltage that relates a standard deviation to the voltage, pu: a dead bus has none."""


def unvouched(design: FrontDesign, metered: Bools, used: Bools) -> Finding | None:
    """UNDECIDED where too few meters report from a phase without a busbar voltage; None elsewhere.

    metered: (b,) phases with a busbar voltage. used: (p,) meters that are compared with each other.
    """
    if all_of(metered):
        return None
    least = int((design.busbar_incidence > 0.0)[used].sum(axis=0)[~metered].min())
    most = design.most_among(int(used.sum()))
    if least > 2 * most:
        return None
    sentence = (
        f"The busbar voltage of a phase is missing, and {least} meters report from there; "
        f"at least {2 * most + 1} are needed to tell {most} manipulated from the others."
    )
    return Decision.UNDECIDED, Cause.TOO_FEW_METERS, sentence


def imprecise(design: FrontDesign, frame: Frame, unread: Bools, estimate: Estimate) -> Finding | None:
    """UNDECIDED where a voltage beside an unread power is too uncertain; None elsewhere.

    unread: (p,) meters with a reading beside an unread power.
    """
    if not any_of(unread):
        return None
    at, limit = design.plant.meters, design.options.unread_std_percent
    v = np.sqrt(np.maximum(estimate.v2[at], _LEAST_V2))
    percent = 50.0 * estimate.std[at] / (v * design.plant.droop.vbar)
    wide = unread & ~(percent <= limit)
    if not any_of(wide):
        return None
    origins = np.zeros(frame.p.size, dtype=np.intp) if frame.p_origin is None else frame.p_origin
    sentence = unread_sentence(design.names, wide, origins[at], percent, limit)
    return Decision.UNDECIDED, Cause.MISSING_POWERS, sentence


def with_clock_offsets(
    design: FrontDesign, frame: Frame, available: Bools, skew: ClockSkew | None, finding: Finding
) -> Finding:
    """The finding with the meters that clock offsets keep from a comparison.

    Meters with an unusable offset count as silent, and are in the sentence. A change within usable offsets by
    more than the accuracy class is UNDECIDED in place of CLEAN, a single sudden one excepted. available: (p,)
    meters with a reading.
    """
    decision, cause, reason = finding
    if decision is Decision.CLEAN and skew is not None and not skew.single:
        moved = available & (skew.change > design.allowed)
        if not any_of(moved):
            return finding
        return Decision.UNDECIDED, Cause.CLOCK_OFFSET, moved_sentence(design.names, moved)
    far = unusable_offsets(design, frame.clock_offset)
    if far is None or cause not in (Cause.SILENT_METERS, Cause.TOO_FEW_METERS):
        return finding
    sentence = clock_sentence(design.names, far, largest_offset(design))
    if cause is Cause.SILENT_METERS and not any_of(~available & ~far):
        return decision, Cause.CLOCK_OFFSET, sentence
    return decision, cause, f"{reason} {sentence}"


# --- Bound of the estimate ---


@dataclass(frozen=True, slots=True, eq=False)
class BoundInputs:
    """Inputs of the bound of one estimate. N customers, p meters."""

    plant: Plant  # the feeder
    powers: PowerErrors  # power errors of the frame
    injected: Floats  # (m,) largest errors of the observed injections, pu
    model: Floats  # (N,) voltages of the model, squared pu
    busbar: Bools | bool  # busbar phases that are metered
    y: Floats  # (p,) squared readings
    trusted: Bools  # (p,) meters used by the estimate
    checked: Callable[[], Bools]  # meters with a known customer's power, (p,); evaluated with the bound
    sigmas: float  # standard deviations of jitter within an honest reading

    def half_width(self, v2: Floats) -> Floats:
        """Largest distance of the true squared voltages from v2, (N,), pu."""
        plant, at = self.plant, self.plant.meters
        injected = plant.droop.per_customer(self.injected, plant.feeder.bus.size)
        lost, correction = self.powers.loss_error(plant, injected)
        spread = np.minimum(self.powers.linear_error(plant, injected) + lost, NO_VOLTAGE)
        reading, use = told_error(plant.accuracy, self.y, self.sigmas), self.trusted & self.checked()
        ends = self._busbar(spread, reading, use)
        low, high = (plant.feeder.broadcast_busbar(end)[plant.feeder.bus] for end in ends)
        # The loss correction is that of the assumed busbar voltage.
        moved = np.minimum(np.maximum(np.abs(low), np.abs(high)), NO_VOLTAGE)
        base = plant.feeder.broadcast_busbar(self.powers.v0_squared)[plant.feeder.bus]
        spread = spread + np.abs(correction) * moved / np.maximum(base - moved, _LEAST_BUSBAR)
        low, high = self.model + low - spread, self.model + high + spread
        own = np.where(use, reading, np.inf)
        low[at], high[at] = _intersection(low[at], high[at], self.y - own, self.y + own)
        return np.minimum(np.maximum(high - v2, v2 - low), NO_VOLTAGE)

    def _busbar(self, spread: Floats, reading: Floats, use: Bools) -> tuple[Floats, Floats]:
        """Interval of the busbar's squared voltage about the assumed one: by its meter, and by the others."""
        plant, at = self.plant, self.plant.meters
        known = np.atleast_1d(busbar_errors(plant, self.powers.v0_squared, self.sigmas))
        known = np.where(self.busbar, known, np.inf)
        off, room = self.y - self.model[at], np.where(use, reading + spread[at], np.inf)
        reach = np.where(plant.feeder.busbar_incidence()[at] > 0.0, room[:, None], np.inf)
        low = (off[:, None] - reach).max(axis=0, initial=-np.inf)
        high = (off[:, None] + reach).min(axis=0, initial=np.inf)
        return _intersection(-known, known, low, high)


_LEAST_BUSBAR = 0.1
"""Least squared busbar voltage of the loss correction, pu."""


def _intersection(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> tuple[Floats, Floats]:
    """Intersection of two intervals; their hull where they do not meet."""
    below, above = np.maximum(low, other_low), np.minimum(high, other_high)
    apart = below > above
    return (
        np.where(apart, np.minimum(low, other_low), below),
        np.where(apart, np.maximum(high, other_high), above),
    )


class BoundedEstimate(Estimate):
    """Estimate with a bound computed on first access, which takes half a step.

    It keeps the arrays of its frame, which must not be changed.
    """

    __slots__ = ("_grounds",)
    _grounds: BoundInputs

    @classmethod
    def of(
        cls, grounds: BoundInputs, t: float, v2_bus: Floats, variance: Floats, x: Floats
    ) -> BoundedEstimate:
        """Estimate at Unix time t, s, with variance (n,) at every place."""
        bus = grounds.plant.feeder.bus
        made = cls(t, v2_bus[bus], PENDING, v2_bus, grounds.trusted, x, np.sqrt(variance[bus]))
        object.__setattr__(made, "_grounds", grounds)
        return made

    @deferred(Estimate)
    def bound(self) -> Floats:
        """Half-width of the interval around `v2` that contains the truth within the stated errors, (N,)."""
        return self._grounds.half_width(self.v2)
