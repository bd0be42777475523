"""What REST shows, as pydantic models: they write the OpenAPI description and keep NaN out of JSON."""

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
from service.store.schema import Step


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
    """An error, as RFC 9457 describes it (`application/problem+json`)."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="Kind of problem; `about:blank` if the status says it all.")
    title: str
    status: int
    detail: str
    instance: str = Field(description="Path of the request.")


ModelOnly = Annotated[
    bool,
    Field(
        description="The estimated values rest on no voltage reading of this tick: on powers, the model and "
        "what the estimator remembers alone."
    ),
]


class MeterState(BaseModel):
    """One meter at the latest tick."""

    meter: str
    bus: str
    seen: bool = Field(description="A usable reading belongs to this tick.")
    suspect: bool = Field(description="The verdict names this meter as manipulated.")
    score: Number = Field(description="Absolute residual of the squared voltage, squared pu.")
    threshold: Number = Field(description="The largest score that an honest meter can reach, squared pu.")
    v_volt_reported: Number = Field(description="Voltage the meter claims, phase to neutral, V.")
    v_volt_estimated: Number = Field(description="Reconstructed voltage, V.")
    v_volt_std: Number = Field(description="Its standard deviation, or a third of its hard bound, V.")
    v2_pu_estimated: Number = Field(description="Reconstructed squared voltage, pu.")
    attack_volt_estimated: Number = Field(description="Reported minus reconstructed, V; 0 if no suspect.")
    kind: str | None = Field(default=None, description="What the manipulation looks like, if known.")
    phase: str | None = Field(default=None, description="Phase that it measures; null if balanced.")
    v_min_volt: Number = Field(default=None, description="Lowest voltage allowed where it is, V.")
    v_max_volt: Number = Field(default=None, description="Highest voltage allowed where it is, V.")
    learning_state: LearningState | None = Field(
        default=None, description="Learning of its own error; null where the estimator does not learn."
    )
    learning_reason: LearningReason | None = Field(
        default=None, description="Reason that took most of the time that did not count; null on schedule."
    )
    model_only: ModelOnly = False
    clock_offset_s: Number = Field(
        default=None,
        description="By how much its clock is ahead of the other meters', s; null where not measurable.",
    )


class BusbarMeterState(BaseModel):
    """The busbar's own meter at the latest tick; in three phases the numbers are those of one of them."""

    meter: str = Field(default=BUSBAR, description="Its name in alarms and explanations.")
    judged: bool = Field(
        default=False,
        description="The estimator judges this meter, and this tick has readings to do so: of this meter and "
        "of a trusted meter in the same phase.",
    )
    seen: bool = Field(default=False, description="A usable reading belongs to this tick.")
    suspect: bool = Field(default=False, description="The verdict names it as manipulated.")
    phases: list[str] = Field(
        default=[], description="In which phases, a, b or c; empty on a balanced feeder."
    )
    phase: str | None = Field(
        default=None, description="Phase that the numbers are of, the one furthest off; null if balanced."
    )
    v_volt_reported: Number = Field(default=None, description="Voltage it claims, phase to neutral, V.")
    v_volt_estimated: Number = Field(default=None, description="Reconstructed voltage of the busbar, V.")
    attack_volt_estimated: Number = Field(
        default=None, description="What it reads too much, on average, V; 0 if no suspect."
    )
    model_only: ModelOnly = False
    clock_offset_s: Number = Field(
        default=None,
        description="By how much its clock is ahead of the other meters', s; null where not measurable.",
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
    judged: bool = Field(description="The estimator can tell whether it is manipulated.")
    suspect: bool = Field(description="The verdict names this inverter as manipulated.")
    q_kvar_estimated: Number = Field(description="Reactive power that it injects, kvar.")
    attack_kvar_estimated: Number = Field(description="What its curve does not ask for of it, kvar.")
    model_only: ModelOnly = False


class ExplanationModel(BaseModel):
    """One way to explain the readings, where several do about equally well."""

    meters: list[str] = Field(description="Which meters would lie; `substation` is the busbar's.")
    inverters: list[str] = Field(description="Whose inverters would inject a wrong reactive power.")
    powers: list[str] = Field(
        default=[], description="Whose powers would not be what they are said to be; accuses nobody."
    )
    probability: float = Field(description="Its share among the explanations given.")


class DataErrorModel(BaseModel):
    """An error of the feeder's files that explains accused meters as well as a manipulation does."""

    kind: DataErrorKind
    meters: list[str] = Field(description="The accused meters that it explains.")
    customers: list[str] = Field(description="The one customer, or the two that are exchanged.")
    proposed: list[str] = Field(description="Bus and phase of each customer that explain the readings.")
    study: str = Field(description="Command that checks it on a recording.")
    text: str = Field(description="One sentence for the operator.")


class BusState(BaseModel):
    """One bus at the latest tick."""

    bus: str
    v_volt: Number = Field(
        description="Reconstructed voltage to neutral, V; of several phases that furthest from nominal."
    )
    v_phases: list[Number] | None = Field(
        default=None, description="Reconstructed voltage of each phase, V; null on a balanced feeder."
    )
    model_only: ModelOnly = False


class Silence(BaseModel):
    """A meter without usable readings for longer than the feeder allows."""

    meter: str
    seconds: Number


class State(BaseModel):
    """A feeder at its latest tick."""

    feeder: str
    revision: str = Field(default="", description="That of the feeder that it is about.")
    t: float = Field(description="Unix time of the tick, s.")
    age_s: float = Field(description="How old it was when this was sent, by the service's clock, s.")
    verdict: Decision
    reason: str
    cause: Cause
    max_attacked: int
    skipped: int = Field(default=0, description="Ticks directly before this one that were not judged.")
    model_only: bool = Field(
        default=False, description="No value of the feeder rests on a voltage reading of this tick."
    )
    model_only_phases: list[str] = Field(
        default=[], description="Of a, b and c those without such a reading; empty on a balanced feeder."
    )
    t_measured: Number = Field(
        default=None,
        description="Newest tick at which a value rested on a reading, Unix s; null: none since the start.",
    )
    meters: list[MeterState]
    buses: list[BusState]
    silent: list[Silence]
    v_min_volt: Number
    v_max_volt: Number
    busbar: BusbarMeterState = Field(default=BusbarMeterState(), description="The busbar's own meter.")
    customers: list[CustomerState] = []
    inverters: list[InverterState] = []
    explanations: list[ExplanationModel] = []
    data_error: DataErrorModel | None = Field(
        default=None, description="Error of the feeder's files that explains the accused meters as well."
    )


class MeterCommissioning(BaseModel):
    """What is known of one meter's own fixed error."""

    meter: str
    state: Stage
    since: Number = Field(description="Since when it is being learned, Unix s; null once it is learned.")
    learned_at: Number = Field(description="When it was learned, Unix s; null while it is not.")
    gathered_s: Number = Field(description="For how long it was heard and trusted meanwhile, s.")
    expected: Number = Field(description="When it is learned at the latest if heard and trusted, Unix s.")
    error_volt: Number = Field(description="Its own error at nominal voltage, V; 0 while not learned.")
    error_volt_std: Number = Field(description="Standard deviation of that, ageing included, V.")
    allowed_volt: Number = Field(description="By how much it may honestly differ from its error, V.")
    learning_state: LearningState = Field(
        description="`waiting`: no tick counted yet. `learning`. `stalled`: not learned after twice "
        "`expected_s`. `learned`."
    )
    learning_reason: LearningReason | None = Field(
        description="Reason that took most of the time that did not count; null on schedule."
    )
    watched_s: Number = Field(description="Time of all ticks since learning began, s; null once learned.")
    lost_s: dict[LearningReason, float] = Field(description="Time that did not count, s, by reason.")


class MeterNow(MeterState):
    """One meter at the latest tick, with what it belongs to."""

    feeder: str
    t: float
    verdict: Decision
    commissioning: MeterCommissioning | None = Field(
        default=None, description="What is known of its own error; null where that is not learned."
    )


class Commissioning(BaseModel):
    """How far the meters' own fixed errors are known."""

    feeder: str
    estimator: str
    state: Stage = Field(
        description="`off`: this monitor learns nothing. `waiting`: no monitor or no tick yet. `learning`: "
        "at least one meter is being learned. `learned`: all are."
    )
    t: Number = Field(description="Tick that this is about, Unix s.")
    tick_s: float = Field(description="Interval of the monitor's steps, s.")
    needed_s: float = Field(description="`commission_s`: for how long a meter has to be heard, s.")
    gathered_s: Number = Field(
        description="For how long the meter heard least was, of those being learned, s."
    )
    since: Number = Field(description="Since when there is something to learn, Unix s.")
    expected: Number = Field(description="When it will be finished, Unix s; null if `held`.")
    learned_at: Number = Field(description="When the last meter was learned, Unix s.")
    held: bool = Field(description="Time enough has passed, but nothing is learned while one is suspected.")
    restored: bool = Field(description="It goes on from what an earlier run of the service kept.")
    note: str = Field(description="Why what was kept is not used; empty if all is well.")
    expected_s: Number = Field(description="Time that learning takes if every tick counts, s.")
    stalled: int = Field(description="Meters that are not learned after twice that time.")
    kept: Number = Field(description="Tick up to which it is in the database, Unix s.")
    meters: list[MeterCommissioning]


class CommissioningEvent(BaseModel):
    """Something that happened to a commissioning."""

    t: float
    change: Step
    meters: list[str]
    who: str | None
    reason: str


class CommissioningEvents(BaseModel):
    """What happened to a commissioning, oldest first."""

    events: list[CommissioningEvent]


class FeederSummary(BaseModel):
    """A feeder in the list."""

    model_config = ConfigDict(extra="allow")

    name: str
    title: str = ""
    t: Number = Field(default=None, description="Latest tick; null before the first one.")
    age_s: Number = Field(default=None, description="How old that is by the service's clock, s.")
    patience_s: Number = Field(default=None, description="An older tick is stale, s.")
    ticks_skipped: int | None = Field(
        default=None, description="Ticks that were not judged since the service started; null if not watched."
    )
    verdict: Decision | None = None
    model_only: bool | None = Field(default=None, description="As in the state; null before the first tick.")


class Feeders(BaseModel):
    """All feeders."""

    feeders: list[FeederSummary]


class LayoutCustomer(BaseModel):
    """Where a customer is connected."""

    customer: str
    bus: str = Field(description="Id of the bus in this layout (zero-impedance lines fuse buses).")
    meter: str | None = Field(default=None, description="Its meter; null if it has none.")
    phase: str | None = Field(default=None, description="Its phase: a, b or c; null on a balanced feeder.")


class Layout(BaseModel):
    """A tree of the feeder, the busbar first, and the lines that close loops in it."""

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
    patience_s: Number = Field(default=None, description="A state that is older is stale, s.")
    revision: str = Field(description="Digest of all the rest; a state with another one is not about this.")
    layout: Layout
    tables: dict[str, Any]


class StalledMeterModel(BaseModel):
    """A meter that is not learned after twice the expected time."""

    meter: str
    reason: LearningReason | None
    gathered_s: float = Field(description="Time that counted, s.")


class AlarmEvidence(BaseModel):
    """The numbers behind an alarm when it was raised, or when `data_error` was found."""

    score: Number
    threshold: Number
    v_volt_reported: Number
    v_volt_estimated: Number
    attack_volt_estimated: Number
    kind: str | None = Field(default=None, description="What a meter's manipulation looks like.")
    attack_kvar_estimated: Number = Field(
        default=None, description="Wrong part of an inverter's injection, kvar."
    )
    explanations: list[ExplanationModel] = []
    learning: list[StalledMeterModel] = Field(default=[], description="Meters whose learning is stalled.")
    data_error: DataErrorModel | None = Field(
        default=None, description="Error of the feeder's files that explains the accusation as well."
    )


class AlarmModel(BaseModel):
    """An alarm. Times are Unix seconds."""

    id: str
    kind: AlarmKind
    feeder: str
    meter: str | None = Field(description="Null if it is about the whole feeder; `substation` is the busbar.")
    severity: Severity
    state: AlarmState
    count: int = Field(description="How often it has been raised; above 1 it flaps.")
    t_event: float = Field(description="When the condition was first seen.")
    t_raised: float = Field(description="When it had lasted for the on-delay.")
    t_cleared: float | None
    reason: str
    evidence: AlarmEvidence
    acknowledged_by: str | None
    t_acknowledged: float | None
    comment: str | None
    customer: str | None = Field(default=None, description="Whose inverter it is about.")


class Alarms(BaseModel):
    """A page of alarms, those that began last first."""

    alarms: list[AlarmModel]
    next: str | None = Field(description="Cursor of the next page; null on the last one.")
    last_event: int = Field(description="Newest event number: `after` of the stream that goes on from here.")
    raised: int = Field(description="So many alarms of all feeders and kinds stand that nobody has answered.")
    unstored: int = Field(
        default=0, description="So many changes of alarms wait for the database and are not among these."
    )
    problem: str | None = Field(
        default=None, description="What is wrong with the database; null while it takes what it is given."
    )


class AlarmEvent(BaseModel):
    """Something that happened to an alarm, and the alarm as it was afterwards."""

    seq: int
    t: float
    change: Change
    who: str | None
    comment: str | None
    alarm: AlarmModel


class AlarmEvents(BaseModel):
    """A page of what happened to an alarm, oldest first."""

    events: list[AlarmEvent]
    next: int | None = Field(description="`after` of the next page; null on the last one.")


class Acknowledgement(BaseModel):
    """The answer of an operator."""

    model_config = ConfigDict(extra="forbid")

    who: Line
    comment: Text = ""
    count: int | None = Field(
        default=None, ge=1, description="The alarm's `count` as it was seen; 409 if it has been raised since."
    )


class Recommissioning(BaseModel):
    """The wish of an operator to have meters learned anew."""

    model_config = ConfigDict(extra="forbid")

    who: Line
    reason: Annotated[Text, StringConstraints(min_length=1)]
    meters: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None, description="Which meters were replaced; without this, all are learned anew."
    )

    @classmethod
    def of(cls, body: bytes, known: Sequence[str]) -> Recommissioning | list[Any]:
        """Return what a body says, or everything that is wrong with it at once.

        Parameters
        ----------
        body
            JSON.
        known
            The feeder's meters.
        """
        try:
            given = json.loads(body)
        except (ValueError, RecursionError) as error:
            return [{"loc": ("body",), "msg": f"no JSON: {error}", "type": "json_invalid"}]
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
            what = f"there is no meter {meter!r}" if meter not in known else f"meter {meter!r} is named twice"
            if meter not in known or meter in seen:
                problems.append({"loc": ("body", "meters", k), "msg": what, "type": "meter"})
            seen.add(meter)
        return problems or found or []

    @classmethod
    def in_openapi(cls) -> dict[str, Any]:
        """Return how a request is described."""
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
    v_volt_highest: Number = Field(description="Highest one likewise, V.")
    model_only: bool = Field(default=False, description="As in the state.")
    meter: HistoryMeter | None = Field(default=None, description="If one was asked for and was there.")


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
    """The newest kept ticks of the time asked for, oldest first."""

    feeder: str
    points: list[HistoryPoint]
    more: bool = Field(description="There may be older ones: ask again with `until` = `t` of the first.")


class RejectedReading(BaseModel):
    """A reading that could not be used."""

    t: float
    key: str
    reason: str
    payload: str = Field(description="The start of its bytes, as text where that is possible.")


class RejectedReadings(BaseModel):
    """The newest readings that could not be used, newest first."""

    readings: list[RejectedReading]


class Health(BaseModel):
    """The answer to a probe."""

    ok: Literal[True]
    reasons: list[str]


HistoryPoint.model_rebuild()
