"""Every payload becomes readings or bad readings with a reason; nothing raises."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import cbor2
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import ipc

from service.ingest.decode import DETAILED_PER_REASON, Wire
from service.ingest.reading import BadReason, Known, Reading
from tests.service.ticks import Listed, listed

T = 1_795_212_000.25
KNOWN = {"village": Known(("a", "b", "c"), 230.94, 10_000.0)}
WIRE = Wire(KNOWN)
METER = "gridsec/village/meter/a/reading"
BUSBAR = "gridsec/village/substation/reading"
BATCH = "gridsec/village/concentrator/k1/readings"
STREAM, FILE = "application/vnd.apache.arrow.stream", "application/vnd.apache.arrow.file"


def decode(payload: bytes | object, key: str = METER, encoding: str = "application/json") -> Listed:
    data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    return listed(WIRE.decode(key, data, encoding), KNOWN["village"])


def only_bad(decoded: Listed) -> tuple[BadReason, tuple[str, ...]]:
    assert not decoded.readings
    (bad,) = decoded.bad
    return bad.reason, bad.problems


def good(**changes: Any) -> dict[str, Any]:
    return {"t": T, "seq": 17, "v_volt": 231.4, "p_kw": 0.8, "q_kvar": 0.1} | changes


def test_the_reading_of_the_documentation() -> None:
    payload = b'{"t": 1795212000.25, "seq": 17, "v_volt": 231.4, "p_kw": 0.8, "q_kvar": 0.1}'
    (found,) = decode(payload).readings
    assert repr(found) == repr(Reading("village", "a", 1795212000.25, 231.4, 0.8, 0.1, 17))


@pytest.mark.parametrize(
    "encoding", ["", "zenoh/bytes", "zenoh/string", "application/json", "application/json;v1"]
)
def test_json_is_read_with_and_without_its_encoding(encoding: str) -> None:
    assert decode(good(), encoding=encoding).readings[0].v_volt == 231.4


def test_powers_and_number_are_optional_and_unknown_fields_are_ignored() -> None:
    (reading,) = decode({"t": int(T), "v_volt": 230, "colour": ["red"], "meter": 5}).readings
    assert (reading.t, reading.v_volt, reading.seq) == (1_795_212_000.0, 230.0, None)
    assert math.isnan(reading.p_kw)
    assert math.isnan(reading.q_kvar)
    assert decode(good(p_kw=None, q_kvar=None, seq=None)).readings


def test_powers_may_have_a_time_of_their_own() -> None:
    """In every format; without one they are of the moment of the voltage."""
    (reading,) = decode(good(t_power=T - 60.0)).readings
    assert reading.t_power == T - 60.0
    assert math.isnan(decode(good()).readings[0].t_power)
    for payload, encoding in (
        (cbor2.dumps(columns() | {"t_power": [T - 5.0, None]}), "application/cbor"),
        (arrow(columns() | {"t_power": [T - 5.0, None]}), STREAM),
    ):
        first, second = decode(payload, BATCH, encoding).readings
        assert first.t_power == T - 5.0
        assert math.isnan(second.t_power)
    for wrong, reason in ((12.0, BadReason.VALUE), ("now", BadReason.TYPE), (1e13, BadReason.VALUE)):
        found, problems = only_bad(decode(good(t_power=wrong)))
        assert found is reason
        assert "t_power" in problems[0]


def test_the_busbar_has_no_meter_id() -> None:
    assert decode({"t": T, "v_volt": 233.0}, BUSBAR).readings[0].meter is None


@pytest.mark.parametrize(
    ("payload", "reason", "words"),
    [
        (b"", BadReason.EMPTY, ["empty"]),
        (b"{}", BadReason.EMPTY, ["empty"]),
        (b"[]", BadReason.EMPTY, ["empty"]),
        (b"{", BadReason.SYNTAX, ["not JSON"]),
        (b"\xff\xfe\x00", BadReason.SYNTAX, ["not JSON"]),
        (b"[" * 100_000, BadReason.SYNTAX, ["not JSON"]),
        (b"1" * 5_000, BadReason.SYNTAX, ["not JSON"]),
        (b"231.4", BadReason.TYPE, ["object", "number"]),
        (b'[{"t": 1}]', BadReason.TYPE, ["object", "array"]),
        (b'{"t": 1795212000, "v_volt": NaN}', BadReason.VALUE, ["v_volt", "nan"]),
        (b'{"t": 1795212000, "v_volt": 1e999}', BadReason.VALUE, ["v_volt", "inf"]),
        (b'{"t": -Infinity, "v_volt": 230}', BadReason.VALUE, ["t = -inf"]),
    ],
)
def test_malformed_payloads(payload: bytes, reason: BadReason, words: list[str]) -> None:
    found, problems = only_bad(decode(payload))
    assert found is reason
    for word in words:
        assert word in problems[0]


@pytest.mark.parametrize(
    ("changes", "reason", "word"),
    [
        ({"v_volt": "231.4"}, BadReason.TYPE, "v_volt is a string"),
        ({"v_volt": True}, BadReason.TYPE, "v_volt is a boolean"),
        ({"v_volt": None}, BadReason.TYPE, "v_volt is null"),
        ({"v_volt": [231.4]}, BadReason.TYPE, "v_volt is an array"),
        ({"v_volt": 0.0}, BadReason.VALUE, "implausible"),
        ({"v_volt": -231.4}, BadReason.VALUE, "implausible"),
        ({"v_volt": 2_400.0}, BadReason.VALUE, "implausible"),
        ({"t": "2026-11-20T23:00:00Z"}, BadReason.TYPE, "t is a string"),
        ({"t": T * 1000}, BadReason.VALUE, "not a Unix time in seconds"),
        ({"t": 0}, BadReason.VALUE, "not a Unix time in seconds"),
        ({"p_kw": 2e4}, BadReason.VALUE, "p_kw = 20000 is implausible"),
        ({"q_kvar": {}}, BadReason.TYPE, "q_kvar is an object"),
        ({"seq": 1.5}, BadReason.TYPE, "seq is a number, not an integer"),
        ({"seq": -1}, BadReason.VALUE, "seq is outside"),
        ({"seq": 2**64}, BadReason.VALUE, "seq is outside"),
    ],
)
def test_wrong_types_and_absurd_values(changes: dict[str, Any], reason: BadReason, word: str) -> None:
    found, problems = only_bad(decode(good(**changes)))
    assert found is reason
    assert word in problems[0]


def test_ten_times_nominal_is_still_a_reading() -> None:
    assert decode(good(v_volt=2_309.4)).readings


def test_every_problem_is_named_at_once() -> None:
    reason, problems = only_bad(decode({"v_volt": -1, "p_kw": "much", "q_kvar": 1e9, "seq": "x"}))
    assert reason is BadReason.TYPE
    assert len(problems) == 5
    for name in ("t is missing", "v_volt", "p_kw", "q_kvar", "seq"):
        assert any(name in problem for problem in problems), name


def test_one_megabyte_is_refused_whole_or_cut() -> None:
    payload = json.dumps(good(padding="x" * (1 << 20))).encode()
    for decoded in (decode(payload), WIRE.decode(METER, payload[:1000], "", size=len(payload))):
        reason, problems = only_bad(decoded)
        assert reason is BadReason.OVERSIZE
        assert str(len(payload)) in problems[0]
        assert len(decoded.bad[0].head) <= 200


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("gridsec/village/meter/*/reading", BadReason.KEY),
        ("gridsec/village/meter/a$*/reading", BadReason.KEY),
        ("gridsec/**/reading", BadReason.KEY),
        ("gridsec/village/meters/a/reading", BadReason.KEY),
        ("gridsec/village/meter/reading", BadReason.KEY),
        ("other/gridsec/village/meter/a/reading", BadReason.KEY),
        ("gridsec/town/meter/a/reading", BadReason.UNKNOWN_FEEDER),
        ("gridsec/village/meter/z/reading", BadReason.UNKNOWN_METER),
    ],
)
def test_keys_that_name_nothing(key: str, reason: BadReason) -> None:
    decoded = decode(good(), key)
    assert only_bad(decoded)[0] is reason
    assert decoded.bad[0].meter is None
    assert decoded.bad[0].feeder == ("village" if reason is BadReason.UNKNOWN_METER else None)


def test_other_encodings_are_refused_by_name() -> None:
    reason, problems = only_bad(decode(good(), encoding="application/protobuf"))
    assert reason is BadReason.ENCODING
    assert "application/protobuf" in problems[0]
    assert only_bad(decode(cbor2.dumps(good()), encoding="application/cbor"))[0] is BadReason.ENCODING


def test_another_prefix() -> None:
    wire = Wire(KNOWN, prefix="utility/north")
    assert wire.decode("utility/north/village/meter/a/reading", json.dumps(good()).encode()).readings
    assert wire.decode(METER, json.dumps(good()).encode()).bad[0].reason is BadReason.KEY


# --- concentrators ---------------------------------------------------------------------------------


def columns() -> dict[str, list[Any]]:
    return {"meter": ["a", "b"], "t": [T, T], "v_volt": [231.4, 229.0], "p_kw": [0.8, None], "seq": [1, 2]}


EXPECTED = (
    ("a", T, 231.4, 0.8, 1),
    ("b", T, 229.0, None, 2),
)


def arrow(table: dict[str, Any] | pa.Table, *, file: bool = False, compression: str | None = None) -> bytes:
    table = table if isinstance(table, pa.Table) else pa.table(table)
    sink = pa.BufferOutputStream()
    make = ipc.new_file if file else ipc.new_stream
    with make(sink, table.schema, options=ipc.IpcWriteOptions(compression=compression)) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue().to_pybytes())


def rows() -> list[dict[str, Any]]:
    return [dict(zip(columns(), row, strict=True)) for row in zip(*columns().values(), strict=True)]


@pytest.mark.parametrize(
    ("payload", "encoding"),
    [
        (json.dumps(rows()).encode(), "application/json"),
        (cbor2.dumps(columns()), "application/cbor"),
        (arrow(columns()), STREAM),
        (arrow(columns(), file=True), FILE),
        (arrow(columns() | {"note": ["x", "y"]}), STREAM + ";v1"),
    ],
)
def test_the_same_batch_in_every_format(payload: bytes, encoding: str) -> None:
    decoded = decode(payload, BATCH, encoding)
    assert not decoded.bad
    found = [
        (r.meter, r.t, r.v_volt, None if math.isnan(r.p_kw) else r.p_kw, r.seq) for r in decoded.readings
    ]
    assert tuple(found) == EXPECTED
    assert {r.feeder for r in decoded.readings} == {"village"}


def test_a_bad_element_does_not_spoil_the_good_ones() -> None:
    batch = [*rows(), good(), good(meter="z"), good(meter="c", v_volt=None), 7, good(meter="c")]
    decoded = decode(batch, BATCH)
    assert [r.meter for r in decoded.readings] == ["a", "b", "c"]
    assert [(b.reason, b.meter) for b in decoded.bad] == [
        (BadReason.TYPE, None),
        (BadReason.TYPE, "c"),
        (BadReason.TYPE, None),
        (BadReason.UNKNOWN_METER, None),
    ]
    assert "element 4" in decoded.bad[1].problems[0]
    assert "element 3" in decoded.bad[3].problems[0]


def test_a_flood_of_bad_elements_is_condensed_and_counted() -> None:
    decoded = decode([good(meter="z")] * 500, BATCH)
    assert len(decoded.bad) == DETAILED_PER_REASON + 1
    assert sum(b.count for b in decoded.bad) == 500


@pytest.mark.parametrize(
    ("payload", "encoding", "reason"),
    [
        (b"[]", "", BadReason.EMPTY),
        (b'{"t": 1}', "", BadReason.TYPE),
        (b"[", "", BadReason.SYNTAX),
        (cbor2.dumps({"meter": [], "t": [], "v_volt": []}), "application/cbor", BadReason.EMPTY),
        (cbor2.dumps({"meter": ["a"], "t": [T]}), "application/cbor", BadReason.TYPE),
        (cbor2.dumps({"meter": ["a"], "t": T, "v_volt": [230.0]}), "application/cbor", BadReason.TYPE),
        (cbor2.dumps({"meter": ["a"], "t": [T, T], "v_volt": [230.0]}), "application/cbor", BadReason.TYPE),
        (cbor2.dumps([1, 2]), "application/cbor", BadReason.TYPE),
        (b"\x9b" + b"\xff" * 8, "application/cbor", BadReason.SYNTAX),
        (b"\x81" * 10_000, "application/cbor", BadReason.SYNTAX),
        (b"junk", STREAM, BadReason.SYNTAX),
        (b"junk", FILE, BadReason.SYNTAX),
        (arrow(columns())[:-20], STREAM, BadReason.SYNTAX),
        (arrow(columns(), compression="zstd"), STREAM, BadReason.TYPE),
        (arrow(columns(), compression="lz4", file=True), FILE, BadReason.TYPE),
        (arrow({"meter": [1], "t": ["x"], "v_volt": [True]}), STREAM, BadReason.TYPE),
        (arrow({"meter": pa.array(["a"]).dictionary_encode(), "t": [T]}), STREAM, BadReason.TYPE),
        (arrow({"x": pa.nulls(10**9)}), STREAM, BadReason.TYPE),
    ],
)
def test_malformed_batches(payload: bytes, encoding: str, reason: BadReason) -> None:
    assert only_bad(decode(payload, BATCH, encoding))[0] is reason


def test_cbor_that_unfolds_to_more_than_memory_holds_is_a_bad_reading() -> None:
    """Twelve arrays, each of ten references to the one before: 460 bytes that stand for 10^13 numbers."""
    references = range(13)
    text = [b"\xd8\x1c\x8a" + b"\x01" * 10]
    text += [b"\xd8\x1c\x8a" + (b"\xd8\x1d" + bytes([number])) * 10 for number in references[:-1]]
    payload = b"".join(
        [
            b"\xa5\x61x\x8d",
            *text,
            b"\x65meter\x81\x61a\x61t\x81",
            cbor2.dumps(T),
            b"\x66v_volt\x81",
            cbor2.dumps(230.0),
            b"\x64p_kw\x81\xd8\x1d" + bytes([references[-1]]),
        ]
    )
    assert len(payload) < 500
    decoded = decode(payload, BATCH, "application/cbor")
    assert only_bad(decoded) == (BadReason.TYPE, ("element 0: p_kw is an array, not a number",))
    assert len(decoded.bad[0].head) <= 200


def test_cbor_numbers_of_other_kinds_are_no_numbers() -> None:
    payload = cbor2.dumps(
        {"meter": ["a", "b"], "t": [T, T], "v_volt": [10**5_000, "x"], "seq": [10**5_000, 1]}
    )
    decoded = decode(payload, BATCH, "application/cbor")
    assert [b.reason for b in decoded.bad] == [BadReason.VALUE, BadReason.TYPE]


def test_nan_in_columns() -> None:
    decoded = decode(arrow({"meter": ["a", "b"], "t": [T, T], "v_volt": [math.nan, 230.0]}), BATCH, STREAM)
    assert [r.meter for r in decoded.readings] == ["b"]
    assert decoded.bad[0].reason is BadReason.VALUE


# --- whatever comes ---------------------------------------------------------------------------------

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)
FIELDS = st.sampled_from(["t", "v_volt", "p_kw", "q_kvar", "seq", "meter", "t_power", "x"])


def sound(decoded: Listed) -> None:
    assert decoded.readings or decoded.bad
    for reading in decoded.readings:
        assert reading.meter in {"a", "b", "c"}
        assert math.isfinite(reading.t)
        assert 0.0 < reading.v_volt <= 2_309.4
    for bad in decoded.bad:
        assert bad.problems
        assert len(bad.head) <= 4 * 200
        for text in (bad.head, bad.key, *bad.problems):
            assert text.isprintable()
            text.encode()


@given(st.binary(max_size=300), st.sampled_from(["", "application/cbor", STREAM, FILE, "?"]), st.booleans())
def test_any_bytes(payload: bytes, encoding: str, single: bool) -> None:
    sound(decode(payload, METER if single else BATCH, encoding))


@given(st.text(max_size=300), st.sampled_from([b"", b"{", b'[{"t": "x"}]', b"x" * 300_000]), st.booleans())
def test_any_key_is_kept_printable(name: str, payload: bytes, odd: bool) -> None:
    """zenoh's keys may hold any character, NUL too, which not every database can keep."""
    chunk = name.replace("/", "") + "\0" * odd
    key = f"gridsec/village/concentrator/{chunk}/readings"
    decoded = decode(payload, key)
    sound(decoded)
    assert all(len(bad.key) <= 10 * 200 for bad in decoded.bad)
    sound(decode(payload, key.replace("village", chunk), chunk))


