"""Overload: whole feeders are shed, the others are monitored, and all return."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from feeders.model.site import Site, from_tables, load
from gridsec.interface import Cause
from service.alarms.state_machine import AlarmKind
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import design
from service.engine.load import HOLD_MAX_S, KEPT, RETURNING, RETURNING_MIN, FeederLoad, LoadControl
from service.ingest.queues import LANE_SAMPLES, Counts, Inbox, Sample
from service.store import Store
from tests.service.liars import FEEDER, START


class Machine:
    """Feeders with a known cost on a processor of one second each second."""

    def __init__(self, feeders: int) -> None:
        self.t = 0.0
        self.control = LoadControl(lambda: self.t, lambda _: False)
        self.offered: dict[str, int] = {}
        self.dropped = Counter[str]()
        for k in range(feeders):
            self.control.feeders[f"f{k}"] = FeederLoad(1.0, 10)
            self.offered[f"f{k}"] = 0

    def counts(self) -> dict[str, Counts]:
        return {name: Counts(offered, self.dropped[name]) for name, offered in self.offered.items()}

    @property
    def shed(self) -> set[str]:
        return set(self.control.shed)

    def window(
        self, lasted_s: float, rounds_s: float, placed_s: float, samples: int, of_s: float = 1.0
    ) -> None:
        """One round of these times and samples in a window of `of_s`."""
        self.control.count_round(0.0, 0.0, 0.0, 0)
        self.t += of_s
        self.control.count_round(lasted_s, rounds_s, placed_s, samples)
        self.control.update(self.counts)

    def second(
        self,
        rate: float,
        cost_s: float = 1e-3,
        only: dict[str, float] | None = None,
        capacity: float = 1.0,
    ) -> None:
        """Each feeder is offered `rate` samples that last `cost_s`; beyond a second of work there are losses.

        `capacity` is the part of the time that the processor works for the service.
        """
        work = 0.0
        for name in self.offered:
            number = (only or {}).get(name, rate)
            self.offered[name] += int(number)
            work += 0.0 if name in self.shed else number * cost_s
        done = min(1.0, work)
        self.t += 1.0
        self.control.count_round(0.1, 0.1 * capacity, 0.0, 0)
        spent = done * capacity
        self.control.count_round(done, spent, spent, int(done / cost_s))
        for name in self.offered.keys() - self.shed if work > 1.0 else ():
            self.dropped[name] += int((only or {}).get(name, rate) * (1.0 - done / work))
        self.control.update(self.counts)


def test_feeders_are_shed_under_lasting_overload_and_return_at_once() -> None:
    machine = Machine(10)
    for _ in range(5):
        machine.second(50.0)
    assert not machine.shed
    machine.second(150.0)
    machine.second(150.0)
    assert not machine.shed  # two windows are no lasting overload
    machine.second(150.0)
    # A feeder needs 0.15 and something for the round.
    assert 5 <= len(machine.shed) <= 7
    for _ in range(60):
        machine.second(150.0)
        assert 5 <= len(machine.shed) <= 7
    machine.second(50.0)
    machine.second(50.0)
    assert not machine.shed


def test_a_costly_start_of_all_feeders_does_not_keep_them_out() -> None:
    """Ticks that cost twenty times as much for five seconds, then 0.6 of the processor's time."""
    machine = Machine(100)
    control = machine.control

    def second(cost_s: float) -> None:
        for name in machine.offered:
            control.count_tick(name, cost_s if name not in machine.shed else 1e-5)
        work = cost_s * (100 - len(machine.shed))
        machine.t += 1.0
        control.count_round(min(1.0, work), min(1.0, work), 0.0, 0)
        control.update(machine.counts)

    for _ in range(5):
        second(0.12)
    assert 80 <= len(machine.shed) < 100
    for _ in range(15):
        second(0.006)
    assert not machine.shed
    # One costly tick of each feeder, as at the start of the service, sheds none.
    machine = Machine(100)
    control = machine.control
    for cost_s in (0.05, *(0.006,) * 5):
        second(cost_s)
        assert not machine.shed


