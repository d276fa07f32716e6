"""Headless Chromium for the tests of the page; a test that needs it is skipped where there is none."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_ARGUMENTS = [
    *("--headless", "--no-sandbox", "--disable-gpu"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a card
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]


@contextmanager
def chromium(*arguments: str) -> Iterator[Browser]:
    """The system's Chromium with an empty profile, and with further arguments.

    Playwright keeps an event loop in this thread as long as it runs: keep it no longer than a module's tests.
    """
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip(f"needs {' or '.join(_NAMES)}; on Debian: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=[*_ARGUMENTS, *arguments])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def visit(browser: Browser, url: str, path: str = "") -> Iterator[Page]:
    """A page of the service at `url`; at the end it must have complained of nothing and called nobody else.

    Answers of 400 and more, and a lack of WebGL, are not complaints: what the page says about them is the
    test's matter.
    """
    context = browser.new_context(viewport={"width": 1200, "height": 900}, locale="en-GB", timezone_id="UTC")
    page = context.new_page()
    page.set_default_timeout(60_000)
    complaints: list[str] = []

    def listen(message: ConsoleMessage) -> None:
        expected = "Failed to load resource", "THREE.WebGLRenderer: "
        if message.type == "error" and not any(words in message.text for words in expected):
            complaints.append(message.text)

    page.on("console", listen)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    called: set[str] = set()
    page.on("request", lambda request: called.add(request.url))
    page.goto(f"{url}/{path}")
    yield page
    context.close()
    assert complaints == [], complaints
    elsewhere = [one for one in called if not one.startswith((f"{url}/", "blob:", "data:"))]
    assert elsewhere == [], elsewhere
