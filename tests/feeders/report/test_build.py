"""The report: nothing from outside, a text for every figure, and numbers that are those of the tables."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from feeders.model.site import Site
from feeders.report.build import Report, report
from feeders.report.drawing import NARROW
from feeders.report.html import StudyOutcome, section
from feeders.report.text import Question, Side, Standing, number, said
from feeders.studies.redundancy import redundancy
from tests.feeders.report.about import ABOUT, HOSTILE

VOID = {"meta", "br"}


class Page(HTMLParser):
    """Reads a page strictly: every tag is closed in turn."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        assert len(names) == len(set(names))
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))


def test_nothing_is_fetched_from_anywhere(made: Report) -> None:
    page = Page(made.html)
    for tag, attributes in page.tags:
        assert tag not in {"link", "img", "iframe", "object", "embed", "base", "form", "image", "use"}
        assert not {"src", "srcset", "xlink:href", "action", "data", "background"} & attributes.keys()
        assert str(attributes.get("href", "#")).startswith("#")
        assert not any(name.startswith("on") for name in attributes)
    styles = " ".join(text for tag, text in page.texts if tag == "style")
    assert "url(" not in styles
    assert "@import" not in styles
    assert set(re.findall(r"https?://[^\s\"'<]+", made.html)) == {"http://www.w3.org/2000/svg"}
    policy = next(a["content"] for tag, a in page.tags if tag == "meta" and "http-equiv" in a)
    assert str(policy).startswith("default-src 'none'")
    assert len(made.html) < 3_000_000


def test_every_link_leads_somewhere_and_every_id_is_one(made: Report) -> None:
    tags = Page(made.html).tags
    ids = [str(a["id"]) for _, a in tags if "id" in a]
    assert len(ids) == len(set(ids))
    links = {str(a["href"])[1:] for tag, a in tags if tag == "a"}
    assert links
    assert links <= set(ids)


def test_every_figure_has_a_text_in_both_widths(made: Report) -> None:
    page = Page(made.html)
    figures = [a for tag, a in page.tags if tag == "figure"]
    drawings = [a for tag, a in page.tags if tag == "svg" and a.get("role") == "img"]
    assert len(figures) >= 9
    assert len(drawings) == 2 * len(figures)
    words = {str(a["id"]) for tag, a in page.tags if tag in {"title", "desc"} and "id" in a}
    for drawing in drawings:
        assert set(str(drawing["aria-labelledby"]).split(" ")) <= words
    assert sum(tag == "figcaption" for tag, _ in page.tags) == len(figures)
    narrow = [a for a in drawings if str(a["width"]) == f"{NARROW:g}"]
    assert len(narrow) == len(figures)


OPERATIONS: dict[str, Callable[[pd.Series], float]] = {
    "max": lambda column: float(column.max()),
    "min": lambda column: float(column.min()),
    "sum": lambda column: float(column.sum()),
    "empty": lambda column: float((column == "").sum()),
    "filled": lambda column: float((column != "").sum()),
    "infinite": lambda column: float(np.isinf(column).sum()),
    "finite": lambda column: float(np.isfinite(column).sum()),
}


def looked_up(tables: dict[str, pd.DataFrame], source: str) -> float:
    """The number that a sentence says it has from there."""
    name, *rest = source.split(":")
    table = tables[name]
    if rest == ["rows"]:
        return float(len(table))
    column, operation = rest
    word, _, argument = operation.partition(" ")
    if word == "row":
        return float(table[column].iloc[int(argument)])
    if word == "count":
        return float((table[column].astype(str) == argument).sum())
    return OPERATIONS[word](table[column])


def shown(text: str) -> tuple[float, float]:
    """A number as people read it, and what its last digit is worth."""
    if text.startswith("none"):
        return math.inf, 0.0
    digits = text.replace("−", "-").replace("∞", "inf").split(" ")[0]
    return float(digits), 10.0 ** -len(digits.partition(".")[2])


ABOVE = ("noticed", "named", "found", "error", "error_fits", "high_volt", "before", "after")
BELOW = ("hidden", "undetected", "margin", "low_volt", "capacity_kw")


def test_every_number_of_a_sentence_is_that_of_its_table(made: Report) -> None:
    found = re.findall(r'<data value="([^"]*)" data-source="([^"]*)">([^<]*)</data>', made.html)
    assert len(found) > 30
    for value, source, text in found:
        number = looked_up(made.tables, source)
        assert float(value) == number or (math.isnan(number) and value == "nan"), source
        if math.isfinite(number):
            read, unit = shown(text)
            number *= 100.0 if "false_names:named" in source else 1.0
            assert abs(read - number) < 1.001 * unit, source
            column = source.split(":")[1]
            if not source.startswith("campaign"):
                assert column not in ABOVE or read >= number - 1e-6, source
                assert column not in BELOW or read <= number + 1e-6, source


@given(st.floats(-1e6, 1e6), st.integers(0, 4))
def test_rounding_keeps_what_is_proved(value: float, digits: int) -> None:
    def read(side: Side) -> float:
        return float(number(value, digits, side).replace("−", "-"))

    assert read(Side.BELOW) <= value + 2e-9 * max(1.0, abs(value))
    assert read(Side.ABOVE) >= value - 2e-9 * max(1.0, abs(value))
    assert read(Side.ABOVE) - read(Side.BELOW) < 1.001 * 10.0**-digits


