"""Series and spans of alarms from the database, and the layouts and roll-ups of the history.

Roll-ups are added in order of time: all rows of a feeder before the end of its newest roll-up are rolled up.
After an upgrade, or a clock that was set back, they are added again, a bounded number with each stored row.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import sqlalchemy as sa

from service.alarms.conditions import AlarmKind, Condition, Severity
from service.alarms.state_machine import Alarm, Change, alarm_id, from_json
from service.report.report import Kept
from service.store.schema import ALARM, EVENT, HISTORY, LAYOUT, ROLLUP, digest
from service.store.series import (
    MAX_ROWS,
    ROLLUP_S,
    ROWS_S,
    Series,
    bucket_of,
    floor_to,
    merge,
    of_rollups,
    of_rows,
    roll_up,
)

_ROLLED_AT_ONCE: Final = 20
"""Largest number of roll-ups that one stored row adds: after an upgrade, 14 days take 84 minutes."""
_CHANGES_READ: Final = 5000
"""Largest number of changes of alarms that one call reads."""
_TIME_OF_ID: Final = 10
"""Number of characters of an alarm's id that state its onset."""

# --- Series ---


def read_series(
    connection: sa.Connection,
    feeder: str,
    meters: Sequence[str],
    *,
    since: float,
    until: float,
    buckets: int,
    step_s: float,
) -> Series:
    """Return a series as `Store.series`; `step_s` is the grid of the history, s."""
    bucket_s = bucket_of(until - since, buckets)
    begin, end = floor_to(since, bucket_s), -floor_to(-until, bucket_s)
    first, parts = begin, []
    if until - since > ROWS_S:
        # Roll-ups first: rows that are rolled up in between are still read as rows.
        parts.append(of_rollups(_rollups(connection, feeder, begin, end), meters))
        first = max(begin, _rolled_until(connection, feeder) or begin)
    rows = _newest_rows(connection, feeder, first, end)
    parts.append(of_rows(rows[-MAX_ROWS:], meters, bucket_s, until))
    complete = len(rows) <= MAX_ROWS
    return Series(begin, end, bucket_s, step_s, tuple(meters), merge(parts, bucket_s), complete)


def _rollups(connection: sa.Connection, feeder: str, begin: float, end: float) -> list[dict[str, Any]]:
    """Roll-ups of a feeder in [begin, end), oldest first."""
    r = ROLLUP.c
    query = (
        sa.select(r.t, r.ticks, r.clean_s, r.attacked_s, r.undecided_s, r.data, LAYOUT.c.meters)
        .join(LAYOUT, LAYOUT.c.id == r.layout)
        .where(r.feeder == feeder, r.t >= begin, r.t < end)
        .order_by(r.t, r.layout)
    )
    return [dict(row) for row in connection.execute(query).mappings()]


def _rolled_until(connection: sa.Connection, feeder: str) -> float | None:
    """End of the newest roll-up of a feeder: all rows before it are rolled up. None without one."""
    newest = connection.scalar(sa.select(sa.func.max(ROLLUP.c.t)).where(ROLLUP.c.feeder == feeder))
    return None if newest is None else float(newest) + ROLLUP_S


def _newest_rows(
    connection: sa.Connection, feeder: str, begin: float, end: float
) -> list[tuple[float, str, bytes, tuple[str, ...]]]:
    """Newest rows of a feeder in [begin, end), oldest first: at most one more than `MAX_ROWS`."""
    h = HISTORY.c
    query = sa.select(h.t, h.verdict, h.data, h.layout).where(h.feeder == feeder, h.t >= begin, h.t < end)
    found = connection.execute(query.order_by(h.t.desc()).limit(MAX_ROWS + 1)).all()
    numbers = {row.layout for row in found}
    texts = connection.execute(sa.select(LAYOUT.c.id, LAYOUT.c.meters).where(LAYOUT.c.id.in_(numbers)))
    meters = {number: tuple(json.loads(text)) for number, text in texts}
    return [(t, verdict, data, meters[layout]) for t, verdict, data, layout in reversed(found)]


# --- Layouts ---


def layout_ids(
    connection: sa.Connection, insert: Callable[[sa.Table], Any], wanted: Iterable[tuple[str, ...]]
) -> dict[tuple[str, ...], int]:
    """Return the ids of layouts by their meters; new ones are stored.

    insert: `Connections.insert`.
    """
    texts = {meters: _layout(meters) for meters in wanted}
    digests = dict(texts.values())
    known = sa.select(LAYOUT.c.digest, LAYOUT.c.id).where(LAYOUT.c.digest.in_(digests))
    found = {row.digest: row.id for row in connection.execute(known)}
    # In one order: two workers that add the same layouts wait for each other only once.
    new = [{"meters": digests[key], "digest": key} for key in sorted(digests.keys() - found.keys())]
    if new:
        connection.execute(insert(LAYOUT).on_conflict_do_nothing(), new)
        found = {row.digest: row.id for row in connection.execute(known)}
    return {meters: int(found[key]) for meters, (key, _) in texts.items()}


