"""Voltages of reports: meters, buses, phases, and the busbar meter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field

from feeders.model.site import Site, Snapshot, volts
from gridsec.arrays import Bools, Floats
from gridsec.grid import Feeder
from gridsec.interface import Cause, Estimate, Verdict
from service.ingest.align import Tick

Phase: TypeAlias = Literal["a", "b", "c"]


def snapshot(site: Site, tick: Tick) -> Snapshot:
    """Return a tick's readings in the form of `feeders.model.site.to_frame`."""
    nan = math.nan
    rows = [
        (nan, nan, nan, nan, nan) if r is None else (r.v_volt, r.p_kw, r.q_kvar, r.t, r.t_power)
        for r in tick.readings
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 5)
    age = columns[:, 3] - columns[:, 4]
    return Snapshot(
        t=tick.t,
        v_volt=columns[:, 0].copy(),
        p_kw=columns[:, 1].copy(),
        q_kvar=columns[:, 2].copy(),
        v0_volt=busbar_volt(site, tick),
        p_age_s=None if np.isnan(age).all() else age,
        clock_offset_s=np.array(tick.clock_offset, dtype=np.float64) if any(tick.clock_offset) else None,
        busbar_offset_s=nan if tick.busbar_offset is None else tick.busbar_offset,
    )


def busbar_volt(site: Site, tick: Tick) -> Floats | float:
    """Return the reading of the busbar meter, V: one voltage, or in three phases (3,); NaN without one."""
    if tick.busbar is None:
        return math.nan
    phases = tick.busbar.v_phases
    # A balanced feeder has one voltage, also if single phases are not measured.
    one = phases is None or site.feeder.busbar_phases == 1
    return tick.busbar.v_volt if one else np.array(phases)


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
        return np.asarray(~(site.feeder.busbar_incidence() * self.measured).any(axis=1), dtype=np.bool_)


def grounds(
    site: Site, tick: Tick, estimate: Estimate | None = None, verdict: Verdict | None = None
) -> ReferenceVoltages:
    """Return the readings that the values of a tick use. Without a monitor each reading counts."""
    used = np.array([reading is not None for reading in tick.readings], dtype=np.bool_)
    busbar = np.isfinite(np.broadcast_to(busbar_volt(site, tick), len(busbar_phases(site))))
    if estimate is not None:
        used &= estimate.trusted
    if verdict is not None:
        busbar = busbar & (verdict.cause is not Cause.NO_BUSBAR)
        busbar = busbar & ~verdict.busbar if verdict.busbar.size else busbar
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
    reported = np.array([math.nan if r is None else r.v_volt for r in tick.readings], dtype=np.float64)
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
    return np.broadcast_to(busbar_volt(site, tick), len(busbar_phases(site)))


def _attack_volts(site: Site, reported: Floats, verdict: Verdict) -> Floats:
    """Excess of the busbar meter in phases named as manipulated, V, (b,)."""
    base = site.base_volt[site.feeder.busbar_places()]
    return excess_volts(base, reported, verdict.busbar_attack, verdict.busbar)
