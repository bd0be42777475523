"""The estimator `modal` on inverters that leave their curves, and on false reactive powers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest

from feeders.model.site import load
from feeders.registry import MODAL, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, frames
from feeders.studies.comparison import LIVELY
from gridsec.interface import Cause, Decision, Frame, Verdict

ONSET = 30
LIVE, WATCHED = 40, 80
"""Ticks from which on a lasting deviation is reported, and ticks of a run."""


def trial(seed: int, *, metered: bool, manipulated: bool = True) -> Trial:
    """The smallest rural feeder; one inverter injects its rating besides."""
    lie = AttackSpec(AttackKind.INVERTER, 1, 100.0, float(ONSET)) if manipulated else None
    return Trial(
        load("simbench-lv-rural1"),
        seed=seed,
        duration_s=150.0,
        load_error=LoadError(0.1, 0.05),
        meters=TrialMeterErrors.SITE,
        variation=LIVELY,
        report_q=metered,
        lie=lie,
    )


@cache
def watched(seed: int, *, metered: bool) -> tuple[int, tuple[Verdict, ...]]:
    """The manipulated inverter, and all verdicts."""
    of = trial(seed, metered=metered)
    played = list(islice(frames(of), WATCHED))
    return int(np.flatnonzero(played[-1][1].inverters)[0]), verdicts(of, [frame for frame, _ in played])


def verdicts(of: Trial, given: list[Frame]) -> tuple[Verdict, ...]:
    """Verdicts of the monitor on some frames."""
    made = design(choose(of.stated, estimator=MODAL, max_attacked=2))
    state, out = made.init(given[0].t), []
    for frame in given:
        state, _, verdict = made.step(state, frame)
        out.append(verdict)
    return tuple(out)


def test_an_inverter_off_its_curve_is_named_by_its_metered_power() -> None:
    """All voltages fit the report, and not the curve."""
    which, told = watched(1, metered=True)
    assert not any(each.suspects.any() or each.inverters.any() for each in told[:ONSET])
    last = told[-1]
    assert (last.decision, last.cause) == (Decision.ATTACKED, Cause.RESIDUALS)
    assert np.flatnonzero(last.inverters).tolist() == [which]
    assert last.inverter_attack[which] != 0.0
    assert not last.suspects.any()
    assert not last.unjudged.any()


@pytest.mark.canary("0")
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_where_the_voltages_do_not_tell_both_are_reported(seed: int) -> None:
    """Small effects: the inverter or the report, never CLEAN and no name."""
    which, told = watched(seed, metered=True)
    assert all(each.decision is not Decision.CLEAN for each in told[LIVE:])
    last = told[-1]
    assert (last.decision, last.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
    assert not last.inverters.any()
    assert any(each.inverters[which] for each in last.explanations)
    assert any(each.powers.any() for verdict in told for each in verdict.explanations)


def test_a_false_reactive_power_names_no_inverter() -> None:
    """The inverter follows its curve; its customer's report is off by as much as the manipulation above."""
    of = trial(1, metered=True, manipulated=False)
    customer = int(of.stated.droop.customer[2])
    given = []
    for k, (frame, _) in enumerate(islice(frames(of), WATCHED)):
        q = frame.q_net + (k >= ONSET) * 0.23 * (np.arange(frame.q_net.size) == customer)
        given.append(replace(frame, q_net=q))
    told = verdicts(of, given)
    assert not any(each.inverters.any() or each.suspects.any() for each in told)
    assert told[-1].decision is Decision.UNDECIDED
    assert any(each.powers[customer] for each in told[-1].explanations)


def test_without_metered_powers_the_inverters_are_judged_by_voltages() -> None:
    """An inverter with a large effect has an explanation; no meter is named."""
    which, told = watched(1, metered=False)
    assert not any(each.suspects.any() for each in told)
    some = [each for verdict in told for each in verdict.explanations]
    assert not some or any(each.inverters[which] for each in some)
