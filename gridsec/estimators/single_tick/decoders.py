"""Decoders of single ticks: sets of at most M manipulated meters that explain the readings of one tick.

    least_squares, fewest, pursue, match (DecoderInput) -> (DecoderAnswer, ...)

The readings of p meters less their prediction by the model are

    m = w + e + a,   w ~ N(0, S),   e ~ N(0, D).

w is the effect of the errors of loads, injections and busbar, e the error of the meters. a is the attack, in
as few entries as possible. Pseudo-measurements of the loads cannot be attacked. With ``Q = (S + D)^-1`` the
precision of honest readings, leaving out the meters of a set s gives

    misfit(s) = m^T Q m - b^T G^-1 b,      b = (Q m)_s,    G = Q_ss

and the leave-one-out residuals of the remaining meters follow from the same solve.

Source: lee2018, chapter 2, (2.2.8'), Remark 2.2.1; docs/theory-snapshot.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.special import chdtri, ndtr

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.estimators.front.posterior import LeaveOneOut, Posterior, leave_one_out, remove_meter
from gridsec.secure.decode.search import basis_pursuit, matching_pursuit

MOST_SETS = 20_000
"""Largest number of sets that a search tries: 0.1 s of processor time for 49 meters and M = 3."""

RIVAL_RATIO = 100.0
"""Largest likelihood ratio of the best set to a rival, 1: a rarer rival has less than 1 % at equal priors."""


# --- Input and output ---


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Limits of honest leave-one-out residuals. p meters."""

    sigmas: float  # standard deviations within chance, 1
    model: Floats  # (p,) largest error of the model, squared pu
    allowed: Floats  # (p,) largest fixed error of a meter by its class, squared pu
    fixed: Floats  # (p,) variance of the fixed errors within the noise, squared pu^2

    def limit(self, std: Floats) -> Floats:
        """``model + min(sigmas s, allowed + sigmas sqrt(s^2 - fixed))`` for standard deviations s (p,)."""
        rest = np.sqrt(np.maximum(std * std - self.fixed, 0.0))
        return np.asarray(self.model + np.minimum(self.sigmas * std, self.allowed + self.sigmas * rest))

    def chi_square(self, meters: int, freedom: int) -> float:
        """Quantile of chi-square at the probability of the limits of `meters` > 0 meters together, 1."""
        alarm = float(np.clip(2.0 * ndtr(-self.sigmas) * meters, _LEAST_TAIL, 0.5))
        return float(chdtri(freedom, alarm))


_LEAST_TAIL = 1e-300
"""Least tail probability with a finite quantile, 1."""


def misfits(now: Posterior, loo: LeaveOneOut, limits: Limits, meters: int | None = None) -> bool:
    """True where the trusted meters of a posterior, taken together, are beyond chance and the model's error.

    An error of the model of at most e_j at meter j adds at most ``sqrt(e^T |Q| e)`` to ``sqrt(m^T Q m)``. The
    probability by chance is that of the limits of `meters` meters together, of the trusted ones by default.
    """
    count = int(np.count_nonzero(now.trusted))
    if not count:
        return False
    quantile = limits.chi_square(count if meters is None else meters, count)
    beyond = np.sqrt(max(loo.chi_square, 0.0)) - np.sqrt(quantile)
    return bool(beyond > 0.0 and beyond > np.sqrt(limits.model @ np.abs(now.Q) @ limits.model))


@dataclass(frozen=True, slots=True, eq=False)
class DecoderInput:
    """Input of a decoder. p meters."""

    whole: Posterior  # posterior of all meters with a reading; not changed
    m: Floats  # (p,) readings less their prediction, squared pu; any finite value without a reading
    available: Bools  # (p,) meters with a reading
    limits: Limits  # limits of honest residuals
    max_attacked: int  # M, largest number of accusations


@dataclass(frozen=True, slots=True, eq=False)
class DecoderAnswer:
    """Set of manipulated meters. p meters."""

    meters: Bools  # (p,) accused meters
    worse: float = 0.0  # misfit above that of the best answer, 1


Decoder = Callable[[DecoderInput], tuple[DecoderAnswer, ...]]
"""The best answer first, then its rivals."""


# --- Weighted least squares ---


def least_squares(evidence: DecoderInput) -> tuple[DecoderAnswer, ...]:
    """Weighted least squares with the chi-square test; remove the largest normalised residual and repeat.

    A removed meter never returns.

    Source: lee2018, Algorithm 2.2 with the corrected degrees of freedom.
    """
    now, limits = evidence.whole.copy(), evidence.limits
    accused = np.zeros(evidence.available.size, dtype=np.bool_)
    meters = int(np.count_nonzero(evidence.available))
    for _ in range(evidence.max_attacked):
        loo = leave_one_out(now, evidence.m)
        excess = np.where(now.trusted, np.abs(loo.residual) / limits.limit(loo.std), 0.0)
        worst = int(np.argmax(excess))
        if excess[worst] <= 1.0 and not misfits(now, loo, limits, meters):
            break
        accused[worst] = True
        remove_meter(now, worst)
    return (DecoderAnswer(accused),)


# --- l0 ---


@dataclass(frozen=True, slots=True, eq=False)
class SetMisfits:
    """Every set of one size. c sets of k meters."""

    members: Ints  # (c, k) meters of each set
    misfit: Floats  # (c,) misfit without each set
    excess: Floats  # (c,) largest residual of a remaining meter relative to its limit


