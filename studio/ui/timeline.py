"""The timeline of a take as HTML: phases, stiffness modes and marks; the playhead; what is true at its time.

Everything that came from a file is escaped here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from studio.cursor import CONTACT, ArmMoment, ArmTrack, Mark, Moment, Span

ROW = 15  # [px] height of a row of the strip; `web_assets/review.css` has it, too
LEAST_WIDTH = 0.4  # [%] of the strip: what lasts less is still seen

WORD_OF_KIND = {"mode": "stiffness", "limited": "limited", "refused": "refused", "event": "event"}


def strip(arms: Sequence[ArmTrack], marks: Sequence[Mark], duration: float) -> str:
    """Two bands for each arm, contact over stiffness, and a row of marks."""
    rows = []
    for arm in arms:
        suffix = f", {escape(arm.name)}" if len(arms) > 1 else ""
        rows.append(_row(f"contact{suffix}", (_contact(span, duration) for span in arm.phases)))
        rows.append(_row(f"stiffness{suffix}", (_mode(span, duration) for span in arm.modes)))
    happened = [mark for mark in marks if mark.kind != "mode"]
    if happened:
        rows.append(_row("limits, events", (_mark(mark, duration) for mark in happened)))
    return f'<div class="strip">{"".join(rows)}</div>'


def height(arms: Sequence[ArmTrack], marks: Sequence[Mark]) -> int:
    """[px] of the strip."""
    return ROW * (2 * len(arms) + any(mark.kind != "mode" for mark in marks))


def playhead(share: float, height: int) -> str:
    """A line over the `height` [px] of what stands above it, at a share of the duration."""
    return (
        f'<div class="playhead"><div class="rail" style="height:{height}px">'
        f'<i style="left:{share:.3%}"></i></div></div>'
    )


def readout(moment: Moment, names: Sequence[str], duration: float) -> str:
    """Time, and for each arm what it feels and how stiff it is."""
    told = "".join(_arm(name, arm, len(names) > 1) for name, arm in zip(names, moment.arms, strict=True))
    clock = f'<span class="time"><b>{moment.time:.2f}</b> / {duration:.2f} s</span>'
    return f'<div class="readout">{clock}{told}</div>'


def key(what: str, unit: str, colors: Mapping[str, str]) -> str:
    """What a plot shows, for the gutter beside it."""
    names = " ".join(f'<b style="color:{escape(color)}">{escape(name)}</b>' for name, color in colors.items())
    return f'<div class="plot"><span>{escape(what)}<br>[{unit}]<br>{names}</span></div>'


def _row(name: str, parts: Iterable[str]) -> str:
    return f'<div class="band"><span>{name}</span><div class="rail">{"".join(parts)}</div></div>'


def _contact(span: Span, duration: float) -> str:
    if span.label != CONTACT:
        return ""
    return _part("contact", span.start, span.end, duration, f"contact, {span.end - span.start:.2f} s")


def _mode(span: Span, duration: float) -> str:
    name = span.label.split()[0]  # of the class
    return _part(name, span.start, span.end, duration, f"{span.label}, {span.end - span.start:.2f} s")


def _mark(mark: Mark, duration: float) -> str:
    who = f"{mark.arm}: " if mark.arm else ""
    return _part(mark.kind, mark.start, mark.end, duration, f"{mark.start:.2f} s {who}{mark.text}")


def _part(kind: str, start: float, end: float, duration: float, title: str) -> str:
    left = 100.0 * start / max(duration, 1e-9)
    width = max(100.0 * (end - start) / max(duration, 1e-9), LEAST_WIDTH)
    return (
        f'<i class="{escape(kind)}" style="left:{left:.2f}%;width:{width:.2f}%" title="{escape(title)}"></i>'
    )


def _arm(name: str, arm: ArmMoment, is_named: bool) -> str:
    force, torque = np.linalg.norm(arm.wrench.force), np.linalg.norm(arm.wrench.torque)
    stiffness = "" if math.isnan(arm.stiffness) else f" {arm.stiffness:.0f} N/m"
    words = [
        f"<b>{escape(name)}</b>" if is_named else "",
        f'<span class="{escape(arm.phase)}">{escape(arm.phase)}</span>',
        f"<span><b>{force:.1f}</b> N</span>",
        f"<span><b>{torque:.2f}</b> N·m</span>",
        f'<span class="chip {escape(arm.mode)}">{escape(arm.mode)}{stiffness}</span>',
        f"<span>gripper {arm.gripper:.0%}</span>",
        f'<span class="{arm.level}">{escape(arm.why)}</span>' if arm.why else "",
    ]
    return f'<span class="arm">{"".join(words)}</span>'
