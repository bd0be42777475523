"""A meshed feeder of single-phase customers through the whole service: its check, layout, and who lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from typer.testing import CliRunner

from benchmarks.mesh import european
from feeders.format.tables import write
from feeders.simulation.scenario import Scenario, random_attacks, simulate
from gridsec.grid.meshed import PhasedMesh
from service.api.models import FeederDetail, State
from service.cli.main import app
from service.report.feeder_info import detail
from tests.service.played import replayed, served

START = 1_795_212_000.0
NAME = "ieee-european-lv"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    attacks = random_attacks(european(), 3, "bias", 6, 0.03, t_on=START + 15, t_off=START + 60)
    return Scenario(seed=6, start=START, duration_s=30.0, attacks=attacks)


def test_the_folder_is_checked_and_shown(tmp_path: Path) -> None:
    write(european().tables, tmp_path / NAME)
    checked = CliRunner().invoke(app, ["feeders", "validate", str(tmp_path / NAME)])
    assert checked.exit_code == 0
    assert "'ring' is drawn as a tie" in " ".join(checked.output.split())
    shown = CliRunner().invoke(app, ["feeders", "show", str(tmp_path / NAME)])
    assert "906 buses, 1 closed ties, 55 customers" in " ".join(shown.output.split())


def test_the_layout_is_a_tree_and_its_tie() -> None:
    site = european()
    assert isinstance(site.feeder, PhasedMesh)
    found = FeederDetail.model_validate(detail(site, 5.0)).layout
    assert [{found.buses[one], found.buses[other]} for one, other in found.ties] == [{"681", "906"}]
    assert len(found.buses) == len(found.parent) == 906
    assert {customer.phase for customer in found.customers} == {"a", "b", "c"}


@pytest.mark.acceptance
def test_the_service_names_the_liars(scenario: Scenario, tmp_path: Path) -> None:
    site = european()
    samples, state = served(site, scenario, tmp_path, NAME)
    lying = {site.meter_ids[k] for k in np.flatnonzero(samples[-1].manipulated)}
    assert len(lying) == 6
    assert state["verdict"] == "attacked"
    assert {meter["meter"] for meter in state["meters"] if meter["suspect"]} == lying
    TypeAdapter(State).validate_python(state)
    found = np.array([bus["v_phases"] for bus in state["buses"]], dtype=float)
    np.testing.assert_allclose(found, samples[-1].v_bus_volt.reshape(-1, 3), rtol=0, atol=2.0)


def test_a_recording_is_replayed(scenario: Scenario, tmp_path: Path) -> None:
    site = european()
    samples = list(simulate(site, scenario))
    reports = replayed(site, scenario, tmp_path)
    lying = {site.meter_ids[k] for k in np.flatnonzero(samples[-1].manipulated)}
    assert {meter.meter for meter in reports[-1].meters if meter.suspect} == lying
    clean = [report for report in reports if report.t < START + 15]
    assert len(clean) >= 10
    assert not any(meter.suspect for report in clean for meter in report.meters)
