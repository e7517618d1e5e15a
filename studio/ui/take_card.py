"""The open take in words: its facts and pictures, and what people say about it."""

from __future__ import annotations

import time
from functools import partial
from html import escape
from typing import Any, Protocol

import viser

from studio.edits import OUTCOMES, QUALITIES, Outcome
from studio.index import EpisodeRow
from studio.ui.teleop import set_value

UNRATED = "not rated"
HELP = (
    '<div class="text dim"><kbd>Space</kbd> plays, <kbd>←</kbd> <kbd>→</kbd> step by a picture. '
    "Keys that drive the robot rest while a take is open. "
    "A deleted take goes to the trash; the list can bring it back.</div>"
)
COLORS: dict[Outcome, Any] = {"success": "green", "failure": "red", "unmarked": "gray"}


class Actions(Protocol):
    """Where the buttons of a card lead."""

    def back(self) -> None: ...

    def neighbour(self, steps: int) -> None: ...

    def annotate(self, **changes: Any) -> None: ...

    def undo(self) -> None: ...

    def delete(self) -> None: ...


class TakeCard:
    """Built into the container that is open."""

    def __init__(self, gui: viser.GuiApi, actions: Actions) -> None:
        self._actions = actions
        self._row: EpisodeRow | None = None
        gui.add_html('<i class="c3"></i>')
        back = gui.add_button("‹ All takes", color="blue")
        newer = gui.add_button("Newer", color="dark")
        older = gui.add_button("Older", color="dark")
        self._facts = gui.add_html("")
        self.gallery = gui.add_folder(None)
        gui.add_html('<i class="c3"></i>')
        self._outcomes = {outcome: gui.add_button(outcome.capitalize(), color="dark") for outcome in OUTCOMES}
        self._quality = gui.add_dropdown(
            "Quality", [UNRATED, *map(str, QUALITIES)], hint="1 poor, 5 excellent"
        )
        self._note = gui.add_text("Note", "", multiline=True, hint="Saved by the button, or when you leave.")
        gui.add_html('<i class="c3"></i>')
        save = gui.add_button("Save note", color="dark")
        undo = gui.add_button("Undo", color="dark")
        delete = gui.add_button("Delete", color="dark")
        gui.add_html(HELP)
        back.on_click(lambda _: actions.back())
        newer.on_click(lambda _: actions.neighbour(-1))
        older.on_click(lambda _: actions.neighbour(1))
        save.on_click(lambda _: self.save_note())
        undo.on_click(lambda _: actions.undo())
        delete.on_click(lambda _: actions.delete())
        for outcome, button in self._outcomes.items():
            button.on_click(partial(self._judge, outcome))
        self._quality.on_update(self._rate)

    def show(self, row: EpisodeRow) -> None:
        """Another take, or the same one after a change; what is typed in its note stays."""
        before, self._row = self._row, row
        is_typing = (
            before is not None and before.episode_id == row.episode_id and self._note.value != before.note
        )
        if not is_typing:
            set_value(self._note, row.note)
        self._facts.content = facts(row)
        set_value(self._quality, UNRATED if row.quality is None else str(row.quality))
        for outcome, button in self._outcomes.items():
            is_chosen = outcome == row.outcome
            button.color = COLORS[outcome] if is_chosen else "dark"
            button.label = f"● {outcome.capitalize()}" if is_chosen else outcome.capitalize()

    def fail(self, why: str) -> None:
        """Say why the take cannot be shown."""
        self._facts.content = f'<div class="card bad">{escape(why)}</div>'

    def save_note(self) -> None:
        """Keep the note where it was changed."""
        if self._row is not None and self._note.value != self._row.note:
            self._actions.annotate(note=self._note.value)

    def _judge(self, outcome: Outcome, _: object) -> None:
        self._actions.annotate(outcome=outcome)

    def _rate(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client is None:  # our own `show`
            return
        value = self._quality.value
        if value == UNRATED:
            self._actions.annotate(clear=("quality",))
        else:
            self._actions.annotate(quality=int(value))


def facts(row: EpisodeRow) -> str:
    """What the catalogue knows about a take, as HTML."""
    when = time.strftime("%a %d %b %Y, %H:%M:%S", time.localtime(row.started))
    who = f"{row.operator} ({row.agent})" if row.operator != row.agent else row.operator
    told = {
        "recorded": when,
        "by": who,
        "length": f"{row.duration:.1f} s",
        "force": f"peak {row.peak_force:.1f} N, mean {row.mean_force:.1f} N in contact",
        "id": row.episode_id,
    }
    lines = "".join(f"<span>{name}</span><span>{escape(value)}</span>" for name, value in told.items())
    seed = "" if row.seed is None else f" · seed {row.seed}"
    return f'<div class="facts"><b>{escape(row.task)}{seed}</b>{lines}</div>'
