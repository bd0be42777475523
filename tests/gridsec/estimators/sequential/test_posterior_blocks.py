"""Many meters at once: against one after the other, and against dense linear algebra made anew."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Bools, Floats, Ints
from gridsec.estimators.sequential import search
from gridsec.estimators.sequential.posterior import (
    ExcludedMeters,
    Posterior,
    Prior,
    add_meter,
    add_unknown,
    chi_square_without,
    condition,
    leave_one_out,
    remove_meter,
    remove_meters,
    well_conditioned,
)
from gridsec.estimators.sequential.search import Candidate, Limits, descend
from tests.gridsec.estimators.sequential.test_posterior import agrees, problem

SEEDS = st.integers(0, 2**32 - 1)


def started(rng: np.random.Generator, prior: Prior, noise: Floats, *, loose: bool) -> Posterior:
    """Most meters trusted, perhaps with a direction loosened."""
    now = condition(prior, noise, rng.random(noise.size) < 0.8)
    if loose:
        add_unknown(now, rng.normal(size=prior.variance.size), 0.7)
        now = condition(prior, noise, now.trusted, now.unknowns)
    return now


def opened(S: Floats, now: Posterior) -> Floats:
    """The covariance with what was loosened."""
    return S + now.unknowns @ now.unknowns.T


@settings(max_examples=80)
@given(seed=SEEDS, meters=st.integers(1, 9), extra=st.integers(0, 6), loose=st.booleans(), lean=st.booleans())
def test_who_falls_together_might_have_fallen_one_by_one(
    seed: int, meters: int, extra: int, loose: bool, lean: bool
) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, meters + extra, meters)
    # Also meters that know less of their bus than what is known without them.
    noise = noise * 10.0 ** rng.integers(-2, 3, meters)
    before = started(rng, prior, noise, loose=loose)
    if not lean:
        before.inverse = before.Q
    kept, removed = before.copy(), rng.random(meters) < 0.5
    after, one_by_one = remove_meters(before, removed), before.copy()
    for j in np.flatnonzero(removed & before.trusted).tolist():
        remove_meter(one_by_one, j)
    agrees(after, opened(S, before), m)
    assert after.updates == one_by_one.updates
    np.testing.assert_array_equal(after.trusted, one_by_one.trusted)
    np.testing.assert_allclose(after.Q, one_by_one.Q, rtol=1e-9, atol=1e-9 * np.abs(after.Q).max(initial=0.0))
    np.testing.assert_array_equal(before.Q, kept.Q)
    np.testing.assert_array_equal(before.variance, kept.variance)
    expected = float(leave_one_out(condition(prior, noise, after.trusted, before.unknowns), m).chi_square)
    wild = np.where(removed, 1e6, m)
    assert chi_square_without(before, wild, removed) == pytest.approx(expected, rel=1e-8, abs=1e-8)


@settings(max_examples=80)
@given(seed=SEEDS, meters=st.integers(2, 9), extra=st.integers(0, 6), loose=st.booleans())
def test_who_is_admitted_together_might_have_been_one_by_one(
    seed: int, meters: int, extra: int, loose: bool
) -> None:
    rng = np.random.default_rng(seed)
    S, prior, noise, m = problem(rng, meters + extra, meters)
    now = started(rng, prior, noise, loose=loose)
    now = remove_meters(now, np.arange(meters) == 0)
    at = np.flatnonzero(~now.trusted)
    order = rng.permutation(at.size)
    outside, one_by_one = ExcludedMeters.of(now, at), now.copy()
    factor = outside.factor(order)
    changes = outside.changes(order, factor)
    part = order[: rng.integers(1, order.size + 1)]
    for k, j in enumerate(at[part].tolist()):
        update = add_meter(one_by_one, j)
        square = update.factor * np.multiply.outer(update.q, update.q)
        np.testing.assert_allclose(np.multiply.outer(changes[k], changes[k]), square, rtol=1e-7, atol=1e-8)
    outside.add(part, factor, changes)
    assert now.updates == one_by_one.updates
    np.testing.assert_array_equal(now.trusted, one_by_one.trusted)
    np.testing.assert_allclose(now.Q, one_by_one.Q, rtol=1e-7, atol=1e-8)
    agrees(now, opened(S, now), m)


def single(found: dict[str, Candidate], seed: int, few: int, part: float) -> dict[str, Candidate]:
    """A descent from part of all, in which some must be believed; readings of one level, a few off."""
    rng = np.random.default_rng(seed)
    _, prior, noise, m = problem(rng, 24, 20)
    off = rng.random(20) < 0.3
    readings = 0.3 * m + np.where(off, rng.normal(size=20) * 10.0, 0.0)
    limits = Limits(2.5, np.full(20, 0.01), np.full(20, 0.3), np.full(20, 0.01), None, np.full(20, 0.02))
    keep: Bools = rng.random(20) < 0.1
    protected = np.flatnonzero(rng.random(20) < 0.2)
    start = condition(prior, noise, rng.random(20) < part)
    return {
        **found,
        str(few): descend(start, readings, np.ones(20, bool), limits, keep=keep, protected=protected),
    }


@settings(max_examples=150)
@given(seed=SEEDS, at_once=st.sampled_from([2, 5, 64]), part=st.sampled_from([0.3, 0.7, 1.0]))
def test_a_descent_moves_many_as_it_would_one_by_one(seed: int, at_once: int, part: float) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "_AT_ONCE", at_once)
        found: dict[str, Candidate] = {}
        for few in (1, 10**6):
            patch.setattr(search, "_MANY", few)
            found = single(found, seed, few, part)
    many, one_by_one = found.values()
    np.testing.assert_array_equal(many.trusted, one_by_one.trusted)
    assert many.cost == pytest.approx(one_by_one.cost, rel=1e-8, abs=1e-8)
    assert many.posterior.updates == one_by_one.posterior.updates
    np.testing.assert_allclose(many.loo.residual, one_by_one.loo.residual, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(many.posterior.variance, one_by_one.posterior.variance, rtol=1e-6, atol=1e-7)


def test_many_may_be_all() -> None:
    """Where nobody is left to be believed, that is an explanation too, and not that from which it began."""
    rng = np.random.default_rng(5)
    _, prior, noise, m = problem(rng, 12, 10)
    none, one = np.zeros(10), np.ones(10)
    start = condition(prior, noise, np.ones(10, dtype=bool))
    found = descend(start, 1e3 * m, one > 0, Limits(0.01, none, none, none), keep=one > 0)
    assert not found.trusted.any()
    assert start.trusted.all()
    assert found.posterior.updates == 10
    assert found.loo.chi_square == 0.0
    np.testing.assert_allclose(found.posterior.variance, prior.variance)


@settings(max_examples=80)
@given(seed=SEEDS, loud=st.booleans())
def test_meters_may_share_a_bus(seed: int, loud: bool) -> None:
    """Two customers of one bus have a meter each; some know far less of it than is known without them."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(7, 7))
    S, at = A @ A.T, rng.integers(0, 7, 9)
    prior, noise, m = Prior(S[:, at], at, S.diagonal().copy()), rng.uniform(0.1, 0.5, 9), rng.normal(size=9)
    noise = np.where(rng.random(9) < 0.4, 1e3 * noise, noise) if loud else noise
    before, removed = condition(prior, noise, rng.random(9) < 0.8), rng.random(9) < 0.4
    after = remove_meters(before, removed)
    agrees(after, S, m)
    others = np.flatnonzero(~after.trusted)
    outside, order = ExcludedMeters.of(after, others), rng.permutation(others.size)[:4]
    if order.size:
        factor = outside.factor(order)
        outside.add(order, factor, outside.changes(order, factor))
        agrees(after, S, m)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("exact", [1e-5, 1e-7, 1e-9])
