"""Codes of the service's errors: docs/error-codes.md against the source, and a sentence for each code."""

from __future__ import annotations

import ast
import asyncio
import json
import math
import re
import sqlite3
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import SimpleNamespace
from typing import Any, cast

import jwt
import numpy as np
import pandas as pd
import psycopg
import pytest
import sqlalchemy as sa
import zenoh
from starlette.requests import Request

import service
from feeders.format.tables import to_json
from feeders.model.site import load
from gridsec.errors import FeederInvalid, GridsecError, InputInvalid, Problem
from gridsec.estimators.front import SuspicionRecord
from service import app
from service.access import pki
from service.access.identity import NotAuthenticated, Role
from service.access.keys import create
from service.access.tokens import TokenVerifier
from service.alarms.incidents import (
    Incident,
    IncidentBook,
    IncidentChanged,
    IncidentUnknown,
    ShelfUnknown,
    WorkUnknown,
    advance,
)
from service.alarms.state_machine import AlarmRules, AlarmUnknown, acknowledged, restore, unacknowledged
from service.api.access import FAILURES, Authenticator, authorise
from service.cli import demo
from service.cli.paths import check_paths, write_tables
from service.cli.replay import _site_of
from service.cli.sources import converted
from service.cli.study_report import STUDIES, Asked
from service.cluster.messages import Envelope
from service.cluster.run import check_cluster
from service.engine.commissioning import FeederCommissioning
from service.engine.design_jobs import prepare
from service.engine.operators import Operators, ShelfRequest
from service.engine.runtime import Runtime
from service.errors import FeederFixed, FeederNotLoaded, FeederUnknown, NoOwner, TooManyFeeders, WorkerBusy
from service.ingest import zenoh_bus
from service.ingest.align import AlignRules
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import Bus, MeterClient
from service.notify.post import permitted
from service.notify.targets import read_targets
from service.settings import refuse_exposed, settings
from service.store import Store, backup, committer, leases, schema
from service.store.access import AccessStore
from service.store.committer import Batch
from service.store.connect import NoAnswer, WriterSession, share_database
from service.store.state_codec import decode, decode_distrust, encode, encode_distrust, fingerprint
from tests.service.stored import T0, an_alarm, raised

PACKAGE = Path(service.__file__).parent
PAGE = PACKAGE.parent / "docs" / "error-codes.md"
GOLDEN = Path(__file__).parent / "golden" / "errors.txt"
SECTION = "## Errors of `service`\n"
ROW = re.compile(r"^\| `([A-Za-z]+)` \| `([a-z-]+)` \| .+ \|$", re.MULTILINE)
CODE = re.compile(r"[a-z]+(-[a-z]+)*")
MODULES = [import_module(each.name) for each in walk_packages(service.__path__, "service.")]


def texts(node: ast.expr) -> Iterator[str]:
    """Strings that an expression states: a constant, both values of a choice, values of a dictionary."""
    if isinstance(node, ast.IfExp):
        yield from (*texts(node.body), *texts(node.orelse))
    elif isinstance(node, ast.Dict):
        for value in vars(node)["values"]:
            yield from texts(value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value:
        yield node.value


def codes(source: str) -> set[str]:
    """Codes of a source: of problems, `code=`, attributes `code`, tables `_CODES` and their defaults."""
    out: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            out.update(text for each in node.keywords if each.arg == "code" for text in texts(each.value))
            if ast.unparse(node.func) == "Problem":
                out.update(texts(node.args[0]))
            if ast.unparse(node.func).endswith("_CODES.get"):
                out.update(text for default in node.args[1:] for text in texts(default))
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).endswith("_CODES"):
            out.update(texts(node.value))
        elif isinstance(node, ast.ClassDef):
            own = (each for each in node.body if isinstance(each, ast.Assign))
            out.update(
                text for each in own if ast.unparse(each.targets[0]) == "code" for text in texts(each.value)
            )
    return out


def used() -> set[str]:
    """Codes of the package."""
    return set().union(*(codes(path.read_text("utf-8")) for path in PACKAGE.rglob("*.py")))


