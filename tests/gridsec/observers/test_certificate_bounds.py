"""What a certificate says of an observer: it decays at the rate, and errors stay below the bound."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.integrate import solve_ivp

from gridsec.grid.devices import Droop
from gridsec.observers.certificates import certify, error_bound, reactance, small_gain
from gridsec.observers.lure import Lure, settle
from tests.gridsec.certified import norm, seeds
from tests.gridsec.radial import random_loop


def observer_and_plant(
    lure: Lure, driven: np.ndarray, size: tuple[float, float], seed: int, e0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (k, n) of the nonlinear observer at times (k,), with switching sets and disturbances."""
    rng = np.random.default_rng([seed, 7])
    n, m = lure.slope.size, lure.F.shape[1]
    tau = -1.0 / np.diag(lure.A)
    x = rng.uniform(-1, 1, n) * (lure.phi.limit if isinstance(lure.phi, Droop) else 1.0)
    hat = x + e0 * rng.normal(size=n)
    times, errors, now = [0.0], [x - hat], 0.0
    for _ in range(8):
        w = rng.uniform(-0.2, 0.2, m)
        y_bad = size[0] * rng.choice([-1.0, 1.0], n)
        w_bad = size[1] * rng.choice([-1.0, 1.0], m)
        trusted = driven & (rng.random(n) < 0.5)
        h = float(10.0 ** rng.uniform(-1, 1))

        def slope(_: float, both: np.ndarray, w=w, y_bad=y_bad, w_bad=w_bad, trusted=trusted) -> np.ndarray:
            x, hat = both[:n], both[n:]
            z = lure.H @ x + lure.F @ w
            zeta = np.where(trusted, z + y_bad, lure.H @ hat + lure.F @ (w + w_bad))
            return np.concatenate([(lure.phi(z) - x) / tau, (lure.phi(zeta) - hat) / tau])

        run = solve_ivp(slope, (0.0, h), np.concatenate([x, hat]), method="LSODA", rtol=1e-8, atol=1e-11)
        assert run.success
        errors.extend((run.y[:n] - run.y[n:]).T)
        times.extend(now + run.t)
        x, hat, now = run.y[:n, -1], run.y[n:, -1], now + h
    return np.array(times), np.array(errors)


@settings(max_examples=25)
@given(seed=seeds, gain=st.sampled_from([0.3, 0.8, 3.0]), spread=st.sampled_from([1.0, 3.0]))
def test_nonlinear_observer_decays_at_the_certified_rate(seed: int, gain: float, spread: float) -> None:
    _, _, lure = random_loop(seed, gain=gain, spread=spread)
    certificate = certify(lure)
    t, e = observer_and_plant(lure, np.ones(lure.slope.size, bool), (0.0, 0.0), seed, e0=0.02)
    size = norm(certificate, e)
    assert np.all(size <= size[0] * np.exp(-certificate.rate * t) + 1e-7 * (1 + size[0]))


@settings(max_examples=25)
@given(
    seed=seeds,
    gain=st.sampled_from([0.3, 0.8, 3.0]),
    kind=st.sampled_from(["reactance", "small-gain"]),
    sizes=st.sampled_from([(0.004, 0.0), (0.0, 0.004), (100.0, 0.0)]),
)
def test_gains_bound_the_error(seed: int, gain: float, kind: str, sizes: tuple[float, float]) -> None:
    if kind == "small-gain":
        gain = min(gain, 0.8)
    _, _, lure = random_loop(seed, gain=gain)
    certificate = reactance(lure) if kind == "reactance" else small_gain(lure)
    _, e = observer_and_plant(lure, np.ones(lure.slope.size, bool), sizes, seed, e0=0.0)
    # From rest the level is never exceeded: W' <= -rate W + rate level.
    if sizes[0] == 100.0:
        allowed = certificate.saturation
        assert allowed < certificate.attack * 100.0
    else:
        allowed = certificate.noise * sizes[0] + certificate.load * sizes[1]
    assert np.all(norm(certificate, e) <= allowed * (1 + 1e-6) + 1e-9)


