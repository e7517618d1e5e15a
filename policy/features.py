"""What a policy sees and says, as numbers: arm states, wrenches and targets to normalised arrays, and back.

One object trains, lies in the checkpoint and runs, so that nothing is encoded twice. Arrays have free leading
axes, then (..., arms, width). A target is relative to the arm state that its images show, or absolute.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, assert_never

import numpy as np

from controller.stiffness import ROTATIONAL_BOUNDS, TRANSLATIONAL_BOUNDS, stiffness_of
from controller.types import Array, StiffnessMode
from policy import rotations

Control = Literal["cartesian", "joint"]
Group = Literal["position", "rotation", "joints", "gripper", "stiffness"]

FLOOR = 0.01  # smallest standard deviation, so that a number that never changes does not become noise
WRENCH_FLOOR = (0.1, 0.1, 0.1, 0.005, 0.005, 0.005)  # [N] and [N·m]: noise of a good sensor
INSIDE = 1e-9  # relative: decoded stiffness keeps this far inside the bounds, so that none is cut back
MODES = tuple(StiffnessMode)

_UPPER = np.triu_indices(3)
_BOUNDS = np.array([TRANSLATIONAL_BOUNDS, ROTATIONAL_BOUNDS]) * (1 + INSIDE, 1 - INSIDE)  # (2, 2)


@dataclass(frozen=True, slots=True)
class ArmStates:
    """Measured arms."""

    base_from_tcp: Array  # (..., arms, 7) position [m], wxyz
    q: Array  # (..., arms, 6) [rad]
    gripper: Array  # (..., arms) 0 closed .. 1 open


@dataclass(frozen=True, slots=True)
class Targets:
    """What arms are told: pose and stiffness, or joints."""

    gripper: Array  # (..., arms)
    base_from_target: Array | None = None  # (..., arms, 7)
    stiffness: Array | None = None  # (..., arms, 2, 3, 3) translational [N/m], rotational [N·m/rad] block
    q: Array | None = None  # (..., arms, 6) [rad]


@dataclass(frozen=True, slots=True)
class Scale:
    """Mean and standard deviation of each number, over the training takes."""

    mean: Array
    std: Array

    @staticmethod
    def of(values: Array, floor: float | Array = FLOOR) -> Scale:
        """From (n, width)."""
        return Scale(values.mean(0), np.maximum(values.std(0), floor))

    def normalise(self, values: Array) -> Array:
        return np.asarray((values - self.mean) / self.std)

    def restore(self, values: Array) -> Array:
        return np.asarray(values * self.std + self.mean)


@dataclass(frozen=True, slots=True)
class Encoding:
    """How states and targets become raw numbers, before any normalisation."""

    n_arms: int
    control: Control = "cartesian"
    frame: Literal["relative", "absolute"] = "relative"
    rotation: Literal["6d", "axis-angle"] = "6d"
    stiffness: Literal["log-diagonal", "cholesky", "mode"] = "log-diagonal"
    # (arms, 3) rotation vector of each arm's mean orientation: where absolute axis-angle has its branch.
    branch: tuple[tuple[float, float, float], ...] = ()
    between: bool = False  # the state also tells how the last of two tools stands to the first

    @property
    def groups(self) -> dict[Group, int]:
        """Width of each group of one arm's action, in order."""
        if self.control == "joint":
            return {"joints": 6, "gripper": 1}
        widths = {"log-diagonal": 6, "cholesky": 12, "mode": len(MODES)}
        rotation = 6 if self.rotation == "6d" else 3
        return {"position": 3, "rotation": rotation, "gripper": 1, "stiffness": widths[self.stiffness]}

    @property
    def arm_width(self) -> int:
        return sum(self.groups.values())

    @property
    def action_width(self) -> int:
        """Numbers of an action of all arms."""
        return self.n_arms * self.arm_width

    @property
    def state_width(self) -> int:
        return self.own_width + (9 if self.between else 0)

    @property
    def own_width(self) -> int:
        """Numbers of the state that tell where each arm is by itself; they come first."""
        rotation = 6 if self.rotation == "6d" else 3
        return self.n_arms * (7 if self.control == "joint" else 4 + rotation)

    def columns(self, group: Group) -> list[int]:
        """Where a group stands in an action of all arms; empty where the encoding does not have it."""
        start = 0
        for name, width in self.groups.items():
            if name == group:
                arms = range(0, self.action_width, self.arm_width)
                return [arm + start + i for arm in arms for i in range(width)]
            start += width
        return []

    def state(self, arms: ArmStates) -> Array:
        """(..., state_width)"""
        if self.control == "joint":
            parts = [arms.q, arms.gripper[..., None]]
        else:
            turn = self._rotation_numbers(rotations.matrices(arms.base_from_tcp[..., 3:]), absolute=True)
            parts = [arms.base_from_tcp[..., :3], turn, arms.gripper[..., None]]
        own = _joined(parts)
        return np.concatenate((own, _between(arms)), axis=-1) if self.between else own

    def action(self, targets: Targets, seen: ArmStates) -> Array:
        """(..., steps, action_width) of targets (..., steps, arms), seen from arm states (..., arms)."""
        relative = self.frame == "relative"
        if self.control == "joint":
            assert targets.q is not None
            q = targets.q - seen.q[..., None, :, :] if relative else targets.q
            return _joined([q, targets.gripper[..., None]])
        assert targets.base_from_target is not None
        assert targets.stiffness is not None
        position = targets.base_from_target[..., :3]
        turn = rotations.matrices(targets.base_from_target[..., 3:])
        if relative:
            position = position - seen.base_from_tcp[..., None, :, :3]
            turn = turn @ np.swapaxes(_seen_rotation(seen), -1, -2)
        stiffness = self._stiffness_numbers(targets.stiffness)
        turned = self._rotation_numbers(turn, absolute=not relative)
        return _joined([position, turned, targets.gripper[..., None], stiffness])

    def targets(self, action: Array, seen: ArmStates) -> Targets:
        """Inverse of `action`. Any numbers give unit quaternions, and stiffness inside the bounds."""
        arms = action.reshape(*action.shape[:-1], self.n_arms, self.arm_width)
        ends = np.cumsum(list(self.groups.values()))[:-1]
        parts = dict(zip(self.groups, np.split(arms, ends, axis=-1), strict=True))
        gripper = parts["gripper"][..., 0].clip(0.0, 1.0)
        relative = self.frame == "relative"
        if self.control == "joint":
            q = parts["joints"] + seen.q[..., None, :, :] if relative else parts["joints"]
            return Targets(gripper, q=q)
        position, numbers = parts["position"], parts["rotation"]
        six = self.rotation == "6d"
        turn = rotations.from_six_numbers(numbers) if six else rotations.from_rotation_vectors(numbers)
        if relative:
            position = position + seen.base_from_tcp[..., None, :, :3]
            turn = turn @ _seen_rotation(seen)
        pose = np.concatenate((position, rotations.quaternions(turn)), axis=-1)
        return Targets(gripper, pose, self._stiffness_blocks(parts["stiffness"]))

    def _rotation_numbers(self, matrix: Array, absolute: bool) -> Array:
        if self.rotation == "6d":
            return rotations.six_numbers(matrix)
        vector = rotations.rotation_vectors(matrix)
        return rotations.nearest_branch(vector, np.array(self.branch)) if absolute else np.asarray(vector)

    def _stiffness_numbers(self, blocks: Array) -> Array:
        match self.stiffness:
            case "cholesky":  # K = U^T U with U upper triangular, as in the paper
                upper = np.swapaxes(np.linalg.cholesky(blocks), -1, -2)
                numbers = upper[..., *_UPPER]
            case "log-diagonal":
                numbers = np.log(_diagonals(blocks))
            case "mode":
                means = _diagonals(blocks)[..., 0, :].mean(-1)
                nearest = np.abs(means[..., None] - _MODE_BLOCKS[:, 0, 0, 0]).argmin(-1)
                return np.asarray(np.eye(len(MODES))[nearest])
            case _:
                assert_never(self.stiffness)
        return np.asarray(numbers.reshape(*numbers.shape[:-2], -1))

    def _stiffness_blocks(self, numbers: Array) -> Array:
        match self.stiffness:
            case "cholesky":
                upper = np.zeros((*numbers.shape[:-1], 2, 3, 3))
                upper[..., *_UPPER] = numbers.reshape(*numbers.shape[:-1], 2, 6)
                return _bounded(np.swapaxes(upper, -1, -2) @ upper)
            case "log-diagonal":
                logs = numbers.reshape(*numbers.shape[:-1], 2, 3)
                low, high = np.log(_BOUNDS[:, :1]), np.log(_BOUNDS[:, 1:])
                return np.asarray(np.exp(logs.clip(low, high))[..., None] * np.eye(3))
            case "mode":
                return np.asarray(_MODE_BLOCKS[numbers.argmax(-1)])
            case _:
                assert_never(self.stiffness)

    def check(self, stiffness: Array, what: str) -> None:
        """Raise ValueError where some of the blocks (n, 2, 3, 3) cannot be told in this encoding."""
        if self.control == "joint" or self.stiffness == "cholesky":
            return
        diagonal = _diagonals(stiffness)
        if np.abs(stiffness - diagonal[..., None] * np.eye(3)).max(initial=0.0) > 1e-6:
            raise ValueError(
                f"{what} has stiffness off the diagonal, which {self.stiffness!r} cannot tell; use cholesky."
            )
        if self.stiffness == "mode":
            wrong = ~np.isclose(stiffness[:, None], _MODE_BLOCKS).all((-1, -2, -3)).any(1)
            if wrong.any():
                found = diagonal[wrong][0].tolist()
                raise ValueError(f"{what} has stiffness {found}, which is no mode; use log-diagonal.")


