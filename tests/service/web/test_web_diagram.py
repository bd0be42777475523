"""Drawing of a feeder: collapsed branches, zoom and pan, labels of suspects, colour scale, phones."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from feeders.model.site import load, names
from service.report.feeder_info import detail
from service.report.report import device_name
from tests.service.asking import T0
from tests.service.looking import DESKTOP, PHONE, Site, customer

pytestmark = pytest.mark.browser

SIZES = pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
SCHEMES = pytest.mark.parametrize("scheme", ["light", "dark"])
BUILD_S = 2.0
"""Time limit of a layout of 1 000 buses on a busy machine, s."""
FITTED = """async ([l, choices]) => {
    const { fitted } = await import('/layout.js');
    return choices.map(([shown, columns, rows]) => fitted(
        l, (grid) => grid.columns <= columns && grid.rows <= rows, new Set(shown)));
}"""


def real(village: type, name: str) -> Any:
    """A village with the tree, the places and the meters of a real feeder."""
    known = detail(load(name), 5.0)
    layout = known["layout"]
    made = village(name, 0)
    made.detail = lambda: known
    made.buses, made.parent = layout["buses"], layout["parent"]
    made.customers = [c for c in layout["customers"] if c["meter"]]
    made.meters = [c["meter"] for c in made.customers]
    return made


def tree(count: int, seed: int) -> dict[str, Any]:
    """A random tree with a customer at most of its buses."""
    draw = random.Random(seed)
    parent = [None, *(draw.randrange(max(0, k - 9), k) for k in range(1, count))]
    at = sorted(draw.sample(range(count), 4 * count // 5))
    return {
        "buses": [f"b{k}" for k in range(count)],
        "parent": parent,
        "customers": [{"customer": f"c{k}", "bus": f"b{k}", "meter": f"m{k}"} for k in at],
    }


def box(found: Locator) -> dict[str, float]:
    size = found.bounding_box()
    assert size is not None
    return dict(size)


def within(inner: dict[str, float], outer: dict[str, float]) -> bool:
    return (
        inner["x"] >= outer["x"] - 1
        and inner["y"] >= outer["y"] - 1
        and inner["x"] + inner["width"] <= outer["x"] + outer["width"] + 1
        and inner["y"] + inner["height"] <= outer["y"] + outer["height"] + 1
    )


def view(page: Page) -> tuple[float, float, float]:
    """Magnification and origin of the drawing."""
    page.wait_for_timeout(60)
    k, dx, dy = page.locator("#diagram .world").evaluate(
        "g => { const m = g.transform.baseVal.consolidate().matrix; return [m.a, m.e, m.f]; }"
    )
    return k, dx, dy


# ------------------------------------------------------------------ the layout


@pytest.mark.canary("small")
@pytest.mark.parametrize("which", ["small", "large", "real"])
def test_suspects_never_collapse_and_each_customer_has_one_place(site: Site, which: str) -> None:
    page = site.open()
    sizes = {"small": (1, 2, 7, 40, 200), "large": (1000,), "real": ()}[which]
    layouts = [tree(count, seed) for seed, count in enumerate(sizes)]
    if which == "real":
        layouts = [detail(load(name), 5.0)["layout"] for name in (*names(), "ieee-european-lv")]
    draw = random.Random(1)
    for layout in layouts:
        every = range(len(layout["customers"]))
        sets = ([], draw.sample(every, min(3, len(every))), list(every))
        choices = [*((shown, 30, 8) for shown in (*sets, *sets)), ([], 1e9, 1e9)]
        made = page.evaluate(FITTED, [layout, choices])
        assert made[:3] == made[3:6]
        assert made[6]["stubs"] == []
        for shown, grid in zip(sets, made[:3], strict=True):
            drawn = [c["customer"] for c in grid["customers"] if c["customer"] is not None]
            hidden = [k for stub in grid["stubs"] for k in stub["customers"]]
            assert sorted([*drawn, *hidden]) == list(every)
            assert {*shown} <= {*drawn}
            assert all(len(stub["customers"]) >= 2 for stub in grid["stubs"])
            if len(shown) < len(every):
                assert grid["columns"] <= 30
                assert grid["rows"] <= 8
            # No two things share a place; a stub takes two steps.
            cells = [(c["x"], c["row"]) for c in grid["customers"]]
            cells += [(stub["x"] + k, stub["row"]) for stub in grid["stubs"] for k in (0, 1)]
            assert len({*cells}) == len(cells)


@pytest.mark.acceptance
def test_a_thousand_buses_are_laid_out_in_time(site: Site) -> None:
    page = site.open()
    shown = [3, 400, 777]
    times = page.evaluate(
        """async ([l, shown]) => {
            const { onePlaces } = await import('/places.js');
            return [1, 2, 3].map(() => {
                const begun = performance.now();
                onePlaces(l, { width: 860, height: 500 }, { shown: new Set(shown), whole: false });
                return (performance.now() - begun) / 1000;
            });
        }""",
        [tree(1000, 3), shown],
    )
    assert min(times) < BUILD_S


# ------------------------------------------------------------- real feeders


@pytest.mark.canary("ieee-european-lv-light-phone")
@SIZES
@SCHEMES
@pytest.mark.parametrize("name", ["ieee-european-lv", "simbench-lv-rural3"])
def test_suspects_of_a_real_feeder_are_in_the_window(
    site_of: Callable[..., Site], village: type, name: str, scheme: str, size: dict[str, int]
) -> None:
    site = site_of(real(village, name))
    lies = {site.village.meters[k]: 9.0 - 3.0 * k for k in (0, 7, 30, 31)}
    site.tick(T0, 4, lies=lies, sag=0.02)
    page = site.open(size, color_scheme=scheme)
    expect(page.locator("#decision")).to_have_text("ATTACKED")
    expect(page.locator('#view button[data-view="map"]')).to_have_attribute("aria-pressed", "true")
    for chosen in ("map", "line"):
        page.locator(f'#view button[data-view="{chosen}"]').click()
        suspects = page.locator('#diagram .customer[data-status="suspect"]')
        expect(suspects).to_have_count(4)
        view(page)
        frame = box(page.locator("#diagram svg"))
        assert frame["width"] <= size["width"]
        assert frame["height"] <= 0.7 * size["height"]
        for mark in suspects.locator(".shape").all():
            assert within(box(mark), frame)
        texts = [text.split("·")[0] for text in suspects.locator(".note").all_text_contents()]
        assert sorted(texts) == sorted(f"{m}{v:+.1f}".replace("-", "−") for m, v in lies.items())
        labels = [box(label) for label in suspects.locator(".note").all()]
        for a, b in itertools.combinations(labels, 2):
            apart = a["x"] + a["width"] <= b["x"] + 2 or b["x"] + b["width"] <= a["x"] + 2
            assert apart or a["y"] + a["height"] <= b["y"] + 4 or b["y"] + b["height"] <= a["y"] + 4
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    # Alarms come before the drawing on a phone, beside it on a desk.
    alarms, card = box(page.locator(".alarms")), box(page.locator(".card.map"))
    first = alarms["y"] + alarms["height"] <= card["y"] if size is PHONE else alarms["x"] > card["x"]
    assert first


# --------------------------------------------------- branches, zoom and pan


@pytest.mark.acceptance
def test_quiet_branches_collapse_open_and_close(site_of: Callable[..., Site], village: type) -> None:
    site = site_of(village("village", 200))
    site.tick(T0)
    page = site.open()
    spots, stubs = page.locator("#diagram .customer"), page.locator("#diagram .stub")
    # Branches that do not fit begin closed: 20 of 10 customers each.
    expect(stubs).to_have_count(20)
    site.tick(T0 + 1, lies={"H25": 9.0}, silent=("H21",))
    expect(stubs).to_have_count(21)
    expect(spots).to_have_count(1)
    expect(customer(page, "H25").locator(".note")).to_have_text("H25+9.0")
    silent = page.locator('#diagram .stub[data-status="silent"]')
    expect(silent).to_have_attribute(
        "aria-label",
        "Collapsed branch: 5 customers, 4 consistent, 1 silent, reconstructed 227.6 V to 230.3 V",
    )
    expect(silent).to_have_text("▸ 5?")
    silent.hover()
    expect(page.locator("#tip")).to_contain_text("Collapsed branch, 5 customers")
    # A second suspect opens its branch, which stays open for a minute.
    site.tick(T0 + 2, lies={"H25": 9.0, "H133": -8.0})
    expect(customer(page, "H133")).to_have_attribute("data-status", "suspect")
    site.tick(T0 + 30, lies={"H25": 9.0})
    expect(customer(page, "H133")).to_have_attribute("data-status", "ok")
    site.tick(T0 + 90, lies={"H25": 9.0})
    expect(customer(page, "H133")).to_have_count(0)
    # By keyboard: the neighbour of the suspect is a stub; Enter expands it, and the focus is inside.
    customer(page, "H25").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    expect(customer(page, "H26")).to_be_focused()
    expect(spots).to_have_count(5)
    page.locator("#branches").click()
    expect(spots).to_have_count(200)
    expect(page.locator("#branches")).to_have_text("Collapse quiet branches")
    page.locator("#branches").click()
    expect(spots).to_have_count(1)
    # The table leads to a customer in a collapsed branch.
    page.locator("#meters-box summary").click()
    page.get_by_role("button", name="H77", exact=True).click()
    expect(customer(page, "H77")).to_have_class("customer selected")


def test_wheel_drag_keys_and_buttons_move_the_view(site: Site) -> None:
    site.tick(T0, lies={"H3": 9.0})
    page = site.open()
    expect(customer(page, "H3")).to_have_attribute("data-status", "suspect")
    home = view(page)
    frame = box(page.locator("#diagram svg"))
    place = box(customer(page, "H3").locator(".shape"))
    x, y = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    page.mouse.move(x, y)
    page.mouse.wheel(0, -400)
    assert view(page)[0] > 1.5 * home[0]
    # The point under the pointer stays, and the symbol keeps its size.
    after = box(customer(page, "H3").locator(".shape"))
    assert after["x"] + after["width"] / 2 == pytest.approx(x, abs=2)
    assert after["y"] + after["height"] / 2 == pytest.approx(y, abs=2)
    assert after["width"] < 1.6 * place["width"]
    before = view(page)
    page.mouse.down()
    page.mouse.move(x - 90, y - 30, steps=4)
    page.mouse.up()
    assert view(page)[1:] == pytest.approx((before[1] - 90, max(before[2] - 30, view(page)[2])), abs=2)
    expect(page.locator("#detail-card")).to_be_hidden()  # A drag is not a click.
    for _ in range(6):
        page.locator("#zoom-in").click()
    page.mouse.move(frame["x"] + 200, frame["y"] + 200)
    page.mouse.down()
    page.mouse.move(frame["x"] - 900, frame["y"] + 200, steps=4)
    page.mouse.up()
    expect(page.locator("#outside")).to_have_text("1 suspect outside of the view: show")
    # New states leave the operator's view alone.
    held = view(page)
    site.tick(T0 + 1, lies={"H3": 9.0})
    expect(page.locator("#facts")).to_contain_text("10:00:01")
    assert view(page) == pytest.approx(held)
    page.locator("#outside").click()
    assert view(page) == pytest.approx(home)
    expect(page.locator("#zoom-out")).to_be_disabled()
    page.locator('#diagram .customer[tabindex="0"]').focus()
    page.keyboard.press("+")
    page.keyboard.press("+")
    closer = view(page)
    assert closer[0] == pytest.approx(home[0] * 1.35**2, rel=1e-3)
    page.keyboard.press("Shift+ArrowRight")
    assert view(page)[1] == pytest.approx(closer[1] - 60)
    page.keyboard.press("0")
    assert view(page) == pytest.approx(home)


@pytest.mark.acceptance
def test_two_fingers_zoom_and_one_finger_scrolls_the_page(site: Site) -> None:
    site.tick(T0, lies={"H3": 9.0})
    page = site.open(PHONE, has_touch=True)
    expect(customer(page, "H3")).to_have_attribute("data-status", "suspect")
    page.locator("#diagram").scroll_into_view_if_needed()
    home, frame = view(page), box(page.locator("#diagram svg"))
    x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    fingers = page.context.new_cdp_session(page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        at = [{"x": px, "y": py, "id": k} for k, (px, py) in enumerate(points)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    touch("touchStart", (x - 20, y), (x + 20, y))
    for apart in range(20, 61, 10):
        touch("touchMove", (x - apart, y), (x + apart, y))
    touch("touchEnd")
    assert view(page)[0] == pytest.approx(3.0 * home[0], rel=0.05)
    scrolled = page.evaluate("scrollY")
    touch("touchStart", (x, y))
    for far in range(0, 121, 20):
        touch("touchMove", (x, y + far))
    touch("touchEnd")
    page.wait_for_timeout(200)
    assert page.evaluate("scrollY") < scrolled


# ------------------------------------------------------------ colours and names


def seen_by(rgb: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """CIELAB of a colour as a colour-blind person sees it."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(matrix @ linear, 0.0, 1.0)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    t = to_xyz @ linear / np.array([0.9505, 1.0, 1.089])
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


