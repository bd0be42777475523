"""Readings of another identity: refused, counted, and an incident."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from feeders.model.site import Site, load
from service.access.signing import read_meter_keys, signed_bytes
from service.alarms.conditions import Severity, identity_mismatches
from service.alarms.incidents import IncidentKind, IncidentState
from service.alarms.state_machine import AlarmKind
from service.engine.engine import ORDER_S, Engine, RuntimeConfig
from service.engine.feeder_monitor import MISMATCH_S, design
from service.ingest.align import Clock
from service.ingest.queues import Sample
from service.store import Store
from service.store.state_codec import KeptInvalid, SnapshotKind, StateSnapshot, decode_signed
from tests.codes import refused

FEEDER, START = "simbench-lv-rural1", 1_795_212_000.0
SECRETS = {meter: bytes([k]) * 32 for k, meter in enumerate(("substation", "m01", "m02"))}
BATCH = f"gridsec/{FEEDER}/concentrator/c9/readings"


@pytest.fixture(scope="module")
def site() -> Site:
    return load(FEEDER)


class Signed:
    """A feeder at no load; three of its meters sign their readings, the others need no signature."""

    def __init__(self, site: Site, store: Store, keys: Path, second: int = 0) -> None:
        rows = [f"{FEEDER},{meter},hmac,{base64.b64encode(each).decode()}" for meter, each in SECRETS.items()]
        keys.write_text("\n".join(("feeder,meter,scheme,key", *rows)))
        self.site, self.store, self.second, self.wall = site, store, second, START + second - 0.5
        config = RuntimeConfig(clock=Clock.WALL, meter_keys=read_meter_keys(keys, accepts_unlisted=True))
        self.engine = Engine(config, store, [site], wall=lambda: self.wall, stored=lambda: None)
        self.engine.monitors[FEEDER].install(design(site))
        self.engine.begin()

    def run(self, seconds: int, *forged: Sample) -> None:
        """Readings of all meters each second; the forged ones come with the first of them."""
        for second in range(self.second, self.second + seconds):
            self.wall = START + second + 0.05
            self.engine.cycle([*self.readings(second), *(forged if second == self.second else ())])
            self.wall = START + second + 0.9
            self.engine.cycle([])
        self.second += seconds

    def readings(self, second: int) -> Iterator[Sample]:
        payload = json.dumps({"t": START + second, "v_volt": 230.9, "p_kw": 0.0, "q_kvar": 0.0}).encode()
        for meter in ("substation", *self.site.meter_ids):
            yield self.sample(meter, meter, payload, second)

    def sample(
        self, meter: str, signer: str, payload: bytes = b'{"t": 1, "v_volt": 250}', seq: int = 0
    ) -> Sample:
        """A reading on the key of a meter with the signature of another."""
        place = "substation" if meter == "substation" else f"meter/{meter}"
        key, attachment = f"gridsec/{FEEDER}/{place}/reading", b""
        if signer in SECRETS:
            content = signed_bytes("hmac", 1, seq, key, payload)
            signature = base64.b64encode(hmac.digest(SECRETS[signer], content, hashlib.sha256)).decode()
            attachment = f"v1 hmac 1:{seq} {signature}".encode()
        return Sample(key, payload, "", self.wall, len(payload), attachment)

    def standing(self) -> set[tuple[AlarmKind, str | None]]:
        return {(alarm.kind, alarm.meter) for alarm in self.store.active(FEEDER)}

    def forged(self, meter: str, signer: str) -> Sample:
        """A reading of now with a valid form, of another identity."""
        payload = json.dumps({"t": START + self.second, "v_volt": 250.0}).encode()
        return self.sample(meter, signer, payload, 10_000 + self.second)


@pytest.fixture
def signed(site: Site, tmp_path: Path) -> Iterator[Signed]:
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        yield Signed(site, store, tmp_path / "keys.csv")


def test_a_meter_that_publishes_as_another_is_refused_and_raises_one_incident(signed: Signed) -> None:
    signed.run(10)
    assert signed.standing() == set()
    signed.run(
        1, signed.forged("m01", "m02"), signed.forged("m02", "m01"), signed.forged("substation", "m01")
    )
    signed.run(4)
    expected = {(AlarmKind.IDENTITY_MISMATCH, meter) for meter in ("m01", "m02", "substation")}
    assert signed.standing() == expected
    (incident,) = signed.store.incidents()[0]
    assert (incident.kind, incident.severity, incident.alarms) == (
        IncidentKind.IDENTITY_MISMATCH, Severity.MAJOR, 3,
    )  # fmt: skip
    assert "does not fit key" in incident.reason
    refused = signed.store.rejected()
    assert [each.reason.partition(":")[0] for each in refused] == ["signature"] * 3
    assert 'reason="signature"} 3.0' in signed.engine.metrics.exposition().decode()
    report = signed.engine.monitors[FEEDER].report
    assert report is not None
    assert max(meter.v_volt_reported or 0.0 for meter in report.meters) < 240.0
    # The condition lasts for a minute after the latest reading, then the alarms and the incident clear.
    signed.run(int(MISMATCH_S) - 8)
    assert signed.standing() == expected
    signed.run(16)
    assert signed.standing() == set()
    assert signed.store.incidents()[0][0].state is IncidentState.CLEARED


def test_a_batch_of_another_concentrator_is_of_its_meters(signed: Signed) -> None:
    signed.run(3)
    rows = [{"meter": "m01", "t": START + 3.0, "v_volt": 250.0}] * 20
    payload = json.dumps(rows).encode()
    signed.run(1, Sample(BATCH, payload, "application/json", signed.wall, len(payload)))
    signed.run(5)
    assert signed.standing() == {(AlarmKind.IDENTITY_MISMATCH, "m01")}


def test_all_refused_meters_of_a_long_batch_and_the_busbar_have_an_alarm(signed: Signed) -> None:
    signed.run(3)
    # Each bad reading has an entry up to a limit, which the first meter exceeds.
    rows = [
        {"meter": meter, "t": START + 3.0, "v_volt": 250.0} for meter in ("m02", "m01") for _ in range(20)
    ]
    payload = json.dumps(rows).encode()
    batch = Sample(BATCH, payload, "application/json", signed.wall, len(payload))
    signed.run(1, batch, signed.forged("substation", "m01"))
    signed.run(5)
    expected = {(AlarmKind.IDENTITY_MISMATCH, meter) for meter in ("m01", "m02", "substation")}
    assert signed.standing() == expected


def test_a_replayed_or_malformed_reading_is_no_mismatch(signed: Signed) -> None:
    signed.run(5)
    again = next(iter(signed.readings(2)))
    signed.run(1, again, signed.sample("m01", "m01", b"{}", 99))
    signed.run(5)
    assert signed.standing() == set()
    assert {each.reason.partition(":")[0] for each in signed.store.rejected()} == {"replayed", "empty"}


def reasons(signed: Signed) -> list[str]:
    return [each.reason.partition(":")[0] for each in signed.store.rejected()]


def test_a_reading_of_before_a_restart_is_refused_after_it(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after `kill -9`: the first process stores nothing at its end."""
    monkeypatch.setattr("service.engine.engine.ORDER_S", 0.0)
    keys, url = tmp_path / "keys.csv", f"sqlite:///{tmp_path}/g.db"
    with Store(url) as store:
        first = Signed(site, store, keys)
        first.run(5)
        old = [sample for sample in first.readings(4) if sample.attachment]
        kept = store.signed(FEEDER)
        assert kept is not None
        assert {each.meter for each in decode_signed(FEEDER, kept)} == SECRETS.keys()
    with Store(url) as store:
        again = Signed(site, store, keys, 5)
        again.engine.cycle(old)
        again.run(3)
        assert reasons(again) == ["replayed"] * len(SECRETS)
        # A new key of a meter, which counts from the beginning, is another order.
        rows = keys.read_text().replace(base64.b64encode(SECRETS["m01"]).decode(), "bmV3IHNlY3JldCBvZiBtMDE=")
        keys.write_text(rows)
        renewed = read_meter_keys(keys, accepts_unlisted=True)
        renewed.restore(FEEDER, decode_signed(FEEDER, kept))
        assert {each.meter for each in renewed.orders(FEEDER)} == SECRETS.keys() - {"m01"}


