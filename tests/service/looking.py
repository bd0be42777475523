"""Pages that look at a served feeder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from playwright.sync_api import Browser, Page

DESKTOP, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}


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
        page.set_default_timeout(10_000)
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
