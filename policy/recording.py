"""What training asks of a recorded take, whoever stores it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from controller.stiffness import StiffnessTable
from controller.types import Array


@dataclass(frozen=True, slots=True)
class ArmTrack:
    """One arm over a take: n measured states, m applied actions. NaN where an action has no such target."""

    state_time: Array  # (n,) [s] rising
    base_from_tcp: Array  # (n, 7) position [m], wxyz
    q: Array  # (n, 6) [rad]
    q_command: Array  # (n, 6) [rad] last joint command
    wrench: Array  # (n, 6) [N, N·m] in base axes
    gripper: Array  # (n,) 0 closed .. 1 open
    action_time: Array  # (m,) [s] rising
    base_from_target: Array  # (m, 7) after limits
    stiffness: Array  # (m, 12) of `Stiffness.vector`
    gripper_command: Array  # (m,)


class Recording(Protocol):
    """One take, open for reading."""

    name: str
    task: str
    arms: tuple[str, ...]
    cameras: Mapping[str, tuple[int, int]]  # (height, width) [px]
    span: tuple[float, float]  # [s] of the part to learn from
    stiffness_table: StiffnessTable  # what the controller was set up for

    def track(self, arm: str) -> ArmTrack: ...

    def image_times(self, camera: str) -> Array:
        """(n,) [s] rising: of the state that each image shows."""

    def image(self, camera: str, index: int) -> Array:
        """(h, w, 3) uint8, RGB."""
