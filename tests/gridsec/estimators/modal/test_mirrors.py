"""Mirror images of explanations: no meter is named where readings cannot tell it from its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Source, model_of, power_columns, tree
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import core, mirrors
from gridsec.estimators.modal.core import Core
from gridsec.estimators.modal.costs import SearchProblem
from gridsec.estimators.modal.search import Identification, identified
from tests.gridsec.estimators.modal.test_search import problem

FEEDER = tree(12, np.random.default_rng(3))
MODEL = model_of(FEEDER)
POWERS = np.vstack([np.zeros((1, 12)), power_columns(FEEDER)[:, :12]])


def kernel(attacked: int = 4) -> Core:
    """Core of a feeder of 12 meters."""
    return core.assemble(MODEL, POWERS, np.full(12, 0.1), gamma=1e6, attacked=attacked)


def lateral(of: Core) -> Bools:
    """The largest group of neighbours but the whole feeder."""
    sizes = of.near.laterals.sum(axis=1)
    return np.asarray(of.near.laterals[int(sizes.argmax())])


def looked(of: Core, lie: Floats, unknown: Floats | None = None) -> Identification:
    """Explanations eight ticks after the onset of a lie of some meters, (p,)."""
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(of, 0.0)
    for k in range(40):
        state, evidence = core.step(of, state, float(k), source.tick() + lie * (k >= 32), None, unknown)
    assert core.alarmed(of, evidence)
    return core.identify(of, state, evidence).found


def test_likelihoods_of_one_amount_are_exact() -> None:
    """Against the covariance of all amounts by a dense determinant."""
    given = problem(3, p=8, others=2)
    rest, alike = np.array([1, 8]), np.isin(np.arange(8), (2, 4, 5))
    at = np.array([1, 8, 2, 4, 5])
    V = np.diag(given.std[at] ** 2)
    V[2:, 2:] = given.std[2] ** 2
    F, y = given.F[np.ix_(at, at)], given.y[at]
    want = np.linalg.slogdet(np.eye(5) + V @ F)[1] - y @ np.linalg.solve(np.eye(5) + V @ F, V @ y)
    assert np.isclose(mirrors._likelihood(given, rest, alike), want)
    assert mirrors._likelihood(given, np.zeros(0, dtype=np.intp), None) == 0.0


@pytest.mark.parametrize("share", [0.0, 0.99])
def test_likelihoods_of_amounts_alike_are_exact(share: float) -> None:
    """Three meters with a share of their variance in common, a power, and two meters with one amount."""
    given, at = problem(4, p=8, others=2), np.array([0, 3, 6, 9, 1, 2])
    given = replace(given, std=np.linspace(0.5, 2.0, 10))
    correlation = np.eye(6)
    correlation[:3, :3] += share * (1.0 - np.eye(3))
    correlation[4:, 4:] = 1.0
    std = np.append(given.std[at[:4]], given.std[[0, 0]])
    V = std[:, None] * correlation * std
    F, y = given.F[np.ix_(at, at)], given.y[at]
    want = np.linalg.slogdet(np.eye(6) + V @ F)[1] - y @ np.linalg.solve(np.eye(6) + V @ F, V @ y)
    column = np.isin(np.arange(8), at[4:])
    assert np.isclose(mirrors._likelihood(given, at[:4], column, share), want)


def test_a_mirror_image_costs_as_much_as_its_set_where_readings_agree() -> None:
    """Six meters off alike, one of them in a group with two others: no image is cheaper than the set."""
    random, p = np.random.default_rng(5), 8
    F = np.linalg.inv(0.002 * np.eye(p) + 0.05)
    truth = np.arange(p) < 6
    y = F @ (1.0 * truth) + np.linalg.cholesky(F) @ random.standard_normal(p)
    given = SearchProblem(
        np.append(y, 0.0), np.eye(p + 1), np.ones(p + 1), p, np.zeros(p + 1), np.full(9, np.inf)
    )
    given.F[:p, :p] = F
    laterals = np.zeros((1, p), dtype=np.bool_)
    laterals[0, 5:] = True
    near = mirrors.Neighbourhoods(laterals, np.zeros((p, 1), dtype=np.bool_), p)
    chosen = np.append(truth, False)
    images = list(mirrors._images(given, chosen, near))
    assert all(more > 0.0 for _, more in images)


def test_a_majority_of_a_lateral_is_ambiguous_where_nothing_else_confirms_it() -> None:
    """All but one meter of a lateral read 1 % too much; its level is unknown: no meter is named."""
    of = kernel()
    group = lateral(of)
    honest = int(np.flatnonzero(group)[0])
    lie = 0.02 * (group & (np.arange(12) != honest))
    found = looked(of, lie, np.where(group, 0.3, 0.0)[:, None])
    assert not found.named.any()
    likely = found.chosen[found.weight > 0.1, :12]
    assert any((each == (lie > 0.0)).all() for each in likely)
    assert any((each == (np.arange(12) == honest)).all() for each in likely)


def test_a_meter_is_named_where_its_lateral_is_confirmed() -> None:
    """The same feeder with known powers: the meter that is off by 1 % is named, and no other."""
    of = kernel()
    one = int(np.flatnonzero(lateral(of))[0])
    found = looked(of, 0.02 * (np.arange(12) == one))
    assert (found.named == (np.arange(12) == one)).all()


@pytest.mark.parametrize(("attacked", "named"), [(4, True), (12, False)])
def test_the_busbar_is_certain_only_where_not_all_meters_may_be_manipulated(
    attacked: int, named: bool
) -> None:
    of = kernel(attacked)
    found = looked(of, np.full(12, 0.04))
    without = float(found.weight @ ~found.chosen[:, -1])
    assert (without < 1e-3) == named
    if not named:
        assert any(each.all() for each in found.chosen[found.weight > 0.1, :12])


@pytest.mark.parametrize(("attacked", "named"), [(3, False), (4, False), (5, True)])
def test_as_many_meters_as_are_promised_beside_the_busbar_do_not_keep_the_promise(
    attacked: int, named: bool
) -> None:
    """The busbar's meter and four meters: five keep the promise, and exclude the other eight."""
    lie = np.where(np.arange(12) % 3 == 0, 0.0, 0.04)
    found = looked(kernel(attacked), lie)
    assert (found.named == (named & (lie == 0.0))).all()
    assert found.certain[-1] == named


