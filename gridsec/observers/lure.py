"""Systems in Lur'e form; the closed loop of feeder and droop, its time step and its equilibrium.

    x' or x+ = A x + G phi(H x + F u) + B u,     y = C x + D u

phi acts entry by entry, and its slopes lie in `[0, slope]`. For a feeder, x is the reactive injection of the
inverters, `z = H x + F u` and y are `vbar^2 - v^2` at inverters and meters, and u = w is the contribution of
the rest of the feeder to z (`known_input`).

Source: chong2020 (9), (10), (15) to (19); yang2019 (1), (2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import prod

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from gridsec.arrays import Bools, Floats, Ints, exponential_integrals, frozen, perron_bound
from gridsec.errors import DesignInfeasible, FeederInvalid, InputInvalid, Problem, raise_if_any
from gridsec.grid.devices import Droop
from gridsec.grid.network import LinDistFlow, Network, Power
from gridsec.grid.three_phase import CustomerFlow, ThreePhaseFeeder, lindist3flow, per_customer

Nonlinearity = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Matrices:
    """The matrices of a Lur'e system. n states, m nonlinearities, l inputs, p meters."""

    A: Floats  # (n, n)
    G: Floats  # (n, m)
    H: Floats  # (m, n)
    F: Floats  # (m, l)
    B: Floats  # (n, l)
    C: Floats  # (p, n)
    D: Floats  # (p, l)


_Seven = tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats]


def matrices_of(  # noqa: PLR0917  # all matrices
    A: ArrayLike,
    C: ArrayLike,
    G: ArrayLike,
    H: ArrayLike,
    F: ArrayLike | None,
    B: ArrayLike | None,
    D: ArrayLike | None,
) -> _Seven:
    """Arrays A, G, H, F, B, C, D from nested lists; missing input matrices are zero, given ones state l."""
    a, c, g, h = (np.asarray(one, dtype=np.float64) for one in (A, C, G, H))
    found = [None if one is None else np.asarray(one, dtype=np.float64) for one in (F, B, D)]
    inputs = max((one.shape[-1] for one in found if one is not None and one.ndim), default=0)
    rows = zip(found, (h, a, c), strict=True)
    f, b, d = (np.zeros((len(like), inputs)) if one is None else one for one, like in rows)
    return a, g, h, f, b, c, d


def freeze(system: Matrices, *slopes: str) -> list[Problem]:
    """Freeze the seven matrices and the bounds `slopes` (m,) of a new system; return their problems."""
    given: dict[str, Floats] = {name: frozen(getattr(system, name)) for name in (*"AGHFBCD", *slopes)}
    for name, array in given.items():
        object.__setattr__(system, name, array)
    if wrong := [
        Problem("shape", f"{name} has shape {array.shape}; expected {count} axes")
        for name, array in given.items()
        if array.ndim != (count := 1 if name in slopes else 2)
    ]:
        return wrong
    n, m, inputs, p = len(given["A"]), given[slopes[0]].size, given["F"].shape[1], len(given["C"])
    wanted = {"A": (n, n), "G": (n, m), "H": (m, n), "F": (m, inputs), "B": (n, inputs), "C": (p, n)}
    wanted |= {"D": (p, inputs)}
    wrong = [
        Problem("shape", f"{name} has shape {given[name].shape}; expected {shape}")
        for name, shape in (wanted | dict.fromkeys(slopes, (m,))).items()
        if given[name].shape != shape
    ]
    if not all(np.isfinite(array).all() for array in given.values()):
        wrong.append(Problem("not-finite", "every entry must be finite"))
    return wrong


