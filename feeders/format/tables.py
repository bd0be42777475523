"""Feeders as files and as JSON: read, checked with every problem at once, and written.

A feeder is a folder with `feeder.toml`, `lines.csv` and `customers.csv` (docs/feeder-format.md), or the same
as JSON: ``{"feeder": {...}, "lines": [...], "customers": [...]}``. A table is a list of rows or an object of
columns. Values are in SI units; only feeders/model/site.py converts to per unit.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from feeders.format import validation
from feeders.format.columns import (
    CUSTOMER_COLUMNS,
    CUSTOMERS_FILE,
    LINE_COLUMNS,
    LINES_FILE,
    META_COLUMNS,
    META_FILE,
    PHASE_NAMES,
    REQUIRED,
    SECTIONS,
    CellInvalid,
    CheckReport,
    Column,
    CustomerRow,
    FeederMeta,
    FeederTables,
    Limits,
    LineRow,
    LoadDefaults,
    MeterDefaults,
    MonitorDefaults,
    Parsed,
    ParsedRow,
    RawTables,
    Rows,
    from_folder,
    from_object,
    shown,
)
from feeders.util import plain
from gridsec.errors import FeederInvalid, Problem

__all__ = [
    "CustomerRow",
    "Examination",
    "FeederMeta",
    "FeederTables",
    "Limits",
    "LineRow",
    "LoadDefaults",
    "MeterDefaults",
    "MonitorDefaults",
    "examine",
    "from_json",
    "read",
    "to_json",
    "validate",
    "write",
]

MAX_PROBLEMS = 1000
SELDOM = PHASE_NAMES | {"to_volt", "forecast", "utc_offset_h"}
"""Cells and keys that are written only if they differ from the default."""


@dataclass(frozen=True, slots=True)
class Examination:
    """Result of reading an input."""

    tables: FeederTables | None
    """The feeder, or None with problems."""
    problems: tuple[Problem, ...]
    """Every problem, one sentence each."""
    notes: tuple[str, ...]
    """Valid but notable content: ignored columns, fused buses, unmetered customers."""


def validate(source: FeederTables | Path | str | Mapping[str, Any]) -> tuple[Problem, ...]:
    """Every problem of a feeder (folder, JSON form or tables), each with file, row, column and value.

    Tables without a problem are marked as valid; they are not parsed and checked again.
    """
    if not isinstance(source, FeederTables):
        return examine(source).problems
    problems = () if source.valid else examine(source).problems
    if not problems:
        _mark_valid(source)
    return problems


def examine(source: FeederTables | Path | str | Mapping[str, Any]) -> Examination:
    """Read and check a feeder; invalid content never raises."""
    if isinstance(source, (Path, str)):
        return _examine(from_folder(Path(source)))
    return _examine(from_object(to_json(source) if isinstance(source, FeederTables) else source))


def read(path: Path | str) -> FeederTables:
    """Read a feeder's folder; `FeederInvalid` has every problem of the files."""
    return _tables(examine(path))


def from_json(obj: object) -> FeederTables:
    """Read a feeder from its decoded JSON form; `FeederInvalid` has every problem, of any object."""
    return _tables(_examine(from_object(obj)))


def to_json(tables: FeederTables) -> dict[str, Any]:
    """JSON form: the names of the files, a list of rows per table.

    Absent matrices, taps of single phases, voltages behind transformers and forecasts are left out.
    """
    meta = tables.meta
    sections = {name: _cells(META_COLUMNS[name], getattr(meta, name)) for name in SECTIONS}
    return {
        "feeder": _cells(META_COLUMNS[""], meta) | sections,
        "lines": [_cells(LINE_COLUMNS, row) for row in tables.lines],
        "customers": [_cells(CUSTOMER_COLUMNS, row) for row in tables.customers],
    }


def _cells(columns: tuple[Column, ...], row: object) -> dict[str, Any]:
    cells = ((column, getattr(row, column.name)) for column in columns)
    return {c.name: plain(value) for c, value in cells if c.name not in SELDOM or value != c.default}


