"""Models of requests and of responses that no other module declares.

Reports, commissioning and alarms are dataclasses of the engine, declared once: pydantic derives their JSON
and their OpenAPI description.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    StringConstraints,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from gridsec.interface import Cause, Decision
from service.access.audit import AuditEntry
from service.access.identity import Role
from service.alarms.conditions import AlarmKind, Severity
from service.alarms.incidents import Incident, IncidentEvent, PlannedWork, Shelf
from service.alarms.state_machine import Alarm
from service.engine.commissioning import CommissioningProgress, MeterCommissioning
from service.notify.delivery import TargetStatus
from service.report.feeder_info import FeederStatus
from service.report.report import FeederReport, MeterState, ModelOnly
from service.store import AlarmEvent
from service.store.incidents import Said
from service.store.schema import CommissioningEvent
from service.times import UtcTwins

RENAMED = {
    "Alarm": "AlarmModel",
    "DataErrorReport": "DataErrorModel",
    "ExplanationReport": "ExplanationModel",
    "StalledMeter": "StalledMeterModel",
}
"""Names in OpenAPI of classes with another name in the code."""
Line = Annotated[
    str,
    StringConstraints(
        strip_whitespace=True, min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$"
    ),
]
MaxAttacked = Annotated[
    int, Field(description="Number of manipulated meters that the design identifies; 0 without a design.")
]
StatedMaxAttacked = Annotated[int, Field(description="`max_attacked` of the feeder's file.")]
Id = Annotated[str, StringConstraints(pattern=r"^[0-9A-Z]{26}$")]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
Text = Annotated[
    str,
    StringConstraints(strip_whitespace=True, max_length=1000, pattern=r"^[^\x00-\x08\x0b-\x1f\x7f-\x9f]*$"),
]


class Problem(BaseModel):
    """An error as in RFC 9457 (`application/problem+json`)."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="Kind of problem; `about:blank` if the status suffices.")
    title: str
    status: int
    detail: str
    instance: str = Field(description="Path of the request.")


