"""Authentication and authorisation of requests.

A request is authenticated by `Authorization: Bearer <API key or OIDC token>`, or by the cookie of a session
of the web page. Where no key was ever added and no issuer is set, every request has the identity `OPEN`: the
service then listens on loopback only, unless its operator has explicitly allowed otherwise.

Records of keys are cached for `FRESH_S`: a revoked key ends within this time, and within `STALE_S` while the
database does not answer. A client with more than
`FAILURES` invalid credentials per minute gets 429 for further invalid ones; valid credentials always pass,
so that a client behind the same address cannot lock out others.

Refusals get a limited number of entries in the audit log. The numbers of the others are entries of their own.
"""

from __future__ import annotations

import hashlib
import re
import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from ipaddress import IPv6Address, IPv6Network, ip_address
from typing import Any, Final

from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter
from starlette.requests import Request

from service.access import keys
from service.access.identity import (
    OPEN,
    Identity,
    NotAuthenticated,
    NotPermitted,
    TooManyFailures,
)
from service.access.keys import KeyRecord
from service.access.tokens import TokenVerifier
from service.store.access import AccessStore
from service.store.schema import StoreUnavailable

COOKIE: Final = "gridsec_session"
FRESH_S: Final = 2.0
"""Largest age of a cached record of a key or session, s."""
STALE_S: Final = 60.0
"""Largest age of a cached record while the database does not answer, s."""
ANSWER_S: Final = 0.3
"""Wait for the database where a cached record may stand in, s: the page must not freeze with it."""
READERS: Final = 4
"""Threads that read the database."""
CACHED: Final = 1024
"""Largest number of cached records."""
FAILURES: Final = 10
"""Number of invalid credentials of one client per minute that get 401."""
LOGGED: Final = 60
"""Number of invalid credentials per minute that get an entry in the audit log."""
REFUSALS: Final = 10
"""Number of refused changes of one identity per minute that get an entry in the audit log."""
COUNTED_S: Final = 60.0
"""Time for which refusals without an entry are counted, s; their number is then an entry."""
IPV6_SUBNET: Final = 64
"""Length of the prefix of a subnet, bits (RFC 4291): one client can use all of its addresses."""
COOKIE_BYTES: Final = 32
DETAIL_BYTES: Final = 2000
"""Part of a request's body in the audit log, bytes."""


class _Refusals:
    """Audit entries of refusals at a limited rate; numbers of those without an entry. Thread-safe."""

    def __init__(self, store: AccessStore, wall: Callable[[], float]) -> None:
        self._store, self._wall = store, wall
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._lock = threading.Lock()
        # Begin of the count (Unix s) and number, by identity and credential.
        self._counts: dict[tuple[str, str], tuple[float, int]] = {}

    def append(self, limit: int, who: tuple[str, str], action: str, target: str, detail: str) -> None:
        """Append the entry of a refusal, or count it beyond `limit` entries per minute.

        who: identity and credential, which have a limit together.
        """
        if not self._limiter.hit(RateLimitItemPerMinute(limit), *who):
            self.count(who)
            return
        self.flush()
        self._store.append(self._wall(), *who, action, target, detail)

    def count(self, who: tuple[str, str]) -> None:
        """Count a refusal without an entry of its own."""
        with self._lock:
            begin, count = self._counts.get(who, (self._wall(), 0))
            self._counts[who] = begin, count + 1
        self.flush()

    def flush(self, *, over_only: bool = True) -> None:
        """Append the numbers of refusals without an entry; with `over_only` those of ended counts."""
        now = self._wall()
        with self._lock:
            ended = [
                who for who, (begin, _) in self._counts.items() if not over_only or now - begin >= COUNTED_S
            ]
            counts = {who: self._counts.pop(who) for who in ended}
        while counts:
            who, (begin, count) = counts.popitem()
            detail = f"{count} refusals in {now - begin:.0f} s have no entry of their own"
            try:
                self._store.append(now, *who, "refused: further", "", detail)
            except StoreUnavailable:
                with self._lock:
                    for each, (start, number) in {**counts, who: (begin, count)}.items():
                        self._counts[each] = start, number + self._counts.get(each, (0.0, 0))[1]
                raise


