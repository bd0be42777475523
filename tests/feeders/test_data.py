"""The feeders and profiles that come with the project: complete, lawful, and what the theory assumes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandapower as pp
import pytest

from feeders import profiles
from feeders.convert.convert import RECIPES
from feeders.format.tables import examine, read
from feeders.model.site import Site, Snapshot, load, names, to_frame
from feeders.model.three_phase import three_phase_names
from feeders.profiles import Season
from gridsec.observers.certificates import certify, reactance, small_gain, verify
from gridsec.observers.lure import close_loop
from tests.gridsec.radial import squared_voltages

DATA = Path(str(profiles.data_root()))
CUSTOMERS = {
    "case33bw": 32,
    "cigre-lv": 6,
    "kerber-dorfnetz": 57,
    "kerber-landnetz": 13,
    "kerber-vorstadtnetz": 146,
    "simbench-lv-rural1": 13,
    "simbench-lv-rural3": 118,
}
LOW_VOLTAGE = [name for name in CUSTOMERS if name != "case33bw"]
every_feeder = pytest.mark.parametrize("name", CUSTOMERS)


def test_all_are_there() -> None:
    assert names() == sorted(CUSTOMERS)
    assert names(balanced=False) == sorted(RECIPES)
    assert three_phase_names() == ["ieee-european-lv"]
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 600_000


@pytest.mark.parametrize("name", RECIPES)
def test_files_are_valid_and_say_where_they_are_from(name: str) -> None:
    folder = DATA / "feeders" / name
    outcome = examine(folder)
    assert outcome.problems == ()
    assert not [note for note in outcome.notes if "ignored" in note or "accepted" in note]
    source = (folder / "SOURCE.md").read_text(encoding="utf-8")
    assert f"`gridsec feeders convert {name} data/feeders/{name}`" in source
    assert re.search(r"Source: `(pandapower|simbench):[\w-]+`, (pandapower|simbench) \d+\.\d+", source)
    licence = "Open Database License" if name.startswith("simbench") else "3-clause BSD license"
    assert licence in source
    assert "Copyright (c)" in source


@every_feeder
def test_every_customer_is_watched(name: str) -> None:
    site = load(name)
    assert site.feeder.name == name
    assert len(site.feeder.customers) == CUSTOMERS[name]
    assert len(site.meter_ids) == CUSTOMERS[name]
    assert all(row.load_profile in profiles.load_names() for row in site.tables.customers if row.load_kw > 0)
    assert all(row.pv_profile in profiles.pv_names() for row in site.tables.customers if row.pv_kw > 0)
    assert site.droop.customer.size >= 0.3 * CUSTOMERS[name]
    meters, attacked = len(site.meters), site.tables.meta.monitor.max_attacked
    assert meters > 2 * attacked >= 2
    assert site.tables.meta.busbar == site.feeder.buses[0]


def test_source_generators_keep_their_rating() -> None:
    rows = {row.customer: row for row in read(DATA / "feeders" / "simbench-lv-rural1").customers}
    ratings = {f"LV1.101 Load {k}": kva for k, kva in [(9, 40.0), (11, 78.381), (2, 19.0), (4, 23.0)]}
    assert {row.customer: row.inverter_kva for row in rows.values() if row.inverter_kva > 10} == ratings
    assert {rows[customer].droop for customer in ratings} == {"vde4105"}


@every_feeder
def test_both_closed_form_certificates_hold(name: str) -> None:
    site = load(name)
    lure = close_loop(site.feeder, site.droop, site.meters)
    gain = float(np.max(np.abs(np.linalg.eigvals(lure.slope[:, None] * lure.H))))
    assert 0.005 < gain < 1.0
    assert site.droop.tau.max() <= 2.0 * site.droop.tau.min()
    for certificate in (certify(lure), reactance(lure), small_gain(lure)):
        assert certificate.margin > 0.0
        assert verify(certificate, lure) > 0.0
        assert certificate.rate > 0.1 / site.droop.tau.max()


# --- the model against AC power flow ------------------------------------------------------------


def ac_net(site: Site) -> Any:
    """The files' lines, in ohm, in pandapower, fed by an ideal source; no per unit of ours involved."""
    meta = site.tables.meta
    net = pp.create_empty_network(f_hz=50.0, sn_mva=0.1)
    closed = [line for line in site.tables.lines if line.closed]
    names = list(
        dict.fromkeys([meta.busbar, *(end for line in closed for end in (line.from_bus, line.to_bus))])
    )
    made = pp.create_buses(net, len(names), meta.voltage_volt * np.sqrt(3) / 1000.0)
    bus = dict(zip(names, made, strict=True))
    pp.create_lines_from_parameters(
        net,
        [bus[line.from_bus] for line in closed],
        [bus[line.to_bus] for line in closed],
        1.0,
        [line.r_ohm for line in closed],
        [line.x_ohm for line in closed],
        [line.b_us * 1e3 / (2 * np.pi * 50.0) for line in closed],
        1.0,
    )
    pp.create_ext_grid(net, bus[meta.busbar])
    pp.create_loads(net, [bus[row.bus] for row in site.tables.customers], 0.0)
    return net


