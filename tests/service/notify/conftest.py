"""Alertmanager of Debian on loopback, with a receiver of its own notifications."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator

import httpx
import pytest

from tests.service.receiver import Receiver, receiving
from tests.service.running import free_port, until

CONFIGURATION = """
route: {receiver: page, group_by: [feeder], group_wait: 0s, group_interval: 1s, repeat_interval: 1h}
receivers:
- name: page
  webhook_configs: [{url: "URL", send_resolved: true}]
"""


@pytest.fixture(scope="module")
def page() -> Iterator[Receiver]:
    """Receiver of Alertmanager's own notifications."""
    with receiving() as made:
        yield made


@pytest.fixture(scope="module")
def manager(tmp_path_factory: pytest.TempPathFactory, page: Receiver) -> Iterator[str]:
    program = shutil.which("prometheus-alertmanager") or shutil.which("alertmanager")
    if program is None:
        pytest.skip("Alertmanager is not installed")
    folder = tmp_path_factory.mktemp("alertmanager")
    (folder / "config.yml").write_text(CONFIGURATION.replace("URL", page.url))
    url = f"http://127.0.0.1:{free_port()}"
    files = [f"--config.file={folder}/config.yml", f"--storage.path={folder}/data", "--log.level=error"]
    command = [program, *files, f"--web.listen-address={url[7:]}", "--cluster.listen-address="]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            until(lambda: ready(url), "Alertmanager")
            yield url
        finally:
            process.terminate()


def ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/-/ready").status_code == 200
    except httpx.TransportError:
        return False
