"""What contact feels like: presses, free steps and the grasp, in the wiping scene with hand and eraser."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from controller.model import ArmModel
from controller.servo import ServoConfig
from controller.types import (
    ARM_ROW,
    Action,
    ArmAction,
    Array,
    CartesianTarget,
    JointTarget,
    Pose,
    StiffnessMode,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector,
)
from studio import tasks
from studio.motion import Motion
from studio.tasks.wiping import BOARD_CENTER
from studio.twin import Twin

MODES = tuple(StiffnessMode)
ARM, TOOL = "right", "eraser"

PLACES = (
    (0.50, 0.00),
    (0.60, 0.12),
    (0.42, -0.12),
)  # [m] x and y of presses; the first is the board's centre
ABOVE = 0.02  # [m] height at which a press begins
DEPTH = 0.01  # [m] of the target below the board's face
SPEED = 0.05  # [m/s] of the target
PRESSED = 3.0  # [s] that the target stays
SLOW_PRESSED = 20.0  # [s] likewise, fed with measured joints
JUDGED = 1.0  # [s] at the end over which a press is judged
QUIET = 0.1  # [N] standard deviation of a quiet press
ERROR_SCALES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # tried for the margin, from below

STEP = 0.02  # [m]
TURN = math.radians(5.0)  # [rad]
STEPPED = 2.5  # [s]
RISEN = 1.0 - math.exp(-1.0)  # share of a step: 63 %


@dataclass(frozen=True, slots=True)
class Press:
    """One press of `DEPTH`. Joint position control has no stiffness K, and no ratios."""

    mean_N: float  # of the last second, along the board's normal
    std_N: float  # likewise
    peak_N: float  # of the whole press
    to_law: float | None  # mean over K (target - tcp), as measured
    to_depth: float | None  # mean over K DEPTH
    deepest_mm: float  # penetration of any contact: felt, board, pads
    slip_mm: float  # of the eraser in the hand
    slip_deg: float


@dataclass(frozen=True, slots=True)
class Rise:
    """The answer to a step in free space."""

    rise_s: float  # to 63 %
    overshoot: float  # share of the step


def measure() -> dict[str, Any]:
    """Presses and steps in each stiffness mode; takes about a minute."""
    shipped = ServoConfig()
    twin = twin_with(shipped)
    measured = twin_with(replace(shipped, feedback="measured"))
    doubled = twin_with(_with_error_scale(2.0 * shipped.fdcc.error_scale))
    return {
        "error_scale": shipped.fdcc.error_scale,
        "press": {mode.value: asdict(press(twin, mode)) for mode in MODES},
        "press_at_twice_error_scale": {mode.value: asdict(press(doubled, mode)) for mode in MODES},
        "press_with_measured_feedback": {
            mode.value: asdict(press(measured, mode, stay=SLOW_PRESSED)) for mode in MODES
        },
        "press_by_joint_control": asdict(press(twin, StiffnessMode.HIGH, by_joints=True)),
        "quiet_up_to_error_scale": quiet_up_to(),
        "step": {mode.value: _on_all_axes(twin, mode, np.eye(3, 6) * STEP) for mode in MODES},
        "turn": {mode.value: _on_all_axes(twin, mode, np.eye(3, 6, 3) * TURN) for mode in MODES},
    }


def twin_with(config: ServoConfig) -> Twin:
    return Twin(tasks.load("wiping"), config)


def press(
    twin: Twin,
    mode: StiffnessMode,
    place: tuple[float, float] = PLACES[0],
    *,
    stay: float = PRESSED,
    by_joints: bool = False,
) -> Press:
    """Approach in free space, then press 10 mm into the board and stay there [s]."""
    twin.reset(0)
    start = twin.observe().arms[0].base_from_tcp
    above, inside = (Pose(np.array([*place, BOARD_CENTER[2] + z]), start.wxyz) for z in (ABOVE, -DEPTH))
    hand = Motion(start, StiffnessMode.HIGH, gripper=0.0)
    _run(twin, hand.move(above, 2.0))
    hand.mode = mode
    _run(twin, hand.wait(1.5))
    held = _held(twin)
    actions: Iterator[ArmAction] = itertools.chain(
        hand.move(inside, (ABOVE + DEPTH) / SPEED, linear=True), hand.wait(stay)
    )
    if by_joints:
        actions = _as_joint_targets(twin.arms[0].kinematics, twin.observe().arms[0].q_command, actions)
    rows, deepest = _run(twin, actions)
    slip = held.inverse() @ _held(twin)
    force = rows[:, ARM_ROW["wrench"]][:, :3]
    last = slice(-round(JUDGED / twin.config.fast_period), None)
    mean = float(force[last, 2].mean())
    yielded = float((rows[last, ARM_ROW["base_from_tcp"]][:, 2] - inside.position[2]).mean())
    target = next(hand.wait(0.01)).target
    k = float(target.stiffness.translational[2, 2]) if isinstance(target, CartesianTarget) else math.nan
    return Press(
        mean_N=mean,
        std_N=float(force[last, 2].std()),
        peak_N=float(np.linalg.norm(force, axis=1).max()),
        to_law=None if by_joints else mean / (k * yielded),
        to_depth=None if by_joints else mean / (k * DEPTH),
        deepest_mm=deepest * 1e3,
        slip_mm=float(np.linalg.norm(slip.position)) * 1e3,
        slip_deg=math.degrees(float(np.linalg.norm(rotation_vector(slip.wxyz)))),
    )


def quiet_up_to() -> float:
    """Largest error_scale at which presses in the softest and the hardest mode are quiet at all places."""
    quiet = 0.0
    for scale in ERROR_SCALES:
        twin = twin_with(_with_error_scale(scale))
        pairs = itertools.product((StiffnessMode.LOW, StiffnessMode.HIGH), PLACES)
        if any(press(twin, mode, place).std_N > QUIET for mode, place in pairs):
            break
        quiet = scale
    return quiet


def free_step(twin: Twin, mode: StiffnessMode, offset: Array) -> Rise:
    """Move the target at once by `offset` (6,) [m, rad], where nothing touches."""
    twin.reset(0)
    start = twin.observe().arms[0].base_from_tcp
    hand = Motion(start, mode, gripper=0.0)
    _run(twin, hand.wait(0.5))
    turn = quaternion_from_rotation_vector(offset[3:])
    hand.pose = Pose(start.position + offset[:3], multiply_quaternions(turn, start.wxyz))
    rows, _ = _run(twin, hand.wait(STEPPED))
    poses = rows[:, ARM_ROW["base_from_tcp"]]
    back = start.inverse().wxyz
    turned = [rotation_vector(multiply_quaternions(wxyz, back)) for wxyz in poses[:, 3:]]
    share = np.hstack((poses[:, :3] - start.position, turned)) @ offset / (offset @ offset)
    return Rise(int(np.argmax(share >= RISEN)) * twin.config.fast_period, max(0.0, float(share.max()) - 1.0))


def _on_all_axes(twin: Twin, mode: StiffnessMode, offsets: Array) -> dict[str, Any]:
    return {axis: asdict(free_step(twin, mode, offset)) for axis, offset in zip("xyz", offsets, strict=True)}


def _with_error_scale(scale: float) -> ServoConfig:
    shipped = ServoConfig()
    return replace(shipped, fdcc=replace(shipped.fdcc, error_scale=scale))


def _run(twin: Twin, actions: Iterable[ArmAction]) -> tuple[Array, float]:
    """All trace rows (n, ARM_ROW_WIDTH), and the deepest penetration [m]."""
    traces, deepest = [], 0.0
    for action in actions:
        traces.append(twin.apply(Action((action,))).trace[0])
        deepest = max(deepest, -float(twin.data.contact.dist.min(initial=0.0)))
    return np.concatenate(traces), deepest


def _held(twin: Twin) -> Pose:
    """tcp_from_eraser."""
    return twin.world.tcp(ARM).inverse() @ twin.world.pose(TOOL)


def _as_joint_targets(arm: ArmModel, q: Array, actions: Iterator[ArmAction]) -> Iterator[ArmAction]:
    """The same poses, followed stiffly."""
    for action in actions:
        assert isinstance(action.target, CartesianTarget)
        q = arm.inverse_kinematics(action.target.base_from_target, q)
        yield ArmAction(JointTarget(q), action.gripper)
