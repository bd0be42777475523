"""Gaussian noise: estimates, false alarms and hypotheses, with the degrees of freedom corrected."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.linalg import sqrtm
from scipy.stats import chi2, kstest

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.secure.decode import Stack, error_detectable
from gridsec.secure.decode.gaussian import choose, design_hypotheses, design_test, detect, residual_covariance
from tests.codes import refused


def covariance(rng: np.random.Generator, N: int) -> Floats:
    """Correlated noise of unequal sizes."""
    root = rng.standard_normal((N, N)) / np.sqrt(N) + np.diag(10.0 ** rng.uniform(-0.5, 0.5, N))
    return root @ root.T


def case(seed: int, p: int = 5, n: int = 3, height: int = 3) -> tuple[np.random.Generator, Stack, Floats]:
    rng = np.random.default_rng(seed)
    stack = Stack.of(rng.standard_normal((p, height, n)))
    return rng, stack, covariance(rng, p * height)


def draws(rng: np.random.Generator, stack: Stack, P: Floats, count: int) -> tuple[Floats, Floats]:
    x = rng.standard_normal((count, stack.unknowns))
    v = rng.standard_normal((count, len(P))) @ np.linalg.cholesky(P).T
    return x, x @ stack.matrix.T + v


@pytest.mark.parametrize("false_alarm", [0.01, 0.05, 0.2])
def test_false_alarm_rate_over_a_hundred_thousand_draws(false_alarm: float) -> None:
    """lee2018, Algorithm 2.2: within 10 % of the rate asked for; with the printed freedom far below it."""
    rng, stack, P = case(1)
    test = design_test(stack, P)
    _, z = draws(rng, stack, P, 100_000)
    got = detect(test, z, false_alarm=false_alarm)
    assert abs(float(got.alarm.mean()) - false_alarm) < 0.1 * false_alarm
    printed = float(chi2.isf(false_alarm, len(P)))
    assert float(np.mean(got.g > printed)) < 0.65 * false_alarm
    if false_alarm == 0.05:
        assert float(np.mean(got.g > printed)) < 0.45 * false_alarm


def test_attacks_pass_with_the_printed_freedom() -> None:
    """The same attack and the same requested rate: the printed threshold misses a good part of them."""
    rng, stack, P = case(2, p=4, n=3, height=1)
    test = design_test(stack, P)
    assert test.freedom == 1
    _, z = draws(rng, stack, P, 20_000)
    e = np.zeros(4)
    e[0] = 4.0 / np.linalg.norm(test.standardise[:, 0])
    g = detect(test, z + e, false_alarm=0.01).g
    assert np.mean(g > chi2.isf(0.01, 1)) > 0.9
    assert np.mean(g > chi2.isf(0.01, 4)) < 0.7


def test_the_statistic_is_chi_square_with_rows_minus_unknowns() -> None:
    rng, stack, P = case(3)
    test = design_test(stack, P)
    assert test.freedom == 15 - 3
    _, z = draws(rng, stack, P, 20_000)
    g = detect(test, z, false_alarm=0.5).g
    assert kstest(g, chi2(12).cdf).pvalue > 1e-3
    assert kstest(g, chi2(15).cdf).pvalue < 1e-12


def test_the_covariance_of_the_residual_is_singular_and_g_is_the_same_three_ways() -> None:
    """lee2018 (2.2.20): g = r^T Sigma^+ r = r^T P^-1 r; an inverse square root of Sigma does not exist."""
    rng, stack, P = case(4)
    Sigma = residual_covariance(stack, P)
    values = np.linalg.eigvalsh(Sigma)
    assert np.sum(values > 1e-10 * values[-1]) == 15 - 3
    test = design_test(stack, P)
    _, z = draws(rng, stack, P, 200)
    r = z - z @ (stack.matrix @ test.estimator).T
    g = detect(test, z, false_alarm=0.1).g
    root = np.real(sqrtm(np.linalg.pinv(Sigma, rcond=1e-10)))
    zeta = r @ root.T
    assert np.allclose(np.sum(zeta**2, axis=1), g)
    assert np.allclose(np.einsum("ij,jk,ik->i", r, np.linalg.inv(P), r), g)
    sample = np.cov((r @ np.linalg.pinv(Sigma) @ Sigma).T)
    assert np.linalg.matrix_rank(sample, tol=1e-8) == 12


def test_mean_and_covariance_of_the_residual_under_attack() -> None:
    """lee2018, Theorem 2.2.18, including attacks that hide: zero mean if and only if e = Phi x_e."""
    rng, stack, P = case(5)
    test = design_test(stack, P)
    N = len(P)
    project = np.eye(N) - stack.matrix @ test.estimator
    e = np.zeros(N)
    e[stack.rows([1])] = rng.standard_normal(3) * 3.0
    x, z = draws(rng, stack, P, 60_000)
    r = (z + e) @ project.T
    spread = np.sqrt(np.diagonal(P))
    assert np.all(np.abs(r.mean(axis=0) - project @ e) < 5.0 * spread / np.sqrt(60_000))
    assert np.allclose(np.cov(r.T), residual_covariance(stack, P), atol=0.05 * np.abs(P).max())
    assert np.allclose(residual_covariance(stack, P), project @ P, atol=1e-12)
    assert np.linalg.norm(project @ e) > 0.1, "one sensor cannot hide (Theorem 2.2.19)"
    hiding = stack.matrix @ rng.standard_normal(3)
    assert np.allclose(project @ hiding, 0.0, atol=1e-12)
    assert np.allclose(
        detect(test, z + hiding, false_alarm=0.1).g, detect(test, z, false_alarm=0.1).g, atol=1e-8
    )
    error = z @ test.estimator.T - x
    assert np.allclose(np.cov(error.T), test.covariance, atol=0.05 * test.covariance.max())


def test_no_sparse_error_leaves_the_mean_of_the_residual_at_zero() -> None:
    """lee2018, Theorem 2.2.19: every error in the fewest blocks that could hide one less is seen."""
    rng, stack, P = case(10, p=5, n=3, height=1)
    test = design_test(stack, P)
    project = np.eye(5) - stack.matrix @ test.estimator
    assert error_detectable(stack, 2, tol=1e-9)
    assert not error_detectable(stack, 3, tol=1e-9)
    for bad in itertools.combinations(range(5), 2):
        # No combination of the two errors cancels: the columns are independent.
        assert np.linalg.matrix_rank(project[:, bad], tol=1e-6) == 2
    for bad in itertools.combinations(range(5), 3):
        assert np.linalg.matrix_rank(project[:, bad], tol=1e-9) == 2
    x, z = draws(rng, stack, P, 60_000)
    error = z @ test.estimator.T - x
    limit = 5.0 * np.sqrt(np.diagonal(test.covariance) / 60_000)
    assert np.all(np.abs(error.mean(axis=0)) < limit), "without an error E[x_hat] = x"
    assert np.allclose(test.estimator @ stack.matrix, np.eye(3))


def test_minimum_variance_equals_weighted_least_squares_and_beats_others() -> None:
    """lee2018, Lemmas 2.2.16 and 2.2.17; the first holds among unbiased estimators only (errata)."""
    rng, stack, P = case(6)
    test = design_test(stack, P)
    weight = np.linalg.inv(P)
    closed = np.linalg.solve(stack.matrix.T @ weight @ stack.matrix, stack.matrix.T @ weight)
    assert np.allclose(test.estimator, closed)
    assert np.allclose(test.covariance, np.linalg.inv(stack.matrix.T @ weight @ stack.matrix))
    z = rng.standard_normal(15)
    best = test.estimator @ z

    def cost(x: Floats) -> float:
        return float((z - stack.matrix @ x) @ weight @ (z - stack.matrix @ x))

    for _ in range(50):
        assert cost(best + 1e-3 * rng.standard_normal(3)) > cost(best)
        # Any other unbiased linear estimator: Psi + M F with F an annihilator.
        other = test.estimator + rng.standard_normal((3, 15)) @ (
            np.eye(15) - stack.matrix @ np.linalg.pinv(stack.matrix)
        )
        assert np.linalg.eigvalsh(other @ P @ other.T - test.covariance)[0] > -1e-9
    # The printed "any type of estimator" includes the constant zero, whose covariance is zero.
    assert not np.linalg.eigvalsh(np.zeros((3, 3)) - test.covariance)[0] >= 0.0


def plain_g(stack: Stack, P: Floats, kept: tuple[int, ...], z: Floats) -> tuple[float, Floats]:
    """Steps 2 to 5 of Algorithm 2.3 for one set, with the pseudo-inverse."""
    rows = stack.rows(kept)
    phi, cov = stack.matrix[rows], P[np.ix_(rows, rows)]
    weight = np.linalg.inv(cov)
    gain = np.linalg.solve(phi.T @ weight @ phi, phi.T @ weight)
    x = gain @ z[rows]
    r = z[rows] - phi @ x
    Sigma = cov - phi @ np.linalg.inv(phi.T @ weight @ phi) @ phi.T
    return float(r @ np.linalg.pinv(Sigma, rcond=1e-10) @ r), x


@pytest.mark.parametrize("seed", range(4))
def test_hypotheses_equal_the_algorithm_written_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stack = Stack.of([rng.standard_normal((h, 2)) for h in (2, 1, 3, 2, 2, 1)])
    P = covariance(rng, 11)
    both = design_hypotheses(stack, P, 2)
    _, z = draws(rng, stack, P, 5)
    for rule in ("density", "tail"):
        got = choose(both, z, rule=rule)
        for i, one in enumerate(z):
            plain = [plain_g(stack, P, kept, one) for kept in itertools.combinations(range(6), 4)]
            g = np.array([value for value, _ in plain])
            assert np.allclose(got.g[i], g)
            freedom = [stack.rows(kept).size - 2 for kept in itertools.combinations(range(6), 4)]
            score = chi2.pdf(g, freedom) if rule == "density" else chi2.sf(g, freedom)
            best = int(np.argmax(score))
            assert got.hypothesis[i] == best
            assert np.allclose(got.x[i], plain[best][1])


def test_the_tail_rule_is_maximum_likelihood_of_the_data() -> None:
    """Maximise the Gaussian density of z over x and over e on the distrusted sensors: least g wins."""
    rng, stack, P = case(7, p=5, n=2, height=2)
    both = design_hypotheses(stack, P, 1)
    _, z = draws(rng, stack, P, 20)
    got = choose(both, z, rule="tail")
    weight = np.linalg.inv(P)
    for i, one in enumerate(z):
        peaks = []
        for bad in range(4, -1, -1):
            free = np.hstack([stack.matrix, np.eye(10)[:, stack.rows([bad])]])
            fit = np.linalg.solve(free.T @ weight @ free, free.T @ weight @ one)
            r = one - free @ fit
            peaks.append(-0.5 * float(r @ weight @ r))
        assert np.allclose(-0.5 * got.g[i], peaks)
        assert got.hypothesis[i] == int(np.argmax(peaks))


def hits(seed: int, size: float, p: int, height: int) -> dict[str, float]:
    """How often each rule names exactly the manipulated sensor."""
    rng, stack, P = case(seed, p=p, n=3, height=height)
    both = design_hypotheses(stack, P, 1)
    _, z = draws(rng, stack, P, 4000)
    bad = rng.integers(0, p, 4000)
    attack = rng.standard_normal((4000, p * height))
    attack *= (bad[:, None] == np.arange(p)) @ stack.membership.T
    attack *= size / np.sqrt(np.einsum("ij,jk,ik->i", attack, np.linalg.inv(P), attack))[:, None]
    named = p - 1 - bad
    right = {r: choose(both, z + attack, rule=r).hypothesis == named for r in ("density", "tail")}
    doubled = choose(both, z + attack, rule="density", freedom=both.freedom + 3)
    right["printed"] = doubled.hypothesis == named
    return {name: float(np.mean(values)) for name, values in right.items()}


def test_hypothesis_testing_finds_the_manipulated_sensor() -> None:
    """lee2018, Algorithm 2.3. The printed degrees of freedom put the density's peak in the wrong place."""
    large = hits(8, size=100.0, p=5, height=3)
    assert min(large.values()) > 0.98
    medium = hits(8, size=8.0, p=5, height=3)
    assert medium["tail"] > medium["density"] > medium["printed"]