def listed() -> list[tuple[str, str]]:
    """Classes and codes of the page's section, row by row."""
    _, _, section = PAGE.read_text("utf-8").partition(SECTION)
    return ROW.findall(section.partition("\n## ")[0])


def below(kind: type[Exception]) -> Iterator[type[Exception]]:
    """Classes of the service that derive from one, at any depth."""
    for each in kind.__subclasses__():
        if each.__module__.startswith("service."):
            yield each
        yield from below(each)


def defaults() -> set[tuple[str, str]]:
    """Each class of an error, with its own code."""
    return {(each.__name__, vars(each)["code"]) for each in below(GridsecError)}


def test_literals_are_found() -> None:
    source = """
class Broken(GridsecError):
    code = "a"
    text = "no"
raise Broken("no", code="b" if x == "no" else "c")
Problem("d", "no")
Problem(one.code, "no")
_CODES = {"no": "e", 1: "f"}
_CODES.get("no", "g")
other.get("no", "no")
Broken("no", code="")
"""
    assert codes(source) == {"a", "b", "c", "d", "e", "f", "g"}


def test_the_page_lists_the_codes_of_the_source() -> None:
    rows = listed()
    assert rows == sorted(rows)
    assert {code for _, code in rows} == used()
    assert all(CODE.fullmatch(code) for _, code in rows)


def test_each_error_has_a_code_of_its_own() -> None:
    assert len(MODULES) > 50
    found = defaults()
    assert len(found) > 15
    assert len({code for _, code in found}) == len(found)
    assert found <= set(listed())


def test_wrong_input_has_codes_but_for_words_of_the_command_line() -> None:
    plain = re.compile(r"raise (ValueError|GridsecError)\(")
    found = {path.name for path in PACKAGE.rglob("*.py") if plain.search(path.read_text("utf-8"))}
    assert found == {"main.py", "study_campaign.py", "study_report.py"}


# ---------------------------------------------------------------------------------------------- sentences

Patch = pytest.MonkeyPatch
Call = Callable[[Path, Patch], Any]


def one_problem(number: int, made: Callable[[], Any]) -> None:
    """Refuse with one of the problems of a feeder; the others are of the feeder format."""
    with pytest.raises(FeederInvalid) as caught:
        made()
    raise FeederInvalid([caught.value.problems[number]])


def database(place: Path) -> Store:
    return Store(f"sqlite:///{place}/g.db")


def failing(store: Store, doing: str, error: Exception) -> None:
    """Fail with an error of a PostgreSQL driver."""
    store._connections._session = cast(Any, object())
    try:
        with store._connections._guard(doing):
            raise error
    finally:
        store._connections._session = None


def with_store(call: Callable[[Store, Path, Patch], Any]) -> Call:
    def made(place: Path, patch: Patch) -> None:
        with database(place) as store:
            call(store, place, patch)

    return made


def write_under_way(store: Store, _: Path, patch: Patch) -> None:
    patch.setattr("service.store.store.ALONE_S", 0.01)
    free = store._lock
    store._lock = cast(Any, threading.Lock())
    try:
        with store._lock:
            store.commit([raised(an_alarm())])
    finally:
        store._lock = free


def locked(store: Store, place: Path, _: Patch) -> None:
    other = sqlite3.connect(place / "g.db", isolation_level=None)
    try:
        other.execute("BEGIN IMMEDIATE")
        store.commit([raised(an_alarm())])
    finally:
        other.close()


def moved(store: Store, place: Path, *, back: bool) -> None:
    for name in ("g.db", "g.db-wal", "g.db-shm"):
        (place / name).rename(place / f"old-{name}")
    if back:
        (place / "g.db").write_bytes(b"")
    store.check()


def lock_removed(store: Store, place: Path, _: Patch) -> None:
    (place / "g.db.lock").unlink()
    store.check()


def another_writer(store: Store, place: Path, _: Patch) -> None:
    lock, aside = place / "g.db.lock", place / "aside"
    lock.rename(aside)
    database(place).close()
    aside.rename(lock)
    store.check()


def broken_commit(store: Store, _: Path, patch: Patch) -> None:
    def commit(_: object) -> None:
        gone = sqlite3.OperationalError("server closed the connection")
        raise sa.exc.OperationalError("COMMIT", None, gone, connection_invalidated=True)

    patch.setattr(sa.Connection, "commit", commit)
    store.commit([raised(an_alarm())])


