"""The estimators that a feeder can be watched with, by the names that `feeder.toml` uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from feeders.columns import ESTIMATORS
from feeders.design_cache import bank_gains
from feeders.load import Site, from_tables, plant
from gridsec import monitor
from gridsec.arrays import Floats
from gridsec.certificates import certify
from gridsec.errors import FeederInvalid
from gridsec.feeder import lindistflow
from gridsec.gains import CircleOptions, options_for
from gridsec.lure import Lure, close_loop

__all__ = ["DIRECT", "LMI", "choose", "design", "lmi_options"]

DIRECT: Final = "exact-bank"
"""The two banks of chong2020 with direct injection and a closed-form certificate for all sets at once."""

LMI: Final = "exact-bank-lmi"
"""The same banks with gains from the corrected matrix inequality (12), one design for every set."""

RATE_PART: Final = 0.25
"""Decay asked of every observer, as a part of the rate that the feeder has by itself."""

FLOOR: Final = 0.5
"""Least sensitivity to its own meter that an observer must keep, see `gridsec.gains.CircleOptions`."""


def design(
    site: Site,
    *,
    workers: int = 1,
    where: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> monitor.MonitorDesign:
    """Design the estimator that the feeder's file names.

    Parameters
    ----------
    site
        The feeder; `[monitor] estimator`, `max_attacked` and `tick_s` of its file decide.
    workers
        Processes for designs by matrix inequality.
    where
        Folder of the cache of such designs; by default that of `feeders.design_cache.folder`.
    progress
        Called with (done, total) while such designs are made.

    Raises
    ------
    NotObservable, DesignInfeasible
        If the feeder cannot be watched as its file asks for.
    """
    settings = site.tables.meta.monitor
    watched = plant(site)
    if settings.estimator == DIRECT:
        return monitor.design(watched, max_attacked=settings.max_attacked, step_s=settings.tick_s)
    lure = close_loop(site.feeder, site.droop, site.meters)
    found = bank_gains(
        lure,
        settings.max_attacked,
        lmi_options(site, lure),
        workers=workers,
        where=where,
        progress=progress,
    )
    return monitor.design(
        watched, max_attacked=settings.max_attacked, step_s=settings.tick_s, gains=found.gains
    )


def choose(site: Site, *, estimator: str | None = None, max_attacked: int | None = None) -> Site:
    """The same feeder, watched differently from what its file says.

    Parameters
    ----------
    site
        The feeder.
    estimator
        Name of the estimator; None: as in the file.
    max_attacked
        M; None: as in the file.

    Raises
    ------
    FeederInvalid
        If there is no such estimator, or M is negative.
    """
    meta = site.tables.meta
    problems = []
    if estimator is not None and estimator not in ESTIMATORS:
        problems.append(f"estimator {estimator!r} does not exist; there are {', '.join(ESTIMATORS)}")
    if max_attacked is not None and max_attacked < 0:
        problems.append(f"max_attacked is {max_attacked}; it cannot be negative")
    if problems:
        raise FeederInvalid(problems)
    changed = replace(
        meta.monitor,
        estimator=meta.monitor.estimator if estimator is None else estimator,
        max_attacked=meta.monitor.max_attacked if max_attacked is None else max_attacked,
    )
    if changed == meta.monitor:
        return site
    return from_tables(replace(site.tables, meta=replace(meta, monitor=changed)))


def lmi_options(site: Site, lure: Lure) -> CircleOptions:
    """What the observers of a feeder are designed against: its meters' noise and its loads' uncertainty.

    Noise is what changes from reading to reading, jitter and rounding; the fixed bias inside the class is
    no noise and is dealt with by the thresholds. The load error has one column for every customer's p and
    one for its q, each with the largest error that the file allows at the customer's peak.

    Parameters
    ----------
    site
        The feeder.
    lure
        Its Lur'e system.

    References
    ----------
    docs/theory-observers.md, on designing against the load error and the noise together.
    """
    own = certify(lure).rate
    jitter, step = site.accuracy.jitter, site.accuracy.resolution
    return options_for(
        lure,
        rate=RATE_PART * own,
        noise=2.0 * np.hypot(jitter, step / np.sqrt(12.0)),
        load=_load_columns(site),
        floor=FLOOR,
    )


def _load_columns(site: Site) -> Floats:
    """Error of w for unit errors of all powers, (N, 2N): `2 R dp` and `2 X dq`."""
    model, loads = lindistflow(site.feeder), site.loads
    dp = loads.p_fraction * loads.load_peak + loads.p_floor
    dq = 0.5 * (loads.tan_max - loads.tan_min) * loads.load_peak + loads.q_floor
    return np.hstack([2.0 * model.R * dp, 2.0 * model.X * dq])
