"""Certificate authority of a private network: certificates with expiry for mutual TLS.

A folder holds `authority.crt`, `authority.key`, and `NAME.crt`, `NAME.key` of each certificate. Keys are
ECDSA P-256, signatures ECDSA with SHA-256. A certificate has its name as common name and its kind as
organizational unit.
"""

from __future__ import annotations

import datetime as dt
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from gridsec.errors import InputInvalid, Problem

AUTHORITY = "authority"
LOOPBACK = ("localhost", "127.0.0.1", "::1")
DAY_S = 86_400.0
BACKDATED_S = 300.0
"""Start of validity before the time of issue, s; covers offsets of clocks."""

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}")
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*")
_DURATION = re.compile(r"([1-9][0-9]{0,4})([hdwy])")
_UNITS_S = {"h": 3600.0, "d": DAY_S, "w": 7 * DAY_S, "y": 365 * DAY_S}


class Kind(StrEnum):
    """Purpose of a certificate."""

    ROUTER = "router"
    SERVICE = "service"
    CONCENTRATOR = "concentrator"
    METER = "meter"
    SUBSCRIBER = "subscriber"


@dataclass(frozen=True, slots=True)
class Issued:
    """A certificate: name, kind ("authority" for the authority), validity (Unix s), serial number, file."""

    name: str
    kind: str
    begins: float
    expires: float
    serial: int
    path: Path

    def days_left(self, now: float) -> float:
        """Time until expiry, days; negative afterwards."""
        return (self.expires - now) / DAY_S


def duration_s(text: str) -> float:
    """Return a duration such as `12h`, `90d`, `2w` or `1y` (365 days), s; InputInvalid otherwise."""
    found = _DURATION.fullmatch(text)
    if found is None:
        raise _invalid("wrong-type", f"{text!r} is not a duration; expected 12h, 90d, 2w or 1y")
    return int(found[1]) * _UNITS_S[found[2]]


