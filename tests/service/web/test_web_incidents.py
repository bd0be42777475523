"""The web page: incidents before alarms, actions with mouse and keyboard, hand-over."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import APIResponse, Page, Route, expect

from tests.service.asking import T0
from tests.service.looking import Site

pytestmark = pytest.mark.browser

WIDE, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}
LIES = {"H1": 9.0, "H2": -8.0, "H3": 9.0}


def line(page: Page, text: str = "Manipulation") -> Any:
    return page.locator(f'.incident:has(.line:has-text("{text}"))')


def fill(page: Page, text: str, **more: str) -> None:
    """Fill the form of an action and send it."""
    page.fill("#act-who", "Ada")
    page.fill("#act-text", text)
    for name, value in more.items():
        page.fill(f"#act-{name}", value)
    page.click("#act-send")
    expect(page.locator("#act")).to_be_hidden()


def fits(page: Page, size: dict[str, int]) -> None:
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]


def test_a_late_response_to_an_earlier_request_changes_no_alarm(site: Site) -> None:
    site.service.wall = lambda: T0 + 10
    site.tick(T0, 4, lies=LIES)
    page = site.open(WIDE)
    held: list[tuple[Route, APIResponse]] = []
    alarms = re.compile(r"/alarms\?incident=")
    page.route(alarms, lambda route: route.continue_() if held else held.append((route, route.fetch())))
    one = line(page)
    with page.expect_request(alarms):
        one.locator(".line").click()
    page.keyboard.press("a")
    fill(page, "van sent")
    acknowledged = one.locator('.alarm[data-state="acknowledged"]')
    expect(acknowledged).to_have_count(3)
    route, response = held[0]
    with page.expect_response(alarms):
        route.fulfill(response=response)
    page.wait_for_timeout(300)
    expect(acknowledged).to_have_count(3)


def test_one_line_for_an_attack_and_actions_by_keyboard(site: Site) -> None:
    site.service.wall = lambda: T0 + 10
    site.tick(T0, 4, lies=LIES)
    page = site.open(WIDE)
    expect(page.locator(".incident")).to_have_count(1)
    one = line(page)
    expect(one).to_contain_text("village · 3 meters")
    expect(one).to_contain_text("3 alarms, 3 new")
    expect(page.locator("#incident-count")).to_have_text("1 new")
    # Enter opens the alarms of the incident, letters act on it.
    one.locator(".line").focus()
    page.keyboard.press("Enter")
    expect(one.locator(".line")).to_have_attribute("aria-expanded", "true")
    expect(one.locator(".alarm")).to_have_count(3)
    page.keyboard.press("g")
    expect(page.locator("#act-title")).to_have_text("Assign incident")
    fill(page, "please", to="Bob")
    expect(one).to_contain_text("→ Bob")
    expect(one.locator(".log")).to_contain_text("assigned to Bob by Ada")
    one.locator(".line").focus()
    page.keyboard.press("a")
    fill(page, "van sent")
    expect(one).to_contain_text("acknowledged by Ada")
    expect(page.locator("#incident-count")).to_be_hidden()
    expect(one.locator('.alarm[data-state="acknowledged"]')).to_have_count(3)
    one.get_by_role("button", name="Shelve").click()
    page.select_option("#act-duration", str(4 * 3600))
    expect(page.locator("#act-scope option")).to_have_count(5)
    fill(page, "known")
    expect(one.locator('.note[data-kind="shelved"]')).to_contain_text("shelved until")
    expect(one).to_have_attribute("data-suppressed", "yes")
    page.select_option("#incident-state", "todo")
    expect(page.locator(".incident")).to_have_count(0)
    expect(page.locator("#incident-none")).to_be_visible()
    page.select_option("#incident-state", "open")
    # The shift that takes over sees what is open, shelved and said, and may end the shelf.
    page.click("#shift-open")
    expect(page.locator("#shift-incidents")).to_contain_text("assigned to Bob")
    expect(page.locator("#shift-shelves")).to_contain_text("village: one incident until")
    expect(page.locator("#shift-works")).to_have_text("None.")
    page.locator("#shift-shelves button").click()
    expect(page.locator("#shift-shelves")).to_have_text("None.")
    page.click("#shift-close")
    expect(one).to_have_attribute("data-suppressed", "no")
    # The end of the attack clears the incident; the list of all keeps it.
    site.tick(T0 + 20, 8)
    expect(page.locator(".incident")).to_have_count(0)
    page.select_option("#incident-state", "all")
    expect(line(page)).to_contain_text("cleared after")


@pytest.mark.canary("phone-dark")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [WIDE, PHONE], ids=["wide", "phone"])
def test_pictures_of_incidents_and_hand_over(
    site_of: Callable[..., Site], village: Any, tmp_path: Path, size: dict[str, int], scheme: str
) -> None:
    """Two attacked feeders, planned work, a shelf, comments: all are on the page, nothing overflows."""
    site = site_of(village("village"), village("town", 4))
    now = time.time()
    site.tick(now - 300, 4, lies=LIES)
    town = site.service.villages["town"]
    for k in range(4):
        site.service.tick(town.report(now - 200 + k, lies={"H1": 9.0}))
    page = site.open(size, color_scheme=scheme)
    expect(page.locator(".incident")).to_have_count(2)
    page.click("#work-open")
    fill(page, "cable between 4 and 5 is renewed")
    expect(page.locator('.note[data-kind="work"]')).to_have_count(1)
    shelved = line(page, "town")
    shelved.locator(".line").click()
    shelved.get_by_role("button", name="Shelve").click()
    fill(page, "meter is exchanged on Monday")
    shelved.locator('[data-act="comment"]').click()
    fill(page, "customer informed")
    expect(shelved.locator(".log")).to_contain_text("customer informed")
    fits(page, size)
    page.locator(".incidents").scroll_into_view_if_needed()
    page.screenshot(path=tmp_path / "incidents.png")
    page.click("#shift-open")
    for name, text in (
        ("incidents", "village · 3 meters"),
        ("shelves", "meter is exchanged on Monday"),
        ("works", "cable between 4 and 5"),
        ("comments", "customer informed"),
    ):
        expect(page.locator(f"#shift-{name}")).to_contain_text(text)
    fits(page, size)
    box = page.locator("#shift").bounding_box()
    assert box is not None
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= size["width"]
    page.screenshot(path=tmp_path / "hand-over.png")


def test_a_click_survives_news_and_the_search_narrows(site: Site) -> None:
    site.service.wall = lambda: T0 + 10
    site.tick(T0, 4, lies=LIES)
    site.tick(T0 + 200, 8)
    site.tick(T0 + 900, 4, lies={"H5": 9.0})
    page = site.open(WIDE)
    expect(page.locator(".incident")).to_have_count(1)
    handle = page.locator(".incident .line").element_handle()
    site.tick(T0 + 904, 4, lies={"H5": 9.0})
    page.wait_for_timeout(500)
    assert handle.evaluate("node => node.isConnected")
    page.select_option("#incident-state", "all")
    expect(page.locator(".incident")).to_have_count(2)
    page.locator(".incident .line").first.focus()
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.activeElement.closest('.incident').dataset.state") in {"raised", "cleared"}
    page.locator(".more summary").click()
    page.select_option("#incident-sort", "onset")
    with page.expect_request(lambda request: "/incidents?" in request.url and "since=" in request.url):
        page.select_option("#incident-since", "1")
    page.select_option("#incident-since", "")
    page.fill("#incident-text", "h5")
    expect(page.locator(".incident")).to_have_count(1)
    expect(line(page)).to_contain_text("H5")
    # The link of an incident shows its first meter.
    line(page).locator(".line").click()
    line(page).locator(".body > p a.where").click()
    expect(page.locator("#detail-title")).to_have_text("H5")


def test_several_incidents_are_acknowledged_at_once(site_of: Callable[..., Site], village: Any) -> None:
    site = site_of(village("village"), village("town", 4), village("port", 4))
    site.service.wall = lambda: T0 + 10
    for name in ("village", "town", "port"):
        for k in range(4):
            site.service.tick(site.service.villages[name].report(T0 + k, lies={"H1": 9.0}))
    page = site.open(PHONE)
    expect(page.locator(".incident")).to_have_count(3)
    expect(page.locator("#incident-chosen")).to_be_hidden()
    page.get_by_label("Select Manipulation, town").check()
    line(page, "port").locator(".line").focus()
    page.keyboard.press("x")
    expect(page.locator("#incident-chosen-count")).to_have_text("2 selected")
    # An incident that is extended meanwhile is refused, and stays selected.
    page.click("#incident-chosen-ack")
    expect(page.locator("#act-title")).to_have_text("Acknowledge 2 incidents")
    site.expected = "409"
    site.service.tick(site.service.villages["port"].report(T0 + 4, lies={"H1": 9.0, "H2": 9.0}))
    for k in (5, 6, 7):
        site.service.tick(site.service.villages["port"].report(T0 + k, lies={"H1": 9.0, "H2": 9.0}))
    page.fill("#act-who", "Ada")
    page.click("#act-send")
    expect(page.locator("#act-error")).to_contain_text("port: ")
    page.click("#act-cancel")
    expect(page.locator("#incident-chosen-count")).to_have_text("1 selected")
    expect(line(page, "town")).to_contain_text("acknowledged by Ada")
    page.click("#incident-chosen-all")
    expect(page.locator("#incident-chosen-count")).to_have_text("2 selected")
    page.click("#incident-chosen-ack")
    fill(page, "one cause")
    expect(page.locator("#incident-chosen")).to_be_hidden()
    expect(page.locator("#incident-count")).to_be_hidden()
    expect(page.locator('.incident[data-state="acknowledged"]')).to_have_count(3)
    fits(page, PHONE)


def test_the_alarm_list_has_a_search_and_severities(site: Site) -> None:
    site.tick(T0, 20, lies={"H1": 9.0}, silent=("H5",))
    page = site.open(WIDE)
    expect(page.locator("#alarm-list .alarm")).to_have_count(2)
    page.fill("#alarm-text", "h5")
    expect(page.locator("#alarm-list .alarm")).to_have_count(1)
    expect(page.locator("#alarm-list .where")).to_contain_text("H5")
    # A new alarm appears only if the search has it.
    site.tick(T0 + 20, 4, lies={"H1": 9.0, "H3": 9.0}, silent=("H5",))
    page.wait_for_timeout(600)
    expect(page.locator("#alarm-list .alarm")).to_have_count(1)
    page.fill("#alarm-text", "")
    expect(page.locator("#alarm-list .alarm")).to_have_count(3)
    page.select_option("#alarm-severity", "critical")
    expect(page.locator("#alarm-list .alarm")).to_have_count(2)
    expect(page.locator('#alarm-list .alarm:not([data-severity="critical"])')).to_have_count(0)
