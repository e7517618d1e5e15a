"""The takes of a live session: the countdown, the one that runs, the last one, and collecting many."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from studio.episode import Header, Outcome
from studio.messages import Driver, Judgement, NoticeKind, Phase, TakeStatus
from studio.recorder import Recorder, Take
from studio.session import CONTROL_PERIOD, Subscriber
from studio.tasks import HELD_SUCCESS, Progress

BETWEEN_TAKES = 1.5  # [s] that a kept take is shown before the next reset, while collecting


class Tell(Protocol):
    def __call__(self, kind: NoticeKind, text: str, take: TakeStatus | None = None) -> None:
        """Let the operator hear something."""


class Takes:
    """Belongs to the session's thread. `advance` is called once a tick."""

    def __init__(self, recorder: Recorder, make_header: Callable[[], Header], tell: Tell) -> None:
        """`make_header` is called when a take begins: that is the take's time zero."""
        self._recorder, self._make_header, self._tell = recorder, make_header, tell
        self._take: Take | None = None
        self._ticks = 0
        self._countdown: float | None = None  # [s] left
        self._success_since: float | None = None
        self.last: TakeStatus | None = None
        self.collection = Collection()

    @property
    def phase(self) -> Phase:
        if self._take:
            return "recording"
        return "idle" if self._countdown is None else "countdown"

    @property
    def countdown(self) -> float:
        """[s] left until recording."""
        return self._countdown or 0.0

    @property
    def seconds(self) -> float:
        """[s] that the running take has lasted."""
        return self._ticks * CONTROL_PERIOD if self._take else 0.0

    @property
    def running_id(self) -> str:
        """Of the running take; empty without one."""
        return self._take.header.episode_id if self._take else ""

    @property
    def tick(self) -> int | None:
        """Number of the running take's next tick."""
        return self._ticks if self._take else None

    @property
    def subscribers(self) -> list[Subscriber]:
        return [self._take] if self._take else []

    def count_tick(self) -> None:
        """A tick of the running take, if there is one, was recorded."""
        self._ticks += 1

    def add_event(self, kind: str, text: str) -> None:
        """Note something in the running take, if there is one."""
        if self._take:
            self._take.add_event(kind, text)

    def start(self, countdown: float) -> None:
        """Record after `countdown` [s]."""
        if self.phase != "idle":
            raise ValueError("A take is running already.")
        self._countdown = max(0.0, countdown)
        if countdown > 0:
            self._tell("countdown", f"Recording in {countdown:.0f} s.")

    def stop(self, judgement: Judgement | None, progress: Progress) -> None:
        """Keep the running take, or call off a countdown."""
        if self.phase == "countdown":
            self.cancel_countdown()
        elif self._take:
            self.keep(judgement, "stopped by the operator", progress)
        else:
            raise ValueError("No take is running.")

    def cancel_countdown(self) -> None:
        self._countdown = None
        self.collection.stop()

    def keep(self, judgement: Judgement | None, reason: str, progress: Progress) -> None:
        """End the running take, if there is one. Without a judgement the task's success test counts."""
        if self._take is None:
            return
        take, self._take = self._take, None
        success = {"success": True, "failure": False, "unmarked": None, None: progress.success}[judgement]
        path = take.finish(Outcome(success, f"{reason}: {progress.phase}", progress.value))
        outcome: Judgement = "unmarked" if success is None else "success" if success else "failure"
        self.last = self._status_of(take, str(path), outcome, discarded=False)
        self.collection.kept(take.header.episode_id, take.header.seed, time.monotonic())
        self._tell("take kept", f"Kept as {outcome}: {take.header.episode_id}.", self.last)

    def discard(self) -> None:
        """Move the running take to the trash, or call off a countdown."""
        if self._take:
            take, self._take = self._take, None
            self.last = self._status_of(take, str(take.discard()), "unmarked", discarded=True)
            self.collection.again(time.monotonic())
            self._tell("take discarded", f"In the trash: {take.header.episode_id}.", self.last)
        elif self.phase == "countdown":
            self.cancel_countdown()
        else:
            raise ValueError("No take is running.")

    def advance(self, progress: Progress, driver: Driver) -> None:
        """What happens by itself: the countdown ends, the disk fails, collecting notices success."""
        if self._countdown is not None:
            self._countdown -= CONTROL_PERIOD
            if self._countdown <= 0:
                self._countdown = None
                self._begin()
        elif self._take and (error := self._take.error):
            self.keep(None, error, progress)
            self.collection.stop()
            self._tell("error", error)
        elif self._take and self.collection.is_running:
            self._notice_success(progress, driver)

    def due_seed(self) -> int | None:
        """The seed that collecting wants to see next, when it is time for it."""
        collection = self.collection
        is_due = collection.is_running and self.phase == "idle" and collection.is_due(time.monotonic())
        return collection.seed if is_due else None

    def _begin(self) -> None:
        try:
            self._take = self._recorder.start(self._make_header())
        except OSError as error:
            self.collection.stop()
            self._tell("error", str(error))
            return
        self._ticks, self._success_since = 0, None
        self._tell("recording", f"Recording {self.running_id}.")

    def _notice_success(self, progress: Progress, driver: Driver) -> None:
        """End the take when success has held; a script is left to finish its motion."""
        now = time.monotonic()
        if not progress.success:
            self._success_since = None
        elif self._success_since is None:
            self._success_since = now
            self._tell("success", "Done.")
        elif now - self._success_since >= HELD_SUCCESS and driver != "script":
            self.keep(None, "success", progress)

    def _status_of(self, take: Take, path: str, outcome: Judgement, discarded: bool) -> TakeStatus:
        return TakeStatus(
            episode_id=take.header.episode_id,
            path=path,
            seconds=self._ticks * CONTROL_PERIOD,
            outcome=outcome,
            discarded=discarded,
        )


