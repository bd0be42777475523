"""Owners of the feeders by the states of the workers, and forwarding of requests to them.

Each live worker is asked for its state, one call at a time. The newest state with the highest epoch of a
shard counts. A worker is silent after `HEARD_S` without a state: its feeders then have no owner, until
another worker reports their shards.

A request with a feeder in its path goes to the owner of this feeder. A command on an alarm, incident, shelf
or planned work goes to the owner of its feeder. All other requests are answered by the front.
"""

from __future__ import annotations

import asyncio
import json
import math
import re
import threading
import time
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread
from starlette.requests import Request
from starlette.responses import Response

from service.access.identity import OPEN, Identity
from service.alarms.state_machine import AlarmUnknown
from service.cluster.messages import (
    FORWARDED,
    Answer,
    Call,
    Caller,
    Entry,
    Refusals,
    WorkerState,
    rest_key,
    state_key,
)
from service.errors import FeederFixed, NoOwner, TooManyFeeders, WorkerBusy
from service.store import OutcomeUnknown
from service.store.leases import shard_of
from service.store.store import Reader

HEARD_S: Final = 3.0
"""Age of a worker's last state after which it is silent, s."""
FORGET_S: Final = 3600.0
"""Age after which its last state is forgotten, s."""


@dataclass(frozen=True, slots=True)
class _Heard:
    at: float  # monotonic s
    state: WorkerState


class Workers:
    """The heard workers. Thread-safe.

    changed: called after a state, from the thread that took it.
    """

    def __init__(self) -> None:
        self.changed: Callable[[], None] = lambda: None
        self._lock = threading.Lock()
        self._heard: dict[str, _Heard] = {}
        self._owners: dict[int, tuple[int, str]] = {}

    def take(self, state: WorkerState) -> None:
        """Take a state."""
        now = time.monotonic()
        with self._lock:
            before = self._heard.get(state.worker)
            if before is not None and state.order <= before.state.order:
                return  # of an earlier process with this name
            self._heard[state.worker] = _Heard(now, state)
            for name in [one for one, kept in self._heard.items() if now - kept.at > FORGET_S]:
                del self._heard[name]
            for shard, epoch in state.shards.items():
                if epoch >= self._owners.get(shard, (0, ""))[0]:
                    self._owners[shard] = (epoch, state.worker)
        self.changed()

    def states(self) -> list[WorkerState]:
        """Latest states of the workers that are not silent."""
        limit = time.monotonic() - HEARD_S
        with self._lock:
            return [one.state for one in self._heard.values() if one.at >= limit]

    def owner(self, feeder: str) -> tuple[WorkerState, int] | None:
        """State of the worker that monitors a feeder, and its epoch; None if no worker does."""
        shard = shard_of(feeder)
        with self._lock:
            epoch, name = self._owners.get(shard, (0, ""))
            heard = self._heard.get(name)
        if heard is None or time.monotonic() - heard.at > HEARD_S or heard.state.shards.get(shard) != epoch:
            return None
        return heard.state, epoch

    def entry(self, feeder: str) -> Entry | None:
        """Entry of a feeder by its owner; None without an owner, or before it has taken over.

        The age of its tick includes the time since the state.
        """
        found = self.owner(feeder)
        entry = None if found is None else found[0].feeders.get(feeder)
        if found is None or entry is None or entry.now.get("age_s") is None:
            return entry
        with self._lock:
            since_s = time.monotonic() - self._heard[found[0].worker].at
        return replace(entry, now={**entry.now, "age_s": entry.now["age_s"] + since_s})

    def last_entry(self, feeder: str) -> Entry | None:
        """Latest entry of a feeder, also of a silent worker; None before the first one."""
        with self._lock:
            found = [one for one in self._heard.values() if feeder in one.state.feeders]
        return max(found, key=lambda one: one.at).state.feeders[feeder] if found else None


STATE_S: Final = 1.0
"""Time limit of a call for a state, s; a late state answers the next call."""
AGAIN_S: Final = 0.1
"""Wait after a call without an answer, s."""


class StateCalls:
    """Calls for the states of the live workers, one at a time for each.

    workers: takes the states.
    """

    def __init__(self, workers: Workers, caller: Caller) -> None:
        self._workers, self._caller = workers, caller
        self._threads = CapacityLimiter(math.inf)
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._refusals = Refusals("states of workers cannot be read")

    def follow(self, names: Collection[str]) -> None:
        """Ask exactly these workers, in the running event loop."""
        for name in self._tasks.keys() - set(names):
            self._tasks.pop(name).cancel()
        for name in set(names) - self._tasks.keys():
            self._tasks[name] = asyncio.create_task(self._ask_again(name), name=f"state of {name}")

    async def _ask_again(self, worker: str) -> None:
        while True:
            try:
                answered = await to_thread.run_sync(
                    self.ask_blocking, worker, abandon_on_cancel=True, limiter=self._threads
                )
            except Exception as error:  # noqa: BLE001 - the worker would never be heard again
                self._refusals.note(repr(error))
                answered = False
            if not answered:
                await asyncio.sleep(AGAIN_S)

    def ask_blocking(self, worker: str) -> bool:
        """Take the next state of a worker; False without one. Blocks. Raises KeyError for another version."""
        found = self._caller.call(state_key(worker), {}, STATE_S)
        if found is None:
            return False
        self._workers.take(WorkerState.of(found))
        return True


