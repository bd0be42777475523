"""Model of a designed feeder, and the core on its residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks._residuals import Source, model_of, power_columns, tree
from gridsec.estimators.front import FrontDesign
from gridsec.estimators.modal import core
from gridsec.estimators.modal.model import REPORTED_S, modes, residual_model
from tests.gridsec.estimators.modal.streets import front_end
from tests.gridsec.street import Street, make_plant

MODEL = model_of(tree(12, np.random.default_rng(3)))
LIAR = 4
STEPS = power_columns(tree(12, np.random.default_rng(3)))[:, :12]


def front(**options: np.ndarray) -> tuple[FrontDesign, Street]:
    """A designed street and its truth."""
    plant = make_plant(np.random.default_rng(5), customers=12, drop=0.03, **options)
    return front_end(plant), Street(plant, np.random.default_rng(6))


def test_modes_diagonalise_the_model() -> None:
    """U'DU is the identity, U'SU and U'(kappa D)U are diagonal, and B is put together again."""
    model = replace(MODEL, fixed=MODEL.fixed * np.linspace(1.0, 3.0, 12))
    made = modes(model)
    D, S, B = model.noise(made.at), model.loads(made.at), model.static(made.at)
    assert np.allclose(made.U.T @ D @ made.U, np.eye(12), atol=1e-10)
    assert np.allclose(made.U.T @ S @ made.U, np.diag(made.loads), atol=1e-9 * made.loads.max())
    assert np.allclose(made.back @ made.U.T, np.eye(12), atol=1e-9)
    G = made.back @ made.directions
    whole = (made.back * made.lasting) @ made.back.T + (G * made.sign) @ G.T
    assert np.allclose(whole, B, atol=1e-9 * B.max())
    assert (made.varying == made.loads).all()


def test_the_model_is_that_of_the_front_end() -> None:
    """Loads with the busbar are the prior of the front end."""
    made, _ = front()
    model = residual_model(made)
    with_busbar = model.of_meters + model.busbar
    assert np.allclose(with_busbar, made.prior.covariance)
    assert np.allclose(model.variance + model.busbar, made.prior.variance)
    assert (model.white == made.white).all()
    assert (model.fixed == made.fixed).all()


def test_errors_of_registers_change_within_an_hour() -> None:
    """Errors of registers last, but as parts of loads that change."""
    made, _ = front()
    for known_s in (600.0, 7200.0):
        doubt = replace(made.doubt, time_s=known_s)
        assert residual_model(replace(made, doubt=doubt)).time_s == known_s
        always = replace(made, doubt=replace(doubt, lasting=1.0))
        assert residual_model(always).time_s == max(known_s, REPORTED_S)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"white": np.zeros(12)}, "white must be positive"),
        ({"fixed": np.full(12, -1.0)}, "fixed must be at least 0"),
        ({"busbar": -1.0}, "busbar must be at least 0"),
        ({"flicker": np.nan}, "flicker must be at least 0"),
        ({"time_s": 0.0}, "time_s must be positive"),
        ({"fixed_s": -1.0}, "fixed_s must be positive"),
        ({"white": np.ones(3)}, "white has the shape"),
        ({"of_meters": np.ones((3, 3))}, "of_meters has the shape"),
    ],
)
def test_wrong_models_are_refused(change: dict[str, object], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        replace(MODEL, **change)  # type: ignore[arg-type]


def test_modes_need_a_member_and_gamma_is_at_least_1() -> None:
    with pytest.raises(ValueError, match="at least one meter"):
        modes(MODEL, np.zeros(0, dtype=np.intp))
    with pytest.raises(ValueError, match="gamma"):
        core.assemble(MODEL, np.zeros((13, 12)), np.ones(12), gamma=0.5)
    kernel = core.design(front()[0])
    with pytest.raises(ValueError, match="no reading"):
        core.estimate(kernel, core.init(kernel, 0.0))


def test_on_the_residuals_of_a_street() -> None:
    """AC power flow: no alarm without a lie; a lie of 3 % is named at once, and the voltage is put right."""
    made, street = front(inverters=np.zeros(0, dtype=np.intp))
    kernel, mine, feeder = core.design(made), None, made.plant.feeder
    for k in range(120):
        street.advance(1.0)
        frame = street.frame({LIAR: 0.03} if k >= 100 else None)
        v2 = feeder.bus_voltages(frame.p, frame.q, frame.v0_squared, steps=made.plant.loss_correction)
        mine = core.init(kernel, frame.t) if mine is None else mine
        mine, evidence = core.step(kernel, mine, frame.t, frame.y - v2[made.prior.meters])
        assert k >= 100 or not core.alarmed(kernel, evidence)
    assert core.alarmed(kernel, evidence)
    suspicion = core.identify(kernel, mine, evidence)
    assert np.flatnonzero(suspicion.found.named).tolist() == [LIAR]
    place = made.prior.meters[LIAR]
    plain, right = core.estimate(kernel, mine), core.estimate(kernel, mine, suspicion)
    lie = 1.03**2 - 1.0
    assert abs(right.mean[place]) < 0.1 * lie
    assert abs(plain.mean[place]) > abs(right.mean[place])
    assert right.variance[place] > plain.variance[place]


def test_a_suspected_onset_is_kept_and_given_up() -> None:
    """The onset of the alarm stays pinned while the lie lasts; its age is that of the lie."""
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e6)
    source, state = Source(MODEL, np.random.default_rng(1)), core.init(kernel, 0.0)
    for k in range(400):
        lie = 0.02 * (k >= 300) * np.eye(12)[LIAR]
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie)
    suspicion = core.identify(kernel, state, evidence)
    assert state.detector.pinned.any()
    assert abs(int(state.detector.onsets.age[suspicion.row]) - 100) <= 1
    assert np.flatnonzero(suspicion.found.named).tolist() == [LIAR]


