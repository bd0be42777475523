"""OIDC bearer tokens: signature, issuer, audience and time by PyJWT, with the issuer's published keys.

Claims: `preferred_username`, `email` or `sub` is the name; `gridsec_role` the role; `gridsec_feeders` a list
of feeders, absent for all. The claim of the role may have another name. In a list the highest known role
counts.
"""

from __future__ import annotations

import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import urlsplit

import jwt

from service.access.identity import Identity, IssuerUnavailable, NotAuthenticated, Role, is_name

ALGORITHMS: Final = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
"""Accepted signatures: asymmetric ones. `none` and HMAC with a public key as its secret are refused."""
LEEWAY_S: Final = 30.0
"""Tolerated difference of clocks, s."""
ANSWER_S: Final = 5
"""Time limit of a request to the issuer, s."""
KEYS_S: Final = 600
"""Time for which the issuer's keys are cached, s."""
FEEDERS_CLAIM: Final = "gridsec_feeders"
NAMES: Final = ("preferred_username", "email", "sub")
"""Claims of the name, the first one present counts."""


RETRY_S: Final = 10.0
"""Time after a failed request to the issuer without another one, s."""
KEPT: Final = 64
"""Largest number of keys that stay valid while the issuer does not answer."""


@dataclass(eq=False)
class TokenVerifier:
    """Verification of the tokens of one issuer. Thread-safe.

    Keys that were read once stay valid while the issuer does not answer. After a failed request the next one
    follows `RETRY_S` later at the earliest, so that a flood of tokens does not become a flood of requests.
    """

    issuer: str  # required claim `iss`
    audience: str  # required claim `aud`
    jwks_url: str = ""  # address of the issuer's keys; empty: by the issuer's discovery document
    role_claim: str = "gridsec_role"
    _client: jwt.PyJWKClient | None = field(default=None, repr=False)
    _known: dict[str, Any] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _failed: float = field(default=-RETRY_S, repr=False)

    def identify(self, token: str) -> Identity:
        """Identity of a valid token.

        Raises NotAuthenticated with the reason, and IssuerUnavailable if the keys cannot be read.
        """
        try:
            key = self._key(token)
            claims = jwt.decode(
                token,
                key,
                algorithms=list(ALGORITHMS),
                audience=self.audience,
                issuer=self.issuer,
                leeway=LEEWAY_S,
                options={"require": ["exp", "iat", "sub"]},
            )
        # A key of another algorithm than the token's is a TypeError or ValueError of the library.
        except (jwt.PyJWTError, TypeError, ValueError) as error:
            raise NotAuthenticated(f"the token is not valid: {error}") from error
        return self._identity(claims)

    def reachable(self) -> int:
        """Number of the issuer's signing keys, read now. Raises IssuerUnavailable without any."""
        try:
            return len(self._keys().get_signing_keys(refresh=True))
        except (jwt.PyJWKClientError, jwt.PyJWKSetError, OSError, ValueError) as error:
            raise _unavailable(self.issuer, str(error)) from error

    def _key(self, token: str) -> Any:
        """Public key of a token's signature."""
        kid = str(jwt.get_unverified_header(token).get("kid", ""))
        with self._lock:
            if time.monotonic() - self._failed < RETRY_S:
                return self._kept(kid, "the last request failed")
            try:
                found = self._keys().get_signing_key_from_jwt(token).key
            except (jwt.PyJWKClientConnectionError, OSError) as error:
                self._failed = time.monotonic()
                return self._kept(kid, str(error))
            if len(self._known) < KEPT:
                self._known[kid] = found
            return found

    def _kept(self, kid: str, why: str) -> Any:
        if kid in self._known:
            return self._known[kid]
        raise _unavailable(self.issuer, why)

    def _identity(self, claims: Mapping[str, Any]) -> Identity:
        name = next((claims[each] for each in NAMES if isinstance(claims.get(each), str)), "")
        if not is_name(name):
            raise NotAuthenticated("the name in the token must have 1 to 64 printable characters")
        given = claims.get(self.role_claim)
        wanted = given if isinstance(given, list) else [given]
        roles = [role for role in Role if role in wanted]
        if not roles:
            raise NotAuthenticated(f"the token of {name} has no known role in {self.role_claim}")
        feeders = claims.get(FEEDERS_CLAIM)
        if feeders is not None and not (
            isinstance(feeders, list) and all(isinstance(each, str) for each in feeders)
        ):
            raise NotAuthenticated(f"{FEEDERS_CLAIM} in the token of {name} is not a list of names")
        scope = None if feeders is None else frozenset(feeders)
        return Identity(name, roles[-1], scope, f"token {self.issuer}")

    def _keys(self) -> jwt.PyJWKClient:
        if self._client is None:
            url = self.jwks_url or _discovered(self.issuer)
            self._client = jwt.PyJWKClient(url, lifespan=KEYS_S, timeout=ANSWER_S)
        return self._client


def _discovered(issuer: str) -> str:
    """Address of the keys by the issuer's discovery document."""
    address = issuer.rstrip("/") + "/.well-known/openid-configuration"
    if urlsplit(address).scheme not in {"http", "https"}:
        raise _unavailable(issuer, "it is not an http address")
    try:
        with urllib.request.urlopen(address, timeout=ANSWER_S) as answer:  # noqa: S310  # scheme is checked
            found = json.load(answer)
    except urllib.error.HTTPError as error:
        error.close()
        raise
    named = found if isinstance(found, dict) else {}
    if named.get("issuer") != issuer or not str(named.get("jwks_uri", "")).startswith(
        ("http://", "https://")
    ):
        raise _unavailable(issuer, f"{address} must name this issuer and an http address of its keys")
    return str(named["jwks_uri"])


def _unavailable(issuer: str, why: str) -> IssuerUnavailable:
    return IssuerUnavailable(f"the keys of {issuer} cannot be read: {why}")
