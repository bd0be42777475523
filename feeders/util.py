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
    """Format a value as one word that parses back to the same value; a float keeps all digits."""
    return repr(float(value)).removesuffix(".0") if isinstance(value, float) else str(value)


def command_line(words: Iterable[object]) -> str:
    """Join words to one line for a shell, with quotes where needed."""
    return shlex.join(map(word, words))


def extra(name: str) -> str:
    """Name of a missing extra of pyproject.toml and its installation command, as the end of a sentence."""
    return f"the extra {name!r}, in a checkout: pip install -e '.[{name}]'"


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Replace a file by what `write` puts at the path it is given; an incomplete write leaves the old file.

    A symbolic link stays a link. A path that is not a regular file, such as a pipe or a terminal, cannot be
    replaced: it is written directly.

    Raises OSError if the file cannot be written.
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
    """Convert numbers, texts, arrays, tuples, lists and dictionaries to plain JSON types, recursively."""
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def own_numbers(given: DataclassInstance) -> None:
    """Convert NumPy numbers of a frozen dataclass to Python's; a 32-bit float cannot hold a Unix time."""
    for each in fields(given):
        value = getattr(given, each.name)
        if isinstance(value, np.generic):
            object.__setattr__(given, each.name, value.item())
