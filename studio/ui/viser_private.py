"""The only file that touches what viser keeps to itself; `tests/test_ui.py` holds it to viser 1.1."""

from __future__ import annotations

import viser
from viser._messages import RunJavascriptMessage


def run_javascript(server: viser.ViserServer, source: str) -> None:
    """Run a script in every browser that is or will be connected, again after each reconnection."""
    server._websock_server.queue_message(RunJavascriptMessage(source))


def show_jpeg(image: viser.GuiImageHandle, jpeg: bytes) -> None:
    """Show an image that is encoded already; `image.image` would encode it a second time."""
    image._data = jpeg
