"""Errors as `application/problem+json` (RFC 9457), and the guard in front of the HTTP application."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Awaitable, Callable, Collection
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any, cast
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from feeders.registry.plugins import EstimatorUnusable
from gridsec.errors import DesignInfeasible, FeederInvalid, GridsecError, NotObservable
from service.alarms.state_machine import AlarmUnknown, AlreadyAcknowledged, RaisedAgain
from service.engine.commissioning import NothingToLearn
from service.errors import FeederFixed, FeederNotLoaded, FeederUnknown, TooManyFeeders
from service.store import OutcomeUnknown, StoreUnavailable

_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = [
    (b"content-security-policy", _CSP.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
]


def problem(
    request: Request, status: int, detail: str, *, headers: dict[str, str] | None = None, **more: Any
) -> Response:
    """Return an error.

    Parameters
    ----------
    request
        What was asked.
    status, detail
        HTTP's number, and a sentence that says what is wrong.
    headers
        Headers besides.
    **more
        Members besides, such as the list of all problems of a feeder.
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
    """Security headers on every answer, an end to bodies that are too long, and no change for strangers.

    A foreign web page can give its own name our address and then ask us as if it were ours. So whoever
    changes something must call us by an address or a name of ours, and a page that does must come from there.

    Parameters
    ----------
    app
        The application behind it.
    max_body
        Longest body that is read, bytes.
    hosts
        Names of ours, besides `localhost` and this machine's.
    """

    def __init__(self, app: ASGIApp, max_body: int, hosts: Collection[str] = ()) -> None:
        self.app = app
        self.max_body = max_body
        self.hosts = frozenset(name.lower() for name in hosts)
        self.own = self.hosts | {"localhost", socket.gethostname().lower()}

    def stranger(self, request: Request) -> tuple[int, str] | None:
        """Return why a request may change nothing, as status and sentence, or None.

        Parameters
        ----------
        request
            What is asked.
        """
        if request.method in _READS:
            return None
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        name = _name_of(f"//{host}")
        if name not in self.own and not _is_address(name):
            return 421, f"{host!r} is no name of this service; `--http-host` of `gridsec serve` makes it one"
        if (
            origin is None
            or origin.partition("://")[2].lower() == host.lower()
            or _name_of(origin) in self.hosts
        ):
            return None
        return 403, f"a page of {origin!r} may change nothing at {host!r}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
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
                message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
            await send(message)

        if strange := self.stranger(request):
            await problem(request, *strange, headers={"Connection": "close"})(scope, receive, guarded)
        elif declared.isdecimal() and int(declared) > self.max_body:
            await problem(request, 413, text, headers={"Connection": "close"})(scope, receive, guarded)
        else:
            # A client that leaves before its body is complete gets no answer, and is no defect.
            with contextlib.suppress(ClientDisconnect):
                await self.app(scope, limited, guarded)


_READS = frozenset({"GET", "HEAD", "OPTIONS"})


def _name_of(address: str) -> str:
    """Return the host of an address in small letters; empty if there is none."""
    try:
        return urlsplit(address).hostname or ""
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


Handler = Callable[[Request, Exception], Awaitable[Response]]

_STATUS: dict[type[GridsecError], int] = {
    FeederInvalid: 422,
    NotObservable: 422,
    DesignInfeasible: 422,
    EstimatorUnusable: 422,
    AlarmUnknown: 404,
    FeederUnknown: 404,
    AlreadyAcknowledged: 409,
    RaisedAgain: 409,
    FeederFixed: 409,
    NothingToLearn: 409,
    TooManyFeeders: 409,
    FeederNotLoaded: 503,
    StoreUnavailable: 503,
    GridsecError: 500,
}


def handlers() -> dict[type[Exception], Handler]:
    """Return what makes problems of errors, by their type."""
    ours: dict[type[Exception], Handler] = {error: _gridsec_handler(code) for error, code in _STATUS.items()}
    return {**ours, HTTPException: _http_handler, Exception: _unexpected_handler}


def _gridsec_handler(status: int) -> Handler:
    async def handler(request: Request, error: Exception) -> Response:
        more: dict[str, Any] = {}
        if isinstance(error, FeederInvalid):
            more["problems"] = list(error.problems)
        if isinstance(error, OutcomeUnknown):
            more["outcome"] = "unknown"
        headers = {"Retry-After": "5"} if status == 503 else None
        return problem(request, status, str(error), headers=headers, **more)

    return handler


async def _http_handler(request: Request, error: Exception) -> Response:
    error = cast(HTTPException, error)
    detail = "there is nothing here" if error.detail == "Not Found" else error.detail
    return problem(request, error.status_code, detail, headers=dict(error.headers or {}))


async def _unexpected_handler(request: Request, _error: Exception) -> Response:
    # The server hangs up after an error that it did not expect; the client must not be surprised by that.
    text = "something went wrong here; the log of the service says what"
    return problem(request, 500, text, headers={"Connection": "close"})
