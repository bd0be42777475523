"""What meters, operators and strangers do to a service: it says what is wrong and goes on judging."""

from __future__ import annotations

import json
import math
import socket
import sqlite3
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypedDict

import cbor2
import numpy as np
import pyarrow as pa
import pytest
import zenoh
from pyarrow import ipc

from feeders.format.tables import write
from feeders.model.site import Site, from_tables, load
from feeders.simulation.scenario import START, Scenario, SimulatedReading, simulate
from gridsec.attack import Attack, Bias
from tests.acceptance.live import Fleet, Live, serve
from tests.service.running import free_port

BUSBAR = ""
FEEDER = "simbench-lv-rural1"
SILENCE_S = 10.0
STARTED_S = 4.0  # the transient of the observer is small beside the error at which a reading stands out


@dataclass(frozen=True)
class Sample:
    """What is reported at one tick; the busbar's meter is the empty string."""

    t: float
    readings: tuple[SimulatedReading, ...]


def sampled(site: Site, seconds: float, dt_s: float = 1.0, attacks: tuple[Attack, ...] = ()) -> list[Sample]:
    scenario = Scenario(seed=7, duration_s=seconds, dt_s=dt_s, attacks=attacks)
    return [Sample(sample.t, tuple(sample.readings)) for sample in simulate(site, scenario)]


def lie(meter: int, t_on: float, t_off: float, size: float) -> Attack:
    return Bias(meters=np.array([meter]), t_on=t_on, t_off=t_off, size=np.array([size]))


def without(sample: Sample, *meters: str) -> Sample:
    return replace(sample, readings=tuple(r for r in sample.readings if r.meter not in meters))


def verdicts(fleet: Fleet, samples: Iterable[Sample]) -> list[tuple[float, str, dict[str, Any]]]:
    return [(sample.t - START, state["verdict"], state) for sample, state in fleet.play(samples)]


def kinds(live: Live) -> list[tuple[str, str | None, str]]:
    return sorted((a["kind"], a["meter"], a["state"]) for a in live.alarms())


def until(condition: Callable[[], Any], patience_s: float = 15.0) -> Any:
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError("it did not happen")


# --------------------------------------------------------------------------- silence


@pytest.mark.acceptance
def test_a_meter_that_falls_silent_is_data_loss_and_never_clean(tmp_path: Path) -> None:
    samples = sampled(load(FEEDER), 60)
    samples[20:45] = [without(s, "m05") for s in samples[20:45]]
    samples[10] = without(samples[10], "m07")  # A single reading that gets lost is no event.
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        for state in fleet.pour(samples):
            t = state["t"] - START
            unseen = [m["meter"] for m in state["meters"] if not m["seen"]]
            expected = "undecided" if unseen or t < STARTED_S else "clean"
            assert state["verdict"] == expected, (t, state["reason"])
            assert unseen == (["m05"] if 22 <= t < 45 else []), t
            silent = [s["meter"] for s in state["silent"]]
            assert silent == (["m05"] if 19 + SILENCE_S < t < 45 else []), t
        (alarm,) = until(lambda: [a for a in live.alarms() if a["state"] == "cleared"])
    assert (alarm["kind"], alarm["meter"]) == ("data-loss", "m05")
    assert 30 <= alarm["t_raised"] - START <= 19 + SILENCE_S + 4


@pytest.mark.canary("modal")
@pytest.mark.parametrize("estimator", ["modal", "exact-bank"])
def test_a_silent_busbar_is_data_loss(estimator: str, tmp_path: Path) -> None:
    """The bank cannot judge without it; the other monitors estimate it along with everything else."""
    samples = sampled(load(FEEDER), 60)
    samples[20:45] = [without(s, BUSBAR) for s in samples[20:45]]
    with serve(FEEDER, tmp_path, "--estimator", estimator) as live, Fleet(live) as fleet:
        for state in fleet.pour(samples):
            t = state["t"] - START
            assert not any(meter["suspect"] for meter in state["meters"])
            if 22 <= t < 45 and estimator == "exact-bank":
                assert (state["verdict"], state["cause"]) == ("undecided", "no-busbar"), t
            elif not (t < STARTED_S or 45 <= t < 50):  # It settles at the start, and once the busbar is back.
                assert state["verdict"] == "clean", (t, state["reason"])
        (alarm,) = until(lambda: [a for a in live.alarms() if a["state"] == "cleared"])
    assert (alarm["kind"], alarm["meter"]) == ("data-loss", "substation")


