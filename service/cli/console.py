"""Consoles, exit codes, arguments and checks of options, shared by all commands."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from typing import Annotated, Final, TypeVar

import typer
from rich.console import Console
from rich.markup import escape

from service.cli.paths import Given, Unusable, check_paths

Told = TypeVar("Told")


def read_all(
    option: str, texts: Iterable[str] | None, read: Callable[[str], Told], problems: list[str]
) -> list[Told]:
    """Parse all texts of an option; a ValueError of `read` is added to `problems`."""
    out = []
    for text in texts or ():
        try:
            out.append(read(text))
        except ValueError as error:
            problems.append(f"{option} {text!r}: {error}")
    return out


def refuse_options(problems: Iterable[str], **places: Given) -> None:
    """Refuse wrong options, and unusable files and folders as in `check_paths`, before the work.

    Raises typer.BadParameter if there are any problems, together with the unusable files and folders;
        Unusable if only files and folders are unusable.
    """
    found = list(problems)
    try:
        check_paths(**places)
    except Unusable as error:
        if not found:
            raise
        found += str(error).splitlines()
    if found:
        raise typer.BadParameter("; ".join(found))


def options_of(make: Callable[[], Told], problems: Iterable[str], **places: Given) -> Told:
    """Create an object from options; its ValueError is reported together with all other problems.

    Raises typer.BadParameter, Unusable as in `refuse_options`.
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
LEASE_LOST: Final = 8

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
    """Refuse infinite numbers and NaN as options of a command.

    Raises typer.BadParameter if the number is not finite.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not finite")
    return value


def print_error(message: str) -> None:
    """Print an error message without markup."""
    err.print(f"[bold red]gridsec:[/] {escape(message)}")


def say(message: str) -> None:
    """Print a message without markup."""
    out.print(escape(message))
