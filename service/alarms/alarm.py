"""Alarms, their transitions, and their JSON. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from gridsec.errors import GridsecError
from service.alarms.conditions import AlarmEvidence, AlarmKind, Severity


class AlarmState(StrEnum):
    """State of an alarm. Clearing keeps the acknowledgement; raising again requires a new one."""

    RAISED = "raised"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"


class Change(StrEnum):
    """Change of an alarm."""

    RAISED = "raised"
    ACKNOWLEDGED = "acknowledged"
    CLEARED = "cleared"
    UPDATED = "updated"


class AlarmUnknown(GridsecError):
    """No alarm has this id."""

    code = "unknown-alarm"

    def __init__(self, alarm_id: str) -> None:
        self.alarm_id = alarm_id
        super().__init__(f"no alarm has the id {alarm_id!r}")


class AlreadyAcknowledged(GridsecError):
    """The alarm is already acknowledged."""

    code = "already-acknowledged"

    def __init__(self, alarm: Alarm) -> None:
        self.alarm = alarm
        super().__init__(f"alarm {alarm.id} has already been acknowledged by {alarm.acknowledged_by}")


class RaisedAgain(GridsecError):
    """The acknowledgement refers to an earlier occurrence than the present one."""

    code = "raised-again"

    def __init__(self, alarm: Alarm, count: int) -> None:
        self.alarm = alarm
        super().__init__(
            f"this answers occurrence {count} of alarm {alarm.id}, which has been "
            f"raised {alarm.count} times by now: {alarm.reason}"
        )


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm. Times are Unix seconds."""

    id: str  # 26 characters, the first ten sort by time; the same data give the same id
    kind: AlarmKind
    feeder: str
    meter: Annotated[
        str | None,
        Field(description="Null for an alarm of the whole feeder; `substation` is the busbar meter."),
    ]
    severity: Severity
    state: AlarmState
    count: Annotated[int, Field(description="Number of occurrences; above 1 the alarm flaps.")]
    t_event: Annotated[float, Field(description="Start of the condition.")]
    t_raised: Annotated[float, Field(description="End of the on-delay.")]
    t_cleared: float | None
    reason: str
    evidence: AlarmEvidence
    acknowledged_by: str | None
    t_acknowledged: float | None
    comment: str | None
    customer: Annotated[
        str | None, Field(description="Customer of the inverter, for an alarm of an inverter.")
    ] = None

    @property
    def subject(self) -> str | None:
        """Subject of the alarm: a customer's inverter, a meter, or (None) the whole feeder."""
        return self.customer or self.meter

    @property
    def active(self) -> bool:
        """True until the alarm is cleared."""
        return self.state is not AlarmState.CLEARED


@dataclass(frozen=True, slots=True)
class AlarmTransition:
    """One change of one alarm: the alarm after it, the change, its time and the operator."""

    alarm: Alarm
    change: Change
    t: float
    who: str | None = None
    comment: str | None = None


_ALARM = TypeAdapter(Alarm)


def to_json(alarm: Alarm) -> dict[str, Any]:
    """Return the alarm as the JSON object of REST, zenoh and the database."""
    found: dict[str, Any] = _ALARM.dump_python(alarm, mode="json")
    return found


def from_json(data: Mapping[str, Any]) -> Alarm:
    """Return the alarm of `to_json`; further fields are ignored, absent newer ones have their defaults."""
    return _ALARM.validate_python(data)
