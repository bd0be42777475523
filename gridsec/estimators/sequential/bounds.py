"""How far honest errors can lead, whatever they are within what was stated: intervals, no probabilities.

All else in this package calls an offset unlikely. But classes and power factors err in the same direction for
years, and all of them may err together; what then still holds is a sum of worst cases:

    |v2 - model| <= 2 |R| dp + 2 |X| (dq + e) + losses + busbar      everywhere
    |v2 - y|     <= error of the reading                             at trusted meters

with e the error of the observed injections. Every ``|e_i|`` is a first-order lag of what drives it,

    tau_i |e_i|' <= -|e_i| + min(span_i, d_i (error of what it is given + hold) + mismatch),

where `hold` is what the inverter's voltage changed from frame to frame: saturation keeps it finite, whatever
happens. An inverter that follows a trusted meter is given a reading, any other the model. Supposed is that
inverters follow their curves, and that between two frames a voltage stays between its values at them: what
comes and goes unseen moves inverters that nobody knows of.

Powers told by customers whose meters are not trusted may be false, by as much as the book of the search
allows for. The busbar voltage is metered, or what the trusted meters leave of it: it is eliminated, not
assumed.

References
----------
docs/theory-sequential.md, section 7; docs/theory-detection.md for the lag and for `mismatch`.
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
"""Reactive power per active power that a false power is told with at most."""

# The monotone map of the free inverters is applied so often from above.
_ROUNDS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Lag:
    """How far the observed injections may be from the true ones. m inverters.

    Attributes
    ----------
    error : (m,)
        Half-widths, pu.
    given : (m,)
        Squared voltage that each was given at the last frame, pu.
    width : (m,)
        How far that may have been from the truth, squared pu.
    span : (m,)
        Distance between the saturated values of each curve, pu: no error is larger.
    """

    error: Floats
    given: Floats
    width: Floats
    span: Floats

    def lied_to(self, which: Bools) -> Lag:
        """Of inverters that followed a liar nothing is known but where they saturate.

        Parameters
        ----------
        which : (m,)
            Their inverters.
        """
        return replace(self, error=np.where(which, self.span, self.error)) if any_of(which) else self


@dataclass(frozen=True, slots=True, eq=False)
class Powers:
    """The powers of one frame and how far they may be off. N customers, p meters.

    Attributes
    ----------
    frame
        With powers that can be.
    q : (N,)
        Net reactive injections that the model was given, observed ones of inverters included, pu.
    told : (N,)
        Whose net reactive power is metered and used: observed injections do not matter there.
    v0_squared
        Squared busbar voltage, pu; in three phases (3,).
    trusted : (p,)
        Which meters are believed: powers that customers of the others tell may be false.
    sizes : (k,)
        How much there may be of whatever is in the book of the design, pu.
    """

    frame: Frame
    q: Floats
    told: Bools
    v0_squared: Floats | float
    trusted: Bools
    sizes: Floats

    def linear(self, plant: Plant, injected: Floats) -> Floats:
        """What the linear model can be off at each customer for a known busbar voltage, (N,).

        Parameters
        ----------
        plant
            The feeder.
        injected : (N,)
            How far the inverters' injections may be off, pu.
        """
        return plant.feeder.reach(*self.errors(plant, injected))[plant.feeder.bus]

    def lost(self, plant: Plant, injected: Floats) -> tuple[Floats, Floats]:
        """What the loss correction can be off at each customer, (N,), and the correction itself.

        Parameters
        ----------
        plant, injected
            As in `linear`.
        """
        p_error, q_error = self.errors(plant, injected)
        v0 = self.v0_squared
        correction, off = losses(plant, self.frame.p, self.q, v0, p_error=p_error, q_error=q_error)
        return off, correction[plant.feeder.bus]

    def bent(self, plant: Plant, which: Bools) -> Floats:
        """What some customers' reports change at each meter, but for the linear effect of active power, (p,).

        That is what a direction of the dictionary leaves of a report that is false: its reactive power, and
        what the losses of both have added to the model.

        Parameters
        ----------
        plant
            The feeder.
        which : (N,)
            The customers.
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
        """How far the net powers may be off, (N,) each.

        Parameters
        ----------
        plant, injected
            As in `linear`.
        """
        frame = self.frame
        p_error, q_error = frame.p_error.copy(), np.where(self.told, frame.q_net_error, frame.q_error)
        liars = plant.meters[~self.trusted]
        p_error[liars] += self.sizes[liars]
        q_error[liars] += np.abs(frame.q[liars]) + FALSE_Q * self.sizes[liars]
        return p_error, q_error + np.where(self.told, 0.0, injected)


