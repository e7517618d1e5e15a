"""Images show the state they say; without OpenGL, or when it dies, only the images are lost."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from agents import STAY, Listener, Script

from controller.types import Action, ArmAction, CartesianTarget, Hold, Pose
from studio import tasks
from studio.cameras import HEIGHT, PACKAGES, PERIOD, WIDTH, CameraProcess, LiveCameras, RenderedCameras
from studio.session import Session
from studio.station import Station
from studio.tasks.wiping import BOARD_CENTER
from studio.twin import Twin


@pytest.fixture(scope="module")
def rendered() -> Iterator[RenderedCameras]:
    cameras = RenderedCameras("wiping")
    if cameras.error:
        pytest.skip(cameras.error)
    yield cameras
    cameras.close()


@pytest.fixture(scope="module")
def watched(rendered: RenderedCameras) -> Twin:
    """A twin with cameras. Reset it first."""
    return Twin(tasks.load("wiping"), cameras=rendered)


@pytest.fixture(params=["raise ImportError('no OpenGL on this machine')", "import os; os.abort()"])
def broken_opengl(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Every new process finds an OpenGL that fails, or aborts the process."""
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text(request.param)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return str(request.param)


def test_images_have_the_size_and_the_time_of_their_state(watched: Twin) -> None:
    watched.reset(0)
    listener = Listener()
    Session(watched).run(Script([STAY] * 20), [listener], time_limit=1.0)
    first = listener.steps[0].observation
    assert set(first.images) == {"front", "right_wrist"}
    for image in first.images.values():
        assert image.time == first.time == 0.0
        assert image.pixels.shape == (HEIGHT, WIDTH, 3)
        assert image.pixels.std() > 10  # something is to be seen
        decoded = cv2.imdecode(np.frombuffer(image.jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.abs(decoded.astype(int) - image.pixels).mean() < 5
    ages = [step.observation.time - step.observation.images["front"].time for step in listener.steps]
    np.testing.assert_allclose(ages, [0.0, 0.01, 0.02, 0.03, 0.04] * 4, atol=1e-9)


def test_the_same_state_gives_the_same_pixels(watched: Twin) -> None:
    watched.reset(3)
    one = watched.observe().images
    watched.reset(4)
    other = watched.observe().images
    watched.reset(3)
    again = watched.observe().images
    for camera in one:
        np.testing.assert_array_equal(one[camera].pixels, again[camera].pixels)
    assert not np.array_equal(one["front"].pixels, other["front"].pixels)  # the mark is elsewhere


def test_an_image_shows_where_the_arm_is(watched: Twin) -> None:
    watched.reset(0)
    before = watched.observe()
    pose = before.arms[0].base_from_tcp
    aside = Pose(pose.position + np.array([0.0, 0.15, 0.0]), pose.wxyz)
    target = CartesianTarget(aside, watched.arms[0].servo.stiffness)
    Session(watched).run(Script([Action((ArmAction(target, 0.0),))] * 150), time_limit=9.0)
    after = watched.observe()
    changed = before.images["right_wrist"].pixels != after.images["right_wrist"].pixels
    assert changed.any(axis=2).mean() > 0.2


def test_ink_appears_in_the_image_where_it_was_drawn(watched: Twin) -> None:
    watched.reset(0)
    board = watched.task.board  # type: ignore[attr-defined]
    board.clear()
    clean = watched.observe().images["front"].pixels.astype(int)
    board.draw(np.array([[0.0, 0.08], [0.0, 0.12]]), radius=0.01)  # at +y of the board's centre
    for _ in range(5):
        watched.apply(Action((ArmAction(Hold(), 0.0),)))
    darker = clean - watched.observe().images["front"].pixels > 60
    rows, columns = np.nonzero(darker.all(axis=2))
    assert len(rows) > 20
    # The front camera looks back at the robot from +x: +y of the world is on its right.
    expected = _in_front_image(watched, BOARD_CENTER + np.array([0.0, 0.10, 0.0]))
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=4)


def _in_front_image(twin: Twin, point: np.ndarray) -> np.ndarray:
    """(column, row) of a point of the world, by the pinhole model."""
    camera = twin.data.camera("front")
    x, y, z = camera.xmat.reshape(3, 3).T @ (point - camera.xpos)
    focal = HEIGHT / 2 / np.tan(np.radians(twin.model.camera("front").fovy[0]) / 2)
    return np.array([WIDTH / 2 - focal * x / z, HEIGHT / 2 + focal * y / z])


def test_without_opengl_the_message_says_what_to_install(broken_opengl: str) -> None:
    with pytest.raises(RuntimeError, match="No camera images") as refused:
        CameraProcess("wiping")
    told = str(refused.value)
    assert "egl: " in told
    assert "osmesa: " in told
    assert f"apt-get install {PACKAGES}" in told
    if "ImportError" in broken_opengl:
        assert "no OpenGL on this machine" in told


def test_without_opengl_a_take_is_recorded_without_images(broken_opengl: str, tmp_path: Path) -> None:
    with Station("wiping", tmp_path) as station:
        take = station.record(lambda twin: Script([STAY] * 10), agent_name="test", seed=0)
        assert "No camera images" in (station.camera_error or "")
    assert take.path.exists()
    assert take.error is None


def test_killing_the_camera_process_costs_the_images_only() -> None:
    cameras = RenderedCameras("wiping")
    if cameras.error:
        pytest.skip(cameras.error)
    twin, listener = Twin(tasks.load("wiping"), cameras=cameras), Listener()
    assert twin.observe().images
    assert cameras._process is not None
    os.kill(cameras._process.pid, signal.SIGKILL)
    ending = Session(twin).run(Script([STAY] * 20), [listener], time_limit=1.0)
    assert ending.reason == "finished"
    assert len(listener.steps) == 20
    assert listener.steps[-1].observation.images == {}
    assert cameras.error == "No more camera images: the camera process has ended."
    cameras.close()


def test_live_cameras_never_wait_and_show_the_offered_state(twin: Twin) -> None:
    cameras = LiveCameras("wiping")
    try:
        twin.reset(0)
        begin = time.monotonic()
        assert cameras.newest(twin) == {}
        assert time.monotonic() - begin < 0.5  # a camera process takes a second to start
        _wait(lambda: cameras.newest(twin) or cameras.error)
        if cameras.error:
            pytest.skip(cameras.error)
        Session(twin).run(Script([STAY] * 12), time_limit=1.0)
        now = twin.data.time
        cameras.newest(twin)
        _wait(lambda: cameras.newest(twin)["front"].time == now)
    finally:
        cameras.close()
    assert PERIOD == 0.05


def _wait(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("name", ["wiping", "bimanual-wiping"])
def test_hidden_objects_and_marks_are_not_seen(rendered: RenderedCameras, name: str) -> None:
    twin, scenes = Twin(tasks.load(name)), []
    for seed in (1, 2):
        twin.reset(seed)
        painted = twin.task.texture()
        scenes.append((twin.data.qpos.copy(), None if painted is None else painted[1].copy()))
    # The arms and what they hold are seen in both, so they must be in the same place.
    held = {arm.grasp.body for arm in twin.task.arms if arm.grasp}
    first, second = scenes[0][0], scenes[1][0].copy()
    for joint in range(twin.model.njnt):
        body = twin.model.body(int(twin.model.jnt_bodyid[joint])).name
        start = int(twin.model.jnt_qposadr[joint])
        end = int(twin.model.jnt_qposadr[joint + 1]) if joint + 1 < twin.model.njnt else twin.model.nq
        if twin.model.jnt_type[joint] != 0 or body in held:
            second[start:end] = first[start:end]
    for hide in (False, True):
        cameras = CameraProcess(name, 60, 80, hide_objects=hide)
        one = cameras.render(0.0, first, scenes[0][1])["front"].pixels
        other = cameras.render(0.0, second, scenes[1][1])["front"].pixels
        cameras.close()
        assert np.array_equal(one, other) == hide
