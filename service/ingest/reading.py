"""Readings: decoding of payloads and validation of values.

A value is checked as a whole: a `BadReading` lists every problem of the reading at once. The reason is one of
a few words (a label for counters), the problems are sentences (for operators).

Arrow is designed for trusted data: a small payload can expand to a huge table (compressed buffers, null or
dictionary columns), and unchecked offsets point outside of the buffers. Only plain, uncompressed columns are
read, after full validation.

The decoder raises no error on data. An unusable payload, or element of a batch, becomes a `BadReading` with
all its problems; the good elements of a batch are used. The reason is one of a few words (a label for
counters), the problems are sentences (for operators).

The zenoh encoding gives the format: JSON (also without an encoding), and for concentrators the same fields as
columns in CBOR (a map of arrays of equal length) or Arrow IPC (stream or file, uncompressed).
"""

from __future__ import annotations

import json
import math
import reprlib
import struct
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from itertools import chain
from typing import Any, Final

import cbor2
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import structlog
from pyarrow import ipc

from gridsec.arrays import Bools, Floats, Ints
from service.access.signing import MeterKeys, Refusal
from service.ingest.queues import Sample

T_MIN, T_MAX = 1e8, 1e10
"""Range of Unix times, s (1973 to 2286); values outside are milliseconds, counters or uptimes."""

VOLT_FACTOR = 10.0
"""Largest plausible voltage over the nominal one; beyond it the meter is defective, not manipulated."""

SEQ_MAX = 2**63 - 1
PHASES = 3
HEAD_BYTES = 200
NOT_REPORTED = math.nan
_log = structlog.get_logger("gridsec.runtime")


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


def joined(parts: Sequence[Readings]) -> Readings:
    """Return readings of the same feeder, one after the other."""
    if len(parts) == 1:
        return parts[0]
    phases = None
    if any(part.v_phases is not None for part in parts):
        none = (np.full((PHASES, len(part)), np.nan) for part in parts)
        each = zip(parts, none, strict=True)
        phases = np.concatenate([no if part.v_phases is None else part.v_phases for part, no in each], axis=1)
    return Readings(
        parts[0].feeder,
        np.concatenate([part.source for part in parts]),
        np.concatenate([part.values for part in parts], axis=1),
        np.concatenate([part.seq for part in parts]),
        np.concatenate([part.arrival for part in parts]),
        phases,
    )


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


ORDERS_KEPT = 32
"""Number of columns of meters with kept positions, for each feeder."""


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
    volt_max: Floats = field(init=False, compare=False)  # largest plausible voltage of each source, V
    ids: pa.Array = field(init=False, compare=False)  # the meters as a column
    # Results of `sources_of`, by contents.
    orders: dict[tuple[Any, ...], Ints] = field(init=False, compare=False, default_factory=dict)

    def __post_init__(self) -> None:
        order = tuple(self.meters)
        object.__setattr__(self, "order", order)
        object.__setattr__(self, "index", {source: k for k, source in enumerate((*order, None))})
        highest = np.array([VOLT_FACTOR * self.volt(source) for source in (*order, None)])
        object.__setattr__(self, "volt_max", highest)
        object.__setattr__(self, "ids", pa.array(order, pa.string()))

    def sources_of(self, names: pa.Array) -> Ints:
        """Return the position of each meter of a column, (n,); -1 for other names and nulls.

        The column of a concentrator is mostly the same: the newest results are kept by the column's contents.
        """
        buffers = [b"" if one is None else one.to_pybytes() for one in names.buffers()]
        key = (str(names.type), len(names), names.offset, *buffers)
        found = self.orders.get(key)
        if found is None:
            place = pc.index_in(names, value_set=self.ids.cast(names.type))
            found = pc.fill_null(place, -1).to_numpy(zero_copy_only=False).astype(np.intp)
            if len(self.orders) >= ORDERS_KEPT:
                self.orders.clear()
            self.orders[key] = found
        return found

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


