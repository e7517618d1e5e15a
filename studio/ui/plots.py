"""Live forces: a gauge of the contact force and plots of the last seconds, per arm."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from html import escape

import numpy as np
import viser
from viser import uplot

from controller.servo import ServoConfig
from controller.types import Array
from studio.messages import ArmFrame, Level

WINDOW = 10.0  # [s] shown
SAMPLE = WINDOW / 240  # [s] between points; viser sends all of them each time
PERIOD = 0.1  # [s] between updates of the plots
PEAK = 2.0  # [s] that the gauge remembers its peak
FLAT = 0.02  # [N or N·m] a plot that has changed by less stays as it is: at rest it costs nothing
MAX_FORCE = ServoConfig().max_force  # [N] the servo lets nobody press harder

AXES = ("x", "y", "z")
AXIS_COLORS = ("#f0605a", "#5fc46e", "#5b9dff")
COLOR_OF_LEVEL = {"ok": "calm", "limited": "limited", "refused": "refused"}


class WrenchPanel:
    """One arm's gauge and plots, drawn into the container that is open when it is made."""

    def __init__(
        self, gui: viser.GuiApi, name: str, *, heights: tuple[int, int], now: Callable[[], float]
    ) -> None:
        """`heights` of the force and torque plots [px]; 0 leaves a plot out."""
        self._name, self._now = name, now
        self._gauge = gui.add_html("")
        self._plots = []
        for title, height, least in (("Force", heights[0], 5.0), ("Torque", heights[1], 0.5)):
            if height:
                gui.add_html(_legend(title, "N" if title == "Force" else "N·m"))
                self._plots.append(_Plot(gui, height, least))
        self._samples: deque[tuple[float, tuple[float, ...]]] = deque()
        self._forces: deque[tuple[float, float]] = deque()  # for the peak

    def add(self, arm: ArmFrame) -> None:
        """Take a frame; cheap."""
        now = self._now()
        force = float(np.linalg.norm(arm.wrench[:3]))
        self._forces.append((now, force))
        while self._forces[0][0] < now - PEAK:
            self._forces.popleft()
        if not self._samples or now - self._samples[-1][0] >= SAMPLE:
            self._samples.append((now, arm.wrench))
        while self._samples[0][0] < now - WINDOW:
            self._samples.popleft()

    def show(self, level: Level) -> None:
        """Draw what was added."""
        if not self._samples:
            return
        peak = max(force for _, force in self._forces)
        self._gauge.content = gauge(self._name, self._forces[-1][1], peak, level)
        times = np.array([when for when, _ in self._samples]) - self._now()
        wrenches = np.array([wrench for _, wrench in self._samples])
        for plot, part in zip(self._plots, (slice(0, 3), slice(3, 6)), strict=False):
            plot.show(times, wrenches[:, part])


class _Plot:
    """Three components over the last seconds."""

    def __init__(self, gui: viser.GuiApi, height: int, least: float) -> None:
        """Its scale never shows less than ± `least`."""
        start = (np.array([-WINDOW, 0.0]), *(np.zeros(2) for _ in AXES))
        self._drawn = np.zeros((2, 3))
        self._handle = gui.add_uplot(
            start,
            (
                uplot.Series(),
                *(
                    uplot.Series(label=axis, stroke=color, width=1.5, points={"show": False})
                    for axis, color in zip(AXES, AXIS_COLORS, strict=True)
                ),
            ),
            scales={
                "x": uplot.Scale(time=False, range=(-WINDOW, 0.0)),
                "y": uplot.Scale(
                    range={
                        "min": {"soft": -least, "mode": 1, "pad": 0.1},
                        "max": {"soft": least, "mode": 1, "pad": 0.1},
                    }
                ),
            },
            axes=(
                uplot.Axis(size=26, space=60, ticks={"size": 4}),
                uplot.Axis(size=38, space=26, ticks={"size": 4}),
            ),
            legend=uplot.Legend(show=False),
            cursor=uplot.Cursor(show=False),
            height=height,
            padding=(6, 10, 0, 0),
        )

    def show(self, times: Array, values: Array) -> None:
        """`times` (n,) [s] up to now, `values` (n, 3)."""
        if np.ptp(values, axis=0).max() < FLAT and np.abs(values[-1] - self._drawn).max() < FLAT:
            return
        self._drawn = values
        self._handle.data = (times, *values.T.copy())


class LivePlots:
    """The panels of all arms, updated ten times a second."""

    def __init__(
        self, gui: viser.GuiApi, names: tuple[str, ...], now: Callable[[], float] = time.monotonic
    ) -> None:
        heights = (150, 120) if len(names) == 1 else (120, 0)
        self._now, self._due = now, 0.0
        self._panels = [WrenchPanel(gui, name, heights=heights, now=now) for name in names]

    def update(self, arms: tuple[ArmFrame, ...]) -> None:
        for panel, arm in zip(self._panels, arms, strict=True):
            panel.add(arm)
        if self._now() >= self._due:
            self._due = self._now() + PERIOD
            for panel, arm in zip(self._panels, arms, strict=True):
                panel.show(arm.level)


def gauge(name: str, newtons: float, peak: float, level: Level) -> str:
    """How hard an arm presses, in words, colour and length."""
    color = COLOR_OF_LEVEL[level] if level != "ok" or newtons < 0.8 * MAX_FORCE else "limited"
    share = min(newtons / MAX_FORCE, 1.0)
    mark = min(peak / MAX_FORCE, 1.0)
    return (
        f'<div class="gauge"><div class="row"><span>Contact force, {escape(name)} arm</span>'
        f'<span><span class="newtons">{newtons:.1f}</span> N</span></div>'
        f'<div class="track {color}"><div class="fill" style="width:{share:.1%}"></div>'
        f'<div class="peak" style="left:calc({mark:.1%} - 2px)"></div></div>'
        f'<div class="row dim"><span>peak {peak:.1f} N</span><span>limit {MAX_FORCE:.0f} N</span></div></div>'
    )


def _legend(title: str, unit: str) -> str:
    colors = "".join(
        f'<span><i style="background:{color}"></i>{axis}</span>'
        for axis, color in zip(AXES, AXIS_COLORS, strict=True)
    )
    return f'<div class="legend"><span>{title} [{unit}]</span>{colors}</div>'
