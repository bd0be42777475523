"""Owners of feeders by the messages of workers."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import pytest

from service.cluster import forward as module
from service.cluster.forward import Workers
from service.cluster.messages import STATES, Entry, Envelope, WorkerState
from service.store.leases import shard_of

SHARD = shard_of("village")


class Heard:
    """Workers, and messages to them at consecutive times."""

    def __init__(self) -> None:
        self.clock: Iterator[float] = map(float, count(1_000))
        self.sender = Envelope(b"secret", lambda: next(self.clock))
        self.workers = Workers(Envelope(b"secret", lambda: 1_010.0))

    def message(self, worker: str, epoch: int | None, verdict: str = "clean") -> bytes:
        shards = {} if epoch is None else {SHARD: epoch}
        entry = Entry({"name": "village"}, {"t": 1.0, "verdict": verdict})
        feeders = {} if epoch is None else {"village": entry}
        return self.sender.seal(STATES, WorkerState(worker, 0.0, shards, feeders, 0, None, ()).content())

    def owner(self) -> tuple[str, int] | None:
        found = self.workers.owner("village")
        return None if found is None else (found[0].worker, found[1])


def test_the_highest_epoch_owns_a_feeder() -> None:
    heard = Heard()
    assert heard.owner() is None
    heard.workers.take(heard.message("w0", 1))
    assert heard.owner() == ("w0", 1)
    heard.workers.take(heard.message("w1", 2, "attacked"))
    assert heard.owner() == ("w1", 2)
    # The earlier owner continues after a freeze.
    heard.workers.take(heard.message("w0", 1))
    assert heard.owner() == ("w1", 2)
    entry = heard.workers.entry("village")
    assert entry is not None
    assert entry.now["verdict"] == "attacked"


def test_a_released_shard_has_no_owner() -> None:
    heard = Heard()
    heard.workers.take(heard.message("w0", 1))
    heard.workers.take(heard.message("w0", None))
    assert heard.owner() is None
    assert heard.workers.entry("village") is None


def test_a_silent_worker_owns_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = Heard()
    heard.workers.take(heard.message("w0", 1))
    monkeypatch.setattr(module, "HEARD_S", 0.0)
    assert heard.owner() is None
    assert heard.workers.states() == []
    assert heard.workers.last_entry("village") is not None
    assert heard.workers.last_entry("town") is None


def test_repeated_and_forged_messages_change_nothing() -> None:
    heard = Heard()
    first, second = heard.message("w0", 1), heard.message("w0", 1, "attacked")
    for message in (second, first, b"", Envelope(b"other").seal(STATES, {}), heard.sender.seal(STATES, {})):
        heard.workers.take(message)
    entry = heard.workers.entry("village")
    assert entry is not None
    assert entry.now["verdict"] == "attacked"