def test_the_order_of_signed_readings_is_written_every_two_seconds_and_at_the_end(
    signed: Signed, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1000.0]
    monkeypatch.setattr("service.engine.engine.time.monotonic", lambda: now[0])

    def newest() -> int:
        signed.engine.committer.commit(at_once=True)
        kept = signed.store.signed(FEEDER)
        assert kept is not None
        return {each.meter: each.seq for each in decode_signed(FEEDER, kept)}["m01"]

    signed.run(3)
    first = newest()
    now[0] += ORDER_S
    signed.run(1)
    assert newest() == first + 3
    signed.run(1)
    assert newest() == first + 3
    signed.engine.keep_states(at_once=True)
    assert newest() == first + 4


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("{}", "damaged"),
        ('{"format": 9}', "newer-format"),
        ('{"format": 1, "feeder": "x", "t": 1.0, "meters": []}', "other-feeder"),
    ],
)
def test_a_stored_order_that_cannot_be_used_does_not_stop_the_service(
    site: Site, tmp_path: Path, text: str, code: str
) -> None:
    kept = StateSnapshot(FEEDER, START, text, SnapshotKind.SIGNED)
    with refused(KeptInvalid, code):
        decode_signed(FEEDER, kept)
    with Store(f"sqlite:///{tmp_path}/g.db") as store:
        store.commit(kept=[kept])
        again = Signed(site, store, tmp_path / "keys.csv")
        again.run(3)
        assert reasons(again) == []


def test_conditions_of_mismatches() -> None:
    found = identity_mismatches("town", {"m2": "no attachment", "m1": "wrong"})
    assert [(each.meter, each.kind, each.known) for each in found] == [
        ("m1", AlarmKind.IDENTITY_MISMATCH, True),
        ("m2", AlarmKind.IDENTITY_MISMATCH, True),
    ]
    assert identity_mismatches("town", {}) == []
