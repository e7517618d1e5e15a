"""What everybody should see at one look: the line at the top, words over the scene, notices and sounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Literal, assert_never

import viser

from controller.stiffness import stiffness_of
from controller.types import StiffnessMode
from studio.messages import ArmStatus, Level, Notice, NoticeKind, Status
from studio.ui.remote import State

OperatorInput = Literal["gizmo", "keyboard"]
Color = Literal["blue", "green", "orange", "red", "gray"]
Sound = Literal["tick", "start", "success", "kept", "discarded", "error"]

FRESH = 0.5  # [s] input younger than this is "live"
SOUNDS: Mapping[NoticeKind, Sound] = {
    "countdown": "tick",
    "recording": "start",
    "success": "success",
    "take kept": "kept",
    "take discarded": "discarded",
    "error": "error",
}
WORD_OF_LEVEL: Mapping[Level, str] = {"ok": "passes", "limited": "limited", "refused": "refused"}
CLASS_OF_LEVEL: Mapping[Level, str] = {"ok": "calm", "limited": "limited", "refused": "refused"}


class StatusLine:
    """The line at the top and what lies over the scene; `web_assets/page.js` puts them there."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._line = gui.add_html(_told(line(None, "closed", "gizmo")))
        self._over = gui.add_html("")

    def show(
        self, status: Status | None, state: State, operator_input: OperatorInput, control: str = ""
    ) -> None:
        """`control`: who may drive, in words."""
        self._line.content = _told(line(status, state, operator_input, control))
        self._over.content = _told(over(status, state))