def check(candidates: int, most: int) -> None:
    """Refuse a search over the sets of up to `most` of the candidates that takes too long.

    Raises DesignInfeasible for more than `MOST_SETS` sets.
    """
    count = sum(comb(candidates, k) for k in range(most + 1))
    if count > MOST_SETS:
        raise DesignInfeasible(
            "search over all sets",
            f"{count} sets of up to {most} of {candidates}; at most {MOST_SETS}",
            None,
            code="too-many",
        )


def outcomes(evidence: DecoderInput, size: int) -> SetMisfits:
    """Misfits and residuals without every set of `size` meters."""
    Q, m = evidence.whole.Q, evidence.m
    weights = Q @ m
    sets = list(combinations(np.flatnonzero(evidence.available).tolist(), size))
    members = np.array(sets, dtype=np.intp).reshape(len(sets), size)
    b, columns = weights[members], Q[:, members].transpose(1, 0, 2)
    G = Q[members[:, :, None], members[:, None, :]]
    solved = np.linalg.solve(G, np.concatenate([b[:, :, None], columns.transpose(0, 2, 1)], axis=2))
    left = weights - np.einsum("cpr,cr->cp", columns, solved[:, :, 0])
    precision = Q.diagonal() - np.einsum("cpr,crp->cp", columns, solved[:, :, 1:])
    tested = np.broadcast_to(evidence.available, precision.shape) & (precision > 0)
    tested[np.arange(len(sets))[:, None], members] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        residual, std = np.abs(left / precision), 1.0 / np.sqrt(precision)
        excess = np.where(tested, residual / evidence.limits.limit(std), 0.0)
    misfit = float(m @ weights) - np.einsum("cr,cr->c", b, solved[:, :, 0])
    return SetMisfits(members, misfit, excess.max(axis=1, initial=0.0))


def fewest(evidence: DecoderInput) -> tuple[DecoderAnswer, ...]:
    """Smallest set of meters without which every other one is within its limit.

    Among sets of equal size the least misfit comes first, then its rivals within `RIVAL_RATIO`. If no set
    leaves all others within their limits, the answer is the best set of the largest size.

    Source: lee2018 (2.2.8'): l0 decoding with bounded noise, the sets tried in the order of their size.
    """
    within = 2.0 * float(np.log(RIVAL_RATIO))
    most = min(evidence.max_attacked, int(np.count_nonzero(evidence.available)))
    size = 0
    while True:
        found = outcomes(evidence, size)
        fine = np.flatnonzero(found.excess <= 1.0)
        if fine.size:
            order = fine[np.argsort(found.misfit[fine], kind="stable")]
            near = order[found.misfit[order] - found.misfit[order[0]] <= within]
            return tuple(_answer(evidence.available, found, int(c), int(order[0])) for c in near)
        if size == most:
            best = int(np.argmin(found.misfit))
            return (_answer(evidence.available, found, best, best),)
        size += 1


def _answer(available: Bools, found: SetMisfits, which: int, best: int) -> DecoderAnswer:
    accused = np.zeros(available.size, dtype=np.bool_)
    accused[found.members[which]] = True
    return DecoderAnswer(accused, float(found.misfit[which] - found.misfit[best]))


# --- Pursuits ---


def pursue(evidence: DecoderInput) -> tuple[DecoderAnswer, ...]:
    """Basis pursuit: the attack and load errors of smallest weighted sum that explain the readings exactly.

    ``min |a / sigma|_1 + |c|_1`` subject to ``a + V c = m`` with ``S = V V^T``: the stack of readings and
    pseudo-measurements, annihilated. Meters with an attack beyond their limit are accused.

    Raises DesignInfeasible if the solver finds no solution.
    Source: lee2018 (2.1.4); Theorem 2.1.1 for when it is exact.
    """
    at, F, y = _stack(evidence)
    attack = np.sqrt(evidence.whole.noise[at]) * basis_pursuit(F, y)[: at.size]
    return (_beyond(evidence, at, attack),)


def match(evidence: DecoderInput) -> tuple[DecoderAnswer, ...]:
    """Orthogonal matching pursuit on the whitened readings: column after column, without removal.

    Source: lee2018, Algorithm 2.1, Theorem 2.1.2.
    """
    at = np.flatnonzero(evidence.available)
    if not at.size:
        return (DecoderAnswer(np.zeros_like(evidence.available)),)
    root = np.asarray(np.linalg.cholesky(evidence.whole.Q[np.ix_(at, at)]).T, np.float64)
    attack, _ = matching_pursuit(root, root @ evidence.m[at], min(evidence.max_attacked, at.size))
    return (_beyond(evidence, at, attack),)


def _stack(evidence: DecoderInput) -> tuple[Ints, Floats, Floats]:
    """Columns of unit weight: those of the meters, then the principal directions of the loads' covariance."""
    at = np.flatnonzero(evidence.available)
    prior = evidence.whole.prior
    S = prior.among(at)
    values, vectors = np.linalg.eigh(S)
    keep = values > values.max(initial=0.0) * at.size * np.finfo(np.float64).eps
    F = np.hstack([np.diag(np.sqrt(evidence.whole.noise[at])), vectors[:, keep] * np.sqrt(values[keep])])
    return at, F, evidence.m[at]


def _beyond(evidence: DecoderInput, at: Ints, attack: Floats) -> DecoderAnswer:
    """Accuse the meters with a share of the attack beyond their limit."""
    now = leave_one_out(evidence.whole, evidence.m)
    accused = np.zeros(evidence.available.size, dtype=np.bool_)
    accused[at] = np.abs(attack) > evidence.limits.limit(now.std)[at]
    return DecoderAnswer(accused)