class Authenticator:
    """Identities of requests. Thread-safe.

    store: keys, sessions and audit log.
    tokens: verification of OIDC tokens; None without an issuer.
    wall: wall clock, Unix s.
    """

    def __init__(
        self, store: AccessStore, tokens: TokenVerifier | None = None, wall: Callable[[], float] = time.time
    ) -> None:
        self.store, self.tokens, self.wall = store, tokens, wall
        self._required = False
        self._failures = MovingWindowRateLimiter(MemoryStorage())
        self._limit = RateLimitItemPerMinute(FAILURES)
        self._refusals = _Refusals(store, wall)
        self._lock = threading.Lock()
        self._cache: dict[str, tuple[float, Any]] = {}
        self._running: dict[str, Future[Any]] = {}
        self._readers = ThreadPoolExecutor(READERS, thread_name_prefix="gridsec-access")

    @property
    def required(self) -> bool:
        """True if requests need a credential; once true it stays so, also if the database is lost."""
        if not self._required:
            self._required = self.tokens is not None or bool(self._cached("required", self.store.any_key))
        return self._required

    def identify(self, request: Request) -> Identity:
        """Identity of a request.

        Raises NotAuthenticated, TooManyFailures without a valid credential.
        """
        scheme, _, given = request.headers.get("authorization", "").partition(" ")
        cookie = session_of(request)
        if given and scheme.lower() == "bearer":
            return self.of_credential(given.strip(), client_of(request))
        if cookie:
            record = self._cached(_session_name(cookie), lambda: self.store.session(cookie, self.wall()))
            if record is not None and record.ended(self.wall()) is None:
                return Identity(record.name, record.role, record.feeders, f"key {record.id}")
        if not self.required:
            return OPEN
        text = "the session has ended; log in again" if cookie else "a credential is required: an API key"
        raise NotAuthenticated(text)

    def of_credential(self, text: str, client: str) -> Identity:
        """Identity of an API key or token.

        text: the credential.
        client: address of the client, for the limit of failures.
        Raises NotAuthenticated, TooManyFailures if the credential is not valid.
        """
        try:
            if text.startswith("gridsec_") or self.tokens is None:
                return self._key(text).identity
            return self.tokens.identify(text)
        except NotAuthenticated as error:
            # All clients share an identity in the log: addresses can be changed at will.
            unknown = "", ""
            if not self._failures.hit(self._limit, subnet_of(client)):
                self._refusals.count(unknown)
                raise TooManyFailures("too many invalid credentials; wait a minute") from error
            self._refusals.append(LOGGED, unknown, "invalid credential", client, str(error))
            raise

    def log_in(self, text: str, client: str) -> tuple[Identity, str, float]:
        """Exchange an API key for a session.

        text, client: as in `of_credential`.
        Returns identity, cookie, expires: identity, text of the cookie, and the session's end, Unix s.
        """
        identity = self.of_credential(text, client)
        parsed = keys.parse(text)
        if parsed is None:
            raise NotAuthenticated("a session needs an API key")
        cookie = secrets.token_urlsafe(COOKIE_BYTES)
        expires = self.store.open_session(cookie, parsed[0], self.wall())
        self.record(identity, "log in", client)
        return identity, cookie, expires

    def record(self, identity: Identity, action: str, target: str, detail: str = "") -> None:
        """Append an entry of the audit log; durable when this returns."""
        self._refusals.flush()
        self.store.append(self.wall(), identity.name, identity.credential, action, target, detail)

    def record_refusal(self, identity: Identity, action: str, target: str, detail: str) -> None:
        """Append an entry of a refused change, at most `REFUSALS` per minute and identity."""
        who = identity.name, identity.credential
        self._refusals.append(REFUSALS, who, f"refused: {action}", target, detail)

    def log_out(self, cookie: str) -> None:
        """End a session."""
        self.store.close_session(cookie)
        with self._lock:
            self._cache[_session_name(cookie)] = (time.monotonic(), None)

    def _key(self, text: str) -> KeyRecord:
        key_id, secret = keys.parse(text) or ("", "")
        record: KeyRecord | None = self._cached(f"key {key_id}", lambda: self.store.key(key_id))
        if record is None or not keys.matches(record, secret):
            raise NotAuthenticated("the API key is not known")
        if (reason := record.ended(self.wall())) is not None:
            raise NotAuthenticated(reason)
        self._required = True
        return record

    def _cached(self, name: str, read: Callable[[], Any]) -> Any:
        """Value of a read at most `FRESH_S` ago; while the database does not answer, at most `STALE_S`."""
        now = time.monotonic()
        with self._lock:
            found = self._cache.get(name)
            if found is not None and now - found[0] < FRESH_S:
                return found[1]
            running = self._running.get(name)
            if running is None:
                running = self._running[name] = self._readers.submit(self._read, name, read)
        stale = found is not None and now - found[0] < STALE_S
        try:
            return running.result(timeout=ANSWER_S if stale else None)
        except (TimeoutError, StoreUnavailable):
            if found is None or not stale:
                raise
            return found[1]

    def _read(self, name: str, read: Callable[[], Any]) -> Any:
        begun = time.monotonic()
        try:
            value = read()
            with self._lock:
                if len(self._cache) >= CACHED:
                    self._cache.clear()
                self._cache[name] = (begun, value)
        finally:
            with self._lock:
                self._running.pop(name, None)
        return value

    def close(self) -> None:
        """End the threads of reads, and append the numbers of refusals without an entry."""
        self._readers.shutdown(wait=False, cancel_futures=True)
        with suppress(StoreUnavailable):
            self._refusals.flush(over_only=False)


