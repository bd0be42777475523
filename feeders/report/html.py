"""Report as one self-contained HTML page, with one section for each study.

A section is the result of `function(site, result) -> Section`. Results are those of `feeders.studies`, with
`feeder` and `tables`.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from feeders.report import section_calibrate, section_campaign, section_droop, section_meters
from feeders.report.drawing import NARROW, WIDE, Figure, style, svg
from feeders.report.text import Finding, Question, Section, Standing, Value, number, plural

if TYPE_CHECKING:
    import pandas as pd

    from feeders.convert.provenance import Origin
    from feeders.model.site import Site

__all__ = [
    "ANSWERS",
    "CONVERSION",
    "FEEDER",
    "SECTIONS",
    "About",
    "Chapter",
    "Markup",
    "Result",
    "StudyOutcome",
    "el",
    "join",
    "page",
    "section",
]


class Result(Protocol):
    """Result of a study."""

    @property
    def feeder(self) -> str:
        """The feeder's name."""

    @property
    def tables(self) -> Mapping[str, pd.DataFrame]:
        """All numbers, by table name."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyOutcome:
    """Outcome of a study.

    Attributes
    ----------
    study
        Its name, as on the command line.
    result
        Result; None after a failure.
    problem
        Reason of the failure; empty without one.
    command
        Command line of this study alone.
    seconds
        Duration, s.
    resumed
        True if earlier work was reused, which is not in `seconds`.
    absent
        True if the study does not apply to this feeder; `problem` is the reason.
    """

    study: str
    result: Result | None
    problem: str = ""
    command: str = ""
    seconds: float = 0.0
    resumed: bool = False
    absent: bool = False


SECTIONS: Final[dict[str, Callable[[Site, Any], Section]]] = {
    "redundancy": section_meters.redundancy,
    "protect": section_meters.protect,
    "detectable": section_meters.detectable,
    "droop": section_droop.droop,
    "campaign": section_campaign.campaign,
    "calibrate": section_calibrate.calibrate,
}

ANSWERS: Final[dict[str, tuple[Question, ...]]] = {
    "redundancy": (Question.INVISIBLE,),
    "protect": (Question.PROTECT,),
    "detectable": (Question.LIES, Question.PICTURE),
    "droop": (Question.FLEET,),
    "campaign": (Question.MONITOR,),
    "calibrate": (Question.RECORDS,),
}
"""Questions of each study; they remain after a failure or without a run."""


TITLES: Final = {
    "redundancy": "Attacks that stay invisible",
    "protect": "Meters to protect",
    "detectable": "Sizes of attacks",
    "droop": "The inverters",
    "campaign": "Simulated attacks",
    "calibrate": "Readings against the files",
}
"""Headings of sections without a result."""


def section(site: Site, outcome: StudyOutcome) -> Section:
    """Section of a study, for any outcome.

    Parameters
    ----------
    site, outcome
        The feeder, and the outcome of the study.
    """
    if outcome.result is None:
        questions = ANSWERS.get(outcome.study, (Question.OTHER,))
        if outcome.absent:
            nothing = Finding(Standing.ABSENT, ((f"{outcome.problem[:1].upper()}{outcome.problem[1:]}.",),))
            return Section(_title(outcome.study), dict.fromkeys(questions, nothing))
        problem = outcome.problem or "the study ended without a result"
        finding = Finding(
            Standing.FAILED,
            ((f"No answer: {problem}. ", "This is no evidence of safety or danger."),),
        )
        return Section(_title(outcome.study), dict.fromkeys(questions, finding))
    make = SECTIONS.get(outcome.study, _generic(outcome.study))
    return make(site, outcome.result)


def _generic(study: str) -> Callable[[Site, Result], Section]:
    def make(_: Site, found: Result) -> Section:
        sizes: list[str | Value] = []
        for name, table in found.tables.items():
            rows = Value(len(table), str(len(table)), f"{study}-{name}:rows")
            sizes += [", " if sizes else "", f"{name} (", rows, f" {plural(len(table), 'row')})"]
        lead = f"The study {study} has {len(found.tables)} {plural(len(found.tables), 'table')}: "
        end = ". They are shown below without conclusions."
        told = Finding(Standing.MEASURED, ((lead, *sizes, end),))
        where = ANSWERS.get(study, (Question.OTHER,))
        return Section(_title(study), {where[0]: told}, tables=dict(found.tables))

    return make


def _title(study: str) -> str:
    return TITLES.get(study, f"Study: {study}")


_VOID: Final = {"meta", "br"}


class Markup(str):
    """Text that is markup already; only this module and drawings create it."""

    __slots__ = ()


Child = str | Iterable[str] | None


def el(tag: str, *children: Child, **attributes: str | bool | None) -> Markup:
    """Write an element.

    Parameters
    ----------
    tag
        Name of the element.
    children
        Text, which is escaped; markup, which is not; or several of either; None is skipped.
    attributes
        A trailing underscore is removed, others become hyphens. None and False are skipped.
    """
    parts = [tag]
    for name, value in attributes.items():
        if value is None or value is False:
            continue
        key = name.rstrip("_").replace("_", "-")
        parts.append(key if value is True else f'{key}="{_text(value)}"')
    head = f"<{' '.join(parts)}>"
    return Markup(head if tag in _VOID else f"{head}{join(children)}</{tag}>")


def join(children: Iterable[Child]) -> Markup:
    """Write children one after the other."""
    out = []
    for child in children:
        if child is None:
            continue
        every = [child] if isinstance(child, str) else child
        out += [each if isinstance(each, Markup) else _text(each) for each in every]
    return Markup("".join(out))


def _text(text: str) -> str:
    """Escape; control characters become visible, and text direction cannot change."""
    return escape("".join(c if _harmless(c) else "\ufffd" for c in text))


def _harmless(letter: str) -> bool:
    return (letter >= " " or letter == "\n") and not (
        "\x7f" <= letter <= "\x9f" or letter in "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
    )


FEEDER: Final = "feeder"
CONVERSION: Final = "conversion"
"""Section and name of the table of conversion changes."""

MOST_COLUMNS: Final = 13
"""Largest number of columns of a table on the page; more than FEW_COLUMNS are in small print."""
FEW_COLUMNS: Final = 8
OPEN_ROWS: Final = 14
"""Tables up to this number of rows are open, and printed."""
LOST_ROWS: Final = 40
"""The same for conversion changes."""
LONG_WORD: Final = 24
"""Longer words of tables may be broken on paper."""
DIGITS: Final = 4
"""Largest number of significant digits, and of decimals, in tables."""
MOST_ROWS: Final = 500
HEAD_ROWS: Final = 60
"""Of tables with more than MOST_ROWS rows the page shows the first HEAD_ROWS; the files have all."""

MEANING: Final = (
    "Proved: follows from the feeder's model under the assumptions that each section states. Partly proved: "
    "some of it does, or follows from the linear model only; the answer states which. Measured: observed in "
    "simulation or in readings. Not proved, no answer, not studied: unknown."
)

UNKNOWN: Final = "not known, not asked for, or without a case"

MARK: Final = Markup(
    '<svg viewBox="0 0 24 24" aria-hidden="true"><path d="M3 4v16M3 8h11M3 16h7"/>'
    '<circle cx="17" cy="8" r="2.6"/><circle class="bang" cx="14" cy="16" r="2.8"/></svg>'
)


@dataclass(frozen=True, slots=True)
class About:
    """Data on the report itself.

    Attributes
    ----------
    made
        Date of the report, as text.
    command
        Command line of the report.
    versions
        Versions of gridsec and of its numerical libraries.
    seeds
        Seeds of all random numbers.
    folder
        Name of the folder beside the page with figures and tables; empty without one.
    """

    made: str
    command: str
    versions: Mapping[str, str]
    seeds: Mapping[str, int]
    folder: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Chapter:
    """Section, and the outcome of its study."""

    outcome: StudyOutcome
    section: Section


def page(
    title: str,
    facts: Mapping[str, str],
    chart: Figure,
    chapters: Sequence[Chapter],
    about: About,
    *,
    origin: Origin | None,
) -> str:
    """Write the page.

    Parameters
    ----------
    title
        Title of the feeder.
    facts
        General data on the feeder.
    chart
        Map of the feeder.
    chapters
        Sections of its studies.
    about
        Data on the report itself.
    origin
        Origin of the feeder, if it was converted.
    """
    script = _file("sort.js")
    seal = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
        f"script-src 'sha256-{seal}'"
    )
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", http_equiv="Content-Security-Policy", content=policy),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("meta", name="color-scheme", content="light dark"),
        el("title", f"{title}: trust in its meters"),
        el("style", Markup(_file("style.css") + style("figure svg"))),
    )
    body = el(
        "main",
        _front(title, facts, chapters, about),
        _contents(chapters),
        _feeder(facts, chart, [] if origin is None else _origin(origin, about.folder)),
        [_chapter(each, about.folder) for each in chapters],
        _made(about, chapters),
    )
    document = el("html", head, el("body", body, el("script", Markup(script))), lang="en")
    return f"<!DOCTYPE html>\n{document}\n"


def _file(name: str) -> str:
    return (files("feeders.report") / name).read_text(encoding="utf-8")


# --- the first page -----------------------------------------------------------------------------


def _front(title: str, facts: Mapping[str, str], chapters: Sequence[Chapter], about: About) -> Markup:
    few = " · ".join(facts[name] for name in ("customers", "meters", "inverters") if name in facts)
    return el(
        "section",
        el("div", MARK, "gridsec", class_="brand"),
        el("h1", title),
        el(
            "p",
            f"Trust in its meters. {few}. ",
            el("span", about.made, class_="once"),
            class_="lead",
        ),
        el("ul", [_answer(*each) for each in _answers(chapters)], class_="answers"),
        el("p", MEANING, class_="meaning"),
        class_="card front",
        id="summary",
    )


def _answers(chapters: Sequence[Chapter]) -> list[tuple[Question, str, Finding]]:
    """Answers of every question; a question without a study has a pointer to it."""
    out: list[tuple[Question, str, Finding]] = []
    for question in Question:
        given = [
            (chapter.outcome.study, chapter.section.answers[question])
            for chapter in chapters
            if question in chapter.section.answers
        ]
        out += [(question, study, finding) for study, finding in given]
        asked = [study for study, questions in ANSWERS.items() if question in questions]
        if not given and asked and question is not Question.RECORDS:
            words = f"Not part of this report; see gridsec study {asked[0]}."
            out.append((question, "", Finding(Standing.ABSENT, ((words,),))))
    return out


def _answer(question: Question, study: str, finding: Finding) -> Markup:
    asked: Markup | str = el("a", question.value, href=f"#{_id(study)}") if study else question.value
    return el(
        "li",
        el("div", el("span", asked), _standing(finding), class_="question"),
        el("div", _sentences(finding), class_="answer"),
    )


def _standing(finding: Finding) -> Markup:
    return el("span", finding.standing.value, class_="standing", data_standing=finding.standing.value)


def _sentences(finding: Finding) -> list[Markup]:
    return [el("p", [_part(part) for part in sentence]) for sentence in finding.sentences]


def _part(part: str | Value) -> str:
    if isinstance(part, str):
        return part
    return el("data", part.shown, value=repr(float(part.value)), data_source=part.source)


def _contents(chapters: Sequence[Chapter]) -> Markup:
    links = [(FEEDER, "The feeder"), *((_id(c.outcome.study), c.section.title) for c in chapters)]
    links.append(("made", "Origin of this report"))
    items = [el("li", el("a", name, href=f"#{key}")) for key, name in links]
    return el("nav", el("ul", items), class_="card", aria_label="Contents")


def _id(study: str) -> str:
    return "study-" + "".join(c if c.isascii() and (c.isalnum() or c == "-") else "-" for c in study)


# --- sections -----------------------------------------------------------------------------------


def _feeder(facts: Mapping[str, str], chart: Figure, source: Sequence[Markup]) -> Markup:
    told = [el("div", el("dt", name), el("dd", value)) for name, value in facts.items()]
    return el(
        "section",
        el("div", el("h2", "The feeder"), class_="head"),
        el("dl", told, class_="facts"),
        _figure(chart),
        source,
        class_="card",
        id=FEEDER,
    )


def _origin(origin: Origin, folder: str) -> list[Markup]:
    """Changes of a conversion, and their effect on the voltages."""
    fates = [f"{count} {fate}" for fate, count in origin.changes["done"].value_counts(sort=False).items()]
    table = _table(FEEDER, CONVERSION, origin.changes, folder, (), most_open=LOST_ROWS)
    return [
        el("h3", "Changes of the conversion"),
        el(
            "p",
            f"Converted from {origin.source or 'a network of another tool'}: "
            f"{', '.join(fates) or 'nothing was changed'}.",
        ),
        table,
        el("h3", "Checked against the source's power flow"),
        el("p", origin.check or "No comparison is recorded."),
    ]


def _chapter(chapter: Chapter, folder: str) -> Markup:
    outcome, told = chapter.outcome, chapter.section
    alone = len(told.answers) == 1
    answers = [
        join(
            [
                None if alone else el("div", question.value, _standing(finding), class_="question"),
                el("div", _sentences(finding), class_="answer"),
            ]
        )
        for question, finding in told.answers.items()
    ]
    pill = [_standing(finding) for finding in told.answers.values()] if alone else None
    columns = {**told.columns, **({"?": UNKNOWN} if _has_gaps(told.tables) else {})}
    meanings = [join([el("dt", name), el("dd", text)]) for name, text in columns.items()]
    return el(
        "section",
        el("div", el("h2", told.title), pill, class_="head"),
        answers,
        [_figure(figure) for figure in told.figures],
        el("h3", "Numbers") if told.tables else None,
        [
            _table(outcome.study, name, table, folder, told.shown.get(name, ()))
            for name, table in told.tables.items()
        ],
        el("dl", meanings, class_="columns") if meanings else None,
        el("h3", "Assumptions") if told.assumptions else None,
        el("ul", [el("li", each) for each in told.assumptions], class_="plain") if told.assumptions else None,
        el("h3", "Command") if outcome.command else None,
        _command(outcome.command) if outcome.command else None,
        class_="card",
        id=_id(outcome.study),
    )


def _figure(figure: Figure) -> Markup:
    """Figure in two widths; the style sheet shows one."""
    drawings = [
        el(
            "div",
            Markup(
                svg(figure.draw(width), title=figure.title, text=figure.text, key=f"{figure.name}-{kind}")
            ),
            class_=kind,
        )
        for kind, width in (("wide", WIDE), ("narrow", NARROW))
    ]
    caption = el("figcaption", el("b", figure.title), figure.text)
    return el("figure", caption, drawings, id=figure.name)


def _table(
    study: str,
    name: str,
    table: pd.DataFrame,
    folder: str,
    chosen: Sequence[str],
    *,
    most_open: int = OPEN_ROWS,
) -> Markup:
    """Table; long ones are closed, and rows or columns beyond the limits are in the file only."""
    own = [column for column in table.columns if column != FEEDER]  # the page is about one feeder
    said = [column for column in own if table.empty or not table[column].map(_silent).all()]
    kept = [column for column in chosen or said if column in said][:MOST_COLUMNS]
    shown = table[kept].head(len(table) if len(table) <= MOST_ROWS else HEAD_ROWS)
    numeric = {column: _numeric(shown[column]) for column in kept}
    head = [
        el(
            "th",
            el("button", str(column).replace("_", " "), type="button"),
            class_="n" if numeric[column] else None,
            scope="col",
        )
        for column in kept
    ]
    decimals = [_decimals(shown[column]) for column in kept]
    body = [
        el("tr", [_td(*each) for each in zip(row, decimals, strict=True)])
        for row in shown.itertuples(index=False, name=None)
    ]
    crowded = "wide" if len(kept) > FEW_COLUMNS else None
    rows = el("table", el("thead", el("tr", head)), el("tbody", body), class_=crowded)
    grid = el("div", rows, class_="scroll", tabindex="0")
    size = f"{name.replace('_', ' ')}: {len(table)} row{'s' * (len(table) != 1)}"
    where = f"{folder}/tables/{study}-{name}.csv" if folder else ""
    note = el("span", f" · {where}", class_="quiet") if where else None
    parts = [f"{len(kept)} of {len(said)} columns"] * (len(kept) < len(said))
    parts += [f"the first {len(shown)} of {len(table)} rows"] * (len(shown) < len(table))
    part = el("p", f"Shown: {', '.join(parts)}.", class_="quiet part") if parts else None
    long = "long" if len(table) > OPEN_ROWS else None
    is_open = 0 < len(table) <= most_open
    return el("details", el("summary", size, note), grid, part, class_=long, open=is_open)


def _has_gaps(tables: Mapping[str, pd.DataFrame]) -> bool:
    return any(bool(table.select_dtypes("number").isna().to_numpy().any()) for table in tables.values())


def _silent(cell: Any) -> bool:
    return cell is None or cell == ""


def _numeric(column: pd.Series[Any]) -> bool:
    kind = column.dtype
    return bool(kind != np.bool_ and np.issubdtype(kind, np.number)) if isinstance(kind, np.dtype) else False


def _decimals(column: pd.Series[Any]) -> int:
    """Number of decimals of a column, the same for all its numbers."""
    if not _numeric(column):
        return 0
    sizes = [abs(v) for v in column.astype(float).tolist() if math.isfinite(v) and not v.is_integer()]
    needed = [min(max(DIGITS - 1 - math.floor(math.log10(v)), 0), DIGITS) for v in sizes]
    written = [f"{v:.{digits}f}" for v, digits in zip(sizes, needed, strict=True)]
    digits = max((len(text.rstrip("0").partition(".")[2]) for text in written), default=0)
    return digits or DIGITS * any(v < 0.5 * 10.0**-DIGITS for v in sizes)


def _td(cell: Any, decimals: int) -> Markup:
    if isinstance(cell, bool | np.bool_):
        return el("td", "yes" if cell else "no")
    if isinstance(cell, float | np.floating):
        key = "" if math.isnan(cell) else repr(float(cell)).replace("inf", "Infinity")
        return el("td", _written(float(cell), decimals), class_="n", data_key=key)
    if isinstance(cell, int | np.integer):
        return el("td", str(cell).replace("-", "−"), class_="n", data_key=str(cell))
    text = "–" if cell is None or cell == "" else str(cell)
    long = any(len(word) > LONG_WORD for word in text.split())
    return el("td", text, class_="long" if long else None)


def _written(value: float, decimals: int) -> str:
    """Number of a table; a small nonzero number is not written as zero."""
    if not math.isfinite(value) or value == 0.0:
        return number(value)
    least = 10.0**-decimals
    if abs(value) < 0.5 * least:
        return f"<{least:.{decimals}f}" if value > 0.0 else f">−{least:.{decimals}f}"
    return f"{value:.{decimals}f}".replace("-", "−")


# --- the last page ------------------------------------------------------------------------------


def _made(about: About, chapters: Sequence[Chapter]) -> Markup:
    seeds = ", ".join(f"{name} {seed}" for name, seed in about.seeds.items()) or "no random numbers"
    took = [
        el(
            "li",
            f"{c.outcome.study}: {_seconds(c.outcome.seconds)}",
            ", with reused earlier work" * c.outcome.resumed,
        )
        for c in chapters
    ]
    files_ = (
        el(
            "p",
            f"Beside this page, in {about.folder}: every table as CSV and Parquet, every figure as SVG, and "
            "as PNG where matplotlib was installed.",
        )
        if about.folder
        else None
    )
    return el(
        "section",
        el("div", el("h2", "Origin of this report"), class_="head"),
        el("h3", "Command of the whole report"),
        _command(about.command),
        el("h3", "Versions"),
        el("p", ", ".join(f"{name} {version}" for name, version in about.versions.items())),
        el("h3", "Seeds"),
        el("p", seeds),
        el("h3", "Duration"),
        el("ul", took, class_="plain"),
        el("h3", "Files") if files_ else None,
        files_,
        class_="card",
        id="made",
    )


def _command(text: str) -> Markup:
    """Command line without line breaks at the hyphens of options."""
    words = [join([" " if k else "", el("span", word)]) for k, word in enumerate(text.split(" "))]
    return el("pre", words)


def _seconds(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min"
