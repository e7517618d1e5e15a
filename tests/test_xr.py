"""Controllers as an operator: what their buttons mean, and what of a headset's messages is believed."""

from __future__ import annotations

import json
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.types import Pose, quaternion_from_rotation_vector
from studio import messages as m
from studio.inputs import xr
from studio.inputs.controllers import (
    GRIP_AS_CLUTCH,
    LONG,
    Button,
    Controller,
    Controllers,
    Mapping,
    Moment,
    Settings,
    Side,
)

ARM = m.ArmStatus(
    name="right", mode="medium", modes=("medium", "low"), engaged=False, level="ok", why="", input_age=None
)
LEFT = msgspec.structs.replace(ARM, name="left")
STATUS = m.Status(
    task="wiping",
    instruction="",
    seed=0,
    spread=1.0,
    resets=1,
    driver="nobody",
    operator="",
    phase="idle",
    countdown=0.0,
    take_seconds=0.0,
    take_id="",
    last_take=None,
    collected=0,
    to_collect=0,
    progress=0.0,
    success=False,
    task_phase="",
    arms=(ARM,),
    rate=100.0,
    late_share=0.0,
    worst_delay=0.0,
    camera_error="",
)
TWO_ARMS = msgspec.structs.replace(STATUS, arms=(LEFT, ARM))
RECORDING = msgspec.structs.replace(STATUS, phase="recording")
HEAD = Pose(np.array([0.0, 0.0, 1.6]), np.array([1.0, 0.0, 0.0, 0.0]))
FREE: dict[Button, float] = {"menu": 0.0, "trigger": 0.0, "squeeze": 0.0, "primary": 0.0, "stick": 0.0}


class Player:
    """Somebody with two controllers."""

    def __init__(self, settings: Settings | None = None, status: m.Status = STATUS) -> None:
        self.sent: list[m.Command] = []
        self.status, self.time = status, 0.0
        self.controllers = Controllers(self.sent.append, settings or Settings(view=0.0))
        self.show()

    def show(self, *sides: Side, head: Pose = HEAD, **buttons: float) -> list[m.Command]:
        """One sample of the controllers, 10 ms after the one before; what they asked for besides motion."""
        self.sent.clear()
        self.time += 0.01
        controller = Controller(Pose(np.array([0.3, 0.2, 1.1]), HEAD.wxyz), {**FREE, **buttons})  # type: ignore[dict-item]
        hands = {side: controller for side in sides or ("right",)}
        self.controllers.update(hands, head, Moment(self.time), self.status)
        return [command for command in self.sent if not isinstance(command, m.Hands)]

    @property
    def samples(self) -> tuple[m.HandSample, ...]:
        (hands,) = (command for command in self.sent if isinstance(command, m.Hands))
        return hands.hands


def test_the_papers_buttons() -> None:
    player = Player()
    assert player.show(menu=1.0) == [m.Clutch(arm=0)]
    assert player.show(menu=1.0) == []  # held, not pressed again
    assert player.show(squeeze=1.0) == [m.SwitchMode(arm=0)]
    player.show(trigger=0.75)
    assert player.samples[0].opening == 0.25


def test_a_button_that_trembles_in_the_middle_is_pressed_once() -> None:
    player = Player()
    values = (0.2, 0.5, 0.79, 0.81, 0.7, 0.81, 0.4, 0.9, 0.29, 0.31)
    assert sum(len(player.show(squeeze=value)) for value in values) == 1


def test_the_grip_may_be_the_clutch() -> None:
    player = Player(Settings(mapping=GRIP_AS_CLUTCH))
    assert player.show(squeeze=1.0) == [m.Clutch(arm=0, engaged=True)]
    assert player.show(squeeze=0.0) == [m.Clutch(arm=0, engaged=False)]
    assert player.show(menu=1.0) == [m.SwitchMode(arm=0)]


def test_one_button_does_one_thing() -> None:
    with pytest.raises(ValueError, match="'menu' can do one thing only"):
        Mapping(record="menu")


