"""The busbar's own meter: judged by all others, named where it lies, and believed again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gridsec.estimators import sequential
from gridsec.estimators.sequential import SequentialDesign
from gridsec.estimators.sequential.device_checks import (
    BusbarTest,
    BusbarTrust,
    HonestErrors,
    contradicted_phases,
    explained_phases,
    track_busbar,
    trusted_busbar,
)
from gridsec.estimators.sequential.measurements import PowerErrors
from gridsec.estimators.sequential.output import explanations_sentence
from gridsec.estimators.sequential.posterior import condition, leave_one_out, voltage_prior
from gridsec.grid.devices import busbar_error
from gridsec.interface import Cause, Decision, Explanation, Frame
from tests.gridsec.estimators.sequential.test_monitor import Answers, prepare, watch
from tests.gridsec.estimators.sequential.test_phases import apart
from tests.gridsec.street import Street, make_plant

CUSTOMERS = 12


def street(seed: int) -> tuple[Street, SequentialDesign]:
    rng = np.random.default_rng(seed)
    plant = make_plant(rng, customers=CUSTOMERS, drop=0.03)
    return Street(plant, rng), prepare(plant)


def reads(part: float, phase: int = 0) -> Callable[[Frame], Frame]:
    """The busbar's meter, or that of one phase, reads so much too much."""

    def change(frame: Frame) -> Frame:
        if frame.v0_phases is None:
            return replace(frame, v0_squared=frame.v0_squared * (1.0 + part) ** 2)
        factor = np.where(np.arange(3) == phase, (1.0 + part) ** 2, 1.0)
        return replace(frame, v0_phases=frame.v0_phases * factor)

    return change


def errors(street: Street, answers: Answers) -> float:
    """Error of the last answer's voltages, parts of them."""
    estimate = answers[-1][0]
    return float(np.abs(np.sqrt(estimate.v2_bus) - street.voltages()).max())


