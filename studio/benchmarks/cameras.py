"""What an image of the two-arm scene costs: CPU time of the camera process, with the OpenGL that is here."""

from __future__ import annotations

import os
import time
from pathlib import Path
from statistics import median

from studio import tasks
from studio.benchmarks import two_arms
from studio.cameras import HEIGHT, WIDTH, CameraProcess
from studio.twin import Twin

WARM_UP = 5  # sets of images
REPEATS = 5
SETS = 20  # of one image per camera, in each repeat: long against the 10 ms in which the kernel counts


def measure() -> dict[str, float | int]:
    """Medians over repeats of the mean per image, drawing and JPEG included."""
    twin = Twin(tasks.load(two_arms.Task.name))
    process = CameraProcess(two_arms.Task.name)
    try:
        _render(process, twin, WARM_UP)
        costs = [_cost(process, twin) for _ in range(REPEATS)]
    finally:
        process.close()
    cpu, wall = zip(*costs, strict=True)
    return {"cpu_ms": median(cpu), "wall_ms": median(wall), "height": HEIGHT, "width": WIDTH}


def _cost(process: CameraProcess, twin: Twin) -> tuple[float, float]:
    """[ms] of CPU and of real time per image."""
    n = SETS * len(process.names)
    begin, busy = time.perf_counter(), _cpu_seconds(process.pid)
    _render(process, twin, SETS)
    return (_cpu_seconds(process.pid) - busy) / n * 1e3, (time.perf_counter() - begin) / n * 1e3


def _render(process: CameraProcess, twin: Twin, n: int) -> None:
    for _ in range(n):
        process.render(twin.data.time, twin.data.qpos, None, want_pixels=False)


def _cpu_seconds(pid: int) -> float:
    """User and system time of a process, all of its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
