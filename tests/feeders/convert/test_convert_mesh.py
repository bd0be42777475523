"""Networks of other tools whose loops stay closed, against those tools' own power flows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest
from pandapower import networks

from feeders.convert.convert import check_against_source, convert
from feeders.convert.round_trip import BALANCED_PU
from feeders.format.tables import read
from feeders.model.site import load
from feeders.registry import design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.powerflow import PowerFlow, power_flow
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, judge
from gridsec.errors import FeederInvalid
from gridsec.grid.meshed import MeshedFeeder, PhasedMesh
from tests.codes import refused
from tests.feeders.convert.test_from_power_grid_model import line, written
from tests.feeders.convert.test_from_power_grid_model import load as pgm_load
from tests.feeders.convert.test_round_trip import village
from tests.feeders.thirteen import thirteen


def meshed_net() -> Any:
    """The feeder of Baran and Wu with its five ties closed, and cables that charge."""
    net = networks.case33bw()
    net.line["in_service"] = True
    net.line["c_nf_per_km"] = 200.0
    return net


@pytest.mark.acceptance
def test_a_pandapower_net_with_rings_is_as_pandapower_solves_it(tmp_path: Path) -> None:
    net, path = meshed_net(), tmp_path / "net.json"
    pp.to_json(net, str(path))
    with refused(FeederInvalid, *["not-radial"] * 5):
        convert(str(path), tmp_path / "x")
    done = convert(str(path), tmp_path / "x", meshed=True)
    assert done.check is not None
    assert done.check.largest_pu < BALANCED_PU
    assert done.check.buses == 33
    assert "--meshed" in (tmp_path / "x" / "SOURCE.md").read_text()
    assert check_against_source(str(path), tmp_path / "x").exact
    site = load(tmp_path / "x")
    assert isinstance(site.feeder, MeshedFeeder)
    assert len(site.ties) == 5
    # Without what the check compares: the net's own result, bus by bus.
    pp.runpp(net, tolerance_mva=1e-10)
    rows = net.load.set_index(net.load.bus.map(lambda k: str(net.bus.name[k])))
    buses = [row.bus for row in site.tables.customers]
    by_name = {str(name): k for k, name in net.bus.name.items()}
    p, q = (1000.0 * np.array([rows[c][bus] for bus in buses]) for c in ("p_mw", "q_mvar"))
    base = site.feeder.base_volt
    _, ours = PowerFlow(site).solve(p, q, float(net.res_bus.vm_pu[by_name[site.feeder.buses[0]]]) * base)
    theirs = np.array([net.res_bus.vm_pu[by_name[bus]] for bus in site.feeder.buses])
    np.testing.assert_allclose(ours / base, theirs, rtol=0, atol=1e-7)
    # The model by itself, after one correction.
    powers = (-p / site.feeder.base_kva, -q / site.feeder.base_kva, float(theirs[0] ** 2))
    off = np.abs(site.feeder.bus_voltages(*powers) - theirs**2)
    assert off.max() < 2e-4
    assert (off[site.feeder.bus] <= site.feeder.model_error_bound(*powers) + 1e-9).all()


def test_a_ring_behind_a_transformer(tmp_path: Path) -> None:
    path = tmp_path / "ring.json"
    pp.to_json(village(closed=True), str(path))
    done = convert(str(path), tmp_path / "x", root="root", meshed=True)
    assert done.check is not None
    assert done.check.exact
    assert load(tmp_path / "x").ties.size > 0


def test_a_network_of_power_grid_model_with_a_ring(tmp_path: Path) -> None:
    tables = {
        "node": [{"id": k, "u_rated": 20e3} for k in (1, 2, 3)],
        "line": [
            line(20, 1, 2, r1=2.0, x1=2.0),
            line(21, 1, 3, r1=2.0, x1=2.0),
            line(22, 2, 3, r1=4.0, x1=4.0, c1=2e-6),
        ],
        "source": [{"id": 40, "node": 1, "status": 1, "u_ref": 1.0, "sk": 1e9}],
        "sym_load": [pgm_load(50, 2, 2e6, 1e6), pgm_load(51, 3, 2e6, 1e6)],
    }
    done = convert(written(tmp_path, tables), tmp_path / "x", meshed=True)
    assert done.check is not None
    assert done.check.largest_pu < 1e-8


LOOPS = """new line.ring bus1=680.1.2.3 bus2=675.1.2.3 linecode=601 length=1500 units=ft
new line.one bus1=611.3 bus2=646.3 linecode=605 length=900 units=ft
new line.two bus1=645.3.2 bus2=671.3.2 linecode=603 length=1200 units=ft
"""


@pytest.mark.parametrize(
    "lie", [None, AttackSpec(AttackKind.BIAS, 5, 3.0, onset_s=10.0)], ids=["nobody", "five"]
)
def test_the_ieee_13_node_feeder_with_three_loops(lie: AttackSpec | None, tmp_path: Path) -> None:
    """Ties of three phases, of two and of one, behind a regulator that differs in its phases."""
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    before, loads = thirteen().split("new load", 1)
    (tmp_path / "thirteen.dss").write_text(f"{before}{LOOPS}new load{loads}")
    source = str(tmp_path / "thirteen.dss")
    with refused(FeederInvalid, *["not-radial"] * 3):
        convert(source, tmp_path / "x", root="650")
    done = convert(source, tmp_path / "x", root="650", meshed=True)
    assert done.check is not None
    assert done.check.three_phase
    assert done.check.largest_pu < 1e-7
    site = load(tmp_path / "x")
    assert isinstance(site.feeder, PhasedMesh)
    assert sorted(site.feeder.phases.sum(axis=1).tolist()) == [1, 2, 3]
    p = -site.loads.load_peak
    _, places = power_flow(site).solve(-p * site.feeder.base_kva, -0.4 * p * site.feeder.base_kva, 2400.0)
    exact = (places / site.base_volt) ** 2
    v0 = np.square(2400.0 / site.feeder.base_volt)
    off = np.abs(site.feeder.bus_voltages(p, 0.4 * p, v0) - exact)[site.feeder.bus]
    assert (off <= site.feeder.model_error_bound(p, 0.4 * p, v0) + 1e-9).all()
    assert off.max() < 3e-3
    trial = Trial(site, 2, 22.0, load_error=LoadError(20.0, 7.0), meters=TrialMeterErrors.WHITE, lie=lie)
    found = judge(design(trial.stated), trial, settling_s=3.0)
    assert found.liars.size == (5 if lie else 0)
    assert (found.delay_s <= 3.0).all()
    assert not found.accused.any()


@pytest.mark.acceptance
def test_the_option_changes_nothing_of_a_radial_network(tmp_path: Path) -> None:
    path = tmp_path / "net.json"
    pp.to_json(networks.case33bw(), str(path))
    convert(str(path), tmp_path / "x", name="x")
    convert(str(path), tmp_path / "y", name="x", meshed=True)
    one, other = read(tmp_path / "x"), read(tmp_path / "y")
    assert (other.lines, other.customers) == (one.lines, one.customers)
    assert (one.meta.meshed, other.meta.meshed) == (False, True)
    np.testing.assert_array_equal(load(tmp_path / "x").balanced.r, load(tmp_path / "y").balanced.r)


def test_a_ring_of_single_phases_is_refused(tmp_path: Path) -> None:
    net = village(closed=True)
    pp.create_asymmetric_load(net, int(net.load.bus.iloc[0]), p_a_mw=0.002, q_a_mvar=0.0)
    path = tmp_path / "ring.json"
    pp.to_json(net, str(path))
    with refused(FeederInvalid, *["missing"] * 3):
        convert(str(path), tmp_path / "x", root="root", meshed=True)
    assert not (tmp_path / "x").exists()
