"""Unknown directions of a tick: exact in the filter, harmless over time, conditioned on in the estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Dense, Source, power_columns, tree
from gridsec.arrays import Floats
from gridsec.estimators.front.measurements import COMMON_SHARE, measurements, nominal_uncertainty
from gridsec.estimators.modal import core, costs, doubts, full, masking, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.costs import SearchProblem
from gridsec.estimators.modal.doubts import Unknown
from gridsec.estimators.modal.model import modes
from gridsec.estimators.modal.signatures import Scored
from gridsec.grid.network import Power
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.estimators.modal.test_core import MODEL
from tests.gridsec.estimators.modal.test_filter import proportional
from tests.gridsec.street import Street, make_plant

STEPS = power_columns(tree(12, np.random.default_rng(3)))[:, :12]
COLUMN = STEPS[:, [7]]
"""Effect of one customer's active power on the meters."""
POWER = 0.03
"""An unread power, pu: 3 kW."""
WIDE = np.full(2, doubts.WIDER)
"""Factors of two directions."""


def test_the_filter_is_the_dense_one_with_more_noise() -> None:
    """At ticks with an unknown direction the white errors have ``D + U U'``."""
    model = proportional()
    made, dense, source = modes(model), Dense(model), Source(model, np.random.default_rng(4))
    state, known, plain = modal.start(made, 0.0), static.start(made), dense.D
    for k in range(30):
        m, U = source.tick(), 0.02 * np.random.default_rng(k).standard_normal((12, 2))
        open_ = k % 3 == 1
        dense.D = plain + U @ U.T if open_ else plain
        seen = None if k % 2 else np.arange(12) != k % 12
        dense.step(1.0 if k else 0.0, m, seen)
        state, known, _ = full.step(made, state, known, float(k), m, seen, unknown=U if open_ else None)
    assert state.full is not None
    assert np.allclose(state.full.mean, np.stack([dense.varies, dense.lasts]), atol=1e-9)


def played(unknown: Floats | None, error: Floats, ticks: int = 400) -> float:
    """Largest log M of honest readings with a lasting error of the residuals."""
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e6)
    source, state, most = Source(MODEL, np.random.default_rng(9)), core.init(kernel, 0.0), -np.inf
    for k in range(ticks):
        m = source.tick() + error * (k >= 100)
        state, evidence = core.step(kernel, state, float(k), m, None, unknown if k >= 100 else None)
        most = max(most, evidence.log_m)
    return most - kernel.limit


def test_a_lasting_error_along_an_unknown_direction_is_no_evidence() -> None:
    """3 unread kW for 300 ticks raise no alarm; without the direction they do."""
    error = POWER * COLUMN[:, 0]
    assert played(doubts.WIDER * POWER * COLUMN, error) < 0.0
    assert played(None, error) > 0.0


def test_an_injection_that_follows_the_estimate_is_wider_by_its_own_factor() -> None:
    """Its own deviation in the estimate, `FOLLOWS` times that in the filter; far ones `WIDER` times."""
    plant = make_plant(np.random.default_rng(5), customers=12, drop=0.08)
    front, street = front_end(plant), Street(plant, np.random.default_rng(6))
    droop, one = plant.droop, np.ones(12, dtype=np.bool_)
    measured = measurements(front, street.frame(), one, one[:1], 1.0)
    usual = np.sqrt(3.0) * (front.injections[droop.customer] + front.mismatch)
    injected, free = 2.0 * usual, np.zeros(droop.customer.size, dtype=np.bool_)
    injected[1] *= doubts.UNSETTLED
    free[:2] = True
    given = doubts.unknown(front, measured, nominal_uncertainty(front), injected, free, None)
    assert given is not None
    columns = front.sensitivities.columns(Power.REACTIVE, droop.customer[:2])
    exact = columns * injected[:2] / np.sqrt(3.0)
    order = np.argsort(droop.customer[:2])
    assert np.allclose(given.places, exact[:, order])
    assert np.allclose(given.factor, np.array([doubts.FOLLOWS, doubts.WIDER])[order])
    assert np.allclose(given.wide, given.factor * given.meters)
    assert (
        doubts.unknown(front, measured, nominal_uncertainty(front), 2.0 * usual, ~free & free, None) is None
    )


