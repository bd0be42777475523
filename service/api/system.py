"""Routes of the service itself: probes, metrics, rejected readings, notifications, sessions, audit log."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Any

import structlog
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import JSONResponse

from service.access.identity import OPEN, Identity
from service.api import models
from service.api.access import COOKIE, Authenticator, client_of, session_of
from service.api.dependencies import MAX_EVENT, NAME, BackendHere, json_only, known_query
from service.api.errors import problem
from service.notify.delivery import Notifier
from service.settings import is_loopback
from service.store import Store, StoreUnavailable
from service.store.deliveries import DeliveryStore

_log = structlog.get_logger("gridsec.http")
ANSWER_S = 0.7
"""Time limit of the test write, s: `/readyz` answers within 1 s."""

_notifications = APIRouter(
    prefix="/api/v1/notifications", tags=["notifications"], dependencies=[Depends(known_query)]
)
_operations = APIRouter(tags=["operations"])
_sessions = APIRouter(prefix="/api/v1", tags=["access"], dependencies=[Depends(known_query)])
routers = (_notifications, _operations, _sessions)


class Probe:
    """Test write shared by concurrent requests, each of which waits at most `ANSWER_S`."""

    def __init__(self, store: Store, authenticator: Authenticator | None) -> None:
        self._store, self._authenticator = store, authenticator
        self._running: asyncio.Task[str | None] | None = None

    async def trouble(self) -> str | None:
        """Return the reason why the database cannot be written, or None."""
        if self._running is None or self._running.done():
            self._running = asyncio.create_task(self._check(), name="readiness")
        await asyncio.wait({self._running}, timeout=ANSWER_S)
        if self._running.done():
            return self._running.result()
        return f"the database gives no answer within {ANSWER_S:g} s"

    async def _check(self) -> str | None:
        # In a separate thread: reads that wait for the database may occupy all shared ones.
        try:
            await to_thread.run_sync(self._access, limiter=CapacityLimiter(1), abandon_on_cancel=True)
        except StoreUnavailable as error:
            _log.warning("the test write failed", problem=str(error))
            return error.public
        return None

    def _access(self) -> None:
        """Test both databases."""
        self._store.check()
        if self._authenticator is not None:
            self._authenticator.store.any_key()


# ----------------------------------------------------------------- operations


@_operations.get("/api/v1/bad-readings", dependencies=[Depends(known_query)])
def list_rejected(
    backend: BackendHere, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> models.RejectedReadings:
    """The newest rejected readings, with reasons."""
    return models.RejectedReadings(
        readings=[
            models.RejectedReading(
                t=item.t, key=item.key, reason=item.reason, payload=item.payload.decode("utf-8", "replace")
            )
            for item in backend.store.rejected(limit)
        ]
    )


@_operations.get("/healthz", response_model=models.Health)
async def healthz(request: Request, backend: BackendHere) -> Any:
    """Liveness of the process and its tasks."""
    return _probe(request, *backend.healthy(), "the service does not work; restart it")


@_operations.get("/readyz", response_model=models.Health)
async def readyz(request: Request, backend: BackendHere) -> Any:
    """Readiness: feeders are designed, the database can be written and zenoh is connected."""
    ready, reasons = backend.ready()
    trouble = await request.app.state.probe.trouble()
    if trouble is not None:
        ready, reasons = False, list(dict.fromkeys([*reasons, trouble]))
    return _probe(request, ready, reasons, "the service cannot monitor at present")


def _probe(request: Request, good: bool, reasons: list[str], what: str) -> Any:
    if good:
        return JSONResponse({"ok": True, "reasons": reasons}, headers={"Cache-Control": "no-store"})
    return problem(request, 503, what, ok=False, reasons=reasons)


@_operations.get("/metrics", response_class=Response)
def metrics(backend: BackendHere) -> Response:
    """Metrics in Prometheus's text format."""
    return Response(backend.metrics(), media_type="text/plain; version=0.0.4; charset=utf-8")


# -------------------------------------------------------------- notifications


