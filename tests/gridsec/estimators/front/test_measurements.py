"""Clock offsets: changes of the voltages within them, and the answers of the estimator `modal`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.clock_offsets import TAP_PU, run
from benchmarks.late_powers import site, watcher, world
from feeders.model.site import Snapshot, to_frame
from feeders.simulation.scenario import START
from gridsec.arrays import Floats
from gridsec.estimators.detection import AGREEMENT
from gridsec.estimators.front.measurements import (
    SYNCHRONOUS_S,
    Measurements,
    frame_prior,
    frame_variance,
    largest_offset,
    measurements,
    nominal_uncertainty,
    unusable_offsets,
    update_skew,
    update_uncertainty,
    without_shifted_busbar,
)
from gridsec.estimators.front.output import with_clock_offsets
from gridsec.estimators.modal.monitor import init, step
from gridsec.grid.network import Power
from gridsec.interface import Cause, Decision, PowerOrigin
from tests.gridsec.estimators.modal.streets import front_end, prepare
from tests.gridsec.street import Street, make_plant

P = 8


def test_changes_are_those_of_the_definition() -> None:
    """Against all pairs of ticks, for random voltages and powers: each source with its own lag."""
    made = front_end(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    rng, most, ticks = np.random.default_rng(2), 15.0, 80
    # The last but three is the largest usable offset; the next is beyond that.
    offset = np.array([0.5, -0.9, 2.0, -3.0, most, most + 0.1, np.nan, 0.0])
    lead = np.where(np.abs(np.nan_to_num(offset)) <= most, np.nan_to_num(offset), 0.0)
    model, frame, skew = made.plant.feeder.linear(), Street(made.plant, rng).frame(), None
    measured = measurements(made, frame, frame.seen, np.ones(1, dtype=np.bool_), 1.0)
    R, X = (2.0 * each[made.plant.feeder.bus][made.plant.meters] for each in (model.R_bus, model.X_bus))
    # Powers that move by much at every tick, so that each with an offset is a source.
    sign = rng.choice([-1.0, 1.0], (2, ticks, frame.p.size))
    p, q = 0.3 * sign * rng.uniform(1.0, 2.0, sign.shape)
    of_power = [p[:, [c]] * R[:, c] + q[:, [c]] * X[:, c] for c in made.plant.meters]
    rest = 1.0 + 0.01 * rng.standard_normal((ticks, P))
    sources = [(of_power[i], lead - lead[i]) for i in np.flatnonzero(lead)]
    others = rest + sum(of_power[i] for i in np.flatnonzero(lead == 0.0))
    sources.append((others, np.where(lead == 0.0, -SYNCHRONOUS_S, lead)))

    def window(lag: float) -> int:
        return 0 if lag == 0.0 else 1 if abs(lag) <= SYNCHRONOUS_S else int(np.ceil(abs(lag))) + 1

    def later(x: Floats, lag: float, t: int, j: int, k: int) -> float:
        return abs(x[t + k, j] - x[t, j]) if lag < 0.0 and k <= window(lag) else 0.0

    for t in range(ticks):
        v2 = rest[t] + sum(each[t] for each in of_power)
        now = replace(measured, frame=replace(frame, p=p[t]), q=q[t])
        skew = update_skew(made, skew, offset, now, v2)
        assert skew is not None
        back = min(t, 4)  # readings from before the last tick
        for j in range(P):
            change = sum(
                max((abs(x[t, j] - x[t - k, j]) for k in range(1, min(window(lag[j]), t) + 1)), default=0.0)
                for x, lag in sources
            )
            ahead = (sum(later(x, lag[j], t - back, j, k) for x, lag in sources) for k in range(1, back + 1))
            assert skew.change[j] == pytest.approx(change, rel=1e-6, abs=1e-12)
            assert skew.later[-1 - back, j] == pytest.approx(max(ahead, default=0.0), rel=1e-6, abs=1e-12)
        assert skew.wait == 16
    assert unusable_offsets(made, offset).tolist() == [k == 5 for k in range(P)]
    assert largest_offset(made) == most
    assert largest_offset(replace(made, step_s=900.0)) == 225.0


@pytest.mark.parametrize("offset", [None, np.zeros(P), np.full(P, np.nan)])
def test_without_a_measured_offset_nothing_is_kept(offset: np.ndarray | None) -> None:
    made = front_end(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    frame = Street(made.plant, np.random.default_rng(2)).frame()
    now = measurements(made, frame, frame.seen, np.ones(1, dtype=np.bool_), 1.0)
    kept = update_skew(made, None, np.full(P, 1.0), now, np.ones(P))
    assert kept is not None
    assert update_skew(made, kept, offset, now, np.ones(P), last=(np.ones(P), frame)) is None


def test_a_step_beyond_the_class_may_be_a_tick_apart_without_an_offset() -> None:
    """Unknown by its size at its tick and at the one before; nothing of it is kept. Not over long ticks."""
    made = front_end(make_plant(np.random.default_rng(1), customers=P, drop=0.02))
    frame, v2 = Street(made.plant, np.random.default_rng(2)).frame(), np.ones(P)
    step = made.allowed * np.where(np.arange(P) == 3, 1.01, 0.5)

    def of(moved: Floats) -> Measurements:
        return measurements(made, replace(frame, y=frame.y + moved), frame.seen, np.ones(1, np.bool_), 1.0)

    now, last = of(step), (v2, frame)
    skew = update_skew(made, None, None, now, v2 + step, last=last)
    assert skew is not None
    np.testing.assert_allclose(skew.change, step, rtol=1e-9)
    np.testing.assert_allclose(skew.later, [step, 0.0 * step], rtol=1e-9)
    assert skew.due
    assert skew.replayed.single
    # Until the next replay may be due, its age is kept.
    skew = skew.replayed
    for age in (1, 2, 3):
        skew = update_skew(made, skew, None, now, v2 + step, last=(v2 + step, frame))
        assert skew is not None
        assert (skew.since, skew.due, float(skew.change.max())) == (age, False, 0.0)
    assert update_skew(made, skew, None, now, v2 + step, last=(v2 + step, frame)) is None
    assert update_skew(made, None, None, of(0.9 * step), v2 + 0.9 * step, last=last) is None
    assert update_skew(replace(made, step_s=60.0), None, None, now, v2 + step, last=last) is None
    # Readings that stay do not follow.
    assert update_skew(made, None, None, of(0.2 * step), v2 + step, last=last) is None
    assert update_skew(made, None, None, of(0.3 * step), v2 + step, last=last) is not None


@pytest.mark.canary("0.45-240-1")
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("largest_s", "duration_s"), [(0.3, 360), (0.45, 360), (0.45, 240)])
def test_tap_steps_accuse_no_meter_with_a_clock_within_half_a_second(
    largest_s: float, duration_s: int, seed: int
) -> None:
    """Offsets that are not measured; a third that is manipulated at the end is named."""
    seen, _ = run(seed, duration_s, TAP_PU, largest_s, measured=True)
    assert seen["honest"] == 0
    assert seen["named"] == seen["liars"] > 0
    assert seen[Decision.CLEAN] > 0.95 * seen["ticks"] > 0.0


def test_all_clocks_off_and_a_still_feeder_is_clean_and_liars_are_named() -> None:
    """Offsets of 15 s, the largest usable ones."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4))
    state, offset = init(made, street.t - 1.0), np.full(P, largest_offset(made.front))
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
    assert state.front.clock_skew is None


