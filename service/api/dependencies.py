"""Dependencies of the routes: the running service, the caller, parameters and headers they have in common."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from concurrent.futures import Future
from math import ceil
from typing import Annotated, Any, Protocol, TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Header, HTTPException, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError

from gridsec.errors import GridsecError
from service.access.identity import OPEN, POLICY, PUBLIC, Identity, NotPermitted, Role
from service.alarms.state_machine import Alarm
from service.api import tables
from service.api.access import FRESH_S, Authenticator, authorise
from service.engine.commissioning import CommissioningProgress
from service.engine.operators import Operators
from service.errors import FeederNotLoaded, FeederUnknown
from service.report.feeder_info import Ownership
from service.report.report import BUSBAR, FeederReport
from service.store import Store

T = TypeVar("T")

MAX_EVENT = (1 << 63) - 1
"""Largest number of an event."""
NAME = r"^[A-Za-z0-9_-]{1,64}$"
"""Pattern of the names of feeders, meters and targets."""
RESERVED = 0.2
"""Part of the event streams that viewers leave open, 1: wall displays must not keep operators out."""
IDENTITY = "gridsec.identity"
"""Entry of the ASGI scope with the identity of a request that the front of a cluster has authenticated."""


class Answered(Exception):
    """Ends a request with a response that another process of the cluster has made."""

    def __init__(self, response: Response) -> None:
        self.response = response
        super().__init__(response.status_code)


Forward = Callable[[Request, Identity, str, bytes], Awaitable[Response | None]]
"""Forwards a request with identity, method and path template, and body; None: this process answers it."""


class Backend(Protocol):
    """Interface of the running service, such as `runtime.Runtime`."""

    @property
    def store(self) -> Store:
        """The database, for reads."""

    def feeders(self) -> list[dict[str, Any]]:
        """Return the fields of `models.FeederSummary` for every feeder; verdict and time are added here."""

    def feeder(self, name: str) -> dict[str, Any] | None:
        """Return the fields of `models.FeederDetail`, or None for an unknown feeder."""

    def known(self, name: str) -> bool:
        """True if the feeder is monitored; fast."""

    def unloaded(self, name: str) -> str | None:
        """Return the reason why the stored tables of a feeder cannot be loaded, or None."""

    def report(self, name: str) -> FeederReport | None:
        """Return the latest report of a feeder, or None before its first tick."""

    def summary(self, name: str) -> dict[str, Any]:
        """Return the numbers of a feeder in the list of feeders; empty before its first tick."""

    async def latest(self, name: str) -> FeederReport | None:
        """Return the latest report of a feeder as `report` does; it may be that of another process."""

    def ownership(self, name: str) -> Ownership | None:
        """Return the worker that monitors a feeder; None without workers."""

    def age(self, report: FeederReport) -> float:
        """Return the age of a feeder's latest report by the service's clock, s."""

    def commissioning(self, name: str) -> CommissioningProgress | None:
        """Return the progress of a feeder's commissioning, or None for an unknown feeder."""

    def unstored(self) -> tuple[int, str | None]:
        """Return the number of alarm changes that wait for the database, and its problem or None."""

    def metrics(self) -> bytes:
        """Return the metrics in Prometheus's text format."""

    def ready(self) -> tuple[bool, list[str]]:
        """Return True if everything needed for monitoring works, and the problems otherwise."""

    def healthy(self) -> tuple[bool, list[str]]:
        """Return True if the process can continue, and the problems otherwise."""

    async def put_feeder(self, name: str, tables: dict[str, Any]) -> None:
        """Take over a feeder's tables; raises the errors of invalid tables, or TooManyFeeders."""

    async def delete_feeder(self, name: str) -> None:
        """Stop monitoring a feeder; raises FeederUnknown or FeederFixed."""

    async def acknowledge(self, alarm_id: str, who: str, comment: str, *, count: int | None = None) -> Alarm:
        """Acknowledge an alarm and return it; raises AlarmUnknown, RaisedAgain or AlreadyAcknowledged."""

    async def operate(self, action: Callable[[Operators], Future[T]]) -> T:
        """Execute an action of an operator; it is stored when this returns. Raises its errors."""

    @property
    def shelve_most_s(self) -> float:
        """Longest time of a shelf, s."""

    async def recommission(
        self, name: str, meters: Sequence[str], who: str, reason: str
    ) -> CommissioningProgress:
        """Restart the learning of meters, empty for all; raises FeederUnknown or NothingToLearn."""

    def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        """Return an asynchronous generator of wake-ups; it ends when the service stops.

        Each is `{"type": "alarm" | "state", "data": ...}`, sent after the alarm is stored or the report
        replaced. Only the type is read here: the backend may drop wake-ups of a slow client, as long as one
        is left. The first step into the generator subscribes, closing it unsubscribes.
        """


