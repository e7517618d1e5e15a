"""The headset's socket with a real session behind it: who may drive, what is refused, when the arm stops."""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Self

import httpx
import numpy as np
import pytest
from staged import Site
from visitor import wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from studio.api import Studio
from studio.headset import POSES
from studio.messages import EndTake, StartTake

FPS = 90.0


class Quest:
    """A headset's page: sends frames by itself, in WebXR's axes, and keeps what it is told."""

    def __init__(self, site: Site) -> None:
        self.hands: dict[str, dict[str, Any]] = {
            side: {"pose": [x, 1.1, -0.3, 0.0, 0.0, 0.0, 1.0], "buttons": [0.0] * 6}
            for side, x in (("left", -0.2), ("right", 0.2))
        }
        self.state: dict[str, Any] = {}
        self.binary: dict[bytes, bytes] = {}  # newest of each kind
        self.is_silent = False
        url = f"ws://127.0.0.1:{site.front.port}/xr/ws"
        self.socket = connect(url, compression=None, proxy=None)
        self.threads = [threading.Thread(target=run, daemon=True) for run in (self._show, self._read)]
        for thread in self.threads:
            thread.start()
        wait_for(lambda: self.state)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def say(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def press(self, side: str, button: int) -> None:
        for value in (1.0, 0.0):
            buttons = [0.0] * 6
            buttons[button] = value
            self.hands[side] = self.hands[side] | {"buttons": buttons}
            time.sleep(0.05)

    def move(self, side: str, *way: float, seconds: float = 0.4) -> None:
        """By a way [m] in WebXR's axes, as a person would."""
        start = self.hands[side]["pose"]
        for share in np.linspace(0.0, 1.0, round(seconds * FPS)):
            moved = [a + share * b for a, b in zip(start[:3], way, strict=True)]
            self.hands[side] = self.hands[side] | {"pose": [*moved, *start[3:]]}
            time.sleep(1 / FPS)

    def _show(self) -> None:
        try:
            while True:
                if not self.is_silent:
                    self.say(
                        type="frame",
                        t=time.perf_counter() * 1e3,
                        rtt=1.0,
                        head=[0.0, 1.6, 0.0, 0.0, 0.0, 0.0, 1.0],
                        **self.hands,
                    )
                time.sleep(1 / FPS)
        except ConnectionClosed:
            return

    def _read(self) -> None:
        try:
            for message in self.socket:
                if isinstance(message, bytes):
                    self.binary[message[:1]] = message[1:]
                elif (told := json.loads(message))["type"] == "state":
                    self.state = told
        except ConnectionClosed:
            return


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("headset"))
    yield site
    site.close()


@pytest.fixture
def site(stage: Site) -> Site:
    stage.begin()
    return stage


def test_a_hand_leads_its_arm_and_takes_hold_again_without_a_jump(site: Site) -> None:
    with Quest(site) as quest:
        before, other = site.target(), site.target(0)
        quest.press("right", 5)
        wait_for(lambda: site.is_engaged() and site.status.driver == "operator")
        assert np.abs(site.target() - before).max() < 1e-9  # engaging moved nothing
        quest.move("right", 0.0, 0.0, -0.05)  # ahead
        wait_for(lambda: np.abs(site.target()[:3] - before[:3] - [0.05, 0.0, 0.0]).max() < 1e-6)
        quest.press("right", 5)
        wait_for(lambda: not site.is_engaged())
        quest.move("right", 0.2, 0.1, 0.05)
        quest.press("right", 5)
        wait_for(site.is_engaged)
        assert np.abs(site.target()[:3] - before[:3] - [0.05, 0.0, 0.0]).max() < 1e-6
        quest.move("right", -0.03, 0.0, 0.0)  # to the left
        wait_for(lambda: np.abs(site.target()[:3] - before[:3] - [0.05, 0.03, 0.0]).max() < 1e-6)
        assert np.abs(site.target(0) - other).max() < 1e-9