class TestOneMore:
    """The busbar is one more meter, that reads what all others have in common."""

    def setup_method(self) -> None:
        rng = np.random.default_rng(2)
        self.design = prepare(make_plant(rng, customers=CUSTOMERS, drop=0.03))
        self.m = 0.004 * rng.normal(size=CUSTOMERS)
        self.noise = self.design.white + self.design.fixed

    def sigmas(self, m: np.ndarray) -> float:
        """By generalised least squares: what the meters say of the busbar, and what it says itself."""
        design = self.design
        alone = voltage_prior(
            design.plant.feeder,
            design.prior.meters,
            design.doubt,
            busbar=0.0,
            inverters=design.injections,
        )
        inverse = np.linalg.inv(alone.between + np.diag(self.noise))
        precision = float(inverse.sum())
        said = float(inverse.sum(axis=0) @ m) / precision
        return said / np.sqrt(1.0 / precision + design.busbar**2)

    def test_its_residual_is_that_of_leaving_it_out(self) -> None:
        every, nothing = np.ones(CUSTOMERS, dtype=np.bool_), np.zeros(CUSTOMERS)
        now = condition(self.design.prior, self.noise, every)
        shift = np.ones(CUSTOMERS)
        # Move all readings until exactly that many standard deviations are reached.
        slope = self.sigmas(self.m + shift) - self.sigmas(self.m)
        for limit in self.design.sigmas:
            at = (limit - self.sigmas(self.m)) / slope
            for part, expected in ((1.0 - 1e-6, []), (1.0 + 1e-6, [0])):
                loo = leave_one_out(now, self.m + part * at * shift)
                assert (
                    contradicted_phases(self.design, BusbarTest(limit, nothing, metered=True), now, loo)
                    == expected
                )
                assert (
                    contradicted_phases(self.design, BusbarTest(limit, nothing, metered=False), now, loo)
                    == []
                )
            # What the model may be off comes on top.
            loo = leave_one_out(now, self.m + 1.001 * at * shift)
            assert (
                contradicted_phases(self.design, BusbarTest(limit, nothing + 1e-3, metered=True), now, loo)
                == []
            )

    def test_the_model_may_be_off_in_the_direction_that_says_most(self) -> None:
        """Weights of good meters differ in sign; a model that is off with them is no busbar that lies."""
        now = condition(self.design.prior, self.design.white, np.ones(CUSTOMERS, dtype=np.bool_))
        weights, off = now.Q.sum(axis=0), 1e-3
        assert (weights < 0.0).any()
        shift = 0.999 * self.design.sigmas[0] / np.sqrt(weights.sum())
        loo = leave_one_out(now, shift + off * np.sign(weights))
        doubt = BusbarTest(self.design.sigmas[0], np.full(CUSTOMERS, off), np.ones(1, dtype=np.bool_))
        assert contradicted_phases(self.design, doubt, now, loo) == []

    @pytest.mark.parametrize("active", [True, False])
    def test_errors_of_powers_at_their_ends_explain_what_they_can_and_no_more(self, active: bool) -> None:
        """By the matrices of the linear model: all that errs does so in the worst direction."""
        design, rng = self.design, np.random.default_rng(8)
        plant, model = design.plant, design.plant.feeder.linear()
        every, none = np.ones(CUSTOMERS, dtype=np.bool_), np.zeros(CUSTOMERS, dtype=np.bool_)
        now, fixed = condition(design.prior, self.noise, every), rng.uniform(0.0, 1e-3, CUSTOMERS)
        errors, nothing = rng.uniform(0.01, 0.05, CUSTOMERS), np.zeros(CUSTOMERS)
        frame = Street(plant, rng).frame()
        p_error, q_error = (errors, nothing) if active else (nothing, errors)
        frame = replace(frame, p_error=p_error, q_error=q_error)
        powers = PowerErrors(frame, frame.q, none, frame.v0_squared, every, design.faults.std)
        honest = HonestErrors(powers, np.zeros(plant.droop.tau.size))
        v = now.Q.sum(axis=0) / now.Q.sum()
        moved = 2.0 * (model.R_bus if active else model.X_bus)[design.prior.meters]
        room = np.abs(v) @ (fixed + design.sigmas[0] * np.sqrt(design.white)) + np.abs(v @ moved) @ errors
        room += busbar_error(plant.accuracy, float(frame.v0_squared), design.sigmas[0])
        for part, explained in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
            m = np.full(CUSTOMERS, part * room)
            assert explained_phases(design, now, m, fixed, honest).tolist() == [explained]

    def test_nobody_trusted_contradicts_nobody(self) -> None:
        no_meters = np.zeros(CUSTOMERS, dtype=np.bool_)
        now = condition(self.design.prior, self.noise, no_meters)
        loo, doubt = leave_one_out(now, self.m + 1.0), BusbarTest(3.0, np.zeros(CUSTOMERS), metered=True)
        assert contradicted_phases(self.design, doubt, now, loo) == []


