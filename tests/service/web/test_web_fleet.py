"""List of all feeders on the page: worst first, counts, selection, tab title, many feeders."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from gridsec.interface import Cause
from tests.service.asking import T0
from tests.service.looking import DESKTOP, LOOKS, PHONE, READABLE, Site, contrast

pytestmark = pytest.mark.browser

MANY = 1000
MOST_ROWS = 60
"""Largest number of drawn rows of the list."""
PAINT_S = 15.0
"""Time limit of the first list of 1 000 feeders on a busy machine, s."""
UPDATES = 3
FOLLOWS_S, REQUESTS = 2.0, 8.0
"""Limit on a busy machine of the median time from a stored verdict to its number: s, and multiples of a
request's duration. An idle machine takes about 0.5 s."""

REQUEST_S = """() => {
    const all = performance.getEntriesByType("resource").filter((each) => each.name.includes("limit=0"));
    return all.map((each) => each.duration / 1000).sort((a, b) => a - b)[all.length >> 1];
}"""
"""Median duration of a request of the numbers, s."""


def rows(page: Page) -> list[str]:
    return [text.split("\n")[0].split("\t")[0] for text in page.locator("#fleet-rows th").all_inner_texts()]


def tick(site: Site, village: Any, t: float, **changes: Any) -> None:
    site.service.tick(village.report(t, **changes))


def not_evaluated(village: Any) -> Any:
    """Report of a shed feeder."""
    blind = village.report(T0, cause=Cause.OVERLOAD)
    unseen = {"seen": False, "model_only": True, "v_volt_reported": None, "score": None}
    meters = tuple(replace(meter, **unseen) for meter in blind.meters)
    return replace(blind, meters=meters, model_only=True)


@pytest.mark.parametrize(("later_s", "words"), [(-10.0, "not evaluated"), (1.0, "data stale")])
def test_rare_states_of_a_shed_feeder_are_stale_later(
    site_of: Callable[..., Site], village: Callable[..., Any], later_s: float, words: str
) -> None:
    shed = village("shed", 4)
    site = site_of(shed)
    site.service.tick(not_evaluated(shed))
    site.service.delay_s = shed.detail()["patience_shed_s"] + later_s
    page = site.open()
    expect(page.locator("#link")).to_contain_text(words)


@pytest.mark.canary("phone")
@LOOKS
def test_the_worst_feeder_comes_first(
    site_of: Callable[..., Site], village: Callable[..., Any], size: dict[str, int], scheme: str
) -> None:
    quiet, doubtful, attacked, dark = (
        village(name, 4) for name in ("a-quiet", "b-doubtful", "c-attacked", "d")
    )
    site = site_of(quiet, doubtful, attacked, dark)
    tick(site, quiet, T0)
    tick(site, doubtful, T0, cause=Cause.AMBIGUOUS)
    tick(site, attacked, T0, lies={"H1": 9.0, "H2": 9.0})
    page = site.open(size, "/#a-quiet", color_scheme=scheme)
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator("#fleet-rows tr")).to_have_count(4)
    assert [row.split(",")[0] for row in rows(page)] == ["C-attacked", "B-doubtful", "D", "A-quiet"]
    expect(page.locator("#fleet-counts")).to_have_text("1 attacked1 undecided1 no data1 clean")
    first = page.locator("#fleet-rows tr").first
    expect(first.locator("td").nth(2)).to_have_text("2")
    expect(first.locator("td").nth(3)).to_have_text("0 %")
    # A clean feeder never hides attacked ones.
    expect(page).to_have_title("1 ATTACKED | CLEAN – A-quiet, 4 customers – gridsec")
    assert page.locator("#feeder option").all_inner_texts() == [
        "ATTACKED – C-attacked, 4 customers",
        "UNDECIDED – B-doubtful, 4 customers",
        "NO DATA – D, 4 customers",
        "CLEAN – A-quiet, 4 customers",
    ]
    first.locator("button").click()
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    expect(page).to_have_title("ATTACKED – C-attacked, 4 customers – gridsec")
    expect(page.locator('#fleet-rows tr[aria-current="true"] th')).to_contain_text("C-attacked")
    tick(site, attacked, T0 + 1.0, lies={"H1": 9.0, "H2": 9.0})
    tick(site, quiet, T0 + 1.0, lies={"H0": 9.0})
    expect(page).to_have_title("1 ATTACKED | ATTACKED – C-attacked, 4 customers – gridsec")
    expect(page.locator("#fleet-counts")).to_contain_text("2 attacked")
    assert contrast(page, "#fleet-rows :is(.fleet-state, th button, td.num), #fleet-counts button") > READABLE
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= size["width"]


