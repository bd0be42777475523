"""REST, server-sent events and the web page. The only module that imports FastAPI.

This module owns no state: reads come from the store and from the backend's latest reports, writes go through
the backend. Streams have no queue per client. After a wake-up from the backend each one reads from the store
(alarms, by event number) or takes the latest report (states), so that a slow client costs no memory and loses
no alarm. Every error is `application/problem+json` (RFC 9457).
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import secrets
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Collection, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import asdict
from functools import partial
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal, Protocol, TypeVar, cast

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, FastAPI, Header, HTTPException, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent
from fastapi.staticfiles import StaticFiles
from pydantic import StringConstraints, TypeAdapter
from starlette.middleware.gzip import GZipMiddleware

from gridsec.errors import FeederInvalid, GridsecError, Problem
from service.access.identity import OPEN, POLICY, PUBLIC, Identity, NotPermitted, Role
from service.alarms.incidents import (
    Incident,
    IncidentEvent,
    IncidentKind,
    IncidentState,
    IncidentUnknown,
    PlannedWork,
    Shelf,
    ShelfUnknown,
    WorkUnknown,
)
from service.alarms.state_machine import Alarm, AlarmKind, AlarmState, AlarmUnknown, Severity
from service.api import guide, models, overview, tables
from service.api.access import COOKIE, FRESH_S, Authenticator, authorise, client_of, session_of
from service.api.description import BODY, TAGS, feeder_schemas
from service.api.errors import Guard, HeadAsGet, handlers, problem
from service.engine.commissioning import CommissioningProgress
from service.engine.operators import Operators, ShelfRequest
from service.errors import FeederNotLoaded, FeederUnknown
from service.notify.delivery import Notifier
from service.report.feeder_info import FeederStatus
from service.report.report import BUSBAR, FeederReport
from service.settings import is_loopback
from service.store import AlarmEvent, Store, StoreUnavailable
from service.store.series import LONGEST_S

T = TypeVar("T")


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


ANSWER_S = 0.7
"""Time limit of the test write, s: `/readyz` answers within 1 s."""


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
        return f"{self._store.name}: no answer within {ANSWER_S:g} s"

    async def _check(self) -> str | None:
        # In a separate thread: reads that wait for the database may occupy all shared ones.
        try:
            await to_thread.run_sync(self._access, limiter=CapacityLimiter(1), abandon_on_cancel=True)
        except StoreUnavailable as error:
            return str(error)
        return None

    def _access(self) -> None:
        """Test both databases."""
        self._store.check()
        if self._authenticator is not None:
            self._authenticator.store.any_key()


ACCESS_THREADS = 16
"""Largest number of requests that are authenticated at a time."""
MAX_BODY = 4 << 20
"""Largest request body, bytes."""
MAX_STREAMS = 100
"""Largest number of open event streams."""
GZIP_BYTES = 1000
"""Smallest response that is compressed, bytes."""
GZIP_LEVEL = 5
"""Level of the compression, 1 to 9."""
SHIFT_S = 8 * 3600.0
"""Length of a shift, s: time of the comments of a hand-over."""
MAX_EVENT = (1 << 63) - 1
"""Largest number of an event."""
_STATE, _EVENT = TypeAdapter(models.State), TypeAdapter(AlarmEvent)
_INCIDENT_EVENT = TypeAdapter(IncidentEvent)
_WEB = FilePath(__file__).parent.with_name("web")
_NAME = r"^[A-Za-z0-9_-]{1,64}$"


def create_api(
    backend: Backend,
    hosts: Collection[str] = (),
    *,
    max_streams: int = MAX_STREAMS,
    authenticator: Authenticator | None = None,
    notifier: Notifier | None = None,
) -> FastAPI:
    """Return the HTTP application.

    `hosts` are host names for requests that change something, besides `localhost` and the machine's name.
    Without an authenticator every request has the identity `OPEN`.
    """
    app = FastAPI(
        title="gridsec",
        description="Monitors the voltages of distribution feeders and identifies manipulated meters.",
        version="1",
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        openapi_tags=TAGS,
        generate_unique_id_function=lambda route: route.name,
        responses={"default": {"model": models.Problem, "description": "Any error."}},
        dependencies=[Depends(_authorised)],
    )
    app.state.authenticator, app.state.notifier = authenticator, notifier
    app.state.access_threads = CapacityLimiter(ACCESS_THREADS)
    app.state.backend = backend
    app.state.probe = Probe(backend.store, authenticator)
    app.state.streams, app.state.max_streams = 0, max_streams
    app.state.run = secrets.token_hex(4)
    app.add_middleware(GZipMiddleware, minimum_size=GZIP_BYTES, compresslevel=GZIP_LEVEL)
    app.add_middleware(HeadAsGet)
    app.add_middleware(Guard, max_body=MAX_BODY, hosts=hosts)
    for error, handler in handlers().items():
        app.add_exception_handler(error, handler)
    app.add_exception_handler(RequestValidationError, _validation_handler)
    app.include_router(_feeders)
    app.include_router(_alarms)
    app.include_router(_incidents)
    app.include_router(_shelves)
    app.include_router(_works)
    app.include_router(_shift)
    app.include_router(_notifications)
    app.include_router(_operations)
    app.include_router(_sessions)
    app.add_route(guide.ADDRESS, guide.show, include_in_schema=False)
    app.mount("/", _Web(directory=_WEB, html=True), name="web")
    _describe(app)
    app.state.queries = _queries(app.openapi())
    return app


class _Web(StaticFiles):
    """The page. Browsers revalidate its files on every load, so that an upgrade takes effect at once."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response

    async def get_response(self, path: str, scope: Any) -> Response:
        """Return a file; 405 for a resource without the method: the page is mounted at every path."""
        if methods := _methods(scope["app"], scope["path"]):
            raise HTTPException(405, "Method Not Allowed", {"Allow": ", ".join(sorted(methods))})
        return await super().get_response(path, scope)


