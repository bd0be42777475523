"""Final names of the monitor: searches in turn, or a sole fault with enough readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.estimators.modal.monitor import CONFIRM, confirmed
from gridsec.estimators.modal.replay import Reading
from gridsec.estimators.modal.search import Identification

P = 5


def mask(*at: int, size: int = P) -> Bools:
    return np.isin(np.arange(size), at)


def found(*faults: int) -> Identification:
    """Explanation by some of the meters, a power (5) and the busbar (6)."""
    every = mask(*faults, size=P + 2)[None]
    return Identification(every, np.zeros(1, np.intp), np.ones(1), every[0, :P], ())


def ticks(*seen: Bools | None) -> list[Reading]:
    return [(float(k), np.zeros(P), one, None) for k, one in enumerate(seen)]


NONE = np.zeros(P, dtype=np.intp)


def test_a_sole_fault_with_two_readings_is_named_by_one_search() -> None:
    assert confirmed(found(2), mask(2), NONE + mask(2), ticks(None, None)).tolist() == mask(2).tolist()


@pytest.mark.parametrize(
    "since",
    [ticks(None), ticks(mask(0, 1), mask(0, 1), None), ticks(mask(0), mask(2))],
    ids=["one tick", "after a gap", "silent"],
)
def test_one_reading_of_the_meter_is_not_enough(since: list[Reading]) -> None:
    assert not confirmed(found(2), mask(2), NONE + mask(2), since).any()


@pytest.mark.parametrize("faults", [(1, 2), (2, 5), (2, 6)], ids=["meter", "power", "busbar"])
def test_a_part_of_several_faults_needs_searches_in_turn(faults: tuple[int, ...]) -> None:
    several, since = found(*faults), ticks(None, None, None)
    named = replace(several, named=mask(2)).named
    assert not confirmed(several, named, NONE + named, since).any()
    assert confirmed(several, named, CONFIRM * named, since).tolist() == named.tolist()


def test_meters_that_are_named_by_turns_of_different_length_are_apart() -> None:
    streak = CONFIRM * mask(1) + mask(3)
    assert confirmed(found(1, 3), mask(1, 3), streak, ticks(None, None)).tolist() == mask(1).tolist()
