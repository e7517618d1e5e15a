"""What an empty data folder greets with: the first three steps. Each is ticked off; then they disappear."""

from __future__ import annotations

import viser

from studio.messages import Status

STEPS = (
    ("Drive", "Choose <b>Gizmo</b> below and drag the arrows at a tool until it touches something."),
    (
        "Record",
        "Press <kbd>R</kbd> or <b>Start take</b>, do what stands there, press <kbd>R</kbd> again.",
    ),
    ("Review", "Open your take under <b>Episodes</b> and see its forces."),
)


class FirstSteps:
    """Shared by everybody: it goes when a first take was reviewed, or by its button."""

    def __init__(self, gui: viser.GuiApi, *, is_needed: bool) -> None:
        self._done = [not is_needed] * len(STEPS)
        self._card = gui.add_html(card(self._done), visible=is_needed, order=0.1)
        self.close = gui.add_button("Got it", color="dark", visible=is_needed, order=0.2)
        self.close.on_click(lambda _: self._tick(*range(len(STEPS))))

    def show(self, status: Status, is_reviewed: bool) -> None:
        """`is_reviewed`: somebody has a take open."""
        if any(arm.input_age is not None for arm in status.arms):
            self._tick(0)
        if status.last_take is not None and not status.last_take.discarded:
            self._tick(1)
        if is_reviewed:
            self._tick(2)

    def _tick(self, *steps: int) -> None:
        if all(self._done):
            return
        for step in steps:
            self._done[step] = True
        self._card.content = card(self._done)
        self._card.visible = self.close.visible = not all(self._done)


def card(done: list[bool]) -> str:
    """The steps as HTML."""
    items = "".join(
        f'<li class="{"done" if is_done else ""}"><b>{title}.</b> {text}</li>'
        for (title, text), is_done in zip(STEPS, done, strict=True)
    )
    return f'<div class="card">Welcome. Your first take in three steps:<ol>{items}</ol></div>'
