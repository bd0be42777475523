"""Distributed estimation against one dense estimator with all readings."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from feeders.model.site import Site, load, load_doubt
from gridsec.arrays import Bools, Floats
from gridsec.errors import InputInvalid
from gridsec.estimators import distributed
from gridsec.estimators.distributed import Area, Concentrator, Message, exchange, laterals, partition, verdict
from gridsec.estimators.front.posterior import LoadDoubt, voltage_prior
from gridsec.grid.radial import Feeder
from gridsec.interface import Decision

BUSBAR = 0.002  # standard deviation of the squared busbar voltage, pu


def doubt(feeder: Feeder) -> LoadDoubt:
    """Errors with every kind of common part."""
    size = feeder.bus.size
    spread = np.linspace(0.5, 1.5, size)
    return LoadDoubt(0.004 * spread, 0.002 * spread, 600.0, common_p=0.2, common_q=0.4, together=0.1)


def cut(name: str, customers: int) -> tuple[Site, tuple[Area, ...], Floats]:
    site = load(name)
    assert isinstance(site.feeder, Feeder)
    noise = np.linspace(1.0, 4.0, site.meters.size) * 1e-6
    tops = laterals(site.feeder, customers)
    areas = distributed.design(site.feeder, site.meters, noise, doubt(site.feeder), tops=tops, busbar=BUSBAR)
    return site, areas, noise


def drawn(site: Site, noise: Floats, seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Reported powers, true squared voltages of all buses without the change of losses, and readings."""
    rng = np.random.default_rng(seed)
    feeder, errors = site.feeder, doubt(site.feeder)
    p, q = -0.02 * rng.random(feeder.bus.size), -0.005 * rng.random(feeder.bus.size)
    whole = voltage_prior(feeder, np.arange(len(feeder.buses)), errors, busbar=BUSBAR).covariance
    v2 = feeder.bus_voltages(p, q, 1.02) + rng.multivariate_normal(np.zeros(len(whole)), whole, method="eigh")
    y = v2[feeder.bus[site.meters]] + np.sqrt(noise) * rng.normal(size=noise.size)
    return p, q, v2, y


def central(  # noqa: PLR0917
    site: Site, noise: Floats, p: Floats, q: Floats, y: Floats, trusted: Bools
) -> dict[str, Floats]:
    """Posterior of all buses, leave-one-out residuals and chi-square, by dense conditioning."""
    feeder, at = site.feeder, site.feeder.bus[site.meters]
    S = voltage_prior(feeder, np.arange(len(feeder.buses)), doubt(feeder), busbar=BUSBAR).covariance
    model = feeder.bus_voltages(p, q, 1.02)
    use = np.flatnonzero(trusted & np.isfinite(y))
    Q = np.linalg.inv(S[np.ix_(at[use], at[use])] + np.diag(noise[use]))
    m = y - model[at]
    mean = model + S[:, at[use]] @ Q @ m[use]
    cov = S - S[:, at[use]] @ Q @ S[at[use]]
    loo, std = np.full((2, y.size), np.nan)
    loo[use], std[use] = Q @ m[use] / np.diagonal(Q), 1.0 / np.sqrt(np.diagonal(Q))
    out = np.flatnonzero(~trusted & np.isfinite(y))
    loo[out], std[out] = y[out] - mean[at[out]], np.sqrt(np.diagonal(cov)[at[out]] + noise[out])
    chi = np.array(m[use] @ Q @ m[use])
    return {
        "v2": mean,
        "std": np.sqrt(np.diagonal(cov)),
        "loo": loo,
        "loo_std": std,
        "chi": chi,
        "used": np.array(use.size),
    }


def posts_of(areas: tuple[Area, ...], noise: Floats) -> list[Concentrator]:
    return [Concentrator(area, noise[area.meters]) for area in areas]


def observe(posts: list[Concentrator], p: Floats, q: Floats, y: Floats) -> None:
    for post in posts:
        mine = post.area.customers
        post.observe(y[post.area.meters], p[mine], q[mine], 1.02)


def assert_central(site: Site, posts: list[Concentrator], expected: dict[str, Floats], tol: float) -> None:
    buses = {name: k for k, name in enumerate(site.feeder.buses)}
    for post in posts:
        found, area = post.estimate(), post.area
        at = [buses[name] for name in area.feeder.buses]
        np.testing.assert_allclose(found.v2, expected["v2"][at], rtol=0, atol=tol)
        np.testing.assert_allclose(found.std, expected["std"][at], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.residual, expected["loo"][area.meters], rtol=1e-6, atol=tol)
        np.testing.assert_allclose(found.residual_std, expected["loo_std"][area.meters], rtol=1e-6)
        assert found.chi_square == pytest.approx(float(expected["chi"]), rel=1e-6)
        assert found.readings == int(expected["used"])


