"""A browser's socket without a browser: reads viser's page, clicks its buttons, presses its keys."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, Self

import msgspec
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

PATIENCE = 20.0  # [s]
CAMERA = {  # only who tells where the camera is counts as a client; this one looks along +x
    "type": "ViewerCameraMessage",
    "wxyz": (0.5, -0.5, 0.5, -0.5),
    "position": (-1.0, 0.0, 0.5),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 540,
    "image_width": 960,
    "look_at": (0.0, 0.0, 0.5),
    "up_direction": (0.0, 0.0, 1.0),
}


class Visitor:
    """Use it with `with`."""

    def __init__(self, port: int, query: str = "", headers: dict[str, str] | None = None) -> None:
        self.widgets: dict[str, dict[str, Any]] = {}  # properties, by uuid
        self.commands: dict[str, str] = {}  # uuid of each command, by label
        self.notifications: list[tuple[str, str]] = []  # title, text
        self.bytes = 0
        self._socket = connect(
            f"ws://127.0.0.1:{port}/{query}",
            additional_headers=headers,
            subprotocols=[Subprotocol(f"viser-v{version('viser')}")],
            compression=None,
            max_size=None,
            proxy=None,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        self.send(CAMERA)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join()

    def send(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def button(self, label: str) -> dict[str, Any]:
        """The properties of the button whose label contains this."""
        return wait_for(lambda: self._find("GuiButtonMessage", label))

    def click(self, label: str) -> None:
        self.send(
            {"type": "GuiUpdateMessage", "uuid": self.button(label)["uuid"], "updates": {"value": True}}
        )

    def hold(self, label: str, frequency: float) -> None:
        """One of the messages of a button that is held down."""
        uuid = self.button(label)["uuid"]
        self.send({"type": "GuiButtonHoldMessage", "uuid": uuid, "frequency": frequency})

    def press(self, command: str) -> None:
        """A hotkey, by the label of its command."""
        uuid = wait_for(lambda: self.commands.get(command))
        self.send({"type": "CommandTriggerMessage", "uuid": uuid})

    def html(self, text: str) -> str:
        """Of the element that contains `text`, as soon as one does."""
        return str(wait_for(lambda: self._find("GuiHtmlMessage", text, "content"))["content"])

    def says(self, text: str) -> bool:
        return self._find("GuiHtmlMessage", text, "content") is not None

    def _find(self, kind: str, text: str, where: str = "label") -> dict[str, Any] | None:
        for props in list(self.widgets.values()):
            if props["type"] == kind and props["visible"] and text in (props[where] or ""):
                return props
        return None

    def _read(self) -> None:
        try:
            while True:
                window = self._socket.recv(decode=False)
                self.bytes += len(window)
                for message in _decode(window)["messages"]:
                    self._take(message)
        except ConnectionClosed:
            return

    def _take(self, message: dict[str, Any]) -> None:
        kind, uuid = message["type"], message.get("uuid", "")
        if kind == "GuiUpdateMessage":
            self.widgets.get(uuid, {}).update(message["updates"])
        elif kind.startswith("Gui") and "props" in message:
            self.widgets[uuid] = {"uuid": uuid, "type": kind, **message["props"]}
        elif kind == "GuiRemoveMessage":
            self.widgets.pop(uuid, None)
        elif kind == "RegisterCommandMessage":
            self.commands[message["props"]["label"]] = uuid
        elif kind == "NotificationShowMessage":
            self.notifications.append((message["props"]["title"], message["props"]["body"]))


def wait_for(condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
    """What `condition` gives as soon as it gives something."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return found


def _decode(window: bytes) -> dict[str, Any]:
    """viser's frame: two sizes, msgpack in zstd, then the raw arrays."""
    packed = int.from_bytes(window[8:16], "little")
    message: dict[str, Any] = msgspec.msgpack.decode(
        zstandard.ZstdDecompressor().decompress(window[16 : 16 + packed])
    )
    return message
