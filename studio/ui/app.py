"""The page: builds its parts, lets the session's reports reach them, and restarts what has ended.

viser's callbacks only post commands (`Desk`). One thread paints: it wakes for every frame of the session and
hands each part the newest reports.
"""

from __future__ import annotations

import getpass
import json
import logging
import threading
import time
from collections.abc import Callable
from functools import cache
from html import escape
from pathlib import Path
from typing import Protocol

import numpy as np
import viser

from controller.types import Pose, Wrench
from studio.api import Studio
from studio.lease import PersonId
from studio.messages import CameraImage, Frame, Notice, Status
from studio.ui import scene, viser_private
from studio.ui.control import ControlRows
from studio.ui.desk import Desk
from studio.ui.episodes import EpisodesTab
from studio.ui.first_steps import FirstSteps
from studio.ui.gate import Gate
from studio.ui.gizmo import Gizmo
from studio.ui.keys import Hotkey, Hotkeys, Keypad, table
from studio.ui.plots import LivePlots
from studio.ui.remote import Remote, State
from studio.ui.status import SOUNDS, Sounds, StatusLine, lost, notify
from studio.ui.system import SystemTab
from studio.ui.teleop import TeleopTab, active_choice

WEB_ASSETS = Path(__file__).parents[2] / "web_assets"
LEFT_WIDTH, RIGHT_WIDTH = 300, 340  # [px]
STATUS_PERIOD = 0.2  # [s] between updates of words
IMAGE_PERIOD = 0.14  # [s] between previews of one camera: 7 Hz
START_TIMEOUT = 60.0  # [s] for a new session process on a busy machine
BRAND = (91, 157, 255)

log = logging.getLogger(__name__)


class SessionProcess(Protocol):
    """Whoever can start the session process of the data folder."""

    pid: int | None  # of the one that answered last

    def connect(self, remote: Remote, timeout: float) -> None:
        """Raises TimeoutError or RuntimeError where no session answers."""

    def end(self) -> None:
        """Make sure that none is left."""

    def start(self, task: str | None = None, seed: int = 0) -> None: ...