def plausible(known: Known, source: Ints, values: Floats, seq: Ints) -> Bools:
    """True for readings with plausible numbers, (n,); NaN stands for an absent power, or time of powers.

    Arguments are columns as in `Readings`; `source` may be -1, which is not plausible.
    """
    t, v_volt, p_kw, q_kvar, t_power = values
    limit = known.power_max_kw
    good = (source >= 0) & (t >= T_MIN) & (t <= T_MAX) & (v_volt > 0.0) & (v_volt <= known.volt_max[source])
    good &= ((np.abs(p_kw) <= limit) | np.isnan(p_kw)) & ((np.abs(q_kvar) <= limit) | np.isnan(q_kvar))
    good &= ((t_power >= T_MIN) & (t_power <= T_MAX)) | np.isnan(t_power)
    return np.asarray(good & (seq >= NO_SEQ))


def _phases_plausible(phases: list[float | None], known: Known) -> bool:
    # An outage of a phase gives the voltage 0.
    highest = VOLT_FACTOR * known.nominal_volt
    return len(phases) == PHASES and all(v is None or 0.0 <= v <= highest for v in phases)


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
    if not _phases_plausible(phases, known):
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


# --- Payloads ---


_RECORD_BATCH_COMPRESSION_SLOT = 3
_MESSAGE_HEADER_SLOT = 2
_UNREADABLE = (
    pa.ArrowException,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    OverflowError,
    MemoryError,
    struct.error,
)


class ArrowProblem(ValueError):
    """A payload cannot be read.

    problems: one sentence for each problem.
    well_formed: True for valid Arrow IPC.
    """

    def __init__(self, problems: Iterable[str], *, well_formed: bool) -> None:
        self.problems = tuple(problems)
        self.well_formed = well_formed
        super().__init__("; ".join(self.problems))


def record_batches(
    payload: bytes, is_file: bool, names: tuple[str, ...]
) -> tuple[list[pa.RecordBatch], tuple[str, ...]]:
    """Return the record batches of an Arrow IPC stream or file, and the names that its columns include.

    With `is_file` the payload has the file format (with a footer). Raises ArrowProblem if the payload is not
    Arrow IPC, is compressed, or a requested column is not a plain column of strings (`meter`), integers
    (`seq`) or numbers (all others).
    """
    try:
        reader = _open(payload, is_file)
        _check_columns(reader.schema, names)
        batches = []
        for batch in _batches(reader, limit=len(payload)):
            batch.validate(full=True)
            batches.append(batch)
    except ArrowProblem:
        raise
    except _UNREADABLE as error:
        detail = str(error).partition("\n")[0] or type(error).__name__
        raise ArrowProblem([f"not Arrow IPC: {detail}"], well_formed=False) from error
    return batches, tuple(name for name in names if name in reader.schema.names)


def _open(payload: bytes, is_file: bool) -> Any:
    if is_file:
        # The file format wraps the messages of a stream between two magic words: the check for compression
        # works for both. Reading from front to back does not need the footer.
        if payload[:6] != b"ARROW1" or payload[-6:] != b"ARROW1":
            raise pa.ArrowInvalid("not an Arrow file")
        payload = payload[8:]
    _refuse_compression(payload)
    return ipc.open_stream(pa.py_buffer(payload))


def _refuse_compression(payload: bytes) -> None:
    source = pa.BufferReader(payload)
    while True:
        try:
            message = ipc.read_message(source)
        except EOFError:
            return
        if message.type == "record batch" and _is_compressed(message.metadata.to_pybytes()):
            raise ArrowProblem(
                ["compressed Arrow IPC is not supported; write it uncompressed"], well_formed=True
            )
        if message.type == "dictionary":
            raise ArrowProblem(
                ["dictionary columns are not supported; write plain strings"], well_formed=True
            )


def _is_compressed(metadata: bytes) -> bool:
    """True if a record batch's flatbuffer header has its `compression` field set."""
    message = struct.unpack_from("<I", metadata, 0)[0]
    header = _slot(metadata, message, _MESSAGE_HEADER_SLOT)
    if header == 0:
        return False
    batch = header + struct.unpack_from("<I", metadata, header)[0]
    return _slot(metadata, batch, _RECORD_BATCH_COMPRESSION_SLOT) != 0


