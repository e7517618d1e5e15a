"""Reads takes once into the cache that `policy.dataset` describes."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO, Any

import numpy as np

from controller.types import Array
from policy.dataset import FORMAT, GRID
from policy.inputs import NANOSECOND, reduced
from policy.recording import ArmTrack, Recording

BLIND_EVERY = 5  # rows between two samples where there are no cameras: 20 Hz
RATE_TOLERANCE = 0.25  # share by which the rates of two takes may differ
PAIRED = 0.03  # [s] within which the images of all cameras must show the same moment

OpenRecording = Callable[[], AbstractContextManager[Recording]]
Size = tuple[int, int]  # (height, width) [px]


def build(
    folder: Path,
    recordings: Sequence[OpenRecording],
    *,
    max_size: Size | None,
    on_take: Callable[[str], None] = lambda name: None,
) -> None:
    """Write the cache of some takes of one task to `folder`; without `max_size` it has no images.

    Raises ValueError, naming the take, where two differ in task, arms, cameras, rates or stiffness table,
    where there is nothing in one to learn from, or where it holds numbers that are not finite.
    """
    if not recordings:
        raise ValueError("There is no take to learn from.")
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        with (part / "images.raw").open("wb") as images:
            writer = _Writer(images, max_size)
            for open_recording in recordings:
                with open_recording() as recording:
                    writer.add(recording)
                    on_take(recording.name)
        writer.finish(part)
        try:
            part.rename(folder)
        except OSError:
            if not folder.exists():  # else another process was faster
                raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


class _Writer:
    """Appends takes to a cache; images go to their file at once, the rest is written at the end."""

    def __init__(self, images: IO[bytes], max_size: Size | None) -> None:
        self._images, self._max_size = images, max_size
        self._first: dict[str, Any] = {}  # what the first take is like
        self._rates: dict[str, float] = {}  # [Hz] of the first take
        self._rows: list[dict[str, Array]] = []
        self._sample_rows: list[Array] = []
        self._takes: list[dict[str, Any]] = []
        self._n_rows = self._n_samples = 0

    def add(self, recording: Recording) -> None:
        self._check_alike(recording)
        tracks = [recording.track(arm) for arm in recording.arms]
        for arm, track in zip(recording.arms, tracks, strict=True):
            _check_finite(track, f"{recording.name}, {arm} arm")
        start = tracks[0].state_time[0]
        end = min(recording.span[1], *(track.action_time[-1] for track in tracks))
        times = start + GRID * np.arange(int((end - start) / GRID + 1e-6) + 1)
        names = self._cameras
        images = {name: recording.image_times(name) for name in names}
        if dark := [name for name, shown in images.items() if not len(shown)]:
            raise ValueError(
                f"{recording.name} has no image of {', '.join(dark)}; leave it out, or train --no-images."
            )
        rows, chosen = _pair(times, images, recording.span[0])
        if len(rows) < 2:
            first, last = recording.span
            raise ValueError(
                f"{recording.name} has {len(rows)} moments to learn from between {first:g} and {last:g} s, "
                "at which all cameras show the same; at least 2 are needed."
            )
        self._check_rates(recording, tracks[0], images)
        self._write_images(recording, chosen)
        on_grid = [_on_grid(track, times) for track in tracks]
        self._rows.append({name: np.stack([g[name] for g in on_grid], axis=1) for name in on_grid[0]})
        self._sample_rows.append(self._n_rows + rows)
        take = {"name": recording.name, "start": float(start)}
        take |= {"rows": [self._n_rows, self._n_rows + len(times)]}
        take |= {"samples": [self._n_samples, self._n_samples + len(rows)]}
        self._takes.append(take)
        self._n_rows += len(times)
        self._n_samples += len(rows)

    def finish(self, folder: Path) -> None:
        tracks = {name: np.concatenate([rows[name] for rows in self._rows]) for name in self._rows[0]}
        tracks["sample_row"] = np.concatenate(self._sample_rows)
        np.savez(folder / "tracks.npz", **tracks)  # type: ignore[arg-type]  # its names are no options
        index = {"format": FORMAT, **self._first, "cameras": self._sizes, "takes": self._takes}
        (folder / "index.json").write_text(json.dumps(index, indent=1))

    @property
    def _cameras(self) -> list[str]:
        return list(self._first["recorded"])

    @property
    def _sizes(self) -> dict[str, Size]:
        """Of each camera in the cache."""
        assert self._max_size is not None or not self._cameras
        low, wide = self._max_size or (0, 0)
        return {name: (min(h, low), min(w, wide)) for name, (h, w) in self._first["recorded"].items()}

    def _check_alike(self, recording: Recording) -> None:
        """With the takes before."""
        cameras = {name: list(size) for name, size in recording.cameras.items()}
        if self._max_size is None:
            cameras = {}
        elif not cameras:
            raise ValueError(f"{recording.name} has no images; --no-images learns without.")
        elif len({tuple(size) for size in cameras.values()}) > 1:
            raise ValueError(f"The cameras of {recording.name} differ in size: {cameras}.")
        found = {
            "task": recording.task,
            "arms": list(recording.arms),
            "recorded": cameras,
            "stiffness_table": recording.stiffness_table,
        }
        if not self._first:
            self._first = found
        for name, value in found.items():
            if value != self._first[name]:
                what = "cameras" if name == "recorded" else name.replace("_", " ")
                raise ValueError(
                    f"{recording.name} has {what} {value}, but {self._takes[0]['name']} {self._first[name]}; "
                    "takes of one run must be alike."
                )

    def _check_rates(self, recording: Recording, track: ArmTrack, images: dict[str, Array]) -> None:
        """Against the first take: someone may have recorded at half the speed."""
        rates = {name: _rate(times) for name, times in {"actions": track.action_time, **images}.items()}
        for name, rate in rates.items():
            first = self._rates.setdefault(name, rate)
            if not abs(rate / first - 1) <= RATE_TOLERANCE:
                raise ValueError(
                    f"{recording.name} has {name} at {rate:.1f} Hz, but {self._takes[0]['name']} at "
                    f"{first:.1f} Hz; takes of one run must be alike."
                )

    def _write_images(self, recording: Recording, chosen: dict[str, Array]) -> None:
        for numbers in zip(*chosen.values(), strict=True):
            for camera, number in zip(chosen, numbers, strict=True):
                picture = reduced(recording.image(camera, int(number)), self._sizes[camera])
                self._images.write(np.ascontiguousarray(picture, np.uint8).tobytes())


def _pair(times: Array, images: dict[str, Array], begin: float) -> tuple[Array, dict[str, Array]]:
    """Rows (n,) of the samples, and of each camera the image (n,) that shows the moment of each."""
    if not images:
        rows = np.arange(0, len(times), BLIND_EVERY)
        return rows[times[rows] >= begin - NANOSECOND], {}
    shown = next(iter(images.values()))
    rows = np.rint((shown - times[0]) / GRID).astype(int)
    fits = (rows >= 0) & (rows < len(times)) & (shown >= begin - NANOSECOND)
    chosen = {}
    for camera, others in images.items():
        nearest = _nearest(others, shown)
        fits &= np.abs(others[nearest] - shown) < PAIRED
        chosen[camera] = nearest
    return rows[fits], {camera: nearest[fits] for camera, nearest in chosen.items()}


def _on_grid(track: ArmTrack, times: Array) -> dict[str, Array]:
    """Each column at `times`: the newest state or action at or before, as the robot knew them."""
    state = _newest(track.state_time, times)
    after = _newest(track.state_time, times + GRID)  # the joints that the period beginning then commanded
    action = _newest(track.action_time, times)
    return {
        "base_from_tcp": track.base_from_tcp[state],
        "q": track.q[state],
        "gripper": track.gripper[state],
        "wrench": track.wrench[state],
        "q_command": track.q_command[after],
        "base_from_target": track.base_from_target[action],
        "stiffness": track.stiffness[action],
        "gripper_command": track.gripper_command[action],
    }


def _newest(known: Array, times: Array) -> Array:
    """(n,) index of the last of rising `known` at or before each of `times`, else of the first."""
    return np.maximum(np.searchsorted(known, times + 10 * NANOSECOND, side="right") - 1, 0)


def _nearest(known: Array, times: Array) -> Array:
    """(n,) index of the one of rising `known` next to each of `times`, of two the earlier."""
    after = np.searchsorted(known, times).clip(max=len(known) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(times - known[before] <= np.abs(known[after] - times), before, after)


def _rate(times: Array) -> float:
    """[Hz]"""
    return 1.0 / float(np.median(np.diff(times)))


def _check_finite(track: ArmTrack, what: str) -> None:
    for name in ("base_from_tcp", "q", "q_command", "wrench", "gripper", "gripper_command"):
        values = getattr(track, name)
        wrong = ~np.isfinite(values).reshape(len(values), -1).all(1)
        if wrong.any():
            at = track.state_time[wrong.argmax()] if len(values) == len(track.state_time) else 0.0
            raise ValueError(f"{what}: {name} is not finite at {at:.2f} s; leave the take out.")
