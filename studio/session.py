"""The slow loop: observe, act, apply, tell. One thread owns the robot.

Every 10 ms the session asks an agent for an action, lets the robot apply it for one control period (five
fast steps inside the robot) and tells the subscribers what was observed, requested and applied. With
`realtime=True` it sleeps to absolute deadlines; a late tick slips the schedule and is counted, ticks are
never bursted to catch up. With `realtime=False` it runs as fast as it computes, with the same results to
the bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from controller.types import Action, Applied, Array, Observation, Snapshot, Step

if TYPE_CHECKING:
    from studio.tasks import Progress

CONTROL_PERIOD = 0.01  # [s] of one tick
IMAGE_EVERY = 5  # ticks between images and task states: 20 Hz
SNAPSHOT_EVERY = 100  # ticks between full simulator states: 1 Hz
LATE = 0.002  # [s] a tick that starts later than this after its deadline counts as late


class Robot(Protocol):
    """Arms and the world they stand in, real or simulated."""

    def observe(self) -> Observation:
        """The state now, with the newest images."""

    def apply(self, action: Action) -> Applied:
        """Command one control period; return the action after limits."""

    def hold(self) -> None:
        """Freeze every arm where it is commanded. Safe at any time, also twice."""

    def task_state(self) -> Mapping[str, Array]:
        """Board grid, object poses and the like, by name."""

    def digest(self) -> bytes:
        """Hash of everything in `save`; empty where a robot cannot be saved."""

    def save(self) -> Snapshot | None:
        """Everything that decides the future, or None for a robot that cannot be restored."""

    def progress(self) -> Progress:
        """How far the task is, and whether it counts as done in the present state."""


class Agent(Protocol):
    """A hand, a script, a recorded episode or a policy."""

    def reset(self, observation: Observation) -> None:
        """Called once before the first `act` of a run."""

    def act(self, observation: Observation) -> Action | None:
        """The next action, or None when finished."""


class Subscriber(Protocol):
    """Told of every step of a take, in order, on the session's thread: must not block."""

    def on_step(self, step: Step) -> None: ...


@dataclass(frozen=True, slots=True)
class Ending:
    """How a run ended."""

    reason: Literal["finished", "time limit", "success"]
    progress: Progress
    seconds: float  # of the run, in the robot's time


class Session:
    """Lets agents drive one robot. Everything runs on the thread that calls."""

    def __init__(self, robot: Robot, *, realtime: bool = False) -> None:
        self.robot = robot
        self.clock = Clock(CONTROL_PERIOD) if realtime else None

    def run(
        self,
        agent: Agent,
        subscribers: Sequence[Subscriber] = (),
        *,
        time_limit: float,
        stop_on_success: bool = False,
    ) -> Ending:
        """Let `agent` drive until it is finished or `time_limit` [s] have passed; then the robot holds."""
        observation = self.robot.observe()
        start = observation.time
        agent.reset(observation)
        reason: Literal["finished", "time limit", "success"] = "time limit"
        try:
            for tick in range(round(time_limit / CONTROL_PERIOD)):
                if not self.tick(tick, agent, subscribers):
                    reason = "finished"
                    break
                if stop_on_success and self.robot.progress().success:
                    reason = "success"
                    break
                if self.clock:
                    self.clock.wait()
        finally:
            self.robot.hold()
        return Ending(reason, self.robot.progress(), self.robot.observe().time - start)

    def tick(self, tick: int, agent: Agent, subscribers: Sequence[Subscriber] = ()) -> bool:
        """One control period, the `tick`-th of a take; False where the agent is finished.

        Snapshots, task states and digests are only taken where someone listens.
        """
        robot = self.robot
        observation = robot.observe()
        requested = agent.act(observation)
        if requested is None:
            return False
        if not subscribers:
            robot.apply(requested)
            return True
        task_state = robot.task_state() if tick % IMAGE_EVERY == 0 else None
        snapshot = robot.save() if tick % SNAPSHOT_EVERY == 0 else None
        applied = robot.apply(requested)
        step = Step(observation, requested, applied, robot.digest(), task_state, snapshot)
        for subscriber in subscribers:
            subscriber.on_step(step)
        return True


@dataclass(slots=True)
class Pace:
    """How well the loop kept time."""

    ticks: int = 0
    late: int = 0
    worst: float = 0.0  # [s] longest delay after a deadline

    @property
    def late_share(self) -> float:
        return self.late / self.ticks if self.ticks else 0.0


class Clock:
    """Absolute deadlines of `period` seconds. A late tick moves the schedule, so that no burst follows."""

    def __init__(
        self,
        period: float,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.pace = Pace()
        self._period, self._now, self._sleep = period, now, sleep
        self._deadline = now()

    def wait(self) -> None:
        """Sleep until the next deadline and count how late it was met."""
        self._deadline += self._period
        ahead = self._deadline - self._now()
        if ahead > 0:
            self._sleep(ahead)
        delay = self._now() - self._deadline
        self.pace.ticks += 1
        self.pace.worst = max(self.pace.worst, delay)
        if delay > LATE:
            self.pace.late += 1
            self._deadline += delay
