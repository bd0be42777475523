"""Commands whose write takes its time: judging goes on meanwhile, and their outcome is taken in later."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import sqlalchemy as sa

from feeders.format.tables import to_json
from feeders.model.site import Site
from service.alarms.state_machine import AlarmState, AlreadyAcknowledged
from service.engine.engine import NOT_WATCHED, Engine, RuntimeConfig
from service.engine.feeder_monitor import FeederMonitor, design
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.store import OutcomeUnknown, Store
from service.store.committer import WriteResult
from service.store.schema import CommissioningChange
from tests.service.liars import FEEDER, START, until


class Slow:
    """Rounds with writes that are done when the test says so."""

    def __init__(self, site: Site, store: Store) -> None:
        self.writes: list[tuple[Callable[[], WriteResult], Callable[[WriteResult], None]]] = []
        self.store = store
        self.live = Engine(
            RuntimeConfig(clock=Clock.EVENTS),
            store,
            [site],
            wall=lambda: START,
            stored=lambda: None,
            apart=lambda write, then: self.writes.append((write, then)),
            # A clock at rest: no time budget ends a round early on a busy machine.
            clock=lambda: 0.0,
        )
        self.live.monitors[FEEDER].install(design(site))
        self.live.begin()
        self.land()

    @property
    def watch(self) -> FeederMonitor:
        return self.live.monitors[FEEDER]

    def land(self) -> None:
        """Do all writes, and those that follow from them."""
        while self.writes:
            write, then = self.writes.pop(0)
            then(write())
            self.live.committer.commit(at_once=True)

    def play(self, samples: list[Sample]) -> None:
        """Judge samples while nothing is written."""
        self.live.cycle(samples)
        assert len(self.writes) <= 1


def test_an_alarm_clears_while_its_acknowledgement_is_stored(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    before, after = until(attacked, 15.0)
    with Store(f"sqlite:///{path}") as store:
        slow = Slow(site, store)
        slow.play(before)
        slow.land()
        first, second = (alarm.id for alarm in store.active(FEEDER))
        answer = slow.live.acknowledge(first, "Ada", "on my way")
        slow.play(after)
        assert not answer.done()
        states = {alarm.id: (alarm.state, alarm.acknowledged_by) for alarm in slow.watch.book.alarms}
        assert states == {first: (AlarmState.CLEARED, None), second: (AlarmState.CLEARED, None)}
        slow.land()
        assert answer.result().acknowledged_by == "Ada"
        assert [str(event.change) for event in store.events(first)] == ["raised", "acknowledged", "cleared"]
        assert set(slow.watch.book.alarms) == set(store.alarms()[0])
        stored = {alarm.id: (alarm.state, alarm.acknowledged_by) for alarm in slow.watch.book.alarms}
        assert stored == {first: (AlarmState.CLEARED, "Ada"), second: (AlarmState.CLEARED, None)}
        number = store.last_event
        assert slow.live.acknowledge(first, "Ada", "on my way").result().acknowledged_by == "Ada"
        with pytest.raises(AlreadyAcknowledged):
            slow.live.acknowledge(first, "Ada", "something else")
        assert store.last_event == number


def test_a_write_of_unknown_outcome_is_repeated_before_anything_else(
    site: Site, attacked: list[Sample], path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is stored, and one that is not, without an answer to either."""
    before, after = until(attacked, 15.0)
    commit, rollback = sa.Connection.commit, sa.Connection.rollback
    with Store(f"sqlite:///{path}") as store:
        slow = Slow(site, store)
        slow.play(before)
        slow.land()
        for alarm, end in zip(store.active(FEEDER), (commit, rollback), strict=True):

            def broken(self: sa.Connection, end: Callable[[sa.Connection], None] = end) -> None:
                end(self)
                raise sa.exc.OperationalError("COMMIT", {}, OSError("gone"), connection_invalidated=True)

            answer = slow.live.acknowledge(alarm.id, "Ada", "")
            with monkeypatch.context() as patch:
                patch.setattr(sa.Connection, "commit", broken)
                write, then = slow.writes.pop()
                then(write())
            assert isinstance(answer.exception(), OutcomeUnknown)
            assert all(one.acknowledged_by is None for one in slow.watch.book.alarms if one.id == alarm.id)
            slow.play(after[: len(after) // 8])
            slow.live.committer.commit(at_once=True)
            slow.land()
            assert [str(event.change) for event in store.events(alarm.id)][:2] == ["raised", "acknowledged"]
            assert [one.acknowledged_by for one in slow.watch.book.alarms if one.id == alarm.id] == ["Ada"]
        assert set(slow.watch.book.active) == set(store.active(FEEDER))
        assert [event.seq for event in store.events_after(0)] == list(range(1, store.last_event + 1))


def test_alarms_that_rise_while_their_feeder_is_removed_do_not_stand(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    with Store(f"sqlite:///{path}") as store:
        slow = Slow(site, store)
        slow.play(until(attacked, 5.0)[0])
        slow.land()
        answer = slow.live.remove(FEEDER)
        slow.play(until(until(attacked, 5.0)[1], 15.0)[0])
        assert len(slow.watch.book.active) == 2
        slow.land()
        assert answer.result() is None
        assert (slow.live.monitors, store.active()) == ({}, [])
        slow.live.cycle([])
        slow.land()
        assert store.active() == []
        assert all(
            event.comment == NOT_WATCHED for event in store.events_after(0) if event.change == "cleared"
        )


def test_alarms_that_rise_while_their_feeder_is_put_are_gone_on_with(
    site: Site, attacked: list[Sample], path: Path
) -> None:
    with Store(f"sqlite:///{path}") as store:
        slow = Slow(site, store)
        slow.play(until(attacked, 5.0)[0])
        slow.land()
        known = slow.watch
        answer = slow.live.put(site, to_json(site.tables), lambda monitor: monitor.install(design(site)))
        slow.play(until(until(attacked, 5.0)[1], 15.0)[0])
        assert slow.watch is known
        slow.land()
        assert answer.result() is None
        assert slow.watch is not known
        assert [alarm.id for alarm in slow.watch.book.active] == [alarm.id for alarm in store.active()]
        assert len(store.active()) == 2
        assert slow.watch.commissioning.restored
        assert slow.watch.suspicions.known.same(known.suspicions.known)
        assert FEEDER in store.feeders()


def test_learning_anew_begins_when_it_is_stored(site: Site, attacked: list[Sample], path: Path) -> None:
    with Store(f"sqlite:///{path}") as store:
        slow = Slow(site, store)
        slow.play(until(attacked, 5.0)[0])
        slow.land()
        answer = slow.live.recommission(FEEDER, ["m01"], "Ada", "replaced")
        slow.play(until(until(attacked, 5.0)[1], 15.0)[0])
        assert slow.watch.commissioning.known is not None
        gathered = slow.watch.commissioning.known.learning
        slow.land()
        states = {one.meter: one for one in answer.result().meters}
        assert states["m01"].state == "learning"
        assert gathered is not slow.watch.commissioning.known.learning
        changes = [event.change for event in store.commission_events(FEEDER)]
        assert changes == [CommissioningChange.BEGUN, CommissioningChange.RECOMMISSIONED]
        assert store.commission(FEEDER) is not None
