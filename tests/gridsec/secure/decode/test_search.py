"""l0 decoding is exact for every correctable pattern, for every r, in batches and singly."""

from __future__ import annotations

import itertools
from math import comb

import numpy as np
import pytest

from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.secure.decode import Stack, design, exact
from gridsec.secure.decode.search import bounded, cheapest
from gridsec.secure.index import observability
from tests.codes import refused

TOL = 1e-9

SHAPES = [(5, 3, 1, 1), (7, 3, 1, 2), (6, 4, 2, 2), (5, 3, 3, 2), (8, 2, 1, 3), (4, 3, 3, 1)]


@pytest.mark.parametrize(("p", "n", "height", "q"), SHAPES)
def test_exact_for_every_pattern_and_every_r(p: int, n: int, height: int, q: int) -> None:
    """lee2018, Theorem 2.2.7: all supports up to q, attacks from 1e-3 to 1e6, q <= r <= 2 q."""
    rng = np.random.default_rng(p * 100 + n)
    stack = Stack.of(rng.standard_normal((p, height, n)))
    patterns = [bad for size in range(q + 1) for bad in itertools.combinations(range(p), size)]
    x = rng.standard_normal((len(patterns), n))
    e = np.zeros((len(patterns), p * height))
    for row, bad in zip(e, patterns, strict=True):
        row[stack.rows(bad)] = rng.standard_normal(height * len(bad)) * 10.0 ** rng.uniform(-3, 6)
    z = x @ stack.matrix.T + e
    for r in range(q, 2 * q + 1):
        decoder = design(stack, q, tol=TOL, left_out=r)
        assert len(decoder.kept) == comb(p, r)
        got = exact(decoder, z, tol=1e-9)
        assert np.allclose(got.x, x, rtol=1e-7, atol=1e-8)
        assert np.all(got.credible)
        for found, bad in zip(got.in_error, patterns, strict=True):
            assert tuple(np.flatnonzero(found)) == bad
        single = exact(decoder, z[-1], tol=1e-9)
        assert np.array_equal(single.in_error, got.in_error[-1])
        assert np.allclose(single.x, got.x[-1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("p", "n", "height", "q"), SHAPES)
def test_exact_against_lies_that_agree_with_each_other(p: int, n: int, height: int, q: int) -> None:
    """The worst noiseless attack: q sensors report another state, in perfect harmony."""
    rng = np.random.default_rng(p)
    stack = Stack.of(rng.standard_normal((p, height, n)))
    decoder = design(stack, q, tol=TOL)
    for bad in itertools.combinations(range(p), q):
        x, other = rng.standard_normal(n), rng.standard_normal(n)
        z = stack.matrix @ x
        z[stack.rows(bad)] = (stack.matrix @ other)[stack.rows(bad)]
        got = exact(decoder, z, tol=1e-9)
        assert np.allclose(got.x, x, atol=1e-8)
        assert tuple(np.flatnonzero(got.in_error)) == bad


def test_blocks_of_unequal_height_and_an_empty_one() -> None:
    rng = np.random.default_rng(4)
    blocks = [rng.standard_normal((h, 3)) for h in (3, 2, 3, 0, 1, 3, 2)]
    stack = Stack.of(blocks)
    decoder = design(stack, 1, tol=TOL)
    for bad in (0, 1, 2, 4, 5, 6):
        x = rng.standard_normal(3)
        z = stack.matrix @ x
        z[stack.rows([bad])] += 1.0
        got = exact(decoder, z, tol=1e-9)
        assert np.allclose(got.x, x)
        assert np.flatnonzero(got.in_error).tolist() == [bad]


def test_initial_state_of_a_system_under_attack() -> None:
    """lee2018, Proposition 3.3.1: a 2q-redundant observable pair, outputs over n steps, any attack."""
    rng = np.random.default_rng(5)
    A = np.array([[1.0, 0.1, 0], [0, 0.9, 0.2], [-0.2, 0, 0.8]])
    C = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [1, 1, 1]])
    G = observability(A, C)
    decoder = design(Stack.of(G), 2, tol=1e-6)
    for bad in itertools.combinations(range(5), 2):
        x = rng.standard_normal(3)
        outputs = G @ x
        outputs[list(bad)] = rng.standard_normal((2, 3)) * 5.0
        got = exact(decoder, outputs.ravel(), tol=1e-9)
        assert np.allclose(got.x, x, atol=1e-8)


def test_more_errors_than_assumed_are_noticed() -> None:
    """Not a guarantee of the paper, but an answer that must not look like a success."""
    rng = np.random.default_rng(6)
    stack = Stack.of(rng.standard_normal((7, 1, 3)))
    decoder = design(stack, 2, tol=TOL)
    z = stack.matrix @ rng.standard_normal(3)
    z[:4] += rng.standard_normal(4)
    got = exact(decoder, z, tol=1e-9)
    assert not got.credible


def test_of_several_minimisers_the_best_fitting_is_taken() -> None:
    """Two candidates leave one sensor unexplained; the one with smaller residuals wins."""
    stack = Stack.of_rows(np.ones((3, 1)))
    decoder = design(stack, 1, tol=TOL, left_out=2)
    got = bounded(decoder, np.array([0.0, 0.9, 1.0]), limit=0.5)
    assert got.x == pytest.approx([0.9])
    assert got.in_error.tolist() == [True, False, False]
    per_sensor = bounded(decoder, np.array([0.0, 0.9, 1.0]), limit=np.array([2.0, 0.5, 0.5]))
    assert not per_sensor.in_error.any()


def test_the_cheapest_number_of_blocks_to_leave_out() -> None:
    """lee2018, Remark 2.2.2: r = q for few errors among many, r = 2 q near p / 2."""
    assert cheapest(30, 2) == 2
    assert cheapest(9, 4) == 8
    assert cheapest(5, 0) == 0
    assert comb(9, cheapest(9, 4)) == 9 < comb(9, 4)


def test_refusals() -> None:
    stack = Stack.of_rows(np.random.default_rng(0).standard_normal((6, 3)))
    with refused(NotObservable, "not-observable"):
        design(stack, 2, tol=TOL)
    with refused(InputInvalid, "out-of-range"):
        design(stack, 1, tol=TOL, left_out=3)
    with refused(DesignInfeasible, "too-many"):
        design(stack, 1, tol=TOL, most=5)
    for limit in (np.nan, -1e-9):
        with refused(InputInvalid, "negative"):
            bounded(design(stack, 1, tol=TOL), np.zeros(6), limit=limit)
