"""Every paper as `gridsec reproduce` tells it: what differs has a reason, and all figures are described.

Beside the tests of the papers, which look at the same examples.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from service.cli.reproduce import PAPERS
from tests.gridsec.papers.made import made
from tests.service.commands import command

ROOT = Path(__file__).resolve().parents[3]

run = command("reproduce")


@pytest.mark.canary("kim2018")
@pytest.mark.parametrize("paper", PAPERS)
def test_no_paper_fails(
    paper: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(f"gridsec.papers.{paper}.reproduce", lambda: made(paper))
    code, told, error = run(monkeypatch, capsys, paper, "--out", str(tmp_path))
    assert (code, error) == (0, "")
    assert "not met" not in told
    assert [page for page in re.findall(r"docs/[\w/-]+\.md", told) if not (ROOT / page).exists()] == []
    names = {path.stem for path in tmp_path.iterdir()}
    described = (ROOT / "docs" / "papers" / "README.md").read_text()
    assert names == set(re.findall(rf"`({paper}-[^`]+)`", described))
