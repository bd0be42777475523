"""Tables of a feeder: typed rows, files and JSON, and every problem of an input at once.

A feeder is a folder with `feeder.toml`, `lines.csv` and `customers.csv` (docs/feeder-format.md), or the same
as JSON: ``{"feeder": {...}, "lines": [...], "customers": [...]}``. A table is a list of rows or an object of
columns. Values are in SI units; only feeders/model/site.py converts to per unit.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeGuard

from feeders.format import reader, validation
from feeders.format.columns import (
    CUSTOMER_COLUMNS,
    LINE_COLUMNS,
    META_COLUMNS,
    PHASE_NAMES,
    REQUIRED,
    Column,
    parse,
    shown,
)
from feeders.format.reader import CUSTOMERS_FILE, LINES_FILE, META_FILE, Parsed, ParsedRow, Rows
from feeders.util import plain
from gridsec.errors import FeederInvalid, Problem

MAX_PROBLEMS = 1000
SELDOM = frozenset({"forecast", "utc_offset_h"})
"""Keys of [load] that are written only if they differ from the default."""


@dataclass(frozen=True, slots=True)
class LineRow:
    """One row of lines.csv; units in the names, meanings in `feeders.format.columns.LINE_COLUMNS`."""

    line: str
    from_bus: str
    to_bus: str
    r_ohm: float
    x_ohm: float
    phases: str = "abc"
    r0_ohm: float | None = None
    x0_ohm: float | None = None
    r_aa_ohm: float | None = None
    r_ab_ohm: float | None = None
    r_ac_ohm: float | None = None
    r_bb_ohm: float | None = None
    r_bc_ohm: float | None = None
    r_cc_ohm: float | None = None
    x_aa_ohm: float | None = None
    x_ab_ohm: float | None = None
    x_ac_ohm: float | None = None
    x_bb_ohm: float | None = None
    x_bc_ohm: float | None = None
    x_cc_ohm: float | None = None
    b_us: float = 0.0
    b_aa_us: float | None = None
    b_ab_us: float | None = None
    b_ac_us: float | None = None
    b_bb_us: float | None = None
    b_bc_us: float | None = None
    b_cc_us: float | None = None
    tap: float = 1.0
    tap_a: float | None = None
    tap_b: float | None = None
    tap_c: float | None = None
    to_volt: float | None = None
    closed: bool = True
    rating_a: float | None = None
    to_x: float | None = None
    to_y: float | None = None

    @property
    def taps(self) -> tuple[float, float, float]:
        """Ratio of the ideal transformer in each phase."""
        a, b, c = (self.tap if own is None else own for own in (self.tap_a, self.tap_b, self.tap_c))
        return a, b, c

    @property
    def in_phases(self) -> bool:
        """True if the line requires a model in three phases: missing phases, a matrix, or taps by phase."""
        own = (self.r_aa_ohm, self.b_aa_us, self.tap_a)
        return self.phases != "abc" or any(value is not None for value in own)


@dataclass(frozen=True, slots=True)
class CustomerRow:
    """One row of customers.csv; None for the default of feeder.toml."""

    customer: str
    bus: str
    load_kw: float
    phases: str = "abc"
    meter: str = ""
    class_percent: float | None = None
    resolution_volt: float | None = None
    jitter_percent: float | None = None
    p_error_percent: float | None = None
    q_error_percent: float | None = None
    load_profile: str = ""
    power_factor: float | None = None
    power_factor_min: float | None = None
    power_factor_max: float | None = None
    q_floor_kvar: float | None = None
    p_std_kw: float | None = None
    q_std_kvar: float | None = None
    pv_kw: float = 0.0
    pv_profile: str = ""
    inverter_kva: float = 0.0
    droop: str = ""
    tau_s: float | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """Allowed voltages, pu."""

    v_min_pu: float = 0.9
    v_max_pu: float = 1.1


@dataclass(frozen=True, slots=True)
class MeterDefaults:
    """Properties of the customers' meters, for empty cells of customers.csv."""

    class_percent: float = 0.5
    resolution_volt: float = 0.1
    jitter_percent: float = 0.05
    p_error_percent: float = 1.0
    q_error_percent: float = 2.0
    p_resolution_kw: float = 0.01
    p_interval_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LoadDefaults:
    """Reactive power, correlation time and forecast of the loads, for empty cells of customers.csv."""

    power_factor: float = 0.95
    power_factor_min: float = 0.9
    power_factor_max: float = 1.0
    q_floor_percent: float = 2.0
    correlation_s: float = 600.0
    forecast: str = "none"
    utc_offset_h: float = 0.0


