"""Readings as columns: the same result as one reading after the other, in decoding and in alignment."""

from __future__ import annotations

import json
import math
import random
from collections import Counter
from typing import Any

import cbor2
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import ipc

from service.ingest.align import Aligner, Clock, ReadingOutcome, Tick, rules
from service.ingest.decode import Wire
from service.ingest.queues import Sample
from service.ingest.reading import NO_SEQ, Findings, Known, Reading, Readings, judge
from tests.service.ticks import listed, plain

T0 = 1_795_212_000.0
METERS = tuple("abcdefghij")
ALL = (*METERS, None)
KNOWN = Known(METERS, 230.94, 10_000.0)
WIRE = Wire({"village": KNOWN})
BATCH = "gridsec/village/concentrator/k1/readings"


# --- decoding ------------------------------------------------------------------------------------------

NUMBER = st.one_of(
    st.none(),
    st.floats(),
    st.floats(0.0, 300.0),
    st.sampled_from([T0, T0 + 0.5, 230.0, -1.0, 0.0, 2309.4, 2309.5, 1e4, 1e4 + 1, 10**30]),
)
ROW = st.fixed_dictionaries(
    {
        "meter": st.sampled_from([*METERS, "z", None]),
        "t": st.sampled_from([T0, 1e8, 1e10, 0.0, None, math.inf]),
    },
    optional={"v_volt": NUMBER, "p_kw": NUMBER, "q_kvar": NUMBER, "t_power": NUMBER}
    | {"seq": st.sampled_from([None, 0, 17, -1, 2**63 - 1, 2**63, 10**30])},
)


def judged(row: dict[str, Any]) -> tuple[Any, ...] | tuple[str, ...]:
    """The reading in a row, or all its problems, by the function for single values."""
    found = judge(row, KNOWN, in_batch=True)
    if isinstance(found, Findings):
        return found.problems
    return found.meter, found.t, found.v_volt, found.p_kw, found.q_kvar, found.seq, found.t_power


def decoded(payload: bytes, encoding: str) -> list[tuple[Any, ...]]:
    """The readings of a payload in the form of `judged`."""
    found = listed(WIRE.decode(BATCH, payload, encoding), KNOWN)
    return [
        tuple(
            None if isinstance(v, float) and math.isnan(v) else v
            for v in (r.meter, r.t, r.v_volt, r.p_kw, r.q_kvar, r.seq, r.t_power)
        )
        for r in found.readings
    ]


@given(st.lists(ROW, min_size=1, max_size=12))
def test_columns_are_validated_as_single_readings(rows: list[dict[str, Any]]) -> None:
    """CBOR takes any number; each row is good or bad exactly as alone, and every bad one is counted."""
    names = ("meter", "t", "v_volt", "p_kw", "q_kvar", "seq", "t_power")
    full = [{name: row.get(name) for name in names} for row in rows]
    good = [judged(row) for row in full if not isinstance(judge(row, KNOWN, in_batch=True), Findings)]
    columns = {name: [row[name] for row in full] for name in names}
    assert decoded(cbor2.dumps(columns), "application/cbor") == good
    found = WIRE.decode(BATCH, cbor2.dumps(columns), "application/cbor")
    assert sum(bad.count for bad in found.bad) == len(rows) - len(good)
    finite = all(not isinstance(v, float) or math.isfinite(v) for row in full for v in row.values())
    if finite:
        assert decoded(json.dumps(full).encode(), "") == good


ARROW = "application/vnd.apache.arrow.stream"


def arrow_of(rows: list[dict[str, Any]], chunk: int) -> tuple[bytes, list[dict[str, Any]]]:
    """Rows as a payload of record batches of `chunk` rows, and in the types of its columns."""

    def number(value: Any) -> float | None:
        return None if value is None else float(value)

    def count(value: int | None) -> int | None:
        return value if value is None or -(2**63) <= value < 2**63 else None

    names = ("t", "v_volt", "p_kw", "q_kvar", "t_power")
    full = [
        {"meter": row["meter"], "seq": count(row.get("seq"))}
        | {name: number(row.get(name)) for name in names}
        for row in rows
    ]
    table = pa.table(
        {
            "meter": pa.array([row["meter"] for row in full], pa.string()),
            "seq": pa.array([row["seq"] for row in full], pa.int64()),
            **{name: pa.array([row[name] for row in full], pa.float64()) for name in names},
        }
    )
    sink = pa.BufferOutputStream()
    with ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table, max_chunksize=chunk)
    return sink.getvalue().to_pybytes(), full


