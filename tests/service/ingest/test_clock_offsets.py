"""Clock offsets from delays: ticks, reports, alarms."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import load, to_frame
from gridsec.interface import Cause
from service.alarms.conditions import AlarmKind, Condition, Severity, conditions
from service.alarms.state_machine import AlarmBook, AlarmRules, advance, restore
from service.engine.feeder_monitor import FeederMonitor, align_rules, design
from service.ingest.align import OFFSETS_TICKS, Aligner, Clock, Tick, rules
from service.ingest.clock_offsets import FEWEST, KEPT, ClockOffsets
from service.ingest.reading import Reading
from service.report.report import snapshot, to_json
from tests.service.played import ingest
from tests.service.reports import meter, report
from tests.service.ticks import tick_of

T0 = 1_795_212_000.0
METERS = tuple("abcdefgh")


def reading(meter: str | None, t: float) -> Reading:
    return Reading("village", meter, t, 230.0)


def played(
    offsets: dict[str, float], *, clock: Clock = Clock.WALL, ticks: int = 80, batch: int = 1, seed: int = 1
) -> list[Tick]:
    """Ways of 0.05 to 0.25 s; every `batch` seconds all readings since then arrive in one instant."""
    rng, out = random.Random(seed), []
    a = Aligner(METERS, rules(1.0, 30.0, clock=clock, grace_s=float(batch)))
    out += list(a.due(T0 - 0.5))
    for k in range(ticks):
        if k % batch:
            continue
        now = T0 + k + rng.uniform(0.05, 0.25)
        for age in range(batch - 1, -1, -1):
            for one in (*METERS, None):
                stamp = T0 + k - age + offsets.get(one or "", 0.0)
                out += a.take(reading(one, stamp), now)[1]
    return out


@pytest.mark.canary("1--0.8", "5-3.0")
@pytest.mark.parametrize("offset", [-2.0, -0.8, 0.8, 3.0])
@pytest.mark.parametrize("batch", [1, 5])
def test_one_clock_that_is_off_is_measured(offset: float, batch: int) -> None:
    """To the jitter of the ways, and no other one."""
    last = played({"c": offset}, ticks=160, batch=batch)[-1].clock_offset
    assert [one is not None for one in last] == [m == "c" for m in METERS]
    assert last[2] == pytest.approx(offset, abs=0.15)


@pytest.mark.parametrize("batch", [1, 15])
def test_clocks_that_are_right_are_not_reported(batch: int) -> None:
    assert all(tick.clock_offset == () for tick in played({}, ticks=300, batch=batch))


def test_clocks_of_all_meters_are_measured_about_the_median() -> None:
    offsets = {m: -3.0 + 6.0 * k / 7 for k, m in enumerate(METERS)}
    last = played(offsets, ticks=160)[-1].clock_offset
    middle = float(np.median([*offsets.values(), 0.0]))
    for m, found in zip(METERS, last, strict=True):
        assert found is None or found == pytest.approx(offsets[m] - middle, abs=0.15)
        assert found is not None or abs(offsets[m] - middle) < 0.7


def test_only_the_wall_clock_measures() -> None:
    """Readings that tell the time have no delay."""
    assert all(tick.clock_offset == () for tick in played({"c": 3.0}, clock=Clock.EVENTS))


def test_a_backlog_at_one_instant_counts_once_with_its_newest_stamp() -> None:
    clocks = ClockOffsets((*METERS, None), 1.0, 30.0)
    for k in range(FEWEST):
        for one in (*METERS, None):
            clocks.note(one, T0 + k, T0 + k + 0.1)
        # Sixty readings of the last minute at once: each instant is one arrival.
        for age in range(60, 0, -1):
            clocks.note("d", T0 + k - age, T0 + k + 0.1)
    assert clocks.measured(T0 + FEWEST) == {}


def test_too_few_arrivals_or_sources_measure_nothing_and_a_set_clock_forgets() -> None:
    few, lonely = ClockOffsets((*METERS, None), 1.0, 30.0), ClockOffsets(("a", None), 1.0, 30.0)
    for k in range(FEWEST - 1):
        for one in (*METERS, None):
            few.note(one, T0 + k + (3.0 if one == "a" else 0.0), T0 + k)
    for k in range(KEPT):
        lonely.note("a", T0 + k + 3.0, T0 + k)
        lonely.note(None, T0 + k, T0 + k)
    assert few.measured(T0 + FEWEST) == {} == lonely.measured(T0 + KEPT)
    for one in (*METERS, None):
        few.note(one, T0 + 20.0 + (3.0 if one == "a" else 0.0), T0 + 20.0)
    assert few.measured(T0 + 20.0) == {"a": 3.0}
    few.forget()
    assert few.measured(T0 + 20.0) == {}


def test_silent_sources_do_not_count_when_the_service_clock_is_set() -> None:
    """Five of nine sources fall silent, then the service's clock leaps by 2 s: the four clocks are right."""
    clocks = ClockOffsets((*METERS, None), 1.0, 30.0)
    for k in range(300):
        live = (*METERS, None) if k < 100 else METERS[:4]
        for one in live:
            clocks.note(one, T0 + k, T0 + k + (0.1 if k < 140 else 2.1))
        if k >= 140:
            assert clocks.measured(T0 + k) == {}
    # A source that reports again begins with new delays.
    for k in range(300, 300 + FEWEST):
        for one in METERS[:5]:
            clocks.note(one, T0 + k, T0 + k + 2.1)
        assert clocks.measured(T0 + k) == {}


