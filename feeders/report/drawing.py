"""Drawings as lists of marks, as SVG and PNG, and figures of the report.

A mark has a named look. Colours are from two palettes, for light and for dark surroundings. Marks are
independent of feeders.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any, Final

from gridsec.papers import draw

Point = tuple[float, float]

STEPS: Final = 5
"""Number of steps of a size scale; each has its own colour and size."""

LIGHT: Final = {
    "card": "#ffffff",
    "ink": "#16202b",
    "quiet": "#5a6673",
    "line": "#d9dfe5",
    "soft": "#edf0f3",
    "wire": "#8793a0",
    "a": "#0b5cad",
    "b": "#b45309",
    "c": "#1c6b50",
    "d": "#8a3d7d",
    "bad": "#a1182f",
    "on": "#ffffff",
    "s0": "#f4ead9",
    "s1": "#efc78f",
    "s2": "#e2933f",
    "s3": "#b85714",
    "s4": "#6f2a00",
}
DARK: Final = {
    "card": "#18212a",
    "ink": "#e8edf2",
    "quiet": "#9dabb8",
    "line": "#2c3844",
    "soft": "#26313b",
    "wire": "#687685",
    "a": "#6db3f8",
    "b": "#f0a04b",
    "c": "#7fdcb4",
    "d": "#e0a3d6",
    "bad": "#ff98a5",
    "on": "#0f151b",
    "s0": "#3b342a",
    "s1": "#6b4c26",
    "s2": "#a86c28",
    "s3": "#e39a41",
    "s4": "#ffd796",
}


@dataclass(frozen=True, slots=True)
class Look:
    """Look of a mark. Colours are names of the palettes; empty: none."""

    fill: str = ""
    stroke: str = ""
    width: float = 1.0
    dash: str = ""
    halo: bool = False


LOOKS: Final[dict[str, Look]] = {
    "axis": Look(stroke="quiet"),
    "grid": Look(stroke="line"),
    "limit": Look(stroke="bad", width=1.5, dash="6 4"),
    "wire": Look(stroke="wire", width=2.2),
    "drop": Look(stroke="wire", width=1.2),
    "busbar": Look(stroke="ink", width=5.0),
    "text": Look(fill="ink"),
    "quiet": Look(fill="quiet"),
    "label": Look(fill="ink", halo=True),
    "none": Look(fill="card", stroke="wire", width=1.2),
    "plain": Look(fill="card", stroke="ink", width=1.4),
    "solid": Look(fill="a", stroke="a", width=1.4),
    "shield": Look(fill="c", stroke="c", width=1.4),
    "tick": Look(stroke="on", width=1.8),
    "alarm": Look(fill="bad", stroke="bad", width=1.4),
    "band0": Look(fill="s1"),
    "band1": Look(fill="s0", stroke="s2", width=0.8),
    "band2": Look(fill="soft", stroke="wire", width=0.8),
    "fill-a": Look(fill="a"),
    "fill-b": Look(fill="b"),
    "fill-c": Look(fill="c"),
    "fill-d": Look(fill="d"),
    "fill-bad": Look(fill="bad"),
    "fill-soft": Look(fill="line"),
    "fill-ink": Look(fill="ink"),
    "fill-wire": Look(fill="wire"),
    "line-a": Look(stroke="a", width=2.0),
    "line-b": Look(stroke="b", width=2.0, dash="7 3"),
    "line-c": Look(stroke="c", width=2.0, dash="2 3"),
    "line-d": Look(stroke="d", width=2.0, dash="9 3 2 3"),
    "line-ink": Look(stroke="ink", width=1.4),
    "line-bad": Look(stroke="bad", width=2.0, dash="12 4"),
    "line-wire": Look(stroke="wire", width=2.4, dash="4 4"),
    "line-s": Look(stroke="s3", width=2.0, dash="1 4"),
    **{f"step{k}": Look(fill=f"s{k}", stroke="ink", width=0.9) for k in range(STEPS)},
}


@dataclass(frozen=True, slots=True)
class Polyline:
    """Polyline; `tip` is its tooltip."""

    points: tuple[Point, ...]
    look: str
    tip: str = ""


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon."""

    points: tuple[Point, ...]
    look: str
    tip: str = ""


