"""Checks of the certificate files of a TLS configuration: readability, validity, key, authority."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization

from service.access.pki import DAY_S

AUTHORITY = "root_ca_certificate"
PAIRS = (("connect_certificate", "connect_private_key"), ("listen_certificate", "listen_private_key"))
"""Names of certificates and their keys in the section `transport/link/tls` of zenoh's configuration."""
SOON_S = 30 * DAY_S
"""Time before the expiry of a certificate that is announced, s."""


@dataclass(frozen=True, slots=True)
class FileCheck:
    """Result of the check of one certificate file."""

    path: Path
    expires: float | None  # Unix s; None if it cannot be read
    problem: str = ""  # reason why TLS with it fails; empty without one

    def expires_soon(self, now: float) -> bool:
        """True if it is valid at `now`, Unix s, and expires within `SOON_S`."""
        return not self.problem and self.expires is not None and self.expires - now < SOON_S


def check_files(files: Mapping[str, str], now: float) -> Iterator[FileCheck]:
    """Yield the result of each certificate, the authority first; a file of two names is checked once.

    files: paths by name, as in `AUTHORITY` and `PAIRS`.
    now: Unix s.
    """
    authorities: list[x509.Certificate] = []
    if AUTHORITY in files:
        path = Path(files[AUTHORITY])
        result, authorities = _read(path, now)
        yield result
    done: set[tuple[str, str | None]] = set()
    for certificate, key in PAIRS:
        pair = files.get(certificate, ""), files.get(key)
        if pair[0] and pair not in done:
            done.add(pair)
            yield _pair(Path(pair[0]), pair[1], authorities, now)


def _read(path: Path, now: float) -> tuple[FileCheck, list[x509.Certificate]]:
    """Result of a file by itself, and its certificates."""
    try:
        chain = x509.load_pem_x509_certificates(path.read_bytes())
    except OSError as error:
        return FileCheck(path, None, f"cannot be read: {error.strerror or error}"), []
    except ValueError:
        return FileCheck(path, None, "is not a certificate in PEM"), []
    begins = max(one.not_valid_before_utc.timestamp() for one in chain)
    expires = min(one.not_valid_after_utc.timestamp() for one in chain)
    problem = ""
    if expires <= now:
        problem = f"expired on {_day(expires)}; issue it again (`gridsec pki issue --renew`)"
    elif begins > now:
        problem = f"is valid from {_day(begins)} on; set the clock"
    return FileCheck(path, expires, problem), chain


def _pair(path: Path, key: str | None, authorities: list[x509.Certificate], now: float) -> FileCheck:
    result, chain = _read(path, now)
    if result.problem or not chain:
        return result
    problem = "the configuration names no private key" if key is None else _key_problem(Path(key), chain[0])
    if not problem and authorities and not _issued(chain[-1], authorities):
        problem = "is not issued by the authority of the configuration"
    return FileCheck(path, result.expires, problem)


def _key_problem(path: Path, certificate: x509.Certificate) -> str:
    """Reason why a file is not the private key of a certificate; empty if it is."""
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        return f"its key {path} cannot be read: {error.strerror or error}"
    except (ValueError, TypeError, UnsupportedAlgorithm):
        return f"{path} is not a private key in PEM without a password"
    return "" if key.public_key() == certificate.public_key() else f"{path} is the key of another certificate"


def _issued(certificate: x509.Certificate, authorities: list[x509.Certificate]) -> bool:
    for authority in authorities:
        try:
            certificate.verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature):
            continue
        return True
    return False


def _day(t: float) -> str:
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d}"
