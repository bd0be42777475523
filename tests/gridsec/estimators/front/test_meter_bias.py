"""Times of the commissioning meter by meter, and the persistent form of the fixed errors."""

from __future__ import annotations

import numpy as np
import pytest

from gridsec.arrays import Bools
from gridsec.errors import InputInvalid
from gridsec.estimators import front
from gridsec.estimators.front import Commission, FrontDesign, FrontOptions, LoadDoubt
from gridsec.estimators.front.meter_bias import (
    COUNTED,
    REASONS,
    Learned,
    Learning,
    LearningReason,
    from_arrays,
    gather,
    initial,
    no_readings,
    ready_meters,
    renew,
    to_arrays,
)
from tests.codes import refused
from tests.gridsec.street import make_plant

P = 6
EVERY = np.full(P, COUNTED)


def prepared(commission_s: float = 3600.0) -> FrontDesign:
    plant = make_plant(np.random.default_rng(3), customers=P)
    doubt = LoadDoubt(np.full(P, 0.006), np.full(P, 0.002), 600.0)
    options = FrontOptions(commission_s=commission_s, stability=0.0)
    return front.design(plant, doubt=doubt, step_s=1.0, options=options)


def one(k: int) -> Bools:
    return np.arange(P) == k


def learned(design: FrontDesign, rng: np.random.Generator) -> Commission:
    """All meters learned at 3600 s."""
    bias, known = rng.uniform(-1.0, 1.0, P) * design.allowed, 0.1 * design.fixed
    return Commission(Learned(bias, known, 0.5 * design.allowed, np.full(P, 3600.0), np.zeros(P)), None)


def ticks(start: Learning, use: Bools, h: float, count: int = 1) -> Learning:
    """Sums after some ticks that count for the meters `use` (p,)."""
    for _ in range(count):
        start = gather(start, np.full(P, 1e-4), use, h, EVERY)
    return start


def test_sums_count_used_readings_and_lost_time() -> None:
    use, why = one(1) | one(4), np.where(one(3), REASONS.index(LearningReason.SUSPECTED), COUNTED)
    found = gather(no_readings(EVERY < 0, 7.0), np.arange(P) * 1.0, use, 2.0, why)
    np.testing.assert_array_equal(found.total, [0.0, 1.0, 0.0, 0.0, 4.0, 0.0])
    np.testing.assert_array_equal(found.count, use)
    np.testing.assert_array_equal(found.time_s, 2.0 * use)
    np.testing.assert_array_equal(found.watched_s, 2.0)
    np.testing.assert_array_equal(found.lost_s.sum(axis=0), 2.0 * one(3))
    assert found.lost_s[REASONS.index(LearningReason.SUSPECTED), 3] == 2.0


def test_a_replaced_meter_has_the_error_of_its_class_and_the_others_keep_theirs() -> None:
    design, rng = prepared(), np.random.default_rng(5)
    before = learned(design, rng)
    known = renew(design, before, one(2), 5000.0)
    assert known.learning is not None
    assert known.learning.open.tolist() == one(2).tolist()
    assert (known.learned.bias[2], known.learned.variance[2]) == (0.0, design.fixed[2])
    assert known.learned.allowed[2] == design.allowed[2]
    for name in ("bias", "variance", "allowed", "at", "hidden"):
        found, was = getattr(known.learned, name), getattr(before.learned, name)
        np.testing.assert_array_equal(found[~one(2)], was[~one(2)])
    learning = ticks(known.learning, EVERY < 0, 100.0, 36)
    assert ready_meters(design, learning).tolist() == one(2).tolist()


def test_a_silent_meter_holds_up_no_other() -> None:
    """The others are ready at the time of commissioning; those with 80 % of it are ready with them."""
    design = prepared()
    learning = ticks(no_readings(EVERY < 0, 0.0), ~one(4), 100.0, 35)
    assert not ready_meters(design, learning).any()
    assert ready_meters(design, ticks(learning, ~one(4), 100.0)).tolist() == (~one(4)).tolist()
    late = ticks(ticks(no_readings(EVERY < 0, 0.0), EVERY < 0, 100.0, 30), ~one(4), 100.0, 6)
    assert ready_meters(design, late).all()


