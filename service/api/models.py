"""Pydantic models of REST: source of the OpenAPI description; NaN becomes null."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, ValidationError

from gridsec.estimators.data_errors import DataErrorKind
from gridsec.estimators.sequential import LearningReason, LearningState
from gridsec.interface import Cause, Decision
from service.alarms.state_machine import AlarmKind, AlarmState, Change, Severity
from service.engine.commissioning import Stage
from service.report.voltages import BUSBAR
from service.store.schema import CommissioningChange


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


Number = Annotated[float | None, BeforeValidator(_finite)]
Line = Annotated[
    str,
    StringConstraints(
        strip_whitespace=True, min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$"
    ),
]
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


ModelOnly = Annotated[
    bool,
    Field(
        description="The estimates use no voltage reading of this tick, only powers, the model and the state "
        "of the estimator."
    ),
]


class MeterState(BaseModel):
    """One meter at the latest tick."""

    meter: str
    bus: str
    seen: bool = Field(description="A usable reading belongs to this tick.")
    suspect: bool = Field(description="The verdict names this meter as manipulated.")
    score: Number = Field(description="Absolute residual of the squared voltage, squared pu.")
    threshold: Number = Field(description="Largest score of an honest meter, squared pu.")
    v_volt_reported: Number = Field(description="Reported voltage, phase to neutral, V.")
    v_volt_estimated: Number = Field(description="Reconstructed voltage, V.")
    v_volt_std: Number = Field(description="Its standard deviation, or a third of its hard bound, V.")
    v2_pu_estimated: Number = Field(description="Reconstructed squared voltage, pu.")
    attack_volt_estimated: Number = Field(description="Reported minus reconstructed, V; 0 if not suspect.")
    kind: str | None = Field(default=None, description="Attack kind, if known.")
    phase: str | None = Field(default=None, description="Measured phase; null if balanced.")
    v_min_volt: Number = Field(default=None, description="Lowest permitted voltage at the meter, V.")
    v_max_volt: Number = Field(default=None, description="Highest permitted voltage at the meter, V.")
    learning_state: LearningState | None = Field(
        default=None, description="Learning of its fixed error; null if the estimator does not learn."
    )
    learning_reason: LearningReason | None = Field(
        default=None, description="Reason that took most of the time that did not count; null on schedule."
    )
    model_only: ModelOnly = False
    clock_offset_s: Number = Field(
        default=None,
        description="Lead of its clock relative to the other meters, s; null if not measurable.",
    )


class BusbarMeterState(BaseModel):
    """The busbar meter at the latest tick; in three phases the numbers belong to one phase."""

    meter: str = Field(default=BUSBAR, description="Its name in alarms and explanations.")
    judged: bool = Field(
        default=False,
        description="The estimator tests this meter, and this tick has the readings for the test: of this "
        "meter and of a trusted meter in the same phase.",
    )
    seen: bool = Field(default=False, description="A usable reading belongs to this tick.")
    suspect: bool = Field(default=False, description="The verdict names it as manipulated.")
    phases: list[str] = Field(
        default=[], description="Manipulated phases, a, b or c; empty on a balanced feeder."
    )
    phase: str | None = Field(
        default=None,
        description="Phase of the numbers, the one with the largest deviation; null if balanced.",
    )
    v_volt_reported: Number = Field(default=None, description="Reported voltage, phase to neutral, V.")
    v_volt_estimated: Number = Field(default=None, description="Reconstructed voltage of the busbar, V.")
    attack_volt_estimated: Number = Field(
        default=None, description="Mean excess of its reading, V; 0 if not suspect."
    )
    model_only: ModelOnly = False
    clock_offset_s: Number = Field(
        default=None,
        description="Lead of its clock relative to the other meters, s; null if not measurable.",
    )


class CustomerState(BaseModel):
    """One customer at the latest tick, metered or not."""

    customer: str
    v_volt_estimated: Number = Field(description="Reconstructed voltage, V.")
    v_volt_std: Number = Field(description="Its standard deviation, or a third of its hard bound, V.")
    model_only: ModelOnly = False


class InverterState(BaseModel):
    """One droop inverter at the latest tick."""

    customer: str
    bus: str
    meter: str | None = Field(description="The customer's meter, if there is one.")
    judged: bool = Field(description="The inverter is monitored at this tick.")
    suspect: bool = Field(description="The verdict names this inverter as manipulated.")
    q_kvar_estimated: Number = Field(description="Injected reactive power, kvar.")
    attack_kvar_estimated: Number = Field(description="Injection beyond its droop curve, kvar.")
    model_only: ModelOnly = False


class ExplanationModel(BaseModel):
    """One of several explanations of the readings with similar probability."""

    meters: list[str] = Field(description="Accused meters; `substation` is the busbar meter.")
    inverters: list[str] = Field(description="Accused inverters, by customer.")
    powers: list[str] = Field(default=[], description="False reported powers, by customer; accuses no meter.")
    probability: float = Field(description="Share among the given explanations.")


class DataErrorModel(BaseModel):
    """An error of the feeder's files that explains accused meters as well as a manipulation does."""

    kind: DataErrorKind
    meters: list[str] = Field(description="The accused meters that the error explains.")
    customers: list[str] = Field(description="The one customer, or the two that are exchanged.")
    proposed: list[str] = Field(description="Bus and phase of each customer that agree with the readings.")
    study: str = Field(description="Command that checks the error on a recording.")
    text: str = Field(description="One sentence for the operator.")


