"""Agents to measure policies against: some know the answer, some know nothing of the scene before them.

A policy is worth its name where it does better than `average` and `replay`, which move as the demonstrator
does but neither see nor feel; `demonstrator` says what is possible. The others vary the demonstrator: all of
it at the wrong stiffness, and the same motion off by a smooth error, under compliance and under joint
position control.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from controller.model import ArmModel, ur5e
from controller.servo import ServoConfig
from controller.stiffness import StiffnessTable, stiffness_of
from controller.types import (
    ARM_ROW,
    Action,
    ArmAction,
    Array,
    CartesianTarget,
    Hold,
    JointTarget,
    Observation,
    Pose,
    Stiffness,
    StiffnessMode,
)
from studio import tasks
from studio.inputs.scripted import ScriptedAgent, demonstration
from studio.motion import Motion, together
from studio.replay import ReplayAgent
from studio.session import CONTROL_PERIOD, Agent
from studio.twin import Twin

AVERAGED = range(20)  # seeds whose demonstrations `average` averages
ANOTHER = 100_000  # what `replay` adds to the seed to come to another one
LEAD_IN = 1.0  # [s] from where the arms are to where a foreign motion begins
ERROR = 0.002  # [m] root mean square of the smooth error
ERROR_PERIODS = (2.0, 6.0)  # [s] of the sinusoids that it is made of
N_SINUSOIDS = 3  # of each axis

_ERROR_STREAM = 2  # of the seed, beside the scene's and the demonstrator's


class Stiffened:
    """Another agent's motion, all of it at one stiffness."""

    def __init__(self, agent: Agent, stiffness: Stiffness) -> None:
        self._agent, self._stiffness = agent, stiffness

    def reset(self, observation: Observation) -> None:
        self._agent.reset(observation)

    def act(self, observation: Observation) -> Action | None:
        action = self._agent.act(observation)
        return None if action is None else Action(tuple(map(self._stiffened, action.arms)))

    def _stiffened(self, arm: ArmAction) -> ArmAction:
        if not isinstance(arm.target, CartesianTarget):
            return arm
        return ArmAction(CartesianTarget(arm.target.base_from_target, self._stiffness), arm.gripper)


@dataclass(frozen=True, slots=True)
class Demonstrated:
    """A demonstration as it went."""

    actions: list[Action]  # requested, one a tick
    q_commands: Array  # (ticks, arms, 6) [rad] what the controller made of them, at each tick's end


def demonstrated(twin: Twin, seed: int, spread: float) -> Demonstrated:
    """Let the task's demonstrator do `seed`; the twin is then somewhere else."""
    twin.reset(seed, spread)
    longest = round(twin.task.time_limit / CONTROL_PERIOD)
    actions, q_commands = [], []
    for action in itertools.islice(demonstration(twin, seed), longest):
        trace = twin.apply(action).trace  # (arms, fast steps, columns)
        actions.append(action)
        q_commands.append(trace[:, -1, ARM_ROW["q_command"]])
    return Demonstrated(actions, np.array(q_commands))


def nothing(twin: Twin) -> Agent:
    """Holds until time is up."""
    still = Action(tuple(ArmAction(Hold(), arm.servo.gripper) for arm in twin.arms))
    return ReplayAgent([still] * round(twin.task.time_limit / CONTROL_PERIOD))


def average(twin: Twin) -> Agent:
    """One motion for every scene: the mean of the demonstrations of `AVERAGED`, which other seeds drew."""
    motion = _average_of(twin.task.name, twin.spread, twin.config.stiffness_table)
    return ReplayAgent([*_lead_in(twin, motion[0]), *motion])


def replay(twin: Twin) -> Agent:
    """What the demonstrator did in another scene."""
    seed, spread = twin.seed, twin.spread
    motion = demonstrated(twin, seed + ANOTHER, spread).actions
    twin.reset(seed, spread)
    return ReplayAgent([*_lead_in(twin, motion[0]), *motion])


