"""False powers with all voltages true: no honest meter answers for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import load, to_frame
from feeders.registry import choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec, manipulations
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.interface import Cause, Decision

ONSET_S = 30.0


@pytest.mark.canary("1.0-6 to 6")
@pytest.mark.parametrize(
    ("size", "seeds"),
    [(1.0, range(6, 7)), (1.0, range(8)), (2.0, range(8))],
    ids=lambda value: f"{value[0]} to {value[-1]}" if isinstance(value, range) else str(value),
)
def test_a_power_that_is_false_is_told_as_a_power(size: float, seeds: range) -> None:
    """CIGRE LV with its 6 meters, where one load moves half of them: AC power flow."""
    site = choose(load("cigre-lv"), max_attacked=2)
    watcher, told = design(site), 0
    for seed in seeds:
        profile = float(np.random.default_rng(seed).uniform(0.0, 13.9 * 86_400.0))
        quiet = Scenario(seed=seed, duration_s=60.0, profile_s=profile)
        attacks, _ = manipulations(site, AttackSpec(AttackKind.POWER, 1, size, ONSET_S), quiet)
        (attack,) = attacks
        state, loud = watcher.init(START - 1.0), False
        for snapshot in snapshots(simulate(site, replace(quiet, attacks=attacks))):
            state, _, verdict = watcher.step(state, to_frame(site, snapshot))
            honest = np.delete(verdict.suspects, attack.meters)
            assert not honest.any(), f"seed {seed}: {verdict.reason}"
            pending = "not often enough to be named" in verdict.reason  # nobody is accused of anything yet
            if verdict.decision is Decision.UNDECIDED and verdict.cause is Cause.AMBIGUOUS and not pending:
                loud = True
                named = any(each.powers[site.meters[attack.meters]].any() for each in verdict.explanations)
                accused = site.feeder.customers[site.meters[attack.meters[0]]] in verdict.reason
                assert named or accused, verdict.reason
        told += loud
    # A load beyond the customer's connection is not believed in the first place, and changes nothing.
    assert told >= max(1, len(seeds) // 4)


def test_residuals_made_with_a_power_that_was_doubted_name_nobody_afterwards() -> None:
    """A claim of 80 kW passes what is credible: from then on the customer's usual load stands for it."""
    site = choose(load("kerber-landnetz"), max_attacked=2)
    watcher, seed = design(site), 9
    profile = float(np.random.default_rng(seed).uniform(0.0, 13.9 * 86_400.0))
    quiet = Scenario(seed=seed, duration_s=90.0, profile_s=profile)
    (attack,), _ = manipulations(site, AttackSpec(AttackKind.COORDINATED_POWER, 2, 3.0, ONSET_S), quiet)
    state, errors = watcher.init(START - 1.0), []
    for snapshot in snapshots(simulate(site, replace(quiet, attacks=(attack,)))):
        frame = to_frame(site, snapshot)
        state, _, verdict = watcher.step(state, frame)
        assert not np.delete(verdict.suspects, attack.meters).any(), verdict.reason
        errors.append(float(frame.p_error[site.meters[attack.meters]].max()))
    assert verdict.suspects[attack.meters].all()
    # It is doubted from the onset on, and no longer believed at all later.
    assert errors[20] < 0.01 < errors[-1] < 0.1 < errors[40]
