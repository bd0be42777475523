"""Studies that are interrupted by real signals, go on, and come to the same; and journals that cannot be."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from feeders.studies.running import worked
from gridsec.errors import GridsecError
from service.cli.session import keeping
from tests.journals import rows
from tests.service.commands import command, plain

run = command("study")

GRIDSEC = (sys.executable, "-c", "from service.cli.main import main; main()", "study")

CAMPAIGN = (
    *("campaign", "cigre-lv", "--scenarios", "32", "--together", "4", "--duration", "60", "--step", "1"),
    *("--kind", "bias:3", "--place", "random", "--liars", "1", "--workers", "2"),
)


@pytest.fixture(autouse=True)
def heard() -> Iterator[None]:
    """Who is started in the background of a shell ignores Ctrl-C, and so would all that it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Journals' folder of these tests."""
    monkeypatch.setenv("GRIDSEC_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache" / "journals"


def until(true: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def pieces(folder: Path) -> int:
    return sum(len(rows(path)) for path in folder.glob("*.sqlite"))


def family(session: int) -> set[int]:
    """Processes of a session that are not dead."""
    found = set()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, theirs = stat.read_text(encoding="utf-8").rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(theirs) == session and state != "Z":
            found.add(int(stat.parent.name))
    return found


def asleep(process: int) -> bool:
    """Whether its main thread waits and has not woken up for a while."""

    def now() -> list[str]:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
        return re.findall(r"^(?:State|voluntary_ctxt_switches):\s+(\S+)", status, re.MULTILINE)

    before = now()
    time.sleep(0.1)
    return before[0] == "S" and now() == before


def tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_ctrl_c_at_half_loses_nothing_and_nobody_else_writes_meanwhile(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("detectable", "simbench-lv-rural1", "--trials", "2")
    master, terminal = pty.openpty()
    with subprocess.Popen(
        [*GRIDSEC, *words], stdout=subprocess.PIPE, stderr=terminal, start_new_session=True
    ) as first:
        os.close(terminal)
        until(lambda: pieces(cache) >= 8)
        first.send_signal(signal.SIGSTOP)
        kept = pieces(cache)
        # The same command, while the first one has the journal.
        code, whole, said = run(monkeypatch, capsys, *words, "--out", str(tmp_path / "whole"))
        assert code == 0
        assert plain(said).count("no journal is kept, an interruption loses finished work:") == 1
        assert "another command is writing this journal" in said
        assert pieces(cache) == kept
        first.send_signal(signal.SIGINT)
        first.send_signal(signal.SIGCONT)
        shown = b""
        while chunk := _read(master):
            shown += chunk
        assert first.stdout is not None
        assert first.stdout.read() == b""
    os.close(master)
    assert first.returncode == 130
    told = shown.decode()
    assert "Traceback" not in told
    assert told.rfind("\x1b[?25h") > told.rfind("\x1b[?25l"), "the cursor is shown again"
    (journal,) = cache.iterdir()
    done = pieces(cache)
    assert 8 <= done < 26
    (line,) = re.findall(r"[^\r\n]*gridsec:[^\r\n]*", told)
    kept = f"interrupted; detectable: {done} of 26 done, kept in {journal}"
    assert f"{kept}; the same command continues" in line

    code, again, said = run(monkeypatch, capsys, *words, "--out", str(tmp_path / "again"))
    assert (code, again) == (0, whole)
    assert said == f"continuing from {journal}, {done} of 26 done\n"
    assert tables(tmp_path / "again") == tables(tmp_path / "whole")
    assert not list(cache.iterdir()), "what is done needs no journal"


def _read(master: int) -> bytes:
    try:
        return os.read(master, 4096)
    except OSError:  # nobody has the terminal any more
        return b""


@pytest.mark.acceptance
def test_sigterm_ends_all_processes_of_a_campaign_and_it_goes_on(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*GRIDSEC, *CAMPAIGN], text=True, start_new_session=True, **pipes) as first:
        until(lambda: pieces(cache))
        os.killpg(first.pid, signal.SIGTERM)
        _, told = first.communicate(timeout=60)
        until(lambda: not family(first.pid))
    assert first.returncode == 143
    done = pieces(cache)
    assert 1 <= done < 8
    (journal,) = cache.iterdir()
    assert told == (
        f"gridsec: interrupted; campaign: {done} of 8 done, kept in {journal}; "
        "the same command continues from there\n"
    )
    alone = (*CAMPAIGN[:-1], "1")
    code, again, said = run(monkeypatch, capsys, *alone, "--out", str(tmp_path / "again"))
    assert code == 0
    assert said == f"continuing from {journal}, {done} of 8 done\n"
    code, whole, said = run(monkeypatch, capsys, *alone, "--out", str(tmp_path / "whole"), "--no-journal")
    assert (code, said) == (0, "")
    assert again == whole
    assert tables(tmp_path / "again") == tables(tmp_path / "whole")
    assert not list(cache.iterdir())


@pytest.mark.acceptance
def test_an_interruption_while_processes_begin_is_one_line(cache: Path) -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*GRIDSEC, *CAMPAIGN], text=True, start_new_session=True, **pipes) as first:
        until(lambda: len(family(first.pid)) > 2)  # itself, who looks after semaphores, and a worker
        os.killpg(first.pid, signal.SIGINT)
        _, told = first.communicate(timeout=60)
        until(lambda: not family(first.pid))
    assert first.returncode == 130
    assert re.fullmatch(r"gridsec: interrupted; [^\n]+\n", told), told
    assert not pieces(cache)


