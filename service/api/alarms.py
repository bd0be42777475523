"""Routes of alarms, incidents, shelves, planned work and the hand-over of the shift."""

from __future__ import annotations

import hashlib
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable
from contextlib import aclosing
from functools import partial
from operator import attrgetter
from typing import Annotated, Any, Literal, TypeVar

from anyio import to_thread
from fastapi import APIRouter, Depends, Header, HTTPException, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import TypeAdapter

from service.access.identity import Identity, NotPermitted
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
from service.api import models, tables
from service.api.dependencies import (
    MAX_EVENT,
    NAME,
    NOT_MODIFIED,
    TABLES,
    Backend,
    BackendHere,
    Caller,
    IfNoneMatch,
    Media,
    Permission,
    Since,
    Until,
    as_table,
    has_meter,
    json_only,
    known_feeder,
    known_query,
    operator_of,
    set_table_headers,
    stream_slot,
    unchanged,
    wakes,
)
from service.engine.operators import ShelfRequest
from service.errors import FeederUnknown, IdUnknown
from service.store import AlarmEvent, StoreUnavailable

SHIFT_S = 8 * 3600.0
"""Length of a shift, s: time of the comments of a hand-over."""
_STREAMS: dict[str, tuple[str, str, TypeAdapter[Any]]] = {
    "alarm": ("last_event", "events_after", TypeAdapter(AlarmEvent)),
    "incident": ("last_incident_event", "incident_events_after", TypeAdapter(IncidentEvent)),
}
"""Number of the newest event and read access of the store, and form of the events, by name of the stream."""

_alarms = APIRouter(prefix="/api/v1/alarms", tags=["alarms"], dependencies=[Depends(known_query)])
_incidents = APIRouter(prefix="/api/v1/incidents", tags=["incidents"], dependencies=[Depends(known_query)])
_shelves = APIRouter(prefix="/api/v1/shelves", tags=["incidents"], dependencies=[Depends(known_query)])
_works = APIRouter(prefix="/api/v1/planned-work", tags=["incidents"], dependencies=[Depends(known_query)])
_shift = APIRouter(prefix="/api/v1", tags=["incidents"], dependencies=[Depends(known_query)])
routers = (_alarms, _incidents, _shelves, _works, _shift)

AlarmId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the alarm.")]
IncidentId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the incident.")]
ShelfId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the shelf.")]
WorkId = Annotated[str, Path(pattern=r"^[0-9A-Z]{26}$", description="Id of the planned work.")]
Words = Annotated[
    str | None, Query(max_length=200, description="Only with each of these words, in any case.")
]
Cursor = Annotated[str | None, Query(pattern=r"^([0-9.e+-]{1,32}~)?[0-9A-Z]{26}$")]
Standing = Annotated[bool, Query(description="Leave out those that have ended.")]
After = Annotated[int, Query(ge=0, le=MAX_EVENT, description="Only events with a higher number.")]
Limit = Annotated[int, Query(ge=1, le=1000)]
StreamFeeder = Annotated[str | None, Query(pattern=NAME, description="Restrict to this feeder.")]
StreamAfter = Annotated[int | None, Query(ge=0, description="Begin after this event number.")]
LastEvent = Annotated[int | None, Header(ge=0, description="Takes precedence over `after`.")]
T = TypeVar("T", Alarm, Incident, Shelf, PlannedWork)
E = TypeVar("E", AlarmEvent, IncidentEvent)


def _within(caller: Identity, feeder: str | None) -> None:
    """Refuse a feeder outside of the caller's scope."""
    if feeder is not None and not caller.sees(feeder):
        raise NotPermitted(f"{caller.name} has no access to feeder {feeder!r}")


def _scope(caller: Identity) -> list[str] | None:
    return None if caller.feeders is None else sorted(caller.feeders)


def _found(caller: Identity, read: Callable[[str], T | None], error: type[IdUnknown], number: str) -> T:
    """Object with an id, within the caller's scope."""
    found = read(number)
    if found is None or not caller.sees(found.feeder):
        raise error(number)
    return found


def _alarm(backend: Backend, caller: Identity, number: str) -> Alarm:
    return _found(caller, backend.store.alarm, AlarmUnknown, number)


def _incident(backend: Backend, caller: Identity, number: str) -> Incident:
    return _found(caller, backend.store.incident, IncidentUnknown, number)


def _events(read: Callable[..., list[E]], after: int, limit: int) -> tuple[list[E], int | None]:
    """A page of events after a number, and the number of its last one if more follow."""
    found = read(after, limit=limit + 1)
    page = found[:limit]
    return page, page[-1].seq if len(found) > limit else None


