"""Networks of several voltages as one feeder: AC voltages against the tools they come from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest

from feeders.convert.convert import check_against_source, convert
from feeders.convert.round_trip import BALANCED_PU, UNBALANCED_PU
from feeders.format.tables import FeederTables, read
from feeders.model.site import from_tables
from feeders.studies.unobservable import CurvePositions, knowledge
from gridsec.errors import FeederInvalid
from tests.codes import refused
from tests.feeders.convert.test_from_power_grid_model import line, load, transformer, written


def stations(tables: FeederTables) -> dict[str, float]:
    return {row.line: row.to_volt for row in tables.lines if row.to_volt is not None}


@pytest.mark.canary("pandapower:create_cigre_network_mv-Bus 0-15-11547.0")
@pytest.mark.usefixtures("simbench_tables")
@pytest.mark.parametrize(
    ("source", "root", "buses", "behind"),
    [
        ("pandapower:example_multivoltage", "Bus MV0", 20, 230.94),
        ("pandapower:create_cigre_network_mv", "Bus 0", 15, 11547.0),
        ("pandapower:mv_oberrhein", "58", 70, 11547.0),
        ("simbench:1-MVLV-rural-1.108-0-sw", None, 0, 230.94),
    ],
)
def test_pandapowers_networks(
    source: str, root: str | None, buses: int, behind: float, tmp_path: Path
) -> None:
    done = convert(source, tmp_path / "x", root=root)
    assert done.check is not None
    assert done.check.largest_pu < 1e-8 < BALANCED_PU
    if buses:
        assert done.check.buses == buses
    tables = read(tmp_path / "x")
    assert {round(volt, 1 if volt > 1e3 else 2) for volt in stations(tables).values()} == {behind}
    site = from_tables(tables)
    assert (site.nominal_volt != site.feeder.base_volt).any()


@pytest.mark.canary("-2")
@pytest.mark.parametrize("tap", [-2, 1])
def test_a_station_with_everything(tap: int, tmp_path: Path) -> None:
    """Iron, magnetising current, taps, rated voltages beside the nominal ones, a vector group, twice."""
    net = village(tap)
    done = convert(saved(net, tmp_path), tmp_path / "x", root="root")
    assert done.check is not None
    assert done.check.largest_pu < 1e-8
    tables = read(tmp_path / "x")
    idle = [row for row in tables.customers if row.customer.endswith("no-load")]
    assert len(idle) == 2
    assert not any(row.meter for row in idle)
    known = knowledge(
        from_tables(tables), unknown=None, silent=(), busbar_known=True, curves=CurvePositions.DEADBAND
    )
    assert known.unknown == ()
    assert all(row.meter for row in tables.customers if row not in idle)
    iron = 1.3 * (net.res_bus.vm_pu[1] * 20.0 / 20.8) ** 2 if net.converged else 1.3
    assert idle[0].load_kw == pytest.approx(iron, rel=0.2)
    assert any("side by side" in note or "in parallel" in note for note in done.notes)
    (both,) = (row for row in tables.lines if row.to_volt is not None)
    assert both.rating_a is not None
    # At other loads it is as good, but for what the no-load current changes with the voltage.
    net.load["p_mw"] *= 0.3
    net.ext_grid["vm_pu"] = 0.99
    worst = check_against_source(saved(net, tmp_path), tmp_path / "x", root="root").largest_pu
    assert worst < BALANCED_PU
    # Who wants one voltage only gets what there was, and no better.
    convert(saved(net, tmp_path), tmp_path / "y", root="root", one_voltage=True)
    assert not stations(read(tmp_path / "y"))
    assert "--one-voltage" in (tmp_path / "y" / "SOURCE.md").read_text()
    assert check_against_source(saved(net, tmp_path), tmp_path / "y", root="root", one_voltage=True).exact


def village(tap: int = 0) -> Any:
    """110 kV, a street of 20 kV, and two transformers beside each other to a street of 0.4 kV."""
    net = pp.create_empty_network()
    high, root, end = (pp.create_bus(net, kv, name=n) for kv, n in ((110, "high"), (20, "root"), (20, "end")))
    low, home = (pp.create_bus(net, 0.4, name=name) for name in ("low", "home"))
    pp.create_ext_grid(net, high, vm_pu=1.01)
    pp.create_transformer(net, high, root, "25 MVA 110/20 kV")
    pp.create_line(net, root, end, 4.0, "NA2XS2Y 1x185 RM/25 12/20 kV", name="street")
    for name in ("T1", "T2"):
        pp.create_transformer_from_parameters(
            net, end, low, sn_mva=0.4, vn_hv_kv=20.8, vn_lv_kv=0.42, vk_percent=5.0, vkr_percent=1.2,
            pfe_kw=1.3, i0_percent=1.4, shift_degree=150, tap_side="hv", tap_neutral=0, tap_pos=tap,
            tap_step_percent=2.5, tap_changer_type="Ratio", name=name,
        )  # fmt: skip
    pp.create_line(net, low, home, 0.2, "NAYY 4x150 SE", name="lane")
    pp.create_load(net, home, 0.11, 0.04, name="house")
    pp.create_load(net, end, 1.0, 0.3, name="mill")
    pp.runpp(net, numba=False)
    return net


def saved(net: Any, folder: Path) -> str:
    pp.to_json(net, str(folder / "net.json"))
    return str(folder / "net.json")


def test_a_station_without_lines_stays_a_customer(tmp_path: Path) -> None:
    net = village()
    net.line.loc[net.line.name == "lane", "in_service"] = False
    net.load.loc[net.load.name == "house", "bus"] = net.bus.index[net.bus.name == "low"][0]
    done = convert(saved(net, tmp_path), tmp_path / "x", root="root")
    tables = read(tmp_path / "x")
    assert not stations(tables)
    assert {"transformer T1", "transformer T2"} <= {row.customer for row in tables.customers}
    assert done.check is not None
    assert done.check.exact


@pytest.mark.acceptance
def test_a_loop_through_stations(tmp_path: Path) -> None:
    """Closed on the low side: radial as it was, a mesh when asked, and never one of different ratios."""
    net = village()
    other = pp.create_bus(net, 20.0, name="other")
    root, low = (net.bus.index[net.bus.name == name][0] for name in ("root", "low"))
    pp.create_line(net, root, other, 3.0, "NA2XS2Y 1x185 RM/25 12/20 kV", name="second")
    net.trafo.loc[net.trafo.name == "T2", "hv_bus"] = other
    net.trafo.loc[net.trafo.name.isin(["T1", "T2"]), ["i0_percent", "pfe_kw"]] = 0.0
    radial = convert(saved(net, tmp_path), tmp_path / "radial", root="root")
    assert radial.check is not None
    assert radial.check.exact
    assert list(stations(read(tmp_path / "radial"))) == ["transformer T1"]
    assert any("transformer T2; in a loop" in note for note in radial.notes)
    ring = convert(saved(net, tmp_path), tmp_path / "ring", root="root", meshed=True)
    assert ring.check is not None
    assert ring.check.largest_pu < 1e-8
    site = from_tables(read(tmp_path / "ring"))
    assert site.ties.shape == (1, 2)
    assert check_against_source(saved(net, tmp_path), tmp_path / "ring", root="root").exact
    net.trafo.loc[net.trafo.name == "T2", "tap_pos"] = 1
    uneven = convert(saved(net, tmp_path), tmp_path / "uneven", root="root", meshed=True)
    assert len(stations(read(tmp_path / "uneven"))) == 1
    assert uneven.check is not None
    assert uneven.check.exact
    assert low in net.bus.index


def two_levels() -> dict[str, list[dict[str, Any]]]:
    """A 10 kV street with two stations, one of them given from its low side."""
    return {
        "node": [{"id": k, "u_rated": 10e3 if k < 4 else 400.0} for k in range(1, 9)],
        "line": [line(20, 1, 2), line(21, 2, 3), line(22, 4, 5), line(23, 6, 7), line(24, 7, 8)],
        "transformer": [
            transformer(10, 2, 4, (10e3, 400.0)) | {"tap_pos": 2, "tap_size": 250.0},
            transformer(11, 6, 3, (410.0, 10.2e3)) | {"clock": 1, "winding_from": 1, "winding_to": 2},
        ],
        "source": [{"id": 40, "node": 1, "status": 1, "u_ref": 1.01, "sk": 1e9}],
        "sym_load": [
            load(50, 3, 2e5, 3e4),
            load(51, 5, 5e4, 1e4),
            load(52, 7, 3e4, 1e4),
            load(53, 8, 2e4, 4e3),
        ],
    }


def test_power_grid_models_transformers(tmp_path: Path) -> None:
    done = convert(written(tmp_path, two_levels()), tmp_path / "x", root="1")
    assert done.check is not None
    assert (done.check.buses, done.check.three_phase) == (8, False)
    assert done.check.largest_pu < 1e-8
    tables = read(tmp_path / "x")
    assert stations(tables) == pytest.approx({"transformer 10": 400 / 3**0.5, "transformer 11": 400 / 3**0.5})
    turned = next(row for row in tables.lines if row.line == "transformer 11")
    assert (turned.from_bus, turned.to_bus) == ("3", "6")
    # By hand: uk and pk of 400 kVA at 410 V; the ratio of its rated by the nominal voltages.
    size, r = 0.04 * 410.0**2 / 4e5, 4e3 * 410.0**2 / 4e5**2
    np.testing.assert_allclose(abs(complex(turned.r_ohm, turned.x_ohm)), size, rtol=1e-3)
    np.testing.assert_allclose([turned.r_ohm, turned.tap], [r, 10.2 / 10.0 * 400.0 / 410.0], rtol=1e-3)


def test_three_phases_take_those_that_pass_every_sequence(tmp_path: Path) -> None:
    tables = two_levels()
    star = {"winding_from": 1, "winding_to": 1, "clock": 0}
    tables["transformer"][0] |= star
    tables["asym_load"] = [load(54, 5, [9e3, 4e3, 1e3], [2e3, 1e3, 0.0])]
    done = convert(written(tmp_path, tables), tmp_path / "x", root="1")
    assert done.check is not None
    assert done.check.three_phase
    assert done.check.largest_pu < UNBALANCED_PU
    made = read(tmp_path / "x")
    assert list(stations(made)) == ["transformer 10"]
    assert any("load side of transformer 11; 3 buses became a customer" in note for note in done.notes)
    assert np.isfinite(from_tables(made).base_volt).all()


OPENDSS = """clear
new circuit.town basekv=20 pu=1.02 mvasc3=500 mvasc1=500 bus1=grid
new line.m1 bus1=grid bus2=mid r1=0.4 x1=0.3 r0=1.2 x0=0.9 c1=0 c0=0
new line.m2 bus1=mid bus2=far r1=0.4 x1=0.3 r0=1.2 x0=0.9 c1=0 c0=0
new transformer.star windings=2 buses=(mid,low) conns=(wye,wye) kvs=(20,0.4) kvas=(400,400) xhl=4 %r=0.6
~ %noloadloss=0.3 %imag=0.5 taps=(1.025,1)
new transformer.delta windings=2 buses=(far,other) conns=(delta,wye) kvs=(20,0.4) kvas=(250,250) xhl=4
new line.l1 bus1=low bus2=home r1=0.02 x1=0.01 r0=0.06 x0=0.03 c1=0 c0=0
new line.l2 bus1=other bus2=there r1=0.02 x1=0.01 r0=0.06 x0=0.03 c1=0 c0=0
new load.one bus1=home.1 phases=1 kv=0.231 kw=20 pf=0.95
new load.three bus1=home phases=3 kv=0.4 kw=40 pf=0.95
new load.other bus1=there phases=3 kv=0.4 kw=50 pf=0.95
new load.mill bus1=far phases=3 kv=20 kw=300 pf=0.95
set voltagebases=[20,0.4]
calcvoltagebases
solve
"""


def test_opendss_stars_with_grounded_neutrals(tmp_path: Path) -> None:
    path = tmp_path / "town.dss"
    path.write_text(OPENDSS)
    done = convert(str(path), tmp_path / "x", root="grid")
    assert done.check is not None
    assert done.check.three_phase
    assert done.check.largest_pu < UNBALANCED_PU
    made = read(tmp_path / "x")
    assert stations(made) == pytest.approx({"transformer.star": 400 / 3**0.5}, rel=1e-5)
    (star,) = (row for row in made.lines if row.to_volt is not None)
    assert star.tap == pytest.approx(1.025, rel=1e-4)
    assert any("load side of transformer delta; 2 buses became a customer" in note for note in done.notes)
    idle = [row for row in made.customers if "no-load" in row.customer]
    assert sum(row.load_kw for row in idle) == pytest.approx(1.2, rel=0.1)


def test_an_opendss_transformer_whose_first_winding_is_the_lower_one(tmp_path: Path) -> None:
    """The report and the rating are of the line in the file, which leads away from the busbar."""
    path = tmp_path / "town.dss"
    star = "windings=2 buses=(mid,low) conns=(wye,wye) kvs=(20,0.4)"
    assert star in OPENDSS
    found = []
    for text in (OPENDSS, OPENDSS.replace(star, "windings=2 buses=(low,mid) conns=(wye,wye) kvs=(0.4,20)")):
        path.write_text(text.replace("taps=(1.025,1)", ""))
        done = convert(str(path), tmp_path / f"x{len(found)}", root="grid")
        (row,) = (row for row in read(tmp_path / f"x{len(found)}").lines if row.to_volt is not None)
        found.append((row.from_bus, row.to_bus, row.rating_a))
        assert any("transformer star; a line to 230.94 V" in note for note in done.notes), done.notes
    assert found == [("mid", "low", pytest.approx(400 / 0.4 / 3**0.5))] * 2


def test_lines_between_voltages_are_refused(tmp_path: Path) -> None:
    net = village()
    end, home = (net.bus.index[net.bus.name == name][0] for name in ("end", "home"))
    pp.create_line(net, end, home, 1.0, "NAYY 4x150 SE", name="wrong")
    with refused(FeederInvalid, "inconsistent") as caught:
        convert(saved(net, tmp_path), tmp_path / "x", root="root")
    assert "line 'wrong' joins the buses 'end' of 11547 V and 'home' of 230.94 V" in str(caught.value)
