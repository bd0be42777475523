"""The comparison: numbers from known outcomes, rows for those who cannot, and the page that holds it."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from feeders.model.site import Site, from_tables, load
from feeders.registry import FAMILIES, choose, design
from feeders.simulation.attacks import AttackKind
from feeders.simulation.trial import judge
from feeders.studies.comparison import (
    BEGIN,
    CASES,
    END,
    FEEDER,
    HEADERS,
    ComparisonCase,
    ComparisonPlan,
    ComparisonRow,
    cells,
    compare,
    markdown,
    splice,
    write_csv,
)
from gridsec.errors import GridsecError, InputInvalid
from tests.codes import refused

PAGE = Path(__file__).resolve().parents[3] / "docs" / "estimators.md"

SHORT = ComparisonPlan(
    max_attacked=1,
    seeds=2,
    duration_s=90.0,
    families=("modal", "exact-bank"),
    cases=("clean", "bias"),
)


def without_meters(site: Site, kept: int) -> Site:
    rows = site.tables.customers
    few = tuple(row if k < kept else replace(row, meter="") for k, row in enumerate(rows))
    return from_tables(replace(site.tables, customers=few))


def test_rows_are_what_the_runs_of_one_family_add_up_to() -> None:
    """Oracle: the same trials, judged one by one."""
    site = load(FEEDER)
    told: list[str] = []
    rows = {(row.family, row.case): row for row in compare(site, SHORT, progress=told.append)}
    assert list(rows) == [(name, case) for case in SHORT.cases for name in SHORT.families]
    assert told[:2] == ["design of modal", "design of exact-bank"]
    bias = next(case for case in CASES if case.name == "bias")
    trials = [SHORT.trial(site, bias, seed) for seed in range(2)]
    stated = trials[0].stated
    watcher = design(choose(stated, estimator="exact-bank", max_attacked=1))
    outcomes = [judge(watcher, trial) for trial in trials]
    row = rows["exact-bank", "bias"]
    assert (row.liars, row.named, row.missed, row.falsely_named) == (2, 2, 0, 0)
    assert row.delay_s == np.median([one.delay_s[0] for one in outcomes])
    errors = np.sort(np.concatenate([one.error_all for one in outcomes]))
    assert errors[int(0.94 * errors.size)] <= row.error_all <= errors[int(np.ceil(0.96 * errors.size))]
    assert row.undecided == np.mean([one.undecided.mean() for one in outcomes])
    assert row.observers == watcher.observers == 91
    assert 0.0 < row.step_ms <= row.step_ms_95
    clean = rows["modal", "clean"]
    assert (clean.liars, clean.named, clean.missed, clean.reason) == (0, 0, 0, "")
    assert math.isnan(clean.false_clean)
    assert math.isnan(clean.error_liars)


def test_a_family_that_cannot_be_designed_keeps_its_row_with_the_reason() -> None:
    plan = replace(SHORT, max_attacked=2, seeds=1, cases=("clean",))
    bank, other = sorted(compare(without_meters(load(FEEDER), 4), plan), key=lambda row: row.family)
    assert "4 meters" in bank.reason
    assert (bank.liars, bank.observers) == (0, 0)
    assert math.isnan(bank.step_ms)
    assert other.reason == ""


def test_a_lie_that_cannot_be_told_is_a_reason_too() -> None:
    plan = replace(SHORT, max_attacked=2, seeds=1, cases=("bias",), families=("modal",))
    (row,) = compare(without_meters(load(FEEDER), 1), plan)
    assert "cannot attack 2" in row.reason


def test_a_family_that_fails_while_it_watches_leaves_the_others_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other's row is the one that it has without it."""
    plan = replace(SHORT, seeds=1, duration_s=20.0, cases=("clean",))
    site, made, ticks = load("cigre-lv"), FAMILIES["exact-bank"], iter(range(10))

    def step(prepared: Any, state: Any, frame: Any) -> Any:
        if next(ticks) == 9:
            raise ZeroDivisionError("a defect\nof the other package")
        return made.step(prepared, state, frame)

    (alone,) = compare(site, replace(plan, families=("modal",)))
    monkeypatch.setitem(FAMILIES._known, "exact-bank", replace(made, step=step))
    row, broken = compare(site, plan)
    assert broken.reason == "failed in a step: ZeroDivisionError: a defect of the other package"
    assert (broken.case, broken.observers) == ("clean", 0)
    assert replace(row, step_ms=0.0, step_ms_95=0.0) == replace(alone, step_ms=0.0, step_ms_95=0.0)


def test_a_plan_that_compares_nothing_is_refused_with_all_that_is_wrong() -> None:
    with refused(InputInvalid, "unknown-name", "unknown-name", "not-positive"):
        ComparisonPlan(families=("modal", "bank"), cases=("biass",), seeds=0)


