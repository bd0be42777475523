"""Requests to checked addresses: what may be connected to, limits of time and size, TLS, no redirects."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.access import pki
from service.notify.post import (
    RESPONSE_BYTES,
    AddressRefused,
    Cancel,
    Endpoint,
    is_public,
    permitted,
    post,
)
from tests.service.receiver import Receiver, receiving

PRIVATE = (
    *("127.0.0.1", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0"),
    *("224.0.0.1", "240.0.0.1", "255.255.255.255", "192.0.2.1", "::1", "::", "fe80::1%eth0", "fc00::1"),
    *("ff02::1", "::ffff:127.0.0.1", "::ffff:10.0.0.1", "2002:7f00:1::", "64:ff9b::7f00:1", "2001:db8::1"),
)
PUBLIC = ("8.8.8.8", "1.1.1.1", "2606:4700:4700::1111", "64:ff9b::808:808")


@pytest.fixture(scope="module")
def receiver() -> Iterator[Receiver]:
    with receiving() as made:
        yield made


def resolver(*addresses: str) -> Any:
    """A resolver with fixed answers that counts its calls."""

    def resolve(_host: str, port: int, **_: Any) -> list[Any]:
        resolve.calls += 1  # type: ignore[attr-defined]
        return [
            (socket.AF_INET6 if ":" in each else socket.AF_INET, socket.SOCK_STREAM, 6, "", (each, port))
            for each in addresses
        ]

    resolve.calls = 0  # type: ignore[attr-defined]
    return resolve


@pytest.mark.parametrize("address", PRIVATE)
def test_addresses_that_are_not_public_are_refused(address: str) -> None:
    assert not is_public(address)
    with pytest.raises(AddressRefused) as caught:
        permitted("name", 443, private=False, resolve=resolver(address))
    assert caught.value.code == "address-refused"
    assert permitted("name", 443, private=True, resolve=resolver(address))


@pytest.mark.parametrize("address", PUBLIC)
def test_public_addresses_are_permitted(address: str) -> None:
    assert is_public(address)
    found = permitted("name", 443, private=False, resolve=resolver("10.0.0.1", address))
    assert [each[4][0] for each in found] == [address]


@given(st.ip_addresses(v=4))
def test_an_address_within_an_address_is_not_more_public(address: Any) -> None:
    for text in (f"::ffff:{address}", f"64:ff9b::{address}"):
        assert not is_public(text) or is_public(str(address))


def test_a_request_reaches_the_target(receiver: Receiver) -> None:
    done = post(Endpoint(f"{receiver.url}/in?a=1", private=True), b'{"a": 1}', {"webhook-id": "msg_1"})
    assert (done.status, done.accepted, done.problem) == (200, True, None)
    got = receiver.got[-1]
    assert (got.path, got.body) == ("/in?a=1", b'{"a": 1}')
    assert got.headers["webhook-id"] == "msg_1"
    assert got.headers["content-type"] == "application/json"
    assert got.headers["host"] == f"127.0.0.1:{receiver.port}"


def test_loopback_needs_permission(receiver: Receiver) -> None:
    before = len(receiver.got)
    done = post(Endpoint(receiver.url), b"{}", {})
    assert (done.status, len(receiver.got)) == (None, before)
    assert done.problem is not None
    assert "private_addresses" in done.problem


def test_a_name_is_resolved_once_and_the_checked_address_is_used(receiver: Receiver) -> None:
    """A resolver that answers differently the second time (DNS rebinding) has no second time."""
    resolve = resolver("127.0.0.1")
    done = post(Endpoint(f"http://hooks.example:{receiver.port}/", private=True), b"{}", {}, resolve=resolve)
    assert (done.accepted, resolve.calls) == (True, 1)
    assert receiver.got[-1].headers["host"] == f"hooks.example:{receiver.port}"
    unknown = post(Endpoint("https://gridsec.invalid/"), b"{}", {})
    assert (unknown.status, unknown.accepted) == (None, False)


def test_redirects_are_not_followed(receiver: Receiver) -> None:
    receiver.answers.append((307, {"Location": f"{receiver.url}/elsewhere"}))
    before = len(receiver.got)
    done = post(Endpoint(receiver.url, private=True), b"{}", {})
    assert (done.status, done.refused, len(receiver.got)) == (307, True, before + 1)


@pytest.mark.parametrize(
    ("status", "is_refused"),
    [
        (400, True),
        (401, True),
        (410, True),
        (408, False),
        (425, False),
        (429, False),
        (500, False),
        (503, False),
    ],
)
def test_what_a_status_means(receiver: Receiver, status: int, is_refused: bool) -> None:
    receiver.answers.append((status, {"Retry-After": "17"}))
    done = post(Endpoint(receiver.url, private=True), b"{}", {})
    assert (done.status, done.accepted, done.refused, done.retry_after_s) == (status, False, is_refused, 17.0)
    assert done.problem is not None
    assert done.problem.startswith(f"status {status}")


def test_a_dripping_response_ends_at_the_time_limit(receiver: Receiver) -> None:
    def drip(handler: Any) -> None:
        handler.wfile.write(b"HTTP/1.1 200 OK\r\n")
        for _ in range(100):
            try:
                handler.wfile.write(b"X-A: b\r\n")
                handler.wfile.flush()
            except OSError:
                return
            time.sleep(0.05)

    receiver.answers.append(drip)
    begun, cancel = time.monotonic(), Cancel()
    done = post(Endpoint(receiver.url, private=True, timeout_s=0.4), b"{}", {}, cancel=cancel)
    assert (done.status, time.monotonic() - begun < 1.5) == (None, True)
    assert done.problem == "no response within 0.4 s"
    assert post(Endpoint(receiver.url, private=True), b"{}", {}, cancel=cancel).accepted


def test_an_endless_response_is_read_to_its_limit_only(receiver: Receiver) -> None:
    written = []

    def flood(handler: Any) -> None:
        handler.wfile.write(b"HTTP/1.1 500 Broken\r\n\r\n")
        try:
            for _ in range(10_000):
                handler.wfile.write(b"x" * 65_536)
                written.append(65_536)
        except OSError:
            pass

    receiver.answers.append(flood)
    done = post(Endpoint(receiver.url, private=True), b"{}", {})
    assert done.status == 500
    assert done.problem is not None
    assert len(done.problem) < RESPONSE_BYTES
    time.sleep(0.05)
    assert sum(written) < 100 << 20


def test_an_address_without_a_listener_is_a_problem() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        done = post(Endpoint(f"http://127.0.0.1:{taken.getsockname()[1]}/", private=True), b"{}", {})
    assert (done.status, done.problem) == (None, "Connection refused")


def test_a_request_ends_from_another_thread(receiver: Receiver) -> None:
    release = threading.Event()
    receiver.answers.append(lambda _: release.wait(10.0) and None)
    cancel = Cancel()
    threading.Timer(0.1, cancel.end).start()
    begun = time.monotonic()
    done = post(Endpoint(receiver.url, private=True, timeout_s=30.0), b"{}", {}, cancel=cancel)
    release.set()
    assert (done.accepted, done.ended, time.monotonic() - begun < 5.0) == (False, True, True)
    assert not post(Endpoint(receiver.url, private=True), b"{}", {}, cancel=cancel).accepted


def test_tls_verifies_the_name_and_the_authority(tmp_path: Path) -> None:
    pki.create_authority(tmp_path, time.time(), lasts_s=7200.0)
    issued = pki.issue(
        tmp_path, "hook", pki.Kind.ROUTER, time.time(), lasts_s=3600.0, hosts=["hooks.example"]
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(issued.path, tmp_path / "hook.key")
    with receiving() as secure:
        secure.server.socket = context.wrap_socket(secure.server.socket, server_side=True)
        for name, ca_file, taken in (
            ("hooks.example", str(tmp_path / "authority.crt"), True),
            ("other.example", str(tmp_path / "authority.crt"), False),
            ("hooks.example", None, False),
        ):
            endpoint = Endpoint(f"https://{name}:{secure.port}/", True, 5.0, ca_file)
            done = post(endpoint, b"{}", {}, resolve=resolver("127.0.0.1"))
            assert done.accepted is taken, done
        assert len(secure.got) == 1
