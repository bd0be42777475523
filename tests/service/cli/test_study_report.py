"""`gridsec study report`: the files it leaves, what it says of failures, how it goes on, how it looks."""

from __future__ import annotations

import re
import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from playwright.sync_api import Browser

from feeders.model.site import load
from feeders.simulation.plant import MeterErrors
from feeders.simulation.recording import record
from feeders.simulation.scenario import Scenario
from service.cli.study_report import STUDIES, Asked, _command, misplaced
from tests.feeders.villages import with_long_ids
from tests.journals import edit, rows
from tests.service.commands import command, plain, text_of

FEW = ("--studies", "redundancy,protect")


run = command("study", "report")


def test_a_report_and_everything_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "new" / "our report.html"
    words = ("cigre-lv", "--out", str(page), "--silent", "m02", "--at", "2026-11-21T13:00+01:00")
    code, told, _ = run(monkeypatch, capsys, *words, "--studies", "redundancy, protect,detectable")
    assert code == 0
    assert "3 studies" in told
    html = page.read_text(encoding="utf-8")
    assert "2026-11-21 12:00 UTC" in html
    folder = tmp_path / "new" / "our report-files"
    assert (folder / "figures" / "detectable-sizes.svg").stat().st_size > 1000
    kept = pd.read_parquet(folder / "tables" / "detectable-meters.parquet")
    pd.testing.assert_frame_equal(
        kept, pd.read_csv(folder / "tables" / "detectable-meters.csv", float_precision="round_trip")
    )
    assert len(list((folder / "journals").iterdir())) == 3
    commands = [text_of(each) for each in re.findall(r"<pre>(.*?)</pre>", html)]
    again = shlex.split(next(each for each in commands if each.startswith("gridsec study report ")))
    assert again[3:] == [
        "cigre-lv",
        "--out",
        str(page),
        "--studies",
        "redundancy, protect,detectable",
        "--silent",
        "m02",
    ]
    first = {path.name: path.read_bytes() for path in (folder / "figures").iterdir()}

    code, _, _ = run(monkeypatch, capsys, *again[3:])
    assert code == 0
    assert "with reused earlier work" in page.read_text(encoding="utf-8")
    assert {path.name: path.read_bytes() for path in (folder / "figures").iterdir()} == first

    # Of another question the same report keeps nothing that is not in it.
    (folder / "figures" / "logo.svg").write_text("mine")
    code, _, _ = run(monkeypatch, capsys, "cigre-lv", "--out", str(page), "--studies", "redundancy")
    assert code == 0
    figures = {path.stem for path in (folder / "figures").iterdir()}
    assert figures == {"feeder-map", "redundancy-map", "logo"}
    tables = {path.stem for path in (folder / "tables").iterdir()}
    expected = {f"redundancy-{name}" for name in ("summary", "meters", "parts")}
    assert tables == {"feeder-conversion", *expected}


def test_commands_in_a_report_say_exactly_what_was_asked() -> None:
    asked = Asked(
        feeder="my feeder",
        goal="bound",
        lie_volt=2501234.5,
        unknown=("-5 x",),
        step=1000000.5,
        load_error_kw=0.12345678,
        band=(0.9, 1.1000001),
    )
    words = shlex.split(_command(asked, Path("our report.html"), None))
    assert words[3] == "my feeder"
    assert words[words.index("--out") + 1] == "our report.html"
    given = {"--lie-volt": (2501234.5,), "--step": (1000000.5,), "--load-error-kw": (0.12345678,)}
    single = [word for study in STUDIES.values() for word in study.options(asked)]
    for each in (words, single):
        for option, values in (given | {"--band": (0.9, 1.1000001)}).items():
            at = each.index(option) + 1
            assert tuple(map(float, each[at : at + len(values)])) == values
        assert each[each.index("--unknown") + 1] == "-5 x"


