"""Designs by the corrected inequality: proofs recomputed, and the guarantees seen in trajectories."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.observers.certificates import feeds, verify
from gridsec.observers.gains import CircleGains, CircleOptions, circle_matrix, margin, options_for
from gridsec.observers.lmi import circle, contraction, prove, settle, solve_many
from gridsec.observers.lure import Lure
from tests.codes import refused
from tests.gridsec.plants import Street, line, shared, street, tree

RATE = 0.25
NOISE = 2e-4


def design(of: Street, J: list[int], **more: object) -> CircleGains:
    asked: dict[str, object] = {"rate": RATE, "noise": NOISE, "load": of.load}
    return circle(of.lure, J, **(asked | more))  # type: ignore[arg-type]


def scalar(d: float = 0.3, tau: float = 2.0, loop: float = 0.5) -> Lure:
    """One inverter, one meter: x' = (-x + K(z)) / tau, z = -(loop / d) x + w."""
    one = np.ones((1, 1))
    return Lure(
        A=-one / tau,
        G=one / tau,
        H=-loop / d * one,
        F=one,
        B=0 * one,
        C=-loop / d * one,
        D=one,
        slope=np.array([d]),
        phi=lambda z: np.asarray(np.clip(d * z, -0.1, 0.1)),
    )


def independent_margin(lure: Lure, g: CircleGains) -> float:
    """Smallest pivot of a Cholesky factorisation of the negated, equilibrated matrix (no eigenvalues)."""
    M = -circle_matrix(lure, g.J, g)
    scale = 1.0 / np.sqrt(np.diagonal(M))
    return float(np.min(np.diagonal(np.linalg.cholesky(scale[:, None] * M * scale))))


def test_the_inequality_holds_for_every_subset_of_both_banks() -> None:
    """chong2020, Proposition 1: N = 6, M = 2, all sets of N - M and of N - 2M meters."""
    of = line(6)
    subsets = [c for size in (4, 2) for c in itertools.combinations(range(6), size)]
    seen: list[tuple[int, int]] = []
    options = options_for(of.lure, rate=RATE, noise=NOISE, load=of.load)
    designs = solve_many(of.lure, subsets, options, workers=1, progress=lambda *a: seen.append(a))
    assert len(designs) == 15 + 15
    for subset, g in zip(subsets, designs, strict=True):
        assert tuple(g.J) == subset
        assert g.alpha >= RATE * 0.95
        assert margin(of.lure, g.J, g) == g.margin > 0.0
        assert independent_margin(of.lure, g) > 0.0
        raw = circle_matrix(of.lure, g.J, g)
        eigenvalues = np.linalg.eigvalsh(raw)
        assert eigenvalues[-1] <= 1e-13 * abs(eigenvalues[0])
        assert np.linalg.eigvalsh(g.P)[0] > 0.0
        assert g.sensitivity.min() > 1e-3, "every meter of every set is listened to"
    assert seen[-1] == (30, 30)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


Signal = Callable[[float], Floats]


def simulate(
    lure: Lure,
    g: CircleGains,
    start: tuple[Floats, Floats],
    signals: tuple[Signal, Signal, Signal],
    times: Floats,
) -> tuple[Floats, Floats]:
    """Plant and observer side by side by solve_ivp: the oracle for every claim about the error."""
    u_hat, u_error, y_error = signals
    n = len(lure.A)

    def field(t: float, both: Floats) -> Floats:
        x, xhat = both[:n], both[n:]
        u, uh = u_hat(t) + u_error(t), u_hat(t)
        y = lure.C @ x + lure.D @ u + y_error(t)
        r = y[g.J] - lure.C[g.J] @ xhat - lure.D[g.J] @ uh
        dx = lure.A @ x + lure.G @ lure.phi(lure.H @ x + lure.F @ u) + lure.B @ u
        zeta = lure.H @ xhat + lure.F @ uh + g.K @ r
        dxhat = lure.A @ xhat + lure.G @ lure.phi(zeta) + lure.B @ uh + g.L @ r
        return np.concatenate([dx, dxhat])

    run = solve_ivp(
        field, (times[0], times[-1]), np.concatenate(start), t_eval=times, rtol=1e-8, atol=1e-12, max_step=0.1
    )
    assert run.success
    return run.y[:n].T, run.y[n:].T


