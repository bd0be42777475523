"""Test write of `/readyz`, with a limit on the wait for it."""

from __future__ import annotations

import asyncio

from anyio import CapacityLimiter, to_thread

from service.store import Store, StoreUnavailable

ANSWER_S = 0.7
"""Wait for the test write, s: `/readyz` answers within 1 s."""


class Probe:
    """Test write that concurrent requests share; none of them waits for it longer than `ANSWER_S`.

    Parameters
    ----------
    store
        The database.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._running: asyncio.Task[str | None] | None = None

    async def trouble(self) -> str | None:
        """Return why the database cannot be written, or None."""
        if self._running is None or self._running.done():
            self._running = asyncio.create_task(self._check(), name="readiness")
        await asyncio.wait({self._running}, timeout=ANSWER_S)
        if self._running.done():
            return self._running.result()
        return f"{self._store.name}: no answer within {ANSWER_S:g} s"

    async def _check(self) -> str | None:
        # A thread of its own: reads that wait for the database may hold all of the shared ones.
        try:
            await to_thread.run_sync(self._store.check, limiter=CapacityLimiter(1), abandon_on_cancel=True)
        except StoreUnavailable as error:
            return str(error)
        return None
