"""Training data: a cache of plain arrays (see `policy.cache`), and samples drawn from it.

    CACHE/index.json     names, task, arms, cameras, where each take begins and ends
          tracks.npz     states and targets of all arms on a common 100 Hz grid, take after take
          images.raw     (samples, cameras, h, w, 3) uint8, mapped into memory, not read

A sample is one moment that images show. Its arm states and forces are those of that moment, not of the
images' arrival; its chunk begins there, too.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controller.stiffness import StiffnessTable
from controller.types import Array
from policy import rotations
from policy.config import TrainConfig
from policy.features import ArmStates, Control, Encoding, Features, Targets, blocks_of

FORMAT = 1
GRID = 0.01  # [s] of the grid: the control period
FIT_SAMPLES = 5000  # at most, evenly over the training takes, to scale the numbers


@dataclass(frozen=True, slots=True)
class Take:
    """Where one take lies in the cache."""

    name: str
    rows: tuple[int, int]  # first, and one past the last, of the grid
    samples: tuple[int, int]
    start: float  # [s] in the take of its first row


class Dataset:
    """A cache, open for reading. `indices` are always those of samples, (n,)."""

    def __init__(self, folder: Path) -> None:
        try:
            index = json.loads((folder / "index.json").read_text())
        except FileNotFoundError as error:
            raise FileNotFoundError(f"There is no training cache at {folder}.") from error
        if index["format"] != FORMAT:
            raise ValueError(
                f"{folder} has format {index['format']}, this version reads {FORMAT}: delete it."
            )
        self.folder = folder
        self.task: str = index["task"]
        self.arms: tuple[str, ...] = tuple(index["arms"])
        self.stiffness_table: StiffnessTable = index.get("stiffness_table", "tuned")  # older caches: untold
        self.cameras = {name: (height, width) for name, (height, width) in index["cameras"].items()}
        self.recorded = {name: (height, width) for name, (height, width) in index["recorded"].items()}
        self.takes = tuple(
            Take(take["name"], tuple(take["rows"]), tuple(take["samples"]), take["start"])
            for take in index["takes"]
        )
        with np.load(folder / "tracks.npz") as tracks:
            self._tracks = {name: tracks[name] for name in tracks.files}
        self._row = self._tracks.pop("sample_row")  # (samples,)
        self._images: Array | None = None
        if self.cameras:
            size = next(iter(self.cameras.values()))
            shape = (len(self._row), len(self.cameras), *size, 3)
            self._images = np.memmap(folder / "images.raw", np.uint8, "r", shape=shape)
        self._take = np.repeat(np.arange(len(self.takes)), [len(range(*t.samples)) for t in self.takes])
        rows = np.array([take.rows for take in self.takes])[self._take]
        self._first, self._last = rows[:, 0], rows[:, 1] - 1  # (samples,) rows of each sample's take

    def __len__(self) -> int:
        return len(self._row)

    def split(self, share: float, seed: int) -> tuple[Array, Array]:
        """Samples to learn from and samples to validate on: whole takes, at least one if `share` > 0."""
        n = len(self.takes)
        aside = min(max(1, round(share * n)), n - 1) if share > 0 else 0
        chosen = np.random.default_rng([seed, n]).permutation(n)[:aside]
        validates = np.isin(self._take, chosen)
        return np.flatnonzero(~validates), np.flatnonzero(validates)

    def describe(self, indices: Array) -> str:
        """Which moments these are, for a person."""
        told = []
        for index in indices.tolist():
            take = self.takes[self._take[index]]
            at = take.start + (self._row[index] - take.rows[0]) * GRID
            told.append(f"{take.name} at {at:.2f} s")
        return ", ".join(told)

    def seen(self, indices: Array) -> ArmStates:
        """(n, arms)"""
        rows = self._row[indices]
        return ArmStates(*(self._tracks[name][rows] for name in ("base_from_tcp", "q", "gripper")))

    def wrench(self, indices: Array, samples: int) -> Array:
        """(n, samples, arms, 6) up to each moment, 10 ms apart; before its take the first stands for all."""
        back = np.arange(1 - max(samples, 1), 1)
        first = self._first[indices]
        rows = np.maximum(self._row[indices][:, None] + back, first[:, None])
        return np.asarray(self._tracks["wrench"][rows][:, len(back) - samples :])

    def targets(self, indices: Array, steps: int, rate: float) -> tuple[Targets, Array]:
        """Targets (n, steps, arms) at `rate` [Hz] from each moment on; which lie in the take (n, steps).

        Past its end the last one is repeated. Between two rows of the grid targets are blended.
        """
        last = self._last[indices][:, None]
        place = self._row[indices][:, None] + np.arange(steps) / (rate * GRID)  # (n, steps)
        valid = place <= last + 1e-6
        place = np.minimum(place, last)
        lower = np.floor(place + 1e-6).astype(int)
        upper = np.minimum(lower + 1, last)
        share = np.maximum(place - lower, 0.0)
        if share.max(initial=0.0) < 1e-6:
            share = None

        def at(name: str) -> Array:
            values = self._tracks[name]
            if share is None:
                return np.asarray(values[lower])
            below, above = values[lower], values[upper]
            weight = share.reshape(*share.shape, *[1] * (below.ndim - 2))
            if name == "base_from_target":  # q and -q are the same rotation
                agree = (below[..., 3:] * above[..., 3:]).sum(-1, keepdims=True) >= 0
                above = np.concatenate((above[..., :3], np.where(agree, 1.0, -1.0) * above[..., 3:]), axis=-1)
            return np.asarray(below + weight * (above - below))

        pose = at("base_from_target")
        pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        return Targets(at("gripper_command"), pose, blocks_of(at("stiffness")), at("q_command")), valid

    def images(self, indices: Array) -> Array:
        """(n, cameras, h, w, 3) uint8"""
        if self._images is None:
            return np.empty((len(indices), 0, 1, 1, 3), np.uint8)
        return np.asarray(self._images[indices])

    def check(self, encoding: Encoding) -> None:
        """Raise ValueError where a take holds what the encoding cannot tell."""
        if encoding.control == "joint":
            return
        for take in self.takes:
            rows = slice(*take.rows)
            missing = ~np.isfinite(self._tracks["base_from_target"][rows]).all((-1, -2))
            if missing.any():
                raise ValueError(
                    f"{take.name} follows joint targets for {missing.mean():.0%} of its time; Comp-ACT "
                    "learns from Cartesian ones. Leave the take out, or train with --policy act."
                )
            for arm, name in enumerate(self.arms):
                stiffness = np.unique(self._tracks["stiffness"][rows, arm], axis=0)
                encoding.check(blocks_of(stiffness), f"The {name} arm of {take.name}")


def fit(dataset: Dataset, config: TrainConfig, training: Array) -> Features:
    """The encoding that a run asks for, with the scales of the samples to learn from.

    Raises ValueError where a take holds what the encoding cannot tell.
    """
    chosen = training[:: math.ceil(len(training) / FIT_SAMPLES)]
    seen = dataset.seen(chosen)
    branch = tuple(
        tuple(rotations.rotation_vectors(rotations.matrices(rotations.mean_rotation(poses[:, 3:]))).tolist())
        for poses in np.moveaxis(seen.base_from_tcp, 1, 0)
    )
    control: Control = "joint" if config.policy == "act" else "cartesian"
    n_arms = len(dataset.arms)
    between = config.between and n_arms == 2 and control == "cartesian"
    encoding = Encoding(n_arms, control, config.frame, config.rotation, config.stiffness, branch, between)
    dataset.check(encoding)
    targets, valid = dataset.targets(chosen, config.chunk, config.rate)
    actions = encoding.action(targets, seen)
    return Features.fit(encoding, encoding.state(seen), actions[valid], dataset.wrench(chosen, 1)[:, 0])
