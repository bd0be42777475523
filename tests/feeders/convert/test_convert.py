"""Conversion: against pandapower's own admittances and power flow, and nothing dropped in silence."""

from __future__ import annotations

import csv
import datetime
import gzip
import io
import random
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest
from pandapower import networks
from pandapower.toolbox import drop_trafos, select_subnet

from feeders.convert.convert import RECIPES, SEED, convert
from feeders.convert.customers import Fleet
from feeders.convert.from_pandapower import read_pandapower
from feeders.convert.from_simbench import envelope, envelopes_csv, library_csv
from feeders.convert.network import feeder_of
from feeders.convert.provenance import SourceUnreadable, origin, sentences
from feeders.format.tables import read, validate
from feeders.model.site import from_tables, load, names
from feeders.profiles import Season, data_root, envelopes
from gridsec.errors import FeederInvalid, GridsecError
from gridsec.grid.phased import PhasedFeeder
from tests.codes import refused

FROM_PANDAPOWER = [name for name, recipe in RECIPES.items() if recipe.source.startswith("pandapower:")]
BALANCED = [name for name in FROM_PANDAPOWER if name in names()]
FROM_SIMBENCH = [name for name, recipe in RECIPES.items() if recipe.source.startswith("simbench:")]


def below_busbar(net: Any, root: int) -> Any:
    """The part below a bus, fed there by an ideal source; built by pandapower's own tools."""
    drop_trafos(net, net.trafo.index)
    net.ext_grid = net.ext_grid.iloc[0:0]
    pp.create_ext_grid(net, root, vm_pu=1.0)
    reached = sorted(pp.topology.connected_component(pp.topology.create_nxgraph(net), root))
    return select_subnet(net, reached)


def original(name: str) -> tuple[Any, int]:
    maker = RECIPES[name].source.removeprefix("pandapower:")
    random.seed(SEED)
    net = getattr(networks, maker)()
    wanted = RECIPES[name].root
    if wanted is not None:
        root = int(net.bus.index[net.bus.name == wanted][0])
    else:
        root = int(net.trafo.lv_bus.iloc[0]) if len(net.trafo) else int(net.ext_grid.bus.iloc[0])
    return below_busbar(net, root), root


# --- the project's own feeders ------------------------------------------------------------------


@pytest.mark.canary("kerber-landnetz")
@pytest.mark.parametrize("name", FROM_PANDAPOWER)
def test_recipe_builds_the_committed_folder(name: str, tmp_path: Path) -> None:
    done = convert(name, tmp_path / "out")
    committed = Path(str(data_root())) / "feeders" / name
    for file in ("feeder.toml", "lines.csv", "customers.csv", "conversion.csv", "SOURCE.md"):
        assert (tmp_path / "out" / file).read_text() == (committed / file).read_text(), file
    source = (committed / "SOURCE.md").read_text()
    assert all(note in " ".join(source.split()) for note in done.notes)
    assert f"gridsec feeders convert {name} data/feeders/{name}" in source
    assert done.check is not None
    assert done.check.exact


@pytest.mark.canary("simbench-lv-rural3")
@pytest.mark.usefixtures("simbench_tables")
@pytest.mark.parametrize("name", FROM_SIMBENCH)
def test_recipe_builds_the_committed_simbench_folder(name: str, tmp_path: Path) -> None:
    done = convert(name, tmp_path / "out")
    assert done.check is not None
    assert done.check.largest_pu < 1e-8
    committed = Path(str(data_root())) / "feeders" / name
    for file in ("feeder.toml", "lines.csv", "customers.csv", "conversion.csv"):
        assert (tmp_path / "out" / file).read_text() == (committed / file).read_text(), file


