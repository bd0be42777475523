"""Confirmation: suspects are named on lasting evidence without a rival hypothesis about as likely.

References
----------
docs/theory-sequential.md, section 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gridsec.arrays import Bools, Ints, all_of, any_of, indices
from gridsec.estimators.sequential.apart import set_apart
from gridsec.estimators.sequential.conditional import judge
from gridsec.estimators.sequential.curves import Curves
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.examine import Examined
from gridsec.estimators.sequential.exchanges import swaps, turns
from gridsec.estimators.sequential.scales import Scales, View
from gridsec.estimators.sequential.search import Found
from gridsec.estimators.sequential.state import Trust
from gridsec.grid.network import Power
from gridsec.interface import Explanation

MOST_COUNTED, _FELT = 12, 0.25
"""Largest count of an inverter's accusations; part of its largest effect that makes a meter its witness.

The count rises at a tick that accuses it and falls at others with a trusted reading of a witness.
"""


def name(
    design: SequentialDesign, before: Trust, seen: Examined, live: Bools, curves: Curves
) -> tuple[Trust, tuple[Explanation, ...]]:
    """Trust state with named meters and inverters, and rival hypotheses where one prevents a name.

    live: (p,) meters with a reading; silence releases none. curves: an inverter that follows its curve is not
    a rival.
    """
    trust = seen.trust
    if trust.calm and before.calm:
        return trust, ()
    open_ = trust.accused or any_of(trust.age) or any_of(before.named) or any_of(before.counted)
    if all_of(trust.trusted) and not open_:
        return trust, ()
    quiet = np.where(trust.still.any(axis=0), 0, trust.quiet + live)
    trusted = (trust.trusted & ~before.named) | (quiet >= design.options.release)
    # A meter detected again within the longest scale keeps its age.
    age = np.where(trusted & (quiet > design.lengths[-1]), 0, trust.age + ~trusted)
    owed = np.where(trusted, 0, np.maximum(trust.owed - live, 0))
    need = design.confirmed[trust.scale]
    fresh = ~trusted & ~before.named & trust.bad.any(axis=0) & (age >= need) & _accused(seen, trusted.size)
    named = before.named & (quiet < design.options.release)
    count, inverters = _inverters(design, before, trust, seen, live)
    new = inverters & ~before.inverters
    rivals: tuple[Explanation, ...] = ()
    if any_of(fresh) or any_of(new):
        found = _Rivals(design, fresh, new, curves.agrees(design))
        found.collect(seen)
        for meters, accused in found.ways():
            fresh, inverters = fresh & meters, inverters & (before.inverters | accused)
        rivals = found.explanations(live | before.named)
    trust = replace(
        trust,
        trusted=trusted,
        age=age,
        quiet=quiet,
        owed=owed,
        lag=np.where(trusted, 0, trust.lag),
        named=named | fresh,
        counted=count,
        inverters=inverters,
    )
    return trust, rivals


def supported(scales: Scales, before: Trust, seen: Examined, trust: Trust) -> Trust:
    """Trust state without new names that rest on meters that withhold powers."""
    fresh, vouched = trust.named & ~before.named, scales.doubts.vouched
    if all_of(vouched) or not any_of(fresh):
        return trust
    out = np.zeros_like(fresh)
    for s, now in enumerate(seen.fits):
        which = fresh & (trust.scale == s)
        beside = None if now is None or not any_of(which) else set_apart(now, vouched[s])
        if beside is not None:
            here = scales[s]
            judged = judge(beside.rest, here.m)
            out |= which & (np.abs(judged.offset) <= here.limits.of(judged.std))
    return replace(trust, named=trust.named & ~out) if any_of(out) else trust


def _accused(seen: Examined, meters: int) -> Bools:
    """Meters accused by the likeliest candidate of a scale that searched at this tick, (p,)."""
    out = np.zeros(meters, dtype=np.bool_)
    for found in seen.found.values():
        out |= ~found.best.trusted
    return out


def _inverters(
    design: SequentialDesign, before: Trust, trust: Trust, seen: Examined, live: Bools
) -> tuple[Ints, Bools]:
    """Ticks that accuse each inverter, and the named ones, (m,) each.

    An accusation counts at ticks with a search that accuses it; silence releases none.
    """
    accused = [k for k, _ in trust.accused]
    if not accused and not any_of(before.counted):
        return before.counted, before.inverters
    now = inverters_of(design, accused)
    less = np.where(_felt(design, before.counted > 0, live & trust.trusted), -1, 0)
    # An inverter named before a restart starts above that and counts down.
    most = np.maximum(MOST_COUNTED, before.counted + less)
    count = np.clip(before.counted + np.where(now, 1, less), 0, most)
    need, confirmed = np.full(now.size, MOST_COUNTED), design.confirmed
    for k, s in trust.accused:
        if k >= design.customers:
            need[k - design.customers] = min(confirmed[s], MOST_COUNTED)
    sought = inverters_of(design, [k for found in seen.found.values() for k in found.best.loosened])
    return count, (before.inverters & (count > 0)) | (now & sought & (count >= need))


def _felt(design: SequentialDesign, which: Bools, heard: Bools) -> Bools:
    """Inverters that move the voltage of some available meter, (m,)."""
    if all_of(heard) or not any_of(which):
        return which
    out, at = which.copy(), indices(which)
    own = design.plant.droop.customer[at]
    effect = np.abs(design.effects.columns(Power.REACTIVE, own)[design.prior.meters])
    most = effect.max(axis=0, initial=0.0)
    out[at] = effect[heard].max(axis=0, initial=0.0) >= np.maximum(_FELT * most, np.finfo(np.float64).tiny)
    return out


def inverters_of(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Inverters among accused faults, (m,)."""
    return _suspicions(design, accused)[design.customers : design.book.std.size]


