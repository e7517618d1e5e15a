"""A policy of a few lines, for tests: no network, no torch."""

from __future__ import annotations

import numpy as np

from controller.stiffness import stiffness_of
from controller.types import StiffnessMode
from policy.agent import ActionChunk, ArmChunk, Inputs, PolicySpec

SPEC = PolicySpec(
    run="riser",
    task="wiping",
    arms=("right",),
    cameras={},
    control="cartesian",
    rate=20.0,
    chunk=20,
    wrench_history=4,
    wrench_rate=100.0,
    step=7,
)
SPEED = 0.05  # [m/s]


class Riser:
    """Raises the tool from where it is seen, at low stiffness. Remembers what it was shown."""

    def __init__(self, spec: PolicySpec = SPEC) -> None:
        self.spec = spec
        self.seeds: list[int] = []
        self.shown: list[Inputs] = []

    def reset(self, seed: int) -> None:
        self.seeds.append(seed)

    def predict(self, inputs: Inputs) -> ActionChunk:
        if not np.isfinite(inputs.wrench).all():
            raise ValueError("The wrench is not finite.")
        self.shown.append(inputs)
        n, stiffness = self.spec.chunk, stiffness_of(StiffnessMode.LOW)
        rise = np.arange(n)[:, None] / self.spec.rate * SPEED * np.array([0.0, 0.0, 1.0])
        arms = tuple(
            ArmChunk(
                gripper=np.zeros(n),
                position=pose[:3] + rise,
                wxyz=np.tile(pose[3:], (n, 1)),
                translational=np.tile(stiffness.translational, (n, 1, 1)),
                rotational=np.tile(stiffness.rotational, (n, 1, 1)),
            )
            for pose in inputs.base_from_tcp
        )
        return ActionChunk(inputs.time, 1.0 / self.spec.rate, arms)

    def close(self) -> None:
        """Nothing to give back."""
