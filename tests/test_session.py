"""The slow loop: who is told what and when, and that the robot is held whatever happens."""

from __future__ import annotations

import numpy as np
import pytest
from agents import STAY, Listener, Script

from controller.types import (
    ARM_ROW_WIDTH,
    Action,
    Applied,
    ArmState,
    Observation,
    Pose,
    Snapshot,
    Step,
    Wrench,
)
from studio.inputs.scripted import ScriptedAgent
from studio.session import CONTROL_PERIOD, LATE, Clock, Session
from studio.tasks import Progress
from studio.twin import Twin


class Robot:
    """One arm that never moves, and succeeds after `patience` periods."""

    def __init__(self, patience: int = 10**6) -> None:
        self.periods, self.held, self.patience = 0, 0, patience

    def observe(self) -> Observation:
        time = self.periods * CONTROL_PERIOD
        arm = ArmState(
            time, np.zeros(6), np.zeros(6), np.zeros(6), Pose.identity(), Wrench.from_vector(np.zeros(6)), 0.0
        )
        return Observation(time, (arm,), {})

    def apply(self, action: Action) -> Applied:
        self.periods += 1
        return Applied(action, (), np.zeros((1, 5, ARM_ROW_WIDTH)))

    def hold(self) -> None:
        self.held += 1

    def task_state(self) -> dict[str, np.ndarray]:
        return {"periods": np.array([self.periods])}

    def digest(self) -> bytes:
        return self.periods.to_bytes(2, "big")

    def save(self) -> Snapshot:
        return Snapshot(self.task_state())

    def progress(self) -> Progress:
        return Progress(0.0, self.periods >= self.patience, "waiting")


def test_the_robot_is_held_when_an_agent_raises() -> None:
    robot, listener = Robot(), Listener()
    with pytest.raises(ZeroDivisionError):
        Session(robot).run(Script([STAY, STAY, ZeroDivisionError("a bug")]), [listener], time_limit=1.0)
    assert robot.held == 1
    assert len(listener.steps) == 2


def test_the_robot_is_held_when_a_subscriber_raises() -> None:
    class Broken:
        def on_step(self, step: Step) -> None:
            raise OSError("disk")

    robot = Robot()
    with pytest.raises(OSError, match="disk"):
        Session(robot).run(Script([STAY]), [Broken()], time_limit=1.0)
    assert robot.held == 1


def test_a_run_ends_with_its_agent_its_time_or_its_success() -> None:
    def ending(robot: Robot, **options: bool) -> tuple[str, float, int]:
        end = Session(robot).run(Script([STAY] * 30), time_limit=0.2, **options)
        return end.reason, round(end.seconds, 9), robot.held

    assert Session(Robot()).run(Script([STAY] * 7), time_limit=0.2).reason == "finished"
    assert ending(Robot()) == ("time limit", 0.2, 1)
    assert ending(Robot(patience=5), stop_on_success=True) == ("success", 0.05, 1)
    assert ending(Robot(patience=5)) == ("time limit", 0.2, 1)


def test_subscribers_are_told_every_step_in_order_with_states_at_their_rates() -> None:
    first, second = Listener(), Listener()
    Session(Robot()).run(Script([STAY] * 250), [first, second], time_limit=9.0)
    assert first.steps == second.steps
    steps = first.steps
    assert [int.from_bytes(step.digest) for step in steps] == list(range(1, 251))  # after each period
    for every, states in (
        (5, [step.task_state for step in steps]),
        (100, [step.snapshot and step.snapshot.arrays for step in steps]),
    ):
        given = {tick: int(state["periods"][0]) for tick, state in enumerate(states) if state is not None}
        assert given == {tick: tick for tick in range(0, 250, every)}  # the states before the period


def test_without_a_take_states_are_left_out() -> None:
    robot, agent = Robot(), Script([STAY])
    agent.reset(robot.observe())
    step = Session(robot).tick(agent)
    assert step is not None
    assert (step.digest, step.task_state, step.snapshot) == (b"", None, None)


class FakeTime:
    """A clock that only moves when somebody sleeps or works."""

    def __init__(self) -> None:
        self.now, self.slept = 100.0, list[float]()

    def read(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds

    def clock(self) -> Clock:
        return Clock(CONTROL_PERIOD, self.read, self.sleep)


def test_a_loop_in_time_meets_absolute_deadlines() -> None:
    time = FakeTime()
    clock = time.clock()
    for work in (0.001, 0.009, 0.004):
        time.now += work
        clock.wait()
    assert time.now == pytest.approx(100.03)  # not 100.03 + what the work took
    assert time.slept == pytest.approx([0.009, 0.001, 0.006])
    assert clock.pace().late == 0


def test_a_late_tick_slips_the_schedule_and_is_not_made_up_for() -> None:
    time = FakeTime()
    clock = time.clock()
    starts = []
    for work in (0.001, 0.055, 0.001, 0.001, 0.001):
        time.now += work
        clock.wait()
        starts.append(time.now)
    gaps = np.diff(starts)
    assert gaps == pytest.approx([0.055, 0.01, 0.01, 0.01])  # a burst would have gaps of 1 ms
    pace = clock.pace()
    assert (pace.ticks, pace.late) == (5, 1)
    assert pace.worst == pytest.approx(0.045)
    assert pace.late_share == pytest.approx(0.2)


def test_a_little_late_is_on_time_and_does_not_add_up() -> None:
    time = FakeTime()
    clock = time.clock()
    for _ in range(50):
        for work in (CONTROL_PERIOD + LATE / 2, CONTROL_PERIOD / 2):
            time.now += work
            clock.wait()
    assert clock.pace().late == 0
    assert time.now == pytest.approx(100.0 + 100 * CONTROL_PERIOD)


def test_a_run_in_real_time_gives_the_same_bits_as_a_headless_one(twin: Twin) -> None:
    digests = []
    for realtime in (False, True):
        twin.reset(11)
        listener = Listener()
        Session(twin, realtime=realtime).run(ScriptedAgent(twin, 11), [listener], time_limit=0.5)
        digests.append([step.digest for step in listener.steps])
    assert len(digests[0]) == 50
    assert digests[0] == digests[1]


def test_a_session_in_real_time_says_how_late_each_tick_began() -> None:
    class Slow(Script):
        def act(self, observation: Observation) -> Action | None:
            if observation.time == 0.0:
                time.now += 0.05
            return super().act(observation)

    time, listener = FakeTime(), Listener()
    session = Session(Robot())
    session.clock = time.clock()
    session.run(Slow([STAY] * 4), [listener], time_limit=1.0)
    assert [step.late for step in listener.steps] == pytest.approx([0.0, 0.04, 0.0, 0.0])
