"""l0 decoding by exact search, for balls and for boxes, and recovery without enumeration.

`exact` and `bounded` choose among the candidates

    F_(p,r)(z) = {Phi_Lambda^+ z_Lambda : |Lambda| = p - r},   q <= r <= 2q,

which always contain a good answer; C(p, r) of them take the place of R^n.

`fits` decodes rows with bounds of their own, `s = B xi + v + e` with |xi_i| <= 1, |v_k| <= 1 and e zero in
all but q blocks. xi is the state in units of its prior intervals, which cannot be attacked. With
``W = (I + B B^T)^-1``, Lambda the rows kept by a fit, D the others and ``g = W_DD^-1 W_D s``,

    residual_Lambda = W_Lambda s - W_LambdaD g,     residual_D = g,

known matrices times (xi, v): the largest values without attack are sums of absolute coefficients.

`decode_by_pursuit` and `decode_by_matching` recover e from `F z = F e`, F an annihilator of Phi, fast, but
under stronger conditions than correctability.

Source: lee2018, section 2.1, (2.2.4) to (2.2.6), (2.2.8) to (2.2.8''), Theorems 2.2.7 and 2.2.11; for boxes:
docs/theory-partial-observers.md, section 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.optimize import linprog

from gridsec.arrays import Bools, Floats, Ints, frozen, not_negative
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers.lmi.solver import group_pursuit
from gridsec.secure.decode.stacks import MOST_SUBSETS, Stack, annihilator, masked, require, subsets


@dataclass(frozen=True, slots=True, eq=False)
class Decoder:
    """Part of l0 decoding that does not depend on the measurements."""

    stack: Stack  # Phi
    max_attacked: int  # q, number of blocks that may be in error
    left_out: int  # r, number of blocks that each candidate ignores
    kept: Ints  # (S, p - r) the blocks used by each candidate
    inverses: Floats  # (S, n, N) pseudo-inverses of `Phi_Lambda`; zero in the columns of ignored blocks


@dataclass(frozen=True, slots=True, eq=False)
class DecodeResult:
    """Result for a batch of measurements."""

    x: Floats  # (…, n) decoded unknowns
    in_error: Bools  # (…, p) blocks that x does not explain
    # (…) True if these are at most q, as assumed. Otherwise more than q blocks are in error or the noise
    # exceeds its bound, and x is invalid
    credible: Bools
    residuals: Floats  # (…, p) norms of `z_i - Phi_i x`


def cheapest(p: int, q: int) -> int:
    """The r in q … 2q with the fewest candidates C(p, r); of several the smallest, with most averaging.

    Source: lee2018, Remark 2.2.2.
    """
    return min(range(q, 2 * q + 1), key=lambda r: (comb(p, r), r))


def design(
    stack: Stack, max_attacked: int, *, tol: float, left_out: int | None = None, most: int = MOST_SUBSETS
) -> Decoder:
    """Prepare l0 decoding.

    stack: Phi; must be q-error correctable.
    tol: tolerance of that test, relative to blocks of norm one.
    left_out: r between q and 2q; by default the cheapest.
    Raises NotObservable if Phi is not q-error correctable; the message lists sensors with a loss that proves
        it. DesignInfeasible if there would be more than `most` candidates. ValueError unless 0 <= q <= r <= 2
        q.
    """
    q = max_attacked
    r = cheapest(stack.count, q) if left_out is None else left_out
    if q < 0 or not q <= r <= 2 * q:
        raise InputInvalid.of(
            "out-of-range", f"r = {r} with q = {q}; expected 0 <= q <= r <= 2 q (lee2018, Theorem 2.2.7)"
        )
    require(stack, 2 * q, tol, f"undoing {q} errors")
    kept = subsets(stack.count, stack.count - r, most)
    inverses = np.asarray(np.linalg.pinv(masked(stack, kept)), dtype=np.float64)
    return Decoder(stack, q, r, kept, frozen(inverses))


def exact(decoder: Decoder, z: Floats, *, tol: float) -> DecodeResult:
    """Noiseless l0 decoding: recovers x exactly from any error in at most q blocks.

    z (…, N): measurements, finite.
    tol: a block counts as explained if its residual is at most this times `|z_i| + |Phi_i| |x|`.
    Source: lee2018 (2.2.6), Theorem 2.2.7.
    """
    size = np.linalg.norm(decoder.stack.blocks(), 2, axis=(1, 2)) if decoder.stack.matrix.size else 0.0
    x = _candidates(decoder, z)
    limit = tol * (decoder.stack.norms(z)[..., None, :] + np.linalg.norm(x, axis=-1)[..., None] * size)
    return _vote(decoder, z, x, limit)


def bounded(decoder: Decoder, z: Floats, *, limit: Floats | float) -> DecodeResult:
    """l0 decoding with bounded noise: fewest blocks with a residual above a limit.

    z (…, N): measurements, finite.
    limit (scalar or (…, 1) or (…, p)): `v'_max = theta v_max`, for which `gridsec.secure.decode.noise` gives
        the error bound; not negative.
    Of several minimisers, returns the one with the best fit of the explained blocks; the bound holds for all.
    Raises ValueError if a limit is negative or NaN.
    Source: lee2018 (2.2.8'), Proposition 2.2.10, Theorem 2.2.11.
    """
    wide = not_negative("limit", limit)
    return _vote(decoder, z, _candidates(decoder, z), wide if wide.ndim == 0 else wide[..., None, :])


def _candidates(decoder: Decoder, z: Floats) -> Floats:
    """All candidates, (…, S, n), by one product for the whole batch."""
    S, n, N = decoder.inverses.shape
    flat = np.asarray(z, dtype=np.float64) @ decoder.inverses.reshape(S * n, N).T
    return flat.reshape(*flat.shape[:-1], S, n)


def _vote(decoder: Decoder, z: Floats, x: Floats, limit: Floats) -> DecodeResult:
    stack = decoder.stack
    sizes = stack.norms(np.asarray(z)[..., None, :] - x @ stack.matrix.T)
    # Negated comparison: a residual of NaN counts as unexplained.
    unexplained = ~(sizes <= limit)
    count = np.count_nonzero(unexplained, axis=-1)
    misfit = np.where(unexplained, 0.0, sizes).sum(axis=-1)
    best = np.argmin(np.where(count == count.min(axis=-1, keepdims=True), misfit, np.inf), axis=-1)
    pick = best[..., None, None]
    chosen = np.take_along_axis(unexplained, pick, axis=-2)[..., 0, :]
    return DecodeResult(
        np.take_along_axis(x, pick, axis=-2)[..., 0, :],
        chosen,
        np.count_nonzero(chosen, axis=-1) <= decoder.max_attacked,
        np.take_along_axis(sizes, pick, axis=-2)[..., 0, :],
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Fits that leave q blocks out, for all sets. S sets, p blocks, A rows, n unknowns, F functionals."""

    left_out: Bools  # (S, p) the blocks left out by each fit
    residual: Floats  # (S, A) `s - B xi_hat`
    # (S, A) largest residual if all blocks outside the set, and for rows of the set these too, are
    # unmanipulated
    limit: Floats
    # (A,) largest value of ``|s|`` of an unmanipulated row: the limit of the fit without blocks
    reach: Floats
    disagree: Bools  # (S, p) blocks with a residual above its limit, or a value above `reach`
    xi: Floats  # (S, n) fitted unknowns
    # (S, F) bound of ``|f (xi - xi_hat)|`` for each functional, if all blocks outside the set are
    # unmanipulated
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

    B (A, n): rows that can be attacked, in units of their own bounds.
    s (A,): their values.
    block (A,): block of each row. A block without rows can be left out too, and never disagrees.
    q: number of blocks that each fit leaves out; all of them if fewer have rows.
    functionals (F, n): functionals to bound.
    Raises DesignInfeasible if there are more than `most` sets.
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


def restricted_isometry(F: Floats, k: int, *, most: int = MOST_SUBSETS) -> float:
    """Smallest delta_k with `(1 - delta) |e|^2 <= |F e|^2 <= (1 + delta) |e|^2` for all k-sparse e.

    F (m, p): sensing matrix. Its scale matters.
    k: order.
    most: largest number of subsets of columns.
    Source: lee2018, Definition 2.1.1.
    """
    columns = subsets(F.shape[1], min(k, F.shape[1]), most)
    gram = F.T @ F
    values = np.linalg.eigvalsh(gram[columns[:, :, None], columns[:, None, :]])
    return float(np.max(np.abs(values - 1.0), initial=0.0))


def basis_pursuit(F: Floats, y: Floats) -> Floats:
    """Minimise `|e|_1` over e (p,) subject to `F e = y`, as a linear program.

    The result is the sparse one if `delta_2q < sqrt(2) - 1`.

    F (m, p), y (m,).
    Raises DesignInfeasible if no e satisfies the constraint.
    Source: lee2018 (2.1.4), Theorem 2.1.1.
    """
    p = F.shape[1]
    size = float(np.max(np.abs(y), initial=0.0))
    if size == 0.0:
        return np.zeros(p)
    # Scaled, because the solver's tolerances are absolute.
    found = linprog(np.ones(2 * p), A_eq=np.hstack([F, -F]), b_eq=y / size, method="highs")
    if not found.success or found.x is None:
        raise DesignInfeasible("basis pursuit", f"linear program: {found.message}", code="no-solution")
    return np.asarray(size * (found.x[:p] - found.x[p:]))


def matching_pursuit(F: Floats, y: Floats, q: int, *, heights: Ints | None = None) -> tuple[Floats, Ints]:
    """Orthogonal matching pursuit: q times the block of columns that explains the residual best.

    F (m, N), y (m,).
    q: number of blocks to choose.
    heights (p,): columns per block; single columns by default, which is the paper's algorithm. A block's
        correlation is the norm of the projection of the residual on its columns.
    Returns e (N,): least squares on the chosen blocks, zero elsewhere.
    Returns chosen (q,): the blocks, in the order of their choice; fewer if the residual vanishes or all are
        chosen earlier.
    Source: lee2018, Algorithm 2.1, Theorem 2.1.2.
    """
    sizes = np.ones(F.shape[1], dtype=np.intp) if heights is None else heights
    parts = np.split(np.arange(F.shape[1]), np.cumsum(sizes)[:-1])
    bases = [np.linalg.qr(F[:, part])[0] for part in parts]
    chosen: list[int] = []
    e, rest = np.zeros(F.shape[1]), y
    while len(chosen) < min(q, len(parts)) and np.any(rest):
        match = np.array([np.linalg.norm(b.T @ rest) for b in bases])
        # Prevents a second choice of a block by rounding.
        match[chosen] = -1.0
        chosen.append(int(np.argmax(match)))
        at = np.concatenate([parts[i] for i in chosen])
        e = np.zeros(F.shape[1])
        e[at] = np.linalg.lstsq(F[:, at], y, rcond=None)[0]
        rest = y - F @ e
    return e, np.array(chosen, dtype=np.intp)


def decode_by_pursuit(stack: Stack, z: Floats, *, tol: float) -> Floats:
    """Decode by basis pursuit: rows as single errors, or whole blocks by their Euclidean norms.

    A stack of single rows is solved as a linear program; otherwise `sum_i |e_i|_2` is minimised, a
    second-order cone program, because an attack has no pattern within the block of its sensor.

    stack: Phi of full column rank.
    z (N,). tol: as in `annihilator`.
    Returns (n,): `Phi^+ (z - e)`.
    Source: lee2018 (2.1.4); Remark 2.2.2.
    """
    F = annihilator(stack.matrix, tol=tol)
    single = bool(np.all(stack.heights == 1))
    e = basis_pursuit(F, F @ z) if single else group_pursuit(F, F @ z, stack.heights)
    return np.asarray(np.linalg.lstsq(stack.matrix, z - e, rcond=None)[0])


def decode_by_matching(stack: Stack, z: Floats, q: int, *, tol: float) -> tuple[Floats, Ints]:
    """Decode by orthogonal matching pursuit; x, and the q blocks assumed in error."""
    F = annihilator(stack.matrix, tol=tol)
    e, chosen = matching_pursuit(F, F @ z, q, heights=stack.heights)
    return np.asarray(np.linalg.lstsq(stack.matrix, z - e, rcond=None)[0]), chosen
