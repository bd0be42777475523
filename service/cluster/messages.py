"""Messages between the processes of a cluster: signed envelopes, states of the workers, REST over zenoh.

Envelope. A zenoh client may publish on any key that the router permits. Each message therefore has an
HMAC-SHA256 by a secret that only readers of the database know. The tag covers the purpose and the key: a
message of one worker is not valid for another one. A message older than `FRESH_S` is refused. The time is
that of the database (`Leases.clock`): the clocks of the machines do not matter.

State. A worker sends its leases and the entries of its feeders in the list on `@worker/<worker>/state`: after
new ticks, at most every `GATHER_S`, and at least every `SILENT_S`. A feeder takes about 0.6 kB. Messages of
many feeders are rarer, up to `LONGEST_S`, so that they take about `SHARE` of the time.

REST. A request is one query on `@worker/<worker>/rest`. The worker executes it on its own HTTP application,
in process, with the identity that the front has authenticated. No operation is declared twice.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import cbor2
import structlog
from starlette.types import ASGIApp, Message

from gridsec.errors import GridsecError
from service.access.identity import OPEN, Identity, Role
from service.api.dependencies import IDENTITY

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

    def seal(self, purpose: str, content: dict[str, Any]) -> bytes:
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
        self._seen = {one: t for one, t in self._seen.items() if abs(now - t) <= 2.0 * FRESH_S}
        if number in self._seen:
            raise MessageRefused(f"{purpose}: the message is repeated")
        self._seen[number] = now

    def _tag(self, purpose: str, body: bytes) -> bytes:
        return hmac.digest(self._secret, purpose.encode() + b"\0" + body, "sha256")


GATHER_S: Final = 0.25
"""Shortest interval of the messages, s."""
SILENT_S: Final = 0.5
"""Longest interval of the messages without new ticks, s."""
LONGEST_S: Final = 0.75
"""Longest interval of the messages of many feeders, s: a worker is silent after four of them."""
SHARE: Final = 0.03
"""Part of the processor time of a thread for the messages."""
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
    order: tuple[int, int]  # registration of the worker, and number of the message since
    shards: Mapping[int, int]  # epoch of its lease by shard
    feeders: Mapping[str, Entry]
    unstored: int  # changes of alarms that wait for the database
    problem: str | None  # problem of the database
    reasons: tuple[str, ...]  # reasons why it is not ready

    def content(self) -> dict[str, Any]:
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
        begun = time.thread_time()
        tell(key, envelope.seal(STATES, content()))
        gather_s = min(max(GATHER_S, (time.thread_time() - begun) / SHARE), LONGEST_S)
        await asyncio.sleep(gather_s)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(news.wait(), max(SILENT_S - gather_s, 0.0))


FORWARDED: Final = frozenset({"accept", "accept-encoding", "content-type", "if-none-match"})
"""Headers of a request that its answer depends on."""
_OWN: Final = frozenset(
    {"content-length", "content-security-policy", "x-content-type-options", "referrer-policy"}
)
"""Headers that the front sets by itself."""
_log = structlog.get_logger("gridsec.cluster")


@dataclass(frozen=True, slots=True)
class Call:
    """One request."""

    method: str
    path: str
    query: str
    headers: tuple[tuple[str, str], ...]
    body: bytes
    identity: Identity

    def content(self) -> dict[str, Any]:
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
    def of(cls, content: dict[str, Any]) -> Call:
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
    def of(cls, content: dict[str, Any]) -> Answer:
        """The response of a message."""
        headers = tuple((name, value) for name, value in content["headers"])
        return cls(content["status"], headers, content["body"])


def rest_key(worker: str) -> str:
    """Key of the requests to a worker, without the prefix; `@` keeps it out of the feeders' keys."""
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


class RestServer:
    """Executes the requests to one worker.

    app: its HTTP application.
    key: key of the requests, without the prefix.
    loop: event loop of the application.
    """

    def __init__(self, app: ASGIApp, key: str, envelope: Envelope, loop: asyncio.AbstractEventLoop) -> None:
        self._app, self._key, self._envelope, self._loop = app, key, envelope, loop
        self._running: set[asyncio.Task[None]] = set()

    def __call__(self, payload: bytes, respond: Callable[[bytes], None]) -> None:
        """Take a request from any thread."""
        try:
            content = self._envelope.open(f"call {self._key}", payload, once=True)
        except (MessageRefused, ValueError, KeyError, TypeError) as error:
            _log.warning("a request of the cluster is refused", problem=str(error))
            respond(b"")
            return

        def start() -> None:
            task = self._loop.create_task(self._execute(content, respond))
            self._running.add(task)
            task.add_done_callback(self._running.discard)

        self._loop.call_soon_threadsafe(start)

    async def _execute(self, content: dict[str, Any], respond: Callable[[bytes], None]) -> None:
        try:
            found = await execute(self._app, Call.of(content))
        except Exception:  # noqa: BLE001 - the application has sent its response 500 before
            _log.exception("a request failed", path=content["path"])
            found = Answer(500, (), b"")
        reply = {
            "to": content["id"],
            "status": found.status,
            "headers": [list(pair) for pair in found.headers],
            "body": found.body,
        }
        respond(self._envelope.seal(f"answer {self._key}", reply))
