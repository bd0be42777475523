"""`gridsec study compare`: tables on the screen, in a file of numbers, and in a document."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from feeders.registry import FAMILIES
from feeders.studies.comparison import BEGIN, END, ComparisonRow
from service.cli import study_compare
from tests.service.commands import command

QUICK = ("--seeds", "1", "--duration", "80", "--max-attacked", "1", "--case", "bias")


run = command("study")


def row(text: str, family: str) -> list[str]:
    """The cells of a family's row on the screen."""
    (line,) = (line for line in text.splitlines() if line.startswith(f"│ {family} "))
    return [cell.strip() for cell in line.split("│")[1:-1]]


def test_numbers_go_to_the_screen_to_a_file_and_into_a_document(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page, numbers = tmp_path / "page.md", tmp_path / "numbers.csv"
    page.write_text(f"# Mine\n{BEGIN}\nold\n{END}\nkept\n", encoding="utf-8")
    names = ("--family", "modal", "--family", "exact-bank")
    code, told, _ = run(
        monkeypatch, capsys, "compare", *QUICK, *names, "--csv", str(numbers), "--write", str(page)
    )
    assert code == 0
    assert "bias: readings of 1 meter at random" in told
    assert row(told, "modal")[1:4] == ["1 of 1", "0", "0"]
    with numbers.open(newline="", encoding="utf-8") as file:
        read = {line["family"]: line for line in csv.DictReader(file)}
    assert list(read) == ["modal", "exact-bank"]
    assert read["exact-bank"]["observers"] == row(told, "exact-bank")[8] == "91"
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Mine\n")
    assert text.endswith(f"{END}\nkept\n")
    assert "old" not in text
    assert "13 meters (errors: site), 9 inverters, M = 1, one run of 80 s at 1 s per case" in text
    command = "gridsec study compare simbench-lv-rural1 --max-attacked 1 --seeds 1 --duration 80"
    assert f"    {command} --family modal --family exact-bank --case bias\n" in text
    assert text.count("| exact-bank |") == 2
    assert text.count("not run") == len(FAMILIES) - 2


def test_what_is_written_in_the_document_during_the_work_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"{BEGIN}\nold\n{END}\n", encoding="utf-8")

    def working(*_: object) -> list[ComparisonRow]:
        with page.open("a", encoding="utf-8") as file:
            file.write("written meanwhile\n")
        return []

    monkeypatch.setattr(study_compare, "_compared", working)
    code, _, error = run(monkeypatch, capsys, "compare", "cigre-lv", *QUICK, "--write", str(page))
    assert code == 0, error
    text = page.read_text(encoding="utf-8")
    assert "old" not in text
    assert text.endswith(f"{END}\nwritten meanwhile\n")


def test_a_family_that_is_refused_tells_why(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told, _ = run(
        monkeypatch, capsys, "compare", "cigre-lv", *QUICK, "--max-attacked", "3", "--family", "exact-bank"
    )
    assert code == 0
    assert "exact-bank: 6 meters" in told


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        (("--family", "oracle"), "modal"),
        (("--case", "bribe"), "coordinated-power"),
        (("--meters", "perfect"), "white"),
        (("--seeds", "0"), "1"),
    ],
)
def test_wrong_names_are_usage_errors(
    wrong: tuple[str, str], hint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, told = run(monkeypatch, capsys, "compare", *wrong)
    assert code == 2
    assert wrong[0] in told
    assert hint in told


def test_a_document_without_markers_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing to replace", encoding="utf-8")
    code, told, error = run(monkeypatch, capsys, "compare", "--write", str(page))
    assert (code, told) == (1, "")
    assert BEGIN in error
    assert page.read_text(encoding="utf-8") == "nothing to replace"


def test_a_feeder_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(monkeypatch, capsys, "compare", "nowhere")
    assert code == 3
    assert "nowhere" in error
