"""H.264 files of constant rate: written frame by frame, read from any time on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av

from controller.types import Array

CODEC, PIXELS = "h264", "yuv420p"
ENCODER = "libx264"
# Every second frame is a key frame, as in LeRobot's own datasets: training jumps to any of them.
OPTIONS = {"preset": "veryfast", "crf": "20", "g": "2", "bf": "0"}


class VideoWriter:
    """One file. Close it, or use it in a `with`; raises OSError where it cannot be written."""

    def __init__(
        self, path: Path, rate: int, width: int, height: int, *, starts_at_once: bool = False
    ) -> None:
        """Where it `starts_at_once`, the index stands first: a browser shows it before all has come."""
        if width % 2 or height % 2:
            raise ValueError(f"H.264 needs an even width and height, not {width} x {height}.")
        self.path = path
        self.n_frames = self.size = 0  # [bytes]
        path.parent.mkdir(parents=True, exist_ok=True)
        told = {"movflags": "faststart"} if starts_at_once else {}
        self._container = av.open(str(path), "w", options=told)
        self._stream: Any = self._container.add_stream(ENCODER, rate=rate, options=OPTIONS)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, PIXELS
        self._stream.thread_count = 1  # small pictures: threads cost more than they give

    def add(self, pixels: Array, *, is_first: bool = False) -> None:
        """(height, width, 3) uint8, RGB. The `is_first` of a take is a key frame."""
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        if is_first:
            frame.pict_type = av.video.frame.PictureType.I
        packets = self._stream.encode(frame)
        self._container.mux(packets)
        self.n_frames += 1
        self.size += sum(packet.size for packet in packets)

    def close(self) -> None:
        try:
            self._container.mux(self._stream.encode())
        finally:
            self._container.close()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def frames(path: Path, start: float, count: int) -> Iterator[Array]:
    """`count` pictures (h, w, 3) uint8 RGB from the time `start` [s] of a file on.

    Raise ValueError where it has fewer.
    """
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        base, rate = stream.time_base, stream.average_rate
        assert base is not None
        assert rate is not None
        container.seek(max(round(start / base), 0), stream=stream)  # to the key frame before
        found = 0
        for frame in container.decode(stream):
            if found == count:
                return
            if frame.pts is not None and float(frame.pts * base) > start - 0.5 / float(rate):
                found += 1
                yield frame.to_ndarray(format="rgb24")
    if found < count:
        raise ValueError(f"{path} has {found} frames from {start:.3f} s on; {count} are needed.")
