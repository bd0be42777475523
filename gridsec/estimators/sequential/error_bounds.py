"""Bounds of the estimate under all honest errors within their stated limits: intervals, not probabilities.

Accuracy classes and power factors err in one direction for years, and all of them may err together. The
bound is a sum of worst cases:

    |v2 - model| <= 2 |R| dp + 2 |X| (dq + e) + losses + busbar      everywhere
    |v2 - y|     <= error of the reading                             at trusted meters

e is the error of the observed injections. Every ``|e_i|`` is a first-order lag of its input error,

    tau_i |e_i|' <= -|e_i| + min(span_i, d_i (input error + hold) + mismatch),

with `hold` the change of the inverter's voltage between frames; saturation keeps it finite. The input is a
reading of a trusted meter or the model. Assumptions: inverters follow their curves, and a voltage stays
between its values at two successive frames.

Powers reported by customers of suspect meters may be false by the sizes of the fault dictionary. The busbar
voltage is metered, or eliminated by the trusted meters (docs/theory-sequential.md, section 7;
docs/theory-detection.md for the lag and for `mismatch`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, any_of
from gridsec.estimators.inputs import NO_VOLTAGE, busbar_errors, losses
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.grid.meter import told_error
from gridsec.interface import Estimate, Frame

FALSE_Q = 0.5
"""Largest reactive power per active power of a false report."""

_ITERATIONS = 2
"""Iterations of the monotone map of the model-driven inverters, from above."""


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


@dataclass(frozen=True, slots=True, eq=False)
class PowerErrors:
    """Powers of one frame and their errors. N customers, p meters."""

    frame: Frame  # with possible powers
    q: Floats  # (N,) net reactive injections of the model, observed ones included, pu
    uses_q: Bools  # (N,) metered net reactive power is used: observed injections do not matter
    v0_squared: Floats | float  # squared busbar voltage, pu; (3,) in three phases
    trusted: Bools  # (p,) trusted meters: powers of the other customers may be false
    sizes: Floats  # (k,) standard deviation of each fault of the dictionary, pu

    def linear_error(self, plant: Plant, injected: Floats) -> Floats:
        """Largest error of the linear model at each customer for a known busbar voltage, (N,).

        injected: (N,) largest errors of the inverters' injections, pu; also in `loss_error` and `errors`.
        """
        return plant.feeder.reach(*self.errors(plant, injected))[plant.feeder.bus]

    def loss_error(self, plant: Plant, injected: Floats) -> tuple[Floats, Floats]:
        """Largest error of the loss correction at each customer, (N,), and the correction."""
        p_error, q_error = self.errors(plant, injected)
        v0 = self.v0_squared
        correction, off = losses(plant, self.frame.p, self.q, v0, p_error=p_error, q_error=q_error)
        return off, correction[plant.feeder.bus]

    def report_effect(self, plant: Plant, which: Bools) -> Floats:
        """Effect of customers' reports `which` (N,) at each meter, without that of active power, (p,).

        This remains of a false report beside its direction in the fault dictionary: reactive power and
        losses.
        """
        if not any_of(which):
            return np.zeros(plant.meters.size)
        p, q = (np.stack([of, np.where(which, 0.0, of)]) for of in (self.frame.p, self.q))
        with np.errstate(all="ignore"):
            all_ = plant.feeder.bus_voltages(p, q, self.v0_squared, steps=plant.loss_correction)
            active = plant.feeder.bus_voltages(p, q[0], self.v0_squared, steps=0)
            off: Floats = np.abs((all_[1] - all_[0]) - (active[1] - active[0]))
        at = plant.feeder.bus[plant.meters]
        return np.minimum(np.nan_to_num(off[at], nan=NO_VOLTAGE), NO_VOLTAGE)

    def errors(self, plant: Plant, injected: Floats) -> tuple[Floats, Floats]:
        """Largest errors of the net powers, (N,) each."""
        frame = self.frame
        p_error, q_error = frame.p_error.copy(), np.where(self.uses_q, frame.q_net_error, frame.q_error)
        suspects = plant.meters[~self.trusted]
        p_error[suspects] += self.sizes[suspects]
        q_error[suspects] += np.abs(frame.q[suspects]) + FALSE_Q * self.sizes[suspects]
        return p_error, q_error + np.where(self.uses_q, 0.0, injected)


def unknown_injections(plant: Plant, given: Floats) -> InjectionError:
    """Errors before the first frame: injections within saturation. given: (m,) inputs, squared pu."""
    span = plant.droop.span
    return InjectionError(span, given, np.full(span.size, NO_VOLTAGE), span)


def update_injection_error(
    design: SequentialDesign,
    before: InjectionError,
    given: Floats,
    free: tuple[Bools, PowerErrors, Bools | bool] | None,
    h: float,
) -> InjectionError:
    """Errors a time h later.

    given: (m,) squared voltage at each input, pu. free: inverters that follow the model, (m,), power errors,
    and metered busbar phases; None where all follow their meters.
    """
    plant, droop, span = design.plant, design.plant.droop, before.span
    hold = np.abs(given - before.input)
    width = design.reading_errors.of(given)
    wider = np.maximum(width, before.width)
    target = np.minimum(span, droop.slope * (wider + hold) + design.mismatch)
    if free is not None:
        (which, powers, metered), size = free, plant.feeder.bus.size
        # The map is monotone: from above its images stay above the error.
        top = np.where(which, span, np.maximum(before.error, target))
        lost, _ = powers.loss_error(plant, droop.per_customer(top, size))
        meter = np.minimum(busbar_errors(plant, powers.v0_squared, design.sigmas[0]), NO_VOLTAGE)
        known = np.where(metered, meter, NO_VOLTAGE)
        busbar = plant.feeder.broadcast_busbar(known)[plant.feeder.bus]
        for _ in range(_ITERATIONS):
            model = powers.linear_error(plant, droop.per_customer(top, size)) + lost + busbar
            width = np.where(which, model[droop.customer], width)
            wider = np.maximum(width, before.width)
            image = np.minimum(span, droop.slope * (wider + hold) + design.mismatch)
            target = np.where(which, image, target)
            top = np.where(which, np.maximum(before.error, image), top)
    error = target + np.exp(-h / droop.tau) * (before.error - target)
    return InjectionError(error, given, width, span)


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


# Placeholder of a bound that is not computed yet.
_PENDING: Floats = np.zeros(0)


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
        made = cls(t, v2_bus[bus], _PENDING, v2_bus, grounds.trusted, x, np.sqrt(variance[bus]))
        object.__setattr__(made, "_grounds", grounds)
        return made

    @property
    def bound(self) -> Floats:
        """Half-width of the interval around `v2` that contains the truth within the stated errors, (N,)."""
        slot = Estimate.__dict__["bound"]
        found: Floats = slot.__get__(self)
        if found is _PENDING:
            found = self._grounds.half_width(self.v2)
            slot.__set__(self, found)
        return found

    @bound.setter
    def bound(self, value: Floats) -> None:
        Estimate.__dict__["bound"].__set__(self, value)
