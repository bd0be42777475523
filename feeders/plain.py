"""Values as JSON has them: numbers of Python in place of NumPy's, lists in place of arrays and tuples."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["own_numbers", "plain"]


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
