"""What is kept of a feeder's commissioning: a typed, versioned JSON text, and whether it still fits.

Numbers are written with as many digits as give the same float64 back, NaN as null.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from feeders.load import Site
from feeders.schema import to_json
from gridsec.arrays import Floats
from gridsec.errors import GridsecError

FORMAT: Final = 1
"""Version of the text; it changes when its fields do."""
_Finite = Annotated[float, msgspec.Meta(gt=-1e300, lt=1e300)]
# Of the feeder's file, what says how it is watched and shown, not what it is.
_BESIDE = ("title", "accept", "busbar_xy", "limits", "monitor")


class KeptInvalid(GridsecError):
    """A kept text cannot be used; the message says why."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A text of the store, as it is.

    Attributes
    ----------
    feeder
        Whose.
    t
        Unix time of the tick that it belongs to, s.
    text
        What `encode` wrote.
    """

    feeder: str
    t: float
    text: str


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the text holds.

    Attributes
    ----------
    format
        Its version.
    feeder, t
        As in `Kept`.
    fingerprint
        What the feeder was, see `fingerprint`.
    meters
        Ids, in the order of the arrays.
    arrays
        One number per meter, by name; None for NaN.
    """

    format: int
    feeder: str
    t: _Finite
    fingerprint: dict[str, str]
    meters: list[str]
    arrays: dict[str, list[_Finite | None]]


def fingerprint(site: Site) -> dict[str, str]:
    """Return what learned errors depend on, as digests by the name of what they are of.

    Titles, limits, delays of alarms and the like may change without a new commissioning.

    Parameters
    ----------
    site
        The feeder.
    """
    tables = to_json(site.tables)
    meta, monitor = tables["feeder"], site.tables.meta.monitor
    parts = {
        "meters": list(site.meter_ids),
        "lines": tables["lines"],
        "customers": tables["customers"],
        "feeder.toml": {name: value for name, value in meta.items() if name not in _BESIDE},
        "estimator": monitor.estimator,
        "commission_s": monitor.commission_s,
    }
    return {name: _digest(part) for name, part in parts.items()}


def encode(site: Site, now: Mapping[str, str], t: float, arrays: Mapping[str, Floats]) -> Kept:
    """Write a text.

    Parameters
    ----------
    site, now
        The feeder, and its fingerprint.
    t
        Unix time of the tick, s.
    arrays : of (p,)
        What is to be kept, by name.
    """
    name = site.feeder.name
    numbers = {key: [None if math.isnan(x) else x for x in value.tolist()] for key, value in arrays.items()}
    record = Record(FORMAT, name, t, dict(now), list(site.meter_ids), numbers)
    return Kept(name, t, msgspec.json.encode(record).decode())


def decode(site: Site, now: Mapping[str, str], kept: Kept) -> dict[str, Floats]:
    """Read a text for the feeder as it is now.

    Parameters
    ----------
    site, now, kept
        The feeder, its fingerprint, and the text.

    Returns
    -------
    dict of (p,) arrays
        What `encode` was given.

    Raises
    ------
    KeptInvalid
        If the text is damaged, newer than this program, or of a feeder that has changed since.
    """
    try:
        version = msgspec.json.decode(kept.text, type=_Version).format
        if version > FORMAT:
            raise KeptInvalid(f"it is of format {version}, and this program knows {FORMAT}")
        record = msgspec.json.decode(kept.text, type=Record)
    except msgspec.DecodeError as error:
        raise KeptInvalid(f"it is damaged: {error}") from error
    if record.feeder != site.feeder.name:
        raise KeptInvalid(f"it is of feeder {record.feeder!r}")
    changed = [name for name in now if record.fingerprint.get(name) != now[name]]
    if changed:
        raise KeptInvalid(f"the feeder has changed since ({', '.join(changed)})")
    lengths = {len(value) for value in record.arrays.values()}
    if record.meters != list(site.meter_ids) or lengths - {len(record.meters)}:
        raise KeptInvalid("it is damaged: its numbers do not belong to its meters")
    return {
        name: np.array([math.nan if x is None else x for x in value], dtype=np.float64)
        for name, value in record.arrays.items()
    }


class _Version(msgspec.Struct, frozen=True):
    """What every version of the text has."""

    format: Annotated[int, msgspec.Meta(ge=1)]


def _digest(part: Any) -> str:
    text = json.dumps(part, sort_keys=True, allow_nan=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
