"""Twins of times as in RFC 3339: in every response, in streams and in messages; not in the database."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, TypeAdapter

from service.store.schema import ALARM, EVENT, INCIDENT, INCIDENT_EVENT, SHELF, WORK
from service.times import UtcTwins, is_time, rfc3339
from tests.service.asking import Setup, Stream

REQUESTS = {"WorkRequest"}
LISTS = {"Series"}
"""Schemas with lists of times: their tables have the twins."""


@given(st.integers(-62_135_596_800_000, 253_402_300_799_999))
def test_a_twin_is_the_time_to_the_millisecond(thousandths: int) -> None:
    shown = pc.strftime(pa.array([thousandths], pa.timestamp("ms", "UTC")), "%Y-%m-%dT%H:%M:%SZ")[0].as_py()
    assert rfc3339(thousandths / 1000.0) == shown


@pytest.mark.parametrize("t", [None, 1e300, -1e300, math.inf, math.nan, 253_402_300_800.0])
def test_a_time_beyond_the_calendar_has_no_twin(t: float | None) -> None:
    assert rfc3339(t) is None


@dataclass(frozen=True, slots=True)
class _Base(UtcTwins):
    t: float
    tick_s: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _More(_Base):
    shelved_until: float | None = None


class _Model(UtcTwins, BaseModel):
    since: float
    inner: _More


def test_models_and_dataclasses_get_their_twins_by_one_base() -> None:
    made = _Model(since=0.5, inner=_More(t=1.0))
    inner = {"t": 1.0, "tick_s": 1.0, "shelved_until": None}
    assert made.model_dump(round_trip=True) == {"since": 0.5, "inner": inner}
    twins = {"t_utc": "1970-01-01T00:00:01.000Z", "shelved_until_utc": None}
    assert made.model_dump()["inner"] == inner | twins
    assert made.model_dump()["since_utc"] == "1970-01-01T00:00:00.500Z"
    reader = TypeAdapter(_More)
    assert reader.validate_json(reader.dump_json(made.inner)) == made.inner


def test_every_time_of_a_response_has_its_twin(setup: Setup) -> None:
    """The description marks a time by its name `t`, `t_...`, or by the unit `Unix s`."""
    schemas = setup.get("/openapi.json").json()["components"]["schemas"]
    found = 0
    for name, schema in schemas.items():
        properties: dict[str, Any] = schema.get("properties", {})
        if name in REQUESTS | LISTS or (name.startswith("Feeder") and name not in {"FeederSummary"}):
            continue
        for field, described in properties.items():
            unit = "Unix s" in described.get("description", "")
            if not field.endswith("_utc") and (re.fullmatch(r"t(_[a-z]+)?", field) or unit or is_time(field)):
                found += 1
                assert f"{field}_utc" in properties, (name, field)
                forms = properties[f"{field}_utc"]["anyOf"]
                assert {"type": "string", "format": "date-time"} in forms
    assert found > 40


def pairs(value: Any) -> Iterator[tuple[float | None, str | None]]:
    """Times of a JSON document with their twins."""
    if isinstance(value, list):
        for each in value:
            yield from pairs(each)
    elif isinstance(value, dict):
        for name, each in value.items():
            if isinstance(each, list | dict):
                yield from pairs(each)
            elif name.endswith("_utc"):
                yield value[name.removesuffix("_utc")], each


def right(document: Any, least: int) -> None:
    found = list(pairs(document))
    assert len(found) >= least
    assert sum(twin is not None for _, twin in found) >= 1
    assert all(twin == rfc3339(t) for t, twin in found)


def test_responses_and_streams_have_twins_and_the_database_none(setup: Setup) -> None:
    setup.attack()
    alarm = setup.one()
    shelf = {"who": "Ada", "alarm": alarm["id"], "duration_s": 600.0, "reason": "known"}
    assert setup.http.post("/api/v1/shelves", json=shelf).status_code == 201
    work = {"who": "Ada", "feeder": "village", "t_until": setup.service.wall() + 600.0, "reason": "cable"}
    assert setup.http.post("/api/v1/planned-work", json=work).status_code == 201
    remark = {"who": "Ada", "comment": "seen"}
    assert setup.http.post(f"/api/v1/alarms/{alarm['id']}/comment", json=remark).status_code == 200
    least = {
        "/feeders": 4, "/feeders/village/state": 3, "/feeders/village/meters/H3": 1,
        "/feeders/village/history": 1, "/alarms": 5, f"/alarms/{alarm['id']}": 5,
        f"/alarms/{alarm['id']}/events": 5, "/incidents": 6, "/incidents/events": 7, "/shelves": 3,
        "/planned-work": 4, "/hand-over": 2,
    }  # fmt: skip
    for path, count in least.items():
        right(setup.get(path).json(), count)
    assert setup.get("/alarms").json()["alarms"][0]["t_raised_utc"].startswith("2026-11-20T22:00:0")
    for path, count in {"/alarms/stream": 5, "/incidents/stream": 7, "/feeders/village/stream": 3}.items():
        stream = Stream(setup, path + ("?after=0" if "village" not in path else ""))
        event = stream.next()
        right(json.loads(event["data"] if "data" in event else stream.next()["data"]), count)
        stream.close()
    with setup.service.store._read() as connection:
        for table in (ALARM, EVENT, INCIDENT, INCIDENT_EVENT, SHELF, WORK):
            stored = list(connection.scalars(sa.select(table.c.data)))
            assert stored
            assert not any("_utc" in each for each in stored)
