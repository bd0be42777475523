"""`gridsec doctor`: checks of the machine, the database, the addresses and the feeders before a start.

The checks change nothing. They use the settings of `gridsec serve`, from options and environment.
"""

from __future__ import annotations

import ctypes
import json
import resource
import socket
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from importlib import metadata
from importlib.util import find_spec
from shutil import which
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import typer

from service.cli.console import FAILED, say
from service.cli.serve import (
    Config,
    Database,
    Endpoints,
    EstimatorName,
    Feeders,
    Http,
    Listen,
    MeterKeysFile,
    Notify,
    OidcIssuer,
    OidcJwks,
)

if TYPE_CHECKING:
    from pathlib import Path

    from feeders.model.site import Site
    from service.settings import Settings
    from service.store.inspection import DatabaseState

FREE_BYTES = 1 << 30
"""Least free space of the file system of an SQLite database, bytes."""
AHEAD_S = 60.0
"""Largest lead of the newest stored tick over the clock, s: `--max-skew`."""
_STATES = {
    1: "a leap second is inserted today",
    2: "a leap second is deleted today",
    3: "a leap second is in progress",
    5: "the kernel's clock is not synchronised; start NTP",
}
"""Message by return value of adjtimex(2)."""
_EXTRAS = {
    "pandapower": "convert",
    "simbench": "convert",
    "opendssdirect": "convert",
    "distributed": "cluster",
    "matplotlib": "plot",
    "sympy": "symbolic",
}
"""Extra of the package by optional module."""


class Level(StrEnum):
    """Result of a check."""

    OK = "ok"
    NOTE = "note"
    FAIL = "FAIL"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the result."""

    level: Level
    part: str
    text: str


def doctor(
    *,
    database: Database = None,
    http: Http = None,
    zenoh_listen: Listen = None,
    zenoh_connect: Endpoints = None,
    feeder: Feeders = None,
    estimator: EstimatorName = None,
    notify: Notify = None,
    zenoh_config: Config = None,
    meter_keys: MeterKeysFile = None,
    oidc_issuer: OidcIssuer = None,
    oidc_jwks: OidcJwks = None,
) -> None:
    """Check everything that `gridsec serve` needs; exit code 1 if a line is FAIL.

    Settings that are not given come from the environment, as of `serve`.
    """
    from service.settings import settings

    chosen = settings(
        {
            "database": database,
            "http": http,
            "zenoh_listen": tuple(zenoh_listen) if zenoh_listen else None,
            "zenoh_connect": tuple(zenoh_connect) if zenoh_connect else None,
            "feeders": tuple(feeder) if feeder else None,
            "estimator": estimator,
            "notify": notify,
            "zenoh_config": zenoh_config,
            "meter_keys": meter_keys,
            "oidc_issuer": oidc_issuer,
            "oidc_jwks": oidc_jwks,
        }
    )
    failed = False
    for finding in examine(chosen):
        failed |= finding.level is Level.FAIL
        say(f"{finding.level:<5} {finding.part + ':':<13} {finding.text}")
    if failed:
        raise typer.Exit(FAILED)


def examine(chosen: Settings) -> Iterator[Finding]:
    """Yield the findings of all checks, part by part."""
    yield Finding(Level.OK, "version", f"gridsec {metadata.version('gridsec')}")
    state, database = _database(chosen.database)
    yield from database
    yield from _clock(None if state is None else state.newest, time.time())
    yield _http(chosen.http)
    yield from _zenoh(chosen)
    yield from _certificates(chosen.zenoh_config, time.time())
    yield from _meter_keys(chosen)
    yield from _issuer(chosen)
    meters, feeders = _feeders(chosen, {} if state is None else state.feeders)
    yield from feeders
    yield _descriptors(meters)
    yield from _notifications(chosen.notify)
    yield from _optional(postgresql=chosen.database.startswith("postgresql"))


def _database(url: str) -> tuple[DatabaseState | None, list[Finding]]:
    """State of the database, if it can be read, and the findings."""
    from service.store import StoreUnavailable
    from service.store.backup import NEWEST
    from service.store.inspection import inspect

    try:
        state = inspect(url)
    except StoreUnavailable as error:
        return None, [Finding(Level.FAIL, "database", str(error))]
    found = []
    if state.version is None:
        text = f"{state.name}: empty; `gridsec serve` creates it"
    else:
        migrated = (
            "" if state.version == NEWEST else f", `gridsec serve` migrates it to {NEWEST}; back it up first"
        )
        text = f"{state.name}: schema version {state.version}{migrated}, {state.size / 1e6:.1f} MB"
    level = Level.OK if state.version in {None, NEWEST} else Level.NOTE
    found.append(Finding(level, "database", text))
    if state.read_only is not None:
        found.append(Finding(Level.FAIL, "database", state.read_only))
    if state.running:
        text = "another process writes it; a second service does not start beside it"
        found.append(Finding(Level.NOTE, "database", text))
    if state.free is not None:
        needed = FREE_BYTES + state.size
        enough = state.free >= needed
        text = f"{state.free / 1e9:.1f} GB free"
        text += "" if enough else f"; make room: {needed / 1e9:.1f} GB are needed for history and a backup"
        found.append(Finding(Level.OK if enough else Level.FAIL, "disk", text))
    return state, found


def _clock(newest: float | None, now: float) -> Iterator[Finding]:
    """Findings about the clock against the database's newest tick, and about leaps."""
    text = f"{datetime.fromtimestamp(now, UTC):%Y-%m-%dT%H:%M:%SZ}"
    if newest is None:
        yield Finding(Level.OK, "clock", text)
    elif newest > now + AHEAD_S:
        text += f" is {newest - now:.0f} s before the newest tick of the database; set the clock (NTP)"
        yield Finding(Level.FAIL, "clock", text)
    else:
        yield Finding(
            Level.OK, "clock", f"{text}, {now - newest:.0f} s after the newest tick of the database"
        )
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))  # modes 0: read only
    except AttributeError:  # another system than Linux
        return
    if state in _STATES:
        yield Finding(Level.NOTE, "clock", _STATES[state])


