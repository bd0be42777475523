"""What is known about one feeder at one tick, in the units and words of its operators.

The monitor speaks per unit and indices; everything after it (alarms, store, REST, zenoh, web page) speaks
of `FeederReport`, in volts and with the operator's own ids. A report is a value: it holds only tuples,
strings and floats, so it can be kept, compared, sent and read from any thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np

from feeders.load import Site, volts
from gridsec.online import Cause, Decision, Estimate, Verdict
from service.align import Tick
from service.busbar import BUSBAR, UNKNOWN_BUSBAR, BusbarReport, busbar_report
from service.reasons import reason_of
from service.voltages import attack_volts, bus_volts, std_volts

__all__ = [
    "BUSBAR",
    "BusbarReport",
    "CustomerReport",
    "ExplanationReport",
    "FeederReport",
    "InverterReport",
    "MeterReport",
    "blind",
    "build",
    "finite",
    "to_json",
]


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
        What the manipulation looks like, see `gridsec.online.Kind`; None where nobody can tell.
    phase
        The phase that it measures: a, b or c; None on a balanced feeder.
    v_min_volt, v_max_volt
        The voltage limits where it is, V: behind a transformer others than the busbar's; None: the feeder's.
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
    v_volt_estimated, v_volt_std
        As in `MeterReport`.
    """

    customer: str
    v_volt_estimated: float | None
    v_volt_std: float | None


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
        Whether the estimator can tell: the data say enough of this inverter.
    suspect
        Whether the verdict names it as manipulated.
    q_kvar_estimated
        Reactive power that it injects, kvar.
    attack_kvar_estimated
        The part of it that its droop curve does not ask for, kvar; 0 if it is no suspect, None if not judged.
    """

    customer: str
    bus: str
    meter: str | None
    judged: bool
    suspect: bool
    q_kvar_estimated: float | None
    attack_kvar_estimated: float | None


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
    revision
        Of which tables, limits and times of the feeder this is, see `describe.revision`.
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
    revision: str = ""

    @property
    def suspects(self) -> tuple[str, ...]:
        """The meters that the verdict names as manipulated, the busbar's as `BUSBAR`."""
        named = tuple(meter.meter for meter in self.meters if meter.suspect)
        return (*named, BUSBAR) if self.busbar.suspect else named


def finite(value: float) -> float | None:
    """Return a number that JSON can carry: None for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


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
    kinds = verdict.kinds or (None,) * len(site.meter_ids)
    allowed = _limits(site)
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
            )
        )
    one, phases = bus_volts(site, estimate.v2_bus)
    buses = zip(site.spanning.buses, one, strict=True)
    return _whole(
        site,
        tick,
        max_attacked,
        verdict=(verdict.decision, verdict.cause, reason_of(site, tick, max_attacked, verdict)),
        meters=tuple(meters),
        buses=tuple((bus, finite(v)) for bus, v in buses),
        customers=tuple(map(CustomerReport, site.feeder.customers, map(finite, v), map(finite, std))),
        inverters=_inverters(site, estimate, verdict),
        explanations=_explanations(site, verdict),
        bus_phases=tuple(tuple(map(finite, row)) for row in phases) if phases.size else (),
        busbar=busbar_report(site, tick, estimate, verdict),
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
    allowed = _limits(site)
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
        )
        for k, (meter, reading) in enumerate(zip(site.meter_ids, tick.readings, strict=True))
    )
    return _whole(
        site,
        tick,
        max_attacked,
        verdict=(Decision.UNDECIDED, cause, reason),
        meters=meters,
        buses=tuple((bus, None) for bus in site.spanning.buses),
        customers=tuple(CustomerReport(customer, None, None) for customer in site.feeder.customers),
        inverters=_inverters(site, None, None),
        explanations=(),
        busbar=busbar_report(site, tick),
    )


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


def _inverters(site: Site, estimate: Estimate | None, verdict: Verdict | None) -> tuple[InverterReport, ...]:
    """Every inverter; without a verdict, or one that does not judge inverters, nobody knows."""
    base = site.feeder.base_kva
    judged = verdict is not None and verdict.inverters.size > 0
    out = []
    for i, row in enumerate(site.tables.customers[int(c)] for c in site.droop.customer):
        asked = verdict is not None and judged and not (verdict.unjudged.size and verdict.unjudged[i])
        named = verdict is not None and asked and bool(verdict.inverters[i])
        wrong = base * verdict.inverter_attack[i] if verdict is not None and asked else math.nan
        x = math.nan if estimate is None else base * estimate.x[i]
        out.append(
            InverterReport(row.customer, row.bus, row.meter or None, asked, named, finite(x), finite(wrong))
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
    bus_phases: tuple[tuple[float | None, ...], ...] = (),
) -> FeederReport:
    limits, nominal = site.tables.meta.limits, site.tables.meta.voltage_volt
    decision, cause, reason = verdict
    return FeederReport(
        feeder=site.feeder.name,
        t=tick.t,
        verdict=decision,
        reason=reason,
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
    )


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
            }
            for m in report.meters
        ],
        "busbar": report.busbar.to_json(),
        "customers": [
            {"customer": c.customer, "v_volt_estimated": c.v_volt_estimated, "v_volt_std": c.v_volt_std}
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
            }
            for i in report.inverters
        ],
        "explanations": [
            {name: list(getattr(e, name)) for name in ("meters", "inverters", "powers")}
            | {"probability": e.probability}
            for e in report.explanations
        ],
        "buses": [
            {"bus": bus, "v_volt": v, "v_phases": None if phases is None else list(phases)}
            for (bus, v), phases in zip_longest(report.bus_v_volt, report.bus_phases)
        ],
        "silent": [{"meter": meter, "seconds": finite(seconds)} for meter, seconds in report.silent],
        "v_min_volt": report.v_min_volt,
        "v_max_volt": report.v_max_volt,
    }