def create_authority(folder: Path, now: float, *, lasts_s: float) -> Issued:
    """Create the authority of a folder; now is in Unix s.

    Raises
    ------
    InputInvalid
        If the folder has an authority already.
    """
    if _certificate(folder, AUTHORITY).exists():
        raise _invalid("exists", f"{folder} has an authority already; expected a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _subject(f"gridsec authority {x509.random_serial_number():x}"[:40], AUTHORITY)
    made = (
        _builder(subject, subject, key.public_key(), now, lasts_s)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    _write(folder, AUTHORITY, key, made)
    return _read(_certificate(folder, AUTHORITY))


def issue(
    folder: Path,
    name: str,
    kind: Kind,
    now: float,
    *,
    lasts_s: float,
    hosts: Sequence[str] = (),
    renew: bool = False,
) -> Issued:
    """Issue a certificate with a new private key.

    Parameters
    ----------
    now
        Unix s.
    hosts
        Names and addresses of a router, beside those of the loopback interface.
    renew
        Replace the certificate of this name.

    Raises
    ------
    InputInvalid
        With every problem of the arguments and of the authority.
    """
    problems = [
        Problem("wrong-host", f"{host!r} is neither a host name nor an address")
        for host in hosts
        if not _is_host(host)
    ]
    if hosts and kind is not Kind.ROUTER:
        problems.append(Problem("inconsistent", "only a router has hosts"))
    if not _NAME.fullmatch(name) or name == AUTHORITY:
        text = f"{name!r} is not a name; expected 1 to 64 of the characters A-Z a-z 0-9 _ . -"
        problems.append(Problem("wrong-name", text))
    elif _certificate(folder, name).exists() and not renew:
        problems.append(Problem("exists", f"{folder} has a certificate {name!r} already; renew replaces it"))
    signer, authority = _authority(folder, problems)
    if authority is not None and now + lasts_s > authority.not_valid_after_utc.timestamp():
        end = authority.not_valid_after_utc
        problems.append(Problem("out-of-range", f"the authority itself expires on {end:%Y-%m-%d}"))
    if problems or signer is None or authority is None:
        raise InputInvalid(problems)
    key = ec.generate_private_key(ec.SECP256R1())
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    built = (
        _builder(_subject(name, kind), authority.subject, key.public_key(), now, lasts_s)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
    )
    if kind is Kind.ROUTER:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = [_general_name(host) for host in dict.fromkeys((*LOOPBACK, *hosts))]
        built = built.add_extension(x509.SubjectAlternativeName(names), critical=False)
    built = built.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    _write(folder, name, key, built.sign(signer, hashes.SHA256()))
    return _read(_certificate(folder, name))


def certificates(folder: Path) -> tuple[Issued, ...]:
    """Return the certificates of a folder, the authority first, then by name.

    Raises
    ------
    InputInvalid
        If the folder has no authority, or for every certificate that cannot be read.
    """
    if not _certificate(folder, AUTHORITY).is_file():
        raise InputInvalid([_no_authority(folder)])
    found: list[Issued] = []
    problems: list[str] = []
    for path in sorted(folder.glob("*.crt"), key=lambda one: (one.stem != AUTHORITY, one.stem)):
        try:
            found.append(_read(path))
        except InputInvalid as error:
            problems.extend(error.problems)
    if problems:
        raise InputInvalid(problems)
    return tuple(found)


def expired(issued: Iterable[Issued], now: float) -> tuple[Issued, ...]:
    """Return the certificates that have expired at a time, Unix s."""
    return tuple(one for one in issued if one.expires <= now)


def write_private(path: Path, content: bytes) -> None:
    """Replace a file by one with mode 0600 from its beginning."""
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)
    new.replace(path)


def _invalid(code: str, text: str) -> InputInvalid:
    return InputInvalid([Problem(code, text)])


def _no_authority(folder: Path) -> Problem:
    return Problem("no-file", f"{folder} has no authority; expected a folder made by `gridsec pki init`")


def _certificate(folder: Path, name: str) -> Path:
    return folder / f"{name}.crt"


def _key(folder: Path, name: str) -> Path:
    return folder / f"{name}.key"


def _is_host(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return len(host) <= 253 and _HOST.fullmatch(host) is not None
    return True


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _subject(name: str, kind: str) -> x509.Name:
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, kind),
            x509.NameAttribute(NameOID.COMMON_NAME, name),
        ]
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: float, lasts_s: float
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_utc(now - BACKDATED_S))
        .not_valid_after(_utc(now + lasts_s))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _utc(t: float) -> dt.datetime:
    return dt.datetime.fromtimestamp(int(t), dt.UTC)


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _write(folder: Path, name: str, key: ec.EllipticCurvePrivateKey, made: x509.Certificate) -> None:
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_private(_key(folder, name), pem)
    _certificate(folder, name).write_bytes(made.public_bytes(serialization.Encoding.PEM))


def _authority(
    folder: Path, problems: list[Problem]
) -> tuple[ec.EllipticCurvePrivateKey | None, x509.Certificate | None]:
    """Private key and certificate of the authority; None and a problem where they cannot be used."""
    files = _key(folder, AUTHORITY), _certificate(folder, AUTHORITY)
    if not all(file.is_file() for file in files):
        problems.append(_no_authority(folder))
        return None, None
    try:
        key = serialization.load_pem_private_key(files[0].read_bytes(), None)
        certificate = x509.load_pem_x509_certificate(files[1].read_bytes())
    except (ValueError, TypeError) as error:
        problems.append(Problem("unreadable", f"{folder}: the authority cannot be read: {error}"))
        return None, None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or certificate.public_key() != key.public_key():
        problems.append(Problem("unreadable", f"{folder}: key and certificate of the authority differ"))
        return None, None
    return key, certificate


def _read(path: Path) -> Issued:
    try:
        made = x509.load_pem_x509_certificate(path.read_bytes())
        (name,) = made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        (kind,) = made.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)
    except ValueError as error:
        raise _invalid("unreadable", f"{path} is not a certificate of `gridsec pki`") from error
    authority = path.stem == AUTHORITY
    if authority != (kind.value == AUTHORITY) or (not authority and str(name.value) != path.stem):
        raise _invalid("unreadable", f"{path} has the name {str(name.value)!r} and the kind {kind.value!r}")
    return Issued(
        AUTHORITY if authority else path.stem,
        str(kind.value),
        made.not_valid_before_utc.timestamp(),
        made.not_valid_after_utc.timestamp(),
        made.serial_number,
        path,
    )
