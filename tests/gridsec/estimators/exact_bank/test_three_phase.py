"""Banks in three phases: against balanced ones where phases do not touch, otherwise against AC truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from types import ModuleType

import numpy as np
import pytest

from gridsec.estimators import detection, exact_bank, partial, set_search, unknown_input, windowed
from gridsec.estimators.exact_bank import bank as banks
from gridsec.estimators.plant import Plant
from gridsec.grid.meshed import MeshedFeeder
from gridsec.grid.phased import PhasedFeeder
from gridsec.grid.radial import Feeder
from gridsec.interface import Cause, Decision, Estimate, Verdict
from gridsec.observers.lure import close_loop
from tests.gridsec.estimators.modal.test_phases import CUSTOMERS, apart, together
from tests.gridsec.street import Street, make_plant
from tests.gridsec.streets import PhasedStreet, coupled, errors_at_their_ends

Step = tuple[Estimate, Verdict]


def alike(seed: int, loss_correction: int) -> Plant:
    """A balanced street whose cables have one ratio of x and r, as a mesh without a loop.

    On a tree the bounds of a balanced feeder are those of losses alone; a mesh has those of three phases.
    """
    one = make_plant(
        np.random.default_rng(seed), customers=CUSTOMERS, drop=0.03, loss_correction=loss_correction
    )
    assert isinstance(one.feeder, Feeder)
    return replace(one, feeder=replace(one.feeder, x=0.4 * one.feeder.r))


def meshed(one: Plant) -> Plant:
    """The same as a mesh without a loop."""
    assert isinstance(one.feeder, Feeder)
    none = np.zeros(0)
    return replace(one, feeder=MeshedFeeder(one.feeder, np.zeros((0, 2), dtype=np.intp), none, none, none))


def watched(
    family: ModuleType, plants: tuple[Plant, Plant], liars: int, lie: dict[int, float]
) -> list[tuple[list[Step], Step]]:
    """Answers for three streets, and for them as the phases of one; the first one lies after 8 readings."""
    one, whole = (family.design(plant, max_attacked=liars, step_s=1.0) for plant in plants)
    streets = [Street(make_like(plants[0]), np.random.default_rng([5, k])) for k in range(3)]
    states, state = [family.init(one, 1000.0) for _ in streets], family.init(whole, 1000.0)
    out = []
    for tick in range(16):
        for street in streets:
            street.advance(1.0)
        heard = [street.frame(lie if tick >= 8 and not k else {}) for k, street in enumerate(streets)]
        stepped = [family.step(one, before, frame) for before, frame in zip(states, heard, strict=True)]
        states = [each[0] for each in stepped]
        state, estimate, verdict = family.step(whole, state, together(heard))
        out.append(([each[1:] for each in stepped], (estimate, verdict)))
    return out


def make_like(plant: Plant) -> Plant:
    """The plant whose truth is that of a balanced tree."""
    if isinstance(plant.feeder, MeshedFeeder):
        return replace(plant, feeder=plant.feeder.tree)
    return plant


class TestPhasesThatDoNotTouch:
    @pytest.mark.parametrize(
        ("family", "liars", "lie"),
        [
            (exact_bank, 0, {}),
            (exact_bank, 0, {4: -0.05}),
            (set_search, 1, {4: -0.05}),
            (set_search, 1, {2: 0.06}),
        ],
    )
    def test_answers_are_those_of_three_balanced_ones(
        self, monkeypatch: pytest.MonkeyPatch, family: ModuleType, liars: int, lie: dict[int, float]
    ) -> None:
        # Bounds are lowered as far as they go, or each phase would stop where nobody of its own gains much.
        monkeypatch.setattr(detection, "_TIGHTENING", 0.0)
        monkeypatch.setattr(detection, "_ROUNDS", 500)
        one = meshed(alike(5, 1))
        for answers, whole in watched(family, (one, apart(make_like(one))), liars, lie):
            for k, names in enumerate(
                (("v2", "bound", "x", "trusted"), ("score", "threshold", "attack", "suspects"))
            ):
                for name in names:
                    found = getattr(whole[k], name)
                    each = np.concatenate([getattr(answer[k], name) for answer in answers])
                    # Who drops a meter, or sees more liars than allowed for, bounds all phases anew.
                    own = slice(CUSTOMERS if lie and name in {"bound", "threshold"} else None)
                    np.testing.assert_allclose(found[own], each[own], rtol=0, atol=1e-9)
            verdict = whole[1]
            said = {found.decision for _, found in answers}
            worst = next(
                each for each in (Decision.ATTACKED, Decision.UNDECIDED, Decision.CLEAN) if each in said
            )
            assert verdict.decision is worst
        assert np.flatnonzero(verdict.suspects).tolist() == list(lie)

    def test_a_mesh_without_a_loop_is_the_radial_feeder_with_wider_bounds(self) -> None:
        one = alike(5, 0)
        street = Street(one, np.random.default_rng(1))
        designs = [exact_bank.design(plant, max_attacked=1, step_s=1.0) for plant in (one, meshed(one))]
        states = [exact_bank.init(each, 1000.0) for each in designs]
        for tick in range(14):
            street.advance(1.0)
            frame = street.frame({3: 0.06} if tick > 6 else {})
            found = [exact_bank.step(d, s, frame) for d, s in zip(designs, states, strict=True)]
            states = [each[0] for each in found]
            (_, radial, said), (_, loops, other) = found
            np.testing.assert_allclose(loops.v2, radial.v2, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(other.suspects, said.suspects)
            assert other.decision is said.decision
            assert (loops.bound >= radial.bound).all()
            assert (loops.bound <= 1.3 * radial.bound).all()
        assert other.decision is Decision.ATTACKED

    def test_every_observer_is_that_of_its_phase(self) -> None:
        """Who leaves out meters of one phase is there the balanced observer, and elsewhere trusts all."""
        one = alike(6, 0)
        whole = apart(one)
        alone, both = (
            banks.design(close_loop(each.feeder, each.droop, each.meters), 1) for each in (one, whole)
        )
        rng, everyone = np.random.default_rng(4), np.ones(3 * CUSTOMERS, dtype=np.bool_)
        states, state = [None] * 3, None
        for h in (0.0, 1.0, 1.0, 900.0):
            z, w = rng.uniform(-0.08, 0.08, (2, 3, CUSTOMERS))
            if state is None:
                states = [banks.init(alone, *each, everyone[:CUSTOMERS]) for each in zip(z, w, strict=True)]
                state = banks.init(both, z.ravel(), w.ravel(), everyone)
            else:
                states = [
                    banks.step(alone, before, *each, everyone[:CUSTOMERS], h)
                    for before, *each in zip(states, z, w, strict=True)
                ]
                state = banks.step(both, state, z.ravel(), w.ravel(), everyone, h)
        masks = alone.masks
        for index, mask in enumerate(both.masks):
            found = banks.estimate(both, state, index).reshape(3, CUSTOMERS)
            for k, part in enumerate(mask.reshape(3, CUSTOMERS)):
                same = np.flatnonzero((masks == part).all(axis=1))
                number = -1 if part.all() else int(same[0])
                np.testing.assert_allclose(
                    found[k], banks.estimate(alone, states[k], number), rtol=0, atol=1e-9
                )


def lied(
    street: Street, design: object, family: ModuleType, liars: tuple[int, ...], ticks: int
) -> list[bool]:
    """Watch a street whose liars lie by a little more than is surely named; who was named at last."""
    state, sure = family.init(design, 1000.0), np.zeros(street.plant.meters.size)
    sign = street.rng.choice([-1.0, 1.0], len(liars))
    threshold = np.full(sure.size, 0.03)
    for tick in range(ticks):
        street.advance(1.0)
        honest = street.truth()[street.plant.meters]
        # From the true voltage the lie has to be larger by what the meter itself is off.
        size = {j: s * 1.6 * threshold[j] / honest[j] for j, s in zip(liars, sign, strict=True)}
        frame = street.frame(size if tick > 5 else {})
        state, estimate, verdict = family.step(design, state, frame)
        threshold = verdict.threshold
        assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
        assert set(np.flatnonzero(verdict.suspects)) <= set(liars)
        sure += np.abs(frame.y - honest) > 2.0 * threshold
        assert verdict.suspects[sure >= 2].all()
        assert tick <= 5 or verdict.decision is not Decision.CLEAN
    return [bool(verdict.suspects[j]) for j in liars]


class TestCoupledPhases:
    @pytest.mark.canary("liars0", "liars7", "liars14", "liars20", "liars27")
    @pytest.mark.parametrize("liars", [liars for k in (1, 2) for liars in combinations(range(7), k)])
    def test_every_set_of_liars_is_named_and_nobody_else(self, liars: tuple[int, ...]) -> None:
        rng = np.random.default_rng(liars)
        plant = coupled(len(liars))
        street = PhasedStreet(plant, rng, extreme=True)
        design = exact_bank.design(plant, max_attacked=2, step_s=1.0)
        assert all(lied(street, design, exact_bank, liars, 11))

    @pytest.mark.canary("None-gridsec.estimators.windowed", "5-gridsec.estimators.unknown_input")
    @pytest.mark.parametrize("family", [windowed, set_search, partial, unknown_input])
    @pytest.mark.parametrize("liar", [None, 0, 5])
    def test_other_families_name_the_liar_alone(self, family: ModuleType, liar: int | None) -> None:
        plant = coupled(3)
        street = PhasedStreet(plant, np.random.default_rng(8), extreme=True)
        more = {"length": 5} if family is windowed else {}
        design = family.design(plant, max_attacked=1, step_s=1.0, **more)
        state = family.init(design, 1000.0)
        said = []
        for tick in range(24):
            street.advance(1.0)
            frame = street.frame({liar: 0.1} if liar is not None and tick > 9 else {})
            state, estimate, verdict = family.step(design, state, frame)
            said.append(verdict.decision)
            assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
            assert set(np.flatnonzero(verdict.suspects)) <= {liar}
            if liar is not None and tick > 9:
                assert verdict.decision is not Decision.CLEAN or tick < 16
        if liar is not None:
            assert said[-1] is Decision.ATTACKED
        elif family is unknown_input:
            # Inverters of a single phase are small against what is not known of the loads.
            assert said[-1] is Decision.UNDECIDED
            assert "too coarse to judge the inverter" in verdict.reason
        else:
            assert said[-1] is Decision.CLEAN

    @pytest.mark.parametrize("family", [exact_bank, windowed, set_search, partial, unknown_input])
    def test_without_a_phase_of_the_busbar_nothing_is_clean(self, family: ModuleType) -> None:
        plant = coupled(2, customers=9)
        street = PhasedStreet(plant, np.random.default_rng(3), extreme=True)
        more = {"length": 3} if family is windowed else {}
        design = family.design(plant, max_attacked=1, step_s=1.0, **more)
        state = family.init(design, 1000.0)
        for tick in range(18):
            street.advance(1.0)
            frame = street.frame()
            lost = tick >= 9
            if lost:
                v0 = np.where(np.arange(3) == 1, (np.nan, 0.0, np.inf)[tick % 3], frame.v0_phases)
                frame = replace(frame, v0_phases=None if tick == 12 else v0)
            state, estimate, verdict = family.step(design, state, frame)
            assert not verdict.suspects.any()
            assert (np.abs(estimate.v2 - street.truth()) <= estimate.bound).all()
            if lost:
                assert verdict.decision is Decision.UNDECIDED
                assert verdict.cause is Cause.NO_BUSBAR
        assert isinstance(plant.feeder, PhasedFeeder)
        here = plant.feeder.bus[plant.meters] % 3 == 1
        # The others keep theirs.
        assert verdict.threshold[~here].max() < verdict.threshold[here].min()

    @pytest.mark.canary("gridsec.estimators.exact_bank")
    @pytest.mark.parametrize("family", [exact_bank, windowed, set_search, partial, unknown_input])
    def test_absurd_frames_get_an_answer(self, family: ModuleType) -> None:
        plant = coupled(2)
        street = PhasedStreet(plant, np.random.default_rng(3), metered_q=np.arange(0, 7, 2))
        design = family.design(plant, max_attacked=1, step_s=1.0)
        rng, absurd = np.random.default_rng(8), np.array([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, 1.0])
        names = ("y", "p", "q", "p_error", "q_error", "q_net", "q_net_error", "v0_phases")
        state = family.init(design, 1000.0)
        for tick in range(30):
            street.advance(1.0 if tick % 3 else 900.0)
            frame = street.frame()
            broken = {
                name: np.where(rng.random(value.shape) < 0.2, rng.choice(absurd, value.shape), value)
                for name, value in ((name, getattr(frame, name)) for name in names)
            }
            state, estimate, verdict = family.step(design, state, replace(frame, **broken))
            assert np.isfinite(estimate.v2).all()
            assert not np.isnan(estimate.bound).any()
            assert verdict.decision is not Decision.CLEAN
        again = family.step(design, state, frame)[2]
        assert again.decision is Decision.UNDECIDED

    @pytest.mark.canary("0", "17")
    @pytest.mark.parametrize("seed", range(18))
    def test_random_streets_with_errors_at_their_ends(self, seed: int) -> None:
        """Any spacing of readings, lost readings, metered reactive power, unequal phases, lies that jump."""
        rng = np.random.default_rng([seed, 99])
        family = (exact_bank, set_search, partial)[seed % 3]
        plant = coupled(seed, customers=int(rng.integers(5, 9)), drop=float(rng.choice([0.02, 0.04, 0.06])))
        errors_at_their_ends(family, plant, rng, seed)
