"""Time series of the history: buckets and roll-ups against sums over the single rows."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gridsec.interface import Cause, Decision
from service.alarms.conditions import AlarmKind, Condition, Severity
from service.alarms.state_machine import AlarmState, AlarmTransition, Change, alarm_id
from service.report.report import FeederReport, MeterState
from service.store import HistoryRules, Store
from service.store import series as codec
from service.store.schema import HISTORY, ROLLUP
from service.store.series import BAND_STD, EXTREMES, ROLLUP_S, STEPS_S, VERDICTS, bucket_of, unpack
from tests.service.databases import both
from tests.service.stored import an_alarm, raised

BEGIN = 1_795_200_000.0
"""A multiple of every duration of a bucket, Unix s."""
FINE = HistoryRules(step_s=0.0)


def a_report(t: float, draw: np.random.Generator, meters: tuple[str, ...] = ("m0", "m1")) -> FeederReport:
    verdict = VERDICTS[draw.choice(3, p=(0.6, 0.2, 0.2))]

    def number(scale: float, missing: float) -> float | None:
        return None if draw.random() < missing else float(np.float32(230.0 + scale * draw.normal()))

    states = tuple(
        MeterState(
            meter,
            "b",
            bool(draw.random() < 0.9),
            verdict is Decision.ATTACKED and k == 0,
            1e-4,
            2e-3,
            number(3.0, 0.2),
            number(1.0, 0.1),
            None if draw.random() < 0.1 else 0.25,
            1.0,
            0.0,
            model_only=bool(draw.random() < 0.1),
        )
        for k, meter in enumerate(meters)
    )
    cause = {Decision.CLEAN: Cause.AGREEMENT, Decision.ATTACKED: Cause.RESIDUALS}.get(verdict, Cause.MISFIT)
    return FeederReport("village", t, verdict, "", cause, 2, states, (), (), 207.0, 253.0)


def expected(reports: list[FeederReport], meter: str, bucket_s: float, until: float) -> dict[float, Any]:
    """Extremes and verdict times of the buckets, report by report."""
    found: dict[float, Any] = {}
    for k, one in enumerate(reports):
        begin = one.t // bucket_s * bucket_s
        bucket = found.setdefault(begin, {"ticks": 0, "suspect": False, **{str(v): 0.0 for v in VERDICTS}})
        following = reports[k + 1].t if k + 1 < len(reports) else until
        within = min(bucket_s, ROLLUP_S)
        bucket[str(one.verdict)] += min(following, (one.t // within + 1.0) * within) - one.t
        bucket["ticks"] += 1
        state = next((m for m in one.meters if m.meter == meter), None)
        if state is None:
            continue
        bucket["suspect"] |= state.suspect
        v = None if state.model_only else state.v_volt_estimated
        half = None if v is None or state.v_volt_std is None else BAND_STD * state.v_volt_std
        pairs = {"reported": (state.v_volt_reported,) * 2, "estimated": (v, v)}
        pairs["band"] = (None, None) if v is None or half is None else (v - half, v + half)
        for name, (low, high) in pairs.items():
            for end, value, better in (("min", low, min), ("max", high, max)):
                if value is not None:
                    key = f"v_volt_{name}_{end}"
                    bucket[key] = better(bucket.get(key, value), value)
    return found


def check(
    store: Store,
    reports: list[FeederReport],
    meters: tuple[str, ...],
    *,
    since: float,
    until: float,
    buckets: int,
) -> codec.Series:
    found = store.series("village", meters, since=since, until=until, buckets=buckets)
    inside = [one for one in reports if found.since <= one.t < found.until]
    for k, meter in enumerate(meters):
        wanted = expected(inside, meter, found.bucket_s, until)
        each = [wanted[t] for t in sorted(wanted)]
        assert found.buckets.t.tolist() == sorted(wanted)
        assert found.buckets.ticks.tolist() == [bucket["ticks"] for bucket in each]
        assert found.buckets.suspect[:, k].tolist() == [bucket["suspect"] for bucket in each]
        lasted = np.array([[bucket[str(v)] for v in VERDICTS] for bucket in each])
        np.testing.assert_allclose(found.buckets.verdict_s, lasted, atol=1e-4)
        numbers = np.array([[bucket.get(name, math.nan) for name in EXTREMES] for bucket in each])
        np.testing.assert_allclose(found.buckets.extremes[:, :, k], numbers, atol=1e-4, equal_nan=True)
    return found


@pytest.mark.canary("sqlite")
@both
def test_roll_ups_and_rows_merge_to_the_same_buckets(url: str) -> None:
    """Nine hours with gaps, another set of meters, a restart, and a clock that was set back."""
    draw = np.random.default_rng(1)
    times = np.sort(BEGIN + np.unique(draw.uniform(0.0, 9 * 3600.0, 420).round(1)))
    times = times[(times < BEGIN + 4000.0) | (times > BEGIN + 9000.0)]
    sets = (("m0", "m1"), ("m1", "m2", "m0"))
    reports = [a_report(t, draw, sets[t > BEGIN + 20_000.0]) for t in times.tolist()]
    half = len(reports) // 2
    with Store(url, history=FINE) as store:
        for k in range(0, half, 25):
            store.commit(reports=reports[:half][k : k + 25])
    with Store(url, history=FINE) as store:
        store.commit(reports=reports[half:])
        # The clock is set back by 25 minutes: some ticks are replaced, others come between.
        again = [a_report(t, draw, sets[1]) for t in (times[-100:] - 1500.0).round(1).tolist()]
        store.commit(reports=again)
        at = {one.t: one for one in (*reports, *again)}
        every = [at[t] for t in sorted(at)]
        end = times[-1] + 1.0
        meters = ("m0", "m2", "substation")
        whole = check(store, every, meters, since=BEGIN, until=end, buckets=600)
        assert whole.bucket_s == ROLLUP_S
        assert whole.complete
        check(store, every, meters, since=BEGIN, until=end, buckets=40)
        check(store, every, meters, since=times[120], until=end, buckets=200)
        check(store, every, meters, since=end - 3600.0, until=end, buckets=600)
        assert check(store, every, ("m1",), since=end - 6 * 3600.0, until=end, buckets=2000).bucket_s == 20.0
        with store._connections.read() as connection:
            rolled = connection.execute(ROLLUP.select().with_only_columns(ROLLUP.c.t)).scalars().all()
        assert len(set(rolled)) > 80


def test_rows_of_version_1_stay_readable_and_have_no_band(tmp_path: Path) -> None:
    """A database with rows of the earlier version is rolled up step by step; the answer is the same."""
    draw = np.random.default_rng(2)
    reports = [a_report(BEGIN + 200.0 * k, draw) for k in range(120)]
    ids = ("m0", "m1", "substation")
    with Store(f"sqlite:///{tmp_path}/g.db", history=FINE) as store:
        store.commit(reports=reports)
        with store._connections.write() as connection:
            connection.execute(ROLLUP.delete())
            for one in reports:
                meters = (*one.meters, one.busbar)
                table = [
                    [math.nan if (v := getattr(m, name, None)) is None else v for m in meters]
                    for name in ("v_volt_reported", "v_volt_estimated", "score", "threshold")
                ]
                flags = bytes(m.seen + 2 * m.suspect + 4 * m.model_only for m in meters)
                old = zlib.compress(np.array(table, dtype="<f4").tobytes() + flags, 6)
                row = unpack(old, ids, "m0")["meter"]
                assert row["v_volt_std"] is None
                assert row["v_volt_reported"] == pytest.approx(one.meters[0].v_volt_reported)
                connection.execute(HISTORY.update().where(HISTORY.c.t == one.t).values(data=old))
    plain = [replace(one, meters=tuple(replace(m, v_volt_std=None) for m in one.meters)) for one in reports]
    with Store(f"sqlite:///{tmp_path}/g.db", history=FINE) as store:
        end = BEGIN + 200.0 * 120
        check(store, plain, ("m0", "m1"), since=BEGIN, until=end, buckets=300)
        for k in range(14):
            plain.append(a_report(end + k, draw))
            store.commit(reports=plain[-1:])
            if k % 6 == 0:
                check(store, plain, ("m0", "m1"), since=BEGIN, until=end + k + 1.0, buckets=300)
        with store._connections.read() as connection:
            assert len(connection.execute(ROLLUP.select()).all()) == 120


@pytest.mark.acceptance
def test_old_roll_ups_are_deleted_with_their_rows(tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    keep = HistoryRules(step_s=600.0, keep_s=86_400.0)
    with Store(f"sqlite:///{tmp_path}/g.db", history=keep) as store:
        for k in range(0, 700, 50):
            store.commit(reports=[a_report(BEGIN + 600.0 * j, draw) for j in range(k, k + 50)])
        last = BEGIN + 600.0 * 699
        with store._connections.read() as connection:
            oldest = min(connection.execute(ROLLUP.select().with_only_columns(ROLLUP.c.t)).scalars())
        assert oldest >= last - 86_400.0 - 500 * 600.0
        assert oldest == store.history("village", limit=5000)[0]["t"]


def test_the_roll_ups_of_many_feeders_are_spread_over_a_bucket(tmp_path: Path) -> None:
    draw = np.random.default_rng(5)
    names = [f"feeder-{k:03d}" for k in range(60)]
    added: list[int] = []
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        for k in range(36):
            made = a_report(BEGIN + 10.0 * k, draw)
            store.commit(reports=[replace(made, feeder=name) for name in names])
            with store._connections.read() as connection:
                rolled = connection.execute(
                    ROLLUP.select().with_only_columns(ROLLUP.c.feeder, ROLLUP.c.t)
                ).all()
            added.append(len(rolled))
    first, later = np.diff(added[:24]), np.diff(added[24:])
    assert not any(added[:12])
    # Every feeder has its first roll-up at most one bucket late, and a second one a bucket after it.
    assert {feeder for feeder, t in rolled if t == BEGIN} == set(names)
    assert added[24] == len(names)
    assert max(*first, *later) < len(names) / 4


def test_the_cost_of_a_series_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without roll-ups the oldest rows are left out, and the series states it."""
    monkeypatch.setattr("service.store.rollups.MAX_ROWS", 50)
    draw = np.random.default_rng(4)
    reports = [a_report(BEGIN + k, draw) for k in range(100)]
    with Store(f"sqlite:///{tmp_path}/g.db", history=FINE) as store:
        store.commit(reports=reports)
        found = store.series("village", ["m0"], since=BEGIN, until=BEGIN + 100.0)
        assert not found.complete
        assert found.buckets.t.tolist() == [one.t for one in reports[50:]]
        assert store.series("town", ["m0"], since=BEGIN, until=BEGIN + 100.0).buckets.t.size == 0


