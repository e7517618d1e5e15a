"""Who has control, as each client sees it: its name, and buttons to take, ask for and hand over control."""

from __future__ import annotations

from contextlib import suppress
from html import escape

import viser

from studio.lease import PATIENCE, NotDriving, Seat, Standing
from studio.ui import scene
from studio.ui.gate import Gate

GIZMOS = f"{scene.LIVE}/gizmo"


class ControlRows:
    """Fills `container` for every client that is or will be connected; `show` keeps it up to date."""

    def __init__(self, server: viser.ViserServer, container: viser.GuiFolderHandle, gate: Gate) -> None:
        self._server, self._container, self._gate = server, container, gate
        self._clients: dict[int, _Rows] = {}
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def show(self) -> None:
        for rows in list(self._clients.values()):
            with suppress(RuntimeError):  # it has gone meanwhile, and its widgets with it
                rows.show()

    def _connect(self, client: viser.ClientHandle) -> None:
        seat = self._gate.seat(client.client_id)
        if seat is not None:  # else it has gone again
            with self._container:
                self._clients[client.client_id] = _Rows(client, seat)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        self._clients.pop(client.client_id, None)


class _Rows:
    """Of one client."""

    def __init__(self, client: viser.ClientHandle, seat: Seat) -> None:
        self._client, self._seat = client, seat
        self._hidden: viser.FrameHandle | None = None  # in place of the gizmos, while somebody else drives
        gui = client.gui
        name = gui.add_text(
            "Operator", seat.name, hint="Your name, kept with each take and with what you note."
        )
        name.on_update(lambda _: seat.rename(name.value))
        self._words = gui.add_html("", visible=False)
        self._button = gui.add_button("", color="blue", visible=False)
        self._keep = gui.add_button("Keep control", color="dark", visible=False)
        self._button.on_click(lambda _: self._press())
        self._keep.on_click(lambda _: seat.keep())
        self.show()

    def show(self) -> None:
        standing = self._seat.standing
        is_alone = standing.n_people < 2 and (standing.is_mine or not standing.holder)
        self._words.content = words(standing)
        self._words.visible = self._button.visible = not is_alone
        self._button.label = action(standing)
        is_urgent = not standing.holder or (standing.is_mine and standing.asker)
        self._button.color = "blue" if is_urgent else "dark"
        self._button.disabled = bool(standing.asker) and not standing.is_mine
        self._keep.visible = standing.is_mine and bool(standing.asker)
        self._hide_gizmos(bool(standing.holder) and not standing.is_mine)

    def _press(self) -> None:
        try:
            self._seat.give_up() if self._seat.may_drive else self._seat.ask()
        except NotDriving as error:
            self._client.add_notification("You are watching", str(error), color="orange")
        self.show()

    def _hide_gizmos(self, hidden: bool) -> None:
        if hidden and self._hidden is None:
            self._hidden = scene.hide(self._client, GIZMOS)
        elif not hidden and self._hidden is not None:
            self._hidden.remove()
            self._hidden = None


def words(standing: Standing) -> str:
    """Who has control and who wants it, as HTML."""
    holder, asker = escape(standing.holder), escape(standing.asker)
    if standing.is_mine and asker:
        return (
            f'<div class="card"><b>{asker}</b> asks for control. It passes on when you have done nothing for '
            f"{PATIENCE:.0f} s.</div>"
        )
    if standing.is_mine:
        return '<div class="text"><b class="good">You have control.</b></div>'
    if not holder:
        return '<div class="text dim">Nobody has control. Whoever acts first takes it.</div>'
    asked = "You have asked" if standing.is_asked_by_me else f"{asker} has asked"
    wait = f" {asked}; it passes on when {holder} has done nothing for {PATIENCE:.0f} s." if asker else ""
    # The mark lets `web_assets/page.css` grey out what only the holder may use.
    return f'<div class="text"><i class="watching"></i><b>{holder}</b> has control; you watch.{wait}</div>'


def action(standing: Standing) -> str:
    """What the button does."""
    if standing.is_mine:
        return f"Hand over to {standing.asker}" if standing.asker else "Give up control"
    if not standing.holder:
        return "Take control"
    return "Asked" if standing.asker else "Ask for control"