@given(st.dictionaries(FIELDS, VALUES, max_size=7), st.booleans())
def test_any_fields(fields: dict[str, Any], base: bool) -> None:
    value = good(meter="b") | fields if base else fields
    sound(decode(json.dumps(value).encode()))
    sound(decode(json.dumps([value]).encode(), BATCH))
    sound(decode(cbor2.dumps({name: [v] for name, v in value.items()}), BATCH, "application/cbor"))


@given(
    st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=6), st.booleans()
)
def test_damaged_arrow(changes: list[tuple[int, int]], file: bool) -> None:
    payload = bytearray(arrow(columns(), file=file))
    for position, byte in changes:
        payload[position % len(payload)] = byte
    sound_or_garbled = decode(bytes(payload), BATCH, FILE if file else STREAM)
    assert sound_or_garbled.readings or sound_or_garbled.bad


def test_arrow_of_wide_types() -> None:
    table = pa.table(
        {
            "meter": pa.array(["a"], pa.large_string()),
            "t": np.array([T]),
            "v_volt": np.array([230.0], np.float32),
            "p_kw": np.array([1], np.int8),
        }
    )
    (reading,) = decode(arrow(table), BATCH, STREAM).readings
    assert reading.v_volt == struct.unpack("f", struct.pack("f", 230.0))[0]
    assert reading.p_kw == 1.0
