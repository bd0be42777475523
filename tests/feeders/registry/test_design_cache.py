"""The folder of designs: real files, real damage, real lack of permission."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from feeders.registry import BankGains, DesignCache, bank_gains, cache_folder
from gridsec.errors import InputInvalid, NotObservable
from gridsec.estimators.exact_bank import bank
from gridsec.observers.gains import margin, options_for
from tests.codes import refused
from tests.gridsec.plants import line

STREET = line(4)
OPTIONS = options_for(STREET.lure, rate=0.25, noise=2e-4, load=STREET.load)


def run(where: Path, seen: list[tuple[int, int]] | None = None) -> BankGains:
    progress = None if seen is None else lambda *a: seen.append(a)
    return bank_gains(STREET.lure, 1, OPTIONS, workers=1, where=where, progress=progress)


@pytest.mark.parametrize(
    ("environment", "platform", "expected"),
    [
        ({"GRIDSEC_CACHE_DIR": "/x/y", "HOME": "/h"}, "linux", "/x/y"),
        ({"HOME": "/h"}, "linux", "/h/.cache/gridsec"),
        ({"HOME": "/h", "XDG_CACHE_HOME": "/c"}, "linux", "/c/gridsec"),
        ({"HOME": "/h", "XDG_CACHE_HOME": "c"}, "linux", "/h/.cache/gridsec"),
        ({"HOME": "/h"}, "darwin", "/h/Library/Caches/gridsec"),
        ({"USERPROFILE": "/h", "LOCALAPPDATA": "/l"}, "win32", "/l/gridsec/Cache"),
        ({"USERPROFILE": "/h"}, "win32", "/h/AppData/Local/gridsec/Cache"),
    ],
)
def test_where_designs_are_kept(environment: dict[str, str], platform: str, expected: str) -> None:
    assert cache_folder(environment, platform).as_posix() == expected


def test_the_default_folder_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRIDSEC_CACHE_DIR", str(tmp_path / "deep" / "cache"))
    assert bank_gains(STREET.lure, 1, OPTIONS, workers=1).origin == "new"
    assert bank_gains(STREET.lure, 1, OPTIONS, workers=1).origin == "stored"
    assert len(list((tmp_path / "deep" / "cache").iterdir())) == 1


def test_a_bank_is_designed_once_and_runs(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    first = run(tmp_path, calls)
    assert (first.origin, first.problem, calls[-1]) == ("new", "", (10, 10))
    count = len(calls)
    again = run(tmp_path, calls)
    assert (again.origin, again.problem, len(calls)) == ("stored", "", count)
    np.testing.assert_array_equal(first.gains.K, again.gains.K)
    np.testing.assert_array_equal(first.gains.L, again.gains.L)
    made = bank.design(STREET.lure, 1, gains=again.gains)
    u, seen = np.full(4, 0.08), np.ones(4, dtype=bool)
    y = STREET.lure.D @ u
    state = bank.init(made, y, u, seen)
    for _ in range(40):
        state = bank.step(made, state, y, u, seen, 1.0)
    assert np.isfinite(bank.consistency(made, state)).all()


def test_a_damaged_entry_is_replaced(tmp_path: Path) -> None:
    run(tmp_path)
    (entry,) = tmp_path.iterdir()
    blob = bytearray(entry.read_bytes())
    blob[len(blob) // 2] ^= 0xFF
    entry.write_bytes(bytes(blob))
    again = run(tmp_path)
    assert again.origin.startswith("redesigned: stored design: cannot be read")
    assert all(margin(STREET.lure, g.J, g) > 0.0 for g in again.designs)
    assert run(tmp_path).origin == "stored"


def test_where_nothing_can_be_written_the_design_is_still_there(tmp_path: Path) -> None:
    # A file where the folder should be: refused even to the superuser.
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    got = run(blocked)
    assert got.origin == "new"
    assert "cannot be" in got.problem
    assert len(got.designs) == 10


def test_an_entry_that_cannot_be_read_is_a_reason_not_a_crash(tmp_path: Path) -> None:
    cache = DesignCache(tmp_path)
    (tmp_path / "abc.gains").mkdir()
    assert cache.get("abc") is None
    assert "cannot be read" in cache.problems[0]
    cache.put("abc", b"1")
    assert "cannot be stored" in cache.problems[1]
    assert [p.name for p in tmp_path.iterdir()] == ["abc.gains"], "no draft is left behind"


def test_old_entries_go_first(tmp_path: Path) -> None:
    cache = DesignCache(tmp_path)
    cache.put("00", b"old")
    cache.put("01", b"older, but used")
    past = time.time() - 1000.0
    os.utime(tmp_path / "00.gains", (past, past))
    os.utime(tmp_path / "01.gains", (past - 10.0, past - 10.0))
    assert cache.get("01") == b"older, but used"
    for index in range(2, 65):
        cache.put(f"{index:02d}", b"new")
    assert cache.get("00") is None
    assert cache.get("01") is not None
    assert len(list(tmp_path.iterdir())) == 64
    assert cache.problems == []


def test_a_key_is_no_path(tmp_path: Path) -> None:
    cache = DesignCache(tmp_path)
    for key in ("../x", "a/b", "", "a.b"):
        with refused(InputInvalid, "wrong-text"):
            cache.get(key)


def test_more_than_half_lying_is_refused(tmp_path: Path) -> None:
    with refused(NotObservable, "too-few-meters"):
        bank_gains(STREET.lure, 2, OPTIONS, workers=1, where=tmp_path)
