"""Alarms of feeders that are not stored any more, in the shards of a worker."""

from __future__ import annotations

import pytest

from service.engine.engine import NOT_WATCHED, Engine, RuntimeConfig
from service.engine.orphans import ORPHAN_S, Orphans, Standing
from service.store import Store, leases
from service.store.leases import Lease
from tests.service.asking import T0
from tests.service.databases import Cluster
from tests.service.store.test_leases import settle
from tests.service.store.test_workers import Worker
from tests.service.stored import an_alarm, raised


@pytest.mark.postgresql
def test_alarms_of_removed_feeders_are_cleared_after_a_claim(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "SETTLE_S", 0.0)
    url, names = cluster.database(), ("removed", "stored", "late")
    with Store(url) as alone:
        alone.commit([raised(an_alarm(k, feeder=name)) for k, name in enumerate(names)])
        alone.commit(put=("stored", {}))
    clock = [0.0]
    worker = Worker(url, "a")
    store = worker.store
    live = Engine(
        RuntimeConfig(), store, [], wall=lambda: T0 + 60, stored=lambda: None, clock=lambda: clock[0]
    )

    def active(t: float) -> set[str]:
        """Feeders with active alarms after a cycle at a monotonic time, s."""
        clock[0] = t
        live.cycle([])
        return {alarm.feeder for alarm in store.active()}

    live.begin()
    assert active(-1.0) == set(names)
    settle(worker.leases)
    assert active(0.0) == set(names)
    # The front has put one more feeder since.
    store.commit(put=("late", {}))
    assert active(ORPHAN_S) == active(1.9 * ORPHAN_S) == set(names)
    assert active(2.0 * ORPHAN_S) == {"stored", "late"}
    assert store.events(an_alarm(0).id)[-1].comment == NOT_WATCHED
    number = store.last_event
    assert active(9.0 * ORPHAN_S) == {"stored", "late"}
    assert store.last_event == number
    worker.close()


def test_orphans_need_equal_leases_and_feeders_at_two_reads() -> None:
    alarms = (an_alarm(0, feeder="removed"), an_alarm(1, feeder="here"))
    old, new = {1: Lease(1, 1)}, {1: Lease(1, 1), 2: Lease(2, 1)}
    orphans = Orphans()
    assert not orphans.due({}, 0.0)
    assert orphans.due(old, 0.0)
    assert not orphans.due(old, 0.9 * ORPHAN_S)
    assert orphans.due(new, ORPHAN_S)
    reads = [Standing(old, {}, alarms), Standing(new, {}, alarms), Standing(new, {"a": 1}, alarms)]
    assert [orphans.found(read, ["here"]) for read in reads] == [[], [], []]
    assert orphans.found(Standing(new, {"a": 1}, alarms), ["here"]) == [alarms[0]]
    assert not orphans.due(new, 5.0 * ORPHAN_S)
    assert orphans.due(dict(new), 5.0 * ORPHAN_S)
