"""Thresholds term by term: worst cases by sampling and by simulation."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsec.errors import InputInvalid
from gridsec.estimators import detection
from gridsec.estimators.detection import ErrorBound, Motion, TickUncertainty
from gridsec.grid.devices import PRESETS, MeterAccuracy, busbar_error, fleet, reading_error
from tests.codes import refused
from tests.gridsec.street import make_plant, random_tree


def accuracy(**changes: object) -> MeterAccuracy:
    given = {
        "class_fraction": np.array([0.005, 0.01]),
        "resolution": np.array([4e-4, 0.0]),
        "jitter": np.array([5e-4, 1e-3]),
        "busbar_class": 0.001,
        "busbar_resolution": 4e-4,
        "busbar_jitter": 1e-4,
    }
    return MeterAccuracy(**(given | changes))  # type: ignore[arg-type]


class TestReadingError:
    @settings(max_examples=200)
    @given(
        v=st.floats(0.5, 1.5),
        bias=st.floats(-1.0, 1.0),
        jitter=st.floats(-3.0, 3.0),
        meter=st.integers(0, 1),
    )
    def test_covers_every_honest_reading(self, v: float, bias: float, jitter: float, meter: int) -> None:
        spec = accuracy()
        step = spec.resolution[meter]
        reading = v * (1.0 + bias * spec.class_fraction[meter]) + jitter * spec.jitter[meter]
        if step:
            reading = np.round(reading / step) * step
        bound = reading_error(spec, np.full(2, v * v), 3.0)[meter]
        assert abs(reading**2 - v**2) <= bound * (1.0 + 1e-12)

    def test_is_reached(self) -> None:
        spec = accuracy()
        worst = (1.0 * 1.005 + 2e-4 + 3.0 * 5e-4) ** 2 - 1.0
        assert reading_error(spec, np.ones(2), 3.0)[0] == pytest.approx(worst, rel=1e-12)
        # The reading is 1, the truth below it by what the class is of the truth itself.
        truth = (1.0 - 2e-4 - 3e-4) / 1.001
        below = 1.0 - truth**2
        assert below <= busbar_error(spec, 1.0, 3.0) <= 1.004 * below

    @settings(max_examples=200)
    @given(
        v=st.floats(0.5, 1.5),
        bias=st.floats(-1.0, 1.0),
        jitter=st.floats(-3.0, 3.0),
        klass=st.sampled_from([0.0, 0.001, 0.05, 0.3]),
    )
    def test_busbar_from_the_reading_alone(self, v: float, bias: float, jitter: float, klass: float) -> None:
        """The class is a part of the truth; what is known is the reading."""
        spec = accuracy(busbar_class=klass)
        reading = v * (1.0 + bias * klass) + jitter * spec.busbar_jitter
        bound = busbar_error(spec, reading**2, 3.0)
        assert abs(reading**2 - v**2) <= bound * (1.0 + 1e-12)

    def test_a_class_of_a_hundred_percent_says_nothing(self) -> None:
        assert busbar_error(accuracy(busbar_class=1.0), 1.0, 3.0) == np.inf

    @pytest.mark.parametrize(
        ("changes", "codes"),
        [
            ({"class_fraction": np.array([0.005])}, ("shape", "shape")),
            ({"resolution": np.array([-1.0, 0.0])}, ("negative",)),
            ({"jitter": np.array([np.nan, 0.0])}, ("negative",)),
            ({"jitter": np.zeros((2, 1))}, ("shape",)),
            ({"busbar_class": -0.1}, ("negative",)),
            ({"busbar_jitter": float("inf")}, ("negative",)),
        ],
    )
    def test_wrong_descriptions(self, changes: dict[str, object], codes: tuple[str, ...]) -> None:
        with refused(InputInvalid, *codes):
            accuracy(**changes)


class TestCurveMismatch:
    @pytest.mark.parametrize("name", PRESETS)
    def test_largest_distance_of_the_two_curves(self, name: str) -> None:
        droop = fleet(np.array([0]), name, np.array([5.0]), 100.0)
        v = np.linspace(0.8, 1.2, 400_001)
        exact = np.interp(v, droop.v[0], droop.q[0])
        model = droop((1.0 - v**2)[:, None])[:, 0]
        found = np.abs(exact - model).max()
        assert detection.curve_mismatch(droop)[0] == pytest.approx(found, rel=1e-6)
        assert found > 0


class TestLargest:
    @given(seed=st.integers(0, 2**32 - 1), p=st.integers(1, 8), count=st.integers(0, 9))
    def test_against_all_choices(self, seed: int, p: int, count: int) -> None:
        values = np.random.default_rng(seed).uniform(0.0, 1.0, (3, p))
        best = [max(sum(row[list(c)]) for c in combinations(range(p), min(count, p))) for row in values]
        np.testing.assert_allclose(detection.largest(values, count), best, rtol=1e-12, atol=0.0)


def problem(
    rng: np.random.Generator, *, customers: int = 7, M: int = 1
) -> tuple[detection.ErrorModel, TickUncertainty]:
    plant = make_plant(rng, customers=customers, drop=0.04)
    model = detection.error_model(plant.droop, plant.feeder.linear(), plant.meters, M)
    empty = np.zeros(customers, dtype=bool)
    now = TickUncertainty(
        base=rng.uniform(0.0, 0.01, customers),
        reading=rng.uniform(0.005, 0.02, customers),
        live=np.ones(customers, dtype=bool),
        told=empty,
        extra=np.zeros(customers),
    )
    return model, now


class TestGap:
    @settings(max_examples=30)
    @given(seed=st.integers(0, 2**32 - 1), M=st.integers(0, 3), silent=st.integers(0, 2))
    def test_is_the_worst_over_all_sets_that_leave_out_2m(self, seed: int, M: int, silent: int) -> None:
        rng = np.random.default_rng(seed)
        model, now = problem(rng, M=M)
        live = now.live.copy()
        live[:silent] = False
        now = replace(now, live=live)
        bound = ErrorBound(rng.uniform(0.0, 0.01, 7), rng.uniform(0.0, 0.02, 7))
        candidates = np.flatnonzero(live)
        worst = np.zeros(7)
        for count in range(2 * M + 1):
            for out in combinations(candidates, min(count, candidates.size)):
                free = ~live
                free[list(out)] = True
                each = np.where(free, bound.free, bound.driven)
                worst = np.maximum(worst, now.base + model.X2 @ each)
        np.testing.assert_allclose(detection.gap(model, now, bound), worst, rtol=1e-12)

    def test_metered_reactive_power(self) -> None:
        """Trusted: the inverter does not matter. Left out: its error and the load's extra one do."""
        rng = np.random.default_rng(1)
        model, now = problem(rng, M=1)
        told = np.zeros(7, dtype=bool)
        told[[1, 4]] = True
        extra = np.where(told, 0.003, 0.0)
        now = replace(now, told=told, extra=extra)
        bound = ErrorBound(rng.uniform(0.0, 0.01, 7), rng.uniform(0.0, 0.02, 7))
        worst = np.zeros(7)
        for count in range(3):
            for out in combinations(range(7), count):
                left = np.isin(np.arange(7), out)
                each = np.where(left, bound.free + extra, np.where(told, 0.0, bound.driven))
                worst = np.maximum(worst, now.base + model.X2 @ each)
        np.testing.assert_allclose(detection.gap(model, now, bound), worst, rtol=1e-12)

    def test_at_the_inverters(self) -> None:
        rng = np.random.default_rng(2)
        plant = make_plant(rng, customers=6, inverters=np.array([1, 4, 4]), meters=np.array([0, 1, 3, 4, 5]))
        model = detection.error_model(plant.droop, plant.feeder.linear(), plant.meters, 1)
        live, none = np.ones(5, dtype=bool), np.zeros(5, dtype=bool)
        now = TickUncertainty(rng.uniform(0.0, 0.01, 6), np.full(5, 0.01), live, none, np.zeros(5))
        bound = ErrorBound(rng.uniform(0.0, 0.01, 3), rng.uniform(0.0, 0.02, 3))
        np.testing.assert_allclose(
            detection.gap(model, now, bound, own=True),
            detection.gap(model, now, bound)[[1, 4, 4]],
            rtol=1e-13,
        )


