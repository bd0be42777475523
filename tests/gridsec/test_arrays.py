"""Shared numerics against closed forms and dense computations."""

from __future__ import annotations

from fractions import Fraction
from math import factorial

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from gridsec.arrays import (
    exponential_integrals,
    frozen,
    frozen_ints,
    perron_bound,
    spectral_radius,
    submatrix,
    symmetry_defect,
    unit_rows,
)


def test_frozen_copies_and_locks() -> None:
    given_values = np.array([1.0, 2.0])
    out = frozen(given_values)
    given_values[0] = 7.0
    assert out.tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        out[0] = 3.0


@pytest.mark.parametrize("values", [np.array([0.0, 1.0]), np.array([True]), np.array(["1"])])
def test_indices_must_be_integers(values: np.ndarray) -> None:
    with pytest.raises(TypeError, match="indices must be integers"):
        frozen_ints(values)


@given(st.data(), st.integers(1, 6), st.integers(1, 6))
def test_a_submatrix_is_picked_entry_by_entry(data: st.DataObject, n: int, m: int) -> None:
    matrix = np.arange(float(n * m)).reshape(n, m)
    rows = data.draw(st.lists(st.integers(0, n - 1), max_size=9))
    columns = data.draw(st.lists(st.integers(0, m - 1), max_size=9))
    out = submatrix(matrix, np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp))
    assert out.shape == (len(rows), len(columns))
    assert out.flags.c_contiguous
    assert out.tolist() == [[matrix[i, j] for j in columns] for i in rows]
    out += 1.0
    assert matrix[0, 0] == 0.0, "a copy"


def test_no_indices_at_all_are_integers_of_any_type() -> None:
    assert frozen_ints(np.array([])).dtype == np.intp


def test_unit_rows_are_directions_or_nothing() -> None:
    rows = np.array([[3.0, 4.0], [0.0, 0.0], [1e-16, -2e-17], [0.0, 1e-6]])
    assert unit_rows(rows, tol=1e-9).tolist() == [[0.6, 0.8], [0.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
    # The unit of the whole is no property of it, and nothing is divided by zero.
    np.testing.assert_allclose(unit_rows(1e-100 * rows, tol=1e-9), unit_rows(rows, tol=1e-9), rtol=1e-15)
    assert unit_rows(np.zeros((2, 3)), tol=1e-9).tolist() == [[0.0] * 3] * 2
    assert unit_rows(np.zeros((0, 3)), tol=0.0).shape == (0, 3)


def test_symmetry_defect() -> None:
    assert symmetry_defect(np.zeros((3, 3))) == 0.0
    assert symmetry_defect(np.array([[2.0, 1.0], [0.0, 2.0]])) == 0.5


def _exact_integrals(y: float) -> tuple[float, float, float]:
    """The power series in rational numbers, without any rounding."""
    exact = Fraction(y)
    powers = [exact**k for k in range(60)]
    return (
        float(sum(powers[k] / factorial(k) for k in range(60))),
        float(sum(powers[k] / factorial(k + 1) for k in range(60))),
        float(sum(powers[k] / factorial(k + 2) for k in range(60))),
    )


@pytest.mark.acceptance
@given(st.floats(-12.0, 2.0))
def test_exponential_integrals_match_the_exact_series(y: float) -> None:
    for got, exact in zip(exponential_integrals(np.array([y])), _exact_integrals(y), strict=True):
        assert got[0] == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("y", [0.0, 1e-300, -1e-2, 1e-2, np.nextafter(1e-2, 0), -0.00999])
def test_exponential_integrals_where_the_formulas_change(y: float) -> None:
    for got, exact in zip(exponential_integrals(np.array([y])), _exact_integrals(y), strict=True):
        assert got[0] == pytest.approx(exact, rel=1e-13)


def test_exponential_integrals_far_out() -> None:
    grown, first, second = exponential_integrals(np.array([-1e4]))
    assert grown[0] == 0.0
    assert first[0] == pytest.approx(1e-4)
    assert second[0] == pytest.approx(1e-4 - 1e-8)


@given(st.integers(0, 10_000), st.integers(1, 12), st.integers(0, 10))
def test_perron_bound_is_a_bound(seed: int, n: int, rounds: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.5)
    top = spectral_radius(np.abs(matrix))
    bound = perron_bound(matrix, rounds)
    assert bound >= top * (1 - 1e-12)
    assert bound >= spectral_radius(matrix) * (1 - 1e-9)


def test_perron_bound_is_tight_for_positive_matrices() -> None:
    matrix = np.random.default_rng(0).uniform(0.5, 1.0, (20, 20))
    assert perron_bound(matrix, 8) == pytest.approx(spectral_radius(matrix), rel=1e-2)


def test_empty_matrices() -> None:
    empty = np.zeros((0, 0))
    assert spectral_radius(empty) == perron_bound(empty, 3) == symmetry_defect(empty) == 0.0
