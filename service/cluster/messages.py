"""Messages between the processes of a cluster: signed calls and their answers over zenoh.

Call. The front queries a key of one worker, and takes the first valid reply. A put on these keys reaches no
process, because none subscribes to them.

Envelope. A zenoh client may query and answer on any key that the router permits. Each message therefore has
an HMAC-SHA256 by a secret that only readers of the database know. The tag covers the direction and the key: a
message of one worker is not valid for another one. An answer names its call. A message older than `FRESH_S`
is refused. The time is that of the database (`Leases.clock`): the clocks of the machines do not matter.

State, `@worker/<worker>/state`. The answer waits for new ticks, at least until `GATHER_S` and at most until
`SILENT_S` after the one before. It has the leases of the worker and the entries of its feeders in the list,
about 0.6 kB for a feeder. States of many feeders are rarer, up to `LONGEST_S`: they take about `SHARE` of the
time.

REST, `@worker/<worker>/rest`. The worker executes a request on its own HTTP application, in process, with
the identity that the front has authenticated. No operation is declared twice.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import cbor2
import structlog
from anyio import CapacityLimiter, to_thread
from starlette.types import ASGIApp, Message

from gridsec.errors import GridsecError
from service.access.identity import OPEN, Identity, Role
from service.api.dependencies import IDENTITY
from service.ingest.queues import BusUnavailable

FRESH_S: Final = 30.0
"""Largest age of a message, s."""
_TAG: Final = 32
"""Length of the tag, bytes."""


class MessageRefused(GridsecError):
    """A message of the cluster is damaged, old, repeated or not signed with the secret of the database."""

    code = "message-refused"


class Envelope:
    """Encoding of messages, CBOR with a tag in front. Thread-safe.

    secret: secret of the cluster.
    clock: time of the cluster, Unix s.
    """

    def __init__(self, secret: bytes, clock: Callable[[], float] = time.time) -> None:
        self._secret, self._clock = secret, clock
        self._seen: dict[str, float] = {}
        self._lock = threading.Lock()

    def seal(self, purpose: str, content: Mapping[str, Any]) -> bytes:
        """Return a message. `purpose` names the key and the direction."""
        body = cbor2.dumps({"t": self._clock(), "id": secrets.token_hex(8), **content})
        return self._tag(purpose, body) + body

    def open(self, purpose: str, message: bytes, *, once: bool = False) -> dict[str, Any]:
        """Return the content of a message; with `once` a second one with its id is refused.

        Raises MessageRefused if it is not valid.
        """
        tag, body = message[:_TAG], message[_TAG:]
        if not hmac.compare_digest(tag, self._tag(purpose, body)):
            raise MessageRefused(f"{purpose}: the signature is not that of this cluster")
        found: dict[str, Any] = cbor2.loads(body)
        now = self._clock()
        if abs(now - found["t"]) > FRESH_S:
            raise MessageRefused(f"{purpose}: the message is {now - found['t']:.0f} s old")
        if once:
            self._refuse_repeated(purpose, found["id"], now)
        return found

    def _refuse_repeated(self, purpose: str, number: str, now: float) -> None:
        with self._lock:
            self._seen = {one: t for one, t in self._seen.items() if abs(now - t) <= 2.0 * FRESH_S}
            if number in self._seen:
                raise MessageRefused(f"{purpose}: the message is repeated")
            self._seen[number] = now

    def _tag(self, purpose: str, body: bytes) -> bytes:
        return hmac.digest(self._secret, purpose.encode() + b"\0" + body, "sha256")


Ask = Callable[[str, bytes, float], Iterable[bytes]]
"""Queries a key with a payload, and yields the replies until a time limit, s, as `Bus.ask` does."""
Content = dict[str, Any]
"""Content of a message."""
TELL_S: Final = 10.0
"""Shortest interval of log lines about refused messages, s."""
_log = structlog.get_logger("gridsec.cluster")


class Refusals:
    """Count of refused messages, with a line of the log every `TELL_S`. Thread-safe."""

    def __init__(self, event: str) -> None:
        self._event, self._lock = event, threading.Lock()
        self._count, self._tell_at = 0, float("-inf")

    def note(self, problem: object) -> None:
        """Count a refused message."""
        with self._lock:
            self._count += 1
            if (now := time.monotonic()) < self._tell_at:
                return
            count, self._count, self._tell_at = self._count, 0, now + TELL_S
        _log.warning(self._event, messages=count, latest=str(problem))


class Caller:
    """Calls of workers. Thread-safe."""

    def __init__(self, ask: Ask, envelope: Envelope) -> None:
        self._ask, self._envelope = ask, envelope
        self._refusals = Refusals("replies of workers are refused")

    def call(self, key: str, content: Content, limit_s: float) -> Content | None:
        """Content of the first valid answer; None without one within the time limit. Blocks."""
        number = secrets.token_hex(8)
        message = self._envelope.seal(f"call {key}", {**content, "id": number})
        try:
            for reply in self._ask(key, message, limit_s):
                try:
                    found = self._envelope.open(f"answer {key}", reply)
                    if found["to"] == number:
                        return found
                except (MessageRefused, ValueError, KeyError, TypeError) as error:
                    self._refusals.note(error)
        except BusUnavailable:
            return None
        return None


class CallServer:
    """Passes the valid calls on a key, each once, to an event loop, and their answers to the bus.

    key: key without the prefix.
    take: called in the event loop with the content of a call and a function that answers it once, which is
        called in the event loop, too.
    """

    def __init__(
        self,
        key: str,
        envelope: Envelope,
        loop: asyncio.AbstractEventLoop,
        take: Callable[[Content, Callable[[Content], None]], None],
    ) -> None:
        self._key, self._envelope, self._loop, self._take = key, envelope, loop, take
        self._refusals = Refusals("calls of the cluster are refused")
        self._threads = CapacityLimiter(math.inf)
        self._replying: set[asyncio.Task[None]] = set()

    def __call__(self, payload: bytes, respond: Callable[[bytes], None]) -> None:
        """Take a call from any thread."""
        try:
            content = self._envelope.open(f"call {self._key}", payload, once=True)
        except (MessageRefused, ValueError, KeyError, TypeError) as error:
            self._refusals.note(error)
            respond(b"")
            return

        def answer(found: Content) -> None:
            message = self._envelope.seal(f"answer {self._key}", {**found, "to": content["id"]})
            # A congested link blocks a reply for seconds; the event loop renews the leases.
            reply = to_thread.run_sync(respond, message, abandon_on_cancel=True, limiter=self._threads)
            task = self._loop.create_task(reply)
            self._replying.add(task)
            task.add_done_callback(self._replying.discard)

        self._loop.call_soon_threadsafe(self._take, content, answer)


GATHER_S: Final = 0.25
"""Shortest interval of the states, s."""
SILENT_S: Final = 0.5
"""Longest interval of the states without new ticks, s."""
LONGEST_S: Final = 0.75
"""Longest interval of the states of many feeders, s."""
SHARE: Final = 0.03
"""Part of the processor time of a thread for the states."""


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
    order: tuple[int, int]  # registration of the worker, and number of the message since
    shards: Mapping[int, int]  # epoch of its lease by shard
    feeders: Mapping[str, Entry]
    unstored: int  # changes of alarms that wait for the database
    problem: str | None  # problem of the database
    reasons: tuple[str, ...]  # reasons why it is not ready

    def content(self) -> Content:
        """Content of its message."""
        return {
            "worker": self.worker,
            "order": list(self.order),
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
            tuple(content["order"]),
            content["shards"],
            {fields["name"]: Entry(fields, now) for fields, now in content["feeders"]},
            content["unstored"],
            content["problem"],
            tuple(content["reasons"]),
        )


def state_key(worker: str) -> str:
    """Key of the calls for a state, without the prefix; `@` keeps it out of the feeders' keys."""
    return f"@worker/{worker}/state"


