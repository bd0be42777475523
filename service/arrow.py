"""Columns out of an Arrow IPC payload that nobody vouches for.

Arrow is made to be trusted: a small payload can unfold into a huge table (compressed buffers, null or
dictionary columns), and unchecked offsets reach outside of the buffers. So only plain columns are read, only
uncompressed, only after full validation.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import pyarrow as pa
from pyarrow import ipc

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
    """A payload is not read.

    Parameters
    ----------
    problems
        Why, one sentence each.
    well_formed
        Whether it is Arrow IPC at all.
    """

    def __init__(self, problems: Iterable[str], *, well_formed: bool) -> None:
        self.problems = tuple(problems)
        self.well_formed = well_formed
        super().__init__("; ".join(self.problems))


def columns_of(payload: bytes, is_file: bool, names: tuple[str, ...]) -> dict[str, list[Any]]:
    """Return the named columns of an Arrow IPC stream or file as Python lists, nulls as None.

    Parameters
    ----------
    payload
        The bytes.
    is_file
        File format (with a footer) instead of the stream format.
    names
        The columns that are wanted; others are ignored, absent ones are left out.

    Raises
    ------
    ArrowProblem
        If the payload is not Arrow IPC, is compressed, or a wanted column is not a plain column of
        strings (`meter`), integers (`seq`) or numbers (all others).
    """
    try:
        reader = _open(payload, is_file)
        _check_columns(reader.schema, names)
        columns: dict[str, list[Any]] = {name: [] for name in names if name in reader.schema.names}
        for batch in _batches(reader, limit=len(payload)):
            batch.validate(full=True)
            for name, column in columns.items():
                column.extend(batch.column(name).to_pylist())
    except ArrowProblem:
        raise
    except _UNREADABLE as error:
        detail = str(error).partition("\n")[0] or type(error).__name__
        raise ArrowProblem([f"no Arrow IPC: {detail}"], well_formed=False) from error
    return columns


def _open(payload: bytes, is_file: bool) -> Any:
    if is_file:
        # The file format wraps the messages of a stream between two magic words, so that the same check
        # for compression runs over them; the footer is not needed to read a file from front to back.
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
            raise ArrowProblem(["compressed Arrow IPC is not read; write it uncompressed"], well_formed=True)
        if message.type == "dictionary":
            raise ArrowProblem(["dictionary columns are not read; write plain strings"], well_formed=True)


def _is_compressed(metadata: bytes) -> bool:
    """Tell whether a record batch's flatbuffer header has its `compression` field set."""
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
        # A row costs at least one byte somewhere, or else its length is a lie (a column without buffers).
        if rows > limit:
            raise ArrowProblem([f"more than {limit} rows in {limit} bytes"], well_formed=True)
        yield batch
