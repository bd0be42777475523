"""What is known about one feeder at one tick, in the units and words of its operators.

The monitor speaks per unit and indices; everything after it (alarms, store, REST, zenoh, web page) speaks
of `FeederReport`, in volts and with the operator's own ids. A report is a value: it holds only tuples,
strings and floats, so it can be kept, compared, sent and read from any thread.
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
    Grounds,
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
    meter
        Id.
    reason
        Code of `gridsec.estimators.sequential.LearningReason`; None where no time was lost.
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
        Time that learning takes if every tick counts, s; None where the estimator does not learn.
    stalled
        Meters not learned after twice that time.
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
        Whether a usable reading belongs to this tick.
    suspect
        Whether the verdict names this meter as manipulated.
    score
        Absolute residual between reported and reconstructed squared voltage, squared pu; None if unseen.
    threshold
        The largest score that an honest meter can reach, squared pu; None if there is none.
    v_volt_reported
        RMS phase-to-neutral voltage that the meter claims, V; None if unseen.
    v_volt_estimated
        Reconstructed voltage at the meter's connection point, V; None if there is no estimate.
    v_volt_std
        Standard deviation of the reconstructed voltage, V. From estimators that only bound it: a third of
        the half-width of the interval that holds the true voltage, the standard deviation of the normal law
        whose three-sigma interval it is.
    v2_pu_estimated
        Reconstructed squared voltage, in parts of its nominal voltage squared.
    attack_volt_estimated
        Reconstructed manipulation: reported minus reconstructed voltage, V, for suspects; 0 for others.
    kind
        What the manipulation looks like, see `gridsec.interface.Kind`; None where nobody can tell.
    phase
        The phase that it measures: a, b or c; None on a balanced feeder.
    v_min_volt, v_max_volt
        The voltage limits where it is, V: behind a transformer others than the busbar's; None: the feeder's.
    learning_state, learning_reason
        As in `LearningReport`; None where the estimator does not learn, or does not run.
    model_only
        The estimated values rest on no reading of this tick, see `voltages.Grounds`.
    clock_offset_s
        By how much its clock is ahead of those of the other meters, s; None where that is not measurable.
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
        """Return the lowest and the highest voltage allowed at the meter, V.

        Parameters
        ----------
        report
            Of its feeder.
        """
        low, high = self.v_min_volt, self.v_max_volt
        return report.v_min_volt if low is None else low, report.v_max_volt if high is None else high


@dataclass(frozen=True, slots=True)
class CustomerReport:
    """The reconstructed voltage of one customer, metered or not.

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
        Whose it is and where, ids as in the feeder's files.
    meter
        The customer's meter; None without one.
    judged
        The estimator judges inverters, the data say enough of this one, and its values are not model only.
    suspect
        Whether the verdict names it as manipulated.
    q_kvar_estimated
        Reactive power that it injects, kvar.
    attack_kvar_estimated
        The part of it that its droop curve does not ask for, kvar; 0 if it is no suspect, None if not judged.
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
    """One way to explain the readings, where several do about equally well.

    Attributes
    ----------
    meters
        Who would lie, by meter; the busbar's is `BUSBAR`.
    inverters
        Whose inverters would inject a wrong reactive power, by customer.
    probability
        Its share among the explanations given, from 0 to 1.
    powers
        Whose powers would not be what they are said to be, by customer.
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
    feeder
        Name.
    t
        Unix time of the tick, s.
    verdict, cause, reason
        The decision, why for programs, why for people.
    max_attacked
        The number M of manipulated meters up to which the verdict is guaranteed.
    meters
        One entry per meter, in the order of the feeder's file.
    bus_v_volt
        (bus id, reconstructed voltage in V or None) of every bus, the busbar first; in three phases that of
        the phase furthest from nominal.
    silent
        (meter id, seconds since its last usable reading, infinity if there never was one) of the meters
        that have been silent for longer than the feeder's `silence_s`; the busbar meter appears as
        `BUSBAR`.
    v_min_volt, v_max_volt
        The feeder's voltage limits, V, at the nominal voltage of its busbar.
    customers, inverters
        One entry per customer, and per droop inverter, in the order of the feeder's file.
    explanations
        Where several explanations fit the readings, those, the likeliest first.
    bus_phases
        In three phases, the voltage of each phase of every bus, V; None for one that it does not have.
    busbar
        The busbar's own meter.
    learning
        Learning of the meters' fixed errors; None at a tick without a monitor.
    revision
        Of which tables, limits and times of the feeder this is, see `feeder_info.revision`.
    skipped
        Number of ticks directly before this one that were not judged.
    model_only
        No value of the feeder rests on a reading of this tick, see `voltages.Grounds`.
    model_only_phases
        In three phases, those of a, b and c without such a reading.
    bus_model_only
        Of each entry of `bus_v_volt`, whether it is model only; empty: none is.
    t_measured
        Newest tick at which a value rested on a reading, Unix s; None: no such tick since the start.
    data_error
        Error of the feeder's files that explains accused meters; None: none does.
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
        """The meters that the verdict names as manipulated, the busbar's as `BUSBAR`."""
        named = tuple(meter.meter for meter in self.meters if meter.suspect)
        return (*named, BUSBAR) if self.busbar.suspect else named


def finite(value: float) -> float | None:
    """Return a number that JSON can carry: None for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


def with_learning(report: FeederReport, learning: LearningReport) -> FeederReport:
    """Return the report with the learning of its meters.

    Parameters
    ----------
    report, learning
        Of the same feeder and tick.
    """
    if not learning.states:
        return replace(report, learning=learning)
    each = zip(report.meters, learning.states, learning.reasons, strict=True)
    meters = tuple(replace(m, learning_state=state, learning_reason=reason) for m, state, reason in each)
    return replace(report, meters=meters, learning=learning)


def with_data_error(report: FeederReport, error: DataErrorReport | None) -> FeederReport:
    """Return the report with an error of the files that explains accused meters, in its reason too.

    Parameters
    ----------
    report, error
        Of the same feeder and tick.
    """
    if error is None:
        return report
    return replace(report, data_error=error, reason=f"{report.reason.removesuffix('.')}. {error.text}")


def build(site: Site, tick: Tick, max_attacked: int, estimate: Estimate, verdict: Verdict) -> FeederReport:
    """Put a tick, its estimate and its verdict into an operator's words.

    Parameters
    ----------
    site
        The feeder.
    tick
        What was known.
    max_attacked
        The number M that the monitor was designed for.
    estimate, verdict
        What the monitor made of it.
    """
    v, std = volts(site.customer_volt, estimate.v2), std_volts(site, estimate)
    at = site.meters
    v2 = estimate.v2 * (site.customer_volt / site.customer_nominal) ** 2  # of nominal, behind taps too
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
    """Return the report of a tick at which no monitor runs: undecided, with what the meters say.

    Parameters
    ----------
    site, tick, max_attacked
        As in `build`.
    cause, reason
        Why there is no estimate.
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
    """Lowest and highest voltage allowed at every meter, V."""
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
    """Every inverter; model-only values judge none, and leave an inverter named that is named."""
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
    rests_on: Grounds,
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
    """Return the sentence about ticks that were not judged.

    Parameters
    ----------
    count
        Their number, 1 or more.
    """
    return "The tick before was not judged." if count == 1 else f"The {count} ticks before were not judged."


def to_json(report: FeederReport) -> dict[str, Any]:
    """Return the report as the JSON object that REST's `state` and the zenoh key `estimate` show.

    Parameters
    ----------
    report
        The report.

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
