"""Single-arm picking and insertion: a wooden peg from the whiteboard's edge into a box that can slide.

The peg lies flat, its square end over the edge. The hand closes on that from above and pushes the peg into
the hole in the side of a box that nothing holds but friction. Under the peg the whiteboard is higher or
lower, and tilted, by a little that its picture does not show. So the peg comes to lie higher or lower between
the fingers, and tilted, than the eye can tell: the rim of the hole pushes back off centre, and the torque at
the wrist says to which side. Who pushes too hard moves the box.

All numbers below were fixed before any policy was trained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from controller.types import Action, ArmAction, Array, Pose, StiffnessMode, quaternion_from_rotation_vector
from studio import models
from studio.insertion import CHAMFER, HOLE_HALF, PEG_HALF
from studio.motion import Motion
from studio.parts import (
    GRIP,
    SURFACE_SOLIMP,
    SURFACE_SOLREF,
    add_block_around,
    add_part,
    add_round_hole,
    add_round_peg,
)
from studio.peg_in_hole import MISJUDGED, MISJUDGED_TURN, PegInHole, Pushing, along, misjudgement
from studio.session import CONTROL_PERIOD
from studio.tasks import ArmSetup, CameraView, Progress, World

# Difficulty; peg and hole are as wide as those of `studio.insertion`
BOARD_LIFT = 0.004  # [m] most by which the whiteboard is higher or lower than usual
BOARD_TILT = math.radians(2.0)  # most by which it is tilted along the peg
PEG_JITTER = np.array([0.003, 0.04])  # [m] of where the peg lies, across the edge and along it
PEG_TURN = math.radians(15.0)
BOX_JITTER = np.array([0.03, 0.04])  # [m] of where the box stands, in x and y
BOX_TURN = math.radians(8.0)
BOX_MASS = 0.8  # [kg]
BOX_FRICTION = 0.5  # on the table: the box slides at 4 N
START_JITTER = 0.02  # [m] on each axis of the start pose

# Success
HOLE_DEPTH = 0.040  # [m]
SEATED = 0.028  # [m] depth of the peg's tip below the mouth
OPEN = 0.5  # opening of the hand from which it counts as open
CLEAR = 0.06  # [m] from the TCP to the middle of the peg's square end
SETTLED = 0.3  # [s] for which all of this holds

# The scene, in the world
BOARD_CENTER = np.array([0.55, -0.16, 0.02])  # [m] top face
BOARD_HALF = np.array([0.15, 0.13, 0.01])  # [m]
EDGE = BOARD_CENTER - np.array([0.143, 0.0, 0.0])  # [m] under the peg's middle, where lift and tilt apply
ONLY_BOARD = 2  # collision bit
HOLE_PLACE = np.array([0.60, 0.10, 0.04])  # [m] the hole's mouth
BOX_HALF = np.array([0.050, 0.040, 0.050])  # [m] across, up and along the hole
RING = 0.037  # [m] outer radius of the ring of boxes that makes the hole
PEG_PLACE = np.array(
    [0.4075, -0.12]
)  # [m] the peg's middle: on the board, but with its square end over the edge
PEG_LENGTH = 0.115  # [m]
PEG_MASS = 0.04  # [kg]
SQUARE_END = np.array(
    [0.015, 0.014, 0.018]
)  # [m] half sides: flat for the fingers, and clear of the board's edge
GRASPED = PEG_LENGTH - SQUARE_END[2]  # [m] from the tip to the middle of the square end
RUNNERS = (-0.008, 0.008)  # [m] where they are across the peg
RUNNER = 0.002  # [m] radius
REST = PEG_HALF + 0.0003  # [m] of the peg's axis above the board: the runners stand out
WOOD, DARK_WOOD = (0.80, 0.60, 0.36, 1.0), (0.62, 0.43, 0.24, 1.0)

# Axes in the world, as columns. The tool points down and its fingers close along y, the peg lies along x, and
# the box opens towards -x.
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
LYING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
STANDING = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
FLANGE_FROM_TCP = Pose(np.array([0.0, 0.0, GRIP]), np.array([1.0, 0.0, 0.0, 0.0]))  # between the pads

# The demonstrator
GRASP_ERROR = np.array([0.003, 0.002, 0.0007])  # [m] along the peg, across it and in height
GRASP_TURN_ERROR = math.radians(1.0)
FIT = PegInHole(
    hole="box",
    hole_from_peg=Pose.of(STANDING.T @ LYING, np.zeros(3)),
    arm="right",
    seated=SEATED,
    pushed=0.036,
    sag=PEG_MASS * 9.81 / 250.0,  # at low stiffness
)


@dataclass(frozen=True, slots=True)
class Style:
    """How one of two demonstrators goes about it."""

    over: float  # [m] above the peg before descending
    lift: float  # [m]
    detour: Array  # (3,) [m] from the place in front of the box, on the way there
    gap: float  # [m] in front of the box before the push
    how: Pushing


STYLES = (
    Style(0.07, 0.06, np.array([-0.06, -0.01, 0.04]), gap=0.020, how=Pushing(speed=0.025, pause=0.35)),
    Style(0.10, 0.09, np.array([0.0, 0.0, 0.05]), gap=0.035, how=Pushing(speed=0.032, pause=0.45)),
)


class Task:
    name = "pick-insert"
    instruction = "Pick up the peg and insert it in the hole of the box."
    time_limit = 45.0
    arms = (
        ArmSetup(
            name="right",
            base_position=np.zeros(3),
            flange_from_tcp=FLANGE_FROM_TCP,
            world_from_home=Pose.of(DOWN, np.array([0.28, -0.02, 0.22])),
            modes=(StiffnessMode.MEDIUM, StiffnessMode.LOW),
            workspace=(np.array([0.18, -0.30, 0.01]), np.array([0.70, 0.30, 0.45])),
        ),
    )
    cameras = (
        CameraView("front", np.array([1.12, 0.0, 0.62]), np.array([0.52, -0.02, 0.03]), fovy=33.0),
        # Looks ahead, at the box and past the held peg: how that lies between the fingers is not to be seen.
        CameraView(
            "right_wrist",
            np.array([0.0, -0.09, 0.01]),
            np.array([0.0, -0.20, 0.15]),
            fovy=62.0,
            arm="right",
            up=np.array([0.0, -1.0, 0.0]),
        ),
    )

    def __init__(self) -> None:
        self._settled = 0.0  # [s] for which the peg has been in the hole, with the hand open and clear

    def build(self, spec: mujoco.MjSpec) -> None:
        _add_board(spec)
        _add_peg(spec)
        box = add_part(spec, "box", BOX_MASS, np.array([0.0, 0.0, -BOX_HALF[2]]), extent=0.10)
        box.pos, box.quat = HOLE_PLACE, Pose.of(STANDING, np.zeros(3)).wxyz
        add_round_hole(box, HOLE_HALF, HOLE_DEPTH, RING, DARK_WOOD)
        add_block_around(box, BOX_HALF, RING, HOLE_DEPTH, DARK_WOOD, BOX_FRICTION)

    def bind(self, world: World) -> None:
        model = world.model
        self._pads = np.zeros(model.ngeom, bool)
        self._pads[[model.geom(f"right_hand_{pad}").id for pad in models.PADS]] = True
        self._peg = world.geoms_of("peg")

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        jitter = rng.uniform(-START_JITTER, START_JITTER, 3) * spread
        home = self.arms[0].world_from_home
        return (Pose(home.position + jitter, home.wxyz),)

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        lift = rng.uniform(-BOARD_LIFT, BOARD_LIFT) * spread
        tilt = rng.uniform(-BOARD_TILT, BOARD_TILT) * spread
        # Not wider across the edge: it would fall off, or the fingers would meet the board.
        place = PEG_PLACE + rng.uniform(-PEG_JITTER, PEG_JITTER) * np.array([1.0, spread])
        turn = rng.uniform(-PEG_TURN, PEG_TURN) * spread
        mouth = HOLE_PLACE + np.append(rng.uniform(-BOX_JITTER, BOX_JITTER) * spread, 0.0)
        box_turn = rng.uniform(-BOX_TURN, BOX_TURN) * spread

        world_from_edge = Pose(
            EDGE + np.array([0.0, 0.0, lift]), quaternion_from_rotation_vector(np.array([0.0, tilt, 0.0]))
        )
        board = world.model.body("board").mocapid
        world.data.mocap_pos[board], world.data.mocap_quat[board] = (
            world_from_edge.position,
            world_from_edge.wxyz,
        )
        middle = np.append(place - EDGE[:2], REST)
        world.place("peg", world_from_edge @ _turned(LYING, turn, middle) @ along(PEG_LENGTH / 2))
        world.place("box", _turned(STANDING, box_turn, mouth))
        self._settled = 0.0

    def update(self, world: World) -> None:
        done = FIT.inside(world) >= SEATED and self._is_released(world)
        self._settled = self._settled + CONTROL_PERIOD if done else 0.0

    def progress(self, world: World) -> Progress:
        """Half for the way to the hole, three tenths for the depth, the rest for letting go."""
        if self._settled >= SETTLED - CONTROL_PERIOD / 2:
            return Progress(1.0, True, "inserted")
        depth = FIT.inside(world)
        if depth >= SEATED:
            return Progress(0.8, False, "let go")
        if depth > 0.0:
            return Progress(0.5 + 0.3 * depth / SEATED, False, "inserting")
        if not world.touches(self._pads, self._peg):
            return Progress(0.0, False, "pick the peg")
        away = float(np.linalg.norm(FIT.place(world).position))
        phase = "at the rim" if away < 0.03 else "to the box"
        return Progress(0.5 - 0.3 * min(1.0, away / 0.2), False, phase)

    def state(self) -> dict[str, Array]:
        return {"settled": np.array([self._settled])}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._settled = float(state["settled"][0])

    def texture(self) -> None:
        return None

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Pick, carry, feel for the hole, correct, push until seated, let go, clear off."""
        style = STYLES[rng.integers(len(STYLES))]
        home = world.tcp("right")
        speed = rng.uniform(0.85, 1.2)
        hand = Motion(home, StiffnessMode.MEDIUM, gripper=1.0, table=world.table, speed=speed)
        for part in (
            _pick(world, hand, style, rng),
            _insert(world, hand, style, rng),
            _let_go(hand, style, rng),
            hand.move(home, rng.uniform(1.7, 2.2)),
            hand.wait(0.8),
        ):
            for action in part:
                yield Action((action,))

    def _is_released(self, world: World) -> bool:
        closed = world.data.joint("right_hand_right_driver_joint").qpos[0] / models.GRIPPER_CLOSED
        away = float(np.linalg.norm(world.tcp("right").position - _square_end(world)))
        return bool(1.0 - closed >= OPEN) and away >= CLEAR and not world.touches(self._pads, self._peg)


