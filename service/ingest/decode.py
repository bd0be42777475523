"""Decoding of payloads to readings, and to bad readings with all their problems.

The decoder raises no error on data. An unusable payload, or element of a batch, becomes a `BadReading`; the
good elements of a batch are used. Valid readings take the fast way: typed parsing, columns, and one check of
all numbers. Only the others are parsed and judged one by one.

The zenoh encoding gives the format: JSON (also without an encoding), and for concentrators the same fields as
columns in CBOR (a map of arrays of equal length) or Arrow IPC (stream or file, uncompressed).
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, TypeAlias

import cbor2
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import structlog

from gridsec.arrays import Bools, Floats, Ints, all_of
from service.access.signing import MeterKeys, Refusal
from service.ingest.arrow import ArrowProblem, Column, column_of, layout_of, record_batches
from service.ingest.queues import Sample
from service.ingest.reading import (
    COLUMNS,
    HEAD_BYTES,
    NO_SEQ,
    P_KW,
    PHASES,
    SEQ_MAX,
    VOLT_FACTOR,
    BadReading,
    BadReason,
    Findings,
    Known,
    Readings,
    WireReading,
    beginning,
    head_of,
    judge,
    name_of,
    printable,
)

_log = structlog.get_logger("gridsec.runtime")
ORDERS_KEPT = 32
"""Number of columns of meters with kept positions, for each feeder."""
LAYOUTS_KEPT = 8
"""Number of concentrators with a kept layout, for each feeder."""


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
    # Feeder and source of single JSON readings so far, by zenoh key and encoding.
    places: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)

    def expects(self, key: str) -> bool:
        """True for the key of single readings of a known meter."""
        source = source_of(key, self.prefix, self.known)
        return isinstance(source, Source) and source.concentrator is None

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
        if isinstance(source, BadReading):
            return DecodedPayload(bad=(replace(source, head=head_of(payload[:HEAD_BYTES])),))
        of = Payload(key, payload, source, self.known[source.feeder], arrival)
        length = len(payload) if size is None else size
        if length > self.max_bytes:
            return of.refused(
                BadReason.OVERSIZE, f"payload of {length} bytes; at most {self.max_bytes} are read"
            )
        if not payload:
            return of.refused(BadReason.EMPTY, "the payload is empty")
        decoder = _decoder(encoding.partition(";")[0].strip().lower(), source)
        if decoder is None:
            accepted = "application/json" if source.concentrator is None else "JSON, CBOR or Arrow IPC"
            problem = f"encoding `{encoding[:80]}` is not supported; use {accepted}"
            return of.refused(BadReason.ENCODING, problem)
        decoded = decoder(payload, of)
        if self.keys is None:
            return decoded
        check = partial(self.keys.check, key=key, payload=payload, attachment=attachment)
        return _verified(decoded, check, of)

    def gather(self, samples: Sequence[Sample]) -> Gathered:
        """Decode payloads; single JSON readings of a feeder are validated together.

        A defect of the decoder costs one payload only.
        """
        parts: dict[str, list[Readings]] = {}
        singles: dict[str, list[_Single]] = {}
        bad: list[tuple[BadReading, Sample]] = []

        def flush(feeder: str) -> None:
            readings, refused = self._finish(feeder, singles.pop(feeder))
            bad.extend(refused)
            parts.setdefault(feeder, []).extend(readings)

        places = self.places
        for sample in samples:
            key, payload, encoding, _, size, _ = sample
            place = places.get((key, encoding)) if size <= self.max_bytes else None
            if place is None:
                place = self._place_of(sample)
            if place is not None:
                try:
                    raw = _decode_one(payload)
                except (msgspec.MsgspecError, RecursionError):
                    pass
                else:
                    feeder, source = place
                    rows = singles.get(feeder)
                    if rows is None:
                        rows = singles[feeder] = []
                    rows.append((source, raw, sample))
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
        source = source_of(sample.key, self.prefix, self.known)
        if isinstance(source, BadReading) or source.concentrator is not None:
            return None
        place = source.feeder, self.known[source.feeder].index[source.meter]
        self.places[sample.key, sample.encoding] = place
        return place

    def _finish(
        self, feeder: str, rows: Sequence[_Single]
    ) -> tuple[list[Readings], list[tuple[BadReading, Sample]]]:
        """Validate single readings of a feeder together; return the usable and the bad ones."""
        sources, raws, samples = zip(*rows, strict=True)
        arrival = np.array([sample.arrival for sample in samples])
        readings, good = _of_raws(self.known[feeder], feeder, sources, raws, arrival)
        if good.all():
            return [readings], []
        kept: list[Readings] = []
        bad: list[tuple[BadReading, Sample]] = []
        for k in np.flatnonzero(~good).tolist():
            decoded = self._decoded(samples[k])
            bad.extend((one, samples[k]) for one in decoded.bad)
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


_Single: TypeAlias = tuple[int, WireReading, Sample]
"""Source, contents and payload of a well-typed single reading."""


@dataclass(frozen=True, slots=True)
class Payload:
    """Content, source and arrival of a payload."""

    key: str
    content: bytes
    source: Source
    known: Known
    arrival: float

    def bad(self, reason: BadReason, *problems: str, **more: Any) -> BadReading:
        """Return a bad reading of this payload; `more` are other fields of it."""
        source, texts = self.source, tuple(map(printable, problems))
        fields = {"meter": source.meter, "head": head_of(self.content[:HEAD_BYTES]), **more}
        return BadReading(reason, texts, beginning(self.key), source.feeder, **fields)

    def refused(self, reason: BadReason, *problems: str) -> DecodedPayload:
        """Return the payload as one bad reading."""
        return DecodedPayload(bad=(self.bad(reason, *problems),))

    def columns(self, source: Ints, values: Floats, seq: Ints, phases: Floats | None = None) -> Readings:
        """Return its readings, from columns as in `Readings`."""
        arrival = np.full(source.size, self.arrival)
        return Readings(self.source.feeder, source, values, seq, arrival, phases)


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


def plausible(known: Known, source: Ints, values: Floats, given: Bools) -> Bools:
    """True for readings with plausible numbers, (n,).

    Arguments are columns as in `Readings`; `source` may be -1, which is not plausible. `given` (5, n) is
    False for absent numbers, which are NaN.
    """
    inside = (values >= known.lowest.take(source, axis=1)) & (values <= known.highest.take(source, axis=1))
    inside[P_KW:] |= ~given[P_KW:]
    return np.asarray(inside.all(axis=0))


def _of_raws(
    known: Known, feeder: str, sources: Sequence[int], raws: Sequence[WireReading], arrival: Floats
) -> tuple[Readings, Bools]:
    """Return well-typed readings as columns, and which of them are plausible, (n,)."""
    columns = (
        [raw.t for raw in raws],
        [raw.v_volt for raw in raws],
        [raw.p_kw for raw in raws],
        [raw.q_kvar for raw in raws],
        [raw.t_power for raw in raws],
    )
    source = np.array(sources, dtype=np.intp)
    values, given = _numbers_of(columns)
    seq, fits = _sequence([raw.seq for raw in raws])
    good = plausible(known, source, values, given) & fits
    phases = _phases_of([raw.v_phases for raw in raws], known, good)
    return Readings(feeder, source, values, seq, arrival, phases), good


def _numbers_of(columns: Sequence[Sequence[float | None] | None]) -> tuple[Floats, Bools]:
    """Return columns of numbers as an array, and which of them are given, (5, n); a column may be absent."""
    size = len(next(column for column in columns if column is not None))
    values, given = np.full((COLUMNS, size), np.nan), np.zeros((COLUMNS, size), dtype=np.bool_)
    for row, column in enumerate(columns):
        absent = size if column is None else column.count(None)
        if column is not None and absent < size:
            values[row] = np.array(column, dtype=np.float64)
            given[row] = [one is not None for one in column] if absent else True
    return values, given


def _phases_of(found: Sequence[list[float | None] | None], known: Known, good: Bools) -> Floats | None:
    """Voltages of the phases of readings, (3, n); None without any. `good` becomes False if implausible."""
    if found.count(None) == len(found):
        return None
    phases = np.full((PHASES, len(found)), np.nan)
    for k, v_phases in enumerate(found):
        if v_phases is not None:
            good[k] &= len(v_phases) == PHASES
            if good[k]:
                phases[:, k] = np.array(v_phases, dtype=np.float64)
    # An outage of a phase gives the voltage 0.
    good &= ~((phases < 0.0) | (phases > VOLT_FACTOR * known.nominal_volt)).any(axis=0)
    return None if np.isnan(phases).all() else phases


def _sequence(numbers: Sequence[int | None]) -> tuple[Ints, Bools | bool]:
    """Return sequence numbers as a column, and which of them are in the permitted range, (n,) or for all."""
    if numbers.count(None) == len(numbers):
        return np.full(len(numbers), NO_SEQ, dtype=np.int64), True
    fits = np.array([one is None or 0 <= one <= SEQ_MAX for one in numbers], dtype=np.bool_)
    column = [NO_SEQ if one is None or not 0 <= one <= SEQ_MAX else one for one in numbers]
    return np.array(column, dtype=np.int64), fits


def _verified(
    decoded: DecodedPayload,
    check: Callable[[str, str | None], Refusal | None],
    of: Payload,
) -> DecodedPayload:
    """Move readings that their keys refuse to the bad ones."""
    if decoded.readings is None:
        return decoded
    readings, bad = decoded.readings, list(decoded.bad)
    accepted = np.ones(len(readings), dtype=np.bool_)
    more: Counter[BadReason] = Counter()
    refused: dict[BadReason, list[str | None]] = defaultdict(list)
    for k, source in enumerate(readings.source.tolist()):
        meter = None if source == len(of.known.order) else of.known.order[source]
        refusal = check(readings.feeder, meter)
        if refusal is None:
            continue
        accepted[k] = False
        reason = BadReason(refusal.reason)
        more[reason] += 1
        refused[reason].append(meter)
        if more[reason] <= DETAILED_PER_REASON:
            bad.append(of.bad(reason, refusal.problem, meter=meter))
    for reason, meters in refused.items():
        first = next(k for k, one in enumerate(bad) if one.reason is reason and k >= len(decoded.bad))
        bad[first] = replace(bad[first], refused=tuple(dict.fromkeys(meters)))
    for reason, count in more.items():
        if (rest := count - DETAILED_PER_REASON) > 0:
            bad.append(of.bad(reason, f"{rest} more elements of the batch: {reason}", count=rest))
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
        return of.refused(BadReason.SYNTAX, f"not JSON: {error}")
    if value in ([], {}):
        return of.refused(BadReason.EMPTY, "the reading is empty")
    judged = judge(value, of.known, of.source.meter, in_batch=False)
    if isinstance(judged, Findings):
        return of.refused(judged.reason, *judged.problems)
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
        return of.refused(BadReason.SYNTAX, f"not JSON: {error}")
    if not isinstance(value, list):
        return of.refused(BadReason.TYPE, f"expected a JSON array of readings, not {name_of(value)}")
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
        return of.refused(BadReason.SYNTAX, f"not CBOR: {error}")
    if not isinstance(columns, dict):
        return of.refused(BadReason.TYPE, f"expected a CBOR map of columns, not {name_of(columns)}")
    present = {name: columns[name] for name in _FIELDS if name in columns}
    problems = [
        f"column `{name}` is {name_of(column)}, not an array"
        for name, column in present.items()
        if not isinstance(column, list)
    ]
    problems += _missing(present)
    if problems:
        return of.refused(BadReason.TYPE, *problems)
    lengths = {name: len(column) for name, column in present.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"`{name}` {length}" for name, length in lengths.items())
        return of.refused(BadReason.TYPE, f"the columns differ in length: {listed}")
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
    numbers = [columns.get(name) for name in _NUMBERS]
    names, counts = columns["meter"], columns.get("seq") or [None] * size
    typed = all(_NUMERIC.issuperset(map(type, column)) for column in numbers if column is not None)
    typed = typed and _NAMING.issuperset(map(type, names)) and _COUNTING.issuperset(map(type, counts))
    if not typed or not size:
        return _batch([row(k) for k in range(size)], of)
    try:
        values, given = _numbers_of(numbers)
    except OverflowError:  # an integer of hundreds of digits
        return _batch([row(k) for k in range(size)], of)
    source = np.array([of.known.index.get(name, -1) for name in names], dtype=np.intp)
    seq, fits = _sequence(counts)
    good = plausible(of.known, source, values, given) & fits
    return _sorted_out(of.columns(source, values, seq), good, row, of)


def _arrow(payload: bytes, of: Payload, *, is_file: bool) -> DecodedPayload:
    layouts, key = of.known.layouts, (of.key, is_file)
    if key in layouts:
        layout, source = layouts[key]
        columns = layout.columns(payload)
        if columns is not None:
            readings, good = _of_columns(columns, source, of)
            if all_of(good):
                return DecodedPayload(readings)
    try:
        batches, present = record_batches(payload, is_file, _FIELDS)
    except ArrowProblem as error:
        reason = BadReason.TYPE if error.well_formed else BadReason.SYNTAX
        return of.refused(reason, *error.problems)
    if problems := _missing(present):
        return of.refused(BadReason.TYPE, *problems)
    parts = [_of_batch(batch, present, of) for batch in batches if batch.num_rows]
    if not parts:
        return _batch([], of)
    if len(batches) == 1:
        found = layout_of(payload, batches[0], [name for name in present if name != "meter"])
        if found is not None:
            if len(layouts) >= LAYOUTS_KEPT:
                layouts.clear()
            layouts[key] = found, parts[0][0].source
    begins = np.cumsum([0, *(len(readings) for readings, _ in parts)])

    def row(k: int) -> dict[str, Any]:
        number = int(np.searchsorted(begins, k, side="right")) - 1
        batch = [one for one in batches if one.num_rows][number]
        return {name: batch.column(name)[k - int(begins[number])].as_py() for name in present}

    good = np.concatenate([one for _, one in parts])
    return _sorted_out(joined([readings for readings, _ in parts]), good, row, of)


def _sources_of(known: Known, names: pa.Array) -> Ints:
    """Return the position of each meter of a column, (n,); -1 for other names and nulls.

    The column of a concentrator is mostly the same: the newest results are kept by the column's contents.
    """
    buffers = [b"" if one is None else one.to_pybytes() for one in names.buffers()]
    key = (str(names.type), len(names), names.offset, *buffers)
    found = known.orders.get(key)
    if found is None:
        place = pc.index_in(names, value_set=known.ids.cast(names.type))
        found = pc.fill_null(place, -1).to_numpy(zero_copy_only=False).astype(np.intp)
        if len(known.orders) >= ORDERS_KEPT:
            known.orders.clear()
        known.orders[key] = found
    return found


def _of_batch(batch: pa.RecordBatch, present: Collection[str], of: Payload) -> tuple[Readings, Bools]:
    """Return the readings of a record batch, and which of them are plausible, (n,)."""
    columns = {name: column_of(batch, name) for name in present if name != "meter"}
    return _of_columns(columns, _sources_of(of.known, batch.column("meter")), of)


def _of_columns(columns: Mapping[str, Column], source: Ints, of: Payload) -> tuple[Readings, Bools]:
    """Return the readings of columns, and which of them are plausible, (n,)."""
    size = source.size
    values, given = np.full((COLUMNS, size), np.nan), np.zeros((COLUMNS, size), dtype=np.bool_)
    for row, name in enumerate(_NUMBERS):
        column = columns.get(name)
        if column is None:
            continue
        values[row] = column.values
        given[row] = True if column.valid is None else column.valid
        if column.valid is not None:
            values[row, ~column.valid] = np.nan
    good = plausible(of.known, source, values, given)
    seq = np.full(size, NO_SEQ, dtype=np.int64)
    if (counts := columns.get("seq")) is not None:
        valid = True if counts.valid is None else counts.valid
        fits = (counts.values >= 0) & (counts.values <= SEQ_MAX)
        good &= fits | ~np.asarray(valid)
        np.copyto(seq, counts.values, where=fits & valid, casting="unsafe")
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
        return of.refused(BadReason.EMPTY, "the batch is empty")
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
        listed = (f"element {index}: {problem}" for problem in found.problems)
        alike.append(of.bad(found.reason, *listed, meter=ours, head=head_of(row)))
    rest = (
        of.bad(reason, f"{count} more elements of the batch: {reason}", count=count)
        for reason, count in more.items()
    )
    return raws, (*chain.from_iterable(bad.values()), *rest)
