"""Displayed verdict on the page of a live service while a fifth of all readings is lost."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from feeders.model.site import load
from feeders.simulation.plant import Channel
from feeders.simulation.scenario import Scenario
from service.cli.simulate import Pace, play
from tests.service.looking import DESKTOP
from tests.service.running import FEEDER, service, until

pytestmark = pytest.mark.browser

LOSS = 0.2
SETTLED = 12
"""Ticks before the first counted one."""
SHARE = 0.1
"""Largest number of changes of the displayed verdict, relative to those of the raw one."""
COUNT = """() => {
    const node = document.querySelector("#decision");
    window.words = [node.textContent];
    new MutationObserver(() => {
        if (window.words.at(-1) !== node.textContent) window.words.push(node.textContent);
    }).observe(node, { childList: true, characterData: true, subtree: true });
}"""


@pytest.mark.canary("fast")
@pytest.mark.parametrize(
    ("ticks", "speed"), [(40, float("inf")), (480, 4.0)], ids=["fast", "two minutes at fourfold speed"]
)
def test_the_displayed_verdict_stands_while_readings_are_lost(
    browser: Browser, tmp_path: Path, ticks: int, speed: float
) -> None:
    scenario = Scenario(seed=5, duration_s=float(SETTLED + ticks), channel=Channel(loss=LOSS))
    with service(tmp_path, clock="events") as running:
        page = browser.new_page(viewport=DESKTOP)  # type: ignore[arg-type]
        played = play(load(FEEDER), scenario, running.meters, Pace(speed, ahead=3))
        for _ in range(SETTLED):
            next(played)
        page.goto(str(running.http.base_url))
        expect(page.locator("#decision")).to_have_text("CLEAN")
        page.evaluate(COUNT)
        since = running.state()["t"]
        last = [tick.t for tick in played][-1]
        until(lambda: running.state()["t"] >= last - 2.0, "the end")
        points = running.get(f"/api/v1/feeders/{FEEDER}/history", since=since, limit=5000)["points"]
        raw = [point["verdict"] for point in points]
        words = page.evaluate("window.words")
        page.close()
    raw_changes = sum(a != b for a, b in pairwise(raw))
    assert raw_changes >= ticks / 20
    assert len(words) - 1 <= SHARE * raw_changes
    print(f"{ticks} ticks: raw verdict {raw_changes} changes, displayed {len(words) - 1}")
