"""Lipschitz constants in the largest-entry norm, from above and from below, each with its method.

`Lip^(phi)`, the smallest constant from above, is on a box the largest row sum of |Jacobian|: proven by
interval bisection. `Lip_(phi)`, the largest constant from below, has three ways: from a left inverse
(proven), from an interval matrix (proven, but may fail), from pairs of points (an estimate).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gridsec.arrays import Floats
from gridsec.observers.high_gain.form import Matrix, Scalar
from gridsec.observers.high_gain.intervals import Bracket, Interval, interval, supremum

Map = Callable[[Floats], Floats]


def upper_proven(rows: Matrix, lower: Floats, upper: Floats, *, gap: float = 1e-4) -> Bracket:
    """`Lip^` of a map on a box: `sup_x max_r sum_c |J_rc(x)|`.

    A box is convex: the mean value theorem along the segment gives "at most", and a segment along the signs
    of the worst row "at least".

    Parameters
    ----------
    rows
        Jacobian over components.
    lower, upper : (n,)
        The box.
    gap
        Acceptable relative width of the bracket.

    References
    ----------
    kim2018, section III.A.
    """
    count = len(rows(list(np.asarray(lower, dtype=np.float64))))
    each = [supremum(_row_sum(rows, r), lower, upper, gap=gap) for r in range(count)]
    return Bracket(max(b.lower for b in each), max(b.upper for b in each), "interval bisection")


def _row_sum(rows: Matrix, r: int) -> Scalar:
    def total(x: Sequence[Any]) -> Any:
        out: Any = 0.0 * x[0]
        for entry in rows(x)[r]:
            out = out + np.absolute(entry)
        return out

    return total


def upper_sampled(
    function: Map, lower: Floats, upper: Floats, *, samples: int = 20_000, seed: int = 0
) -> Bracket:
    """Lower bound of `Lip^` from pairs of points; never a proof from above.

    Half of the pairs are far apart, half close together, near the steepest slopes of smooth maps.

    Parameters
    ----------
    function
        From points (k, n) to values (k, q).
    lower, upper : (n,)
        The box.
    samples, seed
        Number of pairs and seed.
    """
    quotient = _quotients(function, lower, upper, samples, seed)
    return Bracket(float(np.max(quotient)), np.inf, "sampling")


def lower_sampled(
    function: Map, lower: Floats, upper: Floats, *, samples: int = 20_000, seed: int = 0
) -> Bracket:
    """Upper bound of `Lip_` from pairs of points, as in `upper_sampled`; never a proof from below."""
    quotient = _quotients(function, lower, upper, samples, seed)
    return Bracket(0.0, float(np.min(quotient)), "sampling")


def _quotients(function: Map, lower: Floats, upper: Floats, samples: int, seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    lower, upper = np.atleast_1d(lower), np.atleast_1d(upper)
    x = rng.uniform(lower, upper, (samples, len(lower)))
    other = rng.uniform(lower, upper, x.shape)
    # Directions with all entries at +-1 are the steepest ones in the largest-entry norm.
    near = 1e-4 * (upper - lower) * rng.choice([-1.0, 1.0], x.shape)
    close = np.arange(samples) % 2 == 0
    other[close] = np.clip(x + near, lower, upper)[close]
    apart = np.max(np.abs(other - x), axis=-1)
    keep = apart > 0.0
    change = np.max(np.abs(function(other[keep]) - function(x[keep])), axis=-1)
    return np.asarray(change / apart[keep])


def lower_from_inverse(inverse: Bracket) -> Bracket:
    """`Lip_(phi) >= 1 / Lip^(psi)` for every left inverse psi: `|x - x'| <= Lip^(psi) |phi(x) - phi(x')|`.

    Parameters
    ----------
    inverse
        Bracket of Lip^(psi) on a convex set that contains the image, or on a set with a global psi.
    """
    return Bracket(1.0 / inverse.upper, np.inf, inverse.method)


def lower_proven(rows: Matrix, lower: Floats, upper: Floats) -> Bracket:
    """`Lip_` on a box from the interval matrix [J] of the Jacobian.

    For any two points `phi(x) - phi(x') = M (x - x')` with a mean Jacobian M in [J]. With a left inverse B of
    the middle of [J], `|B| |M d| >= |B M d| >= (1 - r) |d|` where r bounds |B M - I|. Useful for moderate
    curvature; otherwise the bound is 0, which is valid but empty.

    Parameters
    ----------
    rows
        Jacobian over components.
    lower, upper : (n,)
        The box.
    """
    box = [Interval(np.array(a), np.array(b)) for a, b in zip(lower, upper, strict=True)]
    entries = [[interval(entry) for entry in row] for row in rows(box)]
    low = np.array([[float(e.lo) for e in row] for row in entries])
    high = np.array([[float(e.hi) for e in row] for row in entries])
    middle, radius = 0.5 * (low + high), 0.5 * (high - low)
    B = np.linalg.pinv(middle)
    off = np.abs(B @ middle - np.eye(middle.shape[1])) + np.abs(B) @ radius
    left = 1.0 - float(np.max(np.sum(off, axis=1)))
    if left <= 0.0:
        return Bracket(0.0, np.inf, "interval")
    # Allowance of 1e-12 for the rounding of this well-conditioned step.
    return Bracket(left / float(np.max(np.sum(np.abs(B), axis=1))) * (1.0 - 1e-12), np.inf, "interval")


def extend(points: Floats, values: Floats, constants: Floats) -> Map:
    """Lipschitz extension of a function from its values at points, `min_y f(y) + L |z - y|`.

    Every component keeps its constant on the whole space, in the largest-entry norm, and the given values
    that satisfy it (McShane's formula; in the papers Kirszbraun's).

    Parameters
    ----------
    points : (k, N)
        Points with known values.
    values : (k, n)
        Its values.
    constants : (n,)
        Lipschitz constant of each component.

    References
    ----------
    kim2018, footnote 2; lee2018, Remark 5.2.3.
    """
    steep = np.broadcast_to(np.asarray(constants, dtype=np.float64), values.shape[1:])

    def extended(z: Floats) -> Floats:
        far = np.max(np.abs(np.asarray(z)[..., None, :] - points), axis=-1)
        return np.asarray(np.min(values + steep * far[..., None], axis=-2))

    return extended


def kappa_detect(factor: float, lowest: float) -> float:
    """`kappa^{n,d} = (Lip^(id - Phi Psi) + 1) / min Lip_(Phi_J)`: error of an estimate that passes its test.

    Parameters
    ----------
    factor
        Lip^(id - Phi Psi), or the largest one over the sets for kappa^{n,c}.
    lowest
        Smallest Lip_(Phi_J) over the sets J that can be free of attacks; 0 gives no bound.

    References
    ----------
    kim2018, Theorems 1 and 2; lee2018, before Theorem 5.4.1 and before Theorem 5.4.3.
    """
    return (factor + 1.0) / lowest if lowest != 0.0 else np.inf


def kappa_error(factor: float, lowest: float, steepest: float) -> float:
    """`kappa^{n,e} = (Lip^(id - Phi Psi) + 1) (1 + Lip^(Phi) / min Lip_(Phi_J))`: largest attack that passes.

    Parameters
    ----------
    factor, lowest
        As in `kappa_detect`.
    steepest
        Lip^(Phi) of the tested set.

    References
    ----------
    lee2018, before Theorem 5.4.1; its part (ii).
    """
    return (factor + 1.0) * (1.0 + steepest / lowest) if lowest != 0.0 else np.inf
