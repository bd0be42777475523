"""Signed messages between the processes of a cluster.

A zenoh client may publish on any key that the router permits. Each message therefore has an HMAC-SHA256 by a
secret that only readers of the database know. The tag covers the purpose and the key, so that a message of
one worker is not valid for another one. A message older than `FRESH_S` is refused.
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections.abc import Callable
from typing import Any, Final

import cbor2

from gridsec.errors import GridsecError

FRESH_S: Final = 30.0
"""Largest age of a message, s: above the difference of the clocks of two machines of a cluster."""
_TAG: Final = 32
"""Length of the tag, bytes."""


class MessageRefused(GridsecError):
    """A message of the cluster is damaged, old, repeated or not signed with the secret of the database."""

    code = "message-refused"


class Envelope:
    """Encoding of messages, CBOR with a tag in front. Thread-safe.

    secret: secret of the cluster.
    wall: wall clock, Unix s.
    """

    def __init__(self, secret: bytes, wall: Callable[[], float] = time.time) -> None:
        self._secret, self._wall = secret, wall
        self._seen: dict[str, float] = {}

    def seal(self, purpose: str, content: dict[str, Any]) -> bytes:
        """Return a message. `purpose` names the key and the direction."""
        body = cbor2.dumps({"t": self._wall(), "id": secrets.token_hex(8), **content})
        return self._tag(purpose, body) + body

    def open(self, purpose: str, message: bytes, *, once: bool = False) -> dict[str, Any]:
        """Return the content of a message; with `once` a second one with its id is refused.

        Raises MessageRefused if it is not valid.
        """
        tag, body = message[:_TAG], message[_TAG:]
        if not hmac.compare_digest(tag, self._tag(purpose, body)):
            raise MessageRefused(f"{purpose}: the signature is not that of this cluster")
        found: dict[str, Any] = cbor2.loads(body)
        now = self._wall()
        if abs(now - found["t"]) > FRESH_S:
            raise MessageRefused(f"{purpose}: the message is {now - found['t']:.0f} s old")
        if once:
            self._refuse_repeated(purpose, found["id"], now)
        return found

    def _refuse_repeated(self, purpose: str, number: str, now: float) -> None:
        self._seen = {one: t for one, t in self._seen.items() if abs(now - t) <= 2.0 * FRESH_S}
        if number in self._seen:
            raise MessageRefused(f"{purpose}: the message is repeated")
        self._seen[number] = now

    def _tag(self, purpose: str, body: bytes) -> bytes:
        return hmac.digest(self._secret, purpose.encode() + b"\0" + body, "sha256")
