"""Rows of lines.csv and customers.csv and keys of feeder.toml: one declaration per column, and their reading.

An annotated field declares name, type, meaning, limits and default of its column. Files, the JSON form of
the REST interface, reader, writer and documentation use these declarations. A cell arrives as text (CSV) or
as a JSON or TOML value; `Column.parse` converts it to the column's type, or raises `CellInvalid`.
"""

from __future__ import annotations

import csv
import io
import math
import re
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import KW_ONLY, MISSING, dataclass, field, fields, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, get_type_hints

from gridsec.errors import Problem

NUMBER: Final = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
NO_NUMBER: Final = {"nan", "inf", "+inf", "-inf", "infinity", "-infinity", "null", "none", "na", "n/a", "-"}
NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
SHOWN: Final = 60
REQUIRED: Final = object()
"""Default of a column without a default."""


class CellInvalid(Exception):
    """A cell has no valid value."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.problem = Problem(code, text)


def shown(cell: object) -> str:
    """Value of a cell for a message: quoted, and shortened to SHOWN characters."""
    try:
        text = repr(cell)
    except (ValueError, RecursionError):  # integers of thousands of digits, nested JSON
        text = f"a {type(cell).__name__} that is too large to show"
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "…"


# --- types of cells -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Column(ABC):
    """One column, or one key of feeder.toml."""

    meaning: str
    """Meaning with its unit, for messages and the documentation."""
    _: KW_ONLY
    choices: tuple[str, ...] | None = None
    """The only valid values, if not None."""
    name: str = ""
    """As in the file's header; the unit is part of the name."""
    default: Any = REQUIRED
    """Value of an empty or absent cell."""

    valid: ClassVar[str] = ""

    @property
    def right(self) -> str:
        """Description of a valid value."""
        return self.valid if self.choices is None else "one of " + ", ".join(self.choices)

    def parse(self, cell: object) -> Any:
        """Value of a cell; `CellInvalid` names the given and the expected value."""
        given = cell.strip() or None if isinstance(cell, str) else cell
        if given is None and self.default is REQUIRED:
            raise self._complaint("missing", "is missing")
        try:
            return self.default if given is None else self._value(given)
        except CellInvalid as wrong:
            raise self._complaint(wrong.problem.code, wrong.problem) from None

    def _complaint(self, code: str, text: str) -> CellInvalid:
        return CellInvalid(code, f"{text}; expected {self.right} ({self.meaning})")

    @abstractmethod
    def _value(self, cell: object) -> Any:
        """Value of a cell that is present."""

    def _check_choices(self, values: Collection[str]) -> None:
        for value in values:
            if self.choices is not None and value not in self.choices:
                raise CellInvalid("unknown-name", f"{shown(value)} is not known")


class Text(Column):
    """Printable text."""

    valid = "text of at most 200 characters"
    longest = 200

    def _value(self, cell: object) -> str:
        if not isinstance(cell, str):
            raise CellInvalid("wrong-type", f"{shown(cell)} is not text")
        if not cell.isprintable():
            raise CellInvalid("wrong-text", f"{shown(cell)} holds characters that cannot be printed")
        if len(cell) > self.longest:
            raise CellInvalid("wrong-text", f"{shown(cell)} is longer than {self.longest} characters")
        self._check_choices([cell])
        return cell


class Id(Text):
    """Id of a bus, line or customer."""

    valid = "an id: printable text of at most 128 characters"
    longest = 128


class Name(Column):
    """Name that is valid in paths and keys."""

    valid = "a name of 1 to 64 of the characters A-Z a-z 0-9 _ -"

    def _value(self, cell: object) -> str:
        if not isinstance(cell, str) or NAME.fullmatch(cell) is None:
            raise CellInvalid("wrong-text", f"{shown(cell)} is not a valid name")
        return cell


class Names(Column):
    """List of names."""

    valid = "a list of names"

    def _value(self, cell: object) -> tuple[str, ...]:
        if not isinstance(cell, (list, tuple)) or not all(isinstance(item, str) for item in cell):
            raise CellInvalid("wrong-type", f"{shown(cell)} is not a list of names")
        self._check_choices(cell)
        return tuple(cell)


class Truth(Column):
    """Truth value."""

    valid = "true or false"

    def _value(self, cell: object) -> bool:
        if isinstance(cell, bool):
            return cell
        if isinstance(cell, str) and cell.lower() in ("true", "1", "false", "0"):
            return cell.lower() in ("true", "1")
        raise CellInvalid("wrong-type", f"{shown(cell)} is neither true nor false")