def test_unread_powers_are_wrong_together() -> None:
    """Their errors have the common share of the front end; the sum of k is k times as uncertain as one."""
    plant = make_plant(np.random.default_rng(5), customers=12, drop=0.08)
    front, street = front_end(plant), Street(plant, np.random.default_rng(6))
    one, unread, usual = np.ones(12, dtype=np.bool_), np.arange(12) < 3, nominal_uncertainty(front)
    frame = street.frame()
    frame = replace(frame, p_error=np.where(unread, 0.2, frame.p_error))
    measured = measurements(front, frame, one, one[:1], 1.0)
    known = replace(usual, p=np.where(unread, 4.0, usual.p), read=usual.read & ~unread[plant.meters])
    none = np.zeros(plant.droop.customer.size)
    given = doubts.unknown(front, measured, known, none, none > 0.0, None)
    assert given is not None
    std = np.sqrt(0.2**2 / 3.0 - front.doubt.smooth_p[unread] ** 2)
    columns = front.sensitivities.columns(Power.ACTIVE, np.flatnonzero(unread)) * std
    between = (1.0 - COMMON_SHARE) * np.eye(3) + COMMON_SHARE
    assert np.allclose(given.places @ given.places.T, columns @ between @ columns.T)
    assert np.allclose(given.wide @ given.wide.T, doubts.WIDER**2 * given.meters @ given.meters.T)


def test_the_estimate_is_the_gaussian_one() -> None:
    """Mean and variance equal those of dense conditioning; unchecked readings widen the variance only."""
    made, random = modes(MODEL), np.random.default_rng(3)
    places, at = random.standard_normal((13, 2)) * 0.01, MODEL.meters
    given = Unknown(places, places[at], WIDE, np.zeros(12, dtype=np.bool_), 2)
    u, seen = 0.01 * random.standard_normal(12), np.arange(12) != 5
    mean, variance = doubts.estimated(made.noise, given, u, seen)
    whole = np.block(
        [
            [places @ places.T, places @ places[at].T],
            [places[at] @ places.T, places[at] @ places[at].T + made.noise],
        ]
    )
    n = 13 + np.flatnonzero(seen)
    gain = np.linalg.solve(whole[np.ix_(n, n)], whole[n, :13]).T
    assert np.allclose(mean, gain @ u[seen])
    assert np.allclose(variance, np.diag(whole)[:13] - np.diag(gain @ whole[n, :13]), atol=1e-12)
    doubted = Unknown(places, places[at], WIDE, np.arange(12) == 2, 2)
    same, wider = doubts.estimated(made.noise, doubted, u, seen)
    other, less = doubts.estimated(made.noise, given, u, seen & (np.arange(12) != 2))
    assert np.allclose(same, mean)
    assert np.allclose(wider, less + (mean - other) ** 2)
    assert (wider >= variance - 1e-15).all()


@pytest.mark.canary(
    "columns0-True-1",
    "columns0-False-1",
    "columns1-True-1",
    "columns1-False-1",
    "columns0-False-20",
)
@pytest.mark.parametrize("ticks", [1, 20])
@pytest.mark.parametrize("lasts", [True, False])
@pytest.mark.parametrize("columns", [POWER * STEPS[:, [7, 3]], 0.1 * np.ones((12, 1))])
def test_the_stated_deviation_of_the_estimate_is_seen(columns: Floats, ticks: int, *, lasts: bool) -> None:
    """Random errors of the model, of the own errors and of the directions: none is stated too small."""
    made, square = modes(MODEL), []
    given = Unknown(columns, columns, WIDE[:1], np.zeros(12, dtype=np.bool_), columns.shape[1])
    for run in range(100):
        source, random = Source(MODEL, np.random.default_rng(run)), np.random.default_rng([run, 1])
        state, known, amount = (
            modal.start(made, 0.0),
            static.start(made),
            random.standard_normal(columns.shape[1]),
        )
        for k in range(ticks):
            amount = amount if lasts else random.standard_normal(amount.size)
            truth = source.w + columns @ amount
            m = source.tick() + columns @ amount
            state, known, _ = full.step(made, state, known, float(k), m, None, unknown=given.wide)
        after = state.full
        assert after is not None
        u = m - after.mean[0] - after.mean[1]
        off, more = doubts.estimated(made.noise + after.whole, given, u, np.ones(12, dtype=np.bool_))
        square.append((after.mean[0] + off - truth) ** 2 / (after.blocks[0].diagonal() + more))
    assert 0.4 < np.mean(square) < 1.0


