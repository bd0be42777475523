"""Observers that do not believe some inputs, of an exact plant and of a feeder with all its errors."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from gridsec.arrays import Floats
from gridsec.observers import unknown_input as observers
from gridsec.observers.lmi.sampled import advance, measure
from gridsec.observers.unknown_input import Pair, UnknownInputPlant
from gridsec.papers import yang2021, yang2021_feeder
from tests.contracts.member import Batch, Family, Member, Run, signs_or_anything, started_away

COUNT = 25
# More sensors than unbelieved inputs: otherwise an observer reproduces its readings whatever they are.
PAIRS: dict[str, tuple[Pair, ...]] = {
    "exact": (((0,), (0, 1, 2)), ((1,), (1, 2, 3)), ((2,), (0, 2, 3)), ((), (0, 1, 2, 3))),
    "feeder": (((0,), tuple(range(7))), ((1, 2), tuple(range(2, 8))), ((), tuple(range(8)))),
}
# Size of states and of inputs, and the middle of the latter.
SIZES = {"exact": (3.0, 5.0, 0.0), "feeder": (0.04, 0.03, 0.07)}


@functools.cache
def plant(where: str) -> UnknownInputPlant:
    if where == "exact":
        return yang2021.plant(2, corrected=True)
    made = yang2021_feeder.plant(yang2021_feeder.AT, yang2021_feeder.METERS, 1e-5)
    return replace(made, drift=made.inputs * 1e-4)


@functools.cache
def design(where: str) -> observers.UnknownInputObserver:
    made = observers.design(plant(where), PAIRS[where])
    assert not made.missing
    return made


def _course(where: str, rng: np.random.Generator, errors: bool = False, extreme: bool = False) -> Run:
    of, (x_size, u_size, middle) = plant(where), SIZES[where]
    system = of.system
    u = middle + u_size * rng.uniform(-1.0, 1.0, (COUNT, system.F.shape[1]))
    states = [x_size * rng.uniform(-1.0, 1.0, len(system.A))]
    width = np.ones(of.drift.shape[1]) * errors
    for k in range(COUNT - 1):
        states.append(advance(system, states[-1], u[k]) + of.drift @ signs_or_anything(rng, width, extreme))
    x = np.array(states)
    n = signs_or_anything(rng, np.tile(of.noise * errors, (COUNT, 1)), extreme)
    # Time starts with the first readings: the first call estimates the first state still.
    return Run(x[0], x[0], measure(system, x, u) + n, u, x, system.h)


def _free(where: str, rng: np.random.Generator) -> Run:
    run = _course(where, rng)
    return replace(run, guess=run.first + SIZES[where][0] * rng.uniform(-1.0, 1.0, run.first.size))


def _honest(where: str, rng: np.random.Generator, extreme: bool) -> Run:
    run = _course(where, rng, errors=True, extreme=extreme)
    away = started_away(rng, SIZES[where][0], run.first.size)
    return replace(run, guess=run.first + away)


def member(where: str) -> Member:
    made = design(where)
    system, count = made.plant.system, len(made.pairs)
    # The sensors' share along the unbelieved inputs is taken for these inputs: what is left of a lie
    # at its own sensor in the first step. Sensors outside J_s show it all.
    share = 1.0 - np.einsum("pn,cnp->cp", system.C, made.inject)
    assert np.all(share > 0.05)

    def norms(errors: list[Floats]) -> Floats:
        pairs = zip(errors, made.gains, strict=True)
        return np.array([np.sqrt(e @ gains.P @ e) for e, gains in pairs])

    def claims(liar: int, lie: float, _: Floats) -> Floats:
        return norms([lie * (made.inject[i] + made.K[i])[:, liar] for i in range(count)])

    return Member(
        listens=made.sensors,
        predicts=np.ones(made.sensors.shape, dtype=bool),
        share=share,
        start=lambda run: observers.init(made, 0.0, run.guess, np.abs(run.guess - run.first)),
        step=lambda state, y, u, seen, _: observers.step(made, state, y, u, seen),
        estimates=lambda state: list(state.x),
        code=lambda x: [x] * count,
        norms=norms,
        decay=lambda calls: made.rate ** (calls - 1),
        slack=1e-9,
        outputs=lambda state, u: observers.outputs(made, state, u),
        bound=lambda state: state.box @ np.abs(system.C).T + made.plant.noise,
        claims=claims,
        free=lambda rng: _free(where, rng),
        honest=lambda rng, extreme: _honest(where, rng, extreme),
        calm=lambda: _course(where, np.random.default_rng(0)),
        lengths=(system.h,),
    )


def batch(where: str) -> Batch:
    many = design(where)
    alone = [observers.design(many.plant, [pair]) for pair in many.pairs]
    system = many.plant.system
    x = SIZES[where][0] * np.random.default_rng(5).uniform(-1.0, 1.0, len(system.A))
    radius = np.ones(x.size)

    def single(index: int) -> Any:
        return lambda state, y, u, seen, _: observers.step(alone[index], state, y, u, seen)

    return Batch(
        sensors=len(many.plant.noise),
        inputs=system.F.shape[1],
        size=SIZES[where][0],
        start=lambda *_: (
            observers.init(many, 0.0, x, radius),
            [observers.init(one, 0.0, x, radius) for one in alone],
        ),
        step=lambda state, y, u, seen, _: observers.step(many, state, y, u, seen),
        single=single,
        estimates=lambda state: list(state.x),
        alone=lambda _, state: np.asarray(state.x[0]),
        steps=tuple((system.h, silent) for silent in ((), (), (1,), (1, 3), (), (), (0,))),
    )


def family() -> Family:
    return Family(
        members={where: (lambda w=where: member(w)) for where in PAIRS},
        batches={where: (lambda w=where: batch(w)) for where in PAIRS},
        one_length="the plant is sampled: a step is one period",
    )
