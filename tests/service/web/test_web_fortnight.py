"""Time series of 14 days on the page, over HTTP from stored rows, with the change to winter time in them."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from service.store import Store
from service.store.series import pack
from tests.service.looking import DESKTOP, PHONE, Site

pytestmark = pytest.mark.browser

DAY_S = 86_400.0
END = 1_793_404_800.0
"""2026-10-31 00:00 UTC, Unix s. Six days before, Central Europe changes to winter time."""
BEGIN = END - 14 * DAY_S
ATTACKED = (BEGIN + 4 * DAY_S, BEGIN + 5 * DAY_S)
RESPONSE_S = 10.0
"""Time limit of the response with 14 days on a busy machine, s."""


def fill(path: Path, village: Any, step_s: float) -> None:
    """Store 14 days with a row every `step_s`; H3 is manipulated on one of them."""
    calm, attacked = (village.report(BEGIN, lies=lies) for lies in ({}, {"H3": 9.0}))
    packed = [pack(one.row) for one in (calm, attacked)]
    with Store(f"sqlite:///{path}") as store:
        store.commit(reports=[calm])
    with closing(sqlite3.connect(path)) as connection, connection:
        times = [BEGIN + step_s * k for k in range(1, int((END - BEGIN) / step_s))]
        connection.executemany(
            "INSERT INTO history VALUES ('village', ?, ?, ?, 1, ?)",
            (
                (t, "attacked", "residuals", packed[1])
                if ATTACKED[0] <= t < ATTACKED[1]
                else (t, "clean", "agreement", packed[0])
                for t in times
            ),
        )
    with Store(f"sqlite:///{path}") as store:
        t = END
        while store._rolled.get("village", 0.0) < END - step_s:
            store.commit(reports=[village.report(t)])
            t += 10.0


def labels(page: Page) -> list[tuple[str, float]]:
    """Texts of the time axis and their places, px."""
    found = page.locator("#series-chart svg > text.axis").evaluate_all(
        "all => all.map(e => [e.textContent, Number(e.getAttribute('x')), Number(e.getAttribute('y'))])"
    )
    lowest = max(y for _, _, y in found)
    return [(text, x) for text, x, y in found if y == lowest and text != "local"]


@pytest.mark.canary("7200 s")
@pytest.mark.parametrize("step_s", [7200.0, 10.0], ids=["7200 s", "10 s"])
def test_fourteen_days_with_the_change_to_winter_time(
    site_of: Callable[..., Site], village: Callable[..., Any], tmp_path: Path, step_s: float
) -> None:
    made = village("village")
    fill(tmp_path / "service-0.db", made, step_s)
    site = site_of(made)
    site.tick(END + DAY_S)
    page = site.open(
        DESKTOP, f"/#village?series=H3&span={14 * DAY_S:.0f}&until={END:.0f}",
        timezone_id="Europe/Berlin", locale="en-GB",
    )  # fmt: skip
    expect(page.locator("#series-chart .panel")).to_have_count(1)
    took_s = page.evaluate(
        "performance.getEntriesByType('resource').find((e) => e.name.includes('/series?')).duration / 1000"
    )
    assert took_s < RESPONSE_S
    # One label for each midnight of the clock; the 25 October has 25 hours.
    days = [(text, x) for text, x in labels(page) if re.fullmatch(r"\d+ Oct", text)]
    assert [text for text, _ in days] == [f"{k} Oct" for k in range(18, 32)][: len(days)]
    apart = {text: b - a for (text, a), (_, b) in pairwise(days)}
    ordinary = apart.pop("24 Oct")
    assert apart.pop("25 Oct") == pytest.approx(25.0 / 24.0 * ordinary, rel=0.01)
    assert all(x == pytest.approx(ordinary, rel=0.01) for text, x in apart.items() if text != "30 Oct")
    assert page.locator("#series-chart .verdicts.attacked").get_attribute("d")
    # Around the change, labels stay at even hours of the clock.
    page.goto(f"{site.server.url}/#village?series=H3&span=172800&until={END - 4.5 * DAY_S:.0f}")
    expect(page.locator("#series-state")).to_contain_text(re.compile("24 Oct.* to 26 Oct"))
    hours = [text for text, _ in labels(page) if re.fullmatch(r"\d\d:00", text)]
    assert len(hours) > 8
    assert {int(text[:2]) % 3 for text in hours} == {0}
    print(f"rows every {step_s:g} s: response {took_s:.2f} s")


def test_the_table_is_open_to_screen_readers_while_it_is_folded(site: Site) -> None:
    site.tick(BEGIN, 3)
    page = site.open(PHONE, "/#village?series=H3")
    expect(page.locator("#series-rows tr")).not_to_have_count(0)
    for unfolded in (False, True):
        tree = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
        shown = {(node.get("role", {}).get("value"), node.get("name", {}).get("value")) for node in tree}
        assert ("columnheader", "Reconstructed V") in shown
        assert ("region", "Table of the time series") in shown
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        size = page.locator("#series-box").bounding_box()
        assert size is not None
        assert (size["width"] > 100) is unfolded
        page.locator("#series-table").click()
