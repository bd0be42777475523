"""HTTP POST to an address that is checked after its name is resolved.

A webhook's address is configuration, but its name is resolved by a foreign server. A name is therefore
resolved once, addresses that are not public are dropped, and the connection is made to the checked address:
a second answer of the resolver (DNS rebinding) has no effect. TLS verifies the certificate for the name.
Redirects are not followed. A request has a time limit as a whole and a limit of the response.
"""

from __future__ import annotations

import http.client
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, IPv6Network, ip_address
from typing import Any, Final
from urllib.parse import urlsplit

from gridsec.errors import GridsecError

RESPONSE_BYTES: Final = 4096
"""Part of a response that is read, bytes."""
RETRY_AFTER_S: Final = 3600.0
"""Largest `Retry-After` that is followed, s."""
_NAT64: Final = IPv6Network("64:ff9b::/96")
"""IPv4 addresses behind a translator (RFC 6052)."""

Resolver = Callable[..., list[Any]]


class AddressRefused(GridsecError):
    """A target's name has no permitted address."""

    code = "address-refused"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address of a target."""

    url: str  # http:// or https://
    private: bool = False  # private, loopback and link-local addresses are permitted
    timeout_s: float = 10.0  # time limit of a request, s
    ca_file: str | None = None  # certificates of authorities (PEM); None: those of the system


@dataclass(frozen=True, slots=True)
class Response:
    """Result of a request."""

    status: int | None  # status of the response; None without a response
    problem: str | None = None  # reason of a failure; None of a success
    retry_after_s: float | None = None  # wait that the target asks for, s
    ended: bool = False  # the request was ended because the service ends: no failure of the target

    @property
    def accepted(self) -> bool:
        """True if the target has the message."""
        return self.status is not None and 200 <= self.status < 300

    @property
    def refused(self) -> bool:
        """True if the target does not take this message: the same request would fail again."""
        waits = {408, 425, 429}
        return self.status is not None and 300 <= self.status < 500 and self.status not in waits


def post(
    endpoint: Endpoint,
    body: bytes,
    headers: Mapping[str, str],
    *,
    resolve: Resolver = socket.getaddrinfo,
    cancel: Cancel | None = None,
) -> Response:
    """Send a request and return its result; raises nothing of the network.

    endpoint: address and limits.
    body: JSON.
    headers: further headers.
    resolve: resolver with the interface of `socket.getaddrinfo`.
    cancel: ends the request from another thread; None for a request of its own.
    """
    cancel = cancel or Cancel()
    parts = urlsplit(endpoint.url)
    host, secure = parts.hostname or "", parts.scheme == "https"
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    cancel.begin()
    end = time.monotonic() + endpoint.timeout_s
    watch = threading.Timer(endpoint.timeout_s, cancel.expire)
    watch.daemon = True
    watch.start()
    try:
        addresses = permitted(host, parts.port or (443 if secure else 80), endpoint.private, resolve)
        context = ssl.create_default_context(cafile=endpoint.ca_file) if secure else None
        connection = _Checked(host, addresses, end, context, cancel)
        try:
            connection.request("POST", path, body, {"Content-Type": "application/json", **headers})
            response = connection.getresponse()
            text = response.read(RESPONSE_BYTES)
        finally:
            connection.close()
    except (OSError, http.client.HTTPException, AddressRefused, ValueError) as error:
        if not (cancel.over or isinstance(error, TimeoutError)):
            return Response(None, _text(error))
        return _unfinished(endpoint, cancel)
    finally:
        watch.cancel()
    if cancel.over:
        # The end of the connection looks like the end of the response.
        return _unfinished(endpoint, cancel)
    if 200 <= response.status < 300:
        return Response(response.status)
    start = " ".join(text.decode("utf-8", "replace").split())[:200]
    problem = f"status {response.status} {response.reason}" + (f": {start}" if start else "")
    return Response(response.status, problem, _retry_after_s(response.headers.get("Retry-After", "")))


def _unfinished(endpoint: Endpoint, cancel: Cancel) -> Response:
    """Result of a request without a response, by its time limit or by the end of the service."""
    if cancel.ended:
        return Response(None, "the service ends", ended=True)
    return Response(None, f"no response within {endpoint.timeout_s:g} s")


def permitted(
    host: str, port: int, private: bool, resolve: Resolver = socket.getaddrinfo
) -> list[tuple[Any, ...]]:
    """Resolve a name once and return its permitted addresses, as `socket.getaddrinfo` does.

    Raises AddressRefused if none is permitted, OSError if the name is not known.
    """
    found = resolve(host, port, type=socket.SOCK_STREAM)
    good = [each for each in found if private or is_public(each[4][0])]
    if not good:
        texts = ", ".join(sorted({str(each[4][0]) for each in found}))
        raise AddressRefused(
            f"{host} has no public address ({texts}); `private_addresses = true` of the target permits it"
        )
    return good


def is_public(address: str) -> bool:
    """True for a global unicast address, also of an IPv4 address within an IPv6 address."""
    found = ip_address(address.partition("%")[0])
    return all(each.is_global and not each.is_multicast for each in (found, *_within(found)))


def _within(address: IPv4Address | IPv6Address) -> Iterable[IPv4Address]:
    """Addresses that an IPv6 address stands for: mapped, 6to4, Teredo, NAT64."""
    if isinstance(address, IPv4Address):
        return ()
    found = [address.ipv4_mapped, address.sixtofour, *(address.teredo or ())]
    if address in _NAT64:
        found.append(IPv4Address(int(address) & 0xFFFF_FFFF))
    return [each for each in found if each is not None]


class Cancel:
    """Ends requests of one thread from another one: the present one at its time limit, all at the end."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ended, self._late = False, False
        self._socket: socket.socket | None = None

    @property
    def ended(self) -> bool:
        """True after `end`."""
        return self._ended

    @property
    def over(self) -> bool:
        """True if the present request was ended."""
        return self._ended or self._late

    def begin(self) -> None:
        """Begin a request."""
        with self._lock:
            self._late, self._socket = False, None

    def expire(self) -> None:
        """End the present request."""
        with self._lock:
            self._late = True
            self._end()

    def end(self) -> None:
        """End the present request and all later ones."""
        with self._lock:
            self._ended = True
            self._end()

    def hold(self, opened: socket.socket) -> None:
        """Set the socket of the present request."""
        with self._lock:
            self._socket = opened
            if self.over:
                self._end()

    def _end(self) -> None:
        if self._socket is not None:
            _shut(self._socket)