def at_work(of: Street) -> Signal:
    """A known input that keeps the curves outside their deadbands most of the time."""
    inputs = of.lure.F.shape[1]
    phase = np.linspace(0.0, 3.0, inputs)
    return lambda t: 0.06 * np.sin(0.7 * t + phase)


def constant(values: Floats) -> Signal:
    return lambda _: values


def nothing(size: int) -> Signal:
    return constant(np.zeros(size))


PLANTS = {"line": line(5), "tree": tree(), "shared": shared()}


@pytest.mark.canary("J1-line")
@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("J", [[0, 1, 2, 3], [1, 3], [2]])
def test_the_error_decays_at_least_at_the_certified_rate(name: str, J: list[int]) -> None:
    of = PLANTS[name]
    g = design(of, J, rate=0.6 / 2.4)
    rng = np.random.default_rng(len(J))
    n, p, inputs = len(of.lure.A), len(of.meters), of.lure.F.shape[1]
    times = np.linspace(0.0, 12.0, 61)
    for _ in range(3):
        start = (rng.uniform(-0.1, 0.1, n), rng.uniform(-0.1, 0.1, n))
        x, xhat = simulate(of.lure, g, start, (at_work(of), nothing(inputs), nothing(p)), times)
        e = x - xhat
        norm = np.sqrt(np.einsum("ti,ij,tj->t", e, g.P, e))
        assert np.all(norm <= norm[0] * np.exp(-g.alpha * times) * (1 + 1e-6) + 1e-9 * norm[0])


@pytest.mark.canary("shared")
@pytest.mark.parametrize("name", PLANTS)
def test_the_error_bound_holds_under_attack_noise_and_wrong_loads(name: str) -> None:
    """V(t) <= exp(-2 alpha t) V(0) + (mu sup |n + a|^2 + mu_delta sup |delta|^2) / (2 alpha)."""
    of = PLANTS[name]
    J = [0, 1, 3]
    g = design(of, J)
    rng = np.random.default_rng(5)
    n, p = len(of.lure.A), len(of.meters)
    times = np.linspace(0.0, 20.0, 81)
    direction = rng.normal(size=(4, g.load.shape[1]))
    # A drift without limit, a square wave, a step; every sign of delta that noise can give them.
    attacks: list[Signal] = [
        lambda t: 0.01 * t * np.ones(p),
        lambda t: 0.05 * np.sign(np.sin(t)) * np.ones(p),
        lambda t: np.where(np.arange(p) == 1, -0.1, 0.0) * (t > 3.0),
        nothing(p),
    ]
    for attack, d in zip(attacks, direction, strict=True):

        def wrong(t: float, d: Floats = d) -> Floats:
            return g.load @ (d * np.cos(0.3 * t))

        start = (rng.uniform(-0.05, 0.05, n), np.zeros(n))
        x, xhat = simulate(of.lure, g, start, (at_work(of), wrong, attack), times)
        e = x - xhat
        V = np.einsum("ti,ij,tj->t", e, g.P, e)
        size_n = np.array([np.linalg.norm(attack(t)[g.J] / g.noise) for t in times])
        size_d = np.array([np.linalg.norm(d * np.cos(0.3 * t)) for t in times])
        level = (
            g.mu * np.maximum.accumulate(size_n) ** 2 + g.mu_delta * np.maximum.accumulate(size_d) ** 2
        ) / (2 * g.alpha)
        bound = np.exp(-2 * g.alpha * times) * V[0] + level
        assert np.all(bound * (1 + 1e-6) + 1e-12 >= V)


