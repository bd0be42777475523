"""What is refused before anything is designed, with all problems at once."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from scipy.special import ndtr

from gridsec.errors import InputInvalid
from gridsec.estimators import exact_bank, front, partial, set_search, unknown_input
from gridsec.estimators.front import FrontOptions, LoadDoubt
from gridsec.estimators.plant import Options, Plant
from gridsec.grid.devices import steady_rounding
from tests.codes import refused
from tests.gridsec.street import accuracy, make_plant

FAMILIES = (exact_bank, partial, set_search, unknown_input)


def street() -> Plant:
    return make_plant(np.random.default_rng(0), customers=5)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"meters": np.array([-1, 0, 1, 2, 3])}, "unknown-index"),
        ({"meters": np.array([9, 0, 1, 2, 5])}, "unknown-index"),
        ({"meters": np.array([0, 0, 1, 2, 3])}, "duplicate"),
        ({"accuracy": accuracy(3)}, "shape"),
        ({"accuracy": accuracy(1)}, "shape"),
    ],
)
def test_a_plant_that_does_not_fit_together_is_refused(
    family: ModuleType, wrong: dict[str, object], code: str
) -> None:
    with refused(InputInvalid, code):
        family.design(replace(street(), **wrong), max_attacked=1, step_s=1.0)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("step_s", [0.0, -1.0, np.nan, np.inf])
def test_all_problems_are_named_at_once(family: ModuleType, step_s: float) -> None:
    wrong = replace(street(), meters=np.array([-1, 3, 3]))
    with refused(InputInvalid, "unknown-index", "duplicate", "shape", "not-integer", "not-positive"):
        family.design(wrong, max_attacked=-1, step_s=step_s)


def test_the_front_end_asks_the_same_of_a_plant() -> None:
    wrong = replace(street(), meters=np.array([-1, 3, 3]))
    with refused(InputInvalid, "unknown-index", "duplicate", "shape", "not-integer", "not-positive", "shape"):
        front.design(wrong, doubt=LoadDoubt(np.ones(3), np.ones(3), 1.0), step_s=np.nan, max_attacked=-1)


def test_numbers_of_one_family_are_named_with_the_others() -> None:
    for dwell_s in (np.nan, -1.0, np.inf):
        with refused(InputInvalid, "not-integer", "negative"):
            set_search.design(street(), max_attacked=-1, step_s=1.0, dwell_s=dwell_s)
    with refused(InputInvalid, "not-positive", "negative"):
        unknown_input.design(street(), max_attacked=1, step_s=0.0, max_inverters=-1)


def test_options_that_would_name_everybody_or_nobody_are_refused() -> None:
    with refused(
        InputInvalid,
        "negative",
        "negative",
        "not-integer",
        "not-integer",
        "out-of-range",
        "not-positive",
        "order",
    ) as caught:
        Options(np.nan, confirm=0, release=0, settled=0.0, tie=-1.0, widest=np.nan, v2_limits=(2.0, 1.0))
    names = [problem.split()[0] for problem in caught.value.problems]
    assert names == ["sigmas", "tie", "confirm", "release", "settled", "widest", "v2_limits"]
    Options(sigmas=0.0, confirm=1, release=1, settled=1.0, tie=0.0, widest=np.inf)


def test_options_of_the_front_end_are_checked_alike() -> None:
    wrong = {
        "alarms_per_year": 0.0, "enough": 0.0, "release": 0, "suspect": 1.0, "lower": np.nan, "like": 0.5,
        "hidden_power": 0.0, "commission_s": np.nan, "stability": -0.1, "unread_std_percent": -1.0,
        "largest_offset_s": -1.0,
        "widest": np.nan, "v2_limits": (np.nan, 1.0), "settled": np.nan,
    }  # fmt: skip
    with pytest.raises(InputInvalid) as caught:
        FrontOptions(**wrong)  # type: ignore[arg-type]
    found = {
        problem.split()[0]: code
        for problem, code in zip(caught.value.problems, caught.value.codes, strict=True)
    }
    assert found == {
        "alarms_per_year": "not-positive", "enough": "out-of-range", "release": "out-of-range",
        "suspect": "out-of-range", "lower": "out-of-range", "like": "out-of-range",
        "hidden_power": "not-positive", "commission_s": "negative", "stability": "negative",
        "unread_std_percent": "negative",
        "largest_offset_s": "negative", "widest": "not-positive", "v2_limits": "order",
        "settled": "out-of-range",
    }  # fmt: skip


def test_a_plant_of_broken_numbers_is_refused() -> None:
    for steps in (-1, 0.5, np.nan):
        with refused(InputInvalid, "not-integer"):
            replace(street(), loss_correction=steps)
    with refused(InputInvalid, "not-integer", "not-integer"):
        replace(street(), meters=np.array([0.0, 1.5]), loss_correction=-1)


def test_an_accuracy_names_all_its_problems_and_is_read_only() -> None:
    mine = np.full(2, 0.005)
    with refused(InputInvalid, "negative", "shape", "negative", "negative") as caught:
        replace(
            accuracy(2), class_fraction=np.array([np.nan, 0.0]), resolution=-np.ones(3), busbar_class=-1.0
        )
    names = [problem.split()[0] for problem in caught.value.problems]
    assert names == ["class_fraction", "resolution", "resolution", "busbar_class"]
    made = replace(accuracy(2), class_fraction=mine)
    mine[0] = 1.0
    assert made.class_fraction.tolist() == [0.005, 0.005]
    with pytest.raises(ValueError, match="read-only"):
        made.jitter[0] = 1.0


def test_rounding_that_jitter_does_not_average_away_is_bounded() -> None:
    """Against the mean of a register, by the probability of each of its numbers."""
    steps = np.array([1.0 / 230.0, 0.1 / 230.0, 0.0, 0.01])
    for part in (1e-6, 0.02, 0.1, 0.2, 0.3, 0.5, 1.0):
        found = steady_rounding(replace(accuracy(4), resolution=steps, jitter=part * steps))
        v, numbers = np.linspace(-0.5, 0.5, 201)[1:-1, None], np.arange(-9, 10)
        upper, lower = (ndtr((numbers + end - v) / part) for end in (0.5, -0.5))
        off = ((upper - lower) @ numbers)[:, None] - v
        largest, variance = np.abs(off).max(), np.mean(off**2)
        assert (found >= 0.999 * largest * steps).all()
        assert (found <= 1.5 * largest * steps + 1e-15).all()
        assert (0.5 * found**2 >= 0.99 * variance * steps**2).all()
    # A register of 0.1 V with 0.05 % of jitter has none.
    assert (steady_rounding(accuracy(4)) < 1e-12).all()
