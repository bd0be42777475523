"""The likeliest explanation of one snapshot, against all explanations and dense linear algebra."""

from __future__ import annotations

from itertools import chain, combinations
from math import comb

import numpy as np
import pytest
from scipy.special import betaln

from gridsec.arrays import Bools, Floats
from gridsec.errors import InputInvalid
from gridsec.estimators.front.posterior import Prior
from gridsec.estimators.snapshot.collusion import _SamePowers
from gridsec.estimators.snapshot.identification import (
    ErrorPrior,
    FalsePowers,
    SnapshotExplanation,
    _together,
    identify,
)
from gridsec.estimators.snapshot.likelihood import LikelihoodProblem, SnapshotHypothesis
from tests.codes import refused

P = 7
LIES = ErrorPrior()
APART = ErrorPrior(apart=0.0, pair=1e3, more=1e3, load=1e3)


Known = tuple[Prior, Floats, FalsePowers]


def street(rng: np.random.Generator) -> Known:
    """A line of customers: prior, noise, and what false powers do to voltages."""
    r = np.cumsum(rng.uniform(0.01, 0.05, P))
    R = 2.0 * np.minimum.outer(r, r)
    K = R @ np.diag(rng.uniform(0.005, 0.02, P) ** 2) @ R.T
    return (
        Prior(K, np.arange(P), K.diagonal()),
        np.full(P, 0.004**2),
        FalsePowers(R, R, np.ones(P), np.full(P, 0.3)),
    )


def tells(moved: Floats, suspects: tuple[int, ...]) -> bool:
    """Whether nobody else would be moved more than one of them."""
    others = [moved[j] for j in range(P) if j not in suspects]
    return bool(min(moved[list(suspects)]) >= max(others, default=0.0) * (1.0 - 1e-9))


def told(moved: Floats, c: int, size: int) -> int:
    """How many sets of so many would tell the story of customer c, c among them."""
    return sum(c in each and tells(moved, each) for each in combinations(range(P), size))


def dense(
    known: Known, m: Floats, suspects: tuple[int, ...], powers: tuple[int, ...] = (), *, drawn: bool = True
) -> float:
    """Minus twice the log evidence, from its definition, of the likeliest shape, relative to K of nobody."""
    prior, noise, false = known
    honest = prior.covariance + np.diag(noise)
    K = honest.copy()
    for c in powers:
        B = np.column_stack([false.R[:, c] * false.p[c], false.X[:, c] * false.q[c]])
        K += B @ B.T
    k, L = len(suspects), np.array(suspects, dtype=int)
    shapes = [(LIES.size**2 * np.eye(k), LIES.apart * (k - 1))]
    if k > 1:
        same = (np.ones(k), LIES.pair + LIES.more * (k - 2))
        stories = [
            (
                false.R[L, c] / false.R[c, c],
                LIES.load + 2.0 * np.log(P * told(false.R[:, c], c, k) / comb(P, k)),
            )
            for c in (suspects if drawn else ())
            if tells(false.R[:, c], suspects)
        ]
        for u, price in (same, *stories):
            shapes.append((LIES.amplitude**2 * (np.outer(u, u) + LIES.differ**2 * np.diag(u**2)), price))
    costs = []
    for C, price in shapes:
        both = K.copy()
        both[np.ix_(L, L)] += C
        logs = np.linalg.slogdet(both)[1] - np.linalg.slogdet(honest)[1]
        costs.append(float(m @ np.linalg.solve(both, m) + logs + price))
    a, b = LIES.seen
    sets = 2.0 * (betaln(a, P + b) - betaln(k + a, P - k + b))
    return float(min(costs) + sets + LIES.each * k + LIES.false * len(powers))


def subsets(most: int) -> list[tuple[int, ...]]:
    return list(chain.from_iterable(combinations(range(P), k) for k in range(1, most + 1)))