async def _stream(
    permission: Permission, backend: Backend, name: str, feeder: str | None, start: int | None
) -> AsyncGenerator[ServerSentEvent]:
    """Server-sent events `alarm` or `incident` after a number; None: from the next event on."""
    caller, store = permission.caller, backend.store
    _within(caller, feeder)
    counter, reader, form = _STREAMS[name]
    newest, read = attrgetter(counter), getattr(store, reader)
    # A number beyond the newest belongs to another database: start now, otherwise no event would ever come.
    seen = newest(store) if start is None else min(start, newest(store))
    yield ServerSentEvent(comment="connected", id=str(seen), retry=2000)
    async for _ in wakes(backend):
        if not await permission.lasts():
            return
        while seen < (last := newest(store)):
            try:
                events = await to_thread.run_sync(partial(read, seen, feeder=feeder))
            except StoreUnavailable:
                return  # The client reconnects with the number of its last event.
            for event in events:
                seen = event.seq
                if caller.sees(getattr(event, name).feeder):
                    data = form.dump_json(event).decode()
                    yield ServerSentEvent(event=name, id=str(event.seq), raw_data=data)
            if not events:
                seen = last


def _check_filters(backend: Backend, caller: Identity, feeder: str | None, meter: str | None) -> None:
    """Refuse a feeder and a meter that, in the caller's scope, neither exist nor have any alarm."""
    seen = caller.seen(fields["name"] for fields in backend.feeders())
    names = seen if feeder is None else (feeder,)
    if backend.store.alarms(feeder=feeder, among=caller.feeders, meter=meter, limit=1)[0]:
        return
    if feeder is not None and not (backend.known(feeder) or backend.unloaded(feeder)):
        raise FeederUnknown(feeder)
    if meter is not None and not any(has_meter(backend, name, meter) for name in names):
        raise HTTPException(404, f"there is no meter {meter!r}")


# --------------------------------------------------------------------- alarms


