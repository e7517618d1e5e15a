"""Writes takes: one MCAP file each, `.part` until it is finished. What is in it: `studio.episode`."""

from __future__ import annotations

import fcntl
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from controller.types import ARM_ROW, Action, ArmState, Array, Image, Limit, Pose, Step
from studio import schema
from studio.edits import sync_folder
from studio.episode import HEADER_TOPIC, METADATA, PART, Event, Header, Outcome, log_zero
from studio.mcap_file import McapWriter
from studio.totals import METADATA as TOTALS
from studio.totals import ForceTally, StiffnessTally, Totals

JPEG_QUALITY = 90
FORCE = slice(ARM_ROW["wrench"].start, ARM_ROW["wrench"].start + 3)
VIEW_PERIOD = 1 / 30  # [s] between messages for viewers

Message = tuple[str, str, int, Any]  # topic, name of schema, log time [ns], message or its wire form


class EpisodeWriter:
    """Writes one take, from one thread. After `flush` it outlives a crash, after `sync` a power cut."""

    def __init__(self, path: Path, header: Header) -> None:
        """Open `path` with ".part" behind it, which `finish` takes off."""
        if path.exists():
            raise FileExistsError(f"{path} exists; takes are never overwritten.")
        _make_folder(path.parent)
        self.header = header
        self.path = path
        self.time = 0.0  # [s] since reset: the newest state written
        self._part = path.with_name(path.name + PART)
        self._file = _create_locked(self._part)
        self._zero = log_zero(header.started)
        self._mcap = start_file(self._file, header.to_json(), self._zero)
        self._n_ticks = 0
        self._forces, self._stiffness = ForceTally(), StiffnessTally(header.control)
        self._begin = self._end = 0  # [ns] log times of the first state and the newest
        self._n_view = -1  # periods of the viewers that have begun
        self._shown: dict[str, float] = {}  # camera -> time of its newest image
        bases: list[Pose | None] = [Pose.from_vector(np.array(pose)) for pose in header.world_from_base]
        self._arms = tuple(
            schema.ArmView(arm, tuple(f"{arm}_{joint}" for joint in header.joints), base)
            for arm, base in zip(header.arms, bases or [None] * len(header.arms), strict=True)
        )
        self.sync()
        sync_folder(path.parent)

    def add(self, step: Step, wall: float) -> None:
        """Write one control period, told at the unix time `wall` [s], or raise and write none of it."""
        traces = self._traces(step)
        messages = list(self._messages(step, wall, traces))
        for message in messages:
            add_message(self._mcap, message, round(wall * 1e9))
        for trace in traces:
            self._forces.add(trace[..., FORCE])
        self._stiffness.add(step.applied.action)
        if self._n_ticks == 0:
            self._begin = self._log_time(float(traces[0][0, 0, 0]))
        self._end = self._log_time(float(traces[-1][0, -1, 0]))
        self._n_ticks += 1
        self.time = float(step.applied.trace[0, -1, 0])

    def add_event(self, event: Event) -> None:
        add_message(self._mcap, event_message(event, self._log_time(event.time)), time.time_ns())

    def flush(self) -> None:
        """Hand what was added to the operating system."""
        self._mcap.flush()

    def sync(self) -> None:
        """Put what was added on the disk."""
        self._mcap.flush()
        os.fdatasync(self._file.fileno())

    def finish(self, outcome: Outcome) -> Path:
        """End the take and return `path`, which then is on the disk."""
        add_message(
            self._mcap, outcome_message(outcome, self.time, self._log_time(self.time)), time.time_ns()
        )
        self._mcap.add_metadata(TOTALS, self._totals(outcome).to_entries())
        self._mcap.finish()
        put_in_place(self._file, self._part, self.path)
        self.close()
        return self.path

    def close(self) -> None:
        """Give up the file and its lock. A take that is not finished stays as `.part`, for `recover`."""
        self._file.close()

    def _totals(self, outcome: Outcome) -> Totals:
        cameras = dict.fromkeys((*self.header.cameras, *self._shown))
        return Totals(
            duration=(self._end - self._begin) * 1e-9,
            peak_force=self._forces.peak,
            mean_force=self._forces.mean,
            cameras=tuple(cameras),
            success=outcome.success,
            progress=None if math.isnan(outcome.progress) else outcome.progress,
            stiffness_share=self._stiffness.shares,
        )

    def _traces(self, step: Step) -> list[Array]:
        """The states to write, each (arms, n, ARM_ROW_WIDTH): with the very first, where none was yet."""
        trace, arms = step.applied.trace, step.observation.arms
        if self._n_ticks == 0 and len(arms) == len(trace) and trace[0, 0, 0] > step.observation.time:
            return [np.stack([_row_of(state)[None] for state in arms]), trace]
        return [trace]

    def _messages(self, step: Step, wall: float, traces: list[Array]) -> Iterator[Message]:
        """Everything to write about a step, its tick last: recovery drops what has no tick."""
        arms, observation, now = self.header.arms, step.observation, step.observation.time
        if {len(observation.arms), len(step.requested.arms), len(step.applied.trace)} != {len(arms)}:
            raise ValueError(f"A step of {len(observation.arms)} arms in a take of {arms}.")
        ns = self._log_time(now)
        for trace in traces:
            yield from self._states(trace)
        yield from self._actions(now, {"requested": step.requested, "applied": step.applied.action})
        yield from self._images(observation.images)
        if step.task_state is not None:
            yield "/task_state", "studio.v1.Arrays", ns, schema.arrays_message(now, step.task_state)
        if step.snapshot is not None:
            yield "/snapshot", "studio.v1.Arrays", ns, schema.arrays_message(now, step.snapshot.arrays)
        for arm, timing in zip(arms, step.inputs, strict=False):
            if timing is not None:
                row = np.array([[now, timing.age, timing.latency, timing.jitter]])
                yield f"/{arm}/input", "studio.v1.Input", ns, schema.INPUT.encode(row)[0]
        if step.applied.limits:
            yield _limits_message(step.applied.limits, now, ns)
        if (n_view := math.floor(now / VIEW_PERIOD + 1e-6)) != self._n_view:
            self._n_view = n_view
            for topic, name, message in schema.view(ns, self._arms, observation, step.applied.action):
                yield topic, name, ns, message
        (numbers,) = schema.TICK.encode(np.array([[now, wall, step.late]]))
        rest = schema.message("studio.v1.Tick")(number=self._n_ticks, digest=step.digest)
        yield "/tick", "studio.v1.Tick", ns, numbers + rest.SerializeToString()

    def _states(self, trace: Array) -> Iterator[Message]:
        """From (arms, n, ARM_ROW_WIDTH)."""
        rows = trace.reshape(-1, trace.shape[-1])
        topics = (f"/{arm}/state" for arm in self.header.arms for _ in range(trace.shape[1]))
        for topic, at, wire in zip(topics, rows[:, 0].tolist(), schema.STATE.encode(rows), strict=True):
            yield topic, "studio.v1.ArmState", self._log_time(at), wire

    def _actions(self, now: float, actions: Mapping[str, Action]) -> Iterator[Message]:
        wires = iter(schema.encode_actions(now, [arm for action in actions.values() for arm in action.arms]))
        for which in actions:
            for arm in self.header.arms:
                yield f"/{arm}/{which}", "studio.v1.ArmAction", self._log_time(now), next(wires)

    def _images(self, images: Mapping[str, Image]) -> Iterator[Message]:
        for camera, image in images.items():
            if image.time > self._shown.get(camera, -math.inf):
                self._shown[camera] = image.time
                ns = self._log_time(image.time)
                jpeg = schema.compressed_image(ns, camera, _jpeg_of(image))
                yield f"/camera/{camera}", "foxglove.CompressedImage", ns, jpeg

    def _log_time(self, at: float) -> int:
        """[ns] of the simulated time `at` [s]."""
        return self._zero + round(at * 1e9)


