"""What the HTTP application needs from the running service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from typing import Any, Protocol

from service.report import FeederReport
from service.store import Store


class Backend(Protocol):
    """The running service, as REST sees it; `runtime.Runtime` is one."""

    @property
    def store(self) -> Store:
        """The database, for reads."""

    def feeders(self) -> list[dict[str, Any]]:
        """Return the fields of `models.FeederSummary` for every feeder; verdict and time are added here."""

    def feeder(self, name: str) -> dict[str, Any] | None:
        """Return the fields of `models.FeederDetail`, or None if there is no such feeder."""

    def known(self, name: str) -> bool:
        """Whether there is such a feeder; costs nothing."""

    def unloaded(self, name: str) -> str | None:
        """Return why the stored tables of a feeder could not be loaded, or None if that is not so."""

    def report(self, name: str) -> FeederReport | None:
        """Return the latest report of a feeder, or None before its first tick."""

    def age(self, report: FeederReport) -> float:
        """Return how old a feeder's latest report is by the service's clock, s."""

    def commissioning(self, name: str) -> dict[str, Any] | None:
        """Return the fields of `models.Commissioning` but `kept`, or None if there is no such feeder."""

    def unstored(self) -> tuple[int, str | None]:
        """Return how many changes of alarms wait for the database, and what is wrong with it, or None."""

    def metrics(self) -> bytes:
        """Return the metrics in Prometheus's text format."""

    def ready(self) -> tuple[bool, list[str]]:
        """Say whether everything works that is needed to watch, and what does not."""

    def healthy(self) -> tuple[bool, list[str]]:
        """Say whether the process should live on, and if not, why."""

    async def put_feeder(self, name: str, tables: dict[str, Any]) -> None:
        """Take over a feeder's tables; raises what says that it is wrong, or TooManyFeeders."""

    async def delete_feeder(self, name: str) -> None:
        """Watch a feeder no more; raises FeederUnknown or FeederFixed."""

    async def acknowledge(
        self, alarm_id: str, who: str, comment: str, *, count: int | None = None
    ) -> dict[str, Any]:
        """Answer an alarm and return it; raises AlarmUnknown, RaisedAgain or AlreadyAcknowledged."""

    async def recommission(self, name: str, meters: Sequence[str], who: str, reason: str) -> dict[str, Any]:
        """Learn meters' errors anew, none for all; raises FeederUnknown or NothingToLearn."""

    def subscribe(self) -> AsyncGenerator[dict[str, Any], None]:
        """Return an asynchronous generator of wake-ups; it ends when the service stops.

        Each is `{"type": "alarm" | "state", "data": ...}`, sent after the alarm has been stored or the
        report replaced. Only the type is read here, so the backend may drop wake-ups of a client that is
        slow, as long as one is left. The first step into the generator subscribes, closing it ends that.
        """


async def wakes(backend: Backend) -> AsyncIterator[None]:
    """Yield once the subscription stands, and again after each wake-up, until the service stops.

    Parameters
    ----------
    backend
        The running service.
    """
    subscription = backend.subscribe()
    waiting: asyncio.Future[dict[str, Any] | None] | None = None
    try:
        while True:
            waiting = asyncio.ensure_future(anext(subscription, None))
            await asyncio.sleep(0)  # The first step subscribes: nothing that happens from here on is missed.
            yield
            if await waiting is None:
                return
    finally:
        if waiting is not None:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)
        await subscription.aclose()
