"""Errors of the service with stable codes, and errors of requests about a feeder.

Programs and tests compare codes; sentences may change. docs/error-codes.md lists the codes.
"""

from __future__ import annotations

from gridsec.errors import GridsecError, Problem


def prefixed(start: str, problem: str) -> Problem:
    """Return a problem with its place in front, once, and with its code."""
    return Problem(getattr(problem, "code", ""), start + problem.removeprefix(start))


class IdUnknown(GridsecError):
    """No object of a kind has this id."""

    code = "unknown-id"
    kind = "object"

    def __init__(self, number: str) -> None:
        super().__init__(f"no {self.kind} has the id {number!r}")


class FeederUnknown(GridsecError):
    """No feeder has this name."""

    code = "unknown-feeder"

    def __init__(self, name: str) -> None:
        super().__init__(f"there is no feeder {name!r}")


class FeederNotLoaded(GridsecError):
    """The feeder's stored tables cannot be loaded; the feeder is not monitored."""

    code = "feeder-not-loaded"

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(f"feeder {name!r} is not monitored: its stored tables cannot be loaded: {problem}")


class FeederFixed(GridsecError):
    """The feeder was given on the command line."""

    code = "feeder-fixed"

    def __init__(self, name: str) -> None:
        super().__init__(f"feeder {name!r} was given when the service was started and cannot be deleted")


class TooManyFeeders(GridsecError):
    """The limit of feeders added over REST is reached."""

    code = "too-many-feeders"

    def __init__(self, most: int) -> None:
        super().__init__(f"the limit of {most} feeders over REST is reached; delete one first")


class NoOwner(GridsecError):
    """No worker monitors the feeder at the moment."""

    code = "no-owner"

    def __init__(self, feeder: str) -> None:
        super().__init__(f"no worker monitors feeder {feeder!r} at the moment; another one takes it over")


class WorkerBusy(GridsecError):
    """Too many requests wait for the worker; this one has not been sent."""

    code = "worker-busy"

    def __init__(self, worker: str, most: int) -> None:
        super().__init__(f"{most} requests wait for worker {worker!r}; this one is not executed")