def test_ticks_of_shed_feeders_keep_no_feeder_out() -> None:
    """Ticks of 340 feeders that cost ten times as much for five seconds, then 0.5 of the processor's time.

    A tick of a shed feeder costs as much as one of the others, and there is one in three seconds.
    """
    machine = Machine(340)
    control, before = machine.control, 340

    def second(cost_s: float) -> None:
        work = 0.0
        for k, name in enumerate(machine.offered):
            if name in machine.shed and (k + int(machine.t)) % 3:
                continue
            # Most of it is for the forming of the tick.
            control.count_forming(name, 0.7 * cost_s)
            control.count_tick(name, 0.3 * cost_s)
            work += cost_s
        samples = 340 - len(machine.shed)
        machine.t += 1.0
        control.count_round(min(1.0, work), min(1.0, work), 1e-4 * samples, samples)
        control.update(machine.counts)

    for _ in range(8):
        second(0.015)
    assert machine.shed
    for _ in range(30):
        second(0.0015)
        assert len(machine.shed) <= before
        before = len(machine.shed)
    assert not machine.shed
    assert control.figures()["demand"] == pytest.approx(0.5, abs=0.06)


def test_a_flood_is_shed_before_its_neighbours_and_alarms_last() -> None:
    machine = Machine(5)
    machine.control.standing = lambda name: name == "f0"
    for _ in range(5):
        machine.second(20.0, only={"f3": 2000.0})
    assert machine.shed == {"f3"}
    machine = Machine(4)
    machine.control.standing = lambda name: name == "f0"
    for _ in range(4):
        machine.second(600.0)
    assert machine.shed == {"f1", "f2", "f3"}  # never all


def test_feeders_return_in_parts() -> None:
    machine = Machine(100)
    for _ in range(4):
        machine.second(30.0)
    shed = [len(machine.shed)]
    assert shed[0] > 70
    while machine.shed:
        machine.second(5.0)
        shed.append(len(machine.shed))
    back = [before - after for before, after in pairwise(shed) if before > after]
    assert back[0] == RETURNING_MIN
    for before, after in pairwise(shed):
        assert before - after <= max(RETURNING_MIN, RETURNING * (100 - before))
    assert max(back) > RETURNING_MIN


@pytest.mark.parametrize("feeders", [4, 60])
def test_returns_become_rarer_while_the_estimate_of_the_load_is_wrong(feeders: int) -> None:
    machine, times = Machine(feeders), list[float]()
    for _ in range(120):
        before = machine.shed
        # The samples of returned feeders cost more than those of the others.
        machine.second((100.0 if before else 400.0) * 4 / feeders)
        if before and not machine.shed:
            times.append(machine.t)
    gaps = [after - one for one, after in pairwise(times)]
    assert gaps == sorted(gaps)
    # More than `RETURNING_MIN` feeders return in parts; the window after the last return does not count.
    assert HOLD_MAX_S <= gaps[-1] <= HOLD_MAX_S + 5.0 + feeders // RETURNING_MIN


def test_feeders_return_when_other_processes_end() -> None:
    machine = Machine(10)
    for _ in range(8):
        machine.second(80.0, cost_s=4e-3, capacity=0.25)  # four times slower beside other processes
    assert 6 <= len(machine.shed) <= 9
    for _ in range(16):
        machine.second(80.0)
    # The demand of all is 0.8 and something for the round: above the limit, and most of them fit.
    assert len(machine.shed) <= 3
    for _ in range(4):
        machine.second(50.0)
    assert not machine.shed


def test_short_rounds_that_wait_for_other_threads_keep_no_feeder_out() -> None:
    """With few feeders a round works 1 ms and waits 9 ms, five times a second: most of the time is free."""
    machine = Machine(10)
    for _ in range(4):
        machine.second(150.0)
    assert machine.shed
    for _ in range(12):
        for _ in range(5):
            machine.control.count_round(0.01, 0.001, 0.0, 0)
        machine.second(50.0)
    assert not machine.shed
    figures = machine.control.figures()
    assert figures["capacity"] > 0.9
    assert figures["demand"] == figures["demand_of_all"] < KEPT


