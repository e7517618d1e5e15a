"""The Episodes tab: each client's own list of takes, and the take that it has opened."""

from __future__ import annotations

import getpass
import json
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import viser

from studio.catalog import Catalog
from studio.http_wire import ViewIn
from studio.index import EpisodeRow
from studio.lease import PersonId
from studio.ui.review import Review
from studio.ui.scene import SceneModel
from studio.ui.take_card import TakeCard
from studio.ui.take_list import TakeList
from studio.ui.viser_private import run_javascript

DATASET_PAGE = (
    '<div class="dock-row"><button data-dock="/dataset">Dataset page</button>'
    '<a href="/dataset" target="_blank" rel="noopener">in a tab of its own</a></div>'
    '<div class="dock-row"><button data-dock="/train">Train, evaluate</button>'
    '<a href="/train" target="_blank" rel="noopener">in a tab of its own</a></div>'
)


class EpisodesTab:
    """Fills `tab` for every client that is or will be connected."""

    def __init__(
        self,
        server: viser.ViserServer,
        tab: viser.GuiTabHandle,
        catalog: Catalog,
        *,
        model: Callable[[str], SceneModel] | None = None,
        author: Callable[[int], str] = lambda _: getpass.getuser(),
        mark: Callable[[str, bool], None] = lambda _, __: None,
        person: Callable[[int], PersonId | None] = lambda _: None,
    ) -> None:
        """`model` gives the scene of a task, best always the same one.

        `author` and `person` tell who a client is. `mark` hears of takes that are moved to the trash (True),
        or back.
        """
        self._person = person
        self.catalog, self.author, self.mark = catalog, author, mark
        self.model = model or cache(SceneModel)
        self.server, self._tab = server, tab
        self._clients: dict[int, ClientEpisodes] = {}
        run_javascript(server, page_script())
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def refresh(self) -> None:
        """Look for takes, e.g. after one was recorded, and bring every list up to date."""
        self.catalog.refresh()
        self.show()

    def show(self) -> None:
        """Bring every list up to date with the catalogue."""
        for client_id in self.server.get_clients():
            client = self._clients.get(client_id)
            if client is not None:
                with suppress(RuntimeError):  # it has gone meanwhile, and its widgets with it
                    client.takes.show()

    def show_in(self, person: PersonId, asked: ViewIn) -> None:
        """See `studio.http_view.Views`."""
        clients = list(self._clients.items())
        found = [c for client_id, c in clients if c.key == asked.view and self._person(client_id) == person]
        if not found:
            raise KeyError("That page is not open any more, or it is somebody else's.")
        if asked.bar and asked.episode_ids:
            self.catalog.get(asked.episode_ids[0])  # KeyError, where there is no such take
            found[0].open(asked.episode_ids[0])
        else:
            found[0].follow(asked.episode_ids, asked.shifts, asked.time, asked.speed)

    def of(self, client_id: int) -> ClientEpisodes | None:
        """What this client sees; None before it has connected and after it has gone."""
        return self._clients.get(client_id)

    def close(self) -> None:
        """End every review."""
        for client in list(self._clients.values()):
            client.close()

    def _connect(self, client: viser.ClientHandle) -> None:
        here = client.gui.add_html("")  # on the page whatever tab is open
        with self._tab:
            episodes = ClientEpisodes(client, self, here)
        self._clients[client.client_id] = episodes
        self.show()  # what is known already
        self.refresh()
        if client.client_id not in self.server.get_clients():  # gone before it could be told to us
            self._disconnect(client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        gone = self._clients.pop(client.client_id, None)
        if gone is not None:
            gone.close()


class ClientEpisodes:
    """One client's list and open take, built into the container that is open; one thing at a time."""

    def __init__(self, client: viser.ClientHandle, everybody: EpisodesTab, here: viser.GuiHtmlHandle) -> None:
        """`here` tells the page's script by which key its view is known, and which take is open."""
        self._client, self._everybody, self._catalog = client, everybody, everybody.catalog
        self._lock = threading.RLock()
        self._deleted: str | None = None  # id of the take that can be brought back
        self.review: Review | None = None
        self.key = secrets.token_urlsafe(12)
        self._here = here
        self._followed: list[str] = []  # takes that another page has shown here
        self._tell_here()
        gui = client.gui
        self._list_folder = gui.add_folder(None)
        with self._list_folder:
            gui.add_html(DATASET_PAGE)
            self.takes = TakeList(
                gui, self._catalog, open_take=self.open, restore=self._restore, look_again=everybody.refresh
            )
        self._card_folder = gui.add_folder(None, visible=False)
        with self._card_folder:
            self._card = TakeCard(gui, self)

    def open(self, episode_id: str) -> None:
        """Review a take, instead of the one that is open, if any."""
        with self._turn():
            row = self._catalog.get(episode_id)
            self._leave()
            self._card.show(row)
            self._list_folder.visible, self._card_folder.visible = False, True
            self.review = Review(
                self._everybody.server,
                self._client,
                row,
                self._everybody.model,
                self._card.gallery,
                self._card.fail,
            )
            self._tell_here()

    def follow(self, episode_ids: Sequence[str], shifts: Sequence[float], time: float, speed: float) -> None:
        """Show in 3-D what the page of the dataset shows; no take, and the live scene is back."""
        with self._lock:
            if list(episode_ids) != self._followed and (episode_ids or self._followed):
                self._follow_others([self._catalog.get(each) for each in episode_ids])
            if self.review is not None and self._followed:
                n = len(self.review.others)
                self.review.shifts = [*shifts, *[0.0] * n][:n]
                self.review.playback.follow(time, speed)

    def _follow_others(self, rows: Sequence[EpisodeRow]) -> None:
        self._leave()
        self._list_folder.visible, self._card_folder.visible = True, False
        if rows:
            first, *others = rows
            everybody = self._everybody
            self.review = Review(
                everybody.server, self._client, first, everybody.model, None, self._tell_failure, others
            )
            self._followed = [row.episode_id for row in rows]

    def _tell_failure(self, why: str) -> None:
        self._client.add_notification("No 3-D view", why, color="orange")

    def _tell_here(self) -> None:
        shown = self.review.row.episode_id if self.review and not self._followed else ""
        self._here.content = f'<i class="here" data-view="{self.key}" data-episode="{escape(shown)}"></i>'

    def back(self) -> None:
        """To the list and the live scene."""
        with self._turn():
            self._card.save_note()
            self._leave()
            self._list_folder.visible, self._card_folder.visible = True, False

    def neighbour(self, steps: int) -> None:
        """Open the take so many further down the list."""
        with self._turn():
            if self.review is not None:
                episode_id = self.takes.neighbour(self.review.row.episode_id, steps)
                if episode_id is None:
                    raise ValueError(f"There is no {'older' if steps > 0 else 'newer'} take in the list.")
                self._card.save_note()
                self.open(episode_id)

    def annotate(self, **changes: Any) -> None:
        """Say something about the open take; `changes` are fields of `studio.edits.Edit`."""
        with self._turn():
            if self.review is not None:
                row = self._catalog.annotate(self.review.row.episode_id, author=self._author, **changes)
                self._changed(row)

    def undo(self) -> None:
        """Take back this author's last change of the open take."""
        with self._turn():
            if self.review is not None:
                self._changed(self._catalog.undo(self.review.row.episode_id, author=self._author))

    def delete(self) -> None:
        """Move the open take to the trash; the list offers to bring it back."""
        with self._turn():
            if self.review is not None:
                self._deleted = self._catalog.delete(self.review.row.episode_id).episode_id
                self._everybody.mark(self._deleted, True)
                self._leave()
                self._list_folder.visible, self._card_folder.visible = True, False
                self.takes.offer_undo(self._deleted)
                self._everybody.show()

    def close(self) -> None:
        """The client has gone."""
        with self._lock:
            self._leave()

    def _restore(self) -> None:
        with self._turn():
            if self._deleted is not None:
                self._catalog.restore(self._deleted)
                self._everybody.mark(self._deleted, False)
                self._deleted = None
                self.takes.offer_undo(None)
                self._everybody.show()

    @property
    def _author(self) -> str:
        return self._everybody.author(self._client.client_id)

    def _changed(self, row: EpisodeRow) -> None:
        self._card.show(row)
        self._everybody.show()

    def _leave(self) -> None:
        if self.review is not None:
            self.review.close()
            self.review, self._followed = None, []
            with suppress(RuntimeError):  # its client may have gone
                self._tell_here()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """One thing after the other; what does not work is told to the person."""
        with self._lock:
            try:
                yield
            except (KeyError, ValueError, OSError) as error:
                why = str(error.args[0]) if error.args else type(error).__name__
                self._client.add_notification("That did not work", why, color="orange")


def page_script() -> str:
    """What the page needs besides viser's own: keys and looks of a review, and our other pages beside it."""
    folder = Path(__file__).parents[2] / "web_assets"
    review, dock = (json.dumps((folder / f"{name}.css").read_text()) for name in ("review", "dock"))
    scripts = [(folder / f"{name}.js").read_text() for name in ("review", "dock")]
    return "\n".join(scripts).replace("REVIEW_CSS", review).replace("DOCK_CSS", dock)
