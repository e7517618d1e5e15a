"""WebXR at our border: what a headset's browser sends, checked, in our axes and on our clock.

WebXR has x right, y up, z back, quaternions xyzw (https://www.w3.org/TR/webxr/#geometry); ours is x ahead, y
left, z up, wxyz. Buttons come in the order of the `xr-standard` mapping
(https://www.w3.org/TR/webxr-gamepads-module-1/#xr-standard-heading).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from controller.types import Array, Pose, multiply_quaternions, quaternion_of
from studio.inputs.controllers import Button, Controller, Controllers, Mapping, Moment, Settings, Side
from studio.inputs.haptics import Haptics
from studio.messages import Name, Share, Status

MESSAGE_LIMIT = 16 * 1024  # [bytes]; a frame with both hands takes 700

Coordinate = Annotated[float, Meta(ge=-7.0, le=7.0)]
Part = Annotated[float, Meta(ge=-1.01, le=1.01)]
XrPose = tuple[Coordinate, Coordinate, Coordinate, Part, Part, Part, Part]  # position [m], xyzw
Milliseconds = Annotated[float, Meta(ge=0.0, le=1e12)]

# xr-standard: trigger, squeeze, touchpad, thumbstick, then A or X, B or Y. Menu and Meta buttons never reach
# a page, so B and Y stand in for the paper's menu button.
STANDARD: tuple[Button, ...] = ("trigger", "squeeze", "pad", "stick", "primary", "menu")
# A Vive wand has no more than these for a page (WebXR input profile `htc-vive`); its pad stands in.
WAND: tuple[Button, ...] = ("trigger", "squeeze", "menu")

AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # ours to WebXR's
XR_FROM_OURS = quaternion_of(AXES)

Reason = Literal["ended", "hidden", "blurred", "reset", "left"]
WHY: dict[Reason, str] = {
    "ended": "The session in the headset has ended.",
    "hidden": "The headset was taken off, or shows something else.",
    "blurred": "The headset's own menu is open.",
    "reset": "The room was recentred.",
    "left": "The headset's page was closed, or the network is down.",
}


class XrHand(msgspec.Struct, forbid_unknown_fields=True):
    """One input source with its grip pose."""

    pose: XrPose
    buttons: Annotated[list[Share], Meta(max_length=16)]
    is_hand: bool = False  # bare fingers, no controller
    is_emulated: bool = False  # the position is a guess (XRPose.emulatedPosition)


class XrFrame(msgspec.Struct, tag="frame", forbid_unknown_fields=True):
    """What one XRFrame shows, by the page's clock."""

    t: Milliseconds  # when the poses were taken
    rtt: Milliseconds | None = None  # shortest round trip of late, as the page measures it
    head: XrPose | None = None
    left: XrHand | None = None
    right: XrHand | None = None


class XrLost(msgspec.Struct, tag="lost", forbid_unknown_fields=True):
    """No frame is to be trusted until the next one comes."""

    why: Reason


class XrPing(msgspec.Struct, tag="ping", forbid_unknown_fields=True):
    """Sent back as it is."""

    t: Milliseconds


class XrWatch(msgspec.Struct, tag="watch", forbid_unknown_fields=True):
    """What the page wants to be shown."""

    twin: bool = False
    images: bool = False


class XrSettings(msgspec.Struct, tag="settings", forbid_unknown_fields=True):
    """`studio.inputs.controllers.Settings`, flat."""

    mapping: Annotated[dict[str, Annotated[str, Meta(max_length=20)] | bool | None], Meta(max_length=10)]
    dead_band: float
    full: float
    strength: float
    scale: float
    view: Annotated[float, Meta(ge=-360.0, le=360.0)] | None  # [deg]
    one_arm: Side
    countdown: Annotated[float, Meta(ge=0.0, le=60.0)]
    operator: Name = ""

    def checked(self) -> Settings:
        """Raises ValueError, with a sentence, where something does not fit together."""
        return Settings(
            mapping=msgspec.convert(self.mapping, Mapping),
            haptics=Haptics(self.dead_band, self.full, self.strength),
            scale=self.scale,
            view=None if self.view is None else math.radians(self.view),
            one_arm=self.one_arm,
            countdown=self.countdown,
            operator=self.operator,
        )


XrMessage = XrFrame | XrLost | XrPing | XrWatch | XrSettings
_decoder: msgspec.json.Decoder[XrMessage] = msgspec.json.Decoder(XrMessage)