def powers_of(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Customers with a false power among accused faults, (N,)."""
    return _suspicions(design, accused)[: design.customers]


def _busbar_of(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Busbar phases among accused faults, (b,)."""
    return _suspicions(design, accused)[design.book.std.size :]


def _suspicions(design: SequentialDesign, accused: Sequence[int]) -> Bools:
    """Accused powers, inverters and busbar phases, (N + m + b,)."""
    out = np.zeros(design.book.std.size + design.hangs_on.shape[1], dtype=np.bool_)
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
        self.out: dict[bytes, tuple[Bools, Bools, float, tuple[int, ...]]] = {}

    def collect(self, seen: Examined) -> None:
        """Take the candidates of every scale that searched."""
        for s, found in seen.found.items():
            view = seen.views[s]
            if view is not None:
                self._collect(found, view)
        if not any(self._differs(meters, inverters) for meters, inverters, *_ in self.out.values()):
            self.out.clear()

    def ways(self) -> list[tuple[Bools, Bools]]:
        """Meters and inverters that each accuses; meters without a reading are among the former."""
        return [(meters, inverters) for meters, inverters, *_ in self.out.values()]

    def explanations(self, heard: Bools) -> tuple[Explanation, ...]:
        """All of them, the likeliest first; meters without a reading, `heard` (p,) False, are left out."""
        design, total = self.design, sum(way[2] for way in self.out.values())
        return tuple(
            Explanation(
                meters & heard,
                inverters,
                weight / total,
                powers_of(design, loosened),
                _busbar_of(design, loosened),
            )
            for meters, inverters, weight, loosened in sorted(self.out.values(), key=lambda way: -way[2])
        )

    def _collect(self, found: Found, view: View) -> None:
        best, within = found.best, self.within
        near = [(~each.trusted, each.loosened, each.cost - best.cost) for each in (best, *found.others)]
        for swap in swaps(best, view.enough, within, view.limits):
            other = near[0][0].copy()
            other[swap.accused], other[swap.innocent] = False, True
            near.append((other, best.loosened, swap.worse))
        accused = (self.design.customers + indices(self.new)).tolist()
        for turn in turns(best, self.design.book, accused, self.others, within):
            loosened = tuple(turn.innocent if k == turn.accused else k for k in best.loosened)
            near.append((near[0][0], loosened, turn.worse))
        for k, (meters, loosened, worse) in enumerate(near):
            inverters = inverters_of(self.design, loosened)
            if not k or (worse <= within and self._differs(meters, inverters)):
                who, weight = meters.tobytes() + inverters.tobytes(), float(np.exp(-0.5 * worse))
                if who not in self.out or self.out[who][2] < weight:
                    self.out[who] = (meters, inverters, weight, loosened)

    def _differs(self, meters: Bools, inverters: Bools) -> bool:
        """True if a meter or inverter about to be named is left out."""
        return any_of(self.fresh & ~meters) or any_of(self.new & ~inverters)
