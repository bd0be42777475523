"""Identities, keys, tokens, the audit chain, and their database."""

from __future__ import annotations

import hashlib
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import rsa
from hypothesis import given
from hypothesis import strategies as st

from service.access.audit import START, AuditEntry, broken, chained
from service.access.identity import (
    OPEN,
    POLICY,
    WHOLE_FLEET,
    Identity,
    IssuerUnavailable,
    NotAuthenticated,
    Role,
    is_name,
)
from service.access.keys import create, matches, parse
from service.access.tokens import TokenVerifier
from service.store.access import AccessStore
from service.store.schema import StoreUnavailable
from tests.codes import refused
from tests.service.issuer import Issuer, issuing

NOW = 1_795_212_000.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[AccessStore]:
    with AccessStore(f"sqlite:///{tmp_path}/grid.db") as made:
        yield made


# ------------------------------------------------------------------- identity


def test_roles_are_a_chain() -> None:
    order = list(Role)
    for k, one in enumerate(order):
        assert [one.includes(other) for other in order] == [j <= k for j in range(len(order))]


def test_an_unlisted_route_is_denied_to_every_role() -> None:
    for role in Role:
        assert Identity("a", role).permits("GET /api/v1/unlisted") is not None
    assert OPEN.permits("GET /api/v1/unlisted") is not None


def test_restricted_identities_see_their_feeders_and_nothing_of_the_whole_fleet() -> None:
    some = Identity("a", Role.ADMIN, frozenset({"north"}))
    assert some.seen(["north", "south"]) == ("north",)
    for route in WHOLE_FLEET:
        assert some.permits(route) is not None
        assert replace(some, feeders=None).permits(route) is None
    assert all(route in POLICY for route in WHOLE_FLEET)


# ----------------------------------------------------------------------- keys


def test_a_key_has_256_random_bits_and_only_its_sha256_is_kept() -> None:
    texts = set()
    for _ in range(100):
        text, record = create("a", Role.VIEWER, None, NOW, None)
        parsed = parse(text)
        assert parsed is not None
        key_id, secret = parsed
        assert record.id == key_id
        assert record.digest == hashlib.sha256(secret.encode()).hexdigest()
        assert matches(record, secret)
        assert not matches(record, secret[:-1] + ("A" if secret[-1] != "A" else "B"))
        assert secret not in repr(record)
        # 43 characters of base64 hold 32 bytes.
        assert len(secret) == 43
        texts.add(secret)
    assert len(texts) == 100


@given(st.text())
def test_no_other_text_is_a_key(text: str) -> None:
    assert parse(text) is None


def test_expiry_and_revocation() -> None:
    _, record = create("a", Role.VIEWER, None, NOW, NOW + 10.0)
    assert record.ended(NOW + 9.9) is None
    assert record.ended(NOW + 10.0) == "the key has expired"
    assert replace(record, revoked=NOW).ended(NOW) == "the key is revoked"
    assert replace(record, expires=None).ended(NOW + 1e9) is None


def test_the_file_of_keys_holds_no_secret_and_is_private(store: AccessStore, tmp_path: Path) -> None:
    text, record = create("Ada", Role.OPERATOR, None, NOW, NOW + 100.0)
    store.add_key(record)
    store.open_session("cookie", record.id, NOW)
    content = (tmp_path / "grid.db.access").read_bytes()
    assert text.encode() not in content
    assert text.split("_", 2)[2].encode() not in content
    assert b"cookie" not in content
    assert (tmp_path / "grid.db.access").stat().st_mode & 0o077 == 0


def test_addresses_that_are_no_database(tmp_path: Path) -> None:
    with refused(StoreUnavailable, "wrong-address"):
        AccessStore("no address")
    with refused(StoreUnavailable, "in-memory"):
        AccessStore("sqlite://")
    with refused(StoreUnavailable, "write-failed"):
        AccessStore(f"sqlite:///{tmp_path}/absent/grid.db")