def without_lower(system: Matrices, phi: Nonlinearity, lower: Floats) -> tuple[Floats, Floats, Nonlinearity]:
    """Loop transform: the lower slopes of phi move into the linear part.

    `phi(z) = lower z + phi~(z)`, with slopes of phi~ in [0, upper - lower], and `A~ = A + G diag(lower) H`,
    `B~ = B + G diag(lower) F`. Trajectories do not change.

    lower (m,): the lower slopes. Returns A~, B~, phi~; phi itself if `lower` is zero.
    """
    if not np.any(lower):
        return system.A, system.B, phi
    pushed = system.G * lower
    return (
        system.A + pushed @ system.H,
        system.B + pushed @ system.F,
        lambda z: np.asarray(phi(z) - lower * z),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Lure(Matrices):
    """`x' = A x + G phi(H x + F u) + B u`, `y = C x + D u`.

    Raises ValueError if shapes are inconsistent, an entry is not finite, or a slope is negative; lists every
        problem.
    """

    slope: Floats  # (m,) upper bound of the slope of each entry of phi; the lower bound is 0
    phi: Nonlinearity  # the nonlinearity, (…, m) -> (…, m), entry by entry. For a feeder: its `Droop`

    def __post_init__(self) -> None:
        wrong = freeze(self, "slope")
        if np.any(self.slope < 0.0):
            wrong.append(
                Problem(
                    "order",
                    "an upper slope is below its lower one, which is 0 by default; `Lure.of` takes another",
                )
            )
        raise_if_any(wrong)

    @classmethod
    def of(
        cls,
        A: ArrayLike,
        C: ArrayLike,
        *,
        G: ArrayLike,
        H: ArrayLike,
        phi: Nonlinearity,
        slope: ArrayLike,
        lower: ArrayLike = 0.0,
        F: ArrayLike | None = None,
        B: ArrayLike | None = None,
        D: ArrayLike | None = None,
    ) -> Lure:
        """System from nested lists or arrays; a missing input matrix is zero.

        A, C, G, H, phi, F, B, D: as in the class. Without any of F, B and D there are no inputs, l = 0.
        slope, lower: bounds of the slopes of each entry of phi, or one number for all. A `lower` other than 0
            moves into the linear part: A, B, `slope` and phi of the result are those of `without_lower`.
        Raises ValueError if shapes are inconsistent, an entry is not finite, or a lower slope exceeds its
            upper one; lists every problem.
        Source: chong2020 (9), (10).
        """
        found = matrices_of(A, C, G, H, F, B, D)
        high, low = (np.broadcast_to(np.asarray(end, np.float64), len(found[2])) for end in (slope, lower))
        given = cls(*found, high - low, phi)
        moved_a, moved_b, bent = without_lower(given, phi, low)
        return replace(given, A=moved_a, B=moved_b, phi=bent)


def close_loop(feeder: Network | ThreePhaseFeeder, droop: Droop, meters: Ints) -> Lure:
    """Lur'e system of a feeder with droop inverters and voltage meters.

    With `z = vbar^2 - v^2` as the output everywhere and `u = w` from `known_input`:
    `A = -T^-1`, `G = T^-1`, `H = -2 X[inverters, inverters]`, `C = -2 X[meters, inverters]`, `F` and `D`
    pick the inverters' and the meters' customers, `B = 0`. The slopes are those of K (G carries 1/tau).
    On three phases X is that of `per_customer`, and neither symmetric nor nonnegative.

    meters (p,): customer of each meter.
    Raises FeederInvalid if an inverter or a meter belongs to a customer that does not exist.
    Source: chong2020, section VII.
    """
    count = len(feeder.customers)
    problems = [
        Problem("unknown-index", f"{what} {i}: customer {j} does not exist; expected 0 to {count - 1}")
        for what, where in (("inverter", droop.customer), ("meter", meters))
        for i, j in enumerate(where)
        if not 0 <= j < count
    ]
    if problems:
        raise FeederInvalid(problems)
    own, at = droop.customer, np.arange(count)
    X = _reactances(feeder, own)
    return Lure(
        A=-np.diag(1.0 / droop.tau),
        G=np.diag(1.0 / droop.tau),
        H=-2.0 * X[own],
        F=np.equal.outer(own, at).astype(np.float64),
        B=np.zeros((own.size, count)),
        C=-2.0 * X[meters],
        D=np.equal.outer(meters, at).astype(np.float64),
        slope=droop.slope,
        phi=droop,
    )


def _reactances(feeder: Network | ThreePhaseFeeder, own: Ints) -> Floats:
    """Reactances from the reactive powers of the customers `own` to all squared voltages, (N, m)."""
    if isinstance(feeder, ThreePhaseFeeder):
        return per_customer(feeder, lindist3flow(feeder)).X[:, own]
    return 0.5 * feeder.columns(Power.REACTIVE, own)[feeder.bus]


def known_input(  # noqa: PLR0917  # every argument is a term of chong2020 (19), in its order
    model: LinDistFlow | CustomerFlow,
    vbar: float,
    p: Floats,
    q: Floats,
    v0_squared: Floats | float,
    correction: Floats | float = 0.0,
) -> Floats:
    """Input w (…, N) of the Lur'e system, pu: z with all droop inverters at zero.

    `w = vbar^2 - v0^2 - 2 R p - 2 X q - correction`, chong2020 before (19), where q is the reactive
    injection without the inverters (`q = -q_c`).

    model: from `lindistflow`, or from `per_customer` on three phases.
    vbar: reference voltage of the droop, pu.
    p, q (…, N): active injection and reactive injection without the droop inverters, pu.
    v0_squared (…) or scalar: squared busbar voltage, pu.
    correction (…, N) or scalar: correction of the linear model's squared voltages: `loss_correction` at the
        customers.
    """
    base = vbar**2 - np.asarray(v0_squared, dtype=np.float64)[..., None]
    return np.asarray(base - 2.0 * (p @ model.R.T + q @ model.X.T) - correction)


@dataclass(frozen=True, slots=True)
class StepPolicy:
    """Substeps of `advance`, and its criterion for steps that end in the equilibrium."""

    # longest substep times the fastest rate of the closed loop, dimensionless. The error of the second-order
    # scheme falls with its square
    substep: float
    # a step is long when every open-loop mode has decayed to this fraction; it then ends in the equilibrium.
    # If only some have, these are slowed down to exactly that decay (`rest`). 0 disables both
    settled: float
    tol: float  # residual of the equilibrium, relative to `unit`
    max_iter: int  # largest number of Newton steps for the equilibrium


POLICY = StepPolicy(substep=0.1, settled=1e-6, tol=1e-10, max_iter=200)
"""Default of `advance`; docs/theory-model.md states its accuracy."""


def unit(phi: Nonlinearity) -> float:
    """Scale of the states driven by phi: the largest limit of the curves, 1 without known limits.

    Per-unit injections may be of any size, since the base power is free.
    """
    return (float(np.max(phi.limit, initial=0.0)) if isinstance(phi, Droop) else 0.0) or 1.0


def rest(h: float, policy: StepPolicy) -> float:
    """Rate, 1/s, of a mode that decays to `policy.settled` within a step of h s; faster modes are at rest."""
    return float(-np.log(policy.settled) / h) if policy.settled > 0 and h > 0 else np.inf


@dataclass(frozen=True, slots=True, eq=False)
class LureTransition:
    """Quantities of a step of length h that do not depend on x and u."""

    h: float  # length of the step, s
    substeps: int  # number of equal substeps; 0 for a long step that ends in the equilibrium
    # (n,) or (n, n) `exp(A s)`, `s phi_1(A s)`, `s phi_2(A s)` for the substep s; diagonals where A is
    # diagonal. `first` and `second` include the slowed rows of G and B of slowed states
    decay: Floats
    first: Floats  # (n,) or (n, n)
    second: Floats  # (n,) or (n, n)
    policy: StepPolicy  # policy of the step


def transition(lure: Lure, h: float, policy: StepPolicy = POLICY) -> LureTransition:
    """Prepare steps of a fixed length.

    The number of substeps follows the fastest rate. A state of a diagonal A that is faster than `rest` is
    treated as exactly that fast: it ends the step as settled as any other, and a feeder that mixes
    milliseconds with hours costs no more. Its effect on other states within the step is delayed by up to
    `h / ln(1 / settled)`, 7 % of the step.

    h: length of the step, s, not negative.
    Raises ValueError if h is negative or not finite.
    Source: M. Hochbruck, A. Ostermann, "Exponential integrators", Acta Numerica 19, 2010, sections 2.1, 2.3.
    """
    if not (np.isfinite(h) and h >= 0):
        raise InputInvalid.of("negative", f"h is {h} s; it must be a finite number that is not negative")
    own = np.diagonal(lure.A)
    diagonal = np.count_nonzero(lure.A) == np.count_nonzero(own)
    if diagonal:
        slowest, fastest = (float(np.max(own, initial=-np.inf)), float(np.max(np.abs(own), initial=0.0)))
    else:
        slowest = float(np.max(np.linalg.eigvals(lure.A).real))
        fastest = perron_bound(lure.A, _PERRON_ROUNDS)
    most = rest(h, policy)
    if -slowest >= most:
        empty = np.zeros(0)
        return LureTransition(h, 0, empty, empty, empty, policy)
    slowed = np.ones(own.size)
    if diagonal and fastest > most:
        fastest, slowed = most, np.divide(most, np.abs(own), out=slowed, where=own < -most)
        own = own * slowed
    through = (slowed[:, None] * np.abs(lure.G) * lure.slope) @ np.abs(lure.H)
    fastest += perron_bound(through, _PERRON_ROUNDS)
    count = max(1, int(np.ceil(h * fastest / policy.substep)))
    s = h / count
    if diagonal:
        decay, one, two = exponential_integrals(own * s)
        return LureTransition(h, count, decay, slowed * s * one, slowed * s * two, policy)
    n = own.size
    # One exponential of a block matrix contains both integrals in its first row.
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n] = s * lure.A
    block[:n, n : 2 * n] = s * np.eye(n)
    block[n : 2 * n, 2 * n :] = np.eye(n)
    full = expm(block)
    return LureTransition(h, count, full[:n, :n], full[:n, n : 2 * n], full[:n, 2 * n :], policy)


