"""Small streets in three phases with AC truth by nodal admittances, and what their meters say."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import ModuleType

import numpy as np

from gridsec.estimators.plant import Plant
from gridsec.grid.devices import Droop
from gridsec.grid.meshed import PhasedMesh
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.three_phase import ThreePhaseFeeder
from gridsec.interface import Frame
from tests.gridsec.street import BASE_KVA, BASE_VOLT, RESOLUTION, Street, make_plant
from tests.gridsec.unbalanced import ac_places

UNEQUAL = np.array([1.0, 1.012, 0.991])
"""Busbar voltages of the phases, relative to each other."""


def coupled(
    seed: int, *, customers: int = 7, drop: float = 0.04, rating: float = 1.0 / 3.0, loss_correction: int = 1
) -> Plant:
    """A tree with full matrices of its own for every branch, an inverter and a meter for every customer.

    `rating` is that of the inverters, by those of `make_plant`; a third is what one phase of these has.
    """
    rng = np.random.default_rng([seed, 3])
    branches = 5
    parent = np.array([rng.integers(max(0, k - 2), k + 1) for k in range(branches)])
    own = rng.uniform(0.6, 1.2, (branches, 3)) * (1.0 + 0.6j * rng.uniform(0.7, 1.3, (branches, 3)))
    earth = rng.uniform(0.2, 0.4, branches) * (1.0 + 1.4j)
    z = own[:, :, None] * np.eye(3) + earth[:, None, None]
    # About `drop` at 5 kW for each of two customers in a phase over three branches.
    z *= drop / 3.0 / (2.0 * 3.0 * 5.0 / BASE_KVA)
    phase = np.concatenate([np.arange(3), rng.integers(0, 3, customers - 3)])
    tree = ThreePhaseFeeder(
        name="coupled",
        parent=parent,
        z=z,
        phases=np.ones((branches + 1, 3), dtype=np.bool_),
        bus=np.concatenate([[branches] * 3, rng.integers(1, branches + 1, customers - 3)]),
        connected=np.equal.outer(phase, np.arange(3)),
        customers=tuple(f"c{k}" for k in range(customers)),
        buses=tuple(f"b{k}" for k in range(branches + 1)),
        base_volt=BASE_VOLT,
        base_kva=BASE_KVA,
        charging=np.zeros((branches, 3, 3)),
    )
    like = make_plant(rng, customers=customers)
    droop = Droop(
        customer=like.droop.customer,
        v=like.droop.v,
        q=rating * like.droop.q,
        tau=like.droop.tau,
        vbar=like.droop.vbar,
        rating=rating * like.droop.rating,
    )
    return Plant(PhasedFeeder(tree), droop, like.meters, like.accuracy, loss_correction)


def ringed(plant: Plant) -> Plant:
    """The same with two closed ties: one of all phases from the busbar to the end, one of phase b."""
    assert isinstance(plant.feeder, PhasedFeeder)
    tree = plant.feeder.tree
    last = tree.z.shape[0]
    phases = np.array([[True, True, True], [False, True, False]])
    z = tree.z[[0, 1]] * (phases[:, :, None] & phases[:, None, :]) * np.array([2.0, 0.5])[:, None, None]
    ends = np.array([[0, last], [1, last - 1]])
    return replace(plant, feeder=PhasedMesh(tree, ends, phases, z, np.zeros((2, 3, 3))))


@dataclass
class PhasedStreet(Street):
    """A street in three phases: its truth is that of nodal admittances, its busbar has three voltages."""

    phases: np.ndarray = field(default_factory=lambda: UNEQUAL)

    def voltages(self) -> np.ndarray:
        """|v| of every place."""
        feeder = self.plant.feeder
        assert feeder.busbar_phases == 3
        q = self.p * self.tan
        np.add.at(q, self.plant.droop.customer, self.x)
        return np.nan_to_num(np.sqrt(ac_places(feeder, self.p, q, (self.v0 * self.phases) ** 2)))

    def frame(self, lies: dict[int, float] | None = None, silent: tuple[int, ...] = ()) -> Frame:
        """What is known of the present; see `Street.frame`."""
        one = super().frame(lies, silent)
        v0 = self.v0 * self.phases * (1.0 + self.busbar_bias)
        v0 = (np.round(v0 / RESOLUTION) * RESOLUTION) ** 2
        return replace(one, v0_squared=float(v0.mean()), v0_phases=v0)


def errors_at_their_ends(family: ModuleType, plant: Plant, rng: np.random.Generator, seed: int) -> None:
    """Watch a street whose errors are as large as they may be: bounds hold, and nobody honest is accused."""
    count = plant.meters.size
    design = family.design(plant, max_attacked=1, step_s=1.0)
    told = np.arange(0, count, 2) if seed % 2 else None
    street = PhasedStreet(plant, rng, extreme=True, metered_q=told, phases=rng.uniform(0.98, 1.02, 3))
    state, liar = family.init(design, 1000.0), int(rng.integers(count))
    honest = np.arange(count) != (liar if seed % 4 else -1)
    for tick in range(16):
        street.advance(float(rng.choice([0.3, 1.0, 5.0, 900.0])))
        lie = {liar: float(rng.choice([-0.1, -0.04, 0.03, 0.08]))} if tick > 3 and seed % 4 else {}
        silent = (int(rng.integers(count)),) if tick % 5 == 4 else ()
        state, estimate, verdict = family.step(design, state, street.frame(lie, silent))
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
        assert not (np.nan_to_num(verdict.score) > verdict.threshold)[honest].any()
        assert not verdict.suspects[honest].any()
