"""How processes of one studio talk: a `Hub` in the session process, a `Link` in each client.

A Unix socket in a folder that only its user may enter carries `studio.messages`. A client that stalls
never stalls the session: reports of which only the newest counts (`publish`) overwrite each other while they
wait, the others (`tell`) queue up, and a client with too many of them is dropped.
"""

from __future__ import annotations

import contextlib
import getpass
import hashlib
import logging
import os
import select
import socket
import stat
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path

import msgspec

from studio.channels import Mailbox
from studio.messages import Command, Message, Notice, Report, decode_command, decode_report, encode

MAX_QUEUE = 1000  # reports that may wait for a client before it is dropped

log = logging.getLogger(__name__)


def socket_path(data_dir: Path) -> Path:
    """Where the session process of a data folder listens; the folder is the user's alone."""
    folder = Path(tempfile.gettempdir()) / f"compact-studio-{getpass.getuser()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.geteuid() or about.st_mode & 0o077:
        raise PermissionError(f"{folder} can be entered by others; remove it or set its mode to 700.")
    return folder / f"{hashlib.sha256(str(data_dir.absolute()).encode()).hexdigest()[:16]}.sock"


class Outbox:
    """What waits for one client: the newest of each key, and a queue."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: dict[object, bytes] = {}
        self._queue: deque[bytes] = deque()
        self._closed = False

    def publish(self, key: object, data: bytes) -> None:
        with self._changed:
            self._newest[key] = data
            self._changed.notify()

    def tell(self, data: bytes) -> bool:
        """Whether there was room."""
        with self._changed:
            if len(self._queue) >= MAX_QUEUE:
                return False
            self._queue.append(data)
            self._changed.notify()
            return True

    def take(self) -> list[bytes] | None:
        """Wait for something to send; None when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._newest or self._closed)
            if self._closed:
                return None
            waiting = [*self._queue, *self._newest.values()]
            self._queue.clear()
            self._newest.clear()
            return waiting

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()


class Hub:
    """The session's end: collects commands of all clients, sends reports to all of them."""

    def __init__(self, path: Path) -> None:
        """Listen at `path`. A socket that a dead process left there is taken over."""
        self.commands: Mailbox[Command] = Mailbox()
        self._clients: dict[Connection, Outbox] = {}
        self._lock = threading.Lock()
        self._remembered: dict[object, bytes] = {}  # for clients that come later
        path.unlink(missing_ok=True)
        self._listener = Listener(str(path), family="AF_UNIX")
        threading.Thread(target=self._accept, name="hub", daemon=True).start()

    @property
    def n_clients(self) -> int:
        with self._lock:
            return len(self._clients)

    def publish(self, key: object, report: Report) -> None:
        """Send to all clients, in place of an earlier report of the same key that still waits."""
        data = encode(report)
        with self._lock:
            self._remembered[key] = data
            boxes = list(self._clients.values())
        for box in boxes:
            box.publish(key, data)

    def tell(self, report: Report) -> None:
        """Send to all clients; none is lost."""
        data = encode(report)
        with self._lock:
            clients = list(self._clients.items())
        for connection, box in clients:
            if not box.tell(data):
                log.warning("A client reads nothing and is dropped.")
                self._drop(connection)

    def close(self) -> None:
        self._listener.close()
        with self._lock:
            clients = list(self._clients)
        for connection in clients:
            self._drop(connection)

    def _accept(self) -> None:
        while True:
            try:
                connection: Connection = self._listener.accept()
            except OSError:
                return
            box = Outbox()
            with self._lock:
                self._clients[connection] = box
                remembered = list(self._remembered.items())
            for key, data in remembered:
                box.publish(key, data)
            threading.Thread(target=self._read, args=(connection,), name="hub reader", daemon=True).start()
            threading.Thread(
                target=self._write, args=(connection, box), name="hub writer", daemon=True
            ).start()

    def _read(self, connection: Connection) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                try:
                    self.commands.post(decode_command(connection.recv_bytes()))
                except msgspec.DecodeError as error:
                    log.warning("A malformed command was refused: %s", error)
                    self._answer(connection, Notice(kind="error", text=f"A command was refused: {error}."))
        self._drop(connection)

    def _answer(self, connection: Connection, report: Report) -> None:
        with self._lock:
            box = self._clients.get(connection)
        if box:
            box.tell(encode(report))

    def _write(self, connection: Connection, box: Outbox) -> None:
        with contextlib.suppress(OSError):
            while (waiting := box.take()) is not None:
                for data in waiting:
                    connection.send_bytes(data)
        self._drop(connection)

    def _drop(self, connection: Connection) -> None:
        with self._lock:
            box = self._clients.pop(connection, None)
        if box:
            box.close()
            _hang_up(connection)


class Link:
    """A client's end. Reports arrive on a thread of the link; commands may be sent from any thread."""

    def __init__(
        self, path: Path, on_report: Callable[[Report], None], on_close: Callable[[], None] = lambda: None
    ) -> None:
        """Connect to the session at `path`. Raises OSError where none listens."""
        self._connection: Connection = Client(str(path), family="AF_UNIX")
        self._on_report, self._on_close = on_report, on_close
        self._sending = threading.Lock()
        self.is_open = True
        self._thread = threading.Thread(target=self._read, name="link", daemon=True)
        self._thread.start()

    def send(self, command: Message) -> bool:
        """Whether the session took it."""
        try:
            with self._sending:
                self._connection.send_bytes(encode(command))
            return True
        except OSError:
            return False

    def send_at_once(self, command: Message) -> bool:
        """Whether it could be sent without any waiting."""
        if not self._sending.acquire(blocking=False):
            return False
        try:
            # A Unix socket counts as writable while most of its buffer is free: a command fits in.
            if not select.select((), (self._connection,), (), 0.0)[1]:
                return False
            self._connection.send_bytes(encode(command))
            return True
        except (OSError, ValueError):  # ValueError: closed
            return False
        finally:
            self._sending.release()

    def close(self) -> None:
        self._on_close = lambda: None
        self.is_open = False
        _hang_up(self._connection)

    def _read(self) -> None:
        with contextlib.suppress(EOFError, OSError, TypeError):  # TypeError: closed while reading
            while self.is_open:
                self._on_report(decode_report(self._connection.recv_bytes()))
        self.is_open = False
        self._on_close()


def connect(
    path: Path,
    on_report: Callable[[Report], None],
    on_close: Callable[[], None] = lambda: None,
    timeout: float = 30.0,
) -> Link:
    """A link to a session that is just starting; raises TimeoutError where it does not."""
    deadline = time.monotonic() + timeout
    while True:
        try:
            return Link(path, on_report, on_close)
        except OSError as error:
            if time.monotonic() > deadline:
                raise TimeoutError(f"The session process did not answer within {timeout:.0f} s.") from error
            time.sleep(0.05)


def _hang_up(connection: Connection) -> None:
    """Close a connection at which a thread may be waiting: only a shutdown wakes it, here and there."""
    with contextlib.suppress(OSError):
        with socket.socket(fileno=os.dup(connection.fileno())) as end:
            end.shutdown(socket.SHUT_RDWR)
        connection.close()