def test_a_page_that_closes_stops_the_arm_at_once(site: Site) -> None:
    with Quest(site) as quest:
        quest.press("right", 5)
        wait_for(site.is_engaged)
        mover = threading.Thread(target=quest.move, args=("right", 0.0, 0.0, -0.2))
        mover.start()
        time.sleep(0.3)
        quest.socket.close()
        time.sleep(0.2)
        stopped = site.target()
        time.sleep(0.3)
        assert np.abs(site.target() - stopped).max() < 1e-6
        mover.join()
    wait_for(lambda: "closed" in site.hand().why)


def test_a_headset_that_falls_silent_stops_within_a_fifth_of_a_second(site: Site) -> None:
    with Quest(site) as quest:
        quest.press("left", 5)
        quest.press("right", 5)
        wait_for(lambda: site.is_engaged(0) and site.is_engaged(1))
        mover = threading.Thread(target=quest.move, args=("right", 0.0, 0.0, -0.2))
        mover.start()
        time.sleep(0.3)
        quest.is_silent = True
        time.sleep(0.2)
        stopped = site.target()
        mover.join()
        assert np.abs(site.target() - stopped).max() < 1e-9
        wait_for(lambda: not site.is_engaged() and "Nothing was heard" in site.hand().why)


@pytest.mark.parametrize("why", ["hidden", "blurred", "reset", "ended"])
def test_what_takes_the_headset_away_lets_go_and_says_so(site: Site, why: str) -> None:
    with Quest(site) as quest:
        quest.press("right", 5)
        wait_for(site.is_engaged)
        quest.is_silent = True
        quest.say(type="lost", why=why)
        wait_for(lambda: not site.is_engaged(), 0.5)
        wait_for(lambda: any(arm["why"] for arm in quest.state["arms"]))
        quest.is_silent = False
        time.sleep(0.2)
        assert not site.is_engaged()  # only the clutch takes hold again


def test_one_lost_hand_leaves_the_other_arm_alone(site: Site) -> None:
    with Quest(site) as quest:
        quest.press("left", 5)
        quest.press("right", 5)
        wait_for(lambda: site.is_engaged(0) and site.is_engaged(1))
        before = site.target(0)
        lost = quest.hands.pop("right")
        wait_for(lambda: not site.is_engaged(1))
        quest.move("left", 0.0, 0.03, 0.0)
        wait_for(lambda: abs(site.target(0)[2] - before[2] - 0.03) < 1e-6)
        quest.hands["right"] = lost
        assert site.is_engaged(0)


def test_only_who_drives_is_obeyed(site: Site) -> None:
    with Quest(site) as ana, Quest(site) as ben:
        ana.press("right", 5)
        wait_for(site.is_engaged)
        before = site.target(0)
        ben.press("left", 5)
        wait_for(lambda: "you asked for it" in ben.state["said"])
        ben.move("left", 0.0, 0.1, 0.0)
        assert not site.is_engaged(0)
        assert np.abs(site.target(0) - before).max() < 1e-9
        assert ana.state["is_mine"]
        assert not ben.state["is_mine"]


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        '{"type": "frame", "t": NaN}',
        '{"type": "frame", "t": 1, "right": {"pose": [0, 0, 0, 0, 0, 0, 0], "buttons": []}}',
        '{"type": "settings"}',
        "x" * 10_000_000,
    ],
    ids=["shape", "NaN", "no rotation", "incomplete", "10 MB"],
)
def test_what_no_page_says_ends_the_conversation_and_moves_nothing(site: Site, text: str) -> None:
    with Quest(site) as quest:
        quest.press("right", 5)
        wait_for(site.is_engaged)
        before = site.target()
        with suppress(ConnectionClosed):  # before all of it was taken
            quest.socket.send(text)
        wait_for(lambda: not site.is_engaged())
        assert np.abs(site.target()[:3] - before[:3]).max() < 1e-3  # it ran to where the arm is
        wait_for(lambda: not any(thread.is_alive() for thread in quest.threads))


