"""Uniform observability decomposition of systems written as functions or in sympy.

    z_i = Phi_i(x) = (h_i, L_f h_i, …, L_f^{n_i - 1} h_i)
    z_i' = A z_i + e alpha_i(z_i) + beta_i(z_i) u,    beta_ij depends on z_i1, …, z_ij only
    y_i = z_i1 + a_i + v_i

Functions are written over *components*: they take a sequence of n entries and use NumPy's operations on
them, so that one function serves numbers, arrays and intervals. `linear` decomposes a linear system,
`decompose` one in sympy, which is optional and imported only there.

Lie derivatives are exact. The order n_i is the number of Lie derivatives with independent differentials;
alpha_i and beta_ij are found by matching a polynomial in z_i against the exact expression, and accepted only
if the difference vanishes. If no polynomial of the given degree matches, `alpha_i` is evaluated at any state
with the given z_i, which makes it a function of z_i.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from itertools import chain, combinations_with_replacement
from typing import Any

import numpy as np

from gridsec.arrays import Bools, Floats, Ints
from gridsec.errors import InputInvalid, NotObservable
from gridsec.observers.high_gain.constants import Slopes
from gridsec.observers.high_gain.intervals import Interval, interval, supremum

Scalar = Callable[[Sequence[Any]], Any]
Vector = Callable[[Sequence[Any]], Sequence[Any]]
Matrix = Callable[[Sequence[Any]], Sequence[Sequence[Any]]]


def at(function: Vector, points: Floats) -> Floats:
    """Values (…, k) of a function from n components to k at points (…, n)."""
    points = np.asarray(points, dtype=np.float64)
    values = function([points[..., i] for i in range(points.shape[-1])])
    # Assigned to one array: a stack of arrays after broadcasting takes several times as long.
    made = np.empty((*points.shape[:-1], len(values)), dtype=np.float64)
    for k, value in enumerate(values):
        made[..., k] = value
    return made


def jacobian_at(function: Matrix, points: Floats) -> Floats:
    """Values (…, k, m) of a function from n components to k rows of m entries, at points (…, n)."""
    points = np.asarray(points, dtype=np.float64)
    rows = function([points[..., i] for i in range(points.shape[-1])])
    columns = range(len(rows[0]))
    made = np.empty((*points.shape[:-1], len(rows), len(columns)), dtype=np.float64)
    for k, row in enumerate(rows):
        for i, value in zip(columns, row, strict=True):
            made[..., k, i] = value
    return made


def sat(z: Floats, bound: Floats | float) -> Floats:
    """Componentwise saturation `min(max(z, -bound), bound)`; NaN becomes zero.

    z (…): arbitrary values, also infinite.
    bound: saturation level, scalar or broadcastable.
    Source: kim2018, after (4); lee2018, after (5.2.5).
    """
    return np.clip(np.where(np.isnan(z), 0.0, z), -np.asarray(bound), np.asarray(bound))


@dataclass(frozen=True, slots=True, eq=False)
class Polynomial:
    """Polynomial `sum_k c_k prod_j z_j^{e_kj}`; differentiable, and stackable over sensors."""

    exponents: Ints  # (k, n) non-negative integers
    coefficients: Floats  # (k,) real

    def __call__(self, z: Sequence[Any]) -> Any:
        """Value at n components."""
        total: Any = 0.0
        for powers, factor in zip(self.exponents.tolist(), self.coefficients.tolist(), strict=True):
            term: Any = factor
            for component, power in zip(z, powers, strict=True):
                if power == 1:
                    term = term * component
                elif power > 1:
                    term = term * component**power
            total = total + term
        return total

    def derivative(self, k: int) -> Polynomial:
        """Partial derivative with respect to the k-th component."""
        keep = self.exponents[:, k] > 0
        lowered = self.exponents[keep].copy()
        factors = self.coefficients[keep] * lowered[:, k]
        lowered[:, k] -= 1
        return Polynomial(lowered, factors)


def affine(constant: float, slopes: Sequence[float]) -> Polynomial:
    """`constant + sum_j slopes_j z_j` as a `Polynomial`."""
    n = len(slopes)
    exponents = np.concatenate([np.zeros((1, n), dtype=np.intp), np.eye(n, dtype=np.intp)])
    return Polynomial(exponents, np.array([constant, *slopes], dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class Partial:
    """Uniformly observable part of one sensor."""

    phi: Vector  # Phi_i, from the n components of x to the n_i of z_i
    jacobian: Matrix  # its derivative, n_i rows of n entries
    alpha: Scalar  # alpha_i over the n_i components of z_i
    # beta_i: n_i rows with one function for each of the m inputs; row j must use z_1 … z_j only
    beta: tuple[tuple[Scalar, ...], ...]
    # M_z,i: `|Phi_i(x)| <= bound` on the whole box of states. alpha and beta are only evaluated at saturated
    # arguments, which makes them globally Lipschitz (kim2018 (4))
    bound: float

    @property
    def size(self) -> int:
        """n_i."""
        return len(self.beta)

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return len(self.beta[0])


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """System with its sensors. n states, p sensors, N = n_1 + … + n_p.

    Raises NotObservable if there is no sensor. ValueError if sensors differ in their numbers of inputs.
    """

    x_bound: Floats  # (n,) the states stay in the box `|x_k| <= x_bound_k`
    partials: tuple[Partial, ...]  # the sensors' observable parts
    mask: Bools = field(init=False)

    def __post_init__(self) -> None:
        if not self.partials:
            raise NotObservable(
                (), 0, "a system without sensors has no observable state", code="too-few-meters"
            )
        widths = {partial.inputs for partial in self.partials}
        if len(widths) != 1:
            raise InputInvalid.of("shape", f"all sensors share the inputs, but have {sorted(widths)} of them")
        object.__setattr__(self, "x_bound", np.atleast_1d(np.asarray(self.x_bound, dtype=np.float64)))
        sizes = np.array([partial.size for partial in self.partials])
        object.__setattr__(self, "mask", np.arange(sizes.max())[None, :] < sizes[:, None])

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.x_bound.shape[0])

    @property
    def z_bound(self) -> Floats:
        """M_z,i of every sensor, (p,)."""
        return np.array([partial.bound for partial in self.partials], dtype=np.float64)

    def phi(self, x: Floats, sensors: Sequence[int] | None = None) -> Floats:
        """Phi_I(x), (…, N_I), for x (…, n); by default of all sensors.

        Source: kim2018 (9); lee2018 (5.3.2), without the zeros for padding.
        """
        return np.concatenate([at(self.partials[i].phi, x) for i in self._chosen(sensors)], axis=-1)

    def jacobian(self, x: Floats, sensors: Sequence[int] | None = None) -> Floats:
        """Derivative of Phi_I, (…, N_I, n); arguments as in `phi`."""
        parts = [jacobian_at(self.partials[i].jacobian, x) for i in self._chosen(sensors)]
        return np.concatenate(parts, axis=-2)

    def rows(self, sensors: Sequence[int] | None = None) -> Matrix:
        """Derivative of Phi_I over components, for interval bounds; I ascending."""
        chosen = [self.partials[i].jacobian for i in self._chosen(sensors)]
        return lambda x: list(chain.from_iterable(part(x) for part in chosen))

    def pick(self, sensors: Sequence[int]) -> Bools:
        """Mask (N,) of the entries of the stacked z that belong to the sensors I; kim2018 (8)."""
        owner = np.nonzero(self.mask)[0]
        return np.isin(owner, np.asarray(sensors, dtype=np.intp))

    def _chosen(self, sensors: Sequence[int] | None) -> Sequence[int]:
        return range(len(self.partials)) if sensors is None else sensors


def largest(phi: Vector, x_bound: Floats, *, gap: float = 1e-3) -> float:
    """A proven M_z: bound on `|Phi_i|` over the box of states, by interval bisection.

    phi: Phi_i over components.
    x_bound (n,): half-widths of the box.
    gap: acceptable relative overestimation.
    """
    count = len(phi(list(np.zeros(len(x_bound)))))
    return max(supremum(_size(phi, j), -x_bound, x_bound, gap=gap).upper for j in range(count))


def _size(phi: Vector, j: int) -> Scalar:
    return lambda x: np.absolute(phi(x)[j])


def slopes(partial: Partial, u_low: Floats, u_high: Floats, *, samples: int = 4000, seed: int = 0) -> Slopes:
    """Ranges of the derivatives of alpha and beta u for `constants.margin`.

    Proven by intervals for alpha and beta that are `Polynomial`; otherwise the ranges of central differences
    at random points, widened by a tenth, and marked as not proven. Zero is always inside, because the
    functions are constant beyond the saturation.

    u_low, u_high (m,): range of the inputs.
    samples, seed: number and seed of the random points.
    """
    n = partial.size
    low, high, proven = np.zeros((n, n)), np.zeros((n, n)), True
    u = [Interval(a, b) for a, b in zip(np.atleast_1d(u_low), np.atleast_1d(u_high), strict=True)]
    box = [Interval(np.array(-partial.bound), np.array(partial.bound)) for _ in range(n)]
    points = np.random.default_rng(seed).uniform(-partial.bound, partial.bound, (samples, n))
    for j in range(n):
        terms: list[tuple[Scalar, Interval]] = list(zip(partial.beta[j], u, strict=True))
        if j == n - 1:
            terms.append((partial.alpha, interval(1.0)))
        for k in range(n if j == n - 1 else j + 1):
            total = interval(0.0)
            for function, factor in terms:
                if isinstance(function, Polynomial):
                    total = total + interval(function.derivative(k)(box)) * factor
                else:
                    proven = False
                    total = total + _seen(function, points, k) * factor
            low[j, k], high[j, k] = min(float(total.lo), 0.0), max(float(total.hi), 0.0)
    return Slopes(low, high, proven)


def _seen(function: Scalar, points: Floats, k: int) -> Interval:
    h = 1e-6 * max(float(np.max(np.abs(points))), 1e-6)
    ahead, behind = points.copy(), points.copy()
    ahead[:, k] += h
    behind[:, k] -= h
    rate = (at(_single(function), ahead) - at(_single(function), behind)) / (2.0 * h)
    extra = 0.1 * float(np.max(np.abs(rate)))
    return Interval(np.array(rate.min() - extra), np.array(rate.max() + extra))


def defects(system: System, f: Vector, g: Matrix, h: Vector, points: Floats, *, step: float = 1e-5) -> Floats:
    """Deviation of given Phi, alpha, beta from the decomposition of `x' = f + g u, y = h`.

    Central differences of Phi_i along f and the columns of g against `(z_2, …, alpha)` and `beta`, and
    Phi_i1 against h_i. The check uses no derivative of the decomposition itself.

    f, g, h: the system over components; g has n rows of m entries.
    points (k, n): points inside the box of states.
    step: length of the differences, relative to the length of the direction.
    Returns (p,): largest absolute defect of every sensor; near `step^2` for a correct decomposition.
    Source: kim2018, Assumption 2 and (3).
    """
    drift, drive, read = at(f, points), jacobian_at(g, points), at(h, points)
    out = np.zeros(len(system.partials))
    for i, partial in enumerate(system.partials):
        z = at(partial.phi, points)
        want = np.concatenate([z[:, 1:], at(_single(partial.alpha), z)], axis=1)
        worst = [np.abs(z[:, 0] - read[:, i]), np.abs(_along(partial.phi, points, drift, step) - want)]
        for column in range(partial.inputs):
            rows = at(_column(partial, column), z)
            worst.append(np.abs(_along(partial.phi, points, drive[..., column], step) - rows))
        out[i] = max(float(part.max()) for part in worst)
    return out


def _single(function: Scalar) -> Vector:
    return lambda z: [function(z)]


def _column(partial: Partial, column: int) -> Vector:
    return lambda z: [row[column](z) for row in partial.beta]


def _along(phi: Vector, points: Floats, direction: Floats, step: float) -> Floats:
    return np.asarray(
        (at(phi, points + step * direction) - at(phi, points - step * direction)) / (2.0 * step)
    )


def linear(A: Floats, B: Floats, C: Floats, x_bound: Floats, *, tolerance: float = 1e-9) -> System:
    """Decomposition of `x' = A x + B u, y = C x`: for linear systems Assumption 2 always holds.

    Phi_i is the observability matrix of (A, c_i) up to its rank n_i, and alpha_i are the coefficients of
    `c_i A^{n_i}` in its rows.

    A (n, n), B (n, m), C (p, n).
    x_bound (n,): half-widths of the box of states.
    tolerance: largest relative part of a row outside the span of the rows before that counts as zero.
    Raises NotObservable if a sensor's row is zero.
    """
    A, B, C = (np.asarray(matrix, dtype=np.float64) for matrix in (A, B, C))
    x_bound = np.broadcast_to(np.asarray(x_bound, dtype=np.float64), A.shape[:1])
    parts = []
    for i, row in enumerate(C):
        if not row.any():
            raise NotObservable(
                (i,), 0, f"sensor {i} measures nothing: its row of C is zero", code="zero-output"
            )
        kept = [row]
        while True:
            ahead = kept[-1] @ A
            stack = np.array(kept)
            weights = np.linalg.lstsq(stack.T, ahead, rcond=None)[0]
            if np.max(np.abs(weights @ stack - ahead)) <= tolerance * max(1.0, float(np.max(np.abs(ahead)))):
                break
            kept.append(ahead)
        flat = [0.0] * len(kept)
        beta = tuple(tuple(affine(float(r @ b), flat) for b in B.T) for r in kept)
        bound = float(np.max(np.abs(stack) @ x_bound))
        parts.append(Partial(_times(stack), _constant(stack), affine(0.0, weights.tolist()), beta, bound))
    return System(np.array(x_bound), tuple(parts))


def _times(matrix: Floats) -> Vector:
    def phi(x: Sequence[Any]) -> Sequence[Any]:
        return [affine(0.0, row)(x) for row in matrix.tolist()]

    return phi


def _constant(matrix: Floats) -> Matrix:
    return lambda _: matrix.tolist()


Expression = Any


def _sympy() -> Any:
    try:
        return import_module("sympy")
    except ImportError as missing:
        raise ImportError(
            "symbolic Lie derivatives need sympy, which is not installed: install it (pip install sympy), "
            "or write the decomposition yourself with gridsec.observers.high_gain.Partial"
        ) from missing


@dataclass(frozen=True, slots=True, eq=False)
class SensorForm:
    """Symbolic decomposition for one sensor."""

    phi: tuple[Expression, ...]  # `h, L_f h, …`; n_i expressions in x
    alpha: Expression  # `L_f^{n_i} h`, in x
    beta: tuple[tuple[Expression, ...], ...]  # for each row j the m expressions `L_g L_f^{j-1} h`, in x
    # for alpha and each entry of beta (in this order, row by row) the equal polynomial in z_i, or None if
    # there is none of the given degree
    polynomials: tuple[Polynomial | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Symbolic:
    """A decomposed system."""

    x: tuple[Expression, ...]  # the symbols of the state
    forms: tuple[SensorForm, ...]  # one for each sensor
    f: Vector  # the system over components, for `form.defects` and simulation
    g: Matrix
    h: Vector
    system: System  # the decomposition, ready for the observers


def lie(expression: Expression, field: Sequence[Expression], x: Sequence[Expression]) -> Expression:
    """Lie derivative `sum_k d(expression)/dx_k field_k`, simplified.

    The field has n expressions for the n symbols x.

    Source: lee2018, Remark 5.2.1.
    """
    sympy = _sympy()
    terms = (sympy.diff(expression, symbol) * part for symbol, part in zip(x, field, strict=True))
    return sympy.simplify(sum(terms, sympy.Integer(0)))


def decompose(
    f: Sequence[Expression],
    g: Sequence[Sequence[Expression]] | Sequence[Expression],
    h: Sequence[Expression],
    x: Sequence[Expression],
    *,
    x_bound: Floats | float,
    degree: int = 3,
    samples: int = 60,
    seed: int = 0,
    tolerance: float = 1e-8,
) -> Symbolic:
    """Decomposition of `x' = f + g u, y = h` for every sensor.

    f: n expressions.
    g: n rows of m expressions; n expressions for one input.
    h: p expressions.
    x: n symbols.
    x_bound: half-widths of the box of states; scalar or (n,).
    degree: largest degree of the polynomials for alpha and beta.
    samples, seed: random points for ranks and for matching.
    tolerance: relative singular value that counts as zero.
    Raises NotObservable if a sensor has no uniformly observable part: the rank changes over the box, or
        beta_ij depends on more than z_1 … z_j, so that observability depends on the input. ImportError if
        sympy is missing.
    Source: kim2018, Assumption 2 and (3); lee2018, Assumption 5.2.1.
    """
    sympy = _sympy()
    symbols = tuple(x)
    drift = [sympy.sympify(entry) for entry in f]
    drive = [
        [sympy.sympify(e) for e in row] if isinstance(row, Sequence) else [sympy.sympify(row)] for row in g
    ]
    bound = np.broadcast_to(np.asarray(x_bound, dtype=np.float64), (len(symbols),)).copy()
    points = np.random.default_rng(seed).uniform(-bound, bound, (samples, len(symbols)))
    probe = _Probe(symbols, points, tolerance)
    forms = []
    for i, output in enumerate(h):
        chain = _chain(i, sympy.sympify(output), drift, probe)
        phi, alpha = tuple(chain[:-1]), chain[-1]
        columns = range(len(drive[0]))
        beta = tuple(tuple(lie(entry, [row[c] for row in drive], symbols) for c in columns) for entry in phi)
        _check_triangular(i, phi, beta, probe)
        polynomials = [_match(alpha, phi, probe, degree)]
        for j, row in enumerate(beta):
            known = phi[: j + 1]
            polynomials += [_match(entry, known, probe, degree, pad=len(phi)) for entry in row]
        forms.append(SensorForm(phi, alpha, beta, tuple(polynomials)))
    parts = tuple(_partial(form, symbols, bound) for form in forms)
    return Symbolic(
        x=symbols,
        forms=tuple(forms),
        f=_numeric(drift, symbols),
        g=_numeric(drive, symbols),
        h=_numeric([sympy.sympify(output) for output in h], symbols),
        system=System(bound, parts),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Probe:
    """Points for ranks, and the tolerance there."""

    x: tuple[Expression, ...]
    points: Floats
    tolerance: float

    def ranks(self, chain: Sequence[Expression]) -> Any:
        """Rank of the differentials of some functions, at each point."""
        sympy = _sympy()
        rows = [[sympy.diff(entry, symbol) for symbol in self.x] for entry in chain]
        values = jacobian_at(_numeric(rows, self.x), self.points)
        size = np.linalg.norm(values, axis=-1, keepdims=True)
        singular = np.linalg.svd(values / np.where(size > 0.0, size, 1.0), compute_uv=False)
        return np.sum(singular > self.tolerance, axis=-1)


def _chain(i: int, output: Expression, drift: list[Expression], probe: _Probe) -> list[Expression]:
    """`h, L_f h, …` up to and including the first with a dependent differential."""
    chain = [output]
    while True:
        ranks = probe.ranks(chain)
        low, high = int(ranks.min()), int(ranks.max())
        if low != high:
            why = f"the rank of sensor {i}'s observable part changes between {low} and {high} in the box"
            raise NotObservable((i,), low, why, code="rank-changes")
        if high == 0:
            raise NotObservable((i,), 0, f"sensor {i} does not depend on the state", code="zero-output")
        if high < len(chain):
            return chain
        chain.append(lie(chain[-1], drift, probe.x))


def _check_triangular(
    i: int, phi: tuple[Expression, ...], beta: tuple[tuple[Expression, ...], ...], probe: _Probe
) -> None:
    for j, row in enumerate(beta):
        for entry in row:
            if np.any(probe.ranks([*phi[: j + 1], entry]) > j + 1):
                why = (
                    f"sensor {i} is not uniformly observable: row {j + 1} of beta depends on more than the "
                    f"first {j + 1} entries of z, so that its observability depends on the input"
                )
                raise NotObservable((i,), len(phi), why, code="not-uniform")


def _match(
    target: Expression, phi: Sequence[Expression], probe: _Probe, degree: int, *, pad: int | None = None
) -> Polynomial | None:
    """The polynomial P with exactly `target = P(phi)`; None if there is none of this degree."""
    sympy = _sympy()
    n = len(phi)
    powers = [
        np.bincount(np.array(pick, dtype=np.intp), minlength=n)
        for d in range(degree + 1)
        for pick in combinations_with_replacement(range(n), d)
    ]
    z, goal = at(_numeric(phi, probe.x), probe.points), at(_numeric([target], probe.x), probe.points)[:, 0]
    table = np.stack([np.prod(z**power, axis=-1) for power in powers], axis=-1)
    scale = np.max(np.abs(table), axis=0)
    weights = np.linalg.lstsq(table / scale, goal, rcond=1e-12)[0] / scale
    if np.max(np.abs(table @ weights - goal)) > 1e-8 * max(1.0, float(np.max(np.abs(goal)))):
        return None
    exact = [sympy.nsimplify(round(float(weight), 9), rational=True) for weight in weights]
    rebuilt = sympy.Integer(0)
    for weight, power in zip(exact, powers, strict=True):
        rebuilt += weight * sympy.prod([e ** int(k) for e, k in zip(phi, power, strict=True)])
    if sympy.simplify(target - rebuilt) != 0:
        return None
    keep = [k for k, weight in enumerate(exact) if weight != 0] or [0]
    width = n if pad is None else pad
    exponents = np.zeros((len(keep), width), dtype=np.intp)
    exponents[:, :n] = np.array([powers[k] for k in keep])
    return Polynomial(exponents, np.array([float(exact[k]) for k in keep]))


def _partial(form: SensorForm, x: tuple[Expression, ...], bound: Floats) -> Partial:
    sympy = _sympy()
    phi = _numeric(form.phi, x)
    jacobian = _numeric([[sympy.diff(entry, symbol) for symbol in x] for entry in form.phi], x)
    section = _section(phi, jacobian, bound)
    size = largest(phi, bound)
    found = iter(form.polynomials)
    alpha: Scalar = next(found) or _through(form.alpha, x, section)
    beta = tuple(tuple(next(found) or _through(entry, x, section) for entry in row) for row in form.beta)
    return Partial(phi, jacobian, alpha, beta, size)


def _section(phi: Vector, jacobian: Matrix, bound: Floats) -> Callable[[Floats], Floats]:
    """Map z (k, n_i) to a state (k, n) of the box with this z, or nearly so outside the image."""

    def state(z: Floats) -> Floats:
        x = np.zeros((len(z), len(bound)))
        for _ in range(_ROUNDS):
            move = np.linalg.pinv(jacobian_at(jacobian, x))
            x = sat(x + np.einsum("kij,kj->ki", move, z - at(phi, x)), bound)
        return x

    return state


def _through(target: Expression, x: tuple[Expression, ...], section: Callable[[Floats], Floats]) -> Scalar:
    """`target` at a state with this z: a function of z exactly if `target` is one."""
    value = _numeric([target], x)

    def function(z: Sequence[Any]) -> Any:
        parts = np.broadcast_arrays(*[np.asarray(part, dtype=np.float64) for part in z])
        goal = np.stack(parts, axis=-1)
        states = section(goal.reshape(-1, goal.shape[-1]))
        return at(value, states)[:, 0].reshape(goal.shape[:-1])

    return function


# Newton steps of `_section`; it converges quadratically inside the image.
_ROUNDS = 12


def _numeric(entries: Sequence[Any], x: tuple[Expression, ...]) -> Callable[[Sequence[Any]], Any]:
    """Expressions, or rows of them, as a function over components."""
    listed = [list(entry) if isinstance(entry, Sequence) else entry for entry in entries]
    function = _sympy().lambdify(x, listed, modules="numpy", cse=True)
    return lambda point: function(*point)