def _methods(app: FastAPI, path: str) -> frozenset[str]:
    """Methods of the resource at a path; a literal path goes before one with parameters."""
    queries: dict[tuple[str, str], frozenset[str]] = app.state.queries
    templates = {template for template, _ in queries}
    fitting = {path} & templates or {each for each in templates if _fits(each, path)}
    found = {method for template, method in queries if template in fitting}
    return frozenset(found | ({"HEAD"} if "GET" in found else set()))


def _fits(template: str, path: str) -> bool:
    """True if a path has the form of a template such as `/api/v1/feeders/{feeder}`."""
    parts, given = template.split("/"), path.split("/")
    return len(parts) == len(given) and all(
        bool(one) if each.startswith("{") else each == one for each, one in zip(parts, given, strict=True)
    )


def _describe(app: FastAPI) -> None:
    """Write the OpenAPI description once, with errors as problems."""
    schema = app.openapi()
    error = {"$ref": "#/components/schemas/Problem"}
    for path in schema["paths"].values():
        for operation in path.values():
            operation["responses"].pop("422", None)
            operation["responses"]["default"]["content"] = {"application/problem+json": {"schema": error}}
    schemas = schema["components"]["schemas"]
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for name, shown in models.RENAMED.items():
        schemas[shown] = {**schemas.pop(name), "title": shown}
    schemas.update(feeder_schemas())
    put = schema["paths"]["/api/v1/feeders/{feeder}"]["put"]["requestBody"]
    put["content"]["application/json"]["schema"] = {"$ref": f"#/components/schemas/{BODY}"}
    text = json.dumps(schema)
    for name, shown in models.RENAMED.items():
        text = text.replace(f'"#/components/schemas/{name}"', f'"#/components/schemas/{shown}"')
    app.openapi_schema = json.loads(text)


def _queries(schema: dict[str, Any]) -> dict[tuple[str, str], frozenset[str]]:
    """Return the names of the query parameters by path and method, from the OpenAPI description."""
    return {
        (path, method.upper()): frozenset(
            each["name"] for each in operation.get("parameters", ()) if each["in"] == "query"
        )
        for path, methods in schema["paths"].items()
        for method, operation in methods.items()
    }


async def _known_query(request: Request) -> None:
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


async def _authorised(request: Request) -> Identity:
    """Identity of a request that may use its route."""
    authenticator: Authenticator | None = request.app.state.authenticator
    if authenticator is None:
        return OPEN
    route = f"{request.method} {request.scope['route'].path}"
    if POLICY.get(route, Role.ADMIN) is PUBLIC:
        return OPEN
    body = b"" if request.method in {"GET", "HEAD"} else await request.body()
    # Threads of their own: a slow database or issuer must not occupy those of the probes.
    threads: CapacityLimiter = request.app.state.access_threads
    return await to_thread.run_sync(authorise, authenticator, request, route, body, limiter=threads)


class _Permission:
    """Permission of an open stream, verified again every `FRESH_S`."""

    def __init__(self, request: Request, caller: Identity) -> None:
        self._request, self._caller, self._verified = request, caller, time.monotonic()

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
        return now == self._caller


def _operator(identity: Identity, given: str | None) -> str:
    """Name of the operator: that of the credential, or without authentication the given one."""
    if identity is OPEN and given is not None:
        return given
    if identity is OPEN:
        raise RequestValidationError([{"loc": ("body", "who"), "msg": "Field required", "type": "missing"}])
    if given not in {None, identity.name}:
        raise NotPermitted(f"`who` must be left out: the credential is that of {identity.name}")
    return identity.name


BackendHere = Annotated[Backend, Depends(_backend)]
Caller = Annotated[Identity, Depends(_authorised)]
FeederName = Annotated[str, Path(pattern=_NAME, description="Name of the feeder.")]
AlarmId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the alarm.")]
IncidentId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the incident.")]
ShelfId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the shelf.")]
WorkId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the planned work.")]
Words = Annotated[
    str | None, Query(max_length=200, description="Only with each of these words, in any case.")
]
Cursor = Annotated[str | None, Query(pattern=r"^([0-9.e+-]{1,32}~)?[0-9A-Z]{26}$")]
Since = Annotated[float | None, Query(allow_inf_nan=False, description="Not before this Unix time, s.")]
Until = Annotated[float | None, Query(allow_inf_nan=False, description="Before this Unix time, s.")]


def _known_feeder(backend: BackendHere, feeder: FeederName) -> str:
    if backend.known(feeder):
        return feeder
    if problem := backend.unloaded(feeder):
        raise FeederNotLoaded(feeder, problem)
    raise FeederUnknown(feeder)


def _latest(backend: BackendHere, feeder: Annotated[str, Depends(_known_feeder)]) -> FeederReport:
    report = backend.report(feeder)
    if report is None:
        raise HTTPException(503, f"feeder {feeder!r} has had no tick yet", {"Retry-After": "1"})
    return report


