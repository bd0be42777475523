"""Partial observers on a feeder: against AC power flow, meters with flaws, liars, silence and bad frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.model.site import load, plant, to_frame
from feeders.registry import FAMILIES, choose, design
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate, snapshots
from gridsec.arrays import Ints
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators import detection, partial
from gridsec.estimators import partial as partial_observers
from gridsec.estimators.partial import PartialDesign, PartialState
from gridsec.estimators.plant import PreviousStep, clean
from gridsec.interface import Cause, Decision, Estimate, Frame, Verdict
from gridsec.observers import circle
from tests.codes import refused
from tests.gridsec.street import Street, make_plant
from tests.gridsec.watching import watcher

SMALL, RURAL = "cigre-lv", "simbench-lv-rural1"
Answers = list[tuple[Estimate, Verdict]]


# A meter that lied before may still be named until it has been honest for a while.
watch = watcher(
    partial, lambda _, state, verdict, honest: (verdict.suspects & (state.tally.below == 0))[honest]
)


def made_for(street_plant: object, most: int = 1, h: float = 1.0) -> PartialDesign:
    return partial.design(street_plant, max_attacked=most, step_s=h)  # type: ignore[arg-type]


class TestStreets:
    @pytest.mark.acceptance
    @settings(max_examples=25, deadline=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        drop=st.sampled_from([0.005, 0.02, 0.06]),
        h=st.sampled_from([0.5, 1.0, 5.0, 900.0]),
        inverters=st.sampled_from([0, 3, 9]),
        told=st.booleans(),
    )
    def test_worst_case_errors_name_nobody(
        self, seed: int, drop: float, h: float, inverters: int, told: bool
    ) -> None:
        """Meters at the ends of their classes, loads at the ends of their intervals: inside all bounds."""
        rng = np.random.default_rng(seed)
        own = np.sort(rng.choice(9, inverters, replace=False))
        street_plant = make_plant(rng, drop=drop, inverters=own)
        street = Street(street_plant, rng, extreme=True, metered_q=np.arange(0, 9, 2) if told else None)
        # Half a minute at least: the slowest inverters have not forgotten their start in a quarter.
        _, answers = watch(street, made_for(street_plant, 1, h), 60 if h < 1.0 else 30, h=h)
        assert not any(verdict.suspects.any() for _, verdict in answers)
        assert answers[-1][1].decision is Decision.CLEAN

    @settings(max_examples=15, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1), h=st.sampled_from([1.0, 900.0]), most=st.integers(1, 2))
    def test_liars_are_named_and_nobody_else(self, seed: int, h: float, most: int) -> None:
        rng = np.random.default_rng(seed)
        street_plant = make_plant(rng)
        street = Street(street_plant, rng, extreme=bool(rng.integers(2)))
        liars = sorted(int(j) for j in rng.choice(9, most, replace=False))
        made = made_for(street_plant, most, h)
        state, _ = watch(street, made, 10, h=h)
        lies = {j: float(rng.choice([-0.08, 0.08])) for j in liars}
        _, answers = watch(street, made, 4, h=h, state=state, lies=lies)
        assert answers[0][1].decision is Decision.UNDECIDED
        for estimate, verdict in answers[1:]:
            assert np.flatnonzero(verdict.suspects).tolist() == liars
            assert verdict.decision is Decision.ATTACKED
            at = street_plant.meters[liars]
            lie = np.array([lies[j] for j in liars])
            expected = ((1.0 + lie) ** 2 - 1.0) * estimate.v2[at]
            np.testing.assert_allclose(verdict.attack[liars], expected, atol=0.02)

    @settings(max_examples=10, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.002, 0.03))
    def test_small_lies_never_make_an_honest_meter_named(self, seed: int, size: float) -> None:
        """Two neighbours lie together, by any amount: the bound holds, and no honest meter is named."""
        rng = np.random.default_rng(seed)
        street_plant = make_plant(rng)
        street = Street(street_plant, rng, extreme=True)
        made = made_for(street_plant, 2)
        state, _ = watch(street, made, 5)
        first = int(rng.integers(8))
        _, answers = watch(street, made, 10, state=state, lies={first: size, first + 1: size})
        honest = np.setdiff1d(np.arange(9), [first, first + 1])
        assert not any(verdict.suspects[honest].any() for _, verdict in answers)

    def test_more_liars_than_allowed_are_undecided(self) -> None:
        rng = np.random.default_rng(5)
        street_plant = make_plant(rng)
        street = Street(street_plant, rng)
        made = made_for(street_plant, 1)
        state, _ = watch(street, made, 10)
        _, answers = watch(street, made, 5, state=state, lies={0: 0.1, 4: -0.1, 7: 0.08}, sound=False)
        assert {verdict.decision for _, verdict in answers} == {Decision.UNDECIDED}
        assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS
        truth = street.truth()
        assert (np.abs(answers[-1][0].v2 - truth) <= answers[-1][0].bound).all()

    def test_a_named_meter_is_cleared_and_silence_clears_nobody(self) -> None:
        rng = np.random.default_rng(6)
        street_plant = make_plant(rng)
        street, made = Street(street_plant, rng), made_for(street_plant, 1)
        state, _ = watch(street, made, 10)
        state, answers = watch(street, made, 3, state=state, lies={3: 0.08})
        assert answers[-1][1].suspects[3]
        state, answers = watch(street, made, 8, state=state, silent=(3,), sound=False)
        assert answers[-1][1].suspects[3]
        state, answers = watch(street, made, made.setting.options.release, state=state, sound=False)
        assert not answers[-1][1].suspects.any()
        assert answers[-1][1].decision is Decision.CLEAN

    def test_without_liars_allowed_a_lie_is_too_many(self) -> None:
        rng = np.random.default_rng(7)
        street_plant = make_plant(rng)
        street, made = Street(street_plant, rng), made_for(street_plant, 0)
        state, answers = watch(street, made, 10)
        assert answers[-1][1].decision is Decision.CLEAN
        _, answers = watch(street, made, 4, state=state, lies={2: 0.08}, sound=False)
        assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS


class TestBadFrames:
    @staticmethod
    def settled(most: int = 1) -> tuple[Street, PartialDesign, PartialState]:
        rng = np.random.default_rng(8)
        street_plant = make_plant(rng)
        street, made = Street(street_plant, rng), made_for(street_plant, most)
        state, answers = watch(street, made, 15)
        assert answers[-1][1].decision is Decision.CLEAN
        return street, made, state

    def test_silent_meters_are_undecided(self) -> None:
        street, made, state = self.settled()
        state, answers = watch(street, made, 3, state=state, silent=(2, 5))
        assert {verdict.cause for _, verdict in answers} == {Cause.SILENT_METERS}
        _, answers = watch(street, made, 3, state=state)
        assert answers[-1][1].decision is Decision.CLEAN

    def test_too_few_meters(self) -> None:
        street, made, state = self.settled(2)
        _, answers = watch(street, made, 3, state=state, silent=(0, 1, 2, 3, 4))
        assert {verdict.cause for _, verdict in answers} == {Cause.TOO_FEW_METERS}
        _, answers = watch(street, made, 3, state=state, silent=tuple(range(9)))
        assert {verdict.cause for _, verdict in answers} == {Cause.TOO_FEW_METERS}

    def test_a_frame_that_is_not_later_changes_nothing(self) -> None:
        street, made, state = self.settled()
        fresh = partial.init(made, 0.0)
        for t in (street.t, street.t - 5.0, np.nan, np.inf):
            frame = replace(street.frame({1: 0.2}), t=t)
            after, estimate, verdict = partial.step(made, state, frame)
            assert after is state
            assert verdict.decision is Decision.UNDECIDED
            assert state.last is not None
            assert estimate is state.last[0]
        after, _, verdict = partial.step(made, fresh, replace(street.frame(), t=np.nan))
        assert after is fresh
        assert verdict.decision is Decision.UNDECIDED

    def test_without_a_busbar_voltage(self) -> None:
        street, made, state = self.settled()
        state, answers = watch(
            street, made, 3, state=state, change=lambda frame: replace(frame, v0_squared=np.nan)
        )
        assert {verdict.cause for _, verdict in answers} == {Cause.NO_BUSBAR}
        _, answers = watch(street, made, 3, state=state)
        assert answers[-1][1].decision is Decision.CLEAN

    def test_readings_that_are_no_numbers_count_as_silent(self) -> None:
        street, made, state = self.settled()

        def spoil(frame: Frame) -> Frame:
            return replace(frame, y=np.where(np.arange(9) == 4, np.nan, frame.y))

        _, answers = watch(street, made, 2, state=state, change=spoil)
        assert {verdict.cause for _, verdict in answers} == {Cause.SILENT_METERS}

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("y", 1e300),
            ("y", -1e300),
            ("y", 0.0),
            ("p", 1e6),
            ("p_error", 1e6),
            ("p_error", np.inf),
            ("q_error", 1e200),
            ("v0_squared", 0.0),
            ("v0_squared", 1e300),
        ],
    )
    def test_a_step_never_raises_and_nonsense_is_never_clean(self, field: str, value: float) -> None:
        street, made, state = self.settled()
        street.advance(1.0)
        frame = street.frame()
        whole = value if field == "v0_squared" else np.full(9, value)
        _, estimate, verdict = partial.step(made, state, replace(frame, **{field: whole}))
        for numbers in (estimate.v2, estimate.bound, verdict.threshold, verdict.score):
            assert np.isfinite(numbers).all()
        assert verdict.decision is Decision.UNDECIDED

    def test_a_metered_reactive_power_beyond_any_is_none(self) -> None:
        street, made, state = self.settled()
        street.advance(1.0)
        frame = street.frame()
        absurd, silent = (replace(frame, q_net=np.full(9, value)) for value in (1e300, np.nan))
        (_, one, said), (_, other, expected) = (partial.step(made, state, each) for each in (absurd, silent))
        np.testing.assert_array_equal(one.v2, other.v2)
        np.testing.assert_array_equal(one.bound, other.bound)
        assert said.decision is expected.decision

    @pytest.mark.parametrize("error", [np.nan, np.inf])
    def test_reactive_powers_without_a_known_error_are_not_used(self, error: float) -> None:
        street, made, state = self.settled()
        street.advance(1.0)
        frame = street.frame()
        told = replace(frame, q_net=np.full(9, 7.0), q_net_error=np.full(9, error))
        _, base, _ = partial.step(made, state, frame)
        _, other, verdict = partial.step(made, state, told)
        np.testing.assert_array_equal(base.v2, other.v2)
        assert verdict.decision is Decision.CLEAN

    @pytest.mark.parametrize("inverters", [np.arange(6), np.arange(9)])
    def test_a_wrong_reactive_power_names_its_meter_unless_an_inverter_may_inject_it(
        self, inverters: Ints
    ) -> None:
        rng = np.random.default_rng(14)
        street_plant = make_plant(rng, inverters=inverters)
        street = Street(street_plant, rng, metered_q=np.arange(9))
        made = made_for(street_plant)
        state, _ = watch(street, made, 10)

        def lie(frame: Frame) -> Frame:
            return replace(frame, q_net=frame.q_net + np.where(np.arange(9) == 6, 0.3, 0.0))

        _, answers = watch(street, made, 3, state=state, lies={6: 0.0}, change=lie)
        last = answers[-1][1]
        if 6 in inverters:
            assert not last.suspects.any()
            assert (last.decision, last.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
            assert last.reason.startswith("c6: the reactive power reported is off the inverter's curve")
        else:
            assert np.flatnonzero(last.suspects).tolist() == [6]
            assert last.decision is Decision.ATTACKED

    def test_a_silent_meter_has_exactly_no_influence(self) -> None:
        street, made, state = self.settled()
        street.advance(1.0)
        frame = street.frame(silent=(3,))
        base = partial.step(made, state, frame)
        for value in (np.nan, np.inf, -1.0, 1e300):
            told = replace(frame, y=np.where(np.arange(9) == 3, value, frame.y))
            other = partial.step(made, state, told)
            np.testing.assert_array_equal(other[1].v2, base[1].v2)
            np.testing.assert_array_equal(other[1].bound, base[1].bound)
            np.testing.assert_array_equal(other[0].parts.driven, base[0].parts.driven)

    def test_a_lie_spoils_its_own_observer_only(self) -> None:
        street, made, state = self.settled()
        street.advance(1.0)
        frame = street.frame()
        lied = replace(frame, y=frame.y * np.where(np.arange(9) == 3, 1.2, 1.0))
        honest, spoiled = (partial.step(made, state, f)[0].parts for f in (frame, lied))
        moved = honest.driven != spoiled.driven
        assert np.flatnonzero(moved).tolist() == [3]
        np.testing.assert_array_equal(honest.x, spoiled.x)
        np.testing.assert_array_equal(honest.bound.free, spoiled.bound.free)


class TestParts:
    @pytest.mark.parametrize("h", [0.5, 900.0])
    def test_the_scalar_observers_are_direct_injection_of_one_meter(self, h: float) -> None:
        """Oracle: the circle-criterion observer that trusts just that meter, inverter by inverter."""
        rng = np.random.default_rng(9)
        street_plant = make_plant(rng, drop=0.05)
        street, made = Street(street_plant, rng), made_for(street_plant, 1, h)
        state = partial.init(made, street.t)
        singles = [circle.design(made.model.lure, np.arange(9) == j) for j in range(9)]
        others: list[circle.CircleState] = []
        for _ in range(5):
            street.advance(h)
            frame = street.frame()
            before, (state, _, _) = state, partial.step(made, state, frame)
            past = PreviousStep(before.parts.x, before.v0_squared, before.tally.named)
            inputs = clean(made.setting, past, frame)
            if not others:
                others = [circle.init(one, frame.t, state.parts.driven) for one in singles]
                continue
            others = [
                circle.step(one, other, inputs.z, inputs.w, inputs.live, h)
                for one, other in zip(singles, others, strict=True)
            ]
            alone = np.array([other.x[j] for j, other in enumerate(others)])
            np.testing.assert_allclose(state.parts.driven, alone, atol=1e-9)

    def test_the_code_word_of_honest_meters_is_inside_its_box(self) -> None:
        """s = B xi + v with |xi| <= 1 and |v| <= 1, from the street's own truth."""
        rng = np.random.default_rng(10)
        street_plant = make_plant(rng, drop=0.03, inverters=np.arange(0, 9, 2))
        street = Street(street_plant, rng, extreme=True, metered_q=np.arange(9))
        made = made_for(street_plant)
        state, _ = watch(street, made, 10)
        street.advance(1.0)
        frame = street.frame()
        past = PreviousStep(state.parts.x, state.v0_squared, state.tally.named)
        inputs = clean(made.setting, past, frame)
        alone, model, parts, _ = partial_observers.observe(
            made.setting, made.model, state.parts, frame, inputs, 1.0
        )
        word = partial_observers.code_word(made.setting, parts, frame, inputs, alone, model)
        true_q = street.p * street.tan
        error = [street.x - parts.x, street.p - frame.p, true_q - frame.q, [street.v0**2 - frame.v0_squared]]
        xi = np.concatenate(error) / word.scale
        assert np.abs(xi).max() <= 1.0
        assert word.s.size == 9 + 5 + 4  # voltages, inverters, reactive powers of customers without one
        assert not partial_observers.disputed(made.setting, parts, frame, inputs).any()
        assert np.abs(word.s - word.B @ xi).max() <= 1.0 + 1e-9  # metered q sits at the very end
        assert (np.abs(street.truth() - model.v2 - word.voltage @ xi) <= word.rest).all()

    def test_the_papers_constants_promise_less_than_is_known_without_meters(self) -> None:
        rng = np.random.default_rng(11)
        street_plant = make_plant(rng)
        street, made = Street(street_plant, rng), made_for(street_plant)
        state, _ = watch(street, made, 10)
        street.advance(1.0)
        frame = street.frame()
        inputs = clean(made.setting, PreviousStep(state.parts.x, state.v0_squared, state.tally.named), frame)
        alone, model, parts, _ = partial_observers.observe(
            made.setting, made.model, state.parts, frame, inputs, 1.0
        )
        word = partial_observers.code_word(made.setting, parts, frame, inputs, alone, model)
        found = partial.constants(word, 9, 1, tol=1e-9)
        n = word.scale.size
        assert found.rho == pytest.approx(np.sqrt(7.0), rel=1e-6)
        assert found.kappa_c == pytest.approx((np.sqrt(8.0) + 1.0) * np.sqrt(7.0) / found.rho)
        # In the box |xi| <= sqrt(n) by itself.
        assert found.kappa_c * np.sqrt(n + 2.0) > 3.0 * np.sqrt(n)


