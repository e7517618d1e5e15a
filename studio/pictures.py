"""Pictures of the tasks for people: what each camera sees in the course of a demonstration."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from controller.types import Array
from studio import tasks
from studio.cameras import HEIGHT, WIDTH, CameraProcess
from studio.inputs.scripted import ScriptedAgent
from studio.session import CONTROL_PERIOD
from studio.twin import Twin

MOMENTS = (0.05, 0.4, 0.6, 0.95)  # shares of the demonstration
EVERY = 25  # ticks between two states that may be shown
SIZE = (256, 192)  # [px] of one image; the policy sees it at WIDTH x HEIGHT
CAPTION = 20  # [px] above it
GAP = 4  # [px] between two columns
JPEG_QUALITY = 85

State = tuple[str, float, Array, Array | None]  # phase, time [s], joint positions, painted texture


def write_picture(task: str, path: Path, seed: int = 0) -> None:
    """One JPEG: a row for each camera of `task`, a column for each of the moments.

    Raises RuntimeError where nothing can be rendered.
    """
    states = _demonstrate(task, seed)
    moments = [states[round(share * (len(states) - 1))] for share in MOMENTS]
    process = CameraProcess(task, HEIGHT, WIDTH)
    try:
        columns = [_column(process, state) for state in moments]
    finally:
        process.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack(columns)[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))


def _demonstrate(task: str, seed: int) -> list[State]:
    twin = Twin(tasks.load(task))
    twin.reset(seed)
    agent = ScriptedAgent(twin, seed)
    agent.reset(twin.observe())
    states: list[State] = []
    tick = 0
    while (action := agent.act(twin.observe())) is not None:
        twin.apply(action)
        if tick % EVERY == 0:
            painted = twin.task.texture()
            texture = painted[1] if painted else None
            states.append((twin.progress().phase, tick * CONTROL_PERIOD, twin.data.qpos.copy(), texture))
        tick += 1
    return states


def _column(process: CameraProcess, state: State) -> Array:
    """(height, SIZE[0] + GAP, 3) uint8: the images of one moment below each other."""
    phase, time, qpos, texture = state
    images = process.render(time, qpos, texture)
    parts = []
    for name, image in images.items():
        assert image.pixels is not None
        parts += [
            _caption(f"{name}, {time:.0f} s: {phase}"),
            cv2.resize(image.pixels, SIZE, interpolation=cv2.INTER_AREA),
        ]
    return np.pad(np.vstack(parts), ((0, 0), (0, GAP), (0, 0)), constant_values=255)


def _caption(text: str) -> Array:
    strip = np.full((CAPTION, SIZE[0], 3), 255, np.uint8)
    cv2.putText(strip, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40), 1, cv2.LINE_AA)
    return strip
