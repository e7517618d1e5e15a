"""Records takes: the session tells a `Take` its steps, a thread of its own encodes and writes them.

    with recorder.start(header) as take:
        run(session, [take])
        path = take.finish(Outcome(True, "wiped"))

    DATA/episodes/<task>/<id>.mcap      DATA/trash/<task>/<id>.mcap  (discarded)

A take is kept whatever happens: a `with` that raises finishes it, a disk that runs low finishes it early, a
write that fails leaves a `.part` for `episode.recover`, and so does a crash, short of the last half second.
"""

from __future__ import annotations

import importlib.metadata
import platform
import queue
import re
import secrets
import shutil
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from types import TracebackType

from controller.types import Step
from studio.episode import PART, Event, Header, Outcome
from studio.episode_writer import EpisodeWriter

SYNC_PERIOD = 0.25  # [s] between writes to the disk: half of what a crash may cost
GATHER = 0.05  # [s] between looks at the queue: waking up for every step would cost half as much again
MIN_FREE = 1e9  # [bytes] below which no take starts, and a running one ends
BACKLOG = 1000  # steps, 10 s, 150 MB with three cameras: a disk that lags further behind has failed
HEADLESS_BACKLOG = 25  # steps, 0.25 s of simulated time: headless, the session waits for the disk


class NotEnoughSpaceError(OSError):
    """The disk is too full to record."""


class Recorder:
    """Starts takes below `data_dir`. Several may run at once, also in other processes."""

    def __init__(self, data_dir: Path, min_free: float = MIN_FREE) -> None:
        """`min_free` [bytes] must be free on the disk of `data_dir`."""
        self.data_dir = data_dir
        self.min_free = min_free

    def start(self, header: Header, realtime: bool = True) -> Take:
        """Open a take. `realtime=False` lets `Take.on_step` wait for the disk, see there."""
        self.data_dir.mkdir(parents=True, exist_ok=True)
        if lack := _lack_of_space(self.data_dir, self.min_free):
            raise NotEnoughSpaceError(lack)
        return Take(self.data_dir, header, self.min_free, realtime)


_Item = tuple[Step, float] | Event | Outcome  # a step and when it was told, unix time [s]


