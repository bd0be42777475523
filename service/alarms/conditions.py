"""Conditions of a feeder at one tick: present, absent or unknown. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

from pydantic import ConfigDict, Field, JsonValue, with_config

from gridsec.interface import Cause, Decision
from service.report.data_errors import DataErrorReport
from service.report.report import (
    BUSBAR,
    ExplanationReport,
    FeederReport,
    MeterState,
    StalledMeter,
    device_name,
    finite,
    listed,
)
from service.report.tick_state import MeterCounts


class AlarmKind(StrEnum):
    """Kind of a condition."""

    METER_MANIPULATED = "meter-manipulated"
    INVERTER_MANIPULATED = "inverter-manipulated"
    VOLTAGE_LIMIT = "voltage-limit"
    DATA_LOSS = "data-loss"
    UNDECIDED = "undecided"
    LEARNING_STALLED = "learning-stalled"
    CLOCK_OFFSET = "clock-offset"
    IDENTITY_MISMATCH = "identity-mismatch"


class Severity(StrEnum):
    """Severity of a condition."""

    CRITICAL = "critical"
    MAJOR = "major"
    MINOR = "minor"


_ALWAYS: list[JsonValue] = [
    "score",
    "threshold",
    "v_volt_reported",
    "v_volt_estimated",
    "attack_volt_estimated",
]


@with_config(ConfigDict(json_schema_extra={"required": _ALWAYS}))
@dataclass(frozen=True, slots=True)
class AlarmEvidence:
    """Numbers of an alarm when it was raised, or when `data_error` was found."""

    score: float | None = None
    threshold: float | None = None
    v_volt_reported: float | None = None
    v_volt_estimated: float | None = None
    attack_volt_estimated: float | None = None
    kind: Annotated[str | None, Field(description="Attack kind of a meter.")] = None
    attack_kvar_estimated: Annotated[
        float | None, Field(description="Injection of an inverter beyond its droop curve, kvar.")
    ] = None
    explanations: tuple[ExplanationReport, ...] = ()
    learning: Annotated[tuple[StalledMeter, ...], Field(description="Meters with stalled learning.")] = ()
    silent: Annotated[tuple[str, ...], Field(description="Silent meters of an outage of the feeder.")] = ()
    data_error: Annotated[
        DataErrorReport | None,
        Field(description="Error of the feeder's files that explains the accusation as well."),
    ] = None
    customer: Annotated[str | None, Field(description="Customer of the meter.")] = None


@dataclass(frozen=True, slots=True)
class Condition:
    """One condition that is present at a tick or, with `known=False`, unknown."""

    # kind, feeder, meter: kind and subject; the meter is None for a condition of the whole feeder.
    kind: AlarmKind
    feeder: str
    meter: str | None
    # severity, evidence, reason: severity, numbers, and a sentence for the operator.
    severity: Severity
    evidence: AlarmEvidence = AlarmEvidence()
    reason: str = ""
    known: bool = True  # false: the tick gives no answer; an existing alarm is held
    # Customer of the inverter that the condition refers to, or None. `meter` is that customer's, if any.
    customer: str | None = None
    # The condition is present because readings are missing of meters that are not silent yet: it raises an
    # alarm only if it lasts for longer than `silence_s`.
    unheard: bool = False

    @property
    def subject(self) -> str | None:
        """Subject of the condition: a customer's inverter, a meter, or (None) the whole feeder."""
        return self.customer or self.meter


Key = tuple[AlarmKind, str | None]
"""Kind and subject of a condition."""


