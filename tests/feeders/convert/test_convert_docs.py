"""The page on conversion: its example runs and prints what the page says."""

from __future__ import annotations

import io
import logging
import re
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from benchmarks import converters
from feeders.convert.convert import convert
from feeders.convert.round_trip import BALANCED_PU, UNBALANCED_PU
from feeders.model.site import load
from gridsec.errors import FeederInvalid

pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")

PAGE = (Path(__file__).parents[3] / "docs" / "bring-your-own-feeder.md").read_text(encoding="utf-8")


def blocks(kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL)


def test_the_example_becomes_what_the_page_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source, finding, printed = blocks("text")
    Path("street.dss").write_text(source)
    done = convert("street.dss", "my-street")
    assert Path("my-street/conversion.csv").read_text() == blocks("csv")[0]
    assert done.check is not None
    assert done.check.sentence.endswith(finding.strip())
    out = io.StringIO()
    with redirect_stdout(out):
        exec(compile(blocks("python")[0], "page", "exec", dont_inherit=True), {"__name__": "page"})
    assert out.getvalue() == printed


@pytest.mark.acceptance
def test_the_table_of_the_page_is_what_the_benchmark_prints(capsys: pytest.CaptureFixture[str]) -> None:
    table = [[cell.strip() for cell in line.strip("| ").split("|")] for line in PAGE.splitlines()]
    page = {(row[0], row[1]): row[2:] for row in table if len(row) == 7 and row[2].isdigit()}
    assert len(page) >= converters.FEWEST
    assert sum(int(row[0]) > converters.LARGE for row in page.values()) >= converters.FEWEST_LARGE
    for row in page.values():
        assert float(row[3]) <= (UNBALANCED_PU if row[2] == "3" else BALANCED_PU)
    disabled = logging.root.manager.disable
    try:
        with warnings.catch_warnings():
            assert converters.main(["landnetz_kabel_2", "network_mv", "OpenDSS:simbench-lv"]) == 0
    finally:
        logging.disable(disabled)
    printed = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()]
    rows = [row for row in printed if len(row) == 7 and row[2].isdigit()]
    assert len(rows) == 4
    for row in rows:
        there = page[row[0], row[1]]
        assert [*there[:3], there[4]] == [*row[2:5], row[6]]


@pytest.mark.parametrize("source", ["street.dss", "net.json", "simbench:x", "1-LV-rural1--0-sw"])
def test_other_commands_say_how_to_convert(source: str) -> None:
    with pytest.raises(FeederInvalid, match=f"gridsec feeders convert {source} FOLDER"):
        load(source)
