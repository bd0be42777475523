"""Alarms and reports to store."""

from __future__ import annotations

from dataclasses import replace

from gridsec.interface import Cause, Decision
from service.alarms.state_machine import (
    Alarm,
    AlarmEvidence,
    AlarmKind,
    AlarmState,
    AlarmTransition,
    Change,
    Severity,
)
from service.report.report import FeederReport, MeterState
from service.store import Store, StoreUnavailable
from tests.service.asking import T0


def an_alarm(number: int = 0, **changes: object) -> Alarm:
    t = T0 + number
    made = Alarm(
        id=f"{number:026d}",
        kind=AlarmKind.METER_MANIPULATED,
        feeder="village",
        meter="m1",
        severity=Severity.CRITICAL,
        state=AlarmState.RAISED,
        count=1,
        t_event=t - 2,
        t_raised=t,
        t_cleared=None,
        reason="reports 240.0 V – «quoted» ' \" \\ 雪",
        evidence=AlarmEvidence(1e-3 / 3, None, 0.1 + 0.2, 230.0, -5e-324),
        acknowledged_by=None,
        t_acknowledged=None,
        comment=None,
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def raised(alarm: Alarm) -> AlarmTransition:
    return AlarmTransition(alarm, Change.RAISED, alarm.t_raised)


def a_report(
    t: float, suspects: tuple[str, ...] = (), *, count: int = 3, volt: float = 230.0
) -> FeederReport:
    meters = tuple(
        MeterState(f"m{i}", "b1", i != 2, f"m{i}" in suspects, 1e-4, 2e-3, volt, volt - 0.5, 0.1, 1.0, 0.0)
        for i in range(count)
    )
    verdict = (Decision.ATTACKED, Cause.RESIDUALS) if suspects else (Decision.CLEAN, Cause.AGREEMENT)
    return FeederReport("village", t, verdict[0], "", verdict[1], 2, meters, (), (), 207.0, 253.0)


def writable(store: Store) -> bool:
    """True if the database can be written now."""
    try:
        store.check()
    except StoreUnavailable:
        return False
    return True
