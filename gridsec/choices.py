"""Choices out of a few: a member of an enumeration, or its text; or one of the texts of a `Literal`."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import TypeVar

from gridsec.errors import Problem, refuse

__all__ = ["choice", "each_choice", "no_choice"]

Choice = TypeVar("Choice", bound=StrEnum)


def no_choice(name: str, kind: Iterable[str], *values: str) -> list[str]:
    """Return what is wrong with values that are to be out of a few, one sentence each.

    Parameters
    ----------
    name, kind
        What is chosen, and out of what: an enumeration, or `typing.get_args` of a `Literal`.
    values
        What was given.
    """
    known = tuple(kind)
    return [
        Problem("unknown-name", f"{name} is {value!r}; expected one of {', '.join(known)}")
        for value in values
        if value not in known
    ]


def each_choice(name: str, kind: type[Choice], values: Iterable[str]) -> tuple[Choice, ...]:
    """Return the members that are meant.

    Parameters
    ----------
    name, kind
        What is chosen, and out of what.
    values
        Members, or their texts.

    Raises
    ------
    ValueError
        If there is no such member.
    """
    given = tuple(values)
    problems = no_choice(name, kind, *given)
    refuse(problems)
    return tuple(kind(value) for value in given)


def choice(name: str, kind: type[Choice], value: str) -> Choice:
    """Return the member that is meant.

    Parameters
    ----------
    name, kind, value
        As in `each_choice`.

    Raises
    ------
    ValueError
        If there is no such member.
    """
    return each_choice(name, kind, (value,))[0]
