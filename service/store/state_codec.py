"""Versioned JSON encoding of a feeder's persistent state.

The subjects are commissioning, suspicions, observer and signed readings.

Numbers are written with enough digits to restore the same float64, NaN as null. The observer's arrays are
single precision, as base64.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Final, TypeAlias, TypeVar

import msgspec
import numpy as np

from feeders.format.tables import to_json
from feeders.model.site import Site
from gridsec.arrays import Floats
from gridsec.errors import GridsecError
from gridsec.estimators.front import ObserverRecord, SuspicionRecord
from gridsec.estimators.plant import NO_VOLTAGE
from service.access.signing import SignedOrder
from service.report.report import Phase, busbar_phases

FORMAT: Final = 1
"""Version of the text; it increases with a change of its fields."""
_Finite = Annotated[float, msgspec.Meta(gt=-1e300, lt=1e300)]
_Time: TypeAlias = Annotated[float, msgspec.Meta(gt=0.0, lt=1e300)]
# Entries of the feeder's file that concern monitoring and display, not the network.
_BESIDE = ("title", "accept", "busbar_xy", "limits", "monitor")


class SnapshotKind(StrEnum):
    """Subject of a text."""

    COMMISSION = "commission"
    DISTRUST = "distrust"
    OBSERVER = "observer"
    SIGNED = "signed"


class KeptInvalid(GridsecError):
    """A stored text of monitor state cannot be used."""

    code = "state-unusable"


@dataclass(frozen=True, slots=True)
class StateSnapshot:
    """An encoded text of the store."""

    feeder: str
    t: float  # Unix time of its tick, s
    text: str  # result of `encode` or `encode_distrust`
    matter: SnapshotKind = SnapshotKind.COMMISSION  # subject of the text


@dataclass(frozen=True, slots=True)
class MonitorState:
    """Stored state of a feeder's monitor, by subject; None where none is stored."""

    commission: StateSnapshot | None = None
    distrust: StateSnapshot | None = None
    observer: StateSnapshot | None = None


class CommissionRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of the text of a commissioning."""

    format: int  # version of the text
    # feeder, t: as in `StateSnapshot`.
    feeder: str
    t: _Finite
    fingerprint: dict[str, str]  # result of `fingerprint` at that time
    meters: list[str]  # ids, in the order of the arrays
    arrays: dict[str, list[_Finite | None]]  # one number per meter, by name; None for NaN


def fingerprint(site: Site) -> dict[str, str]:
    """Return digests of everything that learned errors depend on, by name.

    Titles, limits, delays of alarms and the like may change without a new commissioning.
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


def encode(site: Site, now: Mapping[str, str], t: float, arrays: Mapping[str, Floats]) -> StateSnapshot:
    """Encode a commissioning. `now` is the feeder's fingerprint, `arrays` has shapes (p,)."""
    name = site.feeder.name
    numbers = {key: [None if math.isnan(x) else x for x in value.tolist()] for key, value in arrays.items()}
    record = CommissionRecord(FORMAT, name, t, dict(now), list(site.meter_ids), numbers)
    return StateSnapshot(name, t, msgspec.json.encode(record).decode())


def decode(site: Site, now: Mapping[str, str], kept: StateSnapshot) -> dict[str, Floats]:
    """Decode a commissioning for the present feeder.

    `now` is the feeder's fingerprint. Returns the arrays of `encode`. Raises KeptInvalid if the text is
    damaged, newer than this program, or of a feeder that has changed since.
    """
    record = _read(site.feeder.name, kept, CommissionRecord)
    changed = [name for name in now if record.fingerprint.get(name) != now[name]]
    if changed:
        raise KeptInvalid(f"the feeder has changed since ({', '.join(changed)})", code="feeder-changed")
    lengths = {len(value) for value in record.arrays.values()}
    if record.meters != list(site.meter_ids) or lengths - {len(record.meters)}:
        raise KeptInvalid("it is damaged: its arrays do not fit its meters", code="other-meters")
    return {
        name: np.array([math.nan if x is None else x for x in value], dtype=np.float64)
        for name, value in record.arrays.items()
    }