def _row_of(state: ArmState) -> Array:
    """(33,) of `ARM_ROW`."""
    parts = (state.q, state.dq, state.q_command, state.base_from_tcp.vector, state.wrench.vector)
    return np.concatenate(([state.time], *parts, [state.gripper]))


def _jpeg_of(image: Image) -> bytes:
    if image.jpeg is not None:
        return image.jpeg
    assert image.pixels is not None
    bgr = cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR)
    done, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"OpenCV could not encode an image of {bgr.shape} {bgr.dtype}.")
    return bytes(jpeg)


def start_file(file: IO[bytes], header: str, ns: int) -> McapWriter:
    """The header goes in twice: as metadata to find it, as a message for viewers."""
    mcap = McapWriter(file, "comp-act studio")
    mcap.add_metadata(METADATA, {"header": header})
    add_message(
        mcap, (HEADER_TOPIC, "studio.v1.Header", ns, schema.message("studio.v1.Header")(json=header)), ns
    )
    return mcap


def add_message(mcap: McapWriter, message: Message, publish_ns: int) -> None:
    topic, name, ns, content = message
    if not mcap.has_topic(topic):
        mcap.add_topic(topic, name, schema.descriptor_set(name))
    mcap.add(topic, content if isinstance(content, bytes) else content.SerializeToString(), ns, publish_ns)


def event_message(event: Event, ns: int) -> Message:
    message = schema.message("studio.v1.Event")(time=[event.time], kind=event.kind, text=event.text)
    return "/events", "studio.v1.Event", ns, message


def outcome_message(outcome: Outcome, at: float, ns: int) -> Message:
    message = schema.message("studio.v1.Outcome")(
        time=[at], success=outcome.success, reason=outcome.reason, progress=outcome.progress
    )
    return "/outcome", "studio.v1.Outcome", ns, message


def _limits_message(limits: tuple[Limit, ...], at: float, ns: int) -> Message:
    limit = schema.message("studio.v1.Limit")
    told = [limit(arm=x.arm, kind=x.kind, why=x.why, refused=x.refused) for x in limits]
    return "/limits", "studio.v1.Limits", ns, schema.message("studio.v1.Limits")(time=[at], limits=told)


def _create_locked(part: Path) -> IO[bytes]:
    """Create `part` and lock it for as long as it is open, so that recovery leaves it alone."""
    while True:
        file = part.open("xb")
        fcntl.flock(file, fcntl.LOCK_EX)
        if is_at(file, part):
            return file
        file.close()  # a recovery came between the two calls and put the empty file aside


def lock(file: IO[bytes]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_at(file: IO[bytes], path: Path) -> bool:
    """Whether `path` still names the open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def put_in_place(file: IO[bytes], written: Path, path: Path) -> None:
    """Rename `written`, which is open as `file`, when all of it is on the disk."""
    file.flush()
    os.fsync(file.fileno())
    written.rename(path)
    sync_folder(path.parent)


def _make_folder(folder: Path) -> None:
    """Make a folder and those above it, on the disk."""
    if not folder.exists():
        _make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)
