"""What reviewing a take costs: time to the first drawn frame, time of a scrub step, who else waits for it."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median, quantiles
from typing import TYPE_CHECKING

import numpy as np

from studio import tasks
from studio.benchmarks import two_arms
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.benchmarks.scene import Viewer
from studio.catalog import Catalog
from studio.episode import Outcome
from studio.episode_writer import EpisodeWriter
from studio.twin import Twin

if TYPE_CHECKING:
    from studio.ui.episodes import ClientEpisodes

SECONDS = 60.0
SCRUBS = 60
HEARTBEAT = 0.005  # [s] of a thread that wants little and often, like the page's painter
N_OPENED = 5


def measure(seconds: float = SECONDS) -> dict[str, float]:
    """Takes of `seconds`, one arm that wipes and two arms: open them, scrub them here and there.

    One viewer reads along. An opening lasts until all of its first frame has gone to viser, a scrub step
    until all that it changes has. `wait` is how much later than asked another thread of the web process ran.
    """
    one, two = _measure("wiping", seconds), _measure(two_arms.__name__, seconds)
    return {f"one_arm_{name}": value for name, value in one.items()} | {
        f"two_arms_{name}": value for name, value in two.items()
    }


def _measure(task: str, seconds: float) -> dict[str, float]:
    from studio.server import start_viser
    from studio.ui.episodes import EpisodesTab
    from studio.ui.scene import LIVE, SceneModel, SceneView

    with tempfile.TemporaryDirectory() as folder, Catalog(Path(folder)) as catalog:
        _write(Path(folder), task, seconds)
        catalog.refresh()
        server, model = start_viser(), SceneModel(task)
        SceneView(server, model, LIVE)
        episodes = EpisodesTab(
            server, server.gui.add_tab_group().add_tab("Episodes"), catalog, model=lambda _: model
        )
        with Viewer(server) as viewer:
            viewer.settle()
            (client,) = (episodes.of(client_id) for client_id in server.get_clients())
            assert client is not None
            (row,) = catalog.episodes()
            opened, busy, read = [], [], []
            with _heartbeat() as waits_opening:
                for _ in range(N_OPENED):
                    before, used = viewer.bytes, time.process_time()
                    opened.append(_timed(lambda: _open(client, row.episode_id)))
                    busy.append(time.process_time() - used)
                    viewer.settle()
                    read.append(viewer.bytes - before)
            with _heartbeat() as waits_scrubbing:
                steps = list(_scrubs(client, row.duration))
        episodes.close()
        server.stop()
        return {
            "open_s": median(opened),
            "open_s_worst": max(opened),
            "open_cpu_s": median(busy),
            "open_MB": median(read) / 1e6,
            "open_wait_ms": max(waits_opening) * 1e3,
            "scrub_ms": median(steps) * 1e3,
            "scrub_ms_p95": quantiles(steps, n=20)[-1] * 1e3,
            "scrub_wait_ms": max(waits_scrubbing) * 1e3,
        }


def _open(client: ClientEpisodes, episode_id: str) -> None:
    client.open(episode_id)
    assert client.review is not None
    if not client.review.shown.wait(60.0):
        raise TimeoutError(f"{episode_id} did not open.")


def _scrubs(client: ClientEpisodes, duration: float) -> Iterator[float]:
    """[s] of each of some jumps through the take."""
    review = client.review
    assert review is not None
    rng = np.random.default_rng(0)
    for _ in range(SCRUBS):
        time.sleep(0.5)  # also the late drawing of the ink is over
        review.shown.clear()
        at = float(rng.uniform(0.0, duration))

        def scrub(at: float = at) -> None:
            review.playback.scrub(at)
            review.shown.wait(10.0)

        yield _timed(scrub)


def _timed(call: Callable[[], None]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


@contextmanager
def _heartbeat() -> Iterator[list[float]]:
    """[s] that a thread was late, each time it ran."""
    late: list[float] = []
    ended = threading.Event()

    def beat() -> None:
        while not ended.is_set():
            begin = time.perf_counter()
            time.sleep(HEARTBEAT)
            late.append(time.perf_counter() - begin - HEARTBEAT)

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield late
    finally:
        ended.set()
        thread.join()


def _write(folder: Path, task: str, seconds: float) -> None:
    """Noise in place of a motion, but with images, ink and snapshots of the task's own size."""
    twin = Twin(tasks.load(task))
    arms = tuple(arm.name for arm in twin.task.arms)
    header = replace(made_up_header(arms, tuple(view.name for view in twin.task.cameras)), task=task)
    state, snapshot = twin.task_state(), twin.save()
    writer = EpisodeWriter(folder / "episodes" / task / f"{header.episode_id}.mcap", header)
    for step in made_up_steps(round(seconds * 100), header):
        if step.task_state is not None:
            step = replace(step, task_state=state)
        if step.snapshot is not None:
            step = replace(step, snapshot=snapshot)
        writer.add(step, time.time())
    writer.finish(Outcome(None, "made up"))