@_alarms.get("", response_model=models.Alarms, responses=NOT_MODIFIED | TABLES)
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
    feeder: Annotated[str | None, Query(pattern=NAME)] = None,
    meter: Annotated[str | None, Query(pattern=NAME)] = None,
    since: Since = None,
    until: Until = None,
    text: Words = None,
    incident: Annotated[str | None, Query(pattern=r"^[0-9A-Z]{26}$", description="Of this incident.")] = None,
    shelved: Annotated[bool | None, Query(description="Only shelved ones, or only others.")] = None,
    sort: Annotated[
        Literal["onset", "severity", "raised"], Query(description="Latest, or most severe, first.")
    ] = "onset",
    cursor: Cursor = None,
    limit: Limit = 100,
    if_none_match: IfNoneMatch = None,
) -> Any:
    """A page of alarms; `since` and `until` refer to `t_raised`."""
    _within(caller, feeder)
    store = backend.store
    # Before the page is read: changes stored in between are in the page. By the database: another request may
    # have shown a change of which this process does not know yet.
    last_event, last_incident_event = store.newest()
    changes = f"{last_incident_event}-{store.suppression_changes}"
    unstored, trouble = backend.unstored()
    # Event numbers identify changes within one database, and a run has only one.
    scope = _scope(caller)
    waits = hashlib.sha256(f"{unstored} {trouble} {scope}".encode()).hexdigest()[:16]
    form = "" if media == tables.JSON else f"-{tables.MEDIA.index(media)}"
    tag = f'W/"{request.app.state.run}-{last_event}-{changes}-{waits}{form}"'
    if known := unchanged(response, tag, if_none_match):
        return known
    page, following = store.alarms(
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
    set_table_headers(request, response, media, **({} if following is None else {"cursor": following}))
    if media != tables.JSON:
        return as_table(response, tables.encoded(tables.alarms(listed), media), media)
    return models.Alarms(
        alarms=listed,
        next=following,
        last_event=last_event,
        raised=store.raised(among=scope),
        unstored=unstored,
        problem=trouble,
    )


@_alarms.get(
    "/stream", response_class=EventSourceResponse, dependencies=[Depends(stream_slot)], tags=["streams"]
)
async def stream_alarms(  # noqa: PLR0917  # one argument per query parameter
    request: Request,
    backend: BackendHere,
    caller: Caller,
    feeder: StreamFeeder = None,
    after: StreamAfter = None,
    last_event_id: LastEvent = None,
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events `alarm`, with event numbers as ids: with `Last-Event-ID` none is missed.

    Without it and without `after`, the stream starts with the next event.
    """
    start = after if last_event_id is None else last_event_id
    async with aclosing(_stream(Permission(request, caller), backend, "alarm", feeder, start)) as stream:
        async for event in stream:
            yield event


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


@_alarms.get("/{alarm_id}/events")
def get_events(
    backend: BackendHere,
    caller: Caller,
    alarm_id: AlarmId,
    after: After = 0,
    limit: Limit = 100,
) -> models.AlarmEvents:
    """A page of events of an alarm, oldest first."""
    _alarm(backend, caller, alarm_id)
    page, following = _events(partial(backend.store.events, alarm_id), after, limit)
    return models.AlarmEvents(events=page, next=following)


@_alarms.post("/ack", dependencies=[Depends(json_only)])
async def acknowledge_alarms(
    backend: BackendHere, caller: Caller, answer: models.BulkAcknowledgement
) -> list[Alarm]:
    """Acknowledge several alarms, all or none; those that are acknowledged already stay."""
    who = operator_of(caller, answer.who)
    if caller.feeders is not None:
        await to_thread.run_sync(lambda: [_alarm(backend, caller, each) for each in answer.alarms])
    names = list(dict.fromkeys(answer.alarms))
    return await backend.operate(lambda act: act.acknowledge(names, who, answer.comment))


@_alarms.post("/{alarm_id}/unack", dependencies=[Depends(json_only)])
async def withdraw_acknowledgement(
    backend: BackendHere, caller: Caller, alarm_id: AlarmId, answer: models.Withdrawal
) -> Alarm:
    """Withdraw the acknowledgement of an alarm."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_alarm, backend, caller, alarm_id)
    (alarm,) = await backend.operate(lambda act: act.unacknowledge(alarm_id, who, answer.comment))
    return alarm


@_alarms.post("/{alarm_id}/comment", dependencies=[Depends(json_only)])
async def comment_alarm(
    backend: BackendHere, caller: Caller, alarm_id: AlarmId, answer: models.Remark
) -> Alarm:
    """Add a comment to an alarm; it is an event of the alarm."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_alarm, backend, caller, alarm_id)
    (alarm,) = await backend.operate(lambda act: act.comment(alarm_id, who, answer.comment))
    return alarm


@_alarms.post("/{alarm_id}/ack", dependencies=[Depends(json_only)])
async def acknowledge(
    backend: BackendHere, caller: Caller, alarm_id: AlarmId, answer: models.Acknowledgement
) -> Alarm:
    """Acknowledge an alarm, with the operator's name."""
    who = operator_of(caller, answer.who)
    if caller.feeders is not None:
        await to_thread.run_sync(_alarm, backend, caller, alarm_id)
    return await backend.acknowledge(alarm_id, who, answer.comment, count=answer.count)


# ------------------------------------------------------------------ incidents


@_incidents.get("", response_model=models.Incidents, responses=TABLES)
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
    feeder: Annotated[str | None, Query(pattern=NAME)] = None,
    meter: Annotated[str | None, Query(pattern=NAME)] = None,
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
    limit: Limit = 100,
) -> Any:
    """A page of incidents; `since` and `until` refer to `t_first` and `t_last`."""
    _within(caller, feeder)
    response.headers["Cache-Control"] = "no-store"
    last_event = backend.store.last_incident_event
    unstored, trouble = backend.unstored()
    scope = _scope(caller)
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
    set_table_headers(request, response, media, **({} if following is None else {"cursor": following}))
    if media != tables.JSON:
        return as_table(response, tables.encoded(tables.incidents(page), media), media)
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
    after: After = 0,
    limit: Limit = 100,
) -> models.IncidentEvents:
    """A page of the events of all incidents, oldest first."""
    page, following = _events(backend.store.incident_events_after, after, limit)
    seen = [event for event in page if caller.sees(event.incident.feeder)]
    return models.IncidentEvents(events=seen, next=following)


@_incidents.get(
    "/stream", response_class=EventSourceResponse, dependencies=[Depends(stream_slot)], tags=["streams"]
)
async def stream_incidents(  # noqa: PLR0917  # one argument per query parameter
    request: Request,
    backend: BackendHere,
    caller: Caller,
    feeder: StreamFeeder = None,
    after: StreamAfter = None,
    last_event_id: LastEvent = None,
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events `incident`, with event numbers as ids: with `Last-Event-ID` none is missed.

    Without it and without `after`, the stream starts with the next event.
    """
    start = after if last_event_id is None else last_event_id
    async with aclosing(_stream(Permission(request, caller), backend, "incident", feeder, start)) as stream:
        async for event in stream:
            yield event


@_incidents.get("/{incident_id}")
def get_incident(backend: BackendHere, caller: Caller, incident_id: IncidentId) -> Incident:
    """One incident."""
    return _incident(backend, caller, incident_id)


@_incidents.get("/{incident_id}/events")
def get_incident_events(
    backend: BackendHere,
    caller: Caller,
    incident_id: IncidentId,
    after: After = 0,
    limit: Limit = 100,
) -> models.IncidentEvents:
    """A page of events of an incident, oldest first."""
    _incident(backend, caller, incident_id)
    page, following = _events(partial(backend.store.incident_events, incident_id), after, limit)
    return models.IncidentEvents(events=page, next=following)


@_incidents.post("/{incident_id}/ack", dependencies=[Depends(json_only)])
async def acknowledge_incident(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.IncidentAcknowledgement
) -> Incident:
    """Acknowledge all active alarms of an incident."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(
        lambda act: act.acknowledge_incident(incident_id, who, answer.comment, count=answer.count)
    )


