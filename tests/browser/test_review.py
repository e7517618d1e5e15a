"""A person opens a take in a real browser, plays it, scrubs it, and sees what was felt."""

from __future__ import annotations

import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import viser
from playwright.sync_api import Locator, Page, expect

from controller.types import Array, rotation_of
from studio.api import DemoReport
from studio.catalog import Catalog
from studio.cursor import Cursor
from studio.episode import open_episode
from studio.server import FrontServer, make_app, start_viser
from studio.ui import scene
from studio.ui.episodes import EpisodesTab
from studio.ui.review import Review
from studio.ui.scene import SceneModel, SceneView

pytestmark = [
    pytest.mark.browser,
    # A page may close while something is being sent to it; viser warns that this is never delivered.
    pytest.mark.filterwarnings("ignore:Queued a:UserWarning"),
]


class Rig:
    """A page with an Episodes tab over two takes of wiping."""

    def __init__(self, data: Path) -> None:
        self.server = start_viser()
        self.front = FrontServer(make_app(self.server.get_port()), port=0)
        self.server.gui.configure_theme(dark_mode=True)
        self.server.gui.main_panel.dock_right()
        self.catalog = Catalog(data)
        model = SceneModel("wiping")
        scene.set_stage(self.server, model)
        SceneView(self.server, model, scene.LIVE)
        self.started = threading.Event()  # a hotkey that would drive the robot
        self.server.gui.add_command("Start", hotkey="R").on_trigger(lambda _: self.started.set())
        tab = self.server.gui.add_tab_group().add_tab("Episodes")
        self.episodes = EpisodesTab(self.server, tab, self.catalog, model=lambda _: model)

    @property
    def client(self) -> viser.ClientHandle:
        (client,) = self.server.get_clients().values()
        return client

    @property
    def review(self) -> Review:
        view = self.episodes.of(self.client.client_id)
        assert view is not None
        assert view.review is not None
        assert view.review.shown.wait(30)
        return view.review

    def close(self) -> None:
        self.episodes.close()
        self.server.stop()
        self.catalog.close()


@pytest.fixture
def rig(recorded: tuple[Path, DemoReport], tmp_path: Path) -> Iterator[Rig]:
    shutil.copytree(recorded[0] / "episodes", tmp_path / "episodes")
    rig = Rig(tmp_path)
    with rig.front:
        yield rig
    rig.close()


@pytest.fixture
def review(rig: Rig, page: Page) -> Review:
    """Of the take of seed 8, opened by a click."""
    page.goto(f"{rig.front.url}/?fixedDpr=0.5")
    page.get_by_role("button", name="wiping 8").click()
    expect(page.locator(".readout")).to_be_visible()
    return rig.review


def time_of(page: Page) -> float:
    """[s] as the page shows it."""
    return float(page.locator(".readout .time b").inner_text())


def enter_time(page: Page, at: float) -> None:
    box: Locator = page.locator("div:has(> .scrub) + div input[type=text]")
    box.fill(str(at))
    box.press("Enter")
    expect(page.locator(".readout .time b")).to_have_text(f"{at:.2f}")
    box.blur()


def arrow_of(client: viser.ClientHandle) -> Array | None:
    """(2, 3) [m] tail and tip of the force arrow that the client sees in its review."""
    handle = client.scene.get_handle_by_name(f"{scene.REVIEW}/forces/right/force")
    assert isinstance(handle, viser.ArrowsHandle)
    return np.array(handle.points[0], float) if handle.visible else None


def is_teal(client: viser.ClientHandle, point: Array) -> bool:
    """Whether the browser draws something of a force arrow's colour at `point` (3,) [m] of the world."""
    height, width = 360, 640
    image = client.get_render(height=height, width=width).astype(int)
    camera = client.camera
    x, y, z = rotation_of(camera.wxyz).T @ (point - camera.position)
    focal = 0.5 * height / np.tan(camera.fov / 2)
    column, row = round(width / 2 + focal * x / z), round(height / 2 + focal * y / z)
    red, green, blue = np.moveaxis(image[row - 3 : row + 4, column - 3 : column + 4, :3], -1, 0)
    return bool(((green - red > 40) & (blue - red > 30)).any())


def test_scrubbing_moves_the_force_arrow(review: Review, rig: Rig, page: Page) -> None:
    with open_episode(review.row.path) as episode:
        _, contact, _ = Cursor(episode).arms[0].phases
        pressing = round((contact.start + contact.end) / 2, 2)
        newtons = float(np.linalg.norm(Cursor(episode).at(pressing).arms[0].wrench.force))
    enter_time(page, 0.1)
    expect(page.locator(".readout .free")).to_be_visible()
    assert arrow_of(rig.client) is None
    enter_time(page, pressing)
    expect(page.locator(".readout .contact")).to_be_visible()
    assert float(page.locator(".readout .arm b").first.inner_text()) == pytest.approx(newtons, abs=0.1)
    arrow = arrow_of(rig.client)
    assert arrow is not None
    assert arrow[1, 2] > arrow[0, 2] + 0.015  # the board pushes the tool up
    wait_until(lambda: is_teal(rig.client, arrow.mean(axis=0)))
    enter_time(page, 0.1)
    wait_until(lambda: not is_teal(rig.client, arrow.mean(axis=0)))


def wait_until(holds: Callable[[], bool]) -> None:
    """A browser that renders in software draws late."""
    deadline = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.2)


def test_one_playhead_crosses_slider_bands_and_plots(review: Review, page: Page) -> None:
    enter_time(page, 4.0)
    share = 4.0 / review.row.duration
    line = page.locator(".playhead i").bounding_box()
    assert line is not None
    for row in (".rail >> nth=0", ".mantine-Slider-track", ".u-over >> nth=0", ".u-over >> nth=1"):
        box = page.locator(row).bounding_box()
        assert box is not None
        assert line["x"] + line["width"] / 2 == pytest.approx(box["x"] + share * box["width"], abs=2.5)


def test_keys_play_and_step_but_not_while_typing(review: Review, rig: Rig, page: Page) -> None:
    enter_time(page, 2.0)
    looks_from = rig.client.camera.position.copy()
    page.keyboard.press("ArrowRight")
    expect(page.locator(".readout .time b")).to_have_text("2.05")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    expect(page.locator(".readout .time b")).to_have_text("1.95")
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    wait_until(lambda: time_of(page) > 1.95)
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
    stopped = time_of(page)
    note = page.locator("textarea:visible").first
    note.click()
    page.keyboard.type("a b")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("R")
    assert note.input_value() == "a Rb"
    time.sleep(0.3)
    assert time_of(page) == stopped
    # The arrows, which also move viser's camera, have not.
    assert np.allclose(rig.client.camera.position, looks_from, atol=1e-3)


def test_keys_of_the_robot_do_nothing_during_a_review(review: Review, rig: Rig, page: Page) -> None:
    page.keyboard.press("r")
    assert not rig.started.wait(1.0)
    page.get_by_role("button", name=re.compile("All takes")).click()
    expect(page.locator(".readout")).to_have_count(0)
    page.keyboard.press("r")
    assert rig.started.wait(10.0)


def test_the_slider_is_dragged(review: Review, page: Page) -> None:
    box = page.locator(".mantine-Slider-track").bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 2, y)
    page.mouse.down()
    for share in np.linspace(0.1, 0.5, 9):
        page.mouse.move(box["x"] + share * box["width"], y)
    page.mouse.up()
    middle = review.row.duration / 2
    wait_until(lambda: time_of(page) == pytest.approx(middle, abs=0.1))
