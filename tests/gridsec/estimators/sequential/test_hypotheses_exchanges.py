"""Inverters that could each be the one that does not follow its curve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.estimators import sequential
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt, SequentialOptions
from gridsec.estimators.sequential.hypotheses import fault_exchanges
from gridsec.estimators.sequential.posterior import LoadDoubt as Doubt
from gridsec.estimators.sequential.posterior import add_unknown, condition, leave_one_out, voltage_prior
from gridsec.estimators.sequential.search import Candidate, FaultDictionary
from gridsec.grid.devices import fleet
from gridsec.interface import Cause, Decision, Verdict
from tests.gridsec.street import BASE_KVA, Street, accuracy, make_plant, random_tree

ONSET, BOTH = 20, (7, 8)


class Stuck(Street):
    """From some tick on an inverter injects the least that it can, whatever its voltage."""

    stuck = -1

    def advance(self, h: float) -> None:
        super().advance(h)
        if self.stuck >= 0:
            self.x[self.stuck] = -self.plant.droop.limit[self.stuck]


def watched(
    liar: int, *, together: bool, metered: bool = False, silent: tuple[int, ...] = ()
) -> list[Verdict]:
    """Two inverters of 30 kVA at the end of a street, at one bus or two; one of them is stuck."""
    feeder = random_tree(9, np.random.default_rng(3), drop=0.06)
    if together:
        at = feeder.bus.copy()
        at[7] = at[8]
        feeder = replace(feeder, bus=at)
    meters = np.arange(9 if metered else 7)
    droop = fleet(np.array(BOTH), ["ieee1547-b"] * 2, np.full(2, 30.0), BASE_KVA)
    plant = Plant(feeder, droop, meters, accuracy(meters.size))
    doubt = LoadDoubt(np.full(9, 0.1 / BASE_KVA), np.full(9, 0.05 / BASE_KVA), 600.0)
    made = sequential.design(plant, doubt=doubt, step_s=1.0, options=SequentialOptions(commission_s=0.0))
    reported = np.arange(9) if metered else None
    street = Stuck(plant, np.random.default_rng(4), load_kw=0.5, wobble=0.0, metered_q=reported)
    street.bias[:] = street.busbar_bias = 0.0
    street.tan[:], street.p_bias[:] = 0.25, 0.0
    state, told = sequential.init(made, street.t), []
    for k in range(90):
        street.stuck = liar - BOTH[0] if k >= ONSET else -1
        street.advance(1.0)
        frame = street.frame(silent=silent if k >= ONSET else ())
        state, _, verdict = sequential.step(made, state, frame)
        told.append(verdict)
    return told


@pytest.mark.canary("False-7")
@pytest.mark.parametrize("liar", BOTH)
@pytest.mark.parametrize("together", [True, False])
def test_which_of_two_neighbours_it_is_is_not_guessed(liar: int, *, together: bool) -> None:
    """Nobody is named whom the voltages do not tell apart; that it is one of both is said, and goes on."""
    told = watched(liar, together=together)
    assert not any(each.inverters.any() or each.suspects.any() for each in told)
    first = next(k for k, each in enumerate(told) if each.explanations)
    assert first < ONSET + 40
    for each in told[first:]:
        assert (each.decision, each.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
        accused = np.array([way.inverters for way in each.explanations])
        assert accused.any(axis=0).all()
        assert sum(way.probability for way in each.explanations) == pytest.approx(1.0)


def test_explanations_accuse_nobody_who_was_not_heard() -> None:
    """Whose reading is missing is not manipulated for that."""
    ways = [way for each in watched(7, together=True, silent=(0, 3)) for way in each.explanations]
    assert any(way.inverters.any() for way in ways)
    assert not any(way.meters[[0, 3]].any() for way in ways)


@pytest.mark.parametrize("liar", BOTH)
def test_whose_injection_is_metered_is_told_apart(liar: int) -> None:
    """What both report of their reactive powers says which of them it is, though they are at one bus."""
    told = watched(liar, together=True, metered=True)
    assert not any(each.inverters[1 - (liar - BOTH[0])] for each in told)
    assert told[-1].inverters[liar - BOTH[0]]
    assert told[-1].decision is Decision.ATTACKED


def test_turns_are_what_the_misfit_rises_by() -> None:
    """Against fits in which one direction is loosened in place of the other, for all pairs."""
    rng = np.random.default_rng(8)
    plant = make_plant(rng, customers=10, drop=0.04)
    at = plant.feeder.bus[plant.meters]
    doubt = Doubt(np.full(10, 0.006), np.full(10, 0.002), 600.0)
    known = voltage_prior(plant.feeder, at, doubt, busbar=1e-3)
    noise, available = np.full(10, 0.01**2), np.ones(10, dtype=bool)
    available[3] = False
    columns = rng.normal(size=(11, 6)) * rng.uniform(0.02, 0.2, 6)
    std = rng.uniform(0.1, 2.0, 6)
    faults = FaultDictionary(
        std=std,
        charge=np.ones(6),
        size=(columns[at] ** 2).sum(axis=0),
        meter=np.full(6, -1),
        columns=lambda which: columns[:, which],
        weighted=lambda weights: weights @ columns[at],
    )
    m = 0.03 * rng.normal(size=10)

    def misfit(which: tuple[int, ...]) -> float:
        loose = columns[:, [5, *which]] * std[[5, *which]]
        return leave_one_out(condition(known, noise, available, loose), m).chi_square

    now = condition(known, noise, available, columns[:, [5]] * std[5])
    for k in (1, 4):
        add_unknown(now, columns[:, k], float(std[k]))
    found = Candidate(now.trusted, (1, 4), 0.0, 0.0, now, leave_one_out(now, m))
    every = fault_exchanges(found, faults, (1, 4, 2), np.arange(5), 1e9)
    assert {(one.accused, one.innocent) for one in every} == {(a, b) for a in (1, 4) for b in (0, 2, 3)}
    for one in every:
        which = (one.innocent, 4) if one.accused == 1 else (1, one.innocent)
        worse = misfit(which) - misfit((1, 4))
        assert one.worse == pytest.approx(max(worse, 0.0), rel=1e-6, abs=1e-8)
    assert [one.worse for one in every] == sorted(one.worse for one in every)
    median = float(np.median([one.worse for one in every]))
    assert len(fault_exchanges(found, faults, (1, 4), np.arange(5), median)) < len(every)
    assert fault_exchanges(found, faults, (2,), np.arange(5), 1e9) == []
