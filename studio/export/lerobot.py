"""Datasets in LeRobot's format v3.0 (https://github.com/huggingface/lerobot), written with pyarrow and PyAV.

    OUT/meta/info.json  stats.json  tasks.parquet  episodes/chunk-000/file-000.parquet
        data/chunk-000/file-000.parquet             one row for each moment
        videos/<key>/chunk-000/file-000.mp4         H.264
        takes.json

    observation.state            an arm: joints [rad], x y z [m], first two columns of the rotation matrix,
                                 gripper 0 closed .. 1 open
    observation.velocity         an arm: joints [rad/s]
    observation.joint_command    an arm: the last joint command [rad]
    observation.wrench           an arm: force [N] and torque [N·m] on the robot, about the TCP, base axes
    observation.images.<camera>
    action                       an arm: x y z, rotation, gripper, and the stiffness: upper triangles U of
                                 K = U^T U, translational [√(N/m)] and rotational [√(N·m/rad)];
                                 or joints [rad], gripper
    next.success                 true in the last row of a take that succeeded

Poses are in each arm's base; every dimension has a name, `<arm>.<what>`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from controller.types import Array
from studio.episode import Header
from studio.export import arrays, statistics
from studio.export.folder import Progress
from studio.export.source import Control, Grid, Take, cameras_of, opened
from studio.export.statistics import Statistics
from studio.export.video import CODEC, PIXELS, VideoWriter

if TYPE_CHECKING:
    from studio.export import Options

VERSION = "v3.0"
IN_CHUNK = 1000  # files
DATA_MB, VIDEO_MB = 100, 200  # [MB] of a file, about
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"

JOINTS = tuple(f"joint_{n}" for n in range(1, 7))
POSITION = ("x", "y", "z")
ROTATION = ("r11", "r21", "r31", "r12", "r22", "r32")  # row, column
WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
CHOLESKY = tuple(
    f"{block}_cholesky_{entry}"
    for block in ("translational", "rotational")
    for entry in ("xx", "xy", "xz", "yy", "yz", "zz")
)
ACTIONS: dict[Control, tuple[str, ...]] = {
    "cartesian": (*POSITION, *ROTATION, "gripper", *CHOLESKY),
    "joints": (*JOINTS, "gripper"),
}
STATE = (*JOINTS, *POSITION, *ROTATION, "gripper")
IMAGES = "observation.images."
SCALARS = {
    "next.success": ("bool", pa.bool_()),
    "timestamp": ("float32", pa.float32()),
    "frame_index": ("int64", pa.int64()),
    "episode_index": ("int64", pa.int64()),
    "index": ("int64", pa.int64()),
    "task_index": ("int64", pa.int64()),
}


def write(takes: Sequence[Take], folder: Path, options: Options, progress: Progress) -> None:
    """One dataset of all takes; two that differ in their instruction differ in their LeRobot task."""
    header = takes[0].header
    rate = round(options.rate)
    if rate != options.rate:
        raise ValueError(f"LeRobot wants a whole number of rows a second, not {options.rate:g}.")
    cameras = cameras_of(header, options.cameras)
    instructions = list(dict.fromkeys(take.header.instruction for take in takes))
    features = _features(header, cameras, options.control, rate)
    episodes: list[dict[str, Any]] = []
    told: list[dict[str, Statistics]] = []
    first = 0
    with _Data(folder, features) as data, _Videos(folder, header, cameras, rate) as videos:
        for number, take in enumerate(takes):
            with opened(take, rate, options.control) as grid:
                columns = _numbers(grid, options.control)
                task = instructions.index(take.header.instruction)
                columns |= _scalars(len(grid), rate, first, number, task, take.outcome == "success")
                placed = data.add(columns)
                seen, shown = videos.add(grid, progress)
            stats = {name: statistics.of_numbers(_matrix(values)) for name, values in columns.items()} | seen
            episodes.append(
                {
                    **{"episode_index": number, "tasks": [take.header.instruction], "length": len(grid)},
                    **placed,
                    **{"dataset_from_index": first, "dataset_to_index": first + len(grid)},
                    **shown,
                    **_flat(stats),
                    **{"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0},
                }
            )
            told.append(stats)
            first += len(grid)
    _write_meta(folder, header.robot, rate, features, instructions, episodes, told)


@dataclass(slots=True)
class _Place:
    """The file that is being filled."""

    chunk: int = 0
    file: int = 0

    def advance(self) -> None:
        self.file += 1
        if self.file == IN_CHUNK:
            self.chunk, self.file = self.chunk + 1, 0

    def of(self, template: str, **names: str) -> str:
        return template.format(chunk_index=self.chunk, file_index=self.file, **names)


class _Data:
    """The rows, a row group for each take."""

    def __init__(self, folder: Path, features: Mapping[str, Any]) -> None:
        self._folder, self._place = folder, _Place()
        self._schema = pa.schema(
            [
                (name, SCALARS[name][1] if name in SCALARS else pa.list_(pa.float32(), feature["shape"][0]))
                for name, feature in features.items()
                if feature["dtype"] != "video"
            ]
        )
        self._writer: Any = None

    def __enter__(self) -> _Data:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def add(self, columns: Mapping[str, Array]) -> dict[str, int]:
        """Write a take's rows; tell where."""
        path = self._folder / self._place.of(DATA_PATH)
        if path.exists() and path.stat().st_size > DATA_MB * 1e6:
            self._close()
            self._place.advance()
            path = self._folder / self._place.of(DATA_PATH)
        if self._writer is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, self._schema)
        table = [_column(columns[field.name], field.type) for field in self._schema]
        self._writer.write_table(pa.table(table, schema=self._schema))
        return {"data/chunk_index": self._place.chunk, "data/file_index": self._place.file}

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class _Videos:
    """The pictures of each camera, take after take in one file until it is long enough."""

    def __init__(self, folder: Path, header: Header, cameras: Sequence[str], rate: int) -> None:
        self._folder, self._rate = folder, rate
        self._sizes = {camera: header.cameras[camera] for camera in cameras}
        self._places = {camera: _Place() for camera in cameras}
        self._writers: dict[str, VideoWriter] = {}

    def __enter__(self) -> _Videos:
        return self

    def __exit__(self, *_: object) -> None:
        for writer in self._writers.values():
            writer.close()

    def add(self, grid: Grid, progress: Progress) -> tuple[dict[str, Statistics], dict[str, Any]]:
        """Write a take's pictures; statistics of them, and where they are."""
        shown: dict[str, Any] = {}
        numbers = {camera: grid.image_numbers(camera) for camera in self._sizes}
        for camera in self._sizes:
            writer = self._writer(camera)
            start = writer.n_frames / self._rate
            place = self._places[camera]
            shown |= {
                f"videos/{IMAGES}{camera}/chunk_index": place.chunk,
                f"videos/{IMAGES}{camera}/file_index": place.file,
                f"videos/{IMAGES}{camera}/from_timestamp": start,
                f"videos/{IMAGES}{camera}/to_timestamp": start + len(grid) / self._rate,
            }
        sampled = set(np.linspace(0, len(grid) - 1, min(len(grid), statistics.PICTURES)).astype(int).tolist())
        samples: dict[str, list[Array]] = {camera: [] for camera in self._sizes}
        newest: dict[str, tuple[int, Array]] = {}
        for row in range(len(grid)):
            for camera, shows in numbers.items():
                number = int(shows[row])
                if camera not in newest or newest[camera][0] != number:
                    newest[camera] = number, grid.episode.image(camera, number)
                self._writers[camera].add(newest[camera][1], is_first=row == 0)
                if row in sampled:
                    samples[camera].append(newest[camera][1])
            progress.advance(1 / self._rate, grid.take.episode_id)
        return {
            f"{IMAGES}{camera}": statistics.of_pictures(pictures) for camera, pictures in samples.items()
        }, shown

    def _writer(self, camera: str) -> VideoWriter:
        """Of the file that is being filled, or of the next where that is full."""
        writer = self._writers.get(camera)
        if writer is not None and writer.size > VIDEO_MB * 1e6:
            writer.close()
            self._places[camera].advance()
            writer = None
        if writer is None:
            path = self._folder / self._places[camera].of(VIDEO_PATH, video_key=IMAGES + camera)
            writer = self._writers[camera] = VideoWriter(path, self._rate, *self._sizes[camera])
        return writer


