"""Charts: rows of bars, and curves; axes with round numbers, and legends."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from feeders.report.drawing import Area, Disc, Drawing, Mark, Polyline, Text, regular, width_of

LINES: Final = ("line-a", "line-b", "line-c", "line-d", "line-ink", "line-bad", "line-wire", "line-s")
"""Looks of curves, different in colour and dashes."""

_LETTERS: Final = 11.5
_ROW: Final = 19.0


@dataclass(frozen=True, slots=True)
class Bar:
    """Part of a row, from one value to another."""

    # The values.
    low: float
    high: float
    look: str  # one of the looks of drawings
    meaning: str  # text in the legend
    tip: str = ""  # text of the tooltip
    inset: float = 3.0  # distance of the bar from the row's edges, px


@dataclass(frozen=True, slots=True)
class ChartRow:
    """Row of a chart: bars, and a number at their end."""

    label: str
    bars: tuple[Bar, ...]
    shown: str = ""
    tip: str = ""


def rows(
    data: Sequence[ChartRow],
    width: float,
    *,
    axis: str,
    start: float = 0.0,
    limits: Mapping[str, Sequence[float]] | None = None,
) -> Drawing:
    """Draw rows of bars, finite values from `start` on, over one axis on a sheet `width` px wide.

    `limits` are values with a line through all rows, by meaning; values beyond the axis are left out.
    """
    left = min(max((width_of(row.label, _LETTERS) for row in data), default=0.0), 0.36 * width) + 12.0
    right = max((width_of(row.shown, _LETTERS) for row in data), default=0.0) + 14.0
    high = max((bar.high for row in data for bar in row.bars), default=1.0)
    steps = [v for v in ticks(start, high, 4 if width < 500.0 else 7) if v >= start - 1e-9 * abs(start)]
    end = max(high, *steps)
    scale = (width - left - right) / ((end - start) or 1.0)
    bottom = 30.0 + _ROW * len(data)

    def at(value: float) -> float:
        return left + (value - start) * scale

    marks: list[Mark] = [Text(max(min(left, width - width_of(axis) - 4.0), 2.0), 13.0, axis, "quiet")]
    marks += [Polyline(((at(v), 24.0), (at(v), bottom)), "grid") for v in steps]
    for k, row in enumerate(data):
        y = 30.0 + _ROW * k
        marks.append(Text(left - 7.0, y + 12.5, _cut(row.label, left - 12.0), "text", "end", _LETTERS))
        for bar in row.bars:
            (a, b), (above, below) = (at(bar.low), at(bar.high)), (y + bar.inset, y + _ROW - bar.inset)
            corners = ((a, above), (b, above), (b, below), (a, below))
            marks.append(Area(corners, bar.look, f"{row.label}: {bar.tip or bar.meaning}"))
        furthest = max((bar.high for bar in row.bars), default=start)
        marks.append(Text(at(furthest) + 6.0, y + 12.5, row.shown, "text", size=_LETTERS))
    marks += [Text(at(v), bottom + 15.0, _tick(v, steps), "quiet", "middle", _LETTERS) for v in steps]
    meanings = {bar.meaning: bar.look for row in data for bar in row.bars}
    for meaning, values in (limits or {}).items():
        inside = [v for v in values if start <= v <= end]
        marks += [Polyline(((at(v), 24.0), (at(v), bottom)), "limit", meaning) for v in inside]
        meanings |= dict.fromkeys([meaning] * len(inside), "limit")
    extra, height = _legend(meanings, bottom + 24.0, width) if len(meanings) > 1 else ([], bottom + 24.0)
    return Drawing(width, height, (*marks, *extra))


@dataclass(frozen=True, slots=True)
class Curve:
    """Curve; `look` is one of LINES, or limit; with `points` its points have a shape."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    look: str
    meaning: str
    points: bool = False