def stiffened(twin: Twin, mode: StiffnessMode) -> Agent:
    """The demonstrator, all of it in one mode."""
    return Stiffened(ScriptedAgent(twin, twin.seed), stiffness_of(mode, twin.config.stiffness_table))


def off_under_joint_control(twin: Twin) -> Agent:
    """The joint commands of the demonstration, each arm's tool off by the smooth error."""
    seed, spread = twin.seed, twin.spread
    shown = demonstrated(twin, seed, spread)
    twin.reset(seed, spread)
    errors = smooth_errors(seed, len(shown.actions), len(twin.arms))
    models = [ur5e(arm.flange_from_tcp) for arm in twin.task.arms]
    return ReplayAgent(
        [
            Action(
                tuple(
                    ArmAction(JointTarget(_moved(model, q, error)), arm.gripper)
                    for model, q, error, arm in zip(models, qs, offs, action.arms, strict=True)
                )
            )
            for action, qs, offs in zip(shown.actions, shown.q_commands, errors, strict=True)
        ]
    )


def off_under_compliance(twin: Twin) -> Agent:
    """The targets of the demonstration, off by the same error and with its stiffness."""
    seed, spread = twin.seed, twin.spread
    shown = demonstrated(twin, seed, spread)
    twin.reset(seed, spread)
    errors = smooth_errors(seed, len(shown.actions), len(twin.arms))
    return ReplayAgent(
        [
            Action(tuple(_shifted(arm, error) for arm, error in zip(action.arms, offs, strict=True)))
            for action, offs in zip(shown.actions, errors, strict=True)
        ]
    )


REFERENCES: dict[str, Callable[[Twin], Agent]] = {
    "demonstrator": lambda twin: ScriptedAgent(twin, twin.seed),
    "nothing": nothing,
    "average": average,
    "replay": replay,
    "all-low": lambda twin: stiffened(twin, StiffnessMode.LOW),
    "all-high": lambda twin: stiffened(twin, StiffnessMode.HIGH),
    "off-compliant": off_under_compliance,
    "off-joint": off_under_joint_control,
}


def smooth_errors(seed: int, ticks: int, arms: int) -> Array:
    """(ticks, arms, 3) [m] errors of position: sums of slow sinusoids, `ERROR` in length (RMS), from 0 on."""
    rng = np.random.default_rng([_ERROR_STREAM, seed])
    periods = rng.uniform(*ERROR_PERIODS, (arms, 3, N_SINUSOIDS))
    phases = rng.uniform(0, 2 * np.pi, (arms, 3, N_SINUSOIDS))
    t = np.arange(ticks) * CONTROL_PERIOD
    waves = np.sin(2 * np.pi * t[:, None, None, None] / periods + phases).sum(axis=-1)
    errors = waves * ERROR / np.sqrt((waves**2).sum(axis=-1).mean(axis=0, keepdims=True))[..., None]
    return np.asarray(errors * np.minimum(t / LEAD_IN, 1.0)[:, None, None])


def _moved(model: ArmModel, q: Array, error: Array) -> Array:
    """Joints (6,) with the tool shifted by millimetres (3,) [m]: one Newton step, exact to micrometres."""
    return np.asarray(q + np.linalg.solve(model.jacobian(q), np.concatenate((error, np.zeros(3)))))


def _shifted(arm: ArmAction, error: Array) -> ArmAction:
    assert isinstance(arm.target, CartesianTarget)
    pose = arm.target.base_from_target
    off = Pose(pose.position + error, pose.wxyz)
    return ArmAction(CartesianTarget(off, arm.target.stiffness), arm.gripper)


