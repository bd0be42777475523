"""What all commands share: the consoles, exit codes, and arguments."""

from __future__ import annotations

import math
import sys
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.markup import escape

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
