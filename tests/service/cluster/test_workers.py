"""States of workers, calls for them, and owners of feeders by them."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count, pairwise
from typing import Any

import pytest
from structlog.testing import capture_logs

from service.cluster import forward as module
from service.cluster.forward import StateCalls, Workers
from service.cluster.messages import (
    GATHER_S,
    LONGEST_S,
    SHARE,
    Caller,
    CallServer,
    Entry,
    Envelope,
    StateReports,
    WorkerState,
    state_key,
)
from service.ingest.queues import BusUnavailable
from service.store.leases import shard_of

SHARD = shard_of("village")


class Heard:
    """Workers, and states of them in the order of their numbers."""

    def __init__(self) -> None:
        self.numbers: Iterator[int] = count(1)
        self.workers = Workers()

    def state(
        self, worker: str, epoch: int | None, verdict: str = "clean", order: tuple[int, int] | None = None
    ) -> WorkerState:
        shards = {} if epoch is None else {SHARD: epoch}
        entry = Entry({"name": "village"}, {"t": 1.0, "verdict": verdict, "age_s": 0.5})
        feeders = {} if epoch is None else {"village": entry}
        return WorkerState(worker, order or (1, next(self.numbers)), shards, feeders, 0, None, ())

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
    heard.workers.take(heard.state("w0", 1))
    assert heard.owner() == ("w0", 1)
    heard.workers.take(heard.state("w1", 2, "attacked"))
    assert heard.owner() == ("w1", 2)
    # The earlier owner continues after a freeze.
    heard.workers.take(heard.state("w0", 1))
    assert heard.owner() == ("w1", 2)
    assert heard.verdict() == "attacked"


def test_a_released_shard_has_no_owner() -> None:
    heard = Heard()
    heard.workers.take(heard.state("w0", 1))
    heard.workers.take(heard.state("w0", None))
    assert heard.owner() is None
    assert heard.workers.entry("village") is None


def test_a_silent_worker_owns_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = Heard()
    heard.workers.take(heard.state("w0", 1))
    monkeypatch.setattr(module, "HEARD_S", 0.0)
    assert heard.owner() is None
    assert heard.workers.states() == []
    assert heard.workers.last_entry("village") is not None
    assert heard.workers.last_entry("town") is None


def test_an_overtaken_state_changes_nothing() -> None:
    heard = Heard()
    first, second = heard.state("w0", 1), heard.state("w0", 1, "attacked")
    heard.workers.take(second)
    heard.workers.take(first)
    assert heard.verdict() == "attacked"


def test_a_restarted_worker_is_heard_at_once() -> None:
    heard = Heard()
    heard.workers.take(heard.state("w0", 1, order=(1, 1000)))
    heard.workers.take(heard.state("w0", 2, "attacked", order=(2, 1)))
    assert heard.verdict() == "attacked"


def test_the_age_of_a_tick_includes_the_time_since_the_state() -> None:
    heard = Heard()
    heard.workers.take(heard.state("w0", 1))
    sent = time.monotonic()
    time.sleep(0.05)
    entry = heard.workers.entry("village")
    assert entry is not None
    assert 0.05 <= entry.now["age_s"] - 0.5 <= time.monotonic() - sent + 0.05


class Line:
    """The way from a front to the worker `w0`, with false replies before the answer."""

    def __init__(self) -> None:
        self.now = 1e9
        self.key = state_key("w0")
        self.loop = asyncio.new_event_loop()
        self.states = Heard()
        self.server = CallServer(self.key, self.envelope(), self.loop, self.take)
        self.false: list[bytes] = []
        self.kept: list[bytes] = []

    def envelope(self, secret: bytes = b"secret") -> Envelope:
        return Envelope(secret, lambda: self.now)

    def take(self, _: object, answer: Callable[[dict[str, Any]], None]) -> None:
        answer(self.states.state("w0", 1).content())

    def ask(self, _: str, payload: bytes, limit_s: float) -> Iterator[bytes]:
        yield from self.false
        answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.server(payload, answers.put)
        self.kept.append(answers.get(timeout=limit_s))
        yield self.kept[-1]


@pytest.fixture
def line() -> Iterator[Line]:
    """A worker that answers each call with the state of one feeder."""
    made = Line()
    thread = threading.Thread(target=made.loop.run_forever, daemon=True)
    thread.start()
    yield made
    made.loop.call_soon_threadsafe(made.loop.stop)
    thread.join(5.0)
    made.loop.close()


def test_false_replies_hide_no_state(line: Line) -> None:
    workers, envelope, answer = Workers(), line.envelope(), f"answer {line.key}"
    calls = StateCalls(workers, Caller(line.ask, envelope))
    assert calls.ask_blocking("w0")
    # An answer to an earlier call is none to this one.
    line.false = [
        b"",
        line.envelope(b"guess").seal(answer, {"to": ""}),
        envelope.seal(answer, {}),
        *line.kept,
    ]
    with capture_logs() as lines:
        assert calls.ask_blocking("w0")
    assert [entry["log_level"] for entry in lines] == ["warning"]
    assert workers.states()[0].order == (1, 2)
    assert Caller(line.ask, line.envelope(b"guess")).call(line.key, {}, 0.2) is None


@pytest.mark.parametrize("leap_s", [3600.0, -3600.0, -10.0])
def test_a_leap_of_the_clock_of_the_database_silences_no_worker(line: Line, leap_s: float) -> None:
    workers = Workers()
    calls = StateCalls(workers, Caller(line.ask, line.envelope()))
    assert calls.ask_blocking("w0")
    line.now += leap_s
    assert calls.ask_blocking("w0")
    assert workers.states()[0].order == (1, 2)


def test_a_blocked_reply_does_not_hold_up_the_event_loop(line: Line) -> None:
    goes_on = threading.Event()
    line.server(line.envelope().seal(f"call {line.key}", {}), lambda _: bool(goes_on.wait(20.0)))
    workers = Workers()
    assert StateCalls(workers, Caller(line.ask, line.envelope())).ask_blocking("w0")
    goes_on.set()


def test_the_live_workers_are_asked_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "AGAIN_S", 0.01)
    asked: list[str] = []

    def ask(key: str, _: bytes, __: float) -> list[bytes]:
        asked.append(key)
        if len(asked) % 2:
            raise BusUnavailable("zenoh query: no session", code="query-failed")
        raise RuntimeError("no thread")

    async def keys(calls: StateCalls, *names: str) -> set[str]:
        """Asked keys while these workers are live."""
        calls.follow(names)
        await asyncio.sleep(0.2)
        asked.clear()
        await asyncio.sleep(0.5)
        return set(asked)

    async def run() -> None:
        calls = StateCalls(Workers(), Caller(ask, Envelope(b"secret")))
        assert await keys(calls, "w0", "w1") == {state_key("w0"), state_key("w1")}
        assert await keys(calls, "w0") == {state_key("w0")}
        assert await keys(calls) == set()

    asyncio.run(asyncio.wait_for(run(), 60.0))


def test_a_flood_of_forged_calls_has_one_line_of_the_log(line: Line) -> None:
    replies: list[bytes] = []
    with capture_logs() as lines:
        for _ in range(1000):
            line.server(b"0" * 200, replies.append)
    assert replies == [b""] * 1000
    assert [(entry["messages"], entry["log_level"]) for entry in lines] == [(1, "warning")]
    assert StateCalls(Workers(), Caller(line.ask, line.envelope())).ask_blocking("w0")


@pytest.mark.canary("0.0-0.25", "0.015-0.5")
@pytest.mark.parametrize(
    ("cost_s", "interval_s"), [(0.0, GATHER_S), (0.5 * SHARE, 0.5), (1.0, LONGEST_S)], ids=str
)
def test_the_states_of_many_feeders_are_rarer(
    cost_s: float, interval_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    spent, told = [0.0], list[float]()
    monkeypatch.setattr(time, "thread_time", lambda: spent[0])

    def content() -> dict[str, Any]:
        spent[0] += cost_s
        return {}

    async def run() -> None:
        news = asyncio.Event()
        reports = StateReports(content, news)
        task = asyncio.create_task(reports.run())
        while len(told) < 4:
            answered = asyncio.Event()
            reports.take({}, lambda _: answered.set())  # noqa: B023
            while not answered.is_set():
                news.set()
                await asyncio.sleep(0.01)
            told.append(time.monotonic())
        task.cancel()

    asyncio.run(asyncio.wait_for(run(), 60.0))
    assert min(later - earlier for earlier, later in pairwise(told)) == pytest.approx(
        interval_s, rel=0.05, abs=0.05
    )


def test_one_state_answers_all_waiting_fronts() -> None:
    made: list[dict[str, Any]] = []

    def content() -> dict[str, Any]:
        made.append({"number": len(made)})
        return made[-1]

    async def run() -> list[dict[str, Any]]:
        reports, found = StateReports(content, asyncio.Event()), list[dict[str, Any]]()
        for _ in range(3):
            reports.take({}, found.append)
        task = asyncio.create_task(reports.run())
        await asyncio.sleep(0.05)
        task.cancel()
        return found

    assert asyncio.run(run()) == [{"number": 0}] * 3
    assert len(made) == 1
