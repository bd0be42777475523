"""OpenAPI description of a feeder's JSON form, from the declarations of the columns."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from feeders.format.columns import (
    CUSTOMER_COLUMNS,
    LINE_COLUMNS,
    META_COLUMNS,
    REQUIRED,
    SECTIONS,
    Column,
    Names,
    Number,
    Pair,
    Truth,
    Whole,
)
from feeders.util import plain

BODY = "FeederTables"
"""Name of the schema of a whole feeder."""

TAGS = [
    {"name": "feeders", "description": "Feeders: verdicts, history, commissioning, and changes of the set."},
    {"name": "alarms", "description": "Alarms, their events, and acknowledgement."},
    {
        "name": "incidents",
        "description": "Incidents of alarms, shelves, planned work, hand-over of the shift.",
    },
    {"name": "streams", "description": "Server-sent events."},
    {"name": "notifications", "description": "Targets of notifications, and messages that were given up."},
    {"name": "access", "description": "Identity of the caller, sessions of the web page, audit log."},
    {"name": "operations", "description": "Probes, metrics and rejected readings."},
]
"""Tags of the routes."""


def feeder_schemas() -> dict[str, dict[str, Any]]:
    """Return the schemas of a feeder, its file `feeder.toml` and its two tables, by name."""
    sections = {name: _object(META_COLUMNS[name], f"Section [{name}].") for name in SECTIONS}
    meta = _object(META_COLUMNS[""], "Content of feeder.toml.")
    meta["properties"] |= sections
    return {
        "FeederFile": meta,
        "FeederLine": _object(LINE_COLUMNS, "A row of lines.csv."),
        "FeederCustomer": _object(CUSTOMER_COLUMNS, "A row of customers.csv."),
        BODY: {
            "type": "object",
            "title": BODY,
            "description": "A feeder. A table is a list of rows, or an object of equally long columns.",
            "required": ["feeder", "lines", "customers"],
            "properties": {
                "feeder": {"$ref": "#/components/schemas/FeederFile"},
                "lines": _rows("FeederLine", LINE_COLUMNS),
                "customers": _rows("FeederCustomer", CUSTOMER_COLUMNS),
            },
        },
    }


def _rows(name: str, columns: Iterable[Column]) -> dict[str, Any]:
    """Schema of a table in both forms."""
    lists = {column.name: {"type": "array", "items": _cell(column)} for column in columns}
    required = [column.name for column in columns if column.default is REQUIRED]
    return {
        "anyOf": [
            {"type": "array", "minItems": 1, "items": {"$ref": f"#/components/schemas/{name}"}},
            {"type": "object", "required": required, "properties": lists},
        ]
    }


def _object(columns: Iterable[Column], description: str) -> dict[str, Any]:
    return {
        "type": "object",
        "description": description,
        "required": [column.name for column in columns if column.default is REQUIRED],
        "properties": {column.name: _cell(column) for column in columns},
    }


def _cell(column: Column) -> dict[str, Any]:
    """Schema of a cell; null stands for the default."""
    found: dict[str, Any] = {"description": f"{column.meaning}; {column.right}"}
    kind = "string"
    if isinstance(column, Number):
        kind = "integer" if isinstance(column, Whole) else "number"
        limits = {"minimum": column.low, "maximum": column.high, "exclusiveMinimum": column.above}
        found |= {name: limit for name, limit in limits.items() if limit is not None}
    elif isinstance(column, Truth):
        kind = "boolean"
    elif isinstance(column, Pair):
        kind = "array"
        found |= {"items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    elif isinstance(column, Names):
        kind = "array"
        found["items"] = {"type": "string", "enum": list(column.choices or ())}
    elif column.choices is not None:
        found["enum"] = [*column.choices, *([] if column.default is REQUIRED else [None])]
    if column.default is REQUIRED:
        return {"type": kind, **found}
    return {"type": [kind, "null"], **found, "default": plain(column.default)}