@dataclass(frozen=True, slots=True)
class MonitorDefaults:
    """Settings of the monitor."""

    estimator: str = "sequential"
    max_attacked: int = 1
    tick_s: float = 1.0
    on_delay_s: float = 2.0
    off_delay_s: float = 5.0
    silence_s: float = 10.0
    alarms_per_year: float = 1.0
    commission_s: float = 86400.0
    unread_std_percent: float = 0.5


@dataclass(frozen=True, slots=True)
class FeederMeta:
    """Content of feeder.toml."""

    format: int
    name: str
    voltage_volt: float
    busbar: str
    title: str = ""
    base_kva: float = 100.0
    busbar_xy: tuple[float, float] | None = None
    meshed: bool = False
    busbar_class_percent: float = 0.1
    busbar_resolution_volt: float = 0.1
    busbar_jitter_percent: float = 0.02
    accept: tuple[str, ...] = ()
    limits: Limits = Limits()
    meters: MeterDefaults = MeterDefaults()
    load: LoadDefaults = LoadDefaults()
    monitor: MonitorDefaults = MonitorDefaults()


@dataclass(frozen=True, slots=True)
class FeederTables:
    """Content of a feeder's files: SI units, the source's ids."""

    meta: FeederMeta
    lines: tuple[LineRow, ...]
    customers: tuple[CustomerRow, ...]

    @property
    def in_phases(self) -> bool:
        """True if the model is in three phases; open lines do not count."""
        lines = any(row.in_phases for row in self.lines if row.closed)
        return lines or any(row.phases != "abc" for row in self.customers)


@dataclass(frozen=True, slots=True)
class Examination:
    """Result of reading an input.

    Attributes
    ----------
    tables
        The feeder, or None with problems.
    problems
        Every problem, one sentence each.
    notes
        Valid but notable content: ignored columns, fused buses, unmetered customers.
    """

    tables: FeederTables | None
    problems: tuple[Problem, ...]
    notes: tuple[str, ...]


def validate(source: FeederTables | Path | str | Mapping[str, Any]) -> tuple[Problem, ...]:
    """Every problem of a feeder, each with file, row, column and value.

    Parameters
    ----------
    source
        A folder, the JSON form, or tables in memory.
    """
    return examine(source).problems


def examine(source: FeederTables | Path | str | Mapping[str, Any]) -> Examination:
    """Read and check a feeder; invalid content never raises."""
    if isinstance(source, FeederTables):
        return _examine(reader.from_object(to_json(source)))
    if isinstance(source, (Path, str)):
        return _examine(reader.from_folder(Path(source)))
    return _examine(reader.from_object(source))


def read(path: Path | str) -> FeederTables:
    """Read a feeder's folder.

    Raises
    ------
    FeederInvalid
        With every problem of the files.
    """
    return _tables(examine(path))


def from_json(obj: object) -> FeederTables:
    """Read a feeder from its decoded JSON form.

    Raises
    ------
    FeederInvalid
        With every problem of the tables, also if `obj` is not a feeder.
    """
    return _tables(_examine(reader.from_object(obj)))


def to_json(tables: FeederTables) -> dict[str, Any]:
    """JSON form: the names of the files, a list of rows per table.

    Absent matrices, taps of single phases, voltages behind transformers and forecasts are left out.
    """
    meta = asdict(tables.meta)
    meta["accept"] = list(tables.meta.accept)
    load, usual = meta["load"], asdict(LoadDefaults())
    meta["load"] = {key: load[key] for key in load if key not in SELDOM or load[key] != usual[key]}
    meta["busbar_xy"] = None if tables.meta.busbar_xy is None else list(tables.meta.busbar_xy)
    return {
        "feeder": plain(meta),
        "lines": [_ordered(asdict(row), LINE_COLUMNS) for row in tables.lines],
        "customers": [_ordered(asdict(row), CUSTOMER_COLUMNS) for row in tables.customers],
    }


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


def _ordered(row: dict[str, Any], columns: tuple[Column, ...]) -> dict[str, Any]:
    given = (column.name for column in columns)
    seldom = {*PHASE_NAMES, "to_volt"}
    return {name: plain(row[name]) for name in given if row[name] is not None or name not in seldom}


# --- from cells to typed rows -------------------------------------------------------------------


