"""Confirmation: suspects are named on lasting evidence without a rival hypothesis about as likely.

References
----------
docs/theory-sequential.md, section 5.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gridsec.arrays import Bools, Ints, all_of, any_of, indices
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.hypotheses import fault_exchanges, meter_exchanges
from gridsec.estimators.sequential.identify import Identification
from gridsec.estimators.sequential.inverter_check import InverterChecks
from gridsec.estimators.sequential.posterior import leave_one_out
from gridsec.estimators.sequential.search import Candidates
from gridsec.estimators.sequential.suspect_powers import vouched_posterior
from gridsec.estimators.sequential.time_scales import Scales, ScaleTest
from gridsec.estimators.sequential.trust import TrustState
from gridsec.grid.network import Power
from gridsec.interface import Explanation

MAX_INVERTER_TICKS, _WITNESS_PART = 12, 0.25
"""Largest count of an inverter's accusations; part of its largest effect that makes a meter its witness.

The count rises at a tick that accuses it and falls at others with a trusted reading of a witness.
"""


def confirm(
    design: SequentialDesign,
    before: TrustState,
    identified: Identification,
    available: Bools,
    curves: InverterChecks,
) -> tuple[TrustState, tuple[Explanation, ...]]:
    """Trust state with named meters and inverters, and rival hypotheses where one prevents a name.

    available: (p,) meters with a reading; silence releases none. curves: an inverter that follows its curve
    is not a rival.
    """
    trust = identified.trust
    if trust.clear and before.clear:
        return trust, ()
    lately = any_of(trust.ticks_suspect) or any_of(before.named) or any_of(before.inverter_ticks)
    if all_of(trust.trusted) and not (trust.accused or lately):
        return trust, ()
    now = trust.counted(before.named, available, design.options.release, design.lengths[-1])
    lasting = trust.above_limit.any(axis=0) & (now.ticks_suspect >= design.confirmed[trust.scale])
    fresh = ~now.trusted & ~before.named & lasting & _accused(identified, available.size)
    count, inverters = _inverter_counts(design, before, trust, identified, available)
    new = inverters & ~before.inverters
    rivals: tuple[Explanation, ...] = ()
    if any_of(fresh) or any_of(new):
        found = _Rivals(design, fresh, new, curves.consistent(design))
        found.collect(identified)
        for meters, accused in found.accusations():
            fresh, inverters = fresh & meters, inverters & (before.inverters | accused)
        rivals = found.explanations(available | before.named)
    return now.with_names(fresh, count, inverters), rivals


def supported(
    scales: Scales, before: TrustState, identified: Identification, trust: TrustState
) -> TrustState:
    """Trust state without new names that rest on meters that withhold powers."""
    fresh, vouched = trust.named & ~before.named, scales.uncertainty.vouched
    if all_of(vouched) or not any_of(fresh):
        return trust
    out = np.zeros_like(fresh)
    for s, now in enumerate(identified.posteriors):
        which = fresh & (trust.scale == s)
        beside = None if now is None or not any_of(which) else vouched_posterior(now, vouched[s])
        if beside is not None:
            here = scales[s]
            loo = leave_one_out(beside.vouched, here.m)
            out |= which & (np.abs(loo.residual) <= here.limits.limit(loo.std))
    return trust.without_names(out)


def _accused(identified: Identification, meters: int) -> Bools:
    """Meters accused by the likeliest candidate of a scale that searched at this tick, (p,)."""
    out = np.zeros(meters, dtype=np.bool_)
    for found in identified.candidates.values():
        out |= ~found.best.trusted
    return out


def _inverter_counts(
    design: SequentialDesign,
    before: TrustState,
    trust: TrustState,
    identified: Identification,
    available: Bools,
) -> tuple[Ints, Bools]:
    """Ticks that accuse each inverter, and the named ones, (m,) each.

    An accusation counts at ticks with a search that accuses it; silence releases none.
    """
    accused = [k for k, _ in trust.accused]
    if not accused and not any_of(before.inverter_ticks):
        return before.inverter_ticks, before.inverters
    now = accused_inverters(design, accused)
    less = np.where(_witnessed(design, before.inverter_ticks > 0, available & trust.trusted), -1, 0)
    # An inverter named before a restart starts above that and counts down.
    most = np.maximum(MAX_INVERTER_TICKS, before.inverter_ticks + less)
    count = np.clip(before.inverter_ticks + np.where(now, 1, less), 0, most)
    need, confirmed = np.full(now.size, MAX_INVERTER_TICKS), design.confirmed
    for k, s in trust.accused:
        if k >= design.customers:
            need[k - design.customers] = min(confirmed[s], MAX_INVERTER_TICKS)
    sought = accused_inverters(
        design, [k for found in identified.candidates.values() for k in found.best.faults]
    )
    return count, (before.inverters & (count > 0)) | (now & sought & (count >= need))


def _witnessed(design: SequentialDesign, which: Bools, available: Bools) -> Bools:
    """Inverters that move the voltage of some available meter, (m,)."""
    if all_of(available) or not any_of(which):
        return which
    out, at = which.copy(), indices(which)
    own = design.plant.droop.customer[at]
    effect = np.abs(design.sensitivities.columns(Power.REACTIVE, own)[design.prior.meters])
    most = effect.max(axis=0, initial=0.0)
    out[at] = effect[available].max(axis=0, initial=0.0) >= np.maximum(
        _WITNESS_PART * most, np.finfo(np.float64).tiny
    )
    return out


def accused_inverters(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Inverters among accused faults, (m,)."""
    return _accused_faults(design, accused)[design.customers : design.faults.std.size]


