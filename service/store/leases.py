"""Leases of shards by worker processes, in PostgreSQL.

A feeder belongs to one of `SHARDS` shards. A shard belongs to at most one worker. Its epoch increases with
every claim; a transaction of an earlier epoch is refused (`Leases.check`).

A worker is absent when it has not renewed for `EXPIRY_S` by the database's clock, or when the session with
its advisory lock has ended: the server ends it with the worker's process. Its shards are free after an
absence of `GRACE_S`, within which a worker reconnects. After its own reconnection a worker leaves them alone
for `RETURN_S`: no shard moves at the end of an outage of the database.

Claims are serialised. Each free shard, the heaviest first, is due to the worker with the least weight; every
worker claims its own. The worker with the largest weight releases shards (`excess`), one with feeders at a
time.
"""

from __future__ import annotations

import hashlib
import math
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import psycopg
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql

from service.store import connect
from service.store.connect import CALL_S, HELD_S, RELOCK_S, NoAnswer, Timed, code_of, share_database
from service.store.schema import OPEN_S, SHARD, WORKER, LeaseLost, StoreUnavailable, migrate

SHARDS: Final = 256
"""Number of shards."""
POLL_S: Final = 0.25
"""Interval at which `claim` is due, s."""
RENEW_S: Final = 2.0
"""Interval at which `renew` is due, s."""
EXPIRY_S: Final = 6.0
"""Time without a renewal after which a worker is absent, s."""
GRACE_S: Final = 0.5
"""Absence after which the shards of a worker are free, s; above `POLL_S`, within which it reconnects."""
RETURN_S: Final = CALL_S + RENEW_S
"""Time after a reconnection in which no shard of an absent worker is free, s.

The server may have been away for longer than `EXPIRY_S`. Another worker may wait for it for `CALL_S`, and
renews at the latest `RENEW_S` later.
"""
SETTLE_S: Final = 2.0
"""Wait for further workers, s, while no live worker has a shard: all workers start at once."""
CLOCK_S: Final = 30.0
"""Difference of the clocks of a process and of the database that is a problem, s."""
WORKER_LOCKS: Final = 0x6773_776B
"""Class of the workers' advisory locks."""
_CLAIM_LOCK: Final = 0x6772_6964_636C_6D00
_FORGET_S: Final = 3600.0
"""Time after which the row of an absent worker without shards is deleted, s."""
_FEEDER: Final = 1000
"""Weight of a feeder of weight 1; a shard without feeders has weight 1."""

_NOW = sa.extract("epoch", sa.func.clock_timestamp())
_SESSIONS = sa.text(
    "SELECT objid FROM pg_locks WHERE locktype = 'advisory' AND classid = :locks AND objsubid = 2 "
    "AND granted AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
).bindparams(locks=WORKER_LOCKS)


def clock_problem(wall: float, cluster: float) -> str | None:
    """Return the problem of a process's clock at a time of the cluster, both Unix s; None without one."""
    ahead = wall - cluster
    if abs(ahead) <= CLOCK_S:
        return None
    return f"clock of the machine: {abs(ahead):.0f} s {'ahead of' if ahead > 0 else 'behind'} the database"


def shard_of(feeder: str) -> int:
    """Return the shard of a feeder: a hash of its name, the same in all processes and versions."""
    return int.from_bytes(hashlib.sha256(feeder.encode()).digest()[:8]) % SHARDS


@dataclass(frozen=True, slots=True, order=True)
class Lease:
    """A shard that a worker holds."""

    shard: int
    epoch: int


@dataclass(frozen=True, slots=True)
class Owner:
    """Owner of a shard."""

    worker: str
    epoch: int
    live: bool  # False from its absence until another worker claims the shard


