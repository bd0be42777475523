"""Arguments of benchmarks: each by its place, looked at before the work."""

from __future__ import annotations

import argparse
import math


def arguments(doc: str | None, **usual: object) -> argparse.Namespace:
    """Read the command line; `--help` prints what the benchmark is, and what is wrong ends it.

    Parameters
    ----------
    doc
        What the benchmark is.
    usual
        What each argument is by default, in their order. A number stands for a positive one of its kind, a
        tuple for any number of words, False for an option, and anything else for one word.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    for name, default in usual.items():
        if default is False:
            parser.add_argument(f"--{name}", action="store_true")
        elif isinstance(default, tuple):
            parser.add_argument(name, nargs="*", default=default)
        else:
            kind = {int: count, float: positive}.get(type(default), str)
            parser.add_argument(name, nargs="?", type=kind, default=default)
    return parser.parse_intermixed_args()


def count(text: str) -> int:
    """Read a number of something."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected 1 or more")
    return number


def positive(text: str) -> float:
    """Read a positive number."""
    number = float(text)
    if not 0.0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a positive number")
    return number
