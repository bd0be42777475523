"""Own errors of the meters against batch regression, and evidence against their accuracy classes."""

from __future__ import annotations

from dataclasses import replace
from math import inf, log

import numpy as np
import pytest
from scipy.integrate import quad

from benchmarks._residuals import Source
from gridsec.arrays import Bools, Floats
from gridsec.estimators.modal import classes, core, full, static
from gridsec.estimators.modal import filter as modal
from gridsec.estimators.modal.detector import SIZE
from gridsec.estimators.modal.filter import FilterState
from gridsec.estimators.modal.model import Modes, ResidualModel, modes
from gridsec.estimators.modal.static import Static
from tests.gridsec.estimators.modal.test_core import LIAR, MODEL
from tests.gridsec.estimators.modal.test_filter import mixed

METERS, TICKS = 12, 15
ALL = np.ones(METERS, dtype=np.bool_)
ALLOWED = np.sqrt(3.0 * MODEL.fixed)
"""Half-width of a uniform error with the variance of the model."""


def batch(model: ResidualModel, m: Floats, seen: Bools) -> tuple[Floats, Floats]:
    """Means and variances of the own errors given all readings (k, p), by one Gaussian regression."""
    at, k = np.arange(METERS), len(m)
    S, H, phi = model.loads(at), model.phases(at), model.fixed
    lag = np.abs(np.subtract.outer(np.arange(k), np.arange(k)))
    lasting = np.diag(phi) + model.busbar * (H @ H.T)
    V = np.kron(np.exp(-lag / model.time_s), S) + np.kron(np.ones((k, k)), lasting)
    V += np.kron(np.eye(k), model.noise(at))
    C, kept = np.tile(np.diag(phi), k)[:, seen.ravel()], seen.ravel()
    gain = np.linalg.solve(V[np.ix_(kept, kept)], C.T).T
    return gain @ m.ravel()[kept], phi - (gain * C).sum(axis=1)


def followed(model: ResidualModel, m: Floats, seen: Bools) -> tuple[Modes, FilterState, Static]:
    """The exact filter after these readings."""
    made = modes(model)
    state, known = modal.start(made, 0.0), static.start(made)
    for k, (each, read) in enumerate(zip(m, seen, strict=True)):
        state, known, _ = full.step(made, state, known, float(k), each, None if read.all() else read)
    return made, state, known


@pytest.mark.parametrize("share", [0.0, 0.3])
@pytest.mark.parametrize("model", [replace(MODEL, fixed_s=inf), replace(mixed(METERS), fixed_s=inf)])
def test_own_errors_equal_those_of_batch_regression(model: ResidualModel, share: float) -> None:
    """Complete and missing readings, one class and two, a busbar's meter with an error of its own."""
    random = np.random.default_rng(4)
    m, seen = 0.01 * random.standard_normal((TICKS, METERS)), random.random((TICKS, METERS)) >= share
    made, state, known = followed(model, m, seen)
    # With many directions N is computed anew only where refinements do not suffice.
    known = static.current(made, known) if state.full is None else known
    own, (mean, variance) = classes.classes(made, ALLOWED), batch(model, m, seen)
    np.testing.assert_allclose(classes.means(own, made, state, known), mean, atol=1e-9 * np.abs(mean).max())
    np.testing.assert_allclose(classes.variances(own, made, state, known), variance, rtol=1e-7)


@pytest.mark.parametrize("scale", [0.2, 1.0, 3.0])
def test_the_evidence_is_that_of_numerical_integration(scale: float) -> None:
    """The likelihood of each own error has the prior of the filter taken out."""
    source = Source(MODEL, np.random.default_rng(2))
    m = scale * np.stack([source.tick() for _ in range(TICKS)])
    made, state, known = followed(MODEL, m, np.ones_like(m, dtype=np.bool_))
    own = classes.classes(made, ALLOWED)
    mean, v = (f(own, made, state, known) for f in (classes.means, classes.variances))
    every = []
    for j in range(METERS):
        phi, a = MODEL.fixed[j], ALLOWED[j]
        G, g = 1.0 / v[j] - 1.0 / phi, mean[j] / v[j]
        most = g * np.clip(g / G, -a, a) - 0.5 * G * np.clip(g / G, -a, a) ** 2

        def density(c: float, G: float = G, g: float = g, most: float = most) -> float:
            whole = g * c - 0.5 * G * c * c - most - 0.5 * (c / SIZE) ** 2
            return float(np.exp(whole) / (SIZE * np.sqrt(2.0 * np.pi)))

        near = g / G, 8.0 / np.sqrt(G)
        every.append(quad(density, near[0] - near[1], near[0] + near[1], epsrel=1e-10)[0])
    some = np.arange(METERS) < 5
    found = classes.log_lambda(own, made, state, known, some)
    np.testing.assert_allclose(found, np.where(some, np.log(every), -inf), atol=1e-6)
    limit = float(np.max(found)) - log(METERS)
    for more, count in ((-1e-9, 1), (1e-9, 0)):
        assert classes.exceeding(own, made, state, known, some, limit + more).sum() == count


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_errors_within_the_classes_are_no_evidence(share: float) -> None:
    """Mean of each Lambda over drawn runs with every own error at its bound, and a year of aging: at most 1.

    The largest of a run exceeds 100 in at most one of 100 / 12 runs, by Ville's inequality.
    """
    random, found = np.random.default_rng(7), []
    for seed in range(60):
        source = Source(MODEL, np.random.default_rng([seed, 3]))
        source.b = ALLOWED * random.choice([-1.0, 1.0], METERS)
        m = np.stack([source.tick() for _ in range(40)])
        made, state, known = followed(MODEL, m, random.random(m.shape) >= share)
        found.append(np.exp(classes.log_lambda(classes.classes(made, ALLOWED), made, state, known, ALL)))
    mean = np.mean(found, axis=0)
    assert (mean <= 1.0 + 3.0 * np.std(found, axis=0) / np.sqrt(len(found))).all()
    assert mean.max() > 0.1
    assert np.mean(np.max(found, axis=1) > 100.0) <= METERS / 100.0


