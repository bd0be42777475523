"""Report of one feeder at one tick, in operators' units and terms.

The monitor uses per unit and indices; everything after it (alarms, store, REST, zenoh, web page) uses
`FeederReport`, in volts and with the ids of the feeder's files. A report is a value: it contains only tuples,
strings and floats, so that it can be stored, compared, sent and read from any thread.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final, Literal, Protocol, TypeAlias

import numpy as np
from pydantic import Field, TypeAdapter

from feeders.model.site import Site, Snapshot, volts
from gridsec.arrays import Bools, Floats, all_of, any_of
from gridsec.estimators.front import LearningReason, LearningState
from gridsec.grid import Feeder
from gridsec.interface import Cause, Decision, Estimate, Verdict
from service.ingest.align import Tick
from service.ingest.reading import P_KW, Q_KVAR, T_POWER, V_VOLT, T
from service.report.data_errors import DataErrorReport
from service.times import UtcTwins

Phase: TypeAlias = Literal["a", "b", "c"]


def snapshot(site: Site, tick: Tick) -> Snapshot:
    """Return a tick's readings in the form of `feeders.model.site.to_frame`."""
    values = tick.values[:, :-1]
    age = values[T] - values[T_POWER]
    return Snapshot(
        t=tick.t,
        v_volt=values[V_VOLT],
        p_kw=values[P_KW],
        q_kvar=values[Q_KVAR],
        v0_volt=busbar_volt(site, tick),
        p_age_s=None if all_of(np.isnan(age)) else age,
        clock_offset_s=np.array(tick.clock_offset, dtype=np.float64) if any(tick.clock_offset) else None,
        busbar_offset_s=math.nan if tick.busbar_offset is None else tick.busbar_offset,
    )


def busbar_volt(site: Site, tick: Tick) -> Floats | float:
    """Return the reading of the busbar meter, V: one voltage, or in three phases (3,); NaN without one."""
    # A balanced feeder has one voltage, also if single phases are not measured.
    one = tick.v_phases is None or site.feeder.busbar_phases == 1
    return tick.busbar_volt if one else np.array(tick.v_phases)


def busbar_phases(site: Site) -> tuple[Phase | None, ...]:
    """Return the phases of the busbar, (b,): a, b and c, or None on a balanced feeder."""
    return ("a", "b", "c") if site.feeder.busbar_phases == 3 else (None,)


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceVoltages:
    """Voltage readings of one tick that the reconstruction uses, by phase of the busbar, (b,).

    A value without such a reading in its phase is *model only*: it follows from powers, the model and the
    state of the estimator. All buses of a phase are connected, so that one reading counts for all of them.
    """

    meters: Bools  # (b,): At least one meter of the phase reports and is trusted
    busbar: Bools  # (b,): The busbar's meter reports the phase and is not named as manipulated

    @property
    def measured(self) -> Bools:
        """Phases with at least one reading, (b,)."""
        return self.meters | self.busbar

    def model_only(self, site: Site) -> Bools:
        """Return the customers with model-only values, (N,)."""
        if site.feeder.busbar_phases == 1:
            return np.full(len(site.feeder.customers), not self.measured[0])
        return np.asarray(~(site.feeder.busbar_incidence() * self.measured).any(axis=1), dtype=np.bool_)


def grounds(
    site: Site, tick: Tick, estimate: Estimate | None = None, verdict: Verdict | None = None
) -> ReferenceVoltages:
    """Return the readings that the values of a tick use. Without a monitor each reading counts."""
    used, busbar = tick.seen, np.isfinite(_reported(site, tick))
    if estimate is not None:
        used &= estimate.trusted
    if verdict is not None:
        busbar = busbar & (verdict.cause is not Cause.NO_BUSBAR)
        busbar = busbar & ~verdict.busbar if verdict.busbar.size else busbar
    if site.feeder.busbar_phases == 1:
        return ReferenceVoltages(np.array([any_of(used)]), busbar)
    of_meters = site.feeder.busbar_incidence()[site.meters[used]].any(axis=0)
    return ReferenceVoltages(np.asarray(of_meters, dtype=np.bool_), busbar)