@dataclass(frozen=True, slots=True)
class Disc:
    """A circle of radius r."""

    x: float
    y: float
    r: float
    look: str
    tip: str = ""


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text; y is its base line, `anchor` one of start, middle, end."""

    x: float
    y: float
    text: str
    look: str = "text"
    anchor: str = "start"
    size: float = 12.0


Mark = Polyline | Area | Disc | Text


@dataclass(frozen=True, slots=True)
class Drawing:
    """Marks on a sheet, in px from its upper left corner."""

    width: float
    height: float
    marks: tuple[Mark, ...]


def regular(x: float, y: float, r: float, corners: int, *, turn: float = 0.0) -> tuple[Point, ...]:
    """Corners of a regular polygon around (x, y); the first is above the centre, turned by `turn` corners."""
    angles = [2.0 * math.pi * (k + turn) / corners - 0.5 * math.pi for k in range(corners)]
    return tuple((x + r * math.cos(angle), y + r * math.sin(angle)) for angle in angles)


def width_of(text: str, size: float = 12.0) -> float:
    """Approximate width of a text, px, for a plain sans serif; rather too wide than too narrow."""
    narrow = sum(letter in "iljtf.,:;'|!()[] " for letter in text)
    wide = sum(letter in "mwMW%@" or ord(letter) > 0x2E80 for letter in text)
    return size * (0.59 * (len(text) - narrow - wide) + 0.34 * narrow + 0.95 * wide)


def style(scope: str = "") -> str:
    """Style sheet of all looks, light and dark, below a selector, or for a whole document."""
    root = scope or ":root"
    before = f"{scope} " if scope else ""
    lines = [f"{root} {{ {_variables(LIGHT)} }}"]
    lines.append(f"@media screen and (prefers-color-scheme: dark) {{ {root} {{ {_variables(DARK)} }} }}")
    fonts = "system-ui, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"
    lines.append(f"{before}text {{ font-family: {fonts}; }}")
    lines += [f"{before}.g-{name} {{ {_rule(look)} }}" for name, look in LOOKS.items()]
    return "\n".join(lines)


def _variables(palette: dict[str, str]) -> str:
    return " ".join(f"--g-{name}: {colour};" for name, colour in palette.items())


def _rule(look: Look) -> str:
    parts = [f"fill: {f'var(--g-{look.fill})' if look.fill else 'none'};"]
    if look.stroke:
        parts.append(f"stroke: var(--g-{look.stroke}); stroke-width: {look.width:g}; stroke-linejoin: round;")
    if look.stroke and not look.dash:
        parts.append("stroke-linecap: round;")
    if look.dash:
        parts.append(f"stroke-dasharray: {look.dash};")
    if look.halo:
        parts.append("paint-order: stroke; stroke: var(--g-card); stroke-width: 3px; stroke-linejoin: round;")
    return " ".join(parts)


def svg(drawing: Drawing, *, title: str, text: str, key: str, alone: bool = False) -> str:
    """Write a drawing as SVG with a title, and a text for screen readers.

    `key` is a prefix of ids, unique in the document: letters, digits and hyphens. With `alone` the drawing is
    a file of its own, with style sheet and background.
    """
    width, height = _number(drawing.width), _number(drawing.height)
    head = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" role="img" aria-labelledby="{key}-t {key}-d">',
        f'<title id="{key}-t">{_plain(title)}</title>',
        f'<desc id="{key}-d">{_plain(text)}</desc>',
    ]
    if alone:
        head.append(f"<style>{style()}</style>")
        head.append(f'<rect width="{width}" height="{height}" style="fill: var(--g-card)"/>')
    return "\n".join([*head, *_merged(drawing.marks), "</svg>"]) + "\n"


def _merged(marks: Sequence[Mark]) -> Iterable[str]:
    """Write marks; successive ones of equal look without a tip share one path."""
    for look, some in groupby(marks, _shared_look):
        if look:
            parts = [_path(mark) for mark in some if isinstance(mark, Polyline | Area)]
            yield f'<path class="g-{look}" d="{"".join(parts)}"/>'
        else:
            yield from map(_element, some)


def _shared_look(mark: Mark) -> str:
    return mark.look if isinstance(mark, Polyline | Area) and not mark.tip else ""


def _element(mark: Mark) -> str:
    if isinstance(mark, Text):
        anchor = "" if mark.anchor == "start" else f' text-anchor="{mark.anchor}"'
        return (
            f'<text class="g-{mark.look}" x="{_number(mark.x)}" y="{_number(mark.y)}" '
            f'font-size="{_number(mark.size)}"{anchor}>{_plain(mark.text)}</text>'
        )
    tip = f"<title>{_plain(mark.tip)}</title>" if mark.tip else ""
    if isinstance(mark, Disc):
        x, y, r = map(_number, (mark.x, mark.y, mark.r))
        what = f'<circle class="g-{mark.look}" cx="{x}" cy="{y}" r="{r}"'
        return f"{what}>{tip}</circle>" if tip else f"{what}/>"
    what = f'<path class="g-{mark.look}" d="{_path(mark)}"'
    return f"{what}>{tip}</path>" if tip else f"{what}/>"


def _path(mark: Polyline | Area) -> str:
    steps = " ".join(f"{_number(x)} {_number(y)}" for x, y in mark.points)
    return f"M{steps}{'Z' if isinstance(mark, Area) else ''}"


def _number(value: float) -> str:
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _plain(text: str) -> str:
    """Text for XML: escaped, and without characters that are invalid in XML."""
    return escape(re.sub("[\x00-\x1f\ufffe\uffff]", "\ufffd", text))


WIDE: Final = 720.0
"""Width of a drawing on a screen or on paper, px."""
NARROW: Final = 350.0
"""Width on a phone, px: a separate drawing, not a smaller image, so that it is legible."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Figure of the report."""

    name: str  # name of its files: letters, digits and hyphens
    title: str  # title in a few words
    text: str  # description, for screen readers; also printed below it
    draw: Callable[[float], Drawing]  # draws it for a width, px


