"""Kinematics of one serial arm: forward, Jacobian, inverse, limits.

An arm is a list of `Segment`s, so that any chain can be built; `ur5e` is ours. The last segment is the end
effector. Dynamics are left out on purpose: FDCC puts its own virtual masses on this model (`fdcc.py`), and
the real ones belong to the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from controller.types import Array, Pose, multiply_quaternions, rotation_vector

BASE = "base"
FLANGE = "attachment_site"
TCP = "tcp"


@dataclass(frozen=True, slots=True)
class Segment:
    """A link and how it hangs on the link before it: `parent_from_link @ turn(axis, q)`.

    Without an axis the link is fixed and has no joint; limits are then unused.
    """

    link: str
    parent_from_link: Pose  # at q = 0
    axis: Array | None = None  # (3,) in link axes, of a revolute joint
    lower: float = -math.inf  # [rad]
    upper: float = math.inf  # [rad]
    velocity_limit: float = math.inf  # [rad/s]

    def __post_init__(self) -> None:
        if self.axis is not None and not np.linalg.norm(self.axis) > 0.0:
            raise ValueError(f"The joint of {self.link!r} needs an axis of some length, not {self.axis}.")
        if not self.lower <= self.upper:
            raise ValueError(f"The joint of {self.link!r} has limits {self.lower} > {self.upper} rad.")
        if not self.velocity_limit > 0.0:
            raise ValueError(
                f"The joint of {self.link!r} may turn at {self.velocity_limit} rad/s; must be > 0."
            )


class OutOfReach(ValueError):
    """Inverse kinematics ended away from its target."""


class ArmModel:
    """Kinematics of a serial arm in the axes of its base; n is the number of its joints.

    Not for two threads at once: results pass through one Pinocchio data structure.
    """

    def __init__(self, base: str, segments: Sequence[Segment]) -> None:
        if not any(segment.axis is not None for segment in segments):
            raise ValueError("An arm needs at least one joint; none of its segments has an axis.")
        joints = [segment for segment in segments if segment.axis is not None]
        self.base = base
        self.segments = tuple(segments)
        self.end_effector = segments[-1].link
        self.n_joints = len(joints)
        self.lower = np.array([joint.lower for joint in joints])  # (n,) [rad]
        self.upper = np.array([joint.upper for joint in joints])  # (n,) [rad]
        self.velocity_limits = np.array([joint.velocity_limit for joint in joints])  # (n,) [rad/s]
        self.kinematics = _pinocchio_model(base, segments)  # massless
        self._frames = {link: i for i, link in enumerate(self.links, start=1)}  # frame 0 is the universe
        self._end = self._frames[self.end_effector]
        self._data = self.kinematics.createData()

    @property
    def links(self) -> tuple[str, ...]:
        """All link names from the base to the end effector."""
        return (self.base, *(segment.link for segment in self.segments))

    def frame_id(self, link: str) -> int:
        """Index of a link among the frames of `kinematics`."""
        if link not in self._frames:
            raise KeyError(f"No link {link!r}; this arm has {list(self.links)}.")
        return self._frames[link]

    def forward_kinematics(self, q: Array, link: str | None = None) -> Pose:
        """`base_from_link` at joints q (n,) [rad]; the end effector's without a name."""
        frame = self._end if link is None else self.frame_id(link)
        pin.forwardKinematics(self.kinematics, self._data, q)
        base_from_link = pin.updateFramePlacement(self.kinematics, self._data, frame)
        return Pose.of(base_from_link.rotation, base_from_link.translation)

    def jacobian(self, q: Array) -> Array:
        """(6, n): joint rates to linear, then angular velocity at the end effector's origin, base axes."""
        jacobian: Array = pin.computeFrameJacobian(
            self.kinematics, self._data, q, self._end, pin.LOCAL_WORLD_ALIGNED
        )
        return jacobian.reshape(6, self.n_joints)  # Pinocchio gives (6,) for a single joint

    def inverse_kinematics(
        self,
        base_from_end: Pose,
        q_start: Array,
        *,
        tolerance: float = 1e-9,  # [m] and [rad]
        max_iterations: int = 200,
    ) -> Array:
        """(n,) joints within their limits that reach a pose, on the branch that q_start (n,) leads to.

        Damped least squares with the damping of Levenberg and Marquardt: less after a step that helped, more
        after one that did not. The same arguments give the same joints. Raises `OutOfReach`.
        """
        q: Array = np.clip(q_start, self.lower, self.upper)
        error = self._pose_error(base_from_end, q)
        damping = 1e-3
        for _ in range(max_iterations):
            if np.abs(error).max() <= tolerance:
                return q
            jacobian = self.jacobian(q)
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), error)
            q_next = np.clip(q + step, self.lower, self.upper)
            error_next = self._pose_error(base_from_end, q_next)
            if error_next @ error_next < error @ error:
                q, error, damping = q_next, error_next, max(damping / 10.0, 1e-12)
            else:
                damping = min(damping * 10.0, 1e3)
        raise OutOfReach(
            f"No joints found for {base_from_end}: {np.linalg.norm(error[:3]) * 1e3:.3g} mm and "
            f"{math.degrees(np.linalg.norm(error[3:])):.3g} deg are left after {max_iterations} iterations."
        )

    def _pose_error(self, base_from_end: Pose, q: Array) -> Array:
        """(6,): translation [m] and rotation vector [rad] that lead to the pose, base axes."""
        now = self.forward_kinematics(q)
        turn = multiply_quaternions(base_from_end.wxyz, now.inverse().wxyz)
        return np.concatenate((base_from_end.position - now.position, rotation_vector(turn)))