@dataclass(frozen=True, slots=True)
class Features:
    """An encoding with the scales of its numbers, from the training takes alone."""

    encoding: Encoding
    state: Scale  # (state_width,)
    action: Scale  # (action_width,)
    wrench: Scale  # (arms * 6,)

    @staticmethod
    def fit(encoding: Encoding, states: Array, actions: Array, wrenches: Array) -> Features:
        """From raw numbers (n, state_width), (n, action_width) and wrenches (n, arms, 6)."""
        action = Scale.of(actions)
        if encoding.stiffness == "mode":  # zeros and ones are their own scale
            columns = encoding.columns("stiffness")
            action.mean[columns], action.std[columns] = 0.0, 1.0
        floor = np.tile(WRENCH_FLOOR, encoding.n_arms)
        return Features(
            encoding, Scale.of(states), action, Scale.of(wrenches.reshape(len(wrenches), -1), floor)
        )

    def encode_state(self, arms: ArmStates) -> Array:
        """(..., state_width), normalised."""
        return self.state.normalise(self.encoding.state(arms))

    def encode_wrench(self, history: Array) -> Array:
        """(..., samples, arms * 6), normalised, of (..., samples, arms, 6) [N, N·m]."""
        joined = history.reshape(*history.shape[:-2], self.wrench.mean.size)  # of no samples, too
        return self.wrench.normalise(joined)

    def encode_action(self, targets: Targets, seen: ArmStates) -> Array:
        """(..., steps, action_width), normalised, of targets (..., steps, arms)."""
        return self.action.normalise(self.encoding.action(targets, seen))

    def decode_action(self, values: Array, seen: ArmStates) -> Targets:
        """Inverse of `encode_action`."""
        return self.encoding.targets(self.action.restore(values), seen)

    def to_json(self) -> dict[str, Any]:
        scales = {
            name: {"mean": scale.mean.tolist(), "std": scale.std.tolist()}
            for name, scale in (("state", self.state), ("action", self.action), ("wrench", self.wrench))
        }
        return {"encoding": dataclasses.asdict(self.encoding), **scales}

    @staticmethod
    def from_json(fields: Mapping[str, Any]) -> Features:
        branch = tuple(tuple(vector) for vector in fields["encoding"]["branch"])
        scales = {
            name: Scale(np.array(fields[name]["mean"]), np.array(fields[name]["std"]))
            for name in ("state", "action", "wrench")
        }
        return Features(Encoding(**{**fields["encoding"], "branch": branch}), **scales)


