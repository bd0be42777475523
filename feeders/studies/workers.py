"""Runners of the pieces of a long study: this process, processes of this machine, or a Dask cluster.

A runner has a function and numbers, and yields each number with its result, in any order. When a worker dies,
its pieces are repeated, RETRIES times at most.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib import import_module
from threading import Thread
from typing import Any, Final

from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # has no stubs

from feeders.studies.journal import Made, Runner, Work, versions
from feeders.util import extra
from gridsec.errors import GridsecError
from gridsec.processes import deaf, listen, stop

__all__ = ["ClusterUnusable", "Dask", "Here", "Processes", "Runner", "WorkerLost", "agree", "cores"]

RETRIES: Final = 3  # largest number of repetitions of a piece after the death of its worker


class WorkerLost(GridsecError):
    """The workers of a piece died repeatedly."""

    code = "worker-lost"


class ClusterUnusable(GridsecError):
    """No usable Dask cluster."""

    code = "cluster-unusable"


@dataclass(frozen=True, slots=True)
class Here:
    """One piece after the other, in this process."""

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`."""
        for piece in pieces:
            # Several threads sum in another order, with other last bits.
            with threadpool_limits(limits=1):
                made = work(piece)
            yield piece, made


@dataclass(frozen=True, slots=True)
class Processes:
    """Processes of this machine, spawned rather than forked: equal on every system."""

    count: int  # number of processes
    retries: int = RETRIES  # repetitions of a piece after the death of its process

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`.

        Raises WorkerLost if the processes of a piece died repeatedly.
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
        """Work until all pieces are finished, or a process has died; returns the unfinished pieces."""
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(self.count, len(waiting)), context, initializer=_begin)
        running: dict[Future[Any], int] = {}
        try:
            while waiting or running:
                # Pieces in work, and one more for each process: little is lost with a process.
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
            pass  # during a submission; the piece is still waiting
        finally:
            stop(pool)
        return sorted(running.values())


def cores(count: int | None = None) -> Runner:
    """`count` processes of this machine, by default one for each core; this process if there is one core."""
    count = count or os.cpu_count() or 1
    return Processes(count) if count > 1 else Here()


def _begin() -> None:
    """Prepare a process: it ignores interruptions, and ends with the first process."""
    listen()
    Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the parent process, even after its forced end."""
    first = multiprocessing.parent_process()
    if first is not None:
        first.join()
        os._exit(1)


def _single(work: Work, piece: int) -> Any:
    """Work on a piece in a separate process, with one thread; all libraries are loaded by now."""
    threadpool_limits(limits=1)
    return work(piece)


@dataclass(frozen=True, slots=True)
class Dask:
    """Dask cluster; requires the extra `cluster`, and gridsec on its workers.

    The scheduler repeats the pieces of a dead worker, up to `distributed.scheduler.allowed-failures` times
    (3).
    """

    address: str  # of the scheduler, such as tcp://10.0.0.1:8786
    timeout_s: float = 10.0  # longest wait for its answer

    def run(self, work: Work, pieces: Sequence[int]) -> Made:
        """As `Runner`.

        Raises ClusterUnusable without `distributed`, a scheduler at the address, or workers, or for workers
            with other versions of the libraries that numbers depend on; WorkerLost if the workers of a piece
            died repeatedly.
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
                # Each piece contains the feeder: the scheduler has a few per worker, and at least one, which
                # waits for a worker if there is none.
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
        """Check that there are workers with equal versions; later ones are checked with their results."""
        try:
            client.wait_for_workers(1, timeout=self.timeout_s)
        except TimeoutError as error:
            raise ClusterUnusable(f"the Dask cluster at {self.address} has no workers") from error
        for worker, theirs in client.run(versions, on_error="return").items():
            agree(worker, theirs)


def agree(worker: str, theirs: Any) -> None:
    """Reject a worker with other versions than those of this process, or with an error in their place.

    Raises ClusterUnusable for other versions.
    """
    mine = versions()
    if theirs != mine:
        raise ClusterUnusable(f"the versions of Dask worker {worker} are {theirs!r}, not {mine!r}")


def _one(work: Work, piece: int) -> tuple[dict[str, str], Any]:
    """Work on a piece in an external worker."""
    return versions(), _single(work, piece)
