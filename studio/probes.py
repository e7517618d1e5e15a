"""Does a task need touch? What images and forces tell, linearly, about how a part lies in the hand.

In each scene the demonstrator goes to where it turns soft to insert. How far the part lies off in the hand is
regressed on the images of that moment, before anything touches, and on the forces from the first contact on.
What decides must show in the forces and hardly in the images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from controller.stiffness import nearest_mode
from controller.types import ARM_ROW, Action, Array, CartesianTarget, Image, StiffnessMode, rotation_of
from studio import tasks
from studio.cameras import CameraProcess
from studio.inputs.scripted import demonstration
from studio.tasks import World
from studio.twin import Twin

TOUCH = 0.7  # [N] of change in an arm's force that counts as the first contact
FELT = 41  # ticks of forces, the first contact among them: 0.4 s
SEEN = (80, 60)  # (width, height) [px] of the images
GREY = 0.02  # of the range of a pixel: what changes less is mostly noise of the renderer
FOLDS = 5
PENALTIES = 10.0 ** np.arange(-5, 5)  # tried, in units of the mean variance of a feature

# What is felt rather than seen: arm, part, axis of the arm's tool along which the part lies off.
HIDDEN: Mapping[str, tuple[tuple[str, str, int], ...]] = {
    "peg-cylinder": (("left", "hole", 1), ("right", "peg", 1)),
    "peg-cuboid": (("left", "hole", 1), ("right", "peg", 1)),
    "pick-insert": (("right", "peg", 2),),
}


@dataclass(frozen=True, slots=True)
class Samples:
    """One row a scene."""

    parts: tuple[str, ...]
    offsets: Array  # (n, parts) [m]
    forces: Array  # (n, FELT, arms, 6) [N, N·m] in the axes of the tool
    images: Mapping[str, Array]  # camera -> (n, h, w, 3) uint8
    untouched: tuple[int, ...]  # seeds without a contact


@dataclass(frozen=True, slots=True)
class Told:
    """What can be told of one part's offset: R² on scenes that were not fitted."""

    part: str
    spread_mm: float  # standard deviation of the offset
    from_forces: float
    from_images: float  # of all cameras together
    from_each_camera: Mapping[str, float]


def probe(task: str, seeds: Sequence[int], on_seed: Callable[[], None] = lambda: None) -> list[Told]:
    """For each part of `task` that hides how it lies. Raises KeyError where there is none."""
    samples = collect(task, seeds, on_seed)
    n = len(samples.offsets)
    if n < 2 * FOLDS:
        raise ValueError(f"Contact came in {n} of {len(seeds)} scenes; a regression needs {2 * FOLDS}.")
    cameras = {name: images.reshape(n, -1) / 255.0 for name, images in samples.images.items()}
    everything = np.concatenate(list(cameras.values()), axis=1)
    return [
        Told(
            part=part,
            spread_mm=float(offset.std()) * 1e3,
            from_forces=ridge_r2(samples.forces.reshape(n, -1), offset),
            from_images=ridge_r2(everything, offset, GREY),
            from_each_camera={name: ridge_r2(images, offset, GREY) for name, images in cameras.items()},
        )
        for part, offset in zip(samples.parts, samples.offsets.T, strict=True)
    ]


def collect(task: str, seeds: Sequence[int], on_seed: Callable[[], None] = lambda: None) -> Samples:
    """Let the demonstrator come to touch in every scene."""
    if task not in HIDDEN:
        raise KeyError(f"No part of {task!r} is felt rather than seen; there are {sorted(HIDDEN)}.")
    twin, cameras = Twin(tasks.load(task)), CameraProcess(task)
    touched, images, untouched = [], [], []
    try:
        for seed in seeds:
            twin.reset(seed)
            touch = _first_touch(twin, seed)
            if touch is None:
                untouched.append(seed)
            else:
                touched.append(touch)
                images.append(cameras.render(0.0, touch.qpos, None))
            on_seed()
    finally:
        cameras.close()
    return Samples(
        parts=tuple(part for _, part, _ in HIDDEN[task]),
        offsets=np.array([touch.offsets for touch in touched]),
        forces=np.array([touch.forces for touch in touched]),
        images={name: np.stack([_small(seen[name]) for seen in images]) for name in cameras.names},
        untouched=tuple(untouched),
    )