@pytest.mark.parametrize(("attacked", "named"), [(4, True), (10, False)])
def test_the_busbar_and_some_meters_have_the_others_as_a_mirror_image(attacked: int, named: bool) -> None:
    """The busbar's meter and two meters off by one amount, or the other ten, as far as that is promised."""
    of = kernel(attacked)
    lie = np.where(np.arange(12) < 2, 0.0, 0.04)
    found = looked(of, lie)
    assert (found.named == (named & (lie == 0.0))).all()
    both, others = (
        found.weight @ (found.chosen[:, :12] == each).all(axis=1) for each in (lie == 0.0, lie > 0.0)
    )
    assert both > 0.2
    assert (others > 0.2) != named


def test_explanations_without_mirror_images_stay() -> None:
    """A single false power has none."""
    of = kernel()
    given = looked(of, 0.02 * (np.arange(12) == 3))
    chosen = np.zeros((1, given.chosen.shape[1]), dtype=np.bool_)
    chosen[0, 14] = True
    alone = replace(given, chosen=chosen, model=np.zeros(1, dtype=np.intp), weight=np.ones(1))
    assert mirrors.reflected(alone, of.near) is alone


def test_a_mirror_image_that_was_found_with_its_own_penalty_has_that_of_its_set() -> None:
    """All meters of the phase alike are the busbar's meter, with or without them among the sets before."""
    of = kernel(12)
    given = looked(of, np.full(12, 0.04))
    p = given.chosen.shape[1]
    busbar, meters = np.arange(p) == p - 1, np.arange(p) < 12
    sets = {busbar.tobytes(): 0.0, meters.tobytes(): -2.0 * float(np.log(1e-3))}
    alone = identified(given.problems, ({busbar.tobytes(): 0.0}, *({} for _ in given.problems[1:])))
    both = identified(given.problems, (sets, *({} for _ in given.problems[1:])))
    for each in (alone, both):
        found = mirrors.reflected(each, of.near)
        assert np.isclose(found.weight[(found.chosen == meters).all(axis=1)].sum(), found.weight[0])
        assert not found.certain[-1]


@pytest.mark.parametrize("most", [2, 3])
def test_all_others_of_a_lateral_have_an_image_within_the_promise(most: int) -> None:
    """Meter 4 of the meters 4 to 7, which belong to two branches; the others are one lateral."""
    given = problem(3, p=8, others=1)
    laterals = (np.arange(8) < 4)[None]
    near = mirrors.Neighbourhoods(laterals, np.zeros((8, 1), dtype=np.bool_), most)
    images = [np.flatnonzero(one).tolist() for one, _ in mirrors._images(given, np.arange(9) == 4, near)]
    assert images == ([[5, 6, 7]] if most == 3 else [])