def test_a_meter_with_an_unusable_offset_is_neither_clean_nor_accused() -> None:
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
    made, one = front_end(plant), Street(plant, np.random.default_rng(2)).frame()
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


def test_uncertainty_of_a_frame_is_that_of_its_tick() -> None:
    """Factors by powers of two from four times the design's half-width on; back at the next usual frame."""
    plant = make_plant(np.random.default_rng(3), customers=3, drop=0.02)
    made, frame = front_end(plant), Street(plant, np.random.default_rng(4)).frame()
    known, rng = np.sqrt(3.0) * np.maximum(made.doubt.p, 1e-6), np.random.default_rng(5)
    now = nominal_uncertainty(made)
    for _ in range(200):
        ratio = np.exp2(rng.integers(0, 10, 3))
        given = replace(frame, p_error=ratio * known)
        now = update_uncertainty(made, now, given, frame.seen, busbar=True)
        assert (4.0 * now.p >= ratio).all()
        assert (now.p <= 4.0 * np.maximum(ratio, 1.0)).all()
        assert (np.log2(now.p) % 1.0 == 0.0).all()
        assert update_uncertainty(made, now, given, frame.seen, busbar=True) is now
    now = update_uncertainty(made, now, replace(frame, p_error=known), frame.seen, busbar=True)
    assert now.usual
    assert frame_prior(made, now) is made.prior


