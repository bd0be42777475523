"""Reports of a feeder, and of its meters and inverters."""

from __future__ import annotations

from dataclasses import replace

from gridsec.interface import Cause, Decision
from service.alarms.state_machine import AlarmBook, AlarmTransition, AlarmUnknown, acknowledged, carry
from service.report.report import BusbarMeterState, FeederReport, InverterState, MeterState, Silence, finite
from tests.service.asking import T0

FEEDER = "village"


def meter(name: str = "m1", **changes: object) -> MeterState:
    made = MeterState(name, "b1", True, False, 1e-4, 2e-3, 230.0, 230.0, 0.5, 1.0, 0.0)
    return replace(made, **{"v_min_volt": 207.0, "v_max_volt": 253.0} | changes)  # type: ignore[arg-type]


def report(
    *meters: MeterState,
    cause: Cause = Cause.AGREEMENT,
    silent: tuple[tuple[str, float], ...] = (),
    t: float = T0,
) -> FeederReport:
    verdict = {Cause.AGREEMENT: Decision.CLEAN, Cause.RESIDUALS: Decision.ATTACKED}.get(
        cause, Decision.UNDECIDED
    )
    silences = tuple(Silence(meter, finite(seconds)) for meter, seconds in silent)
    made = FeederReport(FEEDER, t, verdict, "the reason", cause, 2, meters, (), silences, 207.0, 253.0)
    return replace(made, busbar=BusbarMeterState(judged=True, seen=True, suspect=False))


def acknowledge(
    book: AlarmBook, alarm_id: str, who: str, comment: str, t: float, *, count: int | None = None
) -> tuple[AlarmBook, AlarmTransition]:
    """Acknowledge an alarm of a book as the engine does."""
    alarm = next((one for one in book.alarms if one.id == alarm_id), None)
    if alarm is None:
        raise AlarmUnknown(alarm_id)
    transition = acknowledged(alarm, who, comment, t, count=count)
    after = carry(book, transition.alarm)
    assert after is not None
    return after, transition


def inverter(customer: str = "Miller", **changes: object) -> InverterState:
    made = InverterState(customer, "b1", "m1", True, False, 2.0, 0.0)
    return replace(made, **changes)  # type: ignore[arg-type]


def with_inverters(now: FeederReport, *inverters: InverterState) -> FeederReport:
    return replace(now, inverters=inverters)
