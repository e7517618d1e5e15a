"""Datasets in the layout of ACT and of the Comp-ACT paper: one HDF5 file for each take.

    OUT/episode_0.hdf5 …      numbered without holes, as ACT's loader wants them
        takes.json

    /observations/qpos        (T, 7 an arm) joints [rad], gripper 0 closed .. 1 open
                 /qvel        (T, 7 an arm) [rad/s], [1/s]
                 /eef_pos     (T, 7 an arm) position [m], axis-angle [rad], gripper
                 /ft          (T, 6 an arm) force [N], torque [N·m] on the robot, about the TCP, base axes
                 /q_command   (T, 6 an arm) [rad] the last joint command; ours
                 /images/CAM  (T, h, w, 3) uint8 RGB
    /action                   (T, 19 an arm) stiffness as Cholesky 6 [√(N/m)] and 6 [√(N·m/rad)], position
                              [m], axis-angle [rad], gripper; of joints: (T, 7 an arm) joints [rad], gripper

Files are equally long, the last row repeated, unless that is not wanted; attribute `length` is the true one.
Axis-angle vectors lie on the branch next to the mean orientation of the first take, so that none jumps.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import h5py
import numpy as np

from controller.types import Array
from studio.export import arrays
from studio.export.folder import Progress
from studio.export.rebuild import ArmRows, Rows, known_headers
from studio.export.source import Grid, Take, cameras_of, opened

if TYPE_CHECKING:
    from studio.export import Options

ROWS_IN_CHUNK = 256  # of what is small; an image is a chunk of its own


def write(takes: Sequence[Take], folder: Path, options: Options, progress: Progress) -> None:
    """One file for each take, then all as long as the longest."""
    branches: dict[str, Array] = {}
    lengths = []
    for number, take in enumerate(takes):
        with opened(take, options.rate, options.control) as grid, _file(folder, number, "w+") as (file, sink):
            for arm in take.header.arms:
                branches.setdefault(arm, arrays.mean_rotation_vector(grid.state(arm, "base_from_tcp")[:, 3:]))
            _write_numbers(file, grid, options, branches)
            _write_images(file, grid, options, progress, sink)
            file.attrs.update(_attributes(take, options, len(grid)))
            lengths.append(len(grid))
    for number, length in enumerate(lengths):
        with _file(folder, number, "r+") as (file, sink):
            longest = max(lengths) if options.pad else length
            file.attrs["max_timesteps"] = longest
            if longest > length:
                _pad(file, longest, sink)


class _Sink(io.FileIO):
    """A file for HDF5, which crashes where a write fails: the first error is kept, `check` raises it."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) or 0 :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def check(self) -> None:
        if self.error is not None:
            raise self.error


@contextmanager
def _file(folder: Path, number: int, mode: Literal["w+", "r+"]) -> Iterator[tuple[h5py.File, _Sink]]:
    """An HDF5 file to write to; raises OSError where not all of it could be written."""
    with _Sink(folder / f"episode_{number}.hdf5", mode) as sink:
        with h5py.File(sink, "w" if mode == "w+" else "r+") as file:
            yield file, sink
        sink.check()


def _write_numbers(file: h5py.File, grid: Grid, options: Options, branches: Mapping[str, Array]) -> None:
    parts: dict[str, list[Array]] = {}
    for arm, branch in branches.items():
        for name, values in _columns(grid, arm, options, branch).items():
            parts.setdefault(name, []).append(values)
    for name, columns in parts.items():
        values = np.concatenate(columns, axis=1).astype(np.float32)
        rows = (min(len(values), ROWS_IN_CHUNK), values.shape[1])
        file.create_dataset(name, data=values, chunks=rows, maxshape=(None, values.shape[1]))