async def _json_only(request: Request) -> None:
    """Refuse bodies without the type JSON; this also prevents posts from foreign web pages."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HTTPException(415, f"the body must be application/json, not {kind or 'of unknown type'}")


async def _slot(request: Request) -> AsyncIterator[None]:
    """Count a stream while it is open."""
    state = request.app.state
    if state.streams >= state.max_streams:
        raise HTTPException(503, f"{state.max_streams} event streams are open already", {"Retry-After": "10"})
    state.streams += 1
    try:
        yield
    finally:
        state.streams -= 1


KnownFeeder = Annotated[str, Depends(_known_feeder)]
Latest = Annotated[FeederReport, Depends(_latest)]
Media = Annotated[str, Depends(_media)]
IfNoneMatch = Annotated[str | None, Header(include_in_schema=False)]

_NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "Unchanged."}}
_TABLES: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {"schema": {"type": "string"}} for media in tables.MEDIA[1:]}}
}


def _unchanged(response: Response, tag: str, if_none_match: str | None) -> Response | None:
    """Set the ETag of a response; return the response 304 if the client has the same version."""
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    response.headers.update(headers)
    known = {part.strip() for part in (if_none_match or "").split(",")}
    return Response(status_code=304, headers=headers) if known & {tag, "*"} else None


# -------------------------------------------------------------------- feeders

_feeders = APIRouter(prefix="/api/v1/feeders", tags=["feeders"], dependencies=[Depends(_known_query)])


def _detail(backend: Backend, feeder: str) -> dict[str, Any]:
    fields = backend.feeder(feeder)
    if fields is None:
        raise FeederUnknown(feeder)
    return fields


@_feeders.get("")
def list_feeders(
    backend: BackendHere,
    caller: Caller,
    *,
    order: Annotated[
        overview.Order, Query(description="`worst`: by status, suspects, new alarms and time.")
    ] = overview.Order.GIVEN,
    text: Annotated[str, Query(max_length=100, description="Only those with it in name or title.")] = "",
    status: Annotated[list[FeederStatus], Query(description="Only those with one of these.")] = [],  # noqa: B006
    include: Annotated[
        str | None, Query(pattern=_NAME, description="Feeder that follows the page if it is not on it.")
    ] = None,
    offset: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Number of feeders before the page.")] = 0,
    limit: Annotated[int | None, Query(ge=1, le=5000, description="Without it all.")] = None,
) -> models.Feeders:
    """All feeders with the latest verdict of each, or a page of them, the worst first."""
    alarms = backend.store.alarms_by_feeder()
    found = [
        overview.standing(fields, backend.summary(name), alarms.get(name))
        for fields in backend.feeders()
        if caller.sees(name := fields["name"])
    ]
    part = (offset, limit)
    return overview.page(found, order=order, text=text, status=status, include=include, part=part)


@_feeders.get("/{feeder}", response_model=models.FeederDetail, responses=_NOT_MODIFIED)
def get_feeder(
    backend: BackendHere, feeder: KnownFeeder, response: Response, if_none_match: IfNoneMatch = None
) -> Any:
    """A feeder: its tree, and the columns of its files."""
    fields = _detail(backend, feeder)
    return _unchanged(response, f'"{fields["revision"]}"', if_none_match) or fields


@_feeders.put("/{feeder}", response_model=models.FeederDetail, dependencies=[Depends(_json_only)])
async def put_feeder(backend: BackendHere, feeder: FeederName, tables: dict[str, Any]) -> Any:
    """Add a feeder or replace it, from JSON of the same columns as its files."""
    try:
        await to_thread.run_sync(lambda: json.dumps(tables, allow_nan=False))
    except ValueError as error:
        text = "the JSON contains NaN or an infinity; leave the field out instead"
        raise FeederInvalid([Problem("not-finite", text)]) from error
    await backend.put_feeder(feeder, tables)
    return _detail(backend, feeder)


@_feeders.delete("/{feeder}", status_code=204)
async def delete_feeder(backend: BackendHere, feeder: FeederName) -> None:
    """Stop monitoring a feeder that was added over REST: its alarms are cleared, its history stays."""
    await backend.delete_feeder(feeder)


@_feeders.get("/{feeder}/state")
def get_state(backend: BackendHere, report: Latest, response: Response) -> models.State:
    """The latest tick: verdict, and every meter with its reported and its reconstructed voltage."""
    response.headers["Cache-Control"] = "no-store"
    return _state(backend, report)


def _state(backend: Backend, report: FeederReport) -> models.State:
    return models.extended(models.State, report, age_s=backend.age(report))


@_feeders.get("/{feeder}/meters/{meter}")
def get_meter(backend: BackendHere, report: Latest, meter: str, response: Response) -> models.MeterNow:
    """One meter at the latest tick, and its commissioning."""
    response.headers["Cache-Control"] = "no-store"
    found = next((one for one in report.meters if one.meter == meter), None)
    if found is None:
        raise HTTPException(404, f"feeder {report.feeder!r} has no meter {meter!r}")
    progress = backend.commissioning(report.feeder)
    learned = () if progress is None else progress.meters
    return models.extended(
        models.MeterNow,
        found,
        feeder=report.feeder,
        t=report.t,
        verdict=report.verdict,
        commissioning=next((one for one in learned if one.meter == meter), None),
    )


@_feeders.get("/{feeder}/history", response_model=models.History, responses=_TABLES)
def get_history(
    request: Request,
    response: Response,
    backend: BackendHere,
    feeder: KnownFeeder,
    media: Media,
    *,
    since: Since = None,
    until: Until = None,
    meter: Annotated[
        str | None, Query(pattern=_NAME, description="Include the numbers of this meter.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=5000)] = 500,
) -> Any:
    """The newest kept ticks in [since, until), oldest first."""
    rows = backend.store.history(feeder, since=since, until=until, meter=meter, limit=limit)
    if meter is not None and not any(row["meter"] for row in rows) and not _has(backend, feeder, meter):
        raise HTTPException(404, f"feeder {feeder!r} has no meter {meter!r}")
    more = len(rows) == limit
    _link(request, response, media, **({"until": rows[0]["t"]} if more else {}))
    if media != tables.JSON:
        return _as_table(response, tables.encoded(tables.history(rows, meter), media), media)
    return {"feeder": feeder, "points": rows, "more": more}


MAX_SERIES = 12
"""Largest number of meters of one time series."""
MAX_BUCKETS = 2000
"""Largest number of buckets of one time series."""


@_feeders.get("/{feeder}/series", response_model=models.Series, responses=_TABLES)
def get_series(
    request: Request,
    response: Response,
    backend: BackendHere,
    feeder: KnownFeeder,
    media: Media,
    *,
    meter: Annotated[
        list[Annotated[str, StringConstraints(pattern=_NAME)]] | None,
        Query(max_length=MAX_SERIES, description="May be repeated. Without: verdicts and alarms only."),
    ] = None,
    since: Since = None,
    until: Until = None,
    buckets: Annotated[
        int, Query(ge=1, le=MAX_BUCKETS, description="Largest number of buckets; the ends may add one.")
    ] = 600,
) -> Any:
    """Minimum and maximum of reported and estimated voltages and of the uncertainty band, by bucket.

    Without `until` the series ends with the latest tick, without `since` it covers one hour. The longest one
    covers 15 days. Tables have a row for each bucket and meter, and no alarms.
    """
    if until is None:
        report = backend.report(feeder)
        newest = backend.store.history(feeder, limit=1) if report is None else []
        last = report.t if report is not None else newest[0]["t"] if newest else 0.0
        until = last + 1.0
    since = until - 3600.0 if since is None else since
    if not 0.0 < until - since <= LONGEST_S:
        text = f"must be before until, by at most {LONGEST_S:g} s"
        raise RequestValidationError([{"loc": ("query", "since"), "msg": text, "type": "time"}])
    wanted = list(dict.fromkeys(meter or ()))
    for one in wanted:
        if not _has(backend, feeder, one):
            raise HTTPException(404, f"feeder {feeder!r} has no meter {one!r}")
    found = tables.series(backend.store.series(feeder, wanted, since=since, until=until, buckets=buckets))
    _link(request, response, media)
    response.headers["Cache-Control"] = "no-store"
    if media != tables.JSON:
        return _as_table(response, tables.encoded(tables.series_table(found), media), media)
    spans, more = backend.store.alarm_spans(feeder, since=since, until=until)
    alarms = [
        {
            "id": span.alarm.id,
            "kind": span.alarm.kind,
            "meter": span.alarm.meter,
            "customer": span.alarm.customer,
            "severity": span.alarm.severity,
            "t_raised": span.raised,
            "t_cleared": span.cleared,
        }
        for span in spans
    ]
    return {"feeder": feeder, **found, "alarms": alarms, "more_alarms": more}


def _has(backend: Backend, feeder: str, meter: str) -> bool:
    """True if a feeder has a meter, or had it within its history."""
    report = backend.report(feeder)
    if meter == BUSBAR or (report is not None and meter in {one.meter for one in report.meters}):
        return True
    layout = (backend.feeder(feeder) or {}).get("layout", {"customers": []})
    present = {row["meter"] for row in layout["customers"]}
    return meter in present or meter in backend.store.history_meters(feeder)


def _check_filters(backend: Backend, caller: Identity, feeder: str | None, meter: str | None) -> None:
    """Refuse a feeder and a meter that, in the caller's scope, neither exist nor have any alarm."""
    seen = caller.seen(fields["name"] for fields in backend.feeders())
    names = seen if feeder is None else (feeder,)
    if backend.store.alarms(feeder=feeder, among=caller.feeders, meter=meter, limit=1)[0]:
        return
    if feeder is not None and not (backend.known(feeder) or backend.unloaded(feeder)):
        raise FeederUnknown(feeder)
    if meter is not None and not any(_has(backend, name, meter) for name in names):
        raise HTTPException(404, f"there is no meter {meter!r}")


