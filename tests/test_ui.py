"""The page without a browser: a session that is 60 lines long, and visitors that read and click."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
from visitor import Visitor, wait_for

from controller.types import Pose, StiffnessMode, quaternion_from_rotation_vector
from studio import messages as m
from studio import tasks
from studio.api import Studio
from studio.lease import Standing
from studio.link import Hub, socket_path
from studio.pilot import Playing, Tried
from studio.server import FrontServer, make_app, start_viser
from studio.tasks import ArmSetup
from studio.ui import control, viser_private
from studio.ui import status as words
from studio.ui.app import Page
from studio.ui.desk import Desk
from studio.ui.first_steps import FirstSteps
from studio.ui.gate import Gate
from studio.ui.gizmo import SETTLED, Gizmo
from studio.ui.keys import Hotkeys, Keypad, world_from_view
from studio.ui.plots import MAX_FORCE, gauge
from studio.ui.remote import SILENCE, Remote
from studio.ui.system import facts, invitation_html
from studio.ui.teleop import TeleopTab

HOME = (0.36, 0.0, 0.2, 0.0, 0.7071067811865476, -0.7071067811865476, 0.0)

ARM = m.ArmStatus(
    name="right",
    mode="medium",
    modes=("medium", "low"),
    engaged=True,
    level="ok",
    why="",
    input_age=None,
)
STATUS = m.Status(
    task="wiping",
    instruction="Wipe the mark off the whiteboard in one go.",
    seed=42,
    spread=1.0,
    resets=1,
    driver="operator",
    operator="Ana",
    phase="idle",
    countdown=0.0,
    take_seconds=0.0,
    take_id="",
    last_take=None,
    collected=0,
    to_collect=0,
    progress=0.0,
    success=False,
    task_phase="approach",
    arms=(ARM,),
    rate=100.0,
    late_share=0.0,
    worst_delay=0.001,
    camera_error="",
)


def frame(target: tuple[float, ...] = HOME, qpos: np.ndarray | None = None) -> m.Frame:
    arm = m.ArmFrame(
        base_from_tcp=HOME,
        base_from_target=target,
        wrench=(0.0, 0.0, 3.0, 0.0, 0.0, 0.0),
        stiffness=500.0,
        gripper=0.0,
        level="ok",
    )
    return m.Frame(time=0.0, resets=1, qpos=(np.zeros(0) if qpos is None else qpos).tobytes(), arms=(arm,))


def cut(hub: Hub) -> None:
    """Close a hub and, as the end of its process does, the connections that somebody still reads."""
    for connection in list(hub._clients):
        with socket.socket(fileno=os.dup(connection.fileno())) as wire:
            wire.shutdown(socket.SHUT_RDWR)
    hub.close()


class FakeSession:
    """Obeys so far as the page can see, 50 times a second."""

    def __init__(self, data_dir: Path) -> None:
        model = tasks_model("wiping")
        self._frame = frame(qpos=model)
        self.status = msgspec.structs.replace(STATUS, driver="nobody", operator="")
        self.commands: list[m.Command] = []
        self.hub = Hub(socket_path(data_dir))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> None:
        """As abruptly as a process ends."""
        self._ended.set()
        self._thread.join()
        cut(self.hub)

    def set(self, **changes: object) -> None:
        self.status = msgspec.structs.replace(self.status, **changes)

    def got(self, kind: type[m.Command]) -> list[m.Command]:
        return [command for command in self.commands if isinstance(command, kind)]

    def _run(self) -> None:
        while not self._ended.wait(0.02):
            for command in self.hub.commands.drain():
                self.commands.append(command)
                self._obey(command)
            self.hub.publish("frame", self._frame)
            self.hub.publish("status", self.status)

    def _obey(self, command: m.Command) -> None:
        arm = self.status.arms[0]
        match command:
            case m.Drive():
                self.set(driver=command.driver, operator=command.operator)
            case m.SetMode():
                self.set(arms=(msgspec.structs.replace(arm, mode=command.mode),))
            case m.StartTake() if self.status.phase != "idle":
                self.hub.tell(m.Notice(kind="error", text="A take is running already."))
            case m.StartTake():
                self.set(phase="recording", take_id="take-1", take_seconds=7.0)
            case m.EndTake():
                take = m.TakeStatus("take-1", "take-1.mcap", 7.0, command.judgement or "unmarked", False)
                self.set(phase="idle", take_id="", last_take=take)
                self.hub.tell(m.Notice(kind="take kept", text="Kept.", take=take))
            case m.Reset():
                self.set(seed=command.seed, resets=self.status.resets + 1)
                self._frame = msgspec.structs.replace(self._frame, resets=self.status.resets)
            case _:
                pass


class FakeProcess:
    """Starts fake sessions."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self.session: FakeSession

    def start(self, task: str | None = None, seed: int = 0) -> None:
        self.session = FakeSession(self._data_dir)

    def connect(self, remote: Remote, timeout: float = 10.0) -> None:
        remote.connect(socket_path(self._data_dir), timeout)

    def end(self) -> None:
        self.session.end()


