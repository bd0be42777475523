"""The estimator `modal` on simulated frames: AC power flow as the truth, readings missing, restarts."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load, to_frame
from feeders.registry import MODAL, DesignedEstimator, choose, design
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.arrays import Floats
from gridsec.attack import Attack, Scaling
from gridsec.errors import NotObservable
from gridsec.estimators.modal import full, masking, monitor, verdict
from gridsec.interface import Cause, Decision, Estimate, Frame, PowerOrigin, Verdict

ONSET, LIARS, LIE = 40, np.array([2, 5, 9]), 0.02
TICKS = 60


@cache
def site() -> Site:
    return choose(load("simbench-lv-rural1"), estimator=MODAL)


@cache
def watcher() -> DesignedEstimator:
    return design(site())


@cache
def played(lie: float = LIE, busbar: float = 0.0) -> tuple[tuple[Frame, ...], tuple[Floats, ...]]:
    """Frames, and true squared voltages of the customers, pu."""
    t_on, t_off = START + ONSET, START + 1e6
    attacks: tuple[Attack, ...] = (Scaling(LIARS, t_on, t_off, factor=np.full(3, lie)),) if lie else ()
    off = (Scaling(np.zeros(1, dtype=np.intp), t_on, t_off, factor=np.array([busbar])),) if busbar else ()
    scenario = Scenario(seed=4, duration_s=float(TICKS), attacks=attacks, busbar_attacks=off)
    volt = site().tables.meta.voltage_volt
    samples = list(simulate(site(), scenario))
    frames = tuple(to_frame(site(), snapshot) for snapshot in snapshots(samples))
    return frames, tuple((sample.v_volt / volt) ** 2 for sample in samples)


def run(
    frames: Sequence[Frame], state: Any = None, known: Any = None
) -> tuple[Any, list[Estimate], list[Verdict]]:
    """Final state and all answers."""
    state = watcher().init(frames[0].t, known) if state is None else state
    estimates, verdicts = [], []
    for frame in frames:
        state, estimate, verdict = watcher().step(state, frame)
        estimates.append(estimate)
        verdicts.append(verdict)
    return state, estimates, verdicts


def named(verdict: Verdict) -> set[int]:
    return set(np.flatnonzero(verdict.suspects).tolist())


@cache
def attacked() -> tuple[Any, list[Estimate], list[Verdict]]:
    return run(played()[0])


def test_liars_are_named_and_their_voltages_reconstructed() -> None:
    """CLEAN before, exactly the three named within five seconds; evidence and attack fit the bias."""
    frames, truth = played()
    _, estimates, verdicts = attacked()
    assert {verdict.decision for verdict in verdicts[20:ONSET]} == {Decision.CLEAN}
    assert all(named(verdict) <= set(LIARS.tolist()) for verdict in verdicts)
    assert verdicts[ONSET].decision is not Decision.CLEAN
    for k in range(ONSET + 4, TICKS):
        verdict, estimate = verdicts[k], estimates[k]
        assert named(verdict) == set(LIARS.tolist())
        assert verdict.decision is Decision.ATTACKED
        assert verdict.cause is Cause.RESIDUALS
        beyond = verdict.score > verdict.threshold
        assert set(np.flatnonzero(beyond).tolist()) == set(LIARS.tolist())
        error = np.abs(estimate.v2 - truth[k])
        assert (error <= estimate.bound).all()
        assert (error <= 4.0 * estimate.std).all()
        # A lie of 2 % of the voltage is 4 % of its square, known to a fixed error of 0.5 %.
        expected = (1.0 + LIE) ** 2 - 1.0
        assert np.allclose(verdict.attack[LIARS], expected * truth[k][site().meters[LIARS]], atol=0.012)
        assert not estimate.trusted[LIARS].any()
    assert frames[0].t == START


@pytest.mark.canary("factor0")
@pytest.mark.parametrize("factor", [(1.02, 1.03), (0.98, 1.0)])
def test_false_readings_of_one_tick_are_seen_and_forgiven(factor: tuple[float, float]) -> None:
    """Two meters or one: no transition takes the evidence of the tick away, and no other meter is named."""
    frames = list(played(0.0)[0])
    wrong, at = frames[ONSET].y.copy(), LIARS[:2]
    wrong[at] *= np.square(factor)
    frames[ONSET] = replace(frames[ONSET], y=wrong)
    _, _, verdicts = run(frames)
    false = {int(j) for j, each in zip(at, factor, strict=True) if each != 1.0}
    assert set.union(*(named(each) for each in verdicts)) <= false
    assert verdicts[ONSET].decision is Decision.UNDECIDED
    assert all(each.decision is Decision.CLEAN for each in verdicts[ONSET + 16 :])


def test_the_threshold_of_a_masked_meter_is_that_of_its_release() -> None:
    """A power without a reading is an unknown direction of each tick; the lie ends while it is unread."""
    attacked_, honest = played()[0], played(0.0)[0]
    unread = site().meters[12]
    state, deviates = None, []
    for frame in (*attacked_[: ONSET + 8], *honest[ONSET + 8 :]):
        p = np.where(np.arange(frame.p.size) == unread, np.nan, frame.p)
        before = None if state is None else state.core.masked
        state, _, verdicts = run([replace(frame, p=p)], state)
        if before is None or not before.meters.any():
            continue
        still = before.meters & state.core.masked.meters
        turns = state.core.masked.turn > before.turn
        assert ((verdicts[0].score <= verdicts[0].threshold) == turns)[still].all()
        deviates += (~turns)[still].tolist()
        now, at = state.core, np.flatnonzero(still)
        if at.size:
            m, unknown = np.zeros(still.size), now.history.unknown
            _, P = masking.deviations(now.filter.full, now.update.exact, m, at, unknown)
            std = np.sqrt(P.diagonal() + watcher().design.core.modes.noise.diagonal()[at])
            assert np.allclose(verdicts[0].threshold[at], masking.OUTLIER * std, rtol=1e-9)
            # Each tick of the filter has an amount of its own along it, a lasting one is narrower.
            wide = verdict.deviations(watcher().design.core, now, m)[1][at]
            assert (std < 1.01 * wide).all()
            assert (std < 0.99 * wide).any()
    assert 0 < sum(deviates) < len(deviates)


def test_the_same_frames_give_the_same_answers_from_a_copied_state() -> None:
    """Replay equals live, also from a state that went through a process boundary."""
    frames, _ = played()
    _, estimates, verdicts = attacked()
    state, _, _ = run(frames[:45])
    _, again, answers = run(frames[45:], pickle.loads(pickle.dumps(state)))
    for one, other in zip(estimates[45:], again, strict=True):
        assert (one.v2_bus == other.v2_bus).all()
        assert (one.std == other.std).all()
    assert [v.reason for v in answers] == [v.reason for v in verdicts[45:]]


def test_score_and_threshold_are_those_of_any_later_access() -> None:
    """First access after later ticks, in a copy, and in a changed verdict give the same numbers."""
    frames, _ = played()
    _, _, verdicts = attacked()
    state, _, later = run(frames[:45])
    run(frames[45:], state)
    for one, other in zip(verdicts, later, strict=False):
        assert np.array_equal(replace(other, reason="").threshold, one.threshold)
        assert np.array_equal(pickle.loads(pickle.dumps(other)).score, one.score, equal_nan=True)
        assert other.score.shape == other.threshold.shape == site().meters.shape


def test_a_repeated_frame_changes_nothing() -> None:
    """The last answer, UNDECIDED."""
    frames, _ = played()
    state, estimates, _ = run(frames[:30])
    after, estimate, verdict = watcher().step(state, frames[29])
    assert after is state
    assert estimate is estimates[-1]
    assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.SETTLING)
    _, first, answer = watcher().step(watcher().init(START), replace(frames[0], t=np.nan))
    assert answer.decision is Decision.UNDECIDED
    assert np.isfinite(first.std).all()


def silent(frame: Frame, meters: Sequence[int]) -> Frame:
    seen, y = frame.seen.copy(), frame.y.copy()
    seen[list(meters)], y[list(meters)] = False, np.nan
    return replace(frame, seen=seen, y=y)


def test_silent_meters_are_never_clean() -> None:
    """Some silent meters, irregular ticks, then silence of all; the liars are named all the same."""
    frames, truth = played()
    given = [silent(frame, (0, 11) if k % 3 else (0,)) for k, frame in enumerate(frames) if k % 4 != 1]
    state, estimates, verdicts = run(given)
    assert named(verdicts[-1]) == set(LIARS.tolist())
    assert all(verdict.decision is not Decision.CLEAN for verdict in verdicts)
    assert Cause.SILENT_METERS in {verdict.cause for verdict in verdicts}
    assert (np.abs(estimates[-1].v2 - truth[-1]) <= 4.0 * estimates[-1].std).all()
    nothing = replace(silent(frames[-1], range(13)), t=frames[-1].t + 1.0, v0_squared=np.nan)
    _, estimate, verdict = watcher().step(state, nothing)
    assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.TOO_FEW_METERS)
    assert np.isfinite(estimate.v2_bus).all()
    assert np.isfinite(estimate.bound).all()


def test_a_busbar_without_a_voltage_is_estimated() -> None:
    """From tick 10 on the busbar's voltage is missing, and its estimate stays within its deviation."""
    frames, truth = played(0.0)
    given = [frame if k < 10 else replace(frame, v0_squared=np.nan) for k, frame in enumerate(frames)]
    _, estimates, verdicts = run(given)
    assert {verdict.decision for verdict in verdicts[20:]} == {Decision.CLEAN}
    for k in range(20, TICKS):
        assert abs(estimates[k].v2_bus[0] - frames[k].v0_squared) < 0.01
        assert (np.abs(estimates[k].v2 - truth[k]) <= 4.0 * estimates[k].std).all()


