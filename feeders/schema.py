"""A feeder's tables: typed rows, files and JSON, and every problem of an input at once.

A feeder is a folder with `feeder.toml`, `lines.csv` and `customers.csv` (docs/feeder-format.md), or
the same as JSON: ``{"feeder": {...}, "lines": [...], "customers": [...]}``, where a table is a list
of rows or an object of columns. Values are in SI units here; only feeders/load.py knows per unit.
"""

from __future__ import annotations

import csv
import io
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from feeders import check
from feeders.columns import CUSTOMER_COLUMNS, LINE_COLUMNS, META_COLUMNS, REQUIRED, Column, parse, shown
from gridsec.errors import FeederInvalid

META_FILE, LINES_FILE, CUSTOMERS_FILE = "feeder.toml", "lines.csv", "customers.csv"
MAX_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class LineRow:
    """One row of lines.csv; units are in the names, meanings in `feeders.columns.LINE_COLUMNS`."""

    line: str
    from_bus: str
    to_bus: str
    r_ohm: float
    x_ohm: float
    phases: str = "abc"
    r0_ohm: float | None = None
    x0_ohm: float | None = None
    b_us: float = 0.0
    tap: float = 1.0
    closed: bool = True
    rating_a: float | None = None
    to_x: float | None = None
    to_y: float | None = None


@dataclass(frozen=True, slots=True)
class CustomerRow:
    """One row of customers.csv; None means: the default of feeder.toml."""

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
    """What the customers' meters are, where customers.csv does not say otherwise."""

    class_percent: float = 0.5
    resolution_volt: float = 0.1
    jitter_percent: float = 0.05
    p_error_percent: float = 1.0
    q_error_percent: float = 2.0
    p_resolution_kw: float = 0.01


@dataclass(frozen=True, slots=True)
class LoadDefaults:
    """What is known about the loads' reactive power, where customers.csv does not say otherwise."""

    power_factor: float = 0.95
    power_factor_min: float = 0.9
    power_factor_max: float = 1.0
    q_floor_percent: float = 2.0


@dataclass(frozen=True, slots=True)
class MonitorDefaults:
    """How the feeder is watched."""

    estimator: str = "exact-bank"
    max_attacked: int = 1
    tick_s: float = 1.0
    on_delay_s: float = 2.0
    off_delay_s: float = 5.0
    silence_s: float = 10.0


@dataclass(frozen=True, slots=True)
class FeederMeta:
    """The content of feeder.toml."""

    format: int
    name: str
    voltage_volt: float
    busbar: str
    title: str = ""
    base_kva: float = 100.0
    busbar_xy: tuple[float, float] | None = None
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
    """A feeder as its files say it: SI units, the source's ids."""

    meta: FeederMeta
    lines: tuple[LineRow, ...]
    customers: tuple[CustomerRow, ...]


@dataclass(frozen=True, slots=True)
class Examination:
    """What came out of reading an input.

    Attributes
    ----------
    tables
        The feeder, or None if there are problems.
    problems
        Everything that is wrong, one sentence each.
    notes
        What is right but worth knowing: ignored columns, fused buses, unmetered customers.
    """

    tables: FeederTables | None
    problems: tuple[str, ...]
    notes: tuple[str, ...]


def validate(source: FeederTables | Path | str | Mapping[str, Any]) -> tuple[str, ...]:
    """Return every problem of a feeder at once, each naming file, row, column and value.

    Parameters
    ----------
    source
        A folder, the JSON form, or tables made in memory.
    """
    return examine(source).problems


def examine(source: FeederTables | Path | str | Mapping[str, Any]) -> Examination:
    """Read and check a feeder; never raises on its content."""
    if isinstance(source, FeederTables):
        return _examine(_raw_json(to_json(source)))
    if isinstance(source, (Path, str)):
        return _examine(_raw_folder(Path(source)))
    return _examine(_raw_json(source))


def read(path: Path | str) -> FeederTables:
    """Read a feeder's folder.

    Raises
    ------
    FeederInvalid
        With every problem of the files.
    """
    return _tables(examine(path))


def from_json(obj: object) -> FeederTables:
    """Take a feeder from its JSON form, already decoded.

    Raises
    ------
    FeederInvalid
        With every problem of the tables, also if `obj` is no feeder at all.
    """
    return _tables(_examine(_raw_json(obj)))


def to_json(tables: FeederTables) -> dict[str, Any]:
    """Return the JSON form: the same names as in the files, a list of rows per table."""
    meta = asdict(tables.meta)
    meta["accept"] = list(tables.meta.accept)
    meta["busbar_xy"] = None if tables.meta.busbar_xy is None else list(tables.meta.busbar_xy)
    return {
        "feeder": meta,
        "lines": [_ordered(asdict(row), LINE_COLUMNS) for row in tables.lines],
        "customers": [_ordered(asdict(row), CUSTOMER_COLUMNS) for row in tables.customers],
    }


