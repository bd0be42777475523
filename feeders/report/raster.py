"""A drawing as PNG, on white, twice as sharp as its px; with matplotlib, where it is installed."""

from __future__ import annotations

import math
from typing import Any, Final

from feeders.report.drawing import LIGHT, LOOKS, Area, Disc, Drawing, Line, Mark
from gridsec.papers import draw

__all__ = ["available", "png"]

SCALE: Final = 2.0
_POINTS: Final = 0.72  # of one px on a sheet of 100 px per inch
_SIDES: Final = 48


def available() -> bool:
    """Whether PNG can be made: matplotlib is installed."""
    return draw.available()


def png(drawing: Drawing, *, title: str, text: str) -> bytes:
    """Make a PNG of a drawing; the same drawing gives the same bytes.

    Parameters
    ----------
    drawing
        What to draw.
    title, text
        Kept in the file.

    Raises
    ------
    ModuleNotFoundError
        matplotlib is not installed; see `available`.
    """

    def marks(axes: Any) -> None:
        for k, mark in enumerate(drawing.marks):
            _draw(axes, mark, float(k))

    about = {"Title": title, "Description": text, "Software": None}
    return draw.sheet(drawing.width, drawing.height, marks, scale=SCALE, about=about)


def _draw(axes: Any, mark: Mark, order: float) -> None:
    look = LOOKS[mark.look]
    fill = LIGHT.get(look.fill, "none")
    if isinstance(mark, Line):
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
            fontsize=_POINTS * mark.size * 0.94,  # DejaVu is wider than what screens use
            ha=side,
            va="baseline",
            weight="bold" if look.bold else "normal",
            zorder=order,
            parse_math=False,
            bbox=halo if look.halo else None,
        )


def _circle(disc: Disc) -> list[tuple[float, float]]:
    angles = [2.0 * math.pi * k / _SIDES for k in range(_SIDES)]
    return [(disc.x + disc.r * math.cos(a), disc.y + disc.r * math.sin(a)) for a in angles]