@pytest.mark.canary("kerber-landnetz")
@every_feeder
def test_corrected_lindistflow_is_within_its_stated_error_of_ac(name: str) -> None:
    site = load(name)
    net = ac_net(site)
    model = site.feeder.linear()
    rng = np.random.default_rng(7)
    base, loads = site.feeder.base_kva, site.loads
    plain, corrected, stated = [], [], []
    for case in range(6):
        sun, v0 = (0.6, 1.03) if case % 2 else (0.0, 0.98)
        load_now = rng.uniform(0.0, 0.7, loads.load_peak.size) * loads.load_peak
        p = load_now - sun * loads.pv_peak  # import, pu
        q = load_now * rng.uniform(0.1, 0.5, load_now.size)
        net.load["p_mw"], net.load["q_mvar"] = p * base / 1000.0, q * base / 1000.0
        net.ext_grid["vm_pu"] = v0
        pp.runpp(net, tolerance_mva=1e-10, numba=False)
        truth = net.res_bus.vm_pu.to_numpy()[net.load.bus] ** 2
        linear = squared_voltages(model, -p, -q, v0**2)
        better = linear + site.feeder.loss_correction(-p, -q, v0**2)[site.feeder.bus]
        bound = site.feeder.model_error_bound(-p, -q, v0**2)
        assert (np.abs(better - truth) <= bound + 1e-9).all()
        plain.append(np.abs(linear - truth).max() / 2)
        corrected.append(np.abs(better - truth).max() / 2)
        stated.append(bound.max() / 2)
    assert max(plain) < 4e-3  # what a linear model may be off at these loads
    assert max(corrected) < 3e-4
    assert max(stated) < 1e-3  # the bound is of use: far below a meter's class
    assert max(corrected) < max(plain) / 5


# --- how much a frame leaves open ---------------------------------------------------------------


@pytest.mark.parametrize("name", LOW_VOLTAGE)
def test_unknown_powers_leave_room_to_see_a_lie(name: str) -> None:
    """Worst case over all customers at once, in per cent of voltage."""
    site = load(name)
    model, loads, base = site.feeder.linear(), site.loads, site.feeder.base_kva
    largest = 0.1 if name == "simbench-lv-rural1" else 0.6
    for share in (0.05, 0.2, 0.5):
        p_kw = (share * loads.load_peak - 0.5 * (share > 0.1) * loads.pv_peak)[site.meters] * base
        count = len(site.meter_ids)
        frame = to_frame(site, Snapshot(0.0, np.full(count, 230.0), p_kw, np.full(count, np.nan), 230.0))
        voltage = 100.0 * (model.R @ frame.p_error + model.X @ frame.q_error).max()
        assert voltage < largest


# --- profiles -----------------------------------------------------------------------------------


