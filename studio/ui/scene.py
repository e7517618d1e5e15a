"""The twin on the page: one viser node per moving body, and only what changed goes over the wire.

`SceneModel` is what a task looks like, built once; `SceneView` shows it, either to everybody (live, on the
server's scene) or to one person (a take under review, on that client's scene).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import viser

from controller.types import Array, Pose, Wrench
from studio import meshes, tasks
from studio.meshes import Mesh
from studio.messages import Level
from studio.tasks import ArmSetup
from studio.twin import build_model
from studio.ui import marks
from studio.ui.marks import Ghost, Trail, WorkspaceMark, WrenchMark

RATE = 30.0  # [Hz] at which a view is meant to be updated
INK_PERIOD = 0.2  # [s] between two pictures of the board; one is 2 kB, and eyes do not ask for more
PAPER_SHADE = 0.9  # the picture is not lit; as bright as it comes it would glare on a dark page

# From where one first looks at the work, in the world. One arm: from the right and a little ahead, its tool
# not behind it. Two arms: from behind, over the robot's shoulders, its right arm on the right.
ONE_ARM_VIEW = np.array([0.45, -0.85, 0.42])
TWO_ARM_VIEW = np.array([-0.75, -0.18, 0.62])

FIELD_OF_VIEW = float(np.radians(40.0))
ARM_WIDTH = 0.12  # [m] about, from a base's middle to the edge of the picture

LIVE = "/live"  # root of the view that everybody shares
REVIEW = "/review"  # root of a client's own view


@dataclass(frozen=True, slots=True)
class Node:
    """One moving body with all that is fixed to it."""

    path: str  # below the view's root; nested like the bodies, so that a resting joint costs nothing
    body: int
    parent: int  # body in whose frame the node's pose is given; 0 is the world
    glb: bytes  # empty for a body without anything to see


@dataclass(frozen=True, slots=True)
class GhostShape:
    """One arm's hand as hulls, in the frame of the body that carries it."""

    body: int  # that the real hand is fixed to
    tcp_from_body: Pose
    palm: Mesh  # with the part that the task has it hold
    fingers: tuple[tuple[int, str, Mesh], ...]  # index of the node it moves like, path, hull


@dataclass(frozen=True, slots=True)
class Picture:
    """The surface that a task paints on."""

    world_from_face: Pose  # x and y along the picture's columns and up its rows
    width: float  # [m]
    height: float  # [m]


