"""What a person at the page can do. Every button and every key ends here; nothing here waits."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal, get_args

from controller.types import StiffnessMode
from studio.messages import (
    Collect,
    DiscardTake,
    Drive,
    EndTake,
    Engage,
    Judgement,
    Mirror,
    Notice,
    NoticeKind,
    Nudge,
    Release,
    Reset,
    RestartCameras,
    SetGripper,
    SetMode,
    StartTake,
    Status,
    TakeRestored,
    TakeStatus,
    TakeTrashed,
)
from studio.pilot import Playing, Tried
from studio.ui.remote import Remote

Choice = Literal["gizmo", "keyboard", "script", "policy", "nobody"]
CHOICES: tuple[Choice, ...] = get_args(Choice)
SIMULTANEOUS = 0.7  # [s] after a start within which a press cannot mean stop


class Desk:
    """Posts commands, knowing the newest status. Shared by everybody who looks at the page."""

    def __init__(
        self,
        remote: Remote,
        delete: Callable[[str], object],
        restore: Callable[[str], object],
        operator: Callable[[], str] = str,
        now: Callable[[], float] = time.monotonic,
        runs_of: Callable[[str], list[str]] = lambda task: [],
        ways_to_play: Callable[[str], list[Tried]] = lambda run: [],
    ) -> None:
        """`delete` moves the take of an id to the trash, `restore` brings it back.

        `operator` tells the name of the person who drives, `runs_of` the runs that have learned a task,
        `ways_to_play` how the chunks of a run may be played, the best first.
        """
        self._remote, self._delete, self._restore = remote, delete, restore
        self._operator = operator
        self.runs_of, self.ways_to_play = runs_of, ways_to_play
        self.policy, self.playing = "", Playing()  # the run that drives where the choice is "policy", and how
        self.countdown = 3.0  # [s] before recording
        self.with_sounds = True
        self.choice: Choice = "nobody"  # who was asked to drive last
        self.keyboard_arm = 0
        self._started = -SIMULTANEOUS  # [s] monotonic time of the last start
        self._now = now
        self._is_deleted: dict[str, bool] = {}  # of takes, where it differs from what the session knows

    @property
    def status(self) -> Status | None:
        return self._remote.status.get()[0]

    @property
    def operator(self) -> str:
        """Name of the person who drives; empty where they gave none."""
        return self._operator()

    # Scene

    def reset(self, seed: int, task: str | None = None) -> None:
        self._remote.post(Reset(seed=seed, task=task))

    def reset_again(self) -> None:
        if status := self.status:
            self.reset(status.seed)

    def next_seed(self) -> None:
        if status := self.status:
            self.reset(status.seed + 1)

    # Driving

    def drive(self, choice: Choice) -> None:
        self.choice = choice
        self._remote.post(
            Drive(
                driver="operator" if choice in ("gizmo", "keyboard") else choice,  # type: ignore[arg-type]
                operator=self.operator,
                policy=self.policy if choice == "policy" else "",
                execution=self.playing.execution,
                replan_every=self.playing.replan_every,
            )
        )

    def toggle_engaged(self, arm: int) -> None:
        if status := self.status:
            self._remote.post(Engage(arm=arm, engaged=not status.arms[arm].engaged))

    def release(self) -> None:
        """Stop pressing, all arms."""
        self._remote.post(Release())

    def set_mode(self, arm: int, mode: str) -> None:
        self._remote.post(SetMode(arm=arm, mode=StiffnessMode(mode).value))

    def switch_mode(self, arm: int) -> None:
        """To the other of the arm's two modes."""
        if status := self.status:
            one, other = status.arms[arm].modes
            self.set_mode(arm, other if status.arms[arm].mode == one else one)

    def set_gripper(self, arm: int, opening: float) -> None:
        self._remote.post(SetGripper(arm=arm, opening=opening))

    def toggle_gripper(self, arm: int) -> None:
        if status := self.status:
            self.set_gripper(arm, 0.0 if status.arms[arm].opening > 0.5 else 1.0)

    def nudge(
        self, translation: tuple[float, float, float], rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Move the keyboard's arm: base axes [m], tool axes [rad]."""
        self._remote.post(Nudge(arm=self.keyboard_arm, translation=translation, rotation=rotation))

    def toggle_mirror(self) -> None:
        """Whether what moves one of two arms moves the other like in a mirror."""
        if status := self.status:
            self._remote.post(Mirror(mirrored=not status.mirrored))

    def switch_keyboard_arm(self) -> None:
        if status := self.status:
            self.keyboard_arm = (self.keyboard_arm + 1) % len(status.arms)

    # Takes

    def toggle_take(self) -> None:
        """Start where nothing runs, else stop and keep; during the countdown, cancel.

        Somebody who presses just after somebody else saw "Start" too; the session then tells why not.
        """
        if status := self.status:
            if status.phase == "idle" or self._now() < self._started + SIMULTANEOUS:
                self._start(status)
            else:
                self.keep()

    def keep(self, judgement: Judgement | None = None) -> None:
        """Stop and keep. Without a judgement the task's own success test counts."""
        self._remote.post(EndTake(judgement=judgement))

    def discard(self) -> None:
        """The running take, or else the last one."""
        status = self.status
        if status is None or status.phase != "idle":
            self._remote.post(DiscardTake())
        elif (take := status.last_take) and not self.is_discarded(take):
            if self._does(self._delete, take.episode_id, "deleted"):
                self.mark(take.episode_id, is_deleted=True)
                self._notice("take discarded", f"In the trash: {take.episode_id}.")
        else:
            self.tell("No take to discard.")

    def undo_discard(self) -> None:
        """Bring the last take back from the trash."""
        take = self.status and self.status.last_take
        if not take or not self.is_discarded(take):
            self.tell("Nothing to undo: the last take is not in the trash.")
        elif self._does(self._restore, take.episode_id, "restored"):
            self.mark(take.episode_id, is_deleted=False)
            self._notice("take kept", f"Back again: {take.episode_id}.")

    def is_discarded(self, take: TakeStatus) -> bool:
        """Whether it lies in the trash now."""
        return self._is_deleted.get(take.episode_id, take.discarded)

    def mark(self, episode_id: str, *, is_deleted: bool) -> None:
        """A take was moved to the trash, or brought back; the session hears of it."""
        self._is_deleted[episode_id] = is_deleted
        kind = TakeTrashed if is_deleted else TakeRestored
        self._remote.post(kind(episode_id=episode_id))

    def collect(self, count: int, seed: int) -> None:
        """Takes of consecutive seeds until `count` are kept."""
        status = self.status
        if status and status.driver == "nobody" and self.choice in ("nobody", "script", "policy"):
            self.drive("gizmo" if self.choice == "nobody" else self.choice)
        countdown = 0.0 if self.choice == "script" else self.countdown
        self._remote.post(Collect(count=count, seed=seed, countdown=countdown, operator=self.operator))

    def stop_collecting(self) -> None:
        self._remote.post(Collect(count=0))

    # Processes

    def restart_cameras(self) -> None:
        self._remote.post(RestartCameras())

    def tell(self, text: str) -> None:
        """Tell everybody that something did not work."""
        self._notice("error", text)

    def _notice(self, kind: NoticeKind, text: str) -> None:
        self._remote.notices.post(Notice(kind=kind, text=text))

    def _does(self, act: Callable[[str], object], episode_id: str, done: str) -> bool:
        """Whether the take could be `done`; else everybody hears why not."""
        try:
            act(episode_id)
        except (KeyError, OSError, ValueError) as error:
            self.tell(f"The take could not be {done}: {error.args[0] if error.args else error}")
            return False
        return True

    def _start(self, status: Status) -> None:
        self._started = self._now()
        is_script = self.choice == "script"
        # A script is recorded from its first motion; a person gets time to take the gizmo.
        self._remote.post(StartTake(countdown=0.0 if is_script else self.countdown, operator=self.operator))
        if is_script and status.driver != "script":
            self.drive("script")
        elif status.driver == "nobody" and not is_script:
            self.drive("gizmo" if self.choice == "nobody" else self.choice)