class TestStreets:
    @pytest.mark.canary("-0.03")
    @pytest.mark.parametrize("part", [0.03, -0.03, 0.012])
    def test_it_is_named_and_nobody_else_and_believed_again(self, part: float) -> None:
        road, design = street(1)
        state, _ = watch(road, design, 30)
        state, answers = watch(road, design, 40, state=state, change=reads(part))
        verdicts = [verdict for _, verdict in answers]
        assert not any(verdict.suspects.any() or verdict.inverters.any() for verdict in verdicts)
        first = next(k for k, verdict in enumerate(verdicts) if verdict.busbar.any())
        assert first <= 3
        # Before it is named nothing is said to be clean.
        assert all(verdict.decision is Decision.UNDECIDED for verdict in verdicts[:first])
        assert all(verdict.decision is Decision.ATTACKED for verdict in verdicts[first:])
        assert verdicts[-1].cause is Cause.RESIDUALS
        assert verdicts[-1].reason.startswith("Manipulated: the meter of the busbar; it reads ")
        assert verdicts[-1].busbar_attack[0] == pytest.approx(2.0 * part, rel=0.25)
        assert errors(road, answers) < 0.004
        state, answers = watch(road, design, 100, state=state)
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert answers[-1][1].decision is Decision.CLEAN
        assert not answers[-1][1].busbar.any()
        assert state.busbar.trusted.all()

    def test_beside_as_many_liars_as_can_be_told_apart(self) -> None:
        road, design = street(3)
        state, _ = watch(road, design, 30)
        lies = {1: 0.03, 4: -0.03, 6: 0.03, 9: -0.03}
        state, answers = watch(road, design, 30, state=state, lies=lies, change=reads(-0.03))
        verdict = answers[-1][1]
        assert np.flatnonzero(verdict.suspects).tolist() == list(lies)
        assert verdict.busbar.all()
        assert verdict.reason.endswith("; and the meter of the busbar.")
        assert not any(np.delete(verdict.suspects, list(lies)).any() for _, verdict in answers)

    @pytest.mark.canary("0.015")
    @pytest.mark.parametrize("part", [0.03, 0.015])
    def test_many_who_lie_alike_do_not_make_it_a_liar(self, part: float) -> None:
        road, design = street(5)
        state, _ = watch(road, design, 30)
        _, answers = watch(road, design, 70, state=state, lies=dict.fromkeys((0, 3, 7, 10), part))
        assert not any(verdict.busbar.any() for _, verdict in answers)
        assert np.flatnonzero(answers[-1][1].suspects).tolist() == [0, 3, 7, 10]

    @pytest.mark.parametrize("seed", [0, 7])
    def test_meters_that_are_all_off_alike_within_their_class(self, seed: int) -> None:
        """They may be right and the busbar wrong, or the reverse: it is not named for that."""
        rng = np.random.default_rng(seed)
        plant = make_plant(rng, customers=CUSTOMERS, drop=0.03)
        _, answers = watch(Street(plant, rng, extreme=True), prepare(plant), 60)
        assert not any(verdict.busbar.any() or verdict.suspects.any() for _, verdict in answers)

    @pytest.mark.parametrize("part", [0.004, -0.004])
    def test_what_honest_errors_explain_that_are_all_alike_accuses_nobody(self, part: float) -> None:
        road, design = street(7)
        state, _ = watch(road, design, 30)
        state, answers = watch(road, design, 90, state=state, change=reads(part))
        assert not any(verdict.busbar.any() or verdict.suspects.any() for _, verdict in answers)
        assert errors(road, answers) < 0.005

    def test_it_stays_named_as_long_as_it_lies(self) -> None:
        road, design = street(7)
        state, _ = watch(road, design, 30)
        state, answers = watch(road, design, 200, state=state, change=reads(0.015))
        named = np.array([verdict.busbar.any() for _, verdict in answers])
        assert int(named.argmax()) <= 3
        assert named[3:].all()

    def test_silence_does_not_hide_it(self) -> None:
        road, design = street(8)
        state, _ = watch(road, design, 30)
        _, answers = watch(road, design, 20, state=state, silent=(3,), change=reads(0.03))
        assert answers[-1][1].decision is Decision.ATTACKED
        assert answers[-1][1].busbar.all()

    def test_one_that_is_lost_while_it_lies_is_no_proof_of_honesty(self) -> None:
        road, design = street(9)
        state, _ = watch(road, design, 30)
        state, _ = watch(road, design, 20, state=state, change=reads(0.03))

        def lost(frame: Frame) -> Frame:
            return replace(frame, v0_squared=np.nan)

        state, answers = watch(road, design, 80, state=state, change=lost)
        assert answers[-1][1].busbar.all()
        _, answers = watch(road, design, 20, state=state, change=reads(0.03))
        assert all(verdict.busbar.all() for _, verdict in answers)

    def test_one_that_lies_from_the_first_frame_on(self) -> None:
        road, design = street(11)
        _, answers = watch(road, design, 60, change=reads(0.03))
        assert answers[-1][1].busbar.all()
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert errors(road, answers) < 0.004