class Pair(Column):
    """Pair of numbers."""

    valid = "a pair of numbers"

    def _value(self, cell: object) -> tuple[float, float]:
        if not isinstance(cell, (list, tuple)) or len(cell) != 2:
            raise CellInvalid("wrong-type", f"{shown(cell)} is not a pair")
        return _number(cell[0]), _number(cell[1])


@dataclass(frozen=True)
class Number(Column):
    """Number between inclusive limits, or above an exclusive one."""

    low: float | None = field(default=None, kw_only=False)
    high: float | None = field(default=None, kw_only=False)
    above: float | None = None

    valid = "a number"

    @property
    def right(self) -> str:
        """Description of a valid value."""
        if self.low is not None and self.low == self.high:
            return f"{self.low:g}"
        if self.low is not None and self.high is not None:
            return f"{self.valid} from {self.low:.10g} to {self.high:.10g}"
        parts = [("above", self.above), ("at least", self.low), ("at most", self.high)]
        limits = " and ".join(f"{word} {value:.10g}" for word, value in parts if value is not None)
        return f"{self.valid} {limits}".strip()

    def _value(self, cell: object) -> float:
        value = _number(cell)
        low, above = (-math.inf if limit is None else limit for limit in (self.low, self.above))
        if value < low or (value <= above and self.above is not None):
            negative = value < 0
            raise CellInvalid(
                "negative" if negative else "out-of-range",
                f"{value:g} is {'negative' if negative else 'too small'}",
            )
        if self.high is not None and value > self.high:
            raise CellInvalid("out-of-range", f"{value:g} is too large")
        return value


class Whole(Number):
    """Whole number between inclusive limits."""

    valid = "a whole number"

    def _value(self, cell: object) -> int:
        value = _number(cell)
        if value != int(value):
            raise CellInvalid("not-integer", f"{shown(cell)} is not a whole number")
        return int(super()._value(cell))


def _number(cell: object) -> float:
    if isinstance(cell, bool) or not isinstance(cell, (int, float, str)):
        raise CellInvalid("wrong-type", f"{shown(cell)} is not a number")
    if isinstance(cell, str) and cell.lower() in NO_NUMBER:
        raise CellInvalid(
            "not-finite", f"{shown(cell)} is not a finite number (leave the cell empty if there is none)"
        )
    if isinstance(cell, str) and NUMBER.fullmatch(cell) is None:
        comma = NUMBER.fullmatch(cell.replace(",", ".")) is not None
        hint = " (decimal point, not comma)" if comma else ""
        raise CellInvalid("wrong-type", f"{shown(cell)} is not a number{hint}")
    try:
        value = float(cell)
    except OverflowError:
        raise CellInvalid("out-of-range", f"{shown(cell)} is too large for a number") from None
    if not math.isfinite(value):
        raise CellInvalid("not-finite", f"{shown(cell)} is not a finite number")
    return value


# --- names --------------------------------------------------------------------------------------

PHASES: Final = ("abc", "a", "b", "c")
LINE_PHASES: Final = (*PHASES, "ab", "bc", "ca")
SUSPICIONS: Final = ("voltage", "impedance", "ratio", "rating", "load", "class")
OWN_ESTIMATORS: Final = (
    "modal",
    "exact-bank",
    "exact-bank-lmi",
    "windowed-bank",
    "weighted-least-squares",
    "l0-decoder",
    "basis-pursuit",
    "matching-pursuit",
    "partial-observers",
    "set-search",
    "unknown-input",
)
GROUP: Final = "gridsec.estimators"
"""Entry points of estimators of other packages."""

_ESTIMATOR: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")


def foreign_estimators() -> tuple[str, ...]:
    """Names of the estimators of other packages, in alphabetic order; their code is not run.

    Own names, and names with characters other than lower-case letters, digits and hyphens, are ignored.
    """
    found = {point.name for point in entry_points(group=GROUP)}
    return tuple(sorted(name for name in found - set(OWN_ESTIMATORS) if _ESTIMATOR.fullmatch(name)))


ESTIMATORS: Final = (*OWN_ESTIMATORS, *foreign_estimators())


