"""OIDC bearer tokens: signature, issuer, audience and time by PyJWT, with the issuer's published keys.

Claims: `preferred_username`, `email` or `sub` is the name; `gridsec_role` the role; `gridsec_feeders` a list
of feeders, absent for all. The claim of the role may have another name. In a list the highest known role
counts.
"""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import urlsplit

import jwt

from service.access.identity import Identity, NotAuthenticated, Role

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


@dataclass(eq=False)
class TokenVerifier:
    """Verification of the tokens of one issuer."""

    # issuer, audience: required claims `iss` and `aud`
    issuer: str
    audience: str
    jwks_url: str = ""  # address of the issuer's keys; empty: by the issuer's discovery document
    role_claim: str = "gridsec_role"  # claim of the role
    _client: jwt.PyJWKClient | None = field(default=None, repr=False)

    def identify(self, token: str) -> Identity:
        """Identity of a valid token.

        Raises NotAuthenticated with the reason.
        """
        try:
            key = self._keys().get_signing_key_from_jwt(token)
            claims = jwt.decode(
                token,
                key.key,
                algorithms=list(ALGORITHMS),
                audience=self.audience,
                issuer=self.issuer,
                leeway=LEEWAY_S,
                options={"require": ["exp", "iat", "sub"]},
            )
        except jwt.PyJWTError as error:
            raise NotAuthenticated(f"the token is not valid: {error}") from error
        except (OSError, ValueError) as error:
            raise _unavailable(self.issuer, str(error)) from error
        return self._identity(claims)

    def _identity(self, claims: Mapping[str, Any]) -> Identity:
        name = next((claims[each] for each in NAMES if isinstance(claims.get(each), str)), "")
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


def _unavailable(issuer: str, why: str) -> NotAuthenticated:
    return NotAuthenticated(f"the keys of {issuer} cannot be read: {why}", code="issuer-unavailable")
