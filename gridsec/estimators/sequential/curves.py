"""Whether the reactive power that meters report is what the droop curves ask for.

Where a customer's net reactive power is metered, what is left of it after the load is what the inverter
injects. It is known a second time, from the voltage. No honest errors explain more than

    |q_net - q - x| <= q_error + q_net_error + e + min(span, d (|offset| + z std)):

e bounds the error of the observed injection x (`gridsec.estimators.sequential.bounds`), and the last term
lets the inverter follow what the other meters say of its voltage rather than its own meter. Beyond that
either the inverter does not follow its curve, or what is reported is false. The voltages say which, where the
amount ``a = q_net - q - x`` moves them: if x were true rather than what is reported, the misfit would rise by

    2 a c^T Q m + a^2 c^T Q c,   c the column of 2X,   m the residuals with what is reported,

and half of that is the logarithm of the likelihood ratio. Where it says little, both are reported.

References
----------
chong2020 (16) to (18) for the curves; docs/theory-sequential.md, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.estimators.sequential.bounds import Lag
from gridsec.estimators.sequential.conditional import Fit, Judged
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.interface import Explanation, Frame


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """What the metered reactive powers say of the inverters. p meters, m inverters.

    Attributes
    ----------
    count : (p,)
        Ticks in which a report and the curve disagreed, four times, less those in which they agreed.
    off : (p,)
        Whose do, for long enough.
    amount : (p,)
        By how much, pu; 0 for others.
    share : (p,)
        Probability that the inverter is wrong and not the report; 0 for others.
    sure : (p,)
        Where it is the inverter, by the voltages, and nothing has spoken against it since.
    heard : (m,)
        Inverters whose injection is metered well enough to notice if they were where they can be.
    idle
        Derived. Whether nobody's reports are compared with anything.
    """

    count: Ints
    off: Bools
    amount: Floats
    share: Floats
    sure: Bools
    heard: Bools
    idle: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "idle", not (any_of(self.heard) or any_of(self.count)))

    def named(self, design: SequentialDesign) -> Bools:
        """Inverters that do not follow their curves, (m,)."""
        return (design.meter_of >= 0) & self.sure[design.meter_of] if self.sure.size else self.heard

    def amounts(self, design: SequentialDesign) -> Floats:
        """What each inverter injects that its curve does not ask for, (m,) in pu."""
        metered, at = design.meter_of >= 0, design.meter_of
        if not any_of(metered):
            return np.zeros(at.size)
        # Several inverters of a customer are metered together.
        share = np.bincount(at[metered], minlength=self.amount.size)
        return np.where(metered, self.amount[at] / np.maximum(share[at], 1), 0.0)

    def agrees(self, design: SequentialDesign) -> Bools:
        """Inverters that are metered and do what their curves ask for, (m,)."""
        return self.heard & (self.count[design.meter_of] == 0) if self.count.size else self.heard

    def renewed(self, which: Bools) -> Curves:
        """Nothing of meters that were replaced counts any more.

        Parameters
        ----------
        which : (p,)
            The meters.
        """
        return Curves(
            np.where(which, 0, self.count),
            self.off & ~which,
            np.where(which, 0.0, self.amount),
            np.where(which, 0.0, self.share),
            self.sure & ~which,
            self.heard,
        )

    def explanations(self, design: SequentialDesign, named: Bools) -> tuple[Explanation, ...]:
        """What may be the case where the voltages do not decide: that of the strangest customers.

        Parameters
        ----------
        design
            The design.
        named : (p,)
            Meters that are manipulated in any case.
        """
        open_ = self.off & ~self.sure
        if self.idle or not any_of(open_):
            return ()
        strange = np.argsort(-np.where(open_, np.abs(self.amount), -1.0), kind="stable")
        who = np.sort(strange[: min(int(open_.sum()), _TOGETHER)])
        ways = []
        for wrong in map(np.array, product((True, False), repeat=who.size)):
            inverters = np.isin(design.meter_of, who[wrong])
            powers = np.zeros(design.customers, dtype=np.bool_)
            powers[design.plant.meters[who[~wrong]]] = True
            each = np.where(wrong, self.share[who], 1.0 - self.share[who])
            ways.append(Explanation(named, inverters, float(each.prod()), powers))
        likely = [way for way in ways if way.probability > 1.0 / design.options.like]
        return tuple(sorted(likely, key=lambda way: -way.probability))


def empty(meters: int, inverters: int) -> Curves:
    """Nothing heard yet.

    Parameters
    ----------
    meters, inverters
        p and m.
    """
    no = np.zeros(meters, dtype=np.bool_)
    zero = np.zeros(meters)
    return Curves(np.zeros(meters, dtype=np.intp), no, zero, zero, no, np.zeros(inverters, dtype=np.bool_))


# Customers whose reports or inverters are wrong, of all of which explanations tell.
_TOGETHER = 3

CONFIRM = 5
"""Ticks of the longest means that say which of both is wrong."""

# A disagreement counts so much, an agreement takes one away: who comes back after a pause is not forgotten.
_EACH = 4
# So much must be counted, and so much is at most.
_ENOUGH, _MOST = 12, 48


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One tick. N customers, p meters, m inverters.

    Attributes
    ----------
    frame
        Everything known.
    reported, told : (N,)
        Whose net reactive power is reported, and whose the model was given.
    trusted : (p,)
        Meters that report and are believed, and have been for long enough that the observer followed them.
    x
        Observed injections, (m,), pu.
    lag
        Their errors.
    fit, judged
        What the trusted meters say, on the longest scale of at most CONFIRM ticks.
    """

    frame: Frame
    reported: Bools
    told: Bools
    trusted: Bools
    x: Floats
    lag: Lag
    fit: Fit | None
    judged: Judged | None


