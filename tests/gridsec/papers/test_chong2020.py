"""chong2020 on its setting, and a test for each erratum that no other one holds: docs/errata/chong2020.md."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gridsec.estimators.exact_bank import bank as banks
from gridsec.observers.gains import circle_matrix
from gridsec.observers.lmi import circle
from gridsec.observers.lure import advance, close_loop, equilibrium, known_input
from gridsec.papers import chong2020
from gridsec.papers.chong2020 import DESIGNS, Design
from gridsec.papers.claims import Reproduction
from tests.gridsec.papers.made import made
from tests.gridsec.radial import squared_voltages

both = pytest.mark.parametrize("of", DESIGNS)


@pytest.fixture(scope="module")
def result() -> Reproduction:
    return made("chong2020")


class TestSetting:
    @pytest.mark.acceptance
    def test_every_claim_is_met_or_explained(self, result: Reproduction) -> None:
        assert not result.unexplained
        assert [claim.where for claim in result.unmet] == ["(8) (erratum)", "(8) (erratum)"]

    @pytest.mark.parametrize("where", ["(8)", "(20)", "Theorem 2", "(8) (erratum)"])
    def test_every_statement_about_the_estimate_has_a_row_for_each_design(
        self, result: Reproduction, where: str
    ) -> None:
        rows = [claim.what for claim in result.claims if claim.where == where]
        assert ["L, K of (12)" in what for what in rows] == [True, False]
        assert ["L = 0, K = E_J" in what for what in rows] == [False, True]

    def test_the_figure_shows_the_claims(self, result: Reproduction) -> None:
        (figure,) = result.figures
        voltages, state, squared, chosen = figure.panels
        for panel in (state, squared):
            for selected, envelope in (panel.lines[:2], panel.lines[2:]):
                assert np.all(selected.y <= envelope.y)
                assert selected.y[-1] < -8.0
        true, reported, back = voltages.lines[:3]
        assert np.abs(true.y[-1] - back.y[-1]) < 1e-7
        assert not np.isfinite(reported.y[-1]), "the drifting meter leaves the axes"
        # The set {1, 3, 4} without both liars is chosen once the rest has settled.
        masks = banks.subsets(5, 2, most=100).masks()
        for line in chosen.lines:
            assert np.flatnonzero(masks[int(line.y[-1])]).tolist() == [0, 2, 3]

    def test_the_reactance_matrix_of_the_line(self) -> None:
        """H as printed in section VII: sums of X_0 … X_min, and X' on the diagonal."""
        of = chong2020.setting(4)
        main, drop = 0.03 / 1.587, 0.01 / 1.587
        i = np.arange(4)
        expected = -2.0 * (main * (np.minimum(i[:, None], i) + 1) + drop * np.eye(4))
        np.testing.assert_allclose(of.lure.H, expected, rtol=1e-12)

    @pytest.mark.canary("direct")
    @both
    def test_the_run_against_the_bank_of_the_service(self, of: Design) -> None:
        """The same banks, held readings, small steps: `bank.step` follows the continuous-time run."""
        at, those = chong2020.setting(3), chong2020.observers(of, 3, 1)
        rng = np.random.default_rng(1)
        x, start = rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.05, 0.05, (6, 3))

        def alpha(t: float) -> np.ndarray:
            return np.array([0.0, 0.03 * np.cos(t), 0.0])

        run = chong2020.observe(at, those, alpha, x=x, start=start, times=np.linspace(0.0, 4.0, 41))
        bank = those.bank
        seen, h, truth = np.ones(3, dtype=bool), 0.005, x
        state = banks.init(bank, np.zeros(3), at.w, seen)
        state = type(state)(start, seen, state.prepared)  # type: ignore[call-arg, arg-type]
        for k in range(800):
            # Readings of the middle of each step make the held input second order.
            half = advance(at.lure, truth, at.w, h / 2)
            y = chong2020.reported(at.lure.H @ half + at.w, 1.0, alpha((k + 0.5) * h))
            state = banks.step(bank, state, y, at.w, seen, h)
            truth = advance(at.lure, half, at.w, h / 2)
        np.testing.assert_allclose(truth, run.x[-1], atol=1e-6)
        np.testing.assert_allclose(state.x, run.estimates[-1], atol=2e-5)  # type: ignore[union-attr]
        np.testing.assert_allclose(banks.consistency(bank, state), run.pi[-1], atol=4e-5)

    @both
    def test_the_run_against_one_observer_at_a_time(self, of: Design) -> None:
        """(11) and (17) written out entry by entry, one set J after the other, with its own solver."""
        at = chong2020.setting()
        run, _, _ = chong2020.under_attack(of)
        masks = banks.subsets(5, 2, most=100).masks()
        tau, knots, levels = at.droop.tau, 1.0 - at.droop.v[:, ::-1] ** 2, at.droop.q[:, ::-1]
        H, w = at.lure.H, at.w

        def gain(J: list[int]) -> tuple[np.ndarray, np.ndarray]:
            if of == "direct":
                return np.zeros((5, len(J))), np.eye(5)[:, J]
            one = chong2020.solutions()[tuple(J)]
            return one.L, one.K

        def curve(i: int, z: float) -> float:
            return float(np.interp(z, knots[i], levels[i]))

        for index in (0, 4, 12):  # {3, 4, 5} and {1, 3, 4} of the large sets, {3} of the small ones
            J = np.flatnonzero(masks[index]).tolist()
            L, K = gain(J)

            def field(
                t: float, s: np.ndarray, J: list[int] = J, L: np.ndarray = L, K: np.ndarray = K
            ) -> list[float]:
                x, hat = s[:5], s[5:]
                z = [float(w[i] + H[i] @ x) for i in range(5)]
                # Meter 2 reads 0.04 + 0.02 t too much, meter 5 0.08 sin t, in per unit of the voltage.
                shift = [0.0, 0.04 + 0.02 * t, 0.0, 0.0, 0.08 * np.sin(t)]
                y = [1.0 - (np.sqrt(1.0 - z[j]) + shift[j]) ** 2 for j in range(5)]
                gap = [y[j] - float(w[j] + H[j] @ hat) for j in J]
                zeta = [float(w[i] + H[i] @ hat + K[i] @ gap) for i in range(5)]
                plant = [(curve(i, z[i]) - x[i]) / tau[i] for i in range(5)]
                return plant + [(curve(i, zeta[i]) - hat[i]) / tau[i] + float(L[i] @ gap) for i in range(5)]

            start = np.concatenate([run.x[0], run.estimates[0, index]])
            alone = solve_ivp(
                field, (0.0, 5.0), start, "DOP853", run.t[:51], rtol=1e-9, atol=1e-12, max_step=0.1
            )
            np.testing.assert_allclose(alone.y[:5].T, run.x[:51], atol=2e-7)
            np.testing.assert_allclose(alone.y[5:].T, run.estimates[:51, index], atol=2e-7)

    @both
    def test_honest_observers_stay_within_a_third_of_the_envelope(self, of: Design) -> None:
        run, state, _ = chong2020.under_attack(of)
        masks = banks.subsets(5, 2, most=100).masks()
        honest = ~masks[:, [1, 4]].any(axis=1)
        error = np.abs(run.estimates[:, honest] - run.x[:, None]).max(axis=(1, 2))
        assert np.all(error <= state / 3.0)
        assert np.all(run.error <= state)

    @both
    def test_the_proof_of_each_honest_observer_falls_at_its_rate(self, of: Design) -> None:
        """`V = e^T P e` of the integrated error, set by set: V(t) <= exp(-2 rate t) V(0)."""
        run, _, _ = chong2020.under_attack(of)
        those = chong2020.observers(of)
        honest = np.flatnonzero(~those.bank.masks[:, [1, 4]].any(axis=1))
        assert len(honest) == 4  # {1, 3, 4}, {1}, {3}, {4}
        for index in honest:
            e = run.estimates[:, index] - run.x
            V = np.einsum("ti,ij,tj->t", e, those.P[index], e)
            late = 1e-10 * V[0] < V  # below, the error of the integration counts
            assert np.all(V[late] <= V[0] * np.exp(-2.0 * those.rate[index] * run.t[late]) * (1.0 + 1e-6))
            assert late.sum() > 100