def conditions(
    report: FeederReport,
    *,
    connecting: bool = False,
    keys: Collection[Key] | None = None,
    counts: MeterCounts | None = None,
) -> list[Condition]:
    """Return the present and the unknown conditions of a feeder at one tick.

    connecting: a meter has had no reading since the start and is not silent yet.
    keys: conditions of meters that may be reported as unknown, those with an alarm or a pending one: an
        unknown condition has no other effect. None: all.
    counts: numbers of all meters, for a report with some of them. None: those of the report.

    - `meter-manipulated`: the verdict names the meter, or the busbar meter. Unknown while the verdict is
      UNDECIDED or the meter is unavailable, whatever the list of suspects; for the busbar meter also with an
      estimator that does not test it.
    - `inverter-manipulated`: the verdict names the inverter. Unknown while the verdict is UNDECIDED, or with
      an estimator that does not monitor inverters.
    - `voltage-limit`: the whole interval around the *reconstructed* voltage is outside the limits, so that a
      manipulated meter raises none. Unknown while the interval contains a limit with its middle outside, or
      while the reconstruction has no guarantee or is model only.
    - `data-loss`: a meter, or the busbar meter, is silent. Unknown while it is unavailable but not yet
      silent. If most meters are silent, there is one condition of the feeder, and those of meters are
      unknown.
    - `undecided`: there is no verdict, for a separate cause. Unknown while the monitor settles, while meters
      connect, or if `data-loss` gives the reason: every meter without a reading is silent.
    - `learning-stalled`: the fixed error of a meter is not learned after twice the expected time; one
      condition per feeder. Unknown at a tick without a monitor.
    - `clock-offset`: the clock of a meter, or of the busbar meter, is measurably ahead or behind, or its
      readings are late.

    A condition that is not in the list is absent.
    """
    if counts is None:
        counts = MeterCounts(len(report.meters), sum(not meter.seen for meter in report.meters))
    manipulated = (*_manipulated(report, keys), *_busbar(report), *_inverters(report))
    lost, undecided = _data_loss(report, keys, counts), _undecided(report, counts, connecting=connecting)
    found = [*manipulated, *lost, *undecided, *_learning(report, counts.total), *_clocks(report)]
    for meter in report.meters:
        found.extend(_voltage_limit(report, meter, keys))
    return found


def _unknown(
    report: FeederReport, kind: AlarmKind, meter: str, severity: Severity, keys: Collection[Key] | None
) -> Iterable[Condition]:
    """The unknown condition of a meter, if it is one of `keys`."""
    if keys is None or (kind, meter) in keys:
        yield Condition(kind, report.feeder, meter, severity, known=False)


def _evidence(meter: MeterState) -> AlarmEvidence:
    def number(value: float | None) -> float | None:
        return None if value is None else finite(value)

    return AlarmEvidence(
        number(meter.score),
        number(meter.threshold),
        number(meter.v_volt_reported),
        None if meter.model_only else number(meter.v_volt_estimated),
        None if meter.model_only else number(meter.attack_volt_estimated),
        meter.kind,
        customer=meter.customer,
    )


def _volt(value: float | None) -> str:
    return "an unknown voltage" if value is None else f"{value:.1f} V"


def _manipulated(report: FeederReport, keys: Collection[Key] | None) -> Iterable[Condition]:
    decided = report.verdict is not Decision.UNDECIDED
    for meter in report.meters:
        if not (decided and meter.seen):
            yield from _unknown(report, AlarmKind.METER_MANIPULATED, meter.meter, Severity.CRITICAL, keys)
            continue
        if not meter.suspect:
            continue
        evidence = _evidence(meter)
        reported, estimated = _volt(evidence.v_volt_reported), _volt(evidence.v_volt_estimated)
        beside = (
            "no other trusted meter is available"
            if meter.model_only
            else f"but the rest of the feeder implies {estimated}"
        )
        error = _data_error(report, meter.meter)
        hint = "" if error is None else f". {error.text}"
        yield Condition(
            AlarmKind.METER_MANIPULATED,
            report.feeder,
            meter.meter,
            Severity.CRITICAL,
            replace(evidence, data_error=error),
            f"reports {reported}, {beside}{hint}",
        )


def _data_error(report: FeederReport, meter: str) -> DataErrorReport | None:
    """The error of the files that explains an accused meter, or None."""
    error = report.data_error
    return error if error is not None and meter in error.meters else None


def _busbar(report: FeederReport) -> Iterable[Condition]:
    busbar = report.busbar
    known = report.verdict is not Decision.UNDECIDED and busbar.judged and busbar.seen
    if known and not busbar.suspect:
        return
    reported, estimated = _volt(busbar.v_volt_reported), _volt(busbar.v_volt_estimated)
    phase = "" if busbar.phase is None else f" in phase {busbar.phase}"
    yield Condition(
        AlarmKind.METER_MANIPULATED,
        report.feeder,
        BUSBAR,
        Severity.CRITICAL,
        AlarmEvidence(
            v_volt_reported=busbar.v_volt_reported,
            v_volt_estimated=busbar.v_volt_estimated,
            attack_volt_estimated=busbar.attack_volt_estimated,
        ),
        f"reports {reported}{phase}, but the meters of the feeder imply {estimated}",
        known,
    )