def tasks_model(task: str) -> np.ndarray:
    from studio.twin import build_model

    qpos: np.ndarray = build_model(tasks.load(task)).qpos0
    return qpos


class Rig:
    """A page with its session."""

    def __init__(self, data_dir: Path) -> None:
        self.gate = Gate()
        self.server = start_viser(arrive=self.gate.arrive)
        self.front = FrontServer(make_app(self.server.get_port(), reception=self.gate.receive), port=0)
        self.front.start()
        self.studio = Studio(data_dir)
        self.process = FakeProcess(data_dir)
        self.page = Page(self.server, self.studio, self.process, self.gate)
        self.process.start()
        self.process.connect(self.page.remote)
        self.page.start()

    @property
    def session(self) -> FakeSession:
        return self.process.session

    def visitor(self) -> Visitor:
        """Whom the page knows: before, it could tell nothing to this one alone."""
        known = set(self.server.get_clients())
        visitor = Visitor(self.front.port)
        wait_for(lambda: self.server.get_clients().keys() - known)
        return visitor

    def close(self) -> None:
        self.page.close()
        self.front.stop()
        self.process.end()
        self.server.stop()
        self.studio.close()


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    rig = Rig(tmp_path_factory.mktemp("data"))
    yield rig
    rig.close()


@pytest.fixture(autouse=True)
def _fresh(request: pytest.FixtureRequest) -> None:
    """Each test of the page begins with an idle session in which nobody drives."""
    if "rig" in request.fixturenames:
        rig: Rig = request.getfixturevalue("rig")
        wait_for(lambda: not rig.gate.lease.holder)  # who drove has left
        rig.session.commands.clear()
        rig.session.set(
            driver="nobody", phase="idle", take_id="", last_take=None, arms=(ARM,), to_collect=0, operator=""
        )
        wait_for(lambda: rig.page.remote.status.get()[0] == rig.session.status)


@pytest.fixture
def gui() -> Iterator[viser.ViserServer]:
    server = start_viser()
    yield server
    server.stop()


# The page


