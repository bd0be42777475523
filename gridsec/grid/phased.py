"""Three-phase feeder in the form for estimators: single-phase customers, and a place per phase of each bus.

Places take the role of the buses in `gridsec.grid.radial`, in the same per unit:
powers in units of the three-phase base S. Place ``3 k + phi`` is phase phi of bus k, and the busbar has the
first three. R and X are not symmetric, and their entries have either sign.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from gridsec.arrays import Floats, Ints, frozen, frozen_ints, put
from gridsec.errors import FeederInvalid, Problem
from gridsec.grid import three_phase
from gridsec.grid.network import Network, OfMatrices, OnTree, unbounded
from gridsec.grid.three_phase import PHASES, ThreePhaseFeeder, customers_at, lindist3flow


class _OnThreePhases(Protocol):
    @property
    def tree(self) -> ThreePhaseFeeder: ...


class InPhases:
    """Methods of feeders with three busbar voltages: place ``3 k + phi`` is phase phi of bus k."""

    __slots__ = ()

    @property
    def busbar_phases(self) -> int:
        """See `Network`."""
        return 3

    @property
    def customer_bus(self: _OnThreePhases) -> Ints:
        """See `Network`."""
        return self.tree.at

    def busbar_places(self) -> slice:
        """See `Network`."""
        return slice(0, 3)

    def places(self: _OnThreePhases, buses: Ints) -> Ints:
        """See `Network`."""
        at, phase = np.nonzero(self.tree.phases[buses])
        return np.asarray(3 * buses[at] + phase)

    def same_busbar_phase(self, some: Ints, others: Ints) -> Floats:
        """See `Network`."""
        return np.equal.outer(some % 3, others % 3).astype(np.float64)

    def busbar_incidence(self: Network) -> Floats:
        """See `Network`."""
        return np.equal.outer(self.bus % 3, np.arange(3)).astype(np.float64)

    def broadcast_busbar(self: Network, of_busbar: Floats | float) -> Floats:
        """See `Network`."""
        each = np.broadcast_to(np.asarray(of_busbar, dtype=np.float64), 3)
        return np.tile(each, len(self.buses) // 3)


@dataclass(frozen=True, slots=True, eq=False)
class PhasedFeeder(InPhases, OfMatrices, OnTree):
    """Feeder of single-phase customers. N customers, b + 1 buses, n = 3 (b + 1) places.

    Raises FeederInvalid if customers have several phases; lists them all.
    """

    tree: ThreePhaseFeeder  # the feeder in three phases; each of its customers is connected to one of them
    bus: Ints = field(init=False, repr=False)  # (N,) place of each customer
    # (n,) identifiers of the places, the busbar's three first
    buses: tuple[str, ...] = field(init=False, repr=False)
    # R, X (n, N): The linear power flow ``v^2 = v0^2 + 2 R p + 2 X q``: from a customer's power, in units of
    # S, to the squared voltage of every place, pu. For an absent phase, that of its end.
    R: Floats = field(init=False, repr=False)
    X: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        tree, several = self.tree, self.tree.connected.sum(axis=1) > 1
        if several.any():
            raise FeederInvalid(
                [
                    Problem(
                        "several-phases",
                        f"customer {tree.customers[k]!r} has several phases; expected one customer for each",
                    )
                    for k in np.flatnonzero(several).tolist()
                ]
            )
        model = lindist3flow(tree)
        names = tuple(f"{bus}.{phase}" for bus in tree.buses for phase in PHASES)
        put(self, bus=frozen_ints(len(PHASES) * tree.at + tree.phase), buses=names)
        for name, found in (("R", model.R_bus), ("X", model.X_bus)):
            # 1 pu of the power of a phase is a third of S.
            by_place = 3.0 * np.moveaxis(found, 0, 1).reshape(len(names), tree.at.size)
            put(self, **{name: frozen(by_place)})

    def bus_voltages(self, p: Floats, q: Floats, v0_squared: Floats | float, *, steps: int = 1) -> Floats:
        """Squared voltage of every place, corrected for losses, charging and unequal phases.

        p, q (…, N): net active and reactive injection of each customer (generation positive), pu.
        v0_squared (…, 3) or scalar: squared busbar voltage of each phase, pu.
        steps: as in `gridsec.grid.three_phase.bus_voltages`; 0 gives LinDist3Flow.
        """
        given = np.asarray(v0_squared, dtype=np.float64)
        v0 = np.broadcast_to(given, (*given.shape[:-1], len(PHASES)))
        by_phase = three_phase.bus_voltages(self.tree, 3.0 * p, 3.0 * q, v0, steps=steps)
        return np.moveaxis(by_phase, -2, -1).reshape(*by_phase.shape[:-2], len(self.buses))

    def with_customers_at(self, places: Ints) -> PhasedFeeder:
        """See `Network`."""
        return PhasedFeeder(customers_at(self.tree, places))

    def model_error_bound(self, p: Floats, q: Floats, v0_squared: Floats | float) -> Floats:
        """See `gridsec.grid.network.Network`; by `gridsec.grid.three_phase.model_error_bound`."""
        v0 = np.broadcast_to(np.asarray(v0_squared, dtype=np.float64), len(PHASES))
        return three_phase.model_error_bound(self.tree, 3.0 * p, 3.0 * q, v0)

    def interval_bounds(
        self,
        p: Floats,
        q: Floats,
        v0_squared: Floats | float,
        *,
        p_error: Floats,
        q_error: Floats,
    ) -> tuple[Floats, Floats]:
        """See `gridsec.grid.network.WithMatrices`; by `gridsec.grid.three_phase.interval_bounds`."""
        v0 = np.broadcast_to(np.asarray(v0_squared, dtype=np.float64), len(PHASES))
        with np.errstate(all="ignore"):  # NaN gets an infinite bound without a warning
            moved, rest = three_phase.interval_bounds(
                self.tree, 3.0 * p, 3.0 * q, v0, p_error=3.0 * p_error, q_error=3.0 * q_error
            )
        return unbounded(moved), unbounded(rest)
