"""The monitor against AC power flow, meters with flaws, and manipulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.errors import InputInvalid, NotObservable
from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.interface import Cause, Decision, Frame
from tests.codes import refused
from tests.gridsec.estimators.modal.streets import doubt, prepare, watch
from tests.gridsec.street import Street, accuracy, make_plant


class TestHonestStreets:
    @pytest.mark.acceptance
    @settings(max_examples=15, deadline=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        drop=st.sampled_from([0.005, 0.02, 0.06]),
        h=st.sampled_from([0.5, 1.0, 5.0, 900.0]),
        inverters=st.sampled_from([0, 3, 9]),
    )
    def test_nobody_is_named(self, seed: int, drop: float, h: float, inverters: int) -> None:
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, drop=drop, inverters=np.sort(rng.choice(9, inverters, replace=False)))
        street = Street(plant, rng)
        _, answers = watch(street, prepare(plant, step_s=h), 40, h=h)
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert answers[-1][1].decision is Decision.CLEAN
        estimate = answers[-1][0]
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()

    @pytest.mark.acceptance
    def test_the_standard_deviation_is_about_right(self) -> None:
        """Over many streets, the error in standard deviations is neither large nor tiny."""
        ratio = []
        for seed in range(25):
            rng = np.random.default_rng([7, seed])
            plant = make_plant(rng, customers=12, drop=0.04)
            street = Street(plant, rng)
            _, answers = watch(street, prepare(plant), 70)
            estimate = answers[-1][0]
            ratio.append((estimate.v2 - street.truth()) / estimate.std)
        assert 0.4 < float(np.sqrt(np.mean(np.square(ratio)))) < 1.3

    def test_settling_is_undecided(self) -> None:
        rng = np.random.default_rng(1)
        plant = make_plant(rng)
        _, answers = watch(Street(plant, rng), prepare(plant), 60)
        causes = [verdict.cause for _, verdict in answers]
        first = causes.index(Cause.AGREEMENT)
        assert first > 0
        assert set(causes[:first]) == {Cause.SETTLING}
        assert set(causes[first:]) == {Cause.AGREEMENT}


class TestLiars:
    @pytest.mark.canary("0")
    @pytest.mark.parametrize("seed", range(6))
    def test_a_third_of_the_meters_is_named_and_nobody_else(self, seed: int) -> None:
        rng = np.random.default_rng([11, seed])
        plant = make_plant(rng, customers=15, drop=0.04)
        design, street = prepare(plant), Street(plant, rng)
        suspects = np.sort(rng.choice(15, 5, replace=False))
        state, _ = watch(street, design, 40)
        lies = {int(j): float(rng.choice([-1.0, 1.0])) * 0.03 for j in suspects}
        state, answers = watch(street, design, 60, state=state, lies=lies)
        honest = np.setdiff1d(np.arange(15), suspects)
        assert not any(verdict.suspects[honest].any() for _, verdict in answers)
        for _, verdict in answers[5:]:
            np.testing.assert_array_equal(np.flatnonzero(verdict.suspects), suspects)
            assert verdict.decision is Decision.ATTACKED
        estimate, verdict = answers[-1]
        assert np.abs(estimate.v2 - street.truth()).max() < 0.006
        reported = street.truth()[suspects] * (1.0 + np.array([lies[int(j)] for j in suspects])) ** 2
        np.testing.assert_allclose(verdict.attack[suspects], reported - street.truth()[suspects], atol=0.018)
        _, after = watch(street, design, 90, state=state)
        assert not after[-1][1].suspects.any()
        assert after[-1][1].decision is Decision.CLEAN

    def test_a_small_lie_shows_on_a_long_scale_and_after_commissioning(self) -> None:
        """0.5 % is inside the class: nothing speaks against it before the meters are known, all after."""
        rng = np.random.default_rng(12)
        plant = make_plant(rng, customers=12, drop=0.03)
        unknown = prepare(plant)
        state, answers = watch(Street(plant, rng), unknown, 120, lies={4: 0.004})
        assert not answers[-1][1].suspects.any()
        design = prepare(plant, commission_s=3000.0)
        street = Street(plant, rng)
        state, answers = watch(street, design, 320, h=10.0)
        assert state.front.learning is None
        assert not any(verdict.suspects.any() for _, verdict in answers)
        again = monitor.init(design, street.t, state.commission)
        again, _ = watch(street, design, 60, state=again)
        _, answers = watch(street, design, 60, state=again, lies={4: 0.006})
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [4]

    @pytest.mark.canary("5")
    @pytest.mark.parametrize("ticks", [5, 20])
    def test_more_liars_than_can_be_told_apart_are_undecided(self, ticks: int) -> None:
        rng = np.random.default_rng(13)
        plant = make_plant(rng, customers=9, drop=0.02)
        design = prepare(plant)
        n = len(plant.feeder.customers)
        narrow = monitor.design(plant, doubt=doubt(plant), step_s=1.0, max_attacked=1)
        assert (design.max_attacked, narrow.max_attacked, narrow.observers) == (3, 1, 1)
        state, _ = watch(Street(plant, rng), narrow, 30)
        _, answers = watch(
            Street(plant, rng, t=2000.0), narrow, ticks, state=state, lies={1: 0.05, n - 2: -0.05}
        )
        assert answers[-1][1].decision is Decision.UNDECIDED
        assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS


class TestGaps:
    def test_silent_meters_are_undecided_and_liars_still_named(self) -> None:
        """Half of the meters are silent."""
        rng = np.random.default_rng(21)
        plant = make_plant(rng, customers=16, drop=0.03)
        design, street = prepare(plant), Street(plant, rng)
        silent = tuple(range(1, 16, 2))
        state, answers = watch(street, design, 60, silent=silent)
        assert answers[-1][1].decision is Decision.UNDECIDED
        assert np.abs(answers[-1][0].v2 - street.truth()).max() < 0.01
        _, answers = watch(street, design, 12, state=state, silent=silent, lies={4: -0.04})
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [4]
        _, answers = watch(street, design, 5, state=state, silent=tuple(range(15)))
        assert answers[-1][1].decision is Decision.UNDECIDED

    def test_without_the_busbar_the_meters_say_where_it_is(self) -> None:
        rng = np.random.default_rng(22)
        plant = make_plant(rng, customers=12, drop=0.03)
        design, street = prepare(plant), Street(plant, rng)
        street.v0 = 1.03
        state, answers = watch(street, design, 60, change=lambda f: replace(f, v0_squared=np.nan))
        assert np.abs(answers[-1][0].v2 - street.truth()).max() < 0.012
        assert np.abs(answers[-1][0].v2_bus[0] - 1.03**2) < 0.012
        assert not any(verdict.suspects.any() for _, verdict in answers)
        _, answers = watch(
            street, design, 12, state=state, lies={7: 0.04}, change=lambda f: replace(f, v0_squared=np.nan)
        )
        assert list(np.flatnonzero(answers[-1][1].suspects)) == [7]

    def test_powers_that_nobody_knows_are_not_believed(self) -> None:
        """A customer's active power is missing and far from what the frame says."""
        rng = np.random.default_rng(23)
        plant = make_plant(rng, customers=10, drop=0.04)
        design, street = prepare(plant), Street(plant, rng)

        def guess(frame: Frame) -> Frame:
            p, error = frame.p.copy(), frame.p_error.copy()
            p[6], error[6] = -0.12, 0.12
            return replace(frame, p=p, p_error=error)

        state, answers = watch(street, design, 60, change=guess)
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert state.front.uncertainty.p[6] > 1.0
        state, _ = watch(street, design, 1, state=state)
        assert state.front.uncertainty.usual

    def test_a_frame_that_is_not_later_changes_nothing(self) -> None:
        rng = np.random.default_rng(24)
        plant = make_plant(rng)
        design, street = prepare(plant), Street(plant, rng)
        first = monitor.init(design, street.t)
        same, estimate, verdict = monitor.step(design, first, replace(street.frame(), t=np.nan))
        assert same is first
        assert verdict.decision is Decision.UNDECIDED
        assert np.isfinite(estimate.bound).all()
        state, answers = watch(street, design, 30)
        again, estimate, verdict = monitor.step(design, state, street.frame())
        assert again is state
        assert verdict.decision is Decision.UNDECIDED
        np.testing.assert_array_equal(estimate.v2, answers[-1][0].v2)

    @pytest.mark.acceptance
    @settings(max_examples=15, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_absurd_frames_raise_nothing(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        plant = make_plant(rng)
        design, street = prepare(plant), Street(plant, rng)

        def spoil(frame: Frame) -> Frame:
            y, p = frame.y.copy(), frame.p.copy()
            y[rng.integers(9)] = rng.choice([np.nan, -1.0, 1e6, 0.0])
            p[rng.integers(9)] = rng.choice([1e3, -1e3, 0.0])
            return replace(frame, y=y, p=p)

        watch(street, design, 15, change=spoil)


class TestDesign:
    def test_what_cannot_be_watched_is_refused(self) -> None:
        rng = np.random.default_rng(31)
        plant = make_plant(rng, meters=np.array([1, 4]))
        known = LoadDoubt(np.full(9, 0.01), np.full(9, 0.01), 600.0)
        with refused(NotObservable, "too-few-meters"):
            monitor.design(plant, doubt=known, step_s=1.0)
        twice = make_plant(rng, meters=np.array([1, 1, 4]))
        with refused(InputInvalid, "duplicate"):
            monitor.design(twice, doubt=known, step_s=1.0)
        good = make_plant(rng)
        with refused(InputInvalid, "shape"):
            monitor.design(good, doubt=LoadDoubt(np.ones(3), np.ones(3), 1.0), step_s=1.0)
        with refused(InputInvalid, "not-positive"):
            monitor.design(good, doubt=known, step_s=0.0)
        with refused(InputInvalid, "shape"):
            monitor.design(replace(good, accuracy=accuracy(4)), doubt=known, step_s=1.0)

    def test_the_limits_ask_for_the_false_alarm_rate(self) -> None:
        """Chance beyond the limits, times the ticks of a year, is a share of the rate asked for."""
        from math import erfc, exp, sqrt

        front = prepare(make_plant(np.random.default_rng(32))).front
        ticks = 365.25 * 86400.0
        assert (9 + 1 + 1) * ticks * erfc(front.sigmas / sqrt(2.0)) == pytest.approx(1.0 / 6.0, rel=1e-6)
        assert 9 * ticks * exp(-front.references.limits.stuck) == pytest.approx(1.0 / 6.0, rel=1e-6)