@lru_cache(maxsize=1024)
def _layout(meters: tuple[str, ...]) -> tuple[str, str]:
    """Digest and text of the layout of a row."""
    text = json.dumps(meters)
    return digest(text), text


# --- Roll-ups ---


def add_rollups(
    connection: sa.Connection, upsert: Callable[..., Any], rolled: dict[str, float], report: Kept
) -> None:
    """Add the roll-ups of the finished buckets before a stored report, at most one bucket late.

    Each feeder has its own delay: the work of many feeders is spread over the bucket.

    upsert: `Connections.upsert`.
    rolled: end of the roll-ups of each feeder, Unix s; updated.
    """
    h, r, feeder = HISTORY.c, ROLLUP.c, report.feeder
    now = floor_to(report.t - ROLLUP_S * _delay(feeder), ROLLUP_S)
    until = rolled.get(feeder)
    if until is None:
        until = _rolled_until(connection, feeder)
    if until is not None and report.t < until:  # The clock was set back.
        connection.execute(ROLLUP.delete().where(r.feeder == feeder, r.t >= now))
        until = now
    if until is not None and now <= until:
        rolled[feeder] = until
        return
    before = sa.and_(h.feeder == feeder, h.t < now, *([] if until is None else [h.t >= until]))
    first = connection.scalar(sa.select(sa.func.min(h.t)).where(before))
    if first is None:
        rolled[feeder] = now
        return
    begin = floor_to(float(first), ROLLUP_S)
    end = min(now, begin + _ROLLED_AT_ONCE * ROLLUP_S)
    query = (
        sa.select(h.t, h.verdict, h.layout, h.data, LAYOUT.c.meters)
        .join(LAYOUT, LAYOUT.c.id == h.layout)
        .where(h.feeder == feeder, h.t >= begin, h.t < end)
        .order_by(h.t)
    )
    for row in roll_up(connection.execute(query).all(), end):
        connection.execute(upsert(ROLLUP, "feeder", "t", "layout"), {"feeder": feeder, **row})
    rolled[feeder] = end


def _delay(feeder: str) -> float:
    """Delay of a feeder's roll-ups in buckets, [0, 1); it depends on the name only."""
    return zlib.crc32(feeder.encode()) / 2.0**32


def feeders_in(connection: sa.Connection, table: sa.Table) -> list[str]:
    """Return the feeders of a table with the feeder first in its key, by one look-up for each of them."""
    name = table.c.feeder
    found = sa.select(sa.func.min(name).label("name")).cte(recursive=True)
    following = sa.select(sa.func.min(name)).where(name > found.c.name).scalar_subquery()
    found = found.union_all(sa.select(following).where(found.c.name.is_not(None)))
    return list(connection.scalars(sa.select(found.c.name).where(found.c.name.is_not(None))))


def prune_rollups(connection: sa.Connection, feeders: Collection[str], t: float, *, limit: int) -> None:
    """Delete old roll-ups of some feeders."""
    r = ROLLUP.c
    oldest = sa.select(r.feeder, r.t).where(r.feeder.in_(feeders), r.t < t - ROLLUP_S)
    connection.execute(ROLLUP.delete().where(sa.tuple_(r.feeder, r.t).in_(oldest.limit(limit))))


# --- Alarms ---


@dataclass(frozen=True, slots=True)
class AlarmSpan:
    """One occurrence of an alarm: the alarm when it was raised, and both times, Unix s."""

    alarm: Alarm
    raised: float
    cleared: float | None  # None while it is active


def read_alarm_spans(
    connection: sa.Connection, feeder: str, *, since: float, until: float, limit: int
) -> tuple[list[AlarmSpan], bool]:
    """Return spans as `Store.alarm_spans`."""
    a, e = ALARM.c, EVENT.c
    overlap = sa.and_(a.feeder == feeder, sa.or_(a.t_cleared.is_(None), a.t_cleared >= since))
    # Ids begin with the onset: an alarm that returned later keeps its id.
    anything = Condition(AlarmKind.UNDECIDED, feeder, None, Severity.MINOR)
    end = alarm_id(anything, until)[:_TIME_OF_ID]
    ids = list(
        connection.scalars(sa.select(a.id).where(overlap, a.id < end).order_by(a.id.desc()).limit(limit + 1))
    )
    changes = sa.select(e.alarm_id, e.t, e.change, e.data).where(
        e.alarm_id.in_(ids[:limit]), e.change.in_([str(Change.RAISED), str(Change.CLEARED)])
    )
    spans: dict[tuple[str, int], AlarmSpan] = {}
    last: dict[str, AlarmSpan] = {}
    for alarm, t, change, data in connection.execute(changes.order_by(e.seq).limit(_CHANGES_READ)):
        if change == str(Change.RAISED):
            last[alarm] = AlarmSpan(from_json(json.loads(data)), t, None)
        elif alarm in last:
            last[alarm] = replace(last[alarm], cleared=t)
        if alarm in last:
            spans[alarm, last[alarm].alarm.count] = last[alarm]
    inside = [
        span
        for span in spans.values()
        if span.raised < until and (span.cleared is None or span.cleared >= since)
    ]
    return sorted(inside, key=lambda span: span.raised), len(ids) > limit
