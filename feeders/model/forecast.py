"""Forecasts of unread powers: library profiles at the time of the week and year.

A forecast is the profile's mean over the season's days of that kind (working day, Saturday, Sunday) at that
time of day, times the customer's peak. It is a pure function of Unix time: a replay has the forecasts of the
service.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.model.equipment import LoadModel, indices
from feeders.profiles import PROFILE_STEP_S, Profiles, Season, library, profile
from gridsec.arrays import Bools, Floats, Ints
from gridsec.interface import Frame

if TYPE_CHECKING:
    from feeders.format.tables import FeederTables

__all__ = ["Forecast", "always", "forecast"]

DAY_S: Final = 86_400.0
WEEK_S: Final = 7.0 * DAY_S
KINDS: Final = (0, 0, 0, 0, 0, 1, 2)
"""Kind of each day from Monday: working day, Saturday, Sunday."""

FIRST_MONDAY_S: Final = 4.0 * DAY_S
"""5 January 1970, the first Monday of Unix time, s."""

_LONGEST_S: Final = 1e11
_LOAD_P, _LOAD_Q, _PV = "load_p", "load_q", "pv"


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """Forecasts of the customers' powers. N customers, pu, net import positive."""

    # (N,), standard deviations of the forecast's errors: `p_std_kw` and `q_std_kvar` of a customer without a
    # meter where its row has them, else `spread` of its profiles times its peaks
    p_std: Floats
    q_std: Floats
    # (2, N), least and largest power of the customers, of q the load alone
    p_range: Floats
    q_range: Floats
    peaks: Floats  # (3, N), peak of the load, its reactive power, and peak of the generation
    which: Ints  # (3, N), index of the curve of each of these
    weeks: Mapping[Season, Floats]  # By season: the K curves over a week, relative to the peak, (672, K)
    origin: float  # Unix time of the begin of a week, s: Monday 00:00 of local time
    season: Season | None = None  # Fixed season; None: that of the calendar

    def at(self, t: float) -> tuple[Floats, Floats]:
        """Active power and the load's reactive power (N,) at a Unix time, s; linear between samples."""
        local = float(np.clip(np.nan_to_num(t), -_LONGEST_S, _LONGEST_S)) - self.origin
        season = season_of(local + FIRST_MONDAY_S) if self.season is None else self.season
        week = self.weeks[season]
        place = (local % WEEK_S) / PROFILE_STEP_S
        here, share = int(place) % len(week), place % 1.0
        return self._powers(week[here] + share * (week[(here + 1) % len(week)] - week[here]))

    def farthest(self) -> tuple[Floats, Floats]:
        """Half-widths of intervals about p and q that contain their ranges at any time, (N,)."""
        found = [self._powers(week) for week in self.weeks.values()]
        p, q = (
            np.max([_farther(powers[k], limits).max(axis=0) for powers in found], axis=0)
            for k, limits in enumerate((self.p_range, self.q_range))
        )
        return p, q

    def _powers(self, curves: Floats) -> tuple[Floats, Floats]:
        """Active and reactive powers, (…, N), from the values of all curves, (…, K)."""
        load, q, pv = (peak * curves[..., which] for peak, which in zip(self.peaks, self.which, strict=True))
        return np.clip(load - pv, *self.p_range), np.clip(q, *self.q_range)

    def played(self, origin: float, season: Season) -> Forecast:
        """Forecast with the calendar of a simulation: the season's profiles begin at a Unix time, s."""
        return replace(self, origin=origin, season=season)

    def fill(self, frame: Frame, unread: Bools) -> Frame:
        """Frame with forecasts in place of unread powers (N,).

        Half-widths reach to the farther end of the range, so that intervals contain every possible power. The
        forecasts' standard deviations are separate fields.
        """
        p, q = self.at(frame.t)
        return replace(
            frame,
            p=np.where(unread, -p, frame.p),
            p_error=np.where(unread, _farther(p, self.p_range), frame.p_error),
            q=np.where(unread, -q, frame.q),
            q_error=np.where(unread, _farther(q, self.q_range), frame.q_error),
            p_std=np.where(unread, self.p_std, np.nan),
            q_std=np.where(unread, self.q_std, np.nan),
        )