def reader_writes(store: Store, _: Path, __: Patch) -> None:
    with store._read() as connection:
        connection.execute(schema.FEEDER.delete())


def newer_schema(store: Store, place: Path, patch: Patch) -> None:
    store.close()
    with sqlite3.connect(place / "g.db") as other:
        other.execute("UPDATE schema_version SET version = 99")
    patch.setattr(schema, "MIGRATIONS", schema.MIGRATIONS[:4])
    database(place)


def not_a_database(place: Path, _: Patch) -> None:
    (place / "g.db").write_text("These are notes. " * 200)
    database(place)


def session_ended(_: Path, __: Patch) -> None:
    lost = WriterSession("postgresql://server/g")
    lost._ended, lost._server = True, "noon"
    made = SimpleNamespace(execute=lambda _: SimpleNamespace(fetchone=lambda: ("noon",)))
    lost._take_lock(cast(Any, made))


def workers_running(_: Path, __: Patch) -> None:
    made = SimpleNamespace(execute=lambda *_: SimpleNamespace(fetchone=lambda: (True,)))
    WriterSession("postgresql://server/g")._refuse_workers(cast(Any, made))


def single_process(_: Path, __: Patch) -> None:
    def execute(statement: str, _: object) -> None:
        if "pg_advisory_lock_shared" in statement:
            raise psycopg.errors.LockNotAvailable("canceling statement due to lock timeout")

    share_database(cast(Any, SimpleNamespace(execute=execute)), "postgresql://server/g", 0.0)


def defect(_: Path, __: Patch) -> None:
    def check() -> None:
        raise ZeroDivisionError("a defect")

    error = committer._write(
        cast(Any, SimpleNamespace(check=check)), committer.WriteJob(1, Batch(), probe=True)
    ).error
    assert error is not None
    raise error


def damaged(changes: dict[str, Any]) -> Call:
    def made(_: Path, __: Patch) -> None:
        site = load("cigre-lv")
        kept = encode(site, fingerprint(site), T0, {})
        text = kept.text
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        now = fingerprint(site) | ({} if changes else {"meters": "now"})
        decode(site, now, replace(kept, text=text))

    return made


def suspect_twice(_: Path, __: Patch) -> None:
    site = load("cigre-lv")
    p, m = len(site.meter_ids), site.droop.tau.size
    kept = encode_distrust(
        site, T0, replace(SuspicionRecord.empty(p, m), scale_s=np.where(np.arange(p) < 1, 60.0, np.nan))
    )
    record = json.loads(kept.text)
    decode_distrust(site, replace(kept, text=json.dumps(record | {"meters": 2 * record["meters"]})))


SHELF = ShelfRequest("village", None, None, "m1", None, None, 61.0, "known")


def incident() -> Incident:
    """The incident of one alarm."""
    made, _ = advance(IncidentBook("village"), [raised(an_alarm(reason="reports 240.0 V"))], T0)
    return next(iter(made.incidents.values()))


def watcher(name: str, learner: object) -> Any:
    """A watcher that does not learn; its estimator can, or cannot."""
    return SimpleNamespace(family=SimpleNamespace(name=name, bias_learning=learner), bias_learning=None)


def learning(installed: Any) -> Call:
    def made(_: Path, __: Patch) -> None:
        commissioning = FeederCommissioning(load("cigre-lv"))
        commissioning._watcher = installed
        commissioning.renew(None, [], T0, "Ada", "new")

    return made


def put_fails(_: Path, __: Patch) -> None:
    def put(*_: object, **__: object) -> None:
        raise zenoh.ZError("the session is closed at /there")

    meters = MeterClient(BusConfig(), "gridsec")
    meters._live = cast(Any, SimpleNamespace(declare_publisher=lambda *_, **__: SimpleNamespace(put=put)))
    meters.put("key", b"")