@dataclass(frozen=True, slots=True)
class _View:
    """State of all workers and shards."""

    names: dict[int, str]  # by number of the worker
    live: frozenset[int]
    youngest_s: float  # time since the newest registration of a live worker, s
    shards: dict[int, tuple[int, int | None]]  # epoch and owner

    def refuse(self, worker: str, database: str) -> None:
        """Refuse the name of a live worker."""
        if any(self.names[number] == worker for number in self.live):
            text = f"{database}: a worker with the name {worker!r} is running"
            raise StoreUnavailable(text, code="worker-exists")


@dataclass(slots=True)
class _Plan:
    """Distribution of the free shards."""

    mine: list[int]
    loads: dict[int, int] = field(default_factory=dict)  # weight of each live worker after all claims


class Leases:
    """Leases of one process. Methods block and are thread-safe; `check`, `held` and `fresh` never wait.

    A process that does not call `register` observes: it holds no shard. As long as any process observes or
    holds leases, a service without workers cannot open the database, and the reverse.

    database: address, PostgreSQL.
    worker: name of this process, unique among the live workers.
    weights: weight of each feeder, such as its time per tick; a feeder without one has weight 0.
    Raises StoreUnavailable if the database is not PostgreSQL (`unsupported`), cannot be opened, is newer than
        this program, or is written by a service without workers (`single-process`).
    """

    def __init__(self, database: str, worker: str, *, weights: Mapping[str, float] | None = None) -> None:
        self.worker = worker
        self._weights = [1] * SHARDS
        self._lock = threading.RLock()
        # Replaced as a whole under `_change`, and read without it.
        self._held: dict[int, Lease] = {}
        self._lost: set[Lease] = set()
        self._change = threading.Lock()
        self._number: int | None = None
        self._renewed = float("-inf")
        self._offset_s = 0.0  # Unix time of the database minus this process's monotonic time, s
        # Beginning of each absence in this process's monotonic time, s, within one session.
        self._absent: dict[int, float] = {}
        self._returned = float("-inf")  # latest reconnection, monotonic s
        self._engine, self.name = _engine(database, self._connected)
        self._wait_s, self._limit_s = connect.LOCK_S, OPEN_S
        self._session: Timed | None = None
        self.weigh(weights or {})
        try:
            with self._transaction() as connection:
                migrate(connection, self.name)
                rows = [{"shard": shard, "epoch": 0} for shard in range(SHARDS)]
                connection.execute(postgresql.insert(SHARD).on_conflict_do_nothing(), rows)
        except BaseException:
            self._engine.dispose()
            raise
        self._opened()

    def __enter__(self) -> Leases:
        """Return the leases."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Release all shards, deregister and close the session; idempotent."""
        with self._lock:
            self._drop(set(self._held.values()))
            number, self._number = self._number, None
            try:
                if number is not None:
                    with self._transaction() as connection:
                        _release(connection, number, None)
                        connection.execute(WORKER.delete().where(WORKER.c.number == number))
            except StoreUnavailable:
                pass  # The end of the session frees the shards.
            finally:
                self._engine.dispose()

    # --------------------------------------------------------------- workers

    def register(self) -> None:
        """Register this process as a worker.

        Raises StoreUnavailable (`worker-exists`) if a live worker has its name.
        """
        with self._lock:
            if self._number is not None:
                return
            began = time.monotonic()
            with self._transaction() as connection:
                _serialise(connection)
                view = _view(connection)
                view.refuse(self.worker, self.name)
                _forget_absent(connection)
                row = {"name": self.worker, "registered": _NOW, "until": _NOW + EXPIRY_S}
                number = connection.scalar(WORKER.insert().values(row).returning(WORKER.c.number))
                connection.execute(_hold(int(number or 0)))
            self._number, self._renewed = number, began

    def weigh(self, feeders: Mapping[str, float]) -> None:
        """Replace the weights of the feeders."""
        weights = [1] * SHARDS
        for feeder, weight in feeders.items():
            weights[shard_of(feeder)] += max(1, round(_FEEDER * weight))
        self._weights = weights

    def live_workers(self) -> list[str]:
        """Return the names of the live workers, sorted."""
        with self._lock, self._transaction() as connection:
            view = _view(connection)
        return sorted(view.names[number] for number in view.live)

    def owners(self) -> dict[int, Owner]:
        """Return the owners of the shards that have one."""
        with self._lock, self._transaction() as connection:
            view = _view(connection)
        return {
            shard: Owner(view.names[owner], epoch, owner in view.live)
            for shard, (epoch, owner) in view.shards.items()
            if owner in view.names
        }

    # ---------------------------------------------------------------- leases

    @property
    def number(self) -> int:
        """Number of this worker; 0 of an observer."""
        return self._number or 0

    def clock(self) -> float:
        """Return the time of the database by the latest call and the monotonic time since, Unix s.

        It is the same in all processes of a cluster, for any clock of their machines.
        """
        return time.monotonic() + self._offset_s

    @property
    def held(self) -> Mapping[int, Lease]:
        """Leases of this process by shard, as of the last call; another object after each change."""
        return self._held

    @property
    def fresh(self) -> bool:
        """True if the last renewal has not expired."""
        return time.monotonic() - self._renewed < EXPIRY_S

    def lease_of(self, feeder: str) -> Lease | None:
        """Return the held lease of a feeder, or None."""
        return self._held.get(shard_of(feeder))

    def claim(self) -> list[Lease]:
        """Claim this worker's part of the free shards; return the new leases."""
        with self._lock:
            with self._transaction() as connection:
                plan = self._plan(_view(connection))
            if not plan.mine or self._number is None:
                return []
            with self._transaction() as connection:
                _serialise(connection)
                plan = self._plan(_view(connection))
                new = _claim(connection, self._number, plan.mine)
            if new:
                with self._change:
                    self._held = {**self._held, **{lease.shard: lease for lease in new}}
            return new

    def renew(self) -> set[Lease]:
        """Renew the leases; return those that other workers have claimed.

        All leases are lost after the registration was deleted by a service without workers.
        """
        with self._lock:
            began, number = time.monotonic(), self.number
            with self._transaction() as connection:
                renewed = connection.execute(
                    WORKER.update().where(WORKER.c.number == number).values(until=_NOW + EXPIRY_S)
                ).rowcount
                owned = sa.select(SHARD.c.shard, SHARD.c.epoch).where(SHARD.c.owner == number)
                found = {Lease(*row) for row in connection.execute(owned)} if renewed else set()
                # The outcome of a claim or a release may have been unknown.
                strays = found - set(self._held.values())
                if strays:
                    _release(connection, number, [lease.shard for lease in strays])
            if renewed:
                self._renewed = began
            self._drop(set(self._held.values()) - found, lost=True)
            with self._change:
                lost, self._lost = self._lost, set()
            return lost

    def excess(self) -> list[int]:
        """Return the shards to release now so that the weights become more even.

        At most one of them has feeders; the next is due after it has been released.
        """
        with self._lock:
            with self._transaction() as connection:
                plan = self._plan(_view(connection))
            me, loads, chosen = self._number, plan.loads, list[int]()
            # One worker at a time: the others see the effect of its releases.
            if me is None or me != max(loads, key=lambda number: (loads[number], number), default=None):
                return []
            left = set(self._held)
            while True:
                least = min(loads, key=lambda number: (loads[number], number))
                gap = loads[me] - loads[least]
                movable = [shard for shard in left if 2 * self._weights[shard] <= gap]
                if not movable:
                    return chosen
                best = max(movable, key=lambda shard: (self._weights[shard], -shard))
                chosen.append(best)
                left.remove(best)
                loads[me] -= self._weights[best]
                loads[least] += self._weights[best]
                if self._weights[best] > 1:
                    return chosen

    def release(self, shards: Iterable[int]) -> None:
        """Release shards for other workers. From the call on, this worker writes none of their feeders."""
        with self._lock:
            gone = set(shards) & set(self._held)
            self._drop({self._held[shard] for shard in gone})
            if gone and self._number is not None:
                with self._transaction() as connection:
                    _release(connection, self._number, gone)

    def check(self, connection: sa.Connection, feeders: Collection[str]) -> None:
        """Lock the shards of feeders against claims until the end of a transaction.

        Raises LeaseLost if this worker does not hold all of them in the database.
        """
        lost = set(feeders) - self.among(connection, feeders)
        if lost:
            raise LeaseLost(self.worker, lost)

    def among(self, connection: sa.Connection, feeders: Collection[str]) -> set[str]:
        """Return those of some feeders that `check` accepts, and lock their shards."""
        held, shards = self._held, sorted({shard_of(feeder) for feeder in feeders})
        query = sa.select(SHARD.c.shard, SHARD.c.epoch).where(
            SHARD.c.shard.in_(shards), SHARD.c.owner == self.number
        )
        rows = connection.execute(query.with_for_update(read=True)) if shards else ()
        found = {Lease(*row) for row in rows}
        self._drop({held[shard] for shard in shards if shard in held} - found, lost=True)
        return {feeder for feeder in feeders if held.get(shard_of(feeder)) in found}

    def _drop(self, leases: Collection[Lease], *, lost: bool = False) -> None:
        """Hold leases no more; `renew` returns the lost ones."""
        with self._change:
            gone = set(leases) & set(self._held.values())
            if not gone:
                return
            self._held = {shard: lease for shard, lease in self._held.items() if lease not in gone}
            if lost:
                self._lost |= gone

    # ------------------------------------------------------------ distribution

    def _plan(self, view: _View) -> _Plan:
        """Distribute the free shards over the live workers: the heaviest first, to the least weight."""
        now = time.monotonic()
        owners = {owner for _, owner in view.shards.values() if owner is not None}
        self._absent = {number: self._absent.get(number, now) for number in owners - view.live}
        absent_s = GRACE_S if now >= self._returned + RETURN_S else math.inf
        gone = {number for number, since in self._absent.items() if now - since >= absent_s}
        plan = _Plan([], dict.fromkeys(sorted(view.live), 0))
        free = []
        for shard, (_, owner) in view.shards.items():
            if owner in view.live:
                plan.loads[owner] += self._weights[shard]
            elif owner is None or owner in gone:
                free.append(shard)
        starting = not owners & view.live and view.youngest_s < SETTLE_S
        if starting or not plan.loads:
            return plan
        for shard in sorted(free, key=lambda shard: (-self._weights[shard], shard)):
            least = min(plan.loads, key=lambda number: (plan.loads[number], number))
            plan.loads[least] += self._weights[shard]
            if least == self._number:
                plan.mine.append(shard)
        return plan

    # ---------------------------------------------------------------- session

    def _connected(self, _dialect: object, _record: object, arguments: Any, options: Any) -> Timed:
        """Connect, and lock the database against services without workers."""
        self._absent = {}
        made = Timed.connect(*arguments, **options)
        try:
            share_database(made, self.name, self._wait_s)
            made.limit_s = self._limit_s
            if self._number is not None:
                made.execute("SELECT pg_advisory_lock_shared(%s, %s)", (WORKER_LOCKS, self._number))
                made.commit()
        except BaseException:
            made.close()
            raise
        now = time.monotonic()
        # A session that ends again and again must not keep this worker from its part.
        if self._session is not None and now >= self._returned + 2.0 * RETURN_S:
            self._returned = now
        self._session = made
        return made

    def _opened(self) -> None:
        """Set the time limits of calls after the database is open."""
        self._wait_s, self._limit_s = RELOCK_S, CALL_S
        if self._session is not None:
            self._session.limit_s = CALL_S

    @contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        """Begin a transaction; a second attempt follows if the server had closed the session before."""
        try:
            with self._begun() as connection:
                yield connection
                connection.commit()
        except (sa.exc.SQLAlchemyError, psycopg.Error, OSError) as error:
            cause = getattr(error, "orig", None) or error
            text = f"cannot use {self.name}: {' '.join(str(cause).split())}"
            raise StoreUnavailable(text, code=code_of(cause) or "write-failed") from error

    def _begun(self) -> sa.Connection:
        connection = self._engine.connect()
        try:
            asked = time.monotonic()
            now = float(connection.scalar(sa.select(_NOW)) or 0.0)
            self._offset_s = now - 0.5 * (asked + time.monotonic())
        except sa.exc.DBAPIError as error:
            connection.close()
            if not error.connection_invalidated or isinstance(error.orig, NoAnswer):
                raise
            return self._engine.connect()
        return connection