class TestPhases:
    @pytest.mark.parametrize("most", [3, 9])
    def test_the_phase_is_named(self, most: int) -> None:
        rng = np.random.default_rng(4)
        whole = apart(make_plant(rng, customers=9, drop=0.03, inverters=np.arange(0)))
        count = whole.meters.size
        doubt = sequential.LoadDoubt(np.full(count, 0.0003), np.full(count, 0.003), 600.0)
        design = sequential.design(whole, doubt=doubt, step_s=1.0, max_attacked=most)
        v0 = np.array([1.0, 1.02, 0.99])
        p, q = -0.01 * rng.random(count), np.zeros(count)
        v2 = whole.feeder.bus_voltages(p, q, v0**2, steps=3)[whole.feeder.bus]
        state, none, zero = sequential.init(design, 0.0), np.full(count, np.nan), np.zeros(count)
        for k in range(1, 60):
            y = v2 * (1.0 + 0.001 * rng.normal(size=count))
            frame = Frame(
                float(k), y, np.ones(count, bool), 1.0, p, zero, q, zero, none, none, v0_phases=v0**2
            )
            frame = reads(0.03, phase=1)(frame) if k > 20 else frame
            state, estimate, verdict = sequential.step(design, state, frame)
            assert not verdict.suspects.any()
        np.testing.assert_array_equal(verdict.busbar, [False, True, False])
        # All of a phase could lie alike where as many can be liars.
        assert verdict.decision is (Decision.ATTACKED if most == 3 else Decision.UNDECIDED)
        assert "the meter of the busbar (phase b)" in verdict.reason.lower()
        assert verdict.busbar_attack == pytest.approx([0.0, 1.02**2 * 0.0609, 0.0], rel=0.1)
        np.testing.assert_allclose(np.sqrt(estimate.v2_bus[:3]), v0, atol=2e-3)


class TestBelieving:
    """What a meter that is not believed says, against what the others say."""

    def played(self, says: np.ndarray, scale: int, heard: bool = True) -> list[BusbarTrust]:
        design = street(1)[1]
        now, out = trusted_busbar(1).suspect(0, scale), []
        for v0_squared in says:
            there = np.array([heard])
            now = track_busbar(design, now, np.array([v0_squared]), there, np.ones(1), np.full(1, 1e-6), 0.0)
            out.append(now)
        return out

    def test_it_takes_as_long_as_its_scale(self) -> None:
        for scale, ticks in ((0, 6), (2, 15), (3, 60)):
            out = self.played(np.full(100, 1.0001), scale)
            assert [one.trusted.all() for one in out].index(True) == ticks - 1
            assert not out[ticks].off.any()

    def test_what_it_said_before_is_forgotten_with_its_scale(self) -> None:
        says = np.concatenate([np.full(30, 1.06), np.ones(60)])
        out = self.played(says, 1)
        assert out[29].off[0] == pytest.approx(0.06)
        assert not out[30 + 5].trusted.all()
        assert out[-1].trusted.all()

    def test_once_is_not_enough_to_be_named(self) -> None:
        """A step that the meters hear of a tick later."""
        assert not any(one.named.any() for one in self.played(np.array([1.03, 1.0, 1.0, 1.0]), 0))
        twice = self.played(np.array([1.03, 1.03, 1.0, 1.0]), 0)
        assert [one.named.any() for one in twice] == [False, True, True, True]

    def test_silence_is_neither(self) -> None:
        assert not any(one.trusted.any() for one in self.played(np.ones(200), 0, heard=False))


def test_explanations_name_it() -> None:
    design = street(1)[1]
    no_meters, none = (
        np.zeros(CUSTOMERS, dtype=np.bool_),
        np.zeros(design.plant.droop.tau.size, dtype=np.bool_),
    )
    one = Explanation(no_meters, none, 0.7, busbar=np.ones(1, dtype=np.bool_))
    other = Explanation(np.arange(CUSTOMERS) == 2, none, 0.3, busbar=np.zeros(1, dtype=np.bool_))
    assert explanations_sentence(design, (one, other)) == (
        "Wrong are either the meter of the busbar or else the meter of c2; both explain the readings."
    )
