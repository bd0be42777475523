"""zenoh interface: samples in, estimates and alarms out, replies to queries.

The rest of the service uses plain Python: `Sample`s in batches, and `Bus.telemetry` and `Bus.event` to
publish. This module contains the workarounds of the binding. Samples are drained by one blocking receive and
then non-blocking ones. Callbacks are not used: they collapse under a busy interpreter, and a call of zenoh
from a callback can deadlock. Every session is closed explicitly, otherwise the process hangs at exit.
"""

from __future__ import annotations

import json
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice
from typing import Any, TypeAlias

import structlog
import zenoh

from gridsec.errors import GridsecError
from service.access.signing import ATTACHMENT_MAX
from service.ingest.queues import (
    BusConfig,
    BusCounts,
    BusUnavailable,
    Outgoing,
    Publication,
    Sample,
    StoredEvent,
    Value,
)

RING = 4096
"""Capacity of a subscription's queue, samples: a reading of each of 1 000 meters for four seconds.

Each waiting sample may keep a receive buffer of 64 KiB; a flood by one peer took 12 to 25 kB for each.
"""
POLL_S = 0.02
"""Pause between two looks at the queues, s.

A thread that waits for one queue wakes ten times a second and takes the interpreter's lock: hundreds of them
stop the others.
"""

BATCH = 1024
"""Largest number of samples that are taken from one queue before the next one."""
NEWEST = 4
"""Number of the newest samples of a key that are taken from a queue with more than `BATCH`."""
DECLARING_S = 0.005
"""Time for declarations of keys after a look at the queues, s."""
KEYS_DECLARED = 20_000
"""Largest number of declared keys: one takes 0.2 ms then, in proportion to their number."""
_HEAD = 1024
QUERIES_WAITING = 256
_ESTIMATES = 1024
_OPEN_TIMEOUT_MS = 5_000
MISSED_AT_ONCE = 1000
"""Largest number of stored events that one query reads."""
_DIGITS = 18
"""Largest number of digits of an event's number."""
JSON = "application/json"
_log = structlog.get_logger("gridsec.zenoh")
_MULTICAST = "udp/224.0.0.224:7446"
"""Group of zenoh's multicast scouting."""


def _config(config: BusConfig) -> zenoh.Config:
    try:
        if config.file is None:
            built = zenoh.Config()
            settings: dict[str, Any] = {
                "mode": "router",
                "listen/endpoints": [],
                "connect/endpoints": [],
                "connect/timeout_ms": {"router": -1, "peer": -1, "client": _OPEN_TIMEOUT_MS},
                "scouting/multicast/enabled": False,
                "transport/shared_memory/enabled": False,
                "transport/unicast/max_sessions": config.max_sessions,
                "transport/unicast/accept_pending": config.accept_pending,
            }
        else:
            built = zenoh.Config.from_file(str(config.file))
            settings = {}
        if config.mode is not None:
            settings["mode"] = config.mode
        if config.listen:
            settings["listen/endpoints"] = [_buffered(endpoint) for endpoint in config.listen]
        if config.connect:
            settings["connect/endpoints"] = [_buffered(endpoint) for endpoint in config.connect]
        for key, value in settings.items():
            built.insert_json5(key, json.dumps(value))
    except (zenoh.ZError, OSError, ValueError) as error:
        raise BusUnavailable(
            f"zenoh configuration: {_first_line(error)}", code="bus-configuration"
        ) from error
    return built


def _buffered(endpoint: str) -> str:
    """Bound the age of data under load: small socket buffers pass backpressure to the sender at once."""
    if "#" in endpoint or not endpoint.startswith("tcp/"):
        return endpoint
    return endpoint + "#so_rcvbuf=65536;so_sndbuf=65536"


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0].partition(" at /")[0].strip()


@contextmanager
def session(config: BusConfig) -> Iterator[zenoh.Session]:
    """Open a zenoh session and close it in any case; `RUST_LOG` writes zenoh's own log to standard output.

    Raises BusUnavailable if an endpoint cannot be listened on or connected to, or the configuration is wrong.
    """
    built = _config(config)
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    try:
        opened = zenoh.open(built)
    except zenoh.ZError as error:
        ends = ", ".join((*config.listen, *config.connect)) or "no endpoint"
        text = f"zenoh cannot be opened on {ends}: {_first_line(error)}"
        raise BusUnavailable(text, code="bus-endpoint") from error
    with opened:
        yield opened


