"""REST beyond JSON: tables, compression, HEAD, strict parameters, and the description of a feeder."""

from __future__ import annotations

import csv
import gzip
import io
import json
from datetime import UTC, datetime
from typing import Any

import httpx
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from feeders.format.tables import to_json
from feeders.model.site import load
from service.alarms.conditions import AlarmKind, Severity
from service.alarms.incidents import Incident, IncidentKind, IncidentState
from service.api.description import feeder_schemas
from service.api.tables import ARROW, CSV, JSON, MEDIA, PARQUET, encoded, incidents, preferred
from tests.service.asking import T0, Setup, is_problem

HISTORY = "/feeders/village/history"


def table(response: httpx.Response) -> list[dict[str, Any]]:
    """Rows of a response in its format."""
    assert response.status_code == 200, response.text
    kind = response.headers["content-type"].partition(";")[0]
    if kind == CSV:
        return list(csv.DictReader(io.StringIO(response.text)))
    if kind == PARQUET:
        return list(pq.read_table(io.BytesIO(response.content)).to_pylist())
    assert kind == ARROW
    return list(pa.ipc.open_stream(response.content).read_all().to_pylist())


@pytest.mark.parametrize("media", MEDIA[1:])
def test_history_as_a_table(setup: Setup, media: str) -> None:
    setup.calm(T0, 30)
    setup.attack(T0 + 30.0, 3)
    points = setup.get(HISTORY, params={"meter": "H3"}).json()["points"]
    rows = table(setup.get(HISTORY, params={"meter": "H3"}, headers={"Accept": media}))
    assert len(rows) == len(points) == 4
    for row, point in zip(rows, points, strict=True):
        assert float(row["t"]) == point["t"]
        assert float(row["v_volt_estimated"]) == point["meter"]["v_volt_estimated"]
        assert (row["meter"], row["verdict"]) == ("H3", point["verdict"])
        assert row["suspects"] == (";".join(point["suspects"]) if media == CSV else point["suspects"])
    instant = datetime.fromtimestamp(T0 + 30.0, UTC)
    shown = rows[-1]["t_utc"]
    assert (datetime.fromisoformat(shown) if media == CSV else shown) == instant
    if media == CSV:
        assert shown == "2026-11-20T22:00:30.000Z"


@pytest.mark.parametrize("media", MEDIA[1:])
@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r"])
def test_texts_of_operators_are_no_formulas_in_csv(media: str, start: str) -> None:
    text = f"{start}HYPERLINK(1)"
    incident = Incident(
        "0" * 26,
        IncidentKind.MANIPULATION,
        "village",
        Severity.CRITICAL,
        IncidentState.RAISED,
        count=1,
        alarms=1,
        active=1,
        unacknowledged=1,
        kinds=(AlarmKind.METER_MANIPULATED,),
        customers=(),
        t_first=-1.5,
        t_last=2.0,
        t_cleared=None,
        reason=f"x{start}",
        meters=(text, text),
        assigned_to=text,
    )
    content = encoded(incidents([incident]), media)
    (row,) = table(httpx.Response(200, headers={"Content-Type": media}, content=content))
    if media == CSV:
        assert (row["assigned_to"], row["meters"]) == (f"'{text}", f"'{text};{text}")
        assert (row["t_first"], row["reason"]) == ("-1.5", f"x{start}")
    else:
        assert (row["assigned_to"], row["meters"], row["t_first"]) == (text, [text, text], -1.5)


@pytest.mark.parametrize("media", MEDIA[1:])
def test_alarms_page_by_page_as_tables(setup: Setup, media: str) -> None:
    setup.attack(lies={f"H{k}": 8.0 for k in range(3)})
    found = setup.get("/alarms").json()["alarms"]
    response = setup.get("/alarms?limit=2", headers={"Accept": media})
    rows = table(response)
    while "link" in response.headers:
        url = response.links["next"]["url"]
        response = setup.http.get(url, headers={"Accept": media})
        rows += table(response)
    assert [row["id"] for row in rows] == [alarm["id"] for alarm in found]
    for row, alarm in zip(rows, found, strict=True):
        assert json.loads(row["evidence"]) == alarm["evidence"]
        assert float(row["t_raised"]) == alarm["t_raised"]
        assert row["t_cleared_utc"] == ("" if media == CSV else None)
    # The same list in another format is another response.
    tag = setup.get("/alarms").headers["etag"]
    assert setup.get("/alarms", headers={"If-None-Match": tag, "Accept": media}).status_code == 200
    assert response.headers["vary"].split(", ")[0] == "Accept"


