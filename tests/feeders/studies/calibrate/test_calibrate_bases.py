"""Calibration of feeders with taps and with closed loops: by AC power flow, as without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from feeders.format.tables import FeederTables
from feeders.model.site import from_tables
from feeders.model.three_phase import three_phase
from feeders.simulation.powerflow import PowerFlow
from feeders.simulation.recording import record
from feeders.simulation.scenario import START
from feeders.studies.calibrate.feeder import network, powers, series
from feeders.studies.calibrate.readings import Frames
from feeders.studies.calibrate.search import FileErrorKind, longer
from feeders.studies.calibrate.study import Calibrate, calibrate
from gridsec.attack import Attack, Bias
from gridsec.errors import FeederInvalid
from gridsec.planning.calibration import lengthened
from tests.codes import refused
from tests.feeders import villages
from tests.feeders.studies.calibrate.calibrate_cases import (
    moved,
    scenario,
    shortened,
    swapped,
    three_phase_readings,
)

Change = Callable[[FeederTables], FeederTables]


def plain() -> FeederTables:
    """The village without generation, every customer metered, on longer lines."""
    tables = villages.village_without_inverters().tables
    rows = (replace(row, meter=f"m-{row.customer}", pv_kw=0.0) for row in tables.customers)
    return replace(
        tables,
        lines=tuple(longer(line, 2.0) for line in tables.lines),
        customers=tuple(row for row in rows if row.customer != "c7"),
    )


def tapped(tables: FeederTables) -> FeederTables:
    """A regulator in each branch; the second is in a line that is given from its far end."""
    taps = {"l2": 0.95, "l4": 1.04}
    return replace(tables, lines=tuple(replace(row, tap=taps.get(row.line, 1.0)) for row in tables.lines))


def ringed(tables: FeederTables) -> FeederTables:
    """The ends of both branches joined."""
    lines = tuple(replace(row, closed=True) for row in tables.lines)
    return replace(tables, meta=replace(tables.meta, meshed=True), lines=lines)


def headed(tables: FeederTables) -> FeederTables:
    """The ring behind a tap."""
    ring = ringed(tables)
    lines = tuple(replace(row, tap=0.96) if row.line == "l1" else row for row in ring.lines)
    return replace(ring, lines=lines)


def stepped(tables: FeederTables) -> FeederTables:
    """The first line is a transformer from 6.35 kV, 2 % above its nominal ratio; so is the village."""
    lines = tuple(replace(row, to_volt=230.0, tap=0.98) if row.line == "l1" else row for row in tables.lines)
    return replace(tables, meta=replace(tables.meta, voltage_volt=6350.0), lines=lines)


def found_in(
    folder: Path, truth: FeederTables, files: FeederTables, seed: int, lies: tuple[Attack, ...] = ()
) -> Calibrate:
    given = scenario(seed, ticks=192, attacks=lies)
    given = replace(given, errors=replace(given.errors, bias=0.0)) if lies else given
    return calibrate(from_tables(files), record(from_tables(truth), given, folder / "readings.parquet"))


@pytest.mark.canary("tapped")
@pytest.mark.parametrize("make", [tapped, headed])
def test_planted_errors_are_found_and_nothing_else(make: Change, tmp_path: Path) -> None:
    """Two meters are exchanged and a customer is elsewhere, both across a tap; a line is longer."""
    truth = make(plain())
    wrong = moved(swapped(truth, "c2", "c5"), "c1", "n5")
    found = found_in(tmp_path, truth, shortened(wrong, "l3", 1.5), 1)
    rows = found.proposals.set_index("kind")
    assert sorted(rows.index) == ["bus", "length", "swap"]
    assert rows.loc["bus", ["what", "now", "proposed"]].tolist() == ["c1", "n5", "n1"]
    assert rows.loc["swap", "what"] == "c2 and c5"
    assert rows.loc["length", "what"] == "l3"
    assert rows.loc["length", "low"] < 1.5 < rows.loc["length", "high"]
    assert len(found.lines) == 5 + (make is not tapped)
    assert found.meters["bias_percent"].abs().max() < 1.5


@pytest.mark.canary("tapped")
@pytest.mark.parametrize("make", [tapped, headed, stepped])
def test_biases_are_found_and_files_that_are_right_are_left(make: Change, tmp_path: Path) -> None:
    truth = make(plain())
    half = tuple(Bias(np.array([k]), START, np.inf, np.array([b])) for k, b in ((2, 0.005), (4, -0.005)))
    found = found_in(tmp_path, truth, truth, 1, half)
    assert found.proposals.empty
    rows = found.meters.set_index("customer")
    volt = dict(zip(from_tables(truth).feeder.customers, from_tables(truth).customer_volt, strict=True))
    for customer, of_nominal in (("c3", 0.5), ("c5", -0.5)):
        bias = of_nominal * 230.0 / volt[customer]
        assert rows.loc[customer, "verdict"] == "biased"
        assert abs(rows.loc[customer, "bias_percent"] - bias) < 3.0 * rows.loc[customer, "std_percent"]
    assert (rows.drop(["c3", "c5"])["verdict"] == "within error").all()


def readings(tables: FeederTables) -> Frames:
    """Two moments of the village by AC power flow, told exactly."""
    site, draws = from_tables(tables), np.random.default_rng(0).uniform(0.0, 12.0, (2, 2, 7))
    v = np.array([PowerFlow(site).solve(p, q, 231.0)[0] for p, q in zip(*draws, strict=True)])
    v0, ones = np.full(2, 231.0), np.ones((2, 8))
    return Frames(site.meter_ids, np.arange(2.0), v, *draws, v0, np.tile(v0[:, None], 3), ones, 1.0)


@pytest.mark.parametrize("make", [tapped, ringed, headed])
def test_what_longer_lines_do_is_what_the_power_flow_says(make: Change) -> None:
    tables = make(plain())
    given, net = readings(tables), network(tables)
    drawn = powers(net.site, given)
    told = series(net, given, drawn, ())
    assert np.abs(told.residual(net.places)).max() < 2e-5
    columns = lengthened(net.places, told)
    size = np.abs(columns).max()
    for k, (row,) in enumerate(net.lines):
        line = tables.lines[row]
        assert {net.site.bus_of_file[line.from_bus], net.site.bus_of_file[line.to_bus]} == set(
            net.ends[k].tolist()
        )
        lines = tuple(longer(each, 1.01) if each is line else each for each in tables.lines)
        after = readings(replace(tables, lines=lines)).v_volt
        change = (after**2 - given.v_volt**2) / net.places.unit**2
        np.testing.assert_allclose(0.01 * columns[:, :, k], change, atol=0.0012 * size)


@pytest.mark.parametrize("make", [tapped, ringed])
def test_a_move_is_what_the_power_flow_says(make: Change) -> None:
    """In the unit of the place in the files, whatever the base of the true one."""
    tables = make(plain())
    given, net = readings(tables), network(tables)
    told = series(net, given, powers(net.site, given), ())
    for customer, bus in (("c1", "n6"), ("c8", "n2"), ("c3", "n1")):
        number = net.site.feeder.customers.index(customer)
        weight = net.weight(net.site.bus_of_file[bus], "abc")
        after = readings(moved(tables, customer, bus)).v_volt
        change = (after**2 - given.v_volt**2) / net.places.unit**2
        found = net.places.moved(told, {number: weight})
        np.testing.assert_allclose(found, change, atol=0.12 * np.abs(found).max())


def test_a_tap_of_each_phase_and_no_loops_in_three() -> None:
    tables = plain()
    plainly = tuple(replace(line, r0_ohm=3 * line.r_ohm, x0_ohm=4 * line.x_ohm) for line in tables.lines)
    rows = tuple(
        replace(row, phases=phases) for row, phases in zip(tables.customers, ("abc", *"abcabc"), strict=True)
    )
    own = {"tap_a": 0.95, "tap_b": 1.0, "tap_c": 1.03}
    lines = tuple(replace(line, **own) if line.line == "l2" else line for line in plainly)
    truth = replace(tables, lines=lines, customers=rows)
    read = three_phase_readings(three_phase(truth), 1, 192, 900.0, hidden_kw=0.2)
    found = calibrate(
        three_phase(moved(truth, "c3", "n6")), read, kinds=(FileErrorKind.BUS, FileErrorKind.PHASE)
    )
    rows_found = found.proposals[["kind", "what", "proposed"]].to_numpy().tolist()
    assert rows_found == [["bus", "c3", "n3"]]
    assert found.meters["bias_percent"].abs().max() < 1.5
    closed = ringed(replace(tables, lines=plainly, customers=rows))
    with refused(FeederInvalid, "not-radial"):
        network(closed)
