"""Sizes of attacks that stay unnoticed, are noticed and are named, in volts; resulting estimation errors.

References: docs/theory-studies.md, sections 3 and 5.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pandas as pd

from feeders.format.tables import FeederTables
from feeders.model.site import Site, from_tables, load_doubt, plant
from feeders.studies.operating import SHARE, box, volts_of_lie
from feeders.studies.running import Here, Progress, Runner, Where, cores, run_pieces
from feeders.studies.unobservable import CurvePositions
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, Problem, raise_if_any
from gridsec.estimators.sequential import SequentialOptions
from gridsec.estimators.sequential import design as design_sequential
from gridsec.planning.collusion import Corridor, furthest
from gridsec.planning.detectability import (
    MonitorTests,
    Rule,
    Threshold,
    learned_scales,
    named_size,
    rule,
    within,
)
from gridsec.planning.stealthy_attacks import ErrorBox, largest_lie, worst_error

__all__ = ["Detectable", "detectable", "monitor_rule", "workers"]

RISK = 1e-3  # probability at one moment that honest errors exceed the monitor's limits
MANY = 50  # number of meters from which on several processes are faster than one


@dataclass(frozen=True, slots=True, eq=False)
class Detectable:
    """Result of `detectable`. All sizes are voltages at nominal voltage, V."""

    feeder: str
    digest: str
    max_attacked: int
    risk: float
    # one row for each meter, `alone` or in collusion with M - 1 others of the attacker's choice: -
    # `hidden_alone`, `hidden`: up to this size, with probability `1 - risk` at any one moment, no meter
    # exceeds the sequential monitor's limits, so that no meter is named; - `noticed_alone`, `noticed`: beyond
    # this size a meter does, with that probability; - `named_alone`, `named`: beyond this size, with
    # probability `1 - 2 risk`, no explanation that trusts the meter is a rival, and it exceeds its limit; -
    # `fits_alone`, `fits`: the largest attack that is consistent with an honest feeder, all errors within
    # their worst cases: no test without false alarms is sure to detect it; every larger one is inconsistent;
    # - `identified_alone`, `identified`: for every larger attack, all explanations by at most M meters accuse
    # this meter; - `undetected_alone`, `undetected`: once fixed errors are learned, the largest attack within
    # the limits of all tests of the monitor, the misfit's included, with a fifth of each limit left to honest
    # residuals; - `found_alone`, `found`: every larger attack exceeds a limit by more than a fifth of it; -
    # `unavoidable_alone`, `unavoidable`: no test with the same rate of false alarms detects this size, by the
    # meters of `undetected`, more often than every second time
    meters: pd.DataFrame
    # one row for each customer: `error`, the largest error of the sequential monitor's reconstruction under M
    # unnoticed manipulated meters; `error_fits`, the largest distance of two voltages that are consistent
    # with the same readings; `error_undetected`, `error_found` and `error_unavoidable`: errors by attacks
    # within the limits less a fifth, beyond the limits by a fifth, and undetected by every test, once fixed
    # errors are learned
    customers: pd.DataFrame
    share: float = SHARE

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """All tables by name."""
        return {"meters": self.meters, "customers": self.customers}


def detectable(
    site: Site,
    *,
    max_attacked: int,
    share: float = SHARE,
    risk: float = RISK,
    runner: Runner | None = None,
    journal: Where = None,
    progress: Progress | None = None,
) -> Detectable:
    """Find the smallest attacks that are named for sure, and the largest that stay unnoticed.

    Inverters are in their deadbands. The result is the same for every runner.

    max_attacked: M: largest number of manipulated meters.
    share: load relative to its peak, the same for all, 1.
    risk: probability that honest errors exceed the monitor's limits.
    Raises NotObservable, DesignInfeasible if the feeder cannot be monitored; ValueError if `max_attacked`,
        `share` or `risk` is out of range; OtherStudy if the journal is that of another study; InUse if
        another process writes the journal.
    """
    p = site.meters.size
    checks = (
        (1 <= max_attacked <= p, "out-of-range", f"max_attacked is {max_attacked}; it must be from 1 to {p}"),
        (0.0 < risk < 1.0, "out-of-range", f"risk is {risk}; it must be between 0 and 1"),
        (0.0 <= share < math.inf, "negative", f"share is {share}; it must be finite and not negative"),
    )
    raise_if_any(Problem(code, text) for right, code, text in checks if not right)
    subject = {
        "study": "detectable",
        "digest": site.digest,
        "max_attacked": max_attacked,
        "share": share,
        "risk": risk,
    }
    asked = site.tables, max_attacked, share, risk
    given = _Given.of(site, *asked[1:])  # errors of the arguments occur here, not in a worker
    here = runner is None or isinstance(runner, Here)
    rows = run_pieces(
        journal,
        subject,
        [*(f"meter|{j}" for j in range(p)), *(f"customer|{i}" for i in range(site.feeder.bus.size))],
        partial(_row, given) if here else partial(_worked, *asked),
        runner=runner or Here(),
        progress=progress,
    )
    meters, customers = pd.DataFrame(rows[:p]), pd.DataFrame(rows[p:])
    return Detectable(site.feeder.name, site.digest, max_attacked, risk, meters, customers, share)


def workers(site: Site, count: int | None) -> Runner:
    """Fastest runner for a feeder's study: `count` processes; by default all cores, from MANY meters on."""
    return Here() if count is None and site.meters.size < MANY else cores(count)


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """Common data of all rows. Corridors are by detection and number of manipulated meters."""

    site: Site
    max_attacked: int
    rule: Rule
    corridors: Mapping[tuple[bool, int], Corridor]
    worst: ErrorBox
    claims: Floats
    tests: MonitorTests
    learned: Mapping[int, Corridor]

    @classmethod
    def of(cls, site: Site, max_attacked: int, share: float, risk: float) -> _Given:
        given = monitor_rule(site, risk=risk, share=share)
        tests = MonitorTests.of(learned_scales(given.design, learned=True, model=given.model))
        return cls(
            site,
            max_attacked,
            given,
            {
                (seen, count): within(given, count, seen=seen)
                for seen in (False, True)
                for count in (1, max_attacked)
            },
            box(site, share=share, curves=CurvePositions.DEADBAND),
            _claims(site, given, share),
            tests,
            {count: tests.corridor(count) for count in (1, max_attacked)},
        )