def test_two_replaced_at_different_times_keep_their_own_time() -> None:
    design = prepared()
    known = renew(design, learned(design, np.random.default_rng(6)), one(0), 4000.0)
    assert known.learning is not None
    half = ticks(known.learning, EVERY < 0, 1800.0)
    both = renew(design, Commission(known.learned, half), one(3), 5800.0)
    assert both.learning is not None
    np.testing.assert_array_equal(both.learning.time_s[[0, 1, 3]], [1800.0, 1800.0, 0.0])
    np.testing.assert_array_equal(both.learning.since[[0, 1, 3]], [4000.0, np.nan, 5800.0])
    later = ticks(both.learning, EVERY < 0, 1800.0)
    assert ready_meters(design, later).tolist() == one(0).tolist()


def test_where_nothing_is_learned_nothing_is_begun_anew() -> None:
    design = prepared(0.0)
    known = initial(design, 0.0)
    assert known.learning is None
    assert renew(design, known, one(1), 1.0) is known
    assert not ready_meters(design, no_readings(EVERY < 0, 0.0)).any()


def test_what_is_learned_survives_where_nothing_is_ever_learned() -> None:
    design = prepared(0.0)
    before = initial(design, 0.0)
    after = from_arrays(design, to_arrays(before))
    assert after.learning is None
    for name in ("bias", "variance", "allowed", "at"):
        np.testing.assert_array_equal(getattr(after.learned, name), getattr(before.learned, name))
    with refused(InputInvalid, "inconsistent"):
        from_arrays(prepared(), to_arrays(before))


class TestArrays:
    def test_there_and_back(self) -> None:
        design = prepared()
        for known in (
            initial(design, 7.0),
            learned(design, np.random.default_rng(1)),
            renew(design, learned(design, np.random.default_rng(2)), one(1), 9.0),
        ):
            found = from_arrays(design, to_arrays(known))
            assert (found.learning is None) == (known.learning is None)
            for name, value in to_arrays(known).items():
                np.testing.assert_array_equal(to_arrays(found)[name], value)

    @pytest.mark.parametrize(
        ("name", "value", "codes"),
        [
            ("bias", np.inf, ("out-of-range",)),
            ("bias", 0.5, ("out-of-range",)),
            ("variance", np.nan, ("out-of-range",)),
            ("variance", -1.0, ("out-of-range",)),
            ("allowed", 1.0, ("out-of-range",)),
            ("hidden", np.nan, ("negative",)),
            ("hidden", -1.0, ("negative",)),
            ("at", np.inf, ("not-finite", "inconsistent")),
            ("since", 5.0, ("inconsistent",)),
            ("total", np.nan, ("not-finite",)),
            ("count", 1.5, ("not-integer",)),
            ("time_s", -1.0, ("negative",)),
        ],
    )
    def test_what_cannot_be_is_refused(self, name: str, value: float, codes: tuple[str, ...]) -> None:
        design = prepared()
        arrays = to_arrays(learned(design, np.random.default_rng(1)))
        arrays[name] = np.where(one(3), value, arrays[name])
        with refused(InputInvalid, *codes) as caught:
            from_arrays(design, arrays)
        assert all(problem.endswith("(meters 3)") for problem in caught.value.problems)

    def test_all_problems_at_once(self) -> None:
        design = prepared()
        arrays = to_arrays(initial(design, 0.0))
        del arrays["bias"]
        arrays |= {"more": np.zeros(P), "count": np.zeros(P + 1)}
        with refused(InputInvalid, "missing", "unknown-name", "shape"):
            from_arrays(design, arrays)
