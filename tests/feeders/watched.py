"""Scenarios that an estimator of a feeder watches."""

from __future__ import annotations

import numpy as np

from feeders.model.site import Site, to_frame
from feeders.registry import design
from feeders.simulation.scenario import START, Scenario, random_attacks, simulate, snapshots
from gridsec.interface import Decision


def names_the_liar_alone(site: Site) -> None:
    """Let one meter lie by 8 % from 20 s on: the feeder's estimator names it, and nobody else.

    Parameters
    ----------
    site
        The feeder; its files say which estimator watches it.
    """
    slow = site.tables.meta.monitor.estimator == "windowed-bank"
    watcher = design(site)
    attacks = random_attacks(site, 5, "bias", 1, 0.08, t_on=START + 20, t_off=START + 130)
    state, named = watcher.init(START), set()
    run = simulate(site, Scenario(seed=5, duration_s=130, attacks=attacks))
    for k, snapshot in enumerate(snapshots(run)):
        state, _, verdict = watcher.step(state, to_frame(site, snapshot))
        named |= set(np.flatnonzero(verdict.suspects).tolist())
        # Windows of 50 readings answer at their ends.
        assert verdict.decision is not Decision.CLEAN or k < (100 if slow else 22)
    assert named == set(attacks[0].meters.tolist())
    assert verdict.decision is Decision.ATTACKED
