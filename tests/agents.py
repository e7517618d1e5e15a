"""Agents and subscribers of a few lines, for tests."""

from __future__ import annotations

from collections.abc import Iterable

from controller.types import Action, ArmAction, Hold, Observation, Step

STAY = Action((ArmAction(Hold(), 0.0),))  # of one arm


class Script:
    """Plays actions and is then finished; an exception among them is raised."""

    def __init__(self, actions: Iterable[Action | Exception]) -> None:
        self._actions = actions

    def reset(self, observation: Observation) -> None:
        self._rest = iter(self._actions)

    def act(self, observation: Observation) -> Action | None:
        match next(self._rest, None):
            case Exception() as error:
                raise error
            case action:
                return action


class Listener:
    """Remembers every step."""

    def __init__(self) -> None:
        self.steps: list[Step] = []

    def on_step(self, step: Step) -> None:
        self.steps.append(step)