def test_attacks_are_visible_in_the_estimate() -> None:
    """A lie of 3 % moves the settled estimate of z, whichever trusted meter tells it."""
    of = line(5)
    J = [0, 1, 2, 3]
    g = design(of, J)
    n, inputs = 5, 5
    times = np.linspace(0.0, 30.0, 4)
    start = (np.zeros(n), np.zeros(n))
    # The voltage is low everywhere, so that no curve rests in its deadband.
    low = constant(np.full(inputs, 0.09))
    x, honest = simulate(of.lure, g, start, (low, nothing(inputs), nothing(5)), times)
    assert np.abs(x[-1] - honest[-1]).max() < 1e-8
    noisy = [
        simulate(of.lure, g, start, (low, nothing(inputs), constant(3.0 * NOISE * signs)), times)[1]
        for signs in [np.ones(5), *(2.0 * np.eye(5)[:4] - 1.0)]
    ]
    honest_spread = max(np.abs(of.lure.H @ (one[-1] - honest[-1])).max() for one in noisy)
    for liar in J:
        lie = np.zeros(5)
        lie[liar] = -0.06
        _, fooled = simulate(of.lure, g, start, (low, nothing(inputs), constant(lie)), times)
        moved = np.abs(of.lure.H @ (fooled[-1] - honest[-1])).max()
        assert moved > 5.0 * honest_spread


def test_with_precise_meters_the_optimum_is_direct_injection() -> None:
    """THE design against loads and noise: K near E_J, L near 0."""
    for of in (line(6), line(4, tau=(1.0, 3.0), seed=4)):
        count = len(of.meters)
        for load in (of.load, np.diag(of.load_size)):
            g = design(of, list(range(count)), noise=1e-5, load=load, rate=0.1)
            np.testing.assert_allclose(g.K, np.eye(count), atol=2e-3)
            assert np.abs(g.L).max() < 1e-2 * np.max(of.lure.G @ of.lure.slope)


def test_the_gain_falls_with_the_noise_until_the_design_is_blind() -> None:
    of = line(5)
    gains = [float(np.sum(design(of, [0, 2, 4], noise=s).sensitivity)) for s in (1e-5, 5e-4, 1e-3)]
    assert gains[0] > gains[1] > gains[2] > 0.0
    for noise in (0.1, 1e3, 1e8):
        with refused(DesignInfeasible, "degenerate"):
            design(of, [0, 2, 4], noise=noise)


def test_minimising_the_attack_gain_alone_is_refused_with_an_explanation() -> None:
    of = line(5)
    with refused(DesignInfeasible, "degenerate"):
        design(of, [0, 1, 2], load=np.zeros((5, 5)))


def test_a_demanded_gain_is_kept_where_noise_would_make_the_design_blind() -> None:
    of = line(4)
    g = design(of, [0, 1, 3], noise=0.1, floor=0.5)
    own = feeds(of.lure)[:, g.J]
    assert np.all(g.K[own] >= 0.5 - 1e-6)
    assert g.margin > 0.0


@given(st.floats(0.05, 0.9), st.floats(0.5, 10.0), st.floats(0.05, 3.0), st.floats(0.05, 0.9))
@settings(max_examples=12)
def test_the_noise_gain_of_direct_injection_has_a_closed_form(
    d: float, tau: float, loop: float, part: float
) -> None:
    """One inverter, L = 0, K = 1: the smallest mu of the inequality is (d s_n / (1 - alpha tau))^2 nu."""
    lure = scalar(d, tau, loop)
    alpha, noise = part / tau, 0.01
    options = options_for(lure, rate=alpha, noise=noise, load=np.array([1e-4]), weight=np.eye(1))
    g = prove(lure, [0], np.zeros((1, 1)), np.ones((1, 1)), options)
    assert g.margin > 0.0
    np.testing.assert_array_equal(g.K, [[1.0]])
    assert g.mu == pytest.approx((d * noise / (1.0 - part)) ** 2, rel=0.02)