@lru_cache(maxsize=1)
def _prepared(tables: FeederTables, max_attacked: int, share: float, risk: float) -> _Given:
    """Common data of all rows, computed once in each process."""
    return _Given.of(from_tables(tables), max_attacked, share, risk)


def _worked(tables: FeederTables, max_attacked: int, share: float, risk: float, piece: int) -> dict[str, Any]:
    """One row in any process."""
    return _row(_prepared(tables, max_attacked, share, risk), piece)


def _row(given: _Given, piece: int) -> dict[str, Any]:
    """Row of a piece: the meters first, then the customers."""
    p = given.site.meters.size
    return _meter(given, piece) if piece < p else _customer(given, piece - p)


def monitor_rule(site: Site, *, risk: float = RISK, share: float = SHARE) -> Rule:
    """Rule of the sequential monitor with the settings of the feeder's files.

    Raises NotObservable, DesignInfeasible if the feeder cannot be monitored.
    """
    settings = site.tables.meta.monitor
    found = design_sequential(
        plant(site),
        doubt=load_doubt(site),
        step_s=settings.tick_s,
        options=SequentialOptions(
            alarms_per_year=settings.alarms_per_year, commission_s=settings.commission_s
        ),
    )
    p = -share * site.loads.load_peak
    q = 0.5 * (site.loads.tan_min + site.loads.tan_max) * p
    model = site.feeder.model_error_bound(p, q, 1.0)[site.meters]
    if not np.isfinite(model).all():
        raise DesignInfeasible(
            f"rule of {site.feeder.name}'s monitor",
            f"no power flow at {share:g} of the peak",
            code="not-converged",
        )
    return rule(found, risk=risk, model=model)


def _claims(site: Site, given: Rule, share: float) -> Floats:
    """Sizes of false powers in the monitor, as it rounds them up, pu."""
    least = given.design.options.hidden_power
    return np.asarray(np.exp2(np.ceil(np.log2(np.maximum(share * site.loads.load_peak, least)))))


def _meter(given: _Given, j: int) -> dict[str, Any]:
    site = given.site
    unit = (np.arange(site.meters.size) == j).astype(np.float64)
    customer = int(site.meters[j])
    base = site.customer_volt[customer]
    row: dict[str, Any] = {
        "meter": site.meter_ids[j],
        "customer": site.feeder.customers[customer],
        "bus": site.feeder.buses[int(site.feeder.bus[customer])],
    }
    both = ("_alone", 1), ("", given.max_attacked)
    fits = {
        count: largest_lie(given.worst, j, count).bound
        for count in sorted({times * each for times in (1, 2) for _, each in both})
    }
    for suffix, count in both:
        hidden = furthest(given.corridors[False, count], unit, must=j)
        noticed = furthest(given.corridors[True, count], unit, must=j)
        named = max(named_size(given.rule, j, count, claims=given.claims), noticed.bound)
        sizes = {
            "hidden": hidden.size,
            "noticed": noticed.bound,
            "named": named,
            "fits": fits[count],
            "identified": fits[2 * count],
            **_sizes(given.tests.threshold(given.learned[count], unit, must=j)),
        }
        row |= {f"{name}{suffix}": float(volts_of_lie(base, size)) for name, size in sizes.items()}
    return row


def _customer(given: _Given, i: int) -> dict[str, Any]:
    site, liars = given.site, given.max_attacked
    bus, base = int(site.feeder.bus[i]), site.customer_volt[i]
    moved = furthest(given.corridors[True, liars], given.rule.weights(bus)).bound
    # At the busbar the monitor shows the reading of its meter.
    own = float(bus >= site.feeder.busbar_places().stop)
    learned = given.tests.threshold(given.learned[liars], own * given.tests.region.weights[bus])
    return {
        "customer": site.feeder.customers[i],
        "bus": site.feeder.buses[bus],
        "error": float(volts_of_lie(base, moved + given.rule.spread(bus))),
        "error_fits": float(volts_of_lie(base, worst_error(given.worst, i, liars).bound)),
        **{f"error_{name}": float(volts_of_lie(base, size)) for name, size in _sizes(learned).items()},
    }


def _sizes(threshold: Threshold) -> dict[str, float]:
    """Sizes of a threshold by column, squared pu."""
    return {name: getattr(threshold, name) for name in ("undetected", "found", "unavoidable")}
