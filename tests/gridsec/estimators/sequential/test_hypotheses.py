"""Explanations of one scale, against all sets of liars there are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from gridsec.arrays import Bools, Floats
from gridsec.estimators import sequential
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt, SequentialDesign, hypotheses
from gridsec.estimators.sequential.hypotheses import HypothesisSearch, _components
from gridsec.estimators.sequential.posterior import (
    LeaveOneOut,
    Posterior,
    chi_square,
    condition,
    leave_one_out,
)
from gridsec.estimators.sequential.search import (
    Candidate,
    Candidates,
    Hypothesis,
    descend,
    false_power_charge,
    set_cost,
)
from gridsec.estimators.sequential.time_scales import Scales, ScaleTest, push, scale_test, update_posterior
from gridsec.grid.devices import MeterAccuracy, fleet
from gridsec.grid.network import Power
from gridsec.grid.radial import Feeder
from gridsec.interface import Frame

NEAR, FAR = 30, 15  # customers close to the busbar, and at the end of a long cable
JITTER = 0.001


def two_streets() -> SequentialDesign:
    """One short street, and one at the end of a long cable; loads known to 0.6 kW."""
    count = NEAR + FAR
    k = np.arange(count)
    r = np.where(k == NEAR, 0.4, 0.001)  # the long cable the errors of the loads move all behind it by 0.7 %
    feeder = Feeder(
        name="two streets",
        parent=np.where(k == NEAR, 0, k),
        r=r,
        x=0.4 * r,
        bus=k + 1,
        customers=tuple(f"c{i}" for i in k),
        buses=tuple(f"b{i}" for i in range(count + 1)),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(count),
    )
    accuracy = MeterAccuracy(np.zeros(count), np.zeros(count), np.full(count, JITTER), 0.0, 0.0, 2e-4)
    none = np.zeros(0)
    plant = Plant(feeder, fleet(none.astype(np.intp), [], none, 100.0), k, accuracy, 1)
    doubt = LoadDoubt(np.full(count, 0.006), np.full(count, 0.002), 600.0)
    return sequential.design(plant, doubt=doubt, step_s=1.0)


def search(design: SequentialDesign, m: Floats) -> Candidates:
    """What the first scale finds when everybody was believed until now."""
    made, now, view = prepared(design, m)
    return made(now, view)[0]


def prepared(design: SequentialDesign, m: Floats) -> tuple[HypothesisSearch, Posterior, ScaleTest]:
    """The search itself, and what it begins with."""
    state, all_meters = sequential.init(design, 0.0), np.ones(m.size, dtype=np.bool_)
    window = push(state.window, design.lengths, m, all_meters)
    scales = Scales(design, state.uncertainty, window, state.learned, np.zeros(m.size))
    now = update_posterior(None, scales[0], all_meters, None)
    view = scale_test(design, scales[0], leave_one_out(now, scales[0].m))
    return HypothesisSearch(design, scales, state.full_posteriors, state.trust, 0), now, view


def cost(design: SequentialDesign, m: Floats, suspects: Bools, accused_faults: tuple[int, ...] = ()) -> float:
    """J by definition, without what loosened directions are charged."""
    at = np.flatnonzero(~suspects)
    whole = design.prior.between[np.ix_(at, at)] + np.diag(design.white[at])
    more = (
        design.faults.columns(np.array(accused_faults, dtype=int)) * design.faults.std[list(accused_faults)]
    )[at + 1]
    return float(m[at] @ np.linalg.solve(whole + more @ more.T, m[at])) + set_cost(
        m.size, int(suspects.sum())
    )


def draw(design: SequentialDesign, seed: int, size: float) -> tuple[Floats, Bools]:
    """Residuals of one tick in which 7 of 15 far meters lie alike, and 6 near ones; and who they are."""
    rng = np.random.default_rng([5, seed])
    count = NEAR + FAR
    w = rng.multivariate_normal(np.zeros(count), design.prior.between + 1e-18 * np.eye(count))
    lies = np.zeros(count)
    lies[rng.choice(NEAR, 6, replace=False)] = size * rng.choice([-1.0, 1.0], 6)
    lies[NEAR + rng.choice(FAR, 7, replace=False)] = -size
    m = w + np.sqrt(design.white) * rng.normal(size=count) + lies
    return np.asarray(m), lies != 0.0


@pytest.mark.canary("0.022")
@pytest.mark.parametrize("size", [0.018, 0.022])
def test_where_the_word_of_many_stands_against_that_of_many_nobody_is_sure(size: float) -> None:
    """Seven of fifteen tell the same lie: what they say is as likely as what the others say, or not."""
    design, both_told = two_streets(), 0
    for seed in range(60):
        m, suspects = draw(design, seed, size)
        turned = np.where(np.arange(m.size) < NEAR, suspects, ~suspects)
        found = search(design, m)
        within = found.best.cost + 2.0 * np.log(design.options.like)
        sides = cost(design, m, suspects), cost(design, m, turned)
        assert found.best.cost <= min(sides) + 0.1
        if max(sides) < within - 0.5:
            both_told += 1
            near = [~each.trusted for each in (found.best, *found.others) if each.cost <= within]
            assert not np.logical_and.reduce(near)[NEAR:].any()
    assert both_told > 20


def watched(design: SequentialDesign, seed: int, far: int) -> tuple[set[int], set[int]]:
    """Who is ever named, and who lies, where loads wander for 40 s as the design supposes."""
    rng = np.random.default_rng([11, seed])
    count = NEAR + FAR
    street, near = NEAR + rng.choice(FAR, far, replace=False), rng.choice(NEAR, 3, replace=False)
    root = np.linalg.cholesky(design.prior.between + 1e-14 * np.eye(count))
    keeps = np.exp(-1.0 / 600.0)
    none, zero, z = np.full(count, np.nan), np.zeros(count), rng.normal(size=count)
    state, named = sequential.init(design, 0.0), set()
    for k in range(40):
        z = keeps * z + np.sqrt(1.0 - keeps**2) * rng.normal(size=count)
        y = 1.0 + root @ z + np.sqrt(design.white) * rng.normal(size=count)
        if k >= 10:
            y[street] -= 0.018
            y[near] += 0.02
        seen = np.ones(count, dtype=np.bool_)
        frame = Frame(k + 1.0, y, seen, 1.0, zero, zero, zero, zero, none, np.full(count, np.inf))
        state, _, verdict = sequential.step(design, state, frame)
        named |= set(np.flatnonzero(verdict.suspects).tolist())
    return named, {*street.tolist(), *near.tolist()}


@pytest.mark.canary("26")
@pytest.mark.parametrize("seed", [2, 6, 16, 20, 26])
def test_nobody_of_the_other_side_is_named_by_a_breath_of_noise(seed: int) -> None:
    """Seven of fifteen tell one lie: without a common amount for them, noise tips the scales at some tick."""
    named, suspects = watched(two_streets(), seed, 7)
    assert named <= suspects


def test_a_third_of_a_street_is_named() -> None:
    for seed in range(4):
        named, suspects = watched(two_streets(), seed, 5)
        assert named == suspects


def test_a_group_off_by_one_amount_gains_by_definition() -> None:
    design = two_streets()
    m, _ = draw(design, 3, 0.02)
    hunt, now, view = prepared(design, m)
    every = design.prior.between + np.diag(design.white)
    best = hunt.likeliest(now, view).best
    found = hunt._neighbourhoods(now, best)
    assert any((group.meters & ~best.trusted).any() for group in found)
    assert not all((group.meters & ~best.trusted).any() for group in found)
    for group in found:
        alike = 1e2 * group.meters
        with_amount = m @ np.linalg.solve(every + np.multiply.outer(alike, alike), m)
        assert group.gain == pytest.approx(m @ np.linalg.solve(every, m) - with_amount, rel=1e-4)
        assert group.gain > group.charge >= 2.0 * np.log(m.size * design.max_attacked) - 1e-9
    net = [group.gain - group.charge for group in found]
    assert net == sorted(net, reverse=True)


def test_a_street_off_alike_is_a_rival_at_the_price_of_one_hypothesis() -> None:
    """The far street but for two is off by one amount: the search accuses the two, the rival the rest."""
    design, count = two_streets(), NEAR + FAR
    rng = np.random.default_rng(6)
    root = np.linalg.cholesky(design.prior.between + 1e-14 * np.eye(count))
    m = root @ rng.normal(size=count) + np.sqrt(design.white) * rng.normal(size=count)
    design = replace(design, max_attacked=FAR)
    group = np.arange(NEAR, count - 2)
    m[group] -= 0.02
    hunt, _, _ = prepared(design, m)
    base = np.ones(count, dtype=np.bool_)
    best = hunt._descend(hunt._condition(~np.isin(np.arange(count), [count - 2, count - 1])), ~base)
    first = next(
        one
        for one in hunt._neighbourhoods(hunt._condition(base), best)
        if set(group) == set(np.flatnonzero(one.meters))
    )
    charge = 2.0 * float(np.log(count * (count - FAR)))
    assert first.charge == pytest.approx(charge)
    _, other = hunt._with_offsets(best, base, [first])
    alike = np.where(np.isin(np.arange(count), group), 0.2, 0.0)
    every = design.prior.between + np.diag(design.white) + np.multiply.outer(alike, alike)
    assert np.array_equal(np.flatnonzero(~other.trusted), group)
    left = m @ np.linalg.solve(every, m)
    # Each scale has seen one reading, so all scales agree.
    assert other.cost == pytest.approx(left + charge, rel=1e-6)


def test_one_amount_for_a_group_by_definition() -> None:
    design, rng = two_streets(), np.random.default_rng(9)
    m, _ = draw(design, 3, 0.02)
    alike = np.zeros((m.size, 2))
    alike[NEAR : NEAR + 4, 0] = alike[2:5, 1] = 0.2
    trusted = rng.random(m.size) < 0.8
    at = np.flatnonzero(trusted)
    whole = design.prior.between + np.diag(design.white) + alike @ alike.T
    wanted = m[at] @ np.linalg.solve(whole[np.ix_(at, at)], m[at])
    found = chi_square(design.prior, design.white, m, trusted, None, alike)
    assert found == pytest.approx(wanted, rel=1e-8)
    # One that may be off by anything by itself is as good as dropped.
    one, there = np.zeros((m.size, 1)), trusted.copy()
    one[at[3]], there[at[3]] = 1e3, False
    without = chi_square(design.prior, design.white, m, there)
    assert chi_square(design.prior, design.white, m, trusted, None, one) == pytest.approx(without, rel=1e-5)


def test_a_street_is_turned_round_where_powers_are_accused_too() -> None:
    """One of the seven claims a load as well that is not there: if it is honest, that is charged in full."""
    plain, told, full = two_streets(), 0, 0
    faults = plain.faults
    design = replace(plain, faults=replace(faults, std=np.full(faults.std.size, 0.4)))
    feeder, count = design.plant.feeder, NEAR + FAR
    for seed in range(8):
        rng = np.random.default_rng([8, seed])
        w = rng.multivariate_normal(np.zeros(count), design.prior.between + 1e-18 * np.eye(count))
        group = NEAR + rng.choice(FAR, 7, replace=False)
        m = w + np.sqrt(design.white) * rng.normal(size=count)
        m -= 0.2 * feeder.columns(Power.ACTIVE, group[:1])[feeder.bus, 0]
        m[group] -= 0.018
        made, now, _ = prepared(design, m)
        for each in made._reversals(made._descend(now, np.zeros(count, dtype=bool), design.faults)):
            suspects, which = ~each.trusted, np.array(each.faults, dtype=int)
            honest = each.trusted[faults.meter[which]]
            charge = np.where(
                honest, faults.charge[which], false_power_charge(suspects.sum())
            ).sum() * set_cost(count, 1)
            told, full = told + bool(which.size), full + bool(honest.any())
            assert each.charge == pytest.approx(charge)
            assert each.cost == pytest.approx(cost(design, m, suspects, each.faults) + charge, rel=1e-6)
    assert told > 4
    assert full > 0


@pytest.mark.parametrize("suspected", [False, True])
def test_what_is_judged_is_what_each_search_begins_with(
    suspected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where this scale lifts a suspicion, and so begins with another fit than that it was asked of."""
    design, told = two_streets(), list[bool]()
    m, suspects = draw(design, 3, 0.05)
    m[suspects & (np.arange(m.size) >= NEAR)] += 0.05
    suspects[NEAR:] = False
    made, now, view = prepared(design, m)
    if suspected:
        trust = replace(made.trust, accused=((0, 0),))
        direction = made.scales.unknowns(trust.accused)
        now = update_posterior(None, made.scales[0], np.ones(m.size, dtype=np.bool_), direction)
        view = scale_test(design, made.scales[0], leave_one_out(now, m))
        made = HypothesisSearch(design, made.scales, made.full_posteriors, trust, 0)
    plain = descend

    def checked(
        start: Posterior, m: Floats, *rest: Any, loo: LeaveOneOut | None = None, **more: Any
    ) -> Candidate:
        # Those that believe somebody begin with what another one came to.
        told.append(loo is not None and not more["protected"].size)
        if loo is not None:
            np.testing.assert_allclose(loo.residual, leave_one_out(start, m).residual)
        return plain(start, m, *rest, loo=loo, **more)

    monkeypatch.setattr(hypotheses, "descend", checked)
    found, _ = made(now, view)
    np.testing.assert_array_equal(~found.best.trusted, suspects)
    assert any(told) is not suspected


