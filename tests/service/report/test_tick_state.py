"""The part of a report that conditions depend on gives the alarms of the whole report."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, load
from feeders.simulation.attacks import Bias
from feeders.simulation.scenario import Scenario, SimulatedReading, by_arrival, simulate
from gridsec.interface import Decision
from service.alarms.conditions import AlarmKind, conditions
from service.alarms.state_machine import AlarmBook, AlarmRules, AlarmTransition, advance
from service.engine.feeder_monitor import TickResult
from service.engine.replay import ReplayCounts, replay
from service.store.series import mark
from tests.service.liars import FEEDER, START


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


def results(site: Site, gone: dict[str, tuple[float, float]], **more: Any) -> list[TickResult]:
    """Replay a scenario in which meters are unheard of for a while."""

    def heard(one: SimulatedReading) -> bool:
        first, last = gone.get(one.meter, (1.0, 0.0))
        return not first <= one.t - START < last

    scenario = Scenario(seed=3, start=START, duration_s=60.0, **more)
    readings = [one for one in by_arrival(simulate(site, scenario)) if heard(one)]
    return list(replay(site, readings, ReplayCounts()))


@pytest.mark.parametrize("scene", ["calm", "liar", "silent", "half", "outage", "low"])
def test_alarms_are_those_of_whole_reports(site: Site, scene: str) -> None:
    gone: dict[str, tuple[float, float]] = {}
    more: dict[str, Any] = {}
    if scene == "liar":
        more["attacks"] = (Bias(np.array([2]), START + 15.0, START + 40.0, np.array([0.06])),)
    if scene == "silent":
        gone = {site.meter_ids[1]: (20.0, 45.0), site.meter_ids[4]: (10.0, 12.0), "": (30.0, 33.0)}
    if scene in ("half", "outage"):
        # One meter goes first; half of the meters, or all with the busbar's, follow.
        count = len(site.meter_ids) // 2 if scene == "half" else len(site.meter_ids)
        gone = dict.fromkeys(site.meter_ids[1:count], (22.0, 45.0)) | {site.meter_ids[0]: (10.0, 45.0)}
        gone |= {"": (22.0, 45.0)} if scene == "outage" else {}
    if scene == "low":
        limits = replace(site.tables.meta.limits, v_min_pu=1.06, v_max_pu=1.2)
        tables = replace(site.tables, meta=replace(site.tables.meta, limits=limits))
        site = replace(site, tables=tables)
    found = results(site, gone, **more)
    rules = AlarmRules(2.0, 5.0, silence_s=10.0)
    whole, part = AlarmBook(FEEDER), AlarmBook(FEEDER)
    told: list[AlarmTransition] = []
    calm = 0
    for result in found:
        state = result.state
        notable = state.notable({subject for _, subject in part.entries})
        calm += notable is None
        keys, counts = part.entries.keys(), state.counts
        some = [] if notable is None else conditions(notable, keys=keys, counts=counts)
        whole, expected = advance(whole, rules, conditions(state.report), state.t)
        part, transitions = advance(part, rules, some, state.t)
        assert transitions == expected
        assert part == whole
        assert state.suspects == state.report.suspects
        assert state.inverters == sum(one.suspect for one in state.report.inverters)
        assert state.model_only == state.report.model_only
        assert (state.verdict, state.cause) == (state.report.verdict, state.report.cause)
        kept = state.kept()
        assert mark(kept) == mark(state.report)
        assert kept.row.meters == state.report.row.meters
        np.testing.assert_array_equal(kept.row.values, state.report.row.values)
        np.testing.assert_array_equal(kept.row.flags, state.report.row.flags)
        told += transitions
    assert bool(told) == (scene != "calm")
    assert calm > 10 or scene != "calm"
    assert Decision.CLEAN in {result.state.verdict for result in found}


def test_an_outage_is_held_while_most_meters_are_unavailable_and_not_silent(site: Site) -> None:
    """A decided tick after a time without monitoring, which is no evidence of silence."""
    gone = dict.fromkeys(site.meter_ids[1:], (22.0, 45.0))
    state = next(one.state for one in results(site, gone) if one.state.counts.mostly(one.state.counts.unread))
    assert state.judgement is not None
    decided = replace(state.judgement, decision=Decision.CLEAN)
    state = replace(state, tick=replace(state.tick, silent=()), judgement=decided)
    notable = state.notable({None})
    assert notable is not None
    keys = {(AlarmKind.DATA_LOSS, None)}
    (found,) = (one for one in conditions(notable, keys=keys, counts=state.counts) if one.meter is None)
    assert (found.kind, found.known) == (AlarmKind.DATA_LOSS, False)
    assert found in conditions(state.report)
