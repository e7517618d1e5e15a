"""Putting a peg into a hole with two arms: what `peg-cylinder` and `peg-cuboid` have in common.

The right hand holds the peg, the left hand the part with the hole, each by friction between flat pads. How a
part lies in its hand differs at every reset, across the hand and by a tilt, and the two hands are a quarter
turn apart, so that together the parts miss each other in a direction and by an amount that nobody knows
before they touch: the rim pushes back off centre, and the torque at the wrist says to which side.

The numbers of the difficulty and of success below were fixed before any policy was trained.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from controller.types import Action, Array, Pose, StiffnessMode, quaternion_from_rotation_vector
from studio import models
from studio.motion import Motion, together
from studio.parts import GRIP, add_handle, add_part
from studio.peg_in_hole import MISJUDGED, MISJUDGED_TURN, PegInHole, Pushing, misjudgement
from studio.session import CONTROL_PERIOD
from studio.tasks import ArmSetup, CameraView, Grasp, Progress, World

# Difficulty
TOLERANCE = 0.002  # [m] by which the hole's diameter or width exceeds the peg's
PEG_HALF = 0.015  # [m] radius or half side of the peg
HOLE_HALF = PEG_HALF + TOLERANCE / 2  # [m]
CHAMFER = 0.0012  # [m] radius of the peg's edge; the hole's edge is sharp
GRASP_OFFSET = 0.006  # [m] most by which a part lies off the middle of its hand, each along its hand's y
GRASP_TILT = math.radians(1.5)  # most by which it is tilted, each about its hand's x
START_JITTER = 0.015  # [m] of each hand's start on each axis
START_TURN = math.radians(3.0)  # of each hand's start about each axis
MEETING_JITTER = 0.03  # [m] of the place where the parts meet, on each axis
MEETING_TURN = np.radians([5.0, 5.0, 8.0])  # of its orientation, about the world's axes

# Success
HOLE_DEPTH = 0.030  # [m]
SEATED = 0.022  # [m] depth of the peg's tip below the mouth
HELD = 0.5  # [s] during which the peg is seated and both parts are held
HOLDS = 0.5  # [N] each finger of a hand that holds its part presses at least so hard

# Parts
OUTER = 0.030  # [m] radius or half side of the part with the hole
PEG_LENGTH = 0.038  # [m] of the peg's shaft
REACH = 0.214  # [m] from the flange to the peg's tip and to the hole's mouth
PEG_MASS, HOLE_MASS = 0.06, 0.12  # [kg]
PEG_CENTER, HOLE_CENTER = np.array([0.0, 0.0, -0.035]), np.array([0.0, 0.0, -0.03])  # [m]
PEG_RGBA, HOLE_RGBA = (0.85, 0.48, 0.16, 1.0), (0.25, 0.45, 0.62, 1.0)

# Each hand has a guard between its camera and the parts, which touches nothing: the cameras see how the hands
# stand to each other, not how the parts lie in them. Without it, a linear fit of the images tells the parts'
# offsets with R² .97 before they touch; 3 cm shorter and 5 mm lower, a corner of the square part told R² .83.
GUARD = np.array([0.0, -0.05, 0.147])  # [m] its middle in the flange frame
GUARD_HALF = np.array([0.055, 0.0015, 0.100])  # [m]

# Tool axes in the world, as columns: z points at the other arm. The right fingers close along x, the left
# ones vertically, so that the parts' free directions in the hands are the world's z and x.
RIGHT_TOOL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
LEFT_TOOL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
MEETING = Pose.of(LEFT_TOOL, np.array([0.4, 0.0, 0.32]))  # the hole's mouth, before jitter
HOLE_FROM_PEG = Pose.of(LEFT_TOOL.T @ RIGHT_TOOL, np.zeros(3))  # facing each other, the tip in the mouth
APART = 1.1  # [m] between the arms' bases
# [rad] Elbows up and the arms mirrored: with both shoulders on the same side, the right wrist would stretch.
LEFT_JOINTS = np.array([-0.73, -1.41, 1.89, -0.48, 2.42, -1.57])
RIGHT_JOINTS = np.array([-2.41, -1.73, -1.89, -2.66, -2.42, -3.14])
START_GAP = 0.12  # [m] between the parts

PUSHED = 0.031  # [m] depth of the target at the end
ROUGH, NEAR = (0.02, math.radians(3.0)), (0.01, math.radians(1.5))  # most by which one aims beside the mouth
FIT = PegInHole("hole", HOLE_FROM_PEG, "right", SEATED, PUSHED)


@dataclass(frozen=True, slots=True)
class Style:
    """How one of two demonstrators goes about it."""

    gap: float  # [m] between the parts before the push
    detour: Array  # (3,) [m] of the peg on its way there, in world axes
    approach: float  # [s]
    push: float  # [m/s]
    pause: float  # [s] between two motions


STYLES = (
    Style(gap=0.025, detour=np.array([0.0, -0.02, 0.0]), approach=2.2, push=0.025, pause=0.35),
    Style(gap=0.040, detour=np.array([0.0, -0.03, 0.05]), approach=3.0, push=0.035, pause=0.5),
)


def _setup(
    name: str,
    tool: Array,
    side: float,
    modes: tuple[StiffnessMode, StiffnessMode],
    grasp: Grasp,
    near: Array,
) -> ArmSetup:
    """`side` of the table: +1 is left."""
    return ArmSetup(
        name=name,
        base_position=np.array([0.0, side * APART / 2, 0.0]),
        flange_from_tcp=grasp.flange_from_body,
        world_from_home=Pose.of(tool, MEETING.position + np.array([0.0, side * START_GAP / 2, 0.0])),
        modes=modes,
        workspace=(np.array([0.2, -0.25, 0.10]), np.array([0.65, 0.25, 0.55])),
        grasp=grasp,
        near=near,
    )


def _grasp(body: str, mass: float, center: Array) -> Grasp:
    flange_from_part = Pose(np.array([0.0, 0.0, REACH]), np.array([1.0, 0.0, 0.0, 0.0]))
    return Grasp(body, flange_from_part, mass, center, offset=GRASP_OFFSET, tilt=GRASP_TILT)


def _wrist_camera(arm: str) -> CameraView:
    """Looks over the guard at the other hand."""
    return CameraView(
        f"{arm}_wrist",
        np.array([0.0, -0.11, 0.02]),
        np.array([0.0, -0.05, 0.26]),
        fovy=70.0,
        arm=arm,
        up=np.array([0.0, -1.0, 0.0]),
    )


class Insertion:
    """A `studio.tasks.Task` but for its name, its instruction and the two parts."""

    turn = 0.0  # [rad] by which the approach misjudges the turn about the hole's axis, at most
    wiggle = 0.0  # [rad] by which the demonstrator turns the peg about its axis where it stalls
    time_limit = 30.0
    arms = (
        _setup(
            "left",
            LEFT_TOOL,
            1.0,
            (StiffnessMode.MEDIUM, StiffnessMode.HIGH),
            _grasp("hole", HOLE_MASS, HOLE_CENTER),
            LEFT_JOINTS,
        ),
        _setup(
            "right",
            RIGHT_TOOL,
            -1.0,
            (StiffnessMode.MEDIUM, StiffnessMode.LOW),
            _grasp("peg", PEG_MASS, PEG_CENTER),
            RIGHT_JOINTS,
        ),
    )
    cameras = (
        CameraView("front", np.array([1.25, 0.0, 0.62]), np.array([0.38, 0.0, 0.32]), fovy=36.0),
        _wrist_camera("left"),
        _wrist_camera("right"),
    )

    def __init__(self) -> None:
        self._meeting = MEETING  # world_from_mouth, where the demonstrator brings the parts together
        self._seated = 0.0  # [s] for which the peg has been seated with both parts held

    def add_peg(self, body: mujoco.MjsBody) -> None:
        raise NotImplementedError

    def add_hole(self, body: mujoco.MjsBody) -> None:
        raise NotImplementedError

    def build(self, spec: mujoco.MjSpec) -> None:
        peg = add_part(spec, "peg", PEG_MASS, PEG_CENTER, extent=0.05)
        self.add_peg(peg)
        add_handle(peg, GRIP - REACH, PEG_RGBA)
        hole = add_part(spec, "hole", HOLE_MASS, HOLE_CENTER, extent=0.06)
        self.add_hole(hole)
        add_handle(hole, GRIP - REACH, HOLE_RGBA)
        for arm in self.arms:
            spec.body(f"{arm.name}_flange").add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=GUARD_HALF,
                pos=GUARD,
                rgba=(0.2, 0.2, 0.22, 1.0),
                contype=0,
                conaffinity=0,
                mass=0,
            )

    def bind(self, world: World) -> None:
        """Number the four fingers, and each geom of a part by the part."""
        model = world.model
        self._finger = np.zeros(model.ngeom, int)
        self._part = np.full(model.ngeom, -1)
        for index, arm in enumerate(self.arms):
            for pad in models.PADS:
                finger = 1 + 2 * index + pad.startswith("left")
                self._finger[model.geom(f"{arm.name}_hand_{pad}").id] = finger
            assert arm.grasp is not None
            body = model.body(arm.grasp.body)
            self._part[int(body.geomadr[0]) : int(body.geomadr[0] + body.geomnum[0])] = index

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        return tuple(
            _moved(
                arm.world_from_home,
                rng.uniform(-START_JITTER, START_JITTER, 3) * spread,
                rng.uniform(-START_TURN, START_TURN, 3) * spread,
            )
            for arm in self.arms
        )

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        self._meeting = _moved(
            MEETING,
            rng.uniform(-MEETING_JITTER, MEETING_JITTER, 3) * spread,
            rng.uniform(-MEETING_TURN, MEETING_TURN) * spread,
        )
        self._seated = 0.0

    def update(self, world: World) -> None:
        held = FIT.inside(world) >= SEATED and self._held(world)
        self._seated = self._seated + CONTROL_PERIOD if held else 0.0

    def progress(self, world: World) -> Progress:
        x, y, z = FIT.place(world).position.tolist()
        value = min(1.0, FIT.inside(world) / SEATED)
        success = self._seated >= HELD - CONTROL_PERIOD / 2
        if success:
            phase = "inserted"
        elif value > 0.0:
            phase = "hold it" if value == 1.0 else "inserting"
        else:
            phase = "at the rim" if z < 0.003 and math.hypot(x, y) < OUTER else "approach"
        return Progress(value, success, phase)

    def state(self) -> dict[str, Array]:
        return {"meeting": self._meeting.vector, "seated": np.array([self._seated])}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._meeting = Pose.from_vector(state["meeting"])
        self._seated = float(state["seated"][0])

    def texture(self) -> None:
        return None

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Bring the parts face to face, feel for the hole, correct, push until seated, hold.

        As a person does, it aims roughly from afar and corrects before the parts meet, which shows what to do
        when off (noise while demonstrating: Laskey et al. 2017, arXiv 1703.09327). What the hands hold, and
        how, is read from the world only after the rim has been felt.
        """
        style = STYLES[rng.integers(len(STYLES))]
        speed = rng.uniform(0.85, 1.2)
        left, right = (
            Motion(world.tcp(arm.name), StiffnessMode.MEDIUM, 0.0, world.table, speed, arm.base_position)
            for arm in self.arms
        )
        gap = style.gap * rng.uniform(0.85, 1.15)

        def before(seen: Pose) -> Pose:
            """world_from_tcp of the right hand, in line with where the mouth is believed to be."""
            return FIT.target(seen, Pose.identity(), -gap)

        mouth = self._meeting @ misjudgement(rng, MISJUDGED, MISJUDGED_TURN, self.turn)
        rough = before(mouth @ misjudgement(rng, *ROUGH))
        detour = Pose(rough.position + style.detour * rng.uniform(0.7, 1.3), rough.wxyz)
        seconds = style.approach * rng.uniform(0.9, 1.1)
        hands = (left, right)
        yield from together(hands, left.move(self._meeting, seconds), right.move(detour, seconds))
        yield from together(
            hands, right.move(before(mouth @ misjudgement(rng, *NEAR)), rng.uniform(0.8, 1.1))
        )
        yield from together(hands, right.move(before(mouth), rng.uniform(0.6, 0.9)))
        yield from together(hands, right.wait(style.pause * rng.uniform(0.8, 1.2)))
        left.mode, right.mode = StiffnessMode.HIGH, StiffnessMode.LOW
        how = Pushing(style.push, style.pause, self.wiggle)
        yield from together(hands, FIT.feel_in(world, right, mouth, Pose.identity(), how, rng))
        yield from together(hands, right.wait(1.0))

    def _held(self, world: World) -> bool:
        """Whether all four fingers press on their parts."""
        contact = world.data.contact
        pairs = contact.geom
        first, second = pairs[:, 0], pairs[:, 1]
        finger = self._finger[first] + self._finger[second]
        part = self._part[first] + self._part[second] + 1
        gripping = (finger > 0) & ((finger - 1) // 2 == part) & (contact.efc_address >= 0)
        # An elliptic cone's first row is the normal force.
        forces = world.data.efc_force[contact.efc_address[gripping]]
        pressed = np.bincount(finger[gripping], weights=forces, minlength=5)[1:5]
        return bool((pressed >= HOLDS).all())


def _moved(pose: Pose, shift: Array, turn: Array) -> Pose:
    """Shifted (3,) [m] and turned by a rotation vector (3,) [rad], both in world axes."""
    turned = Pose(np.zeros(3), quaternion_from_rotation_vector(turn)) @ Pose(np.zeros(3), pose.wxyz)
    return Pose(pose.position + shift, turned.wxyz)
