"""Batches of a run: what step n learns from depends on the seed and n alone, on any number of processes.

Steps take samples one after the other from a shuffled row of them, and the next row, shuffled anew, follows
without a gap. A run that goes on at step n needs nothing else to go on with the same batches.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
import torch

from controller.types import Array
from policy.act import Batch
from policy.config import TrainConfig
from policy.dataset import Dataset
from policy.features import Features


class Batches:
    """Draws from the samples `indices` of a dataset."""

    def __init__(
        self,
        dataset: Dataset,
        features: Features,
        config: TrainConfig,
        indices: Array,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        if not len(indices):
            raise ValueError("There is no sample to learn from.")
        self._dataset, self._features, self._config = dataset, features, config
        self._indices = indices
        self._rank, self._world = rank, world
        self._shuffled = lru_cache(2)(self._shuffle)

    def stream(self, first: int, last: int) -> Iterator[tuple[Batch, Array]]:
        """Batch and samples of steps `first` .. `last` - 1; a thread prepares the next meanwhile."""
        with ThreadPoolExecutor(1, "batches") as thread:
            coming = thread.submit(self.at, first) if first < last else None
            for step in range(first, last):
                assert coming is not None
                batch = coming.result()
                coming = thread.submit(self.at, step + 1) if step + 1 < last else None
                yield batch

    def at(self, step: int) -> tuple[Batch, Array]:
        """Batch of a step, for this process, and which samples it holds."""
        size = self._config.batch
        whole = np.arange(step * size * self._world, (step + 1) * size * self._world)
        mine = slice(self._rank * size, (self._rank + 1) * size)
        rounds, places = np.divmod(whole[mine], len(self._indices))
        indices = np.array(
            [self._shuffled(r)[p] for r, p in zip(rounds.tolist(), places.tolist(), strict=True)]
        )
        rng = np.random.default_rng([self._config.seed, step, 1])
        n_cameras = len(self._dataset.cameras)
        light = rng.uniform(-1.0, 1.0, (len(whole), n_cameras, 2))[mine] * self._config.brightness
        moves = rng.integers(-self._config.shift, self._config.shift + 1, (len(whole), n_cameras, 2))[mine]
        return self.of(indices, light, moves), indices

    def of(self, indices: Array, light: Array | None = None, moves: Array | None = None) -> Batch:
        """Batch of given samples; changed by contrast and brightness `light` and moved by pixels `moves`."""
        seen = self._dataset.seen(indices)
        targets, valid = self._dataset.targets(indices, self._config.chunk, self._config.rate)
        wrench = self._dataset.wrench(indices, self._config.wrench_history)
        images = self._dataset.images(indices)
        if moves is not None and self._config.shift:
            images = _moved(images, moves, self._config.shift)
        if self._config.past_end == "repeat":
            valid = np.ones_like(valid)
        changes = self._config.brightness > 0 and light is not None
        return Batch(
            state=_tensor(self._features.encode_state(seen)),
            wrench=_tensor(self._features.encode_wrench(wrench)),
            images=torch.from_numpy(images),
            action=_tensor(self._features.encode_action(targets, seen)),
            valid=torch.from_numpy(valid),
            light=_tensor(light + np.array([1.0, 0.0])) if changes and light is not None else None,
        )

    def _shuffle(self, number: int) -> Array:
        return np.random.default_rng([self._config.seed, number, 0]).permutation(self._indices)


def _tensor(values: Array) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, np.float32))


def _moved(images: Array, moves: Array, most: int) -> Array:
    """Images (n, cameras, h, w, 3), each moved by its pixels (n, cameras, 2); borders are repeated."""
    height, width = images.shape[2:4]
    wide = np.pad(images, ((0, 0), (0, 0), (most, most), (most, most), (0, 0)), mode="edge")
    out = np.empty_like(images)
    for place in np.ndindex(*images.shape[:2]):
        y, x = moves[place] + most
        out[place] = wide[place][y : y + height, x : x + width]
    return out
