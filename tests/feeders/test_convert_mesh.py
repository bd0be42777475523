"""Networks of other tools whose loops stay closed, against those tools' own power flows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest
from pandapower import networks

from feeders.convert import check_against_source, convert
from feeders.convert_check import BALANCED_PU
from feeders.load import load
from feeders.powerflow import PowerFlow
from feeders.schema import read
from gridsec.errors import FeederInvalid
from gridsec.mesh import MeshedFeeder
from gridsec.network import bus_voltages, model_error_bound
from tests.feeders.test_convert_check import village
from tests.feeders.test_convert_pgm import line, written
from tests.feeders.test_convert_pgm import load as pgm_load


def meshed_net() -> Any:
    """The feeder of Baran and Wu with its five ties closed, and cables that charge."""
    net = networks.case33bw()
    net.line["in_service"] = True
    net.line["c_nf_per_km"] = 200.0
    return net


def test_a_pandapower_net_with_rings_is_as_pandapower_solves_it(tmp_path: Path) -> None:
    net, path = meshed_net(), tmp_path / "net.json"
    pp.to_json(net, str(path))
    with pytest.raises(FeederInvalid, match=r"form a loop.*\(converters: --meshed\)"):
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
    off = np.abs(bus_voltages(site.feeder, *powers) - theirs**2)
    assert off.max() < 2e-4
    assert (off[site.feeder.bus] <= model_error_bound(site.feeder, *powers) + 1e-9).all()


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
    with pytest.raises(FeederInvalid, match=r"only balanced feeders can be meshed|zero sequence"):
        convert(str(path), tmp_path / "x", root="root", meshed=True)
    assert not (tmp_path / "x").exists()
