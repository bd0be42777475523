"""Conditioning by changes of rank one, against dense linear algebra made anew for every question."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential.conditional import (
    Fit,
    Prior,
    admit,
    drop,
    fit,
    follow,
    invert,
    judge,
    loosen,
    misfit,
)


def problem(rng: np.random.Generator, buses: int, meters: int) -> tuple[Floats, Prior, Floats, Floats]:
    """A covariance of rank below full, meters anywhere, their noise and readings."""
    root = rng.normal(size=(buses, rng.integers(1, buses + 2)))
    S = root @ root.T
    at = rng.choice(buses, meters, replace=False)
    noise = rng.uniform(0.1, 2.0, meters)
    return S, Prior(S[:, at], at, S.diagonal().copy()), noise, rng.normal(size=meters) * 3.0


def expected(
    S: Floats, at: np.ndarray, noise: Floats, m: Floats, trusted: Bools
) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean and variance at all buses, offset and standard deviation of all meters, by definition."""
    T = np.flatnonzero(trusted)

    def conditioned(on: np.ndarray) -> tuple[Floats, Floats]:
        K = S[:, at[on]]
        gain = K @ np.linalg.inv(S[np.ix_(at[on], at[on])] + np.diag(noise[on])) if on.size else K
        return gain @ m[on], S - gain @ K.T

    w, M = conditioned(T)
    offset, std = np.empty(m.size), np.empty(m.size)
    for j in range(m.size):
        others = np.setdiff1d(T, [j])
        mean, rest = conditioned(others)
        offset[j] = m[j] - mean[at[j]]
        std[j] = np.sqrt(rest[at[j], at[j]] + noise[j])
    return w, M.diagonal(), offset, std


def agrees(now: Fit, S: Floats, m: Floats) -> None:
    judged = judge(now, m)
    w, variance, offset, std = expected(S, now.prior.meters, now.noise, m, now.trusted)
    np.testing.assert_allclose(judged.w, w, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(now.variance, variance, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(judged.offset, offset, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(judged.std, std, rtol=1e-7, atol=1e-7)
    T = np.flatnonzero(now.trusted)
    at = now.prior.meters[T]
    whole = S[np.ix_(at, at)] + np.diag(now.noise[T])
    np.testing.assert_allclose(judged.misfit, m[T] @ np.linalg.solve(whole, m[T]), rtol=1e-7, atol=1e-9)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), meters=st.integers(1, 9), extra=st.integers(0, 6))
def test_leave_one_out_is_leaving_one_out(seed: int, meters: int, extra: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, meters + extra, meters)
    agrees(fit(prior, noise, rng.random(meters) < 0.7), S, m)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), moves=st.integers(1, 30))
def test_any_sequence_of_moves_is_a_fit_of_where_it_ends(seed: int, moves: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, 9, 7)
    now = fit(prior, noise, rng.random(7) < 0.5)
    judged = judge(now, m)
    for _ in range(moves):
        j = int(rng.integers(7))
        if rng.random() < 0.2 and now.loose.shape[1] < 3:
            direction, std = rng.normal(size=9), float(rng.uniform(0.1, 2.0))
            judged = follow(now, m, judged, loosen(now, direction, std))
            S = S + std**2 * np.outer(direction, direction)
        else:
            judged = follow(now, m, judged, (drop if now.trusted[j] else admit)(now, j))
    agrees(now, S, m)
    anew = judge(now, m)
    for name in ("weights", "offset", "std", "w", "misfit"):
        np.testing.assert_allclose(getattr(judged, name), getattr(anew, name), rtol=1e-7, atol=1e-7)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_dropping_lowers_the_misfit_by_the_square_of_the_normalised_offset(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, prior, noise, m = problem(rng, 8, 6)
    now = fit(prior, noise, np.ones(6, dtype=bool))
    before = judge(now, m)
    j = int(rng.integers(6))
    drop(now, j)
    gain = (before.offset[j] / before.std[j]) ** 2
    np.testing.assert_allclose(before.misfit - judge(now, m).misfit, gain, rtol=1e-7, atol=1e-9)


def test_a_copy_does_not_change_with_its_original() -> None:
    rng = np.random.default_rng(3)
    S, prior, noise, m = problem(rng, 6, 5)
    one = fit(prior, noise, np.ones(5, dtype=bool))
    other = one.copy()
    drop(one, 2)
    loosen(one, np.ones(6), 1.0)
    agrees(other, S, m)
    assert (one.changes, other.changes) == (2, 0)


def test_loosened_directions_may_be_given_at_once() -> None:
    rng = np.random.default_rng(4)
    S, prior, noise, m = problem(rng, 6, 5)
    directions = rng.normal(size=(6, 2))
    now = fit(prior, noise, np.ones(5, dtype=bool), directions)
    agrees(now, S + directions @ directions.T, m)


def test_nobody_trusted_leaves_the_prior() -> None:
    rng = np.random.default_rng(5)
    _, prior, noise, m = problem(rng, 6, 5)
    judged = judge(fit(prior, noise, np.zeros(5, dtype=bool)), m)
    assert judged.misfit == 0.0
    np.testing.assert_array_equal(judged.offset, m)


def test_inverse_is_symmetric_and_an_inverse() -> None:
    rng = np.random.default_rng(6)
    root = rng.normal(size=(12, 12))
    matrix = root @ root.T + np.eye(12)
    inverse = np.array(matrix, order="F")
    invert(inverse)
    np.testing.assert_array_equal(inverse, inverse.T)
    np.testing.assert_allclose(inverse @ matrix, np.eye(12), atol=1e-9)
    assert prior_between_is_symmetric(rng)


def prior_between_is_symmetric(rng: np.random.Generator) -> bool:
    S, prior, _, _ = problem(rng, 7, 4)
    return bool(np.allclose(prior.between, S[np.ix_(prior.meters, prior.meters)]))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_fit_that_keeps_less_says_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, 12, 10)
    now = fit(prior, noise, np.ones(10, dtype=bool))
    for j in rng.choice(10, int(rng.integers(2, 11)), replace=False).tolist():
        drop(now, j)
    Q = now.Q.copy()
    now.shrink()
    assert len(now.inverse) == np.count_nonzero(now.trusted)
    np.testing.assert_array_equal(now.Q, Q)
    agrees(now, S, m)
    again = now.copy()
    for j in np.flatnonzero(~now.trusted).tolist():
        admit(again, j)
    agrees(again, S, m)
    direction = rng.normal(size=12)
    loosen(now, direction, 0.5)
    agrees(now, S + 0.25 * np.outer(direction, direction), m)
    expected_misfit = judge(now, m).misfit
    found = misfit(prior, noise, m, now.trusted, 0.5 * direction[:, None])
    np.testing.assert_allclose(found, expected_misfit, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("silent", [0, 2])
def test_what_was_judged_stays_though_the_fit_is_changed(silent: int) -> None:
    """What the meters say of the buses may be asked for after others are believed."""
    rng = np.random.default_rng(6)
    _, prior, noise, m = problem(rng, 9, 6)
    trusted = np.arange(6) >= silent
    now = fit(prior, noise, trusted)
    loosen(now, rng.normal(size=9), 0.5)
    late, early = judge(now, m), judge(now, m)
    w, misfit = early.w.copy(), early.misfit
    drop(now, 4)
    loosen(now, rng.normal(size=9), 0.5)
    np.testing.assert_array_equal(late.w, w)
    assert late.w is late.w
    assert late.misfit == misfit
    assert not np.allclose(judge(now, m).w, w)
