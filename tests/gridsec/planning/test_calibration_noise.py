"""Noise of readings: the filter against dense covariances, what is learned against what was drawn."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.arrays import Bools, Floats
from gridsec.planning.calibration import Field, LoadErrors, Whitening, increments, learn, whitening

P = 4


def field(rng: np.random.Generator) -> Field:
    A, B = (scale * rng.uniform(0.3, 1.0, (P, P)) for scale in (1e-2, 6e-3))
    return Field(A @ A.T, B @ B.T, 1e-8 * np.eye(P))


def scene(
    seed: int,
) -> tuple[Floats, Bools, Floats, Floats, Floats, list[Floats], Whitening]:
    """Seven frames at uneven times, some readings missing, powers of one frame unknown."""
    rng = np.random.default_rng(seed)
    S = LoadErrors(0.1, 0.1, 1.0, 1.0, np.zeros(4)).covariance(field(rng))
    t = np.cumsum(rng.uniform(10.0, 900.0, 7))
    seen = rng.random((7, P)) > 0.25
    seen[3] = False
    white = rng.uniform(1e-8, 4e-8, (7, P))
    common = rng.uniform(1e-4, 2e-4, (7, P, 2))
    gaps = [np.empty((P, 0))] * 7
    gaps[2] = 1e-3 * rng.standard_normal((P, 2))
    made = whitening(t, seen, S, time_s=300.0, white=white, common=common, gaps=gaps)
    return t, seen, S, white, common, gaps, made


@pytest.mark.parametrize("seed", range(3))
def test_whitened_columns_have_the_inner_products_of_the_dense_covariance(seed: int) -> None:
    t, seen, S, white, common, gaps, made = scene(seed)
    dense = np.kron(np.exp(-np.abs(np.subtract.outer(t, t)) / 300.0), S)
    for k in range(t.size):
        some = slice(k * P, (k + 1) * P)
        dense[some, some] += np.diag(white[k]) + common[k] @ common[k].T + gaps[k] @ gaps[k].T
    rows = seen.ravel()
    columns = np.random.default_rng(9).standard_normal((t.size, P, 3)) * seen[:, :, None]
    flat, whitened = columns.reshape(-1, 3)[rows], made(columns).reshape(-1, 3)
    expected = flat.T @ np.linalg.solve(dense[np.ix_(rows, rows)], flat)
    # Modes below a thousandth of the meters' noise are left out.
    np.testing.assert_allclose(whitened.T @ whitened, expected, rtol=3e-3, atol=3e-3 * np.abs(expected).max())


def test_missing_readings_have_no_influence() -> None:
    t, seen, *_, made = scene(1)
    columns = np.ones((t.size, P, 1))
    other = np.where(seen[:, :, None], columns, 77.0)
    np.testing.assert_array_equal(made(columns), made(other))


def drawn(seed: int, true: LoadErrors, given: Field, white: Floats) -> tuple[Floats, Bools, Floats]:
    """An Ornstein-Uhlenbeck field every two minutes, with meters' noise and constant errors."""
    rng = np.random.default_rng(seed)
    count, step = 1200, 120.0
    L = np.linalg.cholesky(true.covariance(given))
    decay = np.exp(-step / true.time_s)
    state, out = rng.standard_normal(P), np.empty((count, P))
    for k in range(count):
        out[k] = L @ state
        state = decay * state + np.sqrt(1.0 - decay**2) * rng.standard_normal(P)
    out += true.white * np.sqrt(white) * rng.standard_normal(out.shape) + rng.normal(0.0, 1e-2, P)
    return step * np.arange(count), rng.random(out.shape) > 0.1, out


def test_sizes_and_correlation_time_are_learned_and_their_errors_cover() -> None:
    true = LoadErrors(0.1, 0.05, 600.0, 1.1, np.zeros(4))
    given, white = field(np.random.default_rng(0)), np.full(P, 1e-8)
    guess = LoadErrors(0.03, 0.03, 300.0, 1.0, np.zeros(4))
    z = []
    for seed in range(12):
        t, seen, residual = drawn(seed, true, given, white)
        found = learn(increments(t, seen, residual), given, white, np.zeros((P, P)), guess)
        ratios = (found.p / true.p, found.q / true.q, found.time_s / true.time_s, found.white / true.white)
        z.append(np.log(ratios) / found.std)
        assert abs(np.log(found.p / true.p)) < 0.2
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_what_cannot_be_seen_stays_as_uncertain_as_before() -> None:
    given, white = field(np.random.default_rng(0)), np.full(P, 1.0)
    t, seen, residual = drawn(3, LoadErrors(0.1, 0.05, 600.0, 1.0, np.zeros(4)), given, white)
    guess = LoadErrors(0.03, 0.03, 300.0, 1.0, np.zeros(4))
    found = learn(increments(t, seen, residual), given, white, np.zeros((P, P)), guess)
    assert found.std[0] > 2.0
    assert found.std[2] > 1.5
    assert found.white == pytest.approx(1.0, abs=0.05)
