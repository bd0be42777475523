"""Check of a naming under collusion: no meter is named that other meters with one amount may replace."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import inf

import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import collusion
from gridsec.estimators.modal.costs import SearchProblem, cost, costs, penalties
from gridsec.estimators.modal.mirrors import Neighbourhoods
from gridsec.estimators.modal.search import ALIKE, DOUBT, Identification
from tests.gridsec.estimators.modal.test_search import problem

METERS, NOISE, SHARED = 12, 0.01, 3.0
"""Meters of a street in two laterals of six, white variance of each, variance that a lateral shares."""


def street(lie: Floats, seed: int = 0, charge: float = 5.0, power: float = 0.0) -> SearchProblem:
    """Scores of a lie, (p,), where the voltages of each lateral move alike.

    power: amount of a false power, which moves the second lateral's meters apart.
    """
    V = NOISE * np.eye(METERS) + SHARED * np.kron(np.eye(2), np.ones((6, 6)))
    W = np.hstack([np.eye(METERS), np.append(np.zeros(6), np.linspace(-1.0, 1.0, 6))[:, None]])
    noise = np.linalg.cholesky(V) @ np.random.default_rng(seed).standard_normal(METERS)
    F = W.T @ np.linalg.solve(V, W)
    y = W.T @ np.linalg.solve(V, W @ np.append(lie, power) + noise)
    bound = np.full(METERS + 1, inf)
    return SearchProblem(y, F, np.ones(METERS + 1), METERS, np.append(np.zeros(METERS), charge), bound)


def explanation(given: SearchProblem, accused: Bools, *, power: bool = False) -> Identification:
    """One explanation, which names all meters that it accuses, (p,)."""
    chosen = np.append(accused, power)
    return Identification(chosen[None], np.zeros(1, np.intp), np.ones(1), accused, (given,))


def contested(given: Identification, masked: Bools, most: int, *, powers: bool = False) -> Bools:
    """Named meters that other explanations replace, (p,)."""
    return given.named & ~collusion.weighed(given, masked, near(most, powers=powers)).found.named


def near(most: int, *, powers: bool = False) -> Neighbourhoods:
    """The two laterals, halves of them, and one phase; the one power, or a power of each meter's customer."""
    laterals = np.repeat(np.eye(4, dtype=np.bool_), 3, axis=1)
    whole = np.repeat(np.eye(2, dtype=np.bool_), 6, axis=1)
    own = METERS + np.arange(METERS) * powers
    return Neighbourhoods(np.vstack([laterals, whole]), np.ones((METERS, 1), dtype=np.bool_), most, own)


