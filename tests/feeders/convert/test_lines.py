"""Lines between the same buses as one: what it carries before one of them is full."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from feeders.convert.lines import merged
from feeders.convert.provenance import Changes, ConversionChange
from feeders.format.tables import LineRow
from feeders.model.three_phase import series_of

NAMES = ("aa", "ab", "ac", "bb", "bc", "cc")
POLE: dict[str, Any] = {
    **{f"r_{name}_ohm": 0.1 if name[0] == name[1] else 0.02 for name in NAMES},
    **{
        f"x_{name}_ohm": value for name, value in zip(NAMES, (0.12, 0.05, 0.03, 0.1, 0.04, 0.11), strict=True)
    },
}
BC: dict[str, Any] = {name: value for name, value in POLE.items() if "a" not in name.split("_")[1]}
LINE = LineRow("one", "s", "t", 0.08, 0.07, rating_a=200.0, **POLE)


def joined(*rows: LineRow) -> tuple[LineRow, list[ConversionChange]]:
    changes = Changes()
    (row,) = merged(rows, "s", changes, {"s": 230.0, "t": 230.0})
    return row, [each for each in changes if each.prop == "rating"]


def halved(row: LineRow) -> LineRow:
    return replace(row, **{name: value / 2.0 for name, value in POLE.items()})


def test_lines_of_matrices_share_the_current_by_their_admittances() -> None:
    twin = replace(LINE, line="two")
    assert joined(LINE, twin)[0].rating_a == pytest.approx(400.0)
    # Half the impedance takes two thirds of the current: 200 A there are 300 A of both.
    row, told = joined(LINE, halved(twin))
    assert row.rating_a == pytest.approx(300.0)
    assert told == []


def test_a_line_without_a_rating_leaves_none_to_those_beside_it() -> None:
    assert joined(LINE, replace(LINE, line="two", rating_a=None))[0].rating_a is None


def test_a_rating_is_told_as_approximated_where_the_conductors_are_not_alike() -> None:
    turned = {name: POLE[f"{name[:2]}{pair}_ohm"] for name, pair in zip(POLE, 2 * NAMES[::-1], strict=True)}
    other = replace(LINE, line="two", rating_a=150.0, **turned)
    row, told = joined(LINE, other)
    # Balanced voltages along both lines: what each conductor carries, and all of them together.
    z = [series_of(each) for each in (LINE, other)]
    both = np.linalg.inv(sum(np.linalg.inv(each) for each in z))
    drop = both @ np.exp(-2j * np.pi / 3.0 * np.arange(3))
    own = [np.abs(np.linalg.solve(each, drop)).max() for each in z]
    assert row.rating_a == pytest.approx(min(200.0 / own[0], 150.0 / own[1]))
    assert [(each.element, each.done) for each in told] == [("lines one + two", "approximated")]


def test_a_line_of_one_phase_beside_another_is_told() -> None:
    single = LineRow("two", "s", "t", 0.1, 0.1, phases="a", rating_a=50.0)
    row, told = joined(replace(single, line="one", phases="bc", rating_a=60.0, **BC), single)
    assert row.rating_a == 50.0
    assert len(told) == 1
    row, told = joined(replace(single, line="one", phases="bc", rating_a=50.0, **BC), single)
    assert row.rating_a == 50.0
    assert told == []
