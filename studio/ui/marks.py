"""What the scene tells beside the bodies: forces, torques, targets, limits and trails."""

from __future__ import annotations

import numpy as np
import viser

from controller.types import Array, Pose, Wrench, rotation_vector
from studio.meshes import Mesh, linear
from studio.messages import Level

Rgb = tuple[int, int, int]

CALM: Rgb = (20, 184, 166)
AMBER: Rgb = (255, 150, 10)
RED: Rgb = (228, 28, 28)
LEVEL_COLORS: dict[Level, Rgb] = {"ok": (72, 132, 240), "limited": AMBER, "refused": RED}

FORCE_LEVELS = (5.0, 15.0, 30.0)  # [N] calm below, amber at, red above
TORQUE_LEVELS = (1.0, 3.0, 6.0)  # [N·m] likewise
FORCE_LENGTH = 0.012  # [m/N] of an arrow: a 4 N wipe is half a hand long
LONGEST_ARROW = 0.30  # [m] from 25 N on the colour alone tells
LEAST_FORCE = 1.0  # [N] below this there is no arrow: the hand's own inertia
LEAST_TORQUE = 0.15  # [N·m] likewise
LINGERS = 0.7  # share of these at which what is shown vanishes again, against flicker
# The contact force runs along the tool, so that an arrow at the TCP would be hidden in the hand. It stands
# before it instead, as one first looks at it.
BEFORE = 0.095  # [m]

ARC_RADIUS = 0.085  # [m] of the arc that shows torque; clear of the wrist
ARC_TUBE = 0.006  # [m]
ARC_TURN = np.radians(70.0)  # [rad/(N·m)]
LONGEST_ARC = np.radians(300.0)
ARC_STEP = np.radians(10.0)  # the arc is drawn anew when it has grown by this
ARC_HEAD = 0.026  # [m]

GHOST_OPACITY = 0.28
GHOST_APPEARS = (0.006, np.radians(3.0))  # [m], [rad] between target and tool from which the ghost is shown
GHOST_VANISHES = (0.004, np.radians(2.0))
BRACKET = 0.06  # [m] arms of the workspace's corners
TRAIL_POINTS = 600  # a longer trail is thinned out
TRAIL_LIFT = 0.004  # [m] a pressed tool sinks into what it touches, and its trail must not

RESOLUTION = 2.0**-17  # 8 µm, or 15 µrad in a quaternion

_FLOAT = np.float32


def force_color(newtons: Array | float) -> Array:
    """(..., 3) uint8: calm, then through amber to red."""
    return _color(newtons, FORCE_LEVELS)


def torque_color(newton_metres: float) -> Array:
    return _color(newton_metres, TORQUE_LEVELS)


def force_arrow(force: Array) -> Array:
    """(3,) [m] from the arrow's tail to its tip."""
    norm = float(np.linalg.norm(force))
    return force * min(FORCE_LENGTH, LONGEST_ARROW / max(norm, 1e-9))


def torque_arc(angle: float) -> Mesh:
    """A bent arrow of `angle` [rad] about +z, as many vertices for any angle."""
    head = ARC_HEAD / ARC_RADIUS
    turns = np.linspace(0.0, max(angle - head, 0.05), 24)
    # The shaft's rings, then those of the head: wide, and closing to the tip.
    turns = np.concatenate((turns, [turns[-1], turns[-1] + head]))
    widths = np.full(len(turns), ARC_TUBE)
    widths[0], widths[-2:] = 1e-5, (2.4 * ARC_TUBE, 1e-5)
    turns[0] = turns[1]  # closes the end
    around = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
    reach = ARC_RADIUS + widths[:, None] * np.cos(around)
    vertices = np.stack(
        (
            reach * np.cos(turns)[:, None],
            reach * np.sin(turns)[:, None],
            widths[:, None] * np.sin(around) * np.ones_like(reach),
        ),
        axis=-1,
    ).reshape(-1, 3)
    return Mesh(vertices, _tube_faces(len(turns), len(around)))


