"""Camera images, rendered in a process of their own from the twin's state.

The parent sends joint positions and painted textures, the child answers with JPEGs and pixels. No OpenGL is
ever loaded into the process that carries the robot: where it is missing, hangs or aborts, `RenderedCameras`
goes dark, says why (`error`) and the robot goes on. The child is `studio.rendering`.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from typing import IO, TYPE_CHECKING

import numpy as np

from controller.types import Array, Image
from studio import tasks
from studio.channels import Latest
from studio.rendering import ANSWER, READY, REQUEST
from studio.session import CONTROL_PERIOD, IMAGE_EVERY

if TYPE_CHECKING:
    from studio.twin import Twin

HEIGHT, WIDTH = 240, 320  # [px]
PERIOD = IMAGE_EVERY * CONTROL_PERIOD  # [s]
START_TIMEOUT = 60.0  # [s] for Python, MuJoCo and the model on a busy machine
IMAGE_TIMEOUT = 10.0  # [s] a child that takes longer for one set of images is given up
BACKENDS = ("egl", "osmesa")
PACKAGES = "libegl1 libgl1 libgl1-mesa-dri"


class CameraProcess:
    """The child of one task's scene. Not for two threads at once."""

    def __init__(
        self, task: str, height: int = HEIGHT, width: int = WIDTH, *, hide_objects: bool = False
    ) -> None:
        """Start it with the first OpenGL that works. Raises RuntimeError with what to install.

        `hide_objects` leaves out what is painted and the objects that no hand holds at the start.
        """
        self.names = tuple(view.name for view in tasks.load(task).cameras)
        self._shape = (height, width, 3)
        reasons = []
        for backend in BACKENDS:
            self._child = _start(task, height, width, hide_objects, backend)
            try:
                self._read(len(READY), START_TIMEOUT)
                return
            except (EOFError, TimeoutError) as error:
                reasons.append(f"{backend}: {self._last_words() or error}")
                self.close()
        raise RuntimeError(
            f"No camera images: offscreen rendering failed ({'; '.join(reasons)}). "
            f"On Debian: apt-get install {PACKAGES}"
        )

    @property
    def pid(self) -> int:
        return self._child.pid

    def render(
        self, time: float, qpos: Array, texture: Array | None, want_pixels: bool = True
    ) -> dict[str, Image]:
        """One image of each camera at joint positions `qpos`; `texture` (h, w, 3) only where it changed.

        Raises EOFError where the child has died, TimeoutError where it hangs.
        """
        painted = b"" if texture is None else np.ascontiguousarray(texture, np.uint8).tobytes()
        positions = np.ascontiguousarray(qpos, np.float64).tobytes()
        head = REQUEST.pack(len(positions), len(painted), want_pixels)
        try:
            self._child.stdin.write(head + positions + painted)
            self._child.stdin.flush()
        except (BrokenPipeError, ValueError):
            raise EOFError("the camera process has ended") from None
        return {name: self._read_image(time) for name in self.names}

    def close(self) -> None:
        """End the child; safe to call twice."""
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout, self._child.stderr):
            if pipe:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _read_image(self, time: float) -> Image:
        n_jpeg, n_pixels = ANSWER.unpack(self._read(ANSWER.size, IMAGE_TIMEOUT))
        jpeg = self._read(n_jpeg, IMAGE_TIMEOUT)
        if not n_pixels:
            return Image(time, None, jpeg)
        pixels = np.frombuffer(self._read(n_pixels, IMAGE_TIMEOUT), np.uint8)
        return Image(time, pixels.reshape(self._shape), jpeg)

    def _read(self, size: int, timeout: float) -> bytes:
        pipe, parts, deadline = self._child.stdout.fileno(), [], time.monotonic() + timeout
        while size:
            if not select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError(f"the camera process gave no answer for {timeout:.0f} s")
            part = os.read(pipe, size)
            if not part:
                raise EOFError("the camera process has ended")
            parts.append(part)
            size -= len(part)
        return b"".join(parts)

    def _last_words(self) -> str:
        self._child.kill()
        lines = self._child.stderr.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


