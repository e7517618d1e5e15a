"""A take on disk: one MCAP file, written once, never edited. The only file that knows MCAP.

    <id>.mcap.part    while it is recorded, locked by its writer
    <id>.mcap         finished

Every message is logged at the simulated time of what it tells, counted from `Header.started`; its publish
time is the wall clock. Topics:

    /header                                       the header as JSON, first of all messages
    /{arm}/state                                  500 Hz, packed `ArmState`
    /{arm}/requested  /{arm}/applied  /tick       100 Hz
    /{arm}/input                                  100 Hz while a tracked hand leads the arm
    /camera/{name}    /task_state                 20 Hz
    /snapshot                                     1 Hz
    /limits  /events  /outcome                    when there is something to tell
    /joint_states  /tf  /forces  /{arm}/tcp_pose  /{arm}/target_pose      30 Hz, for viewers only
"""

from __future__ import annotations

import dataclasses
import fcntl
import itertools
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

import cv2
import numpy as np
from mcap import records

from controller.types import Action, ArmAction, ArmState, Array, Image, Limit, Pose, Snapshot, Step
from studio import schema
from studio.edits import sync_folder
from studio.mcap_file import EpisodeError, McapFile, McapWriter, read_until_torn

__all__ = [
    "Episode",
    "EpisodeError",
    "EpisodeWriter",
    "Event",
    "Header",
    "Outcome",
    "Recovery",
    "open_episode",
    "recover",
    "recover_all",
]

FORMAT_VERSION = 1
JPEG_QUALITY = 90
PART = ".part"  # behind the name of a take that is being recorded
VIEW_PERIOD = 1 / 30  # [s] between messages for viewers
MIGRATIONS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}  # header of version n -> of n + 1

_METADATA = "comp-act studio"  # name of the MCAP metadata record with the header
_HEADER_TOPIC = "/header"
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


@dataclass(frozen=True, slots=True)
class Header:
    """What one needs to know to read a take. Flat, JSON on disk; fields unknown to this version are kept."""

    episode_id: str
    task: str
    instruction: str
    agent: str
    operator: str
    robot: str
    arms: tuple[str, ...]  # e.g. ("left", "right"): the order of every per-arm tuple
    started: float  # [s] unix time of simulated time zero
    seed: int | None = None
    spread: float = 1.0  # share of the task's range of initial states
    cameras: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # (width, height) [px]
    joints: tuple[str, ...] = tuple(f"joint_{n}" for n in range(1, 7))  # of one arm, base to wrist
    world_from_base: tuple[tuple[float, ...], ...] = ()  # per arm: position [m], wxyz; () where not known
    versions: Mapping[str, str] = field(default_factory=dict)  # of code, libraries, machine
    control: Mapping[str, Any] = field(default_factory=dict)  # rates, servo and FDCC parameters, modes
    provenance: Mapping[str, Any] = field(default_factory=dict)  # of a policy: run, step, how it was run
    wrench_frame: str = "about the TCP, in base axes"
    wrench_sign: str = "what the environment exerts on the robot"
    wrench_tare: str = "weight behind the sensor compensated, zero taken in free space at reset"
    wrench_filter: str = "none"
    quaternion_order: str = "wxyz"
    stiffness_layout: str = "upper triangles xx xy xz yy yz zz: translational, then rotational block"
    units: str = "m, rad, s, N, N·m, N/m, N·m/rad; gripper 0 closed .. 1 open"
    format_version: int = FORMAT_VERSION
    extra: Mapping[str, Any] = field(default_factory=dict)  # fields that this version does not know

    def __post_init__(self) -> None:
        for name in (self.episode_id, self.task, *self.arms, *self.cameras):
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"{name!r} cannot be part of a file or topic name; use letters, digits, - _ ."
                )
        if not self.arms:
            raise ValueError("A take needs at least one arm.")
        if self.world_from_base and len(self.world_from_base) != len(self.arms):
            raise ValueError(f"{len(self.world_from_base)} base poses for the arms {self.arms}.")

    def to_json(self) -> str:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "extra"}
        return json.dumps({**self.extra, **fields}, ensure_ascii=False)

    @staticmethod
    def from_json(text: str) -> Header:
        """Raise `EpisodeError` on a newer version, or on what is not a header."""
        try:
            fields = _migrated(json.loads(text))
            known = {f.name for f in dataclasses.fields(Header)} - {"extra"}
            given = {name: value for name, value in fields.items() if name in known}
            for name in ("arms", "joints"):
                if name in given:
                    given[name] = tuple(given[name])
            if "world_from_base" in given:
                given["world_from_base"] = tuple(tuple(pose) for pose in given["world_from_base"])
            if "cameras" in given:
                given["cameras"] = {name: (w, h) for name, (w, h) in given["cameras"].items()}
            return Header(**given, extra={name: v for name, v in fields.items() if name not in known})
        except EpisodeError:
            raise
        except (TypeError, KeyError, AttributeError, ValueError) as error:
            raise EpisodeError(f"The header of the take cannot be read: {error}.") from error


