"""What honest loads and meters of a feeder can be off by at an operating point, as a box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from feeders.doubts import unread
from feeders.forecast import always
from feeders.load import Snapshot, to_frame
from feeders.studies.hidden import Curves, customer_indices
from gridsec.accuracy import busbar_error, reading_error
from gridsec.arrays import Floats
from gridsec.choices import choice
from gridsec.network import Power, between
from gridsec.online import Frame
from gridsec.studies.false_powers import FalsePowers
from gridsec.studies.lies import Box
from gridsec.studies.patterns import from_busbar

if TYPE_CHECKING:
    from feeders.load import Site

__all__ = ["SHARE", "SIGMAS", "box", "false_powers", "squared", "volts_of_lie"]

SHARE: Final = 0.5
"""Share of its peak that every load draws where nothing else is said; nothing is generated."""

SIGMAS: Final = 4.0
"""Standard deviations of jitter that an honest reading may be off, as in `gridsec.plant.Options`."""


def box(site: Site, *, share: float = SHARE, curves: Curves = Curves.DEADBAND) -> Box:
    """The worst cases of the exact bank's thresholds, at nominal voltage.

    Intervals of powers are those of a frame in which every metered load draws `share` of its peak and reports
    active power only. Inverters answer along their droop curves, linearised. In three phases each voltage of
    the busbar errs on its own.

    Parameters
    ----------
    site
        The feeder.
    share
        Of the peak load.
    curves
        Where the inverters work; at nominal voltage that is the deadband.

    Raises
    ------
    ValueError
        If they have no such part.
    """
    frame = _frame(site, share)
    return _box(site, curves, frame.p_error, frame.q_error)


def false_powers(
    site: Site,
    *,
    unknown: Sequence[str] | None = None,
    share: float = SHARE,
    curves: Curves = Curves.DEADBAND,
) -> FalsePowers:
    """The same where liars report any powers that their customers could draw or feed in.

    Parameters
    ----------
    site, share, curves
        As in `box`.
    unknown
        Customers whose powers nobody knows, whoever lies, besides those without a meter.

    Raises
    ------
    ValueError
        If there is no such customer or part of the curves.
    """
    frame, silent = _frame(site, share), unread(site)
    p, q = np.maximum(frame.p_error, silent.p_error), np.maximum(frame.q_error, silent.q_error)
    made, owner = _box(site, curves, p, q), np.full(p.size, -1, dtype=np.intp)
    owner[site.meters] = np.arange(site.meters.size)
    open_ = customer_indices(site, unknown or ())
    owner[open_] = -1
    alone = made.effect.shape[1] - 2 * p.size
    wide, narrow = np.concatenate([p, q]), np.concatenate([frame.p_error, frame.q_error])
    part = np.divide(narrow, wide, out=np.ones_like(wide), where=wide > 0.0)
    part[np.concatenate([open_, p.size + open_])] = 1.0
    return FalsePowers(
        made,
        np.concatenate([owner, owner, np.full(alone, -1, dtype=np.intp)]),
        np.concatenate([part, np.ones(alone)]),
    )


def _frame(site: Site, share: float) -> Frame:
    """What honest meters say."""
    drawn = np.array([share * row.load_kw for row in site.tables.customers])[site.meters]
    nominal = site.customer_volt[site.meters]
    frame = to_frame(
        site, Snapshot(0.0, nominal, drawn, np.full(drawn.size, np.nan), float(site.feeder.base_volt))
    )
    unmetered = np.ones(frame.p.size, dtype=np.bool_)
    unmetered[site.meters] = False
    return always(site.forecast, frame, unmetered)


def _box(site: Site, curves: Curves, p_error: Floats, q_error: Floats) -> Box:
    """What powers, off by so much, the busbar and the meters do."""
    R, X = (between(site.feeder, power) for power in Power)
    own = site.droop.customer
    steepest = choice("curves", Curves, curves) is Curves.STEEPEST
    slope = site.droop.slope if steepest else np.zeros(own.size)
    loop = np.eye(len(X))
    loop[:, own] += 2.0 * X[:, own] * slope
    open_loop = np.hstack(
        [
            2.0 * R * p_error,
            2.0 * X * q_error,
            busbar_error(site.accuracy, 1.0, SIGMAS) * from_busbar(site.feeder),
        ]
    )
    reading = reading_error(site.accuracy, np.ones(site.meters.size), SIGMAS)
    return Box(np.asarray(np.linalg.solve(loop, open_loop)), site.meters, reading)


def volts_of_lie(base_volt: Floats | float, size: Floats | float) -> Floats:
    """What a change of the squared voltage is in volts, at 1 pu and downwards: the larger way, V.

    Parameters
    ----------
    base_volt, size
        1 pu, V, as `Site.customer_volt` has it; and squared pu.
    """
    return np.asarray(base_volt * (1.0 - np.sqrt(np.maximum(1.0 - np.asarray(size), 0.0))))


def squared(base_volt: Floats | float, volt: Floats | float) -> Floats:
    """The reverse of `volts_of_lie`.

    Parameters
    ----------
    base_volt, volt
        1 pu, V; and volts.
    """
    return np.asarray(1.0 - np.maximum(1.0 - np.asarray(volt) / base_volt, 0.0) ** 2)
