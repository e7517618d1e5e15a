"""How soon the dataset page shows a long take, and another time of it, in a headless Chromium."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from statistics import median, quantiles
from typing import TYPE_CHECKING, Any

from studio.benchmarks.browser import chromium
from studio.benchmarks.episodes import CAMERAS, made_up_header, write_take

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SECONDS = 60.0
N_OPENED = 5
SCRUBS = 60
SIZE = (1280, 800)  # [px]
NOBODY = 9  # the discard port: viser is not needed here

# An opening lasts from the call until a frame with all cameras, lanes and plots is painted; a scrub step
# until one is in which all cameras show the image of the new time, playhead and numbers, too.
OPEN = """async ({id, cameras}) => {
  const {api} = await import("/assets/dataset/api.js");
  const {EpisodeView} = await import("/assets/episode/view.js");
  const {row} = await api.get(`/episodes/${id}`);
  const section = document.getElementById("episode");
  section.hidden = false;
  document.body.classList.add("viewing");
  window.painted = () => new Promise((done) => requestAnimationFrame(() => {
    const {port1, port2} = new MessageChannel();
    port1.onmessage = done;
    port2.postMessage(0); // heard once the frame is painted
  }));
  window.shown = async (holds) => {
    const cameras = document.getElementsByTagName("canvas");
    while (!holds([...cameras].filter((each) => each.closest(".cameras")))) {
      await new Promise((done) => setTimeout(done, 1));
    }
    await painted();
  };
  window.view = new EpisodeView(section, {api});
  const begin = performance.now();
  await view.show([row]);
  await shown((all) => all.length === cameras && all.every((camera) => camera.dataset.number));
  return performance.now() - begin;
}"""
SCRUB = """async (time) => {
  const begin = performance.now();
  view.playhead.seek(time);
  await shown((all) => all.every((camera) => camera.dataset.number === String(Math.floor(time * 20 + 1e-3))));
  return performance.now() - begin;
}"""


def measure(seconds: float = SECONDS) -> dict[str, float]:
    """Of a take of two arms and three cameras, read anew each time, by browsers that know nothing yet."""
    from studio.api import Studio
    from studio.http import add_api
    from studio.lease import Lease
    from studio.server import FrontServer, make_app
    from studio.ui.remote import Remote

    with tempfile.TemporaryDirectory() as folder:
        header = made_up_header()
        path = Path(folder) / "episodes" / header.task / f"{header.episode_id}.mcap"
        write_take(path, header, seconds)
        with Studio(Path(folder)) as studio, chromium() as browser:
            studio.catalog.refresh()
            app, remote = make_app(NOBODY), Remote()
            reader = add_api(app, studio, remote, Lease(remote.post))
            with FrontServer(app, port=0) as front:
                told = [_look(browser, front.url, header.episode_id, path, seconds) for _ in range(N_OPENED)]
            reader.close()
            remote.close()
    opened = [opening / 1e3 for opening, _ in told]
    steps = [step for _, steps in told for step in steps]
    return {
        "open_s": median(opened),
        "open_s_worst": max(opened),
        "scrub_ms": median(steps),
        "scrub_ms_p95": quantiles(steps, n=20)[-1],
    }


def _look(
    browser: Browser, url: str, episode_id: str, path: Path, seconds: float
) -> tuple[float, list[float]]:
    """[ms] to open the take, and of some jumps through it."""
    os.utime(path)  # nobody has kept what was read of it
    page: Any = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.goto(f"{url}/dataset")
    page.get_by_text("made-up").first.wait_for()
    page.wait_for_timeout(1000)
    opened = page.evaluate(OPEN, {"id": episode_id, "cameras": len(CAMERAS)})
    page.wait_for_timeout(500)
    times = [seconds * ((17 * number) % SCRUBS + 0.4) / SCRUBS for number in range(SCRUBS // N_OPENED)]
    steps = []
    for time in times:
        steps.append(page.evaluate(SCRUB, time))
        page.wait_for_timeout(150)
    page.close()
    return opened, steps
