"""A feeder with closed ties through the whole service: its layout, a recording, and who lies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from benchmarks.mesh import baran_wu
from feeders.format.tables import to_json
from feeders.simulation.scenario import Scenario, random_attacks, simulate
from gridsec.grid.radial import Feeder
from service.api.models import FeederDetail, State
from service.report.feeder_info import detail
from tests.service.played import replayed, served

START = 1_795_212_000.0
NAME = "case33bw"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    attacks = random_attacks(baran_wu(), 3, "bias", 10, 0.03, t_on=START + 15, t_off=START + 60)
    return Scenario(seed=6, start=START, duration_s=30.0, attacks=attacks)


def test_the_layout_is_a_tree_and_its_ties() -> None:
    site = baran_wu()
    found = FeederDetail.model_validate(detail(site, 5.0)).layout
    assert len(found.ties) == 5
    lines = {frozenset((row.from_bus, row.to_bus)) for row in site.tables.lines}
    drawn = [(k, above) for k, above in enumerate(found.parent) if above is not None] + found.ties
    assert {frozenset((found.buses[a], found.buses[b])) for a, b in drawn} == lines
    assert len(drawn) == len(lines) == 37


def test_the_service_names_the_liars(scenario: Scenario, tmp_path: Path) -> None:
    site = baran_wu()
    samples, state = served(site, scenario, tmp_path, NAME)
    lying = {site.meter_ids[k] for k in np.flatnonzero(samples[-1].manipulated)}
    assert len(lying) == 10
    assert state["verdict"] == "attacked"
    assert {meter["meter"] for meter in state["meters"] if meter["suspect"]} == lying
    TypeAdapter(State).validate_python(state)
    found = np.array([bus["v_volt"] for bus in state["buses"]])
    np.testing.assert_allclose(found, samples[-1].v_bus_volt, rtol=2e-3)


def test_a_recording_is_replayed(scenario: Scenario, tmp_path: Path) -> None:
    site, short = baran_wu(), replace(scenario, duration_s=20.0)
    samples = list(simulate(site, short))
    reports = replayed(site, short, tmp_path)
    lying = {site.meter_ids[k] for k in np.flatnonzero(samples[-1].manipulated)}
    assert {meter.meter for meter in reports[-1].meters if meter.suspect} == lying
    assert reports[-1].verdict == "attacked"
    assert not isinstance(site.feeder, Feeder)
    assert to_json(site.tables)["feeder"]["meshed"] is True
