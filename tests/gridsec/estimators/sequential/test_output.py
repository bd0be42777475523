"""What an operator is told where several explanations fit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gridsec.estimators import sequential
from gridsec.estimators.plant import Plant
from gridsec.estimators.sequential import LoadDoubt, SequentialDesign, SequentialOptions
from gridsec.estimators.sequential.identify import Identification
from gridsec.estimators.sequential.output import _strongest, explanations_sentence
from gridsec.estimators.sequential.posterior import condition, leave_one_out
from gridsec.estimators.sequential.search import Limits
from gridsec.estimators.sequential.time_scales import ScaleTest
from gridsec.interface import Cause, Decision, Explanation, Frame
from tests.gridsec.estimators.sequential.test_monitor import prepare, watch
from tests.gridsec.street import BASE_KVA, Street, accuracy, make_plant


@pytest.fixture(scope="module")
def design() -> SequentialDesign:
    return prepare(make_plant(np.random.default_rng(1), customers=12, drop=0.03))


def way(
    meters: tuple[int, ...] = (), inverters: tuple[int, ...] = (), powers: tuple[int, ...] = ()
) -> Explanation:
    every = np.arange(12)
    return Explanation(np.isin(every, meters), np.isin(every, inverters), 0.5, np.isin(every, powers))


def test_every_explanation_is_told_as_what_it_is(design: SequentialDesign) -> None:
    assert explanations_sentence(design, (way((1,)), way())) == (
        "Wrong are either the meter of c1 or else none of them; both explain the readings."
    )
    three = explanations_sentence(design, (way((1, 2)), way((3,), (4,)), way(powers=(5,))))
    assert three == (
        "Wrong are either the meters of c1, c2 or else the meter of c3 and the inverter of c4 or else the "
        "reported power of c5; each of these explains the readings."
    )
    assert "c11" not in explanations_sentence(design, (way(tuple(range(12))), way()))
    assert "or 3 more; each of these" in explanations_sentence(design, (way((1,)),) * 8)


def test_a_customer_on_the_busbar_is_known_as_well_as_its_meter_reads() -> None:
    """A busbar's meter of class 0.5 among twelve exact ones: what is reported there is that reading."""
    plant = make_plant(
        np.random.default_rng(1), customers=12, drop=0.03, inverters=np.zeros(0, dtype=np.intp)
    )
    bus, rng, none = np.arange(12), np.random.default_rng(2), np.zeros(12)
    plant = replace(
        plant,
        feeder=replace(plant.feeder, bus=bus),
        accuracy=replace(plant.accuracy, busbar_class=0.005),
    )
    made, off = prepare(plant), []
    for _ in range(60):
        v0_squared = (1.0 + 0.005 * rng.uniform(-1.0, 1.0)) ** 2
        y, seen = np.ones(12), np.ones(12, dtype=np.bool_)
        frame = Frame(1.0, y, seen, v0_squared, none, none, none, none, np.full(12, np.nan), none)
        estimate = sequential.step(made, sequential.init(made, 0.0), frame)[1]
        off.append((estimate.v2 - 1.0) / estimate.std)
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.1).all()


def twins() -> Plant:
    """Two customers at the end of a long cable, about whose load nobody knows much."""
    rng = np.random.default_rng(4)
    plant = make_plant(rng, customers=14, drop=0.03, inverters=np.arange(10))
    feeder = plant.feeder
    parent, r = feeder.parent.copy(), feeder.r.copy()
    parent[12], r[12] = 6, 1.8
    bus = feeder.bus.copy()
    bus[13] = bus[12] = 13
    leaf = np.arange(13)
    feeder = replace(
        feeder,
        parent=parent[leaf],
        r=r[leaf],
        x=feeder.x[leaf],
        charging=feeder.charging[leaf],
        buses=feeder.buses[:14],
        bus=bus,
    )
    return replace(plant, feeder=feeder, accuracy=accuracy(14))


def test_one_of_two_at_the_same_bus_lies_and_that_is_said_at_every_tick() -> None:
    """Though who could be honest is looked for now and then only."""
    plant = twins()
    doubt = LoadDoubt(np.full(14, 0.6 / BASE_KVA), np.full(14, 0.2 / BASE_KVA), 600.0)
    made = sequential.design(plant, doubt=doubt, step_s=1.0, options=SequentialOptions(commission_s=0.0))
    street = Street(plant, np.random.default_rng(5), load_kw=0.5)
    street.bias[12:] = 0.0
    state, _ = watch(street, made, 30)
    _, answers = watch(street, made, 40, state=state, lies={12: -0.045})
    for _, verdict in answers[1:]:
        assert (verdict.decision, verdict.cause) == (Decision.UNDECIDED, Cause.AMBIGUOUS)
        accused = {tuple(np.flatnonzero(each.meters)) for each in verdict.explanations}
        assert {(12,), (13,)} <= accused
        assert sum(each.probability for each in verdict.explanations) == pytest.approx(1.0)
        assert verdict.reason.startswith("Wrong are either the meter of c1")


def test_a_meters_score_is_that_of_the_scale_that_speaks_most_against_it(design: SequentialDesign) -> None:
    """Against a loop over scales and meters; whoever no scale has enough readings of is not judged."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        offset, limit = rng.normal(size=(4, 12)), rng.uniform(0.1, 2.0, (4, 12))
        enough = rng.random((4, 12)) < rng.choice([0.3, 0.9, 1.0])
        there = rng.random(4) < 0.7
        views = tuple(
            replace(_view(design), loo=replace(_view(design).loo, residual=o), limit=a, enough=e)
            if here
            else None
            for o, a, e, here in zip(offset, limit, enough, there, strict=True)
        )
        seen = Identification(
            sequential.init(design, 0.0).trust, (None,) * 4, (None,) * 4, views, {}, (False,) * 4
        )
        score, threshold, loo = _strongest(design, seen, 12)
        for j in range(12):
            by = [s for s in range(4) if there[s] and enough[s, j]]
            assert loo[j] == bool(by)
            if not by:
                assert np.isnan(score[j])
                assert threshold[j] == design.options.widest
                continue
            s = max(by, key=lambda s: abs(offset[s, j]) / limit[s, j])
            assert (score[j], threshold[j]) == (abs(offset[s, j]), limit[s, j])


@cache
def _view(design: SequentialDesign) -> ScaleTest:
    """Any view of a scale."""
    zero, prior = np.zeros(12), design.prior
    loo = leave_one_out(condition(prior, design.white, zero == 0.0), zero)
    limits = Limits(4.0, zero, design.allowed, design.fixed)
    return ScaleTest(loo, zero == 0.0, zero, zero > 0.0, limits, 0.5)