_PERRON_ROUNDS = 8


def step(prepared: LureTransition, lure: Lure, x: Floats, u: Floats) -> Floats:
    """State after one step prepared for the same system, with u (…, l) constant and x (…, n)."""
    if prepared.substeps == 0:
        policy = prepared.policy
        return equilibrium(lure, u, x, tol=policy.tol * unit(lure.phi), max_iter=policy.max_iter)
    drive, push = u @ lure.F.T, u @ lure.B.T

    def feedback(state: Floats) -> Floats:
        return np.asarray(lure.phi(state @ lure.H.T + drive) @ lure.G.T + push)

    for _ in range(prepared.substeps):
        here = feedback(x)
        ahead = _times(prepared.decay, x) + _times(prepared.first, here)
        x = ahead + _times(prepared.second, feedback(ahead) - here)
    return x


def _times(matrix: Floats, x: Floats) -> Floats:
    """`matrix @ x` along the last axis; a vector stands for a diagonal matrix."""
    return np.asarray(x * matrix if matrix.ndim == 1 else x @ matrix.T)


def advance(lure: Lure, x: Floats, u: Floats, h: float, policy: StepPolicy = POLICY) -> Floats:
    """State a time h later, with u constant.

    Short steps: exponential Runge-Kutta of second order,

        a  = exp(A s) x + s phi_1(A s) N(x),     N(x) = G phi(H x + F u) + B u
        x+ = a + s phi_2(A s) (N(a) - N(x)),

    with the number of substeps s from the fastest closed-loop rate, so that loop gains above 1 are stable
    too. Steps after which every open-loop mode has decayed to `policy.settled` end in the equilibrium,
    provided that it is attractive (proved for droop inverters in docs/theory-model.md). For many steps of one
    length, prepare them with `transition`.

    x (…, n), u (…, l), h in s.
    Raises DesignInfeasible if the equilibrium of a long step is not found.
    """
    return step(transition(lure, h, policy), lure, x, u)


