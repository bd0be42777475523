"""lee2018, chapter 4: the three-inertia example, and its errata, each shown by a counterexample."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from gridsec.errors import NotObservable
from gridsec.observers import kalman, luenberger
from gridsec.observers.luenberger import Bounds
from gridsec.papers import lee2018
from gridsec.secure.decode import Stack, error_correctable, partial_bounded, partial_gaussian
from gridsec.secure.decode.noise import correct
from gridsec.secure.index import asymptotic_index
from tests.codes import refused

PLANT = lee2018.plant()


@pytest.mark.acceptance
def test_every_claim_of_chapter_4_comes_out_or_has_its_reason() -> None:
    found = lee2018.chapter4()
    assert all(claim.met or claim.why for claim in found.claims)
    assert sorted(claim.where for claim in found.unmet) == ["(4.5.1)", "Remark 4.4.2"]
    by_name = {claim.what: claim for claim in found.claims}
    assert by_name["redundancy of (A, C)"].met
    assert by_name["dynamic security index"].ours == 3.0
    assert by_name["asymptotic security index"].ours == 3.0
    assert by_name["sensor attacked from 2 s on"].ours == "1"
    assert float(by_name["|x_hat - x| over kappa^c v_max(k), largest over all k"].ours) < 1.0
    titles = [panel.title for panel in found.figures[0].panels]
    assert [title.split(":")[0] for title in titles] == [f"Figure 4.{k}" for k in (9, 10, 11, 12)]
    assert all(np.all(np.isfinite(line.y)) for f in found.figures for p in f.panels for line in p.lines)


def test_sampled_plant_is_the_mechanics_over_one_step() -> None:
    J, b, k = 0.01, 0.007, 1.37
    rng = np.random.default_rng(0)
    x, torque, push = rng.standard_normal(6), 0.3, rng.standard_normal(6)

    def wheels(_: float, s: np.ndarray) -> np.ndarray:
        angle, speed = s[::2], s[1::2]
        left, right = k * (angle[1] - angle[0]), k * (angle[2] - angle[1])
        force = np.array([left + torque, right - left, -right]) - b * speed
        return np.column_stack([speed, force / J]).ravel() + push

    exact = solve_ivp(wheels, (0.0, 1e-3), x, rtol=1e-12, atol=1e-14).y[:, -1]
    ours = PLANT.A @ x + PLANT.B[:, 0] * torque + PLANT.E @ push
    assert np.allclose(ours, exact, rtol=0.0, atol=1e-10)


def test_index_three_by_brute_force_over_sensors() -> None:
    """The rigid turn is the only unstable mode; it must be seen without any two sensors, not any three."""
    values, vectors = np.linalg.eig(PLANT.A_c)
    unstable = vectors[:, np.abs(values) < 1e-9]
    assert unstable.shape[1] == 1
    for lost in (2, 3):
        left = [
            np.linalg.norm(np.delete(PLANT.C, gone, axis=0) @ unstable)
            for gone in combinations(range(5), lost)
        ]
        assert (min(left) > 0.1) == (lost == 2)
    made = lee2018.estimator(PLANT)
    assert np.array_equal(np.diff(made.observers.stack.first), [6, 6, 6, 5, 5])
    plain = lee2018.estimator(PLANT, slowest=0.0)
    assert np.array_equal(np.diff(plain.observers.stack.first), [6, 4, 6, 4, 4])
    assert error_correctable(Stack.of(made.observers.stack.blocks), 1, tol=1e-6)
    assert not error_correctable(Stack.of(made.observers.stack.blocks), 2, tol=1e-6)


@pytest.mark.canary("0.0")
@pytest.mark.parametrize("slowest", [lee2018.SLOWEST, 0.0])
def test_bound_holds_for_both_decompositions_and_several_seeds(slowest: float) -> None:
    made = lee2018.estimator(PLANT, slowest=slowest)
    for seed in (2, 3):
        run = lee2018.simulate(PLANT, made, seconds=2.6, seed=seed)
        error = np.linalg.norm(run.x_hat - run.x, axis=1)
        assert np.all(error <= run.bound)
        assert not np.any(run.disagree[run.t < 1.9995])
        assert np.all(run.disagree[run.t > 2.1, 0])
        assert not np.any(run.disagree[:, 1:])


def test_loop_over_an_observer_of_all_sensors_misses_its_reference() -> None:
    made = lee2018.estimator(PLANT)
    fooled = lee2018.simulate(PLANT, made, seconds=6.0, feedback="conventional")
    late = fooled.t > 5.0
    assert np.abs(fooled.x[late, 4] - 1.0).max() > 0.1
    honest = lee2018.simulate(PLANT, made, seconds=6.0, feedback="conventional", attacked=False)
    assert np.abs(honest.x[late, 4] - 1.0).max() < 0.01


def test_erratum_printed_output_matrix_has_a_row_too_many() -> None:
    rows = lee2018.ROWS_PRINTED
    assert rows.shape == (6, 6)
    assert np.array_equal(rows[1], rows[2])
    assert asymptotic_index(PLANT.A, rows, discrete=True, tol=1e-9).count == 4
    # With it two attacked sensors still could not be corrected, but three would be seen.
    assert asymptotic_index(PLANT.A, PLANT.C, discrete=True, tol=1e-9).count == 3


def test_remark_integral_gain_is_that_of_a_sum() -> None:
    slowest = np.max(np.abs(np.linalg.eigvals(lee2018.closed_loop(PLANT))))
    assert -1e-3 / np.log(slowest) < 0.4
    # As an integral, K_I T_s sum, the loop needs more than ten minutes.
    loop = np.block(
        [
            [PLANT.A + PLANT.B @ lee2018.FEEDBACK, PLANT.B * lee2018.INTEGRAL],
            [-1e-3 * PLANT.C[[2]], np.eye(1)],
        ]
    )
    assert -1e-3 / np.log(np.max(np.abs(np.linalg.eigvals(loop)))) > 600.0


def test_remark_disturbance_bound_of_the_sampled_state_would_make_the_guarantee_empty() -> None:
    held = lee2018.estimator(PLANT)
    sampled = lee2018.estimator(lee2018.plant("sampled"))
    limits = [d.constants.kappa_c * max(e.limit for e in d.observers.envelopes) for d in (held, sampled)]
    assert limits[0] < 0.5
    assert limits[1] > 10.0


def deadbeat(
    p: int, q: int, a: float = 1.0, noise: float = 1.0, left_out: int | None = None
) -> partial_bounded.BoundedDesign:
    """p sensors of one scalar state x+ = a x; every observer repeats the last reading, times a."""
    bounds = Bounds(0.0, np.full(p, noise), np.eye(1))
    # The basis of a part may be -1: the gain in its coordinates follows it.
    parts = luenberger.decompose(np.array([[a]]), np.ones((p, 1)), slowest=0.0, tol=1e-9)
    observers = luenberger.design(
        np.array([[a]]),
        np.zeros((1, 1)),
        np.ones((p, 1)),
        bounds,
        slowest=0.0,
        tol=1e-9,
        gains=[np.array([a / part.t[0]]) for part in parts],
    )
    return partial_bounded.design(observers, q, tol=1e-9, left_out=left_out)


def test_dedicated_observers_decide_by_majority_and_two_of_them_cannot() -> None:
    """Section 4.4.1: every sensor observes everything, and r = p - 1."""
    made = deadbeat(3, 1, noise=0.01, left_out=2)
    for liar in range(3):
        state, _ = partial_bounded.init(made, 0.0, np.array([2.0]), 0.0)
        y = np.array([2.005, 2.0, 1.995])
        y[liar] = -40.0
        _, out = partial_bounded.step(made, state, y, np.zeros(1))
        assert np.flatnonzero(out.disagree).tolist() == [liar]
        assert abs(out.x[0] - 2.0) <= out.bound < 0.05
    with refused(NotObservable, "not-observable"):
        deadbeat(2, 1)


def test_algorithm_4_1_compares_with_theta_v_max() -> None:
    """Five sensors of one constant, theta = 2, noise at most 1: a residual of 1.92 passes, 2.08 does not."""
    made = deadbeat(5, 2)
    for last, faults in ((2.4, 0), (2.6, 1)):
        state, _ = partial_bounded.init(made, 0.0, np.zeros(1), 0.0)
        _, out = partial_bounded.step(made, state, np.array([0.0, 0.0, 0.0, 0.0, last]), np.zeros(1))
        assert np.allclose(out.limits, 2.0)
        assert np.isclose(out.residuals[4], 0.8 * last)
        assert out.faults == faults
        assert not out.searched


class Printed:
    """Algorithm 4.1 to the letter: the estimate of the step before is tested, another one is given out."""

    def __init__(self, made: partial_bounded.BoundedDesign, z: np.ndarray) -> None:
        self.made, self.stacked = made, made.decoder.stack
        self.x = np.linalg.pinv(self.stacked.matrix) @ z
        self.faults = 0

    def step(self, z: np.ndarray, v_max: float) -> np.ndarray:
        limit = self.made.constants.theta * v_max
        on = self.stacked.norms(z - self.stacked.matrix @ self.x) <= limit
        self.faults = int(np.count_nonzero(~on))
        if self.faults <= self.made.decoder.max_attacked:
            rows = self.stacked.rows(np.flatnonzero(on))
            self.x = np.linalg.pinv(self.stacked.matrix[rows]) @ z[rows]
        else:
            self.x = correct(self.made.decoder, self.made.constants, z, v_max=v_max).x
        return self.x


def test_erratum_printed_algorithm_4_1_exceeds_its_bound() -> None:
    made = deadbeat(5, 2)
    signs = made.observers.stack.phi[:, 0]
    theta, kappa = made.constants.theta, made.constants.kappa_c
    assert np.isclose(theta, 2.0)
    assert np.isclose(kappa, 3.0)
    # The state is 0, noise at most 1. First the two liars make the mean 1 + theta, then they pull on.
    first = np.array([1.0, 1.0, 1.0, 0.0, 0.0])
    reach = theta * (1.0 - 1e-9)
    first[3:] = 0.5 * (5.0 * (1.0 + reach) - 3.0)
    second = np.array([1.0, -1.0, -1.0, 1.0 + 2.0 * reach, 1.0 + 2.0 * reach])
    printed = Printed(made, signs * first)
    given = printed.step(signs * second, 1.0)
    assert printed.faults == 2
    assert abs(given[0]) > kappa * 1.2
    assert np.isclose(abs(given[0]), 1.0 + 4.0 * theta / 3.0)
    # Ours, from the same readings.
    state, _ = partial_bounded.init(made, 0.0, np.zeros(1), 0.0)
    state, _ = partial_bounded.step(made, state, first, np.zeros(1))
    _, out = partial_bounded.step(made, state, second, np.zeros(1))
    assert np.isclose(out.bound, kappa)
    assert np.linalg.norm(out.x) <= out.bound


def test_erratum_printed_test_compares_with_a_state_that_has_moved_on() -> None:
    made = deadbeat(3, 1, a=1.5, noise=0.01)
    signs, x = made.observers.stack.phi[:, 0], 1.0
    state, _ = partial_bounded.init(made, 0.0, np.array([x]), 0.0)
    printed = Printed(made, signs * x)
    searches, ours = 0, 0
    for _ in range(10):
        state, out = partial_bounded.step(made, state, np.full(3, x), np.zeros(1))
        x *= 1.5
        printed.step(state.observers.z, float(np.max(luenberger.bound(made.observers, state.observers))))
        searches += printed.faults > 1
        ours += out.searched
        assert out.faults == 0
        assert np.isclose(out.x[0], x)
    # Nobody is attacked; the printed test suspects everybody, at every step.
    assert searches == 10
    assert ours == 0


def test_erratum_joint_covariance_of_the_example_is_singular() -> None:
    made = lee2018.gaussian_estimator(PLANT)
    P = kalman.steady(made.filters).P
    sizes = np.sqrt(np.diagonal(P))
    values = np.linalg.eigvalsh(P / np.outer(sizes, sizes))
    assert abs(values[0]) < 1e-12
    assert values[1] > 1e-6
    # Sensors 4 and 5 are both blind to the common speed and predict it with the same error.
    blocks = [made.filters.stack.rows(i) for i in (3, 4)]
    last = [at.stop - 1 for at in blocks]
    speed = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0]) / np.sqrt(3.0)
    for row in last:
        assert np.isclose(abs(made.filters.stack.phi[row] @ speed), 1.0)
    together = P[np.ix_(last, last)]
    assert np.isclose(abs(together[0, 1]), together[0, 0], rtol=1e-9)
    # At the start it is worse: 28 estimates, one initial error of rank 6.
    start = kalman.init(made.filters, 0.0, np.zeros(6), np.eye(6))
    assert np.linalg.matrix_rank(start.P) == 6
    assert len(start.P) == 28


def test_erratum_degrees_of_freedom_on_the_example() -> None:
    made = lee2018.gaussian_estimator(PLANT)
    P = kalman.steady(made.filters).P
    fused = partial_gaussian.fuse(made.sets[0], P, tol=1e-10)
    # 28 rows, 6 unknowns, one exact parity: not 28.
    assert fused.freedom == 21
    rng = np.random.default_rng(0)
    values, axes = np.linalg.eigh(P)
    draws = rng.standard_normal((100_000, 28)) @ (axes * np.sqrt(np.maximum(values, 0.0))).T
    g = np.sum((draws @ fused.standardise.T) ** 2, axis=1)
    delta = 0.05
    ours = np.mean(g > chi2.isf(delta, 21))
    printed = np.mean(g > chi2.isf(delta, 28))
    assert abs(ours - delta) < 0.1 * delta
    assert printed < 0.2 * delta
    assert np.isclose(printed, chi2.sf(chi2.isf(delta, 28), 21), rtol=0.2)


def test_erratum_densities_of_different_degrees_of_freedom_are_not_comparable() -> None:
    """Without any attack, the printed rule prefers sets with few rows; by tails every set is as good."""
    made = lee2018.gaussian_estimator(PLANT)
    P = kalman.steady(made.filters).P
    fused = [partial_gaussian.fuse(prepared, P, tol=1e-10) for prepared in made.sets[1:]]
    freedom = np.array([f.freedom for f in fused])
    assert sorted(set(freedom.tolist())) == [15, 17]
    rng = np.random.default_rng(1)
    values, axes = np.linalg.eigh(P)
    draws = rng.standard_normal((20_000, 28)) @ (axes * np.sqrt(np.maximum(values, 0.0))).T
    g = np.stack([np.sum((draws @ f.standardise.T) ** 2, axis=1) for f in fused], axis=1)
    # At the mean of g itself: a set of 15 is preferred to a set of 17 that fits exactly as well.
    assert chi2.pdf(15, 15) > chi2.pdf(17, 17)
    small = freedom == 15
    density = np.mean(small[np.argmax(chi2.logpdf(g, freedom), axis=1)])
    tail = np.mean(small[np.argmax(chi2.logsf(g, freedom), axis=1)])
    # Three of the five sets have 15.
    assert density > 0.8
    assert abs(tail - 0.6) < 0.06


def test_erratum_printed_algorithm_4_2_gives_out_the_attacked_estimate_when_it_alarms() -> None:
    made = lee2018.gaussian_estimator(PLANT)
    rng = np.random.default_rng(2)
    noise = np.sqrt(made.filters.noise[0, 0])
    x, u = np.zeros(6), np.zeros(1)
    state, _ = partial_gaussian.init(
        made, 0.0, x, 1e-6 * np.eye(6), PLANT.C @ x + noise * rng.standard_normal(5)
    )
    for _ in range(200):
        x = PLANT.A @ x
        state, out = partial_gaussian.step(made, state, PLANT.C @ x + noise * rng.standard_normal(5), u)
        assert not out.alarm
    lie = np.array([3.0, 0.0, 0.0, 0.0, 0.0])
    x = PLANT.A @ x
    before = state.current
    state, out = partial_gaussian.step(made, state, PLANT.C @ x + noise * rng.standard_normal(5) + lie, u)
    assert out.alarm
    assert np.array_equal(np.flatnonzero(~out.trusted), [0])
    # Line 2 of the printed algorithm: Psi of the old set on the attacked estimates.
    printed = partial_gaussian.fuse(made.sets[before], state.filters.P, tol=1e-10).estimator @ state.filters.z
    assert np.linalg.norm(printed - x) > 5.0 * np.linalg.norm(out.x - x)
    error = out.x - x
    assert error @ np.linalg.solve(out.covariance, error) < chi2.isf(1e-6, 6)


def test_time_varying_filters_are_consistent_on_the_example() -> None:
    """NEES of the fused estimate over independent runs, with and without the attacked sensor."""
    made = lee2018.gaussian_estimator(PLANT)
    filters, runs = made.filters, 300
    rng = np.random.default_rng(3)
    spread, scale = lee2018.START_ERROR / np.sqrt(6.0), lee2018.D_MAX / np.sqrt(8.0)
    noise = lee2018.N_MAX / np.sqrt(3.0)
    x = spread * rng.standard_normal((runs, 6))
    state = kalman.init(filters, 0.0, np.zeros((runs, 6)), spread**2 * np.eye(6))
    state = kalman.correct(filters, state, x @ PLANT.C.T + noise * rng.standard_normal((runs, 5)))
    for _ in range(400):
        x = x @ PLANT.A.T + scale * rng.standard_normal((runs, 6)) @ PLANT.E.T
        y = x @ PLANT.C.T + noise * rng.standard_normal((runs, 5))
        y[:, 0] += 10.0 * rng.standard_normal(runs)
        state = kalman.step(filters, state, y, np.zeros((runs, 1)))
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 6 * runs) / runs
    inside = []
    for prepared in made.sets[:2]:
        fused = partial_gaussian.fuse(prepared, state.P, tol=1e-10)
        error = state.z @ fused.estimator.T - x
        nees = np.einsum("ri,ij,rj->r", error, np.linalg.inv(fused.covariance), error).mean()
        inside.append(bool(low < nees < high))
    # `sets[1]` are the sensors 0 … 3, `sets[5]` those without the attacked one.
    fused = partial_gaussian.fuse(made.sets[5], state.P, tol=1e-10)
    assert np.array_equal(made.sets[5].kept, [1, 2, 3, 4])
    error = state.z @ fused.estimator.T - x
    nees = np.einsum("ri,ij,rj->r", error, np.linalg.inv(fused.covariance), error).mean()
    assert low < nees < high
    assert inside == [False, False]