def _migrated(fields: dict[str, Any]) -> dict[str, Any]:
    version = fields["format_version"]
    if version > FORMAT_VERSION:
        raise EpisodeError(
            f"The take has format version {version}, this Studio reads up to {FORMAT_VERSION}: update Studio."
        )
    for old in range(version, FORMAT_VERSION):
        if old not in MIGRATIONS:
            raise EpisodeError(f"No migration from format version {old}; there are {sorted(MIGRATIONS)}.")
        fields = {**MIGRATIONS[old](fields), "format_version": old + 1}
    return fields


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a take ended."""

    success: bool | None  # None: nobody judged
    reason: str
    progress: float = math.nan  # 0..1 at the end, NaN where the task does not measure it


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth finding again: an operator took over, a take was recovered."""

    time: float  # [s] since reset
    kind: str
    text: str


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
        self._zero = _log_zero(header.started)
        self._mcap = _start(self._file, header.to_json(), self._zero)
        self._n_ticks = 0
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
        messages = list(self._messages(step, wall))
        for message in messages:
            _add(self._mcap, message, round(wall * 1e9))
        self._n_ticks += 1
        self.time = float(step.applied.trace[0, -1, 0])

    def add_event(self, event: Event) -> None:
        _add(self._mcap, _event_message(event, self._log_time(event.time)), time.time_ns())

    def flush(self) -> None:
        """Hand what was added to the operating system."""
        self._mcap.flush()

    def sync(self) -> None:
        """Put what was added on the disk."""
        self._mcap.flush()
        os.fdatasync(self._file.fileno())

    def finish(self, outcome: Outcome) -> Path:
        """End the take and return `path`, which then is on the disk."""
        _add(self._mcap, _outcome_message(outcome, self.time, self._log_time(self.time)), time.time_ns())
        self._mcap.finish()
        _put_in_place(self._file, self._part, self.path)
        self.close()
        return self.path

    def close(self) -> None:
        """Give up the file and its lock. A take that is not finished stays as `.part`, for `recover`."""
        self._file.close()

    def _messages(self, step: Step, wall: float) -> Iterator[_Message]:
        """Everything to write about a step, its tick last: recovery drops what has no tick."""
        arms, observation, now = self.header.arms, step.observation, step.observation.time
        if {len(observation.arms), len(step.requested.arms), len(step.applied.trace)} != {len(arms)}:
            raise ValueError(f"A step of {len(observation.arms)} arms in a take of {arms}.")
        ns = self._log_time(now)
        if self._n_ticks == 0 and step.applied.trace[0, 0, 0] > now:  # the trace begins after the first state
            yield from self._states(np.stack([_row_of(state)[None] for state in observation.arms]))
        yield from self._states(step.applied.trace)
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

    def _states(self, trace: Array) -> Iterator[_Message]:
        """From (arms, n, ARM_ROW_WIDTH)."""
        rows = trace.reshape(-1, trace.shape[-1])
        topics = (f"/{arm}/state" for arm in self.header.arms for _ in range(trace.shape[1]))
        for topic, at, wire in zip(topics, rows[:, 0].tolist(), schema.STATE.encode(rows), strict=True):
            yield topic, "studio.v1.ArmState", self._log_time(at), wire

    def _actions(self, now: float, actions: Mapping[str, Action]) -> Iterator[_Message]:
        wires = iter(schema.encode_actions(now, [arm for action in actions.values() for arm in action.arms]))
        for which in actions:
            for arm in self.header.arms:
                yield f"/{arm}/{which}", "studio.v1.ArmAction", self._log_time(now), next(wires)

    def _images(self, images: Mapping[str, Image]) -> Iterator[_Message]:
        for camera, image in images.items():
            if image.time > self._shown.get(camera, -math.inf):
                self._shown[camera] = image.time
                ns = self._log_time(image.time)
                jpeg = schema.compressed_image(ns, camera, _jpeg_of(image))
                yield f"/camera/{camera}", "foxglove.CompressedImage", ns, jpeg

    def _log_time(self, at: float) -> int:
        """[ns] of the simulated time `at` [s]."""
        return self._zero + round(at * 1e9)


