"""Connections and descriptors within bounds: few descriptors, real sockets, real zenoh sessions."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from service.api import listener
from service.api.listener import RESERVE, Shares
from service.ingest.queues import BusConfig, BusUnavailable
from service.ingest.zenoh_bus import session
from service.logs import Repeats
from tests.service.running import FEEDER, free_port, service, until

DESCRIPTORS = 256
LOG_LINES = 200
"""Lines of the log that a flood may cost, at most."""


class Served:
    """A service in a process of its own."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, zenoh: str, log: Path) -> None:
        self.process, self.port, self.zenoh, self.log = process, port, zenoh, log

    def answers(self) -> None:
        """New clients get what they ask for, at once."""
        base = f"http://127.0.0.1:{self.port}"
        for path in ("/healthz", "/api/v1/feeders", "/api/v1/alarms", "/"):
            answer = httpx.get(base + path, timeout=20.0)
            assert answer.status_code == 200, (path, answer.text)

    def descriptors(self) -> int:
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def lines(self) -> list[str]:
        return self.log.read_text().splitlines()

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=20.0)


@contextmanager
def served(folder: Path, *, soft: int = 128, hard: int = DESCRIPTORS) -> Iterator[Served]:
    port, zenoh, log = free_port(), f"tcp/127.0.0.1:{free_port()}", folder / "log"
    command = [
        str(Path(sys.executable).with_name("gridsec")),
        *("serve", "--feeder", FEEDER, "--http", f"127.0.0.1:{port}"),
        *("--zenoh-listen", zenoh, "--database", f"sqlite:///{folder}/gridsec.db"),
    ]

    with log.open("wb") as out:
        process = subprocess.Popen(
            command,
            stdout=out,
            stderr=out,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard)),  # noqa: PLW1509
        )
        made = Served(process, port, zenoh, log)
        try:
            until(lambda: _ready(made), "a ready service")
            yield made
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=20) in {0, -signal.SIGTERM, 143}


def _ready(made: Served) -> bool:
    assert made.process.poll() is None, made.log.read_text()
    try:
        return httpx.get(f"http://127.0.0.1:{made.port}/readyz", timeout=5.0).is_success
    except httpx.TransportError:
        return False


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("limits")) as made:
        yield made


@pytest.mark.parametrize(
    "says",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: x\r\nX-",
        b"PUT /api/v1/feeders/x HTTP/1.1\r\nHost: localhost\r\n"
        b"Content-Type: application/json\r\nContent-Length: 1000\r\n\r\n{",
    ],
    ids=["idle", "header", "body"],
)
def test_300_connections_without_a_complete_request_keep_nobody_out(small: Served, says: bytes) -> None:
    before, lines = small.descriptors(), len(small.lines())
    with ExitStack() as stack:
        for _ in range(300):
            one = stack.enter_context(small.connect())
            one.sendall(says)
        small.answers()
        most = Shares.of(DESCRIPTORS).http
        assert small.descriptors() <= before + most + 4
    until(lambda: small.descriptors() <= before + 4, "freed descriptors")
    small.answers()
    assert len(small.lines()) - lines <= LOG_LINES


@pytest.mark.acceptance
def test_an_incomplete_header_has_a_time_out(small: Served) -> None:
    with small.connect() as one:
        begun = time.monotonic()
        one.sendall(b"GET / HTTP/1.1\r\n")
        for k in range(4):
            time.sleep(1.0)
            one.sendall(b"X-%d: 1\r\n" % k)
        with suppress(ConnectionResetError):
            assert one.recv(1) == b""
        assert 8.0 < time.monotonic() - begun < 15.0


def test_zenoh_sessions_leave_descriptors_for_http(small: Served) -> None:
    before = small.descriptors()
    with ExitStack() as stack:
        host, port = small.zenoh.removeprefix("tcp/").rsplit(":", 1)
        for _ in range(DESCRIPTORS):  # half-open ones
            stack.enter_context(socket.create_connection((host, int(port)), timeout=20.0))
        small.answers()
    until(lambda: small.descriptors() <= before + 4, "freed descriptors")
    # A handshake has a time limit of its own, which a busy machine may exceed.
    until(lambda: _opens(small.zenoh), "a session")
    small.answers()


def _opens(zenoh: str) -> bool:
    """True if a client gets a session."""
    try:
        with session(BusConfig("client", connect=(zenoh,))):
            return True
    except BusUnavailable:
        return False


