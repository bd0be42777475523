"""A third of the meters lies within every single meter's limit: linear programs against the monitor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import _stealthy, adversary
from benchmarks._adversary import falsified, faults
from benchmarks._scenes import Model, Setting, neighbours, site
from benchmarks.stealthy_lies import LARGE_VOLT, calm, chosen, run
from feeders.registry import SEQUENTIAL
from gridsec.estimators.sequential import step
from gridsec.estimators.sequential.posterior import leave_one_out
from gridsec.estimators.sequential.time_scales import Scales, scale_test

CASES = [
    ("kerber-dorfnetz", "contiguous", 0.5),
    ("kerber-dorfnetz", "greedy", 0.7),
    ("simbench-lv-rural3", "contiguous", 0.5),
    ("kerber-vorstadtnetz", "contiguous", 0.7),
]


@pytest.mark.canary("kerber-dorfnetz-contiguous-0.5")
@pytest.mark.parametrize(("feeder", "how", "share"), CASES)
def test_a_large_error_of_a_stealthy_third_is_not_clean(feeder: str, how: str, share: float) -> None:
    played = run(Setting(feeder, Model.MATCHED, learned=True, seed=1), how, share)
    assert played.lie > LARGE_VOLT
    assert played.late_error <= LARGE_VOLT
    assert played.honest == 0


def test_no_single_meter_is_over_its_limit_under_the_lie() -> None:
    """The program's lie added to the means stays below the share of all limits, by the monitor's own view."""
    setting = Setting("kerber-dorfnetz", Model.MATCHED, learned=True, seed=2)
    made, state, _ = calm(setting)
    given = _stealthy.linear_tests(made, state)
    where = site(setting.feeder)
    lie = chosen(where, given, "contiguous", 0.6, 2)
    first = int(np.argmax(given.fits[-1].prior.variance[given.buses]))
    assert np.array_equal(lie.meters, np.sort(neighbours(where, first)[: where.meters.size // 3]))
    assert np.count_nonzero(lie.lie) <= lie.meters.size
    scales = Scales(made, state.uncertainty, state.window, state.learned, state.model_error)
    for s, now in enumerate(given.fits):
        view = scale_test(made, scales[s], leave_one_out(now, lie.lie))
        assert (np.abs(view.loo.residual) <= (0.6 + 1e-6) * view.limit).all()
    error = abs(leave_one_out(given.fits[-1], lie.lie).mean).max()
    assert error >= lie.error * (1.0 - 1e-9) > 0.02


@pytest.mark.canary("cigre-lv-misfit")
@pytest.mark.parametrize("attack", ["misfit", "restart", "scattered"])
@pytest.mark.parametrize("feeder", ["cigre-lv", "kerber-landnetz"])
def test_an_optimised_third_is_clean_up_to_twice_the_unavoidable_minimum(feeder: str, attack: str) -> None:
    scene = adversary.Scene(adversary.KINDS[attack], feeder, 1, SEQUENTIAL)
    plays = [scene.play(adversary.step, *one) for one in scene.attacks(adversary.step)]
    assert [one.share for one in plays] == list(adversary.SHARES)
    # The first seconds after a restart are UNDECIDED.
    within = next(one for one in plays if one.share == 0.6)
    assert within.clean >= (90.0 if attack == "restart" else 100.0)
    assert within.ratio > 0.5
    assert plays[-1].clean <= 5.0
    assert max(one.ratio for one in plays) <= 2.2
    assert all(one.honest == 0 for one in plays)


def test_faults_move_the_residuals_of_the_monitor_as_stated() -> None:
    """False voltages, powers and busbar in a frame of AC power flow, against the linear signature."""
    setting = Setting("kerber-landnetz", Model.MATCHED, learned=True, seed=2)
    made, state, frame = calm(setting)
    where, meters = site(setting.feeder), np.array([1, 4, 9])
    given = faults(where, made, frame, meters, powers=True, busbar=True)
    assert (given.least <= 0.0).all()
    assert (given.most >= 0.0).all()
    amounts = np.array([0.01, -0.01, 0.005, -0.02, 0.01, -0.03, 0.004])
    later = replace(frame, t=frame.t + 1.0)
    seen = falsified(later, made, meters, amounts, powers=True, busbar=True)
    (honest, before, _), (false, after, _) = step(made, state, later), step(made, state, seen)
    moved = false.window.residuals[-1] - honest.window.residuals[-1]
    expected = given.signature @ amounts
    np.testing.assert_allclose(moved, expected, atol=0.03 * np.abs(expected).max())
    # The longest mean holds one such tick; the model moves at once.
    shift = given.effect[where.feeder.bus] @ amounts
    np.testing.assert_allclose(after.v2 - before.v2, shift, atol=0.15 * np.abs(shift).max())
