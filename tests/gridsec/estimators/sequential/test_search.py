"""The search for the likeliest liars, against all sets there are."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product
from math import comb, log

import numpy as np
import pytest

from gridsec.arrays import Bools, Floats
from gridsec.estimators.sequential import search
from gridsec.estimators.sequential.hypotheses import meter_exchanges
from gridsec.estimators.sequential.posterior import LoadDoubt, Prior, condition, leave_one_out, voltage_prior
from gridsec.estimators.sequential.search import (
    Candidate,
    FaultDictionary,
    LimitCache,
    Limits,
    descend,
    robust_set,
    set_cost,
)
from tests.gridsec.street import random_tree

SIGMAS = 3.5


def street(rng: np.random.Generator, customers: int) -> tuple[Floats, Prior]:
    """A random tree; 2R, and what errors of 0.6 kW do to its voltages."""
    tree = random_tree(customers, rng, drop=0.04)
    model = tree.linear()
    doubt = LoadDoubt(np.full(customers, 0.006), np.full(customers, 0.002), 600.0)
    return 2.0 * model.R_bus, voltage_prior(tree, np.arange(1, customers + 1), doubt, busbar=4e-4)


def readings(rng: np.random.Generator, p: Prior, noise: Floats) -> Floats:
    count = noise.size
    w = rng.multivariate_normal(np.zeros(count), p.between + 1e-18 * np.eye(count))
    return np.asarray(w + np.sqrt(noise) * rng.normal(size=count))


def limits(count: int) -> Limits:
    return Limits(SIGMAS, np.zeros(count), np.zeros(count), np.zeros(count))


def cost(p: Prior, noise: Floats, m: Floats, trusted: Bools) -> float:
    """J by definition: a dense solve, and a binomial coefficient."""
    at = np.flatnonzero(trusted)
    whole = p.between[np.ix_(at, at)] + np.diag(noise[at])
    suspects = int((~trusted).sum())
    assert suspects <= m.size // 2
    return float(m[at] @ np.linalg.solve(whole, m[at])) + 2.0 * log(comb(m.size, suspects))


@pytest.mark.parametrize("seed", range(12))
def test_no_set_explains_better_and_the_liars_are_it(seed: int) -> None:
    """All sets of up to three of ten meters are tried; three lie by 3 %."""
    rng = np.random.default_rng([1, seed])
    _, p = street(rng, 10)
    noise = np.full(10, 0.002**2)
    suspects = np.sort(rng.choice(10, 3, replace=False))
    m = readings(rng, p, noise)
    m[suspects] += 0.06 * rng.choice([-1.0, 1.0], 3)
    available, none = np.ones(10, dtype=bool), np.zeros(10, dtype=bool)
    start = condition(p, noise, robust_set(p, noise, m, available, 2.0 * np.sqrt(noise)))
    found = descend(start, m, available, limits(10), keep=none)
    everything = [
        (cost(p, noise, m, ~np.isin(np.arange(10), out)), out)
        for size in range(4)
        for out in combinations(range(10), size)
    ]
    best, which = min(everything)
    assert found.cost == pytest.approx(best, rel=1e-9)
    assert tuple(np.flatnonzero(~found.posterior.trusted)) == which == tuple(suspects)


@pytest.mark.canary("False-0", "False-6", "True-3", "True-9")
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("one_way", [False, True])
def test_a_third_of_the_meters_in_collusion(seed: int, one_way: bool) -> None:
    rng = np.random.default_rng([2, seed])
    _, p = street(rng, 60)
    noise = np.full(60, 0.002**2)
    suspects = rng.choice(60, 20, replace=False)
    m = readings(rng, p, noise)
    m[suspects] += 0.04 * (-1.0 if one_way else rng.choice([-1.0, 1.0], 20))
    available, none = np.ones(60, dtype=bool), np.zeros(60, dtype=bool)
    start = condition(p, noise, robust_set(p, noise, m, available, 2.0 * np.sqrt(noise)))
    found = descend(start, m, available, limits(60), keep=none)
    wrong = set(np.flatnonzero(~found.posterior.trusted)) ^ set(suspects)
    assert not wrong


def test_honest_meters_are_all_trusted_at_once() -> None:
    rng = np.random.default_rng(3)
    _, p = street(rng, 30)
    noise = np.full(30, 0.002**2)
    m = readings(rng, p, noise)
    available = np.arange(30) != 4
    m[4] = 0.0
    np.testing.assert_array_equal(robust_set(p, noise, m, available, 6.0 * np.sqrt(noise)), available)
    found = descend(condition(p, noise, np.ones(30, dtype=bool)), m, available, limits(30), keep=~available)
    np.testing.assert_array_equal(found.posterior.trusted, available)
    assert found.cost == pytest.approx(leave_one_out(condition(p, noise, available), m).chi_square)
    assert not robust_set(p, noise, m, np.zeros(30, dtype=bool), np.ones(30)).any()


def test_a_fit_that_needs_no_change_is_the_solutions_own_and_another_is_left_as_it_was() -> None:
    rng = np.random.default_rng(3)
    _, p = street(rng, 30)
    noise = np.full(30, 0.002**2)
    m, available, no_meters = readings(rng, p, noise), np.ones(30, dtype=bool), np.zeros(30, dtype=bool)
    start = condition(p, noise, available)
    assert descend(start, m, available, limits(30), keep=no_meters).posterior is start
    inverse, variance = start.inverse.copy(), start.variance.copy()
    m[[2, 9]] += 0.05
    found = descend(start, m, available, limits(30), keep=no_meters)
    assert np.flatnonzero(~found.trusted).tolist() == [2, 9]
    assert start.trusted.all()
    np.testing.assert_array_equal(start.inverse, inverse)
    np.testing.assert_array_equal(start.variance, variance)


@pytest.mark.parametrize("fresh", [True, False])
def test_a_solution_keeps_nothing_about_the_many_that_it_accuses(fresh: bool) -> None:
    rng = np.random.default_rng(3)
    _, p = street(rng, 30)
    noise, m = np.full(30, 0.002**2), np.zeros(30)
    m[::4] = 0.05
    start = condition(p, noise, np.ones(30, dtype=bool))
    found = descend(start, m, m < 1.0, limits(30), keep=np.zeros(30, dtype=bool), fresh=fresh)
    assert found.posterior.inverse.shape == (22, 22)
    assert (found.posterior is start) is fresh


def test_what_was_judged_before_counts_only_where_nothing_has_changed_since() -> None:
    """Silent meters are dropped, and innocent ones admitted, before the search begins."""
    rng = np.random.default_rng(3)
    _, p = street(rng, 30)
    noise, no_meters = np.full(30, 0.002**2), np.zeros(30, dtype=bool)
    m = readings(rng, p, noise)
    m[[2, 9]] += 0.05
    start = condition(p, noise, np.arange(30) != 4)
    silent = np.arange(30) == 17
    m[17] = 10.0
    for available, protected in ((~silent, []), (~silent, [4]), (~no_meters, [4])):
        which = np.array(protected, dtype=np.intp)
        plain = descend(start, m, available, limits(30), keep=no_meters, protected=which)
        told = descend(
            start, m, available, limits(30), keep=no_meters, protected=which, loo=leave_one_out(start, m)
        )
        np.testing.assert_array_equal(told.trusted, plain.trusted)
        assert told.cost == pytest.approx(plain.cost, rel=1e-9)
        np.testing.assert_allclose(told.loo.residual, plain.loo.residual, rtol=1e-9, atol=1e-12)


def test_readings_of_which_none_can_be_have_a_robust_fit_too() -> None:
    """All weights are nothing then."""
    rng = np.random.default_rng(6)
    _, p = street(rng, 12)
    for size in (0.1, 10.0, 1e4):
        m = size * rng.choice([-1.0, 1.0], 12) * rng.uniform(1.0, 2.0, 12)
        assert robust_set(p, np.full(12, 1e-8), m, np.ones(12, dtype=bool), np.full(12, 1e-5)).sum() <= 1


def test_the_truncated_cost_is_not_higher_than_anywhere_near() -> None:
    """The robust fit minimises what it says: no change of one meter lowers it."""
    rng = np.random.default_rng(4)
    _, p = street(rng, 14)
    noise = np.full(14, 0.002**2)
    m = readings(rng, p, noise)
    m[[2, 3, 7]] -= 0.05
    bound = 2.5 * np.sqrt(noise)
    chosen = robust_set(p, noise, m, np.ones(14, dtype=bool), bound)

    def truncated(trusted: Bools) -> float:
        out = float((~trusted).sum()) * 2.5**2
        return leave_one_out(condition(p, noise, trusted), m).chi_square + out

    for j in range(14):
        other = chosen.copy()
        other[j] = ~other[j]
        assert truncated(chosen) <= truncated(other) + 1e-9


def test_a_load_that_nobody_knows_is_one_suspicion_and_not_many_liars() -> None:
    """A customer draws 20 kW that its meter does not show: everyone below reads less."""
    rng = np.random.default_rng(5)
    columns, p = street(rng, 20)
    noise = np.full(20, 0.001**2)
    where = int(np.argmax(columns[1:].sum(axis=0)))
    m = readings(rng, p, noise) - 0.2 * columns[1:, where]
    faults = FaultDictionary(
        std=np.full(20, 0.1),
        charge=np.full(20, 3.0),
        size=(columns[1:] ** 2).sum(axis=0),
        meter=np.full(20, -1),
        columns=lambda which: columns[:, which],
        weighted=lambda weights: weights @ columns[1:],
    )
    available, none = np.ones(20, dtype=bool), np.zeros(20, dtype=bool)
    start = condition(p, noise, available)
    plain = descend(start, m, available, limits(20), keep=none)
    wider = descend(start, m, available, limits(20), keep=none, faults=faults)
    assert plain.posterior.trusted.sum() < 20
    assert wider.faults == (where,)
    assert wider.posterior.trusted.all()
    assert wider.cost < plain.cost
    assert wider.charge == pytest.approx(3.0 * set_cost(20, 1))
    assert wider.cost == pytest.approx(wider.loo.chi_square + wider.charge)


def test_swaps_are_what_the_cost_rises_by() -> None:
    """Two meters at one bus: which of them lies is anyone's guess, and that is said."""
    rng = np.random.default_rng(6)
    columns, _ = street(rng, 8)
    S = columns @ columns.T * 0.006**2
    at = np.array([3, 3, 5, 6, 7])
    p = Prior(S[:, at], at, S.diagonal().copy())
    noise = np.full(5, 0.002**2)
    m = np.array([0.04, -0.04, 0.0, 0.0, 0.0])
    available, none = np.ones(5, dtype=bool), np.zeros(5, dtype=bool)
    found = descend(condition(p, noise, available), m, available, limits(5), keep=none)
    accused = np.flatnonzero(~found.posterior.trusted)
    assert accused.size >= 1
    any_meter, honest = replace(limits(5), sigmas=1e9), set()
    everything = meter_exchanges(found, available, 50.0, any_meter)
    for swap in everything:
        trusted = found.posterior.trusted.copy()
        trusted[swap.accused], trusted[swap.innocent] = True, False
        now = leave_one_out(condition(p, noise, trusted), m)
        assert swap.worse == pytest.approx(
            max(now.chi_square - found.loo.chi_square, 0.0), rel=1e-6, abs=1e-9
        )
        if abs(now.residual[swap.accused]) <= limits(5).limit(now.std)[swap.accused]:
            honest.add(swap.accused)
    assert {swap.accused for swap in meter_exchanges(found, available, 50.0, limits(5))} == honest
    assert meter_exchanges(found, available, -1.0, any_meter) == []


