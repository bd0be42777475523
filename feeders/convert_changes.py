"""What a conversion could not carry over as it was: each element, what was done, and what that does."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from typing import Final, Literal

from gridsec.errors import GridsecError

CHANGES_FILE: Final = "conversion.csv"
COLUMNS: Final = ("element", "property", "done", "effect")
WHOLE: Final = "all of it"
"""The property of an element that is meant as a whole."""

NAMED: Final = 8
"""Elements that a sentence names; the file names all of them."""

Done = Literal["left out", "approximated", "changed", "added", "accepted"]


class BusbarUnclear(GridsecError):
    """There are several buses, or none, that could be the metered busbar."""

    code = "busbar-unclear"


class SourceUnreadable(GridsecError):
    """What is to be converted does not exist, or is nothing that can be read as a network."""

    code = "unreadable"


@dataclass(frozen=True, slots=True)
class Change:
    """One element of the source that is not, or not exactly, in the feeder.

    Attributes
    ----------
    element
        Its name, with its kind.
    prop
        Which property of it; WHOLE where all of it is meant.
    done
        What was done.
    effect
        What the feeder does instead, and what that does to its voltages.
    """

    element: str
    prop: str
    done: Done
    effect: str


def sentences(changes: Iterable[Change]) -> tuple[str, ...]:
    """Return the changes in words, elements of the same fate together.

    Parameters
    ----------
    changes
        In the order in which they are to be told.
    """
    fates: dict[tuple[str, str, str], list[str]] = {}
    for change in changes:
        fates.setdefault((change.done, change.prop, change.effect), []).append(change.element)
    return tuple(
        f"{done}: {'' if prop == WHOLE else f'{prop} of '}{_listed(elements)}; {effect}"
        for (done, prop, effect), elements in fates.items()
    )


def _listed(elements: list[str]) -> str:
    tail = f" and {len(elements) - NAMED} more" if len(elements) > NAMED else ""
    return ", ".join(elements[:NAMED]) + tail


def changes_csv(changes: Iterable[Change]) -> str:
    """Return the table of all changes, one row for each element and property."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(astuple(change) for change in changes)
    return out.getvalue()
