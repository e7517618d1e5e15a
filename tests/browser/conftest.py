"""A headless Chromium, the system's own, for tests of the page."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Error, Page, ViewportSize

from studio.benchmarks import browser

VIEWPORT = ViewportSize(width=960, height=540)  # small: each pixel is drawn by the processor
TIMEOUT = 60.0  # [s] for a page on a busy machine


@pytest.fixture(scope="module")  # while it lives no test of this thread could run a loop of asyncio's
def chromium() -> Iterator[Browser]:
    try:
        with browser.chromium() as running:
            yield running
    except browser.NoBrowserError as error:
        pytest.skip(str(error))


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
