"""The page in a browser that draws nothing in 3D: it submits and tells all the same."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from browser import chromium, visit
from playwright.sync_api import Browser, expect
from service_process import Service


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium("--disable-3d-apis") as browser:
        yield browser


def test_a_sample_is_submitted(browser: Browser, service: Service) -> None:
    with visit(browser, service.rest_url) as page:
        page.get_by_role("button", name="Chair", exact=True).click()
        expect(page.locator("#verdict")).to_have_text(
            "This browser shows no WebGL, so nothing is drawn here."
        )
        page.get_by_role("button", name="Refine", exact=True).click()
        page.wait_for_url(re.compile("#/refinements/"))
        expect(page.locator(".state")).to_have_text("Waiting for a free worker.")
