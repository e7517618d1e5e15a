"""How long one FDCC step takes, beside the two Pinocchio calls that it cannot do without."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import pinocchio as pin

from controller.fdcc import Fdcc, virtual_arm
from controller.model import FLANGE, ur5e
from controller.types import Array, Pose, Stiffness

HOME = np.array([0.0, -1.6, 1.8, -1.8, -1.57, 0.0])  # [rad] elbow up, tool down
FLANGE_FROM_TCP = Pose(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0]))
LAG = np.full(6, 1e-3)  # [rad] of measured joints behind commanded ones


def measure(steps: int = 5000) -> dict[str, float]:
    """Medians [µs] of one step with one iteration and of the bare calls, taken in turn, and their ratios.

    Each step has a new target and a new wrench, as in the servo. `step` is fed with its last command, as we
    ship it; `measured_step` with other joints, which takes one more forward kinematics.
    """
    arm = ur5e(FLANGE_FROM_TCP)
    fdcc = Fdcc(arm, HOME, sensor_frame=FLANGE)
    lagging = Fdcc(arm, HOME, sensor_frame=FLANGE)
    stiffness = Stiffness.diagonal((500.0, 500.0, 500.0, 35.0, 35.0, 35.0))
    model = virtual_arm(arm, fdcc.config.link_mass)
    data, end, no_rates = model.createData(), arm.frame_id(arm.end_effector), np.zeros(6)

    def bare(q: Array, torque: Array) -> None:
        pin.computeFrameJacobian(model, data, q, end, pin.LOCAL_WORLD_ALIGNED)
        pin.aba(model, data, q, no_rates, torque)

    bare_times, step_times, measured_times = [], [], []
    for target, wrench in zip(_circle(arm.forward_kinematics(HOME), steps), _pushes(steps), strict=True):
        q, q_lagging = fdcc.q, lagging.q - LAG
        bare_times.append(_microseconds(bare, q, wrench))
        step_times.append(_microseconds(fdcc.step, q, target, stiffness, wrench))
        measured_times.append(_microseconds(lagging.step, q_lagging, target, stiffness, wrench))
    bare_us, step_us, measured_us = median(bare_times), median(step_times), median(measured_times)
    return {
        "bare_us": bare_us,
        "step_us": step_us,
        "ratio": step_us / bare_us,
        "measured_step_us": measured_us,
        "measured_ratio": measured_us / bare_us,
    }


def _microseconds(call: Callable[..., Any], *arguments: Any) -> float:
    start = time.perf_counter_ns()
    call(*arguments)
    return (time.perf_counter_ns() - start) / 1e3


def _circle(centre: Pose, steps: int) -> list[Pose]:
    """Targets on a circle of 20 mm, two seconds per turn at 500 Hz."""
    angles = np.arange(steps) * (2.0 * np.pi / 1000.0)
    offsets = 0.02 * np.stack((np.cos(angles), np.sin(angles), np.zeros(steps)), axis=1)
    return [Pose(centre.position + offset, centre.wxyz) for offset in offsets]


def _pushes(steps: int) -> Array:
    """(steps, 6) wrenches of a few newtons."""
    return np.random.default_rng(0).normal(0.0, (2.0, 2.0, 5.0, 0.2, 0.2, 0.2), (steps, 6))
