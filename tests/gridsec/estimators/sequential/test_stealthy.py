"""A third of the meters lies within every single meter's limit: linear programs against the monitor."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import _stealthy
from benchmarks._scenes import Model, Setting, neighbours, site
from benchmarks.stealthy_lies import LARGE_VOLT, calm, chosen, run
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
