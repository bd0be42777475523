"""What every family of observers owes, checked on every family and every small feeder alike.

A new family is one more entry of FAMILIES: five functions, and a sixth if it can run many observers
at once. Nothing below knows which family it is looking at.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsec import bank
from gridsec.arrays import Bools, Floats
from gridsec.gains import CircleOptions, options_for, stacked
from gridsec.lmi import solve_many
from gridsec.lure import Lure, StepPolicy
from gridsec.observers import circle
from gridsec.stacked import Gains
from gridsec.subsets import subsets
from tests.gridsec.plants import Street, line, shared, tree

NOISE = 3e-4


@dataclass(frozen=True)
class Family:
    """The border of a family. Everything in z coordinates, `y = vbar^2 - v^2`."""

    # (street, trusted) -> design with `.rate` (1/s) and `.trusted`
    design: Callable[[Street, Bools], Any]
    # (design, x) -> state with `.x`
    init: Callable[[Any, Floats], Any]
    # (design, state, y, u, seen, h[, policy]) -> state
    step: Callable[..., Any]
    # (design, state, u) -> (p,)
    outputs: Callable[[Any, Any, Floats], Floats]
    # (design, e) -> norm in which the error decays
    norm: Callable[[Any, Floats], Floats]
    # (design, y_error, u_error) -> (p,) bound of an honest residual, settled
    residual_bound: Callable[[Any, Floats, Floats], Floats]
    # street -> gains for `bank.design` with M = 1, and its observers one by one; None: no batch
    batch: Callable[[Street], tuple[Any, list[Any]]] | None


def _masks(of: Street) -> Bools:
    return subsets(len(of.meters), 1, most=1000).masks()


def _options(of: Street) -> CircleOptions:
    """Loads as they correlate, and a part in each customer that correlates with nothing."""
    own = 0.1 * float(np.mean(of.load_size))
    load = np.linalg.cholesky(of.load @ of.load.T + own**2 * np.eye(len(of.load)))
    return options_for(of.lure, rate=0.25, noise=NOISE, load=load)


def _lmi_design(of: Street, trusted: Bools) -> circle.CircleDesign:
    return circle.design(of.lure, trusted, gains="lmi", options=_options(of))


def _lmi_batch(of: Street) -> tuple[Gains, list[Any]]:
    masks = _masks(of)
    made = solve_many(of.lure, [np.flatnonzero(m).tolist() for m in masks], _options(of), workers=1)
    L, K = stacked(made, len(of.meters))
    singles = [circle.design(of.lure, m, gains=g) for m, g in zip(masks, made, strict=True)]
    return Gains(L=L, K=K), singles


def _direct_batch(of: Street) -> tuple[str, list[Any]]:
    return "direct", [circle.design(of.lure, m) for m in _masks(of)]


def _start(design: circle.CircleDesign, x: Floats) -> circle.CircleState:
    return circle.init(design, 0.0, x)


FAMILIES = {
    "circle-direct": Family(
        design=lambda of, trusted: circle.design(of.lure, trusted),
        init=_start,
        step=circle.step,
        outputs=circle.outputs,
        norm=circle.error_norm,
        residual_bound=circle.residual_bound,
        batch=_direct_batch,
    ),
    "circle-lmi": Family(
        design=_lmi_design,
        init=_start,
        step=circle.step,
        outputs=circle.outputs,
        norm=circle.error_norm,
        residual_bound=circle.residual_bound,
        batch=_lmi_batch,
    ),
}
STREETS = {"line": line(5), "tree": tree(), "shared": shared()}
EVERY = [(family, where) for family in FAMILIES for where in STREETS]
TRUSTED = {"most": (0, 1, 2, 3), "few": (1, 3), "one": (3,)}


@functools.cache
def member(family: str, where: str, trusted: str) -> Any:
    """One observer; designs take time, so each is made once."""
    of = STREETS[where]
    mask = np.zeros(len(of.meters), dtype=bool)
    mask[list(TRUSTED[trusted])] = True
    return FAMILIES[family].design(of, mask)


def plant_step(lure: Lure, x: Floats, u: Floats, h: float) -> tuple[Floats, Floats]:
    """The plant in the middle and at the end of a step, by an integrator of its own."""
    run = solve_ivp(
        lambda _, x: lure.A @ x + lure.G @ lure.phi(lure.H @ x + lure.F @ u) + lure.B @ u,
        (0.0, h),
        x,
        t_eval=(0.5 * h, h),
        rtol=1e-9,
        atol=1e-13,
    )
    assert run.success
    return run.y[:, 0], run.y[:, 1]


def rest(lure: Lure, u: Floats) -> Floats:
    """Where the plant settles under a constant input: two quarters of an hour, integrated."""
    run = solve_ivp(
        lambda _, x: lure.A @ x + lure.G @ lure.phi(lure.H @ x + lure.F @ u) + lure.B @ u,
        (0.0, 120.0),
        np.zeros(len(lure.A)),
        rtol=1e-9,
        atol=1e-13,
    )
    assert run.success
    return np.asarray(run.y[:, -1])


def everyone(of: Street) -> Bools:
    return np.ones(len(of.meters), dtype=bool)


@pytest.mark.parametrize("trusted", TRUSTED)
@pytest.mark.parametrize(("family", "where"), EVERY)
def test_decays_at_the_certified_rate(family: str, where: str, trusted: str) -> None:
    of, kind, design = STREETS[where], FAMILIES[family], member(family, where, trusted)
    n, inputs, h = len(of.lure.A), of.lure.F.shape[1], 0.1
    assert design.rate > 0.0

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=4)
    def check(seed: int) -> None:
        rng = np.random.default_rng(seed)
        x, u = rng.uniform(-0.1, 0.1, n), rng.uniform(-0.12, 0.12, inputs)
        state = kind.init(design, rng.uniform(-0.1, 0.1, n))
        first = float(kind.norm(design, x - state.x))
        for index in range(1, 81):
            # The reading in the middle of a step stands for the step: the error of that is O(h^2).
            middle, x = plant_step(of.lure, x, u, h)
            y = of.lure.C @ middle + of.lure.D @ u
            state = kind.step(design, state, y, u, everyone(of), h)
            now = float(kind.norm(design, x - state.x))
            assert now <= first * (np.exp(-design.rate * index * h) + 1e-3)

    check()


@pytest.mark.parametrize("trusted", TRUSTED)
@pytest.mark.parametrize(("family", "where"), EVERY)
def test_an_honest_residual_stays_inside_its_bound(family: str, where: str, trusted: str) -> None:
    of, kind, design = STREETS[where], FAMILIES[family], member(family, where, trusted)
    inputs, p = of.lure.F.shape[1], len(of.meters)
    y_error, u_error = np.full(p, NOISE), of.load_size
    bound = kind.residual_bound(design, y_error, u_error)
    assert np.isfinite(bound).all()

    @given(st.integers(0, 2**32 - 1), st.booleans())
    @settings(max_examples=8)
    def check(seed: int, extreme: bool) -> None:
        rng = np.random.default_rng(seed)

        def within(size: Floats) -> Floats:
            return size * (rng.choice([-1.0, 1.0], len(size)) if extreme else rng.uniform(-1, 1, len(size)))

        u = np.full(inputs, rng.uniform(-0.12, 0.12)) + rng.uniform(-0.02, 0.02, inputs)
        x = rest(of.lure, u)
        y = of.lure.C @ x + of.lure.D @ u + within(y_error)
        known = u - within(u_error)
        state = kind.step(design, kind.init(design, x), y, known, everyone(of), 900.0)
        assert np.all(np.abs(y - kind.outputs(design, state, known)) <= bound + 1e-12)

    check()


@pytest.mark.parametrize("trusted", TRUSTED)
@pytest.mark.parametrize(("family", "where"), EVERY)
def test_attacks_are_visible(family: str, where: str, trusted: str) -> None:
    """A lie of three honest bounds breaks the bound at the liar, trusted or not; and where the observer
    claims to listen, the estimate moves too."""
    of, kind, design = STREETS[where], FAMILIES[family], member(family, where, trusted)
    p, inputs = len(of.meters), of.lure.F.shape[1]
    bound = kind.residual_bound(design, np.full(p, NOISE), of.load_size)
    # Low voltage everywhere, so that no curve rests in its deadband.
    u = np.full(inputs, 0.09)
    x = rest(of.lure, u)
    honest = of.lure.C @ x + of.lure.D @ u
    quiet = kind.step(design, kind.init(design, x), honest, u, everyone(of), 900.0)
    for liar in range(p):
        for sign in (-1.0, 1.0):
            y = honest.copy()
            y[liar] += sign * 3.0 * bound[liar]
            state = kind.step(design, kind.init(design, x), y, u, everyone(of), 900.0)
            residual = np.abs(y - kind.outputs(design, state, u))
            assert residual[liar] > bound[liar]
            moved = float(kind.norm(design, state.x - quiet.x))
            if design.sensitivity[liar] > 1e-2:
                assert moved > 1e-3 * design.sensitivity[liar] * float(kind.norm(design, x))
            if not design.trusted[liar]:
                assert moved == 0.0
    assert np.any(design.sensitivity > 1e-2), "a family member must listen to somebody"


@pytest.mark.parametrize("trusted", TRUSTED)
@pytest.mark.parametrize(("family", "where"), EVERY)
def test_a_masked_meter_has_exactly_no_influence(family: str, where: str, trusted: str) -> None:
    of, kind, design = STREETS[where], FAMILIES[family], member(family, where, trusted)
    n, p, inputs = len(of.lure.A), len(of.meters), of.lure.F.shape[1]
    rng = np.random.default_rng(1)
    y, u = rng.uniform(-0.1, 0.1, p), rng.uniform(-0.1, 0.1, inputs)
    start = kind.init(design, rng.uniform(-0.05, 0.05, n))
    for silent in range(p):
        seen = everyone(of)
        seen[silent] = False
        for h in (0.5, 900.0):
            base = kind.step(design, start, y, u, seen, h)
            assert np.isfinite(base.x).all()
            for value in (np.nan, np.inf, 0.0, -7.0, 1e300):
                other = y.copy()
                other[silent] = value
                np.testing.assert_array_equal(kind.step(design, start, other, u, seen, h).x, base.x)


@pytest.mark.parametrize(("family", "where"), EVERY)
def test_long_steps_end_where_short_ones_lead(family: str, where: str) -> None:
    of, kind, design = STREETS[where], FAMILIES[family], member(family, where, "few")
    rng = np.random.default_rng(2)
    y, u = rng.uniform(-0.1, 0.1, len(of.meters)), rng.uniform(-0.1, 0.1, of.lure.F.shape[1])
    start = kind.init(design, np.zeros(len(of.lure.A)))
    short = start
    for _ in range(100):
        short = kind.step(design, short, y, u, everyone(of), 1.0)
    for h in (300.0, 900.0, 86_400.0):
        long = kind.step(design, start, y, u, everyone(of), h)
        np.testing.assert_allclose(long.x, short.x, atol=1e-8)


@pytest.mark.parametrize(("family", "where"), [(f, w) for f, w in EVERY if FAMILIES[f].batch is not None])
def test_many_at_once_are_the_same_as_one_by_one(family: str, where: str) -> None:
    """A bank of chong2020 with M = 1: steps of several lengths, meters that fall silent and return."""
    of, kind = STREETS[where], FAMILIES[family]
    assert kind.batch is not None
    gains, designs = kind.batch(of)
    # One integrator treats L inside, the other outside of the exponential: fine substeps make them meet.
    fine = StepPolicy(substep=0.02, settled=1e-6, tol=1e-12, max_iter=60)
    many = bank.design(of.lure, 1, gains=gains, policy=fine)
    n, p, inputs = len(of.lure.A), len(of.meters), of.lure.F.shape[1]
    rng = np.random.default_rng(3)
    y, u, seen = rng.uniform(-0.1, 0.1, p), rng.uniform(-0.1, 0.1, inputs), everyone(of)
    together = bank.init(many, y, u, seen)
    singles = [kind.init(d, bank.estimate(many, together, i)) for i, d in enumerate(designs)]
    for h, silent in ((0.5, ()), (2.0, (1,)), (0.5, (1, 3)), (900.0, ()), (1.0, (0,))):
        seen = everyone(of)
        seen[list(silent)] = False
        y, u = y + rng.uniform(-0.02, 0.02, p), u + rng.uniform(-0.02, 0.02, inputs)
        together = bank.step(many, together, y, u, seen, h)
        for index, design in enumerate(designs):
            singles[index] = kind.step(design, singles[index], y, u, seen, h, fine)
            found = bank.estimate(many, together, index)
            assert found.shape == (n,)
            np.testing.assert_allclose(found, singles[index].x, atol=1e-5 * np.abs(singles[index].x).max())
