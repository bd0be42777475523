"""Design of circle-criterion observers by linear matrix inequalities.

The observer of the trusted meters J is

    x_hat' = A x_hat + G phi(zeta) + B u + L r,   zeta = H x_hat + F u + K r,   r = (y - C x_hat - D u)_J

and `circle` finds the L and K, with their proof, that keep the error small under errors `load @ delta` of
the known input and `noise * n` of the meters. The solver's result is not trusted: the inequality is
rebuilt from the gains in NumPy, in the plant's own units, before a design leaves this module.

Source: chong2020 (11), (12), corrected; arcak2001. Proofs: docs/theory-observers.md.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace

import numpy as np

from gridsec.arrays import Floats, Ints, frozen, frozen_ints
from gridsec.errors import DesignInfeasible
from gridsec.observers.certificates import Certificate, feeds, quadratic
from gridsec.observers.gains import CircleGains, CircleOptions, margin, options_for, refuse_blind, sensitivity
from gridsec.observers.lmi.solver import BACKOFF, cvxpy_late, first_proven, solve
from gridsec.observers.lure import Lure
from gridsec.processes import deaf, listen, stop

# Slack of the scaled inequality, with entries of order one: a hundred times the solver's tolerance, so that
# its last digits cannot decide the sign of the margin.
_SLACK = 1e-6
# Subsets per task of `solve_many`: enough to share one canonicalisation, few enough for steady progress.
_CHUNK = 5


def circle(
    lure: Lure,
    J: Sequence[int] | Ints,
    *,
    rate: float,
    noise: Floats | float,
    load: Floats,
    weight: Floats | None = None,
    floor: float = 0.0,
) -> CircleGains:
    """Design the circle-criterion observer of one set of trusted meters.

    Minimises `k mu + r mu_delta`, a bound on the mean of e^T Q e for signals of their stated sizes, over (P,
    P L, Lambda, Lambda K, mu, mu_delta) subject to the corrected (12) with nu = 1.

    J (k,). rate, noise, load, weight, floor: see `options_for`.
    Raises DesignInfeasible if there is no such observer, if the rebuilt inequality is violated, or if the
        optimum is the blind L = K = 0.
    Source: chong2020 (12), corrected: docs/theory-observers.md, section 2.
    """
    options = options_for(lure, rate=rate, noise=noise, load=load, weight=weight, floor=floor)
    return _Template(lure, options, len(J)).solve(np.asarray(J, dtype=np.intp))


def prove(lure: Lure, J: Sequence[int] | Ints, L: Floats, K: Floats, options: CircleOptions) -> CircleGains:
    """Certificate for an observer with given gains: the corrected (12) in P and Lambda only.

    lure: plant; n states, m nonlinearities.
    J (k,). L (n, k), K (m, k): gains. Those of nonlinearities of slope bound 0 have no effect.
    options: from `options_for`. Its `floor` is ignored.
    Blind gains are accepted.
    Raises DesignInfeasible if the inequality has no solution, or is violated when rebuilt.
    """
    given = (np.asarray(L, dtype=np.float64), np.asarray(K, dtype=np.float64))
    template = _Template(lure, replace(options, floor=0.0), len(J), given=given)
    return template.solve(np.asarray(J, dtype=np.intp))


def contraction(lure: Lure, *, rate: float) -> Certificate:
    """Certificate of direct injection for every trusted set at once, for plants without a closed form.

    Finds P > 0 and a diagonal Lambda > 0 with

        [ P A + A^T P + 2 alpha P   P G + H^T Lambda ]
        [ *                         -Lambda d^-1     ]  <=  0,

    the corrected (12) for no trusted meter, with half of the multiplier's term reserved for errors of the
    load. Trusted meters only remove columns of H in it, and by Theorem 1 of docs/theory-certificates.md this
    proves every set.

    lure: closed loop of a feeder with droop, from `close_loop`.
    rate: alpha, 1/s.
    Raises DesignInfeasible if there is no such P at this rate, or its verification in NumPy fails.
    """
    cp = cvxpy_late()
    what = f"certificate of direct injection for all sets of meters at rate {rate:g}/s"
    # Units as in _Template: every slope bound becomes 1. An inverter of slope bound 0 gets a small one, which
    # is still a bound.
    slope = np.maximum(lure.slope, 1e-3 * (float(np.max(lure.slope, initial=0.0)) or 1.0))
    clock, n = float(np.linalg.norm(lure.A, 2)), len(lure.A)
    A, G, H = lure.A * slope / slope[:, None] / clock, lure.G * slope / slope[:, None] / clock, lure.H * slope
    P, lam = cp.Variable((n, n), symmetric=True), cp.Variable(n)
    half, cross = P @ (A + rate / clock * np.eye(n)), P @ G + (cp.diag(lam) @ H).T
    whole = cp.bmat([[half + half.T, cross], [cross.T, -cp.diag(lam)]])
    # Homogeneous in (P, Lambda): the trace fixes the scale, and the slack is maximised.
    slack = cp.Variable()
    constraints = [whole << -slack * np.eye(2 * n), P >> slack * np.eye(n), cp.trace(P) == n]
    problem = cp.Problem(cp.Maximize(slack), constraints)
    solve(problem, what)
    if not slack.value > 0.0:
        raise DesignInfeasible(
            what, f"the inequality has no solution ({problem.status})", slack.value, code="no-solution"
        )
    found = np.asarray(P.value, dtype=np.float64) / slope[:, None] / slope
    # e^T P e in plant units; the multiplier follows from psi = slope * scaled psi and the clock.
    Lambda = np.asarray(lam.value, dtype=np.float64) * clock / slope
    status = f"corrected inequality (12) without meters, solver: {problem.status}"
    return quadratic(lure, 0.5 * (found + found.T), Lambda, rate, kind="lmi", status=status)


def solve_many(
    lure: Lure,
    subsets: Sequence[Sequence[int]],
    options: CircleOptions,
    *,
    workers: int,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[CircleGains, ...]:
    """Design the observers of several trusted sets, in several processes.

    Processes are spawned, so a calling script needs the `if __name__ == "__main__"` guard; each runs its
    linear algebra on one thread. One worker means this process.

    lure: plant. Its matrices are sent to the workers; its nonlinearity, which no inequality needs, is not.
    options: from `options_for`.
    progress: called in this process with (done, total) after finished designs.
    Returns the designs in the order of `subsets`.
    Raises DesignInfeasible for the first set with a failed design; pending work is dropped.
    """
    chunks = _chunks(subsets)
    results: dict[int, CircleGains] = {}

    def collect(indices: Sequence[int], outcome: list[CircleGains] | _Failure) -> None:
        if isinstance(outcome, _Failure):
            raise DesignInfeasible(outcome.what, outcome.status, outcome.margin, code=outcome.code)
        results.update(zip(indices, outcome, strict=True))
        if progress is not None:
            progress(len(results), len(subsets))

    bare = replace(lure, phi=_no_curve)
    if workers <= 1 or len(chunks) <= 1:
        for indices, group in chunks:
            collect(indices, _solve_chunk(bare, options, group))
    else:
        context = multiprocessing.get_context("spawn")
        count = min(workers, len(chunks))
        pool = ProcessPoolExecutor(count, mp_context=context, initializer=_one_thread)
        try:
            with deaf():
                jobs: dict[Future[list[CircleGains] | _Failure], Sequence[int]] = {
                    pool.submit(_solve_chunk, bare, options, group): indices for indices, group in chunks
                }
            for job in as_completed(jobs):
                collect(jobs[job], job.result())
        finally:
            stop(pool)
    return tuple(results[index] for index in range(len(subsets)))


@dataclass(frozen=True, slots=True)
class _Failure:
    """A DesignInfeasible in transit between processes: exceptions with several arguments do not pickle."""

    what: str
    status: str
    margin: float | None
    code: str


def _chunks(subsets: Sequence[Sequence[int]]) -> list[tuple[list[int], list[Ints]]]:
    """Group the sets by size, because one canonicalised problem serves one size."""
    sizes: dict[int, list[int]] = {}
    for index, subset in enumerate(subsets):
        sizes.setdefault(len(subset), []).append(index)
    parts = [
        indices[start : start + _CHUNK]
        # The largest sets take longest and come first, so that no worker is left with them at the end.
        for _, indices in sorted(sizes.items(), reverse=True)
        for start in range(0, len(indices), _CHUNK)
    ]
    return [(part, [np.asarray(subsets[index], dtype=np.intp) for index in part]) for part in parts]


def _one_thread() -> None:
    """Pin the linear algebra of a worker to one thread; threads of several processes would compete."""
    listen()
    import scipy.linalg  # noqa: F401  # loads the libraries that are to be limited
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # has no stubs

    threadpool_limits(limits=1)


def _no_curve(z: Floats) -> Floats:
    """Placeholder of the nonlinearity where only its slope bounds matter."""
    raise AssertionError(f"a design evaluated the nonlinearity, shape {z.shape}")


def _solve_chunk(lure: Lure, options: CircleOptions, group: Sequence[Ints]) -> list[CircleGains] | _Failure:
    """Worker: designs for sets of one size."""
    try:
        template = _Template(lure, options, len(group[0]))
        return [template.solve(J) for J in group]
    except DesignInfeasible as failure:
        return _Failure(failure.what, failure.status, failure.margin, failure.code)


class _Template:
    """The scaled inequality for sets of one size, canonicalised once and solved for several sets.

    Units: time in `1 / |A|`, z and y in `z_unit` (a typical load error), nonlinearity i in `slope_i z_unit`
    (so that every slope bound becomes 1), states in the effect of the nonlinearities in one unit of time,
    noise in its root mean square. All entries are then of order one, for any base power of the feeder.
    """

    def __init__(
        self, lure: Lure, options: CircleOptions, size: int, given: tuple[Floats, Floats] | None = None
    ) -> None:
        if size == 0:
            raise DesignInfeasible(
                "circle-criterion observer", "no trusted meter: nothing to design", code="nothing-to-design"
            )
        self.lure, self.options, self.size, self.given = lure, options, size, given
        self.live = lure.slope > 0.0
        self._set_units()
        self._pose()

    def _set_units(self) -> None:
        lure, load = self.lure, self.options.load
        spread = np.sqrt(np.sum((lure.F @ load) ** 2, axis=1))
        noise = float(np.sqrt(np.mean(self.options.noise**2)))
        self.z_unit = float(np.sqrt(np.mean(spread**2))) if np.any(spread > 0.0) else noise
        self.noise_unit = noise
        self.clock = float(np.linalg.norm(lure.A, 2))
        push = (np.abs(lure.G) @ lure.slope) * self.z_unit / self.clock
        self.x_unit = np.where(push > 0.0, push, np.max(push, initial=0.0) or self.z_unit)
        scaled = self.x_unit[:, None] * self.options.weight * self.x_unit
        self.q_unit = float(np.trace(scaled)) / len(scaled)
        if not self.q_unit > 0.0:
            raise DesignInfeasible(
                "circle-criterion observer",
                "the weight Q is zero: nothing to keep small",
                code="nothing-to-design",
            )

    def _pose(self) -> None:
        """State the problem in scaled coordinates, with the set of meters as a parameter."""
        cp = cvxpy_late()
        lure, options, live, k = self.lure, self.options, self.live, self.size
        x, z, clock = self.x_unit, self.z_unit, self.clock
        n, m, r = len(lure.A), int(np.count_nonzero(live)), options.load.shape[1]
        A = lure.A * x / x[:, None] / clock
        G = lure.G[:, live] * (lure.slope[live] * z) / x[:, None] / clock
        H, F = lure.H[live] * x / z, lure.F[live] @ options.load / z
        B = lure.B @ options.load / x[:, None] / clock
        Q = x[:, None] * options.weight * x / self.q_unit
        self.C, self.D = cp.Parameter((k, n)), cp.Parameter((k, r))
        self.N, self.at = cp.Parameter((1, k), nonneg=True), cp.Parameter((m, k), nonneg=True)
        P, Y = cp.Variable((n, n), symmetric=True), cp.Variable((n, k))
        lam, Gamma = cp.Variable(m), cp.Variable((m, k))
        mu, mu_delta = cp.Variable(), cp.Variable()
        Lam = cp.diag(lam)
        half = P @ A - Y @ self.C
        ee = half + half.T + (2.0 * options.rate / clock) * P + Q
        ep = P @ G + (Lam @ H - Gamma @ self.C).T
        en, pn = -cp.multiply(Y, np.ones((n, 1)) @ self.N), -cp.multiply(Gamma, np.ones((m, 1)) @ self.N)
        ed, pd = P @ B - Y @ self.D, Lam @ F - Gamma @ self.D
        nn, nd, dd = -mu * np.eye(k), np.zeros((k, r)), -mu_delta * np.eye(r)
        whole = cp.bmat(
            [[ee, ep, en, ed], [ep.T, -2.0 * Lam, pn, pd], [en.T, pn.T, nn, nd], [ed.T, pd.T, nd.T, dd]]
        )
        constraints = [whole << -_SLACK * np.eye(n + m + k + r), P >> _SLACK * np.eye(n)]
        if self.given is not None:
            L, K = self.given
            constraints += [P @ (L * z / x[:, None] / clock) == Y, Gamma == Lam @ K[live]]
        if options.floor > 0.0:
            constraints.append(
                cp.multiply(self.at, Gamma) >= options.floor * cp.multiply(self.at, Lam @ np.ones((m, k)))
            )
        # The noise column is written for unit noise and weighted here: its size changes the optimum,
        # not the conditioning. Beyond a hundred load errors it changes neither.
        loud = min((self.noise_unit / z) ** 2, 1e4)
        self.problem = cp.Problem(cp.Minimize(k * loud * mu + r * mu_delta), constraints)
        self.variables = (P, Y, lam, Gamma, mu, mu_delta)

    def solve(self, J: Ints) -> CircleGains:
        """Design for one set, verified. Raises DesignInfeasible as in `circle`."""
        lure, options, live = self.lure, self.options, self.live
        what = f"circle-criterion observer of the meters {J.tolist()} at rate {options.rate:g}/s"
        self.C.value = lure.C[J] * self.x_unit / self.z_unit
        self.D.value = lure.D[J] @ options.load / self.z_unit
        self.N.value = (options.noise[J] / self.noise_unit)[None, :]
        self.at.value = feeds(lure)[np.ix_(live, J)].astype(np.float64)
        solve(self.problem, what)
        return settle(lure, self._in_plant_units(J), what, blind=self.given is not None)

    def _in_plant_units(self, J: Ints) -> CircleGains:
        """Undo the scaling; nu = 1 fixes the free scale of the inequality."""
        lure, options, live = self.lure, self.options, self.live
        P, Y, lam, Gamma, mu, mu_delta = (np.asarray(v.value, dtype=np.float64) for v in self.variables)
        x, z = self.x_unit, self.z_unit
        if self.given is not None:
            L, K = self.given
        else:
            L = np.linalg.solve(P, Y) * (x * self.clock / z)[:, None]
            K = np.zeros((len(lure.slope), self.size))
            K[live] = Gamma / lam[:, None]
        Lambda = np.zeros(len(lure.slope))
        Lambda[live] = self.q_unit * lam / (lure.slope[live] * z**2)
        half = 0.5 * (P + P.T)
        return CircleGains(
            J=frozen_ints(J),
            L=frozen(L),
            K=frozen(K),
            P=frozen(self.q_unit / self.clock * half / x[:, None] / x),
            Lambda=frozen(Lambda),
            nu=1.0,
            mu=self.q_unit * float(mu) * (self.noise_unit / z) ** 2,
            mu_delta=self.q_unit * float(mu_delta),
            alpha=options.rate,
            noise=frozen(options.noise[J]),
            load=options.load,
            weight=options.weight,
            margin=np.nan,
            sensitivity=frozen(sensitivity(lure, L, K)),
            backoff=0.0,
            status=str(self.problem.status),
        )


def settle(lure: Lure, found: CircleGains, what: str, *, blind: bool = False) -> CircleGains:
    """Turn a solver's result into a proven design, or refuse it.

    The margin is recomputed in the plant's own units. If it is not positive, alpha, nu are shrunk
    and mu, mu_delta grown together by the stated steps (at most 5 %), which makes every diagonal
    block but that of psi more negative; the gains stay. `backoff` stores the step.

    blind: accept gains that use no meter.
    Raises DesignInfeasible if every step fails, or if the design uses no meter.
    """
    tries = (
        replace(
            found,
            alpha=found.alpha * (1.0 - step),
            nu=found.nu * (1.0 - step),
            mu=found.mu * (1.0 + step),
            mu_delta=found.mu_delta * (1.0 + step),
            backoff=step,
        )
        for step in BACKOFF
    )
    made, reached = first_proven(tries, lambda tried: margin(lure, found.J, tried), what, found.status)
    if not blind:
        refuse_blind(found.J, found.sensitivity)
    return replace(made, margin=reached)
