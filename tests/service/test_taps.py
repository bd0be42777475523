"""Feeders with a tap through the service: who lies behind it, and by how many volts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from feeders.simulation.scenario import Scenario, simulate
from gridsec.attack import Bias
from gridsec.grid.phased import PhasedFeeder
from service.api.models import FeederDetail
from service.report.feeder_info import detail
from tests.service.played import replayed

START = 1_795_212_000.0
T_ON = START + 20.0


def tapped(name: str) -> Site:
    """A feeder with a voltage 5 % higher behind the line in the middle of its largest street."""
    plain = load(name)
    tree = plain.tree
    sizes = tree.walk.stop - tree.walk.start
    middle = int(np.argmin(np.abs(sizes - len(tree.buses) // 3)))
    tables = plain.tables
    into = {plain.bus_of_file[row.to_bus]: row.line for row in tables.lines if row.closed}
    lines = (replace(row, tap=0.95) if row.line == into[middle] else row for row in tables.lines)
    return from_tables(replace(tables, lines=tuple(lines)))


@pytest.mark.canary("kerber-landnetz")
@pytest.mark.parametrize("name", ["kerber-landnetz", "ieee-european-lv"])
def test_the_liars_behind_a_tap_are_named_in_volts(name: str, tmp_path: Path) -> None:
    site = tapped(name)
    assert isinstance(site.feeder, PhasedFeeder) == (name == "ieee-european-lv")
    nominal, base = site.tables.meta.voltage_volt, site.customer_volt[site.meters]
    behind = np.flatnonzero(base > 1.04 * nominal)
    before = np.flatnonzero(base == nominal)
    assert behind.size > 2
    assert before.size > 2
    liars = np.sort([behind[0], behind[-1], before[-1]])
    lie = Bias(liars, T_ON, START + 60.0, np.array([0.03, -0.03, 0.03]))
    scenario = Scenario(seed=3, start=START, duration_s=28.0, attacks=(lie,))
    samples = list(simulate(site, scenario))
    reports = replayed(site, scenario, tmp_path)
    honest = next(report for report in reports if report.t == T_ON - 2.0)
    assert honest.verdict != "attacked"
    last = reports[-1]
    assert last.verdict == "attacked"
    assert {m.meter for m in last.meters if m.suspect} == {site.meter_ids[k] for k in liars}
    sample = next(sample for sample in samples if sample.t == last.t)
    true = sample.v_volt[site.meters]
    assert true[behind].mean() > 1.03 * true[before].mean()  # the tap is in the truth
    told = np.array([m.v_volt_estimated for m in last.meters], dtype=float)
    np.testing.assert_allclose(told, true, rtol=3e-3)
    claimed = np.array([m.v_volt_reported for m in last.meters], dtype=float)
    np.testing.assert_allclose(claimed, sample.reported.v_volt[0])
    attack = np.array([m.attack_volt_estimated for m in last.meters], dtype=float)
    np.testing.assert_allclose(attack[liars], sample.shift_volt[liars], atol=1.0)
    np.testing.assert_allclose(np.abs(sample.shift_volt[liars]), 0.03 * nominal, atol=0.1)
    squared = np.array([m.v2_pu_estimated for m in last.meters], dtype=float)
    np.testing.assert_allclose(squared, (told / nominal) ** 2, rtol=1e-12)
    found = np.array([bus.v_volt for bus in last.buses], dtype=float)
    buses = sample.v_bus_volt.reshape(found.size, -1)
    off = np.abs(found[:, None] - buses).min(axis=1) / nominal
    assert off.max() < 5e-3
    assert (last.v_min_volt, last.v_max_volt) == (0.9 * nominal, 1.1 * nominal)


def test_the_layout_has_one_nominal_voltage() -> None:
    site = tapped("kerber-landnetz")
    told = FeederDetail.model_validate(detail(site, 5.0))
    assert told.v_nominal_volt == site.tables.meta.voltage_volt