def test_settings_that_do_not_fit_together_are_told(site: Site) -> None:
    with Quest(site) as quest:
        given = {"mapping": {"clutch": "trigger"}, "dead_band": 3, "full": 50, "strength": 1, "scale": 1}
        quest.say(type="settings", **given, view=0, one_arm="right", countdown=3)
        wait_for(lambda: "can do one thing only" in quest.state["said"])
        given |= {"mapping": {}, "scale": 2.0}
        quest.say(type="settings", **given, view=180, one_arm="right", countdown=0)
        before = site.target()
        quest.press("right", 5)
        wait_for(site.is_engaged)
        quest.move("right", 0.0, 0.0, -0.02)
        wait_for(lambda: abs(site.target()[0] - before[0] + 0.04) < 1e-6)  # twice as far, towards me


def test_a_take_with_two_hands_tells_how_they_reached_us_and_replays(site: Site) -> None:
    with Quest(site) as quest:
        quest.press("left", 5)
        quest.press("right", 5)
        wait_for(lambda: site.is_engaged(0) and site.is_engaged(1))
        site.remote.post(StartTake(countdown=0.0, operator="ana"))
        wait_for(lambda: site.status.phase == "recording")
        quest.move("left", 0.0, 0.02, 0.0)
        quest.move("right", 0.0, 0.02, 0.0)
        quest.press("right", 1)
        quest.hands.pop("left")
        wait_for(lambda: not site.is_engaged(0))
        site.remote.post(EndTake())
        take = wait_for(lambda: site.status.last_take)
    with Studio(site.data) as studio:
        assert studio.replay(take.episode_id).is_exact
        with studio.open(take.episode_id) as episode:
            columns = episode.columns("left/input", "right/input", "right/requested")
            events = [event.text for event in episode.events() if event.kind == "clutch"]
    age, latency = columns["right/input/age"], columns["right/input/latency"]
    assert len(age) > 60
    assert 0.0 < np.median(age) < 0.1
    assert 0.0 < np.median(latency) < np.median(age)
    assert len(columns["left/input/age"]) < len(age)  # it was lost in between
    assert any("not tracked" in text for text in events)
    stiffness = columns["right/requested/stiffness"][:, 0]
    assert len(set(stiffness[np.isfinite(stiffness)])) == 2  # the grip switched it


def test_nobody_feels_a_force_that_is_old(site: Site) -> None:
    with Quest(site) as quest:
        quest.press("right", 5)
        wait_for(lambda: quest.state["is_mine"])
        os.kill(site.process.pid, signal.SIGSTOP)
        try:
            wait_for(lambda: quest.state["session"] == "stuck", 5.0)
            assert all(arm["amplitude"] == 0.0 for arm in quest.state["arms"])
        finally:
            os.kill(site.process.pid, signal.SIGCONT)
        wait_for(lambda: quest.state["session"] == "open")


def test_the_scene_can_be_fetched(site: Site) -> None:
    url = f"http://127.0.0.1:{site.front.port}"
    scene = httpx.get(f"{url}/xr/scene/peg-cylinder", timeout=60).json()
    parts = [httpx.get(url + part).content for part in scene["parts"] if part]
    assert all(part.startswith(b"glTF") for part in parts)
    assert sum(map(len, parts)) < 4e6
    assert "Enter VR" in httpx.get(f"{url}/xr").text
    assert httpx.get(f"{url}/xr/scene/nothing").status_code == 404
    with Quest(site) as quest:
        quest.say(type="watch", twin=True)
        sent = wait_for(lambda: quest.binary.get(POSES))
        poses = np.frombuffer(sent, "<f4").reshape(-1, 7)
        assert len(poses) == len(parts) - 1  # what is fixed has no pose
        assert np.linalg.norm(poses[:, 3:], axis=1) == pytest.approx(1.0, abs=1e-5)
        assert math.isfinite(sum(quest.state["stage"]))
