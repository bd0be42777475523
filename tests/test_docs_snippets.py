"""The Python on the pages for researchers runs as it stands there, and prints what they say."""

from __future__ import annotations

import ast
import io
import os
import re
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.mesh import european, landnetz
from feeders.model.site import Site, load
from feeders.registry import DesignedEstimator, DesignOptions, Estimator
from feeders.simulation import trial as trials
from feeders.simulation.attacks import AttackKind, AttackSpec
from feeders.simulation.trial import Trial, TrialMeterErrors
from gridsec.interface import Decision
from tests.acceptance.live import serve
from tests.feeders.registry.test_bad_frames import BEFORE, frames, put

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"```python\n(.*?)```(?:\n```text\n(.*?)```)?", re.DOTALL)
LINES, WIDTH = 10, 110
GRIDSEC = """
import sys
from service.cli.main import main
for words in sys.argv[1:]:
    sys.argv = ["gridsec", *words.split()]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
    print(chr(12))
"""


def blocks(page: str) -> list[tuple[str, str, str | None]]:
    """Heading, code and output of every block of a page."""
    text = (DOCS / page).read_text()
    found = [(m.start(), m[1], m[2]) for m in BLOCK.finditer(text)]
    return [(re.findall(r"^##+ (.*)$", text[:at], re.MULTILINE)[-1], code, out) for at, code, out in found]


PAGES = ("your-own-system.md", "theory-distributed.md")
EVERY = [pytest.param(code, out, id=head) for page in PAGES for head, code, out in blocks(page)]
SLOW = "High-gain observers for a system written in sympy"
MODULE, WATCH = blocks("your-own-estimator.md")


@pytest.mark.canary(*(str(one.id) for one in EVERY if one.id != SLOW))
@pytest.mark.parametrize(("code", "printed"), EVERY)
def test_a_block_prints_what_stands_below_it(code: str, printed: str | None) -> None:
    out = io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(out):
        warnings.simplefilter("error")
        exec(compile(code, "block", "exec", dont_inherit=True), {"__name__": "block"})
    assert out.getvalue() == printed


def test_every_method_takes_ten_lines_besides_the_imports() -> None:
    long = {}
    for head, code, _ in (block for page in PAGES for block in blocks(page)):
        imports = sum(isinstance(one, (ast.Import, ast.ImportFrom)) for one in ast.parse(code).body)
        count = sum(bool(line.strip()) for line in code.splitlines()) - imports
        if count > LINES or max(map(len, code.splitlines())) > WIDTH:
            long[head] = count
    assert not long


