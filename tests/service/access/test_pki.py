"""Certificates with expiry, by the command line."""

from __future__ import annotations

import stat
import time
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

from gridsec.errors import InputInvalid
from service.access import pki
from service.access.pki import Kind
from tests.codes import refused
from tests.service.commands import command

run = command("pki")
NOW = 1.8e9


def test_an_authority_issues_certificates_that_name_hosts_and_purposes(tmp_path: Path) -> None:
    root = pki.create_authority(tmp_path / "ca", NOW, lasts_s=1e8)
    made = pki.issue(
        tmp_path / "ca", "router", Kind.ROUTER, NOW, lasts_s=1e6, hosts=("grid.example", "10.0.0.1")
    )
    meter = pki.issue(tmp_path / "ca", "town.m01", Kind.METER, NOW, lasts_s=2e6)
    authority, router, client = (
        x509.load_pem_x509_certificate(one.path.read_bytes()) for one in (root, made, meter)
    )
    for certificate in (router, client):
        certificate.verify_directly_issued_by(authority)
        key = certificate.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey)
        assert key.curve.name == "secp256r1"
        usage = certificate.extensions.get_extension_for_class(x509.KeyUsage).value
        assert usage.digital_signature
        assert not usage.key_cert_sign
    names = router.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["localhost", "grid.example"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1", "::1", "10.0.0.1"]
    purposes = client.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(purposes) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert authority.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert len({authority.serial_number, router.serial_number, client.serial_number}) == 3
    assert (meter.expires - NOW, meter.begins) == (2e6, NOW - pki.BACKDATED_S)
    for file in (tmp_path / "ca").glob("*.key"):
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_renewed_certificate_replaces_the_first(tmp_path: Path) -> None:
    pki.create_authority(tmp_path, NOW, lasts_s=1e8)
    first = pki.issue(tmp_path, "c1", Kind.CONCENTRATOR, NOW, lasts_s=10.0)
    with refused(InputInvalid, "exists"):
        pki.issue(tmp_path, "c1", Kind.CONCENTRATOR, NOW, lasts_s=10.0)
    assert pki.expired(pki.certificates(tmp_path), NOW + 10.0) == (first,)
    pki.issue(tmp_path, "c1", Kind.CONCENTRATOR, NOW, lasts_s=20.0, renew=True)
    assert pki.expired(pki.certificates(tmp_path), NOW + 10.0) == ()


def test_wrong_arguments_are_refused_together(tmp_path: Path) -> None:
    with refused(InputInvalid, "wrong-host", "inconsistent", "wrong-name", "no-file"):
        pki.issue(tmp_path, "../up", Kind.METER, NOW, lasts_s=1.0, hosts=("a b",))
    pki.create_authority(tmp_path, NOW, lasts_s=1e3)
    with refused(InputInvalid, "exists"):
        pki.create_authority(tmp_path, NOW, lasts_s=1e3)
    with refused(InputInvalid, "out-of-range"):
        pki.issue(tmp_path, "c1", Kind.METER, NOW, lasts_s=1e4)
    with refused(InputInvalid, "wrong-type"):
        pki.duration_s("1 year")
    assert [pki.duration_s(text) for text in ("12h", "1d", "2w", "1y")] == [
        43200.0,
        86400.0,
        1209600.0,
        3.1536e7,
    ]
    assert not list(tmp_path.glob("c1.*"))


def test_damaged_certificates_are_named(tmp_path: Path) -> None:
    with refused(InputInvalid, "no-file"):
        pki.certificates(tmp_path)
    made = pki.create_authority(tmp_path, NOW, lasts_s=1e6)
    pki.issue(tmp_path, "c1", Kind.METER, NOW, lasts_s=1.0)
    (tmp_path / "c1.crt").rename(tmp_path / "c2.crt")
    (tmp_path / "c3.crt").write_text("nothing")
    with refused(InputInvalid, "unreadable", "unreadable"):
        pki.certificates(tmp_path)
    (tmp_path / "authority.key").write_bytes((tmp_path / "c1.key").read_bytes())
    with refused(InputInvalid, "unreadable"):
        pki.issue(tmp_path, "c4", Kind.METER, NOW, lasts_s=1.0)
    made.path.write_text("nothing")
    with refused(InputInvalid, "unreadable"):
        pki.issue(tmp_path, "c4", Kind.METER, NOW, lasts_s=1.0)


def test_the_list_ends_with_code_1_after_an_expiry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "ca")
    assert run(monkeypatch, capsys, "init", folder)[0] == 0
    code, said, _ = run(
        monkeypatch, capsys, "issue", folder, "c1", "--kind", "concentrator", "--expires", "90d"
    )
    assert code == 0
    assert "concentrator, expires" in " ".join(said.split())
    code, said, _ = run(monkeypatch, capsys, "list", folder)
    assert code == 0
    assert "90.0" in said
    pki.issue(tmp_path / "ca", "old", Kind.METER, time.time() - 100.0, lasts_s=50.0)
    code, said, _ = run(monkeypatch, capsys, "list", folder)
    assert (code, said.count("expired")) == (1, 1)
    code, _, error = run(monkeypatch, capsys, "issue", folder, "c1", "--kind", "meter")
    assert code == 2
    assert "already" in error
