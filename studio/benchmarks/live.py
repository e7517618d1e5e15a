"""How well the session process keeps time, and how quickly a hand reaches the servo."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from controller.types import Array
from studio import messages as m
from studio.episode import Episode, open_episode
from studio.link import Link, connect, socket_path
from studio.session import LATE

N_MOVES = 100  # isolated moves
MOVE_GAP = 0.15  # [s] between them: longer than a source that streams


def measure(seconds: float = 60.0) -> dict[str, float]:
    """Record a live take of `seconds` with two cameras and one client that reads everything.

    Late ticks and stalls come from the take itself; latency is from sending a target to the start of the
    control period that requests it, by the wall clock.
    """
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen([sys.executable, "-m", "studio.live", "--data", folder])
        try:
            return _drive(Path(folder), seconds)
        finally:
            process.terminate()
            process.wait(10)


def _drive(data: Path, seconds: float) -> dict[str, float]:
    reports: dict[type, m.Report] = {}
    images, kept = [0], list[m.TakeStatus]()

    def hear(report: m.Report) -> None:
        reports[type(report)] = report
        images[0] += isinstance(report, m.CameraImage)
        if isinstance(report, m.Notice) and report.kind == "take kept" and report.take:
            kept.append(report.take)

    link = connect(socket_path(data), hear)
    _wait(lambda: images[0] > 0 and m.Frame in reports)
    link.send(m.Drive(driver="operator"))
    time.sleep(0.5)
    link.send(m.StartTake(countdown=0.0))
    start = time.monotonic()
    images[0] = 0
    sent = _move(link, reports)
    time.sleep(max(0.0, seconds - (time.monotonic() - start)))
    n_images, elapsed = images[0], time.monotonic() - start
    link.send(m.EndTake())
    _wait(lambda: kept)
    link.close()
    with open_episode(Path(kept[0].path)) as episode:
        late = episode.columns("tick")["tick/late"]
        latency = _latencies(episode, sent)
    return {
        "seconds": elapsed,
        "ticks": len(late),
        "late_share": float((late > LATE).mean()),
        "longest_stall_ms": float(late.max() * 1e3),
        "images_per_second": n_images / elapsed,
        "target_latency_p50_ms": float(np.percentile(latency, 50) * 1e3),
        "target_latency_p95_ms": float(np.percentile(latency, 95) * 1e3),
    }


def _move(link: Link, reports: dict[type, m.Report]) -> list[tuple[float, float]]:
    """Isolated moves of 1 mm; when [s, unix time] each was sent and its x [m]."""
    frame = reports[m.Frame]
    assert isinstance(frame, m.Frame)
    x, y, z, *wxyz = frame.arms[0].base_from_target
    sent = []
    for n in range(N_MOVES):
        goal = x + 0.001 * (1 + n % 2) + 1e-6 * n  # every target is another number
        sent.append((time.time(), goal))
        link.send(m.MoveTo(arm=0, position=(goal, y, z), wxyz=(wxyz[0], wxyz[1], wxyz[2], wxyz[3])))
        time.sleep(MOVE_GAP)
    return sent


def _latencies(episode: Episode, sent: list[tuple[float, float]]) -> Array:
    arm = episode.header.arms[0]
    columns = episode.columns("tick", f"{arm}/requested")
    wall, x = columns["tick/wall"], columns[f"{arm}/requested/base_from_target"][:, 0]
    return np.array([wall[np.flatnonzero(x == goal)[0]] - at for at, goal in sent if (x == goal).any()])


def _wait(condition: Callable[[], object], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"The session process did not answer within {seconds:.0f} s.")
        time.sleep(0.01)
