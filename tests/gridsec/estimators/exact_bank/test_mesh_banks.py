"""Banks around loops of three phases, against AC truth by nodal admittances."""

from __future__ import annotations

from itertools import combinations
from types import ModuleType

import numpy as np
import pytest

from gridsec.estimators import exact_bank, partial, set_search, unknown_input, windowed
from gridsec.grid.meshed import PhasedMesh
from gridsec.interface import Decision
from tests.gridsec.estimators.exact_bank.test_three_phase import lied
from tests.gridsec.streets import PhasedStreet, coupled, errors_at_their_ends, ringed


@pytest.mark.parametrize("liars", [*combinations(range(7), 1), (0, 1), (2, 5), (3, 6)])
def test_a_set_of_liars_is_named_and_nobody_else(liars: tuple[int, ...]) -> None:
    plant = ringed(coupled(len(liars)))
    assert isinstance(plant.feeder, PhasedMesh)
    street = PhasedStreet(plant, np.random.default_rng(liars), extreme=True)
    design = exact_bank.design(plant, max_attacked=2, step_s=1.0)
    assert all(lied(street, design, exact_bank, liars, 11))


@pytest.mark.canary("None-gridsec.estimators.windowed", "5-gridsec.estimators.unknown_input")
@pytest.mark.parametrize("family", [windowed, set_search, partial, unknown_input])
@pytest.mark.parametrize("liar", [None, 0, 5])
def test_other_families_name_the_liar_alone(family: ModuleType, liar: int | None) -> None:
    plant = ringed(coupled(3))
    street = PhasedStreet(plant, np.random.default_rng(8), extreme=True)
    more = {"length": 5} if family is windowed else {}
    design = family.design(plant, max_attacked=1, step_s=1.0, **more)
    state = family.init(design, 1000.0)
    for tick in range(24):
        street.advance(1.0)
        state, estimate, verdict = family.step(
            design, state, street.frame({liar: 0.1} if liar is not None and tick > 9 else {})
        )
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
        assert set(np.flatnonzero(verdict.suspects)) <= {liar}
        if liar is not None and tick > 15:
            assert verdict.decision is not Decision.CLEAN
    if liar is not None:
        assert verdict.suspects[liar]
    else:
        assert not verdict.suspects.any()
        # Inverters of a single phase are small against what is not known of the loads.
        assert verdict.decision is (Decision.UNDECIDED if family is unknown_input else Decision.CLEAN)


@pytest.mark.canary("0", "8")
@pytest.mark.parametrize("seed", range(9))
def test_random_streets_with_errors_at_their_ends(seed: int) -> None:
    """Any spacing of readings, lost readings, metered reactive power, unequal phases, lies that jump."""
    rng = np.random.default_rng([seed, 99])
    family = (exact_bank, set_search, partial)[seed % 3]
    plant = ringed(coupled(seed, customers=int(rng.integers(5, 9)), drop=float(rng.choice([0.02, 0.06]))))
    errors_at_their_ends(family, plant, rng, seed)