class Sounds:
    """Plays a cue in every browser; `web_assets/page.js` makes the tones."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._count = 0
        self._mark = gui.add_html(self._html("none"))

    def play(self, sound: Sound) -> None:
        self._count += 1
        self._mark.content = self._html(sound)

    def _html(self, sound: str) -> str:
        return f'<i data-sound="{self._count} {sound}"></i>'


def notify(server: viser.ViserServer, notice: Notice) -> None:
    """Tell every browser, for as long as it deserves."""
    title, color, seconds = _NOTICES[notice.kind]
    if title:
        for client in server.get_clients().values():
            client.add_notification(title, notice.text, color=color, auto_close_seconds=seconds)


_NOTICES: Mapping[NoticeKind, tuple[str, Color, float | None]] = {
    "info": ("Note", "blue", 6.0),
    "warning": ("Careful", "orange", 10.0),
    "error": ("That did not work", "red", 12.0),
    "take kept": ("Take kept", "green", 5.0),
    "take discarded": ("Take discarded", "gray", 8.0),
    "countdown": ("", "gray", None),  # the line and the scene say these
    "recording": ("", "gray", None),
    "success": ("", "gray", None),
}


def _told(html: str) -> str:
    return f'<div class="told">{html}</div>'


def line(status: Status | None, state: State, operator_input: OperatorInput, control: str = "") -> str:
    """The status line as HTML."""
    parts = ['<span class="name"><b>Comp-ACT Studio</b></span>']
    if status is not None:
        parts.append(f"<span>{escape(status.task)} · seed {status.seed}</span>")
    if status is None or state != "open":
        parts.append(f'<span class="refused"><b>{_lost_word(status, state)}</b></span>')
        return _bar(parts, [])
    parts.append(f'<span class="driver">{driver(status, operator_input, control)}</span>')
    parts += [_arm(arm, status) for arm in status.arms]
    return _bar(parts, [_pace(status), _input(status), _recording(status)])


def over(status: Status | None, state: State) -> str:
    """What lies over the scene as HTML: limits and why, the countdown, a lost session."""
    if status is None or state != "open":
        text = lost(status, state)
        return (
            f'<div class="over"><div class="note refused"><span>{text}</span></div></div>' if status else ""
        )
    notes = "".join(_limit(arm) for arm in status.arms if arm.level != "ok")
    if status.phase == "countdown" and status.countdown > 0:
        notes += f'<div class="count">{math.ceil(status.countdown)}</div>'
    return f'<div class="over">{notes}</div>' if notes else ""


def lost(status: Status | None, state: State) -> str:
    """What happened to the session and what became of the take, as HTML; empty while all is well."""
    if state == "open":
        return ""
    if status is None:
        return "The session process is starting."
    what = (
        "The session process has ended; nothing drives the arms."
        if state == "closed"
        else "The session process does not answer; wait, or restart it."
    )
    take = f" The take {escape(status.take_id)} is kept; a restart recovers it." if status.take_id else ""
    return what + take


def driver(status: Status, operator_input: OperatorInput, control: str = "") -> str:
    """Who drives, and who has control, as HTML."""
    name, control = escape(status.operator or control), escape(control)
    has_control = f", <b>{control}</b> has control" if control else ""
    match status.driver:
        case "nobody":
            return f'<span class="dim">nobody drives, the arms hold{has_control}</span>'
        case "operator":
            return f"<b>{name or 'operator'}</b> drives by {operator_input}"
        case "script":
            return f"the <b>script</b> drives{has_control}"
        case "policy":
            late = f", late for {status.policy_late} ticks" if status.policy_late else ""
            return f"<b>{escape(status.policy)}</b> drives{late}{has_control}"
        case other:
            assert_never(other)


def mode_words(mode: str) -> str:
    """A stiffness mode with its number: `low 250 N/m`."""
    newtons = stiffness_of(StiffnessMode(mode)).translational[0, 0]
    return f"{mode} {newtons:.0f} N/m"


def clock(seconds: float) -> str:
    return f"{int(seconds) // 60:02d}:{int(seconds) % 60:02d}"


def _arm(arm: ArmStatus, status: Status) -> str:
    color, word = CLASS_OF_LEVEL[arm.level], WORD_OF_LEVEL[arm.level]
    if arm.level == "ok" and (status.driver == "nobody" or (status.driver == "operator" and not arm.engaged)):
        color, word = "dim", "holds"
    return (
        f'<span class="arm">{escape(arm.name)} '
        f'<span class="chip {escape(arm.mode)}">{mode_words(arm.mode)}</span> '
        f'<span class="{color}">● {word}</span></span>'
    )


def _limit(arm: ArmStatus) -> str:
    color, word = CLASS_OF_LEVEL[arm.level], WORD_OF_LEVEL[arm.level]
    return (
        f'<div class="note {color}"><b>{escape(arm.name)} {word}</b> <span>{escape(arm.why)}</span></div><br>'
    )


def _pace(status: Status) -> str:
    color = "dim" if status.late_share < 0.005 else "limited"
    return f'<span class="{color}">{status.rate:.0f} Hz · late {status.late_share:.1%}</span>'


def _input(status: Status) -> str:
    ages = [arm.input_age for arm in status.arms if arm.input_age is not None]
    if status.driver != "operator" or not ages:
        return ""
    return f'<span class="dim">input {age_words(min(ages))}</span>'


def age_words(seconds: float) -> str:
    """Coarse, so that it is not sent anew all the time."""
    if seconds < FRESH:
        return "live"
    return f"{seconds:.0f} s ago" if seconds < 60 else f"{seconds / 60:.0f} min ago"


def _recording(status: Status) -> str:
    match status.phase:
        case "recording":
            return f'<span class="rec">● REC {clock(status.take_seconds)}</span>'
        case "countdown":
            return f'<span class="rec soon">starts in {math.ceil(status.countdown)}</span>'
        case "idle":
            return '<span class="rec idle">not recording</span>'
        case other:
            assert_never(other)


def _lost_word(status: Status | None, state: State) -> str:
    if state == "stuck":
        return "The session does not answer"
    return "No session yet" if status is None else "The session has ended"


def _bar(left: list[str], right: list[str]) -> str:
    return f'<div class="bar">{"".join(left)}<span class="right">{"".join(right)}</span></div>'
