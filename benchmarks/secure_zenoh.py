"""Cost of access rules and signatures: start of a router and puts by number of rules, verification.

`python -m benchmarks.secure_zenoh` prints all.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import sys
import tempfile
import time
from pathlib import Path

import zenoh
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from service.access import pki, zenoh_rules
from service.access.signing import read_meter_keys, signed_bytes
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session

PUTS = 2000
KEY = "gridsec/town/meter/m0/reading"
PAYLOAD = b'{"t": 1795212000.25, "seq": 17, "v_volt": 231.4, "p_kw": 0.8, "q_kvar": 0.1}'


def start_s(count: int, folder: Path) -> tuple[float, float, float, float]:
    """Times of writing the files, the start of the router, the connection of one meter, and its puts, s."""
    now = time.time()
    pki.create_authority(folder, now, lasts_s=1e6)
    for name, kind in (
        ("router", pki.Kind.ROUTER),
        ("service", pki.Kind.SERVICE),
        ("c0", pki.Kind.CONCENTRATOR),
    ):
        pki.issue(folder, name, kind, now, lasts_s=1e5)
    real = pki.certificates(folder)
    more = [
        pki.Issued(f"town.m{k}", "meter", now, now + 1e5, k, folder / "none.crt") for k in range(1, count)
    ]
    meters = frozenset(f"m{k}" for k in range(count))
    table = (zenoh_rules.Assignment("c0", "town", "m0"),)
    plan = zenoh_rules.Plan(
        (*real, *more), {"town": meters}, table, ("tls/127.0.0.1:17447",), "gridsec", folder
    )
    begun = time.perf_counter()
    made = zenoh_rules.files(plan)
    for name in ("router.json5", "c0.json5"):
        (folder / name).write_text(made[name])
    written = time.perf_counter()
    with session(BusConfig(None, file=folder / "router.json5")) as router:
        up = time.perf_counter()
        arrived = router.declare_subscriber("gridsec/*/**/reading$*", zenoh.handlers.FifoChannel(2 * PUTS))
        declared = time.perf_counter()
        with session(BusConfig(None, file=folder / "c0.json5")) as meter:
            connected = time.perf_counter()
            for _ in range(PUTS):
                meter.put(KEY, PAYLOAD, congestion_control=zenoh.CongestionControl.BLOCK)
            for _ in range(PUTS):
                arrived.recv()
            sent = time.perf_counter()
    return written - begun, up - written, connected - declared, sent - connected


def verification_us(scheme: str, folder: Path, rounds: int = 2000) -> float:
    """Time of one verification, us; the median of 5 repetitions."""
    private, secret = Ed25519PrivateKey.generate(), bytes(range(32))
    public = private.public_key().public_bytes_raw()
    key = base64.b64encode(public if scheme == "ed25519" else secret).decode()
    (folder / "keys.csv").write_text(f"feeder,meter,scheme,key\ntown,m0,{scheme},{key}\n")
    keys = read_meter_keys(folder / "keys.csv", accepts_unlisted=False)
    times = []
    for epoch in range(5):
        sent = []
        for seq in range(rounds):
            content = signed_bytes(scheme, epoch, seq, KEY, PAYLOAD)
            signature = (
                private.sign(content) if scheme == "ed25519" else hmac.digest(secret, content, hashlib.sha256)
            )
            sent.append(f"v1 {scheme} {epoch}:{seq} {base64.b64encode(signature).decode()}".encode())
        begun = time.perf_counter()
        refused = [one for one in sent if keys.check("town", "m0", KEY, PAYLOAD, one) is not None]
        times.append((time.perf_counter() - begun) / rounds * 1e6)
        if refused:
            raise SystemExit("a valid signature was refused")
    return sorted(times)[2]


def main() -> None:
    """Print all times."""
    for count in map(int, sys.argv[1:] or ("1", "1000", "10000")):
        with tempfile.TemporaryDirectory() as folder:
            written, up, connected, sent = start_s(count, Path(folder))
        print(
            f"{count:6} rules: files {written:.2f} s, start {up:.2f} s, "
            f"connection {connected * 1e3:.0f} ms, {sent / PUTS * 1e6:.0f} us per reading"
        )
    for scheme in ("ed25519", "hmac"):
        with tempfile.TemporaryDirectory() as folder:
            print(f"{scheme}: {verification_us(scheme, Path(folder)):.0f} us per reading")


if __name__ == "__main__":
    main()
