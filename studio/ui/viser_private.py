"""The only file that touches what viser keeps to itself; `tests/test_ui.py` holds it to viser 1.1."""

from __future__ import annotations

from typing import Any

import viser
from viser._messages import (
    GuiUpdateMessage,
    Message,
    RunJavascriptMessage,
    SetOrientationMessage,
    SetPositionMessage,
)


def run_javascript(server: viser.ViserServer, source: str) -> None:
    """Run a script in every browser that is or will be connected, again after each reconnection."""
    server._websock_server.queue_message(RunJavascriptMessage(source))


def show_jpeg(image: viser.GuiImageHandle, jpeg: bytes) -> None:
    """Show an image that is encoded already; `image.image` would encode it a second time."""
    image._data = jpeg


def uuid(widget: object) -> str:
    """By which browsers name a widget."""
    found: str = widget._impl.uuid  # type: ignore[attr-defined]
    return found


def shared_widget(server: viser.ViserServer, uuid: str) -> Any:
    """The input that all clients share by this uuid; None where it is a client's own, or gone."""
    return server.gui._gui_input_handle_from_uuid.get(uuid)


def show_again(
    server: viser.ViserServer, client: viser.ClientHandle, *, widget: str = "", gizmo: str = ""
) -> None:
    """Undo in one browser what somebody did there with a shared widget or a shared gizmo."""
    messages: list[Message] = []
    if (handle := shared_widget(server, widget)) is not None and not handle._impl.is_button:
        messages.append(GuiUpdateMessage(widget, {"value": handle.value}))
    if (control := server.scene._handle_from_transform_controls_name.get(gizmo)) is not None:
        w, i, j, k = map(float, control.wxyz)
        x, y, z = map(float, control.position)
        messages += [SetOrientationMessage(gizmo, (w, i, j, k)), SetPositionMessage(gizmo, (x, y, z))]
    for message in messages:
        client._websock_connection.queue_message(message)
