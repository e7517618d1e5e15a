"""A headless Chromium, the system's own, for tests of the page."""

import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Error, Page, ViewportSize, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
# WebGL in software, no sandbox for root, and nothing that asks the internet by itself.
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
VIEWPORT = ViewportSize(width=960, height=540)  # small: each pixel is drawn by the processor
TIMEOUT = 60.0  # [s] for a page on a busy machine


@pytest.fixture(scope="module")  # while it lives no test of this thread could run a loop of asyncio's
def chromium() -> Iterator[Browser]:
    path = next((path for path in map(shutil.which, NAMES) if path), None)
    if path is None:
        pytest.skip(
            f"needs Chromium, and none of {', '.join(NAMES)} is here; on Debian: apt-get install chromium"
        )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(chromium: Browser) -> Iterator[Page]:
    """A fresh page; the test fails where its scripts do."""
    context = chromium.new_context(viewport=VIEWPORT)
    context.set_default_timeout(TIMEOUT * 1e3)
    page = context.new_page()
    errors: list[Error] = []
    page.on("pageerror", lambda error: errors.append(error))
    yield page
    context.close()
    assert not errors