def bus_volts(site: Site, v2_bus: Floats, measured: Bools) -> tuple[Floats, Floats, Bools]:
    """Return the voltage of every bus, V: in three phases that of the phase furthest from nominal.

    v2_bus (n,): squared voltages as in `gridsec.interface.Estimate`, pu.
    measured (b,): phases with a reading, see `ReferenceVoltages`. The other phases of a bus count only where
        it has none of these.
    Returns one (b + 1,): voltage of each bus, V.
    Returns phases (b + 1, 3) or (b + 1, 0): voltage of each of its phases, V, NaN for one that it does not
        have; nothing on a balanced feeder.
    Returns model_only (b + 1,): the first is model only.
    """
    v = volts(site.base_volt, v2_bus)
    tree = site.spanning
    if isinstance(tree, Feeder):
        return v, np.zeros((v.size, 0)), np.full(v.size, not measured[0])
    phases = np.where(tree.phases, v.reshape(-1, 3), np.nan)
    there = tree.phases & measured
    among = np.where(there.any(axis=1, keepdims=True), there, tree.phases)
    off = np.where(among, np.nan_to_num(np.abs(phases - site.nominal_volt.reshape(-1, 3)), nan=-0.5), -1.0)
    one = np.take_along_axis(phases, off.argmax(axis=1)[:, None], axis=1)[:, 0]
    return one, phases, np.asarray(~there.any(axis=1), dtype=np.bool_)


def std_volts(site: Site, estimate: Estimate) -> Floats:
    """Return the standard deviation of every customer's voltage, V, (N,): given, or from the bound."""
    half, share = (estimate.std, 1.0) if estimate.std.size else (estimate.bound, 1.0 / 3.0)
    base = site.customer_volt
    return np.asarray(0.5 * share * (volts(base, estimate.v2 + half) - volts(base, estimate.v2 - half)))


def attack_volts(site: Site, tick: Tick, verdict: Verdict) -> Floats:
    """Return the excess of every meter that is named as manipulated, (p,), see `excess_volts`."""
    reported = tick.values[V_VOLT, :-1]
    return excess_volts(site.customer_volt[site.meters], reported, verdict.attack, verdict.suspects)


def excess_volts(base: Floats, reported: Floats, attack: Floats, named: Bools) -> Floats:
    """Convert attacks on squared voltages to volts: ``sqrt(y) - sqrt(y - a)``, 0 without a name.

    base, reported (k,): 1 pu, and the reported voltages, V.
    attack (k,): excess of the squared voltages, pu.
    named (k,): True for devices named as manipulated.
    """
    true = volts(base, (reported / base) ** 2 - attack)
    return np.where(named, reported - true, 0.0)


BUSBAR = "substation"
"""Name of the busbar meter in reports, as in its zenoh key; reserved for it."""


ModelOnly: TypeAlias = Annotated[
    bool,
    Field(
        description="The estimates use no voltage reading of this tick, only powers, the model and the state "
        "of the estimator."
    ),
]
"""See `ReferenceVoltages`."""
ClockOffset: TypeAlias = Annotated[
    float | None,
    Field(description="Lead of its clock relative to the other meters, s; null if not measurable."),
]


@dataclass(frozen=True, slots=True)
class BusbarMeterState:
    """The busbar meter at the latest tick; in three phases the numbers belong to one phase."""

    # Estimators that trust this meter, or do not use it, never test it.
    judged: Annotated[
        bool,
        Field(
            description="The estimator tests this meter, and this tick has the readings for the test: of "
            "this meter and of a trusted meter in the same phase."
        ),
    ] = False
    seen: Annotated[bool, Field(description="A usable reading belongs to this tick.")] = False
    suspect: Annotated[bool, Field(description="The verdict names it as manipulated.")] = False
    phases: Annotated[
        tuple[str, ...], Field(description="Manipulated phases, a, b or c; empty on a balanced feeder.")
    ] = ()
    phase: Annotated[
        str | None,
        Field(description="Phase of the numbers, the one with the largest deviation; null if balanced."),
    ] = None
    v_volt_reported: Annotated[float | None, Field(description="Reported voltage, phase to neutral, V.")] = (
        None
    )
    # The reported voltage while the meter is trusted.
    v_volt_estimated: Annotated[
        float | None, Field(description="Reconstructed voltage of the busbar, V.")
    ] = None
    attack_volt_estimated: Annotated[
        float | None, Field(description="Mean excess of its reading, V; 0 if not suspect.")
    ] = None
    model_only: ModelOnly = False
    clock_offset_s: ClockOffset = None
    meter: Annotated[str, Field(description="Its name in alarms and explanations.")] = BUSBAR


