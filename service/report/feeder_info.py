"""Feeders as JSON: the summary in the list, and the detail with tree and tables."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from feeders.format.tables import to_json
from feeders.model.site import Site
from service.report.report import BUSBAR, FeederReport


@dataclass(frozen=True, slots=True)
class Ownership:
    """Worker that monitors a feeder, and the epoch of its lease."""

    worker: str
    epoch: int


class FeederStatus(StrEnum):
    """Status of a feeder in the list of feeders, the worst first."""

    ATTACKED = "attacked"
    UNDECIDED = "undecided"
    NO_DATA = "no-data"  # no verdict from present readings: none yet, model only, or stale
    NOT_MONITORED = "not-monitored"  # the feeder or its monitor failed
    CLEAN = "clean"


UNWATCHED = frozenset({"overload", "no-owner"})
"""Causes of feeders without an evaluation of their readings: undecided, and not a lack of data."""


SHED_TICK_S = 15.0
"""Interval of the ticks of a feeder that is displayed as shed, s; one takes as long as one with readings."""


def rare_ticks(tick_s: float) -> int:
    """Return the number of tick intervals, `tick_s` each, from one tick of a shed feeder to the next."""
    return max(1, int(SHED_TICK_S / tick_s))


def patience_shed_s(patience_s: float, tick_s: float) -> float:
    """Return the age beyond which a state of a shed feeder is stale, s; `patience_s` is that of others."""
    return patience_s + (rare_ticks(tick_s) - 1) * tick_s


def status_of(now: Mapping[str, Any], patience_s: float | None, *, failed: bool = False) -> FeederStatus:
    """Return the status of a feeder: its displayed verdict, unless no value uses a present reading.

    now: numbers of the latest tick, as of `numbers`; empty before the first one. A tick with an `age_s` above
    `patience_s`, s, is stale.
    """
    if failed:
        return FeederStatus.NOT_MONITORED
    if now.get("cause") in UNWATCHED:
        return FeederStatus.UNDECIDED
    age_s = now.get("age_s")
    stale = age_s is not None and patience_s is not None and age_s > patience_s
    if not now or now["model_only"] or stale:
        return FeederStatus.NO_DATA
    return FeederStatus(str(now["displayed_verdict"] or now["verdict"]))


def numbers(report: FeederReport, age_s: float) -> dict[str, Any]:
    """Return the numbers of a report in the list of feeders; `TickState.summary` needs no report for them."""
    shown = report.displayed
    return {
        "t": report.t,
        "verdict": report.verdict,
        "age_s": age_s,
        "model_only": report.model_only,
        "since": report.since,
        "displayed_verdict": None if shown is None else shown.verdict,
        "displayed_since": None if shown is None else shown.since,
        "cause": report.cause if shown is None else shown.cause,
        "t_measured": report.t_measured,
        "meters": len(report.meters),
        "suspects": len(report.suspects) + sum(inverter.suspect for inverter in report.inverters),
        "silent": sum(one.meter != BUSBAR for one in report.silent),
    }


def summary(site: Site) -> dict[str, Any]:
    """Return a feeder's entry in the list of feeders, as far as its files determine it."""
    settings = site.tables.meta.monitor
    return {
        "name": site.feeder.name,
        "title": site.tables.meta.title,
        "customers": len(site.feeder.customers),
        "meters": len(site.meter_ids),
        "inverters": int(site.droop.customer.size),
        "estimator": settings.estimator,
        "max_attacked_stated": settings.max_attacked,
        "tick_s": settings.tick_s,
    }


def revision(fields: Mapping[str, Any]) -> str:
    """Return a digest of a feeder's published properties; it changes with any of them."""
    return hashlib.sha256(json.dumps(fields, sort_keys=True, default=str).encode()).hexdigest()[:32]


def detail(site: Site, patience_s: float) -> dict[str, Any]:
    """Return all properties of a feeder's files: limits, tree with positions, tables, and their `revision`.

    Reports older than `patience_s`, s, are stale; those of a shed feeder later by the interval of its ticks.
    """
    meta = site.tables.meta
    tree = site.spanning
    xy = site.xy
    fields = {
        **summary(site),
        "patience_s": patience_s,
        "patience_shed_s": patience_shed_s(patience_s, meta.monitor.tick_s),
        "v_nominal_volt": meta.voltage_volt,
        "v_min_volt": meta.limits.v_min_pu * meta.voltage_volt,
        "v_max_volt": meta.limits.v_max_pu * meta.voltage_volt,
        "layout": {
            "buses": list(tree.buses),
            "parent": [None, *(int(bus) for bus in tree.parent)],
            "ties": [(int(one), int(other)) for one, other in site.ties],
            "xy": None if xy is None else [[float(x), float(y)] for x, y in xy],
            "v_nominal_volt": site.nominal_volt[:: site.nominal_volt.size // len(tree.buses)].tolist(),
            "customers": [
                {
                    "customer": row.customer,
                    "bus": tree.buses[int(bus)],
                    "meter": row.meter or None,
                    "phase": row.phases if len(row.phases) == 1 else None,
                }
                for row, bus in zip(site.tables.customers, tree.bus, strict=True)
            ],
        },
        "tables": to_json(site.tables),
    }
    return {**fields, "revision": revision(fields)}