def test_an_offset_stays_reported_down_to_half_of_the_limit() -> None:
    """No alarm flaps about the limit of 0.5 s."""
    clocks, now = ClockOffsets((*METERS, None), 1.0, 30.0), T0
    for offset, reported in ((0.4, False), (0.6, True), (0.4, True), (0.2, False), (0.4, False)):
        for _ in range(KEPT):
            now += 1.0
            for one in (*METERS, None):
                clocks.note(one, now + (offset if one == "a" else 0.0), now)
        assert ("a" in clocks.measured(now)) is reported, offset


def test_ways_that_vary_more_than_the_offset_hide_it() -> None:
    rng, clocks = random.Random(3), ClockOffsets((*METERS, None), 1.0, 30.0)
    for k in range(KEPT):
        for one in (*METERS, None):
            late = rng.uniform(0.0, 10.0) if one == "a" else 0.1
            clocks.note(one, T0 + k, T0 + k + late)
        clocks.note("b", T0 + k + 0.5, T0 + k + 0.6)
    measured = clocks.measured(T0 + KEPT)
    assert "b" not in measured
    assert set(measured) <= {"a"}


@pytest.mark.parametrize(("offset", "words"), [(2.25, "2.2 s ahead of"), (-1.0, "1.0 s behind")])
def test_an_offset_is_a_minor_condition_with_its_seconds(offset: float, words: str) -> None:
    now = report(meter("m1"), meter("m2", clock_offset_s=offset))
    (found,) = conditions(now)
    assert (found.kind, found.subject, found.severity) == (AlarmKind.CLOCK_OFFSET, "m2", Severity.MINOR)
    assert found.known
    assert words in found.reason
    assert [m["clock_offset_s"] for m in to_json(now)["meters"]] == [None, offset]


def test_the_clock_of_the_busbar_meter_is_measured_and_shown() -> None:
    """Ahead by 2 s: ticks, snapshot, alarm of the substation, REST; no meter has an offset."""
    site = load("cigre-lv")
    watch = FeederMonitor(site, align_rules(site, Clock.WALL), AlarmBook(site.feeder.name))
    watch.install(design(site))
    rng, raised = random.Random(6), []
    for k in range(3 * OFFSETS_TICKS + 10):
        now = T0 + k + rng.uniform(0.05, 0.2)
        for one in (*site.meter_ids, None):
            stamp = T0 + k + (2.0 if one is None else 0.0)
            volt = site.tables.meta.voltage_volt
            results = ingest(watch, Reading(site.feeder.name, one, stamp, volt, 0.0, 0.0), now)
            raised += [t.alarm for result in results for t in result.transitions]
    assert ("substation", AlarmKind.CLOCK_OFFSET) in {(one.meter, one.kind) for one in raised}
    assert watch.report is not None
    shown = to_json(watch.report)
    assert shown["busbar"]["clock_offset_s"] == pytest.approx(2.0, abs=0.15)
    assert {m["clock_offset_s"] for m in shown["meters"]} == {None}
    tick = tick_of(T0, (None,) * len(site.meter_ids), None, (), busbar_offset=2.0)
    assert to_frame(site, snapshot(site, tick)).busbar_offset == 2.0
    assert np.isnan(to_frame(site, snapshot(site, replace(tick, busbar_offset=None))).busbar_offset)