def _slot(data: bytes, table: int, index: int) -> int:
    """Return the position of field `index` of a flatbuffer table, 0 if absent."""
    vtable = table - struct.unpack_from("<i", data, table)[0]
    size = struct.unpack_from("<H", data, vtable)[0]
    entry = 4 + 2 * index
    if entry >= size:
        return 0
    offset = struct.unpack_from("<H", data, vtable + entry)[0]
    return table + offset if offset else 0


def _check_columns(schema: pa.Schema, names: tuple[str, ...]) -> None:
    problems = []
    for name in names:
        count = schema.names.count(name)
        if count > 1:
            problems.append(f"column `{name}` appears {count} times")
        if count != 1:
            continue
        kind = schema.field(name).type
        if name == "meter":
            good = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        elif name == "seq":
            good = pa.types.is_integer(kind)
        else:
            good = pa.types.is_integer(kind) or pa.types.is_floating(kind)
        if not good:
            problems.append(f"column `{name}` has type {kind}")
    if problems:
        raise ArrowProblem(problems, well_formed=True)


def _batches(reader: Any, limit: int) -> Iterable[Any]:
    rows = 0
    for batch in reader:
        rows += batch.num_rows
        # A row takes at least one byte, otherwise its length is false (a column without buffers).
        if rows > limit:
            raise ArrowProblem([f"more than {limit} rows in {limit} bytes"], well_formed=True)
        yield batch


JSON_ENCODINGS = frozenset({"", "zenoh/bytes", "zenoh/string", "text/plain", "application/json", "text/json"})
DETAILED_PER_REASON = 5
"""Largest number of bad elements of one batch and reason that are reported in full; the others are counted.
"""


@dataclass(frozen=True, slots=True)
class DecodedPayload:
    """Readings and bad readings of one payload."""

    readings: Readings | None = None
    bad: tuple[BadReading, ...] = ()


@dataclass(frozen=True, slots=True)
class Source:
    """Source of a payload: a feeder, and a meter, the busbar (meter None) or a concentrator."""

    feeder: str
    meter: str | None = None
    concentrator: str | None = None


