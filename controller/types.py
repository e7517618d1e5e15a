"""What flows between an agent and a robot: poses, wrenches, stiffness, observations, actions, steps.

Everything is a frozen dataclass of float64 arrays. Frames chain by name
(`base_from_tcp @ tcp_from_tool`), quaternions are wxyz, units are SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np

Array = np.ndarray

N_JOINTS = 6


@dataclass(frozen=True, slots=True)
class Pose:
    """Rigid transform `parent_from_child`.

    The quaternion is kept as given, so that a recorded pose reads back to the bit; it must have unit norm
    within 1e-6. `Pose.of` takes a rotation matrix instead.
    """

    position: Array  # (3,) [m]
    wxyz: Array  # (4,) unit quaternion

    def __post_init__(self) -> None:
        norm = math.hypot(*self.wxyz.tolist())
        if not abs(norm - 1.0) < 1e-6:  # also catches NaN
            raise ValueError(f"Quaternion {self.wxyz} has norm {norm}; a pose needs a unit quaternion.")

    @staticmethod
    def identity() -> Pose:
        return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    @staticmethod
    def of(rotation: Array, position: Array) -> Pose:
        """From a (3, 3) rotation matrix and a (3,) position [m]."""
        return Pose(np.array(position, dtype=float), quaternion_of(rotation))

    @staticmethod
    def from_vector(vector: Array) -> Pose:
        """From (7,): position, then wxyz."""
        return Pose(np.array(vector[:3], dtype=float), np.array(vector[3:7], dtype=float))

    @property
    def vector(self) -> Array:
        """(7,): position, then wxyz."""
        return np.concatenate((self.position, self.wxyz))

    @property
    def rotation(self) -> Array:
        """(3, 3) rotation matrix."""
        return rotation_of(self.wxyz)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(
            self.position + self.rotation @ other.position, _unit(multiply_quaternions(self.wxyz, other.wxyz))
        )

    def inverse(self) -> Pose:
        conjugate = self.wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        return Pose(-(rotation_of(conjugate) @ self.position), conjugate)

    def apply(self, points: Array) -> Array:
        """Points (..., 3) of the child frame in the parent frame."""
        moved: Array = points @ self.rotation.T + self.position
        return moved

    def is_finite(self) -> bool:
        return bool(np.isfinite(self.position).all())  # the quaternion was checked at construction


@dataclass(frozen=True, slots=True)
class Wrench:
    """External wrench: what the environment exerts on the robot, about the TCP, in base axes."""

    force: Array  # (3,) [N]
    torque: Array  # (3,) [N·m]

    @staticmethod
    def from_vector(vector: Array) -> Wrench:
        """From (6,): force, then torque."""
        return Wrench(np.array(vector[:3], dtype=float), np.array(vector[3:6], dtype=float))

    @property
    def vector(self) -> Array:
        """(6,): force, then torque."""
        return np.concatenate((self.force, self.torque))


@dataclass(frozen=True, slots=True)
class Stiffness:
    """Cartesian stiffness at the TCP, in its axes: two symmetric positive definite blocks, uncoupled."""

    translational: Array  # (3, 3) [N/m]
    rotational: Array  # (3, 3) [N·m/rad]

    def __post_init__(self) -> None:
        for name, block in (("translational", self.translational), ("rotational", self.rotational)):
            if not (np.isfinite(block).all() and np.array_equal(block, block.T)):
                raise ValueError(f"The {name} stiffness must be finite and symmetric, not {block.tolist()}.")
            if not _is_positive_definite(block):
                raise ValueError(f"The {name} stiffness must be positive definite, not {block.tolist()}.")

    @staticmethod
    def diagonal(values: Array | list[float] | tuple[float, ...]) -> Stiffness:
        """From (6,): three values [N/m], then three [N·m/rad]."""
        values = np.asarray(values, dtype=float)
        return Stiffness(np.diag(values[:3]), np.diag(values[3:6]))

    @staticmethod
    def from_vector(vector: Array) -> Stiffness:
        """From (12,): the upper triangles of the two blocks, row by row."""
        return Stiffness(_symmetric(vector[:6]), _symmetric(vector[6:12]))

    @property
    def vector(self) -> Array:
        """(12,): the upper triangles (xx, xy, xz, yy, yz, zz) of the two blocks."""
        return np.concatenate((self.translational[_UPPER], self.rotational[_UPPER]))

    @property
    def diagonals(self) -> Array:
        """(6,): the two diagonals."""
        return np.concatenate((np.diagonal(self.translational), np.diagonal(self.rotational)))


class StiffnessMode(Enum):
    """The three modes of the paper, section IV-C."""

    LOW = "low"
    MEDIUM = "medium"
    HIGH = "high"


@dataclass(frozen=True, slots=True)
class ArmState:
    """One arm as measured. `wrench` has gravity and tare removed."""

    time: float  # [s] since reset
    q: Array  # (6,) [rad]
    dq: Array  # (6,) [rad/s]
    q_command: Array  # (6,) [rad] last joint command
    base_from_tcp: Pose
    wrench: Wrench
    gripper: float  # measured opening, 0 closed .. 1 open

    @staticmethod
    def from_row(row: Array) -> ArmState:
        """From one packed row, see `ARM_ROW`."""
        part = {name: row[ARM_ROW[name]] for name in ARM_ROW}
        return ArmState(
            time=float(part["time"][0]),
            q=part["q"],
            dq=part["dq"],
            q_command=part["q_command"],
            base_from_tcp=Pose.from_vector(part["base_from_tcp"]),
            wrench=Wrench.from_vector(part["wrench"]),
            gripper=float(part["gripper"][0]),
        )


def _row_layout(*fields: tuple[str, int]) -> dict[str, slice]:
    layout, start = {}, 0
    for name, width in fields:
        layout[name] = slice(start, start + width)
        start += width
    return layout


# An ArmState packed into one float64 row: what the fast loop writes and the recorder keeps, at 500 Hz.
ARM_ROW = _row_layout(
    ("time", 1), ("q", 6), ("dq", 6), ("q_command", 6), ("base_from_tcp", 7), ("wrench", 6), ("gripper", 1)
)
ARM_ROW_WIDTH = 33


@dataclass(frozen=True, slots=True)
class CartesianTarget:
    """Follow a pose compliantly: FDCC pulls the TCP towards `base_from_target` with `stiffness`."""

    base_from_target: Pose
    stiffness: Stiffness


@dataclass(frozen=True, slots=True)
class JointTarget:
    """Follow joint positions stiffly, without compliance: what plain ACT commands."""

    q: Array  # (6,) [rad]


@dataclass(frozen=True, slots=True)
class Hold:
    """Freeze target and stiffness where they are."""


@dataclass(frozen=True, slots=True)
class Release:
    """Let the target run to the measured pose, so that the arm stops pressing."""


Target = CartesianTarget | JointTarget | Hold | Release


@dataclass(frozen=True, slots=True)
class ArmAction:
    target: Target
    gripper: float  # commanded opening, 0 closed .. 1 open


@dataclass(frozen=True, slots=True)
class Action:
    arms: tuple[ArmAction, ...]


@dataclass(frozen=True, slots=True)
class Image:
    """A camera image and the time of the state that it shows."""

    time: float  # [s] since reset
    pixels: Array | None  # (h, w, 3) uint8, RGB; None where only the JPEG has travelled
    jpeg: bytes | None = None  # the same picture, where the sender has encoded it already

    def __post_init__(self) -> None:
        if self.pixels is None and self.jpeg is None:
            raise ValueError("An image needs pixels or a JPEG.")


@dataclass(frozen=True, slots=True)
class Observation:
    time: float  # [s] since reset
    arms: tuple[ArmState, ...]
    images: Mapping[str, Image]  # newest image of each camera; empty without cameras


LimitKind = Literal[
    "workspace",
    "target_speed",
    "target_step",
    "contact_force",
    "contact_torque",
    "joint_position",
    "joint_speed",
    "not_finite",
    "stiffness",
]


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit that changed a command, and why."""

    arm: int
    kind: LimitKind
    why: str  # a sentence for the operator
    refused: bool = False  # True: the arm holds instead; False: the command was cut back


