"""Load powers of one tick from the registers of active power, with intervals and origins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from feeders.equipment import LoadModel
from gridsec.arrays import Bools, Floats, Ints, all_of
from gridsec.network import Power, model_error_bound, own
from gridsec.online import PowerOrigin

if TYPE_CHECKING:
    from feeders.load import Site


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """Load powers of one tick, consumption positive, pu. N customers.

    Attributes
    ----------
    p, p_error : (N,)
        Centre and half-width of the interval of the net active power.
    q, q_error : (N,)
        The same of the load's reactive power.
    known : (N,)
        The interval rests on a reading.
    origin : (N,)
        `PowerOrigin` of `p`.
    excess : (N,)
        Part of the reading beyond the declared load or generation.
    """

    p: Floats
    p_error: Floats
    q: Floats
    q_error: Floats
    known: Bools
    origin: Ints
    excess: Floats


def registered(site: Site, metered: Floats) -> Registered:
    """Return the powers that the frame states.

    A reading is used up to ``LoadModel.credible``. Readings beyond the declared range are used only while
    the model error has a finite bound with all of them. Otherwise those with the largest voltage effect
    ``R_ii excess_i`` are replaced by the declared range, the fewest that restore the bound. The busbar has
    its nominal voltage there: no meter of the busbar decides on powers.

    Parameters
    ----------
    site
        The feeder.
    metered : (N,)
        Net active power that each register shows, pu; NaN: no usable reading.
    """
    known = np.abs(metered) <= site.loads.credible  # False for NaN
    found = _intervals(site.loads, metered, known)
    over = np.flatnonzero(known & (found.excess > 0.0))
    if not over.size or _bounded(site, found):
        return found
    effect = own(site.feeder, Power.ACTIVE)[over] * found.excess[over]
    over = over[np.argsort(-effect, kind="stable")]

    def without(count: int) -> Registered:
        used = known.copy()
        used[over[:count]] = False
        return _intervals(site.loads, metered, used)

    few, enough = 0, over.size
    while enough - few > 1:
        middle = (few + enough) // 2
        few, enough = (few, middle) if _bounded(site, without(middle)) else (middle, enough)
    return without(enough)


def _bounded(site: Site, powers: Registered) -> bool:
    """Existence of a finite error bound of the loss-corrected model, at nominal busbar voltage."""
    with np.errstate(all="ignore"):
        bound = model_error_bound(site.feeder, -powers.p, -powers.q, site.droop.vbar**2)
    return all_of(np.isfinite(bound))


def _intervals(model: LoadModel, metered: Floats, known: Bools) -> Registered:
    """Intervals of the powers, `feeders.load.to_frame`; the declared range where not `known`."""
    p = np.where(known, metered, 0.5 * (model.load_peak - model.pv_peak))
    excess = np.maximum(p - model.load_peak, 0.0) + np.maximum(-p - model.pv_peak, 0.0)
    doubt = np.minimum(2.0 * excess, np.abs(p))
    p_error = np.where(known, model.p_fraction * np.abs(p) + model.p_floor + doubt, model.p_unread)
    low = np.maximum(p - p_error, 0.0)
    most = np.minimum(p + p_error + model.pv_peak, model.load_peak)
    high = np.maximum(np.maximum(most, p + p_error), 0.0)
    q_low = low * model.tan_min - model.q_floor
    q_high = high * model.tan_max + model.q_floor
    q_error = 0.5 * (q_high - q_low)
    beyond = (known & (excess > 0.0)) | (np.isfinite(metered) & ~known)
    origin = np.where(known, PowerOrigin.READ, PowerOrigin.UNREAD)
    return Registered(
        p=p,
        p_error=p_error,
        q=0.5 * (q_low + q_high),
        q_error=np.where(known, q_error, np.minimum(q_error, model.q_unread)),
        known=known,
        origin=np.where(beyond, PowerOrigin.BEYOND, origin).astype(np.intp),
        excess=excess,
    )