def start(plant: Plant, given: Floats) -> Lag:
    """Nothing is known of the injections but where they saturate.

    Parameters
    ----------
    plant
        The inverters.
    given : (m,)
        Squared voltage that each is given, pu.
    """
    span = plant.droop.span
    return Lag(span, given, np.full(span.size, NO_VOLTAGE), span)


def follow(
    design: SequentialDesign,
    before: Lag,
    given: Floats,
    free: tuple[Bools, Powers, Bools | bool] | None,
    h: float,
) -> Lag:
    """The errors a time h later.

    Parameters
    ----------
    design, before
        The design, and the errors at the last frame.
    given : (m,)
        Squared voltage that each inverter is given: its meter's reading or the model's, pu.
    free
        Which inverters follow the model, (m,), what the frame says of powers, and whether the busbar voltage
        is metered; None where all follow their meters.
    h
        Step, s.
    """
    plant, droop, span = design.plant, design.plant.droop, before.span
    hold = np.abs(given - before.given)
    width = design.heard.of(given)
    wider = np.maximum(width, before.width)
    target = np.minimum(span, droop.slope * (wider + hold) + design.mismatch)
    if free is not None:
        (which, powers, metered), size = free, plant.feeder.bus.size
        # The map is monotone: from above its images stay above the error.
        top = np.where(which, span, np.maximum(before.error, target))
        lost, _ = powers.lost(plant, droop.per_customer(top, size))
        meter = np.minimum(busbar_errors(plant, powers.v0_squared, design.sigmas[0]), NO_VOLTAGE)
        known = np.where(metered, meter, NO_VOLTAGE)
        busbar = plant.feeder.broadcast_busbar(known)[plant.feeder.bus]
        for _ in range(_ROUNDS):
            model = powers.linear(plant, droop.per_customer(top, size)) + lost + busbar
            width = np.where(which, model[droop.customer], width)
            wider = np.maximum(width, before.width)
            image = np.minimum(span, droop.slope * (wider + hold) + design.mismatch)
            target = np.where(which, image, target)
            top = np.where(which, np.maximum(before.error, image), top)
    error = target + np.exp(-h / droop.tau) * (before.error - target)
    return Lag(error, given, width, span)