def test_tables_without_rows_have_their_columns(setup: Setup) -> None:
    empty = setup.get(HISTORY, headers={"Accept": CSV}).text
    assert empty.startswith('"t","t_utc","verdict","cause","seen","suspects"')
    assert table(setup.get("/alarms", headers={"Accept": PARQUET})) == []


def test_the_accepted_type_is_chosen(setup: Setup) -> None:
    assert preferred("") == preferred("*/*") == preferred("application/*") == JSON
    assert preferred("text/html,application/xhtml+xml,*/*;q=0.8") == JSON
    assert preferred("application/json;q=0.5, text/csv") == CSV
    assert preferred("application/json;q=0, */*") == CSV
    assert preferred(f"{ARROW};q=0.9, {PARQUET}") == PARQUET
    assert preferred("text/html") is preferred("text/csv;q=0") is preferred("text/csv;q=x") is None
    detail = is_problem(setup.get(HISTORY, headers={"Accept": "text/html"}), 406)["detail"]
    assert all(media in detail for media in MEDIA)


def test_long_responses_are_compressed_on_request(setup: Setup) -> None:
    setup.attack()
    with setup.http.stream(
        "GET", "/api/v1/feeders/village/state", headers={"Accept-Encoding": "gzip"}
    ) as response:
        raw = b"".join(response.iter_raw())
    assert response.headers["content-encoding"] == "gzip"
    assert "Accept-Encoding" in response.headers["vary"]
    plain = setup.get("/feeders/village/state", headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers
    assert json.loads(gzip.decompress(raw))["meters"] == plain.json()["meters"]
    assert len(raw) < 0.4 * len(plain.content)
    with setup.http.stream("GET", "/api/v1/alarms/stream", headers={"Accept-Encoding": "gzip"}) as stream:
        assert "content-encoding" not in stream.headers


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        (f"{HISTORY}?meters=H3", "query.meters: unknown parameter; expected limit, meter, since, until"),
        ("/alarms?stat=raised&feeder=village", "query.stat: unknown parameter"),
        ("/feeders/village/state?x=1", "query.x: unknown parameter; expected none"),
        ("/bad-readings?limits=3", "query.limits: unknown parameter; expected limit"),
        ("/alarms/stream?since=3", "query.since: unknown parameter; expected after, feeder"),
    ],
)
def test_unknown_parameters_are_refused(setup: Setup, path: str, wrong: str) -> None:
    setup.attack()
    assert wrong in is_problem(setup.get(path), 422)["detail"]


def test_unknown_meters_and_feeders_are_refused(setup: Setup) -> None:
    assert "no meter 'zzz'" in is_problem(setup.get(f"{HISTORY}?meter=zzz"), 404)["detail"]
    assert setup.get(f"{HISTORY}?meter=H3").json()["points"] == []
    setup.attack(ticks=1)
    for meter in ("H3", "substation"):
        assert setup.get(f"{HISTORY}?meter={meter}").status_code == 200
        assert setup.get(f"/alarms?meter={meter}").status_code == 200
    is_problem(setup.get(f"{HISTORY}?meter=zzz"), 404)
    is_problem(setup.get("/alarms?meter=zzz"), 404)
    is_problem(setup.get("/alarms?feeder=zzz"), 404)
    is_problem(setup.get("/alarms?feeder=town&meter=zzz"), 404)
    assert setup.get("/alarms?feeder=town").json()["alarms"] == []
    # A meter that the feeder had is known as long as a kept tick has it.
    setup.service.villages["village"].customers.pop()
    late = {"meter": "H12", "since": T0 + 1000}
    assert setup.get(HISTORY, params=late).json()["points"] == []


