"""Registers beyond the declared range, on voltages from the AC power flow."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from feeders.model.site import Site, Snapshot, load, to_frame
from feeders.registry import DesignedEstimator, design
from feeders.simulation.scenario import START, Scenario, simulate, snapshots
from gridsec.arrays import Floats
from gridsec.interface import Frame, PowerOrigin

LIE_S = 30.0
"""Time of the first false register, s after the start."""
SIZES = (0.4, 0.6, 0.9, 0.99)
"""Parts of the largest credible power."""


@cache
def watched(name: str) -> tuple[Site, DesignedEstimator, tuple[Snapshot, ...]]:
    site = load(name)
    samples = simulate(site, Scenario(seed=1, duration_s=LIE_S + 15.0, dt_s=1.0))
    return site, design(site), tuple(snapshots(samples))


def credible_kw(site: Site) -> Floats:
    return np.asarray(site.loads.credible[site.meters] * site.feeder.base_kva)


def named(name: str, liar: int, power_kw: float) -> set[int]:
    """Meters that are named while one register is false and every voltage is true."""
    site, watcher, said = watched(name)
    state, found = watcher.init(START), set()
    for each in said:
        p_kw = each.p_kw.copy()
        if each.t - START >= LIE_S:
            p_kw[liar] = power_kw
        state, _, verdict = watcher.step(state, to_frame(site, replace(each, p_kw=p_kw)))
        found |= set(np.flatnonzero(verdict.suspects).tolist())
    return found


@pytest.mark.canary("0-0.99", "3-0.9", "0-0.4")
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("liar", range(6))
def test_one_false_register_names_no_honest_meter(liar: int, size: float) -> None:
    site, _, _ = watched("cigre-lv")
    assert site.meters.size == 6
    assert named("cigre-lv", liar, size * credible_kw(site)[liar]) <= {liar}


def test_one_false_register_names_no_honest_meter_in_three_phases() -> None:
    """The meter with the largest voltage effect of its credible power."""
    name = "ieee-european-lv"
    site, _, _ = watched(name)
    low = [(frame_of(name, {j: 0.99}, 0.0)[1], j) for j in range(site.meters.size)]
    liar = max(low)[1]
    frame, _ = frame_of(name, {liar: 0.99}, 0.0)
    assert frame.p_error[site.meters[liar]] == site.loads.p_unread[site.meters[liar]]
    assert named(name, liar, 0.99 * credible_kw(site)[liar]) <= {liar}


def frame_of(name: str, false: dict[int, float], peak: float, honest: int = 0) -> tuple[Frame, float]:
    """Frame with registers at parts of the credible power, one at `peak` declared loads; error bound."""
    site, _, said = watched(name)
    p_kw = said[-1].p_kw.copy()
    for j, size in false.items():
        p_kw[j] = size * credible_kw(site)[j]
    if peak:
        p_kw[honest] = peak * site.loads.load_peak[site.meters[honest]] * site.feeder.base_kva
    given = np.full(site.loads.credible.size, 0.0)
    given[site.meters] = p_kw / site.feeder.base_kva
    with np.errstate(all="ignore"):
        bound = site.feeder.model_error_bound(-given, -0.3 * given, 1.0).max()
    return to_frame(site, replace(said[-1], p_kw=p_kw)), float(bound)


@pytest.mark.parametrize("name", ["cigre-lv", "ieee-european-lv"])
def test_every_frame_has_a_model_with_a_finite_error(name: str) -> None:
    """All subsets of a random draw at random sizes: the model of the frame is bounded."""
    site, _, _ = watched(name)
    random = np.random.default_rng(7)
    for _ in range(30):
        liars = random.permutation(site.meters.size)[: random.integers(1, 7)]
        false = {int(j): float(random.uniform(-1.0, 1.0)) for j in liars}
        frame, _ = frame_of(name, false, 0.0)
        with np.errstate(all="ignore"):
            bound = site.feeder.model_error_bound(frame.p, frame.q, site.droop.vbar**2)
        assert np.isfinite(bound).all()


def test_a_register_of_small_effect_is_used_beside_one_without_a_bound() -> None:
    """Meter 1 reads 1.5 declared loads, meter 5 the largest credible power."""
    site, _, said = watched("cigre-lv")
    frame, bound = frame_of("cigre-lv", {5: 0.99}, 1.5, honest=1)
    assert not np.isfinite(bound)
    at, liar = site.meters[1], site.meters[5]
    np.testing.assert_allclose(-frame.p[at], 1.5 * site.loads.load_peak[at])
    assert frame.p_error[liar] == site.loads.p_unread[liar]
    assert frame.p_origin is not None
    assert frame.p_origin[[at, liar]].tolist() == [PowerOrigin.BEYOND] * 2
    absurd = said[-1].p_kw.copy()
    absurd[5] = 1e6
    same = to_frame(site, replace(said[-1], p_kw=absurd))
    np.testing.assert_array_equal(frame.p_error[liar], same.p_error[liar])
    np.testing.assert_array_equal(frame.q[liar], same.q[liar])
