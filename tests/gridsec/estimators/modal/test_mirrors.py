"""Mirror images of explanations: no meter is named where readings cannot tell it from its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Source, model_of, power_columns, tree
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import core, mirrors
from gridsec.estimators.modal.core import Core
from gridsec.estimators.modal.costs import SearchProblem, mean_likelihood
from gridsec.estimators.modal.search import ALIKE, Identification, identified
from tests.gridsec.estimators.modal.test_search import problem

FEEDER = tree(12, np.random.default_rng(3))
MODEL = model_of(FEEDER)
NONE = np.zeros(12, dtype=np.bool_)
"""No masked meter."""
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


def of_column(given: SearchProblem, rest: Bools, column: Bools, share: float) -> float:
    """L of faults and of meters with one amount, by the covariance of all amounts and a dense determinant."""
    p, at = given.meters, np.concatenate([np.flatnonzero(rest), np.flatnonzero(column)])
    n, k = np.count_nonzero(rest), np.count_nonzero(rest[:p])
    correlation = np.eye(at.size)
    if k > 1:
        correlation[:k, :k] += share * (1.0 - np.eye(k))
    correlation[n:, n:] = 1.0
    std = np.append(given.std[at[:n]], np.full(at.size - n, given.std[0]))
    V = std[:, None] * correlation * std
    F, y = given.F[np.ix_(at, at)], given.y[at]
    A = np.eye(at.size) + V @ F
    charge = float(given.charge.max()) if share and k > 1 else 0.0
    return float(np.linalg.slogdet(A)[1] - y @ np.linalg.solve(A, V @ y)) + charge


@pytest.mark.parametrize("seed", range(4))
def test_likelihoods_of_parts_of_a_set_with_a_column_are_exact(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both priors, parts with few meters and none, columns inside and outside of the set, and no column."""
    monkeypatch.setattr(mirrors, "TOGETHER", (6, 512)[seed % 2])
    random = np.random.default_rng(seed)
    given = replace(problem(4 + seed, p=9, others=3), std=random.uniform(0.5, 2.0, 12))
    chosen = np.isin(np.arange(12), (0, 2, 3, 5, 6, 9, 11))
    likelihood = mirrors._Likelihood(given, np.stack([np.arange(12) == 10, chosen]))
    of = np.ones(20, dtype=np.intp)
    rest = chosen & (random.random((20, 12)) < np.linspace(0.0, 1.0, 20)[:, None])
    columns = (random.random((20, 9)) < 0.4) & ~rest[:, :9]
    columns[7] = False
    own = [of_column(given, chosen, columns[7], share) for share in (0.0, ALIKE)]
    counted = [k for k in range(2) if own[k] <= min(own) + mirrors.APART]
    assert likelihood.own[1] == pytest.approx(float(mean_likelihood(np.array(own)[counted])), abs=1e-7)
    assert likelihood.own[0] == pytest.approx(
        of_column(given, np.arange(12) == 10, columns[7], 0.0), abs=1e-7
    )
    for one, column, found in zip(rest, columns, likelihood(of, rest, columns), strict=True):
        each = np.array([of_column(given, one, column, share) for share in (0.0, ALIKE)])
        assert found == pytest.approx(float(mean_likelihood(each[counted])), abs=1e-7)
    assert likelihood(of[:0], rest[:0], columns[:0]).shape == (0,)


def test_numbers_of_exchanged_meters_are_those_of_the_sets() -> None:
    random = np.random.default_rng(2)
    sets, regions, masked = random.random((7, 11)) < 0.4, random.random((5, 11)) < 0.5, np.arange(11) > 8
    found = mirrors._exchanged(sets, regions, masked)
    for k, one in enumerate(sets):
        for n, region in enumerate(regions):
            assert found[k, n] == np.count_nonzero((one ^ region) | masked)


def test_a_prior_that_is_far_worse_for_a_set_does_not_count_for_its_images() -> None:
    """Two meters that are off by the reverse amounts: amounts alike do not count."""
    F, truth = 1e4 * np.eye(5), np.array([1.0, -1.0, 0.0, 0.0, 0.0])
    given = SearchProblem(F @ truth, F, np.ones(5), 4, np.zeros(5), np.full(5, np.inf))
    chosen = truth != 0.0
    likelihood = mirrors._Likelihood(given, chosen[None])
    assert likelihood.counted.tolist() == [[True], [False]]
    assert likelihood.own[0] == pytest.approx(of_column(given, chosen, np.zeros(4, np.bool_), 0.0))


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
    near = mirrors.Neighbourhoods(laterals, np.zeros((p, 1), dtype=np.bool_), p, p + np.arange(p))
    chosen = np.append(truth, False)
    (images,) = mirrors._images(given, chosen[None], near, NONE[: near.phases.shape[0]])
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
    assert mirrors.reflected(alone, of.near, NONE) is alone


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
        found = mirrors.reflected(each, of.near, NONE)
        assert np.isclose(found.weight[(found.chosen == meters).all(axis=1)].sum(), found.weight[0])
        assert not found.certain[-1]


@pytest.mark.parametrize(
    ("weight", "before", "reflected"),
    [
        (0.02, False, True),
        (0.005, False, False),
        (0.005, True, True),
        (0.001, True, False),
    ],
)
def test_an_image_stays_where_its_set_loses_some_weight(weight: float, before: bool, reflected: bool) -> None:
    """The busbar's meter beside a likelier false power; all other sets of the search before do not count."""
    of = kernel(12)
    given = looked(of, np.full(12, 0.04))
    q = given.chosen.shape[1]
    busbar, power, meters = np.arange(q) == q - 1, np.arange(q) == 14, np.arange(q) < 12
    costs = {power.tobytes(): 0.0, busbar.tobytes(): -2.0 * float(np.log(weight / (1.0 - weight)))}
    each = identified(given.problems, (costs, *({} for _ in given.problems[1:])))
    found = mirrors.reflected(each, of.near, NONE, np.stack([busbar if before else power]))
    assert (found.chosen == meters).all(axis=1).any() == reflected


@pytest.mark.parametrize(("most", "masked"), [(2, 0), (3, 0), (3, 1), (4, 1)])
def test_all_others_of_a_lateral_have_an_image_within_the_promise(most: int, masked: int) -> None:
    """Meter 4 of the meters 4 to 7, which belong to two branches; the others are one lateral."""
    given = problem(3, p=8, others=1)
    laterals = (np.arange(8) < 4)[None]
    near = mirrors.Neighbourhoods(laterals, np.zeros((8, 1), dtype=np.bool_), most, 8 + np.arange(8))
    (found,) = mirrors._images(given, (np.arange(9) == 4)[None], near, np.arange(8) < masked)
    images = [np.flatnonzero(one).tolist() for one, _ in found]
    assert images == ([[5, 6, 7]] if most - masked == 3 else [])


@pytest.mark.parametrize("masked", [0, 1])
def test_masked_meters_count_in_the_promise_of_images_by_a_phase(masked: int) -> None:
    """Three of seven meters of the phase, or the other four with its meter; meter 7 is on another phase."""
    of_phase = np.arange(8) < 7
    near = mirrors.Neighbourhoods(np.zeros((0, 8), dtype=np.bool_), of_phase[:, None], 4, 8 + np.arange(8))
    image, _ = mirrors._of_phase(np.arange(9) < 3, near, 0, of_phase, np.arange(8) >= 8 - masked)
    if masked:
        assert image is None
    else:
        assert image is not None
        assert np.flatnonzero(image).tolist() == [3, 4, 5, 6, 8]
