"""Two-armed wiping: the left hand lifts the hammer, the right wipes the dirt under it, the hammer goes back.

The hammer lies on a board, turned by up to 15 degrees, on a smear of dirt whose shape and place change. It
counts as back only where it was put down: a hammer that leaves the hand in the air has been dropped. All
numbers below were fixed before any policy was trained.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from controller.types import (
    Action,
    ArmAction,
    Array,
    Pose,
    StiffnessMode,
    quaternion_from_rotation_vector,
    rotation_vector,
)
from studio import eraser, models
from studio.board import Board
from studio.motion import Motion, together
from studio.parts import GRIP, HANDLE_WIDTH, RIB_APART, RIB_RADIUS, RIB_SOLIMP, RIB_SOLREF, Rgba
from studio.tasks import ArmSetup, CameraView, Progress, World

# Difficulty: the dirt is at most 28 mm across and the felt 34 mm, so a wipe that is 1 cm off leaves some.
HAMMER_TURN = math.radians(15.0)  # of the hammer about the vertical
HAMMER_JITTER = 0.02  # [m] of its place, in x and in y
DIRT_OFFSET = 0.012  # [m] of the dirt's middle from the hammer's, in x and in y
DIRT_LENGTH = (0.05, 0.08)  # [m] along y
DIRT_WAVE = (0.004, 0.009)  # [m] amplitude across the line
DIRT_TURNS = (0.7, 2.0)  # periods of the wave
DIRT_RADIUS = (0.003, 0.005)  # [m] of the smear
START_JITTER = 0.015  # [m] of each hand's start, on each axis

# Success
CLEAR = 0.06  # [m] by which the hammer must have been lifted
WIPED_ENOUGH = 0.9  # share of the dirt's cells
BACK = 0.03  # [m] from where the hammer lay, along the board
BACK_TURN = math.radians(15.0)  # from how it lay
RESTING = 0.01  # [m] above where it lay: any higher, and the hand must hold it

# Scene
BOARD_CENTER = np.array([0.45, 0.0, 0.02])  # [m] top face
APART = 0.9  # [m] between the arms' bases
# The hammer's axes: x along the handle towards the head, z up as it lies, the origin at its centre of mass.
HEAD, TAIL = 0.055, -0.12  # [m] middles of the head and of the handle's end, along x
HEAD_HALF = np.array([0.014, 0.042, 0.018])  # [m]
TAIL_HALF = np.array([0.010, 0.014, 0.018])  # [m]
HAMMER_CORNERS = np.array(  # (16, 3) [m]
    [
        [x, 0.0, 0.0] + half * np.array(signs)
        for x, half in ((HEAD, HEAD_HALF), (TAIL, TAIL_HALF))
        for signs in itertools.product((-1, 1), repeat=3)
    ]
)
HAMMER_MASS = 0.42  # [kg]
HAMMER_INERTIA = (2.2e-4, 2.2e-3, 2.3e-3)  # [kg·m²]
STEEL, WOOD = (0.36, 0.38, 0.42, 1.0), (0.72, 0.50, 0.28, 1.0)

# The left fingers close along x of the world, across the handle; its head points to the right arm.
LEFT_TOOL = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
FLANGE_FROM_PADS = Pose(np.array([0.0, 0.0, GRIP]), np.array([1.0, 0.0, 0.0, 0.0]))
HAMMER_FROM_TOOL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
GRASP_HEIGHT = 0.005  # [m] of the pads' middle above the hammer's axis: the fingertips clear the board

# The demonstrator
GRASP_ERROR = 0.004  # [m] along the handle
SAG = HAMMER_MASS * 9.81 / 500.0  # [m] by which the hammer pulls the hand down at medium stiffness
ASIDE = 0.27  # [m] by which the hammer is held off to the left


@dataclass(frozen=True, slots=True)
class Style:
    """How one of two demonstrators does it."""

    lift: float  # [m]
    depth: float  # [m] of the eraser's target below the board
    speed: float  # [m/s] of the strokes' target
    strokes: int
    waits: bool  # the right hand stays home until the hammer is aside, instead of coming closer meanwhile


STYLES = (
    Style(lift=0.12, depth=0.013, speed=0.06, strokes=2, waits=True),
    Style(lift=0.16, depth=0.015, speed=0.07, strokes=3, waits=False),
)


class Task:
    name = "bimanual-wiping"
    instruction = "Lift the hammer with the left hand, wipe the dirt under it, and put the hammer back."
    time_limit = 45.0
    arms = (
        ArmSetup(
            name="left",
            base_position=np.array([0.0, APART / 2, 0.0]),
            flange_from_tcp=FLANGE_FROM_PADS,
            world_from_home=Pose.of(LEFT_TOOL, np.array([0.45, 0.22, 0.20])),
            modes=(StiffnessMode.MEDIUM, StiffnessMode.MEDIUM),
            workspace=(np.array([0.20, -0.20, 0.02]), np.array([0.70, 0.45, 0.45])),
        ),
        ArmSetup(
            name="right",
            base_position=np.array([0.0, -APART / 2, 0.0]),
            flange_from_tcp=eraser.FLANGE_FROM_FELT,
            world_from_home=Pose.of(eraser.DOWN, np.array([0.45, -0.25, 0.16])),
            modes=(StiffnessMode.MEDIUM, StiffnessMode.LOW),
            workspace=(np.array([0.20, -0.45, -0.03]), np.array([0.70, 0.20, 0.45])),
            grasp=eraser.held(),
        ),
    )
    cameras = (
        CameraView("front", np.array([1.05, 0.0, 0.66]), np.array([0.42, 0.04, 0.09]), fovy=39.0),
        eraser.wrist_camera("right"),
    )

    def __init__(self) -> None:
        self.board = Board()
        self._eraser = eraser.Eraser(self.board, BOARD_CENTER)
        self._dirt = np.zeros((2, 2))  # (n, 2) [m] polyline in board axes
        self._cells = 0  # of dirt at the start
        self._place = Pose.identity()  # world_from_hammer at the start
        self._lifted = False
        self._dropped = False

    def build(self, spec: mujoco.MjSpec) -> None:
        Board.build(spec, BOARD_CENTER)
        eraser.add_eraser(spec)
        _add_hammer(spec)

    def bind(self, world: World) -> None:
        self._eraser.bind(world)
        self._hammer = world.geoms_of("hammer")
        self._fingers = []
        for side in ("left", "right"):
            finger = np.zeros(world.model.ngeom, bool)
            for pad in (pad for pad in models.PADS if pad.startswith(side)):
                finger[world.model.geom(f"left_hand_{pad}").id] = True
            self._fingers.append(finger)

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        return tuple(
            Pose(
                arm.world_from_home.position + rng.uniform(-START_JITTER, START_JITTER, 3) * spread,
                arm.world_from_home.wxyz,
            )
            for arm in self.arms
        )

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        place = rng.uniform(-HAMMER_JITTER, HAMMER_JITTER, 2) * spread
        turn = rng.uniform(-HAMMER_TURN, HAMMER_TURN) * spread - math.pi / 2
        self._place = Pose(
            BOARD_CENTER + np.append(place, HEAD_HALF[2]),
            quaternion_from_rotation_vector(np.array([0.0, 0.0, turn])),
        )
        world.place("hammer", self._place)
        under = place + rng.uniform(-DIRT_OFFSET, DIRT_OFFSET, 2) * spread
        self._dirt = eraser.wavy_line(rng, under, DIRT_LENGTH, DIRT_WAVE, DIRT_TURNS)
        self.board.clear()
        self.board.draw(self._dirt, rng.uniform(*DIRT_RADIUS))
        self._cells = self.board.inked()
        self._lifted = self._dropped = False
        self._eraser.reset(world)

    def update(self, world: World) -> None:
        self._eraser.wipe(world)
        height = self._height(world)
        self._lifted |= height >= CLEAR
        if self._lifted and height > RESTING and not all(self._touching(world)):
            self._dropped = True

    def progress(self, world: World) -> Progress:
        """A fifth for lifting, three fifths for wiping, a fifth for putting back."""
        wiped = 1.0 - self.board.inked() / max(self._cells, 1)
        is_clean = wiped >= WIPED_ENOUGH
        is_back = self._lifted and self._is_back(world)
        value = 0.2 * min(1.0, max(0.0, self._height(world)) / CLEAR) if not self._lifted else 0.2
        value += 0.6 * min(1.0, wiped / WIPED_ENOUGH) + 0.2 * (is_clean and is_back)
        if self._dropped:
            return Progress(min(value, 0.8), False, "dropped")
        if is_clean and is_back:
            return Progress(1.0, True, "done")
        if not self._lifted:
            return Progress(value, False, "lift the hammer")
        return Progress(value, False, "put it back" if is_clean else "wipe")

    def state(self) -> dict[str, Array]:
        return {
            **self.board.state(),
            "dirt": self._dirt.copy(),
            "place": self._place.vector,
            "wiping": np.array([self._cells, self._lifted, self._dropped], float),
            "felt": self._eraser.state(),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        self.board.restore(state)
        self._dirt = np.array(state["dirt"])
        self._place = Pose.from_vector(state["place"])
        cells, lifted, dropped = state["wiping"].tolist()
        self._cells, self._lifted, self._dropped = int(cells), bool(lifted), bool(dropped)
        self._eraser.restore(state["felt"])

    def texture(self) -> tuple[str, Array]:
        return Board.TEXTURE, self.board.picture()

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Pick, lift and hold aside; wipe at low stiffness; put back, let go, both hands home."""
        style = STYLES[rng.integers(len(STYLES))]
        speed = rng.uniform(0.85, 1.2)
        home = [world.tcp(arm.name) for arm in self.arms]
        left, right = hands = [
            Motion(pose, StiffnessMode.MEDIUM, gripper, world.table, speed, arm.base_position)
            for pose, gripper, arm in zip(home, (1.0, 0.0), self.arms, strict=True)
        ]
        error = rng.uniform(-GRASP_ERROR, GRASP_ERROR)
        grasp = world.pose("hammer") @ Pose.of(HAMMER_FROM_TOOL, np.array([error, 0.0, GRASP_HEIGHT]))
        lift = style.lift * rng.uniform(0.9, 1.1)
        aside = _raised(grasp, lift, np.array([rng.uniform(-0.02, 0.02), ASIDE, 0.0]))

        yield from together(hands, self._pick(left, grasp, lift, rng))
        seconds = rng.uniform(1.8, 2.3)
        at_edge = Pose(home[1].position + np.array([0.0, 0.09, -0.03]), home[1].wxyz)
        closer = () if style.waits else (right.move(at_edge, seconds),)
        yield from together(hands, left.move(aside, seconds), *closer)
        yield from together(hands, self._wipe(right, style, rng))
        yield from together(hands, right.move(home[1], rng.uniform(1.6, 2.0)))
        yield from together(hands, self._put_back(left, grasp, lift, rng))
        yield from together(hands, left.move(home[0], rng.uniform(1.3, 1.7)))
        yield from together(hands, left.wait(0.8))

    @staticmethod
    def _pick(hand: Motion, grasp: Pose, lift: float, rng: np.random.Generator) -> Iterator[ArmAction]:
        yield from hand.move(_raised(grasp, 0.08), rng.uniform(1.7, 2.2))
        yield from hand.move(grasp, rng.uniform(1.0, 1.3))
        yield from hand.wait(rng.uniform(0.5, 0.7))
        yield from hand.grip(0.0, rng.uniform(0.6, 0.9))
        yield from hand.wait(0.3)
        yield from hand.move(_raised(grasp, lift), rng.uniform(1.3, 1.7))

    @staticmethod
    def _put_back(hand: Motion, grasp: Pose, lift: float, rng: np.random.Generator) -> Iterator[ArmAction]:
        yield from hand.move(_raised(grasp, lift), rng.uniform(1.8, 2.3))
        yield from hand.wait(rng.uniform(0.4, 0.6))
        yield from hand.move(_raised(grasp, SAG + 0.004), rng.uniform(1.4, 1.8))
        yield from hand.wait(0.3)
        yield from hand.move(_raised(grasp, 0.5 * SAG), rng.uniform(0.5, 0.7))
        yield from hand.wait(rng.uniform(0.4, 0.6))
        yield from hand.grip(1.0, rng.uniform(0.6, 0.9))
        yield from hand.move(_raised(grasp, 0.10), rng.uniform(1.0, 1.3))

    def _wipe(self, hand: Motion, style: Style, rng: np.random.Generator) -> Iterator[ArmAction]:
        """To and fro along the middle of the dirt, each stroke from beyond one end to beyond the other."""
        dirt = BOARD_CENTER[:2] + self._dirt
        low, high = dirt.min(axis=0), dirt.max(axis=0)
        beyond = eraser.HALF[0] + 0.012  # [m] of the felt's middle, so that all of the felt leaves the dirt
        ends = [
            np.array([(low[0] + high[0]) / 2, y, BOARD_CENTER[2]])
            for y in (low[1] - beyond, high[1] + beyond)
        ]
        depth = style.depth * rng.uniform(0.9, 1.1)
        begin = Pose(ends[0], hand.pose.wxyz)
        yield from hand.move(_raised(begin, rng.uniform(0.045, 0.07)), rng.uniform(1.6, 2.0))
        yield from hand.move(_raised(begin, 0.006), rng.uniform(0.8, 1.0))
        yield from hand.wait(0.35)
        hand.mode = StiffnessMode.LOW
        yield from hand.move(_raised(begin, -depth), 0.5)
        yield from hand.wait(0.3)
        for stroke in range(style.strokes):
            start, end = ends[stroke % 2], ends[(stroke + 1) % 2]
            path = np.linspace(start, end, 4)[1:] - np.array([0.0, 0.0, depth])
            path += rng.normal(0.0, 0.001, path.shape) * np.array([1.0, 1.0, 0.3])
            lag = eraser.LOW_LAG * style.speed * (end - start) / np.linalg.norm(end - start)
            yield from hand.follow(np.vstack((path, path[-1] + lag)), style.speed)
        yield from hand.wait(0.2)
        hand.mode = StiffnessMode.MEDIUM
        yield from hand.move(_raised(hand.pose, 0.09), rng.uniform(0.8, 1.1))

    def _height(self, world: World) -> float:
        """[m] of the hammer's lowest point above the board."""
        pose = world.pose("hammer")
        return float(pose.apply(HAMMER_CORNERS)[:, 2].min() - BOARD_CENTER[2])

    def _is_back(self, world: World) -> bool:
        """Lying where it lay, with nothing in the hand."""
        moved = self._place.inverse() @ world.pose("hammer")
        turn = float(np.linalg.norm(rotation_vector(moved.wxyz)))
        is_there = float(np.linalg.norm(moved.position)) <= BACK and turn <= BACK_TURN
        return is_there and self._height(world) <= RESTING and not any(self._touching(world))

    def _touching(self, world: World) -> list[bool]:
        """Whether each finger of the left hand touches the hammer."""
        return [world.touches(finger, self._hammer) for finger in self._fingers]


