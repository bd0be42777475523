"""Report of one feeder at one tick, in operators' units and terms.

The monitor uses per unit and indices; everything after it (alarms, store, REST, zenoh, web page) uses
`FeederReport`, in volts and with the ids of the feeder's files. A report is a value: it contains only tuples,
strings and floats, so that it can be stored, compared, sent and read from any thread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter

from feeders.model.site import Site, volts
from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential import LearningReason, LearningState
from gridsec.interface import Cause, Decision, Estimate, Verdict
from service.ingest.align import Tick
from service.report.reasons import DataErrorReport, reason_of
from service.report.voltages import (
    BUSBAR,
    UNKNOWN_BUSBAR,
    BusbarMeterState,
    ClockOffset,
    ModelOnly,
    ReferenceVoltages,
    attack_volts,
    bus_volts,
    busbar_phases,
    busbar_report,
    grounds,
    std_volts,
)


@dataclass(frozen=True, slots=True)
class StalledMeter:
    """A meter that is not learned after twice the expected time."""

    meter: str
    reason: LearningReason | None  # None without lost time
    gathered_s: Annotated[float, Field(description="Time that counted, s.")]


@dataclass(frozen=True, slots=True)
class LearningReport:
    """Learning of the meters' fixed errors at one tick; empty where the estimator does not learn."""

    states: tuple[LearningState, ...] = ()  # of each meter
    reasons: tuple[LearningReason | None, ...] = ()
    expected_s: float | None = None  # time of learning if every tick counts, s
    stalled: tuple[StalledMeter, ...] = ()


@dataclass(frozen=True, slots=True)
class MeterState:
    """One meter at the latest tick."""

    meter: str
    bus: str
    seen: Annotated[bool, Field(description="A usable reading belongs to this tick.")]
    suspect: Annotated[bool, Field(description="The verdict names this meter as manipulated.")]
    score: Annotated[float | None, Field(description="Absolute residual of the squared voltage, squared pu.")]
    threshold: Annotated[float | None, Field(description="Largest score of an honest meter, squared pu.")]
    v_volt_reported: Annotated[float | None, Field(description="Reported voltage, phase to neutral, V.")]
    v_volt_estimated: Annotated[float | None, Field(description="Reconstructed voltage, V.")]
    v_volt_std: Annotated[
        float | None, Field(description="Its standard deviation, or a third of its hard bound, V.")
    ]
    v2_pu_estimated: Annotated[float | None, Field(description="Reconstructed squared voltage, pu.")]
    attack_volt_estimated: Annotated[
        float | None, Field(description="Reported minus reconstructed, V; 0 if not suspect.")
    ]
    kind: Annotated[str | None, Field(description="Attack kind, if known.")] = None
    phase: Annotated[str | None, Field(description="Measured phase; null if balanced.")] = None
    v_min_volt: Annotated[float | None, Field(description="Lowest permitted voltage at the meter, V.")] = None
    v_max_volt: Annotated[float | None, Field(description="Highest permitted voltage at the meter, V.")] = (
        None
    )
    learning_state: Annotated[
        LearningState | None,
        Field(description="Learning of its fixed error; null if the estimator does not learn."),
    ] = None
    learning_reason: Annotated[
        LearningReason | None,
        Field(
            description="Reason that took most of the time that did not count; null on schedule.",
        ),
    ] = None
    model_only: ModelOnly = False
    clock_offset_s: ClockOffset = None


@dataclass(frozen=True, slots=True)
class CustomerState:
    """One customer at the latest tick, metered or not."""

    customer: str
    v_volt_estimated: Annotated[float | None, Field(description="Reconstructed voltage, V.")]
    v_volt_std: Annotated[
        float | None, Field(description="Its standard deviation, or a third of its hard bound, V.")
    ]
    model_only: ModelOnly = False


