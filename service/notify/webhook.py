"""Messages of Standard Webhooks: https://www.standardwebhooks.com, version v1 with HMAC-SHA256.

    signature = base64(HMAC-SHA256(secret, id "." timestamp "." body))

The id is the same at every attempt, so that a receiver can drop repetitions. The timestamp is that of the
attempt, so that a receiver can refuse old requests.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import secrets
from datetime import UTC, datetime
from typing import Final

from service.notify.notices import Notice

PREFIX: Final = "whsec_"
"""Beginning of a secret."""
SECRET_BYTES: Final = 32
"""Size of a new secret, bytes."""
_SIZES: Final = range(24, 65)
"""Permitted sizes of a secret, bytes, as in the specification."""


def new_secret() -> str:
    """Return a new random secret."""
    return PREFIX + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()


def secret_bytes(text: str) -> bytes | None:
    """Return the bytes of a secret; None if the text is not one."""
    if not text.startswith(PREFIX):
        return None
    try:
        found = base64.b64decode(text.removeprefix(PREFIX), validate=True)
    except (binascii.Error, ValueError):
        return None
    return found if len(found) in _SIZES else None


def body_of(notice: Notice) -> str:
    """Return the message of a notice: type, time (RFC 3339) and data."""
    when = datetime.fromtimestamp(notice.t, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    message = {"type": notice.type, "timestamp": when, "data": notice.data}
    return json.dumps(message, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def headers_of(secret: bytes, message_id: str, body: bytes, now: float) -> dict[str, str]:
    """Return the headers of a request, with its signature.

    secret: bytes of the secret.
    message_id: id of the message.
    body: body of the request.
    now: Unix time of the attempt, s.
    """
    timestamp = str(int(now))
    return {
        "webhook-id": message_id,
        "webhook-timestamp": timestamp,
        "webhook-signature": f"v1,{signature(secret, message_id, timestamp, body)}",
    }


def signature(secret: bytes, message_id: str, timestamp: str, body: bytes) -> str:
    """Return the signature of a message, base64."""
    content = f"{message_id}.{timestamp}.".encode() + body
    return base64.b64encode(hmac.digest(secret, content, hashlib.sha256)).decode()
