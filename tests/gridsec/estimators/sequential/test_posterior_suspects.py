"""Powers of customers whose meters are not believed, against dense conditioning and AC power flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from feeders.model.site import load
from feeders.registry import SEQUENTIAL, choose, design
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.scenario import START
from feeders.simulation.trial import LoadError, Trial, TrialMeterErrors, frames
from gridsec.arrays import Floats
from gridsec.estimators.sequential.posterior import (
    FALSE_Q,
    LoadDoubt,
    Posterior,
    Prior,
    add_unknown,
    condition,
    doubt_powers,
    leave_one_out,
    voltage_prior,
)
from gridsec.grid.network import Power, Sensitivities
from tests.gridsec.street import BASE_KVA, make_plant

CUSTOMERS = 12


def problem(seed: int) -> tuple[Sensitivities, Posterior, Floats]:
    """A street, nine of whose meters are believed, one load of it loosened, and what the meters say.

    Two of the meters are at one bus, and they err by different amounts.
    """
    rng = np.random.default_rng(seed)
    plant = make_plant(rng, customers=CUSTOMERS, drop=0.03)
    bus = plant.feeder.bus.copy()
    bus[6] = bus[2]
    plant = replace(plant, feeder=replace(plant.feeder, bus=bus))
    doubt = LoadDoubt(np.full(CUSTOMERS, 0.5 / BASE_KVA), np.full(CUSTOMERS, 0.2 / BASE_KVA), 600.0)
    every = np.arange(CUSTOMERS)
    known: Prior = voltage_prior(
        plant.feeder, plant.feeder.bus, doubt, busbar=1e-4, inverters=np.zeros(CUSTOMERS)
    )
    now = condition(known, 10.0 ** rng.uniform(-7.0, -5.0, CUSTOMERS), ~np.isin(every, (3, 7, 11)))
    sensitivities = Sensitivities(plant.feeder)
    add_unknown(now, sensitivities.columns(Power.ACTIVE, np.array([5]))[:, 0], 0.01)
    return sensitivities, now, rng.normal(size=CUSTOMERS) * 0.002


@pytest.mark.parametrize("seed", range(5))
def test_it_is_conditioning_on_a_wider_prior(seed: int) -> None:
    sensitivities, now, m = problem(seed)
    suspects, sizes = np.array([3, 7, 11]), np.array([0.02, 0.05, 0.1])
    loo = leave_one_out(now, m)
    found = doubt_powers(sensitivities, now, suspects, sizes, loo)
    std = sizes / np.sqrt(3.0) * found.share
    wider = [now.unknowns]
    for power, part in ((Power.ACTIVE, 1.0), (Power.REACTIVE, FALSE_Q)):
        wider.append(sensitivities.columns(power, suspects) * std * part)
    dense = condition(now.prior, now.noise, now.trusted, np.hstack(wider))
    np.testing.assert_allclose(found.mean(loo), leave_one_out(dense, m).mean, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.variance, dense.variance, rtol=1e-6, atol=1e-15)
    assert (found.variance >= now.variance).all()


@pytest.mark.parametrize("seed", range(5))
def test_whether_a_power_is_false_is_bayes_rule(seed: int) -> None:
    """The share is the root of a posterior probability: the ratio of two normal densities, made densely."""
    sensitivities, now, m = problem(seed)
    which, size = np.array([7]), np.array([0.05])
    a = (sensitivities.columns(Power.ACTIVE, which) * size / np.sqrt(3.0))[now.prior.meters]
    at = np.flatnonzero(now.trusted)
    S = (
        now.prior.between
        + now.unknowns[now.prior.meters] @ now.unknowns[now.prior.meters].T
        + np.diag(now.noise)
    )
    for lie in (0.0, 3.0):
        readings = m + lie * a[:, 0]
        found = doubt_powers(sensitivities, now, which, size, leave_one_out(now, readings))
        logs = [_density(S[np.ix_(at, at)] + more, readings[at]) for more in (0.0, a[at] @ a[at].T)]
        false = 1.0 / (1.0 + np.exp(logs[0] - logs[1]))
        assert found.share[0] ** 2 == pytest.approx(max(false, 1.0 / 64.0), rel=1e-6)


def _density(S: Floats, m: Floats) -> float:
    """Logarithm of a normal density, by its independent parts."""
    values, vectors = np.linalg.eigh(S)
    return float(norm.logpdf(vectors.T @ m, scale=np.sqrt(values)).sum())


def test_who_feels_nothing_odd_believes_again_and_the_work_is_kept() -> None:
    sensitivities, now, m = problem(0)
    which, size = np.array([7]), np.array([0.3])
    calm = leave_one_out(now, 0.0 * m)
    found = doubt_powers(sensitivities, now, which, size, calm)
    assert found.share[0] < 0.5
    assert found.matches(now, which, size)
    assert found.is_current(leave_one_out(now, 1e-6 * m))
    assert not found.matches(now, which, 2.0 * size)
    assert not found.matches(now, which + 1, size)
    assert not found.matches(now.copy(), which, size)
    odd = sensitivities.columns(Power.ACTIVE, which)[now.prior.meters, 0] * 0.3
    asked = leave_one_out(now, odd)
    assert not found.is_current(asked)
    again, whole = found.renewed(asked), doubt_powers(sensitivities, now, which, size, asked)
    for name in ("share", "factor", "variance"):
        np.testing.assert_allclose(getattr(again, name), getattr(whole, name), rtol=1e-12, atol=0)
    np.testing.assert_allclose(again.mean(asked), whole.mean(asked), rtol=1e-12, atol=0)


def test_a_third_lies_about_voltages_and_powers_alike() -> None:
    """Nobody honest is named for powers that liars tell, and errors are as large as is said."""
    site = load("kerber-dorfnetz")
    count, ratios = site.meters.size // 3, []
    lie = AttackSpec(AttackKind.BIAS, count, 3.0, onset_s=10.0)
    trial = Trial(
        site,
        seed=5,
        duration_s=35.0,
        load_error=LoadError(0.3, 0.1),
        meters=TrialMeterErrors.REAL,
        lie=lie,
    )
    watcher = design(choose(trial.stated, estimator=SEQUENTIAL))
    state, rng = watcher.init(START), np.random.default_rng(5)
    fake = rng.uniform(-15.0, 15.0, site.meters.size) / site.feeder.base_kva
    for frame, truth in frames(trial):
        p = frame.p.copy()
        p[site.meters] += np.where(truth.liars, fake, 0.0)
        state, estimate, verdict = watcher.step(state, replace(frame, p=p))
        assert not (verdict.suspects & ~truth.liars).any()
        if frame.t >= START + 20.0:
            assert (verdict.suspects == truth.liars).all()
            ratios.append(
                np.abs(estimate.v2 - truth.v2)[site.meters[truth.liars]]
                / estimate.std[site.meters[truth.liars]]
            )
    assert np.percentile(np.concatenate(ratios), 95) < 3.0