class TestDesign:
    def test_too_few_meters_for_the_liars(self) -> None:
        with refused(NotObservable, "too-few-meters"):
            partial.design(plant(load(SMALL)), max_attacked=3, step_s=1.0)

    def test_too_much_work_for_the_interval(self) -> None:
        big = plant(load("kerber-vorstadtnetz"))
        with refused(DesignInfeasible, "too-many"):
            partial.design(big, max_attacked=1, step_s=1.0)
        assert partial.design(big, max_attacked=1, step_s=10.0).observers > 50

    @pytest.mark.parametrize("step_s", [0.0, -1.0, np.nan, np.inf])
    def test_wrong_calls(self, step_s: float) -> None:
        with refused(InputInvalid, "not-positive"):
            partial.design(plant(load(SMALL)), max_attacked=1, step_s=step_s)

    def test_meters_that_do_not_fit(self) -> None:
        of = plant(load(SMALL))
        twice = replace(of, meters=np.zeros(6, dtype=np.intp))
        with refused(InputInvalid, "duplicate"):
            partial.design(twice, max_attacked=1, step_s=1.0)
        with refused(InputInvalid, "shape"):
            partial.design(replace(of, meters=of.meters[:5]), max_attacked=1, step_s=1.0)

    def test_a_broken_certificate_is_not_believed(self) -> None:
        made = partial.design(plant(load(SMALL)), max_attacked=1, step_s=1.0)
        proof = made.model.certificate
        broken = replace(made, model=replace(made.model, certificate=replace(proof, P=-np.asarray(proof.P))))
        assert partial.init(made, 0.0).valid
        assert not partial.init(broken, 0.0).valid


