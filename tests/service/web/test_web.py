"""The web page: verdicts, customers, maps, on desks and phones."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from benchmarks.mesh import baran_wu
from feeders.model.site import Site as FeederSite
from feeders.model.site import from_tables, load, names
from gridsec.interface import Cause, Decision
from service.report.feeder_info import detail
from service.report.report import BusbarMeterState, BusState, blind
from tests.feeders import stations
from tests.service.asking import T0
from tests.service.looking import DESKTOP, PHONE, Site, customer
from tests.service.ticks import tick_of

pytestmark = pytest.mark.browser


def real(village: type, of: FeederSite) -> Any:
    """A village with the tree of a real feeder."""
    made = village(of.feeder.name, 0)
    made.detail = lambda: known
    known = detail(of, 5.0)
    layout = known["layout"]
    made.buses, made.parent, made.customers = layout["buses"], layout["parent"], layout["customers"]
    made.meters = [c["meter"] for c in made.customers]
    return made


def fill_of(page: Page, name: str) -> tuple[int, int, int]:
    text = customer(page, name).locator(".shape").evaluate("e => getComputedStyle(e).fill")
    red, green, blue = map(int, re.findall(r"\d+", text)[:3])
    return red, green, blue


def magnification(page: Page) -> float:
    """Pixels of the window per pixel of the drawing."""
    value: float = page.locator("#diagram .world").evaluate("g => g.transform.baseVal.consolidate().matrix.a")
    return value


# ------------------------------------------------------------------- the verdict


def test_a_clean_feeder(site: Site) -> None:
    site.tick(T0, 3)
    page = site.open()
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator("#reason")).to_have_text("All meters agree with the feeder.")
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator('#diagram .customer[data-status="ok"]')).to_have_count(13)
    expect(page.locator("#alarm-none")).to_be_visible()
    expect(page).to_have_title("CLEAN – Village, 13 customers – gridsec")


def test_before_the_first_tick_nothing_is_claimed(site: Site) -> None:
    page = site.open()
    expect(page.locator("#decision")).to_have_text("NO DATA")
    expect(page.locator("#link")).to_have_text("waiting for data …")
    site.tick(T0)
    expect(page.locator("#decision")).to_have_text("CLEAN")


def test_a_feeder_that_cannot_be_loaded_is_said_to_be_watched_by_nobody(site: Site) -> None:
    site.service.cannot_load["town"] = "key v_min_pu: 'x' is no number"
    site.expected = "503"
    site.tick(T0)
    page = site.open(path="/#village")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    page.select_option("#feeder", "town")
    expect(page.locator("#decision")).to_have_text("NO DATA")
    expect(page.locator("#reason")).to_contain_text("feeder 'town' is not monitored")
    expect(page.locator("#link")).to_have_text("not monitored")
    expect(page.locator("#diagram .customer")).to_have_count(0)
    page.select_option("#feeder", "village")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator("#link")).to_have_text("live")


def test_an_attack_shows_without_reloading(site: Site) -> None:
    site.tick(T0, 3)
    page = site.open()
    expect(page.locator("#decision")).to_have_text("CLEAN")
    site.tick(T0 + 3, 4, lies={"H3": 9.0, "H7": -7.5})
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    expect(page.locator('#diagram .customer[data-status="suspect"]')).to_have_count(2)
    expect(customer(page, "H3").locator(".sign")).to_have_text("!")
    expect(customer(page, "H3").locator(".note")).to_have_text("H3+9.0")
    assert page.locator(".chip").all_text_contents() == ["H3 +9.0 V", "H7 −7.5 V"]
    expect(page.locator(".alarm")).to_have_count(2)
    expect(page.locator(".alarm").first).to_contain_text("Meter manipulated")
    site.tick(T0 + 7, 8)
    expect(page.locator("#decision")).to_have_text("CLEAN")
    expect(page.locator(".alarm")).to_have_count(0)
    page.select_option("#alarm-state", "all")
    expect(page.locator('.alarm[data-state="cleared"]')).to_have_count(2)


def test_undecided_and_silent(site: Site) -> None:
    site.tick(T0, 4, silent=("H5",))
    page = site.open()
    expect(page.locator("#decision")).to_have_text("UNDECIDED")
    expect(page.locator("#reason")).to_have_text("No verdict: silent meters.")
    expect(customer(page, "H5")).to_have_attribute("data-status", "silent")
    expect(customer(page, "H5").locator(".sign")).to_have_text("?")
    expect(page.locator(".chip")).to_have_text("H5 silent 12 s")
    expect(page.locator(".alarm")).to_contain_text("Data loss")


@pytest.mark.canary("phone")
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_who_is_in_doubt_or_not_judged_is_not_honest(site: Site, size: dict[str, int]) -> None:
    report = site.village.report(T0, cause=Cause.SILENT_METERS)
    changes: dict[str, dict[str, Any]] = {
        "H3": {"score": 9.0, "threshold": 1.0},
        "H4": {"score": None, "threshold": None},
        "H5": {"v_volt_estimated": None, "v_volt_std": None, "v2_pu_estimated": None},
        "H6": {"threshold": None},
    }
    meters = tuple(replace(meter, **changes.get(meter.meter, {})) for meter in report.meters)
    site.service.tick(replace(report, meters=meters))
    page = site.open(size)
    expect(page.locator("#decision")).to_have_text("UNDECIDED")
    page.locator("#meters-box summary").click()
    wanted = {"H3": "doubtful", "H4": "unjudged", "H5": "unjudged", "H6": "unjudged", "H7": "ok"}
    words = {"doubtful": "doubtful", "unjudged": "not monitored", "ok": "consistent"}
    shapes = {}
    for name, key in wanted.items():
        spot = customer(page, name)
        expect(spot).to_have_attribute("data-status", key)
        expect(spot).to_have_attribute("aria-label", re.compile(f": {words[key]}, "))
        shapes[key] = spot.locator(".shape").get_attribute("d"), spot.locator(".sign").text_content()
        row = page.locator("#meters tr").filter(has=page.get_by_role("button", name=name, exact=True))
        expect(row).to_have_attribute("data-status", key)
        expect(row.locator(".state")).to_have_text(words[key])
        spot.hover()
        expect(page.locator("#tip .state")).to_have_text(words[key])
        spot.click()
        expect(page.locator("#detail-title")).to_have_text(name)
        expect(page.locator("#detail .state")).to_have_text(words[key])
    assert len(set(shapes.values())) == len(shapes)
    expect(page.locator("#legend")).to_contain_text("not monitored")
    # Without a verdict nothing tells who is honest, not even of those whose scores are small, or the busbar.
    busbar = BusbarMeterState(True, True, False, (), None, 231.0, 231.0, 0.0)
    states = [page.locator(f'#meters tr:has-text("{name}") .state') for name in ("H7", "substation")]
    texts = [(Cause.AMBIGUOUS, "not monitored"), (Cause.AGREEMENT, "consistent")]
    for k, (cause, word) in enumerate(texts, 1):
        site.service.tick(replace(site.village.report(T0 + k, cause=cause), busbar=busbar))
        for state in states:
            expect(state).to_have_text(word)


def test_limits_have_shapes(site: Site) -> None:
    site.tick(T0, 1, volts={"H1": 255.0, "H2": 206.0})
    page = site.open()
    expect(customer(page, "H1")).to_have_attribute("data-status", "high")
    expect(customer(page, "H2")).to_have_attribute("data-status", "low")
    shapes = {
        page.locator(f'#diagram .customer[data-status="{s}"] .shape').first.get_attribute("d")
        for s in ("high", "low", "ok")
    }
    assert len(shapes) == 3


@pytest.mark.canary("light")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_low_is_blue_and_high_is_orange(site: Site, scheme: str) -> None:
    site.tick(T0, 1, volts={"H1": 222.0, "H2": 230.94, "H3": 240.0})
    page = site.open(color_scheme=scheme, reduced_motion="reduce")  # no colour fades over
    expect(page.locator("#decision")).to_have_text("CLEAN")
    low, middle, high = (fill_of(page, name) for name in ("H1", "H2", "H3"))
    assert low[2] > low[0] + 60
    assert high[0] > high[2] + 60
    assert max(middle) - min(middle) < 30
    ticks = page.locator("#scale .tick b").all_text_contents()
    assert [float(text.removesuffix(" V")) for text in ticks] == pytest.approx(
        [230.94 * k for k in (0.9, 1, 1.1)], abs=0.06
    )
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (int(re.findall(r"\d+", background)[0]) < 60) is (scheme == "dark")


# -------------------------------------------------------------------- one customer


def test_a_customer_shows_what_its_meter_says_and_what_is_true(site: Site) -> None:
    site.tick(T0, 40)
    site.tick(T0 + 40, 5, lies={"H3": 9.0})
    page = site.open()
    box = customer(page, "H3")
    box.hover()
    report = site.service.report("village").meters[3]
    expect(page.locator("#tip")).to_contain_text(f"reported {report.v_volt_reported:.1f} V")
    expect(page.locator("#tip")).to_contain_text(f"reconstructed {report.v_volt_estimated:.1f} V")
    box.click()
    panel = page.locator("#detail-card")
    expect(panel).to_contain_text("suspect")
    expect(panel).to_contain_text(f"{report.v_volt_reported:.2f} V")
    expect(panel).to_contain_text(f"{report.v_volt_estimated:.2f} V")
    expect(panel).to_contain_text("+9.00 V")
    ratio = report.score / report.threshold
    expect(panel).to_contain_text(f"{ratio:.1f} times the threshold")
    # The trend goes back into the stored history, to before the page was opened.
    expect(panel.locator(".trend")).to_contain_text("44 s ago")
    site.tick(T0 + 45, 1)
    expect(panel).to_contain_text("of the threshold")
    page.locator("#unselect").click()
    expect(panel).to_be_hidden()


def test_a_tick_without_a_reconstruction_does_not_flatten_the_trend(site: Site) -> None:
    page = site.open()
    unknown = {"v_volt_estimated": None, "v_volt_std": None, "v2_pu_estimated": None}
    for k in range(4):
        report = site.village.report(T0 + k)
        blinded = tuple(replace(meter, **unknown) for meter in report.meters)
        site.service.tick(replace(report, meters=blinded) if k == 1 else report)
        expect(page.locator("#facts dd").nth(3)).to_have_text("–" if k == 1 else re.compile(r"\d"))
    customer(page, "H3").click()
    expect(page.locator(".trend")).to_contain_text("3 s ago")
    axis = page.locator(".trend .grid + .axis").all_text_contents()
    assert len(axis) == 3
    assert all(220 < float(text) < 240 for text in axis)


@pytest.mark.acceptance
def test_looking_again_makes_no_trend_longer_than_an_hour(site: Site) -> None:
    for k in range(900):
        site.tick(T0 + 10 * k)
    page = site.open()
    asked: list[str] = []
    page.on("request", lambda r: asked.append(r.url) if "/history?" in r.url else None)
    expect(page.locator("#decision")).to_have_text("CLEAN")
    for _ in range(3):
        customer(page, "H3").click()
        page.wait_for_timeout(300)
        expect(page.locator(".trend")).to_contain_text("60 min ago")
        page.locator("#unselect").click()
    customer(page, "H3").click()
    drawn = page.locator(".trend path.reported").get_attribute("d")
    assert len(re.findall("[ML]", drawn or "")) == 361
    assert len(asked) == 1


def test_what_is_told_at_the_pointer_follows_the_readings(site: Site) -> None:
    page = site.open()
    customer(page, "H3").hover()
    expect(page.locator("#tip")).to_be_hidden()
    for k, volts in enumerate((229.0, 227.0)):
        site.tick(T0 + k, volts={"H3": volts})
        expect(page.locator("#tip")).to_contain_text(f"reported {volts:.1f} V")


def test_the_diagram_works_by_keyboard(site: Site) -> None:
    site.tick(T0)
    page = site.open()
    expect(page.locator("#diagram .customer")).to_have_count(13)
    assert page.locator('#diagram .customer[tabindex="0"]').count() == 1
    page.locator('#diagram .customer[tabindex="0"]').focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    expect(page.locator("#detail-title")).to_have_text("H3")


def test_phases_of_meters_and_of_customers_without_one(site: Site) -> None:
    report = site.village.report(T0, lies={"H3": 9.0})
    buses = [replace(b, v_phases=(None, None, 219.5 if b.bus == "drop-5" else None)) for b in report.buses]
    site.village.customers[3]["phase"] = "b"
    site.village.customers.append({"customer": "X", "bus": "drop-5", "meter": None, "phase": "c"})
    site.service.tick(replace(report, buses=tuple(buses)))
    page = site.open()
    liar = page.locator('#diagram .customer[aria-label^="H3, phase b:"]')
    liar.hover()
    expect(page.locator("#tip")).to_contain_text("phase b")
    liar.click()
    expect(page.locator("#detail-card")).to_contain_text(" bus drop-3, phase b")
    expect(page.locator('#diagram .customer[aria-label*="X, phase c:"]')).to_have_attribute(
        "aria-label", re.compile("reconstructed 219.5 V")
    )
    # Balanced meters say nothing of phases.
    expect(customer(page, "H4")).to_have_count(1)


def test_all_meters_as_a_table_with_the_worst_first(site: Site) -> None:
    site.tick(T0, 1, lies={"H9": 8.0}, silent=("H2",))
    page = site.open()
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    page.locator("#meters-box summary").click()
    rows = page.locator("#meters tr")
    expect(rows).to_have_count(13)
    expect(rows.nth(0)).to_contain_text("H9")
    expect(rows.nth(0)).to_contain_text("suspect")
    expect(rows.nth(1)).to_contain_text("silent")
    rows.nth(0).locator("button").click()
    expect(page.locator("#detail-title")).to_have_text("H9")


# ------------------------------------------------------------ hostile and large


def test_ids_are_text_and_nothing_else(site_of: Callable[..., Site], village: type) -> None:
    evil = "\"><img src=x onerror=alert(1)><script>alert(2)</script>'"
    site = site_of(village("village", 13, evil))
    site.expected = "422"  # No file can call a meter like that, and the history says so.
    site.tick(T0, 4, lies={f"{evil}3": 9.0}, silent=(f"{evil}4",))
    page = site.open()
    expect(page.locator(".alarm")).to_have_count(2)
    page.locator('#diagram .customer[data-status="suspect"]').click()
    expect(page.locator("#detail-title")).to_have_text(f"{evil}3")
    page.locator("#meters-box summary").click()
    expect(page.locator("#meters tr")).to_have_count(13)
    page.locator("button.ack").first.click()
    assert page.locator("main img, dialog img, main script").count() == 0


@pytest.mark.canary("phone")
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_146_customers_can_be_told_apart(
    site_of: Callable[..., Site], village: type, size: dict[str, int]
) -> None:
    site = site_of(real(village, load("kerber-vorstadtnetz")))
    suspects = {site.village.meters[k]: 8.0 for k in range(0, 144, 3)}
    site.tick(T0, 1, lies=suspects, sag=0.3)
    page = site.open(size)
    expect(page.locator('#diagram .customer[data-status="suspect"]')).to_have_count(48)
    if page.locator("#branches").is_visible():
        page.locator("#branches").click()
    expect(page.locator("#diagram .customer")).to_have_count(146)
    while magnification(page) < 1.0:
        page.locator("#zoom-in").click()
    boxes = page.locator("#diagram .customer .shape").evaluate_all(
        "all => all.map(e => e.getBoundingClientRect()).map(r => [r.x, r.y, r.right, r.bottom])"
    )
    assert len(boxes) == 146
    for k, (a_left, a_top, a_right, a_bottom) in enumerate(boxes):
        assert a_right - a_left >= 13
        for b_left, b_top, b_right, b_bottom in boxes[:k]:
            assert a_right <= b_left or b_right <= a_left or a_bottom <= b_top or b_bottom <= a_top
    # Only the diagram scrolls sideways, never the page.
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_real_feeders_are_drawn_without_crossings(site: Site) -> None:
    page = site.open()
    layouts = [detail(load(name), 5.0)["layout"] for name in names()]
    draw = random.Random(7)
    for size in (1, 2, 5, 30, 80):
        parent = [None, *(draw.randrange(max(0, k - 6), k) for k in range(1, size))]
        layouts.append(
            {
                "buses": [f"b{k}" for k in range(size)],
                "parent": parent,
                "customers": [
                    {"customer": f"c{k}", "bus": f"b{draw.randrange(size)}", "meter": None}
                    for k in range(size)
                ],
            }
        )
    for layout in layouts:
        placed = page.evaluate("async l => (await import('/layout.js')).oneLine(l)", layout)
        tree = page.evaluate("async l => (await import('/layout.js')).contracted(l)", layout)
        spots = placed["customers"]
        named = sorted(c["customer"] for c in spots if c["customer"] is not None)
        assert named == list(range(len(layout["customers"])))
        cells = [(c["x"], c["row"]) for c in spots]
        assert len(set(cells)) == len(cells)
        for bus in placed["buses"]:
            cells += [(bus["x"], bus["row"])] if bus["bare"] else []
        drawn = {line["bus"] for line in placed["lines"]} | {c["bus"] for c in spots}
        drawn |= {fork["bus"] for fork in placed["forks"]} | set(placed["leftOut"])
        # Every other bus is a part of the line to a drawn one.
        parts = {k for bus in drawn for k in tree["through"][bus]}
        assert drawn | parts >= set(range(1, len(layout["buses"])))
        assert not {c["bus"] for c in layout["customers"]} & {layout["buses"][k] for k in placed["leftOut"]}
        for line in placed["lines"]:
            low, high = sorted((line["row0"], line["row"]))
            if line["x0"] > 0:  # a connector from row to row meets nothing on its way down
                assert not any(x == line["x0"] and low < row < high for x, row in cells)
            assert line["x"] >= line["x0"]
        # Two rows of one line never share a place.
        spans = [(b["row"], b["x"], b["to"]) for b in placed["buses"]]
        for k, (row, left, right) in enumerate(spans):
            assert not any(r == row and left <= b and a <= right for r, a, b in spans[:k])


def test_the_map_shows_real_places(site_of: Callable[..., Site], village: type) -> None:
    site = site_of(real(village, load("simbench-lv-rural1")))
    site.tick(T0, sag=0.3)
    page = site.open()
    expect(page.locator("#diagram .customer")).to_have_count(13)
    expect(page.locator('#view button[data-view="map"]')).to_have_attribute("aria-pressed", "true")
    expect(page.locator('#diagram .customer[aria-label*="reconstructed"]')).to_have_count(13)
    seen = page.locator("#diagram .customer").evaluate_all(
        "all => all.map(e => [e.ariaLabel.split(':')[0].split(' · ')[1], e.transform.baseVal[0].matrix])"
        ".map(([name, m]) => [name, m.e, m.f])"
    )
    layout = detail(load("simbench-lv-rural1"), 5.0)["layout"]
    xy = dict(zip(layout["buses"], layout["xy"], strict=True))
    bus = {known["customer"]: known["bus"] for known in layout["customers"]}
    x, y = np.array([[x, y] for _, x, y in seen]).T
    east, north = np.array([xy[bus[name]] for name, _, _ in seen]).T
    # The same plan but for scale and origin, north up: the screen counts downwards.
    scales = []
    for spot, place in ((x, east), (-y, north)):
        scale, origin = np.polyfit(place, spot, 1)
        np.testing.assert_allclose(spot, scale * place + origin, atol=0.01)
        scales.append(scale)
    assert scales[0] == pytest.approx(scales[1])
    assert scales[0] > 0


def test_closed_ties_are_drawn_in_both_views(site_of: Callable[..., Site], village: type) -> None:
    mesh = baran_wu()
    page = site_of(real(village, mesh)).open()
    page.locator('#view button[data-view="line"]').click()
    drawn = page.locator("#diagram path.tie")
    expect(drawn).to_have_count(5)
    boxes = [drawn.nth(k).bounding_box() for k in range(5)]
    frame = page.locator("#diagram svg").bounding_box()
    for box in boxes:
        assert frame["x"] <= box["x"]
        assert frame["y"] <= box["y"]
        assert box["x"] + box["width"] <= frame["x"] + frame["width"]
        assert box["y"] + box["height"] <= frame["y"] + frame["height"]
    page.locator('#view button[data-view="map"]').click()
    expect(drawn).to_have_count(5)
    # On the map a tie joins the places of its two buses: its size is their distance, in one scale.
    xy = np.array(mesh.xy)[mesh.ties]
    apart = np.abs(xy[:, 0] - xy[:, 1])
    size = np.array(drawn.evaluate_all("all => all.map(e => e.getBBox()).map(b => [b.width, b.height])"))
    np.testing.assert_allclose(size / size.max(), apart / apart.max(), atol=1e-3)


def test_two_nominal_voltages_have_one_scale(site_of: Callable[..., Site], village: type) -> None:
    """The same part of 20 kV and of 0.4 kV has the same colour, and each is beyond its own limit."""
    two = from_tables(stations.tables())
    parts = {"dairy": 0.96, "a1-east": 0.96, "quarry": 1.12, "b1-east": 1.12, "b2-west": 0.88}
    nothing = [None] * two.meters.size
    report = blind(two, tick_of(T0, tuple(nothing), None, ()), 1, Cause.AGREEMENT, "made up")
    nominal = two.customer_nominal[two.meters]
    meters = tuple(
        replace(
            meter,
            seen=True,
            score=0.0,
            threshold=0.01,
            v_volt_reported=float(volt * parts.get(meter.meter, 1.0)),
            v_volt_estimated=float(volt * parts.get(meter.meter, 1.0)),
            v_volt_std=0.1,
            v2_pu_estimated=parts.get(meter.meter, 1.0) ** 2,
            model_only=False,
        )
        for meter, volt in zip(report.meters, nominal, strict=True)
    )
    buses = tuple(
        BusState(bus, float(volt)) for bus, volt in zip(two.feeder.buses, two.nominal_volt, strict=True)
    )
    site = site_of(real(village, two))
    site.service.tick(
        replace(
            report,
            verdict=Decision.CLEAN,
            meters=meters,
            buses=buses,
            model_only=False,
            t_measured=T0,
        )
    )
    page = site.open(reduced_motion="reduce")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    assert fill_of(page, "dairy") == fill_of(page, "a1-east")
    wanted = {"quarry": "high", "b1-east": "high", "b2-west": "low", "dairy": "ok", "a1-east": "ok"}
    for name, status in wanted.items():
        expect(customer(page, name)).to_have_attribute("data-status", status)
    assert page.locator("#scale .tick b").all_text_contents() == ["0.900 pu", "1.000 pu", "1.100 pu"]
    expect(page.locator("#facts")).to_contain_text("0.880 – 1.120 pu")
    customer(page, "quarry").click()
    expect(page.locator("#detail")).to_contain_text("1.1200 pu")
    customer(page, "b2-west").click()
    expect(page.locator("#detail")).to_contain_text("203.23 V")
    expect(page.locator("#detail")).to_contain_text("0.8800 pu")


def test_a_link_leads_to_its_feeder(site_of: Callable[..., Site], village: type) -> None:
    site = site_of(village("village"), village("town", 4))
    site.service.tick(site.service.villages["town"].report(T0, cause=Cause.AMBIGUOUS))
    page = site.open(path="/#town")
    expect(page.locator("#feeder")).to_have_value("town")
    expect(page.locator("#decision")).to_have_text("UNDECIDED")
    page.select_option("#feeder", "village")
    expect(page.locator("#decision")).to_have_text("NO DATA")
    assert page.url.endswith("#village")


def test_the_feeder_chosen_last_is_shown_however_slow_the_first(
    site_of: Callable[..., Site], village: type
) -> None:
    site = site_of(village("village"), village("town", 4))
    site.tick(T0)
    page = site.open(path="/#village")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    asked: list[str] = []
    held: list[Route] = []
    page.on("request", lambda r: asked.append(r.url))

    def hold(route: Route) -> None:
        held.append(route)

    page.route(re.compile("/feeders/town$"), hold)
    with page.expect_request(re.compile("/feeders/town$")):
        page.select_option("#feeder", "town")
    with page.expect_request(re.compile("/feeders/village/stream$")):
        page.select_option("#feeder", "village")
    with page.expect_response(re.compile("/feeders/town$")):
        held[0].continue_()
    page.wait_for_timeout(300)
    expect(page.locator("#feeder")).to_have_value("village")
    expect(page.locator("#diagram .customer")).to_have_count(13)
    assert not any(url.endswith("/town/stream") for url in asked)
    site.tick(T0 + 1, lies={"H3": 9.0})
    expect(page.locator("#decision")).to_have_text("ATTACKED")


def test_nothing_comes_from_elsewhere() -> None:
    web = Path(__file__).parents[3] / "service" / "web"
    foreign = re.compile(r"https?://|(inner|outer)HTML|insertAdjacentHTML|document\.write|eval\(")
    for file in [*filter(Path.is_file, web.iterdir()), web / "swagger" / "open.js"]:
        text = file.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not foreign.search(text), file


@pytest.mark.canary("phone")
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_values_of_the_model_alone_do_not_look_measured(site: Site, size: dict[str, int]) -> None:
    def silence(t: float, measured: float | None) -> None:
        report = site.village.report(t, silent=tuple(site.village.meters), cause=Cause.TOO_FEW_METERS)
        meters = tuple(replace(meter, model_only=True) for meter in report.meters)
        buses = tuple(replace(bus, model_only=True) for bus in report.buses)
        site.service.tick(replace(report, meters=meters, model_only=True, buses=buses, t_measured=measured))

    silence(T0, None)
    page = site.open(size)
    link, decision = page.locator("#link"), page.locator("#decision")
    expect(link).to_have_text("no data yet")
    expect(decision).to_have_text("NO DATA")
    expect(page.locator("#facts")).to_contain_text("Reconstructed voltages–")
    expect(customer(page, "H3")).to_have_attribute("aria-label", re.compile("silent, model only"))
    expect(page.locator(".wire:not(.unknown)")).to_have_count(0)
    site.tick(T0 + 1)
    expect(link).to_have_text("live")
    expect(decision).to_have_text("CLEAN")
    expect(page.locator(".wire.unknown")).to_have_count(0)
    silence(T0 + 2, T0 + 1)
    expect(link).to_have_text(re.compile(r"no data since .*\d\d:\d\d:\d\d"))
    expect(link).to_have_attribute("data-state", "nodata")
    expect(page.locator("#reason")).to_contain_text("those of the model alone")
