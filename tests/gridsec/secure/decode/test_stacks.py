"""Detectability and correctability against the definitions, and the errata of section 2.2.1 and 2.2.2."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible, InputInvalid, NotObservable
from gridsec.secure.decode import (
    Stack,
    annihilator,
    clean,
    cospark,
    error_correctable,
    error_detectable,
    residual,
    sensors_in_error,
    spark,
)
from gridsec.secure.decode.stacks import masked, require, subsets
from tests.codes import refused

TOL = 1e-9


def random_stack(seed: int) -> Stack:
    """Small integers, so that coincidences (the interesting cases) are frequent; heights 0 to 3."""
    rng = np.random.default_rng(seed)
    p, n = int(rng.integers(2, 7)), int(rng.integers(1, 4))
    return Stack.of([rng.integers(-1, 2, (int(rng.integers(0, 4)), n)).astype(float) for _ in range(p)])


def full_rank_without(stack: Stack, lost: tuple[int, ...]) -> bool:
    kept = [i for i in range(stack.count) if i not in lost]
    part = stack.matrix[stack.rows(kept)]
    return bool(part.size and np.linalg.matrix_rank(part) == stack.unknowns)


@given(st.integers(0, 10_000))
@settings(max_examples=150, deadline=None)
def test_detectable_and_correctable_by_rank(seed: int) -> None:
    """lee2018, Propositions 2.2.2 (i) = (ii) = (iii) and 2.2.3 (i) = (ii) = (iii) = (iv)."""
    stack = random_stack(seed)
    found = cospark(stack, tol=TOL)
    for q in range(stack.count + 1):
        by_rank = all(
            full_rank_without(stack, lost)
            for lost in itertools.combinations(range(stack.count), min(q, stack.count))
        )
        assert error_detectable(stack, q, tol=TOL) == by_rank == (found.count > q)
        # Definition 2.2.3: two states collide if they differ only where one error or the other can be.
        sets = list(itertools.combinations(range(stack.count), min(q, stack.count)))
        by_pairs = all(full_rank_without(stack, (*one, *other)) for one in sets for other in sets)
        assert error_correctable(stack, q, tol=TOL) == by_pairs
    # The direction found is an undetectable error of exactly that many blocks (Definition 2.2.1).
    error = stack.matrix @ found.direction
    assert list(stack.support(error, 1e-9)) == list(found.blocks)
    if np.linalg.matrix_rank(stack.matrix) == stack.unknowns:
        assert np.allclose(residual(stack, error), 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(25))
def test_cospark_of_a_code_is_spark_of_its_annihilator(seed: int) -> None:
    """lee2018, section 2.1, in integers with many coincidences."""
    rng = np.random.default_rng(seed)
    while True:
        C = rng.integers(-1, 2, (7, 3)).astype(float)
        if np.linalg.matrix_rank(C) == 3:
            break
    F = annihilator(C, tol=TOL)
    assert F.shape == (4, 7)
    assert np.allclose(F @ C, 0.0, atol=1e-12)
    assert np.allclose(F @ F.T, np.eye(4))
    code, sensing = cospark(Stack.of_rows(C), tol=TOL), spark(F, tol=TOL)
    assert code.count == sensing.count == brute_spark(F)
    assert np.allclose(F @ sensing.direction, 0.0, atol=1e-9)
    assert list(np.flatnonzero(np.abs(sensing.direction) > 1e-9)) == list(sensing.blocks)


def brute_spark(F: Floats) -> float:
    for k in range(1, F.shape[1] + 1):
        for columns in itertools.combinations(range(F.shape[1]), k):
            if np.linalg.matrix_rank(F[:, columns], tol=1e-9) < k:
                return k
    return np.inf


def test_spark_of_independent_and_of_zero_columns() -> None:
    assert spark(np.eye(3), tol=TOL).count == np.inf
    assert spark(np.array([[1.0, 0, 0], [0, 1e-6, 0]]), tol=TOL).count == 1


def correctable(seed: int, p: int = 6, n: int = 3, height: int = 2) -> Stack:
    return Stack.of(np.random.default_rng(seed).standard_normal((p, height, n)))


def test_noiseless_detection_finds_every_error_below_the_cospark() -> None:
    """lee2018, Lemmas 2.2.1 and 2.2.4: residual zero if and only if the error is undetectable."""
    rng = np.random.default_rng(0)
    stack = correctable(0)
    most = int(cospark(stack, tol=TOL).count) - 1
    assert most == 4
    for size in range(most + 1):
        for bad in itertools.combinations(range(6), size):
            x = rng.standard_normal((5, 3))
            e = np.zeros((5, 12))
            e[:, stack.rows(bad)] = rng.standard_normal((5, 2 * size)) * 10.0 ** rng.uniform(-4, 4, (5, 1))
            z = x @ stack.matrix.T + e
            assert np.all(clean(stack, z, tol=1e-12) == (size == 0))
    hiding = stack.matrix @ rng.standard_normal(3)
    assert clean(stack, stack.matrix @ np.ones(3) + hiding, tol=1e-12)


def test_a_second_residual_and_the_erratum_in_its_dimensions() -> None:
    """lee2018, Corollary 2.2.5: Psi has n (p - 1) rows. With the printed (n - 1) p, errors pass unseen."""
    p, n = 5, 3
    stack = correctable(1, p, n, n)
    Psi = annihilator(stack.matrix, tol=TOL)
    assert Psi.shape == (n * (p - 1), n * p)
    assert n * (p - 1) != (n - 1) * p
    z = np.random.default_rng(2).standard_normal((20, n * p))
    assert np.allclose(z @ Psi.T @ Psi, residual(stack, z)), "r = Psi^T r'"
    # 10 of the 12 dimensions satisfy all that is printed; here they are chosen to miss an error in a block.
    e = np.zeros(n * p)
    e[:n] = [1.0, -2.0, 0.5]
    seen = Psi @ e
    cut = np.linalg.svd(np.vstack([seen, np.eye(12)[:1]]), full_matrices=True)[2][2:]
    printed = cut @ Psi
    assert printed.shape == ((n - 1) * p, n * p)
    assert np.allclose(printed @ printed.T, np.eye(10))
    assert np.allclose(printed @ stack.matrix, 0.0, atol=1e-12)
    assert error_detectable(stack, 1, tol=TOL)
    assert np.linalg.norm(printed @ e) < 1e-12
    assert np.linalg.norm(Psi @ e) > 0.1
    # For p < n that many rows do not exist at all: it is more than the left kernel has dimensions.
    short = correctable(1, p := 2, n := 6, n)
    assert len(annihilator(short.matrix, tol=TOL)) == n * (p - 1) < (n - 1) * p


def test_the_criterion_of_lemma_2_2_8() -> None:
    rng = np.random.default_rng(3)
    stack = correctable(3, p=7, n=3, height=1)
    assert error_correctable(stack, 2, tol=TOL)
    x = rng.standard_normal(3)
    for bad in itertools.combinations(range(7), 2):
        z = stack.matrix @ x
        z[list(bad)] += rng.standard_normal(2)
        assert sensors_in_error(stack, z, x, 1e-12) == 2
        others = x + rng.standard_normal((50, 3))
        assert np.all(sensors_in_error(stack, z, others, 1e-12) > 2)
        # The most dangerous wrong answers: those that fit 3 sensors exactly, true or not.
        for fit in itertools.combinations(range(7), 3):
            y = np.linalg.solve(stack.matrix[list(fit)], z[list(fit)])
            assert (sensors_in_error(stack, z, y, 1e-9) <= 2) == bool(np.allclose(y, x))


def test_stack_with_blocks_of_all_heights() -> None:
    stack = Stack.of([np.ones((2, 2)), np.zeros((0, 2)), np.array([[0.0, 3]])])
    assert (stack.count, stack.unknowns) == (3, 2)
    z = np.array([3.0, 4.0, -2.0])
    assert np.array_equal(stack.norms(z), [5.0, 0.0, 2.0])
    assert list(stack.support(z, 0.0)) == [0, 2]
    assert list(stack.rows([2])) == [2]
    assert stack.blocks().shape == (3, 2, 2)
    assert np.array_equal(stack.blocks()[2], [[0, 3], [0, 0]])
    assert np.array_equal(masked(stack, np.array([[1, 2]]))[0], [[0, 0], [0, 0], [0, 3]])
    with refused(InputInvalid, "shape"):
        Stack(np.eye(3), np.array([2, 2]))
    with refused(InputInvalid, "shape"):
        Stack(np.eye(3), np.array([4, -1]))


def test_refusals_name_the_sensors_and_the_counts() -> None:
    C = np.array([[1.0, 0], [1, 0], [1, 0], [0, 1], [0, 1]])
    with refused(NotObservable, "not-observable") as caught:
        require(Stack.of_rows(C), 2, TOL, "undoing 1 errors")
    assert caught.value.subset == (0, 1, 2)
    assert caught.value.rank == 1
    with refused(DesignInfeasible, "too-many"):
        subsets(20, 10, 1000)
    assert subsets(4, 2, 6).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert subsets(4, 0, 6).shape == (1, 0)