class Columns(TypedDict):
    """Readings of many meters at one time, as columns."""

    meter: list[str]
    t: list[float]
    v_volt: list[float]
    p_kw: list[float | None]


def in_batch(fleet: Fleet, sample: Sample, t: float, number: int) -> None:
    """One concentrator brings all meters: JSON, CBOR, Arrow stream, Arrow file in turn."""
    rows = [r for r in sample.readings if r.meter]
    columns = Columns(
        meter=[r.meter for r in rows],
        t=[t] * len(rows),
        v_volt=[r.v_volt for r in rows],
        p_kw=[r.p_kw for r in rows],
    )
    payload, encoding = packed(columns, number % 4)
    key = f"gridsec/{FEEDER}/concentrator/k1/readings"
    fleet.session.put(key, payload, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK)


def packed(columns: Columns, form: int) -> tuple[bytes, str]:
    if form == 0:
        rows = [
            {"meter": m, "t": t, "v_volt": v, "p_kw": p} for m, t, v, p in zip(*columns.values(), strict=True)
        ]
        return json.dumps(rows).encode(), "application/json"
    if form == 1:
        return cbor2.dumps(columns), "application/cbor"
    table, sink = pa.table(columns), pa.BufferOutputStream()
    make, name = ((ipc.new_stream, "stream"), (ipc.new_file, "file"))[form - 2]
    with make(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue().to_pybytes(), f"application/vnd.apache.arrow.{name}"


# A machine that is busy may drop ticks; what is sent goes on meanwhile.
TICKS = 120


@pytest.mark.acceptance
def test_a_concentrator_in_every_format_and_its_silence(tmp_path: Path) -> None:
    """By the wall clock, half a second a tick: nobody needs to talk for time to go on."""
    folder, tables = tmp_path / FEEDER, load(FEEDER).tables
    settings = replace(tables.meta.monitor, tick_s=0.5, on_delay_s=0.5, off_delay_s=0.5, silence_s=2.0)
    tables = replace(tables, meta=replace(tables.meta, monitor=settings))
    write(tables, folder)
    samples = iter(sampled(from_tables(tables), 3 * 0.5 * TICKS, dt_s=0.5))
    meters = {row.meter for row in tables.customers if row.meter}
    with serve(str(folder), tmp_path, clock="wall") as live:
        live.feeder = FEEDER
        with Fleet(live) as fleet:

            def lost(state: str) -> set[str | None]:
                return {meter for kind, meter, now in kinds(live) if (kind, now) == ("data-loss", state)}

            clean: set[int] = set()
            for number, state in by_the_clock(fleet, islice(samples, TICKS), talking=True):
                if state["verdict"] == "clean" and not state["silent"]:
                    clean.add(number % 4)
                if len(clean) == 4:
                    break
            assert clean == set(range(4)), "a format never led to a clean state"
            for number, state in by_the_clock(fleet, islice(samples, TICKS), talking=False):
                # Readings are fresh for a tick or two.
                assert state["verdict"] == "undecided" or number < 4, state["reason"]
                # One alarm of the feeder stands for the silence of all its meters.
                if {s["meter"] for s in state["silent"]} == meters and lost("raised") == {None}:
                    break
            assert lost("raised") == {None}
            for _, state in by_the_clock(fleet, islice(samples, TICKS), talking=True):
                if state["verdict"] == "clean" and not state["silent"] and lost("cleared") == {None}:
                    break
            assert lost("cleared") == {None}
            assert live.get("/api/v1/bad-readings")["readings"] == []
            assert not [a for a in live.alarms() if a["kind"] in ("meter-manipulated", "voltage-limit")]


def by_the_clock(
    fleet: Fleet, samples: Iterable[Sample], *, talking: bool
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Publish a sample every half second, and yield the states of ticks as they are heard, with their number.

    The substation always reports; customers, through their concentrator, only where they are talking.
    """
    sent: dict[float, int] = {}
    t = 0.0
    for number, sample in enumerate(samples):
        t = max(0.5 * math.ceil(2.0 * time.time()), t + 0.5)
        time.sleep(max(0.0, t - time.time()))
        if talking:
            in_batch(fleet, sample, t, number)
        fleet.put(replace(next(r for r in sample.readings if not r.meter), t=t))
        sent[t] = number
        while (heard := fleet.estimates.try_recv()) is not None:
            state = json.loads(heard.payload.to_bytes())
            if state["t"] in sent:
                yield sent[state["t"]], state


# ------------------------------------------------------------------- quarter hours


@pytest.mark.acceptance
def test_readings_of_a_quarter_of_an_hour(tmp_path: Path) -> None:
    """A day of them: a liar is named, a lost reading and a silent meter are never clean."""
    step = 900.0
    folder, tables = tmp_path / FEEDER, load(FEEDER).tables
    settings = replace(tables.meta.monitor, tick_s=step, on_delay_s=0.0, off_delay_s=step, silence_s=2 * step)
    tables = replace(tables, meta=replace(tables.meta, monitor=settings))
    write(tables, folder)
    site = from_tables(tables)
    liar, t_on, t_off = 4, START + 20 * step, START + 40 * step
    samples = sampled(site, 96 * step, dt_s=step, attacks=(lie(liar, t_on, t_off, 0.04),))
    samples[10] = without(samples[10], "m02")
    samples[60:66] = [without(s, "m09") for s in samples[60:66]]
    with serve(str(folder), tmp_path) as live:
        live.feeder = FEEDER
        with Fleet(live) as fleet:
            states = fleet.pour(samples)
        for number, state in enumerate(states):
            unseen = [m["meter"] for m in state["meters"] if not m["seen"]]
            suspects = [m["meter"] for m in state["meters"] if m["suspect"]]
            assert unseen == (["m02"] if number == 10 else ["m09"] if 60 <= number < 66 else [])
            assert state["verdict"] != "clean" or not unseen
            assert set(suspects) <= {site.meter_ids[liar]}
            # A sole fault is named by two readings.
            if t_on <= state["t"] < t_off:
                first = state["t"] < t_on + step
                named = ("undecided", []) if first else ("attacked", [site.meter_ids[liar]])
                assert (state["verdict"], suspects) == named
        assert states[-1]["verdict"] == "clean"
        found = until(lambda: len([a for a in live.alarms() if a["state"] == "cleared"]) == 3 and kinds(live))
    assert found == [
        ("data-loss", "m09", "cleared"),
        ("meter-manipulated", site.meter_ids[liar], "cleared"),
        ("undecided", None, "cleared"),
    ]


# ------------------------------------------------------------------ bad material

GOOD = {"t": START, "v_volt": 230.0}
BAD: tuple[tuple[str, bytes, str], ...] = (
    ("meter/m01/reading", b'{"t": 17', "syntax"),
    ("meter/m01/reading", b"[" * 100_000, "syntax"),
    ("meter/m01/reading", b'{"t": ' + b"9" * 5000 + b', "v_volt": 230}', "syntax"),
    ("meter/m01/reading", b"\xff\xfe\x00", "syntax"),
    ("meter/m01/reading", b"", "empty"),
    ("meter/m01/reading", b"{}", "empty"),
    ("concentrator/k1/readings", b"[]", "empty"),
    ("meter/m01/reading", b"null", "type"),
    ("meter/m01/reading", b'{"t": "noon", "v_volt": [230], "p_kw": true, "seq": 1.5}', "type"),
    ("concentrator/k1/readings", json.dumps([GOOD]).encode(), "type"),
    ("meter/m01/reading", b'{"t": NaN, "v_volt": Infinity}', "value"),
    ("meter/m01/reading", b'{"t": 1795212000, "v_volt": 1e300}', "value"),
    ("meter/m01/reading", b'{"t": 1795212000, "v_volt": -5, "p_kw": 1e12}', "value"),
    ("meter/m01/reading", b'{"t": 1795212000, "v_volt": 230, "seq": ' + b"9" * 40 + b"}", "value"),
    ("meter/m01/reading", json.dumps(GOOD | {"t": START + 1e6}).encode(), "clock-off"),
    ("meter/stranger/reading", json.dumps(GOOD).encode(), "unknown-meter"),
    ("concentrator/k1/readings", json.dumps([GOOD | {"meter": "x"}]).encode(), "unknown-meter"),
    ("meter/m01/reading", b" " * 1_000_000, "oversize"),
    ("meter/*/reading", json.dumps(GOOD).encode(), "key"),
    ("meter/m01/readings", json.dumps(GOOD).encode(), "key"),
    ("../elsewhere/meter/m01/reading", json.dumps(GOOD).encode(), "key"),
)


def _is_newest(live: Live, reason: str) -> bool:
    newest = live.get("/api/v1/bad-readings", limit=2)["readings"]
    return reason in {one["reason"].partition(":")[0] for one in newest}


@pytest.mark.acceptance
def test_every_kind_of_bad_reading_is_named_and_none_stops_the_judging(tmp_path: Path) -> None:
    samples = sampled(load(FEEDER), 10 + len(BAD))
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        verdicts(fleet, samples[:10])
        for sample, (key, payload, reason) in zip(samples[10:], BAD, strict=True):
            fleet.session.put(f"gridsec/{FEEDER}/{key}", payload, encoding="application/json")
            fleet.session.put(f"gridsec/nowhere/{key}", payload, encoding="application/json")
            ((_, state),) = fleet.play([sample])
            assert state["verdict"] == "clean", (key, payload[:50], state["reason"])
            # Estimates are published while the bad readings of their round are being written.
            until(partial(_is_newest, live, reason))
        assert live.http.get("/readyz").status_code == 200
        assert live.alarms() == []


@pytest.mark.acceptance
def test_a_flood_of_bad_keys_costs_no_memory_and_no_labels(tmp_path: Path) -> None:
    samples = sampled(load(FEEDER), 30)
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        verdicts(fleet, samples[:10])
        labels, before = len(live.http.get("/metrics").text.splitlines()), resident_mb(live)
        for number in range(10_000):
            key = f"gridsec/{FEEDER}/meter/stranger-{number}/reading"
            fleet.session.put(key, b"x" * 100, congestion_control=zenoh.CongestionControl.BLOCK)
        assert {verdict for _, verdict, _ in verdicts(fleet, samples[10:])} == {"clean"}
        metrics = live.http.get("/metrics").text
        assert len(metrics.splitlines()) <= labels + 10
        assert f'gridsec_bad_readings_total{{feeder="{FEEDER}",reason="unknown-meter"}} 10000.0' in metrics
        assert "stranger" not in metrics
        assert resident_mb(live) - before < 60


def resident_mb(live: Live) -> float:
    status = Path(f"/proc/{live.process.pid}/status")
    if not status.exists():
        pytest.skip("there is no /proc to see a process's memory in")
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


# ------------------------------------------------------------ ports, database, files


@pytest.mark.acceptance
def test_a_second_service_leaves_the_first_alone(tmp_path: Path) -> None:
    """It wants the same database; messages of all such cases are in tests/service/cli/test_main.py."""
    samples = sampled(load(FEEDER), 25)
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        verdicts(fleet, samples[:10])
        command = [str(Path(sys.executable).parent / "gridsec"), "serve", "--feeder", FEEDER]
        command += ["--http", f"127.0.0.1:{free_port()}", "--zenoh-listen", f"tcp/127.0.0.1:{free_port()}"]
        command += ["--database", f"sqlite:///{tmp_path / 'alarms.db'}"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert ended.returncode != 0
        assert "another process writes it" in " ".join((ended.stdout + ended.stderr).split())
        assert {verdict for _, verdict, _ in verdicts(fleet, samples[10:])} == {"clean"}


@pytest.mark.acceptance
def test_a_locked_and_a_removed_database_do_not_stop_the_judging(tmp_path: Path) -> None:
    """Ticks go on, readiness says what is wrong, and the alarm of that time is stored once it is back."""
    site = load(FEEDER)
    attack = lie(4, START + 15, START + 30, 0.05)
    samples = sampled(site, 60, attacks=(attack,))
    path = tmp_path / "alarms.db"
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        verdicts(fleet, samples[:10])
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        assert verdicts(fleet, samples[10:25])[-1][1] == "attacked"
        answer = until(lambda: (a := live.http.get("/readyz")).status_code == 503 and a)
        assert "locked" in answer.json()["reasons"][0]
        assert live.http.get("/healthz").status_code == 200
        assert live.alarms() == []
        other.close()
        (alarm,) = until(live.alarms)
        assert (alarm["meter"], alarm["state"]) == (site.meter_ids[4], "raised")
        verdicts(fleet, samples[25:40])
        away = tmp_path / "away"
        away.mkdir()
        for name in ("alarms.db", "alarms.db-wal", "alarms.db-shm"):
            (tmp_path / name).rename(away / name)
        assert verdicts(fleet, samples[40:50])[-1][1] == "clean"
        answer = until(lambda: (a := live.http.get("/readyz")).status_code == 503 and a)
        assert "removed" in answer.json()["reasons"][0]
        assert live.http.get("/api/v1/alarms").headers["content-type"] == "application/problem+json"
        for name in ("alarms.db", "alarms.db-wal", "alarms.db-shm"):
            (away / name).rename(tmp_path / name)
        assert verdicts(fleet, samples[50:])[-1][1] == "clean"
        until(lambda: live.http.get("/readyz").status_code == 200)
        assert [a["state"] for a in live.alarms()] == ["cleared"]


@pytest.mark.acceptance
def test_a_feeder_with_five_mistakes_by_file_and_by_rest(tmp_path: Path) -> None:
    samples = sampled(load(FEEDER), 20)
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        verdicts(fleet, samples[:10])
        tables = live.get(f"/api/v1/feeders/{FEEDER}")["tables"]
        tables["feeder"]["base_kva"] = -1
        tables["lines"][0]["r_ohm"] = -1
        tables["lines"][1]["from_bus"] = "nowhere"
        tables["customers"][0]["droop"] = "no-such-curve"
        tables["customers"][1]["power_factor"] = 3
        answer = live.http.put(f"/api/v1/feeders/{FEEDER}", json=tables)
        assert (answer.status_code, answer.headers["content-type"]) == (422, "application/problem+json")
        problems = answer.json()["problems"]
        assert len(problems) == 5
        for word in ("base_kva", "r_ohm", "nowhere", "no-such-curve", "power_factor"):
            assert any(word in problem for problem in problems), problems
        assert {verdict for _, verdict, _ in verdicts(fleet, samples[10:])} == {"clean"}
        answer_s, echo_s = delays(live)
        assert answer_s < 0.03 + 10.0 * echo_s


def delays(live: Live) -> tuple[float, float]:
    """Medians of how long a small answer takes, and an echo from a thread of this process, s.

    An answer must not wait for Nagle's algorithm and the other side's delayed acknowledgement, 40 ms; on a
    busy machine both take longer.
    """
    asked, echoed = [], []
    near, far = socket.socketpair()
    with near, far:

        def echo() -> None:
            while data := far.recv(16):
                far.sendall(data)

        other = threading.Thread(target=echo)
        other.start()
        for _ in range(21):
            begin = time.perf_counter()
            near.sendall(b"echo")
            near.recv(16)
            between = time.perf_counter()
            live.get("/api/v1/feeders")
            echoed.append(between - begin)
            asked.append(time.perf_counter() - between)
        near.shutdown(socket.SHUT_WR)
        other.join()
    return statistics.median(asked), statistics.median(echoed)


@pytest.mark.acceptance
def test_a_feeder_put_while_running_is_watched_and_the_other_goes_on(tmp_path: Path) -> None:
    samples = sampled(load(FEEDER), 30)
    with serve(FEEDER, tmp_path) as live, Fleet(live) as fleet:
        verdicts(fleet, samples[:10])
        tables = live.get(f"/api/v1/feeders/{FEEDER}")["tables"]
        tables["feeder"]["name"] = "second"
        assert live.http.put("/api/v1/feeders/second", json=tables).status_code == 200
        second = Live("second", live.zenoh_port, live.http, live.process, live.log)
        with Fleet(second) as fleet2:
            both = zip(fleet.play(samples[10:]), fleet2.play(samples[10:]), strict=True)
            for (sample, one), (_, two) in both:
                assert one["verdict"] == "clean"
                assert (one["feeder"], two["feeder"]) == (FEEDER, "second")
                assert two["verdict"] == "clean" or sample.t - START < 10.0 + STARTED_S
            replies = fleet.session.get("gridsec/*/estimate", timeout=5.0)
            told = {str(r.ok.key_expr): json.loads(r.ok.payload.to_bytes()) for r in replies if r.ok}
        assert {state["feeder"] for state in told.values()} == {FEEDER, "second"}
        state = live.get(f"/api/v1/feeders/{FEEDER}/state")
        assert state.pop("age_s") >= 0.0
        # One process has no leases.
        assert (state.pop("owner"), state.pop("epoch")) == (None, None)
        assert told[f"gridsec/{FEEDER}/estimate"] == state
