"""Films of a take's cameras: H.264 of constant rate, made once and kept in DATA/cache/video."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import cv2
import numpy as np

from studio.episode import Episode, open_episode
from studio.export.video import VideoWriter
from studio.interpolation import NANOSECOND
from studio.session import CONTROL_PERIOD, IMAGE_EVERY

RATE = round(1 / (IMAGE_EVERY * CONTROL_PERIOD))  # [Hz] of the cameras
KEPT = 4e9  # [bytes] of films; those that nobody asked for longest go first


def video(data_dir: Path, path: Path, camera: str) -> Path:
    """The film of one camera of the take at `path`; its time zero is that of the take.

    Raise KeyError on an unknown camera, ValueError on one without images.
    """
    folder = data_dir / "cache" / "video"
    film = folder / f"{path.stem}.{camera}.mp4"
    if film.exists() and film.stat().st_mtime_ns >= path.stat().st_mtime_ns:
        os.utime(film)
        return film
    with open_episode(path) as episode:
        if not len(episode.image_times(camera)):
            raise ValueError(f"{path.stem} has no image of camera {camera!r}.")
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, part = tempfile.mkstemp(suffix=".mp4", prefix=".", dir=folder)
        os.close(descriptor)
        try:
            _write(Path(part), episode, camera)
            Path(part).rename(film)
        finally:
            Path(part).unlink(missing_ok=True)
    _forget(folder, film)
    return film


def _write(path: Path, episode: Episode, camera: str) -> None:
    """Each frame shows the newest image at or before its time, else the first."""
    times = np.arange(round(episode.duration * RATE) + 1) / RATE
    numbers = np.searchsorted(episode.image_times(camera), times + NANOSECOND, side="right") - 1
    height, width = episode.image(camera, 0).shape[:2]
    even = np.s_[: height - height % 2, : width - width % 2]
    shown, pixels = -1, np.empty(0)
    with VideoWriter(path, RATE, width - width % 2, height - height % 2, starts_at_once=True) as film:
        for number in numbers.clip(min=0).tolist():
            if number != shown:
                shown, image = number, episode.image(camera, number)
                if image.shape[:2] != (height, width):
                    image = cv2.resize(image, (width, height))
                pixels = image[even]
            film.add(np.ascontiguousarray(pixels))


def _forget(folder: Path, newest: Path) -> None:
    """Films beyond KEPT, but never the one just made."""
    films = sorted(folder.glob("*.mp4"), key=lambda film: film.stat().st_mtime_ns, reverse=True)
    total = 0
    for film in films:
        total += film.stat().st_size
        if total > KEPT and film != newest:
            film.unlink(missing_ok=True)
