"""A front without workers: its feeders are undecided, never absent and never clean."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from feeders.model.site import load
from service.cluster.run import check_cluster
from service.settings import SettingsInvalid, settings
from service.store import Store
from tests.codes import refused
from tests.service.asking import is_problem
from tests.service.clusters import ServedCluster
from tests.service.databases import Cluster
from tests.service.stored import an_alarm, raised

COMMANDS = {
    "ack": {"who": "Ada", "comment": ""},
    "unack": {"who": "Ada", "comment": "again"},
    "comment": {"who": "Ada", "comment": "seen"},
}


@pytest.fixture(scope="module")
def live(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedCluster]:
    """A front with two feeders, and a stored alarm of a third one."""
    database = cluster.database()
    with Store(database) as store:
        store.commit([raised(an_alarm())])
    made = ServedCluster(tmp_path_factory.mktemp("front"), database, load("cigre-lv"), 2)
    try:
        made.start_front_here()
        yield made
    finally:
        made.end()


@pytest.mark.postgresql
def test_a_feeder_without_an_owner_is_listed_as_undecided(live: ServedCluster) -> None:
    listed = live.listed()
    assert list(listed) == ["copy-0", "copy-1"]
    for one in listed.values():
        assert (one["status"], one["verdict"], one["cause"]) == ("undecided", "undecided", "no-owner")
        assert one["owner"] is None
    assert live.get("/feeders")["counts"]["clean"] == 0
    reasons = is_problem(live.http.get("/readyz"), 503)["reasons"]
    assert "no worker answers" in reasons


@pytest.mark.postgresql
@pytest.mark.parametrize("path", ["", "/state", "/meters/m01", "/history", "/series", "/commissioning"])
def test_its_resources_have_a_code(live: ServedCluster, path: str) -> None:
    answer = live.http.get(f"/api/v1/feeders/copy-0{path}")
    assert is_problem(answer, 503)["code"] == "no-owner"
    assert int(answer.headers["retry-after"]) > 0


@pytest.mark.postgresql
@pytest.mark.parametrize("action", COMMANDS)
def test_commands_need_the_owner(live: ServedCluster, action: str) -> None:
    known, unknown = (f"/api/v1/alarms/{number:026d}/{action}" for number in (0, 7))
    assert is_problem(live.http.post(known, json=COMMANDS[action]), 503)["code"] == "no-owner"
    is_problem(live.http.post(unknown, json=COMMANDS[action]), 404)
    is_problem(live.http.post(known.replace("0000", "a"), json=COMMANDS[action]), 422)


@pytest.mark.postgresql
def test_bulk_commands_shelves_and_works_need_the_owner(live: ServedCluster) -> None:
    who, alarm = {"who": "Ada"}, f"{0:026d}"
    known = [
        ("alarms/ack", who | {"comment": "", "alarms": [alarm]}),
        ("shelves", who | {"alarm": alarm, "duration_s": 60.0, "reason": "known"}),
        ("planned-work", who | {"feeder": "copy-0", "t_until": 4e9, "reason": "cable"}),
    ]
    for path, body in known:
        assert is_problem(live.http.post(f"/api/v1/{path}", json=body), 503)["code"] == "no-owner", path
    missing = who | {"comment": "", "alarms": [alarm, f"{7:026d}"]}
    is_problem(live.http.post("/api/v1/alarms/ack", json=missing), 404)
    is_problem(live.http.post("/api/v1/planned-work", json=known[2][1] | {"feeder": "nowhere"}), 404)


@pytest.mark.postgresql
def test_alarms_come_from_the_database(live: ServedCluster) -> None:
    assert [one["id"] for one in live.alarms()] == [an_alarm().id]
    assert live.get("/alarms", feeder="copy-0", meter="m01")["alarms"] == []
    is_problem(live.http.get("/api/v1/alarms", params={"feeder": "copy-0", "meter": "m99"}), 404)


@pytest.mark.postgresql
def test_feeders_of_the_command_line_are_fixed(live: ServedCluster) -> None:
    is_problem(live.http.delete("/api/v1/feeders/copy-0"), 409)
    is_problem(live.http.delete("/api/v1/feeders/nowhere"), 503)


@pytest.mark.postgresql
@pytest.mark.browser
def test_the_page_shows_it_as_undecided(live: ServedCluster, browser: Browser) -> None:
    page = browser.new_page()
    page.goto(f"{live.http.base_url}/#copy-0")
    expect(page.locator("#reason")).to_contain_text("no worker monitors feeder 'copy-0'")
    expect(page.locator("#fleet-rows tr")).to_have_count(2)
    expect(page.locator("#fleet-counts")).to_have_text("2 undecided: 2 no owner")
    expect(page).to_have_title(re.compile("^NO OWNER"))
    page.close()


def test_workers_need_postgresql(tmp_path: Path) -> None:
    with refused(SettingsInvalid, "needs-postgresql"):
        check_cluster(settings({"database": f"sqlite:///{tmp_path}/g.db"}))