@pytest.fixture(autouse=True)
def unit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Amounts of any size have the prior size of these problems."""
    monkeypatch.setattr(collusion, "WIDE", 1.0)


def some(*meters: int) -> Bools:
    """Places of meters, (p,)."""
    return np.isin(np.arange(METERS), meters)


NONE = some()
NOT_FIRST = ~some(0, 1, 2, 3)
NO_SETS = np.zeros((0, METERS), dtype=np.bool_)


def test_the_evidence_is_the_cost_without_the_penalty_of_meters() -> None:
    """Own amounts for one meter; for more, the mean of the likelihoods with own amounts and amounts alike."""
    given = problem(3, p=8, others=2)
    one, two = np.zeros((2, 10), dtype=np.bool_)
    one[[2, 9]], two[[1, 4, 9]] = True, True
    own, both = collusion._evidence(given, np.stack([one, two]))
    assert np.isclose(own, cost(given, one) - penalties(8)[1])
    each = [cost(given, two), float(costs(given, two[None], ALIKE)[0])]
    mean = -2.0 * np.log(np.mean(np.exp(-0.5 * np.array(each))))
    assert np.isclose(both, mean - penalties(8)[2])


@pytest.mark.parametrize("seed", range(8))
def test_the_set_with_one_amount_is_the_best_of_all(seed: int) -> None:
    """Against all subsets of the other meters with an amount of the sign that was asked for."""
    given, room = street(0.8 * some(0, 1, 2, 3).astype(np.float64), seed), 4
    own, barred = np.append(some(7), False), some(11)
    at, y, F = collusion._beside(given, own, ~(own[:METERS] | barred))
    found = collusion._Relaxed(y, F, 1.0, np.ones(at.size, dtype=np.bool_), room, NO_SETS[:, : at.size])
    least, inside = found.best(0.5)
    assert set(at.tolist()) == set(range(METERS)) - {7, 11}

    def exact(members: Bools) -> float:
        column = np.zeros(METERS + 1)
        column[at[members]] = 1.0
        W = np.stack([own.astype(np.float64), column], axis=1)
        F, y = W.T @ given.F @ W, W.T @ given.y
        if np.linalg.solve(np.eye(2) + F, y)[1] < 0.0:
            return inf
        whole = np.linalg.slogdet(np.eye(2) + F)[1] - y @ np.linalg.solve(np.eye(2) + F, y)
        alone = np.log1p(F[0, 0]) - y[0] ** 2 / (1.0 + F[0, 0])
        return float(whole - alone)

    every = (np.array(each, dtype=np.bool_) for each in product((False, True), repeat=10))
    assert np.isclose(least, exact(inside))
    assert np.isclose(least, min(exact(each) for each in every if 0 < each.sum() <= room))


@pytest.mark.parametrize("amount", [0.1, 0.3])
def test_a_relaxation_of_too_many_meters_is_solved_for_larger_amounts(amount: float) -> None:
    """Seven of ten meters of a graded lateral: with the amounts given, the relaxation has more than seven."""
    rng, p = np.random.default_rng(23), 20
    V = 0.04 * np.eye(p) + 0.6 * np.ones((p, p))
    V += 3.0 * np.kron(np.eye(2), np.outer(np.linspace(0.5, 1.5, 10), np.linspace(0.5, 1.5, 10)))
    lie = np.isin(np.arange(p), rng.permutation(10)[:7])
    F = np.linalg.inv(V)
    y = F @ (0.8 * lie + np.linalg.cholesky(V) @ rng.standard_normal(p))
    relaxed = collusion._Relaxed(y, F, 1.0, np.ones(p, dtype=np.bool_), 7, np.zeros((0, p), dtype=np.bool_))
    assert relaxed._share(amount, np.full(p, 0.5)).sum() > 7.0
    least, inside = relaxed.best(amount)
    assert (inside == lie).all()
    assert least == collusion._Limited(relaxed, lie[None]).cost[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_bound_is_that_of_all_amounts_of_the_sign(seed: int, sign: float) -> None:
    """Against nonnegative least squares, and below the fits of all sets that a search finds."""
    given, own = street(0.8 * some(0, 1, 2, 3).astype(np.float64), seed), np.append(some(7), False)
    at, y, F = collusion._beside(given, own, ~own[:METERS])
    relaxed = collusion._Relaxed(sign * y, F, 1.0, np.ones(at.size, dtype=np.bool_), 4, NO_SETS[:, : at.size])
    root = np.linalg.cholesky(F)
    aim = np.linalg.solve(root, sign * y)
    rest = nnls(root.T, aim)[1]
    bound, inside = relaxed.bound()
    assert np.isclose(bound, rest**2 - aim @ aim, rtol=1e-5, atol=1e-6)
    assert bound <= relaxed.best(0.5)[0]
    order = np.argsort(-nnls(root.T, aim)[0], kind="stable")
    assert set(np.flatnonzero(inside)) <= set(order[:4])


def test_a_known_set_is_improved_within_the_promise() -> None:
    """A set near the lie leads there; sets of more meters and of none are left out."""
    given = street(0.8 * some(0, 1, 2, 3).astype(np.float64))
    at, y, F = collusion._beside(given, np.zeros(METERS + 1, dtype=np.bool_), ~NONE)
    every = np.ones(at.size, dtype=np.bool_)
    beginning = np.stack([some(0, 1, 2, 6), some(*range(6)), NONE])
    known = collusion._Relaxed(y, F, 1.0, every, 4, beginning)
    assert known._known().tolist() == [some(0, 1, 2, 6).tolist()]
    least, inside = known.best(0.8)
    assert inside.tolist() == some(0, 1, 2, 3).tolist()
    assert np.isclose(least, collusion._Limited(known, inside[None]).cost[0], rtol=1e-12)


def test_sets_that_keep_names_are_told_for_the_next_search() -> None:
    """None where no name is kept."""
    given = street(0.8 * some(0, 1, 2, 3).astype(np.float64))
    first = collusion.weighed(explanation(given, some(4, 5)), NONE, near(4))
    assert [each.tolist() for each in first.replacing] == [[*some(0, 1, 2, 3).tolist(), False]]
    assert not collusion.weighed(explanation(given, some(0)), NONE, near(4)).replacing


def test_an_honest_meter_amid_colluding_ones_is_contested() -> None:
    """Four of a lateral are off by 0.8: its two honest meters seem to be off by the reverse."""
    given = street(0.8 * some(0, 1, 2, 3).astype(np.float64))
    honest, false = explanation(given, some(4, 5)), explanation(given, some(0, 1, 2, 3))
    assert (contested(honest, NONE, 4) == some(4, 5)).all()
    # The promise excludes the reverse where two meters are masked already, and not the truth's own.
    assert not contested(honest, some(10, 11), 4).any()
    assert (contested(false, NONE, 4) == some(0, 1, 2, 3)).all()


def evidence(given: SearchProblem, sets: Bools) -> Floats:
    """L of sets of meters, (k,), by the covariances of the amounts: independent ones and amounts alike."""
    out = []
    for each in sets:
        n = np.flatnonzero(each)
        F, y, one = given.F[np.ix_(n, n)], given.y[n], np.eye(n.size)
        own, alike = (
            np.linalg.slogdet(one + P @ F)[1] - y @ np.linalg.solve(one + P @ F, P @ y)
            for P in (one, ALIKE * np.ones_like(F) + (1.0 - ALIKE) * one)
        )
        both = 2.0 * np.log(2.0) - 2.0 * np.logaddexp(-0.5 * own, -0.5 * (alike + given.charge.max()))
        out.append(both if n.size > 1 else own)
    return np.array(out)


def by_enumeration(given: SearchProblem, accused: Bools, sign: float, most: int) -> Bools:
    """Meters accused (p,), all of one sign, that a set with one amount or with any amounts replaces, (p,)."""
    every = np.array([each for each in product((False, True), repeat=METERS) if sum(each) <= most])
    a, b = every @ given.y[:METERS], np.vecdot(every @ given.F[:METERS, :METERS], every)
    one = np.log1p(b) - a * a / (b + 1.0)
    # Members of the set accused have the reverse sign.
    usable = ~(every & accused).any(axis=1) | (sign * a < 0.0)
    L = np.where(usable, np.minimum(evidence(given, every), one), inf)
    own = min(evidence(given, accused[None])[0], one[(every == accused).all(axis=1)][0])
    against = evidence(given, accused & every) - own
    near = L - own < np.maximum(2.0 * np.log(1e3), 0.1 * against)
    return np.asarray((accused & ~every[near]).any(axis=0) | by_fits(given, accused, every))


def fit(given: SearchProblem, chosen: Bools) -> float:
    """Misfit that meters (p,) with amounts of the prior size take away, by the covariance of the scores."""
    n = np.flatnonzero(chosen)
    F, y = given.F[np.ix_(n, n)], given.y[n]
    return float(y @ np.linalg.solve(F + np.eye(n.size), y))


def by_fits(given: SearchProblem, accused: Bools, every: Bools) -> Bools:
    """Meters accused (p,) that sets (k, p) replace by their fits, at most twice the number of the accused."""
    least, out = 2.0 * np.log(1e3), np.zeros_like(accused)
    own, largest = fit(given, accused), min(int(every.sum(axis=1).max()), 2 * int(accused.sum()))
    for each in every[every.sum(axis=1) <= largest]:
        alone = fit(given, each)
        needed = [
            j for j in np.flatnonzero(accused & ~each) if fit(given, each | some(int(j))) - alone >= least
        ]
        one = each | some(*needed)
        if one.sum() <= largest and own - fit(given, one) < least:
            out |= accused & ~one
    return out


def test_meters_with_graded_amounts_contest_a_false_power_beside_a_meter() -> None:
    """Three of the second lateral read as by its power, and the honest 6 as the one that does not."""
    graded = np.append(np.zeros(6), np.linspace(-1.0, 1.0, 6))
    given = street(np.where(some(9, 10, 11), graded, 0.0))
    kept = collusion.weighed(explanation(given, some(6), power=True), NONE, near(4))
    assert kept.contested[6]
    assert not kept.found.named.any()
    assert all(some(10, 11)[each[:METERS]].sum() == 2 and not each[-1] for each in kept.replacing)


@pytest.mark.canary("5")
@pytest.mark.parametrize("seed", range(8))
def test_accused_meters_with_the_reverse_sign_contest_others(seed: int) -> None:
    """Meters 0 to 3 read high, 3 by less: beside the others the honest 4 and 5 seem low, and so does 3."""
    given, accused = street(0.8 * some(0, 1, 2) + 0.6 * some(3), seed), some(3, 4, 5)
    found = contested(explanation(given, accused), NONE, 4)
    assert found[[4, 5]].all()
    assert (found == by_enumeration(given, accused, -1.0, 4)).all()


@pytest.mark.parametrize(("amount", "members"), [(0.6, (3,)), (0.3, (3, 4))])
def test_the_evidence_against_meters_that_a_set_lacks_is_compared(
    amount: float, members: tuple[int, ...]
) -> None:
    """Meters 3 and 4 share a branch, and 3 is hardly off: the reverse of 3 explains most of the evidence."""
    V = NOISE * np.eye(METERS) + SHARED * np.kron(np.eye(2), np.ones((6, 6)))
    F = np.zeros((METERS + 1, METERS + 1))
    F[:METERS, :METERS] = 100.0 * np.linalg.inv(V + np.outer(some(3, 4), some(3, 4)))
    given = replace(street(np.zeros(METERS)), y=F[:, 4] * amount + F[:, 3] * 0.05, F=F)
    accused = some(3, 4)
    both, three, none = evidence(given, np.stack([accused, some(3), NONE]))
    assert three - both < collusion.MISFIT * (none - both)
    found = contested(explanation(given, accused), NONE, 4)
    assert (found == some(*members)).all()
    assert (found == by_enumeration(given, accused, 1.0, 4)).all()
    # With most powers read, amounts of any size contest no meters that are accused alone.
    read = collusion.weighed(explanation(given, accused), NONE, near(4), unread=False)
    assert (read.found.named == accused & ~(some(4) & (amount < 0.5))).all()


def test_a_set_that_contests_a_part_is_reported() -> None:
    """The meter that both explanations accuse stays named."""
    given = street(0.8 * some(0, 1, 2) + 2.0 * some(3))
    out = collusion.weighed(explanation(given, some(3, 4, 5)), NONE, near(4)).found
    assert (out.named == some(3)).all()
    assert (out.chosen[1, :METERS] == some(0, 1, 2, 3)).all()


def test_a_set_that_keeps_no_further_name_is_not_reported() -> None:
    """A likelier one with the reverse sign of meter 3 comes after one without any of the accused."""
    given, accused = street(0.8 * some(0, 1, 2) + 0.6 * some(3), 3), some(3, 4, 5)
    likelier, other = evidence(given, np.stack([some(0, 1, 2, 3), some(0, 1, 2)]))
    assert likelier < other
    out = collusion.weighed(explanation(given, accused), NONE, near(4)).found
    assert not out.named.any()
    assert not (out.chosen[:, :METERS] == some(0, 1, 2, 3)).all(axis=1).any()
    assert (~out.chosen[1:, :METERS] & accused).any(axis=1).all()


def test_meters_that_nothing_replaces_are_named() -> None:
    """Two meters of different laterals, off by far more than others can feign."""
    lie = 2.0 * some(0, 6).astype(np.float64)
    given = street(lie)
    assert not contested(explanation(given, some(0, 6)), NONE, 4).any()
    opposite = street(lie * np.where(some(6), -1.0, 1.0))
    assert not contested(explanation(opposite, some(0, 6)), NONE, 4).any()


@pytest.mark.parametrize("seed", range(4))
def test_a_decoy_protects_no_honest_meter(seed: int) -> None:
    """A meter of the other lateral is off by far more, in the direction in which the honest ones seem off."""
    lie = 0.8 * some(0, 1, 2, 3) - 2.0 * some(8)
    given = street(lie, seed)
    assert (contested(explanation(given, some(4, 5, 8)), NONE, 5) == some(4, 5)).all()
    assert not contested(explanation(street(-2.0 * some(2, 8), seed), some(2, 8)), NONE, 4).any()


def test_a_split_is_by_the_lateral_with_most_of_the_meters() -> None:
    """All in one half lateral, or one meter: no split by a lateral that has all."""
    laterals = near(4).laterals
    first, second = collusion._split(some(0, 2, 4, 7), laterals)
    assert (first == some(0, 2, 4)).all()
    assert (second == some(7)).all()
    assert [each.nonzero()[0].tolist() for each in collusion._split(some(0, 4, 5), laterals)] == [[4, 5], [0]]
    assert collusion._split(some(0, 2), laterals) == collusion._split(some(3), laterals) == ()


def test_a_sole_fault_is_left_to_the_prior() -> None:
    """Without masked meters one fault is likelier than many; with them it is contested."""
    given = street(0.8 * some(0, 1, 2, 3, 4).astype(np.float64))
    one = explanation(given, some(5))
    assert not contested(one, NONE, 5).any()
    assert (contested(one, some(11), 6) == some(5)).all()


def test_an_explanation_beyond_the_promise_names_nothing() -> None:
    """More accused meters than the promise or a third, those that are masked included."""
    given = street(2.0 * some(0, 1, 6, 7).astype(np.float64))
    four = explanation(given, some(0, 1, 6, 7))
    assert not contested(four, NONE, 1).any()
    assert (contested(four, some(11), 1) == four.named).all()
    beside = explanation(busbar(2.0 * some(0, 1, 6, 7).astype(np.float64)), some(0, 1, 6, 7), power=True)
    assert collusion.weighed(beside, some(11), near(1)).contested[-1]


def test_nothing_named_is_not_contested() -> None:
    """Explanations that name no meter."""
    given = street(0.8 * some(0, 1, 2, 3).astype(np.float64))
    shown = explanation(given, some(4, 5))
    nothing = Identification(shown.chosen, shown.model, shown.weight, NONE, shown.problems)
    assert collusion.weighed(nothing, NONE, near(4)).found is nothing


def test_a_false_power_beside_it_protects_no_manipulated_meter() -> None:
    """The margin follows from the evidence against the meter, not from that of a power that is far off."""
    given = street(0.6 * some(0).astype(np.float64), power=8.0)
    both = explanation(given, some(0), power=True)
    evidence = collusion._evidence(given, np.stack([np.append(some(0), True), np.append(NONE, True)]))
    assert collusion.MISFIT * abs(evidence[0]) > evidence[1] - evidence[0] > 20.0
    assert not contested(both, NONE, 4).any()


def test_the_other_set_is_no_likelier_than_the_explanation() -> None:
    """It is reported behind the explanation, also where it fits better."""
    given = street(0.8 * some(0, 1, 2, 3).astype(np.float64))
    out = collusion.weighed(explanation(given, some(4, 5)), NONE, near(4)).found
    assert (out.chosen[0, :METERS] == some(4, 5)).all()
    assert (out.chosen[1, :METERS] == some(0, 1, 2, 3)).all()
    assert out.weight[0] > out.weight[1] > 0.4


def test_meters_without_readings_replace_nothing() -> None:
    """All other meters are silent since the onset: there is no set to look for."""
    given = street(2.0 * some(0, 6).astype(np.float64))
    seen = np.append(some(0, 6), False)
    silent = replace(given, y=given.y * seen, F=given.F * np.outer(seen, seen))
    assert not contested(explanation(silent, some(0, 6)), NONE, 4).any()


def busbar(lie: Floats) -> SearchProblem:
    """Scores of a lie, (p,): loads move the meters 4 to 11 alike, and the busbar's meter all of them."""
    V = NOISE * np.eye(METERS) + SHARED * np.outer(NOT_FIRST, NOT_FIRST)
    W = np.hstack([np.eye(METERS), -np.ones((METERS, 1))])
    F, y = W.T @ np.linalg.solve(V, W), W.T @ np.linalg.solve(V, lie)
    charge = np.append(np.zeros(METERS), 5.0)
    return SearchProblem(y, F, np.ones(METERS + 1), METERS, charge, np.full(METERS + 1, inf))


