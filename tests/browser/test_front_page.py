"""viser's page, through the front server, in a real browser."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from playwright.sync_api import Page

from studio.server import FrontServer, make_app, start_viser

pytestmark = pytest.mark.browser


@pytest.fixture
def viewer() -> Iterator[viser.ViserServer]:
    server = start_viser()
    yield server
    server.stop()


def test_the_page_shows_the_scene_and_a_click_reaches_python(page: Page, viewer: viser.ViserServer) -> None:
    viewer.scene.configure_default_lights(cast_shadow=False)
    viewer.scene.set_background_image(np.zeros((2, 2, 3), np.uint8))
    viewer.scene.add_box("/box", color=(255, 0, 0), dimensions=(2.0, 2.0, 2.0))
    viewer.initial_camera.position, viewer.initial_camera.look_at = (4.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    pressed, sockets = threading.Event(), []
    viewer.gui.add_button("Press me").on_click(lambda _: pressed.set())
    page.on("websocket", lambda websocket: sockets.append(websocket.url))
    with FrontServer(make_app(viewer.get_port()), port=0) as front:
        page.goto(f"{front.url}/?fixedDpr=0.5")
        page.get_by_role("button", name="Press me").click()
        assert pressed.wait(10)
        assert page.get_by_role("button", name="Share").count() == 0
        (client,) = viewer.get_clients().values()
        image = client.get_render(height=90, width=160)
    red, green, blue = image[45, 80, :3]
    assert red > 100 > 50 > max(green, blue)
    assert {url.split("/")[2] for url in sockets} == {f"127.0.0.1:{front.port}"}
