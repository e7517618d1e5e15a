"""One small picture of a take, at a telling moment, kept in DATA/cache/thumbnails."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import cv2

from studio.cursor import CONTACT, phases_of
from studio.episode import Episode, open_episode
from studio.interpolation import newest

WIDTH = 192  # [px]
QUALITY = 80  # of its JPEG
LATEST = 60.0  # [s] of a take in which its first contact is looked for


def kept(data_dir: Path, path: Path) -> bytes | None:
    """The picture, where it was made before. Raise FileNotFoundError where the take is gone."""
    place, recorded = _place(data_dir, path), path.stat().st_mtime_ns
    try:
        return place.read_bytes() if place.stat().st_mtime_ns >= recorded else None
    except FileNotFoundError:
        return None


def thumbnail(data_dir: Path, path: Path) -> bytes:
    """A JPEG of the take at `path`: its front camera in the middle of the first contact.

    Raise KeyError where no camera sent an image.
    """
    if (picture := kept(data_dir, path)) is not None:
        return picture
    with open_episode(path) as episode:
        camera = _front(episode)
        number = newest(episode.image_times(camera), telling_moment(episode))
        image = episode.image(camera, number)
    height = round(image.shape[0] * WIDTH / image.shape[1])
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    picture = jpeg.tobytes()
    _keep(_place(data_dir, path), picture)
    return picture


def telling_moment(episode: Episode) -> float:
    """[s] the middle of the first contact of any arm, else of the take."""
    arms, duration = episode.header.arms, episode.duration
    columns = episode.columns(*(f"{arm}/state" for arm in arms))
    contacts = [
        span
        for arm in arms
        for span in phases_of(columns[f"{arm}/state/time"], columns[f"{arm}/state/wrench"], duration)
        if span.label == CONTACT
    ]
    first = min(contacts, key=lambda span: span.start, default=None)
    return duration / 2 if first is None else (first.start + first.end) / 2


def _front(episode: Episode) -> str:
    """The camera that shows most of the scene."""
    with_images = [camera for camera in episode.cameras if len(episode.image_times(camera))]
    if not with_images:
        raise KeyError(f"{episode.header.episode_id} has no images.")
    return min(with_images, key=lambda camera: ("front" not in camera, "wrist" in camera))


def _place(data_dir: Path, path: Path) -> Path:
    return data_dir / "cache" / "thumbnails" / f"{path.stem}.jpg"


def _keep(place: Path, picture: bytes) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    descriptor, part = tempfile.mkstemp(prefix=".", dir=place.parent)
    with os.fdopen(descriptor, "wb") as file:
        file.write(picture)
    Path(part).rename(place)
