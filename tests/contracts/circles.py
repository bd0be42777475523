"""Circle-criterion observers in continuous time, on small feeders."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from gridsec.arrays import Bools, Floats
from gridsec.estimators.exact_bank import bank
from gridsec.estimators.exact_bank.bank import Gains
from gridsec.observers import circle
from gridsec.observers.gains import CircleOptions, options_for, stacked
from gridsec.observers.lmi import solve_many
from gridsec.observers.lure import Lure, StepPolicy
from gridsec.secure.subsets import subsets
from tests.contracts.member import Batch, Family, Member, Run, signs_or_anything
from tests.gridsec.plants import Street, line, shared, tree

NOISE = 3e-4
STREETS = {"line": line(5), "tree": tree(), "shared": shared()}
TRUSTED = {"most": (0, 1, 2, 3), "few": (1, 3), "one": (3,)}
# One integrator treats L inside, the other outside of the exponential: fine substeps make them meet.
FINE = StepPolicy(substep=0.02, settled=1e-6, tol=1e-12, max_iter=60)


def trusted_mask(where: str, trusted: str) -> Bools:
    mask = np.zeros(len(STREETS[where].meters), dtype=bool)
    mask[list(TRUSTED[trusted])] = True
    return mask


def _options(of: Street) -> CircleOptions:
    """Loads as they correlate, and a part in each customer that correlates with nothing."""
    own = 0.1 * float(np.mean(of.load_size))
    load = np.linalg.cholesky(of.load @ of.load.T + own**2 * np.eye(len(of.load)))
    return options_for(of.lure, rate=0.25, noise=NOISE, load=load)


def _rates(lure: Lure, u: Floats) -> Any:
    return lambda _, x: lure.A @ x + lure.G @ lure.phi(lure.H @ x + lure.F @ u) + lure.B @ u


def plant_step(lure: Lure, x: Floats, u: Floats, h: float) -> tuple[Floats, Floats]:
    """The plant in the middle and at the end of a step, by an integrator of its own."""
    run = solve_ivp(_rates(lure, u), (0.0, h), x, t_eval=(0.5 * h, h), rtol=1e-9, atol=1e-13)
    assert run.success
    return run.y[:, 0], run.y[:, 1]


def rest(lure: Lure, u: Floats) -> Floats:
    """Where the plant settles under a constant input: sixty time constants, integrated."""
    run = solve_ivp(_rates(lure, u), (0.0, 120.0), np.zeros(len(lure.A)), rtol=1e-9, atol=1e-13)
    assert run.success
    return np.asarray(run.y[:, -1])


def _free(of: Street, rng: np.random.Generator) -> Run:
    n, inputs, h, count = len(of.lure.A), of.lure.F.shape[1], 0.1, 80
    x, u, guess = rng.uniform(-0.1, 0.1, n), rng.uniform(-0.12, 0.12, inputs), rng.uniform(-0.1, 0.1, n)
    first, readings, states = x, [], []
    for _ in range(count):
        # The reading in the middle of a step stands for the step: the error of that is O(h^2).
        middle, x = plant_step(of.lure, x, u, h)
        readings.append(of.lure.C @ middle + of.lure.D @ u)
        states.append(x)
    return Run(first, guess, np.array(readings), np.tile(u, (count, 1)), np.array(states), h)


def _honest(of: Street, rng: np.random.Generator, extreme: bool) -> Run:
    inputs, p = of.lure.F.shape[1], len(of.meters)
    u = np.full(inputs, rng.uniform(-0.12, 0.12)) + rng.uniform(-0.02, 0.02, inputs)
    x = rest(of.lure, u)
    y = of.lure.C @ x + of.lure.D @ u + signs_or_anything(rng, np.full(p, NOISE), extreme)
    known = u - signs_or_anything(rng, of.load_size, extreme)
    return Run(x, x, y[None], known[None], x[None], 900.0)


def _calm(of: Street) -> Run:
    # Low voltage everywhere, so that no curve rests in its deadband.
    u = np.full(of.lure.F.shape[1], 0.09)
    x = rest(of.lure, u)
    return Run(x, x, (of.lure.C @ x + of.lure.D @ u)[None], u[None], x[None], 900.0)


def member(where: str, trusted: str, gains: Any) -> Member:
    of, mask = STREETS[where], trusted_mask(where, trusted)
    design = circle.design(of.lure, mask, gains=gains, options=_options(of) if gains == "lmi" else None)
    settled = circle.residual_bound(design, np.full(len(of.meters), NOISE), of.load_size)
    assert design.rate > 0.0

    def norms(errors: list[Floats]) -> Floats:
        return np.array([circle.error_norm(design, e) for e in errors])

    return Member(
        listens=design.trusted[None],
        predicts=np.ones((1, mask.size), dtype=bool),
        share=np.ones((1, mask.size)),
        start=lambda run: circle.init(design, 0.0, run.guess),
        step=lambda state, y, u, seen, h: circle.step(design, state, y, u, seen, h),
        estimates=lambda state: [state.x],
        code=lambda x: [x],
        norms=norms,
        decay=lambda calls: np.exp([-design.rate * calls * 0.1]),
        slack=1e-3,
        outputs=lambda state, u: circle.outputs(design, state, u)[None],
        # Settled, so the contracts' honest run is one step to the equilibrium.
        bound=lambda _: settled[None],
        claims=lambda liar, _, x: design.sensitivity[liar] * (design.sensitivity[liar] > 1e-2) * norms([x]),
        free=lambda rng: _free(of, rng),
        honest=lambda rng, extreme: _honest(of, rng, extreme),
        calm=lambda: _calm(of),
        lengths=(0.5, 900.0),
    )


def _singles(of: Street, kind: str) -> tuple[Any, list[circle.CircleDesign]]:
    masks = subsets(len(of.meters), 1, most=1000).masks()
    if kind == "direct":
        return "direct", [circle.design(of.lure, mask) for mask in masks]
    made = solve_many(of.lure, [np.flatnonzero(m).tolist() for m in masks], _options(of), workers=1)
    L, K = stacked(made, len(of.meters))
    return Gains(L=L, K=K), [circle.design(of.lure, m, gains=g) for m, g in zip(masks, made, strict=True)]


def batch(where: str, kind: str) -> Batch:
    """A bank of chong2020 with M = 1."""
    of = STREETS[where]
    gains, designs = _singles(of, kind)
    many = bank.design(of.lure, 1, gains=gains, policy=FINE)
    count, everyone = len(designs), np.ones(len(of.meters), dtype=bool)

    def estimates(state: Any) -> list[Floats]:
        return [bank.estimate(many, state, i) for i in range(count)]

    def start(y: Floats, u: Floats) -> tuple[Any, list[Any]]:
        together = bank.init(many, y, u, everyone)
        pairs = zip(designs, estimates(together), strict=True)
        return together, [circle.init(design, 0.0, x) for design, x in pairs]

    def single(index: int) -> Any:
        design = designs[index]
        return lambda state, y, u, seen, h: circle.step(design, state, y, u, seen, h, FINE)

    return Batch(
        sensors=len(of.meters),
        inputs=of.lure.F.shape[1],
        size=0.1,
        start=start,
        step=lambda state, y, u, seen, h: bank.step(many, state, y, u, seen, h),
        single=single,
        estimates=estimates,
        alone=lambda _, state: np.asarray(state.x),
        steps=((0.5, ()), (2.0, (1,)), (0.5, (1, 3)), (900.0, ()), (1.0, (0,))),
    )


def family(kind: str) -> Family:
    return Family(
        members={
            f"{where}-{trusted}": (lambda w=where, t=trusted: member(w, t, kind))
            for where in STREETS
            for trusted in TRUSTED
        },
        batches={where: (lambda w=where: batch(w, kind)) for where in STREETS},
        one_length="",
    )
