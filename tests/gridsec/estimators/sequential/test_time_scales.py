"""Fits made from one another: the same as made anew."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks._scenes import Model, Setting
from benchmarks.stealthy_lies import calm
from gridsec.arrays import Bools
from gridsec.estimators.sequential import time_scales
from gridsec.estimators.sequential.posterior import (
    Posterior,
    Prior,
    condition,
    leave_one_out,
    remove_meter,
)
from gridsec.estimators.sequential.search import Limits
from gridsec.estimators.sequential.time_scales import (
    ScaleData,
    Scales,
    inconsistent,
    load_scores,
    score_limit,
    update_posterior,
)
from gridsec.grid.network import Power
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


# --- scores of the customers' powers ------------------------------------------------------------


def test_scores_are_those_of_generalised_least_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    """The score is the least-squares amount of one power over its standard deviation."""
    made, state, _ = calm(Setting("simbench-lv-rural1", Model.MATCHED, learned=True, seed=0))
    scales = Scales(made, state.uncertainty, state.window, state.learned, state.model_error)
    here, every = scales[3], np.ones(made.fixed.size, dtype=np.bool_)
    now, m = condition(here.prior, here.noise, every), np.random.default_rng(1).normal(size=every.size)
    R = made.sensitivities.columns(Power.ACTIVE, np.arange(made.customers))[here.prior.meters]
    V = here.prior.between + np.diag(here.noise)

    def largest(some: Bools) -> float:
        half = np.linalg.inv(np.linalg.cholesky(V[np.ix_(some, some)]))
        fits = [np.linalg.lstsq((half @ R[some])[:, [k]], half @ m[some]) for k in range(made.customers)]
        white = np.linalg.norm(half @ R[some], axis=0)
        return max(abs(float(fit[0][0])) * norm for fit, norm in zip(fits, white, strict=True) if norm > 1e-9)

    found = load_scores(made, now, None, leave_one_out(now, m))
    assert found is not None
    assert found.largest == pytest.approx(largest(every), rel=1e-6)
    assert found.count == made.customers
    few = every.copy()
    few[[2, 5]] = False
    part = condition(here.prior, here.noise, few)
    # Beside the posterior of all meters the information is theirs: at least that of the others.
    beside = load_scores(made, part.copy(), now, leave_one_out(part, m))
    alone = load_scores(made, part, None, leave_one_out(part, m))
    assert beside is not None
    assert alone is not None
    assert beside.largest <= alone.largest == pytest.approx(largest(few), rel=1e-6)
    none = condition(here.prior, here.noise, ~every)
    assert load_scores(made, now.copy(), none, leave_one_out(now, m)) == found
    monkeypatch.setattr(time_scales, "MAX_SCORED", 5)
    assert load_scores(made, now, None, leave_one_out(now, m)) is None


def test_the_trace_of_a_load_is_inconsistent_before_the_misfit_is() -> None:
    made, state, _ = calm(Setting("simbench-lv-rural1", Model.MATCHED, learned=True, seed=0))
    scales = Scales(made, state.uncertainty, state.window, state.learned, state.model_error)
    here, every = scales[3], np.ones(made.fixed.size, dtype=np.bool_)
    now, tail = condition(here.prior, here.noise, every), made.tails[3]
    trace = made.sensitivities.columns(Power.ACTIVE, np.array([made.customers - 1]))[here.prior.meters, 0]
    for size, seen in ((0.98, False), (1.02, True)):
        amount = size * score_limit(made.customers, 0.5 * tail) / np.sqrt(trace @ now.Q @ trace)
        loo = leave_one_out(now, amount * trace)
        scores = load_scores(made, now, None, loo)
        assert inconsistent(now, loo, scales.model, tail, scores) is seen
        assert not inconsistent(now, loo, scales.model, tail)
