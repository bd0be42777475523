"""Signatures of readings: a meter's key, and an order that excludes repetitions.

The attachment of a sample is `v1 SCHEME EPOCH:SEQ SIGNATURE` with the scheme `ed25519` or `hmac` (HMAC with
SHA-256) and the signature in base64. The signature is over `v1 SCHEME EPOCH:SEQ KEY`, a line feed, and the
payload. The pair (epoch, seq) of a meter increases from reading to reading, also over a restart.
"""

from __future__ import annotations

import base64
import binascii
import csv
import hashlib
import hmac
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from gridsec.errors import InputInvalid, Problem
from service.errors import prefixed

BUSBAR = "substation"
ATTACHMENT_MAX = 256
"""Size of the longest attachment that is read, bytes."""

DIGEST_BYTES = 8
"""Size of the digest of a key, bytes: two keys of one meter are equal in it with probability 2^-64."""

SECRET_MIN = 16
"""Size of the shortest secret, bytes."""

COLUMNS = ("feeder", "meter", "scheme", "key")
_ATTACHMENT = re.compile(rb"v1 (ed25519|hmac) ([0-9]{1,19}):([0-9]{1,19}) ([A-Za-z0-9+/]{43,86}={1,2})")


class Scheme(StrEnum):
    """Proof of a reading's origin: a signature, or the certificate of the sender's connection."""

    ED25519 = "ed25519"
    HMAC = "hmac"
    CERTIFICATE = "certificate"


class Refusal(NamedTuple):
    """Reason (`signature` or `replayed`) and sentence of a refused reading."""

    reason: str
    problem: str


class SignedOrder(NamedTuple):
    """The newest accepted reading of a meter with a key of its own."""

    meter: str
    key: str  # digest of the key: another key begins anew
    epoch: int
    seq: int


@dataclass(frozen=True, slots=True)
class _Entry:
    scheme: Scheme
    verifies: Callable[[bytes, bytes], bool]
    certificate: str = ""
    digest: str = ""


@dataclass(slots=True)
class MeterKeys:
    """Keys of meters, and the newest (epoch, seq) of each.

    Attributes
    ----------
    accepts_unlisted
        Accept readings of meters without a key.
    changed
        Feeders with accepted signed readings that are not stored.
    """

    entries: Mapping[tuple[str, str], _Entry]
    accepts_unlisted: bool = False
    changed: set[str] = field(default_factory=set)
    # By feeder and meter.
    _newest: dict[str, dict[str, tuple[int, int]]] = field(default_factory=dict)

    def orders(self, feeder: str) -> list[SignedOrder]:
        """Return the newest accepted readings of a feeder's meters."""
        return [
            SignedOrder(meter, self.entries[feeder, meter].digest, *newest)
            for meter, newest in self._newest.get(feeder, {}).items()
        ]

    def restore(self, feeder: str, orders: Iterable[SignedOrder]) -> None:
        """Take over the newest readings of an earlier process, of meters that have the same key."""
        newest = self._newest.setdefault(feeder, {})
        for meter, digest, *order in orders:
            entry = self.entries.get((feeder, meter))
            if entry is not None and entry.digest == digest:
                newest[meter] = max(newest.get(meter, (-1, -1)), (order[0], order[1]))

    def check(
        self, feeder: str, meter: str | None, key: str, payload: bytes, attachment: bytes
    ) -> Refusal | None:
        """Return the reason to refuse a reading, or None.

        Parameters
        ----------
        meter
            None for the busbar meter.
        key
            zenoh key of the sample.
        """
        source = BUSBAR if meter is None else meter
        entry = self.entries.get((feeder, source))
        if entry is None:
            return None if self.accepts_unlisted else Refusal("signature", "the meter has no key in the list")
        sender = _concentrator(key)
        if entry.scheme is Scheme.CERTIFICATE:
            text = f"the meter belongs to {entry.certificate}, not to {sender}"
            return None if sender in (None, entry.certificate) else Refusal("signature", text)
        if sender is not None:
            return Refusal("signature", "a meter with a key of its own has no place in a batch")
        order = _signed_order(entry, key, payload, attachment)
        if isinstance(order, str):
            return Refusal("signature", order)
        orders = self._newest.setdefault(feeder, {})
        newest = orders.get(source, (-1, -1))
        if order <= newest:
            text = f"epoch:seq is {order[0]}:{order[1]}, not after {newest[0]}:{newest[1]}"
            return Refusal("replayed", text)
        orders[source] = order
        self.changed.add(feeder)
        return None


