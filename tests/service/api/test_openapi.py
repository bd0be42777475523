"""The OpenAPI description against the service: methods of resources, Schemathesis."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from importlib.util import find_spec
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
    """Schemathesis accepts 422 where valid data may break a rule beyond the schema, and 503 of streams."""
    statuses = json.dumps(["2xx", "401", "403", "404", "409", "422", "5xx"])
    rules = [
        f'include-path = "{path}"\ninclude-method = "{method}"\n'
        f"checks.positive_data_acceptance.expected-statuses = {statuses}\n"
        for method, path in SEMANTIC
    ]
    full = json.dumps(["2xx", "4xx", "503"])
    rules.append(
        f'include-path-regex = "/stream$"\nchecks.not_a_server_error.expected-statuses = {full}\n'
        f"checks.positive_data_acceptance.expected-statuses = {full}\n"
    )
    return "".join(f"[[operations]]\n{rule}" for rule in rules)


def schemathesis(url: str, folder: Path, *arguments: str) -> str:
    """Output of Schemathesis on the description of a service; it must find no failure."""
    if find_spec("schemathesis") is None:
        pytest.skip("schemathesis is not installed; the extra 'dev' has it")
    (folder / "schemathesis.toml").write_text(configuration())
    command = [
        sys.executable, "-m", "schemathesis.cli", "--config-file", "schemathesis.toml", "run",
        f"{url}/api/v1/openapi.json", "--continue-on-failure", "--seed", "1", "--no-color",
        "--request-timeout", "20", *arguments,
    ]  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=1500, check=False, env=environment
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr
    return done.stdout


def generated(output: str) -> int:
    """Number of requests."""
    found = re.search(r"(\d+) generated", output)
    return int(found[1]) if found else 0


def test_schemathesis_finds_no_failure_in_streams(setup: Setup, tmp_path: Path) -> None:
    """The answer of streams when all are in use: a stream itself has no end."""
    setup.attack()
    setup.server.api.state.max_streams = 0
    found = schemathesis(
        setup.server.url, tmp_path, "--phases", "coverage", "--max-examples", "1",
        "--include-path-regex", "/stream$",
    )  # fmt: skip
    assert generated(found) > 20


@pytest.mark.acceptance
@pytest.mark.timeout(1800)
def test_schemathesis_finds_no_failure(tmp_path: Path) -> None:
    """Every operation but the endless streams, as an admin, on a service with alarms and incidents."""
    site = load(FEEDER)
    attacks = random_attacks(site, 5, "scaling", 2, 0.03, t_on=START + 5, t_off=START + 25)
    text, record = create("fuzz", Role.ADMIN, None, time.time(), None)
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as keys:
        keys.add_key(record)
    (tmp_path / "targets.toml").write_text('[[alertmanager]]\nname = "am"\nurl = "https://127.0.0.1:9"\n')
    with service(tmp_path, clock="events", notify=tmp_path / "targets.toml") as live:
        scenario = Scenario(seed=4, start=START, duration_s=20.0, attacks=attacks)
        for _ in play(site, scenario, live.meters, Pace(float("inf"), ahead=3)):
            pass
        output = schemathesis(
            str(live.http.base_url), tmp_path, "--header", f"Authorization: Bearer {text}",
            "--exclude-path-regex", "stream$", "--phases", "examples,coverage,fuzzing", "--max-examples", "4",
        )  # fmt: skip
    assert generated(output) > 100
