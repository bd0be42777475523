"""What goes between zenoh and the rest of the service, in plain Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gridsec.errors import GridsecError


class BusUnavailable(GridsecError):
    """zenoh cannot be used as configured; the message says which endpoint and why."""

    code = "bus-unavailable"


@dataclass(frozen=True, slots=True)
class BusConfig:
    """How to take part in zenoh.

    Attributes
    ----------
    mode
        `router` for the service (it routes between clients and needs no separate router process), `client`
        for meters and tools, `peer` if an existing network asks for it. None: what the file says, or
        `router` without a file.
    listen, connect
        Endpoints such as `tcp/127.0.0.1:7447`.
    file
        A user's own json5 configuration (TLS, users, access control, ...). What it says is kept; mode and
        endpoints given here are put on top.
    max_sessions, accept_pending
        Sessions at most, and those that are being opened; not where a file is given. Each takes a descriptor.
    """

    mode: str | None = None
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    file: Path | None = None
    max_sessions: int = 100_000
    accept_pending: int = 1_000


@dataclass(frozen=True, slots=True)
class Sample:
    """One put, copied out of zenoh: key, bytes, encoding, wall time of its arrival (Unix s).

    Of a payload above the limit only the beginning is kept; `size` is its whole length. Of an absurdly long
    key only the beginning is kept, too.
    """

    key: str
    payload: bytes
    encoding: str
    arrival: float
    size: int


@dataclass(slots=True)
class BusCounts:
    """What went through and what did not: deletions on reading keys, puts and deletes of ours, queries."""

    deleted: int = 0
    published: int = 0
    publish_failed: int = 0
    queries: int = 0