def _lead_in(twin: Twin, first: Action) -> list[Action]:
    """From where the arms are to where a motion begins: a jump would be refused."""
    hands, moves = [], []
    for arm, wanted in zip(twin.arms, first.arms, strict=True):
        assert isinstance(wanted.target, CartesianTarget)
        table = twin.config.stiffness_table
        hands.append(hand := Motion(arm.servo.target, StiffnessMode.MEDIUM, arm.servo.gripper, table))
        moves.append(hand.move(wanted.target.base_from_target, LEAD_IN))
    return list(together(hands, *moves))


@cache
def _average_of(task: str, spread: float, table: StiffnessTable) -> list[Action]:
    """The mean motion of the demonstrations of `AVERAGED`.

    Averaged phase by phase, each stretched to its mean length; a phase ends where a stiffness changes, or a
    hand begins or ends to open or close. Only demonstrations with the usual phases count, and of these the
    half that is nearest to the most central one: the mean of two ways to go about it would be neither.
    """
    twin = Twin(tasks.load(task), ServoConfig.for_table(table))
    homes = np.array([arm.world_from_home.wxyz for arm in twin.task.arms])
    phased = [_phases(demonstrated(twin, seed, spread).actions, homes) for seed in AVERAGED]
    usual, _ = Counter(keys for keys, _ in phased).most_common(1)[0]
    alike = [phases for keys, phases in phased if keys == usual]
    lengths = [round(np.mean([len(part) for part in phase])) for phase in zip(*alike, strict=True)]
    motions = np.array(
        [np.concatenate([_stretched(*p) for p in zip(phases, lengths, strict=True)]) for phases in alike]
    )  # (demonstrations, ticks, arms, columns)
    apart = np.linalg.norm(motions[:, None, ..., :3] - motions[None, ..., :3], axis=-1).mean(axis=(2, 3))
    nearest = np.argsort(apart[apart.sum(axis=0).argmin()])[: (len(motions) + 1) // 2]
    return [Action(tuple(map(_action_of, row))) for row in motions[nearest].mean(axis=0)]


_Key = tuple[tuple[float, int], ...]  # per arm: stiffness [N/m]; -1 while it closes, 1 while it opens


def _phases(actions: list[Action], homes: Array) -> tuple[tuple[_Key, ...], list[Array]]:
    """What characterises each phase, and its rows (ticks, arms, columns).

    Of a quaternion and its negative, the one on the side of `homes` (arms, 4) is taken.
    """
    rows = np.array([[_row_of(arm) for arm in action.arms] for action in actions])
    rows[:, :, 3:7] *= np.where((rows[0, :, 3:7] * homes).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    moving = np.sign(np.diff(rows[:, :, -1], axis=0, append=rows[-1:, :, -1])).astype(int)
    keys = [
        tuple(zip(stiffness.tolist(), hands.tolist(), strict=True))
        for stiffness, hands in zip(rows[:, :, 7], moving, strict=True)
    ]
    starts = [0, *(n for n in range(1, len(keys)) if keys[n] != keys[n - 1])]
    return tuple(keys[n] for n in starts), np.split(rows, starts[1:])


def _row_of(arm: ArmAction) -> Array:
    """(20,): position, wxyz, stiffness, gripper."""
    assert isinstance(arm.target, CartesianTarget)
    return np.concatenate((arm.target.base_from_target.vector, arm.target.stiffness.vector, [arm.gripper]))


def _action_of(row: Array) -> ArmAction:
    wxyz = row[3:7] / np.linalg.norm(row[3:7])
    return ArmAction(CartesianTarget(Pose(row[:3], wxyz), Stiffness.from_vector(row[7:19])), float(row[19]))


def _stretched(rows: Array, length: int) -> Array:
    """Rows (n, …) interpolated to another number of them."""
    at = np.linspace(0, len(rows) - 1, length)
    low = np.floor(at).astype(int)
    high = np.minimum(low + 1, len(rows) - 1)
    share = (at - low)[:, None, None]
    return np.asarray((1 - share) * rows[low] + share * rows[high])