def test_exact_meters_are_moved_one_by_one(seed: int, exact: float) -> None:
    """What they leave open of one another is lost in rounding where many move at once."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(40, 3))
    S, every, zero = A @ A.T, np.ones(40, dtype=np.bool_), np.zeros(40)
    noise = np.full(40, exact * float(S.diagonal().max()))
    prior, found = Prior(S, np.arange(40), S.diagonal().copy()), []
    m = A @ rng.normal(size=3) + np.sqrt(noise) * rng.normal(size=40)
    assert well_conditioned(prior, noise) == (exact > 1e-6)
    with pytest.MonkeyPatch.context() as patch:
        for few in (search._MANY, 10**6):
            patch.setattr(search, "_MANY", few)
            start = condition(prior, noise, np.arange(40) % 2 == 0)
            found.append(descend(start, m, every, Limits(5.0, zero, zero, zero), keep=~every))
    np.testing.assert_array_equal(found[0].trusted, found[1].trusted)
    assert found[0].posterior.updates == found[1].posterior.updates
    # Still more exact ones are beyond what doubles tell apart.
    assert found[0].trusted.all() or exact < 1e-8


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("loud", [False, True])
def test_a_descent_where_meters_share_a_bus_ends_in_a_fit_made_anew(seed: int, loud: bool) -> None:
    """Two or three customers of one bus; one of them may know far less than is known without it."""
    rng = np.random.default_rng([21, seed])
    root = rng.normal(size=(12, 4))
    S, at = root @ root.T, rng.integers(0, 12, 24)
    prior, noise = Prior(S[:, at], at, S.diagonal().copy()), rng.uniform(0.05, 0.4, 24)
    if loud:
        noise[rng.integers(24)] = 100.0 * float(S.diagonal().max())
    m = (root @ rng.normal(size=4))[at] + np.sqrt(noise) * rng.normal(size=24)
    m[rng.choice(24, 8, replace=False)] += 4.0 * rng.choice([-1.0, 1.0], 8)
    zero, every = np.zeros(24), np.ones(24, dtype=np.bool_)
    limits, found = Limits(2.5, zero, zero + 0.02, zero + 0.01), list[Candidate]()
    start = condition(prior, noise, rng.random(24) < (1.0 if seed % 2 else 0.3))
    with pytest.MonkeyPatch.context() as patch:
        for few in (2, 10**6):
            patch.setattr(search, "_MANY", few)
            found.append(descend(start, m, every, limits, keep=~every))
    many, one_by_one = found
    np.testing.assert_array_equal(many.trusted, one_by_one.trusted)
    assert many.posterior.updates == one_by_one.posterior.updates
    assert many.cost == pytest.approx(one_by_one.cost, rel=1e-8)
    agrees(many.posterior, S, m)
    anew, removed = leave_one_out(condition(prior, noise, many.trusted), m), start.trusted & ~many.trusted
    assert many.loo.chi_square == pytest.approx(anew.chi_square, rel=1e-8)
    left = leave_one_out(condition(prior, noise, start.trusted & ~removed), m).chi_square
    assert chi_square_without(start, np.where(removed, 1e6, m), removed) == pytest.approx(
        left, rel=1e-8, abs=1e-8
    )


@pytest.mark.parametrize("seed", range(10))
def test_nobody_knows_more_of_a_bus_when_somebody_falls(seed: int) -> None:
    """Also where many good meters know the bus as well as the noisy ones that fall know little of it."""
    rng = np.random.default_rng([22, seed])
    root = rng.uniform(0.5, 1.5, (50, 1))
    S = root @ root.T
    noise = np.where(np.arange(50) < 10, 8.0 * S.diagonal(), 1e-6)
    before = condition(Prior(S, np.arange(50), S.diagonal().copy()), noise, np.ones(50, dtype=np.bool_))
    after = remove_meters(before, np.arange(50) < 10)
    assert (after.variance >= before.variance).all()
    # Of one cause only: what all say of it together is known without a matrix.
    known = 1.0 + float((root[10:, 0] ** 2 / noise[10:]).sum())
    np.testing.assert_allclose(after.variance, root[:, 0] ** 2 / known, atol=5e-9)


@pytest.mark.parametrize("seed", range(8))
def test_exact_numbers_tell_what_meters_leave_open_that_know_next_to_nothing(seed: int) -> None:
    """Two of six meters have noise so large that their own reading says nothing of their bus."""
    rng = np.random.default_rng([23, seed])
    root = rng.normal(size=(6, 8))
    S = root @ root.T
    noise = rng.uniform(0.1, 0.5, 6)
    noise[[1, 4]] = 1e12 * S.diagonal()[[1, 4]]
    prior, every = Prior(S, np.arange(6), S.diagonal().copy()), np.ones(6, dtype=np.bool_)
    whole = condition(prior, noise, every)
    np.testing.assert_allclose(whole.variance, exactly(S, noise, np.arange(6)), rtol=1e-9)
    for gone in ([1], [4, 2], [1, 4], [0, 1, 4]):
        stay = np.setdiff1d(np.arange(6), gone)
        after = remove_meters(whole, np.isin(np.arange(6), gone))
        np.testing.assert_allclose(after.variance, exactly(S, noise, stay), rtol=1e-9)


def exactly(S: Floats, noise: Floats, at: Ints) -> Floats:
    """What meters at the first buses leave open at every bus, in fractions: elimination of one by one."""
    open_ = [[Fraction(float(value)) for value in row] for row in S]
    for j in at.tolist():
        pivot, row = open_[j][j] + Fraction(float(noise[j])), list(open_[j])
        open_ = [
            [own - row[a] * row[b] / pivot for b, own in enumerate(each)] for a, each in enumerate(open_)
        ]
    return np.array([float(open_[k][k]) for k in range(len(open_))])
