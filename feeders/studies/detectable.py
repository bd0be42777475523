"""Which lies stay unnoticed, which are surely noticed and named, in volts; and what they do to the picture.

References
----------
docs/theory-studies.md, sections 3 and 5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from feeders.doubts import load_doubt
from feeders.load import plant
from feeders.studies.hidden import Curves
from feeders.studies.journal import Progress, Where, worked
from feeders.studies.operating import SHARE, box, volts_of_lie
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.network import model_error_bound
from gridsec.sequential import SequentialOptions
from gridsec.sequential import design as design_sequential
from gridsec.studies.lies import Box, largest_lie, worst_error
from gridsec.studies.quiet import Rule, largest_shift, named_size, rule

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["RISK", "Detectable", "detectable", "monitor_rule"]

RISK = 1e-3
"""Probability, at one moment, with which honest errors are beyond what the monitor's figures allow for."""


@dataclass(frozen=True, slots=True, eq=False)
class Detectable:
    """What `detectable` found. All sizes are voltages at nominal voltage, V.

    Attributes
    ----------
    feeder, digest
        The feeder's name, and its content.
    max_attacked
        M.
    risk
        As in `detectable`.
    meters
        One row for each meter, `alone` or in collusion with M - 1 others of the attacker's choice:

        - `hidden_alone`, `hidden`: up to this, with probability `1 - risk` at any one moment, no meter is
          beyond the sequential monitor's limits, so that nobody is named;
        - `noticed_alone`, `noticed`: beyond this somebody is, with that probability;
        - `named_alone`, `named`: beyond this, with probability `1 - 2 risk`, no explanation that believes the
          meter is a rival, and it is beyond its limit;
        - `fits_alone`, `fits`: the largest lie that fits to an honest feeder, all errors within their worst
          cases: no test without false alarms notices it for sure; every larger one is inconsistent;
        - `identified_alone`, `identified`: every larger one makes all explanations by at most M liars accuse
          this meter.
    customers
        One row for each customer: `error`, the largest error of the sequential monitor's reconstruction
        under M unnoticed liars; `error_fits`, the distance of two voltages that fit to the same readings.
    """

    feeder: str
    digest: str
    max_attacked: int
    risk: float
    meters: pd.DataFrame
    customers: pd.DataFrame

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
    journal: Where = None,
    progress: Progress | None = None,
) -> Detectable:
    """Find the smallest lies that are surely named, and the largest that stay unnoticed.

    Parameters
    ----------
    site
        The feeder.
    max_attacked
        M: how many meters lie together at most.
    share
        Share of its peak that every load draws; inverters are in their deadbands.
    risk
        Probability with which honest errors may be beyond what the monitor's figures allow for.
    journal
        File in which finished work is kept; an interrupted study goes on from it.
    progress
        Told how far it is.

    Raises
    ------
    NotObservable, DesignInfeasible
        If the feeder cannot be watched.
    ValueError
        If `max_attacked` or `risk` is out of range.
    OtherStudy
        If the journal is another study's.
    InUse
        If another process is writing it.
    """
    if not 1 <= max_attacked <= site.meters.size:
        raise ValueError(f"max_attacked is {max_attacked}; it must be from 1 to {site.meters.size}")
    if not 0.0 < risk < 1.0:
        raise ValueError(f"risk is {risk}; it must be between 0 and 1")
    subject = {
        "study": "detectable",
        "digest": site.digest,
        "max_attacked": max_attacked,
        "share": share,
        "risk": risk,
    }
    given, worst = monitor_rule(site, risk=risk, share=share), box(site, share=share, curves=Curves.DEADBAND)
    claims = _claims(site, given, share)
    tasks: list[tuple[str, Callable[[], Any]]] = [
        (f"meter|{j}", partial(_meter, site, given, worst, claims, max_attacked, j))
        for j in range(site.meters.size)
    ]
    tasks += [
        (f"customer|{i}", partial(_customer, site, given, worst, max_attacked, i))
        for i in range(site.feeder.bus.size)
    ]
    done = worked(journal, subject, tasks, progress)
    rows = {kind: [v for k, v in done.items() if k.startswith(kind)] for kind in ("meter", "customer")}
    return Detectable(
        site.feeder.name,
        site.digest,
        max_attacked,
        risk,
        pd.DataFrame(rows["meter"]),
        pd.DataFrame(rows["customer"]),
    )


def monitor_rule(site: Site, *, risk: float = RISK, share: float = SHARE) -> Rule:
    """The rule of the sequential monitor that this feeder's files ask for.

    Parameters
    ----------
    site, risk, share
        As in `detectable`.

    Raises
    ------
    NotObservable, DesignInfeasible
        If the feeder cannot be watched.
    """
    settings = site.tables.meta.monitor
    found = design_sequential(
        plant(site),
        doubt=load_doubt(site),
        step_s=settings.tick_s,
        options=SequentialOptions(alarms_per_year=settings.alarms_per_year),
    )
    p = -share * site.loads.load_peak
    q = 0.5 * (site.loads.tan_min + site.loads.tan_max) * p
    model = model_error_bound(site.feeder, p, q, 1.0)[site.meters]
    if not np.isfinite(model).all():
        raise DesignInfeasible(
            f"rule of {site.feeder.name}'s monitor", f"no power flow at {share:g} of the peak"
        )
    return rule(found, risk=risk, model=model)


def _claims(site: Site, given: Rule, share: float) -> Floats:
    """Sizes that the monitor gives false powers, as it rounds them up, pu."""
    least = given.design.options.hidden_power
    return np.asarray(np.exp2(np.ceil(np.log2(np.maximum(share * site.loads.load_peak, least)))))


def _meter(  # noqa: PLR0917  # the feeder twice, and which of its meters
    site: Site, given: Rule, worst: Box, claims: Floats, liars: int, j: int
) -> dict[str, Any]:
    unit = (np.arange(site.meters.size) == j).astype(np.float64)
    customer = int(site.meters[j])
    base = site.customer_volt[customer]
    row: dict[str, Any] = {
        "meter": site.meter_ids[j],
        "customer": site.feeder.customers[customer],
        "bus": site.feeder.buses[int(site.feeder.bus[customer])],
    }
    for suffix, count in (("_alone", 1), ("", liars)):
        hidden = largest_shift(given, unit, count, seen=False, must=j)
        noticed = largest_shift(given, unit, count, seen=True, must=j)
        named = max(named_size(given, j, count, claims=claims), noticed.bound)
        sizes = {
            "hidden": hidden.size,
            "noticed": noticed.bound,
            "named": named,
            "fits": largest_lie(worst, j, count).bound,
            "identified": largest_lie(worst, j, 2 * count).bound,
        }
        row |= {f"{name}{suffix}": float(volts_of_lie(base, size)) for name, size in sizes.items()}
    return row


def _customer(site: Site, given: Rule, worst: Box, liars: int, i: int) -> dict[str, Any]:
    bus, base = int(site.feeder.bus[i]), site.customer_volt[i]
    moved = largest_shift(given, given.weights(bus), liars, seen=True).bound
    return {
        "customer": site.feeder.customers[i],
        "bus": site.feeder.buses[bus],
        "error": float(volts_of_lie(base, moved + given.spread(bus))),
        "error_fits": float(volts_of_lie(base, worst_error(worst, i, liars).bound)),
    }
