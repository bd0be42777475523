"""Results of a reproduction: claims with the paper's numbers beside the computed ones, and data of figures.

Every module of this package has `reproduce() -> Reproduction`. Nothing here draws or prints.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gridsec.arrays import Floats
from gridsec.errors import InputInvalid

Style = Literal["solid", "dashed", "dotted", "dashdot", "points", "steps"]


@dataclass(frozen=True, slots=True)
class Claim:
    """One statement of a paper beside the computed result."""

    what: str  # the quantity or statement, in words
    where: str  # its place in the paper: equation, section, table, figure
    printed: float | str  # the printed value or statement
    ours: float | str  # the computed value or statement
    met: bool  # True if the two agree, numbers to the printed digits
    # known reason of a disagreement: an erratum, or a choice that the paper leaves open. A claim that is not
    # met and has no reason is a failure of this project
    why: str = ""
    # required relation of `ours` to the printed number: equal to the digits, or at most it
    relation: Literal["=", "<="] = "="


@dataclass(frozen=True, slots=True, eq=False)
class FigureCurve:
    """One curve.

    Raises ValueError if x and y differ in their shapes.
    """

    label: str  # for the legend; empty for none
    x: Floats  # (k,) abscissas
    y: Floats  # (k,) ordinates; NaN interrupts the curve
    style: Style = "solid"  # "points" has markers only, "steps" holds each value until the next point

    def __post_init__(self) -> None:
        x, y = np.asarray(self.x, dtype=np.float64), np.asarray(self.y, dtype=np.float64)
        if x.ndim != 1 or x.shape != y.shape:
            raise InputInvalid.of(
                "shape", f"line {self.label!r}: x has shape {x.shape}, y has shape {y.shape}"
            )
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "y", y)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One pair of axes with its curves."""

    title: str  # text above the axes
    x_label: str  # with the unit
    y_label: str  # with the unit
    lines: tuple[FigureCurve, ...]  # the curves


@dataclass(frozen=True, slots=True, eq=False)
class PaperFigure:
    """Panels of one figure, drawn one below the other."""

    name: str  # file stem, for example "kim2018-figure-1"; letters, digits and hyphens
    caption: str  # content in one sentence
    panels: tuple[Panel, ...]  # from top to bottom


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """Results of one paper's examples."""

    paper: str  # short name, for example "kim2018"
    claims: tuple[Claim, ...]  # its numbers and statements beside the computed ones
    figures: tuple[PaperFigure, ...] = field(default=())  # data of its figures

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

    printed: the number in the paper.
    ours: the number computed here.
    unit: worth of one step in the last printed digit: 1.0 for "671", 1e-6 for "4.74e-4".
    Met when `|ours - printed| <= unit / 2`, with a part in 1e9 for rounding of the comparison.
    """
    half = 0.5 * unit * (1.0 + 1e-9)
    return Claim(what, where, printed, float(ours), bool(abs(ours - printed) <= half))


def statement(what: str, where: str, printed: str, ours: str, why: str = "") -> Claim:
    """Claim in words, met if both texts are the same."""
    return Claim(what, where, printed, ours, printed == ours, why)


def rounded_up(what: str, where: str, printed: float, ours: float, *, unit: float) -> Claim:
    """Claim about a printed upper bound, met if `ours`, rounded up, equals it.

    unit: worth of one step in the last printed digit.
    Met when `printed - unit < ours <= printed`, with a part in 1e9 for rounding.
    """
    slack = 1e-9 * unit
    met = bool(printed - unit < ours + slack <= printed + 2.0 * slack)
    return Claim(what, where, printed, float(ours), met, relation="<=")


def at_most(what: str, where: str, printed: float, ours: float) -> Claim:
    """Claim that a number is an upper bound, met if `ours` does not exceed it."""
    return Claim(what, where, printed, float(ours), bool(ours <= printed), relation="<=")
