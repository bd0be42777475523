"""Report as one self-contained HTML page, from `report.html.j2`, with one section for each study.

A section is the result of `function(site, result) -> Section`. Results are those of `feeders.studies`, with
`feeder` and `tables`.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined

from feeders.report import section_calibrate, section_campaign, section_droop, section_meters
from feeders.report.drawing import NARROW, WIDE, Figure, style, svg
from feeders.report.text import Finding, Question, Section, Standing, Value, counted, legend, number, plural

if TYPE_CHECKING:
    import pandas as pd

    from feeders.convert.provenance import Origin
    from feeders.model.site import Site


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
    """Outcome of a study."""

    study: str  # its name, as on the command line
    result: Result | None  # result; None after a failure
    problem: str = ""  # reason of the failure; empty without one
    command: str = ""  # command line of this study alone
    seconds: float = 0.0  # duration, s
    resumed: bool = False  # true if earlier work was reused, which is not in `seconds`
    absent: bool = False  # true if the study does not apply to this feeder; `problem` is the reason


class _Study(NamedTuple):
    """Heading of a study's section, its questions, and the maker of its section from a result."""

    title: str
    questions: tuple[Question, ...]
    make: Callable[[Site, Any], Section]


STUDIES: Final = {
    "redundancy": _Study("Attacks that stay invisible", (Question.INVISIBLE,), section_meters.redundancy),
    "protect": _Study("Meters to protect", (Question.PROTECT,), section_meters.protect),
    "detectable": _Study("Sizes of attacks", (Question.LIES, Question.PICTURE), section_meters.detectable),
    "droop": _Study("The inverters", (Question.FLEET,), section_droop.droop),
    "campaign": _Study("Simulated attacks", (Question.MONITOR,), section_campaign.campaign),
    "calibrate": _Study("Readings against the files", (Question.RECORDS,), section_calibrate.calibrate),
}
"""Studies with a section of their own; the questions remain after a failure or without a run."""


def _study(name: str) -> _Study:
    return STUDIES.get(name) or _Study(f"Study: {name}", (Question.OTHER,), partial(_generic, name))


def section(site: Site, outcome: StudyOutcome) -> Section:
    """Section of a study, for any outcome."""
    study = _study(outcome.study)
    if outcome.result is not None:
        return study.make(site, outcome.result)
    if outcome.absent:
        nothing = Finding(Standing.ABSENT, ((f"{outcome.problem[:1].upper()}{outcome.problem[1:]}.",),))
    else:
        problem = outcome.problem or "the study ended without a result"
        nothing = Finding(
            Standing.FAILED,
            ((f"No answer: {problem}. ", "This is no evidence of safety or danger."),),
        )
    return Section(dict.fromkeys(study.questions, nothing))


def _generic(study: str, _: Site, found: Result) -> Section:
    sizes: list[str | Value] = []
    for name, table in found.tables.items():
        rows = counted(len(table), f"{study}-{name}:rows")
        sizes += [", " if sizes else "", f"{name} (", rows, f" {plural(len(table), 'row')})"]
    lead = f"The study {study} has {len(found.tables)} {plural(len(found.tables), 'table')}: "
    told = Finding(Standing.MEASURED, ((lead, *sizes, ". They are shown below without conclusions."),))
    return Section({Question.OTHER: told}, tables=dict(found.tables))


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

UNKNOWN: Final = "not known, not asked for, or without a case"


@dataclass(frozen=True, slots=True)
class About:
    """Data on the report itself."""

    made: str  # date of the report, as text
    command: str  # command line of the report
    versions: Mapping[str, str]  # versions of gridsec and of its numerical libraries
    seeds: Mapping[str, int]  # seeds of all random numbers
    folder: str = ""  # name of the folder beside the page with figures and tables; empty without one


@dataclass(frozen=True, slots=True, eq=False)
class Chapter:
    """Section, and the outcome of its study."""

    outcome: StudyOutcome
    section: Section

    @property
    def title(self) -> str:
        """Heading."""
        return _study(self.outcome.study).title

    @property
    def id(self) -> str:
        """Id of the section on the page."""
        study = self.outcome.study
        return "study-" + "".join(c if c.isascii() and (c.isalnum() or c == "-") else "-" for c in study)

    @property
    def columns(self) -> dict[str, str]:
        """Meanings of the columns on the page, with that of a question mark if a number is unknown."""
        told = self.section
        tables = told.tables.values()
        names = (
            c for name, table in told.tables.items() for c in _columns(table, told.shown.get(name, ()))[1]
        )
        meanings = legend(self.outcome.study, dict.fromkeys(names))
        gaps = any(table.select_dtypes("number").isna().to_numpy().any() for table in tables)
        return {
            **{name.replace("_", " "): meaning for name, meaning in meanings.items()},
            **({"?": UNKNOWN} if gaps else {}),
        }


def page(
    title: str,
    facts: Mapping[str, str],
    chart: Figure,
    chapters: Sequence[Chapter],
    about: About,
    *,
    origin: Origin | None,
) -> str:
    """Write the page; `facts` on the feeder are by name: customers, meters, inverters and others."""
    script = _file("sort.js")
    changes, changed = "", None
    if origin is not None:
        fates = origin.changes["done"].value_counts(sort=False)
        changes = ", ".join(f"{count} {fate}" for fate, count in fates.items())
        changed = _table(FEEDER, CONVERSION, origin.changes, about.folder, (), most_open=LOST_ROWS)
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            title=title,
            facts=facts,
            chart=chart,
            chapters=chapters,
            about=about,
            origin=origin,
            changes=changes,
            changed=changed,
            answers=_answers(chapters),
            tables_of=partial(_tables, about.folder),
            svg_of=_svg,
            duration=_duration,
            css=_file("style.css") + style("figure svg"),
            script=script,
            script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        )
    )