@pytest.mark.parametrize("busbar", [True, False])
def test_prior_of_a_frame_by_the_matrices(*, busbar: bool) -> None:
    """An unread power: half of its variance is common; a missing busbar voltage is unknown by 0.1."""
    none = np.zeros(0, dtype=np.intp)
    plant = make_plant(np.random.default_rng(3), customers=5, drop=0.02, inverters=none)
    made, frame = front_end(plant), Street(plant, np.random.default_rng(4)).frame()
    origin = np.where(np.arange(5) == 2, PowerOrigin.UNREAD, PowerOrigin.READ)
    error = np.where(np.arange(5) == 2, 0.1, frame.p_error)
    given = replace(frame, p_error=error, p_origin=origin)
    now = update_uncertainty(made, nominal_uncertainty(made), given, frame.seen, busbar=busbar)
    assert now.vouched.tolist() == [k != 2 for k in range(5)]
    p, q = (
        np.where(np.arange(5) == 2, wide / np.sqrt(3.0), usual)
        for wide, usual in ((error, made.doubt.p), (frame.q_error, made.doubt.q))
    )
    g = np.sqrt(np.where(np.arange(5) == 2, 0.5, 0.0))
    alone, model = np.sqrt(1.0 - g**2), plant.feeder.linear()
    u = 2.0 * model.R_bus @ (g * p) + 2.0 * model.X_bus @ (g * q)
    S = np.zeros((6, 6))
    for matrix, s, c in ((model.R_bus, p, made.doubt.common_p), (model.X_bus, q, made.doubt.common_q)):
        V = (1.0 - c) * np.diag((alone * s) ** 2) + c * np.outer(alone * s, alone * s)
        S += 4.0 * matrix @ V @ matrix.T
    S += np.outer(u, u) + (made.busbar if busbar else 0.1) ** 2
    found = frame_prior(made, now)
    np.testing.assert_allclose(found.covariance, S[:, made.prior.meters], rtol=1e-9)
    np.testing.assert_allclose(found.variance, np.diag(S), rtol=1e-9)
    np.testing.assert_allclose(frame_variance(made, now), np.diag(S), rtol=1e-9)


@pytest.mark.acceptance
def test_load_and_tap_steps_accuse_meters_without_measured_offsets() -> None:
    unknown, _ = run(0, 480, TAP_PU, measured=False)
    assert unknown["honest"] > 0


@pytest.mark.acceptance
@pytest.mark.parametrize("largest_s", [3.0, 15.0])
@pytest.mark.parametrize("tap_pu", [0.0, TAP_PU])
def test_load_and_tap_steps_accuse_no_meter_with_a_measured_offset(tap_pu: float, largest_s: float) -> None:
    """Three runs each; a third that is manipulated at the end is named."""
    for seed in range(3):
        measured, _ = run(seed, 480, tap_pu, largest_s, measured=True)
        assert measured["named"] == measured["liars"]
        assert measured["honest"] == 0
        assert measured[Decision.ATTACKED] == 0
        assert measured[Decision.CLEAN] > (0.5 if largest_s < 15.0 else 0.15) * measured["ticks"]


@pytest.mark.parametrize("size", [0.03, 0.015])
def test_a_meter_that_alternates_behind_a_clock_offset_is_not_clean(size: float) -> None:
    """Voltage and power of meter 3 are those of a load that comes and goes; its clock explains the others."""
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4), wobble=0.0)
    offset, said = np.where(np.arange(P) == 3, 1.0, np.nan), []
    customer, state = int(plant.meters[3]), init(made, street.t - 1.0)
    effect = 2.0 * plant.feeder.self_impedance(Power.ACTIVE)[customer]
    power = size / effect * (np.arange(plant.feeder.bus.size) == customer)
    for k in range(160):
        street.advance(1.0)
        frame = street.frame()
        lie = (k >= 60) * (k // 2 % 2)
        y = frame.y - lie * size * (np.arange(P) == 3)
        frame = replace(frame, y=y, p=frame.p - lie * power, clock_offset=offset)
        state, _, verdict = step(made, state, frame)
        said.append(verdict)
    assert all(one.decision is Decision.CLEAN for one in said[40:60])
    assert all(one.decision is not Decision.CLEAN for one in said[63:])


def test_changes_beyond_the_class_within_clock_offsets_are_not_clean() -> None:
    plant = make_plant(np.random.default_rng(3), customers=P, drop=0.02)
    made, frame = front_end(plant), Street(plant, np.random.default_rng(4)).frame()
    now = measurements(made, frame, frame.seen, np.ones(1, dtype=np.bool_), 1.0)
    skew = update_skew(made, None, np.where(np.arange(P) == 2, 1.0, np.nan), now, np.ones(P))
    assert skew is not None
    within, seen = made.allowed * np.where(np.arange(P) % 3 == 2, 1.01, 0.99), np.arange(P) != 5
    decision, cause, sentence = with_clock_offsets(made, frame, seen, replace(skew, change=within), AGREEMENT)
    assert (decision, cause) == (Decision.UNDECIDED, Cause.CLOCK_OFFSET)
    assert f"voltage of {made.names[2]} changes within the clock offsets" in sentence
    calm = replace(skew, change=0.99 * made.allowed)
    for each in (None, calm):
        assert with_clock_offsets(made, frame, seen, each, AGREEMENT) == AGREEMENT