def test_a_short_press_starts_and_keeps_and_a_long_one_discards() -> None:
    player = Player(Settings(countdown=0.0, operator="ana"))
    player.show(primary=1.0)
    assert player.show() == [m.StartTake(countdown=0.0, operator="ana")]
    player.status = RECORDING
    player.show(primary=1.0)
    assert player.show() == [m.EndTake()]
    player.show(primary=1.0)
    player.time += LONG
    assert player.show(primary=1.0) == [m.DiscardTake()]
    assert player.show() == []  # letting go of it keeps nothing


def test_two_hands_lead_two_arms_and_one_arm_has_one_hand() -> None:
    player = Player(status=TWO_ARMS)
    player.show("left", "right")
    assert player.show("left", "right", menu=1.0) == [m.Clutch(arm=0), m.Clutch(arm=1)]
    assert [sample.arm for sample in player.samples] == [0, 1]
    player.status = STATUS
    assert player.show("left", squeeze=1.0) == [m.LoseHand(arm=0, why="The right controller is not tracked.")]
    player = Player(Settings(one_arm="left"))
    player.show("left")
    assert player.show("left", menu=1.0) == [m.Clutch(arm=0)]


def test_a_hand_that_is_lost_is_lost_once_and_the_other_goes_on() -> None:
    player = Player(status=TWO_ARMS)
    player.show("left", "right")
    assert player.show("right") == [m.LoseHand(arm=0, why="The left controller is not tracked.")]
    assert [sample.arm for sample in player.samples] == [1]
    assert player.show("right") == []
    # A button that is down when the hand comes back was not pressed just now.
    assert player.show("left", "right", menu=1.0) == [m.Clutch(arm=1)]


def test_ahead_is_where_the_operator_faces_and_facing_anew_lets_go() -> None:
    player = Player()
    player.show()
    ahead = player.samples[0].position
    turned = Pose(HEAD.position, quaternion_from_rotation_vector(np.array([0.0, 0.0, math.pi / 2])))
    player.show(head=turned)
    assert player.samples[0].position == ahead  # looking about turns nothing
    assert player.show(head=turned, stick=1.0) == [m.Clutch(arm=0, engaged=False)]
    player.show(head=turned)
    assert player.samples[0].position == pytest.approx((ahead[1], -ahead[0], ahead[2]))
    player = Player(Settings(view=math.pi))  # facing the robot
    player.show()
    assert player.samples[0].position == pytest.approx((-ahead[0], -ahead[1], ahead[2]))
    player = Player(Settings())  # to the right of one arm
    player.show()
    assert player.samples[0].position == pytest.approx((-ahead[1], ahead[0], ahead[2]))


# WebXR


def frame(**fields: object) -> xr.XrFrame:
    hand = {"pose": [0.3, 1.1, -0.4, 0.0, 0.0, 0.0, 1.0], "buttons": [0.5, 0.0, 0.0, 0.0, 0.0, 1.0]}
    given = {"type": "frame", "t": 1.0, "head": [0.0, 1.6, 0.0, 0.0, 0.0, 0.0, 1.0], "right": hand} | fields
    message = xr.decode(json.dumps(given))
    assert isinstance(message, xr.XrFrame)
    return message


def test_webxr_axes_become_ours() -> None:
    pose = xr.pose_of([0.3, 1.1, -0.4, 0.0, math.sin(0.1), 0.0, math.cos(0.1)])
    assert pose.position == pytest.approx([0.4, -0.3, 1.1])  # right is -y, up is z, back is -x
    assert pose.wxyz == pytest.approx([math.cos(0.1), 0.0, 0.0, math.sin(0.1)])  # about the vertical


