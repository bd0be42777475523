"""Messages to systemd by a running service; the unit and the container file in `deploy/`."""

from __future__ import annotations

import asyncio
import json
import os
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service import systemd
from service.cli.main import app
from service.settings import Settings, strangers
from tests.service.running import FEEDER, free_port

ROOT = Path(__file__).parents[2]
UNITS = sorted((ROOT / "deploy").glob("*.service"))
CONTAINER = ROOT / "deploy" / "Containerfile"
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("GRIDSEC_")}
# PR_SET_MDWE of Linux 6.3: no writable and executable memory, as MemoryDenyWriteExecute of the unit.
PROGRAM = "import ctypes; ctypes.CDLL(None).prctl(65, 1, 0, 0, 0); from service.cli.main import main; main()"
WATCHDOG_S = 1.0


@pytest.mark.acceptance
def test_a_service_reports_to_systemd(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, (tmp_path / "log").open("w") as log:
        manager.bind(address)
        manager.settimeout(30.0)
        extra = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(int(1e6 * WATCHDOG_S))}
        with subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "serve", "--feeder", FEEDER, "--http", "127.0.0.1:0",
             "--zenoh-listen", f"tcp/127.0.0.1:{free_port()}", "--database", f"sqlite:///{tmp_path}/g.db"],
            stdout=subprocess.DEVNULL, stderr=log, env=ENVIRONMENT | extra,
        ) as child:  # fmt: skip
            try:
                assert [manager.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1"]
                child.send_signal(signal.SIGSTOP)
                time.sleep(0.2)
                while select.select([manager], [], [], 0.0)[0]:
                    manager.recv(100)
                manager.settimeout(2.0 * WATCHDOG_S)
                with pytest.raises(TimeoutError):
                    manager.recv(100)
                child.send_signal(signal.SIGCONT)
                manager.settimeout(30.0)
                assert manager.recv(100) == b"WATCHDOG=1"
                child.terminate()
                while (message := manager.recv(100)) == b"WATCHDOG=1":
                    pass
                assert message == b"STOPPING=1"
                assert child.wait(20.0) == 0
            finally:
                child.kill()


def test_an_unhealthy_service_gives_no_sign_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[str] = []
    monkeypatch.setattr(systemd, "notify", sent.append)
    monkeypatch.setenv("WATCHDOG_USEC", "20000")
    health = [True, False, False, True]

    with pytest.raises(IndexError):
        asyncio.run(systemd.supervise(lambda: health.pop(0)))
    assert sent == ["READY=1", "WATCHDOG=1", "WATCHDOG=1"]


def test_the_watchdog_of_another_process_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "30000000")
    assert systemd.interval_s() == 15.0
    monkeypatch.setenv("WATCHDOG_PID", str(os.getppid()))
    assert systemd.interval_s() is None
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert systemd.interval_s() == 15.0
    for wrong in ("", "0", "soon"):
        monkeypatch.setenv("WATCHDOG_USEC", wrong)
        assert systemd.interval_s() is None


def test_messages_without_systemd_are_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    systemd.notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    systemd.notify("READY=1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0gridsec-test-" + str(os.getpid()))
        monkeypatch.setenv("NOTIFY_SOCKET", f"@gridsec-test-{os.getpid()}")
        systemd.notify("READY=1")
        assert manager.recv(100) == b"READY=1"


# ------------------------------------------------------------------------ unit


units = pytest.mark.parametrize("path", UNITS, ids=lambda path: path.stem)


def unit(path: Path) -> dict[str, dict[str, list[str]]]:
    """Values of each key of a unit, by section."""
    out: dict[str, dict[str, list[str]]] = {}
    for line in path.read_text().splitlines():
        if line.startswith("["):
            section = out.setdefault(line.strip("[]"), {})
        elif line and not line.startswith("#"):
            key, _, value = line.partition("=")
            section.setdefault(key, []).append(value)
    return out