@dataclass(frozen=True, slots=True)
class InverterState:
    """One droop inverter at the latest tick."""

    customer: str
    bus: str
    meter: Annotated[str | None, Field(description="The customer's meter, if there is one.")]
    judged: Annotated[bool, Field(description="The inverter is monitored at this tick.")]
    suspect: Annotated[bool, Field(description="The verdict names this inverter as manipulated.")]
    q_kvar_estimated: Annotated[float | None, Field(description="Injected reactive power, kvar.")]
    attack_kvar_estimated: Annotated[
        float | None, Field(description="Injection beyond its droop curve, kvar.")
    ]
    model_only: ModelOnly = False


@dataclass(frozen=True, slots=True)
class ExplanationReport:
    """One of several explanations of the readings with similar probability."""

    meters: Annotated[tuple[str, ...], Field(description="Accused meters; `substation` is the busbar meter.")]
    inverters: Annotated[tuple[str, ...], Field(description="Accused inverters, by customer.")]
    probability: Annotated[float, Field(description="Share among the given explanations.")]
    powers: Annotated[
        tuple[str, ...], Field(description="False reported powers, by customer; accuses no meter.")
    ] = ()


@dataclass(frozen=True, slots=True)
class BusState:
    """One bus at the latest tick."""

    bus: str
    v_volt: Annotated[
        float | None,
        Field(
            description="Reconstructed voltage to neutral, V; in three phases the one furthest from nominal."
        ),
    ]
    v_phases: Annotated[
        tuple[float | None, ...] | None,
        Field(description="Reconstructed voltage of each phase, V; null on a balanced feeder."),
    ] = None
    model_only: ModelOnly = False


@dataclass(frozen=True, slots=True)
class Silence:
    """A meter without usable readings for longer than `silence_s` of the feeder."""

    meter: str
    seconds: float | None  # since its last usable reading; None: none since the start


@dataclass(frozen=True, slots=True)
class FeederReport:
    """A feeder at one tick, as REST's `state` and the zenoh key `estimate` show it."""

    feeder: str
    t: Annotated[float, Field(description="Unix time of the tick, s.")]
    verdict: Decision
    reason: str
    cause: Cause
    max_attacked: int
    meters: tuple[MeterState, ...]
    buses: tuple[BusState, ...]
    silent: tuple[Silence, ...]
    v_min_volt: float | None
    v_max_volt: float | None
    customers: tuple[CustomerState, ...] = ()
    inverters: tuple[InverterState, ...] = ()
    explanations: tuple[ExplanationReport, ...] = ()  # the likeliest first
    busbar: Annotated[BusbarMeterState, Field(description="The busbar meter.")] = UNKNOWN_BUSBAR
    # None at a tick without a monitor.
    learning: Annotated[LearningReport | None, Field(exclude=True)] = LearningReport()
    revision: Annotated[str, Field(description="Revision of the feeder that the state belongs to.")] = ""
    skipped: Annotated[int, Field(description="Number of skipped ticks directly before this one.")] = 0
    model_only: Annotated[
        bool, Field(description="No value of the feeder uses a voltage reading of this tick.")
    ] = False
    model_only_phases: Annotated[
        tuple[str, ...],
        Field(description="Phases without such a reading, of a, b and c; empty on a balanced feeder."),
    ] = ()
    t_measured: Annotated[
        float | None,
        Field(
            description="Newest tick with a reading that a value uses, Unix s; null: none since the start."
        ),
    ] = None
    since: Annotated[
        float | None,
        Field(description="First consecutive tick with this verdict since the start of the service, Unix s."),
    ] = None
    data_error: Annotated[
        DataErrorReport | None,
        Field(description="Error of the feeder's files that explains the accused meters as well."),
    ] = None

    @property
    def suspects(self) -> tuple[str, ...]:
        """Meters that the verdict names as manipulated, the busbar meter as `BUSBAR`."""
        named = tuple(meter.meter for meter in self.meters if meter.suspect)
        return (*named, BUSBAR) if self.busbar.suspect else named


_REPORT = TypeAdapter(FeederReport)