@dataclass(frozen=True, slots=True)
class Wire:
    """The decoder of one service."""

    known: Mapping[str, Known]  # the monitored feeders, by name
    prefix: str = "gridsec"  # first chunks of every key, without a final slash
    max_bytes: int = 256 * 1024  # size of the largest accepted payload, bytes
    keys: MeterKeys | None = None  # keys of meters; None accepts readings without signature
    # Feeder and source of the zenoh keys of single readings so far.
    places: dict[str, tuple[str, int]] = field(default_factory=dict)

    def decode(
        self,
        key: str,
        payload: bytes,
        encoding: str = "",
        *,
        size: int | None = None,
        attachment: bytes = b"",
        arrival: float = math.nan,
    ) -> DecodedPayload:
        """Return the readings and the bad readings in one payload.

        `size` is the length of the whole payload, bytes, if `payload` is only its beginning. `arrival` is the
        time of its arrival, Unix s. A schema after
        `;` in the encoding is ignored. The result is never empty: a payload without readings is a
        bad reading.
        """
        source = source_of(key, self.prefix, self.known)
        head = head_of(payload[:HEAD_BYTES])
        if isinstance(source, BadReading):
            return DecodedPayload(bad=(replace(source, head=head),))
        base = BadReading(BadReason.SYNTAX, (), beginning(key), source.feeder, source.meter, head)
        length = len(payload) if size is None else size
        if length > self.max_bytes:
            problem = f"payload of {length} bytes; at most {self.max_bytes} are read"
            return _refuse(base, BadReason.OVERSIZE, problem)
        if not payload:
            return _refuse(base, BadReason.EMPTY, "the payload is empty")
        decoder = _decoder(encoding.partition(";")[0].strip().lower(), source)
        if decoder is None:
            accepted = "application/json" if source.concentrator is None else "JSON, CBOR or Arrow IPC"
            problem = f"encoding `{encoding[:80]}` is not supported; use {accepted}"
            return _refuse(base, BadReason.ENCODING, problem)
        decoded = decoder(payload, Payload(source, self.known[source.feeder], base, arrival))
        if self.keys is None:
            return decoded
        check = partial(self.keys.check, key=key, payload=payload, attachment=attachment)
        return _verified(decoded, check, self.known[source.feeder], base)

    def gather(self, samples: Sequence[Sample]) -> Gathered:
        """Decode payloads; single JSON readings of a feeder are validated together.

        A defect of the decoder costs one payload only.
        """
        parts: dict[str, list[Readings]] = {}
        singles: dict[str, _Singles] = {}
        bad: list[tuple[BadReading, Sample]] = []

        def flush(feeder: str) -> None:
            readings, refused = self._finish(singles.pop(feeder))
            bad.extend(refused)
            parts.setdefault(feeder, []).extend(readings)

        for sample in samples:
            place = self._place_of(sample)
            if place is not None:
                try:
                    raw = _decode_one(sample.payload)
                except (msgspec.MsgspecError, RecursionError):
                    pass
                else:
                    feeder, source = place
                    rows = singles.get(feeder)
                    if rows is None:
                        rows = singles[feeder] = _Singles(feeder)
                    rows.raws.append(raw)
                    rows.sources.append(source)
                    rows.samples.append(sample)
                    continue
            decoded = self._decoded(sample)
            bad.extend((one, sample) for one in decoded.bad)
            if decoded.readings is not None:
                feeder = decoded.readings.feeder
                if feeder in singles:
                    flush(feeder)
                parts.setdefault(feeder, []).append(decoded.readings)
        for feeder in list(singles):
            flush(feeder)
        return Gathered({feeder: joined(found) for feeder, found in parts.items() if found}, bad)

    def _place_of(self, sample: Sample) -> tuple[str, int] | None:
        """Feeder and source of a payload that may be a valid single JSON reading; None for all others."""
        if self.keys is not None or sample.encoding not in JSON_ENCODINGS or sample.size > self.max_bytes:
            return None
        place = self.places.get(sample.key)
        if place is None:
            source = source_of(sample.key, self.prefix, self.known)
            if isinstance(source, BadReading) or source.concentrator is not None:
                return None
            place = self.places[sample.key] = (source.feeder, self.known[source.feeder].index[source.meter])
        return place

    def _finish(self, rows: _Singles) -> tuple[list[Readings], list[tuple[BadReading, Sample]]]:
        """Validate single readings of a feeder together; return the usable and the bad ones."""
        arrival = np.array([sample.arrival for sample in rows.samples])
        readings, good = _of_raws(self.known[rows.feeder], rows.feeder, rows.sources, rows.raws, arrival)
        if good.all():
            return [readings], []
        kept: list[Readings] = []
        bad: list[tuple[BadReading, Sample]] = []
        for k in np.flatnonzero(~good).tolist():
            decoded = self._decoded(rows.samples[k])
            bad.extend((one, rows.samples[k]) for one in decoded.bad)
            good[k] = decoded.readings is not None
        if good.any():
            kept.append(_some(readings, good))
        return kept, bad

    def _decoded(self, sample: Sample) -> DecodedPayload:
        """Decode one payload; a defect of the decoder costs this payload only."""
        try:
            return self.decode(
                sample.key,
                sample.payload,
                sample.encoding,
                size=sample.size,
                attachment=sample.attachment,
                arrival=sample.arrival,
            )
        except Exception as error:  # noqa: BLE001 - one payload must not end the service
            problem = beginning(f"{type(error).__name__}: {error}")
            _log.error("a payload could not be decoded", key=sample.key[:HEAD_BYTES], problem=problem)
            head, key = head_of(sample.payload[:HEAD_BYTES]), beginning(sample.key)
            return DecodedPayload(bad=(BadReading(BadReason.INTERNAL, (problem,), key, head=head),))


@dataclass(frozen=True, slots=True)
class Gathered:
    """Decoded payloads of a round."""

    readings: Mapping[str, Readings]  # usable readings of each feeder, by its name
    bad: list[tuple[BadReading, Sample]]  # bad readings, with their payloads


