"""Lies with false powers against enumeration of liars, and their protection against brute force."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import linprog

from gridsec.arrays import Bools
from gridsec.planning.protection import fewest_protected, lies_beyond
from gridsec.planning.stealthy_attacks import PowerErrorModel, largest_lie, largest_story
from tests.gridsec.planning.small import street


def stories(seed: int, meters: int) -> PowerErrorModel:
    """A street whose powers are known to a share, by its meters: of unknowns that belong to nobody too."""
    box, rng = street(seed, meters=meters), np.random.default_rng(seed)
    k = box.effect.shape[1]
    return PowerErrorModel(box, rng.integers(-1, box.meters.size, k), rng.choice([0.0, 0.1, 0.5, 1.0], k))


def mask(p: int, some: tuple[int, ...]) -> Bools:
    return np.isin(np.arange(p), some)


def tried(given: PowerErrorModel, meter: int, liars: int, honest: Bools) -> float:
    """Every set of liars by a linear program of its own; bounds of the unknowns are written out."""
    box, best = given.box, 0.0
    able = [j for j in range(box.meters.size) if not honest[j]]
    for some in combinations(able, min(liars, len(able))):
        if meter not in some:
            continue
        kept = [j for j in range(box.meters.size) if j not in some]
        rows = box.effect[box.meters[kept]]
        ends = [
            1.0 if owner in some else share
            for owner, share in zip(given.owner.tolist(), given.honest, strict=True)
        ]
        found = linprog(
            -box.effect[box.meters[meter]],
            A_ub=np.vstack([rows, -rows]),
            b_ub=np.concatenate([box.reading[kept]] * 2),
            bounds=[(-end, end) for end in ends],
        )
        best = max(best, -2.0 * found.fun + 2.0 * box.reading[meter])
    return best


@pytest.mark.canary("0", "11")
@pytest.mark.parametrize("seed", range(12))
def test_largest_stories_equal_enumeration(seed: int) -> None:
    given = stories(seed, 4)
    p = given.box.meters.size
    honest = mask(p, (seed % 5,))
    for liars in (1, 2, 3):
        for j in range(p):
            found = largest_story(given, j, liars, honest=honest)
            if honest[j]:
                assert (found.size, found.bound) == (0.0, 0.0)
                continue
            assert found.size == pytest.approx(tried(given, j, liars, honest), rel=1e-5)
            assert found.size <= found.bound <= found.size * (1 + 1e-4)
            assert j in found.liars
            assert found.liars.size <= liars
            assert not honest[found.liars].any()
            # Those that were named are enough.
            again = largest_story(given, j, liars, honest=~mask(p, tuple(found.liars.tolist())))
            assert again.size == pytest.approx(found.size, rel=1e-5)


def test_with_true_powers_it_is_the_lie_alone() -> None:
    given = stories(3, 4)
    true = PowerErrorModel(
        given.told(mask(given.box.meters.size, ())), given.owner, np.ones(given.owner.size)
    )
    for j in range(true.box.meters.size):
        assert largest_story(true, j, 2).size == pytest.approx(largest_lie(true.box, j, 2).size)


@pytest.mark.canary("0", "19")
@pytest.mark.parametrize("seed", range(20))
def test_protection_against_stories_equals_brute_force(seed: int) -> None:
    given, liars = stories(300 + seed, 4), 1 + seed % 3
    p = given.box.meters.size
    alone = np.array([largest_story(given, j, liars).size for j in range(p)])
    limit = 0.5 * (2.0 * given.box.reading.max() + alone.max())
    fewest = min(
        count
        for count in range(p + 1)
        for some in combinations(range(p), count)
        if all(tried(given, j, liars, mask(p, some)) <= limit for j in range(p) if j not in some)
    )
    found = fewest_protected(lies_beyond(given, liars, limit), p)
    assert found.meters.size == found.least == fewest