def to_json(report: FeederReport) -> dict[str, Any]:
    """Return the report as the JSON object of REST's `state` (without `age_s`) and of zenoh's `estimate`."""
    found: dict[str, Any] = _REPORT.dump_python(report, mode="json")
    return found


def to_text(report: FeederReport) -> bytes:
    """Return the text of `to_json`, without the objects in between."""
    return _REPORT.dump_json(report)


def finite(value: float) -> float | None:
    """Return a number for JSON: None for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


def with_learning(report: FeederReport, learning: LearningReport) -> FeederReport:
    """Return the report with the learning of its meters."""
    if not learning.states:
        return replace(report, learning=learning)
    each = zip(report.meters, learning.states, learning.reasons, strict=True)
    meters = tuple(replace(m, learning_state=state, learning_reason=reason) for m, state, reason in each)
    return replace(report, meters=meters, learning=learning)


def with_data_error(report: FeederReport, error: DataErrorReport | None) -> FeederReport:
    """Return the report with an error of the files that explains accused meters, also in its reason."""
    if error is None:
        return report
    return replace(report, data_error=error, reason=f"{report.reason.removesuffix('.')}. {error.text}")


def build(site: Site, tick: Tick, max_attacked: int, estimate: Estimate, verdict: Verdict) -> FeederReport:
    """Return the report of a tick, its estimate and its verdict; `max_attacked` is M of the design."""
    reason = reason_of(site, tick, max_attacked, verdict)
    return _report(site, tick, max_attacked, verdict.cause, reason, estimate=estimate, verdict=verdict)


def blind(site: Site, tick: Tick, max_attacked: int, cause: Cause, reason: str) -> FeederReport:
    """Return the report of a tick without a monitor: undecided, with the reported voltages."""
    return replace(_report(site, tick, max_attacked, cause, reason), learning=None)


def _report(
    site: Site,
    tick: Tick,
    max_attacked: int,
    cause: Cause,
    reason: str,
    *,
    estimate: Estimate | None = None,
    verdict: Verdict | None = None,
) -> FeederReport:
    limits, nominal = site.tables.meta.limits, site.tables.meta.voltage_volt
    rests_on = grounds(site, tick, estimate, verdict)
    alone, measured = rests_on.model_only(site), rests_on.measured.tolist()
    v = std = np.full(len(site.feeder.customers), math.nan)
    if estimate is not None:
        v, std = volts(site.customer_volt, estimate.v2), std_volts(site, estimate)
    each = zip(site.feeder.customers, map(finite, v), map(finite, std), alone.tolist(), strict=True)
    return FeederReport(
        feeder=site.feeder.name,
        t=tick.t,
        verdict=Decision.UNDECIDED if verdict is None else verdict.decision,
        reason=f"{reason.removesuffix('.')}. {skipped_in_words(tick.skipped)}" if tick.skipped else reason,
        cause=cause,
        max_attacked=max_attacked,
        meters=_meters(site, tick, estimate, verdict, volts_of=(v, std), model_only=alone),
        buses=_buses(site, estimate, rests_on),
        silent=tuple(Silence(BUSBAR if meter is None else meter, finite(s)) for meter, s in tick.silent),
        v_min_volt=limits.v_min_pu * nominal,
        v_max_volt=limits.v_max_pu * nominal,
        customers=tuple(CustomerState(*one) for one in each),
        inverters=_inverters(site, estimate, verdict, alone),
        explanations=() if verdict is None else _explanations(site, verdict),
        busbar=busbar_report(site, tick, estimate, verdict),
        skipped=tick.skipped,
        model_only=not any(measured),
        model_only_phases=tuple(
            phase for phase, one in zip(busbar_phases(site), measured, strict=True) if phase and not one
        ),
    )


def _meters(
    site: Site,
    tick: Tick,
    estimate: Estimate | None,
    verdict: Verdict | None,
    *,
    volts_of: tuple[Floats, Floats],
    model_only: Bools,
) -> tuple[MeterState, ...]:
    at, limits, (v, std) = site.meters, site.tables.meta.limits, volts_of
    unknown = np.full(at.size, math.nan)
    kinds: Sequence[Any] = () if verdict is None else verdict.kinds
    scores = (unknown,) * 3
    if verdict is not None:
        scores = (verdict.score, verdict.threshold, attack_volts(site, tick, verdict))
    # Relative to nominal, behind taps too.
    ratio = (site.customer_volt / site.customer_nominal) ** 2
    v2 = unknown if estimate is None else (estimate.v2 * ratio)[at]
    offsets = tick.clock_offset or (None,) * at.size
    meters = []
    for k, (customer, reading) in enumerate(zip(at.tolist(), tick.readings, strict=True)):
        row, volt = site.tables.customers[customer], float(site.customer_nominal[customer])
        kind = kinds[k] if kinds else None
        meters.append(
            MeterState(
                meter=site.meter_ids[k],
                bus=row.bus,
                seen=reading is not None,
                suspect=verdict is not None and bool(verdict.suspects[k]),
                score=finite(scores[0][k]),
                threshold=finite(scores[1][k]),
                v_volt_reported=None if reading is None else reading.v_volt,
                v_volt_estimated=finite(v[customer]),
                v_volt_std=finite(std[customer]),
                v2_pu_estimated=finite(v2[k]),
                attack_volt_estimated=finite(scores[2][k]),
                kind=None if kind is None else str(kind),
                phase=row.phases if len(row.phases) == 1 else None,
                v_min_volt=limits.v_min_pu * volt,
                v_max_volt=limits.v_max_pu * volt,
                model_only=bool(model_only[customer]),
                clock_offset_s=offsets[k],
            )
        )
    return tuple(meters)


def _buses(site: Site, estimate: Estimate | None, rests_on: ReferenceVoltages) -> tuple[BusState, ...]:
    names = site.spanning.buses
    if estimate is None:
        alone = not rests_on.measured.any()
        return tuple(BusState(bus, None, None, alone) for bus in names)
    one, phases, model_only = bus_volts(site, estimate.v2_bus, rests_on.measured)
    return tuple(
        BusState(bus, finite(v), tuple(map(finite, row)) if row.size else None, alone)
        for bus, v, row, alone in zip(names, one, phases, model_only.tolist(), strict=True)
    )


def _inverters(
    site: Site, estimate: Estimate | None, verdict: Verdict | None, model_only: Bools
) -> tuple[InverterState, ...]:
    """Reports of all inverters; model-only values test none, but an inverter stays named as manipulated."""
    base = site.feeder.base_kva
    judges = verdict is not None and verdict.inverters.size > 0
    out = []
    for i, customer in enumerate(site.droop.customer.tolist()):
        row, alone = site.tables.customers[customer], bool(model_only[customer])
        asked = verdict is not None and judges and not (verdict.unjudged.size and verdict.unjudged[i])
        named = verdict is not None and asked and bool(verdict.inverters[i])
        judged = asked and not alone
        wrong = base * verdict.inverter_attack[i] if verdict is not None and judged else math.nan
        x = math.nan if estimate is None else base * estimate.x[i]
        meter = row.meter or None
        out.append(
            InverterState(row.customer, row.bus, meter, judged, named, finite(x), finite(wrong), alone)
        )
    return tuple(out)


def _explanations(site: Site, verdict: Verdict) -> tuple[ExplanationReport, ...]:
    owners = [site.feeder.customers[int(c)] for c in site.droop.customer]
    return tuple(
        ExplanationReport(
            tuple(site.meter_ids[k] for k in np.flatnonzero(e.meters)) + (BUSBAR,) * bool(e.busbar.any()),
            tuple(owners[i] for i in np.flatnonzero(e.inverters)),
            float(e.probability),
            tuple(site.feeder.customers[c] for c in np.flatnonzero(e.powers)),
        )
        for e in verdict.explanations
    )


def skipped_in_words(count: int) -> str:
    """Return the sentence about skipped ticks, 1 or more."""
    return "The tick before was skipped." if count == 1 else f"The {count} ticks before were skipped."