def test_one_look_tells_who_drives_and_how_stiff(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.html("nobody drives")
        ana.button("● Nobody")
        ana.click("Gizmo")
        wait_for(lambda: ana.says("drives by gizmo"))
        ana.button("● Gizmo")
        wait_for(lambda: ana.button("Gizmo")["color"] == "blue" != ana.button("Nobody")["color"])
        ana.button("● Medium 500 N/m")
        ana.click("Low 250 N/m")
        ana.button("● Low 250 N/m")
        wait_for(lambda: ana.button("Medium")["color"] == "dark")
        ana.html('<span class="chip low">low 250 N/m</span>')
        rig.session.set(arms=(msgspec.structs.replace(ARM, level="limited", why="Too <hard>."),))
        assert "Too &lt;hard&gt;." in ana.html("right limited")
        ana.html('<span class="limited">● limited</span>')


def test_keys_do_what_buttons_do_once_however_long_they_are_held(rig: Rig) -> None:
    with rig.visitor() as ana:
        for _ in range(5):
            ana.press("Switch the right arm's stiffness")
            time.sleep(0.1)
        wait_for(lambda: rig.session.status.arms[0].mode == "low")
        time.sleep(0.3)
        assert len(rig.session.got(m.SetMode)) == 1


def test_two_people_press_start_one_take_runs_and_both_hear_why(rig: Rig) -> None:
    with rig.visitor() as ana, rig.visitor() as ben:
        button = ana.button("Start take"), ben.button("Start take")
        assert all(button)
        ana.click("Start take")
        wait_for(lambda: rig.gate.lease.holder)
        ben.click("Start take")
        wait_for(lambda: any(title == "You are watching" for title, _ in ben.notifications))
        assert not any(title == "You are watching" for title, _ in ana.notifications)
        wait_for(lambda: ben.says("REC 00:07") and ana.says("REC 00:07"))
        assert len(rig.session.got(m.StartTake)) == 1
        assert not rig.session.got(m.EndTake)


def test_a_judgement_ends_the_take_and_its_outcome_is_told(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.click("Start take")
        wait_for(lambda: not ana.button("Success")["disabled"])
        ana.click("Success")
        ana.html('Last take <b class="good">success</b>')
        wait_for(lambda: ("Take kept", "Kept.") in ana.notifications)
        # An unknown take cannot be discarded; the page says so and goes on.
        ana.click("Discard last")
        wait_for(lambda: any("could not be deleted" in text for _, text in ana.notifications))


def test_nobody_drives_and_start_gives_the_gizmo_to_the_operator(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.click("Start take")
        wait_for(lambda: rig.session.status.driver == "operator")
        kinds = [type(command) for command in rig.session.commands]
        assert [kind for kind in kinds if kind is not m.OperatorLeft] == [m.StartTake, m.Drive]


def test_a_task_that_was_chosen_by_the_session_is_not_chosen_again_by_the_page(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.click("Next seed")
        wait_for(lambda: rig.session.status.seed == 43)
        wait_for(lambda: ana.says("seed 43"))
        time.sleep(0.5)
        assert len(rig.session.got(m.Reset)) == 1


def test_a_held_button_of_the_keypad_nudges_along_the_view(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.click("Keys")
        wait_for(lambda: ana.says("drives by keyboard"))
        for _ in range(3):
            ana.hold("W", 20.0)
            time.sleep(0.05)
        wait_for(lambda: len(rig.session.got(m.Nudge)) == 3)
        first = rig.session.got(m.Nudge)[0]
        assert isinstance(first, m.Nudge)
        np.testing.assert_allclose(first.translation, [0.003, 0.0, 0.0])  # 60 mm/s for 50 ms, along the look
        ana.hold("U", 20.0)
        turn = wait_for(lambda: rig.session.got(m.Nudge)[3:])[0]
        # Left about the world's up is about -z of a tool that points down.
        np.testing.assert_allclose(turn.rotation, [0.0, 0.0, -np.radians(30) / 20], atol=1e-9)


def test_a_session_that_died_is_told_and_restarted_from_the_page(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.click("Start take")
        ana.html("REC 00:07")
        rig.session.end()
        ana.html("The take take-1 is kept; a restart recovers it.")
        assert rig.page.remote.state == "closed"
        ana.click("Restart session")
        wait_for(lambda: rig.page.remote.state == "open")
        ana.html("nobody drives")
        wait_for(lambda: ("Note", "A new session process runs.") in ana.notifications)
        wait_for(lambda: not ana.says('class="over"'))


def test_an_idle_page_costs_little(rig: Rig) -> None:
    with rig.visitor() as ana:
        ana.html("nobody drives")
        time.sleep(1.5)
        before = ana.bytes
        time.sleep(2.0)
        assert (ana.bytes - before) / 2.0 < 20e3


# Its parts


def test_commands_keep_their_order_and_only_the_newest_target_waits(tmp_path: Path) -> None:
    hub, remote = Hub(socket_path(tmp_path)), Remote()
    try:
        with remote._changed:  # the sender is held up, as by a session that is stuck
            for n in range(5):
                remote.post(m.MoveTo(arm=0, position=(n, 0.0, 0.0), wxyz=(1.0, 0.0, 0.0, 0.0)))
            remote.post(m.Engage(arm=0, engaged=False))
            remote.post(m.MoveTo(arm=0, position=(9.0, 0.0, 0.0), wxyz=(1.0, 0.0, 0.0, 0.0)))
            waiting = list(remote._waiting)
        moves = [command.position[0] for command in waiting if isinstance(command, m.MoveTo)]
        assert moves == [4.0, 9.0]
        assert isinstance(waiting[1], m.Engage)
    finally:
        hub.close()


def test_a_session_that_falls_silent_counts_as_stuck(tmp_path: Path) -> None:
    hub, remote = Hub(socket_path(tmp_path)), Remote()
    assert remote.state == "closed"
    hub.publish("status", STATUS)
    remote.connect(socket_path(tmp_path))
    assert remote.state == "open"
    remote._heard -= SILENCE
    assert remote.state == "stuck"
    hub.publish("status", STATUS)
    wait_for(lambda: remote.state == "open")
    cut(hub)
    wait_for(lambda: remote.state == "closed")


def test_what_people_typed_never_becomes_markup() -> None:
    bad = "<img src=x onerror=alert(1)>"
    status = msgspec.structs.replace(
        STATUS,
        operator=bad,
        task=bad,
        take_id=bad,
        camera_error=bad,
        arms=(msgspec.structs.replace(ARM, name=bad, why=bad, level="refused"),),
    )
    shown = [
        words.line(status, "open", "gizmo"),
        words.over(status, "open"),
        words.over(status, "closed"),
        words.line(status, "open", "gizmo", control=bad),
        facts(status, "open", 1, Path("/data") / bad, 1e9),
        invitation_html(f"https://host/?token={bad}"),
        gauge(bad, 1.0, 1.0, "ok"),
        *(control.words(Standing(bad, mine, bad, False, 2)) for mine in (True, False)),
    ]
    assert not any("<img" in html for html in shown)


def test_words_and_colour_go_together() -> None:
    for level, color, word in (("ok", "calm", "passes"), ("limited", "limited", "limited")):
        arm = msgspec.structs.replace(ARM, level=level, why="Why.")
        html = words.line(msgspec.structs.replace(STATUS, arms=(arm,)), "open", "gizmo")
        assert f'<span class="{color}">● {word}</span>' in html
    parked = msgspec.structs.replace(ARM, engaged=False)
    assert "● holds" in words.line(msgspec.structs.replace(STATUS, arms=(parked,)), "open", "gizmo")


def test_the_gauge_turns_amber_before_the_limit_and_never_overflows() -> None:
    assert "calm" in gauge("right", 0.5 * MAX_FORCE, MAX_FORCE, "ok")
    assert "limited" in gauge("right", 0.9 * MAX_FORCE, MAX_FORCE, "ok")
    assert "width:100.0%" in gauge("right", 3 * MAX_FORCE, 4 * MAX_FORCE, "refused")


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.1, 0.7, 2.0])
def test_directions_of_keys_are_axes_of_the_world_nearest_to_the_view(yaw: float) -> None:
    look = np.array([np.cos(yaw), np.sin(yaw), -0.5])
    look /= np.linalg.norm(look)
    right = np.cross(look, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    camera = Pose.of(np.column_stack((right, np.cross(look, right), look)), np.zeros(3))
    axes = world_from_view(camera.wxyz)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert set(np.abs(axes).ravel().tolist()) == {0.0, 1.0}
    assert axes[:, 0] @ right > 0.7
    assert axes[:, 1] @ look > 0.6
    assert axes[2, 2] == 1.0


def make_gizmo(server: viser.ViserServer) -> tuple[Gizmo, list[m.Command], list[float]]:
    posted: list[m.Command] = []
    clock = [0.0]
    (setup,) = tasks.load("wiping").arms
    return Gizmo(server.scene, 0, setup, posted.append, now=lambda: clock[0]), posted, clock


def test_showing_a_gizmo_sends_nothing_and_grabbing_it_keeps_the_target(gui: viser.ViserServer) -> None:
    gizmo, posted, _ = make_gizmo(gui)
    gizmo.show(frame(), visible=True)
    assert not posted
    gizmo._on_drag("start", 1)
    gizmo._on_drag("update", 1)
    (move,) = posted
    assert isinstance(move, m.MoveTo)
    np.testing.assert_allclose((*move.position, *move.wxyz), HOME, atol=1e-12)


def test_a_gizmo_follows_the_target_except_while_and_just_after_it_is_dragged(gui: viser.ViserServer) -> None:
    gizmo, posted, clock = make_gizmo(gui)
    gizmo.show(frame(), visible=True)
    handle = gizmo._handle
    assert handle.position.tolist() == [0.36, 0.0, 0.2]
    gizmo._on_drag("start", 1)
    handle._impl.position = np.array([0.36, 0.0, 0.1])  # what a browser sends
    gizmo._on_drag("update", 1)
    gizmo._on_drag("update", 2)  # somebody else is not heard
    assert len(posted) == 1
    on_its_way = (0.36, 0.0, 0.15, *HOME[3:])
    gizmo.show(frame(on_its_way), visible=True)
    assert handle.position[2] == 0.1
    gizmo._on_drag("end", 1)
    for height in (0.13, 0.12):  # the target comes after; it would pull the gizmo back
        clock[0] += SETTLED / 2
        gizmo.show(frame((0.36, 0.0, height, *HOME[3:])), visible=True)
        assert handle.position[2] == 0.1
    clock[0] += 2 * SETTLED  # a limit stopped it at 0.12
    gizmo.show(frame((0.36, 0.0, 0.12, *HOME[3:])), visible=True)
    assert handle.position[2] == 0.12


def test_a_second_arm_has_rows_and_keys_of_its_own(gui: viser.ViserServer) -> None:
    (right,) = tasks.load("wiping").arms
    arms: tuple[ArmSetup, ...] = (
        replace(right, name="left", modes=(StiffnessMode.MEDIUM, StiffnessMode.HIGH)),
        right,
    )
    remote = Remote()
    desk = Desk(remote, delete=lambda _: None, restore=lambda _: None)
    tab = TeleopTab(gui.gui, desk, Keypad(desk, lambda _: None))
    keys = Hotkeys(gui.gui, desk).set_arms(("left", "right"))
    assert {key.name for key in keys} >= {"M", "Shift+M", "G", "Shift+G", "P", "Shift+P", "T", "R"}
    assert len({key.name for key in keys}) == len(keys)
    assert {key.label for key in keys if key.name == "M"} == {"Switch the right arm's stiffness"}
    left = msgspec.structs.replace(ARM, name="left", modes=("medium", "high"), mode="high")
    tab.set_task(arms)
    tab.show(msgspec.structs.replace(STATUS, arms=(left, ARM)))
    with Visitor(gui.get_port()) as ana:
        ana.button("● High 750 N/m")
        ana.button("Low 250 N/m")
        tab.set_task([replace(right, modes=(StiffnessMode.MEDIUM, StiffnessMode.MEDIUM))])
        tab.show(STATUS)
        wait_for(lambda: ana._find("GuiButtonMessage", "High") is None)
        ana.button("● Medium 500 N/m")
        assert ana._find("GuiButtonMessage", "medium") is None  # nor a second one, without its number


def test_runs_of_the_task_are_offered_and_one_is_asked_to_drive(gui: viser.ViserServer) -> None:
    remote, asked = Remote(), []
    remote.post = asked.append  # type: ignore[method-assign, assignment]
    runs = {"wiping": ["wipe-2", "wipe-1"], "drawing": []}
    ways = [Tried(Playing("replan", 40), 9, 10), Tried(Playing("replan", 10))]
    desk = Desk(
        remote,
        lambda _: None,
        lambda _: None,
        runs_of=runs.__getitem__,
        ways_to_play=lambda run: ways if run == "wipe-1" else ways[1:],
    )
    tab = TeleopTab(gui.gui, desk, Keypad(desk, lambda _: None))
    with Visitor(gui.get_port()) as ana:
        assert ana._find("GuiButtonMessage", "Policy") is None
        tab.show(msgspec.structs.replace(STATUS, task="wiping"))
        choice = wait_for(lambda: ana._find("GuiDropdownMessage", "Run"))
        ana.send({"type": "GuiUpdateMessage", "uuid": choice["uuid"], "updates": {"value": "wipe-1"}})
        wait_for(lambda: desk.policy == "wipe-1")
        ana.click("Policy")
        wait_for(lambda: asked)
        assert asked == [m.Drive(driver="policy", operator="", policy="wipe-1", replan_every=40)]
        way = wait_for(lambda: ana._find("GuiDropdownMessage", "Plays"))
        assert way["options"] == ["40 steps of each chunk (9/10)", "10 steps of each chunk"]
        ana.send(
            {"type": "GuiUpdateMessage", "uuid": way["uuid"], "updates": {"value": "10 steps of each chunk"}}
        )
        wait_for(lambda: desk.playing == Playing("replan", 10))
        tab.show(msgspec.structs.replace(STATUS, task="wiping", driver="policy", policy="wipe-1"))
        ana.button("● Policy")
        assert desk.policy == "wipe-1"
        tab.show(msgspec.structs.replace(STATUS, task="drawing"))
        assert desk.policy == ""


def test_the_first_steps_are_ticked_off_and_go(gui: viser.ViserServer) -> None:
    steps = FirstSteps(gui.gui, is_needed=True)
    take = m.TakeStatus("a", "a.mcap", 1.0, "success", False)
    with Visitor(gui.get_port()) as ana:
        assert "Your first take" in ana.html("Drive")
        steps.show(msgspec.structs.replace(STATUS, last_take=take), False)
        assert ana.html('class="done"').count('class="done"') == 1
        moved = msgspec.structs.replace(ARM, input_age=0.1)
        steps.show(msgspec.structs.replace(STATUS, arms=(moved,)), True)
        wait_for(lambda: not ana.says("Your first take"))


def test_undo_brings_back_what_was_discarded() -> None:
    done: list[str] = []
    remote = Remote()
    desk = Desk(remote, lambda take: done.append(f"-{take}"), lambda take: done.append(f"+{take}"))
    take = m.TakeStatus("a", "a.mcap", 1.0, "success", False)
    remote.status.set(msgspec.structs.replace(STATUS, last_take=take))
    desk.undo_discard()
    desk.discard()
    desk.discard()
    desk.undo_discard()
    assert done == ["-a", "+a"]
    said = [notice.kind for notice in remote.notices.drain()]
    assert said == ["error", "take discarded", "error", "take kept"]


def test_viser_is_the_one_that_our_private_part_was_written_for(gui: viser.ViserServer) -> None:
    assert version("viser").startswith("1.1.")
    image = gui.gui.add_image(np.zeros((2, 2, 3), np.uint8))
    viser_private.show_jpeg(image, b"jpeg")
    viser_private.run_javascript(gui, "1 + 1")
    with Visitor(gui.get_port()) as ana:
        ours = wait_for(lambda: ana._find("GuiImageMessage", "", "label"))
        wait_for(lambda: ours["_data"] == b"jpeg")


def test_a_turn_about_up_keeps_a_tool_that_points_down(gui: viser.ViserServer) -> None:
    gizmo, _, _ = make_gizmo(gui)
    gizmo.show(frame(), visible=True)
    # At home the arrows are the world's.
    np.testing.assert_allclose(np.abs(gizmo._handle.wxyz), [1.0, 0.0, 0.0, 0.0], atol=1e-12)
    turned = Pose(np.zeros(3), quaternion_from_rotation_vector(np.array([0.0, 0.0, 0.3])))
    target = turned @ Pose.from_vector(np.array(HOME))
    gizmo.show(frame(tuple(target.vector.tolist())), visible=True)
    np.testing.assert_allclose(gizmo._handle.wxyz, turned.wxyz, atol=1e-12)