_COOKIE = re.compile(r"[A-Za-z0-9_-]{43}")


def session_of(request: Request) -> str:
    """Text of a request's session cookie; empty without one, or for another text."""
    found = request.cookies.get(COOKIE, "")
    return found if _COOKIE.fullmatch(found) else ""


def _session_name(cookie: str) -> str:
    return f"session {hashlib.sha256(cookie.encode()).hexdigest()}"


def client_of(request: Request) -> str:
    """Address of the client, for the limit of failures and the audit log."""
    return request.client.host if request.client is not None else "unknown"


def subnet_of(client: str) -> str:
    """Subnet of an IPv6 address; any other address as it is. An IPv4-mapped address is the IPv4 address."""
    try:
        address = ip_address(client.partition("%")[0])
    except ValueError:
        return client
    if not isinstance(address, IPv6Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(IPv6Network((int(address), IPV6_SUBNET), strict=False))


def authorise(authenticator: Authenticator, request: Request, route: str, body: bytes) -> Identity:
    """Identity of a request that may use a restricted route; the audit log has changes before they are made.

    authenticator: the authenticator.
    route: method and path template.
    body: body of the request.
    Raises NotAuthenticated, TooManyFailures without a valid credential; NotPermitted if the identity has no
        access.
    """
    identity = authenticator.identify(request)
    feeder = request.path_params.get("feeder")
    reason = identity.permits(route)
    if reason is None and feeder is not None and not identity.sees(feeder):
        reason = f"{identity.name} has no access to feeder {feeder!r}"
    # Without authentication no identity could be held to an entry.
    if identity is not OPEN and request.method not in {"GET", "HEAD"}:
        detail = body[:DETAIL_BYTES].decode("utf-8", "replace")
        record = authenticator.record if reason is None else authenticator.record_refusal
        record(identity, route, request.url.path, detail)
    if reason is not None:
        raise NotPermitted(reason)
    return identity
