"""What the twin on the page costs: bytes of a scene, bytes of its stream, time of an update."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from importlib.metadata import version
from statistics import median, quantiles
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import msgspec
import numpy as np
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from controller.types import ArmAction, CartesianTarget
from studio import tasks
from studio.benchmarks import two_arms
from studio.twin import Twin

if TYPE_CHECKING:
    import viser

SETTLED = 0.3  # [s] without a byte after which everything has arrived
MARK = "/mark"  # nodes that only tell how far a viewer has read
WARM_UP = 30  # updates that are not counted


class Viewer:
    """A page's socket without a page: it reads whatever viser sends, counts it and keeps the messages."""

    def __init__(self, server: viser.ViserServer, port: int | None = None) -> None:
        """Through `port` where given, a proxy's, else to the server itself."""
        self.bytes = 0
        self.messages: list[dict[str, Any]] = []
        self._server = server
        self._marks = 0
        self._seen: set[str] = set()
        self._arrived = time.monotonic()
        self._socket = connect(
            f"ws://127.0.0.1:{port or server.get_port()}",
            subprotocols=[Subprotocol(f"viser-v{version('viser')}")],
            compression=None,
            max_size=None,
            proxy=None,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        self._greet()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()
        self._thread.join()

    def settle(self) -> None:
        """Wait until all that was sent has arrived: a mark behind it has, and then nothing more."""
        self._marks += 1
        mark = f"{MARK}/{id(self)}/{self._marks}"
        self._server.scene.add_frame(mark, show_axes=False)
        self._server.flush()
        while mark not in self._seen or time.monotonic() - self._arrived < SETTLED:
            time.sleep(0.02)

    def _read(self) -> None:
        try:
            while True:
                window = self._socket.recv(decode=False)
                self.bytes += len(window)
                for message in _decode(window)["messages"]:
                    name = str(message.get("name", ""))
                    if name.startswith(MARK):
                        self._seen.add(name)
                    else:
                        self.messages.append(message)
                self._arrived = time.monotonic()
        except ConnectionClosed:
            return

    def _greet(self) -> None:
        """Only who tells where the camera is counts as a client."""
        camera = {
            "type": "ViewerCameraMessage",
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": (1.0, 1.0, 1.0),
            "fov": 1.0,
            "near": 0.01,
            "far": 100.0,
            "image_height": 540,
            "image_width": 960,
            "look_at": (0.0, 0.0, 0.0),
            "up_direction": (0.0, 0.0, 1.0),
        }
        self._socket.send(msgspec.msgpack.encode(camera))


def measure(seconds: float = 5.0) -> dict[str, float]:
    """One arm that wipes and two arms that press, each as it streams to one viewer in real time."""
    one, two = _measure("wiping", seconds), _measure(two_arms.__name__, seconds)
    return {f"one_arm_{name}": value for name, value in one.items()} | {
        f"two_arms_{name}": value for name, value in two.items()
    }


def _measure(task: str, seconds: float) -> dict[str, float]:
    from studio.server import start_viser
    from studio.ui.scene import LIVE, RATE, SceneModel, SceneView, set_stage

    shows = _Demonstration(task)
    begin = time.perf_counter()
    model = SceneModel(task)
    model_s = time.perf_counter() - begin
    server = start_viser()
    try:
        set_stage(server, model)
        view = SceneView(server, model, LIVE)
        with Viewer(server) as viewer:
            viewer.settle()
            scene_bytes = viewer.bytes
            _paced(lambda: shows.next(view), WARM_UP, 1 / RATE)
            viewer.settle()
            before = viewer.bytes
            times = _paced(lambda: shows.next(view), round(seconds * RATE), 1 / RATE)
            viewer.settle()
            streamed = viewer.bytes - before
    finally:
        server.stop()
    return {
        "scene_MB": scene_bytes / 1e6,
        "stream_kB_per_s": streamed / 1e3 / seconds,
        "update_ms": median(times) * 1e3,
        "update_ms_p95": quantiles(times, n=20)[-1] * 1e3,
        "build_s": model_s,
    }


class _Demonstration:
    """A scripted demonstration, simulated beforehand: only showing it is measured."""

    def __init__(self, task: str) -> None:
        twin = Twin(tasks.load(task))
        twin.reset(0)
        self._frames = []
        for tick, action in enumerate(twin.task.demonstrate(twin.world, np.random.default_rng(0))):
            applied = twin.apply(action).action
            if tick % 3 == 0:  # about the rate of a page
                wrenches = [arm.wrench for arm in twin.observe().arms]
                painted = twin.task.texture()
                self._frames.append(
                    (twin.data.qpos.copy(), wrenches, [_target(arm) for arm in applied.arms], painted)
                )
        self._at = len(self._frames) // 4  # the approach is over, what follows is contact

    def next(self, view: Any) -> None:
        qpos, wrenches, targets, painted = self._frames[self._at % len(self._frames)]
        self._at += 1
        view.update(qpos, wrenches, targets)
        if painted is not None:
            view.set_ink(painted[1])


def _target(action: ArmAction) -> Any:
    return action.target.base_from_target if isinstance(action.target, CartesianTarget) else None


def _paced(call: Callable[[], None], times: int, period: float) -> list[float]:
    """How long each call took [s], one each `period` [s]."""
    took = []
    due = time.monotonic()
    for _ in range(times):
        begin = time.perf_counter()
        call()
        took.append(time.perf_counter() - begin)
        due += period
        time.sleep(max(0.0, due - time.monotonic()))
    return took


def _decode(window: bytes) -> dict[str, Any]:
    """viser's frame: two sizes, msgpack in zstd, then the raw arrays."""
    packed = int.from_bytes(window[8:16], "little")
    decoded: dict[str, Any] = msgspec.msgpack.decode(
        zstandard.ZstdDecompressor().decompress(window[16 : 16 + packed])
    )
    return decoded
