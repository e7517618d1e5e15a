"""What recording costs and how fast a take reads, on made-up steps: no simulator, no rendering."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import cv2
import numpy as np

from controller.types import (
    ARM_ROW,
    ARM_ROW_WIDTH,
    Action,
    Applied,
    ArmAction,
    ArmState,
    Array,
    CartesianTarget,
    Image,
    Observation,
    Snapshot,
    Step,
    Stiffness,
)
from studio.episode import Episode, Header, Outcome, open_episode
from studio.episode_writer import EpisodeWriter
from studio.recorder import SYNC_PERIOD, Recorder, new_episode_id
from studio.session import CONTROL_PERIOD, IMAGE_EVERY, SNAPSHOT_EVERY

ARMS = ("left", "right")
CAMERAS = ("front", "left_wrist", "right_wrist")
IMAGE_SHAPE = (240, 320, 3)
FAST_STEPS = 5  # in a control period


def measure(seconds: float = 60.0, recorded: float = 5.0) -> dict[str, float]:
    """The share of a core that the recorder needs besides JPEG, and how long it takes to read.

    A two-arm take with three cameras, whose images come as JPEG, is recorded in real time for `recorded`
    seconds; another of `seconds` is written and read. CPU time where it can be: others use the machine too.
    """
    with tempfile.TemporaryDirectory() as folder:
        share = _recorder_share(Path(folder), recorded)
        path = Path(folder) / "read.mcap"
        write_take(path, made_up_header(), seconds)
        columns = [_columns_cpu(path) for _ in range(3)]
        with open_episode(path) as episode:
            frames = _frame_times(episode, n=100)
        return {
            "recorder_share_of_core": share,
            "columns_cpu_s": median(columns),
            "frame_ms": median(frames) * 1e3,
            "frame_ms_worst": max(frames) * 1e3,
            "take_MB": path.stat().st_size / 1e6,
        }


def made_up_header(arms: tuple[str, ...] = ARMS, cameras: tuple[str, ...] = CAMERAS) -> Header:
    height, width, _ = IMAGE_SHAPE
    return Header(
        episode_id=new_episode_id("made-up"),
        task="made-up",
        instruction="move",
        agent="none",
        operator="nobody",
        robot="made-up",
        arms=arms,
        cameras={camera: (width, height) for camera in cameras},
        started=time.time(),
        seed=0,
    )


def made_up_steps(n: int, header: Header, jpeg: bool = True) -> Iterator[Step]:
    """`n` steps of noise with the shape, the size and the times of real ones.

    Images are textured, their JPEGs of about 19 kB. With `jpeg` False they come as pixels only.
    """
    rng = np.random.default_rng(0)
    pictures = [_picture(rng) for _ in range(8)]
    board = np.zeros((200, 200), np.uint8)
    traces = rng.normal(size=(n, len(header.arms), FAST_STEPS, ARM_ROW_WIDTH))
    poses = traces[..., ARM_ROW["base_from_tcp"]]
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    fast = CONTROL_PERIOD / FAST_STEPS
    traces[..., 0] = (np.arange(n)[:, None, None] * FAST_STEPS + np.arange(1, FAST_STEPS + 1)) * fast
    states = tuple(ArmState.from_row(np.concatenate(([0.0], row[1:]))) for row in traces[-1, :, -1])
    for tick, trace in enumerate(traces):
        now = states[0].time
        images = {}
        if tick % IMAGE_EVERY == 0:
            for number, camera in enumerate(header.cameras):
                pixels, encoded = pictures[(tick // IMAGE_EVERY + number) % len(pictures)]
                images[camera] = Image(now, pixels, encoded if jpeg else None)
            board[tick % 200] = rng.integers(0, 2, 200)
        action = Action(
            tuple(
                ArmAction(
                    CartesianTarget(state.base_from_tcp, Stiffness.diagonal(rng.uniform(20, 750, 6))), 0.5
                )
                for state in states
            )
        )
        yield Step(
            observation=Observation(now, states, images),
            requested=action,
            applied=Applied(action, (), trace),
            digest=rng.bytes(16),
            task_state={"board": board.copy(), "objects": trace[0, 0, :14]}
            if tick % IMAGE_EVERY == 0
            else None,
            snapshot=Snapshot({"mujoco": rng.normal(size=500)}) if tick % SNAPSHOT_EVERY == 0 else None,
        )
        states = tuple(ArmState.from_row(rows[-1]) for rows in trace)


def _picture(rng: np.random.Generator) -> tuple[Array, bytes]:
    """(h, w, 3) uint8 RGB, and its JPEG."""
    smooth = cv2.GaussianBlur(rng.integers(0, 256, IMAGE_SHAPE).astype(np.uint8), (0, 0), 3)
    pixels = cv2.addWeighted(smooth, 1.0, rng.integers(0, 26, IMAGE_SHAPE).astype(np.uint8), 1.0, 0.0)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return pixels, bytes(jpeg)


def _recorder_share(folder: Path, seconds: float) -> float:
    """CPU seconds of the whole process less those of the loop that feeds it, per second of real time."""
    header = made_up_header()
    steps = list(made_up_steps(round(seconds / CONTROL_PERIOD), header))
    with Recorder(folder, min_free=0.0).start(header) as take:
        begin, busy = time.monotonic(), time.process_time() - time.thread_time()
        for number, step in enumerate(steps):
            take.on_step(step)
            time.sleep(max(0.0, begin + (number + 1) * CONTROL_PERIOD - time.monotonic()))
        elapsed = time.monotonic() - begin
        take.finish(Outcome(None, "measured"))
        if take.error:
            raise RuntimeError(take.error)
        return (time.process_time() - time.thread_time() - busy) / elapsed


def write_take(path: Path, header: Header, seconds: float) -> None:
    """With chunks of the size that a recorder makes."""
    writer = EpisodeWriter(path, header)
    for number, step in enumerate(made_up_steps(round(seconds / CONTROL_PERIOD), header)):
        writer.add(step, time.time())
        if number % round(SYNC_PERIOD / CONTROL_PERIOD) == 0:
            writer.flush()
    writer.finish(Outcome(None, "written"))


def _columns_cpu(path: Path) -> float:
    """CPU seconds to open a take and decode all of its columns."""
    begin = time.process_time()
    with open_episode(path) as episode:
        episode.columns()
    return time.process_time() - begin


def _frame_times(episode: Episode, n: int) -> list[float]:
    """[s] of real time for each of `n` images picked at random."""
    rng, times = np.random.default_rng(0), []
    for _ in range(n):
        camera = CAMERAS[rng.integers(len(CAMERAS))]
        index = int(rng.integers(len(episode.image_times(camera))))
        begin = time.perf_counter()
        episode.image(camera, index)
        times.append(time.perf_counter() - begin)
    return times