def forecast(tables: FeederTables, loads: LoadModel) -> Forecast | None:
    """Prepare the forecasts of a feeder; None with "none": unread powers have their range only."""
    meta, rows = tables.meta, tables.customers
    if meta.load.forecast == "none":
        return None
    factor = np.array([row.power_factor or meta.load.power_factor for row in rows])
    peaks = np.stack([loads.load_peak, loads.load_peak * np.tan(np.arccos(factor)), loads.pv_peak])
    followed = [
        *((_LOAD_P, row.load_profile) for row in rows),
        *((_LOAD_Q, row.load_profile) for row in rows),
        *((_PV, row.pv_profile) for row in rows),
    ]
    curves = {curve: k for k, curve in enumerate(dict.fromkeys(followed))}
    which = indices([curves[curve] for curve in followed]).reshape(peaks.shape)
    load_std, q_std, pv_std = peaks * np.array([spread(*curve) for curve in curves])[which]
    return Forecast(
        p_std=_told(np.hypot(load_std, pv_std), tables, "p_std_kw"),
        q_std=_told(q_std, tables, "q_std_kvar"),
        p_range=np.stack([-loads.pv_peak, loads.load_peak]),
        q_range=np.stack([-loads.q_floor, loads.load_peak * loads.tan_max + loads.q_floor]),
        peaks=peaks,
        which=which,
        weeks={season: np.stack([_week(season, *curve) for curve in curves], axis=1) for season in Season},
        origin=FIRST_MONDAY_S - 3600.0 * meta.load.utc_offset_h,
    )


def always(given: Forecast | None, frame: Frame, unread: Bools) -> Frame:
    """Frame with intervals of unread powers (N,) that hold at any time, for designs and studies."""
    if given is None:
        return frame
    p, q = given.farthest()
    return replace(
        frame,
        p_error=np.where(unread, p, frame.p_error),
        q_error=np.where(unread, q, frame.q_error),
    )


def season_of(local_s: float) -> Season:
    """Season of the northern hemisphere at a local time, s since 1970-01-01; winter is from December."""
    month = int(np.datetime64(int(local_s), "s").astype("datetime64[M]").astype(np.int64)) % 12
    return tuple(Season)[(month + 1) % 12 // 3]


@cache
def spread(what: str, name: str) -> float:
    """Standard deviation of the forecast by a profile of "load_p", "load_q" or "pv", relative to the peak.

    Root mean square error of all profiles of its class (first letter: households, trades, farms, roofs) on
    every day of a season, in the worst season; generation by day only. Without a name it is that of all
    classes.
    """
    worst = 0.0
    for season in Season:
        expected = _week(season, what, name)
        alike = [
            each for key, each in _curves(library(season), what).items() if not name or key[0] == name[0]
        ]
        off = np.array(alike) - np.resize(expected, alike[0].size)
        day = np.resize((what != _PV) | (expected > 0.0), alike[0].size)
        worst = max(worst, float(np.sqrt(np.mean(off[:, day] ** 2))))
    return worst


@cache
def _week(season: Season, what: str, name: str) -> Floats:
    """A profile's mean over the season's days of each kind, as a week from Monday, (672,)."""
    days = profile(_curves(library(season), what), name).reshape(-1, round(DAY_S / PROFILE_STEP_S))
    kinds = np.resize(KINDS, len(days))
    return np.concatenate([days[kinds == kind].mean(axis=0) for kind in KINDS])


def _curves(profiles: Profiles, what: str) -> dict[str, Floats]:
    return {_LOAD_P: profiles.load_p, _LOAD_Q: profiles.load_q, _PV: profiles.pv}[what]


def _farther(power: Floats, limits: Floats) -> Floats:
    low, high = limits
    return np.asarray(np.maximum(power - low, high - power))


def _told(own: Floats, tables: FeederTables, column: str) -> Floats:
    """Standard deviations of the files, pu; those of metered customers describe readings, not forecasts."""
    told = [None if row.meter else getattr(row, column) for row in tables.customers]
    base = tables.meta.base_kva
    return np.array([std if each is None else each / base for std, each in zip(own, told, strict=True)])
