"""Laterals on another phase than their files say: told by asymmetric AC power flow, found, and corrected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from feeders.format.tables import CustomerRow, FeederMeta, FeederTables, LineRow, validate
from feeders.model.site import from_tables
from feeders.model.three_phase import series_of, three_phase
from feeders.simulation.plant import MeterErrors
from feeders.simulation.powerflow import UnbalancedPowerFlow
from feeders.simulation.recording import RecordingInvalid, record
from feeders.simulation.scenario import Scenario
from feeders.studies.calibrate.feeder import network, powers, series
from feeders.studies.calibrate.readings import Frames, frames
from feeders.studies.calibrate.search import Correction, FileErrorKind, apply, as_filed, left
from feeders.studies.calibrate.study import Calibrate, calibrate
from tests.codes import refused
from tests.feeders.studies.calibrate.calibrate_cases import three_phase_readings


def street() -> FeederTables:
    """A trunk of four buses with laterals: services of one customer, and a forked one of three."""
    trunk = [
        LineRow(f"t{k}", one, f"n{k}", 0.03, 0.012, r0_ohm=0.09, x0_ohm=0.04)
        for k, one in enumerate(("bb", "n1", "n2", "n3"), start=1)
    ]
    near = {"s1": "n1", "s2": "n2", "s3": "n3", "s4": "n4", "s5": "n4", "s6": "n1"}
    phases = dict(zip((*near, "u", "u1", "u2"), "baccbabbb", strict=True))
    ends = [*near.items(), ("u", "n2"), ("u1", "u"), ("u2", "u")]
    single = [LineRow(f"l-{bus}", at, bus, 0.02, 0.003, phases=phases[bus]) for bus, at in ends]
    loads = (6.0, 4.0, 5.0, 7.0, 4.5, 5.5, 3.0, 4.0, 3.5)
    rows = [
        CustomerRow(f"c-{bus}", bus, load_kw=load, phases=phase, meter=f"m-{bus}")
        for (bus, phase), load in zip(phases.items(), loads, strict=True)
    ]
    meta = FeederMeta(format=1, name="street", voltage_volt=230.0, busbar="bb", base_kva=100.0)
    return FeederTables(meta, (*trunk, *single), tuple(rows))


def on(tables: FeederTables, lateral: Mapping[str, str]) -> FeederTables:
    """Files with buses and the lines to them on other phases."""
    lines = (replace(row, phases=lateral.get(row.to_bus, row.phases)) for row in tables.lines)
    rows = (replace(row, phases=lateral.get(row.bus, row.phases)) for row in tables.customers)
    return replace(tables, lines=tuple(lines), customers=tuple(rows))


@cache
def days() -> pd.DataFrame:
    """A day on the street."""
    return three_phase_readings(three_phase(street()), seed=3, ticks=96, dt_s=900.0, hidden_kw=0.1)


@cache
def apart() -> pd.DataFrame:
    """A day on the street whose busbar has phases 0.6 % above and below."""
    return three_phase_readings(
        three_phase(street()), seed=3, ticks=96, dt_s=900.0, hidden_kw=0.1, apart=0.006
    )


def without(readings: pd.DataFrame, phase: int, part: float = 1.0) -> pd.DataFrame:
    """Readings whose busbar has, in the first part of all of them, no voltage of one phase."""
    first = np.arange(len(readings)) < part * len(readings)
    cells = [
        row and [None if k == phase and gone else v for k, v in enumerate(row)]
        for row, gone in zip(readings["v_phases"], first, strict=True)
    ]
    return readings.assign(v_phases=cells)


def told(found: Calibrate) -> list[list[str]]:
    """The proposals in short."""
    return found.proposals[["kind", "what", "now", "proposed", "verdict"]].to_numpy().tolist()


def corrected(tables: FeederTables, found: Calibrate) -> FeederTables:
    """Files with all that is sure."""
    for wrong in found.corrections:
        tables = apply(tables, wrong)
    return tables


def test_nothing_is_said_of_right_phases() -> None:
    assert calibrate(three_phase(street()), days()).proposals.empty


def test_meters_on_a_phase_that_the_busbar_does_not_read_are_left_out_and_accused_of_nothing() -> None:
    tables = street()
    found = calibrate(three_phase(tables), without(apart(), 0))
    assert found.proposals.empty
    on_a = {row.meter for row in tables.customers if row.phases == "a"}
    verdicts = found.meters.set_index("meter")["verdict"]
    assert found.unread == "a"
    assert set(verdicts.index[verdicts == "phase not read"]) == on_a
    assert set(verdicts.drop(list(on_a))) <= {"within error", "biased"}
    places = found.customers.set_index("meter")["verdict"]
    assert set(places.loc[list(on_a)]) == {"cannot be told"}


def test_the_noise_of_the_busbars_phases_is_learned_as_that_of_three_meters(tmp_path: Path) -> None:
    """Coarse meters of known powers: what is left is their noise, the busbar's of each phase included."""
    meta = street().meta
    meta = replace(meta, busbar_jitter_percent=0.1, meters=replace(meta.meters, jitter_percent=0.02))
    tables = replace(street(), meta=meta)
    day = Scenario(
        seed=1, duration_s=2 * 86400.0, dt_s=900.0, profile_s=0.0, errors=MeterErrors(report_q=True)
    )
    found = calibrate(
        three_phase(tables),
        record(from_tables(tables), day, tmp_path / "day.parquet"),
        kinds=[FileErrorKind.LENGTH],
    )
    white = found.errors.set_index("quantity").loc["noise of meters"]
    assert white["low"] < 1.0 < white["high"]
    assert white["estimate"] == pytest.approx(1.0, abs=0.15)


