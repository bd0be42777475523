"""Days without an attack on every low-voltage feeder: not one false alarm, not one suspect.

The whole chain behind the wire runs, from readings to alarms; meters have the errors that their class
allows, and the loads of two weeks' profiles with fast variation on top run through full AC power flow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from feeders.load import from_tables, load
from feeders.scenario import START, Reading, Scenario, simulate
from gridsec.arrays import Floats
from gridsec.online import Decision
from service.conditions import AlarmKind
from service.replay import Tally, replay

DAY_S = 86_400.0
SETTLED_S = 120.0
LARGE, SMALL_TICK_S, LARGE_TICK_S = 50, 10.0, 30.0
"""Feeders with more customers than this are read less often: the AC power flow takes the time."""

LOW_VOLTAGE = (
    "cigre-lv",
    "kerber-dorfnetz",
    "kerber-landnetz",
    "kerber-vorstadtnetz",
    "simbench-lv-rural1",
    "simbench-lv-rural3",
)


@pytest.mark.slow
@pytest.mark.parametrize("feeder", LOW_VOLTAGE)
@pytest.mark.parametrize("hour", range(0, 24, 6))
def test_a_day_without_an_attack_raises_no_alarm(feeder: str, hour: int) -> None:
    """Four quarters of a day, each from another day of the profiles and with other meters."""
    tables = load(feeder).tables
    tick_s = LARGE_TICK_S if len(tables.customers) > LARGE else SMALL_TICK_S
    settings = replace(tables.meta.monitor, tick_s=tick_s, on_delay_s=0.0, off_delay_s=0.0, silence_s=60.0)
    site = from_tables(replace(tables, meta=replace(tables.meta, monitor=settings)))
    day = hour // 6 + 4 * LOW_VOLTAGE.index(feeder) % 10
    scenario = Scenario(
        seed=1000 + hour,
        duration_s=DAY_S / 4,
        dt_s=settings.tick_s,
        profile_s=day * DAY_S + hour * 3600.0,
    )
    truth: dict[float, Floats] = {}

    def readings() -> Iterator[Reading]:
        for sample in simulate(site, scenario):
            truth[sample.t] = sample.v_volt / site.feeder.base_volt
            yield from sample.readings

    ticks = 0
    for result in replay(site, readings(), Tally()):
        report = result.report
        ticks += 1
        assert not any(meter.suspect for meter in report.meters)
        if report.t >= START + SETTLED_S:
            assert report.verdict is Decision.CLEAN, report.reason
        for transition in result.transitions:
            alarm = transition.alarm
            assert alarm.kind is AlarmKind.VOLTAGE_LIMIT, alarm
            true = truth[report.t][site.meters[site.meter_ids.index(str(alarm.meter))]]
            limits = tables.meta.limits
            assert not limits.v_min_pu <= true <= limits.v_max_pu, f"{alarm}: the truth is {true} pu"
    assert ticks == DAY_S / 4 / settings.tick_s
