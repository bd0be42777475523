"""Consoles, exit codes, arguments and checks of options that all commands share."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from typing import Annotated, Final, TypeVar

import typer
from rich.console import Console
from rich.markup import escape

from service.cli.paths import Given, Unusable, see

__all__ = [
    "ADDRESS",
    "DATABASE",
    "FAILED",
    "FEEDER",
    "FILE",
    "USAGE",
    "WRITER_LOST",
    "Feeder",
    "Studied",
    "complain",
    "err",
    "finite",
    "options_of",
    "out",
    "read_all",
    "refuse_options",
]


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
        Files and folders, as `service.cli.paths.see` takes them.

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


FAILED: Final = 1
USAGE: Final = 2
FEEDER: Final = 3
DATABASE: Final = 4
ADDRESS: Final = 5
FILE: Final = 6
WRITER_LOST: Final = 7

Feeder = Annotated[str, typer.Argument(help="A feeder's folder, or the name of one that comes with gridsec.")]
Studied = Annotated[
    str,
    typer.Argument(
        help="A feeder's folder, the name of one that comes with gridsec, or another tool's network: a "
        "pandapower or power-grid-model JSON file, an OpenDSS master file (.dss), simbench:CODE, "
        "pandapower:NETWORK.",
        metavar="FEEDER",
    ),
]

out = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 160)
err = Console(stderr=True, highlight=False, soft_wrap=True)


def finite(value: float | None) -> float | None:
    """Refuse infinite numbers where they are options of a command.

    Parameters
    ----------
    value
        What was given, if anything.

    Raises
    ------
    typer.BadParameter
        If it is infinite, or none.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is no finite number")
    return value


def complain(message: str) -> None:
    """Print an error message.

    Parameters
    ----------
    message
        The message, without markup.
    """
    err.print(f"[bold red]gridsec:[/] {escape(message)}")
