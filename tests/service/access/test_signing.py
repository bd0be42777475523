"""Signed readings: keys of meters, order, and the way of a refused reading to the bad readings."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from gridsec.errors import InputInvalid
from service.access import signing
from service.access.signing import SignedOrder, read_meter_keys, signed_bytes
from service.ingest.decode import Wire
from service.ingest.reading import Known
from service.settings import SettingsInvalid, settings
from tests.codes import refused
from tests.service.ticks import listed

PRIVATE, SECRET = Ed25519PrivateKey.from_private_bytes(bytes(range(32))), bytes(range(32))
READING = b'{"t": 1795212000.0, "v_volt": 231.0}'
TABLE = f"""feeder,meter,scheme,key
town,m01,ed25519,{base64.b64encode(PRIVATE.public_key().public_bytes_raw()).decode()}
town,substation,hmac,{base64.b64encode(SECRET).decode()}
town,m02,certificate,c1
"""
KNOWN = {"town": Known(("m01", "m02", "m03"), 231.0, 100.0)}


def attached(scheme: str, epoch: int, seq: int, key: str, payload: bytes) -> bytes:
    """Attachment of a reading."""
    content = signed_bytes(scheme, epoch, seq, key, payload)
    signature = PRIVATE.sign(content) if scheme == "ed25519" else hmac.digest(SECRET, content, hashlib.sha256)
    return f"v1 {scheme} {epoch}:{seq} {base64.b64encode(signature).decode()}".encode()


@pytest.fixture
def wire(tmp_path: Path) -> Wire:
    (tmp_path / "keys.csv").write_text(TABLE)
    return Wire(KNOWN, keys=read_meter_keys(tmp_path / "keys.csv", accepts_unlisted=False))


def result(wire: Wire, key: str, payload: bytes = READING, attachment: bytes = b"") -> list[str]:
    """Reasons of the bad readings and ids of the good ones."""
    decoded = listed(wire.decode(f"gridsec/town/{key}", payload, attachment=attachment), KNOWN["town"])
    return [*(str(one.reason) for one in decoded.bad), *(str(one.meter) for one in decoded.readings)]


@pytest.mark.parametrize(
    ("scheme", "place", "meter"), [("ed25519", "meter/m01", "m01"), ("hmac", "substation", "None")]
)
def test_a_signature_fits_one_key_payload_and_order(wire: Wire, scheme: str, place: str, meter: str) -> None:
    key = f"gridsec/town/{place}/reading"

    def sent(epoch: int, seq: int, payload: bytes = READING, signed: str = key) -> list[str]:
        return result(wire, f"{place}/reading", payload, attached(scheme, epoch, seq, signed, READING))

    assert sent(1, 5) == [meter]
    assert sent(1, 5) == ["replayed"]
    assert sent(1, 4) == ["replayed"]
    assert sent(0, 9) == ["replayed"]
    assert sent(1, 6, READING.replace(b"231.0", b"232.0")) == ["signature"]
    assert sent(1, 6, signed="gridsec/town/meter/m02/reading") == ["signature"]
    # A refused reading does not change the order.
    assert sent(1, 6) == [meter]
    assert sent(2, 0) == [meter]


def test_readings_without_a_valid_attachment_are_refused(wire: Wire) -> None:
    good = attached("ed25519", 1, 1, "gridsec/town/meter/m01/reading", READING)
    other = attached("hmac", 1, 1, "gridsec/town/meter/m01/reading", READING)
    wrong = (
        b"",
        b"v1",
        good + b" ",
        good.replace(b"1:1", b"1:2"),
        b" A".join(good.rsplit(b" ", 1)),
        other,
        b"\xff" * 300,
    )
    for attachment in wrong:
        assert result(wire, "meter/m01/reading", READING, attachment) == ["signature"]
    assert result(wire, "meter/m01/reading", READING, good) == ["m01"]
    assert result(wire, "meter/m03/reading") == ["signature"]


def test_a_meter_of_a_certificate_is_accepted_from_its_concentrator_only(wire: Wire, tmp_path: Path) -> None:
    batch = json.dumps([{"meter": m, "t": 1795212000.0, "v_volt": 231.0} for m in ("m01", "m02")]).encode()
    assert result(wire, "concentrator/c1/readings", batch) == ["signature", "m02"]
    assert result(wire, "concentrator/c2/readings", batch) == ["signature", "signature"]
    assert result(wire, "meter/m02/reading") == ["m02"]
    many = json.dumps([{"meter": "m03", "t": 1795212000.0, "v_volt": 231.0}] * 20).encode()
    decoded = wire.decode("gridsec/town/concentrator/c1/readings", many)
    assert [one.count for one in decoded.bad] == [1] * 5 + [15]
    lenient = Wire(KNOWN, keys=read_meter_keys(tmp_path / "keys.csv", accepts_unlisted=True))
    assert result(lenient, "concentrator/c1/readings", many) == ["m03"] * 20
    assert result(lenient, "meter/m01/reading") == ["signature"]


def test_every_problem_of_a_table_is_named(tmp_path: Path) -> None:
    path = tmp_path / "keys.csv"
    with refused(InputInvalid, "unreadable"):
        read_meter_keys(path, accepts_unlisted=False)
    path.write_text("feeder,meter\n")
    with refused(InputInvalid, "missing"):
        read_meter_keys(path, accepts_unlisted=False)
    rows = ("a,m0,rsa,x", "a,m1,hmac,c2hvcnQ=", "a,m2,ed25519,c2hvcnQ=", "a,m3,hmac,?", "a,m4,certificate,")
    path.write_text("\n".join(("feeder,meter,scheme,key", *rows)))
    with refused(InputInvalid, "unknown-name", "wrong-key", "wrong-key", "wrong-key", "wrong-key"):
        read_meter_keys(path, accepts_unlisted=False)
    path.write_text(TABLE + TABLE.splitlines()[1])
    with pytest.raises(SettingsInvalid) as caught:
        settings({"meter_keys": path}).read_meter_keys()
    assert caught.value.codes == ("duplicate",)
    assert "--meter-keys" in str(caught.value)
    assert settings({}).read_meter_keys() is None


def test_the_longest_attachment_is_read() -> None:
    largest = 2**63 - 1
    assert len(attached("ed25519", largest, largest, "k", b"")) <= signing.ATTACHMENT_MAX


def test_the_orders_of_a_feeder_are_those_of_its_meters(tmp_path: Path) -> None:
    feeders, meters = [f"f{k}" for k in range(3)], ["m0", "m1"]
    key = base64.b64encode(SECRET).decode()
    rows = (f"{feeder},{meter},hmac,{key}" for feeder in feeders for meter in meters)
    (tmp_path / "keys.csv").write_text("\n".join(("feeder,meter,scheme,key", *rows)))
    keys = read_meter_keys(tmp_path / "keys.csv", accepts_unlisted=False)
    digest = keys.entries["f0", "m0"].digest
    for k, feeder in enumerate(feeders):
        keys.restore(feeder, [SignedOrder(meter, digest, k, 1) for meter in meters])
    for k, feeder in enumerate(feeders):
        assert keys.orders(feeder) == [SignedOrder(meter, digest, k, 1) for meter in meters]
