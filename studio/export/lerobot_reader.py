"""LeRobot v3 datasets as takes: those of `studio.export.lerobot`, and of others what has a known name.

A dimension is known by its name, `<arm>.<what>` as in `studio.export.lerobot`. A dataset of others names its
dimensions otherwise: told which arms it has, its state and action are read as joints and gripper of each.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq

from controller.types import Array
from studio.export import arrays
from studio.export.lerobot import CHOLESKY, IMAGES, JOINTS, POSITION, ROTATION, VERSION, WRENCH
from studio.export.rebuild import UNKNOWN, ArmRows, Rows, known_headers
from studio.export.video import frames

# Column of `ArmRows` -> the feature and the names in it that it is made of.
COLUMNS: dict[str, tuple[str, tuple[str, ...]]] = {
    "q": ("observation.state", JOINTS),
    "gripper": ("observation.state", ("gripper",)),
    "base_from_tcp": ("observation.state", (*POSITION, *ROTATION)),
    "dq": ("observation.velocity", JOINTS),
    "q_command": ("observation.joint_command", JOINTS),
    "wrench": ("observation.wrench", WRENCH),
    "base_from_target": ("action", (*POSITION, *ROTATION)),
    "stiffness": ("action", CHOLESKY),
    "q_target": ("action", JOINTS),
    "opening": ("action", ("gripper",)),
}
KNOWN = {part for _, parts in COLUMNS.values() for part in parts}
PICTURES = ("video", "image")
BOOKKEEPING = {
    *("timestamp", "frame_index", "episode_index", "index", "task_index"),
    *("next.success", "next.done"),
}


def read(source: Path, arms: tuple[str, ...], rate: float | None) -> tuple[int, Iterator[Rows]]:
    """How many takes there are, and the takes; the rate is the dataset's own.

    Raises ValueError, telling what was found, where it is no v3 dataset or nothing in it is known.
    """
    info = json.loads((source / "meta" / "info.json").read_text())
    version = str(info.get("codebase_version"))
    if not version.startswith(VERSION.split(".")[0]):
        raise ValueError(
            f"{source} is a LeRobot dataset {version}; {VERSION} can be read: let LeRobot convert it."
        )
    dataset = _Dataset(source, info, _layout(source, info["features"], arms))
    return len(dataset.episodes), dataset.takes()


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the columns of each arm stand: column -> feature and indices."""

    arms: Mapping[str, Mapping[str, tuple[str, list[int]]]]
    left_out: tuple[str, ...]


def _layout(source: Path, features: Mapping[str, Any], arms: tuple[str, ...]) -> _Layout:
    told = {key: feature for key, feature in features.items() if key not in BOOKKEEPING}
    names = {key: _names(feature) for key, feature in told.items() if feature["dtype"].startswith("float")}
    found = _named(names) or (_unnamed(source, features, arms) if arms else {})
    if not found:
        raise ValueError(
            f"{source} has no dimension of a known name, like right.x or right.joint_1, but {names}. "
            "Say which arms it has to read state and action as joints and gripper of each."
        )
    used = {(key, n) for columns in found.values() for key, places in columns.values() for n in places}
    parts = [f"{key}: {part}" for key in names for n, part in enumerate(names[key]) if (key, n) not in used]
    others = [key for key in told if key not in names and told[key]["dtype"] not in PICTURES]
    return _Layout(found, (*parts, *others))


def _names(feature: Mapping[str, Any]) -> Sequence[str]:
    """Of the dimensions; numbers where they have none."""
    names = feature.get("names")
    if isinstance(names, Mapping):  # {"motors": [...]}
        names = next(iter(names.values()), None)
    width = int(np.prod(feature["shape"]))
    fits = isinstance(names, list) and len(names) == width
    return list(map(str, names)) if fits and names else list(map(str, range(width)))


def _named(names: Mapping[str, Sequence[str]]) -> dict[str, dict[str, tuple[str, list[int]]]]:
    """By their names, as `studio.export.lerobot` gives them."""
    arms = dict.fromkeys(
        name.rpartition(".")[0]
        for parts in names.values()
        for name in parts
        if name.rpartition(".")[0] and name.rpartition(".")[2] in KNOWN
    )
    found: dict[str, dict[str, tuple[str, list[int]]]] = {}
    for arm in arms:
        for column, (key, parts) in COLUMNS.items():
            places = {name: index for index, name in enumerate(names.get(key, ()))}
            wanted = [f"{arm}.{part}" for part in parts]
            if all(name in places for name in wanted):
                found.setdefault(arm, {})[column] = (key, [places[name] for name in wanted])
    return found