def decode(text: str | bytes) -> XrMessage:
    """Raises ValueError on anything else; JSON knows neither NaN nor infinity."""
    if len(text) > MESSAGE_LIMIT:
        raise ValueError(f"A message of {len(text)} bytes; at most {MESSAGE_LIMIT} are taken.")
    return _decoder.decode(text)


def pose_of(xr: Sequence[float]) -> Pose:
    """In our axes. Raises ValueError where the quaternion is none."""
    x, y, z, qx, qy, qz, qw = xr
    norm = math.hypot(qx, qy, qz, qw)
    if not 0.9 < norm < 1.1:  # browsers send single precision
        raise ValueError(f"A quaternion with norm {norm:.3g}; a pose needs a unit quaternion.")
    return Pose(np.array([-z, -x, y]), np.array([qw / norm, -qz / norm, -qx / norm, qy / norm]))


def pose_of_matrix(xr: Array) -> Pose:
    """In our axes, from (3, 4) in WebXR's, which are OpenVR's, too. Single precision is enough."""
    first, _, third = np.linalg.svd(xr[:, :3])
    return Pose.of(AXES.T @ (first @ third) @ AXES, AXES.T @ xr[:, 3])


def stage_of(room_from_world: Pose) -> list[float]:
    """From points in our axes of the world to WebXR's of the room: position, xyzw.

    A page puts everything into one group with this transform and needs to know nothing else of our axes.
    """
    x, y, z = room_from_world.position.tolist()
    w, i, j, k = multiply_quaternions(XR_FROM_OURS, room_from_world.wxyz).tolist()
    return [-y, z, -x, i, j, k, w]


class Transit:
    """Tells how long messages travel between two clocks of which neither knows the other.

    The quickest of the last seconds took half of the shortest round trip, the others as much longer as they
    came later. Jitter is that of RFC 3550, section 6.4.1.
    """

    WINDOW = 5.0  # [s] after which an old quickest is forgotten: two clocks drift apart

    def __init__(self) -> None:
        self.jitter = 0.0  # [s]
        self._before: float | None = None
        self._quickest, self._last_quickest = math.inf, math.inf
        self._until = 0.0

    def heard(self, sent: float, now: float, round_trip: float) -> float:
        """[s] that the message took, sent at `sent` by the other's clock; `now` is ours."""
        difference = now - sent
        if self._before is not None:
            self.jitter += (abs(difference - self._before) - self.jitter) / 16.0
        self._before = difference
        if now >= self._until:
            self._last_quickest, self._quickest = self._quickest, math.inf
            self._until = now + self.WINDOW
        self._quickest = min(self._quickest, difference)
        return difference - min(self._quickest, self._last_quickest) + round_trip / 2.0


class WebXr:
    """One headset's controllers, from the messages of its page."""

    def __init__(self, controllers: Controllers) -> None:
        self.controllers = controllers
        self.latency = 0.0  # [s] of the newest frame, estimated
        self._transit = Transit()
        self._was_tracked: set[Side] = set()  # hands whose position was once more than a guess

    @property
    def jitter(self) -> float:
        """[s]"""
        return self._transit.jitter

    def hear(self, frame: XrFrame, now: float, status: Status | None) -> None:
        """`now`: our monotonic clock [s]."""
        self.latency = self._transit.heard(frame.t / 1e3, now, (frame.rtt or 0.0) / 1e3)
        head = pose_of(frame.head) if frame.head else None
        hands: dict[Side, Controller] = {}
        for side, hand in (("left", frame.left), ("right", frame.right)):
            if hand is not None and self._is_trusted(side, hand):  # type: ignore[arg-type]
                names = WAND if len(hand.buttons) <= len(WAND) else STANDARD
                buttons = dict(zip(names, hand.buttons, strict=False))
                hands[side] = Controller(pose_of(hand.pose), buttons)  # type: ignore[index]
        moment = Moment(now - self.latency, self.latency, self.jitter)
        self.controllers.update(hands, head, moment, status)

    def lose(self, why: Reason) -> None:
        self.controllers.lose(WHY[why])
        if why == "reset":
            self.controllers.forget_facing()

    def _is_trusted(self, side: Side, hand: XrHand) -> bool:
        if hand.is_hand:
            self.controllers.lose("Bare hands are tracked; take the controllers.", side)
            return False
        if not hand.is_emulated:
            self._was_tracked.add(side)
        elif side in self._was_tracked:  # else the device never knows better, such as an emulated one
            self.controllers.lose(f"The headset does not see the {side} controller.", side)
            return False
        return True
