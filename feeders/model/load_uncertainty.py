"""Load uncertainty of a feeder, from its files or from a history."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from feeders.format.columns import META_COLUMNS, Number
from feeders.format.tables import FeederTables
from feeders.model.forecast import always
from feeders.model.site import Site, Snapshot, expected, to_frame
from gridsec.arrays import Floats
from gridsec.errors import InputInvalid, Problem
from gridsec.estimators.sequential import LoadDoubt
from gridsec.interface import Frame

TYPICAL: Final = 0.5
"""Share of the peak at which errors that grow with the load are sized."""

ALIKE: Final = 0.5
"""Common share of the customers' variance: of reactive power known by power factors, and of unmetered powers.

Seasons, hours and habits move these together.
"""

LONGEST_S: Final = next(
    column.high
    for column in META_COLUMNS["load"]
    if column.name == "correlation_s" and isinstance(column, Number) and column.high
)
"""Longest correlation time of the format, s."""


def load_doubt(site: Site) -> LoadDoubt:
    """Standard deviations of the customers' powers by a feeder's files.

    Metered active power has the error of its register, the load's reactive power that of its power factor
    limits. Both are uniform within these limits and lasting: a register and a power factor err in one
    direction all the time. Unmetered powers are uniform in the range of `to_frame`, so that design and frames
    agree. `p_std_kw` and `q_std_kvar` take precedence; their errors have the correlation time
    `correlation_s`. They describe a metered customer's reported power, and the distance of an unmetered one
    from the middle of its range. With forecasts it is the distance from the forecast, by default that of the
    library. With `p_interval_s` the metered powers also have the load change over that interval.
    """
    rows, loads, base = site.tables.customers, site.loads, site.feeder.base_kva
    typical = TYPICAL * loads.load_peak
    p = (loads.p_fraction * np.maximum(typical, loads.pv_peak) + loads.p_floor) / np.sqrt(3.0)
    q = (0.5 * (loads.tan_max - loads.tan_min) * typical + loads.q_floor) / np.sqrt(3.0)
    frame, unmetered = unread(site), np.ones(p.size, dtype=np.bool_)
    unmetered[site.meters] = False
    p = np.where(unmetered, _usual(frame.p_error, frame.p_std), p)
    q = np.where(unmetered, _usual(frame.q_error, frame.q_std), q)
    told_p = np.array([np.nan if row.p_std_kw is None else row.p_std_kw for row in rows])
    told_q = np.array([np.nan if row.q_std_kvar is None else row.q_std_kvar for row in rows])
    by_limits = bool(np.isnan(told_q).any() or np.isnan(told_p).any())
    open_ = unmetered & np.isnan(told_p)
    changed = np.where(unmetered, 0.0, expected(site))
    return LoadDoubt(
        p=np.hypot(np.where(np.isnan(told_p), p, told_p / base), changed),
        q=np.hypot(np.where(np.isnan(told_q), q, told_q / base), loads.tan_max * changed),
        time_s=site.tables.meta.load.correlation_s,
        common_q=ALIKE if np.isnan(told_q[site.meters]).any() else 0.0,
        lasting=1.0 if by_limits else 0.0,
        together=np.where(open_, ALIKE, 0.0) if open_.any() else 0.0,
    )


def unread(site: Site) -> Frame:
    """Frame without readings of meters: powers have their range only.

    Intervals about forecasts hold at any time.
    """
    none = np.full(site.meters.size, np.nan)
    frame = to_frame(site, Snapshot(0.0, none, none, none, np.nan))
    return always(site.forecast, frame, np.ones(frame.p.size, dtype=np.bool_))


def _usual(half_width: Floats, std: Floats | None) -> Floats:
    """Standard deviation of a uniform error in an interval, or the stated one."""
    uniform = half_width / np.sqrt(3.0)
    return uniform if std is None else np.where(np.isnan(std), uniform, std)


def forecast_errors(site: Site, t: Floats, p_kw: Floats, q_kvar: Floats) -> tuple[Floats, Floats]:
    """Deviations of true powers from frames without readings, pu, (T, N): a history for `from_history`.

    `t` (T,) are Unix times, s; `p_kw` and `q_kvar` (T, N) the true net active import and the loads' reactive
    import.
    """
    none, base = np.full(site.meters.size, np.nan), site.feeder.base_kva
    frames = [to_frame(site, Snapshot(float(now), none, none, none, np.nan)) for now in t]
    p, q = (np.array([getattr(frame, name) for frame in frames]) for name in ("p", "q"))
    return p_kw / base + p, q_kvar / base + q


def tell(tables: FeederTables, doubt: LoadDoubt, base_kva: float) -> FeederTables:
    """Write standard deviations to customers without a meter, and the correlation time to `[load]`.

    The correlation time is at most LONGEST_S; `base_kva` is 1 pu of `doubt`.
    """
    told = zip(tables.customers, doubt.p * base_kva, doubt.q * base_kva, strict=True)
    rows = tuple(
        row if row.meter else replace(row, p_std_kw=float(p), q_std_kvar=float(q)) for row, p, q in told
    )
    load = replace(tables.meta.load, correlation_s=min(float(doubt.time_s), LONGEST_S))
    return replace(tables, meta=replace(tables.meta, load=load), customers=rows)


def from_history(error_p: Floats, error_q: Floats, step_s: float) -> LoadDoubt:
    """Estimate the load uncertainty from a history (T, N) of errors, pu: true powers less the assumed ones.

    The correlation time is that of a first-order process with the same correlation between successive
    samples: the median over the customers, at most the length of the history. The common share follows from
    the variance of the customers' mean beyond that of independent errors.

    Raises ValueError with fewer than three samples, or values that are not finite.
    """
    if error_p.ndim != 2 or error_p.shape != error_q.shape or len(error_p) < _FEWEST:
        raise InputInvalid(
            [
                Problem(
                    "shape", f"errors of shapes {error_p.shape} and {error_q.shape}; need (T, N) with T >= 3"
                )
            ]
        )
    if not (np.isfinite(error_p).all() and np.isfinite(error_q).all() and step_s > 0):
        raise InputInvalid(
            [Problem("not-finite", "errors and their interval must be finite, and the interval positive")]
        )
    return LoadDoubt(
        p=np.sqrt(np.mean(error_p**2, axis=0)),
        q=np.sqrt(np.mean(error_q**2, axis=0)),
        time_s=min(step_s / -float(np.log(_from_sample_to_sample(error_p))), step_s * len(error_p)),
        common_p=_common(error_p),
        common_q=_common(error_q),
    )


_FEWEST = 3
# Limits of the correlation between samples that a history can resolve.
_RANGE = (1e-3, 1.0 - 1e-6)


def _from_sample_to_sample(error: Floats) -> float:
    energy = np.sum(error[:-1] ** 2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.sum(error[1:] * error[:-1], axis=0) / energy
    share = share[np.isfinite(share)]
    return float(np.clip(np.median(share), *_RANGE)) if share.size else _RANGE[0]


def _common(error: Floats) -> float:
    """Share c of ``var(sum e / s) = N (1 - c) + N^2 c``."""
    std = np.sqrt(np.mean(error**2, axis=0))
    use = std > 0
    count = int(np.count_nonzero(use))
    if count < 2:
        return 0.0
    total = float(np.mean(np.sum(error[:, use] / std[use], axis=1) ** 2))
    return float(np.clip((total / count - 1.0) / (count - 1.0), 0.0, 1.0))
