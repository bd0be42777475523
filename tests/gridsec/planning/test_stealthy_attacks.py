"""Hidden lies against enumeration of liars, and against readings that are made of them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid
from gridsec.planning.stealthy_attacks import ErrorBox, largest_lie, worst_error
from tests.codes import refused
from tests.gridsec.planning.small import street


def tried(box: ErrorBox, row: Floats, liars: int, honest: Floats, must: int | None) -> float:
    """Maximum of ``2 row c`` by trying every set of liars."""
    able = [j for j in range(box.meters.size) if not honest[j]]
    best = 0.0
    for count in range(min(liars, len(able)) + 1):
        for some in combinations(able, count):
            if must is not None and must not in some:
                continue
            kept = [j for j in range(box.meters.size) if j not in some]
            rows = box.effect[box.meters[kept]]
            found = linprog(
                -row,
                A_ub=np.vstack([rows, -rows]),
                b_ub=np.concatenate([box.reading[kept]] * 2),
                bounds=(-1, 1),
                options={"primal_feasibility_tolerance": 1e-9},
            )
            best = max(best, -2.0 * found.fun)
    return best


@pytest.mark.canary("1")
@pytest.mark.parametrize("seed", range(6))
def test_largest_lies_equal_enumeration(seed: int) -> None:
    box = street(seed, meters=4)
    honest = np.arange(box.meters.size) == seed % 7
    for liars in (1, 2, 3):
        for j in range(box.meters.size):
            found = largest_lie(box, j, liars, honest=honest)
            if honest[j]:
                assert found.size == 0.0
                continue
            expected = tried(box, box.effect[box.meters[j]], liars, honest, j) + 2.0 * box.reading[j]
            assert found.size == pytest.approx(expected, rel=1e-5)
            assert found.size <= found.bound <= found.size * (1 + 1e-4)
            assert j in found.liars
            assert found.liars.size <= liars
        for i in range(box.effect.shape[0]):
            worst = worst_error(box, i, liars, honest=honest)
            assert worst.size == pytest.approx(tried(box, box.effect[i], liars, honest, None), rel=1e-5)


@pytest.mark.canary("2", "9")
@pytest.mark.parametrize("seed", range(10))
def test_the_largest_lie_does_fit_to_an_honest_feeder(seed: int) -> None:
    """Two honest feeders at opposite ends of the unknowns: the lies turn one's readings into the other's."""
    box = street(seed)
    for j in range(box.meters.size):
        found = largest_lie(box, j, 2)
        w = box.effect[box.meters] @ found.unknowns
        e = np.clip(-w, -box.reading, box.reading)
        e[j] = -box.reading[j] * np.sign(w[j] or 1.0)
        first, second = -w - e, w + e
        # Both are honest: |e| within the meters' errors. They agree wherever nobody lies.
        a = second - first
        others = np.delete(np.arange(box.meters.size), found.liars)
        np.testing.assert_allclose(a[others], 0.0, atol=2e-5 * box.reading.max())
        reached = 2.0 * (w[j] + box.reading[j] * np.sign(w[j] or 1.0))
        assert abs(reached) == pytest.approx(found.size, rel=1e-6)


def test_protection_and_collusion_are_monotone() -> None:
    box = street(4)
    none = np.zeros(box.meters.size, dtype=np.bool_)
    one = none.copy()
    one[1] = True
    for j in range(box.meters.size):
        sizes = [largest_lie(box, j, liars).size for liars in (1, 2, 3, 4)]
        assert sizes == sorted(sizes)
        assert largest_lie(box, j, 3, honest=one).size <= largest_lie(box, j, 3).size + 1e-12


def test_boxes_are_checked() -> None:
    with refused(InputInvalid, "not-positive"):
        ErrorBox(np.eye(2), np.array([0, 1]), np.array([0.1, 0.0]))
    with refused(InputInvalid, "shape"):
        ErrorBox(np.eye(2), np.array([0, 1]), np.array([0.1]))
