"""Figures of the report: a drawing for every width, with a title and what it shows in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from feeders.report.drawing import Drawing

__all__ = ["NARROW", "WIDE", "Figure"]

WIDE: Final = 720.0
"""Width of a drawing on a screen or on paper, px."""
NARROW: Final = 350.0
"""The same on a phone: drawn anew, not shrunk, so that it can be read."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure.

    Attributes
    ----------
    name
        Of its files: letters, digits and hyphens.
    title
        What it is, in a few words.
    text
        What it shows, in words, for those who cannot see it; also printed below it.
    draw
        Draws it, so wide.
    """

    name: str
    title: str
    text: str
    draw: Callable[[float], Drawing]