@_notifications.get("")
def list_targets(request: Request) -> models.Targets:
    """Targets of notifications, with their position and the problem of the last attempt."""
    notifier: Notifier | None = request.app.state.notifier
    return models.Targets(targets=[] if notifier is None else notifier.status())


@_notifications.get("/dead-letters")
def list_dead_letters(
    request: Request,
    target: Annotated[str | None, Query(pattern=NAME, description="Restrict to this target.")] = None,
    after: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Only letters with a higher number.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> models.Letters:
    """A page of messages that were given up, oldest first."""
    notifier: Notifier | None = request.app.state.notifier
    found = [] if notifier is None else notifier.store.letters(target=target, after=after, limit=limit + 1)
    page = [
        models.Letter.model_validate({**asdict(each), "message": json.loads(each.body)})
        for each in found[:limit]
    ]
    return models.Letters(dead_letters=page, next=page[-1].id if len(found) > limit else None)


@_notifications.post("/dead-letters/resend", dependencies=[Depends(json_only)])
def resend_dead_letters(request: Request, choice: models.LetterChoice) -> models.LetterCount:
    """Send dead letters again, with the same message ids; a delivered one is deleted."""
    return _change_letters(request, DeliveryStore.resend, choice)


@_notifications.post("/dead-letters/discard", dependencies=[Depends(json_only)])
def discard_dead_letters(request: Request, choice: models.LetterChoice) -> models.LetterCount:
    """Delete dead letters."""
    return _change_letters(request, DeliveryStore.discard, choice)


def _change_letters(
    request: Request, change: Callable[..., int], choice: models.LetterChoice
) -> models.LetterCount:
    notifier: Notifier | None = request.app.state.notifier
    if notifier is None:
        return models.LetterCount(count=0)
    count = change(notifier.store, target=choice.target, ids=choice.ids)
    notifier.look()
    return models.LetterCount(count=count)


# ------------------------------------------------------- sessions and audit log


def _session(identity: Identity, expires: float | None = None) -> models.Session:
    feeders = None if identity.feeders is None else sorted(identity.feeders)
    return models.Session(
        name=identity.name, role=identity.role, feeders=feeders, open=identity is OPEN, expires=expires
    )


@_sessions.get("/session")
def get_session(request: Request, response: Response) -> models.Session:
    """The caller's identity; 401 without one."""
    response.headers["Cache-Control"] = "no-store"
    authenticator: Authenticator | None = request.app.state.authenticator
    return _session(OPEN if authenticator is None else authenticator.identify(request))


@_sessions.post("/session", dependencies=[Depends(json_only)])
def log_in(request: Request, response: Response, given: models.LogIn) -> models.Session:
    """Exchange an API key for a cookie of the web page."""
    response.headers["Cache-Control"] = "no-store"
    authenticator: Authenticator | None = request.app.state.authenticator
    if authenticator is None:
        return _session(OPEN)
    client = client_of(request)
    identity, cookie, expires = authenticator.log_in(given.key, client)
    # A browser refuses a secure cookie over plain HTTP; beyond loopback the page needs HTTPS.
    secure_page = request.headers.get("origin", "").startswith("https://")
    plain = request.url.scheme == "http" and is_loopback(request.url.hostname or "") and not secure_page
    response.set_cookie(
        COOKIE,
        cookie,
        max_age=int(expires - authenticator.wall()),
        httponly=True,
        samesite="strict",
        secure=not plain,
    )
    return _session(identity, expires)


@_sessions.delete("/session", status_code=204)
def log_out(request: Request, response: Response) -> None:
    """End the session of the cookie."""
    authenticator: Authenticator | None = request.app.state.authenticator
    if authenticator is not None:
        authenticator.log_out(session_of(request))
    response.delete_cookie(COOKIE, httponly=True, samesite="strict")


@_sessions.get("/audit")
def list_audit(
    request: Request,
    after: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Only entries with a higher number.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> models.AuditLog:
    """Entries of the audit log, oldest first."""
    authenticator: Authenticator | None = request.app.state.authenticator
    entries = [] if authenticator is None else authenticator.store.audit(after=after, limit=limit)
    return models.AuditLog(entries=entries)