@pytest.mark.canary("cigre-lv")
@pytest.mark.parametrize("name", BALANCED)
def test_impedances_are_pandapowers_own(name: str) -> None:
    """Z between customers from the inverse of pandapower's admittance matrix, without cable charging."""
    net, root = original(name)
    net.line["c_nf_per_km"] = 0.0
    pp.runpp(net, numba=False)
    lookup = net._pd2ppc_lookups["bus"]
    Y = net._ppc["internal"]["Ybus"].toarray()
    slack = int(lookup[root])
    keep = np.delete(np.arange(Y.shape[0]), slack)
    Z = np.zeros(Y.shape, dtype=complex)
    Z[np.ix_(keep, keep)] = np.linalg.inv(Y[np.ix_(keep, keep)])
    at = lookup[net.load.bus.to_numpy()]
    site = load(name)
    ids = [str(n) if n is not None else f"load-{i}" for i, n in net.load.name.items()]
    order = [site.feeder.customers.index(customer) for customer in ids]
    model = site.feeder.linear()
    scale = site.feeder.base_kva / 1000.0 / net.sn_mva  # from pandapower's base power to the feeder's
    np.testing.assert_allclose(
        model.R[np.ix_(order, order)], Z.real[np.ix_(at, at)] * scale, rtol=1e-7, atol=1e-12
    )
    np.testing.assert_allclose(
        model.X[np.ix_(order, order)], Z.imag[np.ix_(at, at)] * scale, rtol=1e-7, atol=1e-12
    )


@pytest.mark.canary("cigre-lv")
@pytest.mark.parametrize("name", BALANCED)
def test_ids_loads_and_charging_are_kept(name: str) -> None:
    net, root = original(name)
    tables = read(Path(str(data_root())) / "feeders" / name)
    assert tables.meta.voltage_volt == pytest.approx(net.bus.vn_kv[root] * 1000 / np.sqrt(3), rel=1e-8)
    buses = {str(bus) for bus in net.bus.name}
    assert {row.bus for row in tables.customers} <= buses
    assert {line.to_bus for line in tables.lines} | {tables.meta.busbar} == buses
    assert sorted(row.load_kw for row in tables.customers) == pytest.approx(sorted(net.load.p_mw * 1000))
    susceptance = 2e-3 * np.pi * net.f_hz * (net.line.c_nf_per_km * net.line.length_km).sum()
    assert sum(line.b_us for line in tables.lines) == pytest.approx(susceptance, rel=1e-7)


def test_open_ties_are_kept_open() -> None:
    lines = read(Path(str(data_root())) / "feeders" / "case33bw").lines
    assert sum(not line.closed for line in lines) == 5
    assert len(lines) == 37


# --- anything else ------------------------------------------------------------------------------


def street() -> Any:
    """A net with one of everything that can go wrong."""
    net = pp.create_empty_network(f_hz=50.0)
    mv = pp.create_bus(net, 20.0, name="MV")
    bus = [
        pp.create_bus(net, 0.4, name=name) for name in ("busbar", "A", "A", "", "far", "dead", "other side")
    ]
    pp.create_ext_grid(net, mv)
    pp.create_transformer(net, mv, bus[0], "0.25 MVA 20/0.4 kV")
    cable = {"r_ohm_per_km": 0.2, "x_ohm_per_km": 0.08, "c_nf_per_km": 500.0, "max_i_ka": 0.2}
    for name, a, b, extra in [
        ("one", 1, 0, {"parallel": 2}),
        ("two", 1, 2, {}),
        ("two", 3, 4, {}),
        (None, 4, 5, {}),
        ("across", 4, 6, {}),
    ]:
        pp.create_line_from_parameters(net, bus[a], bus[b], 0.1, name=name, **cable, **extra)
    pp.create_switch(net, bus[2], bus[3], "b", name="coupler")
    pp.create_switch(net, bus[0], bus[4], "b", closed=False, name="two")
    pp.create_switch(net, bus[4], 4, "l", closed=False)
    net.bus.loc[bus[5], "in_service"] = False
    pp.create_load(net, bus[1], 0.004, 0.003, name="house")
    pp.create_load(net, bus[1], 0.002, -0.001, name="house", scaling=0.5)
    pp.create_load(net, bus[2], -0.001, name="seller")
    pp.create_load(net, bus[6], 0.1, name="beyond")
    pp.create_sgen(net, bus[1], 0.006, sn_mva=0.007, name="roof")
    pp.create_sgen(net, bus[4], 0.003, q_mvar=0.001, name="field")
    pp.create_shunt(net, bus[2], 0.01, name="coil")
    pp.create_shunt(net, bus[2], -0.012, p_mw=0.001, name="condenser")
    pp.create_impedance(net, bus[2], bus[4], 0.01, 0.01, 1.0, 0.02, name="choke")
    pp.create_gen(net, bus[4], 0.01)
    pp.create_storage(net, bus[1], 0.001, 0.01)
    return net


