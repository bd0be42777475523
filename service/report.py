"""What is known about one feeder at one tick, in the units and words of its operators.

The monitor speaks per unit and indices; everything after it (alarms, store, REST, zenoh, web page) speaks
of `FeederReport`, in volts and with the operator's own ids. A report is a value: it holds only tuples,
strings and floats, so it can be kept, compared, sent and read from any thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from gridsec.online import Cause, Decision

BUSBAR = "substation"
"""The name under which the busbar meter is reported among the silent ones (as in its zenoh key)."""


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
        A third of the half-width of the interval that holds the true voltage, V: the interval is hard, so
        this is the standard deviation of the normal law whose three-sigma interval it is.
    v2_pu_estimated
        Reconstructed squared voltage, pu.
    attack_volt_estimated
        Reconstructed manipulation: reported minus reconstructed voltage, V, for suspects; 0 for others.
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
        (bus id, reconstructed voltage in V or None) of every bus, the busbar first.
    silent
        (meter id, seconds since its last usable reading) of the meters that have been silent for longer
        than the feeder's `silence_s`; the busbar meter appears as `BUSBAR`.
    v_min_volt, v_max_volt
        The feeder's voltage limits, V.
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


def finite(value: float) -> float | None:
    """Return a number that JSON can carry: None for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


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
            }
            for m in report.meters
        ],
        "buses": [{"bus": bus, "v_volt": v} for bus, v in report.bus_v_volt],
        "silent": [{"meter": meter, "seconds": seconds} for meter, seconds in report.silent],
        "v_min_volt": report.v_min_volt,
        "v_max_volt": report.v_max_volt,
    }
