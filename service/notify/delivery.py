"""Deliveries: at least once, in order per target, each target in a thread of its own.

The position of a target is the number of the last event that was delivered, given up, or not selected by its
filters. It is stored after each request, so that a killed process repeats at most one request. Events are
read from the database: a target that does not answer costs no memory and loses nothing.

- **Failure.** The next attempt follows after a back-off that doubles, with jitter, or after the `Retry-After`
  of the target. Later messages wait.
- **Dead letter.** A message that the target refuses (status 3xx or 4xx, except 408, 425 and 429) is given up
  after `REFUSALS` attempts. Any other failing message is given up when the target has failed for `give_up_s`
  and the event is older than that; it has at least one attempt.
- **Resending.** A dead letter that is requested to be sent again goes out apart from the order, with the same
  id. It is deleted when the target has it.

Time and randomness are arguments of `Delivery`; `Notifier` owns the threads and the clock.
"""

from __future__ import annotations

import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Protocol

import numpy as np
import structlog

from service.metrics import Metrics
from service.notify import alertmanager, webhook
from service.notify.notices import Notice, Source
from service.notify.post import Cancel, Response, post
from service.notify.targets import Alertmanager, Target, Targets, Webhook
from service.store import StoreUnavailable
from service.store.deliveries import DeadLetter, DeliveryStore, Position
from service.times import UtcTwins

PAGE: Final = 100
"""Number of events in one read."""
REFUSALS: Final = 3
"""Attempts of a message that the target refuses."""
BACKOFF_S: Final = 1.0
"""Back-off after the first failure, s."""
BACKOFF_MOST_S: Final = 300.0
"""Largest back-off, s."""
POLL_S: Final = 2.0
"""Interval of reads of requested dead letters, s."""
DEFECT_S: Final = 10.0
"""Pause of a target after an unexpected error, s."""
RESENT_AT_ONCE: Final = 20
"""Dead letters that one step sends again."""

_log = structlog.get_logger("gridsec.notify")


def backoff_s(failures: int, u: float) -> float:
    """Return the wait before the next attempt, s: between half of the back-off and the whole.

    failures: failures since the last success, at least 1.
    u: random number in [0, 1).
    """
    most = min(BACKOFF_MOST_S, BACKOFF_S * 2.0 ** min(failures - 1, 32))
    return most * (0.5 + 0.5 * u)


class Channel(Protocol):
    """Requests to one target."""

    @property
    def target(self) -> Target:
        """Address, limits and filters."""

    @property
    def at_once(self) -> int:
        """Largest number of notices in one request."""

    @property
    def renew_s(self) -> float | None:
        """Interval of repetitions of active notices, s; None without any."""

    def body(self, notices: Sequence[Notice], now: float) -> str:
        """Return the body of a request."""

    def send(self, message_id: str, body: str, now: float) -> Response:
        """Send a body at Unix time `now`."""


class WebhookChannel:
    """Messages of Standard Webhooks, one per request."""

    at_once, renew_s = 1, None

    def __init__(self, target: Webhook, cancel: Cancel) -> None:
        self.target = target
        self._endpoint, self._key, self._cancel = target.endpoint(), target.key(), cancel

    def body(self, notices: Sequence[Notice], now: float) -> str:  # noqa: ARG002  # the time is in the headers
        """Return the message of one notice."""
        (notice,) = notices
        return webhook.body_of(notice)

    def send(self, message_id: str, body: str, now: float) -> Response:
        """Send a signed message."""
        content = body.encode()
        headers = webhook.headers_of(self._key, message_id, content, now)
        return post(self._endpoint, content, headers, cancel=self._cancel)