def endpoints(config: BusConfig) -> tuple[str, ...]:
    """Return the endpoints of a configuration: to listen on, to connect to, to search other sessions.

    Raises
    ------
    BusUnavailable
        If the configuration is wrong.
    """
    built = _config(config)
    mode = _mode(built)
    found = [*_ends(built, "listen"), *_ends(built, "connect")]
    scouts = mode != "router" and json.loads(built.get_json("scouting/multicast/enabled")) is not False
    if scouts and json.loads(built.get_json("transport/link/protocols")) != ["tls"]:
        found.append(_MULTICAST)
    return tuple(found)


def fixed_listeners(config: BusConfig) -> tuple[str, ...]:
    """Return the endpoints that one process of a machine can listen on: all except those with port 0.

    Raises
    ------
    BusUnavailable
        If the configuration is wrong.
    """
    ends = _ends(_config(config), "listen")
    return tuple(end for end in ends if not re.split("[?#]", end, maxsplit=1)[0].endswith(":0"))


def _mode(built: zenoh.Config) -> str:
    return json.loads(built.get_json("mode")) or "peer"


def _ends(built: zenoh.Config, name: str) -> list[str]:
    """Endpoints to `listen` or `connect`."""
    ends = json.loads(built.get_json(f"{name}/endpoints"))
    if isinstance(ends, dict):
        ends = ends.get(_mode(built), [])
    return [end["locator"] if isinstance(end, dict) else end for end in ends or ()]


def tls_files(config: BusConfig) -> dict[str, str]:
    """Return the certificate and key files of a configuration by their names in `transport/link/tls`.

    Raises
    ------
    BusUnavailable
        If the configuration is wrong.
    """
    section: dict[str, Any] = json.loads(_config(config).get_json("transport/link/tls")) or {}
    return {
        name: path
        for name, path in section.items()
        if isinstance(path, str) and name.endswith(("_certificate", "_private_key"))
    }


_Handler: TypeAlias = "zenoh.handlers.Handler[zenoh.Sample]"
_Subscription: TypeAlias = "tuple[zenoh.Subscriber[Any], _Handler]"
"""A subscription and its queue, which remains readable after its end."""
_Keyed: TypeAlias = "tuple[str, zenoh.Sample]"
"""A sample and its key."""


@dataclass(slots=True)
class _Followed:
    """Reception of one feeder."""

    subscriber: zenoh.Subscriber[Any]
    queue: _Handler
    keys: dict[str, zenoh.KeyExpr | None] = field(default_factory=dict)  # None: still to be declared


