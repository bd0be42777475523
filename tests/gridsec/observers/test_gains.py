"""The corrected inequality against the error system it stands for; margins, bounds, options."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.grid.devices import PRESETS, fleet
from gridsec.observers.gains import (
    CircleGains,
    circle_matrix,
    margin,
    negativity,
    options_for,
    refuse_blind,
    sensitivity,
    stacked,
    state_bound,
)
from gridsec.observers.lure import Lure, close_loop
from tests.codes import refused
from tests.gridsec.plants import Street, line, shared, tree
from tests.gridsec.radial import random_feeder


def arbitrary(lure: Lure, J: list[int], seed: int = 0) -> CircleGains:
    """Numbers without any meaning, for identities that hold whatever they are."""
    rng = np.random.default_rng(seed)
    n, m, k, inputs = len(lure.A), len(lure.slope), len(J), lure.F.shape[1]
    root = rng.normal(size=(n, n))
    return CircleGains(
        J=np.array(J, dtype=np.intp),
        L=rng.normal(size=(n, k)),
        K=rng.normal(size=(m, k)),
        P=root @ root.T,
        Lambda=rng.uniform(0.5, 2.0, m),
        nu=0.7,
        mu=1.3,
        mu_delta=0.4,
        alpha=0.2,
        noise=rng.uniform(0.5, 2.0, k),
        load=rng.normal(size=(inputs, inputs + 1)),
        weight=np.eye(n),
        margin=np.nan,
        sensitivity=np.zeros(k),
        backoff=0.0,
        status="made up",
    )


@pytest.mark.parametrize("street", [line(4), tree(), shared()], ids=["line", "tree", "shared"])
def test_the_matrix_is_the_dissipation_inequality_of_the_error_system(street: Street) -> None:
    """Oracle: V' along plant minus observer, both written out as in chong2020 (9) and (11)."""
    rng = np.random.default_rng(3)
    lure = replace(street.lure, B=rng.normal(size=street.lure.B.shape))
    J = [0, 2, 3]
    g = arbitrary(lure, J)
    n, m = len(lure.A), len(lure.slope)
    M = circle_matrix(lure, J, g)
    for _ in range(20):
        x, xhat, uhat = rng.normal(size=n), rng.normal(size=n), rng.normal(size=lure.F.shape[1])
        delta, noise = rng.normal(size=g.load.shape[1]), rng.normal(size=len(J))
        u = uhat + g.load @ delta
        y = lure.C @ x + lure.D @ u
        r = y[J] + g.noise * noise - lure.C[J] @ xhat - lure.D[J] @ uhat
        z, zeta = lure.H @ x + lure.F @ u, lure.H @ xhat + lure.F @ uhat + g.K @ r
        # Any pair of values of the nonlinearity will do: the identity does not need the slope bound.
        psi = rng.normal(size=m)
        e = x - xhat
        de = lure.A @ e + lure.G @ psi + lure.B @ (u - uhat) - g.L @ r
        eta = z - zeta
        left = 2.0 * e @ g.P @ de + 2.0 * g.alpha * e @ g.P @ e + g.nu * e @ g.weight @ e
        left += 2.0 * psi @ (g.Lambda * (eta - psi / lure.slope))
        left -= g.mu * noise @ noise + g.mu_delta * delta @ delta
        v = np.concatenate([e, psi, noise, delta])
        assert v @ M @ v == pytest.approx(left, rel=1e-9, abs=1e-9)


def test_leaving_a_meter_out_is_the_observer_without_its_columns() -> None:
    lure = line(4).lure
    g = arbitrary(lure, [0, 2, 3])
    zeroed = replace(g, L=np.where([True, False, True], g.L, 0.0), K=np.where([True, False, True], g.K, 0.0))
    without = circle_matrix(lure, [0, 3], g)
    full = circle_matrix(lure, [0, 2, 3], zeroed)
    dropped = 4 + 4 + 1
    keep = np.delete(np.arange(len(full)), dropped)
    np.testing.assert_allclose(without, full[np.ix_(keep, keep)], atol=1e-12)
    with refused(InputInvalid, "wrong-design"):
        circle_matrix(lure, [1], g)


