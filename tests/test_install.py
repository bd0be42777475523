"""Installation: lock files, targets of the Makefile, and messages of commands without their extra."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from tests.service.commands import command, plain

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
RUN_TIME, WHOLE = "requirements.lock", "requirements-dev.lock"
PIN = re.compile(r"^([a-z0-9-]+)==([^ ]+)( ; [^\\]+)? \\$")
HASH = re.compile(r"^    --hash=sha256:[0-9a-f]{64}( \\)?$")
BUILD = "editable"

gridsec = command()


def pins(lock: str) -> dict[tuple[str, str], list[str]]:
    """Hashes by package and its version."""
    out: dict[tuple[str, str], list[str]] = {}
    for line in (ROOT / lock).read_text("utf-8").splitlines():
        if pin := PIN.match(line):
            hashes = out.setdefault((pin[1], pin[2]), [])
        else:
            assert HASH.match(line), line
            hashes.append(line.removesuffix(" \\"))
    return out


def names(requirements: list[str]) -> set[str]:
    """Names of requirements, normalized; extras of this project are followed."""
    out: set[str] = set()
    for each in requirements:
        name, extras = re.match(r"([A-Za-z0-9._-]+)(?:\[(.*?)\])?", each).groups()  # type: ignore[union-attr]
        if name == PROJECT["name"]:
            wanted = PROJECT["optional-dependencies"]
            out |= set().union(*(names(wanted[extra]) for extra in extras.split(",")))
        else:
            out.add(re.sub(r"[-_.]+", "-", name).lower())
    return out


def imported(source: str) -> Iterator[tuple[str, bool]]:
    """Packages that a module imports, and whether on its own import: outside of functions."""
    waiting: list[tuple[ast.AST, bool]] = [(ast.parse(source), True)]
    while waiting:
        node, at_once = waiting.pop()
        if isinstance(node, ast.Import):
            yield from ((each.name.partition(".")[0], at_once) for each in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield str(node.module).partition(".")[0], at_once
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += ((each, at_once) for each in node.orelse)
        elif not isinstance(node, ast.expr):  # no import within
            at_once = at_once and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            waiting += ((each, at_once) for each in ast.iter_child_nodes(node))


def foreign() -> tuple[set[str], set[str]]:
    """Distributions of all foreign packages that the project imports: on the import of a module, or later."""
    sources = (
        path.read_text("utf-8")
        for package in ("gridsec", "feeders", "service")
        for path in (ROOT / package).rglob("*.py")
    )
    found = {one for source in sources for one in imported(source)}
    owners, ours = packages_distributions(), {"gridsec", "feeders", "service"}

    def of(which: bool) -> set[str]:
        wanted = {name for name, at_once in found if at_once is which} - sys.stdlib_module_names - ours
        return names([owners[name][0] for name in wanted])

    return of(True), of(False)


def test_the_lock_files_agree() -> None:
    run_time, whole = pins(RUN_TIME), pins(WHOLE)
    assert len(run_time) > 40
    assert {pin: whole.get(pin) for pin in run_time} == run_time
    assert all(whole.values())


def test_the_lock_files_have_what_the_project_states() -> None:
    extras = PROJECT["optional-dependencies"]
    locked = {lock: {name for name, _ in pins(lock)} for lock in (RUN_TIME, WHOLE)}
    needed, build = names(PROJECT["dependencies"]), names(extras[BUILD])
    assert needed | build <= locked[RUN_TIME]
    assert needed | names(extras["dev"]) <= locked[WHOLE]
    optional = set().union(*(names(each) for each in extras.values())) - needed - build
    assert len(optional) > 10
    assert not locked[RUN_TIME] & optional


def test_modules_import_the_run_time_only() -> None:
    locked = {name for name, _ in pins(RUN_TIME)}
    found, later = foreign()
    assert len(found) > 10
    assert found <= locked
    optional = later - locked
    assert {"pandapower", "simbench", "matplotlib"} <= optional <= names(["gridsec[convert,cluster,plot]"])


def test_imports_of_a_source() -> None:
    source = """
if TYPE_CHECKING:
    import a
else:
    import b
from c.d import e
from . import f
class G:
    import g.h
    def i(self):
        import j
"""
    assert set(imported(source)) == {("b", True), ("c", True), ("g", True), ("j", False)}


def planned(folder: Path, target: str) -> list[str]:
    """Commands that a target would run, in order."""
    done = subprocess.run(
        ["make", "--dry-run", target],
        cwd=folder,
        env={"PATH": os.environ["PATH"]},  # without the flags of a `make` that runs the tests
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return done.stdout.splitlines()


@pytest.mark.skipif(not shutil.which("make"), reason="make is not installed; its targets are not tested")
def test_targets_install_what_they_need(tmp_path: Path) -> None:
    for name in ("Makefile", "pyproject.toml", RUN_TIME, WHOLE):
        shutil.copy(ROOT / name, tmp_path)

    def installed(target: str) -> list[str]:
        """Subjects of pip, each once: a dry run installs nothing, and a sub-make plans it again."""
        lines = [line for line in planned(tmp_path, target) if "-m pip install" in line]
        return list(dict.fromkeys(line.split()[-1] for line in lines))

    assert installed("demo") == [RUN_TIME, "."]
    assert installed("test") == installed("acceptance") == [RUN_TIME, ".", WHOLE]
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv/.installed-demo").touch()
    assert installed("demo") == []
    assert installed("test") == [WHOLE]
    (tmp_path / ".venv/.installed").touch()
    assert planned(tmp_path, "demo") == [".venv/bin/gridsec demo"]
    assert installed("test") == []


@pytest.fixture
def without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str, str], tuple[int, str]]:
    """Exit code and errors of a command without a package, beside two files of other tools."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GRIDSEC_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "net.json").write_text('{"_module": "pandapower.auxiliary", "_class": "pandapowerNet"}')
    (tmp_path / "town.dss").write_text("clear\nnew circuit.town\n")

    def run(package: str, line: str) -> tuple[int, str]:
        monkeypatch.setitem(sys.modules, package, None)
        code, _, error = gridsec(monkeypatch, capsys, *line.split())
        return code, plain(error)

    return run


CAMPAIGN = "study campaign simbench-lv-rural1 --scenarios 1 --dask tcp://127.0.0.1:1"


@pytest.mark.parametrize(
    ("package", "line", "extra"),
    [
        ("pandapower", "convert pandapower:create_kerber_landnetz_kabel_1 out", "convert"),
        ("pandapower", "convert simbench:1-LV-rural2--0-sw out", "convert"),
        ("simbench", "convert simbench:1-LV-rural2--0-sw out", "convert"),
        ("pandapower", "study redundancy simbench:1-LV-rural2--0-sw", "convert"),
        ("pandapower", "convert net.json out", "convert"),
        ("opendssdirect", "convert town.dss out", "convert"),
        ("distributed", CAMPAIGN, "cluster"),
    ],
    ids=["pandapower", "simbench-by-pandapower", "simbench", "study", "json", "opendss", "dask"],
)
def test_a_command_states_its_missing_extra(
    without: Callable[[str, str], tuple[int, str]], package: str, line: str, extra: str
) -> None:
    code, error = without(package, line)
    assert code == 1
    assert f"the extra '{extra}', in a checkout: pip install -e '.[{extra}]'" in error
    assert not Path("out").exists()
