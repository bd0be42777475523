"""Certificates against matrix exponentials, solve_ivp, the corrected inequality (12), and forgeries."""

from __future__ import annotations

import warnings
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import expm

from gridsec.arrays import spectral_radius
from gridsec.errors import DesignInfeasible
from gridsec.grid.devices import Droop, fleet
from gridsec.grid.radial import Feeder
from gridsec.observers.certificates import (
    Certificate,
    certify,
    error_bound,
    feeds,
    quadratic,
    reactance,
    small_gain,
    verify,
)
from gridsec.observers.lure import Lure, close_loop
from tests.codes import refused
from tests.gridsec.certified import norm, seeds
from tests.gridsec.radial import random_feeder, random_loop


def asymmetric(lure: Lure, droop: Droop, seed: int, amount: float) -> Lure:
    """The loop with a skew part added to S, as single-phase customers on a three-phase cable have."""
    rng = np.random.default_rng([seed, 9])
    skew = rng.normal(size=lure.H.shape)
    return replace(lure, H=lure.H + amount * np.max(np.abs(lure.H)) * (skew - skew.T), phi=droop)


def switched_decay(lure: Lure, certificate: Certificate, seed: int) -> None:
    """Products of exponentials over random trusted sets and slopes shrink every error as certified."""
    rng = np.random.default_rng([seed, 6])
    n = lure.slope.size
    tau, S = -1.0 / np.diag(lure.A), -lure.H
    e = rng.normal(size=(5, n)) * 10.0 ** rng.uniform(-2, 2, (5, n))
    for _ in range(12):
        slopes = lure.slope * rng.choice([0.0, 1.0, 1.0, 0.3], n) * (rng.random(n) < 0.7)
        h = 10.0 ** rng.uniform(-2, 1)
        after = e @ expm(-h * (np.eye(n) + slopes[:, None] * S) / tau[:, None]).T
        allowed = norm(certificate, e) * np.exp(-certificate.rate * h)
        assert np.all(norm(certificate, after) <= allowed * (1 + 1e-9))
        e = after


@given(seed=seeds, gain=st.sampled_from([0.1, 0.9, 1.1, 5.0, 50.0]))
def test_reactance_holds_for_every_tree_and_common_tau(seed: int, gain: float) -> None:
    # Customers share buses and sit on the busbar in most of these feeders: X is singular.
    _, droop, lure = random_loop(seed, gain=gain)
    certificate = reactance(lure)
    assert certificate.kind == "reactance"
    # kappa = 0.01 costs half a percent, the back-off another one.
    assert 0.995 * 0.99 * (1 - 1e-9) <= certificate.rate * droop.tau[0] < 1.0
    assert certificate.margin > 0
    assert verify(certificate, lure) == certificate.margin
    switched_decay(lure, certificate, seed)


@given(seed=seeds, gain=st.sampled_from([0.1, 0.9, 2.0, 10.0]), spread=st.sampled_from([2.0, 5.0, 20.0]))
def test_reactance_with_different_time_constants_decays_where_it_holds(
    seed: int, gain: float, spread: float
) -> None:
    _, droop, lure = random_loop(seed, gain=gain, spread=spread)
    try:
        certificate = reactance(lure)
    except DesignInfeasible as error:
        refused = error
    else:
        switched_decay(lure, certificate, seed)
        return
    assert refused.margin is not None
    assert refused.margin <= 0
    assert gain > 0.5
    assert np.ptp(droop.tau) > 0


def test_asymmetry_is_charged_for() -> None:
    refused: list[bool] = []

    @settings(max_examples=50)
    @given(seed=seeds, gain=st.sampled_from([0.1, 0.5, 0.9]), amount=st.sampled_from([0.02, 0.3]))
    def holds(seed: int, gain: float, amount: float) -> None:
        _, droop, lure = random_loop(seed, gain=gain)
        skewed = asymmetric(lure, droop, seed, amount)
        refused.append(False)
        try:
            certificate = reactance(skewed)
        except DesignInfeasible:
            refused[-1] = True
            assert (gain, amount) == (0.9, 0.3)
            return
        assert certificate.rate <= reactance(lure).rate * (1 + 1e-9)
        switched_decay(skewed, certificate, seed)

    holds()
    # Of the seeds fewer than 1 %.
    assert sum(refused) <= 0.1 * len(refused)


def test_strong_asymmetry_at_high_gain_is_refused() -> None:
    _, droop, lure = random_loop(8, gain=5.0)
    with refused(DesignInfeasible, "unstable"):
        reactance(asymmetric(lure, droop, 8, 3.0))