def query_fails(_: Path, __: Patch) -> None:
    def get(*_: object, **__: object) -> None:
        raise zenoh.ZError("the session is closed at /there")

    bus = Bus(BusConfig(), "gridsec", lambda _: None, max_payload=1, lossless=False)
    bus._live = cast(Any, SimpleNamespace(get=get))
    list(bus.ask("key", b"", 1.0))


def wrong_targets(place: Path, _: Patch) -> None:
    path = place / "targets.toml"
    hook = '[[webhook]]\nname = "a"\nurl = '
    path.write_text(f'{hook}"http://a.example"\n{hook}"https://a.example"\nsecret = "whsec_AA"\n')
    problems = []
    for text in ("[", path.read_text()):
        path.write_text(text)
        with pytest.raises(InputInvalid) as caught:
            read_targets(path)
        problems += caught.value.problems
    raise InputInvalid(problems)


def no_bus(_: Path, patch: Patch) -> None:
    def refuse(_: object) -> None:
        raise zenoh.ZError("no listener at /there")

    patch.setattr(zenoh, "open", refuse)
    with zenoh_bus.session(BusConfig(listen=("tcp/127.0.0.1:7447",))):
        pass


def http_status(_: Path, patch: Patch) -> None:
    answer = SimpleNamespace(status=404, read=lambda: b"")
    made = SimpleNamespace(request=lambda *_: None, getresponse=lambda: answer, close=lambda: None)
    patch.setattr("http.client.HTTPConnection", lambda *_, **__: made)
    demo.Service(cast(Any, None), "http://127.0.0.1:8000", "").get("/readyz")


def not_ready(_: Path, patch: Patch) -> None:
    patch.setattr(demo, "START_WITHIN_S", -1.0)
    demo._wait_ready(cast(Any, SimpleNamespace(get=lambda _: {"ok": False, "reasons": ["no design"]})))


def not_started(_: Path, patch: Patch) -> None:
    def launch(_: object, log: Any) -> Any:
        log.write("gridsec: no such feeder\n")
        return SimpleNamespace(wait=lambda **_: 3)

    patch.setattr(demo, "_launch", launch)
    patch.setattr(demo, "_first_line", lambda _: "")
    patch.setattr(demo, "_end", lambda _: None)
    with demo.started("nowhere", "127.0.0.1:0"):
        pass


