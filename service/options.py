"""Options of a command: all that is wrong with them is told at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import typer

from service.places import Given, Unusable, see

__all__ = ["options_of", "read_all", "refuse_options"]

Told = TypeVar("Told")


def read_all(
    option: str, texts: Iterable[str] | None, read: Callable[[str], Told], problems: list[str]
) -> list[Told]:
    """Read all texts of an option.

    Parameters
    ----------
    option, texts
        The option, and what was given.
    read
        Reads one of them; raises a ValueError with what is wrong with it.
    problems
        Takes what is wrong.
    """
    out = []
    for text in texts or ():
        try:
            out.append(read(text))
        except ValueError as error:
            problems.append(f"{option} {text!r}: {error}")
    return out


def refuse_options(problems: Iterable[str], **places: Given) -> None:
    """Refuse options that are wrong, and files and folders that cannot be used, before the work.

    Parameters
    ----------
    problems
        What is wrong so far.
    places
        Files and folders, as `service.places.see` takes them.

    Raises
    ------
    typer.BadParameter
        If there are any problems, with the files and folders that cannot be used.
    Unusable
        If there are no others than these.
    """
    found = list(problems)
    try:
        see(**places)
    except Unusable as error:
        if not found:
            raise
        found += str(error).splitlines()
    if found:
        raise typer.BadParameter("; ".join(found))


def options_of(make: Callable[[], Told], problems: Iterable[str], **places: Given) -> Told:
    """Make something of options; what it is that they do not make is refused with all other problems.

    Parameters
    ----------
    make
        Makes it; raises a ValueError with what is wrong with the options.
    problems, places
        As `refuse_options` takes them.

    Raises
    ------
    typer.BadParameter, Unusable
        As `refuse_options` does.
    """
    try:
        out = make()
    except ValueError as error:
        refuse_options([*problems, str(error)], **places)
        raise
    refuse_options(problems, **places)
    return out
