"""Estimators of other packages: found by name without running them, loaded once, refused with a reason."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from feeders import registry
from feeders.format.columns import ESTIMATORS, OWN_ESTIMATORS, foreign_estimators
from feeders.model.site import Site, load
from feeders.registry import DesignOptions, Estimator, EstimatorUnusable, Families
from gridsec.errors import DesignInfeasible, FeederInvalid, NotObservable
from tests.codes import refused

GOOD = """
from feeders.registry import Estimator

print("loaded")
FAMILY = Estimator(
    "mine", "what", lambda s, j: s, lambda d, t: t, lambda d, s, f: s, lambda d: 1, lambda d: ""
)
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
    (about / "entry_points.txt").write_text("\n".join([f"[{registry.GROUP}]", *points, ""]))
    importlib.invalidate_caches()


def test_names_are_known_without_running_anything(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    install(place, "pkg_a", GOOD, "mine = pkg_a:FAMILY", "modal = pkg_a:FAMILY", "Not a name = pkg_a:FAMILY")
    assert set(foreign_estimators()) - set(ESTIMATORS) == {"mine"}
    assert not capsys.readouterr().out


def test_a_family_is_loaded_when_it_is_asked_for(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(place, "pkg_b", GOOD, "mine = pkg_b:FAMILY")
    monkeypatch.setattr(registry, "ESTIMATORS", (*ESTIMATORS, "mine"))
    families = Families(registry.FAMILIES[name] for name in OWN_ESTIMATORS)
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
        ("broken", "cannot be loaded: out of order"),
        ("other", "is no Estimator of that name"),
        ("alias", "is no Estimator of that name"),
        ("twice", "2 packages offer it"),
        ("nobody", "0 packages offer it"),
    ):
        with refused(EstimatorUnusable, "estimator-unusable") as caught:
            registry.load_foreign(name, Estimator)
        assert why in str(caught.value)


def test_what_a_design_says_on_purpose_is_passed_on_and_all_else_is_one_line() -> None:
    site, job = load("cigre-lv"), DesignOptions()

    def failing(error: Exception) -> Callable[[Site, DesignOptions], None]:
        def design(_: Site, __: DesignOptions) -> None:
            raise error

        return design

    assert registry.design_foreign("mine", lambda site, job: (site, job), site, job) == (site, job)
    for known in (NotObservable((0,), 1, "too few"), DesignInfeasible("design", "not found")):
        with pytest.raises(type(known)) as told:
            registry.design_foreign("mine", failing(known), site, job)
        assert told.value is known
    for other in (FeederInvalid(["of two", "reasons"]), KeyError("x"), MemoryError()):
        with refused(EstimatorUnusable, "estimator-unusable") as told:
            registry.design_foreign("mine", failing(other), site, job)
        assert type(other).__name__ in str(told.value)
        assert "\n" not in str(told.value)
        assert told.value.__cause__ is other


@pytest.mark.acceptance
def test_a_broken_one_leaves_the_others_alone(place: Path) -> None:
    install(place, "pkg_f", "raise RuntimeError('out of order')", "broken = pkg_f:FAMILY")
    install(place, "pkg_g", GOOD.replace("lambda s, j: s", "lambda s, j: s.nothing"), "mine = pkg_g:FAMILY")
    code = (
        "from service.cli.main import main\n"
        "from feeders.studies.comparison import ComparisonPlan, compare\n"
        "from feeders.model.site import load\n"
        "who = ('broken', 'mine', 'l0-decoder')\n"
        "plan = ComparisonPlan(max_attacked=1, seeds=1, duration_s=70, cases=('bias',), families=who)\n"
        "print([(row.family, row.reason, row.liars) for row in compare(load('simbench-lv-rural1'), plan)])\n"
        "main()\n"
    )
    done = run(place, code, "feeders", "estimators")
    assert done.returncode == 0, done.stderr
    _, rows, listing = done.stdout.split("\n", 2)
    why = "estimator 'mine' cannot be designed for simbench-lv-rural1: AttributeError: 'Site' object has no"
    assert why in rows
    assert "('l0-decoder', '', 1)" in rows
    assert "out of order" in rows
    assert "out of order" in listing
    assert all(name in listing for name in OWN_ESTIMATORS)
    code = "from service.cli.main import main\nmain()\n"
    few = ("--scenarios", "16", "--duration", "60", "--workers", "1", "--no-journal")
    done = run(place, code, "study", "campaign", "simbench-lv-rural1", "--estimator", "mine", *few)
    assert done.returncode == 1
    assert why in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def run(place: Path, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={"PYTHONPATH": str(place), "COLUMNS": "200", "OPENBLAS_NUM_THREADS": "1"},
    )