def _features(header: Header, cameras: Sequence[str], control: Control, rate: int) -> dict[str, Any]:
    """As `info.json` tells them."""
    dimensions = {
        "observation.state": STATE,
        "observation.velocity": JOINTS,
        "observation.joint_command": JOINTS,
        "observation.wrench": WRENCH,
        "action": ACTIONS[control],
    }
    features: dict[str, Any] = {}
    for name, parts in dimensions.items():
        names = [f"{arm}.{part}" for arm in header.arms for part in parts]
        features[name] = {"dtype": "float32", "shape": [len(names)], "names": names}
    for camera in cameras:
        width, height = header.cameras[camera]
        info = {
            "video.height": height,
            "video.width": width,
            "video.channels": 3,
            "video.codec": CODEC,
            "video.pix_fmt": PIXELS,
            "video.is_depth_map": False,
            "video.fps": rate,
            "has_audio": False,
        }
        shape = {"shape": [height, width, 3], "names": ["height", "width", "channels"]}
        features[IMAGES + camera] = {"dtype": "video", **shape, "info": info}
    for name, (dtype, _) in SCALARS.items():
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return features


def _numbers(grid: Grid, control: Control) -> dict[str, Array]:
    """(n, width) float32 of each feature."""
    parts: dict[str, list[Array]] = {}
    for arm in grid.take.header.arms:
        tcp, gripper = grid.state(arm, "base_from_tcp"), grid.state(arm, "gripper")[:, None]
        opening = grid.action(arm, "gripper")[:, None]
        if control == "joints":
            action = [grid.commanded(arm), opening]
        else:
            target = grid.action(arm, "base_from_target")
            stiffness = arrays.cholesky_of(grid.action(arm, "stiffness"))
            action = [target[:, :3], arrays.six_of(target[:, 3:]), opening, stiffness]
        of_arm = {
            "observation.state": [grid.state(arm, "q"), tcp[:, :3], arrays.six_of(tcp[:, 3:]), gripper],
            "observation.velocity": [grid.state(arm, "dq")],
            "observation.joint_command": [grid.state(arm, "q_command")],
            "observation.wrench": [grid.state(arm, "wrench")],
            "action": action,
        }
        for name, columns in of_arm.items():
            parts.setdefault(name, []).extend(columns)
    return {name: np.concatenate(columns, axis=1).astype(np.float32) for name, columns in parts.items()}