class AlertmanagerChannel:
    """Alerts of Alertmanager, several per request."""

    at_once = alertmanager.ALERTS_AT_ONCE

    def __init__(self, target: Alertmanager, external_url: str, cancel: Cancel) -> None:
        self.target, self.renew_s = target, target.resend_s
        self._endpoint, self._cancel = target.endpoint(alertmanager.PATH), cancel
        self._labels, self._external_url = target.labels, external_url

    def body(self, notices: Sequence[Notice], now: float) -> str:
        """Return the alerts of notices."""
        return alertmanager.body_of(
            each
            for notice in alertmanager.newest(notices)
            for each in alertmanager.alerts(notice, self._labels, self._external_url, now, self.renew_s)
        )

    def send(self, message_id: str, body: str, now: float) -> Response:  # noqa: ARG002  # alerts have labels
        """Send alerts."""
        return post(self._endpoint, body.encode(), {}, cancel=self._cancel)


def channel_of(
    target: Webhook | Alertmanager, external_url: str, cancel: Cancel | None = None
) -> WebhookChannel | AlertmanagerChannel:
    """Return the channel to a target. `cancel` ends its requests from another thread."""
    cancel = cancel or Cancel()
    if isinstance(target, Webhook):
        return WebhookChannel(target, cancel)
    return AlertmanagerChannel(target, external_url, cancel)


@dataclass(frozen=True, slots=True)
class TargetStatus(UtcTwins):
    """State of a target. Times are Unix seconds."""

    name: str
    kind: str  # `webhook` or `alertmanager`
    host: str  # host of its address
    position: int  # number of the last event that was delivered, given up or not selected
    waiting: int  # events after it
    delivered: float | None  # last successful request
    failing_since: float | None  # first failed request after it
    attempts: int  # failed attempts of the next message
    problem: str | None  # problem of the last attempt
    dead_letters: int  # messages that were given up


