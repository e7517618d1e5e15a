"""The twin on the page: its nodes stand where MuJoCo's bodies do, and only what changed is sent."""

import itertools
import time
from collections.abc import Iterator

import cv2
import mujoco
import numpy as np
import pytest
import viser
from visitor import wait_for

from controller.types import Array, Pose, Wrench
from studio import meshes
from studio.benchmarks import scene as benchmark
from studio.benchmarks.scene import Viewer
from studio.board import CELL, CELLS, HALF, Board
from studio.meshes import Mesh
from studio.server import start_viser
from studio.tasks.wiping import BOARD_CENTER
from studio.ui import marks
from studio.ui.marks import AMBER, CALM, RED, force_arrow, force_color
from studio.ui.scene import INK_PERIOD, LIVE, REVIEW, Picture, SceneModel, SceneView, hide, set_stage

TWO_ARMS = "studio.benchmarks.two_arms"


@pytest.fixture(scope="module")
def model() -> SceneModel:
    return SceneModel("wiping")


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = start_viser()
    yield server
    server.stop()


@pytest.fixture
def viewer(server: viser.ViserServer) -> Iterator[Viewer]:
    with Viewer(server) as viewer:
        yield viewer


def some_qpos(model: SceneModel, seed: int) -> Array:
    """Any joint angles, the eraser somewhere."""
    rng = np.random.default_rng(seed)
    qpos = rng.uniform(-1.0, 1.0, model.mujoco.nq)
    qpos[-4:] /= np.linalg.norm(qpos[-4:])
    return qpos


def last(viewer: Viewer, kind: str, name: str) -> dict[str, object]:
    """The newest message of a kind about a node."""
    return next(m for m in reversed(viewer.messages) if m["type"] == kind and m["name"] == name)


def pose_of(viewer: Viewer, name: str) -> Pose:
    """world_from_node as a browser puts it together from what it was sent."""
    world_from_node = Pose.identity()
    for path in itertools.accumulate(name.split("/")[1:], lambda path, part: f"{path}/{part}", initial=""):
        sent = [m for m in viewer.messages if m.get("name") == path]
        position = [m["position"] for m in sent if m["type"] == "SetPositionMessage"]
        wxyz = [m["wxyz"] for m in sent if m["type"] == "SetOrientationMessage"]
        rotation = np.array(wxyz[-1]) if wxyz and path else np.array([1.0, 0.0, 0.0, 0.0])
        world_from_node = world_from_node @ Pose(
            np.array(position[-1]) if position else np.zeros(3), rotation / np.linalg.norm(rotation)
        )
    return world_from_node


def is_visible(viewer: Viewer, name: str) -> object:
    return last(viewer, "SetSceneNodeVisibilityMessage", name)["visible"]


def test_each_node_stands_where_mujoco_has_its_body(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer
) -> None:
    view = SceneView(server, model, LIVE)
    data = mujoco.MjData(model.mujoco)
    data.qpos[:] = some_qpos(model, 1)
    view.update(some_qpos(model, 0))
    view.update(data.qpos)
    viewer.settle()
    mujoco.mj_kinematics(model.mujoco, data)
    for node in model.nodes:
        pose = pose_of(viewer, LIVE + node.path)
        np.testing.assert_allclose(pose.position, data.xpos[node.body], atol=2e-4)
        np.testing.assert_allclose(pose.rotation, data.xmat[node.body].reshape(3, 3), atol=2e-4)


def test_only_what_moved_is_sent(model: SceneModel, server: viser.ViserServer, viewer: Viewer) -> None:
    view = SceneView(server, model, LIVE)
    qpos = some_qpos(model, 0)
    view.update(qpos)
    viewer.settle()
    known = len(viewer.messages)
    qpos[model.mujoco.joint("right_wrist_2_joint").qposadr[0]] += 0.1
    view.update(qpos)
    viewer.settle()
    # One orientation: a joint does not displace its own body, and what it carries moves along in the tree.
    told = [(m["type"], m["name"].split("/")[-1]) for m in viewer.messages[known:]]
    assert told == [("SetOrientationMessage", "right_wrist_2_link")]