def test_nobody_is_exchanged_who_would_be_accused_again() -> None:
    """Against an oracle, for lies of all sizes: who is taken back must be within what honest meters are."""
    rng = np.random.default_rng(16)
    columns, _ = street(rng, 8)
    S = columns @ columns.T * 0.006**2
    noise, available, none = np.full(9, 0.002**2), np.ones(9, dtype=bool), np.zeros(9, dtype=bool)
    seen: set[bool] = set()
    for size, alone in product(np.linspace(0.01, 0.05, 40), (True, False)):
        at = np.array([3, 4, 5, 6, 7, 8, 2, 1, 0]) if alone else np.array([3, 3, 5, 6, 7, 7, 8, 2, 1])
        p = Prior(S[:, at], at, S.diagonal().copy())
        m = 0.002 * rng.normal(size=9)
        m[[2, 4]] += size
        found = descend(condition(p, noise, available), m, available, limits(9), keep=none)
        told = {swap.accused for swap in meter_exchanges(found, available, 30.0, limits(9))}
        for swap in meter_exchanges(found, available, 30.0, replace(limits(9), sigmas=1e9)):
            trusted = found.posterior.trusted.copy()
            trusted[swap.accused], trusted[swap.innocent] = True, False
            now = leave_one_out(condition(p, noise, trusted), m)
            fine = abs(now.residual[swap.accused]) <= limits(9).limit(now.std)[swap.accused]
            assert fine == (swap.accused in told)
            seen.add(bool(fine))
    assert seen == {True, False}


