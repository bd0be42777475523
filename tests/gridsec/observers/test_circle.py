"""One observer: gains, steps of every length against solve_ivp, silent meters, bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from gridsec.errors import DesignInfeasible, InputInvalid
from gridsec.observers import circle
from gridsec.observers.certificates import Certificate, certify
from gridsec.observers.gains import CircleGains, options_for
from gridsec.observers.lure import advance, equilibrium
from tests.codes import refused
from tests.gridsec.plants import Street, line, shared, tree

NOISE = 2e-4


def mask(count: int, *trusted: int) -> np.ndarray:
    out = np.zeros(count, dtype=bool)
    out[list(trusted)] = True
    return out


def by_lmi(of: Street, *trusted: int, noise: float = NOISE) -> circle.CircleDesign:
    options = options_for(of.lure, rate=0.25, noise=noise, load=of.load)
    return circle.design(of.lure, mask(len(of.meters), *trusted), gains="lmi", options=options)


def by_hand(of: Street) -> circle.CircleDesign:
    """Gains with an L that matters, to exercise the general integrator; no claim of any proof."""
    rng = np.random.default_rng(0)
    d = circle.design(of.lure, mask(len(of.meters), 0, 2, 3))
    L = np.where(d.trusted, rng.uniform(-0.2, 0.2, d.L.shape), 0.0)
    K = np.where(d.trusted, rng.uniform(-0.2, 0.8, d.K.shape), 0.0)
    return replace(d, L=L, K=K)


def oracle(design: circle.CircleDesign, x: np.ndarray, y: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    """chong2020 (11) as it stands, by an adaptive integrator."""
    lure, J = design.lure, design.trusted

    def field(_: float, x: np.ndarray) -> np.ndarray:
        r = np.where(J, y - lure.C @ x - lure.D @ u, 0.0)
        zeta = lure.H @ x + lure.F @ u + design.K @ r
        return lure.A @ x + lure.G @ lure.phi(zeta) + lure.B @ u + design.L @ r

    run = solve_ivp(field, (0.0, h), x, rtol=1e-10, atol=1e-13, max_step=min(0.05, h))
    assert run.success
    return np.asarray(run.y[:, -1])


@pytest.mark.canary(
    "direct-0.05-line",
    "direct-1.0-shared",
    "lmi-0.05-tree",
    "lmi-10.0-tree",
    "hand-1.0-line",
    "hand-10.0-shared",
)
@pytest.mark.parametrize("of", [line(5), tree(), shared()], ids=["line", "tree", "shared"])
@pytest.mark.parametrize("h", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("kind", ["direct", "lmi", "hand"])
def test_a_step_is_the_solution_of_the_observer_equation(of: Street, h: float, kind: str) -> None:
    rng = np.random.default_rng(7)
    p, n = len(of.meters), len(of.lure.A)
    if kind == "direct":
        design = circle.design(of.lure, mask(p, 0, 2, 3))
    else:
        design = by_lmi(of, 0, 2, 3) if kind == "lmi" else by_hand(of)
    for _ in range(3):
        x = rng.uniform(-0.05, 0.05, n)
        y, u = rng.uniform(-0.15, 0.15, p), rng.uniform(-0.15, 0.15, of.lure.F.shape[1])
        state = circle.init(design, 5.0, x)
        after = circle.step(design, state, y, u, np.ones(p, dtype=bool), h)
        assert after.t == 5.0 + h
        expected = oracle(design, x, y, u, h)
        # Second order in a substep of a tenth of the fastest time constant.
        np.testing.assert_allclose(after.x, expected, atol=2e-4 * np.abs(expected - x).max() + 1e-9)


@pytest.mark.parametrize("kind", ["direct", "lmi", "hand"])
def test_a_step_of_a_quarter_of_an_hour_ends_in_the_equilibrium(kind: str) -> None:
    """Oracle: MINPACK on the right-hand side."""
    of = line(5, kva=100.0)
    design = circle.design(of.lure, mask(5, 0, 2, 3)) if kind == "direct" else by_lmi(of, 0, 2, 3)
    if kind == "hand":
        design = by_hand(of)
    lure = of.lure
    y, u = np.array([0.09, -0.05, 0.1, 0.08, 0.0]), np.full(5, 0.1)
    seen = np.ones(5, dtype=bool)
    after = circle.step(design, circle.init(design, 0.0), y, u, seen, 900.0)

    def rest(x: np.ndarray) -> np.ndarray:
        r = np.where(design.trusted, y - lure.C @ x - lure.D @ u, 0.0)
        return np.asarray(
            lure.A @ x + lure.G @ lure.phi(lure.H @ x + lure.F @ u + design.K @ r) + design.L @ r
        )

    expected, _, flag, _ = fsolve(rest, after.x + 1e-4, full_output=True, xtol=1e-13)
    assert flag == 1
    np.testing.assert_allclose(after.x, expected, atol=1e-8)


def test_many_short_steps_are_one_long_one() -> None:
    of = tree()
    design = by_lmi(of, 0, 1, 3)
    y, u, seen = np.full(5, 0.05), np.full(6, 0.06), np.ones(5, dtype=bool)
    state = circle.init(design, 0.0)
    for _ in range(60):
        state = circle.step(design, state, y, u, seen, 1.0)
    long = circle.step(design, circle.init(design, 0.0), y, u, seen, 900.0)
    np.testing.assert_allclose(state.x, long.x, atol=1e-8)


def test_direct_injection_drives_an_inverter_by_its_own_meter() -> None:
    of = line(4)
    design = circle.design(of.lure, mask(4, 1, 3))
    expected = np.zeros((4, 4))
    expected[1, 1] = expected[3, 3] = 1.0
    np.testing.assert_array_equal(design.K, expected)
    np.testing.assert_array_equal(design.L, 0.0)
    np.testing.assert_array_equal(design.sensitivity, [0.0, 1.0, 0.0, 1.0])
    assert isinstance(design.certificate, Certificate)
    assert design.certificate.margin > 0.0
    # With the plant's own reading the driven inverters copy the plant exactly, load error or not.
    x0, u = np.array([0.02, -0.01, 0.03, 0.0]), np.full(4, 0.08)
    y = of.lure.C @ x0 + of.lure.D @ u
    after = circle.step(design, circle.init(design, 0.0, x0), y, u + 0.01, np.ones(4, dtype=bool), 0.5)
    tau = -1.0 / np.diagonal(of.lure.A)
    held = of.lure.phi(y)
    np.testing.assert_allclose(after.x[[1, 3]], (held + (x0 - held) * np.exp(-0.5 / tau))[[1, 3]], rtol=1e-12)


def test_customers_on_one_bus_keep_their_own_meters() -> None:
    of = shared()
    K = circle.direct_gain(of.lure, np.ones(5, dtype=bool))
    expected = np.zeros((4, 5))
    expected[range(4), range(4)] = 1.0  # inverters 1 and 2 share a bus; the fifth meter has no inverter
    np.testing.assert_array_equal(K, expected)


def test_of_two_meters_at_one_inverter_one_drives_it() -> None:
    of = line(3)
    twice = replace(of.lure, C=of.lure.C[[0, 0, 1, 2]], D=of.lure.D[[0, 0, 1, 2]])
    K = circle.direct_gain(twice, mask(4, 0, 1, 3))
    np.testing.assert_array_equal(K, [[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]])
    np.testing.assert_array_equal(circle.direct_gain(twice, mask(4, 1))[0], [0, 1, 0, 0])


@pytest.mark.parametrize("kind", ["direct", "lmi", "hand"])
def test_a_silent_or_untrusted_meter_has_exactly_no_influence(kind: str) -> None:
    of = line(5)
    design = {
        "direct": lambda: circle.design(of.lure, mask(5, 0, 2, 3)),
        "lmi": lambda: by_lmi(of, 0, 2, 3),
        "hand": lambda: by_hand(of),
    }[kind]()
    u, state = np.full(5, 0.07), circle.init(design, 0.0, np.full(5, 0.01))
    y = np.array([0.05, 0.0, 0.06, 0.07, 0.0])
    seen = np.array([True, True, False, True, False])
    for h in (1.0, 900.0):
        base = circle.step(design, state, y, u, seen, h).x
        for value in (np.nan, np.inf, -1e30, 3.0):
            other = y.copy()
            other[[1, 2, 4]] = value
            np.testing.assert_array_equal(circle.step(design, state, other, u, seen, h).x, base)
        # A reading that is no number counts as none, whatever `seen` says.
        broken = y.copy()
        broken[2] = np.nan
        everyone = np.ones(5, dtype=bool)
        np.testing.assert_array_equal(circle.step(design, state, broken, u, everyone, h).x, base)
        fewer = replace(
            design,
            trusted=mask(5, 0, 3),
            L=np.where(mask(5, 0, 3), design.L, 0.0),
            K=np.where(mask(5, 0, 3), design.K, 0.0),
        )
        np.testing.assert_array_equal(circle.step(fewer, state, y, u, everyone, h).x, base)


def test_without_any_reading_the_observer_is_the_model() -> None:
    of = tree()
    design = by_lmi(of, 0, 1, 3)
    x, u, none = np.full(5, 0.02), np.full(6, 0.08), np.zeros(5, dtype=bool)
    after = circle.step(design, circle.init(design, 0.0, x), np.full(5, np.nan), u, none, 2.0)
    np.testing.assert_allclose(after.x, advance(of.lure, x, u, 2.0), rtol=1e-12)


def test_the_proof_while_meters_are_silent() -> None:
    of = line(5)
    design = by_lmi(of, 0, 2, 3)
    assert isinstance(design.certificate, CircleGains)
    assert circle.margin_without(design, np.array([], dtype=np.intp)) == design.certificate.margin
    # The optimum spends all the slack there is on its own meters: without one of them the same P and
    # Lambda prove nothing, and the function says so.
    assert circle.margin_without(design, np.array([2])) < 0.0
    direct = circle.design(of.lure, mask(5, 0, 2, 3))
    assert circle.margin_without(direct, np.array([0, 2])) == direct.certificate.margin > 0.0


def test_where_no_closed_form_applies_the_solver_proves_direct_injection() -> None:
    """Spread time constants, a loop gain above 1, S far from symmetric: neither closed form holds."""
    of = line(4, tau=(0.5, 3.0), seed=4, kva=300.0)
    lure, taps = of.lure, np.exp(np.random.default_rng(4).normal(0.0, 0.8, 4))
    skew = replace(lure, H=lure.H * taps, C=lure.C * taps)
    with refused(DesignInfeasible, "no-certificate"):
        certify(skew)
    design = circle.design(skew, mask(4, 0, 2))
    assert isinstance(design.certificate, Certificate)
    assert design.certificate.kind == "lmi"
    assert design.certificate.margin > 0.0
    assert design.rate == pytest.approx(0.1 * float(np.min(np.diagonal(lure.G))))
    asked = options_for(skew, rate=0.02, noise=NOISE, load=of.load)
    assert circle.design(skew, mask(4, 0, 2), options=asked).rate == 0.02


def test_a_plant_that_is_no_droop_loop_needs_an_lmi_design() -> None:
    of = line(3)
    odd = replace(of.lure, A=of.lure.A + 0.01 * np.triu(np.ones((3, 3)), 1))
    with refused(DesignInfeasible, "no-certificate"):
        circle.design(odd, mask(3, 0))
    options = options_for(odd, rate=0.2, noise=NOISE, load=of.load)
    assert circle.design(odd, mask(3, 0, 1), gains="lmi", options=options).rate >= 0.19


def test_a_design_made_before_is_verified_again() -> None:
    of = line(5)
    made = by_lmi(of, 0, 2, 3).certificate
    assert isinstance(made, CircleGains)
    again = circle.design(of.lure, mask(5, 0, 2, 3), gains=made)
    np.testing.assert_array_equal(again.K[:, made.J], made.K)
    with refused(InputInvalid, "wrong-design"):
        circle.design(of.lure, mask(5, 0, 2), gains=made)
    with refused(DesignInfeasible, "not-verified"):
        circle.design(line(5, seed=9, kva=60.0).lure, mask(5, 0, 2, 3), gains=made)


def test_wrong_calls() -> None:
    lure = line(3).lure
    with refused(InputInvalid, "missing"):
        circle.design(lure, mask(3, 0), gains="lmi")
    with refused(InputInvalid, "shape"):
        circle.design(lure, mask(4, 0))


def test_the_residual_bound_is_infinite_where_nothing_was_promised() -> None:
    of = line(4)
    # Loads known exactly except at the first customer.
    load = np.zeros((4, 1))
    load[0] = 1e-3
    options = options_for(of.lure, rate=0.2, noise=np.array([1e-4, 0.0, 1e-4, 1e-4]), load=load, floor=0.2)
    design = circle.design(of.lure, mask(4, 0, 1), gains="lmi", options=options)
    fine = circle.residual_bound(design, np.array([1e-4, 0.0, 1e-4, 1e-4]), np.array([1e-3, 0, 0, 0]))
    assert np.isfinite(fine).all()
    assert np.isinf(circle.residual_bound(design, np.zeros(4), np.array([0, 1e-6, 0, 0]))).all()
    assert np.isinf(circle.residual_bound(design, np.array([0, 1e-6, 0, 0]), np.zeros(4))).all()


def test_without_an_equilibrium_a_long_step_walks() -> None:
    """An observer without a proof, which has no rest: the step still answers."""
    of = line(3, kva=100.0)

    def relay(z: np.ndarray) -> np.ndarray:
        # Injecting lowers z below the threshold, absorbing raises it above: it never comes to rest.
        return 0.01 * np.sign(z - 0.01)

    wild = replace(of.lure, phi=relay)
    design = replace(circle.design(of.lure, mask(3, 0)), lure=wild)
    system, held = circle.between_readings(design, np.zeros(3), np.full(3, 0.01), mask(3, 0))
    with refused(DesignInfeasible, "not-converged"):
        equilibrium(system, held, np.zeros(3), tol=1e-10, max_iter=200)
    after = circle.step(design, circle.init(design, 0.0), np.zeros(3), np.full(3, 0.01), mask(3, 0), 60.0)
    assert np.isfinite(after.x).all()
    assert np.abs(after.x).max() <= 0.01 + 1e-9