def test_moments_without_one_of_the_phases_are_left_out() -> None:
    whole, some = (frames(three_phase(street()), each) for each in (apart(), without(apart(), 2, 0.25)))
    assert (some.unread, some.t.size) == ("", whole.t.size - 24)
    np.testing.assert_array_equal(some.v0_phases, whole.v0_phases[24:])
    assert frames(three_phase(street()), without(apart(), 2, 0.75)).unread == "c"


def test_a_wrong_phase_is_not_written_where_another_one_is_not_read() -> None:
    found = calibrate(three_phase(on(street(), {"s5": "c"})), without(apart(), 0))
    assert told(found) == [["phase", "l-s5 with c-s5", "c", "b", "cannot be told"]]
    assert found.proposals["alternatives"].tolist() == ["l-s5 with c-s5 on a"]
    assert found.corrections == ()


def test_channels_of_a_meter_of_three_phases_are_read_as_the_meter(tmp_path: Path) -> None:
    """What `record` writes of a feeder with a customer of three phases is what `calibrate` takes."""
    tables = street()
    rows = (replace(row, bus="n3", phases="abc") if row.bus == "s3" else row for row in tables.customers)
    tables = replace(tables, customers=tuple(rows))
    day = Scenario(seed=1, duration_s=86400.0, dt_s=900.0, profile_s=0.0, errors=MeterErrors(report_q=True))
    recording = record(from_tables(tables), day, tmp_path / "day.parquet")
    table = recording.frame().assign(meter=lambda read: read["meter"].astype(str))
    own = table[table["meter"].str.startswith("m-s3-")].pivot_table(index="t", columns="meter")
    found = frames(three_phase(tables), recording)
    j = found.meter_ids.index("m-s3")
    np.testing.assert_allclose(found.v_volt[:, j], own["v_volt"].mean(axis=1))
    np.testing.assert_allclose(found.p_kw[:, j], own["p_kw"].sum(axis=1))
    np.testing.assert_allclose(found.q_kvar[:, j], own["q_kvar"].sum(axis=1))
    assert set(found.count[:, j]) == {3.0}
    gone = (table["meter"] == "m-s3-b") & (table["t"] == table["t"].min())
    assert np.flatnonzero(np.isnan(frames(three_phase(tables), table[~gone]).v_volt[:, j])).tolist() == [0]
    assert calibrate(three_phase(tables), recording).proposals.empty
    for renamed, code in (({"m-s3-b": "m-s3"}, "duplicate"), ({"m-s1": "m-s3-d"}, "unknown-name")):
        with refused(RecordingInvalid, code):
            frames(three_phase(tables), table.replace({"meter": renamed}))


