"""A process that reads takes for the web process, which carries the hands of those who drive."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

import msgspec
import numpy as np

from controller.types import Array
from studio import curves
from studio.episode import Episode, open_episode
from studio.interpolation import newest

NICE = 5  # behind whatever serves people
OPEN = 6  # takes kept open; each holds up to 32 MB of what it read last
ORPHAN = 2.0  # [s] between looks whether the web process still is

P = ParamSpec("P")
T = TypeVar("T")


class Reader:
    """Runs functions of modules in one other process, which starts with the first. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None
        self._aside: Reader | None = None

    @property
    def aside(self) -> Reader:
        """A second process, for what takes seconds: nobody waits behind it for a glance at a take."""
        with self._lock:
            self._aside = self._aside or Reader()
            return self._aside

    def start(self) -> None:
        """Begin to start the process, so that the first who asks need not wait for that."""
        try:
            self._submit(curves.prepare)
        except BrokenProcessPool:
            self._end_pool()

    def read(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Wait for what `function` returns or raises; a process that died meanwhile is started once more."""
        try:
            return self._submit(function, *args, **kwargs).result()
        except BrokenProcessPool:
            self._end_pool()
            return self._submit(function, *args, **kwargs).result()

    def close(self) -> None:
        """End the process, and the one aside; the next call starts another."""
        self._end_pool()
        with self._lock:
            aside, self._aside = self._aside, None
        if aside is not None:
            aside.close()

    def _end_pool(self) -> None:
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(cancel_futures=True)

    def _submit(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        with self._lock:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(1, get_context("spawn"), _prepare, (os.getpid(),))
            return self._pool.submit(function, *args, **kwargs)


def columns_npz(path: Path, groups: tuple[str, ...], every: int) -> bytes:
    """Columns as `Episode.columns` names them, each `every`-th row, as NumPy's archive."""
    file = io.BytesIO()
    np.savez(file, **_columns(path, groups, every))  # type: ignore[arg-type]
    return file.getvalue()


def columns_arrow(path: Path, groups: tuple[str, ...], every: int) -> bytes:
    """The same as a stream of Arrow's; a matrix is a column of lists of fixed length.

    Raise ValueError where the groups have different numbers of rows.
    """
    import pyarrow as pa

    columns = _columns(path, groups, every)
    lengths = {name.rpartition("/")[0]: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{group} {n}" for group, n in sorted(lengths.items()))
        raise ValueError(f"An Arrow table has rows of one length; ask for one group at a time, not {told}.")
    arrays = {
        name: pa.array(column)
        if column.ndim == 1
        else pa.FixedSizeListArray.from_arrays(pa.array(column.ravel()), column.shape[1])
        for name, column in columns.items()
    }
    table, sink = pa.table(arrays), pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return bytes(sink.getvalue())


def columns_json(path: Path, groups: tuple[str, ...], every: int) -> bytes:
    """The same as lists; NaN becomes null."""
    columns = _columns(path, groups, every)
    return msgspec.json.encode({name: column.tolist() for name, column in columns.items()})


def jpeg(path: Path, camera: str, number: int) -> bytes:
    """One image of a camera, by its number."""
    return _opened(path).jpeg(camera, number)


def jpeg_at(path: Path, camera: str, at: float) -> bytes:
    """The newest at or before `at` [s], else the first."""
    episode = _opened(path)
    return episode.jpeg(camera, newest(episode.image_times(camera), at))


def _opened(path: Path) -> Episode:
    """Stays open: whoever plays a take asks for its images one after the other."""
    status = path.stat()
    return _open(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=OPEN)
def _open(path: Path, mtime_ns: int, size: int) -> Episode:
    return open_episode(path)


def _columns(path: Path, groups: tuple[str, ...], every: int) -> dict[str, Array]:
    with open_episode(path) as episode:
        return {name: column[::every] for name, column in episode.columns(*groups).items()}


def _prepare(parent: int) -> None:
    """Of the process: it gives way, leaves Ctrl-C to the web process, and ends with it."""
    os.nice(NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(ORPHAN)
    os._exit(0)
