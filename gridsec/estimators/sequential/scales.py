"""What every scale judges by: its means and limits, the view of a fit, and fits made from one another.

References
----------
docs/theory-sequential.md, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil

import numpy as np

from gridsec.arrays import Bools, Floats, any_of, indices
from gridsec.estimators.sequential.blocks import sound, without
from gridsec.estimators.sequential.commission import Learned
from gridsec.estimators.sequential.conditional import Fit, Judged, Prior, admit, drop, fit
from gridsec.estimators.sequential.design import SequentialDesign
from gridsec.estimators.sequential.dictionary import Dictionary
from gridsec.estimators.sequential.doubts import Doubts
from gridsec.estimators.sequential.search import Limits
from gridsec.estimators.sequential.skew import Skew
from gridsec.estimators.sequential.state import Trust
from gridsec.estimators.sequential.windows import Window


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one scale says. p meters.

    Attributes
    ----------
    judged
        Every meter, judged by the trusted others.
    enough : (p,)
        Meters with enough readings on this scale.
    limit : (p,)
        Largest honest offset, squared pu.
    over : (p,)
        Whose offset is larger.
    limits, lower
        How the limits come about, and the part of `sigmas` that is expected of a meter that is to be
        trusted again.
    """

    judged: Judged
    enough: Bools
    limit: Floats
    over: Bools
    limits: Limits
    lower: float

    @property
    def still(self) -> Bools:
        """Whose offset is larger than what is expected of a meter that is to be trusted again, (p,)."""
        judged = self.judged
        return self.enough & (np.abs(judged.offset) > self.limits.of(judged.std, self.lower))


# A fit is made anew when that part of its meters changed, or after so many changes (rounding).
_ANEW = 6
# Unless all that changed is that some fell, no more than that part of all meters, since a factorisation.
_WHOLE = 3
_MOST_CHANGES = 400


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """What one scale has to judge by. p meters.

    Attributes
    ----------
    prior
        What the powers may do.
    noise : (p,)
        Variance of each meter's mean, squared pu^2.
    m : (p,)
        Mean residual, squared pu.
    enough : (p,)
        Meters with enough readings.
    limits
        What is evidence.
    """

    prior: Prior
    noise: Floats
    m: Floats
    enough: Bools
    limits: Limits


def needed(design: SequentialDesign, s: int) -> int:
    """Readings of a meter that a scale judges it by at least.

    Parameters
    ----------
    design
        The design.
    s
        The scale.
    """
    return max(1, ceil(design.options.enough * design.lengths[s]))


class Scales:
    """All scales at one tick, by index.

    Parameters
    ----------
    design
        The design.
    doubts, window, learned
        What is not known of powers, the last residuals, and what is known of the meters' errors.
    model : (p,)
        What the model may be off, squared pu.
    skew
        Changes of the voltages within clock offsets; None for none.
    """

    def __init__(  # noqa: PLR0917  # what every scale is made of
        self,
        design: SequentialDesign,
        doubts: Doubts,
        window: Window,
        learned: Learned,
        model: Floats,
        skew: Skew | None = None,
    ) -> None:
        self.design, self.doubts, self.window, self.model = design, doubts, window, model
        self.learned, self.skew, self.made = learned, skew, dict[int, Scale]()

    @cached_property
    def book(self) -> Dictionary:
        """What else but meters can be wrong now."""
        return replace(self.design.book, std=self.doubts.sizes)

    def __getitem__(self, s: int) -> Scale:
        if s not in self.made:
            self.made[s] = self._scale(s)
        return self.made[s]

    def _scale(self, s: int) -> Scale:
        design, counts, learned = self.design, self.window.counts[s], self.learned
        need = needed(design, s)
        noise, enough = design.white / need + learned.variance, counts >= need
        if self.skew is not None:
            noise, enough = noise + self.skew.variance[s], enough & ~self.skew.aside[s]
        return Scale(
            prior=self.doubts.priors[s],
            noise=noise,
            m=self.window.sums[s] / np.maximum(counts, 1),
            enough=enough,
            limits=Limits(
                *(design.sigmas[s], self.model, learned.allowed, learned.variance, design.most, learned.late),
                learned.recent[s],
            ),
        )

    def loosened(self, accused: tuple[tuple[int, int], ...]) -> Floats | None:
        """Loosened directions with their standard deviations, (n, k); None for none.

        Parameters
        ----------
        accused
            Indices of the book, each with a scale.
        """
        if not accused:
            return None
        which = np.array([k for k, _ in accused])
        return np.asarray(self.book.columns(which) * self.book.std[which])

    def wider(self, direction: Floats) -> Scales:
        """The same with priors that leave one more direction open.

        Parameters
        ----------
        direction : (n,)
            As in `Prior.wider`.
        """
        each = {id(prior): prior.wider(direction) for prior in self.doubts.priors}
        doubts = replace(self.doubts, priors=tuple(each[id(prior)] for prior in self.doubts.priors))
        return Scales(self.design, doubts, self.window, self.learned, self.model, self.skew)


def view_of(design: SequentialDesign, here: Scale, judged: Judged) -> View:
    """What a scale says of every meter when it rests on a fit.

    Parameters
    ----------
    design, here, judged
        The design, the scale, and every meter judged by the fit.
    """
    limit = here.limits.of(judged.std)
    over = here.enough & (np.abs(judged.offset) > limit)
    return View(judged, here.enough, limit, over, here.limits, design.options.lower)


def adapt(before: Fit | None, here: Scale, wanted: Bools, loose: Floats | None) -> Fit:
    """A fit of the wanted meters, from the last one where that is cheaper.

    Parameters
    ----------
    before
        The last fit of this scale.
    here
        The scale.
    wanted : (p,)
        The meters to rest on.
    loose : (n, k)
        Loosened directions.
    """
    prior, noise = here.prior, here.noise
    if before is None or before.prior is not prior:
        return fit(prior, noise, wanted, loose)
    if before.loose.shape[1] if loose is None else not np.array_equal(before.loose, loose):
        return fit(prior, noise, wanted, loose)
    differs = before.trusted != wanted
    if not any_of(differs):
        return before
    change = indices(differs)
    many = change.size * _ANEW > wanted.size
    few = not before.changes and change.size * _WHOLE < wanted.size and not any_of(wanted[change])
    if many and few and sound(prior, before.noise):
        return without(before, differs)
    if many or before.changes + change.size > _MOST_CHANGES:
        return fit(prior, noise, wanted, loose)
    now = before.copy()
    for j in change.tolist():
        (admit if wanted[j] else drop)(now, j)
    return now


def believe(trust: Trust, trusted: Bools, s: int, accused: tuple[tuple[int, int], ...]) -> Trust:
    """Whom an explanation leaves trusted.

    Parameters
    ----------
    trust
        Who was believed.
    trusted : (p,)
        Who is.
    s
        The scale that it was found on.
    accused
        What else is suspected, each with a scale.
    """
    fallen = trust.trusted & ~trusted
    scale, quiet = np.where(fallen, s, trust.scale), np.where(fallen, 0, trust.quiet)
    return replace(trust, trusted=trusted, scale=scale, quiet=quiet, accused=accused)