def test_everything_is_carried_over_or_named() -> None:
    converted = feeder_of(read_pandapower(street()), "street", title="A street")
    tables, notes = converted.tables, sentences(converted.changes)
    assert validate(tables) == ()
    lines = {line.line: line for line in tables.lines}
    assert set(lines) == {"one", "two", "two-1", "two-2", "coupler", "shunt condenser"}
    assert lines["one"].r_ohm == pytest.approx(0.01)
    assert lines["one"].b_us == pytest.approx(2 * 2 * np.pi * 50 * 500e-9 * 0.1 * 1e6)
    assert lines["one"].rating_a == pytest.approx(400.0)
    assert (lines["one"].from_bus, lines["one"].to_bus) == ("busbar", "A-2")
    assert (lines["coupler"].r_ohm, lines["coupler"].x_ohm, lines["coupler"].closed) == (0.0, 0.0, True)
    assert sum(not line.closed for line in tables.lines) == 1  # the tie between busbar and far
    customers = {row.customer: row for row in tables.customers}
    assert set(customers) == {"house-0", "house-1", "seller", "field", "gen gen-0", "storage storage-0"}
    assert lines["shunt condenser"].b_us == pytest.approx(1e6 * 0.012 / 0.4**2)
    assert customers["house-0"].power_factor == pytest.approx(0.8)
    assert customers["house-0"].bus == customers["house-1"].bus == "A-2"
    assert (customers["house-0"].pv_kw, customers["house-0"].inverter_kva) == (6.0, 7.0)
    assert customers["house-0"].droop == "vde4105"
    assert customers["house-1"].load_kw == pytest.approx(1.0)
    assert (customers["field"].load_kw, customers["field"].pv_kw) == (0.0, 3.0)
    assert customers["field"].droop == "vde4105-small"
    assert len({row.meter for row in tables.customers}) == 6
    said = "\n".join(notes)
    for part in (
        "power factor of load house-1; leading",
        "p_mw of load seller; feeds in",
        "customer of generator field; has no load at its bus",
        "q_mvar of generator field; its droop curve decides",
        "inductance of shunt coil; 10 kvar",
        "connection of shunt condenser; 12 kvar",
        "conductance of shunt condenser; 1 kW",
        "left out: impedance choke",
        "control of gen gen-0; a customer that feeds in 10 kW",
        "control of storage storage-0; a customer that draws 1 kW",
        "line across; open, towards buses that the busbar does not feed",
        "left out: 3 buses; above the busbar, behind a transformer or without supply",
    ):
        assert part in said, part
    from_tables(tables)


def test_power_factor_interval_holds_the_profiles_history() -> None:
    tables = feeder_of(read_pandapower(street()), "street").tables
    for row in tables.customers:
        if row.load_kw == 0.0 or row.power_factor is None or row.q_floor_kvar is None:
            continue
        assert row.power_factor_min is not None
        assert row.power_factor_max is not None
        assert row.q_floor_kvar is not None
        history = envelopes()[row.load_profile]
        tan = np.tan(np.arccos(row.power_factor))
        assert np.tan(np.arccos(row.power_factor_min)) >= history.high * tan * (1 - 1e-12)
        assert np.tan(np.arccos(row.power_factor_max)) <= history.low * tan * (1 + 1e-12)
        assert row.q_floor_kvar >= history.floor * tan * row.load_kw


