"""The fast loop of one arm: sparse targets in, joint commands at 500 Hz out, through limits and FDCC.

Once per control period `begin` takes an action, limits it and lays out the path of the target for the
period; `step` then follows that path, once per fast step. Every limit that changes a command is reported
with a sentence (`limits`); what cannot be trusted at all (NaN, absurd jumps) is refused and the arm holds.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Literal, assert_never

import numpy as np

from controller.fdcc import Fdcc, FdccConfig
from controller.model import FLANGE, ArmModel
from controller.stiffness import (
    ROTATIONAL_BOUNDS,
    ROTATIONAL_GAIN,
    TRANSLATIONAL_BOUNDS,
    StiffnessTable,
    bounded,
)
from controller.types import (
    ArmAction,
    Array,
    CartesianTarget,
    Hold,
    JointTarget,
    Limit,
    LimitKind,
    Pose,
    Release,
    Stiffness,
    Wrench,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector,
)


@dataclass(frozen=True, slots=True)
class ServoConfig:
    """Rates, limits and gains of one arm. Speeds are the target's; the arm itself is limited per joint."""

    fast_period: float = 0.002  # [s] of one FDCC cycle
    fast_steps: int = 5  # per control period
    # FDCC continues from its own last command. Fed with measured joints it pays for every servo lag with a
    # standing Cartesian error and presses 25-40 % too lightly (`studio bench` prints the press with both).
    feedback: Literal["commanded", "measured"] = "commanded"
    max_speed: float = 0.5  # [m/s] of the target
    max_turn_rate: float = 2.0  # [rad/s] of the target
    max_jump: float = 0.5  # [m] a target further away than this is a mistake, not a motion
    max_turn: float = 2.0  # [rad] likewise
    max_force: float = 50.0  # [N] contact force at which the target stops pressing further
    max_torque: float = 10.0  # [N·m] likewise
    max_joint_speed: float = 2.0  # [rad/s] of the joint command
    max_joint_jump: float = 1.0  # [rad] a joint target further away than this is refused
    interpolation: int = 5  # control periods: a source that sends at 20 Hz is joined up to a smooth path
    stiffness_table: StiffnessTable = "tuned"
    fdcc: FdccConfig = field(default_factory=FdccConfig)

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if isinstance(value, float | int) and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be above 0, not {value}.")

    @property
    def control_period(self) -> float:
        """[s]"""
        return self.fast_period * self.fast_steps

    @staticmethod
    def for_table(table: StiffnessTable) -> ServoConfig:
        """The defaults with the rotational gain that suits a stiffness table."""
        gain = ROTATIONAL_GAIN[table]
        return ServoConfig(
            stiffness_table=table, fdcc=FdccConfig(p_gains=(0.035, 0.035, 0.035, gain, gain, gain))
        )