def test_where_nobody_is_trusted_nobody_is_exchanged() -> None:
    rng = np.random.default_rng(18)
    _, p = street(rng, 4)
    available, none = np.ones(4, dtype=bool), np.zeros(4, dtype=bool)
    found = descend(
        condition(p, np.full(4, 0.002**2), none), np.full(4, 0.5), available, limits(4), keep=available
    )
    assert not found.posterior.trusted.any()
    assert meter_exchanges(found, available, 1e9, limits(4)) == []


def test_swaps_with_a_loosened_direction() -> None:
    rng = np.random.default_rng(7)
    columns, p = street(rng, 9)
    noise = np.full(9, 0.002**2)
    m = readings(rng, p, noise)
    m[4] += 0.05
    available, none = np.ones(9, dtype=bool), np.zeros(9, dtype=bool)
    loose = 0.05 * columns[:, [6]]
    found = descend(condition(p, noise, available, loose), m, available, limits(9), keep=none)
    assert list(np.flatnonzero(~found.posterior.trusted)) == [4]
    (swap,) = meter_exchanges(found, available, 1e9, replace(limits(9), sigmas=1e9))
    trusted = available.copy()
    trusted[swap.innocent] = False
    now = leave_one_out(condition(p, noise, trusted, loose), m).chi_square
    assert swap.worse == pytest.approx(now - found.loo.chi_square, rel=1e-6)


