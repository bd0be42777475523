"""`gridsec reproduce`: the papers' numbers beside ours, their figures, and an exit code that tells."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

from gridsec.papers import kim2018
from gridsec.papers.claims import Claim, Reproduction, number, statement
from service.cli.reproduce import PAPERS
from tests.gridsec.papers.made import made
from tests.service.commands import command

ROOT = Path(__file__).resolve().parents[3]


run = command("reproduce")


def row(text: str, what: str) -> list[str]:
    """Return the cells of the row of a table that speaks of something."""
    (line,) = (line for line in text.splitlines() if what in line)
    return [cell.strip() for cell in line.split("│")[1:-1]]


def test_numbers_of_a_paper_stand_beside_ours_and_its_figures_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "folder"
    monkeypatch.setattr(kim2018, "reproduce", lambda: made("kim2018"))
    code, told, _ = run(monkeypatch, capsys, "kim2018", "--out", str(folder))
    assert code == 0
    mark, _, where, printed, ours = row(told, "2 M_z eta")
    assert (mark, where, printed) == ("met", "section IV", "at most 671")
    assert 670.0 < float(ours) <= 671.0
    assert row(told, "sets in use after 17 s")[3:] == ["3 -> 4 -> 1 -> 2"] * 2
    mark, *_ = row(told, "entries of Phi(x)")
    found = re.fullmatch(r"differs \((\d+)\)", mark)
    assert found is not None
    assert re.search(rf"^\({found[1]}\) the row below it stands in its place", told, flags=re.MULTILINE)
    figures = made("kim2018").figures
    for figure in figures:
        path = folder / f"{figure.name}.png"
        assert path.read_bytes().startswith(b"\x89PNG")
        assert f"{path}: {figure.caption}" in told
    assert len(list(folder.iterdir())) == len(figures)


def outcomes(claims: tuple[Claim, ...]) -> SimpleNamespace:
    return SimpleNamespace(reproduce=lambda: Reproduction("kim2018", claims))


def test_what_should_be_met_and_is_not_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    met = number("a number", "(1)", 671.0, 670.8, unit=1.0)
    known = statement("a word", "(2)", "yes", "no", "the paper [sic] errs")
    wrong = number("another", "Table 3", 4.74e-4, 4.9e-4, unit=1e-6)
    asked = ("kim2018", "--out", str(tmp_path))
    monkeypatch.setitem(sys.modules, "gridsec.papers.kim2018", outcomes((met, known)))  # type: ignore[arg-type]  # has what is called
    code, told, error = run(monkeypatch, capsys, *asked)
    assert (code, error) == (0, "")
    assert "(1) the paper [sic] errs" in told
    assert "2 claims" in told
    monkeypatch.setitem(sys.modules, "gridsec.papers.kim2018", outcomes((met, known, wrong)))  # type: ignore[arg-type]  # as above
    code, told, error = run(monkeypatch, capsys, *asked)
    assert code == 1
    assert [row(told, what)[0] for what in ("a number", "a word", "another")] == [
        "met",
        "differs (1)",
        "not met",
    ]
    assert error == "gridsec: not met: another (Table 3): 0.000474, ours 0.00049\n"


def test_a_reason_that_several_claims_share_is_printed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = statement("first", "(1)", "yes", "no", "the recipe gives zero")
    second = statement("second", "(2)", "yes", "yes", "by thresholds of this project")
    third = statement("third", "(3)", "yes", "no", "the recipe gives zero")
    monkeypatch.setitem(sys.modules, "gridsec.papers.kim2018", outcomes((first, second, third)))  # type: ignore[arg-type]  # as above
    code, told, _ = run(monkeypatch, capsys, "kim2018", "--out", str(tmp_path))
    assert code == 0
    assert [row(told, what)[0] for what in ("first", "second", "third")] == [
        "differs (1)",
        "met (2)",
        "differs (1)",
    ]
    assert told.count("the recipe gives zero") == 1


def test_without_matplotlib_the_numbers_come_and_the_figures_are_missed_aloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(kim2018, "reproduce", lambda: made("kim2018"))
    code, told, error = run(monkeypatch, capsys, "kim2018", "--out", str(tmp_path / "figures"))
    assert code == 0
    assert row(told, "2 M_z eta")[0] == "met"
    assert "they need matplotlib, in a checkout: pip install -e '.[plot]'" in error
    assert not (tmp_path / "figures").exists()


def test_a_paper_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(monkeypatch, capsys, "kim2081")
    assert code == 2
    assert "kim2081" in error
    assert all(paper in error for paper in PAPERS)


def test_a_folder_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    code, _, error = run(monkeypatch, capsys, "kim2018", "--out", str(tmp_path / "file"))
    assert code == 6
    assert "file" in error


def test_every_paper_of_the_references_can_be_reproduced() -> None:
    page = (ROOT / "docs" / "papers.md").read_text()
    for paper in PAPERS:
        assert callable(import_module(f"gridsec.papers.{paper}").reproduce)
        assert f"gridsec reproduce {paper}" in page or f"](papers/{paper}.md)" in page
