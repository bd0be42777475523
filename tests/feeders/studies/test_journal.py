"""Journals: real files, other processes that hold them, full disks, and what is done when one is refused."""

from __future__ import annotations

import resource
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import load
from feeders.studies.campaign.guarantees import rehearse
from feeders.studies.comparison import ComparisonPlan, ComparisonRow, compare
from feeders.studies.detectable import detectable
from feeders.studies.running import InUse, Journal, Keeper, OtherStudy, remove, versions, worked
from tests.codes import refused
from tests.journals import head_of, rows

CIGRE = load("cigre-lv")
SUBJECT = {"study": "any", "number": 3}


class Stop(Exception):
    """An interruption."""


def stop_at(count: int) -> Callable[[int, int], None]:
    def progress(done: int, _: int) -> None:
        if done == count:
            raise Stop

    return progress


@dataclass
class Shelf(Keeper):
    """A keeper that gives in, and remembers why."""

    folder: Path
    again: bool = False
    opened_at: list[int] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def file(self, study: str, digest: str) -> Path:
        return self.folder / f"{study}-{digest}"

    def opened(self, journal: Journal) -> None:
        self.opened_at.append(journal.done)

    def refused(self, path: Path, why: Exception) -> bool:
        self.problems.append(str(why))
        if self.again:
            path.unlink()
        return self.again


def squares(count: int) -> list[tuple[str, Callable[[], Any]]]:
    return [(str(k), lambda k=k: k * k) for k in range(count)]


def test_progress_begins_with_what_is_done_already(tmp_path: Path) -> None:
    shelf, told = Shelf(tmp_path), list[tuple[int, int]]()
    with pytest.raises(Stop):
        worked(shelf, SUBJECT, squares(5), stop_at(2))
    found = worked(shelf, SUBJECT, squares(5), lambda done, of: told.append((done, of)))
    assert found == {str(k): k * k for k in range(5)}
    assert told == [(2, 5), (3, 5), (4, 5), (5, 5)]
    assert shelf.opened_at == [0, 2]
    assert worked(shelf, SUBJECT | {"number": 4}, squares(1), None) == {"0": 0}
    assert len(list(tmp_path.iterdir())) == 2, "other arguments, another journal"


