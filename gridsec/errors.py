"""Error tree with stable codes, and checks of enumerated arguments.

Every problem has a stable code beside its sentence. Programs and tests compare codes; sentences may change.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Any, Self, TypeVar

__all__ = [
    "DesignInfeasible",
    "FeederInvalid",
    "GridsecError",
    "InputInvalid",
    "NotObservable",
    "Problem",
    "Problems",
    "choice",
    "each_choice",
    "no_choice",
    "raise_if_any",
    "wrong_shapes",
]


class Problem(str):
    """Problem of an input: a sentence with a stable code.

    code: violated rule, lower case words joined by hyphens, such as `shape` or `not-finite`.
    text: place, fault, and expected value.
    """

    __slots__ = ("code",)
    code: str

    def __new__(cls, code: str, text: str) -> Self:
        """Return the sentence with its code."""
        self = super().__new__(cls, text)
        self.code = code
        return self

    def __reduce__(self) -> tuple[type[Problem], tuple[str, str]]:
        """Return class and arguments: a pickled sentence keeps its code."""
        return type(self), (self.code, str(self))


def _restored(kind: type[BaseException], args: tuple[Any, ...], state: dict[str, Any]) -> BaseException:
    """An error of a class, by its sentence and its attributes: without the arguments of its constructor."""
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(state)
    return error


class _Pickled(BaseException):
    """An error that keeps its sentence and its attributes between processes."""

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        """Return a constructor and its arguments."""
        return _restored, (type(self), self.args, self.__dict__)


class GridsecError(_Pickled, Exception):
    """Base of every error that this project raises on purpose.

    code: code of the reason: lower case words joined by hyphens; None: that of the class.
    """

    code: str = ""

    def __init__(self, *args: object, code: str | None = None) -> None:
        super().__init__(*args)
        if code is not None:
            self.code = code

    @property
    def codes(self) -> tuple[str, ...]:
        """Code of the error; one for each problem of an error that lists problems."""
        return (self.code,)


class Problems(_Pickled):
    """All problems of an error."""

    problems: tuple[str, ...]

    @property
    def codes(self) -> tuple[str, ...]:
        """Code of each problem; empty for a sentence without one."""
        return tuple(getattr(problem, "code", "") for problem in self.problems)


class FeederInvalid(Problems, GridsecError):
    """Invalid description of a feeder; `problems` lists every fault at once.

    problems: one complete sentence each: place, fault, and expected value.
    """

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        count = len(self.problems)
        head = f"{count} problem{'s' if count != 1 else ''} with the feeder"
        super().__init__("\n  - ".join([head + ":", *self.problems]))


class InputInvalid(Problems, ValueError):
    """Invalid arguments; `problems` lists every fault at once."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(self.problems))

    @classmethod
    def of(cls, code: str, text: str) -> Self:
        """Return the error of a single problem."""
        return cls((Problem(code, text),))


class NotObservable(GridsecError):
    """A set of meters is too small for the purpose.

    rank: rank that they determine, or the number of meters if the number is too small.
    why: the violated condition, in words.
    """

    def __init__(self, subset: Iterable[int], rank: int, why: str, *, code: str = "not-observable") -> None:
        self.subset: tuple[int, ...] = tuple(subset)
        self.rank = rank
        super().__init__(why, code=code)


class DesignInfeasible(GridsecError):
    """A design was not found, or its verification failed.

    what: the design and its condition.
    status: status of the solver, or the failed check. A solver's status is never a proof.
    margin: the recomputed margin of the failed condition, if any; negative if violated.
    code: code of the reason: lower case words joined by hyphens.
    """

    def __init__(
        self, what: str, status: str, margin: float | None = None, *, code: str = "design-infeasible"
    ) -> None:
        self.what = what
        self.status = status
        self.margin = margin
        tail = "" if margin is None else f", margin {margin:.3g}"
        super().__init__(f"{what}: {status}{tail}", code=code)


def raise_if_any(problems: Iterable[str]) -> None:
    """Raise one error with all problems of an input; return if there are none.

    Raises InputInvalid if `problems` is not empty.
    """
    found = tuple(problems)
    if found:
        raise InputInvalid(found)


def require(holds: object, problem: Problem) -> None:
    """Raise one error with a problem of an input, unless the condition holds."""
    raise_if_any([] if holds else [problem])


def wrong_shapes(*expected: tuple[str, tuple[int, ...], tuple[int, ...]]) -> list[Problem]:
    """Return one problem for each name with a shape (second) other than the expected one (third)."""
    return [
        Problem("shape", f"{what} has shape {has}; expected {wants}")
        for what, has, wants in expected
        if has != wants
    ]


Choice = TypeVar("Choice", bound=StrEnum)


def no_choice(name: str, kind: Iterable[str], *values: str) -> list[str]:
    """Return one problem for each value that is not among the allowed ones.

    kind: allowed values: an enumeration, or `typing.get_args` of a `Literal`.
    """
    known = tuple(kind)
    return [
        Problem("unknown-name", f"{name} is {value!r}; expected one of {', '.join(known)}")
        for value in values
        if value not in known
    ]


def each_choice(name: str, kind: type[Choice], values: Iterable[str]) -> tuple[Choice, ...]:
    """Return the members for members or their texts.

    Raises ValueError if a value is not a member; the message contains `name`.
    """
    given = tuple(values)
    problems = no_choice(name, kind, *given)
    raise_if_any(problems)
    return tuple(kind(value) for value in given)


def choice(name: str, kind: type[Choice], value: str) -> Choice:
    """Return the member for a member or its text.

    Raises ValueError if `value` is not a member; the message contains `name`.
    """
    return each_choice(name, kind, (value,))[0]