def test_an_interrupted_report_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of a journal: the rest is done, the page is the same."""
    page = tmp_path / "report.html"
    words = ("cigre-lv", "--out", str(page), "--studies", "redundancy", "--at", "2026-11-21")
    assert run(monkeypatch, capsys, *words)[0] == 0
    whole = page.read_text(encoding="utf-8")
    (journal,) = (tmp_path / "report-files" / "journals").iterdir()
    complete = rows(journal)
    edit(journal, keep=len(complete) // 2)
    page.unlink()
    assert run(monkeypatch, capsys, *words)[0] == 0

    def timeless(text: str) -> str:
        return re.sub(r"redundancy: [0-9.]+ s(, with reused earlier work)?", "", text)

    assert timeless(page.read_text(encoding="utf-8")) == timeless(whole)
    assert rows(journal) == complete


def test_a_journal_of_something_else_is_laid_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "report.html"
    words = ("cigre-lv", "--out", str(page), "--studies", "protect")
    assert run(monkeypatch, capsys, *words)[0] == 0
    (journal,) = (tmp_path / "report-files" / "journals").iterdir()
    journal.write_text('{"study": "another"}\n', encoding="utf-8")
    assert run(monkeypatch, capsys, *words)[0] == 0
    assert journal.with_suffix(".other").read_text(encoding="utf-8") == '{"study": "another"}\n'
    assert rows(journal)


def test_what_a_study_cannot_answer_is_in_the_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "report.html"
    code, _, told = run(monkeypatch, capsys, "cigre-lv", "--out", str(page), "--silent", "m99", *FEW)
    assert code == 1
    assert "redundancy: there is no meter 'm99'" in plain(told)
    html = page.read_text(encoding="utf-8")
    assert "No answer: there is no meter &#39;m99&#39;" in html
    assert 'data-standing="no answer"' in html
    assert "protect-map" in html


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--studies", "protect,palmistry"), "--studies is 'palmistry'; expected one of"),
        (("--studies", "calibrate"), "calibrate needs --readings"),
        (("--goal", "all"), "expected one of identify, notice, bound, contain"),
        (("--goal", "bound"), "lie_volt is nan; a bound of attacks must be a positive number"),
        (("--goal", "notice", "--lie-volt", "3"), "lie_volt goes with goals in volts, not with notice"),
        (("--studies", "redundancy", "--hosting"), "--hosting goes with droop"),
        (("--studies", "redundancy,droop", "--readings", "pyproject.toml"), "--readings goes with calibrate"),
        (
            ("--studies", "droop", "--max-attacked", "3"),
            "--max-attacked goes with detectable, protect, campaign",
        ),
        (("--studies", "calibrate", "--unknown", "miller"), "--unknown goes with protect, redundancy"),
        (("--at", "tomorrow"), "expected a date and time of ISO 8601"),
    ],
)
def test_wrong_arguments_are_told_before_the_work(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    said: str,
) -> None:
    code, _, told = run(monkeypatch, capsys, "cigre-lv", "--out", str(tmp_path / "r.html"), *words)
    assert code == 2
    assert said in plain(told)
    assert not list(tmp_path.iterdir())


def test_every_option_of_a_report_belongs_to_a_study() -> None:
    usual = Asked("cigre-lv")
    others = {"feeder", "workers"}
    given: dict[str, Any] = {
        "max_attacked": 1, "goal": "contain", "lie_volt": 2.0, "unknown": ("a",), "silent": ("b",),
        "busbar_unknown": True, "scenarios": 3, "seed": 4, "step": 5.0, "estimator": "modal",
        "load_error_kw": 1.0, "load_error_kvar": 1.0, "preset": "vde4105", "busbar": (0.9, 1.0),
        "band": (0.9, 1.1), "hosting": True, "readings": Path("day.csv"),
    }  # fmt: skip
    assert {each.name for each in fields(Asked)} == given.keys() | others
    for name, value in given.items():
        asked = replace(usual, **{name: value})
        (told,) = misplaced(asked, ())
        takers = told.partition(" goes with ")[2].split(", ")
        assert not misplaced(asked, takers[:1])
    assert not misplaced(replace(usual, workers=7), ("droop",))
    assert misplaced(replace(usual, seed=4), ("redundancy",)) == ["--seed goes with droop, campaign"]


def test_a_feeder_that_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, told = run(monkeypatch, capsys, "atlantis", "--out", str(tmp_path / "r.html"))
    assert code == 3
    assert "atlantis" in told
    assert not list(tmp_path.iterdir())


@pytest.mark.browser
def test_it_can_be_read_on_a_desk_on_a_phone_and_on_paper(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page_file = tmp_path / "report.html"
    words = ("simbench-lv-rural1", "--out", str(page_file), "--silent", "m04", *FEW)
    assert run(monkeypatch, capsys, *words)[0] == 0
    complaints: list[str] = []
    for width, shown, hidden in ((1400, "wide", "narrow"), (390, "narrow", "wide")):
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme="dark")
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: None if r.url.startswith("file:") else complaints.append(r.url))
        page.goto(page_file.as_uri())
        page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
        tables = page.evaluate("[...document.querySelectorAll('table')].map((each) => each.scrollWidth)")
        assert width > 390 or max(tables) > width
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.locator(f"figure .{shown} svg").first.is_visible()
        assert not page.locator(f"figure .{hidden} svg").first.is_visible()
        letters = page.evaluate(
            """[...document.querySelectorAll("figure svg text")]
               .filter((text) => text.getBoundingClientRect().width)
               .map((text) => [text.ownerSVGElement, parseFloat(text.getAttribute("font-size"))])
               .map(([svg, size]) => size * svg.getBoundingClientRect().width / svg.viewBox.baseVal.width)"""
        )
        assert min(letters) > 9.0
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(15, 21, 27)"
        context.close()
    assert not complaints


@pytest.mark.browser
@pytest.mark.acceptance
def test_tables_sort_and_the_summary_is_one_page_of_paper(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page_file = tmp_path / "report.html"
    assert run(monkeypatch, capsys, "simbench-lv-rural1", "--out", str(page_file), *FEW)[0] == 0
    page = browser.new_page()
    page.goto(page_file.as_uri())
    details = page.locator("details", has_text="meters: 13 rows").first
    details.evaluate("(box) => { box.open = true; }")
    order = "(box) => [...box.querySelectorAll('tbody tr')].map((row) => row.children[4].dataset.key)"
    details.get_by_role("button", name="index any").click()
    up = details.evaluate(order)
    details.get_by_role("button", name="index any").click()
    down = details.evaluate(order)
    numbers = [float(cell) for cell in up if cell]
    assert len(numbers) > 5
    assert [float(cell) for cell in down if cell] == sorted(numbers, reverse=True)
    page.set_viewport_size(
        {"width": 673, "height": 1000}
    )  # what A4 leaves between its margins, 96 px per inch
    page.emulate_media(media="print")
    assert page.evaluate("document.querySelector('.front').getBoundingClientRect().height") < 1003
    assert page.evaluate("document.documentElement.scrollWidth") <= 673
    assert len(page.pdf(prefer_css_page_size=True)) > 10_000
    page.close()


@pytest.mark.browser
@pytest.mark.acceptance
def test_tables_and_legends_of_all_studies_fit_on_a_phone_and_on_paper(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page_file, readings = tmp_path / "report.html", tmp_path / "day.parquet"
    day = Scenario(seed=1, duration_s=86400.0, dt_s=1800.0, errors=MeterErrors(report_q=True))
    record(load("cigre-lv"), day, readings)
    words = ("--silent", "m03", "--scenarios", "4", "--hosting", "--readings", str(readings))
    assert run(monkeypatch, capsys, "cigre-lv", "--out", str(page_file), *words)[0] == 0
    page = browser.new_page()
    page.goto(page_file.as_uri())
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    assert page.locator("dl.columns").count() == len(STUDIES)
    wide = "[...document.querySelectorAll('table, dl')].map((each) => each.getBoundingClientRect().right)"
    page.set_viewport_size({"width": 390, "height": 900})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.set_viewport_size({"width": 673, "height": 1000})
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") <= 673
    assert max(page.evaluate(wide)) <= 673.5
    page.close()


@pytest.mark.browser
@pytest.mark.canary("long ids")
@pytest.mark.parametrize(
    "feeder", ["simbench-lv-rural1", "kerber-vorstadtnetz"], ids=["long ids", "146 meters"]
)
def test_tables_of_many_meters_and_long_ids_stay_on_the_page(
    browser: Browser,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    feeder: str,
) -> None:
    folder = with_long_ids(feeder, tmp_path / "feeder")
    page_file = tmp_path / "report.html"
    assert run(monkeypatch, capsys, str(folder), "--out", str(page_file), *FEW)[0] == 0
    page = browser.new_page()
    page.goto(page_file.as_uri())
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    beyond = """width => [...document.querySelectorAll('body *')].filter((e) => !e.closest('.scroll, svg')
        && e.getBoundingClientRect().right > width + 0.5).map((e) => e.outerHTML.slice(0, 80))"""
    for width, height in ((1400, 900), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(beyond, width) == []
    # A wide table is scrolled in its own frame, by keyboard, too.
    for frame in page.locator(".scroll").all():
        assert frame.get_attribute("tabindex") == "0"
    page.close()