@_incidents.post("/{incident_id}/unack", dependencies=[Depends(json_only)])
async def withdraw_acknowledgements(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.Withdrawal
) -> Incident:
    """Withdraw the acknowledgements of all active alarms of an incident."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(lambda act: act.unacknowledge_incident(incident_id, who, answer.comment))


@_incidents.post("/{incident_id}/comment", dependencies=[Depends(json_only)])
async def comment_incident(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.Remark
) -> Incident:
    """Add a comment to an incident; it is an event of the incident."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(lambda act: act.comment_incident(incident_id, who, answer.comment))


@_incidents.post("/{incident_id}/assign", dependencies=[Depends(json_only)])
async def assign_incident(
    backend: BackendHere, caller: Caller, incident_id: IncidentId, answer: models.Assignment
) -> Incident:
    """Assign an incident to a person, or with `to` null to none."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_incident, backend, caller, incident_id)
    return await backend.operate(lambda act: act.assign(incident_id, answer.to, who, answer.comment))


# ------------------------------------------------- shelves, planned work, shift


@_shelves.get("")
def list_shelves(
    backend: BackendHere,
    caller: Caller,
    *,
    feeder: Annotated[str | None, Query(pattern=NAME)] = None,
    standing: Standing = True,
) -> models.Shelves:
    """Shelves, newest first."""
    _within(caller, feeder)
    found = backend.store.shelves(standing=standing, feeder=feeder, among=_scope(caller))
    return models.Shelves(shelves=found, max_duration_s=backend.shelve_most_s)


@_shelves.post("", status_code=201, dependencies=[Depends(json_only)])
async def shelve(backend: BackendHere, caller: Caller, wanted: models.Shelving) -> Shelf:
    """Shelve an alarm, an incident, or alarms of a feeder: they do not notify until the end of the shelf."""
    who = operator_of(caller, wanted.who)
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
        known_feeder(backend, wanted.feeder)
        if wanted.meter is not None and not has_meter(backend, wanted.feeder, wanted.meter):
            raise HTTPException(404, f"feeder {wanted.feeder!r} has no meter {wanted.meter!r}")


@_shelves.post("/{shelf_id}/end", dependencies=[Depends(json_only)])
async def end_shelf(
    backend: BackendHere, caller: Caller, shelf_id: ShelfId, answer: models.Withdrawal
) -> Shelf:
    """End a shelf before its time."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_found, caller, backend.store.shelf, ShelfUnknown, shelf_id)
    return await backend.operate(lambda act: act.unshelve(shelf_id, who, answer.comment))


@_works.get("")
def list_planned_work(
    backend: BackendHere,
    caller: Caller,
    *,
    feeder: Annotated[str | None, Query(pattern=NAME)] = None,
    standing: Standing = True,
) -> models.PlannedWorks:
    """Planned works, newest first; `standing` includes future ones."""
    _within(caller, feeder)
    found = backend.store.works(standing=standing, feeder=feeder, among=_scope(caller))
    return models.PlannedWorks(planned_work=found)


@_works.post("", status_code=201, dependencies=[Depends(json_only)])
async def plan_work(backend: BackendHere, caller: Caller, wanted: models.WorkRequest) -> PlannedWork:
    """Enter planned work on a feeder: its alarms are marked and do not notify."""
    who = operator_of(caller, wanted.who)
    _within(caller, wanted.feeder)
    known_feeder(backend, wanted.feeder)
    return await backend.operate(
        lambda act: act.plan_work(wanted.feeder, wanted.t_from, wanted.t_until, who, wanted.reason)
    )


@_works.post("/{work_id}/end", dependencies=[Depends(json_only)])
async def end_work(
    backend: BackendHere, caller: Caller, work_id: WorkId, answer: models.Withdrawal
) -> PlannedWork:
    """End planned work before its time, or cancel it."""
    who = operator_of(caller, answer.who)
    await to_thread.run_sync(_found, caller, backend.store.work, WorkUnknown, work_id)
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
