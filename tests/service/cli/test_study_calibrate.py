"""`gridsec study calibrate` on the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from feeders.format.tables import read, write
from feeders.model.site import load
from feeders.simulation.demand import Variation
from feeders.simulation.plant import MeterErrors
from feeders.simulation.recording import record
from feeders.simulation.scenario import Scenario
from tests.service.commands import command

CIGRE = load("cigre-lv")


run = command("study", "calibrate")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "readings.parquet"
    scenario = Scenario(
        seed=1,
        duration_s=2 * 86400.0,
        dt_s=900.0,
        profile_s=0.0,
        variation=Variation(hidden_kw=0.2, hidden_kvar=0.1),
        errors=MeterErrors(report_q=True),
    )
    record(CIGRE, scenario, path)
    return path


def test_a_wrong_bus_is_proposed_and_corrected_in_a_copy_only(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = (
        replace(row, bus="Bus R17") if row.customer == "Load R15" else row for row in CIGRE.tables.customers
    )
    folder, copy, out = tmp_path / "feeder", tmp_path / "copy", tmp_path / "out"
    write(replace(CIGRE.tables, customers=tuple(rows)), folder)
    before = (folder / "customers.csv").read_bytes()
    csv = tmp_path / "readings.csv"
    pd.read_parquet(recording).to_csv(csv, index=False)
    options = ("--readings", str(csv), "--write", str(copy), "--out", str(out))
    code, told, _ = run(monkeypatch, capsys, str(folder), *options, "--journal", str(tmp_path / "journal"))
    assert code == 0
    assert "Proposals" in told
    assert "with 1 corrections" in told
    assert read(copy).customers == CIGRE.tables.customers
    assert (folder / "customers.csv").read_bytes() == before
    assert pd.read_csv(out / "calibrate-proposals.csv")["proposed"].tolist() == ["Bus R15"]
    assert {path.stem for path in out.glob("*.parquet")} == {
        f"calibrate-{name}" for name in ("proposals", "meters", "lines", "customers", "loads", "errors")
    }


def test_files_that_are_right_get_no_proposal(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = ("cigre-lv", "--readings", str(recording), "--look-for", "swap", "--look-for", "meter")
    code, told, _ = run(monkeypatch, capsys, *some)
    assert code == 0
    assert "nothing to propose" in told


def test_wrong_arguments_are_told(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = ("--readings", str(recording))
    code, _, told = run(monkeypatch, capsys, "cigre-lv", *some, "--look-for", "ghosts")
    assert code == 2
    assert "expected one of bus, phase, swap" in " ".join(told.replace("│", " ").split())
    code, _, told = run(monkeypatch, capsys, "cigre-lv", *some, "--exclude", "m99")
    assert code == 2
    assert "no meter m99" in told
    code, _, told = run(monkeypatch, capsys, "kerber-landnetz", *some)
    assert code == 6
    assert "recorded on cigre-lv" in told
    folder = tmp_path / "feeder"
    write(CIGRE.tables, folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for option in ("--out", "--write"):
        code, _, told = run(monkeypatch, capsys, str(folder), *some, option, str(folder))
        assert code == 6
        assert f"{option} {folder}: " in told
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    code, _, told = run(monkeypatch, capsys, "cigre-lv", "--readings", str(tmp_path / "none.parquet"))
    assert code == 6