@pytest.mark.acceptance
@settings(max_examples=40)
@given(
    seed=seeds,
    gain=st.sampled_from([0.3, 0.9, 3.0]),
    sizes=st.sampled_from([(0.004, 0.0), (0.0, 0.004), (0.002, 0.003), (100.0, 0.002)]),
    proof=st.booleans(),
)
def test_error_bound_is_never_exceeded(
    seed: int, gain: float, sizes: tuple[float, float], proof: bool
) -> None:
    # The trusted set is fixed in each example (the bound is for one set); the meters outside it may say
    # anything, the load error is at its bound everywhere.
    _, droop, lure = random_loop(seed, gain=gain, spread=2.0)
    n, m = lure.slope.size, lure.F.shape[1]
    rng = np.random.default_rng([seed, 8])
    trusted = rng.random(n) < 0.5
    bound = error_bound(
        lure,
        trusted,
        np.full(n, sizes[0]),
        np.full(m, sizes[1]),
        certificate=certify(lure) if proof else None,
    )
    assert np.all(bound <= 2.0 * droop.limit + 1e-15)
    x = hat = np.zeros(n)
    tau = droop.tau
    for _ in range(150):
        w = rng.uniform(-0.2, 0.2, m)
        y_bad, w_bad = sizes[0] * rng.choice([-1.0, 1.0], n), sizes[1] * rng.choice([-1.0, 1.0], m)
        h = float(rng.choice([0.02, 0.5, 5.0]))
        for _ in range(1 if h < 0.1 else 20):
            z = lure.H @ x + lure.F @ w
            zeta = np.where(trusted, z + y_bad, lure.H @ hat + lure.F @ (w + w_bad))
            # Any convex combination of the state and the curve is a step of the differential inclusion.
            share = 1.0 - np.exp(-min(h, 0.1) / tau)
            x, hat = x + share * (droop(z) - x), hat + share * (droop(zeta) - hat)
            assert np.all(np.abs(x - hat) <= bound * (1 + 1e-9) + 1e-12)


@settings(max_examples=60)
@given(seed=seeds, gain=st.sampled_from([0.3, 0.9, 3.0]), size=st.sampled_from([0.002, 0.02, 10.0]))
def test_local_error_bound_at_rest(seed: int, gain: float, size: float) -> None:
    _, droop, lure = random_loop(seed, gain=gain)
    n, m = lure.slope.size, lure.F.shape[1]
    rng = np.random.default_rng([seed, 8])
    trusted = rng.random(n) < 0.5
    w = rng.uniform(-0.2, 0.2, m)
    none = np.zeros(n)
    rest = {"drive": lure.F @ w, "bias": none, "x0": none, "tol": 1e-10, "max_iter": 100}
    x = settle(droop, np.eye(n), lure.H, **rest)
    z = lure.H @ x + lure.F @ w
    y_bad, w_bad = rng.uniform(-size, size, n), rng.uniform(-0.003, 0.003, m)
    heard = np.where(trusted, z + y_bad, lure.F @ (w + w_bad))
    hat = settle(droop, np.eye(n), np.where(trusted[:, None], 0.0, lure.H), **(rest | {"drive": heard}))
    zeta = np.where(trusted, z + y_bad, lure.H @ hat + lure.F @ (w + w_bad))
    everywhere = error_bound(lure, trusted, np.full(n, size), np.full(m, 0.003))
    local = error_bound(lure, trusted, np.full(n, size), np.full(m, 0.003), z=zeta)
    assert np.all(np.abs(x - hat) <= local * (1 + 1e-9) + 1e-9)
    assert np.all(local <= everywhere * (1 + 1e-3) + 1e-12)


def test_local_bound_is_zero_inside_the_deadband() -> None:
    _, _, lure = random_loop(8, gain=3.0)
    n = lure.slope.size
    off = np.zeros(n, bool)
    small = np.full(n, 0.003)
    assert np.all(error_bound(lure, off, small, small, z=np.zeros(n)) < 1e-300)
    assert np.all(error_bound(lure, off, small, small)[lure.slope > 0] > 1e-3)


def test_error_bounds_in_batches() -> None:
    _, _, lure = random_loop(8, gain=0.9)
    n, m = lure.slope.size, lure.F.shape[1]
    rng = np.random.default_rng(0)
    trusted, y, u = (
        rng.random((2, 3, n)) < 0.5,
        rng.uniform(0, 0.01, (2, 3, n)),
        rng.uniform(0, 0.01, (2, 3, m)),
    )
    proof = reactance(lure)
    together = error_bound(lure, trusted, y, u, certificate=proof)
    for i, j in np.ndindex(2, 3):
        alone = error_bound(lure, trusted[i, j], y[i, j], u[i, j], certificate=proof)
        assert np.allclose(together[i, j], alone, rtol=1e-3)


def test_unbounded_attacks_are_capped_by_saturation() -> None:
    _, droop, lure = random_loop(8, gain=0.9)
    n = lure.slope.size
    on = np.ones(n, bool)
    bound = error_bound(lure, on, np.full(n, np.inf), np.zeros(n), certificate=reactance(lure))
    assert np.all(bound <= 2.0 * droop.limit)
    assert np.all(bound[droop.slope > 0] > 0)
    # One meter attacked without bound, all trusted: the others stay exact.
    only = np.where(np.arange(n) == 0, np.inf, 0.0)
    assert not error_bound(lure, on, only, np.zeros(n))[1:].any()


def test_unsaturated_curves_have_unbounded_attacks() -> None:
    eye = np.eye(2)
    lure = Lure(-eye, eye, np.diag([-0.5, 0.0]), eye, 0 * eye, np.diag([-0.5, 0.0]), eye, np.ones(2), np.tanh)
    y = np.array([np.inf, 0.0])
    bound = error_bound(lure, np.array([True, False]), y, np.zeros(2))
    assert bound.tolist() == [np.inf, 0.0]
    assert reactance(lure).saturation == small_gain(lure).saturation == np.inf
