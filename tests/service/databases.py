"""Databases for tests: SQLite in a folder, and a PostgreSQL of our own where it is installed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest

NOBODY = 65534


def find_postgresql() -> Path | None:
    on_path = shutil.which("initdb")
    folders = [Path(on_path).resolve().parent] if on_path else []
    folders += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    wanted = ("initdb", "pg_ctl", "postgres")
    return next((folder for folder in folders if all((folder / name).exists() for name in wanted)), None)


def installed_postgresql() -> Path:
    """Folder of PostgreSQL's programs; a program ends without them."""
    found = find_postgresql()
    if found is None:
        raise SystemExit("PostgreSQL's initdb, pg_ctl and postgres are not installed")
    return found


class Cluster:
    """A private PostgreSQL that listens on a socket in a folder of its own and on no network."""

    def __init__(self, binaries: Path, folder: Path) -> None:
        self.binaries, self.folder, self.data = binaries, folder, folder / "data"
        # PostgreSQL refuses to run as root; the folder then belongs to nobody.
        self.prefix = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
        if os.geteuid() == 0:
            os.chown(folder, NOBODY, NOBODY)
        else:
            self.prefix = []
        self.run("initdb", "-D", self.data, "-A", "trust", "-U", "gridsec", "-E", "UTF8", "--no-sync")

    def run(self, name: str, *arguments: object) -> None:
        command = [*self.prefix, str(self.binaries / name), *map(str, arguments)]
        done = subprocess.run(
            command, cwd=self.folder, capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def start(self) -> None:
        options = f"-c listen_addresses='' -c unix_socket_directories='{self.folder}' -c fsync=off"
        self.run("pg_ctl", "-D", self.data, "-w", "-l", self.folder / "log", "-o", options, "start")

    def stop(self) -> None:
        self.run("pg_ctl", "-D", self.data, "-w", "-m", "immediate", "stop")

    def processes(self) -> list[int]:
        """Return the ids of the server's processes, the postmaster first."""
        postmaster = int((self.data / "postmaster.pid").read_text().split()[0])
        children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text()
        return [postmaster, *map(int, children.split())]

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop all processes of the server with SIGSTOP until the block ends."""
        stopped = self.processes()
        try:
            for pid in stopped:
                os.kill(pid, signal.SIGSTOP)
            yield
        finally:
            for pid in stopped:
                os.kill(pid, signal.SIGCONT)

    def database(self) -> str:
        name = f"t{uuid.uuid4().hex}"
        with psycopg.connect(f"host={self.folder} user=gridsec dbname=postgres", autocommit=True) as admin:
            admin.execute(f'CREATE DATABASE "{name}"')
        return f"postgresql+psycopg://gridsec@/{name}?host={self.folder}"


both = pytest.mark.parametrize("family", ["sqlite", pytest.param("postgresql", marks=pytest.mark.postgresql)])


@contextmanager
def running(binaries: Path, kind: type[Cluster] = Cluster) -> Iterator[Cluster]:
    """A PostgreSQL in a temporary folder, stopped with the block."""
    with tempfile.TemporaryDirectory(prefix="gridsec-pg-", dir="/tmp") as folder:
        made = kind(binaries, Path(folder))
        made.start()
        try:
            yield made
        finally:
            made.stop()