@pytest.mark.acceptance
def test_single_phase_loads_become_single_phase_customers() -> None:
    net = networks.ieee_european_lv_asymmetric("on_peak_566")
    converted = feeder_of(read_pandapower(net), "european")
    tables, notes = converted.tables, sentences(converted.changes)
    assert validate(tables) == ()
    loads = net.asymmetric_load
    for phase in "abc":
        drawn = loads[f"p_{phase}_mw"][loads[f"p_{phase}_mw"] > 0] * 1000
        assert sorted(row.load_kw for row in tables.customers if row.phases == phase) == pytest.approx(
            sorted(drawn)
        )
    assert len(tables.customers) == 55
    assert all(line.r0_ohm is not None and line.x0_ohm is not None for line in tables.lines)
    assert not any("asymmetric_load" in note for note in notes)
    assert isinstance(from_tables(tables).feeder, PhasedFeeder)


def test_synthetic_fleet() -> None:
    net = networks.create_kerber_landnetz_freileitung_1()
    converted = feeder_of(read_pandapower(net), "fleet", fleet=Fleet(3, 0.0, "asnzs4777-a"))
    tables, added = converted.tables, [each for each in converted.changes if each.done == "added"]
    with_inverter = [k for k, row in enumerate(tables.customers) if row.inverter_kva > 0]
    assert with_inverter == list(range(0, 13, 3))
    assert {row.inverter_kva for row in tables.customers} == {0.0, 4.0}
    assert len(added) == 5
    assert all("asnzs4777-a" in each.effect for each in added)


def test_ambiguous_and_unknown_busbars() -> None:
    net = networks.create_cigre_network_lv()
    with refused(GridsecError, "busbar-unclear") as caught:
        feeder_of(read_pandapower(net), "x")
    assert "Bus R1, Bus I1, Bus C1" in str(caught.value)
    with refused(GridsecError, "unknown-name"):
        feeder_of(read_pandapower(net), "x", root="Bus X")
    commercial = feeder_of(read_pandapower(net), "x", root="Bus C1").tables
    assert all(row.customer.startswith("Load C") for row in commercial.customers)
    by_index = feeder_of(read_pandapower(net), "x", root=str(net.bus.index[net.bus.name == "Bus C1"][0]))
    assert by_index.tables == commercial