def commands() -> set[str]:
    """Names of the commands of `gridsec`."""
    named = {each.name or getattr(each.callback, "__name__", "") for each in app.registered_commands}
    return named | {each.name or "" for each in app.registered_groups}


def known(variables: list[str]) -> None:
    """Check that the service knows each variable."""
    assert variables
    assert strangers(dict.fromkeys(variables, "")) == {}


@units
def test_the_unit_starts_the_service_with_known_settings(path: Path) -> None:
    service = unit(path)["Service"]
    (start,) = service["ExecStart"]
    program, command, *options = shlex.split(start)
    assert (Path(program).name, command in commands()) == ("gridsec", True)
    fields = {*Settings.model_fields, "name"}
    assert all(each[2:].replace("-", "_") in fields for each in options if each.startswith("--"))
    known([each.partition("=")[0] for each in service["Environment"]])
    assert (service["Type"], service["WatchdogSec"]) == (["notify"], ["30"])
    assert service["CapabilityBoundingSet"] == [""]
    hardened = ("DynamicUser", "NoNewPrivileges", "PrivateTmp", "PrivateDevices", "MemoryDenyWriteExecute")
    assert all(service[name] == ["yes"] for name in hardened)


@units
def test_systemd_verifies_the_unit(path: Path, tmp_path: Path) -> None:
    assert set(unit(path)) == {"Unit", "Service", "Install"}
    analyze = shutil.which("systemd-analyze")
    if analyze is None:  # another system: the parts above are checked all the same
        return
    copy = tmp_path / path.name.replace("@", "@1")
    copy.write_text(path.read_text().replace("/opt/gridsec/bin/gridsec", "/bin/true"))
    done = subprocess.run(
        [analyze, "verify", "--man=no", copy], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, str(copy) in done.stderr) == (0, False), done.stderr
    judged = [analyze, "security", "--offline=true", "--threshold=20", copy]
    done = subprocess.run(judged, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# ------------------------------------------------------------------- container


def instructions() -> list[tuple[str, str]]:
    """Instructions of the container file, continued lines joined."""
    text = re.sub(r"\\\n\s*", " ", CONTAINER.read_text())
    lines = (line for line in text.splitlines() if line and not line.startswith("#"))
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in lines)]


def test_the_container_file_copies_what_exists_and_runs_as_a_user() -> None:
    found = instructions()
    allowed = {"FROM", "WORKDIR", "COPY", "RUN", "ENV", "USER", "VOLUME", "EXPOSE", "STOPSIGNAL",
               "HEALTHCHECK", "ENTRYPOINT", "CMD"}  # fmt: skip
    assert {word for word, _ in found} <= allowed
    copied = [shlex.split(rest) for word, rest in found if word == "COPY"]
    sources = [source for words in copied if not words[0].startswith("--") for source in words[:-1]]
    assert all((ROOT / source).exists() for source in sources)
    assert {"requirements.lock", "gridsec", "feeders", "service", "data"} <= set(sources)
    last = found[max(k for k, (word, _) in enumerate(found) if word == "FROM") :]
    parts = dict(last)
    assert parts["USER"].isdecimal()
    assert int(parts["USER"]) > 0
    variables = [each.partition("=")[0] for each in shlex.split(parts["ENV"])]
    known([name for name in variables if name.startswith("GRIDSEC_")])
    assert json.loads(parts["ENTRYPOINT"]) == ["gridsec"]
    assert json.loads(parts["CMD"])[0] in commands()
    health = json.loads(parts["HEALTHCHECK"].partition("CMD ")[2])
    compile(health[2], "health check", "exec")


def test_the_health_check_needs_an_answer() -> None:
    (line,) = (rest for word, rest in instructions() if word == "HEALTHCHECK")
    _, option, program = json.loads(line.partition("CMD ")[2])
    done = subprocess.run(
        [sys.executable, option, program.replace("8000", str(free_port()))],
        capture_output=True, timeout=30, check=False,
    )  # fmt: skip
    assert done.returncode != 0