@given(
    seed=seeds,
    gain=st.sampled_from([0.1, 0.5, 0.9, 0.99]),
    spread=st.sampled_from([1.0, 20.0, 300.0]),
    amount=st.sampled_from([0.0, 0.3]),
)
def test_small_gain_decays_whatever_the_time_constants(
    seed: int, gain: float, spread: float, amount: float
) -> None:
    _, droop, lure = random_loop(seed, gain=gain, spread=spread)
    lure = asymmetric(lure, droop, seed, amount)
    if spectral_radius(lure.slope[:, None] * np.abs(lure.H)) >= 1:
        with refused(DesignInfeasible, "unstable"):
            small_gain(lure)
        return
    certificate = small_gain(lure)
    assert certificate.margin > 0
    assert verify(certificate, lure) == certificate.margin
    assert np.all(certificate.P > 0)
    switched_decay(lure, certificate, seed)


@given(seed=seeds, row=st.floats(0.05, 0.999))
def test_row_sums_below_one_are_enough(seed: int, row: float) -> None:
    _, _, lure = random_loop(seed, gain=1.0)
    sums = lure.slope * np.sum(np.abs(lure.H), axis=1)
    if sums.max() == 0:
        return
    certificate = small_gain(replace(lure, H=lure.H * row / sums.max()))
    # With weights 1 the rate would be (1 - row) / tau; better weights only raise it, less the back-off.
    assert certificate.rate * 2.0 >= 0.9 * (1.0 - row) * (1 - 1e-9)


@given(seed=seeds, gain=st.sampled_from([0.5, 5.0]))
def test_feasible_point_of_the_corrected_inequality(seed: int, gain: float) -> None:
    # chong2020 (12) as corrected, for direct injection K = E_J, L = 0, built block by block. Lambda is
    # 1 / tau off J and large on J, mu large.
    _, _, lure = random_loop(seed, gain=gain)
    certificate = reactance(lure)
    rng = np.random.default_rng([seed, 10])
    n = lure.slope.size
    J = np.flatnonzero(rng.random(n) < 0.5)
    E = np.eye(n)[:, J]
    H = lure.H - E @ lure.C[J]
    P, alpha = certificate.P, certificate.rate
    top = 1e3 * np.max(np.abs(P)) * np.max(lure.slope) / np.min(np.linalg.eigvalsh(P))
    heavy = certificate.multiplier * np.where(np.isin(np.arange(n), J), max(1e3, top), 1.0)
    Lambda, live = np.diag(heavy), lure.slope > 0
    mu = 1e6 * max(1.0, float(np.max(heavy)) ** 2)
    off = P @ lure.G + H.T @ Lambda
    # Entries of psi with slope zero vanish: their rows and columns are left out instead of divided by 0.
    blocks = [
        [P @ lure.A + lure.A.T @ P + 2 * alpha * P, off[:, live], np.zeros((n, J.size))],
        [off[:, live].T, -2 * np.diag(heavy[live] / lure.slope[live]), -(Lambda @ E)[live]],
        [np.zeros((J.size, n)), -(Lambda @ E)[live].T, -mu * np.eye(J.size)],
    ]
    matrix = np.block(blocks)
    scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    assert np.max(np.linalg.eigvalsh(scale[:, None] * matrix * scale)) <= 1e-12


def test_time_constants_too_far_apart() -> None:
    # Two customers on one street, one inverter a hundred times as fast, loop gain 20.
    feeder = Feeder(
        name="street",
        parent=np.array([0, 1]),
        r=np.array([0.01, 0.01]),
        x=np.array([0.02, 0.02]),
        bus=np.array([1, 2]),
        customers=("near", "far"),
        buses=("0", "1", "2"),
        base_volt=230.0,
        base_kva=100.0,
        charging=np.zeros(2),
    )
    own = np.array([0, 1])
    droop = fleet(own, "ieee1547-b", np.full(2, 5000.0), 100.0, tau=np.array([0.2, 20.0]))
    lure = close_loop(feeder, droop, own)
    with refused(DesignInfeasible, "unstable") as caught:
        reactance(lure)
    assert caught.value.margin is not None
    assert caught.value.margin < 0
    with refused(DesignInfeasible, "no-certificate"):
        certify(lure)
    # The certificate of the same fleet with one common tau is a forgery here, and verify says so ...
    honest = close_loop(feeder, fleet(own, "ieee1547-b", np.full(2, 5000.0), 100.0, tau=np.full(2, 2.0)), own)
    certificate = reactance(honest)
    assert verify(certificate, honest) > 0
    assert verify(certificate, lure) < 0
    # ... rightly: trusting nobody, some slopes make this norm grow.
    tau, S = droop.tau, -lure.H
    plain = S + np.diag(1e-9 / droop.slope)
    growth = [
        np.max(np.linalg.eigvals(-np.linalg.solve(plain, plain @ M + M.T @ plain)).real)
        for M in [(np.eye(2) + np.diag(droop.slope * on) @ S) / tau[:, None] for on in np.ndindex(2, 2)]
    ]
    assert max(growth) > 0


