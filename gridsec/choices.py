"""Choices: members of an enumeration or their texts, or texts of a `Literal`."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import TypeVar

from gridsec.errors import Problem, refuse

__all__ = ["choice", "each_choice", "no_choice"]

Choice = TypeVar("Choice", bound=StrEnum)


def no_choice(name: str, kind: Iterable[str], *values: str) -> list[str]:
    """Return one problem for each value that is not among the allowed ones.

    Parameters
    ----------
    name
        Name of the quantity in the message.
    kind
        Allowed values: an enumeration, or `typing.get_args` of a `Literal`.
    """
    known = tuple(kind)
    return [
        Problem("unknown-name", f"{name} is {value!r}; expected one of {', '.join(known)}")
        for value in values
        if value not in known
    ]


def each_choice(name: str, kind: type[Choice], values: Iterable[str]) -> tuple[Choice, ...]:
    """Return the members for members or their texts.

    Raises
    ------
    ValueError
        If a value is not a member; the message contains `name`.
    """
    given = tuple(values)
    problems = no_choice(name, kind, *given)
    refuse(problems)
    return tuple(kind(value) for value in given)


def choice(name: str, kind: type[Choice], value: str) -> Choice:
    """Return the member for a member or its text.

    Raises
    ------
    ValueError
        If `value` is not a member; the message contains `name`.
    """
    return each_choice(name, kind, (value,))[0]
