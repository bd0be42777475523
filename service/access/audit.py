"""Audit log: a chain of entries, each with the SHA-256 of its content and of the previous entry.

    hash_n = SHA-256(canonical JSON of [seq, t, identity, credential, action, target, detail, hash_(n-1)])

A changed, inserted or removed entry breaks the chain at its place. Removed last entries leave a valid
shorter chain: `gridsec audit verify` prints the number and hash of the last entry, and `--expect` compares
an entry with a number and hash that were kept elsewhere.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Final

from service.times import UtcTwins

START: Final = "0" * 64
"""Previous hash of the first entry."""


@dataclass(frozen=True, slots=True)
class AuditEntry(UtcTwins):
    """Entry of the audit log."""

    seq: int  # number, from 1 without gaps
    t: float  # Unix time, s
    # identity, credential: name of the identity, and the credential that proved it
    identity: str
    credential: str
    # action, target: action, such as `POST /api/v1/alarms/{alarm_id}/ack`, and the resource
    action: str
    target: str
    detail: str  # further text, such as the body of the request
    # previous, hash: hash of the previous entry and of this one, hexadecimal
    previous: str
    hash: str

    def to_json(self) -> dict[str, Any]:
        """Fields by name."""
        return asdict(self)


def chained(  # noqa: PLR0917  # the columns of an entry
    last: AuditEntry | None, t: float, identity: str, credential: str, action: str, target: str, detail: str
) -> AuditEntry:
    """Entry that follows the last one.

    last: the last entry; None for an empty log.
    t, identity, credential, action, target, detail: as in `AuditEntry`.
    """
    seq, previous = (1, START) if last is None else (last.seq + 1, last.hash)
    entry = AuditEntry(seq, t, identity, credential, action, target, detail, previous, "")
    return AuditEntry(seq, t, identity, credential, action, target, detail, previous, content_hash(entry))


def content_hash(entry: AuditEntry) -> str:
    """Hash of an entry's content."""
    content = (
        entry.seq,
        entry.t,
        entry.identity,
        entry.credential,
        entry.action,
        entry.target,
        entry.detail,
        entry.previous,
    )
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def broken(entries: Iterable[AuditEntry], expect: tuple[int, str] | None = None) -> str | None:
    """First violation of the chain as a sentence, or None.

    entries: all entries in ascending order of their numbers.
    expect: number and hash of an entry that must be in the log; None for no such check.
    """
    seq, previous, found = 0, START, expect is None
    for entry in entries:
        if entry.seq != seq + 1:
            return f"entry {entry.seq} follows entry {seq}: entries are missing"
        if entry.previous != previous:
            return f"entry {entry.seq} does not follow the present entry {seq}: one of them was replaced"
        if entry.hash != content_hash(entry):
            return f"entry {entry.seq} was changed after it was written"
        if expect is not None and entry.seq == expect[0]:
            if entry.hash != expect[1]:
                return f"entry {entry.seq} has the hash {entry.hash}, not the expected {expect[1]}"
            found = True
        seq, previous = entry.seq, entry.hash
    return None if found or expect is None else f"the log ends at entry {seq}; entry {expect[0]} is missing"
