"""Readings: their columns, their limits, and the problems of one value.

A value is checked as a whole: a `BadReading` lists every problem of the reading at once. The reason is one of
a few words (a label for counters), the problems are sentences (for operators).
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import msgspec
import numpy as np
import pyarrow as pa

from gridsec.arrays import Floats, Ints
from service.ingest.arrow import Layout

T_MIN, T_MAX = 1e8, 1e10
"""Range of Unix times, s (1973 to 2286); values outside are milliseconds, counters or uptimes."""

VOLT_FACTOR = 10.0
"""Largest plausible voltage over the nominal one; beyond it the meter is defective, not manipulated."""

SEQ_MAX = 2**63 - 1
PHASES = 3
HEAD_BYTES = 200
NOT_REPORTED = math.nan


class BadReason(StrEnum):
    """Reason of a bad reading; the number of reasons suits the label of a counter."""

    KEY = "key"
    UNKNOWN_FEEDER = "unknown-feeder"
    UNKNOWN_METER = "unknown-meter"
    OVERSIZE = "oversize"
    ENCODING = "encoding"
    EMPTY = "empty"
    SYNTAX = "syntax"
    TYPE = "type"
    VALUE = "value"
    CLOCK_OFF = "clock-off"
    SIGNATURE = "signature"
    REPLAYED = "replayed"
    INTERNAL = "internal"


class Reading(msgspec.Struct, frozen=True, gc=False):
    """One usable reading."""

    feeder: str  # its name
    meter: str | None  # its id; None for the busbar meter
    t: float  # Unix time of the measurement by the meter's clock, s
    v_volt: float  # RMS phase-to-neutral voltage, V
    # p_kw, q_kvar: net import at the connection point, kW and kvar; NaN where not reported.
    p_kw: float = NOT_REPORTED
    q_kvar: float = NOT_REPORTED
    seq: int | None = None  # sequence number of the reading, or None
    # Voltage of each phase at the busbar of a feeder in three phases, V, NaN if absent; None if the reading
    # has no separate phases.
    v_phases: tuple[float, ...] | None = None
    t_power: float = NOT_REPORTED  # Unix time of the powers by the meter's clock, s; NaN for the time `t`


T, V_VOLT, P_KW, Q_KVAR, T_POWER = range(5)
"""Rows of `Readings.values`."""
COLUMNS: Final = 5
NO_SEQ: Final = -1
"""Sequence number of a reading without one."""


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Usable readings of one feeder as columns, in the order of arrival. n readings, p meters."""

    feeder: str  # its name
    source: Ints  # (n,) position of the meter among those of the feeder; p for the busbar meter
    values: Floats  # (5, n) t, v_volt, p_kw, q_kvar, t_power, as in `Reading`
    seq: Ints  # (n,) sequence numbers; `NO_SEQ` where absent
    arrival: Floats  # (n,) Unix time of the arrival, s
    v_phases: Floats | None = None  # (3, n) as in `Reading`, NaN where absent; None if all are

    def __len__(self) -> int:
        """Number of readings."""
        return int(self.source.size)

    def phases_of(self, k: int) -> tuple[float, ...] | None:
        """Return the voltages of the phases of one reading, V; None without any."""
        if self.v_phases is None or np.isnan(self.v_phases[:, k]).all():
            return None
        return tuple(self.v_phases[:, k].tolist())

    def row(self, k: int) -> tuple[int, tuple[float, ...], int, tuple[float, ...] | None]:
        """Return source, values, sequence number and phases of one reading."""
        return int(self.source[k]), tuple(self.values[:, k].tolist()), int(self.seq[k]), self.phases_of(k)

    def reading(self, k: int, known: Known) -> Reading:
        """Return one reading."""
        source, (t, v_volt, p_kw, q_kvar, t_power), seq, phases = self.row(k)
        meter = None if source == len(known.order) else known.order[source]
        number = None if seq == NO_SEQ else seq
        return Reading(self.feeder, meter, t, v_volt, p_kw, q_kvar, number, phases, t_power)


@dataclass(frozen=True, slots=True)
class BadReading:
    """A payload, or an element of one, that was not used."""

    reason: BadReason  # the kind of problem
    problems: tuple[str, ...]  # all problems, one sentence each
    key: str  # the zenoh key, printable; a long one is cut
    # feeder, meter: known ids only; None if the key denotes none.
    feeder: str | None = None
    meter: str | None = None
    head: str = ""  # the beginning of the payload or element, printable
    # Number of readings that this entry stands for (more than one only for the tail of a bad batch).
    count: int = 1
    # Sources of all refused readings of the batch, None for the busbar meter; in its first such entry.
    refused: tuple[str | None, ...] = ()