def test_a_constant_nonlinearity_has_no_column() -> None:
    street = line(3)
    flat = replace(street.lure, slope=np.array([street.lure.slope[0], 0.0, street.lure.slope[2]]))
    g = arbitrary(flat, [0, 1])
    assert circle_matrix(flat, [0, 1], g).shape == (3 + 2 + 2 + 4,) * 2
    # Its gain and its multiplier are of no consequence.
    other = replace(g, K=g.K + np.array([[0.0], [5.0], [0.0]]), Lambda=g.Lambda * np.array([1.0, -3.0, 1.0]))
    np.testing.assert_array_equal(circle_matrix(flat, [0, 1], g), circle_matrix(flat, [0, 1], other))
    np.testing.assert_array_equal(sensitivity(flat, g.L, g.K), sensitivity(flat, g.L, other.K))


@given(
    st.integers(1, 6).flatmap(lambda n: arrays(np.float64, (n, n), elements=st.floats(-1, 1, width=32))),
    st.floats(-3, 3),
    st.floats(-8, 8),
)
def test_negativity_has_the_sign_of_the_largest_eigenvalue_at_any_scaling(
    root: np.ndarray, shift: float, decades: float
) -> None:
    matrix = 0.5 * (root + root.T) - shift * np.eye(len(root))
    largest = float(np.linalg.eigvalsh(matrix)[-1])
    scale = 10.0 ** np.linspace(0.0, decades, len(matrix))
    found = negativity(scale[:, None] * matrix * scale)
    if largest < -1e-9:
        assert found > 0.0
    if largest > 1e-9:
        assert found < 0.0


def test_negativity_of_what_is_no_number_or_empty() -> None:
    assert negativity(np.array([[np.nan]])) == -np.inf
    assert negativity(np.zeros((2, 2))) == -np.inf
    assert negativity(np.zeros((0, 0))) == np.inf
    tiny = np.finfo(np.float64).tiny / 10.0
    assert negativity(np.array([[-tiny, 0.5], [0.5, -tiny]])) == -np.inf
    # On the boundary there is no margin: rounding could have made it.
    assert negativity(-np.ones((3, 3))) <= 0.0


def test_the_margin_needs_every_sign() -> None:
    street = line(3)
    lure = street.lure
    g = arbitrary(lure, [0, 1])
    assert margin(lure, g.J, g) < 0.0
    for name in ("mu", "mu_delta", "nu", "alpha"):
        assert margin(lure, g.J, replace(g, **{name: 0.0})) == -np.inf
    assert margin(lure, g.J, replace(g, Lambda=np.array([1.0, -1.0, 1.0]))) == -np.inf
    assert margin(lure, g.J, replace(g, P=-g.P)) < 0.0


def test_the_state_bound_is_the_extent_of_the_ellipsoid() -> None:
    """Oracle: the largest value of c^T e over the boundary of e^T P e = level, sampled."""
    g = arbitrary(line(3).lure, [0, 1])
    level = (g.mu * 0.3**2 + g.mu_delta * 0.5**2) / (2 * g.alpha)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400_000, 3))
    points *= np.sqrt(level / np.einsum("ki,ij,kj->k", points, g.P, points))[:, None]
    rows = rng.normal(size=(4, 3))
    reached = np.abs(points @ rows.T).max(axis=0)
    bound = state_bound(g, rows, 0.3, 0.5)
    assert np.all(reached <= bound * (1 + 1e-12))
    np.testing.assert_allclose(reached, bound, rtol=2e-3)


def test_stacked_gains_act_like_single_ones() -> None:
    lure = line(4).lure
    designs = [arbitrary(lure, [0, 2], 1), arbitrary(lure, [3], 2)]
    L, K = stacked(designs, 4)
    r = np.array([1.0, -2.0, 0.5, 4.0])
    for index, one in enumerate(designs):
        np.testing.assert_allclose(L[index] @ r, one.L @ r[one.J])
        np.testing.assert_allclose(K[index] @ r, one.K @ r[one.J])


def test_sensitivity_is_relative_to_what_the_curves_can_do() -> None:
    lure = line(3).lure
    push = np.abs(lure.G) @ lure.slope
    L = np.zeros((3, 2))
    L[1, 1] = 0.25 * push[1]
    K = np.zeros((3, 2))
    K[0, 0] = -0.5
    np.testing.assert_allclose(sensitivity(lure, L, K), [0.5, 0.25])
    still = replace(lure, slope=np.zeros(3))
    np.testing.assert_allclose(sensitivity(still, L, K), [0.0, L[1, 1] / abs(lure.A[1, 1])])


