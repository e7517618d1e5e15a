"""Sources that must keep talking: a headset, a policy. Silence holds the arm, a lost hand releases it.

Each arm is watched by itself. A hold freezes target and stiffness until the source is heard again; after a
release the source has to engage anew, which is its own business (`lost` stays until `set` is called).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from controller.types import Action, ArmAction, Hold, Observation, Release
from studio.channels import Latest

WATCHDOG = 0.1  # [s] nine missed targets of a 90 Hz headset, two of a 20 Hz policy


@dataclass(frozen=True, slots=True)
class _Heard:
    action: ArmAction | None  # None: the hand is lost
    at: float  # [s] monotonic


class StreamAgent:
    """Drives with what a stream last said; set from any thread, read by the session's."""

    def __init__(self, n_arms: int, now: Callable[[], float] = time.monotonic) -> None:
        self._heard: tuple[Latest[_Heard], ...] = tuple(Latest() for _ in range(n_arms))
        self._grippers = [0.0] * n_arms
        self._now = now

    def set(self, arm: int, action: ArmAction) -> None:
        """The newest wish for one arm."""
        self._heard[arm].set(_Heard(action, self._now()))

    def lose(self, arm: int) -> None:
        """The hand that drove an arm is gone: tracking lost, page hidden, lease lost."""
        self._heard[arm].set(_Heard(None, self._now()))

    def age(self, arm: int) -> float | None:
        """[s] since an arm was last heard of; None before the first time."""
        heard, _ = self._heard[arm].get()
        return None if heard is None else self._now() - heard.at

    def reset(self, observation: Observation) -> None:
        self._grippers = [state.gripper for state in observation.arms]

    def act(self, observation: Observation) -> Action:
        return Action(tuple(map(self._action, range(len(self._heard)))))

    def _action(self, arm: int) -> ArmAction:
        heard, _ = self._heard[arm].get()
        if heard is None:
            return ArmAction(Hold(), self._grippers[arm])
        if heard.action is None:
            return ArmAction(Release(), self._grippers[arm])
        self._grippers[arm] = heard.action.gripper
        if self._now() - heard.at > WATCHDOG:
            return ArmAction(Hold(), self._grippers[arm])
        return heard.action
