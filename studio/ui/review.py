"""One person's review of one take: the scene, the timeline, the plots and the pictures at one time.

A thread of its own draws; whatever a person does only says what to draw next. Nothing of it is shared: two
people review two takes, or the same one, without seeing each other, and the live scene goes on for everybody
else.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Protocol

import numpy as np
import viser

from controller.types import Array, rotation_of
from studio import tasks
from studio.cursor import Cursor
from studio.episode import Episode, open_episode
from studio.index import EpisodeRow
from studio.ui import scene
from studio.ui.company import Company
from studio.ui.playback import Playback
from studio.ui.review_bar import COVERED, ReviewBar
from studio.ui.scene import SceneModel, SceneView
from studio.ui.viser_private import show_jpeg

log = logging.getLogger(__name__)


class Review:
    """Opens a take for one client and draws it until closed. Any thread may command it."""

    def __init__(
        self,
        server: viser.ViserServer,
        client: viser.ClientHandle,
        row: EpisodeRow,
        model: Callable[[str], SceneModel],
        gallery: viser.GuiFolderHandle | None,
        on_failure: Callable[[str], None],
        others: Sequence[EpisodeRow] = (),
    ) -> None:
        """`model` gives the scene of a task. The pictures go into `gallery`.

        Without one there are neither pictures nor a bar: the page of the dataset has both, and says what time
        it is. The hands of the `others` are shown, too.
        """
        self.row, self.others = row, tuple(others)
        self.shifts: Sequence[float] = [0.0] * len(others)  # [s] that each is ahead of this take's time
        self.playback = Playback(row.duration)
        self.shown = threading.Event()  # the first time is drawn
        self._server, self._client = server, client
        self._model, self._gallery, self._on_failure = model, gallery, on_failure
        self._thread = threading.Thread(target=self._run, name=f"review of {row.episode_id}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Take everything off the client's page."""
        self.playback.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            with ExitStack() as opened, ExitStack() as undone:
                first, *others = (
                    opened.enter_context(open_episode(row.path)) for row in (self.row, *self.others)
                )
                try:
                    self._draw(self._build(first, others, undone))
                finally:
                    if not self._is_client_there():  # its page has gone with all that was on it
                        undone.pop_all()
        except Exception as error:  # a damaged take must not take the page down
            if self._is_client_there():
                log.exception("The review of %s ended", self.row.episode_id)
                self._on_failure(f"{self.row.episode_id} cannot be shown: {error}")

    def _draw(self, parts: Sequence[_Part]) -> None:
        while (at := self.playback.wait()) is not None:
            for part in parts:
                part.show(at)
            self._client.flush()
            self.shown.set()

    def _is_client_there(self) -> bool:
        return self._client.client_id in self._server.get_clients()

    def _build(self, episode: Episode, others: Sequence[Episode], undone: ExitStack) -> Sequence[_Part]:
        cursor, model = None, None
        try:
            name = episode.header.task
            model = self._model(name)
            cursor = Cursor(episode, model.mujoco, tasks.load(name))
        except (AttributeError, KeyError, ValueError) as error:  # the plots are still worth seeing
            why = str(error.args[0] if error.args else error)
            self._client.add_notification("No scene for this take", why, color="orange")
            cursor, model = Cursor(episode), None
        parts: list[_Part] = []
        if model is not None:
            view = _Scene(self._client, model, cursor)
            undone.callback(view.remove)
            parts.append(view)
            for number, other in enumerate(others):
                company = Company(self._client, model, Cursor(other), number)
                undone.callback(company.remove)
                parts.append(_Shifted(self, company, number))
        if self._gallery is None:
            return parts
        if model is not None:
            undone.callback(_raise_view(self._client))
        gallery = _Gallery(self._client, self._gallery, cursor)
        undone.callback(gallery.remove)
        bar = ReviewBar(self._client, _title(self.row), cursor, self.playback)
        undone.callback(bar.remove)
        return [*parts, gallery, bar]


class _Part(Protocol):
    """What is drawn at each time."""

    def show(self, at: float) -> None: ...


class _Shifted:
    """Another take, at its own time."""

    def __init__(self, review: Review, company: Company, number: int) -> None:
        self._review, self._company, self._number = review, company, number

    def show(self, at: float) -> None:
        self._company.show(at + self._review.shifts[self._number])


class _Scene:
    """The take in 3-D, in place of the live scene."""

    def __init__(self, client: viser.ClientHandle, model: SceneModel, cursor: Cursor) -> None:
        self._cursor = cursor
        self._live = scene.hide(client)  # and the gizmos, which are part of it
        self._view = SceneView(client, model, scene.REVIEW)
        for index, arm in enumerate(cursor.arms):
            self._view.set_trail(index, arm.path(), arm.force)

    def show(self, at: float) -> None:
        moment, picture = self._cursor.at(at), self._cursor.picture(at)
        if picture is not None:
            self._view.set_ink(picture)
        assert moment.qpos is not None
        self._view.update(
            moment.qpos,
            [arm.wrench for arm in moment.arms],
            [arm.base_from_target for arm in moment.arms],
            [arm.level for arm in moment.arms],
        )

    def remove(self) -> None:
        self._view.remove()
        self._live.remove()


class _Gallery:
    """The cameras' pictures, two in a row."""

    def __init__(self, client: viser.ClientHandle, folder: viser.GuiFolderHandle, cursor: Cursor) -> None:
        self._cursor = cursor
        self._handles: dict[str, viser.GuiImageHandle] = {}
        self._shown: dict[str, bytes] = {}
        self._rest: list[viser.GuiHtmlHandle] = []
        with folder:
            for number, camera in enumerate(cursor.jpegs(0.0)):
                if number % 2 == 0:
                    self._rest.append(client.gui.add_html('<i class="c2"></i>'))
                blank = np.zeros((2, 2, 3), np.uint8)
                self._handles[camera] = client.gui.add_image(
                    blank, label=camera.replace("_", " "), format="jpeg"
                )

    def show(self, at: float) -> None:
        for camera, jpeg in self._cursor.jpegs(at).items():
            if jpeg != self._shown.get(camera):
                self._shown[camera] = jpeg
                show_jpeg(self._handles[camera], jpeg)

    def remove(self) -> None:
        for handle in (*self._rest, *self._handles.values()):
            handle.remove()


def _raise_view(client: viser.ClientHandle) -> Callable[[], None]:
    """Shift what the client looks at above the bar; the result shifts it back."""
    camera = client.camera
    down = rotation_of(camera.wxyz)[:, 1]
    distance = float(np.linalg.norm(camera.look_at - camera.position))
    shift = COVERED * distance * math.tan(camera.fov / 2) * down

    def move(by: Array) -> None:
        camera.position = camera.position + by  # takes what it looks at along

    move(shift)
    return lambda: move(-shift)


def _title(row: EpisodeRow) -> str:
    return row.task if row.seed is None else f"{row.task} {row.seed}"
