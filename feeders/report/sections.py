"""Which function makes which study's section; a study that has none gets one from its tables.

A section is made by `function(site, result) -> Section`. Results are those of `feeders.studies`: they have
`feeder` and `tables`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from feeders.report import attacks, fleet, invisible, meters, records
from feeders.report.section import Question, Section
from feeders.report.words import Finding, Standing, Value, plural

if TYPE_CHECKING:
    import pandas as pd

    from feeders.load import Site

__all__ = ["ANSWERS", "SECTIONS", "Outcome", "Result", "section"]


class Result(Protocol):
    """What every study returns."""

    @property
    def feeder(self) -> str:
        """The feeder's name."""

    @property
    def tables(self) -> Mapping[str, pd.DataFrame]:
        """All numbers, by name of the table."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of a study.

    Attributes
    ----------
    study
        Its name, as on the command line.
    result
        What it found; None if it failed.
    problem
        Why it failed; empty if it did not.
    command
        Runs it again, alone.
    seconds
        How long it took.
    resumed
        Whether some of the work was kept from before, and is not in `seconds`.
    absent
        Whether there is nothing on this feeder that it could study; `problem` says what.
    """

    study: str
    result: Result | None
    problem: str = ""
    command: str = ""
    seconds: float = 0.0
    resumed: bool = False
    absent: bool = False


SECTIONS: Final[dict[str, Callable[[Site, Any], Section]]] = {
    "redundancy": invisible.redundancy,
    "protect": meters.protect,
    "detectable": meters.detectable,
    "droop": fleet.droop,
    "campaign": attacks.campaign,
    "calibrate": records.calibrate,
}

ANSWERS: Final[dict[str, tuple[Question, ...]]] = {
    "redundancy": (Question.INVISIBLE,),
    "protect": (Question.PROTECT,),
    "detectable": (Question.LIES, Question.PICTURE),
    "droop": (Question.FLEET,),
    "campaign": (Question.MONITOR,),
    "calibrate": (Question.RECORDS,),
}
"""What a study answers: asked although it failed, or was not run."""


TITLES: Final = {
    "redundancy": "Who can lie without ever being noticed",
    "protect": "Which meters to protect",
    "detectable": "How large a lie must be",
    "droop": "The inverters",
    "campaign": "Simulated attacks",
    "calibrate": "What the readings say about the files",
}
"""Headings of sections that could not be made."""


def section(site: Site, outcome: Outcome) -> Section:
    """The section of a study, whatever became of it.

    Parameters
    ----------
    site, outcome
        The feeder, and what became of the study.
    """
    if outcome.result is None:
        questions = ANSWERS.get(outcome.study, (Question.OTHER,))
        if outcome.absent:
            nothing = Finding(Standing.ABSENT, ((f"{outcome.problem[:1].upper()}{outcome.problem[1:]}.",),))
            return Section(_title(outcome.study), dict.fromkeys(questions, nothing))
        problem = outcome.problem or "it ended without a result"
        finding = Finding(
            Standing.FAILED,
            ((f"No answer: {problem}. ", "This says nothing about whether there is a danger."),),
        )
        return Section(_title(outcome.study), dict.fromkeys(questions, finding))
    make = SECTIONS.get(outcome.study, _generic(outcome.study))
    return make(site, outcome.result)


def _generic(study: str) -> Callable[[Site, Result], Section]:
    def make(_: Site, found: Result) -> Section:
        sizes: list[str | Value] = []
        for name, table in found.tables.items():
            rows = Value(len(table), str(len(table)), f"{study}-{name}:rows")
            sizes += [", " if sizes else "", f"{name} (", rows, f" {plural(len(table), 'row')})"]
        lead = f"The study {study} left {len(found.tables)} {plural(len(found.tables), 'table')}: "
        end = ". They are below as they are; nothing is concluded from them here."
        told = Finding(Standing.MEASURED, ((lead, *sizes, end),))
        where = ANSWERS.get(study, (Question.OTHER,))
        return Section(_title(study), {where[0]: told}, tables=dict(found.tables))

    return make


def _title(study: str) -> str:
    return TITLES.get(study, f"Study: {study}")