@pytest.mark.canary("simbench-lv-rural1-4")
@pytest.mark.parametrize(
    ("name", "customers"), [("simbench-lv-rural1", 4), ("kerber-dorfnetz", 10), ("kerber-vorstadtnetz", 12)]
)
def test_every_concentrator_has_the_estimate_of_the_central_one(name: str, customers: int) -> None:
    site, areas, noise = cut(name, customers)
    assert len(areas) > 2
    p, q, _, y = drawn(site, noise, 1)
    y[1::7] = np.nan
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    exchange(posts, 3 * len(areas), decide=False)
    assert_central(site, posts, central(site, noise, p, q, y, np.ones(y.size, dtype=np.bool_)), 1e-9)


def greedy(site: Site, noise: Floats, p: Floats, q: Floats, y: Floats) -> Bools:
    """Meters that a central estimator trusts: the largest residual is removed, a consistent one returns."""
    trusted, limit = np.ones(y.size, dtype=np.bool_), distributed._limit(1)
    for _ in range(3 * y.size):
        found = central(site, noise, p, q, y, trusted)
        score = np.abs(found["loo"]) / found["loo_std"]
        back = np.where(~trusted & (score <= limit), score, np.inf)
        worst = np.where(trusted & ~np.isnan(score), score, 0.0)
        if np.isfinite(back.min()):
            trusted[np.argmin(back)] = True
        elif worst.max() > limit:
            trusted[np.argmax(worst)] = False
        else:
            break
    return trusted


def manipulated(y: Floats, seed: int, part: float, size: float) -> tuple[Floats, Bools]:
    rng = np.random.default_rng([7, seed])
    liars = np.zeros(y.size, dtype=np.bool_)
    liars[rng.choice(y.size, int(part * y.size), replace=False)] = True
    return y + np.where(liars, size * rng.choice([-1.0, 1.0], y.size), 0.0), liars


@pytest.mark.canary("0")
@pytest.mark.parametrize("seed", range(6))
def test_meters_are_those_that_a_central_search_names(seed: int) -> None:
    site, areas, noise = cut("kerber-dorfnetz", 8)
    p, q, _, honest = drawn(site, noise, seed)
    y, liars = manipulated(honest, seed, 0.25, 0.05)
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    settle(posts)
    trusted = greedy(site, noise, p, q, y)
    for post in posts:
        assert np.array_equal(post.trusted, trusted[post.area.meters])
    assert_central(site, posts, central(site, noise, p, q, y, trusted), 1e-9)
    told = verdict({post.area.number: post.estimate() for post in posts}, areas)
    assert told.decision is Decision.ATTACKED
    assert set(told.meters) == set(np.flatnonzero(~trusted).tolist())
    assert set(told.meters) <= set(np.flatnonzero(liars).tolist())


def settle(posts: list[Concentrator]) -> None:
    """Rounds until no concentrator changes its mind for as many rounds as a message needs."""
    calm = 0
    for _ in range(500):
        before = [post.trusted for post in posts]
        exchange(posts, 1)
        same = all(np.array_equal(a, post.trusted) for a, post in zip(before, posts, strict=True))
        calm = calm + 1 if same else 0
        if calm > 2 * len(posts):
            return
    raise AssertionError("the concentrators do not settle")


def lies(area: int, shift: Floats) -> distributed.Carry:
    """Link in which one concentrator moves the boundary variables of all its messages."""

    def carry(sender: int, _: int, message: Message) -> Message:
        if sender != area:
            return message
        return replace(message, vector=message.vector + message.information[:, :3] @ shift)

    return carry


def in_volts(site: Site, posts: list[Concentrator], v2: Floats, without: frozenset[int]) -> float:
    """Largest error of the concentrators outside a set, in standard deviations."""
    buses = {name: k for k, name in enumerate(site.feeder.buses)}
    worst = 0.0
    for post in posts:
        if post.area.number not in without:
            found = post.estimate()
            truth = v2[[buses[name] for name in post.area.feeder.buses]]
            worst = max(worst, float(np.max(np.abs(found.v2 - truth) / np.maximum(found.std, 1e-9))))
    return worst