@pytest.mark.canary("s5-c")
@pytest.mark.parametrize(("bus", "said"), [("s1", "a"), ("s5", "c")])
def test_a_customer_on_a_service_line_of_another_phase_is_found_and_no_meter_excluded(
    bus: str, said: str
) -> None:
    wrong = on(street(), {bus: said})
    found = calibrate(three_phase(wrong), days())
    assert told(found) == [["phase", f"l-{bus} with c-{bus}", said, "b", "proposed"]]
    assert "excluded" not in set(found.meters["verdict"])
    assert found.customers.set_index("customer").loc[f"c-{bus}", ["bus", "phases"]].tolist() == [bus, "b"]
    assert corrected(wrong, found) == street()


@pytest.mark.acceptance
def test_a_lateral_of_several_customers_moves_as_one() -> None:
    wrong = on(street(), {"u": "c", "u1": "c", "u2": "c", "s3": "a"})
    found = calibrate(three_phase(wrong), days())
    assert sorted(told(found)) == [
        ["phase", "l-s3 with c-s3", "a", "c", "proposed"],
        ["phase", "l-u with c-u, c-u1, c-u2", "c", "b", "proposed"],
    ]
    assert corrected(wrong, found) == street()


@pytest.mark.acceptance
def test_of_a_customer_with_a_wrong_bus_and_phase_one_place_is_proposed() -> None:
    """Its service line, on which nobody is then, stays as it is in the files."""
    tables = street()
    rows = (replace(row, bus="n4", phases="b") if row.customer == "c-s3" else row for row in tables.customers)
    truth = replace(tables, customers=tuple(rows))
    readings = three_phase_readings(three_phase(truth), seed=3, ticks=96, dt_s=900.0, hidden_kw=0.1)
    found = calibrate(three_phase(tables), readings)
    assert sorted(told(found)) == [
        ["bus", "c-s3", "s3", "n4", "proposed"],
        ["phase", "c-s3", "c", "b", "proposed"],
    ]
    after = corrected(tables, found)
    assert not validate(after)
    assert after == truth


def test_places_of_which_each_speaks_for_the_other_are_not_written() -> None:
    """Phases are not looked for: the search comes back to the bus of the files, and ends there."""
    found = calibrate(
        three_phase(on(street(), {"s1": "a"})), days(), kinds=(FileErrorKind.BUS, FileErrorKind.LENGTH)
    )
    assert found.proposals["kind"].tolist() == ["length", "bus"]
    assert found.proposals.loc[1, ["what", "verdict"]].tolist() == ["c-s1", "cannot be told"]
    assert found.proposals["alternatives"][1] == "c-s1 at s1"
    assert [wrong.kind for wrong in found.corrections] in ([], [FileErrorKind.LENGTH])


def test_what_a_later_place_leaves_of_an_earlier_one() -> None:
    tables = street()
    away = Correction(FileErrorKind.BUS, ("c-s1",), "n4")
    on_c = Correction(FileErrorKind.PHASE, ("c-u", "c-u1", "c-u2"), phases="c", lines=("l-u", "l-u1", "l-u2"))
    assert left(away, replace(away, bus="n3")) is None
    assert left(away, on_c) == away
    assert left(on_c, replace(on_c, phases="a")) is None
    two = replace(on_c, names=("c-u", "c-u1"))
    assert left(on_c, two) == Correction(FileErrorKind.PHASE, ("c-u2",), phases="c")
    gone = Correction(FileErrorKind.BUS, on_c.names, "n4")
    assert left(on_c, gone) == replace(on_c, lines=())
    swap = Correction(FileErrorKind.SWAP, ("c-s1", "c-s2"))
    assert left(swap, away) == swap
    group = network(tables).site.bus_of_file
    assert as_filed(tables, replace(away, bus="s1"), group)
    assert not as_filed(tables, away, group)
    assert as_filed(tables, replace(on_c, phases="b"), group)
    assert not as_filed(tables, on_c, group)
    assert not as_filed(tables, swap, group)


