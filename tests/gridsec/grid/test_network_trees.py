"""Sums over trees against walking from bus to bus."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
from hypothesis import given

from gridsec.arrays import Ints
from gridsec.grid.network import below, from_root, meetings, walk


def some_tree(seed: int, most: int = 20) -> Ints:
    rng = np.random.default_rng(seed)
    return np.array([rng.integers(max(0, k - 3), k + 1) for k in range(rng.integers(0, most))], dtype=np.intp)


def ancestors(parent: Ints, bus: int) -> list[int]:
    """A bus and all above it, up to the root."""
    out = [bus]
    while out[-1] > 0:
        out.append(int(parent[out[-1] - 1]))
    return out


@given(st.integers(0, 100_000), st.sampled_from([1, 3, 12]), st.booleans())
def test_sums_of_few_and_many_real_and_complex_values(seed: int, rows: int, phasors: bool) -> None:
    parent = some_tree(seed)
    tree, count = walk(parent), parent.size + 1
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(2, rows, count))
    if phasors:
        values = values + 1j * rng.normal(size=(2, rows, count))
    above = [ancestors(parent, bus) for bus in range(count)]
    subtree = [[bus for bus in range(count) if k in above[bus]] for k in range(count)]
    expected = np.stack([values[..., buses].sum(axis=-1) for buses in subtree], axis=-1)
    np.testing.assert_allclose(below(tree, values), expected, rtol=0, atol=1e-13)
    branch = values[..., 1:]
    expected = np.stack([branch[..., [b - 1 for b in path if b > 0]].sum(axis=-1) for path in above], axis=-1)
    np.testing.assert_allclose(from_root(tree, branch), expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(tree.depth, [len(path) - 1 for path in above])


@given(st.integers(0, 100_000))
def test_sums_along_the_walk_are_those_by_the_matrix(seed: int) -> None:
    small = walk(some_tree(seed, most=200))
    large = replace(small, inside=None)
    assert small.inside is not None
    values = np.random.default_rng(seed).normal(size=small.start.size)
    np.testing.assert_allclose(below(small, values), below(large, values), rtol=0, atol=1e-12)
    np.testing.assert_allclose(from_root(small, values[1:]), from_root(large, values[1:]), rtol=0, atol=1e-12)


def test_no_matrix_is_kept_for_a_large_tree() -> None:
    assert walk(np.arange(1000)).inside is None


@given(st.integers(0, 100_000))
def test_paths_meet_at_the_lowest_common_bus(seed: int) -> None:
    parent = some_tree(seed)
    buses = np.random.default_rng(seed).integers(0, parent.size + 1, 7)
    found = meetings(parent, walk(parent), buses)
    for k in range(parent.size + 1):
        for j, bus in enumerate(buses):
            common = set(ancestors(parent, k)) & set(ancestors(parent, int(bus)))
            assert found[k, j] == max(common)  # further down is a higher number