UNKNOWN_BUSBAR = BusbarMeterState()
"""Default without any data."""


def busbar_report(
    site: Site, tick: Tick, estimate: Estimate | None = None, verdict: Verdict | None = None
) -> BusbarMeterState:
    """Return the report of the busbar meter."""
    names, reported = busbar_phases(site), _reported(site, tick)
    nothing = np.full(reported.size, math.nan)
    judges = verdict is not None and verdict.busbar.size > 0
    rests_on = grounds(site, tick, estimate, verdict)
    suspect = np.zeros(reported.size, dtype=np.bool_)
    attack, estimated = nothing, nothing
    if verdict is not None and judges:
        suspect, attack = verdict.busbar, _attack_volts(site, reported, verdict)
    if estimate is not None:
        places = site.feeder.busbar_places()
        estimated = volts(site.base_volt[places], estimate.v2_bus[places])
    k = _furthest(suspect, attack if suspect.any() else reported - estimated)

    def number(values: Floats) -> float | None:
        return float(values[k]) if math.isfinite(values[k]) else None

    return BusbarMeterState(
        judged=judges and bool((np.isfinite(reported) & rests_on.meters).any()),
        seen=math.isfinite(reported[k]),
        suspect=bool(suspect.any()),
        phases=tuple(name for name, one in zip(names, suspect, strict=True) if one and name is not None),
        phase=names[k],
        v_volt_reported=number(reported),
        v_volt_estimated=number(estimated),
        attack_volt_estimated=number(attack),
        model_only=not rests_on.measured[k],
        clock_offset_s=tick.busbar_offset,
    )


def busbar_in_words(site: Site, which: Bools) -> str:
    """Return the name of the busbar meter for a sentence, with the phases if there are several."""
    names = [name for name, one in zip(busbar_phases(site), which, strict=True) if one and name is not None]
    phases = f" (phase{'s' * (len(names) > 1)} {', '.join(names)})" if names else ""
    return f"the substation's meter{phases}"


def busbar_off(site: Site, tick: Tick, verdict: Verdict) -> str:
    """Return the deviation of a busbar meter named as manipulated, in the phase with the largest one."""
    reported = _reported(site, tick)
    attack = _attack_volts(site, reported, verdict)
    k = _furthest(verdict.busbar, attack)
    if not math.isfinite(attack[k]):
        return "has no reading at present"
    percent = 100.0 * attack[k] / max(reported[k] - attack[k], 1e-6 * reported[k])
    much = f"{abs(attack[k]):.1f} V ({abs(percent):.1f} %) {'more' if attack[k] > 0 else 'less'}"
    return f"reads {much} than the meters of the feeder imply"


def _furthest(which: Bools, off: Floats) -> int:
    """Phase with the largest deviation among the given ones, or among all if none is given."""
    among = which if which.any() else np.ones_like(which)
    return int(np.where(among, np.nan_to_num(np.abs(off), nan=-0.5), -1.0).argmax())


def _reported(site: Site, tick: Tick) -> Floats:
    """Voltages reported by the busbar meter, V, NaN without a reading, (b,)."""
    found = busbar_volt(site, tick)
    return found if isinstance(found, np.ndarray) else np.full(site.feeder.busbar_phases, found)