@given(st.integers(0, 10_000), st.integers(2, 7), st.sampled_from([0.3, 0.9]))
@settings(max_examples=25)
def test_the_reactance_matrix_proves_direct_injection_for_every_set(
    seed: int, count: int, part: float
) -> None:
    """P = S + eps I, L = 0, K = E_J, Lambda = 1 / tau off J and large on it: no solver anywhere."""
    rng = np.random.default_rng(seed)
    of = street(
        parent=[int(rng.integers(0, k + 1)) for k in range(count)],
        bus=[int(b) for b in rng.integers(0, count + 1, count)],
        inverters=list(range(count)),
        meters=list(range(count)),
        seed=seed,
        kva=float(rng.uniform(5.0, 200.0)),
    )
    lure, tau = of.lure, 2.0
    S, d = -lure.H, float(np.max(lure.slope))
    J = np.flatnonzero(rng.random(count) < 0.5)
    if len(J) == 0:
        J = np.array([0])
    off = ~np.isin(np.arange(count), J)
    # The constants of the proof, each a little better than it asks for.
    eps = 0.9 * (1.0 - part) / d
    P = S + eps * np.eye(count)
    norm = float(np.linalg.norm(P, 2))
    large = 1.1 * 2.0 * d * norm / (tau * (1.0 - part))
    Lambda = np.where(off, 1.0 / tau, large)
    g = CircleGains(
        J=J,
        L=np.zeros((count, len(J))),
        K=np.eye(count)[:, J],
        P=P,
        Lambda=Lambda,
        nu=0.9 * eps * (1.0 - part) / (2.0 * tau),
        mu=1.1 * large * d,
        mu_delta=1.1 * d / tau,
        alpha=part / tau,
        noise=np.ones(len(J)),
        load=np.eye(count),
        weight=np.eye(count),
        margin=np.nan,
        sensitivity=np.ones(len(J)),
        backoff=0.0,
        status="closed form",
    )
    assert margin(lure, J, g) > 0.0


def test_the_inequality_as_printed_certifies_a_false_bound() -> None:
    """chong2020 (12) lacks the attack's way through K: with L = 0, K = 1 it would promise gain zero."""
    d, tau, loop = 0.3, 2.0, 0.5
    lure = scalar(d, tau, loop)
    P, nu, mu = 1.0, 1e-3, 1e-9
    # (12) with its third column read as -P L, the only reading that fits the dimensions; Lambda = 1.
    # The plant's slope bound in chong2020's form, where phi carries 1 / tau, is d / tau.
    H = C = float(lure.H[0, 0])
    L, K = 0.0, 1.0
    printed = np.array(
        [
            [2 * P * (-1 / tau - L * C) + nu, P + (H - K * C), -P * L],
            [P + (H - K * C), -2 * tau / d, 0.0],
            [-P * L, 0.0, -mu],
        ]
    )
    assert np.linalg.eigvalsh(printed)[-1] < 0.0
    # What it promises: V' <= -nu e^2 + mu a^2, so that e stays below sqrt(mu / nu) |a|.
    attack = 0.2
    promised = np.sqrt(mu / nu) * attack
    g = replace(prove_direct(lure), K=np.array([[K]]), L=np.array([[L]]))
    signals = (nothing(1), nothing(1), constant(np.full(1, attack)))
    x, xhat = simulate(lure, g, (np.zeros(1), np.zeros(1)), signals, np.linspace(0.0, 40.0, 5))
    error = abs(float(x[-1, 0] - xhat[-1, 0]))
    assert error > 100.0 * promised
    # The corrected inequality knows better: no mu below (d / (1 - alpha tau))^2 nu fits.
    level = g.mu * (attack / g.noise[0]) ** 2 / (2 * g.alpha)
    assert error <= np.sqrt(level / g.P[0, 0])
    assert margin(lure, g.J, replace(g, mu=0.5 * g.mu)) < 0.0


