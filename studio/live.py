"""The session process: one twin in real time, one recorder, commands in, reports out.

`python -m studio.live --data DIR --task NAME` owns the robot for as long as it runs. Whoever drives, records
or watches is a client on its socket (`studio.link`); a client that stalls, crashes or leaves never stops the
loop. Without any client the arms hold, and after a minute the take is kept and the process ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import tyro

from controller.servo import ServoConfig
from controller.stiffness import StiffnessTable
from studio import messages as m
from studio.link import Hub, socket_path
from studio.live_session import LiveSession

REALTIME_PRIORITY = 10  # of 99: below what the kernel's own threads use
SWITCH_INTERVAL = 0.0005  # [s] after which another thread must hand the interpreter back to the loop


class SessionRunning(RuntimeError):
    """Another session process owns this data folder."""


@contextlib.contextmanager
def _ownership(path: Path) -> Iterator[None]:
    """Be the only session of a socket path; a lock that dies with its process."""
    with path.with_suffix(".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SessionRunning(f"A session process listens at {path} already.") from None
        yield


def main(
    data: Path,
    task: str = "wiping",
    seed: int = 0,
    cameras: bool = True,
    stiffness_table: StiffnessTable = "tuned",
) -> None:
    """Run the session process of a data folder.

    Args:
        data: The data folder.
        task: What is on the stage first.
        seed: Of the first scene.
        cameras: Render images.
        stiffness_table: What the stiffness modes mean, see controller/stiffness.py.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    sys.setswitchinterval(SWITCH_INTERVAL)
    path = socket_path(data)
    with _ownership(path):
        hub = Hub(path)
        try:
            config = ServoConfig.for_table(stiffness_table)
            session = LiveSession(data.absolute(), task, hub, seed=seed, cameras=cameras, config=config)
            _end_on_signal(lambda: hub.commands.post(m.Shutdown()))
            _claim_priority()
            gc.collect()
            gc.freeze()
            session.run()
        finally:
            hub.close()
            path.unlink(missing_ok=True)


def _claim_priority() -> None:
    """Let the loop run before cameras, page and jobs, where the user may.

    The calling thread gets a real-time policy, so that it runs the moment its deadline comes; with a higher
    priority alone it waits until the time slice of whoever has the core is over. Nothing that it starts later
    inherits the policy.
    """
    with contextlib.suppress(PermissionError):
        os.nice(-5)
    if hasattr(os, "SCHED_RESET_ON_FORK"):  # Linux
        with contextlib.suppress(PermissionError):
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(REALTIME_PRIORITY))


def _end_on_signal(end: Callable[[], None]) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: end())


if __name__ == "__main__":
    tyro.cli(main)