def equilibrium(lure: Lure, u: Floats, x0: Floats | None = None, *, tol: float, max_iter: int) -> Floats:
    """Equilibrium of the system, `A x + G phi(H x + F u) + B u = 0`.

    lure: the system; A must be invertible.
    u (…, l).
    x0 (…, n): initial value; 0 by default.
    tol: largest entry of the residual `x + A^-1 (G phi + B u)`, in the unit of x.
    Raises DesignInfeasible if it is not found.
    """
    gain = np.asarray(np.linalg.solve(-lure.A, lure.G), dtype=np.float64)
    bias = np.linalg.solve(-lure.A, lure.B)
    offset = u @ bias.T
    start = np.zeros(offset.shape) if x0 is None else np.broadcast_to(x0, offset.shape)
    drive = u @ lure.F.T
    return settle(lure.phi, gain, lure.H, drive=drive, bias=offset, x0=start, tol=tol, max_iter=max_iter)


# Half-width of the difference quotients, relative: far above rounding, far below any deadband.
_QUOTIENT = 1e-7
_HALVINGS = 30


def settle(
    phi: Nonlinearity,
    gain: Floats,
    H: Floats,
    *,
    drive: Floats,
    bias: Floats,
    x0: Floats,
    tol: float,
    max_iter: int,
) -> Floats:
    """Solve `x = gain phi(H x + drive) + bias` by a damped semismooth Newton method.

    The Jacobian `I - gain Delta H` takes Delta, the slopes of phi, from difference quotients, which are
    elements of the generalised Jacobian except within rounding of a kink. The step is halved until the
    residual falls. Plain iteration would need a loop gain below 1; this method does not.

    phi: nonlinearity, entry by entry, non-decreasing.
    gain (n, m): gain behind phi.
    H (m, n) or (…, m, n): feedback, possibly one for every leading index (one observer each).
    drive (…, m). bias (…, n): constant parts.
    x0 (…, n): initial value.
    tol: largest entry of the residual, in the unit of x.
    Raises DesignInfeasible if the residual is still above `tol` after `max_iter` steps.
    """
    lead = np.broadcast_shapes(x0.shape[:-1], drive.shape[:-1], bias.shape[:-1], H.shape[:-2])
    (n, m), count = gain.shape, prod(lead)
    x = np.array(np.broadcast_to(x0, (*lead, n)), dtype=np.float64).reshape(count, n)
    c = np.broadcast_to(drive, (*lead, m)).reshape(count, m)
    e = np.broadcast_to(bias, (*lead, n)).reshape(count, n)
    every = np.broadcast_to(H, (*lead, m, n)).reshape(count, m, n) if H.ndim > 2 else H[None]
    rows, loop = np.arange(count), _Loop(phi, gain, every, c, e)
    for _ in range(max_iter):
        residual = loop.residual(x[rows])
        rough = np.max(np.abs(residual), axis=-1, initial=0.0) > tol
        if not rough.any():
            return x.reshape(*lead, n)
        rows, loop = rows[rough], loop.rows(rough)
        x[rows] = loop.newton(x[rows], residual[rough])
    raise DesignInfeasible(
        "equilibrium of the droop loop",
        f"residual above {tol:g} after {max_iter} Newton steps",
        None,
        code="not-converged",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Loop:
    """The equation `x - gain phi(H x + drive) - bias = 0` for k rows at once."""

    phi: Nonlinearity
    gain: Floats
    H: Floats  # (1 or k, m, n)
    drive: Floats
    bias: Floats

    def rows(self, keep: Bools) -> _Loop:
        H = self.H if self.H.shape[0] == 1 else self.H[keep]
        return _Loop(self.phi, self.gain, H, self.drive[keep], self.bias[keep])

    def outputs(self, x: Floats) -> Floats:
        if self.H.shape[0] == 1:
            return np.asarray(x @ self.H[0].T + self.drive)
        return np.asarray(np.einsum("kmn,kn->km", self.H, x) + self.drive)

    def residual(self, x: Floats) -> Floats:
        return np.asarray(x - self.phi(self.outputs(x)) @ self.gain.T - self.bias)

    def newton(self, x: Floats, residual: Floats) -> Floats:
        """One damped Newton step from `x` (k, n) with residual `residual`."""
        z = self.outputs(x)
        width = _QUOTIENT * np.maximum(1.0, np.abs(z))
        slopes = (self.phi(z + width) - self.phi(z - width)) / (2.0 * width)
        jacobian = np.eye(x.shape[1]) - (self.gain * slopes[:, None, :]) @ self.H
        direction = -np.linalg.solve(jacobian, residual[..., None])[..., 0]
        size = np.linalg.norm(residual, axis=-1)
        length = np.ones(x.shape[0])
        for _ in range(_HALVINGS):
            trial = x + length[:, None] * direction
            worse = np.linalg.norm(self.residual(trial), axis=-1) > (1.0 - 1e-4 * length) * size
            if not worse.any():
                break
            length = np.where(worse, 0.5 * length, length)
        return np.asarray(x + length[:, None] * direction)
