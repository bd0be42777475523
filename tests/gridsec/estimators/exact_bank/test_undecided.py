"""What keeps the monitor from an answer, and what it asks of a design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators import exact_bank
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.exact_bank.step import MonitorDesign, MonitorState
from gridsec.estimators.plant import Options
from gridsec.grid.devices import Droop
from gridsec.interface import Cause, Decision, Frame
from gridsec.observers.certificates import Certificate, certify
from gridsec.observers.gains import stacked
from gridsec.observers.lmi import circle
from gridsec.observers.lure import close_loop
from tests.codes import refused
from tests.gridsec.street import Street, make_plant
from tests.gridsec.watching import decisions, watch


class TestUndecided:
    def start(self, seed: int, M: int = 2, **options: int) -> tuple[Street, MonitorDesign, MonitorState]:
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, **options)
        design = exact_bank.design(plant, max_attacked=M, step_s=1.0)
        street = Street(plant, rng)
        state, answers = watch(street, design, 40)
        assert answers[-1][1].decision is Decision.CLEAN
        return street, design, state

    def test_silent_meter(self) -> None:
        street, design, state = self.start(20)
        state, answers = watch(street, design, 10, state=state, silent=(2,))
        assert {verdict.cause for _, verdict in answers} == {Cause.SILENT_METERS}
        assert "c2" in answers[0][1].reason
        # Back again: no new settling.
        state, answers = watch(street, design, 5, state=state)
        assert set(decisions(answers)) == {Decision.CLEAN}

    def test_silence_and_lies_together(self) -> None:
        street, design, state = self.start(21)
        state, answers = watch(street, design, 6, state=state, silent=(0, 8), lies={3: 0.04, 5: 0.04})
        assert np.flatnonzero(answers[-1][1].suspects).tolist() == [3, 5]
        assert answers[-1][1].decision is Decision.ATTACKED

    @settings(max_examples=15)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_meters_come_and_go(self, seed: int) -> None:
        """Bounds hold through any pattern of losses."""
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, drop=0.03)
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0)
        street = Street(plant, rng, extreme=True)
        state = None
        for _ in range(12):
            lost = tuple(int(j) for j in np.flatnonzero(rng.random(9) < 0.4))
            state, _ = watch(street, design, int(rng.integers(1, 4)), state=state, silent=lost)

    def test_too_few_meters(self) -> None:
        street, design, state = self.start(22)
        state, answers = watch(street, design, 5, state=state, silent=(0, 1, 2, 3, 4), lies={5: 0.2})
        assert {verdict.cause for _, verdict in answers} == {Cause.TOO_FEW_METERS}
        assert not answers[-1][0].trusted.any()
        assert not answers[-1][1].suspects.any()
        state, answers = watch(street, design, 40, state=state)
        assert answers[0][1].cause is Cause.SETTLING
        assert answers[-1][1].decision is Decision.CLEAN

    def test_nothing_at_all(self) -> None:
        street, design, state = self.start(23)
        change = lambda frame: replace(frame, v0_squared=float("nan"))  # noqa: E731
        state, answers = watch(street, design, 5, state=state, silent=tuple(range(9)), change=change)
        assert {verdict.cause for _, verdict in answers} == {Cause.TOO_FEW_METERS}

    @pytest.mark.parametrize("value", [float("nan"), 0.0, -1.0, 1e9, float("inf")])
    def test_no_busbar(self, value: float) -> None:
        """The meters imply the busbar voltage, and up to M of them may lie about it."""
        street, design, state = self.start(24)

        def blind(frame: Frame) -> Frame:
            return replace(frame, v0_squared=value)

        state, answers = watch(street, design, 10, state=state, change=blind, lies={1: 0.3, 2: 0.3})
        assert {verdict.cause for _, verdict in answers} == {Cause.NO_BUSBAR}
        assert np.flatnonzero(answers[-1][1].suspects).tolist() == [1, 2]
        state, answers = watch(street, design, design.options.release, state=state)
        assert decisions(answers)[-2:] == [Decision.ATTACKED, Decision.CLEAN]

    def test_no_busbar_from_the_start(self) -> None:
        rng = np.random.default_rng(25)
        plant = make_plant(rng)
        design = exact_bank.design(plant, max_attacked=2, step_s=1.0)
        change = lambda frame: replace(frame, v0_squared=float("nan"))  # noqa: E731
        watch(Street(plant, rng), design, 20, change=change)

    def test_too_many_suspects(self) -> None:
        street, design, state = self.start(26)
        lies = {0: 0.1, 3: -0.1, 5: 0.1}
        state, answers = watch(street, design, 5, state=state, lies=lies, sound=False)
        verdict = answers[-1][1]
        assert verdict.cause is Cause.TOO_MANY_SUSPECTS
        assert verdict.suspects[[0, 3, 5]].all()
        assert "switch" in verdict.reason
        # The liars moved the estimate by what saturation allows, and the bound says so.
        assert (np.abs(answers[-1][0].v2 - street.truth()) <= answers[-1][0].bound).all()
        state, answers = watch(street, design, 30, state=state, sound=False)
        assert answers[-1][1].decision is Decision.CLEAN

    def test_wrong_busbar_reading_is_not_blamed_on_two_meters(self) -> None:
        street, design, state = self.start(27)
        shift = lambda frame: replace(frame, v0_squared=frame.v0_squared * 1.1)  # noqa: E731
        _, answers = watch(street, design, 5, state=state, change=shift, sound=False)
        assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS

    def test_invalid_design(self) -> None:
        street, design, _ = self.start(28)
        good = design.certificate
        claims_too_much = Certificate(
            kind=good.kind,
            P=good.P,
            rate=100.0 * good.rate,
            noise=good.noise,
            load=good.load,
            attack=good.attack,
            margin=good.margin,
            status=good.status,
            multiplier=good.multiplier,
        )
        unknown = replace(good, kind="hearsay")
        for certificate, code in ((claims_too_much, "not-verified"), (unknown, "wrong-form")):
            _, answers = watch(street, replace(design, certificate=certificate), 40)
            assert {verdict.cause for _, verdict in answers} == {Cause.DESIGN_INVALID}
            with refused(DesignInfeasible, code):
                exact_bank.design(design.plant, max_attacked=2, step_s=1.0, certificate=certificate)

    def test_loads_too_uncertain(self) -> None:
        street, design, state = self.start(29)

        def vague(frame: Frame) -> Frame:
            return replace(frame, p_error=np.full(9, 0.3))

        _, answers = watch(street, design, 3, state=state, change=vague)
        assert {verdict.cause for _, verdict in answers} == {Cause.AMBIGUOUS}
        assert "not known well enough" in answers[-1][1].reason

    def test_collapse(self) -> None:
        """Loads far beyond what the feeder carries: no answer, and no exception."""
        street, design, state = self.start(30)

        def absurd(frame: Frame) -> Frame:
            return replace(frame, p=frame.p * 1e4, q=frame.q * 1e4)

        _, answers = watch(street, design, 3, state=state, change=absurd, sound=False)
        assert {verdict.decision for _, verdict in answers} == {Decision.UNDECIDED}

    def test_time_does_not_run_backwards(self) -> None:
        street, design, state = self.start(31)
        street.advance(1.0)
        frame = street.frame()
        state, estimate, verdict = exact_bank.step(design, state, frame)
        assert verdict.decision is Decision.CLEAN
        for t in (frame.t, frame.t - 100.0, float("nan")):
            same, again, answer = exact_bank.step(design, state, replace(frame, t=t, y=frame.y * 2.0))
            assert same is state
            assert again is estimate
            assert answer.decision is Decision.UNDECIDED
            assert "not used" in answer.reason
        fresh, estimate, verdict = exact_bank.step(
            design, exact_bank.init(design, 0.0), replace(frame, t=float("nan"))
        )
        assert verdict.decision is Decision.UNDECIDED
        assert fresh.last is None
        assert np.isfinite(estimate.bound).all()

    @pytest.mark.parametrize("value", [float("inf"), float("-inf"), 1e300, -5.0, 0.0])
    def test_absurd_readings(self, value: float) -> None:
        street, design, state = self.start(32)

        def absurd(frame: Frame) -> Frame:
            y = frame.y.copy()
            y[6] = value
            return replace(frame, y=y)

        _, answers = watch(street, design, 4, state=state, change=absurd, lies={6: 0.0})
        wanted = Cause.RESIDUALS if np.isfinite(value) else Cause.SILENT_METERS
        assert answers[-1][1].cause is wanted


class TestDesign:
    def test_not_observable(self) -> None:
        plant = make_plant(np.random.default_rng(40), customers=4)
        with refused(NotObservable, "too-few-meters"):
            exact_bank.design(plant, max_attacked=2, step_s=1.0)

    def test_wrong_plants(self) -> None:
        plant = make_plant(np.random.default_rng(41), customers=4)
        with refused(InputInvalid, "duplicate"):
            exact_bank.design(replace(plant, meters=np.array([0, 1, 1, 2])), max_attacked=1, step_s=1.0)
        with refused(InputInvalid, "shape"):
            exact_bank.design(replace(plant, meters=np.array([0, 1, 2])), max_attacked=1, step_s=1.0)
        with refused(InputInvalid, "not-positive"):
            exact_bank.design(plant, max_attacked=1, step_s=0.0)

    def test_stacked_gains(self) -> None:
        """Gains between none and direct injection: other observers, other bounds, the same verdicts."""
        rng = np.random.default_rng(42)
        plant = make_plant(rng, customers=7)
        direct = exact_bank.design(plant, max_attacked=2, step_s=1.0)
        gains = banks.direct_gains(direct.bank.lure, direct.bank.masks)
        soft = banks.Gains(gains.L, 0.8 * gains.K)
        design = exact_bank.design(plant, max_attacked=2, step_s=1.0, gains=soft)
        assert design.certificate.kind == "small-gain"
        street = Street(plant, rng, extreme=True)
        state, answers = watch(street, design, 40)
        assert answers[-1][1].decision is Decision.CLEAN
        state, answers = watch(street, design, 5, state=state, silent=(0,))
        assert answers[-1][1].cause is Cause.SILENT_METERS
        state, answers = watch(street, design, 5, state=state, lies={3: 0.05, 5: -0.05})
        assert np.flatnonzero(answers[-1][1].suspects).tolist() == [3, 5]
        state, answers = watch(street, design, 3, state=state, silent=(0, 1, 2), sound=False)
        assert answers[-1][1].cause is Cause.TOO_FEW_METERS
        blind = lambda frame: replace(frame, v0_squared=float("nan"))  # noqa: E731
        state, answers = watch(street, design, 3, state=state, change=blind)
        assert answers[-1][1].cause is Cause.NO_BUSBAR
        assert answers[-1][0].bound.max() < 0.1

    @settings(max_examples=6)
    @given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.0, 0.01, 0.05]))
    def test_gains_that_inject_into_states(self, seed: int, size: float) -> None:
        """Bounds hold for any gains under the small-gain condition, lies and silence included."""
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, customers=6, drop=0.02, inverters=np.arange(5))
        direct = exact_bank.design(plant, max_attacked=1, step_s=1.0)
        gains = banks.direct_gains(direct.bank.lure, direct.bank.masks)
        masks = direct.bank.masks[:, None, :]
        L = size / plant.droop.tau[:, None] * rng.uniform(-1.0, 1.0, gains.L.shape) * masks
        K = (0.6 * gains.K + 0.05 * rng.uniform(-1.0, 1.0, gains.K.shape)) * masks
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0, gains=banks.Gains(L, K))
        street = Street(plant, rng, extreme=True)
        state, answers = watch(street, design, 40)
        assert answers[-1][1].decision is Decision.CLEAN
        state, _ = watch(street, design, 6, state=state, lies={2: 0.2})
        state, _ = watch(street, design, 6, state=state, lies={2: -5.0}, silent=(0, 4))
        state, _ = watch(street, design, 4, state=state, silent=(0, 1, 2, 3), sound=False)
        state, _ = watch(street, design, 10, state=state, sound=False)
        watch(street, design, 10, state=state)

    def test_gains_by_matrix_inequality(self) -> None:
        """A whole bank designed by the corrected (12), watching the same street."""
        rng = np.random.default_rng(46)
        plant = make_plant(rng, customers=4, drop=0.02, presets=("ieee1547-b",))
        lure = exact_bank.design(plant, max_attacked=1, step_s=1.0).bank.lure
        model = plant.feeder.linear()
        options = {"rate": 0.05, "noise": 5e-4, "load": 2.0 * np.hstack([model.R * 6e-3, model.X * 2e-3])}
        masks = banks.subsets(4, 1, most=100).masks()
        designs = [circle(lure, np.flatnonzero(mask), **options) for mask in masks]
        L, K = stacked(designs, 4)
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0, gains=banks.Gains(L, K))
        street = Street(plant, rng)
        state, answers = watch(street, design, 60)
        assert answers[-1][1].decision is Decision.CLEAN
        _, answers = watch(street, design, 4, state=state, lies={1: -0.05})
        assert answers[-1][1].suspects.tolist() == [False, True, False, False]

    def test_gains_beyond_the_small_gain_condition(self) -> None:
        plant = make_plant(np.random.default_rng(47), customers=3, drop=0.03)
        lure = exact_bank.design(plant, max_attacked=1, step_s=1.0).bank.lure
        gains = banks.direct_gains(lure, banks.subsets(3, 1, most=100).masks())
        with refused(DesignInfeasible, "unstable"):
            exact_bank.design(plant, max_attacked=1, step_s=1.0, gains=banks.Gains(gains.L, 1e4 * gains.K))

    def test_certificate_by_solver_where_no_closed_form_applies(self) -> None:
        """Time constants 40 times apart and a loop gain above 1."""
        rng = np.random.default_rng(4)
        plant = make_plant(rng, customers=7, drop=0.4)
        droop = plant.droop
        tau = np.where(np.arange(7) % 2 == 0, 0.5, 20.0)
        plant = replace(plant, droop=Droop(droop.customer, droop.v, droop.q, tau, droop.vbar))
        with refused(DesignInfeasible, "no-certificate"):
            certify(close_loop(plant.feeder, plant.droop, plant.meters))
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0)
        assert design.certificate.kind == "lmi"
        watch(Street(plant, rng, load_kw=0.5), design, 20)

    @pytest.mark.acceptance
    @settings(max_examples=15)
    @given(seed=st.integers(0, 2**32 - 1), h=st.sampled_from([1.0, 10.0, 50.0]))
    def test_time_constants_from_a_millisecond_to_days(self, seed: int, h: float) -> None:
        """Inverters far faster than the step are slowed down in the observers; the bounds know that."""
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, drop=0.04)
        old = plant.droop
        tau = rng.permutation(np.resize([1e-3, 0.02, 0.7, 4.0, 200.0, 1e5], 9))
        plant = replace(plant, droop=Droop(old.customer, old.v, old.q, tau, old.vbar))
        design = exact_bank.design(plant, max_attacked=2, step_s=h)
        state, _ = watch(Street(plant, rng, extreme=True, wobble=0.2), design, 25, h=h)
        assert state.bank is not None
        # No more than 14 (1 + loop gain) substeps, whatever the fastest inverter is.
        assert 0 < state.bank.prepared.substeps <= 30

    def test_no_liar_allowed(self) -> None:
        rng = np.random.default_rng(43)
        plant = make_plant(rng, customers=3)
        design = exact_bank.design(plant, max_attacked=0, step_s=1.0)
        street = Street(plant, rng)
        state, answers = watch(street, design, 30)
        assert answers[-1][1].decision is Decision.CLEAN
        _, answers = watch(street, design, 3, state=state, lies={0: 0.1}, sound=False)
        assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS

    def test_options_decide(self) -> None:
        rng = np.random.default_rng(44)
        plant = make_plant(rng)
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0, options=Options(confirm=4, release=1))
        street = Street(plant, rng)
        state, _ = watch(street, design, 30)
        state, answers = watch(street, design, 6, state=state, lies={1: 0.1})
        assert [bool(verdict.suspects[1]) for _, verdict in answers] == [False] * 3 + [True] * 3
        _, answers = watch(street, design, 1, state=state)
        assert not answers[0][1].suspects.any()

    def test_same_numbers_from_the_same_inputs(self) -> None:
        """No clock, no hidden state: a step can be repeated from any kept state."""
        rng = np.random.default_rng(45)
        plant = make_plant(rng)
        design = exact_bank.design(plant, max_attacked=1, step_s=1.0)
        street = Street(plant, rng)
        state, _ = watch(street, design, 10)
        street.advance(1.0)
        frame = street.frame({3: 0.04}, (5,))
        first, second = exact_bank.step(design, state, frame), exact_bank.step(design, state, frame)
        assert np.array_equal(first[1].v2, second[1].v2)
        assert np.array_equal(first[2].threshold, second[2].threshold)
