"""Results of a reproduction: claims with the paper's numbers beside the computed ones, and data of figures.

Every module of this package has `reproduce() -> Reproduction`. Nothing here draws or prints.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid, Problem

Style = Literal["solid", "dashed", "dotted", "dashdot", "points", "steps"]


@dataclass(frozen=True, slots=True)
class Claim:
    """One statement of a paper beside the computed result.

    Attributes
    ----------
    what
        The quantity or statement, in words.
    where
        Its place in the paper: equation, section, table, figure.
    printed
        The printed value or statement.
    ours
        The computed value or statement.
    met
        True if the two agree, numbers to the printed digits.
    why
        Known reason of a disagreement: an erratum, or a choice that the paper leaves open. A claim that is
        not met and has no reason is a failure of this project.
    relation
        Required relation of `ours` to the printed number: equal to the digits, or at most it.
    """

    what: str
    where: str
    printed: float | str
    ours: float | str
    met: bool
    why: str = ""
    relation: Literal["=", "<="] = "="


@dataclass(frozen=True, slots=True, eq=False)
class FigureCurve:
    """One curve.

    Attributes
    ----------
    label
        For the legend; empty for none.
    x, y : (k,)
        Its points; NaN in `y` interrupts it.
    style
        "points" has markers only, "steps" holds each value until the next point.

    Raises
    ------
    ValueError
        If x and y differ in their shapes.
    """

    label: str
    x: Floats
    y: Floats
    style: Style = "solid"

    def __post_init__(self) -> None:
        x, y = np.asarray(self.x, dtype=np.float64), np.asarray(self.y, dtype=np.float64)
        if x.ndim != 1 or x.shape != y.shape:
            raise InputInvalid(
                [Problem("shape", f"line {self.label!r}: x has shape {x.shape}, y has shape {y.shape}")]
            )
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "y", y)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One pair of axes with its curves.

    Attributes
    ----------
    title, x_label, y_label
        Texts, units included.
    lines
        The curves.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[FigureCurve, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PaperFigure:
    """Panels of one figure, drawn one below the other.

    Attributes
    ----------
    name
        File stem, for example "kim2018-figure-1"; letters, digits and hyphens.
    caption
        Content in one sentence.
    panels
        From top to bottom.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """Results of one paper's examples.

    Attributes
    ----------
    paper
        Short name, for example "kim2018".
    claims
        Its numbers and statements beside the computed ones.
    figures
        Data of its figures.
    """

    paper: str
    claims: tuple[Claim, ...]
    figures: tuple[PaperFigure, ...] = field(default=())

    @property
    def unmet(self) -> tuple[Claim, ...]:
        """Claims that are not met."""
        return tuple(claim for claim in self.claims if not claim.met)

    @property
    def unexplained(self) -> tuple[Claim, ...]:
        """Claims that are not met, without a stated reason."""
        return tuple(claim for claim in self.unmet if not claim.why)


def number(what: str, where: str, printed: float, ours: float, *, unit: float) -> Claim:
    """Claim about a printed number, met if `ours` rounds to it.

    Parameters
    ----------
    what, where
        As in `Claim`.
    printed
        The number in the paper.
    ours
        The number computed here.
    unit
        Worth of one step in the last printed digit: 1.0 for "671", 1e-6 for "4.74e-4".

    Returns
    -------
    Claim
        Met when `|ours - printed| <= unit / 2`, with a part in 1e9 for rounding of the comparison.
    """
    half = 0.5 * unit * (1.0 + 1e-9)
    return Claim(what, where, printed, float(ours), bool(abs(ours - printed) <= half))


def statement(what: str, where: str, printed: str, ours: str, why: str = "") -> Claim:
    """Claim in words, met if both texts are the same.

    Parameters
    ----------
    what, where
        As in `Claim`.
    printed, ours
        The two texts, for example "1 -> 2 -> 3".
    why
        As in `Claim`.
    """
    return Claim(what, where, printed, ours, printed == ours, why)


def rounded_up(what: str, where: str, printed: float, ours: float, *, unit: float) -> Claim:
    """Claim about a printed upper bound, met if `ours`, rounded up, equals it.

    Parameters
    ----------
    what, where, printed, ours
        As in `Claim`.
    unit
        Worth of one step in the last printed digit.

    Returns
    -------
    Claim
        Met when `printed - unit < ours <= printed`, with a part in 1e9 for rounding.
    """
    slack = 1e-9 * unit
    met = bool(printed - unit < ours + slack <= printed + 2.0 * slack)
    return Claim(what, where, printed, float(ours), met, relation="<=")


def at_most(what: str, where: str, printed: float, ours: float) -> Claim:
    """Claim that a number is an upper bound, met if `ours` does not exceed it."""
    return Claim(what, where, printed, float(ours), bool(ours <= printed), relation="<=")
