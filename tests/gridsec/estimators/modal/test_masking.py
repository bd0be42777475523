"""Masking of named meters, their release, and a restart from a stored state."""

from __future__ import annotations

import itertools
import pickle  # the states of this test only
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks._residuals import Source
from gridsec.estimators.modal import core, full, masking, replay
from gridsec.estimators.modal.core import Core
from gridsec.estimators.modal.filter import Interval
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


@pytest.mark.canary("0.2")
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
    none, meter = np.zeros((p, p)), np.eye(p)[FIRST]
    posterior = SimpleNamespace(mean=np.zeros((2, p)), blocks=(np.eye(p), none, none))
    masked, far = masking.added(masking.none(kernel.modes), meter > 0.0), 10.0 * np.sqrt(1.0 + noise) * meter
    for k, m in enumerate([np.zeros(p), far, *ticks * [np.zeros(p)]]):
        assert masked.meters[FIRST], k
        masked = masking.follow(quiet, masked, posterior, None, m, None)
    assert not masked.meters.any()
    masked = masking.added(masked, meter > 0.0)
    # A mean beyond `AGREES` of its deviations releases nothing.
    for _ in range(masking.MOST + 1):
        off = 1.2 * masking.AGREES * np.sqrt(1.0 + noise / masking.RELEASE) * meter
        masked = masking.follow(quiet, masked, posterior, None, off, None)
    assert masked.meters[FIRST]


def test_the_amount_of_a_ramp_is_that_of_the_reading(kernel: Core) -> None:
    """A drift of 5e-5 squared pu per tick, named 30 ticks or more after its onset."""
    source, state, lie = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0), 0.0
    for k in range(400):
        lie = 5e-5 * max(0, k - 200)
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie * np.eye(12)[FIRST])
        if core.alarmed(kernel, evidence):
            suspicion = core.identify(kernel, state, evidence)
            if suspicion.found.named[FIRST] and state.detector.onsets.ramp[suspicion.row]:
                break
    state, _ = core.mask(kernel, state, suspicion)
    assert 0.5 * lie < state.masked.amount[FIRST] < 2.0 * lie


def test_meters_are_masked_from_the_earliest_suspected_onset_on(kernel: Core) -> None:
    """Two drifts. The earliest onset counts for each meter, and is kept as long as its reading."""
    source, state, earliest = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0), np.inf
    both, first = np.isin(np.arange(12), [FIRST, SECOND]), None
    for k in range(420):
        lie = 1e-4 * min(max(0, k - 200), 120)
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie * both)
        pinned = state.detector.pinned
        if pinned.any() and first is None:
            first = state.began
            assert 190.0 <= first <= k
        assert state.began <= earliest or not pinned.any()
        earliest = state.began
        if core.alarmed(kernel, evidence):
            suspicion = core.identify(kernel, state, evidence)
            if suspicion.found.named.any():
                # As if a pinned onset before had been older.
                state, evidence = core.mask(kernel, replace(state, began=first - 7.0), suspicion)
                since = [seen for t, _, seen, *_ in state.history.readings if t >= first - 7.0]
                before = [seen for t, _, seen, *_ in state.history.readings if t < first - 7.0]
                assert not any(seen[state.masked.meters].any() for seen in since)
                assert all(seen is None for seen in before)
                earliest = state.began
                assert earliest == first - 7.0
    assert np.array_equal(state.masked.meters, both)
    for k in range(420, 420 + 2 * replay.HALF):
        state, _ = core.step(kernel, state, float(k), source.tick() + lie * both)
    assert state.began == np.inf
    assert state.first == len(state.history.readings)


def test_a_ramp_of_the_suspected_age_is_a_candidate(kernel: Core) -> None:
    """Its age is that of the earliest suspicion, or three times that of the likeliest step."""
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    for k in range(100):
        state, evidence = core.step(kernel, state, float(k), source.tick())
    onsets, rows = state.detector.onsets, np.flatnonzero(state.detector.onsets.used)
    young = rows[np.argsort(onsets.age[rows])][: evidence.rows.size]
    ramps = rows[onsets.ramp[rows]]
    assert not onsets.ramp[young].any()
    for age, first in ((70, young), (1, rows[onsets.age[rows] > 20][:3])):
        pins, likely = core._pins(onsets, first, age), max(age, 3 * int(onsets.age[first[0]]))
        assert pins[:-1].tolist() == first[:-1].tolist()
        assert onsets.ramp[pins[-1]]
        apart = np.abs(np.log(onsets.age[ramps] / likely))
        assert apart[ramps == pins[-1]] == apart.min()
    pins = core._pins(onsets, young, 70)
    # A ramp that is pinned anyway takes the place of no other onset.
    with_ramp = np.concatenate([pins[-1:], young[:-1]])
    assert core._pins(onsets, with_ramp, 70) is with_ramp


