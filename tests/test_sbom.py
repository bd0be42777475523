"""Bill of materials: the installed packages of the lock file, with their dependencies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
BUILD = {"hatchling", "editables", "setuptools"}
"""The build backend and its needs; no package of the run time depends on them."""


def made(lock: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, ROOT / "deploy" / "sbom.py", lock]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env={**os.environ, **environment}
    )


@pytest.fixture(scope="module")
def bill() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(made(ROOT / "requirements.lock").stdout)
    return found


def test_it_has_the_installed_packages_of_the_lock_file(bill: dict[str, Any]) -> None:
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.6", 1)
    assert bill["metadata"]["component"]["name"] == "gridsec"
    parts = {each["name"]: each for each in bill["components"]}
    assert len(parts) == len(bill["components"]) > 50
    assert {"numpy", "eclipse-zenoh", "psycopg-binary"} <= parts.keys()
    assert not {"pytest", "pandapower", "colorama"} & parts.keys()
    for name, each in parts.items():
        assert each["version"] == version(name)
        assert each["purl"] == each["bom-ref"] == f"pkg:pypi/{name}@{each['version']}"
        assert all(len(one["value"]) == 64 for one in each["properties"])
    unlicensed = {name for name, each in parts.items() if not each.get("licenses")}
    assert unlicensed <= {"qdldl"}  # its metadata state none


def test_every_package_is_needed(bill: dict[str, Any]) -> None:
    """The graph leads from the project to every component but those of the build."""
    needs = {each["ref"]: each["dependsOn"] for each in bill["dependencies"]}
    names = {each["bom-ref"]: each["name"] for each in bill["components"]}
    assert {ref for each in needs.values() for ref in each} <= names.keys()
    reached, waiting = set(), [bill["metadata"]["component"]["bom-ref"]]
    while waiting:
        ref = waiting.pop()
        if ref not in reached:
            reached.add(ref)
            waiting += needs[ref]
    build = {ref for ref, name in names.items() if name in BUILD}
    waiting = list(build)
    while waiting:
        ref = waiting.pop()
        build.add(ref)
        waiting += [each for each in needs[ref] if each not in build]
    assert names.keys() <= reached | build


@pytest.mark.acceptance
def test_the_same_installation_gives_the_same_file(bill: dict[str, Any]) -> None:
    dated = json.loads(made(ROOT / "requirements.lock", SOURCE_DATE_EPOCH="1795212000").stdout)
    assert dated["metadata"]["timestamp"] == "2026-11-20T22:00:00Z"
    assert "timestamp" not in bill["metadata"]
    assert dated["components"] == bill["components"]
    assert dated["serialNumber"] != bill["serialNumber"]
    assert json.loads(made(ROOT / "requirements.lock").stdout) == bill


def test_another_version_than_that_of_the_lock_file_is_an_error(tmp_path: Path) -> None:
    lock = tmp_path / "requirements.lock"
    lock.write_text("numpy==1.0.0 \\\n    --hash=sha256:" + "0" * 64 + "\nabsent-package==1.0\n")
    done = made(lock)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"numpy {version('numpy')} is installed; expected 1.0.0\n"
