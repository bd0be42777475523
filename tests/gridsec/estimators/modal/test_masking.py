"""Masking of named meters, their release, and a restart from a stored state."""

from __future__ import annotations

import pickle  # the states of this test only
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks._residuals import Source
from gridsec.estimators.modal import core, masking, replay
from gridsec.estimators.modal.core import Core
from tests.gridsec.estimators.modal.test_core import MODEL

FIRST, SECOND = 4, 9


@pytest.fixture(scope="module")
def kernel() -> Core:
    """A core of 12 meters."""
    return core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e6)


def lie(k: int) -> np.ndarray:
    """The first meter is off from 200 to 360, the second one from 260 on."""
    out = np.zeros(12)
    out[FIRST] = 0.02 * (200 <= k < 360)
    out[SECOND] = 0.02 * (k >= 260)
    return out


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_named_meters_are_masked_and_released(kernel: Core, share: float) -> None:
    """Each one is named alone; the first one is released after it agrees again, the second one is not."""
    source, random = Source(MODEL, np.random.default_rng(1)), np.random.default_rng(2)
    state, masked, alarms = core.init(kernel, 0.0), {}, []
    for k in range(600):
        seen = random.random(12) >= share
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie(k), seen)
        if core.alarmed(kernel, evidence):
            suspicion = core.identify(kernel, state, evidence)
            alarms.append(k)
            if suspicion.found.named.any():
                state, evidence = core.mask(kernel, state, suspicion)
                assert not core.alarmed(kernel, evidence)
        masked[k] = np.flatnonzero(state.masked.meters).tolist()
    assert masked[199] == []
    assert masked[215] == [FIRST]
    assert masked[280] == [FIRST, SECOND]
    assert masked[360 + masking.RELEASE - 2] == [FIRST, SECOND]
    assert masked[360 + 2 * masking.MOST] == masked[599] == [SECOND]
    assert len(alarms) < 30
    truth = abs(core.estimate(kernel, state).mean[MODEL.meters[SECOND]])
    assert truth < 0.02


@pytest.mark.parametrize(("noise", "ticks"), [(0.5, masking.RELEASE), (9.5, 10), (1e6, masking.MOST)])
def test_a_release_takes_readings_until_their_mean_is_sharp(kernel: Core, noise: float, ticks: int) -> None:
    """White variances of 0.5 to 1e6 times the variance of the filter; one reading in between disagrees."""
    p = kernel.modes.size
    quiet = SimpleNamespace(noise=noise * np.eye(p))
    mean, variance, meter = np.zeros((2, p)), np.ones(p), np.eye(p)[FIRST]
    full = SimpleNamespace(mean=mean, variance=variance)
    masked, far = masking.added(masking.none(kernel.modes), meter > 0.0), 10.0 * np.sqrt(1.0 + noise) * meter
    for k, m in enumerate([np.zeros(p), far, *ticks * [np.zeros(p)]]):
        assert masked.meters[FIRST], k
        masked = masking.follow(quiet, masked, full, m, None)
    assert not masked.meters.any()
    masked = masking.added(masked, meter > 0.0)
    # A mean beyond `AGREES` of its deviations releases nothing.
    for _ in range(masking.MOST + 1):
        off = 1.2 * masking.AGREES * np.sqrt(1.0 + noise / masking.RELEASE) * meter
        masked = masking.follow(quiet, masked, full, off, None)
    assert masked.meters[FIRST]


@pytest.mark.parametrize("share", [0.0, 0.2])
@pytest.mark.parametrize("ticks", [205, 240])
def test_a_replay_from_a_late_state_equals_one_from_the_first(kernel: Core, share: float, ticks: int) -> None:
    """State, log M and kept readings after masking 5 and 40 ticks after the onset."""
    source, random = Source(MODEL, np.random.default_rng(1)), np.random.default_rng(2)
    state = core.init(kernel, 0.0)
    for k in range(ticks):
        seen = random.random(12) >= share
        jump = 0.5 * (k % 50 == 20)
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie(k), seen, None, jump)
    suspicion = core.identify(kernel, state, evidence)
    assert suspicion.found.named.any()
    whole = replace(state.history, middle=None, recent=())
    one, two = (core.mask(kernel, replace(state, history=each), suspicion) for each in (state.history, whole))
    assert one[1].log_m == pytest.approx(two[1].log_m, abs=1e-9)
    assert (core.estimate(kernel, one[0]).mean == core.estimate(kernel, two[0]).mean).all()
    assert len(one[0].history.readings) == len(two[0].history.readings)
    assert [each[0] for each in one[0].history.recent] == [each[0] for each in two[0].history.recent]
    assert (one[0].history.middle is None) == (two[0].history.middle is None)


def test_an_onset_older_than_the_kept_readings_is_masked(kernel: Core) -> None:
    """The meter is masked 300 ticks after its onset: log M falls, and nothing else is named."""
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    for k in range(500):
        state, evidence = core.step(
            kernel, state, float(k), source.tick() + 0.02 * (k >= 200) * np.eye(12)[FIRST]
        )
    assert 2 * replay.HALF < 300
    state, evidence = core.mask(kernel, state, core.identify(kernel, state, evidence))
    for k in range(500, 560):
        state, evidence = core.step(kernel, state, float(k), source.tick() + 0.02 * np.eye(12)[FIRST])
        assert not core.alarmed(kernel, evidence)
    assert np.flatnonzero(state.masked.meters).tolist() == [FIRST]


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_restart_from_a_stored_state_goes_on(kernel: Core, share: float) -> None:
    """Irregular steps; state stored and read back at tick 90, during an alarm."""
    random, source = np.random.default_rng(3), Source(MODEL, np.random.default_rng(4))
    state, other, t = core.init(kernel, 0.0), None, 0.0
    for k in range(150):
        m = source.tick() + 0.02 * (k >= 80) * np.eye(12)[FIRST]
        seen, t = random.random(12) >= share, t + float(random.choice([0.5, 1.0, 7.0]))
        state, evidence = core.step(kernel, state, t, m, seen)
        if other is not None:
            other, again = core.step(kernel, other, t, m, seen)
            assert again.log_m == evidence.log_m
        if k == 90:
            other = pickle.loads(pickle.dumps(state))  # written one line before
    assert other is not None
    one, two = (core.identify(kernel, each, evidence) for each in (state, other))
    assert (one.found.named == two.found.named).all()
    assert (core.estimate(kernel, state, one).mean == core.estimate(kernel, other, two).mean).all()
