"""Conditioning by changes of rank one, against dense linear algebra made anew for every question."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential.posterior import (
    Posterior,
    Prior,
    add_meter,
    add_unknown,
    chi_square,
    condition,
    invert_spd,
    leave_one_out,
    remove_meter,
    updated,
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


def agrees(now: Posterior, S: Floats, m: Floats) -> None:
    loo = leave_one_out(now, m)
    w, variance, offset, std = expected(S, now.prior.meters, now.noise, m, now.trusted)
    np.testing.assert_allclose(loo.mean, w, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(now.variance, variance, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(loo.residual, offset, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(loo.std, std, rtol=1e-7, atol=1e-7)
    T = np.flatnonzero(now.trusted)
    at = now.prior.meters[T]
    whole = S[np.ix_(at, at)] + np.diag(now.noise[T])
    np.testing.assert_allclose(loo.chi_square, m[T] @ np.linalg.solve(whole, m[T]), rtol=1e-7, atol=1e-9)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), meters=st.integers(1, 9), extra=st.integers(0, 6))
def test_leave_one_out_is_leaving_one_out(seed: int, meters: int, extra: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, meters + extra, meters)
    agrees(condition(prior, noise, rng.random(meters) < 0.7), S, m)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), moves=st.integers(1, 30))
def test_any_sequence_of_moves_is_a_fit_of_where_it_ends(seed: int, moves: int) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, 9, 7)
    now = condition(prior, noise, rng.random(7) < 0.5)
    loo = leave_one_out(now, m)
    for _ in range(moves):
        j = int(rng.integers(7))
        if rng.random() < 0.2 and now.unknowns.shape[1] < 3:
            direction, std = rng.normal(size=9), float(rng.uniform(0.1, 2.0))
            loo = updated(now, m, loo, add_unknown(now, direction, std))
            S = S + std**2 * np.outer(direction, direction)
        else:
            loo = updated(now, m, loo, (remove_meter if now.trusted[j] else add_meter)(now, j))
    agrees(now, S, m)
    anew = leave_one_out(now, m)
    for name in ("weights", "residual", "std", "mean", "chi_square"):
        np.testing.assert_allclose(getattr(loo, name), getattr(anew, name), rtol=1e-7, atol=1e-7)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_dropping_lowers_the_misfit_by_the_square_of_the_normalised_offset(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, prior, noise, m = problem(rng, 8, 6)
    now = condition(prior, noise, np.ones(6, dtype=bool))
    before = leave_one_out(now, m)
    j = int(rng.integers(6))
    remove_meter(now, j)
    gain = (before.residual[j] / before.std[j]) ** 2
    np.testing.assert_allclose(
        before.chi_square - leave_one_out(now, m).chi_square, gain, rtol=1e-7, atol=1e-9
    )


def test_a_copy_does_not_change_with_its_original() -> None:
    rng = np.random.default_rng(3)
    S, prior, noise, m = problem(rng, 6, 5)
    one = condition(prior, noise, np.ones(5, dtype=bool))
    other = one.copy()
    remove_meter(one, 2)
    add_unknown(one, np.ones(6), 1.0)
    agrees(other, S, m)
    assert (one.updates, other.updates) == (2, 0)


def test_loosened_directions_may_be_given_at_once() -> None:
    rng = np.random.default_rng(4)
    S, prior, noise, m = problem(rng, 6, 5)
    directions = rng.normal(size=(6, 2))
    now = condition(prior, noise, np.ones(5, dtype=bool), directions)
    agrees(now, S + directions @ directions.T, m)


def test_nobody_trusted_leaves_the_prior() -> None:
    rng = np.random.default_rng(5)
    _, prior, noise, m = problem(rng, 6, 5)
    loo = leave_one_out(condition(prior, noise, np.zeros(5, dtype=bool)), m)
    assert loo.chi_square == 0.0
    np.testing.assert_array_equal(loo.residual, m)


def test_inverse_is_symmetric_and_an_inverse() -> None:
    rng = np.random.default_rng(6)
    root = rng.normal(size=(12, 12))
    matrix = root @ root.T + np.eye(12)
    inverse = np.array(matrix, order="F")
    invert_spd(inverse)
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
    now = condition(prior, noise, np.ones(10, dtype=bool))
    for j in rng.choice(10, int(rng.integers(2, 11)), replace=False).tolist():
        remove_meter(now, j)
    Q = now.Q.copy()
    now.compact()
    assert len(now.inverse) == np.count_nonzero(now.trusted)
    np.testing.assert_array_equal(now.Q, Q)
    agrees(now, S, m)
    again = now.copy()
    for j in np.flatnonzero(~now.trusted).tolist():
        add_meter(again, j)
    agrees(again, S, m)
    direction = rng.normal(size=12)
    add_unknown(now, direction, 0.5)
    agrees(now, S + 0.25 * np.outer(direction, direction), m)
    expected_misfit = leave_one_out(now, m).chi_square
    found = chi_square(prior, noise, m, now.trusted, 0.5 * direction[:, None])
    np.testing.assert_allclose(found, expected_misfit, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("silent", [0, 2])
def test_what_was_judged_stays_though_the_fit_is_changed(silent: int) -> None:
    """What the meters say of the buses may be asked for after others are believed."""
    rng = np.random.default_rng(6)
    _, prior, noise, m = problem(rng, 9, 6)
    trusted = np.arange(6) >= silent
    now = condition(prior, noise, trusted)
    add_unknown(now, rng.normal(size=9), 0.5)
    late, early = leave_one_out(now, m), leave_one_out(now, m)
    w, misfit = early.mean.copy(), early.chi_square
    remove_meter(now, 4)
    add_unknown(now, rng.normal(size=9), 0.5)
    np.testing.assert_array_equal(late.mean, w)
    assert late.mean is late.mean
    assert late.chi_square == misfit
    assert not np.allclose(leave_one_out(now, m).mean, w)
