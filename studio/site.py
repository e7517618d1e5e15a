"""What `studio serve` shows: viser with the page, and the front server with all routes, on one data folder.

Kept apart from `studio.serve`, as all that is imported here takes as long as a session process to start.
"""

from __future__ import annotations

import contextlib
import getpass
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rich
import viser

from studio import cert, invitation
from studio.api import Studio
from studio.cert import Certificate
from studio.door import person_of
from studio.headset import add_xr
from studio.http import add_api
from studio.server import FrontServer, is_loopback, make_app, start_viser
from studio.ui.app import Page, SessionProcess
from studio.ui.gate import Gate
from studio.ui.remote import Remote


@dataclass(frozen=True, slots=True)
class Site:
    """All that stands, as long as it stands."""

    front: FrontServer
    page: Page
    certificate: Certificate | None

    @property
    def invitation(self) -> str:
        """What the terminal tells once: the link, and how to know that it leads here. Empty on loopback."""
        if self.front.token is None:
            return ""
        link = self.front.invitation
        lines = [invitation.qr_text(link)] if sys.stdout.isatty() else []
        lines += [f"Others come in by this link; who has it may ask for control:\n  {link}"]
        if self.certificate is None:
            lines += ["Without TLS whoever shares the network can read it, and headsets show no VR."]
        else:
            facts = cert.read(self.certificate)
            lines += [
                f"Their browsers warn once of a certificate with the fingerprint\n  {facts.fingerprint}"
            ]
        return "\n".join(lines)


@contextlib.contextmanager
def open_site(
    data_dir: Path,
    process: SessionProcess,
    host: str,
    port: int,
    *,
    certificate: Certificate | None = None,
    tls: bool = True,
    new_token: bool = False,
    tell: Callable[[str], None] = print,
) -> Iterator[Site]:
    """Recover torn takes, then serve the page; the session is not connected yet.

    Raises OSError, with a sentence for people, where the port cannot be had.
    """
    is_local = is_loopback(host)
    with contextlib.ExitStack() as stack:
        studio = stack.enter_context(Studio(data_dir))
        stack.enter_context(studio.jobs.kept_going())
        for recovery in studio.recover():
            tell(recovery.what)
        if not is_local and certificate is None and tls:
            certificate = cert.of_installation(invitation.folder())
        token = None if is_local else invitation.token(renew=new_token)
        gate = Gate(_user() if is_local else "")
        viewer = start_viser(arrive=gate.arrive)
        stack.callback(_stop, viewer)
        page = Page(viewer, studio, process, gate, (lambda: front.invitation) if token else None)
        stack.callback(page.close)
        app = make_app(
            viewer.get_port(),
            health=lambda: health(page.remote, process.pid, len(viewer.get_clients())),
            reception=gate.receive,
        )
        add_xr(app, page.remote, lambda socket: gate.lease.sit(person_of(socket), "headset"), page.model)
        stack.callback(add_api(app, studio, page.remote, gate.lease, page.views).close)
        front = FrontServer(app, host, port, token=token, certificate=certificate)
        stack.enter_context(front)
        yield Site(front, page, certificate)


def health(remote: Remote, session_pid: int | None, n_viewers: int) -> dict[str, Any]:
    """What /api/v1/health tells beside the server's own."""
    status, _ = remote.status.get()
    is_alive = remote.state == "open"
    return {
        "session": remote.state,
        "session_pid": session_pid if is_alive else None,
        "task": status.task if status else None,
        "phase": status.phase if status and is_alive else None,
        "take": status.take_id or None if status and is_alive else None,
        "cameras": (status.camera_error or "ok") if status and is_alive else None,
        "viewers": n_viewers,
    }


def _user() -> str:
    """Who is logged in, unless that says nothing."""
    user = getpass.getuser()
    return "" if user == "root" else user


def _stop(viewer: viser.ViserServer) -> None:
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True  # what it says is not for people
    try:
        viewer.stop()
    finally:
        console.quiet = quiet
