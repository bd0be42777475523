"""Estimators of other packages: found by name without running them, loaded once, refused with a reason."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from feeders import estimators, outside
from feeders.columns import ESTIMATORS, OWN_ESTIMATORS
from feeders.estimators import Families, Family
from feeders.outside import EstimatorUnusable

GOOD = """
from feeders.estimators import Family

print("loaded")
FAMILY = Family("mine", "what", lambda s, j: s, lambda d, t: t, lambda d, s, f: s, lambda d: 1, lambda d: "")
OTHER = "no family"
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def install(place: Path, package: str, code: str, *points: str) -> None:
    (place / f"{package}.py").write_text(code)
    about = place / f"{package}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("\n".join([f"[{outside.GROUP}]", *points, ""]))
    importlib.invalidate_caches()


def test_names_are_known_without_running_anything(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    install(
        place, "pkg_a", GOOD, "mine = pkg_a:FAMILY", "sequential = pkg_a:FAMILY", "Not a name = pkg_a:FAMILY"
    )
    assert set(outside.names(OWN_ESTIMATORS)) - set(ESTIMATORS) == {"mine"}
    assert not capsys.readouterr().out


def test_a_family_is_loaded_when_it_is_asked_for(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(place, "pkg_b", GOOD, "mine = pkg_b:FAMILY")
    monkeypatch.setattr(estimators, "ESTIMATORS", (*ESTIMATORS, "mine"))
    families = Families(estimators.FAMILIES[name] for name in OWN_ESTIMATORS)
    assert list(families) == [*ESTIMATORS, "mine"]
    assert not capsys.readouterr().out
    assert families["mine"].summary == "what"
    assert families["mine"] is families["mine"]
    assert capsys.readouterr().out == "loaded\n"
    with pytest.raises(KeyError):
        families["nobody's"]


def test_what_cannot_be_used_is_refused_by_name(place: Path) -> None:
    install(place, "pkg_c", "raise RuntimeError('out of order')", "broken = pkg_c:FAMILY")
    install(place, "pkg_d", GOOD, "other = pkg_d:OTHER", "alias = pkg_d:FAMILY", "twice = pkg_d:FAMILY")
    install(place, "pkg_e", GOOD, "twice = pkg_e:FAMILY")
    for name, why in (
        ("broken", "pkg_c:FAMILY of pkg_c.* cannot be loaded: out of order"),
        ("other", "is no Family of that name"),
        ("alias", "is no Family of that name"),
        ("twice", "2 packages offer it"),
        ("nobody", "0 packages offer it"),
    ):
        with pytest.raises(EstimatorUnusable, match=why):
            outside.load(name, Family)


def test_a_broken_one_leaves_the_others_alone(place: Path) -> None:
    install(place, "pkg_f", "raise RuntimeError('out of order')", "broken = pkg_f:FAMILY")
    code = (
        "from service.cli import main\n"
        "from feeders.comparison import Plan, compare\n"
        "from feeders.load import load\n"
        "who = ('broken', 'l0-decoder')\n"
        "plan = Plan(max_attacked=1, seeds=1, duration_s=70, cases=('bias',), families=who)\n"
        "print([(row.family, row.reason, row.liars) for row in compare(load('simbench-lv-rural1'), plan)])\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "feeders", "estimators"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={"PYTHONPATH": str(place), "COLUMNS": "200", "OPENBLAS_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    rows, listing = done.stdout.split("\n", 1)
    assert "('l0-decoder', '', 1)" in rows
    assert "out of order" in rows
    assert "out of order" in listing
    assert all(name in listing for name in OWN_ESTIMATORS)
