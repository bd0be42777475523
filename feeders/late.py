"""Active powers that are older than the voltage reading beside them.

A load follows a first-order process with the standard deviation sigma of its range, or of its forecast, and
the correlation time tau = `[load] correlation_s`. Single devices switch the whole difference J between the
reading and the farther end of the range at once. The change over an age a > 0 has the standard deviation

    s(a) = sqrt(2 sigma^2 (1 - exp(-a / tau)) + (J / SWITCHED)^2).

A power with s of sigma and more is worth no more than no reading.

References
----------
docs/theory-sequential.md, section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from gridsec.arrays import Bools, Floats, any_of
from gridsec.online import Frame, PowerOrigin

if TYPE_CHECKING:
    from feeders.load import Site, Snapshot

SWITCHED: Final = 5.0
"""Standard deviations that switching the whole difference to the end of the range amounts to.

The limits of one meter begin at 5.2: no single device exceeds them. A larger value names honest meters, a
smaller one hides lies.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Late:
    """Late powers of one tick. N customers.

    Attributes
    ----------
    which : (N,)
        Customers with a late power that is worth something.
    useless : (N,)
        Customers with a power that is worth no more than none.
    stated : (N,)
        Customers with a power no older than `[meters] p_interval_s`.
    std : (N,)
        Standard deviation of the change of the active power, pu; 0 elsewhere.
    reach : (N,)
        Largest change, pu.
    """

    which: Bools
    useless: Bools
    stated: Bools
    std: Floats
    reach: Floats

    def widen(self, site: Site, frame: Frame) -> Frame:
        """The frame with the uncertainty of the late powers.

        Intervals reach to the ends of what is possible. Metered reactive powers are as old, and are not used.

        Parameters
        ----------
        site
            The feeder.
        frame
            The frame of the readings, as if all were of the same moment.
        """
        loads, which, none = site.loads, self.which, np.full(self.std.size, np.nan)
        root, tan = np.sqrt(3.0), np.maximum(np.abs(loads.tan_min), np.abs(loads.tan_max))
        low, high = -loads.q_floor, loads.load_peak * loads.tan_max + loads.q_floor
        q = -frame.q
        p_std = np.hypot(frame.p_error / root, self.std)
        q_std = np.hypot(frame.q_error / root, tan * np.minimum(self.std, loads.load_peak))
        told = (none if std is None else std for std in (frame.p_std, frame.q_std))
        origin = np.zeros(q.size, dtype=np.intp) if frame.p_origin is None else frame.p_origin
        late = which & ~self.stated & (origin == PowerOrigin.READ)
        return replace(
            frame,
            p_error=np.where(which, np.maximum(frame.p_error, self.reach), frame.p_error),
            q_error=np.where(which, np.maximum(frame.q_error, np.maximum(q - low, high - q)), frame.q_error),
            q_net=np.where(which, np.nan, frame.q_net),
            p_std=np.where(which, p_std, next(told)),
            q_std=np.where(which, q_std, next(told)),
            p_origin=np.where(late, PowerOrigin.LATE, origin).astype(np.intp),
        )


def late(site: Site, snapshot: Snapshot) -> Late | None:
    """Late powers of a tick; None: all are of the moment of their voltage.

    Parameters
    ----------
    site
        The feeder; `[meters] p_interval_s` of its file is the age of powers without a time of their own.
    snapshot
        The readings.
    """
    interval = site.tables.meta.meters.p_interval_s
    if snapshot.p_age_s is None and interval == 0.0:
        return None
    told = np.full(site.meters.size, np.nan) if snapshot.p_age_s is None else snapshot.p_age_s
    age = np.where(np.isnan(told), interval, np.maximum(told, 0.0))
    aged = (age > 0.0) & np.isfinite(snapshot.p_kw)
    if not any_of(aged):
        return None
    ages, p = np.zeros((2, site.loads.load_peak.size))
    ages[site.meters] = np.where(aged, age, 0.0)
    p[site.meters] = np.where(aged, snapshot.p_kw / site.feeder.base_kva, 0.0)
    reach = np.maximum(site.loads.load_peak - p, p + site.loads.pv_peak)
    std = change(site, ages, reach)
    useless = (ages > 0.0) & (std >= spread(site))
    which = (ages > 0.0) & ~useless
    return Late(which, useless, ages <= interval, np.where(which, std, 0.0), np.where(which, reach, 0.0))


def change(site: Site, age_s: Floats | float, reach: Floats) -> Floats:
    """Standard deviation of the change of each customer's active power, (N,), pu; 0 at age 0.

    Parameters
    ----------
    site
        The feeder.
    age_s : (N,)
        Age, s.
    reach : (N,)
        Distance to the farther end of the range, pu.
    """
    slow = -2.0 * np.expm1(-np.asarray(age_s) / site.tables.meta.load.correlation_s)
    moved = np.hypot(np.sqrt(slow) * spread(site), reach / SWITCHED)
    return np.asarray(np.where(np.asarray(age_s) > 0.0, moved, 0.0))


def spread(site: Site) -> Floats:
    """Standard deviation of each customer's active power without a reading, (N,), pu."""
    if site.forecast is not None:
        return site.forecast.p_std
    return np.asarray((site.loads.load_peak + site.loads.pv_peak) / np.sqrt(12.0))


def expected(site: Site) -> Floats:
    """Standard deviation of the change over `[meters] p_interval_s` that the design supposes, (N,), pu."""
    if site.tables.meta.meters.p_interval_s == 0.0:
        return np.zeros(site.loads.load_peak.size)
    reach = site.loads.load_peak + site.loads.pv_peak
    return np.minimum(change(site, site.tables.meta.meters.p_interval_s, reach), spread(site))