# --- rows ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LineRow:
    """One row of lines.csv."""

    line: Annotated[str, Id("id of the line or switch")]
    from_bus: Annotated[str, Id("bus at one end")]
    to_bus: Annotated[str, Id("bus at the other end")]
    phases: Annotated[str, Text("conductors", choices=LINE_PHASES)] = field(default="abc", kw_only=True)
    r_ohm: Annotated[float, Number("series resistance of the whole line, per phase, ohm", 0, 1e6)]
    x_ohm: Annotated[float, Number("series reactance of the whole line, per phase, ohm", 0, 1e6)]
    r0_ohm: Annotated[float | None, Number("zero-sequence resistance, ohm", 0, 1e6)] = None
    x0_ohm: Annotated[float | None, Number("zero-sequence reactance, ohm", 0, 1e6)] = None
    r_aa_ohm: Annotated[float | None, Number("self-resistance of phase a, ohm", 0, 1e6)] = None
    r_ab_ohm: Annotated[float | None, Number("mutual resistance of a and b, ohm", -1e6, 1e6)] = None
    r_ac_ohm: Annotated[float | None, Number("mutual resistance of a and c, ohm", -1e6, 1e6)] = None
    r_bb_ohm: Annotated[float | None, Number("self-resistance of phase b, ohm", 0, 1e6)] = None
    r_bc_ohm: Annotated[float | None, Number("mutual resistance of b and c, ohm", -1e6, 1e6)] = None
    r_cc_ohm: Annotated[float | None, Number("self-resistance of phase c, ohm", 0, 1e6)] = None
    x_aa_ohm: Annotated[float | None, Number("self-reactance of phase a, ohm", 0, 1e6)] = None
    x_ab_ohm: Annotated[float | None, Number("mutual reactance of a and b, ohm", -1e6, 1e6)] = None
    x_ac_ohm: Annotated[float | None, Number("mutual reactance of a and c, ohm", -1e6, 1e6)] = None
    x_bb_ohm: Annotated[float | None, Number("self-reactance of phase b, ohm", 0, 1e6)] = None
    x_bc_ohm: Annotated[float | None, Number("mutual reactance of b and c, ohm", -1e6, 1e6)] = None
    x_cc_ohm: Annotated[float | None, Number("self-reactance of phase c, ohm", 0, 1e6)] = None
    b_us: Annotated[float, Number("total shunt susceptance, microsiemens per phase", 0, 1e9)] = 0.0
    b_aa_us: Annotated[float | None, Number("shunt susceptance of phase a, microsiemens", 0, 1e9)] = None
    b_ab_us: Annotated[
        float | None, Number("its entry of a and b, seldom above 0, microsiemens", -1e9, 1e9)
    ] = None
    b_ac_us: Annotated[
        float | None, Number("its entry of a and c, seldom above 0, microsiemens", -1e9, 1e9)
    ] = None
    b_bb_us: Annotated[float | None, Number("shunt susceptance of phase b, microsiemens", 0, 1e9)] = None
    b_bc_us: Annotated[
        float | None, Number("its entry of b and c, seldom above 0, microsiemens", -1e9, 1e9)
    ] = None
    b_cc_us: Annotated[float | None, Number("shunt susceptance of phase c, microsiemens", 0, 1e9)] = None
    tap: Annotated[float, Number("ratio of an ideal transformer at from_bus", 0.001, 1e3)] = 1.0
    tap_a: Annotated[float | None, Number("the same of phase a alone", 0.001, 1e3)] = None
    tap_b: Annotated[float | None, Number("the same of phase b alone", 0.001, 1e3)] = None
    tap_c: Annotated[float | None, Number("the same of phase c alone", 0.001, 1e3)] = None
    to_volt: Annotated[
        float | None,
        Number(
            "nominal voltage of to_bus where another than from_bus's: a transformer; phase to neutral, V",
            0.001,
            1e6,
        ),
    ] = None
    closed: Annotated[bool, Truth("whether the line carries current")] = True
    rating_a: Annotated[float | None, Number("thermal limit, ampere", above=0, high=1e9)] = None
    to_x: Annotated[float | None, Number("horizontal position of to_bus, any unit", -1e12, 1e12)] = None
    to_y: Annotated[float | None, Number("vertical position of to_bus, any unit", -1e12, 1e12)] = None

    @property
    def fuses(self) -> bool:
        """True without impedance: a closed line joins its buses to one."""
        return self.r_ohm == self.x_ohm == 0.0

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

    customer: Annotated[str, Id("id of the customer")]
    bus: Annotated[str, Id("bus of the connection point")]
    _: KW_ONLY
    phases: Annotated[str, Text("connected phases", choices=PHASES)] = "abc"
    meter: Annotated[str, Name("id of the meter; empty: no meter")] = ""
    class_percent: Annotated[
        float | None, Number("accuracy class of the voltage register, %", above=0, high=100)
    ] = None
    resolution_volt: Annotated[float | None, Number("resolution of the voltage register, V", 0, 1e6)] = None
    jitter_percent: Annotated[float | None, Number("1 sigma noise of the voltage, % of nominal", 0, 100)] = (
        None
    )
    p_error_percent: Annotated[float | None, Number("error of the active power, % of it", 0, 50)] = None
    q_error_percent: Annotated[float | None, Number("error of the reactive power, % of range", 0, 100)] = None
    load_kw: Annotated[float, Number("expected peak of the load, kW", 0, 1e9)]
    load_profile: Annotated[str, Text("load profile of the library")] = ""
    power_factor: Annotated[float | None, Number("expected power factor of the load", 0.01, 1)] = None
    power_factor_min: Annotated[float | None, Number("its smallest value", 0.01, 1)] = None
    power_factor_max: Annotated[float | None, Number("its largest value", 0.01, 1)] = None
    q_floor_kvar: Annotated[
        float | None, Number("load's reactive power that does not follow p, kvar", 0, 1e9)
    ] = None
    p_std_kw: Annotated[float | None, Number("1 sigma error of the active power known, kW", 0, 1e9)] = None
    q_std_kvar: Annotated[
        float | None, Number("1 sigma error of the load's reactive power known, kvar", 0, 1e9)
    ] = None
    pv_kw: Annotated[float, Number("peak of the generation, kW", 0, 1e9)] = 0.0
    pv_profile: Annotated[str, Text("generation profile of the library")] = ""
    inverter_kva: Annotated[float, Number("rating of the droop inverter, kVA; 0: none", 0, 1e9)] = 0.0
    droop: Annotated[str, Text("droop preset of the inverter")] = ""
    tau_s: Annotated[
        float | None, Number("time constant of the inverter, s; empty: the preset's", 0.001, 1e6)
    ] = None