def test_busbar_concentrator_that_lies_to_all_is_named() -> None:
    site, areas, noise = cut("kerber-dorfnetz", 10)
    p, q, v2, y = drawn(site, noise, 3)
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    exchange(posts, 40, carry=lies(0, np.array([0.03, 0.0, 0.0])))
    told = verdict({post.area.number: post.estimate() for post in posts}, areas)
    assert (told.decision, told.meters, told.concentrators) == (Decision.ATTACKED, (), (frozenset({0}),))
    assert in_volts(site, posts, v2, frozenset({0})) < 5.0


def test_lying_end_leaves_two_explanations_and_the_others_right() -> None:
    """One dispute has two ends. Everything else is estimated as without the lying concentrator."""
    site, areas, noise = cut("kerber-dorfnetz", 10)
    p, q, v2, y = drawn(site, noise, 4)
    last = next(area.number for area in reversed(areas) if not area.under)
    above = areas[last].above
    assert above is not None
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    exchange(posts, 40, carry=lies(last, np.array([0.04, 0.0, 0.0])))
    estimates = {post.area.number: post.estimate() for post in posts}
    told = verdict(estimates, areas)
    assert told.decision is Decision.UNDECIDED
    assert set(told.concentrators) == {frozenset({last}), frozenset({above})}
    assert not told.meters
    assert in_volts(site, posts, v2, frozenset({last})) < 5.0
    exchange(posts, 40)
    again = verdict({post.area.number: post.estimate() for post in posts}, areas)
    assert (again.decision, again.concentrators) == (Decision.CLEAN, ())


@pytest.mark.canary("1000000000.0")
@pytest.mark.parametrize("claim", [0.0, 1e9])
def test_claimed_information_moves_a_neighbour_by_less_than_the_limit(claim: float) -> None:
    """Any message that is not disputed leaves the truth within the limit of the receiver's own prediction."""
    site, areas, noise = cut("simbench-lv-rural1", 4)
    p, q, _, y = drawn(site, noise, 5)
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    exchange(posts, 12)
    last = next(area.number for area in reversed(areas) if not area.under)
    above = areas[last].above
    assert above is not None
    alone = posts_of(areas, noise)
    observe(alone, p, q, y)
    exchange(alone, 12, carry=lambda sender, _, message: None if sender == last else message)
    own = alone[above].estimate()
    bus = posts[above]._bus(last)
    for shift in np.linspace(-0.05, 0.05, 21):
        liar = posts_of(areas, noise)
        observe(liar, p, q, y)

        def carry(sender: int, _: int, message: Message, by: float = float(shift)) -> Message:
            if sender != last:
                return message
            more = message.information.copy()
            more[0, 0] += claim
            vector = message.vector.copy()
            vector[0] += claim * by
            return replace(message, information=more, vector=vector)

        exchange(liar, 12, carry=carry)
        found = liar[above].estimate()
        if last not in found.disputed:
            limit = distributed._limit(areas[last].size)
            assert abs(found.v2[bus] - own.v2[bus]) <= limit * own.std[bus] * 1.01 + 1e-9


def test_lost_link_is_undecided_and_the_rest_stays_right() -> None:
    site, areas, noise = cut("kerber-dorfnetz", 10)
    p, q, v2, y = drawn(site, noise, 6)
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    last = areas[-1].number
    exchange(posts, 30, carry=lambda sender, to, message: None if last in {sender, to} else message)
    estimates = {post.area.number: post.estimate() for post in posts}
    told = verdict(estimates, areas)
    assert (told.decision, told.meters, told.concentrators) == (Decision.UNDECIDED, (), ())
    assert last in estimates[areas[last].above or 0].silent
    assert in_volts(site, posts, v2, frozenset()) < 5.0


def test_losing_messages_at_random_changes_the_estimate_by_nothing_in_the_end() -> None:
    site, areas, noise = cut("kerber-dorfnetz", 10)
    p, q, _, y = drawn(site, noise, 7)
    rng = np.random.default_rng(7)
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    exchange(posts, 20, carry=lambda _, __, message: message if rng.random() > 0.3 else None)
    exchange(posts, 12, decide=False)
    assert_central(site, posts, central(site, noise, p, q, y, np.ones(y.size, dtype=np.bool_)), 1e-9)


