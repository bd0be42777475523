"""Discrete-time circle-criterion observers on a feeder, and gains found by simulation."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.model.site import load as load_site
from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers import circle_discrete as observers
from gridsec.observers.lmi.discrete import (
    discrete_circle,
    discrete_contraction,
    discrete_options,
    growth,
    input_error,
)
from gridsec.observers.lmi.sampled import DiscreteLure, advance, held_error, measure, sample
from gridsec.observers.lure import Lure, close_loop
from gridsec.observers.lure import advance as continuous
from gridsec.papers import yang2019
from tests.codes import refused
from tests.gridsec.observers.discrete_lures import gains_of, mask, sine


class TestMonteCarlo:
    @pytest.mark.acceptance
    def test_never_above_the_proven_gain_and_worth_what_it_says(self) -> None:
        bank = yang2019.bank()
        found = yang2019.simulated_gains(bank, runs=60, seed=1)
        proven = np.array([one.noise_gain for one in bank])
        assert np.all(found.gains <= proven)
        assert np.all(found.gains > 0.2 * proven)
        assert found.exceedance == pytest.approx(1.0 - 0.01 ** (1.0 / 60.0))
        assert (1.0 - found.exceedance) ** found.runs == pytest.approx(1.0 - found.confidence)
        # Of 12 fresh runs each exceeds with at most 0.074: 7 or more has a probability of 1e-5.
        fresh = np.array([yang2019.simulated_gains(bank, runs=1, seed=100 + i).gains for i in range(12)])
        assert np.all((fresh > found.gains).sum(axis=0) <= 6)

    def test_against_a_plain_loop(self) -> None:
        bank = yang2019.bank()[:2]
        start, u = np.array([[0.3, -0.2], [1.0, 2.0]]), np.full((40, 1), 0.1)
        found = observers.monte_carlo(observers.stack(bank), half_width=0.5, start=start, u=u, seed=9)
        rng, x, worst = np.random.default_rng(9), start.copy(), np.zeros(2)
        hats, loudest = [[row.copy() for row in start] for _ in bank], np.zeros((2, 2))
        for _ in range(40):
            n = rng.uniform(-0.5, 0.5, (2, 4))
            for o, run in product(range(2), range(2)):
                d = bank[o]
                y = d.system.C @ x[run] + n[run]
                r = np.where(d.trusted, y - d.system.C @ hats[o][run], 0.0)
                zeta = hats[o][run].sum() + d.K @ r
                hats[o][run] = d.system.A @ hats[o][run] + d.system.G @ np.sin(zeta) + d.L @ r + 0.01
                loudest[o, run] = max(loudest[o, run], np.linalg.norm(n[run][d.trusted]))
            x = np.stack([advance(bank[0].system, row, u[0]) for row in x])
            for o, run in product(range(2), range(2)):
                worst[o] = max(worst[o], np.linalg.norm(hats[o][run] - x[run]) / loudest[o, run])
        np.testing.assert_allclose(found.gains, worst, rtol=1e-10)

    def test_a_simulated_gain_is_no_bound(self) -> None:
        """Erratum: constant noise within the same bound makes errors above (5) with the simulated gain."""
        bank = yang2019.bank()
        found = yang2019.simulated_gains(bank, runs=200, seed=2)
        plant, everyone, above = sine(), np.ones(4, dtype=bool), np.zeros(len(bank))
        all_of_them = observers.stack(bank)
        for corner in product([-0.5, 0.5], repeat=4):
            truth, x = np.zeros(2), np.zeros((len(bank), 2))
            for _ in range(150):
                x = observers.advance(
                    all_of_them, x, measure(plant, truth, np.zeros(1)) + corner, np.zeros(1), everyone
                )
                truth = advance(plant, truth, np.zeros(1))
                size = np.linalg.norm(np.asarray(corner) * all_of_them.masks, axis=1)
                above = np.maximum(above, np.linalg.norm(x - truth, axis=1) / size / found.gains)
        assert above.max() > 1.2
        assert np.all(above * found.gains <= [one.noise_gain for one in bank])

    def test_wrong_calls(self) -> None:
        stack = observers.stack(yang2019.bank())
        with refused(InputInvalid, "out-of-range"):
            observers.monte_carlo(stack, half_width=0.5, start=np.zeros((0, 2)), u=np.zeros((1, 1)), seed=0)
        for width, code in (
            (0.0, "not-positive"),
            (np.nan, "negative"),
            (-1.0, "negative"),
            (np.array([1.0, 0.0, 0.0, 0.0]), "not-positive"),
        ):
            with refused(InputInvalid, "out-of-range", code):
                observers.monte_carlo(
                    stack, half_width=width, start=np.zeros((0, 2)), u=np.zeros((1, 1)), seed=0
                )


@pytest.fixture(scope="module")
def village() -> tuple[Lure, DiscreteLure, np.ndarray]:
    """Kerber's Landnetz with its seven inverters' own meters, read once a second."""
    site = load_site("kerber-landnetz")
    meters = site.meters[np.isin(site.meters, site.droop.customer)]
    lure = close_loop(site.feeder, site.droop, meters)
    return lure, sample(lure, 1.0), site.droop.limit


class TestFeeder:
    @settings(max_examples=10, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_one_proof_for_direct_injection_and_every_set(
        self, village: tuple[Lure, DiscreteLure, np.ndarray], seed: int
    ) -> None:
        """Errors stay within (5) for a random set, random noise, on the true continuous feeder."""
        lure, plant, limit = village
        rng = np.random.default_rng(seed)
        p = len(plant.C)
        d = observers.design(plant, rng.random(p) < 0.6, gains=_proof(plant))
        assert np.array_equal(d.K @ plant.C, np.where(d.K.any(axis=1)[:, None], plant.H, 0.0))
        held = float(np.linalg.norm(held_error(lure, 1.0, 2.0 * limit)))
        x, everyone = rng.uniform(-1.0, 1.0, p) * limit, np.ones(p, dtype=bool)
        state = observers.init(d, 0.0, rng.uniform(-1.0, 1.0, p) * limit)
        start, loudest, later = float(np.linalg.norm(state.x - x)), 0.0, 0.0
        for k in range(80):
            bound = observers.error_bound(d, k, start=start, noise=loudest, unknown=held)
            assert np.linalg.norm(state.x - x) <= bound
            later = max(later, float(np.linalg.norm(state.x - x))) if k > 40 else 0.0
            u = np.full(lure.F.shape[1], 0.09) + rng.uniform(-0.03, 0.03, lure.F.shape[1])
            n = rng.uniform(-2e-3, 2e-3, p)
            loudest = max(loudest, float(np.linalg.norm(n[d.trusted])))
            state = observers.step(d, state, lure.C @ x + lure.D @ u + n, u, everyone)
            x = continuous(lure, x, u, 1.0)
        assert later < start

    def test_gains_by_inequality_against_load_errors(
        self, village: tuple[Lure, DiscreteLure, np.ndarray]
    ) -> None:
        lure, plant, _ = village
        unknown = input_error(plant, np.full(lure.F.shape[1], 2e-3))
        weight = lure.H.T @ lure.H + 1e-6 * np.eye(7)
        want = discrete_options(plant, decays=0.8, noise=2e-4, unknown=unknown, weight=weight)
        J = (0, 2, 3, 6)
        d = observers.design(plant, mask(J, 7), options=want)
        # Precise meters: the optimum is close to direct injection, as in continuous time.
        np.testing.assert_allclose(d.K[np.ix_(J, J)], np.eye(4), atol=0.1)
        rng, x = np.random.default_rng(0), np.zeros(7)
        state, worst = observers.init(d, 0.0, x), 0.0
        for _ in range(200):
            u = np.full(lure.F.shape[1], 0.1) + rng.uniform(-0.02, 0.02)
            delta, n = rng.uniform(-1.0, 1.0, lure.F.shape[1]), rng.uniform(-2e-4, 2e-4, 7)
            truth_input = u + 2e-3 * delta
            y = measure(plant, x, truth_input) + n
            state = observers.step(d, state, y, u, np.ones(7, dtype=bool))
            x = advance(plant, x, truth_input)
            worst = max(worst, float(np.linalg.norm(state.x - x)))
        bound = observers.error_bound(
            d, 0, start=0.0, noise=2e-4 * 2.0, unknown=float(np.sqrt(lure.F.shape[1]))
        )
        assert worst <= bound
        assert worst > 0.0

    def test_noise_alone_is_refused_as_blind(self, village: tuple[Lure, DiscreteLure, np.ndarray]) -> None:
        _, plant, _ = village
        with refused(DesignInfeasible, "degenerate"):
            discrete_circle(plant, (0, 1, 2), discrete_options(plant, decays=0.8, noise=1e-3))

    def test_a_proof_of_another_plant_is_refused(
        self, village: tuple[Lure, DiscreteLure, np.ndarray]
    ) -> None:
        _, plant, _ = village
        steep = replace(plant, upper=200.0 * plant.upper)
        with refused(DesignInfeasible, "not-verified"):
            observers.design(steep, np.ones(7, dtype=bool), gains=_proof(plant))

    def test_growth_is_one_for_a_round_certificate(
        self, village: tuple[Lure, DiscreteLure, np.ndarray]
    ) -> None:
        _, plant, _ = village
        assert observers.design(plant, np.zeros(7, dtype=bool), gains=_proof(plant)).noise_gain == 0.0
        assert growth(replace(gains_of((0,)), P=np.eye(2))) == 1.0


def _proof(plant: DiscreteLure) -> object:
    if id(plant) not in PROOFS:
        PROOFS[id(plant)] = discrete_contraction(plant, decays=(0.65, 0.7, 0.8))
    return PROOFS[id(plant)]


PROOFS: dict[int, object] = {}