class BusState(BaseModel):
    """One bus at the latest tick."""

    bus: str
    v_volt: Number = Field(
        description="Reconstructed voltage to neutral, V; in three phases the one furthest from nominal."
    )
    v_phases: list[Number] | None = Field(
        default=None, description="Reconstructed voltage of each phase, V; null on a balanced feeder."
    )
    model_only: ModelOnly = False


class Silence(BaseModel):
    """A meter without usable readings for longer than `silence_s` of the feeder."""

    meter: str
    seconds: Number


class State(BaseModel):
    """A feeder at its latest tick."""

    feeder: str
    revision: str = Field(default="", description="Revision of the feeder that the state belongs to.")
    t: float = Field(description="Unix time of the tick, s.")
    age_s: float = Field(description="Age of the tick at the response, by the service's clock, s.")
    verdict: Decision
    reason: str
    cause: Cause
    max_attacked: int
    skipped: int = Field(default=0, description="Number of skipped ticks directly before this one.")
    model_only: bool = Field(
        default=False, description="No value of the feeder uses a voltage reading of this tick."
    )
    model_only_phases: list[str] = Field(
        default=[], description="Phases without such a reading, of a, b and c; empty on a balanced feeder."
    )
    t_measured: Number = Field(
        default=None,
        description="Newest tick with a reading that a value uses, Unix s; null: none since the start.",
    )
    meters: list[MeterState]
    buses: list[BusState]
    silent: list[Silence]
    v_min_volt: Number
    v_max_volt: Number
    busbar: BusbarMeterState = Field(default=BusbarMeterState(), description="The busbar meter.")
    customers: list[CustomerState] = []
    inverters: list[InverterState] = []
    explanations: list[ExplanationModel] = []
    data_error: DataErrorModel | None = Field(
        default=None, description="Error of the feeder's files that explains the accused meters as well."
    )


class MeterCommissioning(BaseModel):
    """Commissioning of one meter: its fixed error."""

    meter: str
    state: Stage
    since: Number = Field(description="Start of the learning, Unix s; null for a learned meter.")
    learned_at: Number = Field(description="Time at which it was learned, Unix s; null before.")
    gathered_s: Number = Field(description="Time with usable readings of a trusted meter since the start, s.")
    expected: Number = Field(description="Expected end of the learning if every tick counts, Unix s.")
    error_volt: Number = Field(description="Fixed error at nominal voltage, V; 0 before it is learned.")
    error_volt_std: Number = Field(description="Standard deviation of the error, ageing included, V.")
    allowed_volt: Number = Field(description="Largest deviation of an honest meter from its error, V.")
    learning_state: LearningState = Field(
        description="`waiting`: no tick counted yet. `learning`. `stalled`: not learned after twice "
        "`expected_s`. `learned`."
    )
    learning_reason: LearningReason | None = Field(
        description="Reason that took most of the time that did not count; null on schedule."
    )
    watched_s: Number = Field(description="Time of all ticks since the start, s; null for a learned meter.")
    lost_s: dict[LearningReason, float] = Field(description="Time that did not count, s, by reason.")


