"""Every table of pandapower, class of OpenDSS and component of power-grid-model has a known fate."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pandas as pd
import pytest
from pandapower.control import ConstControl
from power_grid_model import ComponentType

from feeders.convert import from_opendss, from_power_grid_model
from feeders.convert.convert import convert
from feeders.convert.customers import in_star
from feeders.convert.from_pandapower import read_pandapower
from feeders.convert.network import Converted, feeder_of
from feeders.convert.round_trip import UNBALANCED_PU, compare
from feeders.format.tables import read, validate

# --- pandapower ---------------------------------------------------------------------------------


def village(*, phased: bool = False) -> Any:
    """20 kV, a transformer, and a street of the buses 1, 2, 3, the last of which is empty."""
    net = pp.create_empty_network()
    for kv, name in ((20.0, "high"), (0.4, "root"), (0.4, "near"), (0.4, "far")):
        pp.create_bus(net, kv, name=name)
    pp.create_ext_grid(net, 0, s_sc_max_mva=1000.0, rx_max=0.1, x0x_max=1.0, r0x0_max=0.1)
    pp.create_transformer_from_parameters(
        net, 0, 1, 0.4, 20.0, 0.4, 1.0, 4.0, 1.0, 0.3, vector_group="Dyn", shift_degree=150.0,
        vk0_percent=4.0, vkr0_percent=1.0, mag0_percent=100.0, mag0_rx=0.0, si0_hv_partial=0.9,
    )  # fmt: skip
    for one, other in ((1, 2), (2, 3)):
        pp.create_line_from_parameters(
            net, one, other, 0.2, 0.2, 0.08, 100.0, 0.2, r0_ohm_per_km=0.8, x0_ohm_per_km=0.3,
            c0_nf_per_km=100.0,
        )  # fmt: skip
    pp.create_load(net, 2, 0.01, 0.002, name="house")
    if phased:
        pp.create_asymmetric_load(net, 2, p_a_mw=0.004, p_b_mw=0.002, q_b_mvar=0.001, name="flat")
    return net


def direct(net: Any) -> None:
    """Two buses of direct current, which the converters of alternating current need."""
    for _ in range(2):
        pp.create_bus_dc(net, 0.8)


def three_winding(net: Any) -> None:
    pp.create_bus(net, 10.0)
    pp.create_transformer3w_from_parameters(
        net, 0, 4, 3, 20.0, 10.0, 0.4, 1.0, 1.0, 1.0, 4.0, 4.0, 4.0, 1.0, 1.0, 1.0, 0.1, 0.1, in_service=False
    )


FILLED: dict[str, tuple[Callable[[Any], object], str]] = {
    "bus": (lambda _: None, "2 buses: all of it"),
    "line": (lambda _: None, ""),
    "trafo": (lambda net: pp.create_transformer(net, 0, 3, "0.4 MVA 20/0.4 kV", in_service=False), "trafo-1"),
    "trafo3w": (three_winding, "three-winding transformer trafo3w-0"),
    "switch": (lambda net: pp.create_switch(net, 1, 3, "b", closed=False, name="tie"), ""),
    "ext_grid": (lambda net: pp.create_ext_grid(net, 3, in_service=False), "ext_grid 1"),
    "load": (lambda net: pp.create_load(net, 3, 0.001, name="shop"), ""),
    "sgen": (lambda net: pp.create_sgen(net, 3, 0.001, name="roof"), "generator roof: droop curve"),
    "asymmetric_load": (
        lambda net: pp.create_asymmetric_load(net, 3, 0.001, name="flat", in_service=False),
        "load flat: in service",
    ),
    "asymmetric_sgen": (
        lambda net: pp.create_asymmetric_sgen(net, 3, 0.001, name="balcony", in_service=False),
        "generator balcony: all of it",
    ),
    "gen": (lambda net: pp.create_gen(net, 3, 0.001, name="g"), "gen g: control"),
    "storage": (lambda net: pp.create_storage(net, 3, 0.001, 1.0, name="s"), "storage s: control"),
    "motor": (lambda net: pp.create_motor(net, 3, 0.001, 0.9, name="m"), "motor m: control"),
    "ward": (lambda net: pp.create_ward(net, 3, 1e-3, 0.0, 1e-3, 0.0, name="w"), "ward w: control"),
    "xward": (
        lambda net: pp.create_xward(net, 2, 1e-3, 0.0, 1e-3, 0.0, 0.1, 9.0, 1.0, name="x"),
        "xward x: control",
    ),
    "shunt": (lambda net: pp.create_shunt(net, 3, -0.001, name="c"), "shunt c: connection"),
    "impedance": (
        lambda net: pp.create_impedance(net, 2, 3, 0.1, 0.1, 1.0, 0.2, name="i", in_service=False),
        "impedance i: all of it",
    ),
    "dcline": (
        lambda net: pp.create_dcline(net, 0, 3, 1e-3, 1.0, 0.0, 1.0, 1.0, in_service=False), "dcline 0"
    ),
    "svc": (lambda net: pp.create_svc(net, 3, 1.0, -1.0, 1.0, 90.0, in_service=False), "svc 0"),
    "ssc": (lambda net: pp.create_ssc(net, 3, 0.1, 0.1, in_service=False), "ssc 0"),
    "tcsc": (lambda net: pp.create_tcsc(net, 2, 3, 1.0, -1.0, 0.1, 140.0, in_service=False), "tcsc 0"),
    "bus_dc": (direct, "table bus_dc, 2 rows"),
    "line_dc": (
        lambda net: pp.create_line_dc_from_parameters(net, 0, 1, 1.0, 0.1, 1.0, in_service=False),
        "table line_dc, 1 row",
    ),
    "load_dc": (lambda net: pp.create_load_dc(net, 0, 0.0, in_service=False), "table load_dc, 1 row"),
    "source_dc": (lambda net: pp.create_source_dc(net, 0, in_service=False), "table source_dc, 1 row"),
    "vsc": (lambda net: pp.create_vsc(net, 3, 0, 0.1, 0.1, 0.1, in_service=False), "vsc 0"),
    "vsc_stacked": (
        lambda net: pp.create_vsc_stacked(net, 3, 0, 1, 0.1, 0.1, 0.1, in_service=False), "vsc_stacked 0"
    ),
    "vsc_bipolar": (
        lambda net: pp.create_vsc_bipolar(net, 3, 0, 1, 0.1, 0.1, 0.1, in_service=False), "vsc_bipolar 0"
    ),
    "measurement": (
        lambda net: pp.create_measurement(net, "v", "bus", 1.0, 0.01, 3), "table measurement, 1 row"
    ),
    "poly_cost": (lambda net: pp.create_poly_cost(net, 0, "load", 1.0), "table poly_cost, 1 row"),
    "pwl_cost": (lambda net: pp.create_pwl_cost(net, 0, "gen", [[0, 1, 1]]), "table pwl_cost, 1 row"),
    "group": (lambda net: pp.create_group(net, "load", [[0]], name="us"), "table group, 1 row"),
    "controller": (
        lambda net: ConstControl(net, "load", "p_mw", 0, data_source=None), "table controller, 1 row"
    ),
}  # fmt: skip


def tables_of(net: Any) -> set[str]:
    """Tables that may be filled: pandapower's results and its private tables are not."""
    return {key for key in net if hasattr(net[key], "columns") and not key.startswith(("_", "res_"))}


