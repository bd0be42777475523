"""Alarms, their transitions, and their JSON. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from gridsec.errors import GridsecError
from service.alarms.conditions import AlarmKind, ConditionEvidence, Severity
from service.report.reasons import DataErrorReport
from service.report.report import ExplanationReport, StalledMeter


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
    """An alarm. Times are Unix seconds.

    Attributes
    ----------
    id
        26 characters, the first ten of which sort by time; the same data give the same id.
    kind, feeder, meter, severity, reason, evidence, customer
        As in the condition of the alarm.
    state
        Raised, acknowledged or cleared.
    count
        Number of occurrences; above 1 the alarm flaps.
    t_event
        Start of the condition of the present (or last) occurrence.
    t_raised
        End of the on-delay of that occurrence.
    t_cleared
        Time of clearing; None while active.
    acknowledged_by, t_acknowledged, comment
        Operator's acknowledgement of the present (or last) occurrence.
    """

    id: str
    kind: AlarmKind
    feeder: str
    meter: str | None
    severity: Severity
    state: AlarmState
    count: int
    t_event: float
    t_raised: float
    t_cleared: float | None
    reason: str
    evidence: ConditionEvidence
    acknowledged_by: str | None = None
    t_acknowledged: float | None = None
    comment: str | None = None
    customer: str | None = None

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


def to_json(alarm: Alarm) -> dict[str, Any]:
    """Return the alarm as the JSON object of REST and zenoh."""
    return {
        **asdict(alarm),
        "kind": str(alarm.kind),
        "severity": str(alarm.severity),
        "state": str(alarm.state),
    }


def from_json(data: Mapping[str, Any]) -> Alarm:
    """Return the alarm that `to_json` wrote.

    Parameters
    ----------
    data
        The object; it may have more fields, and older ones lack newer fields.
    """
    fields = {name: data[name] for name in Alarm.__dataclass_fields__ if name in data}
    fields["kind"] = AlarmKind(data["kind"])
    fields["severity"] = Severity(data["severity"])
    fields["state"] = AlarmState(data["state"])
    evidence = dict(data["evidence"])
    shown = evidence.pop("explanations", ())
    explanations = tuple(
        ExplanationReport(
            tuple(e["meters"]), tuple(e["inverters"]), e["probability"], tuple(e.get("powers", ()))
        )
        for e in shown
    )
    learning = tuple(StalledMeter(**meter) for meter in evidence.pop("learning", ()))
    error = evidence.pop("data_error", None)
    fields["evidence"] = ConditionEvidence(
        **evidence, explanations=explanations, learning=learning, data_error=_data_error(error)
    )
    return Alarm(**fields)


def _data_error(data: Mapping[str, Any] | None) -> DataErrorReport | None:
    if data is None:
        return None
    lists = {name: tuple(data[name]) for name in ("meters", "customers", "proposed")}
    return DataErrorReport(kind=data["kind"], study=data["study"], text=data["text"], **lists)
