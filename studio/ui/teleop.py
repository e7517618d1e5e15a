"""The Teleop tab: what is on the stage, who drives, each arm, the take, collecting."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import Any, Final

import viser

from studio import tasks
from studio.messages import ArmStatus, Status
from studio.pilot import Playing, Tried
from studio.tasks import ArmSetup
from studio.ui.desk import CHOICES, Choice, Desk
from studio.ui.keys import Keypad, is_shifted
from studio.ui.status import clock, mode_words

ACTIVE: Final = "blue"
PASSIVE: Final = "dark"
LABELS: dict[Choice, str] = {
    "gizmo": "Gizmo",
    "keyboard": "Keys",
    "script": "Script",
    "nobody": "Nobody",
    "policy": "Policy",
}
MOST_TAKES = 1000
LOOK_EVERY = 5.0  # [s] between looks for new runs
SETTLE = 0.5  # [s] until what a person has set comes back from the session


class TeleopTab:
    """Built into the container that is open; `show` keeps it up to date."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, keypad: Keypad) -> None:
        with gui.add_folder(None, order=1.0):
            self._scene = _SceneRows(gui, desk)
        with gui.add_folder("Who drives", order=2.0):
            self._driver = _DriverRows(gui, desk, keypad)
        with gui.add_folder("Take", order=4.0):
            self._take = _TakeRows(gui, desk)
        with gui.add_folder("Collect", order=5.0):
            self._collect = _CollectRows(gui, desk)
        self._gui, self._desk = gui, desk
        self._arms: list[_ArmRows] = []
        self._container = gui.add_folder(None, order=3.0)

    def set_task(self, arms: Sequence[ArmSetup]) -> None:
        """Another task is on the stage: it has other arms."""
        for rows in self._arms:
            rows.remove()
        with self._container:
            self._arms = [
                _ArmRows(self._gui, self._desk, index, setup, len(arms)) for index, setup in enumerate(arms)
            ]

    def show(self, status: Status) -> None:
        self._scene.show(status)
        self._driver.show(status)
        self._take.show(status)
        self._collect.show(status)
        for rows, arm in zip(self._arms, status.arms, strict=False):
            rows.show(arm, status)


class _SceneRows:
    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        _columns(gui, 2)
        self._task = gui.add_dropdown("Task", tasks.names())
        self._seed = gui.add_number(
            "Seed", 0, min=0, step=1, hint="Draws the scene; the same seed, the same scene."
        )
        self._resets = -1
        _columns(gui, 2)
        again = gui.add_button("Reset (B)", color=PASSIVE, icon=viser.Icon.REFRESH)
        following = gui.add_button("Next seed (V)", color=PASSIVE, icon=viser.Icon.PLAYER_TRACK_NEXT)

        @self._task.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            if event.client is not None:  # not our own `show`
                desk.reset(self._seed.value, self._task.value)

        on_click(again, lambda: desk.reset(self._seed.value))
        on_click(following, desk.next_seed)
        self._buttons = (again, following)

    def show(self, status: Status) -> None:
        if status.resets != self._resets:  # else it is a person's, who may be typing
            self._resets = status.resets
            set_value(self._task, status.task)
            set_value(self._seed, status.seed)
        for widget in (*self._buttons, self._task):
            widget.disabled = status.phase == "recording"


class _DriverRows:
    def __init__(self, gui: viser.GuiApi, desk: Desk, keypad: Keypad) -> None:
        self._desk, self._keypad = desk, keypad
        _columns(gui, 4)
        people = [choice for choice in CHOICES if choice != "policy"]
        self._buttons = {choice: gui.add_button(LABELS[choice], color=PASSIVE) for choice in people}
        self._policies = _PolicyRow(gui, desk)
        self._hint = gui.add_html("")
        self._mirror = gui.add_button(
            "Mirror",
            color=PASSIVE,
            visible=False,
            hint="What moves one arm moves the other like in a mirror.",
        )
        on_click(self._mirror, desk.toggle_mirror)
        keypad.build(gui)

        for choice, button in self._buttons.items():
            on_click(button, partial(desk.drive, choice))

    def show(self, status: Status) -> None:
        active = active_choice(status, self._desk.choice)
        for choice, button in self._buttons.items():
            _set_active(button, LABELS[choice], choice == active)
        self._policies.show(status)
        self._keypad.show(status, visible=active == "keyboard")
        self._hint.content = f'<div class="text dim">{_DRIVER_HINTS[active]}</div>'
        self._mirror.visible = len(status.arms) == 2 and status.driver == "operator"
        _set_active(self._mirror, "Mirror both arms (H)", status.mirrored)


_DRIVER_HINTS: dict[Choice, str] = {
    "gizmo": 'Drag the arrows at the tool, or <a href="/xr" target="_blank">use a headset</a>.',
    "keyboard": "Hold a key; directions follow your view.",
    "script": "The task's own demonstration runs.",
    "policy": "The run drives. Drag the arrows at the tool to take over, press Policy to hand back.",
    "nobody": "The arms hold. Choosing who drives moves nothing.",
}


