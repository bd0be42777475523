"""docs/studies.md: its programs run, and its numbers are those of today."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from feeders.studies.protect import Goal, protect
from feeders.studies.redundancy import redundancy
from tests.feeders.studies.rural import RURAL, rural_sizes

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "studies.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


STUDIES = [re.findall(r"feeders\.studies\.(\w+)", program)[0] for program in PROGRAMS]


@pytest.mark.canary("redundancy0", "protect")
@pytest.mark.parametrize("program", PROGRAMS, ids=STUDIES)
def test_programs_run(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(program, "docs/studies.md", "exec"), {})
    assert capsys.readouterr().out.strip()


def cells(*begin: str) -> list[str]:
    """The other cells of the row that begins with these."""
    (line,) = (line for line in PAGE.splitlines() if line.startswith("| " + " | ".join(begin) + " |"))
    return [cell.strip() for cell in line.split("|")[1 + len(begin) : -1]]


def told(number: float) -> str:
    return "∞" if number == float("inf") else f"{number:g}"


def test_numbers_of_redundancy() -> None:
    names = ["meters", "patterns", "index", "detected", "identified"]
    for row in redundancy(RURAL, silent=["m04"]).summary.to_dict("records"):
        assert cells(row["case"], row["attack"]) == [*(told(row[name]) for name in names), row["liars"]]


def test_numbers_of_protect() -> None:
    some = protect(RURAL, max_attacked=2, unknown=["LV1.101 Load 4", "LV1.101 Load 8"])
    for row in some.meters.to_dict("records"):
        assert cells(row["meter"]) == [row["customer"], row["bus"], str(row["attacks"])]
    usual = protect(RURAL, max_attacked=2)
    assert usual.meters["meter"].tolist() == ["m13"]
    assert f"largest hidden attack, V: {usual.before:.4g} before, {usual.after:.4g} after" in PAGE
    assert f"(contain): at most {usual.lie_volt:.4g}; one meter hides {usual.alone:.4g}" in PAGE
    found = protect(RURAL, max_attacked=2, goal=Goal.BOUND, lie_volt=4.5)
    assert f"largest hidden attack, V: {found.before:.4g} before, {found.after:.4g} after" in PAGE


def test_numbers_of_detectable() -> None:
    found = rural_sizes()
    names = ["hidden", "noticed", "named", "fits", "identified"]
    meters = found.meters.set_index("meter")
    for meter in ("m02", "m13"):
        for who, suffix in (("alone", "_alone"), ("with one more", "")):
            sizes = [f"{meters.loc[meter, name + suffix]:.2f}" for name in names]
            assert cells(f"{meter}, {who}") == sizes
            learned = ("undetected", "found", "unavoidable")
            sizes = [f"{meters.loc[meter, name + suffix]:.3f}" for name in learned]
            assert cells(f"{meter}, {who}, learned") == sizes
            initial = ("undetected_initial", "found_initial")
            sizes = [f"{meters.loc[meter, name + suffix]:.2f}" for name in initial]
            assert cells(f"{meter}, {who}, initial") == sizes
    customers = found.customers.set_index("customer")
    for name in ("LV1.101 Load 13", "LV1.101 Load 2"):
        errors = [f"{customers.loc[name, column]:.2f}" for column in ("error", "error_fits")]
        assert errors == cells(name)