class MeterNow(MeterState):
    """One meter at the latest tick, with its feeder and the verdict."""

    feeder: str
    t: float
    verdict: Decision
    commissioning: MeterCommissioning | None = Field(
        default=None, description="Commissioning of the meter; null if the estimator does not learn."
    )


class Commissioning(BaseModel):
    """Commissioning of a feeder: learning of its meters' fixed errors."""

    feeder: str
    estimator: str
    state: Stage = Field(
        description="`off`: this monitor does not learn. `waiting`: no monitor or no tick yet. `learning`: "
        "at least one meter is being learned. `learned`: all are."
    )
    t: Number = Field(description="Tick of the data, Unix s.")
    tick_s: float = Field(description="Interval of the monitor's steps, s.")
    needed_s: float = Field(description="`commission_s`: required time with usable readings, s.")
    gathered_s: Number = Field(
        description="Least time with usable readings of the meters that are being learned, s."
    )
    since: Number = Field(description="Earliest start of the learning, Unix s.")
    expected: Number = Field(description="Expected end of the learning, Unix s; null if `held`.")
    learned_at: Number = Field(description="Time of the latest learned meter, Unix s.")
    held: bool = Field(description="Enough time has passed, but a suspect prevents learning.")
    restored: bool = Field(description="The commissioning continues from stored state.")
    note: str = Field(description="Reason why stored state is not used; empty otherwise.")
    expected_s: Number = Field(description="Time of learning if every tick counts, s.")
    stalled: int = Field(description="Meters that are not learned after twice that time.")
    kept: Number = Field(description="Newest tick of the stored commissioning, Unix s.")
    meters: list[MeterCommissioning]


class CommissioningEvent(BaseModel):
    """One change of a commissioning."""

    t: float
    change: CommissioningChange
    meters: list[str]
    who: str | None
    reason: str


class CommissioningEvents(BaseModel):
    """Changes of a commissioning, oldest first."""

    events: list[CommissioningEvent]


class FeederSummary(BaseModel):
    """A feeder in the list."""

    model_config = ConfigDict(extra="allow")

    name: str
    title: str = ""
    t: Number = Field(default=None, description="Latest tick; null before the first one.")
    age_s: Number = Field(default=None, description="Age of that tick by the service's clock, s.")
    patience_s: Number = Field(default=None, description="Age beyond which a tick is stale, s.")
    ticks_skipped: int | None = Field(
        default=None, description="Number of skipped ticks since the start; null if not monitored."
    )
    verdict: Decision | None = None
    model_only: bool | None = Field(default=None, description="As in the state; null before the first tick.")


class Feeders(BaseModel):
    """All feeders."""

    feeders: list[FeederSummary]


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
    patience_s: Number = Field(default=None, description="Age beyond which a state is stale, s.")
    revision: str = Field(
        description="Digest of all other fields; a state with another one does not belong to them."
    )
    layout: Layout
    tables: dict[str, Any]


class StalledMeterModel(BaseModel):
    """A meter that is not learned after twice the expected time."""

    meter: str
    reason: LearningReason | None
    gathered_s: float = Field(description="Time that counted, s.")


class AlarmEvidence(BaseModel):
    """Numbers of an alarm when it was raised, or when `data_error` was found."""

    score: Number
    threshold: Number
    v_volt_reported: Number
    v_volt_estimated: Number
    attack_volt_estimated: Number
    kind: str | None = Field(default=None, description="Attack kind of a meter.")
    attack_kvar_estimated: Number = Field(
        default=None, description="Injection of an inverter beyond its droop curve, kvar."
    )
    explanations: list[ExplanationModel] = []
    learning: list[StalledMeterModel] = Field(default=[], description="Meters with stalled learning.")
    data_error: DataErrorModel | None = Field(
        default=None, description="Error of the feeder's files that explains the accusation as well."
    )