class TestErrata:
    def test_the_sign_of_the_attack(self) -> None:
        """Section VII prints a = 2 v alpha - alpha^2; by (14), y = vbar^2 - (v + alpha)^2, it is minus."""
        v, alpha = 0.97, 0.03
        y, z = 1.0 - (v + alpha) ** 2, 1.0 - v**2
        assert y - z == pytest.approx(-2.0 * v * alpha - alpha**2, abs=1e-15)
        assert y - z != pytest.approx(2.0 * v * alpha - alpha**2, abs=1e-3)
        assert chong2020.reported(np.array([z]), 1.0, np.array([alpha]))[0] == pytest.approx(y, abs=1e-15)

    def test_the_service_drop_of_15(self) -> None:
        """An injection raises the voltage over its own drop: v^2 = v'^2 + 2 beta', not minus.

        Oracle: the AC voltage at the end of one line, by its quartic equation, for a small injection.
        """
        r, x, p, q = 0.01, 0.02, 0.05, 0.02
        # |v_s|^2 = |v_r - z i|^2 with i = conj(s / v_r): v_r^4 - (v_s^2 + 2 (r p + x q)) v_r^2 + |z s|^2 = 0.
        b = 1.0 + 2.0 * (r * p + x * q)
        squared = 0.5 * (b + np.sqrt(b**2 - 4.0 * (r**2 + x**2) * (p**2 + q**2)))
        assert squared == pytest.approx(1.0 + 2.0 * (r * p + x * q), abs=2e-6)
        assert squared < 1.0 + 2.0 * (r * p + x * q)
        assert abs(squared - (1.0 - 2.0 * (r * p + x * q))) > 1e-3

    def test_the_known_input_and_19(self) -> None:
        """The printed phi_i has the wrong sign before the own drop's X' q_c, and (19) lacks v_0.

        Oracle: (15), corrected, walked from the busbar outwards, customer by customer.
        """
        rng = np.random.default_rng(2)
        N, v0 = 4, 0.98
        R, X, Rp, Xp = rng.uniform(0.01, 0.05, (4, N))
        rho, qc, qg = rng.uniform(-0.2, 0.1, N), rng.uniform(0.0, 0.1, N), rng.uniform(-0.05, 0.05, N)
        point, v2 = v0**2, np.zeros(N)
        for i in range(N):
            # Power that flows from point i to i + 1 is what the customers beyond draw.
            P, Q = -rho[i:].sum(), -(qg - qc)[i:].sum()
            point -= 2.0 * (R[i] * P + X[i] * Q)
            v2[i] = point + 2.0 * (Rp[i] * rho[i] + Xp[i] * (qg[i] - qc[i]))
        shared = np.array([[X[: min(i, j) + 1].sum() for j in range(N)] for i in range(N)])
        shared_r = np.array([[R[: min(i, j) + 1].sum() for j in range(N)] for i in range(N)])
        H = -2.0 * (shared + np.diag(Xp))
        w = 1.0 - v0**2 - 2.0 * (shared_r + np.diag(Rp)) @ rho + 2.0 * (shared + np.diag(Xp)) @ qc
        np.testing.assert_allclose(1.0 - (H @ qg + w), v2, atol=1e-13)
        phi = np.zeros(N)
        for i in range(N):
            for j in range(i + 1):
                phi[i] += 2.0 * X[j] * qc[j:].sum() - 2.0 * R[j] * rho[j:].sum()
                phi[i] -= 2.0 * (Rp[j] * rho[j] + Xp[j] * qc[j])
            for j in range(i):
                phi[i] += 2.0 * (Rp[j] * rho[j] + Xp[j] * qc[j])
        # Printed: v^2 = -H x - psi + v^2, read with v_0 at the end. The correction is 4 X' q_c.
        printed = -H @ qg - phi + v0**2
        np.testing.assert_allclose(printed - v2, 4.0 * Xp * qc, atol=1e-13)
        # The project's own loop and known input, on a line with these impedances, give the same voltages.
        of = chong2020.setting(N)
        line = replace(of.feeder, r=np.concatenate([R, Rp]), x=np.concatenate([X, Xp]))
        lure, model = close_loop(line, of.droop, np.arange(N)), line.linear()
        np.testing.assert_allclose(lure.H, H, atol=1e-15)
        ours = known_input(model, 1.0, rho, -qc, v0**2)
        np.testing.assert_allclose(ours, w, atol=1e-15)
        np.testing.assert_allclose(1.0 - (lure.H @ qg + lure.F @ ours), v2, atol=1e-13)
        np.testing.assert_allclose(squared_voltages(model, rho, qg - qc, v0**2), v2, atol=1e-13)

    def test_the_printed_inequality_does_not_fit(self) -> None:
        """(12) prints -P, n columns, where n_J are needed; the corrected column is -P L N."""
        of, J = chong2020.setting(), [0, 2, 4]
        made = circle(of.lure, J, rate=0.25, noise=2e-4, load=np.full(5, 2e-3))
        n, k = 5, len(J)
        column = circle_matrix(of.lure, made.J, made)[:, 2 * n : 2 * n + k]
        assert made.P.shape[1] != k
        np.testing.assert_allclose(column[:n], -made.P @ made.L * made.noise, rtol=1e-12)
        np.testing.assert_allclose(column[n : 2 * n], -made.Lambda[:, None] * made.K * made.noise, rtol=1e-12)

    def test_a_lower_slope_other_than_zero(self) -> None:
        """Proposition 1 uses the upper slope of (10) only; below zero it certifies an unstable observer.

        x' = -x + phi(z), z = -x, slopes in [-3, 0.1]: feasible at 0.1, and the error grows like exp(2 t).
        """
        p, lam, d = 1.0, 1.0, 0.1
        printed = np.array([[-2.0 * p + 0.1, p - lam], [p - lam, -2.0 * lam / d]])
        assert np.linalg.eigvalsh(printed)[-1] < 0.0
        run = solve_ivp(lambda _, e: -e + (-3.0) * (-e), (0.0, 1.0), [1.0], rtol=1e-9)
        assert run.y[0, -1] == pytest.approx(np.exp(2.0), rel=1e-6)

    @pytest.mark.parametrize(
        ("A", "C", "L", "what"),
        [
            ([[0.0, 1.0], [-1.0, 0.0]], [[1.0, 0.0]], [[2.0], [0.0]], "outputs cross"),
            ([[1.0]], [[1.0]], [[3.0]], "outputs part"),
            ([[-1.0]], [[0.0]], [[0.0]], "outputs agree"),
        ],
    )
    def test_theorem_1_needs_another_definition(
        self, A: list[list[float]], C: list[list[float]], L: list[list[float]], what: str
    ) -> None:
        """(ii) does not imply (2): each system has an observer as in (4); M = 0, one output."""
        a, c, gain = np.array(A), np.array(C), np.array(L)
        n = len(a)

        def field(_: float, s: np.ndarray) -> np.ndarray:
            x, other, hat = s.reshape(3, n)
            return np.concatenate([a @ x, a @ other, a @ hat + gain @ (c @ (x - hat))])

        start = np.concatenate([np.eye(n)[0], np.zeros(n), np.full(n, -0.7)])
        grid = np.linspace(0.0, 4.0 * np.pi, 801)
        run = solve_ivp(field, (0.0, grid[-1]), start, t_eval=grid, rtol=1e-10, atol=1e-12)
        x, other, hat = run.y.reshape(3, n, -1)
        assert np.abs(x - hat)[:, -1].max() < 1e-3 * np.abs(x - hat)[:, 0].max()
        gap = np.abs(c @ (x - other)).max(axis=0)
        if what == "outputs cross":
            # A class KL function of |x(0) - x_bar(0)| = 1 is positive at every time.
            assert grid[100] == pytest.approx(np.pi / 2.0)
            assert gap[100] == pytest.approx(0.0, abs=1e-8)
        elif what == "outputs part":
            # No class K function of the initial distance bounds this at all times.
            assert gap[-1] > 1e5 * gap[0]
        else:
            assert np.abs(x - other)[:, 0].max() > 0.5
            assert np.array_equal(gap, np.zeros_like(gap))

    def test_what_theorem_1_does_give(self) -> None:
        """Plants that agree on honest outputs converge: one observer, fed by either, tracks both."""
        decay = np.array([1.0, 0.3])

        def field(_: float, s: np.ndarray) -> np.ndarray:
            x, other, hat = s.reshape(3, 2)
            pushed = np.array([2.0 * (x[0] - hat[0]), 0.0])
            return np.concatenate([-decay * x, -decay * other, -decay * hat + pushed])

        run = solve_ivp(field, (0.0, 12.0), [1.0, 5.0, 1.0, -2.0, 0.0, 0.0], rtol=1e-9, atol=1e-12)
        x, other, hat = run.y.reshape(3, 2, -1)
        np.testing.assert_allclose(x[0], other[0], atol=1e-8)  # the output is the first state
        gap, both = (
            np.abs(x - other).max(axis=0),
            np.abs(x - hat).max(axis=0) + np.abs(other - hat).max(axis=0),
        )
        assert np.all(gap <= both + 1e-9)
        assert gap[-1] < 0.03 * gap[0]

    @both
    def test_8_needs_the_errors_of_all_observers(self, of: Design) -> None:
        run = chong2020.exact_start(of)
        masks = banks.subsets(3, 1, most=100).masks()
        assert run.error[0] == 0.0
        assert np.flatnonzero(masks[run.chosen[0]]).tolist() == [0, 1]
        assert run.error.max() > 0.02
        # Corrected: the largest initial error of all observers.
        those = chong2020.observers(of, 3, 1)
        assert np.all(run.error <= chong2020.envelope(those, run.estimates[0] - run.x[0], run.t))

    def test_corollary_1_holds_when_corrected(self) -> None:
        """The corrected (12) for all 31 sets, without the column of load errors, block by block.

        Oracle: A = -1 / tau, G = 1 / tau and H as section VII prints them, and the slope bounds of (18).
        """
        at, found = chong2020.setting(), chong2020.solutions()
        assert sorted(found) == sorted(J for k in range(1, 6) for J in combinations(range(5), k))
        inverse = np.diag(1.0 / at.droop.tau)
        shared = 0.03 * (np.minimum.outer(np.arange(5), np.arange(5)) + 1) + 0.01 * np.eye(5)
        H = -2.0 * shared / 1.587
        for J, one in found.items():
            P, Lam, k = one.P, np.diag(one.Lambda), len(J)
            assert np.linalg.eigvalsh(P)[0] > 0.0
            assert min(*one.Lambda, one.mu, one.nu) > 0.0
            inner = P @ (-inverse - one.L @ H[list(J)])
            weight = one.nu * np.linalg.eigvalsh(H.T @ H)[0] * np.eye(5)  # nu I of (12)
            blocks = np.block(
                [
                    [
                        inner + inner.T + 2.0 * chong2020.RATE * P + weight,
                        P @ inverse + (H - one.K @ H[list(J)]).T @ Lam,
                        -P @ one.L,
                    ],
                    [np.zeros((5, 5)), -2.0 * Lam @ np.diag(1.0 / at.droop.slope), -Lam @ one.K],
                    # mu belongs to noise in units of METER_ERROR.
                    [np.zeros((k, 10)), -one.mu / chong2020.METER_ERROR**2 * np.eye(k)],
                ]
            )
            whole = np.triu(blocks) + np.triu(blocks, 1).T
            scale = 1.0 / np.sqrt(-np.diagonal(whole))
            assert np.linalg.eigvalsh(scale[:, None] * whole * scale)[-1] < 0.0, J
            # No observer ignores its meters, and none of the bank is direct injection.
            assert np.abs(one.K[list(J), range(k)]).min() > 0.5, J
            assert np.abs(one.L).max() > 1e-3 or k > 3, J
        rest = equilibrium(at.lure, at.w, tol=1e-12, max_iter=200)
        assert np.all(rest > 0.01), "the setting works on the ramps of its curves"
