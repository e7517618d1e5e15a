"""Parts that are held and put together: handles with ribs, pegs, holes. All of them are primitives.

A part is a free body. Its z axis points out of the hand that holds it, along the tool; its origin is at the
peg's tip or in the middle of the hole's mouth. Fingers close along its x axis.

A peg is a shell of capsules along z, whose round ends are the chamfer, and a crown: a flat cone. A flat end
that is off centre touches the rim wherever the least tilt brings it down, anywhere on half of the circle; a
crowned one touches on the side that it is off to. A hole is a ring of boxes. Such pairs stay quiet and within
0.3 mm of each other.
"""

from __future__ import annotations

import mujoco
import numpy as np

from controller.types import Array
from studio.models import PAD_FRICTION

# Hard plastic that FDCC can press without chatter: ten newtons enter by about 0.1 mm.
SURFACE_SOLREF = (0.006, 1.0)
SURFACE_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
SURFACE_FRICTION = (0.3, 0.005, 0.0001)  # printed plastic on printed plastic

# A pad touches a rib in two points, a box in up to eight. Four ribs hold a part against every motion without
# torsional or rolling friction, at half the cost of a step.
RIB_RADIUS = 0.003  # [m]
RIB_APART = 0.0188  # [m] between the two ribs of a side: the distance of a finger's two pads
RIB_SOLREF = (0.004, 1.0)  # the pads' own
RIB_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)

HANDLE_WIDTH = 0.030  # [m] between the finger pads
HANDLE_DEPTH = 0.028  # [m] across
HANDLE_LENGTH = 0.036  # [m] along z
GRIP = 0.1542  # [m] from the flange to the middle of the pads when they hold a handle

BLOCK_SET_BACK = 0.0002  # [m]
RING_BOXES = 24  # tangent to the circle of a round hole
SHELL_CAPSULES = 16  # of a peg: on a circle, or along the sides of a square
CROWN = 0.002  # [m] by which a peg's middle stands out, so that it touches a rim on the side that is off
CROWN_TOP = 0.3  # share of the peg's width at which the crown is flat

Rgba = tuple[float, float, float, float]


def add_part(spec: mujoco.MjSpec, name: str, mass: float, center: Array, extent: float) -> mujoco.MjsBody:
    """A free body of `mass` [kg], its centre at `center` (3,) [m], as unwieldy as a cube of side `extent`."""
    body = spec.worldbody.add_body(name=name, mass=mass, ipos=center)
    body.inertia = np.full(3, mass * extent**2 / 6)
    body.explicitinertial = True
    body.add_freejoint(name=name)
    return body


def add_handle(body: mujoco.MjsBody, z: float, rgba: Rgba, condim: int = 3) -> None:
    """Ribs for the finger pads around height `z` [m], and the block that they stand on."""
    half = np.array([HANDLE_WIDTH / 2 - RIB_RADIUS, HANDLE_DEPTH / 2, HANDLE_LENGTH / 2])
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=(0, 0, z), rgba=rgba, contype=0, conaffinity=0
    )
    for x in (-half[0], half[0]):
        for along in (z - RIB_APART / 2, z + RIB_APART / 2):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=(x, -half[1], along, x, half[1], along),
                size=(RIB_RADIUS, 0, 0),
                rgba=rgba,
                condim=condim,
                friction=PAD_FRICTION,
                solref=RIB_SOLREF,
                solimp=RIB_SOLIMP,
                priority=1,
                mass=0,
            )


def add_round_peg(body: mujoco.MjsBody, radius: float, length: float, chamfer: float, rgba: Rgba) -> None:
    """A cylinder of `radius` whose edge, rounded by `chamfer`, is at z = 0, all [m]."""
    _add_shell(body, _circle(radius - chamfer, SHELL_CAPSULES), length, chamfer, rgba)
    _add_crown(body, radius - chamfer, chamfer, rgba)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=(radius - chamfer, length / 2, 0),
        pos=(0, 0, -length / 2),
        rgba=rgba,
        contype=0,
        conaffinity=0,
    )


def add_square_peg(body: mujoco.MjsBody, half: float, length: float, chamfer: float, rgba: Rgba) -> None:
    """A square bar of half side `half` whose edge, rounded by `chamfer`, is at z = 0, all [m].

    Its corners lie on the x and y axes. So does what a hand leaves free, and a peg that is off by any
    amounts along the two touches the side that tells the signs of both.
    """
    corners = _circle((half - chamfer) * np.sqrt(2.0), 4)
    shares = np.arange(SHELL_CAPSULES // 4)[:, None] * 4 / SHELL_CAPSULES
    sides = [a + shares * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    _add_shell(body, np.concatenate(sides), length, chamfer, rgba)
    _add_crown(body, half - chamfer, chamfer, rgba)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(half - chamfer, half - chamfer, length / 2),
        pos=(0, 0, -length / 2),
        quat=(np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)),
        rgba=rgba,
        contype=0,
        conaffinity=0,
    )


