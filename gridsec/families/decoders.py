"""The papers' methods to identify manipulated meters, as decoders of one tick of a feeder.

They share the model ``m = w + e + a`` of `gridsec.sequential`: w is the effect of the loads' errors on all
voltages, known by its covariance S (pseudo-measurements of the loads, which cannot be attacked); e are the
errors of unmanipulated meters; a is the attack, in as few entries as possible.

References
----------
lee2018, chapter 2; docs/theory-snapshot.md.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, ndtr

from gridsec.arrays import Bools, Floats, Ints
from gridsec.decode.sparse import basis_pursuit, matching_pursuit
from gridsec.families.sets import Outcome, outcomes
from gridsec.sequential.conditional import drop, judge
from gridsec.sequential.decoder import Accused, Evidence


def least_squares(evidence: Evidence) -> tuple[Accused, ...]:
    """Weighted least squares with the chi-square test; remove the largest normalised residual and repeat.

    Returns
    -------
    tuple of Accused
        At most `most` meters, in the order of their residuals; a removed meter never returns.

    References
    ----------
    lee2018, Algorithm 2.2 with the corrected degrees of freedom.
    """
    now, live = evidence.whole.copy(), evidence.live
    accused = np.zeros(live.size, dtype=np.bool_)
    alarm = float(np.clip(2.0 * ndtr(-evidence.limits.sigmas) * max(live.sum(), 1), 1e-300, 0.5))
    for _ in range(evidence.most):
        judged = judge(now, evidence.m)
        freedom = int(np.count_nonzero(now.trusted))
        offset = np.abs(judged.offset) / evidence.limits.of(judged.std)
        worst = int(np.argmax(np.where(now.trusted, offset, -1.0)))
        if not freedom or (judged.misfit <= chdtri(freedom, alarm) and offset[worst] <= 1.0):
            break
        accused[worst] = True
        drop(now, worst)
    return (Accused(accused),)


def fewest(evidence: Evidence) -> tuple[Accused, ...]:
    """The smallest set of meters without which every other one is within its limits.

    Returns
    -------
    tuple of Accused
        The set with the smallest misfit among those of the smallest size, and its rivals; the best set of the
        largest size if no set leaves all others within the limits.

    References
    ----------
    lee2018 (2.2.8'): l0 decoding with bounded noise, the sets tried in the order of their size.
    """
    within = 2.0 * float(np.log(evidence.like))
    found: Outcome | None = None
    for size in range(min(evidence.most, int(np.count_nonzero(evidence.live))) + 1):
        found = outcomes(evidence, size)
        fine = np.flatnonzero(found.excess <= 1.0)
        if fine.size:
            order = fine[np.argsort(found.misfit[fine], kind="stable")]
            near = order[found.misfit[order] - found.misfit[order[0]] <= within]
            return tuple(_answer(evidence.live, found, int(c), int(order[0])) for c in near)
    assert found is not None  # noqa: S101  # size 0 is always tried
    best = int(np.argmin(found.misfit))
    return (_answer(evidence.live, found, best, best),)


def pursue(evidence: Evidence) -> tuple[Accused, ...]:
    """Basis pursuit: the attack and load errors of smallest weighted sum that explain the readings exactly.

    ``min |a / sigma|_1 + |c|_1`` subject to ``a + V c = m`` with ``S = V V^T``: the stack of readings and
    pseudo-measurements, annihilated. Meters with a share beyond their limit are accused.

    References
    ----------
    lee2018 (2.1.4); Theorem 2.1.1 for when it is exact.
    """
    at, F, y = _stack(evidence)
    attack = np.sqrt(evidence.whole.noise[at]) * basis_pursuit(F, y)[: at.size]
    return (_beyond(evidence, at, attack),)


def match(evidence: Evidence) -> tuple[Accused, ...]:
    """Orthogonal matching pursuit on the whitened readings: column after column, without removal.

    References
    ----------
    lee2018, Algorithm 2.1, Theorem 2.1.2.
    """
    at = np.flatnonzero(evidence.live)
    if not at.size:
        return (Accused(np.zeros_like(evidence.live)),)
    root = np.asarray(np.linalg.cholesky(evidence.whole.Q[np.ix_(at, at)]).T, np.float64)
    attack, _ = matching_pursuit(root, root @ evidence.m[at], min(evidence.most, at.size))
    return (_beyond(evidence, at, attack),)


def _stack(evidence: Evidence) -> tuple[Ints, Floats, Floats]:
    """Columns of unit weight: those of the meters, then the principal directions of the loads' covariance."""
    at = np.flatnonzero(evidence.live)
    prior = evidence.whole.prior
    S = prior.among(at)
    values, vectors = np.linalg.eigh(S)
    keep = values > values.max(initial=0.0) * at.size * np.finfo(np.float64).eps
    F = np.hstack([np.diag(np.sqrt(evidence.whole.noise[at])), vectors[:, keep] * np.sqrt(values[keep])])
    return at, F, evidence.m[at]


def _beyond(evidence: Evidence, at: Ints, attack: Floats) -> Accused:
    """Accuse the meters with a share of the attack beyond their limit."""
    now = judge(evidence.whole, evidence.m)
    accused = np.zeros(evidence.live.size, dtype=np.bool_)
    accused[at] = np.abs(attack) > evidence.limits.of(now.std)[at]
    return Accused(accused)


def _answer(live: Bools, found: Outcome, which: int, best: int) -> Accused:
    accused = np.zeros(live.size, dtype=np.bool_)
    accused[found.members[which]] = True
    return Accused(accused, float(found.misfit[which] - found.misfit[best]))
