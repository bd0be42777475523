"""Set search against AC power flow: who is named, how wide the bounds are, and what it costs."""

from __future__ import annotations

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
from gridsec.estimators import set_search
from gridsec.estimators.plant import PreviousStep, clean
from gridsec.estimators.set_search import advance
from gridsec.interface import Cause, Decision
from tests.codes import refused
from tests.gridsec.street import Street, make_plant
from tests.gridsec.watching import watcher

watch = watcher(set_search, lambda _made, _state, verdict, honest: verdict.suspects[honest])


@pytest.mark.acceptance
@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    lie=st.sampled_from([0.0, 0.004, 0.012, -0.02, 0.03, -0.08]),
    h=st.sampled_from([1.0, 7.0, 900.0]),
    inverters=st.sampled_from([0, 4, 9]),
)
def test_nobody_honest_is_named_and_the_truth_is_within_the_bounds(
    seed: int, lie: float, h: float, inverters: int
) -> None:
    """Errors at the ends of their intervals, up to two liars of any size, AC power flow as truth."""
    rng = np.random.default_rng(seed)
    plant = make_plant(rng, inverters=np.sort(rng.choice(9, inverters, replace=False)))
    street = Street(plant, rng, extreme=True)
    made = set_search.design(plant, max_attacked=2, step_s=h)
    state, answers = watch(street, made, 20, h=h)
    assert answers[-1][1].decision is Decision.CLEAN
    liars = rng.choice(9, int(rng.integers(1, 3)), replace=False)
    watch(street, made, 12, h=h, state=state, lies={int(j): lie * rng.choice([-1.0, 1.0]) for j in liars})


@pytest.mark.parametrize("feeder", ["cigre-lv", "simbench-lv-rural1"])
def test_exactly_the_liar_is_named_and_readmitted(feeder: str) -> None:
    site = choose(load(feeder), estimator="set-search", max_attacked=1)
    watcher = design(site)
    assert watcher.observers == 1
    (attack,) = attacks = random_attacks(site, 5, "bias", 1, 0.04, t_on=START + 30, t_off=START + 60)
    state = watcher.init(START)
    seen: list[Decision] = []
    for k, snapshot in enumerate(snapshots(simulate(site, Scenario(seed=5, duration_s=90, attacks=attacks)))):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        seen.append(verdict.decision)
        if 31 <= k < 60:
            assert np.flatnonzero(verdict.suspects).tolist() == attack.meters.tolist()
        elif k < 31:
            assert not verdict.suspects.any()
    assert set(seen[31:60]) == {Decision.ATTACKED}
    assert seen[29] is Decision.CLEAN
    assert seen[-1] is Decision.CLEAN
    assert not state.dropped.any()


@pytest.mark.acceptance
@pytest.mark.no_cover  # a long run of what other tests cover
def test_a_clean_hour_names_nobody() -> None:
    site = choose(load("simbench-lv-rural1"), estimator="set-search", max_attacked=2)
    watcher = design(site)
    state = watcher.init(START)
    clean = 0
    for snapshot in snapshots(simulate(site, Scenario(seed=11, duration_s=3600))):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        assert not verdict.suspects.any()
        clean += verdict.decision is Decision.CLEAN
    assert clean >= 3590


def test_a_liar_is_believed_again_only_after_the_dwell() -> None:
    rng = np.random.default_rng(3)
    plant = make_plant(rng)
    made = set_search.design(plant, max_attacked=1, step_s=1.0, dwell_s=25.0)
    street = Street(plant, rng)
    state, _ = watch(street, made, 20)
    state, answers = watch(street, made, 10, state=state, lies={4: 0.06})
    assert answers[-1][1].suspects[4]
    dropped = []
    for _ in range(40):
        state, _ = watch(street, made, 1, state=state, sound=False)
        dropped.append(bool(state.dropped[4]))
    # Honest again with the first of these readings; 25 s have passed at the 26th.
    assert dropped == [True] * 25 + [False] * 15


def test_the_search_finds_what_brute_force_finds() -> None:
    """Oracle: every set tried by itself, its limit put together entry by entry from the feeder's matrices."""
    rng = np.random.default_rng(8)
    plant = make_plant(rng, inverters=np.array([0, 2, 3, 5, 8]))
    made = set_search.design(plant, max_attacked=2, step_s=1.0)
    street = Street(plant, rng)
    state, _ = watch(street, made, 20)
    lies = {2: 0.05, 6: -0.04}
    street.advance(1.0)
    frame = street.frame(lies)
    inputs = clean(made.setting, PreviousStep(state.x, state.v0_squared, state.tally.named), frame)
    view = advance(made, state, frame, inputs)
    found = set_search._search(made, inputs, view, state)
    X = made.setting.model.X
    passing = []
    for D in [c for k in (1, 2) for c in combinations(range(9), k)]:
        fits = True
        for j in set(range(9)) - set(D):
            off = view.base[j]
            for i, customer in enumerate(plant.droop.customer):
                known = view.state.sure[i] if customer not in D else made.errors.span[i]
                off += 2.0 * abs(X[j, customer]) * known
            v = np.sqrt(view.seen.v2[j] + off)
            accuracy = plant.accuracy
            e = accuracy.class_fraction[j] * v + accuracy.resolution[j] / 2 + 4.0 * accuracy.jitter[j]
            fits &= bool(abs(frame.y[j] - view.seen.v2[j]) <= off + e * (2.0 * v + e))
        if fits:
            passing.append(D)
    assert passing == [(2, 6)]
    assert np.flatnonzero(found.dropped).tolist() == [2, 6]
    assert np.flatnonzero(found.accused).tolist() == sorted(set.intersection(*map(set, passing)))