def _inverters(report: FeederReport) -> Iterable[Condition]:
    decided = report.verdict is not Decision.UNDECIDED
    for inverter in report.inverters:
        known = decided and inverter.judged
        if known and not inverter.suspect:
            continue
        kvar = inverter.attack_kvar_estimated
        much = "reactive power" if kvar is None else f"{kvar:+.1f} kvar"
        yield Condition(
            AlarmKind.INVERTER_MANIPULATED,
            report.feeder,
            inverter.meter,
            Severity.CRITICAL,
            AlarmEvidence(attack_kvar_estimated=kvar),
            f"the inverter of {inverter.customer} injects {much} beyond its droop curve",
            known,
            inverter.customer,
        )


# With these causes the reconstruction keeps the guarantee of the design: the available readings suffice, or
# the standard deviation is wide. With every other UNDECIDED its bound does not hold.
_SOUND = frozenset(
    {
        Cause.AGREEMENT,
        Cause.RESIDUALS,
        Cause.SILENT_METERS,
        Cause.CLOCK_OFFSET,
        Cause.MISSING_POWERS,
    }
)


def _voltage_limit(
    report: FeederReport, meter: MeterState, keys: Collection[Key] | None
) -> Iterable[Condition]:
    v = None if meter.model_only or meter.v_volt_estimated is None else finite(meter.v_volt_estimated)
    half_width = None if meter.v_volt_std is None else finite(3.0 * meter.v_volt_std)
    low, high = meter.v_min_volt, meter.v_max_volt
    if v is None or half_width is None or low is None or high is None or report.cause not in _SOUND:
        yield from _unknown(report, AlarmKind.VOLTAGE_LIMIT, meter.meter, Severity.MAJOR, keys)
        return
    if low <= v <= high:
        return
    surely = v + half_width < low or v - half_width > high
    side, limit = ("below", low) if v < low else ("above", high)
    yield Condition(
        AlarmKind.VOLTAGE_LIMIT,
        report.feeder,
        meter.meter,
        Severity.MAJOR,
        _evidence(meter),
        f"{v:.1f} V ± {half_width:.1f} V at the connection point, {side} the limit of {limit:.1f} V",
        surely,
    )


def _data_loss(
    report: FeederReport, keys: Collection[Key] | None, counts: MeterCounts
) -> Iterable[Condition]:
    silent = {one.meter: one.seconds for one in report.silent}
    owners = {meter.meter: meter.customer for meter in report.meters}
    most = _most_silent(report, counts)
    if most:
        yield _outage(report, most, counts.total)
    elif counts.mostly(counts.unread):
        # Most meters are unavailable, and not silent yet: an outage neither begins nor ends.
        yield Condition(AlarmKind.DATA_LOSS, report.feeder, None, Severity.MAJOR, known=False)
    unsure = [meter.meter for meter in report.meters if not meter.seen and meter.meter not in silent]
    busbar_seen = report.busbar.seen and report.cause is not Cause.NO_BUSBAR
    if not busbar_seen and BUSBAR not in silent:
        unsure.append(BUSBAR)
    if most:
        unsure.extend(silent)
        silent = {}
    for meter, seconds in silent.items():
        # Without the busbar voltage the whole feeder is not monitored.
        severity = Severity.MAJOR if meter == BUSBAR else Severity.MINOR
        yield Condition(
            AlarmKind.DATA_LOSS,
            report.feeder,
            meter,
            severity,
            AlarmEvidence(customer=owners.get(meter)),
            f"no usable reading {_length(seconds)}",
        )
    for meter in unsure:
        yield from _unknown(report, AlarmKind.DATA_LOSS, meter, Severity.MINOR, keys)


def _length(seconds: float | None) -> str:
    return "yet" if seconds is None else f"for {seconds:.0f} s"


