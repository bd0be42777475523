"""`gridsec study campaign` on the command line."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from tests.journals import rows
from tests.service.commands import command, plain

FEW = ("campaign", "cigre-lv", "--scenarios", "3", "--duration", "30", "--workers", "1")


gridsec = command("study")


def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[int, str, str]:
    code, told, error = gridsec(monkeypatch, capsys, *arguments)
    return code, told, plain(error)


def test_tables_are_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, journal = tmp_path / "out", tmp_path / "journal"
    some = ("--kind", "bias:3,5", "--liars", "1", "--place", "random", "--out", str(out))
    code, told, _ = run(monkeypatch, capsys, *FEW, *some, "--journal", str(journal))
    assert code == 0
    assert "cigre-lv: 3 scenarios of 30 s monitored by modal" in told
    assert "By kind and size" in told
    found = pd.read_csv(out / "campaign-scenarios.csv")
    assert found["kind"].tolist() == ["clean", "bias", "bias"]
    assert sorted(found["size"]) == [0.0, 3.0, 5.0]
    assert pd.read_parquet(out / "campaign-by_size.parquet")["scenarios"].sum() == 3
    assert len(rows(journal)) == 1
    # Nothing is left to do, and the answer is the same.
    code, again, _ = run(monkeypatch, capsys, *FEW, *some, "--journal", str(journal))
    assert (code, again) == (0, told)
    code, _, told = run(monkeypatch, capsys, *FEW, "--journal", str(journal))
    assert code == 1
    assert "not the journal of this study" in told


def test_promises_are_played_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = ("campaign", "cigre-lv", "--promised", "--scenarios", "10", "--together", "5", "--duration", "30")
    words = (*some, "--place", "random", "--workers", "1", "--out", str(tmp_path / "out"))
    code, told, _ = run(monkeypatch, capsys, *words)
    assert code == 0
    assert "Guarantees of `study detectable`" in told
    assert "monitored by modal (--promised)" in told
    kept = pd.read_csv(tmp_path / "out" / "campaign-promises.csv").set_index("promise")
    assert kept["lies"].to_dict() == {"hidden": 4, "named": 4}
    assert kept["broken"].sum() == 0
    assert kept["scenes"].max() == 2
    assert set(pd.read_csv(tmp_path / "out" / "campaign-liars.csv")["kind"]) >= {"hidden_alone", "named"}


def test_wrong_arguments_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong, why in (
        (("--kind", "charm:3"), "--kind 'charm:3': expected one of bias, together"),
        (("--kind", "bias:x"), "expected something like bias:1,3"),
        (("--kind", "inverter"), "expected something like bias:1,3"),
        (("--place", "nowhere"), "expected one of random, street, sensitive, colluding"),
        (("--season", "carnival"), "expected one of winter, spring, summer, autumn"),
        (("--estimator", "oracle"), "estimator 'oracle' does not exist"),
        (("--setting", "colour=3"), "'colour' is not a setting"),
        (("--setting", "colour"), "expected NAME=NUMBER"),
        (("--dask", "tcp://127.0.0.1:1"), "a Dask cluster has its own workers"),
    ):
        code, _, told = run(monkeypatch, capsys, *FEW, *wrong)
        assert code == 2
        assert why in told


def test_options_about_lies_need_scenarios_with_lies(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lies = ("--kind", "bias:1", "--place", "street", "--liars", "1")
    for count in (("--scenarios", "1"), ("--together", "1")):
        code, _, told = run(monkeypatch, capsys, "campaign", "cigre-lv", *count, *lies)
        assert code == 2
        assert "--kind, --liars, --place" in plain(told)
        assert "scenario without an attack; expected --scenarios and --together of 2 or more" in plain(told)
        code, _, told = run(monkeypatch, capsys, "campaign", "cigre-lv", *count, "--promised")
        assert (code, "without an attack" in plain(told)) == (2, True)
    clean = ("--scenarios", "1", "--duration", "30", "--workers", "1")
    code, told, _ = run(monkeypatch, capsys, "campaign", "cigre-lv", *clean)
    assert code == 0
    assert "1 scenarios of 30 s" in told


def test_no_cluster_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    code, _, told = run(monkeypatch, capsys, *FEW[:4], "--dask", "nonsense://127.0.0.1")
    assert code == 1
    assert "no Dask scheduler answers at nonsense://127.0.0.1" in told
