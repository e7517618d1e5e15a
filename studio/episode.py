"""A take on disk: one MCAP file, written once (`studio.episode_writer`), never edited.

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
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from controller.types import Action, ArmAction, Array, Limit, Snapshot
from studio import schema
from studio.mcap_file import EpisodeError, McapFile, metadata_of
from studio.totals import METADATA as TOTALS
from studio.totals import ForceTally, StiffnessTally, Totals

__all__ = ["Episode", "EpisodeError", "Event", "Header", "Outcome", "open_episode"]

FORMAT_VERSION = 1
PART = ".part"  # behind the name of a take that is being recorded
MIGRATIONS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}  # header of version n -> of n + 1

METADATA = "comp-act studio"  # name of the MCAP metadata record with the header
HEADER_TOPIC = "/header"
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


def totals_of(path: Path) -> tuple[Header, Totals] | None:
    """What a finished take comes to, read in a millisecond; None where it was not written down.

    Raise `EpisodeError` where the header cannot be read.
    """
    found = metadata_of(path)
    totals = Totals.from_entries(found.get(TOTALS, {}))
    return None if totals is None else (Header.from_json(found[METADATA]["header"]), totals)


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
    def totals(self) -> Totals:
        """As `totals_of`, but counted anew: reads all forces and actions."""
        tally, outcome = ForceTally(), self.outcome
        stiffness = StiffnessTally(self.header.control)
        for action in self.actions("applied"):
            stiffness.add(action)
        columns = self.columns(*(f"{arm}/state" for arm in self.header.arms))
        for arm in self.header.arms:
            tally.add(columns[f"{arm}/state/wrench"][:, :3])
        return Totals(
            duration=self.duration,
            peak_force=tally.peak,
            mean_force=tally.mean,
            cameras=self.cameras,
            success=outcome.success,
            progress=None if math.isnan(outcome.progress) else outcome.progress,
            recovered=any(event.kind == "recovered" for event in self.events()),
            stiffness_share=stiffness.shares,
        )

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
        entries = self._mcap.metadata(METADATA)
        if entries is None:
            raise EpisodeError("This is an MCAP file, but not a take of Studio: it has no header.")
        return entries["header"]

    def _parsed(self, topic: str, name: str) -> Iterator[Any]:
        return map(schema.message(f"studio.v1.{name}").FromString, self._mcap.messages(topic))

    def _times(self, topic: str) -> Array:
        """(n,) [s] since reset of the messages of a topic."""
        times: Array = (self._mcap.log_times(topic) - log_zero(self.header.started)) * 1e-9
        return times

    def _number_at(self, topic: str, time: float) -> int | None:
        """Of the newest message at or before `time` [s], else of the first."""
        ns = self._mcap.log_times(topic) - log_zero(self.header.started)
        return max(0, int(np.searchsorted(ns, round(time * 1e9), side="right")) - 1) if len(ns) else None


def log_zero(started: float) -> int:
    """[ns] log time of simulated time zero."""
    return round(started * 1e9)