def _link(request: Request, response: Response, media: str, **following: Any) -> None:
    """Set the headers of a response with tables; `following` are the parameters of the next page."""
    response.headers["Vary"] = "Accept"
    if following and media != tables.JSON:
        url = request.url.include_query_params(**following)
        response.headers["Link"] = f'<{url.path}?{url.query}>; rel="next"'


def _as_table(response: Response, content: bytes, media: str) -> Response:
    """Return a table with the headers of the response."""
    headers = {name: response.headers[name] for name in response.headers if name != "content-length"}
    return Response(content, media_type=media, headers=headers)


@_feeders.get("/{feeder}/commissioning")
def get_commissioning(backend: BackendHere, feeder: KnownFeeder, response: Response) -> models.Commissioning:
    """Commissioning of the meters: gathered time, learned errors, and times."""
    response.headers["Cache-Control"] = "no-store"
    return _commissioning(backend, feeder, backend.commissioning(feeder))


@_feeders.post(
    "/{feeder}/commissioning",
    dependencies=[Depends(_json_only)],
    openapi_extra=models.Recommissioning.in_openapi(),
)
async def recommission(
    backend: BackendHere, feeder: KnownFeeder, request: Request, caller: Caller
) -> models.Commissioning:
    """Restart the learning: of replaced meters, or without `meters` of the whole feeder."""
    layout = _detail(backend, feeder)["layout"]
    meters = [row["meter"] for row in layout["customers"] if row["meter"]]
    found = models.Recommissioning.of(await request.body(), meters, named=caller is not OPEN)
    if isinstance(found, list):
        raise RequestValidationError(found)
    who = _operator(caller, found.who)
    progress = await backend.recommission(feeder, found.meters or (), who, found.reason)
    return await to_thread.run_sync(_commissioning, backend, feeder, progress)


