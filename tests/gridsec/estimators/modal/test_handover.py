"""The observer of the inverters after a pause and after a restart, against AC power flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.estimators.front import ObserverRecord, settling_s
from gridsec.estimators.front.observer import advance_inverters
from gridsec.estimators.modal import monitor
from gridsec.estimators.modal.monitor import ModalDesign, ModalState, observed, resume
from gridsec.estimators.plant import Plant
from gridsec.interface import Decision
from gridsec.observers.lure import close_loop
from tests.gridsec.estimators.modal.streets import prepare, watch
from tests.gridsec.street import BASE_KVA, Street, make_plant

CUSTOMERS = 8


def slow(plant: Plant, tau: float) -> Plant:
    """The plant with inverters of one time constant, s."""
    return replace(plant, droop=replace(plant.droop, tau=np.full(plant.droop.tau.size, tau)))


def settled(seed: int, tau: float, *, extreme: bool = False) -> tuple[ModalDesign, Street, ModalState]:
    """A street with a monitor that is CLEAN and whose observer has settled."""
    rng = np.random.default_rng(seed)
    made = slow(make_plant(rng, customers=CUSTOMERS, drop=0.05), tau)
    design, street = prepare(made), Street(made, rng, extreme=extreme)
    state, answers = watch(street, design, 12 + round(6.0 * tau) if tau < 5.0 else 30)
    if tau >= 5.0:
        # The rest of a long settling time is known in closed form.
        state = replace(state, front=replace(state.front, transient=0.0 * state.front.transient))
    assert tau >= 5.0 or answers[-1][1].decision is Decision.CLEAN
    return design, street, state


def record(design: ModalDesign, state: ModalState) -> ObserverRecord:
    found = observed(design, state)
    assert found is not None
    return found


def again(design: ModalDesign, street: Street, before: ObserverRecord) -> ModalState:
    """A restarted monitor whose first frame is a second later."""
    return resume(design, monitor.init(design, street.t + 1.0), before)


def test_the_transient_decays_with_the_certificate() -> None:
    rng = np.random.default_rng(2)
    made = make_plant(rng, customers=CUSTOMERS, drop=0.05)
    design, street = prepare(made), Street(made, rng)
    state, _ = watch(street, design, 1)
    whole = np.abs(close_loop(made.feeder, made.droop, made.meters).C) @ (2.0 * made.droop.limit)
    np.testing.assert_allclose(state.front.transient, whole, rtol=1e-12)
    state, _ = watch(street, design, 5, h=0.5, state=state)
    np.testing.assert_allclose(
        state.front.transient, whole * np.exp(-2.5 * design.certificate.rate), rtol=1e-12
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_restart_without_a_gap_continues_the_observer(seed: int) -> None:
    """Injections as without a restart; a fresh start is an order of magnitude further away."""
    design, street, state = settled(seed, 2.0)
    begun = again(design, street, record(design, state))
    street.usual = 0.2 * street.usual
    street.advance(1.0)
    frame = street.frame()
    after, estimate, verdict = monitor.step(design, begun, frame)
    through, same, _ = monitor.step(design, state, frame)
    fresh = monitor.step(design, monitor.init(design, street.t), frame)[0]
    assert after.front.x is not None
    assert through.front.x is not None
    assert fresh.front.x is not None
    np.testing.assert_allclose(after.front.x, through.front.x, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(after.front.transient, through.front.transient, rtol=1.0, atol=1e-12)
    assert np.abs(fresh.front.x - through.front.x).max() > 1e-4
    # The load errors of earlier frames are not restored.
    assert np.abs(estimate.v2 - same.v2).max() < 3.0 * estimate.std.max()
    assert verdict.decision is Decision.CLEAN


@pytest.mark.canary("20-60.0-2")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("tau", [2.0, 10.0, 60.0])
@pytest.mark.parametrize("gap", [1, 2, 5, 20, 60, 120])
def test_the_bound_holds_after_any_gap(gap: int, tau: float, seed: int) -> None:
    """Loads go on and off in the gap, all errors are at their ends, and a meter is manipulated from it on."""
    design, street, state = settled(seed, tau, extreme=True)
    before, rng, usual = record(design, state), np.random.default_rng(seed), street.usual
    for _ in range(gap - 1):
        # Full load, or sun beyond the load.
        street.usual = usual * rng.choice([-3.0, 0.0, 1.0, 3.0])
        street.advance(1.0)
    street.usual = usual
    begun = again(design, street, before)
    assert (begun.front.x is None) == (gap > settling_s(design.front))
    lies = {int(rng.integers(CUSTOMERS)): float(rng.choice([-0.12, 0.12]))}
    for k in range(8):
        street.advance(1.0)
        begun, estimate, verdict = monitor.step(design, begun, street.frame(lies))
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all(), k
        assert verdict.decision is not Decision.CLEAN
        assert set(np.flatnonzero(verdict.suspects)) <= set(lies)


def _fine(design: ModalDesign, street: Street, x: Floats, h: float) -> Floats:
    """The lags of all inverters behind the true voltages, in short steps."""
    plant, all_driven, dt = design.plant, np.ones(x.size, dtype=np.bool_), 0.05
    at = plant.feeder.bus[plant.droop.customer]
    for _ in range(round(h / dt)):
        street.advance(dt)
        x, _ = advance_inverters(design.front, x, street.voltages()[at] ** 2, all_driven, None, dt)
    return x


@pytest.mark.canary("0-3.0", "1-6.0")
@pytest.mark.parametrize("gap_s", [3.0, 6.0])
@pytest.mark.parametrize("seed", range(10))
def test_the_transient_contains_what_happened_in_a_pause(seed: int, gap_s: float) -> None:
    """Loads jump at some moment of the pause, and the inverters respond."""
    design, street, state = settled(seed, 2.0)
    street.wobble, before = 0.0, state.front.x
    # Loads hold until they jump: by a drift, voltages would leave the range between both ends.
    street.usual, street.level = street.p, 0.0 * street.level
    assert before is not None
    plant = design.plant
    # Inverters that are still off the observer would move the voltages before the jump.
    street.x = before.copy()
    exact = street.voltages()[plant.feeder.bus[plant.droop.customer]] ** 2
    error = replace(state.front.injection_error, input=exact)
    state = replace(state, front=replace(state.front, injection_error=error))
    rng = np.random.default_rng(seed)
    first = float(rng.uniform(0.2, 0.95)) * gap_s
    x = _fine(design, street, before, first)
    street.usual = street.usual * rng.uniform(-1.0, 2.0, CUSTOMERS)
    x = _fine(design, street, x, gap_s - first)
    frame = replace(street.frame(), t=state.front.t + gap_s, y=street.truth()[plant.meters])
    after, _, verdict = monitor.step(design, state, frame)
    assert after.front.x is not None
    effect = np.abs(close_loop(plant.feeder, plant.droop, plant.meters).C @ (after.front.x - x))
    assert (effect <= after.front.transient + 1e-6).all()
    assert (after.front.transient <= design.front.inverter_reach).all()
    if (after.front.transient > design.options.settled * verdict.threshold).any():
        assert verdict.decision is not Decision.CLEAN


def test_a_calm_pause_ends_with_a_verdict_and_a_moved_one_settles() -> None:
    design, street, state = settled(3, 2.0)
    street.wobble, kept = 0.0, record(design, state)
    street.t += 3.0
    calm, moved = again(design, street, kept), again(design, street, kept)
    street.advance(1.0)
    assert monitor.step(design, calm, street.frame())[2].decision is Decision.CLEAN
    street.usual = street.usual - 20.0 / BASE_KVA
    street.t -= 1.0
    street.advance(1.0)
    after, _, verdict = monitor.step(design, moved, street.frame())
    assert verdict.decision is Decision.UNDECIDED
    assert (after.front.transient > 5.0 * design.options.settled * design.front.allowed).any()
    # The same jump within a tick is no pause.
    assert (
        monitor.step(design, state, replace(street.frame(), t=state.front.t + 1.0))[0].front.transient.max()
        < 1e-3
    )


def test_records_that_are_too_old_are_not_used() -> None:
    design, street, state = settled(1, 2.0)
    kept, limit = record(design, state), settling_s(design.front)
    rate, allowed = design.certificate.rate, design.front.allowed
    left = design.front.inverter_reach * np.exp(-rate * limit)
    assert (left <= design.options.settled * allowed).all()
    assert (left > design.options.settled * allowed * np.exp(-rate * design.front.step_s)).any()
    for age, used in ((limit, True), (limit + 1.0, False), (0.0, False), (-5.0, False)):
        begun = monitor.init(design, kept.t + age)
        assert (resume(design, begun, kept) is not begun) == used
    assert observed(design, monitor.init(design, street.t)) is None


def test_without_inverters_there_is_nothing_to_store() -> None:
    rng = np.random.default_rng(1)
    made = make_plant(rng, customers=CUSTOMERS, inverters=np.zeros(0, dtype=np.intp))
    design, street = prepare(made), Street(made, rng)
    state, _ = watch(street, design, 3)
    state, answers = watch(street, design, 2, h=20.0, state=state)
    assert answers[-1][1].decision is Decision.CLEAN
    assert observed(design, state) is None
    assert settling_s(design.front) == 0.0
