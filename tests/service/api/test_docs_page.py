"""Swagger UI at `/api/v1/docs`: unchanged files, and a browser that loads them from the service alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import expect

from service.api.description import TAGS
from service.api.errors import SECURITY_POLICY
from service.api.guide import DOCS, DOCS_POLICY
from tests.service.asking import Setup
from tests.service.looking import Site

FILES = Path(__file__).parents[3] / "service" / "web" / "swagger"
DIGESTS = {
    "swagger-ui-bundle.js": "e6a898692f2d768e807c3ba4626068a69a2c5dd960dd6c76f3e4d3a3de180af2",
    "swagger-ui.css": "5ed08757e53da3e026d6cbecc61fe5d43585c9560b302d534ad56692519a273d",
}
"""SHA-256 of the files in `swagger-ui-dist` 5.35.0."""


@pytest.mark.parametrize("name", DIGESTS)
def test_the_files_are_those_of_the_package(name: str) -> None:
    assert hashlib.sha256((FILES / name).read_bytes()).hexdigest() == DIGESTS[name]
    assert "Apache License" in (FILES / "LICENSE").read_text("utf-8")


def test_only_its_page_may_load_data_addresses(setup: Setup) -> None:
    policies = {
        path: setup.http.get(path).headers.get_list("content-security-policy")
        for path in (DOCS, "/", "/swagger/open.js", "/api/v1/openapi.json")
    }
    assert policies.pop(DOCS) == [DOCS_POLICY]
    assert list(policies.values()) == [[SECURITY_POLICY]] * 3
    assert DOCS_POLICY.replace(" data:", "") == SECURITY_POLICY
    assert 'href="api/v1/docs"' in setup.http.get("/").text
    assert setup.http.head(DOCS).status_code == 200
    assert setup.http.post(DOCS).status_code == 405


@pytest.mark.browser
def test_a_browser_shows_all_operations_and_asks_no_other_host(
    site_of: Callable[..., Site], village: type
) -> None:
    """`Site` collects requests of other hosts, and messages of the content security policy."""
    site = site_of(village())
    page = site.open(path=DOCS)
    expect(page.locator(".info .title")).to_contain_text("gridsec")
    expect(page.locator(".opblock-tag-section")).to_have_count(len(TAGS))
    page.locator("#operations-tag-feeders").click()
    shown = page.locator("#operations-feeders-list_feeders")
    shown.locator(".opblock-summary-control").click()
    shown.get_by_role("button", name="Try it out").click()
    shown.get_by_role("button", name="Execute").click()
    expect(shown.locator(".live-responses-table .response .response-col_status")).to_contain_text("200")
    expect(shown.locator(".live-responses-table")).to_contain_text('"village"')
