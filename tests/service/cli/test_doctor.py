"""Version, start without a feeder, and `gridsec doctor`: each check with and without its problem."""

from __future__ import annotations

import os
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import pytest

from feeders.format.tables import to_json
from feeders.model.site import load
from service.access import pki, zenoh_rules
from service.access.pki import Kind
from service.cli import doctor
from service.cli.doctor import Finding, Level
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session
from service.notify.webhook import new_secret
from service.store import Store
from service.store.backup import NEWEST
from tests.service.commands import command
from tests.service.databases import Cluster
from tests.service.issuer import issuing
from tests.service.running import FEEDER, free_port
from tests.service.stored import T0, a_report, an_alarm, raised

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("GRIDSEC_")}
Patch = pytest.MonkeyPatch
Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _bare(monkeypatch: Patch) -> None:
    for name in set(os.environ) - set(ENVIRONMENT):
        monkeypatch.delenv(name)


def test_version(monkeypatch: Patch, capsys: Capture) -> None:
    assert command()(monkeypatch, capsys, "--version") == (0, f"gridsec {metadata.version('gridsec')}\n", "")


@pytest.mark.acceptance
def test_a_service_without_a_feeder_names_the_ways_to_add_one(tmp_path: Path) -> None:
    with subprocess.Popen(
        [*COMMAND, "serve", "--zenoh-listen", f"tcp/127.0.0.1:{free_port()}", "--http", "127.0.0.1:0",
         "--database", f"sqlite:///{tmp_path / 'g.db'}"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        assert child.stderr is not None
        url = child.stdout.readline().strip()
        lines = [child.stderr.readline()]
        while "no feeder is monitored" not in lines[-1]:
            assert lines[-1], lines
            lines.append(child.stderr.readline())
        child.terminate()
        assert f"--feeder DIR, or PUT {url}/api/v1/feeders/NAME" in lines[-1]


def result(text: str) -> dict[str, list[tuple[str, str]]]:
    """Level and text of the lines of each part."""
    out: dict[str, list[tuple[str, str]]] = {}
    for line in text.splitlines():
        level, _, rest = line.partition(" ")
        part, _, words = rest.strip().partition(":")
        out.setdefault(part, []).append((level, words.strip()))
    return out


def filled(url: str, t: float) -> None:
    """Make a database with an alarm and a tick."""
    with Store(url) as store:
        store.commit([raised(an_alarm())], reports=[a_report(t)])


def test_a_machine_in_order(tmp_path: Path, monkeypatch: Patch, capsys: Capture) -> None:
    url, http = f"sqlite:///{tmp_path / 'g.db'}", free_port()
    filled(url, time.time() - 30.0)
    zenoh = f"tcp/127.0.0.1:{free_port()}"
    arguments = ("--database", url, "--http", f"127.0.0.1:{http}", "--feeder", FEEDER)
    with session(BusConfig("router", listen=(zenoh,))):
        code, out, _ = command("doctor")(
            monkeypatch, capsys, *arguments, "--zenoh-connect", zenoh, "--zenoh-listen",
            f"tcp/127.0.0.1:{free_port()}",
        )  # fmt: skip
    found = result(out)
    assert code == 0, out
    assert list(found) == [
        *("version", "database", "disk", "clock", "http", "zenoh", "feeder", "descriptors", "optional")
    ]
    assert not [line for lines in found.values() for line in lines if line[0] == "FAIL"]
    assert f"schema version {NEWEST}" in found["database"][0][1]
    assert found["clock"][0][1].endswith("s after the newest tick of the database")
    assert found["http"] == [("ok", f"127.0.0.1:{http} is free")]
    assert found["zenoh"][1] == ("ok", f"{zenoh} answers")
    assert found["feeder"][0][1].startswith(f"{FEEDER}: 13 meters, modal, M = ")


def test_every_problem_has_its_line(tmp_path: Path, monkeypatch: Patch, capsys: Capture) -> None:
    url = f"sqlite:///{tmp_path / 'g.db'}"
    filled(url, time.time() + 3600.0)
    monkeypatch.setattr(doctor, "FREE_BYTES", 1 << 60)
    with socket.create_server(("127.0.0.1", 0)) as busy, Store(url):
        address = f"127.0.0.1:{busy.getsockname()[1]}"
        code, out, _ = command("doctor")(
            monkeypatch, capsys, "--database", url, "--http", address, "--zenoh-listen", f"tcp/{address}",
            "--feeder", str(tmp_path / "none"),
        )  # fmt: skip
    found = result(out)
    assert code == 1
    assert ("note", "another process writes it; a second service does not start beside it") in found[
        "database"
    ]
    assert found["disk"][0][0] == "FAIL"
    assert "before the newest tick of the database; set the clock" in found["clock"][0][1]
    assert found["http"] == [
        ("FAIL", f"{address}: Address already in use; end the other process, or choose another --http")
    ]
    assert found["zenoh"][0] == (
        "FAIL",
        f"tcp/{address}: Address already in use; choose another --zenoh-listen",
    )
    assert found["feeder"][0][0] == "FAIL"


def test_databases_that_cannot_be_used(tmp_path: Path) -> None:
    newer, notes = tmp_path / "newer.db", tmp_path / "notes.db"
    filled(f"sqlite:///{newer}", T0)
    with sqlite3.connect(newer) as connection:
        connection.execute("UPDATE schema_version SET version = 99")
    connection.close()
    notes.write_text("not a database " * 100)
    for path, words in ((newer, "schema version 99"), (notes, "is not a database")):
        state, (finding,) = doctor._database(f"sqlite:///{path}")
        assert (state, finding.level) == (None, Level.FAIL)
        assert words in finding.text
    _, found = doctor._database(f"sqlite:///{tmp_path}/missing/g.db")
    assert any(each.level is Level.FAIL and "does not exist" in each.text for each in found)


def test_feeders_of_the_database_are_checked(tmp_path: Path, monkeypatch: Patch, capsys: Capture) -> None:
    url = f"sqlite:///{tmp_path / 'g.db'}"
    run = command("doctor")
    arguments = ("--database", url, "--http", f"127.0.0.1:{free_port()}")
    arguments += ("--zenoh-listen", f"tcp/127.0.0.1:{free_port()}")
    _, out, _ = run(monkeypatch, capsys, *arguments)
    assert result(out)["feeder"] == [("note", "none; add --feeder DIR, or PUT one over REST")]
    with Store(url) as store:
        store.commit(put=("cigre-lv", to_json(load("cigre-lv").tables)))
        store.commit(put=(FEEDER, {"feeder": {}}))
    code, out, _ = run(monkeypatch, capsys, *arguments)
    good, bad = result(out)["feeder"]
    assert (code, good[0], bad[0]) == (1, "ok", "FAIL")
    assert bad[1].startswith(f"{FEEDER}: ")
    code, out, _ = run(monkeypatch, capsys, *arguments, "--feeder", FEEDER)
    assert [level for level, _ in result(out)["feeder"]] == ["ok", "ok"]


TARGETS = """
[[webhook]]
name = "public"
url = "https://192.0.32.8/hook"
secret_file = "{key}"
[[webhook]]
name = "inside"
url = "https://127.0.0.1:{port}/hook"
secret = "{secret}"
[[webhook]]
name = "no-authority"
url = "https://192.0.32.8/hook"
secret = "{secret}"
ca_file = "{key}"
[[webhook]]
name = "unknown"
url = "https://{label}.example/hook"
secret = "{secret}"
[[alertmanager]]
name = "room"
url = "http://127.0.0.1:{port}"
private_addresses = true
"""


def test_targets_of_notifications_are_checked_and_get_nothing(tmp_path: Path) -> None:
    assert list(doctor._notifications(None)) == []
    secret, key, file = new_secret(), tmp_path / "key", tmp_path / "targets.toml"
    key.write_text(secret)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        # A label of more than 63 characters is refused without a question to a server of names.
        file.write_text(TARGETS.format(key=key, secret=secret, port=port, label=64 * "x"))
        found = list(doctor._notifications(file))
        server.settimeout(0.1)
        with pytest.raises(TimeoutError):
            server.accept()
    assert [each.level for each in found] == [Level.OK, Level.FAIL, Level.FAIL, Level.NOTE, Level.OK]
    assert all(each.part == "notify" for each in found)
    assert all(secret not in each.text for each in found)
    assert "private_addresses" in found[1].text
    key.unlink()
    file.write_text(file.read_text().replace("http://127", "ftp://127"))
    wrong = list(doctor._notifications(file))
    assert len(wrong) == 3
    assert {each.level for each in wrong} == {Level.FAIL}
    assert [each.level for each in doctor._notifications(tmp_path)] == [Level.FAIL]


def test_descriptors_against_the_meters(monkeypatch: Patch) -> None:
    monkeypatch.setattr(doctor.resource, "getrlimit", lambda _: (256, 256))
    assert doctor._descriptors(20).level is Level.OK
    finding = doctor._descriptors(146)
    assert (finding.level, "need a hard limit of 900" in finding.text) == (Level.NOTE, True)
    monkeypatch.setattr(doctor.resource, "getrlimit", lambda _: (64, 64))
    assert doctor._descriptors(0).level is Level.FAIL


def test_a_leap_second_is_announced(monkeypatch: Patch) -> None:
    class Kernel:
        def adjtimex(self, _: object) -> int:
            return 1

    monkeypatch.setattr(doctor.ctypes, "CDLL", lambda _: Kernel())
    assert list(doctor._clock(None, T0))[1] == Finding(Level.NOTE, "clock", "a leap second is inserted today")


@pytest.mark.postgresql
def test_a_server(cluster: Cluster) -> None:
    url = cluster.database()
    state, (empty,) = doctor._database(url)
    assert state is not None
    assert (state.version, state.newest, empty.level) == (None, None, Level.OK)
    filled(url, T0 + 7.0)
    with Store(url) as store:
        store.commit(put=("village", {"feeder": {}}))
        state, found = doctor._database(url)
    assert state is not None
    assert (state.newest, state.feeders) == (T0 + 7.0, {"village": '{"feeder": {}}'})
    assert [each.level for each in found] == [Level.OK, Level.NOTE]
    _, (gone,) = doctor._database("postgresql://gridsec@127.0.0.1:1/gridsec")
    assert gone.level is Level.FAIL


def secured(folder: Path, lasts_s: dict[str, float]) -> Path:
    """Certificates of `gridsec pki`, and the configuration of the router."""
    now = time.time()
    pki.create_authority(folder, now, lasts_s=1e8)
    for name, kind in (("router", Kind.ROUTER), ("service", Kind.SERVICE), ("town.m01", Kind.METER)):
        pki.issue(folder, name, kind, now, lasts_s=lasts_s.get(name, 1e7))
    ends, feeders = (zenoh_rules.ENDPOINT,), {"town": frozenset({"m01"})}
    plan = zenoh_rules.Plan(pki.certificates(folder), feeders, (), ends, "gridsec", folder)
    for name, content in zenoh_rules.files(plan).items():
        (folder / name).write_text(content)
    return folder / "router.json5"


def levels(found: Iterable[Finding]) -> dict[str, str]:
    """Level by the name of the file."""
    return {Path(each.text.partition(": ")[0]).name: str(each.level) for each in found}


def test_certificates_of_a_configuration(tmp_path: Path) -> None:
    now, file = time.time(), secured(tmp_path, {"router": 60 * 86_400.0})
    assert levels(doctor._certificates(file, now)) == {"authority.crt": "ok", "router.crt": "ok"}
    assert levels(doctor._certificates(file, now + 31 * 86_400.0))["router.crt"] == "note"
    (tmp_path / "router.key").write_bytes((tmp_path / "service.key").read_bytes())
    (found,) = [each for each in doctor._certificates(file, now) if each.level is Level.FAIL]
    assert found.text.endswith("router.key is the key of another certificate")
    (tmp_path / "router.key").unlink()
    assert levels(doctor._certificates(file, now))["router.crt"] == "FAIL"
    pki.issue(tmp_path, "router", Kind.ROUTER, now, lasts_s=1e7, renew=True)
    other = tmp_path / "other"
    pki.create_authority(other, now, lasts_s=1e8)
    (tmp_path / "authority.crt").write_bytes((other / "authority.crt").read_bytes())
    (found,) = [each for each in doctor._certificates(file, now) if each.level is Level.FAIL]
    assert found.text.endswith("is not issued by the authority of the configuration")
    (tmp_path / "authority.crt").write_text("none")
    assert levels(doctor._certificates(file, now)) == {"authority.crt": "FAIL", "router.crt": "ok"}
    file.write_text("{")
    (found,) = doctor._certificates(file, now)
    assert found.level is Level.FAIL


def test_an_expired_certificate_wrong_keys_and_an_issuer(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    """Each with its line and the exit code 1; all in order with 0."""
    file, keys = secured(tmp_path, {"router": 1.0}), tmp_path / "keys.csv"
    usual = ("--database", f"sqlite:///{tmp_path / 'g.db'}", "--http", f"127.0.0.1:{free_port()}")
    wrong = ("feeder,meter,scheme,key", "town,m01,hmac,!", "town,m01,other,")
    keys.write_text("\n".join(wrong))
    time.sleep(1.1)
    with issuing() as issuer:

        def ran(*arguments: str) -> tuple[int, dict[str, list[tuple[str, str]]]]:
            code, out, _ = command("doctor")(
                monkeypatch,
                capsys,
                *usual,
                "--zenoh-config",
                str(file),
                "--meter-keys",
                str(keys),
                *arguments,
            )
            return code, result(out)

        code, found = ran("--oidc-issuer", f"{issuer.url}/absent")
        assert code == 1
        assert [level for level, _ in found["certificate"]] == ["ok", "FAIL"]
        assert "expired on" in found["certificate"][1][1]
        assert [level for level, _ in found["meter keys"]] == ["FAIL"] * 3
        assert [level for level, _ in found["issuer"]] == ["FAIL"]
        pki.issue(tmp_path, "router", Kind.ROUTER, time.time(), lasts_s=1e7, renew=True)
        keys.write_text("feeder,meter,scheme,key\ntown,m01,certificate,c1\n")
        code, found = ran("--oidc-issuer", issuer.url)
        assert code == 0, found
        assert found["meter keys"] == [("ok", f"{keys}: 1 meters")]
        assert found["issuer"] == [("ok", f"{issuer.url}: 2 signing keys")]
        code, found = ran("--oidc-issuer", issuer.url, "--oidc-jwks", f"{issuer.url}/keys")
        assert (code, found["issuer"][0][0]) == (0, "ok")