def _engine(database: str, connected: Any) -> tuple[sa.Engine, str]:
    try:
        url = sa.make_url(database)
    except sa.exc.ArgumentError as error:
        text = f"{database!r} is not a database address: {error}"
        raise StoreUnavailable(text, code="wrong-address") from error
    name = url.render_as_string(hide_password=True)
    if url.get_backend_name() != "postgresql":
        raise StoreUnavailable(f"{name}: workers need a PostgreSQL database", code="unsupported")
    limits = {
        "client_connection_check_interval": connect.BEAT_S,
        "idle_session_timeout": connect.IDLE_S,
        "idle_in_transaction_session_timeout": HELD_S,
    }
    options = " ".join(f"-c {key}={value * 1e3:.0f}" for key, value in limits.items())
    engine = sa.create_engine(
        url if url.get_driver_name() == "psycopg" else url.set(drivername="postgresql+psycopg"),
        pool_size=1,
        max_overflow=0,
        connect_args={
            "connect_timeout": int(CALL_S),
            "tcp_user_timeout": int(CALL_S * 1e3),
            "options": options,
            "application_name": "gridsec leases",
        },
    )
    sa.event.listen(engine, "do_connect", connected)
    return engine, name


def _serialise(connection: sa.Connection) -> None:
    """Wait for the claims of other workers."""
    connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_CLAIM_LOCK)))