def test_behind_unread_powers_readings_narrow_the_busbar_only() -> None:
    """Power and busbar unknown: the variance is that of the power, and the posterior one of the busbar."""
    made, random = modes(MODEL), np.random.default_rng(7)
    power, at = 0.01 * random.standard_normal((13, 1)), MODEL.meters
    places, seen, u = np.hstack([power, np.ones((13, 1))]), np.arange(12) != 5, random.standard_normal(12)
    given = Unknown(places, places[at], WIDE, np.zeros(12, dtype=np.bool_), 1)
    mean, variance = doubts.estimated(made.noise, given, u, seen, hidden=True)
    same, _ = doubts.estimated(made.noise, given, u, seen)
    assert np.allclose(mean, same)
    n = at[seen]
    V = places[n] @ places[n].T + made.noise[np.ix_(seen, seen)]
    of_busbar = np.linalg.solve(V, np.ones(n.size))
    busbar, left = float(of_busbar @ u[seen]), 1.0 - float(of_busbar.sum())
    assert np.allclose(variance, left + power[:, 0] ** 2 + (mean - busbar) ** 2)


def test_without_readings_nothing_is_known() -> None:
    """The variance is that of the directions."""
    places = np.ones((13, 1))
    given = Unknown(places, places[MODEL.meters], WIDE[:1], np.zeros(12, dtype=np.bool_), 1)
    mean, variance = doubts.estimated(modes(MODEL).noise, given, np.ones(12), np.zeros(12, dtype=np.bool_))
    assert not mean.any()
    assert np.allclose(variance, 1.0)


def test_the_search_integrates_lasting_errors_out() -> None:
    """Costs less twice the gain are those with the lasting amounts as faults without a charge."""
    random = np.random.default_rng(6)
    kernel = core.assemble(MODEL, np.vstack([np.zeros(12), STEPS]), np.full(12, 0.1), gamma=1e6)
    root, U = random.standard_normal((12, 12)), 0.02 * random.standard_normal((12, 2))
    scored = Scored(random.standard_normal(12), root @ root.T)
    reduced, gain = core._problem(kernel, scored, U)
    columns = np.hstack([np.eye(12), kernel.faults.beside, U])
    y, F = columns.T @ scored.score, columns.T @ scored.information @ columns
    plain, none = core._problem(kernel, scored, None)
    assert none == 0.0
    whole = SearchProblem(
        y,
        F,
        np.concatenate([plain.std, np.full(2, masking.LASTS)]),
        12,
        np.concatenate([plain.charge, np.zeros(2)]),
        np.full(y.size, np.inf),
    )
    for chosen in random.random((5, plain.y.size)) < 0.2:
        both = np.append(chosen, [True, True])
        assert np.isclose(costs.cost(reduced, chosen) - 2.0 * gain, costs.cost(whole, both))
        few, same = core._problem(kernel, scored, U, chosen)
        assert same == gain
        assert np.allclose(few.y, reduced.y[chosen])
        assert np.allclose(few.F, reduced.F[np.ix_(chosen, chosen)])
        assert few.meters == np.count_nonzero(chosen[:12])


def test_a_lasting_error_does_not_decide_between_meters_over_time() -> None:
    """One of three meters beyond an unread power is off, or both others are: no evidence arises from time."""
    group = np.arange(12) >= 9
    unknown, kernel = (
        np.where(group, 0.3, 0.0)[:, None],
        core.assemble(MODEL, np.vstack([np.zeros(12), STEPS]), np.full(12, 0.1), gamma=1e6),
    )
    source, state, odds = Source(MODEL, np.random.default_rng(2)), core.init(kernel, 0.0), []
    lie = 0.06 * (np.arange(12) == 9)
    for k in range(340):
        m = source.tick() + lie * (k >= 40) + 0.06 * group * (k >= 40)
        state, _ = core.step(kernel, state, float(k), m, None, unknown)
        if k in (60, 339):
            problem, _ = core._problem(kernel, state.suspected[0].scored, unknown)
            sets = (np.arange(problem.y.size) == 9, np.isin(np.arange(problem.y.size), (10, 11)))
            odds.append(costs.cost(problem, sets[0]) - costs.cost(problem, sets[1]))
    assert abs(odds[1] - odds[0]) < 10.0
