"""Days without an attack on every low-voltage feeder: not one false alarm, not one suspect.

The whole chain behind the wire runs, from readings to alarms; meters have the errors that their class
allows, and the loads of all seasons' profiles with fast variation on top run through full AC power flow.
`python -m benchmarks.clean_days` is the same at length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.clean_days import Run, main, plan, play
from feeders.model.site import Snapshot, from_tables, load, to_frame
from feeders.profiles import Season
from feeders.registry import design
from feeders.simulation.attacks import AttackKind, random_attacks
from feeders.simulation.demand import Variation
from feeders.simulation.plant import MeterErrors
from feeders.simulation.scenario import START, Scenario, SimulatedReading, simulate
from gridsec.arrays import Floats
from gridsec.interface import Decision
from service.alarms.conditions import AlarmKind
from service.engine.replay import ReplayCounts, replay

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


@pytest.mark.canary("kerber-dorfnetz-12-1.5")
@pytest.mark.parametrize(
    ("feeder", "hour", "hours"),
    # The large ones take their time: a night or an afternoon each.
    [("kerber-dorfnetz", 12, 1.5)]
    + [
        (name, hour, 6.0)
        for k, name in enumerate(LOW_VOLTAGE)
        for hour in (0, 12)
        if k % 2 == hour // 12 or len(load(name).meters) < LARGE
    ],
)
def test_a_day_without_an_attack_raises_no_alarm(feeder: str, hour: int, hours: float) -> None:
    """A night and an afternoon, each from another season and day of the profiles and with other meters."""
    tables = load(feeder).tables
    tick_s = LARGE_TICK_S if len(tables.customers) > LARGE else SMALL_TICK_S
    settings = replace(tables.meta.monitor, tick_s=tick_s, on_delay_s=0.0, off_delay_s=0.0, silence_s=60.0)
    site = from_tables(replace(tables, meta=replace(tables.meta, monitor=settings)))
    season = tuple(Season)[(hour // 6 + LOW_VOLTAGE.index(feeder)) % 4]
    day = hour // 6 + 4 * LOW_VOLTAGE.index(feeder) % 10
    scenario = Scenario(
        seed=1000 + hour,
        duration_s=3600.0 * hours,
        dt_s=settings.tick_s,
        profile_s=day * DAY_S + hour * 3600.0,
        season=season,
    )
    truth: dict[float, Floats] = {}

    def readings() -> Iterator[SimulatedReading]:
        for sample in simulate(site, scenario):
            truth[sample.t] = sample.v_volt / site.feeder.base_volt
            yield from sample.readings

    ticks = 0
    for result in replay(site, readings(), ReplayCounts()):
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
    assert ticks == 3600.0 * hours / settings.tick_s


@pytest.mark.canary("30.0")
@pytest.mark.parametrize("tick_s", [10.0, 30.0])
def test_a_meter_at_the_edge_of_its_class_is_learned_and_not_named(tick_s: float) -> None:
    """The busbar's meter is off by its class one way, m05 by its class the other way, for ever.

    Nobody draws or generates anything. Taken for their own, what all meters seem to be off would leave m05
    outside its class.
    """
    tables = load("cigre-lv").tables
    settings = replace(tables.meta.monitor, tick_s=tick_s, silence_s=60.0, commission_s=DAY_S / 4)
    site = from_tables(replace(tables, meta=replace(tables.meta, monitor=settings)))
    nominal, p, random = tables.meta.voltage_volt, len(site.meter_ids), np.random.default_rng(0)
    off = np.where(np.array(site.meter_ids) == "m05", site.accuracy.class_fraction, 0.0)
    watcher = design(site)
    assert watcher.bias_learning is not None
    state = watcher.init(0.0)
    for k in range(1, int(1.2 * settings.commission_s / settings.tick_s)):
        v = nominal * (1.0 + off + site.accuracy.jitter * random.standard_normal(p))
        v0 = nominal * (1.0 - site.accuracy.busbar_class)
        frame = to_frame(site, Snapshot(tick_s * k, v, np.zeros(p), np.full(p, np.nan), v0))
        state, _, verdict = watcher.step(state, frame)
        assert k < 12 or verdict.decision is Decision.CLEAN, f"{tick_s * k} s: {verdict}"
    assert watcher.bias_learning.commission(state).learning is None


def test_the_benchmark_counts_nothing_where_nothing_is() -> None:
    run = plan("simbench-lv-rural1", Season.WINTER, 3, 3600.0, None)
    assert run.site.tables.meta.monitor.commission_s == 900.0
    seen = play(run)
    assert (seen.ticks, seen.verdicts) == (360, {"clean": 348})
    assert not seen.suspects
    assert not seen.false
    assert not seen.notes


def test_the_benchmark_counts_alarms_and_tells_which_are_right() -> None:
    """As many alarms as liars, and those about voltages that truly are too low are no false ones."""
    run = plan("simbench-lv-rural1", Season.WINTER, 3, 600.0, None)
    lies = random_attacks(run.site, 1, AttackKind.BIAS, 2, 0.05, t_on=START + 300.0, t_off=START + 500.0)
    seen = play(replace(run, scenario=replace(run.scenario, attacks=lies)))
    assert seen.false == {"meter-manipulated": 2}
    assert len(seen.suspects) == 2
    assert sum("is suspected" in note for note in seen.notes) == 2
    assert seen.verdicts["attacked"] >= 20  # of 200 s, every 10 s

    deep = replace(run.scenario, variation=Variation(busbar_pu=0.85, busbar_spread_pu=0.0, tap_step_pu=0.0))
    seen = play(replace(run, scenario=deep))
    assert seen.rightly == len(run.site.meter_ids)
    assert not seen.false


@pytest.mark.acceptance
def test_the_benchmark_fails_where_there_are_more_alarms_than_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Meters of six times their class: many are named, and the answer is 1."""
    monkeypatch.setattr("benchmarks.clean_days.names", lambda **_: ("cigre-lv",))
    assert main(0.02, None, None, None) == 0
    assert "| cigre-lv | autumn |" in capsys.readouterr().out

    def wrong(*args: Any) -> Run:
        run = plan(*args)
        return replace(run, scenario=replace(run.scenario, errors=MeterErrors(bias=6.0)))

    monkeypatch.setattr("benchmarks.clean_days.plan", wrong)
    assert main(0.02, None, None, None) == 1
