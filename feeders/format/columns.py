"""Columns of lines.csv and customers.csv and keys of feeder.toml: types, limits, defaults.

One table of columns serves the files, the JSON form of the REST interface, the reader, the writer and the
documentation. A cell arrives as text (CSV) or as a JSON or TOML value. `parse` converts it to the column's
type, or returns a problem.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from feeders.registry import plugins
from gridsec.errors import Problem

NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
WORDS_NO_NUMBER = {"nan", "inf", "+inf", "-inf", "infinity", "-infinity", "null", "none", "na", "n/a", "-"}
NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
LONGEST_ID = 128
LONGEST_TEXT = 200
SHOWN = 60


class CellType(Enum):
    """Type of a cell."""

    TEXT = "text of at most 200 characters"
    ID = "an id: printable text of at most 128 characters"
    NAME = "a name of 1 to 64 of the characters A-Z a-z 0-9 _ -"
    NUMBER = "a number"
    WHOLE = "a whole number"
    TRUTH = "true or false"
    PAIR = "a pair of numbers"
    NAMES = "a list of names"


class _Missing(Enum):
    REQUIRED = "required"
    BAD = "bad"


REQUIRED: Final = _Missing.REQUIRED
BAD: Final = _Missing.BAD


@dataclass(frozen=True, slots=True)
class Column:
    """One column, or one key of feeder.toml.

    Attributes
    ----------
    name
        As in the file's header; the unit is part of the name.
    kind
        Type of the cell.
    meaning
        Meaning of the cell, with its unit; used in messages and in the documentation.
    default
        Value of an empty or absent cell; REQUIRED without a default.
    low, high
        Inclusive limits of a number.
    above
        Exclusive lower limit of a number.
    choices
        The only valid values, if not None.
    """

    name: str
    kind: CellType
    meaning: str
    default: Any = REQUIRED
    low: float | None = None
    high: float | None = None
    above: float | None = None
    choices: tuple[str, ...] | None = None

    @property
    def right(self) -> str:
        """Description of a valid value."""
        if self.choices is not None:
            return "one of " + ", ".join(self.choices)
        if self.low is not None and self.low == self.high:
            return f"{self.low:g}"
        if self.low is not None and self.high is not None:
            limits = f"from {self.low:.10g} to {self.high:.10g}"
        else:
            parts = [("above", self.above), ("at least", self.low), ("at most", self.high)]
            limits = " and ".join(f"{word} {value:.10g}" for word, value in parts if value is not None)
        return f"{self.kind.value} {limits}".strip()

    def complaint(self, what: Problem) -> Problem:
        """Problem of this column's cell as a sentence, with the expected value."""
        return Problem(what.code, f"{what}; expected {self.right} ({self.meaning})")


PHASES = ("abc", "a", "b", "c")
LINE_PHASES = (*PHASES, "ab", "bc", "ca")
PAIRS = ("aa", "ab", "ac", "bb", "bc", "cc")
"""Upper triangle of a symmetric matrix in phases, row by row."""


def _matrix(symbol: str, unit: str, what: tuple[str, str], high: float) -> tuple[Column, ...]:
    """Columns of a symmetric matrix in phases; entries of the diagonal are never negative."""
    return tuple(
        Column(
            f"{symbol}_{pair}_{unit}",
            CellType.NUMBER,
            what[0 if own else 1].format(*pair),
            None,
            low=0.0 if own else -high,
            high=high,
        )
        for pair, own in ((pair, pair[0] == pair[1]) for pair in PAIRS)
    )


SERIES_COLUMNS = (
    *_matrix("r", "ohm", ("self-resistance of phase {}, ohm", "mutual resistance of {} and {}, ohm"), 1e6),
    *_matrix("x", "ohm", ("self-reactance of phase {}, ohm", "mutual reactance of {} and {}, ohm"), 1e6),
)
SHUNT_COLUMNS = _matrix(
    "b",
    "us",
    ("shunt susceptance of phase {}, microsiemens", "its entry of {} and {}, seldom above 0, microsiemens"),
    1e9,
)
TAP_COLUMNS = tuple(
    Column(f"tap_{phase}", CellType.NUMBER, f"the same of phase {phase} alone", None, low=0.001, high=1e3)
    for phase in "abc"
)
MATRIX_NAMES = frozenset(column.name for column in (*SERIES_COLUMNS, *SHUNT_COLUMNS))
PHASE_NAMES = MATRIX_NAMES | {column.name for column in TAP_COLUMNS}
"""Columns of feeders in three phases only."""

