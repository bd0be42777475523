"""Authentication and roles of REST: every route against every role on a real service, sessions, audit."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner, Result

from service.access.audit import broken
from service.access.identity import (
    POLICY,
    PUBLIC,
    WHOLE_FLEET,
    Identity,
    NotAuthenticated,
    Role,
    TooManyFailures,
)
from service.access.keys import create
from service.api.access import (
    COOKIE,
    COUNTED_S,
    FAILURES,
    FRESH_S,
    LOGGED,
    REFUSALS,
    Authenticator,
    subnet_of,
)
from service.api.routes import create_api
from service.cli.main import app
from service.settings import SettingsInvalid, is_loopback, settings
from service.store.access import SESSION_S, AccessStore
from service.store.schema import StoreUnavailable
from tests.codes import refused
from tests.service.asking import is_problem
from tests.service.running import FEEDER, InProcess, service

PAGE = Path(__file__).parents[3] / "docs" / "access.md"
OTHER = "cigre-lv"
ALARM = "0" * 26
IDS = ("{alarm_id}", "{incident_id}", "{shelf_id}", "{work_id}")
EXAMPLES = {"{feeder}": FEEDER, "{meter}": "m01"} | dict.fromkeys(IDS, ALARM)
BODIES: dict[str, Any] = {
    "POST /api/v1/alarms/ack": {"alarms": [ALARM]},
    "POST /api/v1/alarms/{alarm_id}/unack": {},
    "POST /api/v1/alarms/{alarm_id}/comment": {"comment": "seen"},
    "POST /api/v1/incidents/{incident_id}/ack": {},
    "POST /api/v1/incidents/{incident_id}/unack": {},
    "POST /api/v1/incidents/{incident_id}/comment": {"comment": "seen"},
    "POST /api/v1/incidents/{incident_id}/assign": {"to": "Bob"},
    "POST /api/v1/shelves": {"alarm": ALARM, "duration_s": 60.0, "reason": "known"},
    "POST /api/v1/shelves/{shelf_id}/end": {},
    "POST /api/v1/planned-work": {"feeder": FEEDER, "t_until": 0.0, "reason": "cable"},
    "POST /api/v1/planned-work/{work_id}/end": {},
    "POST /api/v1/alarms/{alarm_id}/ack": {"comment": "seen"},
    "POST /api/v1/feeders/{feeder}/commissioning": {"reason": "replaced", "meters": ["absent"]},
    "PUT /api/v1/feeders/{feeder}": {},
}
REFUSED = {401, 429}
"""Status without a valid credential: the latter beyond the limit of failures."""
STREAMS = tuple(route for route in POLICY if route.endswith("/stream"))


def key(
    folder: Path, role: Role, *, feeders: frozenset[str] | None = None, expires: float | None = None
) -> str:
    text, record = create(f"{role} of {sorted(feeders or ())}", role, feeders, time.time(), expires)
    with AccessStore(f"sqlite:///{folder / 'gridsec.db'}") as store:
        store.add_key(record)
    return text


def bearer(text: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {text}"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("access")


@pytest.fixture(scope="module")
def keys(folder: Path) -> dict[str, str]:
    out = {str(role): key(folder, role) for role in Role}
    out["north"] = key(folder, Role.ENGINEER, feeders=frozenset({OTHER}))
    out["expired"] = key(folder, Role.ADMIN, expires=time.time() - 1.0)
    return out


@pytest.fixture(scope="module")
def running(folder: Path, keys: dict[str, str]) -> Iterator[InProcess]:
    assert keys
    with service(folder, (FEEDER, OTHER)) as made:
        yield made


def ask(running: InProcess, route: str, headers: dict[str, str]) -> int:
    """Status of a request; of a stream that of its beginning."""
    method, path = route.split(" ")
    for name, value in EXAMPLES.items():
        path = path.replace(name, value)
    if route in STREAMS:
        with running.http.stream(method, path, headers=headers) as response:
            return response.status_code
    body = BODIES.get(route)
    content = None if body is None else json.dumps(body).encode()
    typed = headers if body is None else {**headers, "Content-Type": "application/json"}
    return running.http.request(method, path, headers=typed, content=content).status_code


def test_the_policy_is_that_of_all_routes(running: InProcess) -> None:
    """Nothing but the files of the page is outside; the description of the interface is public."""
    made = create_api(_Nothing())
    routers = [
        router for each in made.routes if (router := getattr(each, "original_router", None)) is not None
    ]
    routes = {
        f"{method} {route.path}" for router in routers for route in router.routes for method in route.methods
    }
    assert routes == set(POLICY)
    assert running.http.get("/api/v1/openapi.json").status_code == 200
    assert running.http.get("/").status_code == 200


def test_the_page_lists_the_policy() -> None:
    rows = [line.split("|")[1:4] for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    shown = {name.strip().strip("`"): (least.strip(), scope.strip()) for name, least, scope in rows}
    whole = {route: "all feeders" if route in WHOLE_FLEET else "" for route in POLICY}
    wanted = {route: (str(least or "no credential"), whole[route]) for route, least in POLICY.items()}
    assert shown == {route: row for route, row in wanted.items() if not route.startswith("HEAD")}


class _Nothing:
    store = None


@pytest.mark.parametrize("route", [route for route, least in POLICY.items() if least is not PUBLIC])
def test_every_route_against_every_role(running: InProcess, keys: dict[str, str], route: str) -> None:
    least = POLICY[route]
    assert least is not None
    assert ask(running, route, {}) == 401
    assert ask(running, route, bearer(keys["expired"])) in REFUSED
    assert ask(running, route, bearer(keys["viewer"][:-1] + "?")) in REFUSED
    for role in Role:
        if route.startswith("DELETE") and role.includes(least):
            continue  # the feeder is needed by the other routes
        status = ask(running, route, bearer(keys[role]))
        assert (status == 403) == (not role.includes(least)), (role, status)
        assert status not in REFUSED
    outside = ask(running, route, bearer(keys["north"]))
    if "{feeder}" in route or route in WHOLE_FLEET or route == "POST /api/v1/planned-work":
        assert outside == 403
    elif any(name in route for name in IDS) or route in BODIES:
        assert outside == 404
    else:
        assert outside == 200


def test_public_routes_need_no_credential(running: InProcess) -> None:
    for route in ("GET /healthz", "HEAD /healthz", "GET /readyz"):
        assert ask(running, route, {}) in {200, 503}
    assert ask(running, "GET /api/v1/session", {}) == 401


def test_a_restricted_identity_sees_its_feeders_only(running: InProcess, keys: dict[str, str]) -> None:
    seen = running.http.get("/api/v1/feeders", headers=bearer(keys["north"])).json()["feeders"]
    assert [feeder["name"] for feeder in seen] == [OTHER]
    everything = running.http.get("/api/v1/feeders", headers=bearer(keys["viewer"])).json()["feeders"]
    assert {feeder["name"] for feeder in everything} == {FEEDER, OTHER}
    denied = running.http.get("/api/v1/alarms", params={"feeder": FEEDER}, headers=bearer(keys["north"]))
    is_problem(denied, 403)
    for identity in ("north", "viewer"):
        answer = running.http.get("/api/v1/alarms", headers=bearer(keys[identity]))
        assert answer.status_code == 200
        same = {**bearer(keys["viewer"]), "If-None-Match": answer.headers["etag"]}
        status = running.http.get("/api/v1/alarms", headers=same).status_code
        assert status == (304 if identity == "viewer" else 200)


def test_names_come_from_the_credential(running: InProcess, keys: dict[str, str]) -> None:
    path, head = f"/api/v1/alarms/{ALARM}/ack", bearer(keys["operator"])
    other = running.http.post(path, json={"who": "Eve"}, headers=head)
    assert "must be left out" in is_problem(other, 403)["detail"]
    assert running.http.post(path, json={"who": "operator of []"}, headers=head).status_code == 404
    assert running.http.post(path, json={}, headers=head).status_code == 404


def test_the_page_exchanges_a_key_for_a_cookie(running: InProcess, keys: dict[str, str]) -> None:
    with httpx.Client(base_url=running.http.base_url) as browser:
        wrong = browser.post("/api/v1/session", json={"key": "gridsec_0_0"})
        assert wrong.status_code in REFUSED
        answer = browser.post("/api/v1/session", json={"key": keys["operator"]})
        assert answer.json()["role"] == "operator"
        assert answer.json()["expires"] == pytest.approx(time.time() + SESSION_S, abs=60.0)
        cookie = answer.headers["set-cookie"].lower()
        assert cookie.startswith(f"{COOKIE}=")
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert keys["operator"] not in cookie
        assert browser.get("/api/v1/session").json()["name"] == "operator of []"
        assert browser.get("/api/v1/feeders").status_code == 200
        assert browser.put(f"/api/v1/feeders/{FEEDER}", json={}).status_code == 403
        kept = dict(browser.cookies)
        assert browser.delete("/api/v1/session").status_code == 204
        assert browser.get("/api/v1/feeders").status_code == 401
        # The cookie itself is worth nothing any more.
        stolen = {"Cookie": f"{COOKIE}={kept[COOKIE]}"}
        assert httpx.get(f"{running.http.base_url}/api/v1/feeders", headers=stolen).status_code == 401


def test_a_revoked_key_ends_its_sessions(running: InProcess, folder: Path) -> None:
    text = key(folder, Role.VIEWER)
    with httpx.Client(base_url=running.http.base_url) as browser:
        assert browser.post("/api/v1/session", json={"key": text}).status_code == 200
        assert browser.get("/api/v1/feeders").status_code == 200
        with AccessStore(f"sqlite:///{folder / 'gridsec.db'}") as store:
            assert store.revoke(text.split("_")[1], time.time())
        time.sleep(FRESH_S + 0.2)
        assert browser.get("/api/v1/feeders").status_code == 401
        assert browser.get("/api/v1/feeders", headers=bearer(text)).status_code in REFUSED


def test_invalid_credentials_are_limited_and_valid_ones_pass(
    running: InProcess, keys: dict[str, str]
) -> None:
    statuses = [
        running.http.get("/api/v1/feeders", headers=bearer(f"gridsec_{k}")).status_code
        for k in range(2 * FAILURES)
    ]
    assert set(statuses) <= {401, 429}
    assert statuses[-1] == 429
    limited = running.http.get("/api/v1/feeders", headers=bearer("gridsec_x"))
    is_problem(limited, 429)
    assert limited.headers["retry-after"] == "60"
    assert running.http.get("/api/v1/feeders", headers=bearer(keys["viewer"])).status_code == 200


def test_every_change_is_in_the_audit_log_before_it_is_made(
    running: InProcess, keys: dict[str, str], folder: Path
) -> None:
    head = bearer(keys["operator"])
    running.http.post(f"/api/v1/alarms/{ALARM}/ack", json={"comment": "on my way"}, headers=head)
    running.http.put(f"/api/v1/feeders/{FEEDER}", json={}, headers=head)
    with AccessStore(f"sqlite:///{folder / 'gridsec.db'}") as store:
        entries = store.audit()
    assert broken(entries) is None
    acknowledged, refused_ = entries[-2:]
    assert acknowledged.action == "POST /api/v1/alarms/{alarm_id}/ack"
    assert acknowledged.identity == "operator of []"
    assert acknowledged.credential.startswith("key ")
    assert acknowledged.target == f"/api/v1/alarms/{ALARM}/ack"
    assert "on my way" in acknowledged.detail
    assert refused_.action == "refused: PUT /api/v1/feeders/{feeder}"
    texts = json.dumps([entry.to_json() for entry in entries])
    assert all(text.split("_", 2)[2] not in texts for text in keys.values())
    page = running.http.get("/api/v1/audit", params={"limit": 1000}, headers=bearer(keys["admin"])).json()
    assert [entry["hash"] for entry in page["entries"]][-2:] == [acknowledged.hash, refused_.hash]


def test_refused_changes_cannot_flood_the_audit_log(
    running: InProcess, keys: dict[str, str], folder: Path
) -> None:
    """One identity has its own limit; changes that are permitted are all in the log."""
    text = key(folder, Role.VIEWER, feeders=frozenset({FEEDER, OTHER}))
    path, name = f"/api/v1/alarms/{ALARM}/ack", f"viewer of {sorted((FEEDER, OTHER))}"
    for credential in (text, keys["operator"]):
        for _ in range(2 * REFUSALS):
            running.http.post(path, json={}, headers=bearer(credential))
    with AccessStore(f"sqlite:///{folder / 'gridsec.db'}") as store:
        entries = store.audit()
    assert len([entry for entry in entries if entry.identity == name]) == REFUSALS
    assert len([entry for entry in entries[-3 * REFUSALS :] if entry.target == path]) == 3 * REFUSALS


def test_the_number_of_refusals_without_an_entry_is_in_the_chain(tmp_path: Path) -> None:
    now = [1_000.0]
    ada, bob = (Identity(name, Role.VIEWER, None, f"key {name}") for name in ("Ada", "Bob"))
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        gate = Authenticator(store, wall=lambda: now[0])
        for _ in range(REFUSALS + 7):
            gate.record_refusal(ada, "PUT /x", "/x", "")
        gate.record_refusal(bob, "PUT /x", "/x", "")
        gate.record(bob, "log in", "::1")
        assert len(store.audit()) == REFUSALS + 2
        now[0] += COUNTED_S
        gate.record(bob, "log in", "::1")
        further, last = store.audit()[-2:]
        assert (further.identity, further.credential, further.action) == (
            "Ada",
            "key Ada",
            "refused: further",
        )
        assert further.detail.split()[0] == "7"
        assert last.action == "log in"
        # The end of the service ends every count; a database that is away keeps it.
        gate.record_refusal(ada, "PUT /x", "/x", "")
        database = tmp_path / "gridsec.db.access"
        database.rename(tmp_path / "away")
        now[0] += COUNTED_S
        with pytest.raises(StoreUnavailable):
            gate.record(bob, "log in", "::1")
        (tmp_path / "away").rename(database)
        gate.close()
        assert [entry.detail.split()[0] for entry in store.audit()[REFUSALS + 4 :]] == ["1"]
        assert broken(store.audit()) is None


def test_failures_are_limited_by_subnet_and_counted(tmp_path: Path) -> None:
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        gate = Authenticator(store)
        refused_: list[type[Exception]] = []
        for k in range(LOGGED + 5):
            with pytest.raises((NotAuthenticated, TooManyFailures)) as caught:
                gate.of_credential("gridsec_x", f"2001:db8:0:1::{k:x}")
            refused_.append(caught.type)
        assert refused_ == [NotAuthenticated] * FAILURES + [TooManyFailures] * (LOGGED + 5 - FAILURES)
        with pytest.raises(NotAuthenticated):
            gate.of_credential("gridsec_x", "2001:db8:0:2::1")
        gate.close()
        entries = store.audit()
    assert [entry.target for entry in entries[:2]] == ["2001:db8:0:1::0", "2001:db8:0:1::1"]
    assert len(entries) == FAILURES + 2
    assert entries[-1].detail.split()[0] == str(LOGGED + 5 - FAILURES)


def test_subnets() -> None:
    assert subnet_of("2001:db8::ffff:1") == subnet_of("2001:db8::1%eth0") == "2001:db8::/64"
    assert subnet_of("2001:db8:0:1::1") != subnet_of("2001:db8::1")
    assert subnet_of("::ffff:192.0.2.1") == subnet_of("192.0.2.1") == "192.0.2.1"
    assert subnet_of("192.0.2.2") != subnet_of("192.0.2.1")
    assert subnet_of("unknown") == "unknown"


def test_viewers_leave_a_fifth_of_the_streams_to_operators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.app.MAX_STREAMS", 5)
    viewer, operator, admin = (key(tmp_path, role) for role in (Role.VIEWER, Role.OPERATOR, Role.ADMIN))
    with service(tmp_path) as small, ExitStack() as streams:

        def status(text: str) -> int:
            path = "/api/v1/alarms/stream"
            return streams.enter_context(small.http.stream("GET", path, headers=bearer(text))).status_code

        assert status(operator) == 200
        assert [status(viewer) for _ in range(4)] == [200] * 4
        assert status(admin) == 503
    with service(tmp_path) as small, ExitStack() as streams:
        assert [status(viewer) for _ in range(5)] == [200] * 4 + [503]
        assert status(operator) == 200


@pytest.mark.parametrize("path", [f"/api/v1/feeders/{FEEDER}/stream", "/api/v1/alarms/stream"])
def test_an_open_stream_ends_with_its_key(running: InProcess, folder: Path, path: str) -> None:
    text = key(folder, Role.VIEWER)
    with running.http.stream("GET", path, headers=bearer(text)) as response:
        lines = response.iter_lines()
        assert next(lines).startswith((":", "id:", "retry:"))
        with AccessStore(f"sqlite:///{folder / 'gridsec.db'}") as store:
            assert store.revoke(text.split("_")[1], time.time())
        begun = time.monotonic()
        for _ in lines:
            assert time.monotonic() - begun < 10.0
        assert time.monotonic() - begun < 10.0


@pytest.mark.acceptance
def test_a_lost_database_of_access_does_not_open_the_service(tmp_path: Path) -> None:
    text = key(tmp_path, Role.ADMIN)
    with service(tmp_path, (OTHER,)) as made:
        assert made.http.get("/api/v1/feeders", headers=bearer(text)).status_code == 200
        (tmp_path / "gridsec.db.access").unlink()
        AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}").close()
        end = time.monotonic() + FRESH_S + 0.5
        while time.monotonic() < end:
            assert made.http.get("/api/v1/feeders").status_code in {401, 503}
            time.sleep(0.05)


# ---------------------------------------------------------------------- start


def test_an_open_service_needs_no_key_and_takes_the_given_name(tmp_path: Path) -> None:
    with service(tmp_path, (OTHER,)) as made:
        assert made.get("/api/v1/session") == {
            "name": "",
            "role": "admin",
            "feeders": None,
            "open": True,
            "expires": None,
            "expires_utc": None,
        }
        path = f"/api/v1/alarms/{ALARM}/ack"
        assert "Field required" in is_problem(made.http.post(path, json={}), 422)["detail"]
        is_problem(made.http.post(path, json={"who": "Ada"}), 404)
        # The first key closes the service.
        key(tmp_path, Role.VIEWER)
        time.sleep(FRESH_S + 0.2)
        is_problem(made.http.get("/api/v1/feeders"), 401)


@contextmanager
def started(folder: Path, **given: Any) -> Iterator[InProcess]:
    with service(folder, (OTHER,), http="0.0.0.0:0", **given) as made:
        yield made


@pytest.mark.acceptance
def test_a_network_address_needs_authentication(tmp_path: Path) -> None:
    with refused(SettingsInvalid, "no-authentication"), started(tmp_path):
        pass
    with started(tmp_path, open_to_network_without_authentication=True) as made:
        assert made.http.get("/api/v1/feeders").status_code == 200
    key(tmp_path, Role.VIEWER)
    with started(tmp_path) as made:
        assert made.http.get("/api/v1/feeders").status_code == 401


def test_loopback_addresses() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.8.8.8", "::1", "localhost", "LOCALHOST")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "10.0.0.1", "grid.example", "")))
    assert settings({}).open_to_network_without_authentication is False


# ----------------------------------------------------------------- command line


def gridsec(folder: Path, *arguments: str) -> Result:
    return CliRunner().invoke(app, [*arguments, f"--database=sqlite:///{folder / 'gridsec.db'}"])


def test_keys_and_the_audit_log_on_the_command_line(tmp_path: Path) -> None:
    made = gridsec(tmp_path, "key", "add", "Ada Lovelace", "--role", "operator", "--feeder", "north")
    assert made.exit_code == 0, made.stderr
    text = made.stdout.strip().splitlines()[-1]
    key_id = text.split("_")[1]
    assert text.startswith("gridsec_")
    assert "expires" in made.stderr
    shown = gridsec(tmp_path, "key", "list").stdout
    assert key_id in shown
    assert text.split("_", 2)[2] not in shown
    assert gridsec(tmp_path, "key", "revoke", key_id).exit_code == 0
    assert gridsec(tmp_path, "key", "revoke", key_id).exit_code == 2
    assert "revoked" in gridsec(tmp_path, "key", "list").stdout
    wrong = gridsec(tmp_path, "key", "add", "x", "--role", "root", "--expires", "soon")
    assert wrong.exit_code == 2
    assert "--role" in wrong.stderr
    assert "--expires" in wrong.stderr
    intact = gridsec(tmp_path, "audit", "verify")
    assert intact.exit_code == 0
    last = intact.stdout.split()[-1]
    assert gridsec(tmp_path, "audit", "verify", f"--expect={last}").exit_code == 0
    assert "key revoke" in gridsec(tmp_path, "audit", "show").stdout
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as store, store._write() as connection:
        connection.exec_driver_sql("UPDATE audit SET identity = 'Eve' WHERE seq = 1")
    changed = gridsec(tmp_path, "audit", "verify")
    assert changed.exit_code == 1
    assert "entry 1 was changed" in changed.stderr
