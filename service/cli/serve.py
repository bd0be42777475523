"""`gridsec serve`: runs the service until it is interrupted."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.console import FAILED, LEASE_LOST, print_error

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from service.app import Running
    from service.settings import Settings

Feeders = Annotated[list[str] | None, typer.Option(help="Folder or name of a feeder; may be repeated.")]
EstimatorName = Annotated[
    str | None, typer.Option(help="See `feeders estimators`. [default: as in feeder.toml]")
]
Listen = Annotated[
    list[str] | None, typer.Option(help="zenoh endpoint to listen on. [default: tcp/127.0.0.1:7447]")
]
Endpoints = Annotated[
    list[str] | None, typer.Option(help="zenoh endpoint to connect to, e.g. tcp/127.0.0.1:7447.")
]
Mode = Annotated[str | None, typer.Option(help="router, peer or client. [default: router]")]
Config = Annotated[Path | None, typer.Option(help="zenoh configuration file (json5): TLS, access rules, ...")]
Prefix = Annotated[str | None, typer.Option(help="First chunks of all keys. [default: gridsec]")]
Http = Annotated[str | None, typer.Option(help="Address of REST and web page. [default: 127.0.0.1:8000]")]
HttpHost = Annotated[
    list[str] | None,
    typer.Option(help="Host name for changes over REST, behind a proxy; may be repeated."),
]
Database = Annotated[
    str | None,
    typer.Option(help="sqlite:///file or postgresql+psycopg://... [default: sqlite:///gridsec.db]"),
]
ClockOf = Annotated[str | None, typer.Option(help="wall, or events: time of the readings. [default: wall]")]
MaxSkew = Annotated[
    float | None,
    typer.Option(help="Largest deviation of a reading's time, s. [default: 60 or 2 ticks]"),
]
Grace = Annotated[
    float | None,
    typer.Option(help="Longest wait of a tick for readings, s. [default: half a tick, at most 60]"),
]
MaxPayload = Annotated[int | None, typer.Option(help="Largest payload, bytes. [default: 262144]")]
Queue = Annotated[int | None, typer.Option(help="Length of the queue, payloads. [default: 20000]")]
MaxShelve = Annotated[
    float | None, typer.Option("--max-shelve", help="Longest time of a shelf of alarms, h. [default: 24]")
]
MaxFeeders = Annotated[int | None, typer.Option(help="Largest number of feeders over REST. [default: 100]")]
OidcIssuer = Annotated[
    str | None, typer.Option(help="Issuer of bearer tokens (OpenID Connect), e.g. https://login.example.")
]
OidcAudience = Annotated[str | None, typer.Option(help="Audience of bearer tokens. [default: gridsec]")]
OidcJwks = Annotated[
    str | None, typer.Option(help="Address of the issuer's keys. [default: by its discovery document]")
]
OidcRoleClaim = Annotated[
    str | None, typer.Option(help="Claim of the role in bearer tokens. [default: gridsec_role]")
]
OpenToNetwork = Annotated[
    bool,
    typer.Option(
        "--open-to-network-without-authentication",
        help="Dangerous: any client on the network can read, acknowledge and change everything.",
    ),
]
MeterKeysFile = Annotated[
    Path | None,
    typer.Option(
        help="Table (csv) feeder,meter,scheme,key: readings of these meters need a valid signature."
    ),
]
Unsigned = Annotated[
    str | None,
    typer.Option(help="refuse or accept: meters without a row in --meter-keys. [default: refuse]"),
]
Plaintext = Annotated[
    bool,
    typer.Option(
        "--plaintext-network", help="Dangerous: zenoh without TLS beyond loopback; any machine can publish."
    ),
]
Notify = Annotated[
    Path | None, typer.Option(help="File (TOML) with targets of notifications: webhooks, Alertmanager.")
]
LogLevel = Annotated[str | None, typer.Option(help="debug, info, warning or error. [default: info]")]
LogFormat = Annotated[str | None, typer.Option(help="console or json. [default: console]")]
STOP_S = 2.7
"""Time from a signal to the forced end, s; the documented limit is 3 s."""
Workers = Annotated[
    int | None,
    typer.Option(
        min=0,
        help="Monitor in this number of worker processes, with PostgreSQL; 0: by `gridsec worker` elsewhere. "
        "[default: in this process]",
    ),
]
WorkerName = Annotated[
    str | None, typer.Option(help="Name of the worker, unique. [default: by host and process]")
]
UntilEof = Annotated[bool, typer.Option(hidden=True, help="End when standard input ends.")]


def serve(
    *,
    feeder: Feeders = None,
    estimator: EstimatorName = None,
    zenoh_listen: Listen = None,
    zenoh_connect: Endpoints = None,
    zenoh_mode: Mode = None,
    zenoh_config: Config = None,
    prefix: Prefix = None,
    http: Http = None,
    http_host: HttpHost = None,
    database: Database = None,
    clock: ClockOf = None,
    max_skew: MaxSkew = None,
    grace: Grace = None,
    max_payload: MaxPayload = None,
    queue: Queue = None,
    max_feeders: MaxFeeders = None,
    max_shelve: MaxShelve = None,
    oidc_issuer: OidcIssuer = None,
    oidc_audience: OidcAudience = None,
    oidc_jwks: OidcJwks = None,
    oidc_role_claim: OidcRoleClaim = None,
    open_to_network_without_authentication: OpenToNetwork = False,
    meter_keys: MeterKeysFile = None,
    unsigned: Unsigned = None,
    plaintext_network: Plaintext = False,
    notify: Notify = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
    workers: Workers = None,
    until_eof: UntilEof = False,
) -> None:
    """Monitor feeders until interrupted. Every option can also be set as GRIDSEC_..., e.g. GRIDSEC_HTTP.

    `--feeder` is GRIDSEC_FEEDERS, `--http-host` GRIDSEC_HTTP_HOSTS, `--max-skew` GRIDSEC_MAX_SKEW_S and
    `--grace` GRIDSEC_GRACE_S.
    """
    from service.settings import settings

    chosen = settings(
        {
            "feeders": tuple(feeder) if feeder else None,
            "estimator": estimator,
            "zenoh_listen": tuple(zenoh_listen) if zenoh_listen else None,
            "zenoh_connect": tuple(zenoh_connect) if zenoh_connect else None,
            "zenoh_mode": zenoh_mode,
            "zenoh_config": zenoh_config,
            "prefix": prefix,
            "http": http,
            "http_hosts": tuple(http_host) if http_host else None,
            "database": database,
            "clock": clock,
            "max_skew_s": max_skew,
            "grace_s": grace,
            "max_payload": max_payload,
            "queue": queue,
            "max_feeders": max_feeders,
            "max_shelve_h": max_shelve,
            "oidc_issuer": oidc_issuer,
            "oidc_audience": oidc_audience,
            "oidc_jwks": oidc_jwks,
            "oidc_role_claim": oidc_role_claim,
            "open_to_network_without_authentication": open_to_network_without_authentication or None,
            "meter_keys": meter_keys,
            "unsigned": unsigned,
            "plaintext_network": plaintext_network or None,
            "notify": notify,
            "log_level": log_level,
            "log_format": log_format,
            "workers": workers,
        }
    )
    _prepare(chosen, chosen.listen)
    _serve(chosen, until_eof=until_eof)


def worker(
    *,
    name: WorkerName = None,
    zenoh_listen: Listen = None,
    zenoh_connect: Endpoints = None,
    zenoh_mode: Mode = None,
    zenoh_config: Config = None,
    prefix: Prefix = None,
    database: Database = None,
    max_skew: MaxSkew = None,
    grace: Grace = None,
    max_payload: MaxPayload = None,
    queue: Queue = None,
    max_shelve: MaxShelve = None,
    meter_keys: MeterKeysFile = None,
    unsigned: Unsigned = None,
    plaintext_network: Plaintext = False,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
    until_eof: UntilEof = False,
) -> None:
    """Monitor a part of the feeders of a cluster until interrupted.

    The front is `gridsec serve --workers`. Both have the same PostgreSQL database, zenoh network and prefix.
    Every option but `--name` can also be set as GRIDSEC_..., as for `serve`. By default zenoh connects to
    tcp/127.0.0.1:7447 as a client.
    """
    from service.settings import DEFAULT_ENDPOINT, settings

    chosen = settings(
        {
            "zenoh_listen": tuple(zenoh_listen) if zenoh_listen else None,
            "zenoh_connect": tuple(zenoh_connect) if zenoh_connect else None,
            "zenoh_mode": zenoh_mode,
            "zenoh_config": zenoh_config,
            "prefix": prefix,
            "database": database,
            "max_skew_s": max_skew,
            "grace_s": grace,
            "max_payload": max_payload,
            "queue": queue,
            "max_shelve_h": max_shelve,
            "meter_keys": meter_keys,
            "unsigned": unsigned,
            "plaintext_network": plaintext_network or None,
            "log_level": log_level,
            "log_format": log_format,
        }
    )
    if not (chosen.zenoh_connect or chosen.zenoh_listen or chosen.zenoh_config):
        chosen = chosen.model_copy(update={"zenoh_connect": (DEFAULT_ENDPOINT,)})
    if chosen.zenoh_mode is None and chosen.zenoh_config is None:
        chosen = chosen.model_copy(update={"zenoh_mode": "client"})
    _prepare(chosen, chosen.zenoh_listen)
    _work(chosen, name, until_eof=until_eof)


def _prepare(chosen: Settings, listen: tuple[str, ...]) -> None:
    """Refuse endpoints of zenoh without TLS, and set up the log. Raises SettingsInvalid."""
    import structlog

    from service import logs
    from service.ingest import zenoh_bus
    from service.ingest.queues import BusConfig
    from service.settings import refuse_exposed, strangers

    if not chosen.plaintext_network:
        bus = BusConfig(chosen.zenoh_mode, listen, chosen.zenoh_connect, chosen.zenoh_config)
        refuse_exposed(zenoh_bus.endpoints(bus))
    logs.set_up(chosen.log_level, chosen.log_format)
    for variable, closest in strangers(os.environ).items():
        structlog.get_logger().warning("variable_ignored", variable=variable, closest=closest or None)


def _serve(chosen: Settings, *, until_eof: bool) -> None:
    """Run the service, or the front of a cluster."""
    import structlog

    from service.app import serve as run
    from service.cluster.run import serve_front
    from service.engine.design_jobs import settle

    def announce(running: Running) -> None:
        print(running.url, flush=True)
        if not running.feeders and chosen.workers is None:
            structlog.get_logger("gridsec.app").warning(
                "no feeder is monitored", add=f"--feeder DIR, or PUT {running.url}/api/v1/feeders/NAME"
            )
        if until_eof:
            _stop_at_eof(asyncio.get_running_loop(), running.stop)

    if chosen.workers is None:
        _run_to_end(lambda stopping: run(chosen, announce=announce, settled=settle, stopping=stopping))
    else:
        _run_to_end(lambda stopping: serve_front(chosen, announce=announce, stopping=stopping))


def _work(chosen: Settings, name: str | None, *, until_eof: bool) -> None:
    """Run a worker."""
    from service.api.dependencies import NAME
    from service.cluster.run import check_cluster
    from service.cluster.worker import work, worker_name
    from service.engine.design_jobs import settle

    check_cluster(chosen)
    if name is not None and re.fullmatch(NAME, name) is None:
        raise typer.BadParameter(f"--name {name!r}: expected 1 to 64 of the characters A-Z a-z 0-9 _ -")

    def announce(stop: Callable[[], None]) -> None:
        if until_eof:
            _stop_at_eof(asyncio.get_running_loop(), stop)

    chosen_name = name or worker_name()
    _run_to_end(
        lambda stopping: work(
            chosen, chosen_name, announce=announce, settled=settle, stopping=stopping, lost=_end_now
        )
    )


def _end_now(error: BaseException) -> None:
    """End the process after the loss of a lease, before anything is written or published."""
    print_error(str(error))
    os._exit(LEASE_LOST)


def _run_to_end(main: Callable[[Callable[[], None]], Coroutine[None, None, None]]) -> None:
    """Run a service; `main` gets what it calls when it begins to end."""
    from service.engine.design_jobs import abandon

    ended = threading.Event()
    try:
        asyncio.run(main(partial(_end_within, STOP_S, ended)))
        ended.set()
    finally:
        abandon()


def _end_within(seconds: float, ended: threading.Event) -> None:
    """End the process after a time even if a step hangs: a commit, a socket, a design.

    A request is confirmed only after its commit, so that no confirmed request is lost. The exit code is 0 if
    the service itself has ended and only the interpreter has not.
    """
    import structlog

    from service.engine.design_jobs import abandon

    def end() -> None:
        if ended.is_set():
            os._exit(0)
        structlog.get_logger().error("ended by force: something did not end in time", after_s=seconds)
        abandon()
        os._exit(FAILED)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()


def _stop_at_eof(loop: asyncio.AbstractEventLoop, stop: Callable[[], None]) -> None:
    """Stop when the parent process has ended: standard input is then closed."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        loop.call_soon_threadsafe(stop)

    threading.Thread(target=wait, name="gridsec-eof", daemon=True).start()
