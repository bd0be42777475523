"""A feeder of 20 kV and 0.4 kV through the service: liars on both levels, in volts, and what REST says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from feeders.format.tables import to_json
from feeders.model.site import Site, from_tables
from feeders.simulation.scenario import Scenario, simulate
from gridsec.attack import Bias
from gridsec.interface import Cause
from service.alarms.conditions import conditions
from service.alarms.state_machine import AlarmKind
from service.api.models import FeederDetail, State
from service.engine.feeder_monitor import known_of
from service.ingest.decode import Wire
from service.ingest.reading import BadReading
from service.report.feeder_info import detail
from service.report.report import FeederReport
from service.report.report import to_json as report_json
from tests.feeders import stations
from tests.feeders.stations import LV, MV
from tests.service.played import replayed
from tests.service.ticks import listed

START = 1_795_212_000.0
T_ON = START + 20.0


@pytest.mark.parametrize("phases", [False, True], ids=["balanced", "phases"])
def test_a_liar_on_each_level_is_named_in_volts(phases: bool, tmp_path: Path) -> None:
    tables = stations.in_phases() if phases else stations.tables()
    monitor = replace(tables.meta.monitor, max_attacked=2)
    site = from_tables(replace(tables, meta=replace(tables.meta, monitor=monitor)))
    nominal = site.customer_nominal[site.meters]
    high, low = np.flatnonzero(nominal > 1000.0), np.flatnonzero(nominal < 1000.0)
    assert high.size >= 3
    assert low.size == 8
    liars = np.sort([high[1], low[-1]])
    lie = Bias(liars, T_ON, START + 60.0, np.where(liars == low[-1], -0.03, 0.03))
    scenario = Scenario(seed=5, start=START, duration_s=28.0, attacks=(lie,))
    samples = list(simulate(site, scenario))
    reports = replayed(site, scenario, tmp_path)
    honest = next(report for report in reports if report.t == T_ON - 2.0)
    assert honest.verdict != "attacked"
    last = reports[-1]
    assert last.verdict == "attacked"
    assert {m.meter for m in last.meters if m.suspect} == {site.meter_ids[k] for k in liars}
    sample = next(sample for sample in samples if sample.t == last.t)
    told = np.array([m.v_volt_estimated for m in last.meters], dtype=float)
    std = np.array([m.v_volt_std for m in last.meters], dtype=float)
    assert (np.abs(told - sample.v_volt[site.meters]) <= 3.0 * std).all()
    # Powers of liars are not believed: without them their voltages, and the street's, are known less well.
    np.testing.assert_allclose(told, sample.v_volt[site.meters], rtol=8e-3)
    attack = np.array([m.attack_volt_estimated for m in last.meters], dtype=float)
    # Whoever lies by 3 % of its nominal voltage may be off by its class, 0.5 %, besides.
    np.testing.assert_allclose(attack[liars] / nominal[liars], lie.size, atol=6e-3)
    np.testing.assert_allclose(np.abs(sample.shift_volt[liars]) / nominal[liars], 0.03, rtol=5e-3)
    squared = np.array([m.v2_pu_estimated for m in last.meters], dtype=float)
    np.testing.assert_allclose(squared, (told / nominal) ** 2, rtol=1e-12)
    found = np.array([bus.v_volt for bus in last.buses], dtype=float)
    levels = np.array([stations_volt(bus.bus) for bus in last.buses])
    assert (np.abs(found / levels - 1.0) < 0.08).all()
    _limits_are_those_of_the_level(site, last)


def stations_volt(bus: str) -> float:
    return MV if bus in ("works", "m1", "m2", "m3") else LV


def _limits_are_those_of_the_level(site: Site, report: FeederReport) -> None:
    """0.95 of its nominal voltage is within, 0.85 is not, on both levels."""
    nominal = site.customer_nominal[site.meters]
    state = TypeAdapter(State).validate_python(report_json(report) | {"age_s": 0.0})
    np.testing.assert_allclose([m.v_min_volt for m in state.meters], 0.9 * nominal)
    np.testing.assert_allclose([m.v_max_volt for m in state.meters], 1.1 * nominal)
    fine = [
        replace(m, v_volt_estimated=0.95 * v, v_volt_std=0.0)
        for m, v in zip(report.meters, nominal, strict=True)
    ]
    low = [
        replace(m, v_volt_estimated=0.85 * v, v_volt_std=0.0)
        for m, v in zip(report.meters, nominal, strict=True)
    ]
    for meters, count in ((fine, 0), (low, len(low))):
        found = conditions(replace(report, meters=tuple(meters), cause=Cause.AGREEMENT))
        assert sum(c.kind is AlarmKind.VOLTAGE_LIMIT for c in found) == count
    reasons = [c.reason for c in found if c.kind is AlarmKind.VOLTAGE_LIMIT]
    assert any("limit of 207.8 V" in reason for reason in reasons)
    assert any("limit of 10392.3 V" in reason for reason in reasons)


def test_the_layout_says_the_nominal_voltage_of_every_bus() -> None:
    site = from_tables(stations.tables())
    told = FeederDetail.model_validate(detail(site, 5.0))
    assert told.v_nominal_volt == MV
    assert told.layout.v_nominal_volt == [stations_volt(bus) for bus in told.layout.buses]
    phases = FeederDetail.model_validate(detail(from_tables(stations.in_phases()), 5.0))
    assert phases.layout.v_nominal_volt == told.layout.v_nominal_volt
    assert detail(site, 5.0)["tables"] == to_json(site.tables)


def test_a_reading_is_absurd_by_its_own_level() -> None:
    """5 kV at a customer of 230 V never comes from the grid; at one of 11.5 kV it may."""
    site = from_tables(stations.tables())
    wire = Wire({"two-levels": known_of(site)}, "gridsec", 1000)
    payload = b'{"t": 1795212000.0, "v_volt": 5000.0}'
    taken = {}
    for meter in ("sawmill", "a1-east"):
        decoded = wire.decode(f"gridsec/two-levels/meter/{meter}/reading", payload, "application/json")
        taken[meter] = decoded
    assert len(taken["sawmill"].readings) == 1
    (bad,) = taken["a1-east"].bad
    assert isinstance(bad, BadReading)
    assert "implausible at a nominal voltage of 230.94 V" in bad.problems[0]
    both = b'[{"meter": "sawmill", "t": 1795212000.0, "v_volt": 5000.0}, ' + (
        b'{"meter": "a1-east", "t": 1795212000.0, "v_volt": 5000.0}]'
    )
    decoded = wire.decode("gridsec/two-levels/concentrator/c/readings", both, "application/json")
    assert [reading.meter for reading in listed(decoded, known_of(site)).readings] == ["sawmill"]
