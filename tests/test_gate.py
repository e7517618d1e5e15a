"""The gate: what a page never says is not heard, and who does not drive changes nothing that all share."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import msgspec
import pytest
import viser
from visitor import CAMERA, Visitor, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from studio.server import FrontServer, make_app, start_viser
from studio.ui.control import words
from studio.ui.gate import Gate, Seat

VISER = Subprotocol(f"viser-v{viser.__version__}")
NAN, INFINITY = float("nan"), float("inf")
GIZMO = "/gizmo"


class House:
    """A page of a button, a slider, a text, a key and a gizmo, and what was heard of them."""

    def __init__(self) -> None:
        self.gate = Gate()
        self.viser = start_viser(arrive=self.gate.arrive)
        self.gate.attach(self.viser)
        self.front = FrontServer(make_app(self.viser.get_port(), reception=self.gate.receive), port=0)
        self.front.start()
        self.heard: list[str] = []
        gui = self.viser.gui
        self.button = gui.add_button("Press")
        self.help = gui.add_button("Help")
        self.slider = gui.add_slider("Opening", 0.0, 1.0, 0.01, 0.5)
        self.gate.free(self.help)
        key = gui.add_command("Reset", hotkey="R")
        self.gizmo = self.viser.scene.add_transform_controls(GIZMO, position=(0.4, 0.0, 0.2))
        self.button.on_click(lambda _: self.heard.append("button"))
        self.button.on_hold(lambda _: self.heard.append("hold"), callback_hz=20.0)
        self.help.on_click(lambda _: self.heard.append("help"))
        self.slider.on_update(lambda _: self.heard.append("slider"))
        key.on_trigger(lambda _: self.heard.append("key"))
        self.gizmo.on_update(lambda event: self.heard.append(event.phase))

    def visitor(self) -> Guest:
        before = len(self.viser.get_clients())
        guest = Guest(self.front.port)
        wait_for(lambda: len(self.viser.get_clients()) > before)
        return guest

    def seat(self, number: int) -> Seat:
        return self.gate.seats[number]

    def drag(self, z: float) -> dict[str, Any]:
        return {
            "type": "TransformControlsUpdateMessage",
            "name": GIZMO,
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": (0.4, 0.0, z),
        }

    def close(self) -> None:
        self.front.stop()
        self.viser.stop()


class Guest(Visitor):
    """Keeps what is told of the gizmo, too."""

    def __init__(self, port: int) -> None:
        self.positions: list[tuple[float, ...]] = []
        super().__init__(port)

    def set(self, label: str, value: object) -> None:
        uuid = wait_for(lambda: [w for w in list(self.widgets.values()) if w.get("label") == label])[0][
            "uuid"
        ]
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def is_told(self, title: str) -> bool:
        return any(told == title for told, _ in self.notifications)

    def _take(self, message: dict[str, Any]) -> None:
        if message["type"] == "SetPositionMessage" and message["name"] == GIZMO:
            self.positions.append(tuple(message["position"]))
        super()._take(message)


@pytest.fixture
def house() -> Iterator[House]:
    house = House()
    yield house
    house.close()


def test_the_first_to_act_drives_and_what_a_viewer_does_goes_no_further(house: House) -> None:
    with house.visitor() as ana, house.visitor() as ben:
        ana.click("Press")
        wait_for(lambda: house.heard == ["button"])
        ben.click("Press")
        ben.hold("Press", 20.0)
        ben.press("Reset")
        ben.set("Opening", 0.9)
        ben.send({"type": "TransformControlsDragStartMessage", "name": GIZMO})
        ben.send(house.drag(0.1))
        wait_for(lambda: ben.is_told("You are watching"))
        wait_for(lambda: (0.4, 0.0, 0.2) in ben.positions)  # the gizmo goes back to where it is
        ben.click("Help")
        wait_for(lambda: house.heard == ["button", "help"])
        assert house.slider.value == 0.5
        assert house.gizmo.position[2] == 0.2
        assert not ana.is_told("You are watching")
        slider = next(w for w in ben.widgets.values() if w.get("label") == "Opening")
        assert slider["value"] == 0.5


def test_the_one_who_drives_is_heard(house: House) -> None:
    with house.visitor() as ana:
        ana.press("Reset")
        ana.hold("Press", 20.0)
        ana.set("Opening", 0.9)
        ana.send(house.drag(0.1))
        wait_for(lambda: set(house.heard) == {"key", "hold", "slider", "update"})
        assert house.slider.value == 0.9
        assert house.gizmo.position[2] == 0.1


def test_holding_and_dragging_never_take_control(house: House) -> None:
    with house.visitor() as ana:
        ana.hold("Press", 20.0)
        ana.send(house.drag(0.1))
        wait_for(lambda: ("You are watching", "Nobody has control. Take it first.") in ana.notifications)
        assert house.heard == []
        assert not house.gate.lease.holder


def test_control_is_free_again_after_a_page_has_closed(house: House) -> None:
    with house.visitor() as ben:
        with house.visitor() as ana:
            ana.click("Press")
            wait_for(lambda: house.heard)
        wait_for(lambda: not house.gate.lease.holder)
        ben.click("Press")
        wait_for(lambda: house.heard == ["button", "button"])


def test_control_is_asked_for_and_handed_over(house: House) -> None:
    with house.visitor() as ana, house.visitor():
        ana.click("Press")
        wait_for(lambda: house.gate.lease.holder)
        mine, other = house.seat(0), house.seat(1)
        mine.rename("<b>Ana")
        other.ask()
        assert "&lt;b&gt;Ana</b> has control; you watch. You have asked" in words(other.standing)
        assert "guest 2</b> asks for control" in words(mine.standing)
        mine.give_up()
        assert other.may_drive
        ana.click("Press")
        wait_for(lambda: ana.is_told("You are watching"))
        assert house.heard == ["button"]


MALFORMED: dict[str, object] = {
    "no message at all": [1, 2, 3],
    "unknown": {"type": "Nonsense"},
    "the share tunnel": {"type": "ShareUrlRequest"},
    "a file": {"type": "FileTransferStartUpload", "source_component_uuid": "a"},
    "of the server's own": {"type": "RunJavascriptMessage", "source": "alert(1)"},
    "nan in a camera": {**CAMERA, "position": (NAN, 0.0, 0.0)},
    "nan in a gizmo": {
        "type": "TransformControlsUpdateMessage",
        "name": GIZMO,
        "wxyz": (1.0, 0.0, 0.0, 0.0),
        "position": (0.4, 0.0, NAN),
    },
    "too few numbers": {
        "type": "TransformControlsUpdateMessage",
        "name": GIZMO,
        "wxyz": (1.0, 0.0, 0.0),
        "position": (0.4, 0.0, 0.1),
    },
    "a field too many": {"type": "CommandTriggerMessage", "uuid": "a", "excluded_self_client": 0},
    "a number for a name": {"type": "CommandTriggerMessage", "uuid": 3},
    "a long name": {"type": "CommandTriggerMessage", "uuid": 10_000 * "x"},
}


@pytest.mark.parametrize("what", MALFORMED)
def test_what_our_page_never_says_ends_the_connection(house: House, what: str) -> None:
    _is_thrown_out(house, msgspec.msgpack.encode(MALFORMED[what]))


@pytest.mark.parametrize(
    "updates",
    [
        {"value": NAN},
        {"value": INFINITY},
        {"value": "nan"},
        {"value": {"a": 1}},
        {"value": 100_000 * "x"},
        {"label": "<img src=x onerror=alert(1)>"},
        {"value": 0.7, "disabled": True},
        {"removed": True},
        {},
    ],
)
def test_only_the_value_of_a_widget_is_a_browsers_to_set_and_only_to_its_kind(
    house: House, updates: dict[str, object]
) -> None:
    message = {"type": "GuiUpdateMessage", "uuid": house.slider._impl.uuid, "updates": updates}
    _is_thrown_out(house, msgspec.msgpack.encode(message))


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\xdf\xff\xff\xff\xff", "text", bytes(10_000_000)])
def test_what_is_no_msgpack_ends_the_connection(house: House, data: bytes | str) -> None:
    _is_thrown_out(house, data)


def _is_thrown_out(house: House, data: bytes | str) -> None:
    """And the page goes on for everybody else."""
    before = house.slider.value, house.slider.label, house.gizmo.position.tolist()
    url = f"ws://127.0.0.1:{house.front.port}/"
    with connect(url, subprotocols=[VISER], max_size=None, proxy=None) as evil:
        evil.send(msgspec.msgpack.encode(CAMERA))
        with suppress(ConnectionClosed):
            evil.send(data)
        evil.recv_events_thread.join(10)
        assert not evil.recv_events_thread.is_alive()
        assert evil.close_code in (1008, 1009, 1006)  # 1009: too long, 1006: it was still sending
    wait_for(lambda: not house.viser.get_clients())
    assert house.heard == []
    assert (house.slider.value, house.slider.label, house.gizmo.position.tolist()) == before
    with house.visitor() as ana:
        ana.click("Press")
        wait_for(lambda: house.heard == ["button"])


def test_a_message_that_names_two_types_is_none(house: House) -> None:
    encode = msgspec.msgpack.encode
    twice = b"\x83" + b"".join(
        encode(part) for part in ("type", "CommandTriggerMessage", "uuid", "a", "type", "ShareUrlRequest")
    )
    assert msgspec.msgpack.decode(twice)["type"] == "ShareUrlRequest"  # as viser would understand it
    _is_thrown_out(house, twice)


def test_other_programs_that_found_visers_own_port_are_not_heard(house: House) -> None:
    url = f"ws://127.0.0.1:{house.viser.get_port()}"
    press = {"type": "GuiUpdateMessage", "uuid": house.button._impl.uuid, "updates": {"value": True}}
    for headers in ({}, {"studio-visit": ""}, {"studio-visit": "guessed"}):
        with connect(url, proxy=None, subprotocols=[VISER], additional_headers=headers) as evil:
            with suppress(ConnectionClosed):
                evil.send(msgspec.msgpack.encode(CAMERA))
                evil.send(msgspec.msgpack.encode(press))
            evil.recv_events_thread.join(10)
            assert evil.close_code == 1008
    assert house.heard == []


def test_a_browser_cannot_say_whose_connection_it_is(house: House) -> None:
    with house.visitor() as ana:
        ana.click("Press")
        wait_for(lambda: house.heard)
        (key,) = house.gate._visits
        url, headers = f"ws://127.0.0.1:{house.front.port}/", {"Studio-Visit": key}
        with connect(
            url, proxy=None, subprotocols=[VISER], additional_headers=headers, max_size=None
        ) as evil:
            evil.send(msgspec.msgpack.encode(CAMERA))
            wait_for(lambda: len(house.viser.get_clients()) == 2)
            evil.send(msgspec.msgpack.encode(house.drag(0.1)))
            evil.send(msgspec.msgpack.encode({"type": "CommandTriggerMessage", "uuid": "none"}))
            assert {visit.client_id for visit in house.gate._visits.values()} == set(
                house.viser.get_clients()
            )
        assert "update" not in house.heard


def test_refusals_are_logged_in_one_short_line(house: House, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        _is_thrown_out(house, msgspec.msgpack.encode({"type": "secret\n" * 100}))
    (line,) = [record.getMessage() for record in caplog.records if record.name == "studio.proxy"]
    assert "no message of our page" in line
    assert len(line.splitlines()) == 1
    assert len(line) < 300


def test_many_who_come_and_go_leave_nothing_behind(house: House) -> None:
    threads = [threading.Thread(target=lambda: Guest(house.front.port).__exit__()) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wait_for(lambda: not house.gate.seats)
    wait_for(lambda: not house.viser.get_clients())
