"""Masking of named meters, and their release.

A masked meter is unread by the filter and by the detector, from the onset of its fault on. The filter keeps
the posterior of its fixed error, so that the reading r of a masked meter is compared with its own past:

    r - (w + b)   has the variance   P + d   at one tick, and   P + d / n   as a mean of n ticks

with P the variance of w + b, which changes slowly, and d the white variance. Unknown directions U of the tick
have amounts x ~ N(0, `LASTS`^2) that last, where the filter has N(0, 1) at each tick. With its innovation nu
of covariance ``V = L L'``, ``A = L^-1 U``, ``G = A'A``, ``B = P H' L^-T A (I - G)^-1`` and C the posterior
covariance of x,

    C = (I / LASTS^2 + G (I - G)^-1)^-1,   x = C (I - G)^-1 A' L^-1 nu,
    r - (w + b) <- r - (w + b) - B (A' L^-1 nu - x) - U x,   P <- P - B (I - G) B' + (B - U) C (B - U)'

A meter agrees after n readings in turn within `OUTLIER` standard deviations, if their mean is within `AGREES`
of its own. n is at least `RELEASE`, and ``d <= n P``: more readings would hardly sharpen the comparison.
After `MOST` readings the mean decides at the latest, and the count begins anew.

**Release.** A wide P agrees with a lie, too. Of the meters that agree, with the means o of covariance S, the
set J may go on with the amounts a last seen, each within `VARIES` of itself:

    cost(J) = (o - a_J)' (S + VARIES^2 diag(a_J)^2)^-1 (o - a_J)

A meter is released if the least cost of the sets without it is below that of the sets with it by 2 `HONEST`,
or if it has agreed for `LONG` readings in turn. Costs are minimised by single changes, from the empty set and
from all meters: colluding ones support each other. The amount last seen is that of the search, or a smaller
one of a reading that disagrees: a single larger reading does not make the usual amount implausible.
After the release a meter is subject to the detector as any other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np
from scipy.linalg import lapack

from gridsec.arrays import Bools, Floats, Ints, any_of, indices, submatrix
from gridsec.estimators.modal.filter import Full, Innovation
from gridsec.estimators.modal.laterals import GAIN
from gridsec.estimators.modal.model import Modes

RELEASE, MOST = 6, 12
"""Least readings that agree before a release, and readings from which on the mean decides at the latest."""
OUTLIER = 4.0
"""Standard deviations of a single reading that disagrees, 1."""
AGREES = 3.0
"""Standard deviations of a mean that agrees, 1."""
LASTS = 0.2
"""Standard deviation of a lasting error along an unknown direction, in that of one tick of the filter, 1."""
VARIES = 0.25
"""Change of a manipulation that goes on, in standard deviations per amount last seen, 1."""
LONG = 600
"""Readings in turn that agree after which a meter is released in any case: ten minutes at one per second."""
HONEST = 2.0
"""Least logarithm of the ratio of likelihoods, honest to manipulated, of a release, 1: odds of seven."""


@dataclass(frozen=True, slots=True, eq=False)
class Masked:
    """Masked meters. t members.

    Attributes
    ----------
    meters : (t,)
        The masked ones.
    count : (t,)
        Readings in turn that agree, since the last comparison of their mean.
    total : (t,)
        Sum of their deviations, squared pu.
    amount : (t,)
        Manipulation as last seen, squared pu; 0: not seen, and agreement is enough.
    turn : (t,)
        Readings in turn that agree.
    """

    meters: Bools
    count: Ints
    total: Floats
    amount: Floats
    turn: Ints


def none(modes: Modes) -> Masked:
    """No masked meter."""
    count, total = np.zeros(modes.size, dtype=np.intp), np.zeros(modes.size)
    return Masked(np.zeros(modes.size, dtype=np.bool_), count, total, total, count)


def added(masked: Masked, meters: Bools, amount: Floats | float = 0.0) -> Masked:
    """The same with more meters (t,), their count at 0, and their amounts, squared pu (t,), where not 0."""
    before = np.where(masked.meters, masked.amount, 0.0)
    return Masked(
        masked.meters | meters,
        np.where(meters, 0, masked.count),
        np.where(meters, 0.0, masked.total),
        np.where(meters & (np.asarray(amount) != 0.0), amount, before),
        np.where(meters, 0, masked.turn),
    )


def without(masked: Masked, meters: Bools) -> Masked:
    """The same without some meters (t,)."""
    return replace(added(masked, meters), meters=masked.meters & ~meters)


def follow(  # noqa: PLR0917  # the masked meters, and one tick
    modes: Modes,
    masked: Masked,
    full: Full,
    tick: Innovation | None,
    m: Floats,
    seen: Bools | None,
    unknown: Floats | None = None,
) -> Masked:
    """Take in the readings of one tick, and release the meters that are honest.

    Parameters
    ----------
    modes, masked
        The modes, and the masked meters.
    full, tick
        The exact filter after the tick, without their readings, and its innovation.
    m, seen : (t,)
        Residuals, and members with a reading, the masked ones included; None: all.
    unknown : (t, k)
        As in `gridsec.estimators.modal.full.step`.
    """
    at, d = indices(masked.meters), modes.noise.diagonal()
    off, slow = deviations(full, tick, m, at, unknown)
    wide, read = np.zeros_like(d), masked.meters if seen is None else masked.meters & seen
    wide[at] = slow.diagonal()
    fits = np.zeros_like(read)
    fits[at] = off[at] ** 2 <= OUTLIER**2 * (wide + d)[at]
    count = np.where(read, np.where(fits, masked.count + 1, 0), masked.count)
    total = np.where(read, np.where(fits, masked.total + off, 0.0), masked.total)
    n = np.maximum(count, 1)
    mean, full_count = total / n, count >= MOST
    agrees = read & (full_count | ((count >= RELEASE) & (d <= n * wide)))
    agrees &= mean**2 <= AGREES**2 * (wide + d / n)
    turn = np.where(read, np.where(fits, masked.turn + 1, 0), masked.turn)
    released, amount = agrees & ((masked.amount == 0.0) | (turn >= LONG)), masked.amount
    smaller = read & ~fits & ((amount == 0.0) | (np.abs(off) < np.abs(amount)))
    amount = np.where(smaller, off, amount)
    if any_of(agrees & ~released):
        some = agrees[at]
        least = np.sqrt(n[agrees])
        S = slow[np.ix_(some, some)] + modes.noise[np.ix_(agrees, agrees)] / np.outer(least, least)
        released[agrees] |= evidence(S, mean[agrees], amount[agrees]) >= HONEST
    return Masked(
        masked.meters & ~released,
        np.where(full_count, 0, count),
        np.where(full_count, 0.0, total),
        amount,
        turn,
    )


def deviations(
    full: Full, tick: Innovation | None, m: Floats, at: Ints, unknown: Floats | None
) -> tuple[Floats, Floats]:
    """Deviations of readings from the filter, (t,), and their covariance at members `at` without D, (k, k).

    Parameters
    ----------
    full, tick, m, unknown
        As in `follow`; members `at` have no part in the innovation.
    at : (k,)
        The members.
    """
    w, both, b = (submatrix(each, at, at) for each in full.blocks)
    off, P = m - full.mean[0] - full.mean[1], w + both + both.T + b
    if unknown is None or tick is None:
        return off, P
    if not tick.rows.size:
        return off, P + LASTS**2 * (unknown[at] @ unknown[at].T)
    t, one = full.seen.size, np.eye(unknown.shape[1])
    A, _ = lapack.dtrtrs(tick.half, unknown[tick.rows], lower=True)
    G = A.T @ A
    alone, pull = np.linalg.inv(one - G), A.T @ tick.white
    C = np.linalg.inv(one / LASTS**2 + G @ alone)
    B, amounts = (tick.gain[:t] + tick.gain[t:]) @ (A @ alone), C @ (alone @ pull)
    apart = (B - unknown)[at]
    off = off - B @ (pull - amounts) - unknown @ amounts
    return off, P - B[at] @ (one - G) @ B[at].T + apart @ C @ apart.T


def evidence(S: Floats, mean: Floats, amount: Floats) -> Floats:
    """Logarithm of the ratio of likelihoods, honest to manipulated, of each of k meters, (k,).

    Parameters
    ----------
    S : (k, k)
        Covariance of their mean deviations, where they are honest.
    mean : (k,)
        The mean deviations.
    amount : (k,)
        Manipulations as last seen; a meter with 0 counts as honest.
    """
    known = amount != 0.0
    least = np.full((2, amount.size), inf)
    for start in (np.zeros_like(known), known):
        chosen = start.copy()
        cost, change = _changes(S, mean, amount, chosen)
        while change.min() < -GAIN:
            chosen[change.argmin()] ^= True
            cost, change = _changes(S, mean, amount, chosen)
        each = cost + np.stack([np.where(chosen, change, 0.0), np.where(chosen, 0.0, change)])
        least = np.minimum(least, each)
    return np.asarray(0.5 * (least[1] - least[0]))


def _changes(S: Floats, mean: Floats, amount: Floats, chosen: Bools) -> tuple[float, Floats]:
    """Cost of a set, and its change by each meter added or removed, (k,); infinite for an amount of 0."""
    v, sign = (VARIES * amount) ** 2, np.where(chosen, -1.0, 1.0)
    inverse, r = np.linalg.inv(S + np.diag(v * chosen)), mean - amount * chosen
    z, i = inverse @ r, inverse.diagonal()
    # The changed deviation by the unchanged covariance, and the formula of Sherman and Morrison.
    moved = amount * (amount * i - 2.0 * sign * z)
    moved -= sign * v * (z - sign * amount * i) ** 2 / (1.0 + sign * v * i)
    return float(r @ z), np.where(amount != 0.0, moved, inf)
