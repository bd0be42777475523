"""Banks by matrix inequality on a loop that is not symmetric, and banks around closed loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.estimators import exact_bank
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.exact_bank.bank import Gains
from gridsec.estimators.plant import Plant
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.network import Power
from gridsec.interface import Decision
from gridsec.observers.certificates import certify, verify
from gridsec.observers.gains import margin, options_for, stacked
from gridsec.observers.lmi import contraction, solve_many
from gridsec.observers.lure import Lure, close_loop
from tests.gridsec.around import MeshedStreet
from tests.gridsec.street import make_plant
from tests.gridsec.streets import PhasedStreet, coupled


def loop() -> tuple[Plant, Lure]:
    plant = coupled(4, customers=5)
    return plant, close_loop(plant.feeder, plant.droop, plant.meters)


def largest(M: np.ndarray) -> float:
    return float(np.linalg.eigvalsh(0.5 * (M + M.T))[-1])


class TestAsymmetricLoop:
    def test_the_certificate_of_the_solver_holds_for_every_set_and_slope(self) -> None:
        """Oracle: V' of the error equation itself, at random slopes and trusted sets."""
        _, lure = loop()
        assert np.abs(lure.H - lure.H.T).max() > 0.5 * np.abs(lure.H).max()
        assert (lure.H > 0.0).any()
        rng, rate = np.random.default_rng(1), 0.1 * float(np.min(-np.diagonal(lure.A)))
        for proof in (contraction(lure, rate=rate), certify(lure)):
            assert verify(proof, lure) > 0
            if proof.P.ndim < 2:
                continue
            P = proof.P
            for _ in range(400):
                slope = lure.slope * rng.choice([0.0, 1.0, rng.random()], lure.slope.size)
                free = rng.random(lure.slope.size) < 0.7
                E = lure.A + (lure.G * slope * free) @ lure.H
                assert largest(P @ E + (P @ E).T + 2.0 * proof.rate * P) <= 1e-9 * largest(P)

    def test_every_observer_by_matrix_inequality_forgets_as_fast_as_it_says(self) -> None:
        plant, lure = loop()
        load = 0.01 * np.hstack([2.0 * plant.feeder.between(power) for power in Power])
        options = options_for(lure, rate=0.25 * certify(lure).rate, noise=0.002, load=load, floor=0.5)
        masks = banks.subsets(5, 1, most=100).masks()
        made = solve_many(lure, [np.flatnonzero(mask).tolist() for mask in masks], options, workers=1)
        rng = np.random.default_rng(2)
        for one in made:
            assert margin(lure, one.J, one) > 0
            C, size = lure.C[one.J], largest(one.P)
            for _ in range(50):
                slope = lure.slope * rng.choice([0.0, 1.0, rng.random()], lure.slope.size)
                E = lure.A - one.L @ C + (lure.G * slope) @ (lure.H - one.K @ C)
                assert largest(one.P @ E + (one.P @ E).T + 2.0 * one.alpha * one.P) <= 1e-9 * size
        gains = Gains(*stacked(made, 5))
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0, gains=gains)
        assert design.certificate.kind == "small-gain"
        for liar in (0, 3):
            street = PhasedStreet(plant, np.random.default_rng(liar), extreme=True)
            state = exact_bank.init(design, 1000.0)
            for tick in range(14):
                street.advance(1.0)
                state, estimate, verdict = exact_bank.step(
                    design, state, street.frame({liar: 0.15} if tick > 8 else {})
                )
                assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
                assert set(np.flatnonzero(verdict.suspects)) <= {liar}
                assert tick <= 8 or verdict.decision is not Decision.CLEAN
            assert verdict.suspects[liar]


@pytest.mark.parametrize("liar", [1, 4])
def test_a_bank_around_loops_names_the_liar_alone(liar: int) -> None:
    one = make_plant(np.random.default_rng(7), customers=6, drop=0.03)
    tree = one.feeder
    ends, z = np.array([[2, 6], [3, 5]]), np.array([0.01, 0.02])
    mesh = MeshedFeeder(tree, ends, z, 0.5 * z, np.zeros(2))  # type: ignore[arg-type]
    plant = replace(one, feeder=mesh)
    street = MeshedStreet(plant, np.random.default_rng(liar), extreme=True, metered_q=np.array([0, 2]))
    design = exact_bank.design(plant, max_attacked=1, step_s=1.0)
    state = exact_bank.init(design, 1000.0)
    for tick in range(16):
        street.advance(1.0 if tick % 4 else 900.0)
        state, estimate, verdict = exact_bank.step(
            design, state, street.frame({liar: 0.06} if tick > 9 else {})
        )
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
        assert set(np.flatnonzero(verdict.suspects)) <= {liar}
        assert verdict.decision is not Decision.CLEAN or tick <= 9
    assert verdict.suspects[liar]