def _scalars(n: int, rate: int, first: int, episode: int, task: int, success: bool) -> dict[str, Array]:
    rows = np.arange(n)
    return {
        "next.success": success & (rows == n - 1),
        "timestamp": (rows / rate).astype(np.float32),
        "frame_index": rows,
        "episode_index": np.full(n, episode),
        "index": first + rows,
        "task_index": np.full(n, task),
    }


def _matrix(values: Array) -> Array:
    return values if values.ndim == 2 else values[:, None]


def _column(values: Array, kind: Any) -> Any:
    if values.ndim == 1:
        return pa.array(values, kind)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _flat(stats: Mapping[str, Statistics]) -> dict[str, Any]:
    """As columns of the table of episodes."""
    return {
        f"stats/{key}/{name}": value.tolist() for key, found in stats.items() for name, value in found.items()
    }


def _write_meta(
    folder: Path,
    robot: str,
    rate: int,
    features: Mapping[str, Any],
    instructions: Sequence[str],
    episodes: Sequence[Mapping[str, Any]],
    told: Sequence[Mapping[str, Statistics]],
) -> None:
    info = {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": episodes[-1]["dataset_to_index"],
        "total_tasks": len(instructions),
        "chunks_size": IN_CHUNK,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": rate,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if any(name.startswith(IMAGES) for name in features) else None,
        "features": features,
    }
    whole = {name: statistics.together([stats[name] for stats in told]) for name in told[0]}
    lists = {name: {key: value.tolist() for key, value in found.items()} for name, found in whole.items()}
    path = folder / EPISODES_PATH
    path.parent.mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=4))
    (folder / "meta" / "stats.json").write_text(json.dumps(lists, indent=4))
    pq.write_table(_tasks(instructions), folder / "meta" / "tasks.parquet")
    pq.write_table(pa.Table.from_pylist(list(episodes)), path)


def _tasks(instructions: Sequence[str]) -> Any:
    """LeRobot reads it with pandas, whose index is the instruction."""
    index = "__index_level_0__"
    kinds = {"task_index": ("int64", "int64"), index: ("unicode", "object")}
    columns = [
        {
            "name": None if name == index else name,
            "field_name": name,
            "pandas_type": pandas_type,
            "numpy_type": numpy_type,
            "metadata": None,
        }
        for name, (pandas_type, numpy_type) in kinds.items()
    ]
    pandas = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.2.0",
    }
    numbers = pa.array(range(len(instructions)), pa.int64())
    table = pa.table({"task_index": numbers, index: list(instructions)})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