@dataclass(frozen=True, slots=True)
class Applied:
    """What a robot made of an action in one control period."""

    action: Action  # after limits; where an arm held, the target and stiffness that it held
    limits: tuple[Limit, ...]
    trace: Array  # (arms, fast steps, ARM_ROW_WIDTH): the states before each fast step, the first as observed


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything that decides a robot's future, by name; restoring it continues to the bit."""

    arrays: Mapping[str, Array]


@dataclass(frozen=True, slots=True)
class InputTiming:
    """How the hand that leads an arm reached us, when a control period began."""

    age: float  # [s] since its newest pose was taken
    latency: float  # [s] that this took from the device to us, estimated
    jitter: float  # [s] by which the way differs from one pose to the next


@dataclass(frozen=True, slots=True)
class Step:
    """One control period, told to the subscribers."""

    observation: Observation
    requested: Action
    applied: Applied
    digest: bytes  # hash of the robot's state after the period; empty where a robot has none
    task_state: Mapping[str, Array] | None  # board, object poses, at 20 Hz: the state at observation.time
    snapshot: Snapshot | None  # once a second: the state at observation.time
    late: float = 0.0  # [s] after its deadline that the period began; 0 where there is no clock
    inputs: tuple[InputTiming | None, ...] = ()  # per arm that a tracked hand leads; () where none does


