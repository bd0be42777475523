"""Changes of the voltages within measured clock offsets."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.clock_offsets import TAP_PU, run
from benchmarks.late_powers import site, watcher, world
from feeders.model.site import Snapshot, to_frame
from feeders.simulation.scenario import START
from gridsec.estimators.sequential import init, step
from gridsec.estimators.sequential.identify import Identification, identify
from gridsec.estimators.sequential.measurements import (
    largest_offset,
    unusable_offsets,
    update_skew,
    without_shifted_busbar,
)
from gridsec.interface import Cause, Decision
from tests.gridsec.estimators.sequential.test_monitor import prepare
from tests.gridsec.street import Street, make_plant

P = 8


def test_changes_means_and_scales_are_those_of_the_definition() -> None:
    """Against sums over all pairs of ticks, for random voltages."""
    made = prepare(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    rng = np.random.default_rng(2)
    longest = made.lengths[-1]
    # The last but three is the largest with a scale that judges it; the next is beyond that.
    offset = np.array([0.5, -0.9, 2.0, -3.0, longest / 4.0, longest / 4.0 + 0.1, np.nan, 0.0])
    used = np.where(np.abs(np.nan_to_num(offset)) <= longest / 4.0, np.abs(np.nan_to_num(offset)), 0.0)
    v2, noise = 1.0 + 0.01 * rng.standard_normal((150, P)), np.full((len(made.lengths), P), 1e-9)
    skew, c = None, np.zeros(v2.shape)
    for t, now in enumerate(v2):
        skew = update_skew(made, skew, t, offset, now, noise)
        for j in range(P):
            ticks = int(np.ceil(used[j])) + 1 if used[j] else 0
            c[t, j] = max((abs(now[j] - v2[t - k, j]) for k in range(1, min(ticks, t) + 1)), default=0.0)
        assert skew is not None
        np.testing.assert_allclose(skew.change[-1], c[t], rtol=1e-12)
    assert skew is not None
    for s, length in enumerate(made.lengths):
        last = 149 - 149 % made.look_every[s]
        square = np.where(skew.aside[s], 0.0, c[last - length + 1 : last + 1].mean(axis=0) ** 2)
        assert (skew.variance[s] >= square * (1.0 - 1e-12))[square > 1e-10].all()
    for s, length in enumerate(made.lengths):
        assert skew.aside[s].tolist() == (length < 4.0 * used).tolist()
    assert unusable_offsets(made, offset).tolist() == [k == 5 for k in range(P)]


@pytest.mark.parametrize("offset", [None, np.zeros(P), np.full(P, np.nan)])
def test_without_a_measured_offset_nothing_is_kept(offset: np.ndarray | None) -> None:
    made = prepare(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    noise = np.full((len(made.lengths), P), 1e-9)
    kept = update_skew(made, None, 0, np.full(P, 1.0), np.ones(P), noise)
    assert kept is not None
    assert update_skew(made, kept, 1, offset, np.ones(P), noise) is None


def test_offsets_add_no_look_and_few_factorisations(monkeypatch: pytest.MonkeyPatch) -> None:
    """The busbar wanders and its transformer changes the tap; looks follow the design alone."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street, rng = prepare(plant), Street(plant, np.random.default_rng(4)), np.random.default_rng(5)
    seen: list[Identification] = []

    def watched(*given: Any) -> Identification:
        seen.append(identify(*given))
        return seen[-1]

    monkeypatch.setattr(sys.modules["gridsec.estimators.sequential.step"], "identify", watched)
    offset = np.linspace(-3.0, 3.0, P)
    state, wander, fresh = init(made, street.t - 1.0), 0.0, 0
    for k in range(300):
        wander += rng.normal(0.0, 6e-4) - 0.02 * wander + 0.02 * (k % 100 == 70)
        frame = replace(street.frame(), t=street.t + k, clock_offset=offset)
        frame = replace(frame, v0_squared=frame.v0_squared + wander, y=frame.y + wander)
        before = state
        state, _, verdict = step(made, state, frame)
        assert verdict.decision is not Decision.ATTACKED
        due = [
            k % every == 0 or fit is None
            for fit, every in zip(before.posteriors, made.look_every, strict=True)
        ]
        assert [view is not None for view in seen[-1].tests] == due
        if before.clock_skew is not None and state.clock_skew is not None:
            changed = (before.clock_skew.variance != state.clock_skew.variance).any(axis=1)
            assert all(k % every == 0 for every, one in zip(made.look_every, changed, strict=True) if one)
            fresh += int(changed.sum())
    assert 0 < fresh < 100


