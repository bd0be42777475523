"""Files that are whole or not there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

__all__ = ["replace_file"]


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
