"""Busbar readings that come and go, meters that pause, frames that stay away, and what is not metered."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gridsec.estimators.front import FrontOptions, LoadDoubt
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalDesign, ModalState
from gridsec.estimators.plant import Plant
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.interface import Decision, Frame
from tests.gridsec.estimators.modal.streets import prepare, watch
from tests.gridsec.street import BASE_KVA, Street, accuracy, make_plant

LIAR = 4


@cache
def watched_calm(seed: int) -> tuple[ModalDesign, Street, ModalState]:
    """A street of meters without fixed errors, watched for ten minutes."""
    plant = make_plant(np.random.default_rng(3), customers=9, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(seed), load_kw=0.5)
    street.bias[:] = street.busbar_bias = 0.0
    return made, street, watch(street, made, 600)[0]


def calm(seed: int = 4) -> tuple[ModalDesign, Street, ModalState]:
    """As `watched_calm`, with a street of its own: a street changes with each frame."""
    made, street, state = watched_calm(seed)
    return made, deepcopy(street), state


@pytest.mark.canary("3-40")
@pytest.mark.parametrize(("every", "ticks"), [(3, 40), (2, 60), (3, 60)])
def test_a_busbar_that_is_read_now_and_then_hides_no_small_lie(every: int, ticks: int) -> None:
    """Long means go on, as those of a feeder whose busbar nobody reads, and find what they always find."""
    delays = []
    for gaps in (0, every):
        made, street, state = calm()
        named = []
        for k in range(ticks):

            def lost(frame: Frame, k: int = k, gaps: int = gaps) -> Frame:
                return replace(frame, v0_squared=np.nan) if gaps and k % gaps == 0 else frame

            state, [(_, verdict)] = watch(street, made, 1, state=state, lies={LIAR: 0.002}, change=lost)
            assert not np.delete(verdict.suspects, LIAR).any()
            named.append(bool(verdict.suspects[LIAR]))
        delays.append(named.index(True))
    assert delays[1] <= delays[0] + 5


@pytest.mark.canary("0.0015")
@pytest.mark.parametrize("size", [0.0015, 0.0018])
def test_a_named_liar_that_pauses_is_not_believed_for_it(size: float) -> None:
    """Means that spoke against a meter and have too few of its readings have not changed their minds."""
    made, street, state = calm()
    state, before = watch(street, made, 80, state=state, lies={LIAR: size})
    assert before[-1][1].suspects[LIAR]
    state, silent = watch(street, made, 15, state=state, lies={LIAR: size}, silent=(LIAR,))
    state, after = watch(street, made, 65, state=state, lies={LIAR: size})
    assert all(verdict.suspects[LIAR] for _, verdict in (*silent, *after))
    state, honest = watch(street, made, 90, state=state)
    assert not honest[-1][1].suspects.any()


def white(customers: int, time_s: float) -> tuple[Plant, ModalDesign]:
    """Meters whose only error is a jitter of 0.2 %, and loads that are known to 0.6 kW for some time."""
    none = np.array([], dtype=np.intp)
    plain = make_plant(np.random.default_rng(3), customers=customers, drop=0.06, inverters=none)
    tiny = np.full(customers, 1e-5)
    meters = MeterAccuracy(tiny, 0.1 * tiny, np.full(customers, 0.002), 1e-5, 1e-6, 2e-4)
    plant = Plant(plain.feeder, plain.droop, plain.meters, meters)
    doubt = LoadDoubt(np.full(customers, 0.6 / BASE_KVA), np.full(customers, 0.2 / BASE_KVA), time_s)
    return plant, monitor.design(plant, doubt=doubt, step_s=1.0, options=FrontOptions(commission_s=0.0))


@pytest.mark.canary("600.0")
@pytest.mark.parametrize("time_s", [600.0, 86400.0])
def test_after_a_pause_nothing_is_remembered_of_loads_that_were(time_s: float) -> None:
    """Twelve correlation times: residuals of before say nothing of the loads that there are now."""
    plant, made = white(12, time_s)
    wide = np.sqrt(3.0) * np.array([0.6, 0.2]) / BASE_KVA
    off = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        street = Street(plant, rng, load_kw=1.0, wobble=0.0)
        street.bias[:] = street.busbar_bias = 0.0
        state = monitor.init(made, street.t)
        for k in range(70):
            if k % 65 == 0:
                wrong = rng.normal(size=(2, 12)) * np.array([[0.6], [0.2]]) / BASE_KVA
            street.advance(12.0 * time_s if k == 65 else 1.0)
            at = plant.feeder.bus[plant.meters]
            v = street.voltages()[at] + 0.002 * rng.normal(size=12)
            frame = replace(
                street.frame(),
                y=v**2,
                v0_squared=street.v0**2,
                p=street.p + wrong[0],
                q=street.p * street.tan + wrong[1],
                p_error=np.full(12, wide[0]),
                q_error=np.full(12, wide[1]),
            )
            state, estimate, _ = monitor.step(made, state, frame)
            if k >= 65:
                truth = street.voltages()[plant.feeder.bus] ** 2
                off.append((estimate.v2 - truth) / estimate.std)
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_inverters_without_a_meter_see_the_voltage_of_now() -> None:
    """Frames a quarter of an hour apart, with the busbar up and down: against AC power flow, every time."""
    feeder = make_plant(np.random.default_rng(3), customers=12, drop=0.06).feeder
    own = np.array([8, 9, 10, 11])
    droop = fleet(own, ["ieee1547-b"] * 4, np.full(4, 40.0), BASE_KVA)
    plant = Plant(feeder, droop, np.arange(8), accuracy(8))
    doubt = LoadDoubt(np.full(12, 0.1 / BASE_KVA), np.full(12, 0.05 / BASE_KVA), 600.0)
    options = FrontOptions(commission_s=0.0)
    made = monitor.design(plant, doubt=doubt, step_s=900.0, options=options)
    street = Street(plant, np.random.default_rng(4), load_kw=0.5, wobble=0.0)
    street.bias[:] = street.busbar_bias = 0.0
    street.tan[:], street.p_bias[:] = 0.25, 0.0
    state, most = None, 0.0
    for k in range(12):
        street.v0 = 1.07 if k % 2 else 1.0
        state, [(estimate, verdict)] = watch(street, made, 1, h=900.0, state=state)
        if k > 1:
            assert verdict.decision is Decision.CLEAN
            np.testing.assert_allclose(estimate.x, street.x, atol=0.004)
            most = max(most, float(np.abs(street.x).max()))
    assert most > 0.05


def test_half_widths_below_zero_are_none() -> None:
    """A power of which a frame says so is not known, nor believed: no bound is below what is true."""
    none = np.array([], dtype=np.intp)
    plant = make_plant(np.random.default_rng(3), customers=6, drop=0.06, meters=np.arange(3), inverters=none)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4), load_kw=0.5)
    off = np.array([0.0, 0.0, 0.0, 0.03, 0.03, 0.03])

    def wrong(frame: Frame) -> Frame:
        error = np.where(off > 0.0, -0.03, frame.p_error)
        return replace(frame, p=frame.p + off, p_error=error, q_net_error=-np.ones(6), q_net=np.zeros(6))

    state, _ = watch(street, made, 3)
    _, [(estimate, _)] = watch(street, made, 1, state=state, change=wrong)
    truth = street.voltages()[plant.feeder.bus] ** 2
    assert (np.abs(estimate.v2 - truth) <= estimate.bound).all()


def test_nothing_jumps_when_meters_have_been_learned() -> None:
    """The frame with which learning ends is judged as the one before it."""
    none = np.array([], dtype=np.intp)
    plant = make_plant(np.random.default_rng(3), customers=9, drop=0.06, inverters=none)
    doubt = LoadDoubt(np.full(9, 2.0 / BASE_KVA), np.full(9, 1.0 / BASE_KVA), 600.0)
    made = monitor.design(plant, doubt=doubt, step_s=1.0, options=FrontOptions(commission_s=70.0))
    street = Street(plant, np.random.default_rng(4), load_kw=1.0)
    street.bias[:] = street.busbar_bias = 0.0
    off = np.random.default_rng(0).normal(0.0, 0.02, 9)
    wide = np.full(9, 0.035)

    def wrong(frame: Frame) -> Frame:
        return replace(frame, p=frame.p + off, p_error=wide, q_error=0.5 * wide)

    state, stds, learned = None, [], []
    for _ in range(80):
        state, [(estimate, _)] = watch(street, made, 1, state=state, change=wrong)
        stds.append(float(estimate.std.max()))
        learned.append(state.front.learning is None)
    first = learned.index(True)
    assert 60 < first < 79
    assert stds[first] <= 1.05 * stds[first - 1]
    assert stds[first + 1] <= 1.05 * stds[first]


def test_an_inverter_off_its_curve_is_named_until_it_follows_it_again() -> None:
    """Also while its reactive power is not reported."""
    plain = make_plant(np.random.default_rng(3), customers=6, drop=0.06)
    droop = fleet(np.array([5]), ["ieee1547-b"], np.full(1, 30.0), BASE_KVA)
    plant = Plant(plain.feeder, droop, plain.meters, plain.accuracy)
    doubt = LoadDoubt(np.full(6, 0.1 / BASE_KVA), np.full(6, 0.05 / BASE_KVA), 600.0)
    options = FrontOptions(commission_s=0.0)
    made = monitor.design(plant, doubt=doubt, step_s=1.0, options=options)
    street = Street(plant, np.random.default_rng(4), load_kw=0.5, wobble=0.0, metered_q=np.arange(6))
    street.bias[:] = street.busbar_bias = 0.0
    street.tan[:], street.p_bias[:] = 0.25, 0.0
    state, before = watch(street, made, 25)
    assert before[-1][1].decision is Decision.CLEAN
    for _ in range(40):
        street.advance(1.0)
        street.x[:] = -plant.droop.limit
        state, _, verdict = monitor.step(made, state, street.frame())
    assert verdict.inverters.all()

    def untold(frame: Frame) -> Frame:
        return replace(frame, q_net=np.full(6, np.nan))

    # Neither silence nor another injection beyond the curve clears it.
    for part in (1.0, 0.4):
        for _ in range(60):
            street.advance(1.0)
            street.x[:] = -part * plant.droop.limit
            state, _, verdict = monitor.step(made, state, untold(street.frame()))
        assert verdict.inverters.all()
    street.rest()
    state, after = watch(street, made, 200, state=state, change=untold)
    assert not after[-1][1].inverters.any()
    assert after[-1][1].decision is Decision.CLEAN


@pytest.mark.canary("1.0")
@pytest.mark.parametrize("busbar", [0.0, 1.0])
def test_meters_without_errors_and_a_busbar_that_says_nothing(busbar: float) -> None:
    """Two perfect meters at one bus, and a class of 100 %: limits are numbers, and what lies is seen."""
    none, zero = np.array([], dtype=np.intp), np.zeros(5)
    plain = make_plant(np.random.default_rng(3), customers=5, drop=0.02, inverters=none)
    feeder = replace(plain.feeder, bus=np.array([1, 1, 2, 3, 4]))
    plant = Plant(feeder, plain.droop, plain.meters, MeterAccuracy(zero, zero, zero, busbar, 0.0, 0.0))
    doubt = LoadDoubt(zero + 0.6 / BASE_KVA, zero + 0.2 / BASE_KVA, 600.0)
    made = monitor.design(plant, doubt=doubt, step_s=1.0, options=FrontOptions(commission_s=0.0))
    street = Street(plant, np.random.default_rng(4), load_kw=0.5)
    street.busbar_bias = 0.0
    _, told = watch(street, made, 5)
    assert all(np.isfinite(verdict.threshold).all() for _, verdict in told)