LINE_COLUMNS: tuple[Column, ...] = (
    Column("line", CellType.ID, "id of the line or switch"),
    Column("from_bus", CellType.ID, "bus at one end"),
    Column("to_bus", CellType.ID, "bus at the other end"),
    Column("phases", CellType.TEXT, "conductors", "abc", choices=LINE_PHASES),
    Column(
        "r_ohm", CellType.NUMBER, "series resistance of the whole line, per phase, ohm", low=0.0, high=1e6
    ),
    Column("x_ohm", CellType.NUMBER, "series reactance of the whole line, per phase, ohm", low=0.0, high=1e6),
    Column("r0_ohm", CellType.NUMBER, "zero-sequence resistance, ohm", None, low=0.0, high=1e6),
    Column("x0_ohm", CellType.NUMBER, "zero-sequence reactance, ohm", None, low=0.0, high=1e6),
    *SERIES_COLUMNS,
    Column(
        "b_us", CellType.NUMBER, "total shunt susceptance, microsiemens per phase", 0.0, low=0.0, high=1e9
    ),
    *SHUNT_COLUMNS,
    Column("tap", CellType.NUMBER, "ratio of an ideal transformer at from_bus", 1.0, low=0.001, high=1e3),
    *TAP_COLUMNS,
    Column(
        "to_volt",
        CellType.NUMBER,
        "nominal voltage of to_bus where another than from_bus's: a transformer; phase to neutral, V",
        None,
        low=0.001,
        high=1e6,
    ),
    Column("closed", CellType.TRUTH, "whether the line carries current", True),
    Column("rating_a", CellType.NUMBER, "thermal limit, ampere", None, above=0.0, high=1e9),
    Column("to_x", CellType.NUMBER, "horizontal position of to_bus, any unit", None, low=-1e12, high=1e12),
    Column("to_y", CellType.NUMBER, "vertical position of to_bus, any unit", None, low=-1e12, high=1e12),
)

CUSTOMER_COLUMNS: tuple[Column, ...] = (
    Column("customer", CellType.ID, "id of the customer"),
    Column("bus", CellType.ID, "bus of the connection point"),
    Column("phases", CellType.TEXT, "connected phases", "abc", choices=PHASES),
    Column("meter", CellType.NAME, "id of the meter; empty: no meter", ""),
    Column(
        "class_percent",
        CellType.NUMBER,
        "accuracy class of the voltage register, %",
        None,
        above=0.0,
        high=100.0,
    ),
    Column(
        "resolution_volt", CellType.NUMBER, "resolution of the voltage register, V", None, low=0.0, high=1e6
    ),
    Column(
        "jitter_percent",
        CellType.NUMBER,
        "1 sigma noise of the voltage, % of nominal",
        None,
        low=0.0,
        high=100.0,
    ),
    Column(
        "p_error_percent", CellType.NUMBER, "error of the active power, % of it", None, low=0.0, high=50.0
    ),
    Column(
        "q_error_percent",
        CellType.NUMBER,
        "error of the reactive power, % of range",
        None,
        low=0.0,
        high=100.0,
    ),
    Column("load_kw", CellType.NUMBER, "expected peak of the load, kW", low=0.0, high=1e9),
    Column("load_profile", CellType.TEXT, "load profile of the library", ""),
    Column("power_factor", CellType.NUMBER, "expected power factor of the load", None, low=0.01, high=1.0),
    Column("power_factor_min", CellType.NUMBER, "its smallest value", None, low=0.01, high=1.0),
    Column("power_factor_max", CellType.NUMBER, "its largest value", None, low=0.01, high=1.0),
    Column(
        "q_floor_kvar",
        CellType.NUMBER,
        "load's reactive power that does not follow p, kvar",
        None,
        low=0.0,
        high=1e9,
    ),
    Column(
        "p_std_kw", CellType.NUMBER, "1 sigma error of the active power known, kW", None, low=0.0, high=1e9
    ),
    Column(
        "q_std_kvar",
        CellType.NUMBER,
        "1 sigma error of the load's reactive power known, kvar",
        None,
        low=0.0,
        high=1e9,
    ),
    Column("pv_kw", CellType.NUMBER, "peak of the generation, kW", 0.0, low=0.0, high=1e9),
    Column("pv_profile", CellType.TEXT, "generation profile of the library", ""),
    Column(
        "inverter_kva", CellType.NUMBER, "rating of the droop inverter, kVA; 0: none", 0.0, low=0.0, high=1e9
    ),
    Column("droop", CellType.TEXT, "droop preset of the inverter", ""),
    Column(
        "tau_s",
        CellType.NUMBER,
        "time constant of the inverter, s; empty: the preset's",
        None,
        low=0.001,
        high=1e6,
    ),
)