@pytest.mark.parametrize(("most", "named"), [(5, False), (4, True)])
def test_colluding_meters_contest_the_meter_of_the_busbar(most: int, named: bool) -> None:
    """Four meters are off by one amount: beside a fifth the busbar is named only if five are not promised."""
    given = busbar(0.8 * ~NOT_FIRST + 2.0 * some(6))
    weighed = collusion.weighed(explanation(given, some(6), power=True), NONE, near(most))
    out = weighed.found
    assert weighed.contested[-1] == (not named)
    assert (out.weight @ ~out.chosen[:, -1] < DOUBT) == named
    assert (out.named == some(6)).all()
    sets = [np.append(some(6), True), np.append(some(0, 1, 2, 3, 6), False)]
    assert {each.tobytes() for each in out.chosen} == {each.tobytes() for each in sets[: 2 - named]}


def test_a_sole_fault_of_the_busbar_is_left_to_the_prior() -> None:
    """Without masked meters it is likelier than four meters; beside a masked one it is contested."""
    given = busbar(0.8 * ~NOT_FIRST)
    one = explanation(given, NONE, power=True)
    assert collusion.weighed(one, NONE, near(5)).found is one
    out = collusion.weighed(one, some(11), near(5)).found
    assert out.weight @ ~out.chosen[:, -1] >= DOUBT


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_bound_without_accused_meters_is_that_of_all_sets(seed: int, sign: float) -> None:
    """Against bounded least squares of all meters and the power, and against the costs of sets."""
    random = np.random.default_rng(seed)
    given = street(0.3 * random.standard_normal(METERS), seed, power=0.4)
    accused, power = np.append(some(1, 2, 7), False), np.append(NONE, True)
    loose = collusion._Loose.of(given, accused | power)
    assert loose is not None
    found = loose.without(accused, sign)
    A = given.F + np.diag(np.where(power, given.std**-2.0, 0.0))
    half = np.linalg.cholesky(A)
    target = np.linalg.solve(half, given.y)
    least, most = np.full(METERS + 1, -inf), np.full(METERS + 1, inf)
    (most if sign > 0.0 else least)[accused] = 0.0
    exact = lsq_linear(half.T, target, (least, most), tol=1e-14)
    assert found == pytest.approx(2.0 * exact.cost - target @ target, rel=1e-6)
    for chosen in (random.random((200, METERS + 1)) < 0.4) & ~accused:
        assert cost(given, chosen) - penalties(METERS)[chosen[:METERS].sum()] >= found
    # The power itself is accused: sets without it.
    alone = collusion._Loose.of(given, power)
    assert alone is not None
    rest = -given.y[:METERS] @ np.linalg.solve(given.F[:METERS, :METERS], given.y[:METERS])
    assert alone.least <= alone.without(power, sign) <= rest + 1e-6 * abs(rest)


