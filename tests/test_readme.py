"""What the README shows is run as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.acceptance.live import Fleet, serve

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
API, PUBLISH = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_the_python_example_names_the_liars() -> None:
    done = subprocess.run(
        [sys.executable, "-c", API], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    decision, reason, voltages = done.stdout.split("\n", 2)
    assert re.fullmatch(r"attacked \['m\d+', 'm\d+'\]", decision)
    assert reason
    assert len(re.findall(r"2\d\d\.", voltages)) == 13


@pytest.mark.acceptance
def test_the_publishing_example_arrives(tmp_path: Path) -> None:
    with serve("simbench-lv-rural1", tmp_path, clock="wall") as live, Fleet(live) as fleet:
        code = PUBLISH.replace("7447", str(live.zenoh_port))
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
        query = re.search(r"curl 'http://127\.0\.0\.1:8000([^']+)'", README)
        assert query is not None
        assert live.get(query[1])["alarms"] == []
        # One reading counts for two seconds and a half: the state now may be a later one.
        meters = {m["meter"]: m for m in fleet.first(lambda s: s["meters"][0]["seen"])["meters"]}
        assert meters["m01"]["v_volt_reported"] == pytest.approx(231.4)
        assert not meters["m02"]["seen"]


@pytest.mark.parametrize("page", ["README.md", "docs/operations.md"])
def test_the_publishers_name_what_they_need(page: str) -> None:
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (zenoh,) = (each for each in needed if each.startswith("eclipse-zenoh"))
    before, _, _ = (ROOT / page).read_text().partition("```python\nimport json, time, zenoh")
    assert f"`pip install '{zenoh}'`" in before[-300:]


def test_nothing_is_installed_by_a_name_that_is_not_published() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    for page in pages:
        text = page.read_text()
        assert not re.search(r"install '?gridsec", text), page
        for named in re.findall(r"pip install -e '\.\[(.*?)\]'", text):
            assert set(named.split(",")) <= extras, page
