"""What is not supplied is named, and what is written can be loaded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest
from power_grid_model import ComponentType, DatasetType, initialize_array
from power_grid_model.utils import json_serialize_to_file
from typer.testing import CliRunner

from feeders.convert.convert import Conversion, convert
from feeders.convert.from_pandapower import read_pandapower
from feeders.convert.network import feeder_of
from feeders.convert.provenance import BusbarUnclear
from feeders.convert.round_trip import UNBALANCED_PU, compare
from feeders.model.site import load
from gridsec.errors import FeederInvalid, GridsecError
from service.cli.main import app
from tests.codes import refused

LINE = {"r_ohm_per_km": 0.3, "x_ohm_per_km": 0.09, "c_nf_per_km": 250.0, "max_i_ka": 0.2}
ZERO = {"r0_ohm_per_km": 0.8, "x0_ohm_per_km": 0.4, "c0_nf_per_km": 100.0}


def street(buses: int, *, base_mva: float = 1.0, **columns: float) -> Any:
    """A station and a street of the buses b0 (the busbar), b1, ...; a load at each but the busbar."""
    net = pp.create_empty_network(sn_mva=base_mva)
    high = pp.create_bus(net, 20.0, name="high")
    pp.create_ext_grid(net, high, s_sc_max_mva=1000.0, rx_max=0.1, x0x_max=1.0, r0x0_max=0.1)
    root = pp.create_bus(net, 0.4, name="b0")
    pp.create_transformer_from_parameters(
        net, high, root, 0.4, 20.0, 0.4, 1.0, 4.0, 1.0, 0.3, vector_group="Dyn", shift_degree=150.0,
        vk0_percent=4.0, vkr0_percent=1.0, mag0_percent=100.0, mag0_rx=0.0, si0_hv_partial=0.9,
    )  # fmt: skip
    for k in range(1, buses):
        bus = pp.create_bus(net, 0.4, name=f"b{k}")
        pp.create_line_from_parameters(net, bus - 1, bus, 0.1, **LINE, **columns)
        pp.create_load(net, bus, 0.01, 0.003, name=f"house {k}")
    return net


def converted(net: Any, folder: Path, **options: Any) -> Conversion:
    path = folder / "net.json"
    pp.to_json(net, str(path))
    return convert(str(path), folder / "out", **options)


def left_out(done: Conversion) -> dict[str, str]:
    return {each.element: each.effect for each in done.changes if each.done == "left out"}


@pytest.mark.canary("False-True")
@pytest.mark.parametrize("phased", [False, True])
@pytest.mark.parametrize("by_line", [False, True])
def test_a_bus_out_of_service_carries_nothing(phased: bool, by_line: bool, tmp_path: Path) -> None:
    net = street(4, **ZERO)
    if phased:
        pp.create_asymmetric_load(net, 3, p_a_mw=0.004, p_c_mw=0.001, name="flat")
    dead = pp.create_bus(net, 0.4, name="dead", in_service=False)
    if by_line:
        pp.create_line_from_parameters(net, 3, dead, 0.1, **LINE, **ZERO)
    else:
        pp.create_switch(net, 3, dead, "b")
    pp.create_load(net, dead, 0.05, 0.01, name="off")
    pp.create_sgen(net, dead, 0.01, name="roof")
    pp.create_motor(net, dead, 0.01, 0.9, name="pump")
    done = converted(net, tmp_path)
    assert done.check is not None
    assert (done.check.buses, done.check.three_phase, done.check.exact) == (4, phased, True)
    told = left_out(done)
    assert told["bus dead"] == "out of service in the source"
    assert {"load off", "generator roof"} <= told.keys()
    assert any("motor pump" in element for element in told)
    names = {row.customer for row in load(tmp_path / "out").tables.customers}
    assert names.isdisjoint({"off", "roof", "motor pump"})


def test_a_balanced_net_stays_balanced_whatever_its_zero_sequence(tmp_path: Path) -> None:
    """Charging of the zero sequence, a switch with an impedance and a regulator, none of which has one."""
    net = street(3, **ZERO)
    beyond, behind, end = (pp.create_bus(net, 0.4, name=name) for name in ("beyond", "behind", "end"))
    pp.create_switch(net, 3, beyond, "b", z_ohm=0.002)
    pp.create_transformer_from_parameters(
        net, beyond, behind, 0.1, 0.4, 0.4, 1.0, 4.0, 0.1, 0.5, tap_side="lv", tap_neutral=0, tap_min=-5,
        tap_max=5, tap_step_percent=2.0, tap_pos=2, tap_changer_type="Ratio",
    )  # fmt: skip
    pp.create_line_from_parameters(net, behind, end, 0.1, **LINE, **ZERO)
    pp.create_load(net, end, 0.005, 0.001, name="last")
    done = converted(net, tmp_path)
    assert done.check is not None
    assert (done.check.buses, done.check.three_phase, done.check.exact) == (6, False, True)
    site = load(tmp_path / "out")
    assert not site.tables.in_phases
    assert len(site.tables.customers) == 4  # what the regulator takes without load is one
    charged = {each.element for each in done.changes if each.prop == "charging between phases"}
    assert charged == {"line line-0", "line line-1", "line line-2"}


def test_a_switch_with_an_impedance_in_three_phases() -> None:
    net = street(3, **ZERO)
    beyond = pp.create_bus(net, 0.4, name="beyond")
    pp.create_switch(net, 3, beyond, "b", z_ohm=0.002)
    pp.create_asymmetric_load(net, beyond, p_a_mw=0.004, p_c_mw=0.001, name="flat")
    done = feeder_of(read_pandapower(net), "x")
    assert done.state is not None
    assert ("switch switch-0", "impedance") in {(each.element, each.prop) for each in done.changes}
    assert not compare(done.state, done.tables).exact
    # pandapower refers it to the base of three phases, and everything else to that of one.
    third = {"r_ohm": 0.002 / 3 * 2 / 5**0.5, "x_ohm": 0.002 / 3 / 5**0.5}
    third |= {"r0_ohm": third["r_ohm"], "x0_ohm": third["x_ohm"]}
    rows = [replace(row, **third) if row.line == "switch-0" else row for row in done.tables.lines]
    assert compare(done.state, replace(done.tables, lines=tuple(rows))).exact


def test_nothing_is_written_that_cannot_be_loaded(tmp_path: Path) -> None:
    """Single phases on lines without a zero sequence: no three-phase model, and no folder."""
    net = street(3)
    pp.create_asymmetric_load(net, 3, p_a_mw=0.004, name="flat")
    with refused(FeederInvalid, "missing", "missing"):
        converted(net, tmp_path)
    done = CliRunner().invoke(app, ["feeders", "convert", str(tmp_path / "net.json"), str(tmp_path / "out")])
    assert done.exit_code != 0
    assert not (tmp_path / "out").exists()


def village(r_back: float = 0.01) -> Any:
    """Medium voltage: the hospital behind an impedance, the school behind an open switch."""
    net = pp.create_empty_network()
    high, *rest = (
        pp.create_bus(net, kv, name=name)
        for kv, name in ((110.0, "high"), *((20.0, f"b{k}") for k in range(5)))
    )
    pp.create_ext_grid(net, high)
    pp.create_transformer(net, high, rest[0], "25 MVA 110/20 kV")
    for a, b in ((0, 1), (2, 3), (1, 4)):
        pp.create_line_from_parameters(net, rest[a], rest[b], 1.0, 0.3, 0.12, 280.0, 0.2)
    pp.create_impedance(net, rest[1], rest[2], 0.01, 0.02, 10.0, rtf_pu=r_back, name="reactor")
    pp.create_switch(net, rest[1], 2, "l", closed=False)
    for at, name in ((1, "front"), (3, "hospital"), (4, "school")):
        pp.create_load(net, rest[at], 0.5, 0.1, name=name)
    pp.create_sgen(net, rest[3], 0.2, name="solar park")
    pp.create_load(net, high, 3.0, 0.5, name="another town")
    return net


def test_an_impedance_is_a_line_and_who_is_not_supplied_is_named(tmp_path: Path) -> None:
    done = converted(village(), tmp_path)
    assert done.check is not None
    assert (done.check.buses, done.check.exact) == (4, True)
    told = left_out(done)
    assert told["load school"] == "not supplied in the source"
    assert "load hospital" not in told
    assert "load another town" not in told  # above the busbar, as the buses there
    rows = {row.line: row for row in load(tmp_path / "out").tables.lines}
    assert (rows["reactor"].r_ohm, rows["reactor"].x_ohm) == (pytest.approx(0.4), pytest.approx(0.8))


def test_who_is_behind_what_is_left_out_is_named(tmp_path: Path) -> None:
    done = converted(village(r_back=0.02), tmp_path)
    told = left_out(done)
    assert "asymmetric" in told["impedance reactor"]
    assert told["load hospital"].startswith("supplied in the source")
    assert told["generator solar park"] == told["load hospital"]
    assert done.check is not None
    assert not done.check.exact
    assert "line-0" in (tmp_path / "out" / "lines.csv").read_text()


def test_power_grid_model_names_who_is_not_supplied(tmp_path: Path) -> None:
    def rows(kind: ComponentType, count: int, first: int, **columns: Any) -> Any:
        table = initialize_array(DatasetType.input, kind, count)
        table["id"] = first + np.arange(count)
        for name, values in columns.items():
            table[name] = values
        return table

    tables = {
        ComponentType.node: rows(ComponentType.node, 4, 0, u_rated=400.0),
        ComponentType.line: rows(
            ComponentType.line, 3, 10, from_node=[0, 1, 2], to_node=[1, 2, 3], from_status=[1, 1, 1],
            to_status=[1, 0, 1], r1=0.05, x1=0.02, c1=0.0, tan1=0.0, i_n=200.0,
        ),
        ComponentType.source: rows(ComponentType.source, 1, 20, node=0, status=1, u_ref=1.0),
        ComponentType.sym_load: rows(
            ComponentType.sym_load, 3, 30, node=[1, 2, 3], status=1, type=0, p_specified=3e3,
            q_specified=1e3,
        ),
    }  # fmt: skip
    path = tmp_path / "town.json"
    json_serialize_to_file(path, tables)
    done = convert(str(path), tmp_path / "out")
    told = left_out(done)
    assert {told[f"load sym_load {k}"] for k in (31, 32)} == {"not supplied in the source"}
    assert [row.customer for row in load(tmp_path / "out").tables.customers] == ["sym_load 30"]


def test_opendss_names_who_is_behind_an_open_line(tmp_path: Path) -> None:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    path = tmp_path / "town.dss"
    path.write_text(
        "clear\nnew circuit.town basekv=0.4 bus1=root\n"
        "new line.one bus1=root bus2=near r1=0.1 x1=0.03 r0=0.2 x0=0.1 c1=0 c0=0\n"
        "new line.two bus1=near bus2=far r1=0.1 x1=0.03 r0=0.2 x0=0.1 c1=0 c0=0\n"
        "new load.mill bus1=near kv=0.4 kw=4\nnew load.school bus1=far kv=0.4 kw=3\n"
        "open line.two 1\nset voltagebases=[0.4]\ncalcvoltagebases\nsolve\n"
    )
    done = convert(str(path), tmp_path / "out")
    assert left_out(done)["load school"] == "not supplied in the source"
    assert done.check is not None
    assert done.check.exact


def test_the_check_does_not_depend_on_the_base_of_the_source() -> None:
    found = []
    for base in (0.1, 1.0, 100.0):
        net = street(6, base_mva=base, **ZERO)
        for bus in (3, 5, 6):
            pp.create_asymmetric_load(net, bus, p_a_mw=0.006, p_c_mw=0.002, q_a_mvar=0.003)
        done = feeder_of(read_pandapower(net), "x")
        assert done.state is not None
        check = compare(done.state, done.tables)
        assert check.largest_pu < 1e-3 * UNBALANCED_PU
        found.append(check.largest_pu)
        assert net.sn_mva == base
    assert found == pytest.approx([found[0]] * 3, rel=1e-3, abs=1e-12)


def test_a_source_without_voltages_is_named_as_such(tmp_path: Path) -> None:
    net = street(3, **ZERO)
    pp.create_asymmetric_load(net, 3, p_a_mw=0.004, name="flat")
    net.ext_grid["x0x_max"] = np.nan  # pandapower takes that, and says that it converged
    done = converted(net, tmp_path)
    assert done.check is None
    assert done.unchecked == "pandapower's own power flow gives no voltages, NaN only"


def test_a_voltage_without_the_other_is_no_agreement() -> None:
    done = feeder_of(read_pandapower(street(4)), "x")
    state = done.state
    assert state is not None
    assert compare(state, done.tables).exact
    nothing = np.full(3, np.nan)
    check = compare(replace(state, volts={**state.volts, "b2": nothing}), done.tables)
    assert (check.buses, check.three_phase, check.unmatched, check.exact) == (3, False, ("b2",), False)
    assert check.sentence.endswith("; only one of them has a voltage at bus b2")
    with refused(GridsecError, "missing"):
        compare(replace(state, volts=dict.fromkeys(state.volts, nothing)), done.tables)


def test_without_a_source_the_busbar_has_to_be_named() -> None:
    net = street(3)
    net.ext_grid["in_service"] = False
    with refused(BusbarUnclear, "busbar-unclear"):
        feeder_of(read_pandapower(net), "x")
    assert feeder_of(read_pandapower(net), "x", root="b0").tables.meta.busbar == "b0"
