"""Observer of the inverters: against an adaptive integrator, and at each preparation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsec.arrays import Floats
from gridsec.estimators.front import LoadDoubt, design, device_checks
from gridsec.estimators.front.observer import advance_inverters
from gridsec.estimators.front.state import ModelDriven
from tests.gridsec.street import make_plant


class TestInverters:
    @pytest.mark.parametrize(
        ("driven", "w", "steps"),
        [
            ((), (-0.08, 0.08), (1.0, 1.0, 0.3, 1.0, 4.0)),
            ((0, 2, 4, 6, 8), (0.06, 0.1), (0.5, 0.5, 0.3, 0.5, 1.0)),
        ],
    )
    def test_those_without_a_meter_follow_the_model(
        self, driven: tuple[int, ...], w: tuple[float, float], steps: tuple[float, ...]
    ) -> None:
        """Against an adaptive integrator; step lengths change, and what was prepared is used again."""
        rng = np.random.default_rng(5)
        plant = make_plant(rng, drop=0.06)
        doubt = LoadDoubt(np.full(9, 0.01), np.full(9, 0.01), 600.0)
        made = design(plant, doubt=doubt, step_s=1.0)
        X, droop = 2.0 * plant.feeder.linear().X, plant.droop
        known, y, which = rng.uniform(*w, 9), np.full(9, 0.9), np.isin(np.arange(9), driven)
        x, free = np.zeros(9), None
        for h in steps:
            x, free = advance_inverters(made, x, y, which, known, h, free)

        def change(_: float, x: Floats) -> Floats:
            return np.asarray((droop(np.where(which, droop.vbar**2 - y, known - X @ x)) - x) / droop.tau)

        exact = solve_ivp(change, (0.0, sum(steps)), np.zeros(9), rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(x, exact, atol=2e-3 * np.abs(exact).max())

    @settings(max_examples=40, deadline=None)
    @given(
        steps=st.lists(
            st.tuples(st.integers(0, 7), st.sampled_from([0.2, 1.0, 60.0, 900.0])), min_size=2, max_size=8
        )
    )
    def test_what_was_prepared_changes_nothing(self, steps: list[tuple[int, float]]) -> None:
        rng = np.random.default_rng(6)
        plant = make_plant(rng, drop=0.06)
        made = design(plant, doubt=LoadDoubt(np.full(9, 0.01), np.full(9, 0.01), 600.0), step_s=1.0)
        w, y = rng.uniform(-0.08, 0.08, 9), rng.uniform(0.9, 1.1, 9)
        x, before = np.zeros(9), None
        for which, h in steps:
            driven = np.array([(which >> (k % 3)) & 1 for k in range(9)], dtype=np.bool_)
            anew, _ = advance_inverters(made, x, y, driven, w, h)
            x, free = advance_inverters(made, x, y, driven, w, h, before)
            np.testing.assert_array_equal(x, anew)
            kept = isinstance(before, ModelDriven) and isinstance(free, ModelDriven)
            if kept and np.array_equal(before.rows, free.rows):
                assert free.loop is before.loop
            before = free

    def test_several_of_a_customer_share_what_is_metered(self) -> None:
        rng = np.random.default_rng(7)
        plant = make_plant(rng, customers=4, inverters=np.array([0, 0, 1, 3]), meters=np.array([0, 1, 2]))
        made = design(plant, doubt=LoadDoubt(np.full(4, 0.01), np.full(4, 0.01), 600.0), step_s=1.0)
        np.testing.assert_array_equal(made.meter_of, [0, 0, 1, -1])
        found = replace(device_checks.no_checks(3, 4), amount=np.array([0.04, -0.03, 0.5])).amounts(made)
        np.testing.assert_array_equal(found, [0.02, 0.02, -0.03, 0.0])