def test_one_feeder_has_no_list(site: Site) -> None:
    site.tick(T0, 1)
    page = site.open()
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator("#fleet")).to_be_hidden()


@pytest.mark.canary("phone-dark")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_feeders_that_are_not_evaluated_never_look_clean(
    site_of: Callable[..., Site], village: Callable[..., Any], size: dict[str, int], scheme: str
) -> None:
    """One is shed, as the engine reports it; one has no owner, as the front of workers reports it."""
    quiet, shed, lost = (village(name, 4) for name in ("a-quiet", "b-shed", "c-lost"))
    site = site_of(quiet, shed, lost)
    site.expected = "503"
    tick(site, quiet, T0)
    tick(site, lost, T0)
    site.service.tick(not_evaluated(shed))
    plain = site.service.summary
    gone = {"cause": "no-owner", "verdict": "undecided", "displayed_verdict": "undecided", "since": None}
    site.service.summary = lambda name: {**plain(name), **(gone if name == "c-lost" else {})}
    page = site.open(size, "/#b-shed", color_scheme=scheme)
    expect(page.locator("#decision")).to_have_text("SHED")
    expect(page.locator("#link")).to_have_text("not evaluated")
    expect(page.locator("#next a")).to_have_attribute("href", "operator-guide#undecided-overload")
    expect(page).to_have_title("SHED – B-shed, 4 customers – gridsec")
    expect(page.locator("#fleet-counts")).to_have_text("2 undecided: 1 shed, 1 no owner1 clean")
    words = page.locator("#fleet-rows .fleet-state")
    expect(words).to_have_text(["SHED", "NO OWNER", "CLEAN"])
    looks = words.evaluate_all(
        "all => all.map(e => [getComputedStyle(e).color, getComputedStyle(e, '::before').content])"
    )
    assert looks[0] == looks[1]
    assert looks[0][0] != looks[2][0]
    assert looks[0][1] != looks[2][1]
    page.wait_for_timeout(1200)  # twice the interval of the freshness
    expect(page.locator("#decision")).to_have_text("SHED")
    expect(page.locator("#diagram .customer[data-status=ok]")).to_have_count(0)
    detail = {"status": 503, "code": "no-owner", "detail": "no worker monitors feeder 'c-lost' at the moment"}
    page.route("**/feeders/c-lost", lambda route: route.fulfill(status=503, json=detail))
    page.locator("#fleet-rows button:has-text('C-lost')").click()
    expect(page.locator("#decision")).to_have_text("NO OWNER")
    expect(page.locator("#reason")).to_contain_text("no worker monitors feeder")
    expect(page.locator("#next a")).to_have_attribute("href", "operator-guide#undecided-no-owner")
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]


@pytest.mark.acceptance
def test_a_thousand_feeders_and_the_filter(site_of: Callable[..., Site], village: Callable[..., Any]) -> None:
    villages = [village(f"v{k:04d}", 2) for k in range(MANY)]
    site = site_of(*villages)
    for each in villages:
        tick(site, each, T0, lies={"H1": 9.0} if each.name == "v0777" else {})
    begun = time.monotonic()
    page = site.open(None, "/#v0600")
    expect(page.locator("#fleet-rows tr").first).to_contain_text("V0777")
    assert time.monotonic() - begun < PAINT_S
    expect(page.locator("#fleet-more")).to_have_text(f"{MANY - 8} further feeders")
    # The selector has the worst feeders and the shown one, with their verdicts.
    expect(page.locator("#feeder option")).to_have_count(52)
    assert page.locator("#feeder option").first.inner_text() == "ATTACKED – V0777, 2 customers"
    expect(page.locator("#feeder option").last).to_be_disabled()
    page.locator("#fleet-all summary").click()
    expect(page.locator("#fleet-more")).to_have_text(f"{MANY} of {MANY}")
    assert page.locator("#fleet-rows tr").count() < MOST_ROWS
    # Any place of the list is reached, by scrolling and by keyboard; the document stays small.
    page.locator("#fleet-scroll").evaluate("box => { box.scrollTop = 16000; }")
    expect(page.locator('#fleet-rows tr[data-feeder="v0490"]')).to_be_visible()
    page.locator('#fleet-rows tr[data-feeder="v0490"] button').focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator('#fleet-rows tr[data-feeder="v0491"] button')).to_be_focused()
    page.keyboard.press("End")
    expect(page.locator('#fleet-rows tr[data-feeder="v0999"] button')).to_be_focused()
    expect(page.locator("#fleet-table")).to_have_attribute("aria-rowcount", str(MANY + 1))
    assert page.locator("#fleet-rows tr").count() < MOST_ROWS
    page.keyboard.press("Home")
    expect(page.locator('#fleet-rows tr[data-feeder="v0777"] button')).to_be_focused()
    page.fill("#fleet-filter", "v0999")
    expect(page.locator("#fleet-rows tr")).to_have_count(1)
    page.locator("#fleet-rows button").click()
    expect(page.locator("#verdict")).to_be_visible()
    expect(page.locator("#feeder")).to_have_value("v0999")
    expect(page).to_have_title(re.compile(r"^1 ATTACKED \| .* – V0999, 2 customers – gridsec$"))
    # A feeder that becomes attacked comes to the top within two updates.
    page.fill("#fleet-filter", "")
    tick(site, villages[500], T0 + 1.0, lies={"H0": 9.0, "H1": 9.0})
    expect(page.locator("#fleet-rows tr:not(.gap)").first).to_contain_text("V0500")
    expect(page).to_have_title(re.compile(r"^2 ATTACKED \| "))


