"""Benchmarks are run by hand: that they still fit to what they measure is seen here."""

from __future__ import annotations

import importlib
import re
import runpy
import sys
from pathlib import Path

import httpx
import pytest

from benchmarks import overview, traces
from benchmarks._arguments import arguments
from service.store import Store

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for file in (ROOT / "benchmarks").rglob("*.py")
    if not file.stem.startswith("__")
)
ASKING = [
    name
    for name in MODULES
    if "._" not in name
    and re.search(
        r"import arguments$|ArgumentParser\(",
        (ROOT / f"{name.replace('.', '/')}.py").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
]


@pytest.mark.parametrize("name", MODULES)
def test_every_benchmark_can_be_imported(name: str) -> None:
    assert importlib.import_module(name).__doc__


@pytest.mark.parametrize("name", ASKING)
def test_a_benchmark_that_is_asked_for_help_gives_it_and_does_nothing_else(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for words, code in ((["--help"], 0), (["--nosuch"], 2)):
        monkeypatch.setattr("sys.argv", [name, *words])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / f"{name.replace('.', '/')}.py"), run_name="__main__")
        assert ended.value.code == code
    assert capsys.readouterr().out.startswith("usage: ")
    assert list(tmp_path.iterdir()) == []


def test_arguments_of_benchmarks_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = {"seeds": 5, "kw": 0.6, "full": False, "feeders": ("a", "b")}
    monkeypatch.setattr("sys.argv", ["x"])
    assert vars(arguments("", **usual)) == usual
    monkeypatch.setattr("sys.argv", ["x", "3", "--full", "0.5", "c"])
    assert vars(arguments("", **usual)) == {"seeds": 3, "kw": 0.5, "full": True, "feeders": ["c"]}
    for wrong in (["0"], ["x"], ["1.5"], ["1", "nan"], ["1", "-1"]):
        monkeypatch.setattr("sys.argv", ["x", *wrong])
        with pytest.raises(SystemExit):
            arguments("", **usual)


def test_the_overview_serves_clean_and_attacked_feeders(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        fleet = overview.Fleet(store, overview.EVERY // 2 + 1)
        with overview.served(fleet) as url, httpx.Client(base_url=url, timeout=20) as client:
            found = client.get("/api/v1/feeders", params=overview.HEAD).json()
            assert found["feeders"][0]["suspects"] == 2
            fleet.attack("feeder-0001")
            changed = client.get("/api/v1/feeders", params=overview.HEAD).json()
    assert (found["counts"]["attacked"], found["counts"]["clean"]) == (1, overview.EVERY // 2)
    assert changed["counts"]["attacked"] == 2


def test_a_trace_counts_functions_at_run_time_and_nothing_of_an_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "traced_low.py").write_text(
        "class Low:\n    x = 1\n\n\ndef at_import():\n    pass\n\n\ndef run():\n    pass\n"
    )
    (tmp_path / "traced_top.py").write_text(
        "import traced_low\n\ntraced_low.at_import()\n\n\ndef run():\n    class Inner:\n        pass\n\n"
        "    traced_low.run()\n    [traced_low.run() for _ in range(2)]\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(traces, "PACKAGES", (str(tmp_path),))

    def trip(module: str) -> traces.Trip:
        return traces.of(lambda: importlib.import_module(module).run())

    first, again = trip("traced_top"), trip("traced_top")
    for module in ("traced_top", "traced_low"):
        sys.modules.pop(module)
    names = {code.co_name for code in first.functions} - {"<listcomp>"}
    assert names == {"run"}
    assert {Path(file).stem for file in first.files} == {"traced_top", "traced_low"}
    assert (first.files, first.changes) == (again.files, again.changes)
    assert first.files[str(tmp_path / "traced_low.py")] == 3