@settings(max_examples=30)
@given(seed=seeds, gain=st.sampled_from([0.2, 0.6, 1.0]))
def test_different_time_constants_on_one_bus_need_the_slope_term(seed: int, gain: float) -> None:
    feeder = replace(random_feeder(seed, customers=3), bus=np.array([1, 1, 0]))
    own, tau = np.arange(3), np.array([1.0, 4.0, 2.0])
    unit = fleet(own, "ieee1547-b", np.full(3, 1.0), 100.0, tau=tau)
    radius = spectral_radius(unit.slope[:, None] * close_loop(feeder, unit, own).H)
    lure = close_loop(feeder, fleet(own, "ieee1547-b", np.full(3, gain / radius), 100.0, tau=tau), own)
    S = -lure.H
    assert np.linalg.eigvalsh(S / tau + (S / tau).T)[0] < -1e-6 * np.max(S)
    certificate = reactance(lure)
    assert certificate.rate > 0
    switched_decay(lure, certificate, seed)


@settings(max_examples=40)
@given(seed=seeds, gain=st.sampled_from([0.5, 5.0, 50.0]))
def test_voltage_errors_decay_at_the_common_rate_however_singular(seed: int, gain: float) -> None:
    # Theorem 2 (b) on the buses: the seminorm e^T S e needs no slope term at all.
    _, droop, lure = random_loop(seed, gain=gain)
    rng = np.random.default_rng([seed, 11])
    n, S, tau = lure.slope.size, -lure.H, droop.tau[0]
    e = rng.normal(size=n)
    for _ in range(12):
        slopes = lure.slope * rng.choice([0.0, 1.0, 0.3], n) * (rng.random(n) < 0.7)
        h = 10.0 ** rng.uniform(-2, 0.5)
        after = expm(-h * (np.eye(n) + slopes[:, None] * S) / tau) @ e
        assert after @ S @ after <= (e @ S @ e) * np.exp(-2.0 * h / tau) * (1 + 1e-8) + 1e-15 * np.max(S)
        e = after


@given(seeds)
def test_forgeries_are_caught(seed: int) -> None:
    _, _, lure = random_loop(seed, gain=0.8)
    for certificate in (reactance(lure), small_gain(lure)):
        assert verify(certificate, lure) > 0
        assert verify(replace(certificate, rate=1.2 * certificate.rate), lure) < 0
        assert verify(replace(certificate, P=-certificate.P), lure) == -np.inf
        for claimed in (0.0, -1e6, -np.inf, np.inf, np.nan):
            assert verify(replace(certificate, rate=claimed), lure) == -np.inf
        if lure.slope.size > 1:
            with refused(DesignInfeasible, "wrong-form"):
                verify(replace(certificate, P=certificate.P[:1]), lure)
        with refused(DesignInfeasible, "wrong-form"):
            verify(replace(certificate, kind="hearsay"), lure)
    forged = reactance(lure)
    with refused(DesignInfeasible, "not-verified"):
        quadratic(lure, forged.P, forged.multiplier, -1.0, kind="reactance", status="")
    assert verify(replace(forged, multiplier=0.0 * forged.multiplier), lure) == -np.inf
    if lure.slope.size > 1:
        P = forged.P.copy()
        P[0, 1] += 1e-3 * P[0, 0]
        assert verify(replace(forged, P=P), lure) == -np.inf


@given(seed=seeds, kind=st.sampled_from(["reactance", "small-gain"]))
def test_fewer_trusted_meters_is_the_harder_claim(seed: int, kind: str) -> None:
    _, _, lure = random_loop(seed, gain=0.8, spread=2.0)
    certificate = reactance(lure) if kind == "reactance" else small_gain(lure)
    trusted = np.random.default_rng(seed).random(lure.slope.size) < 0.5
    assert verify(certificate, lure, trusted) >= certificate.margin - 1e-9
    assert verify(certificate, lure, np.zeros_like(trusted)) == certificate.margin


