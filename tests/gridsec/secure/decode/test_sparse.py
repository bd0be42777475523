"""Pursuits recover what their theorems promise, and may fail where only l0 decoding is exact."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gridsec.arrays import Floats
from gridsec.errors import DesignInfeasible
from gridsec.observers.lmi.solver import group_pursuit
from gridsec.secure.decode import Stack, annihilator, design, error_correctable, exact
from gridsec.secure.decode.search import (
    basis_pursuit,
    decode_by_matching,
    decode_by_pursuit,
    matching_pursuit,
    restricted_isometry,
)
from tests.codes import refused

TOL = 1e-9


def nearly_orthogonal(seed: int, m: int, p: int) -> Floats:
    """Columns of norm one and low coherence: a random frame, relaxed towards a Welch-bound one."""
    rng = np.random.default_rng(seed)
    F = rng.standard_normal((m, p))
    for _ in range(200):
        u, _, vh = np.linalg.svd(F, full_matrices=False)
        F = u @ vh
        F /= np.linalg.norm(F, axis=0)
    return F


def test_isometry_constants_by_definition() -> None:
    F = nearly_orthogonal(0, 5, 8)
    for k in (1, 2, 3):
        delta = restricted_isometry(F, k)
        worst = 0.0
        for columns in itertools.combinations(range(8), k):
            s = np.linalg.svd(F[:, columns], compute_uv=False)
            worst = max(worst, s[0] ** 2 - 1, 1 - s[-1] ** 2)
        assert delta == pytest.approx(worst, abs=1e-12)
    assert restricted_isometry(np.eye(4), 9) == 0.0


@pytest.mark.parametrize(("m", "p", "q"), [(6, 8, 1), (12, 16, 1), (40, 44, 2)])
def test_pursuits_are_exact_under_their_conditions(m: int, p: int, q: int) -> None:
    """lee2018, Theorems 2.1.1 and 2.1.2, on matrices for which the constants are verified."""
    F = nearly_orthogonal(1, m, p)
    assert restricted_isometry(F, 2 * q) < np.sqrt(2) - 1
    assert restricted_isometry(F, q + 1) < 1 / (np.sqrt(q) + 1)
    rng = np.random.default_rng(2)
    supports = list(itertools.combinations(range(p), q))
    for index in rng.permutation(len(supports))[:40]:
        e = np.zeros(p)
        e[list(supports[index])] = rng.standard_normal(q) * 10.0 ** rng.uniform(-3, 3, q)
        assert np.allclose(basis_pursuit(F, F @ e), e, atol=1e-7 * np.abs(e).max())
        found, chosen = matching_pursuit(F, F @ e, q)
        assert np.allclose(found, e, atol=1e-9 * np.abs(e).max())
        assert set(chosen) == set(supports[index])


def test_matching_pursuit_written_out() -> None:
    """lee2018, Algorithm 2.1, line by line; also where it chooses wrongly."""
    rng = np.random.default_rng(3)
    F, y = rng.standard_normal((6, 10)), rng.standard_normal(6)
    support: list[int] = []
    rest = y
    for _ in range(4):
        support.append(int(np.argmax(np.abs(F.T @ rest) / np.linalg.norm(F, axis=0))))
        rest = y - F[:, support] @ (np.linalg.pinv(F[:, support]) @ y)
    e, chosen = matching_pursuit(F, y, 4)
    assert list(chosen) == support
    assert np.allclose(y - F @ e, rest)
    nothing, none = matching_pursuit(F, np.zeros(6), 4)
    assert not nothing.any()
    assert none.size == 0


def test_where_pursuits_fail_and_l0_does_not() -> None:
    """A correctable code of a system: F is given, not drawn, and its isometry constant is useless."""
    t = np.arange(7.0)
    stack = Stack.of_rows(np.stack([np.ones(7), t, t**2], axis=1))
    F = annihilator(stack.matrix, tol=TOL)
    assert error_correctable(stack, 2, tol=TOL)
    assert restricted_isometry(F, 4) > 0.9
    decoder = design(stack, 2, tol=TOL)
    failures = {"pursuit": 0, "matching": 0}
    rng = np.random.default_rng(4)
    for bad in itertools.combinations(range(7), 2):
        x = rng.standard_normal(3)
        z = stack.matrix @ x
        z[list(bad)] += rng.standard_normal(2) * 3.0
        assert np.allclose(exact(decoder, z, tol=1e-9).x, x)
        failures["pursuit"] += not np.allclose(decode_by_pursuit(stack, z, tol=TOL), x, atol=1e-6)
        failures["matching"] += not np.allclose(decode_by_matching(stack, z, 2, tol=TOL)[0], x, atol=1e-6)
    assert failures["pursuit"] > 0
    assert failures["matching"] > 0


def test_blocks_by_a_cone_program_and_by_matching() -> None:
    """Errors that fill whole blocks; ten sensors of three rows, two of them wrong."""
    rng = np.random.default_rng(5)
    stack = Stack.of(rng.standard_normal((10, 3, 3)))
    for bad in ((0, 1), (3, 8), (9,)):
        x = rng.standard_normal(3)
        z = stack.matrix @ x
        z[stack.rows(bad)] += rng.standard_normal(3 * len(bad)) * 20.0
        assert np.allclose(decode_by_pursuit(stack, z, tol=TOL), x, atol=1e-5)
        got, chosen = decode_by_matching(stack, z, len(bad), tol=TOL)
        assert np.allclose(got, x, atol=1e-9)
        assert set(chosen) == set(bad)


def test_group_pursuit_is_optimal() -> None:
    """Dual certificate: |(F^T nu)_i| <= 1 in every block and y^T nu equal to the cost."""
    rng = np.random.default_rng(6)
    F, y = rng.standard_normal((5, 12)), rng.standard_normal(5)
    heights = np.array([3, 1, 4, 0, 4])
    e = group_pursuit(F, y, heights)
    parts = [part for part in np.split(np.arange(12), np.cumsum(heights)[:-1]) if part.size]
    sizes = np.array([np.linalg.norm(e[part]) for part in parts])
    assert np.allclose(F @ e, y, atol=1e-6)
    active = [k for k, s in enumerate(sizes) if s > 1e-4]
    equations = np.vstack([F[:, parts[k]].T for k in active])
    wanted = np.concatenate([e[parts[k]] / sizes[k] for k in active])
    nu = np.linalg.lstsq(equations, wanted, rcond=None)[0]
    assert np.allclose(equations @ nu, wanted, atol=1e-3)
    assert all(np.linalg.norm(F[:, part].T @ nu) <= 1 + 1e-3 for part in parts)
    assert y @ nu == pytest.approx(sizes.sum(), rel=1e-3)
    single = group_pursuit(F, y, np.ones(12, dtype=np.intp))
    assert np.abs(single).sum() == pytest.approx(np.abs(basis_pursuit(F, y)).sum(), rel=1e-5)


def test_nothing_to_find_and_nothing_possible() -> None:
    F = np.array([[1.0, 0, 0], [1.0, 0, 0]])
    assert not basis_pursuit(F, np.zeros(2)).any()
    assert not group_pursuit(F, np.zeros(2), np.array([3])).any()
    with refused(DesignInfeasible, "no-solution"):
        basis_pursuit(F, np.array([1.0, 2.0]))
    with refused(DesignInfeasible, "no-solution"):
        group_pursuit(F, np.array([1.0, 2.0]), np.array([1, 2]))


def test_no_block_is_chosen_twice_where_more_are_asked_for_than_there_are() -> None:
    F, y = np.array([[1.0, 0.3], [0.2, 1.0], [0.5, 0.5]]), np.array([1.0, 0.5, 2.0])
    e, chosen = matching_pursuit(F, y, 3)
    assert sorted(chosen.tolist()) == [0, 1]
    assert np.allclose(e, np.linalg.solve(F.T @ F, F.T @ y), atol=1e-12)
