"""Windows of consistency against AC power flow, and their measures against observers run one by one."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from feeders.model.site import load, to_frame
from feeders.registry import choose, design
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate, snapshots
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.estimators import windowed
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.plant import Plant
from gridsec.estimators.windowed import LENGTH, LENGTHS, WindowedDesign
from gridsec.interface import Cause, Decision, Estimate, Verdict
from gridsec.secure.windows import Rule
from tests.codes import refused
from tests.gridsec.street import Street, make_plant
from tests.gridsec.watching import watcher

Answers = list[tuple[Estimate, Verdict]]

STEEP = "ieee1547-b"
LIES = {4: 0.1}


def make(
    seed: int, *, length: int = 10, most: int = 1, rule: Rule = "survivors", h: float = 1.0
) -> tuple[Plant, WindowedDesign, Street]:
    """A street of steep inverters whose loads pull all voltages onto the slopes of their curves."""
    rng = np.random.default_rng(seed)
    plant = make_plant(rng, drop=0.03, presets=(STEEP,))
    made = windowed.design(plant, max_attacked=most, step_s=h, length=length, rule=rule)
    return plant, made, Street(plant, rng)


watch = watcher(windowed, None)


@pytest.mark.acceptance
@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    lie=st.sampled_from([0.0, 0.01, -0.03, 0.06, 0.12]),
    h=st.sampled_from([1.0, 7.0, 900.0]),
    rule=st.sampled_from(["survivors", "majority"]),
    drop=st.sampled_from([0.01, 0.05]),
)
def test_nobody_honest_is_ever_named(seed: int, lie: float, h: float, rule: Rule, drop: float) -> None:
    """Errors at the ends of their intervals, up to two liars of any size, AC power flow as truth."""
    rng = np.random.default_rng(seed)
    plant = make_plant(rng, drop=drop, presets=(STEEP, "vde4105"))
    street = Street(plant, rng, extreme=True)
    made = windowed.design(plant, max_attacked=2, step_s=h, length=5, rule=rule)
    liars = rng.choice(9, 2, replace=False)
    lies = {int(j): lie * rng.choice([-1.0, 1.0]) for j in liars}
    state = windowed.init(made, street.t)
    for tick in range(25):
        told = lies if tick >= 15 else {}
        state, ((estimate, verdict),) = watch(street, made, 1, h=h, state=state, lies=told)
        assert set(np.flatnonzero(verdict.suspects)) <= set(told)
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()


def test_the_measures_are_those_of_observers_run_one_by_one() -> None:
    """Oracle: each estimate taken out of the bank alone, sets compared by their definition."""
    plant, made, street = make(3, most=2)
    state, _ = watch(street, made, 12)
    street.advance(1.0)
    state, _, _ = windowed.step(made, state, street.frame({2: 0.1, 5: -0.1}))
    chain, bound = made.chain, state.chain.bound
    assert state.chain.bank is not None
    masks = [frozenset(np.flatnonzero(mask).tolist()) for mask in chain.bank.masks]
    x = {J: banks.estimate(chain.bank, state.chain.bank, i) for i, J in enumerate(masks)}
    everyone = frozenset(range(9))
    x[everyone] = banks.estimate(chain.bank, state.chain.bank, -1)

    def apart(J: frozenset[int], S: frozenset[int]) -> float:
        worst = 0.0
        for i, customer in enumerate(plant.droop.customer):
            level = sum(bound.driven[i] if customer in each else bound.free[i] for each in (J, S))
            level += 2.0 * chain.options.tie * plant.droop.limit[i]
            worst = max(worst, abs(x[J][i] - x[S][i]) / level)
        return worst

    large = [frozenset(J) for J in combinations(range(9), 7)]
    pi, pi_sets = windowed.consistency(chain, state.chain.bank, bound)
    np.testing.assert_allclose(pi, max(apart(everyone, J) for J in large), rtol=1e-12)
    for J, mask, measured in zip(masks, chain.bank.masks, pi_sets, strict=False):
        assert len(J) == mask.sum() == 7
        expected = max(apart(J, frozenset(S)) for S in combinations(sorted(J), 5))
        np.testing.assert_allclose(measured, expected, rtol=1e-12)
    assert pi_sets.max() > 0.0


@pytest.mark.parametrize("rule", ["survivors", "majority"])
def test_a_window_names_the_liar_at_its_end(rule: Rule) -> None:
    _, made, street = make(1, length=10, rule=rule)
    state, answers = watch(street, made, 30)
    assert {verdict.decision for _, verdict in answers[9:]} <= {Decision.CLEAN, Decision.UNDECIDED}
    assert answers[-1][1].decision is Decision.CLEAN
    state, answers = watch(street, made, 20, state=state, lies=LIES)
    assert [bool(verdict.suspects[4]) for _, verdict in answers] == [False] * 9 + [True] * 11
    assert answers[-1][1].decision is Decision.ATTACKED
    _, answers = watch(street, made, 25, state=state)
    assert answers[-1][1].decision is Decision.CLEAN


@pytest.mark.canary("cigre-lv")
@pytest.mark.parametrize("feeder", ["cigre-lv", "simbench-lv-rural1"])
def test_exactly_the_liar_is_named_on_a_real_feeder(feeder: str) -> None:
    site = choose(load(feeder), estimator="windowed-bank")
    watcher = design(site)
    assert watcher.design.length == LENGTH == min(LENGTHS)
    (attack,) = attacks = random_attacks(site, 5, "bias", 1, 0.06, t_on=START + 60, t_off=START + 120)
    state = watcher.init(START)
    decisions: Counter[Decision] = Counter()
    scenario = Scenario(seed=5, duration_s=120, attacks=attacks)
    for k, snapshot in enumerate(snapshots(simulate(site, scenario))):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        decisions[verdict.decision] += 1
        named = np.flatnonzero(verdict.suspects).tolist()
        assert named == (attack.meters.tolist() if k >= 2 * LENGTH - 1 else [])
    assert decisions[Decision.ATTACKED] == 120 - 2 * LENGTH + 1
    assert decisions[Decision.CLEAN] == 60 - LENGTH + 1


@pytest.mark.acceptance
@pytest.mark.no_cover  # a long run of what other tests cover
def test_a_clean_hour_names_nobody() -> None:
    site = choose(load("cigre-lv"), estimator="windowed-bank")
    watcher = design(site)
    state = watcher.init(START)
    decisions: Counter[Decision] = Counter()
    for snapshot in snapshots(simulate(site, Scenario(seed=11, duration_s=3600))):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        decisions[verdict.decision] += 1
        assert not verdict.suspects.any()
    assert decisions[Decision.CLEAN] >= 3400


def test_lies_that_move_no_injection_are_undecided() -> None:
    """Beyond saturation every reading drives an inverter alike: no window sees it, residuals do."""
    _, made, street = make(2)
    street.v0 = 0.85
    street.rest()
    state, _ = watch(street, made, 30)
    _, answers = watch(street, made, 30, state=state, lies={4: -0.08})
    assert not any(verdict.suspects.any() for _, verdict in answers)
    assert {verdict.decision for _, verdict in answers[2:]} == {Decision.UNDECIDED}
    assert answers[-1][1].cause is Cause.AMBIGUOUS


def test_more_liars_than_assumed_are_undecided() -> None:
    _, made, street = make(5)
    state, _ = watch(street, made, 20)
    _, answers = watch(street, made, 20, state=state, lies={0: 0.1, 4: -0.1, 8: 0.12})
    assert {verdict.decision for _, verdict in answers} == {Decision.UNDECIDED}
    assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS


def test_silence_and_missing_busbar_are_undecided() -> None:
    _, made, street = make(6)
    state, _ = watch(street, made, 20)
    after, answers = watch(street, made, 3, state=state, silent=(2,))
    assert {verdict.cause for _, verdict in answers} == {Cause.SILENT_METERS}
    after, answers = watch(street, made, 7, state=after, silent=(0, 1, 2, 3, 4, 5, 6))
    assert {verdict.cause for _, verdict in answers} == {Cause.TOO_FEW_METERS}
    after, answers = watch(street, made, 3, state=after)
    assert Decision.CLEAN not in {verdict.decision for _, verdict in answers}
    _, answers = watch(street, made, 30, state=after)
    assert answers[-1][1].decision is Decision.CLEAN
    frame = replace(street.frame(), t=street.t + 1.0, v0_squared=np.nan)
    _, _, verdict = windowed.step(made, state, frame)
    assert verdict.cause is Cause.NO_BUSBAR


def test_a_liar_is_found_while_another_meter_is_silent() -> None:
    _, made, street = make(1)
    state, _ = watch(street, made, 20)
    _, answers = watch(street, made, 20, state=state, lies=LIES, silent=(7,))
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [4]


def test_readings_that_are_no_numbers_and_late_frames() -> None:
    _, made, street = make(1)
    start = windowed.init(made, street.t)
    same, _, verdict = windowed.step(made, start, replace(street.frame(), t=np.nan))
    assert same is start
    assert verdict.decision is Decision.UNDECIDED
    state, _ = watch(street, made, 20)
    state, answers = watch(street, made, 20, state=state, lies=LIES)
    late, estimate, verdict = windowed.step(made, state, replace(street.frame(), t=state.chain.t))
    assert late is state
    assert verdict.decision is Decision.UNDECIDED
    assert np.flatnonzero(verdict.suspects).tolist() == [4]
    np.testing.assert_array_equal(estimate.v2, answers[-1][0].v2)
    y = street.frame().y.copy()
    y[3], y[4] = np.nan, np.inf
    _, estimate, verdict = windowed.step(made, state, replace(street.frame(), t=street.t + 1.0, y=y))
    assert np.isfinite(estimate.v2).all()
    assert np.isfinite(verdict.attack).all()


def test_with_reported_reactive_power_the_liar_is_named_as_well() -> None:
    rng = np.random.default_rng(1)
    plant = make_plant(rng, drop=0.03, presets=(STEEP,))
    made = windowed.design(plant, max_attacked=1, step_s=1.0, length=10)
    street = Street(plant, rng, metered_q=np.arange(9))
    state, answers = watch(street, made, 30)
    assert answers[-1][1].decision is Decision.CLEAN
    _, answers = watch(street, made, 20, state=state, lies=LIES)
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [4]


def test_irregular_intervals_name_the_liar_as_well() -> None:
    _, made, street = make(1)
    state, _ = watch(street, made, 20)
    answers: Answers = []
    for h in (1.0, 30.0, 2.5, 900.0, 1.0) * 4:
        state, some = watch(street, made, 1, h=h, state=state, lies=LIES)
        answers += some
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [4]


def test_what_cannot_be_designed() -> None:
    rng = np.random.default_rng(0)
    plant = make_plant(rng)
    with refused(NotObservable, "too-few-meters"):
        windowed.design(plant, max_attacked=5, step_s=1.0)
    with refused(DesignInfeasible, "nothing-to-design"):
        windowed.design(plant, max_attacked=0, step_s=1.0)
    with refused(DesignInfeasible, "nothing-to-design"):
        windowed.design(make_plant(rng, inverters=np.array([], np.intp)), max_attacked=1, step_s=1.0)
    with refused(InputInvalid, "unknown-name"):
        windowed.design(plant, max_attacked=1, step_s=1.0, rule="vote")  # type: ignore[arg-type]
    with refused(InputInvalid, "out-of-range"):
        windowed.design(plant, max_attacked=1, step_s=1.0, length=0)
    assert windowed.design(plant, max_attacked=2, step_s=1.0).observers == 1 + 36 + 126