DAYS = {Season.WINTER: 7, Season.SPRING: 7, Season.SUMMER: 14, Season.AUTUMN: 7}
DARK = {Season.WINTER: (7, 16), Season.SPRING: (5, 20), Season.SUMMER: (3, 22.5), Season.AUTUMN: (6, 18.5)}
"""The sun of these weeks has not risen by the first hour, and has set by the second (Germany, local time)."""
BRIGHT = {Season.WINTER: 0.2, Season.SPRING: 0.4, Season.SUMMER: 0.4, Season.AUTUMN: 0.3}


@pytest.mark.parametrize("season", Season)
def test_library_is_days_of_quarters(season: Season) -> None:
    library = profiles.library(season)
    assert library.t_s.size == DAYS[season] * 96
    np.testing.assert_array_equal(np.diff(library.t_s), 900.0)
    assert len(library.load_p) == len(library.load_q) == 16
    assert list(library.load_p) == list(library.load_q) == list(profiles.load_names())
    assert len(profiles.pv_names()) == 8
    for p in library.load_p.values():
        assert 0.0 <= p.min() <= p.max() <= 1.0
        assert p.max() > 0.3
    assert (DATA / "profiles" / season.file).stat().st_size < 9_000 * DAYS[season]


@pytest.mark.parametrize("season", Season)
def test_generation_is_dark_at_night_and_bright_at_noon(season: Season) -> None:
    library = profiles.library(season)
    hour = library.t_s / 3600.0 % 24.0
    rises, sets = DARK[season]
    for pv in library.pv.values():
        assert pv[(hour < rises) | (hour > sets)].max() == 0.0
        assert BRIGHT[season] < pv[(hour > 10) & (hour < 16)].max() <= 1.0


def test_winter_has_more_load_and_less_sun_than_summer() -> None:
    winter, summer = profiles.library(Season.WINTER), profiles.library(Season.SUMMER)
    assert list(winter.load_p) == list(summer.load_p)
    assert list(winter.pv) == list(summer.pv)
    for name, drawn in winter.load_p.items():
        if name.startswith("H0"):
            assert drawn.mean() > summer.load_p[name].mean(), name
    for name, pv in winter.pv.items():
        assert pv.mean() < 0.5 * summer.pv[name].mean()


@pytest.mark.parametrize("season", Season)
def test_first_day_is_a_monday(season: Season) -> None:
    """Trade stands still on Sundays: days 6 and 13 when day 0 is a Monday."""
    trade = profiles.library(season).load_p["G1-A"].reshape(-1, 96).mean(axis=1)
    days = set(range(DAYS[season]))
    weekend = {day for day in days if day % 7 in {5, 6}}
    assert max(trade[day] for day in weekend) < min(trade[day] for day in days - weekend)


@pytest.mark.parametrize("season", Season)
def test_envelopes_hold_the_library(season: Season) -> None:
    library, envelopes = profiles.library(season), profiles.envelopes()
    assert set(envelopes) == set(library.load_p)
    for name, envelope in envelopes.items():
        p, q = library.load_p[name], library.load_q[name]
        assert (envelope.low * p - envelope.floor <= q).all(), name
        assert (q <= envelope.high * p + envelope.floor).all(), name


def test_frames_hold_the_libraries_reactive_power() -> None:
    """Every load at its profile, with the profile's own reactive power: inside the frame's interval."""
    library = profiles.library()
    for name in CUSTOMERS:
        site = load(name)
        rows = site.tables.customers
        peak = np.array([row.load_kw for row in rows])
        tan = np.tan(np.arccos([row.power_factor or 1.0 for row in rows]))
        for k in range(0, 14 * 96, 97):
            p = peak * [library.load_p[row.load_profile][k] if row.load_profile else 0.0 for row in rows]
            q = (
                peak
                * tan
                * [library.load_q[row.load_profile][k] if row.load_profile else 0.0 for row in rows]
            )
            sun = np.array([row.pv_kw * library.pv[row.pv_profile][k] if row.pv_kw else 0.0 for row in rows])
            count = len(rows)
            frame = to_frame(
                site, Snapshot(0.0, np.full(count, 230.0), p - sun, np.full(count, np.nan), 230.0)
            )
            assert (np.abs(-q / site.feeder.base_kva - frame.q) <= frame.q_error * (1 + 1e-9)).all(), name