def test_a_manipulated_busbar_is_named() -> None:
    """The busbar's meter reads 3 % too much; no meter is named, and the voltages stay right."""
    _, truth = played(0.0, 0.03)
    _, estimates, verdicts = run(played(0.0, 0.03)[0])
    assert not any(named(verdict) for verdict in verdicts)
    last = verdicts[-1]
    assert (last.decision, last.cause) == (Decision.ATTACKED, Cause.RESIDUALS)
    assert last.busbar.all()
    assert "busbar" in last.reason
    assert np.isclose(last.busbar_attack[0], 1.03**2 - 1.0, atol=0.02)
    assert (np.abs(estimates[-1].v2 - truth[-1]) <= 4.0 * estimates[-1].std).all()


def test_an_unread_power_leaves_the_voltage_open_and_accuses_nobody() -> None:
    """6 unread kW accuse no meter; MISSING_POWERS where the voltage is less certain than asked for."""
    frames, truth = played(0.0)
    customer, base = int(site().meters[4]), site().feeder.base_kva

    def unread(frame: Frame, half_kw: float) -> Frame:
        p, error = frame.p.copy(), frame.p_error.copy()
        p[customer] += 6.0 / base
        error[customer] = half_kw / base
        origin = np.full(p.size, PowerOrigin.READ, dtype=np.intp)
        origin[customer] = PowerOrigin.UNREAD
        return replace(frame, p=p, p_error=error, p_origin=origin)

    given = [frame if k < 20 else unread(frame, 10.0) for k, frame in enumerate(frames)]
    _, estimates, verdicts = run(given)
    assert not any(named(verdict) for verdict in verdicts)
    assert {verdict.cause for verdict in verdicts[25:]} <= {Cause.AGREEMENT, Cause.MISSING_POWERS}
    for k in range(25, TICKS):
        assert (np.abs(estimates[k].v2 - truth[k]) <= 4.0 * estimates[k].std).all()
    meta = site().tables.meta
    strict = replace(meta, monitor=replace(meta.monitor, unread_std_percent=0.01))
    other = design(from_tables(replace(site().tables, meta=strict)))
    state = other.init(START)
    for frame in given[:25]:
        state, _, verdict = other.step(state, frame)
    assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.MISSING_POWERS)


