"""Command lines as text, optional dependencies, atomic files, and plain JSON values."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["command_line", "extra", "own_numbers", "plain", "replace_file", "word"]


def word(value: object) -> str:
    """Return a value as one word, from which the same value is read: a float keeps all its digits.

    Parameters
    ----------
    value
        A number, a name, a path, ...
    """
    return repr(float(value)).removesuffix(".0") if isinstance(value, float) else str(value)


def command_line(words: Iterable[object]) -> str:
    """Return words as one line for a shell, quoted where that is needed.

    Parameters
    ----------
    words
        The command, its options and their values.
    """
    return shlex.join(map(word, words))


def extra(name: str) -> str:
    """Return what is missing, and how to get it, as the end of a sentence.

    Parameters
    ----------
    name
        The extra, as in pyproject.toml.
    """
    return f"the extra {name!r}, in a checkout: pip install -e '.[{name}]'"


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Replace a file when its new content is complete; what cannot be completed leaves the old one.

    A link stays one. What is no file, as a pipe or a terminal, cannot be replaced: it is written.

    Parameters
    ----------
    path
        The file.
    write
        Writes it, into another file beside it.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    if path.exists() and not path.is_file():
        write(path)
        return
    file = Path(os.path.realpath(path))
    new = file.with_name(f".{file.name}.new")
    try:
        write(new)
        os.replace(new, file)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def plain(value: Any) -> Any:
    """Return a value as JSON has it, all the way down.

    Parameters
    ----------
    value
        Made of numbers, texts, arrays, tuples, lists and dictionaries.
    """
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def own_numbers(given: DataclassInstance) -> None:
    """Make NumPy's numbers in a frozen dataclass Python's: those of 32 bits hold no Unix time.

    Parameters
    ----------
    given
        The instance, which is being made.
    """
    for each in fields(given):
        value = getattr(given, each.name)
        if isinstance(value, np.generic):
            object.__setattr__(given, each.name, value.item())