class _PolicyRow:
    """The runs that have learned the task, how one plays its chunks, and the button that lets it drive.

    Gone where there are no runs.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk, self._looked = desk, -LOOK_EVERY
        self._task = ""
        self._ways: dict[str, Playing] = {}
        self._row = _columns(gui, 2)
        self._run = gui.add_dropdown("Run", ("",), visible=False, hint="A trained policy of this task.")
        self._button = gui.add_button(LABELS["policy"], color=PASSIVE, visible=False)
        self._way = gui.add_dropdown(
            "Plays",
            ("",),
            visible=False,
            hint="How much, before it looks again; first what did best when evaluated.",
        )

        @self._run.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            self._choose(self._run.value)

        @self._way.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            desk.playing = self._ways.get(self._way.value, desk.playing)

        on_click(self._button, partial(desk.drive, "policy"))

    def show(self, status: Status) -> None:
        now = time.monotonic()
        if status.task != self._task or now > self._looked + LOOK_EVERY:
            self._task, self._looked = status.task, now
            self._offer(tuple(self._desk.runs_of(status.task)))
        _set_active(self._button, LABELS["policy"], status.driver == "policy")

    def _offer(self, runs: tuple[str, ...]) -> None:
        self._row.visible = self._run.visible = self._button.visible = bool(runs)
        if runs and runs != self._run.options:
            chosen = self._run.value
            self._run.options = runs
            set_value(self._run, chosen if chosen in runs else runs[0])
        self._choose(self._run.value if runs else "")

    def _choose(self, run: str) -> None:
        if run == self._desk.policy:
            return
        tried = self._desk.ways_to_play(run) if run else []
        self._desk.policy = run
        self._ways = {_words_of(one): one.playing for one in tried}
        self._way.visible = bool(tried)
        if tried:
            self._way.options = tuple(self._ways)
            set_value(self._way, self._way.options[0])
            self._desk.playing = tried[0].playing


def _words_of(tried: Tried) -> str:
    """Of one way of playing chunks."""
    playing = tried.playing
    averages = playing.execution == "ensemble"
    words = "average of all chunks" if averages else f"{playing.steps} steps of each chunk"
    if averages and playing.steps > 1:
        words += f", one each {playing.steps} steps"
    return f"{words} ({tried.successes}/{tried.trials})" if tried.trials else words


class _ArmRows:
    """One arm: stiffness, gripper, parking."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, arm: int, setup: ArmSetup, n_arms: int) -> None:
        self._touched = 0.0  # [s] monotonic time at which a person last moved the slider
        self._folder = gui.add_folder(f"{setup.name.capitalize()} arm")
        self._shift = "⇧" if is_shifted(arm, n_arms) else ""
        modes = {mode.value for mode in setup.modes}  # an arm may have but one
        with self._folder:
            if len(modes) > 1:
                _columns(gui, 2)
            self._modes = {
                mode: gui.add_button(mode, color=PASSIVE)
                for mode in sorted(modes, key=("low", "medium", "high").index)
            }
            self._gripper = gui.add_slider(
                "Gripper", 0.0, 1.0, 0.01, 0.0, hint=f"0 closed, 1 open; {self._shift}G switches."
            )
            is_last = arm == n_arms - 1
            if is_last:
                _columns(gui, 2)
            self._park = gui.add_button("Park", color=PASSIVE)
            if is_last:
                release = gui.add_button("Let go (F)" if n_arms == 1 else "Let go, both (F)", color=PASSIVE)
                on_click(release, desk.release)

        for mode, button in self._modes.items():
            on_click(button, partial(desk.set_mode, arm, mode))

        @self._gripper.on_update
        def _(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client is not None:
                self._touched = time.monotonic()
                desk.set_gripper(arm, self._gripper.value)

        @self._park.on_click
        def _(_: object) -> None:
            desk.toggle_engaged(arm)

    def show(self, arm: ArmStatus, status: Status) -> None:
        for mode, button in self._modes.items():
            _set_active(button, _sentence(mode_words(mode)), mode == arm.mode)
        if time.monotonic() > self._touched + SETTLE:  # never against a hand that drags
            set_value(self._gripper, arm.opening)
        self._park.label = f"{'Park' if arm.engaged else 'Engage'} ({self._shift}P)"
        self._park.color = PASSIVE if arm.engaged else ACTIVE
        self._park.disabled = status.driver != "operator"

    def remove(self) -> None:
        self._folder.remove()


class _TakeRows:
    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk = desk
        self._state = gui.add_html("")
        self._start = gui.add_button("Start take", color="red", icon=viser.Icon.PLAYER_RECORD)
        _columns(gui, 3)
        self._success = gui.add_button("Success (Y)", color="green")
        self._failure = gui.add_button("Failure (N)", color=PASSIVE)
        self._discard = gui.add_button("Discard (X)", color=PASSIVE)
        self._last = gui.add_html("")
        self._undo = gui.add_button(
            "Undo discard (Z)", color=ACTIVE, icon=viser.Icon.ARROW_BACK_UP, visible=False
        )
        _columns(gui, 2)
        countdown = gui.add_number(
            "Countdown", desk.countdown, min=0.0, max=30.0, step=1.0, hint="Seconds before recording."
        )
        sounds = gui.add_checkbox("Sounds", True)

        on_click(self._start, desk.toggle_take)
        on_click(self._success, partial(desk.keep, "success"))
        on_click(self._failure, partial(desk.keep, "failure"))
        on_click(self._discard, desk.discard)
        on_click(self._undo, desk.undo_discard)

        @countdown.on_update
        def _(_: object) -> None:
            desk.countdown = countdown.value

        @sounds.on_update
        def _(_: object) -> None:
            desk.with_sounds = sounds.value

    def show(self, status: Status) -> None:
        last = status.last_take
        is_gone = last is not None and self._desk.is_discarded(last)
        self._state.content = progress(status)
        self._start.label = {
            "idle": "Start take (R)",
            "countdown": "Cancel countdown (R)",
            "recording": f"Stop and keep (R)  {clock(status.take_seconds)}",
        }[status.phase]
        self._start.color = "orange" if status.phase == "countdown" else "red"
        is_recording = status.phase == "recording"
        self._success.disabled = self._failure.disabled = not is_recording
        self._discard.disabled = not is_recording and (last is None or is_gone)
        self._discard.label = "Discard (X)" if is_recording or last is None else "Discard last (X)"
        self._undo.visible = is_gone
        self._last.content = last_take(status, is_gone)


class _CollectRows:
    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._state = gui.add_html("")
        _columns(gui, 2)
        self._count = gui.add_number("Takes", 30, min=1, max=MOST_TAKES, step=1)
        self._seed = gui.add_number("Seed", 0, min=0, step=1, hint="Of the first; then one more each.")
        self._button = gui.add_button("Collect", color=ACTIVE, icon=viser.Icon.REPEAT)
        self._is_collecting = False

        @self._button.on_click
        def _(_: object) -> None:
            if self._is_collecting:
                desk.stop_collecting()
            else:
                desk.collect(self._count.value, self._seed.value)

    def show(self, status: Status) -> None:
        self._is_collecting = status.to_collect > 0
        self._state.content = counter(status)
        self._button.label = "Stop collecting" if self._is_collecting else "Collect"
        self._button.color = "orange" if self._is_collecting else ACTIVE
        self._count.disabled = self._seed.disabled = self._is_collecting


def active_choice(status: Status, chosen: Choice) -> Choice:
    """Who drives, as one of the choices on the page."""
    if status.driver == "operator":
        return "keyboard" if chosen == "keyboard" else "gizmo"
    return status.driver


def progress(status: Status) -> str:
    """The instruction and how far it is, as HTML."""
    color = "good" if status.success else "calm"
    done = " done" if status.success else ""
    return (
        f'<div class="text">{escape(status.instruction)}<div class="gauge" style="padding:0">'
        f'<div class="track {color}"><div class="fill" style="width:{status.progress:.0%}"></div></div>'
        f'<div class="row dim"><span>{escape(status.task_phase)}</span>'
        f'<span class="{color}">{status.progress:.0%}{done}</span></div></div></div>'
    )


def last_take(status: Status, is_gone: bool) -> str:
    """What became of the last take, as HTML."""
    take = status.last_take
    if take is None:
        return '<div class="text dim">No take yet.</div>'
    color = {"success": "good", "failure": "refused", "unmarked": "dim"}[take.outcome]
    what = "in the trash" if is_gone else f'<b class="{color}">{take.outcome}</b>'
    return (
        f'<div class="text">Last take {what}, {take.seconds:.1f} s'
        f'<br><span class="dim">{escape(take.episode_id)}</span></div>'
    )


def counter(status: Status) -> str:
    """7 / 30, as HTML."""
    if status.to_collect == 0:
        return '<div class="text dim">Rising seeds; each take ends at success.</div>'
    share = status.collected / status.to_collect
    return (
        f'<div class="gauge"><div class="row"><span>Kept, seed {status.seed} is on the stage</span>'
        f'<span class="newtons">{status.collected} / {status.to_collect}</span></div>'
        f'<div class="track good"><div class="fill" style="width:{share:.1%}"></div></div></div>'
    )


def _columns(gui: viser.GuiApi, count: int) -> viser.GuiHtmlHandle:
    """Put the next `count` widgets side by side (`web_assets/page.css`); hidden with them."""
    return gui.add_html(f'<i class="c{count}"></i>')


def _set_active(button: viser.GuiButtonHandle, label: str, is_active: bool) -> None:
    """Say and show that this one of several is chosen."""
    button.label = f"● {label}" if is_active else label
    button.color = ACTIVE if is_active else PASSIVE


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:]


def on_click(button: viser.GuiButtonHandle, action: Callable[[], None]) -> None:
    button.on_click(lambda _: action())


def set_value(widget: Any, value: object) -> None:
    """Show a value that is not a person's; callbacks see it without a client."""
    widget.value = value