def fates(converted: Converted) -> list[str]:
    assert validate(converted.tables) == ()
    return [f"{each.element}: {each.prop}" for each in converted.changes]


def filled(tables: Iterable[str]) -> Converted:
    """A village with a row in every one of some tables, and in one that nobody knows."""
    net = village()
    for table in tables:
        FILLED[table][0](net)
        assert len(net[table])
    net["wishes"] = net.load[["name"]].copy()
    converted = feeder_of(read_pandapower(net), "x", root="root")
    said = fates(converted)
    wanted = {**{table: FILLED[table][1] for table in tables}, "wishes": "table wishes, "}
    assert [table for table, fate in wanted.items() if not any(fate in one for one in said)] == []
    return converted


def test_every_table_of_pandapower_is_carried_over_or_named() -> None:
    assert tables_of(village()) == FILLED.keys()
    # Direct current, even where it is switched off, leaves pandapower without a solution.
    of_dc = [table for table in FILLED if "dc" in table.split("_") or "vsc" in table]
    filled(of_dc)
    converted = filled([table for table in FILLED if table not in of_dc])
    assert {row.line for row in converted.tables.lines} == {"line-0", "line-1", "tie", "shunt c"}
    names = {"house", "shop", "flat", "gen g", "storage s", "motor m", "ward w", "xward x"}
    assert {row.customer for row in converted.tables.customers} == names
    assert converted.state is not None
    # What is left out is switched off here.
    assert compare(converted.state, converted.tables).exact


