"""A person with a Quest 3, which IWER emulates: engage, move, press, feel, be lost, record, replay."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from staged import Site
from visitor import wait_for

from studio.api import Studio
from studio.server import WEB_ASSETS

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]

IWER = WEB_ASSETS / "node_modules" / "iwer" / "build" / "iwer.min.js"
QUEST = """
;window.xd = new IWER.XRDevice(IWER.metaQuest3, {stereoEnabled: false});
xd.installRuntime({forceInstall: true});  // Chromium offers WebXR, too, but has no headset here
window.pulses = [];
for (const side of ["left", "right"]) {
  const actuator = xd.controllers[side].inputSource.gamepad.hapticActuators[0];
  actuator.pulse = async (value, duration) => pulses.push({side, value, duration, at: performance.now()});
}
window.moveHand = async (side, way, steps) => {
  const {position} = xd.controllers[side];
  for (let n = 0; n < steps; n++) {
    await new Promise((resolve) => setTimeout(resolve, 30));
    position.set(position.x + way[0] / steps, position.y + way[1] / steps, position.z + way[2] / steps);
  }
};
"""


class Operator:
    """In the headset; everything is drawn small, as a processor draws it."""

    def __init__(self, page: Page, site: Site, **settings: object) -> None:
        self.page, self.site = page, site
        page.set_viewport_size({"width": 160, "height": 120})
        page.add_init_script(IWER.read_text() + QUEST)
        page.goto(f"http://127.0.0.1:{site.front.port}/xr")
        page.wait_for_selector("#vr:enabled", state="attached")
        for name, is_shown in ({"twin": False, "images": False} | settings).items():
            page.evaluate(f"settings.elements.{name}.checked = {str(is_shown).lower()}; settings.oninput()")

    def enter(self, how: str = "vr") -> None:
        self.page.evaluate(f"document.getElementById('{how}').click()")
        self.page.wait_for_function("xd.activeSession?.visibilityState === 'visible'")
        self.page.wait_for_timeout(300)

    def set(self, side: str, button: str, value: float) -> None:
        self.page.evaluate(f"xd.controllers.{side}.updateButtonValue('{button}', {value})")
        self.page.wait_for_timeout(150)  # some frames

    def press(self, side: str, button: str) -> None:
        self.set(side, button, 1.0)
        self.set(side, button, 0.0)

    def engage(self, side: str) -> None:
        self.press(side, "b-button" if side == "right" else "y-button")
        wait_for(lambda: self.site.is_engaged(("left", "right").index(side) if self.is_two else 0))

    @property
    def is_two(self) -> bool:
        return len(self.site.status.arms) == 2

    def move(self, side: str, *way: float, steps: int = 15) -> None:
        """By a way [m] in WebXR's axes: right, up, back."""
        self.page.evaluate("([side, way, steps]) => moveHand(side, way, steps)", [side, list(way), steps])

    def pulses(self) -> list[dict[str, Any]]:
        """Those since the last call."""
        felt: list[dict[str, Any]] = self.page.evaluate("pulses.splice(0)")
        return felt


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    if not IWER.exists():
        pytest.skip("needs iwer: npm ci --prefix web_assets")
    site = Site(tmp_path_factory.mktemp("xr"))
    yield site
    site.close()


@pytest.fixture
def site(stage: Site) -> Site:
    stage.begin("peg-cylinder")
    return stage


def reached(site: Site, start: Any, *way: float) -> bool:
    return bool(np.abs(site.target()[:3] - start[:3] - way).max() < 1e-4)


def test_the_arm_follows_the_hand_and_takes_hold_again_without_a_jump(page: Page, site: Site) -> None:
    ana = Operator(page, site, twin=True)
    ana.enter()
    start = site.target()
    ana.engage("right")
    joints = site.joints()
    time.sleep(0.3)
    assert np.abs(site.joints() - joints).max() < 1e-4  # engaging moved nothing
    ana.move("right", 0.02, 0.03, -0.04)
    wait_for(lambda: reached(site, start, 0.04, -0.02, 0.03))
    wait_for(lambda: np.abs(np.array(site.arm().base_from_tcp[:3]) - site.target()[:3]).max() < 2e-3)
    ana.press("right", "b-button")
    wait_for(lambda: not site.is_engaged())
    joints = site.joints()
    ana.move("right", -0.1, 0.1, 0.1)
    ana.engage("right")
    time.sleep(0.5)
    assert reached(site, start, 0.04, -0.02, 0.03)
    assert np.abs(site.joints() - joints).max() < 1e-3
    fetched = page.evaluate("performance.getEntriesByType('resource').map(({name}) => name)")
    assert any("/xr/scene/peg-cylinder/" in name for name in fetched)