def _attack_volts(site: Site, reported: Floats, verdict: Verdict) -> Floats:
    """Excess of the busbar meter in phases named as manipulated, V, (b,)."""
    base = site.base_volt[site.feeder.busbar_places()]
    return excess_volts(base, reported, verdict.busbar_attack, verdict.busbar)


# --- Reasons ---


_NAMING: Final = frozenset({Cause.AMBIGUOUS, Cause.SILENT_METERS, Cause.CLOCK_OFFSET, Cause.MISSING_POWERS})
"""Causes with a sentence of the monitor that contains customers in place of meters."""
_SHOWN: Final = 5
"""Largest number of names in a list."""


def reason_of(site: Site, tick: Tick, max_attacked: int, verdict: Verdict) -> str:
    """Return the reason of a verdict, with the meters' names as on the page; the monitor uses customers."""
    suspects = np.flatnonzero(verdict.suspects).tolist()
    unseen = np.flatnonzero(~tick.seen).tolist()
    named = _listed(site, suspects)
    if verdict.cause is Cause.RESIDUALS:
        sure = _named(site, tick, verdict)
        return f"{sure} {_ways(site, verdict)}" if verdict.explanations else sure
    if verdict.cause is Cause.AMBIGUOUS and verdict.explanations:
        return _ways(site, verdict)
    if verdict.cause is Cause.TOO_MANY_SUSPECTS and suspects:
        return (
            f"{len(suspects)} meters disagree with the feeder ({named}), and at most {max_attacked} can be "
            "told apart. A wrong busbar reading, switch or line in the model looks the same."
        )
    if verdict.cause is Cause.SILENT_METERS and unseen:
        return f"No reading from {_listed(site, unseen)}."
    text = re.sub(r"([Tt])he meter of the busbar\b", r"\1he substation's meter", verdict.reason)
    return _in_ids(site, text) if verdict.cause in _NAMING else text


def _named(site: Site, tick: Tick, verdict: Verdict) -> str:
    """Devices named as manipulated, with the deviation of a busbar meter: all estimates depend on it."""
    accused = _who(site, verdict.suspects, verdict.inverters, busbar=verdict.busbar)
    if not verdict.busbar.any():
        return f"Manipulated: {accused}; further off than meter accuracy and load uncertainty allow."
    off = busbar_off(site, tick, verdict)
    if not verdict.suspects.any() and not verdict.inverters.any():
        return f"Manipulated: {accused}; it {off}."
    far = "further off than meter accuracy and load uncertainty allow"
    return f"Manipulated: {accused}; {far}. The substation's meter {off}."


def _ways(site: Site, verdict: Verdict) -> str:
    """Explanations, each with its share."""
    ways = [
        f"{_who(site, e.meters, e.inverters, e.powers, busbar=e.busbar)} ({e.probability:.0%})"
        for e in verdict.explanations
    ]
    more = f" or {len(ways) - _SHOWN} more" if len(ways) > _SHOWN else ""
    begin = "Several explanations fit" if len(ways) > 1 else "Only this explains the readings"
    return f"{begin}: {' or else '.join(ways[:_SHOWN])}{more}."


def device_name(meter: str, customer: str) -> str:
    """Return the name of a meter in sentences and on the page: its id, then its customer, `m04 · Load 3`.

    A customer with a number as its id is `customer 3`; an id that both have stands once.
    """
    owner = f"customer {customer}" if customer[:1].isdigit() else customer
    return meter if customer in {"", meter} else f"{meter} · {owner}"


def _meter_name(site: Site, k: int) -> str:
    return device_name(site.meter_ids[k], site.feeder.customers[int(site.meters[k])])


def listed(names: Sequence[str]) -> str:
    """Return the first `_SHOWN` names, and the number of the others."""
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


def _listed(site: Site, which: Sequence[int]) -> str:
    return listed([_meter_name(site, k) for k in which])