def who(found: SnapshotExplanation) -> tuple[int, ...]:
    return tuple(np.flatnonzero(found.meters).tolist())


LIVE: Bools = np.ones(P, dtype=np.bool_)


@pytest.mark.parametrize("seed", range(40))
def test_finds_the_best_of_all_sets_of_up_to_three(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior, noise, false = street(rng)
    m = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
    lying = rng.choice(P, 1 + seed % 3, replace=False)
    m[lying] += rng.choice([-1.0, 1.0], lying.size) * rng.uniform(0.05, 0.2, lying.size)
    found = identify(prior, noise, m, LIVE)
    costs = {each: dense((prior, noise, false), m, each, drawn=False) for each in subsets(3)}
    best = min(costs, key=lambda each: costs[each])
    assert who(found[0]) == best == tuple(sorted(lying.tolist()))
    rivals = {who(each): each.probability for each in found}
    for other, probability in rivals.items():
        if other:
            gap = costs[other] - costs[best]
            assert np.log(rivals[best] / probability) == pytest.approx(gap / 2.0, abs=1e-6)
    assert sum(rivals.values()) == pytest.approx(1.0)


@pytest.mark.canary("True")
@pytest.mark.parametrize("like_a_load", [False, True])
def test_lies_that_are_alike_are_found_where_they_are_weak(like_a_load: bool) -> None:
    """Lies of three to seven standard deviations: the best of all sets, of all shapes, is found."""
    named, exact, right, right_apart = 0, 0, 0, 0
    for seed in range(60):
        rng = np.random.default_rng([seed, like_a_load])
        prior, noise, false = street(rng)
        false = FalsePowers(false.R, false.X, np.full(P, 1e-4), np.full(P, 1e-4))
        m = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
        lying = np.arange(P - 3, P) if like_a_load else np.sort(rng.choice(P, 3, replace=False))
        shape = false.R[lying, P - 1] / false.R[P - 1, P - 1] if like_a_load else np.ones(3)
        m[lying] -= rng.uniform(0.012, 0.03) * shape
        found = identify(prior, noise, m, LIVE, false=false)
        if found[0].powers.any() or not found[0].meters.any():
            continue
        named += 1
        costs = {each: dense((prior, noise, false), m, each) for each in subsets(4)}
        exact += who(found[0]) == min(costs, key=lambda each: costs[each])
        right += who(found[0]) == tuple(lying.tolist())
        right_apart += who(identify(prior, noise, m, LIVE, error_prior=APART, false=false)[0]) == tuple(
            lying.tolist()
        )
        for other in found[1:]:
            if who(other) in costs and not other.powers.any():
                gap = costs[who(other)] - costs[who(found[0])]
                assert other.cost - found[0].cost == pytest.approx(gap, abs=1e-6)
        K = prior.covariance + np.diag(noise)
        np.testing.assert_allclose(K @ found[0].weights + found[0].errors, m, atol=1e-9)
    assert named >= 15
    # The search is local: three of seven that agree may look like the other four.
    assert exact >= 0.6 * named
    assert right >= right_apart


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("size", [2, 3, 4])
def test_who_tells_a_story_and_how_many_could(size: int, seed: int) -> None:
    """A branching feeder, where many feel a load alike: against all sets."""
    rng = np.random.default_rng(seed)
    above = np.array([-1, *(int(rng.integers(k)) for k in range(1, P))])
    on_path = np.eye(P)
    for k in range(1, P):
        on_path[k] += on_path[above[k]]
    R = on_path @ np.diag(rng.uniform(0.01, 0.05, P)) @ on_path.T
    false = FalsePowers(R, R, np.ones(P), np.ones(P))
    no_meters = SnapshotHypothesis.without_accusations(np.zeros(P), np.eye(P))
    problem = LikelihoodProblem(LIES, no_meters, false, None)
    base = _SamePowers(problem, no_meters, np.zeros(P))
    L = np.array(list(combinations(range(P), size)))
    of, shape, cost = base.shapes([tuple(each) for each in L.tolist()])
    found = {(k, c): J for k, c, J in zip(of.tolist(), shape.tolist(), cost.tolist(), strict=True) if c >= 0}
    for k, suspects in enumerate(L.tolist()):
        for c in suspects:
            assert ((k, c) in found) == tells(R[:, c], tuple(suspects))
            if (k, c) in found:
                u = R[suspects, c] / R[c, c]
                C = LIES.amplitude**2 * (np.outer(u, u) + LIES.differ**2 * np.diag(u**2))
                price = LIES.load + 2.0 * np.log(P * told(R[:, c], c, size) / comb(P, size))
                freedom = np.linalg.slogdet(np.eye(size) + C)[1]
                assert found[k, c] == pytest.approx(freedom + problem.prices[size] + price, abs=1e-9)


def test_one_set_of_all_meters() -> None:
    """Where everybody may lie there is nobody left to accuse."""
    prior = Prior(np.zeros((2, 2)), np.arange(2), np.zeros(2))
    found = identify(prior, np.full(2, 1e-6), np.array([0.1, 0.1]), np.ones(2, dtype=np.bool_))
    assert who(found[0]) == (0, 1)


def test_false_powers_are_found_with_their_meter() -> None:
    exact = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        prior, noise, false = street(rng)
        c = int(rng.integers(2, P - 1))
        # The model follows the false powers, all meters but the customer's own tell the truth.
        honest = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
        m = honest - 0.7 * false.R[:, c]
        m[c] = honest[c]
        found = identify(prior, noise, m, LIVE, false=false)
        best = min(
            ((each, powers) for each in subsets(2) for k in (0, 1) for powers in combinations(each, k)),
            key=lambda pair: dense((prior, noise, false), m, *pair),
        )
        assert who(found[0]) == best[0]
        assert tuple(np.flatnonzero(found[0].powers).tolist()) == best[1]
        exact += best == ((c,), (c,))
    assert exact >= 18


@pytest.mark.parametrize("seed", range(6))
def test_pairs_and_triples_with_false_powers_are_ranked_as_dense_algebra_ranks_them(seed: int) -> None:
    """Two customers with false meters and powers; all pairs and all triples."""
    rng = np.random.default_rng(seed)
    prior, noise, false = street(rng)
    customers = np.sort(rng.choice(P, 2, replace=False))
    m = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
    m -= false.R[:, customers] @ rng.uniform(0.3, 0.7, 2)
    m[customers] += rng.uniform(0.05, 0.2, 2)
    K = prior.covariance + np.diag(noise)
    W = np.linalg.inv(np.linalg.cholesky(K))
    start = SnapshotHypothesis.without_accusations(m, W)
    found = _together(LikelihoodProblem(APART, start, false, None), start)
    for size in (2, 3):
        costs = {each: independent(K, false, m, each) for each in combinations(range(P), size)}
        ranked = sorted(costs, key=lambda each: costs[each])
        mine = [tuple(sorted(each)) for each in found if len(each) == size]
        assert mine == ranked[: len(mine)]
    assert len(found) == 8


def independent(K: Floats, false: FalsePowers, m: Floats, customers: tuple[int, ...]) -> float:
    """Minus twice the log likelihood with independent errors of the customers' meters and powers."""
    both = K.copy()
    for c in customers:
        B = np.column_stack([false.R[:, c] * false.p[c], false.X[:, c] * false.q[c]])
        both += B @ B.T
        both[c, c] += LIES.size**2
    return float(np.linalg.slogdet(both)[1] + m @ np.linalg.solve(both, m))


def test_false_powers_are_found_where_no_meter_alone_is_suspicious_enough() -> None:
    found = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        prior, noise, false = street(rng)
        c = int(rng.integers(2, P - 1))
        honest = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
        m = honest - 0.15 * false.R[:, c]
        m[c] = honest[c]
        if identify(prior, noise, m, LIVE)[0].meters.any():
            continue
        best = identify(prior, noise, m, LIVE, false=false)[0]
        if best.meters.any():
            assert who(best) == (c,)
            assert best.powers[c]
            found += 1
    assert found >= 2


def clean_and_named(rate: float, noise: Floats, trials: int) -> int:
    """In how many of so many clean snapshots somebody is named."""
    rng = np.random.default_rng(5)
    prior, _, false = street(rng)
    root = np.linalg.cholesky(prior.covariance + np.diag(noise))
    lies = ErrorPrior(rate=rate)
    told = rng.normal(size=(trials, P)) @ root.T
    found = [identify(prior, noise, m, LIVE, error_prior=lies, false=false)[0] for m in told]
    return sum(bool(each.meters.any()) for each in found)


SAME = np.full(P, 0.004**2)
MIXED = np.array([1.0, 1.0, 30.0, 1.0, 1.0, 5.0, 1.0]) ** 2 * SAME


@pytest.mark.canary("noise0")
@pytest.mark.parametrize("noise", [SAME, MIXED])
def test_no_more_clean_snapshots_name_somebody_than_allowed(noise: Floats) -> None:
    for rate in (0.05, 0.005):
        # Three standard deviations of the count.
        assert clean_and_named(rate, noise, 4000) <= 4000 * rate + 3.0 * np.sqrt(4000 * rate)


@pytest.mark.acceptance
def test_as_many_clean_snapshots_name_somebody_as_allowed_where_the_rate_decides() -> None:
    # At 0.05 the freedom and the prior alone allow less; at 0.001 `anybody` is what they lack.
    assert clean_and_named(0.05, SAME, 4000) < 0.01 * 4000
    assert 8 <= clean_and_named(0.001, SAME, 15000) <= 27


def test_the_voltage_follows_from_the_weights() -> None:
    rng = np.random.default_rng(9)
    prior, noise, _ = street(rng)
    truth = rng.multivariate_normal(np.zeros(P), prior.covariance)
    m = truth + np.sqrt(noise) * rng.normal(size=P)
    m[4] += 0.3
    best = identify(prior, noise, m, LIVE)[0]
    honest = np.flatnonzero(~best.meters)
    K = prior.covariance[np.ix_(honest, honest)] + np.diag(noise[honest])
    expected = prior.covariance[:, honest] @ np.linalg.solve(K, m[honest])
    # A liar's reading counts with the tiny weight of its slab.
    np.testing.assert_allclose(prior.covariance @ best.weights, expected, atol=3e-4)


def test_a_silent_meter_has_no_influence() -> None:
    rng = np.random.default_rng(2)
    prior, noise, false = street(rng)
    m = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
    m[1] += 0.1
    available = LIVE.copy()
    available[5] = False
    first = identify(prior, noise, m, available, false=false)
    m[5] = np.nan
    second = identify(prior, noise, m, available, false=false)
    assert who(first[0]) == who(second[0]) == (1,)
    assert not first[0].weights[5]
    np.testing.assert_array_equal(first[0].weights, second[0].weights)


def test_without_readings_nobody_is_named() -> None:
    prior, noise, _ = street(np.random.default_rng(1))
    found = identify(prior, noise, np.full(P, np.nan), ~LIVE)
    assert len(found) == 1
    assert not found[0].meters.any()
    assert found[0].probability == pytest.approx(1.0)


def test_what_is_handed_on_changes_no_answer() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        prior, noise, false = street(rng)
        m = rng.multivariate_normal(np.zeros(P), prior.covariance + np.diag(noise))
        m[rng.choice(P, 3, replace=False)] += 0.05
        p, q = rng.uniform(0.1, 1.0, (2, P))
        handed = false.claimed(q, p).claimed(p, q)
        assert handed.felt is not None
        np.testing.assert_array_equal(handed.felt, -np.sort(-false.R, axis=0))
        plain = FalsePowers(false.R, false.X, p, q)
        for available in (LIVE, np.arange(P) != 3):
            one, other = (identify(prior, noise, m, available, false=each) for each in (plain, handed))
            assert [who(each) for each in one] == [who(each) for each in other]
            assert [each.cost for each in one] == [each.cost for each in other]


def test_false_powers_of_other_meters_are_refused() -> None:
    prior, noise, false = street(np.random.default_rng(3))
    few = np.arange(P - 1)
    with refused(InputInvalid, "shape"):
        false.claimed(np.ones(P - 1), np.ones(P - 1))
    with refused(InputInvalid, "shape"):
        FalsePowers(false.R, false.X, false.p, false.q, false.of(few).claimed(few * 1.0, few * 1.0).felt)
    with refused(InputInvalid, "shape"):
        identify(prior, noise, np.zeros(P), LIVE, false=false.of(few))
    with refused(InputInvalid, "not-positive"):
        ErrorPrior(differ=0.0)


def test_a_state_is_what_dense_algebra_says_after_many_changes() -> None:
    rng = np.random.default_rng(8)
    prior, noise, false = street(rng)
    K, m = prior.covariance + np.diag(noise), rng.normal(size=P)
    start = SnapshotHypothesis.without_accusations(m, np.linalg.inv(np.linalg.cholesky(K)))
    problem, at = LikelihoodProblem(LIES, start, false, None), start.copy()
    for j in (2, 5, 2, 6):
        problem.toggle(at, j)
    problem.doubt_powers(at, 6)
    problem.doubt_powers(at, 5)
    problem.doubt_powers(at, 5, -1.0)
    B = np.column_stack([false.R[:, 6] * false.p[6], false.X[:, 6] * false.q[6]])
    after = K + LIES.size**2 * np.diag(np.isin(np.arange(P), (5, 6))) + B @ B.T
    Q, x = np.linalg.inv(after), rng.normal(size=P)
    assert at.counts == (2, 1)
    np.testing.assert_allclose(at.rows(np.arange(P)), Q, rtol=1e-7, atol=1e-7 * np.abs(Q).max())
    np.testing.assert_allclose(at.times(x), Q @ x, rtol=1e-7, atol=1e-7 * np.abs(Q @ x).max())
    np.testing.assert_allclose(at.diagonal, Q.diagonal(), rtol=1e-7)
    np.testing.assert_allclose(at.g, Q @ m, rtol=1e-7, atol=1e-7 * np.abs(Q @ m).max())
    assert at.fit == pytest.approx(float(m @ Q @ m), rel=1e-8)
    assert at.logdet == pytest.approx(np.linalg.slogdet(after)[1] - np.linalg.slogdet(K)[1], abs=1e-8)
    assert start.counts == (0, 0)
    assert not start.meters.any()


@pytest.mark.parametrize("seed", range(20))
def test_nobody_tells_of_a_load_that_moves_nothing(seed: int) -> None:
    """A customer of the busbar has no column: what it draws moves no voltage, and who lies there is alone."""
    rng = np.random.default_rng(seed)
    _, noise, plain = street(rng)
    R = plain.R.copy()
    R[0] = R[:, 0] = 0.0
    K = R @ np.diag(rng.uniform(0.005, 0.02, P) ** 2) @ R.T
    false = FalsePowers(R, R, plain.p, plain.q)
    m = rng.multivariate_normal(np.zeros(P), K + np.diag(noise))
    lying = (0, 1 + seed % (P - 1))
    m[list(lying)] += rng.choice([-0.1, 0.1], 2)
    found = identify(Prior(K, np.arange(P), K.diagonal()), noise, m, LIVE, false=false)
    assert who(found[0]) == lying
    assert np.isfinite([(each.cost, each.probability) for each in found]).all()