class SceneModel:
    """What a task looks like. Views share one, in any thread."""

    def __init__(self, task: str) -> None:
        self.task = tasks.load(task)
        self._painting = threading.Lock()
        self.mujoco = build_model(self.task)
        self._at_rest = mujoco.MjData(self.mujoco)
        mujoco.mj_kinematics(self.mujoco, self._at_rest)
        self.fixed = self._glb(0)
        self.nodes = self._nodes()
        self.ghosts = tuple(self._ghost(arm) for arm in self.task.arms)
        self.picture = self._picture()
        self.bases = [self._at_rest.body(f"{arm.name}_base").xpos.copy() for arm in self.task.arms]  # [m]
        self.first_view = ONE_ARM_VIEW if len(self.task.arms) == 1 else TWO_ARM_VIEW

    def ink(self, state: Mapping[str, Array]) -> Array | None:
        """(h, w, 3) uint8 picture that the task has painted in `state`; None where it paints nothing."""
        with self._painting:  # views of several people may share the model
            self.task.restore(state)
            painted = self.task.texture()
        return None if painted is None else painted[1]

    def _pose(self, body: int) -> Pose:
        """world_from_body at rest."""
        return Pose(self._at_rest.xpos[body].copy(), self._at_rest.xquat[body].copy())

    def _from_body(self, group: int, body: int) -> Pose:
        """group_from_body, fixed to each other."""
        return self._pose(group).inverse() @ self._pose(body)

    def _members(self, group: int) -> list[int]:
        """The bodies that never move relative to body `group`, itself among them."""
        return np.flatnonzero(self.mujoco.body_weldid == group).tolist()

    def _glb(self, group: int) -> bytes:
        geoms = meshes.visible_geoms(self.mujoco, self._members(group))
        return meshes.glb_of(self.mujoco, geoms, lambda body: self._from_body(group, body)) if geoms else b""

    def _nodes(self) -> tuple[Node, ...]:
        paths = {0: ""}
        nodes = []
        for body in np.unique(self.mujoco.body_weldid).tolist():  # a parent comes before its children
            if body != 0:
                parent = int(self.mujoco.body_weldid[self.mujoco.body_parentid[body]])
                paths[body] = f"{paths[parent]}/{self.mujoco.body(body).name}"
                nodes.append(Node(paths[body], body, parent, self._glb(body)))
        return tuple(nodes)

    def _ghost(self, arm: ArmSetup) -> GhostShape:
        flange = self.mujoco.body(f"{arm.name}_flange").id
        group = int(self.mujoco.body_weldid[flange])
        body_from_flange = self._from_body(group, flange)
        is_hand = f"{arm.name}_hand"
        palm = [b for b in self._members(group) if self.mujoco.body(b).name.startswith(is_hand)]
        parts = [self._hull(palm, group)]
        if arm.grasp is not None:
            held = self.mujoco.body(arm.grasp.body).id
            body_from_held = body_from_flange @ arm.grasp.flange_from_body
            for geom in meshes.visible_geoms(self.mujoco, [held]):
                parts.append(meshes.hull([meshes.geom_mesh(self.mujoco, geom)]).moved(body_from_held))
        top = next(node.path for node in self.nodes if node.body == group)
        fingers = tuple(
            (index, node.path.removeprefix(top), self._hull(self._members(node.body), node.body))
            for index, node in enumerate(self.nodes)
            if node.path.startswith(f"{top}/")
        )
        tcp_from_body = (body_from_flange @ arm.flange_from_tcp).inverse()
        return GhostShape(group, tcp_from_body, meshes.merged(parts), fingers)

    def _hull(self, bodies: Sequence[int], group: int) -> Mesh:
        return meshes.hull(
            [
                meshes.geom_mesh(self.mujoco, geom).moved(
                    self._from_body(group, int(self.mujoco.geom_bodyid[geom]))
                )
                for geom in meshes.visible_geoms(self.mujoco, bodies)
            ]
        )

    def _picture(self) -> Picture | None:
        """Where the texture that the task paints lies: on the plane whose material uses it."""
        painted = self.task.texture()
        if painted is None:
            return None
        texture = self.mujoco.texture(painted[0]).id
        for geom in range(self.mujoco.ngeom):
            material = int(self.mujoco.geom_matid[geom])
            if material >= 0 and texture in self.mujoco.mat_texid[material]:
                width, height = (2.0 * self.mujoco.geom_size[geom][:2]).tolist()
                on_body = Pose(self.mujoco.geom_pos[geom].copy(), self.mujoco.geom_quat[geom].copy())
                return Picture(self._pose(int(self.mujoco.geom_bodyid[geom])) @ on_body, width, height)
        raise ValueError(f"Task {self.task.name!r} paints texture {painted[0]!r}, which no geom shows.")


