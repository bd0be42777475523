"""Assembly of the service: settings, database, feeders, runtime, zenoh, HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import structlog

from feeders.format.tables import from_json
from feeders.model.site import Site, from_tables, load
from feeders.registry import choose
from gridsec.errors import FeederInvalid, GridsecError, InputInvalid, Problem
from service import systemd
from service.access.tokens import TokenVerifier
from service.api.access import Authenticator
from service.api.dependencies import Backend, Forward
from service.api.listener import BoundedServer, Shares, raise_limit
from service.api.routes import MAX_STREAMS, create_api
from service.engine.engine import RuntimeConfig
from service.engine.runtime import Runtime
from service.errors import prefixed
from service.ingest.align import Clock
from service.ingest.queues import BusConfig, StoredEvent
from service.ingest.zenoh_bus import Bus
from service.metrics import Metrics
from service.notify.delivery import Notifier
from service.notify.notices import IncidentSource
from service.notify.targets import Targets, read_targets
from service.settings import ENV_PREFIX, Settings, SettingsInvalid, is_loopback, split_address
from service.store import Store
from service.store.access import AccessStore
from service.store.committer import missed
from service.store.deliveries import DeliveryStore

_GRACE_S = 1
_log = structlog.get_logger("gridsec.app")


class AddressUnavailable(GridsecError):
    """The HTTP address cannot be listened on."""

    code = "address-unavailable"


@dataclass(frozen=True, slots=True)
class Running:
    """Properties of the running service for its starter."""

    url: str
    feeders: tuple[str, ...]
    stop: Callable[[], None]


async def serve(
    settings: Settings,
    *,
    announce: Callable[[Running], None] = lambda _: None,
    signals: bool = True,
    settled: Callable[[], None] = lambda: None,
    stopping: Callable[[], None] = lambda: None,
    wall: Callable[[], float] = time.time,
) -> None:
    """Run the service until SIGINT, SIGTERM or `Running.stop`.

    `announce` is called once HTTP responds, `stopping` at the beginning of the end, `settled` as in
    `Runtime`. Signals can be handled in the main thread only. Raises FeederInvalid, StoreUnavailable,
    BusUnavailable, AddressUnavailable if the service cannot start.
    """
    shares = Shares.of(raise_limit())
    config = runtime_config(settings)
    targets = read_notify(settings)
    sites = {
        name: choose(site, estimator=settings.estimator)
        for name, site in load_sites(settings.feeders).items()
    }
    with ExitStack() as stack:
        store = stack.enter_context(Store(settings.database))
        http = HttpSide.open(stack, settings, shares, targets, wall)
        given = tuple(sites)
        stored, unloaded = _stored(sites, store)
        sites |= stored
        runtime = Runtime(
            config, store, sites.values(), given=given, unloaded=unloaded, wall=wall, settled=settled
        )
        bus = bus_of(settings, shares, runtime, missed=partial(missed, store), wall=wall)
        runtime.attach(stack.enter_context(bus))
        await http.serve(stack, runtime, tuple(sites), announce=announce, signals=signals, stopping=stopping)


def runtime_config(settings: Settings) -> RuntimeConfig:
    """Return the configuration of a runtime. Raises SettingsInvalid if the keys of meters cannot be read."""
    return RuntimeConfig(
        prefix=settings.prefix,
        clock=settings.clock,
        max_skew_s=settings.max_skew_s,
        grace_s=settings.grace_s,
        max_payload=settings.max_payload,
        max_samples=settings.queue,
        max_feeders=settings.max_feeders,
        shelve_most_s=3600.0 * settings.max_shelve_h,
        meter_keys=settings.read_meter_keys(),
    )


def bus_of(
    settings: Settings,
    shares: Shares,
    receiver: Runtime | None,
    *,
    missed: Callable[[str, int, int], Iterable[StoredEvent]] | None,
    wall: Callable[[], float],
    everything: bool = True,
) -> Bus:
    """Return the zenoh session of a process, without a receiver of readings for a front.

    The other parameters are those of `Bus`.
    """
    config = BusConfig(
        settings.zenoh_mode,
        settings.listen,
        settings.zenoh_connect,
        settings.zenoh_config,
        max_sessions=shares.sessions,
        accept_pending=shares.pending,
    )
    receiving: dict[str, Any] = {}
    if receiver is not None:
        receiving = {"count": receiver.count, "expects": receiver.expects}
    return Bus(
        config,
        settings.prefix,
        receiver.deliver if receiver is not None else lambda _: None,
        max_payload=settings.max_payload,
        lossless=settings.clock is Clock.EVENTS,
        wall=wall,
        missed=missed,
        everything=everything,
        **receiving,
    )


class Served(Backend, Protocol):
    """Service behind the HTTP application, such as `Runtime`."""

    async def run(self) -> None:
        """Run until `stop`."""

    def stop(self) -> None:
        """End `run` and every subscription soon; called from the event loop."""

    @property
    def counters(self) -> Metrics:
        """Counters and gauges of this process."""


@dataclass(frozen=True, slots=True)
class HttpSide:
    """HTTP address, authentication and notifications of a service."""

    settings: Settings
    shares: Shares
    targets: Targets | None
    authenticator: Authenticator
    listener: socket.socket
    wall: Callable[[], float]

    @classmethod
    def open(
        cls,
        stack: ExitStack,
        settings: Settings,
        shares: Shares,
        targets: Targets | None,
        wall: Callable[[], float],
    ) -> HttpSide:
        """Open it until the end of the stack.

        Raises SettingsInvalid, AddressUnavailable, StoreUnavailable if it cannot be opened.
        """
        authenticator = Authenticator(
            stack.enter_context(AccessStore(settings.database)), _tokens(settings), wall
        )
        stack.callback(authenticator.close)
        _check_exposure(settings, authenticator)
        listener = stack.enter_context(_listen(settings.http))
        return cls(settings, shares, targets, authenticator, listener, wall)

    async def serve(
        self,
        stack: ExitStack,
        service: Served,
        feeders: tuple[str, ...],
        *,
        forward: Forward | None = None,
        announce: Callable[[Running], None],
        signals: bool,
        stopping: Callable[[], None],
    ) -> None:
        """Run the service and its HTTP application until a signal or `Running.stop`."""
        # Several fronts may run; one of them sends.
        shared = forward is not None
        notifier = _notifier(stack, self.settings, self.targets, service, shared=shared, wall=self.wall)
        api = create_api(
            service,
            self.settings.http_hosts,
            max_streams=min(MAX_STREAMS, self.shares.streams),
            authenticator=self.authenticator,
            notifier=notifier,
            forward=forward,
        )
        server = _Server(
            api,
            self.shares.http,
            lifespan="off",
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=_GRACE_S,
            server_header=False,
        )
        with _waking(notifier, service):
            await _run(
                service, server, self.listener, feeders, announce=announce, signals=signals, stopping=stopping
            )


def _tokens(settings: Settings) -> TokenVerifier | None:
    """Verification of bearer tokens; None without an issuer."""
    if not settings.oidc_issuer:
        return None
    return TokenVerifier(
        settings.oidc_issuer, settings.oidc_audience, settings.oidc_jwks, settings.oidc_role_claim
    )


def read_notify(settings: Settings) -> Targets | None:
    """Targets of notifications; None without a file. Raises SettingsInvalid if the file is wrong."""
    if settings.notify is None:
        return None
    try:
        return read_targets(settings.notify)
    except InputInvalid as error:
        start = f"--notify or {ENV_PREFIX}NOTIFY: "
        raise SettingsInvalid(prefixed(start, one) for one in error.problems) from error


def _notifier(
    stack: ExitStack,
    settings: Settings,
    targets: Targets | None,
    service: Served,
    *,
    shared: bool,
    wall: Callable[[], float],
) -> Notifier | None:
    """Notifier of the targets, ended with the stack; None without targets."""
    if targets is None:
        return None
    deliveries = stack.enter_context(DeliveryStore(settings.database, shared=shared))
    notifier = Notifier(targets, IncidentSource(service.store), deliveries, service.counters, wall)
    stack.callback(notifier.close)
    return notifier


@contextlib.contextmanager
def _waking(notifier: Notifier | None, service: Served) -> Iterator[None]:
    """Start the notifier, and wake it after stored events, until the block ends."""
    if notifier is None:
        yield
        return

    async def wake() -> None:
        async for _ in service.subscribe():
            notifier.wake()

    notifier.start()
    task = asyncio.create_task(wake(), name="notify")
    try:
        yield
    finally:
        task.cancel()


def _check_exposure(settings: Settings, authenticator: Authenticator) -> None:
    """Refuse an address beyond loopback without authentication."""
    host, _ = split_address(settings.http)
    if authenticator.required or is_loopback(host) or settings.open_to_network_without_authentication:
        return
    text = (
        f"--http or GRIDSEC_HTTP: {settings.http} is reachable from the network and no authentication is set "
        f"up; add a key (`gridsec key add NAME --role operator --database {settings.database}`), set "
        "--oidc-issuer, or listen on 127.0.0.1. --open-to-network-without-authentication lets any client on "
        "the network change everything"
    )
    raise SettingsInvalid([Problem("no-authentication", text)])


async def _run(
    service: Served,
    server: _Server,
    listener: socket.socket,
    feeders: tuple[str, ...],
    *,
    announce: Callable[[Running], None],
    signals: bool,
    stopping: Callable[[], None],
) -> None:
    stop = asyncio.Event()
    with stop_on_signals(stop, active=signals):
        watching = asyncio.create_task(service.run(), name="runtime")
        serving = asyncio.create_task(server.serve(sockets=[listener]), name="http")
        stopped = asyncio.create_task(stop.wait(), name="stop")
        started = asyncio.create_task(server.up.wait(), name="started")
        await asyncio.wait({started, serving, stopped}, return_when=asyncio.FIRST_COMPLETED)
        started.cancel()
        host, port = listener.getsockname()[:2]
        url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        _log.info("serving", url=url, feeders=list(feeders))
        announce(Running(url, feeders, stop.set))
        supervised = asyncio.create_task(systemd.supervise(lambda: service.healthy()[0]), name="systemd")
        await asyncio.wait({watching, serving, stopped}, return_when=asyncio.FIRST_COMPLETED)
        stopping()
        stopped.cancel()
        supervised.cancel()
        systemd.notify("STOPPING=1")
        service.stop()
        server.should_exit = True
        results = await asyncio.gather(watching, serving, return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result


class _Server(BoundedServer):
    """uvicorn with an event for its start, and without signal handlers.

    uvicorn's own handlers would end the process before zenoh and the database are closed.
    """

    def __init__(self, app: Callable[..., Any], most: int, **options: Any) -> None:
        super().__init__(app, most, **options)
        self.up = asyncio.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and set the event."""
        await super().startup(sockets=sockets)
        self.up.set()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Change nothing."""
        yield


@contextlib.contextmanager
def stop_on_signals(stop: asyncio.Event, *, active: bool = True) -> Iterator[None]:
    """Set an event at SIGINT and SIGTERM, if `active`: only the main thread can."""
    if not active:
        yield
        return
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)


@contextlib.contextmanager
def _listen(address: str) -> Iterator[socket.socket]:
    host, port = split_address(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio disables Nagle's algorithm (40 ms per response) only if the protocol is given as TCP.
    with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
            listener.listen(socket.SOMAXCONN)
        except OSError as error:
            raise AddressUnavailable(f"HTTP cannot listen on {address}: {error.strerror or error}") from error
        listener.setblocking(False)
        yield listener


def load_sites(names: Iterable[str]) -> dict[str, Site]:
    """Load feeders, and report the problems of all of them at once.

    `names` are folders, or names of feeders of the project. Raises FeederInvalid if any cannot be loaded, or
    two have the same name.
    """
    sites: dict[str, Site] = {}
    problems: list[Problem] = []
    for name in names:
        try:
            site = load(name)
        except FeederInvalid as error:
            problems.extend(prefixed(f"{name}: ", problem) for problem in error.problems)
            continue
        if site.feeder.name in sites:
            text = f"{name}: a feeder named {site.feeder.name} has been given already"
            problems.append(Problem("duplicate", text))
        sites[site.feeder.name] = site
    if problems:
        raise FeederInvalid(problems)
    return sites


def _stored(given: Mapping[str, Site], store: Store) -> tuple[dict[str, Site], dict[str, str]]:
    """Load the feeders added over REST; those of the command line take precedence.

    Returns loaded, unloaded: by name: the feeders, and the reasons for those that cannot be loaded.
    """
    loaded: dict[str, Site] = {}
    unloaded: dict[str, str] = {}
    for name, tables in store.feeders().items():
        if name in given:
            _log.warning("the feeder's files go before what was put over REST", feeder=name)
            continue
        try:
            loaded[name] = from_tables(from_json(tables))
        except GridsecError as error:
            # The tables were valid when they were added; after an update of the program the other feeders
            # must still start.
            unloaded[name] = "; ".join(error.problems) if isinstance(error, FeederInvalid) else str(error)
            _log.error("a stored feeder is not watched", feeder=name, problem=unloaded[name])
    return loaded, unloaded