class Bus:
    """zenoh session of the service, as a context manager.

    prefix: first chunks of every key.
    deliver: called from the receiving threads with each batch. It may block only if `lossless`.
    max_payload: size beyond which a payload is cut to its beginning, bytes.
    lossless: under load, block the senders instead of dropping the oldest samples. For `Clock.EVENTS`; in
        real time old data are worthless.
    wall: wall clock, Unix s.
    missed: called with `alarm` or `incident`, a number and a limit; returns the stored events after the
        number, oldest first. A GridsecError that it raises is the reply. None: such queries get no reply.
    everything: receive the keys of all other feeders as well, to report them as bad readings.
    count: called from the receiving threads with a feeder, the number of its samples that are not delivered,
        and the number of those of them that are dropped: 0 for a feeder of `discard`, all of a long queue.
    expects: True for a key of single readings of a meter that is known; it is declared when it arrives.
        zenoh compares other keys with the subscriptions of all feeders at each put.

    Each followed feeder has a queue of its own: a flood on other keys displaces none of its samples. A look
    at a queue empties it, so that samples become no older than the time between two looks.
    """

    def __init__(
        self,
        config: BusConfig,
        prefix: str,
        deliver: Callable[[list[Sample]], object],
        *,
        max_payload: int,
        lossless: bool,
        wall: Callable[[], float] = time.time,
        missed: Callable[[str, int, int], Iterable[StoredEvent]] | None = lambda *_: (),
        everything: bool = True,
        count: Callable[[str, int, int], object] = lambda *_: None,
        expects: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._wall, self._missed, self._everything = wall, missed, everything
        self._live: zenoh.Session | None = None
        self._followed: dict[str, _Followed] = {}
        self._discarded: Collection[str] = frozenset()
        self._arrived: deque[tuple[str, _Followed, str]] = deque()  # keys to be declared
        self._declared = 0  # number of declared keys
        self._count, self._expects = count, expects
        self._others: _Subscription | None = None
        self._closing = threading.Event()
        self._config = config
        self._prefix = prefix
        self._deliver = deliver
        self._max_payload = max_payload
        self._lossless = lossless
        self._stack = ExitStack()
        self._threads: list[threading.Thread] = []
        self._outgoing = Outgoing()
        self._answers: dict[str, Value] = {}
        self._answers_lock = threading.Lock()
        self.counts = BusCounts()
        self.failure: str | None = None

    def __enter__(self) -> Bus:
        """Open the session, subscribe, and declare the queryables."""
        with ExitStack() as stack:
            live = self._live = stack.enter_context(session(self._config))
            if self._everything:
                # Its pattern also matches wrong keys.
                self._others = self._subscribe(live, "**")
                stack.callback(self._others[0].undeclare)
            if self._lossless and self._others is not None:
                self._start("zenoh readings", self._receive, self._others[1])
            else:
                self._start("zenoh readings", self._poll, self._closing)
                stack.callback(self._closing.set)
            for kind in ("estimate", "alarm/*", "incident/*"):
                key = f"{self._prefix}/*/{kind}"
                queryable = live.declare_queryable(key, zenoh.handlers.FifoChannel(QUERIES_WAITING))
                stack.callback(queryable.undeclare)
                answer = partial(self._answer, kind.partition("/")[0])
                self._start(f"zenoh queries {key}", answer, queryable.handler)
            token = live.liveliness().declare_token(f"{self._prefix}/service/{live.zid()}")
            stack.callback(token.undeclare)
            publishing = self._start("zenoh publish", self._publish, live)
            stack.callback(self._stop_publishing, publishing)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Publish the waiting items, close the session, end the threads."""
        self._stack.close()
        for thread in self._threads:
            thread.join(timeout=2.0)

    def _start(self, name: str, run: Callable[[Any], None], argument: Any) -> threading.Thread:
        thread = threading.Thread(target=run, args=(argument,), name=name, daemon=True)
        thread.start()
        self._threads.append(thread)
        return thread

    def _session(self) -> zenoh.Session:
        if self._live is None:
            raise BusUnavailable("the zenoh session is not open", code="bus-closed")
        return self._live

    # ---------------------------------------------------------------- in

    def _subscribe(self, live: zenoh.Session, pattern: str) -> _Subscription:
        """Subscribe to readings; one subscription for all kinds of readings keeps their order."""
        # A full ring drops the oldest samples; the gap shows in the sequence numbers.
        ring: Any = zenoh.handlers.FifoChannel(RING) if self._lossless else zenoh.handlers.RingChannel(RING)
        remote = zenoh.Locality.REMOTE
        made = live.declare_subscriber(f"{self._prefix}/{pattern}", ring, allowed_origin=remote)
        return made, made.handler

    def follow(self, feeder: str) -> None:
        """Receive the keys of one feeder; idempotent. With `lossless` one queue keeps the order of all.

        Samples that wait in the queue of all other keys at this moment are discarded.
        """
        if not self._lossless and feeder not in self._followed:
            self._followed[feeder] = _Followed(*self._subscribe(self._session(), f"{feeder}/**"))

    def unfollow(self, feeder: str) -> None:
        """End the effect of `follow`; idempotent."""
        if (made := self._followed.pop(feeder, None)) is not None:
            made.subscriber.undeclare()  # type: ignore[no-untyped-call]
            for key in [one for one in list(made.keys.values()) if one is not None]:
                self._undeclare(key)

    def discard(self, feeders: Collection[str]) -> None:
        """Count the samples of exactly these followed feeders, and deliver none, from the next look on."""
        self._discarded = feeders

    def _receive(self, handler: _Handler) -> None:
        """Deliver the samples of one subscription until it ends."""
        while True:
            try:
                first = handler.recv()
            except zenoh.ZError:  # the subscription is closed and drained
                return
            self._deliver(self._copies(self._readings(_waiting(handler, BATCH, first))))

    def _poll(self, closing: threading.Event) -> None:
        """Deliver the samples of all subscriptions in turn, until `closing` is set.

        Samples on patterns of keys are not counted: a flood of them would leave a feeder's own ones in its
        queue until they are displaced.
        """
        while not closing.wait(POLL_S):
            batch, begun = list[Sample](), time.monotonic()
            for feeder, followed in list(self._followed.items()):
                if closing.is_set():
                    break
                # Most of them are empty: the look is the cost.
                if (first := _try_recv(followed.queue)) is not None:
                    batch += self._take(feeder, followed, _waiting(followed.queue, RING, first))
                # A flood in all queues makes the look last: the others must not wait for its end.
                if batch and (len(batch) >= BATCH or time.monotonic() - begun > POLL_S):
                    self._deliver(batch)
                    batch, begun = [], time.monotonic()
            if self._others is not None:
                batch += self._copies(self._readings(_waiting(self._others[1], BATCH)))
            if batch:
                self._deliver(batch)
            self._declare(closing)

    def _take(self, feeder: str, followed: _Followed, waiting: Iterable[zenoh.Sample]) -> list[Sample]:
        """Copies of a feeder's waiting samples; the others are counted."""
        found = self._readings(waiting, feeder)
        if feeder in self._discarded:
            self._count(feeder, sum(1 for _ in found), 0)
            return []
        readings = list(found)
        if len(readings) > BATCH:
            newest = _newest(readings)
            older = len(readings) - len(newest)
            self._count(feeder, older, older)
            readings = newest
        for key, _ in readings:
            if key not in followed.keys and self._expects(key):
                followed.keys[key] = None
                self._arrived.append((feeder, followed, key))
        return self._copies(readings)

    def _declare(self, closing: threading.Event) -> None:
        """Declare keys that have arrived, within a time limit."""
        live, end = self._session(), time.monotonic() + DECLARING_S
        while self._arrived and time.monotonic() < end and not closing.is_set():
            feeder, followed, key = self._arrived.popleft()
            if self._followed.get(feeder) is not followed or self._declared >= KEYS_DECLARED:
                continue
            with suppress(zenoh.ZError):  # the session is closed: reception ends by itself
                followed.keys[key] = made = live.declare_keyexpr(key)
                self._declared += 1
                if self._followed.get(feeder) is not followed:  # meanwhile
                    self._undeclare(made)

    def _undeclare(self, key: zenoh.KeyExpr) -> None:
        self._declared -= 1
        with suppress(zenoh.ZError):  # the session is closed
            self._session().undeclare(key)

    def _readings(self, samples: Iterable[zenoh.Sample], feeder: str | None = None) -> Iterator[_Keyed]:
        """Readings among some samples, with keys of one feeder, or None: of no followed one.

        A put on a pattern of keys is in the queues of all feeders that it matches.
        """
        start = len(self._prefix) + 1
        for raw in samples:
            key = str(raw.key_expr)
            of = key[start:].partition("/")[0]
            if (of in self._followed if feeder is None else of != feeder) or self._published_by_others(key):
                continue
            if raw.kind == zenoh.SampleKind.DELETE:
                self.counts.deleted += 1
            else:
                yield key, raw

    def _copies(self, readings: Iterable[_Keyed]) -> list[Sample]:
        return [self._copy(raw, key) for key, raw in readings]

    def _published_by_others(self, key: str) -> bool:
        """True for keys that another service with this prefix publishes."""
        if key.endswith(("/reading", "/readings")):
            return False
        match key.removeprefix(f"{self._prefix}/").split("/"):
            case [_, "estimate"] | [_, "alarm" | "incident", _]:
                return True
        return False

    def _copy(self, raw: zenoh.Sample, key: str) -> Sample:
        payload = raw.payload.to_bytes()
        size = len(payload)
        kept = payload if size <= self._max_payload else payload[:_HEAD]
        attached = raw.attachment
        # A key or an attachment that is cut here is longer than every valid one, and stays invalid.
        attachment = b"" if attached is None else attached.to_bytes()[: ATTACHMENT_MAX + 1]
        at = key[: len(self._prefix) + _HEAD]
        return Sample(at, kept, str(raw.encoding), self._wall(), size, attachment)

    # ---------------------------------------------------------------- out

    def telemetry(self, key: str, payload: Value) -> None:
        """Publish the newest value of a key, and store it for queries.

        `key` has no prefix. A function is called in another thread, for a subscriber or a query.
        """
        with self._answers_lock:
            self._answers[f"{self._prefix}/{key}"] = payload
        self._outgoing.add_telemetry(f"{self._prefix}/{key}", payload)

    def event(
        self,
        key: str,
        payload: bytes,
        *,
        last: bool,
        number: int = 0,
        done: Callable[[], None] | None = None,
    ) -> bool:
        """Publish an event that must not be lost; in order, with high priority.

        `key` has no prefix; the payload is JSON, `number` its attachment (0: none). With `last` the key is
        deleted after the put. `done` is called from the publishing thread. Returns False if too many events
        are waiting; the event is not queued.
        """
        full = f"{self._prefix}/{key}"
        with self._answers_lock:
            if last:
                self._answers.pop(full, None)
            else:
                self._answers[full] = payload
        put = Publication(full, payload, None if last else done, number)
        return self._outgoing.add_events(put, *([Publication(full, None, done, number)] if last else []))

    def answer(self, key: str, payload: bytes) -> None:
        """Store the reply to queries for a key, without publishing it.

        `key` has no prefix; the payload is JSON.
        """
        with self._answers_lock:
            self._answers[f"{self._prefix}/{key}"] = payload

    def withdraw(self, feeder: str) -> None:
        """Remove the replies to queries for all keys of a feeder."""
        below = f"{self._prefix}/{feeder}/"
        with self._answers_lock:
            for key in [key for key in self._answers if key.startswith(below)]:
                del self._answers[key]

    def _publish(self, live: zenoh.Session) -> None:
        publishers: dict[str, zenoh.Publisher] = {}
        while (item := self._outgoing.next()) is not None:
            try:
                if isinstance(item, Publication):
                    _put_event(live, item)
                else:
                    key, value = item
                    if key not in publishers:
                        publishers[key] = live.declare_publisher(
                            key,
                            encoding=JSON,
                            congestion_control=zenoh.CongestionControl.DROP,
                            # The session's own subscription of readings matches the key, too.
                            allowed_destination=zenoh.Locality.REMOTE,
                        )
                    if not isinstance(value, bytes) and not _has_receiver(publishers[key]):
                        continue
                    text = _text(key, value)
                    if text is None:
                        continue
                    publishers[key].put(text)
            except zenoh.ZError as error:
                self.counts.publish_failed += 1
                self.failure = _first_line(error)
                if isinstance(item, Publication) and _well_formed(item.key):
                    self._outgoing.put_back(item)
                continue
            self.counts.published += 1
            if isinstance(item, Publication):
                self._outgoing.retry_at = None
                if item.done is not None:
                    item.done()
            if self._outgoing.retry_at is None:
                self.failure = None

    def _stop_publishing(self, thread: threading.Thread) -> None:
        self._outgoing.close()
        thread.join(timeout=2.0)

    # ---------------------------------------------------------------- queries

    def _answer(self, kind: str, handler: zenoh.handlers.Handler[zenoh.Query]) -> None:
        while True:
            try:
                query = handler.recv()
            except zenoh.ZError:
                return
            self.counts.queries += 1
            with query:
                if kind != "estimate" and query.parameters.get("after") is not None:
                    if self._missed is not None:
                        self._answer_missed(kind, query, self._missed)
                    continue
                with self._answers_lock:
                    known = tuple(self._answers.items())
                for key, payload in known:
                    if not query.key_expr.intersects(key) or (text := _text(key, payload)) is None:
                        continue
                    if not _reply(query, key, text):
                        break

    def _answer_missed(
        self, kind: str, query: zenoh.Query, missed: Callable[[str, int, int], Iterable[StoredEvent]]
    ) -> None:
        """Reply with the newest event of each key after the number of a query; numbers are attachments."""
        given = query.parameters.get("after") or ""
        if not (given.isascii() and given.isdigit() and len(given) <= _DIGITS):
            _refuse(query, f"after is {given[:40]!r}; expected the number of an event")
            return
        try:
            events = list(missed(kind, int(given), MISSED_AT_ONCE))
        except GridsecError as error:
            _refuse(query, str(error))
            return
        newest = {event.key: event for event in events}
        for event in sorted(newest.values(), key=lambda event: event.number):
            key = f"{self._prefix}/{event.key}"
            if query.key_expr.intersects(key) and not _reply(query, key, event.payload, event.number):
                return

    # ---------------------------------------------------------------- between processes of a cluster

    def serve(self, key: str, answer: Callable[[bytes, Callable[[bytes], None]], None]) -> None:
        """Answer queries for a key, without the prefix.

        `answer` is called from another thread with the payload and a function that replies, once, from any
        thread.
        """
        live = self._session()
        made = live.declare_queryable(f"{self._prefix}/{key}", zenoh.handlers.FifoChannel(QUERIES_WAITING))
        self._stack.callback(made.undeclare)
        self._start(f"zenoh {key}", partial(_serve, answer), made.handler)

    def ask(self, key: str, payload: bytes, timeout_s: float) -> Iterator[bytes]:
        """Query a key, without the prefix, and yield the payload of each reply as it arrives. Blocks.

        All queryables are asked, and each reply counts: a false one replaces no other. A queryable that does
        not end the query keeps it open in zenoh until `timeout_s`, also after the last reply that is read.
        Raises BusUnavailable.
        """
        try:
            replies = self._session().get(
                f"{self._prefix}/{key}",
                payload=payload,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for reply in replies:
                if reply.ok is not None:
                    yield reply.ok.payload.to_bytes()
        except zenoh.ZError as error:
            raise BusUnavailable(f"zenoh query: {_first_line(error)}", code="query-failed") from error


def _serve(
    answer: Callable[[bytes, Callable[[bytes], None]], None], handler: zenoh.handlers.Handler[zenoh.Query]
) -> None:
    while True:
        try:
            query = handler.recv()
        except zenoh.ZError:
            return
        given = query.payload
        try:
            answer(b"" if given is None else given.to_bytes(), partial(_respond, query))
        except Exception:  # noqa: BLE001 - the next queries are answered
            _log.exception("a query could not be answered", key=str(query.key_expr))


def _respond(query: zenoh.Query, payload: bytes) -> None:
    """Reply on the key of the query, and end it."""
    with suppress(zenoh.ZError), query:  # the querying session is closed
        query.reply(query.key_expr, payload)


def _has_receiver(publisher: zenoh.Publisher) -> bool:
    """True if a subscriber matches. The binding's stubs state a boolean in place of the object."""
    status = publisher.matching_status
    return bool(getattr(status, "matching", status))


def _text(key: str, value: Value) -> bytes | None:
    """Payload of a value; None, with a line in the log, if it cannot be built."""
    if isinstance(value, bytes):
        return value
    try:
        return value()
    except Exception:  # noqa: BLE001 - the other values are published
        _log.exception("a value could not be built", key=key)
        return None


def _well_formed(key: str) -> bool:
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError:
        return False
    return True


def _put_event(live: zenoh.Session, item: Publication) -> None:
    options: Mapping[str, Any] = {
        "congestion_control": zenoh.CongestionControl.BLOCK,
        "priority": zenoh.Priority.INTERACTIVE_HIGH,
        "express": True,
        "attachment": str(item.number) if item.number else None,
    }
    if item.payload is None:
        live.delete(item.key, **options)
    else:
        live.put(item.key, item.payload, encoding=JSON, **options)


def _reply(query: zenoh.Query, key: str, payload: bytes, number: int | None = None) -> bool:
    attachment = None if number is None else str(number)
    try:
        query.reply(key, payload, encoding=JSON, attachment=attachment)
    except zenoh.ZError:  # the querying session is closed
        return False
    return True


def _refuse(query: zenoh.Query, problem: str) -> None:
    with suppress(zenoh.ZError):  # the querying session is closed
        query.reply_err(json.dumps({"detail": problem}), encoding=JSON)


def _waiting(handler: _Handler, most: int, *first: zenoh.Sample) -> Iterator[zenoh.Sample]:
    """Some samples and those that wait in a queue behind them, up to `most` together."""
    return islice(chain(first, iter(partial(_try_recv, handler), None)), most)


def _newest(found: Sequence[_Keyed]) -> list[_Keyed]:
    """The `NEWEST` samples of each key, oldest first."""
    counts: Counter[str] = Counter()
    newest: list[_Keyed] = []
    for one in reversed(found):
        counts[one[0]] += 1
        if counts[one[0]] <= NEWEST:
            newest.append(one)
    return newest[::-1]


def _try_recv(handler: _Handler) -> zenoh.Sample | None:
    try:
        return handler.try_recv()
    except zenoh.ZError:  # the subscription is closed, and its queue is empty
        return None


DECLARED = 2_000
"""Largest number of keys that a session of virtual meters declares.

A router looks up the subscriptions of a declared key once, of another one with each payload. The time of a
declaration grows with the number of declared keys.
"""


class MeterClient:
    """zenoh session of the virtual meters: puts readings and, on request, receives estimates.

    config: usually a client of the service.
    prefix: first chunks of every key.
    """

    def __init__(self, config: BusConfig, prefix: str) -> None:
        self._config = config
        self._prefix = prefix
        self._stack = ExitStack()
        self._live: zenoh.Session | None = None
        self._estimates: _Handler | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}

    def __enter__(self) -> MeterClient:
        """Open the session."""
        self._live = self._stack.enter_context(session(self._config))
        return self

    def __exit__(self, *_: object) -> None:
        """Close the session."""
        self._live = None
        self._publishers.clear()
        self._stack.close()

    def watch(self, feeder: str) -> None:
        """Subscribe to the estimates of a feeder."""
        live = self._session()
        subscriber = live.declare_subscriber(
            f"{self._prefix}/{feeder}/estimate", zenoh.handlers.RingChannel(_ESTIMATES)
        )
        self._stack.callback(subscriber.undeclare)
        self._estimates = subscriber.handler

    def estimates(self) -> list[bytes]:
        """Return the estimates received since the last call, oldest first."""
        found: list[bytes] = []
        while self._estimates is not None and (sample := _try_recv(self._estimates)) is not None:
            found.append(sample.payload.to_bytes())
        return found

    def query(self, key: str, timeout_s: float) -> dict[str, bytes]:
        """Query the values of a key.

        `key` is a key or pattern without the prefix. Returns the payload by full key.
        """
        replies = self._session().get(f"{self._prefix}/{key}", timeout=timeout_s)
        samples = (reply.ok for reply in replies)
        return {str(one.key_expr): one.payload.to_bytes() for one in samples if one is not None}

    def _session(self) -> zenoh.Session:
        if self._live is None:
            raise BusUnavailable("the meters' zenoh session is not open", code="bus-closed")
        return self._live

    def put(self, key: str, payload: bytes, encoding: str = JSON) -> None:
        """Put a payload on a key (without the prefix). Raises BusUnavailable if the session is closed."""
        try:
            live, publisher, full_key = self._session(), self._publishers.get(key), f"{self._prefix}/{key}"
            # The default (drop when the network is congested) would lose readings of a simulation faster
            # than real time; a meter with one reading per second is not affected.
            block = zenoh.CongestionControl.BLOCK
            if publisher is None and len(self._publishers) < DECLARED:
                publisher = live.declare_publisher(full_key, congestion_control=block)
                self._publishers[key] = publisher
            if publisher is None:
                live.put(full_key, payload, encoding=encoding, congestion_control=block)
            else:
                publisher.put(payload, encoding=encoding)
        except zenoh.ZError as error:
            raise BusUnavailable(f"zenoh put: {_first_line(error)}", code="put-failed") from error
