"""Local workers of a front: started again, and ended with it; here processes that only wait."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cluster import run as module
from service.cluster.run import Supervisor, check_cluster, worker_environment
from service.settings import Settings, SettingsInvalid, settings
from tests.codes import refused
from tests.service.running import until

WAITING = (sys.executable, "-S", "-c", "import sys; sys.stdin.read()")
DEAF = (
    sys.executable,
    "-S",
    "-c",
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)",
)


async def reached(condition: Callable[[], bool]) -> None:
    await asyncio.to_thread(until, condition, "the number of processes", 10.0)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("command", [WAITING, DEAF], ids=["waiting", "deaf"])
def test_workers_are_started_again_and_end_with_the_front(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AGAIN_S", 0.05)
    monkeypatch.setattr(module, "END_S", 0.3)

    async def run() -> None:
        made = Supervisor(2, dict(os.environ), command)
        task = asyncio.create_task(made.run())
        await reached(lambda: len(made.pids) == 2)
        first, second = made.pids
        os.kill(first, signal.SIGKILL)
        await reached(lambda: len(made.pids) == 2 and first not in made.pids)
        assert second in made.pids
        pids = made.pids
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert [alive(pid) for pid in pids] == [False, False]

    asyncio.run(run())


def test_workers_have_the_settings_of_their_front(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRIDSEC_HTTP", "127.0.0.1:9000")
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/notify")
    chosen = {
        "database": "postgresql+psycopg://gridsec@/grid",
        "zenoh_listen": ("tcp/127.0.0.1:7448",),
        "prefix": "grid",
        "max_skew_s": 7.5,
        "workers": 3,
    }
    environment = worker_environment(settings(chosen))
    assert "NOTIFY_SOCKET" not in environment
    for name in [one for one in os.environ if one.startswith("GRIDSEC_")]:
        monkeypatch.delenv(name)
    for name, value in environment.items():
        if name.startswith("GRIDSEC_"):
            monkeypatch.setenv(name, value)
    found = Settings()
    assert (found.database, found.prefix, found.max_skew_s) == (chosen["database"], "grid", 7.5)
    assert (found.zenoh_mode, found.zenoh_connect) == ("client", ("tcp/127.0.0.1:7448",))
    assert (found.http, found.workers, found.zenoh_listen) == ("127.0.0.1:8000", None, ())


CONFIGURATIONS = {
    "router": ('{mode: "router", listen: {endpoints: ["tls/127.0.0.1:7447"]}}', False),
    "default": ('{mode: "router"}', False),
    "client": ('{mode: "client", connect: {endpoints: ["tls/127.0.0.1:7447"]}}', True),
    "peer": ('{mode: "peer"}', True),
}


@pytest.mark.parametrize(("text", "valid"), CONFIGURATIONS.values(), ids=CONFIGURATIONS)
@pytest.mark.parametrize("workers", [0, 2])
def test_local_workers_do_not_listen_on_the_endpoints_of_their_front(
    tmp_path: Path, text: str, valid: bool, workers: int
) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(text)
    chosen = settings(
        {"database": "postgresql+psycopg://gridsec@/grid", "zenoh_config": file, "workers": workers}
    )
    if valid or not workers:
        check_cluster(chosen)
        return
    with refused(SettingsInvalid, "shared-endpoint"):
        check_cluster(chosen)
