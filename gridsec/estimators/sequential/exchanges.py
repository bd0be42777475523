"""Hypotheses next to the likeliest one: one accused meter or direction is exchanged for another.

An exchange follows from the posterior of the likeliest hypothesis, without a new factorisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Ints, indices, submatrix
from gridsec.estimators.sequential.dictionary import FaultDictionary
from gridsec.estimators.sequential.search import Candidate, Limits


@dataclass(frozen=True, slots=True)
class Exchange:
    """Exchange of an accused meter or direction for an innocent one; J rises by `worse`."""

    accused: int
    innocent: int
    worse: float


_COLUMNS = 64
"""Accused meters of one block of a product."""


def meter_exchanges(found: Candidate, available: Bools, within: float, limits: Limits) -> list[Exchange]:
    """Best exchange of each accused meter for a trusted one, rise at most `within`; O(p^2) per accused.

    With accused k back, ``Q' = Q + v v^T / s`` with ``v = Q S_:k - e_k`` and ``s = M_kk + d_k``, and then
    meter j gains ``(Q' m)_j^2 / Q'_jj``. Without j, k is off by ``(Q'' m)_k / Q''_kk`` with
    ``Q'' = Q' - Q'_:j Q'_j: / Q'_jj``; the exchange counts only if that is within k's limit. Cheapest first.
    """
    now, loo = found.posterior, found.loo
    prior, accused, out = now.prior, indices(available & ~now.trusted), []
    inside, (at, Q) = now.unknowns[prior.meters], now.precision()
    for first in range(0, accused.size if at.size else 0, _COLUMNS):
        which = accused[first : first + _COLUMNS]
        columns = submatrix(prior.covariance, prior.meters[at], which)
        if inside.shape[1]:
            columns += inside[at] @ inside[which].T
        v, s = Q @ columns, loo.std[which] ** 2
        weights = loo.weights[at, None] - v * (loo.residual[which] / s)
        gain = weights**2 / (Q.diagonal()[:, None] + v**2 / s)
        best, each = gain.argmax(axis=0), np.arange(which.size)
        worse = loo.residual[which] ** 2 / s - gain[best, each]
        v, weight = v[best, each], weights[best, each]
        pivot = Q.diagonal()[best] + v**2 / s
        precision = 1.0 / s - (v / s) ** 2 / pivot
        offset = (loo.residual[which] + v * weight / pivot) / (s * precision)
        std = np.ones(now.trusted.size)
        std[which] = 1.0 / np.sqrt(precision)
        near = indices((worse <= within) & (np.abs(offset) <= limits.limit(std)[which]))
        out += [Exchange(int(which[k]), int(at[best[k]]), max(float(worse[k]), 0.0)) for k in near.tolist()]
    return sorted(out, key=lambda swap: swap.worse)


def fault_exchanges(
    found: Candidate, faults: FaultDictionary, accused: Sequence[int], instead: Ints, within: float
) -> list[Exchange]:
    """Exchanges of an accused direction for one of `instead` (k,) of the same charge, rise at most `within`.

    With the accused direction, u times its standard deviation, removed, ``Q' = Q + c c^T / d`` with ``c = Q
    u`` and ``d = 1 - u^T c``; then direction b lowers the chi-square by ``(b^T Q' m)^2 / (1 / s_b^2 + b^T Q'
    b)``. O(p^2) per direction, cheapest first. accused: directions to be exchanged.
    """
    now, weights = found.posterior, found.loo.weights
    out: list[Exchange] = []
    which = [k for k in accused if k in found.faults]
    others = instead[~np.isin(instead, found.faults)]
    if not which or not others.size:
        return out
    at, Q = now.precision()
    buses, w = now.prior.meters[at], weights[at]
    # The directions of this hypothesis come last, in its order.
    first = now.unknowns.shape[1] - len(found.faults)
    seen = faults.columns(others)[buses]
    along, form = w @ seen, np.einsum("ij,ij->j", seen, Q @ seen)
    for k in which:
        u = now.unknowns[buses, first + found.faults.index(k)]
        c = Q @ u
        d, own = max(1.0 - float(u @ c), np.finfo(np.float64).tiny), float(u @ w)
        both = c @ seen
        gain = (along + both * own / d) ** 2 / (faults.std[others] ** -2.0 + form + both**2 / d)
        # Of the accused itself: (u^T Q' m)^2 / (1 + u^T Q' u) with u^T Q' m = own / d, 1 + u^T Q' u = 1 / d.
        worse = np.maximum(own**2 / d - gain, 0.0)
        out += [Exchange(k, int(others[j]), float(worse[j])) for j in indices(worse <= within).tolist()]
    return sorted(out, key=lambda swap: swap.worse)
