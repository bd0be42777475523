"""Who was not believed, and goes on not to be when a monitor begins anew on a street with AC power flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec import sequential
from gridsec.online import Decision
from gridsec.sequential import Distrust, SequentialDesign, distrusted, init, nobody, renew, restore
from tests.gridsec.sequential.test_monitor import Answers, prepare, watch
from tests.gridsec.street import Street, make_plant

P, M = 12, 5
LIARS = (2, 7)


@pytest.fixture(scope="module")
def begun() -> tuple[SequentialDesign, Street]:
    rng = np.random.default_rng(4)
    plant = make_plant(rng, customers=P, drop=0.03, inverters=np.arange(M))
    return prepare(plant), Street(plant, rng)


def _suspects(answers: Answers) -> list[tuple[int, ...]]:
    return [tuple(np.flatnonzero(verdict.suspects).tolist()) for _, verdict in answers]


def test_liars_stay_named_and_are_forgotten_when_they_stop(begun: tuple[SequentialDesign, Street]) -> None:
    design, street = begun
    state, _ = watch(street, design, 30, lies=dict.fromkeys(LIARS, 0.04))
    before = distrusted(design, state)
    assert np.flatnonzero(before.named).tolist() == list(LIARS)
    assert np.flatnonzero(np.isfinite(before.scale_s)).tolist() == list(LIARS)
    again = restore(design, init(design, street.t), before)
    assert distrusted(design, again).same(replace(before, inverters=np.zeros(M, dtype=np.bool_)))
    again, answers = watch(street, design, 30, state=again, lies=dict.fromkeys(LIARS, 0.04))
    assert set(_suspects(answers)) == {LIARS}
    assert {verdict.decision for _, verdict in answers} == {Decision.ATTACKED}
    again = restore(design, init(design, street.t), distrusted(design, again))
    _, answers = watch(street, design, 70, state=again)
    first = _suspects(answers).index(())
    assert first >= design.options.release
    assert set(_suspects(answers)[: design.options.release - 1]) == {LIARS}
    assert not any(_suspects(answers)[first:])
    assert answers[-1][1].decision is Decision.CLEAN


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(("scale_s", "readings"), [(5.0, 4), (15.0, 12), (70.0, 48)])
def test_a_scale_speaks_for_a_meter_once_it_has_readings_enough(
    begun: tuple[SequentialDesign, Street], scale_s: float, readings: int, *, named: bool
) -> None:
    """Readings, not ticks: a meter that was silent at first owes them still."""
    design, street = begun
    which = np.isin(np.arange(P), LIARS)
    before = Distrust(np.where(which, scale_s, np.nan), which & named, np.zeros(M, dtype=np.bool_))
    state = restore(design, init(design, street.t), before)
    readings = max(readings, int(state.trust.owed.max()))
    state, silent = watch(street, design, 10, state=state, silent=LIARS)
    state, early = watch(street, design, readings - 1, state=state)
    assert not any(verdict.decision is Decision.CLEAN for _, verdict in (*silent, *early))
    assert not state.trust.trusted[list(LIARS)].any()
    state, later = watch(street, design, design.options.release + 1 + 8, state=state)
    assert state.trust.trusted.all()
    assert later[-1][1].decision is Decision.CLEAN


def test_inverters_stay_named_until_they_can_be_judged(begun: tuple[SequentialDesign, Street]) -> None:
    design, street = begun
    inverters = np.arange(M) == 1
    before = replace(nobody(P, M), inverters=inverters)
    state, answers = watch(street, design, 80, state=restore(design, init(design, street.t), before))
    named = [tuple(np.flatnonzero(verdict.inverters).tolist()) for _, verdict in answers]
    last = named.index(())
    assert set(named[:last]) == {(1,)}
    assert 48 <= last <= 48 + 12
    assert not any(named[last:])
    assert distrusted(design, state).empty


def test_a_replaced_meter_owes_nothing(begun: tuple[SequentialDesign, Street]) -> None:
    design, street = begun
    which = np.isin(np.arange(P), LIARS)
    before = Distrust(np.where(which, 60.0, np.nan), which, np.zeros(M, dtype=np.bool_))
    state = renew(design, restore(design, init(design, street.t), before), np.arange(P) == LIARS[0])
    assert distrusted(design, state).same(before.without(np.arange(P) == LIARS[0]))
    assert state.trust.owed[LIARS[0]] == 0
    _, _, verdict = sequential.step(design, state, street.frame())
    assert np.flatnonzero(verdict.suspects).tolist() == [LIARS[1]]


def test_nobody_is_nothing_to_restore(begun: tuple[SequentialDesign, Street]) -> None:
    design, street = begun
    state = init(design, street.t)
    assert restore(design, state, nobody(P, M)) is state
