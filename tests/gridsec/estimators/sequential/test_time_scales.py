"""Fits made from one another: the same as made anew."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.sequential.posterior import Posterior, Prior, condition, remove_meter
from gridsec.estimators.sequential.search import Limits
from gridsec.estimators.sequential.time_scales import ScaleData, update_posterior
from tests.gridsec.estimators.sequential.test_posterior import problem


def scale(rng: np.random.Generator, meters: int) -> ScaleData:
    """Any scale on which all meters report."""
    _, prior, noise, m = problem(rng, meters + 3, meters)
    zero = np.zeros(meters)
    return ScaleData(prior, noise, m, zero == 0.0, Limits(3.0, zero, zero, zero))


def changed_to(before: Posterior, here: ScaleData, wanted: Bools) -> Posterior:
    """A fit of those wanted, looked at from all sides; the one before stays as it is."""
    kept, now = before.copy(), update_posterior(before, here, wanted, None)
    anew = condition(here.prior, here.noise, wanted)
    np.testing.assert_array_equal(now.trusted, wanted)
    np.testing.assert_allclose(now.Q, anew.Q, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(now.variance, anew.variance, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(before.Q, kept.Q)
    np.testing.assert_array_equal(before.trusted, kept.trusted)
    return now


@pytest.mark.parametrize("seed", range(20))
def test_however_many_fall_or_come_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    here, now = scale(rng, 12), None
    for _ in range(12):
        wanted = rng.random(12) < rng.choice([0.3, 0.8, 1.0])
        before = condition(here.prior, here.noise, wanted) if now is None else now
        now = changed_to(before, here, wanted)


def test_many_that_fall_are_taken_off_a_fit_just_factorised_only() -> None:
    """Rounding does not gather: after other changes it is made anew."""
    rng = np.random.default_rng(2)
    here, every = scale(rng, 12), np.arange(12)
    whole = condition(here.prior, here.noise, every >= 0)
    assert changed_to(whole, here, every >= 3).updates == 3
    worn = whole.copy()
    remove_meter(worn, 11)
    assert changed_to(worn, here, (every >= 3) & (every < 11)).updates == 0
    # Nor where somebody is admitted as well.
    part = condition(here.prior, here.noise, every >= 2)
    assert changed_to(part, here, (every >= 4) | (every == 0)).updates == 0
    assert changed_to(whole, here, every >= 5).updates == 0


def test_who_falls_from_exact_meters_is_not_taken_off() -> None:
    """Rounding would take too much of what they leave open: a fit is made anew."""
    rng = np.random.default_rng(3)
    root, zero, every = rng.normal(size=(12, 3)), np.zeros(12), np.arange(12)
    S = root @ root.T
    for exact, changes in ((1e-5, 3), (1e-8, 0)):
        noise = np.full(12, exact * float(S.diagonal().max()))
        prior = Prior(S, every, S.diagonal().copy())
        here = ScaleData(prior, noise, zero, every >= 0, Limits(3.0, zero, zero, zero))
        now = update_posterior(condition(prior, noise, every >= 0), here, every >= 3, None)
        np.testing.assert_array_equal(now.trusted, every >= 3)
        assert now.updates == changes
        anew = condition(prior, noise, every >= 3)
        np.testing.assert_allclose(now.Q, anew.Q, rtol=1e-6, atol=1e-6 * np.abs(anew.Q).max())
