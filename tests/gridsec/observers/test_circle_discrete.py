"""Discrete-time observers: proofs recomputed, error bounds against brute force, sampled feeders."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers import circle_discrete as observers
from gridsec.observers.lmi.discrete import (
    DiscreteGains,
    discrete_circle,
    discrete_contraction,
    discrete_margin,
    discrete_matrix,
    discrete_options,
    discrete_prove,
    input_error,
    noise_gain,
)
from gridsec.observers.lmi.sampled import advance, drift_error, held_error, measure, sample, shift
from gridsec.observers.lure import Lure, equilibrium
from gridsec.observers.lure import advance as continuous
from gridsec.papers import yang2019
from tests.codes import refused
from tests.gridsec.observers.discrete_lures import EVERY, gains_of, mask, options, sine
from tests.gridsec.plants import line


@pytest.fixture(scope="module")
def made() -> dict[tuple[int, ...], DiscreteGains]:
    return {J: gains_of(J) for J in EVERY}


class TestProof:
    def test_an_observer_exists_for_every_set(self, made: dict[tuple[int, ...], DiscreteGains]) -> None:
        """Example 1 of yang2019. Oracle: V+ against decay^2 V + mu |n|^2, from the equations."""
        rng = np.random.default_rng(0)
        plant = sine()
        for J, gains in made.items():
            assert gains.margin > 0.0
            e, n = rng.standard_normal((2, 4000, max(2, len(J))))
            e, n = e[:, :2], n[:, : len(J)] * rng.choice([0.1, 1.0, 10.0], (4000, 1))
            C = plant.C[list(J)]
            r = e @ C.T + n
            # Any slope in [-1, 1] between the two arguments.
            eta = e @ plant.H.T - r @ gains.K.T
            slope = rng.choice([-1.0, 1.0, 0.3], eta.shape)
            ahead = e @ plant.A.T + (slope * eta) @ plant.G.T - r @ gains.L.T
            V, W = (np.einsum("ri,ij,rj->r", v, gains.P, v) for v in (e, ahead))
            allowed = gains.decay**2 * V + gains.mu * (n**2).sum(axis=1)
            assert np.all(allowed * (1.0 + 1e-9) >= W)

    def test_the_matrix_is_the_dissipation_inequality(
        self, made: dict[tuple[int, ...], DiscreteGains]
    ) -> None:
        """The quadratic form of `discrete_matrix` from the difference equation, term by term."""
        rng = np.random.default_rng(1)
        plant, J = sine(), (1, 3)
        unknown = input_error(plant, np.array([0.3]), held=np.array([0.2]))
        gains = replace(made[J], unknown=unknown, mu_delta=0.7)
        M = discrete_matrix(plant, J, gains)
        for _ in range(20):
            e, psi, n, delta = (rng.standard_normal(k) for k in (2, 1, 2, 2))
            C, E_y = plant.C[list(J)], unknown.output[list(J)]
            r = C @ e + n + E_y @ delta
            eta = plant.H @ e + unknown.argument @ delta - gains.K @ r
            # psi belongs to the shifted nonlinearity phi + z, of slopes in [0, 2].
            ahead = plant.A @ e + plant.G @ (psi - eta) + unknown.state @ delta - gains.L @ r
            form = ahead @ gains.P @ ahead - gains.decay**2 * e @ gains.P @ e
            form += 2.0 * psi @ (gains.Lambda * (eta - psi / 2.0)) - gains.mu * n @ n - 0.7 * delta @ delta
            v = np.concatenate([e, psi, n, delta])
            assert v @ M @ v == pytest.approx(form, rel=1e-9, abs=1e-12)

    def test_the_margin_needs_every_sign(self, made: dict[tuple[int, ...], DiscreteGains]) -> None:
        J = (0, 1, 2)
        good = made[J]
        assert discrete_margin(sine(), J, good) == good.margin
        for bad in (
            replace(good, mu=0.0),
            replace(good, Lambda=-good.Lambda),
            replace(good, decay=1.0),
            replace(good, P=-good.P),
            replace(good, mu=0.5 * good.mu),
            replace(good, L=2.0 * good.L),
        ):
            assert not discrete_margin(sine(), J, bad) > 0.0
        with refused(InputInvalid, "wrong-design"):
            discrete_matrix(sine(), [3], good)

    def test_the_loop_transform_changes_no_trajectory(self) -> None:
        rng = np.random.default_rng(2)
        plant = sine(F=np.array([[0.4]]))
        moved = shift(plant)
        assert np.array_equal(moved.lower, [0.0])
        assert np.array_equal(moved.upper, [2.0])
        x, u = rng.standard_normal((50, 2)), rng.standard_normal((50, 1))
        np.testing.assert_allclose(advance(moved, x, u), advance(plant, x, u), atol=1e-14)
        z = np.linspace(-9.0, 9.0, 2001)
        slopes = np.diff(moved.phi(z)) / np.diff(z)
        assert slopes.min() >= 0.0
        assert slopes.max() <= 2.0

    def test_without_the_transform_a_sine_is_outside_its_sector(self) -> None:
        """A design for slopes in [0, 1] proves nothing about a sine, and the margin finds it out."""
        wrong = sine(lower=np.zeros(1))
        gains = discrete_circle(wrong, (0,), discrete_options(wrong, decays=0.85, noise=1.0))
        assert gains.margin > 0.0
        assert not discrete_margin(sine(), (0,), gains) > 0.0

    @settings(max_examples=8, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_gains_and_proof_in_other_units(self, seed: int) -> None:
        """Scaling states and outputs scales the gains and leaves decay and feasibility alone."""
        rng = np.random.default_rng(seed)
        s, c = 10.0 ** rng.uniform(-3.0, 3.0, 2), 10.0 ** rng.uniform(-3.0, 3.0)
        plant = sine()
        other = replace(
            plant,
            A=plant.A * s / s[:, None],
            G=plant.G / s[:, None],
            H=plant.H * s,
            B=plant.B / s[:, None],
            C=c * plant.C * s,
        )
        J = (0, 1, 3)
        at = discrete_options(plant, decays=0.8, noise=1.0)
        there = discrete_options(other, decays=0.8, noise=c, weight=np.diag(s**2))
        first, second = discrete_circle(plant, J, at), discrete_circle(other, J, there)
        assert second.margin > 0.0
        assert second.mu == pytest.approx(first.mu, rel=2e-3)

    def test_given_gains_are_proven_as_they_are(self, made: dict[tuple[int, ...], DiscreteGains]) -> None:
        J = (0, 3)
        again = discrete_prove(sine(), J, made[J].L, made[J].K, options(made[J].decay))
        assert again.margin > 0.0
        assert np.array_equal(again.L, made[J].L)
        assert noise_gain(again) <= noise_gain(made[J]) * (1.0 + 1e-4)
        with refused(DesignInfeasible, "no-solution"):
            discrete_prove(sine(), J, 0.0 * made[J].L, 0.0 * made[J].K, options(0.9))

    def test_a_linear_plant_has_the_gain_of_its_closed_form(self) -> None:
        """x+ = x/2 with the deadbeat gain 1/(2k): |e| = |sum n| / (2k), gamma = 1/(2 sqrt k)."""
        bank = yang2019.deadbeat_bank()
        for one in bank:
            k = int(one.trusted.sum())
            assert one.noise_gain == pytest.approx(0.5 / np.sqrt(k), rel=1e-3)

    def test_a_linear_plant_that_settles_by_itself_needs_no_sensor_and_is_refused(self) -> None:
        plant = yang2019.deadbeat_bank()[0].system
        with refused(DesignInfeasible, "degenerate"):
            discrete_circle(plant, (0, 1), discrete_options(plant, decays=(0.6, 0.8), noise=1.0))

    def test_refusals(self) -> None:
        with refused(DesignInfeasible, "nothing-to-design"):
            discrete_circle(sine(), (), options())
        with refused(DesignInfeasible, "no-solution"):
            discrete_circle(sine(), (3,), options(0.5))
        with refused(InputInvalid, "out-of-range"):
            options(1.0)
        with refused(InputInvalid, "not-positive"):
            discrete_options(sine(), decays=0.5, noise=0.0)
        with refused(InputInvalid, "not-definite"):
            discrete_options(sine(), decays=0.5, noise=1.0, weight=np.zeros((2, 2)))
        with refused(DesignInfeasible, "wrong-form"):
            discrete_contraction(sine(lower=np.full(1, 0.1)), decays=0.9)
        with refused(DesignInfeasible, "no-solution"):
            discrete_contraction(sine(), decays=0.9)


class TestPlant:
    def test_shapes_and_slopes_are_checked(self) -> None:
        with refused(InputInvalid, "shape"):
            sine(G=np.zeros((3, 1)))
        with refused(InputInvalid, "order"):
            sine(lower=np.full(1, 2.0))
        with refused(InputInvalid, "not-finite"):
            sine(A=np.full((2, 2), np.nan))
        with refused(InputInvalid, "not-positive"):
            sine(h=0.0)

    @pytest.mark.parametrize("dense", [False, True])
    def test_sampling_is_exact_where_the_argument_rests(self, dense: bool) -> None:
        """H = 0: phi(F u) is constant over the step. Oracle: the matrix exponential."""
        rng = np.random.default_rng(3)
        A = rng.standard_normal((3, 3)) - 3.0 * np.eye(3) if dense else -np.diag([0.4, 1.0, 2.0])
        lure = Lure(
            A=A,
            G=rng.standard_normal((3, 2)),
            H=np.zeros((2, 3)),
            F=rng.standard_normal((2, 2)),
            B=rng.standard_normal((3, 2)),
            C=np.eye(3),
            D=np.zeros((3, 2)),
            slope=np.ones(2),
            phi=np.tanh,
        )
        plant, x, u = sample(lure, 0.7), rng.standard_normal(3), rng.standard_normal(2)
        push = lure.G @ np.tanh(lure.F @ u) + lure.B @ u
        expected = expm(0.7 * A) @ x + np.linalg.solve(A, (expm(0.7 * A) - np.eye(3)) @ push)
        np.testing.assert_allclose(advance(plant, x, u), expected, atol=1e-13)
        assert plant.h == 0.7

    @settings(max_examples=20, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1), h=st.sampled_from([0.1, 1.0, 3.0]))
    def test_what_sampling_leaves_out_is_an_argument_within_the_stated_range(
        self, seed: int, h: float
    ) -> None:
        """Lemma of docs/theory-discrete.md: the exact step is the sampled one at arguments off by <= held."""
        rng = np.random.default_rng(seed)
        lure = line(4, kva=60.0, seed=seed % 1000, tau=(1.5, 2.5)).lure
        plant = sample(lure, h)
        limit = np.abs(lure.phi(np.full(4, 9.0)))
        x, u = rng.uniform(-1.0, 1.0, 4) * limit, rng.uniform(-0.15, 0.15, 4)
        z0 = lure.H @ x + lure.F @ u
        held = held_error(lure, h, np.abs(lure.phi(z0) - x))
        assert np.isfinite(held).all()
        run = solve_ivp(
            lambda _, s: lure.A @ s + lure.G @ lure.phi(lure.H @ s + lure.F @ u),
            (0.0, h),
            x,
            rtol=1e-10,
            atol=1e-13,
            max_step=h / 50,
        )
        moved = np.abs(lure.H @ run.y + (lure.F @ u)[:, None] - z0[:, None]).max(axis=1)
        assert np.all(moved <= held * (1.0 + 1e-6) + 1e-12)
        # The exact end state lies between the sampled steps at both ends of that range.
        low, high = (plant.A @ x + plant.G @ lure.phi(z0 + side * held) for side in (-1.0, 1.0))
        assert np.all(run.y[:, -1] >= low - 1e-9)
        assert np.all(run.y[:, -1] <= high + 1e-9)

    def test_a_loop_that_follows_small_jumps_moves_little(self) -> None:
        lure = line(4, kva=60.0).lure
        rng = np.random.default_rng(5)
        bound = drift_error(lure, 1.0, np.full(4, 1e-3))
        u = np.full(4, 0.07)
        x = equilibrium(lure, u, tol=1e-13, max_iter=200)
        largest = np.zeros(4)
        for _ in range(300):
            # Mostly one direction, so that the inverters lag behind.
            u = np.clip(u + rng.uniform(-0.2e-3, 1e-3, 4) * (1 if u[0] < 0.12 else -1), 0.03, 0.13)
            z, ahead = lure.H @ x + lure.F @ u, continuous(lure, x, u, 1.0)
            largest = np.maximum(largest, np.abs(lure.H @ ahead + lure.F @ u - z))
            x = ahead
        assert np.all(largest <= bound)
        assert np.all(largest > 0.02 * bound)
        assert np.all(bound < held_error(lure, 1.0, np.full(4, 0.5)))

    def test_no_bound_beyond_loop_gain_one(self) -> None:
        lure = line(4, kva=60.0).lure
        steep = replace(lure, slope=1e3 * lure.slope)
        assert np.isinf(held_error(steep, 1.0, np.ones(4))).all()
        assert np.isinf(drift_error(steep, 1.0, np.ones(4))).all()


class TestObserver:
    def test_step_is_the_printed_equation(self) -> None:
        """yang2019 (4) with its own signs: K (C x_hat - y), L (C x_hat - y)."""
        rng = np.random.default_rng(6)
        d = observers.design(sine(), mask((0, 2)), options=options())
        L, K, C, plant = -d.L, -d.K, d.system.C, d.system
        x, y, u = rng.standard_normal(2), rng.standard_normal(4), rng.standard_normal(1)
        off = np.where(d.trusted, C @ x - y, 0.0)
        expected = plant.A @ x + plant.G @ np.sin(plant.H @ x + K @ off) + L @ off + plant.B @ u
        state = observers.step(d, observers.init(d, 3.0, x), y, u, np.ones(4, dtype=bool))
        np.testing.assert_allclose(state.x, expected, atol=1e-14)
        assert state.t == pytest.approx(3.1)

    def test_a_masked_or_silent_sensor_has_exactly_no_influence(self) -> None:
        d = observers.design(sine(), mask((0, 1, 2)), options=options())
        y, u, everyone = np.array([1.0, 2.0, 3.0, 4.0]), np.zeros(1), np.ones(4, dtype=bool)
        state = observers.init(d, 0.0)
        first = observers.step(d, state, y, u, everyone).x
        for value in (1e9, np.nan, -np.inf):
            assert np.array_equal(
                observers.step(d, state, np.array([1.0, 2.0, 3.0, value]), u, everyone).x, first
            )
        silent = observers.step(d, state, y, u, mask((0, 1, 3))).x
        unread = observers.step(d, state, np.array([1.0, 2.0, np.nan, 4.0]), u, everyone).x
        assert np.array_equal(silent, unread)
        assert not np.array_equal(silent, first)

    def test_a_stack_is_its_observers(self) -> None:
        rng = np.random.default_rng(7)
        bank = yang2019.bank()
        x, y, u = rng.standard_normal((3, 11, 2)), rng.standard_normal((3, 4)), np.array([0.2])
        seen = mask((0, 1, 3))
        many = observers.advance(observers.stack(bank), x, y, u, seen)
        for run, index in product(range(3), range(11)):
            one = observers.step(
                bank[index], observers.init(bank[index], 0.0, x[run, index]), y[run], u, seen
            )
            np.testing.assert_allclose(many[run, index], one.x, atol=1e-13)
        assert measure(sine(), x, u).shape == (3, 11, 4)
        assert np.array_equal(
            observers.outputs(bank[0], observers.init(bank[0], 0.0, x[0, 0]), u), sine().C @ x[0, 0]
        )
        with refused(InputInvalid, "wrong-design"):
            observers.stack([bank[0], yang2019.deadbeat_bank()[0]])

    @settings(max_examples=25, deadline=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        J=st.sampled_from(EVERY),
        kind=st.sampled_from(["random", "corner", "constant", "late"]),
    )
    def test_iss_bound(self, seed: int, J: tuple[int, ...], kind: str) -> None:
        """yang2019 (5) with the proven constants, for every set, whatever the noise."""
        rng = np.random.default_rng(seed)
        d = observers.design(sine(), mask(J), gains=gains_of(J))
        T, plant, everyone = 200, sine(), np.ones(4, dtype=bool)
        size = 10.0 ** rng.uniform(-2.0, 2.0)
        noise = rng.uniform(-size, size, (T, 4))
        if kind == "corner":
            noise = size * rng.choice([-1.0, 1.0], (T, 4))
        elif kind == "constant":
            noise = np.tile(noise[:1], (T, 1))
        elif kind == "late":
            noise[: T // 2] = 0.0
        x = 3.0 * rng.standard_normal(2)
        state = observers.init(d, 0.0, x + 10.0 ** rng.uniform(-3.0, 1.0) * rng.standard_normal(2))
        start, loudest = float(np.linalg.norm(state.x - x)), 0.0
        for k in range(T):
            bound = observers.error_bound(d, k, start=start, noise=loudest)
            assert np.linalg.norm(state.x - x) <= bound * (1.0 + 1e-9)
            u = rng.standard_normal(1)
            state = observers.step(d, state, measure(plant, x, u) + noise[k], u, everyone)
            x = advance(plant, x, u)
            loudest = max(loudest, float(np.linalg.norm(noise[k][d.trusted])))

    def test_attacks_are_visible(self) -> None:
        """Each trusted sensor's lie moves the estimate, and is not drowned by what it moves."""
        plant, everyone = sine(), np.ones(4, dtype=bool)
        for d in yang2019.bank():
            for sensor in np.flatnonzero(d.trusted):
                honest = lied = observers.init(d, 0.0)
                for _ in range(30):
                    honest = observers.step(d, honest, np.zeros(4), np.zeros(1), everyone)
                    lied = observers.step(d, lied, 5.0 * np.eye(4)[sensor], np.zeros(1), everyone)
                assert np.linalg.norm(plant.C[sensor] @ (lied.x - honest.x)) > 0.05

    def test_settling(self) -> None:
        d = yang2019.bank()[1]
        k = observers.settling_steps(d, start=10.0, epsilon=1e-3)
        assert d.growth * d.decay**k * 10.0 <= 1e-3 < d.growth * d.decay ** (k - 1) * 10.0
        assert observers.settling_steps(d, start=0.0, epsilon=0.0) == 0
        with refused(InputInvalid, "not-positive"):
            observers.settling_steps(d, start=1.0, epsilon=0.0)

    def test_wrong_calls(self) -> None:
        with refused(InputInvalid, "shape"):
            observers.design(sine(), np.ones(3, dtype=bool), options=options())
        with refused(InputInvalid, "missing"):
            observers.design(sine(), mask((0,)))
        with refused(InputInvalid, "wrong-design"):
            observers.design(sine(), mask((0, 1)), gains=gains_of((0, 2)))
        with refused(DesignInfeasible, "not-verified"):
            observers.design(sine(C=8.0 * sine().C), mask((0, 2)), gains=gains_of((0, 2)))