def _pinocchio_model(base: str, segments: Sequence[Segment]) -> pin.Model:
    """Joints at the moving segments, one frame for every link."""
    model = pin.Model()
    model.addFrame(pin.Frame(base, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    joint, joint_from_parent = 0, pin.SE3.Identity()
    for segment in segments:
        if model.existFrame(segment.link):
            raise ValueError(f"Two links are named {segment.link!r}; names must differ.")
        pose = segment.parent_from_link
        joint_from_link = joint_from_parent * pin.SE3(pose.rotation, pose.position)
        if segment.axis is not None:
            joint = model.addJoint(joint, _revolute(segment.axis), joint_from_link, f"{segment.link}_joint")
            joint_from_link = pin.SE3.Identity()
        model.addFrame(pin.Frame(segment.link, joint, joint_from_link, pin.FrameType.OP_FRAME))
        joint_from_parent = joint_from_link
    return model


def _revolute(axis: Array) -> pin.JointModel:
    """Pinocchio has quicker joints for the three positive axes."""
    aligned = {
        (1.0, 0.0, 0.0): pin.JointModelRX,
        (0.0, 1.0, 0.0): pin.JointModelRY,
        (0.0, 0.0, 1.0): pin.JointModelRZ,
    }
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    kind = aligned.get(tuple(unit.tolist()))
    return kind() if kind else pin.JointModelRevoluteUnaligned(unit)


def ur5e(flange_from_tcp: Pose | None = None) -> ArmModel:
    """Universal Robots UR5e with a tool; the end effector is `TCP`, at the flange without an argument.

    Frames are the bodies of the MuJoCo Menagerie model (universal_robots_ur5e/ur5e.xml) from its body "base"
    to its site "attachment_site". They differ by up to 1 mm from the maker's, and from a URDF in where links
    have their origins, hence where FDCC's virtual masses sit.
    """
    return ArmModel(BASE, (*_UR5E, Segment(TCP, flange_from_tcp or Pose.identity())))


_QUARTER = math.sqrt(0.5)  # sine and cosine of half a quarter turn
_STRAIGHT = (1.0, 0.0, 0.0, 0.0)
_TURN_Y = (_QUARTER, 0.0, _QUARTER, 0.0)
_TURN_X = (_QUARTER, -_QUARTER, 0.0, 0.0)
_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_FULL, _HALF = 6.28319, 3.1415  # [rad] ranges as Menagerie rounds them
_SPEED = math.pi  # [rad/s] of all six joints, UR5e data sheet


def _moving(
    link: str,
    position: tuple[float, float, float],
    wxyz: tuple[float, float, float, float],
    axis: tuple[float, float, float],
    limit: float,
) -> Segment:
    return Segment(link, Pose(np.array(position), np.array(wxyz)), np.array(axis), -limit, limit, _SPEED)


_UR5E = (
    _moving("shoulder_link", (0.0, 0.0, 0.163), _STRAIGHT, _Z, _FULL),
    _moving("upper_arm_link", (0.0, 0.138, 0.0), _TURN_Y, _Y, _FULL),
    _moving("forearm_link", (0.0, -0.131, 0.425), _STRAIGHT, _Y, _HALF),
    _moving("wrist_1_link", (0.0, 0.0, 0.392), _TURN_Y, _Y, _FULL),
    _moving("wrist_2_link", (0.0, 0.127, 0.0), _STRAIGHT, _Z, _FULL),
    _moving("wrist_3_link", (0.0, 0.0, 0.1), _STRAIGHT, _Y, _FULL),
    Segment(FLANGE, Pose(np.array((0.0, 0.1, 0.0)), np.array(_TURN_X))),
)
