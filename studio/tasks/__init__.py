"""What a task is. Each module of this package is one task and ends with a `Task` class.

A task describes its scene (arms, cameras, objects), how an instance is drawn from a seed, when it counts as
done, and how it can be demonstrated. `load` and `names` find tasks by file, so that a new task is one new
file here.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import mujoco
import numpy as np

from controller.stiffness import StiffnessTable
from controller.types import Action, Array, Pose, StiffnessMode, quaternion_from_rotation_vector

HELD_SUCCESS = 0.5  # [s] for which success must hold to end a rollout, or a take while collecting


@dataclass(frozen=True, slots=True)
class Grasp:
    """A part that an arm already holds when an episode starts, by friction between the finger pads."""

    body: str  # name of a body with a free joint
    flange_from_body: Pose
    mass: float  # [kg] payload whose weight the F/T sensor compensates
    center: Array  # (3,) [m] centre of mass in the body's frame
    # How differently the part may lie in the hand at each reset, uniformly. Flat pads leave these two free.
    offset: float = 0.0  # [m] along the body's y
    tilt: float = 0.0  # [rad] about the body's x

    def draw(self, rng: np.random.Generator, spread: float) -> Pose:
        """flange_from_body at a reset."""
        if self.offset == 0.0 and self.tilt == 0.0:
            return self.flange_from_body
        offset, tilt = rng.uniform(-1.0, 1.0, 2) * np.array([self.offset, self.tilt]) * spread
        turn = quaternion_from_rotation_vector(np.array([tilt, 0.0, 0.0]))
        return self.flange_from_body @ Pose(np.array([0.0, offset, 0.0]), turn)


@dataclass(frozen=True, slots=True)
class ArmSetup:
    """One arm of a task. Base axes are parallel to the world's."""

    name: str  # "left" or "right"
    base_position: Array  # (3,) [m] in the world
    flange_from_tcp: Pose
    world_from_home: Pose  # TCP at the start of an episode, before jitter
    modes: tuple[StiffnessMode, StiffnessMode]  # the two that the operator switches between
    workspace: tuple[Array, Array]  # lower and upper corner for the target [m], in the world
    grasp: Grasp | None = None
    gripper: float = 1.0  # opening at the start where nothing is held
    near: Array | None = (
        None  # (6,) [rad] joints near home, where an elbow up and a hand in front is not meant
    )


@dataclass(frozen=True, slots=True)
class CameraView:
    """A camera of the scene, fixed in the world or on an arm's flange."""

    name: str
    position: Array  # (3,) [m] in the world or in the flange frame
    look_at: Array  # (3,) [m] in the same frame
    fovy: float  # [deg]
    arm: str | None = None  # name of the arm that carries it
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a task is, for the page and the success test."""

    value: float  # 0 .. 1
    success: bool
    phase: str  # one or two words for the operator


@dataclass(frozen=True, slots=True)
class World:
    """The simulation as a task sees it. Only scripts and success tests may read it, never a policy."""

    model: mujoco.MjModel
    data: mujoco.MjData
    arms: tuple[ArmSetup, ...]
    table: StiffnessTable = "tuned"  # of the modes that a demonstrator switches between

    def pose(self, body: str) -> Pose:
        """world_from_body."""
        view = self.data.body(body)
        return Pose(view.xpos.copy(), view.xquat.copy())

    def tcp(self, arm: str) -> Pose:
        """world_from_tcp of an arm, as measured."""
        view = self.data.site(f"{arm}_tcp")
        return Pose.of(view.xmat.reshape(3, 3), view.xpos)

    def place(self, body: str, pose: Pose) -> None:
        """Put a free body at rest at world_from_body."""
        joint = self.data.joint(body)
        joint.qpos[:] = pose.vector
        joint.qvel[:] = 0.0

    def geoms_of(self, body: str) -> Array:
        """(ngeom,) bool"""
        return np.asarray(self.model.geom_bodyid == self.model.body(body).id)

    def touches(self, some: Array, others: Array) -> bool:
        """Whether any of `some` geoms touches any of `others`, each (ngeom,) bool."""
        first, second = self.data.contact.geom.T
        return bool(((some[first] & others[second]) | (some[second] & others[first])).any())

    def normal_force(self, geom: int, other: int) -> float:
        """Summed normal force [N] between two geoms, by id."""
        pairs = self.data.contact.geom
        touching = ((pairs[:, 0] == geom) & (pairs[:, 1] == other)) | (
            (pairs[:, 0] == other) & (pairs[:, 1] == geom)
        )
        addresses = self.data.contact.efc_address[touching]
        # An elliptic cone's first row is the normal force.
        return float(self.data.efc_force[addresses[addresses >= 0]].sum())


class Task(Protocol):
    """One manipulation task. The instance owns what MuJoCo does not hold (ink, phases)."""

    name: str
    instruction: str
    arms: tuple[ArmSetup, ...]
    cameras: tuple[CameraView, ...]
    time_limit: float  # [s] of an episode

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the scene's bodies; the arms are there already."""

    def bind(self, world: World) -> None:
        """Called once after compilation: look up ids."""

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        """Draw one instance: place objects, draw marks. `spread` above 1 widens the randomisation."""

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        """world_from_tcp of each arm at the start."""

    def update(self, world: World) -> None:
        """After each control period: ink, phases."""

    def progress(self, world: World) -> Progress: ...

    def state(self) -> dict[str, Array]:
        """Everything that the instance owns, by name; exact."""

    def restore(self, state: Mapping[str, Array]) -> None: ...

    def texture(self) -> tuple[str, Array] | None:
        """Name of the texture that the task paints and its (h, w, 3) uint8 picture, or None."""

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Actions at the control rate. May read the world; ends when the demonstration is over."""


def names() -> list[str]:
    """All tasks by name."""
    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__))


def load(name: str) -> Task:
    """A new instance of the task called `name`, or of the one in our own module of that full name.

    A take's header names its task, so no other module than ours is ever imported.
    """
    if name.startswith("studio."):
        return _task_in(name)
    if name not in names():
        raise KeyError(f"No task {name!r}; there are {names()}.")
    return _task_in(f"{__name__}.{name.replace('-', '_')}")


def _task_in(module: str) -> Task:
    try:
        task: Task = importlib.import_module(module).Task()
    except ModuleNotFoundError as error:
        raise KeyError(f"No task {module!r}: {error.msg}; there are {names()}.") from error
    return task
