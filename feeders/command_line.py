"""Command lines as text: what is printed does the same again when it is typed."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

__all__ = ["command_line", "word"]


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