def compare(design: SequentialDesign, before: Curves, now: Evidence) -> Curves:
    """Compare what is reported with the curves.

    Parameters
    ----------
    design, before
        The design, and what was known.
    now
        One tick.
    """
    droop, at, size = design.plant.droop, design.plant.meters, design.customers
    own = np.bincount(droop.customer, minlength=size) > 0
    asked = now.reported[at] & now.trusted & own[at]
    if now.fit is None or now.judged is None:
        return before
    if not (any_of(asked) or any_of(before.count)):
        return before if before.idle else empty(at.size, droop.tau.size)
    x, error, slope, span = (
        droop.per_customer(of, size)[at] for of in (now.x, now.lag.error, droop.slope, now.lag.span)
    )
    frame, judged = now.frame, now.judged
    amount = np.where(asked, frame.q_net[at] - frame.q[at] - x, 0.0)
    other = np.minimum(span, slope * (np.abs(judged.offset) + design.sigmas[0] * judged.std))
    room = frame.q_error[at] + frame.q_net_error[at] + error + other
    off = asked & (np.abs(amount) > room)
    count = np.where(asked, np.clip(before.count + np.where(off, _EACH, -1), 0, _MOST), before.count)
    lasts = (count >= _ENOUGH) | (before.off & (count > 0))
    share, beyond = np.zeros(at.size), before.sure.copy()
    amount = np.where(asked, amount, before.amount) * lasts
    for j in np.flatnonzero(lasts).tolist():
        told = bool(asked[j] and now.told[at[j]])
        share[j], sigmas = _share(design, now.fit, judged.weights, j, float(amount[j]), told=told)
        beyond[j] |= bool(asked[j] and sigmas > design.sigmas[0])
    # Who reports no more stays accused, unless the voltages say that it is over.
    over = lasts & ~asked & (share <= 1.0 / design.options.like)
    count = np.where(over, count - 1, count)
    share = np.where(asked | over, share, before.share * lasts)
    sure = lasts & beyond & ((share >= 1.0 - 1.0 / design.options.like) | (before.sure & (share >= 0.5)))
    least, most = (of[at] for of in droop.saturated(size))
    enough = asked & (room < np.maximum(most - x, x - least))
    heard = (design.meter_of >= 0) & enough[design.meter_of]
    return Curves(count, lasts, amount, share, sure, heard)


def _share(
    design: SequentialDesign, now: Fit, weights: Floats, j: int, a: float, *, told: bool
) -> tuple[float, float]:
    """Probability that a report is true and the inverter wrong, for equal odds beforehand.

    And by how many standard deviations the voltages are off along its column if the inverter is not wrong:
    who asks at every tick for years is told something unlikely at some of them.
    """
    inverter = int(np.argmax(design.meter_of == j))
    column = design.book.columns(np.array([design.customers + inverter]))[now.prior.meters, 0]
    at, Q = now.trusting()
    along, form = float(column @ weights), float(column[at] @ Q @ column[at])
    if told:
        along += a * form  # as if x were true
    worse = 2.0 * a * along - a * a * form
    share = 1.0 / (1.0 + np.exp(-0.5 * np.clip(worse, -_FAR, _FAR)))
    # Who hangs on the busbar moves nothing.
    return float(share), abs(along) / max(float(np.sqrt(form)), np.finfo(np.float64).tiny)


_FAR = 1000.0