def test_time_that_the_model_does_not_explain_counts() -> None:
    """Rounds that wait for the interpreter's lock last the whole second, at a tenth of the modelled work."""
    machine = Machine(20)
    control = machine.control

    def second(dropped: int) -> None:
        for name in machine.offered:
            machine.offered[name] += 15
        for name in list(machine.offered)[:dropped]:
            machine.dropped[name] += 15
        kept = 20 - len(machine.shed)
        lasted = min(1.0, kept / 10)  # ten feeders take all the time
        machine.window(lasted, 0.005 * kept, 0.005 * kept, 15 * (kept - dropped))

    for _ in range(3):
        second(10)
    assert control.figures()["demand_of_all"] < KEPT
    # Half of the needed samples were processed in all the time: the demand was 2.
    before = len(machine.shed)
    assert before in (13, 14)
    for _ in range(10):
        second(0)
    assert before - 1 <= len(machine.shed) <= before


def test_one_window_with_few_samples_sheds_no_more_feeders() -> None:
    """The ratio of needed to processed samples is bounded, though all samples of a window are dropped."""
    machine = Machine(100)

    def second(samples: int) -> None:
        for name in machine.offered:
            machine.offered[name] += 10
            machine.dropped[name] += 10 - samples // 100
        machine.window(2.0, 0.8e-3 * samples, 0.4e-3 * samples, samples, of_s=2.0)

    second(1000)
    second(10)
    # Half of the time is placing: 0.5 + 0.5 * 3 = 2 in place of 1, and KEPT of it stays.
    assert len(machine.shed) == pytest.approx(65, abs=1)


def test_a_flood_that_drops_its_own_samples_sheds_no_neighbour() -> None:
    machine = Machine(100)
    for _ in range(10):
        for name in machine.offered:
            machine.offered[name] += 16_000 if name == "f7" else 10
        machine.dropped["f7"] += 15_000
        machine.window(0.6, 0.6, 0.3, 2_000)
        assert machine.shed <= {"f7"}


def test_many_short_rounds_keep_no_feeder_out() -> None:
    """A round of 1.2 ms waits 9 ms for the interpreter's lock, 70 times a second."""
    machine = Machine(20)
    for _ in range(4):
        machine.second(150.0)
    assert machine.shed
    for _ in range(30):
        for name in machine.offered:
            machine.offered[name] += 10
        for _ in range(70):
            machine.control.count_round(0.0102, 0.0012, 0.001, 1)
        machine.window(0.0, 0.0, 0.0, 0)
    assert not machine.shed


def test_dropped_samples_that_no_tick_needs_are_no_overload() -> None:
    machine = Machine(12)
    for _ in range(10):
        machine.second(330.0)
    assert machine.shed  # all of the time is used, and half of the samples of a tick may be lost
    machine = Machine(12)
    for _ in range(10):
        machine.second(330.0, cost_s=1e-4)
        for name in machine.offered:
            machine.dropped[name] += 300
    assert not machine.shed


def test_kept_demand_leaves_room() -> None:
    machine = Machine(20)
    for _ in range(10):
        machine.second(80.0)
    kept = sum(machine.control.demand(name) for name in machine.offered if name not in machine.shed)
    assert 0.0 < kept <= KEPT


# --- queue ---------------------------------------------------------------------------------------------


def sample(feeder: str, meter: str, number: int = 0) -> Sample:
    return Sample(f"gridsec/{feeder}/meter/{meter}/reading", b"x" * 100, "", float(number), 100)