ANSWER_S: Final = 15.0
"""Time limit of an answer, s: above the time limit of a command with the database."""
DESIGN_S: Final = 600.0
"""Time limit of an answer to new tables of a feeder, s: the owner designs its monitor."""
WATCH_S: Final = 0.1
"""Interval at which the owner is compared while an answer is under way, s."""
FORWARDS: Final = 64
"""Largest number of requests that wait for one worker at a time."""
SLOT_S: Final = 5.0
"""Time limit of the wait of a further request, s."""
BULK_MOST: Final = 1000
"""Largest number of alarms of one acknowledgement."""
_ID: Final = re.compile(r"[0-9A-Z]{26}")
_BULK: Final = "POST /api/v1/alarms/ack"
_FEEDER: Final = "/api/v1/feeders/{feeder}"


class Forwarder:
    """Forwards requests of the front.

    workers: the heard workers.
    store: database, to find the feeder of an alarm.
    given: feeders of the command line, which REST cannot delete.
    names: names of all feeders.
    refresh: reads the feeders and events of the database, after each command.
    max_feeders: largest number of feeders added over REST.
    """

    def __init__(
        self,
        workers: Workers,
        store: Reader,
        caller: Caller,
        *,
        names: Callable[[], Mapping[str, Any]],
        refresh: Callable[[], Awaitable[None]],
        given: frozenset[str] = frozenset(),
        max_feeders: int = 100,
    ) -> None:
        self._workers, self._store, self._caller = workers, store, caller
        self._refresh = refresh
        self._given, self._names, self._max_feeders = given, names, max_feeders
        # The slots of each worker limit the threads.
        self._threads = CapacityLimiter(math.inf)
        self._slots: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()

    async def __call__(
        self, request: Request, identity: Identity, route: str, body: bytes
    ) -> Response | None:
        """Response of the owner; None if the front answers by itself.

        Raises NoOwner, WorkerBusy, OutcomeUnknown, FeederFixed, TooManyFeeders.
        """
        found = await self._forwarded(request, identity, route, body)
        if found is not None and request.method not in {"GET", "HEAD"}:
            await self._refresh()
        return found

    async def _forwarded(
        self, request: Request, identity: Identity, route: str, body: bytes
    ) -> Response | None:
        call = self._call(request, identity, body)
        if route == _BULK:
            return await self._acknowledge(call)
        feeder = await self._feeder_of(request, route, body)
        # Outside of the caller's scope the front refuses the request as its own.
        if feeder is None or not identity.sees(feeder):
            return None
        self._permit(route, feeder)
        limit_s = DESIGN_S if route == f"PUT {_FEEDER}" else ANSWER_S
        answer = await self.ask(feeder, call, limit_s)
        if answer.status == 404 and feeder in self._names() and self._workers.entry(feeder) is None:
            # Its owner has the lease, and has not taken it over yet.
            raise NoOwner(feeder)
        return _response(answer)

    def _permit(self, route: str, feeder: str) -> None:
        """Check the rules for the whole fleet."""
        if route == f"DELETE {_FEEDER}" and feeder in self._given:
            raise FeederFixed(feeder)
        if route == f"PUT {_FEEDER}" and feeder not in self._given:
            put = self._names().keys() - self._given
            if feeder not in put and len(put) >= self._max_feeders:
                raise TooManyFeeders(self._max_feeders)

    @staticmethod
    def _call(request: Request, identity: Identity, body: bytes) -> Call:
        headers = tuple((name, value) for name, value in request.headers.items() if name in FORWARDED)
        return Call(request.method, request.url.path, request.url.query, headers, body, identity)

    async def ask(self, feeder: str, call: Call, limit_s: float = ANSWER_S) -> Answer:
        """Answer of a feeder's owner; a read is repeated after a change of the owner.

        Raises NoOwner, WorkerBusy, OutcomeUnknown.
        """
        reads = call.method == "GET"
        while True:
            owner = self._owner(feeder)
            if owner is None:
                raise NoOwner(feeder)
            asked = asyncio.create_task(self.ask_worker(owner[0], call, limit_s))
            # zenoh may miss the end of a session with a query under way.
            while not asked.done() and self._owner(feeder) == owner:
                await asyncio.wait({asked}, timeout=WATCH_S)
            if not asked.done():
                asked.cancel()
                if reads:
                    continue
            elif (answer := asked.result()) is not None:
                return answer
            if reads:
                raise NoOwner(feeder)
            text = f"no answer of the owner of feeder {feeder!r}; the outcome is not known"
            raise OutcomeUnknown(text)

    def _owner(self, feeder: str) -> tuple[str, int] | None:
        """Worker that monitors a feeder, and its epoch."""
        found = self._workers.owner(feeder)
        return None if found is None else (found[0].worker, found[1])

    async def ask_worker(self, worker: str, call: Call, limit_s: float = ANSWER_S) -> Answer | None:
        """Answer of a worker; None without one. Raises WorkerBusy if too many requests wait for it."""
        slots = self._slots.setdefault(worker, asyncio.Semaphore(FORWARDS))
        try:
            await asyncio.wait_for(slots.acquire(), SLOT_S)
        except TimeoutError as error:
            raise WorkerBusy(worker, FORWARDS) from error
        try:
            return await to_thread.run_sync(
                self.ask_blocking, worker, call, limit_s, abandon_on_cancel=True, limiter=self._threads
            )
        finally:
            slots.release()

    def ask_blocking(self, worker: str, request: Call, limit_s: float) -> Answer | None:
        """Answer of a worker; None without one. Blocks."""
        found = self._caller.call(rest_key(worker), request.content(), limit_s)
        return None if found is None else Answer.of(found)

    # ------------------------------------------------------------------------------- the feeder of a request

    async def _feeder_of(self, request: Request, route: str, body: bytes) -> str | None:
        """Feeder of a request that its owner answers, or None."""
        method, _, path = route.partition(" ")
        given = request.path_params
        if path.startswith(_FEEDER):
            return None if path.endswith("/stream") else str(given["feeder"])
        if method == "GET":
            return None
        return await to_thread.run_sync(self._subject, path, given, body)

    def _subject(self, path: str, given: Mapping[str, Any], body: bytes) -> str | None:
        """Feeder of what a command changes; None if it does not exist or its id is not valid.

        The front refuses the command then.
        """
        finders: Mapping[str, Callable[[str], Any]] = {
            "alarm": self._store.alarm,
            "incident": self._store.incident,
            "shelf": self._store.shelf,
            "work": self._store.work,
        }
        for name, find in finders.items():
            if f"{name}_id" in given:
                return _feeder_of(find, given[f"{name}_id"])
        if path not in {"/api/v1/shelves", "/api/v1/planned-work"}:
            return None
        wanted = _object(body)
        for name in ("alarm", "incident"):
            if isinstance(number := wanted.get(name), str):
                return _feeder_of(finders[name], number)
        feeder = wanted.get("feeder")
        return feeder if isinstance(feeder, str) and feeder in self._names() else None

    async def _acknowledge(self, call: Call) -> Response | None:
        """Acknowledge alarms of several owners: one request to each, in the order of the alarms.

        Unknown alarms are refused before. After the failure of an owner the earlier ones have acknowledged
        theirs; a repetition acknowledges the others.
        """
        wanted = _object(call.body)
        names = wanted.get("alarms")
        if not isinstance(names, list) or not 1 <= len(names) <= BULK_MOST or not all(map(_is_id, names)):
            return None
        parts = await to_thread.run_sync(self._by_owner, names, call.identity)
        found: list[Any] = []
        for feeder, part in parts.items():
            body = json.dumps({**wanted, "alarms": part}).encode()
            own = Call(call.method, call.path, call.query, _plain(call.headers), body, call.identity)
            answer = await self.ask(feeder, own)
            if answer.status != 200:
                return _response(answer)
            found.extend(json.loads(answer.body))
        order = {name: k for k, name in enumerate(names)}
        found.sort(key=lambda alarm: order[alarm["id"]])
        return Response(json.dumps(found), media_type="application/json")

    def _by_owner(self, names: Sequence[str], caller: Identity) -> dict[str, list[str]]:
        """Alarms by a feeder of each owner. Raises AlarmUnknown outside of the caller's scope, NoOwner."""
        feeders: dict[str, str] = {}
        for name in names:
            if (alarm := self._store.alarm(name)) is None or not caller.sees(alarm.feeder):
                raise AlarmUnknown(name)
            feeders[name] = alarm.feeder
        parts: dict[str, tuple[str, list[str]]] = {}
        for name, feeder in feeders.items():
            if (owner := self._workers.owner(feeder)) is None:
                raise NoOwner(feeder)
            parts.setdefault(owner[0].worker, (feeder, []))[1].append(name)
        return dict(parts.values())


def get(path: str, query: str = "") -> Call:
    """A request of the front itself."""
    return Call("GET", path, query, (("accept", "application/json"),), b"", OPEN)


def _is_id(value: object) -> bool:
    """True for the id of an alarm, an incident, a shelf or a planned work."""
    return isinstance(value, str) and _ID.fullmatch(value) is not None


def _feeder_of(find: Callable[[str], Any], number: str) -> str | None:
    """Feeder of an object with an id; None without one."""
    found = find(number) if _is_id(number) else None
    return None if found is None else str(found.feeder)


def _object(body: bytes) -> dict[str, Any]:
    """Object of a JSON body; empty for another body, which the front or the owner refuses."""
    try:
        found = json.loads(body)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _plain(headers: Sequence[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    """Headers without compression of the answer."""
    return tuple(pair for pair in headers if pair[0] != "accept-encoding")


def _response(answer: Answer) -> Response:
    made = Response(answer.body, answer.status)
    for name, value in answer.headers:
        made.headers.append(name, value)
    return made