class AlarmModel(BaseModel):
    """An alarm. Times are Unix seconds."""

    id: str
    kind: AlarmKind
    feeder: str
    meter: str | None = Field(
        description="Null for an alarm of the whole feeder; `substation` is the busbar meter."
    )
    severity: Severity
    state: AlarmState
    count: int = Field(description="Number of occurrences; above 1 the alarm flaps.")
    t_event: float = Field(description="Start of the condition.")
    t_raised: float = Field(description="End of the on-delay.")
    t_cleared: float | None
    reason: str
    evidence: AlarmEvidence
    acknowledged_by: str | None
    t_acknowledged: float | None
    comment: str | None
    customer: str | None = Field(
        default=None, description="Customer of the inverter, for an alarm of an inverter."
    )


class Alarms(BaseModel):
    """A page of alarms, those with the latest onset first."""

    alarms: list[AlarmModel]
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


class AlarmEvent(BaseModel):
    """One event of an alarm, and the alarm after it."""

    seq: int
    t: float
    change: Change
    who: str | None
    comment: str | None
    alarm: AlarmModel


class AlarmEvents(BaseModel):
    """A page of events of an alarm, oldest first."""

    events: list[AlarmEvent]
    next: int | None = Field(description="`after` of the next page; null on the last one.")


class Acknowledgement(BaseModel):
    """Acknowledgement by an operator."""

    model_config = ConfigDict(extra="forbid")

    who: Line
    comment: Text = ""
    count: int | None = Field(
        default=None,
        ge=1,
        description="The alarm's `count` that the operator refers to; 409 if it has been raised since.",
    )


class Recommissioning(BaseModel):
    """Request of an operator to restart the learning of meters."""

    model_config = ConfigDict(extra="forbid")

    who: Line
    reason: Annotated[Text, StringConstraints(min_length=1)]
    meters: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None, description="Replaced meters; without this field the learning of all restarts."
    )

    @classmethod
    def of(cls, body: bytes, known: Sequence[str]) -> Recommissioning | list[Any]:
        """Return the request in a body, or all its problems.

        Parameters
        ----------
        body
            JSON.
        known
            Ids of the feeder's meters.
        """
        try:
            given = json.loads(body)
        except (ValueError, RecursionError) as error:
            return [{"loc": ("body",), "msg": f"not JSON: {error}", "type": "json_invalid"}]
        found, problems = None, list[Any]()
        try:
            found = cls.model_validate(given)
        except ValidationError as error:
            problems = [{**one, "loc": ("body", *one["loc"])} for one in error.errors(include_url=False)]
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


class HistoryPoint(BaseModel):
    """A kept tick of a feeder."""

    t: float
    verdict: Decision
    cause: Cause
    seen: int = Field(description="Number of meters with a usable reading.")
    suspects: list[str]
    v_volt_lowest: Number = Field(
        description="Lowest reconstructed voltage at a meter that is not model only, V."
    )
    v_volt_highest: Number = Field(description="Highest such voltage, V.")
    model_only: bool = Field(default=False, description="As in the state.")
    meter: HistoryMeter | None = Field(default=None, description="The requested meter; null without one.")


class HistoryMeter(BaseModel):
    """One meter at a kept tick."""

    meter: str
    seen: bool
    suspect: bool
    v_volt_reported: Number
    v_volt_estimated: Number
    score: Number
    threshold: Number
    model_only: ModelOnly = False


class History(BaseModel):
    """The newest kept ticks of the requested time, oldest first."""

    feeder: str
    points: list[HistoryPoint]
    more: bool = Field(description="There may be older ones: repeat with `until` = `t` of the first.")


class RejectedReading(BaseModel):
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
