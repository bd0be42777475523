"""Report of one feeder at one tick, in operators' units and terms.

The monitor uses per unit and indices; everything after it (alarms, store, REST, zenoh, web page) uses
`FeederReport`, in volts and with the ids of the feeder's files. A report is a value: it contains only tuples,
strings and floats, so that it can be stored, compared, sent and read from any thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from feeders.model.site import Site, volts
from gridsec.arrays import Bools
from gridsec.interface import Cause, Decision, Estimate, Verdict
from service.ingest.align import Tick
from service.report.reasons import DataErrorReport, reason_of
from service.report.voltages import (
    BUSBAR,
    UNKNOWN_BUSBAR,
    BusbarReport,
    ReferenceVoltages,
    attack_volts,
    bus_volts,
    busbar_phases,
    busbar_report,
    grounds,
    std_volts,
)

__all__ = [
    "BUSBAR",
    "BusbarReport",
    "CustomerReport",
    "DataErrorReport",
    "ExplanationReport",
    "FeederReport",
    "InverterReport",
    "LearningReport",
    "MeterReport",
    "StalledMeter",
    "blind",
    "build",
    "finite",
    "to_json",
    "with_data_error",
    "with_learning",
]


@dataclass(frozen=True, slots=True)
class StalledMeter:
    """A meter that is not learned after twice the expected time.

    Attributes
    ----------
    reason
        Code of `gridsec.estimators.sequential.LearningReason`; None without lost time.
    gathered_s
        Time that counted, s.
    """

    meter: str
    reason: str | None
    gathered_s: float


@dataclass(frozen=True, slots=True)
class LearningReport:
    """Learning of the meters' fixed errors at one tick.

    Attributes
    ----------
    states, reasons : (p,)
        Codes of `gridsec.estimators.sequential.LearningState` and `LearningReason`, in the order of the
        feeder's file; empty where the estimator does not learn.
    expected_s
        Time of learning if every tick counts, s; None if the estimator does not learn.
    stalled
        Meters that are not learned after twice that time.
    """

    states: tuple[str, ...] = ()
    reasons: tuple[str | None, ...] = ()
    expected_s: float | None = None
    stalled: tuple[StalledMeter, ...] = ()


@dataclass(frozen=True, slots=True)
class MeterReport:
    """One meter at one tick.

    Attributes
    ----------
    meter, bus
        Ids as in the feeder's files.
    seen
        True if a usable reading belongs to this tick.
    suspect
        True if the verdict names this meter as manipulated.
    score
        Absolute residual between reported and reconstructed squared voltage, squared pu; None if unavailable.
    threshold
        Largest score of an honest meter, squared pu; None without one.
    v_volt_reported
        Reported RMS phase-to-neutral voltage, V; None if unavailable.
    v_volt_estimated
        Reconstructed voltage at the meter's connection point, V; None without an estimate.
    v_volt_std
        Standard deviation of the reconstructed voltage, V. For estimators with an error bound only: a third
        of the half-width of the interval that contains the true voltage, as for the three-sigma interval of a
        normal distribution.
    v2_pu_estimated
        Reconstructed squared voltage over the square of its nominal voltage.
    attack_volt_estimated
        Reconstructed manipulation: reported minus reconstructed voltage, V, for suspects; 0 for others.
    kind
        Attack kind, see `gridsec.interface.ManipulationKind`; None if unknown.
    phase
        Measured phase: a, b or c; None on a balanced feeder.
    v_min_volt, v_max_volt
        Voltage limits at the meter, V: behind a transformer they differ from the busbar's; None: the
        feeder's.
    learning_state, learning_reason
        As in `LearningReport`; None if the estimator does not learn, or does not run.
    model_only
        True if the estimates use no reading of this tick, see `voltages.ReferenceVoltages`.
    clock_offset_s
        Lead of its clock relative to the other meters, s; None if not measurable.
    """

    meter: str
    bus: str
    seen: bool
    suspect: bool
    score: float | None
    threshold: float | None
    v_volt_reported: float | None
    v_volt_estimated: float | None
    v_volt_std: float | None
    v2_pu_estimated: float | None
    attack_volt_estimated: float | None
    kind: str | None = None
    phase: str | None = None
    v_min_volt: float | None = None
    v_max_volt: float | None = None
    learning_state: str | None = None
    learning_reason: str | None = None
    model_only: bool = False
    clock_offset_s: float | None = None

    def limits(self, report: FeederReport) -> tuple[float, float]:
        """Return the lowest and the highest permitted voltage at the meter, V.

        Parameters
        ----------
        report
            Report of its feeder.
        """
        low, high = self.v_min_volt, self.v_max_volt
        return report.v_min_volt if low is None else low, report.v_max_volt if high is None else high


@dataclass(frozen=True, slots=True)
class CustomerReport:
    """Reconstructed voltage of one customer, metered or not.

    Attributes
    ----------
    customer
        Id as in the feeder's files.
    v_volt_estimated, v_volt_std, model_only
        As in `MeterReport`.
    """

    customer: str
    v_volt_estimated: float | None
    v_volt_std: float | None
    model_only: bool = False


@dataclass(frozen=True, slots=True)
class InverterReport:
    """One droop inverter at one tick.

    Attributes
    ----------
    customer, bus
        Ids as in the feeder's files.
    meter
        The customer's meter; None without one.
    judged
        True if the estimator monitors inverters, the data suffice for this one, and its values are not model
        only.
    suspect
        True if the verdict names it as manipulated.
    q_kvar_estimated
        Injected reactive power, kvar.
    attack_kvar_estimated
        Injection beyond its droop curve, kvar; 0 if not suspect, None if not monitored.
    model_only
        As in `MeterReport`.
    """

    customer: str
    bus: str
    meter: str | None
    judged: bool
    suspect: bool
    q_kvar_estimated: float | None
    attack_kvar_estimated: float | None
    model_only: bool = False


@dataclass(frozen=True, slots=True)
class ExplanationReport:
    """One of several explanations of the readings with similar probability.

    Attributes
    ----------
    meters
        Accused meters; the busbar meter is `BUSBAR`.
    inverters
        Accused inverters, by customer.
    probability
        Share among the given explanations, from 0 to 1.
    powers
        Accused reported powers, by customer.
    """

    meters: tuple[str, ...]
    inverters: tuple[str, ...]
    probability: float
    powers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FeederReport:
    """One feeder at one tick.

    Attributes
    ----------
    t
        Unix time of the tick, s.
    verdict, cause, reason
        The decision, its code for programs, and its sentence for operators.
    max_attacked
        The number M of manipulated meters up to which the verdict is guaranteed.
    meters
        One entry per meter, in the order of the feeder's file.
    bus_v_volt
        (bus id, reconstructed voltage in V or None) of every bus, the busbar first; in three phases the
        voltage of the phase furthest from nominal.
    silent
        (meter id, seconds since its last usable reading, infinity without any) of the meters that have been
        silent for longer than the feeder's `silence_s`; the busbar meter is `BUSBAR`.
    v_min_volt, v_max_volt
        The feeder's voltage limits, V, at the nominal voltage of its busbar.
    customers, inverters
        One entry per customer, and per droop inverter, in the order of the feeder's file.
    explanations
        If several explanations fit the readings: these, the likeliest first.
    bus_phases
        In three phases, the voltage of each phase of every bus, V; None for an absent phase.
    busbar
        The busbar meter.
    learning
        Learning of the meters' fixed errors; None at a tick without a monitor.
    revision
        Digest of the feeder's tables, limits and times, see `feeder_info.revision`.
    skipped
        Number of skipped ticks directly before this one.
    model_only
        True if no value of the feeder uses a reading of this tick, see `voltages.ReferenceVoltages`.
    model_only_phases
        In three phases, the phases without such a reading.
    bus_model_only
        For each entry of `bus_v_volt`, True if it is model only; empty: none is.
    t_measured
        Newest tick with a reading that a value uses, Unix s; None without such a tick since the start.
    data_error
        Error of the feeder's files that explains accused meters, or None.
    """

    feeder: str
    t: float
    verdict: Decision
    reason: str
    cause: Cause
    max_attacked: int
    meters: tuple[MeterReport, ...]
    bus_v_volt: tuple[tuple[str, float | None], ...]
    silent: tuple[tuple[str, float], ...]
    v_min_volt: float
    v_max_volt: float
    customers: tuple[CustomerReport, ...] = ()
    inverters: tuple[InverterReport, ...] = ()
    explanations: tuple[ExplanationReport, ...] = ()
    bus_phases: tuple[tuple[float | None, ...], ...] = ()
    busbar: BusbarReport = UNKNOWN_BUSBAR
    learning: LearningReport | None = LearningReport()
    revision: str = ""
    skipped: int = 0
    model_only: bool = False
    model_only_phases: tuple[str, ...] = ()
    bus_model_only: tuple[bool, ...] = ()
    t_measured: float | None = None
    data_error: DataErrorReport | None = None

    @property
    def suspects(self) -> tuple[str, ...]:
        """Meters that the verdict names as manipulated, the busbar meter as `BUSBAR`."""
        named = tuple(meter.meter for meter in self.meters if meter.suspect)
        return (*named, BUSBAR) if self.busbar.suspect else named


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
    """Return the report of a tick, its estimate and its verdict.

    Parameters
    ----------
    max_attacked
        M of the design.
    """
    v, std = volts(site.customer_volt, estimate.v2), std_volts(site, estimate)
    at = site.meters
    # relative to nominal, behind taps too
    v2 = estimate.v2 * (site.customer_volt / site.customer_nominal) ** 2
    numbers = np.column_stack((verdict.score, verdict.threshold, v[at], std[at], v2[at]))
    attack = attack_volts(site, tick, verdict)
    rests_on = grounds(site, tick, estimate, verdict)
    alone = rests_on.model_only(site)
    kinds = verdict.kinds or (None,) * len(site.meter_ids)
    allowed, offsets = _limits(site), tick.clock_offset or (None,) * len(site.meter_ids)
    meters = []
    for k, (meter, reading) in enumerate(zip(site.meter_ids, tick.readings, strict=True)):
        score, threshold, v_volt, v_std, v2_pu = (finite(value) for value in numbers[k])
        meters.append(
            MeterReport(
                meter=meter,
                bus=site.tables.customers[int(site.meters[k])].bus,
                seen=reading is not None,
                suspect=bool(verdict.suspects[k]),
                score=score,
                threshold=threshold,
                v_volt_reported=None if reading is None else reading.v_volt,
                v_volt_estimated=v_volt,
                v_volt_std=v_std,
                v2_pu_estimated=v2_pu,
                attack_volt_estimated=finite(attack[k]),
                kind=None if kinds[k] is None else str(kinds[k]),
                phase=_phase(site, k),
                v_min_volt=allowed[k][0],
                v_max_volt=allowed[k][1],
                model_only=bool(alone[at[k]]),
                clock_offset_s=offsets[k],
            )
        )
    one, phases, buses_alone = bus_volts(site, estimate.v2_bus, rests_on.measured)
    buses = zip(site.spanning.buses, one, strict=True)
    return _whole(
        site,
        tick,
        max_attacked,
        verdict=(verdict.decision, verdict.cause, reason_of(site, tick, max_attacked, verdict)),
        meters=tuple(meters),
        buses=tuple((bus, finite(v)) for bus, v in buses),
        customers=tuple(
            map(CustomerReport, site.feeder.customers, map(finite, v), map(finite, std), alone.tolist())
        ),
        inverters=_inverters(site, estimate, verdict, alone),
        explanations=_explanations(site, verdict),
        bus_phases=tuple(tuple(map(finite, row)) for row in phases) if phases.size else (),
        busbar=busbar_report(site, tick, estimate, verdict),
        rests_on=rests_on,
        buses_alone=tuple(buses_alone.tolist()),
    )


def blind(site: Site, tick: Tick, max_attacked: int, cause: Cause, reason: str) -> FeederReport:
    """Return the report of a tick without a monitor: undecided, with the reported voltages.

    Parameters
    ----------
    site, tick, max_attacked
        As in `build`.
    cause, reason
        Reason of the missing estimate, as code and as sentence.
    """
    allowed, offsets = _limits(site), tick.clock_offset or (None,) * len(site.meter_ids)
    rests_on = grounds(site, tick)
    alone = rests_on.model_only(site)
    meters = tuple(
        MeterReport(
            meter=meter,
            bus=site.tables.customers[int(site.meters[k])].bus,
            seen=reading is not None,
            suspect=False,
            score=None,
            threshold=None,
            v_volt_reported=None if reading is None else reading.v_volt,
            v_volt_estimated=None,
            v_volt_std=None,
            v2_pu_estimated=None,
            attack_volt_estimated=None,
            phase=_phase(site, k),
            v_min_volt=allowed[k][0],
            v_max_volt=allowed[k][1],
            model_only=bool(alone[site.meters[k]]),
            clock_offset_s=offsets[k],
        )
        for k, (meter, reading) in enumerate(zip(site.meter_ids, tick.readings, strict=True))
    )
    whole = _whole(
        site,
        tick,
        max_attacked,
        verdict=(Decision.UNDECIDED, cause, reason),
        meters=meters,
        buses=tuple((bus, None) for bus in site.spanning.buses),
        customers=tuple(
            CustomerReport(customer, None, None, model)
            for customer, model in zip(site.feeder.customers, alone.tolist(), strict=True)
        ),
        inverters=_inverters(site, None, None, alone),
        explanations=(),
        busbar=busbar_report(site, tick),
        rests_on=rests_on,
    )
    return replace(whole, learning=None)


def _limits(site: Site) -> list[tuple[float, float]]:
    """Lowest and highest permitted voltage at every meter, V."""
    limits = site.tables.meta.limits
    return [
        (limits.v_min_pu * volt, limits.v_max_pu * volt)
        for volt in site.customer_nominal[site.meters].tolist()
    ]


def _phase(site: Site, meter: int) -> str | None:
    phases = site.tables.customers[int(site.meters[meter])].phases
    return phases if len(phases) == 1 else None


def _inverters(
    site: Site, estimate: Estimate | None, verdict: Verdict | None, model_only: Bools
) -> tuple[InverterReport, ...]:
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
            InverterReport(row.customer, row.bus, meter, judged, named, finite(x), finite(wrong), alone)
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


def _whole(
    site: Site,
    tick: Tick,
    max_attacked: int,
    *,
    verdict: tuple[Decision, Cause, str],
    meters: tuple[MeterReport, ...],
    buses: tuple[tuple[str, float | None], ...],
    customers: tuple[CustomerReport, ...],
    inverters: tuple[InverterReport, ...],
    explanations: tuple[ExplanationReport, ...],
    busbar: BusbarReport,
    rests_on: ReferenceVoltages,
    bus_phases: tuple[tuple[float | None, ...], ...] = (),
    buses_alone: tuple[bool, ...] = (),
) -> FeederReport:
    limits, nominal = site.tables.meta.limits, site.tables.meta.voltage_volt
    decision, cause, reason = verdict
    measured = rests_on.measured.tolist()
    return FeederReport(
        feeder=site.feeder.name,
        t=tick.t,
        verdict=decision,
        reason=f"{reason.removesuffix('.')}. {skipped_in_words(tick.skipped)}" if tick.skipped else reason,
        cause=cause,
        max_attacked=max_attacked,
        meters=meters,
        bus_v_volt=buses,
        silent=tuple((BUSBAR if meter is None else meter, seconds) for meter, seconds in tick.silent),
        v_min_volt=limits.v_min_pu * nominal,
        v_max_volt=limits.v_max_pu * nominal,
        customers=customers,
        inverters=inverters,
        explanations=explanations,
        bus_phases=bus_phases,
        busbar=busbar,
        skipped=tick.skipped,
        model_only=not any(measured),
        model_only_phases=tuple(
            phase for phase, one in zip(busbar_phases(site), measured, strict=True) if phase and not one
        ),
        bus_model_only=buses_alone or (not any(measured),) * len(buses),
    )


def skipped_in_words(count: int) -> str:
    """Return the sentence about skipped ticks.

    Parameters
    ----------
    count
        Number of skipped ticks, 1 or more.
    """
    return "The tick before was skipped." if count == 1 else f"The {count} ticks before were skipped."


def to_json(report: FeederReport) -> dict[str, Any]:
    """Return the report as the JSON object of REST's `state` and of the zenoh key `estimate`.

    Returns
    -------
    dict
        Plain JSON types only; absent numbers are null, never NaN.
    """
    return {
        "feeder": report.feeder,
        "revision": report.revision,
        "t": report.t,
        "verdict": str(report.verdict),
        "reason": report.reason,
        "cause": str(report.cause),
        "max_attacked": report.max_attacked,
        "skipped": report.skipped,
        "model_only": report.model_only,
        "model_only_phases": list(report.model_only_phases),
        "t_measured": report.t_measured,
        "meters": [
            {
                "meter": m.meter,
                "bus": m.bus,
                "seen": m.seen,
                "suspect": m.suspect,
                "score": m.score,
                "threshold": m.threshold,
                "v_volt_reported": m.v_volt_reported,
                "v_volt_estimated": m.v_volt_estimated,
                "v_volt_std": m.v_volt_std,
                "v2_pu_estimated": m.v2_pu_estimated,
                "attack_volt_estimated": m.attack_volt_estimated,
                "kind": m.kind,
                "phase": m.phase,
                "v_min_volt": m.limits(report)[0],
                "v_max_volt": m.limits(report)[1],
                "learning_state": m.learning_state,
                "learning_reason": m.learning_reason,
                "model_only": m.model_only,
                "clock_offset_s": m.clock_offset_s,
            }
            for m in report.meters
        ],
        "busbar": report.busbar.to_json(),
        "customers": [
            {
                "customer": c.customer,
                "v_volt_estimated": c.v_volt_estimated,
                "v_volt_std": c.v_volt_std,
                "model_only": c.model_only,
            }
            for c in report.customers
        ],
        "inverters": [
            {
                "customer": i.customer,
                "bus": i.bus,
                "meter": i.meter,
                "judged": i.judged,
                "suspect": i.suspect,
                "q_kvar_estimated": i.q_kvar_estimated,
                "attack_kvar_estimated": i.attack_kvar_estimated,
                "model_only": i.model_only,
            }
            for i in report.inverters
        ],
        "explanations": [
            {name: list(getattr(e, name)) for name in ("meters", "inverters", "powers")}
            | {"probability": e.probability}
            for e in report.explanations
        ],
        "buses": [
            {
                "bus": bus,
                "v_volt": v,
                "v_phases": None if phases is None else list(phases),
                "model_only": bool(alone),
            }
            for (bus, v), phases, alone in zip_longest(
                report.bus_v_volt, report.bus_phases, report.bus_model_only
            )
        ],
        "data_error": None if report.data_error is None else report.data_error.to_json(),
        "silent": [{"meter": meter, "seconds": finite(seconds)} for meter, seconds in report.silent],
        "v_min_volt": report.v_min_volt,
        "v_max_volt": report.v_max_volt,
    }