class _Child(subprocess.Popen[bytes]):
    """A process with all three pipes."""

    stdin: IO[bytes]
    stdout: IO[bytes]
    stderr: IO[bytes]


def _start(task: str, height: int, width: int, hide_objects: bool, backend: str) -> _Child:
    hidden = ["--hide-objects"] if hide_objects else []
    return _Child(
        [sys.executable, "-m", "studio.rendering", task, str(height), str(width), *hidden],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "MUJOCO_GL": backend},
    )


class RenderedCameras:
    """Images at 20 Hz of simulated time, rendered while the robot waits: for runs that are not live.

    `hide_objects` as in `CameraProcess`: a control of whether an agent needs to see them.
    """

    def __init__(
        self, task: str, height: int = HEIGHT, width: int = WIDTH, *, hide_objects: bool = False
    ) -> None:
        self.error: str | None = None  # why there are no images any more
        self._images: Mapping[str, Image] = {}
        self._texture: Array = np.empty(0)
        self._due = 0.0
        try:
            self._process: CameraProcess | None = CameraProcess(
                task, height, width, hide_objects=hide_objects
            )
        except RuntimeError as error:
            self._process, self.error = None, str(error)

    def newest(self, twin: Twin) -> Mapping[str, Image]:
        """The newest images; rendered afresh where 50 ms have passed since the last, or none at all."""
        if self._process is None:
            return {}
        now = twin.data.time
        if -PERIOD < now - self._due < -1e-9 and self._images:
            return self._images
        painted = twin.task.texture()
        texture = painted[1] if painted else None
        changed = texture is not None and not np.array_equal(texture, self._texture)
        try:
            self._images = self._process.render(now, twin.data.qpos, texture if changed else None)
        except (EOFError, TimeoutError) as error:
            self.error = f"No more camera images: {error}."
            self.close()
            return {}
        self._texture = self._texture if texture is None else texture
        self._due = now + PERIOD
        return self._images

    def close(self) -> None:
        if self._process is not None:
            self._process.close()
        self._process, self._images = None, {}


class LiveCameras:
    """Images at up to 20 Hz from a thread of its own: asking for them never waits.

    The thread renders the newest state that was offered; images carry that state's time. Only JPEGs travel.
    """

    def __init__(self, task: str, height: int = HEIGHT, width: int = WIDTH) -> None:
        self.error: str | None = None  # why there are no images
        self._size = (height, width)
        self._scene = tasks.load(task)  # an instance of its own, to paint the texture from a task state
        self._offered: Latest[tuple[float, Array, dict[str, Array]]] = Latest()
        self._wake = threading.Event()
        self._images: Mapping[str, Image] = {}
        self._due = 0.0
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="cameras", daemon=True)
        self._thread.start()

    def newest(self, twin: Twin) -> Mapping[str, Image]:
        """The newest images there are; offers the present state for the next where 50 ms have passed."""
        now = twin.data.time
        if not -PERIOD <= now - self._due < -1e-9:
            self._offered.set((now, twin.data.qpos.copy(), twin.task.state()))
            self._due = now + PERIOD
            self._wake.set()
        return self._images

    def clear(self) -> None:
        """Forget the images of a scene that is gone."""
        self._images = {}

    def close(self) -> None:
        self._ended = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        process = None
        try:
            process = CameraProcess(self._scene.name, *self._size)
            self._render(process)
        except (RuntimeError, EOFError, TimeoutError) as error:
            self._images = {}
            self.error = f"No camera images: {error}."
        finally:
            if process:
                process.close()

    def _render(self, process: CameraProcess) -> None:
        painted: Array = np.empty(0)
        while True:
            self._wake.wait()
            self._wake.clear()
            if self._ended:
                return
            offered, _ = self._offered.get()
            if offered is None:
                continue
            time, qpos, state = offered
            self._scene.restore(state)
            texture = self._scene.texture()
            changed = texture is not None and not np.array_equal(texture[1], painted)
            if texture and changed:
                painted = texture[1]
            self._images = process.render(time, qpos, painted if changed else None, want_pixels=False)
