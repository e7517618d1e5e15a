"""Tells clients what the robot does, each kind of report at a rate of its own."""

from __future__ import annotations

import time
from collections.abc import Callable

from controller.types import Limit, Step
from studio import messages as m
from studio.link import Hub
from studio.twin import Twin

FRAME_EVERY = 3  # ticks: 33 Hz
STATUS_EVERY = 10  # ticks: 10 Hz
TASK_STATE_EVERY = 10  # ticks: 10 Hz, where it has changed
SHOWN = 0.7  # [s] that a limit stays on display


class Reporter:
    """What was told of the scene on the stage, and what is due."""

    def __init__(self, hub: Hub, now: Callable[[], float] = time.monotonic) -> None:
        self.resets = 0  # how often a scene was put on the stage
        self._hub, self._now = hub, now
        self._ticks = 0
        self._limits: dict[int, tuple[float, Limit]] = {}  # newest of each arm, and when [s]
        self._told_state: dict[str, bytes] = {}
        self._told_images: dict[str, float] = {}

    def begin_scene(self) -> None:
        """Another scene is on the stage; nothing was told of it."""
        self.resets += 1
        self._limits.clear()
        self._told_state.clear()

    def publish(self, step: Step, robot: Twin, status: Callable[[], m.Status]) -> None:
        """What is due after a tick."""
        self._ticks += 1
        for limit in step.applied.limits:
            self._limits[limit.arm] = (self._now(), limit)
        if self._ticks % FRAME_EVERY == 0:
            self._hub.publish("frame", self._frame(step, robot))
        if self._ticks % STATUS_EVERY == 0:
            self._hub.publish("status", status())
        if self._ticks % TASK_STATE_EVERY == 0:
            self._publish_task_state(robot)
        for name, image in step.observation.images.items():
            if image.jpeg and self._told_images.get(name) != image.time:
                self._told_images[name] = image.time
                report = m.CameraImage(camera=name, time=image.time, resets=self.resets, jpeg=image.jpeg)
                self._hub.publish(("image", name), report)

    def level(self, arm: int) -> tuple[m.Level, str]:
        """How the arm's last targets fared and why, for as long as a person needs to read it."""
        when, limit = self._limits.get(arm, (-1e9, None))
        if limit is None or self._now() - when > SHOWN:
            return "ok", ""
        return ("refused" if limit.refused else "limited"), limit.why

    def _publish_task_state(self, robot: Twin) -> None:
        """Each array by itself, so that a counter that runs does not carry the whole board along."""
        for name, array in robot.task.state().items():
            data = array.tobytes()
            if self._told_state.get(name) != data:
                self._told_state[name] = data
                self._hub.publish(("task state", name), m.TaskState.of({name: array}, self.resets))

    def _frame(self, step: Step, robot: Twin) -> m.Frame:
        arms = []
        for index, (state, arm) in enumerate(zip(step.observation.arms, robot.arms, strict=True)):
            arms.append(
                m.ArmFrame(
                    base_from_tcp=tuple(state.base_from_tcp.vector.tolist()),
                    base_from_target=tuple(arm.servo.target.vector.tolist()),
                    wrench=tuple(state.wrench.vector.tolist()),
                    stiffness=float(arm.servo.stiffness.translational.trace()) / 3,
                    gripper=state.gripper,
                    level=self.level(index)[0],
                )
            )
        qpos = robot.data.qpos.tobytes()
        return m.Frame(time=robot.data.time, resets=self.resets, qpos=qpos, arms=tuple(arms))
