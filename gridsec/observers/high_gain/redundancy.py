"""Redundant observability of nonlinear systems: left inverses, Lipschitz constants, sensor groups.

A left inverse Psi^I maps every z_I to a state in the box, and Phi_I(x) back to x. Its `factor` bounds the
ratio of the residual `|z_I - Phi_I(Psi^I(z_I))|` of a set without attack to the observers' error:

- given: `1 + Lip^(Phi_I) Lip^(Psi^I)`, kim2018's bound on `Lip^(id - Phi_I Psi^I)`;
- nearest point: `sqrt(N_I)`, because no state in the box, and so not the true one either, has a smaller
  Euclidean residual. No Lipschitz constant is needed (docs/theory-high-gain.md, Theorem 2).

`Lip^(phi)`, the smallest constant from above, is on a box the largest row sum of |Jacobian|: proven by
interval bisection. `Lip_(phi)`, the largest constant from below, has three ways: from a left inverse
(proven), from an interval matrix (proven, but may fail), from pairs of points (an estimate).

A coding function Phi = (Phi_1, …, Phi_p) is *q-error detectable* if no two states differ in at most q
blocks, *infinitesimally* so if the same holds for its Jacobians, *strongly* so if both; *correctable* is
detectable for 2q. Strong detectability is q-redundant observability.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np

from gridsec.arrays import Bools, Floats
from gridsec.errors import DesignInfeasible, NotObservable
from gridsec.observers.high_gain.form import Matrix, Scalar, System, sat
from gridsec.observers.high_gain.intervals import Bracket, Interval, interval, supremum


@dataclass(frozen=True, slots=True, eq=False)
class Inverse:
    """Left inverse of Phi_I, defined everywhere."""

    sensors: tuple[int, ...]  # I, ascending
    function: Callable[[Floats], Floats]  # Psi^I: from z_I (…, N_I) to states (…, n) inside the box
    factor: float  # a residual above `factor` times the observers' error bound proves an attack within I
    origin: str  # "given" or "nearest"

    def __call__(self, z: Floats) -> Floats:
        """Psi^I(z_I)."""
        return self.function(z)


def given(
    system: System,
    sensors: Sequence[int],
    function: Callable[[Floats], Floats],
    *,
    factor: float,
    z_bound: float | None = None,
) -> Inverse:
    """Left inverse in closed form, extended by saturation: `sat(f(sat(z, M_z)), M_x)`.

    function: a smooth map from (…, N_I) to (…, n) with `f(Phi_I(x)) = x` in the box of states.
    factor: bound on `Lip^(id - Phi_I Psi^I)`.
    z_bound: M_z; by default the largest bound of the sensors.
    Source: kim2018 (10), (11); lee2018 (5.3.4), (5.3.5).
    """
    chosen = tuple(int(i) for i in sensors)
    level = float(np.max(system.z_bound[list(chosen)])) if z_bound is None else z_bound
    return Inverse(chosen, lambda z: sat(function(sat(z, level)), system.x_bound), factor, "given")


def nearest(system: System, sensors: Sequence[int], *, accept: float = 0.0, iterations: int = 60) -> Inverse:
    """Left inverse by least squares: the state of the box with Phi_I nearest to z_I.

    Damped Gauss-Newton (Levenberg-Marquardt) projected onto the box, from the centre; for residuals above
    `accept` also from the middles of the orthants (up to eight states), with the best result. The factor
    sqrt(N_I) presumes a global minimum.

    system: the system; its Jacobians are used.
    accept: residual (largest entry) without further starts. Values up to the threshold in use change no
        decision: a set that passes with a local minimum would pass with the global one.
    """
    chosen = tuple(int(i) for i in sensors)
    bound = system.x_bound
    level = np.concatenate([np.full(system.partials[i].size, system.partials[i].bound) for i in chosen])
    grid = np.zeros((0, system.n))
    if system.n <= _MANY:
        grid = 0.5 * bound * np.array(list(product((-1.0, 1.0), repeat=system.n)))

    def descend(z: Floats, starts: Floats) -> tuple[Floats, Floats]:
        x = np.broadcast_to(starts, (len(z), *starts.shape))
        goals = np.broadcast_to(z[:, None, :], (*x.shape[:2], z.shape[-1]))
        x, left = _descend(system, chosen, goals, x, iterations)
        best = np.argmin(np.sum(left**2, axis=-1), axis=1)
        each = np.arange(len(z))
        return x[each, best], left[each, best]

    def function(z: Floats) -> Floats:
        flat = sat(np.asarray(z, dtype=np.float64), level)
        batch = flat.reshape(-1, flat.shape[-1])
        x, left = descend(batch, np.zeros((1, system.n)))
        again = np.flatnonzero(np.max(np.abs(left), axis=-1) > accept)
        if again.size and len(grid):
            other, rest = descend(batch[again], grid)
            better = np.sum(rest**2, axis=-1) < np.sum(left[again] ** 2, axis=-1)
            x[again[better]] = other[better]
        return np.asarray(x.reshape(*flat.shape[:-1], system.n))

    size = int(sum(system.partials[i].size for i in chosen))
    return Inverse(chosen, function, float(np.sqrt(size)), "nearest")


# Largest number of states for starts from all orthants.
_MANY = 8


def _descend(
    system: System, sensors: tuple[int, ...], z: Floats, x: Floats, iterations: int
) -> tuple[Floats, Floats]:
    """Projected Levenberg-Marquardt for a batch; returns points and residuals."""
    bound, eye = system.x_bound, np.eye(system.n)
    residual = system.phi(x, sensors) - z
    cost = np.sum(residual**2, axis=-1)
    damping = np.full(cost.shape, 1e-3)
    for _ in range(iterations):
        J = system.jacobian(x, sensors)
        slope = np.einsum("...ki,...k->...i", J, residual)
        # At a face of the box only coordinates that point inwards may move.
        stuck = ((x >= bound) & (slope < 0.0)) | ((x <= -bound) & (slope > 0.0))
        J, slope = np.where(stuck[..., None, :], 0.0, J), np.where(stuck, 0.0, slope)
        normal = np.einsum("...ki,...kj->...ij", J, J)
        scale = np.trace(normal, axis1=-2, axis2=-1) / system.n + np.finfo(np.float64).tiny
        normal = normal + ((damping + 1e-14) * scale)[..., None, None] * eye
        move = np.linalg.solve(normal, slope[..., None])[..., 0]
        trial = np.clip(x - move, -bound, bound)
        ahead = system.phi(trial, sensors) - z
        reached = np.sum(ahead**2, axis=-1)
        better = reached < cost
        x = np.where(better[..., None], trial, x)
        residual = np.where(better[..., None], ahead, residual)
        cost = np.where(better, reached, cost)
        damping = np.clip(np.where(better, 0.1 * damping, 10.0 * damping), 1e-12, 1e12)
        if np.max(np.abs(move) / bound) <= _SHORT:
            break
    return x, residual


# Step, relative to the box, below the resolution of double precision.
_SHORT = 1e-13


def check(system: System, inverse: Inverse, points: Floats, *, tolerance: float) -> float:
    """Largest `|Psi^I(Phi_I(x)) - x|` over points of the box.

    points (k, n): states in the box.
    tolerance: largest acceptable error.
    Raises DesignInfeasible if the error exceeds `tolerance`.
    """
    worst = float(np.max(np.abs(inverse(system.phi(points, inverse.sensors)) - points)))
    if not worst <= tolerance:
        what = f"left inverse for the sensors {list(inverse.sensors)}"
        raise DesignInfeasible(
            what, f"misses the state by {worst:.3g}", tolerance - worst, code="not-verified"
        )
    return worst


def corners_and_interior(system: System, *, samples: int = 500, seed: int = 0) -> Floats:
    """Points of the box of states for checks: random ones and (up to ten states) all corners."""
    inner = np.random.default_rng(seed).uniform(-system.x_bound, system.x_bound, (samples, system.n))
    if system.n > 10:
        return inner
    corners = np.array(list(product((-1.0, 1.0), repeat=system.n))) * system.x_bound
    return np.concatenate([inner, corners])


Map = Callable[[Floats], Floats]


def upper_proven(rows: Matrix, lower: Floats, upper: Floats, *, gap: float = 1e-4) -> Bracket:
    """`Lip^` of a map on a box: `sup_x max_r sum_c |J_rc(x)|`.

    A box is convex: the mean value theorem along the segment gives "at most", and a segment along the signs
    of the worst row "at least".

    rows: Jacobian over components.
    lower, upper (n,).
    gap: acceptable relative width of the bracket.
    Source: kim2018, section III.A.
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

    function: from points (k, n) to values (k, q).
    lower, upper (n,).
    samples, seed: number of pairs and seed.
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

    inverse: bracket of Lip^(psi) on a convex set that contains the image, or on a set with a global psi.
    """
    return Bracket(1.0 / inverse.upper, np.inf, inverse.method)


def lower_proven(rows: Matrix, lower: Floats, upper: Floats) -> Bracket:
    """`Lip_` on a box from the interval matrix [J] of the Jacobian.

    For any two points `phi(x) - phi(x') = M (x - x')` with a mean Jacobian M in [J]. With a left inverse B of
    the middle of [J], `|B| |M d| >= |B M d| >= (1 - r) |d|` where r bounds |B M - I|. Useful for moderate
    curvature; otherwise the bound is 0, which is valid but empty.

    rows: Jacobian over components.
    lower, upper (n,).
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

    points (k, N) with known values (k, n).
    constants (n,): Lipschitz constant of each component.
    Source: kim2018, footnote 2; lee2018, Remark 5.2.3.
    """
    steep = np.broadcast_to(np.asarray(constants, dtype=np.float64), values.shape[1:])

    def extended(z: Floats) -> Floats:
        far = np.max(np.abs(np.asarray(z)[..., None, :] - points), axis=-1)
        return np.asarray(np.min(values + steep * far[..., None], axis=-2))

    return extended


def kappa_detect(factor: float, lowest: float) -> float:
    """`kappa^{n,d} = (Lip^(id - Phi Psi) + 1) / min Lip_(Phi_J)`: error of an estimate that passes its test.

    factor: Lip^(id - Phi Psi), or the largest one over the sets for kappa^{n,c}.
    lowest: smallest Lip_(Phi_J) over the sets J that can be free of attacks; 0 gives no bound.
    Source: kim2018, Theorems 1 and 2; lee2018, before Theorem 5.4.1 and before Theorem 5.4.3.
    """
    return (factor + 1.0) / lowest if lowest != 0.0 else np.inf


def kappa_error(factor: float, lowest: float, steepest: float) -> float:
    """`kappa^{n,e} = (Lip^(id - Phi Psi) + 1) (1 + Lip^(Phi) / min Lip_(Phi_J))`: largest attack that passes.

    factor, lowest: as in `kappa_detect`.
    steepest: Lip^(Phi) of the tested set.
    Source: lee2018, before Theorem 5.4.1; its part (ii).
    """
    return (factor + 1.0) * (1.0 + steepest / lowest) if lowest != 0.0 else np.inf


def block_distance(codes: Floats, mask: Bools | None = None, *, tolerance: float = 0.0) -> Floats:
    """Number of blocks in which codes differ, pairwise: `d_{0^n}(z, z')`.

    codes (k, p, n): k codes of p blocks.
    mask (p, n): entries that count; by default all.
    tolerance: largest difference that counts as zero.
    Returns (k, k): symmetric, zero on the diagonal.
    Source: kim2018, section III.A; lee2018, Proposition 5.1.2 (iii).
    """
    apart = np.abs(codes[:, None] - codes[None, :])
    if mask is not None:
        apart = np.where(mask, apart, 0.0)
    return np.asarray((apart.max(axis=-1) > tolerance).sum(axis=-1), dtype=np.float64)


def detectable(codes: Floats, errors: int, *, tolerance: float = 0.0) -> bool:
    """True if any two of finitely many codes differ in more than `errors` blocks.

    codes (k, p, n): codes of different states.
    tolerance: largest difference that counts as zero.
    Source: lee2018, Definition 5.1.1 and Proposition 5.1.2.
    """
    far = block_distance(codes, tolerance=tolerance)
    return bool(np.all(far[~np.eye(len(codes), dtype=np.bool_)] > errors))


def correctable(codes: Floats, errors: int, *, tolerance: float = 0.0) -> bool:
    """True if `errors` wrong blocks are always correctable: detectable for twice as many (5.1.2, 5.1.5)."""
    return detectable(codes, 2 * errors, tolerance=tolerance)


@dataclass(frozen=True, slots=True)
class SensorRedundancy:
    """Redundancy without k sensors, at the sampled points."""

    missing: int  # k
    weakest: tuple[int, ...]  # the group of p - k sensors with the smallest `singular`
    # smallest singular value of the Jacobian of any group at any point; zero for no immersion
    singular: float
    # smallest `|Phi_I(x) - Phi_I(x')| / |x - x'|` of any group and any pair; zero if not injective
    injective: float


def redundancy(system: System, missing: int, *, samples: int = 2000, seed: int = 0) -> SensorRedundancy:
    """Search for counterexamples of k-redundant observability by sampling.

    A value of zero disproves it. Positive values are evidence, and a proof with a bound of
    `redundancy.lower_proven` or a left inverse for each group.

    missing: k.
    samples, seed: points and pairs for each group.
    Raises NotObservable if a group has too few entries to determine the state at all.
    Source: kim2018, Definition 1; lee2018, Definition 5.3.1 and Proposition 5.1.4.
    """
    p = len(system.partials)
    points = corners_and_interior(system, samples=samples, seed=seed)
    best: tuple[float, tuple[int, ...]] = (np.inf, ())
    injective = np.inf
    for group in combinations(range(p), max(p - missing, 0)):
        entries = sum(system.partials[i].size for i in group)
        if entries < system.n:
            raise NotObservable(
                group, entries, f"{entries} entries cannot determine {system.n} states", code="too-few-meters"
            )
        smallest = np.linalg.svd(system.jacobian(points, group), compute_uv=False)[:, -1].min()
        best = min(best, (float(smallest), group))
        quotient = lower_sampled(
            partial(system.phi, sensors=group),
            -system.x_bound,
            system.x_bound,
            samples=samples,
            seed=seed,
        )
        injective = min(injective, quotient.upper)
    return SensorRedundancy(missing, best[1], best[0], injective)


def groups(sensors: int, attacked: int) -> list[tuple[int, ...]]:
    """All sets of p - q sensors in the order Lambda of the papers' tables: the first leaves out sensor 0."""
    everyone = range(sensors)
    return [tuple(i for i in everyone if i not in out) for out in combinations(everyone, attacked)]