def test_numbers_by_verdict_filter_the_list(
    site_of: Callable[..., Site], village: Callable[..., Any]
) -> None:
    villages = [village(name, 4) for name in ("one", "two", "three")]
    site = site_of(*villages)
    for k in range(4):
        tick(site, villages[1], T0 + k, lies={"H1": 9.0, "H2": 9.0})
    tick(site, villages[2], T0, silent=("H3",))
    page = site.open(None, "/#one")
    expect(page.locator("#fleet-rows tr")).to_have_count(3)
    first, second = page.locator("#fleet-rows tr").nth(0), page.locator("#fleet-rows tr").nth(1)
    expect(first.locator("td").nth(4)).to_have_text("1")  # incident of both alarms
    expect(first.locator("td").nth(5)).to_have_text("2, 2 new")
    expect(second.locator("td").nth(3)).to_have_text("25 %")
    page.locator('.alarm:has-text("H1") button.ack').click()
    page.fill("#act-who", "Ada")
    page.locator("#act-send").click()
    expect(first.locator("td").nth(5)).to_have_text("2, 1 new")
    undecided = page.locator('#fleet-counts button[data-state="undecided"]')
    undecided.click()
    expect(page.locator("#fleet-rows tr")).to_have_count(1)
    expect(page.locator("#fleet-rows th")).to_contain_text("Three")
    expect(undecided).to_have_attribute("aria-pressed", "true")
    undecided.click()
    expect(page.locator("#fleet-rows tr")).to_have_count(3)
    # A page of another feeder than the shown one: one number of attacked feeders everywhere.
    expect(page).to_have_title("1 ATTACKED | NO DATA – One, 4 customers – gridsec")
    expect(page.locator("#feeder option:checked")).to_have_text("NO DATA – One, 4 customers")


@pytest.mark.canary("60")
@pytest.mark.parametrize("count", [60, MANY], ids=["60", "1000"])
def test_the_overview_follows_within_a_second_also_in_a_hidden_tab(
    site_of: Callable[..., Site], village: Callable[..., Any], count: int
) -> None:
    """The tab is hidden as a browser hides it: `visibilityState`, and no paint."""
    villages = [village(f"v{k:04d}", 2) for k in range(count)]
    site = site_of(*villages)
    live = villages if count == MANY else villages[:20]
    for each in live:
        tick(site, each, T0)
    page = site.open(None, "/#v0001")
    expect(page.locator('#fleet-counts [data-state="clean"]')).to_have_text(f"{len(live)} clean")
    painted_ms = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    assert painted_ms < 1e3 * PAINT_S
    waited = []
    for k in range(UPDATES):
        tick(site, villages[10 + k], T0 + 1.0, lies={"H1": 9.0})
        begun = time.monotonic()
        page.wait_for_selector(f'#fleet-counts [data-state="attacked"]:text-is("{k + 1} attacked")')
        waited.append(time.monotonic() - begun)
    request_s = page.evaluate(REQUEST_S)
    assert sorted(waited)[UPDATES // 2] < FOLLOWS_S + REQUESTS * request_s
    expect(page.locator("#fleet-rows tr").first).to_contain_text("V0010")
    page.evaluate(
        "Object.defineProperty(document, 'visibilityState', { get: () => 'hidden', configurable: true })"
    )
    lists: list[str] = []
    page.wait_for_timeout(800)  # requests of the visible page end
    page.on("request", lambda request: lists.append(request.url) if "order=worst" in request.url else None)
    for each in villages[:4]:
        tick(site, each, T0 + 2.0, lies={"H1": 9.0})
    expect(page).to_have_title(re.compile(r"^6 ATTACKED \| ATTACKED – V0001"))
    assert lists == []
    page.evaluate("delete document.visibilityState; document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#feeder option").nth(6)).to_contain_text("ATTACKED")
    print(f"{count} feeders: paint {painted_ms:.0f} ms, request {request_s:.2f} s, updates {waited} s")
