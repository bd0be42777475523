"""OIDC tokens at a running service, and the refusal of an address beyond loopback without authentication."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.access.identity import Role
from service.access.keys import create
from service.store.access import AccessStore
from tests.service.asking import is_problem
from tests.service.issuer import Issuer, issuing
from tests.service.running import FEEDER, InProcess, service

OTHER = "cigre-lv"
ALARM = "0" * 26


@pytest.fixture(scope="module")
def issuer() -> Iterator[Issuer]:
    with issuing() as made:
        yield made


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def statuses(live: InProcess, token: str) -> tuple[int, int, int]:
    """Status of a read, of an action of operators, and of one of engineers."""
    head = bearer(token)
    read = live.http.get("/api/v1/feeders", headers=head).status_code
    act = live.http.post(f"/api/v1/alarms/{ALARM}/ack", json={}, headers=head).status_code
    change = live.http.put(f"/api/v1/feeders/{FEEDER}", json={}, headers=head).status_code
    return read, act, change


def test_tokens_have_roles_feeders_and_names(issuer: Issuer, tmp_path: Path) -> None:
    with service(tmp_path, (FEEDER, OTHER), oidc_issuer=issuer.url) as live:
        assert live.http.get("/api/v1/feeders").status_code == 401
        for wrong in ("no.token.text", issuer.token(aud="other"), issuer.token(exp=time.time() - 3600.0)):
            refused = live.http.get("/api/v1/feeders", headers=bearer(wrong))
            is_problem(refused, 401)
            assert refused.headers["www-authenticate"] == "Bearer"
        assert statuses(live, issuer.token(gridsec_role="viewer")) == (200, 403, 403)
        assert statuses(live, issuer.token(preferred_username="Ada")) == (200, 404, 403)
        assert statuses(live, issuer.token(kid="e", gridsec_role="engineer")) == (200, 404, 422)
        some = bearer(issuer.token(gridsec_feeders=[OTHER]))
        shown = live.http.get("/api/v1/feeders", headers=some).json()["feeders"]
        assert [each["name"] for each in shown] == [OTHER]
        is_problem(live.http.get(f"/api/v1/feeders/{FEEDER}", headers=some), 403)
        assert live.http.get(f"/api/v1/feeders/{OTHER}", headers=some).status_code == 200
        admin = bearer(issuer.token(gridsec_role="admin"))
        entries = live.http.get("/api/v1/audit", headers=admin).json()["entries"]
    names = {(each["identity"], each["credential"], each["action"]) for each in entries}
    assert ("Ada", f"token {issuer.url}", "POST /api/v1/alarms/{alarm_id}/ack") in names
    assert ("Ada", f"token {issuer.url}", "refused: PUT /api/v1/feeders/{feeder}") in names
    assert all(each["t_utc"].endswith("Z") for each in entries)


def test_without_the_issuer_unknown_keys_get_503_and_api_keys_pass(tmp_path: Path) -> None:
    text, record = create("Bob", Role.VIEWER, None, time.time(), None)
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        store.add_key(record)
    with issuing() as early:
        known, unknown = early.token(), early.token(kid="new", key=early.rsa, alg="RS256")
        late = early.url
    with service(tmp_path, oidc_issuer=late) as live:
        for token in (known, unknown):
            away = live.http.get("/api/v1/feeders", headers=bearer(token))
            is_problem(away, 503)
            assert away.headers["retry-after"] == "5"
        assert live.http.get("/api/v1/feeders", headers=bearer(text)).status_code == 200
        assert live.http.get("/healthz").status_code == 200


@pytest.mark.acceptance
def test_no_service_without_authentication_beyond_loopback(tmp_path: Path) -> None:
    """A real process ends before it listens."""
    command = [
        sys.executable, "-c", "from service.cli.main import main; main()", "serve", "--http", "0.0.0.0:0",
        "--zenoh-listen", "tcp/127.0.0.1:0", "--database", f"sqlite:///{tmp_path / 'g.db'}",
    ]  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GRIDSEC_")}
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=environment)
    assert (done.returncode, done.stdout) == (2, "")
    assert "no authentication is set up" in " ".join(done.stderr.replace("│", " ").split())