@dataclass(frozen=True, slots=True)
class Known:
    """Properties of a feeder that the validation of its readings uses."""

    meters: Collection[str]  # ids of its meters, in order
    nominal_volt: float  # nominal phase-to-neutral voltage of the busbar, V
    power_max_kw: float  # largest plausible magnitude of a customer's active or reactive power, kW or kvar
    # Nominal voltage of each meter behind a transformer, V.
    own_volt: Mapping[str, float] = field(default_factory=dict)
    order: tuple[str, ...] = field(init=False)  # the meters
    index: Mapping[str | None, int] = field(init=False)  # position of each meter; the busbar meter is last
    # (5, p + 2): smallest and largest plausible numbers of each source as in `Readings.values`; the last
    # column stands for unknown meters, without plausible numbers.
    lowest: Floats = field(init=False, compare=False)
    highest: Floats = field(init=False, compare=False)
    ids: pa.Array = field(init=False, compare=False)  # the meters as a column
    # Positions of the meters of columns, by contents.
    orders: dict[tuple[Any, ...], Ints] = field(init=False, compare=False, default_factory=dict)
    # Layouts of the newest payloads in Arrow and their meters, by zenoh key and file format.
    layouts: dict[tuple[str, bool], tuple[Layout, Ints]] = field(
        init=False, compare=False, default_factory=dict
    )

    def __post_init__(self) -> None:
        order = tuple(self.meters)
        object.__setattr__(self, "order", order)
        object.__setattr__(self, "index", {source: k for k, source in enumerate((*order, None))})
        lowest, highest = np.empty((2, COLUMNS, len(order) + 2))
        lowest[[T, T_POWER]], highest[[T, T_POWER]] = T_MIN, T_MAX
        lowest[V_VOLT] = np.nextafter(0.0, 1.0)
        highest[V_VOLT] = [*(VOLT_FACTOR * self.volt(source) for source in (*order, None)), -math.inf]
        lowest[P_KW:T_POWER], highest[P_KW:T_POWER] = -self.power_max_kw, self.power_max_kw
        object.__setattr__(self, "lowest", lowest)
        object.__setattr__(self, "highest", highest)
        object.__setattr__(self, "ids", pa.array(order, pa.string()))

    def volt(self, meter: object) -> float:
        """Return the nominal voltage of a meter, or of the busbar for anything else, V."""
        return self.own_volt.get(meter, self.nominal_volt) if isinstance(meter, str) else self.nominal_volt


class WireReading(msgspec.Struct, gc=False):
    """A reading as transmitted; `meter` is present in batches only, `v_phases` at the busbar."""

    t: float
    v_volt: float
    p_kw: float | None = None
    q_kvar: float | None = None
    seq: int | None = None
    meter: str | None = None
    v_phases: list[float | None] | None = None
    t_power: float | None = None


def to_reading(feeder: str, meter: str | None, raw: WireReading) -> Reading:
    """Return the reading of a meter (None: the busbar)."""
    return Reading(
        feeder,
        meter,
        raw.t,
        raw.v_volt,
        NOT_REPORTED if raw.p_kw is None else raw.p_kw,
        NOT_REPORTED if raw.q_kvar is None else raw.q_kvar,
        raw.seq,
        _phases_of(raw),
        NOT_REPORTED if raw.t_power is None else raw.t_power,
    )


def _phases_of(raw: WireReading) -> tuple[float, ...] | None:
    """Voltages of the phases; None if all are absent."""
    if raw.v_phases is None or all(v is None for v in raw.v_phases):
        return None
    return tuple(math.nan if v is None else v for v in raw.v_phases)


@dataclass(frozen=True, slots=True)
class Findings:
    """Problems of one reading, by kind."""

    of: dict[BadReason, list[str]] = field(default_factory=dict)

    def add(self, reason: BadReason, problem: str) -> None:
        """Add a problem."""
        self.of.setdefault(reason, []).append(printable(problem))

    @property
    def reason(self) -> BadReason:
        """The kind that counts the reading: a wrong type before a wrong value."""
        return next(reason for reason in _GRAVITY if reason in self.of)

    @property
    def problems(self) -> tuple[str, ...]:
        """Every problem, by gravity."""
        return tuple(problem for reason in _GRAVITY for problem in self.of.get(reason, ()))


_GRAVITY = (BadReason.TYPE, BadReason.VALUE, BadReason.UNKNOWN_METER)


