"""The round trip of pandapower nets by its own power flow: transformers, capacitors, loops, single phases."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest
from pandapower import networks

from feeders.convert.convert import check_against_source, convert
from feeders.convert.from_pandapower import read_pandapower
from feeders.convert.from_power_grid_model import read_pgm
from feeders.convert.network import feeder_of
from feeders.convert.provenance import ConversionChange, changes_csv, sentences
from feeders.convert.round_trip import BALANCED_PU, UNBALANCED_PU, SourceCheck, compare
from feeders.convert.transformers import Extent
from feeders.format.tables import read, write
from feeders.model.three_phase import three_phase
from feeders.simulation.powerflow import PowerFlowDiverged, UnbalancedPowerFlow
from gridsec.errors import FeederInvalid, GridsecError
from tests.codes import refused
from tests.feeders.foreign import pgm


@pytest.mark.canary("create_cigre_network_mv-Bus 12-3")
@pytest.mark.parametrize(
    ("maker", "root", "buses"),
    [
        ("create_cigre_network_mv", "Bus 1", 11),
        ("create_cigre_network_mv", "Bus 12", 3),
        ("mv_oberrhein", "Bus 19", 69),
        ("mv_oberrhein", "Bus 178", 108),
        ("create_kerber_landnetz_kabel_2", None, 29),
    ],
)
def test_balanced_networks(maker: str, root: str | None, buses: int, tmp_path: Path) -> None:
    """Medium voltage has charging, open ends of cables, and generators."""
    check = convert(f"pandapower:{maker}", tmp_path / "x", root=root).check
    assert check is not None
    assert (check.buses, check.three_phase) == (buses, False)
    assert check.largest_pu < BALANCED_PU


def village(*, closed: bool = False) -> Any:
    """20 kV with a transformer to 0.4 kV, a capacitor, loads that depend on the voltage, and a ring."""
    net = pp.create_empty_network()
    high, root, a, b = (pp.create_bus(net, kv, name=name) for kv, name in
                        ((110.0, "high"), (20.0, "root"), (20.0, "A"), (20.0, "B")))  # fmt: skip
    low, home = (pp.create_bus(net, 0.4, name=name) for name in ("low", "home"))
    pp.create_ext_grid(net, high, vm_pu=1.02)
    pp.create_transformer(net, high, root, "25 MVA 110/20 kV")
    pp.create_transformer(net, b, low, "0.4 MVA 20/0.4 kV", name="T1")
    kind = "NA2XS2Y 1x185 RM/25 12/20 kV"
    for name, one, other, km in (("1", root, a, 5.0), ("2", a, b, 4.0), ("ring", root, b, 6.0)):
        pp.create_line(net, one, other, km, kind, name=name)
    pp.create_line(net, low, home, 0.1, "NAYY 4x150 SE", name="street")
    if not closed:
        pp.create_switch(net, b, 2, "l", closed=False)
    pp.create_load(net, a, 2.0, 0.5, name="mill", const_z_p_percent=50.0, const_z_q_percent=50.0)
    pp.create_load(net, home, 0.1, 0.03, name="house")
    pp.create_shunt(net, a, q_mvar=-0.4, name="bank")
    pp.create_sgen(net, b, 1.5, sn_mva=2.0, name="wind")
    return net


def test_transformer_capacitor_and_open_cable_are_carried_over() -> None:
    converted = feeder_of(read_pandapower(village()), "village", root="root", extent=Extent(one_voltage=True))
    assert converted.state is not None
    check = compare(converted.state, converted.tables)
    assert check.largest_pu < BALANCED_PU
    assert check.as_found_pu is not None
    assert check.as_found_pu > BALANCED_PU
    customers = {row.customer: row for row in converted.tables.customers}
    assert customers["transformer T1"].load_kw == pytest.approx(102.0, abs=1.5)
    said = "\n".join(sentences(converted.changes))
    for part in ("load side of transformer T1; 2 buses became", "connection of shunt bank; 400 kvar",
                 "const_z_p_percent", "droop curve of generator wind"):  # fmt: skip
        assert part in said, part
    # Without the capacitor the voltages differ, and the check says so.
    bare = tuple(line for line in converted.tables.lines if line.line != "shunt bank")
    assert not compare(converted.state, replace(converted.tables, lines=bare)).exact


def test_parallel_transformers_on_a_coupled_busbar_are_one_infeed() -> None:
    """Two transformers, a busbar for each, a closed coupler; open, there are two busbars to choose from."""
    net = village()
    second = pp.create_bus(net, 20.0, name="root 2")
    pp.create_transformer(net, 0, second, "25 MVA 110/20 kV")
    pp.create_switch(net, 1, second, "b", name="coupler")
    far = pp.create_bus(net, 20.0, name="far")
    pp.create_line(net, second, far, 2.0, "NA2XS2Y 1x185 RM/25 12/20 kV", name="far")
    pp.create_load(net, far, 1.0, 0.2, name="farm")
    net.trafo.loc[1, "in_service"] = False  # that of the low voltage
    converted = feeder_of(read_pandapower(net), "x")
    assert converted.tables.meta.busbar == "root"
    assert converted.state is not None
    check = compare(converted.state, converted.tables)
    assert (check.buses, check.largest_pu < BALANCED_PU) == (5, True)
    net.switch.loc[net.switch.name == "coupler", "closed"] = False
    with refused(GridsecError, "busbar-unclear") as caught:
        feeder_of(read_pandapower(net), "x")
    assert "root, root 2" in str(caught.value)
    assert feeder_of(read_pandapower(net), "x", root="root 2").tables.customers[0].customer == "farm"


@pytest.mark.acceptance
def test_loop_is_named_and_opened_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "ring.json"
    pp.to_json(village(closed=True), str(path))
    with refused(FeederInvalid, "not-radial"):
        convert(str(path), tmp_path / "x", root="root")
    done = convert(str(path), tmp_path / "x", root="root", opened=["ring"])
    assert done.check is not None
    assert not done.check.exact
    assert "--open ring" in (tmp_path / "x" / "SOURCE.md").read_text()
    pp.to_json(village(), str(path))
    # What the open cable's end still charges is all that is left between the two.
    assert check_against_source(str(path), tmp_path / "x", root="root").largest_pu < 1e-3


@pytest.mark.acceptance
def test_single_phases_with_generators_and_a_folder_again(tmp_path: Path) -> None:
    net = networks.ieee_european_lv_asymmetric("on_peak_566")
    pp.create_asymmetric_sgen(net, 200, p_b_mw=0.004, q_b_mvar=0.0, name="roof")
    path = tmp_path / "european.json"
    pp.to_json(net, str(path))
    done = convert(str(path), tmp_path / "x")
    assert done.check is not None
    assert (done.check.buses, done.check.three_phase) == (906, True)
    assert done.check.largest_pu < UNBALANCED_PU
    roof = {row.customer: row for row in read(tmp_path / "x").customers}["roof"]
    assert (roof.phases, roof.pv_kw, roof.load_kw) == ("b", pytest.approx(4.0), 0.0)
    again = convert(str(tmp_path / "x"), tmp_path / "y")
    assert (again.check, again.changes) == (None, done.changes)
    assert read(tmp_path / "y") == read(tmp_path / "x")


def test_check_compares_what_the_flows_say(tmp_path: Path) -> None:
    """The reported difference is the one between the two sets of voltages, by hand."""
    converted = feeder_of(read_pgm(pgm(tmp_path / "town.json", 30, balanced=False)), "x")
    state = converted.state
    assert state is not None
    site = three_phase(converted.tables)
    power = np.array([state.power_kva[row.customer] for row in converted.tables.customers])
    _, volts = UnbalancedPowerFlow(site).solve(power.real, power.imag, state.busbar_volt)
    apart = {bus: np.abs(volts[site.bus_of_file[bus]] - v).max() for bus, v in state.volts.items()}
    check = compare(state, converted.tables)
    assert check.at == max(apart, key=lambda bus: apart[bus])
    assert check.largest_pu == pytest.approx(max(apart.values()) / converted.tables.meta.voltage_volt)
    shifted = {bus: v + 0.01 * converted.tables.meta.voltage_volt for bus, v in state.volts.items()}
    assert compare(replace(state, volts=shifted), converted.tables).largest_pu == pytest.approx(
        0.01, rel=1e-2
    )


def test_all_problems_of_a_net_at_once(tmp_path: Path) -> None:
    net = village()
    net.line.loc[0, "from_bus"] = 77
    net.load.loc[1, "bus"] = 78
    net.line.loc[1, "length_km"] = np.nan
    path = tmp_path / "broken.json"
    pp.to_json(net, str(path))
    with refused(FeederInvalid, "unknown-index", "unknown-index", "out-of-range") as caught:
        convert(str(path), tmp_path / "x")
    assert all(part in str(caught.value) for part in ("from_bus 77", "bus 78", "line 1: length_km is nan"))
    net = village()
    del net["trafo3w"], net["shunt"]
    net.line = net.line.drop(columns="df")
    with refused(FeederInvalid, "missing", "missing"):
        feeder_of(read_pandapower(net), "x")
    fresh = village()
    fresh.line = fresh.line.drop(columns=["df", "parallel"])
    with refused(FeederInvalid, "missing", "missing"):
        feeder_of(read_pandapower(fresh), "x")


def test_unknown_numbers_and_truths_of_any_table_are_told() -> None:
    net = village()
    pp.create_asymmetric_load(net, 2, p_a_mw=0.001, p_b_mw=np.nan)
    pp.create_asymmetric_sgen(net, 2, p_a_mw=0.001, q_c_mvar=np.nan)
    pp.create_shunt(net, 2, q_mvar=np.nan)
    net.bus.loc[1, "vn_kv"] = np.nan
    net.load["in_service"] = net.load["in_service"].astype(object)
    net.load.loc[0, "in_service"] = np.nan
    net.switch["closed"] = net.switch["closed"].astype(object)
    net.switch.loc[0, "closed"] = None
    with refused(FeederInvalid, *["out-of-range"] * 4, *["wrong-type"] * 2) as caught:
        feeder_of(read_pandapower(net), "x")
    assert {problem.partition(" is ")[0] for problem in caught.value.problems} == {
        "asymmetric_load 0: p_b_mw",
        "asymmetric_sgen 0: q_c_mvar",
        "shunt 1: q_mvar",
        "bus 1: vn_kv",
        "load 0: in_service",
        "switch 0: closed",
    }


def test_truths_may_be_numbers_and_a_shunt_of_no_power_is_named() -> None:
    net = village()
    expected = feeder_of(read_pandapower(net), "x").tables
    for table in ("load", "line", "trafo", "ext_grid", "bus"):
        net[table]["in_service"] = net[table]["in_service"].astype(float)
    pp.create_shunt(net, 2, q_mvar=0.0, name="none")
    found = feeder_of(read_pandapower(net), "x")
    assert found.tables == expected
    assert "shunt none" in [each.element for each in found.changes]


def test_another_source_hides_no_loop() -> None:
    net = village(closed=True)
    pp.create_ext_grid(net, 3)  # bus B
    with refused(FeederInvalid, "several-sources", "not-radial") as caught:
        feeder_of(read_pandapower(net), "x", root="root")
    source, loop = caught.value.problems
    assert source.startswith("bus 'B' ")
    assert loop.startswith("lines: ")
    with refused(FeederInvalid, "several-sources") as caught:
        feeder_of(read_pandapower(net), "x", root="root", extent=Extent(meshed=True))
    assert caught.value.problems == (source,)


def test_a_wrong_busbar_hides_no_other_wrong_choice(tmp_path: Path) -> None:
    net = village()
    for wrong, count in (({"droop": "nosuch"}, 1), ({"opened": ["no", "none"]}, 2)):
        with refused(FeederInvalid, *["unknown-name"] * count):
            feeder_of(read_pandapower(net), "x", **wrong)  # type: ignore[arg-type]
    choices = {"root": "nowhere", "droop": "nosuch", "opened": ["no"]}
    source = str(pgm(tmp_path / "town.json", 6, balanced=True))
    pp.to_json(net, str(tmp_path / "village.json"))
    for each in (source, str(tmp_path / "village.json")):
        with refused(FeederInvalid, *["unknown-name"] * 3) as caught:
            convert(each, tmp_path / "x", **choices)  # type: ignore[arg-type]
        told = caught.value.problems
        assert all(part in told[k] for k, part in enumerate(("nowhere", "'no'", "'nosuch'")))


def test_what_is_no_number_is_told_and_not_a_traceback() -> None:
    net = village()
    net.line["r_ohm_per_km"] = net.line["r_ohm_per_km"].astype(object)
    net.line.loc[0, "r_ohm_per_km"] = "a lot"
    net.line.loc[1, "parallel"] = 0
    net.load.loc[0, "p_mw"] = np.nan
    net.switch.loc[0, "element"] = 99
    net.f_hz = None
    net.bus["geo"] = '{"x": 1}'
    with refused(FeederInvalid, "unknown-index", "not-positive", *["out-of-range"] * 3) as caught:
        feeder_of(read_pandapower(net), "x")
    assert {problem.partition(" is ")[0] for problem in caught.value.problems} == {
        "line 0: r_ohm_per_km",
        "line 1: parallel",
        "load 0: p_mw",
        "switch 0: element 99",
        "f_hz",
    }


@pytest.mark.acceptance
def test_a_source_without_solution_is_converted_and_not_checked(tmp_path: Path) -> None:
    net = village()
    net.load.loc[0, "p_mw"] = 90.0
    path = tmp_path / "heavy.json"
    pp.to_json(net, str(path))
    done = convert(str(path), tmp_path / "x", root="root")
    assert done.check is None
    assert "own power flow fails" in done.unchecked
    said = "\n".join(done.notes)
    assert "no-load current of transformer T1; not known without the source's power flow" in said
    done = convert(str(path), tmp_path / "y", root="root", one_voltage=True)
    assert "load side of transformer T1; 2 buses; the power into it is not known" in "\n".join(done.notes)
    with refused(GridsecError, "not-converged"):
        check_against_source(str(path), tmp_path / "x", root="root")


@pytest.mark.acceptance
def test_what_is_doubtful_is_accepted_from_a_source_with_a_solution_only(tmp_path: Path) -> None:
    """Loads in kW in a column of MW: the source's own power flow has no solution."""
    path = tmp_path / "kw.json"
    net = village(closed=True)
    net.load["p_mw"] *= 1000.0
    pp.to_json(net, str(path))
    with refused(FeederInvalid, "not-radial", *["doubtful"] * 3) as caught:
        convert(str(path), tmp_path / "x", root="root")
    said = "\n".join(caught.value.problems)
    for part in ("column load_kw: 2e+06 is very large", "own power flow fails: "):
        assert part in said, part
    assert "accept = [" not in said
    assert not (tmp_path / "x").exists()
    with refused(FeederInvalid, *["doubtful"] * 3):
        convert(str(path), tmp_path / "x", root="root", meshed=True)