def test_a_single_reading_replaces_no_smaller_amount(kernel: Core) -> None:
    """A lie within a wide deviation, and one reading at 20 times the lie; repeated readings keep it."""
    p, meter = kernel.modes.size, np.eye(12)[FIRST]
    none, quiet = np.zeros((p, p)), SimpleNamespace(noise=1e-7 * np.eye(p))
    posterior = SimpleNamespace(mean=np.zeros((2, p)), blocks=(1e-5 * np.eye(p), none, none))
    lie = 2.5 * np.sqrt(1e-5) * meter
    masked = masking.added(masking.none(kernel.modes), meter > 0.0, lie)
    for k in range(10 * masking.MOST):
        masked = masking.follow(quiet, masked, posterior, None, (20.0 if k == 30 else 1.0) * lie, None)
        if k == 60:
            masked = masking.added(masked, meter > 0.0)
    assert masked.meters[FIRST]
    # Agreement for very long releases it in any case.
    for _ in range(masking.LONG):
        masked = masking.follow(quiet, masked, posterior, None, lie, None)
    assert not masked.meters[FIRST]


def test_deviations_beside_unknown_directions(kernel: Core) -> None:
    """Oracle: the dense joint law of w + b, the lasting amounts and the readings of one tick."""
    random, modes, p = np.random.default_rng(5), kernel.modes, 12
    begun = core.init(kernel, 0.0)
    at, rows, unknown = np.array([2, 7]), np.delete(np.arange(p), [2, 7]), 0.01 * random.normal(size=(p, 3))
    before = full.expanded(modes, begun.filter, begun.static)
    gap, m, seen = Interval(1.0), 0.01 * random.normal(size=p), np.isin(np.arange(p), rows)
    after, tick = full.updated(modes, before, gap, m, seen, unknown)
    off, P = masking.deviations(after, tick, m, at, unknown)
    rho, rho_b = gap.decay(modes)
    w, both, b = before.blocks
    prior = rho**2 * w + rho * rho_b * (both + both.T) + rho_b**2 * b
    prior += (1.0 - rho**2) * modes.covariance_w + (1.0 - rho_b**2) * modes.covariance_b
    # Joint law of the readings of all members, with lasting amounts; white errors of both parts independent.
    noise = modes.noise * np.equal.outer(seen, seen)
    joint = prior + noise + masking.LASTS**2 * unknown @ unknown.T
    gain = np.linalg.solve(joint[np.ix_(rows, rows)], joint[np.ix_(rows, at)]).T
    found = (joint - noise)[np.ix_(at, at)] - gain @ joint[np.ix_(rows, at)]
    assert pytest.approx(found, rel=1e-8, abs=1e-15) == P
    assert off[at] == pytest.approx(m[at] - gain @ m[rows], rel=1e-8)
    # A tick without any reading.
    none, tick = full.updated(modes, before, gap, m, np.zeros(p, dtype=np.bool_), unknown)
    _, P = masking.deviations(none, tick, m, at, unknown)
    assert pytest.approx((joint - noise)[np.ix_(at, at)], rel=1e-9) == P


def test_evidence_of_honesty_against_all_sets() -> None:
    """Oracle: all sets of six meters. None, some or all go on by nearly the amounts last seen."""
    random, k, other = np.random.default_rng(0), 6, 0
    sets = [np.array(each) for each in itertools.product([False, True], repeat=k)]
    for trial in range(200):
        S = 1e-5 * random.uniform(0.5, 4.0) + np.diag(1e-6 * random.uniform(0.2, 2.0, k))
        amount = random.uniform(0.003, 0.02, k) if trial % 2 else np.full(k, 0.01)
        lies = amount * (random.random(k) < random.choice([0.0, 0.5, 1.0]))
        mean = np.linalg.cholesky(S) @ random.normal(size=k) + lies * (1.0 + 0.1 * random.normal(size=k))
        costs = []
        for J in sets:
            off = mean - amount * J
            costs.append(off @ np.linalg.solve(S + np.diag((masking.VARIES * amount * J) ** 2), off))
        least = np.array(
            [
                [min(c for J, c in zip(sets, costs, strict=True) if J[j] == go_on) for j in range(k)]
                for go_on in (True, False)
            ]
        )
        released = 0.5 * (least[0] - least[1]) >= masking.HONEST
        other += np.count_nonzero(released != (masking.evidence(S, mean, amount) >= masking.HONEST))
    # Single changes miss the least cost of all sets now and then.
    assert other <= 3


def test_meters_that_collude_within_a_wide_deviation_stay_masked(kernel: Core) -> None:
    """Four meters alike at 2.5 deviations of their common part agree, and stay masked until they end."""
    p, four = kernel.modes.size, np.arange(12) < 4
    none, wide = np.zeros((p, p)), 1e-5 * np.outer(four, four) + 1e-8 * np.eye(p)
    quiet = SimpleNamespace(noise=1e-7 * np.eye(p))
    posterior = SimpleNamespace(mean=np.zeros((2, p)), blocks=(wide, none, none))
    lie = 2.5 * np.sqrt(1e-5) * four
    masked = masking.added(masking.none(kernel.modes), four, lie)
    for _ in range(10 * masking.MOST):
        masked = masking.follow(quiet, masked, posterior, None, lie, None)
    assert (masked.meters == four).all()
    # Without a known amount, agreement is enough.
    unknown = masking.added(masking.none(kernel.modes), four)
    for _ in range(masking.RELEASE):
        unknown = masking.follow(quiet, unknown, posterior, None, lie, None)
    assert not unknown.meters.any()
    for _ in range(2 * masking.MOST):
        masked = masking.follow(quiet, masked, posterior, None, np.zeros(p), None)
    assert not masked.meters.any()


@pytest.mark.canary("205-0.2")
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
