"""The page on conversion: its example runs and prints what the page says."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from feeders.convert import convert
from feeders.load import load
from gridsec.errors import FeederInvalid

pytest.importorskip("opendssdirect", reason="the extra `convert` is not installed")

PAGE = (Path(__file__).parents[2] / "docs" / "bring-your-own-feeder.md").read_text(encoding="utf-8")


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


@pytest.mark.parametrize("source", ["street.dss", "net.json", "simbench:x", "1-LV-rural1--0-sw"])
def test_other_commands_say_how_to_convert(source: str) -> None:
    with pytest.raises(FeederInvalid, match=f"gridsec feeders convert {source} FOLDER"):
        load(source)
