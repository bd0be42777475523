"""Loads, windows and learned fixed errors, each against its definition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.estimators.sequential import LoadDoubt, SequentialOptions, design, device_checks
from gridsec.estimators.sequential.meter_bias import class_only, gather, learn, no_readings
from gridsec.estimators.sequential.posterior import injection_doubt, voltage_prior
from gridsec.estimators.sequential.state import ModelDriven
from gridsec.estimators.sequential.step import advance_inverters
from gridsec.estimators.sequential.time_scales import empty, forget, push, shift
from gridsec.grid.devices import fleet
from tests.codes import refused
from tests.gridsec.street import ac_voltages, accuracy, make_plant, random_tree


class TestLoads:
    def test_the_prior_is_the_covariance_of_what_power_flow_makes_of_load_errors(self) -> None:
        """Monte Carlo through AC power flow; common parts and the busbar's error included."""
        rng = np.random.default_rng(1)
        tree = random_tree(6, rng, drop=0.004)
        p, q = np.full(6, 0.01), np.full(6, 0.02)
        doubt = LoadDoubt(p, q, 600.0, common_p=0.5, common_q=0.3)
        found = voltage_prior(tree, np.arange(1, 7), doubt, busbar=1e-3)
        base = ac_voltages(tree, np.zeros(6, dtype=complex), 1.0) ** 2
        draws = []
        for _ in range(6000):
            dp = p * (np.sqrt(0.5) * rng.normal(size=6) + np.sqrt(0.5) * rng.normal())
            dq = q * (np.sqrt(0.7) * rng.normal(size=6) + np.sqrt(0.3) * rng.normal())
            v2 = ac_voltages(tree, dp + 1j * dq, 1.0) ** 2 + 1e-3 * rng.normal()
            draws.append(v2 - base)
        sample = np.cov(np.array(draws).T)
        scale = np.sqrt(np.outer(found.variance, found.variance))
        np.testing.assert_allclose(found.covariance / scale[:, 1:], sample[:, 1:] / scale[:, 1:], atol=0.06)
        np.testing.assert_allclose(found.variance, np.diagonal(sample), rtol=0.08, atol=1e-7)
        np.testing.assert_allclose(found.between, found.between.T)

    def test_the_prior_is_that_of_the_matrices(self) -> None:
        rng = np.random.default_rng(2)
        tree = random_tree(12, rng, drop=0.04)
        model, doubt = tree.linear(), LoadDoubt(rng.random(12), rng.random(12), 1.0, 0.3, 0.6)
        at, inverters = rng.permutation(13)[:7], rng.random(12)
        found = voltage_prior(tree, at, doubt, busbar=0.01, inverters=inverters)
        expected = np.full((13, 13), 1e-4)
        for R, s, c in (
            (model.R_bus, doubt.p, 0.3),
            (model.X_bus, np.hypot(doubt.q, inverters), 0.6),
        ):
            expected += 4.0 * R @ ((1.0 - c) * np.diag(s**2) + c * np.outer(s, s)) @ R.T
        np.testing.assert_allclose(found.covariance, expected[:, at], rtol=1e-12)
        np.testing.assert_allclose(found.variance, np.diagonal(expected), rtol=1e-12)

    def test_what_else_can_be_wrong_is_what_the_matrices_say(self) -> None:
        rng = np.random.default_rng(3)
        doubt = LoadDoubt(np.full(9, 0.006), np.full(9, 0.002), 600.0)
        made = design(make_plant(rng), doubt=doubt, step_s=1.0)
        plant, faults = made.plant, made.faults
        model, at = plant.feeder.linear(), plant.feeder.bus[plant.meters]
        columns = 2.0 * np.hstack([model.R_bus, model.X_bus[:, plant.droop.customer]])
        every = rng.permutation(columns.shape[1])
        np.testing.assert_allclose(faults.columns(every), columns[:, every], rtol=1e-12)
        weights = rng.normal(size=at.size)
        np.testing.assert_allclose(faults.weighted(weights), weights @ columns[at], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(faults.size, (columns[at] ** 2).sum(axis=0), rtol=1e-12)

    def test_every_problem_is_named(self) -> None:
        with refused(InputInvalid, "negative", "negative", "out-of-range", "out-of-range", "out-of-range"):
            LoadDoubt(np.array([-1.0]), np.array([np.nan]), 0.0, common_p=2.0, common_q=-1.0)
        for time_s in (np.inf, np.nan, 1e200):
            with refused(InputInvalid, "out-of-range"):
                LoadDoubt(np.ones(1), np.ones(1), time_s)

    def test_inverters_follow_their_meters_errors_up_to_saturation(self) -> None:
        droop = fleet(np.array([0, 2, 2]), ["ieee1547-b"] * 3, np.array([5.0, 5.0, 8.0]), 100.0)
        found = injection_doubt(droop, accuracy(2), np.array([0, 1]), 3)
        std = 2.0 * np.sqrt(0.005**2 / 3.0 + (0.1 / 230.0) ** 2 / 12.0 + 0.0005**2)
        assert found[0] == pytest.approx(min(droop.slope[0] * std, droop.limit[0]))
        np.testing.assert_array_equal(found[1:], 0.0)


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


class TestWindows:
    @settings(max_examples=50)
    @given(seed=st.integers(0, 2**32 - 1), ticks=st.integers(1, 60))
    def test_sums_are_sums(self, seed: int, ticks: int) -> None:
        rng = np.random.default_rng(seed)
        lengths = (1, 4, 9)
        window = empty(lengths, 3)
        rows, marks = [], []
        often = np.ones(3, dtype=np.bool_), np.array([True, False, True])
        for _ in range(ticks):
            values, heard = rng.normal(size=3), rng.random(3) < 0.7
            # The very array of before now and then, as where everybody reports at every tick.
            heard = often[int(rng.random() < 0.2)] if rng.random() < 0.9 else heard
            window = push(window, lengths, np.where(heard, values, np.nan), heard)
            rows.append(np.where(heard, values, 0.0))
            marks.append(heard)
            if rng.random() < 0.1:
                gone = rng.random(3) < 0.3
                window = forget(window, gone)
                rows = [np.where(gone, 0.0, row) for row in rows]
                marks = [mark & ~gone for mark in marks]
            if rng.random() < 0.1:
                change = rng.normal(size=3)
                window = shift(window, change)
                rows = [np.where(m, row + change, 0.0) for row, m in zip(rows, marks, strict=True)]
        for s, length in enumerate(lengths):
            np.testing.assert_allclose(window.sums[s], np.sum(rows[-length:], axis=0), atol=1e-12)
            np.testing.assert_array_equal(window.counts[s], np.sum(marks[-length:], axis=0))

    def test_rounding_errors_do_not_gather(self) -> None:
        window = empty((1, 7), 1)
        for k in range(5000):
            window = push(window, (1, 7), np.array([1e8 if k < 100 else 1e-8]), np.array([True]))
        np.testing.assert_allclose(window.sums[:, 0], [1e-8, 7e-8], rtol=1e-12)


class TestCommissioning:
    def test_fixed_errors_are_their_posterior(self) -> None:
        """Against the textbook posterior of a linear Gaussian model, made dense."""
        rng = np.random.default_rng(2)
        plant = make_plant(rng, customers=8)
        doubt = LoadDoubt(np.full(8, 0.006), np.full(8, 0.002), 600.0)
        made = design(plant, doubt=doubt, step_s=1.0, options=SequentialOptions(stability=0.0))
        count = np.array([900, 900, 900, 0, 450, 900, 900, 900])
        mean = rng.normal(size=8) * 0.004
        heard = count > 0
        start, time_s = no_readings(np.ones(8, dtype=bool), 100.0), np.where(heard, 3600.0, 0.0)
        gathered = replace(start, total=mean * count, count=count, time_s=time_s)
        known = learn(made, class_only(made), gathered, np.ones(8, dtype=bool), 4000.0)
        found = known.learned
        rho = 600.0 / 3600.0
        share = 2 * rho * (1 - rho * (1 - np.exp(-1 / rho)))
        # The fixed error of the busbar's meter is in every mean, however long.
        S = made.prior.between[np.ix_(heard, heard)] * share + (1.0 - share) * made.busbar**2
        B = np.diag(made.fixed[heard])
        K = S + B + np.diag(made.white[heard] / count[heard])
        gain = B @ np.linalg.inv(K)
        expected = np.clip(gain @ mean[heard], -made.allowed[heard], made.allowed[heard])
        np.testing.assert_allclose(found.bias[heard], expected, rtol=1e-9)
        np.testing.assert_allclose(found.variance[heard], np.diagonal(B - gain @ B), rtol=1e-6)
        assert found.bias[3] == 0.0
        assert found.variance[3] == made.fixed[3]
        assert found.allowed[3] == made.allowed[3]
        assert (found.allowed[heard] < made.allowed[heard]).all()
        np.testing.assert_array_equal(found.at, np.where(heard, 4000.0, np.nan))
        assert known.learning is not None
        np.testing.assert_array_equal(known.learning.open, ~heard)

    def test_mean_of_a_correlated_process_varies_as_is_said(self) -> None:
        """The factor on S, against an Ornstein-Uhlenbeck process."""
        rng = np.random.default_rng(3)
        rho, steps = 0.25, 400
        keep = np.exp(-1.0 / (rho * steps))
        x = rng.normal(size=20_000)
        total = np.zeros_like(x)
        for _ in range(steps):
            total += x
            x = keep * x + np.sqrt(1 - keep**2) * rng.normal(size=x.size)
        share = 2.0 * rho * (1.0 + rho * np.expm1(-1.0 / rho))
        assert np.var(total / steps) == pytest.approx(share, rel=0.03)

    def test_nothing_gathered_is_the_class(self) -> None:
        rng = np.random.default_rng(4)
        plant = make_plant(rng, customers=5)
        made = design(plant, doubt=LoadDoubt(np.full(5, 0.01), np.full(5, 0.01), 600.0), step_s=1.0)
        every = np.ones(5, dtype=bool)
        start = no_readings(every, 7.0)
        known = learn(made, class_only(made), start, every, 9.0)
        assert np.array_equal(known.learned.variance, class_only(made).variance)
        assert known.learning is start
        some = gather(
            start, np.array([1.0, 2.0, np.nan, 4.0, 5.0]), np.array([1, 1, 0, 1, 0], dtype=bool), 2.0
        )
        np.testing.assert_array_equal(some.total, [1.0, 2.0, 0.0, 4.0, 0.0])
        np.testing.assert_array_equal(some.count, [1, 1, 0, 1, 0])
        np.testing.assert_array_equal(some.time_s, [2.0, 2.0, 0.0, 2.0, 0.0])
