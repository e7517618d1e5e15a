"""The System tab: does the loop keep time, do the processes live, restart them, what this machine lacks."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from html import escape
from pathlib import Path

import viser

from studio.doctor import Finding, diagnose
from studio.invitation import qr_svg
from studio.messages import Status
from studio.session import CONTROL_PERIOD, LATE
from studio.ui.desk import Desk
from studio.ui.remote import State

MEGA = 1e6


class SystemTab:
    """Built into the container that is open; `show` keeps it up to date."""

    def __init__(
        self,
        gui: viser.GuiApi,
        desk: Desk,
        data_dir: Path,
        restart_session: Callable[[], None],
        invitation: Callable[[], str] | None = None,
    ) -> None:
        """`restart_session` must not wait; `invitation` gives the link with the token, where there is one."""
        self._data_dir = data_dir
        self._facts = gui.add_html("")
        self._restart = gui.add_button("Restart session", color="dark", icon=viser.Icon.REFRESH)
        cameras = gui.add_button("Restart cameras", color="dark", icon=viser.Icon.CAMERA)
        with gui.add_folder("This machine"):
            check = gui.add_button("Check", color="dark", icon=viser.Icon.STETHOSCOPE)
            findings = gui.add_html(
                '<div class="text dim">What is installed here, and the line that installs the rest.</div>'
            )

        self.for_everybody = [check]  # also for who only watches
        if invitation is not None:
            with gui.add_folder("Others") as others:
                self.for_everybody.append(_add_invitation(gui, others, invitation))

        @self._restart.on_click
        def _(_: object) -> None:
            restart_session()

        @cameras.on_click
        def _(_: object) -> None:
            desk.restart_cameras()

        @check.on_click
        def _(_: object) -> None:
            def run() -> None:
                findings.content = findings_html(diagnose())
                check.disabled = False

            check.disabled = True
            findings.content = '<div class="text dim">Looking; this takes some seconds…</div>'
            threading.Thread(target=run, name="doctor", daemon=True).start()

    def show(self, status: Status | None, state: State, n_viewers: int) -> None:
        free = shutil.disk_usage(self._data_dir).free
        self._facts.content = facts(status, state, n_viewers, self._data_dir, free)
        self._restart.color = "dark" if state == "open" else "red"
        # Restarting ends the take; whoever wants that stops it first.
        self._restart.disabled = state == "open" and status is not None and status.phase == "recording"


def _add_invitation(
    gui: viser.GuiApi, container: viser.GuiFolderHandle, invitation: Callable[[], str]
) -> viser.GuiButtonHandle:
    """A button that shows the link and its QR code to the client that presses it, and hides them again."""
    button = gui.add_button("Invite somebody", color="dark", icon=viser.Icon.QRCODE)
    shown: dict[int, viser.GuiHtmlHandle] = {}

    @button.on_click
    def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        client = event.client
        if client is None:
            return
        if (there := shown.pop(client.client_id, None)) is not None:
            there.remove()
        else:
            with container:
                shown[client.client_id] = client.gui.add_html(invitation_html(invitation()))

    return button


def invitation_html(link: str) -> str:
    """The link with its QR code."""
    return (
        f'<div class="text invitation">{qr_svg(link)}<code>{escape(link)}</code>'
        "Whoever has this link may come in, watch, and ask for control.</div>"
    )


def facts(status: Status | None, state: State, n_viewers: int, data_dir: Path, free: float) -> str:
    """Pace and processes as HTML."""
    words = {
        "open": '<b class="good">runs</b>',
        "stuck": '<b class="refused">does not answer</b>',
        "closed": '<b class="refused">has ended</b>',
    }
    rows = [("Session", words[state])]
    if status is not None and state == "open":
        on_time = "good" if status.late_share < 0.005 else "limited"
        rows += [
            ("Control loop", f"{status.rate:.1f} Hz of {1 / CONTROL_PERIOD:.0f} Hz"),
            (f"Ticks later than {LATE * 1e3:.0f} ms", f'<b class="{on_time}">{status.late_share:.2%}</b>'),
            ("Longest delay, 10 s", f"{status.worst_delay * 1e3:.0f} ms"),
            (
                "Cameras",
                f'<span class="limited">{escape(status.camera_error)}</span>'
                if status.camera_error
                else '<b class="good">run</b>',
            ),
        ]
    rows += [
        ("Viewers", str(n_viewers)),
        ("Data", escape(str(data_dir))),
        ("Free there", f"{free / 1e9:.0f} GB" if free > 1e10 else f"{free / MEGA:.0f} MB"),
    ]
    cells = "".join(f'<span class="dim">{name}</span><span>{value}</span>' for name, value in rows)
    return f'<div class="text facts">{cells}</div>'


def findings_html(findings: list[Finding]) -> str:
    """What the doctor found."""
    parts = []
    for finding in findings:
        color, word = ("good", "ok") if finding.ok else ("limited", "missing")
        remedy = f"<br><code>{escape(finding.remedy)}</code>" if finding.remedy else ""
        needed = f"<br>needed for {escape(finding.needed_for)}" if not finding.ok else ""
        detail = f'<span class="dim">{escape(finding.detail)}{needed}</span>'
        parts.append(f'<p><b class="{color}">{word}</b> {escape(finding.name)} {detail}{remedy}</p>')
    return f'<div class="text findings">{"".join(parts)}</div>'
