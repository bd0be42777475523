"""l0 decoding: the x with the fewest unexplained blocks, searched in a finite set.

    F_(p,r)(z) = {Phi_Lambda^+ z_Lambda : |Lambda| = p - r},   q <= r <= 2q

always contains a good answer, so C(p, r) candidates take the place of R^n. One pass serves the
noiseless decoder and the one for bounded noise; they differ in the criterion for an explained block.

References
----------
lee2018 (2.2.4) to (2.2.6), (2.2.8) to (2.2.8''), Theorems 2.2.7 and 2.2.11.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from gridsec.arrays import Bools, Floats, Ints, frozen, not_negative
from gridsec.decode.stacks import MOST_SUBSETS, Stack, masked, require, subsets
from gridsec.errors import InputInvalid, Problem


@dataclass(frozen=True, slots=True, eq=False)
class Decoder:
    """Part of l0 decoding that does not depend on the measurements.

    Attributes
    ----------
    stack
        Phi.
    max_attacked
        q, number of blocks that may be in error.
    left_out
        r, number of blocks that each candidate ignores.
    kept : (S, p - r)
        The blocks used by each candidate.
    inverses : (S, n, N)
        Pseudo-inverses of `Phi_Lambda`; zero in the columns of ignored blocks.
    """

    stack: Stack
    max_attacked: int
    left_out: int
    kept: Ints
    inverses: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """Result for a batch of measurements.

    Attributes
    ----------
    x : (…, n)
        Decoded unknowns.
    in_error : (…, p)
        Blocks that x does not explain.
    credible : (…)
        True if these are at most q, as assumed. Otherwise more than q blocks are in error or the noise
        exceeds its bound, and x is invalid.
    residuals : (…, p)
        Norms of `z_i - Phi_i x`.
    """

    x: Floats
    in_error: Bools
    credible: Bools
    residuals: Floats


def cheapest(p: int, q: int) -> int:
    """The r in q … 2q with the fewest candidates C(p, r); of several the smallest, with most averaging.

    References
    ----------
    lee2018, Remark 2.2.2.
    """
    return min(range(q, 2 * q + 1), key=lambda r: (comb(p, r), r))


def design(
    stack: Stack, max_attacked: int, *, tol: float, left_out: int | None = None, most: int = MOST_SUBSETS
) -> Decoder:
    """Prepare l0 decoding.

    Parameters
    ----------
    stack
        Phi; must be q-error correctable.
    max_attacked
        q.
    tol
        Tolerance of that test, relative to blocks of norm one.
    left_out
        r between q and 2q; by default the cheapest.

    Raises
    ------
    NotObservable
        If Phi is not q-error correctable; the message lists sensors with a loss that proves it.
    DesignInfeasible
        If there would be more than `most` candidates.
    ValueError
        Unless 0 <= q <= r <= 2 q.
    """
    q = max_attacked
    r = cheapest(stack.count, q) if left_out is None else left_out
    if q < 0 or not q <= r <= 2 * q:
        raise InputInvalid(
            [
                Problem(
                    "out-of-range",
                    f"r = {r} with q = {q}; expected 0 <= q <= r <= 2 q (lee2018, Theorem 2.2.7)",
                )
            ]
        )
    require(stack, 2 * q, tol, f"undoing {q} errors")
    kept = subsets(stack.count, stack.count - r, most)
    inverses = np.asarray(np.linalg.pinv(masked(stack, kept)), dtype=np.float64)
    return Decoder(stack, q, r, kept, frozen(inverses))


def exact(decoder: Decoder, z: Floats, *, tol: float) -> Decoded:
    """Noiseless l0 decoding: recovers x exactly from any error in at most q blocks.

    Parameters
    ----------
    z : (…, N)
        Measurements, finite.
    tol
        A block counts as explained if its residual is at most this times `|z_i| + |Phi_i| |x|`.

    References
    ----------
    lee2018 (2.2.6), Theorem 2.2.7.
    """
    size = np.linalg.norm(decoder.stack.blocks(), 2, axis=(1, 2)) if decoder.stack.matrix.size else 0.0
    x = _candidates(decoder, z)
    limit = tol * (decoder.stack.norms(z)[..., None, :] + np.linalg.norm(x, axis=-1)[..., None] * size)
    return _vote(decoder, z, x, limit)


def bounded(decoder: Decoder, z: Floats, *, limit: Floats | float) -> Decoded:
    """l0 decoding with bounded noise: fewest blocks with a residual above a limit.

    Parameters
    ----------
    z : (…, N)
        Measurements, finite.
    limit : scalar or (…, 1) or (…, p)
        `v'_max = theta v_max`, for which `gridsec.decode.noise` gives the error bound; not negative.

    Returns
    -------
    Decoded
        Of several minimisers the one with the best fit of the explained blocks; the bound holds for all.

    Raises
    ------
    ValueError
        If a limit is negative or NaN.

    References
    ----------
    lee2018 (2.2.8'), Proposition 2.2.10, Theorem 2.2.11.
    """
    wide = not_negative("limit", limit)
    return _vote(decoder, z, _candidates(decoder, z), wide if wide.ndim == 0 else wide[..., None, :])


def _candidates(decoder: Decoder, z: Floats) -> Floats:
    """All candidates, (…, S, n), by one product for the whole batch."""
    S, n, N = decoder.inverses.shape
    flat = np.asarray(z, dtype=np.float64) @ decoder.inverses.reshape(S * n, N).T
    return flat.reshape(*flat.shape[:-1], S, n)


def _vote(decoder: Decoder, z: Floats, x: Floats, limit: Floats) -> Decoded:
    stack = decoder.stack
    sizes = stack.norms(np.asarray(z)[..., None, :] - x @ stack.matrix.T)
    # Negated comparison: a residual of NaN counts as unexplained.
    unexplained = ~(sizes <= limit)
    count = np.count_nonzero(unexplained, axis=-1)
    misfit = np.where(unexplained, 0.0, sizes).sum(axis=-1)
    best = np.argmin(np.where(count == count.min(axis=-1, keepdims=True), misfit, np.inf), axis=-1)
    pick = best[..., None, None]
    chosen = np.take_along_axis(unexplained, pick, axis=-2)[..., 0, :]
    return Decoded(
        np.take_along_axis(x, pick, axis=-2)[..., 0, :],
        chosen,
        np.count_nonzero(chosen, axis=-1) <= decoder.max_attacked,
        np.take_along_axis(sizes, pick, axis=-2)[..., 0, :],
    )
