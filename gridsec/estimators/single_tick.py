"""Estimators of single ticks: decoders over all sets of at most M manipulated meters.

With ``Q = (S + D)^-1`` the inverse covariance of the readings m without manipulation, leaving out the meters
of a set s gives

    misfit(s) = m^T Q m - b^T G^-1 b,      b = (Q m)_s,    G = Q_ss

and the normalised residuals of the remaining meters follow from the same solve.

They share the model ``m = w + e + a`` of `gridsec.estimators.sequential`: w is the effect of the loads'
errors on all voltages, known by its covariance S (pseudo-measurements of the loads, which cannot be
attacked); e are the errors of unmanipulated meters; a is the attack, in as few entries as possible.

Source: lee2018, chapter 2, (2.2.8'), Remark 2.2.1; docs/theory-snapshot.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
from scipy.special import chdtri, ndtr

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt, SequentialDesign, SequentialOptions
from gridsec.estimators.sequential import design as sequential_design
from gridsec.estimators.sequential.conditional import drop, judge
from gridsec.estimators.sequential.decoder import Accused, Decoder, Evidence
from gridsec.secure.decode.search import basis_pursuit, matching_pursuit

MOST_SETS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class SetMisfits:
    """Every set of one size. c sets of k meters."""

    members: Ints  # (c, k) meters of each set
    misfit: Floats  # (c,) misfit without each set
    excess: Floats  # (c,) largest offset of a remaining meter relative to its limit


def check(candidates: int, most: int) -> None:
    """Refuse a search that would take too long.

    Raises DesignInfeasible if there would be more than `MOST_SETS` sets.
    """
    count = sum(comb(candidates, k) for k in range(most + 1))
    if count > MOST_SETS:
        raise DesignInfeasible(
            "search over all sets",
            f"{count} sets of up to {most} of {candidates}; at most {MOST_SETS}",
            None,
            code="too-many",
        )


def outcomes(evidence: Evidence, size: int) -> SetMisfits:
    """Evaluate every set of `size` meters."""
    Q, m = evidence.whole.Q, evidence.m
    weights = Q @ m
    sets = list(combinations(np.flatnonzero(evidence.live).tolist(), size))
    members = np.array(sets, dtype=np.intp).reshape(len(sets), size)
    b, columns = weights[members], Q[:, members].transpose(1, 0, 2)
    G = Q[members[:, :, None], members[:, None, :]]
    solved = np.linalg.solve(G, np.concatenate([b[:, :, None], columns.transpose(0, 2, 1)], axis=2))
    left = weights - np.einsum("cpr,cr->cp", columns, solved[:, :, 0])
    precision = Q.diagonal() - np.einsum("cpr,crp->cp", columns, solved[:, :, 1:])
    judged = np.broadcast_to(evidence.live, precision.shape) & (precision > 0)
    judged[np.arange(len(sets))[:, None], members] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        offset, std = np.abs(left / precision), 1.0 / np.sqrt(precision)
        excess = np.where(judged, offset / evidence.limits.of(std), 0.0)
    misfit = float(m @ weights) - np.einsum("cr,cr->c", b, solved[:, :, 0])
    return SetMisfits(members, misfit, excess.max(axis=1, initial=0.0))


def least_squares(evidence: Evidence) -> tuple[Accused, ...]:
    """Weighted least squares with the chi-square test; remove the largest normalised residual and repeat.

    Returns tuple of Accused: at most `most` meters, in the order of their residuals; a removed meter never
        returns.
    Source: lee2018, Algorithm 2.2 with the corrected degrees of freedom.
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

    Returns tuple of Accused: the set with the smallest misfit among those of the smallest size, and its
        rivals; the best set of the largest size if no set leaves all others within the limits.
    Source: lee2018 (2.2.8'): l0 decoding with bounded noise, the sets tried in the order of their size.
    """
    within = 2.0 * float(np.log(evidence.like))
    found: SetMisfits | None = None
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

    Source: lee2018 (2.1.4); Theorem 2.1.1 for when it is exact.
    """
    at, F, y = _stack(evidence)
    attack = np.sqrt(evidence.whole.noise[at]) * basis_pursuit(F, y)[: at.size]
    return (_beyond(evidence, at, attack),)


def match(evidence: Evidence) -> tuple[Accused, ...]:
    """Orthogonal matching pursuit on the whitened readings: column after column, without removal.

    Source: lee2018, Algorithm 2.1, Theorem 2.1.2.
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


def _answer(live: Bools, found: SetMisfits, which: int, best: int) -> Accused:
    accused = np.zeros(live.size, dtype=np.bool_)
    accused[found.members[which]] = True
    return Accused(accused, float(found.misfit[which] - found.misfit[best]))


def design(
    plant: Plant,
    decoder: Decoder,
    *,
    doubt: LoadDoubt,
    step_s: float,
    max_attacked: int,
    alarms_per_year: float = 1.0,
) -> SequentialDesign:
    """Design with a decoder; `gridsec.estimators.sequential.init` and `step` run it.

    step_s: expected interval between frames, s.
    max_attacked: M, the largest number of accusations.
    alarms_per_year: expected false alarms per year.
    Raises NotObservable, ValueError as `gridsec.estimators.sequential.design`; DesignInfeasible if no
        certificate holds, or the decoder has too many sets to try.
    """
    options = SequentialOptions(alarms_per_year=alarms_per_year, scales_s=(0.0,), commission_s=0.0)
    made = sequential_design(plant, doubt=doubt, step_s=step_s, options=options, max_attacked=max_attacked)
    if decoder is fewest:
        check(plant.meters.size, max_attacked)
    return replace(made, decoder=decoder)