_Message = tuple[str, str, int, Any]  # topic, name of schema, log time [ns], message or its wire form


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


def open_episode(path: Path) -> Episode:
    """Open a finished take. Raise `EpisodeError` with what is wrong with the file, and what helps."""
    return Episode(path)


class Episode:
    """A finished take, read-only. May be used by several threads; close it, or use it in a `with`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._mcap = McapFile(path)
        try:
            self.header = Header.from_json(self._header_text())
        except EpisodeError as error:
            self._mcap.close()
            raise EpisodeError(f"{path}: {error}") from error

    def __enter__(self) -> Episode:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        self.close()

    def close(self) -> None:
        self._mcap.close()

    @property
    def outcome(self) -> Outcome:
        told = list(self._parsed("/outcome", "Outcome"))
        if not told:
            return Outcome(None, "no outcome was recorded")
        last = told[-1]
        success = last.success if last.HasField("success") else None
        return Outcome(success, last.reason, last.progress)

    @property
    def duration(self) -> float:
        """[s] of simulated time from the first state to the last."""
        ns = self._mcap.log_times(f"/{self.header.arms[0]}/state")
        return float(ns[-1] - ns[0]) * 1e-9 if len(ns) else 0.0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those of the header, and any other that sent an image."""
        sent = (topic.removeprefix("/camera/") for topic in self._mcap.topics if topic.startswith("/camera/"))
        return tuple(dict.fromkeys((*self.header.cameras, *sent)))

    def columns(self, *groups: str) -> dict[str, Array]:
        """The low-dimensional columns of all groups, or of some, by "group/column".

        {arm}/state       500 Hz, from the first state on: time (n,), q (n, 6), dq (n, 6), q_command (n, 6),
                          base_from_tcp (n, 7), wrench (n, 6), gripper (n,), as in `ArmState`
        {arm}/requested   100 Hz: time (m,), kind (m,) of "cartesian" "joint" "hold" "release",
        {arm}/applied     base_from_target (m, 7), stiffness (m, 12), q (m, 6), gripper (m,); NaN where absent
        {arm}/input       100 Hz while a tracked hand led the arm: time (k,), and of its newest pose age (k,),
                          latency (k,) from device to session and jitter (k,), all [s]
        tick              100 Hz: time (m,), wall (m,) unix time [s] when it was told, late (m,) [s]
        """
        layouts = {"tick": (schema.TICK, 0)}
        for arm in self.header.arms:
            layouts[f"{arm}/state"] = (schema.STATE, 0)
            layouts[f"{arm}/input"] = (schema.INPUT, 0)
            layouts[f"{arm}/requested"] = layouts[f"{arm}/applied"] = (schema.ACTION, schema.ACTION_HEAD)
        for group in groups:
            if group not in layouts:
                raise KeyError(f"No columns {group!r}; this episode has {sorted(layouts)}.")
        recorded = [group for group in layouts if "/input" not in group or f"/{group}" in self._mcap.topics]
        chosen = {group: layouts[group] for group in groups or recorded}
        wires = self._mcap.heads(
            {f"/{name}": start + packed.size for name, (packed, start) in chosen.items()}
        )
        columns: dict[str, Array] = {}
        for group, (packed, start) in chosen.items():
            columns |= {
                f"{group}/{name}": c for name, c in packed.decode(wires[f"/{group}"][:, start:]).items()
            }
            if packed is schema.ACTION:
                columns[f"{group}/kind"] = schema.kinds_of(wires[f"/{group}"])
        return columns

    def digests(self) -> list[bytes]:
        """The state hash after each tick; empty where the robot has none."""
        return [tick.digest for tick in self._parsed("/tick", "Tick")]

    def actions(self, which: Literal["requested", "applied"] = "requested") -> list[Action]:
        """One a tick, equal to the recorded ones to the bit."""
        columns = self.columns(*(f"{arm}/{which}" for arm in self.header.arms))
        arms = []
        for arm in self.header.arms:
            names = ("kind", "base_from_target", "stiffness", "q", "gripper")
            rows = zip(*(columns[f"{arm}/{which}/{name}"] for name in names), strict=True)
            arms.append([ArmAction(schema.target_of(*row[:-1]), float(row[-1])) for row in rows])
        return [Action(action) for action in zip(*arms, strict=True)]

    def task_states(self) -> Iterator[tuple[float, dict[str, Array]]]:
        """(time [s], arrays) at 20 Hz: the state at the start of a tick."""
        return map(schema.decode_arrays, self._mcap.messages("/task_state"))

    def task_state_times(self) -> Array:
        """(n,) [s] time of each of `task_states`, to the nanosecond."""
        return self._times("/task_state")

    def task_state_at(self, time: float) -> dict[str, Array]:
        """The newest at or before `time` [s] (else the first); empty where the take has none."""
        number = self._number_at("/task_state", time)
        return {} if number is None else schema.decode_arrays(self._mcap.message("/task_state", number))[1]

    def snapshots(self) -> Iterator[tuple[float, Snapshot]]:
        """(time [s], what decides the robot's future) once a second: the state at the start of a tick."""
        for at, arrays in map(schema.decode_arrays, self._mcap.messages("/snapshot")):
            yield at, Snapshot(arrays)

    def limits(self) -> list[tuple[float, tuple[Limit, ...]]]:
        """(time [s], limits that acted) of the ticks in which there were any."""
        return [
            (tick.time[0], tuple(Limit(x.arm, x.kind, x.why, x.refused) for x in tick.limits))
            for tick in self._parsed("/limits", "Limits")
        ]

    def events(self) -> list[Event]:
        return [Event(told.time[0], told.kind, told.text) for told in self._parsed("/events", "Event")]

    def image_times(self, camera: str) -> Array:
        """(n,) [s] time of the state that each image shows, to the nanosecond."""
        return self._times(self._camera_topic(camera))

    def image_ticks(self, camera: str) -> Array:
        """(n,) the tick whose observation each image shows: the newest at or before the image's time."""
        ticks, shown = self._mcap.log_times("/tick"), self._mcap.log_times(self._camera_topic(camera))
        found: Array = np.searchsorted(ticks, shown, side="right") - 1
        return found.clip(min=0)

    def jpeg(self, camera: str, index: int) -> bytes:
        topic = self._camera_topic(camera)
        n = len(self._mcap.log_times(topic))
        if not 0 <= index < n:
            raise IndexError(f"No image {index} of camera {camera!r}; this episode has {n} of them.")
        return bytes(
            schema.message("foxglove.CompressedImage").FromString(self._mcap.message(topic, index)).data
        )

    def image(self, camera: str, index: int) -> Array:
        """(h, w, 3) uint8, RGB."""
        data = np.frombuffer(self.jpeg(camera, index), np.uint8)
        pixels: Array = cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        return pixels

    def image_at(self, camera: str, time: float) -> Array:
        """The newest image at or before `time` [s], else the first: (h, w, 3) uint8, RGB."""
        return self.image(camera, self._number_at(self._camera_topic(camera), time) or 0)

    def _camera_topic(self, camera: str) -> str:
        if camera not in self.cameras:
            raise KeyError(f"No camera {camera!r}; this episode has {sorted(self.cameras)}.")
        return f"/camera/{camera}"

    def _header_text(self) -> str:
        entries = self._mcap.metadata(_METADATA)
        if entries is None:
            raise EpisodeError("This is an MCAP file, but not a take of Studio: it has no header.")
        return entries["header"]

    def _parsed(self, topic: str, name: str) -> Iterator[Any]:
        return map(schema.message(f"studio.v1.{name}").FromString, self._mcap.messages(topic))

    def _times(self, topic: str) -> Array:
        """(n,) [s] since reset of the messages of a topic."""
        times: Array = (self._mcap.log_times(topic) - _log_zero(self.header.started)) * 1e-9
        return times

    def _number_at(self, topic: str, time: float) -> int | None:
        """Of the newest message at or before `time` [s], else of the first."""
        ns = self._mcap.log_times(topic) - _log_zero(self.header.started)
        return max(0, int(np.searchsorted(ns, round(time * 1e9), side="right")) - 1) if len(ns) else None


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of a `.part`."""

    part: Path
    state: Literal["recovered", "live", "unreadable", "failed"]
    what: str  # a sentence
    episode: Path | None = None  # the finished take, where there is one


def recover_all(data_dir: Path) -> list[Recovery]:
    """Recover every `.part` below `data_dir`/episodes; takes that are being recorded stay as they are."""
    return [recover(part) for part in sorted((data_dir / "episodes").glob(f"*/*.mcap{PART}"))]


def recover(part: Path) -> Recovery:
    """Make a finished take of what a torn `.part` holds.

    The torn file goes only when the new one is on the disk. One that holds no take is put aside as
    `.unreadable`, one that its writer still has open is left alone.
    """
    episode = part.with_name(part.name.removesuffix(PART))
    try:
        with part.open("r+b") as file:
            if not _lock(file) or not _is_at(file, part):
                return Recovery(part, "live", f"{part.name} is being recorded.")
            if episode.exists():
                aside = _put_aside(part, ".duplicate")
                return Recovery(
                    part, "recovered", f"{episode.name} was there; moved to {aside.name}.", episode
                )
            seconds = _copy_readable(file, episode)
            if seconds is None:
                aside = _put_aside(part, ".unreadable")
                return Recovery(part, "unreadable", f"{part.name} holds no take; moved to {aside.name}.")
            part.unlink()
            return Recovery(part, "recovered", f"Recovered {seconds:.1f} s of {episode.name}.", episode)
    except FileNotFoundError:
        return Recovery(part, "live", f"{part.name} was finished meanwhile.")
    except OSError as error:
        return Recovery(part, "failed", f"{part.name} is kept as it is: {error}.")


def _copy_readable(torn: IO[bytes], episode: Path) -> float | None:
    """Copy what comes before the tear into a finished `episode`; return its seconds, None without header."""
    found = read_until_torn(torn)
    header = next(filter(None, map(_header_in, found)), None)
    if header is None:
        return None
    zero = _log_zero(json.loads(header).get("started", 0.0))  # whatever version wrote it
    copy = episode.with_name(episode.name + ".recovering")
    with copy.open("wb") as file:
        mcap = _start(file, header, zero)
        end = _copy_messages(found, mcap, zero)
        seconds = (end - zero) * 1e-9
        event = Event(seconds, "recovered", "The recording was cut off; this is what had reached the disk.")
        _add(mcap, _event_message(event, end), time.time_ns())
        if not mcap.has_topic("/outcome"):
            outcome = Outcome(None, "recovered after the recording was cut off")
            _add(mcap, _outcome_message(outcome, seconds, end), time.time_ns())
        mcap.finish()
        _put_in_place(file, copy, episode)
    return seconds


def _copy_messages(found: Iterator[records.McapRecord], mcap: McapWriter, end: int) -> int:
    """Copy whole steps, each up to its tick, and events; return the newest log time, or `end`."""
    schemas: dict[int, records.Schema] = {}
    channels: dict[int, records.Channel] = {}
    step: list[tuple[str, records.Message]] = []
    for record in found:
        match record:
            case records.Schema():
                schemas[record.id] = record
            case records.Channel():
                channels[record.id] = record
            case records.Message() if channels[record.channel_id].topic != _HEADER_TOPIC:
                topic = channels[record.channel_id].topic
                if not mcap.has_topic(topic):
                    described = schemas[channels[record.channel_id].schema_id]
                    mcap.add_topic(topic, described.name, described.data)
                step.append((topic, record))
                if topic in ("/tick", "/events", "/outcome"):
                    for where, message in step:
                        mcap.add(where, message.data, message.log_time, message.publish_time)
                        end = max(end, message.log_time)
                    step.clear()
    return end


def _header_in(record: records.McapRecord) -> str | None:
    if isinstance(record, records.Metadata) and record.name == _METADATA:
        return record.metadata["header"]
    return None


def _create_locked(part: Path) -> IO[bytes]:
    """Create `part` and lock it for as long as it is open, so that recovery leaves it alone."""
    while True:
        file = part.open("xb")
        fcntl.flock(file, fcntl.LOCK_EX)
        if _is_at(file, part):
            return file
        file.close()  # a recovery came between the two calls and put the empty file aside


def _lock(file: IO[bytes]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_at(file: IO[bytes], path: Path) -> bool:
    """Whether `path` still names the open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _put_in_place(file: IO[bytes], written: Path, path: Path) -> None:
    """Rename `written`, which is open as `file`, when all of it is on the disk."""
    file.flush()
    os.fsync(file.fileno())
    written.rename(path)
    sync_folder(path.parent)


