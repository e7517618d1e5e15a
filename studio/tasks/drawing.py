"""Single-arm drawing: a smile of three strokes on a whiteboard, with the pen in the hand from the start.

The pen inks only where and while it presses, and the line widens with the force. The drawing is compared with
the reference smile at the board's centre by SSIM (`likeness`); the start pose varies. All numbers below were
fixed before any policy was trained.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache

import cv2
import mujoco
import numpy as np

from controller.types import Action, ArmAction, Array, Pose, StiffnessMode
from studio.board import CELL, CELLS, Board
from studio.motion import Motion
from studio.session import CONTROL_PERIOD
from studio.tasks import ArmSetup, CameraView, Grasp, Progress, World

BOARD_CENTER = np.array([0.50, 0.0, 0.02])  # [m] top face, in the world

# The smile in board axes, upright for somebody who faces the robot: up is -x, right is +y.
EYE = (-0.038, -0.012)  # [m] from and to, along x
EYE_SIDE = 0.025  # [m] of each eye from the middle
MOUTH_CENTER = -0.008  # [m] of its circle, along x
MOUTH_RADIUS = 0.045  # [m]
MOUTH_REACH = np.radians(65.0)  # of the arc to each side
LINE_RADIUS = 0.002  # [m] of the reference: a press of 2 N

INK_FORCE = 0.3  # [N] below it the pen leaves nothing
NIB_RADIUS = 0.001  # [m] of the thinnest line
NIB_SPREAD = 0.0005  # [m/N] by which the line's radius grows
NIB_MAX_RADIUS = 0.003  # [m]
NIB_REACH = 0.012  # [m] in one period; further apart are two strokes
LIFTED = 0.1  # [s] without ink that ends a stroke

# The likeness is the mean SSIM (Wang et al., 2004, K1 .01, K2 .03) of the face cut out at the board's
# centre, blurred by BLUR and averaged to PIXELS on a side; the window is a Gaussian of WINDOW pixels.
# Blur and window are wide on purpose: a smile 3 mm off scores .9, one without an eye .8, a blank board 0.
# The figure is not comparable with the paper's 84 %, whose crop is not known.
CROP = 128  # [cells] side of the face: 14 cm
PIXELS = 32
BLUR = 0.004  # [m] standard deviation
WINDOW = 4.0  # [px] standard deviation
ALIKE = 0.82

START_JITTER = np.array([0.04, 0.06, 0.02])  # [m] on each axis of the start pose

PEN_MASS = 0.03  # [kg]
PEN_CENTER = np.array([0.0, 0.0, -0.065])  # [m] of mass, from the nib's tip
BARREL_HALF = np.array([0.008, 0.008, 0.045])  # [m] of the square barrel along tool x, y and z
BARREL_START = 0.030  # [m] from the nib's tip
TIP_RADIUS = 0.003  # [m]
# A soft nib, quiet under FDCC like the eraser's felt.
NIB_SOLREF = (0.008, 1.0)
NIB_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
NIB_FRICTION = (0.2, 0.005, 0.0001)

# The tool points down: tool z = -z, tool x (where the fingers close) = -y, tool y = -x of the world.
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLANGE_FROM_TCP = Pose(np.array([0.0, 0.0, 0.21]), np.array([1.0, 0.0, 0.0, 0.0]))  # the nib's tip


@dataclass(frozen=True, slots=True)
class Style:
    """How one of two demonstrators draws."""

    hover: float  # [m] above the board between strokes
    depth: float  # [m] of the target below the board
    speed: float  # [m/s] of a stroke's target
    order: tuple[int, int, int]  # of the strokes
    backwards: bool  # the mouth from its other end


STYLES = (
    Style(hover=0.030, depth=0.008, speed=0.030, order=(0, 1, 2), backwards=False),
    Style(hover=0.045, depth=0.009, speed=0.026, order=(2, 1, 0), backwards=True),
)


class Task:
    name = "drawing"
    instruction = "Draw a smile on the whiteboard: two eyes and a mouth."
    time_limit = 40.0
    arms = (
        ArmSetup(
            name="right",
            base_position=np.zeros(3),
            flange_from_tcp=FLANGE_FROM_TCP,
            world_from_home=Pose.of(DOWN, np.array([0.44, 0.0, 0.12])),
            modes=(StiffnessMode.MEDIUM, StiffnessMode.LOW),
            workspace=(np.array([0.25, -0.25, -0.02]), np.array([0.70, 0.25, 0.45])),
            grasp=Grasp("pen", FLANGE_FROM_TCP, PEN_MASS, PEN_CENTER),
        ),
    )
    cameras = (
        CameraView("front", np.array([0.92, 0.0, 0.62]), np.array([0.48, 0.0, 0.03]), fovy=34.0),
        CameraView(
            "right_wrist",
            np.array([0.0, -0.11, 0.02]),
            np.array([0.0, -0.035, 0.2]),
            fovy=75.0,
            arm="right",
            up=np.array([0.0, -1.0, 0.0]),
        ),
    )

    def __init__(self) -> None:
        self.board = Board()
        self._nib = np.full(2, np.nan)  # (2,) [m] where ink was last left in this stroke, board axes
        self._dry = LIFTED  # [s] since ink was last left
        self._n_strokes = 0  # begun so far
        self._likeness = 0.0

    def build(self, spec: mujoco.MjSpec) -> None:
        Board.build(spec, BOARD_CENTER)
        _add_pen(spec)

    def bind(self, world: World) -> None:
        self._nib_geom = world.model.geom("pen_nib").id
        self._board_geom = world.model.geom("board").id

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        home = self.arms[0].world_from_home
        return (Pose(home.position + spread * rng.uniform(-START_JITTER, START_JITTER), home.wxyz),)

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        self.board.clear()
        self._nib = np.full(2, np.nan)
        self._dry, self._n_strokes = LIFTED, 0
        self._likeness = likeness(self.board.grid)

    def update(self, world: World) -> None:
        force = world.normal_force(self._nib_geom, self._board_geom)
        if force < INK_FORCE:
            self._lift()
            return
        nib = (world.pose("pen").position - BOARD_CENTER)[:2]
        if self._dry >= LIFTED:
            self._n_strokes += 1
        is_new = self._dry > 0.0 or float(np.linalg.norm(nib - self._nib)) > NIB_REACH
        radius = min(NIB_RADIUS + NIB_SPREAD * (force - INK_FORCE), NIB_MAX_RADIUS)
        self.board.stroke(nib if is_new else self._nib, nib, radius)
        self._nib, self._dry = nib, 0.0

    def _lift(self) -> None:
        was_drawing = self._dry < LIFTED
        self._dry = min(self._dry + CONTROL_PERIOD, LIFTED)
        if was_drawing and self._dry >= LIFTED:
            self._likeness = likeness(self.board.grid)

    def progress(self, world: World) -> Progress:
        """The likeness as of the last finished stroke: a drawing counts once the pen is off the board."""
        is_drawing = self._dry < LIFTED
        success = self._likeness >= ALIKE and not is_drawing
        if success:
            phase = "drawn"
        elif is_drawing:
            phase = f"stroke {self._n_strokes}"
        else:
            phase = "pen up"
        return Progress(max(0.0, self._likeness), success, phase)

    def state(self) -> dict[str, Array]:
        return {
            **self.board.state(),
            "nib": self._nib.copy(),
            "drawing": np.array([self._dry, self._n_strokes, self._likeness]),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        self.board.restore(state)
        self._nib = np.array(state["nib"])
        dry, n_strokes, alike = state["drawing"].tolist()
        self._dry, self._n_strokes, self._likeness = dry, int(n_strokes), alike

    def texture(self) -> tuple[str, Array]:
        return Board.TEXTURE, self.board.picture()

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Three strokes, then home."""
        style = STYLES[rng.integers(len(STYLES))]
        home = world.tcp("right")
        speed = rng.uniform(0.85, 1.2)
        hand = Motion(home, StiffnessMode.MEDIUM, gripper=0.0, table=world.table, speed=speed)
        eyes_and_mouth = list(smile())
        if style.backwards:
            eyes_and_mouth[2] = eyes_and_mouth[2][::-1]
        misplaced = rng.normal(0.0, 0.0007, 2)  # [m]
        for number in style.order:
            line = eyes_and_mouth[number] + misplaced + rng.normal(0.0, 0.0007, 2)
            for action in self._draw(hand, line, style, rng):
                yield Action((action,))
        for part in (hand.move(home, rng.uniform(1.3, 1.7)), hand.wait(0.8)):
            for action in part:
                yield Action((action,))

    @staticmethod
    def _draw(hand: Motion, line: Array, style: Style, rng: np.random.Generator) -> Iterator[ArmAction]:
        """Hover, descend, press at low stiffness, follow `line` (n, 2) [m] in board axes, catch up, lift."""
        tilt = hand.pose.wxyz
        path = BOARD_CENTER + np.pad(line, ((0, 0), (0, 1)))
        up = np.array([0.0, 0.0, 1.0])
        deep = style.depth * rng.uniform(0.9, 1.1) * up
        wander = rng.normal(0.0, 0.003, 3)
        yield from hand.move(Pose(path[0] + style.hover * up + wander, tilt), rng.uniform(0.9, 1.3))
        yield from hand.move(Pose(path[0] + 0.008 * up, tilt), rng.uniform(0.5, 0.7))
        yield from hand.wait(0.4)
        hand.mode = StiffnessMode.LOW
        yield from hand.move(Pose(path[0] - deep, tilt), 0.5)
        yield from hand.wait(rng.uniform(0.4, 0.55))
        yield from hand.follow(path[1:] - deep, style.speed * rng.uniform(0.9, 1.1))
        yield from hand.wait(0.5)
        hand.mode = StiffnessMode.MEDIUM
        yield from hand.move(Pose(path[-1] + style.hover * up, tilt), rng.uniform(0.6, 0.8))


