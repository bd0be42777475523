"""Texts of the report: sentences with sourced numbers, and sections of studies.

A number in a sentence names the table it was taken from, so that whoever doubts it can look, and a test can.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

from feeders.report.drawing import Figure

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "MANY",
    "Finding",
    "Question",
    "Section",
    "Sentence",
    "Side",
    "Standing",
    "Value",
    "least",
    "listed",
    "most",
    "number",
    "plural",
    "rows",
    "said",
]


MANY: Final = 12
"""So many names are listed in a sentence at most."""


class Standing(Enum):
    """How sure an answer is."""

    PROVED = "proved"
    MEASURED = "measured"
    PART = "partly proved"
    OPEN = "not proved"
    FAILED = "no answer"
    ABSENT = "not studied"


@dataclass(frozen=True, slots=True)
class Value:
    """A number in a sentence.

    Attributes
    ----------
    value
        The number.
    shown
        As it is written, with its unit.
    source
        Table, column, and what was done with it: `detectable-meters:noticed:max`.
    """

    value: float
    shown: str
    source: str


Sentence = tuple[str | Value, ...]


@dataclass(frozen=True, slots=True)
class Finding:
    """An answer of a study.

    Attributes
    ----------
    standing
        How sure it is.
    sentences
        The answer, the most important first.
    """

    standing: Standing
    sentences: tuple[Sentence, ...]


def said(sentence: Sentence) -> str:
    """A sentence as plain text."""
    return "".join(part if isinstance(part, str) else part.shown for part in sentence)


class Side(Enum):
    """Where rounding goes: what is proved up to a number is written with a smaller one, and so on."""

    NEAR = "near"
    BELOW = "below"
    ABOVE = "above"


def number(value: Any, digits: int = 2, side: Side = Side.NEAR) -> str:
    """Write a number: ∞ for none that is finite, a question mark for one that is not known."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "?"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if float(value).is_integer():
        return f"{value + 0.0:.0f}".replace("-", "−")  # no −0
    scale, slack = 10.0**digits, 1e-9 * max(1.0, abs(value))
    if side is Side.BELOW:
        value = math.floor((value + slack) * scale) / scale
    elif side is Side.ABOVE:
        value = math.ceil((value - slack) * scale) / scale
    text = f"{value:.{digits}f}"
    if digits and side is Side.NEAR and float(text) == 0.0:
        text = f"{value:.2g}"
    return text.replace("-", "−")


def plural(size: float, one: str, several: str = "") -> str:
    """One meter, two meters: the noun that goes with a number."""
    return one if size == 1 else several or f"{one}s"


def listed(names: Sequence[str]) -> str:
    """Names in a sentence; from too many on, the first and how many more."""
    some = list(names)
    if len(some) > MANY:
        return f"{', '.join(some[: MANY - 2])} and {len(some) - MANY + 2} more"
    return " and ".join([", ".join(some[:-1]), some[-1]] if len(some) > 1 else some)


def rows(table: pd.DataFrame, name: str) -> Value:
    """How many rows a table has."""
    return Value(len(table), str(len(table)), f"{name}:rows")


def most(
    table: pd.DataFrame, name: str, column: str, unit: str = "", *, digits: int = 2, side: Side = Side.NEAR
) -> Value:
    """The largest of a column."""
    value = float(table[column].max())
    return Value(value, f"{number(value, digits, side)} {unit}".strip(), f"{name}:{column}:max")


def least(
    table: pd.DataFrame, name: str, column: str, unit: str = "", *, digits: int = 2, side: Side = Side.NEAR
) -> Value:
    """The smallest of a column."""
    value = float(table[column].min())
    return Value(value, f"{number(value, digits, side)} {unit}".strip(), f"{name}:{column}:min")


class Question(Enum):
    """What a committee asks, in the order in which the summary answers."""

    LIES = "Which meters can be lied about without anyone noticing, and by how much?"
    PROTECT = "Which few meters should be protected?"
    PICTURE = "What can an attacker do to the picture of the voltage?"
    FLEET = "Are the inverters stable, and do they keep the voltage band?"
    MONITOR = "How did the monitor behave in simulated attacks?"
    INVISIBLE = "Could liars stay invisible for ever, even to someone who knows everything else?"
    RECORDS = "What do the recorded readings say about the files?"
    OTHER = "What else was studied?"


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A section of the report.

    Attributes
    ----------
    title
        Its heading.
    answers
        What it answers.
    figures
        Its figures; their names begin with the study's.
    tables
        Its tables by name.
    shown
        Columns of a table that the page shows, where it is not to be the first ones; files have all.
    columns
        What columns of the tables mean, in the order in which that is told.
    assumptions
        What was assumed, sentences.
    """

    title: str
    answers: Mapping[Question, Finding]
    figures: tuple[Figure, ...] = ()
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    shown: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    assumptions: tuple[str, ...] = ()
