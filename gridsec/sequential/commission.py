"""What a meter's own fixed error is, learned while nothing speaks against it.

A meter of class 0.5 may be off by 0.5 %, always by the same amount; a lie of that size is no evidence. But
the amount can be learned: over a long time the load errors cancel, and what is left of a meter's residual
is its own. With B the prior variance of the fixed errors and M the long-run means,

    cov M = B + S / n_eff + D / n,      b_hat = B (cov M)^-1 M,      P = B - B (cov M)^-1 B

where S / n_eff is what the loads' errors still contribute: their mean over a time T has the variance
``2 rho (1 - rho (1 - exp(-1 / rho)))`` times that at one instant, ``rho = time_s / T``.
After that a meter counts as manipulated when it *changes*, even inside its class.

References
----------
docs/theory-sequential.md, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from gridsec.arrays import Bools, Floats, Ints
from gridsec.sequential.design import SequentialDesign


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What is known of the meters' fixed errors. p meters.

    Attributes
    ----------
    bias : (p,)
        Expected fixed error, squared pu.
    variance : (p,)
        Its variance.
    allowed : (p,)
        Largest honest change from it, squared pu.
    """

    bias: Floats
    variance: Floats
    allowed: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Learning:
    """What was gathered so far. p meters.

    Attributes
    ----------
    total : (p,)
        Sum of each meter's residuals while it was trusted, squared pu.
    count : (p,)
        How many they are.
    time_s
        Time over which they were gathered, s.
    """

    total: Floats
    count: Ints
    time_s: float


def nothing(design: SequentialDesign) -> Learned:
    """What the accuracy class alone says.

    Parameters
    ----------
    design
        The design.
    """
    return Learned(np.zeros(design.allowed.size), design.fixed, design.allowed)


def begin(meters: int) -> Learning:
    """Nothing gathered yet.

    Parameters
    ----------
    meters
        p.
    """
    return Learning(np.zeros(meters), np.zeros(meters, dtype=np.intp), 0.0)


def gather(before: Learning, residual: Floats, use: Bools, h: float) -> Learning:
    """Take one tick in.

    Parameters
    ----------
    before
        So far.
    residual : (p,)
        Readings minus what the model explains.
    use : (p,)
        Meters that are trusted and have a reading.
    h
        Time since the last tick, s.
    """
    return replace(
        before,
        total=before.total + np.where(use, residual, 0.0),
        count=before.count + use,
        time_s=before.time_s + h,
    )


def conclude(design: SequentialDesign, gathered: Learning) -> Learned:
    """The meters' fixed errors; meters with no reading at all keep their class.

    Parameters
    ----------
    design
        The design.
    gathered
        From `gather`.
    """
    heard = np.flatnonzero(gathered.count)
    known = nothing(design)
    if not heard.size or not gathered.time_s > 0:
        return known
    B, n = design.fixed[heard], gathered.count[heard]
    rho = design.doubt.time_s / gathered.time_s
    share = 2.0 * rho * (1.0 + rho * np.expm1(-1.0 / rho))
    K = share * design.prior.between[np.ix_(heard, heard)] + np.diag(B + design.white[heard] / n)
    factor = cho_factor(K, lower=True, check_finite=False)
    bias, variance, allowed = known.bias.copy(), known.variance.copy(), known.allowed.copy()
    bias[heard] = B * cho_solve(factor, gathered.total[heard] / n)
    left = B - B * B * cho_solve(factor, np.eye(heard.size)).diagonal()
    aging = design.options.stability * design.allowed[heard]
    # A uniform error of half-width a has the variance a^2 / 3.
    variance[heard] = np.minimum(np.maximum(left, 0.0) + aging**2 / 3.0, B)
    allowed[heard] = np.minimum(aging + 3.0 * np.sqrt(np.maximum(left, 0.0)), known.allowed[heard])
    return Learned(bias, variance, allowed)