@dataclass(frozen=True, slots=True, eq=False)
class Grounds:
    """What the bound of one estimate rests on. N customers, p meters.

    Attributes
    ----------
    plant
        The feeder.
    powers
        The frame's, and how far they may be off.
    injected : (m,)
        How far the observed injections may be off, pu.
    model : (N,)
        What the model makes of it, squared pu.
    busbar
        Whether its voltage is metered; in three phases (3,).
    y, trusted : (p,)
        Squared readings, and the meters that the estimate rests on.
    reads
        Meters whose customer's power is known, (p,): the bound rests on these. Asked for with the bound.
    sigmas
        Standard deviations of jitter that an honest reading may be off.
    """

    plant: Plant
    powers: Powers
    injected: Floats
    model: Floats
    busbar: Bools | bool
    y: Floats
    trusted: Bools
    reads: Callable[[], Bools]
    sigmas: float

    def half_width(self, v2: Floats) -> Floats:
        """Largest distance of the truth from some squared voltages, pu.

        Parameters
        ----------
        v2 : (N,)
            The squared voltages.
        """
        plant, at = self.plant, self.plant.meters
        injected = plant.droop.per_customer(self.injected, plant.feeder.bus.size)
        lost, correction = self.powers.lost(plant, injected)
        spread = np.minimum(self.powers.linear(plant, injected) + lost, NO_VOLTAGE)
        reading, use = told_error(plant.accuracy, self.y, self.sigmas), self.trusted & self.reads()
        ends = self._busbar(spread, reading, use)
        low, high = (plant.feeder.broadcast_busbar(end)[plant.feeder.bus] for end in ends)
        # What losses take off is that of the assumed busbar voltage.
        moved = np.minimum(np.maximum(np.abs(low), np.abs(high)), NO_VOLTAGE)
        base = plant.feeder.broadcast_busbar(self.powers.v0_squared)[plant.feeder.bus]
        spread = spread + np.abs(correction) * moved / np.maximum(base - moved, _LEAST)
        low, high = self.model + low - spread, self.model + high + spread
        own = np.where(use, reading, np.inf)
        low[at], high[at] = _both(low[at], high[at], self.y - own, self.y + own)
        return np.minimum(np.maximum(high - v2, v2 - low), NO_VOLTAGE)

    def _busbar(self, spread: Floats, reading: Floats, use: Bools) -> tuple[Floats, Floats]:
        """How far squared busbar voltages may be from those assumed: by their meters, and by all others."""
        plant, at = self.plant, self.plant.meters
        known = np.atleast_1d(busbar_errors(plant, self.powers.v0_squared, self.sigmas))
        known = np.where(self.busbar, known, np.inf)
        off, room = self.y - self.model[at], np.where(use, reading + spread[at], np.inf)
        heard = np.where(plant.feeder.busbar_incidence()[at] > 0.0, room[:, None], np.inf)
        low = (off[:, None] - heard).max(axis=0, initial=-np.inf)
        high = (off[:, None] + heard).min(axis=0, initial=np.inf)
        return _both(-known, known, low, high)


# No supply is lower, squared pu.
_LEAST = 0.1


def _both(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> tuple[Floats, Floats]:
    """What two intervals have in common; where they have nothing, all that is between their ends."""
    below, above = np.maximum(low, other_low), np.minimum(high, other_high)
    apart = below > above
    return (
        np.where(apart, np.minimum(low, other_low), below),
        np.where(apart, np.maximum(high, other_high), above),
    )


# In place of a bound that nobody has asked for yet.
_LATER: Floats = np.zeros(0)


class Bounded(Estimate):
    """An estimate whose bound is worked out when it is first asked for: that is half a step more.

    From the arrays of its frame, which must not be changed meanwhile.
    """

    __slots__ = ("_grounds",)
    _grounds: Grounds

    @classmethod
    def on(cls, grounds: Grounds, t: float, v2_bus: Floats, variance: Floats, x: Floats) -> Bounded:
        """Put an estimate together.

        Parameters
        ----------
        grounds
            What its bound rests on.
        t
            Unix time, s.
        v2_bus, variance : (n,)
            Squared voltage of every place and its variance, pu.
        x : (m,)
            Observed injections, pu.
        """
        bus = grounds.plant.feeder.bus
        made = cls(t, v2_bus[bus], _LATER, v2_bus, grounds.trusted, x, np.sqrt(variance[bus]))
        object.__setattr__(made, "_grounds", grounds)
        return made

    @property
    def bound(self) -> Floats:
        """Half-width of the interval around `v2` that holds the truth while errors are as stated, (N,)."""
        slot = Estimate.__dict__["bound"]
        found: Floats = slot.__get__(self)
        if found is _LATER:
            found = self._grounds.half_width(self.v2)
            slot.__set__(self, found)
        return found

    @bound.setter
    def bound(self, value: Floats) -> None:
        Estimate.__dict__["bound"].__set__(self, value)
