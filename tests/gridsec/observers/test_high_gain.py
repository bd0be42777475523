"""Constants, decomposition and steps of gridsec.observers.high_gain, against scipy and closed forms."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given as hypothesis_given
from hypothesis import settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov

from gridsec.errors import NotObservable
from gridsec.observers.high_gain import Partial, Polynomial, System, affine, defects, linear
from gridsec.observers.high_gain.constants import (
    Slopes,
    decay_componentwise,
    decay_kim,
    decay_lee,
    gain,
    margin,
    riccati,
    settling,
    smallest_theta,
)
from gridsec.observers.high_gain.form import at, jacobian_at, largest, sat, slopes
from gridsec.observers.high_gain.observer import advance, field, gains, transition
from tests.codes import refused
from tests.gridsec.observers.bent import bent, oscillator, oscillator_input


def shift(n: int) -> np.ndarray:
    return np.eye(n, k=1)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("theta", [1.0, 7.5, 32.0])
def test_riccati_and_gain_solve_the_lyapunov_equation(n: int, theta: float) -> None:
    C = np.eye(1, n)
    dense = solve_continuous_lyapunov((shift(n) + 0.5 * theta * np.eye(n)).T, C.T @ C)
    closed = riccati(n, theta)
    assert np.allclose(closed, dense, rtol=1e-7, atol=0.0)
    assert np.all(np.linalg.eigvalsh(riccati(n, 1.0)) > 0.0)
    K = gain(n, theta)
    assert np.allclose(closed @ K, C[0], rtol=1e-9, atol=1e-9 * np.abs(closed).max() * np.abs(K).max())
    # The characteristic polynomial of A - K C is (s + theta)^n.
    wanted = np.poly(np.full(n, -theta))
    assert np.allclose(np.concatenate([[1.0], K]), wanted, rtol=1e-12)


def test_constants_of_order_two_by_hand() -> None:
    low, high = (3.0 - np.sqrt(5.0)) / 2.0, (3.0 + np.sqrt(5.0)) / 2.0
    made = decay_kim(2, 32.0, 1e-6)
    assert made.eta == pytest.approx(32.0 * np.sqrt(4.0 * high / low), rel=1e-12)
    assert made.epsilon == pytest.approx(32.0 * 4.0 * np.sqrt(2.0) * 1e-6 / low, rel=1e-12)
    assert made.rate == 4.0
    # sqrt(high / low) = high because high * low = 1.
    assert decay_lee(2, 16.0, 0.0, printed=True).eta == pytest.approx(16.0 * high, rel=1e-12)
    assert decay_lee(2, 16.0, 0.0).eta == pytest.approx(16.0 * high * np.sqrt(2.0), rel=1e-12)
    ours = decay_componentwise(2, 32.0, 1e-6)
    start = 1.0 + 2.0 / 32.0 + 2.0 / 32.0**2
    assert ours.eta == pytest.approx(32.0 * np.sqrt(2.0 * start), rel=1e-12)
    assert ours.epsilon == pytest.approx(32.0 * 2.0 * 1e-6, rel=1e-12)
    assert ours.bound(4.0, 0.0) == pytest.approx(4.0 * ours.eta)
    assert ours.bound(4.0, 100.0) == ours.epsilon


@settings(max_examples=15, deadline=None)
@hypothesis_given(n=st.integers(1, 3), theta=st.floats(4.0, 40.0), seed=st.integers(0, 10_000))
def test_errors_stay_below_all_proven_bounds(n: int, theta: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    reach = np.tril(rng.uniform(0.0, 1.5, (n, n)))
    ranges = Slopes(-reach, reach, proven=True)
    if margin(ranges, theta) <= 0.0:
        theta = 1.01 * smallest_theta(ranges)
    noise, start = 1e-2, rng.choice([-1.0, 1.0], n)
    K, pieces = gain(n, theta), 12
    D, v = rng.uniform(-1.0, 1.0, (pieces, n, n)) * reach, noise * rng.choice([-1.0, 1.0], pieces)
    ends = np.linspace(0.0, 24.0 / theta, pieces + 1)
    limits = [decay_kim(n, theta, noise), decay_componentwise(n, theta, noise)]
    e = start.copy()
    for k in range(pieces):
        M = shift(n) - np.outer(K, np.eye(n)[0]) + D[k]
        path = solve_ivp(
            lambda _, e, M=M, k=k: M @ e + K * v[k],
            (ends[k], ends[k + 1]),
            e,
            rtol=1e-9,
            atol=1e-12,
            max_step=0.2 / theta,
        )
        sizes = np.abs(path.y).max(axis=0)
        for limit in limits:
            assert np.all(sizes <= limit.bound(1.0, path.t) * (1.0 + 1e-6))
        e = path.y[:, -1]


@settings(max_examples=10, deadline=None)
@hypothesis_given(n=st.integers(1, 3), theta=st.floats(8.0, 40.0), seed=st.integers(0, 10_000))
def test_without_noise_errors_fall_at_the_rate_of_the_dissertation(n: int, theta: float, seed: int) -> None:
    """lee2018, Lemma 5.2.1 with the factor sqrt(n): eta e^(-theta t / 4); as fast as one likes."""
    rng = np.random.default_rng(seed)
    reach = np.tril(rng.uniform(0.0, 0.5, (n, n)))
    assert margin(Slopes(-reach, reach, proven=True), theta) > 0.0
    D, start = rng.uniform(-1.0, 1.0, (n, n)) * reach, rng.choice([-1.0, 1.0], n)
    M = shift(n) - np.outer(gain(n, theta), np.eye(n)[0]) + D
    limit = decay_lee(n, theta, 0.0)
    for t in np.linspace(0.0, 24.0 / theta, 60):
        assert np.abs(expm(M * t) @ start).max() <= limit.bound(1.0, t) * (1.0 + 1e-9)
    reached = [float(decay_lee(n, high, 0.0).bound(1.0, 0.3)) for high in (100.0, 200.0, 400.0)]
    assert reached[0] > 10.0 * reached[1] > 100.0 * reached[2]


def test_margin_is_the_worst_case_over_the_ranges() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 5):
        low = np.tril(rng.uniform(-2.0, 0.0, (n, n)))
        high = np.tril(rng.uniform(0.0, 1.0, (n, n)))
        theta = 20.0
        claimed = margin(Slopes(low, high, proven=True), theta)
        base, power = riccati(n, 1.0), theta ** (np.arange(n)[None, :] - np.arange(n)[:, None]).astype(float)
        found = np.inf
        for _ in range(2000):
            D = np.where(rng.uniform(size=(n, n)) < 0.5, low, high) * power
            values = np.linalg.eigvals(np.linalg.solve(base, base @ D + D.T @ base)).real
            found = min(found, 0.5 * theta - values.max())
        assert claimed <= found + 1e-8
        if n < 5:  # corners are all tried there; five states fall back to a norm bound
            assert claimed == pytest.approx(found, abs=0.2)


def test_smallest_theta_separates_good_from_bad() -> None:
    ranges = Slopes(np.array([[0.0, 0.0], [-2.0, -3.0]]), np.zeros((2, 2)), proven=True)
    least = smallest_theta(ranges)
    assert margin(ranges, least) > 0.0
    assert margin(ranges, 0.99 * least) <= 0.0
    assert smallest_theta(Slopes(np.zeros((1, 1)), np.zeros((1, 1)), proven=True)) == 1.0
    # A derivative above the diagonal, which is no uniformly observable system, has no theta at all.
    bad = Slopes(np.array([[0.0, -3.0], [0.0, 0.0]]), np.array([[0.0, 3.0], [0.0, 0.0]]), proven=True)
    assert smallest_theta(bad) == np.inf


@pytest.mark.canary("0", "2", "4")
@pytest.mark.parametrize("seed", range(6))
def test_the_inequality_holds_at_every_theta_above_the_smallest(seed: int) -> None:
    """Also where a range leaves zero out: the eigenvalues at corners and random slopes, on a fine grid."""
    rng = np.random.default_rng(seed)
    n = 2 + seed % 2
    low = np.tril(rng.uniform(-3.0, 1.0, (n, n)))
    ranges = Slopes(low, low + np.tril(rng.uniform(0.0, 3.0, (n, n))), proven=True)
    least, base = smallest_theta(ranges), riccati(n, 1.0)
    assert 1.0 <= least < np.inf
    for theta in np.concatenate([np.linspace(least, 3.0 * least, 41), np.geomspace(3.0 * least, 1e5, 20)]):
        assert margin(ranges, float(theta)) > 0.0
        for part in (*rng.uniform(size=(10, n, n)), *rng.integers(0, 2, (10, n, n))):
            D = np.tril(ranges.low + part * (ranges.high - ranges.low))
            D = D * theta ** np.subtract.outer(-np.arange(n), -np.arange(n)).astype(float)
            form = 0.5 * theta * base - base @ D - D.T @ base
            assert np.linalg.eigvalsh(form)[0] > -1e-12 * theta


def test_the_smallest_theta_is_sufficient_and_not_necessary() -> None:
    """kim2018's example at theta = 3.5, below 4.0: (6) without noise holds for all slopes in range.

    V' <= -(theta / 2 + margin) V, and kim2018's rate theta / 8 needs V' <= -(theta / 4) V only.
    """
    ranges = Slopes(np.array([[0.0, 0.0], [-2.0, -3.0]]), np.zeros((2, 2)), proven=True)
    theta = 3.5
    assert theta < smallest_theta(ranges)
    assert -theta / 4.0 <= margin(ranges, theta) < 0.0
    rng, bound = np.random.default_rng(0), decay_kim(2, theta, 0.0)
    step = 0.1
    for _ in range(200):
        e, t = rng.choice([-1.0, 1.0], 2), 0.0
        for _ in range(60):
            D = np.array([[0.0, 0.0], [rng.choice([-2.0, 0.0]), rng.choice([-3.0, 0.0])]])
            e = expm(step * (shift(2) - np.outer(gain(2, theta), [1.0, 0.0]) + D)) @ e
            t += step
            assert np.abs(e).max() <= float(bound.bound(np.array(1.0), np.array(t)))


def test_settling_times_meet_18_with_equality() -> None:
    made, size = decay_kim(3, 12.0, 1e-5), 1.7
    first, second = settling(made, size)
    start = 2.0 * size * made.eta
    assert (max(start, made.epsilon) + 2.0 * size) * made.eta * np.exp(-1.5 * first) == pytest.approx(
        made.epsilon
    )
    assert start * np.exp(-1.5 * second) == pytest.approx(made.epsilon)


def test_sat_removes_what_is_not_finite() -> None:
    assert np.array_equal(sat(np.array([np.nan, np.inf, -np.inf, 0.5]), 2.0), [0.0, 2.0, -2.0, 0.5])


def test_polynomials_and_their_derivatives() -> None:
    p = Polynomial(np.array([[2, 1], [0, 3], [0, 0]]), np.array([2.0, -1.0, 5.0]))
    z = np.random.default_rng(0).normal(size=(2, 50))
    assert np.allclose(p(list(z)), 2.0 * z[0] ** 2 * z[1] - z[1] ** 3 + 5.0)
    assert np.allclose(p.derivative(0)(list(z)), 4.0 * z[0] * z[1])
    assert np.allclose(p.derivative(1)(list(z)), 2.0 * z[0] ** 2 - 3.0 * z[1] ** 2)
    assert p.derivative(0).derivative(0).derivative(0)([1.0, 1.0]) == 0.0


@settings(max_examples=25, deadline=None)
@hypothesis_given(seed=st.integers(0, 10_000))
def test_linear_systems_always_decompose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # A block-triangular A gives sensors that see only a part.
    A, B = rng.integers(-2, 3, (3, 3)).astype(float), rng.normal(size=(3, 2))
    A[0, 1:] *= seed % 2
    C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    made = linear(A, B, C, 1.0)
    for row, part in zip(C, made.partials, strict=True):
        stack = np.array([row @ np.linalg.matrix_power(A, k) for k in range(3)])
        assert part.size == np.linalg.matrix_rank(stack)
    points = rng.uniform(-1.0, 1.0, (40, 3))
    off = defects(
        made,
        lambda x: list(A @ np.array(x)),
        lambda x: [[value + 0.0 * x[0] for value in row] for row in B.tolist()],
        lambda x: list(C @ np.array(x)),
        points,
    )
    assert np.all(off < 1e-6)
    z = np.abs(made.phi(points))
    assert all(z[:, made.pick([i])].max() <= made.z_bound[i] + 1e-12 for i in range(2))


def test_sensors_without_a_row_are_refused() -> None:
    with refused(NotObservable, "zero-output"):
        linear(np.eye(2), np.ones((2, 1)), np.array([[1.0, 0.0], [0.0, 0.0]]), 1.0)
    with refused(NotObservable, "too-few-meters"):
        System(np.ones(2), ())


def test_defects_find_a_wrong_decomposition() -> None:
    right = bent()
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 2))
    read = lambda x: [x[0]] * 3  # noqa: E731
    assert np.all(defects(right, oscillator, oscillator_input, read, points) < 1e-8)
    wrong = replace(right.partials[0], alpha=affine(0.0, [-1.0, -1.0]))
    pair = System(right.x_bound, (right.partials[0], wrong))
    off = defects(
        pair,
        oscillator,
        oscillator_input,
        lambda x: [x[0]] * 2,
        points,
    )
    assert off[0] < 1e-8
    assert off[1] > 0.1
    turned = replace(right.partials[0], beta=((affine(1.0, [0.0, 0.0]),), (affine(0.0, [0.0, 0.0]),)))
    assert (
        defects(System(right.x_bound, (turned,)), oscillator, oscillator_input, lambda x: [x[0]], points)[0]
        > 0.5
    )


def test_slopes_are_proven_for_polynomials_and_say_so() -> None:
    first = bent().partials[0]
    known = slopes(first, np.array([-1.0]), np.array([2.0]))
    assert known.proven
    # -1 + 0.6 z1 on |z1| <= 1, with zero for the saturated arguments.
    assert known.low[1, 0] == pytest.approx(-1.6)
    assert known.high[1, 0] == 0.0
    assert known.low[1, 1] == pytest.approx(-1.0)
    hidden = replace(first, alpha=lambda z: -z[0] - z[1] + 0.3 * z[0] ** 2)
    seen = slopes(hidden, np.array([-1.0]), np.array([2.0]))
    assert not seen.proven
    assert np.all(seen.low <= known.low + 1e-3)
    assert np.all(seen.low >= 1.2 * known.low - 1e-3)


def test_stack_project_and_bound() -> None:
    model = linear(
        np.diag([-1.0, -2.0]), np.ones((2, 1)), np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), 1.0
    )
    assert [part.size for part in model.partials] == [1, 2, 1]
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (20, 2))
    whole = model.phi(x)
    for chosen in ([0], [0, 2], [1, 2], [0, 1, 2]):
        assert np.array_equal(whole[:, model.pick(chosen)], model.phi(x, chosen))
    step = 1e-6
    for k in range(2):
        shifted = x + step * np.eye(2)[k]
        assert np.allclose((model.phi(shifted) - whole) / step, model.jacobian(x)[..., k], atol=1e-8)
    assert jacobian_at(model.rows([1]), x).shape == (20, 2, 2)
    assert largest(lambda z: [z[0] ** 2 - z[1], z[0]], np.array([1.0, 0.5])) == pytest.approx(1.5, rel=2e-3)


def mixed() -> System:
    """Two different sizes, nonlinear, two inputs."""
    one = Partial(
        phi=lambda x: [x[0], x[1]],
        jacobian=lambda _: [[1.0, 0.0], [0.0, 1.0]],
        alpha=Polynomial(np.array([[1, 0], [1, 1]]), np.array([-1.0, -0.5])),
        beta=(
            (affine(0.3, [0.2, 0.0]), affine(0.0, [0.0, 0.0])),
            (affine(0.0, [0.0, 0.4]), affine(1.0, [0.0, 0.0])),
        ),
        bound=1.5,
    )
    two = Partial(
        phi=lambda x: [x[1]],
        jacobian=lambda _: [[0.0, 1.0]],
        alpha=Polynomial(np.array([[3]]), np.array([-0.2])),
        beta=((affine(0.1, [1.0]), affine(0.0, [0.5])),),
        bound=0.8,
    )
    return System(np.array([1.0, 1.0]), (one, two))


def looped(model: System) -> System:
    """The same system with its polynomials hidden, so that nothing can be stacked."""

    def hide(function: Any) -> Any:
        # A partial application is no Polynomial any more.
        return partial(function)

    parts = [
        replace(p, alpha=hide(p.alpha), beta=tuple(tuple(hide(e) for e in row) for row in p.beta))
        for p in model.partials
    ]
    return System(model.x_bound, tuple(parts))


def test_stacked_and_looped_right_hand_sides_agree() -> None:
    model = mixed()
    rng = np.random.default_rng(3)
    stacked, one_by_one = field(model), field(looped(model))
    for _ in range(20):
        z, u = np.where(model.mask, rng.normal(scale=2.0, size=(2, 2)), 0.0), rng.normal(size=2)
        assert np.allclose(stacked(z, u), one_by_one(z, u), rtol=1e-12, atol=1e-12)
        assert stacked(z, u)[1, 1] == 0.0


def test_transition_solves_linear_forcing_exactly() -> None:
    model = linear(np.diag([-1.0, -2.0]), np.ones((2, 1)), np.array([[1.0, 1.0], [0.0, 1.0]]), 1.0)
    K = gains(model, np.array([20.0, 3.0]))
    for h in (1e-6, 0.02, 0.7):
        move = transition(model, K, h)
        g0, g1, z0 = np.array([0.3, -0.2]), np.array([-1.0, 0.5]), np.array([1.0, 2.0])
        M = shift(2) - np.outer(K[0], [1.0, 0.0])
        path = solve_ivp(
            lambda t, z, M=M, h=h, a=g0, b=g1: M @ z + a + (b - a) * t / h,
            (0.0, h),
            z0,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        )
        ours = move.whole[0] @ z0 + move.held[0] @ g0 + move.slope[0] @ (g1 - g0)
        assert np.allclose(ours, path.y[:, -1], rtol=1e-9, atol=1e-10)


def test_steps_converge_to_the_differential_equation_with_order_two() -> None:
    model = mixed()
    K = gains(model, np.array([8.0, 5.0]))
    right = field(model)

    def signal(t: float) -> tuple[np.ndarray, np.ndarray]:
        return np.array([0.5 * t, 0.2 - 0.3 * t]), np.array([t, 1.0 - t])

    def rate(t: float, flat: np.ndarray) -> np.ndarray:
        z, (y, u) = flat.reshape(2, 2), signal(t)
        ahead = np.column_stack([z[:, 1], np.zeros(2)]) * np.array([[1.0, 0.0], [0.0, 0.0]])
        return (ahead + right(z, u) + K * (y - z[:, 0])[:, None]).ravel()

    start = np.array([[0.9, -0.7], [0.6, 0.0]])
    exact = solve_ivp(rate, (0.0, 1.0), start.ravel(), rtol=1e-12, atol=1e-13).y[:, -1].reshape(2, 2)
    errors = []
    for count in (20, 40, 80):
        move, z = transition(model, K, 1.0 / count), start
        for k in range(count):
            (y0, u0), (y1, u1) = signal(k / count), signal((k + 1) / count)
            z = advance(right, K, move, z, y=(y0, y1), u=(u0, u1))
        errors.append(np.abs(z - exact).max())
    assert errors[-1] < 1e-4
    assert errors[0] / errors[1] > 3.4
    assert errors[1] / errors[2] > 3.4


def test_values_over_components_broadcast_constants() -> None:
    assert at(lambda x: [1.0, x[0]], np.ones((4, 1))).shape == (4, 2)
