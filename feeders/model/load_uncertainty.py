"""How wrong the powers may be that a feeder's readings give: from its files, or from its history."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from feeders.format.columns import META_COLUMNS
from feeders.format.tables import FeederTables
from feeders.model.forecast import always
from feeders.model.site import Site, Snapshot, expected, to_frame
from gridsec.arrays import Floats
from gridsec.errors import InputInvalid, Problem
from gridsec.estimators.sequential import LoadDoubt
from gridsec.interface import Frame

TYPICAL: Final = 0.5
"""Share of its peak at which a load's errors are sized where they grow with the load."""

ALIKE: Final = 0.5
"""Share of a variance that customers have in common, of reactive power where only power factors are known,
and of all powers that nobody meters: seasons, hours and habits move all of them the same way."""

LONGEST_S: Final = next(
    column.high for column in META_COLUMNS["load"] if column.name == "correlation_s" and column.high
)
"""The longest correlation time that files can say, s."""


def load_doubt(site: Site) -> LoadDoubt:
    """What a feeder's files say about its customers' powers.

    Metered active power is as wrong as its register may be, the load's reactive power as the limits of its
    power factor allow; taken as uniform within these, and as lasting: a register and a power factor err in
    the same direction all the time. Without a meter powers are uniform in the range that `to_frame` has for
    them, so that design and frames say the same. `p_std_kw` and `q_std_kvar` say it directly, and then of
    errors that come and go within `correlation_s`; they are believed as they are: with a meter as the error
    of what it reports, without one as the distance from the middle of the range. Where powers are forecast it
    is the distance from the forecast, and that of the library where the files say nothing. With
    `p_interval_s` the powers of metered customers are off by what loads do meanwhile, too.

    Parameters
    ----------
    site
        The feeder.
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
    """A frame without readings of meters: all that is known of powers is their range.

    Intervals about forecasts are those that hold at any time.

    Parameters
    ----------
    site
        The feeder.
    """
    none = np.full(site.meters.size, np.nan)
    frame = to_frame(site, Snapshot(0.0, none, none, none, np.nan))
    return always(site.forecast, frame, np.ones(frame.p.size, dtype=np.bool_))


def _usual(half_width: Floats, std: Floats | None) -> Floats:
    """Standard deviation of what is uniform in an interval, or as stated beside it."""
    uniform = half_width / np.sqrt(3.0)
    return uniform if std is None else np.where(np.isnan(std), uniform, std)


def forecast_errors(site: Site, t: Floats, p_kw: Floats, q_kvar: Floats) -> tuple[Floats, Floats]:
    """What customers drew beyond what frames without any reading of them say, pu: a history to learn from.

    Parameters
    ----------
    site
        The feeder, with or without forecasts.
    t : (T,)
        Unix times, s.
    p_kw, q_kvar : (T, N)
        Net active import and reactive import of the loads as they were found later, kW and kvar.
    """
    none, base = np.full(site.meters.size, np.nan), site.feeder.base_kva
    frames = [to_frame(site, Snapshot(float(now), none, none, none, np.nan)) for now in t]
    p, q = (np.array([getattr(frame, name) for frame in frames]) for name in ("p", "q"))
    return p_kw / base + p, q_kvar / base + q


def tell(tables: FeederTables, doubt: LoadDoubt, base_kva: float) -> FeederTables:
    """Write into customers without a meter how far their powers are off, and into `[load]` for how long.

    Longer than files can say is as long as they can say.

    Parameters
    ----------
    tables
        The feeder's tables.
    doubt
        What was learned of all of its customers.
    base_kva
        Its 1 pu, kVA.
    """
    told = zip(tables.customers, doubt.p * base_kva, doubt.q * base_kva, strict=True)
    rows = tuple(
        row if row.meter else replace(row, p_std_kw=float(p), q_std_kvar=float(q)) for row, p, q in told
    )
    load = replace(tables.meta.load, correlation_s=min(float(doubt.time_s), LONGEST_S))
    return replace(tables, meta=replace(tables.meta, load=load), customers=rows)


def from_history(error_p: Floats, error_q: Floats, step_s: float) -> LoadDoubt:
    """Learn from a history of errors, true powers minus those that were assumed.

    The correlation time is that of a first-order process with the same correlation from sample to sample,
    the median over the customers, and no longer than the history; the common share is what the customers'
    mean varies more than independent ones would.

    Parameters
    ----------
    error_p, error_q : (T, N)
        Errors, pu, at equal intervals.
    step_s
        The interval, s.

    Raises
    ------
    ValueError
        With fewer than three samples, or values that are not finite.
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
# Correlations outside these are no first-order process that a history could show.
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
