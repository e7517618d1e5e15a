"""How much faster than real time the headless loop runs on one core, in contact, without cameras."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

import numpy as np

from controller.types import Action, Observation, Pose, StiffnessMode
from studio import tasks
from studio.benchmarks import two_arms
from studio.episode import Outcome
from studio.motion import Motion
from studio.recorder import Recorder
from studio.session import Session, Subscriber
from studio.station import header_of
from studio.tasks.wiping import BOARD_CENTER
from studio.twin import Twin

REPEATS = 3
WARM_UP = 2.5  # [s] of simulated time, until the arms touch
MEASURED = 2.5  # [s] of simulated time
RUB = 0.04  # [m] to either side of the board's centre
DEPTH = 0.01  # [m] of the target below the board's face


def measure() -> dict[str, float]:
    """Simulated time over CPU time of the whole process, medians; `recorded` also writes the take."""
    one = Twin(tasks.load("wiping"))
    two = Twin(tasks.load(two_arms.Task.name))
    rub = _Script(_rub(one))
    squeeze = _Script(two.task.demonstrate(two.world, np.random.default_rng(0)))
    for twin, script in ((one, rub), (two, squeeze)):
        Session(twin).run(script, time_limit=WARM_UP)
        if not np.linalg.norm(twin.observe().arms[0].wrench.force) > 1.0:
            raise RuntimeError(f"Nothing touches in {twin.task.name!r}.")
    with tempfile.TemporaryDirectory() as folder:
        header = header_of(one, agent="bench", operator="bench", has_images=False)
        with Recorder(Path(folder), min_free=0.0).start(header, realtime=False) as take:
            recorded = _times_real_time(one, rub, [take])
            take.finish(Outcome(None, "measured"))
    return {
        "one_arm": _times_real_time(one, rub),
        "one_arm_recorded": recorded,
        "two_arms": _times_real_time(two, squeeze),
    }


class _Script:
    """An agent that goes on where it stopped."""

    def __init__(self, actions: Iterator[Action]) -> None:
        self._actions = actions

    def reset(self, observation: Observation) -> None: ...

    def act(self, observation: Observation) -> Action | None:
        return next(self._actions, None)


def _times_real_time(twin: Twin, script: _Script, subscribers: Sequence[Subscriber] = ()) -> float:
    speeds = []
    for _ in range(REPEATS):
        begin = time.process_time()
        ending = Session(twin).run(script, subscribers, time_limit=MEASURED)
        speeds.append(ending.seconds / (time.process_time() - begin))
    return median(speeds)


def _rub(twin: Twin) -> Iterator[Action]:
    """Descend on the board and rub to and fro for ever."""
    start = twin.observe().arms[0].base_from_tcp
    hand = Motion(start, StiffnessMode.LOW, gripper=0.0)
    middle = np.array([*BOARD_CENTER[:2], BOARD_CENTER[2] - DEPTH])
    ends = [Pose(middle + np.array([0.0, side * RUB, 0.0]), start.wxyz) for side in (-1.0, 1.0)]
    strokes = (hand.move(end, 1.0) for end in itertools.cycle(ends))
    for action in itertools.chain(hand.move(ends[1], 1.5), itertools.chain.from_iterable(strokes)):
        yield Action((action,))