def _most_silent(report: FeederReport, counts: MeterCounts) -> tuple[str, ...]:
    """The silent meters of customers, if these are most of them."""
    silent = tuple(one.meter for one in report.silent if one.meter != BUSBAR)
    return silent if counts.mostly(len(silent)) else ()


def _outage(report: FeederReport, silent: tuple[str, ...], meters: int) -> Condition:
    """Silence of most meters: one condition of the feeder."""
    busbar = any(one.meter == BUSBAR for one in report.silent)
    known = [one.seconds for one in report.silent if one.seconds is not None]
    also = ", and neither has the substation's" if busbar else ""
    return Condition(
        AlarmKind.DATA_LOSS,
        report.feeder,
        None,
        Severity.MAJOR,
        AlarmEvidence(silent=(*silent, *((BUSBAR,) if busbar else ()))),
        f"{len(silent)} of {meters} meters have no usable reading {_length(min(known, default=None))}{also}",
    )


def _undecided(report: FeederReport, counts: MeterCounts, *, connecting: bool) -> Iterable[Condition]:
    if report.verdict is not Decision.UNDECIDED:
        return
    unheard = report.cause in {Cause.SILENT_METERS, Cause.NO_BUSBAR}
    silent = {one.meter for one in report.silent}
    # A meter that is unavailable at every other tick is never silent; only this condition reports it.
    told = report.cause is Cause.SILENT_METERS and 0 < counts.unread == len(silent - {BUSBAR})
    told = told or (report.cause is Cause.NO_BUSBAR and BUSBAR in silent)
    told = told or (report.cause is Cause.TOO_FEW_METERS and bool(_most_silent(report, counts)))
    # Each of these meters has an alarm of kind `clock-offset`.
    told = told or report.cause is Cause.CLOCK_OFFSET
    yield Condition(
        AlarmKind.UNDECIDED,
        report.feeder,
        None,
        Severity.MAJOR,
        AlarmEvidence(explanations=report.explanations, data_error=report.data_error),
        reason=report.reason,
        known=not told
        and (not connecting or report.cause is Cause.DESIGN_INVALID)
        and report.cause is not Cause.SETTLING,
        unheard=unheard,
    )


def identity_mismatches(feeder: str, refused: Mapping[str, str]) -> list[Condition]:
    """Return the conditions of meters with readings of another identity.

    refused: the latest problem by meter, of readings that were refused for their signature or their sender.
    """
    kind, severity = AlarmKind.IDENTITY_MISMATCH, Severity.MAJOR
    return [
        Condition(
            kind, feeder, meter, severity, reason=f"readings of another identity are refused: {problem}"
        )
        for meter, problem in sorted(refused.items())
    ]


def _clocks(report: FeederReport) -> Iterable[Condition]:
    each = [(meter.meter, meter.customer, meter.clock_offset_s) for meter in report.meters]
    for meter, customer, offset in (*each, (BUSBAR, None, report.busbar.clock_offset_s)):
        if offset is None:
            continue
        side = "ahead of" if offset > 0.0 else "behind"
        late = "" if offset > 0.0 else ", or its readings come later"
        reason = f"the clock is {abs(offset):.1f} s {side} the other meters'{late}"
        evidence = AlarmEvidence(customer=customer)
        yield Condition(AlarmKind.CLOCK_OFFSET, report.feeder, meter, Severity.MINOR, evidence, reason)


def _learning(report: FeederReport, meters: int) -> Iterable[Condition]:
    learning = report.learning
    if learning is not None and not learning.stalled:
        return
    stalled = () if learning is None else learning.stalled
    count = Counter(meter.reason or "no time lost" for meter in stalled)
    why = ", ".join(f"{reason} ({number})" for reason, number in sorted(count.items()))
    owners = {meter.meter: meter.customer or "" for meter in report.meters}
    names = listed([device_name(one.meter, owners.get(one.meter, "")) for one in stalled])
    time = "" if learning is None or learning.expected_s is None else f" of {learning.expected_s:.0f} s"
    yield Condition(
        AlarmKind.LEARNING_STALLED,
        report.feeder,
        None,
        Severity.MINOR,
        AlarmEvidence(learning=stalled),
        f"{len(stalled)} of {meters} meters are not learned after twice the expected time{time}: "
        f"{names}; lost time: {why}",
        known=learning is not None,
    )