def test_a_line_takes_its_own_columns_to_another_phase() -> None:
    row = LineRow(
        "l", "n1", "s1", 0.2, 0.1, phases="b", r_bb_ohm=0.2, x_bb_ohm=0.1, b_us=3.0, b_bb_us=3.0, tap_b=0.98
    )
    tables = replace(street(), lines=(row,), customers=())
    wrong = Correction(FileErrorKind.PHASE, (), phases="c", lines=("l",))
    (after,) = apply(tables, wrong).lines
    assert (after.r_cc_ohm, after.x_cc_ohm, after.b_cc_us, after.tap_c) == (0.2, 0.1, 3.0, 0.98)
    assert after.taps == (1.0, 1.0, 0.98)
    assert series_of(after)[2, 2] == series_of(row)[1, 1]
    assert series_of(after)[1, 1] == 0.0
    assert apply(apply(tables, wrong), replace(wrong, phases="b")) == tables


def moments(tables: FeederTables) -> Frames:
    """Two moments of the street by AC power flow, told exactly."""
    given = three_phase(tables)
    draws = np.random.default_rng(0).uniform(0.0, 6.0, (2, 2, len(given.meter_ids)))
    v0, ones = np.full(2, 231.0), np.ones((2, draws.shape[2] + 1))
    v, _ = UnbalancedPowerFlow(given).solve_batch(*draws, v0)
    return Frames(given.meter_ids, np.arange(2.0), v, *draws, v0, np.tile(v0[:, None], 3), ones, 1.0)


@pytest.mark.parametrize("bus", ["s4", "u"])
def test_a_lateral_on_another_phase_is_what_the_power_flow_says(bus: str) -> None:
    """Behind a regulator with a tap in each phase and a transformer at the beginning of each lateral."""
    taps = {"tap_a": 0.98, "tap_b": 1.0, "tap_c": 1.02}
    tables = street()
    own: dict[str, dict[str, float]] = {"t2": taps, "l-s4": {"to_volt": 115.0}, "l-u": {"to_volt": 115.0}}
    lines = tuple(replace(row, **own.get(row.line, {})) for row in tables.lines)  # type: ignore[arg-type]
    tables = replace(tables, lines=lines)
    given, net = moments(tables), network(tables)
    now = series(net, given, powers(net.site, given), ())
    assert np.abs(now.residual(net.places)).max() < 2e-4
    (lateral,) = (one for one in net.laterals if tables.lines[one.lines[0]].to_bus == bus)
    buses = [tables.lines[row].to_bus for row in lateral.lines]
    assert {tables.customers[k].bus for k in lateral.customers} == set(buses)
    for phase, place in lateral.others.items():
        after = moments(on(tables, dict.fromkeys(buses, phase))).v_volt
        change = (after**2 - given.v_volt**2) / net.places.unit**2
        found = net.places.rephased(now, [(lateral.customers, lateral.place, place)])
        np.testing.assert_allclose(found, change, atol=0.1 * np.abs(change).max())


def test_exchanged_phases_of_two_laterals_are_one_proposal() -> None:
    wrong = on(street(), {"s2": "c", "s4": "a"})
    found = calibrate(three_phase(wrong), days())
    assert found.proposals["kind"].tolist() == ["phase"]
    assert found.proposals["proposed"].tolist() == ["phases exchanged"]
    assert found.proposals["verdict"].tolist() == ["proposed"]
    assert corrected(wrong, found) == street()