def test_the_inequality_as_printed_ignores_the_size_of_the_injection() -> None:
    """Its third column taken literally, -P (which fits where J is everything): L does not matter in it."""
    d, tau, loop, P = 0.3, 2.0, 0.5, 1.0
    lure = scalar(d, tau, loop)
    H = C = float(lure.H[0, 0])
    L, K = 1000.0 / C, (H + P) / C
    nu, mu = 1000.0, 1.1e-3
    printed = np.array(
        [
            [2 * P * (-1 / tau - L * C) + nu, P + (H - K * C), -P],
            [P + (H - K * C), -2 * tau / d, 0.0],
            [-P, 0.0, -mu],
        ]
    )
    assert np.linalg.eigvalsh(printed)[-1] < 0.0
    attack = 0.05
    g = replace(prove_direct(lure), K=np.array([[K]]), L=np.array([[L]]))
    signals = (nothing(1), nothing(1), constant(np.full(1, attack)))
    x, xhat = simulate(lure, g, (np.zeros(1), np.zeros(1)), signals, np.linspace(0.0, 4.0, 5))
    assert abs(float(x[-1, 0] - xhat[-1, 0])) > 100.0 * np.sqrt(mu / nu) * attack


@pytest.mark.parametrize("ratio", [0.5, 0.8])
def test_noise_below_the_load_error_gives_one_and_above_it_zero(ratio: float) -> None:
    """A loop too weak to matter: the cost is ((1 - kappa) s_d + kappa s_n)^2, so kappa is 1 or 0."""
    lure = scalar(loop=1e-3)
    size = 1e-2
    g = circle(lure, [0], rate=0.1, noise=ratio * size, load=np.array([size]), weight=np.eye(1))
    np.testing.assert_allclose(g.K, 1.0, atol=1e-2)
    with refused(DesignInfeasible, "degenerate"):
        circle(lure, [0], rate=0.1, noise=size / ratio, load=np.array([size]), weight=np.eye(1))


def prove_direct(lure: Lure) -> CircleGains:
    options = options_for(lure, rate=0.2, noise=0.01, load=np.array([1e-4]), weight=np.eye(1))
    return prove(lure, [0], np.zeros((1, 1)), np.ones((1, 1)), options)


def test_given_gains_are_proven_as_they_are_or_not_at_all() -> None:
    of = tree()
    J = [0, 2, 4]
    options = options_for(of.lure, rate=0.1, noise=NOISE, load=of.load)
    K = feeds(of.lure)[:, J].astype(float)
    g = prove(of.lure, J, np.zeros((5, 3)), K, options)
    np.testing.assert_array_equal(g.K, K)
    np.testing.assert_array_equal(g.L, 0.0)
    assert margin(of.lure, g.J, g) > 0.0
    # Positive feedback of the reading into the state: no certificate can exist.
    with refused(DesignInfeasible, "no-solution"):
        prove(of.lure, J, -1e3 * of.lure.C[J].T, K, options)


@given(st.integers(0, 10_000))
@settings(max_examples=15)
def test_the_contraction_certificate_holds_for_every_set_and_every_slope(seed: int) -> None:
    """Oracle: the Lyapunov inequality of the linear error system, for drawn sets and slopes."""
    rng = np.random.default_rng(seed)
    of = line(4, tau=(0.5, 3.0), seed=seed % 50, kva=300.0)
    taps = np.exp(rng.normal(0.0, 0.6, 4))
    lure = replace(of.lure, H=of.lure.H * taps, C=of.lure.C * taps)
    rate = 0.1 * float(np.min(np.diagonal(lure.G)))
    proof = contraction(lure, rate=rate)
    assert proof.kind == "lmi"
    assert verify(proof, lure) == pytest.approx(proof.margin)
    assert proof.margin > 0.0
    for _ in range(40):
        slopes = lure.slope * rng.choice([0.0, 1.0, rng.random()], 4)
        free = rng.random(4) < 0.7
        drift = lure.A + lure.G @ (np.diag(slopes * free) @ lure.H)
        decay = proof.P @ drift + drift.T @ proof.P + 2.0 * rate * proof.P
        assert np.linalg.eigvalsh(decay)[-1] <= 1e-12 * np.abs(decay).max()


def test_a_contraction_rate_that_no_inverter_has_is_refused() -> None:
    with refused(DesignInfeasible, "no-solution"):
        contraction(line(4).lure, rate=0.6)


def test_a_rate_that_no_inverter_has_is_refused() -> None:
    with refused(DesignInfeasible, "no-solution"):
        design(line(4), [0, 1], rate=0.6)