def test_without_a_bound_no_meter_exceeds() -> None:
    """No class, no meter that counts, or perfect meters."""
    made, state, known = followed(MODEL, np.ones((3, METERS)), np.ones((3, METERS), dtype=np.bool_))
    own = classes.classes(made, np.full(METERS, inf))
    free = replace(own, allowed=ALLOWED, fixed=np.zeros(METERS))
    for each, counted in ((own, ALL), (classes.classes(made, ALLOWED), ~ALL), (free, ALL)):
        assert (classes.log_lambda(each, made, state, known, counted) == -inf).all()
        assert not classes.exceeding(each, made, state, known, counted, 0.0).any()


def test_a_meter_without_readings_does_not_count() -> None:
    """Its own error has the prior's variance."""
    seen = np.ones((TICKS, METERS), dtype=np.bool_)
    seen[:, 3] = False
    source = Source(MODEL, np.random.default_rng(2))
    made, state, known = followed(MODEL, np.stack([source.tick() for _ in range(TICKS)]), seen)
    own = classes.classes(made, ALLOWED)
    assert classes.variances(own, made, state, known)[3] == pytest.approx(MODEL.fixed[3])
    found = classes.log_lambda(own, made, state, known, ALL)
    assert (np.isinf(found) == (np.arange(METERS) == 3)).all()


def bounded() -> core.Core:
    """Core of 12 meters with classes."""
    return core.assemble(MODEL, np.zeros((13, METERS)), np.full(METERS, 0.1), gamma=1e6, allowed=ALLOWED)


def lie(classes_off: float) -> Floats:
    """One meter is off by so many classes."""
    return classes_off * ALLOWED * (np.arange(METERS) == LIAR)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_a_lie_from_the_first_reading_on_exceeds_the_class(share: float) -> None:
    """Three classes are 5.2 standard deviations of the prior: the filter learns them without an alarm."""
    kernel, source = bounded(), Source(MODEL, np.random.default_rng(5))
    random = np.random.default_rng(6)
    source.b = ALLOWED * random.uniform(-1.0, 1.0, METERS) * (np.arange(METERS) != LIAR)
    state, found = core.init(kernel, 0.0), []
    for k in range(200):
        seen = random.random(METERS) >= share
        state, _ = core.step(kernel, state, float(k), source.tick() + lie(3.0), seen)
        found.append(np.flatnonzero(state.exceeding).tolist())
    assert found[60:] == 140 * [[LIAR]]
    assert not state.detector.pinned.any()


def test_another_manipulation_is_named_beside_it_and_a_named_meter_exceeds_no_class() -> None:
    """A second meter steps at tick 150; the first one, once masked, is not compared any more."""
    kernel, source, second = bounded(), Source(MODEL, np.random.default_rng(5)), 9
    source.b = np.zeros(METERS)
    state = core.init(kernel, 0.0)
    for k in range(170):
        step = 0.5 * ALLOWED * (k >= 150) * (np.arange(METERS) == second)
        state, evidence = core.step(kernel, state, float(k), source.tick() + lie(2.5) + step)
    assert np.flatnonzero(state.exceeding).tolist() == [LIAR]
    suspicion = core.identify(kernel, state, evidence)
    assert np.flatnonzero(suspicion.found.named).tolist() == [second]
    after, _ = core.mask(kernel, state, suspicion)
    assert np.flatnonzero(after.exceeding).tolist() == [LIAR]
    both = replace(suspicion, found=replace(suspicion.found, named=suspicion.found.named | (lie(1.0) > 0.0)))
    assert not core.mask(kernel, state, both)[0].exceeding.any()


def test_the_gain_of_errors_alike_is_that_of_a_bounded_error() -> None:
    """Against a grid of one phase; two phases that share no meter count apart, and silent ones not at all."""
    y, F, most = 3.0, 2.0, 1.2
    error = np.linspace(-most, most, 2001)
    best = float((2.0 * error * y - F * error**2).max())
    assert classes.common(np.array([y]), np.array([[F]]), np.array([most])) == pytest.approx(best)
    two = classes.common(np.array([y, -y]), F * np.eye(2), np.array([most, 10.0]))
    assert two == pytest.approx(best + y * y / F)
    assert classes.common(np.zeros(1), np.zeros((1, 1)), np.array([most])) == 0.0


@pytest.mark.parametrize(("classes_off", "fits"), [(-1.0, False), (3.0, True)])
def test_errors_alike_within_the_classes_are_no_fault_of_the_busbar(classes_off: float, fits: bool) -> None:
    """All meters at one end of their class, far coarser than that of the busbar, and three times as far."""
    model = replace(MODEL, busbar=1e-6, fixed=4.0 * MODEL.fixed)
    allowed, blind = np.sqrt(3.0 * model.fixed), np.zeros((13, METERS))
    kernel = core.assemble(model, blind, np.full(METERS, 0.1), gamma=1e3, allowed=allowed)
    source, state = Source(model, np.random.default_rng(5)), core.init(kernel, 0.0)
    source.b = classes_off * allowed
    for k in range(4):
        state, evidence = core.step(kernel, state, float(k), source.tick())
        assert core.alarmed(kernel, evidence)
        suspicion = core.identify(kernel, state, evidence)
        assert np.flatnonzero(suspicion.found.chosen[0]).tolist() == [kernel.bound.size - 1]
        assert suspicion.fits is fits
