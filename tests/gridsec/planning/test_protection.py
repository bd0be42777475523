"""Protection against brute force over all sets of meters, on 50 small random feeders."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from gridsec.arrays import Bools, Ints
from gridsec.planning.protection import Attacker, Unprotectable, fewest_protected, hides, lies_beyond
from gridsec.planning.redundancy import Patterns, patterns
from gridsec.planning.stealthy_attacks import largest_lie
from tests.codes import refused
from tests.gridsec.planning.small import TOL, brute, street, system


def mask(p: int, some: tuple[int, ...]) -> Bools:
    out = np.zeros(p, dtype=np.bool_)
    out[list(some)] = True
    return out


def found_by_hand(safe: dict[tuple[int, ...], bool]) -> int:
    return min(len(some) for some, fine in safe.items() if fine)


def check(attacker: Attacker, p: int, fewest: int) -> None:
    exact = fewest_protected(attacker, p)
    assert exact.meters.size == exact.least == fewest
    assert attacker(mask(p, tuple(exact.meters.tolist()))) is None
    greedy = fewest_protected(attacker, p, exact=False)
    assert attacker(mask(p, tuple(greedy.meters.tolist()))) is None
    assert greedy.least <= fewest <= greedy.meters.size
    assert greedy.gap == greedy.meters.size - greedy.least


@pytest.mark.canary("0-False", "11-False", "21-False", "32-False", "43-False", "3-True", "14-True")
@pytest.mark.parametrize(
    ("seed", "phased"),
    [*((seed, False) for seed in range(50)), *((seed, True) for seed in range(15))],
)
def test_protection_against_imitators_equals_brute_force(seed: int, phased: bool) -> None:
    A, C = system(100 + seed, busbar=seed % 2 == 0, phased=phased)
    p, liars = len(C), 2 * (1 + seed % 2)
    found = patterns(A, C, persistent=True, tol=TOL)
    safe = {}
    for count in range(p + 1):
        for some in combinations(range(p), count):
            free = [j for j in range(p) if j not in some]
            safe[some] = brute(A, C, free, list(range(p)), persistent=True) > liars
    check(hides(found, liars), p, found_by_hand(safe))


@pytest.mark.canary("41")
@pytest.mark.parametrize("seed", range(50))
def test_protection_against_large_lies_equals_brute_force(seed: int) -> None:
    box, liars = street(200 + seed, meters=4), 1 + seed % 3
    p = box.meters.size
    alone = np.array([largest_lie(box, j, liars).size for j in range(p)])
    # A bound between what is left if all others are protected and what there is without protection.
    limit = 0.5 * (2.0 * box.reading.max() + alone.max())
    safe = {}
    for count in range(p + 1):
        for some in combinations(range(p), count):
            honest = mask(p, some)
            safe[some] = all(largest_lie(box, j, liars, honest=honest).bound <= limit for j in range(p))
    check(lies_beyond(box, liars, limit), p, found_by_hand(safe))


def listed(rows: list[tuple[int, ...]]) -> Attacker:
    """Attacks by these sets of liars."""

    def attacker(protected: Bools) -> Ints | None:
        return next((np.array(row) for row in rows if not protected[list(row)].any()), None)

    return attacker


def test_meters_that_cannot_be_protected_are_left_out_or_named() -> None:
    attacker = listed([(0, 1), (0, 2), (3, 4)])
    assert 0 in fewest_protected(attacker, 5).meters
    for exact in (True, False):
        other = fewest_protected(attacker, 5, never=mask(5, (0, 4)), exact=exact)
        assert other.meters.tolist() == [1, 2, 3]
        assert other.gap == 0
        with refused(Unprotectable, "unprotectable") as told:
            fewest_protected(attacker, 5, never=mask(5, (0, 2)), exact=exact)
        assert told.value.liars.tolist() == [0, 2]


def test_nothing_to_protect_where_nothing_can_hide() -> None:
    given = Patterns((), (), TOL)
    assert fewest_protected(hides(given, 4), 5).meters.size == 0


def test_greedy_is_told_from_exact() -> None:
    """Greedy may take meter 0, which is in most attacks, and then needs one for each of the others."""
    attacker = listed([(0, 1, 4), (0, 2, 5), (0, 1, 6), (0, 2, 7), (1, 8), (2, 9)])
    exact, greedy = fewest_protected(attacker, 10), fewest_protected(attacker, 10, exact=False)
    assert exact.meters.tolist() == [1, 2]
    assert greedy.least == 2
    assert greedy.meters.size in {2, 3}