async def wakes(backend: Backend) -> AsyncIterator[None]:
    """Yield once after the subscription, and again after each wake-up, until the service stops."""
    subscription = backend.subscribe()
    waiting: asyncio.Future[dict[str, Any] | None] | None = None
    try:
        while True:
            waiting = asyncio.ensure_future(anext(subscription, None))
            await asyncio.sleep(0)  # The first step subscribes: no later change is missed.
            yield
            if await waiting is None:
                return
    finally:
        if waiting is not None:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)
        await subscription.aclose()


async def known_query(request: Request) -> None:
    """Refuse unknown query parameters: a misspelt filter would otherwise select everything."""
    known = request.app.state.queries[request.scope["route"].path, request.method]
    what = f"unknown parameter; expected {', '.join(sorted(known)) or 'none'}"
    unknown = [name for name in request.query_params if name not in known]
    if unknown:
        raise RequestValidationError(
            [{"loc": ("query", name), "msg": what, "type": "unknown-parameter"} for name in unknown]
        )


def _media(accept: Annotated[str, Header(include_in_schema=False)] = "") -> str:
    """Type of the response of a route with tables."""
    media = tables.preferred(accept)
    if media is None:
        raise HTTPException(406, f"none of {accept!r} is available; expected {', '.join(tables.MEDIA)}")
    return media


def _backend(request: Request) -> Backend:
    backend: Backend = request.app.state.backend
    return backend


async def authorised(request: Request) -> Identity:
    """Identity of a request that may use its route. Raises Answered if another process has answered it."""
    route = f"{request.method} {request.scope['route'].path}"
    if POLICY.get(route, Role.ADMIN) is PUBLIC:
        return OPEN
    forward: Forward | None = request.app.state.forward
    authenticator: Authenticator | None = request.app.state.authenticator
    identity: Identity = request.scope.get(IDENTITY, OPEN)
    if authenticator is None and forward is None:
        return identity
    body = b"" if request.method in {"GET", "HEAD"} else await request.body()
    if authenticator is not None:
        # Threads of their own: a slow database or issuer must not occupy those of the probes.
        threads: CapacityLimiter = request.app.state.access_threads
        identity = await to_thread.run_sync(authorise, authenticator, request, route, body, limiter=threads)
    if forward is not None and (found := await forward(request, identity, route, body)) is not None:
        raise Answered(found)
    return identity


class Permission:
    """Permission of an open stream, verified again every `FRESH_S`."""

    def __init__(self, request: Request, caller: Identity) -> None:
        self._request, self.caller, self._verified = request, caller, time.monotonic()

    async def lasts(self) -> bool:
        """True while the credential is valid and stands for the same identity."""
        authenticator: Authenticator | None = self._request.app.state.authenticator
        if authenticator is None or time.monotonic() - self._verified < FRESH_S:
            return True
        self._verified = time.monotonic()
        threads: CapacityLimiter = self._request.app.state.access_threads
        try:
            now = await to_thread.run_sync(authenticator.identify, self._request, limiter=threads)
        except GridsecError:
            return False
        return now == self.caller


def operator_of(identity: Identity, given: str | None) -> str:
    """Name of the operator: that of the credential, or without authentication the given one."""
    if identity is OPEN and given is not None:
        return given
    if identity is OPEN:
        raise RequestValidationError([{"loc": ("body", "who"), "msg": "Field required", "type": "missing"}])
    if given not in {None, identity.name}:
        raise NotPermitted(f"`who` must be left out: the credential is that of {identity.name}")
    return identity.name


