"""Checks of a suspect busbar meter by all others, and of metered reactive powers by the droop curves.

A named phase of the busbar counts as not metered. The meters then determine the busbar, and its reading is
compared with them until both agree again.

A metered net reactive power less the load is the inverter's injection, which the voltage gives a second
time. Honest errors explain no more than

    |q_net - q - x| <= q_error + q_net_error + e + min(span, d (|residual| + z std)):

e bounds the error of the observed injection x (`gridsec.estimators.front.observer`); the last term lets
the inverter follow the voltage by the other meters. Beyond that either the inverter leaves its curve or the
report is false. The amount ``a = q_net - q - x`` decides by the voltages: if x were true instead of the
report, the chi-square would rise by

    2 a c^T Q m + a^2 c^T Q c,   c the column of 2X,   m the residuals with the report,

twice the logarithm of the likelihood ratio. Where it is small, both are given.

References
----------
chong2020 (16) to (18) for the curves; docs/theory-front.md, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, any_of
from gridsec.estimators.front.design import FrontDesign
from gridsec.interface import Explanation, Frame


@dataclass(frozen=True, slots=True, eq=False)
class BusbarTrust:
    """Trust of the busbar's meter. b phases, 1 on a balanced feeder."""

    trusted: Bools  # (b,) its voltage is used
    ticks_suspect: Ints  # (b,) ticks without trust
    ticks_agreeing: Ints  # (b,) successive ticks of agreement; negative after a restart: ticks owed
    off: Floats  # (b,) excess of its reading, mean over `busbar_ticks`, squared pu

    @property
    def named(self) -> Bools:
        """Phases with a meter named as manipulated, (b,)."""
        return ~self.trusted

    def suspecting(self, named: Bools) -> BusbarTrust:
        """Trust after phases `named` (b,) were named; the mean of their deviation begins."""
        return replace(
            self,
            trusted=self.trusted & ~named,
            ticks_suspect=np.where(named, 0, self.ticks_suspect),
            ticks_agreeing=np.where(named, 0, self.ticks_agreeing),
            off=np.where(named, 0.0, self.off),
        )


def trusted_busbar(phases: int) -> BusbarTrust:
    """All phases trusted."""
    zero = np.zeros(phases, dtype=np.intp)
    return BusbarTrust(np.ones(phases, dtype=np.bool_), zero, zero, np.zeros(phases))


def track_busbar(  # noqa: PLR0917
    design: FrontDesign,
    before: BusbarTrust,
    reported: Floats,
    available: Bools,
    v0_squared: Floats,
    variance: Floats,
) -> BusbarTrust:
    """Compare the reading of a named busbar meter with the other meters.

    It is trusted again once its mean deviation over `busbar_ticks` stays within the limit for as long, and
    for the ticks `release`.

    reported, available: (b,) its squared voltages, pu, and where it has one. v0_squared, variance: (b,) by
    the other meters.
    """
    out = before.named
    if not any_of(out):
        return before
    length = design.busbar_ticks
    age = before.ticks_suspect + out
    off = np.where(available, reported - v0_squared, before.off)
    off = before.off + (off - before.off) / np.clip(age, 1, length)
    std = np.sqrt(variance + design.busbar**2 + design.busbar_noise)
    agrees = out & available & (np.abs(off) <= design.options.lower * design.sigmas * std)
    calm = np.where(available, (before.ticks_agreeing + 1) * agrees, before.ticks_agreeing)
    still = out & (calm < max(design.options.release, length))
    return BusbarTrust(
        trusted=~still,
        ticks_suspect=np.where(still, age, 0),
        ticks_agreeing=np.where(still, calm, 0),
        off=np.where(still, off, 0.0),
    )


# --- Inverters ---


@dataclass(frozen=True, slots=True, eq=False)
class InverterChecks:
    """Results of the comparison. p meters, m inverters."""

    count: Ints  # (p,) disagreeing ticks times `_DISAGREEMENT` less agreeing ones
    off: Bools  # (p,) lasting disagreement
    amount: Floats  # (p,) its size, pu; 0 for others
    share: Floats  # (p,) probability of a wrong inverter rather than a false report; 0 for others
    sure: Bools  # (p,) wrong inverter by the voltages, without later evidence against it
    observable: Bools  # (m,) injection metered well enough to show its whole range
    idle: bool = field(init=False)  # derived: no report is compared

    def __post_init__(self) -> None:
        object.__setattr__(self, "idle", not (any_of(self.observable) or any_of(self.count)))

    def named(self, design: FrontDesign) -> Bools:
        """Inverters that do not follow their curves, (m,)."""
        return design.inverters_of(self.sure) if self.sure.size else self.observable

    def amounts(self, design: FrontDesign) -> Floats:
        """Deviation of each inverter from its curve, (m,), pu."""
        metered, at = design.meter_of >= 0, design.meter_of
        if not any_of(metered):
            return np.zeros(at.size)
        # Several inverters of a customer are metered together.
        share = np.bincount(at[metered], minlength=self.amount.size)
        return np.where(metered, self.amount[at] / np.maximum(share[at], 1), 0.0)

    def consistent(self, design: FrontDesign) -> Bools:
        """Metered inverters that follow their curves, (m,)."""
        return self.observable & (self.count[design.meter_of] == 0) if self.count.size else self.observable

    def without_meters(self, which: Bools) -> InverterChecks:
        """Results without meters that were replaced, (p,)."""
        return InverterChecks(
            np.where(which, 0, self.count),
            self.off & ~which,
            np.where(which, 0.0, self.amount),
            np.where(which, 0.0, self.share),
            self.sure & ~which,
            self.observable,
        )

    def explanations(self, design: FrontDesign, named: Bools) -> tuple[Explanation, ...]:
        """Possible cases where the voltages do not decide, for the customers of the largest deviations.

        named: (p,) meters manipulated in any case.
        """
        open_ = self.off & ~self.sure
        if self.idle or not any_of(open_):
            return ()
        strange = np.argsort(-np.where(open_, np.abs(self.amount), -1.0), kind="stable")
        which = np.sort(strange[: min(int(open_.sum()), _MAX_COMBINED)])
        ways = []
        for wrong in map(np.array, product((True, False), repeat=which.size)):
            inverters = np.isin(design.meter_of, which[wrong])
            powers = np.zeros(design.customers, dtype=np.bool_)
            powers[design.plant.meters[which[~wrong]]] = True
            each = np.where(wrong, self.share[which], 1.0 - self.share[which])
            ways.append(Explanation(named, inverters, float(each.prod()), powers))
        likely = [way for way in ways if way.probability > 1.0 / design.options.like]
        return tuple(sorted(likely, key=lambda way: -way.probability))


