"""Inverters of the model with false readings at their inputs, against the injections of an honest run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks._residuals import Dense, Source
from gridsec.arrays import Floats
from gridsec.estimators.front.state import InjectionError
from gridsec.estimators.modal import core, doubts, drive
from gridsec.estimators.modal.filter import Interval
from gridsec.estimators.modal.monitor import ModalDesign, ModalState, design, init, step
from gridsec.estimators.modal.verdict import Inputs, deviations
from gridsec.interface import Decision, Frame, Verdict
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.estimators.modal.test_core import MODEL
from tests.gridsec.street import Street, make_plant

ONSET, TICKS = 60, 110
LIE = 0.06
"""Squared voltage, pu: 3 %."""


def watched(lies: tuple[int, ...]) -> tuple[ModalDesign, list[tuple[ModalState, Verdict, Floats]]]:
    """Meters that read 3 % too high and too low by turns, with all states, verdicts and true injections."""
    plant = make_plant(np.random.default_rng(5), customers=12, drop=0.08)
    front, street = front_end(plant), Street(plant, np.random.default_rng(6))
    street.v0 = 0.95
    street.rest()
    made = design(plant, doubt=front.doubt, step_s=1.0)
    state, out = init(made, street.t), []
    for k in range(TICKS):
        street.advance(1.0)
        frame = street.frame()
        if k >= ONSET:
            frame = shifted(frame, lies, LIE if k % 2 else -LIE)
        state, _, verdict = step(made, state, frame)
        out.append((state, verdict, street.x.copy()))
    return made, out


def shifted(frame: Frame, meters: tuple[int, ...], by: float) -> Frame:
    y = frame.y.copy()
    y[list(meters)] += by
    return replace(frame, y=y)


@pytest.mark.parametrize("h", [1.0, 30.0, 900.0])
@pytest.mark.parametrize("silent", [False, True])
def test_innovations_are_those_of_the_dense_filter(silent: bool, h: float) -> None:
    """With complete and with missing readings before, at short and at long intervals."""
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e6)
    dense, source = Dense(MODEL), Source(MODEL, np.random.default_rng(4))
    state, seen = core.init(kernel, 0.0), np.ones(12, dtype=np.bool_)
    for k in range(30):
        m = source.tick()
        seen[3] = not (silent and k % 7 == 2)
        dense.step(1.0 if k else 0.0, m, seen)
        state, _ = core.step(kernel, state, float(k), m, None if seen.all() else seen)
    assert (state.filter.full is not None) == silent
    m = source.tick()
    found, std = deviations(kernel, state, m, Interval(h))
    nu, V = dense.step(h, m)
    assert np.allclose(found, nu, atol=1e-9)
    assert np.allclose(std, np.sqrt(V.diagonal()), rtol=1e-7)


@pytest.mark.canary("one")
@pytest.mark.parametrize("lies", [(4,), (4, 7, 9)], ids=["one", "a quarter"])
def test_readings_that_alternate_leave_the_injections_known(lies: tuple[int, ...]) -> None:
    """The model's injections stay within their stated errors, and these a part of what is possible."""
    made, told = watched(lies)
    front, droop, last = made.front, made.plant.droop, told[-1][0]
    at = np.isin(front.meter_of, lies)
    assert np.abs(told[-1][2][at]).max() > 0.003
    for state, _, x in told[ONSET:]:
        assert state.front.x is not None
        assert (np.abs(state.front.x - x) <= state.injections.error).all()
    usual = front.injections[droop.customer] + front.mismatch
    assert (last.injections.error < np.sqrt(3.0) * doubts.UNSETTLED * usual)[at].all()
    assert (last.injections.error < last.front.injection_error.error)[at].all()
    # At rest, K (sqrt(3) s + |change of the input|) + mismatch: the deviation of the estimate counts.
    before = told[-2][0]
    assert before.front.last is not None
    width = np.sqrt(3.0) * before.front.last[0].std[droop.customer]
    moved = np.abs(last.injections.input - before.injections.input)
    aim = droop.slope * (np.maximum(width, before.injections.width) + moved) + front.mismatch
    shown = (last.injections.error - np.exp(-1.0 / droop.tau) * before.injections.error)[at]
    assert np.allclose(shown, ((1.0 - np.exp(-1.0 / droop.tau)) * aim)[at])


@pytest.mark.canary("one")
@pytest.mark.parametrize("lies", [(4,), (4, 7, 9), (3, 4, 7, 9)], ids=["one", "a quarter", "a third"])
def test_readings_that_alternate_are_never_clean(lies: tuple[int, ...]) -> None:
    """No honest meter is named, and no tick from the first false reading on is CLEAN; some are named."""
    _, told = watched(lies)
    honest = ~np.isin(np.arange(12), lies)
    for _, verdict, _ in told[ONSET:]:
        assert verdict.decision is not Decision.CLEAN
        assert not (verdict.suspects & honest).any()
    assert told[-1][1].suspects.any()


def test_errors_of_injections_are_those_of_the_front_end_without_a_distrusted_meter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With equal errors before, those after are equal by the recursion, too."""
    plain, told = drive.followed, []

    def both(front: Any, before: Any, given: Any, now: Any, *rest: Any) -> InjectionError:
        out = plain(front, before, given, now, *rest)
        told.append((out, plain(front, replace(before), given, now, *rest), now.injection_error))
        return out

    monkeypatch.setattr(drive, "followed", both)
    watched(())
    for found, recursion, own in told:
        assert found is own
        for name in ("error", "input", "width"):
            assert np.allclose(getattr(found, name), getattr(recursion, name), rtol=1e-12)


@pytest.mark.canary("honest")
@pytest.mark.parametrize("lies", [(), (4, 7, 9)], ids=["honest", "a quarter"])
def test_the_answer_of_a_calm_tick_is_that_of_all_checks(
    lies: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    calm = [(each.decision, each.cause, each.reason) for _, each, _ in watched(lies)[1]]
    monkeypatch.setattr(Inputs, "calm", False)
    assert calm == [(each.decision, each.cause, each.reason) for _, each, _ in watched(lies)[1]]
    assert len(set(calm)) > 1