@dataclass(frozen=True, slots=True)
class _Singles:
    """Well-typed single readings of one feeder."""

    feeder: str
    raws: list[WireReading] = field(default_factory=list)
    sources: list[int] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Payload:
    """Source and arrival of a payload, and the frame of its bad readings."""

    source: Source
    known: Known
    base: BadReading
    arrival: float

    def columns(self, source: Ints, values: Floats, seq: Ints, phases: Floats | None = None) -> Readings:
        """Return its readings, from columns as in `Readings`."""
        arrival = np.full(source.size, self.arrival)
        return Readings(self.source.feeder, source, values, seq, arrival, phases)


def _some(readings: Readings, which: Bools) -> Readings:
    """Return some of the readings."""
    phases = None if readings.v_phases is None else readings.v_phases[:, which]
    return Readings(
        readings.feeder,
        readings.source[which],
        readings.values[:, which],
        readings.seq[which],
        readings.arrival[which],
        phases,
    )


def _of_raws(
    known: Known, feeder: str, sources: Sequence[int], raws: Sequence[WireReading], arrival: Floats
) -> tuple[Readings, Bools]:
    """Return well-typed readings as columns, and which of them are plausible, (n,)."""
    values = np.array(
        [
            [raw.t for raw in raws],
            [raw.v_volt for raw in raws],
            [raw.p_kw for raw in raws],
            [raw.q_kvar for raw in raws],
            [raw.t_power for raw in raws],
        ],
        dtype=np.float64,
    )
    source = np.array(sources, dtype=np.intp)
    seq, wrong = _sequence([raw.seq for raw in raws])
    good = plausible(known, source, values, seq) & ~wrong
    phases = None
    for k, v_phases in enumerate([raw.v_phases for raw in raws]):
        if v_phases is None:
            continue
        if not _phases_plausible(v_phases, known):
            good[k] = False
        elif any(v is not None for v in v_phases):
            phases = np.full((PHASES, source.size), np.nan) if phases is None else phases
            phases[:, k] = np.array(v_phases, dtype=np.float64)
    return Readings(feeder, source, values, seq, arrival, phases), good


def _sequence(numbers: Sequence[int | None]) -> tuple[Ints, Bools]:
    """Return sequence numbers as a column, and which of them are outside of the permitted range, (n,)."""
    wrong = np.array([one is not None and not 0 <= one <= SEQ_MAX for one in numbers], dtype=np.bool_)
    column = [NO_SEQ if one is None or not 0 <= one <= SEQ_MAX else one for one in numbers]
    return np.array(column, dtype=np.int64), wrong


def _verified(
    decoded: DecodedPayload,
    check: Callable[[str, str | None], Refusal | None],
    known: Known,
    base: BadReading,
) -> DecodedPayload:
    """Move readings that their keys refuse to the bad ones."""
    if decoded.readings is None:
        return decoded
    readings, bad = decoded.readings, list(decoded.bad)
    accepted = np.ones(len(readings), dtype=np.bool_)
    more: Counter[BadReason] = Counter()
    refused: dict[BadReason, list[str | None]] = defaultdict(list)
    for k, source in enumerate(readings.source.tolist()):
        meter = None if source == len(known.order) else known.order[source]
        refusal = check(readings.feeder, meter)
        if refusal is None:
            continue
        accepted[k] = False
        reason = BadReason(refusal.reason)
        more[reason] += 1
        refused[reason].append(meter)
        if more[reason] <= DETAILED_PER_REASON:
            bad.append(replace(base, reason=reason, problems=(refusal.problem,), meter=meter))
    for reason, meters in refused.items():
        first = next(k for k, one in enumerate(bad) if one.reason is reason and k >= len(decoded.bad))
        bad[first] = replace(bad[first], refused=tuple(dict.fromkeys(meters)))
    for reason, count in more.items():
        if (rest := count - DETAILED_PER_REASON) > 0:
            problem = f"{rest} more elements of the batch: {reason}"
            bad.append(replace(base, reason=reason, problems=(problem,), count=rest))
    return DecodedPayload(_some(readings, accepted) if accepted.any() else None, tuple(bad))


