"""REST between front and worker: a request as one query on `@worker/<worker>/rest`.

The worker executes it on its own HTTP application, in process, with the identity that the front has
authenticated. No operation is declared twice.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import structlog
from starlette.types import ASGIApp, Message

from service.access.identity import OPEN, Identity, Role
from service.api.dependencies import IDENTITY
from service.cluster.envelope import Envelope, MessageRefused

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