def test_every_paper_and_method_has_a_block() -> None:
    text = (DOCS / "your-own-system.md").read_text()
    for name in ("lee2018", "kim2018", "yang2019", "yang2021", "chong2020", "Algorithm 4.1", "Algorithm 4.2"):
        assert name in text
    assert len(blocks("your-own-system.md")) == text.count("\n### ")


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The estimator of the page as an installed package with its entry point, for new processes."""
    (table,) = re.findall(r"```toml\n(.*?)```", (DOCS / "your-own-estimator.md").read_text(), re.DOTALL)
    point = tomllib.loads(table)["project"]["entry-points"]["gridsec.estimators"]
    (tmp_path / "neighbours.py").write_text(MODULE[1])
    about = tmp_path / "neighbours-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: neighbours\nVersion: 1.0\n")
    lines = [f"{name} = {where}" for name, where in point.items()]
    (about / "entry_points.txt").write_text("\n".join(["[gridsec.estimators]", *lines, ""]))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


def run(*command: str) -> str:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-W", "error", *command],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.usefixtures("installed")
def test_the_estimator_watches_a_simulated_feeder_as_the_page_says() -> None:
    assert run("-c", WATCH[1]) == WATCH[2]


@pytest.mark.usefixtures("installed")
@pytest.mark.acceptance
def test_the_estimator_is_listed_compared_with_ours_and_enters_a_campaign() -> None:
    quick = "--family neighbours --seeds 1 --duration 80 --max-attacked 1 --case bias"
    few = "--estimator neighbours --scenarios 3 --duration 30 --workers 1 --kind bias:8 --liars 1"
    told = run(
        *("-c", GRIDSEC, "feeders estimators", f"study compare simbench-lv-rural1 {quick}"),
        f"study campaign simbench-lv-rural1 {few}",
    )
    listed, compared, campaign, _ = told.split("\f\n")
    assert re.search(r"neighbours +│ every meter against the median", listed)
    (row,) = (line for line in compared.splitlines() if line.startswith("│ neighbours "))
    assert row.split("│")[2].strip().endswith("of 1")
    assert "3 scenarios of 30 s monitored by neighbours" in campaign
    assert re.search(r"bias +│ 8 +│ 2 +│ 1 +│ 1 +│ 0 ", campaign)


@pytest.mark.acceptance
def test_the_estimator_serves(installed: Path) -> None:
    with serve("simbench-lv-rural1", installed, "--estimator", "neighbours") as live:
        assert live.get("/api/v1/feeders/simbench-lv-rural1/commissioning")["estimator"] == "neighbours"


def neighbours() -> Estimator:
    """The estimator of the page."""
    space: dict[str, Any] = {"__name__": "neighbours"}
    exec(compile(MODULE[1], "neighbours", "exec", dont_inherit=True), space)
    family = space["FAMILY"]
    assert isinstance(family, Estimator)
    return family


@pytest.mark.canary("landnetz")
@pytest.mark.parametrize("make", [partial(load, "ieee-european-lv"), landnetz, european])
def test_the_estimator_watches_three_phases_and_meshes(make: Callable[[], Site]) -> None:
    family, lie = neighbours(), AttackSpec(AttackKind.BIAS, count=1, size=6.0, onset_s=5.0)
    trial = Trial(make(), seed=1, lie=lie, meters=TrialMeterErrors.SITE, duration_s=10.0)
    made, played = family.design(trial.stated, DesignOptions()), list(trials.frames(trial))
    outcome = trials.judge(DesignedEstimator(family, made), trial, settling_s=3.0, played=played)
    assert (outcome.missed, outcome.false_names.max()) == (0, 0)
    assert outcome.delay_s.tolist() == [2.0]
    # The model is wrong by far less than the 6 % of the lie.
    assert outcome.error_all.max() < 1.0
    first = played[0][0]
    lost = replace(first, v0_squared=np.nan, v0_phases=None)
    if first.v0_phases is not None:
        lost = replace(first, v0_phases=np.array([np.nan, 1.0, 1.0]))
    for bad in (lost, put(first, "p", np.inf)):
        _, estimate, verdict = family.step(made, family.init(made, first.t), bad)
        assert verdict.decision is Decision.UNDECIDED
        assert np.isfinite([*estimate.v2, *estimate.v2_bus, *estimate.bound]).all()


def test_the_estimator_owes_what_the_page_says() -> None:
    family = neighbours()
    made, t = family.design(load("simbench-lv-rural1"), DesignOptions()), frames()[0].t - 1.0
    last = frames()[-1]
    silent = replace(last, y=np.full(last.y.shape, np.nan), seen=np.zeros(last.seen.shape, dtype=np.bool_))
    lost = [silent, replace(last, v0_squared=np.nan)]
    lost += [put(last, name, value) for name in "pq" for value in (np.nan, np.inf, -np.inf, 1e300)]
    for bad in (*lost, put(last, "y", 1e300), put(last, "y", -1.0)):
        state = family.init(made, t)
        for frame in frames()[:BEFORE]:
            state, estimate, verdict = family.step(made, state, frame)
        assert verdict.decision is Decision.CLEAN
        for _ in range(4):
            state, estimate, verdict = family.step(made, state, bad)
            assert verdict.decision is not Decision.CLEAN
            for numbers in (estimate.v2, estimate.bound, estimate.v2_bus, estimate.x, verdict.threshold):
                assert np.isfinite(numbers).all()
        assert verdict.decision is (
            Decision.UNDECIDED if any(bad is one for one in lost) else Decision.ATTACKED
        )