def write(tables: FeederTables, path: Path | str) -> None:
    """Write a feeder's folder; columns that hold only their default are left out."""
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
    return {column.name: row[column.name] for column in columns}


# --- raw input: cells as they were given, with the place of each row ------------------------------


@dataclass(slots=True)
class _Raw:
    """Cells before parsing; tables that could not be had at all are None."""

    meta_name: str
    meta: Mapping[str, Any] | None
    lines_name: str
    lines: list[tuple[int, Mapping[str, Any]]] | None
    customers_name: str
    customers: list[tuple[int, Mapping[str, Any]]] | None
    problems: list[str]


def _raw_folder(folder: Path) -> _Raw:
    raw = _Raw(META_FILE, None, LINES_FILE, None, CUSTOMERS_FILE, None, [])
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raw.problems.append(
            f"{folder} {what}; expected a folder with {META_FILE}, {LINES_FILE}, {CUSTOMERS_FILE}"
        )
        return raw
    text = _file_text(folder / META_FILE, raw.problems)
    if text is not None:
        try:
            raw.meta = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raw.problems.append(f"{META_FILE}: no valid TOML: {error}")
    text = _file_text(folder / LINES_FILE, raw.problems)
    if text is not None:
        raw.lines = _csv_rows(LINES_FILE, text, raw.problems)
    text = _file_text(folder / CUSTOMERS_FILE, raw.problems)
    if text is not None:
        raw.customers = _csv_rows(CUSTOMERS_FILE, text, raw.problems)
    return raw


def _file_text(path: Path, problems: list[str]) -> str | None:
    try:
        if path.stat().st_size > MAX_BYTES:
            problems.append(f"{path.name}: larger than {MAX_BYTES // 1024**2} MiB; is it the right file?")
            return None
        data = path.read_bytes()
    except FileNotFoundError:
        problems.append(f"{path.name}: the file is missing in {path.parent}")
        return None
    except OSError as error:
        problems.append(f"{path.name}: cannot be read: {error.strerror}")
        return None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data[: error.start].count(b"\n") + 1
        problems.append(
            f"{path.name}, row {row}: byte 0x{data[error.start]:02x} is not UTF-8; save it as UTF-8"
        )
        return None
    if not text.strip():
        problems.append(f"{path.name}: the file is empty")
        return None
    return text


def _csv_rows(name: str, text: str, problems: list[str]) -> list[tuple[int, Mapping[str, Any]]] | None:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[tuple[int, Mapping[str, Any]]] = []
    try:
        header = [cell.strip() for cell in next(reader)]
        twice = sorted({cell for cell in header if header.count(cell) > 1})
        if twice:
            problems.append(f"{name}, row 1: column {', '.join(map(shown, twice))} is there more than once")
            return None
        if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
            problems.append(
                f"{name}, row 1: one single column {shown(header[0])}; separate columns by commas"
            )
            return None
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                problems.append(
                    f"{name}, row {reader.line_num}: {len(cells)} cells under {len(header)} columns"
                )
                continue
            rows.append((reader.line_num, dict(zip(header, cells, strict=True))))
    except csv.Error as error:
        problems.append(f"{name}, row {reader.line_num}: no valid CSV: {error}")
        return None
    if not rows:
        problems.append(f"{name}: there is no row below the header")
        return None
    return rows


def _raw_json(obj: object) -> _Raw:
    raw = _Raw("feeder", None, "lines", None, "customers", None, [])
    if not isinstance(obj, Mapping):
        raw.problems.append(f"{shown(obj)} is no feeder; expected an object with feeder, lines and customers")
        return raw
    raw.problems.extend(
        f"{name}: is missing; expected feeder, lines and customers"
        for name in ("feeder", "lines", "customers")
        if obj.get(name) is None
    )
    meta = obj.get("feeder")
    if isinstance(meta, Mapping):
        raw.meta = meta
    elif meta is not None:
        raw.problems.append(f"feeder: {shown(meta)} is no object")
    raw.lines = _json_rows("lines", obj.get("lines"), raw.problems)
    raw.customers = _json_rows("customers", obj.get("customers"), raw.problems)
    return raw


def _json_rows(name: str, table: object, problems: list[str]) -> list[tuple[int, Mapping[str, Any]]] | None:
    if table is None:
        return None
    if isinstance(table, Mapping):
        if not all(isinstance(cells, (list, tuple)) for cells in table.values()):
            problems.append(f"{name}: expected a list of rows, or an object whose columns are lists")
            return None
        lengths = {column: len(cells) for column, cells in table.items()}
        if len(set(lengths.values())) > 1:
            problems.append(f"{name}: columns of different length: {shown(lengths)}")
            return None
        count = next(iter(lengths.values()), 0)
        table = [{column: cells[k] for column, cells in table.items()} for k in range(count)]
    if not isinstance(table, (list, tuple)):
        problems.append(f"{name}: {shown(table)} is no table; expected a list of rows")
        return None
    if not table:
        problems.append(f"{name}: there is no row")
        return None
    rows: list[tuple[int, Mapping[str, Any]]] = []
    for number, row in enumerate(table, start=1):
        if isinstance(row, Mapping):
            rows.append((number, row))
        else:
            problems.append(f"{name}, row {number}: {shown(row)} is no object")
    return rows


