"""`gridsec feeders design`: a finished design is told with its proof, and kept for the next start."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.service.commands import command

run = command("feeders")


def test_a_bank_by_matrix_inequality_is_designed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GRIDSEC_CACHE_DIR", str(tmp_path))
    arguments = ("design", "cigre-lv", "--estimator", "exact-bank-lmi", "--workers", "1")
    code, first, _ = run(monkeypatch, capsys, *arguments)
    assert code == 0
    assert "exact-bank-lmi, M = 1, 21 observers" in first
    proof = re.search(r"certificate, margin (\S+), decay at least (\S+) 1/s", first)
    assert proof is not None
    assert min(float(proof[1]), float(proof[2])) > 0
    (kept,) = tmp_path.iterdir()
    before = kept.read_bytes()
    code, again, _ = run(monkeypatch, capsys, *arguments)
    assert (code, kept.read_bytes()) == (0, before)
    assert again.splitlines()[1] == first.splitlines()[1]


def test_what_cannot_be_watched_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(
        monkeypatch, capsys, "design", "cigre-lv", "--estimator", "oracle", "--max-attacked", "-1"
    )
    assert code == 3
    assert "2 problems" in error
    assert "'oracle'" in error
    assert "-1" in error
    bank = ("--estimator", "exact-bank", "--max-attacked", "3")
    code, _, error = run(monkeypatch, capsys, "design", "cigre-lv", *bank)
    assert code == 3
    assert "more than 6 meters are needed" in error