def test_one_observer_names_a_second_liar_while_the_first_goes_on() -> None:
    rng = np.random.default_rng(4)
    plant = make_plant(rng)
    made = set_search.design(plant, max_attacked=2, step_s=1.0)
    street = Street(plant, rng)
    state, _ = watch(street, made, 20)
    state, answers = watch(street, made, 10, state=state, lies={1: 0.05})
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [1]
    _, answers = watch(street, made, 10, state=state, lies={1: 0.05, 7: -0.05})
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [1, 7]
    assert all(verdict.suspects[1] for _, verdict in answers)


def test_more_liars_than_assumed_are_undecided() -> None:
    rng = np.random.default_rng(5)
    plant = make_plant(rng)
    made = set_search.design(plant, max_attacked=1, step_s=1.0)
    street = Street(plant, rng)
    state, _ = watch(street, made, 20)
    _, answers = watch(street, made, 10, state=state, lies={0: 0.06, 4: -0.06, 8: 0.07}, sound=False)
    assert {verdict.decision for _, verdict in answers} == {Decision.UNDECIDED}
    assert answers[-1][1].cause is Cause.TOO_MANY_SUSPECTS


def test_silence_and_missing_busbar_are_undecided() -> None:
    rng = np.random.default_rng(6)
    plant = make_plant(rng)
    made = set_search.design(plant, max_attacked=2, step_s=1.0)
    street = Street(plant, rng)
    state, _ = watch(street, made, 20)
    after, answers = watch(street, made, 3, state=state, silent=(2,))
    assert {verdict.cause for _, verdict in answers} == {Cause.SILENT_METERS}
    after, answers = watch(street, made, 3, state=after, silent=(0, 1, 2, 3, 4))
    assert {verdict.cause for _, verdict in answers} == {Cause.TOO_FEW_METERS}
    _, answers = watch(street, made, 20, state=after)
    assert answers[-1][1].decision is Decision.CLEAN
    frame = replace(street.frame(), t=street.t + 1.0, v0_squared=np.nan)
    _, estimate, verdict = set_search.step(made, state, frame)
    assert verdict.cause is Cause.NO_BUSBAR
    assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()


def test_reported_reactive_power_changes_nothing() -> None:
    """It is not used, whether true or absurd."""
    answers = []
    for reported in (None, np.arange(9)):
        rng = np.random.default_rng(12)
        plant = make_plant(rng)
        made = set_search.design(plant, max_attacked=2, step_s=1.0)
        answers.append(watch(Street(plant, rng, metered_q=reported), made, 20)[1])
    for (one, _), (other, _) in zip(*answers, strict=True):
        np.testing.assert_array_equal(one.v2, other.v2)


def test_readings_that_are_no_numbers_and_late_frames() -> None:
    rng = np.random.default_rng(7)
    plant = make_plant(rng)
    made = set_search.design(plant, max_attacked=1, step_s=1.0)
    street = Street(plant, rng)
    start = set_search.init(made, street.t)
    frame = street.frame()
    same, _, verdict = set_search.step(made, start, replace(frame, t=np.nan))
    assert same is start
    assert verdict.decision is Decision.UNDECIDED
    state, answers = watch(street, made, 20)
    late, estimate, verdict = set_search.step(made, state, replace(frame, t=state.t))
    assert late is state
    assert verdict.decision is Decision.UNDECIDED
    np.testing.assert_array_equal(estimate.v2, answers[-1][0].v2)
    y = street.frame().y.copy()
    y[3], y[5] = np.nan, np.inf
    _, estimate, verdict = set_search.step(made, state, replace(street.frame(), t=state.t + 1.0, y=y))
    assert np.isfinite(estimate.v2).all()
    assert verdict.cause is Cause.SILENT_METERS
    assert np.isnan(verdict.score[[3, 5]]).all()


def test_a_dropped_meter_has_no_influence() -> None:
    """Two lies of different size, both found at once: from then on every estimate is the same."""
    answers = []
    for lie in (0.05, 0.09):
        rng = np.random.default_rng(9)
        plant = make_plant(rng)
        made = set_search.design(plant, max_attacked=1, step_s=1.0)
        street = Street(plant, rng)
        state, _ = watch(street, made, 20)
        state, _ = watch(street, made, 60, state=state, lies={4: lie})
        answers.append(watch(street, made, 3, state=state, lies={4: lie})[1])
    for (one, _), (other, _) in zip(*answers, strict=True):
        np.testing.assert_allclose(one.v2, other.v2, rtol=0.0, atol=1e-9)


def test_what_cannot_be_designed() -> None:
    plant = make_plant(np.random.default_rng(0))
    with refused(NotObservable, "too-few-meters"):
        set_search.design(plant, max_attacked=5, step_s=1.0)
    with refused(InputInvalid, "not-positive"):
        set_search.design(plant, max_attacked=1, step_s=0.0)
    many = make_plant(np.random.default_rng(0), customers=60)
    with refused(DesignInfeasible, "too-many"):
        set_search.design(many, max_attacked=4, step_s=1.0)
    assert len(set_search.design(plant, max_attacked=2, step_s=1.0).dropped) == 9 + 36
