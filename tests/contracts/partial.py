"""One observer for each sensor of a linear plant: Luenberger's with hard bounds, Kalman's with variances."""

from __future__ import annotations

from typing import Any

import numpy as np

from gridsec.arrays import Floats
from gridsec.observers import kalman, luenberger
from gridsec.observers.luenberger import Bounds
from tests.contracts.member import Batch, Family, Member, Run, signs_or_anything, started_away
from tests.gridsec.observers.modal import modal

# Plants of five states and sensors, with a mode that grows and modes that single sensors do not see.
SEEDS = (0, 4, 7)
TOL, INSIDE = 1e-8, 1.0 - 1e-6
PROCESS, NOISE = 1e-2, np.array([1e-3, 2e-3, 5e-4, 1e-3, 3e-3])
COUNT = 30

DOUBT = 1e-9
"""A Kalman filter bounds nothing for certain. Each of its residuals is a sum of independent errors that are
normal, or plus or minus one standard deviation; by Chernoff's bound it exceeds `sqrt(2 ln(2 / DOUBT))`
standard deviations with a probability of at most DOUBT, for both kinds."""


def _course(A: Floats, B: Floats, C: Floats, rng: np.random.Generator, *, d: Floats, n: Floats) -> Run:
    """The plant driven by d (COUNT, n), its sensors off by n (COUNT + 1, p), from a random state."""
    u = rng.uniform(-1.0, 1.0, (COUNT + 1, B.shape[1]))
    states = [rng.uniform(-1.0, 1.0, len(A))]
    for k in range(COUNT):
        states.append(A @ states[-1] + B @ u[k] + d[k])
    x = np.array(states)
    return Run(x[0], x[0], x @ C.T + n, u, x[1:], 2.0, ahead=1)


def _with_guess(run: Run, guess: Floats, prior: Any = None, shift: int = 0) -> Run:
    return Run(run.first, guess, run.r[shift:], run.u, run.x, run.h, run.ahead, prior)


def _blocks(stack: Any, vector: Floats) -> list[Floats]:
    return [vector[stack.rows(i)] for i in range(len(stack.parts))]


def _diagonal(values: Floats) -> Floats:
    """(p, p): each observer predicts its own sensor; nothing about the others."""
    return np.where(np.eye(len(values), dtype=bool), values, np.nan)


def _single_steps(made: list[Any], step: Any) -> Any:
    def single(index: int) -> Any:
        at = slice(index, index + 1)
        return lambda state, y, u, seen, _: step(made[index], state, y[at], u, seen[at])

    return single


STEPS = tuple((2.0, silent) for silent in ((), (1,), (1, 3), (), (0, 4)))


def luenberger_member(seed: int) -> Member:
    A, B, C = modal(seed)
    design = luenberger.design(
        A, B, C, Bounds(PROCESS, NOISE, np.eye(5)), slowest=INSIDE, tol=TOL, rate=0.9, period=2.0
    )
    stack, p = design.stack, len(C)
    length = np.linalg.norm(stack.T, axis=1)
    quiet, exact = np.zeros((COUNT, 5)), np.zeros((COUNT + 1, p))

    def free(rng: np.random.Generator) -> Run:
        run = _course(A, B, C, rng, d=quiet, n=exact)
        return _with_guess(run, run.first + rng.uniform(-1.0, 1.0, 5))

    def honest(rng: np.random.Generator, extreme: bool) -> Run:
        d = rng.standard_normal((COUNT, 5))
        d *= PROCESS / np.linalg.norm(d, axis=1, keepdims=True)
        d *= 1.0 if extreme else rng.uniform(0.0, 1.0, (COUNT, 1))
        n = signs_or_anything(rng, np.tile(NOISE, (COUNT + 1, 1)), extreme)
        run = _course(A, B, C, rng, d=d, n=n)
        return _with_guess(run, run.first + started_away(rng, 1.0, 5))

    return Member(
        listens=np.eye(p, dtype=bool),
        predicts=np.eye(p, dtype=bool),
        share=np.ones((p, p)),
        start=lambda run: luenberger.init(
            design, 0.0, run.guess, float(np.linalg.norm(run.guess - run.first))
        ),
        step=lambda state, y, u, seen, _: luenberger.step(design, state, y, u, seen),
        estimates=lambda state: _blocks(stack, state.z),
        code=lambda x: _blocks(stack, stack.phi @ x),
        norms=lambda errors: np.array([np.linalg.norm(e) for e in errors]),
        decay=lambda calls: np.array([one.growth(calls) for one in design.envelopes]),
        slack=1e-9,
        outputs=lambda state, _: _diagonal(stack.T @ state.z),
        bound=lambda state: _diagonal(length * luenberger.bound(design, state) + NOISE),
        claims=lambda liar, lie, _: np.linalg.norm(design.L[:, liar]) * lie * (np.arange(p) == liar),
        free=free,
        honest=honest,
        calm=lambda: _course(A, B, C, np.random.default_rng(0), d=quiet, n=exact),
        lengths=(2.0,),
    )