def _hold(number: int) -> sa.Select[Any]:
    """Lock of the worker's session; shared, since the next session may begin before the end of this one."""
    return sa.select(sa.func.pg_advisory_lock_shared(WORKER_LOCKS, number))


def _view(connection: sa.Connection) -> _View:
    w = WORKER.c
    sessions = set(connection.scalars(_SESSIONS))
    rows = connection.execute(sa.select(w.number, w.name, w.until > _NOW, _NOW - w.registered)).all()
    live = {number: float(age) for number, _, renewed, age in rows if renewed and number in sessions}
    shards = connection.execute(sa.select(SHARD.c.shard, SHARD.c.epoch, SHARD.c.owner)).all()
    return _View(
        {number: name for number, name, _, _ in rows},
        frozenset(live),
        min(live.values(), default=float("inf")),
        {shard: (epoch, owner) for shard, epoch, owner in shards},
    )


def _claim(connection: sa.Connection, number: int, shards: Collection[int]) -> list[Lease]:
    """Claim shards. A shard in a transaction of its earlier owner is left for the next call."""
    s = SHARD.c
    idle = sa.select(s.shard).where(s.shard.in_(shards)).with_for_update(key_share=True, skip_locked=True)
    taken = list(connection.scalars(idle))
    change = SHARD.update().where(s.shard.in_(taken)).values(owner=number, epoch=s.epoch + 1)
    return sorted(Lease(*row) for row in connection.execute(change.returning(s.shard, s.epoch)))


def _release(connection: sa.Connection, number: int, shards: Collection[int] | None) -> None:
    """Release shards of a worker; None for all of them."""
    change = SHARD.update().where(SHARD.c.owner == number).values(owner=None)
    connection.execute(change if shards is None else change.where(SHARD.c.shard.in_(shards)))


def _forget_absent(connection: sa.Connection) -> None:
    owned = sa.select(SHARD.c.owner).where(SHARD.c.owner.is_not(None))
    old = WORKER.c.until < _NOW - _FORGET_S
    connection.execute(WORKER.delete().where(old, WORKER.c.number.not_in(owned)))
