"""Whom the monitor does not believe, apart from all else it carries: what survives when it begins anew.

Means over many ticks are empty when a monitor begins, so small lies, which only long means tell from
chance, would pass for honest until these are full again. What a scale found therefore stands until it has
enough readings to say something else.

References
----------
docs/theory-sequential.md, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.sequential.design import SequentialDesign
from gridsec.sequential.kinds import suspicious
from gridsec.sequential.naming import MOST_COUNTED
from gridsec.sequential.scales import needed
from gridsec.sequential.state import SequentialState


@dataclass(frozen=True, slots=True, eq=False)
class Distrust:
    """Who is not believed. p meters, m inverters.

    Attributes
    ----------
    scale_s : (p,)
        Time scale on which each distrusted meter was caught, s; NaN for those that are trusted.
    named : (p,)
        Meters named as manipulated; all of them are distrusted.
    inverters : (m,)
        Inverters named as manipulated.
    """

    scale_s: Floats
    named: Bools
    inverters: Bools

    @property
    def empty(self) -> bool:
        """Whether everybody is believed."""
        return not (np.isfinite(self.scale_s).any() or self.inverters.any())

    def same(self, other: Distrust) -> bool:
        """Whether another says the same.

        Parameters
        ----------
        other
            Of the same feeder.
        """
        return (
            np.array_equal(self.scale_s, other.scale_s, equal_nan=True)
            and np.array_equal(self.named, other.named)
            and np.array_equal(self.inverters, other.inverters)
        )

    def without(self, which: Bools) -> Distrust:
        """What is left when some meters were replaced.

        Parameters
        ----------
        which : (p,)
            The meters.
        """
        return replace(self, scale_s=np.where(which, np.nan, self.scale_s), named=self.named & ~which)


def nobody(meters: int, inverters: int) -> Distrust:
    """Everybody is believed.

    Parameters
    ----------
    meters, inverters
        p and m.
    """
    no, none = np.zeros(meters, dtype=np.bool_), np.zeros(inverters, dtype=np.bool_)
    return Distrust(np.full(meters, np.nan), no, none)


def distrusted(design: SequentialDesign, state: SequentialState) -> Distrust:
    """Whom a state does not believe.

    Parameters
    ----------
    design, state
        The design, and the state after a tick.
    """
    trust = state.trust
    inverters = trust.inverters if state.last is None else state.last[1].inverters
    if trust.trusted.all() and not inverters.any():
        return nobody(trust.trusted.size, inverters.size)
    scales_s = np.array(design.lengths) * design.step_s
    # Repetition shows on no scale; the longest is what is left to judge such a meter by.
    scale = np.where(suspicious(state.kinds), len(design.lengths) - 1, trust.scale)
    return Distrust(np.where(trust.trusted, np.nan, scales_s[scale]), trust.named, inverters)


def restore(design: SequentialDesign, state: SequentialState, before: Distrust) -> SequentialState:
    """Go on distrusting who was, from a state that has not seen any frame.

    A meter is trusted again as always, but not before it has given as many readings as its scale needs to
    judge, and the observer has settled; an inverter that is named, as many as the longest scale needs.

    Parameters
    ----------
    design, state
        The design, and a state from `init`.
    before
        Who was distrusted.
    """
    if before.empty:
        return state
    trust, which = state.trust, np.isfinite(before.scale_s)
    scales_s = np.array(design.lengths) * design.step_s
    # The scales may have changed since: the closest.
    far = np.abs(np.log(np.where(which, before.scale_s, 1.0)[:, None] / scales_s))
    scale = np.where(which, far.argmin(axis=1), trust.scale)
    need, settling = np.array([needed(design, s) for s in range(scales_s.size)]), _settling(design, state)
    still = trust.still.copy()
    still[scale[which], np.flatnonzero(which)] = True
    longest = max(int(need[-1]), int(settling.max(initial=0)))
    return replace(
        state,
        trust=replace(
            trust,
            trusted=~which,
            scale=scale,
            age=np.where(before.named, design.confirmed[scale], which),
            still=still,
            owed=np.where(which, np.maximum(need[scale], settling), 0),
            named=before.named & which,
            counted=np.where(before.inverters, longest + MOST_COUNTED, 0),
            inverters=before.inverters,
        ),
    )


def _settling(design: SequentialDesign, state: SequentialState) -> Ints:
    """Ticks until the unknown initial state moves each meter by less than matters, (p,)."""
    least = design.options.settled * np.maximum(state.learned.allowed, np.finfo(np.float64).tiny)
    more = np.log(np.maximum(design.reach / least, 1.0))
    rate = design.certificate.rate * design.step_s
    return np.asarray(np.where(more > 0.0, np.ceil(more / rate), 0.0)).astype(np.intp)
