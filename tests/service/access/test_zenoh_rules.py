"""Access rules of a zenoh router by certificate, with real sessions over mutual TLS on loopback."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import zenoh

from gridsec.errors import InputInvalid
from service.access import pki, zenoh_rules
from service.access.pki import Kind
from service.access.signing import read_meter_keys
from service.ingest.decode import Wire
from service.ingest.queues import BusConfig, BusUnavailable, Sample
from service.ingest.reading import BadReason, Known
from service.ingest.zenoh_bus import Bus, MeterClient, session
from tests.codes import refused
from tests.service.running import free_port, until

NAMES = {
    "router": Kind.ROUTER,
    "service": Kind.SERVICE,
    "c1": Kind.CONCENTRATOR,
    "c2": Kind.CONCENTRATOR,
    "town.m05": Kind.METER,
    "scada": Kind.SUBSCRIBER,
}
TABLE = "certificate,feeder,meter\nc1,town,m01\nc1,town,substation\nc2,town,m02\nc2,village,m01\n"
FEEDERS = {"town": frozenset({"m01", "m02", "m05"}), "village": frozenset({"m01"})}


def planned(folder: Path, *endpoints: str, names: dict[str, Kind] = NAMES) -> zenoh_rules.Plan:
    """Certificates and a plan in a folder."""
    now = time.time()
    pki.create_authority(folder, now, lasts_s=1e6)
    for name, kind in names.items():
        pki.issue(folder, name, kind, now, lasts_s=1e5)
    (folder / "meters.csv").write_text(TABLE)
    table = zenoh_rules.read_assignments(folder / "meters.csv")
    ends = endpoints or (zenoh_rules.ENDPOINT,)
    return zenoh_rules.Plan(pki.certificates(folder), FEEDERS, table, ends, "gridsec", folder)


def write(plan: zenoh_rules.Plan) -> None:
    for name, content in zenoh_rules.files(plan).items():
        (plan.installed / name).write_text(content)


@dataclass
class Network:
    """A router, and the service as its client."""

    folder: Path
    endpoint: str
    bus: Bus
    samples: list[Sample] = field(default_factory=list)

    def keys(self) -> list[str]:
        return [sample.key for sample in self.samples]

    @contextmanager
    def client(self, name: str) -> Iterator[zenoh.Session]:
        with session(BusConfig(None, file=self.folder / f"{name}.json5")) as live:
            yield live


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    folder, end = tmp_path_factory.mktemp("ca"), f"tls/127.0.0.1:{free_port()}"
    write(planned(folder, end))
    samples: list[Sample] = []
    with ExitStack() as stack:
        stack.enter_context(session(BusConfig(None, file=folder / "router.json5")))
        config = BusConfig(None, file=folder / "service.json5")
        bus = stack.enter_context(Bus(config, "gridsec", samples.extend, max_payload=1000, lossless=True))
        yield Network(folder, end, bus, samples)


def test_a_certificate_publishes_the_keys_of_its_meters_only(network: Network) -> None:
    with network.client("c1") as c1, network.client("c2") as c2, network.client("town.m05") as m05:
        allowed = {
            c1: ["town/meter/m01/reading", "town/substation/reading", "town/concentrator/c1/readings"],
            c2: ["town/meter/m02/reading", "village/meter/m01/reading", "village/concentrator/c2/readings"],
            m05: ["town/meter/m05/reading"],
        }
        every = [key for keys in allowed.values() for key in keys]

        def put_all() -> bool:
            for live in allowed:
                for key in every:
                    live.put(f"gridsec/{key}", key)
                    live.delete(f"gridsec/{key}")
                live.put("gridsec/*/meter/*/reading", b"pattern")
            time.sleep(0.2)
            return set(network.keys()) >= {f"gridsec/{key}" for key in every}

        until(put_all)
        # Each key arrives from one of the three sessions only, in every repetition.
        rounds = network.keys().count("gridsec/town/meter/m05/reading")
        assert len(network.samples) <= (rounds + 1) * len(every)
        assert set(network.keys()) == {f"gridsec/{key}" for key in every}
    assert network.bus.counts.deleted == 0


def test_a_declared_publisher_reaches_the_service(network: Network) -> None:
    with network.client("c1") as c1:
        publisher = c1.declare_publisher("gridsec/town/meter/m01/reading")

        def arrived() -> bool:
            publisher.put(b"declared")
            return any(sample.payload == b"declared" for sample in network.samples)

        until(arrived)


def test_processes_of_a_cluster_reach_each_other_and_no_other_client_does(network: Network) -> None:
    config = BusConfig(None, file=network.folder / "service.json5")
    front = Bus(config, "gridsec", lambda _: None, max_payload=1000, lossless=False, everything=False)
    key = "@worker/w0/state"
    with front, network.client("c1") as meters:
        network.bus.serve(key, lambda payload, respond: respond(payload))
        until(lambda: list(front.ask(key, b"call", 2.0)) == [b"call"])
        replies = meters.get(f"gridsec/{key}", payload=b"call", timeout=1.0)
        assert [one.ok for one in replies if one.ok is not None] == []
        with meters.declare_queryable(f"gridsec/{key}", zenoh.handlers.FifoChannel(10)) as false:
            time.sleep(0.3)
            assert list(front.ask(key, b"call", 2.0)) == [b"call"]
            assert false.handler.try_recv() is None


def test_the_service_alone_publishes_estimates_and_alarms(network: Network) -> None:
    with network.client("scada") as scada, network.client("c1") as c1, network.client("c2") as reader:
        keys = ("gridsec/town/estimate", "gridsec/town/alarm/a1")
        seen = [reader.declare_subscriber(key, zenoh.handlers.FifoChannel(1000)) for key in keys]
        alive = c1.liveliness().declare_token("gridsec/service/forged")
        served = c1.declare_queryable(keys[0], zenoh.handlers.FifoChannel(10))
        readings = reader.declare_subscriber("gridsec/town/meter/**", zenoh.handlers.FifoChannel(10))
        number = 0

        def answered() -> dict[str, bytes]:
            nonlocal number
            number += 1
            for live in (scada, c1):
                for key in keys:
                    live.put(key, b"forged")
            network.bus.telemetry("town/estimate", b"%d" % number)
            network.bus.event("town/alarm/a1", b"%d" % number, last=False)
            c1.put("gridsec/town/meter/m01/reading", b"private")
            replies = reader.get("gridsec/*/estimate", timeout=2.0)
            return {str(one.ok.key_expr): one.ok.payload.to_bytes() for one in replies if one.ok}

        until(lambda: answered() and number > 3)
        for subscriber in seen:
            payloads = []
            while (sample := subscriber.try_recv()) is not None:
                payloads.append(sample.payload.to_bytes())
            assert payloads
            assert b"forged" not in payloads
        assert served.try_recv() is None
        assert readings.try_recv() is None
        tokens = reader.liveliness().get("gridsec/service/*", timeout=2.0)
        (token,) = (str(one.ok.key_expr) for one in tokens if one.ok)
        assert token != "gridsec/service/forged"
        alive.undeclare()


def test_a_client_without_certificate_cannot_connect(network: Network) -> None:
    text = json.loads((network.folder / "c1.json5").read_text().split("\n", 1)[1])
    for name in ("connect_certificate", "connect_private_key"):
        del text["transport"]["link"]["tls"][name]
    (network.folder / "bare.json5").write_text(json.dumps(text))
    with pytest.raises(BusUnavailable), network.client("bare"):
        pass
    plain = BusConfig("client", connect=(network.endpoint.replace("tls/", "tcp/"),))
    with pytest.raises(BusUnavailable), MeterClient(plain, "gridsec"):
        pass


def test_a_certificate_of_another_authority_or_beyond_its_expiry_cannot_connect(
    network: Network, tmp_path: Path
) -> None:
    pki.create_authority(tmp_path, time.time(), lasts_s=1e6)
    pki.issue(tmp_path, "c1", Kind.CONCENTRATOR, time.time(), lasts_s=1e5)
    pki.issue(network.folder, "c1", Kind.CONCENTRATOR, time.time() - 2000, lasts_s=1000, renew=True)
    text = (network.folder / "c1.json5").read_text()
    foreign = network.folder / "foreign.json5"
    foreign.write_text(text.replace(f"{network.folder}/c1.", f"{tmp_path}/c1."))
    for name in ("foreign", "c1"):
        with pytest.raises(BusUnavailable), network.client(name):
            pass


def test_a_meter_cannot_pass_for_the_router(tmp_path: Path) -> None:
    write(planned(tmp_path, f"tls/127.0.0.1:{free_port()}"))
    text = (tmp_path / "router.json5").read_text()
    (tmp_path / "false.json5").write_text(text.replace(f"{tmp_path}/router.", f"{tmp_path}/c2."))
    with (
        session(BusConfig(None, file=tmp_path / "false.json5")),
        pytest.raises(BusUnavailable),
        session(BusConfig(None, file=tmp_path / "c1.json5")),
    ):
        pass


def test_a_connection_ends_with_its_certificate(tmp_path: Path) -> None:
    plan = planned(tmp_path, f"tls/127.0.0.1:{free_port()}")
    pki.issue(tmp_path, "scada", Kind.SUBSCRIBER, time.time(), lasts_s=3.0, renew=True)
    write(plan)
    with (
        session(BusConfig(None, file=tmp_path / "router.json5")) as router,
        session(BusConfig(None, file=tmp_path / "c1.json5")) as c1,
        session(BusConfig(None, file=tmp_path / "scada.json5")) as scada,
    ):
        assert list(scada.info.routers_zid()) == [router.zid()]
        until(lambda: not list(scada.info.routers_zid()), "the end of the connection", 15.0)
        assert list(c1.info.routers_zid()) == [router.zid()]


def test_the_service_itself_can_be_the_router(tmp_path: Path) -> None:
    write(planned(tmp_path, f"tls/127.0.0.1:{free_port()}"))
    samples: list[Sample] = []
    config = BusConfig(None, file=tmp_path / "router.json5")
    with (
        Bus(config, "gridsec", samples.extend, max_payload=1000, lossless=True) as bus,
        session(BusConfig(None, file=tmp_path / "c1.json5")) as c1,
        session(BusConfig(None, file=tmp_path / "scada.json5")) as scada,
    ):
        seen = scada.declare_subscriber("gridsec/town/estimate", zenoh.handlers.FifoChannel(1000))

        def both() -> bool:
            c1.put("gridsec/town/meter/m02/reading", b"forged")
            c1.put("gridsec/town/estimate", b"forged")
            c1.put("gridsec/town/meter/m01/reading", b"own")
            bus.telemetry("town/estimate", b"true")
            sample = seen.try_recv()
            assert sample is None or sample.payload.to_bytes() == b"true"
            return sample is not None and bool(samples)

        until(both)
    assert {sample.payload for sample in samples} == {b"own"}


def test_a_refusal_of_the_router_is_a_line_of_its_log_only(tmp_path: Path) -> None:
    """The line states certificate and key. Sender and service learn nothing."""
    write(planned(tmp_path, f"tls/127.0.0.1:{free_port()}"))
    code = (
        "import sys; from pathlib import Path; from service.ingest.queues import BusConfig\n"
        "from service.ingest.zenoh_bus import session\n"
        "with session(BusConfig(None, file=Path(sys.argv[1]))): print('open', flush=True); sys.stdin.read()"
    )
    target = "zenoh::net::routing::interceptor::access_control=trace"
    with subprocess.Popen(
        [sys.executable, "-c", code, tmp_path / "router.json5"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | {"RUST_LOG": target},
    ) as router:  # fmt: skip
        assert router.stdout is not None
        lines = iter(router.stdout.readline, "")
        assert any("open" in line for line in lines)
        with session(BusConfig(None, file=tmp_path / "c2.json5")) as c2:
            key = "gridsec/town/meter/m01/reading"
            c2.put(key, b"forged")
            found = next(line for line in lines if "is unauthorized to Put (ingress)" in line)
        assert "CertCommonName(c2)" in found
        assert found.rstrip().endswith(key)
        router.communicate()


def test_forged_readings_of_meters_that_sign_reach_the_service(tmp_path: Path) -> None:
    """The service refuses them by their signature; those of other meters stay refused silently."""
    plan = planned(tmp_path, f"tls/127.0.0.1:{free_port()}")
    secret = base64.b64encode(b"secret of 16 bytes").decode()
    write(replace(plan, keys=(("town", "m02", "hmac", secret),), report_forgeries=True))
    samples: list[Sample] = []
    config = BusConfig(None, file=tmp_path / "router.json5")
    with (
        Bus(config, "gridsec", samples.extend, max_payload=1000, lossless=True),
        session(BusConfig(None, file=tmp_path / "c1.json5")) as c1,
    ):

        def forge() -> bool:
            for place in ("town/meter/m02", "town/meter/m05", "village/meter/m01"):
                c1.put(f"gridsec/{place}/reading", b'{"t": 1795212000, "v_volt": 250}')
            c1.put("gridsec/town/estimate", b"forged")
            c1.delete("gridsec/town/meter/m02/reading")
            return bool(samples)

        until(forge)
        time.sleep(0.2)
    assert {sample.key for sample in samples} == {"gridsec/town/meter/m02/reading"}
    keys = read_meter_keys(tmp_path / "meter-keys.csv", accepts_unlisted=False)
    known = {name: Known(sorted(meters), 230.0, 100.0) for name, meters in FEEDERS.items()}
    gathered = Wire(known, keys=keys).gather(samples)
    assert {(bad.reason, bad.feeder, bad.meter) for bad, _ in gathered.bad} == {
        (BadReason.SIGNATURE, "town", "m02")
    }
    assert gathered.readings == {}
    with refused(InputInvalid, "missing"):
        zenoh_rules.files(replace(plan, report_forgeries=True))


def test_the_router_has_a_rule_for_each_certificate(tmp_path: Path) -> None:
    plan = planned(tmp_path)
    made = zenoh_rules.files(plan)
    assert set(made) == {*(f"{name}.json5" for name in NAMES), "meter-keys.csv"}
    rules = json.loads(made["router.json5"].split("\n", 1)[1])["access_control"]
    assert rules["default_permission"] == "deny"
    keys = {rule["id"]: rule["key_exprs"] for rule in rules["rules"]}
    assert keys["publish town.m05"] == ["gridsec/town/meter/m05/reading"]
    assert keys["publish c1"] == [
        "gridsec/town/meter/m01/reading",
        "gridsec/town/substation/reading",
        "gridsec/town/concentrator/c1/readings",
    ]
    assert made["meter-keys.csv"].splitlines()[:2] == [
        "feeder,meter,scheme,key",
        "town,m01,certificate,c1",
    ]


def test_every_problem_of_a_plan_is_named(tmp_path: Path) -> None:
    plan = planned(tmp_path, names={"c1": Kind.CONCENTRATOR, "lone": Kind.METER})
    more = (
        zenoh_rules.Assignment("c9", "town", "m01"),
        zenoh_rules.Assignment("c1", "gone", "m01"),
        zenoh_rules.Assignment("c1", "town", "m99"),
    )
    wrong = replace(plan, assignments=plan.assignments[:1] + more, endpoints=("tcp/127.0.0.1:7447",))
    with pytest.raises(InputInvalid) as caught:
        zenoh_rules.files(wrong)
    assert sorted(caught.value.codes) == sorted(
        [
            "wrong-endpoint",
            "missing",
            "missing",
            "unknown-name",
            "duplicate",
            "unknown-name",
            "unknown-name",
            "missing",
        ]
    )


def test_keys_of_meters_that_sign_stay_in_the_table(tmp_path: Path) -> None:
    plan = planned(tmp_path)
    assert zenoh_rules.kept_keys(tmp_path) == ()
    write(plan)
    table = tmp_path / "meter-keys.csv"
    table.write_text(table.read_text().replace("m01,certificate,c1", "m01,hmac,c2VjcmV0IG9mIDE2IGJ5dGVz"))
    write(replace(plan, keys=zenoh_rules.kept_keys(tmp_path)))
    assert table.read_text().splitlines()[1:4] == [
        "town,m01,hmac,c2VjcmV0IG9mIDE2IGJ5dGVz",
        "town,m02,certificate,c2",
        "town,m05,certificate,town.m05",
    ]


def test_a_table_without_its_columns_is_refused(tmp_path: Path) -> None:
    assert zenoh_rules.read_assignments(None) == ()
    with refused(InputInvalid, "no-file"):
        zenoh_rules.read_assignments(tmp_path / "none.csv")
    (tmp_path / "t.csv").write_text("certificate,meter\nc1,m01\n")
    with refused(InputInvalid, "missing"):
        zenoh_rules.read_assignments(tmp_path / "t.csv")