def _decoder(kind: str, source: Source) -> Callable[[bytes, Payload], DecodedPayload] | None:
    if kind in JSON_ENCODINGS:
        return _single if source.concentrator is None else _json_batch
    if source.concentrator is not None:
        return _BATCH_DECODERS.get(kind)
    return None


def source_of(key: str, prefix: str, known: Mapping[str, Known]) -> Source | BadReading:
    """Return the source that a key denotes, or a bad reading with the reason.

    Keys are `<prefix>/<feeder>/meter/<meter>/reading`, `<prefix>/<feeder>/substation/reading` and
    `<prefix>/<feeder>/concentrator/<id>/readings`.
    """
    if "*" in key or "$" in key:
        return _nowhere(key, BadReason.KEY, "is a pattern; a reading needs a key without wildcards")
    head, _, rest = key.partition(prefix + "/")
    match rest.split("/"):
        case [feeder, "meter", meter, "reading"] if not head:
            source = Source(feeder, meter)
        case [feeder, "substation", "reading"] if not head:
            source = Source(feeder)
        case [feeder, "concentrator", concentrator, "readings"] if not head:
            source = Source(feeder, None, concentrator)
        case _:
            return _nowhere(key, BadReason.KEY, "is not the key of a reading")
    limits = known.get(source.feeder)
    if limits is None:
        return _nowhere(key, BadReason.UNKNOWN_FEEDER, "is the key of a feeder that is not monitored here")
    if source.meter is not None and source.meter not in limits.index:
        bad = _nowhere(key, BadReason.UNKNOWN_METER, "is the key of a meter that the feeder does not have")
        return replace(bad, feeder=source.feeder)
    return source


def _nowhere(key: str, reason: BadReason, why: str) -> BadReading:
    shown = beginning(key)
    return BadReading(reason, (f"`{shown}` {why}",), shown)


def _refuse(base: BadReading, reason: BadReason, *problems: str) -> DecodedPayload:
    return DecodedPayload(bad=(replace(base, reason=reason, problems=tuple(map(printable, problems))),))


# ---------------------------------------------------------------------------------------------------------
# JSON


_decode_one = msgspec.json.Decoder(WireReading).decode
_decode_many = msgspec.json.Decoder(list[WireReading]).decode


def _parse(payload: bytes) -> Any:
    """Parse JSON; NaN and infinities are accepted here and reported by field."""
    try:
        return msgspec.json.decode(payload)
    except msgspec.ValidationError:
        return json.loads(payload)
    except msgspec.DecodeError as error:
        try:
            return json.loads(payload)
        except ValueError:
            raise error from None


def _single(payload: bytes, of: Payload) -> DecodedPayload:
    place = of.known.index[of.source.meter]
    try:
        raw = _decode_one(payload)
    except (msgspec.MsgspecError, RecursionError):
        pass
    else:
        readings, good = _of_raws(of.known, of.source.feeder, [place], [raw], np.array([of.arrival]))
        if good.all():
            return DecodedPayload(readings)
    try:
        value = _parse(payload)
    except (ValueError, RecursionError, msgspec.MsgspecError) as error:
        return _refuse(of.base, BadReason.SYNTAX, f"not JSON: {error}")
    if value in ([], {}):
        return _refuse(of.base, BadReason.EMPTY, "the reading is empty")
    judged = judge(value, of.known, of.source.meter, in_batch=False)
    if isinstance(judged, Findings):
        return _refuse(of.base, judged.reason, *judged.problems)
    arrival = np.array([of.arrival])
    return DecodedPayload(_of_raws(of.known, of.source.feeder, [place], [judged], arrival)[0])


def _json_batch(payload: bytes, of: Payload) -> DecodedPayload:
    try:
        raws = _decode_many(payload)
    except (msgspec.MsgspecError, RecursionError):
        raws = []
    if raws:
        index = of.known.index
        sources = [-1 if raw.meter is None else index.get(raw.meter, -1) for raw in raws]
        arrival = np.full(len(raws), of.arrival)
        readings, good = _of_raws(of.known, of.source.feeder, sources, raws, arrival)
        if good.all():
            return DecodedPayload(readings)
    try:
        value = _parse(payload)
    except (ValueError, RecursionError, msgspec.MsgspecError) as error:
        return _refuse(of.base, BadReason.SYNTAX, f"not JSON: {error}")
    if not isinstance(value, list):
        return _refuse(of.base, BadReason.TYPE, f"expected a JSON array of readings, not {name_of(value)}")
    if raws and len(value) == len(raws):
        return _sorted_out(readings, good, value.__getitem__, of)
    return _batch(value, of)