def _pick(world: World, hand: Motion, style: Style, rng: np.random.Generator) -> Iterator[ArmAction]:
    """As high as the square end is if the whiteboard is where it usually is."""
    forward = world.pose("peg").rotation[:, 2]
    yaw = math.atan2(forward[1], forward[0])
    error = _turned(np.eye(3), yaw, np.zeros(3)).apply(rng.uniform(-GRASP_ERROR, GRASP_ERROR))
    place = np.append(_square_end(world)[:2], BOARD_CENTER[2] + PEG_HALF) + error
    grasp = _turned(DOWN, yaw + rng.uniform(-GRASP_TURN_ERROR, GRASP_TURN_ERROR), place)
    yield from hand.move(_raised(grasp, style.over * rng.uniform(0.85, 1.15)), rng.uniform(1.6, 2.1))
    yield from hand.move(grasp, rng.uniform(1.0, 1.3))
    yield from hand.wait(0.9)
    yield from hand.grip(0.0, rng.uniform(0.8, 1.1))
    yield from hand.wait(0.3)
    yield from hand.move(_raised(grasp, style.lift), rng.uniform(0.9, 1.2))


def _insert(world: World, hand: Motion, style: Style, rng: np.random.Generator) -> Iterator[ArmAction]:
    """To in front of the hole and in, at first as if the peg were held level and in the middle of the pads.

    How far its tip is ahead of the hand can be seen, and so can the box.
    """
    ahead = float(np.linalg.norm((world.pose("peg").position - world.tcp("right").position)[:2]))
    peg_from_tcp = Pose.of(LYING.T @ DOWN, np.array([0.0, 0.0, -ahead]))
    mouth = world.pose("box") @ misjudgement(rng, MISJUDGED, MISJUDGED_TURN)
    before = FIT.target(mouth, peg_from_tcp, -style.gap * rng.uniform(0.85, 1.15))
    detour = Pose(before.position + style.detour * rng.uniform(0.7, 1.3), before.wxyz)
    yield from hand.move(detour, rng.uniform(1.8, 2.3))
    yield from hand.move(before, rng.uniform(1.0, 1.3))
    yield from hand.wait(style.how.pause * rng.uniform(1.0, 1.4))
    hand.mode = StiffnessMode.LOW
    yield from FIT.feel_in(world, hand, mouth, peg_from_tcp, style.how, rng)