BackendHere = Annotated[Backend, Depends(_backend)]
Caller = Annotated[Identity, Depends(authorised)]
FeederName = Annotated[str, Path(pattern=NAME, description="Name of the feeder.")]
Since = Annotated[float | None, Query(allow_inf_nan=False, description="Not before this Unix time, s.")]
Until = Annotated[float | None, Query(allow_inf_nan=False, description="Before this Unix time, s.")]


def known_feeder(backend: BackendHere, feeder: FeederName) -> str:
    """Name of a monitored feeder; raises FeederNotLoaded or FeederUnknown."""
    if backend.known(feeder):
        return feeder
    if problem := backend.unloaded(feeder):
        raise FeederNotLoaded(feeder, problem)
    raise FeederUnknown(feeder)


def _latest(backend: BackendHere, feeder: Annotated[str, Depends(known_feeder)]) -> FeederReport:
    report = backend.report(feeder)
    if report is None:
        raise HTTPException(503, f"feeder {feeder!r} has had no tick yet", {"Retry-After": "1"})
    return report


async def json_only(request: Request) -> None:
    """Refuse bodies without the type JSON; this also prevents posts from foreign web pages."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HTTPException(415, f"the body must be application/json, not {kind or 'of unknown type'}")


async def stream_slot(request: Request, caller: Caller) -> AsyncIterator[None]:
    """Count a stream while it is open. Viewers leave a part `RESERVED` of the streams to operators."""
    state, viewer = request.app.state, not caller.role.includes(Role.OPERATOR)
    most = state.max_streams
    of_viewers = most - ceil(RESERVED * most)
    if state.streams >= most:
        raise HTTPException(503, f"{most} event streams are open already", {"Retry-After": "10"})
    if viewer and state.viewers >= of_viewers:
        reason = f"{of_viewers} event streams of viewers are open already"
        raise HTTPException(503, reason, {"Retry-After": "10"})
    state.streams, state.viewers = state.streams + 1, state.viewers + viewer
    try:
        yield
    finally:
        state.streams, state.viewers = state.streams - 1, state.viewers - viewer


KnownFeeder = Annotated[str, Depends(known_feeder)]
Latest = Annotated[FeederReport, Depends(_latest)]
Media = Annotated[str, Depends(_media)]
IfNoneMatch = Annotated[str | None, Header(include_in_schema=False)]

NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "Unchanged."}}
TABLES: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {"schema": {"type": "string"}} for media in tables.MEDIA[1:]}}
}


def unchanged(response: Response, tag: str, if_none_match: str | None) -> Response | None:
    """Set the ETag of a response; return the response 304 if the client has the same version."""
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    response.headers.update(headers)
    known = {part.strip() for part in (if_none_match or "").split(",")}
    return Response(status_code=304, headers=headers) if known & {tag, "*"} else None


def set_table_headers(request: Request, response: Response, media: str, **following: Any) -> None:
    """Set the headers of a response with tables; `following` are the parameters of the next page."""
    response.headers["Vary"] = "Accept"
    if following and media != tables.JSON:
        url = request.url.include_query_params(**following)
        response.headers["Link"] = f'<{url.path}?{url.query}>; rel="next"'


def as_table(response: Response, content: bytes, media: str) -> Response:
    """Return a table with the headers of the response."""
    headers = {name: response.headers[name] for name in response.headers if name != "content-length"}
    return Response(content, media_type=media, headers=headers)


def has_meter(backend: Backend, feeder: str, meter: str) -> bool:
    """True if a feeder has a meter, or had it within its history."""
    report = backend.report(feeder)
    if meter == BUSBAR or (report is not None and meter in {one.meter for one in report.meters}):
        return True
    layout = (backend.feeder(feeder) or {}).get("layout", {"customers": []})
    present = {row["meter"] for row in layout["customers"]}
    return meter in present or meter in backend.store.history_meters(feeder)