@dataclass(slots=True)
class Collection:
    """How far collecting is: which seed comes next, and when."""

    count: int = 0  # takes to keep; 0 while not collecting
    countdown: float = 3.0  # [s]
    _next: int = 0  # the lowest seed that was not on the stage yet
    _seeds: dict[str, int | None] = field(default_factory=dict)  # of the kept takes, by their ids
    _again: dict[str, int | None] = field(default_factory=dict)  # of those that were thrown away since
    _due: float = 0.0  # [s] monotonic time of the next reset

    @property
    def is_running(self) -> bool:
        return self.count > 0

    @property
    def done(self) -> int:
        """How many takes are kept."""
        return len(self._seeds)

    @property
    def seed(self) -> int:
        """Of the next take: first those whose takes were thrown away."""
        return min((seed for seed in self._again.values() if seed is not None), default=self._next)

    def start(self, count: int, seed: int, countdown: float) -> None:
        self.count, self.countdown, self._next, self._due = count, countdown, seed, 0.0
        self._seeds, self._again = {}, {}

    def stop(self) -> None:
        self.count = 0

    def kept(self, episode_id: str, seed: int | None, now: float) -> None:
        """A take of `seed` was kept: on to the next one, or done."""
        if not self.is_running:
            return
        self._seeds[episode_id] = seed
        if seed == self._next:
            self._next += 1
        repeated = next((old for old, again in self._again.items() if again == seed), None)
        if repeated is not None:
            del self._again[repeated]
        self._due = now + BETWEEN_TAKES
        if self.done >= self.count:
            self.stop()

    def again(self, now: float) -> None:
        """A take was discarded: the same seed once more."""
        self._due = now + BETWEEN_TAKES

    def trashed(self, episode_id: str) -> None:
        """A kept take was thrown away: it does not count, and its seed comes once more."""
        if self.is_running and episode_id in self._seeds:
            self._again[episode_id] = self._seeds.pop(episode_id)

    def restored(self, episode_id: str) -> None:
        """It is back, before its seed came once more."""
        if self.is_running and episode_id in self._again:
            self._seeds[episode_id] = self._again.pop(episode_id)

    def is_due(self, now: float) -> bool:
        return now >= self._due