class SceneView:
    """A scene on the page, under one root. One thread updates it."""

    def __init__(self, viewer: viser.ViserServer | viser.ClientHandle, model: SceneModel, root: str) -> None:
        """On a server everybody sees it; on a client, that person alone."""
        self.model = model
        self._viewer = viewer
        self._data = mujoco.MjData(model.mujoco)
        self._bodies = np.array([node.body for node in model.nodes])
        self._parents = np.array([node.parent for node in model.nodes])
        scene = viewer.scene
        with viewer.atomic():
            self._root = scene.add_frame(root, show_axes=False)
            self.ghosts = scene.add_frame(f"{root}/ghosts", show_axes=False)
            self.forces = scene.add_frame(f"{root}/forces", show_axes=False)
            self.workspaces = scene.add_frame(f"{root}/workspaces", show_axes=False)
            if model.fixed:
                _add_glb(scene, f"{root}/fixed", model.fixed)
            self._nodes: list[list[viser.SceneNodeHandle]] = [
                [_add_node(scene, root, node)] for node in model.nodes
            ]
            self._arms = [
                _ArmMarks(scene, root, setup, model, index) for index, setup in enumerate(model.task.arms)
            ]
            for arm, shape in zip(self._arms, model.ghosts, strict=True):
                for index, path, finger in shape.fingers:
                    self._nodes[index].append(arm.ghost.add(arm.ghost.path + path, finger))
            self._trail = [Trail(scene, f"{root}/trail/{setup.name}") for setup in model.task.arms]
            self._ink = _Ink(scene, f"{root}/ink", model.picture) if model.picture else None
        self._sent = np.full((len(model.nodes), 7), np.nan)
        self.update(model.mujoco.qpos0)

    @property
    def visible(self) -> bool:
        return self._root.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._root.visible = visible

    def update(
        self,
        qpos: Array,
        wrenches: Sequence[Wrench | None] = (),
        targets: Sequence[Pose | None] = (),
        levels: Sequence[Level] = (),
    ) -> None:
        """Show a state: `qpos` (nq,) and, per arm, what it feels, where it is sent and how that fared.

        `wrenches` about the TCP and `targets` as base_from_target, in base axes. What is missing is hidden.
        """
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model.mujoco, self._data)
        with self._viewer.atomic():
            self._move_bodies()
            for index, arm in enumerate(self._arms):
                wrench = wrenches[index] if index < len(wrenches) else None
                target = targets[index] if index < len(targets) else None
                arm.show(self._data, wrench, target, levels[index] if index < len(levels) else "ok")
            if self._ink is not None:
                self._ink.send()
        self._viewer.flush()  # inside the atomic block it would be spent on an empty window

    def set_ink(self, picture: Array) -> None:
        """Show what is painted, (h, w, 3) uint8 as `Task.texture` gives it.

        Sent only where it differs, a few times a second; the last one always gets there with a later update.
        """
        if self._ink is not None:
            self._ink.set(picture)

    def set_trail(self, arm: int, points: Array, newtons: Array | None = None) -> None:
        """Draw where a tool has been: (n, 3) [m] in the world, coloured by (n,) [N]; no points, no trail.

        A whole trail is sent each time, about 20 kB for the 600 points that a longer one is thinned to.
        """
        self._trail[arm].show(points, newtons)

    def remove(self) -> None:
        """Take everything off the scene; the view is of no use afterwards."""
        self._root.remove()

    def _move_bodies(self) -> None:
        poses = _relative_poses(self._data, self._bodies, self._parents)
        # A quaternion and its negative are one rotation: stay on the side that was sent.
        poses[:, 3:] *= np.where(np.sum(poses[:, 3:] * self._sent[:, 3:], axis=1) < 0.0, -1.0, 1.0)[:, None]
        rests = np.abs(poses - self._sent) < marks.RESOLUTION  # noise does not step back and forth
        poses = marks.coarse(poses)
        for index in np.flatnonzero(~rests[:, :3].all(axis=1)):
            self._sent[index, :3] = poses[index, :3]
            for handle in self._nodes[index]:
                handle.position = poses[index, :3]
        for index in np.flatnonzero(~rests[:, 3:].all(axis=1)):
            self._sent[index, 3:] = poses[index, 3:]
            for handle in self._nodes[index]:
                handle.wxyz = poses[index, 3:]


class _ArmMarks:
    """What one arm feels and where it is sent."""

    def __init__(
        self, scene: viser.SceneApi, root: str, setup: ArmSetup, model: SceneModel, index: int
    ) -> None:
        shape = model.ghosts[index]
        self.ghost = Ghost(scene, f"{root}/ghosts/{setup.name}", shape.palm)
        self._wrench = WrenchMark(scene, f"{root}/forces/{setup.name}", model.first_view)
        self._workspace = WorkspaceMark(scene, f"{root}/workspaces/{setup.name}", *setup.workspace)
        self._world_from_base = Pose(setup.base_position, np.array([1.0, 0.0, 0.0, 0.0]))
        self._tcp_from_body = shape.tcp_from_body
        self._body = shape.body
        self._tcp = model.mujoco.site(f"{setup.name}_tcp").id
        self._flange = model.mujoco.site(f"{setup.name}_flange").id

    def show(
        self, data: mujoco.MjData, wrench: Wrench | None, base_from_target: Pose | None, level: Level
    ) -> None:
        self._wrench.show(data.site_xpos[self._tcp], data.site_xpos[self._flange], wrench)
        self._workspace.show(level)
        world_from_ghost = None
        if base_from_target is not None:
            world_from_ghost = self._world_from_base @ base_from_target @ self._tcp_from_body
        self.ghost.show(world_from_ghost, Pose(data.xpos[self._body], data.xquat[self._body]), level)