def test_cases_lie_as_they_say() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    assert CASES[0].lie(2) is None
    tricks = {case.trick for case in CASES}
    assert tricks >= {
        None,
        AttackKind.BIAS,
        AttackKind.COORDINATED,
        AttackKind.COORDINATED_POWER,
        AttackKind.DRIFT,
    }
    assert tricks >= {AttackKind.STUCK, AttackKind.REPLAY, AttackKind.INVERTER}
    assert [case.lie(2).count for case in CASES if (case.lie(2)) is not None] == [2] * 6 + [1]  # type: ignore[union-attr]
    assert ComparisonCase("x", "", AttackKind.BIAS, 1.0, one=True).lie(7) is not None


# ---------------------------------------------------------------------------------------------- on paper

ROWS = [
    ComparisonRow(
        "modal", "clean", "", 0, 0, 0, 0, 0.0, math.nan, math.nan, 0.1, 0.4, 2.0, 1, math.nan, 0.01
    ),
    ComparisonRow("exact-bank", "clean", "too few | meters,\n 2 of 5"),
    ComparisonRow("modal", "bias", "", 6, 5, 1, 2, 0.1, 4.0, 0.25, math.inf, 0.4, 2.0, 1, 0.5, 0.01),
    ComparisonRow("exact-bank", "bias", "too few | meters,\n 2 of 5"),
]


def tables(text: str) -> list[list[list[str]]]:
    """The tables of a Markdown text, as rows of cells, the ruler left out."""
    found: list[list[list[str]]] = [[]]
    for line in text.splitlines():
        if line.startswith("| "):
            row = [cell.strip() for cell in line.replace("\\|", "/")[1:-1].split("|")]
            if set(row[0]) != {"-"}:
                found[-1].append(row)
        elif found[-1]:
            found.append([])
    return [table for table in found if table]


def test_a_row_becomes_cells() -> None:
    assert cells(ROWS[0])[1:] == ("0 of 0", "0", "0", "", "", "0.100", "0.40 (2.0)", "1", "", "1")
    assert cells(ROWS[1]) == ("exact-bank", ROWS[1].reason)
    assert cells(ROWS[2])[1:7] == ("5 of 6", "1", "2", "4", "0.250", "∞")


def test_markdown_has_a_row_for_every_family_in_every_table() -> None:
    overview, *single = tables(markdown(ROWS, SHORT))
    assert overview[0] == ["family", "clean", "bias"]
    assert overview[1] == ["modal", "0/0 (0)", "5/6 (2)"]
    assert overview[2] == ["exact-bank", "none", "none"]
    for table in (overview, *single):
        assert tuple(row[0] for row in table[1:]) == tuple(FAMILIES)
    assert [len(row) for table in single for row in table] == [len(HEADERS)] * 2 * (len(FAMILIES) + 1)
    assert single[0][2][1] == "too few / meters, 2 of 5"
    assert single[1][3][1] == "not run"


def test_only_what_is_between_the_markers_changes() -> None:
    page = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    assert splice(page, "new\n") == f"before\n{BEGIN}\n\nnew\n\n{END}\nafter\n"
    assert splice(splice(page, "x"), "y") == splice(page, "y")
    for wrong in ("", BEGIN, END + BEGIN, f"{BEGIN}{BEGIN}{END}", f"{BEGIN}{END}{END}"):
        with refused(GridsecError, "missing"):
            splice(wrong, "new")


def test_csv_holds_every_number(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    write_csv(ROWS, path)
    with path.open(newline="", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert [row["family"] for row in read] == [row.family for row in ROWS]
    assert read[1]["reason"] == ROWS[1].reason
    assert float(read[2]["error_liars"]) == 0.25
    assert math.isinf(float(read[2]["error_all"]))
    assert set(read[0]) == set(ComparisonRow.__dataclass_fields__)


def test_a_csv_that_cannot_be_completed_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    write_csv(ROWS, path)
    before = path.read_bytes()

    def breaking() -> Iterator[ComparisonRow]:
        yield ROWS[0]
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        write_csv(breaking(), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_to_a_csv_stays_one_and_a_pipe_is_written(tmp_path: Path) -> None:
    link = tmp_path / "link.csv"
    link.symlink_to("rows.csv")
    write_csv(ROWS, link)
    assert link.is_symlink()
    assert (tmp_path / "rows.csv").is_file()
    reading, writing = os.pipe()
    write_csv(ROWS[:1], Path(f"/dev/fd/{writing}"))
    os.close(writing)
    with os.fdopen(reading, encoding="utf-8") as told:
        assert len(told.readlines()) == 2


def test_the_page_has_a_row_and_a_sentence_for_every_family() -> None:
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    inside, _, after = rest.partition(END)
    overview, *single = tables(inside)
    assert overview[0] == ["family", *(case.name for case in CASES)]
    for table in (overview, *single):
        assert tuple(row[0] for row in table[1:]) == tuple(FAMILIES)
    assert len(single) == len(CASES)
    assert "gridsec study compare" in before
    told = [line.split("**")[1] for line in after.splitlines() if line.startswith("- **")]
    assert tuple(told) == tuple(FAMILIES)
