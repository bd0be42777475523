"""What stands while something is not read: accusations beside a silent busbar, and doubts about powers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import load, to_frame
from feeders.registry import SEQUENTIAL, choose, design
from feeders.simulation.scenario import Scenario, simulate, snapshots
from gridsec.attack import Attack, Replay, Stuck
from gridsec.estimators.sequential import SuspicionRecord, distrusted, init, warm_start
from gridsec.estimators.sequential.measurements import nominal_uncertainty, update_uncertainty
from gridsec.interface import Decision, Frame
from tests.gridsec.estimators.sequential.test_gaps import LIAR, calm
from tests.gridsec.estimators.sequential.test_monitor import prepare, watch
from tests.gridsec.street import Street, make_plant

WHO = np.array([3])


@pytest.mark.canary("0.0013-30")
@pytest.mark.parametrize("back", [30, 999])
@pytest.mark.parametrize("size", [0.0013, 0.0015])
def test_a_busbar_that_moves_unread_acquits_nobody(size: float, back: int) -> None:
    """All residuals move with it, of liars as of everybody: that is no end of a manipulation."""

    def unread(frame: Frame) -> Frame:
        return replace(frame, v0_squared=np.nan)

    made, street, state = calm(4)
    state, _ = watch(street, made, 65, state=state)
    state, _ = watch(street, made, 90, state=state, lies={LIAR: size})
    assert not state.trust.trusted[LIAR]
    state, _ = watch(street, made, 20, state=state, lies={LIAR: size}, change=unread)
    street.v0 *= 1.02
    said = []
    for k in range(130):
        change = unread if k < back else None
        state, [(_, verdict)] = watch(street, made, 1, state=state, lies={LIAR: size}, change=change)
        said.append(verdict.decision)
    assert Decision.CLEAN not in said


def test_powers_are_in_doubt_as_long_as_residuals_are_remembered_that_were_made_without_them() -> None:
    """The factor of a scale covers the worst tick within it, whatever came before and after that."""
    plant = make_plant(np.random.default_rng(3), customers=3, drop=0.02)
    made, street = prepare(plant), Street(plant, np.random.default_rng(4))
    rng, frame = np.random.default_rng(5), street.frame()
    known = np.sqrt(3.0) * np.maximum(made.doubt.p, 1e-6)
    state, ratios = nominal_uncertainty(made), []
    level = np.ones(3)
    for _ in range(400):
        level = np.where(rng.random(3) < 0.1, np.exp2(rng.integers(0, 10, 3)), level)
        ratios.append(level)
        state = update_uncertainty(
            made, state, replace(frame, p_error=level * known), frame.seen, busbar=True
        )
        for s, length in enumerate(made.lengths):
            worst = np.max(ratios[-length:], axis=0)
            assert (4.0 * state.p[s] >= worst).all()
    for _ in range(2 * made.lengths[-1]):
        state = update_uncertainty(made, state, replace(frame, p_error=known), frame.seen, busbar=True)
    assert (state.p == 1.0).all()


@pytest.mark.canary("60")
@pytest.mark.parametrize("silent", [60, 120])
def test_silence_clears_no_inverter(silent: int) -> None:
    """As many readings as without: ticks at which nobody is heard say nothing of anybody."""
    plant = make_plant(np.random.default_rng(4), customers=12, drop=0.03, inverters=np.arange(5))
    made, after = prepare(plant), []
    for quiet in (0, silent):
        street = Street(plant, np.random.default_rng(6))
        before = replace(SuspicionRecord.empty(12, 5), inverters=np.arange(5) == 1)
        state = warm_start(made, init(made, street.t), before)
        state, nothing = watch(street, made, quiet, state=state, silent=tuple(range(12)))
        assert all(verdict.inverters[1] for _, verdict in nothing)
        state, answers = watch(street, made, 80, state=state)
        after.append([bool(verdict.inverters[1]) for _, verdict in answers].index(False))
    assert abs(after[1] - after[0]) <= 1


def test_only_those_who_feel_an_inverter_clear_it() -> None:
    """A meter at the other end of the feeder says nothing of it."""
    plant = make_plant(np.random.default_rng(4), customers=12, drop=0.03, inverters=np.arange(5))
    made, street = prepare(plant), Street(plant, np.random.default_rng(6))
    felt = plant.feeder.linear().X[plant.meters, plant.droop.customer[1]]
    far = int(np.argmin(felt))
    assert felt[far] < 0.2 * felt.max()
    state = warm_start(
        made, init(made, street.t), replace(SuspicionRecord.empty(12, 5), inverters=np.arange(5) == 1)
    )
    others = tuple(j for j in range(12) if j != far)
    state, answers = watch(street, made, 100, state=state, silent=others)
    assert all(verdict.inverters[1] for _, verdict in answers)


@pytest.mark.canary("attack1-500-800")
@pytest.mark.parametrize(
    ("attack", "restart", "ticks"),
    [(Stuck(WHO, 1_320.0, 9e9), 560, 1_100), (Replay(WHO, 1_420.0, 9e9, delay_s=100.0), 500, 800)],
)
def test_who_repeats_himself_is_not_believed_until_that_would_be_noticed_anew(
    attack: Attack, restart: int, ticks: int
) -> None:
    """A monitor that begins anew remembers no reading: honest values of once look honest to it at first."""
    site = choose(load("simbench-lv-rural1"), estimator=SEQUENTIAL)
    made, played = design(site), Scenario(seed=1, start=1_000.0, duration_s=float(ticks), attacks=(attack,))
    state, suspected = made.init(1_000.0), []
    for k, seen in enumerate(snapshots(simulate(site, played))):
        if k == restart:
            before = distrusted(made.design, state)
            assert np.isfinite(before.repeats_s).nonzero()[0].tolist() == WHO.tolist()
            state = warm_start(made.design, made.init(seen.t), before)
            assert distrusted(made.design, state).same(before)
        state, _, verdict = made.step(state, to_frame(site, seen))
        if k >= restart:
            suspected.append(np.flatnonzero(verdict.suspects).tolist())
    assert set(map(tuple, suspected)) == {tuple(WHO.tolist())}


def test_who_repeated_himself_and_is_mended_is_believed_again() -> None:
    site = choose(load("simbench-lv-rural1"), estimator=SEQUENTIAL)
    made, line = design(site), []
    before = SuspicionRecord.empty(len(site.meter_ids), site.droop.tau.size)
    which = np.isin(np.arange(len(site.meter_ids)), WHO)
    before = replace(before, scale_s=np.where(which, 60.0, np.nan), named=which)
    before = replace(before, repeats_s=np.where(which, 100.0, np.nan))
    state = warm_start(made.design, made.init(1_000.0), before)
    for seen in snapshots(simulate(site, Scenario(seed=2, start=1_000.0, duration_s=700.0))):
        state, _, verdict = made.step(state, to_frame(site, seen))
        line.append(bool(verdict.suspects.any()))
    assert 300 < line.index(False) < 450
    assert not any(line[line.index(False) :])
