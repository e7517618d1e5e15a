"""The twin as a browser draws it: arm and board, ink where it was drawn, a review that is one person's."""

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import viser
from playwright.sync_api import Browser, Page

from controller.types import Array
from studio.board import Board
from studio.server import FrontServer, make_app, start_viser
from studio.tasks.wiping import BOARD_CENTER
from studio.ui.scene import LIVE, REVIEW, SceneModel, SceneView, hide, set_stage

pytestmark = pytest.mark.browser

SIZE = (180, 320)  # [px] height, width
PATIENCE = 60.0  # [s] for the browser to draw what it was sent
# From above, like a map: x to the right, y up.
ABOVE_BOARD = (0.5, 0.0, 0.75)
LOOKING_DOWN = (0.0, 1.0, 0.0, 0.0)
FIELD_OF_VIEW = 0.45  # [rad] vertically: the board's 28 cm fill most of the picture
FRONTS: dict[int, str] = {}  # URL of the front server before each viser port
PIXEL = 2 * (ABOVE_BOARD[2] - BOARD_CENTER[2]) * np.tan(FIELD_OF_VIEW / 2) / SIZE[0]  # [m] on the board


@pytest.fixture(scope="module")
def model() -> SceneModel:
    return SceneModel("wiping")


@pytest.fixture
def server(model: SceneModel) -> Iterator[viser.ViserServer]:
    server = start_viser()
    server.gui.configure_theme(dark_mode=True)
    set_stage(server, model)
    with FrontServer(make_app(server.get_port()), port=0) as front:  # viser itself answers no browser
        FRONTS[server.get_port()] = front.url
        yield server
    server.stop()


def upright(model: SceneModel) -> Array:
    """(nq,) the arm stretched out upwards, clear of the board."""
    qpos: Array = model.mujoco.qpos0.copy()
    qpos[model.mujoco.joint("right_shoulder_lift_joint").qposadr[0]] = -np.pi / 2
    return qpos


def open_page(page: Page, server: viser.ViserServer) -> viser.ClientHandle:
    known = set(server.get_clients())
    page.set_viewport_size({"width": 480, "height": 270})  # each pixel costs the processor
    page.goto(f"{FRONTS[server.get_port()]}/?fixedDpr=0.5")
    deadline = time.monotonic() + PATIENCE
    while not (new := set(server.get_clients()) - known):
        assert time.monotonic() < deadline, "The page never connected."
        page.wait_for_timeout(50)
    return server.get_clients()[new.pop()]


def photograph(client: viser.ClientHandle, position: tuple[float, ...] = ABOVE_BOARD) -> Array:
    return client.get_render(
        *SIZE, wxyz=LOOKING_DOWN, position=position, fov=FIELD_OF_VIEW, transport_format="png"
    )[..., :3].astype(float)


def wait_for(
    client: viser.ClientHandle, holds: Callable[[Array], bool], position: tuple[float, ...] = ABOVE_BOARD
) -> None:
    """Photograph until `holds`; what is seen last is told."""
    deadline = time.monotonic() + PATIENCE
    while not holds(picture := photograph(client, position)):
        if time.monotonic() > deadline:
            pytest.fail(
                f"The picture stays as it is: {board_in(picture).mean():.0f} on average on the board."
            )


def board_in(picture: Array) -> Array:
    """(n, n) brightness of the middle 20 cm of the board, the first row at the largest y."""
    half = round(0.10 / PIXEL)
    row, column = SIZE[0] // 2, SIZE[1] // 2
    middle: Array = picture.mean(axis=2)[row - half : row + half, column - half : column + half]
    return middle


def is_white(picture: Array) -> bool:
    return bool(board_in(picture).min() > 150)


def is_black(picture: Array) -> bool:
    return bool(board_in(picture).max() < 90)


def test_the_page_shows_the_twin(page: Page, server: viser.ViserServer, model: SceneModel) -> None:
    view = SceneView(server, model, LIVE)
    view.update(upright(model))
    client = open_page(page, server)
    wait_for(client, is_white)  # the board
    base = (0.0, 0.0, 1.8)
    # The shoulder's blue cap is the highest thing above the base; the table alone is near black.
    wait_for(client, lambda picture: bool((picture.max(axis=2) > 120).mean() > 0.02), base)
    view.visible = False
    wait_for(client, lambda picture: bool(picture.max() < 120), base)
    assert page.locator("canvas").first.is_visible()


def test_ink_is_seen_where_it_was_drawn(page: Page, server: viser.ViserServer, model: SceneModel) -> None:
    view = SceneView(server, model, LIVE)
    view.update(upright(model))
    board, spot = Board(), np.array([0.07, -0.03])  # [m] in board axes; no mirror or turn maps it to itself
    board.draw(np.array([spot, spot]), 0.015)
    view.set_ink(board.picture())
    client = open_page(page, server)
    wait_for(client, lambda picture: bool(board_in(picture).min() < 90))
    seen = board_in(photograph(client))
    rows, columns = np.nonzero(seen < 120)
    middle = (len(seen) - 1) / 2
    np.testing.assert_allclose(
        [(columns.mean() - middle) * PIXEL, (middle - rows.mean()) * PIXEL], spot, atol=0.004
    )


def test_a_reviewer_sees_the_take_and_others_the_robot(
    chromium: Browser, page: Page, server: viser.ViserServer, model: SceneModel
) -> None:
    clean, inked = Board(), Board()
    inked.grid[:] = 255
    live = SceneView(server, model, LIVE)
    live.update(upright(model))
    live.set_ink(clean.picture())
    reviewer = open_page(page, server)
    other_page = chromium.new_page()
    other = open_page(other_page, server)
    wait_for(reviewer, is_white)

    hidden = hide(reviewer)
    review = SceneView(reviewer, model, REVIEW)
    review.update(upright(model))
    review.set_ink(inked.picture())
    wait_for(reviewer, is_black)
    wait_for(other, is_white)

    review.remove()
    hidden.remove()
    wait_for(reviewer, is_white)
    other_page.close()
