"""`gridsec study droop` on the command line."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from feeders.format.tables import write
from tests.feeders.villages import tables, village_without_inverters
from tests.journals import rows
from tests.service.commands import command

FEW = ("--compare", "vde4105", "--tau-factor", "0.1")


run = command("study", "droop")


def test_the_answer_is_told_and_its_tables_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tables(), tmp_path / "village")
    out, journal = tmp_path / "out", tmp_path / "journal"
    arguments = (str(tmp_path / "village"), *FEW, "--hosting", "--hosting-preset", "none", "--draws", "2")
    code, told, _ = run(monkeypatch, capsys, *arguments, "--out", str(out), "--journal", str(journal))
    assert code == 0
    assert "village: the fleet (sampled every 1 s) is stable" in told
    assert "Random places, kW" in told
    written = pd.read_parquet(out / "droop-stability.parquet")
    assert written["point"].tolist() == ["evening", "noon", "half", "any loads"]
    assert pd.read_csv(out / "droop-hosting.csv")["capacity_kw"].iloc[0] > 0
    assert len(rows(journal)) > 10


@pytest.mark.acceptance
def test_a_feeder_without_inverters_says_which_option_helps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "plain")
    write(village_without_inverters().tables, folder)
    code, told, _ = run(monkeypatch, capsys, folder, *FEW)
    assert code == 0
    assert "no inverters: stability does not apply (--preset" in told
    code, answer, _ = run(
        monkeypatch, capsys, folder, *FEW, "--preset", "vde4105", "--interval", "0", "--also", "cigre-lv"
    )
    assert code == 0
    assert "(continuous) is stable" in answer
    assert answer.count("│ vde4105") == 2


def test_wrong_arguments_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong, why in (
        (("--preset", "vde"), "ieee1547-a"),
        (("--who", "me"), "pv, all"),
        (("--hosting-preset", "x"), "none"),
        (("--interval", "0", "--dead", "2"), "short interval"),
        (("--band", "1.1", "0.9"), "band"),
        (("--hosting", "--at", "me"), "no customer 'me'"),
        (("--at", "me"), "only with hosting"),
        (("--hosting", "--unit-kw", "0"), "unit of generation is 0 kW"),
        (("--tau-factor", "0", "--tau-factor", "-1"), "is 0; it must be a positive number; a factor"),
    ):
        code, _, told = run(monkeypatch, capsys, "cigre-lv", *wrong)
        assert code == 2, told
        assert why in " ".join(told.replace("│", " ").split())