def test_loop_in_the_source_is_refused(tmp_path: Path) -> None:
    net = networks.case33bw()
    net.line.loc[36, "in_service"] = True
    path = tmp_path / "looped.json"
    pp.to_json(net, str(path))
    with refused(FeederInvalid, "not-radial"):
        convert(str(path), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_pandapower_file(tmp_path: Path) -> None:
    path = tmp_path / "street.json"
    pp.to_json(street(), str(path))
    notes = convert(str(path), tmp_path / "my street", droop="ieee1547-a").notes
    site = load(tmp_path / "my street")
    assert site.feeder.name == "my-street"
    assert {row.droop for row in site.tables.customers} == {"", "ieee1547-a"}
    source = (tmp_path / "my street" / "SOURCE.md").read_text()
    assert all(note in " ".join(source.split()) for note in notes)


def test_any_pandapower_network_by_name(tmp_path: Path) -> None:
    convert("pandapower:kerber_landnetz_kabel_1", tmp_path / "cable", name="cable")
    assert load(tmp_path / "cable").feeder.name == "cable"


@pytest.mark.acceptance
@pytest.mark.usefixtures("simbench_tables")
def test_simbench_code_alone_medium_voltage(tmp_path: Path) -> None:
    done = convert("1-MV-comm--0-sw", tmp_path / "mv")
    assert done.check is not None
    assert done.check.buses == 105
    assert done.check.largest_pu < 1e-6


def test_a_folder_written_again_keeps_what_it_tells_of_its_source(tmp_path: Path) -> None:
    convert("pandapower:case33bw", tmp_path / "a", name="first")
    before = origin(tmp_path / "a")
    assert before is not None
    out = tmp_path / "with space"
    done = convert(str(tmp_path / "a"), out, name="second")
    after = origin(out)
    assert after is not None
    assert len(before.changes)
    assert after.changes.to_csv() == before.changes.to_csv()
    assert (after.source, after.about) == (before.source, before.about)
    assert after.check == f"Before the folder was written again: {before.check}"
    assert "nothing" not in (out / "SOURCE.md").read_text(encoding="utf-8").partition("## Checked")[0]
    assert after.command.split("`, then `")[0] == before.command
    again = ["gridsec", "feeders", "convert", str(tmp_path / "a"), str(out), "--name", "second"]
    assert shlex.split(after.command.split("`, then `")[1]) == again
    assert load(out).feeder.name == "second"
    assert done.check is None


def test_a_line_of_a_folder_is_opened_and_what_a_folder_cannot_take_is_refused(tmp_path: Path) -> None:
    net = networks.case33bw()
    net.line.loc[36, "in_service"] = True
    pp.to_json(net, str(tmp_path / "looped.json"))
    before = convert(str(tmp_path / "looped.json"), tmp_path / "a", meshed=True)
    done = convert(str(tmp_path / "a"), tmp_path / "b", opened=["line-36"])
    assert done.changes[:-1] == before.changes
    assert (done.changes[-1].element, done.changes[-1].prop) == ("line line-36", "closed")
    opened = {row.line: row.closed for row in read(tmp_path / "b").lines}
    assert opened == {row.line: row.closed and row.line != "line-36" for row in read(tmp_path / "a").lines}
    wrong = {"root": "s", "droop": "vde4105", "one_voltage": True, "opened": ["nosuch"]}
    with refused(FeederInvalid, *["inconsistent"] * 3, "unknown-name") as caught:
        convert(str(tmp_path / "a"), tmp_path / "c", **wrong)  # type: ignore[arg-type]
    assert [problem.split(" is ")[0] for problem in caught.value.problems] == [
        "root",
        "droop",
        "one_voltage",
        "line 'nosuch' to open does not exist",
    ]
    assert not (tmp_path / "c").exists()


def test_unknown_sources(tmp_path: Path) -> None:
    (tmp_path / "text.json").write_text("no json")
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "other.json").write_text('{"type": "FeatureCollection"}')
    for source, code in [
        ("pandapower:no_such_network", "unknown-name"),
        ("nonsense", "unknown-name"),
        (str(tmp_path / "text.json"), "unreadable"),
        (str(tmp_path / "list.json"), "unreadable"),
        (str(tmp_path / "other.json"), "unreadable"),
        ("1-LV-rural9--0-sw", "unknown-name"),
        ("pandapower:create_bus", "unreadable"),
    ]:
        with refused(SourceUnreadable, code):
            convert(source, tmp_path / "out")


def test_without_the_extra_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "simbench", None)
    for source in ("simbench-lv-rural1", "profiles"):
        with refused(GridsecError, "not-installed") as caught:
            convert(source, tmp_path / "out")
        assert "pip install -e '.[convert]'" in str(caught.value)
    monkeypatch.setitem(sys.modules, "pandapower", None)
    with refused(GridsecError, "not-installed"):
        convert("kerber-landnetz", tmp_path / "out")


# --- envelopes ----------------------------------------------------------------------------------