def blocks_of(vectors: Array) -> Array:
    """(..., 2, 3, 3) of `Stiffness.vector` (..., 12)."""
    blocks = np.zeros((*vectors.shape[:-1], 2, 3, 3))
    blocks[..., *_UPPER] = vectors.reshape(*vectors.shape[:-1], 2, 6)
    return np.asarray(blocks + np.swapaxes(np.triu(blocks, 1), -1, -2))


def _joined(parts: Sequence[Array]) -> Array:
    """(..., arms * width) of parts (..., arms, w)."""
    joined = np.concatenate(parts, axis=-1)
    return joined.reshape(*joined.shape[:-2], -1)


def _between(arms: ArmStates) -> Array:
    """(..., 9): from the first tool to the last, position [m] and rotation in the axes of their bases.

    These are parallel, and a constant way between them is of no consequence once normalised.
    """
    first, last = arms.base_from_tcp[..., 0, :], arms.base_from_tcp[..., -1, :]
    turn = rotations.matrices(last[..., 3:]) @ np.swapaxes(rotations.matrices(first[..., 3:]), -1, -2)
    return np.concatenate((last[..., :3] - first[..., :3], rotations.six_numbers(turn)), axis=-1)


def _seen_rotation(seen: ArmStates) -> Array:
    """(..., 1, arms, 3, 3)"""
    return rotations.matrices(seen.base_from_tcp[..., None, :, 3:])


def _diagonals(blocks: Array) -> Array:
    """(..., 2, 3)"""
    return np.diagonal(blocks, axis1=-2, axis2=-1)


def _bounded(blocks: Array) -> Array:
    """Symmetric blocks (..., 2, 3, 3) with their eigenvalues clipped into the bounds."""
    blocks = (blocks + np.swapaxes(blocks, -1, -2)) / 2
    values, vectors = np.linalg.eigh(np.nan_to_num(blocks))
    low, high = _BOUNDS[:, :1], _BOUNDS[:, 1:]
    clipped = (vectors * values.clip(low, high)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    inside = np.all((values >= low) & (values <= high), axis=-1)
    return np.where(inside[..., None, None], blocks, (clipped + np.swapaxes(clipped, -1, -2)) / 2)


def _mode_blocks() -> Array:
    """(modes, 2, 3, 3)"""
    return np.array([[k.translational, k.rotational] for k in map(stiffness_of, MODES)])


_MODE_BLOCKS = _mode_blocks()
