"""A trained policy as an operator: it asks a network for chunks of targets and plays them, tick by tick.

Two kinds of `Mind` ask it: `Immediate` waits and answers in the robot's time, for runs that are not live;
`Thinking` has a thread of its own, so that whoever drives never waits. The network itself is here, or in
another process on this or another machine (`studio.policy_link`). An answer that comes late is joined in its
middle; where none has a word about the present any more, the last target is held and the tick counted.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from controller.types import Action, Observation
from policy.agent import ActionChunk, ChunkExecutor, ExecutionMode, History, Inputs, Policy, PolicySpec
from studio.channels import Latest


class ClosingPolicy(Policy, Protocol):
    """A policy that holds a process or a connection."""

    def close(self) -> None: ...


class Mind(Protocol):
    """A network that is asked and answers some time later."""

    spec: PolicySpec

    def reset(self, seed: int) -> None:
        """Another run begins."""

    def ask(self, inputs: Inputs, time: float) -> None:
        """Ask at `time` [s] of the observation; a question still open may be forgotten."""

    def answer(self, time: float) -> ActionChunk | None:
        """The newest answer that has arrived by `time` [s], once."""


class Immediate:
    """A policy of this process. In the robot's time it answers `latency` [s] after it is asked."""

    def __init__(self, policy: Policy, latency: float = 0.0) -> None:
        if latency < 0:
            raise ValueError(f"A policy cannot answer {-latency} s before it is asked.")
        self.spec = policy.spec
        self._policy, self._latency = policy, latency
        self._due: list[tuple[float, ActionChunk]] = []

    def reset(self, seed: int) -> None:
        self._policy.reset(seed)
        self._due.clear()

    def ask(self, inputs: Inputs, time: float) -> None:
        self._due.append((time + self._latency, self._policy.predict(inputs)))

    def answer(self, time: float) -> ActionChunk | None:
        arrived = [chunk for due, chunk in self._due if due <= time + 1e-9]
        self._due = self._due[len(arrived) :]
        return arrived[-1] if arrived else None


class Thinking:
    """A policy that a thread opens and asks; of questions that wait, the newest wins."""

    def __init__(self, spec: PolicySpec, open_policy: Callable[[], ClosingPolicy]) -> None:
        """`open_policy` may take its time: until then there is no answer."""
        self.spec = spec
        self.error: str | None = None  # why there are no answers any more
        self._open_policy = open_policy
        self._asked: Latest[Inputs] = Latest()
        self._answered: Latest[ActionChunk] = Latest()
        self._n_read = 0  # of the answers
        self._seed: int | None = None  # of a run that begins
        self._wake = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="policy", daemon=True)
        self._thread.start()

    def reset(self, seed: int) -> None:
        self._seed = seed

    def ask(self, inputs: Inputs, time: float) -> None:
        self._asked.set(inputs)
        self._wake.set()

    def answer(self, time: float) -> ActionChunk | None:
        chunk, count = self._answered.get()
        if count == self._n_read:
            return None
        self._n_read = count
        return chunk

    def close(self) -> None:
        """End it; does not wait for a policy that is just being opened."""
        self._ended = True
        self._wake.set()

    def _run(self) -> None:
        try:
            policy = self._open_policy()
        except Exception as error:  # whatever keeps a network from loading is for the operator to read
            self.error = f"The policy cannot be loaded: {error}"
            return
        try:
            self._think(policy)
        except Exception as error:
            self.error = f"The policy has stopped: {error}"
        finally:
            policy.close()

    def _think(self, policy: Policy) -> None:
        while not self._ended:
            self._wake.wait()
            self._wake.clear()
            seed, self._seed = self._seed, None
            if seed is not None:
                policy.reset(seed)
            inputs, _ = self._asked.get()
            if inputs is not None and not self._ended:
                self._answered.set(policy.predict(inputs))


class PolicyAgent:
    """Drives with what a mind says."""

    def __init__(
        self,
        mind: Mind,
        execution: ExecutionMode = "replan",
        replan_every: int | None = None,
        *,
        seed: int = 0,
        grippers: tuple[float, ...] | None = None,
    ) -> None:
        """`replan_every` counts steps of a chunk between two questions, see `ChunkExecutor`.

        `grippers`: what the hands are commanded now, and stay at until the first answer. Not told, they stay
        as they are measured, which loosens the grip on what they hold.
        """
        self._mind, self._seed = mind, seed
        self._grippers = grippers
        self._history = History(mind.spec)
        self._executor = ChunkExecutor(execution, replan_every, n_arms=len(mind.spec.arms))
        self._time = 0.0  # [s] of the last observation
        self._asked: float | None = None  # [s] of the inputs to which the answer is still out

    @property
    def execution(self) -> dict[str, object]:
        """How chunks are played."""
        return {"execution": self._executor.mode, "replan_every": self._executor.replan_every}

    @property
    def late(self) -> int:
        """Ticks for which no chunk had a word, and the last target was held."""
        return self._executor.late

    def reset(self, observation: Observation) -> None:
        self._mind.reset(self._seed)
        self._history.reset()
        self._executor.reset(self._grippers or tuple(arm.gripper for arm in observation.arms))
        self._time, self._asked = observation.time, None

    def act(self, observation: Observation) -> Action:
        now = observation.time
        if now < self._time:  # a take has begun, and time with it
            self._grippers = self._executor.grippers
            self.reset(observation)
        self._time = now
        self._history.add(observation)
        if self._asked is None and self._executor.wants(now):
            inputs = self._history.inputs(observation)
            if inputs is not None and inputs.time <= now:  # else images of before the reset
                self._mind.ask(inputs, now)
                self._asked = inputs.time
        chunk = self._mind.answer(now)
        if chunk is not None and chunk.time == self._asked:  # else the answer to somebody before us
            self._asked = None
            self._executor.add(chunk)
        return self._executor.action(now)
