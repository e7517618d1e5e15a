"""Which time of a take is to be shown."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

FRAME = 1 / 25  # [s] of real time between two drawings while playing
SETTLE = 0.3  # [s] after the last drawing comes one more: the board's picture is sent only so often
APART = 0.1  # [s] by which two clocks may differ that go on together


class Playback:
    """Which time of a take is to be shown. Any thread may command it, one asks what to draw."""

    def __init__(self, duration: float, now: Callable[[], float] = time.monotonic) -> None:
        self.duration = duration
        self.time = 0.0  # [s] in the take
        self.speed = 1.0
        self.is_playing = False
        self._now = now
        self._changed = threading.Condition()
        self._is_closed = False
        self._due: float | None = now()  # when to draw next; None: when something changes
        self._is_settled = False
        self._drawn = now()

    def play(self) -> None:
        """Go on, at the end from the start."""
        with self._changed:
            if self.time >= self.duration:
                self.time = 0.0
            self.is_playing = True
            self._drawn = self._now()
            self._draw_now()

    def pause(self) -> None:
        with self._changed:
            self.is_playing = False
            self._draw_now()

    def toggle(self) -> None:
        """Play or pause, whichever it is not doing."""
        with self._changed:
            (self.pause if self.is_playing else self.play)()

    def scrub(self, time: float) -> None:
        """Go to a time and stay there."""
        self.move(lambda _: time)

    def move(self, next_time: Callable[[float], float]) -> None:
        """Go to what follows from the time shown, and stay there; of two moves at once none is lost."""
        with self._changed:
            self.is_playing = False
            self.time = min(max(next_time(self.time), 0.0), self.duration)
            self._draw_now()

    def follow(self, time: float, speed: float) -> None:
        """Somebody else's clock: be where it is and go on at its speed; 0 stands still."""
        with self._changed:
            is_going_on = bool(speed) and self.is_playing and speed == self.speed
            now = self.time + self.speed * (self._now() - self._drawn)
            if is_going_on and abs(now - time) < APART:
                return
            self.time = min(max(time, 0.0), self.duration)
            self.is_playing, self.speed = bool(speed), speed or self.speed
            self._drawn = self._now()
            self._draw_now()

    def set_speed(self, speed: float) -> None:
        with self._changed:
            self.speed = speed
            self._draw_now()

    def close(self) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def wait(self) -> float | None:
        """Wait until there is something to draw; return its time [s], or None once closed."""
        with self._changed:
            while not self._is_closed:
                left = None if self._due is None else self._due - self._now()
                if left is not None and left <= 0.0:
                    self._advance()
                    return self.time
                self._changed.wait(left)
        return None

    def _advance(self) -> None:
        now = self._now()
        if self.is_playing:
            self.time = min(self.time + self.speed * (now - self._drawn), self.duration)
            self.is_playing = self.time < self.duration
        self._drawn = now
        if self.is_playing:
            self._due = now + FRAME
        else:
            self._due = None if self._is_settled else now + SETTLE
            self._is_settled = not self._is_settled

    def _draw_now(self) -> None:
        self._due, self._is_settled = self._now(), False
        self._changed.notify_all()
