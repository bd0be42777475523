"""Pages that look at a served feeder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

DESKTOP, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}

LOOKS = pytest.mark.parametrize(
    ("size", "scheme"),
    [(DESKTOP, "light"), (PHONE, "light"), (DESKTOP, "dark")],
    ids=["desktop", "phone", "desktop-dark"],
)
"""Sizes of a window, and the dark scheme once."""
READABLE = 4.5
"""Least contrast of text, WCAG 2.2 level AA."""
_CONTRAST = """selector => {
    const context = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
    const paint = (colour) => {
        context.fillStyle = colour;
        context.fillRect(0, 0, 1, 1);
        const part = (k) => context.getImageData(0, 0, 1, 1).data[k] / 255;
        const linear = (c) => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
        return 0.2126 * linear(part(0)) + 0.7152 * linear(part(1)) + 0.0722 * linear(part(2));
    };
    return [...document.querySelectorAll(selector)].filter((e) => e.checkVisibility()).map((e) => {
        const grounds = [];
        for (let n = e; n; n = n.parentElement) grounds.push(getComputedStyle(n).backgroundColor);
        paint('white');
        const ground = grounds.reverse().map(paint).at(-1);
        const ink = paint(getComputedStyle(e).color);
        return (Math.max(ink, ground) + 0.05) / (Math.min(ink, ground) + 0.05);
    });
}"""


def contrast(page: Page, selector: str) -> float:
    """Least contrast of visible texts with the backgrounds of their ancestors."""
    found = page.evaluate(_CONTRAST, selector)
    assert found, selector
    return float(min(found))


class Site:
    """A served feeder, and pages that look at it and may neither complain nor call anywhere else."""

    def __init__(self, browser: Browser, service: Any, serve: Callable[..., Any]) -> None:
        self.browser, self.service, self.serve = browser, service, serve
        self.server = serve(service)
        self.village = next(iter(service.villages.values()))
        self.complaints: list[str] = []
        self.expected: str | None = None  # what the browser itself may complain about
        self.pages: list[Page] = []

    def tick(self, t: float, ticks: int = 1, **changes: Any) -> None:
        for k in range(ticks):
            self.service.tick(self.village.report(t + k, **changes))

    def open(self, size: dict[str, int] | None = None, path: str = "/", **options: Any) -> Page:
        context = self.browser.new_context(viewport=size or DESKTOP, **options)  # type: ignore[arg-type]
        page = context.new_page()
        page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("dialog", lambda dialog: self.complaints.append(f"dialog: {dialog.message}"))
        page.on(
            "request",
            lambda r: None if r.url.startswith(self.server.url) else self.complaints.append(r.url),
        )
        page.goto(self.server.url + path)
        page.evaluate("document.querySelectorAll('#alarm-box').forEach(box => { box.open = true; })")
        self.pages.append(page)
        return page

    def close(self) -> None:
        for page in self.pages:
            page.context.close()


def customer(page: Page, name: str) -> Any:
    return page.locator(f'#diagram .customer[aria-label^="{name}:"]')