def multiply_quaternions(a: Array, b: Array) -> Array:
    """Hamilton product of two wxyz quaternions."""
    aw, ax, ay, az = a.tolist()
    bw, bx, by, bz = b.tolist()
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def rotation_of(wxyz: Array) -> Array:
    """(3, 3) rotation matrix of a unit quaternion."""
    w, x, y, z = wxyz.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: Array) -> Array:
    """wxyz of a (3, 3) rotation matrix, w >= 0 where the largest component allows it (Shepperd 1978)."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation.tolist()
    trace = r00 + r11 + r22
    if trace >= max(r00, r11, r22):
        q = (1 + trace, r21 - r12, r02 - r20, r10 - r01)
    elif r00 >= r11 and r00 >= r22:
        q = (r21 - r12, 1 + r00 - r11 - r22, r10 + r01, r02 + r20)
    elif r11 >= r22:
        q = (r02 - r20, r10 + r01, 1 - r00 + r11 - r22, r21 + r12)
    else:
        q = (r10 - r01, r02 + r20, r21 + r12, 1 - r00 - r11 + r22)
    return _unit(np.array(q))


def rotation_vector(wxyz: Array) -> Array:
    """(3,) axis times angle [rad] of a unit quaternion, angle in [0, pi]."""
    w, x, y, z = wxyz.tolist()
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return np.array([factor * x, factor * y, factor * z])


def quaternion_from_rotation_vector(vector: Array) -> Array:
    """Inverse of `rotation_vector`, for any angle."""
    x, y, z = vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return _unit(np.array([1.0, x / 2, y / 2, z / 2]))
    factor = math.sin(angle / 2) / angle
    return np.array([math.cos(angle / 2), factor * x, factor * y, factor * z])


_UPPER = np.triu_indices(3)


def _symmetric(upper: Array) -> Array:
    xx, xy, xz, yy, yz, zz = (float(v) for v in upper)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _is_positive_definite(block: Array) -> bool:
    """Sylvester's criterion: all leading minors positive."""
    (a, b, c), (_, d, e), (_, _, f) = block.tolist()
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return bool(a > 0 and a * d - b * b > 0 and determinant > 0)


def _unit(quaternion: Array) -> Array:
    return quaternion / math.sqrt(float(quaternion @ quaternion))
