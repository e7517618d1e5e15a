"""How quickly the gizmo reaches the servo: from a browser's socket through server and page to the session."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from controller.types import Array
from studio import messages as m
from studio.benchmarks.scene import Viewer
from studio.episode import open_episode

N_MOVES = 60
ISOLATED = 0.15  # [s] between moves that have nothing to do with each other
DRAG = 0.05  # [s] between the moves of a drag: a browser sends no faster
GIZMO = "/live/gizmo/right"


class Hand(Viewer):
    """A browser in which somebody drags the gizmo."""

    def move(self, phase: str, **pose: tuple[float, ...]) -> None:
        """`phase` is DragStart, Update or DragEnd."""
        message = {"type": f"TransformControls{phase}Message", "name": GIZMO, "owner": ""}
        self._socket.send(msgspec.msgpack.encode(message | pose))


def measure() -> dict[str, float]:
    """Latencies of isolated moves and of a drag, by the wall clock of a take that is recorded meanwhile."""
    from studio.api import Studio
    from studio.serve import SWITCH_INTERVAL, SessionProcess
    from studio.server import FrontServer, make_app, start_viser
    from studio.ui.app import Page
    from studio.ui.gate import Gate

    sys.setswitchinterval(SWITCH_INTERVAL)
    gate = Gate()
    server = start_viser(arrive=gate.arrive)
    with tempfile.TemporaryDirectory() as folder, Studio(folder) as studio:
        process = SessionProcess(Path(folder), "wiping")
        page = Page(server, studio, process, gate)
        app = make_app(server.get_port(), reception=gate.receive)
        try:
            process.start()
            process.connect(page.remote)
            page.start()
            with FrontServer(app, port=0) as front, Hand(server, front.port) as hand:
                gate.seats[0].ask()
                return _drag(page, hand)
        finally:
            page.close()
            process.end()
            server.stop()


def _drag(page: Any, hand: Hand) -> dict[str, float]:
    remote = page.remote
    remote.post(m.Drive(driver="operator"))
    _wait(lambda: remote.status.get()[0].driver == "operator")
    remote.post(m.StartTake(countdown=0.0))
    _wait(lambda: remote.status.get()[0].phase == "recording")
    time.sleep(1.0)
    isolated = _move(hand, remote, ISOLATED)
    dragged = _move(hand, remote, DRAG)
    remote.post(m.EndTake())
    take = _wait(lambda: remote.status.get()[0].last_take)
    with open_episode(Path(take.path)) as episode:
        columns = episode.columns("tick", "right/requested")
    wall, x = columns["tick/wall"], columns["right/requested/base_from_target"][:, 0]
    first, second = _latencies(wall, x, isolated), _latencies(wall, x, dragged)
    return {
        "isolated_p50_ms": float(np.percentile(first, 50) * 1e3),
        "isolated_p95_ms": float(np.percentile(first, 95) * 1e3),
        "drag_p95_ms": float(np.percentile(second, 95) * 1e3),
        "drag_arrived": len(second) / len(dragged),
    }


def _move(hand: Hand, remote: Any, gap: float) -> list[tuple[float, float]]:
    """Drag the gizmo to and fro by 1 mm; when [s, unix time] each was sent and its x [m]."""
    x, y, z, *_ = remote.frame.get()[0].arms[0].base_from_target
    sent = []
    hand.move("DragStart")
    for n in range(N_MOVES):
        goal = x + 0.001 * (1 + n % 2) + 1e-6 * n  # every target is another number
        sent.append((time.time(), goal))
        hand.move("Update", wxyz=(1.0, 0.0, 0.0, 0.0), position=(goal, y, z))
        time.sleep(gap)
    hand.move("DragEnd")
    return sent


def _latencies(wall: Array, x: Array, sent: list[tuple[float, float]]) -> Array:
    reached = [(at, np.flatnonzero(np.abs(x - goal) < 1e-9)) for at, goal in sent]
    return np.array([wall[ticks[0]] - at for at, ticks in reached if len(ticks)])


def _wait(condition: Any, seconds: float = 60.0) -> Any:
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"Nothing happened for {seconds:.0f} s.")
        time.sleep(0.01)
    return found