def test_each_scale_is_made_once() -> None:
    scales = prepared(two_streets(), np.zeros(NEAR + FAR))[0].scales
    each = [scales[s] for s in range(4)]
    assert all(scales[s] is one for s, one in enumerate(each))
    assert len({id(one) for one in each}) == len(each)


def test_linked_are_connected_components() -> None:
    rng = np.random.default_rng(6)
    for size in (0, 1, 2, 7, 20):
        link = rng.random((size, size)) < 1.2 / max(size, 1)
        link |= link.T | np.eye(size, dtype=bool)
        _, label = connected_components(link) if size else (0, np.zeros(0))
        parts = _components(link)
        assert sorted(np.concatenate([*parts, np.zeros(0, dtype=int)]).tolist()) == list(range(size))
        assert {frozenset(part.tolist()) for part in parts} == {
            frozenset(np.flatnonzero(label == k).tolist()) for k in set(label.tolist())
        }


def several_scales(seed: int, accused: tuple[tuple[int, int], ...] = ()) -> HypothesisSearch:
    """A search on the first scale when each has seen something else, with a kept fit of all meters each."""
    rng, design = np.random.default_rng([17, seed]), two_streets()
    state, every = sequential.init(design, 0.0), np.ones(NEAR + FAR, dtype=np.bool_)
    window = state.window
    for _ in range(design.lengths[-1]):
        window = push(window, design.lengths, 0.01 * rng.normal(size=every.size), every)
    scales = Scales(design, state.uncertainty, window, state.learned, np.zeros(every.size))
    each = range(len(design.lengths))
    full_posteriors = tuple(condition(scales[s].prior, scales[s].noise, every) for s in each)
    return HypothesisSearch(design, scales, full_posteriors, replace(state.trust, accused=accused), 0)