def test_a_flood_displaces_only_its_own_samples() -> None:
    box = Inbox(
        lambda: None,
        max_samples=3000,
        lossless=False,
        feeder_of=lambda key: key.split("/")[1].strip("?") or None,
    )
    quiet = [sample("calm", f"m{k}") for k in range(100)]
    box.put(quiet)
    beside = [sample("flooded", f"m{k}") for k in range(100)]
    box.put(beside)
    dropped = sum(box.put([sample("flooded", "liar", k)]) for k in range(20_000))
    dropped += sum(box.put([sample("?", f"m{k}")]) for k in range(5_000))
    assert len(box) <= 3000
    assert dropped + box.surplus == 25_200 - len(box)
    assert box.counts()["calm"] == (100, 0)
    assert box.counts()["flooded"] == (20_100, dropped)
    first = box.drain(100_000)
    assert set(quiet) <= set(first)
    assert sum(one.key.startswith("gridsec/flooded") for one in first) <= LANE_SAMPLES
    while more := box.drain(100_000):
        first += more
    assert sum(one.key.startswith("gridsec/?") for one in first) <= LANE_SAMPLES
    # Meters beside the flooding one keep their samples; of a flood the newest stay.
    assert set(beside) <= set(first)
    assert sample("flooded", "liar", 19_999) in first
    box.shed = frozenset({"calm"})
    assert box.put(quiet) == 0
    assert (len(box), box.counts()["calm"]) == (0, (200, 0))
    box.count("calm", 7, 0)
    box.count("new", 3, 2)
    assert (len(box), box.counts()["calm"], box.counts()["new"]) == (0, (207, 0), (3, 2))


# --- engine --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


def test_a_shed_feeder_is_undecided_and_no_meter_is_silent(site: Site, tmp_path: Path) -> None:
    other = from_tables(replace(site.tables, meta=replace(site.tables.meta, name="other")))
    wall = START + 0.0
    keys = [f"meter/{meter}" for meter in site.meter_ids] + ["substation"]
    box = Inbox(lambda: None, lossless=False, feeder_of=lambda key: key.split("/")[1])
    shown = set[int]()
    with Store(f"sqlite:///{tmp_path / 's.db'}") as store:
        live = Engine(RuntimeConfig(), store, [site, other], wall=lambda: wall, stored=lambda: None)
        for monitor in live.monitors.values():
            monitor.install(design(monitor.site))

        def seconds(number: int) -> None:
            nonlocal wall
            for _ in range(number):
                wall += 1.0
                payload = b'{"t": %.1f, "v_volt": 231.0, "p_kw": 0.1}' % wall
                for name in live.monitors:
                    box.put([Sample(f"gridsec/{name}/{key}/reading", payload, "", wall, 40) for key in keys])
                live.cycle(box.drain(10_000), box.oldest)
                wall += 0.6
                live.cycle([], box.oldest)
                wall -= 0.6
                # The metric states the feeders of the list, from the display on and until it ends.
                latest = [monitor.latest for monitor in live.monitors.values()]
                listed = sum(one is not None and one.summary["cause"] is Cause.OVERLOAD for one in latest)
                assert f"gridsec_feeders_shed {float(listed)}" in live.metrics.exposition().decode()
                shown.add(listed)

        def states() -> dict[str, Cause]:
            return {name: monitor.report.cause for name, monitor in live.monitors.items() if monitor.report}

        seconds(5)
        before = states()
        assert Cause.OVERLOAD not in before.values()
        live.load.shed = {"other": 0.0}
        live.follow_load(box)
        seconds(30)
        assert states() == {FEEDER: before[FEEDER], "other": Cause.OVERLOAD}
        report = live.monitors["other"].report
        assert report is not None
        assert (report.silent, "overloaded" in report.reason) == ((), True)
        assert [(one.kind, one.feeder) for one in store.active()] == [(AlarmKind.UNDECIDED, "other")]
        live.load.shed = {}
        live.follow_load(box)
        seconds(3)
        assert Cause.OVERLOAD not in states().values()
        assert all(meter.seen for meter in live.monitors["other"].report.meters)  # type: ignore[union-attr]
        seconds(8)
        assert store.active() == []
        assert "gridsec_feeders_shed 0.0" in live.metrics.exposition().decode()
        assert shown == {0, 1}
