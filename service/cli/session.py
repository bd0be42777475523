"""What a command has done is kept, unless it is told not to; and what is said when it is interrupted."""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final, Never

import typer
from rich.control import Control
from rich.markup import escape
from rich.segment import ControlType

from gridsec.errors import DesignInfeasible, NotObservable
from service.cli import console
from service.cli.console import complain

if TYPE_CHECKING:
    from feeders.studies.journal import InUse, Journal, OtherStudy

__all__ = ["JournalAt", "Keeping", "NoJournal", "idle", "keeping"]

JournalAt = Annotated[
    Path | None,
    typer.Option(
        "--journal",
        help="Keep finished work in this file, and go on from it. [default: a file in the user's folder for "
        "caches, until the study is done]",
    ),
]
NoJournal = Annotated[
    bool, typer.Option("--no-journal", help="Keep none: an interruption loses what is done.")
]

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)

PATIENCE_S: Final = 3.0
"""How long a command may take to hear a signal, and then to end its processes, s."""

MOST: Final = 64
"""How many journals of interrupted studies stay in the user's folder for caches."""


class Stopped(KeyboardInterrupt):
    """A signal asks the command to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@dataclass(slots=True)
class Keeping:
    """A command's journals; a `feeders.studies.journal.Keeper`.

    Attributes
    ----------
    study, feeder
        The command's own study, and its feeder as it was given.
    chosen
        The file for it that was asked for; further studies of the command have theirs beside it.
    folder
        Where journals are otherwise; None: there are none.
    stay
        Whether they stay there when the command is done.
    journals
        All that were opened, with the name of the study.
    resumed
        Names of studies that went on from before.
    """

    study: str
    feeder: str
    chosen: Path | None
    folder: Path | None
    stay: bool = False
    journals: list[tuple[str, Journal]] = field(default_factory=list)
    resumed: set[str] = field(default_factory=set)
    _name: str = ""
    _warned: bool = False

    def file(self, study: str, digest: str) -> Path | None:
        """As `Keeper`: the file that was asked for, or one in the folder."""
        self._name = study
        if self.chosen is not None:
            return (
                self.chosen if study == self.study else self.chosen.with_name(f"{self.chosen.name}.{study}")
            )
        if self.folder is None:
            return None
        feeder = re.sub(r"[^A-Za-z0-9_]+", "-", Path(self.feeder).stem).strip("-")[:64]
        return self.folder / f"{study}-{feeder}-{digest}.jsonl"

    def opened(self, journal: Journal) -> None:
        """As `Keeper`: say where it goes on."""
        self.journals.append((self._name, journal))
        if journal.path is not None and journal.done:
            self.resumed.add(self._name)
            console.err.print(escape(f"going on from {journal.path}, {_amount(journal)} done"))

    def refused(self, path: Path, why: OSError | OtherStudy | InUse) -> bool:
        """As `Keeper`: what was not asked for is no reason not to work."""
        from feeders.studies.journal import OtherStudy

        if self.chosen is not None:
            raise why
        if isinstance(why, OtherStudy):
            path.replace(path.with_suffix(".other"))
            return True
        if not self._warned:
            said = f"{why.filename or path}: {why.strerror}" if isinstance(why, OSError) else str(why)
            complain(f"no journal is kept, an interruption loses what is done: {said}")
            self._warned = True
        return False

    def close(self, *, done: bool) -> None:
        """Let go of all journals; those that are not needed any more are removed.

        Parameters
        ----------
        done
            Whether the command is.
        """
        from feeders.studies.journal import remove

        passing = self.chosen is None and not self.stay
        for _, journal in self.journals:
            journal.close()
            if journal.path is not None and (not journal.done or (done and passing)):
                remove(journal.path)

    def left(self) -> str:
        """What is done, and where it is kept."""
        if not self.journals:
            return "nothing was done yet"
        study, journal = self.journals[-1]
        begun = f"{study}: {_amount(journal)} done"
        if not journal.done:
            before = [each for _, each in self.journals[:-1] if each.path is not None and each.done]
            return f"{begun}; what was before it is kept, the same command goes on" if before else begun
        if journal.path is None:
            return f"{begun}, and lost: no journal was kept"
        return f"{begun}, kept in {journal.path}; the same command goes on from there"


def _amount(journal: Journal) -> str:
    if journal.of is not None:
        return f"{journal.done} of {journal.of}"
    return f"{journal.done} piece{'s' * (journal.done != 1)} of work"


@contextmanager
def keeping(
    study: str,
    feeder: str,
    journal: Path | None = None,
    *,
    without: bool = False,
    folder: Path | None = None,
) -> Iterator[Keeping]:
    """Keep journals of a command's studies; interrupted, it says in one line what is done and how to go on.

    Parameters
    ----------
    study, feeder
        The command's own study, and its feeder as it was given.
    journal
        The file that was asked for.
    without
        Keep none.
    folder
        Where they are and stay; None: in the user's folder for caches, until the command is done.

    Raises
    ------
    typer.Exit
        If it was interrupted.
    """
    if without and journal is not None:
        raise typer.BadParameter("goes without --journal", param_hint="--no-journal")
    from feeders.registry.design_cache import folder as cache_folder
    from feeders.studies.workers import ClusterUnusable, WorkerLost

    where = None if without else folder or cache_folder() / "journals"
    kept = Keeping(study, feeder, journal, where, stay=folder is not None)
    try:
        with _signals(kept.left):
            yield kept
    except KeyboardInterrupt as stop:
        number = stop.number if isinstance(stop, Stopped) else signal.SIGINT
        kept.close(done=False)
        complain(f"interrupted; {kept.left()}")
        raise typer.Exit(128 + number) from None
    except (OSError, WorkerLost, ClusterUnusable):
        kept.close(done=False)
        console.err.print(escape(kept.left()))
        raise
    except (DesignInfeasible, NotObservable):
        kept.close(done=True)  # that there is no answer is one, and it would be the same again
        raise
    except BaseException:  # what was finished before something else failed is not to be done again
        kept.close(done=False)
        raise
    kept.close(done=True)
    if where is not None and folder is None:
        _prune(where)


def idle() -> Callable[[], object]:
    """Let a signal end the program with one line while no work is in hand; returns what undoes that."""

    def stop(number: int, _: FrameType | None) -> Never:
        complain("interrupted; no work was in hand")
        sys.exit(128 + number)

    return partial(_handle, _handle(dict.fromkeys(SIGNALS, stop)))


@contextmanager
def _signals(left: Callable[[], str]) -> Iterator[None]:
    """SIGTERM stops a command as Ctrl-C does, and whoever does that twice does not want to wait.

    A solver that has the program for minutes lets no handler run, but a thread: this ends it then, and also
    where processes do not end. Every result is in the journal as soon as there is one: no more is lost.
    """
    heard, over = threading.Event(), threading.Event()

    def stop(number: int, _: FrameType | None) -> Never:
        heard.set()
        _handle(dict.fromkeys(SIGNALS, _end))
        raise Stopped(number)

    def watch() -> None:
        number = os.read(ours, 1)
        if not number or (heard.wait(PATIENCE_S) and over.wait(PATIENCE_S)):
            return
        try:
            with suppress(IndexError):  # there is no progress bar
                console.err.clear_live()
            console.err.control(Control(ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)))
            complain(f"interrupted; {left()}")
        finally:
            _end(number[0], None)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    before, fd = _handle(dict.fromkeys(SIGNALS, stop)), signal.set_wakeup_fd(theirs)
    try:
        yield
    finally:
        _handle(before)
        signal.set_wakeup_fd(fd)
        heard.set()
        over.set()
        os.close(theirs)
        thread.join()
        os.close(ours)


def _handle(handlers: Mapping[signal.Signals, Any]) -> dict[signal.Signals, Any]:
    """Set handlers and return those before. Who ignores a signal, as `nohup` does, goes on doing so."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {
        number: signal.signal(number, handler)
        for number, handler in handlers.items()
        if signal.getsignal(number) is not signal.SIG_IGN
    }


def _end(number: int, _: FrameType | None) -> Never:
    console.err.show_cursor()
    os._exit(128 + number)


def _prune(folder: Path) -> None:
    """Drop the journals that nobody has come back to for longest."""
    from feeders.studies.journal import remove

    found = sorted(folder.glob("*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
    for old in found[:-MOST]:
        remove(old)