@pytest.mark.parametrize("seed", range(3))
def test_each_scale_has_its_own_misfit(seed: int) -> None:
    """Whether it is worked out anew, from a kept fit, or with what else is accused; asked in any order."""
    rng, made = np.random.default_rng(seed), several_scales(seed)
    trusted = rng.random(NEAR + FAR) < 0.85
    start = made._condition(trusted)
    solution = Candidate(trusted, (), 0.0, 0.0, start, leave_one_out(start, made.here.m))
    lone, also = Hypothesis(trusted, (), 0.0, 0.0), Hypothesis(trusted, (3,), 0.0, 0.0)
    group = np.flatnonzero(~trusted)[:3]
    more, alike = np.isin(np.arange(trusted.size), group), np.zeros((trusted.size, 1))
    alike[group] = 0.2

    def expected(who: Bools, accused_faults: tuple[int, ...], alike: Floats | None = None) -> list[float]:
        faults, all_ = made.scales.faults, [made.scales[s] for s in range(len(made.design.lengths))]
        which = np.array(accused_faults, dtype=int)
        loose = faults.columns(which) * faults.std[which] if accused_faults else None
        return [chi_square(one.prior, one.noise, one.m, who, loose, alike) for one in all_]

    plain = expected(trusted, ())
    assert len({round(each, 6) for each in plain}) == len(plain) > 2
    for _ in range(2):
        np.testing.assert_allclose(made._chi_squares(lone), plain, rtol=1e-8)
        np.testing.assert_allclose(made._chi_squares(also), expected(trusted, (3,)), rtol=1e-8)
        np.testing.assert_allclose(made._chi_squares(solution), plain, rtol=1e-8)
        for found in (lone, solution):
            both = expected(trusted | more, (), alike)
            np.testing.assert_allclose(made._chi_squares(found, more, alike), both, rtol=1e-8)