def test_head_on_every_get_route(setup: Setup, caplog: pytest.LogCaptureFixture) -> None:
    setup.attack()
    alarm = setup.one()
    ids = {"alarm_id": alarm["id"], "incident_id": alarm["incident"]}
    paths = [
        path.format(feeder="village", meter="H3", **ids)
        for path, methods in setup.get("/openapi.json").json()["paths"].items()
        if "get" in methods
    ]
    assert len(paths) >= 15
    for path in [*paths, "/", "/api/v1/openapi.json", "/app.js"]:
        answer = setup.http.head(path)
        assert (answer.status_code, answer.content) == (200, b""), path
        if "stream" not in path:
            full = setup.http.get(path)
            assert answer.headers["content-type"] == full.headers["content-type"]
    # Streams have ended, and not by an error.
    assert caplog.records == []
    assert setup.server.api.state.streams == 0
    assert setup.http.head("/api/v1/feeders/nowhere").status_code == 404


# ----------------------------------------------------------------- description


def fits(value: object, schema: dict[str, Any], schemas: dict[str, Any]) -> bool:
    """Evaluate the keywords of JSON Schema that the description of a feeder uses."""
    if "$ref" in schema:
        return fits(value, schemas[schema["$ref"].rpartition("/")[2]], schemas)
    if "anyOf" in schema:
        return any(fits(value, each, schemas) for each in schema["anyOf"])
    kinds = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
    types: dict[str, tuple[type, ...]] = {
        "object": (dict,), "array": (list, tuple), "string": (str,), "boolean": (bool,),
        "integer": (int,), "number": (int, float), "null": (type(None),),
    }  # fmt: skip
    known = [kind for kind in kinds if isinstance(value, types[kind])]
    if not known or (isinstance(value, bool) and "boolean" not in kinds):
        return False
    right = value in schema.get("enum", [value])
    if isinstance(value, dict):
        properties = schema.get("properties", {})
        right &= all(name in value for name in schema.get("required", ()))
        right &= all(
            fits(cell, properties[name], schemas) for name, cell in value.items() if name in properties
        )
    elif isinstance(value, (list, tuple)):
        right &= len(value) >= schema.get("minItems", 0)
        right &= all(fits(item, schema["items"], schemas) for item in value)
    elif isinstance(value, (int, float)):
        low, above = schema.get("minimum", value), schema.get("exclusiveMinimum", value - 1)
        right &= low <= value <= schema.get("maximum", value) and value > above
    return right


@pytest.mark.parametrize("name", ["simbench-lv-rural1", "cigre-lv", "ieee-european-lv"])
def test_the_body_of_put_describes_feeders(name: str) -> None:
    schemas = feeder_schemas()
    whole, body = schemas["FeederTables"], json.loads(json.dumps(to_json(load(name).tables)))
    assert fits(body, whole, schemas)
    columns = {column: [row.get(column) for row in body["lines"]] for column in body["lines"][0]}
    assert fits({**body, "lines": columns}, whole, schemas)
    assert not fits({}, whole, schemas)
    assert not fits({**body, "lines": []}, whole, schemas)
    assert not fits({**body, "feeder": {**body["feeder"], "voltage_volt": -230.0}}, whole, schemas)
    assert not fits({**body, "customers": [{"customer": "c1"}]}, whole, schemas)


def test_the_description_names_operations_and_the_body(setup: Setup) -> None:
    schema = setup.get("/openapi.json").json()
    operations = [each for methods in schema["paths"].values() for each in methods.values()]
    names = [each["operationId"] for each in operations]
    assert len(set(names)) == len(names)
    assert {"list_feeders", "put_feeder", "get_history", "list_alarms", "acknowledge"} <= set(names)
    tags = {tag["name"] for tag in schema["tags"]}
    assert all(set(each["tags"]) <= tags and each["tags"] for each in operations)
    put = schema["paths"]["/api/v1/feeders/{feeder}"]["put"]["requestBody"]
    assert put["content"]["application/json"]["schema"] == {"$ref": "#/components/schemas/FeederTables"}
    assert "r_ohm" in schema["components"]["schemas"]["FeederLine"]["required"]
    history = schema["paths"]["/api/v1/feeders/{feeder}/history"]["get"]
    assert set(history["responses"]["200"]["content"]) == set(MEDIA)
