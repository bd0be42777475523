"""The busbar's own meter as operators see it: what it says, and whether that is believed."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from feeders.load import Site, volts
from gridsec.arrays import Bools, Floats
from gridsec.network import busbar_places
from gridsec.online import Estimate, Verdict
from service.align import Tick
from service.voltages import busbar_phases, busbar_volt, excess_volts, grounds

BUSBAR = "substation"
"""The name under which the busbar meter is reported, as in its zenoh key. No other meter may have it."""


@dataclass(frozen=True, slots=True)
class BusbarReport:
    """The busbar's meter at one tick; in three phases the numbers are those of one of them.

    Attributes
    ----------
    judged
        The estimator judges this meter, and this tick has readings to do so: of this meter and of a trusted
        meter in the same phase. Estimators that rely on this meter, or do without, never judge it.
    seen
        Whether a usable reading of it belongs to this tick.
    suspect
        Whether the verdict names it as manipulated.
    phases
        The phases in which it does: of a, b and c; nothing on a balanced feeder.
    phase
        The phase that the numbers are of, the one that is furthest off of those in which it is suspect, or of
        all; None on a balanced feeder.
    v_volt_reported
        RMS phase-to-neutral voltage that the meter claims, V; None if unseen.
    v_volt_estimated
        Reconstructed voltage of the busbar, V: what the meter claims while that is believed. None if there is
        no estimate.
    attack_volt_estimated
        Reconstructed manipulation, V: the mean over the time scale on which it was found; 0 if it is no
        suspect.
    model_only
        `v_volt_estimated` rests on no reading of this tick, see `voltages.Grounds`.
    clock_offset_s
        By how much its clock is ahead of the other meters', s; None where that is not measurable.
    """

    judged: bool
    seen: bool
    suspect: bool
    phases: tuple[str, ...] = ()
    phase: str | None = None
    v_volt_reported: float | None = None
    v_volt_estimated: float | None = None
    attack_volt_estimated: float | None = None
    model_only: bool = False
    clock_offset_s: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return what REST's `state` shows."""
        return {"meter": BUSBAR} | asdict(self) | {"phases": list(self.phases)}


UNKNOWN_BUSBAR = BusbarReport(judged=False, seen=False, suspect=False)
"""Nothing is known of it."""


def busbar_report(
    site: Site, tick: Tick, estimate: Estimate | None = None, verdict: Verdict | None = None
) -> BusbarReport:
    """Say what is known of the busbar's meter.

    Parameters
    ----------
    site, tick
        The feeder, and what was known.
    estimate, verdict
        What the monitor made of it; None: there is none.
    """
    names, reported = busbar_phases(site), _reported(site, tick)
    nothing = np.full(reported.size, math.nan)
    judges = verdict is not None and verdict.busbar.size > 0
    rests_on = grounds(site, tick, estimate, verdict)
    suspect = np.zeros(reported.size, dtype=np.bool_)
    attack, estimated = nothing, nothing
    if verdict is not None and judges:
        suspect, attack = verdict.busbar, _attack_volts(site, reported, verdict)
    if estimate is not None:
        places = busbar_places(site.feeder)
        estimated = volts(site.base_volt[places], estimate.v2_bus[places])
    k = _furthest(suspect, attack if suspect.any() else reported - estimated)

    def number(values: Floats) -> float | None:
        return float(values[k]) if math.isfinite(values[k]) else None

    return BusbarReport(
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
    """Name the busbar's meter, with the phases in question where there are several.

    Parameters
    ----------
    site
        The feeder.
    which : (b,)
        Phases, one on a balanced feeder.
    """
    names = [name for name, one in zip(busbar_phases(site), which, strict=True) if one and name is not None]
    phases = f" (phase{'s' * (len(names) > 1)} {', '.join(names)})" if names else ""
    return f"the substation's meter{phases}"


def busbar_off(site: Site, tick: Tick, verdict: Verdict) -> str:
    """Say by how much a busbar's meter that is named is off, in the phase where most.

    Parameters
    ----------
    site, tick, verdict
        The feeder, what was known, and what the estimator says.
    """
    reported = _reported(site, tick)
    attack = _attack_volts(site, reported, verdict)
    k = _furthest(verdict.busbar, attack)
    if not math.isfinite(attack[k]):
        return "reports nothing at present"
    percent = 100.0 * attack[k] / max(reported[k] - attack[k], 1e-6 * reported[k])
    much = f"{abs(attack[k]):.1f} V ({abs(percent):.1f} %) {'more' if attack[k] > 0 else 'less'}"
    return f"reads {much} than the meters of the feeder say"


def _furthest(which: Bools, off: Floats) -> int:
    """The phase that is furthest off of some, or of all if there is none; better one that is known."""
    among = which if which.any() else np.ones_like(which)
    return int(np.where(among, np.nan_to_num(np.abs(off), nan=-0.5), -1.0).argmax())


def _reported(site: Site, tick: Tick) -> Floats:
    """What the busbar's meter says, V, NaN where nothing, (b,)."""
    return np.broadcast_to(busbar_volt(site, tick), len(busbar_phases(site)))


def _attack_volts(site: Site, reported: Floats, verdict: Verdict) -> Floats:
    """What the busbar's meter reads too much where it is named, V, (b,)."""
    base = site.base_volt[busbar_places(site.feeder)]
    return excess_volts(base, reported, verdict.busbar_attack, verdict.busbar)
