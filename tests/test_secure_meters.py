"""The tutorial docs/tutorials/secure-meters.md, block by block, with a real router, service and sessions."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from service.cli.main import main
from service.settings import exposed as found_exposed
from tests.service.running import free_port, until

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorials" / "secure-meters.md"
BLOCK = re.compile(r"```(sh|python)\n(.*?)```", re.DOTALL)


class Steps:
    """Runs the blocks of the page in a folder; keeps the output of each shell block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.http = f"127.0.0.1:{free_port()}"
        self.said: list[str] = []
        self.background: list[subprocess.Popen[bytes]] = []
        self.ports = {"127.0.0.1:7447": f"127.0.0.1:{free_port()}", "127.0.0.1:8000": self.http}
        places = {"PYTHONPATH": str(ROOT), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        self.environment = os.environ | places | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

    def run(self, language: str, code: str) -> None:
        for written, used in self.ports.items():
            code = code.replace(written, used)
        if language == "python":
            name = code.split("\n", 1)[0].removeprefix("# ")
            (self.folder / name).write_text(code)
        elif code.endswith("&\n"):
            self._start(code.removesuffix("&\n"))
        else:
            done = subprocess.run(
                ["bash", "-e", "-c", code],
                cwd=self.folder,
                env=self.environment,
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            assert done.returncode == 0, done.stderr
            self.said.append(done.stdout)

    def _start(self, command: str) -> None:
        log = self.folder / f"{len(self.background)}.log"
        with log.open("wb") as out:
            started = subprocess.Popen(
                ["bash", "-c", f"exec {command}"],
                cwd=self.folder,
                env=self.environment,
                stdout=out,
                stderr=out,
            )
        self.background.append(started)
        if "serve" in command:
            until(lambda: f"http://{self.http}" in log.read_text() or started.poll() is not None, "the start")
            assert started.poll() is None, log.read_text()
            until(lambda: httpx.get(f"http://{self.http}/readyz").status_code == 200, "a design")
        else:
            end = self.ports["127.0.0.1:7447"].rpartition(":")[2]
            until(lambda: f":{int(end):04X} " in Path("/proc/net/tcp").read_text(), "the router")


@contextmanager
def steps(folder: Path) -> Iterator[Steps]:
    running = Steps(folder)
    try:
        yield running
    finally:
        for process in reversed(running.background):
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=20)


@pytest.mark.acceptance
def test_every_step_of_the_tutorial(tmp_path: Path) -> None:
    found = BLOCK.findall(PAGE.read_text())
    assert len(found) == 12
    with steps(tmp_path) as running:
        for language, code in found:
            running.run(language, code)
        counted = httpx.get(f"http://{running.http}/metrics").text
    listed, _, _, state, bad, opened = running.said
    assert listed.count("365.0") == 4
    meters = {meter["meter"]: meter["seen"] for meter in json.loads(state)["meters"]}
    assert len(meters) == 13
    assert all(meters.values())
    reasons = [one["reason"] for one in json.loads(bad)["readings"]]
    assert sorted(reason.partition(":")[0] for reason in reasons) == ["replayed", "signature", "signature"]
    (incident,) = json.loads(opened)["incidents"]
    assert (incident["kind"], incident["severity"], incident["state"], incident["meters"]) == (
        "identity-mismatch", "major", "raised", ["m13"],
    )  # fmt: skip
    assert re.search(r'gridsec_bad_readings_total\{[^}]*reason="signature"\} 2\.0', counted)


@pytest.mark.parametrize(
    ("options", "exposed"),
    [
        (("--zenoh-listen", "tcp/0.0.0.0:7447"), "tcp/0.0.0.0:7447"),
        (("--zenoh-connect", "udp/grid.example:7447"), "udp/grid.example:7447"),
        (("--zenoh-config", "bare.json5"), "tcp/[::]:7447"),
        (("--zenoh-config", "bare.json5", "--zenoh-mode", "client"), "udp/224.0.0.224:7446"),
    ],
    ids=["listen", "connect", "file", "scouting"],
)
def test_plaintext_beyond_loopback_is_refused(
    options: tuple[str, ...],
    exposed: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare.json5").write_text('{ mode: "router" }')
    monkeypatch.setattr(sys, "argv", ["gridsec", "serve", *options])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    error = " ".join(capsys.readouterr().err.split())
    assert exposed in error
    assert "--plaintext-network" in error


def test_the_permission_allows_plaintext(monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("--feeder", "nowhere", "--zenoh-listen", "tcp/0.0.0.0:7447")
    monkeypatch.setattr(sys, "argv", ["gridsec", "serve", *options])
    monkeypatch.setenv("GRIDSEC_PLAINTEXT_NETWORK", "1")
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 3  # the feeder does not exist


def test_endpoints_on_loopback_or_with_tls_are_not_exposed() -> None:
    inside = ("tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:1#so_rcvbuf=1", "unixsock-stream//tmp/z")
    assert found_exposed((*inside, "tls/0.0.0.0:7447", "quic/grid.example:7447", "ws/10.0.0.1:1")) == (
        "ws/10.0.0.1:1",
    )
