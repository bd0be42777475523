"""API keys: 256 random bits, stored as SHA-256.

A key is ``gridsec_<id>_<secret>``. The id finds the record and may be shown. The secret has 256 random
bits. A plain SHA-256 suffices: no dictionary contains it, and a slow hash would only slow down requests.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from dataclasses import dataclass

from service.access.identity import Identity, Role

SECRET_BYTES = 32
ID_BYTES = 5
_KEY = re.compile(r"^gridsec_(?P<id>[0-9a-f]{10})_(?P<secret>[A-Za-z0-9_-]{43})$")


@dataclass(frozen=True, slots=True)
class KeyRecord:
    """Stored properties of a key."""

    id: str  # public part of the key
    digest: str  # SHA-256 of the secret, hexadecimal
    name: str  # name of the identity
    # role, feeders: its role, and its feeders or None for all
    role: Role
    feeders: frozenset[str] | None
    # created, expires, revoked: Unix times, s; None for a key without an end, and for one that is not revoked
    created: float
    expires: float | None = None
    revoked: float | None = None

    def ended(self, now: float) -> str | None:
        """Reason why the key is not valid, or None.

        now: Unix time, s.
        """
        if self.revoked is not None:
            return "the key is revoked"
        return None if self.expires is None or now < self.expires else "the key has expired"

    @property
    def identity(self) -> Identity:
        """Identity of requests with this key."""
        return Identity(self.name, self.role, self.feeders, f"key {self.id}")


def create(
    name: str, role: Role, feeders: frozenset[str] | None, now: float, expires: float | None
) -> tuple[str, KeyRecord]:
    """Create a key; its text is stored nowhere.

    name, role, feeders: identity of the key.
    now, expires: present time, and end of the key or None, Unix s.
    Returns text, record: the key and what is stored of it.
    """
    key_id, secret = secrets.token_hex(ID_BYTES), secrets.token_urlsafe(SECRET_BYTES)
    return f"gridsec_{key_id}_{secret}", KeyRecord(key_id, digest(secret), name, role, feeders, now, expires)


def parse(text: str) -> tuple[str, str] | None:
    """Id and secret of a key, or None for a text of another form."""
    found = _KEY.match(text)
    return None if found is None else (found["id"], found["secret"])


def digest(secret: str) -> str:
    """SHA-256 of a secret, hexadecimal."""
    return hashlib.sha256(secret.encode()).hexdigest()


def matches(record: KeyRecord, secret: str) -> bool:
    """True if the secret is that of the record; in constant time."""
    return hmac.compare_digest(record.digest, digest(secret))
