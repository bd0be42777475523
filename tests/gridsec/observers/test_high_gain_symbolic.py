"""Symbolic decomposition against finite differences and decompositions by hand."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from gridsec.errors import NotObservable
from gridsec.observers.high_gain import defects, groups, nearest
from gridsec.observers.high_gain import design as high_gain_design
from gridsec.observers.high_gain.form import Symbolic, at, decompose, lie
from gridsec.papers import kim2018 as example
from tests.codes import refused


@pytest.fixture
def sympy() -> Any:
    return pytest.importorskip("sympy", reason="sympy is not installed; symbolic decomposition is not tested")


def paper(sympy: Any) -> Symbolic:
    a, b, c = sympy.symbols("x1:4")
    s, cos = sympy.sin(b), sympy.cos(b)
    f = [-2 * a - b**3, -b, -b * cos + s - c]
    h = [a + b - b**3 - s + c, a + s - b**3 - c, -a + b**3 + b, -b - s + c]
    return decompose(f, [1 + 3 * b**2, 1, cos], h, [a, b, c], x_bound=0.5)


def test_without_sympy_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(ImportError, match="pip install sympy"):
        decompose([0], [0], [0], [0], x_bound=1.0)


def test_the_example_of_kim2018_comes_out_by_itself(sympy: Any) -> None:
    made, by_hand = paper(sympy), example.system()
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    assert [part.size for part in made.system.partials] == [2, 2, 2, 1]
    assert np.allclose(made.system.phi(x), by_hand.phi(x), atol=1e-13)
    assert np.allclose(made.system.jacobian(x), by_hand.jacobian(x), atol=1e-12)
    assert np.all(defects(made.system, made.f, made.g, made.h, x) < 1e-8)
    z = np.random.default_rng(1).uniform(-2.0, 2.0, (50, 2))
    for ours, theirs in zip(made.system.partials, by_hand.partials, strict=True):
        part = z[:, : ours.size]
        assert np.allclose(
            at(lambda c, p=ours: [p.alpha(c)], part), at(lambda c, p=theirs: [p.alpha(c)], part)
        )
        for row, other in zip(ours.beta, theirs.beta, strict=True):
            assert np.allclose(at(lambda c, e=row[0]: [e(c)], part), at(lambda c, e=other[0]: [e(c)], part))
    # The bounds are proven, and smaller than the paper's 2.
    assert np.all(made.system.z_bound < 1.8)
    assert np.all(np.abs(made.system.phi(x)) <= np.repeat(made.system.z_bound, [2, 2, 2, 1]))


def test_lie_derivatives_against_finite_differences(sympy: Any) -> None:
    a, b = sympy.symbols("a b")
    f = [b, -sympy.sin(a) - b**3]
    second = lie(lie(a * b, f, (a, b)), f, (a, b))
    value = sympy.lambdify((a, b), second)

    def field(x: np.ndarray) -> np.ndarray:
        return np.array([x[1], -np.sin(x[0]) - x[1] ** 3])

    def flow(x: np.ndarray, t: float) -> np.ndarray:
        for _ in range(20):
            h = t / 20
            k1 = field(x)
            k2 = field(x + 0.5 * h * k1)
            k3 = field(x + 0.5 * h * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3))
        return x

    for x in np.random.default_rng(2).uniform(-1.0, 1.0, (10, 2)):
        h = 1e-3
        ahead, here, behind = (float(np.prod(flow(x, t))) for t in (h, 0.0, -h))
        assert value(*x) == pytest.approx((ahead - 2.0 * here + behind) / h**2, abs=1e-4)


def test_alpha_that_is_no_polynomial_is_evaluated_through_a_state(sympy: Any) -> None:
    a, b = sympy.symbols("a b")
    made = decompose([b, -sympy.sin(a) - b], [[0], [1]], [a, a + b], [a, b], x_bound=1.0)
    first, second = made.forms
    assert first.polynomials[0] is None
    assert second.polynomials[0] is None
    x = np.random.default_rng(3).uniform(-1.0, 1.0, (40, 2))
    assert np.all(defects(made.system, made.f, made.g, made.h, x) < 1e-7)
    z = at(made.system.partials[0].phi, x)
    assert np.allclose(at(lambda c: [made.system.partials[0].alpha(c)], z)[:, 0], -np.sin(x[:, 0]) - x[:, 1])
    # The whole way: a design from nothing but expressions.
    sensors = decompose([b, -sympy.sin(a) - b], [0, 1], [a, a + b, 2 * a + b], [a, b], x_bound=1.0).system
    inverses = [nearest(sensors, group) for group in groups(3, 1)]
    made_design = high_gain_design(
        sensors, inverses, theta=20.0, noise=1e-3, max_attacked=1, u_low=-1.0, u_high=1.0, step_s=0.01
    )
    assert np.all(made_design.margins > 0.0)
    assert not made_design.proven


def test_systems_that_some_inputs_hide_are_refused(sympy: Any) -> None:
    a, b = sympy.symbols("a b")
    # x1' = x2 + x2 u: with u = -1 the second state is invisible.
    with refused(NotObservable, "not-uniform"):
        decompose([b, -b], [[b], [0]], [a], [a, b], x_bound=1.0)
    with refused(NotObservable, "zero-output"):
        decompose([b, -b], [0, 1], [sympy.Integer(3)], [a, b], x_bound=1.0)
    # b moves a only where a > 0: the rank depends on the place.
    half = sympy.Piecewise((b * a**2, a > 0), (0, True))
    with refused(NotObservable, "rank-changes"):
        decompose([half, -b], [0, 0], [a], [a, b], x_bound=1.0)


def test_sensors_that_see_only_a_part_keep_that_part(sympy: Any) -> None:
    a, b, c = sympy.symbols("a b c")
    made = decompose([-a + a**2, a - b, b - c], [1, 0, 0], [a, b], [a, b, c], x_bound=0.5)
    assert [part.size for part in made.system.partials] == [1, 2]
    alpha = made.forms[0].polynomials[0]
    assert alpha is not None
    assert sorted(zip(alpha.exponents[:, 0].tolist(), alpha.coefficients.tolist(), strict=True)) == [
        (1, -1.0),
        (2, 1.0),
    ]
    x = np.random.default_rng(4).uniform(-0.5, 0.5, (50, 3))
    assert np.all(defects(made.system, made.f, made.g, made.h, x) < 1e-8)
