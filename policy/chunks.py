"""From chunks of future targets to the action of this moment. Pure numpy: the session's side of a policy.

A chunk tells targets at `time`, `time + period`, … The executor either follows the newest chunk and asks for
another after some steps, or averages all that the chunks so far say about a moment ("temporal ensembling" of
ACT, Zhao et al. 2023). Rotations are averaged as rotations: the sum of w q q^T has the mean as its principal
eigenvector, whatever the signs (Markley et al. 2007). Stiffness blocks are averaged as matrices, which leaves
them symmetric, positive definite and inside the bounds. Where the published code keeps every chunk, only
running sums are kept here: memory of one chunk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from controller.types import Action, ArmAction, Array, CartesianTarget, Hold, JointTarget, Pose, Stiffness
from policy.rotations import principal

ExecutionMode = Literal["replan", "ensemble"]

DECAY = 0.01  # weight exp(-DECAY i) of the i-th chunk about a moment, the oldest first, as in ACT


@dataclass(frozen=True, slots=True)
class ArmChunk:
    """Targets of one arm at T steps: pose and stiffness, or joints."""

    gripper: Array  # (T,) 0 closed .. 1 open
    position: Array | None = None  # (T, 3) [m] in the base
    wxyz: Array | None = None  # (T, 4) unit quaternions
    translational: Array | None = None  # (T, 3, 3) [N/m]
    rotational: Array | None = None  # (T, 3, 3) [N·m/rad]
    q: Array | None = None  # (T, 6) [rad]

    @property
    def is_joint(self) -> bool:
        return self.q is not None


@dataclass(frozen=True, slots=True)
class ActionChunk:
    """What a policy wants, step by step."""

    time: float  # [s] of the first step: of the state that the policy saw
    period: float  # [s]
    arms: tuple[ArmChunk, ...]

    @property
    def end(self) -> float:
        """[s] of the last step."""
        return self.time + (len(self.arms[0].gripper) - 1) * self.period


class ChunkExecutor:
    """Turns chunks into actions. Call `wants` and `action` each tick, `add` when a chunk arrives."""

    def __init__(
        self,
        mode: ExecutionMode = "replan",
        replan_every: int | None = None,
        *,
        n_arms: int,
        decay: float = DECAY,
    ) -> None:
        """`replan_every` counts steps of a chunk between two questions: 10 for "replan", 1 for "ensemble"."""
        if mode not in ("replan", "ensemble"):
            raise ValueError(f"No execution mode {mode!r}; there are 'replan' and 'ensemble'.")
        self.replan_every = replan_every if replan_every is not None else 10 if mode == "replan" else 1
        if self.replan_every < 1:
            raise ValueError(f"A policy is asked after at least 1 step, not {replan_every}.")
        self.mode: ExecutionMode = mode
        self._decay = decay
        self._n_arms = n_arms
        self.reset()

    def reset(self, gripper: tuple[float, ...] | None = None) -> None:
        """Forget all chunks; `gripper` is what each hand keeps until the first one."""
        self.late = 0  # ticks for which no chunk had a word, and the last target was held
        self._told = Action(tuple(ArmAction(Hold(), g) for g in gripper or (0.0,) * self._n_arms))
        self._newest: ActionChunk | None = None
        self._start = 0.0  # [s] of the first row
        self._sums: Array = np.empty((0, 0))  # (steps, numbers): weighted sums, see `_rows`
        self._weights: Array = np.empty(0)  # (steps,) of these sums
        self._counts: Array = np.empty(0)  # (steps,) chunks in each
        self._signs: list[Array | None] = [None] * self._n_arms  # last quaternion of each arm

    @property
    def grippers(self) -> tuple[float, ...]:
        """What each hand was told last."""
        return tuple(arm.gripper for arm in self._told.arms)

    def wants(self, time: float) -> bool:
        """Whether to ask the policy for a chunk now."""
        newest = self._newest
        return newest is None or time >= newest.time + self.replan_every * newest.period - 1e-6

    def add(self, chunk: ActionChunk) -> None:
        """Take a chunk; one that is older than the newest is dropped."""
        if len(chunk.arms) != self._n_arms:
            raise ValueError(f"A chunk of {len(chunk.arms)} arms for {self._n_arms}.")
        if self._newest is not None and chunk.time < self._newest.time:
            return
        rows = _rows(chunk)
        if self.mode == "replan" or self._newest is None:
            self._start, self._sums = chunk.time, rows
            self._weights = self._counts = np.ones(len(rows))
        else:
            self._merge(chunk, rows)
        self._newest = chunk

    def action(self, time: float) -> Action:
        """At `time` [s], between two steps where it lies between; a hold before the first chunk.

        Past the end of all that is known, the last target is held and counted in `late`.
        """
        if self._newest is None:
            return self._told
        place = (time - self._start) / self._newest.period
        last = len(self._sums) - 1
        if place > last + 1e-6:
            self.late += 1
        place = min(max(place, 0.0), last)
        first = min(int(place), last)
        row = self._mean(first)
        if (share := place - first) > 1e-9:
            row = row + share * (self._mean(first + 1) - row)
        chunk = self._newest
        self._told = Action(tuple(self._arm(n, p) for n, p in enumerate(np.split(row, len(chunk.arms)))))
        return self._told

    def _mean(self, step: int) -> Array:
        return np.asarray(self._sums[step] / self._weights[step])

    def _merge(self, chunk: ActionChunk, rows: Array) -> None:
        """Add a chunk to the running sums, from the steps of these at or before its begin on."""
        period = chunk.period
        passed = min(max(int((chunk.time - self._start) / period + 1e-6), 0), len(self._sums))
        sums, weights, counts = (kept[passed:] for kept in (self._sums, self._weights, self._counts))
        self._start += passed * period
        # The chunk at the times of the sums; it has no word about what lies before its begin.
        offset = (chunk.time - self._start) / period
        first = max(0, int(np.ceil(offset - 1e-6)))
        n = len(rows) + int(np.floor(offset + 1e-6))
        places = (np.arange(first, n) - offset).clip(0, len(rows) - 1)
        lower = places.astype(int)
        upper = np.minimum(lower + 1, len(rows) - 1)
        share = (places - lower)[:, None]
        told = rows[lower] + share * (rows[upper] - rows[lower])
        more = max(0, n - len(sums))
        sums = np.concatenate((sums, np.zeros((more, rows.shape[1]))))
        weights, counts = (np.concatenate((kept, np.zeros(more))) for kept in (weights, counts))
        weight = np.exp(-self._decay * counts[first:n])
        sums[first:n] += weight[:, None] * told
        weights[first:n] += weight
        counts[first:n] += 1
        begin = int(np.argmax(weights > 0))  # after a gap, what nobody has a word about
        self._start += begin * period
        self._sums, self._weights, self._counts = sums[begin:], weights[begin:], counts[begin:]

    def _arm(self, number: int, row: Array) -> ArmAction:
        gripper = float(row[0])
        if len(row) == _JOINT_WIDTH:
            return ArmAction(JointTarget(row[1:].copy()), gripper)
        wxyz = principal(row[4:20].reshape(4, 4))
        before = self._signs[number]
        reference = wxyz[0] if before is None else wxyz @ before
        wxyz = -wxyz if reference < 0 else wxyz
        self._signs[number] = wxyz
        translational, rotational = row[20:].reshape(2, 3, 3)
        stiffness = Stiffness(_symmetric(translational), _symmetric(rotational))
        return ArmAction(CartesianTarget(Pose(row[1:4].copy(), wxyz), stiffness), gripper)


_JOINT_WIDTH = 7


def _rows(chunk: ActionChunk) -> Array:
    """(T, arms * width): numbers of which sums and blends make sense. Gripper, position, q q^T, stiffness."""
    parts: list[Array] = []
    for arm in chunk.arms:
        n = len(arm.gripper)
        parts.append(arm.gripper.reshape(n, 1))
        if arm.q is not None:
            parts.append(arm.q)
            continue
        assert arm.position is not None
        assert arm.wxyz is not None
        assert arm.translational is not None
        assert arm.rotational is not None
        outer = arm.wxyz[:, :, None] * arm.wxyz[:, None, :]
        parts += [arm.position, *(b.reshape(n, -1) for b in (outer, arm.translational, arm.rotational))]
    return np.concatenate(parts, axis=1, dtype=float)


def _symmetric(block: Array) -> Array:
    return np.asarray((block + block.T) / 2)
