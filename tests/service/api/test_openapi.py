"""The OpenAPI description against the service: methods of resources, Schemathesis where it is installed."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from feeders.model.site import load
from feeders.simulation.scenario import Scenario, random_attacks
from service.access.identity import Role
from service.access.keys import create
from service.cli.simulate import Pace, play
from service.store.access import AccessStore
from tests.service.asking import Setup, is_problem
from tests.service.running import FEEDER, service

METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
START = 1_795_212_000.0
SEMANTIC = (
    ("PUT", "/api/v1/feeders/{feeder}"),
    ("POST", "/api/v1/feeders/{feeder}/commissioning"),
    ("POST", "/api/v1/planned-work"),
    ("POST", "/api/v1/shelves"),
)
"""Operations with rules that JSON Schema cannot state: a connected tree, names of meters, times after now."""


def examples(path: str) -> str:
    """Path of a template with values of the right form."""
    names = {"feeder": "absent", "meter": "m1"}
    return re.sub(r"\{(\w+)\}", lambda found: names.get(found[1], "0" * 26), path)


def test_every_resource_states_its_methods(setup: Setup) -> None:
    """Another method gets 405 with the described ones in `Allow`, also where the page is mounted."""
    paths = setup.get("/openapi.json").json()["paths"]
    assert len(paths) > 30
    for path, operations in paths.items():
        described = {name.upper() for name in operations}
        allowed = described | ({"HEAD"} if "GET" in described else set())
        for method in METHODS:
            if method in allowed:
                continue
            json_only = {"Content-Type": "application/json"}
            answer = setup.http.request(method, examples(path), headers=json_only)
            if method != "HEAD":
                is_problem(answer, 405)
            assert (answer.status_code, set(answer.headers["allow"].split(", "))) == (405, allowed), path
    is_problem(setup.http.request("POST", "/absent"), 405)
    is_problem(setup.http.get("/api/v1/absent"), 404)


def configuration() -> str:
    """Schemathesis accepts 422 where valid data may break a rule beyond the schema."""
    statuses = json.dumps(["2xx", "401", "403", "404", "409", "422", "5xx"])
    return "".join(
        f'[[operations]]\ninclude-path = "{path}"\ninclude-method = "{method}"\n'
        f"checks.positive_data_acceptance.expected-statuses = {statuses}\n"
        for method, path in SEMANTIC
    )


@pytest.mark.acceptance
@pytest.mark.timeout(1800)
def test_schemathesis_finds_no_failure(tmp_path: Path) -> None:
    """Every operation but the endless streams, as an admin, on a service with alarms and incidents."""
    program = shutil.which("schemathesis")
    if program is None:
        pytest.skip("schemathesis is not installed")
    site = load(FEEDER)
    attacks = random_attacks(site, 5, "scaling", 2, 0.03, t_on=START + 5, t_off=START + 25)
    text, record = create("fuzz", Role.ADMIN, None, time.time(), None)
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as keys:
        keys.add_key(record)
    (tmp_path / "schemathesis.toml").write_text(configuration())
    (tmp_path / "targets.toml").write_text('[[alertmanager]]\nname = "am"\nurl = "https://127.0.0.1:9"\n')
    with service(tmp_path, clock="events", notify=tmp_path / "targets.toml") as live:
        scenario = Scenario(seed=4, start=START, duration_s=20.0, attacks=attacks)
        for _ in play(site, scenario, live.meters, Pace(float("inf"), ahead=3)):
            pass
        command = [
            program, "--config-file", "schemathesis.toml", "run", f"{live.http.base_url}/api/v1/openapi.json",
            "--header", f"Authorization: Bearer {text}", "--exclude-path-regex", "stream$",
            "--phases", "examples,coverage,fuzzing", "--max-examples", "4", "--continue-on-failure",
            "--request-timeout", "20", "--seed", "1", "--no-color",
        ]  # fmt: skip
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=1500, check=False, env=environment
        )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr
    assert re.search(r"[1-9][0-9]{2,} generated", done.stdout), done.stdout[-3000:]
