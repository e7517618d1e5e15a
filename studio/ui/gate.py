"""Hears what every browser says to viser, before viser does: only what our page says, and only from who may.

What all share (buttons, keys, sliders, gizmos) obeys whoever holds the lease; what is a client's own obeys
that client. Whoever is refused is told why and shown again how things are. Messages are passed on as they
were understood, never as they came: viser would set any property of a widget to anything.
"""

from __future__ import annotations

import logging
import secrets
import time
from typing import Annotated, Any, assert_never

import msgspec
import viser
from msgspec import Meta
from starlette.websockets import WebSocket

from studio.door import person_of
from studio.lease import Lease, NotDriving, Seat
from studio.proxy import Unheard
from studio.ui import viser_private
from studio.ui.remote import Remote

SILENCE = 2.0  # [s] between two refusals that one client is told

Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # neither NaN nor infinity
Whole = Annotated[int, Meta(ge=-(2**53), le=2**53)]
Id = Annotated[str, Meta(max_length=300)]
Text = Annotated[str, Meta(max_length=20_000)]
Vector = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]

log = logging.getLogger(__name__)


class _Said(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", forbid_unknown_fields=True):
    """One message of viser's page; `studio/ui/viser_private.py` holds viser to 1.1."""


class Camera(_Said, frozen=True, kw_only=True, tag="ViewerCameraMessage"):
    """Where somebody looks from."""

    wxyz: Quaternion
    position: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Whole
    image_width: Whole
    look_at: Vector
    up_direction: Vector


class NewValue(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of a widget, which has many other properties that are not a browser's to set."""

    value: bool | Whole | Number | Text | list[bool | Whole | Number | Text] | None


class Input(_Said, frozen=True, kw_only=True, tag="GuiUpdateMessage"):
    """A widget was used."""

    uuid: Id
    updates: NewValue


class Held(_Said, frozen=True, kw_only=True, tag="GuiButtonHoldMessage"):
    """A button is held down."""

    uuid: Id
    frequency: Number


class Hotkey(_Said, frozen=True, kw_only=True, tag="CommandTriggerMessage"):
    uuid: Id


class Grab(_Said, frozen=True, kw_only=True, tag="TransformControlsDragStartMessage"):
    """A gizmo's."""

    name: Id
    owner: Id = ""


class Drag(_Said, frozen=True, kw_only=True, tag="TransformControlsUpdateMessage"):
    """A gizmo's."""

    name: Id
    wxyz: Quaternion
    position: Vector
    owner: Id = ""


class Drop(_Said, frozen=True, kw_only=True, tag="TransformControlsDragEndMessage"):
    """A gizmo's."""

    name: Id
    owner: Id = ""


Said = Camera | Input | Held | Hotkey | Grab | Drag | Drop
_decoder: msgspec.msgpack.Decoder[Said] = msgspec.msgpack.Decoder(Said)
_encoder = msgspec.msgpack.Encoder()


class Gate:
    """Of one page: its link to the session, its lease, and who is connected."""

    def __init__(self, name: str = "") -> None:
        """`name` is that of who gives none, where only one person can be meant."""
        self.remote = Remote()
        self.lease = Lease(self.remote.post, self.remote.notices.post)
        self._name = name
        self._visits: dict[str, PageVisit] = {}  # by key
        self._server: viser.ViserServer | None = None
        self._free: set[str] = set()

    def attach(self, server: viser.ViserServer) -> None:
        """Guard the widgets of this one."""
        self._server = server

    def free(self, widget: viser.GuiInputHandle[object] | viser.GuiButtonHandle) -> None:
        """Let everybody use this one."""
        self._free.add(viser_private.uuid(widget))

    def receive(self, browser: WebSocket) -> PageVisit:
        """Somebody opens the page."""
        seat = self.lease.sit(person_of(browser), name=self._name)
        visit = PageVisit(self, seat)
        self._visits[visit.key] = visit
        return visit

    def arrive(self, key: str, client_id: int) -> bool:
        """viser has a connection; whether it is one of ours."""
        visit = self._visits.get(key)
        if visit is not None:
            visit.client_id = client_id
        return visit is not None

    def seat(self, client_id: int) -> Seat | None:
        """Of a client of viser; None where it has gone."""
        visits = list(self._visits.values())
        return next((visit.seat for visit in visits if visit.client_id == client_id), None)

    @property
    def seats(self) -> list[Seat]:
        """Of everybody who looks at the page."""
        return [visit.seat for visit in list(self._visits.values())]

    def admit(self, visit: PageVisit, said: Said) -> bool:
        """Whether viser may hear it."""
        try:
            self._check(visit.seat, said)
        except NotDriving as error:
            self._refuse(visit, said, str(error))
            return False
        return True

    def leave(self, visit: PageVisit) -> None:
        visit.seat.leave()
        self._visits.pop(visit.key, None)

    def _check(self, seat: Seat, said: Said) -> None:
        """Raises NotDriving, or Unheard."""
        match said:
            case Camera() | Drop():
                pass
            case Input():
                widget = self._shared(said.uuid)
                if widget is not None and not _fits(said.updates.value, widget.value):
                    raise Unheard(f"{said.updates.value!r} for a widget that shows {widget.value!r}")
                if widget is not None and said.uuid not in self._free:
                    seat.admit()
            case Held():
                if self._shared(said.uuid) is not None:
                    seat.admit(takes=False)
            case Hotkey():
                seat.admit()
            case Grab() | Drag():
                seat.admit(takes=False)
            case _:
                assert_never(said)

    def _shared(self, uuid: str) -> Any:
        return viser_private.shared_widget(self._server, uuid) if self._server else None

    def _refuse(self, visit: PageVisit, said: Said, why: str) -> None:
        """Show this client again how things are, and tell it why nothing has happened."""
        client = self._server and self._server.get_clients().get(visit.client_id)
        if not client or not self._server:
            return
        if isinstance(said, Input):
            viser_private.show_again(self._server, client, widget=said.uuid)
        elif isinstance(said, Drag):
            viser_private.show_again(self._server, client, gizmo=said.name)
        now = time.monotonic()
        if now > visit.told + SILENCE:
            visit.told = now
            client.add_notification("You are watching", why, color="orange", auto_close_seconds=6.0)


class PageVisit:
    """One browser's connection to the page; see `studio.proxy.Visit`."""

    def __init__(self, gate: Gate, seat: Seat) -> None:
        self.key = secrets.token_urlsafe()
        self.seat = seat
        self.client_id = -1  # until viser has given it a number
        self.told = -SILENCE  # [s] monotonic time of the last refusal that was told
        self._gate = gate

    def hear(self, message: bytes | str) -> bytes | None:
        if isinstance(message, str):
            raise Unheard("a text instead of msgpack")
        try:
            said = _decoder.decode(message)
        except msgspec.DecodeError as error:
            raise Unheard(f"{len(message)} bytes that are no message of our page: {error}") from error
        return _encoder.encode(said) if self._gate.admit(self, said) else None

    def end(self) -> None:
        self._gate.leave(self)


def _fits(value: object, shown: object) -> bool:
    """Whether it is of the kind that a widget shows; viser would turn the text "nan" into a number."""
    return not isinstance(shown, bool | int | float) or isinstance(value, bool | int | float)
