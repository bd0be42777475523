"""Reports of a feeder, and of its meters and inverters."""

from __future__ import annotations

from dataclasses import replace

from gridsec.interface import Cause, Decision
from service.report.report import BusbarReport, FeederReport, InverterReport, MeterReport
from tests.service.asking import T0

FEEDER = "village"


def meter(name: str = "m1", **changes: object) -> MeterReport:
    made = MeterReport(name, "b1", True, False, 1e-4, 2e-3, 230.0, 230.0, 0.5, 1.0, 0.0)
    return replace(made, **changes)  # type: ignore[arg-type]


def report(
    *meters: MeterReport,
    cause: Cause = Cause.AGREEMENT,
    silent: tuple[tuple[str, float], ...] = (),
    t: float = T0,
) -> FeederReport:
    verdict = {Cause.AGREEMENT: Decision.CLEAN, Cause.RESIDUALS: Decision.ATTACKED}.get(
        cause, Decision.UNDECIDED
    )
    made = FeederReport(FEEDER, t, verdict, "the reason", cause, 2, meters, (), silent, 207.0, 253.0)
    return replace(made, busbar=BusbarReport(judged=True, seen=True, suspect=False))


def inverter(customer: str = "Miller", **changes: object) -> InverterReport:
    made = InverterReport(customer, "b1", "m1", True, False, 2.0, 0.0)
    return replace(made, **changes)  # type: ignore[arg-type]


def with_inverters(now: FeederReport, *inverters: InverterReport) -> FeederReport:
    return replace(now, inverters=inverters)