def test_jumps_at_every_tick_are_no_evidence() -> None:
    """The loads are smooth, and the filter supposes a jump of their whole variance at every tick."""
    kernel = core.assemble(MODEL, np.zeros((13, 12)), np.full(12, 0.1), gamma=1e3)
    source, state = Source(MODEL, np.random.default_rng(5)), core.init(kernel, 0.0)
    for k in range(1200):
        state, evidence = core.step(kernel, state, float(k), source.tick(), None, None, 1.0)
        assert not core.alarmed(kernel, evidence)
    assert state.loads > 10.0
    jumped = core.estimate(kernel, state).variance
    assert (jumped >= core.estimate(kernel, replace(state, loads=1.0)).variance).all()


@pytest.mark.canary("108-growing", "108-alternating")
@pytest.mark.parametrize(
    ("pattern", "fits"),
    [
        (lambda _: 1.0, True),
        (lambda k: 0.5 + 0.005 * k, True),
        (lambda k: (-1.0) ** k, False),
        (lambda k: (-1.0) ** (k // 2), False),
    ],
    ids=["lasting", "growing", "alternating", "by pairs"],
)
@pytest.mark.parametrize("ticks", [108, 125])
def test_names_need_an_explanation_of_the_misfit(
    pattern: Callable[[int], float], fits: bool, ticks: int
) -> None:
    """A third that alternates fits no lasting fault: nothing is named, neither meters nor loads adopted."""
    kernel = core.assemble(MODEL, np.vstack([np.zeros(12), STEPS]), np.full(12, 0.1), gamma=1e6)
    source, state, liars = Source(MODEL, np.random.default_rng(8)), core.init(kernel, 0.0), [2, 4, 5, 9]
    lie, found = np.array([0.08, -0.06, 0.07, 0.09]), None
    for k in range(ticks):
        m = source.tick()
        if k >= 100:
            m[liars] += pattern(k - 100) * lie
        state, evidence = core.step(kernel, state, float(k), m)
        if k >= 103:
            assert core.alarmed(kernel, evidence)
            found = core.identify(kernel, state, evidence, found)
            assert found.fits is fits
            assert not (found.found.named & ~np.isin(np.arange(12), liars)).any()
            assert fits or not found.found.named.any()
            assert fits or core.adopt(kernel, state, found) is state
    assert found is not None
    assert not fits or found.found.named[liars].all()
