"""End of every study's output: conclusion with its tables' numbers, meanings of columns, and a figure."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from feeders.format.tables import write
from feeders.model.site import load
from feeders.report import conclusions
from feeders.report.text import legend, said
from feeders.simulation.plant import MeterErrors
from feeders.simulation.recording import record
from feeders.simulation.scenario import Scenario
from gridsec.papers import draw
from service.cli import console
from service.cli.study_words import cell_text, tables
from tests.feeders.villages import village_without_inverters, with_long_ids
from tests.service.commands import command, plain

run = command("study")


class Ran:
    """Output of a study: its conclusion, its other lines, and its tables as files."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], out: Path, *words: str
    ) -> None:
        self.study, self.out = words[0], out
        given = () if words[0] == "compare" else ("--out", str(out))
        plot = out.parent / "figure.svg"
        code, told, errors = run(monkeypatch, capsys, *words, *given, "--no-journal", "--plot", str(plot))
        assert code == 0, errors
        *self.lines, self.end = told.splitlines()
        assert ET.fromstring(plot.read_text(encoding="utf-8")).tag.endswith("svg")
        assert self.end.startswith("Conclusion for cigre-lv (")
        assert self.end.endswith(".")
        assert not re.search(r"∞|\binf\b|\bnan\b", self.end)
        for path in out.glob("*.csv"):
            columns = list(pd.read_csv(path, nrows=0))
            assert list(legend(self.study, columns)) == columns, path
        meanings = Counter(line.partition(":")[0] for line in self.lines if line.startswith("  "))
        assert max(meanings.values(), default=1) == 1
        if any("∞" in line for line in self.lines if line.startswith("│")):
            assert any("∞:" in line for line in self.lines if line.startswith("  "))

    def table(self, name: str) -> pd.DataFrame:
        """Table of the study as written by --out."""
        return pd.read_csv(self.out / f"{self.study}-{name}.csv", keep_default_na=False, na_values=["nan"])

    def number(self, pattern: str) -> float:
        """Number of the conclusion at the place of the group of a pattern."""
        found = re.search(pattern, self.end)
        assert found is not None, (pattern, self.end)
        return float(found[1])


Given = tuple[pytest.MonkeyPatch, pytest.CaptureFixture[str], Path]


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Given:
    return monkeypatch, capsys, tmp_path / "out"


def test_redundancy(given: Given) -> None:
    ran = Ran(*given, "redundancy", "cigre-lv", "--silent", "m03")
    lasting, anyhow, silent, silent_any = ran.table("summary")["index"].astype(float)
    assert np.isinf(lasting)
    assert "all meters live: no set for lasting attacks and " in ran.end
    assert ran.number(r"and (\d+) for any attack \(.*; without") == anyhow
    assert ran.number(r"without m03: (\d+) for lasting") == silent
    assert ran.number(r"without m03: .* and (\d+) for any") == silent_any


def test_protect(given: Given) -> None:
    ran = Ran(*given, "protect", "cigre-lv")
    row = ran.table("summary").iloc[0]
    assert ran.number(r"protect (\d+) of 6 meters") == row["protected"]
    assert f"meters, {' and '.join(ran.table('meters')['meter'])} (no fewer suffice)" in ran.end
    for pattern, column in (("attack: (.*) V without", "before"), ("without, (.*) V with", "after")):
        assert row[column] <= ran.number(pattern) < row[column] + 0.01
    assert ran.number(r"at most (.*) V\.") == row["lie_volt"]


def test_a_goal_without_an_answer_is_concluded_as_none(given: Given) -> None:
    ran = Ran(*given, "protect", "cigre-lv", "--goal", "identify")
    assert "(not proved): none by the goal identify" in ran.end
    assert "no safety" in ran.end


def test_detectable(given: Given) -> None:
    ran = Ran(*given, "detectable", "cigre-lv")
    meters, customers = ran.table("meters"), ran.table("customers")
    for pattern, table, column in (
        (r"noticed from ([\d.]+) V", meters, "noticed"),
        (r"meter named from ([\d.]+) V", meters, "named"),
        (r"found from ([\d.]+) V", meters, "found"),
        (r"by at most ([\d.]+) V", customers, "error"),
    ):
        largest = table[column].max()
        assert largest <= ran.number(pattern) < largest + 0.01
    assert f"V ({customers['customer'][customers['error'].argmax()]})." in ran.end


