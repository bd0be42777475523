"""Charts: round numbers, bars and curves where they belong."""

from __future__ import annotations

import math

from hypothesis import assume, given
from hypothesis import strategies as st

from feeders.report.charts import Bar, ChartRow, Curve, curves, rows, ticks
from feeders.report.drawing import Area, Disc, Polyline, Text


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(3, 9))
def test_ticks_are_round_and_cover(low: float, span: float, most: int) -> None:
    high = low + span
    assume(high - low > 1e-9 * abs(low))
    found = ticks(low, high, most)
    step = found[1] - found[0]
    assert 2 <= len(found) <= most + 3
    digit = step / 10.0 ** math.floor(math.log10(step) + 1e-6)
    assert min(abs(digit - d) for d in (1.0, 2.0, 5.0, 10.0)) < 1e-3
    assert found[0] <= low + 1e-6 * span
    assert found[-1] + step > high - 1e-6 * span


def test_bars_are_as_long_as_they_say() -> None:
    data = [
        ChartRow("a", (Bar(0.0, 1.0, "fill-a", "x"), Bar(1.0, 4.0, "fill-b", "y"))),
        ChartRow("b", (Bar(0.0, 2.0, "fill-a", "x"),)),
    ]
    drawing = rows(data, 400.0, axis="V")
    bars = [m for m in drawing.marks if isinstance(m, Area) and m.tip]
    long = [bar.points[1][0] - bar.points[0][0] for bar in bars]
    assert math.isclose(long[1], 3.0 * long[0])
    assert math.isclose(long[2], 2.0 * long[0])
    assert bars[0].points[1][0] == bars[1].points[0][0]
    assert all(0.0 <= x <= 400.0 and 0.0 <= y <= drawing.height for bar in bars for x, y in bar.points)


def test_an_axis_that_does_not_begin_at_zero_has_no_ticks_before_its_beginning() -> None:
    drawing = rows([ChartRow("a", (Bar(-0.38, 0.21, "fill-a", "x"),))], 720.0, axis="%", start=-0.38)
    left = min(x for m in drawing.marks if isinstance(m, Area) for x, _ in m.points)
    grid = [m.points[0][0] for m in drawing.marks if isinstance(m, Polyline)]
    assert len(grid) >= 4
    assert min(grid) >= left


def test_a_curve_has_a_gap_where_nothing_is_known() -> None:
    curve = Curve((0.0, 1.0, 2.0, 3.0, 4.0), (1.0, 2.0, math.nan, 3.0, 4.0), "line-a", "one")
    lone = Curve((0.0, 1.0), (math.inf, 2.0), "line-b", "two")
    drawing = curves([curve, lone], 400.0, x="s", y="V")
    assert sum(isinstance(m, Polyline) and m.look == "line-a" for m in drawing.marks) == 3  # and the legend
    assert sum(isinstance(m, Disc | Area) for m in drawing.marks) == 1
    assert {"one", "two", "s", "V"} <= {m.text for m in drawing.marks if isinstance(m, Text)}


def test_decades() -> None:
    drawing = curves([Curve((0.0, 2.0), (0.0, 100.0), "line-a", "one")], 400.0, x="s", y="%", decades=True)
    assert {"1", "10", "100"} <= {m.text for m in drawing.marks if isinstance(m, Text)}


def test_long_labels_are_cut_at_their_beginning() -> None:
    drawing = rows([ChartRow("street " * 30 + "end", (Bar(0.0, 1.0, "fill-a", "x"),))], 350.0, axis="V")
    label = next(m.text for m in drawing.marks if isinstance(m, Text) and m.anchor == "end")
    assert label.startswith("…")
    assert label.endswith("end")
