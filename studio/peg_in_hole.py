"""A peg and the hole that it fits: how far it is in, and how a demonstrator feels for the way.

Both are bodies whose z axis points out: the peg's from its tip, the hole's from the middle of its mouth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from controller.types import ArmAction, Pose, quaternion_from_rotation_vector
from studio.motion import Motion
from studio.tasks import World

CENTERED = 0.002  # [m] at most between the tip of a peg that is in its hole and the hole's axis

# The demonstrator
MISJUDGED = 0.0008  # [m] by which the approach misses what can be seen, on both axes
MISJUDGED_TURN = math.radians(0.5)
READING_ERROR = 0.0003  # [m] left after feeling the rim
READING_TURN = math.radians(0.3)
PROBE = 0.009  # [m] of the target beyond the mouth when feeling for the hole
ENTERED = 0.004  # [m] of depth that the peg reaches only inside the hole
RETREAT = 0.006  # [m] from the mouth between two tries: pushing sideways at the rim would stick
ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Pushing:
    """How a demonstrator pushes."""

    speed: float  # [m/s]
    pause: float  # [s] between two motions
    wiggle: float = 0.0  # [rad] by which the hand turns about its z axis to either side where the peg stalls


@dataclass(frozen=True, slots=True)
class PegInHole:
    """The body `peg`, the body with the hole, and the arm whose hand brings the one into the other."""

    hole: str
    hole_from_peg: Pose  # with the tip in the middle of the mouth and the axes in line
    arm: str
    seated: float  # [m] depth of the tip below the mouth that is enough
    pushed: float  # [m] depth at which the target is at the end of a push
    sag: float = 0.0  # [m] by which the weight of a peg that was picked up lowers the hand

    def place(self, world: World) -> Pose:
        """hole_from_peg, as it is."""
        return world.pose(self.hole).inverse() @ world.pose("peg")

    def depth(self, world: World) -> float:
        """[m] of the tip below the mouth; where it is beside the hole, too."""
        return -float(self.place(world).position[2])

    def inside(self, world: World) -> float:
        """[m] of the tip below the mouth, or 0 where it is not in the hole."""
        x, y, z = self.place(world).position.tolist()
        return max(0.0, -z) if math.hypot(x, y) <= CENTERED else 0.0

    def peg_from_tcp(self, world: World) -> Pose:
        """How the peg lies in the hand."""
        return world.pose("peg").inverse() @ world.tcp(self.arm)

    def target(self, mouth: Pose, peg_from_tcp: Pose, depth: float) -> Pose:
        """world_from_tcp with the axes in line and the tip `depth` [m] below `mouth`, a world_from_hole."""
        tcp = mouth @ along(-depth) @ self.hole_from_peg @ peg_from_tcp
        return Pose(tcp.position + np.array([0.0, 0.0, self.sag]), tcp.wxyz)

    def feel_in(
        self,
        world: World,
        hand: Motion,
        mouth: Pose,
        peg_from_tcp: Pose,
        how: Pushing,
        rng: np.random.Generator,
    ) -> Iterator[ArmAction]:
        """Feel for the hole, draw back and aside where the rim is in the way, then push until seated.

        It goes aside while it draws back, when the touch is fresh: who learns from it remembers forces for
        a moment only.

        `mouth` (world_from_hole) and `peg_from_tcp` are what one thinks at first. What they are is read from
        the world only after the rim has been felt.
        """

        def to(depth: float, seconds: float) -> Iterator[ArmAction]:
            return hand.move(self.target(mouth, peg_from_tcp, depth), seconds)

        def push(depth: float) -> Iterator[ArmAction]:
            goal = self.target(mouth, peg_from_tcp, depth)
            way = float(np.linalg.norm(goal.position - hand.pose.position))
            return hand.move(goal, way / how.speed, linear=True)

        def pause() -> Iterator[ArmAction]:
            return hand.wait(how.pause * rng.uniform(0.8, 1.2))

        for _ in range(ATTEMPTS):
            yield from push(PROBE)
            yield from hand.wait(0.5)
            if self.depth(world) > ENTERED:
                break
            mouth, peg_from_tcp = self._read(world, rng)
            yield from to(-RETREAT, rng.uniform(0.6, 0.9))
            yield from pause()
        for _ in range(ATTEMPTS):
            yield from push(self.pushed)
            yield from hand.wait(0.6)
            if self.depth(world) > self.seated + 0.001:
                break
            yield from _wiggle(hand, how.wiggle)
            mouth, peg_from_tcp = self._read(world, rng)

    def _read(self, world: World, rng: np.random.Generator) -> tuple[Pose, Pose]:
        """World_from_hole and peg_from_tcp, as well as feeling the rim tells them."""
        error = misjudgement(rng, READING_ERROR, READING_TURN)
        return world.pose(self.hole) @ error, self.peg_from_tcp(world)


def misjudgement(rng: np.random.Generator, shift: float, tilt: float, turn: float = 0.0) -> Pose:
    """Off by up to `shift` [m] on x and y, `tilt` [rad] about each of them and `turn` [rad] about z."""
    across = np.append(rng.uniform(-shift, shift, 2), 0.0)
    rotation = np.append(rng.uniform(-tilt, tilt, 2), rng.uniform(-turn, turn))
    return Pose(across, quaternion_from_rotation_vector(rotation))


def along(distance: float) -> Pose:
    """`distance` [m] along z."""
    return Pose(np.array([0.0, 0.0, distance]), np.array([1.0, 0.0, 0.0, 0.0]))


def _wiggle(hand: Motion, angle: float) -> Iterator[ArmAction]:
    """Turn the hand about its z axis to one side, to the other and back."""
    middle = hand.pose
    for turn in (angle, -angle, 0.0):
        rotation = quaternion_from_rotation_vector(np.array([0.0, 0.0, turn]))
        yield from hand.move(middle @ Pose(np.zeros(3), rotation), 0.4)