# ---------------------------------------------------------------------------------------------------------
# Columns


_FIELDS = ("meter", "t", "v_volt", "p_kw", "q_kvar", "seq", "t_power")
_NUMBERS = ("t", "v_volt", "p_kw", "q_kvar", "t_power")


def _cbor(payload: bytes, of: Payload) -> DecodedPayload:
    try:
        columns = cbor2.loads(payload)
    except (
        cbor2.CBORDecodeError,
        ValueError,
        OverflowError,
        RecursionError,
        MemoryError,
        TypeError,
    ) as error:
        return _refuse(of.base, BadReason.SYNTAX, f"not CBOR: {error}")
    if not isinstance(columns, dict):
        return _refuse(of.base, BadReason.TYPE, f"expected a CBOR map of columns, not {name_of(columns)}")
    present = {name: columns[name] for name in _FIELDS if name in columns}
    problems = [
        f"column `{name}` is {name_of(column)}, not an array"
        for name, column in present.items()
        if not isinstance(column, list)
    ]
    problems += _missing(present)
    if problems:
        return _refuse(of.base, BadReason.TYPE, *problems)
    lengths = {name: len(column) for name, column in present.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"`{name}` {length}" for name, length in lengths.items())
        return _refuse(of.base, BadReason.TYPE, f"the columns differ in length: {listed}")
    return _of_lists(present, of)


def _missing(present: Collection[str]) -> list[str]:
    return [f"column `{name}` is missing" for name in ("meter", "t", "v_volt") if name not in present]


_NUMERIC = frozenset({int, float, type(None)})
_NAMING = frozenset({str})
_COUNTING = frozenset({int, type(None)})


def _of_lists(columns: Mapping[str, list[Any]], of: Payload) -> DecodedPayload:
    """Return the readings of columns of equal length, of any contents."""

    def row(k: int) -> dict[str, Any]:
        return {name: column[k] for name, column in columns.items()}

    size = len(columns["t"])
    numbers = [columns.get(name) or [None] * size for name in _NUMBERS]
    names, counts = columns["meter"], columns.get("seq") or [None] * size
    typed = all(_NUMERIC.issuperset(map(type, column)) for column in numbers)
    typed = typed and _NAMING.issuperset(map(type, names)) and _COUNTING.issuperset(map(type, counts))
    if not typed or not size:
        return _batch([row(k) for k in range(size)], of)
    try:
        values = np.array(numbers, dtype=np.float64)
    except OverflowError:  # an integer of hundreds of digits
        return _batch([row(k) for k in range(size)], of)
    source = np.array([of.known.index.get(name, -1) for name in names], dtype=np.intp)
    seq, wrong = _sequence(counts)
    good = plausible(of.known, source, values, seq) & ~wrong
    # NaN is absent only as a null.
    for column, found in zip(numbers, np.isnan(values), strict=True):
        for k in np.flatnonzero(found).tolist():
            good[k] &= column[k] is None
    return _sorted_out(of.columns(source, values, seq), good, row, of)


def _arrow(payload: bytes, of: Payload, *, is_file: bool) -> DecodedPayload:
    try:
        batches, present = record_batches(payload, is_file, _FIELDS)
    except ArrowProblem as error:
        reason = BadReason.TYPE if error.well_formed else BadReason.SYNTAX
        return _refuse(of.base, reason, *error.problems)
    if problems := _missing(present):
        return _refuse(of.base, BadReason.TYPE, *problems)
    parts = [_of_batch(batch, present, of) for batch in batches if batch.num_rows]
    if not parts:
        return _batch([], of)
    begins = np.cumsum([0, *(len(readings) for readings, _ in parts)])

    def row(k: int) -> dict[str, Any]:
        number = int(np.searchsorted(begins, k, side="right")) - 1
        batch = [one for one in batches if one.num_rows][number]
        return {name: batch.column(name)[k - int(begins[number])].as_py() for name in present}

    good = np.concatenate([one for _, one in parts])
    return _sorted_out(joined([readings for readings, _ in parts]), good, row, of)