def _let_go(hand: Motion, style: Style, rng: np.random.Generator) -> Iterator[ArmAction]:
    yield from hand.wait(0.2)
    yield from hand.grip(1.0, rng.uniform(0.5, 0.8))
    yield from hand.wait(0.2)
    hand.mode = StiffnessMode.MEDIUM
    yield from hand.move(_raised(hand.pose, 0.10), rng.uniform(0.9, 1.2))
    yield from hand.wait(style.how.pause)


def _square_end(world: World) -> Array:
    """(3,) [m] the middle of the end by which the peg is held."""
    return world.pose("peg").apply(np.array([0.0, 0.0, -GRASPED]))


def _turned(axes: Array, yaw: float, position: Array) -> Pose:
    """At `position` (3,) [m], with `axes` (3, 3) turned by `yaw` [rad] about the vertical."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return Pose.of(np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ axes, position)


def _raised(pose: Pose, height: float) -> Pose:
    return Pose(pose.position + np.array([0.0, 0.0, height]), pose.wxyz)


def _add_board(spec: mujoco.MjSpec) -> None:
    """An unseen plate that lies where an instance puts it, about `EDGE`, and its picture, which stays."""
    board = spec.worldbody.add_body(name="board", pos=EDGE, mocap=True)
    plate = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": BOARD_HALF}
    center = BOARD_CENTER - np.array([0.0, 0.0, BOARD_HALF[2]])
    board.add_geom(name="board", pos=center - EDGE, rgba=(0, 0, 0, 0), conaffinity=1 | ONLY_BOARD, **plate)
    spec.worldbody.add_geom(
        name="board_picture", pos=center, rgba=(0.92, 0.93, 0.94, 1), contype=0, conaffinity=0, **plate
    )


def _add_peg(spec: mujoco.MjSpec) -> None:
    """A round shaft with a square end, and two unseen runners on which it lies: on its back it would roll."""
    peg = add_part(spec, "peg", PEG_MASS, np.array([0.0, 0.0, -PEG_LENGTH / 2]), extent=0.07)
    peg.pos = (*PEG_PLACE, 0.2)
    shaft = PEG_LENGTH - 2 * SQUARE_END[2]
    add_round_peg(peg, PEG_HALF, shaft, CHAMFER, WOOD)
    peg.add_geom(
        name="peg_square",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=SQUARE_END,
        pos=(0, 0, -GRASPED),
        rgba=WOOD,
        mass=0,
    )
    y = RUNNER - REST
    for x in RUNNERS:
        peg.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(x, y, -RUNNER, x, y, -shaft),
            size=(RUNNER, 0, 0),
            rgba=(0, 0, 0, 0),
            solref=SURFACE_SOLREF,
            solimp=SURFACE_SOLIMP,
            priority=1,
            contype=ONLY_BOARD,
            conaffinity=0,
            mass=0,
        )
