"""HTTP conventions of all routes: `application/problem+json` (RFC 9457), request checks, HEAD as GET."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Awaitable, Callable, Collection
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any, cast
from urllib.parse import urlsplit

import structlog
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from feeders.registry import EstimatorUnusable
from gridsec.errors import DesignInfeasible, FeederInvalid, GridsecError, NotObservable
from service.access.identity import IssuerUnavailable, NotAuthenticated, NotPermitted, TooManyFailures
from service.alarms.incidents import IncidentChanged, WrongTime
from service.alarms.state_machine import AlreadyAcknowledged, NotAcknowledged, RaisedAgain
from service.engine.commissioning import NothingToLearn
from service.errors import (
    FeederFixed,
    FeederNotLoaded,
    FeederUnknown,
    IdUnknown,
    NoOwner,
    TooManyFeeders,
    WorkerBusy,
)
from service.store import OutcomeUnknown, StoreUnavailable

_log = structlog.get_logger("gridsec.http")


class _HeadersSent(Exception):
    """Ends a stream after its headers."""


class HeadAsGet:
    """Answers HEAD with the status and headers of GET. A stream ends after its headers."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request to the application."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def headers_only(message: Message) -> None:
            if message["type"] != "http.response.body":
                await send(message)
                return
            await send({"type": "http.response.body", "body": b"", "more_body": False})
            if message.get("more_body"):
                raise _HeadersSent

        try:
            await self.app({**scope, "method": "GET"}, receive, headers_only)
        except* _HeadersSent:  # alone, or in a group of the stream's tasks
            pass


# --- Problems and request checks ---


SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of every response without its own: the page loads nothing from elsewhere."""
_HEADERS = {
    b"content-security-policy": SECURITY_POLICY.encode(),
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
}


def problem(
    request: Request, status: int, detail: str, *, headers: dict[str, str] | None = None, **more: Any
) -> Response:
    """Return an error response.

    `more` are additional members, such as the list of all problems of a feeder.
    """
    body = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "instance": request.url.path,
        **more,
    }
    return JSONResponse(
        body,
        status_code=status,
        media_type="application/problem+json",
        headers={"Cache-Control": "no-store", **(headers or {})},
    )


class Guard:
    """Security headers on every response, a limit of the body, and a check of the origin of changes.

    DNS rebinding: a foreign page can point its host name at this server. A request that changes something
    must therefore use an address or a host name of this server, and a page that sends it must have the same
    origin: scheme, host and port. Behind a proxy with TLS that is `https` and one of `hosts`.

    max_body: largest request body, bytes.
    hosts: host names of this server, besides `localhost` and the machine's name.
    """

    def __init__(self, app: ASGIApp, max_body: int, hosts: Collection[str] = ()) -> None:
        self.app = app
        self.max_body = max_body
        self.hosts = frozenset(name.lower() for name in hosts)
        self.own = self.hosts | {"localhost", socket.gethostname().lower()}

    def stranger(self, request: Request) -> tuple[int, str] | None:
        """Return the reason why a request may change nothing, as status and sentence, or None."""
        if request.method in _READS:
            return None
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        name = _name_of(f"//{host}")
        if name not in self.own and not _is_address(name):
            return (
                421,
                f"{host!r} is not a host name of this service; `--http-host` of `gridsec serve` adds one",
            )
        if origin is None:
            return None
        page = _origin(origin)
        if page is not None and page == _origin(f"{request.url.scheme}://{host}"):
            return None
        if page is not None and page[0] == "https" and page[1] in self.hosts:
            return None
        return 403, f"a page of {origin!r} must not change anything at {host!r}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request and pass it to the application."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope)
        text = f"the body is longer than {self.max_body} bytes"
        declared = request.headers.get("content-length", "")
        length = 0

        async def limited() -> Message:
            nonlocal length
            message = await receive()
            length += len(message.get("body", b""))
            if length > self.max_body:
                raise HTTPException(413, text, {"Connection": "close"})
            return message

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = dict(message.get("headers", []))
                missing = [each for each in _HEADERS.items() if each[0] not in own]
                message = {**message, "headers": [*message.get("headers", []), *missing]}
            await send(message)

        if strange := self.stranger(request):
            await problem(request, *strange, headers={"Connection": "close"})(scope, receive, guarded)
        elif declared.isdecimal() and int(declared) > self.max_body:
            await problem(request, 413, text, headers={"Connection": "close"})(scope, receive, guarded)
        else:
            # A client that disconnects before its body is complete gets no response; this is not a defect.
            with contextlib.suppress(ClientDisconnect):
                await self.app(scope, limited, guarded)


_READS = frozenset({"GET", "HEAD", "OPTIONS"})


def _name_of(address: str) -> str:
    """Return the host of an address in lower case; empty without one."""
    try:
        return urlsplit(address).hostname or ""
    except ValueError:
        return ""


def _origin(address: str) -> tuple[str, str, int | None] | None:
    """Scheme, host and port of an address (RFC 6454), with the default port; None for a wrong one."""
    try:
        parts = urlsplit(address)
        port = parts.port or {"http": 80, "https": 443}.get(parts.scheme)
    except ValueError:
        return None
    return (parts.scheme, parts.hostname, port) if parts.hostname else None


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


_ADVICE = {503: {"Retry-After": "5"}, 401: {"WWW-Authenticate": "Bearer"}, 429: {"Retry-After": "60"}}
"""Headers by status."""

Handler = Callable[[Request, Exception], Awaitable[Response]]

_STATUS: dict[type[GridsecError], int] = {
    FeederInvalid: 422,
    NotObservable: 422,
    DesignInfeasible: 422,
    EstimatorUnusable: 422,
    IdUnknown: 404,
    WrongTime: 422,
    FeederUnknown: 404,
    AlreadyAcknowledged: 409,
    RaisedAgain: 409,
    NotAcknowledged: 409,
    IncidentChanged: 409,
    FeederFixed: 409,
    NothingToLearn: 409,
    TooManyFeeders: 409,
    NotAuthenticated: 401,
    NotPermitted: 403,
    IssuerUnavailable: 503,
    TooManyFailures: 429,
    FeederNotLoaded: 503,
    NoOwner: 503,
    WorkerBusy: 503,
    StoreUnavailable: 503,
    GridsecError: 500,
}


def handlers() -> dict[type[Exception], Handler]:
    """Return the handlers that convert errors to problems, by type of the error."""
    ours: dict[type[Exception], Handler] = {error: _gridsec_handler(code) for error, code in _STATUS.items()}
    return {**ours, HTTPException: _http_handler, Exception: _unexpected_handler}


def _gridsec_handler(status: int) -> Handler:
    async def handler(request: Request, error: Exception) -> Response:
        more: dict[str, Any] = {}
        if isinstance(error, NoOwner | WorkerBusy):
            more["code"] = error.code
        if isinstance(error, FeederInvalid):
            more["problems"] = list(error.problems)
        if isinstance(error, OutcomeUnknown):
            more["outcome"] = "unknown"
        detail = str(error)
        if isinstance(error, StoreUnavailable):
            _log.warning("a request failed for the database", path=request.url.path, problem=detail)
            detail = error.public
        return problem(request, status, detail, headers=_ADVICE.get(status), **more)

    return handler


async def _http_handler(request: Request, error: Exception) -> Response:
    error = cast(HTTPException, error)
    detail = "no such resource" if error.detail == "Not Found" else error.detail
    return problem(request, error.status_code, detail, headers=dict(error.headers or {}))


async def _unexpected_handler(request: Request, _error: Exception) -> Response:
    # The server closes the connection after an unexpected error; the header announces it to the client.
    text = "internal error; the log of the service has the details"
    return problem(request, 500, text, headers={"Connection": "close"})
