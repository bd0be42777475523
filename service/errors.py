"""What can be wrong with a request about a feeder."""

from __future__ import annotations

from gridsec.errors import GridsecError


class FeederUnknown(GridsecError):
    """No feeder has this name."""

    def __init__(self, name: str) -> None:
        super().__init__(f"there is no feeder {name!r}")


class FeederNotLoaded(GridsecError):
    """The feeder's stored tables cannot be loaded any more: nobody watches it."""

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(f"nobody watches feeder {name!r}: its stored tables cannot be loaded: {problem}")


class FeederFixed(GridsecError):
    """The feeder belongs to the command line."""

    def __init__(self, name: str) -> None:
        super().__init__(f"feeder {name!r} was given when the service was started and cannot be deleted")


class TooManyFeeders(GridsecError):
    """No more feeders are taken over REST."""

    def __init__(self, most: int) -> None:
        super().__init__(f"{most} feeders have been put already, and no more are taken; delete one first")
