"""Partial high-gain observers: an oscillator with three equal sensors, and sensors that see parts."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from gridsec.arrays import Floats
from gridsec.observers import high_gain
from gridsec.observers.high_gain import Partial, System, groups, linear, nearest
from tests.contracts.member import Batch, Family, Member, Run, signs_or_anything
from tests.gridsec.observers.bent import bent, oscillator

STEP, COUNT, THETA = 0.02, 200, 12.0
# The largest error of a reading, and how much of that is left for what lies between two of them.
NOISE, METER = 2e-4, 1e-4


@dataclass(frozen=True)
class Kind:
    system: System
    drift: Callable[[Floats], Any]
    drive: Floats


MODES = np.diag([-1.0, -2.0])
ROWS = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
KINDS = {
    "oscillator": Kind(bent(), oscillator, np.array([0.0, 1.0])),
    "parts": Kind(linear(MODES, np.ones((2, 1)), ROWS, 1.0), lambda x: MODES @ x, np.ones(2)),
}


def _design(system: System, attacked: int) -> high_gain.HighGainDesign:
    sets = [nearest(system, group, accept=1e-4) for group in groups(len(system.partials), attacked)]
    return high_gain.design(
        system,
        sets,
        theta=THETA,
        noise=NOISE,
        max_attacked=attacked,
        u_low=-0.4,
        u_high=0.4,
        step_s=STEP,
    )


@functools.cache
def design(where: str) -> high_gain.HighGainDesign:
    return _design(KINDS[where].system, 1)


def _course(where: str, rng: np.random.Generator, noise: Floats) -> Run:
    """Started somewhere inside the box, guessed at zero; (COUNT + 1, p) noise."""
    of = KINDS[where]
    x, phase = rng.uniform(-0.6, 0.6, 2), rng.uniform(0.0, 6.0)
    t = STEP * np.arange(COUNT + 1)
    path = solve_ivp(
        lambda s, x: np.array(of.drift(x)) + of.drive * 0.3 * np.sin(s + phase),
        (0.0, t[-1]),
        x,
        t_eval=t,
        rtol=1e-10,
        atol=1e-12,
    )
    states, u = path.y.T, 0.3 * np.sin(t + phase)[:, None]
    first = np.cumsum([0, *[part.size for part in of.system.partials]])[:-1]
    r = of.system.phi(states)[:, first] + noise
    return Run(x, np.zeros(2), r[1:], u[1:], states[1:], STEP, prior=(r[0], u[0]))


def _blocks(system: System, z: Floats) -> list[Floats]:
    return [row[own] for row, own in zip(z, system.mask, strict=True)]


def _code(system: System, x: Floats) -> list[Floats]:
    return [system.phi(x, [i]) for i in range(len(system.partials))]


def _padded(system: System, blocks: list[Floats]) -> Floats:
    z = np.zeros(system.mask.shape)
    z[system.mask] = np.concatenate(blocks)
    return z


def member(where: str) -> Member:
    made = design(where)
    system = made.system
    p = len(system.partials)
    exact = np.zeros((COUNT + 1, p))

    def diagonal(values: Floats) -> Floats:
        return np.where(np.eye(p, dtype=bool), values, np.nan)

    def start(run: Run) -> Any:
        z = _padded(system, _code(system, run.guess))
        return high_gain.init(made, 0.0, *run.prior, z)

    def step(state: Any, y: Floats, u: Floats, seen: Any, h: float) -> Any:
        return high_gain.step(made, state, y, u, seen, h)[0]

    def honest(rng: np.random.Generator, extreme: bool) -> Run:
        return _course(where, rng, signs_or_anything(rng, np.full((COUNT + 1, p), METER), extreme))

    def calm() -> Run:
        run = _course(where, np.random.default_rng(0), exact)
        return replace(run, guess=run.first)

    def claims(liar: int, lie: float, _: Floats) -> Floats:
        # Of one step in which the lie comes up linearly, the first entry alone: K_1 h / 2.
        return 0.5 * STEP * made.K[liar, 0] * lie * (np.arange(p) == liar)

    return Member(
        listens=np.eye(p, dtype=bool),
        predicts=np.eye(p, dtype=bool),
        share=np.ones((p, p)),
        start=start,
        step=step,
        estimates=lambda state: _blocks(system, state.z),
        code=lambda x: _code(system, x),
        norms=lambda errors: np.array([np.max(np.abs(e)) for e in errors]),
        decay=lambda calls: np.array([one.eta * np.exp(-one.rate * calls * STEP) for one in made.decays]),
        slack=1e-3,
        outputs=lambda state, _: diagonal(state.z[:, 0]),
        bound=lambda state: diagonal(high_gain.error_bounds(made, state.age) + NOISE),
        claims=claims,
        free=lambda rng: _course(where, rng, exact),
        honest=honest,
        calm=calm,
        lengths=(STEP, 0.5 * STEP),
    )


def _own(part: Partial) -> System:
    """One sensor's part as a system in its own coordinates, which that sensor sees completely."""
    unit = np.eye(part.size).tolist()
    return System(np.full(part.size, part.bound), (replace(part, phi=list, jacobian=lambda _: unit),))


def batch(where: str) -> Batch:
    many = design(where)
    system = many.system
    alone = [_design(_own(part), 0) for part in system.partials]
    x = np.random.default_rng(5).uniform(-0.5, 0.5, 2)

    def start(y: Floats, u: Floats) -> tuple[Any, list[Any]]:
        singles = [
            high_gain.init(one, 0.0, y[i : i + 1], u, system.phi(x, [i])[None]) for i, one in enumerate(alone)
        ]
        return high_gain.init(many, 0.0, y, u, _padded(system, _code(system, x))), singles

    def single(index: int) -> Any:
        at = slice(index, index + 1)
        return lambda state, y, u, seen, h: high_gain.step(alone[index], state, y[at], u, seen[at], h)[0]

    return Batch(
        sensors=len(system.partials),
        inputs=1,
        size=0.3,
        start=start,
        step=lambda state, y, u, seen, h: high_gain.step(many, state, y, u, seen, h)[0],
        single=single,
        estimates=lambda state: _blocks(system, state.z),
        alone=lambda index, state: _blocks(alone[index].system, state.z)[0],
        steps=((STEP, ()), (STEP, (1,)), (0.5 * STEP, ()), (3.0 * STEP, (0, 2)), (STEP, ()), (STEP, ())),
    )


def family() -> Family:
    return Family(
        members={where: (lambda w=where: member(w)) for where in KINDS},
        batches={where: (lambda w=where: batch(w)) for where in KINDS},
        one_length="readings are joined by straight lines, and the bound of their error includes that",
    )
