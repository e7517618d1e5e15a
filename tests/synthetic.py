"""Takes made of formulas, for tests of learning: an arm goes to where a bright square is in its images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from controller.stiffness import StiffnessTable
from policy.cache import Size, build
from policy.dataset import Dataset
from policy.recording import ArmTrack, Recording

DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # wxyz of a tool that points down


@dataclass
class Synthetic:
    """Implements `Recording`: 500 Hz states, 100 Hz actions, 20 Hz images. The square's place is `goal`."""

    name: str
    goal: float = 0.0  # -1 .. 1
    seconds: float = 1.0
    start: float = 0.0  # [s] of the first state
    task: str = "wiping"
    arms: tuple[str, ...] = ("right",)
    cameras: Mapping[str, Size] = field(default_factory=lambda: {"front": (48, 64), "wrist": (48, 64)})
    image_rate: float = 20.0
    late: float = 0.0  # [s] by which the images of the second camera are late
    cut: tuple[float, float] | None = None
    stiffness_table: StiffnessTable = "tuned"
    stiffness: Sequence[float] = (500.0, 0, 0, 500, 0, 500, 35, 0, 0, 35, 0, 35)

    @property
    def span(self) -> tuple[float, float]:
        return self.cut or (self.start, np.inf)

    def track(self, arm: str) -> ArmTrack:
        states = self.start + np.arange(0, self.seconds + 1e-9, 0.002)
        actions = self.start + np.arange(0, self.seconds - 0.005, 0.01)
        return ArmTrack(
            state_time=states,
            base_from_tcp=self._poses(states - 0.1),  # lags behind its target
            q=np.outer(states, np.arange(1, 7)),
            q_command=np.outer(states + 0.002, np.arange(1, 7)),
            wrench=np.outer(np.sin(states), np.arange(1, 7)),
            gripper=np.zeros(len(states)),
            action_time=actions,
            base_from_target=self._poses(actions),
            stiffness=np.where(actions[:, None] - self.start < self.seconds / 2, 1.0, 0.5) * self.stiffness,
            gripper_command=np.zeros(len(actions)),
        )

    def image_times(self, camera: str) -> np.ndarray:
        late = self.late if camera == list(self.cameras)[-1] else 0.0
        return self.start + late + np.arange(0, self.seconds - 1e-9, 1 / self.image_rate)

    def image(self, camera: str, index: int) -> np.ndarray:
        height, width = self.cameras[camera]
        picture = np.full((height, width, 3), 40, np.uint8)
        x = int((self.goal + 1) / 2 * (width - 12))
        picture[height // 3 : height // 3 + 12, x : x + 12] = 230
        picture[-height // 4 :] = 5 * index  # so that each image is its own
        return picture

    def _poses(self, times: np.ndarray) -> np.ndarray:
        way = np.clip((times - self.start) / self.seconds, 0, 1)[:, None]
        position = np.array([0.4, 0.0, 0.2]) + way * np.array([0.0, 0.2 * self.goal, -0.1])
        return np.concatenate((position, np.tile(DOWN, (len(times), 1))), axis=1)


def dataset_of(folder: Path, *recordings: Recording, max_size: Size | None = (48, 48)) -> Dataset:
    """Through the cache, as always."""

    def opener(recording: Recording) -> AbstractContextManager[Recording]:
        return nullcontext(recording)

    build(folder, [lambda r=r: opener(r) for r in recordings], max_size=max_size)
    return Dataset(folder)