class TestErrorBound:
    @settings(max_examples=40)
    @given(seed=st.integers(0, 2**32 - 1), h=st.sampled_from([0.3, 1.0, 4.0, 30.0]))
    def test_covers_simulated_errors(self, seed: int, h: float) -> None:
        """Plant and observers side by side, as differential equations, with errors at their ends.

        Any set of at most 2M meters may be left out. Nothing in the simulation comes from the bound.
        """
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, customers=5, drop=rng.choice([0.02, 0.1]), presets=("ieee1547-b", "vde4105"))
        droop, n = plant.droop, 5
        model = replace(
            detection.error_model(droop, plant.feeder.linear(), plant.meters, 1), mismatch=np.zeros(n)
        )
        S = 2.0 * plant.feeder.linear().X
        out = rng.choice(n, 2, replace=False)
        left = np.isin(np.arange(n), out)
        base, reading = rng.uniform(0.0, 0.01, n), rng.uniform(0.005, 0.02, n)
        now = TickUncertainty(base, reading, np.ones(n, dtype=bool), np.zeros(n, dtype=bool), np.zeros(n))
        w = rng.uniform(-0.06, 0.16, n)
        delta, noise = base * rng.choice([-1.0, 1.0], n), reading * rng.choice([-1.0, 1.0], n)
        x = np.concatenate([rng.uniform(-1, 1, n) * droop.limit, rng.uniform(-1, 1, n) * droop.limit])

        def rate(_t: float, both: np.ndarray) -> np.ndarray:
            true, seen = both[:n], both[n:]
            z = w - S @ true
            zeta = np.where(left, w + delta - S @ seen, z + noise)
            return np.concatenate([droop(z) - true, droop(zeta) - seen]) / np.tile(droop.tau, 2)

        bound = level = detection.widest(model)
        before = w + delta - S @ x[n:]
        tight = 0.0
        for _ in range(25):
            x = solve_ivp(rate, (0.0, h), x, rtol=1e-8, atol=1e-11, max_step=h).y[:, -1]
            after = w + delta - S @ x[n:]
            # This observer is itself free of liars: it is as far from the true z as `gap` says, no more.
            motion = Motion(before=before, after=after, offset=np.zeros(n), h=h)
            bound, level = detection.advance(model, now, motion, bound, level)
            each = np.where(left, bound.free, bound.driven)
            error = np.abs(x[:n] - x[n:])
            assert (error <= each + 1e-9).all()
            assert (np.abs(S @ (x[:n] - x[n:]) + delta) <= detection.gap(model, now, bound) + 1e-9).all()
            assert (bound.free <= level.free + 1e-15).all()
            tight = max(tight, float((error / np.maximum(each, 1e-12)).max()))
            before = after
        assert tight > 0.0

    @pytest.mark.parametrize("ago", [0.2, 2.0, 20.0, 800.0])
    def test_a_jump_at_any_time_within_a_long_step(self, ago: float) -> None:
        """The readings at the end are taken for the whole step; the inverters lived through the jump."""
        rng = np.random.default_rng(8)
        plant = make_plant(rng, customers=5, drop=0.1, presets=("ieee1547-b", "vde4105"))
        droop, h = plant.droop, 900.0
        lin = plant.feeder.linear()
        model = replace(detection.error_model(droop, lin, plant.meters, 1), mismatch=np.zeros(5))
        S, zero, none = 2.0 * lin.X, np.zeros(5), np.zeros(5, dtype=bool)
        exact = TickUncertainty(zero, zero, ~none, none, zero)

        def rest(w: np.ndarray, x: np.ndarray) -> np.ndarray:
            for _ in range(3000):
                x = x + 0.2 * (droop(w - S @ x) - x)
            return x

        calm, jumped = np.full(5, 0.05), np.full(5, 0.11)
        true = rest(calm, zero)
        before = calm - S @ true
        seen = rest(jumped, true)
        rate = lambda _, x: (droop(jumped - S @ x) - x) / droop.tau  # noqa: E731
        true = solve_ivp(rate, (0.0, ago), true, rtol=1e-9, atol=1e-12, max_step=1.0).y[:, -1]
        motion = Motion(before=before, after=jumped - S @ true, offset=zero, h=h)
        start = ErrorBound(zero, zero)
        bound, _ = detection.advance(model, exact, motion, start, detection.widest(model))
        # An observer that listens to everybody rests where the last readings put it.
        heard = droop(jumped - S @ true)
        assert (np.abs(true - heard) <= bound.driven + 1e-9).all()
        assert (np.abs(true - seen) <= bound.free + 1e-9).all()

    def test_decays_from_saturation_to_its_settled_level(self) -> None:
        rng = np.random.default_rng(3)
        model, now = problem(rng)
        z = np.full(7, 0.05)
        motion = Motion(z, z, np.zeros(7), 1.0)
        rest = detection.settled(model, now, motion, detection.widest(model))
        bound = level = detection.widest(model)
        last = bound.free
        for _ in range(80):
            bound, level = detection.advance(model, now, motion, bound, level)
            assert (bound.free <= last + 1e-15).all()
            last = bound.free
        assert (bound.free >= rest.free * (1 - 1e-2)).all()
        assert (bound.free <= rest.free * 1.05 + 1e-9).all()
        assert (rest.free < 0.5 * model.span).all()

    def test_grows_again_when_less_is_known(self) -> None:
        rng = np.random.default_rng(4)
        model, now = problem(rng)
        z = np.full(7, 0.05)
        motion = Motion(z, z, np.zeros(7), 5.0)
        bound = level = detection.settled(model, now, motion, detection.widest(model))
        worse = replace(now, base=now.base + 0.05)
        for _ in range(30):
            bound, level = detection.advance(model, worse, motion, bound, level)
        rest = detection.settled(model, worse, motion, detection.widest(model))
        np.testing.assert_allclose(bound.free, rest.free, rtol=0.05)
        assert (bound.free > 1.2 * detection.settled(model, now, motion, detection.widest(model)).free).any()

    def test_nothing_moves_inside_the_deadband(self) -> None:
        rng = np.random.default_rng(5)
        tree = random_tree(5, rng, drop=0.01)
        droop = fleet(np.arange(5), "asnzs4777-a", np.full(5, 5.0), 100.0)
        model = detection.error_model(droop, tree.linear(), np.arange(5), 1)
        now = TickUncertainty(
            np.full(5, 0.003), np.full(5, 0.015), np.ones(5, dtype=bool), np.zeros(5, dtype=bool), np.zeros(5)
        )
        motion = Motion(np.zeros(5), np.zeros(5), np.zeros(5), 1.0)
        rest = detection.settled(model, now, motion, ErrorBound(np.full(5, 1e-3), np.full(5, 1e-3)))
        np.testing.assert_array_equal(rest.free, model.mismatch)