def unconverted(place: Path, patch: Patch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise FeederInvalid([Problem("not-radial", "a loop")])

    patch.setattr("feeders.convert.convert.convert", refuse)
    one_problem(-1, lambda: converted("town.dss", place / "out"))


def another_name(_: Path, __: Patch) -> None:
    async def put() -> None:
        await prepare("village", to_json(load("cigre-lv").tables))

    asyncio.run(put())


def put_nan(_: Path, __: Patch) -> None:
    from service.api.feeders import put_feeder

    asyncio.run(put_feeder(cast(Any, None), "village", {"meta": math.nan}))


def paths(place: Path, _: Patch) -> None:
    (place / "file").write_text("")
    (place / "link").symlink_to("nowhere")
    (place / "cigre").mkdir()
    (place / "cigre" / "feeder.toml").write_text("")
    (place / "measured.parquet").write_text("measured")
    check_paths(
        folders={"--out": Path("file"), "--more": Path("link"), "--tables": Path("cigre")},
        over={"--over": Path("file/in")},
        new={"--write": Path("cigre")},
        files={"--csv": Path("cigre"), "--again": Path("same.csv"), "--same": Path("same.csv")},
        simulated={"--recording": Path("measured.parquet")},
        read={"--readings": Path("nowhere.csv"), "--page": Path("x" * 300)},
    )


def not_writable(_: Path, patch: Patch) -> None:
    def deny(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    patch.setattr("service.cli.paths.tempfile.TemporaryFile", deny)
    check_paths(folders={"--out": Path("results")})


def wrong_settings(_: Path, __: Patch) -> None:
    settings(
        {
            "http": "localhost",
            "clock": "sundial",
            "zenoh_listen": ("127.0.0.1:7447",),
            "zenoh_config": Path("none.json5"),
            "zenoh_mode": "star",
            "max_skew_s": math.inf,
            "grace_s": -1.0,
            "queue": "few",
            "prefix": "a//b",
            "http_hosts": ("grid.example:80",),
            "colour": "red",
        }
    )


def damaged_certificate(place: Path, _: Patch) -> None:
    (place / "authority.crt").write_text("nothing")
    pki.certificates(place)


def wrong_meter_keys(place: Path, _: Patch) -> None:
    rows = ("a,m1,hmac,c2hvcnQ=", "a,m1,rsa,", "a,m2,ed25519,?")
    (place / "keys.csv").write_text("\n".join(("feeder,meter,scheme,key", *rows)))
    settings({"meter_keys": place / "keys.csv"}).read_meter_keys()


def refuse(error: Exception) -> None:
    raise error


def damaged_backup(store: Store, place: Path, _: Patch) -> None:
    store.commit([raised(an_alarm())])
    (place / "copy").write_bytes(b"SQLite format 3\x00" + b"\xff" * 8192)
    backup._copied(place / "copy", place / "new", lambda _: None)


def no_tool(_: Path, patch: Patch) -> None:
    patch.setenv("PATH", "/nonexistent-folder")
    backup._run("pg_dump", sa.make_url("postgresql://localhost/grid"))


def tool_failed(place: Path, patch: Patch) -> None:
    (place / "pg_dump").write_text("#!/bin/sh\necho 'server version mismatch' >&2; exit 1\n")
    (place / "pg_dump").chmod(0o755)
    patch.setenv("PATH", str(place))
    backup._run("pg_dump", sa.make_url("postgresql://localhost/grid"))


ALARM = replace(an_alarm(), reason="reports 240 V")
AGAIN = replace(ALARM, count=2)
ANSWERED = replace(ALARM, acknowledged_by="Ada", t_acknowledged=T0)
RULES = {"tick_s": 1.0, "max_age_s": 1.0, "grace_s": 0.0, "lead_s": 0.0, "max_skew_s": 1.0, "silence_s": 1.0}


def authenticator(place: Path) -> Authenticator:
    return Authenticator(AccessStore(f"sqlite:///{place / 'grid.db'}"))


def many_invalid_keys(made: Authenticator) -> None:
    for _ in range(FAILURES):
        with pytest.raises(NotAuthenticated):
            made.of_credential("gridsec_0_0", "127.0.0.1")
    made.of_credential("gridsec_0_0", "127.0.0.1")


def workers_of_router(place: Path) -> None:
    (place / "router.json5").write_text('{mode: "router", listen: {endpoints: ["tls/127.0.0.1:7447"]}}')
    given = {"database": "postgresql+psycopg://grid", "workers": 2, "zenoh_config": place / "router.json5"}
    check_cluster(settings(given))


def role_too_low(place: Path) -> None:
    made = authenticator(place)
    text, record = create("Ada", Role.VIEWER, None, T0, None)
    made.store.add_key(record)
    head = [(b"authorization", f"Bearer {text}".encode())]
    request = Request(
        {"type": "http", "method": "GET", "path": "/api/v1/audit", "headers": head, "query_string": b""}
    )
    authorise(made, request, "GET /api/v1/audit", b"")


CALLS: dict[str, Call] = {
    "HTTP at an address of another machine": lambda _, __: app._listen("192.0.2.1:80").__enter__(),
    "alarm that does not exist": lambda _, __: refuse(AlarmUnknown("nothing")),
    "second answer to an alarm": lambda _, __: acknowledged(ANSWERED, "Grace", "", T0),
    "withdrawal without an answer": lambda _, __: unacknowledged(ALARM, "Ada", "", T0),
    "incident that does not exist": lambda _, __: refuse(IncidentUnknown("nothing")),
    "answer to an earlier incident": lambda _, __: refuse(IncidentChanged(incident(), 2)),
    "shelf that does not exist": lambda _, __: refuse(ShelfUnknown("nothing")),
    "work that does not exist": lambda _, __: refuse(WorkUnknown("nothing")),
    "shelf for ever": lambda _, __: Operators(cast(Any, None), lambda: T0, 60.0).shelve(SHELF, "Ada"),
    "answer to an earlier occurrence": lambda _, __: acknowledged(AGAIN, "Ada", "", T0, count=1),
    "delay before an alarm": lambda _, __: AlarmRules(on_delay_s=-1.0),
    "alarm of another feeder": lambda _, __: restore("town", [ALARM]),
    "no interval of ticks": lambda _, __: AlignRules(**RULES | {"tick_s": 0.0}),
    "negative grace": lambda _, __: AlignRules(**RULES | {"grace_s": -1.0}),
    "unknown feeder": lambda _, __: refuse(FeederUnknown("village")),
    "stored feeder that cannot be loaded": lambda _, __: refuse(
        FeederNotLoaded("village", "meters.csv: missing")
    ),
    "feeder without a worker": lambda _, __: refuse(NoOwner("village")),
    "busy worker": lambda _, __: refuse(WorkerBusy("w0", 64)),
    "message of another cluster": lambda _, __: Envelope(b"ours").open(
        "call", Envelope(b"theirs").seal("call", {})
    ),
    "workers without PostgreSQL": lambda _, __: check_cluster(settings({"clock": "events"})),
    "local workers of a router": lambda place, _: workers_of_router(place),
    "feeder of the command line": lambda _, __: refuse(FeederFixed("village")),
    "invalid API key": lambda place, _: authenticator(place).of_credential("gridsec_0_0", "127.0.0.1"),
    "many invalid API keys": lambda place, _: many_invalid_keys(authenticator(place)),
    "role below that of the route": lambda place, _: role_too_low(place),
    "issuer without an address": lambda _, __: TokenVerifier("file:///keys", "gridsec").identify(
        jwt.encode({}, "x" * 32, "HS256")
    ),
    "network without authentication": lambda place, _: app._check_exposure(
        settings({"http": "10.0.0.1:80"}), authenticator(place)
    ),
    "limit of feeders": lambda _, __: refuse(TooManyFeeders(100)),
    "two feeders of one name": lambda _, __: app.load_sites(["cigre-lv", "cigre-lv"]),
    "feeder of another name": another_name,
    "NaN in JSON": put_nan,
    "recording of a feeder that is not there": lambda _, __: one_problem(
        0, lambda: _site_of(cast(Any, SimpleNamespace(path="day.parquet", feeder="gone")), None)
    ),
    "source with a loop": unconverted,
    "no readings to compare with": lambda _, __: STUDIES["calibrate"].run(
        load("cigre-lv"), Asked("cigre-lv"), journal=None, progress=None
    ),
    "table outside of its folder": lambda place, _: write_tables(place, "study", {"../up": pd.DataFrame()}),
    "paths": paths,
    "folder without permission": not_writable,
    "settings": wrong_settings,
    "damaged certificate": damaged_certificate,
    "keys of meters": wrong_meter_keys,
    "targets of notifications": wrong_targets,
    "target at a private address": lambda _, __: permitted("127.0.0.1", 443, private=False),
    "zenoh on a network without TLS": lambda _, __: refuse_exposed(("tcp/0.0.0.0:7447", "tls/0.0.0.0:7448")),
    "zenoh file that is damaged": lambda place, _: (
        (place / "zenoh.json5").write_text("{ mode: "),
        zenoh_bus._config(BusConfig(file=Path("zenoh.json5"))),
    ),
    "zenoh endpoint": no_bus,
    "zenoh session that is closed": lambda _, __: MeterClient(BusConfig(), "gridsec").put("key", b""),
    "put that fails": put_fails,
    "query that fails": query_fails,
    "stored state of another format": damaged({'"format":': '"format":9'}),
    "stored state of another feeder": damaged({'"feeder":"cigre-lv"': '"feeder":"town"'}),
    "stored state with another field": damaged({'"format":': '"more":1,"format":'}),
    "stored state of other meters": damaged({'"meters":["': '"meters":["gone","'}),
    "stored state with a meter twice": suspect_twice,
    "stored state before a change of the feeder": damaged({}),
    "learning before the design": learning(None),
    "learning by another estimator": learning(watcher("exact-bank", learner=None)),
    "learning for no time": learning(watcher("modal", learner=object())),
    "demo without an answer": lambda _, __: demo.Service(cast(Any, None), "http://127.0.0.1:1", "").get("/"),
    "demo with another answer": http_status,
    "demo without a port": lambda _, __: demo.free_address("192.0.2.1:80"),
    "demo whose service ends": not_started,
    "demo whose service has no design": not_ready,
    "no address of a database": lambda _, __: Store("nonsense"),
    "another database": lambda _, __: Store("mysql://localhost/x"),
    "database in memory": lambda _, __: Store("sqlite://"),
    "database in no folder": lambda _, __: Store("sqlite:////nonexistent-folder/g.db"),
    "file of notes": not_a_database,
    "second writer at the start": with_store(lambda _, place, __: database(place)),
    "newer schema": with_store(newer_schema),
    "write to a locked file": with_store(locked),
    "removed file": with_store(lambda store, place, _: moved(store, place, back=False)),
    "replaced file": with_store(lambda store, place, _: moved(store, place, back=True)),
    "reader that writes": with_store(reader_writes),
    "read without a table": with_store(lambda store, _, __: failing(store, "read", OSError("no such table"))),
    "write that is refused": with_store(lambda store, _, __: failing(store, "write", OSError("disk full"))),
    "server without an answer": with_store(
        lambda store, _, __: failing(
            store, "write", sa.exc.OperationalError("x", None, NoAnswer("no answer within 5 s"))
        )
    ),
    "write after a slow one": with_store(write_under_way),
    "commit without an answer": with_store(broken_commit),
    "removed lock": with_store(lock_removed),
    "second writer": with_store(another_writer),
    "session that the server ends": session_ended,
    "workers beside a service without workers": single_process,
    "service without workers beside workers": workers_running,
    "workers with SQLite": lambda _, __: leases.Leases("sqlite:///g.db", "a"),
    "second worker of a name": lambda _, __: leases._View({1: "a"}, frozenset({1}), 0.0, {}).refuse(
        "a", "postgresql://server/g"
    ),
    "shards of another worker": lambda _, __: refuse(schema.LeaseLost("a", ["village", "town"])),
    "command while writes fail": lambda _, __: committer.Committer._command(
        cast(Any, SimpleNamespace(problem="cannot write g.db: disk full")), cast(Any, None)
    ),
    "command while the service stops": lambda _, __: Runtime._go_on(
        cast(Any, SimpleNamespace(_stopping=True))
    ),
    "defect while writing": defect,
    "restore into a database with content": with_store(
        lambda _, place, __: backup._refuse_content(place / "g.db")
    ),
    "restore of notes": lambda place, _: (
        (place / "notes").write_text("notes"),
        backup.restore(f"sqlite:///{place}/g.db", Path("notes")),
    ),
    "copy of a damaged file": with_store(damaged_backup),
    "backup of a server without its tools": no_tool,
    "tool of the server that fails": tool_failed,
}


def golden() -> dict[str, list[str]]:
    """Lines of the golden file by call, without the call."""
    out: dict[str, list[str]] = {}
    for each in GOLDEN.read_text("utf-8").splitlines():
        call, rest = each.split(" | ", 1)
        out.setdefault(call, []).append(rest)
    return out


def lines(made: Callable[[], Any], place: Path) -> list[str]:
    """Class, code and sentence of each problem that a call raises; line breaks and its folder are marked."""
    with pytest.raises((GridsecError, FeederInvalid, InputInvalid)) as caught:
        made()
    error = caught.value
    sentences = getattr(error, "problems", (str(error),))
    listing = hasattr(error, "problems")
    out = []
    for code, sentence in zip(error.codes, sentences, strict=True):
        name = "Problem" if listing else type(error).__name__
        out.append(f"{name} | {code} | " + sentence.replace(str(place), "FOLDER").replace("\n", "\\n"))
    return out


@pytest.mark.parametrize("call", CALLS)
def test_sentences(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert lines(lambda: CALLS[call](tmp_path, monkeypatch), tmp_path) == golden()[call]


def test_the_golden_file_has_a_sentence_for_each_code() -> None:
    assert golden().keys() == CALLS.keys()
    found = {tuple(each.split(" | ")[:2]) for rest in golden().values() for each in rest}
    # Of a class whose raising functions all state a code, the default has no sentence.
    assert found <= set(listed())
    assert set(listed()) - found <= defaults()