def test_an_empty_file_becomes_a_journal_and_keeps_all_digits(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "journal"
    path.parent.mkdir()
    path.touch()
    with Journal(path, SUBJECT) as journal:
        journal.put("a", [0.1 + 0.2, float("inf")])
    assert rows(path) == {"a": "[0.30000000000000004, Infinity]"}
    assert head_of(path) == SUBJECT | {"versions": versions()}
    with Journal(path, SUBJECT) as journal:
        assert journal["a"] == [0.1 + 0.2, float("inf")]


def test_the_database_of_another_program_is_refused_and_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "alarms.sqlite"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE alarm (id INTEGER)")
    before = path.read_bytes()
    with refused(OtherStudy, "other-origin"):
        Journal(path, SUBJECT)
    assert path.read_bytes() == before


WRITE = """
import sys
from pathlib import Path
from feeders.studies.running import Journal
journal = Journal(Path(sys.argv[1]), {"study": "any", "number": 3})
while True:
    journal.put(str(journal.done), [journal.done] * 1000)
    print(journal.done, flush=True)
"""


@pytest.mark.parametrize("moment", [0.001, 0.01, 0.05])
def test_a_process_that_is_killed_while_it_writes_loses_one_piece_at_most(
    tmp_path: Path, moment: float
) -> None:
    path = tmp_path / "journal"
    words = [sys.executable, "-c", WRITE, str(path)]
    with subprocess.Popen(words, text=True, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        first = other.stdout.readline()
        time.sleep(moment)
        other.kill()
        finished = int((first + other.stdout.read()).split()[-1])
    with Journal(path, SUBJECT) as journal:
        assert finished <= journal.done <= finished + 1
        assert all(journal[str(k)] == [k] * 1000 for k in range(journal.done))


HOLD = """
import sys
from pathlib import Path
from feeders.studies.running import Journal
journal = Journal(Path(sys.argv[1]), {"study": "any", "number": 3})
journal.put("theirs", 1)
print("ready", flush=True)
sys.stdin.read()
"""


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Another process writes the journal."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HOLD, str(path)], text=True, **pipes) as other:
        assert other.stdout.readline() == "ready\n"
        yield
        other.kill()


def test_two_processes_never_write_one(tmp_path: Path) -> None:
    shelf = Shelf(tmp_path)
    with Journal(shelf, SUBJECT):
        pass
    (path,) = tmp_path.iterdir()
    with held(path):
        with refused(InUse, "in-use"):
            Journal(path, SUBJECT)
        assert worked(shelf, SUBJECT, squares(2), None) == {"0": 0, "1": 1}
        remove(path)
        assert rows(path) == {"theirs": "1"}, "neither written nor removed"
    assert len(shelf.problems) == 1
    with Journal(path, SUBJECT) as journal:
        assert journal["theirs"] == 1, "one that was killed keeps nobody out"
    remove(path)
    assert not path.exists()


def test_what_is_refused_is_done_without_it_or_tried_again(tmp_path: Path) -> None:
    blocked = Shelf(tmp_path / "file")
    blocked.folder.write_text("in the way", encoding="utf-8")
    assert worked(blocked, SUBJECT, squares(2), None) == {"0": 0, "1": 1}
    assert len(blocked.problems) == 1
    shelf = Shelf(tmp_path / "shelf", again=True)
    with Journal(shelf, SUBJECT):
        pass
    (path,) = shelf.folder.iterdir()
    path.write_text("nonsense\n", encoding="utf-8")
    assert worked(shelf, SUBJECT, squares(2), None) == {"0": 0, "1": 1}
    assert "not the journal of this study" in shelf.problems[0]
    assert rows(path) == {"0": "0", "1": "1"}


def test_a_full_disk_ends_the_journal_and_not_the_study(tmp_path: Path) -> None:
    shelf, long = Shelf(tmp_path), "x" * 8000
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
    try:
        assert len(worked(shelf, SUBJECT, [(str(k), lambda: long) for k in range(4)], None)) == 4
        with Journal(tmp_path / "mine", SUBJECT) as journal:
            journal.put("0", long)
            with pytest.raises(OSError, match="disk I/O error"):
                journal.put("1", 4 * long)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(shelf.problems) == 1
    worked(shelf, SUBJECT, [(str(k), lambda: long) for k in range(4)], None)
    assert 0 < shelf.opened_at[1] < 4, "a piece that found no room is done again"


def test_simulated_lies_go_on_and_more_of_them_too(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    found = detectable(CIGRE, max_attacked=1)
    whole = rehearse(CIGRE, found, trials=4, seed=3)
    with pytest.raises(Stop):
        rehearse(CIGRE, found, trials=3, seed=3, journal=journal, progress=stop_at(2))
    told: list[int] = []
    again = rehearse(CIGRE, found, trials=4, seed=3, journal=journal, progress=lambda k, _: told.append(k))
    assert again == whole
    assert told[0] == 2
    with pytest.raises(OtherStudy):
        rehearse(CIGRE, found, trials=4, seed=4, journal=journal)


def test_a_comparison_goes_on(tmp_path: Path) -> None:
    plan = ComparisonPlan(
        max_attacked=1, seeds=1, duration_s=80.0, families=("modal",), cases=("clean", "bias", "stuck")
    )
    journal, said = tmp_path / "journal", list[str]()

    def stop(what: str) -> None:
        if what == "case stuck":
            raise Stop

    def timeless(rows: list[ComparisonRow]) -> list[str]:
        return [repr({**asdict(row), "step_ms": 0.0, "step_ms_95": 0.0}) for row in rows]

    with pytest.raises(Stop):
        compare(CIGRE, plan, journal=journal, progress=stop)
    rows = compare(CIGRE, plan, journal=journal, progress=said.append)
    assert timeless(rows) == timeless(compare(CIGRE, plan))
    assert [each for each in said if each.startswith("case")] == ["case stuck"]