@pytest.mark.acceptance
def test_droop(given: Given) -> None:
    few = ("--compare", "vde4105", "--tau-factor", "1", "--hosting", "--draws", "1", "--band", "0.97", "1.03")
    ran = Ran(*given, "droop", "cigre-lv", *few)
    margin, band = ran.table("stability")["margin"].min(), ran.table("band").iloc[0]
    assert "(proved): the fleet is stable" in ran.end
    assert margin - 0.01 < ran.number(r"slopes up to ([\d.]+) times") <= margin
    assert f"band is {band['rest']} for slow load changes, {band['always']} for arbitrary ones" in ran.end
    assert band["rest"] == band["always"] == "violated"
    assert ran.table("witness")["beyond"].any()
    low, high = ran.number(r"limits ([\d.]+) V"), ran.number(r"limits .* and ([\d.]+) V")
    assert band["low_rest_volt"] - 0.1 < low <= band["low_rest_volt"]
    assert band["high_rest_volt"] <= high < band["high_rest_volt"] + 0.1
    assert [float(kw) for kw in re.findall(r"([\d.]+) kW", ran.end)] == ran.table("hosting")[
        "capacity_kw"
    ].tolist()
    assert (
        "  slope unstable: unstable from this factor on the slopes on; ∞: no limit within 1024" in ran.lines
    )


def test_campaign(given: Given) -> None:
    some = ("--scenarios", "4", "--together", "4", "--duration", "60", "--kind", "bias:3", "--workers", "1")
    ran = Ran(*given, "campaign", "cigre-lv", *some)
    liars, scenarios = ran.table("liars"), ran.table("scenarios")
    delays = liars["delay_s"].astype(float)
    assert ran.number(r"named (\d+) of") == np.isfinite(delays).sum()
    assert ran.number(r"named \d+ of (\d+) manipulated") == len(liars)
    assert ran.number(r"median delay ([\d.]+) s") == delays[np.isfinite(delays)].median()
    low = ran.table("false_names")["named_low"][0]
    # A lower limit is rounded down.
    assert 0.0 <= 100.0 * low - ran.number(r"at least ([\d.]+) %") < 0.1
    assert ran.number(r"accusations in (\d+) of 4") == (scenarios["falsely_named"] != "").sum()
    share = scenarios["undecided_s"].sum() / scenarios["watched_s"].sum()
    assert ran.number(r"UNDECIDED for ([\d.]+) %") == pytest.approx(100.0 * share, abs=0.06)


def test_calibrate(given: Given, tmp_path: Path) -> None:
    site, readings, folder = load("cigre-lv"), tmp_path / "days.parquet", tmp_path / "wrong"
    errors = MeterErrors(report_q=True)
    record(
        site, Scenario(seed=1, duration_s=2 * 86400.0, dt_s=1800.0, profile_s=0.0, errors=errors), readings
    )
    rows = (replace(r, bus="Bus R17") if r.customer == "Load R15" else r for r in site.tables.customers)
    write(replace(site.tables, customers=tuple(rows)), folder)
    ran = Ran(*given, "calibrate", str(folder), "--readings", str(readings), "--look-for", "bus")
    assert "1 correction of the files is proposed, Load R15: Bus R15 (" in ran.end
    for pattern, name, verdict in (
        (r"\): (\d+) correction", "proposals", "proposed"),
        (r"(\d+) found errors are UNDECIDED", "proposals", "cannot be told"),
        (r"(\d+) of 6 meters are outside", "meters", "outside its class"),
        (r"readings: (\d+) of 6 customers", "customers", "cannot be told"),
        (r"and (\d+) of \d+ lines", "lines", "cannot be told"),
    ):
        assert ran.number(pattern) == (ran.table(name)["verdict"] == verdict).sum()


