"""Droop inverters on unbalanced feeders: the closed loop, and proofs that do not need symmetry."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from feeders.model.three_phase import load_three_phase
from feeders.simulation.powerflow import UnbalancedPowerFlow
from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.grid.devices import Droop, fleet
from gridsec.grid.three_phase import ThreePhaseFeeder, bus_voltages, lindist3flow, per_customer
from gridsec.observers.certificates import Certificate, reactance, small_gain, verify
from gridsec.observers.lure import Lure, close_loop, equilibrium, known_input
from tests.codes import refused
from tests.gridsec.unbalanced import random_three_phase


def loop(feeder: ThreePhaseFeeder, kva: float, *, spread: float = 1.0, seed: int = 0) -> tuple[Droop, Lure]:
    """An inverter and a meter at every customer."""
    own = np.arange(len(feeder.customers))
    tau = 2.0 * spread ** np.random.default_rng(seed).uniform(-0.5, 0.5, own.size)
    droop = fleet(own, "ieee1547-b", np.full(own.size, kva), feeder.base_kva, tau=tau)
    return droop, close_loop(feeder, droop, own)


@given(st.integers(0, 100_000))
def test_customers_feel_their_connections(seed: int) -> None:
    feeder = random_three_phase(seed)
    model = lindist3flow(feeder)
    found = per_customer(feeder, model)
    rng = np.random.default_rng(seed)
    kw, kvar = rng.normal(size=(2, len(feeder.customers)))
    third = feeder.base_kva / 3
    p, q = feeder.connections(kw) / third, feeder.connections(kvar) / third
    squared = 1.0 + 2.0 * (model.R @ p + model.X @ q)
    means = [squared[feeder.of == j].mean() for j in range(len(feeder.customers))]
    expected = 1 + 2 * (found.R @ kw + found.X @ kvar) / feeder.base_kva
    np.testing.assert_allclose(means, expected, rtol=0, atol=1e-13)


@given(st.integers(0, 100_000))
def test_closed_loop_has_the_reactances_of_the_customers(seed: int) -> None:
    feeder = random_three_phase(seed)
    _, lure = loop(feeder, 5.0)
    X = per_customer(feeder, lindist3flow(feeder)).X
    np.testing.assert_array_equal(lure.H, -2 * X)
    np.testing.assert_array_equal(lure.C, -2 * X)


def norm(certificate: Certificate, e: Floats) -> float:
    if certificate.kind == "small-gain":
        return float(np.max(np.abs(e) / certificate.P))
    return float(np.sqrt(e @ certificate.P @ e))


def decays(certificate: Certificate, droop: Droop, lure: Lure, seed: int) -> None:
    """Random errors, trusted sets and slopes, switching every step, against the certified rate."""
    rng = np.random.default_rng(seed)
    count, step = droop.tau.size, 1e-3 * float(droop.tau.min())
    for _ in range(5):
        e = rng.normal(size=count)
        for _ in range(40):
            free = rng.random(count) < rng.random()
            slope = lure.slope * np.where(rng.random(count) < 0.5, 1.0, rng.random(count)) * free
            # T e' = -(I + Delta Pi S) e, exactly over one short step.
            matrix = -(np.eye(count) - slope[:, None] * lure.H) / droop.tau[:, None]
            values, vectors = np.linalg.eig(matrix)
            after = (vectors * np.exp(values * step) @ np.linalg.solve(vectors, e.astype(complex))).real
            assert norm(certificate, after) <= norm(certificate, e) * np.exp(-certificate.rate * step) + 1e-12
            e = after


@given(st.integers(0, 100_000), st.floats(0.2, 0.9), st.sampled_from([1.0, 5.0]))
@settings(max_examples=25, deadline=None)
def test_small_gain_holds_without_symmetry(seed: int, gain: float, spread: float) -> None:
    feeder = random_three_phase(seed)
    droop, lure = loop(feeder, 1.0, spread=spread, seed=seed)
    size = float(np.max(np.abs(np.linalg.eigvals(np.abs(lure.slope[:, None] * lure.H)))))
    if size == 0.0:  # everybody on the busbar: nothing couples
        return
    droop, lure = loop(feeder, gain / size, spread=spread, seed=seed)
    certificate = small_gain(lure)
    assert verify(certificate, lure) > 0.0
    decays(certificate, droop, lure, seed)


@given(st.integers(0, 100_000), st.floats(0.2, 3.0))
@settings(max_examples=25, deadline=None)
def test_what_the_quadratic_norm_claims_of_asymmetric_systems_is_so(seed: int, gain: float) -> None:
    feeder = random_three_phase(seed)
    droop, lure = loop(feeder, 1.0)
    size = float(np.max(np.abs(np.linalg.eigvals(lure.slope[:, None] * lure.H)), initial=0.0))
    if size == 0.0:
        return
    droop, lure = loop(feeder, gain / size)
    certificate = reactance(lure)
    decays(certificate, droop, lure, seed)


@pytest.mark.canary("2.3")
@pytest.mark.parametrize("kva", [2.3, 4.6])
def test_european_feeder_with_an_inverter_everywhere(kva: float) -> None:
    feeder = load_three_phase("ieee-european-lv").feeder
    droop, lure = loop(feeder, kva, spread=2.0)
    asymmetry = np.linalg.norm(lure.H - lure.H.T) / np.linalg.norm(lure.H)
    assert asymmetry > 1.5
    for attempt in (reactance, small_gain):
        certificate = attempt(lure)
        assert certificate.margin > 0.0
        assert verify(certificate, lure) > 0.0
        assert certificate.rate > 0.1 / droop.tau.max()
        decays(certificate, droop, lure, 1)


def test_too_large_a_fleet_has_no_certificate() -> None:
    feeder = load_three_phase("ieee-european-lv").feeder
    _, lure = loop(feeder, 20.0)
    for attempt in (reactance, small_gain):
        with refused(DesignInfeasible, "unstable"):
            attempt(lure)


@pytest.mark.canary("0.5-1.05")
@pytest.mark.parametrize(("sun", "busbar"), [(0.9, 1.04), (0.5, 1.05), (0.0, 0.95)])
def test_inverters_rest_where_the_asymmetric_power_flow_rests(sun: float, busbar: float) -> None:
    """Single-phase inverters on the European feeder: equilibrium of the model and of the AC equations."""
    site = load_three_phase("ieee-european-lv")
    feeder, droop, flow = site.feeder, site.droop, UnbalancedPowerFlow(site)
    base, own = feeder.base_kva, site.droop.customer
    load, pv = site.loads.load_peak, site.loads.pv_peak
    p, q_load = 0.7 * load - sun * pv, 0.2 * load  # import, in units of the three-phase base

    def volts(x: Floats) -> Floats:
        q = q_load - np.bincount(own, weights=x, minlength=load.size)
        return flow.solve(p * base, q * base, busbar * feeder.base_volt)[0] / feeder.base_volt

    x: Floats = np.zeros(own.size)
    for _ in range(60):
        x = 0.5 * x + 0.5 * droop(droop.vbar**2 - volts(x)[own] ** 2)
    assert np.abs(x).max() > 0.2 * droop.limit.max()  # the curves are at work

    lure = close_loop(feeder, droop, site.meters)
    model = per_customer(feeder, lindist3flow(feeder))
    v0 = np.full(3, busbar**2)
    found: Floats = np.zeros(own.size)
    for _ in range(4):  # the correction belongs to the injections that come out
        q = np.bincount(own, weights=found, minlength=load.size) - q_load
        p_phase, q_phase = feeder.connections(-3 * p), feeder.connections(3 * q)
        flat, full = (bus_voltages(feeder, p_phase, q_phase, v0, steps=steps) for steps in (0, 1))
        correction = (full - flat)[feeder.phase, feeder.at]
        w = known_input(model, droop.vbar, -p, -q_load, busbar**2, correction)
        found = equilibrium(lure, w, tol=1e-12, max_iter=200)
    np.testing.assert_allclose(found, x, rtol=0, atol=2e-3 * droop.limit.max())
    z = lure.H @ found + lure.F @ w
    np.testing.assert_allclose(np.sqrt(droop.vbar**2 - z), volts(x)[own], rtol=0, atol=1e-4)
