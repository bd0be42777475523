"""Messages of the workers to the front: leases, and the entries of their feeders in the list.

A worker sends one on `@worker/<worker>/state` after new ticks, at most every `GATHER_S`, and at least every
`SILENT_S`. About 0.6 kB for each feeder.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from service.cluster.envelope import Envelope

GATHER_S: Final = 0.25
"""Shortest interval of the messages, s."""
SILENT_S: Final = 0.5
"""Longest interval of the messages, s."""
STATES: Final = "@worker/*/state"
"""Keys of the messages of all workers, without the prefix."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One feeder of a worker."""

    fields: Mapping[str, Any]  # as of `Backend.feeders`
    now: Mapping[str, Any]  # as of `Backend.summary`

    @property
    def t(self) -> float | None:
        """Unix time of its latest tick, s; None before the first one."""
        return self.now.get("t")


@dataclass(frozen=True, slots=True)
class WorkerState:
    """State of one worker."""

    worker: str
    t: float  # wall time of the message, Unix s
    shards: Mapping[int, int]  # epoch of its lease by shard
    feeders: Mapping[str, Entry]
    unstored: int  # changes of alarms that wait for the database
    problem: str | None  # problem of the database
    reasons: tuple[str, ...]  # reasons why it is not ready

    def content(self) -> dict[str, Any]:
        """Content of its message."""
        return {
            "worker": self.worker,
            "shards": dict(self.shards),
            "feeders": [[dict(one.fields), dict(one.now)] for one in self.feeders.values()],
            "unstored": self.unstored,
            "problem": self.problem,
            "reasons": list(self.reasons),
        }

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> WorkerState:
        """The state of a message."""
        return cls(
            content["worker"],
            content["t"],
            content["shards"],
            {fields["name"]: Entry(fields, now) for fields, now in content["feeders"]},
            content["unstored"],
            content["problem"],
            tuple(content["reasons"]),
        )


def state_key(worker: str) -> str:
    """Key of the messages of a worker, without the prefix."""
    return f"@worker/{worker}/state"


async def report_states(
    content: Callable[[], dict[str, Any]],
    tell: Callable[[str, bytes], None],
    worker: str,
    envelope: Envelope,
    news: asyncio.Event,
) -> None:
    """Send the state of a worker until cancelled; `news` is set after new ticks."""
    key = state_key(worker)
    while True:
        news.clear()
        tell(key, envelope.seal(STATES, content()))
        await asyncio.sleep(GATHER_S)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(news.wait(), SILENT_S - GATHER_S)
