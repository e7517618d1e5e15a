"""What the session process and its clients say to each other: commands in, frames and notices out.

Each message is one msgspec struct, tagged by its name, so that a malformed one is refused where it arrives.
Arrays travel as little-endian float64 bytes. Numbers have bounds, which keep out NaN and infinity, too.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from controller.types import Array

Driver = Literal["nobody", "operator", "script", "policy"]
Level = Literal["ok", "limited", "refused"]  # of the last target: passed, cut back, not followed
Phase = Literal["idle", "countdown", "recording"]
Judgement = Literal["success", "failure", "unmarked"]

ArmIndex = Annotated[int, Meta(ge=0, le=7)]
Metres = Annotated[float, Meta(ge=-10.0, le=10.0)]
Radians = Annotated[float, Meta(ge=-7.0, le=7.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Component = Annotated[float, Meta(ge=-1.01, le=1.01)]  # of a unit quaternion
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Countdown = Annotated[float, Meta(ge=0.0, le=600.0)]  # [s]
Seconds = Annotated[float, Meta(ge=0.0, le=1e12)]
Name = Annotated[str, Meta(max_length=200)]


class Message(msgspec.Struct, frozen=True, tag=True, kw_only=True):
    """Base of all messages: encoded with its type's name."""


NoticeKind = Literal[
    "info", "warning", "error", "countdown", "recording", "success", "take kept", "take discarded"
]

# Commands


class Reset(Message, frozen=True, kw_only=True):
    """Draw the instance `seed` of a task; another task is loaded where `task` is given."""

    seed: Seed
    task: Name | None = None
    spread: Annotated[float, Meta(ge=0.0, le=100.0)] = 1.0


class Drive(Message, frozen=True, kw_only=True):
    """Let someone drive, or nobody: the arms then hold."""

    driver: Driver
    operator: Name = ""  # the person's name
    policy: Name = ""  # name of the run that drives; empty for the one that did last, as it did
    execution: Literal["replan", "ensemble"] = (
        "replan"  # how it plays chunks, see `policy.agent.ChunkExecutor`
    )
    replan_every: Annotated[int, Meta(ge=1, le=10_000)] | None = None


class Engage(Message, frozen=True, kw_only=True):
    """Connect an arm to the operator's targets, or park it. Engaging never moves it."""

    arm: ArmIndex
    engaged: bool


class MoveTo(Message, frozen=True, kw_only=True):
    """The operator's target for an arm, base axes. Newest wins."""

    arm: ArmIndex
    position: tuple[Metres, Metres, Metres]  # [m]
    wxyz: tuple[Component, Component, Component, Component]


class Mirror(Message, frozen=True, kw_only=True):
    """Let what moves one of two arms move the other like in a mirror, or no longer."""

    mirrored: bool


class Nudge(Message, frozen=True, kw_only=True):
    """Move an arm's target by a step: translation in base axes [m], rotation vector in tool axes [rad]."""

    arm: ArmIndex
    translation: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    rotation: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)


class SetMode(Message, frozen=True, kw_only=True):
    arm: ArmIndex
    mode: Literal["low", "medium", "high"]


class SetGripper(Message, frozen=True, kw_only=True):
    arm: ArmIndex
    opening: Share  # 0 closed .. 1 open


class SwitchMode(Message, frozen=True, kw_only=True):
    """To the other of the arm's two stiffness modes."""

    arm: ArmIndex


class HandSample(msgspec.Struct, frozen=True, kw_only=True):
    """One tracked hand, in base axes up to where the room's origin is."""

    arm: ArmIndex  # that it leads while its clutch is engaged
    position: tuple[Metres, Metres, Metres]  # [m]
    wxyz: tuple[Component, Component, Component, Component]
    opening: Share | None  # that its trigger asks of the gripper, 0 closed .. 1 open; None where it has none
    scale: Annotated[float, Meta(ge=0.05, le=5.0)] = 1.0  # of the arm's way to the hand's


class Hands(Message, frozen=True, kw_only=True):
    """What a headset tracks. Newest wins; an arm whose hand is not heard of for a moment holds."""

    hands: tuple[HandSample, ...]
    sampled: Seconds  # [s] monotonic time of this machine at which the poses were taken, as far as is known
    latency: Seconds = 0.0  # [s] of the way from the device, likewise
    jitter: Seconds = 0.0  # [s] by which that way differs from sample to sample


class Clutch(Message, frozen=True, kw_only=True):
    """Connect an arm to its tracked hand, or hold it there; None does the other of the two."""

    arm: ArmIndex
    engaged: bool | None = None
    operator: Name = ""  # the person's name


class LoseHand(Message, frozen=True, kw_only=True):
    """A hand is no more to be trusted: its arm stops pressing and waits for the clutch."""

    arm: ArmIndex
    why: Name  # a sentence for the operator


class Release(Message, frozen=True, kw_only=True):
    """Let every arm's target run to where the arm is: stop pressing, now."""


class OperatorLeft(Message, frozen=True, kw_only=True):
    """Nobody's hand is at the arms any more: they hold. A script goes on by itself."""


class StartTake(Message, frozen=True, kw_only=True):
    countdown: Countdown = 3.0  # [s] before recording
    operator: Name = ""


class EndTake(Message, frozen=True, kw_only=True):
    """Keep the take. Without a judgement the task's own success test counts."""

    judgement: Judgement | None = None


class DiscardTake(Message, frozen=True, kw_only=True):
    """Move the running take to the trash, or call off the countdown."""


class Collect(Message, frozen=True, kw_only=True):
    """Record takes of consecutive seeds until `count` are kept; 0 stops collecting."""

    count: Annotated[int, Meta(ge=0, le=100_000)]
    seed: Seed = 0
    countdown: Countdown = 3.0
    operator: Name = ""


