"""Operating points of studies: volts per customer, and errors of honest loads and meters as a box.

Limits and curves are relative to the nominal voltage, the model to each place's own base
(`feeders.model.equipment`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from feeders.format.validation import Edge, tree
from feeders.model.forecast import always
from feeders.model.site import Site, Snapshot, to_frame, unread
from feeders.model.three_phase import ThreePhaseSite
from feeders.studies.unobservable import CurvePositions, customer_indices
from gridsec.arrays import Floats
from gridsec.errors import choice
from gridsec.grid.devices import busbar_error, reading_error
from gridsec.grid.network import Power
from gridsec.interface import Frame
from gridsec.planning.redundancy import from_busbar
from gridsec.planning.stealthy_attacks import ErrorBox, PowerErrorModel

__all__ = ["SHARE", "Bases", "box", "false_powers", "line_rows", "operating_frame", "squared", "volts_of_lie"]


@dataclass(frozen=True, slots=True, eq=False)
class Bases:
    """Voltage bases of N customers."""

    volt: Floats  # (N,) 1 pu at every customer, V
    nominal: Floats  # (N,) the nominal voltage there, V: 1 in limits and curves

    @classmethod
    def of(cls, site: Site) -> Self:
        """Bases of a feeder."""
        return cls(site.customer_volt, site.customer_nominal)

    @property
    def ratio(self) -> Floats:
        """1 pu relative to the nominal voltage, (N,): 1 except behind taps."""
        return np.asarray(self.volt / self.nominal)

    def band(self, low: float, high: float) -> tuple[Floats, Floats]:
        """Limits relative to the nominal voltage, in pu of every customer, (N,) each."""
        return low / self.ratio, high / self.ratio

    def extremes(self, v: Floats) -> tuple[float, float]:
        """Voltages with the smallest and largest ratio to their nominal voltage, V; `v` is (..., N), pu."""
        told = (v * self.ratio).reshape(-1, self.volt.size)
        lows, highs = told.min(axis=0), told.max(axis=0)
        lowest, highest = int(np.argmin(lows)), int(np.argmax(highs))
        return (
            float(lows[lowest] * self.nominal[lowest]),
            float(highs[highest] * self.nominal[highest]),
        )


def line_rows(site: Site | ThreePhaseSite) -> list[int]:
    """Rows in lines.csv of the branches of the feeder's tree, and then of the lines that close loops."""
    rows, group = site.tables.lines, site.bus_of_file
    closed = [k for k, line in enumerate(rows) if line.closed]
    lines = [rows[k] for k in closed]
    # Buses that the model fuses are joined by lines without impedance.
    joins = [group[row.from_bus] == group[row.to_bus] for row in lines]
    edges = [
        Edge(row.line, row.from_bus, row.to_bus, zero, phases=len(row.phases))
        for row, zero in zip(lines, joins, strict=True)
    ]
    found = tree(site.tables.meta.busbar, edges)
    return [closed[k] for k in (*found.branch, *found.ties)]


SHARE: Final = 0.5  # default load relative to its peak, the same for all, 1, without generation
SIGMAS: Final = 4.0  # limit of an honest reading's jitter, as in `estimators.plant.Options`


def box(site: Site, *, share: float = SHARE, curves: CurvePositions = CurvePositions.DEADBAND) -> ErrorBox:
    """Worst cases of the exact bank's thresholds, at nominal voltage.

    Intervals of powers are those of a frame with every metered load at `share` of its peak, active power
    only. Inverters follow their linearised droop curves; at nominal voltage these are in the deadband. In
    three phases each voltage of the busbar has its own error.

    Raises ValueError for an unknown region of the curves.
    """
    frame = _frame(site, share)
    return _box(site, curves, frame.p_error, frame.q_error)


def false_powers(
    site: Site,
    *,
    unknown: Sequence[str] | None = None,
    share: float = SHARE,
    curves: CurvePositions = CurvePositions.DEADBAND,
) -> PowerErrorModel:
    """Worst cases in which manipulated meters report any powers within their customers' range.

    `unknown` are customers with unknown powers besides those without a meter; `share` and `curves` as in
    `box`.

    Raises ValueError for an unknown customer or region of the curves.
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
    return PowerErrorModel(
        made,
        np.concatenate([owner, owner, np.full(alone, -1, dtype=np.intp)]),
        np.concatenate([part, np.ones(alone)]),
    )


def operating_frame(site: Site, share: float) -> Frame:
    """Frame of honest meters, each load at a share of its peak and each voltage at its base."""
    drawn = np.array([share * row.load_kw for row in site.tables.customers])[site.meters]
    volts, none = site.customer_volt[site.meters], np.full(drawn.size, np.nan)
    return to_frame(site, Snapshot(0.0, volts, drawn, none, float(site.feeder.base_volt)))


def _frame(site: Site, share: float) -> Frame:
    """The same where customers without a meter have the farthest forecast."""
    frame = operating_frame(site, share)
    unmetered = np.ones(frame.p.size, dtype=np.bool_)
    unmetered[site.meters] = False
    return always(site.forecast, frame, unmetered)


def _box(site: Site, curves: CurvePositions, p_error: Floats, q_error: Floats) -> ErrorBox:
    """Effect of errors of the powers, the busbar and the meters."""
    R, X = (site.feeder.between(power) for power in Power)
    own = site.droop.customer
    steepest = choice("curves", CurvePositions, curves) is CurvePositions.STEEPEST
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
    return ErrorBox(np.asarray(np.linalg.solve(loop, open_loop)), site.meters, reading)


def volts_of_lie(base_volt: Floats | float, size: Floats | float) -> Floats:
    """Change of the squared voltage, pu^2, in volts at 1 pu, V, and downwards: the larger direction."""
    return np.asarray(base_volt * (1.0 - np.sqrt(np.maximum(1.0 - np.asarray(size), 0.0))))


def squared(base_volt: Floats | float, volt: Floats | float) -> Floats:
    """Inverse of `volts_of_lie`."""
    return np.asarray(1.0 - np.maximum(1.0 - np.asarray(volt) / base_volt, 0.0) ** 2)