OWN_ESTIMATORS = (
    "sequential",
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
ESTIMATORS = (*OWN_ESTIMATORS, *plugins.names(OWN_ESTIMATORS))
SUSPICIONS = ("voltage", "impedance", "ratio", "rating", "load", "class")

META_COLUMNS: dict[str, tuple[Column, ...]] = {
    "": (
        Column("format", CellType.WHOLE, "version of this format", low=1, high=1),
        Column("name", CellType.NAME, "name of the feeder"),
        Column("title", CellType.TEXT, "title for people", ""),
        Column(
            "voltage_volt",
            CellType.NUMBER,
            "nominal voltage of the busbar, phase to neutral, V",
            low=0.001,
            high=1e6,
        ),
        Column(
            "base_kva",
            CellType.NUMBER,
            "three-phase base power of the per-unit system, kVA",
            100.0,
            low=0.001,
            high=1e9,
        ),
        Column("busbar", CellType.ID, "bus of the busbar meter; root of the feeder"),
        Column("busbar_xy", CellType.PAIR, "position of the busbar", None),
        Column("meshed", CellType.TRUTH, "whether closed lines may form loops", False),
        Column(
            "busbar_class_percent",
            CellType.NUMBER,
            "accuracy class of the busbar meter, %",
            0.1,
            above=0.0,
            high=100.0,
        ),
        Column("busbar_resolution_volt", CellType.NUMBER, "its resolution, V", 0.1, low=0.0, high=1e6),
        Column(
            "busbar_jitter_percent",
            CellType.NUMBER,
            "its 1 sigma noise, % of nominal",
            0.02,
            low=0.0,
            high=100.0,
        ),
        Column(
            "accept", CellType.NAMES, "suspicions that were checked and are right", (), choices=SUSPICIONS
        ),
    ),
    "limits": (
        Column("v_min_pu", CellType.NUMBER, "lowest allowed voltage, pu", 0.9, above=0.0, high=2.0),
        Column("v_max_pu", CellType.NUMBER, "highest allowed voltage, pu", 1.1, above=0.0, high=2.0),
    ),
    "meters": (
        Column(
            "class_percent",
            CellType.NUMBER,
            "accuracy class of the voltage registers, %",
            0.5,
            above=0.0,
            high=100.0,
        ),
        Column(
            "resolution_volt",
            CellType.NUMBER,
            "resolution of the voltage registers, V",
            0.1,
            low=0.0,
            high=1e6,
        ),
        Column(
            "jitter_percent",
            CellType.NUMBER,
            "1 sigma noise of the voltage, % of nominal",
            0.05,
            low=0.0,
            high=100.0,
        ),
        Column(
            "p_error_percent", CellType.NUMBER, "error of the active power, % of it", 1.0, low=0.0, high=50.0
        ),
        Column(
            "q_error_percent",
            CellType.NUMBER,
            "error of the reactive power, % of range",
            2.0,
            low=0.0,
            high=100.0,
        ),
        Column(
            "p_resolution_kw", CellType.NUMBER, "resolution of the active power, kW", 0.01, low=0.0, high=1e6
        ),
        Column(
            "p_interval_s",
            CellType.NUMBER,
            "largest age of a power at its voltage reading, s; 0: of the same moment",
            0.0,
            low=0.0,
            high=1e6,
        ),
    ),
    "load": (
        Column("power_factor", CellType.NUMBER, "expected power factor, lagging", 0.95, low=0.01, high=1.0),
        Column("power_factor_min", CellType.NUMBER, "its smallest value", 0.9, low=0.01, high=1.0),
        Column("power_factor_max", CellType.NUMBER, "its largest value", 1.0, low=0.01, high=1.0),
        Column(
            "q_floor_percent",
            CellType.NUMBER,
            "reactive power that does not follow p, % of load_kw",
            2.0,
            low=0.0,
            high=100.0,
        ),
        Column(
            "correlation_s",
            CellType.NUMBER,
            "correlation time of the load errors, s",
            600.0,
            above=0.0,
            high=1e7,
        ),
        Column(
            "forecast", CellType.TEXT, "where unread powers are from", "none", choices=("none", "profiles")
        ),
        Column("utc_offset_h", CellType.NUMBER, "local time less UTC, h", 0.0, low=-14.0, high=14.0),
    ),
    "monitor": (
        Column("estimator", CellType.TEXT, "estimator family", "sequential", choices=ESTIMATORS),
        Column(
            "max_attacked",
            CellType.WHOLE,
            "manipulated meters to withstand; `sequential`: a third",
            1,
            low=0,
            high=1000,
        ),
        Column("tick_s", CellType.NUMBER, "period of the frames, s", 1.0, low=0.01, high=1e5),
        Column(
            "on_delay_s",
            CellType.NUMBER,
            "how long a condition must last to raise an alarm, s",
            2.0,
            low=0.0,
            high=1e6,
        ),
        Column(
            "off_delay_s", CellType.NUMBER, "how long it must be gone to clear it, s", 5.0, low=0.0, high=1e6
        ),
        Column(
            "silence_s",
            CellType.NUMBER,
            "silence after which a meter counts as lost, s",
            10.0,
            above=0.0,
            high=1e6,
        ),
        Column(
            "alarms_per_year",
            CellType.NUMBER,
            "false alarms allowed by chance, per feeder and year",
            1.0,
            above=0.0,
            high=1e6,
        ),
        Column(
            "commission_s",
            CellType.NUMBER,
            "time over which the meters' fixed errors are learned, s; 0: never",
            86400.0,
            low=0.0,
            high=1e8,
        ),
        Column(
            "unread_std_percent",
            CellType.NUMBER,
            "largest standard deviation of a voltage beside a withheld power at CLEAN, %",
            0.5,
            low=0.0,
            high=100.0,
        ),
    ),
}


def shown(cell: object) -> str:
    """Value of a cell for a message: quoted, and shortened to SHOWN characters."""
    try:
        text = repr(cell)
    except (ValueError, RecursionError):  # integers of thousands of digits, nested JSON
        text = f"a {type(cell).__name__} that is too large to show"
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "…"


def parse(column: Column, cell: object) -> tuple[Any, Problem | None]:
    """Convert one cell to the column's type.

    Parameters
    ----------
    column
        Column of the cell.
    cell
        Text of a CSV file, a TOML or JSON value, or None for an absent cell.

    Returns
    -------
    value, problem
        The value, or BAD and a problem with the value and the expected one.
    """
    if isinstance(cell, str):
        cell = cell.strip()
    if cell is None or (isinstance(cell, str) and cell == ""):
        if column.default is REQUIRED:
            return BAD, column.complaint(Problem("missing", "is missing"))
        return column.default, None
    value, what = _PARSERS[column.kind](cell)
    if what is not None:
        return BAD, column.complaint(what)
    what = _outside(column, value)
    return (BAD, column.complaint(what)) if what is not None else (value, None)


def _outside(column: Column, value: Any) -> Problem | None:
    """Problem of a value of the right type, None without one."""
    if column.choices is not None:
        given: Iterable[Any] = value if isinstance(value, tuple) else (value,)
        strange = (item for item in given if item not in column.choices)
        return next((Problem("unknown-name", f"{shown(item)} is not known") for item in strange), None)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return None
    low, above = (-math.inf if limit is None else limit for limit in (column.low, column.above))
    if value < low or (value <= above and column.above is not None):
        return (
            Problem("negative", f"{value:g} is negative")
            if value < 0
            else Problem("out-of-range", f"{value:g} is too small")
        )
    if column.high is not None and value > column.high:
        return Problem("out-of-range", f"{value:g} is too large")
    return None


def _text(cell: object, longest: int = LONGEST_TEXT) -> tuple[Any, Problem | None]:
    if not isinstance(cell, str):
        return BAD, Problem("wrong-type", f"{shown(cell)} is not text")
    if not cell.isprintable():
        return BAD, Problem("wrong-text", f"{shown(cell)} holds characters that cannot be printed")
    if len(cell) > longest:
        return BAD, Problem("wrong-text", f"{shown(cell)} is longer than {longest} characters")
    return cell, None


def _id(cell: object) -> tuple[Any, Problem | None]:
    return _text(cell, LONGEST_ID)


def _name(cell: object) -> tuple[Any, Problem | None]:
    if not isinstance(cell, str) or NAME.fullmatch(cell) is None:
        return BAD, Problem("wrong-text", f"{shown(cell)} is not a valid name")
    return cell, None


def _number(cell: object) -> tuple[Any, Problem | None]:
    if isinstance(cell, bool) or not isinstance(cell, (int, float, str)):
        return BAD, Problem("wrong-type", f"{shown(cell)} is not a number")
    if isinstance(cell, str) and cell.lower() in WORDS_NO_NUMBER:
        return BAD, Problem(
            "not-finite", f"{shown(cell)} is not a finite number (leave the cell empty if there is none)"
        )
    if isinstance(cell, str) and NUMBER.fullmatch(cell) is None:
        comma = NUMBER.fullmatch(cell.replace(",", ".")) is not None
        return BAD, Problem(
            "wrong-type", f"{shown(cell)} is not a number" + (" (decimal point, not comma)" if comma else "")
        )
    try:
        value = float(cell)
    except OverflowError:
        return BAD, Problem("out-of-range", f"{shown(cell)} is too large for a number")
    if not math.isfinite(value):
        return BAD, Problem("not-finite", f"{shown(cell)} is not a finite number")
    return value, None


def _whole(cell: object) -> tuple[Any, Problem | None]:
    value, what = _number(cell)
    if what is not None:
        return value, what
    if value != int(value):
        return BAD, Problem("not-integer", f"{shown(cell)} is not a whole number")
    return int(value), None


def _truth(cell: object) -> tuple[Any, Problem | None]:
    if isinstance(cell, bool):
        return cell, None
    if isinstance(cell, str) and cell.lower() in ("true", "1", "false", "0"):
        return cell.lower() in ("true", "1"), None
    return BAD, Problem("wrong-type", f"{shown(cell)} is neither true nor false")


def _pair(cell: object) -> tuple[Any, Problem | None]:
    if not isinstance(cell, (list, tuple)) or len(cell) != 2:
        return BAD, Problem("wrong-type", f"{shown(cell)} is not a pair")
    parsed = [_number(item) for item in cell]
    bad = next((what for _, what in parsed if what is not None), None)
    return (BAD, bad) if bad is not None else (tuple(value for value, _ in parsed), None)


def _names(cell: object) -> tuple[Any, Problem | None]:
    if not isinstance(cell, (list, tuple)) or not all(isinstance(item, str) for item in cell):
        return BAD, Problem("wrong-type", f"{shown(cell)} is not a list of names")
    return tuple(cell), None


_PARSERS: dict[CellType, Callable[[object], tuple[Any, Problem | None]]] = {
    CellType.TEXT: _text,
    CellType.ID: _id,
    CellType.NAME: _name,
    CellType.NUMBER: _number,
    CellType.WHOLE: _whole,
    CellType.TRUTH: _truth,
    CellType.PAIR: _pair,
    CellType.NAMES: _names,
}