def add_round_hole(body: mujoco.MjsBody, radius: float, depth: float, outer: float, rgba: Rgba) -> None:
    """A ring with a round hole of `radius`, its mouth at z = 0, and a floor at `depth`, all [m]."""
    half = (outer - radius) / 2
    width = outer * np.tan(np.pi / RING_BOXES)  # no gaps at the outside
    for angle in np.arange(RING_BOXES) * 2 * np.pi / RING_BOXES:
        _add_wall(body, radius + half, angle, (half, width, depth / 2), rgba)
    _add_floor(body, outer, depth, rgba)


def add_block_around(
    body: mujoco.MjsBody, half: Array, outer: float, depth: float, rgba: Rgba, friction: float
) -> None:
    """A block around a ring of radius `outer` and `depth` [m], its front at z = 0.

    `half` (3,) [m] are its half sides. Its front stands back a little from the ring's: a peg at the mouth
    touches the ring alone. `friction` is the block's with whatever it stands on.
    """
    x, y, _ = half
    inner = outer / np.sqrt(2.0)  # [m] half side of the square in the ring
    front, back = -BLOCK_SET_BACK, -2.0 * half[2]
    for low, high in (
        ((inner, -y, -depth), (x, y, front)),
        ((-x, -y, -depth), (-inner, y, front)),
        ((-inner, inner, -depth), (inner, y, front)),
        ((-inner, -y, -depth), (inner, -inner, front)),
        ((-x, -y, back), (x, y, -depth)),
    ):
        corners = np.array([low, high])
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(corners[1] - corners[0]) / 2,
            pos=corners.mean(axis=0),
            rgba=rgba,
            friction=(friction, *SURFACE_FRICTION[1:]),
            solref=SURFACE_SOLREF,
            solimp=SURFACE_SOLIMP,
            priority=1,
            mass=0,
        )


def add_square_hole(body: mujoco.MjsBody, half: float, depth: float, outer: float, rgba: Rgba) -> None:
    """A frame with a square hole of half side `half`, its mouth at z = 0, and a floor at `depth`, all [m].

    Its corners lie on the x and y axes, as the peg's do.
    """
    thickness = (outer - half) / 2
    for side, angle in enumerate(np.pi / 4 + np.arange(4) * np.pi / 2):
        width = outer if side % 2 else half  # two walls between two longer ones
        _add_wall(body, half + thickness, angle, (thickness, width, depth / 2), rgba)
    _add_floor(body, outer, depth, rgba)


def _add_shell(body: mujoco.MjsBody, points: Array, length: float, radius: float, rgba: Rgba) -> None:
    """Capsules along z through `points` (n, 2) [m]."""
    for x, y in points:
        _add_capsule(body, (x, y, -radius), (x, y, -length), radius, rgba)


def _add_crown(body: mujoco.MjsBody, width: float, radius: float, rgba: Rgba) -> None:
    """A flat cone of capsules like spokes, `width` [m] the radius of its foot at z = 0."""
    for x, y in _circle(width, SHELL_CAPSULES):
        top = (x * CROWN_TOP, y * CROWN_TOP, CROWN - radius)
        _add_capsule(body, (x, y, -radius), top, radius, rgba)


def _add_capsule(
    body: mujoco.MjsBody, start: tuple[float, ...], end: tuple[float, ...], radius: float, rgba: Rgba
) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(*start, *end),
        size=(radius, 0, 0),
        rgba=rgba,
        friction=SURFACE_FRICTION,
        solref=SURFACE_SOLREF,
        solimp=SURFACE_SOLIMP,
        mass=0,
    )


def _circle(radius: float, n: int) -> Array:
    """(n, 2) [m]"""
    angles = np.arange(n) * 2 * np.pi / n
    circle: Array = radius * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return circle


def _add_wall(
    body: mujoco.MjsBody, distance: float, angle: float, size: tuple[float, float, float], rgba: Rgba
) -> None:
    """A box at `distance` from the axis, its first side along the radius."""
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=size,
        pos=(distance * np.cos(angle), distance * np.sin(angle), -size[2]),
        quat=(np.cos(angle / 2), 0, 0, np.sin(angle / 2)),
        rgba=rgba,
        friction=SURFACE_FRICTION,
        solref=SURFACE_SOLREF,
        solimp=SURFACE_SOLIMP,
        mass=0,
    )


def _add_floor(body: mujoco.MjsBody, outer: float, depth: float, rgba: Rgba) -> None:
    """A disc of radius `outer`: it leaves the corners of a square part open at the outside."""
    half = 0.0015  # [m]
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=(outer, half, 0),
        pos=(0, 0, -depth - half),
        rgba=rgba,
        friction=SURFACE_FRICTION,
        solref=SURFACE_SOLREF,
        solimp=SURFACE_SOLIMP,
        mass=0,
    )
