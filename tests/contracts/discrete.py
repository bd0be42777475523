"""Circle-criterion observers in discrete time: a sampled feeder, and a plant with a sine."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from gridsec.arrays import Floats
from gridsec.observers import circle_discrete as observers
from gridsec.observers.lmi.discrete import discrete_contraction, discrete_options, input_error
from gridsec.observers.lmi.sampled import DiscreteLure, advance, measure, sample
from gridsec.papers import yang2019
from tests.contracts.member import Batch, Family, Member, Run, signs_or_anything, started_away
from tests.gridsec.plants import Street, line, shared, tree

STREETS = {"line": line(5), "tree": tree(), "shared": shared()}
TRUSTED = {"most": (0, 1, 2, 3), "few": (1, 3), "one": (3,)}


@dataclass(frozen=True)
class Kind:
    """A plant, what its readings and inputs may be wrong by, and where its course may go."""

    system: DiscreteLure
    gains: Any
    options: Any
    noise: Floats
    u_error: Floats
    # Size of delta or of the arguments' errors, as the proof counts them.
    unknown: float
    x_size: float
    u_middle: float
    u_size: float

    def trusted(self, sensors: tuple[int, ...]) -> Any:
        return np.isin(np.arange(len(self.system.C)), sensors)

    def design(self, sensors: tuple[int, ...]) -> observers.DiscreteDesign:
        return observers.design(self.system, self.trusted(sensors), gains=self.gains, options=self.options)


def _street(of: Street, gains: str) -> Kind:
    system = sample(of.lure, 1.0)
    noise = np.full(len(of.meters), 3e-4)
    if gains == "direct":
        proof = discrete_contraction(system, decays=(0.5, 0.6, 0.7, 0.8, 0.9))
        size = float(np.linalg.norm(np.abs(system.F) @ of.load_size))
        return Kind(system, proof, None, noise, of.load_size, size, 0.1, 0.09, 0.03)
    unknown = input_error(system, of.load_size)
    weight = system.H.T @ system.H + 1e-6 * np.eye(len(system.A))
    want = discrete_options(system, decays=(0.8, 0.9), noise=3e-4, unknown=unknown, weight=weight)
    return Kind(system, "lmi", want, noise, of.load_size, float(np.sqrt(len(of.load_size))), 0.1, 0.09, 0.03)


@functools.cache
def kind(where: str) -> Kind:
    if where == "sine":
        system = yang2019.system()
        want = discrete_options(system, decays=yang2019.DECAYS, noise=1.0)
        return Kind(system, "lmi", want, np.full(4, 0.5), np.zeros(1), 0.0, 3.0, 0.0, 1.0)
    name, gains = where.split("-")
    return _street(STREETS[name], gains)


def _course(of: Kind, rng: np.random.Generator, count: int, size: float, *, held: bool = False) -> Run:
    n, inputs = len(of.system.A), of.system.F.shape[1]
    x = of.x_size * rng.uniform(-1.0, 1.0, n)
    guess = x + size * rng.uniform(-1.0, 1.0, n)
    u = of.u_middle + of.u_size * rng.uniform(-1.0, 1.0, (count + 1, inputs))
    if held:
        u[:] = of.u_middle
    states = [x]
    for k in range(count):
        states.append(advance(of.system, states[-1], u[k]))
    x_all = np.array(states)
    return Run(x, guess, measure(of.system, x_all, u), u, x_all[1:], of.system.h, ahead=1)


def _honest(of: Kind, rng: np.random.Generator, extreme: bool) -> Run:
    run = _course(of, rng, 60, of.x_size)
    r = run.r + signs_or_anything(rng, np.tile(of.noise, (len(run.r), 1)), extreme)
    u = run.u - signs_or_anything(rng, np.tile(of.u_error, (len(run.r), 1)), extreme)
    guess = run.first + started_away(rng, of.x_size, run.first.size)
    return Run(run.first, guess, r, u, run.x, run.h, run.ahead)


def member(where: str, trusted: tuple[int, ...]) -> Member:
    of = kind(where)
    design = of.design(trusted)
    system, P = of.system, design.certificate.P
    p = len(system.C)
    noise = float(np.linalg.norm(of.noise[design.trusted]))
    # Readings are wrong by what the known input is wrong by, too.
    rest = of.noise + np.abs(system.D) @ of.u_error
    row = np.linalg.norm(system.C, axis=1)

    def norms(errors: list[Floats]) -> Floats:
        return np.array([np.sqrt(e @ P @ e) for e in errors])

    def step(state: Any, y: Floats, u: Floats, seen: Any, _: float) -> Any:
        inner, calls, first = state
        return observers.step(design, inner, y, u, seen), calls + 1, first

    def bound(state: Any) -> Floats:
        error = observers.error_bound(design, state[1], start=state[2], noise=noise, unknown=of.unknown)
        return np.asarray(row * error + rest)[None]

    def claims(liar: int, lie: float, _: Floats) -> Floats:
        # By L at once, by K as far as the curves there move: one step of both, in the norm.
        return norms([design.L[:, liar] * lie])

    return Member(
        listens=design.trusted[None],
        predicts=np.ones((1, p), dtype=bool),
        share=np.ones((1, p)),
        start=lambda run: (
            observers.init(design, 0.0, run.guess),
            0,
            float(np.linalg.norm(run.guess - run.first)),
        ),
        step=step,
        estimates=lambda state: [state[0].x],
        code=lambda x: [x],
        norms=norms,
        decay=lambda calls: np.array([design.decay**calls]),
        slack=1e-9,
        outputs=lambda state, u: observers.outputs(design, state[0], u)[None],
        bound=bound,
        claims=claims if np.any(design.L) else _by_argument(of, design, norms),
        # As many steps as it takes for the certified rate to show.
        free=lambda rng: _course(of, rng, int(np.ceil(np.log(0.3) / np.log(design.decay))), of.x_size),
        honest=lambda rng, extreme: _honest(of, rng, extreme),
        calm=lambda: _course(of, np.random.default_rng(0), 60, 0.0, held=True),
        lengths=(system.h,),
    )


def _by_argument(of: Kind, design: observers.DiscreteDesign, norms: Any) -> Any:
    """Direct injection: a lie moves an inverter as its curve's slope says, here outside the deadband."""
    system = of.system

    def claims(liar: int, lie: float, _: Floats) -> Floats:
        # Curves end: of a large lie, 1e-3 of squared voltage at least arrives.
        pushed = system.upper * (design.K[:, liar] * min(lie, 1e-3))
        return np.asarray(norms([system.G @ pushed]))

    return claims