def _examine(given: reader.RawTables) -> Examination:
    problems = given.problems
    notes: list[str] = []
    meta = _parse_meta(given, problems, notes)
    lines = _parse_table(given.lines_name, LINE_COLUMNS, given.lines, problems, notes)
    customers = _parse_table(given.customers_name, CUSTOMER_COLUMNS, given.customers, problems, notes)
    more, remarks = validation.feeder(Parsed(given.meta_name, meta, lines, customers))
    problems.extend(more)
    notes.extend(remarks)
    if problems or meta is None or lines is None or customers is None:
        return Examination(None, _capped(problems), tuple(notes))
    sections: dict[str, Any] = {
        "limits": Limits(**meta["limits"]),
        "meters": MeterDefaults(**meta["meters"]),
        "load": LoadDefaults(**meta["load"]),
        "monitor": MonitorDefaults(**meta["monitor"]),
    }
    tables = FeederTables(
        FeederMeta(**meta[""], **sections),
        tuple(LineRow(**record.cells) for record in lines),
        tuple(CustomerRow(**record.cells) for record in customers),
    )
    return Examination(tables, (), tuple(notes))


def _capped(problems: list[Problem]) -> tuple[Problem, ...]:
    """Each problem once, at most MAX_PROBLEMS of them."""
    once = tuple(dict.fromkeys(problems))
    if len(once) <= MAX_PROBLEMS:
        return once
    return (*once[:MAX_PROBLEMS], Problem("more", f"and {len(once) - MAX_PROBLEMS} more problems"))


def _parse_meta(
    given: reader.RawTables, problems: list[Problem], notes: list[str]
) -> dict[str, dict[str, Any]] | None:
    if given.meta is None:
        return None
    parsed: dict[str, dict[str, Any]] = {}
    unknown = [key for key in given.meta if key not in {c.name for c in META_COLUMNS[""]} | set(META_COLUMNS)]
    for section, columns in META_COLUMNS.items():
        cells: object = given.meta if section == "" else given.meta.get(section, {})
        if not isinstance(cells, Mapping):
            problems.append(
                Problem(
                    "wrong-type", f"{given.meta_name}, [{section}]: {shown(cells)} is not a table of keys"
                )
            )
            cells = {}
        if section:
            unknown.extend(f"{section}.{key}" for key in cells if key not in {c.name for c in columns})
        parsed[section] = _parse_cells(
            f"{given.meta_name}, [{section}]" if section else given.meta_name, "key", columns, cells, problems
        )
    if unknown:
        notes.append(f"{given.meta_name}: ignored unknown {_listed('key', unknown)}")
    return parsed


def _parse_table(
    name: str,
    columns: tuple[Column, ...],
    rows: Rows | None,
    problems: list[Problem],
    notes: list[str],
) -> list[ParsedRow] | None:
    if rows is None:
        return None
    known = {column.name for column in columns}
    present: dict[str, None] = {}
    for _, row in rows:
        present.update(dict.fromkeys(map(str, row)))
    missing = [c.name for c in columns if c.default is REQUIRED and c.name not in present]
    problems.extend(Problem("missing", f"{name}: the column {column!r} is missing") for column in missing)
    unknown = [column for column in present if column not in known]
    if unknown:
        notes.append(f"{name}: ignored unknown {_listed('column', unknown)}")
    wanted = tuple(column for column in columns if column.name not in missing)
    records = []
    for number, row in rows:
        key = row.get(columns[0].name)
        label = f" ({key.strip()})" if _can_be_read(key) else ""
        where = f"{name}, row {number}{label}"
        records.append(ParsedRow(where, _parse_cells(where, "column", wanted, row, problems)))
    return records


def _can_be_read(key: object) -> TypeGuard[str]:
    """True for an id that can be shown."""
    return isinstance(key, str) and bool(key.strip()) and len(key) <= 128 and key.strip().isprintable()


def _parse_cells(
    where: str, noun: str, columns: Iterable[Column], cells: Mapping[str, Any], problems: list[Problem]
) -> dict[str, Any]:
    """Parse the cells of one row; invalid ones are reported and left out."""
    parsed: dict[str, Any] = {}
    for column in columns:
        value, problem = parse(column, cells.get(column.name))
        if problem is None:
            parsed[column.name] = value
        else:
            problems.append(Problem(problem.code, f"{where}, {noun} {column.name}: {problem}"))
    return parsed


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