def no_checks(meters: int, inverters: int) -> InverterChecks:
    """No comparison yet."""
    no = np.zeros(meters, dtype=np.bool_)
    zero = np.zeros(meters)
    return InverterChecks(
        np.zeros(meters, dtype=np.intp), no, zero, zero, no, np.zeros(inverters, dtype=np.bool_)
    )


_MAX_COMBINED = 3
"""Largest number of customers in the combined cases."""


_DISAGREEMENT = 4
"""Count of a disagreement; an agreement counts -1."""


_EVIDENCE, _MAX_COUNT = 12, 48
"""Count that is evidence, and largest count."""


@dataclass(frozen=True, slots=True, eq=False)
class ReportedPowers:
    """Inputs of one tick. N customers, p meters, m inverters."""

    frame: Frame  # the frame
    reports_q: Bools  # (N,) net reactive power is reported
    uses_q: Bools  # (N,) net reactive power is used by the model
    trusted: Bools  # (p,) available meters, trusted for long enough that the observer followed them
    x: Floats  # (m,) observed injections, pu
    x_error: Floats  # (m,) largest errors of x, pu
    residual: Floats  # (p,) residuals by the other readings, squared pu
    std: Floats  # (p,) their standard deviations, squared pu
    share: Share  # evidence of the voltages
    unreported: Unreported  # the same of this tick, for an inverter without a report


Share = Callable[[int, float, bool], tuple[float, float]]
"""Evidence of the voltages on a report, by meter, amount of its deviation, pu, and use of it by the model.

Results: probability that the report is true and the inverter wrong, for even prior odds; standard deviations
by which the voltages deviate along the inverter's column if the inverter is right."""
Unreported = Callable[[int, float], tuple[float, float]]
"""Evidence of the voltages of one tick on an inverter without a report, by meter and last amount, pu.

Results as in `Share`."""


def check_inverters(design: FrontDesign, before: InverterChecks, now: ReportedPowers) -> InverterChecks:
    """Compare the reports of one tick with the curves."""
    droop, at, size = design.plant.droop, design.plant.meters, design.customers
    own = np.bincount(droop.customer, minlength=size) > 0
    asked = now.reports_q[at] & now.trusted & own[at]
    if not (any_of(asked) or any_of(before.count)):
        return before if before.idle else no_checks(at.size, droop.tau.size)
    x, error, slope, span = (
        droop.per_customer(of, size)[at] for of in (now.x, now.x_error, droop.slope, droop.span)
    )
    frame = now.frame
    amount = np.where(asked, frame.q_net[at] - frame.q[at] - x, 0.0)
    other = np.minimum(span, slope * (np.abs(now.residual) + design.sigmas * now.std))
    room = frame.q_error[at] + frame.q_net_error[at] + error + other
    disagrees = asked & (np.abs(amount) > room)
    count = np.where(
        asked, np.clip(before.count + np.where(disagrees, _DISAGREEMENT, -1), 0, _MAX_COUNT), before.count
    )
    lasts = (count >= _EVIDENCE) | (before.off & (count > 0))
    share, beyond = before.share.copy(), before.sure.copy()
    amount = np.where(asked, amount, before.amount)
    unlikely = 1.0 / design.options.like
    for j in np.flatnonzero(lasts).tolist():
        if asked[j]:
            share[j], sigmas = now.share(j, float(amount[j]), bool(now.uses_q[at[j]]))
            beyond[j] |= bool(sigmas > design.sigmas)
            continue
        # Without reports the accusation stays until the voltages contradict it, tick by tick.
        still, sigmas = now.unreported(j, float(amount[j]))
        if still <= unlikely and sigmas <= design.sigmas:
            count[j] -= 1
        elif still >= 1.0 - unlikely:
            count[j] = min(count[j] + _DISAGREEMENT, _MAX_COUNT)
    lasts &= count > 0
    sure = lasts & beyond & ((share >= 1.0 - unlikely) | (before.sure & (share >= 0.5)))
    least, most = (of[at] for of in droop.saturated(size))
    enough = asked & (room < np.maximum(most - x, x - least))
    return InverterChecks(count, lasts, amount * lasts, share * lasts, sure, design.inverters_of(enough))


def probability(worse: float) -> float:
    """Probability of a hypothesis against one with a chi-square higher by `worse`, for even prior odds."""
    return float(1.0 / (1.0 + np.exp(-0.5 * np.clip(worse, -_MAX_LOG_RATIO, _MAX_LOG_RATIO))))


_MAX_LOG_RATIO = 1000.0
"""Largest twice the logarithm of a likelihood ratio, against overflow."""
