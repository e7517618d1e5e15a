"""What `studio serve` runs: the session process, and `studio.site` with the page. It ends them in order.

DATA/.serve.lock        held while a server runs on the folder; its pid and URL for the next one who tries
DATA/logs/session.log   what the session process says
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

from controller.stiffness import StiffnessTable
from studio import tasks
from studio.link import socket_path
from studio.messages import Shutdown
from studio.ui.remote import Remote

if TYPE_CHECKING:
    from studio.cert import Certificate

LOCK = ".serve.lock"
START_TIMEOUT = 60.0  # [s] for a session process to answer on a busy machine
SWITCH_INTERVAL = 0.001  # [s] after which a busy thread lets a hand on the gizmo through
END_TIMEOUT = 15.0  # [s] for it to keep a take and end

log = logging.getLogger(__name__)


class AlreadyServed(RuntimeError):
    """Another server runs on the data folder."""


class SessionProcess:
    """The session process of a data folder: found running, or started here in a process group of its own."""

    def __init__(
        self, data_dir: Path, task: str, *, cameras: bool = True, stiffness_table: StiffnessTable = "tuned"
    ) -> None:
        self._data_dir, self._task, self._cameras = data_dir, task, cameras
        self._stiffness_table: StiffnessTable = stiffness_table
        self._socket = socket_path(data_dir)
        self._child: subprocess.Popen[bytes] | None = None
        self.pid: int | None = None  # of the one that we talked to last

    def find(self) -> int | None:
        """The pid of the process that listens at the socket; None where none does."""
        with socket.socket(socket.AF_UNIX) as probe:
            try:
                probe.connect(str(self._socket))
            except OSError:
                return None
            pid: int = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
            return pid

    def start(self, task: str | None = None, seed: int = 0) -> None:
        """Start a new one; it outlives us, so that a crash of the page stops no take."""
        log_file = self._data_dir / "logs" / "session.log"
        log_file.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "studio.live", "--data", str(self._data_dir)]
        command += ["--task", task or self._task, "--seed", str(seed)]
        command += ["--stiffness-table", self._stiffness_table]
        command += [] if self._cameras else ["--no-cameras"]
        with log_file.open("ab") as file:
            self._child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
            )

    def connect(self, remote: Remote, timeout: float = START_TIMEOUT) -> None:
        """Raises RuntimeError where the process ends instead, TimeoutError where it does not answer."""
        deadline = time.monotonic() + timeout
        while True:
            try:
                remote.connect(self._socket, timeout=0.5)
                self.pid = self.find()
                return
            except TimeoutError:
                if self.has_ended:
                    raise RuntimeError(f"The session process ended at once: {self._last_words()}") from None
                if time.monotonic() > deadline:
                    raise

    @property
    def has_ended(self) -> bool:
        """Whether the one that was started here has."""
        return self._child is not None and self._child.poll() is not None

    def end(self) -> None:
        """Let it end by itself, and kill what is left; its cameras go with it."""
        pid = self.find()
        if self._child is not None and self._child.poll() is None:
            pid = self._child.pid
        if pid is not None:
            _end_group(pid)
        if self._child is not None:
            self._child.wait()
        self._child = None

    def wait(self, timeout: float = END_TIMEOUT) -> bool:
        """Until it has ended, at most `timeout` [s]; whether it has."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if self._child is None and self.find() is None:
                return True
            if self.has_ended:
                return True
            time.sleep(0.05)
        return False

    def _last_words(self) -> str:
        with contextlib.suppress(OSError):
            lines = (self._data_dir / "logs" / "session.log").read_text(errors="replace").split("\n")
            return next((line for line in reversed(lines) if line.strip()), "it said nothing")
        return "it said nothing"


def serve(
    data_dir: Path,
    host: str = "127.0.0.1",
    port: int = 8080,
    task: str = "wiping",
    *,
    cameras: bool = True,
    stiffness_table: StiffnessTable = "tuned",
    certificate: Certificate | None = None,
    tls: bool = True,
    new_token: bool = False,
    open_page: bool = False,
    tell: Callable[[str], None] = print,
) -> None:
    """Serve the page of a data folder until SIGINT or SIGTERM.

    Any other address than loopback gets a token, a new one if asked for, and TLS with the `certificate` or
    with this installation's own, unless switched off. Raises OSError or RuntimeError with a sentence where it
    cannot, e.g. where another server does already.
    """
    tasks.load(task)  # an unknown task is refused before anything starts
    data_dir = data_dir.absolute()
    data_dir.mkdir(parents=True, exist_ok=True)
    sys.setswitchinterval(SWITCH_INTERVAL)
    ended = _on_signals()
    with contextlib.ExitStack() as stack:
        lock = stack.enter_context(_lock(data_dir))
        process = SessionProcess(data_dir, task, cameras=cameras, stiffness_table=stiffness_table)
        if pid := process.find():
            tell(f"A session process is running already (process {pid}); the page joins it.")
        else:
            process.start()
            stack.callback(process.end)  # where the page does not come to be
        from studio.site import open_site  # takes seconds, in which the session process starts, too

        site = stack.enter_context(
            open_site(
                data_dir,
                process,
                host,
                port,
                certificate=certificate,
                tls=tls,
                new_token=new_token,
                tell=tell,
            )
        )
        _write(lock, site.front.url)
        site.page.start()
        stack.callback(_end_session, site.page.remote, process)
        if process.has_ended:  # on a machine so busy that nobody came for a minute
            process.start()
        process.connect(site.page.remote)
        tell(f"Comp-ACT Studio serves {data_dir} at {site.front.url}")
        if site.invitation:
            tell(site.invitation)
        if open_page:
            webbrowser.open(site.front.url)
        ended.wait()
        tell("Ending. A running take is kept.")


def _end_session(remote: Remote, process: SessionProcess) -> None:
    """Orderly: it keeps a running take; what does not answer is killed."""
    if remote.state == "open":
        remote.post(Shutdown())
        if process.wait():
            return
    process.end()


def _end_group(pid: int) -> None:
    """SIGTERM, some time, SIGKILL; to the whole group, which a session process leads."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, number)
        deadline = time.monotonic() + END_TIMEOUT / 3
        while _is_alive(pid) and time.monotonic() < deadline:
            time.sleep(0.05)


def _is_alive(pid: int) -> bool:
    """Also False for a zombie, which whoever started it has not looked at yet."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


@contextlib.contextmanager
def _lock(data_dir: Path) -> Iterator[IO[str]]:
    """Be the only server of a data folder; the lock dies with its process."""
    with (data_dir / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise AlreadyServed(_served(data_dir, file.read())) from None
        yield file
        file.truncate(0)


def _served(data_dir: Path, text: str) -> str:
    try:
        other = json.loads(text)
        return f"{data_dir} is served already at {other['url']} (process {other['pid']})."
    except (ValueError, KeyError):  # it is just starting
        return f"{data_dir} is served already by another process."


def _write(lock: IO[str], url: str) -> None:
    lock.truncate(0)
    json.dump({"pid": os.getpid(), "url": url}, lock)
    lock.flush()


def _on_signals() -> threading.Event:
    """Set by the first SIGINT or SIGTERM; a second one ends us the usual way."""
    ended = threading.Event()

    def end(number: int, _: object) -> None:
        ended.set()
        signal.signal(number, signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    return ended