def brackets(low: Array, high: Array) -> Array:
    """(24, 2, 3) segments that mark the corners of a box."""
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    inwards = np.where(corners == low, 1.0, -1.0) * np.minimum(BRACKET, (high - low) / 2)
    ends = corners[:, None, :] + np.eye(3) * inwards[:, None, :]
    starts = np.broadcast_to(corners[:, None, :], ends.shape)
    return np.stack((starts, ends), axis=2).reshape(-1, 2, 3)


class WrenchMark:
    """Force arrow with its newtons, and an arc about the axis of the torque."""

    def __init__(self, scene: viser.SceneApi, path: str, view_from: Array) -> None:
        """`view_from` (3,): from where one first looks, in the world."""
        self._before = BEFORE * view_from * [1.0, 1.0, 0.0] / np.linalg.norm(view_from[:2])
        self._arrow = scene.add_arrows(
            f"{path}/force",
            np.array([[[0, 0, 0], [0, 0, 0.1]]], _FLOAT),
            _unmanaged(np.array(CALM)),
            shaft_radius=0.005,
            head_radius=0.012,
            head_length=0.022,
            visible=False,
        )
        self._label = scene.add_label(
            f"{path}/newtons",
            "",
            font_screen_scale=0.9,
            anchor="bottom-center",
            visible=False,
        )
        arc = torque_arc(0.0)
        self._arc = scene.add_mesh_simple(
            f"{path}/torque", arc.vertices, arc.faces, color=CALM, cast_shadow=False, visible=False
        )
        self._arc_steps = 0
        self._newtons = 0

    def show(self, tool: Array, wrist: Array, wrench: Wrench | None) -> None:
        """`tool` and `wrist` (3,) [m] in the world; None hides the marks."""
        force = 0.0 if wrench is None else float(np.linalg.norm(wrench.force))
        torque = 0.0 if wrench is None else float(np.linalg.norm(wrench.torque))
        self._arrow.visible = force >= LEAST_FORCE * (LINGERS if self._arrow.visible else 1.0)
        self._arc.visible = torque >= LEAST_TORQUE * (LINGERS if self._arc.visible else 1.0)
        self._label.visible = self._arrow.visible
        if wrench is not None and self._arrow.visible:
            self._show_force(tool + self._before, wrench.force, force)
        if wrench is not None and self._arc.visible:
            self._show_torque(wrist, wrench.torque / torque, torque)

    def _show_force(self, tail: Array, force: Array, newtons: float) -> None:
        tip = tail + force_arrow(force)
        self._arrow.points = coarse(np.array([[tail, tip]])).astype(_FLOAT)
        self._arrow.colors = _unmanaged(force_color(round(newtons * 2) / 2))
        self._label.position = coarse(tip + np.array([0.0, 0.0, 0.012]))
        if abs(newtons - self._newtons) > 0.7:  # less than the sensor's noise from number to number
            self._newtons = round(newtons)
            self._label.text = f"{self._newtons} N"

    def _show_torque(self, wrist: Array, axis: Array, newton_metres: float) -> None:
        steps = round(min(ARC_TURN * newton_metres, LONGEST_ARC) / ARC_STEP)
        if steps != self._arc_steps:
            self._arc_steps = steps
            self._arc.vertices = torque_arc(steps * ARC_STEP).vertices.astype(_FLOAT)
        self._arc.color = tuple(torque_color(round(newton_metres * 4) / 4).tolist())
        self._arc.position = coarse(wrist)
        self._arc.wxyz = coarse(_turn_z_to(axis))


