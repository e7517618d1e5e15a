"""Keys: hotkeys that do what buttons do, and a keypad whose buttons and keys move an arm while held."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import viser

from controller.types import Array, Pose, rotation_of
from studio.messages import Status
from studio.ui.desk import CHOICES, Desk

REPEAT = 0.7  # [s] a held key repeats faster than this; only its first press counts
HOLD_RATE = 20.0  # [Hz] of nudges while a key is held; viser's page sends no faster
LONGEST_STEP = 0.25  # [s] of motion that one nudge may stand for: a busy browser sends fewer

Action = Callable[[], None]


@dataclass(frozen=True, slots=True)
class Hotkey:
    """A key and what it does; a button does the same."""

    key: Any  # viser's name of it
    label: str
    action: Action
    shift: bool = False

    @property
    def name(self) -> str:
        return ("Shift+" if self.shift else "") + str(self.key).capitalize()


class Hotkeys:
    """The hotkeys of a page, also in the command palette (Ctrl+K). Typing in a field triggers none."""

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._gui, self._desk = gui, desk
        self._of_arms: list[viser.CommandHandle] = []
        self._pressed: dict[tuple[str, int | None], float] = {}  # [s] monotonic, of each key and client
        self.keys = [
            Hotkey("R", "Start or stop the take", desk.toggle_take),
            Hotkey("Y", "Stop, keep as a success", partial(desk.keep, "success")),
            Hotkey("N", "Stop, keep as a failure", partial(desk.keep, "failure")),
            Hotkey("X", "Discard the take", desk.discard),
            Hotkey("Z", "Undo the discard", desk.undo_discard),
            Hotkey("F", "Let go: stop pressing", desk.release),
            Hotkey("B", "Reset the scene", desk.reset_again),
            Hotkey("V", "Next seed", desk.next_seed),
            *(
                Hotkey(str(index % len(CHOICES)), f"Drive: {choice}", partial(desk.drive, choice))
                for index, choice in enumerate(CHOICES, start=1)
            ),
        ]
        for hotkey in self.keys:
            self._register(hotkey)

    def set_arms(self, names: tuple[str, ...]) -> list[Hotkey]:
        """One set per arm, see `is_shifted`."""
        for command in self._of_arms:
            command.remove()
        desk = self._desk
        keys = []
        for arm, name in enumerate(names):
            shift = is_shifted(arm, len(names))
            keys += [
                Hotkey("M", f"Switch the {name} arm's stiffness", partial(desk.switch_mode, arm), shift),
                Hotkey("G", f"Open or close the {name} gripper", partial(desk.toggle_gripper, arm), shift),
                Hotkey("P", f"Park or engage the {name} arm", partial(desk.toggle_engaged, arm), shift),
            ]
        if len(names) > 1:
            keys.append(Hotkey("H", "Mirror: both arms, one hand", desk.toggle_mirror))
            keys.append(Hotkey("T", "Keyboard drives the other arm", desk.switch_keyboard_arm))
        self._of_arms = [self._register(hotkey) for hotkey in keys]
        return self.keys + keys

    def _register(self, hotkey: Hotkey) -> viser.CommandHandle:
        command = self._gui.add_command(
            hotkey.label, hotkey=hotkey.key, modifier="shift" if hotkey.shift else None
        )

        @command.on_trigger
        def _(event: viser.CommandEvent) -> None:
            now, key = time.monotonic(), (hotkey.name, event.client_id)
            is_repeated = now - self._pressed.get(key, -REPEAT) < REPEAT
            self._pressed[key] = now
            if not is_repeated:
                hotkey.action()

        return command


def is_shifted(arm: int, n_arms: int) -> bool:
    """Keys of the right arm, always the last, are plain; those of a left one go with Shift."""
    return arm < n_arms - 1


def table(keys: list[Hotkey]) -> str:
    """The keys as HTML."""
    rows = "".join(f"<kbd>{key.name}</kbd><span>{key.label}</span>" for key in keys)
    return f'<div class="text keys">{rows}</div>'


Motion = tuple[Literal["move", "turn"], Array]  # along or about right, away, up of the view

# Keys by their place on an American keyboard, in rows of three.
_KEYS: tuple[tuple[str, str, Motion], ...] = (
    ("KeyQ", "Q  down", ("move", np.array([0.0, 0.0, -1.0]))),
    ("KeyW", "W  away", ("move", np.array([0.0, 1.0, 0.0]))),
    ("KeyE", "E  up", ("move", np.array([0.0, 0.0, 1.0]))),
    ("KeyA", "A  left", ("move", np.array([-1.0, 0.0, 0.0]))),
    ("KeyS", "S  near", ("move", np.array([0.0, -1.0, 0.0]))),
    ("KeyD", "D  right", ("move", np.array([1.0, 0.0, 0.0]))),
    ("KeyU", "U  turn left", ("turn", np.array([0.0, 0.0, 1.0]))),
    ("KeyI", "I  tip away", ("turn", np.array([-1.0, 0.0, 0.0]))),
    ("KeyO", "O  turn right", ("turn", np.array([0.0, 0.0, -1.0]))),
    ("KeyJ", "J  tip left", ("turn", np.array([0.0, -1.0, 0.0]))),
    ("KeyK", "K  tip near", ("turn", np.array([1.0, 0.0, 0.0]))),
    ("KeyL", "L  tip right", ("turn", np.array([0.0, 1.0, 0.0]))),
)


class Keypad:
    """Buttons that move the keyboard's arm while they or their keys are held (`web_assets/page.js`)."""

    def __init__(self, desk: Desk, target: Callable[[int], Pose | None]) -> None:
        """`target` tells base_from_target of an arm."""
        self._desk, self._target = desk, target
        self._held: dict[str, float] = {}  # [s] monotonic time of each button's last nudge

    def build(self, gui: viser.GuiApi) -> None:
        self._folder = gui.add_folder(None, visible=False)
        with self._folder:
            self._arm = gui.add_button("", color="dark", visible=False)
            for row in range(0, len(_KEYS), 3):
                codes = " ".join(code for code, _, _ in _KEYS[row : row + 3])
                gui.add_html(f'<i class="c3" data-hold="{codes}"></i>')
                for code, label, motion in _KEYS[row : row + 3]:
                    self._add(gui, code, label, motion)
            self._speed = gui.add_slider(
                "Speed", 10, 150, 5, 60, hint="Millimetres a second; half as many degrees."
            )
        self._arm.on_click(lambda _: self._desk.switch_keyboard_arm())

    def show(self, status: Status, *, visible: bool) -> None:
        self._folder.visible = visible
        self._arm.visible = len(status.arms) > 1
        self._arm.label = f"Drives the {status.arms[self._desk.keyboard_arm % len(status.arms)].name} arm (T)"

    def _add(self, gui: viser.GuiApi, code: str, label: str, motion: Motion) -> None:
        button = gui.add_button(label, color="dark")

        @button.on_hold(callback_hz=HOLD_RATE)
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None:
                self._nudge(code, motion, event.client.camera.wxyz)

    def _nudge(self, code: str, motion: Motion, camera_wxyz: Array) -> None:
        """One step as long as the key was held since the last; a short press is one step."""
        now = time.monotonic()
        since = now - self._held.get(code, 0.0)
        self._held[code] = now
        seconds = since if since < LONGEST_STEP else 1.0 / HOLD_RATE
        kind, direction = motion
        along = world_from_view(camera_wxyz) @ direction
        if kind == "move":
            x, y, z = (along * self._speed.value / 1000.0 * seconds).tolist()
            self._desk.nudge((x, y, z))
            return
        target = self._target(self._desk.keyboard_arm)
        if target is not None:
            about = target.rotation.T @ along * np.radians(self._speed.value / 2.0) * seconds
            x, y, z = about.tolist()
            self._desk.nudge((0.0, 0.0, 0.0), (x, y, z))


def world_from_view(camera_wxyz: Array) -> Array:
    """(3, 3) columns right, away, up of who looks, turned to the nearest axes of the world.

    viser's cameras look along +z with y down.
    """
    looks = rotation_of(camera_wxyz)[:, 2]
    if np.hypot(looks[0], looks[1]) < 1e-6:  # straight down: what is up on the screen is away
        looks = -rotation_of(camera_wxyz)[:, 1]
    quarter = round(np.arctan2(looks[1], looks[0]) / (np.pi / 2))
    away = np.round([np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.column_stack((np.cross(away, up), away, up))