def test_envelope_is_the_smallest_wedge() -> None:
    """Brute force over slopes: no other wedge that holds all points is narrower at the stated load."""
    rng = np.random.default_rng(5)
    p = rng.uniform(0, 1, 400) ** 2
    q = p * rng.uniform(0.5, 1.6, 400) + rng.uniform(-0.1, 0.1, 400)
    found = envelope(p, q)
    assert (found.low * p - found.floor <= q).all()
    assert (q <= found.high * p + found.floor).all()
    weight = max(p.mean(), 0.3)
    best = np.inf
    for low in np.linspace(0, 1, 101):
        for high in np.linspace(1, 3, 201):
            floor = max((low * p - q).max(), (q - high * p).max(), 0.0)
            best = min(best, (high - low) * weight + 2 * floor)
    width = (found.high - found.low) * weight + 2 * found.floor
    assert best - 0.02 <= width <= best + 6e-3  # rounded outwards to three digits, on a grid of 0.01


def test_envelope_of_a_straight_profile() -> None:
    p = np.linspace(0, 1, 50)
    found = envelope(p, p)
    assert (found.low, found.high) == (1.0, 1.0)
    assert found.floor <= 2e-3


# --- the profile library ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("season", "monday", "days", "summer_time"),
    [
        (Season.WINTER, datetime.date(2016, 1, 11), 7, False),
        (Season.SPRING, datetime.date(2016, 4, 18), 7, True),
        (Season.SUMMER, datetime.date(2016, 6, 6), 14, True),
        (Season.AUTUMN, datetime.date(2016, 10, 17), 7, True),
    ],
)
def test_library_is_the_right_days(
    season: Season, monday: datetime.date, days: int, summer_time: bool
) -> None:
    """A year that counts its own quarters: the slice starts at the Monday's midnight."""
    clock = np.arange(366 * 96) / 1e5
    columns = {"H0-A_pload": clock, "H0-A_qload": clock / 2, "PV1": clock / 4}
    text = gzip.decompress(library_csv(columns, season)).decode("ascii")
    header, *rows = csv.reader(io.StringIO(text))
    assert header == ["t_s", "H0-A_p", "H0-A_q", "PV1"]
    table = np.array(rows, dtype=float)
    np.testing.assert_array_equal(table[:, 0], np.arange(days * 96) * 900.0)
    # 1 January 2016 was a Friday; one hour is missing from the end of March to the end of October.
    first = ((monday - datetime.date(2016, 1, 1)).days * 24 - summer_time) * 4
    assert monday.weekday() == 0
    np.testing.assert_allclose(table[:, 1], clock[first : first + days * 96], rtol=5e-4)
    np.testing.assert_allclose(table[:, 3], clock[first : first + days * 96] / 4, rtol=5e-4)
    assert library_csv(columns, season) == library_csv(columns, season)
    assert envelopes_csv({**columns, "H0-A_qload": clock}).splitlines()[1].startswith("H0-A,1.0,1.0,")


def test_profiles_build_the_committed_library(tmp_path: Path) -> None:
    pytest.importorskip("simbench", reason="the extra `convert` is not installed")
    convert("profiles", tmp_path)
    committed = Path(str(data_root())) / "profiles"
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in committed.iterdir()}
    for path in committed.iterdir():
        made = (tmp_path / path.name).read_bytes()
        if path.suffix == ".gz":  # compressed bytes depend on the version of zlib
            assert gzip.decompress(made) == gzip.decompress(path.read_bytes())
        else:
            assert made == path.read_bytes(), path.name


def test_other_infeeds_and_deeper_transformers_are_named() -> None:
    net = street()
    net.ext_grid.loc[0, "bus"] = 1
    pp.create_ext_grid(net, 2)
    below = pp.create_bus(net, 0.23, name="below")
    pp.create_transformer_from_parameters(net, 2, below, 0.05, 0.4, 0.23, 1.0, 4.0, 0.1, 0.5)
    with refused(FeederInvalid, "several-sources"):
        feeder_of(read_pandapower(net), "x", root="busbar")
    net.ext_grid.loc[1, "in_service"] = False
    said = "\n".join(sentences(feeder_of(read_pandapower(net), "x", root="busbar").changes))
    assert "load side of transformer trafo-1; 1 bus became a customer" in said