@pytest.mark.acceptance
def test_a_feeder_without_solution_is_told(tmp_path: Path) -> None:
    path = tmp_path / "village.json"
    pp.to_json(village(), str(path))
    convert(str(path), tmp_path / "x", root="root")
    tables = read(tmp_path / "x")
    weak = tuple(replace(line, r_ohm=100 * line.r_ohm, x_ohm=100 * line.x_ohm) for line in tables.lines)
    meta = replace(tables.meta, accept=("impedance", "ratio", "load"))
    write(replace(tables, meta=meta, lines=weak), tmp_path / "x")
    with refused(PowerFlowDiverged, "not-converged"):
        check_against_source(str(path), tmp_path / "x", root="root")


def test_sentences_of_a_check_and_of_changes() -> None:
    check = SourceCheck("Tool 1", 3, three_phase=False, largest_pu=2e-10, at="b", as_found_pu=None)
    assert check.exact
    assert check.sentence.endswith("3 buses: |v| differs by less than 1e-08 pu")
    worse = replace(check, largest_pu=2.5e-4, three_phase=True, as_found_pu=1e-3)
    assert not worse.exact
    assert "less than 1e-03 pu (bus b)" in worse.sentence
    same = [ConversionChange(f"load {k}", "model 2", "approximated", "constant power") for k in range(11)]
    assert sentences(same) == (
        "approximated: model 2 of "
        + ", ".join(f"load {k}" for k in range(8))
        + " and 3 more; constant power",
    )
    assert len(changes_csv(same).splitlines()) == 12