def test_the_soft_limit_becomes_the_hard_limit(small: Served) -> None:
    assert resource.prlimit(small.process.pid, resource.RLIMIT_NOFILE) == (DESCRIPTORS, DESCRIPTORS)


@pytest.mark.acceptance
def test_without_a_descriptor_left_accepting_waits_and_recovers(tmp_path: Path) -> None:
    with served(tmp_path) as small:
        lines = len(small.lines())
        few = small.descriptors() + 2
        resource.prlimit(small.process.pid, resource.RLIMIT_NOFILE, (few, DESCRIPTORS))
        with ExitStack() as stack:
            for _ in range(30):
                stack.enter_context(small.connect())
            ticks = os.sysconf("SC_CLK_TCK")
            begun = _cpu(small)
            time.sleep(3.0)
            assert (_cpu(small) - begun) / ticks < 2.0
        resource.prlimit(small.process.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
        time.sleep(1.0)
        small.answers()
        assert len(small.lines()) - lines <= LOG_LINES


def _cpu(small: Served) -> int:
    fields = Path(f"/proc/{small.process.pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


SESSIONS = """
import sys
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session
opened = []
try:
    for _ in range(int(sys.argv[2])):
        one = session(BusConfig("client", connect=(sys.argv[1],)))
        one.__enter__()
        opened.append(one)
except Exception:
    pass
print(len(opened), flush=True)
sys.stdin.read()
"""
"""A client process that opens zenoh sessions until one is refused. It ends by a signal: a refusal keeps
a thread of zenoh alive."""


@pytest.mark.acceptance
def test_real_zenoh_sessions_are_bounded_and_leave_http_alone(tmp_path: Path) -> None:
    hard = 160
    most = Shares.of(hard).sessions
    with served(tmp_path, soft=64, hard=hard) as small:
        before = small.descriptors()
        command = [sys.executable, "-c", SESSIONS, small.zenoh, str(most + 2)]
        client = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        try:
            assert client.stdout is not None
            assert int(client.stdout.readline()) == most
            small.answers()
            assert small.descriptors() < hard
        finally:
            client.kill()
            client.communicate()
        until(lambda: small.descriptors() <= before + 8, "freed descriptors")
        small.answers()


@pytest.mark.acceptance
def test_a_body_has_a_time_out_and_a_stream_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HEADER_S", "BODY_S", "STALLED_S"):
        monkeypatch.setattr(listener, name, 1.0)
    ahead = 0.0
    with (
        service(tmp_path, clock="wall", wall=lambda: time.time() + ahead) as live,
        live.http.stream("GET", "/api/v1/alarms/stream") as stream,
    ):
        lines = stream.iter_lines()
        assert next(lines).startswith(":")
        base = live.http.base_url
        with socket.create_connection((base.host, base.port or 80), timeout=10.0) as one:
            one.sendall(
                b"PUT /api/v1/feeders/x HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
                b"Content-Length: 1000\r\n\r\n{"
            )
            begun = time.monotonic()
            with suppress(ConnectionResetError):
                assert one.recv(1) == b""
            assert time.monotonic() - begun < 5.0
        time.sleep(2.0)
        # The stream goes on: meters that have not connected are an outage after `silence_s` and `on_delay_s`.
        # Together these are longer than the time limit of the client.
        ahead = 20.0
        assert any("data: " in line for line in lines)


@pytest.mark.parametrize("limit", [128, 256, 1024, 20_000, 1 << 20])
def test_shares_leave_a_reserve(limit: int) -> None:
    shares = Shares.of(limit)
    assert shares.http + shares.sessions + shares.pending <= max(limit - RESERVE, 24)
    assert min(shares.http, shares.sessions, shares.streams) >= 1


def test_repeated_records_are_counted() -> None:
    told: list[tuple[str, int]] = []
    now = [0.0]
    repeats = Repeats(lambda kind, count: told.append((kind[1], count)), lambda: now[0])
    written = sum(repeats.admit(("error", "a", "")) for _ in range(10_000))
    assert written == 5
    assert repeats.admit(("error", "b", ""))
    now[0] = 11.0
    assert repeats.admit(("error", "a", ""))
    assert told == [("a", 9_995)]
    for k in range(1000):
        repeats.admit(("error", str(k), ""))
    repeats.flush()
    assert told == [("a", 9_995)]
