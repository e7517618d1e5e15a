"""Two tracked controllers of any make as an operator: their poses lead arms, their buttons are commands.

A device (`studio.inputs.xr`, `studio.inputs.steamvr`) reports where controllers and head are in a room with x
ahead, y left, z up, and how far each button is pressed. What the buttons do is a `Mapping`; the default is
the paper's, section III-A: menu sets the origin and engages or disengages, trigger is the gripper, grip
switches between the task's two stiffness modes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Mapping as Dict
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

from controller.types import Pose
from studio.inputs.clutch import checked_scale, facing, seen_from
from studio.inputs.haptics import Haptics
from studio.messages import (
    Clutch,
    Command,
    DiscardTake,
    EndTake,
    Hands,
    HandSample,
    LoseHand,
    StartTake,
    Status,
    SwitchMode,
)

Side = Literal["left", "right"]
SIDES: tuple[Side, ...] = get_args(Side)
Button = Literal["menu", "trigger", "squeeze", "primary", "stick", "pad"]
BUTTONS: tuple[Button, ...] = get_args(Button)

PRESSED, LET_GO = 0.8, 0.3  # of a button's way: in between it is what it was
LONG = 0.8  # [s] for which the record button means discard


@dataclass(frozen=True, slots=True)
class Mapping:
    """Which button does what; None where none does."""

    clutch: Button = "menu"
    gripper: Button | None = "trigger"  # pulled is closed
    stiffness: Button | None = "squeeze"  # the other of the task's two modes
    record: Button | None = "primary"  # short: start, or stop and keep; long: discard
    discard: Button | None = None
    face: Button | None = "stick"  # ahead is where I face now
    hold_to_clutch: bool = False  # engaged as long as the button is held, instead of press on, press off

    def __post_init__(self) -> None:
        given = [getattr(self, f.name) for f in fields(self) if f.name != "hold_to_clutch"]
        used = [button for button in given if button is not None]
        if twice := sorted({button for button in used if used.count(button) > 1}):
            raise ValueError(f"The button {twice[0]!r} can do one thing only; there are {list(BUTTONS)}.")


PAPER = Mapping()
GRIP_AS_CLUTCH = Mapping(clutch="squeeze", stiffness="menu", hold_to_clutch=True)


@dataclass(frozen=True, slots=True)
class Settings:
    """How one operator wants it."""

    mapping: Mapping = PAPER
    haptics: Haptics = field(default_factory=Haptics)
    scale: float = 1.0  # of an arm's way to the hand's
    # [rad] about z by which I stand turned from the robot: 0 behind it, pi facing it. None is where the page
    # looks from: behind two arms, to the right of one, whose shoulder would hide the work.
    view: float | None = None
    one_arm: Side = "right"  # the hand that leads where there is one arm
    countdown: float = 3.0  # [s] before recording
    operator: str = ""  # the person's name

    def __post_init__(self) -> None:
        checked_scale(self.scale)


@dataclass(frozen=True, slots=True)
class Controller:
    """One controller, as a device reports it."""

    pose: Pose  # room_from_controller
    buttons: Dict[Button, float]  # 0 free .. 1 pressed


@dataclass(frozen=True, slots=True)
class Moment:
    """When poses were taken and how they came."""

    sampled: float  # [s] monotonic
    latency: float = 0.0  # [s]
    jitter: float = 0.0  # [s]


class Controllers:
    """Turns what a device reports into commands; one for each device. `send` takes them in order."""

    def __init__(self, send: Callable[[Command], None], settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self._send = send
        self._yaw: float | None = None  # [rad] about z, of the room: where the operator faces
        self._seen: dict[Side, dict[Button, _Press]] = {}  # the controllers that are tracked
        self._arms: tuple[str, ...] = ()
        self._record_since: float | None = None  # [s] when the record button went down

    @property
    def yaw(self) -> float | None:
        """[rad] about z from the room's x to the robot's; None until the head was seen."""
        return None if self._yaw is None else self._yaw - self.view

    @property
    def view(self) -> float:
        """[rad] about z by which the operator stands turned from the robot."""
        if self.settings.view is not None:
            return self.settings.view
        return math.pi / 2 if len(self._arms) == 1 else 0.0

    def update(
        self, hands: Dict[Side, Controller], head: Pose | None, moment: Moment, status: Status | None
    ) -> None:
        """What a device has just seen. A hand that is missing is lost."""
        if status is None:
            return
        self._arms = tuple(arm.name for arm in status.arms)
        for side in [side for side in self._seen if side not in hands]:
            self.lose(f"The {side} controller is not tracked.", side)
        if self._yaw is None and head is not None:
            self._yaw = facing(head)
        self._tell_poses(hands, moment)
        for side, controller in hands.items():
            self._read_buttons(side, controller, head, moment.sampled, status)

    def lose(self, why: str, *sides: Side) -> None:
        """These hands, or all, are not to be trusted; their arms stop pressing and wait for the clutch."""
        for side in sides or SIDES:
            arm = self._arm(side)
            if self._seen.pop(side, None) is not None and arm is not None:
                self._send(LoseHand(arm=arm, why=why))

    def forget_facing(self) -> None:
        """The room's axes are others now: ahead is where the head faces next."""
        self._yaw = None

    def _arm(self, side: Side) -> int | None:
        """The arm that a hand may lead."""
        if len(self._arms) == 1:
            return 0 if side == self.settings.one_arm else None
        return self._arms.index(side) if side in self._arms else None

    def _tell_poses(self, hands: Dict[Side, Controller], moment: Moment) -> None:
        samples = []
        for side, controller in hands.items():
            if (arm := self._arm(side)) is None:
                continue
            pose = seen_from(controller.pose, (self._yaw or 0.0) - self.view)
            button = self.settings.mapping.gripper
            samples.append(
                HandSample(
                    arm=arm,
                    position=tuple(pose.position.tolist()),
                    wxyz=tuple(pose.wxyz.tolist()),
                    opening=None if button is None else 1.0 - controller.buttons.get(button, 0.0),
                    scale=self.settings.scale,
                )
            )
        if samples:
            self._send(
                Hands(
                    hands=tuple(samples),
                    sampled=moment.sampled,
                    latency=moment.latency,
                    jitter=moment.jitter,
                )
            )

    def _read_buttons(
        self, side: Side, controller: Controller, head: Pose | None, now: float, status: Status
    ) -> None:
        mapping, presses = self.settings.mapping, self._seen.setdefault(side, {})
        edges = {
            button: presses.setdefault(button, _Press()).edge(value)
            for button, value in controller.buttons.items()
        }
        if (arm := self._arm(side)) is not None:
            self._work_clutch(arm, edges.get(mapping.clutch))
            if mapping.stiffness and edges.get(mapping.stiffness):
                self._send(SwitchMode(arm=arm))
        if mapping.face and edges.get(mapping.face) and head is not None:
            for other in range(len(self._arms)):  # or the turn would be a jump
                self._send(Clutch(arm=other, engaged=False))
            self._yaw = facing(head)
        if mapping.discard and edges.get(mapping.discard) and status.phase != "idle":
            self._send(DiscardTake())
        if mapping.record:
            self._work_record(edges.get(mapping.record), now, status)

    def _work_clutch(self, arm: int, edge: bool | None) -> None:
        if self.settings.mapping.hold_to_clutch:
            if edge is not None:
                self._send(Clutch(arm=arm, engaged=edge, operator=self.settings.operator))
        elif edge:
            self._send(Clutch(arm=arm, operator=self.settings.operator))

    def _work_record(self, edge: bool | None, now: float, status: Status) -> None:
        if edge:
            self._record_since = now
        elif self._record_since is None:
            return
        elif now - self._record_since >= LONG:
            self._record_since = None
            if status.phase != "idle":
                self._send(DiscardTake())
        elif edge is False:
            self._record_since = None
            settings = self.settings
            if status.phase == "idle":
                self._send(StartTake(countdown=settings.countdown, operator=settings.operator))
            else:
                self._send(EndTake())


class _Press:
    """A button with hysteresis. One that is down when it is first seen was not pressed just now."""

    def __init__(self) -> None:
        self._is_down: bool | None = None

    def edge(self, value: float) -> bool | None:
        """True as it goes down, False as it comes up, None in between."""
        was_down = self._is_down
        if value >= PRESSED or value <= LET_GO or was_down is None:
            self._is_down = value >= PRESSED
        return self._is_down if was_down is not None and self._is_down != was_down else None
