"""The slow loop: observe, act, apply, tell. One thread owns the robot.

Every 10 ms the session asks an agent for an action, lets the robot apply it for one control period (five
fast steps inside the robot) and tells the subscribers what was observed, requested and applied. With
`realtime=True` it sleeps to absolute deadlines; a late tick slips the schedule and is counted, ticks are
never bursted to catch up. With `realtime=False` it runs as fast as it computes, with the same results to
the bit.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

from controller.types import Action, Applied, Array, InputTiming, Observation, Snapshot, Step

if TYPE_CHECKING:
    from studio.tasks import Progress

CONTROL_PERIOD = 0.01  # [s] of one tick
IMAGE_EVERY = 5  # ticks between images and task states: 20 Hz
SNAPSHOT_EVERY = 100  # ticks between full simulator states: 1 Hz
KEPT_TICKS = 6000  # ticks that the clock remembers: a minute
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
        self.inputs: Callable[[], tuple[InputTiming | None, ...]] = tuple  # of hands that drive, for takes

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
                if self.tick(agent, subscribers, tick if subscribers else None) is None:
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

    def tick(
        self, agent: Agent, subscribers: Sequence[Subscriber] = (), take_tick: int | None = None
    ) -> Step | None:
        """One control period; None where the agent is finished.

        `take_tick` counts the periods of a take from 0. Without one nobody keeps the step, and snapshots,
        task states and digests are left out.
        """
        robot = self.robot
        observation = robot.observe()
        requested = agent.act(observation)
        if requested is None:
            return None
        if take_tick is None:
            step = Step(observation, requested, robot.apply(requested), b"", None, None)
        else:
            task_state = robot.task_state() if take_tick % IMAGE_EVERY == 0 else None
            snapshot = robot.save() if take_tick % SNAPSHOT_EVERY == 0 else None
            applied = robot.apply(requested)
            late = self.clock.delay if self.clock else 0.0
            digest, inputs = robot.digest(), self.inputs()
            step = Step(observation, requested, applied, digest, task_state, snapshot, late, inputs)
        for subscriber in subscribers:
            subscriber.on_step(step)
        return step


@dataclass(frozen=True, slots=True)
class Pace:
    """How well the loop kept time, over the ticks it was asked about."""

    ticks: int
    late: int
    worst: float  # [s] longest delay after a deadline
    rate: float  # [Hz]

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
        self._period, self._now, self._sleep = period, now, sleep
        self._deadline = now()
        self._met: deque[tuple[float, float]] = deque(maxlen=KEPT_TICKS)  # (when [s], delay [s])
        self.delay = 0.0  # [s] with which the last deadline was met

    def wait(self) -> None:
        """Sleep until the next deadline and note how late it was met."""
        self._deadline += self._period
        ahead = self._deadline - self._now()
        if ahead > 0:
            self._sleep(ahead)
        now = self._now()
        self.delay = now - self._deadline
        self._met.append((now, self.delay))
        if self.delay > LATE:
            self._deadline = now

    def restart(self) -> None:
        """Begin a new schedule now, after a pause that was meant."""
        self._deadline = self._now()

    def pace(self, seconds: float = math.inf) -> Pace:
        """Over the last `seconds`, as far as they are remembered."""
        since = self._now() - seconds
        delays = [delay for when, delay in self._met if when >= since]
        if not delays:
            return Pace(0, 0, 0.0, 0.0)
        span = self._met[-1][0] - max(self._met[0][0], since)
        late = sum(delay > LATE for delay in delays)
        return Pace(len(delays), late, max(delays), (len(delays) - 1) / span if span > 0 else 0.0)