def _file(name: str) -> str:
    return (files("feeders.report") / name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    return Environment(
        loader=FunctionLoader(_file),
        autoescape=True,
        finalize=_visible,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


_HIDDEN: Final = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters except the line feed, and those that change the direction of text."""


def _visible(value: object) -> object:
    """Text with a visible mark in place of each hidden character; markup stays as it is."""
    is_text = isinstance(value, str) and not hasattr(value, "__html__")
    return _HIDDEN.sub("\ufffd", str(value)) if is_text else value


def _answers(chapters: Sequence[Chapter]) -> list[tuple[Question, Chapter | None, Finding]]:
    """Answers of every question; a question without a study has a pointer to it."""
    out: list[tuple[Question, Chapter | None, Finding]] = []
    for question in Question:
        given = [chapter for chapter in chapters if question in chapter.section.answers]
        out += [(question, chapter, chapter.section.answers[question]) for chapter in given]
        asked = [name for name, study in STUDIES.items() if question in study.questions]
        if not given and asked and question is not Question.RECORDS:
            words = f"Not part of this report; see gridsec study {asked[0]}."
            out.append((question, None, Finding(Standing.ABSENT, ((words,),))))
    return out


def _svg(figure: Figure, kind: str) -> str:
    drawing = figure.draw(WIDE if kind == "wide" else NARROW)
    return svg(drawing, title=figure.title, text=figure.text, key=f"{figure.name}-{kind}")


class _Cell(NamedTuple):
    """Cell of a table; `key` is the value of a number for sorting."""

    text: str
    key: str | None = None
    is_long: bool = False


class _Table(NamedTuple):
    """Table on the page."""

    label: str
    file: str
    head: list[tuple[str, bool]]  # name, and True for numbers
    rows: list[list[_Cell]]
    part: str  # shown part, if not all
    is_open: bool
    is_long: bool
    is_crowded: bool


def _tables(folder: str, chapter: Chapter) -> list[_Table]:
    told, study = chapter.section, chapter.outcome.study
    return [
        _table(study, name, table, folder, told.shown.get(name, ())) for name, table in told.tables.items()
    ]


def _table(
    study: str,
    name: str,
    table: pd.DataFrame,
    folder: str,
    chosen: Sequence[str],
    *,
    most_open: int = OPEN_ROWS,
) -> _Table:
    """Table; long ones are closed, and rows or columns beyond the limits are in the file only."""
    said, kept = _columns(table, chosen)
    shown = table[kept].head(len(table) if len(table) <= MOST_ROWS else HEAD_ROWS)
    decimals = [_decimals(shown[column]) for column in kept]
    parts = [f"{len(kept)} of {len(said)} columns"] * (len(kept) < len(said))
    parts += [f"the first {len(shown)} of {len(table)} rows"] * (len(shown) < len(table))
    return _Table(
        label=f"{name.replace('_', ' ')}: {len(table)} {plural(len(table), 'row')}",
        file=f"{folder}/tables/{study}-{name}.csv" if folder else "",
        head=[(str(column).replace("_", " "), _numeric(shown[column])) for column in kept],
        rows=[
            [_cell(*each) for each in zip(row, decimals, strict=True)]
            for row in shown.itertuples(index=False, name=None)
        ],
        part=", ".join(parts),
        is_open=0 < len(table) <= most_open,
        is_long=len(table) > OPEN_ROWS,
        is_crowded=len(kept) > FEW_COLUMNS,
    )


def _columns(table: pd.DataFrame, chosen: Sequence[str]) -> tuple[list[str], list[str]]:
    """Columns with content, and those of them on the page."""
    own = [column for column in table.columns if column != FEEDER]  # the page is about one feeder
    said = [column for column in own if table.empty or not table[column].map(_is_empty).all()]
    return said, [column for column in chosen or said if column in said][:MOST_COLUMNS]


def _is_empty(cell: object) -> bool:
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


def _cell(value: Any, decimals: int) -> _Cell:
    if isinstance(value, bool | np.bool_):
        return _Cell("yes" if value else "no")
    if isinstance(value, float | np.floating):
        key = "" if math.isnan(value) else repr(float(value)).replace("inf", "Infinity")
        return _Cell(_written(float(value), decimals), key)
    if isinstance(value, int | np.integer):
        return _Cell(str(value).replace("-", "−"), str(value))
    text = "–" if _is_empty(value) else str(value)
    return _Cell(text, is_long=any(len(word) > LONG_WORD for word in text.split()))


def _written(value: float, decimals: int) -> str:
    """Number of a table; a small nonzero number is not written as zero."""
    if not math.isfinite(value) or value == 0.0:
        return number(value)
    least = 10.0**-decimals
    if abs(value) < 0.5 * least:
        return f"<{least:.{decimals}f}" if value > 0.0 else f">−{least:.{decimals}f}"
    return f"{value:.{decimals}f}".replace("-", "−")


def _duration(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min"
