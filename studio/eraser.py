"""The eraser of the wiping tasks, and the wavy lines that it wipes off a board."""

from __future__ import annotations

import mujoco
import numpy as np

from controller.types import Array, Pose
from studio.board import Board
from studio.tasks import CameraView, Grasp, World

HALF = np.array([0.015, 0.017])  # [m] half sides of the felt along tool x and y: 3 cm by 3.4 cm
FELT_THICKNESS = 0.008  # [m]
BLOCK_HEIGHT = 0.045  # [m]
MASS = 0.08  # [kg]
CENTER = np.array([0.0, 0.0, -0.0265])  # [m] of mass, from the felt's centre
# Soft felt that stays quiet under FDCC and takes the edge off an impact.
FELT_SOLREF = (0.008, 1.0)
FELT_SOLIMP = (0.5, 0.95, 0.0015, 0.5, 2.0)
FELT_FRICTION = (0.2, 0.005, 0.0001)  # more than 0.2 makes the servoed arm hop

LOW_LAG = 0.36  # [s] by which the tool trails its target at low stiffness (`studio bench --only contact`)

# The tool points down: tool z = -z, tool x (where the fingers close) = -y, tool y = -x of the world.
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLANGE_FROM_FELT = Pose(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0]))  # the felt's centre


class Eraser:
    """Wipes a board's ink away wherever and while its felt presses and moves."""

    def __init__(self, board: Board, board_center: Array, name: str = "eraser") -> None:
        """`board_center` (3,) [m] of the board's top face in the world."""
        self._board = board
        self._board_center = board_center
        self._name = name
        self._felt = np.full(3, np.nan)  # (3,) [m] the felt's centre a period ago, in the world

    def bind(self, world: World) -> None:
        self._felt_geom = world.model.geom(f"{self._name}_felt").id
        self._board_geom = world.model.geom("board").id

    def reset(self, world: World) -> None:
        self._felt = world.pose(self._name).position

    def wipe(self, world: World) -> float:
        """Rub by one control period; returns the normal force [N] on the board."""
        pose = world.pose(self._name)
        force = world.normal_force(self._felt_geom, self._board_geom)
        rub = float(np.linalg.norm((pose.position - self._felt)[:2]))
        self._board.wipe(pose.position - self._board_center, pose.rotation, HALF, 0.0, rub, force)
        self._felt = pose.position
        return force

    def state(self) -> Array:
        return self._felt.copy()

    def restore(self, state: Array) -> None:
        self._felt = np.array(state)


def held(name: str = "eraser") -> Grasp:
    """An eraser in the hand from the start, its felt at the TCP."""
    return Grasp(name, FLANGE_FROM_FELT, MASS, CENTER)


def wrist_camera(arm: str) -> CameraView:
    """Looks past the fingers at the felt's edge and the board ahead of it."""
    return CameraView(
        f"{arm}_wrist",
        np.array([0.0, -0.11, 0.02]),
        np.array([0.0, -0.035, 0.2]),
        fovy=75.0,
        arm=arm,
        up=np.array([0.0, -1.0, 0.0]),
    )


def wavy_line(
    rng: np.random.Generator,
    center: Array,
    length: tuple[float, float],
    wave: tuple[float, float],
    turns: tuple[float, float],
) -> Array:
    """(n, 2) [m] a sine along y around `center` (2,) [m]; its length [m], its amplitude [m] and the number
    of its periods are drawn from ranges.
    """
    drawn_length, amplitude = rng.uniform(*length), rng.uniform(*wave)
    phase, periods = rng.uniform(0, 2 * np.pi), rng.uniform(*turns)
    along = np.linspace(-0.5, 0.5, 40)
    across = amplitude * np.sin(phase + 2 * np.pi * periods * along)
    across -= (across.min() + across.max()) / 2
    line: Array = center + np.stack((across, drawn_length * along), axis=1)
    return line


def add_eraser(spec: mujoco.MjSpec, name: str = "eraser") -> None:
    """A free body, its origin in the middle of the felt's face; geoms `{name}_felt` and `{name}_block`."""
    eraser = spec.worldbody.add_body(name=name, mass=MASS, ipos=CENTER)
    eraser.inertia = (4e-5, 3e-5, 2.5e-5)
    eraser.explicitinertial = True
    eraser.add_freejoint(name=name)
    eraser.add_geom(
        name=f"{name}_felt",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(*HALF, FELT_THICKNESS / 2),
        pos=(0, 0, -FELT_THICKNESS / 2),
        rgba=(0.25, 0.27, 0.30, 1),
        friction=FELT_FRICTION,
        solref=FELT_SOLREF,
        solimp=FELT_SOLIMP,
        priority=2,
    )
    eraser.add_geom(
        name=f"{name}_block",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(*HALF, BLOCK_HEIGHT / 2),
        pos=(0, 0, -FELT_THICKNESS - BLOCK_HEIGHT / 2),
        rgba=(0.85, 0.55, 0.20, 1),
        condim=6,
    )
