"""Status banner: displayed verdict, its start, its certainty, the next step, suspects, lost connection."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from gridsec.interface import Cause, Decision
from service.alarms.conditions import AlarmKind
from service.alarms.incidents import IncidentKind
from service.api.guide import page as guide
from service.report.report import BusbarMeterState, DisplayedVerdict, ExplanationReport
from tests.service.asking import T0
from tests.service.looking import LOOKS, PHONE, READABLE, Site, contrast

pytestmark = pytest.mark.browser

WIDE = {"width": 1400, "height": 900}
BANNER = Path("service/web/banner.js")


def shown(site: Site, t: float, displayed: DisplayedVerdict, **changes: Any) -> None:
    site.service.tick(replace(site.village.report(t, **changes), displayed=displayed))


@pytest.mark.canary("desktop")
@LOOKS
def test_the_displayed_verdict_and_the_latest_tick(site: Site, size: dict[str, int], scheme: str) -> None:
    attacked = DisplayedVerdict(
        Decision.ATTACKED, T0 - 180, T0, Cause.RESIDUALS, "H3 contradicts the rest.", ("H3",)
    )
    shown(site, T0, attacked, lies={"H3": 9.0})
    page = site.open(size, color_scheme=scheme)
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    assert contrast(page, "#verdict :is(strong, h2, p, a, .chip, dt, dd)") > READABLE
    expect(page.locator("#since")).to_have_text(re.compile(r"^Since .* \(3 min\)\.$"))
    expect(page.locator("#certainty")).to_contain_text("Strongest evidence at this tick: H3, 6.6 times")
    expect(page.locator("#next a")).to_have_attribute("href", "operator-guide#meter-manipulated")
    # A tick without an answer does not change the banner; it is named beside it.
    shown(site, T0 + 1, attacked, silent=("H5",))
    expect(page.locator("#since")).to_contain_text("Latest tick: undecided, silent meters.")
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    expect(page.locator("#reason")).to_have_text("H3 contradicts the rest.")
    expect(page.locator("#chips .chip").first).to_have_text("H3 +9.0 V")
    expect(page).to_have_title(re.compile("^ATTACKED"))
    assert contrast(page, "#verdict :is(strong, h2, p, a, .chip, dt, dd)") > READABLE
    clean = DisplayedVerdict(Decision.CLEAN, T0 + 2, T0 + 2, Cause.AGREEMENT, "All agree.", ())
    shown(site, T0 + 2, clean)
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator("#certainty")).to_contain_text(
        "13 of 13 meters tested; largest score 1 % of its threshold"
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]


def test_candidates_of_an_undecided_verdict(site: Site) -> None:
    report = site.village.report(T0, cause=Cause.AMBIGUOUS)
    ways = (ExplanationReport(("H3",), (), 0.6), ExplanationReport(("substation",), (), 0.4))
    site.service.tick(replace(report, explanations=ways))
    page = site.open()
    expect(page.locator("#decision")).to_have_text("UNDECIDED")
    expect(page.locator("#certainty")).to_have_text(
        "Possible: H3 (60 %), or substation · busbar meter (40 %)."
    )
    expect(page.locator("#next")).to_contain_text("Inspect the candidates, the likeliest first.")
    page.locator("#chips .chip:has-text('candidate H3')").click()
    expect(page.locator("#detail-title")).to_have_text("H3")
    page.locator("#chips .chip:has-text('candidate substation')").click()
    expect(page.locator("#series-meters .chip")).to_contain_text("substation")


def test_all_suspects_are_reachable(site: Site) -> None:
    lies = {f"H{k}": 9.0 for k in range(11)}
    liar = BusbarMeterState(True, True, True, (), None, 238.0, 231.0, 7.0)
    site.service.tick(replace(site.village.report(T0, lies=lies), busbar=liar))
    page = site.open()
    chips = page.locator("#chips .chip")
    expect(chips).to_have_count(8)
    page.locator("#chips button:has-text('Show all 12')").click()
    expect(chips).to_have_count(12)
    expect(page.locator("#chips button:has-text('Show fewer')")).to_be_focused()
    site.service.tick(replace(site.village.report(T0 + 1, lies=lies), busbar=liar))
    expect(chips).to_have_count(12)
    page.locator("#chips .chip:has-text('H10')").click()
    expect(page.locator("#detail-title")).to_have_text("H10")
    page.locator("#chips .chip:has-text('substation')").click()
    expect(page.locator("#series-chart .meter-name")).to_contain_text("substation")


@pytest.mark.canary("desktop-light")
@pytest.mark.parametrize(
    ("size", "scheme"),
    [(WIDE, "light"), (WIDE, "dark"), (PHONE, "light"), (PHONE, "dark")],
    ids=["desktop-light", "desktop-dark", "phone-light", "phone-dark"],
)
def test_without_a_connection_the_page_is_dimmed_and_states_it(
    site: Site, size: dict[str, int], scheme: str
) -> None:
    site.tick(T0, 2)
    page = site.open(size, color_scheme=scheme)
    bar, main = page.locator("#offline"), page.locator("#main")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(bar).to_be_hidden()
    site.expected = "net::ERR_"
    site.server.stop()
    expect(bar).to_be_visible()
    expect(bar).to_contain_text("Not connected to the service. The page shows the state of")
    expect(main).to_have_attribute("data-link", "lost")
    veil = main.evaluate("e => getComputedStyle(e, '::after').position")
    assert veil == "fixed"
    assert contrast(page, "#offline") > READABLE
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    expect(page.locator("#next a")).to_have_attribute("href", "operator-guide#no-data")
    site.server = site.serve(site.service, site.server.port)
    site.tick(T0 + 2)
    expect(bar).to_be_hidden()
    expect(page.locator("#decision")).to_have_text("CLEAN")
    assert main.evaluate("e => getComputedStyle(e, '::after').content") == "none"


def test_every_kind_and_every_cause_has_a_section_of_the_guide(site: Site) -> None:
    sections = set(re.findall(r'<h\d id="([^"]+)">', guide()))
    code = BANNER.read_text(encoding="utf-8")
    steps = code.partition("const STEPS")[2].partition("};")[0]
    wanted = set(re.findall(r', "([a-z-]+)"\],', steps))
    assert len(wanted) >= 5
    assert wanted <= sections
    assert {*AlarmKind, *IncidentKind, "undecided"} <= sections
    causes = set(
        re.findall(r'^  "?([a-z-]+)"?: "', code.partition("const CAUSES")[2].partition("};")[0], re.M)
    )
    assert {*Cause} - {Cause.AGREEMENT, Cause.RESIDUALS} <= causes
    assert {f"undecided-{cause}" for cause in causes} <= sections
    # The links of the page.
    site.tick(T0, 4, lies={"H3": 9.0})
    seen = site.open()
    expect(seen.locator("#next a")).to_have_attribute("href", "operator-guide#meter-manipulated")
    seen.locator(".incident .line").click()
    for place, kind in ((".incident .body > .tools", "manipulation"), ("#alarm-list", "meter-manipulated")):
        expect(seen.locator(f"{place} .guide-link")).to_have_attribute("href", f"operator-guide#{kind}")
    site.tick(T0)
    page = site.open(path="/operator-guide#verdict-undecided")
    expect(page.locator("#verdict-undecided")).to_be_in_viewport()
    expect(page.locator("h1")).to_have_text("Operator guide")
    assert page.locator('a[href]:not([href^="#"])').count() == 0
    assert page.locator("img").count() == 0
