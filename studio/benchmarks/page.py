"""How soon the whole page is seen, in a headless Chromium that draws in software."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from typing import TYPE_CHECKING

import numpy as np

from studio.benchmarks.browser import chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser

N_LOADS = 3
WATCHED = 12.0  # [s] after which nothing of the first picture is missing any more
SAME = 2.0  # mean difference of grey values, of 255, below which two pictures show the same
SIZE = (960, 540)  # [px] each pixel is drawn by the processor
SERVED = re.compile(r"at (http://127\.0\.0\.1:\d+)")

# Notes, ten times a second, a small copy of the 3-D view and how many tabs the panels show. The page does it
# itself: a screenshot from outside takes seconds where the browser draws in software.
WATCH = """
window.seen = [];
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  const kept = kind.startsWith("webgl") ? {...options, preserveDrawingBuffer: true} : options;
  return getContext.call(this, kind, kept);
};
const small = new OffscreenCanvas(64, 36).getContext("2d", {willReadFrequently: true});
setInterval(() => {
  const view = document.querySelector("canvas[data-engine]");
  if (!view) return;
  small.drawImage(view, 0, 0, 64, 36);
  const tabs = document.querySelectorAll("[role=tab]").length;
  window.seen.push([performance.now() / 1000, tabs, Array.from(small.getImageData(0, 0, 64, 36).data)]);
}, 100);
"""


def measure() -> dict[str, float]:
    """From opening the address to the first picture that looks as all later ones do, robot and panels.

    Every load is a first one: a context of its own, with nothing in its cache.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "studio", "serve", "--data", folder, "--port", "0", "--no-cameras"]
        begun = time.monotonic()
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            url = _address(process)
            served = time.monotonic() - begun
            with chromium() as browser:
                loads = [_load(browser, url) for _ in range(N_LOADS)]
        finally:
            process.terminate()
            process.communicate()
    return {"serve_s": served, "first_render_s": float(np.median(loads)), "worst_s": max(loads)}


def _address(process: subprocess.Popen[str]) -> str:
    assert process.stdout
    for line in process.stdout:
        if found := SERVED.search(line):
            return found[1]
    raise RuntimeError("`studio serve` ended before it served the page.")


def _load(browser: Browser, url: str) -> float:
    """[s] from the start of the navigation to the full picture."""
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.add_init_script(WATCH)
    page.goto(f"{url}/?fixedDpr=0.5")
    page.wait_for_timeout(WATCHED * 1e3)
    seen = page.evaluate("window.seen")
    page.close()
    at, tabs = np.array([row[0] for row in seen]), np.array([row[1] for row in seen])
    pictures = np.array([row[2] for row in seen], dtype=float).reshape(len(seen), -1, 4)[..., :3]
    if pictures[-1].std() < SAME:
        raise RuntimeError("The 3-D view stayed empty.")
    lacking = (np.abs(pictures - pictures[-1]).mean((1, 2)) > SAME) | (tabs < tabs[-1])
    return float(at[np.flatnonzero(lacking)[-1] + 1] if lacking.any() else at[0])