def test_message_survives_json_to_the_last_digit() -> None:
    site, areas, noise = cut("simbench-lv-rural1", 4)
    p, q, _, y = drawn(site, noise, 8)
    one, two = posts_of(areas, noise), posts_of(areas, noise)
    for posts, carry in (
        (one, lambda _, __, message: message),
        (two, lambda _, to, message: Message.from_json(message.to_json(), areas[to].size)),
    ):
        observe(posts, p, q, y)
        exchange(posts, 12, carry=carry)
    for first, second in zip(one, two, strict=True):
        assert np.array_equal(first.estimate().v2, second.estimate().v2)


def test_impossible_message_is_refused_with_all_its_problems() -> None:
    site, areas, noise = cut("simbench-lv-rural1", 4)
    p, q, _, y = drawn(site, noise, 9)
    posts = posts_of(areas, noise)
    observe(posts, p, q, y)
    message = posts[1].send()[0]
    bad = replace(message, information=-message.information, worst=-1.0)
    posts[0].receive(1, bad)
    assert [problem.code for problem in posts[0].refused[1]] == ["negative"]
    assert 1 in posts[0].estimate().silent
    short = json.loads(message.to_json()) | {"vector": [1.0], "model": []}
    with pytest.raises(InputInvalid) as caught:
        Message.from_json(json.dumps(short), areas[0].size)
    assert caught.value.codes == ("shape", "shape")
    for text in (
        "{",
        "[]",
        '{"information": "x"}',
        json.dumps(short | {"vector": [float("nan")] * areas[0].size}),
    ):
        with pytest.raises(InputInvalid):
            Message.from_json(text, areas[0].size)
    posts[0].receive(1, message)
    assert not posts[0].refused


def test_partition_by_definition_and_its_errors() -> None:
    site = load("kerber-dorfnetz")
    assert isinstance(site.feeder, Feeder)
    tops = laterals(site.feeder, 10)
    area = partition(site.feeder, tops)
    for bus in range(1, len(site.feeder.buses)):
        above = area[site.feeder.parent[bus - 1]]
        assert area[bus] == (sorted(tops).index(bus) + 1 if bus in tops else above)
    with pytest.raises(InputInvalid) as caught:
        partition(site.feeder, [0, 3, 3])
    assert caught.value.codes == ("out-of-range", "duplicate")
    with pytest.raises(InputInvalid):
        distributed.design(
            site.feeder, site.meters, np.zeros(site.meters.size), load_doubt(site), tops=tops, busbar=BUSBAR
        )


def test_smallest_explanations_of_disputes() -> None:
    """Against all subsets of the concentrators."""
    _, areas, noise = cut("kerber-dorfnetz", 10)
    posts = posts_of(areas, noise)
    plain = {post.area.number: replace(post.estimate(), silent=frozenset()) for post in posts}
    star = {0: frozenset({1, 2, 3})}
    told = verdict({k: replace(each, disputed=star.get(k, frozenset())) for k, each in plain.items()}, areas)
    assert (told.decision, told.concentrators) == (Decision.ATTACKED, (frozenset({0}),))
    pair = {1: frozenset({0})}
    told = verdict({k: replace(each, disputed=pair.get(k, frozenset())) for k, each in plain.items()}, areas)
    assert (told.decision, set(told.concentrators)) == (Decision.UNDECIDED, {frozenset({0}), frozenset({1})})
    assert verdict(plain, areas).decision is Decision.CLEAN
    assert verdict({k: each for k, each in plain.items() if k}, areas).decision is Decision.UNDECIDED


def test_an_area_without_customers_and_an_unmetered_busbar() -> None:
    """A street whose last cable feeds nothing; its concentrator agrees with the other."""
    feeder = Feeder(
        name="street",
        parent=np.array([0, 1, 2]),
        r=np.full(3, 0.02),
        x=np.full(3, 0.01),
        bus=np.array([1, 2]),
        customers=("a", "b"),
        buses=("0", "1", "2", "3"),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(3),
    )
    noise = np.full(2, 1e-6)
    areas = distributed.design(feeder, np.arange(2), noise, doubt(feeder), tops=[3], busbar=float("nan"))
    posts = posts_of(areas, noise)
    observe(posts, np.full(2, -0.01), np.zeros(2), np.array([1.0195, 1.0190]))
    exchange(posts, 6)
    estimates = {post.area.number: post.estimate() for post in posts}
    assert verdict(estimates, areas).decision is Decision.CLEAN
    assert estimates[1].v2[1] == pytest.approx(estimates[0].v2[2], abs=1e-9)