# Machado, Oliveira, Fernandes (2009), severity 1: normal sight, protanopia, deuteranopia.
SIGHT = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


@pytest.mark.canary("dark")
@SCHEMES
def test_colours_follow_the_limits_and_can_be_told_apart(site: Site, scheme: str) -> None:
    site.tick(T0, volts={"H1": 222.0, "H2": 240.0, "H3": 206.0, "H4": 255.0})
    page = site.open(color_scheme=scheme, reduced_motion="reduce")
    expect(page.locator("#decision")).to_have_text("CLEAN")
    shapes = {name: customer(page, name).locator(".shape") for name in ("H1", "H2")}
    fills = {name: shape.evaluate("e => e.style.fill") for name, shape in shapes.items()}
    # Another range of the readings changes no colour.
    site.tick(T0 + 1, volts={"H1": 222.0, "H2": 240.0})
    expect(customer(page, "H3")).to_have_attribute("data-status", "ok")
    assert fills == {name: shape.evaluate("e => e.style.fill") for name, shape in shapes.items()}
    assert page.locator("#scale .tick").all_text_contents() == [
        "207.8 Vlow limit, 0.900 pu",
        "230.9 Vnominal, 1.000 pu",
        "254.0 Vhigh limit, 1.100 pu",
    ]
    bar, mark = box(page.locator("#scale .bar")), box(page.locator("#scale .present"))
    assert 0.05 < mark["width"] / bar["width"] < 0.6
    tones = ("below", "low2", "low1", "mid", "high1", "high2", "above")
    colours = [
        page.evaluate("n => getComputedStyle(document.documentElement).getPropertyValue('--v-' + n)", name)
        for name in tones
    ]
    rgb = [np.array([int(c.strip()[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0 for c in colours]
    for matrix in SIGHT.values():
        lab = [seen_by(colour, matrix) for colour in rgb]
        for k, m in itertools.combinations(range(len(tones)), 2):
            assert np.linalg.norm(lab[k] - lab[m]) > 12.0, (tones[k], tones[m])


def test_one_name_of_a_meter_on_the_whole_page(site_of: Callable[..., Site], village: type) -> None:
    site = site_of(real(village, "simbench-lv-rural1"))
    name = "m04 · LV1.101 Load 4"
    for k in range(4):
        report = site.village.report(T0 + k, lies={"m04": 9.0})
        owners = {c["meter"]: c["customer"] for c in site.village.customers}
        meters = tuple(replace(meter, customer=owners[meter.meter]) for meter in report.meters)
        site.service.tick(replace(report, meters=meters))
    page = site.open()
    pairs = [("m04", "Load 3"), ("m04", "3"), ("H3", "H3"), ("m1", "LV1.101 Load 3"), ("substation", "")]
    said = page.evaluate(
        "async all => { const d = await import('/dom.js'); return all.map(([m, c]) => d.deviceName(m, c)); }",
        pairs,
    )
    assert said == [device_name(*pair) for pair in pairs]
    assert device_name("m04", "3") == "m04 · customer 3"
    expect(page.locator(".chip")).to_have_text(f"{name} +9.0 V")
    expect(page.locator(".alarm .where")).to_have_text(f"{name} · simbench-lv-rural1")
    line = page.locator(".incident .line")
    expect(line.locator(".place")).to_have_text(f"simbench-lv-rural1 · {name}")
    line.click()
    expect(page.locator(".incident .reason")).to_contain_text(f"{name} ")
    expect(page.locator(".incident .alarm .where")).to_have_text(f"{name} · simbench-lv-rural1")
    line.press("s")
    scopes = page.locator("#act-scope option")
    expect(scopes.nth(1)).to_have_text(f"all of {name}")
    page.locator("#act-cancel").click()
    line.click()
    page.locator("button.ack").click()
    expect(page.locator("#act-what")).to_contain_text(f"Meter manipulated: {name}. reports")
    page.locator("#act-cancel").click()
    customer(page, name).locator(".hit").hover()
    expect(page.locator("#tip b")).to_have_text(name)
    customer(page, name).locator(".hit").click()
    expect(page.locator("#detail-title")).to_have_text(name)
    page.locator("#meters-box summary").click()
    expect(page.locator("#meters tr").first.locator("th")).to_have_text(name)
    page.locator("#detail-series").click()
    expect(page.locator(".series-plot .meter-name")).to_have_text(name)
    expect(page.locator(".alarm-span title").first).to_contain_text(f"meter-manipulated, {name}: ")
    page.locator(".series-plot").hover()
    expect(page.locator(".series-tip span b")).to_have_text(name)
