"""Every estimator against numbers that are none: finite answers, nobody named, CLEAN only with a prior."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from feeders.model.site import load, to_frame
from feeders.registry import FAMILIES, DesignedEstimator, choose, design
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.interface import Decision, Frame

# The bank of matrix inequalities steps as the exact bank does.
NAMES = sorted(set(FAMILIES) - {"exact-bank-lmi"})
# These have a prior of powers that nobody knows; for all others such a power leaves everything open.
PRIOR = {"modal", "weighted-least-squares", "l0-decoder", "basis-pursuit", "matching-pursuit"}
# These are not sure of honest readings either after so short a time.
SLOW = {"unknown-input", "windowed-bank"}
BEFORE, BAD, WHO = 20, 6, 2


@cache
def watcher(name: str) -> DesignedEstimator:
    return design(choose(load("simbench-lv-rural1"), max_attacked=1, estimator=name))


@cache
def frames() -> tuple[Frame, ...]:
    site = load("simbench-lv-rural1")
    scenario = Scenario(seed=1, duration_s=BEFORE + BAD)
    return tuple(to_frame(site, snapshot) for snapshot in snapshots(simulate(site, scenario)))


def put(frame: Frame, name: str, value: float) -> Frame:
    """One customer's number replaced; with an error of q_net, a q_net that it belongs to."""
    new = getattr(frame, name).copy()
    new[WHO] = value
    frame = replace(frame, **{name: new})
    if name == "q_net_error":
        net = frame.q_net.copy()
        net[WHO] = frame.q[WHO]
        frame = replace(frame, q_net=net)
    return frame


@pytest.mark.canary("p-basis-pursuit", "q_net_error-windowed-bank")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", ["p", "p_error", "q", "q_error", "q_net", "q_net_error"])
def test_a_power_that_is_none_is_not_known(name: str, what: str) -> None:
    known = Decision.UNDECIDED if name in SLOW else Decision.CLEAN
    # Nobody needs the reactive power that is reported on top.
    then = known if name in PRIOR or what.startswith("q_net") else Decision.UNDECIDED
    for value in (np.nan, np.inf, -np.inf, 1e300):
        state = watcher(name).init(START - 1.0)
        if what == "q_net" and value == 1e300:
            continue  # That is a number, and a lie.
        for k, frame in enumerate(frames()):
            given = put(frame, what, value) if k >= BEFORE else frame
            state, estimate, verdict = watcher(name).step(state, given)
            assert not verdict.suspects.any(), (value, k)
            for numbers in (estimate.v2, estimate.bound, estimate.v2_bus, verdict.threshold):
                assert np.isfinite(numbers).all(), (value, k)
            if k >= BEFORE - 1:
                assert verdict.decision is (then if k >= BEFORE else known), (value, k)


@pytest.mark.canary("basis-pursuit", "windowed-bank")
@pytest.mark.parametrize("name", NAMES)
def test_a_voltage_that_is_none_is_a_lie_of_one_meter(name: str) -> None:
    for value in (-1.0, 1e300):
        state = watcher(name).init(START - 1.0)
        for k, frame in enumerate(frames()):
            given = put(frame, "y", value) if k >= BEFORE else frame
            state, estimate, verdict = watcher(name).step(state, given)
            assert not np.delete(verdict.suspects, WHO).any(), (value, k)
            assert np.isfinite(estimate.bound).all()
        assert verdict.decision is not Decision.CLEAN