def test_a_folder_that_cannot_be_is_said_once(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache.parent.write_text("in the way", encoding="utf-8")
    words = ("detectable", "cigre-lv", "--max-attacked", "1", "--trials", "1")
    code, told, said = run(monkeypatch, capsys, *words)
    assert code == 0
    assert "1 attacks from the named size on: 0 missed" in told
    assert said.count("\n") == 1
    assert "no journal is kept" in said
    assert "Not a directory" in said


def test_a_file_of_ones_own_stays_and_further_studies_have_theirs_beside_it(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    journal = tmp_path / "new" / "journal"
    words = ("campaign", "cigre-lv", "--promised", "--scenarios", "2", "--together", "2", "--duration", "30")
    code, _, said = run(monkeypatch, capsys, *words, "--workers", "1", "--journal", str(journal))
    assert (code, said) == (0, "")
    assert sorted(path.name for path in journal.parent.iterdir()) == ["journal", "journal.detectable"]
    assert not cache.exists()
    code, _, said = run(monkeypatch, capsys, "protect", "cigre-lv", "--journal", str(journal))
    assert code == 1
    assert "not the journal of this study" in said
    code, _, said = run(monkeypatch, capsys, "protect", "--journal", str(journal), "--no-journal")
    assert code == 2


def test_what_has_no_answer_leaves_no_journal(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("protect", "--unknown", "LV1.101 Load 8", "--never", "m08")
    code, _, _ = run(monkeypatch, capsys, *words)
    assert code == 3
    assert not list(cache.iterdir())


def test_work_that_was_done_before_an_error_is_kept(cache: Path) -> None:
    def refuse() -> NoReturn:
        raise GridsecError("this piece cannot be done")

    tasks: dict[str, Callable[[], int]] = {"one": lambda: 1, "two": refuse}
    with pytest.raises(GridsecError, match="this piece"), keeping("any", "village") as kept:
        worked(kept, {"study": "any"}, tasks.items(), None)
    tasks = {"one": refuse, "two": lambda: 2}
    with keeping("any", "village") as kept:
        assert worked(kept, {"study": "any"}, tasks.items(), None) == {"one": 1, "two": 2}
    assert not list(cache.iterdir())


DEAF = """
import ctypes, sys
from pathlib import Path
from feeders.studies.running import worked
from service.cli.session import keeping

def solver():
    # Waits for itself, without ever coming back to Python: a lock that is locked twice.
    lock, c = ctypes.create_string_buffer(64), ctypes.CDLL(None)
    c.pthread_mutex_lock(lock)
    print("ready", flush=True)
    c.pthread_mutex_lock(lock)

with keeping("any", "village", Path(sys.argv[1])) as kept:
    worked(kept, {"study": "any"}, [("a", lambda: 1), ("b", solver)], None)
"""


@pytest.mark.acceptance
def test_a_solver_that_hears_no_signal_is_ended_all_the_same(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    words = [sys.executable, "-c", DEAF, str(journal)]
    with subprocess.Popen(words, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "ready\n"
        until(lambda: asleep(first.pid))
        first.send_signal(signal.SIGINT)
        try:
            _, told = first.communicate(timeout=20)
        finally:
            first.kill()
    assert first.returncode == 130
    done = f"any: 1 of 2 done, kept in {journal}"
    assert told == f"gridsec: interrupted; {done}; the same command continues from there\n"
    assert len(rows(journal)) == 1