def _put_aside(path: Path, suffix: str) -> Path:
    """Rename `path` to a free name that ends in `suffix`."""
    for number in itertools.count():
        aside = path.with_name(f"{path.name}{f'.{number}' if number else ''}{suffix}")
        if not aside.exists():
            return path.rename(aside)
    raise AssertionError("unreachable")


def _make_folder(folder: Path) -> None:
    """Make a folder and those above it, on the disk."""
    if not folder.exists():
        _make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)


def _log_zero(started: float) -> int:
    """[ns] log time of simulated time zero."""
    return round(started * 1e9)


def _start(file: IO[bytes], header: str, ns: int) -> McapWriter:
    """The header goes in twice: as metadata to find it, as a message for viewers."""
    mcap = McapWriter(file, "comp-act studio")
    mcap.add_metadata(_METADATA, {"header": header})
    _add(mcap, (_HEADER_TOPIC, "studio.v1.Header", ns, schema.message("studio.v1.Header")(json=header)), ns)
    return mcap


def _add(mcap: McapWriter, message: _Message, publish_ns: int) -> None:
    topic, name, ns, content = message
    if not mcap.has_topic(topic):
        mcap.add_topic(topic, name, schema.descriptor_set(name))
    mcap.add(topic, content if isinstance(content, bytes) else content.SerializeToString(), ns, publish_ns)


def _event_message(event: Event, ns: int) -> _Message:
    message = schema.message("studio.v1.Event")(time=[event.time], kind=event.kind, text=event.text)
    return "/events", "studio.v1.Event", ns, message


def _outcome_message(outcome: Outcome, at: float, ns: int) -> _Message:
    message = schema.message("studio.v1.Outcome")(
        time=[at], success=outcome.success, reason=outcome.reason, progress=outcome.progress
    )
    return "/outcome", "studio.v1.Outcome", ns, message


def _limits_message(limits: tuple[Limit, ...], at: float, ns: int) -> _Message:
    limit = schema.message("studio.v1.Limit")
    told = [limit(arm=x.arm, kind=x.kind, why=x.why, refused=x.refused) for x in limits]
    return "/limits", "studio.v1.Limits", ns, schema.message("studio.v1.Limits")(time=[at], limits=told)