def test_a_still_scene_sends_nothing(model: SceneModel, server: viser.ViserServer, viewer: Viewer) -> None:
    view = SceneView(server, model, LIVE)
    qpos = some_qpos(model, 0)
    push = Wrench(np.array([1.0, 2.0, 9.0]), np.array([0.5, 0.0, 0.2]))
    target = Pose.of(np.eye(3), np.array([0.4, 0.0, 0.2]))
    view.update(qpos, [push], [target], ["limited"])
    viewer.settle()
    known = len(viewer.messages)
    view.update(qpos + 1e-7, [push], [target], ["limited"])
    viewer.settle()
    assert viewer.messages[known:] == []


def test_who_comes_late_sees_the_present(model: SceneModel, server: viser.ViserServer) -> None:
    view = SceneView(server, model, LIVE)
    data = mujoco.MjData(model.mujoco)
    for seed in range(3):
        data.qpos[:] = some_qpos(model, seed)
        view.update(data.qpos)
    mujoco.mj_kinematics(model.mujoco, data)
    with Viewer(server) as late:
        late.settle()
        hand = next(node for node in model.nodes if node.path.endswith("right_wrist_3_link"))
        np.testing.assert_allclose(pose_of(late, LIVE + hand.path).position, data.xpos[hand.body], atol=2e-4)


@pytest.mark.parametrize("cell", [(10, 20), (250, 20), (10, 240)])
def test_ink_lies_where_its_cell_is(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer, cell: tuple[int, int]
) -> None:
    board = Board()
    board.grid[cell] = 255
    view = SceneView(server, model, LIVE)
    view.set_ink(board.picture())
    viewer.settle()
    name = f"{LIVE}/ink"
    updates = [m["updates"] for m in viewer.messages if m["type"] == "SceneNodeUpdateMessage"]
    png = next(update["_data"] for update in updates if "_data" in update)
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    row, column = np.unravel_index(shown.argmin(), shown.shape)
    # viser lays an image out with x along its columns and y down its rows, centred (see the browser test).
    width, height = (
        last(viewer, "ImageMessage", name)["props"][key] for key in ("render_width", "render_height")
    )
    on_image = np.array([((column + 0.5) / CELLS - 0.5) * width, ((row + 0.5) / CELLS - 0.5) * height, 0.0])
    in_world = pose_of(viewer, name).apply(on_image)
    expected = BOARD_CENTER[:2] + (np.array(cell) + 0.5) * CELL - HALF
    np.testing.assert_allclose(in_world[:2], expected, atol=1e-5)
    assert BOARD_CENTER[2] < in_world[2] < BOARD_CENTER[2] + 0.002