def _who(site: Site, meters: Bools, inverters: Bools, powers: Bools | None = None, *, busbar: Bools) -> str:
    """Meters by their names, other devices by their customers; at most `_SHOWN` of a kind."""
    found = np.flatnonzero(meters).tolist()
    parts = [_listed(site, found)] if found else []
    doubted = () if powers is None else np.flatnonzero(powers)
    for what, customers in (("inverter", site.droop.customer[inverters]), ("reported power", doubted)):
        names = [site.feeder.customers[int(c)] for c in customers]
        if names:
            parts.append(f"the {what}{'s' if len(names) > 1 else ''} of {listed(names)}")
    if busbar.any():
        parts.append(busbar_in_words(site, busbar))
    return " and ".join(parts) or "no device"


def _in_ids(site: Site, text: str) -> str:
    """Replace customers in a sentence by the names of their meters.

    Longer names come first, since one name may be the beginning of another. Inverters keep their customer's
    name, as in alarms.
    """
    meter_of = {
        site.feeder.customers[int(customer)]: _meter_name(site, k) for k, customer in enumerate(site.meters)
    }
    names = "|".join(re.escape(name) for name in sorted(meter_of, key=len, reverse=True))
    return re.sub(rf"(?<!\w)(?<!nverter of )(?:{names})(?!\w)", lambda found: meter_of[found[0]], text)


# --- Report ---


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
    customer: Annotated[str | None, Field(description="Its customer.")] = None


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
class DisplayedVerdict(UtcTwins):
    """Verdict after the delays of the alarms: the raw one may change at every tick."""

    verdict: Decision
    since: Annotated[float, Field(description="First tick of the time that led to it, Unix s.")]
    t: Annotated[float, Field(description="Newest tick with this verdict, Unix s.")]
    cause: Annotated[Cause, Field(description="Cause at that tick.")]
    reason: Annotated[str, Field(description="Reason at that tick.")]
    suspects: Annotated[tuple[str, ...], Field(description="Meters named at that tick, with `substation`.")]
    inverters: Annotated[
        tuple[str, ...], Field(description="Inverters named at that tick, by customer.")
    ] = ()


@dataclass(frozen=True, slots=True)
class FeederReport(UtcTwins):
    """A feeder at one tick, as REST's `state` and the zenoh key `estimate` show it."""

    feeder: str
    t: Annotated[float, Field(description="Unix time of the tick, s.")]
    verdict: Decision
    reason: str
    cause: Cause
    max_attacked: Annotated[
        int, Field(description="Number of manipulated meters that the design identifies; 0 without a design.")
    ]
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
    displayed: Annotated[
        DisplayedVerdict | None,
        Field(description="Verdict for operators: it changes only after the delays of the alarms."),
    ] = None

    @property
    def suspects(self) -> tuple[str, ...]:
        """Meters that the verdict names as manipulated, the busbar meter as `BUSBAR`."""
        named = tuple(meter.meter for meter in self.meters if meter.suspect)
        return (*named, BUSBAR) if self.busbar.suspect else named

    @property
    def row(self) -> HistoryRow:
        """Part of the meters that the history keeps."""
        values = [[getattr(meter, name) for meter in self.meters] for name in HISTORY_COLUMNS]
        flags = [[getattr(meter, name) for meter in self.meters] for name in HISTORY_FLAGS]
        return history_row(
            self.busbar,
            tuple(meter.meter for meter in self.meters),
            np.array(values, dtype=np.float64),
            np.array(flags, dtype=np.bool_),
        )


HISTORY_COLUMNS: Final = ("v_volt_reported", "v_volt_estimated", "score", "threshold", "v_volt_std")
"""Numbers of a meter that the history keeps."""
HISTORY_FLAGS: Final = ("seen", "suspect", "model_only")
"""Flags of a meter that the history keeps, in the order of their bits."""


@dataclass(frozen=True, slots=True, eq=False)
class HistoryRow:
    """Part of the meters at one tick that the history keeps. k meters, the busbar meter as `BUSBAR`, last."""

    meters: tuple[str, ...]  # (k,) ids
    values: Floats  # (5, k) `HISTORY_COLUMNS`; NaN for null
    flags: Bools  # (3, k) `HISTORY_FLAGS`


