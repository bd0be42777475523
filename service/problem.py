"""Errors as `application/problem+json` (RFC 9457), and the guard in front of the HTTP application."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Any, cast

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from feeders.outside import EstimatorUnusable
from gridsec.errors import DesignInfeasible, FeederInvalid, GridsecError, NotObservable
from service.alarms import AlarmUnknown, AlreadyAcknowledged, RaisedAgain
from service.commissioning import NothingToLearn
from service.errors import FeederFixed, FeederNotLoaded, FeederUnknown, TooManyFeeders
from service.store import StoreUnavailable

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
    """Security headers on every answer, and an end to bodies that are too long.

    Parameters
    ----------
    app
        The application behind it.
    max_body
        Longest body that is read, bytes.
    """

    def __init__(self, app: ASGIApp, max_body: int) -> None:
        self.app = app
        self.max_body = max_body

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

        if declared.isdecimal() and int(declared) > self.max_body:
            await problem(request, 413, text, headers={"Connection": "close"})(scope, receive, guarded)
        else:
            await self.app(scope, limited, guarded)


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
        more = {"problems": list(error.problems)} if isinstance(error, FeederInvalid) else {}
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
