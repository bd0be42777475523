"""All flats at once, against branch and bound."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsec.arrays import Floats
from gridsec.secure.index import fewest, fewest_rows
from tests.gridsec.planning.small import TOL


def rows_of(seed: int, count: int, n: int) -> Floats:
    """Rows of length one that see everything together, many of them alike or in common subspaces."""
    rng = np.random.default_rng(seed)
    few = rng.integers(-1, 2, (count, n)).astype(float)
    few[rng.permutation(count)[: count // 3]] = rng.normal(size=(count // 3, n))
    few[:n] += 3.0 * np.eye(n)
    length = np.linalg.norm(few, axis=1, keepdims=True)
    return np.asarray(few / np.where(length > 0.0, length, 1.0))[rng.permutation(count)]


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), count=st.integers(4, 9), n=st.integers(2, 4), turned=st.booleans())
def test_same_answers_as_branch_and_bound(seed: int, count: int, n: int, turned: bool) -> None:
    seen = rows_of(seed, max(count, n), n)
    if turned:
        # A complex basis of the same space.
        angles = np.random.default_rng(seed).uniform(0.0, 6.0, (n, n))
        seen = seen @ np.linalg.qr(np.exp(1j * angles))[0]
    for must in (None, *range(len(seen))):
        expected = fewest(list(seen[:, None, :]), np.eye(n), tol=TOL, must=must)
        found = fewest_rows(seen, tol=TOL, must=must)
        assert found is not None
        assert found.count == expected.count
        assert found.blocks.tolist() == expected.blocks.tolist()
        if np.isfinite(found.count):
            sees = np.abs(seen @ found.direction) > TOL
            assert np.flatnonzero(sees).tolist() == found.blocks.tolist()
            assert np.linalg.norm(found.direction) == pytest.approx(1.0)


def test_too_many_choices_are_left_to_branch_and_bound() -> None:
    assert fewest_rows(rows_of(1, 60, 6), tol=TOL) is None
