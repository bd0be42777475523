"""Meters that withhold the active power of their customer: AC power flow as the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.missing_powers import stealthy
from feeders.model.site import Site, Snapshot, from_tables, load, to_frame
from feeders.registry import DesignedEstimator, design
from feeders.simulation.demand import Variation
from feeders.simulation.scenario import START, Scenario, SimulatedTick, simulate, snapshots
from gridsec.arrays import Bools, Floats
from gridsec.estimators.front import FrontDesign
from gridsec.interface import Cause, Decision, Estimate, PowerOrigin, Verdict

LIARS = 19
WITHHELD_S = 20.0
"""Time from which powers are withheld, s after the start."""
LIE_S = 95.0
"""Time from which voltages are false, s."""


@cache
def site() -> Site:
    return load("kerber-dorfnetz")


@cache
def watcher() -> DesignedEstimator:
    return design(site())


@cache
def played(seed: int, duration_s: float = 150.0) -> tuple[tuple[SimulatedTick, Snapshot], ...]:
    """Honest readings and the truth, at a moment of the summer drawn from the seed."""
    profile_s = float(np.random.default_rng([seed, 146]).uniform(0.0, 13.0 * 86_400.0))
    variation = Variation(tap_step_pu=0.0)
    scenario = Scenario(seed=seed, duration_s=duration_s, profile_s=profile_s, variation=variation)
    samples = list(simulate(site(), scenario))
    return tuple(zip(samples, snapshots(samples), strict=True))


def street(count: int, seed: int) -> Bools:
    """Meters that the powers of one customer move most, (p,): its neighbours."""
    model = design_of()
    first = int(np.random.default_rng([seed, 7]).integers(model.prior.meters.size))
    between = model.prior.covariance[model.prior.meters]
    near = np.argsort(-between[first] / np.sqrt(between.diagonal()), kind="stable")
    out = np.zeros(near.size, dtype=np.bool_)
    out[near[:count]] = True
    return out


def design_of() -> FrontDesign:
    """The front end."""
    found: FrontDesign = watcher().design.front
    return found


def omitted(said: Snapshot, gone: Bools) -> Snapshot:
    return replace(said, p_kw=np.where(gone, np.nan, said.p_kw))


def absurd(said: Snapshot, gone: Bools) -> Snapshot:
    return replace(said, p_kw=np.where(gone, 9_000.0, said.p_kw))


def beyond(said: Snapshot, gone: Bools) -> Snapshot:
    """Almost twice what the connection carries, which is believed by a tenth."""
    peak = site().loads.load_peak[site().meters] * site().feeder.base_kva
    return replace(said, p_kw=np.where(gone, 1.9 * peak, said.p_kw))


def late(said: Snapshot, gone: Bools) -> Snapshot:
    return replace(said, p_age_s=np.where(gone, 60.0, np.nan))


@cache
def largest(seed: int, how: Callable[[Snapshot, Bools], Snapshot]) -> Floats:
    """The largest lie of a street within 70 % of every limit of the core, squared pu."""
    withhold, state = street(LIARS, seed), watcher().init(START)
    for sample, said in played(seed):
        age = sample.t - START
        if age == LIE_S:
            break
        told = how(said, withhold & (age >= WITHHELD_S))
        state, _, _ = watcher().step(state, to_frame(site(), told))
    lie = stealthy(watcher().design, state, np.flatnonzero(withhold))
    # More than a tenth of the accuracy class.
    assert np.abs(lie).max() > 5e-4
    return lie


def watch(
    seed: int,
    withhold: Bools,
    *,
    lying: bool,
    how: Callable[[Snapshot, Bools], Snapshot] = omitted,
) -> Iterator[tuple[SimulatedTick, Estimate, Verdict]]:
    """Answers from the first withheld power on, with the lie of `largest`."""
    at = site().customer_volt[site().meters]
    state = watcher().init(START)
    for sample, said in played(seed):
        age = sample.t - START
        lie = largest(seed, how) if lying and age >= LIE_S else np.zeros(withhold.size)
        told = how(said, withhold & (age >= WITHHELD_S))
        v = at * np.sqrt(np.maximum((said.v_volt / at) ** 2 + lie, 0.0))
        state, estimate, verdict = watcher().step(state, to_frame(site(), replace(told, v_volt=v)))
        if age >= WITHHELD_S:
            yield sample, estimate, verdict


def error(sample: SimulatedTick, estimate: Estimate) -> Floats:
    """Error of every customer's squared voltage, pu."""
    return np.asarray(np.abs(estimate.v2 - (sample.v_volt / site().customer_volt) ** 2))


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_colluding_meters_that_withhold_powers_are_never_clean_beyond_the_bound(
    seed: int,
) -> None:
    """A third of the meters, within 70 % of every limit of the core."""
    lied, off = 0, []
    for sample, estimate, verdict in watch(seed, street(LIARS, seed), lying=True):
        wrong = error(sample, estimate)
        assert (wrong <= estimate.bound).all()
        assert verdict.decision is not Decision.CLEAN or (wrong <= 4.0 * estimate.std).all()
        if sample.t - START >= LIE_S:
            lied += 1
            off.append((wrong / estimate.std).max())
    assert lied > 0
    assert max(off) < 4.0