def _in_use(host: str, port: int) -> str | None:
    """Reason why a TCP address cannot be listened on, or None."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
            probe.listen()
        except OSError as error:
            return error.strerror or str(error)
    return None


def _http(address: str) -> Finding:
    from service.settings import split_address

    problem = _in_use(*split_address(address))
    if problem is None:
        return Finding(Level.OK, "http", f"{address} is free")
    text = f"{address}: {problem}; end the other process, or choose another --http"
    return Finding(Level.FAIL, "http", text)


def _zenoh(chosen: Settings) -> Iterator[Finding]:
    """Findings about the endpoints to listen on and to connect to."""
    from service.ingest.queues import BusConfig, BusUnavailable
    from service.ingest.zenoh_bus import MeterClient
    from service.settings import split_address

    for endpoint in chosen.listen:
        kind, _, address = endpoint.partition("/")
        if kind not in {"tcp", "tls", "ws"}:
            continue
        problem = _in_use(*split_address(address.partition("#")[0].partition("?")[0]))
        text = (
            f"{endpoint} is free"
            if problem is None
            else f"{endpoint}: {problem}; choose another --zenoh-listen"
        )
        yield Finding(Level.OK if problem is None else Level.FAIL, "zenoh", text)
    for endpoint in chosen.zenoh_connect:
        config = BusConfig("client", connect=(endpoint,), file=chosen.zenoh_config)
        try:
            with MeterClient(config, chosen.prefix):
                yield Finding(Level.OK, "zenoh", f"{endpoint} answers")
        except BusUnavailable as error:
            text = f"{str(error).rstrip('.!')}; start the router there, or correct --zenoh-connect"
            yield Finding(Level.FAIL, "zenoh", text)


def _certificates(file: Path | None, now: float) -> Iterator[Finding]:
    """Findings about the files that a zenoh configuration names."""
    from service.access.tls_files import check_files
    from service.ingest.queues import BusConfig, BusUnavailable
    from service.ingest.zenoh_bus import tls_files

    if file is None:
        return
    try:
        files = tls_files(BusConfig(file=file))
    except BusUnavailable as error:
        yield Finding(Level.FAIL, "certificate", str(error))
        return
    for found in check_files(files, now):
        if found.problem or found.expires is None:
            yield Finding(Level.FAIL, "certificate", f"{found.path}: {found.problem}")
            continue
        text = f"{found.path}: expires on {datetime.fromtimestamp(found.expires, UTC):%Y-%m-%d}"
        yield Finding(Level.NOTE if found.expires_soon(now) else Level.OK, "certificate", text)


def _meter_keys(chosen: Settings) -> Iterator[Finding]:
    """Finding about the table of the meters' keys, or one for each wrong row."""
    from service.settings import SettingsInvalid

    try:
        keys = chosen.read_meter_keys()
    except SettingsInvalid as error:
        for problem in error.problems:
            yield Finding(Level.FAIL, "meter keys", " ".join(problem.split()))
        return
    if keys is not None:
        yield Finding(Level.OK, "meter keys", f"{chosen.meter_keys}: {len(keys.entries)} meters")


def _issuer(chosen: Settings) -> Iterator[Finding]:
    """Finding about the issuer of tokens: its keys are read."""
    from service.access.identity import IssuerUnavailable
    from service.access.tokens import TokenVerifier

    if not chosen.oidc_issuer:
        return
    try:
        count = TokenVerifier(chosen.oidc_issuer, chosen.oidc_audience, chosen.oidc_jwks).reachable()
    except IssuerUnavailable as error:
        yield Finding(Level.FAIL, "issuer", " ".join(str(error).split()))
        return
    yield Finding(Level.OK, "issuer", f"{chosen.oidc_issuer}: {count} signing keys")