def test_trigger_squeeze_and_record_do_what_the_paper_says(page: Page, site: Site) -> None:
    ana = Operator(page, site)
    ana.enter("ar")
    ana.engage("right")
    before = site.arm().gripper
    ana.set("right", "trigger", 1.0)
    ana.set("right", "trigger", 0.3)
    wait_for(lambda: abs(site.status.arms[1].opening - 0.7) < 0.01)
    wait_for(lambda: site.arm().gripper > before + 0.05)
    opened = site.arm().gripper
    ana.set("right", "trigger", 1.0)
    wait_for(lambda: site.arm().gripper < opened - 0.05)
    stiffness = site.arm().stiffness
    ana.press("right", "squeeze")
    wait_for(lambda: site.arm().stiffness == stiffness / 2)  # medium 500, low 250
    ana.press("right", "squeeze")
    wait_for(lambda: site.arm().stiffness == stiffness)


def test_pressing_the_board_is_felt_and_pressing_harder_is_felt_more(page: Page, stage: Site) -> None:
    stage.begin("wiping")
    ana = Operator(page, stage)
    ana.enter()
    ana.engage("right")
    light = press_until(ana, stage, 10.0)
    hard = press_until(ana, stage, 25.0)
    assert 0.0 < light < hard <= 1.0
    stage.remote.close()  # no more states: silence
    time.sleep(0.3)
    ana.pulses()
    time.sleep(0.3)
    assert ana.pulses() == []
    stage.remote.connect(stage.socket)


def press_until(ana: Operator, stage: Site, newtons: float) -> float:
    """The median of the pulses while the arm presses so hard."""
    for _ in range(80):
        if np.linalg.norm(stage.arm(0).wrench[:3]) > newtons:
            break
        ana.move("right", 0.0, -0.01, 0.0, steps=2)
        ana.page.wait_for_timeout(100)  # the arm follows, also on a busy machine
    ana.page.wait_for_timeout(500)
    ana.pulses()
    ana.page.wait_for_timeout(500)
    felt = ana.pulses()
    assert np.median(np.diff([pulse["at"] for pulse in felt])) <= 50.0  # [ms] 20 Hz at least
    assert {pulse["side"] for pulse in felt} == {"right"}
    assert all(pulse["duration"] <= 200 for pulse in felt)
    return float(np.median([pulse["value"] for pulse in felt]))


LOSSES = (  # what happens, how it ends, what the operator is told
    ("xd.updateVisibilityState('hidden')", "xd.updateVisibilityState('visible')", "taken off"),
    ("xd.updateVisibilityState('visible-blurred')", "xd.updateVisibilityState('visible')", "menu"),
    ("xd.recenter()", "", "recentred"),
    ("xd.controllers.right.connected = false", "xd.controllers.right.connected = true", "not tracked"),
    ("xd.primaryInputMode = 'hand'", "xd.primaryInputMode = 'controller'", "tracked"),
    ("xd.activeSession.end()", "", "ended"),
)


def test_whatever_ends_the_view_stops_the_arm_and_says_why(page: Page, site: Site) -> None:
    ana = Operator(page, site)
    ana.enter()
    for event, undo, words in LOSSES:
        ana.engage("right")
        page.evaluate("void moveHand('right', [0, 0, -0.1], 20)")
        time.sleep(0.3)
        page.evaluate(event)
        assert_stops(site)
        wait_for(lambda words=words: not site.is_engaged() and words in site.hand().why)
        page.evaluate(undo)
        page.wait_for_timeout(300)
        assert not site.is_engaged()
    expect(page.locator("#said")).to_contain_text("The session has ended")


def assert_stops(site: Site) -> None:
    """Within 0.2 s."""
    time.sleep(0.2)
    stopped = site.target()
    time.sleep(0.2)
    assert np.abs(site.target()[:3] - stopped[:3]).max() < 1e-4


def test_killing_the_page_stops_the_arm(chromium: Browser, site: Site) -> None:
    context = chromium.new_context()
    page = context.new_page()
    ana = Operator(page, site)
    ana.enter()
    ana.engage("right")
    page.evaluate("void moveHand('right', [0, 0, -0.3], 60)")
    time.sleep(0.5)
    context.close()
    assert_stops(site)
    wait_for(lambda: not site.is_engaged())


def test_a_take_with_both_hands_is_recorded_from_the_controller_and_replays(page: Page, site: Site) -> None:
    ana = Operator(page, site)
    page.evaluate("countdown.value = 0; settings.oninput()")
    ana.enter()
    ana.engage("left")
    ana.engage("right")
    ana.press("right", "a-button")
    wait_for(lambda: site.status.phase == "recording")
    ana.move("left", 0.0, 0.03, 0.0)
    ana.move("right", 0.0, 0.03, 0.0)
    ana.press("right", "a-button")
    take = wait_for(lambda: site.status.last_take)
    with Studio(site.data) as studio:
        assert studio.replay(take.episode_id).is_exact
        with studio.open(take.episode_id) as episode:
            columns = episode.columns()
    for arm in ("left", "right"):
        height = columns[f"{arm}/requested/base_from_target"][:, 2]
        assert height[-1] - height[0] == pytest.approx(0.03, abs=2e-3)
        assert np.isfinite(columns[f"{arm}/input/age"]).all()
