"""Owners of feeders by the messages of workers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from itertools import count, pairwise
from typing import Any

import pytest
from structlog.testing import capture_logs

from service.cluster import forward as module
from service.cluster.forward import Workers
from service.cluster.messages import (
    GATHER_S,
    LONGEST_S,
    SHARE,
    STATES,
    Entry,
    Envelope,
    WorkerState,
    report_states,
)
from service.store.leases import shard_of

SHARD = shard_of("village")


class Heard:
    """Workers, and messages to them at consecutive times."""

    def __init__(self) -> None:
        self.now = 1_000.0
        self.numbers: Iterator[int] = count(1)
        self.sender = Envelope(b"secret", lambda: self.now)
        self.workers = Workers(Envelope(b"secret", lambda: self.now))

    def message(
        self, worker: str, epoch: int | None, verdict: str = "clean", order: tuple[int, int] | None = None
    ) -> bytes:
        shards = {} if epoch is None else {SHARD: epoch}
        entry = Entry({"name": "village"}, {"t": 1.0, "verdict": verdict, "age_s": 0.5})
        feeders = {} if epoch is None else {"village": entry}
        order = order or (1, next(self.numbers))
        return self.sender.seal(STATES, WorkerState(worker, order, shards, feeders, 0, None, ()).content())

    def verdict(self) -> str:
        entry = self.workers.entry("village")
        assert entry is not None
        return str(entry.now["verdict"])

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
    assert heard.verdict() == "attacked"


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
    assert heard.verdict() == "attacked"


@pytest.mark.parametrize("leap_s", [3600.0, -3600.0, -10.0])
def test_a_leap_of_the_clock_of_the_database_silences_no_worker(leap_s: float) -> None:
    heard = Heard()
    heard.workers.take(heard.message("w0", 1))
    heard.now += leap_s
    heard.workers.take(heard.message("w0", 1, "attacked"))
    assert heard.verdict() == "attacked"


def test_a_restarted_worker_is_heard_at_once() -> None:
    heard = Heard()
    heard.workers.take(heard.message("w0", 1, order=(1, 1000)))
    heard.workers.take(heard.message("w0", 2, "attacked", order=(2, 1)))
    assert heard.verdict() == "attacked"


def test_the_age_of_a_tick_includes_the_time_since_the_message() -> None:
    heard = Heard()
    heard.workers.take(heard.message("w0", 1))
    sent = time.monotonic()
    time.sleep(0.05)
    entry = heard.workers.entry("village")
    assert entry is not None
    assert 0.05 <= entry.now["age_s"] - 0.5 <= time.monotonic() - sent + 0.05


def test_a_flood_of_forged_messages_has_one_line_of_the_log() -> None:
    heard = Heard()
    with capture_logs() as lines:
        for _ in range(1000):
            heard.workers.take(b"0" * 200)
        heard.workers.take(heard.message("w0", 1))
    assert [(line["messages"], line["log_level"]) for line in lines] == [(1, "warning")]
    assert heard.owner() == ("w0", 1)


@pytest.mark.parametrize(
    ("cost_s", "interval_s"), [(0.0, GATHER_S), (0.5 * SHARE, 0.5), (1.0, LONGEST_S)], ids=str
)
def test_the_messages_of_many_feeders_are_rarer(
    cost_s: float, interval_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    spent, told = [0.0], list[float]()
    monkeypatch.setattr(time, "thread_time", lambda: spent[0])

    def content() -> dict[str, Any]:
        spent[0] += cost_s
        return {}

    async def run() -> None:
        news, enough = asyncio.Event(), asyncio.Event()

        def tell(*_: object) -> None:
            told.append(time.monotonic())
            if len(told) == 4:
                enough.set()

        task = asyncio.create_task(report_states(content, tell, "w0", Envelope(b""), news))
        while not enough.is_set():
            news.set()
            await asyncio.sleep(0.01)
        task.cancel()

    asyncio.run(asyncio.wait_for(run(), 60.0))
    assert min(later - earlier for earlier, later in pairwise(told)) == pytest.approx(
        interval_s, rel=0.05, abs=0.05
    )
