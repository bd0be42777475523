"""Reports of a feeder, and of its meters and inverters."""

from __future__ import annotations

from dataclasses import replace

from gridsec.interface import Cause, Decision
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


def inverter(customer: str = "Miller", **changes: object) -> InverterState:
    made = InverterState(customer, "b1", "m1", True, False, 2.0, 0.0)
    return replace(made, **changes)  # type: ignore[arg-type]


def with_inverters(now: FeederReport, *inverters: InverterState) -> FeederReport:
    return replace(now, inverters=inverters)
