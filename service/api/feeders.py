"""Routes of feeders: list, tables, latest tick, history, time series, commissioning, stream of ticks."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import StringConstraints, TypeAdapter

from gridsec.errors import FeederInvalid, Problem
from service.access.identity import OPEN
from service.api import models, overview, tables
from service.api.dependencies import (
    MAX_EVENT,
    NAME,
    NOT_MODIFIED,
    TABLES,
    Backend,
    BackendHere,
    Caller,
    FeederName,
    IfNoneMatch,
    KnownFeeder,
    Latest,
    Media,
    Permission,
    Since,
    Until,
    as_table,
    has_meter,
    json_only,
    known_query,
    operator_of,
    set_table_headers,
    stream_slot,
    unchanged,
    wakes,
)
from service.engine.commissioning import CommissioningProgress
from service.errors import FeederUnknown
from service.report.feeder_info import FeederStatus
from service.report.report import FeederReport
from service.store.series import LONGEST_S

MAX_SERIES = 12
"""Largest number of meters of one time series."""
MAX_BUCKETS = 2000
"""Largest number of buckets of one time series."""
_STATE = TypeAdapter(models.State)

router = APIRouter(prefix="/api/v1/feeders", tags=["feeders"], dependencies=[Depends(known_query)])


def _detail(backend: Backend, feeder: str) -> dict[str, Any]:
    fields = backend.feeder(feeder)
    if fields is None:
        raise FeederUnknown(feeder)
    return fields


@router.get("")
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
        str | None, Query(pattern=NAME, description="Feeder that follows the page if it is not on it.")
    ] = None,
    offset: Annotated[int, Query(ge=0, le=MAX_EVENT, description="Number of feeders before the page.")] = 0,
    limit: Annotated[int | None, Query(ge=0, le=5000, description="Without it all; 0: numbers only.")] = None,
) -> models.Feeders:
    """All feeders with the latest verdict of each, or a page of them, the worst first."""
    alarms, incidents = backend.store.alarms_by_feeder(), backend.store.incidents_by_feeder()
    found = [
        overview.standing(fields, backend.summary(name), alarms.get(name), incidents.get(name, 0))
        for fields in backend.feeders()
        if caller.sees(name := fields["name"])
    ]
    part = (offset, limit)
    return overview.page(found, order=order, text=text, status=status, include=include, part=part)


@router.get("/{feeder}", response_model=models.FeederDetail, responses=NOT_MODIFIED)
def get_feeder(
    backend: BackendHere, feeder: KnownFeeder, response: Response, if_none_match: IfNoneMatch = None
) -> Any:
    """A feeder: its tree, and the columns of its files."""
    fields = _detail(backend, feeder)
    tag = f'"{fields["revision"]}-{fields.get("max_attacked", 0)}"'
    return unchanged(response, tag, if_none_match) or fields


@router.put("/{feeder}", response_model=models.FeederDetail, dependencies=[Depends(json_only)])
async def put_feeder(backend: BackendHere, feeder: FeederName, tables: dict[str, Any]) -> Any:
    """Add a feeder or replace it, from JSON of the same columns as its files."""
    try:
        await to_thread.run_sync(lambda: json.dumps(tables, allow_nan=False))
    except ValueError as error:
        text = "the JSON contains NaN or an infinity; leave the field out instead"
        raise FeederInvalid([Problem("not-finite", text)]) from error
    await backend.put_feeder(feeder, tables)
    return _detail(backend, feeder)


@router.delete("/{feeder}", status_code=204)
async def delete_feeder(backend: BackendHere, feeder: FeederName) -> None:
    """Stop monitoring a feeder that was added over REST: its alarms are cleared, its history stays."""
    await backend.delete_feeder(feeder)


@router.get("/{feeder}/state")
def get_state(backend: BackendHere, report: Latest, response: Response) -> models.State:
    """The latest tick: verdict, and every meter with its reported and its reconstructed voltage."""
    response.headers["Cache-Control"] = "no-store"
    return _state(backend, report)


def _state(backend: Backend, report: FeederReport) -> models.State:
    owned = backend.ownership(report.feeder)
    return models.extended(
        models.State,
        report,
        age_s=backend.age(report),
        owner=None if owned is None else owned.worker,
        epoch=None if owned is None else owned.epoch,
    )


@router.get("/{feeder}/meters/{meter}")
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


@router.get("/{feeder}/history", response_model=models.History, responses=TABLES)
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
        str | None, Query(pattern=NAME, description="Include the numbers of this meter.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=5000)] = 500,
) -> Any:
    """The newest kept ticks in [since, until), oldest first."""
    rows = backend.store.history(feeder, since=since, until=until, meter=meter, limit=limit)
    if meter is not None and not any(row["meter"] for row in rows) and not has_meter(backend, feeder, meter):
        raise HTTPException(404, f"feeder {feeder!r} has no meter {meter!r}")
    more = len(rows) == limit
    set_table_headers(request, response, media, **({"until": rows[0]["t"]} if more else {}))
    if media != tables.JSON:
        return as_table(response, tables.encoded(tables.history(rows, meter), media), media)
    return {"feeder": feeder, "points": rows, "more": more}


@router.get("/{feeder}/series", response_model=models.Series, responses=TABLES)
def get_series(
    request: Request,
    response: Response,
    backend: BackendHere,
    feeder: KnownFeeder,
    media: Media,
    *,
    meter: Annotated[
        list[Annotated[str, StringConstraints(pattern=NAME)]] | None,
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
        if not has_meter(backend, feeder, one):
            raise HTTPException(404, f"feeder {feeder!r} has no meter {one!r}")
    found = tables.series(backend.store.series(feeder, wanted, since=since, until=until, buckets=buckets))
    set_table_headers(request, response, media)
    response.headers["Cache-Control"] = "no-store"
    if media != tables.JSON:
        return as_table(response, tables.encoded(tables.series_table(found), media), media)
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


@router.get("/{feeder}/commissioning")
def get_commissioning(backend: BackendHere, feeder: KnownFeeder, response: Response) -> models.Commissioning:
    """Commissioning of the meters: gathered time, learned errors, and times."""
    response.headers["Cache-Control"] = "no-store"
    return _commissioning(backend, feeder, backend.commissioning(feeder))


@router.post(
    "/{feeder}/commissioning",
    dependencies=[Depends(json_only)],
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
    who = operator_of(caller, found.who)
    progress = await backend.recommission(feeder, found.meters or (), who, found.reason)
    return await to_thread.run_sync(_commissioning, backend, feeder, progress)


@router.get("/{feeder}/commissioning/events")
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


@router.get(
    "/{feeder}/stream",
    response_class=EventSourceResponse,
    dependencies=[Depends(stream_slot)],
    tags=["streams"],
)
async def stream_states(
    request: Request, backend: BackendHere, caller: Caller, feeder: KnownFeeder
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events `state`: the latest tick and each later one; a slow client skips some."""
    yield ServerSentEvent(comment="connected", retry=2000)
    last: FeederReport | None = None
    permission = Permission(request, caller)
    async for _ in wakes(backend):
        if not backend.known(feeder) or not await permission.lasts():
            return
        report = await backend.latest(feeder)
        if report is not None and report is not last:
            last = report
            data = _STATE.dump_json(_state(backend, report)).decode()
            yield ServerSentEvent(event="state", raw_data=data)