def test_meters_to_keep_out_are_kept_out() -> None:
    rng = np.random.default_rng(8)
    _, p = street(rng, 9)
    noise = np.full(9, 0.002**2)
    m = readings(rng, p, noise)
    available = np.ones(9, dtype=bool)
    keep = np.arange(9) == 2
    found = descend(condition(p, noise, ~keep), m, available, limits(9), keep=keep)
    assert not found.posterior.trusted[2]
    back = descend(condition(p, noise, ~keep), m, available, limits(9), keep=np.zeros(9, dtype=bool))
    assert back.posterior.trusted[2]


def test_price_is_the_binomial_up_to_the_middle_and_rises_for_ever() -> None:
    for count in (5, 13, 146):
        for k in range(count // 2 + 1):
            if k and (count - k + 1) / k < np.exp(0.5):
                break
            assert set_cost(count, k) == pytest.approx(2.0 * log(comb(count, k)))
        steps = np.diff([set_cost(count, k) for k in range(count + 1)])
        third = count // 3
        assert set_cost(count, third, third) == set_cost(count, third)
        assert set_cost(count, count, third) >= set_cost(count, third) + 9.0 * (count - third)
        assert (steps >= 1.0 - 1e-12).all()


def test_a_bounded_fixed_error_is_allowed_as_a_bound() -> None:
    """Within the class by bound, beyond by chance: the smaller of both views."""
    std = np.array([1.0, 1.0])
    both = Limits(4.0, np.array([0.1, 0.0]), np.array([1.5, 9.0]), np.array([0.75, 0.75]))
    np.testing.assert_allclose(both.limit(std), [0.1 + 1.5 + 4.0 * 0.5, 4.0])
    np.testing.assert_allclose(both.limit(std, 0.5), [0.1 + 2.0, 2.0])
    assert both.penalty == 16.0


def test_what_was_answered_last_is_answered_again_for_the_same_only() -> None:
    rng = np.random.default_rng(4)
    allowed, certain, late = (rng.uniform(0.1, 1.0, 5) for _ in range(3))
    recent, stds = LimitCache(), [rng.uniform(0.5, 2.0, 5) for _ in range(2)]
    for _ in range(40):
        std, sigmas, part = (
            stds[rng.integers(2)],
            float(rng.choice([3.0, 4.0])),
            float(rng.choice([0.6, 1.0])),
        )
        model = rng.uniform(0.0, 1.0, 5)
        given = (sigmas, model, allowed, certain, None, late)
        np.testing.assert_array_equal(
            Limits(*given, recent).limit(std, part), Limits(*given).limit(std, part)
        )
    assert recent.last is not None


def crowd(seed: int, count: int) -> tuple[np.random.Generator, Prior, Floats, Floats]:
    """Meters that few common causes move, their noise, and honest readings."""
    rng = np.random.default_rng([25, seed])
    root = rng.normal(size=(count, 5))
    S, noise = root @ root.T, rng.uniform(0.05, 0.4, count)
    m = root @ rng.normal(size=5) + np.sqrt(noise) * rng.normal(size=count)
    return rng, Prior(S, np.arange(count), S.diagonal().copy()), noise, m


@pytest.mark.parametrize("seed", range(20, 60))
def test_who_was_believed_is_judged_by_those_admitted_too(seed: int) -> None:
    """The more is known the less an honest meter is off: one is dropped where, one by one, it would be."""
    rng, p, noise, m = crowd(seed, 24)
    m += np.where(rng.random(24) < 0.3, rng.normal(size=24) * 3.0, 0.0)
    start, every, zero = condition(p, noise, rng.random(24) < 0.4), np.ones(24, dtype=bool), np.zeros(24)
    # The better the others know, the less is left but for what is allowed.
    strict, found = Limits(2.5, zero, zero + 0.02, noise), list[Candidate]()
    with pytest.MonkeyPatch.context() as patch:
        for few in (search._MANY, 10**6):
            patch.setattr(search, "_MANY", few)
            found.append(descend(start, m, every, strict, keep=~every))
    many, one_by_one = found
    np.testing.assert_array_equal(many.trusted, one_by_one.trusted)
    assert many.posterior.updates == one_by_one.posterior.updates
    assert many.loo.chi_square == pytest.approx(
        leave_one_out(condition(p, noise, many.trusted), m).chi_square, rel=1e-8
    )


def vouching(seed: int) -> tuple[Prior, Floats, Floats]:
    """Eight of 24 meters lie, and two more at one bus tell the same lie."""
    rng, p, noise, m = crowd(seed, 24)
    m[rng.choice(24, 8, replace=False)] += rng.choice([-1.0, 1.0], 8) * 4.0
    S = np.zeros((25, 25))
    S[:24, :24], S[24, :24] = p.covariance, 0.6 * p.covariance[0]
    S[:24, 24], S[24, 24] = S[24, :24], 0.36 * p.variance[0] + 0.05
    at = np.append(np.arange(24), [24, 24])
    m = np.append(m, 0.6 * m[0] + np.array([3.0, 3.05]))
    return Prior(S[:, at], at, S.diagonal().copy()), np.append(noise, [0.02, 0.02]), m


def test_where_pairs_may_fall_nobody_falls_in_a_crowd() -> None:
    """Each move is the best there is, of one or of two, however many are beyond their limits."""
    every, vouched = np.ones(26, dtype=bool), 0
    for seed in range(20):
        p, noise, m = vouching(seed)
        start, found = condition(p, noise, every), list[Candidate]()
        loo = leave_one_out(start, m)
        beyond = np.abs(loo.residual) > limits(26).limit(loo.std)
        with pytest.MonkeyPatch.context() as patch:
            for few, pairs in ((search._MANY, True), (10**6, True), (10**6, False)):
                patch.setattr(search, "_MANY", few)
                found.append(descend(start, m, every, limits(26), keep=~every, pairs=pairs))
        asked, one_by_one, single = found
        np.testing.assert_array_equal(asked.trusted, one_by_one.trusted)
        assert asked.posterior.updates == one_by_one.posterior.updates
        assert asked.cost == pytest.approx(one_by_one.cost, rel=1e-9)
        enough = np.count_nonzero(beyond) >= 6
        vouched += bool(enough and single.trusted[24:].all() and not asked.trusted[24:].any())
    assert vouched >= 2


@pytest.mark.parametrize("seed", range(6))
def test_where_powers_may_be_false_nobody_falls_in_a_crowd(seed: int) -> None:
    """What loosening gains changes with each who falls: the cost stays what it is by definition."""
    rng = np.random.default_rng([26, seed])
    columns, p = street(rng, 24)
    noise, every = np.full(24, 0.001**2), np.ones(24, dtype=bool)
    m = readings(rng, p, noise)
    m[rng.choice(24, 8, replace=False)] += 0.03 * rng.choice([-1.0, 1.0], 8)
    m -= 0.3 * columns[1:, int(np.argmax(columns[1:].sum(axis=0)))]
    faults = FaultDictionary(
        std=np.full(24, 0.1),
        charge=np.full(24, 3.0),
        size=(columns[1:] ** 2).sum(axis=0),
        meter=np.full(24, -1),
        columns=lambda which: columns[:, which],
        weighted=lambda weights: weights @ columns[1:],
    )
    start, found = condition(p, noise, every), list[Candidate]()
    with pytest.MonkeyPatch.context() as patch:
        for few in (search._MANY, 10**6):
            patch.setattr(search, "_MANY", few)
            found.append(descend(start, m, every, limits(24), keep=~every, faults=faults))
    asked, one_by_one = found
    np.testing.assert_array_equal(asked.trusted, one_by_one.trusted)
    assert asked.faults == one_by_one.faults
    assert asked.posterior.updates == one_by_one.posterior.updates
    loose = 0.1 * columns[:, list(asked.faults)]
    anew = leave_one_out(condition(p, noise, asked.trusted, loose), m).chi_square
    suspects = int(np.count_nonzero(~asked.trusted))
    assert asked.cost == pytest.approx(anew + set_cost(24, suspects) + asked.charge, rel=1e-6)


@pytest.mark.parametrize("few", [1, 10**6])
def test_moves_are_bounded_though_many_are_made_at_once(few: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each who moves counts, not each time that some do: half as many moves as meters leave half of them."""
    _, p, noise, m = crowd(0, 24)
    every = np.ones(24, dtype=bool)
    start = condition(p, noise, ~every)
    monkeypatch.setattr(search, "_MANY", few)
    monkeypatch.setattr(search, "_AT_ONCE", 6)
    assert descend(start, m, every, replace(limits(24), sigmas=9.0), keep=~every).trusted.all()
    monkeypatch.setattr(search, "_MOVES_PER_METER", 0.5)
    found = descend(start, m, every, replace(limits(24), sigmas=9.0), keep=~every)
    assert found.posterior.updates == np.count_nonzero(found.trusted) == 12