@given(st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).filter(lambda v: np.linalg.norm(v[3:]) > 0.1))
def test_the_stage_puts_a_point_where_webxr_has_it(numbers: list[float]) -> None:
    wxyz = np.array(numbers[3:]) / np.linalg.norm(numbers[3:])
    room_from_world = Pose(np.array(numbers[:3]), wxyz)
    x, y, z, i, j, k, w = xr.stage_of(room_from_world)
    point = np.array([0.5, -0.2, 0.1])
    shown = Pose(np.array([x, y, z]), np.array([w, i, j, k])).apply(point)
    ours = room_from_world.apply(point)
    assert shown == pytest.approx([-ours[1], ours[2], -ours[0]])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        '{"type": "frame"}',
        '{"type": "frame", "t": NaN}',
        '{"type": "frame", "t": 1e999}',
        '{"type": "frame", "t": 1, "unheard of": 1}',
        '{"type": "frame", "t": 1, "head": [0, 0, 0, 0, 0, 1]}',
        '{"type": "frame", "t": 1, "head": [1e9, 0, 0, 0, 0, 0, 1]}',
        '{"type": "frame", "t": 1, "left": {"pose": [0, 0, 0, 0, 0, 0, 1], "buttons": [2]}}',
        '{"type": "lost", "why": "something else"}',
        '{"type": "launch"}',
        '{"type": "ping", "t": "1"}',
        "x" * 20_000,
    ],
)
def test_what_no_page_of_ours_says_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        xr.decode(text)


def test_a_quaternion_of_zeros_is_refused() -> None:
    with pytest.raises(ValueError, match="unit quaternion"):
        xr.pose_of([0.0] * 7)


class Page:
    """A headset's page."""

    def __init__(self) -> None:
        self.sent: list[m.Command] = []
        self.device = xr.WebXr(Controllers(self.sent.append))
        self.now = 100.0

    def show(self, **fields: object) -> list[m.Command]:
        self.sent.clear()
        self.now += 0.011
        self.device.hear(frame(t=self.now * 1e3, **fields), self.now + 0.005, STATUS)
        return [command for command in self.sent if not isinstance(command, m.Hands)]


HAND = {"pose": [0.3, 1.1, -0.4, 0.0, 0.0, 0.0, 1.0], "buttons": [0.0] * 6}


def test_buttons_come_in_the_standard_order() -> None:
    page = Page()
    page.show(right=HAND)
    assert page.show(right=HAND | {"buttons": [0, 0, 0, 0, 0, 1]}) == [m.Clutch(arm=0)]
    assert page.show(right=HAND | {"buttons": [0, 1, 0, 0, 0, 1]}) == [m.SwitchMode(arm=0)]


def test_a_wand_takes_hold_by_its_pad() -> None:
    page, wand = Page(), HAND | {"buttons": [0.0] * 3}  # its menu button never reaches a page
    page.show(right=wand)
    assert page.show(right=wand | {"buttons": [0, 0, 1]}) == [m.Clutch(arm=0)]


def test_bare_hands_and_guesses_are_not_believed() -> None:
    page = Page()
    page.show(right=HAND)
    (lost,) = page.show(right=HAND | {"is_hand": True})
    assert lost == m.LoseHand(arm=0, why="Bare hands are tracked; take the controllers.")
    page.show(right=HAND)
    (lost,) = page.show(right=HAND | {"is_emulated": True})
    assert lost == m.LoseHand(arm=0, why="The headset does not see the right controller.")
    other = Page()  # a device that always says so
    assert other.show(right=HAND | {"is_emulated": True}) == []
    assert len(other.sent) == 1


def test_after_recentering_ahead_is_taken_anew() -> None:
    page = Page()
    page.show(right=HAND)
    page.device.lose("reset")
    assert page.sent[-1] == m.LoseHand(arm=0, why="The room was recentred.")
    assert page.device.controllers.yaw is None


def test_a_way_is_timed_without_a_common_clock() -> None:
    transit, rng = xr.Transit(), np.random.default_rng(3)
    offset, told, true = 1234.5, [], []
    for n in range(2000):
        sent, way = n / 90, 0.004 + float(rng.exponential(0.003))
        told.append(transit.heard(sent, sent + offset + way, round_trip=0.008))
        true.append(way)
    error = np.array(told[200:]) - np.array(true[200:])
    assert np.abs(error).max() < 5e-4  # the quickest of five seconds is near 4 ms
    assert transit.jitter == pytest.approx(0.003, rel=0.5)  # E|a - b| of two exponentials is their mean