def _unnamed(
    source: Path, features: Mapping[str, Any], arms: tuple[str, ...]
) -> dict[str, dict[str, tuple[str, list[int]]]]:
    """State and action as 6 joints of each arm, with its gripper behind them or without."""
    found: dict[str, dict[str, tuple[str, list[int]]]] = {arm: {} for arm in arms}
    for key, joints, gripper in (("observation.state", "q", "gripper"), ("action", "q_target", "opening")):
        width = int(np.prod(features.get(key, {"shape": [0]})["shape"]))
        if width not in (0, 6 * len(arms), 7 * len(arms)):
            raise ValueError(
                f"{source} has {width} numbers in {key}; {len(arms)} arms have {6 * len(arms)} joints, or "
                f"{7 * len(arms)} numbers with their grippers."
            )
        each = width // len(arms)
        for index, arm in enumerate(arms if width else ()):
            found[arm][joints] = (key, list(range(each * index, each * index + 6)))
            if each == 7:
                found[arm][gripper] = (key, [each * index + 6])
    return found


class _Dataset:
    """An open dataset."""

    def __init__(self, source: Path, info: Mapping[str, Any], layout: _Layout) -> None:
        self._source, self._info, self._layout = source, info, layout
        self._rate = float(info["fps"])
        files = sorted((source / "meta" / "episodes").glob("*/*.parquet"))
        if not files:
            raise ValueError(f"{source} has no table of episodes in meta/episodes.")
        stored = [name for name in pq.read_schema(files[0]).names if not name.startswith("stats/")]
        self.episodes = [row for file in files for row in pq.read_table(file, columns=stored).to_pylist()]
        self._cameras = {
            key: feature
            for key, feature in info["features"].items()
            if feature["dtype"] in ("video", "image")
        }
        self._headers = known_headers(source)

    def takes(self) -> Iterator[Rows]:
        known = list(self._headers.items())
        ours = len(known) == len(self.episodes)
        for number, episode in enumerate(self.episodes):
            name, header = known[number] if ours else (f"episode {episode['episode_index']}", None)
            yield self._take(episode, name, header)

    def _take(self, episode: Mapping[str, Any], name: str, header: Mapping[str, Any] | None) -> Rows:
        path = self._info["data_path"].format(
            chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"]
        )
        table = pq.read_table(self._source / path, filters=[("episode_index", "=", episode["episode_index"])])
        n = len(table)
        features = {key for columns in self._layout.arms.values() for key, _ in columns.values()}
        values = {key: np.array(table.column(key).to_pylist(), float).reshape(n, -1) for key in features}
        success = None
        if "next.success" in table.column_names:
            success = bool(np.any(table.column("next.success").to_pylist()))
        if header is not None:
            success = {"success": True, "failure": False}.get(header["outcome"])
        return Rows(
            name=name,
            rate=self._rate,
            arms={arm: _arm(columns, values, n) for arm, columns in self._layout.arms.items()},
            cameras={
                _camera(key): (feature["shape"][1], feature["shape"][0])
                for key, feature in self._cameras.items()
            },
            images=self._pictures(episode, table, n),
            instruction=(episode.get("tasks") or [""])[0],
            task=None if header is None else header["task"],
            success=success,
            robot=str(self._info.get("robot_type") or UNKNOWN),
            header=header,
            left_out=self._layout.left_out,
        )

    def _pictures(self, episode: Mapping[str, Any], table: Any, n: int) -> Iterator[dict[str, Array]]:
        streams: dict[str, Iterator[Array]] = {}
        for key, feature in self._cameras.items():
            if feature["dtype"] == "image":
                streams[_camera(key)] = (_decoded(cell["bytes"]) for cell in table.column(key).to_pylist())
            else:
                path = self._info["video_path"].format(
                    video_key=key,
                    chunk_index=episode[f"videos/{key}/chunk_index"],
                    file_index=episode[f"videos/{key}/file_index"],
                )
                start = episode[f"videos/{key}/from_timestamp"]
                streams[_camera(key)] = frames(self._source / path, start, n)
        for _ in range(n):
            yield {camera: next(stream) for camera, stream in streams.items()}


def _camera(key: str) -> str:
    return key.removeprefix(IMAGES).removeprefix("observation.").replace("/", "_")


def _decoded(encoded: bytes) -> Array:
    """(h, w, 3) uint8 RGB of PNG or JPEG."""
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR_RGB))


def _arm(columns: Mapping[str, tuple[str, list[int]]], values: Mapping[str, Array], n: int) -> ArmRows:
    found = {column: values[key][:, indices] for column, (key, indices) in columns.items()}
    for name in ("base_from_tcp", "base_from_target"):
        if name in found:
            position, six = found[name][:, :3], found[name][:, 3:]
            found[name] = np.concatenate((position, arrays.quaternions_from_six(six)), axis=1)
    if "stiffness" in found:
        found["stiffness"] = arrays.stiffness_from(found["stiffness"])
    for name in ("gripper", "opening"):
        if name in found:
            found[name] = found[name][:, 0]
    return ArmRows.of(n, **found)