def _columns(grid: Grid, arm: str, options: Options, branch: Array) -> dict[str, Array]:
    """One arm's part of each dataset."""
    gripper = grid.state(arm, "gripper")[:, None]
    tcp = grid.state(arm, "base_from_tcp")
    opening = grid.action(arm, "gripper")[:, None]
    if options.control == "joints":
        action = [grid.commanded(arm), opening]
    else:
        target = grid.action(arm, "base_from_target")
        stiffness = arrays.cholesky_of(grid.action(arm, "stiffness"))
        action = [stiffness, target[:, :3], arrays.axis_angle_of(target[:, 3:], branch), opening]
    speed = np.gradient(gripper[:, 0], 1 / options.rate)[:, None]
    columns = {
        "observations/qpos": [grid.state(arm, "q"), gripper],
        "observations/qvel": [grid.state(arm, "dq"), speed],
        "observations/eef_pos": [tcp[:, :3], arrays.axis_angle_of(tcp[:, 3:], branch), gripper],
        "observations/ft": [grid.state(arm, "wrench")],
        "observations/q_command": [grid.state(arm, "q_command")],
        "action": action,
    }
    return {name: np.concatenate(parts, axis=1) for name, parts in columns.items()}


def _write_images(file: h5py.File, grid: Grid, options: Options, progress: Progress, sink: _Sink) -> None:
    header = grid.take.header
    cameras = [name for name in header.cameras if options.cameras is None or name in options.cameras]
    datasets, numbers = {}, {}
    for camera in cameras:
        width, height = header.cameras[camera]
        shape = (len(grid), height, width, 3)
        datasets[camera] = file.create_dataset(
            f"observations/images/{camera}",
            shape,
            np.uint8,
            chunks=(1, *shape[1:]),
            maxshape=(None, *shape[1:]),
        )
        numbers[camera] = grid.image_numbers(camera)
    for row in range(len(grid)):
        for camera, dataset in datasets.items():
            dataset[row] = grid.episode.image(camera, int(numbers[camera][row]))
        sink.check()
        progress.advance(1 / options.rate, grid.take.episode_id)


def _attributes(take: Take, options: Options, length: int) -> dict[str, Any]:
    header = take.header
    return {
        "sim": True,
        "camera_names": cameras_of(header, options.cameras),
        "control_frequency": options.rate,
        "stiffness_type": "cholesky" if options.control == "cartesian" else "none",
        "action_type": options.control,
        "task": header.task,
        "instruction": header.instruction,
        "arms": list(header.arms),
        "episode_id": take.episode_id,
        "outcome": take.outcome,
        "length": length,
    }