def test_without_a_trusted_meter_there_is_nothing_to_design() -> None:
    with refused(DesignInfeasible, "nothing-to-design"):
        design(line(3), [])


def test_a_weight_of_zero_is_refused() -> None:
    with refused(DesignInfeasible, "nothing-to-design"):
        design(line(3), [0, 1], weight=np.zeros((3, 3)))


def test_a_small_violation_is_repaired_and_a_large_one_refused() -> None:
    of = line(5)
    g = design(of, [0, 1, 3])
    assert g.backoff == 0.0
    shaved = replace(g, mu=g.mu * 0.995, mu_delta=g.mu_delta * 0.995)
    assert margin(of.lure, g.J, shaved) < 0.0
    repaired = settle(of.lure, shaved, "test")
    assert 0.0 < repaired.backoff <= 0.05
    assert repaired.alpha == pytest.approx(g.alpha * (1 - repaired.backoff))
    assert repaired.mu == pytest.approx(shaved.mu * (1 + repaired.backoff))
    assert repaired.margin == margin(of.lure, g.J, repaired) > 0.0
    np.testing.assert_array_equal(repaired.K, g.K)
    with refused(DesignInfeasible, "not-verified") as caught:
        settle(of.lure, replace(g, mu=g.mu * 0.5), "test")
    assert caught.value.margin is not None
    assert caught.value.margin < 0.0


def test_the_base_power_does_not_matter() -> None:
    """Injections scale with 1 / base, squared voltages and their gains K not at all."""
    one, other = (design(line(5, base_kva=base), [0, 2, 4], noise=1e-4) for base in (100.0, 1e5))
    np.testing.assert_allclose(one.K, other.K, atol=1e-3)
    np.testing.assert_allclose(one.L, other.L * 1e3, atol=1e-2 * np.abs(one.L).max())
    assert other.margin > 0.0
    assert one.mu == pytest.approx(other.mu, rel=1e-3)


def test_a_flat_curve_is_left_out() -> None:
    """An inverter of rating zero: nothing to inject, nothing to prove, no division by zero."""
    of = line(4)
    slope = of.lure.slope.copy()
    slope[2] = 0.0
    flat = replace(of.lure, slope=slope)
    g = circle(flat, [0, 2, 3], rate=RATE, noise=NOISE, load=of.load)
    assert g.margin > 0.0
    assert g.Lambda[2] == 0.0
    np.testing.assert_array_equal(g.K[2], 0.0)


def test_without_any_curve_there_is_nothing_to_hear() -> None:
    of = line(3)
    with refused(DesignInfeasible, "degenerate"):
        circle(replace(of.lure, slope=np.zeros(3)), [0, 1], rate=RATE, noise=NOISE, load=of.load)


@pytest.mark.acceptance
def test_several_processes_find_what_one_finds() -> None:
    of = line(4)
    subsets = [c for size in (3, 2) for c in itertools.combinations(range(4), size)]
    options = options_for(of.lure, rate=RATE, noise=NOISE, load=of.load)
    # A curve that cannot be pickled: the workers must not need it.
    bare = replace(of.lure, phi=lambda z: z)
    seen: list[tuple[int, int]] = []
    many = solve_many(bare, subsets, options, workers=2, progress=lambda *a: seen.append(a))
    single = solve_many(of.lure, subsets, options, workers=1)
    assert seen[-1] == (10, 10)
    for a, b in zip(many, single, strict=True):
        np.testing.assert_array_equal(a.J, b.J)
        np.testing.assert_allclose(a.K, b.K, atol=1e-6)
        assert a.margin > 0.0


def test_a_failure_in_a_worker_arrives_with_its_name() -> None:
    of = line(4)
    options = CircleOptions(rate=0.6, noise=np.full(4, NOISE), load=of.load, weight=np.eye(4), floor=0.0)
    subsets = [(0, 1, 2), (1, 2, 3), (0, 1), (1, 2)]
    for workers in (1, 2):
        with refused(DesignInfeasible, "no-solution"):
            solve_many(of.lure, subsets, options, workers=workers)