class Page:
    """One data folder's page on a viser server. `close` leaves the session process alone."""

    def __init__(
        self,
        server: viser.ViserServer,
        studio: Studio,
        process: SessionProcess,
        gate: Gate,
        invitation: Callable[[], str] | None = None,
    ) -> None:
        """`gate` heard of every connection to `server`; `invitation` tells the link for others."""
        self.remote, self._gate = gate.remote, gate
        gate.attach(server)
        self._server, self._studio, self._process = server, studio, process
        self._desk = Desk(
            self.remote,
            studio.delete,
            studio.restore,
            operator=lambda: gate.lease.holder_name,
            runs_of=studio.runs_of,
            ways_to_play=studio.ways_to_play,
        )
        self._invitation = invitation
        self.model = cache(scene.SceneModel)
        self._stage: Stage | None = None
        self._restarting = threading.Lock()
        self._painted = 0  # frames that had come when the last was painted
        self._words_due = 0.0
        self._ended = threading.Event()
        self._build()
        self._painter = threading.Thread(target=self._paint, name="page", daemon=True)

    def start(self) -> None:
        """Begin to paint; `remote` is connected before or later."""
        self._painter.start()

    def close(self) -> None:
        self._ended.set()
        if self._painter.is_alive():
            self._painter.join()
        self._episodes.close()
        self.remote.close()

    @property
    def views(self) -> EpisodesTab:
        """The 3-D views of all who look, for `studio.http_view`."""
        return self._episodes

    def restart_session(self) -> None:
        """Start a new session process, on a thread of its own: recovering a take may take a while."""
        if self._restarting.acquire(blocking=False):  # else somebody else is at it
            threading.Thread(target=self._restart_once, name="restart", daemon=True).start()

    # Building

    def _build(self) -> None:
        server, gui = self._server, self._server.gui
        gui.configure_theme(
            dark_mode=True,
            show_logo=False,
            show_share_button=False,
            brand_color=BRAND,
            titlebar_content={"buttons": (), "image": None},
        )
        gui.set_panel_label("Control")
        css = (WEB_ASSETS / "page.css").read_text()
        script = (WEB_ASSETS / "page.js").read_text()
        viser_private.run_javascript(server, script.replace("STUDIO_CSS", json.dumps(css)))

        left = gui.add_panel()
        with left.add_tab("Live"):
            self._line = StatusLine(gui)
            self._sounds = Sounds(gui)
            self._live = gui.add_folder(None)
        left.dock_left()
        left.set_width(LEFT_WIDTH)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT_WIDTH)

        keypad = Keypad(self._desk, self._target)
        self._hotkeys = Hotkeys(gui, self._desk)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Teleop"):
            self._lost = gui.add_html("", visible=False)
            self._restart = gui.add_button(
                "Restart session", color="red", icon=viser.Icon.REFRESH, visible=False
            )
            self._first_steps = FirstSteps(gui, is_needed=not self._studio.catalog.count())
            with gui.add_folder(None, visible=False) as self._driving:
                self._control = ControlRows(server, gui.add_folder(None, order=0.0), self._gate)
                gui.add_html('<i class="of-operator"></i>', order=0.1)
                self._teleop = TeleopTab(gui, self._desk, keypad)
                with gui.add_folder("Keys", expand_by_default=False, order=9.0):
                    self._keys = gui.add_html(table(self._hotkeys.keys))
        self._episodes = EpisodesTab(
            server,
            tabs.add_tab("Episodes"),
            self._studio.catalog,
            model=self.model,
            author=self._author,
            mark=lambda episode_id, is_deleted: self._desk.mark(episode_id, is_deleted=is_deleted),
            person=self._person,
        )
        with tabs.add_tab("System"):
            self._system = SystemTab(
                gui, self._desk, self._studio.data_dir, self.restart_session, self._invitation
            )
            for button in (self._first_steps.close, *self._system.for_everybody):
                self._gate.free(button)

        @self._restart.on_click
        def _(_: object) -> None:
            self.restart_session()

    def _author(self, client_id: int) -> str:
        seat = self._gate.seat(client_id)
        return seat.words if seat else getpass.getuser()

    def _person(self, client_id: int) -> PersonId | None:
        seat = self._gate.seat(client_id)
        return seat.person if seat else None

    # Painting

    @property
    def _status(self) -> Status | None:
        return self.remote.status.get()[0]

    def _target(self, arm: int) -> Pose | None:
        """base_from_target of an arm, for the keys."""
        frame, _ = self.remote.frame.get()
        return Pose.from_vector(np.array(frame.arms[arm].base_from_target)) if frame else None

    def _paint(self) -> None:
        while not self._ended.is_set():
            self.remote.wait(timeout=0.1)
            try:
                self._paint_once()
            except Exception:  # a page that stands still would hide what it should tell
                log.exception("The page could not show something.")
                time.sleep(1.0)

    def _paint_once(self) -> None:
        status, state = self._status, self.remote.state
        for notice in self.remote.notices.drain():
            self._hear(notice)
        if status is not None:
            self._set_stage(status)
        now = time.monotonic()
        is_due = now >= self._words_due
        if is_due or self._server.get_clients():  # else rarely: who comes finds it recent
            self._show_frame(status, state)
        if is_due:
            self._words_due = now + STATUS_PERIOD
            self._show_words(status, state)

    def _show_frame(self, status: Status | None, state: State) -> None:
        frame, count = self.remote.frame.get()
        is_new, self._painted = count != self._painted, count
        if self._stage and status and frame and is_new and frame.resets == status.resets:
            self._stage.show(frame, status)
        elif self._stage and state != "open":
            self._stage.lose()

    def _show_words(self, status: Status | None, state: State) -> None:
        choice = active_choice(status, self._desk.choice) if status else "nobody"
        self._line.show(
            status, state, "keyboard" if choice == "keyboard" else "gizmo", self._gate.lease.holder
        )
        self._control.show()
        self._system.show(status, state, len(self._server.get_clients()))
        is_lost = state != "open"
        self._lost.content = f'<div class="card bad">{lost(status, state)}</div>'
        self._lost.visible = is_lost
        self._restart.visible = is_lost and status is not None
        self._driving.visible = not is_lost
        if status is not None and not is_lost:
            self._teleop.show(status)
            self._first_steps.show(status, self._has_review())

    def _has_review(self) -> bool:
        """Whether somebody looks at a take."""
        views = [self._episodes.of(client) for client in self._server.get_clients()]
        return any(view is not None and view.review is not None for view in views)

    def _hear(self, notice: Notice) -> None:
        notify(self._server, notice)
        sound = SOUNDS.get(notice.kind)
        if sound and self._desk.with_sounds:
            self._sounds.play(sound)
        if notice.kind in ("take kept", "take discarded"):  # reading a take must not hold up the painter
            threading.Thread(target=self._episodes.refresh, name="refresh", daemon=True).start()

    def _set_stage(self, status: Status) -> None:
        """Build the scene of another task."""
        if self._stage is not None and self._stage.model.task.name == status.task:
            return
        if self._stage is not None:
            self._stage.remove()
        self._stage = Stage(self._server, self._live, self.model(status.task), self._desk, self.remote)
        names = tuple(arm.name for arm in self._stage.model.task.arms)
        self._teleop.set_task(self._stage.model.task.arms)
        keys: list[Hotkey] = self._hotkeys.set_arms(names)
        self._keys.content = table(keys)

    # Restarting

    def _restart_once(self) -> None:
        try:
            if self.remote.state == "open" and self._status is not None and self._status.phase != "idle":
                self._desk.tell("A take is running; stop it first.")
            else:
                self._start_again()
        except (OSError, RuntimeError) as error:
            self._desk.tell(str(error))
        finally:
            self._restarting.release()

    def _start_again(self) -> None:
        status = self._status
        self.remote.close()
        self._process.end()
        for recovery in self._studio.recover():
            self.remote.notices.post(Notice(kind="info", text=recovery.what))
        self._process.start(status.task if status else None, status.seed if status else 0)
        self._process.connect(self.remote, START_TIMEOUT)
        self.remote.notices.post(Notice(kind="info", text="A new session process runs."))