def luenberger_batch(seed: int) -> Batch:
    A, B, C = modal(seed)

    def made(rows: slice) -> Any:
        bounds = Bounds(PROCESS, NOISE[rows], np.eye(5))
        return luenberger.design(A, B, C[rows], bounds, slowest=INSIDE, tol=TOL, rate=0.9, period=2.0)

    many, alone = made(slice(None)), [made(slice(i, i + 1)) for i in range(5)]
    x = np.random.default_rng(5).uniform(-1.0, 1.0, 5)
    return Batch(
        sensors=5,
        inputs=1,
        size=1.0,
        start=lambda *_: (luenberger.init(many, 0.0, x), [luenberger.init(one, 0.0, x) for one in alone]),
        step=lambda state, y, u, seen, _: luenberger.step(many, state, y, u, seen),
        single=_single_steps(alone, luenberger.step),
        estimates=lambda state: _blocks(many.stack, state.z),
        alone=lambda _, state: np.asarray(state.z),
        steps=STEPS,
    )


def _covariances(seed: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((2, 5, 5))
    return 1e-4 * (roots[0] @ roots[0].T + 0.1 * np.eye(5)), 1e-6 * (roots[1] @ roots[1].T + np.eye(5))


def kalman_member(seed: int) -> Member:
    A, B, C = modal(seed)
    Q, R = _covariances(seed)
    design = kalman.design(A, B, C, Q, R, slowest=INSIDE, tol=TOL, period=2.0)
    stack, p, first = design.stack, len(C), np.eye(5)
    steady = kalman.steady(design)
    at = [stack.rows(i) for i in range(p)]
    # In the norm of its own covariance the error of a settled filter falls by what noise adds to it:
    # P = F P F^T + W makes |F e| <= sqrt(1 - least eigenvalue of W relative to P) |e|.
    factors = [np.linalg.cholesky(steady.P[rows, rows]) for rows in at]
    moves = [
        np.linalg.norm(np.linalg.solve(half, steady.F[rows, rows] @ half), 2)
        for half, rows in zip(factors, at, strict=True)
    ]
    rates = np.array(moves)
    assert np.all(rates < 1.0)
    quiet, exact = np.zeros((COUNT, 5)), np.zeros((COUNT + 1, p))
    deviations = float(np.sqrt(2.0 * np.log(2.0 / DOUBT)))

    def start(run: Run) -> Any:
        begun = kalman.init(design, 0.0, run.guess, first)
        return begun if run.prior is None else kalman.KalmanState(0.0, begun.z, *run.prior)

    def later(run: Run) -> Run:
        """Readings come at the ends of steps: the first one is that of the second state."""
        rest = np.vstack([run.r[1:], run.r[-1:]])
        return Run(run.first, run.guess, rest[:-1], run.u[:-1], run.x[:-1], run.h, run.ahead, run.prior)

    def free(rng: np.random.Generator) -> Run:
        run = _course(A, B, C, rng, d=quiet, n=exact)
        return later(_with_guess(run, run.first + rng.uniform(-1.0, 1.0, 5), (steady.P, steady.K)))

    def draw(rng: np.random.Generator, count: int, covariance: Floats, extreme: bool) -> Floats:
        size = (count, len(covariance))
        unit = rng.choice([-1.0, 1.0], size) if extreme else rng.standard_normal(size)
        return np.asarray(unit @ np.linalg.cholesky(covariance).T)

    def honest(rng: np.random.Generator, extreme: bool) -> Run:
        run = _course(A, B, C, rng, d=draw(rng, COUNT, Q, extreme), n=draw(rng, COUNT + 1, R, extreme))
        return later(_with_guess(run, run.first + draw(rng, 1, first, extreme)[0]))

    def bound(state: Any) -> Floats:
        ahead = kalman.predict(design, state, np.zeros(B.shape[1]))
        return _diagonal(deviations * np.sqrt(np.diagonal(stack.T @ ahead.P @ stack.T.T + R)))

    return Member(
        listens=np.eye(p, dtype=bool),
        predicts=np.eye(p, dtype=bool),
        share=np.ones((p, p)),
        start=start,
        step=lambda state, y, u, seen, _: kalman.step(design, state, y, u, seen),
        estimates=lambda state: _blocks(stack, state.z),
        code=lambda x: _blocks(stack, stack.phi @ x),
        norms=lambda errors: np.array(
            [np.linalg.norm(np.linalg.solve(half, e)) for half, e in zip(factors, errors, strict=True)]
        ),
        decay=lambda calls: rates**calls,
        slack=1e-9,
        # Its residuals are innovations: the next reading less what is expected of it.
        outputs=lambda state, u: _diagonal(stack.T @ kalman.predict(design, state, u).z),
        bound=bound,
        claims=lambda liar, lie, _: np.array(
            [
                lie * float(np.linalg.norm(np.linalg.solve(half, steady.K[rows, liar])))
                for half, rows in zip(factors, at, strict=True)
            ]
        ),
        free=free,
        honest=honest,
        calm=lambda: later(_course(A, B, C, np.random.default_rng(0), d=quiet, n=exact)),
        lengths=(2.0,),
    )


def kalman_batch(seed: int) -> Batch:
    A, B, C = modal(seed)
    Q, R = _covariances(seed)

    def made(rows: slice) -> Any:
        return kalman.design(A, B, C[rows], Q, R[rows, rows], slowest=INSIDE, tol=TOL, period=2.0)

    many, alone = made(slice(None)), [made(slice(i, i + 1)) for i in range(5)]
    x = np.random.default_rng(5).uniform(-1.0, 1.0, 5)
    return Batch(
        sensors=5,
        inputs=1,
        size=1.0,
        start=lambda *_: (
            kalman.init(many, 0.0, x, np.eye(5)),
            [kalman.init(one, 0.0, x, np.eye(5)) for one in alone],
        ),
        step=lambda state, y, u, seen, _: kalman.step(many, state, y, u, seen),
        single=_single_steps(alone, kalman.step),
        estimates=lambda state: _blocks(many.stack, state.z),
        alone=lambda _, state: np.asarray(state.z),
        steps=STEPS,
    )


SAMPLED = "the plant is sampled: a step is one period"


def luenberger_family() -> Family:
    return Family(
        members={f"modal-{seed}": (lambda s=seed: luenberger_member(s)) for seed in SEEDS},
        batches={f"modal-{seed}": (lambda s=seed: luenberger_batch(s)) for seed in SEEDS},
        one_length=SAMPLED,
    )


def kalman_family() -> Family:
    return Family(
        members={f"modal-{seed}": (lambda s=seed: kalman_member(s)) for seed in SEEDS},
        batches={f"modal-{seed}": (lambda s=seed: kalman_batch(s)) for seed in SEEDS},
        one_length=SAMPLED,
    )
