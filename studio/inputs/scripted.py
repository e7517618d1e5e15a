"""A task's own demonstrator as an agent: it reads the simulation and nobody else may."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from controller.types import Action, Observation
from studio.twin import Twin

STREAM = 1  # of the seed: the demonstrator's choices are not those that drew the scene


class ScriptedAgent:
    """Demonstrates the twin's task once; the seed decides style, timing and path."""

    def __init__(self, twin: Twin, seed: int) -> None:
        self._twin = twin
        self._seed = seed
        self._actions: Iterator[Action] = iter(())

    def reset(self, observation: Observation) -> None:
        rng = np.random.default_rng([STREAM, self._seed])
        self._actions = self._twin.task.demonstrate(self._twin.world, rng)

    def act(self, observation: Observation) -> Action | None:
        return next(self._actions, None)