def test_a_blind_design_is_refused_with_reason_and_remedy() -> None:
    with refused(DesignInfeasible, "degenerate") as caught:
        refuse_blind(np.array([0, 3]), np.array([1e-5, 0.0]))
    assert caught.value.margin is not None
    assert caught.value.margin < 0.0
    refuse_blind(np.array([0, 3]), np.array([0.0, 0.4]))


@pytest.mark.parametrize(
    ("bad", "codes"),
    [
        ({"rate": 0.0}, ("not-positive",)),
        ({"rate": np.nan}, ("not-positive",)),
        ({"noise": -1.0}, ("negative", "not-positive")),
        ({"noise": 0.0}, ("not-positive",)),
        ({"load": np.full(3, np.inf)}, ("not-finite",)),
        ({"load": np.eye(4)}, ("shape",)),
        ({"weight": np.ones((3, 2))}, ("shape",)),
        ({"floor": 1.0}, ("out-of-range",)),
        ({"floor": -0.1}, ("out-of-range",)),
    ],
)
def test_options_that_cannot_be_meant_are_refused(bad: dict[str, object], codes: tuple[str, ...]) -> None:
    good: dict[str, object] = {"rate": 0.1, "noise": 1e-3, "load": np.full(3, 1e-3)}
    with refused(InputInvalid, *codes):
        options_for(line(3).lure, **(good | bad))  # type: ignore[arg-type]


def test_short_forms_of_options() -> None:
    lure = line(3).lure
    options = options_for(lure, rate=0.1, noise=1e-3, load=np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(options.noise, [1e-3] * 3)
    np.testing.assert_array_equal(options.load, np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(options.weight, lure.H.T @ lure.H)
    with pytest.raises(ValueError, match="read-only"):
        options.noise[0] = 1.0


@given(seed=st.integers(0, 2**32 - 1), trusted=st.integers(0, 4))
def test_theorem_2_with_several_inverters_at_one_meter(seed: int, trusted: int) -> None:
    """The point that docs/theory-observers.md gives satisfies the inequality, whoever shares a connection."""
    rng = np.random.default_rng(seed)
    feeder = random_feeder(seed % 1000, customers=4)
    own, J = np.sort(rng.integers(0, 4, 7)), np.sort(rng.permutation(4)[:trusted])
    droop = fleet(own, list(rng.choice(PRESETS, 7)), rng.uniform(3.0, 10.0, 7), 100.0, tau=np.full(7, 2.5))
    lure = close_loop(feeder, droop, np.arange(4))
    tau, beta, S = 2.5, 0.7, -lure.H
    K = (own[:, None] == J).astype(np.float64)
    drives = K.any(axis=1)
    steepest, k = float(lure.slope.max()), float(K.sum(axis=0).max(initial=0.0))
    P = S + beta / steepest * np.eye(7)
    high = 2.0 * steepest * np.linalg.norm(P, 2) / (tau * beta)
    noise, load = rng.uniform(0.001, 0.02, J.size), rng.uniform(0.0, 0.01, (4, 3))
    gains = CircleGains(
        J=J,
        L=np.zeros((7, J.size)),
        K=K,
        P=P,
        Lambda=np.where(drives, high, 1.0 / tau),
        nu=beta * beta / steepest / (2.0 * tau),
        mu=max(k, 1.0) * high * steepest * float(np.max(noise, initial=1e-3)) ** 2,
        mu_delta=max(steepest * np.linalg.norm(lure.F @ load, 2) ** 2 / tau, 1e-12),
        alpha=(1.0 - beta) / tau,
        noise=noise,
        load=load,
        weight=np.eye(7),
        margin=np.nan,
        sensitivity=np.zeros(J.size),
        backoff=0.0,
        status="docs/theory-observers.md, section 4",
    )
    matrix = circle_matrix(lure, J, gains)
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(matrix)))
    assert np.linalg.eigvalsh(scale[:, None] * matrix * scale)[-1] <= 1e-9
