"""A task's own demonstrator as an agent: it reads the simulation and nobody else may."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from controller.types import Action, Observation
from studio.twin import Twin

STREAM = 1  # of the seed: the demonstrator's choices are not those that drew the scene


def demonstration(twin: Twin, seed: int) -> Iterator[Action]:
    """The task's demonstration, action by action; each reads the world as the ones before have left it."""
    return twin.task.demonstrate(twin.world, np.random.default_rng([STREAM, seed]))


class ScriptedAgent:
    """Demonstrates the twin's task once; the seed decides style, timing and path."""

    def __init__(self, twin: Twin, seed: int) -> None:
        self._twin = twin
        self._seed = seed
        self._actions: Iterator[Action] = iter(())

    def reset(self, observation: Observation) -> None:
        self._actions = demonstration(self._twin, self._seed)

    def act(self, observation: Observation) -> Action | None:
        return next(self._actions, None)