def test_no_bound_is_given_where_readings_are_too_few() -> None:
    given = street(np.zeros(METERS))
    few = replace(given, F=np.ones_like(given.F))
    assert collusion._Loose.of(few, np.append(NONE, False)) is None


def customers(lie: Floats, powers: Floats, charge: float = 5.0) -> SearchProblem:
    """Scores of false readings (p,) and powers (p,): power 1 moves as meter 4 and power 7 beside meter 1."""
    V = NOISE * np.eye(METERS) + SHARED * np.kron(np.eye(2), np.ones((6, 6)))
    effect = np.tril(np.ones((METERS, METERS))) / METERS
    effect[:, 1] = np.eye(METERS)[4] + effect[:, 7] - np.eye(METERS)[1]
    W = np.hstack([np.eye(METERS), effect])
    F, y = W.T @ np.linalg.solve(V, W), W.T @ np.linalg.solve(V, W @ np.append(lie, powers))
    bound = np.append(np.full(METERS, inf), np.full(METERS, 5.0))
    return SearchProblem(y, F, np.ones(2 * METERS), METERS, np.repeat([0.0, charge], METERS), bound)


def test_customers_with_false_powers_contest_an_honest_meter() -> None:
    """Meter 1 and its power imitate meter 4 and power 7; no other meters do."""
    given = customers(2.0 * some(1), 2.0 * some(1))
    shown = Identification(
        np.append(some(4), some(7))[None], np.zeros(1, np.intp), np.ones(1), some(4), (given,)
    )
    assert (contested(shown, NONE, 4, powers=True) == some(4)).all()
    out = collusion.weighed(shown, NONE, near(4, powers=True)).found
    assert (out.chosen[1] == np.append(some(1), some(1))).all()
    # The customer's meter is masked already, and its power is free.
    assert (contested(shown, some(1), 4, powers=True) == some(4)).all()
