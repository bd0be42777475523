"""Misfits without every small set of meters at once, by one small solve each.

With ``Q = (S + D)^-1`` the inverse covariance of the readings m without manipulation, leaving out the meters
of a set s gives

    misfit(s) = m^T Q m - b^T G^-1 b,      b = (Q m)_s,    G = Q_ss

and the normalised residuals of the remaining meters follow from the same solve.

References
----------
lee2018 (2.2.8'), Remark 2.2.1: least squares over all meters but those of a set.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from gridsec.arrays import Floats, Ints
from gridsec.errors import DesignInfeasible
from gridsec.sequential.decoder import Evidence

MOST_SETS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Every set of one size. c sets of k meters.

    Attributes
    ----------
    members : (c, k)
        Meters of each set.
    misfit : (c,)
        Misfit without each set.
    excess : (c,)
        Largest offset of a remaining meter relative to its limit.
    """

    members: Ints
    misfit: Floats
    excess: Floats


def check(candidates: int, most: int) -> None:
    """Refuse a search that would take too long.

    Parameters
    ----------
    candidates, most
        Number of meters, and largest size of a set.

    Raises
    ------
    DesignInfeasible
        If there would be more than `MOST_SETS` sets.
    """
    count = sum(comb(candidates, k) for k in range(most + 1))
    if count > MOST_SETS:
        raise DesignInfeasible(
            "search over all sets",
            f"{count} sets of up to {most} of {candidates}; at most {MOST_SETS}",
            None,
            code="too-many",
        )


def outcomes(evidence: Evidence, size: int) -> Outcome:
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
    return Outcome(members, misfit, excess.max(axis=1, initial=0.0))