def test_the_density_rule_mistrusts_small_residuals() -> None:
    """lee2018, Remark 2.2.3: of two sets it may take the one that fits worse."""
    stack = Stack.of(np.random.default_rng(9).standard_normal((4, 3, 2)))
    both = design_hypotheses(stack, np.eye(12), 1)
    tiny = np.zeros(12)
    tiny[stack.rows([0])] = 1.2
    z = stack.matrix @ np.ones(2) + tiny
    g = choose(both, z, rule="tail").g
    assert choose(both, z, rule="tail").hypothesis == 3 == int(np.argmin(g))
    assert g[3] < 1e-12
    assert choose(both, z, rule="density").hypothesis != 3


def test_refusals() -> None:
    rng = np.random.default_rng(0)
    stack = Stack.of_rows(rng.standard_normal((4, 3)))
    with refused(NotObservable, "no-redundancy"):
        design_hypotheses(stack, np.eye(4), 1)
    with refused(NotObservable, "not-observable"):
        design_test(stack, np.eye(4), np.array([0, 1]))
    with refused(DesignInfeasible, "not-definite"):
        design_test(stack, np.zeros((4, 4)))
    with refused(NotObservable, "no-redundancy"):
        design_test(stack, np.eye(4), np.arange(3))
    square = Stack.of_rows(rng.standard_normal((3, 3)))
    assert np.allclose(residual_covariance(square, np.eye(3)), 0.0, atol=1e-9)
    for rate in (0.0, 1.0, 2.0, -1.0, np.nan):
        with refused(InputInvalid, "out-of-range"):
            detect(design_test(stack, np.eye(4)), np.zeros(4), false_alarm=rate)


def test_measurements_that_are_not_finite_alarm() -> None:
    test = design_test(Stack.of_rows(np.ones((3, 1))), np.eye(3))
    z = np.array([[np.nan, 1.0, 1.0], [1.0, np.inf, 1.0], [1.0, 1.0, 1.0]])
    with np.errstate(invalid="ignore"):
        assert detect(test, z, false_alarm=0.01).alarm.tolist() == [True, True, False]
