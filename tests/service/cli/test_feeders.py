"""`gridsec feeders design`: a finished design is told with its proof, and kept for the next start."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.mesh import baran_wu
from feeders.format.tables import write
from service.cli.feeders import app
from tests.service.commands import command, plain

run = command("feeders")


@pytest.mark.acceptance
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


def test_a_meshed_feeder_is_checked_shown_and_designed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tables = baran_wu().tables
    write(tables, tmp_path / "mesh")
    write(replace(tables, meta=replace(tables.meta, meshed=False)), tmp_path / "radial")
    code, said, _ = run(monkeypatch, capsys, "validate", str(tmp_path / "mesh"))
    assert code == 0
    assert said.count("is drawn as a tie") == 5
    code, _, error = run(monkeypatch, capsys, "validate", str(tmp_path / "radial"))
    assert code == 3
    assert "meshed to true in feeder.toml" in " ".join(error.split())
    code, said, _ = run(monkeypatch, capsys, "show", str(tmp_path / "mesh"))
    assert code == 0
    assert "33 buses, 5 closed ties, 32 customers" in " ".join(said.split())
    code, said, _ = run(monkeypatch, capsys, "design", str(tmp_path / "mesh"))
    assert code == 0
    assert "reactance certificate" in said
    code, said, _ = run(monkeypatch, capsys, "design", str(tmp_path / "mesh"), "--estimator", "exact-bank")
    assert code == 0
    assert "528 observers" in " ".join(said.split())


def test_a_feeder_that_comes_with_gridsec_is_valid_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, told, wrong = run(monkeypatch, capsys, "validate", "cigre-lv", "atlantis")
    assert "cigre-lv: valid" in told
    assert (code, "atlantis does not exist" in wrong) == (3, True)
    (tmp_path / "cigre-lv").mkdir()  # a folder goes before a name
    code, _, wrong = run(monkeypatch, capsys, "validate", "cigre-lv")
    assert (code, "feeder.toml" in wrong) == (3, True)
    listed = re.findall(r"\w+", str(app.info.help).lower().replace(" and ", " ").removesuffix("feeders."))
    assert set(listed) <= {each.name for each in app.registered_commands}


def test_wrong_usage_of_design_is_told_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = ("--estimator", "zz", "--max-attacked", "-1")
    code, _, told = run(monkeypatch, capsys, "design", "cigre-lv", *wrong)
    assert code == 2
    assert "--estimator is 'zz'; expected one of modal, " in plain(told)
    assert "--max-attacked is -1; it must not be negative" in plain(told)


def test_what_cannot_be_watched_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bank = ("--estimator", "exact-bank", "--max-attacked", "3")
    code, _, error = run(monkeypatch, capsys, "design", "cigre-lv", *bank)
    assert code == 3
    assert "more than 6 meters are needed" in error


def test_the_command_line_starts_without_numerical_libraries() -> None:
    """They take a second; commands that need them import them in their bodies."""
    code = "import sys, service.cli.main; print(*{'pandas', 'scipy', 'sqlalchemy', 'cvxpy'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