class Suspect(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A distrusted meter."""

    meter: str
    scale_s: _Time  # time scale of its detection, s
    named: bool  # True if it was named as manipulated
    # Lag of a replay of its readings, s; None without one. Older texts lack it.
    repeats_s: _Time | None = None


class NamedInverter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An inverter that was named as manipulated."""

    customer: str
    # Index among the inverters of this customer, in the order of the feeder's file.
    number: Annotated[int, msgspec.Meta(ge=0)]


class SuspectBusbarPhase(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A phase with a distrusted busbar meter."""

    phase: Phase | None  # name of the phase; None on a balanced feeder
    # scale_s, named: as in `Suspect`.
    scale_s: _Time
    named: bool
    off: _Finite  # excess of its reading, squared pu


class DistrustRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of the text of suspicions."""

    format: int  # version of the text
    # feeder, t: as in `StateSnapshot`.
    feeder: str
    t: _Finite
    # meters, inverters: distrusted devices.
    meters: list[Suspect]
    inverters: list[NamedInverter]
    # Phases with a distrusted busbar meter; absent in texts of versions that did not test it.
    busbar: list[SuspectBusbarPhase] = []


def encode_distrust(site: Site, t: float, distrust: SuspicionRecord) -> StateSnapshot:
    """Encode suspicions."""
    name, owners = site.feeder.name, _owners(site)
    columns = (distrust.scale_s, distrust.named, distrust.repeats_s)
    meters = zip(*(column.tolist() for column in columns), strict=True)
    suspects = [
        Suspect(site.meter_ids[k], scale, named, None if math.isnan(again) else again)
        for k, (scale, named, again) in enumerate(meters)
        if math.isfinite(scale)
    ]
    deviants = [NamedInverter(*owners[k]) for k in np.flatnonzero(distrust.inverters).tolist()]
    each = zip(
        busbar_phases(site), distrust.busbar_scale_s, distrust.busbar_named, distrust.busbar_off, strict=True
    )
    phases = [
        SuspectBusbarPhase(phase, float(scale), bool(named), float(off))
        for phase, scale, named, off in each
        if math.isfinite(scale)
    ]
    record = DistrustRecord(FORMAT, name, t, suspects, deviants, phases)
    return StateSnapshot(name, t, msgspec.json.encode(record).decode(), SnapshotKind.DISTRUST)


def decode_distrust(site: Site, kept: StateSnapshot) -> SuspicionRecord:
    """Decode suspicions for the meters, inverters and phases of the present feeder.

    Raises KeptInvalid if the text is damaged, newer than this program, or of another feeder.
    """
    record, owners = _read(site.feeder.name, kept, DistrustRecord), _owners(site)
    who = {suspect.meter: suspect for suspect in record.meters}
    if len(who) < len(record.meters):
        raise KeptInvalid("it is damaged: a meter occurs twice", code="duplicate")
    deviants = {(deviant.customer, deviant.number) for deviant in record.inverters}
    found = [who.get(meter) for meter in site.meter_ids]
    off = {phase.phase: phase for phase in record.busbar}
    if len(off) < len(record.busbar):
        raise KeptInvalid("it is damaged: a phase occurs twice", code="duplicate")
    phases = [off.get(phase) for phase in busbar_phases(site)]
    return SuspicionRecord(
        np.array([math.nan if one is None else one.scale_s for one in found], dtype=np.float64),
        np.array([one.repeats_s if one and one.repeats_s else math.nan for one in found], dtype=np.float64),
        np.array([one is not None and one.named for one in found], dtype=np.bool_),
        np.array([owner in deviants for owner in owners], dtype=np.bool_),
        np.array([math.nan if one is None else one.scale_s for one in phases], dtype=np.float64),
        np.array([one is not None and one.named for one in phases], dtype=np.bool_),
        np.array([0.0 if one is None else one.off for one in phases], dtype=np.float64),
    )


_Part: TypeAlias = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
_SINGLE: Final = 1e-6
"""Rounding of an injection to single precision, as a part of its span; at least the true one."""


class ObserverText(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of the text of an observer."""

    format: int  # version of the text
    # feeder, t: as in `StateSnapshot`.
    feeder: str
    t: _Finite
    fingerprint: str  # result of `observer_fingerprint` at that time
    x: bytes  # (m,) injections, pu, float32
    input: bytes  # (m,) squared voltages, pu, float32
    # error, transient: as in `ObserverRecord`.
    error: _Part
    transient: _Part


def observer_fingerprint(site: Site) -> str:
    """Return the digest of everything that an observer depends on: the feeder and its droop curves."""
    droop = site.droop
    curves = (droop.customer, droop.v, droop.q, droop.tau, droop.vbar)
    return _digest([fingerprint(site), *(np.asarray(part).tolist() for part in curves)])


def encode_observer(feeder: str, now: str, record: ObserverRecord) -> StateSnapshot:
    """Encode an observer. `now` is the result of `observer_fingerprint`."""
    x, given = (array.astype("<f4").tobytes() for array in (record.x, record.input))
    error = min(record.error + _SINGLE, 1.0)
    text = ObserverText(FORMAT, feeder, record.t, now, x, given, error, record.transient)
    return StateSnapshot(feeder, record.t, msgspec.json.encode(text).decode(), SnapshotKind.OBSERVER)


def decode_observer(site: Site, now: str, kept: StateSnapshot) -> ObserverRecord:
    """Decode an observer for the present feeder.

    `now` is the result of `observer_fingerprint`. Raises KeptInvalid if the text is damaged, newer than this
    program, or of a feeder that has changed since.
    """
    text, droop = _read(site.feeder.name, kept, ObserverText), site.droop
    if text.fingerprint != now:
        raise KeptInvalid("the feeder has changed since", code="feeder-changed")
    if {len(text.x), len(text.input)} != {4 * droop.tau.size}:
        raise KeptInvalid("it is damaged: its arrays do not fit its inverters", code="damaged")
    x, given = (np.frombuffer(part, dtype="<f4").astype(np.float64) for part in (text.x, text.input))
    room = _SINGLE * droop.limit
    possible = (x >= droop.q.min(axis=1) - room) & (x <= droop.q.max(axis=1) + room)
    if not (possible & (given >= 0.0) & (given <= NO_VOLTAGE)).all():
        raise KeptInvalid("it is damaged: a value is impossible", code="damaged")
    return ObserverRecord(text.t, x, given, text.error, text.transient)


class SignedRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of the text of the newest signed readings."""

    format: int  # version of the text
    # feeder, t: as in `StateSnapshot`.
    feeder: str
    t: _Finite
    meters: list[SignedOrder]


def encode_signed(feeder: str, t: float, orders: Iterable[SignedOrder]) -> StateSnapshot:
    """Encode the newest signed readings of a feeder's meters. `t` is the wall clock, Unix s."""
    record = SignedRecord(FORMAT, feeder, t, list(orders))
    return StateSnapshot(feeder, t, msgspec.json.encode(record).decode(), SnapshotKind.SIGNED)


def decode_signed(feeder: str, kept: StateSnapshot) -> list[SignedOrder]:
    """Decode the newest signed readings of a feeder's meters.

    Raises KeptInvalid if the text is damaged, newer than this program, or of another feeder.
    """
    return _read(feeder, kept, SignedRecord).meters


def _owners(site: Site) -> list[tuple[str, int]]:
    """Customer of every inverter, and its index among the inverters of that customer."""
    count: Counter[str] = Counter()
    owners = []
    for name in (site.feeder.customers[k] for k in site.droop.customer):
        owners.append((name, count[name]))
        count[name] += 1
    return owners


class _Version(msgspec.Struct, frozen=True):
    """Common part of all versions of the text."""

    format: Annotated[int, msgspec.Meta(ge=1)]


_Text = TypeVar("_Text", CommissionRecord, DistrustRecord, ObserverText, SignedRecord)


def _read(feeder: str, kept: StateSnapshot, kind: type[_Text]) -> _Text:
    """Return the contents of a text of this feeder."""
    try:
        version = msgspec.json.decode(kept.text, type=_Version).format
        if version > FORMAT:
            text = f"its format is {version}; this program supports formats up to {FORMAT}"
            raise KeptInvalid(text, code="newer-format")
        record = msgspec.json.decode(kept.text, type=kind)
    except msgspec.DecodeError as error:
        raise KeptInvalid(f"it is damaged: {error}", code="damaged") from error
    if record.feeder != feeder:
        raise KeptInvalid(f"it belongs to feeder {record.feeder!r}", code="other-feeder")
    return record


def _digest(part: Any) -> str:
    text = json.dumps(part, sort_keys=True, allow_nan=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
