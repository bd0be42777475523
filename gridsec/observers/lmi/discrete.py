"""Discrete-time circle-criterion observers by linear matrix inequalities: design, margins, error bounds.

The observer of the trusted meters J is

    x_hat+ = A x_hat + G phi(zeta) + B u + L r,   zeta = H x_hat + F u + K r,   r = (y - C x_hat - D u)_J

Slopes may lie anywhere in [lower, upper]; a loop transform moves them to [0, upper - lower]. The solver's
result is rebuilt in NumPy, in the plant's own units, before it is used.

Source: yang2019 (4), (5), Assumption 1. Proofs: docs/theory-discrete.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gridsec.arrays import Floats, Ints, frozen, frozen_ints
from gridsec.errors import DesignInfeasible, InputInvalid, Problem, raise_if_any
from gridsec.observers.gains import negativity
from gridsec.observers.lmi.sampled import DiscreteLure, shift
from gridsec.observers.lmi.solver import BACKOFF, cvxpy_late, first_proven, solve


@dataclass(frozen=True, slots=True, eq=False)
class UncertaintyInputs:
    """Input matrices of the unknown delta (r,) besides the meters.

    `x+ = … + state @ delta`, `z = H x + F u + argument @ delta`, `y = … + output @ delta`.

    Raises ValueError if the numbers of columns differ.
    """

    state: Floats  # (n, r)
    argument: Floats  # (m, r)
    output: Floats  # (p, r) scaled so that the entries of delta are about one

    def __post_init__(self) -> None:
        for name in ("state", "argument", "output"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        if not self.state.shape[1] == self.argument.shape[1] == self.output.shape[1]:
            raise InputInvalid.of(
                "shape", "state, argument and output must have one column for each entry of delta"
            )


def nothing_unknown(system: DiscreteLure) -> UncertaintyInputs:
    """No uncertainty but that of the meters; r = 0."""
    sizes = (len(system.A), len(system.lower), len(system.C))
    return UncertaintyInputs(*(np.zeros((size, 0)) for size in sizes))


def input_error(system: DiscreteLure, load: Floats, held: Floats | None = None) -> UncertaintyInputs:
    """Uncertainty of an input known up to `load @ delta`, with arguments that move by `held` within a step.

    system: the plant; l inputs, m nonlinearities.
    load (l, r) or (l,): shape of the error of the known input; a vector means independent entries.
    held (m,), optional: error of each argument from `sampled.held_error`, independent of all others.
    """
    given = np.asarray(load, dtype=np.float64)
    W = np.diag(given) if given.ndim == 1 else given
    parts = [system.B @ W, system.F @ W, system.D @ W]
    if held is not None:
        extra = (np.zeros((len(system.A), held.size)), np.diag(held), np.zeros((len(system.C), held.size)))
        parts = [np.hstack(pair) for pair in zip(parts, extra, strict=True)]
    return UncertaintyInputs(*parts)


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteGains:
    """One designed observer with its proof. k trusted meters, n states, m nonlinearities.

    With `V = e^T P e`, `e = x - x_hat`: `V+ <= decay^2 V + mu |n / noise|^2 + mu_delta |delta|^2`.
    """

    J: Ints  # (k,) the trusted meters
    # (n, k) injection of `r = y - y_hat` into the state; yang2019 (4) writes it with the opposite sign
    L: Floats
    K: Floats  # (m, k) injection into the arguments of the nonlinearities, likewise
    P: Floats  # (n, n) certificate, for the loop-transformed system
    Lambda: Floats  # (m,) multiplier, for the same system
    decay: float  # lambda of yang2019 (5), per step
    mu: float  # as above
    mu_delta: float
    noise: Floats  # (k,) scale of each trusted meter's error
    unknown: UncertaintyInputs  # further uncertainty
    margin: float  # margin of the rebuilt inequality; it holds if positive
    backoff: float  # fraction by which mu and mu_delta were enlarged after the solver
    status: str  # status of the solver; not a proof


def discrete_matrix(system: DiscreteLure, J: Ints | Sequence[int], gains: DiscreteGains) -> Floats:
    r"""The matrix that must be negative semidefinite, in the order (e, psi, n / noise, delta).

    With `S` zero but for the rows of psi::

        T^T P T - diag(decay^2 P, 0, mu I, mu_delta I) + S + S^T

        T = [ A~ - L~ C_J   G   -L~ N   E_x~ - L~ E_y ]          N = diag(noise_J)
        S = [ Lam (H - K C_J)   -Lam d^-1   -Lam K N   Lam (E_z - K E_y) ]

    and the loop transform `A~ = A + G diag(lower) H`, `E_x~ = E_x + G diag(lower) E_z`,
    `L~ = L + G diag(lower) K`. Nonlinearities of constant slope have no column.

    J (k',): meters with injection, a subset of `gains.J`: the observer while others are unavailable.
    Raises ValueError if `J` is not a subset of the design's meters.
    Source: docs/theory-discrete.md, Theorem 1.
    """
    keep = np.isin(gains.J, np.asarray(J, dtype=np.intp))
    if np.count_nonzero(keep) != len(J):
        raise InputInvalid.of(
            "wrong-design", f"{list(J)} is not a subset of the design's meters {gains.J.tolist()}"
        )
    rows, L, K, N = gains.J[keep], gains.L[:, keep], gains.K[:, keep], gains.noise[keep]
    moved, lower = shift(system), system.G * system.lower
    L = L + lower @ K
    live = system.slope > 0.0
    C, E_y = system.C[rows], gains.unknown.output[rows]
    E_x, E_z = gains.unknown.state + lower @ gains.unknown.argument, gains.unknown.argument[live]
    P, Lam = gains.P, gains.Lambda[live, None]
    T = np.hstack([moved.A - L @ C, moved.G[:, live], -L * N, E_x - L @ E_y])
    n, m, k, r = len(P), int(live.sum()), len(rows), E_z.shape[1]
    sector = np.zeros((n + m + k + r,) * 2)
    own = np.diag(-1.0 / system.slope[live])
    sector[n : n + m] = Lam * np.hstack(
        [system.H[live] - K[live] @ C, own, -K[live] * N, E_z - K[live] @ E_y]
    )
    supply = np.zeros_like(sector)
    supply[:n, :n] = gains.decay**2 * P
    supply[range(n + m, n + m + k), range(n + m, n + m + k)] = gains.mu
    supply[range(n + m + k, n + m + k + r), range(n + m + k, n + m + k + r)] = gains.mu_delta
    whole = T.T @ P @ T - supply + sector + sector.T
    return np.asarray(0.5 * (whole + whole.T))


def discrete_margin(system: DiscreteLure, J: Ints | Sequence[int], gains: DiscreteGains) -> float:
    """Margin of all conditions of the proof; it holds if positive.

    The smaller one of the negativity of `discrete_matrix` and the positivity of P; minus infinity if a
    sign is wrong.

    system, J, gains: as in `discrete_matrix`.
    """
    live = system.slope > 0.0
    signs = [*gains.Lambda[live], gains.decay, 1.0 - gains.decay]
    signs += [gains.mu] if len(gains.J) else []
    signs += [gains.mu_delta] if gains.unknown.state.shape[1] else []
    if not all(value > 0.0 for value in signs):
        return -np.inf
    return min(negativity(-gains.P), negativity(discrete_matrix(system, J, gains)))


def growth(gains: DiscreteGains) -> float:
    """C of yang2019 (5), `sqrt(lambda_max(P) / lambda_min(P))`: `|e(k)| <= c decay^k |e(0)| + …`."""
    values = np.linalg.eigvalsh(gains.P)
    return float(np.sqrt(values[-1] / values[0]))


def noise_gain(gains: DiscreteGains) -> float:
    """gamma_J of yang2019 (5): `|e| <= … + gamma_J sup |m_J|` in Euclidean norms.

    `sqrt(mu / ((1 - decay^2) lambda_min(P))) / min noise`.

    gains: a design with a positive margin.
    """
    quietest = float(np.min(gains.noise))
    if quietest == 0.0:
        return np.inf
    lowest = float(np.linalg.eigvalsh(gains.P)[0])
    return float(np.sqrt(gains.mu / ((1.0 - gains.decay**2) * lowest))) / quietest


def unknown_gain(gains: DiscreteGains) -> float:
    """Gain of delta: `|e| <= … + gain sup |delta|`; 0 without delta."""
    if not gains.unknown.state.shape[1]:
        return 0.0
    lowest = float(np.linalg.eigvalsh(gains.P)[0])
    return float(np.sqrt(gains.mu_delta / ((1.0 - gains.decay**2) * lowest)))


def direct_gain_bound(system: DiscreteLure, proof: DiscreteGains, rows: Floats) -> float:
    """Ultimate bound of direct injection: `|e| <= … + bound sup |s|` in Euclidean norms.

    `|P^(1/2) G diag(slope)|_2 |rows|_2 / ((1 - decay) sqrt(lambda_min(P)))`, over the nonlinearities
    that s reaches: besides the part covered by the proof, `|psi_i| <= slope_i |(rows s)_i|`.

    system: the plant; slopes from zero.
    proof: from `discrete.discrete_contraction`.
    rows (m, s): matrix from the disturbance s to the arguments of the observer's or the plant's
        nonlinearities.
    Source: docs/theory-discrete.md, Theorem 2.
    """
    used = np.any(rows != 0.0, axis=1)
    if not used.any():
        return 0.0
    root = np.linalg.cholesky(proof.P).T
    push = float(np.linalg.norm(root @ (system.G * system.upper)[:, used], 2))
    lowest = float(np.sqrt(np.linalg.eigvalsh(proof.P)[0]))
    return push * float(np.linalg.norm(rows, 2)) / ((1.0 - proof.decay) * lowest)


# Slack of the scaled inequality, as in circle_criterion: far above the solver's tolerance.
_SLACK = 1e-7
# Relative influence on the observer below which a meter counts as ignored.
_BLIND = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteOptions:
    """Specification of a design. n states, p meters.

    Raises ValueError if a candidate is not inside (0, 1), a scale of noise not positive, or the weight not
        positive definite; lists every problem.
    """

    # candidates for lambda, each in (0, 1), per step. The one with the smallest bound is used
    decays: tuple[float, ...]
    noise: Floats  # (p,) scale of each meter's error
    unknown: UncertaintyInputs  # further unknowns
    weight: Floats  # (n, n) Q > 0: the bound minimised is the one on `e^T Q e`

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", frozen(self.noise))
        object.__setattr__(self, "weight", frozen(self.weight))
        decays = bool(self.decays) and all(0.0 < decay < 1.0 for decay in self.decays)
        noise = self.noise.ndim == 1 and np.isfinite(self.noise).all() and bool(np.all(self.noise > 0.0))
        held = {
            Problem("out-of-range", "decays must lie between 0 and 1, and there must be one"): decays,
            Problem("not-positive", "noise must be finite and positive, of shape (p,)"): noise,
            Problem("not-definite", "the weight must be positive definite"): negativity(-self.weight) > 0.0,
        }
        raise_if_any(text for text, holds in held.items() if not holds)


def discrete_options(
    system: DiscreteLure,
    *,
    decays: Sequence[float] | float,
    noise: Floats | float,
    unknown: UncertaintyInputs | None = None,
    weight: Floats | None = None,
) -> DiscreteOptions:
    """Options with short forms filled in for a plant.

    decays: one candidate for lambda or several.
    noise (p,) or scalar: scale of the meters' errors.
    unknown: None by default. Required for a plant that settles by itself; otherwise the best design is blind.
    weight (n, n): identity by default.
    Raises ValueError as `DiscreteOptions`.
    """
    several = tuple(float(decay) for decay in np.atleast_1d(np.asarray(decays, dtype=np.float64)))
    return DiscreteOptions(
        decays=several,
        noise=np.array(np.broadcast_to(np.asarray(noise, dtype=np.float64), (len(system.C),))),
        unknown=nothing_unknown(system) if unknown is None else unknown,
        weight=np.eye(len(system.A)) if weight is None else np.asarray(weight, dtype=np.float64),
    )


def discrete_circle(system: DiscreteLure, J: Sequence[int] | Ints, options: DiscreteOptions) -> DiscreteGains:
    """Design the observer of one set of trusted meters.

    Minimises `(k mu + r mu_delta) / (1 - lambda^2)`, the bound on `e^T Q e` for entries of size one,
    over (P, P L~, Lambda, Lambda K, mu, mu_delta) with `P >= Q`, for each candidate lambda.

    J (k,).
    Raises DesignInfeasible if there is no such observer for any candidate, or if the best one ignores its
        meters.
    """
    return discrete_circles(system, [J], options)[0]


def discrete_circles(
    system: DiscreteLure, subsets: Sequence[Sequence[int] | Ints], options: DiscreteOptions
) -> tuple[DiscreteGains, ...]:
    """`discrete_circle` for several sets; sets of one size share one stated problem.

    Raises DesignInfeasible if there is no such observer for one of the sets, or it ignores its meters.
    """
    templates: dict[int, _Template] = {}
    made = []
    for J in subsets:
        rows = np.asarray(J, dtype=np.intp)
        if not len(rows):
            raise DesignInfeasible(
                "discrete circle-criterion observer",
                "no trusted meter: nothing to design",
                code="nothing-to-design",
            )
        if len(rows) not in templates:
            templates[len(rows)] = _Template(system, options, len(rows), None)
        found = templates[len(rows)].best(rows)
        _refuse_blind(system, found)
        made.append(found)
    return tuple(made)


def discrete_prove(
    system: DiscreteLure, J: Sequence[int] | Ints, L: Floats, K: Floats, options: DiscreteOptions
) -> DiscreteGains:
    """Best proof for given gains: the same inequality in P, Lambda, mu and mu_delta only.

    system, J, options: as in `discrete_circle`.
    L (n, k), K (m, k): gains; blind ones are accepted.
    Raises DesignInfeasible if there is no proof.
    """
    given = (np.asarray(L, dtype=np.float64), np.asarray(K, dtype=np.float64))
    return _Template(system, options, len(J), given).best(np.asarray(J, dtype=np.intp))


def discrete_contraction(system: DiscreteLure, *, decays: Sequence[float] | float) -> DiscreteGains:
    """One proof of direct injection for all sets of meters: the inequality without meters, J empty.

    `|e+|_P <= decay |e|_P` without disturbances, for every set and switching: a trusted meter replaces a
    slope of the loop by zero, which the proof covers. It needs `lower <= 0 <= upper`.

    decays: candidates for lambda. The one with the smallest `sqrt(cond P) / (1 - lambda)` is used.
    Raises DesignInfeasible if there is no proof.
    Source: docs/theory-discrete.md, Theorem 2.
    """
    what = "proof of direct injection for all sets of meters"
    if np.any(system.lower > 0.0) or np.any(system.upper < 0.0):
        raise DesignInfeasible(what, "a slope interval does not contain zero", code="wrong-form")
    options = discrete_options(system, decays=decays, noise=1.0)
    n, m = len(system.A), len(system.lower)
    silent = _Template(system, options, 0, (np.zeros((n, 0)), np.zeros((m, 0))))
    try:
        return silent.best(
            np.zeros(0, dtype=np.intp), lambda one: float(np.sqrt(np.linalg.cond(one.P))) / (1.0 - one.decay)
        )
    except DesignInfeasible as failure:
        raise DesignInfeasible(
            what, f"the inequality has no solution for lambda in {options.decays}", code="no-solution"
        ) from failure


def _refuse_blind(system: DiscreteLure, gains: DiscreteGains) -> None:
    """Refuse a design that ignores every one of its meters."""
    live = system.slope > 0.0
    through = float(np.max(np.abs(gains.K[live]), initial=0.0))
    drive = np.abs(system.G) @ np.maximum(np.abs(system.lower), np.abs(system.upper))
    reference = np.where(drive > 0.0, drive, np.abs(np.diagonal(system.A)))
    pushed = float(np.max(np.abs(gains.L) / np.maximum(reference, _TINY)[:, None], initial=0.0))
    if max(through, pushed) < _BLIND:
        raise DesignInfeasible(
            f"discrete circle-criterion observer of the meters {gains.J.tolist()}",
            "degenerate: the best gains are L = K = 0. The plant settles by itself, and only the "
            "meters are stated as uncertain: using them only costs. State further unknowns "
            "(`unknown`), or smaller meter noise",
            code="degenerate",
        )


_TINY = 1e-300


class _Template:
    """The scaled inequality for sets of one size, stated once and solved for several sets and decays.

    Units: arguments in `z_unit` (a typical unknown), nonlinearity i in `slope_i z_unit`, states in the effect
    of the nonlinearities in one step, outputs in the effect of such states, noise in its root mean square.
    Without further unknowns, the noise sets all scales.
    """

    def __init__(
        self, system: DiscreteLure, options: DiscreteOptions, size: int, given: tuple[Floats, Floats] | None
    ) -> None:
        self.system, self.options, self.size, self.given = system, options, size, given
        self.moved, self.lower = shift(system), system.G * system.lower
        self.live = system.slope > 0.0
        self._set_units()
        self._pose()

    def _set_units(self) -> None:
        argument = self.options.unknown.argument
        spread = np.sqrt(np.sum(argument**2, axis=1)) if argument.size else np.zeros(1)
        self.noise_unit = float(np.sqrt(np.mean(self.options.noise**2)))
        push = np.abs(self.system.G) @ self.system.slope
        push = np.where(push > 0.0, push, np.max(push, initial=0.0) or 1.0)
        read, fed = (float(np.mean(np.abs(rows) @ push)) for rows in (self.system.C, self.system.H))
        ratio = read / fed if read > 0.0 and fed > 0.0 else 1.0
        if np.any(spread > 0.0):
            self.z_unit = float(np.sqrt(np.mean(spread**2)))
            self.y_unit = ratio * self.z_unit
        else:
            self.y_unit = self.noise_unit
            self.z_unit = self.y_unit / ratio
        self.x_unit = push * self.z_unit
        scaled = self.x_unit[:, None] * self.options.weight * self.x_unit
        self.q_unit = float(np.trace(scaled)) / max(1, len(scaled))

    def _pose(self) -> None:
        cp = cvxpy_late()
        moved, options, live, k = self.moved, self.options, self.live, self.size
        x, z, y, unknown = self.x_unit, self.z_unit, self.y_unit, self.options.unknown
        n, m, r = len(x), int(np.count_nonzero(live)), unknown.state.shape[1]
        A = moved.A * x / x[:, None]
        G = moved.G[:, live] * (self.system.slope[live] * z) / x[:, None]
        H = moved.H[live] * x / z
        E_x = (unknown.state + self.lower @ unknown.argument) / x[:, None]
        E_z = unknown.argument[live] / z
        self.C, self.E_y = cp.Parameter((k, n)), cp.Parameter((k, r))
        self.N, self.decay2 = cp.Parameter((1, k), nonneg=True), cp.Parameter(nonneg=True)
        P, lam = cp.Variable((n, n), symmetric=True), cp.Variable(m)
        mu, mu_delta = cp.Variable(), cp.Variable()
        Lam = cp.diag(lam) if m else np.zeros((0, 0))
        if self.given is None:
            Y, Gamma = cp.Variable((n, k)), cp.Variable((m, k))
        else:
            L, K = self.given
            Y, Gamma = P @ ((L + self.lower @ K) * y / x[:, None]), Lam @ K[live] * (y / z)
        # Rows and columns: e, psi, noise, delta, and P for the Schur complement of e+.
        ahead = [P @ A - Y @ self.C, P @ G]
        argument = [Lam @ H - Gamma @ self.C, -2.0 * Lam]
        sizes = [n, m]
        diagonal = [-self.decay2 * P, -2.0 * Lam]
        if k:
            ahead.append(-cp.multiply(Y, np.ones((n, 1)) @ self.N))
            argument.append(-cp.multiply(Gamma, np.ones((m, 1)) @ self.N))
            diagonal.append(-mu * np.eye(k))
            sizes.append(k)
        if r:
            ahead.append(P @ E_x - Y @ self.E_y)
            argument.append(Lam @ E_z - Gamma @ self.E_y)
            diagonal.append(-mu_delta * np.eye(r))
            sizes.append(r)
        whole = cp.bmat(_blocks(sizes, diagonal, argument, ahead, -P))
        Q = x[:, None] * options.weight * x / self.q_unit
        constraints = [whole << -_SLACK * np.eye(n + sum(sizes)), P >> Q]
        loud = min((self.noise_unit / y) ** 2, 1e4)
        # Without disturbances, the best conditioned P gives the best bound in general.
        cost = k * loud * mu + r * mu_delta if k or r else cp.lambda_max(P)
        self.problem = cp.Problem(cp.Minimize(cost), constraints)
        self.variables = (P, Y, lam, Gamma, mu, mu_delta)

    def best(self, J: Ints, cost: Callable[[DiscreteGains], float] | None = None) -> DiscreteGains:
        """The candidate lambda with the smallest cost, by default the bound of `e^T Q e`."""
        found: list[DiscreteGains] = []
        failed: DesignInfeasible | None = None
        for decay in self.options.decays:
            try:
                found.append(self.solve(J, decay))
            except DesignInfeasible as reason:
                failed = reason
        if failed is not None and not found:
            raise failed
        return min(found, key=self._bound if cost is None else cost)

    def _bound(self, made: DiscreteGains) -> float:
        r = self.options.unknown.state.shape[1]
        return float((len(made.J) * made.mu + r * made.mu_delta) / (1.0 - made.decay**2))

    def solve(self, J: Ints, decay: float) -> DiscreteGains:
        """Design for one set at one decay, verified."""
        what = f"discrete circle-criterion observer of the meters {J.tolist()} at decay {decay:g} per step"
        if len(J):
            self.C.value = self.system.C[J] * self.x_unit / self.y_unit
            self.E_y.value = self.options.unknown.output[J] / self.y_unit
            self.N.value = (self.options.noise[J] / self.noise_unit)[None, :]
        else:
            self.C.value = np.zeros((0, len(self.x_unit)))
        self.decay2.value = decay**2
        solve(self.problem, what)
        found = self._in_plant_units(J, decay)
        tries = (
            replace(found, mu=found.mu * (1.0 + part), mu_delta=found.mu_delta * (1.0 + part), backoff=part)
            for part in BACKOFF
        )
        made, held = first_proven(
            tries, lambda tried: discrete_margin(self.system, J, tried), what, found.status
        )
        return replace(made, margin=held)

    def _in_plant_units(self, J: Ints, decay: float) -> DiscreteGains:
        P, lam = (np.asarray(self.variables[i].value, dtype=np.float64) for i in (0, 2))
        x, z, y, live, k = self.x_unit, self.z_unit, self.y_unit, self.live, self.size
        if self.given is not None:
            L, K = self.given
        else:
            Y = np.asarray(self.variables[1].value, dtype=np.float64)
            K = np.zeros((live.size, k))
            if live.any():
                K[live] = np.asarray(self.variables[3].value, dtype=np.float64) / lam[:, None] * (z / y)
            L = np.linalg.solve(P, Y) * (x / y)[:, None] - self.lower @ K
        Lambda = np.zeros(live.size)
        Lambda[live] = self.q_unit * lam / (self.system.slope[live] * z**2)
        mu = float(self.variables[4].value) if k else 0.0
        r = self.options.unknown.state.shape[1]
        mu_delta = float(self.variables[5].value) if r else 0.0
        half = 0.5 * (P + P.T)
        return DiscreteGains(
            J=frozen_ints(J),
            L=frozen(L),
            K=frozen(K),
            P=frozen(self.q_unit * half / x[:, None] / x),
            Lambda=frozen(Lambda),
            decay=decay,
            mu=self.q_unit * mu * (self.noise_unit / y) ** 2,
            mu_delta=self.q_unit * mu_delta,
            noise=frozen(self.options.noise[J]),
            unknown=self.options.unknown,
            margin=np.nan,
            backoff=0.0,
            status=str(self.problem.status),
        )


def _blocks(
    sizes: list[int], diagonal: list[Any], argument: list[Any], ahead: list[Any], last: Any
) -> list[list[Any]]:
    """The whole symmetric block matrix from its nonzero parts, without blocks of size zero."""
    count = len(sizes)
    rows: list[list[Any]] = [[np.zeros((a, b)) for b in sizes] for a in sizes]
    for i in range(count):
        rows[i][i] = diagonal[i]
        if i != 1:
            rows[1][i], rows[i][1] = argument[i], argument[i].T
    rows = [[*row, ahead[i].T] for i, row in enumerate(rows)]
    rows.append([*ahead, last])
    keep = [i for i in range(count + 1) if i == count or sizes[i] > 0]
    return [[rows[i][j] for j in keep] for i in keep]