def test_between_phases_as_pandapower_solves_it() -> None:
    """At unlike voltages a delta draws from each phase something else than a star."""
    net = village(phased=True)
    by_phase = {f"{part}_{p}_{unit}": x for p, x in zip("abc", (0.008, 0.002, 0.001), strict=True)
                for part, unit in (("p", "mw"), ("q", "mvar"))}  # fmt: skip
    three = {"p_mw": 0.03, "q_mvar": 0.01}
    pp.create_asymmetric_load(net, 3, **by_phase, type="delta", name="works")
    pp.create_asymmetric_sgen(net, 3, **by_phase, type="delta", name="panel")
    pp.create_load(net, 3, **three, type="delta", name="mill")
    pp.create_sgen(net, 3, **three, type="delta", name="turbine")
    pp.create_sgen(net, 3, 0.006, type="WP", name="wind")
    pp.create_load(net, 2, 0.02, name="beside", type="delta", in_service=False)
    converted = feeder_of(read_pandapower(net), "x", root="root")
    assert converted.state is not None
    check = compare(converted.state, converted.tables)
    assert (check.three_phase, check.largest_pu < UNBALANCED_PU) == (True, True)
    told = {each.element for each in converted.changes if (each.prop, each.done) == ("delta", "approximated")}
    assert told == {"load works", "load mill", "load beside", "generator panel", "generator turbine"}
    rows = {row.customer for row in converted.tables.customers}
    uneven = ("works", "mill", "beside", "panel", "turbine")
    assert rows == {"house", "flat-a", "flat-b", "wind", *(f"{one}-{p}" for one in uneven for p in "abc")}
    # A type that is neither: in star, which pandapower's three phases leave out unless told so.
    assert {"1 sgen(s): type", "generator wind: type WP"} <= set(fates(converted))
    assert net.sgen.type.tolist() == ["delta", "WP"]


def test_in_star_is_what_flows_between_the_phases() -> None:
    volts = 230.0 * np.exp(1j * np.deg2rad([3.0, -121.0, 118.0])) * np.array([1.0, 0.97, 1.03])
    pairs = np.array([8.0 + 2.0j, 0.0, 1.0 - 0.5j])
    ab, ca = np.conj(pairs[0] / (volts[0] - volts[1])), np.conj(pairs[2] / (volts[2] - volts[0]))
    np.testing.assert_allclose(in_star(pairs, volts), volts * np.conj([ab - ca, -ab, ca]), rtol=1e-12)
    assert in_star(pairs, volts).sum() == pytest.approx(pairs.sum())


def test_a_capacitor_takes_what_its_table_has_for_its_step() -> None:
    net = village()
    pp.create_shunt(net, 3, -0.001, step=2, step_dependency_table=True, id_characteristic_table=0)
    net["shunt_characteristic_table"] = pd.DataFrame(
        {"id_characteristic": [0, 0, 1], "step": [1, 2, 2], "q_mvar": [-0.004, -0.007, -9.0], "p_mw": 0.0}
    )
    converted = feeder_of(read_pandapower(net), "x", root="root")
    assert converted.state is not None
    assert compare(converted.state, converted.tables).exact
    assert not [fate for fate in fates(converted) if "characteristic" in fate]
    row = next(row for row in converted.tables.lines if row.line == "shunt shunt-0")
    assert row.b_us == pytest.approx(1e6 * 0.007 / 0.4**2)


def test_batteries_and_plants_that_draw() -> None:
    net = village()
    pp.create_storage(net, 3, -0.004, 1.0, name="full")
    pp.create_storage(net, 3, 0.003, 1.0, name="empty")
    pp.create_sgen(net, 2, -0.001, name="standby")
    converted = feeder_of(read_pandapower(net), "x", root="root")
    assert converted.state is not None
    assert compare(converted.state, converted.tables).exact
    assert converted.state.power_kva["storage full"] == pytest.approx(-4.0)
    rows = {row.customer: row for row in converted.tables.customers}
    full, empty = rows["storage full"], rows["storage empty"]
    assert (full.load_kw, full.pv_kw, full.pv_profile, full.inverter_kva) == (0.0, 0.0, "", 0.0)
    assert (empty.load_kw, empty.pv_kw) == (3.0, 0.0)
    assert {"customer storage full: p_kw", "generator standby: p_mw"} <= set(fates(converted))


