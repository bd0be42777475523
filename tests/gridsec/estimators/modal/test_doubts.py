"""Unknown directions of a tick: exact in the filter, harmless over time, conditioned on in the estimate."""

from __future__ import annotations

import numpy as np

from benchmarks._residuals import Dense, Source, power_columns, tree
from gridsec.arrays import Floats
from gridsec.estimators.modal import core, doubts, full, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.doubts import Unknown
from gridsec.estimators.modal.model import modes
from tests.gridsec.estimators.modal.test_core import MODEL
from tests.gridsec.estimators.modal.test_filter import proportional

COLUMN = power_columns(tree(12, np.random.default_rng(3)))[:, [7]]
"""Effect of one customer's active power on the meters."""
POWER = 0.03
"""An unread power, pu: 3 kW."""


def test_the_filter_is_the_dense_one_with_more_noise() -> None:
    """At ticks with an unknown direction the white errors have ``D + U U'``."""
    model = proportional()
    made, dense, source = modes(model), Dense(model), Source(model, np.random.default_rng(4))
    state, known, plain = modal.start(made, 0.0), static.start(made), dense.D
    for k in range(30):
        m, U = source.tick(), 0.02 * np.random.default_rng(k).standard_normal((12, 2))
        open_ = k % 3 == 1
        dense.D = plain + U @ U.T if open_ else plain
        seen = None if k % 2 else np.arange(12) != k % 12
        dense.step(1.0 if k else 0.0, m, seen)
        state, known, _ = full.step(made, state, known, float(k), m, seen, unknown=U if open_ else None)
    assert state.full is not None
    assert np.allclose(state.full.mean, np.stack([dense.varies, dense.lasts]), atol=1e-9)


def played(unknown: Floats | None, error: Floats, ticks: int = 400) -> float:
    """Largest log M of honest readings with a lasting error of the residuals."""
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e6)
    source, state, most = Source(MODEL, np.random.default_rng(9)), core.init(kernel, 0.0), -np.inf
    for k in range(ticks):
        m = source.tick() + error * (k >= 100)
        state, evidence = core.step(kernel, state, float(k), m, None, unknown if k >= 100 else None)
        most = max(most, evidence.log_m)
    return most - kernel.limit


def test_a_lasting_error_along_an_unknown_direction_is_no_evidence() -> None:
    """3 unread kW for 300 ticks raise no alarm; without the direction they do."""
    error = POWER * COLUMN[:, 0]
    assert played(doubts.WIDER * POWER * COLUMN, error) < 0.0
    assert played(None, error) > 0.0


def test_the_estimate_is_the_gaussian_one() -> None:
    """Mean and variance equal those of dense conditioning; unchecked readings widen the variance only."""
    made, random = modes(MODEL), np.random.default_rng(3)
    places, at = random.standard_normal((13, 2)) * 0.01, MODEL.meters
    given = Unknown(places, places[at], np.zeros(12, dtype=np.bool_))
    u, seen = 0.01 * random.standard_normal(12), np.arange(12) != 5
    mean, variance = doubts.estimated(made, given, u, seen)
    whole = np.block(
        [
            [places @ places.T, places @ places[at].T],
            [places[at] @ places.T, places[at] @ places[at].T + made.noise],
        ]
    )
    n = 13 + np.flatnonzero(seen)
    gain = np.linalg.solve(whole[np.ix_(n, n)], whole[n, :13]).T
    assert np.allclose(mean, gain @ u[seen])
    assert np.allclose(variance, np.diag(whole)[:13] - np.diag(gain @ whole[n, :13]), atol=1e-12)
    doubted = Unknown(places, places[at], np.arange(12) == 2)
    same, wider = doubts.estimated(made, doubted, u, seen)
    other, less = doubts.estimated(made, given, u, seen & (np.arange(12) != 2))
    assert np.allclose(same, mean)
    assert np.allclose(wider, less + (mean - other) ** 2)
    assert (wider >= variance - 1e-15).all()


def test_without_readings_nothing_is_known() -> None:
    """The variance is that of the directions."""
    places = np.ones((13, 1))
    given = Unknown(places, places[MODEL.meters], np.zeros(12, dtype=np.bool_))
    mean, variance = doubts.estimated(modes(MODEL), given, np.ones(12), np.zeros(12, dtype=np.bool_))
    assert not mean.any()
    assert np.allclose(variance, 1.0)