def test_compare(given: Given, tmp_path: Path) -> None:
    numbers = tmp_path / "numbers.csv"
    names = ("--family", "modal", "--family", "weighted-least-squares")
    cases = ("--case", "bias", "--case", "clean", "--seeds", "1", "--duration", "80", "--csv", str(numbers))
    ran = Ran(*given, "compare", "cigre-lv", *names, *cases)
    sums = pd.read_csv(numbers).groupby("family")[["named", "liars", "falsely_named"]].sum()
    for family, row in sums.iterrows():
        words = (
            f"{family} named {row['named']} of {row['liars']} manipulated devices and {row['falsely_named']}"
        )
        assert words in ran.end


def test_a_figure_has_the_form_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("protect", "cigre-lv", "--goal", "identify", "--no-journal", "--plot")
    begins = {"png": b"\x89PNG", "pdf": b"%PDF"}
    for form, begin in begins.items():
        plot = tmp_path / f"new/figure.{form}"
        code, told, _ = run(monkeypatch, capsys, *words, str(plot))
        assert code == 0
        assert f"{plot}: Meters to protect" in told
        first = plot.read_bytes()
        assert first.startswith(begin)
        assert run(monkeypatch, capsys, *words, str(plot))[0] == 0
        assert plot.read_bytes() == first
    code, _, told = run(monkeypatch, capsys, *words, str(tmp_path / "figure.jpg"))
    assert code == 2
    assert "ends in .svg, .png, .pdf" in plain(told)
    monkeypatch.setattr(draw, "available", lambda: False)
    for form in begins:
        code, _, told = run(monkeypatch, capsys, *words, str(tmp_path / f"none.{form}"))
        assert code == 2
        assert "the extra 'plot'" in plain(told)
        assert "pip install -e '.[plot]'" in plain(told)
    assert run(monkeypatch, capsys, *words, str(tmp_path / "none.svg"))[0] == 0
    assert [path.name for path in tmp_path.glob("none.*")] == ["none.svg"]


def test_a_feeder_without_inverters_is_concluded_as_not_studied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, plot = tmp_path / "plain", tmp_path / "figure.svg"
    write(village_without_inverters().tables, folder)
    code, told, _ = run(monkeypatch, capsys, "droop", str(folder), "--no-journal", "--plot", str(plot))
    assert code == 0
    assert told.splitlines()[-1].endswith("(not studied): none, as there is no fleet.")
    assert f"{plot}: not written" in told
    assert not plot.exists()


def test_sentence_without_numbers_of_any_estimator() -> None:
    from feeders.studies.comparison import ComparisonRow

    rows = [ComparisonRow("exact-bank", "bias", "too many observers")]
    assert "none, as no estimator has numbers" in said(
        conclusions.conclusion(load("cigre-lv"), "compare", rows)
    )
    assert conclusions.figure(load("cigre-lv"), "compare", rows) is None


def test_tables_fit_a_terminal_of_80_columns_and_cut_no_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console.out, "width", 80)
    folder = with_long_ids("simbench-lv-rural1", tmp_path / "feeder")
    code, told, errors = run(
        monkeypatch, capsys, "redundancy", str(folder), "--no-journal", "--out", str(tmp_path)
    )
    assert code == 0, errors
    drawn = [line for line in told.splitlines() if line[:1] in "┏┃┡│└"]
    assert 40 < max(map(len, drawn)) <= 80
    cells = {text.strip() for line in drawn for text in re.split("[│┃]", line)}
    numbers = pd.read_csv(tmp_path / "redundancy-meters.csv")["index_any"]
    assert {cell_text(float(number)) for number in numbers} <= cells


def test_a_wide_table_is_divided_by_columns() -> None:
    names = ["meter", *(f"size_number_{k}" for k in range(16))]
    texts = {name: [f"{1234.5 + k:.6g}" for k in range(3)] for name in names} | {"meter": ["m1", "m2", "m3"]}
    assert len(tables("Sizes", texts, {"meter"}, 400)) == 1
    parts = tables("Sizes", texts, {"meter"}, 80)
    assert [len(part.columns) for part in parts] == [8, 8, 3]
    assert [column.header for part in parts for column in part.columns if column.header != "meter"] == [
        name.replace("_", "\n") for name in names[1:]
    ]
    assert str(parts[1].title) == "Sizes (2 of 3)"
    assert all(part.columns[0].header == "meter" for part in parts)
    # A column wider than the terminal stands alone.
    assert len(tables("One", {"meter": ["m" * 64], "text": ["x" * 300]}, {"meter"}, 80)) == 1
