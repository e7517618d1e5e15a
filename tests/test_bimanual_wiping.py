"""Bimanual wiping: the hammer is lifted, the dirt wiped, the hammer put back, not dropped."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from controller.types import (
    ARM_ROW,
    Action,
    ArmAction,
    Pose,
    Snapshot,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector,
)
from studio.inputs.scripted import ScriptedAgent
from studio.session import CONTROL_PERIOD
from studio.tasks import Progress
from studio.tasks.bimanual_wiping import BOARD_CENTER, DIRT_OFFSET, HAMMER_TURN, HEAD_HALF, Task
from studio.twin import Twin


@dataclass
class Demonstration:
    """One that succeeded: its actions, and at some moments the state and the number of actions so far."""

    actions: list[Action] = field(default_factory=list)
    moments: dict[str, tuple[Snapshot, int]] = field(default_factory=dict)

    def at(self, twin: Twin, moment: str) -> Action:
        """Restore a moment; returns the action that led to it."""
        snapshot, n = self.moments[moment]
        twin.restore(snapshot)
        return self.actions[n - 1]


@pytest.fixture(scope="module")
def twin() -> Twin:
    return Twin(Task())


@pytest.fixture(scope="module")
def demonstration(twin: Twin) -> Demonstration:
    twin.reset(3)
    seen = Demonstration()
    for action in _demonstrate(twin, 3):
        twin.apply(action)
        seen.actions.append(action)
        hammer = twin.world.pose("hammer").position - BOARD_CENTER
        moment = twin.progress().phase
        if moment == "wipe" and hammer[1] > 0.2:
            moment = "hammer aside"
        elif moment == "put it back":
            moment = "clean" if hammer[2] > HEAD_HALF[2] + 0.0005 else "lowered"
        if moment not in seen.moments:
            seen.moments[moment] = twin.save(), len(seen.actions)
    return seen


def _demonstrate(twin: Twin, seed: int) -> Iterator[Action]:
    """The demonstrator's actions, one by one; the twin must apply each before the next is asked for."""
    agent = ScriptedAgent(twin, seed)
    agent.reset(twin.observe())
    return iter(lambda: agent.act(twin.observe()), None)


def _stay(twin: Twin, action: Action, seconds: float, opening: float | None = None) -> None:
    """Keep the targets; open the left hand where told."""
    left, right = action.arms
    left = ArmAction(left.target, left.gripper if opening is None else opening)
    for _ in range(round(seconds / CONTROL_PERIOD)):
        twin.apply(Action((left, right)))


@pytest.mark.parametrize("seed", [20000, 20001])  # one of each style
def test_the_demonstrator_lifts_wipes_and_puts_back_gently(twin: Twin, seed: int) -> None:
    twin.reset(seed)
    soft = [g for g in range(twin.model.ngeom) if "pad" in twin.model.geom(g).name]
    soft.append(twin.model.geom("eraser_felt").id)
    force = soft_depth = hard_depth = 0.0
    phases = []
    for action in _demonstrate(twin, seed):
        wrenches = twin.apply(action).trace[:, :, ARM_ROW["wrench"]]
        force = max(force, float(np.linalg.norm(wrenches[..., :3], axis=-1).max()))
        contact = twin.data.contact
        is_soft = np.isin(contact.geom, soft).any(axis=1)
        soft_depth = max(soft_depth, -float(contact.dist[is_soft].min(initial=0.0)))
        hard_depth = max(hard_depth, -float(contact.dist[~is_soft].min(initial=0.0)))
        if not phases or phases[-1] != twin.progress().phase:
            phases.append(twin.progress().phase)
    assert twin.progress().success
    assert phases == ["lift the hammer", "wipe", "put it back", "done"]
    assert force < 40.0
    assert soft_depth < 0.001
    assert hard_depth < 0.0005


def test_the_hammer_lies_turned_on_dirt_whose_shape_changes(twin: Twin) -> None:
    turns, dirt = [], []
    for seed in range(6):
        twin.reset(seed)
        hammer = twin.world.pose("hammer")
        turns.append(float(rotation_vector(hammer.wxyz)[2]) + math.pi / 2)
        line = twin.task.state()["dirt"] - (hammer.position - BOARD_CENTER)[:2]
        dirt.append(line)
        assert (np.abs((line.min(axis=0) + line.max(axis=0)) / 2) <= DIRT_OFFSET + 1e-9).all()
    assert np.abs(turns).max() <= HAMMER_TURN
    assert np.ptp(turns) > math.radians(5.0)
    assert (np.std([np.ptp(line, axis=0) for line in dirt], axis=0) > 0.001).all()


def test_dirt_under_a_hammer_that_nobody_lifts_stays(twin: Twin, demonstration: Demonstration) -> None:
    twin.reset(3)
    left_home = demonstration.actions[0].arms[0]
    first, last = (demonstration.moments[moment][1] for moment in ("hammer aside", "clean"))
    for action in demonstration.actions[first:last]:
        twin.apply(Action((left_home, action.arms[1])))
    assert twin.progress() == Progress(0.0, False, "lift the hammer")


def test_a_hammer_that_was_let_go_in_the_air_does_not_count(twin: Twin, demonstration: Demonstration) -> None:
    action = demonstration.at(twin, "clean")
    _stay(twin, action, 0.5, opening=1.0)
    assert twin.progress().phase == "dropped"
    twin.world.place("hammer", Pose.from_vector(twin.task.state()["place"]))
    _stay(twin, action, 0.1, opening=1.0)
    assert not twin.progress().success


def test_a_hammer_held_in_its_place_counts_once_it_is_let_go(
    twin: Twin, demonstration: Demonstration
) -> None:
    action = demonstration.at(twin, "lowered")
    _stay(twin, action, 0.5)
    assert not twin.progress().success
    _stay(twin, action, 1.0, opening=1.0)
    assert twin.progress().success


@pytest.mark.parametrize(
    ("shift", "degrees", "success"),
    [(0.025, 0.0, True), (0.035, 0.0, False), (0.0, 12.0, True), (0.0, 18.0, False)],
)
def test_a_hammer_counts_as_back_within_3_cm_and_15_degrees(
    twin: Twin, demonstration: Demonstration, shift: float, degrees: float, success: bool
) -> None:
    action = demonstration.at(twin, "done")
    place = Pose.from_vector(twin.task.state()["place"])
    twist = quaternion_from_rotation_vector(np.array([0.0, 0.0, math.radians(degrees)]))
    position = place.position + np.array([0.0, -shift, 0.0])
    twin.world.place("hammer", Pose(position, multiply_quaternions(twist, place.wxyz)))
    _stay(twin, action, 0.1, opening=1.0)
    assert twin.progress().success == success