class Take:
    """One recording, a `Subscriber` of the session. Its methods are for the session's thread."""

    def __init__(self, data_dir: Path, header: Header, min_free: float, realtime: bool) -> None:
        self.header = header
        self._data_dir, self._min_free, self._realtime = data_dir, min_free, realtime
        self._writer = EpisodeWriter(
            data_dir / "episodes" / header.task / f"{header.episode_id}.mcap", header
        )
        self._path = self._writer.path
        self._error: str | None = None
        self._time = 0.0  # [s] since reset: the newest state told
        self._queue: queue.Queue[_Item] = queue.Queue(BACKLOG if realtime else HEADLESS_BACKLOG)
        self._finishing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"take {header.episode_id}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Take:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the take, if nobody has: what was recorded before an error is kept."""
        self.finish(
            Outcome(None, f"{type(error).__name__}: {error}" if error else "ended without an outcome")
        )

    @property
    def error(self) -> str | None:
        """Why recording stopped by itself, a sentence; the take was kept. None while all is well."""
        return self._error

    @property
    def path(self) -> Path:
        """Where the take is, or will be when it is finished."""
        return self._path

    def on_step(self, step: Step) -> None:
        """Record a step. Does nothing after an error.

        In real time it never waits: a disk that lags `BACKLOG` steps behind ends the take with an error.
        Headless it waits while `HEADLESS_BACKLOG` steps are unwritten, so that memory and loss stay bounded.
        """
        self._time = step.observation.time
        self._post((step, time.time()))

    def add_event(self, kind: str, text: str) -> None:
        """Note that something happened now, e.g. ("operator", "Ana took over")."""
        self._post(Event(self._time, kind, text))

    def finish(self, outcome: Outcome) -> Path:
        """End the take; return where it is, when all of it is on the disk.

        After an `error` the take has ended with that as its reason; where even that could not be written, the
        path is that of the `.part`. A second call changes nothing.
        """
        self._finishing.set()
        self._wait_to_put(outcome)
        self._thread.join()
        return self._path

    def discard(self) -> Path:
        """End the take and move it to the trash; return where it is."""
        path = self.finish(Outcome(None, "discarded"))
        trash = self._data_dir / "trash" / self.header.task / path.name
        trash.parent.mkdir(parents=True, exist_ok=True)
        self._path = path.rename(trash)
        return self._path

    def _post(self, item: _Item) -> None:
        if self._error is not None:
            return
        if not self._realtime:
            self._wait_to_put(item)
            return
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self._error = f"The disk is too slow: {BACKLOG} steps wait for it. The take stopped and is kept."

    def _wait_to_put(self, item: _Item) -> None:
        """Wait for room in the queue, unless the take has ended."""
        while self._thread.is_alive():
            try:
                return self._queue.put(item, timeout=0.1)
            except queue.Full:
                continue

    def _run(self) -> None:
        """The writer's thread."""
        try:
            outcome = self._write_steps()
        except OSError as error:
            self._fail(error)
        except Exception as error:  # a step that cannot be encoded: keep those before it
            self._error = f"A step could not be recorded ({error}). The take stopped and is kept."
            self._end(Outcome(None, self._error))
        else:
            self._end(Outcome(None, self._error) if self._error else outcome)

    def _write_steps(self) -> Outcome:
        """Write what is posted until the take ends, or until nothing is left after an error."""
        synced, due = time.monotonic(), SYNC_PERIOD
        while not (self._error and self._queue.empty()):
            match self._next(synced + SYNC_PERIOD):
                case Outcome() as outcome:
                    return outcome
                case Event() as event:
                    self._writer.add_event(event)
                case (step, wall):
                    self._writer.add(step, wall)
            if time.monotonic() >= synced + SYNC_PERIOD:
                self._writer.sync()
                synced = time.monotonic()
                if lack := _lack_of_space(self._data_dir, self._min_free):
                    self._error = f"{lack} The take stopped and is kept."
            elif not self._realtime and self._writer.time >= due:  # faster than the clock
                self._writer.flush()
                due = self._writer.time + SYNC_PERIOD
        return Outcome(None, "stopped")

    def _next(self, deadline: float) -> _Item | None:
        """What was posted next, or None at `deadline` (monotonic)."""
        if self._realtime and self._queue.empty():
            self._finishing.wait(GATHER)
        try:
            return self._queue.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return None

    def _end(self, outcome: Outcome) -> None:
        try:
            self._path = self._writer.finish(outcome)
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        """Leave the take as a `.part` after a failed write."""
        self._error = f"Recording failed ({error}). What was written is kept; `studio recover` finishes it."
        self._path = self._path.with_name(self._path.name + PART)
        with suppress(OSError):  # closing tries to write again; the error is told already
            self._writer.close()


def new_episode_id(task: str) -> str:
    """Sorts by time (UTC, to the second), and is unique across processes and machines."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{task}-{secrets.token_hex(3)}"


@cache
def versions() -> dict[str, str]:
    """Of what decides whether a replay gives the same bits, for `Header.versions`."""
    packages = {"studio": "compact-studio", "mujoco": "mujoco", "numpy": "numpy", "pin": "pin"}
    found = {name: importlib.metadata.version(package) for name, package in packages.items()}
    return {**found, "python": platform.python_version(), "machine": platform.machine(), "cpu": _cpu()}


def _cpu() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    model = re.search(r"model name\s*: (.*)", text)
    return model[1] if model else platform.processor()


def _lack_of_space(directory: Path, min_free: float) -> str | None:
    free = shutil.disk_usage(directory).free
    if free >= min_free:
        return None
    return f"Only {free / 1e6:.0f} MB are free in {directory}; recording needs {min_free / 1e6:.0f} MB."
