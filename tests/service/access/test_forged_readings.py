"""A certificate that publishes under another meter's key, through a router to a running service."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from feeders.model.site import load
from service.access import pki, zenoh_rules
from service.access.pki import Kind
from service.access.signing import signed_bytes
from service.cli.simulate import key_of
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session
from tests.service.running import FEEDER, free_port, service, until

START = 1_795_212_000.0
SECRET = b"secret of 16 bytes"
SIGNS, FOREIGN = "m02", "m03"
"""Meter with a key and a certificate of its own, and another meter with a certificate."""


def network(folder: Path) -> None:
    """Certificates and configurations: c1 for all meters but two, which have their own."""
    now, meters = time.time(), load(FEEDER).meter_ids
    own = {meter: f"{FEEDER}.{meter}" for meter in (SIGNS, FOREIGN)}
    kinds = {"router": Kind.ROUTER, "service": Kind.SERVICE, "c1": Kind.CONCENTRATOR}
    pki.create_authority(folder, now, lasts_s=1e6)
    for name, kind in (kinds | dict.fromkeys(own.values(), Kind.METER)).items():
        pki.issue(folder, name, kind, now, lasts_s=1e5)
    others = [meter for meter in (*meters, "substation") if meter not in own]
    table = tuple(zenoh_rules.Assignment("c1", FEEDER, meter) for meter in others)
    keys = ((FEEDER, SIGNS, "hmac", base64.b64encode(SECRET).decode()),)
    plan = zenoh_rules.Plan(
        pki.certificates(folder),
        {FEEDER: frozenset(meters)},
        table,
        (f"tls/127.0.0.1:{free_port()}",),
        "gridsec",
        folder,
        keys=keys,
        report_forgeries=True,
    )
    for name, content in zenoh_rules.files(plan).items():
        (folder / name).write_text(content)


def payload(second: float, volt: float = 230.9) -> bytes:
    return json.dumps({"t": START + second, "v_volt": volt, "p_kw": 0.0, "q_kvar": 0.0}).encode()


def attachment(key: str, content: bytes, seq: int) -> bytes:
    """Valid signature of the meter that signs."""
    made = hmac.digest(SECRET, signed_bytes("hmac", 1, seq, key, content), hashlib.sha256)
    return f"v1 hmac 1:{seq} {base64.b64encode(made).decode()}".encode()


def test_a_foreign_certificate_changes_nothing_and_opens_one_incident(tmp_path: Path) -> None:
    """The router passes what the service can refuse: 0 of the forged readings count, each is counted."""
    network(tmp_path)
    place = f"gridsec/{key_of(FEEDER, SIGNS)}"
    with ExitStack() as stack:
        stack.enter_context(session(BusConfig(None, file=tmp_path / "router.json5")))
        c1 = BusConfig(None, file=tmp_path / "c1.json5")
        live = stack.enter_context(
            service(
                tmp_path, clock="events", client=c1, zenoh_config=tmp_path / "service.json5",
                meter_keys=tmp_path / "meter-keys.csv",
            )
        )  # fmt: skip
        own, foreign = (
            stack.enter_context(session(BusConfig(None, file=tmp_path / f"{FEEDER}.{meter}.json5")))
            for meter in (SIGNS, FOREIGN)
        )
        second = 0

        def forge() -> None:
            foreign.put(place, payload(second, 250.0))  # without a signature
            foreign.put(place, payload(second, 250.0), attachment=attachment("other", b"", second))
            foreign.put(f"gridsec/{key_of(FEEDER, 'm01')}", payload(second, 250.0))  # the router refuses

        def tick(signed: bool, forged: Callable[[], None] | None = None) -> bool:
            nonlocal second
            second += 1
            for meter in (*load(FEEDER).meter_ids, "substation"):
                if meter not in {SIGNS, FOREIGN}:
                    live.put(key_of(FEEDER, meter), payload(second))
            if signed:
                content = payload(second)
                own.put(place, content, attachment=attachment(place, content, second))
            if forged is not None:
                forged()
            time.sleep(0.05)
            return bool(live.state())

        until(lambda: tick(signed=False), "the first tick")
        until(lambda: tick(signed=False, forged=forge) and live.get("/api/v1/incidents")["incidents"], "it")
        meters = {each["meter"]: each for each in live.state()["meters"]}
        assert (meters[SIGNS]["seen"], meters[SIGNS]["v_volt_reported"]) == (False, None)
        assert meters["m01"]["v_volt_reported"] < 240.0
        (incident,) = live.get("/api/v1/incidents")["incidents"]
        assert (incident["kind"], incident["severity"], incident["meters"]) == (
            "identity-mismatch", "major", [SIGNS],
        )  # fmt: skip
        refused = {(each["key"], each["reason"].partition(":")[0]) for each in live.rejected()}
        assert refused == {(place, "signature")}
        assert live.metric("gridsec_bad_readings_total", reason="signature") >= 2.0

        def own_reading() -> bool:
            tick(signed=True)
            return any(each["seen"] for each in live.state()["meters"] if each["meter"] == SIGNS)

        until(own_reading, "the meter's own reading")