def test_all_tables_and_figures_are_there_as_files(made: Report, outcomes: list[StudyOutcome]) -> None:
    for outcome in outcomes:
        if outcome.result is not None:
            for name, table in outcome.result.tables.items():
                assert made.tables[f"{outcome.study}-{name}"] is not None
                assert len(made.tables[f"{outcome.study}-{name}"]) == len(table)
    names = {str(a["id"]) for tag, a in Page(made.html).tags if tag == "figure"}
    assert {f"{name}.svg" for name in names} <= made.pictures.keys()
    for name, data in made.pictures.items():
        if name.endswith(".svg"):
            root = ElementTree.fromstring(data)
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            assert root.find("{http://www.w3.org/2000/svg}desc") is not None
        else:
            assert data.startswith(b"\x89PNG")


@pytest.mark.acceptance
def test_the_same_studies_give_the_same_bytes(site: Site, outcomes: list[StudyOutcome], made: Report) -> None:
    again = report(site, outcomes[:2], ABOUT)
    assert again.html == report(site, outcomes[:2], ABOUT).html
    for name, data in again.pictures.items():
        assert made.pictures[name] == data
    later = report(site, outcomes[:2], replace(ABOUT, made="2027-01-01 00:00 UTC"))
    assert later.pictures == again.pictures
    assert later.html != again.html


def test_names_stay_text(hostile: Site) -> None:
    found = redundancy(hostile, unknown=[hostile.feeder.customers[0]])
    outcomes = [
        StudyOutcome("redundancy", found, command=HOSTILE),
        StudyOutcome(HOSTILE, None, problem=HOSTILE),
    ]
    about = replace(ABOUT, command=HOSTILE, made=HOSTILE, folder=HOSTILE, versions={HOSTILE: HOSTILE})
    result = report(hostile, outcomes, about)
    page = Page(result.html)
    assert sum(tag == "script" for tag, _ in page.tags) == 1
    assert not any(tag in {"img", "b"} and "src" in a for tag, a in page.tags)
    assert "".join(text for tag, text in page.texts if tag == "h1") == HOSTILE
    for name, data in result.pictures.items():
        if name.endswith(".svg"):
            tags = {each.tag.split("}")[1] for each in ElementTree.fromstring(data).iter()}
            assert tags <= {"svg", "title", "desc", "style", "rect", "path", "circle", "text"}


def test_no_answer_never_looks_like_no_attack(site: Site, made: Report) -> None:
    assert "This is no evidence of safety or danger" in made.html
    assert "too few readings &lt;b&gt;here&lt;/b&gt;" in made.html
    silent = Page(report(site, [], ABOUT).html)
    told = [a["data-standing"] for _, a in silent.tags if "data-standing" in a]
    assert told == ["not studied"] * (len(Question) - 2)


class Strange:
    """A study that nobody knows."""

    feeder = "cigre-lv"
    tables: ClassVar = {"findings": pd.DataFrame({"who": ["<b>a</b>", "b"], "much": [1.5, math.nan]})}


def test_a_study_without_a_section_of_its_own_loses_nothing(site: Site) -> None:
    result = report(site, [StudyOutcome("strange", Strange())], ABOUT)
    assert "&lt;b&gt;a&lt;/b&gt;" in result.html
    assert result.tables["strange-findings"] is Strange.tables["findings"]
    told = section(site, StudyOutcome("strange", Strange()))
    finding = told.answers[Question.OTHER]
    assert finding.standing is Standing.MEASURED
    assert "findings (2 rows)" in said(finding.sentences[0])


def test_numbers_of_a_column_stand_in_line_and_do_not_become_nothing(site: Site) -> None:
    columns = {
        "whole": [1.0, 20.0, math.inf],
        "shares": [0.5, 0.1234567, 3e-7],
        "large": [19403.2, 12.5, -3.0],
        "noise": [0.0, 4e-9, -4e-9],
    }

    class Columns:
        feeder = "cigre-lv"
        tables: ClassVar = {"findings": pd.DataFrame(columns)}

    page = Page(report(site, [StudyOutcome("strange", Columns())], ABOUT).html)
    cells = [text for tag, text in page.texts if tag == "td"]
    assert cells[0::4] == ["1", "20", "∞"]
    assert cells[1::4] == ["0.5000", "0.1235", "<0.0001"]
    assert cells[2::4] == ["19403.2", "12.5", "−3.0"]
    assert cells[3::4] == ["0", "<0.0001", ">−0.0001"]


def test_png_has_the_size_of_the_drawing(made: Report) -> None:
    image = pytest.importorskip("matplotlib.image")
    pixels = image.imread(io.BytesIO(made.pictures["feeder-map.png"]))
    root = ElementTree.fromstring(made.pictures["feeder-map.svg"])
    assert pixels.shape[1] == 2 * float(root.attrib["width"])
    assert pixels[..., :3].std() > 0.01