def _feeders(chosen: Settings, stored: Mapping[str, str]) -> tuple[int, list[Finding]]:
    """Number of meters and busbars of all feeders, and the findings about loading and designing them.

    `stored` has the JSON of the tables of feeders put over REST; those of the settings take precedence.
    """
    from feeders.format.tables import from_json
    from feeders.model.site import from_tables, load
    from feeders.registry import choose, design
    from gridsec.errors import GridsecError

    def given(name: str) -> Site:
        return choose(load(name), estimator=chosen.estimator)

    def put(name: str) -> Site:
        return from_tables(from_json(json.loads(stored[name])))

    meters, found, names = 0, list[Finding](), set[str]()
    for name, made in [*((name, given) for name in chosen.feeders), *((name, put) for name in stored)]:
        if made is put and name in names:
            continue
        try:
            site = made(name)
            names.add(site.feeder.name)
            started = time.monotonic()
            estimator = design(site)
        except GridsecError as error:
            found.append(Finding(Level.FAIL, "feeder", f"{name}: {' '.join(str(error).split())}"))
            continue
        meters += len(site.meter_ids) + 1
        text = f"{site.feeder.name}: {len(site.meter_ids)} meters, {site.tables.meta.monitor.estimator}, "
        text += f"M = {estimator.max_attacked}, designed in {time.monotonic() - started:.1f} s"
        found.append(Finding(Level.OK, "feeder", text))
    none = Finding(Level.NOTE, "feeder", "none; add --feeder DIR, or PUT one over REST")
    return meters, found or [none]


def _descriptors(meters: int) -> Finding:
    """Finding about the limits of open descriptors, for one zenoh session of each of `meters`."""
    from service.api.listener import HTTP_MOST, RESERVE, Shares

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = (1 << 20) if hard == resource.RLIM_INFINITY else hard
    shares = Shares.of(limit)
    text = f"soft limit {soft}, hard limit {hard}: {shares.http} for HTTP, {shares.sessions} zenoh sessions"
    needed = RESERVE + HTTP_MOST + 2 * meters
    if limit < RESERVE + 24:
        return Finding(Level.FAIL, "descriptors", f"{text}; raise the hard limit to {needed} (LimitNOFILE)")
    if shares.sessions < meters:
        text += f"; {meters} meters with a session each need a hard limit of {needed} (LimitNOFILE)"
        return Finding(Level.NOTE, "descriptors", text)
    return Finding(Level.OK, "descriptors", text)


def _notifications(file: Path | None) -> Iterator[Finding]:
    """Findings about the targets of notifications. Names are resolved; no connection is made."""
    import ssl

    from gridsec.errors import InputInvalid
    from service.notify.post import AddressRefused, permitted
    from service.notify.targets import Target, read_targets

    def checked(target: Target) -> Finding:
        parts = urlsplit(target.url)
        name = f"{target.name} ({target.kind}), {target.host}"
        try:
            ssl.create_default_context(cafile=target.ca_file)
        except OSError as error:
            text = f"{name}: ca_file {target.ca_file}: {error.strerror or error}"
            return Finding(Level.FAIL, "notify", text)
        try:
            found = permitted(target.host, parts.port or 443, target.private_addresses)
        except AddressRefused as error:
            return Finding(Level.FAIL, "notify", f"{name}: {error}")
        except (OSError, UnicodeError) as error:
            text = f"{name}: the name cannot be resolved: {getattr(error, 'strerror', None) or error}"
            return Finding(Level.NOTE, "notify", text)
        return Finding(
            Level.OK, "notify", f"{name}: {', '.join(sorted({str(each[4][0]) for each in found}))}"
        )

    if file is None:
        return
    try:
        targets = read_targets(file)
    except InputInvalid as error:
        for problem in error.problems:
            yield Finding(Level.FAIL, "notify", " ".join(problem.split()))
        return
    yield from map(checked, targets.all)


def _optional(*, postgresql: bool) -> Iterator[Finding]:
    """Findings about optional packages and tools."""
    missing = {module: extra for module, extra in _EXTRAS.items() if find_spec(module) is None}
    there = ", ".join(module for module in _EXTRAS if module not in missing)
    yield Finding(Level.OK, "optional", f"installed: {there or 'none'}")
    for module, extra in missing.items():
        yield Finding(Level.OK, "optional", f"{module} is not installed; pip install 'gridsec[{extra}]'")
    for tool in ("pg_dump", "pg_restore") if postgresql else ():
        if which(tool) is None:
            text = f"{tool} is not installed; `gridsec backup` needs PostgreSQL's client tools"
            yield Finding(Level.NOTE, "optional", text)
