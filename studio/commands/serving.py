"""Commands that serve the page, and that drive beside it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

from studio.commands.terminal import DATA, Data, Json, console, print_json, say


def serve(
    data: Data = DATA,
    host: str = "127.0.0.1",
    port: int = 8080,
    task: str = "wiping",
    cameras: bool = True,
    stiffness_table: Literal["tuned", "literal"] = "tuned",
    cert: Path | None = None,
    key: Path | None = None,
    tls: bool = True,
    new_token: bool = False,
    open: bool = False,
) -> int:
    """Serve the page: drive, record and review in the browser, until Ctrl-C.

    Args:
        host: Where to listen; only this machine by default. Elsewhere a token is needed, and TLS is spoken.
        port: 0 takes a free one.
        task: What is on the stage first.
        cameras: Render images.
        stiffness_table: What low, medium and high mean: our values, or the paper's numbers on all diagonals.
        cert: A certificate that browsers trust, instead of this installation's own; see `studio cert`.
        key: Its key.
        tls: Encrypt what goes to other machines; only a proxy that does so itself makes this needless.
        new_token: Shut out everybody who came in by the link so far.
        open: Open the page in this machine's browser.
    """
    from studio import serve as server
    from studio.cert import Certificate, read

    if (cert is None) != (key is None):
        raise ValueError("--cert and --key belong together; give both or none.")
    certificate = Certificate(cert, key) if cert and key else None
    if certificate:
        read(certificate)  # refuses what is none
    server.serve(
        data,
        host,
        port,
        task,
        cameras=cameras,
        stiffness_table=stiffness_table,
        certificate=certificate,
        tls=tls,
        new_token=new_token,
        open_page=open,
        tell=say,
    )
    return 0


def make_certificate(names: tuple[str, ...] = (), json: Json = False) -> int:
    """Make a new certificate of this installation, for the pages that other machines open.

    Args:
        names: Further host names and addresses of this machine, e.g. of a DNS server.
    """
    from studio import cert, invitation

    certificate = cert.make(invitation.folder(), (*names, *cert.names_of_this_machine()))
    facts = cert.read(certificate)
    if json:
        print_json({**dataclasses.asdict(facts), "cert": certificate.path, "key": certificate.key})
        return 0
    console.print(f"{certificate.path}, with a key that only you can read, until {facts.expires:%d %b %Y}.")
    console.print(
        f"For {', '.join(facts.names)}. Browsers warn once; its SHA-256 fingerprint is", soft_wrap=True
    )
    console.print(f"  {facts.fingerprint}", soft_wrap=True)
    return 0


def steamvr(
    data: Data = DATA,
    scale: float = 1.0,
    view: float | None = None,
    grip_as_clutch: bool = False,
    one_arm: Literal["left", "right"] = "right",
    dead_band: float = 3.0,
    full: float = 50.0,
    strength: float = 1.0,
    countdown: float = 3.0,
    operator: str = "",
) -> int:
    """Drive the running session of a data folder with Vive wands through SteamVR, until Ctrl-C.

    Args:
        scale: An arm's way to the hand's; rotations are never scaled.
        view: Degrees by which you stand turned from the robot: 0 behind it, 90 on its right, 180 facing it;
            by default behind two arms and to the right of one.
        grip_as_clutch: An arm follows while the grip is held; the menu button switches stiffness.
        one_arm: The hand that leads where there is one arm.
        dead_band: Contact force in newtons from which on it vibrates.
        full: Contact force in newtons at which it vibrates fully.
        strength: Of the vibration, 0 to 1.
        countdown: Seconds before recording.
        operator: Your name, kept with each take.
    """
    from studio.inputs.controllers import GRIP_AS_CLUTCH, PAPER, Settings
    from studio.inputs.haptics import Haptics
    from studio.inputs.steamvr import drive
    from studio.link import socket_path

    settings = Settings(
        mapping=GRIP_AS_CLUTCH if grip_as_clutch else PAPER,
        haptics=Haptics(dead_band, full, strength),
        scale=scale,
        view=None if view is None else math.radians(view),
        one_arm=one_arm,
        countdown=countdown,
        operator=operator,
    )
    drive(socket_path(data), settings, tell=say)
    return 0