def write(tables: FeederTables, path: Path | str) -> None:
    """Write a feeder's folder, without columns that hold only their default."""
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    obj = to_json(tables)
    texts = {
        META_FILE: _toml(obj["feeder"]),
        LINES_FILE: _csv(LINE_COLUMNS, obj["lines"]),
        CUSTOMERS_FILE: _csv(CUSTOMER_COLUMNS, obj["customers"]),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")


def _tables(examination: Examination) -> FeederTables:
    if examination.tables is None:
        raise FeederInvalid(examination.problems)
    return examination.tables


def _mark_valid(tables: FeederTables) -> None:
    object.__setattr__(tables, "valid", True)


# --- from cells to typed rows -------------------------------------------------------------------


def _examine(raw: RawTables) -> Examination:
    """Parse each cell once and check the valid ones once."""
    report = raw.report
    meta = _parse_meta(raw, report)
    lines = _parse_table(raw.lines_name, LINE_COLUMNS, raw.lines, report)
    customers = _parse_table(raw.customers_name, CUSTOMER_COLUMNS, raw.customers, report)
    validation.check(Parsed(raw.meta_name, meta, lines, customers), report)
    if report.problems or meta is None or lines is None or customers is None:
        return Examination(None, _capped(report.problems), tuple(report.notes))
    sections: dict[str, Any] = {name: made(**meta[name]) for name, made in SECTIONS.items()}
    tables = FeederTables(
        FeederMeta(**meta[""], **sections),
        tuple(LineRow(**record.cells) for record in lines),
        tuple(CustomerRow(**record.cells) for record in customers),
    )
    _mark_valid(tables)
    return Examination(tables, (), tuple(report.notes))


def _capped(problems: list[Problem]) -> tuple[Problem, ...]:
    """Each problem once, at most MAX_PROBLEMS of them."""
    once = tuple(dict.fromkeys(problems))
    if len(once) <= MAX_PROBLEMS:
        return once
    return (*once[:MAX_PROBLEMS], Problem("more", f"and {len(once) - MAX_PROBLEMS} more problems"))


def _parse_meta(raw: RawTables, report: CheckReport) -> dict[str, dict[str, Any]] | None:
    if raw.meta is None:
        return None
    parsed: dict[str, dict[str, Any]] = {}
    unknown = [key for key in raw.meta if key not in {*_names(META_COLUMNS[""]), *META_COLUMNS}]
    for section, columns in META_COLUMNS.items():
        cells: object = raw.meta if section == "" else raw.meta.get(section, {})
        place = f"{raw.meta_name}, [{section}]" if section else raw.meta_name
        if not isinstance(cells, Mapping):
            report.problem("wrong-type", f"{place}: {shown(cells)} is not a table of keys")
            cells = {}
        if section:
            unknown.extend(f"{section}.{key}" for key in cells if key not in _names(columns))
        parsed[section] = _parse_cells(place, "key", columns, cells, report)
    if unknown:
        report.notes.append(f"{raw.meta_name}: ignored unknown {_listed('key', unknown)}")
    return parsed


def _parse_table(
    name: str, columns: tuple[Column, ...], rows: Rows | None, report: CheckReport
) -> list[ParsedRow] | None:
    if rows is None:
        return None
    present: dict[str, None] = {}
    for _, row in rows:
        present.update(dict.fromkeys(map(str, row)))
    missing = [c.name for c in columns if c.default is REQUIRED and c.name not in present]
    for column in missing:
        report.problem("missing", f"{name}: the column {column!r} is missing")
    unknown = [column for column in present if column not in _names(columns)]
    if unknown:
        report.notes.append(f"{name}: ignored unknown {_listed('column', unknown)}")
    wanted = [column for column in columns if column.name not in missing]
    records = []
    for number, row in rows:
        key = row.get(columns[0].name)
        where = f"{name}, row {number}" + (f" ({key.strip()})" if _can_be_read(key) else "")
        records.append(ParsedRow(where, _parse_cells(where, "column", wanted, row, report)))
    return records


def _can_be_read(key: object) -> TypeGuard[str]:
    """True for an id that can be shown."""
    return isinstance(key, str) and bool(key.strip()) and len(key) <= 128 and key.strip().isprintable()


def _parse_cells(
    where: str, noun: str, columns: Sequence[Column], cells: Mapping[str, Any], report: CheckReport
) -> dict[str, Any]:
    """Parse the cells of one row; invalid ones are reported and left out."""
    parsed: dict[str, Any] = {}
    for column in columns:
        try:
            parsed[column.name] = column.parse(cells.get(column.name))
        except CellInvalid as wrong:
            report.problem(wrong.problem.code, f"{where}, {noun} {column.name}: {wrong}")
    return parsed


def _names(columns: Iterable[Column]) -> set[str]:
    return {column.name for column in columns}


def _listed(noun: str, names: list[str]) -> str:
    return f"{noun}{'s' if len(names) > 1 else ''} {', '.join(map(shown, names))}"


# --- writing ------------------------------------------------------------------------------------


def _csv(columns: tuple[Column, ...], rows: list[dict[str, Any]]) -> str:
    kept = [c for c in columns if any(row.get(c.name) != c.default for row in rows)]
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([column.name for column in kept])
    writer.writerows([_csv_cell(row.get(column.name)) for column in kept] for row in rows)
    return out.getvalue()


def _csv_cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return str(value)


def _toml(meta: dict[str, Any]) -> str:
    lines = [f"{c.name} = {_toml_value(meta[c.name])}" for c in META_COLUMNS[""] if _worth_writing(c, meta)]
    for section, columns in META_COLUMNS.items():
        if section:
            lines += ["", f"[{section}]"]
            there = (column.name for column in columns if column.name in meta[section])
            lines += [f"{name} = {_toml_value(meta[section][name])}" for name in there]
    return "\n".join(lines) + "\n"


def _worth_writing(column: Column, meta: dict[str, Any]) -> bool:
    value = meta[column.name]
    return value is not None and value is not False and value not in ([], "")


def _toml_value(value: object) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    # Basic strings of TOML take JSON's escapes; booleans and integers have the same form in both.
    return json.dumps(value, ensure_ascii=False)
