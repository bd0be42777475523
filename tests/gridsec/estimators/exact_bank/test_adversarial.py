"""What the worst case can do: errors at corners of their bounds, absurd numbers in frames, odd plants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.estimators import exact_bank
from gridsec.grid.devices import Droop, fleet
from gridsec.interface import Cause, Decision
from gridsec.observers.certificates import error_bound, reactance
from gridsec.observers.lure import Lure, close_loop
from tests.gridsec.street import Street, make_plant, random_tree


def strong_loop(rng: np.random.Generator, gain: float) -> Lure:
    """A tree with one inverter at each of three customers, loop gain rho(D S) as asked for."""
    feeder = random_tree(3, rng, drop=0.05)
    count = np.arange(3)
    droop = fleet(count, "ieee1547-b", rng.uniform(3.0, 10.0, 3), 100.0, tau=np.full(3, 2.0))
    loop = close_loop(feeder, droop, count)
    scale = gain / np.max(np.abs(np.linalg.eigvals(loop.slope[:, None] * loop.H)))
    stronger = Droop(droop.customer, droop.v, droop.q * scale, droop.tau)
    return close_loop(feeder, stronger, count)


def farthest(
    loop: Lure, trusted: np.ndarray, box: np.ndarray, noise: float, *, rng: np.random.Generator
) -> float:
    """How far errors that start in corners of the box leave it, under slopes and signs chosen to hurt."""
    count, S = box.size, -loop.H
    span = loop.phi.q[:, 0] - loop.phi.q[:, 3]
    e = box * rng.choice([-1.0, 1.0], (200, count))
    slope = loop.slope * rng.choice([0.0, 1.0], (200, count))
    h = 0.3 / (1.0 + np.max(np.abs(np.linalg.eigvals(loop.slope[:, None] * S))))
    worst = 0.0
    for _ in range(400):
        drop = -e @ S.T
        seen = np.where(trusted, noise, drop + np.copysign(noise, drop))
        # A convex combination of the error and what drives it: exact for this time step, never overshooting.
        e = (1.0 - h) * e + h * np.clip(slope * seen, -span, span)
        worst = max(worst, float(np.max(np.abs(e) / box)))
    return worst


def test_a_box_from_saturation_is_never_left_and_one_from_an_ellipsoid_can_be() -> None:
    rng = np.random.default_rng(0)
    left = 0.0
    for _ in range(20):
        loop = strong_loop(rng, 30.0)
        proof, none = reactance(loop), np.zeros(3, dtype=bool)
        error = np.full(3, 1e-4)
        closed = error_bound(loop, none, error, error)
        assert farthest(loop, none, closed, 1e-4, rng=rng) <= 1.0 + 1e-12
        tight = error_bound(loop, none, error, error, certificate=proof)
        assert np.all(tight <= closed)
        if np.any(tight < 0.99 * closed):
            left = max(left, farthest(loop, none, tight, 1e-4, rng=rng))
    assert left > 1.2


NUMBERS = np.array([0.0, -1.0, 1e3, -1e3, 1e10, 1e100, -1e100, 1e200, 1e300, 5e-324])


@pytest.mark.canary("y", "q_error", "v0_squared")
@pytest.mark.parametrize("field", ["y", "p", "q", "p_error", "q_error", "q_net", "q_net_error", "v0_squared"])
def test_absurd_numbers_give_finite_answers_and_are_forgotten(field: str) -> None:
    rng = np.random.default_rng(7)
    street = Street(make_plant(rng), rng, metered_q=np.arange(0, 9, 2))
    design = exact_bank.design(street.plant, max_attacked=2, step_s=1.0)
    state = exact_bank.init(design, street.t)
    for tick in range(60):
        street.advance(1.0)
        frame = street.frame()
        if tick < 30:
            if field == "v0_squared":
                value = float(rng.choice([*NUMBERS, np.inf, np.nan, 0.25, 2.25]))
            else:
                value = getattr(frame, field).copy()
                hit = rng.random(value.shape) < 0.3
                value[hit] = rng.choice(NUMBERS, np.count_nonzero(hit))
                value = np.abs(value) if field.endswith("error") else value
            frame = replace(frame, **{field: value})
        state, estimate, verdict = exact_bank.step(design, state, frame)
        for out in (
            estimate.v2,
            estimate.bound,
            estimate.v2_bus,
            estimate.x,
            verdict.threshold,
            verdict.attack,
        ):
            assert np.all(np.isfinite(out))
    assert verdict.decision is Decision.CLEAN


@pytest.mark.parametrize(
    ("inverters", "meters", "attacked"),
    [
        (np.zeros(0, dtype=np.intp), np.arange(9), 2),
        (np.zeros(0, dtype=np.intp), np.arange(1), 0),
        (np.arange(9), np.array([4]), 0),
        (np.array([2, 2, 2, 5]), np.arange(9), 4),
        (np.array([2, 2, 5, 8]), np.array([0, 1, 3]), 1),
    ],
    ids=["no inverter", "nothing but a meter", "one meter", "p = 2M + 1", "no meter at an inverter"],
)
def test_odd_plants_are_watched_within_their_bounds(
    inverters: np.ndarray, meters: np.ndarray, attacked: int
) -> None:
    rng = np.random.default_rng(11)
    street = Street(make_plant(rng, inverters=inverters, meters=meters), rng, extreme=True)
    design = exact_bank.design(street.plant, max_attacked=attacked, step_s=1.0)
    state = exact_bank.init(design, street.t)
    for _ in range(60):
        street.advance(1.0)
        state, estimate, verdict = exact_bank.step(design, state, street.frame())
        true = street.voltages()[street.plant.feeder.bus] ** 2
        assert np.all(np.abs(estimate.v2 - true) <= estimate.bound)
        assert not verdict.suspects.any()
    assert verdict.decision is Decision.CLEAN
    every = tuple(range(meters.size))
    street.advance(1.0)
    _, _, verdict = exact_bank.step(design, state, street.frame(silent=every))
    assert verdict.cause is Cause.TOO_FEW_METERS
