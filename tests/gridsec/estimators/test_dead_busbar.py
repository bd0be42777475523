"""A dead phase, or a dead busbar, and what is said once there is a voltage again."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from gridsec.estimators import exact_bank, partial, set_search, unknown_input
from gridsec.estimators.plant import Plant
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.network import Network
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.interface import Decision, Frame
from tests.gridsec.street import Street, make_plant
from tests.gridsec.streets import PhasedStreet, coupled, ringed

LIAR, LIE = 0, 0.2
DEAD = 0.4 / 230.0
FAMILIES = (exact_bank, set_search, partial, unknown_input)


def ring() -> tuple[Plant, Street]:
    """A balanced street with a closed tie, whose truth is without: nobody is asked for bounds here."""
    one = make_plant(np.random.default_rng(7), customers=7, drop=0.05)
    tree = one.feeder
    assert isinstance(tree, Feeder)
    z = np.full(1, 3.0 * tree.r.max())
    tied = replace(one, feeder=MeshedFeeder(tree, np.array([[0, 7]]), z, z, np.zeros(1)))
    return tied, Street(one, np.random.default_rng(3))


def unbalanced(tied: bool) -> tuple[Plant, Street]:
    """A street of nine customers in three phases, with its ties or without."""
    plant = coupled(3, customers=9)
    plant = ringed(plant) if tied else plant
    return plant, PhasedStreet(plant, np.random.default_rng(8))


def without(frame: Frame, feeder: Network) -> Frame:
    """The frame while phase b, or where there are no phases the whole busbar, has hardly a voltage."""
    if frame.v0_phases is None:
        return replace(frame, y=np.full(frame.y.size, DEAD**2), v0_squared=DEAD**2, p=0.0 * frame.p)
    dead = feeder.bus % 3 == 1
    v0 = np.where(np.arange(3) == 1, DEAD**2, frame.v0_phases)
    return replace(
        frame,
        y=np.where(dead, DEAD**2, frame.y),
        v0_phases=v0,
        v0_squared=float(v0.mean()),
        p=np.where(dead, 0.0, frame.p),
    )


def answers(family: ModuleType, plant: Plant, street: Street) -> list[Decision]:
    """The decisions on a lie that begins when the voltage has been back for a while; all values finite."""
    design = family.design(plant, max_attacked=1, step_s=1.0)
    state, said = family.init(design, street.t), []
    for tick in range(28):
        street.advance(1.0)
        frame = street.frame({LIAR: LIE} if tick >= 14 else {})
        if 4 <= tick < 12:
            frame = without(frame, plant.feeder)
        state, estimate, verdict = family.step(design, state, frame)
        for values in (estimate.v2, estimate.bound, estimate.x, verdict.threshold):
            assert np.isfinite(values).all(), tick
        said.append(verdict.decision)
    return said[20:]


@pytest.mark.canary("False-gridsec.estimators.exact_bank")
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("tied", [False, True])
def test_a_liar_is_not_clean_after_a_phase_was_dead(family: ModuleType, tied: bool) -> None:
    assert Decision.CLEAN not in answers(family, *unbalanced(tied))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_liar_on_a_ring_is_not_clean_after_an_outage(family: ModuleType) -> None:
    assert Decision.CLEAN not in answers(family, *ring())


@pytest.mark.parametrize("plant", [ring()[0], unbalanced(False)[0], unbalanced(True)[0]])
@pytest.mark.parametrize("v0_squared", [-1e-6, 0.0, np.nan])
def test_bounds_are_infinite_without_a_busbar_voltage(plant: Plant, v0_squared: float) -> None:
    feeder = plant.feeder
    assert not isinstance(feeder, Feeder)
    v0 = np.array([1.0, v0_squared, 1.0]) if feeder.busbar_phases == 3 else v0_squared
    p = np.full(len(feeder.customers), 0.01)
    for each in feeder.interval_bounds(p, 0.0 * p, v0, p_error=p, q_error=p):
        assert np.isposinf(each).all()


@pytest.mark.parametrize("family", FAMILIES[:3])
def test_a_threshold_that_is_none_is_never_clean(family: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a number may be lost by: here by bounds that are none for one reading."""
    plant, street = unbalanced(False)
    design = family.design(plant, max_attacked=1, step_s=1.0)
    state, none = family.init(design, street.t), np.full(9, np.nan)
    for tick in range(12):
        street.advance(1.0)
        with monkeypatch.context() as patch:
            if tick == 6:
                patch.setattr(PhasedFeeder, "interval_bounds", lambda *_, **__: (none, none))
            state, _, verdict = family.step(design, state, street.frame())
        if np.isnan(verdict.threshold).any():
            assert verdict.decision is not Decision.CLEAN, tick
    assert np.isnan(verdict.threshold).any()
