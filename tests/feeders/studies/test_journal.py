"""Journals: real files, other processes that hold them, full disks, and what is done when one is refused."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import load
from feeders.studies.campaign.guarantees import rehearse
from feeders.studies.comparison import ComparisonPlan, ComparisonRow, compare
from feeders.studies.detectable import detectable
from feeders.studies.journal import InUse, Journal, OtherStudy, edition, remove, versions, worked
from tests.codes import refused

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
class Shelf:
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


@pytest.mark.parametrize("cut", [0, 1, 40])
def test_one_that_was_cut_off_in_its_first_line_is_begun_again(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "deep" / "journal"
    with Journal(path, SUBJECT):
        head = path.read_bytes()
    path.write_bytes(head[:cut])
    with Journal(path, SUBJECT) as journal:
        journal.put("a", [1.5, float("inf")])
    assert path.read_bytes() == head + b'["a", [1.5, Infinity]]\n'


def test_other_code_of_the_same_version_is_another_study(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    with Journal(path, SUBJECT):
        head = json.loads(path.read_text(encoding="utf-8"))
    assert head == SUBJECT | {"versions": versions(), "edition": edition()}
    path.write_text(json.dumps(head | {"edition": "0"}, sort_keys=True) + "\n", encoding="utf-8")
    with refused(OtherStudy, "other-version"):
        Journal(path, SUBJECT)


HOLD = """
import sys
from pathlib import Path
from feeders.studies.journal import Journal
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
        (path,) = tmp_path.iterdir()
    with held(path):
        with refused(InUse, "in-use"):
            Journal(path, SUBJECT)
        assert worked(shelf, SUBJECT, squares(2), None) == {"0": 0, "1": 1}
        remove(path)
        assert path.read_text(encoding="utf-8").count("\n") == 2, "neither written nor removed"
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
        (path,) = shelf.folder.iterdir()
    path.write_text("nonsense\n", encoding="utf-8")
    assert worked(shelf, SUBJECT, squares(2), None) == {"0": 0, "1": 1}
    assert "not the journal of this study" in shelf.problems[0]
    assert path.read_text(encoding="utf-8").count("\n") == 3


def test_a_full_disk_ends_the_journal_and_not_the_study(tmp_path: Path) -> None:
    shelf, long = Shelf(tmp_path), "x" * 8000
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        assert len(worked(shelf, SUBJECT, [(str(k), lambda: long) for k in range(4)], None)) == 4
        with Journal(tmp_path / "mine", SUBJECT) as journal:
            journal.put("0", long)
            with pytest.raises(OSError, match="too large"):
                journal.put("1", long + long)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(shelf.problems) == 1
    worked(shelf, SUBJECT, [(str(k), lambda: long) for k in range(4)], None)
    assert shelf.opened_at[1] == 2, "a line that found no room is done again"


def test_simulated_lies_go_on_and_more_of_them_too(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    found = detectable(CIGRE, max_attacked=1)
    whole = rehearse(CIGRE, found, trials=6, seed=3)
    with pytest.raises(Stop):
        rehearse(CIGRE, found, trials=4, seed=3, journal=journal, progress=stop_at(3))
    told: list[int] = []
    again = rehearse(CIGRE, found, trials=6, seed=3, journal=journal, progress=lambda k, _: told.append(k))
    assert again == whole
    assert told[0] == 3
    with pytest.raises(OtherStudy):
        rehearse(CIGRE, found, trials=6, seed=4, journal=journal)


def test_a_comparison_goes_on(tmp_path: Path) -> None:
    plan = ComparisonPlan(
        max_attacked=1, seeds=1, duration_s=80.0, families=("sequential",), cases=("clean", "bias", "stuck")
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