def _raised(pose: Pose, height: float, shift: Array | None = None) -> Pose:
    """`height` [m] further up, and shifted (3,) [m], in world axes."""
    up = np.array([0.0, 0.0, height])
    return Pose(pose.position + up + (np.zeros(3) if shift is None else shift), pose.wxyz)


def _add_hammer(spec: mujoco.MjSpec) -> None:
    """A free body: a steel head and a wooden handle with rails for the finger pads."""
    hammer = spec.worldbody.add_body(name="hammer", mass=HAMMER_MASS, ipos=(0, 0, 0), pos=BOARD_CENTER)
    hammer.inertia = HAMMER_INERTIA
    hammer.explicitinertial = True
    hammer.add_freejoint(name="hammer")
    for x, half, rgba in ((HEAD, HEAD_HALF, STEEL), (TAIL, TAIL_HALF, WOOD)):
        hammer.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=(x, 0, 0), rgba=rgba, condim=4, mass=0)
    _add_rails(hammer, TAIL, HEAD, WOOD)


def _add_rails(body: mujoco.MjsBody, start: float, end: float, rgba: Rgba) -> None:
    """Two rails on each side, from x = `start` to `end` [m], and the wood that they stand on."""
    half = HANDLE_WIDTH / 2 - RIB_RADIUS
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=((end - start) / 2, half, RIB_APART / 2),
        pos=((start + end) / 2, 0, 0),
        rgba=rgba,
        contype=0,
        conaffinity=0,
        mass=0,
    )
    for y in (-half, half):
        for z in (-RIB_APART / 2, RIB_APART / 2):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=(start, y, z, end, y, z),
                size=(RIB_RADIUS, 0, 0),
                rgba=rgba,
                condim=4,
                friction=models.PAD_FRICTION,
                solref=RIB_SOLREF,
                solimp=RIB_SOLIMP,
                priority=1,
                mass=0,
            )
