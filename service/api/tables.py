"""History, series and alarms as CSV, Parquet and Arrow IPC streams, chosen by the header `Accept`.

Each time column has a twin `<name>_utc`: a timestamp in UTC, in CSV as in RFC 3339.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import pyarrow as pa

from service.alarms.incidents import Incident, incident_json
from service.alarms.state_machine import Alarm, to_json
from service.store.series import EXTREMES, VERDICTS, Series

JSON: Final = "application/json"
CSV: Final = "text/csv"
PARQUET: Final = "application/vnd.apache.parquet"
ARROW: Final = "application/vnd.apache.arrow.stream"
MEDIA: Final = (JSON, CSV, PARQUET, ARROW)
"""Types of a response, the preferred one first."""

_TIME, _NUMBER, _TEXT, _TRUE = "time", pa.float64(), pa.string(), pa.bool_()
_HISTORY: dict[str, Any] = {
    "t": _TIME,
    "verdict": _TEXT,
    "cause": _TEXT,
    "seen": pa.int64(),
    "suspects": pa.list_(_TEXT),
    "v_volt_lowest": _NUMBER,
    "v_volt_highest": _NUMBER,
    "model_only": _TRUE,
}
_METER: dict[str, Any] = {
    "meter": _TEXT,
    "meter_seen": _TRUE,
    "meter_suspect": _TRUE,
    "v_volt_reported": _NUMBER,
    "v_volt_estimated": _NUMBER,
    "v_volt_std": _NUMBER,
    "score": _NUMBER,
    "threshold": _NUMBER,
    "meter_model_only": _TRUE,
}
_SERIES: dict[str, Any] = {
    "t": _TIME,
    "bucket_s": _NUMBER,
    "ticks": pa.int64(),
    **{f"{verdict}_s": _NUMBER for verdict in VERDICTS},
    "meter": _TEXT,
    "meter_seen": _TRUE,
    "meter_suspect": _TRUE,
    **dict.fromkeys(EXTREMES, _NUMBER),
}
_ALARMS: dict[str, Any] = {
    "id": _TEXT,
    "kind": _TEXT,
    "feeder": _TEXT,
    "meter": _TEXT,
    "customer": _TEXT,
    "severity": _TEXT,
    "state": _TEXT,
    "count": pa.int64(),
    "t_event": _TIME,
    "t_raised": _TIME,
    "t_cleared": _TIME,
    "reason": _TEXT,
    "acknowledged_by": _TEXT,
    "t_acknowledged": _TIME,
    "comment": _TEXT,
    "evidence": _TEXT,
    "incident": _TEXT,
    "shelved_until": _TIME,
    "planned_work": _TEXT,
}
_INCIDENTS: dict[str, Any] = {
    "id": _TEXT,
    "kind": _TEXT,
    "feeder": _TEXT,
    "severity": _TEXT,
    "state": _TEXT,
    "count": pa.int64(),
    "alarms": pa.int64(),
    "active": pa.int64(),
    "unacknowledged": pa.int64(),
    "kinds": pa.list_(_TEXT),
    "meters": pa.list_(_TEXT),
    "customers": pa.list_(_TEXT),
    "t_first": _TIME,
    "t_last": _TIME,
    "t_cleared": _TIME,
    "reason": _TEXT,
    "acknowledged_by": _TEXT,
    "t_acknowledged": _TIME,
    "assigned_to": _TEXT,
    "comments": pa.int64(),
    "shelved_until": _TIME,
    "planned_work": _TEXT,
    "planned_until": _TIME,
}
_FORMULA: Final = r"^([=+\-@\t\r])"
"""Begin of a text that a spreadsheet evaluates as a formula (OWASP, CSV injection)."""
_PREFIXED: Final = ("seen", "suspect", "model_only")
"""Fields of a meter with the name of a field of the whole feeder."""


def preferred(accept: str) -> str | None:
    """Return the type of `MEDIA` that a header `Accept` prefers, or None if it accepts none of them.

    A more specific range takes precedence; of equal weights the first of `MEDIA`.
    """
    ranges: dict[str, float] = {}
    for part in accept.split(",") if accept.strip() else ["*/*"]:
        name, *parameters = (piece.strip().lower() for piece in part.split(";"))
        weight = next((each[2:] for each in parameters if each.startswith("q=")), "1")
        try:
            ranges[name] = float(weight)
        except ValueError:
            ranges[name] = 0.0

    def weight_of(media: str) -> float:
        either = (media, media.partition("/")[0] + "/*", "*/*")
        return next((ranges[name] for name in either if name in ranges), 0.0)

    best = max(MEDIA, key=weight_of)
    return best if weight_of(best) > 0.0 else None


def history(points: Iterable[Mapping[str, Any]], meter: str | None) -> pa.Table:
    """Return stored ticks as a table, with the columns of a requested meter."""
    rows = []
    for point in points:
        one = point["meter"] or {}
        own = {f"meter_{name}" if name in _PREFIXED else name: value for name, value in one.items()}
        rows.append({**point, **own, "meter": one.get("meter")})
    return _table(rows, _HISTORY | (_METER if meter is not None else {}))


def series(found: Series) -> dict[str, Any]:
    """Return the buckets of a series as fields of `models.Series`."""
    buckets = found.buckets
    meters = [
        {
            "meter": meter,
            **{name: _volts(buckets.extremes[:, e, k]) for e, name in enumerate(EXTREMES)},
            "seen": buckets.seen[:, k].tolist(),
            "suspect": buckets.suspect[:, k].tolist(),
        }
        for k, meter in enumerate(found.meters)
    ]
    return {
        "since": found.since,
        "until": found.until,
        "bucket_s": found.bucket_s,
        "step_s": found.step_s,
        "complete": found.complete,
        "t": buckets.t.tolist(),
        "ticks": [int(count) for count in buckets.ticks.tolist()],
        **{f"{v}_s": [round(s, 3) for s in buckets.verdict_s[:, k].tolist()] for k, v in enumerate(VERDICTS)},
        "meters": meters,
    }


def _volts(values: Any) -> list[float | None]:
    """Return voltages of single precision to a millivolt, or at 10 kV and above to 10 mV; None for NaN."""
    return [round(v, 3 if abs(v) < 1e4 else 2) if math.isfinite(v) else None for v in values.tolist()]


def series_table(fields: Mapping[str, Any]) -> pa.Table:
    """Return the fields of `series` as a table: a row for each bucket and meter."""
    common = ("t", "ticks", *(f"{verdict}_s" for verdict in VERDICTS))
    rows = [
        {
            **{name: fields[name][j] for name in common},
            "bucket_s": fields["bucket_s"],
            "meter": one["meter"],
            "meter_seen": one["seen"][j],
            "meter_suspect": one["suspect"][j],
            **{name: one[name][j] for name in EXTREMES},
        }
        for j in range(len(fields["t"]))
        for one in fields["meters"]
    ]
    return _table(rows, _SERIES)


def incidents(found: Iterable[Incident]) -> pa.Table:
    """Return incidents as a table."""
    return _table([incident_json(incident) for incident in found], _INCIDENTS)


def alarms(found: Sequence[Alarm]) -> pa.Table:
    """Return alarms as a table; the column `evidence` is JSON."""
    shown = ("incident", "shelved_until", "planned_work")
    rows = [to_json(alarm) | {name: getattr(alarm, name, None) for name in shown} for alarm in found]
    texts = [{**row, "evidence": json.dumps(row["evidence"], ensure_ascii=False)} for row in rows]
    return _table(texts, _ALARMS)


def _table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Any]) -> pa.Table:
    arrays: dict[str, pa.Array] = {}
    for name, kind in columns.items():
        cells = [row.get(name) for row in rows]
        arrays[name] = pa.array(cells, _NUMBER if kind is _TIME else kind)
        if kind is _TIME:
            thousandths = [None if cell is None else round(1e3 * cell) for cell in cells]
            arrays[f"{name}_utc"] = pa.array(thousandths, pa.timestamp("ms", "UTC"))
    return pa.table(arrays)


def encoded(table: pa.Table, media: str) -> bytes:
    """Return a table in one of `MEDIA` other than JSON."""
    out = io.BytesIO()
    if media == PARQUET:
        from pyarrow import parquet

        parquet.write_table(table, out, compression="zstd")
    elif media == CSV:
        from pyarrow import csv

        csv.write_csv(_flat(table), out)
    else:
        with pa.ipc.new_stream(out, table.schema) as stream:
            stream.write_table(table)
    return out.getvalue()


def _flat(table: pa.Table) -> pa.Table:
    """Replace lists by texts with semicolons, and timestamps by texts as in RFC 3339; escape formulas."""
    from pyarrow import compute

    escaped = partial(compute.replace_substring_regex, pattern=_FORMULA, replacement=r"'\1")
    texts: dict[Callable[[Any], bool], Callable[[Any], Any]] = {
        pa.types.is_timestamp: partial(compute.strftime, format="%Y-%m-%dT%H:%M:%SZ"),
        pa.types.is_list: lambda column: escaped(compute.binary_join(column, ";")),
        pa.types.is_string: escaped,
    }
    for k, field in enumerate(table.schema):
        for is_kind, made in texts.items():
            if is_kind(field.type):
                table = table.set_column(k, field.name, made(table.column(k)))
    return table