def smile() -> tuple[Array, Array, Array]:
    """Left eye, right eye and mouth, each a polyline (n, 2) [m] in board axes."""
    down = np.linspace(*EYE, 9)
    left, right = (np.stack((down, np.full(9, side)), axis=1) for side in (-EYE_SIDE, EYE_SIDE))
    angle = np.linspace(-MOUTH_REACH, MOUTH_REACH, 31)
    mouth = np.stack((MOUTH_CENTER + MOUTH_RADIUS * np.cos(angle), MOUTH_RADIUS * np.sin(angle)), axis=1)
    return left, right, mouth


def likeness(grid: Array) -> float:
    """Mean SSIM of a board's face with the reference smile: 1 where they are equal."""
    drawn, reference = _face(grid), _reference_face()
    mean_drawn, mean_reference = _windowed(drawn), _windowed(reference)
    variance_drawn = _windowed(drawn * drawn) - mean_drawn**2
    variance_reference = _windowed(reference * reference) - mean_reference**2
    covariance = _windowed(drawn * reference) - mean_drawn * mean_reference
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    same = (2 * mean_drawn * mean_reference + c1) * (2 * covariance + c2)
    most = (mean_drawn**2 + mean_reference**2 + c1) * (variance_drawn + variance_reference + c2)
    return float((same / most).mean())