def _signed_order(entry: _Entry, key: str, payload: bytes, attachment: bytes) -> tuple[int, int] | str:
    """Epoch and seq of a reading with a valid signature; otherwise the problem."""
    found = _ATTACHMENT.fullmatch(attachment)
    if found is None:
        text = "the attachment has another form" if attachment else "the reading has no attachment"
        return f"{text}; expected `v1 {entry.scheme} EPOCH:SEQ SIGNATURE`"
    if found[1].decode() != entry.scheme:
        return f"the scheme is {found[1].decode()}, not {entry.scheme}"
    try:
        signature = base64.b64decode(found[4], validate=True)
    except binascii.Error:
        return "the signature is not base64"
    order = int(found[2]), int(found[3])
    if not entry.verifies(signature, signed_bytes(entry.scheme, *order, key, payload)):
        return "the signature does not fit key, epoch, seq and payload"
    return order


def signed_bytes(scheme: str, epoch: int, seq: int, key: str, payload: bytes) -> bytes:
    """Return the bytes that a signature covers."""
    return f"v1 {scheme} {epoch}:{seq} {key}\n".encode() + payload


def table_rows(path: Path) -> list[tuple[str, ...]]:
    """Read the rows of a table of keys: feeder, meter, scheme, key.

    Raises
    ------
    InputInvalid
        If the file cannot be read, or lacks a column.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            lacking = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
            if lacking:
                raise InputInvalid([Problem("missing", f"{path}: no column {', '.join(lacking)}")])
            return [tuple((row[name] or "").strip() for name in COLUMNS) for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputInvalid([Problem("unreadable", f"{path} cannot be read: {error}")]) from error


def read_meter_keys(path: Path, *, accepts_unlisted: bool) -> MeterKeys:
    """Read a table with the columns feeder, meter, scheme, key (base64, or the name of a certificate).

    Raises
    ------
    InputInvalid
        With every problem of the table.
    """
    lines = table_rows(path)
    entries: dict[tuple[str, str], _Entry] = {}
    problems: list[Problem] = []
    seen: set[tuple[str, str]] = set()
    for number, (feeder, meter, scheme, key) in enumerate(lines, start=2):
        place = f"{path}, line {number}: "
        if (feeder, meter) in seen:
            problems.append(Problem("duplicate", f"{place}{feeder}, {meter} has a key already"))
        seen.add((feeder, meter))
        try:
            entries[feeder, meter] = _entry(scheme, key)
        except InputInvalid as error:
            problems += [prefixed(place, one) for one in error.problems]
    if problems:
        raise InputInvalid(problems)
    return MeterKeys(entries, accepts_unlisted)


def _entry(scheme: str, key: str) -> _Entry:
    if scheme == Scheme.CERTIFICATE:
        if not key:
            raise InputInvalid([Problem("wrong-key", "the name of the certificate is missing")])
        return _Entry(Scheme.CERTIFICATE, _never, key)
    if scheme not in (Scheme.ED25519, Scheme.HMAC):
        text = f"{scheme!r} is not a scheme; expected one of {', '.join(Scheme)}"
        raise InputInvalid([Problem("unknown-name", text)])
    try:
        raw = base64.b64decode(key, validate=True)
    except (binascii.Error, ValueError) as error:
        raise InputInvalid([Problem("wrong-key", "the key is not base64")]) from error
    if scheme == Scheme.HMAC:
        if len(raw) < SECRET_MIN:
            text = f"the secret has {len(raw)} bytes; expected at least {SECRET_MIN}"
            raise InputInvalid([Problem("wrong-key", text)])
        return _Entry(Scheme.HMAC, _hmac_of(raw), digest=_digest(raw))
    try:
        public = Ed25519PublicKey.from_public_bytes(raw)
        return _Entry(Scheme.ED25519, _ed25519_of(public), digest=_digest(raw))
    except ValueError as error:
        text = f"the public key has {len(raw)} bytes; expected 32"
        raise InputInvalid([Problem("wrong-key", text)]) from error


def _digest(key: bytes) -> str:
    """Digest that tells keys apart, and from which no key can be computed."""
    return hmac.digest(key, b"gridsec signed order", hashlib.sha256)[:DIGEST_BYTES].hex()


def _never(_signature: bytes, _content: bytes) -> bool:
    return False


def _hmac_of(secret: bytes) -> Callable[[bytes, bytes], bool]:
    def verifies(signature: bytes, content: bytes) -> bool:
        return hmac.compare_digest(signature, hmac.digest(secret, content, hashlib.sha256))

    return verifies


def _ed25519_of(public: Ed25519PublicKey) -> Callable[[bytes, bytes], bool]:
    def verifies(signature: bytes, content: bytes) -> bool:
        try:
            public.verify(signature, content)
        except InvalidSignature:
            return False
        return True

    return verifies


def _concentrator(key: str) -> str | None:
    """Name of the concentrator in the key of a batch; None for the key of a single reading."""
    chunks = key.rsplit("/", 3)
    return chunks[2] if len(chunks) == 4 and chunks[1] == "concentrator" and chunks[3] == "readings" else None