def test_ink_is_sent_only_where_it_changed_and_the_last_arrives(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer
) -> None:
    board = Board()
    view = SceneView(server, model, LIVE)

    def pictures() -> list[bytes]:
        viewer.settle()
        updates = [m["updates"] for m in viewer.messages if m["type"] == "SceneNodeUpdateMessage"]
        return [update["_data"] for update in updates if "_data" in update]

    view.set_ink(board.picture())
    view.set_ink(board.picture())
    assert len(pictures()) == 1
    for level in (90, 160, 255):  # faster than pictures are sent
        board.grid[40:80] = level
        view.set_ink(board.picture())
    time.sleep(INK_PERIOD)
    view.update(model.mujoco.qpos0)
    newest = cv2.imdecode(np.frombuffer(pictures()[-1], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert newest.min() < 60  # of a full stroke; 90 of 255 would be 140
    assert len(pictures()[-1]) < 4000


def test_the_force_arrow_is_as_long_as_the_force_up_to_a_limit() -> None:
    force = np.array([1.0, -2.0, 5.0])
    np.testing.assert_allclose(force_arrow(2 * force), 2 * force_arrow(force))
    np.testing.assert_allclose(np.cross(force_arrow(force), force), 0.0, atol=1e-12)
    assert np.linalg.norm(force_arrow(100 * force)) == pytest.approx(marks.LONGEST_ARROW)
    assert not force_arrow(np.zeros(3)).any()


def test_colours_tell_the_level_of_force() -> None:
    for newtons, color in ((0.0, CALM), (5.0, CALM), (15.0, AMBER), (30.0, RED), (80.0, RED)):
        assert tuple(force_color(newtons)) == color
    assert force_color(np.array([[1.0, 15.0]])).shape == (1, 2, 3)
    assert tuple(force_color(10.0)) not in (CALM, AMBER)


@pytest.mark.parametrize("axis", [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0.6, 0, -0.8]])
def test_torque_turns_about_its_axis(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer, axis: list[float]
) -> None:
    view = SceneView(server, model, LIVE)
    view.update(some_qpos(model, 0), [Wrench(np.zeros(3), 2.0 * np.array(axis))])
    viewer.settle()
    arc = pose_of(viewer, f"{LIVE}/forces/right/torque")
    np.testing.assert_allclose(arc.rotation[:, 2], axis, atol=1e-4)
    assert is_visible(viewer, f"{LIVE}/forces/right/torque")
    assert not is_visible(viewer, f"{LIVE}/forces/right/force")


def test_the_torque_arc_grows_counter_clockwise() -> None:
    for angle in np.radians([30.0, 120.0, 300.0]):
        *_, tip = marks.torque_arc(angle).vertices
        assert np.arctan2(tip[1], tip[0]) % (2 * np.pi) == pytest.approx(angle, abs=0.02)
    assert len(marks.torque_arc(0.0).vertices) == len(marks.torque_arc(3.0).vertices)


def test_the_ghost_stands_at_the_target_and_vanishes_there(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer
) -> None:
    view = SceneView(server, model, LIVE)
    data = mujoco.MjData(model.mujoco)
    data.qpos[:] = some_qpos(model, 2)
    mujoco.mj_kinematics(model.mujoco, data)
    tcp = data.site("right_tcp")
    here = Pose.of(tcp.xmat.reshape(3, 3), tcp.xpos)
    ghost = f"{LIVE}/ghosts/right"
    away = Pose(here.position + np.array([0.0, 0.05, -0.02]), here.wxyz)
    view.update(data.qpos, targets=[away])
    viewer.settle()
    assert is_visible(viewer, ghost)
    # The ghost stands to the target as the hand's body does to the TCP.
    body = model.ghosts[0].body
    np.testing.assert_allclose(
        pose_of(viewer, ghost).position, data.xpos[body] + [0.0, 0.05, -0.02], atol=1e-4
    )
    view.update(data.qpos, targets=[here])
    viewer.settle()
    assert not is_visible(viewer, ghost)


def test_a_base_carries_its_arm_s_target(server: viser.ViserServer, viewer: Viewer) -> None:
    model = SceneModel(TWO_ARMS)
    view = SceneView(server, model, LIVE)
    target = Pose.of(np.eye(3), np.array([0.5, 0.1, 0.4]))
    view.update(model.mujoco.qpos0, targets=[target, target])
    viewer.settle()
    left, right = (pose_of(viewer, f"{LIVE}/ghosts/{arm.name}").position for arm in model.task.arms)
    bases = [arm.base_position for arm in model.task.arms]
    np.testing.assert_allclose(left - right, bases[0] - bases[1], atol=1e-4)


def test_a_refused_target_turns_ghost_and_workspace_red(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer
) -> None:
    view = SceneView(server, model, LIVE)
    target = Pose.of(np.eye(3), np.array([0.5, 0.1, 0.4]))
    view.update(some_qpos(model, 0), targets=[target], levels=["refused"])
    viewer.settle()
    palm = last(viewer, "SceneNodeUpdateMessage", f"{LIVE}/ghosts/right/palm")
    assert palm["updates"] == {"color": list(RED)}
    assert any(
        m["name"] == f"{LIVE}/workspaces/right"
        for m in viewer.messages
        if m["type"] == "SceneNodeUpdateMessage"
    )


def test_brackets_mark_the_corners_from_inside() -> None:
    low, high = np.array([0.2, -0.3, 0.0]), np.array([0.7, 0.3, 0.05])
    segments = marks.brackets(low, high)
    assert segments.shape == (24, 2, 3)
    assert (segments >= low - 1e-12).all()
    assert (segments <= high + 1e-12).all()
    assert len(np.unique(segments[:, 0], axis=0)) == 8


def test_a_long_trail_is_thinned(model: SceneModel, server: viser.ViserServer, viewer: Viewer) -> None:
    view = SceneView(server, model, LIVE)
    name = f"{LIVE}/trail/right"
    points = np.random.default_rng(0).normal(size=(10_000, 3))
    viewer.settle()
    before = viewer.bytes
    view.set_trail(0, points, np.linspace(0.0, 40.0, 10_000))
    viewer.settle()
    assert viewer.bytes - before < 25_000
    view.set_trail(0, np.empty((0, 3)))
    viewer.settle()
    assert last(viewer, "RemoveSceneNodeMessage", name)


def test_a_review_is_one_person_s(model: SceneModel, server: viser.ViserServer) -> None:
    live = SceneView(server, model, LIVE)
    with Viewer(server) as other, Viewer(server) as reviewer:
        for each in (other, reviewer):
            each.settle()
        client = server.get_clients()[1]
        hidden = hide(client)
        review = SceneView(client, model, REVIEW)
        review.update(some_qpos(model, 5))
        known = len(other.messages), len(reviewer.messages)
        live.update(some_qpos(model, 6))
        for each in (other, reviewer):
            each.settle()
        assert not is_visible(reviewer, LIVE)
        assert is_visible(other, LIVE)
        assert not [m for m in other.messages if m.get("name", "").startswith(REVIEW)]
        # The live scene goes on for both: whoever ends a review sees the present.
        assert len(other.messages) > known[0]
        assert len(reviewer.messages) > known[1]
        hidden.remove()
        review.remove()
        reviewer.settle()
        gone = {m["name"] for m in reviewer.messages if m["type"] == "RemoveSceneNodeMessage"}
        assert {LIVE, REVIEW, REVIEW + model.nodes[0].path} <= gone
        other.settle()
        assert not [m for m in other.messages if m["type"] == "RemoveSceneNodeMessage"]


def test_two_reviews_are_apart(model: SceneModel, server: viser.ViserServer) -> None:
    with Viewer(server) as first, Viewer(server) as second:
        for each in (first, second):
            each.settle()
        clients = server.get_clients()
        views = [SceneView(clients[n], model, REVIEW) for n in (0, 1)]
        for each in (first, second):
            each.settle()
        known = len(second.messages)
        views[0].update(some_qpos(model, 7))
        first.settle()
        assert len(second.messages) == known
        elbow = next(node for node in model.nodes if node.path.endswith("forearm_link"))
        assert not np.allclose(
            pose_of(first, REVIEW + elbow.path).position, pose_of(second, REVIEW + elbow.path).position
        )


def test_a_hidden_view_says_so(model: SceneModel, server: viser.ViserServer, viewer: Viewer) -> None:
    view = SceneView(server, model, LIVE)
    view.visible = False
    viewer.settle()
    assert not view.visible
    assert not is_visible(viewer, LIVE)


def test_a_scene_and_its_stream_are_small() -> None:
    measured = benchmark.measure(seconds=1.0)
    assert measured["one_arm_scene_MB"] < 1.3
    assert measured["two_arms_scene_MB"] < 2.6  # 3 MB with all the rest of the page
    assert measured["one_arm_stream_kB_per_s"] < 30.0
    assert measured["two_arms_stream_kB_per_s"] < 60.0


def test_the_stage_looks_at_the_work(model: SceneModel, server: viser.ViserServer) -> None:
    set_stage(server, model)
    camera = server.initial_camera
    low, high = model.task.arms[0].workspace
    assert (low[:2] < camera.look_at[:2]).all()
    assert (camera.look_at[:2] < high[:2]).all()
    assert camera.position[2] > camera.look_at[2]


def test_whoever_came_before_the_stage_looks_at_it_too(
    model: SceneModel, server: viser.ViserServer, viewer: Viewer
) -> None:
    wait_for(server.get_clients)
    set_stage(server, model)
    viewer.settle()
    *_, sent = [m["look_at"] for m in viewer.messages if m["type"] == "SetCameraLookAtMessage"]
    assert sent == pytest.approx(server.initial_camera.look_at)


def test_a_picture_lies_on_the_plane_that_shows_its_texture(model: SceneModel) -> None:
    match model.picture:
        case Picture(face, width, height):
            assert (width, height) == pytest.approx((2 * HALF, 2 * HALF))
            np.testing.assert_allclose(face.position[:2], BOARD_CENTER[:2])
        case None:
            pytest.fail("The board is painted.")
    assert SceneModel(TWO_ARMS).picture is None


def test_edges_stay_sharp_and_round_things_smooth() -> None:
    box, ball = Mesh(*_cube()), meshes._ellipsoid(np.ones(3))
    assert len(meshes.creased(box).vertices) == 24  # three at each corner
    assert len(meshes.creased(ball).vertices) == len(ball.vertices)
    for mesh in (box, ball):
        np.testing.assert_array_equal(
            meshes.creased(mesh).vertices[meshes.creased(mesh).faces], mesh.vertices[mesh.faces]
        )


def test_the_page_s_meshes_are_those_of_the_model(model: SceneModel) -> None:
    """Finer, but in the same place: their boxes agree, however much the model's own lost in decimation."""
    compiled = model.mujoco
    apart = []
    for mesh in range(compiled.nmesh):
        start = compiled.mesh_vertadr[mesh]
        coarse = compiled.mesh_vert[start : start + compiled.mesh_vertnum[mesh]]
        fine = meshes._asset(compiled, mesh)
        apart.append(np.abs(fine.vertices.min(axis=0) - coarse.min(axis=0)).max())
    assert np.median(apart) < 0.002  # [m]; with the pose of the mesh frame left out, 0.05


@pytest.mark.parametrize(
    ("kind", "size", "reach"),
    [
        ("BOX", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
        ("SPHERE", (0.1, 0, 0), (0.1, 0.1, 0.1)),
        ("CAPSULE", (0.1, 0.2, 0), (0.1, 0.1, 0.3)),  # the length is between the centres of its caps
        ("CYLINDER", (0.1, 0.2, 0), (0.1, 0.1, 0.2)),
        ("ELLIPSOID", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
    ],
)
def test_a_primitive_reaches_as_far_as_mujoco_s(
    kind: str, size: tuple[float, ...], reach: tuple[float, ...]
) -> None:
    spec = mujoco.MjSpec()
    place, turn = np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.8, 0.0, 0.0])
    geom_type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")
    spec.worldbody.add_geom(type=geom_type, size=size, pos=place, quat=turn)
    mesh = meshes.geom_mesh(spec.compile(), 0).moved(Pose(place, turn).inverse())
    np.testing.assert_allclose(mesh.vertices.max(axis=0), reach, rtol=0.02)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), -np.array(reach), rtol=0.02)


def test_what_only_collides_is_not_drawn() -> None:
    spec = mujoco.MjSpec()
    for name, group, alpha in (("seen", 0, 1.0), ("collides", 3, 1.0), ("clear", 0, 0.0)):
        spec.worldbody.add_geom(name=name, size=(0.1, 0, 0), group=group, rgba=(1, 1, 1, alpha))
    compiled = spec.compile()
    assert [compiled.geom(geom).name for geom in meshes.visible_geoms(compiled, [0])] == ["seen"]


def test_a_geom_that_cannot_be_drawn_is_named() -> None:
    spec = mujoco.MjSpec()
    spec.add_hfield(name="hills", size=(1, 1, 1, 1), nrow=2, ncol=2, userdata=[0, 0, 0, 1])
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hills")
    compiled = spec.compile()
    with pytest.raises(ValueError, match="'ground' is a mjGEOM_HFIELD"):
        meshes.geom_mesh(compiled, 0)


def _cube() -> tuple[Array, Array]:
    vertices = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return vertices, np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))