def test_a_newer_database_is_refused(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/grid.db"
    AccessStore(address).close()
    with sqlite3.connect(tmp_path / "grid.db.access") as raw:
        raw.execute("UPDATE access_version SET version = 99")
    raw.close()
    with refused(StoreUnavailable, "newer-schema"):
        AccessStore(address)


# ---------------------------------------------------------------------- audit


def log_of(count: int) -> list[AuditEntry]:
    entries: list[AuditEntry] = []
    for k in range(count):
        last = entries[-1] if entries else None
        entries.append(chained(last, NOW + k, "Ada", "key 1", "PUT", f"feeder {k}", '{"a": "ä"}'))
    return entries


@given(st.integers(1, 8), st.data())
def test_every_change_of_the_log_breaks_the_chain(count: int, data: st.DataObject) -> None:
    entries = log_of(count)
    assert broken(entries) is None
    at = data.draw(st.integers(0, count - 1))
    name = data.draw(
        st.sampled_from(["t", "identity", "credential", "action", "target", "detail", "previous", "hash"])
    )
    value: Any = NOW - 1.0 if name == "t" else "f" * 64
    changed = [*entries[:at], replace(entries[at], **{name: value}), *entries[at + 1 :]]
    assert broken(changed) is not None
    if at < count - 1:
        assert broken([*entries[:at], *entries[at + 1 :]]) is not None
    swapped = [*entries[:at], *reversed(entries[at : at + 2]), *entries[at + 2 :]]
    assert (broken(swapped) is not None) == (swapped != entries)


def test_a_shortened_log_is_found_by_a_kept_entry() -> None:
    entries = log_of(4)
    kept = (4, entries[-1].hash)
    assert broken(entries, kept) is None
    assert broken(entries[:3]) is None
    assert broken(entries[:3], kept) == "the log ends at entry 3; entry 4 is missing"
    assert broken(entries, (4, "0" * 64)) is not None


def test_a_rewritten_log_is_found_by_a_kept_entry() -> None:
    kept = (2, log_of(3)[1].hash)
    other = [chained(None, NOW, "Eve", "", "", "", "")]
    other.append(chained(other[0], NOW, "Eve", "", "", "", ""))
    assert broken(other) is None
    assert broken(other, kept) is not None
    assert other[0].previous == START


# --------------------------------------------------------------------- tokens


@pytest.fixture(scope="module")
def issuer() -> Iterator[Issuer]:
    with issuing() as server:
        yield server


def verifier(issuer: Issuer, **more: str) -> TokenVerifier:
    return TokenVerifier(issuer.url, "gridsec", **more)


def test_a_valid_token_is_an_identity(issuer: Issuer) -> None:
    made = verifier(issuer)
    found = made.identify(issuer.token(preferred_username="Ada", gridsec_feeders=["north"]))
    assert found == Identity("Ada", Role.OPERATOR, frozenset({"north"}), f"token {issuer.url}")
    assert made.identify(issuer.token(kid="e")).name == "ada"
    several = TokenVerifier(issuer.url, "gridsec", f"{issuer.url}/keys", "groups")
    assert several.identify(issuer.token(groups=["viewer", "engineer", "other"])).role is Role.ENGINEER


@pytest.mark.parametrize(
    "claims",
    [
        {"exp": time.time() - 3600.0},
        {"iss": "http://other"},
        {"aud": "other"},
        {"exp": None},
        {"gridsec_role": "root"},
        {"gridsec_role": None},
        {"gridsec_feeders": "north"},
        {"preferred_username": ""},
        {"preferred_username": "Ada\nEve"},
        {"preferred_username": "x" * 65},
        {"kid": "unknown"},
        {"alg": "none", "key": ""},
    ],
)
def test_invalid_tokens_are_refused(issuer: Issuer, claims: dict[str, Any]) -> None:
    claims = dict(claims)
    key, alg, kid = claims.pop("key", None), claims.pop("alg", ""), claims.pop("kid", "r")
    if alg == "none":
        text = jwt.encode(
            {"iss": issuer.url, "aud": "gridsec", "sub": "a"}, None, "none", headers={"kid": "r"}
        )
    else:
        text = issuer.token(kid="r", key=key, **claims)
        if kid != "r":
            text = issuer.token(kid=kid, key=issuer.rsa, alg="RS256", **claims)
    with pytest.raises(NotAuthenticated):
        verifier(issuer).identify(text)


def test_another_key_and_the_public_key_as_a_secret_are_refused(issuer: Issuer) -> None:
    other = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    with pytest.raises(NotAuthenticated):
        verifier(issuer).identify(issuer.token(key=other))
    head = {"kid": "r"}
    forged = jwt.encode({"sub": "a", "iss": issuer.url, "aud": "gridsec"}, "x" * 64, "HS256", headers=head)
    with pytest.raises(NotAuthenticated):
        verifier(issuer).identify(forged)
    with pytest.raises(NotAuthenticated):
        verifier(issuer).identify("no token")


def test_an_issuer_without_an_answer_authenticates_nothing(issuer: Issuer) -> None:
    token = issuer.token()
    for address in ("http://127.0.0.1:9", f"{issuer.url}/absent", "file:///etc"):
        with refused(IssuerUnavailable, "issuer-unavailable"):
            TokenVerifier(address, "gridsec").identify(token)


def test_a_key_of_another_algorithm_is_an_invalid_token(issuer: Issuer) -> None:
    """The header names ES256 and the id of the RSA key."""
    with pytest.raises(NotAuthenticated):
        verifier(issuer).identify(issuer.token(kid="r", key=issuer.ec, alg="ES256"))


def test_known_keys_stay_valid_while_the_issuer_does_not_answer(issuer: Issuer) -> None:
    made = verifier(issuer)
    assert made.identify(issuer.token()).name == "ada"
    client = made._client
    assert client is not None
    client.uri = "http://127.0.0.1:9/keys"
    assert client.jwk_set_cache is not None
    client.jwk_set_cache.jwk_set_with_timestamp = None
    client.get_signing_key.cache_clear() if hasattr(client.get_signing_key, "cache_clear") else None
    assert made.identify(issuer.token()).name == "ada"
    begun = time.monotonic()
    for _ in range(20):
        with refused(IssuerUnavailable, "issuer-unavailable"):
            made.identify(issuer.token(kid="e"))
    assert time.monotonic() - begun < 2.0


def test_names_are_printable() -> None:
    assert all(map(is_name, ("Ada", "Ada Lovelace", "Åsa-1", "x" * 64)))
    assert not any(map(is_name, ("", " Ada", "x" * 65, "a\nb", "a\x1b[2J", "a\u202eb", "a\u200bb")))


def test_texts_of_the_audit_log_are_printable_and_bounded(store: AccessStore) -> None:
    entry = store.append(NOW, "Ada", "key 1", "PUT", "/\x1b[2J\ud800", "x" * 10_000)
    assert entry.target == "/\\u001b[2J\\ud800"
    assert len(entry.detail) == 2000
    assert broken(store.audit()) is None


def test_reads_do_not_wait_for_a_writer(store: AccessStore, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "grid.db.access", isolation_level=None) as other:
        other.execute("BEGIN IMMEDIATE")
        begun = time.monotonic()
        assert store.keys() == []
        assert time.monotonic() - begun < 1.0
        other.execute("ROLLBACK")
    other.close()


def test_a_removed_or_replaced_file_is_not_read_on(store: AccessStore, tmp_path: Path) -> None:
    path = tmp_path / "grid.db.access"
    _, record = create("Ada", Role.ADMIN, None, NOW, None)
    store.add_key(record)
    kept = path.read_bytes()
    path.unlink()
    with refused(StoreUnavailable, "read-failed"):
        store.key(record.id)
    path.write_bytes(kept)
    assert store.revoke(record.id, NOW)
    found = store.key(record.id)
    assert found is not None
    assert found.revoked == NOW
