"""Journal handling and signal handling of study commands."""

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
from typing import Annotated, Any, Final, Never

import typer
from rich.control import Control
from rich.markup import escape
from rich.segment import ControlType

from feeders.studies.running import InUse, Journal, Keeper, OtherStudy, remove
from gridsec.errors import DesignInfeasible, NotObservable
from service.cli import console
from service.cli.console import print_error

JournalAt = Annotated[
    Path | None,
    typer.Option(
        "--journal",
        help="Keep finished work in this file, and continue from it. [default: a file in the user's cache "
        "folder, until the study is done]",
    ),
]
NoJournal = Annotated[
    bool, typer.Option("--no-journal", help="No journal: an interruption loses finished work.")
]

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)

PATIENCE_S: Final = 3.0  # time limit for the reaction to a signal, and then for the end of the processes, s
MOST: Final = 64  # largest number of journals of interrupted studies in the user's cache folder


class Stopped(KeyboardInterrupt):
    """A signal requests the end of the command."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@dataclass(slots=True)
class Keeping(Keeper):
    """Journals of a command."""

    study: str  # of the command
    feeder: str  # as on the command line
    chosen: Path | None  # file of the option; further studies have theirs beside it
    folder: Path | None  # of the other journals; None without any
    stay: bool = False  # they stay there after the command
    resumed: set[str] = field(default_factory=set)  # names of studies that were continued
    _journals: list[tuple[str, Journal]] = field(default_factory=list)
    _name: str = ""
    _warned: bool = False

    def file(self, study: str, digest: str) -> Path | None:
        """The file of the option, or one in the folder."""
        self._name = study
        if self.chosen is not None:
            beside = self.chosen.with_name(f"{self.chosen.name}.{study}")
            return self.chosen if study == self.study else beside
        if self.folder is None:
            return None
        feeder = re.sub(r"[^A-Za-z0-9_]+", "-", Path(self.feeder).stem).strip("-")[:64]
        return self.folder / f"{study}-{feeder}-{digest}.sqlite"

    def opened(self, journal: Journal) -> None:
        """Print the progress of a continued study."""
        self._journals.append((self._name, journal))
        if journal.path is not None and journal.done:
            self.resumed.add(self._name)
            console.err.print(escape(f"continuing from {journal.path}, {_amount(journal)} done"))

    def refused(self, path: Path, why: OSError | OtherStudy | InUse) -> bool:
        """Without the option, a study runs without a journal that cannot be used."""
        if self.chosen is not None:
            raise why
        if isinstance(why, OtherStudy):
            path.replace(path.with_suffix(".other"))
            return True
        if not self._warned:
            said = f"{why.filename or path}: {why.strerror}" if isinstance(why, OSError) else str(why)
            print_error(f"no journal is kept, an interruption loses finished work: {said}")
            self._warned = True
        return False

    def close(self, *, done: bool) -> None:
        """Close all journals; those that are empty, or not needed after a complete command, are removed."""
        passing = self.chosen is None and not self.stay
        for _, journal in self._journals:
            journal.close()
            if journal.path is not None and (not journal.done or (done and passing)):
                remove(journal.path)
        if done and passing and self.folder is not None:
            found = sorted(self.folder.glob("*.sqlite"), key=lambda path: path.stat().st_mtime_ns)
            for old in found[:-MOST]:
                remove(old)

    def left(self) -> str:
        """Finished work, and the location of its journal."""
        if not self._journals:
            return "no work was done yet"
        study, journal = self._journals[-1]
        begun = f"{study}: {_amount(journal)} done"
        if not journal.done:
            before = any(each.path is not None and each.done for _, each in self._journals)
            return f"{begun}; earlier studies are kept, the same command continues" if before else begun
        if journal.path is None:
            return f"{begun}, and lost: no journal was kept"
        return f"{begun}, kept in {journal.path}; the same command continues from there"


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
    """Keep journals of a command's studies; after an interruption one line states the progress.

    `journal` is the file of the option, `without` keeps none, and journals stay in `folder`; by default they
    are in the user's cache folder until the command is done.

    Raises typer.Exit after an interruption.
    """
    if without and journal is not None:
        raise typer.BadParameter("excludes --journal", param_hint="--no-journal")
    from feeders.registry import cache_folder
    from feeders.studies.running import ClusterUnusable, WorkerLost

    where = None if without else folder or cache_folder() / "journals"
    kept = Keeping(study, feeder, journal, where, stay=folder is not None)
    done = False
    try:
        with _signals(kept.left):
            yield kept
        done = True
    except KeyboardInterrupt as stop:
        number = stop.number if isinstance(stop, Stopped) else signal.SIGINT
        print_error(f"interrupted; {kept.left()}")
        raise typer.Exit(128 + number) from None
    except (OSError, WorkerLost, ClusterUnusable):
        console.err.print(escape(kept.left()))
        raise
    except (DesignInfeasible, NotObservable):
        done = True  # an infeasible design is a result; a repetition would give the same
        raise
    finally:
        kept.close(done=done)


def exit_on_signal() -> Callable[[], object]:
    """Let a signal end the program with one line while no study runs; returns the undo function."""

    def stop(number: int, _: FrameType | None) -> Never:
        print_error("interrupted; no work was in progress")
        sys.exit(128 + number)

    return partial(_handle, _handle(dict.fromkeys(SIGNALS, stop)))


@contextmanager
def _signals(left: Callable[[], str]) -> Iterator[None]:
    """Stop a command by SIGTERM as by Ctrl-C; a second signal ends it at once.

    A long call of a solver lets no signal handler run. The thread then ends the program, and also if child
    processes do not end. Every result is in the journal as soon as it exists: no more is lost.
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
            with suppress(IndexError):  # without a progress bar
                console.err.clear_live()
            console.err.control(Control(ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)))
            print_error(f"interrupted; {left()}")
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
    """Set handlers and return the previous ones. Ignored signals, as with `nohup`, stay ignored."""
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
