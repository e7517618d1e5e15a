"""The two kinds of channel: `Latest`, where the newest value wins, and `Mailbox`, where nothing is lost.

Both are for threads of one process; `studio.shared` has their counterparts across processes.
"""

from __future__ import annotations

import queue
import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """A slot that holds the newest value. Writers never wait, readers never see half a value."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._value: T | None = None
        self._count = 0

    def set(self, value: T) -> None:
        with self._lock:
            self._value, self._count = value, self._count + 1

    def get(self) -> tuple[T | None, int]:
        """The newest value (None before the first) and how many were set so far."""
        with self._lock:
            return self._value, self._count


class Mailbox(Generic[T]):
    """An unbounded queue that one owner drains. Posting never waits."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[T] = queue.SimpleQueue()

    def post(self, value: T) -> None:
        self._queue.put(value)

    def drain(self) -> list[T]:
        """Everything posted since the last call, in order; does not wait."""
        values = []
        while True:
            try:
                values.append(self._queue.get_nowait())
            except queue.Empty:
                return values