def test_switches_with_an_impedance_and_what_is_switched_off(tmp_path: Path) -> None:
    net = networks.create_kerber_landnetz_freileitung_1()
    far = int(net.load.bus.iloc[-1])
    end = pp.create_bus(net, 0.4, name="end")
    pp.create_switch(net, far, end, "b", z_ohm=0.05, name="fuse")
    pp.create_load(net, end, 0.01, 0.003, name="shop")
    pp.create_load(net, end, 0.02, 0.001, name="closed shop", in_service=False)
    pp.create_sgen(net, end, 0.02, sn_mva=0.02, name="old roof", in_service=False)
    pp.create_load(net, end, 0.0, 0.002, name="coil")
    pp.to_json(net, str(tmp_path / "net.json"))
    done = convert(str(tmp_path / "net.json"), tmp_path / "x")
    assert done.check is not None
    assert done.check.largest_pu < UNBALANCED_PU
    said = [(each.element, each.prop, each.done) for each in done.changes]
    assert ("load closed shop", "in service", "changed") in said
    assert ("generator old roof", "all of it", "left out") in said
    assert ("load coil", "reactive power", "left out") in said
    customers = {row.customer: row for row in read(tmp_path / "x").customers}
    assert customers["closed shop"].load_kw == 0.0
    # A generator that is switched off does not become an inverter that works.
    assert not any(row.inverter_kva for row in customers.values())
    pp.create_asymmetric_load(net, end, name="nobody")
    later = [(each.element, each.prop, each.done) for each in feeder_of(read_pandapower(net), "x").changes]
    assert ("load nobody", "all of it", "left out") in later