@pytest.mark.parametrize("level", [1e-9, 1e-6])
def test_variances_that_cross_a_level_at_each_tick_change_seldom(level: float) -> None:
    """Changes that alternate by 10 % about the level below which they are left out, and about another."""
    made = prepare(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    noise, offset = np.full((len(made.lengths), P), 1e-8), np.full(P, 0.5)
    skew, last, fresh = None, len(made.lengths) - 1, 0
    root = np.sqrt(level)
    for k in range(400):
        rise = 1.05 if k // 60 % 2 else 0.95
        now = update_skew(made, skew, k, offset, np.full(P, (k % 2) * rise * root), noise)
        assert now is not None
        fresh += skew is not None and not np.array_equal(now.variance[last], skew.variance[last])
        skew = now
    assert skew is not None
    assert (skew.variance[last] >= 0.9 * level).all()
    assert (skew.variance[last] <= 4.5 * level).all()
    assert fresh <= 5


def test_all_clocks_off_and_a_still_feeder_is_clean_and_liars_are_named() -> None:
    """Offsets of 15 s: the longest scale alone judges, also at ticks without a look at it."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4))
    state, offset = init(made, street.t - 1.0), np.full(P, largest_offset(made))
    said = []
    for k in range(200):
        frame = replace(street.frame(), t=street.t + k, clock_offset=offset)
        if k >= 100:
            frame = replace(frame, y=frame.y + 0.05 * (np.arange(P) == 2))
        state, _, verdict = step(made, state, frame)
        said.append(verdict)
    assert all(one.decision is Decision.CLEAN for one in said[70:100])
    assert said[-1].suspects.tolist() == [k == 2 for k in range(P)]
    state, _, verdict = step(made, state, replace(street.frame(), t=street.t + 200.0))
    assert state.clock_skew is None


def test_a_meter_with_an_offset_that_no_scale_judges_is_neither_clean_nor_accused() -> None:
    """The busbar wanders; one clock is 40 s ahead; another meter is manipulated, and one falls silent."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street, rng = prepare(plant), Street(plant, np.random.default_rng(4)), np.random.default_rng(5)
    state, offset, said = init(made, street.t - 1.0), np.where(np.arange(P) == 6, 40.0, np.nan), []
    past = [street.frame()] * 40
    wander = 0.0
    for k in range(300):
        wander += rng.normal(0.0, 2e-3) - 0.02 * wander
        now = street.frame()
        now = replace(now, t=street.t + k, v0_squared=now.v0_squared + wander, y=now.y + wander)
        past.append(now)
        y = np.where(np.arange(P) == 6, past[-41].y, now.y) + 0.05 * ((np.arange(P) == 2) & (k >= 150))
        seen = now.seen & ~((np.arange(P) == 5) & (100 <= k < 120))
        state, _, verdict = step(made, state, replace(now, y=y, seen=seen, clock_offset=offset))
        said.append(verdict)
    assert not np.any([one.suspects[6] or one.suspects[5] for one in said])
    assert {one.cause for one in said[70:100]} == {Cause.CLOCK_OFFSET}
    names = plant.feeder.customers[plant.meters[6]]
    assert f"clock offset of {names} is above 15 s" in said[99].reason
    assert said[110].cause is Cause.SILENT_METERS
    assert "clock offset" in said[110].reason
    assert all(one.decision is Decision.UNDECIDED for one in said[:150])
    assert said[-1].suspects.tolist() == [k == 2 for k in range(P)]
    assert np.isnan(said[-1].score[6])


@pytest.mark.canary("4.0")
@pytest.mark.parametrize("offset", [-2.0, 4.0])
def test_tap_steps_accuse_no_busbar_with_a_measured_offset(offset: float) -> None:
    """Right clocks of the meters. Without the offset the busbar's meter is named."""
    where, made, truth = site(0.0), watcher(0.0), world(0, 480, TAP_PU)
    count, before = truth.v.shape[1], len(truth.p_kw) - truth.t.size
    for measured in (False, True):
        state, named, attacked = made.init(START), 0, 0
        for k, t in enumerate(truth.t):
            v0 = truth.v0[int(np.clip(round(k - offset), 0, truth.t.size - 1))]
            p = truth.register * truth.p_kw[k + before]
            said = Snapshot(t, truth.read[k], p, np.full(count, np.nan), v0)
            said = replace(said, busbar_offset_s=offset if measured else np.nan)
            state, _, verdict = made.step(state, to_frame(where, said))
            named += int(verdict.busbar.any())
            attacked += verdict.decision is Decision.ATTACKED
        assert (named == 0) is measured
        assert (attacked == 0) is measured


def test_a_reading_of_another_moment_is_left_out_within_the_offset_of_a_step() -> None:
    """Both directions, a step of the meters and of the busbar's reading."""
    plant, trusted = make_plant(np.random.default_rng(1), customers=P, drop=0.02), np.ones(P, dtype=np.bool_)
    made, one = prepare(plant), Street(plant, np.random.default_rng(2)).frame()
    for offset in (2.5, -2.5):
        moment, left = None, []
        for k in range(40):
            y = np.full(P, 1.0 + 0.03 * (k >= 20))
            v0 = 1.0 + 0.03 * (k >= 20 + offset)
            frame = replace(one, y=y, seen=trusted, v0_squared=v0, busbar_offset=offset)
            moment, out = without_shifted_busbar(made, moment, frame, trusted, 1.0)
            left += [k] if np.isnan(out.v0_squared) else []
        first, last = sorted((20, int(np.ceil(20 + offset))))
        assert left == list(range(first, last + 4))
    moment, out = without_shifted_busbar(made, moment, replace(one, busbar_offset=np.nan), trusted, 1.0)
    assert moment is None
    assert np.isfinite(out.v0_squared)


def test_a_pause_that_empties_the_window_ends_the_changes_before_it() -> None:
    """The busbar's voltage changes during the pause; a shorter pause keeps all changes."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4))
    longest, offset = made.lengths[-1], np.full(P, 2.0)
    for pause, fresh in ((longest - 1, False), (longest, True)):
        state, t = init(made, street.t - 1.0), street.t
        for k in range(40):
            frame, rise = street.frame(), 0.02 * (k % 2)
            frame = replace(frame, t=t + k, v0_squared=frame.v0_squared + rise, y=frame.y + rise)
            state, _, _ = step(made, state, replace(frame, clock_offset=offset))
        assert state.clock_skew is not None
        assert (state.clock_skew.change > 0.0).any()
        frame = replace(street.frame(), t=t + 39.0 + pause, clock_offset=offset)
        state, _, _ = step(made, state, replace(frame, v0_squared=frame.v0_squared + 0.05, y=frame.y + 0.05))
        assert state.clock_skew is not None
        assert (not state.clock_skew.change.any()) is fresh
        assert (len(state.clock_skew.model) == 1) is fresh


@pytest.mark.acceptance
def test_tap_steps_accuse_no_meter_with_a_measured_offset() -> None:
    """Clocks within 3 s, a tap step every two minutes: without the offsets honest meters are named."""
    unknown, _ = run(0, 480, TAP_PU, measured=False)
    measured, _ = run(0, 480, TAP_PU, measured=True)
    assert unknown["honest"] > 0
    assert measured["honest"] == 0
    assert measured["attacked"] == 0
    assert measured["named"] == measured["liars"]