SCALE: Final = 2.0
_POINTS: Final = 0.72  # points per px on a sheet of 100 px per inch
_SIDES: Final = 48


def png(drawing: Drawing, *, title: str, text: str) -> bytes:
    """Draw a PNG with a title and a text as metadata; equal drawings give equal bytes. Needs matplotlib."""
    return _sheet(drawing, "png", {"Title": title, "Description": text, "Software": None})


def pdf(drawing: Drawing, *, title: str, text: str) -> bytes:
    """Draw a PDF with vector graphics, as `png`."""
    about = {"Title": title, "Subject": text, "Creator": None, "Producer": None, "CreationDate": None}
    return _sheet(drawing, "pdf", about)


def _sheet(drawing: Drawing, form: str, about: dict[str, str | None]) -> bytes:

    def marks(axes: Any) -> None:
        for k, mark in enumerate(drawing.marks):
            _draw(axes, mark, float(k))

    return draw.sheet(drawing.width, drawing.height, marks, scale=SCALE, about=about, form=form)


def _draw(axes: Any, mark: Mark, order: float) -> None:
    look = LOOKS[mark.look]
    fill = LIGHT.get(look.fill, "none")
    if isinstance(mark, Polyline):
        stroke: dict[str, Any] = {"color": LIGHT[look.stroke], "linewidth": _POINTS * look.width}
        if look.dash:
            gaps = [float(length) / look.width for length in look.dash.split()]
            stroke |= {"linestyle": (0.0, gaps), "dash_capstyle": "butt"}
        x, y = zip(*mark.points, strict=True)
        axes.plot(x, y, zorder=order, solid_capstyle="round", solid_joinstyle="round", **stroke)
    elif isinstance(mark, Area | Disc):
        points = mark.points if isinstance(mark, Area) else _circle(mark)
        x, y = zip(*points, strict=True)
        edge = LIGHT.get(look.stroke, "none")
        axes.fill(x, y, facecolor=fill, edgecolor=edge, linewidth=_POINTS * look.width, zorder=order)
    else:
        side = {"start": "left", "middle": "center", "end": "right"}[mark.anchor]
        halo = {"facecolor": LIGHT["card"], "edgecolor": "none", "alpha": 0.75, "pad": 0.6}
        axes.text(
            mark.x,
            mark.y,
            mark.text,
            color=fill,
            fontsize=_POINTS * mark.size * 0.94,  # DejaVu is wider than the fonts of screens
            ha=side,
            va="baseline",
            zorder=order,
            parse_math=False,
            bbox=halo if look.halo else None,
        )


def _circle(disc: Disc) -> list[tuple[float, float]]:
    angles = [2.0 * math.pi * k / _SIDES for k in range(_SIDES)]
    return [(disc.x + disc.r * math.cos(a), disc.y + disc.r * math.sin(a)) for a in angles]
