"""Signed messages of a cluster: what is accepted, and what is not."""

from __future__ import annotations

import pytest

from service.cluster.messages import FRESH_S, Envelope, MessageRefused
from tests.codes import refused


def test_a_message_is_opened_with_its_purpose_only() -> None:
    envelope = Envelope(b"secret")
    message = envelope.seal("call a", {"path": "/healthz", "body": b"\0\xff"})
    found = envelope.open("call a", message)
    assert (found["path"], found["body"]) == ("/healthz", b"\0\xff")
    with refused(MessageRefused, "message-refused"):
        envelope.open("call b", message)


@pytest.mark.parametrize("k", [0, 31, 32, -1])
def test_a_changed_byte_is_refused(k: int) -> None:
    envelope = Envelope(b"secret")
    message = bytearray(envelope.seal("call", {"path": "/"}))
    message[k] ^= 1
    with refused(MessageRefused, "message-refused"):
        envelope.open("call", bytes(message))


@pytest.mark.parametrize("shift_s", [-1.01 * FRESH_S, 1.01 * FRESH_S])
def test_an_old_message_is_refused(shift_s: float) -> None:
    sender, receiver = Envelope(b"secret", lambda: 1e9), Envelope(b"secret", lambda: 1e9 + shift_s)
    with refused(MessageRefused, "message-refused"):
        receiver.open("call", sender.seal("call", {}))


def test_a_command_is_executed_once() -> None:
    now = [1e9]
    envelope = Envelope(b"secret", lambda: now[0])
    message = envelope.seal("call", {})
    envelope.open("call", message, once=True)
    with refused(MessageRefused, "message-refused"):
        envelope.open("call", message, once=True)
    # The memory of used messages is bounded; an old one is refused for its age.
    now[0] += 3.0 * FRESH_S
    envelope.open("call", envelope.seal("call", {}), once=True)
    assert len(envelope._seen) == 1
    with refused(MessageRefused, "message-refused"):
        envelope.open("call", message, once=True)
