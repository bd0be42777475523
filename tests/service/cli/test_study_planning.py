"""`gridsec study redundancy`, `protect`, `detectable` on the command line."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from tests.service.commands import command, plain

run = command("study")


def test_redundancy_prints_tables_and_writes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, journal = tmp_path / "out", tmp_path / "journal"
    code, told, _ = run(
        monkeypatch,
        capsys,
        *("redundancy", "simbench-lv-rural1", "--silent", "m04"),
        *("--out", str(folder), "--journal", str(journal)),
    )
    assert code == 0
    assert "m05 m12" in told
    assert "Changes without m04" in told
    summary = pd.read_csv(folder / "redundancy-summary.csv")
    assert summary["liars"].tolist()[2] == "m05 m12"
    assert journal.exists()


def test_wrong_arguments_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, told = run(monkeypatch, capsys, "redundancy", "--silent", "m99")
    assert code == 2
    assert "no meter 'm99'" in told
    code, _, told = run(monkeypatch, capsys, "redundancy", "--curves", "flat")
    assert code == 2
    assert "expected one of steepest, deadband" in " ".join(told.replace("│", " ").split())


def test_protect_tells_the_meters_and_what_they_are_worth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = ("--unknown", "LV1.101 Load 8", "--out", str(tmp_path / "out"))
    code, told, _ = run(monkeypatch, capsys, "protect", *some)
    assert code == 0
    assert "protect 1 of 13 meters; no fewer suffice" in told
    assert "fewest meters of an invisible attack: 1 before, ∞ after" in told
    assert pd.read_csv(tmp_path / "out" / "protect-meters.csv")["meter"].tolist() == ["m08"]


def test_the_usual_question_has_an_answer_where_all_powers_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told, _ = run(monkeypatch, capsys, "protect", "--out", str(tmp_path / "out"))
    assert code == 0
    assert "protect 1 of 13 meters; no fewer suffice" in told
    row = pd.read_csv(tmp_path / "out" / "protect-summary.csv").iloc[0]
    assert row["goal"] == "contain"
    assert row["alone"] < row["after"] <= row["lie_volt"] < row["before"] < 8.0
    for goal in ("identify", "notice"):
        code, told, _ = run(monkeypatch, capsys, "protect", "--goal", goal)
        assert code == 0
        assert f"{goal} requires no protection here; that is no safety" in told
        assert "suffice" not in told


def test_an_infeasible_protection_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, told = run(monkeypatch, capsys, "protect", "--unknown", "LV1.101 Load 8", "--never", "m08")
    assert code == 3
    assert "m08 alone succeeds whatever else is protected, and it cannot be" in " ".join(told.split())
    code, _, told = run(monkeypatch, capsys, "protect", "--goal", "all")
    assert code == 2
    assert "expected one of identify, notice, bound, contain" in " ".join(told.replace("│", " ").split())


def test_detectable_tells_sizes_and_keeps_its_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = ("--max-attacked", "1", "--trials", "3", "--out", str(tmp_path / "out"))
    code, told, _ = run(monkeypatch, capsys, "detectable", "cigre-lv", *some)
    assert code == 0
    assert "3 attacks up to the hidden size: 0 with a meter named" in told
    assert "3 attacks from the named size on: 0 missed, 0 with an honest meter named" in told
    assert len(pd.read_csv(tmp_path / "out" / "detectable-meters.csv")) == 6
    (trials,) = pd.read_csv(tmp_path / "out" / "detectable-trials.csv").to_dict("records")
    assert trials == {"trials": 3, "hidden_named": 0, "large_missed": 0, "honest_named": 0}


def test_feeders_in_three_phases_are_studied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", str(tmp_path))
    code, told, _ = run(monkeypatch, capsys, "redundancy", "ieee-european-lv", *out)
    assert code == 0
    assert "53" in told
    meters = pd.read_csv(tmp_path / "redundancy-meters.csv")
    assert meters["bus"].str[-2:].isin([".a", ".b", ".c"]).all()
    assert pd.read_csv(tmp_path / "redundancy-summary.csv")["index"].tolist() == [float("inf"), 53.0]
    code, told, _ = run(monkeypatch, capsys, "protect", "ieee-european-lv", "--goal", "identify")
    assert code == 0
    assert "identify requires no protection here; that is no safety" in told
    assert "--goal contain" in told


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("campaign", "cigre-lv", "--duration", "inf"), "--duration"),
        (("campaign", "cigre-lv", "--step", "inf"), "--step"),
        (("compare", "cigre-lv", "--duration", "inf"), "--duration"),
        (("report", "cigre-lv", "--load-error-kw", "inf"), "--load-error-kw"),
        (("detectable", "cigre-lv", "--trials", "2", "--seed", "-1"), "--seed"),
        (("detectable", "cigre-lv", "--share", "inf"), "--share"),
    ],
)
def test_numbers_that_cannot_be_are_refused_before_the_work(
    words: tuple[str, ...],
    option: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, told = run(monkeypatch, capsys, *words)
    assert code == 2
    assert f"Invalid value for '{option}'" in plain(told)
    assert not list(tmp_path.iterdir())