class ArmServo:
    """One arm's target, limits and FDCC. Owned by the robot, called from its one thread."""

    def __init__(
        self,
        index: int,
        model: ArmModel,
        config: ServoConfig,
        workspace: tuple[Array, Array],
        q: Array,
        stiffness: Stiffness,
    ) -> None:
        """`workspace`: lower and upper corner (3,) [m] for the target in base axes."""
        self.index = index
        self.config = config
        self.limits: list[Limit] = []  # of the period since the last `begin`
        self._model = model
        self._lower, self._upper = workspace
        self._fdcc = Fdcc(model, q, config.fdcc, sensor_frame=FLANGE)
        cycle = config.fast_period / config.fdcc.internal_dt / config.fdcc.iterations
        self._max_velocity = [config.max_joint_speed * cycle] * model.n_joints
        self.reset(q, stiffness)

    def reset(self, q: Array, stiffness: Stiffness, gripper: float = 0.0) -> None:
        """Come to rest at joints q (6,) [rad], with the target on the TCP."""
        self.limits = []
        self.gripper = gripper
        self.stiffness = stiffness
        self.q_command = np.array(q, dtype=float)  # (6,) [rad]
        self.dq_command = np.zeros_like(self.q_command)  # (6,) [rad/s]
        self._is_cartesian = True
        self._is_released = False
        self._enter_cartesian()

    def begin(self, action: ArmAction, base_from_tcp: Pose, wrench: Wrench) -> ArmAction:
        """Take the action for the next control period, given the measured pose and contact wrench.

        Returns what is applied: the target and stiffness at the period's end.
        """
        self.limits = []
        self._steps_done = 0
        self._since_change += 1
        target = action.target
        if not isinstance(target, Release):
            self._is_released = False
        match target:
            case CartesianTarget():
                self._follow_pose(target, base_from_tcp, wrench)
            case JointTarget():
                self._follow_joints(target, wrench)
            case Hold():
                self.hold()
            case Release():
                self._release(base_from_tcp)
            case _:
                assert_never(target)
        self.gripper = self._checked_gripper(action.gripper)
        if self._is_cartesian:
            return ArmAction(CartesianTarget(self._target, self.stiffness), self.gripper)
        return ArmAction(JointTarget(self._q_path[-1]), self.gripper)

    def step(self, q: Array, sensor_wrench: Array) -> Array:
        """One fast step; return the joint command (6,) [rad].

        q (6,) are the measured joints; `sensor_wrench` (6,) [N, N·m] is what the environment exerts on the
        robot, about the flange and in its axes. Where either is not finite the arm stays.
        """
        step = min(self._steps_done, self.config.fast_steps - 1)
        self._steps_done += 1
        before = self.q_command
        if self._is_cartesian:
            self._step_fdcc(q, self._path[step], sensor_wrench)
        else:
            self.q_command = self._q_path[step]
        self.dq_command = (self.q_command - before) / self.config.fast_period
        return self.q_command

    @property
    def target(self) -> Pose:
        """base_from_target at the end of the present period; the TCP's command under joint control."""
        return self._target if self._is_cartesian else self._model.forward_kinematics(self.q_command)

    def state(self) -> Array:
        """Everything that decides later commands, flat float64."""
        return np.concatenate(
            (
                self._fdcc.state(),
                self.q_command,
                self.dq_command,
                self._target.vector,
                self._goal.vector,
                self.stiffness.vector,
                [
                    self.gripper,
                    self._is_cartesian,
                    self._is_released,
                    self._periods_left,
                    self._since_change,
                ],
            )
        )

    def restore(self, state: Array) -> None:
        """Continue from a `state()` taken between two control periods, to the bit."""
        n = self._model.n_joints
        fdcc, q, dq, target, goal, stiffness, rest = np.split(
            state, np.cumsum([len(self._fdcc.state()), n, n, 7, 7, 12])
        )
        self.reset(q, Stiffness.from_vector(stiffness), gripper=float(rest[0]))
        self._fdcc.restore(fdcc)
        self.dq_command = dq.copy()
        self._target, self._goal = Pose.from_vector(target), Pose.from_vector(goal)
        self._path = [self._target] * self.config.fast_steps
        self._is_cartesian, self._is_released = bool(rest[1]), bool(rest[2])
        self._periods_left, self._since_change = int(rest[3]), int(rest[4])

    # Cartesian targets

    def _enter_cartesian(self) -> None:
        """Start FDCC at rest from the joint command: engaging is the identity."""
        self._is_cartesian = True
        self._fdcc.reset(self.q_command)
        self._target = self._goal = self._model.forward_kinematics(self.q_command)
        self._path = [self._target] * self.config.fast_steps
        self._periods_left, self._since_change, self._steps_done = 1, 0, 0

    def _follow_pose(self, target: CartesianTarget, base_from_tcp: Pose, wrench: Wrench) -> None:
        if not self._is_cartesian:
            self._enter_cartesian()
        goal = self._checked_goal(target.base_from_target)
        if goal is None:
            self.hold()
            return
        self._take_stiffness(target.stiffness)
        self._aim(goal)
        following = self._limit_speed(self._towards_goal())
        following = self._limit_contact(following, base_from_tcp, wrench)
        self._lay_path(following)

    def _checked_goal(self, pose: Pose) -> Pose | None:
        """The goal inside the workspace, or None where it is refused."""
        if not pose.is_finite():
            self._report("not_finite", "The target is not a finite pose; the arm holds.", refused=True)
            return None
        distance = float(np.linalg.norm(pose.position - self._target.position))
        turn = _angle(pose, self._target)
        if distance > self.config.max_jump or turn > self.config.max_turn:
            self._report(
                "target_step",
                f"The target jumped by {distance * 100:.0f} cm and {math.degrees(turn):.0f}°; at most "
                f"{self.config.max_jump * 100:.0f} cm and {math.degrees(self.config.max_turn):.0f}° are "
                "followed; the arm holds.",
                refused=True,
            )
            return None
        inside = np.clip(pose.position, self._lower, self._upper)
        if np.array_equal(inside, pose.position):
            return pose
        sides = [
            f"{axis} at {value:.2f} m"
            for axis, value, wanted in zip("xyz", inside, pose.position, strict=True)
            if value != wanted
        ]
        self._report("workspace", f"The workspace ends: {', '.join(sides)}.")
        return Pose(inside, pose.wxyz)

    def _take_stiffness(self, stiffness: Stiffness) -> None:
        if stiffness is self.stiffness:
            return
        self.stiffness = bounded(stiffness)
        if self.stiffness is not stiffness:
            self._report(
                "stiffness",
                f"Stiffness is kept within {TRANSLATIONAL_BOUNDS} N/m and {ROTATIONAL_BOUNDS} N·m/rad.",
            )

    def _aim(self, goal: Pose) -> None:
        """Spread a changed goal over as many periods as the source takes between two of its targets."""
        if np.array_equal(goal.vector, self._goal.vector):
            return
        self._goal = goal
        regular = self._since_change <= self.config.interpolation
        self._periods_left = max(1, self._since_change) if regular else 1
        self._since_change = 0

    def _towards_goal(self) -> Pose:
        share = 1.0 / self._periods_left
        self._periods_left = max(1, self._periods_left - 1)
        return self._goal if share == 1.0 else _between(self._target, self._goal, share)

    def _limit_speed(self, following: Pose) -> Pose:
        reach = self.config.max_speed * self.config.control_period
        reach_turn = self.config.max_turn_rate * self.config.control_period
        distance = float(np.linalg.norm(following.position - self._target.position))
        turn = _angle(following, self._target)
        share = min(1.0, reach / max(distance, 1e-12), reach_turn / max(turn, 1e-12))
        if share == 1.0:
            return following
        self._report(
            "target_speed",
            f"The target follows at {self.config.max_speed:g} m/s and {self.config.max_turn_rate:g} rad/s.",
        )
        return _between(self._target, following, share)

    def _limit_contact(self, following: Pose, base_from_tcp: Pose, wrench: Wrench) -> Pose:
        """Above the largest force, cut back how far the target lies inside the contact.

        The spring pulls with K (target - tcp); along the contact's normal n that is kept to n^T K n times a
        depth of max_force. The same for torque and rotation.
        """
        position, wxyz = following.position, following.wxyz
        rotation = base_from_tcp.rotation
        force = float(np.linalg.norm(wrench.force))
        if force > self.config.max_force:
            normal = wrench.force / force
            depth = -float((position - base_from_tcp.position) @ normal)
            excess = depth - self.config.max_force / _along(self.stiffness.translational, rotation.T @ normal)
            if excess > 0:
                position = position + excess * normal
                self._report(
                    "contact_force", f"Contact force {force:.0f} N is above {self.config.max_force:.0f} N."
                )
        torque = float(np.linalg.norm(wrench.torque))
        if torque > self.config.max_torque:
            axis = wrench.torque / torque
            angle = -float(rotation_vector(_turn(base_from_tcp, following)) @ axis)
            excess = angle - self.config.max_torque / _along(self.stiffness.rotational, rotation.T @ axis)
            if excess > 0:
                wxyz = multiply_quaternions(quaternion_from_rotation_vector(excess * axis), wxyz)
                self._report(
                    "contact_torque",
                    f"Contact torque {torque:.1f} N·m is above {self.config.max_torque:.0f} N·m.",
                )
        if position is following.position and wxyz is following.wxyz:
            return following
        return Pose(position, wxyz)

    def _lay_path(self, following: Pose) -> None:
        """The target at each fast step of the period, on a line from where it is to `following`."""
        n = self.config.fast_steps
        if np.array_equal(following.vector, self._target.vector):
            self._path = [self._target] * n
        else:
            self._path = [_between(self._target, following, k / n) for k in range(1, n)] + [following]
        self._target = self._path[-1]

    def _step_fdcc(self, q: Array, target: Pose, sensor_wrench: Array) -> None:
        feedback = q if self.config.feedback == "measured" else self.q_command
        try:
            command = self._fdcc.step(feedback, target, self.stiffness, sensor_wrench)
        except FloatingPointError as error:
            self._report("not_finite", f"{error} The arm stays.", refused=True)
            return
        self.q_command = command
        if self._fdcc.limit_velocity(self._max_velocity):
            self._report("joint_speed", f"Joints turn at {self.config.max_joint_speed:g} rad/s at most.")
        at_end = np.flatnonzero((command <= self._model.lower) | (command >= self._model.upper))
        if len(at_end):
            self._report("joint_position", f"Joint {', '.join(str(j + 1) for j in at_end)} is at its end.")

    # Joint targets

    def _follow_joints(self, target: JointTarget, wrench: Wrench) -> None:
        start = self.q_command
        goal = np.asarray(target.q, dtype=float)
        if not np.isfinite(goal).all():
            self._report("not_finite", "The joint target is not finite; the arm holds.", refused=True)
            self.hold()
            return
        if (jump := float(np.abs(goal - start).max())) > self.config.max_joint_jump:
            self._report(
                "target_step",
                f"The joint target jumped by {jump:.2f} rad; at most {self.config.max_joint_jump:g} rad are "
                "followed; the arm holds.",
                refused=True,
            )
            self.hold()
            return
        self._is_cartesian = False
        inside = np.clip(goal, self._model.lower, self._model.upper)
        if not np.array_equal(inside, goal):
            self._report("joint_position", "The joint target is beyond the end of a joint.")
        reach = self.config.max_joint_speed * self.config.control_period
        share = min(1.0, reach / max(float(np.abs(inside - start).max()), 1e-12))
        if share < 1.0:
            self._report("joint_speed", f"Joints turn at {self.config.max_joint_speed:g} rad/s at most.")
        if (force := float(np.linalg.norm(wrench.force))) > self.config.max_force:
            self._report(
                "contact_force",
                f"Contact force {force:.0f} N is above {self.config.max_force:.0f} N; "
                "joint position control cannot yield to it.",
            )
        following = start + share * (inside - start)
        self._lay_joint_path(following)

    def _lay_joint_path(self, following: Array) -> None:
        n = self.config.fast_steps
        start = self.q_command
        self._q_path = [start + (k / n) * (following - start) for k in range(1, n)] + [following]

    # Hold and release

    def hold(self) -> None:
        """Freeze the target where it is, from the next step on."""
        self._steps_done = 0
        if self._is_cartesian:
            self._goal = self._target
            self._periods_left = 1
            self._path = [self._target] * self.config.fast_steps
        else:
            self._lay_joint_path(self.q_command)

    def _release(self, base_from_tcp: Pose) -> None:
        """The target runs to where the TCP is at the moment of release, and stays there."""
        if not self._is_cartesian:
            self._enter_cartesian()
        if not self._is_released:
            self._is_released = True
            self._goal = base_from_tcp
            self._periods_left = 1
        self._lay_path(self._limit_speed(self._towards_goal()))

    def _checked_gripper(self, opening: float) -> float:
        if not math.isfinite(opening):
            self._report("not_finite", "The gripper command is not finite; the gripper stays.", refused=True)
            return self.gripper
        return min(max(float(opening), 0.0), 1.0)

    def _report(self, kind: LimitKind, why: str, refused: bool = False) -> None:
        if not any(limit.kind == kind for limit in self.limits):
            self.limits.append(Limit(self.index, kind, why, refused))


def _turn(start: Pose, end: Pose) -> Array:
    """Quaternion that turns `start` into `end`, in the parent's axes."""
    return multiply_quaternions(end.wxyz, start.wxyz * np.array([1.0, -1.0, -1.0, -1.0]))


def _angle(a: Pose, b: Pose) -> float:
    """[rad] between two orientations, in [0, pi]."""
    return 2.0 * math.acos(min(1.0, abs(float(a.wxyz @ b.wxyz))))


def _between(start: Pose, end: Pose, share: float) -> Pose:
    """On the straight line and the shortest turn from `start` to `end`."""
    position = start.position + share * (end.position - start.position)
    if np.array_equal(start.wxyz, end.wxyz):
        return Pose(position, end.wxyz)
    turn = quaternion_from_rotation_vector(share * rotation_vector(_turn(start, end)))
    wxyz = multiply_quaternions(turn, start.wxyz)
    return Pose(position, wxyz / math.sqrt(float(wxyz @ wxyz)))


def _along(block: Array, direction: Array) -> float:
    """Stiffness along a unit direction, in the block's axes."""
    return float(direction @ block @ direction)
