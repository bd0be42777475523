"""Input of a feeder before and after parsing cell by cell."""

from __future__ import annotations

import csv
import io
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from feeders.format.columns import shown
from gridsec.errors import Problem

SHOWN = 10
META_FILE, LINES_FILE, CUSTOMERS_FILE = "feeder.toml", "lines.csv", "customers.csv"
FOREIGN = re.compile(r".+\.(json|dss)|(pandapower|simbench):.+|.+--[0-9]-(no_)?sw", re.IGNORECASE)
"""Sources with a network of another tool."""
MAX_BYTES = 64 * 1024 * 1024

# Rows with their line numbers, from 1.
Rows = list[tuple[int, Mapping[str, Any]]]


@dataclass(slots=True)
class CheckReport:
    """Problems and notes of reading and of the checks."""

    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def problem(self, code: str, text: str) -> None:
        """Add a problem."""
        self.problems.append(Problem(code, text))


@dataclass(slots=True)
class RawTables:
    """Cells before parsing; unreadable tables are None."""

    meta_name: str
    lines_name: str
    customers_name: str
    meta: Mapping[str, Any] | None = None
    lines: Rows | None = None
    customers: Rows | None = None
    report: CheckReport = field(default_factory=CheckReport)


@dataclass(frozen=True, slots=True)
class ParsedRow:
    """One row: its place for messages, and its valid cells."""

    where: str
    cells: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Parsed:
    """Input after parsing, with the cells of each section of feeder.toml; unreadable parts are None."""

    place: str
    """Name of the file or object with the feeder's own keys."""
    meta: dict[str, dict[str, Any]] | None
    lines: list[ParsedRow] | None
    customers: list[ParsedRow] | None

    def section(self, name: str) -> dict[str, Any]:
        """Valid keys of a section of feeder.toml; "" is the top."""
        return {} if self.meta is None else self.meta[name]

    def top(self, key: str) -> Any:
        """Value of a key at the top of feeder.toml, None if invalid or absent."""
        return self.section("").get(key)


def rows(records: list[ParsedRow] | None, *columns: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield place and cells of the rows with valid cells in these columns."""
    for record in records or ():
        if all(column in record.cells for column in columns):
            yield record.where, record.cells


def some(items: list[str]) -> str:
    """List of ids for a message, shortened to SHOWN."""
    tail = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(items[:SHOWN]) + tail


def advice(source: object) -> str:
    """Command that converts a network of another tool to a feeder; empty for any other source."""
    name = str(source)
    return f"; make one by: gridsec feeders convert {name} FOLDER" if FOREIGN.fullmatch(name) else ""


def from_folder(folder: Path) -> RawTables:
    """Read the files of a feeder; an unreadable file is a problem, never an exception."""
    raw = RawTables(META_FILE, LINES_FILE, CUSTOMERS_FILE)
    if not folder.is_dir():
        there = folder.exists()
        what = "is a file, not a folder" if there else "does not exist"
        files = f"{META_FILE}, {LINES_FILE}, {CUSTOMERS_FILE}"
        raw.report.problem(
            "wrong-type" if there else "missing",
            f"{folder} {what}; expected a folder with {files}{advice(folder)}",
        )
        return raw
    text = _file_text(folder / META_FILE, raw.report)
    try:
        raw.meta = None if text is None else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raw.report.problem("unreadable", f"{META_FILE}: invalid TOML: {error}")
    raw.lines = _csv_rows(folder / LINES_FILE, raw.report)
    raw.customers = _csv_rows(folder / CUSTOMERS_FILE, raw.report)
    return raw


def _file_text(path: Path, report: CheckReport) -> str | None:
    try:
        if path.stat().st_size > MAX_BYTES:
            report.problem(
                "too-many", f"{path.name}: larger than {MAX_BYTES // 1024**2} MiB; is it the right file?"
            )
            return None
        data = path.read_bytes()
    except FileNotFoundError:
        report.problem("missing", f"{path.name}: the file is missing")
        return None
    except OSError as error:
        report.problem("unreadable", f"{path.name}: cannot be read: {error.strerror}")
        return None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data[: error.start].count(b"\n") + 1
        report.problem(
            "unreadable",
            f"{path.name}, row {row}: byte 0x{data[error.start]:02x} is not UTF-8; save it as UTF-8",
        )
        return None
    if not text.strip():
        report.problem("missing", f"{path.name}: the file is empty")
        return None
    return text


def _csv_rows(path: Path, report: CheckReport) -> Rows | None:
    name, text = path.name, _file_text(path, report)
    if text is None:
        return None
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: Rows = []
    try:
        header = [cell.strip() for cell in next(reader)]
        twice = sorted({cell for cell in header if header.count(cell) > 1})
        if twice:
            report.problem(
                "duplicate", f"{name}, row 1: column {', '.join(map(shown, twice))} is there more than once"
            )
            return None
        if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
            report.problem(
                "shape", f"{name}, row 1: one single column {shown(header[0])}; separate columns by commas"
            )
            return None
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                report.problem(
                    "shape", f"{name}, row {reader.line_num}: {len(cells)} cells under {len(header)} columns"
                )
                continue
            rows.append((reader.line_num, dict(zip(header, cells, strict=True))))
    except csv.Error as error:
        report.problem("unreadable", f"{name}, row {reader.line_num}: invalid CSV: {error}")
        return None
    if not rows:
        report.problem("missing", f"{name}: there is no row below the header")
        return None
    return rows


def from_object(obj: object) -> RawTables:
    """Split the decoded JSON form; a table is a list of rows or an object of columns."""
    raw = RawTables("feeder", "lines", "customers")
    if not isinstance(obj, Mapping):
        raw.report.problem(
            "wrong-type", f"{shown(obj)} is not a feeder; expected an object with feeder, lines and customers"
        )
        return raw
    for name in ("feeder", "lines", "customers"):
        if obj.get(name) is None:
            raw.report.problem("missing", f"{name}: is missing; expected feeder, lines and customers")
    meta = obj.get("feeder")
    if isinstance(meta, Mapping):
        raw.meta = meta
    elif meta is not None:
        raw.report.problem("wrong-type", f"feeder: {shown(meta)} is not an object")
    raw.lines = _json_rows("lines", obj.get("lines"), raw.report)
    raw.customers = _json_rows("customers", obj.get("customers"), raw.report)
    return raw


def _json_rows(name: str, table: object, report: CheckReport) -> Rows | None:
    if table is None:
        return None
    if isinstance(table, Mapping):
        if not all(isinstance(cells, (list, tuple)) for cells in table.values()):
            report.problem(
                "wrong-type", f"{name}: expected a list of rows, or an object with lists as columns"
            )
            return None
        lengths = {column: len(cells) for column, cells in table.items()}
        if len(set(lengths.values())) > 1:
            report.problem("shape", f"{name}: columns of different length: {shown(lengths)}")
            return None
        count = next(iter(lengths.values()), 0)
        table = [{column: cells[k] for column, cells in table.items()} for k in range(count)]
    if not isinstance(table, (list, tuple)):
        report.problem("wrong-type", f"{name}: {shown(table)} is not a table; expected a list of rows")
        return None
    if not table:
        report.problem("missing", f"{name}: there is no row")
        return None
    rows: Rows = []
    for number, row in enumerate(table, start=1):
        if isinstance(row, Mapping):
            rows.append((number, row))
        else:
            report.problem("wrong-type", f"{name}, row {number}: {shown(row)} is not an object")
    return rows