@dataclass(frozen=True, slots=True)
class _Touch:
    qpos: Array  # before it
    offsets: list[float]
    forces: Array  # (FELT, arms, 6)


def _first_touch(twin: Twin, seed: int) -> _Touch | None:
    qpos: Array | None = None
    offsets: list[float] = []
    forces: list[Array] = []
    first: int | None = None  # tick of the contact
    for action in demonstration(twin, seed):
        if qpos is None and _is_soft(action):
            qpos, offsets = twin.data.qpos.copy(), _offsets(twin.task.name, twin.world)
        trace = twin.apply(action).trace
        if qpos is None:
            continue
        forces.append(_in_tool_axes(trace))
        if first is None and np.linalg.norm((forces[-1] - forces[0])[:, :3], axis=1).max() > TOUCH:
            first = len(forces) - 1
        if first is not None and len(forces) == first + FELT:
            return _Touch(qpos, offsets, np.array(forces[first:]))
    return None


def _is_soft(action: Action) -> bool:
    """Whether the last arm, which inserts, is at low stiffness."""
    target = action.arms[-1].target
    return isinstance(target, CartesianTarget) and nearest_mode(target.stiffness) is StiffnessMode.LOW


def _offsets(task: str, world: World) -> list[float]:
    """[m] of each part in its hand."""
    return [
        float((world.tcp(arm).inverse() @ world.pose(part)).position[axis])
        for arm, part, axis in HIDDEN[task]
    ]


def _in_tool_axes(trace: Array) -> Array:
    """(arms, 6) mean wrench of a tick's trace."""
    turns = np.array([rotation_of(row[ARM_ROW["base_from_tcp"]][3:]) for row in trace[:, -1]])
    wrench = trace[:, :, ARM_ROW["wrench"]].mean(axis=1).reshape(-1, 2, 3)
    return np.asarray(wrench @ turns).reshape(-1, 6)


def _small(image: Image) -> Array:
    assert image.pixels is not None
    return np.asarray(cv2.resize(image.pixels, SEEN, interpolation=cv2.INTER_AREA))


def ridge_r2(features: Array, target: Array, floor: float = 1e-9) -> float:
    """R² of ridge regression (n, columns) -> (n,), predicted in `FOLDS` folds.

    Each column is scaled to a standard deviation of 1, or less where its own is below `floor`.
    The penalty of each fold is the one that predicts its training rows best, each left out in turn, which has
    a closed form (Allen 1974: residuals divided by 1 less their leverage).
    """
    n = len(target)
    fold = np.random.default_rng(0).permutation(n) % FOLDS
    predicted = np.empty(n)
    for number in range(FOLDS):
        train, test = fold != number, fold == number
        predicted[test] = _ridge(features[train], target[train], features[test], floor)
    return float(1.0 - ((target - predicted) ** 2).sum() / ((target - target.mean()) ** 2).sum())


def _ridge(features: Array, target: Array, asked: Array, floor: float) -> Array:
    """Predictions for the rows `asked`. In the dual form: there are more columns than rows."""
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), floor)
    x, z = (features - mean) / scale, (asked - mean) / scale
    values, vectors = np.linalg.eigh(x @ x.T / x.shape[1])
    centered = vectors.T @ (target - target.mean())
    best, least = np.zeros(len(target)), np.inf
    for penalty in PENALTIES:
        shrunk = 1.0 / (np.maximum(values, 0.0) + penalty)
        weights = vectors @ (shrunk * centered)
        leverage = 1.0 - penalty * (vectors**2 @ shrunk) + 1.0 / len(target)  # the mean was fitted, too
        left_out = ((penalty * weights / (1.0 - np.minimum(leverage, 1.0 - 1e-9))) ** 2).sum()
        if left_out < least:
            best, least = weights, left_out
    return np.asarray(target.mean() + z @ x.T / x.shape[1] @ best)
