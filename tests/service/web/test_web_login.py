"""Login of the web page by an API key, on a real service, in Chromium."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from service.access.identity import Role
from service.access.keys import create
from service.store.access import AccessStore
from tests.service.looking import LOOKS, READABLE, contrast
from tests.service.running import FEEDER, service

pytestmark = pytest.mark.browser


@pytest.mark.canary("phone")
@LOOKS
def test_the_page_asks_for_a_key_and_shows_the_identity(
    browser: Browser, tmp_path: Path, size: dict[str, int], scheme: str
) -> None:
    now = time.time()
    text, record = create("Ada", Role.OPERATOR, frozenset({FEEDER}), now, now + 600.0)
    with AccessStore(f"sqlite:///{tmp_path / 'gridsec.db'}") as store:
        store.add_key(record)
    with service(tmp_path) as running:
        context = browser.new_context(viewport=size, color_scheme=scheme)  # type: ignore[arg-type]
        page = context.new_page()
        page.goto(str(running.http.base_url))
        expect(page.locator("#login")).to_be_visible()
        assert contrast(page, "#login :is(h2, p, label, button, code)") > READABLE
        page.keyboard.press("Escape")
        expect(page.locator("#login")).to_be_visible()
        page.fill("#login-key", "gridsec_0_0")
        page.click("#login-form button")
        expect(page.locator("#login-error")).to_contain_text("not known")
        assert contrast(page, "#login-error") > READABLE
        page.fill("#login-key", text)
        page.click("#login-form button")
        expect(page.locator("#login")).to_be_hidden()
        expect(page.locator("#identity")).to_contain_text("Ada (operator, 1 feeder)")
        expect(page.locator("#decision")).not_to_have_text("–")
        (cookie,) = context.cookies()
        assert cookie["httpOnly"]
        assert page.evaluate("document.cookie") == ""
        page.reload()
        expect(page.locator("#identity")).to_contain_text("Ada")
        page.click("#identity button")
        expect(page.locator("#login")).to_be_visible()
        assert context.cookies() == []
        context.close()
