"""Incidents over REST: lists, events, actions of operators, shelves, planned work, hand-over."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import httpx
import pyarrow.csv
import pytest
from pydantic import TypeAdapter

from service.alarms.incidents import IncidentEvent
from service.api import models
from tests.service.asking import T0, Setup, Stream, is_problem
from tests.service.conftest import SmallService
from tests.service.databases import both

LIES = {"H1": 9.0, "H2": -8.0, "H3": 9.0}


@pytest.fixture
def attacked(setup: Setup) -> Setup:
    """A village with an attack on three meters."""
    setup.service.wall = lambda: T0 + 10
    setup.attack(lies=LIES)
    return setup


def incident(setup: Setup, **params: Any) -> dict[str, Any]:
    (found,) = setup.get("/incidents", params=params).json()["incidents"]
    return dict(found)


def post(setup: Setup, path: str, **body: Any) -> httpx.Response:
    return setup.http.post(f"/api/v1{path}", json={"who": "Ada", **body})


def done(response: httpx.Response) -> dict[str, Any]:
    assert response.status_code in {200, 201}, response.text
    return dict(response.json())


def changes(setup: Setup, name: str) -> list[tuple[str, str | None, str | None, bool]]:
    events = setup.get(f"/incidents/{name}/events").json()["events"]
    return [(each["change"], each["who"], each["comment"], each["notify"]) for each in events]


def test_an_attack_is_one_incident_with_its_alarms(attacked: Setup) -> None:
    found = incident(attacked)
    assert (found["kind"], found["feeder"], found["state"]) == ("manipulation", "village", "raised")
    assert (found["alarms"], found["active"], found["meters"]) == (3, 3, ["H1", "H2", "H3"])
    alarms = attacked.get("/alarms", params={"incident": found["id"]}).json()["alarms"]
    assert {one["meter"] for one in alarms} == {"H1", "H2", "H3"}
    assert {one["incident"] for one in alarms} == {found["id"]}
    assert attacked.get(f"/incidents/{found['id']}").json() == found
    assert [change for change, *_ in changes(attacked, found["id"])] == ["opened"]
    page = models.Incidents.model_validate(attacked.get("/incidents").json())
    assert (page.raised, page.last_event, page.next) == (1, 1, None)
    incidents_are_tables_too(attacked)
    alarms_are_searched_sorted_and_paged(attacked)


def test_filters_and_pages_of_incidents(attacked: Setup) -> None:
    service = attacked.service
    service.tick(next(reversed(service.villages.values())).report(T0 + 100, lies={"H1": 9.0}))
    for k in range(1, 4):
        service.tick(service.villages["town"].report(T0 + 100 + k, lies={"H1": 9.0}))

    def ids(**params: Any) -> list[str]:
        found = attacked.get("/incidents", params=params).json()["incidents"]
        return [f"{one['feeder']} {one['kind']}" for one in found]

    both = ["town manipulation", "village manipulation"]
    assert ids() == ids(sort="severity") == ids(sort="last") == both
    for params in (
        {"feeder": "town"},
        {"text": "TOWN h1"},
        {"since": T0 + 50},
        {"feeder": "town", "meter": "H1"},
    ):
        assert ids(**params) == both[:1], params
    assert ids(until=T0 + 50) == ids(meter="H2") == both[1:]
    for params in ({"text": "moon"}, {"state": "cleared"}, {"kind": "data-loss"}, {"shelved": True}):
        assert ids(**params) == [], params
    assert ids(shelved=False, planned=False, severity="critical", assigned_to="") == both
    for sort in ("onset", "severity", "last"):
        first = attacked.get("/incidents", params={"limit": 1, "sort": sort}).json()
        second = attacked.get("/incidents", params={"limit": 1, "sort": sort, "cursor": first["next"]}).json()
        assert [each["incidents"][0]["feeder"] for each in (first, second)] == ["town", "village"]
        assert second["next"] is None
    is_problem(attacked.get("/incidents", params={"feeder": "moon"}), 404)
    is_problem(attacked.get("/incidents", params={"shelf": "x"}), 422)


def alarms_are_searched_sorted_and_paged(attacked: Setup) -> None:
    def meters(**params: Any) -> list[str]:
        return [one["meter"] for one in attacked.get("/alarms", params=params).json()["alarms"]]

    assert meters(text="h2 village") == ["H2"]
    assert meters(text="100%") == meters(shelved=True) == []
    everything = sorted(meters())
    for sort in ("onset", "severity", "raised"):
        assert sorted(meters(sort=sort)) == everything
        found, cursor = [], None
        while True:
            page = attacked.get(
                "/alarms", params={"limit": 1, "sort": sort} | ({"cursor": cursor} if cursor else {})
            ).json()
            found += [one["meter"] for one in page["alarms"]]
            if (cursor := page["next"]) is None:
                break
        assert sorted(found) == everything
    is_problem(attacked.get("/alarms", params={"sort": "beauty"}), 422)


def incidents_are_tables_too(attacked: Setup) -> None:
    response = attacked.get("/incidents", headers={"Accept": "text/csv"})
    table = pyarrow.csv.read_csv(io.BytesIO(response.content)).to_pylist()
    assert [(row["meters"], row["alarms"], row["kinds"]) for row in table] == [
        ("H1;H2;H3", 3, "meter-manipulated")
    ]
    alarms = attacked.get("/alarms", headers={"Accept": "text/csv"})
    rows = pyarrow.csv.read_csv(io.BytesIO(alarms.content)).to_pylist()
    assert {row["incident"] for row in rows} == {table[0]["id"]}


def test_an_incident_is_acknowledged_once_as_it_was_seen(attacked: Setup) -> None:
    events_by_number_and_by_stream(attacked)
    found = incident(attacked)
    path = f"/incidents/{found['id']}"
    problem = is_problem(post(attacked, f"{path}/ack", count=2), 409)
    assert "which has 3 by now" in problem["detail"]
    after = done(post(attacked, f"{path}/ack", comment="van sent", count=3))
    assert (after["state"], after["unacknowledged"], after["acknowledged_by"]) == ("acknowledged", 0, "Ada")
    assert all(one["acknowledged_by"] == "Ada" for one in attacked.get("/alarms").json()["alarms"])
    assert done(post(attacked, f"{path}/ack")) == after
    assert changes(attacked, found["id"])[2:] == [("acknowledged", "Ada", "van sent", True)]
    # The state machine of the alarms knows it: the end of the attack clears acknowledged alarms.
    attacked.calm(T0 + 20)
    assert incident(attacked)["state"] == "cleared"
    assert {one["acknowledged_by"] for one in attacked.get("/alarms").json()["alarms"]} == {"Ada"}
    is_problem(post(attacked, f"/incidents/{'0' * 26}/ack"), 404)


def test_withdrawals_comments_and_assignment(attacked: Setup) -> None:
    name = incident(attacked)["id"]
    done(post(attacked, f"/incidents/{name}/ack"))
    assert done(post(attacked, f"/incidents/{name}/unack", comment="not yet"))["unacknowledged"] == 3
    assert done(post(attacked, f"/incidents/{name}/assign", to="Bob"))["assigned_to"] == "Bob"
    assert incident(attacked, assigned_to="Bob")["id"] == name
    done(post(attacked, f"/incidents/{name}/comment", comment="on site at 9"))
    assert done(post(attacked, f"/incidents/{name}/assign", to=None))["assigned_to"] is None
    assert changes(attacked, name)[2:] == [
        ("unacknowledged", "Ada", "not yet", True),
        ("assigned", "Ada", None, True),
        ("commented", "Ada", "on site at 9", True),
        ("assigned", "Ada", None, True),
    ]
    is_problem(post(attacked, f"/incidents/{name}/comment", comment=""), 422)
    is_problem(post(attacked, f"/incidents/{name}/assign"), 422)
    several_alarms_at_once_and_one_back(attacked)


def several_alarms_at_once_and_one_back(attacked: Setup) -> None:
    ids = [one["id"] for one in attacked.get("/alarms").json()["alarms"]]
    response = post(attacked, "/alarms/ack", alarms=[*ids[:2], ids[0]])
    assert [one["state"] for one in response.json()] == ["acknowledged"] * 2
    assert incident(attacked)["unacknowledged"] == 1
    assert done(post(attacked, f"/alarms/{ids[0]}/unack", comment="wrong one"))["state"] == "raised"
    is_problem(post(attacked, f"/alarms/{ids[0]}/unack"), 409)
    done(post(attacked, f"/alarms/{ids[0]}/comment", comment="a second look"))
    events = attacked.get(f"/alarms/{ids[0]}/events").json()["events"]
    assert [(each["change"], each["comment"]) for each in events] == [
        ("raised", None),
        ("acknowledged", ""),
        ("unacknowledged", "not yet"),
        ("acknowledged", ""),
        ("unacknowledged", "wrong one"),
        ("commented", "a second look"),
    ]
    # All or none.
    is_problem(post(attacked, "/alarms/ack", alarms=[ids[2], "0" * 26]), 404)
    assert attacked.get(f"/alarms/{ids[2]}").json()["state"] == "raised"
    is_problem(post(attacked, "/alarms/ack", alarms=[]), 422)


@both
def test_a_higher_severity_ends_a_shelf(
    url: str, village: type, serve: Callable[..., Any], family: str
) -> None:
    """The shelf of a meter is for major alarms; the critical one of its manipulation ends it and notifies."""
    assert url.startswith(family)
    running = SmallService(url, village("village"))
    running.wall = lambda: T0 + 10
    setup = Setup(running, serve(running))
    with setup.http:
        wanted = {"feeder": "village", "meter": "H3", "severity": "major"}
        shelf = done(post(setup, "/shelves", duration_s=600.0, reason="exchange", **wanted))
        setup.attack()
        assert setup.get("/shelves").json()["shelves"] == []
        (ended,) = setup.get("/shelves", params={"standing": False}).json()["shelves"]
        assert (ended["id"], ended["escalated"], ended["ended_by"]) == (shelf["id"], True, None)
        found = incident(setup)
        assert (found["severity"], found["shelved_until"]) == ("critical", None)
        assert [notify for *_, notify in changes(setup, found["id"])][-1]
        assert setup.get("/alarms", params={"shelved": True}).json()["alarms"] == []
        # A shelf for this severity holds.
        done(post(setup, "/shelves", duration_s=600.0, reason="known", **wanted | {"severity": "critical"}))
        setup.attack(T0 + 4)
        assert incident(setup)["shelved_until"] == T0 + 610.0
    running.close()


def test_a_shelf_of_each_kind(attacked: Setup) -> None:
    for body, status in WRONG_SHELVES:
        is_problem(post(attacked, "/shelves", **{"reason": "known", "duration_s": 60.0, **body}), status)
    assert attacked.get("/shelves").json()["shelves"] == []
    name = incident(attacked)["id"]
    alarm = attacked.get("/alarms", params={"text": "h1"}).json()["alarms"][0]["id"]
    wanted = {"reason": "known", "duration_s": 3600.0}
    one = done(post(attacked, "/shelves", alarm=alarm, **wanted))
    assert (one["until"], one["severity"], one["feeder"], one["who"]) == (
        T0 + 3610,
        "critical",
        "village",
        "Ada",
    )
    shelved = attacked.get("/alarms", params={"shelved": True}).json()["alarms"]
    assert [(each["meter"], each["shelved_until"]) for each in shelved] == [("H1", T0 + 3610)]
    assert len(attacked.get("/alarms", params={"shelved": False}).json()["alarms"]) == 2
    assert incident(attacked)["shelved_until"] is None
    done(post(attacked, "/shelves", feeder="village", kind="meter-manipulated", **wanted))
    assert incident(attacked, shelved=True)["shelved_until"] == T0 + 3610
    assert attacked.get("/incidents").json()["raised"] == 0
    assert changes(attacked, name)[1:] == [("shelved", "Ada", "known", False)]
    done(post(attacked, "/shelves", incident=name, **wanted))
    done(post(attacked, "/shelves", feeder="village", meter="H2", **wanted))
    assert_tag_follows(attacked, "/shelves", feeder="town", kind="undecided", **wanted)
    (town,) = attacked.get("/shelves", params={"feeder": "town"}).json()["shelves"]
    assert_tag_follows(attacked, f"/shelves/{town['id']}/end")
    found = attacked.get("/shelves").json()
    assert (len(found["shelves"]), found["max_duration_s"]) == (4, 86400.0)
    for each in found["shelves"]:
        assert done(post(attacked, f"/shelves/{each['id']}/end", comment="back"))["ended_by"] == "Ada"
        is_problem(post(attacked, f"/shelves/{each['id']}/end"), 404)
    assert attacked.get("/shelves").json()["shelves"] == []
    assert len(attacked.get("/shelves", params={"standing": False}).json()["shelves"]) == 5
    assert changes(attacked, name)[-1] == ("unshelved", "Ada", "back", True)


def assert_tag_follows(setup: Setup, path: str, **body: Any) -> None:
    """A change of a shelf or a planned work changes the ETag of the alarms; without one it stays."""
    known = {"If-None-Match": setup.get("/alarms").headers["etag"]}
    assert setup.get("/alarms", headers=known).status_code == 304
    done(post(setup, path, **body))
    assert setup.get("/alarms", headers=known).status_code == 200


WRONG_SHELVES: list[tuple[dict[str, Any], int]] = [
    ({}, 422),
    ({"feeder": "village"}, 422),
    ({"meter": "H1"}, 422),
    ({"alarm": "0" * 26}, 404),
    ({"incident": "0" * 26}, 404),
    ({"alarm": "0" * 26, "incident": "0" * 26}, 422),
    ({"feeder": "moon", "meter": "H1"}, 404),
    ({"feeder": "village", "meter": "H99"}, 404),
    ({"feeder": "village", "meter": "H1", "duration_s": 86_401.0}, 422),
    ({"feeder": "village", "meter": "H1", "duration_s": 0.0}, 422),
    ({"feeder": "village", "meter": "H1", "reason": ""}, 422),
]


def test_planned_work_marks_alarms_and_ends(setup: Setup) -> None:
    setup.service.wall = lambda: T0 - 5
    assert_tag_follows(setup, "/planned-work", feeder="village", t_until=T0 + 600, reason="cable")
    (work,) = setup.get("/planned-work").json()["planned_work"]
    assert (work["t_from"], work["begun"], work["t_ended"]) == (T0 - 5, True, None)
    setup.attack(lies=LIES)
    found = incident(setup)
    assert (found["planned_work"], found["planned_until"]) == (work["id"], T0 + 600)
    assert changes(setup, found["id"]) == [("opened", None, None, False)]
    assert {one["planned_work"] for one in setup.get("/alarms").json()["alarms"]} == {work["id"]}
    assert incident(setup, planned=True)["id"] == found["id"]
    assert [each["id"] for each in setup.get("/planned-work").json()["planned_work"]] == [work["id"]]
    assert_tag_follows(setup, f"/planned-work/{work['id']}/end", comment="done early")
    assert changes(setup, found["id"])[-1] == ("work-ended", "Ada", "done early", True)
    assert setup.get("/planned-work").json()["planned_work"] == []
    is_problem(post(setup, f"/planned-work/{work['id']}/end"), 404)
    is_problem(post(setup, "/planned-work", feeder="moon", t_until=T0 + 600, reason="cable"), 404)
    for wrong in (T0 - 10, T0 + 40 * 86_400):
        is_problem(post(setup, "/planned-work", feeder="village", t_until=wrong, reason="cable"), 422)


def test_the_shift_is_handed_over(attacked: Setup) -> None:
    name = incident(attacked)["id"]
    done(post(attacked, f"/incidents/{name}/comment", comment="seen from the van"))
    done(post(attacked, "/shelves", feeder="village", meter="H1", reason="known", duration_s=60.0))
    done(post(attacked, "/planned-work", feeder="town", t_from=T0 + 50, t_until=T0 + 600, reason="cable"))
    done(post(attacked, f"/incidents/{name}/ack", comment="Bob drives"))
    found = attacked.get("/hand-over", params={"since": T0}).json()
    assert [one["id"] for one in found["incidents"]] == [name]
    assert [one["meter"] for one in found["shelves"]] == ["H1"]
    assert [one["feeder"] for one in found["planned_work"]] == ["town"]
    said = [(one["who"], one["change"], one["comment"]) for one in found["comments"]]
    assert sorted(said) == [
        ("Ada", "acknowledged", "Bob drives"),
        ("Ada", "commented", "seen from the van"),
    ]
    assert all(one["incident"] == name for one in found["comments"])
    assert attacked.get("/hand-over", params={"since": T0 + 20}).json()["comments"] == []
    shift = attacked.get("/hand-over").json()
    assert shift["t"] - shift["since"] == pytest.approx(8 * 3600, abs=5)


def events_by_number_and_by_stream(attacked: Setup) -> None:
    name = incident(attacked)["id"]
    stream = Stream(attacked, "/incidents/stream?after=0")
    done(post(attacked, f"/incidents/{name}/comment", comment="seen"))
    found: list[IncidentEvent] = []
    while len(found) < 2:
        event = stream.next()
        if "data" in event:
            assert event["event"] == "incident"
            found.append(TypeAdapter(IncidentEvent).validate_json(event["data"]))
            assert int(event["id"]) == found[-1].seq
    stream.close()
    assert [(one.seq, one.change) for one in found] == [(1, "opened"), (2, "commented")]
    paged = models.IncidentEvents.model_validate(attacked.get("/incidents/events").json())
    assert (paged.events, paged.next) == (found, None)
    first = attacked.get("/incidents/events", params={"limit": 1}).json()
    assert ([each["seq"] for each in first["events"]], first["next"]) == ([1], 1)
    rest = attacked.get("/incidents/events", params={"after": first["next"]}).json()
    assert [each["seq"] for each in rest["events"]] == [2]