def test_the_duration_of_a_bucket() -> None:
    assert bucket_of(3600.0, 600) == 10.0
    assert bucket_of(6 * 3600.0, 600) == 60.0
    assert bucket_of(24 * 3600.0, 720) == ROLLUP_S
    assert bucket_of(6.01 * 3600.0, 2000) == ROLLUP_S
    assert bucket_of(14 * 86400.0, 600) == 2400.0
    assert all(step % ROLLUP_S == 0.0 for step in STEPS_S if step >= ROLLUP_S)


@both
def test_spans_of_alarms(store: Store) -> None:
    def of(number: int, onset: float, **changes: Any) -> Any:
        condition = Condition(AlarmKind.METER_MANIPULATED, "village", f"m{number}", Severity.CRITICAL)
        alarm = an_alarm(id=alarm_id(condition, onset), meter=f"m{number}", t_event=onset, t_raised=onset)
        return replace(alarm, **changes)

    def cleared(alarm: Any, t: float) -> AlarmTransition:
        return AlarmTransition(replace(alarm, state=AlarmState.CLEARED, t_cleared=t), Change.CLEARED, t)

    before, flaps, stands, later = (of(k, BEGIN + 100.0 * k) for k in range(4))
    again = replace(flaps, count=2, t_raised=BEGIN + 180.0)
    store.commit([raised(before), cleared(before, BEGIN + 50.0)])
    store.commit([raised(flaps), cleared(flaps, BEGIN + 150.0), raised(again)])
    store.commit([raised(stands), cleared(again, BEGIN + 900.0), raised(later)])
    store.commit([raised(of(9, BEGIN + 120.0, feeder="town"))])
    found, more = store.alarm_spans("village", since=BEGIN + 110.0, until=BEGIN + 250.0)
    assert not more
    assert [(span.alarm.meter, span.raised - BEGIN, span.cleared) for span in found] == [
        ("m1", 100.0, BEGIN + 150.0),
        ("m1", 180.0, BEGIN + 900.0),
        ("m2", 200.0, None),
    ]
    found, more = store.alarm_spans("village", since=BEGIN, until=BEGIN + 1e4, limit=1)
    assert ([span.alarm.meter for span in found], more) == (["m3"], True)