def _shut(opened: socket.socket) -> None:
    try:
        opened.shutdown(socket.SHUT_RDWR)
    except OSError:  # not connected yet, or already closed
        opened.close()


class _Checked(http.client.HTTPConnection):
    """Connection to the first checked address that answers.

    addresses: checked addresses.
    end: monotonic time of the time limit, s.
    context: TLS; None for plain HTTP.
    """

    def __init__(
        self,
        host: str,
        addresses: list[tuple[Any, ...]],
        end: float,
        context: ssl.SSLContext | None,
        cancel: Cancel,
    ) -> None:
        super().__init__(host, addresses[0][4][1])
        self.default_port = 80 if context is None else 443
        self._addresses, self._end, self._context, self._cancel = addresses, end, context, cancel

    def connect(self) -> None:
        """Connect without resolving the name again."""
        problem: OSError | None = None
        for family, kind, protocol, _, address in self._addresses:
            opened = socket.socket(family, kind, protocol)
            try:
                self._cancel.hold(opened)
                opened.settimeout(max(0.01, self._end - time.monotonic()))
                opened.connect(address)
                if self._context is not None:
                    opened = self._context.wrap_socket(opened, server_hostname=self.host)
                    self._cancel.hold(opened)
            except OSError as error:
                opened.close()
                problem = error
            else:
                self.sock = opened
                return
        raise problem or OSError("no address")


def _retry_after_s(text: str) -> float | None:
    """Seconds of the header `Retry-After`; a date is not followed."""
    return min(float(text), RETRY_AFTER_S) if text.isascii() and text.isdigit() else None


def _text(error: BaseException) -> str:
    """Message of an error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