def batch(where: str, sets: tuple[tuple[int, ...], ...]) -> Batch:
    of = kind(where)
    designs = [of.design(sensors) for sensors in sets]
    many = observers.stack(designs)
    n = len(of.system.A)

    def start(*_: Floats) -> tuple[Any, list[Any]]:
        x = np.random.default_rng(5).uniform(-of.x_size, of.x_size, (len(designs), n))
        return x, [observers.init(design, 0.0, row) for design, row in zip(designs, x, strict=True)]

    def single(index: int) -> Any:
        return lambda state, y, u, seen, _: observers.step(designs[index], state, y, u, seen)

    return Batch(
        sensors=len(of.system.C),
        inputs=of.system.F.shape[1],
        size=of.x_size,
        start=start,
        step=lambda x, y, u, seen, _: observers.advance(many, x, y, u, seen),
        single=single,
        estimates=list,
        alone=lambda _, state: np.asarray(state.x),
        steps=tuple((of.system.h, silent) for silent in ((), (1,), (1, 3), (), (0,))),
    )


WHERE = ("line-direct", "tree-direct", "shared-direct", "line-lmi", "sine")


def family() -> Family:
    return Family(
        members={
            f"{where}-{name}": (lambda w=where, s=sensors: member(w, s))
            for where in WHERE
            for name, sensors in TRUSTED.items()
        },
        batches={where: (lambda w=where: batch(w, tuple(TRUSTED.values()))) for where in WHERE},
        one_length="the plant is sampled: a step is one period",
    )
