"""Texts of the report: sentences with sourced numbers, and sections of studies.

A number in a sentence names its table, for readers and for a test.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import TYPE_CHECKING, Any, Final

from feeders.report.drawing import Figure

if TYPE_CHECKING:
    import pandas as pd


MANY: Final = 12
"""Largest number of names in a sentence."""


class Standing(Enum):
    """Certainty of an answer."""

    PROVED = "proved"
    MEASURED = "measured"
    PART = "partly proved"
    OPEN = "not proved"
    FAILED = "no answer"
    ABSENT = "not studied"


@dataclass(frozen=True, slots=True)
class Value:
    """Number in a sentence."""

    value: float  # the number
    shown: str  # text of the number, with its unit
    source: str  # table, column, and operation: `detectable-meters:noticed:max`


Sentence = tuple[str | Value, ...]


@dataclass(frozen=True, slots=True)
class Finding:
    """Answer of a study."""

    standing: Standing  # certainty of the answer
    sentences: tuple[Sentence, ...]  # the answer, the most important first


def sentence(text: str, **parts: str | Value | Sentence) -> Sentence:
    """Sentence with texts and numbers in place of `{name}`."""
    out: list[str | Value] = []
    for words, name, _, _ in Formatter().parse(text):
        part = parts[name] if name else ()
        out += [words, *(part if isinstance(part, tuple) else [part])]
    return tuple(each for each in out if each)


def said(sentence: Sentence) -> str:
    """Sentence as plain text."""
    return "".join(part if isinstance(part, str) else part.shown for part in sentence)


class Side(Enum):
    """Direction of rounding: a proved upper limit of safety is rounded down, and so on."""

    NEAR = "near"
    BELOW = "below"
    ABOVE = "above"


def number(value: Any, digits: int = 2, side: Side = Side.NEAR) -> str:
    """Write a number: ∞ for an infinite one, a question mark for an unknown one."""
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
    """Noun of a number: one meter, two meters."""
    return one if size == 1 else several or f"{one}s"


def listed(names: Sequence[str]) -> str:
    """Names in a sentence; beyond MANY, the first ones and the number of the others."""
    some = list(names)
    if len(some) > MANY:
        return f"{', '.join(some[: MANY - 2])} and {len(some) - MANY + 2} more"
    return " and ".join([", ".join(some[:-1]), some[-1]] if len(some) > 1 else some)


def counted(count: int, source: str) -> Value:
    """Number of things."""
    return Value(count, str(count), source)


def rows(table: pd.DataFrame, name: str) -> Value:
    """Number of rows of a table."""
    return counted(len(table), f"{name}:rows")


def quantity(value: float, unit: str, source: str, *, digits: int = 2, side: Side = Side.NEAR) -> Value:
    """Rounded number with its unit."""
    return Value(value, f"{number(value, digits, side)} {unit}".strip(), source)


def most(
    table: pd.DataFrame, name: str, column: str, unit: str = "", *, digits: int = 2, side: Side = Side.NEAR
) -> Value:
    """Largest value of a column."""
    return quantity(float(table[column].max()), unit, f"{name}:{column}:max", digits=digits, side=side)


def least(
    table: pd.DataFrame, name: str, column: str, unit: str = "", *, digits: int = 2, side: Side = Side.NEAR
) -> Value:
    """Smallest value of a column."""
    return quantity(float(table[column].min()), unit, f"{name}:{column}:min", digits=digits, side=side)


class Question(Enum):
    """Questions of a committee, in the order of the summary."""

    LIES = "Which meters can be manipulated without notice, and by how much?"
    PROTECT = "Which meters should be protected?"
    PICTURE = "How large an error of the shown voltages can an attack cause?"
    FLEET = "Are the inverters stable, and do they keep the voltage band?"
    MONITOR = "How did the monitor behave in simulated attacks?"
    INVISIBLE = "Can attacks stay invisible for ever, even with exact knowledge of everything else?"
    RECORDS = "Which errors of the files do the recorded readings show?"
    OTHER = "Which other studies were run?"


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Section of the report."""

    answers: Mapping[Question, Finding]  # answers by question
    figures: tuple[Figure, ...] = ()  # figures; their names begin with the study's
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)  # tables by name
    # Columns of a table on the page, if not the first ones; files have all.
    shown: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    assumptions: tuple[str, ...] = ()  # assumptions, as sentences