class Stage:
    """What depends on the task: the scene, a gizmo per arm, the plots, the camera previews."""

    def __init__(
        self,
        server: viser.ViserServer,
        container: viser.GuiFolderHandle,
        model: scene.SceneModel,
        desk: Desk,
        remote: Remote,
    ) -> None:
        self.model = model
        self._desk, self._remote = desk, remote
        scene.set_stage(server, self.model)
        self._view = scene.SceneView(server, self.model, scene.LIVE)
        arms = self.model.task.arms
        self._gizmos = [Gizmo(server.scene, index, setup, remote.post) for index, setup in enumerate(arms)]
        self._ink_of: object = None
        with container, server.gui.add_folder(None) as self._folder:
            self._previews = Previews(server.gui, [view.name for view in self.model.task.cameras], desk)
            self._plots = LivePlots(server.gui, tuple(arm.name for arm in arms))

    def show(self, frame: Frame, status: Status) -> None:
        self._view.update(
            np.frombuffer(frame.qpos),
            [Wrench.from_vector(np.array(arm.wrench)) for arm in frame.arms],
            [Pose.from_vector(np.array(arm.base_from_target)) for arm in frame.arms],
            [arm.level for arm in frame.arms],
        )
        choice = active_choice(status, self._desk.choice)
        for gizmo, arm in zip(self._gizmos, status.arms, strict=True):
            is_led = arm.hand is not None and arm.hand.engaged
            is_handle = (choice == "gizmo" and arm.engaged) or choice == "policy"  # grabbing it takes over
            gizmo.show(frame, visible=is_handle and not is_led)
        self._plots.update(frame.arms)
        self._previews.show(self._remote.images, status.camera_error)
        self._show_ink()

    def lose(self) -> None:
        """The session is gone: nobody drives."""
        for gizmo in self._gizmos:
            gizmo.hide()

    def remove(self) -> None:
        for gizmo in self._gizmos:
            gizmo.remove()
        self._view.remove()
        self._folder.remove()

    def _show_ink(self) -> None:
        painted, _ = self._remote.task_state.get()
        if painted is not None and painted is not self._ink_of:
            self._ink_of = painted
            picture = self.model.ink(painted.unpack())
            if picture is not None:
                self._view.set_ink(picture)


class Previews:
    """The cameras' newest images, side by side."""

    def __init__(self, gui: viser.GuiApi, cameras: list[str], desk: Desk) -> None:
        blank = np.full((240, 320, 3), 30, np.uint8)
        gui.add_html(f'<i class="c{min(len(cameras), 3)}"></i>')
        self._images = {name: gui.add_image(blank, label=name.replace("_", " ")) for name in cameras}
        self._shown: dict[str, tuple[float, CameraImage]] = {}  # when [s]
        self._error = gui.add_html("", visible=False)
        self._restart = gui.add_button(
            "Restart cameras", color="orange", icon=viser.Icon.CAMERA, visible=False
        )
        self._restart.on_click(lambda _: desk.restart_cameras())

    def show(self, images: dict[str, CameraImage], error: str) -> None:
        now = time.monotonic()
        for name, handle in self._images.items():
            image = images.get(name)
            shown_at, shown = self._shown.get(name, (0.0, None))
            if image is None or image is shown or now - shown_at < IMAGE_PERIOD:
                continue
            if shown is None or image.jpeg != shown.jpeg:
                viser_private.show_jpeg(handle, image.jpeg)
            self._shown[name] = (now, image)
        self._error.content = f'<div class="card bad">{escape(error)}</div>'
        self._error.visible = self._restart.visible = bool(error)