@dataclass(frozen=True, slots=True)
class Limits:
    """Allowed voltages."""

    v_min_pu: Annotated[float, Number("lowest allowed voltage, pu", above=0, high=2)] = 0.9
    v_max_pu: Annotated[float, Number("highest allowed voltage, pu", above=0, high=2)] = 1.1


@dataclass(frozen=True, slots=True)
class MeterDefaults:
    """Properties of the customers' meters, for empty cells of customers.csv."""

    class_percent: Annotated[
        float, Number("accuracy class of the voltage registers, %", above=0, high=100)
    ] = 0.5
    resolution_volt: Annotated[float, Number("resolution of the voltage registers, V", 0, 1e6)] = 0.1
    jitter_percent: Annotated[float, Number("1 sigma noise of the voltage, % of nominal", 0, 100)] = 0.05
    p_error_percent: Annotated[float, Number("error of the active power, % of it", 0, 50)] = 1.0
    q_error_percent: Annotated[float, Number("error of the reactive power, % of range", 0, 100)] = 2.0
    p_resolution_kw: Annotated[float, Number("resolution of the active power, kW", 0, 1e6)] = 0.01
    p_interval_s: Annotated[
        float, Number("largest age of a power at its voltage reading, s; 0: of the same moment", 0, 1e6)
    ] = 0.0


@dataclass(frozen=True, slots=True)
class LoadDefaults:
    """Reactive power, correlation time and forecast of the loads, for empty cells of customers.csv."""

    power_factor: Annotated[float, Number("expected power factor, lagging", 0.01, 1)] = 0.95
    power_factor_min: Annotated[float, Number("its smallest value", 0.01, 1)] = 0.9
    power_factor_max: Annotated[float, Number("its largest value", 0.01, 1)] = 1.0
    q_floor_percent: Annotated[
        float, Number("reactive power that does not follow p, % of load_kw", 0, 100)
    ] = 2.0
    correlation_s: Annotated[float, Number("correlation time of the load errors, s", above=0, high=1e7)] = (
        600.0
    )
    forecast: Annotated[str, Text("where unread powers are from", choices=("none", "profiles"))] = "none"
    utc_offset_h: Annotated[float, Number("local time less UTC, h", -14, 14)] = 0.0


