"""A feeder of single-phase customers through the whole service, and what the wire says of three phases."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from pydantic import TypeAdapter

from feeders.model.site import Site, from_tables, load, to_frame
from feeders.simulation.recording import read_recording, record
from feeders.simulation.scenario import Scenario, random_attacks, simulate
from service.api.models import FeederDetail, State
from service.cli.simulate import Pace, payload_of, play
from service.engine.feeder_monitor import known_of
from service.engine.replay import ReplayCounts, replay
from service.ingest.decode import Wire
from service.ingest.reading import BadReason, Reading
from service.report.feeder_info import detail
from service.report.report import snapshot
from tests.service.running import service, until
from tests.service.ticks import Listed, listed, tick_of

EUROPEAN = "ieee-european-lv"
START = 1_795_212_000.0


@pytest.fixture(scope="module")
def site() -> Site:
    return load(EUROPEAN)


@pytest.fixture(scope="module")
def scenario(site: Site) -> Scenario:
    attacks = random_attacks(site, 7, "bias", 3, 0.03, t_on=START + 15, t_off=START + 60)
    return Scenario(seed=6, start=START, duration_s=40.0, attacks=attacks)


def decode(site: Site, **changed: Any) -> Listed:
    wire = Wire({EUROPEAN: known_of(site)})
    reading = {"t": START, "v_volt": 240.0, "v_phases": [239.0, 240.0, 241.0]} | changed
    payload = msgspec.json.encode(reading)
    return listed(wire.decode(f"gridsec/{EUROPEAN}/substation/reading", payload), known_of(site))


def test_the_busbar_tells_its_phases_apart(site: Site) -> None:
    (reading,) = decode(site).readings
    assert reading.v_phases == (239.0, 240.0, 241.0)
    (reading,) = decode(site, v_phases=[239.0, None, 0.0]).readings
    np.testing.assert_array_equal(reading.v_phases, [239.0, np.nan, 0.0])
    assert decode(site, v_phases=None).readings[0].v_phases is None
    assert decode(site, v_phases=[None, None, None]).readings[0].v_phases is None


@pytest.mark.parametrize(
    ("phases", "reason", "said"),
    [
        (240.0, BadReason.TYPE, "v_phases is a number, not an array of 3 voltages"),
        ([240.0, 240.0], BadReason.TYPE, "not an array of 3 voltages"),
        ([240.0, "x", 240.0], BadReason.TYPE, "v_phases[1] is a string, not a number"),
        ([240.0, -1.0, 240.0], BadReason.VALUE, "v_phases are implausible at a nominal voltage of 240.178 V"),
        ([240.0, 1e9, 240.0], BadReason.VALUE, "v_phases are implausible"),
    ],
)
def test_what_is_no_voltage_of_phases(site: Site, phases: object, reason: BadReason, said: str) -> None:
    decoded = decode(site, v_phases=phases)
    assert not decoded.readings
    assert decoded.bad[0].reason is reason
    assert any(said in problem for problem in decoded.bad[0].problems)


def test_every_problem_is_named_with_those_of_the_phases(site: Site) -> None:
    (bad,) = decode(site, v_volt=1e9, v_phases=[240.0, 1e9, 240.0]).bad
    assert len(bad.problems) == 2


def test_phases_do_not_matter_to_a_balanced_feeder() -> None:
    village = load("kerber-landnetz")
    none = (None,) * len(village.meter_ids)
    for phases in (None, (229.0, float("nan"), 233.0), (0.0, 0.0, 0.0)):
        busbar = Reading(village.feeder.name, None, START, 231.0, v_phases=phases)
        said = snapshot(village, tick_of(START, none, busbar, ()))
        assert said.v0_volt == 231.0
        assert to_frame(village, said).v0_phases is None


def test_the_layout_is_that_of_the_buses(site: Site) -> None:
    found = FeederDetail.model_validate(detail(site, 5.0))
    assert len(found.layout.buses) == len(site.tree.buses) == 906
    assert {customer.phase for customer in found.layout.customers} == {"a", "b", "c"}
    assert all(customer.bus in found.layout.buses for customer in found.layout.customers)


def test_a_recording_keeps_the_phases_and_is_replayed(site: Site, scenario: Scenario, tmp_path: Path) -> None:
    short = replace(scenario, duration_s=25.0)
    recording = record(site, short, tmp_path / "day.parquet")
    samples = list(simulate(site, short))
    sent = [reading for sample in samples for reading in sample.readings]
    kept = list(recording.readings())
    assert sorted(kept, key=repr) == sorted(sent, key=repr)
    busbar = next(reading for reading in kept if not reading.meter)
    assert busbar.v_phases is not None
    assert busbar.v_volt == pytest.approx(np.mean(busbar.v_phases))
    assert recording.truth().v_bus_volt.shape == (25, 3 * 906)
    tally = ReplayCounts()
    reports = [result.report for result in replay(site, read_recording(recording.path).readings(), tally)]
    lying = {site.meter_ids[k] for k in np.flatnonzero(samples[-1].manipulated)}
    assert {meter.meter for meter in reports[-1].meters if meter.suspect} == lying
    assert +tally.readings == {"accepted": len(sent)}


@pytest.mark.acceptance
def test_the_service_names_the_liars_with_their_phases(
    site: Site, scenario: Scenario, tmp_path: Path
) -> None:
    tables = site.tables
    phase = {row.meter: row.phases for row in tables.customers}
    with service(tmp_path, (EUROPEAN,), clock="events") as live:
        samples = list(play(site, scenario, live.meters, Pace(float("inf"), ahead=3)))
        until(lambda: live.state(EUROPEAN).get("t", 0.0) >= samples[-1].t - 2.0, "the end")
        state = live.state(EUROPEAN)
    lying = {site.meter_ids[k] for k in np.flatnonzero(samples[-1].manipulated)}
    assert len(lying) == 3
    assert state["verdict"] == "attacked"
    assert {meter["meter"] for meter in state["meters"] if meter["suspect"]} == lying
    assert all(meter["phase"] == phase[meter["meter"]] for meter in state["meters"])
    TypeAdapter(State).validate_python(state)
    # Estimated and true voltages of every phase of every bus, and the one furthest from nominal.
    found = np.array([bus["v_phases"] for bus in state["buses"]], dtype=float)
    np.testing.assert_allclose(found, samples[-1].v_bus_volt.reshape(-1, 3), rtol=0, atol=2.0)
    one = np.array([bus["v_volt"] for bus in state["buses"]])
    off = np.abs(found - tables.meta.voltage_volt)
    np.testing.assert_allclose(np.abs(one - tables.meta.voltage_volt), off.max(axis=1))


def test_a_balanced_feeder_says_nothing_of_phases() -> None:
    village = load("kerber-landnetz")
    assert all(customer["phase"] is None for customer in detail(village, 5.0)["layout"]["customers"])
    assert from_tables(village.tables).digest == village.digest
    (sample,) = simulate(village, Scenario(duration_s=1.0))
    assert all(b"phases" not in payload_of(reading) for reading in sample.readings)
