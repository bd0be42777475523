"""Arrow IPC payloads: record batches after full validation, and the layout of payloads that repeat.

Arrow is designed for trusted data: a small payload can expand to a huge table (compressed buffers, null or
dictionary columns), and unchecked offsets point outside of the buffers. Only plain, uncompressed columns are
read, after full validation.

The payloads of a concentrator mostly differ in their numbers only. `Layout` holds the other bytes of a
validated payload: a payload that agrees with them is valid, and only its numbers are read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import ipc

from gridsec.arrays import Bools

_RECORD_BATCH_COMPRESSION_SLOT: Final = 3
_MESSAGE_HEADER_SLOT: Final = 2
_MAGIC_BYTES: Final = 8
"""Length of the beginning of a file before its stream, bytes."""
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
    content = pa.py_buffer(payload)
    if is_file:
        # The file format wraps the messages of a stream between two magic words: the check for compression
        # works for both. Reading from front to back does not need the footer.
        if payload[:6] != b"ARROW1" or payload[-6:] != b"ARROW1":
            raise pa.ArrowInvalid("not an Arrow file")
        content = content.slice(_MAGIC_BYTES)
    _refuse_compression(content)
    return ipc.open_stream(content)


def _refuse_compression(content: pa.Buffer) -> None:
    source = pa.BufferReader(content)
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


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """Numbers of one column. n rows."""

    values: NDArray[Any]  # (n,) of any numeric type; without meaning where null
    valid: Bools | None  # (n,) False where null; None without nulls


def column_of(batch: pa.RecordBatch, name: str) -> Column:
    """Return a column of integers or numbers."""
    column = batch.column(name)
    if not column.null_count:
        return Column(column.to_numpy(zero_copy_only=False), None)
    filled = pc.fill_null(column, 0).to_numpy(zero_copy_only=False)
    return Column(filled, column.is_valid().to_numpy(zero_copy_only=False))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Bytes of a validated payload of one record batch that are not its numbers, and the places of these."""

    size: int  # length of the payload, bytes
    rows: int  # number of rows
    fixed: tuple[tuple[int, bytes], ...]  # position and contents of the other bytes
    numbers: Mapping[str, tuple[int, Any, Bools | None]]  # position, type and nulls of each column

    def columns(self, payload: bytes) -> dict[str, Column] | None:
        """Return the columns of a payload that differs in its numbers only; None for any other payload."""
        if len(payload) != self.size:
            return None
        if any(payload[at : at + len(part)] != part for at, part in self.fixed):
            return None
        return {
            name: Column(np.frombuffer(payload, kind, self.rows, at), valid)
            for name, (at, kind, valid) in self.numbers.items()
        }


def layout_of(payload: bytes, batch: pa.RecordBatch, names: Iterable[str]) -> Layout | None:
    """Return the layout of a validated payload with one record batch; None if its buffers overlap.

    names: its columns of numbers.
    """
    begin, rows = pa.py_buffer(payload).address, batch.num_rows
    buffers = [one for column in batch.columns for one in column.buffers() if one is not None and one.size]
    places = sorted((one.address - begin, one.address - begin + one.size) for one in buffers)
    inside = bool(places) and places[0][0] >= 0 and places[-1][1] <= len(payload)
    apart = all(one[1] <= other[0] for one, other in pairwise(places))
    if not (inside and apart) or any(column.offset for column in batch.columns):
        return None
    numbers = {}
    for name in names:
        column = batch.column(name)
        kind, data = np.dtype(column.type.to_pandas_dtype()), column.buffers()[1]
        if data is None or data.size < rows * kind.itemsize:
            return None
        valid = column.is_valid().to_numpy(zero_copy_only=False) if column.null_count else None
        numbers[name] = data.address - begin, kind, valid
    fixed, at = [], 0
    for first, kind, _ in sorted(numbers.values(), key=lambda number: number[0]):
        fixed.append((at, payload[at:first]))
        at = first + rows * kind.itemsize
    return Layout(len(payload), rows, (*fixed, (at, payload[at:])), numbers)
