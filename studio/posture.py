"""Positions of everything in a scene, from the little that a take holds of it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import mujoco
import numpy as np

from controller.types import Array, Pose, Snapshot
from studio import models
from studio.interpolation import between, blend

SWEEP = 2.0  # [s] simulated for one closing of the hand: slow, so that springs and dampers keep up
DRIVER = "right_driver_joint"  # whose angle is the recorded opening


class Posture:
    """`qpos` of a task's whole scene at any time of a take.

    Arms and free objects are recorded far more often than whole states. What is not (the linkage of the
    hands, whatever else moves) is interpolated between the snapshots, once a second: for a hand not the
    angles but how far they are from those of a free hand at the same opening, so that a hand which closes
    between two snapshots closes.
    """

    def __init__(
        self, model: mujoco.MjModel, arms: Sequence[str], snapshots: Iterable[tuple[float, Snapshot]]
    ) -> None:
        """Raise ValueError where the snapshots are not of this model."""
        self._hands = [_Hand(model, arm) for arm in arms]
        self._joints = [_addresses(model, f"{arm}_", models.ARM_JOINTS) for arm in arms]
        self._objects = _free_bodies(model)
        known = [(at, _positions(model, snapshot)) for at, snapshot in snapshots]
        known = known or [(0.0, model.qpos0.copy())]
        for hand, (_, qpos) in itertools.product(self._hands, known):
            qpos[hand.joints] -= hand.free(qpos[hand.driver])
        self._times = np.array([at for at, _ in known])
        self._known = np.array([qpos for _, qpos in known])

    def at(
        self, time: float, q: Sequence[Array], openings: Sequence[float], objects: Mapping[str, Array]
    ) -> Array:
        """(nq,) at `time` [s]: arms at `q` (6,), hands at `openings`, free bodies at `objects` (7,)."""
        first, second, share = between(self._times, time)
        qpos = blend(self._known[first], self._known[second], share)
        for joints, angles in zip(self._joints, q, strict=True):
            qpos[joints] = angles
        for hand, opening in zip(self._hands, openings, strict=True):
            angle = models.GRIPPER_CLOSED * (1.0 - opening)
            qpos[hand.joints] += hand.free(angle)
            qpos[hand.driver] = angle
        for name, pose in objects.items():
            if name in self._objects:
                qpos[self._objects[name]] = pose
        return qpos


class _Hand:
    """Where the joints of one hand lie in `qpos`, and what they are when nothing is between its fingers."""

    def __init__(self, model: mujoco.MjModel, arm: str) -> None:
        names, self._driver_angles, self._angles = _sweep()
        self.joints = _addresses(model, f"{arm}_hand_", names)
        self.driver = int(self.joints[names.index(DRIVER)])

    def free(self, driver_angle: float) -> Array:
        first, second, share = between(self._driver_angles, driver_angle)
        return blend(self._angles[first], self._angles[second], share)


@cache
def _sweep() -> tuple[tuple[str, ...], Array, Array]:
    """Joints of a hand, driver angle (m,) [rad], rising, and the angles of all joints (m, 8) with it.

    The linkage has more joints than its loops decide; springs and dampers do the rest. So it is closed once.
    """
    spec = models.new_spec()
    models.add_arm(spec, "any", np.zeros(3), Pose.identity())
    model = spec.compile()
    data = mujoco.MjData(model)
    prefix = "any_hand_"
    joints = [model.joint(j).name for j in range(model.njnt)]
    names = tuple(name.removeprefix(prefix) for name in joints if name.startswith(prefix))
    addresses = _addresses(model, prefix, names)
    fingers = model.actuator(f"{prefix}fingers_actuator").id
    angles = []
    for closed in np.linspace(0.0, models.GRIPPER_RANGE, round(SWEEP / model.opt.timestep)):
        data.ctrl[fingers] = closed
        mujoco.mj_step(model, data)
        angles.append(data.qpos[addresses].copy())
    table = np.array(angles)
    driver = np.maximum.accumulate(table[:, names.index(DRIVER)])
    rising = np.concatenate(([True], np.diff(driver) > 0.0))
    return names, driver[rising], table[rising]


def _addresses(model: mujoco.MjModel, prefix: str, names: Sequence[str]) -> Array:
    return np.array([int(model.joint(prefix + name).qposadr[0]) for name in names])


def _free_bodies(model: mujoco.MjModel) -> dict[str, slice]:
    """Where the free bodies lie in `qpos`, by name."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    starts = {model.body(int(model.jnt_bodyid[j])).name: int(model.jnt_qposadr[j]) for j in free}
    return {name: slice(start, start + 7) for name, start in starts.items()}


def _positions(model: mujoco.MjModel, snapshot: Snapshot) -> Array:
    """(nq,) of a whole simulator state."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.asarray(snapshot.arrays.get("physics", ()))
    if state.shape != (mujoco.mj_stateSize(model, kind),):
        raise ValueError(
            f"The take's states hold {state.size} numbers, the scene of today "
            f"{mujoco.mj_stateSize(model, kind)}: it was recorded with another version of its task."
        )
    positions = np.empty(model.nq)
    mujoco.mj_extractState(model, np.ascontiguousarray(state), kind, positions, mujoco.mjtState.mjSTATE_QPOS)
    return positions
