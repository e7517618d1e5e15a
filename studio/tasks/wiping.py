"""Single-arm wiping: rub a mark off a whiteboard in one go, with the eraser in the hand from the start.

The mark is a curved line along y, at most 3 cm across it, its centre anywhere within 5 cm of the board's
centre. The eraser is 3.4 cm across the line, so a sweep that ignores where the mark is misses most of them.
All numbers of the scene and of success were fixed before any policy was trained. That the demonstrator
corrects its approach came later: from demonstrations that come down straight, always in the right place,
policies had learned to come down straight wherever they were.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from controller.types import Action, Array, Pose, StiffnessMode
from studio import eraser
from studio.board import Board
from studio.motion import Motion
from studio.session import CONTROL_PERIOD
from studio.tasks import ArmSetup, CameraView, Progress, World

BOARD_CENTER = np.array([0.50, 0.0, 0.02])  # [m] top face, in the world

MARK_OFFSET = 0.05  # [m] the mark's centre lies within this of the board's centre, in x and in y
MARK_LENGTH = (0.04, 0.065)  # [m] along y
MARK_WAVE = (0.008, 0.011)  # [m] amplitude across the line
MARK_TURNS = (0.7, 1.2)  # periods of the wave
MARK_RADIUS = 0.004  # [m] of the pen: the mark is at most 2 (11 + 4) mm = 3 cm across
START_JITTER = 0.015  # [m] on each axis of the start pose

WIPED_ENOUGH = 0.9  # share of the mark's cells
LIFTED = 0.3  # [s] without contact that ends the go
GO_STARTS = 0.02  # share wiped from which touching counts as the go


@dataclass(frozen=True, slots=True)
class Style:
    """How one of two demonstrators wipes."""

    hover: float  # [m] above the board before descending
    depth: float  # [m] of the target below the board
    speed: float  # [m/s] of the sweep's target
    slanted: bool  # descends while moving forward instead of straight down


STYLES = (
    Style(hover=0.045, depth=0.012, speed=0.06, slanted=False),
    Style(hover=0.070, depth=0.014, speed=0.05, slanted=True),
)


class Task:
    name = "wiping"
    instruction = "Wipe the mark off the whiteboard in one go."
    time_limit = 20.0
    arms = (
        ArmSetup(
            name="right",
            base_position=np.zeros(3),
            flange_from_tcp=eraser.FLANGE_FROM_FELT,
            world_from_home=Pose.of(eraser.DOWN, np.array([0.36, 0.0, 0.20])),
            modes=(StiffnessMode.MEDIUM, StiffnessMode.LOW),
            workspace=(np.array([0.25, -0.25, -0.03]), np.array([0.70, 0.25, 0.45])),
            grasp=eraser.held(),
        ),
    )
    cameras = (
        CameraView("front", np.array([0.92, 0.0, 0.62]), np.array([0.48, 0.0, 0.03]), fovy=34.0),
        eraser.wrist_camera("right"),
    )

    def __init__(self) -> None:
        self.board = Board()
        self._eraser = eraser.Eraser(self.board, BOARD_CENTER)
        self._mark = np.zeros((2, 2))  # (n, 2) [m] polyline in board axes
        self._cells = 0  # inked cells at the start
        self._go = 0  # 0 before, 1 during, 2 after the one go
        self._wiped = 0.0  # share wiped in the go
        self._airborne = 0.0  # [s] since the last contact

    def build(self, spec: mujoco.MjSpec) -> None:
        Board.build(spec, BOARD_CENTER)
        eraser.add_eraser(spec)

    def bind(self, world: World) -> None:
        self._eraser.bind(world)

    def start_poses(self, rng: np.random.Generator, spread: float) -> tuple[Pose, ...]:
        jitter = rng.uniform(-START_JITTER, START_JITTER, 3) * spread
        home = self.arms[0].world_from_home
        return (Pose(home.position + jitter, home.wxyz),)

    def initialize(self, world: World, rng: np.random.Generator, spread: float) -> None:
        center = rng.uniform(-MARK_OFFSET, MARK_OFFSET, 2) * spread
        self._mark = eraser.wavy_line(rng, center, MARK_LENGTH, MARK_WAVE, MARK_TURNS)
        self.board.clear()
        self.board.draw(self._mark, MARK_RADIUS)
        self._cells = self.board.inked()
        self._go, self._wiped, self._airborne = 0, 0.0, 0.0
        self._eraser.reset(world)

    def update(self, world: World) -> None:
        force = self._eraser.wipe(world)
        self._airborne = 0.0 if force > 0 else self._airborne + CONTROL_PERIOD
        wiped = 1.0 - self.board.inked() / max(self._cells, 1)
        if self._go == 0 and wiped >= GO_STARTS:
            self._go = 1
        if self._go == 1:
            self._wiped = wiped
            if self._airborne > LIFTED:
                self._go = 2

    def progress(self, world: World) -> Progress:
        success = self._wiped >= WIPED_ENOUGH
        if success:
            phase = "wiped"
        elif self._go == 2:
            phase = "lifted too early"
        else:
            phase = ("approach", "wiping")[self._go]
        return Progress(self._wiped, success, phase)

    def state(self) -> dict[str, Array]:
        return {
            **self.board.state(),
            "mark": self._mark.copy(),
            "wiping": np.array([self._cells, self._go, self._wiped, self._airborne]),
            "felt": self._eraser.state(),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        self.board.restore(state)
        self._mark = np.array(state["mark"])
        cells, go, wiped, airborne = state["wiping"].tolist()
        self._cells, self._go, self._wiped, self._airborne = int(cells), int(go), wiped, airborne
        self._eraser.restore(state["felt"])

    def texture(self) -> tuple[str, Array]:
        return Board.TEXTURE, self.board.picture()

    def demonstrate(self, world: World, rng: np.random.Generator) -> Iterator[Action]:
        """Hover beside the mark, descend, press at low stiffness, one pass along the line, lift, home.

        As a person does, it aims roughly from afar and corrects on the way down, which shows what to do when
        off (noise while demonstrating: Laskey et al. 2017, arXiv 1703.09327).
        """
        style = STYLES[rng.integers(len(STYLES))]
        home = world.tcp("right")
        speed = rng.uniform(0.85, 1.2)
        hand = Motion(home, StiffnessMode.MEDIUM, gripper=0.0, table=world.table, speed=speed)

        def jitter(scale: float) -> Array:
            return np.asarray(rng.normal(0.0, scale, 3) * np.array([1.0, 1.0, 0.3]))

        mark = BOARD_CENTER[:2] + self._mark
        x = (mark[:, 0].min() + mark[:, 0].max()) / 2
        # The sweep runs from +y to -y and begins with the felt clear of the mark.
        clear = eraser.HALF[0] + MARK_RADIUS
        begin = np.array([x, mark[:, 1].max() + clear + 0.008, BOARD_CENTER[2]])
        end = np.array([x, mark[:, 1].min() - clear, BOARD_CENTER[2]])
        up = np.array([0.0, 0.0, 1.0])
        tilt = home.wxyz
        hover = begin + style.hover * up + (np.array([-0.03, 0.02, 0.0]) if style.slanted else 0.0)
        deep = style.depth * rng.uniform(0.85, 1.15) * up
        lag = eraser.LOW_LAG * style.speed  # [m]

        rough = hover + jitter(0.012)
        near = begin + 0.025 * up + jitter(0.006)
        for part in (
            hand.move(Pose(rough, tilt), rng.uniform(1.3, 1.7)),
            hand.move(Pose(near, tilt), rng.uniform(0.6, 0.9)),
            hand.move(Pose(begin + 0.006 * up + jitter(0.001), tilt), rng.uniform(0.5, 0.8)),
            hand.wait(0.35),
        ):
            for action in part:
                yield Action((action,))
        hand.mode = StiffnessMode.LOW
        sweep = end - begin
        steps = np.linspace(0, 1, 5)[1:, None]
        path = begin - deep + steps * sweep + rng.normal(0, 0.001, (4, 3)) * np.array([1.0, 1.0, 0.3])
        path[-1] += lag * sweep / np.linalg.norm(sweep)
        for part in (
            hand.move(Pose(begin - deep, tilt), 0.5),
            hand.wait(0.4),
            hand.follow(path, style.speed),
            hand.wait(0.2),
        ):
            for action in part:
                yield Action((action,))
        hand.mode = StiffnessMode.MEDIUM
        lifted = Pose(path[-1] * np.array([1, 1, 0]) + (BOARD_CENTER[2] + 0.06) * up, tilt)
        for part in (
            hand.move(lifted, rng.uniform(0.8, 1.1)),
            hand.move(home, rng.uniform(1.3, 1.7)),
            hand.wait(0.8),
        ):
            for action in part:
                yield Action((action,))
