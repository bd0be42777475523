"""l0 decoding with a bound for every row and rows that cannot be attacked: all sets, in closed form.

    s = B xi + v + e,     |xi_i| <= 1,     |v_k| <= 1,     e zero in all but q blocks

xi is the state in units of its prior intervals: rows of an identity that cannot be attacked, such as a
model's own prediction and loads within their intervals. For every set of q blocks the least-squares fit to
all others is made. With W = (I + B B^T)^-1, Lambda the rows that are kept, D the others and
``g = W_DD^-1 W_D s``,

    residual_Lambda = W_Lambda s - W_LambdaD g,     residual_D = g,

and both are known matrices times (xi, v). The largest value of a row of blocks without attack is therefore
the sum of absolute values of its coefficients, attained by some xi and v; no norm is estimated.

References
----------
lee2018 (2.2.8') and Theorem 2.2.11 with r = q, for boxes instead of balls; docs/theory-partial-observers.md,
section 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.decode.stacks import MOST_SUBSETS, subsets


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Fits that leave q blocks out, for all sets. S sets, p blocks, A rows, n unknowns, F functionals.

    Attributes
    ----------
    left_out : (S, p)
        The blocks left out by each fit.
    residual, limit : (S, A)
        ``s - B xi_hat`` and its largest value if all blocks outside the set are unmanipulated and, for rows
        of the set, these as well.
    reach : (A,)
        Largest value of ``|s|`` of an unmanipulated row: the limit of the fit without blocks.
    disagree : (S, p)
        Blocks with a residual above its limit, or a value above `reach`.
    xi : (S, n)
        Fitted unknowns.
    error : (S, F)
        Bound of ``|f (xi - xi_hat)|`` for each functional, if all blocks outside the set are unmanipulated.
    """

    left_out: Bools
    residual: Floats
    limit: Floats
    reach: Floats
    disagree: Bools
    xi: Floats
    error: Floats

    @property
    def credible(self) -> Bools:
        """Fits that explain every block in them; (S,). A set of unmanipulated blocks always does."""
        return np.asarray(~(self.disagree & ~self.left_out).any(axis=1))

    @property
    def certain(self) -> Bools:
        """Blocks left out by every credible fit; (p,). None if no fit is credible.

        If at most q blocks are attacked, an unmanipulated block j belongs to some set of p - q unmanipulated
        ones. The fit of that set is credible and does not leave j out: a certain block is attacked.
        """
        fine = self.credible
        return np.asarray(self.left_out[fine].all(axis=0) & fine.any())

    @property
    def contradicted(self) -> Bools:
        """Blocks that some fit uses and does not explain; (p,). If there is one, some block is attacked."""
        return np.asarray((self.disagree & ~self.left_out).any(axis=0))


def fits(  # noqa: PLR0917  # the terms of s = B xi + v, then the requested bounds
    B: Floats, s: Floats, block: Ints, blocks: int, q: int, functionals: Floats, *, most: int = MOST_SUBSETS
) -> Fits:
    """Fit the unknowns without every set of q blocks, with the limits of unmanipulated rows.

    Parameters
    ----------
    B : (A, n)
        Rows that can be attacked, in units of their own bounds.
    s : (A,)
        Their values.
    block : (A,)
        Block of each row. A block without rows can be left out too, and never disagrees.
    blocks
        p.
    q
        Number of blocks that each fit leaves out; all of them if fewer have rows.
    functionals : (F, n)
        Functionals to bound.

    Raises
    ------
    DesignInfeasible
        If there are more sets.
    """
    present = np.unique(block)
    chosen = present[subsets(present.size, min(q, present.size), most)]
    left_out = np.zeros((len(chosen), blocks), dtype=np.bool_)
    np.put_along_axis(left_out, chosen.astype(np.intp), values=True, axis=1)
    W = np.asarray(np.linalg.inv(np.eye(s.size) + B @ B.T), dtype=np.float64)
    P = W @ B
    whole = _Whole(W, P, W @ s, functionals - functionals @ (B.T @ P), functionals @ P.T)
    made = [_without(whole, out[block], functionals) for out in left_out]
    residual, limit, error = (np.array([one[k] for one in made]) for k in range(3))
    disagree = np.zeros((len(made), blocks), dtype=np.bool_)
    reach = 1.0 + np.abs(B).sum(axis=1)
    over = (np.abs(residual) > limit * _ROUNDING) | (np.abs(s) > reach * _ROUNDING)
    for j in present:
        disagree[:, j] = over[:, block == j].any(axis=1)
    # xi_hat = B_Lambda^T W_Lambda s_Lambda, and the residual on Lambda is W_Lambda s_Lambda.
    xi = np.where(left_out[:, block], 0.0, residual) @ B
    return Fits(left_out, residual, limit, reach, disagree, xi, error)


_ROUNDING = 1.0 + 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class _Whole:
    """Fit to all rows, the base of the updates."""

    W: Floats  # (A, A)
    P: Floats  # (A, n) W B
    ws: Floats  # (A,)
    by_xi: Floats  # (F, n) error of the functionals, by xi
    by_v: Floats  # (F, A) and by v


def _without(whole: _Whole, out: Bools, functionals: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals, their limits, and the functionals' bounds without some rows; block elimination of W."""
    W, P, kept = whole.W, whole.P, ~out
    if not out.any():
        limit = np.abs(P).sum(axis=1) + np.abs(W).sum(axis=1)
        return whole.ws, limit, np.abs(whole.by_xi).sum(axis=1) + np.abs(whole.by_v).sum(axis=1)
    WD = W[out]
    # (rows of D, [value | by xi | by v]): part of D not explained by the kept rows.
    solved = np.linalg.solve(WD[:, out], np.column_stack([whole.ws[out], P[out], WD * kept]))
    g, by_xi, by_v = solved[:, 0], solved[:, 1 : 1 + P.shape[1]], solved[:, 1 + P.shape[1] :]
    residual, limit = np.empty(out.size), np.empty(out.size)
    residual[out], limit[out] = g, np.abs(by_xi).sum(axis=1) + np.abs(by_v).sum(axis=1) + 1.0
    across = W[np.ix_(kept, out)]
    residual[kept] = whole.ws[kept] - across @ g
    inner = np.abs(W[np.ix_(kept, kept)] - across @ by_v[:, kept]).sum(axis=1)
    limit[kept] = np.abs(P[kept] - across @ by_xi).sum(axis=1) + inner
    f = functionals @ P[out].T
    error = np.abs(whole.by_xi + f @ by_xi).sum(axis=1)
    error += np.abs(whole.by_v[:, kept] - f @ by_v[:, kept]).sum(axis=1)
    return residual, limit, error