class StateReports:
    """States of a worker for the fronts that wait for them.

    content: content of the next state.
    news: set after new ticks.
    """

    def __init__(self, content: Callable[[], Content], news: asyncio.Event) -> None:
        self._content, self._news = content, news
        self._waiting: list[Callable[[Content], None]] = []
        self._asked = asyncio.Event()

    def take(self, _: Content, answer: Callable[[Content], None]) -> None:
        """Take a call; the next state answers it."""
        self._waiting.append(answer)
        self._asked.set()

    async def run(self) -> None:
        """Answer until cancelled."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            self._news.clear()
            begun = time.thread_time()
            content = self._content()
            waiting, self._waiting = self._waiting, []
            for answer in waiting:
                answer(content)
            gather_s = min(max(GATHER_S, (time.thread_time() - begun) / SHARE), LONGEST_S)
            await asyncio.sleep(gather_s)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), max(SILENT_S - gather_s, 0.0))


FORWARDED: Final = frozenset({"accept", "accept-encoding", "content-type", "if-none-match"})
"""Headers of a request that its answer depends on."""
_OWN: Final = frozenset(
    {"content-length", "content-security-policy", "x-content-type-options", "referrer-policy"}
)
"""Headers that the front sets by itself."""


@dataclass(frozen=True, slots=True)
class Call:
    """One request."""

    method: str
    path: str
    query: str
    headers: tuple[tuple[str, str], ...]
    body: bytes
    identity: Identity

    def content(self) -> Content:
        """Content of its message."""
        who = self.identity
        feeders = None if who.feeders is None else sorted(who.feeders)
        identity = None if who is OPEN else [who.name, str(who.role), feeders, who.credential]
        return {
            "method": self.method,
            "path": self.path,
            "query": self.query,
            "headers": [list(pair) for pair in self.headers],
            "body": self.body,
            "identity": identity,
        }

    @classmethod
    def of(cls, content: Content) -> Call:
        """The request of a message."""
        identity = OPEN
        if (given := content["identity"]) is not None:
            name, role, feeders, credential = given
            scope = None if feeders is None else frozenset(feeders)
            identity = Identity(name, Role(role), scope, credential)
        headers = tuple((name, value) for name, value in content["headers"])
        return cls(content["method"], content["path"], content["query"], headers, content["body"], identity)


@dataclass(frozen=True, slots=True)
class Answer:
    """Response to a request."""

    status: int
    headers: tuple[tuple[str, str], ...]
    body: bytes

    @classmethod
    def of(cls, content: Content) -> Answer:
        """The response of a message."""
        headers = tuple((name, value) for name, value in content["headers"])
        return cls(content["status"], headers, content["body"])


def rest_key(worker: str) -> str:
    """Key of the requests to a worker, without the prefix."""
    return f"@worker/{worker}/rest"


async def execute(app: ASGIApp, call: Call) -> Answer:
    """Response of an HTTP application to a request."""
    # The front has checked the origin and the host name.
    head = [(b"host", b"localhost"), *((name.encode(), value.encode()) for name, value in call.headers)]
    head.append((b"content-length", str(len(call.body)).encode()))
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": call.method,
        "scheme": "http",
        "path": call.path,
        "raw_path": call.path.encode(),
        "query_string": call.query.encode(),
        "root_path": "",
        "headers": head,
        "client": ("cluster", 0),
        "server": ("localhost", 80),
        IDENTITY: call.identity,
    }
    sent, parts = False, bytearray()
    status, headers = 500, list[tuple[str, str]]()

    async def receive() -> Message:
        nonlocal sent
        if sent:
            await asyncio.Event().wait()  # the client of the front does not disconnect here
        sent = True
        return {"type": "http.request", "body": call.body, "more_body": False}

    async def send(message: Message) -> None:
        nonlocal status, headers
        if message["type"] == "http.response.start":
            status = message["status"]
            headers = [(n.decode("latin-1"), value.decode("latin-1")) for n, value in message["headers"]]
        elif message["type"] == "http.response.body":
            parts.extend(message.get("body", b""))

    await app(scope, receive, send)
    return Answer(status, tuple(pair for pair in headers if pair[0].lower() not in _OWN), bytes(parts))


class RestCalls:
    """Executes requests on the HTTP application of a worker, in the running event loop."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._running: set[asyncio.Task[None]] = set()

    def take(self, content: Content, answer: Callable[[Content], None]) -> None:
        """Take a call."""
        task = asyncio.get_running_loop().create_task(self._execute(content, answer))
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    async def _execute(self, content: Content, answer: Callable[[Content], None]) -> None:
        try:
            found = await execute(self._app, Call.of(content))
        except Exception:  # noqa: BLE001 - the application has sent its response 500 before
            _log.exception("a request failed", path=content["path"])
            found = Answer(500, (), b"")
        headers = [list(pair) for pair in found.headers]
        answer({"status": found.status, "headers": headers, "body": found.body})
