"""The robust start: against its own objective, and the short way against the long one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.sequential_step import Watched
from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential import hypotheses, identify
from gridsec.estimators.sequential import search as module
from gridsec.estimators.sequential.posterior import (
    LoadDoubt,
    Posterior,
    Prior,
    add_unknown,
    condition,
    remove_meter,
    voltage_prior,
)
from gridsec.estimators.sequential.search import Limits, covers, robust_set
from gridsec.estimators.sequential.time_scales import ScaleData
from tests.gridsec.street import random_tree

SEEDS = st.integers(0, 2**32 - 1)


def street(rng: np.random.Generator, customers: int) -> Prior:
    """What errors of 0.6 kW do to the voltages of a random tree."""
    tree = random_tree(customers, rng, drop=0.04)
    doubt = LoadDoubt(np.full(customers, 0.006), np.full(customers, 0.002), 600.0)
    return voltage_prior(tree, np.arange(1, customers + 1), doubt, busbar=4e-4)


def readings(rng: np.random.Generator, p: Prior, noise: Floats, lie: float) -> tuple[Floats, Bools]:
    """A third of the meters lie."""
    w = rng.multivariate_normal(np.zeros(noise.size), p.between)
    m = w + np.sqrt(noise) * rng.normal(size=noise.size)
    suspects = np.zeros(noise.size, dtype=np.bool_)
    suspects[rng.choice(noise.size, noise.size // 3, replace=False)] = True
    return np.asarray(m + lie * rng.choice([-1.0, 1.0], noise.size) * suspects), suspects


@given(seed=SEEDS, count=st.integers(3, 24), silent=st.integers(0, 8), lie=st.floats(1e-4, 0.2))
@settings(max_examples=150, deadline=None)
def test_from_a_fit_of_all_the_same_are_trusted(seed: int, count: int, silent: int, lie: float) -> None:
    rng = np.random.default_rng(seed)
    p, noise = street(rng, count), rng.uniform(0.5, 2.0, count) * 0.002**2
    m, _ = readings(rng, p, noise, lie)
    before, available = np.ones(count, dtype=np.bool_), np.ones(count, dtype=np.bool_)
    before[rng.choice(count, min(silent // 2, count - 2), replace=False)] = False
    available &= before
    available[rng.choice(count, min(silent, count - 2), replace=False)] = False
    whole, bound = condition(p, noise, before), rng.uniform(1.5, 4.0, count) * np.sqrt(noise)
    assert covers(whole, p, noise, available)
    np.testing.assert_array_equal(
        robust_set(p, noise, m, available, bound, whole), robust_set(p, noise, m, available, bound)
    )


@given(seed=SEEDS, count=st.integers(2, 24))
@settings(max_examples=100, deadline=None)
def test_what_is_left_is_that_of_a_dense_fit_with_weights(seed: int, count: int) -> None:
    """Oracle: a weight is a variance divided by it, and a weight of zero a meter less."""
    rng = np.random.default_rng(seed)
    p, noise = street(rng, count), rng.uniform(0.5, 2.0, count) * 0.002**2
    m, _ = readings(rng, p, noise, 0.05)
    weight = rng.choice([0.0, 1e-7, 1e-3, 0.5, 1.0 - 1e-12, 1.0], count)
    use = np.flatnonzero(weight > module._LEAST_WEIGHT)
    whole = p.between[np.ix_(use, use)] + np.diag(noise[use] / weight[use])
    expected = m - p.between[:, use] @ np.linalg.solve(whole, m[use])
    long = module._weighted_residual(p.among(np.arange(count)), noise, m, weight)
    short = module._residual_by_posterior(
        condition(p, noise, np.ones(count, dtype=np.bool_)), m, np.arange(count)
    )(weight)
    np.testing.assert_allclose(long, expected, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(short, expected, rtol=1e-8, atol=1e-11)


def test_meters_that_are_silent_now_do_not_matter() -> None:
    rng = np.random.default_rng(4)
    p, noise = street(rng, 20), np.full(20, 0.002**2)
    m, suspects = readings(rng, p, noise, 0.06)
    whole, available = condition(p, noise, np.ones(20, dtype=np.bool_)), np.arange(20) != 3
    m[3] = 1e3
    got = robust_set(p, noise, m, available, 3.0 * np.sqrt(noise), whole)
    np.testing.assert_array_equal(got, robust_set(p, noise, m, available, 3.0 * np.sqrt(noise)))
    np.testing.assert_array_equal(got, available & ~suspects)


@pytest.mark.parametrize("what", ["prior", "noise", "silent", "change", "direction"])
def test_a_fit_of_something_else_covers_nothing(what: str) -> None:
    rng = np.random.default_rng(5)
    p, noise, available = street(rng, 8), np.full(8, 0.002**2), np.ones(8, dtype=np.bool_)
    whole = condition(p, noise, available)
    assert covers(whole, p, noise, available)
    if what == "prior":
        assert not covers(whole, p.with_direction(np.full(p.variance.size, 0.1)), noise, available)
    elif what == "noise":
        assert not covers(whole, p, 2.0 * noise, available)
    elif what == "silent":
        assert not covers(condition(p, noise, np.arange(8) != 2), p, noise, available)
    elif what == "change":
        remove_meter(whole, 2)
        assert not covers(whole, p, noise, available & whole.trusted)
    else:
        add_unknown(whole, random_tree(8, np.random.default_rng(5), drop=0.04).linear().R_bus[:, 0], 1.0)
        assert not covers(whole, p, noise, available)


def test_what_all_said_is_kept_while_some_lie_and_no_longer() -> None:
    street = Watched(30)
    street.play(0, 20)
    calm = street.state
    assert all(
        whole is one
        for whole, one in zip(calm.full_posteriors, calm.posteriors, strict=True)
        if one is not None
    )
    street.play(20, 5, street.lies())
    lied = street.state
    assert set(np.flatnonzero(lied.trust.named)) == set(street.liars)
    assert lied.full_posteriors[0] is calm.full_posteriors[0]
    assert lied.posteriors[0] is not lied.full_posteriors[0]
    street.play(25, 90)
    assert street.state.trust.clear
    assert street.state.full_posteriors[0] is street.state.posteriors[0]


def test_on_large_feeders_it_is_not_kept_and_the_same_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, not_kept = Watched(30), Watched(30)
    kept.play(0, 20)
    kept.play(20, 5, kept.lies())
    monkeypatch.setattr(identify, "_MAX_KEPT", 29)
    not_kept.play(0, 20)
    assert not_kept.state.full_posteriors == (None,) * len(not_kept.state.posteriors)
    not_kept.play(20, 5, not_kept.lies())
    np.testing.assert_array_equal(not_kept.state.trust.named, kept.state.trust.named)
    np.testing.assert_allclose(not_kept.state.last[0].std, kept.state.last[0].std)


def test_while_some_lie_the_start_is_made_from_what_all_said(monkeypatch: pytest.MonkeyPatch) -> None:
    street, asked = Watched(30), list[bool]()

    def watched(*given: Any) -> Bools:
        asked.append(given[-1] is not None)
        return robust_set(*given)

    monkeypatch.setattr(hypotheses, "robust_set", watched)
    street.play(0, 20)
    street.play(20, 5, street.lies())
    assert asked
    assert all(asked)


def test_less_is_kept_only_where_more_is_of_no_use() -> None:
    """A fit of all who report takes the place of one of as many or fewer, or of another prior or noise."""
    rng = np.random.default_rng(6)
    p, noise = street(rng, 8), np.full(8, 0.002**2)
    every = np.ones(8, dtype=np.bool_)
    most = np.arange(8) != 3

    def here(enough: Bools, noise: Floats = noise, p: Prior = p) -> ScaleData:
        limits = Limits(3.0, np.zeros(8), np.zeros(8), np.zeros(8))
        return ScaleData(p, noise, np.zeros(8), enough, limits)

    def kept(before: Posterior | None, now: Posterior, here: ScaleData) -> Posterior | None:
        return identify._kept_posterior(before, None, now, here)

    all_, some = condition(p, noise, every), condition(p, noise, most)
    assert kept(None, all_, here(every)) is all_
    assert kept(None, some, here(most)) is some
    assert kept(None, some, here(every)) is None
    assert kept(all_, some, here(every)) is all_
    assert kept(all_, some, here(most)) is all_
    assert kept(some, all_, here(every)) is all_
    assert kept(condition(p, 2.0 * noise, every), some, here(most)) is some
    assert (
        kept(condition(p.with_direction(np.full(p.variance.size, 0.1)), noise, every), some, here(most))
        is some
    )
    open_ = condition(p, noise, every, np.full((p.variance.size, 1), 0.1))
    assert kept(None, open_, here(every)) is None
    assert kept(some, open_, here(every)) is some
    # What is of no use any more is not kept either.
    assert kept(all_, open_, here(every, 2.0 * noise)) is None
    changed = all_.copy()
    remove_meter(changed, 3)
    assert kept(None, changed, here(most)) is None
    assert identify._kept_posterior(some, all_, all_, here(every)) is some