def history_row(
    busbar: BusbarMeterState, meters: tuple[str, ...], values: Floats, flags: Bools
) -> HistoryRow:
    """Return the row of meters and the busbar meter, which has no score; arguments as in `HistoryRow`."""
    own = [getattr(busbar, name, None) for name in HISTORY_COLUMNS]
    told = [getattr(busbar, name) for name in HISTORY_FLAGS]
    return HistoryRow(
        (*meters, BUSBAR),
        np.column_stack([np.where(np.isfinite(values), values, np.nan), np.array(own, dtype=np.float64)]),
        np.column_stack([flags, told]),
    )


class Judged(Protocol):
    """Tick with a verdict."""

    @property
    def t(self) -> float:
        """Unix time, s."""

    @property
    def verdict(self) -> Decision:
        """Verdict."""

    @property
    def cause(self) -> Cause:
        """Cause of the verdict."""


class Marked(Judged, Protocol):
    """Tick that the history may keep: a report, or the result that it is built from."""

    @property
    def suspects(self) -> tuple[str, ...]:
        """Meters that the verdict names as manipulated."""


class Kept(Marked, Protocol):
    """Part of a report that the history keeps."""

    @property
    def feeder(self) -> str:
        """Name of the feeder."""

    @property
    def row(self) -> HistoryRow:
        """Part of the meters."""


@dataclass(frozen=True, slots=True, eq=False)
class KeptTick:
    """Part of a report that the history keeps, as `Kept`."""

    feeder: str
    t: float
    verdict: Decision
    cause: Cause
    suspects: tuple[str, ...]
    row: HistoryRow


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
    each = zip(site.feeder.customers, _numbers(v), _numbers(std), alone.tolist(), strict=True)
    return FeederReport(
        feeder=site.feeder.name,
        t=tick.t,
        verdict=Decision.UNDECIDED if verdict is None else verdict.decision,
        reason=in_words(reason, tick),
        cause=cause,
        max_attacked=max_attacked,
        meters=meter_states(site, tick, estimate, verdict, volts_of=(v, std), model_only=alone),
        buses=_buses(site, estimate, rests_on),
        silent=tuple(Silence(BUSBAR if meter is None else meter, finite(s)) for meter, s in tick.silent),
        v_min_volt=limits.v_min_pu * nominal,
        v_max_volt=limits.v_max_pu * nominal,
        customers=tuple(CustomerState(*one) for one in each),
        inverters=inverter_states(site, estimate, verdict, alone),
        explanations=() if verdict is None else explanations(site, verdict),
        busbar=busbar_report(site, tick, estimate, verdict),
        skipped=tick.skipped,
        model_only=not any(measured),
        model_only_phases=tuple(
            phase for phase, one in zip(busbar_phases(site), measured, strict=True) if phase and not one
        ),
    )


def _numbers(values: Floats) -> list[float | None]:
    """Return numbers for JSON: None for NaN and infinities."""
    found: list[float | None] = values.tolist()
    for k in np.flatnonzero(~np.isfinite(values)):
        found[k] = None
    return found