@pytest.mark.acceptance
def test_a_stuck_meter_is_masked_while_it_repeats_itself() -> None:
    """Readings that do not change beyond chance name the meter, by the same test as the default monitor."""
    frames, _ = played(0.0)
    repeated = [replace(frames[k % TICKS], t=START + k) for k in range(500)]
    stuck = [
        replace(frame, y=np.where(np.arange(13) == 6, frames[0].y, frame.y)) if k >= 320 else frame
        for k, frame in enumerate(repeated)
    ]
    shuffled = [
        replace(frame, y=frame.y * (1.0 + 2e-4 * np.random.default_rng(k).standard_normal(13)))
        for k, frame in enumerate(stuck)
    ]
    for k in range(320, 500):
        shuffled[k].y[6] = frames[0].y[6]
    _, _, verdicts = run(shuffled)
    assert 6 in named(verdicts[-1])
    assert str(verdicts[-1].kinds[6]) == "stuck"


def test_learned_errors_and_named_meters_survive_a_restart() -> None:
    """Arrays of p numbers bring back the posterior; the record of suspects masks the named meters at once."""
    made = watcher().design
    frames, _ = played()
    state, _, _ = run(frames[:ONSET])
    arrays = monitor.to_arrays(made, state.commission)
    assert {values.shape for values in arrays.values()} == {(13,)}
    known = monitor.from_arrays(made, arrays)
    _, _, fresh = run(frames[ONSET:])
    again, _, after = run(frames[ONSET:], known=known)
    # The errors that were learned before the restart make the thresholds of the first ticks narrower.
    assert np.median(after[0].threshold) < np.median(fresh[0].threshold)
    assert named(after[-1]) == set(LIARS.tolist())
    before = monitor.distrusted(made, again)
    assert (np.isfinite(before.scale_s) == before.named).all()
    begun = monitor.warm_start(made, watcher().init(frames[ONSET + 5].t, known), before)
    _, _, verdicts = run(frames[ONSET + 5 :], begun)
    assert {frozenset(named(verdict)) for verdict in verdicts} == {frozenset(LIARS.tolist())}