@_feeders.get("/{feeder}/commissioning/events")
def get_commissioning_events(
    backend: BackendHere, feeder: KnownFeeder, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> models.CommissioningEvents:
    """The newest changes of the commissioning, with operator and reason, oldest first."""
    return models.CommissioningEvents(events=backend.store.commission_events(feeder, limit))


def _commissioning(
    backend: Backend, feeder: str, progress: CommissioningProgress | None
) -> models.Commissioning:
    if progress is None:
        raise FeederUnknown(feeder)
    kept = backend.store.commission(feeder)
    return models.extended(models.Commissioning, progress, kept=None if kept is None else kept.t)


@_feeders.get(
    "/{feeder}/stream", response_class=EventSourceResponse, dependencies=[Depends(_slot)], tags=["streams"]
)
async def stream_states(
    request: Request, backend: BackendHere, caller: Caller, feeder: KnownFeeder
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events `state`: the latest tick and each later one; a slow client skips some."""
    yield ServerSentEvent(comment="connected", retry=2000)
    last: FeederReport | None = None
    permission = _Permission(request, caller)
    async for _ in wakes(backend):
        if not backend.known(feeder) or not await permission.lasts():
            return
        report = backend.report(feeder)
        if report is not None and report is not last:
            last = report
            data = _STATE.dump_json(_state(backend, report)).decode()
            yield ServerSentEvent(event="state", raw_data=data)


# --------------------------------------------------------------------- alarms

_alarms = APIRouter(prefix="/api/v1/alarms", tags=["alarms"], dependencies=[Depends(_known_query)])


@_alarms.get("", response_model=models.Alarms, responses=_NOT_MODIFIED | _TABLES)
def list_alarms(  # one argument per query parameter
    request: Request,
    backend: BackendHere,
    caller: Caller,
    response: Response,
    media: Media,
    *,
    state: Annotated[list[AlarmState] | None, Query(description="May be repeated.")] = None,
    kind: Annotated[list[AlarmKind] | None, Query(description="May be repeated.")] = None,
    severity: Annotated[list[Severity] | None, Query(description="May be repeated.")] = None,
    feeder: Annotated[str | None, Query(pattern=_NAME)] = None,
    meter: Annotated[str | None, Query(pattern=_NAME)] = None,
    since: Since = None,
    until: Until = None,
    text: Words = None,
    incident: Annotated[str | None, Query(pattern=r"^[0-9A-Z]{26}$", description="Of this incident.")] = None,
    shelved: Annotated[bool | None, Query(description="Only shelved ones, or only others.")] = None,
    sort: Annotated[
        Literal["onset", "severity", "raised"], Query(description="Latest, or most severe, first.")
    ] = "onset",
    cursor: Cursor = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    if_none_match: IfNoneMatch = None,
) -> Any:
    """A page of alarms; `since` and `until` refer to `t_raised`."""
    _within(caller, feeder)
    last_event, last_change = backend.store.last_event, backend.store.last_incident_event
    # Before the page is read: changes stored in between are in the page.
    unstored, trouble = backend.unstored()
    # Event numbers identify changes within one database, and a run has only one.
    scope = None if caller.feeders is None else sorted(caller.feeders)
    waits = hashlib.sha256(f"{unstored} {trouble} {scope}".encode()).hexdigest()[:16]
    form = "" if media == tables.JSON else f"-{tables.MEDIA.index(media)}"
    if known := _unchanged(
        response, f'W/"{request.app.state.run}-{last_event}-{last_change}-{waits}{form}"', if_none_match
    ):
        return known
    page, following = backend.store.alarms(
        state=state or (),
        kind=kind or (),
        severity=severity or (),
        feeder=feeder,
        among=scope,
        meter=meter,
        since=since,
        until=until,
        text=text,
        incident=incident,
        shelved=shelved,
        sort=sort,
        cursor=cursor,
        limit=limit,
    )
    listed = _listed(backend, page)
    if not page and (feeder is not None or meter is not None):
        _check_filters(backend, caller, feeder, meter)
    _link(request, response, media, **({} if following is None else {"cursor": following}))
    if media != tables.JSON:
        return _as_table(response, tables.encoded(tables.alarms(listed), media), media)
    return models.Alarms(
        alarms=listed,
        next=following,
        last_event=last_event,
        raised=backend.store.raised(among=scope),
        unstored=unstored,
        problem=trouble,
    )


@_alarms.get("/stream", response_class=EventSourceResponse, dependencies=[Depends(_slot)], tags=["streams"])
async def stream_alarms(  # noqa: PLR0917  # one argument per query parameter
    request: Request,
    backend: BackendHere,
    caller: Caller,
    feeder: Annotated[str | None, Query(pattern=_NAME, description="Restrict to this feeder.")] = None,
    after: Annotated[int | None, Query(ge=0, description="Begin after this event number.")] = None,
    last_event_id: Annotated[int | None, Header(ge=0, description="Takes precedence over `after`.")] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events `alarm`, with event numbers as ids: with `Last-Event-ID` none is missed.

    Without it and without `after`, the stream starts with the next event.
    """
    _within(caller, feeder)
    store = backend.store
    start = last_event_id if last_event_id is not None else after
    # A number beyond the newest belongs to another database: start now, otherwise no event would ever come.
    seen = store.last_event if start is None else min(start, store.last_event)
    yield ServerSentEvent(comment="connected", id=str(seen), retry=2000)
    permission = _Permission(request, caller)
    async for _ in wakes(backend):
        if not await permission.lasts():
            return
        while seen < (newest := store.last_event):
            try:
                events = await to_thread.run_sync(partial(store.events_after, seen, feeder=feeder))
            except StoreUnavailable:
                return  # The client reconnects with the number of its last event.
            for event in events:
                seen = event.seq
                if not caller.sees(event.alarm.feeder):
                    continue
                data = _EVENT.dump_json(event).decode()
                yield ServerSentEvent(event="alarm", id=str(event.seq), raw_data=data)
            if not events:
                seen = newest


@_alarms.get("/{alarm_id}")
def get_alarm(backend: BackendHere, caller: Caller, alarm_id: AlarmId) -> models.ListedAlarm:
    """One alarm."""
    (listed,) = _listed(backend, [_alarm(backend, caller, alarm_id)])
    return listed


def _listed(backend: Backend, alarms: Iterable[Alarm]) -> list[models.ListedAlarm]:
    """Alarms with their incidents and what suppresses their notifications."""
    found = list(alarms)
    marks = backend.store.alarm_marks(alarm.id for alarm in found)
    return [
        models.extended(
            models.ListedAlarm,
            alarm,
            incident=marks[alarm.id].incident,
            shelved_until=marks[alarm.id].shelved_until,
            planned_work=marks[alarm.id].planned_work,
        )
        for alarm in found
    ]


def _alarm(backend: Backend, caller: Identity, alarm_id: str) -> Alarm:
    """An alarm within the caller's scope."""
    alarm = backend.store.alarm(alarm_id)
    if alarm is None or not caller.sees(alarm.feeder):
        raise AlarmUnknown(alarm_id)
    return alarm


def _within(caller: Identity, feeder: str | None) -> None:
    """Refuse a feeder outside of the caller's scope."""
    if feeder is not None and not caller.sees(feeder):
        raise NotPermitted(f"{caller.name} has no access to feeder {feeder!r}")


@_alarms.get("/{alarm_id}/events")
def get_events(
    backend: BackendHere,
    caller: Caller,
    alarm_id: AlarmId,
    after: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Only events with a higher number.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> models.AlarmEvents:
    """A page of events of an alarm, oldest first."""
    _alarm(backend, caller, alarm_id)
    found = backend.store.events(alarm_id, after=after, limit=limit + 1)
    page = found[:limit]
    return models.AlarmEvents(events=page, next=page[-1].seq if len(found) > limit else None)


@_alarms.post("/ack", dependencies=[Depends(_json_only)])
async def acknowledge_alarms(
    backend: BackendHere, caller: Caller, answer: models.BulkAcknowledgement
) -> list[Alarm]:
    """Acknowledge several alarms, all or none; those that are acknowledged already stay."""
    who = _operator(caller, answer.who)
    if caller.feeders is not None:
        await to_thread.run_sync(lambda: [_alarm(backend, caller, each) for each in answer.alarms])
    names = list(dict.fromkeys(answer.alarms))
    return await backend.operate(lambda act: act.acknowledge(names, who, answer.comment))


@_alarms.post("/{alarm_id}/unack", dependencies=[Depends(_json_only)])
async def withdraw_acknowledgement(
    backend: BackendHere, caller: Caller, alarm_id: AlarmId, answer: models.Withdrawal
) -> Alarm:
    """Withdraw the acknowledgement of an alarm."""
    who = _operator(caller, answer.who)
    await to_thread.run_sync(_alarm, backend, caller, alarm_id)
    (alarm,) = await backend.operate(lambda act: act.unacknowledge(alarm_id, who, answer.comment))
    return alarm


@_alarms.post("/{alarm_id}/comment", dependencies=[Depends(_json_only)])
async def comment_alarm(
    backend: BackendHere, caller: Caller, alarm_id: AlarmId, answer: models.Remark
) -> Alarm:
    """Add a comment to an alarm; it is an event of the alarm."""
    who = _operator(caller, answer.who)
    await to_thread.run_sync(_alarm, backend, caller, alarm_id)
    (alarm,) = await backend.operate(lambda act: act.comment(alarm_id, who, answer.comment))
    return alarm


@_alarms.post("/{alarm_id}/ack", dependencies=[Depends(_json_only)])
async def acknowledge(
    backend: BackendHere, caller: Caller, alarm_id: AlarmId, answer: models.Acknowledgement
) -> Alarm:
    """Acknowledge an alarm, with the operator's name."""
    who = _operator(caller, answer.who)
    if caller.feeders is not None:
        await to_thread.run_sync(_alarm, backend, caller, alarm_id)
    return await backend.acknowledge(alarm_id, who, answer.comment, count=answer.count)


# ------------------------------------------------------------------ incidents

_incidents = APIRouter(prefix="/api/v1/incidents", tags=["incidents"], dependencies=[Depends(_known_query)])


@_incidents.get("", response_model=models.Incidents, responses=_TABLES)
def list_incidents(  # one argument per query parameter
    request: Request,
    backend: BackendHere,
    caller: Caller,
    response: Response,
    media: Media,
    *,
    state: Annotated[list[IncidentState] | None, Query(description="May be repeated.")] = None,
    kind: Annotated[list[IncidentKind] | None, Query(description="May be repeated.")] = None,
    severity: Annotated[list[Severity] | None, Query(description="May be repeated.")] = None,
    feeder: Annotated[str | None, Query(pattern=_NAME)] = None,
    meter: Annotated[str | None, Query(pattern=_NAME)] = None,
    since: Since = None,
    until: Until = None,
    text: Words = None,
    assigned_to: Annotated[
        str | None, Query(max_length=64, description="Of this person; empty: none.")
    ] = None,
    shelved: Annotated[bool | None, Query(description="Only shelved ones, or only others.")] = None,
    planned: Annotated[bool | None, Query(description="Only under planned work, or only others.")] = None,
    sort: Annotated[
        Literal["onset", "severity", "last"],
        Query(description="Latest first; or those to act on first, and of these the most severe."),
    ] = "onset",
    cursor: Cursor = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Any:
    """A page of incidents; `since` and `until` refer to `t_first` and `t_last`."""
    _within(caller, feeder)
    response.headers["Cache-Control"] = "no-store"
    last_event = backend.store.last_incident_event
    unstored, trouble = backend.unstored()
    scope = None if caller.feeders is None else sorted(caller.feeders)
    page, following = backend.store.incidents(
        state=state or (),
        kind=kind or (),
        severity=severity or (),
        feeder=feeder,
        among=scope,
        meter=meter,
        since=since,
        until=until,
        text=text,
        assigned_to=assigned_to,
        shelved=shelved,
        planned=planned,
        sort=sort,
        cursor=cursor,
        limit=limit,
    )
    if not page and (feeder is not None or meter is not None):
        _check_filters(backend, caller, feeder, meter)
    _link(request, response, media, **({} if following is None else {"cursor": following}))
    if media != tables.JSON:
        return _as_table(response, tables.encoded(tables.incidents(page), media), media)
    return models.Incidents(
        incidents=page,
        next=following,
        last_event=last_event,
        raised=backend.store.open_incidents(among=scope),
        unstored=unstored,
        problem=trouble,
    )


@_incidents.get("/events")
def list_incident_events(
    backend: BackendHere,
    caller: Caller,
    after: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Only events with a higher number.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> models.IncidentEvents:
    """A page of the events of all incidents, oldest first."""
    found = backend.store.incident_events_after(after, limit=limit + 1)
    page = found[:limit]
    return models.IncidentEvents(
        events=[event for event in page if caller.sees(event.incident.feeder)],
        next=page[-1].seq if len(found) > limit else None,
    )


@_incidents.get(
    "/stream", response_class=EventSourceResponse, dependencies=[Depends(_slot)], tags=["streams"]
)
async def stream_incidents(  # noqa: PLR0917  # one argument per query parameter
    request: Request,
    backend: BackendHere,
    caller: Caller,
    feeder: Annotated[str | None, Query(pattern=_NAME, description="Restrict to this feeder.")] = None,
    after: Annotated[int | None, Query(ge=0, description="Begin after this event number.")] = None,
    last_event_id: Annotated[int | None, Header(ge=0, description="Takes precedence over `after`.")] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events `incident`, with event numbers as ids: with `Last-Event-ID` none is missed.

    Without it and without `after`, the stream starts with the next event.
    """
    _within(caller, feeder)
    store = backend.store
    start = last_event_id if last_event_id is not None else after
    newest = store.last_incident_event
    seen = newest if start is None else min(start, newest)
    yield ServerSentEvent(comment="connected", id=str(seen), retry=2000)
    permission = _Permission(request, caller)
    async for _ in wakes(backend):
        if not await permission.lasts():
            return
        while seen < (newest := store.last_incident_event):
            try:
                events = await to_thread.run_sync(partial(store.incident_events_after, seen, feeder=feeder))
            except StoreUnavailable:
                return  # The client reconnects with the number of its last event.
            for event in events:
                seen = event.seq
                if caller.sees(event.incident.feeder):
                    data = _INCIDENT_EVENT.dump_json(event).decode()
                    yield ServerSentEvent(event="incident", id=str(event.seq), raw_data=data)
            if not events:
                seen = newest


@_incidents.get("/{incident_id}")
def get_incident(backend: BackendHere, caller: Caller, incident_id: IncidentId) -> Incident:
    """One incident."""
    return _incident(backend, caller, incident_id)


def _incident(backend: Backend, caller: Identity, incident_id: str) -> Incident:
    """An incident within the caller's scope."""
    incident = backend.store.incident(incident_id)
    if incident is None or not caller.sees(incident.feeder):
        raise IncidentUnknown(incident_id)
    return incident


@_incidents.get("/{incident_id}/events")
def get_incident_events(
    backend: BackendHere,
    caller: Caller,
    incident_id: IncidentId,
    after: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Only events with a higher number.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> models.IncidentEvents:
    """A page of events of an incident, oldest first."""
    _incident(backend, caller, incident_id)
    found = backend.store.incident_events(incident_id, after=after, limit=limit + 1)
    page = found[:limit]
    return models.IncidentEvents(events=page, next=page[-1].seq if len(found) > limit else None)


@_incidents.post("/{incident_id}/ack", dependencies=[Depends(_json_only)])
async def acknowledge_incident(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.IncidentAcknowledgement
) -> Incident:
    """Acknowledge all active alarms of an incident."""
    who = _operator(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(
        lambda act: act.acknowledge_incident(incident_id, who, answer.comment, count=answer.count)
    )


@_incidents.post("/{incident_id}/unack", dependencies=[Depends(_json_only)])
async def withdraw_acknowledgements(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.Withdrawal
) -> Incident:
    """Withdraw the acknowledgements of all active alarms of an incident."""
    who = _operator(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(lambda act: act.unacknowledge_incident(incident_id, who, answer.comment))


@_incidents.post("/{incident_id}/comment", dependencies=[Depends(_json_only)])
async def comment_incident(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.Remark
) -> Incident:
    """Add a comment to an incident; it is an event of the incident."""
    who = _operator(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(lambda act: act.comment_incident(incident_id, who, answer.comment))


@_incidents.post("/{incident_id}/assign", dependencies=[Depends(_json_only)])
async def assign_incident(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.Assignment
) -> Incident:
    """Assign an incident to a person, or with `to` null to none."""
    who = _operator(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(lambda act: act.assign(incident_id, answer.to, who, answer.comment))


# ------------------------------------------------- shelves, planned work, shift

_shelves = APIRouter(prefix="/api/v1/shelves", tags=["incidents"], dependencies=[Depends(_known_query)])
_works = APIRouter(prefix="/api/v1/planned-work", tags=["incidents"], dependencies=[Depends(_known_query)])
_shift = APIRouter(prefix="/api/v1", tags=["incidents"], dependencies=[Depends(_known_query)])
Standing = Annotated[bool, Query(description="Leave out those that have ended.")]


def _scope(caller: Identity) -> list[str] | None:
    return None if caller.feeders is None else sorted(caller.feeders)


@_shelves.get("")
def list_shelves(
    backend: BackendHere,
    caller: Caller,
    *,
    feeder: Annotated[str | None, Query(pattern=_NAME)] = None,
    standing: Standing = True,
) -> models.Shelves:
    """Shelves, newest first."""
    _within(caller, feeder)
    found = backend.store.shelves(standing=standing, feeder=feeder, among=_scope(caller))
    return models.Shelves(shelves=found, max_duration_s=backend.shelve_most_s)


@_shelves.post("", status_code=201, dependencies=[Depends(_json_only)])
async def shelve(backend: BackendHere, caller: Caller, wanted: models.Shelving) -> Shelf:
    """Shelve an alarm, an incident, or alarms of a feeder: they do not notify until the end of the shelf."""
    who = _operator(caller, wanted.who)
    await to_thread.run_sync(_check_shelf, backend, caller, wanted)
    request = ShelfRequest(
        wanted.feeder,
        wanted.alarm,
        wanted.incident,
        wanted.meter,
        wanted.kind,
        wanted.severity,
        wanted.duration_s,
        wanted.reason,
    )
    return await backend.operate(lambda act: act.shelve(request, who))


def _check_shelf(backend: Backend, caller: Identity, wanted: models.Shelving) -> None:
    """Refuse what does not exist in the caller's scope."""
    if wanted.alarm is not None:
        _alarm(backend, caller, wanted.alarm)
    if wanted.incident is not None:
        _incident(backend, caller, wanted.incident)
    if wanted.feeder is not None:
        _within(caller, wanted.feeder)
        _known_feeder(backend, wanted.feeder)
        if wanted.meter is not None and not _has(backend, wanted.feeder, wanted.meter):
            raise HTTPException(404, f"feeder {wanted.feeder!r} has no meter {wanted.meter!r}")


@_shelves.post("/{shelf_id}/end", dependencies=[Depends(_json_only)])
async def end_shelf(
    backend: BackendHere, caller: Caller, shelf_id: ShelfId, answer: models.Withdrawal
) -> Shelf:
    """End a shelf before its time."""
    who = _operator(caller, answer.who)
    found = await to_thread.run_sync(backend.store.shelf, shelf_id)
    if found is None or not caller.sees(found.feeder):
        raise ShelfUnknown(shelf_id)
    return await backend.operate(lambda act: act.unshelve(shelf_id, who, answer.comment))


@_works.get("")
def list_planned_work(
    backend: BackendHere,
    caller: Caller,
    *,
    feeder: Annotated[str | None, Query(pattern=_NAME)] = None,
    standing: Standing = True,
) -> models.PlannedWorks:
    """Planned works, newest first; `standing` includes future ones."""
    _within(caller, feeder)
    found = backend.store.works(standing=standing, feeder=feeder, among=_scope(caller))
    return models.PlannedWorks(planned_work=found)


@_works.post("", status_code=201, dependencies=[Depends(_json_only)])
async def plan_work(backend: BackendHere, caller: Caller, wanted: models.WorkRequest) -> PlannedWork:
    """Enter planned work on a feeder: its alarms are marked and do not notify."""
    who = _operator(caller, wanted.who)
    _within(caller, wanted.feeder)
    _known_feeder(backend, wanted.feeder)
    return await backend.operate(
        lambda act: act.plan_work(wanted.feeder, wanted.t_from, wanted.t_until, who, wanted.reason)
    )


@_works.post("/{work_id}/end", dependencies=[Depends(_json_only)])
async def end_work(
    backend: BackendHere, caller: Caller, work_id: WorkId, answer: models.Withdrawal
) -> PlannedWork:
    """End planned work before its time, or cancel it."""
    who = _operator(caller, answer.who)
    found = await to_thread.run_sync(backend.store.work, work_id)
    if found is None or not caller.sees(found.feeder):
        raise WorkUnknown(work_id)
    return await backend.operate(lambda act: act.end_work(work_id, who, answer.comment))


@_shift.get("/hand-over")
def get_hand_over(
    backend: BackendHere,
    caller: Caller,
    response: Response,
    since: Annotated[
        float | None, Query(allow_inf_nan=False, description="Begin of the comments; by default 8 h ago.")
    ] = None,
) -> models.HandOver:
    """State of the shift: open incidents, shelves, planned work, and comments since a time."""
    response.headers["Cache-Control"] = "no-store"
    scope, store = _scope(caller), backend.store
    since = time.time() - SHIFT_S if since is None else since
    open_states = (IncidentState.RAISED, IncidentState.ACKNOWLEDGED)
    return models.HandOver(
        t=time.time(),
        since=since,
        incidents=store.incidents(state=open_states, among=scope, sort="severity", limit=1000)[0],
        shelves=store.shelves(standing=True, among=scope),
        planned_work=store.works(standing=True, among=scope),
        comments=store.said(since, among=scope),
    )


# ----------------------------------------------------------------- operations

_operations = APIRouter(tags=["operations"])


@_operations.get("/api/v1/bad-readings", dependencies=[Depends(_known_query)])
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
        ready, reasons = False, [*reasons, *([] if any(trouble in one for one in reasons) else [trouble])]
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

_notifications = APIRouter(
    prefix="/api/v1/notifications", tags=["notifications"], dependencies=[Depends(_known_query)]
)


@_notifications.get("")
def list_targets(request: Request) -> models.Targets:
    """Targets of notifications, with their position and the problem of the last attempt."""
    notifier: Notifier | None = request.app.state.notifier
    return models.Targets(targets=[] if notifier is None else notifier.status())


@_notifications.get("/dead-letters")
def list_dead_letters(
    request: Request,
    target: Annotated[str | None, Query(pattern=_NAME, description="Restrict to this target.")] = None,
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


@_notifications.post("/dead-letters/resend", dependencies=[Depends(_json_only)])
def resend_dead_letters(request: Request, choice: models.LetterChoice) -> models.LetterCount:
    """Send dead letters again, with the same message ids; a delivered one is deleted."""
    notifier: Notifier | None = request.app.state.notifier
    if notifier is None:
        return models.LetterCount(count=0)
    count = notifier.store.resend(target=choice.target, ids=choice.ids)
    notifier.look()
    return models.LetterCount(count=count)


@_notifications.post("/dead-letters/discard", dependencies=[Depends(_json_only)])
def discard_dead_letters(request: Request, choice: models.LetterChoice) -> models.LetterCount:
    """Delete dead letters."""
    notifier: Notifier | None = request.app.state.notifier
    if notifier is None:
        return models.LetterCount(count=0)
    count = notifier.store.discard(target=choice.target, ids=choice.ids)
    notifier.look()
    return models.LetterCount(count=count)


# ------------------------------------------------------------------- sessions

_sessions = APIRouter(prefix="/api/v1", tags=["access"], dependencies=[Depends(_known_query)])


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


@_sessions.post("/session", dependencies=[Depends(_json_only)])
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


# --------------------------------------------------------------------- errors


async def _validation_handler(request: Request, error: Exception) -> Response:
    methods = _methods(request.app, request.url.path)
    if methods and request.method not in methods:
        # The path is literal and fits a parameter of another route, such as `ack` the id of an alarm.
        headers = {"Allow": ", ".join(sorted(methods))}
        return problem(request, 405, "Method Not Allowed", headers=headers)
    found = cast(RequestValidationError, error).errors()
    errors = [{"where": ".".join(str(part) for part in item["loc"]), "what": item["msg"]} for item in found]
    broken = any(item["type"] == "json_invalid" for item in found)
    detail = "; ".join(f"{item['where']}: {item['what']}" for item in errors)
    return problem(request, 400 if broken else 422, detail, errors=errors)
