"""Two arms that press the erasers in their hands against each other: the bench's two-arm scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import mujoco
import numpy as np

from controller.types import Action, ArmAction, Array, Pose, StiffnessMode
from studio.eraser import FLANGE_FROM_FELT, add_eraser, held
from studio.motion import Motion
from studio.tasks import ArmSetup, CameraView, Progress, World

APART = 0.9  # [m] between the bases, along y
GAP = 0.04  # [m] between the felts at the start
OVERLAP = 0.01  # [m] by which the targets pass each other
APPROACH = 1.0  # [s]
SIDES = {"left": -1.0, "right": 1.0}  # the direction along y in which each tool points


def _setup(name: str, side: float) -> ArmSetup:
    tool = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, side], [0.0, -side, 0.0]])  # z along y of the world
    return ArmSetup(
        name=name,
        base_position=np.array([0.0, -side * APART / 2, 0.0]),
        flange_from_tcp=FLANGE_FROM_FELT,
        world_from_home=Pose.of(tool, np.array([0.5, -side * GAP / 2, 0.3])),
        modes=(StiffnessMode.HIGH, StiffnessMode.LOW),
        workspace=(np.array([0.2, -0.4, 0.1]), np.array([0.8, 0.4, 0.6])),
        grasp=held(f"{name}_eraser"),
    )


def _wrist_camera(arm: str) -> CameraView:
    return CameraView(
        f"{arm}_wrist",
        np.array([0.0, -0.11, 0.02]),
        np.array([0.0, -0.035, 0.2]),
        fovy=75.0,
        arm=arm,
        up=np.array([0.0, -1.0, 0.0]),
    )


class Task:
    name = __name__
    instruction = "Press the two erasers against each other."
    time_limit = 10.0
    arms = tuple(_setup(name, side) for name, side in SIDES.items())
    cameras = (
        CameraView("front", np.array([1.5, 0.0, 0.8]), np.array([0.35, 0.0, 0.25]), fovy=40.0),
        _wrist_camera("left"),
        _wrist_camera("right"),
    )

    def build(self, spec: mujoco.MjSpec) -> None:
        for arm in self.arms:
            add_eraser(spec, f"{arm.name}_eraser")

    def bind(self, world: World) -> None:
        self._felts = [world.model.geom(f"{arm.name}_eraser_felt").id for arm in self.arms]

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        return tuple(arm.world_from_home for arm in self.arms)

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        pass

    def update(self, world: World) -> None:
        pass

    def progress(self, world: World) -> Progress:
        touching = world.normal_force(*self._felts) > 0.0
        return Progress(float(touching), touching, "touching" if touching else "apart")

    def state(self) -> dict[str, Array]:
        return {}

    def restore(self, state: Mapping[str, Array]) -> None:
        pass

    def texture(self) -> None:
        return None

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Press until time is up, left at high stiffness and right at low."""
        presses = [self._press(arm) for arm in self.arms]
        for actions in zip(*presses, strict=True):
            yield Action(actions)

    def _press(self, arm: ArmSetup) -> Iterator[ArmAction]:
        start = Pose(arm.world_from_home.position - arm.base_position, arm.world_from_home.wxyz)
        travel = SIDES[arm.name] * np.array([0.0, (GAP + OVERLAP) / 2, 0.0])
        mode = StiffnessMode.HIGH if arm.name == "left" else StiffnessMode.LOW
        hand = Motion(start, mode, gripper=0.0)
        yield from hand.move(Pose(start.position + travel, start.wxyz), APPROACH)
        yield from hand.wait(self.time_limit - APPROACH)