def test_a_reading_that_jumps_and_drives_no_inverter_leaves_the_verdict_open() -> None:
    """Eight standard deviations at one tick, with a limit of the detector that this does not reach."""
    frames, _ = played(0.0)
    made = watcher().design
    assert isinstance(made, monitor.ModalDesign)
    made = replace(made, core=replace(made.core, limit=3.0 * made.core.limit))
    j, state, decisions = int(made.front.meter_of.max()), monitor.init(made, frames[0].t), {}
    for k, frame in enumerate(frames):
        given = frame
        if k == ONSET:
            std = verdict.deviations(made.core, state.core, np.zeros(frame.y.size))[1][j]
            given = replace(frame, y=frame.y + 8.0 * std * np.eye(frame.y.size)[j])
        state, _, answer = monitor.step(made, state, given)
        decisions[k] = answer
    last = ONSET + monitor.HELD
    assert {decisions[k].decision for k in range(20, ONSET)} == {Decision.CLEAN}
    for k in range(ONSET, last):
        assert (decisions[k].decision, decisions[k].cause) == (Decision.UNDECIDED, Cause.MISFIT)
        assert decisions[k].reason.endswith(f"again: {made.front.names[j]}.")
    assert decisions[last].decision is Decision.CLEAN


def test_a_lie_beyond_the_class_from_the_first_reading_on_is_undecided() -> None:
    """Class 0.5 %, off by 1.2 %: 4.2 deviations of the prior. Nothing is learned; a new meter is CLEAN."""
    frames, _ = played(0.0)
    made, state, j = watcher().design, watcher().init(frames[0].t), 4
    assert isinstance(made, monitor.ModalDesign)
    factor = np.where(np.arange(frames[0].y.size) == j, 1.012**2, 1.0)
    for frame in frames:
        state, _, answer = watcher().step(state, replace(frame, y=frame.y * factor))
    assert (answer.decision, answer.cause) == (Decision.UNDECIDED, Cause.MISFIT)
    assert answer.reason.endswith(f"files: {made.front.names[j]}.")
    assert not answer.suspects.any()
    assert np.flatnonzero(state.core.exceeding).tolist() == [j]
    assert state.kept is None
    state = monitor.renew(made, state, np.arange(factor.size) == j)
    for frame in frames:
        state, _, answer = watcher().step(state, replace(frame, t=frame.t + TICKS))
    assert answer.decision is Decision.CLEAN


def test_a_replaced_meter_is_trusted_again_with_an_unknown_error() -> None:
    """Posterior of `renew` against dense conditioning of own errors; nothing else is forgotten."""
    made, (state, _, _) = watcher().design, attacked()
    which = np.arange(13) == LIARS[0]
    after = monitor.renew(made, state, which)
    modes, kernel = made.core.modes, state.core
    whole = kernel.filter.full or full.expanded(modes, kernel.filter, kernel.static)
    t, j = modes.size, int(LIARS[0])
    # States (w, b, own error of j): own = K b + r, then b_j loses it and gains a new one.
    K, fixed = made.core.classes.own[[j]], made.core.model.fixed[j]
    rest = float(fixed - (K @ modes.covariance_b @ K.T)[0, 0])
    L = np.vstack([np.eye(2 * t), np.hstack([np.zeros((1, t)), K])])
    joint = L @ whole.cov @ L.T
    joint[-1, -1] += rest
    step = np.eye(2 * t, 2 * t + 1)
    step[t + j, -1] = -1.0
    expected = step @ joint @ step.T
    expected[t + j, t + j] += fixed
    found = after.core.filter.full
    assert found is not None
    assert np.allclose(found.cov, expected, atol=1e-9 * np.abs(expected).max())
    assert not after.core.masked.meters[j]
    assert after.core.masked.meters.sum() == 2
    assert after.front.trust.trusted[j]


def test_few_meters_are_refused() -> None:
    """Two meters contradict each other, and nothing more."""
    rows = tuple(
        replace(row, meter=row.meter if k < 2 else "") for k, row in enumerate(site().tables.customers)
    )
    with pytest.raises(NotObservable):
        design(from_tables(replace(site().tables, customers=rows)))