def test_what_else_is_accused_stays_so_in_every_start() -> None:
    """A kept fit of all meters knows nothing of it."""
    rng, made = np.random.default_rng(1), several_scales(1, accused=((4, 1),))
    trusted = rng.random(NEAR + FAR) < 0.85
    loose = made.scales.unknowns(made.accused)
    assert loose is not None
    found = made._condition(trusted)
    anew = condition(made.here.prior, made.here.noise, trusted, loose)
    np.testing.assert_array_equal(found.unknowns, anew.unknowns)
    np.testing.assert_allclose(found.Q, anew.Q, rtol=1e-9, atol=1e-9 * np.abs(anew.Q).max())


def test_fits_of_exact_meters_are_not_made_from_a_kept_one() -> None:
    """What many that fall at once leave would be lost in rounding."""
    rng, made = np.random.default_rng(2), several_scales(2)
    trusted, prior = rng.random(NEAR + FAR) < 0.85, made.here.prior
    assert made._condition(trusted).updates == np.count_nonzero(~trusted) > 0
    noise = np.full(trusted.size, 1e-8 * float(prior.variance.max()))
    made.here = replace(made.here, noise=noise)
    made.covering[0] = condition(prior, noise, np.ones_like(trusted))
    found, anew = made._condition(trusted), condition(prior, noise, trusted)
    assert found.updates == 0
    np.testing.assert_array_equal(found.Q, anew.Q)