def test_an_alarm_of_a_clock_is_held_after_a_restart_until_the_offset_is_measured() -> None:
    """One clock is right after the restart, one is still off, one meter is silent: its alarm stays."""
    site = load("cigre-lv")
    kind, ids = AlarmKind.CLOCK_OFFSET, site.meter_ids
    t0 = T0 - T0 % OFFSETS_TICKS
    before = [Condition(kind, site.feeder.name, one, Severity.MINOR) for one in ids[:3]]
    book, _ = advance(AlarmBook(site.feeder.name), AlarmRules(0.0), before, t0 - 60.0)
    book = restore(site.feeder.name, book.active)
    watch = FeederMonitor(site, align_rules(site, Clock.WALL), book)
    rng, cleared = random.Random(7), dict[str | None, float]()
    for k in range(4 * OFFSETS_TICKS):
        now = t0 + k + rng.uniform(0.05, 0.2)
        for one in (*ids, None):
            if one == ids[2]:
                continue
            stamp = t0 + k + (2.0 if one == ids[1] else 0.0)
            reading = Reading(site.feeder.name, one, stamp, site.tables.meta.voltage_volt, 0.0, 0.0)
            for result in ingest(watch, reading, now):
                cleared |= {
                    each.alarm.meter: each.t for each in result.transitions if each.alarm.kind is kind
                }
    assert set(cleared) == {ids[0]}
    assert cleared[ids[0]] >= t0 + FEWEST
    active = {alarm.meter for alarm in watch.book.active if alarm.kind is kind}
    assert active == {ids[1], ids[2]}
    # Clocks that tell the time have no offset: nothing is to be measured.
    assert played({}, clock=Clock.EVENTS)[-1].clocks_known is None


@pytest.mark.parametrize(("offset", "cause"), [(1.5, Cause.AGREEMENT), (40.0, Cause.CLOCK_OFFSET)])
def test_a_watched_feeder_raises_the_alarm_and_shows_the_offset(offset: float, cause: Cause) -> None:
    """An offset that no scale judges: undecided with this cause, and no alarm besides."""
    site = load("cigre-lv")
    watch = FeederMonitor(site, align_rules(site, Clock.WALL), AlarmBook(site.feeder.name))
    watch.install(design(site))
    rng, off, kinds = random.Random(5), site.meter_ids[1], []
    for k in range(7 * OFFSETS_TICKS):
        now = T0 + k + rng.uniform(0.05, 0.2)
        for one in (*site.meter_ids, None):
            stamp = T0 + k + (offset if one == off else 0.0)
            volt = site.tables.meta.voltage_volt
            results = ingest(watch, Reading(site.feeder.name, one, stamp, volt, 0.0, 0.0), now)
            # Up to the first reading of the meter that serves a tick the meter is silent.
            kinds += [t.alarm.kind for result in results for t in result.transitions if k > 50]
            kinds += [
                t.alarm.kind for result in results for t in result.transitions if t.alarm.subject == off
            ]
    assert AlarmKind.CLOCK_OFFSET in kinds
    assert AlarmKind.UNDECIDED not in kinds
    assert watch.report is not None
    assert watch.report.cause is cause
    if cause is Cause.CLOCK_OFFSET:
        assert off in watch.report.reason
    shown = {m.meter: m.clock_offset_s for m in watch.report.meters}
    assert shown.pop(off) == pytest.approx(offset, abs=0.15)
    assert set(shown.values()) == {None}
