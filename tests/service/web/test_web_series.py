"""Time series on the page: a real service, an attack, both sizes, light and dark."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route, expect

from feeders.model.site import load
from feeders.simulation.scenario import Scenario
from gridsec.attack import Bias
from service.cli.simulate import Pace, play
from service.store.series import BAND_STD
from tests.service.asking import T0
from tests.service.looking import PHONE, Site
from tests.service.running import FEEDER, InProcess, service, until

pytestmark = pytest.mark.browser

WIDE = {"width": 1400, "height": 900}
TICKS, ONSET = 100, 60
LIAR = 1
"""Index of the manipulated meter."""
DRAWN_MS = 500.0
"""Time limit of the path of 20 000 points on a busy machine, ms; an idle one takes about 14 ms."""


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[InProcess, list[str]]]:
    """A service that has seen an attack, and its meters."""
    site = load(FEEDER)
    calm = Scenario(duration_s=float(TICKS))
    bias = Bias(np.array([LIAR]), calm.start + ONSET, calm.start + 1e9, np.array([0.04]))
    with service(tmp_path_factory.mktemp("series"), clock="events") as running:
        attacked = replace(calm, attacks=(bias,))
        played = list(play(site, attacked, running.meters, Pace(float("inf"), ahead=3)))
        last = played[-1].t
        until(lambda: running.state().get("t", 0.0) >= last - 2.0, "the end")
        yield running, list(site.meter_ids)


@pytest.fixture
def opened(browser: Browser, live: tuple[InProcess, list[str]]) -> Iterator[Callable[..., Page]]:
    """Pages of the service; they may not complain."""
    pages, complaints = [], []

    def make(path: str = "", size: dict[str, int] | None = None, scheme: str = "light") -> Page:
        base = str(live[0].http.base_url).rstrip("/")
        context = browser.new_context(viewport=size or WIDE, color_scheme=scheme)  # type: ignore[arg-type]
        page = context.new_page()
        page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(f"{base}/{path}")
        pages.append(page)
        return page

    yield make
    for page in pages:
        page.context.close()
    assert complaints == []


def scale_of(page: Page, panel: int) -> Callable[[float], float]:
    """Voltage of a height in a panel, from the labels of its axis."""
    texts = page.locator("#series-chart .panel").nth(panel).locator("text.axis:not(.limit-name)").all()
    ticks = [
        (float(t.get_attribute("y") or 0) - 4.0, float((t.text_content() or "").split()[0])) for t in texts
    ]
    (y0, v0), (y1, v1) = ticks[0], ticks[-1]
    return lambda y: v0 + (y - y0) * (v1 - v0) / (y1 - y0)


def heights(page: Page, panel: int, kind: str) -> list[float]:
    path = page.locator(f"#series-chart .panel path.{kind}").nth(panel).get_attribute("d") or ""
    return [float(a or b) for a, b in re.findall(r"[ML]\d+ (-?[\d.]+)|V(-?[\d.]+)", path)]


def chosen_time(page: Page) -> tuple[float, float | None]:
    """Span and end of the address."""
    address = page.evaluate("location.href")
    found = dict(part.split("=") for part in address.partition("?")[2].split("&"))
    return float(found["span"]), float(found["until"]) if "until" in found else None


@pytest.mark.canary("desktop-light")
@pytest.mark.parametrize(
    ("size", "scheme"),
    [(WIDE, "light"), (WIDE, "dark"), (PHONE, "light"), (PHONE, "dark")],
    ids=["desktop-light", "desktop-dark", "phone-light", "phone-dark"],
)
def test_a_suspect_compared_with_its_reconstruction(
    opened: Callable[..., Page], live: tuple[InProcess, list[str]], size: dict[str, int], scheme: str
) -> None:
    running, meters = live
    liar, other = meters[LIAR], meters[0]
    state = running.state()
    assert (state["displayed"]["verdict"], state["displayed"]["suspects"]) == ("attacked", [liar])
    assert state["displayed"]["since"] >= state["t"] - TICKS + ONSET
    page = opened("", size, scheme)
    page.locator("#alarm-box > summary").click()
    page.locator('.alarm:has-text("Meter manipulated") button:has-text("Time series")').first.click()
    expect(page.locator("#series-title")).to_be_focused()
    expect(page.locator("#series-chart .panel")).to_have_count(1)
    assert page.url.partition("#")[2].startswith(f"{FEEDER}?series={liar}&span=")
    page.select_option("#series-add", other)
    expect(page.locator("#series-chart .panel")).to_have_count(2)
    page.locator('#series-spans [data-span="3600"]').click()
    expect(page.locator('#series-spans [data-span="3600"]')).to_have_attribute("aria-pressed", "true")
    expect(page.locator("#series-state")).to_contain_text("local time, following")
    # The drawing has the numbers of the service, by the labels of its axis.
    end = running.state()["t"] + 0.5
    found = running.get(
        f"/api/v1/feeders/{FEEDER}/series", meter=[liar, other], since=end - 3600.0, until=end
    )
    for k, one in enumerate(found["meters"]):
        volt = scale_of(page, k)
        for kind in ("reported", "estimated", "band"):
            drawn = [volt(y) for y in heights(page, k, kind)]
            low, high = (one[f"v_volt_{kind}_{side}"] for side in ("min", "max"))
            assert min(drawn) == pytest.approx(min(v for v in low if v is not None), abs=0.05)
            assert max(drawn) == pytest.approx(max(v for v in high if v is not None), abs=0.05)
    off = heights(page, 0, "reported"), heights(page, 0, "estimated")
    assert scale_of(page, 0)(min(off[0])) - scale_of(page, 0)(min(off[1])) > 5.0
    assert page.locator("#series-chart path.named").nth(0).get_attribute("d")
    assert not page.locator("#series-chart path.named").nth(1).get_attribute("d")
    for verdict in ("attacked", "clean"):
        assert page.locator(f"#series-chart .verdicts.{verdict}").get_attribute("d")
    expect(page.locator("#series-chart .alarm-span.critical.own title")).to_contain_text("meter-manipulated")
    # The table has both meters, and the alarm.
    page.locator("#series-table").click()
    rows = page.locator("#series-rows tr")
    expect(rows.nth(3)).to_be_visible()
    expect(rows.filter(has_text="attacked").filter(has_text=liar).last).to_contain_text("suspect")
    expect(page.locator("#series-alarms li").first).to_contain_text("meter-manipulated")
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    # Text has contrast in both schemes.
    colours = page.evaluate(
        """() => {
            const style = (s) => getComputedStyle(document.querySelector(s));
            const chart = ['.meter-name', '.axis'].map((s) => style('#series-chart ' + s).fill);
            return [...chart, style('.series').backgroundColor];
        }"""
    )
    ink, axis, ground = (sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in colours)
    assert abs(ink - ground) > 450
    assert abs(axis - ground) > 250
    # The address keeps the choice.
    page.reload()
    expect(page.locator("#series-chart .panel")).to_have_count(2)
    expect(page.locator("#series-meters .chip")).to_have_count(2)
    page.locator("#series-close").click()
    expect(page.locator("#series")).to_be_hidden()
    assert page.url.endswith(f"#{FEEDER}")


@pytest.mark.acceptance
def test_zoom_by_pointer_and_keyboard(opened: Callable[..., Page], live: tuple[InProcess, list[str]]) -> None:
    running, meters = live
    page = opened(f"#{FEEDER}?series={meters[LIAR]}&span=3600")
    expect(page.locator("#series-chart .panel")).to_have_count(1)
    assert chosen_time(page) == (3600.0, None)
    box = page.locator("#series-chart .frame").bounding_box()
    assert box is not None
    y, end = box["y"] + 40.0, running.state()["t"] + 0.5
    page.mouse.move(box["x"] + 0.5 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], y, steps=4)
    page.mouse.up()
    expect(page.locator("#series-state")).not_to_contain_text("following")
    span, until_t = chosen_time(page)
    assert span == pytest.approx(900.0, abs=5.0)
    assert until_t == pytest.approx(end - 900.0, abs=5.0)
    page.locator("#series-chart").focus()
    page.keyboard.press("+")
    assert chosen_time(page)[0] == pytest.approx(450.0, abs=3.0)
    before = chosen_time(page)[1] or 0.0
    page.keyboard.press("ArrowLeft")
    assert (chosen_time(page)[1] or 0.0) == pytest.approx(before - 112.5, abs=3.0)
    page.keyboard.press("End")
    assert chosen_time(page) == (3600.0, None)
    # The numbers at the pointer.
    page.mouse.move(box["x"] + box["width"] - 3.0, y)
    tip = page.locator(".series-tip")
    expect(tip).to_contain_text("attacked")
    expect(tip).to_contain_text(
        re.compile(
            rf"{meters[LIAR]} · LV1\.101 Load 2 reported 2\d\d\.\d\d V, reconstructed 2\d\d\.\d\d V \(band"
        )
    )
    page.locator("#series-out").click()
    assert chosen_time(page) == (7200.0, None)
    page.locator('#series-spans [data-span="1209600"]').click()
    expect(page.locator("#series-out")).to_be_disabled()
    expect(page.locator("#series-state")).to_contain_text("per point")
    # From a meter's details.
    page.locator("#series-close").click()
    page.locator(f"#chips .chip:has-text('{meters[LIAR]}')").click()
    page.locator("#detail-series").click()
    expect(page.locator("#series-meters .chip")).to_contain_text(meters[LIAR])


def test_two_fingers_zoom_and_move_and_a_touchpad_does(site: Site) -> None:
    site.tick(T0, 30)
    page = site.open(PHONE, "/#village?series=H3&span=3600&until=1795212000", has_touch=True)
    expect(page.locator("#series-chart .panel")).to_have_count(1)
    page.locator("#series-chart").scroll_into_view_if_needed()
    frame = page.locator("#series-chart .frame").bounding_box()
    assert frame is not None
    left, width, y = frame["x"], frame["width"], frame["y"] + 0.5 * frame["height"]
    session = page.context.new_cdp_session(page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        at = [{"x": x, "y": up, "id": k} for k, (x, up) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    def two(apart: tuple[float, ...], middle: tuple[float, ...], slant: float = 0.0) -> None:
        """Shares of the width; `slant` moves one finger down, px."""
        for k, (d, m) in enumerate(zip(apart, middle, strict=True)):
            places = [(left + (m - 0.5 * d) * width, y), (left + (m + 0.5 * d) * width, y + slant)]
            touch("touchMove" if k else "touchStart", *places)
        touch("touchEnd")

    # Twice the distance halves the span, and the time at the middle of the fingers stays there.
    two((0.2, 0.3, 0.4), (0.25, 0.25, 0.25))
    span, end = chosen_time(page)
    assert span == pytest.approx(1800.0, rel=0.02)
    assert (end or 0.0) - 0.75 * span == pytest.approx(T0 - 2700.0, abs=30.0)
    # Two fingers side by side move the chart, upright ones too; one finger up or down does nothing.
    two((0.3, 0.3, 0.3), (0.5, 0.6, 0.75))
    moved, after = chosen_time(page)
    assert moved == pytest.approx(span, rel=0.02)
    assert (end or 0.0) - (after or 0.0) == pytest.approx(0.25 * span, rel=0.05)
    two((0.0, 0.0), (0.5, 0.4), slant=60.0)
    assert (chosen_time(page)[1] or 0.0) - (after or 0.0) == pytest.approx(0.1 * span, rel=0.1)
    before = chosen_time(page)
    touch("touchStart", (left + 50, y))
    touch("touchMove", (left + 50, y + 40))
    touch("touchEnd")
    assert chosen_time(page) == before
    # Not beyond the present; the pinch of a touchpad is a wheel with Ctrl.
    page.locator("#series-chart").focus()
    page.keyboard.press("0")
    assert chosen_time(page)[1] is None
    page.mouse.move(left + 0.5 * width, y)
    page.keyboard.down("Control")
    page.mouse.wheel(0, -60)
    page.keyboard.up("Control")
    expect(page).not_to_have_url(re.compile("span=3600"))
    span, end = chosen_time(page)
    assert 1500.0 < span < 2500.0
    page.mouse.wheel(-64, 0)
    expect(page).not_to_have_url(re.compile(rf"until={end:.0f}$"))
    assert chosen_time(page)[0] == pytest.approx(span, rel=0.02)
    assert (end or 0.0) - (chosen_time(page)[1] or 0.0) == pytest.approx(0.25 * span, rel=0.05)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]


def test_a_gesture_during_a_load_keeps_its_range(site: Site) -> None:
    """The response of an earlier choice does not move the axis under the fingers."""
    site.tick(T0, 30)
    page = site.open(WIDE, "/#village?series=H3&span=3600&until=1795212000")
    expect(page.locator("#series-chart .panel")).to_have_count(1)
    page.locator("#series-chart").scroll_into_view_if_needed()
    frame = page.locator("#series-chart .frame").bounding_box()
    assert frame is not None
    held: list[Route] = []
    page.route("**/series?*", lambda route: route.continue_() if held else held.append(route))
    page.click("#series-out")  # 7 200 s
    until(lambda: page.evaluate("1") and held, "the request of the longer span")
    page.mouse.move(frame["x"] + 0.5 * frame["width"], frame["y"] + 0.5 * frame["height"])
    page.keyboard.down("Control")
    page.mouse.wheel(0, -60)
    page.keyboard.up("Control")
    held[0].continue_()
    expect(page).not_to_have_url(re.compile("span=7200"))
    span, _ = chosen_time(page)
    assert 3000.0 < span < 5000.0
    expect(page.locator("#series-chart .panel")).to_have_count(1)


def test_a_choice_that_does_not_exist_is_left_out(site: Site) -> None:
    site.tick(T0, 3)
    page = site.open(path="/#village?series=H3,zzz,<b>,H5&span=-5&until=x")
    expect(page.locator("#series-meters .chip")).to_have_count(2)
    assert chosen_time(page) == (3600.0, None)
    expect(page.locator("#series-chart .panel")).to_have_count(2)
    # Six meters at most, then none.
    for meter in ("H0", "H1", "H2", "substation"):
        page.select_option("#series-add", meter)
    expect(page.locator("#series-add")).to_be_disabled()
    expect(page.locator("#series-chart .panel")).to_have_count(6)
    for left in (5, 4, 3, 2, 1):
        page.locator("#series-meters .chip").first.click()
        expect(page.locator("#series-meters .chip")).to_have_count(left)
    page.locator("#series-meters .chip").first.click()
    expect(page.locator("#series")).to_be_hidden()


def test_one_column_per_pixel_keeps_every_extreme(site: Site) -> None:
    """20 000 points become at most one line per pixel column, with the same extremes; gaps stay gaps."""
    page = site.open()
    draw = np.random.default_rng(1)
    t = np.delete(np.arange(20_000.0), slice(9_000, 11_000))
    values = draw.normal(230.0, 1.0, t.size)
    script = """async ([t, v]) => {
        const { columns, line } = await import("/series.js");
        const scale = { x: (s) => s / 20, gap: 100 };
        line(columns(t, v, v, scale), (u) => 300 - u);
        const begun = performance.now();
        const runs = columns(t, v, v, scale);
        const path = line(runs, (u) => 300 - u);
        return [performance.now() - begun, runs, path.length];
    }"""
    took, runs, length = page.evaluate(script, [t.tolist(), values.tolist()])
    assert took < DRAWN_MS
    assert len(runs) == 2
    assert all(b[0] > a[0] for run in runs for a, b in pairwise(run))
    assert length < 30 * 1000
    at = np.floor(t / 20.0 + 0.5)  # as `Math.round`
    wanted = [[x, values[at == x].min(), values[at == x].max()] for x in sorted({*at.tolist()})]
    assert [column for run in runs for column in run] == wanted
    print(f"20 000 points: {took:.1f} ms")


def test_round_values_and_round_times(site: Site) -> None:
    page = site.open(timezone_id="Europe/Berlin")
    script = """async ([since, until]) => {
        const { ticks, times } = await import("/series.js");
        return [ticks(229.2, 238.9, 5), times(since, until, 8)];
    }"""
    # The day of the change to winter time has 25 hours; labels stay at hours of the clock.
    marks, found = page.evaluate(script, [1_792_900_800 - 86_400, 1_792_900_800 + 86_400])
    assert marks == {"found": [230, 232, 234, 236, 238], "digits": 0}
    hours = page.evaluate("(ts) => ts.map((t) => new Date(t * 1000).getHours())", found["found"])
    assert found["step"] == 21_600
    assert {hour % 6 for hour in hours} == {0}
    assert BAND_STD == 3.0  # as in the legend
