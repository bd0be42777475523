"""The estimators by name: what they are designed from, and that they judge alike."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from feeders.format.columns import ESTIMATORS
from feeders.model.site import from_tables, load, to_frame
from feeders.registry import DIRECT, FAMILIES, LMI, MODAL, choose, design, lmi_options
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate, snapshots
from gridsec.errors import DesignInfeasible, FeederInvalid, NotObservable
from gridsec.interface import Decision
from gridsec.observers.lure import close_loop
from tests.codes import refused
from tests.feeders.asymmetric import unbalanced

SMALL = "cigre-lv"


def test_the_file_is_the_default_and_can_be_overruled() -> None:
    site = load(SMALL)
    assert choose(site) is site
    other = choose(site, estimator=LMI, max_attacked=2)
    assert (other.tables.meta.monitor.estimator, other.tables.meta.monitor.max_attacked) == (LMI, 2)
    assert other.digest != site.digest
    assert choose(other, estimator=MODAL, max_attacked=1).digest == site.digest


def test_every_name_that_a_file_may_hold_has_a_family() -> None:
    assert tuple(FAMILIES) == ESTIMATORS
    assert all(family.summary for family in FAMILIES.values())


@pytest.mark.canary("modal", "unknown-input")
@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name != LMI])
def test_an_estimator_watches_three_phases(name: str) -> None:
    site = choose(from_tables(unbalanced(SMALL)), estimator=name)
    watcher = design(site)
    (attack,) = attacks = random_attacks(site, 5, "bias", 1, 0.08, t_on=START + 30, t_off=START + 60)
    state, named = watcher.init(START), set()
    run = simulate(site, Scenario(seed=5, duration_s=60, attacks=attacks))
    for k, snapshot in enumerate(snapshots(run)):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        named |= set(np.flatnonzero(verdict.suspects).tolist())
        assert k < 50 or verdict.decision is not Decision.CLEAN
    if name == "unknown-input":
        # Whole villages on a phase each: what their inverters may do says little about anybody.
        assert not named
        assert "not known well enough" in verdict.reason
    elif name == "modal":
        # A village by itself on its lateral: its false power looks like its false meter, and is as likely.
        assert named <= set(attack.meters.tolist())
        accused = [each for each in verdict.explanations if each.meters.any() or each.powers.any()]
        assert named or any(each.meters[attack.meters].any() for each in accused)
    else:
        assert named == set(attack.meters.tolist())


@pytest.mark.canary("windowed-bank")
@pytest.mark.parametrize("name", ["exact-bank", "windowed-bank", "set-search", "partial-observers"])
def test_a_real_feeder_in_three_phases_has_a_bank(name: str) -> None:
    watcher = design(choose(load("ieee-european-lv"), estimator=name, max_attacked=1))
    assert "certificate, margin 0.0" in watcher.proof
    assert watcher.observers == {"exact-bank": 1540, "windowed-bank": 1541}.get(name, watcher.observers)


def test_too_many_pairs_in_three_phases_are_refused() -> None:
    with refused(DesignInfeasible, "too-many") as caught:
        design(choose(load("ieee-european-lv"), estimator="unknown-input", max_attacked=1))
    assert "1120 pairs of up to 1 of 55 meters and 1 of 19 inverters" in str(caught.value)


def test_every_mistake_is_named() -> None:
    with refused(FeederInvalid, "unknown-name", "negative"):
        choose(load(SMALL), estimator="oracle", max_attacked=-1)


def test_the_load_columns_are_what_power_flow_does_to_the_voltage() -> None:
    """Oracle: AC power flow of the lightly loaded feeder with one customer's p, then q, changed."""
    site = load(SMALL)
    columns = lmi_options(site, close_loop(site.feeder, site.droop, site.meters)).load
    count = len(site.feeder.customers)
    assert columns.shape == (count, 2 * count)
    flow, base = PowerFlow(site), site.feeder.base_kva
    loads, volt = site.loads, site.feeder.base_volt
    dp = loads.p_fraction * loads.load_peak + loads.p_floor
    for j in range(count):
        step = 0.01 * base
        p = np.zeros(count)
        p[j] = step
        rest = (flow.solve(np.zeros(count), np.zeros(count), volt)[0] / volt) ** 2
        moved = (flow.solve(p, np.zeros(count), volt)[0] / volt) ** 2
        np.testing.assert_allclose(columns[:, j] / dp[j], (rest - moved) / 0.01, rtol=0.02, atol=1e-6)


@pytest.mark.canary("exact-bank")
@pytest.mark.parametrize("estimator", [DIRECT, LMI])
def test_both_name_exactly_the_liar(estimator: str, tmp_path: Path) -> None:
    site = choose(load(SMALL), estimator=estimator)
    seen: list[tuple[int, int]] = []
    finished = design(site, where=tmp_path, progress=lambda done, total: seen.append((done, total)))
    assert (estimator == LMI) == bool(seen)
    assert not seen or seen[-1] == (21, 21)
    (attack,) = attacks = random_attacks(site, 5, "bias", 1, 0.06, t_on=START + 30, t_off=START + 60)
    state = finished.init(START)
    decisions: Counter[Decision] = Counter()
    for k, snapshot in enumerate(snapshots(simulate(site, Scenario(seed=5, duration_s=60, attacks=attacks)))):
        state, _, verdict = finished.step(state, to_frame(site, snapshot))
        decisions[verdict.decision] += 1
        named = np.flatnonzero(verdict.suspects)
        assert named.tolist() == (attack.meters.tolist() if k >= 31 else [])
    assert decisions[Decision.ATTACKED] == 29
    assert decisions[Decision.CLEAN] >= 20


@pytest.mark.acceptance
def test_kept_designs_are_used_again(tmp_path: Path) -> None:
    site = choose(load(SMALL), estimator=LMI)
    first = design(site, where=tmp_path)

    def never(done: int, total: int) -> None:
        raise AssertionError(f"designed again: {done} of {total}")

    second = design(site, where=tmp_path, progress=never)
    np.testing.assert_array_equal(first.design.bank.gains.K, second.design.bank.gains.K)


def test_too_many_liars_are_refused() -> None:
    with refused(NotObservable, "too-few-meters"):
        design(choose(load(SMALL), estimator=DIRECT, max_attacked=3))
