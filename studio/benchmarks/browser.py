"""The system's Chromium without a screen, for measurements and tests of the page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from studio.doctor import CHROMIUM, apt

if TYPE_CHECKING:
    from playwright.sync_api import Browser

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


class NoBrowserError(RuntimeError):
    """No Chromium, or nothing to drive it; the message says what installs it."""


@contextmanager
def chromium() -> Iterator[Browser]:
    """A headless browser for as long as the block runs.

    Until it ends, no other code on this thread may run a loop of asyncio's.
    """
    path = next((path for path in map(shutil.which, CHROMIUM) if path), None)
    if path is None:
        raise NoBrowserError(
            f"This needs Chromium, and none of {', '.join(CHROMIUM)} is here: {apt('chromium')}"
        )
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise NoBrowserError("This drives Chromium by Playwright: pip install playwright") from None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()
