"""A list of takes that one can filter and leaf through: a page of buttons, as viser has no table."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import cast

import viser

from studio.catalog import Catalog
from studio.edits import OUTCOMES, Outcome
from studio.index import EpisodeRow, Filters

PAGE = 15  # takes at once
ANY_TASK, ANY_OUTCOME = "any task", "any outcome"
ICONS: dict[Outcome, viser.IconName] = {
    "success": viser.Icon.CIRCLE_CHECK,
    "failure": viser.Icon.CIRCLE_X,
    "unmarked": viser.Icon.CIRCLE_DASHED,
}


class TakeList:
    """Built into the container that is open. Any thread may call it."""

    def __init__(
        self,
        gui: viser.GuiApi,
        catalog: Catalog,
        *,
        open_take: Callable[[str], None],
        restore: Callable[[], None],
        look_again: Callable[[], None],
    ) -> None:
        """`open_take` gets the id of the take that was clicked, `restore` brings back the deleted one."""
        self._catalog = catalog
        self._lock = threading.Lock()
        self._page = 0
        self._rows: list[EpisodeRow] = []
        self._text = gui.add_text("Search", "", hint="Words of the id, task, people, note or segments.")
        self._task = gui.add_dropdown("Task", [ANY_TASK])
        self._outcome = gui.add_dropdown("Outcome", [ANY_OUTCOME, *OUTCOMES])
        self._undo = gui.add_button("", color="blue", icon=viser.Icon.ARROW_BACK_UP, visible=False)
        self._words = gui.add_html("")
        gui.add_html('<i class="takes"></i>')
        self._buttons = [gui.add_button("", color="dark", visible=False) for _ in range(PAGE)]
        gui.add_html('<i class="c3"></i>')
        self._newer = gui.add_button("‹ Newer", color="dark", disabled=True)
        self._older = gui.add_button("Older ›", color="dark", disabled=True)
        again = gui.add_button("Refresh", color="dark")
        for widget in (self._text, self._task, self._outcome):
            widget.on_update(lambda _: self._turn(-self._page))
        for number, button in enumerate(self._buttons):
            button.on_click(partial(self._open, number, open_take))
        self._newer.on_click(lambda _: self._turn(-1))
        self._older.on_click(lambda _: self._turn(1))
        again.on_click(lambda _: look_again())
        self._undo.on_click(lambda _: restore())

    def show(self) -> None:
        """Bring the page up to date with the catalogue."""
        with self._lock:
            filters = self._filters()
            count = self._catalog.count(**filters)
            last_page = max(count - 1, 0) // PAGE
            self._page = min(max(self._page, 0), last_page)
            self._rows = self._catalog.episodes(limit=PAGE, offset=self._page * PAGE, **filters)
            self._words.content = words(count, self._page, last_page, is_filtered=bool(filters))
            self._task.options = (ANY_TASK, *sorted(self._catalog.facets()["task"]))
            self._newer.disabled, self._older.disabled = self._page == 0, self._page == last_page
            for number, button in enumerate(self._buttons):
                button.visible = number < len(self._rows)
                if button.visible:
                    row = self._rows[number]
                    button.label, button.icon = label(row), ICONS[row.outcome]

    def offer_undo(self, deleted: str | None) -> None:
        """Offer to bring back the take of this id, or nothing."""
        self._undo.visible = deleted is not None
        # Of the id the part that tells it from others fits.
        self._undo.label = f"Undo: bring back {(deleted or '').split('-', 1)[-1]}"

    def neighbour(self, episode_id: str, steps: int) -> str | None:
        """Id of the take so many further down the filtered list."""
        rows = self._catalog.episodes(limit=None, **self._filters())
        ids = [row.episode_id for row in rows]
        place = ids.index(episode_id) + steps if episode_id in ids else -1
        return ids[place] if 0 <= place < len(ids) else None

    def _filters(self) -> Filters:
        filters: Filters = {}
        if self._text.value.strip():
            filters["text"] = self._text.value
        if self._task.value != ANY_TASK:
            filters["task"] = self._task.value
        if self._outcome.value != ANY_OUTCOME:
            filters["outcome"] = cast(Outcome, self._outcome.value)
        return filters

    def _turn(self, pages: int) -> None:
        self._page += pages
        self.show()

    def _open(self, number: int, open_take: Callable[[str], None], _: object) -> None:
        rows = self._rows
        if number < len(rows):
            open_take(rows[number].episode_id)


def label(row: EpisodeRow) -> str:
    """One line for a take; viser shows it as text."""
    when = time.strftime("%d %b %H:%M", time.localtime(row.started))
    seed = "" if row.seed is None else f" {row.seed}"
    stars = "" if row.quality is None else f" · {row.quality}/5"
    note = " · note" if row.note else ""
    return f"{when} · {row.task}{seed} · {row.duration:.1f} s · {row.peak_force:.0f} N{stars}{note}"


def words(count: int, page: int, last_page: int, *, is_filtered: bool) -> str:
    """What is in the list, or what to do where nothing is, as HTML."""
    if count:
        pages = f", page {page + 1} of {last_page + 1}" if last_page else ", newest first"
        return f'<div class="text dim">{count} {"take" if count == 1 else "takes"}{pages}</div>'
    if is_filtered:
        return (
            '<div class="card">No take matches. Clear the search, or choose any task and any outcome.</div>'
        )
    return (
        '<div class="card"><b>No takes yet</b><ol><li>Choose who drives under Teleop.</li>'
        "<li>Press R to start a take, R again to keep it.</li>"
        "<li>It appears here; click it to see it again.</li></ol>"
        "Or let the script record some: <code>studio demo wiping --episodes 3 --seed 0</code></div>"
    )
