"""How quickly a headset's hands reach the servo, and what they cost: through `studio serve`, by a socket."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Self

import httpx
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from controller.types import Array
from studio.episode import open_episode
from studio.link import socket_path
from studio.messages import EndTake, StartTake, Status

TASK = "peg-cylinder"  # two arms, three cameras
FPS = 60.0  # [Hz] at which latency is measured
SLOW, FAST = 20.0, 120.0  # [Hz] between which the cost is measured
ROUNDS, ROUND = 9, 3.0  # [s] of each rate in a round
SECONDS = 8.0  # of a measurement of latency
STEP = 2e-5  # [m] that both hands move from frame to frame, always onward: every pose is another
MENU = 5  # index of the button that engages


def measure() -> dict[str, float]:
    """Latency alone and while another client downloads a take, its films and scenes; the processors' time.

    Latency is from sending a pose to the control period that requests it, by the wall clock of the take that
    is recorded meanwhile. The cost is what server and session process use for more frames, with both clutches
    engaged and the hands still: following costs the servo, whoever leads.
    """
    with tempfile.TemporaryDirectory() as folder:
        server = subprocess.Popen(
            [sys.executable, "-m", "studio", "serve", "--data", folder, "--port", "0", "--task", TASK],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            url = _url(server)
            session = int(httpx.get(f"{url}/api/v1/health").json()["session_pid"])
            return _measure(url, Path(folder), (server.pid, session))
        finally:
            server.terminate()
            server.communicate(timeout=60)


def _measure(url: str, data: Path, pids: tuple[int, int]) -> dict[str, float]:
    with Headset(url) as headset, Recording(data) as recording:
        quiet = _latency(headset, recording)
        with Downloads(url, recording.last_take):
            busy = _latency(headset, recording)
        headset.engage()
        cost = _cost_of_frames(headset, pids)
    return {
        "p50_ms": float(np.percentile(quiet[0], 50) * 1e3),
        "p95_ms": float(np.percentile(quiet[0], 95) * 1e3),
        "with_downloads_p50_ms": float(np.percentile(busy[0], 50) * 1e3),
        "with_downloads_p95_ms": float(np.percentile(busy[0], 95) * 1e3),
        "arrived": min(quiet[1], busy[1]),
        "two_hands_share_of_core": FAST * cost,
    }


class Headset:
    """A page in a headset; both hands are always there."""

    def __init__(self, url: str) -> None:
        self.fps, self.step = FPS, 0.0  # [Hz] of frames, [m] from one to the next
        self.way = 0.0  # [m] that the hands have come
        self.sent: list[tuple[float, float]] = []  # of each frame: unix time [s], way
        self.engaged = 0  # hands, as the studio says
        self._menu = 0.0
        self._socket = connect(f"ws{url.removeprefix('http')}/xr/ws", compression=None, proxy=None)
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._read, self._show)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        for thread in self._threads:
            thread.join()

    def engage(self) -> None:
        """Both hands, unless they are."""
        deadline = time.monotonic() + 30.0
        while self.engaged < 2:
            for self._menu in (1.0, 0.0):
                time.sleep(0.1)
            time.sleep(0.3)
            if time.monotonic() > deadline:
                raise TimeoutError("The hands cannot take hold of the arms.")

    def move(self, seconds: float) -> list[tuple[float, float]]:
        """Onward; what was sent of it."""
        self.sent, self.step = [], STEP
        time.sleep(seconds)
        self.step, sent = 0.0, self.sent
        return sent

    def _show(self) -> None:
        due = time.monotonic()
        try:
            while True:
                self.way += self.step
                self.sent.append((time.time(), self.way))
                self._socket.send(self._frame())
                due = max(due + 1.0 / self.fps, time.monotonic() - 1.0 / self.fps)
                time.sleep(max(0.0, due - time.monotonic()))
        except ConnectionClosed:
            return

    def _frame(self) -> str:
        buttons = [0.0] * 7
        buttons[MENU] = self._menu
        hands = {
            side: {"pose": [x, 1.1, -0.3 - self.way, 0.0, 0.0, 0.0, 1.0], "buttons": buttons}
            for side, x in (("left", -0.2), ("right", 0.2))
        }
        head = [0.0, 1.6, 0.0, 0.0, 0.0, 0.0, 1.0]
        t = time.perf_counter() * 1e3
        return json.dumps({"type": "frame", "t": t, "rtt": 1.0, "head": head, **hands})

    def _read(self) -> None:
        try:
            for message in self._socket:
                if isinstance(message, str) and (told := json.loads(message))["type"] == "state":
                    self.engaged = sum(arm["engaged"] for arm in told["arms"])
        except ConnectionClosed:
            return


class Recording:
    """Another client of the session, which records takes."""

    def __init__(self, data: Path) -> None:
        from studio.ui.remote import Remote

        self._remote = Remote()
        self._remote.connect(socket_path(data))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._remote.close()

    @property
    def status(self) -> Status:
        status, _ = self._remote.status.get()
        assert status is not None
        return status

    @property
    def last_take(self) -> str:
        """Its id."""
        assert self.status.last_take is not None
        return Path(self.status.last_take.path).stem

    def start(self) -> None:
        self._remote.post(StartTake(countdown=0.0))
        _wait(lambda: self.status.phase == "recording")

    def stop(self) -> dict[str, Array]:
        """The columns of the take."""
        before = self.status.last_take
        self._remote.post(EndTake())
        _wait(lambda: self.status.last_take not in (None, before))
        take = self.status.last_take
        assert take is not None
        with open_episode(Path(take.path)) as episode:
            return episode.columns("tick", "right/requested")


class Downloads:
    """Somebody else who fetches whatever is large, again and again: columns, films, scene, page."""

    def __init__(self, url: str, take: str) -> None:
        program = (
            "import httpx, itertools, sys\n"
            "url, task, take = sys.argv[1:]\n"
            "get = lambda path: httpx.get(url + path, timeout=120).raise_for_status()\n"
            "parts = [part for part in get(f'/xr/scene/{task}').json()['parts'] if part]\n"
            "httpx.post(f'{url}/api/v1/refresh').raise_for_status()\n"
            "episode = f'/api/v1/episodes/{take}'\n"
            "films = [f'{episode}/video/{camera}.mp4' for camera in get(f'{episode}/images').json()]\n"
            "columns = [f'{episode}/columns?format={format}' for format in ('npz', 'json')]\n"
            "for path in itertools.cycle([*columns, *films, *parts, '/']):\n"
            "    get(path)\n"
        )
        self._process = subprocess.Popen([sys.executable, "-c", program, url, TASK, take])

    def __enter__(self) -> Self:
        time.sleep(2.0)
        return self

    def __exit__(self, *_: object) -> None:
        ended = self._process.poll()
        self._process.kill()
        self._process.wait()
        if ended is not None:
            raise RuntimeError(f"The downloads stopped by themselves: {ended}.")


def _latency(headset: Headset, recording: Recording) -> tuple[Array, float]:
    """[s] of the poses that were requested, or that a newer one had overtaken; the share that arrived."""
    headset.engage()
    recording.start()
    time.sleep(0.2)
    way = headset.way
    sent = headset.move(SECONDS)
    time.sleep(0.3)
    columns = recording.stop()
    wall, x = columns["tick/wall"], columns["right/requested/base_from_target"][:, 0]
    start = float(x[0]) - way  # while nothing moved
    reached = [(at, np.flatnonzero(x - start > there - STEP / 2)) for at, there in sent]
    found = np.array([wall[ticks[0]] - at for at, ticks in reached if len(ticks)])
    return found, len(found) / len(sent)


def _cost_of_frames(headset: Headset, pids: tuple[int, ...]) -> float:
    """[s] of processors' time for a frame: from many and few of them, in turns, the median of the rounds."""

    def measured(fps: float) -> Array:
        headset.fps, headset.sent = fps, []
        before = sum(map(_cpu_time, pids))
        time.sleep(ROUND)
        return np.array([sum(map(_cpu_time, pids)) - before, len(headset.sent)])

    rounds = np.array([measured(FAST) - measured(SLOW) for _ in range(ROUNDS)])  # [s], frames
    return float(np.median(rounds[:, 0] / rounds[:, 1]))


def _cpu_time(pid: int) -> float:
    """[s] that a process has used so far, without its children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _url(server: subprocess.Popen[str]) -> str:
    assert server.stdout
    for line in server.stdout:
        if found := re.search(r"at (http://127\.0\.0\.1:\d+)", line):
            return found[1]
    raise RuntimeError("The studio did not start.")


def _wait(condition: Any, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"Nothing happened for {seconds:.0f} s.")
        time.sleep(0.01)