def judge(value: Any, known: Known, meter: str | None = None, *, in_batch: bool) -> WireReading | Findings:
    """Return the reading in a parsed value, or all its problems.

    `in_batch`: the reading must contain its meter. Otherwise it belongs to `meter`; None: the busbar meter.
    """
    findings = Findings()
    if not isinstance(value, dict):
        findings.add(BadReason.TYPE, f"a reading is an object, not {name_of(value)}")
        return findings
    t = _number(value, "t", findings, required=True)
    if t is not None and not T_MIN <= t <= T_MAX:
        findings.add(BadReason.VALUE, f"t = {t:g} is not a Unix time in seconds")
    v_volt = _number(value, "v_volt", findings, required=True)
    nominal = known.volt(value.get("meter") if in_batch else meter)
    if v_volt is not None and not 0.0 < v_volt <= VOLT_FACTOR * nominal:
        problem = f"v_volt = {v_volt:g} V is implausible at a nominal voltage of {nominal:g} V"
        findings.add(BadReason.VALUE, problem)
    p_kw = _power(value, "p_kw", known, findings)
    q_kvar = _power(value, "q_kvar", known, findings)
    t_power = _number(value, "t_power", findings, required=False)
    if t_power is not None and not T_MIN <= t_power <= T_MAX:
        findings.add(BadReason.VALUE, f"t_power = {t_power:g} is not a Unix time in seconds")
    v_phases = _phases(value.get("v_phases"), known, findings)
    seq = value.get("seq")
    if seq is not None and (isinstance(seq, bool) or not isinstance(seq, int)):
        findings.add(BadReason.TYPE, f"seq is {name_of(seq)}, not an integer")
    elif seq is not None and not 0 <= seq <= SEQ_MAX:
        findings.add(BadReason.VALUE, "seq is outside of 0 to 2^63 - 1")
    named = value.get("meter") if in_batch else None
    if in_batch and not isinstance(named, str):
        problem = "meter is missing" if named is None else f"meter is {name_of(named)}, not a string"
        findings.add(BadReason.TYPE, problem)
    elif in_batch and named not in known.index:
        findings.add(BadReason.UNKNOWN_METER, f"the feeder has no meter `{str(named)[:64]}`")
    if findings.of or t is None or v_volt is None:
        return findings
    return WireReading(t, v_volt, p_kw, q_kvar, seq, named, v_phases, t_power)


def _phases(value: Any, known: Known, findings: Findings) -> list[float | None] | None:
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != PHASES:
        findings.add(BadReason.TYPE, f"v_phases is {name_of(value)}, not an array of {PHASES} voltages")
        return None
    named = {f"v_phases[{k}]": v for k, v in enumerate(value)}
    phases = [_number(named, name, findings, required=False) for name in named]
    highest = VOLT_FACTOR * known.nominal_volt
    # An outage of a phase gives the voltage 0.
    if not all(v is None or 0.0 <= v <= highest for v in phases):
        findings.add(
            BadReason.VALUE, f"v_phases are implausible at a nominal voltage of {known.nominal_volt:g} V"
        )
    return phases


def _power(value: dict[Any, Any], name: str, known: Known, findings: Findings) -> float | None:
    power = _number(value, name, findings, required=False)
    limit = known.power_max_kw
    if power is not None and abs(power) > limit:
        findings.add(BadReason.VALUE, f"{name} = {power:g} is implausible for one customer (limit {limit:g})")
    return power


def _number(value: dict[Any, Any], name: str, findings: Findings, *, required: bool) -> float | None:
    number = value.get(name)
    if number is None:
        if required:
            findings.add(BadReason.TYPE, f"{name} is {'null' if name in value else 'missing'}")
        return None
    if isinstance(number, bool) or not isinstance(number, int | float):
        findings.add(BadReason.TYPE, f"{name} is {name_of(number)}, not a number")
        return None
    try:
        result = float(number)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        findings.add(BadReason.VALUE, f"{name} = {result} is not finite")
        return None
    return result


def name_of(value: object) -> str:
    """Return the JSON name of a value's type."""
    names: dict[type, str] = {
        type(None): "null",
        bool: "a boolean",
        str: "a string",
        int: "a number",
        float: "a number",
        list: "an array",
        dict: "an object",
        bytes: "bytes",
    }
    return names.get(type(value), type(value).__name__)


def printable(text: str) -> str:
    """Return text with control characters and broken Unicode escaped: fit for logs and databases."""
    return text if text.isprintable() else repr(text)[1:-1]


def beginning(text: str) -> str:
    """Return the beginning of a text, printable."""
    return printable(text[:HEAD_BYTES])


# CBOR can refer to one value many times: 300 bytes can stand for more than the memory holds.
_BRIEF = reprlib.Repr()
_BRIEF.maxlevel, _BRIEF.maxdict, _BRIEF.maxstring, _BRIEF.maxother = 3, 12, HEAD_BYTES, HEAD_BYTES


def head_of(value: object) -> str:
    """Return the beginning of a value as printable text; nested values are expanded up to its end only."""
    if isinstance(value, bytes):
        return printable(value[:HEAD_BYTES].decode("utf-8", "backslashreplace"))
    try:
        return beginning(_BRIEF.repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits, or a value that contains itself
        return name_of(value)