def accused_powers(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Customers with a false power among accused faults, (N,)."""
    return _accused_faults(design, accused)[: design.customers]


def _accused_phases(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Busbar phases among accused faults, (b,)."""
    return _accused_faults(design, accused)[design.faults.std.size :]


def _accused_faults(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Accused powers, inverters and busbar phases, (N + m + b,)."""
    out = np.zeros(design.faults.std.size + design.busbar_incidence.shape[1], dtype=np.bool_)
    out[list(accused)] = True
    return out


class _Rivals:
    """Hypotheses about as likely as the best, if one leaves out a meter or inverter about to be named.

    fresh, new: meters (p,) and inverters (m,) about to be named. agrees: inverters that follow their curves.
    """

    def __init__(self, design: SequentialDesign, fresh: Bools, new: Bools, agrees: Bools) -> None:
        self.design, self.fresh, self.new = design, fresh, new
        self.others = design.customers + indices(~agrees)
        self.within = 2.0 * float(np.log(design.options.like))
        self.found: dict[bytes, tuple[Bools, Bools, float, tuple[int, ...]]] = {}

    def collect(self, identified: Identification) -> None:
        """Take the candidates of every scale that searched."""
        for s, found in identified.candidates.items():
            test = identified.tests[s]
            if test is not None:
                self._collect(found, test)
        if not any(self._differs(meters, inverters) for meters, inverters, *_ in self.found.values()):
            self.found.clear()

    def accusations(self) -> list[tuple[Bools, Bools]]:
        """Meters and inverters that each accuses; meters without a reading are among the former."""
        return [(meters, inverters) for meters, inverters, *_ in self.found.values()]

    def explanations(self, available: Bools) -> tuple[Explanation, ...]:
        """All of them, the likeliest first; meters that are not `available`, (p,), are left out."""
        design, total = self.design, sum(way[2] for way in self.found.values())
        return tuple(
            Explanation(
                meters & available,
                inverters,
                weight / total,
                accused_powers(design, faults),
                _accused_phases(design, faults),
            )
            for meters, inverters, weight, faults in sorted(self.found.values(), key=lambda way: -way[2])
        )

    def _collect(self, found: Candidates, test: ScaleTest) -> None:
        best, within = found.best, self.within
        near = [(~each.trusted, each.faults, each.cost - best.cost) for each in (best, *found.others)]
        for swap in meter_exchanges(best, test.enough, within, test.limits):
            other = near[0][0].copy()
            other[swap.accused], other[swap.innocent] = False, True
            near.append((other, best.faults, swap.worse))
        accused = (self.design.customers + indices(self.new)).tolist()
        for turn in fault_exchanges(best, self.design.faults, accused, self.others, within):
            faults = tuple(turn.innocent if k == turn.accused else k for k in best.faults)
            near.append((near[0][0], faults, turn.worse))
        for k, (meters, faults, worse) in enumerate(near):
            inverters = accused_inverters(self.design, faults)
            if not k or (worse <= within and self._differs(meters, inverters)):
                which, weight = meters.tobytes() + inverters.tobytes(), float(np.exp(-0.5 * worse))
                if which not in self.found or self.found[which][2] < weight:
                    self.found[which] = (meters, inverters, weight, faults)

    def _differs(self, meters: Bools, inverters: Bools) -> bool:
        """True if a meter or inverter about to be named is left out."""
        return any_of(self.fresh & ~meters) or any_of(self.new & ~inverters)