def reference() -> Board:
    """A board with the smile as it is meant."""
    board = Board()
    for line in smile():
        board.draw(line, LINE_RADIUS)
    return board


@cache
def _reference_face() -> Array:
    return _face(reference().grid)


def _face(grid: Array) -> Array:
    """(PIXELS, PIXELS) float, the blurred middle of the grid."""
    middle = slice((CELLS - CROP) // 2, (CELLS + CROP) // 2)
    face = cv2.GaussianBlur(grid[middle, middle].astype(np.float64), (0, 0), BLUR / CELL)
    side = CROP // PIXELS
    return np.asarray(face.reshape(PIXELS, side, PIXELS, side).mean(axis=(1, 3)))


def _windowed(face: Array) -> Array:
    return np.asarray(cv2.GaussianBlur(face, (0, 0), WINDOW))


def _add_pen(spec: mujoco.MjSpec) -> None:
    """A free body, its origin at the tip of the nib, its axis along z."""
    pen = spec.worldbody.add_body(name="pen", mass=PEN_MASS, ipos=PEN_CENTER)
    pen.inertia = (2.5e-5, 2.5e-5, 2e-6)
    pen.explicitinertial = True
    pen.add_freejoint(name="pen")
    pen.add_geom(
        name="pen_nib",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(0, 0, -TIP_RADIUS, 0, 0, -BARREL_START),
        size=(TIP_RADIUS, 0, 0),
        rgba=(0.10, 0.15, 0.33, 1),
        friction=NIB_FRICTION,
        solref=NIB_SOLREF,
        solimp=NIB_SOLIMP,
        priority=2,
    )
    pen.add_geom(
        name="pen_barrel",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=BARREL_HALF,
        pos=(0, 0, -BARREL_START - BARREL_HALF[2]),
        rgba=(0.92, 0.92, 0.90, 1),
        condim=6,
    )
