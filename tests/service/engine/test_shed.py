"""Shed feeders: their alarms last unread, and they can be removed and put again."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from feeders.model.site import Site, from_tables
from gridsec.interface import Cause
from service.alarms.state_machine import AlarmKind
from service.engine.engine import Engine, RuntimeConfig
from service.engine.feeder_monitor import MISMATCH_S, PARTIAL, design
from service.ingest.align import Clock
from service.ingest.queues import Inbox, Sample
from service.report.feeder_info import SHED_TICK_S
from service.store import Store
from tests.service.liars import FEEDER, START

OTHER = "other"
QUIET_VOLT = 230.9
OFFSET_S = 5.0
"""Error of the clock of a meter, s: above the tolerance of the alignment."""
OUTAGE = (AlarmKind.DATA_LOSS, None)


class Pair:
    """Two equal feeders at no load by the wall clock, the second of which is shed."""

    def __init__(self, site: Site, store: Store, t: float = START) -> None:
        self.store, self.wall = store, t
        self.results: list[tuple[str, float]] = []  # feeder and time of each tick
        self.other = from_tables(replace(site.tables, meta=replace(site.tables.meta, name=OTHER)))
        self.box = Inbox(lambda: None, lossless=False, feeder_of=lambda key: key.split("/")[1])
        self.live = Engine(
            RuntimeConfig(clock=Clock.WALL),
            store,
            [site, self.other],
            wall=lambda: self.wall,
            stored=lambda: None,
        )
        for monitor in self.live.monitors.values():
            monitor.install(design(monitor.site))
        self.live.begin()

    def shed(self, *names: str) -> None:
        """Shed these feeders, and monitor all others."""
        self.live.load.shed = dict.fromkeys(names, 0.0)
        self.live.follow_load(self.box)

    def run(
        self, seconds: int, *, silent: Collection[str] = (), late: str = "", refused: Collection[str] = ()
    ) -> None:
        """Readings of each second.

        silent: feeders without readings.
        late: meter of the second feeder with an error of the clock.
        refused: meters of the second feeder with a reading of another identity.
        """
        for _ in range(seconds):
            self.wall += 0.05
            for name in set(self.live.monitors) - {*silent}:
                self.box.put(list(self._samples(name, late if name == OTHER else "")))
            for meter in refused:
                self.live.monitors[OTHER].refuse(meter, "the signature does not fit")
            self._cycle(self.box.drain(10_000))
            self.wall += 0.85
            self._cycle([])
            self.wall += 0.1

    def _cycle(self, samples: list[Sample]) -> None:
        before = {name: monitor.latest for name, monitor in self.live.monitors.items()}
        self.live.cycle(samples, self.box.oldest)
        for name, monitor in self.live.monitors.items():
            if monitor.latest is not None and monitor.latest is not before.get(name):
                self.results.append((name, monitor.latest.t))

    def _samples(self, name: str, late: str) -> Iterator[Sample]:
        for meter in ("substation", *self.other.meter_ids):
            age = OFFSET_S if meter == late else 0.05
            payload = json.dumps({"t": self.wall - age, "v_volt": QUIET_VOLT, "p_kw": 0.0, "q_kvar": 0.0})
            place = meter if meter == "substation" else f"meter/{meter}"
            yield Sample(f"gridsec/{name}/{place}/reading", payload.encode(), "", self.wall, len(payload))

    def standing(self) -> set[tuple[AlarmKind, str | None]]:
        return {(alarm.kind, alarm.meter) for alarm in self.store.active(OTHER)}

    def ticks(self, verdict: str = "undecided") -> float:
        """Number of ticks of the second feeder in the metrics."""
        lines = self.live.metrics.exposition().decode().splitlines()
        start = f'gridsec_ticks_total{{feeder="{OTHER}",verdict="{verdict}"}} '
        return sum(float(line.removeprefix(start)) for line in lines if line.startswith(start))

    def cause(self) -> Cause:
        report = self.live.monitors[OTHER].report
        assert report is not None
        return report.cause


@pytest.fixture
def pair(site: Site, tmp_path: Path) -> Iterator[Pair]:
    with Store(f"sqlite:///{tmp_path / 's.db'}") as store:
        yield Pair(site, store)


def test_ticks_of_shed_feeders_are_rare_once_they_are_displayed(pair: Pair) -> None:
    pair.run(3)
    pair.shed(FEEDER, OTHER)
    pair.run(4)
    # Display and alarm have their delays as with every other cause.
    assert pair.live.monitors[OTHER].latest is not None
    assert pair.live.monitors[OTHER].latest.summary["cause"] is Cause.OVERLOAD
    assert (AlarmKind.UNDECIDED, None) in pair.standing()
    pair.results.clear()
    before, last = pair.ticks(), pair.live.monitors[OTHER].latest
    pair.run(60)
    for name in (FEEDER, OTHER):
        ticks = [t for feeder, t in pair.results if feeder == name]
        if name == OTHER:
            # A rare tick stands for those that were not formed: shares of ticks are shares of time.
            assert last is not None
            assert pair.ticks() - before == ticks[-1] - last.t
        assert len(ticks) in (4, 5)
        assert {round(after - one) for one, after in pairwise(ticks)} == {round(SHED_TICK_S)}
    # Not in the same round.
    assert len({t % SHED_TICK_S for _, t in pair.results}) == 2
    # A skipped tick is a sign of overload.
    assert [monitor.skipped for monitor in pair.live.monitors.values()] == [0, 0]


def test_ticks_of_all_verdicts_are_the_time_over_several_returns(pair: Pair) -> None:
    pair.run(14)
    monitor = pair.live.monitors[OTHER]
    assert monitor.latest is not None
    before, begun = pair.ticks() + pair.ticks(verdict="clean"), monitor.latest.t
    for _ in range(3):
        pair.shed(OTHER)
        pair.run(33)
        pair.shed()
        pair.run(5)
    counted = pair.ticks() + pair.ticks(verdict="clean") - before
    assert counted == monitor.latest.t - begun
    assert pair.ticks() > 60


def test_a_leap_of_the_clock_while_a_feeder_is_shed_is_skipped_ticks(pair: Pair) -> None:
    pair.run(14)
    pair.shed(OTHER)
    pair.run(20)
    before, skipped = pair.ticks(), pair.live.monitors[OTHER].skipped
    pair.wall += 3600.0
    pair.run(16)
    assert pair.ticks() - before < 4 * SHED_TICK_S
    assert pair.live.monitors[OTHER].skipped - skipped > 3500


def test_rare_states_of_a_shed_feeder_are_not_stale(pair: Pair) -> None:
    monitor = pair.live.monitors[OTHER]

    def age() -> float:
        assert monitor.latest is not None
        return pair.wall - monitor.latest.t

    pair.run(14)
    assert monitor.stale(monitor.patience_s + 0.1)
    pair.shed(OTHER)
    ages = []
    for _ in range(3 * round(SHED_TICK_S)):
        pair.run(1)
        ages.append(age())
        assert not monitor.stale(ages[-1])
    assert max(ages) > SHED_TICK_S - 2.0
    while age() < SHED_TICK_S - 2.0:
        pair.run(1)
    pair.shed()
    # The latest state is still the rare one until the first tick after the return.
    assert age() > monitor.patience_s
    assert not monitor.stale(age())
    assert monitor.stale(monitor.patience_s + SHED_TICK_S + 0.1)
    pair.run(8)
    assert not monitor.stale(age())
    assert monitor.stale(monitor.patience_s + 0.1)


@pytest.mark.canary("29")
@pytest.mark.parametrize("rest_s", [16, 29, 44])
def test_the_return_of_a_shed_feeder_is_one_tick_without_silence(pair: Pair, rest_s: int) -> None:
    pair.run(14)
    pair.shed(OTHER)
    pair.run(rest_s)
    pair.results.clear()
    pair.shed()
    for _ in range(16):
        pair.run(1)
        latest = pair.live.monitors[OTHER].latest
        assert latest is not None
        assert latest.tick.silent == ()
        assert latest.t > pair.wall - 2.0
    ticks = [t for feeder, t in pair.results if feeder == OTHER]
    assert len(ticks) <= 17
    assert pair.live.monitors[OTHER].skipped == 0
    assert not any(alarm.kind is AlarmKind.DATA_LOSS for alarm in pair.store.alarms(feeder=OTHER)[0])


def test_ticks_with_a_part_of_the_readings_after_a_return_are_not_judged(pair: Pair) -> None:
    """The return is between the readings of a second: half of them were discarded."""
    pair.run(20)
    pair.shed(OTHER)
    pair.run(3)
    pair.wall += 0.05
    samples = list(pair._samples(OTHER, ""))
    pair.box.put(samples[:7])
    pair.shed()
    pair.box.put(samples[7:])
    pair._cycle(pair.box.drain(10_000))
    pair.wall += 0.85
    pair._cycle([])
    pair.wall += 0.1
    whole = []
    for _ in range(5):
        latest = pair.live.monitors[OTHER].latest
        assert latest is not None
        whole.append((pair.cause() is not Cause.OVERLOAD, bool(latest.tick.seen.all())))
        pair.run(1)
    assert (False, False) in whole
    assert whole[PARTIAL:] == [(True, True)] * (5 - PARTIAL)


def test_a_shed_feeder_can_be_removed(pair: Pair) -> None:
    pair.run(2)
    pair.shed(OTHER)
    pair.live.remove(OTHER).result(timeout=0)
    pair.shed()
    pair.run(3)
    assert (pair.box.shed, set(pair.live.monitors)) == (frozenset(), {FEEDER})
    report = pair.live.monitors[FEEDER].report
    assert report is not None
    assert report.t > pair.wall - 2.0


def test_a_shed_feeder_that_is_put_again_stays_shed(pair: Pair) -> None:
    pair.run(3)
    pair.shed(OTHER)
    pair.run(2)
    offered = pair.live.load.feeders[OTHER].offered = pair.box.counts()[OTHER].offered
    pair.live.add(pair.other).install(design(pair.other))
    # The count of its samples goes on: the next window sees no flood.
    assert pair.live.load.feeders[OTHER].offered == offered > 0
    pair.run(16)
    assert (pair.cause(), pair.standing()) == (Cause.OVERLOAD, {(AlarmKind.UNDECIDED, None)})
    pair.shed()
    # Two ticks are not judged, the observer settles, and the alarm clears 5 s after that.
    pair.run(12)
    assert pair.cause() is not Cause.OVERLOAD
    assert pair.standing() == set()


def test_an_outage_lasts_while_its_feeder_is_shed_and_after_a_restart(site: Site, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 's.db'}"
    with Store(url) as store:
        pair = Pair(site, store)
        pair.run(3)
        pair.run(16, silent={OTHER})
        assert OUTAGE in pair.standing()
        (outage,) = store.alarms(feeder=OTHER, kind=["data-loss"])[0]
        pair.shed(OTHER)
        pair.run(12, silent={OTHER})
        assert OUTAGE in pair.standing()
        pair.shed()
        pair.run(3, silent={OTHER})
        t = pair.wall
    with Store(url) as store:
        pair = Pair(site, store, t)
        # Before the meters are silent again, and after it.
        pair.run(8, silent={OTHER})
        assert OUTAGE in pair.standing()
        pair.run(8, silent={OTHER})
        (still,) = store.alarms(feeder=OTHER, kind=["data-loss"])[0]
        assert (still.id, still.count, still.active) == (outage.id, 1, True)
        pair.run(10)
        assert pair.standing() == set()


def test_alarms_that_depend_on_payloads_last_while_their_feeder_is_shed(pair: Pair) -> None:
    late, refused = pair.other.meter_ids[2], pair.other.meter_ids[0]
    expected = {(AlarmKind.CLOCK_OFFSET, late), (AlarmKind.IDENTITY_MISMATCH, refused)}
    pair.run(20, late=late, refused=(refused,))
    assert expected <= pair.standing()
    pair.shed(OTHER)
    pair.run(int(MISMATCH_S) + 10)
    assert expected <= pair.standing()
    pair.shed()
    # The refused identity lasts from the return on, longer than `off_delay_s`.
    pair.run(12)
    assert (AlarmKind.IDENTITY_MISMATCH, refused) in pair.standing()
    pair.run(int(MISMATCH_S) + 10)
    assert pair.standing() == set()