class TestFeeders:
    @pytest.mark.canary("cigre-lv-0.06-5")
    @pytest.mark.parametrize(
        ("name", "size", "seed"), [(SMALL, 0.06, 5), (RURAL, -0.03, 1), (RURAL, 0.02, 2)]
    )
    def test_names_exactly_the_liar(self, name: str, size: float, seed: int) -> None:
        site = choose(load(name), estimator="partial-observers")
        finished = design(site)
        assert finished.family is FAMILIES["partial-observers"]
        assert "certificate" in finished.proof
        (attack,) = attacks = random_attacks(site, seed, "bias", 1, size, t_on=START + 30, t_off=START + 60)
        state = finished.init(START)
        decisions: Counter[Decision] = Counter()
        scenario = Scenario(seed=seed, duration_s=60, attacks=attacks)
        for k, snapshot in enumerate(snapshots(simulate(site, scenario))):
            state, _, verdict = finished.step(state, to_frame(site, snapshot))
            decisions[verdict.decision] += 1
            named = np.flatnonzero(verdict.suspects).tolist()
            assert named == (attack.meters.tolist() if k >= 31 else [])
        assert decisions[Decision.ATTACKED] == 29
        assert decisions[Decision.CLEAN] >= 20

    @pytest.mark.canary("900.0")
    @pytest.mark.parametrize("dt_s", [15.0, 900.0])
    def test_hours_without_liars(self, dt_s: float) -> None:
        """An hour every 15 s, half a day every quarter of an hour: nobody is named, and it settles."""
        site = load(RURAL)
        made = partial.design(plant(site), max_attacked=1, step_s=dt_s)
        state = partial.init(made, START)
        decisions = []
        scenario = Scenario(seed=3, dt_s=dt_s, duration_s=3600.0 if dt_s < 60.0 else 43_200.0)
        for sample in simulate(site, scenario):
            (snapshot,) = snapshots([sample])
            state, _, verdict = partial.step(made, state, to_frame(site, snapshot))
            assert not verdict.suspects.any()
            decisions.append(verdict.decision)
        assert Decision.ATTACKED not in decisions
        assert decisions[-1] is Decision.CLEAN
        assert decisions.count(Decision.CLEAN) > 0.9 * len(decisions)

    def test_irregular_intervals(self) -> None:
        rng = np.random.default_rng(12)
        street_plant = make_plant(rng)
        street, made = Street(street_plant, rng), made_for(street_plant)
        state = partial.init(made, street.t)
        for h in (1.0, 30.0, 1.0, 900.0, 3.0, 60.0, 1.0, 1.0, 900.0):
            state, answers = watch(street, made, 1, h=h, state=state)
            assert not answers[0][1].suspects.any()
        assert answers[0][1].decision is Decision.CLEAN
        state, answers = watch(street, made, 3, h=900.0, state=state, lies={4: -0.08})
        assert np.flatnonzero(answers[-1][1].suspects).tolist() == [4]


def test_bounds_shrink_as_observers_settle() -> None:
    """Each bound falls towards its level, never below an honest error: checked against the street's state."""
    rng = np.random.default_rng(13)
    street_plant = make_plant(rng, drop=0.04)
    street, made = Street(street_plant, rng, extreme=True, wobble=0.0), made_for(street_plant)
    street.x = street_plant.droop.limit * rng.choice([-1.0, 1.0], street.x.size)
    state = partial.init(made, street.t)
    sums = []
    for _ in range(20):
        state, _ = watch(street, made, 1, state=state)
        parts = state.parts
        assert (np.abs(street.x - parts.x) <= parts.bound.free).all()
        assert (np.abs(street.x - parts.driven) <= parts.bound.driven).all()
        sums.append(float(parts.bound.free.sum()))
    widest = detection.widest(made.setting.errors).free
    assert sums[0] <= widest.sum()
    assert all(late <= early * 1.05 for early, late in pairwise(sums))
    assert sums[-1] < 0.5 * sums[0]