class Delivery:
    """Deliveries to one target. Used by one thread; `position` and `dead` are read by others.

    channel: requests to the target.
    source: the events.
    store: positions and dead letters.
    stored: stored position of the target; None for a new target, which begins after the newest event.
    random: uniform random numbers in [0, 1) for the jitter.
    count: called with an outcome (`delivered`, `failed`, `dead`, `resent`) and a number.
    """

    def __init__(
        self,
        channel: Channel,
        source: Source,
        store: DeliveryStore,
        stored: Position | None,
        *,
        random: Callable[[], float],
        count: Callable[[str, int], None] = lambda *_: None,
    ) -> None:
        self._channel, self._target, self._source, self._store = channel, channel.target, source, store
        self._random, self._count = random, count
        self._queue: deque[Notice] = deque()
        self.position = self._begin(stored)
        self._read_to = self.position.position
        self.dead = 0
        self._failures = self.position.attempts
        self._retry_at = self._poll_at = self._renew_at = -float("inf")
        self._at_once = channel.at_once
        self._unsaved = stored is None or stored != self.position
        self._letters: list[DeadLetter] = []

    def _begin(self, stored: Position | None) -> Position:
        newest = self._source.newest
        if stored is None:
            return Position(newest)
        if stored.position > newest:
            # An older backup of the events was restored.
            _log.warning(
                "a target's position is beyond the newest event", target=self._target.name, newest=newest
            )
            return replace(stored, position=newest)
        return stored

    def poll(self) -> None:
        """Read requested dead letters at the next step; from any thread."""
        self._poll_at = -float("inf")

    @property
    def waiting(self) -> int:
        """Number of events after the position."""
        return max(0, self._source.newest - self.position.position)

    def step(self, now: float) -> float:
        """Send at most one request, besides requested dead letters; return the time of the next step, Unix s.

        Raises StoreUnavailable if events or dead letters cannot be read.
        """
        self._save()
        if now >= self._poll_at:
            self._poll_at = now + POLL_S
            self.dead = self._store.counts().get(self._target.name, 0)
            self._resend(now)
        if now < self._retry_at:
            return min(self._retry_at, self._poll_at)
        self._read()
        if self._queue:
            self._send(now)
        elif self._channel.renew_s is not None and now >= self._renew_at:
            self._renew(now)
        self._save()
        if self._retry_at > now:
            return min(self._retry_at, self._poll_at)
        return now if self._queue or self._source.newest > self._read_to else self._poll_at

    def _read(self) -> None:
        """Read the next events; those that are not selected move the position."""
        if self._queue or self._source.newest <= self._read_to:
            return
        page = self._source.after(self._read_to, PAGE)
        self._queue.extend(notice for notice in page if self._target.selects(notice))
        self._read_to = page[-1].number if page else self._source.newest
        if not self._queue:
            self._move(self._read_to)

    def _move(self, position: int) -> None:
        self.position, self._unsaved = replace(self.position, position=position), True

    def _send(self, now: float) -> None:
        """Send the first notices of the queue."""
        sent = [self._queue[k] for k in range(min(len(self._queue), self._at_once))]
        response = self._channel.send(sent[-1].message_id, self._channel.body(sent, now), now)
        if response.accepted:
            self._count("delivered", len(sent))
            self._pass(sent)
            self._succeeded(now)
            return
        if response.ended:
            return
        self._failed(response, now)
        refused = response.refused and self.position.attempts >= REFUSALS
        since = self.position.failing_since
        late = since is not None and min(now - since, now - sent[0].t) >= self._target.give_up_s
        if response.refused and len(sent) > 1:
            # One of several notices may be the reason.
            self._at_once, self._retry_at = 1, now
        elif refused or late:
            self._give_up(sent, response.problem or "", now)

    def _pass(self, sent: Sequence[Notice]) -> None:
        """Move the position after sent or given up notices."""
        for _ in sent:
            self._queue.popleft()
        self._move(sent[-1].number if self._queue else self._read_to)
        if not self._queue:
            self._at_once = self._channel.at_once

    def _succeeded(self, now: float) -> None:
        if self.position.failing_since is not None:
            _log.info("a target is back", target=self._target.name)
        self._failures, self._retry_at = 0, -float("inf")
        self.position = replace(self.position, delivered=now, failing_since=None, attempts=0, problem=None)
        self._unsaved = True

    def _failed(self, response: Response, now: float, *, of_message: bool = True) -> None:
        self._count("failed", 1)
        self._failures += 1
        self._retry_at = now + (response.retry_after_s or backoff_s(self._failures, self._random()))
        before = self.position
        if before.failing_since is None:
            _log.warning(
                "a target does not take a message", target=self._target.name, problem=response.problem
            )
        self.position = replace(
            before,
            failing_since=now if before.failing_since is None else before.failing_since,
            attempts=before.attempts + of_message,
            problem=response.problem,
        )
        self._unsaved = True

    def _give_up(self, sent: Sequence[Notice], problem: str, now: float) -> None:
        attempts = self.position.attempts
        self._letters += [
            DeadLetter(
                self._target.name,
                notice.number,
                notice.message_id,
                notice.type,
                notice.t,
                now,
                attempts,
                problem,
                self._channel.body([notice], now),
            )
            for notice in sent
        ]
        self.dead += len(sent)
        self._count("dead", len(sent))
        self._pass(sent)
        self.position = replace(self.position, attempts=0)
        _log.error("a message was given up", target=self._target.name, id=sent[0].message_id, problem=problem)

    def _renew(self, now: float) -> None:
        """Send the active notices again."""
        active = [notice for notice in self._source.active() if self._target.selects(notice)]
        for k in range(0, len(active), self._channel.at_once):
            part = active[k : k + self._channel.at_once]
            response = self._channel.send("", self._channel.body(part, now), now)
            if response.ended:
                return
            if not response.accepted:
                self._failed(response, now, of_message=False)
                return
        if active:
            self._succeeded(now)
        self._renew_at = now + (self._channel.renew_s or 0.0)

    def _resend(self, now: float) -> None:
        """Send requested dead letters, until the target fails."""
        letters = self._store.letters(target=self._target.name, resend=True, limit=RESENT_AT_ONCE)
        for letter in letters:
            response = self._channel.send(letter.message_id, letter.body, now)
            if response.accepted:
                self._store.discard(ids=[letter.id])
                self.dead -= 1
                self._count("resent", 1)
                continue
            if response.ended:
                return
            self._count("failed", 1)
            self._store.failed_again(letter, response.problem or "")
            if not response.refused:
                return

    def _save(self) -> None:
        """Store the position and new dead letters; on failure they are kept and stored with the next step."""
        if not self._unsaved:
            return
        try:
            self._store.keep(self._target.name, self.position, self._letters)
        except StoreUnavailable as error:
            _log.error("a target's position cannot be stored", target=self._target.name, problem=str(error))
            return
        self._unsaved, self._letters = False, []


