"""Where pieces of a long study are worked on: here, in processes of this machine, or on a Dask cluster.

A runner is given a function and numbers, and yields each number with what the function made of it, in any
order. A worker that dies takes no result with it: what it had in hand is done again, a few times at most.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from threading import Thread
from typing import Any, Final, Protocol

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # has no stubs

from feeders.studies.journal import versions
from feeders.util import extra
from gridsec.errors import GridsecError
from gridsec.processes import deaf, listen, stop

__all__ = [
    "ClusterUnusable",
    "Dask",
    "Here",
    "Processes",
    "Runner",
    "WorkerLost",
    "agree",
    "cores",
    "versions",
]

Work = Callable[[int], Any]
Made = Generator[tuple[int, Any], None, None]

RETRIES: Final = 3
"""How often a piece is tried again after its worker died."""


class WorkerLost(GridsecError):
    """The workers of a piece died again and again."""

    code = "worker-lost"


class ClusterUnusable(GridsecError):
    """There is no Dask cluster that could be used."""

    code = "cluster-unusable"


class Runner(Protocol):
    """Whatever can work on pieces."""

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """Work on all pieces; yield each with its result when it is done."""


@dataclass(frozen=True, slots=True)
class Here:
    """One piece after the other, in this process."""

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`."""
        for piece in pieces:
            # Sums of several threads are added in another order, and have other last bits.
            with threadpool_limits(limits=1):
                made = work(piece)
            yield piece, made


@dataclass(frozen=True, slots=True)
class Processes:
    """Processes of this machine, begun anew rather than forked: so they are the same on every system.

    Attributes
    ----------
    count
        How many.
    retries
        How often a piece is tried again after its process died.
    """

    count: int
    retries: int = RETRIES

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`.

        Raises
        ------
        WorkerLost
            When the processes of a piece died again and again.
        """
        waiting, lost = deque(pieces), Counter[int]()
        while waiting:
            died = yield from self._until_one_dies(work, waiting)
            lost.update(died)
            for piece in died:
                if lost[piece] > self.retries:
                    raise WorkerLost(f"the processes that worked on piece {piece} died {lost[piece]} times")
            waiting.extendleft(reversed(died))

    def _until_one_dies(self, work: Work, waiting: deque[int]) -> Generator[tuple[int, Any], None, list[int]]:
        """Work until nothing is left, or a process has died; returns what was in hand then."""
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(self.count, len(waiting)), context, initializer=_begin)
        running: dict[Future[Any], int] = {}
        try:
            while waiting or running:
                # What is worked on, and one for each to go on with: little is lost with a process.
                while waiting and len(running) < 2 * self.count:
                    with deaf():
                        running[pool.submit(_single, work, waiting[0])] = waiting[0]
                    waiting.popleft()
                done = wait(running, return_when=FIRST_COMPLETED).done
                for future in done:
                    if not isinstance(future.exception(), BrokenProcessPool):
                        yield running.pop(future), future.result()
                if any(future in running for future in done):
                    break
        except BrokenProcessPool:
            pass  # while a piece was handed over; it is still waiting
        finally:
            stop(pool)
        return sorted(running.values())


def cores(count: int | None = None) -> Runner:
    """Processes of this machine, or this one where there is but one.

    Parameters
    ----------
    count
        How many; by default one for each core.
    """
    count = count or os.cpu_count() or 1
    return Processes(count) if count > 1 else Here()


def _begin() -> None:
    """Prepare a process: an interruption of the first one is not its own, but the end of that one is."""
    listen()
    Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the process that began this one, even if that was killed and could not say so."""
    first = multiprocessing.parent_process()
    if first is not None:
        first.join()
        os._exit(1)


def _single(work: Work, piece: int) -> Any:
    """Work on a piece in a process of its own, with one thread: only now are all libraries loaded."""
    threadpool_limits(limits=1)
    return work(piece)


@dataclass(frozen=True, slots=True)
class Dask:
    """A Dask cluster; it needs the extra `cluster`, and gridsec on its workers.

    Attributes
    ----------
    address
        Of its scheduler, such as tcp://10.0.0.1:8786.
    timeout_s
        How long to wait for its answer, s.

    Notes
    -----
    The scheduler gives what a dead worker had in hand to another one, as often as it is configured to
    (`distributed.scheduler.allowed-failures`, 3).
    """

    address: str
    timeout_s: float = 10.0

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`.

        Raises
        ------
        ClusterUnusable
            When `distributed` is not installed, nobody answers at the address, there are no workers, or they
            have other versions of what numbers depend on.
        WorkerLost
            When the workers of a piece died again and again.
        """
        try:
            dask: Any = import_module("distributed")
        except ImportError as error:
            raise ClusterUnusable(f"a Dask cluster needs {extra('cluster')}", code="not-installed") from error
        try:
            client = dask.Client(self.address, timeout=self.timeout_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ClusterUnusable(f"no Dask scheduler answers at {self.address}: {error}") from error
        with client:
            self._check(client)
            waiting, running = deque(pieces), dict[Any, int]()
            done = dask.as_completed(loop=client.loop)

            def hand_out() -> None:
                # Each piece brings the feeder along: the scheduler holds a few for each worker only, and one
                # at least, which waits where all workers have gone.
                while waiting and len(running) < max(4 * sum(client.nthreads().values()), 1):
                    future = client.submit(_one, work, waiting[0], pure=False)
                    running[future] = waiting.popleft()
                    done.add(future)

            try:
                hand_out()
                for future in done:
                    theirs, made = future.result()
                    agree("a worker", theirs)
                    yield running.pop(future), made
                    hand_out()
            except dask.KilledWorker as error:
                raise WorkerLost(str(error)) from error
            finally:
                client.cancel(list(running))

    def _check(self, client: Any) -> None:
        """Whether there are workers, who compute as this process would; who comes later is asked then."""
        try:
            client.wait_for_workers(1, timeout=self.timeout_s)
        except TimeoutError as error:
            raise ClusterUnusable(f"the Dask cluster at {self.address} has no workers") from error
        for worker, theirs in client.run(versions, on_error="return").items():
            agree(worker, theirs)


def agree(worker: str, theirs: Any) -> None:
    """Refuse a worker with other versions, or without any.

    Parameters
    ----------
    worker, theirs
        Its name, and its versions or what went wrong when it was asked.

    Raises
    ------
    ClusterUnusable
        If they are not those of this process.
    """
    mine = versions()
    if theirs != mine:
        raise ClusterUnusable(f"the versions of Dask worker {worker} are {theirs!r}, not {mine!r}")


def _one(work: Work, piece: int) -> tuple[dict[str, str], Any]:
    """Work on a piece in a worker that is not ours."""
    return versions(), _single(work, piece)
