"""What a study says in the report: answers, figures, tables, what it assumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

from feeders.report.figure import Figure
from feeders.report.words import Finding

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Question", "Section"]


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