class Notifier:
    """Threads of all targets.

    targets: the targets.
    source: the events.
    store: positions and dead letters.
    metrics: counters and gauges.
    wall: wall clock, Unix s.
    """

    def __init__(
        self,
        targets: Targets,
        source: Source,
        store: DeliveryStore,
        metrics: Metrics,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.store, self._metrics, self._wall = store, metrics, wall
        self._stop = threading.Event()
        self._cancels: list[Cancel] = []
        self._deliveries: list[tuple[Webhook | Alertmanager, Delivery, threading.Event]] = []
        stored = store.positions()
        for target in targets.all:
            cancel = Cancel()
            delivery = Delivery(
                channel_of(target, targets.external_url, cancel),
                source,
                store,
                stored.get(target.name),
                random=np.random.default_rng(zlib.crc32(target.name.encode())).random,
                count=partial(self._counted, target.name),
            )
            self._cancels.append(cancel)
            self._deliveries.append((target, delivery, threading.Event()))

    def _counted(self, name: str, outcome: str, number: int) -> None:
        self._metrics.notified.labels(name, outcome).inc(number)

    def start(self) -> None:
        """Start the threads."""
        for target, delivery, wake in self._deliveries:
            threading.Thread(
                target=self._run, args=(delivery, wake, target.name), name="gridsec-notify", daemon=True
            ).start()

    def wake(self) -> None:
        """Look for new events; fast, from any thread."""
        for _, delivery, wake in self._deliveries:
            if delivery.waiting:
                wake.set()

    def look(self) -> None:
        """Look for new events and requested dead letters now."""
        for _, delivery, wake in self._deliveries:
            delivery.poll()
            wake.set()

    def close(self) -> None:
        """End all threads and the requests in progress; their messages are sent after the next start."""
        self._stop.set()
        for cancel in self._cancels:
            cancel.end()
        for _, _, wake in self._deliveries:
            wake.set()

    def status(self) -> list[TargetStatus]:
        """State of all targets; without a call to the database."""
        found = []
        for target, delivery, _ in self._deliveries:
            now = delivery.position
            found.append(
                TargetStatus(
                    target.name,
                    target.kind,
                    target.host,
                    now.position,
                    delivery.waiting,
                    now.delivered,
                    now.failing_since,
                    now.attempts,
                    now.problem,
                    delivery.dead,
                )
            )
        return found

    def _run(self, delivery: Delivery, wake: threading.Event, name: str) -> None:
        while not self._stop.is_set():
            now = self._wall()
            try:
                due = delivery.step(now)
            except StoreUnavailable as error:
                _log.warning("notifications cannot be read", target=name, problem=str(error))
                due = now + POLL_S
            except Exception:  # noqa: BLE001 - the target is served again later
                _log.exception("a delivery failed", target=name)
                due = now + DEFECT_S
            self._show(name, delivery)
            wait_s = min(max(0.0, due - self._wall()), DEFECT_S)
            wake.wait(wait_s)
            wake.clear()

    def _show(self, name: str, delivery: Delivery) -> None:
        """Set the gauges of a target."""
        since = delivery.position.failing_since
        self._metrics.notices_waiting.labels(name).set(delivery.waiting)
        self._metrics.dead_letters.labels(name).set(delivery.dead)
        self._metrics.notify_failing.labels(name).set(0.0 if since is None else self._wall() - since)