# --- OpenDSS ------------------------------------------------------------------------------------

HEAD = """
clear
new circuit.x basekv=11 pu=1.02 mvasc3=100 mvasc1=100 bus1=Grid
new transformer.t windings=2 buses=(Grid,Board) conns=(delta,wye) kvs=(11,0.4) kvas=(800,800) xhl=4
new line.main bus1=Board bus2=B1 r1=0.06 x1=0.02 r0=0.2 x0=0.06 c1=0 c0=0 normamps=150
new load.shop bus1=B1 phases=3 kv=0.4 kw=15 pf=0.95
new loadshape.day npts=2 interval=12 mult=(1 0.5)
new loadshape.year npts=2 interval=4380 mult=(1 0.5)
new tshape.warm npts=2 interval=12 temp=(20 30)
new xycurve.panel npts=2 xarray=(0 75) yarray=(1.2 0.8)
new xycurve.vv npts=4 xarray=(0.5 0.92 1.08 1.5) yarray=(0.4 0 0 -0.4)
new xycurve.eff npts=2 xarray=(0.1 1.0) yarray=(0.9 0.97)
"""
TAIL = """
set voltagebases=[11,0.4]
calcvoltagebases
solve
"""


def master(folder: Path, body: str) -> str:
    path = folder / "master.dss"
    path.write_text(HEAD + body + TAIL)
    return str(path)


def test_every_class_of_opendss_has_a_fate() -> None:
    dss = pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed").dss
    known = [
        {"line", "reactor", "capacitor", "vsource"},
        from_opendss.COUPLINGS,
        from_opendss.LOADS,
        from_opendss.GENERATORS,
        from_opendss.STORAGE,
        set(from_opendss.TOLD),
        from_opendss.NO_PLACE,
        from_opendss.DEFINITIONS,
    ]
    assert sum(map(len, known)) == len(set().union(*known))
    engine = dss.NewContext()
    assert {name.lower() for name in engine.Basic.Classes()} == set().union(*known)
    engine.Basic.AllowForms(False)
    engine.Text.Command("new circuit.x")
    before = engine.Circuit.AllElementNames()
    for name in from_opendss.DEFINITIONS:
        engine.Text.Command(f"new {name}.x")
    assert engine.Circuit.AllElementNames() == before
    engine.Basic.ClearAll()


