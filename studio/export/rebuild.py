"""Takes made of a dataset's rows: what any format is read into, and how that becomes an episode."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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
    Hold,
    Image,
    JointTarget,
    Observation,
    Pose,
    Step,
    Stiffness,
    Target,
)
from studio.episode import Header, Outcome
from studio.episode_writer import EpisodeWriter
from studio.export.folder import TAKES, Progress
from studio.recorder import new_episode_id

UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class ArmRows:
    """One arm in n rows. NaN where the dataset does not tell; a pose without orientation is not turned."""

    q: Array  # (n, 6) [rad]
    dq: Array  # (n, 6) [rad/s]
    q_command: Array  # (n, 6) [rad]
    base_from_tcp: Array  # (n, 7)
    wrench: Array  # (n, 6)
    gripper: Array  # (n,)
    base_from_target: Array  # (n, 7)
    stiffness: Array  # (n, 12)
    q_target: Array  # (n, 6) [rad]
    opening: Array  # (n,)

    @staticmethod
    def of(n: int, **known: Array) -> ArmRows:
        """From the columns that a dataset has."""
        widths = {"base_from_tcp": 7, "base_from_target": 7, "stiffness": 12, "gripper": 0, "opening": 0}
        columns: dict[str, Array] = {}
        for part in dataclasses.fields(ArmRows):
            width = widths.get(part.name, 6)
            columns[part.name] = np.full((n, width) if width else n, np.nan)
            if part.name == "base_from_tcp":
                columns[part.name][:, 3:] = (1.0, 0.0, 0.0, 0.0)
        return ArmRows(**{**columns, **{name: np.asarray(value, float) for name, value in known.items()}})

    def state(self, row: int, at: float) -> Array:
        """(ARM_ROW_WIDTH,)"""
        packed = np.empty(ARM_ROW_WIDTH)
        packed[ARM_ROW["time"]] = at
        for name in ("q", "dq", "q_command", "base_from_tcp", "wrench", "gripper"):
            packed[ARM_ROW[name]] = getattr(self, name)[row]
        return packed

    def action(self, row: int) -> ArmAction:
        """What was applied; an arm that was told nothing holds."""
        target: Target = Hold()
        if np.isfinite(self.base_from_target[row]).all() and np.isfinite(self.stiffness[row]).all():
            stiffness = Stiffness.from_vector(self.stiffness[row])
            target = CartesianTarget(Pose.from_vector(self.base_from_target[row]), stiffness)
        elif np.isfinite(self.q_target[row]).all():
            target = JointTarget(self.q_target[row])
        return ArmAction(target, float(self.opening[row]))


@dataclass(frozen=True, slots=True)
class Rows:
    """One take of a dataset."""

    name: str  # in the dataset
    rate: float  # [Hz]
    arms: Mapping[str, ArmRows]
    cameras: Mapping[str, tuple[int, int]]  # (width, height) [px]
    images: Iterator[Mapping[str, Array]]  # of each row, (h, w, 3) uint8 RGB
    instruction: str
    task: str | None
    success: bool | None = None
    robot: str = UNKNOWN
    header: Mapping[str, Any] | None = None  # that the take had, where we have exported it
    left_out: tuple[str, ...] = field(default=())  # columns that no episode has

    def __len__(self) -> int:
        return len(next(iter(self.arms.values())).q)


def known_headers(folder: Path) -> dict[str, dict[str, Any]]:
    """Headers by episode id, where Studio wrote the dataset; in the order of its takes."""
    try:
        told = json.loads((folder / TAKES).read_text())
        return {take["episode_id"]: take["header"] | {"outcome": take["outcome"]} for take in told["takes"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_take(rows: Rows, data_dir: Path, source: str, task: str | None, progress: Progress) -> Path:
    """An episode of its own, with a new id, that tells where it comes from. Half of one is removed."""
    header = _header(rows, source, task)
    path = data_dir / "episodes" / header.task / f"{header.episode_id}.mcap"
    writer = EpisodeWriter(path, header)
    try:
        for step in _steps(rows):
            writer.add(step, time.time())
            progress.advance(1.0 / len(rows), rows.name)
        writer.finish(Outcome(rows.success, f"imported from {source}"))
    except BaseException:
        writer.close()
        path.with_name(f"{path.name}.part").unlink(missing_ok=True)
        raise
    return path


def _header(rows: Rows, source: str, task: str | None) -> Header:
    task = task or rows.task
    if task is None:
        raise ValueError(f"{source} does not tell its task; say which it is.")
    origin = {"imported_from": {"dataset": source, "take": rows.name, "rate_Hz": rows.rate}}
    changed: dict[str, Any] = {
        "episode_id": new_episode_id(task),
        "task": task,
        "cameras": dict(rows.cameras),
    }
    if rows.header is not None:
        known = {name: value for name, value in rows.header.items() if name != "outcome"}
        header = Header.from_json(json.dumps(known))
        return dataclasses.replace(header, **changed, provenance={**header.provenance, **origin})
    return Header(
        **changed,
        instruction=rows.instruction,
        agent=UNKNOWN,
        operator=UNKNOWN,
        robot=rows.robot,
        arms=tuple(rows.arms),
        started=time.time(),
        provenance=origin,
    )


def _steps(rows: Rows) -> Iterator[Step]:
    for row, pictures in zip(range(len(rows)), rows.images, strict=False):
        now = row / rows.rate
        packed = [arm.state(row, now) for arm in rows.arms.values()]
        action = Action(tuple(arm.action(row) for arm in rows.arms.values()))
        yield Step(
            observation=Observation(
                now,
                tuple(map(ArmState.from_row, packed)),
                {camera: Image(now, pixels) for camera, pixels in pictures.items()},
            ),
            requested=action,
            applied=Applied(action, (), np.stack(packed)[:, None]),
            digest=b"",
            task_state=None,
            snapshot=None,
        )