def _pad(file: h5py.File, longest: int, sink: _Sink) -> None:
    """Repeat the last row of every dataset."""

    def lengthen(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            length, last = len(item), item[-1]
            item.resize(longest, axis=0)
            for row in range(length, longest):
                item[row] = last
                sink.check()

    file.visititems(lengthen)


def read(source: Path, arms: tuple[str, ...], rate: float | None) -> tuple[int, Iterator[Rows]]:
    """How many takes there are, and the takes. `source` is a folder or one file.

    Raises ValueError, telling what was found, where a file does not have ACT's layout.
    """
    files = [source] if source.is_file() else sorted(source.glob("episode_*.hdf5"), key=_number)
    headers = known_headers(files[0].parent)
    return len(files), (_read(path, arms, rate, headers) for path in files)


def _number(path: Path) -> tuple[int, str]:
    digits = path.stem.removeprefix("episode_")
    return (int(digits) if digits.isdigit() else -1, path.stem)


def _read(
    path: Path, arms: tuple[str, ...], rate: float | None, headers: Mapping[str, Mapping[str, Any]]
) -> Rows:
    try:
        opened_file = h5py.File(path)
    except OSError as error:
        raise ValueError(f"{path} is no HDF5 file, or damaged: {error}.") from error
    with opened_file as file:
        told = dict(file.attrs)
        if "observations/qpos" not in file:
            raise ValueError(f"{path} has no /observations/qpos; it has {_datasets(file)}.")
        n = int(told.get("length", len(file["observations/qpos"])))
        known = {name: file[name][:n] for name in _datasets(file) if "/images/" not in name}
        sizes = {name: item.shape for name, item in file.get("observations/images", {}).items()}
    rate = float(told.get("control_frequency", rate or 0.0))
    if rate <= 0:
        raise ValueError(f"{path} does not tell its rate; give it (ACT's own datasets have 50 Hz).")
    width = known["observations/qpos"].shape[1]
    names = _arm_names(path, width, arms or tuple(map(str, told.get("arms", ()))))
    columns = {arm: _arm(known, index, len(names)) for index, arm in enumerate(names)}
    cameras = {name: (shape[2], shape[1]) for name, shape in sizes.items() if len(shape) == 4}
    read_all = set().union(*(used for _, used in columns.values()))
    encoded = {f"observations/images/{name}" for name in sizes.keys() - cameras}  # no pixels
    outcome = told.get("outcome")
    return Rows(
        name=str(told.get("episode_id", path.stem)),
        rate=rate,
        arms={arm: ArmRows.of(n, **found) for arm, (found, _) in columns.items()},
        cameras=cameras,
        images=_pictures(path, n, cameras),
        instruction=str(told.get("instruction", "")),
        task=str(told["task"]) if "task" in told else None,
        success={"success": True, "failure": False}.get(str(outcome)),
        header=headers.get(str(told.get("episode_id"))),
        left_out=tuple(sorted({*known, *encoded} - read_all)),
    )


def _datasets(file: h5py.File) -> list[str]:
    found: list[str] = []

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found.append(name)

    file.visititems(note)
    return found


def _arm_names(path: Path, width: int, arms: tuple[str, ...]) -> tuple[str, ...]:
    usual = {7: ("right",), 14: ("left", "right")}
    names = arms or usual.get(width, ())
    if not names or width != 7 * len(names):
        raise ValueError(
            f"{path} has {width} joint positions; ACT has 7 for each arm (6 joints and the gripper), which "
            f"does not fit the arms {list(names)}."
        )
    return names


def _arm(known: Mapping[str, Array], index: int, n_arms: int) -> tuple[dict[str, Array], set[str]]:
    """One arm's columns, and the datasets that they come from."""
    found: dict[str, Array] = {}
    used: set[str] = set()

    def part(name: str, width: int) -> Array | None:
        values = known.get(name)
        if values is None or values.ndim != 2 or values.shape[1] != width * n_arms:
            return None
        used.add(name)
        return np.asarray(values[:, width * index : width * (index + 1)], float)

    qpos, qvel, tcp = (part(f"observations/{name}", 7) for name in ("qpos", "qvel", "eef_pos"))
    assert qpos is not None
    found |= {"q": qpos[:, :6], "gripper": qpos[:, 6]}
    if qvel is not None:
        found["dq"] = qvel[:, :6]
    if tcp is not None:
        found["base_from_tcp"] = _pose(tcp[:, :3], tcp[:, 3:6])
    for name, column in (("ft", "wrench"), ("q_command", "q_command")):
        if (values := part(f"observations/{name}", 6)) is not None:
            found[column] = values
    if (action := part("action", 19)) is not None:
        found["stiffness"] = arrays.stiffness_from(action[:, :12])
        found |= {"base_from_target": _pose(action[:, 12:15], action[:, 15:18]), "opening": action[:, 18]}
    elif (action := part("action", 7)) is not None:
        found |= {"q_target": action[:, :6], "opening": action[:, 6]}
    return found, used


def _pose(position: Array, axis_angle: Array) -> Array:
    return np.concatenate((position, arrays.quaternions_from_axis_angle(axis_angle)), axis=1)


def _pictures(path: Path, n: int, cameras: Mapping[str, Any]) -> Iterator[dict[str, Array]]:
    with h5py.File(path) as file:
        for row in range(n):
            yield {
                name: np.asarray(file[f"observations/images/{name}"][row]).astype(np.uint8)
                for name in cameras
            }
