"""The bar over the scene of a take under review: what is true now, playing, the timeline, plots under it."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
import viser
from viser import uplot

from controller.types import Array
from studio.cursor import Cursor, peaks, steps
from studio.ui import timeline
from studio.ui.playback import SETTLE, Playback
from studio.ui.plots import AXES, AXIS_COLORS
from studio.ui.teleop import set_value

COVERED = 0.47  # share of the scene's height that the bar hides, about
PLOT_HEIGHT, STIFFNESS_HEIGHT, TIMES_HEIGHT = 100, 74, 22  # [px]
GUTTER, MARGIN = 90, 62  # [px] left and right of every row of the bar; `web_assets/review.css` has them, too
POINTS = 400  # of a plot
SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0)
STIFF = 800.0  # [N/m] up to here the stiffness plot goes at least
LEAST = {"Force": 2.0, "Torque": 0.2}  # [N], [N·m] the other never shows less than this both ways
WHITE = "#e6e9ee"
STIFFNESS_COLORS = (WHITE, "#ffb84d")  # of the arms


class ReviewBar:
    """A panel of one client's. The review's thread shows, the client's callbacks command the playback."""

    def __init__(self, client: viser.ClientHandle, title: str, cursor: Cursor, playback: Playback) -> None:
        gui = client.gui
        self._cursor, self._playback = cursor, playback
        self._names = [arm.name for arm in cursor.arms]
        self._touched = 0.0  # [s] monotonic time at which a person last moved the slider
        self._panel = gui.add_panel()
        with self._panel.add_tab(title):
            self._readout = gui.add_html("")
            self._add_buttons(gui)
            self._add_slider(gui)
            gui.add_html(timeline.strip(cursor.arms, cursor.marks, cursor.duration))
            self._add_plots(gui)
            self._playhead = gui.add_html("")
        strip = timeline.height(cursor.arms, cursor.marks)
        self._height = strip + PLOT_HEIGHT + STIFFNESS_HEIGHT - TIMES_HEIGHT  # [px] of the playhead
        # `web_assets/review.js` puts it below the scene: only the browser knows how wide that is.
        self._panel.float(x=12, y=-12, width=600)

    def show(self, at: float) -> None:
        playback = self._playback
        self._readout.content = timeline.readout(self._cursor.at(at), self._names, self._cursor.duration)
        self._playhead.content = timeline.playhead(at / max(self._cursor.duration, 1e-9), self._height)
        self._play.label = "Pause" if playback.is_playing else "Play"
        self._speed.label = f"{playback.speed:g}×"
        if time.monotonic() - self._touched > SETTLE:  # never against a hand that drags
            set_value(self._slider, at)

    def remove(self) -> None:
        self._panel.remove()

    def _add_buttons(self, gui: viser.GuiApi) -> None:
        playback = self._playback
        # The mark of `web_assets/review.js`: these keys press the next three buttons.
        gui.add_html('<i class="r7" data-press="ArrowLeft Space ArrowRight"></i>')
        back = gui.add_button("‹ Step", color="dark")
        self._play = gui.add_button("Play", color="blue")
        on = gui.add_button("Step ›", color="dark")
        slower = gui.add_button("Slower", color="dark")
        self._speed = gui.add_button("1×", color="dark")
        faster = gui.add_button("Faster", color="dark")
        back.on_click(lambda _: self._step(-1))
        on.on_click(lambda _: self._step(1))
        self._play.on_click(lambda _: playback.toggle())
        slower.on_click(lambda _: playback.set_speed(_next_speed(playback.speed, -1)))
        faster.on_click(lambda _: playback.set_speed(_next_speed(playback.speed, 1)))
        self._speed.on_click(lambda _: playback.set_speed(1.0))
        self._choice = gui.add_dropdown("Plot", list(self._plottable()))
        self._choice.on_update(lambda _: self._plot())

    def _add_slider(self, gui: viser.GuiApi) -> None:
        gui.add_html('<i class="scrub"></i>')
        self._slider = gui.add_slider("Time [s]", 0.0, max(self._cursor.duration, 0.01), 0.01, 0.0)

        @self._slider.on_update
        def _(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client is not None:  # not our own `show`
                self._touched = time.monotonic()
                self._playback.scrub(self._slider.value)

    def _add_plots(self, gui: viser.GuiApi) -> None:
        self._key = gui.add_html("")
        series = dict(zip((*AXES, "norm"), (*AXIS_COLORS, WHITE), strict=True))
        self._chosen = self._add_plot(gui, self._curves(), series, PLOT_HEIGHT)
        arms = self._cursor.arms
        times, curves = arms[0].action_time, [arm.stiffness for arm in arms]
        kept = steps(*curves)
        kept = kept if len(kept) <= POINTS else peaks(curves[0], POINTS)
        stiffness = (times[kept], *(curve[kept] for curve in curves))
        series = dict(zip(self._names, STIFFNESS_COLORS, strict=False))
        gui.add_html(timeline.key("stiffness", "N/m", series if len(arms) > 1 else {}))
        most = max([STIFF, *(float(np.nanmax(curve, initial=0.0)) for curve in curves)])
        self._add_plot(gui, stiffness, series, STIFFNESS_HEIGHT, uplot.Scale(range=(0.0, 1.1 * most)))
        self._plot()

    def _add_plot(
        self,
        gui: viser.GuiApi,
        curves: tuple[Array, ...],
        series: Mapping[str, str],
        height: int,
        scale: uplot.Scale | None = None,
    ) -> viser.GuiUplotHandle:
        """`series` are names with colours; the plot with a `scale` is the lowest, with the times below."""
        is_lowest = scale is not None
        return gui.add_uplot(
            curves,
            (
                uplot.Series(),
                *(
                    uplot.Series(label=name, stroke=color, width=1.25, points={"show": False})
                    for name, color in series.items()
                ),
            ),
            scales={
                "x": self._times(),
                "y": scale or uplot.Scale(),
            },
            axes=(
                uplot.Axis(show=is_lowest, size=TIMES_HEIGHT, space=60, ticks={"size": 3}),
                uplot.Axis(size=GUTTER, space=22, ticks={"size": 4}),
            ),
            legend=uplot.Legend(show=False),
            cursor=uplot.Cursor(drag={"x": False, "y": False}),
            height=height,
            padding=(8, MARGIN, 0 if is_lowest else 4, 0),
        )

    def _times(self) -> uplot.Scale:
        return uplot.Scale(time=False, range=(0.0, max(self._cursor.duration, 0.01)))

    def _plottable(self) -> dict[str, tuple[int, slice]]:
        """What the upper plot can show: the arm and its part of the wrench."""
        parts = {"Force": slice(0, 3), "Torque": slice(3, 6)}
        several = len(self._names) > 1
        return {
            f"{what} {name}" if several else what: (index, part)
            for what, part in parts.items()
            for index, name in enumerate(self._names)
        }

    def _curves(self) -> tuple[Array, ...]:
        index, part = self._plottable()[self._choice.value]
        arm = self._cursor.arms[index]
        values = arm.wrench[:, part]
        norm = np.linalg.norm(values, axis=1)
        kept = peaks(norm, POINTS)
        return (arm.time[kept], *values[kept].T.copy(), norm[kept])

    def _plot(self) -> None:
        what = self._choice.value
        least = LEAST[what.split()[0]]
        soft = {"mode": 1, "pad": 0.1}
        y = uplot.Scale(range={"min": {"soft": -least, **soft}, "max": {"soft": least, **soft}})
        self._chosen.scales = {"x": self._times(), "y": y}
        self._chosen.data = self._curves()
        colors = dict(zip(("x", "y", "z", "norm"), (*AXIS_COLORS, WHITE), strict=True))
        self._key.content = timeline.key(what, "N" if what.startswith("Force") else "N·m", colors)

    def _step(self, steps: int) -> None:
        self._playback.move(lambda at: self._cursor.stepped(at, steps))


def _next_speed(speed: float, steps: int) -> float:
    index = SPEEDS.index(speed) + steps
    return SPEEDS[min(max(index, 0), len(SPEEDS) - 1)]
