"""Uniform observability decomposition of systems written in sympy.

The only module that imports sympy, and only when called: sympy is optional.

Lie derivatives are exact. The order n_i is the number of Lie derivatives with independent differentials;
alpha_i and beta_ij are found by matching a polynomial in z_i against the exact expression, and accepted only
if the difference vanishes. If no polynomial of the given degree matches, `alpha_i` is evaluated at any state
with the given z_i, which makes it a function of z_i.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from gridsec.arrays import Floats
from gridsec.errors import NotObservable
from gridsec.observers.high_gain.form import (
    Matrix,
    Partial,
    Polynomial,
    Scalar,
    System,
    Vector,
    at,
    largest,
    sat,
)

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
    """Symbolic decomposition for one sensor.

    Attributes
    ----------
    phi
        `h, L_f h, …`; n_i expressions in x.
    alpha, beta
        `L_f^{n_i} h`, and for each row j the m expressions `L_g L_f^{j-1} h`, in x.
    polynomials
        For alpha and each entry of beta (in this order, row by row) the equal polynomial in z_i, or None if
        there is none of the given degree.
    """

    phi: tuple[Expression, ...]
    alpha: Expression
    beta: tuple[tuple[Expression, ...], ...]
    polynomials: tuple[Polynomial | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Symbolic:
    """A decomposed system.

    Attributes
    ----------
    x
        The symbols of the state.
    forms
        One for each sensor.
    f, g, h
        The system over components, for `form.defects` and simulation.
    system
        The decomposition, ready for the observers.
    """

    x: tuple[Expression, ...]
    forms: tuple[SensorForm, ...]
    f: Vector
    g: Matrix
    h: Vector
    system: System


def lie(expression: Expression, field: Sequence[Expression], x: Sequence[Expression]) -> Expression:
    """Lie derivative `sum_k d(expression)/dx_k field_k`, simplified.

    The field has n expressions for the n symbols x.

    References
    ----------
    lee2018, Remark 5.2.1.
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

    Parameters
    ----------
    f
        n expressions.
    g
        n rows of m expressions; n expressions for one input.
    h
        p expressions.
    x
        n symbols.
    x_bound
        Half-widths of the box of states; scalar or (n,).
    degree
        Largest degree of the polynomials for alpha and beta.
    samples, seed
        Random points for ranks and for matching.
    tolerance
        Relative singular value that counts as zero.

    Raises
    ------
    NotObservable
        If a sensor has no uniformly observable part: the rank changes over the box, or beta_ij depends
        on more than z_1 … z_j, so that observability depends on the input.
    ImportError
        If sympy is missing.

    References
    ----------
    kim2018, Assumption 2 and (3); lee2018, Assumption 5.2.1.
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
        f=_vector(drift, symbols),
        g=_matrix(drive, symbols),
        h=_vector([sympy.sympify(output) for output in h], symbols),
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
        values = _evaluate_matrix(_matrix(rows, self.x), self.points)
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


def _evaluate_matrix(rows: Matrix, points: Floats) -> Floats:
    count = len(rows(list(points[0])))
    return np.stack([at(_row(rows, r), points) for r in range(count)], axis=-2)


def _row(rows: Matrix, r: int) -> Vector:
    return lambda x: rows(x)[r]


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
    z, goal = at(_vector(phi, probe.x), probe.points), at(_vector([target], probe.x), probe.points)[:, 0]
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
    phi = _vector(form.phi, x)
    jacobian = _matrix([[sympy.diff(entry, symbol) for symbol in x] for entry in form.phi], x)
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
            move = np.linalg.pinv(_evaluate_matrix(jacobian, x))
            x = sat(x + np.einsum("kij,kj->ki", move, z - at(phi, x)), bound)
        return x

    return state


def _through(target: Expression, x: tuple[Expression, ...], section: Callable[[Floats], Floats]) -> Scalar:
    """`target` at a state with this z: a function of z exactly if `target` is one."""
    value = _vector([target], x)

    def function(z: Sequence[Any]) -> Any:
        parts = np.broadcast_arrays(*[np.asarray(part, dtype=np.float64) for part in z])
        goal = np.stack(parts, axis=-1)
        states = section(goal.reshape(-1, goal.shape[-1]))
        return at(value, states)[:, 0].reshape(goal.shape[:-1])

    return function


# Newton steps of `_section`; it converges quadratically inside the image.
_ROUNDS = 12


def _vector(entries: Sequence[Expression], x: tuple[Expression, ...]) -> Vector:
    return _callable(list(entries), x)


def _matrix(rows: Sequence[Sequence[Expression]], x: tuple[Expression, ...]) -> Matrix:
    return _callable([list(row) for row in rows], x)


def _callable(entries: Any, x: tuple[Expression, ...]) -> Callable[[Sequence[Any]], Any]:
    function = _sympy().lambdify(x, entries, modules="numpy", cse=True)
    return lambda point: function(*point)