class Ghost:
    """The hand at the target, translucent. The tool trails it by the press; where both agree it vanishes."""

    def __init__(self, scene: viser.SceneApi, path: str, palm: Mesh, color: Rgb | None = None) -> None:
        """Without a `color` of its own it has that of the level."""
        self.path = path
        self._scene = scene
        self._color = color
        self._root = scene.add_frame(path, show_axes=False, visible=False)
        self._parts: list[viser.MeshHandle] = []
        self._level: Level = "ok"
        self.add(f"{path}/palm", palm)

    def add(self, path: str, mesh: Mesh) -> viser.MeshHandle:
        """Another part, somewhere below the ghost's own path."""
        part = self._scene.add_mesh_simple(
            path,
            mesh.vertices,
            mesh.faces,
            color=self._color or LEVEL_COLORS["ok"],
            opacity=GHOST_OPACITY,
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
        )
        self._parts.append(part)
        return part

    def show(self, world_from_ghost: Pose | None, world_from_real: Pose | None, level: Level) -> None:
        """Put the ghost at its target; None hides it. Without a real hand it is always seen."""
        self._root.visible = world_from_ghost is not None and (
            world_from_real is None or self._is_apart(world_from_ghost, world_from_real)
        )
        if world_from_ghost is None or not self._root.visible:
            return
        self._root.position = coarse(world_from_ghost.position)
        self._root.wxyz = coarse(world_from_ghost.wxyz)
        if level != self._level and self._color is None:
            self._level = level
            for part in self._parts:
                part.color = LEVEL_COLORS[level]

    def _is_apart(self, ghost: Pose, real: Pose) -> bool:
        metres, radians = GHOST_VANISHES if self._root.visible else GHOST_APPEARS
        between = real.inverse() @ ghost
        return bool(
            np.linalg.norm(between.position) > metres
            or np.linalg.norm(rotation_vector(between.wxyz)) > radians
        )


class WorkspaceMark:
    """The corners of the box that targets must stay in."""

    def __init__(self, scene: viser.SceneApi, path: str, low: Array, high: Array) -> None:
        low = np.array([*low[:2], max(low[2], 0.002)])  # what lies under the table cannot be seen
        self._lines = scene.add_line_segments(
            path,
            brackets(low, high).astype(_FLOAT),
            LEVEL_COLORS["ok"],
            thickness=1.5,
            thickness_units="screen",
        )
        self._level: Level = "ok"

    def show(self, level: Level) -> None:
        if level != self._level:
            self._level = level
            self._lines.colors = np.array(LEVEL_COLORS[level], np.uint8)
            self._lines.thickness = 1.5 if level == "ok" else 3.0


class Trail:
    """Where a tool has been, coloured by what it felt, or in a `color` of its own."""

    def __init__(self, scene: viser.SceneApi, path: str, color: Rgb | None = None) -> None:
        self._scene = scene
        self._path = path
        self._color = color
        self._lines: viser.LineSegmentsHandle | None = None

    def show(self, points: Array, newtons: Array | None) -> None:
        """`points` (n, 3) [m] in the world and `newtons` (n,) felt there; no points, no trail."""
        if self._lines is not None:
            self._lines.remove()
            self._lines = None
        if len(points) < 2:
            return
        keep = np.unique(np.linspace(0, len(points) - 1, TRAIL_POINTS).round().astype(int))
        points = points[keep] + np.array([0.0, 0.0, TRAIL_LIFT])
        felt = force_color(np.zeros(len(keep)) if newtons is None else newtons[keep])
        colors = _unmanaged(felt if self._color is None else np.tile(np.array(self._color), (len(keep), 1)))
        self._lines = self._scene.add_line_segments(
            self._path,
            np.stack((points[:-1], points[1:]), axis=1).astype(_FLOAT),
            np.stack((colors[:-1], colors[1:]), axis=1),
            thickness=3.0,
            thickness_units="screen",
        )


def coarse(values: Array) -> Array:
    """Rounded to what one can see: the zeros at the end compress on the wire."""
    return np.round(values / RESOLUTION) * RESOLUTION


def _color(value: Array | float, levels: tuple[float, float, float]) -> Array:
    channels = [np.interp(value, levels, shades) for shades in zip(CALM, AMBER, RED, strict=True)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def _unmanaged(colors: Array) -> Array:
    """For viser's arrows and many-coloured lines, whose colours three.js takes as linear light."""
    return np.round(linear(colors / 255.0) * 255.0).astype(np.uint8)


def _tube_faces(rings: int, sides: int) -> Array:
    ring, side = (
        index.ravel() for index in np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    )
    here, across = ring * sides + side, ring * sides + (side + 1) % sides
    return np.concatenate(
        (
            np.column_stack((here, across, here + sides)),
            np.column_stack((across, across + sides, here + sides)),
        )
    )


def _turn_z_to(axis: Array) -> Array:
    """wxyz of the shortest turn from +z to a unit vector."""
    x, y, z = axis.tolist()
    if z < -1 + 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([1.0 + z, -y, x, 0.0])
    return np.asarray(quaternion / np.linalg.norm(quaternion))