class TakeTrashed(Message, frozen=True, kw_only=True):
    """A kept take was thrown away. Where it was being collected, its seed comes once more."""

    episode_id: Name


class TakeRestored(Message, frozen=True, kw_only=True):
    """A take came back from the trash; it counts again where it was being collected."""

    episode_id: Name


class RestartCameras(Message, frozen=True, kw_only=True):
    """Start the camera process again."""


class Shutdown(Message, frozen=True, kw_only=True):
    """Keep a running take, hold, and end the process."""


Command = (
    Reset
    | Drive
    | Engage
    | MoveTo
    | Mirror
    | Nudge
    | SetMode
    | SwitchMode
    | SetGripper
    | Hands
    | Clutch
    | LoseHand
    | Release
    | OperatorLeft
    | StartTake
    | EndTake
    | DiscardTake
    | Collect
    | TakeTrashed
    | TakeRestored
    | RestartCameras
    | Shutdown
)

# From the session


class ArmFrame(msgspec.Struct, frozen=True):
    """One arm in a frame."""

    base_from_tcp: tuple[float, ...]  # (7,) position [m], wxyz
    base_from_target: tuple[float, ...]  # (7,) where the servo's target is
    wrench: tuple[float, ...]  # (6,) [N, N·m] external, about the TCP, base axes
    stiffness: float  # [N/m] mean translational
    gripper: float  # 0 closed .. 1 open
    level: Level


class Frame(Message, frozen=True, kw_only=True):
    """The robot now; newest wins."""

    time: float  # [s] since reset
    resets: int  # how often the scene was reset: another number is another scene
    qpos: bytes  # float64 positions of the whole scene
    arms: tuple[ArmFrame, ...]


class HandStatus(msgspec.Struct, frozen=True):
    """A tracked hand, as long as it is heard of."""

    engaged: bool  # its clutch
    why: str  # the clutch let go by itself; empty where it did not
    age: float | None  # [s] since the newest pose was taken; None where none comes any more
    latency: float  # [s] on its way here
    jitter: float  # [s]


class ArmStatus(msgspec.Struct, frozen=True):
    """One arm in the status."""

    name: str
    mode: str
    modes: tuple[str, str]  # the two that the task's operator switches between
    engaged: bool
    level: Level
    why: str  # what is limited, for the operator; empty while all passes
    input_age: float | None  # [s] since the operator's last target; None before the first
    opening: float = 0.0  # that is asked of the gripper, 0 closed .. 1 open
    hand: HandStatus | None = None  # that may lead the arm


class TakeStatus(msgspec.Struct, frozen=True):
    """A take that was recorded."""

    episode_id: str
    path: str
    seconds: float
    outcome: Judgement
    discarded: bool


class Status(Message, frozen=True, kw_only=True):
    """Everything that is worth a word; newest wins."""

    task: str
    instruction: str
    seed: int
    spread: float
    resets: int
    driver: Driver
    operator: str
    policy: str = ""  # the run that drives, or drove last
    policy_late: int = 0  # ticks for which it had no word, since it took over
    phase: Phase
    countdown: float  # [s] left
    take_seconds: float
    take_id: str  # of the running take; empty without one
    last_take: TakeStatus | None
    collected: int
    to_collect: int  # 0 while not collecting
    progress: float  # 0 .. 1
    success: bool
    task_phase: str
    arms: tuple[ArmStatus, ...]
    mirrored: bool = False  # whether what moves one arm moves the other
    rate: float  # [Hz] of the control loop over the last seconds
    late_share: float  # of the ticks of the last seconds
    worst_delay: float  # [s] of the last seconds
    camera_error: str


class CameraImage(Message, frozen=True, kw_only=True):
    """A camera's newest image."""

    camera: str
    time: float  # [s] of the state it shows
    resets: int
    jpeg: bytes


class TaskState(Message, frozen=True, kw_only=True):
    """Arrays of the task's own state (ink, phases) that have changed; the others stay as told before."""

    resets: int
    arrays: dict[str, tuple[str, tuple[int, ...], bytes]]  # dtype, shape, bytes

    @staticmethod
    def of(arrays: dict[str, Array], resets: int) -> TaskState:
        return TaskState(
            resets=resets,
            arrays={
                name: (a.dtype.str, a.shape, np.ascontiguousarray(a).tobytes()) for name, a in arrays.items()
            },
        )

    def unpack(self) -> dict[str, Array]:
        return {
            name: np.frombuffer(data, dtype).reshape(shape)
            for name, (dtype, shape, data) in self.arrays.items()
        }


class Notice(Message, frozen=True, kw_only=True):
    """Something happened that a person wants to hear; never dropped."""

    kind: Literal[
        "info", "warning", "error", "take kept", "take discarded", "countdown", "recording", "success"
    ]
    text: str
    take: TakeStatus | None = None


Report = Frame | Status | CameraImage | TaskState | Notice

_encoder = msgspec.msgpack.Encoder()
_commands: msgspec.msgpack.Decoder[Command] = msgspec.msgpack.Decoder(Command)
_reports: msgspec.msgpack.Decoder[Report] = msgspec.msgpack.Decoder(Report)


def encode(message: Message) -> bytes:
    return _encoder.encode(message)


def decode_command(data: bytes) -> Command:
    """Raises msgspec.DecodeError on anything else."""
    return _commands.decode(data)


def decode_report(data: bytes) -> Report:
    """Raises msgspec.DecodeError on anything else."""
    return _reports.decode(data)


def builtins(message: Message) -> Any:
    """As JSON can hold it."""
    return msgspec.to_builtins(message)