@given(st.lists(ROW, min_size=1, max_size=12))
def test_arrow_columns_are_validated_as_single_readings(rows: list[dict[str, Any]]) -> None:
    payload, full = arrow_of(rows, 5)
    good = [judged(row) for row in full if not isinstance(judge(row, KNOWN, in_batch=True), Findings)]
    assert decoded(payload, ARROW) == good


PLAIN = st.fixed_dictionaries(
    {
        "t": st.sampled_from([T0, T0 + 1.0, T0 + 2.0, 0.0]),
        "v_volt": st.sampled_from([230.0, 231.5, 2309.5, math.nan]),
        "p_kw": st.sampled_from([1.0, -2.0, 1e5, math.nan, None]),
        "seq": st.sampled_from([3, 4, -1, None]),
    }
)


@given(st.lists(st.lists(PLAIN, min_size=3, max_size=4), min_size=2, max_size=6), st.booleans())
def test_a_repeated_layout_changes_no_result(rounds: list[list[dict[str, Any]]], other: bool) -> None:
    """Payloads that differ in numbers, nulls, lengths or meters are each decoded as by a new decoder."""
    lasting = Wire({"village": Known(METERS, 230.94, 10_000.0)})
    for number, rows in enumerate(rounds):
        names = "cabz" if other and number % 2 else "cabd"
        payload, _ = arrow_of([{"meter": name, **row} for name, row in zip(names, rows, strict=False)], 5)
        new = Wire({"village": Known(METERS, 230.94, 10_000.0)})
        found, expected = (one.decode(BATCH, payload, ARROW, arrival=T0 + number) for one in (lasting, new))
        assert found.bad == expected.bad
        assert (found.readings is None) == (expected.readings is None)
        if found.readings is not None and expected.readings is not None:
            for name in ("source", "values", "seq", "arrival"):
                each = (getattr(one.readings, name) for one in (found, expected))
                np.testing.assert_array_equal(*each, strict=True)


def test_the_layout_of_a_payload_reads_other_numbers() -> None:
    known = Known(METERS, 230.94, 10_000.0)
    rows = [{"meter": name, "t": T0, "v_volt": 230.0 + k, "seq": k} for k, name in enumerate("cab")]
    payload, _ = arrow_of(rows, 5)
    later, _ = arrow_of([row | {"v_volt": 240.0, "t": T0 + 1.0} for row in rows], 5)
    renamed, _ = arrow_of([row | {"meter": name} for row, name in zip(rows, "abc", strict=True)], 5)
    with_null, _ = arrow_of([rows[0], rows[1] | {"seq": None}, rows[2]], 5)
    Wire({"village": known}).decode(BATCH, payload, ARROW)
    ((layout, source),) = known.layouts.values()
    assert source.tolist() == [2, 0, 1]
    columns = layout.columns(later)
    assert columns is not None
    assert columns["v_volt"].values.tolist() == [240.0, 240.0, 240.0]
    assert columns["seq"].values.tolist() == [0, 1, 2]
    assert [layout.columns(one) for one in (renamed, with_null, later[:-8], later + b"\0")] == [None] * 4


@given(st.lists(st.tuples(st.sampled_from(ALL), ROW), min_size=1, max_size=12))
def test_gathered_single_readings_are_those_of_each_payload(
    rows: list[tuple[str | None, dict[str, Any]]],
) -> None:
    samples = []
    for number, (meter, row) in enumerate(rows):
        place = "substation" if meter is None else f"meter/{meter}"
        payload = json.dumps({name: value for name, value in row.items() if name != "meter"}).encode()
        samples.append(Sample(f"gridsec/village/{place}/reading", payload, "", T0 + number, len(payload)))
    gathered = WIRE.gather(samples)
    alone = [(one, WIRE.decode(one.key, one.payload, arrival=one.arrival)) for one in samples]
    good = [found.readings for _, found in alone if found.readings is not None]
    columns = gathered.readings.get("village")
    assert (columns is None) == (not good)
    if columns is not None:
        assert columns.source.tolist() == [int(one.source[0]) for one in good]
        assert columns.arrival.tolist() == [float(one.arrival[0]) for one in good]
        np.testing.assert_array_equal(columns.values, np.concatenate([one.values for one in good], axis=1))
        assert columns.seq.tolist() == [int(one.seq[0]) for one in good]
    bad = [(repr(problem), sample) for sample, found in alone for problem in found.bad]
    assert sorted((repr(problem), sample) for problem, sample in gathered.bad) == sorted(bad)