def curves(
    data: Sequence[Curve],
    width: float,
    *,
    x: str,
    y: str,
    low: float | None = None,
    high: float | None = None,
    decades: bool = False,
) -> Drawing:
    """Draw curves on a sheet `width` px wide; a value that is not finite makes a gap.

    `low` and `high` are values within the range of the ordinate. With `decades` abscissas are decimal
    logarithms.
    """
    xs = [v for c in data for v in c.x if math.isfinite(v)] or [0.0, 1.0]
    ys = [v for c in data for v in c.y if math.isfinite(v)] or [0.0, 1.0]
    ys += [v for v in (low, high) if v is not None]
    across = ticks(min(xs), max(xs), 4 if width < 500.0 else 8)
    if decades:
        across = [float(k) for k in range(math.floor(min(xs)), math.ceil(max(xs)) + 1)]
    up = ticks(min(ys), max(ys), 5)
    left = max(width_of(_tick(v, up), _LETTERS) for v in up) + 14.0
    top, bottom = 26.0, 0.42 * width + 60.0
    x0, x1 = min(*xs, across[0]), max(*xs, across[-1])
    y0, y1 = min(*ys, up[0]), max(*ys, up[-1])

    def at(px: float, py: float) -> tuple[float, float]:
        return (
            left + (px - x0) / ((x1 - x0) or 1.0) * (width - left - 16.0),
            bottom - (py - y0) / ((y1 - y0) or 1.0) * (bottom - top),
        )

    marks: list[Mark] = [Text(2.0, 13.0, y, "quiet")]
    marks += [Polyline((at(x0, v), at(x1, v)), "grid") for v in up]
    marks.append(Polyline((at(x0, y0), at(x1, y0)), "axis"))
    marks += [Text(left - 7.0, at(x0, v)[1] + 4.0, _tick(v, up), "quiet", "end", _LETTERS) for v in up]
    for v in across:
        name = f"{10.0**v:g}" if decades else _tick(v, across)
        marks.append(Text(at(v, y0)[0], bottom + 16.0, name, "quiet", "middle", _LETTERS))
    marks.append(Text(width - 16.0, bottom + 33.0, x, "quiet", "end"))
    for curve in data:
        marks += _curve(curve, at)
    meanings = {curve.meaning: curve.look for curve in data}
    extra, height = _legend(meanings, bottom + 42.0, width) if len(meanings) > 1 else ([], bottom + 42.0)
    return Drawing(width, height, (*marks, *extra))


def _curve(curve: Curve, at: Callable[[float, float], tuple[float, float]]) -> list[Mark]:
    marks: list[Mark] = []
    piece: list[tuple[float, float]] = []
    for x, y in [*zip(curve.x, curve.y, strict=True), (math.nan, math.nan)]:
        if math.isfinite(x) and math.isfinite(y):
            piece.append(at(x, y))
            continue
        if len(piece) > 1:
            marks.append(Polyline(tuple(piece), curve.look))
        if curve.points or len(piece) == 1:
            marks += [_point(curve.look, px, py) for px, py in piece]
        piece = []
    return marks


def _point(look: str, x: float, y: float) -> Mark:
    """Mark of a point; curves also differ in the shape of their points."""
    fill = look.replace("line-", "fill-") if look in {"line-a", "line-b", "line-c", "line-d"} else "fill-bad"
    if look == "line-b":
        return Area(regular(x, y, 4.6, 4, turn=0.5), fill)
    if look == "line-c":
        return Area(regular(x, y, 5.0, 3), fill)
    if look == "line-d":
        return Area(regular(x, y, 5.0, 4), fill)
    return Disc(x, y, 3.6, fill)


def _legend(meanings: dict[str, str], top: float, width: float) -> tuple[list[Mark], float]:
    x, y, marks = 12.0, top + 12.0, list[Mark]()
    for meaning, look in meanings.items():
        long = 26.0 + width_of(meaning)
        if x > 12.0 and x + long > width - 4.0:
            x, y = 12.0, y + 20.0
        if look.startswith("line") or look == "limit":
            marks.append(Polyline(((x, y - 4.0), (x + 20.0, y - 4.0)), look))
        else:
            corners = ((x, y - 10.0), (x + 16.0, y - 10.0), (x + 16.0, y + 1.0), (x, y + 1.0))
            marks.append(Area(corners, look))
        marks.append(Text(x + 25.0, y, meaning, "quiet"))
        x += long + 14.0
    return marks, y + 10.0


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers from the last one below `low` to the last one below `high`, about `most` of them."""
    span = (high - low) or abs(high) or 1.0
    raw = span / most
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(f * size for f in (1.0, 2.0, 5.0, 10.0) if f * size >= raw * (1.0 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, max(last, first + 1) + 1)]


def _tick(value: float, every: Sequence[float]) -> str:
    step = abs(every[1] - every[0]) if len(every) > 1 else 1.0
    digits = max(0, -math.floor(math.log10(step) + 1e-9)) if step else 0
    return f"{value:.{digits}f}".replace("-", "−")


def _cut(text: str, room: float) -> str:
    """Label, shortened at its begin to the available width."""
    if width_of(text, _LETTERS) <= room:
        return text
    while text and width_of(f"…{text}", _LETTERS) > room:
        text = text[1:]
    return f"…{text}"