def test_what_an_opendss_circuit_holds_is_carried_over_or_named(tmp_path: Path) -> None:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    source = master(
        tmp_path,
        """
new load.home bus1=B1 phases=3 kv=0.4 kw=5 daily=day yearly=year duty=day cvrcurve=day
new pvsystem.roof bus1=B1 phases=3 kv=0.4 kva=10 pmpp=8 irradiance=0.5 daily=day tdaily=warm
~ p-tcurve=panel effcurve=eff
new pvsystem.night bus1=B1.2 phases=1 kv=0.231 kva=4 pmpp=3 irradiance=0
new storage.full bus1=B1 phases=3 kv=0.4 kwrated=5 kwhrated=10 state=discharging daily=day
new storage.empty bus1=B1 phases=3 kv=0.4 kwrated=4 kwhrated=10 %stored=50 state=charging
new storage.kept bus1=B1 phases=3 kv=0.4 kwrated=1 kwhrated=10 %stored=50
new generator.diesel bus1=B1 phases=3 kv=0.4 kw=3 pf=0.9 yearly=year
new indmach012.saw bus1=B1 phases=3 kv=0.4 kw=2 kva=3
new monitor.m element=line.main terminal=2
new energymeter.e element=line.main
new sensor.s element=line.main terminal=2 kvbase=0.4
new invcontrol.volts mode=voltvar voltage_curvex_ref=rated vvc_curve1=vv derlist=(pvsystem.roof)
new storagecontroller.fleet element=line.main elementlist=(kept)
new swtcontrol.door switchedobj=line.main
new fuse.f monitoredobj=line.main ratedcurrent=500
new relay.r monitoredobj=line.main
new recloser.c monitoredobj=line.main phasetrip=500 groundtrip=500
new upfccontrol.u
""",
    )
    done = convert(source, tmp_path / "x")
    assert done.check is not None
    assert done.check.exact
    said = {(each.element, each.prop) for each in done.changes}
    for element, prop in (
        ("load home", "load shape day"), ("load home", "load shape year"),
        ("pvsystem roof", "irradiance 0.5"), ("pvsystem roof", "load shape day"),
        ("pvsystem roof", "tdaily warm"), ("pvsystem roof", "p-tcurve panel"),
        ("pvsystem roof", "effcurve eff"), ("pvsystem night", "irradiance 0"),
        ("storage full", "load shape day"), ("storage full", "p_kw"), ("storage full", "control"),
        ("storage empty", "control"), ("generator diesel", "load shape year"),
        ("generator diesel", "profile"), ("generator diesel", "control"), ("indmach012 saw", "control"),
        ("monitor m", "all of it"), ("energymeter e", "all of it"), ("sensor s", "all of it"),
        ("invcontrol volts", "all of it"), ("storagecontroller fleet", "all of it"),
        ("swtcontrol door", "all of it"), ("fuse f", "all of it"), ("relay r", "all of it"),
        ("recloser c", "all of it"), ("upfccontrol u", "all of it"),
    ):  # fmt: skip
        assert (element, prop) in said, (element, prop)
    rows = {row.customer: row for row in read(tmp_path / "x").customers}
    peaks = {name: (row.load_kw, row.pv_kw, row.inverter_kva) for name, row in rows.items()}
    assert (peaks["roof"], peaks["night"]) == ((0.0, 8.0, 10.0), (0.0, 3.0, 4.0))
    assert peaks["full"] == (0.0, 0.0, 0.0)
    assert peaks["empty"] == (pytest.approx(4.0, rel=0.05), 0.0, 0.0)
    assert peaks["diesel"] == (0.0, pytest.approx(3.0), 0.0)
    assert (rows["full"].pv_profile, rows["empty"].pv_profile) == ("", "")
    assert not [each for each in done.changes if "storage" in each.element and "droop" in each.effect]


@pytest.mark.parametrize(
    "body",
    [
        "new isource.x bus1=B1 phases=3 amps=1",
        "new fault.x bus1=B1 phases=1 r=1000",
        "new upfc.x bus1=B1 bus2=B2 refkv=0.23 phases=1",
        "new gicline.x bus1=B1 bus2=B2",
        "new gictransformer.x bush=B1 busx=B2 r1=0.1 r2=0.1",
        "new espvlcontrol.x element=line.main",
        "new gendispatcher.x element=line.main",
    ],
)
def test_what_has_no_place_in_a_feeder_is_named(body: str, tmp_path: Path) -> None:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    done = convert(master(tmp_path, body), tmp_path / "x")
    said = [(each.element, each.done) for each in done.changes if each.prop == "all of it"]
    assert (f"{body.partition('.')[0].removeprefix('new ')} x", "left out") in said


def test_what_flows_into_an_autotransformer(tmp_path: Path) -> None:
    pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")
    body = "new autotrans.x windings=2 buses=(B1,B2) kvs=(0.4,0.23)\nnew load.z bus1=B2 phases=3 kv=0.23 kw=2"
    done = convert(master(tmp_path, body), tmp_path / "x")
    assert done.check is not None
    assert done.check.exact
    rows = {row.customer: row.load_kw for row in read(tmp_path / "x").customers}
    assert rows["autotrans x"] == pytest.approx(2.0, rel=0.01)


# --- power-grid-model ---------------------------------------------------------------------------


def test_every_component_of_power_grid_model_has_a_fate() -> None:
    kinds = {each.value for each in ComponentType}
    sensors = {kind for kind in kinds if kind.endswith("_sensor")}
    noted = set(from_power_grid_model.NOTED)
    assert not from_power_grid_model.CARRIED & noted
    # Those of later versions are named by the converter as what it does not know.
    assert from_power_grid_model.CARRIED | noted <= kinds
    assert kinds - sensors - noted - from_power_grid_model.CARRIED <= {"voltage_regulator"}