# --- alignment -----------------------------------------------------------------------------------------


def columns_of(rows: list[tuple[float, Reading]]) -> Readings:
    """Readings with their arrivals as columns."""
    index = {meter: k for k, meter in enumerate(ALL)}
    phases = np.full((3, len(rows)), np.nan)
    for k, (_, one) in enumerate(rows):
        if one.v_phases is not None:
            phases[:, k] = one.v_phases
    return Readings(
        "village",
        np.array([index[one.meter] for _, one in rows], dtype=np.intp),
        np.array([[one.t, one.v_volt, one.p_kw, one.q_kvar, one.t_power] for _, one in rows]).T,
        np.array([NO_SEQ if one.seq is None else one.seq for _, one in rows]),
        np.array([arrival for arrival, _ in rows]),
        None if np.isnan(phases).all() else phases,
    )


def arrivals(r: random.Random, tick_s: float) -> list[list[tuple[float, Reading]]]:
    """Rounds: scans in order, late and doubled ones, backlogs, leaps and chaos."""
    rounds, k, seq = [], int(T0 / tick_s), 0
    for _ in range(40):
        k += r.choice([1, 1, 1, 1, 1, 2, 6]) if r.random() < 0.97 else r.choice([-20, 100, 4000])
        base, rows = k * tick_s, list[tuple[float, Reading]]()
        kind = r.choice(["scan", "scan", "late", "twice", "backlog", "chaos"])
        scans = range(r.randint(2, 8)) if kind == "backlog" else range(1)
        order = ALL if r.random() < 0.5 else r.sample(ALL, r.randint(9, len(ALL)))
        for back in reversed(scans):
            for meter in order:
                seq += r.choice([1, 1, 3])
                t = (
                    base
                    - back * tick_s
                    - (0.95 * tick_s if kind == "late" else 0.0)
                    + r.gauss(0.0, 0.02 * tick_s)
                )
                if kind == "chaos":
                    t += r.choice([0.0, -tick_s, tick_s, -4.0 * tick_s, 1e5, 20.0 * tick_s * r.random()])
                phases = (230.0, 231.0, r.random()) if meter is None and r.random() < 0.5 else None
                one = Reading("village", meter, t, r.random(), seq=r.choice([None, seq]), v_phases=phases)
                rows += [(base + r.choice([0.05, 0.3]) * tick_s, one)] * (2 if kind == "twice" else 1)
        rounds.append(sorted(rows, key=lambda row: row[0]) if r.random() < 0.9 else rows)
    return rounds


@pytest.mark.canary("0-events", "2-wall", "3-events", "5-wall")
@pytest.mark.parametrize("clock", list(Clock))
@pytest.mark.parametrize("seed", range(6))
def test_columns_align_as_one_reading_after_the_other(clock: Clock, seed: int) -> None:
    r = random.Random(seed)
    tick_s = r.choice([0.5, 1.0, 900.0])
    times = rules(
        tick_s, 5.0 * tick_s, clock=clock, live=bool(seed % 2), grace_s=r.choice([None, 2.0 * tick_s])
    )
    one, many = Aligner(METERS, times), Aligner(METERS, times)
    ticks: tuple[list[Tick], list[Tick]] = ([], [])
    for rows in arrivals(r, tick_s):
        outcomes = []
        for arrival, reading in rows:
            outcome, found = one.take(reading, arrival)
            outcomes.append(outcome)
            ticks[0].extend(found)
        placed = many.take_all(columns_of(rows))
        ticks[1].extend(placed.ticks)
        assert placed.counts == Counter(outcomes)
        assert placed.clock_off == tuple(k for k, o in enumerate(outcomes) if o is ReadingOutcome.CLOCK_OFF)
        later = rows[-1][0] + r.random() * tick_s
        ticks[0].extend(one.due(later))
        ticks[1].extend(many.due(later))
        assert (one.wake(), one.lost, one.restarts) == (many.wake(), many.lost, many.restarts)
    assert plain(ticks[0]) == plain(ticks[1])
    assert len(ticks[0]) > 40
    assert {ReadingOutcome.ACCEPTED, ReadingOutcome.DUPLICATE} <= {o for o, n in many.counts.items() if n}