@pytest.mark.canary("late")
@pytest.mark.parametrize("how", [absurd, beyond, late])
def test_powers_that_are_worth_nothing_are_as_good_as_withheld_ones(
    how: Callable[[Snapshot, Bools], Snapshot],
) -> None:
    """The same meters report powers that nothing connected can have, or old ones."""
    for sample, estimate, _ in watch(0, street(LIARS, 0), lying=True, how=how):
        if sample.t - START >= LIE_S:
            wrong = error(sample, estimate)
            assert (wrong <= estimate.bound).all()
            assert (wrong <= 4.0 * estimate.std).all()


@pytest.mark.canary("1-0")
@pytest.mark.parametrize(("count", "seed"), [(1, 0), (1, 1), (1, 2), (5, 3), (LIARS, 4)])
def test_withheld_powers_of_honest_meters_accuse_nobody(count: int, seed: int) -> None:
    for sample, estimate, verdict in watch(seed, street(count, seed), lying=False):
        wrong = error(sample, estimate)
        assert verdict.decision is not Decision.ATTACKED
        assert not verdict.suspects.any()
        assert (wrong <= estimate.bound).all()
        assert (wrong <= 5.0 * estimate.std).all()


def test_the_reason_names_the_setting_and_a_larger_one_is_clean() -> None:
    """The same readings, once with no precision asked for: CLEAN, and the same estimate."""
    meta = site().tables.meta
    loose = design(
        from_tables(
            replace(
                site().tables, meta=replace(meta, monitor=replace(meta.monitor, unread_std_percent=100.0))
            )
        )
    )
    withhold = np.ones(site().meters.size, dtype=np.bool_)
    tight, state = watcher().init(START), loose.init(START)
    for sample, said in played(0)[:30]:
        gone = withhold & (sample.t - START >= WITHHELD_S)
        frame = to_frame(site(), replace(said, p_kw=np.where(gone, np.nan, said.p_kw)))
        tight, one, verdict = watcher().step(tight, frame)
        state, other, answer = loose.step(state, frame)
        np.testing.assert_array_equal(one.v2, other.v2)
    assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.MISSING_POWERS)
    assert "unread_std_percent" in verdict.reason
    assert "0.5 %" in verdict.reason
    assert answer.decision is Decision.CLEAN


OMITTED, OUT_OF_RANGE = "No active power from ", "The active power of {} is beyond the declared range."


@pytest.mark.parametrize(
    ("how", "sentence"),
    # Powers 60 s old leave 0.3 %, less than the deviation asked for: the verdict is CLEAN.
    [(omitted, OMITTED), (beyond, OUT_OF_RANGE), (absurd, OUT_OF_RANGE)],
)
def test_the_reason_states_the_origin_of_the_power(
    how: Callable[[Snapshot, Bools], Snapshot], sentence: str
) -> None:
    """Every power is missing in the same way."""
    starts, _, ends = sentence.partition("{}")
    reasons = {
        verdict.reason
        for _, _, verdict in watch(0, np.ones(site().meters.size, dtype=np.bool_), lying=False, how=how)
        if verdict.cause is Cause.MISSING_POWERS
    }
    assert reasons
    assert all(reason.startswith(starts) and ends in reason for reason in reasons)
    assert all(any(name in reason for name in design_of().names) for reason in reasons)


def test_one_power_that_comes_back_is_forgotten() -> None:
    """A minute after the last withheld power the answer is that of a monitor with all powers."""
    gone = street(LIARS, 1)
    state, beside = watcher().init(START), watcher().init(START)
    for sample, said in played(1):
        missing = gone & (WITHHELD_S <= sample.t - START < WITHHELD_S + 10.0)
        frame = to_frame(site(), replace(said, p_kw=np.where(missing, np.nan, said.p_kw)))
        state, estimate, verdict = watcher().step(state, frame)
        beside, usual, _ = watcher().step(beside, to_frame(site(), said))
    assert verdict.decision is Decision.CLEAN
    # The filter keeps that ten ticks told less: 1.2e-6 a minute later.
    np.testing.assert_allclose(estimate.std, usual.std, rtol=1e-5)
    assert state.front.uncertainty.vouched.all()


def test_a_customer_without_a_meter_and_one_whose_file_expects_no_reading_are_as_before() -> None:
    """`p_std_kw` as wide as the range states that no power is expected: no verdict asks for one."""
    tables = site().tables
    rows = tuple(
        replace(row, meter="") if k == 3 else replace(row, p_std_kw=20.0, q_std_kvar=20.0) if k == 5 else row
        for k, row in enumerate(tables.customers)
    )
    stated = from_tables(replace(tables, customers=rows))
    made = design(stated)
    state, keep = made.init(START), np.arange(site().meters.size) != 3
    for _, said in played(2)[:30]:
        p_kw = said.p_kw.copy()
        p_kw[5] = np.nan
        small = Snapshot(said.t, said.v_volt[keep], p_kw[keep], said.q_kvar[keep], said.v0_volt)
        frame = to_frame(stated, small)
        assert frame.p_origin is not None
        assert frame.p_origin[[3, 5]].tolist() == [PowerOrigin.UNREAD] * 2
        state, _, verdict = made.step(state, frame)
    assert verdict.decision is Decision.CLEAN
    assert state.front.uncertainty.vouched.all()