@dataclass(frozen=True, slots=True)
class MonitorDefaults:
    """Settings of the monitor."""

    estimator: Annotated[
        str, Text("estimator family; `modal` replaces the former `sequential`", choices=ESTIMATORS)
    ] = "modal"
    max_attacked: Annotated[int, Whole("manipulated meters to withstand; `modal`: a third", 0, 1000)] = 1
    tick_s: Annotated[float, Number("period of the frames, s", 0.01, 1e5)] = 1.0
    on_delay_s: Annotated[float, Number("how long a condition must last to raise an alarm, s", 0, 1e6)] = 2.0
    off_delay_s: Annotated[float, Number("how long it must be gone to clear it, s", 0, 1e6)] = 5.0
    silence_s: Annotated[
        float, Number("silence after which a meter counts as lost, s", above=0, high=1e6)
    ] = 10.0
    alarms_per_year: Annotated[
        float, Number("false alarms allowed by chance, per feeder and year", above=0, high=1e6)
    ] = 1.0
    commission_s: Annotated[
        float, Number("time over which the meters' fixed errors are learned, s; 0: never", 0, 1e8)
    ] = 86400.0
    unread_std_percent: Annotated[
        float, Number("largest standard deviation of a voltage beside a withheld power at CLEAN, %", 0, 100)
    ] = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class FeederMeta:
    """Content of feeder.toml."""

    format: Annotated[int, Whole("version of this format", 1, 1)]
    name: Annotated[str, Name("name of the feeder")]
    title: Annotated[str, Text("title for people")] = ""
    voltage_volt: Annotated[float, Number("nominal voltage of the busbar, phase to neutral, V", 0.001, 1e6)]
    base_kva: Annotated[float, Number("three-phase base power of the per-unit system, kVA", 0.001, 1e9)] = (
        100.0
    )
    busbar: Annotated[str, Id("bus of the busbar meter; root of the feeder")]
    busbar_xy: Annotated[tuple[float, float] | None, Pair("position of the busbar")] = None
    meshed: Annotated[bool, Truth("whether closed lines may form loops")] = False
    busbar_class_percent: Annotated[
        float, Number("accuracy class of the busbar meter, %", above=0, high=100)
    ] = 0.1
    busbar_resolution_volt: Annotated[float, Number("its resolution, V", 0, 1e6)] = 0.1
    busbar_jitter_percent: Annotated[float, Number("its 1 sigma noise, % of nominal", 0, 100)] = 0.02
    accept: Annotated[
        tuple[str, ...], Names("suspicions that were checked and are right", choices=SUSPICIONS)
    ] = ()
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
    valid: bool = field(default=False, init=False, compare=False, repr=False)
    """True once `feeders.format.tables.validate` has found no problem; False in a copy by `replace`."""

    @property
    def in_phases(self) -> bool:
        """True if the model is in three phases; open lines do not count."""
        lines = any(row.in_phases for row in self.lines if row.closed)
        return lines or any(row.phases != "abc" for row in self.customers)


def _columns(row: type) -> tuple[Column, ...]:
    """Columns of a class of rows or keys, in the order of its fields."""
    hints = get_type_hints(row, include_extras=True)
    declared = [(each, getattr(hints[each.name], "__metadata__", (None,))[0]) for each in fields(row)]
    return tuple(
        replace(column, name=each.name, default=REQUIRED if each.default is MISSING else each.default)
        for each, column in declared
        if isinstance(column, Column)
    )


LINE_COLUMNS: Final = _columns(LineRow)
CUSTOMER_COLUMNS: Final = _columns(CustomerRow)
SECTIONS: Final[dict[str, type]] = {
    "limits": Limits,
    "meters": MeterDefaults,
    "load": LoadDefaults,
    "monitor": MonitorDefaults,
}
META_COLUMNS: Final = {"": _columns(FeederMeta)} | {name: _columns(made) for name, made in SECTIONS.items()}

PAIRS: Final = ("aa", "ab", "ac", "bb", "bc", "cc")
"""Upper triangle of a symmetric matrix in phases, row by row."""

SERIES_NAMES: Final = tuple(f"{symbol}_{pair}_ohm" for symbol in "rx" for pair in PAIRS)
SHUNT_NAMES: Final = tuple(f"b_{pair}_us" for pair in PAIRS)
MATRIX_NAMES: Final = (*SERIES_NAMES, *SHUNT_NAMES)
PHASE_NAMES: Final = frozenset({*MATRIX_NAMES, "tap_a", "tap_b", "tap_c"})
"""Columns of feeders in three phases only."""


# --- Input of a feeder before and after parsing ---


ROWS_SHOWN = 10
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
    tail = f" and {len(items) - ROWS_SHOWN} more" if len(items) > ROWS_SHOWN else ""
    return ", ".join(items[:ROWS_SHOWN]) + tail


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