def test_single_inverter_in_closed_form() -> None:
    # n = 1: P = 1, Lambda = 1 / (s tau) makes b = 0, so that the rate is exactly 1 / tau.
    s, tau, slope = 0.3, 4.0, 2.0
    one = np.eye(1)
    lure = Lure(-one / tau, one / tau, -s * one, one, 0 * one, -s * one, one, np.array([slope]), np.tanh)
    certificate = quadratic(lure, one, np.array([1 / (s * tau)]), 0.9 / tau, kind="lmi", status="by hand")
    assert certificate.margin == pytest.approx(0.1)
    assert certificate.noise == pytest.approx(slope / 0.9)
    assert certificate.load == pytest.approx(np.sqrt(slope / (s * tau) / (2 * 0.9 / tau)))
    with refused(DesignInfeasible, "not-verified") as caught:
        quadratic(lure, one, np.array([1 / (s * tau)]), 1.1 / tau, kind="lmi", status="by hand")
    assert caught.value.margin == pytest.approx(-0.1)
    # Small gain: rate (1 - s slope) / tau less the back-off, gain slope / that.
    made = small_gain(lure)
    assert made.rate == pytest.approx(0.9 * 0.4 / tau)
    assert made.noise == pytest.approx(slope / (0.9 * 0.4))


def test_best_certificate_wins() -> None:
    _, _, common = random_loop(8, gain=0.5)
    assert certify(common).kind == "reactance"
    _, _, apart = random_loop(8, gain=0.2, spread=3000.0)
    assert certify(apart).kind == "small-gain"


def test_meters_without_inverter_and_inverters_without_meter() -> None:
    feeder = replace(random_feeder(8, customers=4), bus=np.array([1, 1, 2, 0]))
    droop = fleet(np.array([1, 3]), "vde4105", np.full(2, 10.0), 100.0)
    lure = close_loop(feeder, droop, np.array([0, 1, 1]))
    # Meter 0 sits at another customer of the same bus: its load error is another one.
    assert feeds(lure).tolist() == [[False, True, True], [False, False, False]]
    certificate = certify(lure)
    assert verify(certificate, lure, np.array([True, False, False])) == certificate.margin
    on = np.array([True, True, True])
    bound = error_bound(lure, on, np.array([9.0, 0.001, 0.002]), np.zeros(4))
    assert bound[0] == pytest.approx(droop.slope[0] * 0.002)
    assert bound[1] == 0.0


def test_no_inverters_at_all() -> None:
    feeder = random_feeder(6)
    none = fleet(np.array([], dtype=np.intp), [], np.zeros(0), 100.0)
    lure = close_loop(feeder, none, np.arange(len(feeder.customers)))
    certificate = certify(lure)
    assert certificate.margin > 0
    assert verify(certificate, lure) > 0
    assert verify(small_gain(lure), lure) > 0
    on = np.ones(len(feeder.customers), bool)
    assert error_bound(lure, on, 1.0 * on, 1.0 * on).shape == (0,)


def test_other_systems_are_refused() -> None:
    eye = np.eye(2)
    lure = Lure(-eye, 2 * eye, -eye, eye, 0 * eye, eye, eye, np.ones(2), np.tanh)
    for attempt in (reactance, small_gain):
        with refused(DesignInfeasible, "wrong-form"):
            attempt(lure)
    with refused(DesignInfeasible, "no-certificate"):
        certify(replace(lure, G=eye, B=eye))


@pytest.mark.canary("create_kerber_dorfnetz")
@pytest.mark.parametrize(
    "name",
    [
        "create_kerber_landnetz_freileitung_1",
        "create_kerber_landnetz_kabel_1",
        "create_kerber_dorfnetz",
        "create_kerber_vorstadtnetz_kabel_1",
    ],
)
def test_published_village_feeders(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pandapower's own, on its own data
        import pandapower.networks

        net = getattr(pandapower.networks, name)()
    from tests.gridsec.grid.test_radial import from_pandapower

    feeder, p, _, _ = from_pandapower(net, int(net.trafo.lv_bus.iloc[0]), 100.0)
    own = np.arange(p.size)
    droop = fleet(own, "ieee1547-b", np.full(p.size, 10.0), 100.0)
    lure = close_loop(feeder, droop, own)
    certificate = certify(lure)
    assert certificate.kind == "reactance"
    assert certificate.rate * droop.tau[0] > 0.98
    # The statement behind it: S T^-1 Delta Pi S is positive semidefinite for every set and slope.
    S = 2.0 * feeder.linear().X
    rng = np.random.default_rng(0)
    for _ in range(20):
        weight = droop.slope * rng.random(p.size) * (rng.random(p.size) < 0.5)
        form = S @ (weight[:, None] * S)
        assert np.linalg.eigvalsh(form + form.T)[0] >= -1e-13 * np.max(np.abs(form))
