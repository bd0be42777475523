"""The busbar's own meter: named by searches of the core, and trusted again by agreement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gridsec.estimators.front import LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalDesign
from gridsec.estimators.plant import NO_VOLTAGE
from gridsec.interface import Cause, Decision, Frame
from tests.gridsec.estimators.modal.streets import Answers, prepare, watch
from tests.gridsec.estimators.modal.test_phases import apart
from tests.gridsec.street import Street, make_plant

CUSTOMERS = 12


def make(seed: int) -> tuple[Street, ModalDesign]:
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


class TestStreets:
    @pytest.mark.canary("-0.03")
    @pytest.mark.parametrize("part", [0.03, -0.03, 0.012])
    def test_it_is_named_and_nobody_else_and_believed_again(self, part: float) -> None:
        road, design = make(1)
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
        assert state.front.busbar.trusted.all()

    def test_a_suspected_meter_bounds_no_voltage(self) -> None:
        """A bound by a false busbar voltage does not contain the truth; other readings bound none either."""
        road, design = make(1)
        state, answers = watch(road, design, 30)
        assert answers[-1][0].bound.max() < 0.1
        _, answers = watch(road, design, 3, state=state, change=reads(0.03))
        open_ = [estimate for estimate, verdict in answers if verdict.decision is Decision.UNDECIDED]
        assert open_
        assert all((estimate.bound == NO_VOLTAGE).all() for estimate in open_)

    def test_beside_as_many_liars_as_can_be_told_apart(self) -> None:
        road, design = make(3)
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
        road, design = make(5)
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

    @pytest.mark.canary("0.004")
    @pytest.mark.parametrize("part", [0.004, -0.004])
    def test_a_step_within_the_classes_of_the_meters_is_its_own(self, part: float) -> None:
        road, design = make(7)
        state, _ = watch(road, design, 30)
        state, answers = watch(road, design, 90, state=state, change=reads(part))
        assert all(verdict.decision is not Decision.CLEAN for _, verdict in answers)
        assert all(verdict.busbar.all() for _, verdict in answers[3:])
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert errors(road, answers) < 0.005

    def test_it_stays_named_as_long_as_it_lies(self) -> None:
        road, design = make(7)
        state, _ = watch(road, design, 30)
        state, answers = watch(road, design, 200, state=state, change=reads(0.015))
        named = np.array([verdict.busbar.any() for _, verdict in answers])
        assert int(named.argmax()) <= 3
        assert named[3:].all()

    def test_silence_does_not_hide_it(self) -> None:
        road, design = make(8)
        state, _ = watch(road, design, 30)
        _, answers = watch(road, design, 20, state=state, silent=(3,), change=reads(0.03))
        assert answers[-1][1].decision is Decision.ATTACKED
        assert answers[-1][1].busbar.all()

    def test_one_that_is_lost_while_it_lies_is_no_proof_of_honesty(self) -> None:
        road, design = make(9)
        state, _ = watch(road, design, 30)
        state, _ = watch(road, design, 20, state=state, change=reads(0.03))

        def lost(frame: Frame) -> Frame:
            return replace(frame, v0_squared=np.nan)

        state, answers = watch(road, design, 80, state=state, change=lost)
        assert answers[-1][1].busbar.all()
        _, answers = watch(road, design, 20, state=state, change=reads(0.03))
        assert all(verdict.busbar.all() for _, verdict in answers)

    @pytest.mark.canary("6--1.0")
    @pytest.mark.parametrize(("seed", "sign"), [(6, -1.0), (7, 1.0), (11, 1.0), (14, 1.0)], ids="{}".format)
    def test_one_that_lies_from_the_first_frame_on(self, seed: int, sign: float) -> None:
        """Fixed errors learned beside it, and their record, are given up."""
        road, design = make(seed)
        state, answers = watch(road, design, 80, change=reads(0.03 * sign))
        assert answers[-1][1].busbar.all()
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert state.kept is None
        assert not monitor.to_arrays(design, state.commission).keys() & {"filter.b"}
        assert errors(road, answers) < 0.006
        own = monitor.own_errors(design, state.core)
        assert np.abs(own - 2.0 * road.bias).max() < 0.01

    def test_a_record_of_before_outlasts_one_that_lies_soon_after_a_restart(self) -> None:
        road, design = make(1)
        state, _ = watch(road, design, 300)
        learned = monitor.to_arrays(design, state.commission)
        state = monitor.init(design, road.t, monitor.from_arrays(design, learned))
        state, _ = watch(road, design, 4, state=state)
        state, answers = watch(road, design, 20, state=state, change=reads(0.03))
        assert answers[-1][1].busbar.all()
        assert state.kept is not None
        now = monitor.to_arrays(design, state.commission)
        np.testing.assert_allclose(now["filter.b"], learned["filter.b"], rtol=1e-9)
        assert errors(road, answers) < 0.004


class TestPhases:
    @pytest.mark.canary("3")
    @pytest.mark.parametrize("most", [3, 9])
    def test_the_phase_is_named(self, most: int) -> None:
        rng = np.random.default_rng(4)
        whole = apart(make_plant(rng, customers=9, drop=0.03, inverters=np.arange(0)))
        count = whole.meters.size
        doubt = LoadDoubt(np.full(count, 0.0003), np.full(count, 0.003), 600.0)
        design = monitor.design(whole, doubt=doubt, step_s=1.0, max_attacked=most)
        v0 = np.array([1.0, 1.02, 0.99])
        p, q = -0.01 * rng.random(count), np.zeros(count)
        v2 = whole.feeder.bus_voltages(p, q, v0**2, steps=3)[whole.feeder.bus]
        state, none, zero = monitor.init(design, 0.0), np.full(count, np.nan), np.zeros(count)
        for k in range(1, 60):
            y = v2 * (1.0 + 0.001 * rng.normal(size=count))
            frame = Frame(
                float(k), y, np.ones(count, bool), 1.0, p, zero, q, zero, none, none, v0_phases=v0**2
            )
            frame = reads(0.03, phase=1)(frame) if k > 20 else frame
            state, estimate, verdict = monitor.step(design, state, frame)
            assert not verdict.suspects.any()
        # All of a phase could lie alike where as many can be liars: its meter is suspect then, and not named.
        np.testing.assert_array_equal(verdict.busbar, [False, most == 3, False])
        assert verdict.decision is (Decision.ATTACKED if most == 3 else Decision.UNDECIDED)
        assert "the meter of the busbar (phase b)" in verdict.reason.lower()
        if most != 3:
            return
        assert verdict.busbar_attack == pytest.approx([0.0, 1.02**2 * 0.0609, 0.0], rel=0.1)
        np.testing.assert_allclose(np.sqrt(estimate.v2_bus[:3]), v0, atol=2e-3)