class _Ink:
    """The painted picture as an image node: a new PNG replaces it, no geometry travels."""

    def __init__(self, scene: viser.SceneApi, path: str, picture: Picture) -> None:
        # viser lays an image out with x along its columns and y down its rows.
        flipped = Pose(np.array([0.0, 0.0, 0.0005]), np.array([0.0, 1.0, 0.0, 0.0]))
        face = picture.world_from_face @ flipped
        self._handle = scene.add_image(
            path,
            np.full((2, 2, 3), 238 * PAPER_SHADE, np.uint8),
            picture.width,
            picture.height,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            position=face.position,
            wxyz=face.wxyz,
        )
        self._pending: Array | None = None
        self._shown: Array | None = None
        self._due = 0.0

    def set(self, picture: Array) -> None:
        is_shown = self._shown is not None and np.array_equal(picture, self._shown)
        self._pending = None if is_shown else picture
        self.send()

    def send(self) -> None:
        """Send what is pending, unless the last one went just now."""
        now = time.monotonic()
        if self._pending is not None and now >= self._due:
            self._handle.image = (self._pending * PAPER_SHADE).astype(np.uint8)
            self._shown, self._pending, self._due = self._pending, None, now + INK_PERIOD


def set_stage(server: viser.ViserServer, model: SceneModel) -> None:
    """Table, light and first view, for everybody and for both kinds of view."""
    scene = server.scene
    low = np.min([arm.workspace[0] for arm in model.task.arms], axis=0)
    high = np.max([arm.workspace[1] for arm in model.task.arms], axis=0)
    center = (low + high) / 2
    scene.set_up_direction("+z")
    scene.configure_default_lights(cast_shadow=False)
    # An environment map must be filtered before anything is drawn: ten seconds where the browser draws in
    # software. Light from all sides comes from the sky instead.
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/sky", ground_color=(110, 114, 122), intensity=3.6, position=(0.0, 0.0, 1.0))
    scene.add_grid(
        "/table",
        width=2.4,
        height=2.4,
        cell_size=0.1,
        cell_color=(58, 62, 70),
        cell_thickness=0.6,
        section_size=0.5,
        section_color=(78, 84, 96),
        section_thickness=0.9,
        plane_color=(30, 33, 39),
        plane_opacity=1.0,
        fade_distance=4.0,
        shadow_opacity=0.0,
    )
    look_at = center - [0.12, 0.0, 0.0]
    look_at[2] = 0.22
    # All of the robot: between the panels the view is about as high as wide.
    reach = max(float(np.linalg.norm(base - look_at)) for base in model.bases)
    direction = model.first_view / np.linalg.norm(model.first_view)
    distance = (reach + ARM_WIDTH) / np.tan(FIELD_OF_VIEW / 2)
    position = look_at + distance * direction
    server.initial_camera.look_at = tuple(look_at)
    server.initial_camera.position = tuple(position)
    server.initial_camera.fov = FIELD_OF_VIEW
    for client in server.get_clients().values():  # those who came before there was a stage, or to another one
        with client.atomic():
            client.camera.position, client.camera.look_at = position, look_at
            client.camera.fov = FIELD_OF_VIEW


def hide(client: viser.ClientHandle, root: str = LIVE) -> viser.FrameHandle:
    """Hide what lies under `root` for one person; `remove()` on the result shows it again.

    A client's own node outranks the shared one of the same name, which goes on being updated behind it.
    """
    return client.scene.add_frame(root, show_axes=False, visible=False)


def _add_node(scene: viser.SceneApi, root: str, node: Node) -> viser.FrameHandle:
    frame = scene.add_frame(f"{root}{node.path}", show_axes=False)
    if node.glb:
        # As a leaf: viser mounts a mesh's children only once it is decoded, one after the other.
        _add_glb(scene, f"{root}{node.path}/mesh", node.glb)
    return frame


def _add_glb(scene: viser.SceneApi, path: str, glb: bytes) -> viser.GlbHandle:
    return scene.add_glb(path, glb, cast_shadow=False, receive_shadow=False)


def _relative_poses(data: mujoco.MjData, bodies: Array, parents: Array) -> Array:
    """(n, 7) parent_from_body: position [m], wxyz."""
    between = data.xpos[bodies] - data.xpos[parents]
    rotation = data.xmat[parents].reshape(-1, 3, 3)  # world_from_parent
    poses = np.empty((len(bodies), 7))
    poses[:, :3] = np.einsum("nji,nj->ni", rotation, between)
    aw, ax, ay, az = (data.xquat[parents] * [1.0, -1.0, -1.0, -1.0]).T
    bw, bx, by, bz = data.xquat[bodies].T
    poses[:, 3] = aw * bw - ax * bx - ay * by - az * bz
    poses[:, 4] = aw * bx + ax * bw + ay * bz - az * by
    poses[:, 5] = aw * by - ax * bz + ay * bw + az * bx
    poses[:, 6] = aw * bz + ax * by - ay * bx + az * bw
    return poses
