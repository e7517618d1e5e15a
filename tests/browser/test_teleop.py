"""The main line in a real browser: open the page, drag the gizmo to the board, switch, record; and a kill."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from served import Site
from visitor import wait_for

from controller.types import Array
from studio.link import socket_path
from studio.messages import ArmFrame, Status
from studio.serve import SessionProcess
from studio.ui.remote import Remote

pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]

EYE, LOOKS_AT, FOV = np.array([1.15, -0.75, 0.55]), np.array([0.42, 0.0, 0.12]), 0.7  # [m], [m], [rad]
PATIENCE = 60.0  # [s] with WebGL in software


class Operator:
    """A person at the page, and the session's own word for what really happened."""

    def __init__(self, page: Page, url: str, data: Path) -> None:
        self.page, self.remote = page, Remote()
        self.remote.connect(socket_path(data))
        page.set_viewport_size({"width": 1000, "height": 600})
        view = {"initialCameraPosition": EYE, "initialCameraLookAt": LOOKS_AT, "initialCameraFov": [FOV]}
        query = "&".join(f"{name}={'%2C'.join(map(str, values))}" for name, values in view.items())
        page.goto(f"{url}/?fixedDpr=0.3&{query}")
        self.settle()

    def settle(self) -> None:
        """Wait for the page, and close viser's complaint about software rendering, which lies over it."""
        self.button("Start take").wait_for()
        self.page.locator(".mantine-Notification-closeButton").first.click()

    @property
    def status(self) -> Status:
        status, _ = self.remote.status.get()
        assert status is not None
        return status

    @property
    def arm(self) -> ArmFrame:
        frame, _ = self.remote.frame.get()
        assert frame is not None
        return frame.arms[0]

    def button(self, name: str):  # type: ignore[no-untyped-def]
        return self.page.get_by_role("button", name=name).first

    def on_screen(self, point: Array) -> tuple[float, float]:
        """Where the browser draws a point of the world [px]."""
        canvas = max(
            (box for c in self.page.locator("canvas").all() if (box := c.bounding_box())),
            key=lambda box: box["width"] * box["height"],
        )
        away = (LOOKS_AT - EYE) / np.linalg.norm(LOOKS_AT - EYE)
        right = np.cross(away, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, away)
        x, y, z = np.array([right, up, away]) @ (point - EYE)
        f = canvas["height"] / 2 / np.tan(FOV / 2)
        return canvas["x"] + canvas["width"] / 2 + f * x / z, canvas["y"] + canvas["height"] / 2 - f * y / z

    def drag_down_until_touching(self, newtons: float) -> None:
        """By the gizmo's upward arrow."""
        arrow = np.array(self.arm.base_from_target[:3]) + np.array([0.0, 0.0, 0.12])
        self._grab(arrow)
        for step in range(60):
            if np.linalg.norm(self.arm.wrench[:3]) > newtons:
                break
            self.page.mouse.move(*self.on_screen(arrow - [0.0, 0.0, 0.006 * step]))
            self.page.wait_for_timeout(150)
        self.page.mouse.up()

    def _grab(self, arrow: Array) -> None:
        """A slow browser may not have drawn the gizmo yet; the mouse then turns the view instead."""
        for seconds in (2, 5, 10):
            self.page.wait_for_timeout(seconds * 1e3)
            self.page.mouse.move(*self.on_screen(arrow))
            self.page.mouse.down()
            self.page.mouse.move(*self.on_screen(arrow - [0.0, 0.0, 0.002]))
            self.page.wait_for_timeout(seconds * 1e3)
            if self.status.arms[0].input_age is not None:
                return
            self.page.mouse.up()
            self.page.reload()
            self.settle()
        raise AssertionError("The gizmo cannot be grabbed.")

    def says(self, text: str) -> None:
        expect(self.page.get_by_text(text).first).to_be_visible(timeout=PATIENCE * 1e3)

    def wait(self, condition) -> None:  # type: ignore[no-untyped-def]
        wait_for(condition, PATIENCE)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    yield site
    site.close()


def test_an_operator_touches_the_board_records_and_gets_over_a_crash(page: Page, site: Site) -> None:
    data, served = site.data, site.serve()
    ana = Operator(page, served.url(), data)
    ana.says("Your first take in three steps")

    # Typing is not pressing keys.
    page.locator("xpath=//label[.='Operator']/following::input[1]").fill("Rory")
    ana.button("Gizmo").click()
    ana.says("Rory")
    assert ana.status.phase == "idle"
    before = np.array(ana.arm.base_from_target)
    ana.wait(lambda: ana.status.arms[0].engaged)
    assert np.abs(np.array(ana.arm.base_from_target) - before).max() < 1e-9  # engaging moved nothing

    ana.drag_down_until_touching(5.0)
    ana.wait(lambda: np.linalg.norm(ana.arm.wrench[:3]) > 5.0)
    held = ana.arm.base_from_target
    stiff = float(np.linalg.norm(ana.arm.wrench[:3]))
    ana.button("Low 250").click()
    ana.wait(lambda: ana.status.arms[0].mode == "low")
    ana.wait(lambda: float(np.linalg.norm(ana.arm.wrench[:3])) < 0.7 * stiff)
    assert np.abs(np.array(ana.arm.base_from_target) - held).max() < 1e-9  # a still gizmo keeps its target
    ana.says("● Low 250 N/m")

    page.keyboard.press("r")
    ana.wait(lambda: ana.status.phase == "recording")
    take = ana.status.take_id
    page.reload()
    ana.button("Stop and keep").wait_for()
    assert ana.status.take_id == take
    page.keyboard.press("n")
    ana.wait(lambda: ana.status.last_take)
    ana.says(take)
    assert [path.name for path in data.glob("episodes/wiping/*.mcap")] == [f"{take}.mcap"]
    page.keyboard.press("x")  # the last take
    ana.button("Undo discard").click()
    ana.wait(lambda: list(data.glob("episodes/wiping/*.mcap")))

    page.keyboard.press("r")
    ana.wait(lambda: ana.status.take_seconds > 1.0)
    torn = ana.status.take_id
    pid = SessionProcess(data, "wiping").find()
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    ana.says(f"The take {torn} is kept; a restart recovers it.")
    ana.button("Restart session").click()
    ana.wait(lambda: (data / "episodes" / "wiping" / f"{torn}.mcap").exists())
    ana.button("Start take").wait_for()

    page.set_viewport_size({"width": 420, "height": 600})  # a phone: panels are folded up, the line stays
    expect(page.get_by_text("Contact force")).to_be_hidden()
    expect(page.locator("#status .rec")).to_be_visible()
    assert served.end() == 0