def test_a_false_power_beside_its_own_suspect_counts_once_between_similar_groups() -> None:
    """A device with false voltage and power is a rival at the price of two accusations, not three."""
    design = two_streets()
    made, now, view = prepared(design, np.zeros(NEAR + FAR))
    best = made.likeliest(now, view).best
    one = set_cost(NEAR + FAR, 1)

    def of(meters: list[int], powers: tuple[int, ...]) -> Hypothesis:
        trusted = np.ones(NEAR + FAR, dtype=np.bool_)
        trusted[meters] = False
        return Hypothesis(trusted, powers, 0.0, 0.0)

    two = replace(best, trusted=of([3, 4], ()).trusted)
    assert made.relief(two, of([7, 8], (8,))) == pytest.approx((false_power_charge(2) - 1.0) * one)
    assert made.relief(two, of([7, 8], ())) == 0.0
    assert made.relief(two, of([7, 8], (9,))) == 0.0  # meter 9 is not a suspect
    assert made.relief(two, of([7, 8, 9], (8,))) == 0.0  # more suspect meters
    assert made.relief(two, of([7, 8, 9, 10], (8,))) == 0.0  # more than twice as many accusations
    assert made.relief(of([3, 4], (4,)), of([7, 8], ())) == 0.0  # the best hypothesis gets none