def _of_batch(batch: pa.RecordBatch, present: Collection[str], of: Payload) -> tuple[Readings, Bools]:
    """Return the readings of a record batch, and which of them are plausible, (n,)."""
    size = batch.num_rows
    values = np.full((COLUMNS, size), np.nan)
    good = np.ones(size, dtype=np.bool_)
    for number, name in enumerate(_NUMBERS):
        if name not in present:
            continue
        column = batch.column(name)
        values[number] = column.to_numpy(zero_copy_only=False)
        absent = np.isnan(values[number])
        if absent.any():
            # NaN is absent only as a null.
            good &= ~(absent & column.is_valid().to_numpy(zero_copy_only=False))
    seq = np.full(size, NO_SEQ, dtype=np.int64)
    if "seq" in present:
        column = batch.column("seq")
        valid = column.is_valid().to_numpy(zero_copy_only=False)
        counts = pc.fill_null(column, 0).to_numpy(zero_copy_only=False)
        fits = (counts >= 0) & (counts <= SEQ_MAX)
        good &= fits
        seq[valid & fits] = counts[valid & fits]
    source = of.known.sources_of(batch.column("meter"))
    good &= plausible(of.known, source, values, seq)
    return of.columns(source, values, seq), good


_BATCH_DECODERS: Mapping[str, Callable[[bytes, Payload], DecodedPayload]] = {
    "application/cbor": _cbor,
    "application/vnd.apache.arrow.stream": partial(_arrow, is_file=False),
    "application/vnd.apache.arrow.file": partial(_arrow, is_file=True),
}


def _sorted_out(readings: Readings, good: Bools, row: Callable[[int], Any], of: Payload) -> DecodedPayload:
    """Return plausible readings, and the others as bad readings; `row` returns an element by position."""
    if good.all():
        return DecodedPayload(readings)
    raws, bad = _judged(((k, row(k)) for k in np.flatnonzero(~good).tolist()), of)
    if raws:
        return _batch([row(k) for k in range(len(readings))], of)
    return DecodedPayload(_some(readings, good) if good.any() else None, bad)


def _batch(rows: list[Any], of: Payload) -> DecodedPayload:
    """Return the readings of elements of any contents."""
    if not rows:
        return _refuse(of.base, BadReason.EMPTY, "the batch is empty")
    raws, bad = _judged(enumerate(rows), of)
    if not raws:
        return DecodedPayload(bad=bad)
    sources = [of.known.index[raw.meter] for raw in raws]
    arrival = np.full(len(raws), of.arrival)
    readings, _ = _of_raws(of.known, of.source.feeder, sources, raws, arrival)
    return DecodedPayload(readings, bad)


def _judged(rows: Iterable[tuple[int, Any]], of: Payload) -> tuple[list[WireReading], tuple[BadReading, ...]]:
    """Return the readings of elements with their positions, and the bad ones with all their problems."""
    raws: list[WireReading] = []
    bad: dict[BadReason, list[BadReading]] = {}
    more: Counter[BadReason] = Counter()
    for index, row in rows:
        found = judge(row, of.known, in_batch=True)
        if isinstance(found, WireReading):
            raws.append(found)
            continue
        alike = bad.setdefault(found.reason, [])
        if len(alike) == DETAILED_PER_REASON:
            more[found.reason] += 1
            continue
        meter = row.get("meter") if isinstance(row, dict) else None
        ours = meter if isinstance(meter, str) and meter in of.known.index else None
        listed = tuple(f"element {index}: {problem}" for problem in found.problems)
        alike.append(replace(of.base, reason=found.reason, problems=listed, meter=ours, head=head_of(row)))
    rest = (
        replace(
            of.base, reason=reason, problems=(f"{count} more elements of the batch: {reason}",), count=count
        )
        for reason, count in more.items()
    )
    return raws, (*chain.from_iterable(bad.values()), *rest)
