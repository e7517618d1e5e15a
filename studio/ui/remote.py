"""The page's end of the session process: posts commands without waiting, keeps the newest of each report."""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path
from typing import Literal

from studio.channels import Latest, Mailbox
from studio.link import Link, connect
from studio.messages import CameraImage, Command, Frame, Hands, MoveTo, Notice, Report, Status, TaskState

SILENCE = 1.5  # [s] without a frame after which the session counts as stuck; it sends 33 a second

State = Literal["closed", "open", "stuck"]


class Remote:
    """A session process as the page sees it. Any thread may call; `connect` again after a restart."""

    def __init__(self) -> None:
        self.frame: Latest[Frame] = Latest()
        self.status: Latest[Status] = Latest()
        self.task_state: Latest[TaskState] = Latest()
        self.images: dict[str, CameraImage] = {}  # newest of each camera
        self.notices: Mailbox[Notice] = Mailbox()
        self.newest_notice: Latest[Notice] = Latest()
        self._link: Link | None = None
        self._heard = 0.0  # [s] monotonic time of the newest report
        self._waiting: deque[Command] = deque()
        self._is_sending = False  # whether the thread has taken one off `_waiting` that is under way
        self._changed = threading.Condition()
        self._framed = threading.Event()
        self._has_status = threading.Event()
        threading.Thread(target=self._send, name="commands", daemon=True).start()

    @property
    def state(self) -> State:
        """Whether somebody is there, and alive."""
        if self._link is None or not self._link.is_open:
            return "closed"
        return "open" if self.silence < SILENCE else "stuck"

    @property
    def silence(self) -> float:
        """[s] since the newest report."""
        return time.monotonic() - self._heard

    def connect(self, socket: Path, timeout: float = 30.0) -> None:
        """Talk to the session process at `socket`; raises TimeoutError where none tells its status."""
        self.close()
        self.images.clear()
        self._has_status.clear()
        link = connect(socket, self._hear, timeout=timeout)
        if not self._has_status.wait(max(timeout, SILENCE)):
            link.close()
            raise TimeoutError("The session process says nothing.")
        with self._changed:
            self._waiting.clear()  # meant for the process before
            self._heard = time.monotonic()
            self._link = link

    def close(self) -> None:
        """Leave the session process alone; it goes on."""
        if self._link is not None:
            self._link.close()

    def wait(self, timeout: float) -> None:
        """Until a frame comes that nobody has waited for, at most `timeout` [s]."""
        self._framed.wait(timeout)
        self._framed.clear()

    def post(self, command: Command) -> None:
        """Send soon, in order. A target or hands that still wait are replaced by the next of their kind."""
        with self._changed:
            # Waking the thread that may wait costs more than all the rest, a hundred times a second.
            is_next = not (self._waiting or self._is_sending)
            if is_next and self._link is not None and self._link.send_at_once(command):
                return
            if self._waiting and _replaces(command, self._waiting[-1]):
                self._waiting.pop()
            self._waiting.append(command)
            self._changed.notify()

    def _send(self) -> None:
        while True:
            with self._changed:
                self._is_sending = False
                self._changed.wait_for(lambda: self._waiting)
                self._is_sending = True
                command, link = self._waiting.popleft(), self._link
            if link is not None:
                link.send(command)  # may wait for a stuck session; nobody waits for us

    def _hear(self, report: Report) -> None:
        self._heard = time.monotonic()
        match report:
            case Frame():
                self.frame.set(report)
                self._framed.set()
            case Status():
                self.status.set(report)
                self._has_status.set()
            case CameraImage():
                self.images[report.camera] = report
            case TaskState():
                self.task_state.set(_merged(self.task_state.get()[0], report))
            case Notice():
                self.newest_notice.set(report)
                self.notices.post(report)


def _replaces(command: Command, before: Command) -> bool:
    if isinstance(command, MoveTo):
        return isinstance(before, MoveTo) and before.arm == command.arm
    return isinstance(command, Hands) and isinstance(before, Hands)


def _merged(known: TaskState | None, told: TaskState) -> TaskState:
    """What is known of a task's state: each report tells only the arrays that changed."""
    if known is None or known.resets != told.resets:
        return told
    return TaskState(resets=told.resets, arrays={**known.arrays, **told.arrays})