# --- from cells to typed rows -------------------------------------------------------------------


def _examine(raw: _Raw) -> Examination:
    problems = raw.problems
    notes: list[str] = []
    meta = _parse_meta(raw, problems, notes)
    lines = _parse_table(raw.lines_name, LINE_COLUMNS, raw.lines, problems, notes)
    customers = _parse_table(raw.customers_name, CUSTOMER_COLUMNS, raw.customers, problems, notes)
    more, remarks = check.feeder(check.Parsed(raw.meta_name, meta, lines, customers))
    problems.extend(more)
    notes.extend(remarks)
    if problems or meta is None or lines is None or customers is None:
        return Examination(None, tuple(dict.fromkeys(problems)), tuple(notes))
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


def _parse_meta(raw: _Raw, problems: list[str], notes: list[str]) -> dict[str, dict[str, Any]] | None:
    if raw.meta is None:
        return None
    parsed: dict[str, dict[str, Any]] = {}
    unknown = [key for key in raw.meta if key not in {c.name for c in META_COLUMNS[""]} | set(META_COLUMNS)]
    for section, columns in META_COLUMNS.items():
        cells: object = raw.meta if section == "" else raw.meta.get(section, {})
        if not isinstance(cells, Mapping):
            problems.append(f"{raw.meta_name}, [{section}]: {shown(cells)} is no table of keys")
            cells = {}
        if section:
            unknown.extend(f"{section}.{key}" for key in cells if key not in {c.name for c in columns})
        parsed[section] = _parse_cells(
            f"{raw.meta_name}, [{section}]" if section else raw.meta_name, "key", columns, cells, problems
        )
    if unknown:
        notes.append(f"{raw.meta_name}: ignored unknown {_listed('key', unknown)}")
    return parsed


def _parse_table(
    name: str,
    columns: tuple[Column, ...],
    rows: list[tuple[int, Mapping[str, Any]]] | None,
    problems: list[str],
    notes: list[str],
) -> list[check.Record] | None:
    if rows is None:
        return None
    known = {column.name for column in columns}
    present: dict[str, None] = {}
    for _, row in rows:
        present.update(dict.fromkeys(map(str, row)))
    missing = [c.name for c in columns if c.default is REQUIRED and c.name not in present]
    problems.extend(f"{name}: the column {column!r} is missing" for column in missing)
    unknown = [column for column in present if column not in known]
    if unknown:
        notes.append(f"{name}: ignored unknown {_listed('column', unknown)}")
    wanted = tuple(column for column in columns if column.name not in missing)
    records = []
    for number, row in rows:
        key = row.get(columns[0].name)
        label = f" ({key.strip()})" if isinstance(key, str) and key.strip() and len(key) <= 128 else ""
        where = f"{name}, row {number}{label}"
        records.append(check.Record(where, _parse_cells(where, "column", wanted, row, problems)))
    return records


def _parse_cells(
    where: str, noun: str, columns: Iterable[Column], cells: Mapping[str, Any], problems: list[str]
) -> dict[str, Any]:
    """Parse the cells of one row; bad ones are reported and left out."""
    parsed: dict[str, Any] = {}
    for column in columns:
        value, problem = parse(column, cells.get(column.name))
        if problem is None:
            parsed[column.name] = value
        else:
            problems.append(f"{where}, {noun} {column.name}: {problem}")
    return parsed


def _listed(noun: str, names: list[str]) -> str:
    return f"{noun}{'s' if len(names) > 1 else ''} {', '.join(map(shown, names))}"


# --- writing ------------------------------------------------------------------------------------


def _csv(columns: tuple[Column, ...], rows: list[dict[str, Any]]) -> str:
    kept = [c for c in columns if any(row[c.name] != c.default for row in rows)]
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([column.name for column in kept])
    writer.writerows([_csv_cell(row[column.name]) for column in kept] for row in rows)
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
            lines += [f"{column.name} = {_toml_value(meta[section][column.name])}" for column in columns]
    return "\n".join(lines) + "\n"


def _worth_writing(column: Column, meta: dict[str, Any]) -> bool:
    return meta[column.name] is not None and meta[column.name] not in ([], "")


def _toml_value(value: object) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    # Basic strings of TOML take JSON's escapes; booleans and whole numbers look the same in both.
    return json.dumps(value, ensure_ascii=False)