def meter_states(
    site: Site,
    tick: Tick,
    estimate: Estimate | None,
    verdict: Verdict | None,
    *,
    volts_of: tuple[Floats, Floats],
    model_only: Bools,
    which: Bools | None = None,
) -> tuple[MeterState, ...]:
    """Return the states of meters.

    volts_of, model_only: voltage and standard deviation of every customer, V, and customers with model-only
        values.
    which (p,): these meters only; None for all.
    """
    chosen = np.arange(site.meters.size) if which is None else np.flatnonzero(which)
    at, limits = site.meters[chosen], site.tables.meta.limits
    v, std = (values[at] for values in volts_of)
    unknown = np.full(at.size, math.nan)
    kinds: Sequence[Any] = () if verdict is None else verdict.kinds
    score, threshold, attack = (unknown,) * 3
    suspects = np.zeros(at.size, dtype=np.bool_)
    if verdict is not None:
        score, threshold = verdict.score[chosen], verdict.threshold[chosen]
        attack, suspects = attack_volts(site, tick, verdict)[chosen], verdict.suspects[chosen]
    nominal = site.customer_nominal
    # Relative to nominal, behind taps too.
    ratio = (site.customer_volt / nominal) ** 2
    v2 = unknown if estimate is None else (estimate.v2 * ratio)[at]
    offsets = tick.clock_offset or (None,) * site.meters.size
    reported = tick.values[V_VOLT, :-1][chosen]
    columns = zip(
        chosen.tolist(),
        at.tolist(),
        tick.seen[chosen].tolist(),
        suspects.tolist(),
        nominal[at].tolist(),
        model_only[at].tolist(),
        zip(*map(_numbers, (score, threshold, reported, v, std, v2, attack)), strict=True),
        strict=True,
    )
    return tuple(
        MeterState(
            site.meter_ids[k],
            (row := site.tables.customers[customer]).bus,
            seen,
            suspect,
            numbers[0],
            numbers[1],
            numbers[2],
            numbers[3],
            numbers[4],
            numbers[5],
            numbers[6],
            kind=None if not kinds or kinds[k] is None else str(kinds[k]),
            phase=row.phases if len(row.phases) == 1 else None,
            v_min_volt=limits.v_min_pu * volt,
            v_max_volt=limits.v_max_pu * volt,
            model_only=alone,
            clock_offset_s=offsets[k],
            customer=row.customer,
        )
        for k, customer, seen, suspect, volt, alone, numbers in columns
    )


def _buses(site: Site, estimate: Estimate | None, rests_on: ReferenceVoltages) -> tuple[BusState, ...]:
    names = site.spanning.buses
    if estimate is None:
        alone = not rests_on.measured.any()
        return tuple(BusState(bus, None, None, alone) for bus in names)
    one, phases, model_only = bus_volts(site, estimate.v2_bus, rests_on.measured)
    each = (tuple(map(finite, row)) for row in phases) if phases.size else (None,) * len(names)
    return tuple(map(BusState, names, _numbers(one), each, model_only.tolist()))


def inverter_states(
    site: Site,
    estimate: Estimate | None,
    verdict: Verdict | None,
    model_only: Bools,
    which: Bools | None = None,
) -> tuple[InverterState, ...]:
    """Return the states of inverters, of those in `which` (m,) or of all.

    Model-only values test none, but an inverter stays named as manipulated.
    """
    base, customers = site.feeder.base_kva, site.droop.customer
    chosen = np.arange(customers.size) if which is None else np.flatnonzero(which)
    alone = model_only[customers[chosen]]
    asked = named = np.zeros(chosen.size, dtype=np.bool_)
    x = wrong = np.full(chosen.size, math.nan)
    if verdict is not None and verdict.inverters.size:
        asked = ~(verdict.unjudged[chosen] if verdict.unjudged.size else asked)
        named = asked & verdict.inverters[chosen]
        wrong = np.where(asked & ~alone, base * verdict.inverter_attack[chosen], math.nan)
    if estimate is not None:
        x = base * estimate.x[chosen]
    rows = [site.tables.customers[k] for k in customers[chosen].tolist()]
    return tuple(
        map(
            InverterState,
            [row.customer for row in rows],
            [row.bus for row in rows],
            [row.meter or None for row in rows],
            (asked & ~alone).tolist(),
            named.tolist(),
            _numbers(x),
            _numbers(wrong),
            alone.tolist(),
        )
    )


def explanations(site: Site, verdict: Verdict) -> tuple[ExplanationReport, ...]:
    """Return the explanations of a verdict."""
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


def in_words(reason: str, tick: Tick) -> str:
    """Return the reason of a verdict, with a sentence about skipped ticks."""
    return f"{reason.removesuffix('.')}. {skipped_in_words(tick.skipped)}" if tick.skipped else reason


def skipped_in_words(count: int) -> str:
    """Return the sentence about skipped ticks, 1 or more."""
    return "The tick before was skipped." if count == 1 else f"The {count} ticks before were skipped."
