"""Readings slower than the frames, and what is said between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import load
from feeders.registry import design
from feeders.simulation.trial import Trial, TrialMeterErrors, frames
from gridsec.estimators.modal import monitor
from gridsec.interface import Decision, Frame
from tests.gridsec.estimators.modal.streets import prepare, watch
from tests.gridsec.street import BASE_KVA, Street, make_plant

EVERY, LIARS = 12, {2: 0.05, 5: -0.05}


@pytest.mark.canary("5")
@pytest.mark.parametrize("count", [5, 8])
def test_nothing_is_remembered_of_frames_without_readings(count: int) -> None:
    """What powers were not known while nobody was heard does not blind the readings that come."""
    plant = make_plant(np.random.default_rng(3), customers=9, drop=0.03)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4), load_kw=1.0)
    wide = np.full(9, 20.0 / BASE_KVA)
    silent, state = tuple(range(9)), None
    named = []
    for k in range(count * EVERY):
        heard = k % EVERY == 0

        def guessed(frame: Frame) -> Frame:
            return replace(frame, p=0.0 * frame.p, p_error=wide, q=0.0 * frame.q, q_error=wide)

        state, [(estimate, verdict)] = watch(
            street,
            made,
            1,
            state=state,
            lies=LIARS,
            silent=() if heard else silent,
            change=None if heard else guessed,
        )
        if heard:
            named.append(np.flatnonzero(verdict.suspects).tolist())
            least = estimate.std
        else:
            assert verdict.decision is Decision.UNDECIDED
            assert np.median(estimate.std / least) > 3.0  # between readings little is known
    assert all(set(each) <= set(LIARS) for each in named)
    assert named[-3:] == [sorted(LIARS)] * 3


@pytest.mark.parametrize("name", ["kerber-landnetz", "cigre-lv"])
def test_the_standard_deviation_covers_the_jitter_of_the_busbar(name: str) -> None:
    """White meters, AC power flow: errors are as large as is said, also those all customers share."""
    trial = Trial(load(name), seed=5, duration_s=150.0, meters=TrialMeterErrors.WHITE)
    watcher, ratios = design(trial.stated), []
    state = watcher.init(0.0)
    for k, (frame, truth) in enumerate(frames(trial)):
        state, estimate, _ = watcher.step(state, frame)
        if k >= 70:
            ratios.append((estimate.v2 - truth.v2) / estimate.std)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.1


def test_who_fell_silent_does_not_stand_for_others() -> None:
    """Liars that are named and say no more leave room for the next one to be named."""
    plant = make_plant(np.random.default_rng(7), customers=13, drop=0.03)
    made, street = prepare(plant), Street(plant, np.random.default_rng(8), load_kw=0.3)
    street.bias[:] = 0.0
    lies = {1: 0.06, 4: -0.06, 8: 0.06}
    state, answers = watch(street, made, 20, lies=lies)
    assert np.flatnonzero(answers[-1][1].suspects).tolist() == [1, 4, 8]
    state, answers = watch(street, made, 20, state=state, lies=lies | {11: 0.15}, silent=(1, 4, 8))
    last = answers[-1][1]
    assert np.flatnonzero(last.suspects).tolist() == [1, 4, 8, 11]
    assert last.decision is Decision.ATTACKED


def test_days_without_a_frame_beside_an_open_suspicion() -> None:
    """The loads have forgotten all of their errors, and jump at the first frame."""
    plant = make_plant(np.random.default_rng(3), customers=12, drop=0.04, inverters=np.arange(0))
    made, street = prepare(plant), Street(plant, np.random.default_rng(4), wobble=0.01)
    state, lies = monitor.init(made, street.t - 1.0), {3: 0.03, 5: -0.03, 7: 0.03, 9: -0.03, 1: 0.03}
    for k in range(100):
        street.advance(1.0)
        frame = street.frame(lies if k > 60 else None)
        if k == 99:
            names = ("p", "p_error", "q", "q_error")
            frame = replace(frame, t=frame.t + 3.0 * 86_400.0, **{n: 4.0 * getattr(frame, n) for n in names})
        state, _, verdict = monitor.step(made, state, frame)
        if k == 98:
            assert state.core.rivals
    assert verdict.decision is not Decision.CLEAN