@dataclass(frozen=True, slots=True, kw_only=True)
class State(FeederReport):
    """A feeder at its latest tick."""

    age_s: Annotated[float, Field(description="Age of the tick at the response, by the service's clock, s.")]
    owner: Annotated[
        str | None, Field(description="Worker that monitors the feeder; null without workers.")
    ] = None
    epoch: Annotated[
        int | None, Field(description="Number of its lease; it rises with every change of the owner.")
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MeterNow(UtcTwins, MeterState):
    """One meter at the latest tick, with its feeder and the verdict."""

    feeder: str
    t: float
    verdict: Decision
    commissioning: Annotated[
        MeterCommissioning | None,
        Field(description="Commissioning of the meter; null if the estimator does not learn."),
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Commissioning(CommissioningProgress):
    """Commissioning of a feeder: learning of its meters' fixed errors."""

    kept: Annotated[float | None, Field(description="Newest tick of the stored commissioning, Unix s.")]


Shown = TypeVar("Shown", State, MeterNow, Commissioning, "ListedAlarm")


def extended(kind: type[Shown], base: Any, **more: Any) -> Shown:
    """Return a dataclass of the engine as its REST form, with the fields that are known at the response."""
    return kind(**{field.name: getattr(base, field.name) for field in fields(base)}, **more)


class CommissioningEvents(BaseModel):
    """Changes of a commissioning, oldest first."""

    events: list[CommissioningEvent]


class FeederSummary(UtcTwins, BaseModel):
    """A feeder in the list."""

    model_config = ConfigDict(extra="allow")

    name: str
    title: str = ""
    t: float | None = Field(default=None, description="Latest tick; null before the first one.")
    age_s: float | None = Field(default=None, description="Age of that tick by the service's clock, s.")
    patience_s: float | None = Field(default=None, description="Age beyond which a tick is stale, s.")
    max_attacked: MaxAttacked = 0
    max_attacked_stated: StatedMaxAttacked = 0
    ticks_skipped: int | None = Field(
        default=None, description="Number of skipped ticks since the start; null if not monitored."
    )
    verdict: Decision | None = None
    status: FeederStatus = Field(
        description="Its verdict; `no-data` without present readings, `not-monitored` after a failure."
    )
    model_only: bool | None = Field(default=None, description="As in the state; null before the first tick.")
    since: float | None = Field(default=None, description="First consecutive tick with this verdict, Unix s.")
    displayed_verdict: Decision | None = Field(
        default=None, description="Verdict after the delays of the alarms; null before the first tick."
    )
    displayed_since: float | None = Field(
        default=None, description="First tick of the time that led to it, Unix s."
    )
    cause: str | None = Field(
        default=None, description="Cause of the displayed verdict; `overload` and `no-owner`: not evaluated."
    )
    t_measured: float | None = Field(
        default=None, description="Newest tick with a trusted voltage reading, Unix s."
    )
    meters: int = Field(default=0, description="Number of meters at the latest tick.")
    suspects: int = Field(default=0, description="Meters and inverters named as manipulated at that tick.")
    silent: int = Field(default=0, description="Silent meters of customers at that tick.")
    alarms: int = Field(default=0, description="Active alarms.")
    raised: int = Field(default=0, description="Active alarms without an acknowledgement.")
    incidents: int = Field(default=0, description="Open incidents: those with an active alarm.")


class Feeders(BaseModel):
    """All feeders, or a page of them."""

    feeders: list[FeederSummary]
    total: int = Field(description="Number of feeders that fit the filters, on this page or not.")
    counts: dict[FeederStatus, int] = Field(
        description="Number of feeders by status, whatever the filters are."
    )
    causes: dict[str, int] = Field(
        default_factory=dict,
        description="Number of feeders that are not evaluated by cause; they are undecided in `counts`.",
    )


class LayoutCustomer(BaseModel):
    """Connection point of a customer."""

    customer: str
    bus: str = Field(description="Id of the bus in this layout (zero-impedance lines fuse buses).")
    meter: str | None = Field(default=None, description="Its meter; null without one.")
    phase: str | None = Field(default=None, description="Its phase: a, b or c; null on a balanced feeder.")


class Layout(BaseModel):
    """Spanning tree of the feeder, the busbar first, and the lines that close loops in it."""

    buses: list[str]
    parent: list[int | None] = Field(description="Index of the bus that feeds each one; null for the busbar.")
    ties: list[tuple[int, int]] = Field(
        default=[], description="Indices of the buses at both ends of each line that closes a loop."
    )
    xy: list[tuple[float, float] | None] | None = Field(default=None, description="Coordinates, if known.")
    v_nominal_volt: list[float] = Field(
        default=[], description="Nominal voltage of each bus, V: behind transformers not that of the busbar."
    )
    customers: list[LayoutCustomer]


class FeederDetail(BaseModel):
    """A feeder: its tree, and the columns of its files."""

    model_config = ConfigDict(extra="allow")

    name: str
    title: str = ""
    v_nominal_volt: float
    v_min_volt: float
    v_max_volt: float
    tick_s: float = 1.0
    patience_s: float | None = Field(default=None, description="Age beyond which a state is stale, s.")
    patience_shed_s: float | None = Field(
        default=None, description="Age beyond which a state with cause `overload` is stale, s."
    )
    revision: str = Field(
        description="Digest of all other fields but `max_attacked`; a state with another one does not belong "
        "to them."
    )
    max_attacked: MaxAttacked = 0
    max_attacked_stated: StatedMaxAttacked = 0
    layout: Layout
    tables: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ListedAlarm(Alarm):
    """An alarm, with its incident and what suppresses its notification."""

    incident: Annotated[
        str | None, Field(description="Id of its incident; null if it cleared before incidents existed.")
    ] = None
    shelved_until: Annotated[
        float | None, Field(description="End of its shelf; null if not shelved or cleared.")
    ] = None
    planned_work: Annotated[
        str | None, Field(description="Id of the planned work during which it was raised.")
    ] = None


class Alarms(BaseModel):
    """A page of alarms, those with the latest onset first."""

    alarms: list[ListedAlarm]
    next: str | None = Field(description="Cursor of the next page; null on the last one.")
    last_event: int = Field(
        description="Newest event number: `after` of the stream that continues from here."
    )
    raised: int = Field(
        description="Number of active alarms without an acknowledgement, of all feeders and kinds."
    )
    unstored: int = Field(
        default=0, description="Number of alarm changes that wait for the database and are not included."
    )
    problem: str | None = Field(default=None, description="Problem of the database; null without one.")


class AlarmEvents(BaseModel):
    """A page of events of an alarm, oldest first."""

    events: list[AlarmEvent]
    next: int | None = Field(description="`after` of the next page; null on the last one.")


Who = Annotated[
    Line | None,
    Field(
        default=None,
        description="The operator's name where no authentication is set up; else that of the credential.",
    ),
]


class Session(UtcTwins, BaseModel):
    """Identity of the caller."""

    name: str
    role: Role
    feeders: list[str] | None = Field(description="Accessible feeders; null for all.")
    open: bool = Field(description="No authentication is set up.")
    expires: float | None = Field(default=None, description="End of a session that was just begun, Unix s.")


class LogIn(BaseModel):
    """Exchange of an API key for a session."""

    model_config = ConfigDict(extra="forbid")

    key: Annotated[str, StringConstraints(min_length=1, max_length=4096)]


class AuditLog(BaseModel):
    """Entries of the audit log."""

    entries: list[AuditEntry]


class Targets(BaseModel):
    """Targets of notifications."""

    targets: list[TargetStatus]


class Letter(UtcTwins, BaseModel):
    """Message that was given up."""

    id: int = Field(description="Number of the dead letter.")
    target: str
    number: int = Field(description="Number of the event.")
    message_id: str = Field(description="The same at every attempt.")
    type: str
    t: float
    died: float = Field(description="Time at which it was given up.")
    attempts: int
    problem: str = Field(description="Problem of the last attempt.")
    resend: bool = Field(description="Requested to be sent again.")
    message: JsonValue = Field(description="The message.")


class Letters(BaseModel):
    """A page of dead letters, oldest first."""

    dead_letters: list[Letter]
    next: int | None = Field(description="`after` of the next page; null on the last one.")


MAX_LETTER = (1 << 53) - 1
"""Largest number of a dead letter: the largest integer that every reader of JSON represents."""


class LetterChoice(BaseModel):
    """Choice of dead letters; without a field all of them."""

    model_config = ConfigDict(extra="forbid")

    target: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,64}$")] | None = None
    ids: (
        Annotated[list[Annotated[int, Field(ge=1, le=MAX_LETTER)]], Field(min_length=1, max_length=1000)]
        | None
    ) = None


class LetterCount(BaseModel):
    """Number of chosen dead letters."""

    count: int


class Answer(BaseModel):
    """Operator and comment of an action."""

    model_config = ConfigDict(extra="forbid")

    who: Who = None
    comment: Text = ""


class Acknowledgement(Answer):
    """Acknowledgement by an operator."""

    count: int | None = Field(
        default=None,
        ge=1,
        description="The alarm's `count` that the operator refers to; 409 if it has been raised since.",
    )


class BulkAcknowledgement(Answer):
    """Acknowledgement of several alarms; those that are acknowledged already stay."""

    alarms: Annotated[list[Id], Field(min_length=1, max_length=1000)]


class IncidentAcknowledgement(Answer):
    """Acknowledgement of all active alarms of an incident."""

    count: int | None = Field(
        default=None,
        ge=1,
        description="The incident's `count` that the operator refers to; 409 if alarms were raised since.",
    )


class Withdrawal(Answer):
    """Withdrawal of an acknowledgement, or early end of a shelf or of planned work."""


class Remark(BaseModel):
    """Comment of an operator."""

    model_config = ConfigDict(extra="forbid")

    who: Who = None
    comment: Annotated[Text, StringConstraints(min_length=1)]


class Assignment(BaseModel):
    """Assignment of an incident."""

    model_config = ConfigDict(extra="forbid")

    who: Who = None
    to: Line | None = Field(description="Name of the person; null withdraws the assignment.")
    comment: Text = ""


def _only(*names: str) -> dict[str, Any]:
    """Schema of an object with these of the fields that select alarms."""
    fields = ("alarm", "incident", "feeder", *({"meter", "kind"} if "feeder" not in names else ()))
    absent = {name: {"type": "null"} for name in sorted(fields) if name not in names}
    return {"required": [*names], "properties": {name: {"type": "string"} for name in names} | absent}


class Shelving(BaseModel):
    """Request of a shelf: of an `alarm`, an `incident`, or a `feeder` with a `meter`, a `kind`, or both."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "anyOf": [_only("alarm"), _only("incident"), _only("feeder", "meter"), _only("feeder", "kind")]
        },
    )

    who: Who = None
    alarm: Id | None = None
    incident: Id | None = None
    feeder: Name | None = None
    meter: Name | None = None
    kind: AlarmKind | None = None
    severity: Severity | None = Field(
        default=None, description="An alarm of a higher one ends the shelf; by default that of the alarms."
    )
    duration_s: float = Field(gt=0.0, allow_inf_nan=False, description="Time until its end, s.")
    reason: Annotated[Text, StringConstraints(min_length=1)]

    @model_validator(mode="after")
    def _one_target(self) -> Shelving:
        part = self.feeder is not None and (self.meter is not None or self.kind is not None)
        stray = self.feeder is None and (self.meter is not None or self.kind is not None)
        targets = (self.alarm is not None) + (self.incident is not None) + (self.feeder is not None)
        if targets != 1 or stray or (self.feeder is not None and not part):
            text = "expected `alarm`, or `incident`, or `feeder` with `meter` or `kind`"
            raise PydanticCustomError("target", text)
        return self


class Shelves(BaseModel):
    """Shelves, newest first."""

    shelves: list[Shelf]
    max_duration_s: float = Field(description="Longest time of a shelf, s.")


class WorkRequest(BaseModel):
    """Planned work on a feeder."""

    model_config = ConfigDict(extra="forbid")

    who: Who = None
    feeder: Name
    t_from: float | None = Field(
        default=None, allow_inf_nan=False, description="Begin, Unix s; without it now."
    )
    t_until: float = Field(allow_inf_nan=False, description="End, Unix s; at most 31 days later.")
    reason: Annotated[Text, StringConstraints(min_length=1)]


class PlannedWorks(BaseModel):
    """Planned works, newest first."""

    planned_work: list[PlannedWork]


class Incidents(BaseModel):
    """A page of incidents."""

    incidents: list[Incident]
    next: str | None = Field(description="Cursor of the next page; null on the last one.")
    last_event: int = Field(
        description="Newest event number: `after` of the stream that continues from here."
    )
    raised: int = Field(
        description="Number of incidents to act on, of all feeders: not acknowledged, not shelved, not under "
        "planned work."
    )
    unstored: int = Field(
        default=0, description="Number of alarm changes that wait for the database and are not included."
    )
    problem: str | None = Field(default=None, description="Problem of the database; null without one.")


class IncidentEvents(BaseModel):
    """A page of events of incidents, oldest first."""

    events: list[IncidentEvent]
    next: int | None = Field(description="`after` of the next page; null on the last one.")


class HandOver(UtcTwins, BaseModel):
    """State of the shift: open incidents, shelves, planned work, and comments since a time."""

    t: float = Field(description="Time of the response, Unix s.")
    since: float
    incidents: list[Incident] = Field(description="Open incidents, the most severe first.")
    shelves: list[Shelf] = Field(description="Shelves that apply.")
    planned_work: list[PlannedWork] = Field(description="Present and future planned work.")
    comments: list[Said] = Field(description="Comments since then, oldest first.")


class Recommissioning(BaseModel):
    """Request of an operator to restart the learning of meters."""

    model_config = ConfigDict(extra="forbid")

    who: Who = None
    reason: Annotated[Text, StringConstraints(min_length=1)]
    meters: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None, description="Replaced meters; without this field the learning of all restarts."
    )

    @classmethod
    def of(cls, body: bytes, known: Sequence[str], *, named: bool) -> Recommissioning | list[Any]:
        """Return the request in a body, or all its problems; `named`: the credential gives the name."""
        try:
            given = json.loads(body)
        except (ValueError, RecursionError) as error:
            return [{"loc": ("body",), "msg": f"not JSON: {error}", "type": "json_invalid"}]
        found, problems = None, list[Any]()
        try:
            found = cls.model_validate(given)
        except ValidationError as error:
            problems = [{**one, "loc": ("body", *one["loc"])} for one in error.errors(include_url=False)]
        if isinstance(given, dict) and given.get("who") is None and not named:
            problems.append({"loc": ("body", "who"), "msg": "Field required", "type": "missing"})
        meters = given.get("meters") if isinstance(given, dict) else None
        seen: set[str] = set()
        for k, meter in enumerate(meters if isinstance(meters, list) else ()):
            if not isinstance(meter, str):
                continue
            what = f"there is no meter {meter!r}" if meter not in known else f"meter {meter!r} occurs twice"
            if meter not in known or meter in seen:
                problems.append({"loc": ("body", "meters", k), "msg": what, "type": "meter"})
            seen.add(meter)
        return problems or found or []

    @classmethod
    def in_openapi(cls) -> dict[str, Any]:
        """Return the OpenAPI description of the request."""
        schema = cls.model_json_schema()
        return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


class HistoryPoint(UtcTwins, BaseModel):
    """A kept tick of a feeder."""

    t: float
    verdict: Decision
    cause: Cause
    seen: int = Field(description="Number of meters with a usable reading.")
    suspects: list[str]
    v_volt_lowest: float | None = Field(
        description="Lowest reconstructed voltage at a meter that is not model only, V."
    )
    v_volt_highest: float | None = Field(description="Highest such voltage, V.")
    model_only: bool = Field(default=False, description="As in the state.")
    meter: HistoryMeter | None = Field(default=None, description="The requested meter; null without one.")


class HistoryMeter(BaseModel):
    """One meter at a kept tick."""

    meter: str
    seen: bool
    suspect: bool
    v_volt_reported: float | None
    v_volt_estimated: float | None
    v_volt_std: float | None = Field(
        default=None, description="Standard deviation of the estimate, V; null in rows of earlier versions."
    )
    score: float | None
    threshold: float | None
    model_only: ModelOnly = False


class History(BaseModel):
    """The newest kept ticks of the requested time, oldest first."""

    feeder: str
    points: list[HistoryPoint]
    more: bool = Field(description="There may be older ones: repeat with `until` = `t` of the first.")


Volts = list[float | None]


class MeterSeries(BaseModel):
    """One meter in every bucket of a series; null where the bucket has no such value. Voltages in V."""

    meter: str
    v_volt_reported_min: Volts
    v_volt_reported_max: Volts
    v_volt_estimated_min: Volts = Field(description="Lowest estimate that is not model only.")
    v_volt_estimated_max: Volts
    v_volt_band_min: Volts = Field(
        description="Lowest end of the uncertainty band: estimate minus three standard deviations."
    )
    v_volt_band_max: Volts = Field(description="Highest end: estimate plus three standard deviations.")
    seen: list[bool] = Field(description="A usable reading belongs to a stored tick of the bucket.")
    suspect: list[bool] = Field(description="The verdict of a stored tick names the meter.")


class AlarmOccurrence(UtcTwins, BaseModel):
    """One occurrence of an alarm."""

    id: str
    kind: AlarmKind
    meter: str | None
    customer: str | None
    severity: Severity
    t_raised: float
    t_cleared: float | None = Field(description="Null while it is active.")


class Series(BaseModel):
    """Time series of meters: minimum and maximum of the stored ticks of each bucket."""

    feeder: str
    since: float = Field(description="Beginning of the first bucket, Unix s.")
    until: float = Field(description="End of the last bucket, Unix s.")
    bucket_s: float = Field(description="Duration of a bucket, s.")
    step_s: float = Field(description="Grid of the stored ticks, s; changes of the verdict come in between.")
    complete: bool = Field(description="False if older stored ticks are left out to bound the cost.")
    t: list[float] = Field(description="Beginning of each bucket with a stored tick, Unix s.")
    ticks: list[int] = Field(description="Number of stored ticks in each bucket.")
    clean_s: list[float] = Field(
        description="Time with the verdict clean in each bucket, s: from a stored tick to the next one, at "
        "most to the end of its bucket and of its two minutes."
    )
    attacked_s: list[float] = Field(description="The same for the verdict attacked, s.")
    undecided_s: list[float] = Field(description="The same for the verdict undecided, s.")
    meters: list[MeterSeries]
    alarms: list[AlarmOccurrence] = Field(
        description="Alarms of the feeder in this time, oldest first, each occurrence by itself."
    )
    more_alarms: bool = Field(description="There are more; `alarms` are the newest ones.")


class RejectedReading(UtcTwins, BaseModel):
    """A rejected reading."""

    t: float
    key: str
    reason: str
    payload: str = Field(description="The beginning of its bytes, as text.")


class RejectedReadings(BaseModel):
    """The newest rejected readings, newest first."""

    readings: list[RejectedReading]


class Health(BaseModel):
    """Response to a probe."""

    ok: Literal[True]
    reasons: list[str]


HistoryPoint.model_rebuild()
