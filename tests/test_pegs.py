"""Peg in hole with two arms: it must be felt, and both parts must stay in their hands."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from controller.types import ARM_ROW, Action, ArmAction, Pose, StiffnessMode
from studio import tasks
from studio.inputs.scripted import ScriptedAgent
from studio.insertion import FIT, GRASP_OFFSET, SEATED
from studio.motion import Motion, together
from studio.twin import Twin


@pytest.fixture(scope="module", params=["peg-cylinder", "peg-cuboid"])
def twin(request: pytest.FixtureRequest) -> Twin:
    return Twin(tasks.load(request.param))


def _demonstration(twin: Twin, seed: int) -> Iterable[Action]:
    """The demonstrator's actions, one by one; the twin must apply each before the next is asked for."""
    agent = ScriptedAgent(twin, seed)
    agent.reset(twin.observe())
    return iter(lambda: agent.act(twin.observe()), None)


def _play(twin: Twin, actions: Iterable[Action]) -> list[Action]:
    played = []
    for action in actions:
        twin.apply(action)
        played.append(action)
    return played


@pytest.mark.parametrize("seed", [20000, 20001, 20002])
def test_the_demonstrator_inserts_gently(twin: Twin, seed: int) -> None:
    twin.reset(seed)
    parts = [twin.model.body(name).id for name in ("peg", "hole")]
    force = depth = 0.0
    for action in _demonstration(twin, seed):
        wrenches = twin.apply(action).trace[:, :, ARM_ROW["wrench"]]
        force = max(force, float(np.linalg.norm(wrenches[..., :3], axis=-1).max()))
        between = np.isin(twin.model.geom_bodyid[twin.data.contact.geom], parts).all(axis=1)
        depth = max(depth, -float(twin.data.contact.dist[between].min(initial=0.0)))
    assert twin.progress().success
    assert force < 40.0
    assert depth < 0.0005


def test_how_the_parts_lie_in_the_hands_differs_by_seed(twin: Twin) -> None:
    offsets = []
    for seed in range(4):
        twin.reset(seed)
        for arm, part in (("left", "hole"), ("right", "peg")):
            x, y, z = (twin.world.tcp(arm).inverse() @ twin.world.pose(part)).position
            assert abs(x) < 2e-4
            assert abs(z) < 2e-4
            assert abs(y) <= GRASP_OFFSET + 2e-4
            offsets.append(round(float(y), 6))
    assert len(set(offsets)) == len(offsets)


def test_nothing_but_friction_holds_the_parts(twin: Twin) -> None:
    twin.reset(0)
    welds = [twin.model.equality(f"{arm.name}_presented").id for arm in twin.task.arms]
    assert not twin.data.eq_active[welds].any()
    left, right = next(iter(_demonstration(twin, 0))).arms
    for _ in range(80):
        twin.apply(Action((left, ArmAction(right.target, 1.0))))
    assert twin.world.pose("peg").position[2] < 0.15  # fell from 0.3 m
    assert twin.world.pose("hole").position[2] > 0.25
    assert not twin.progress().success


def test_a_peg_that_is_let_go_in_the_hole_does_not_count(twin: Twin) -> None:
    twin.reset(20000)
    actions = _play(twin, _demonstration(twin, 20000))
    assert twin.progress().success
    left, right = actions[-1].arms
    for _ in range(30):
        twin.apply(Action((left, ArmAction(right.target, 1.0))))
    assert FIT.depth(twin.world) > SEATED  # the hole carries it
    assert not twin.progress().success


def test_a_peg_beside_the_hole_does_not_count(twin: Twin) -> None:
    twin.reset(1)
    hands = [
        Motion(twin.world.tcp(arm.name), StiffnessMode.MEDIUM, gripper=0.0, base=arm.base_position)
        for arm in twin.task.arms
    ]
    at_mouth = FIT.target(twin.world.pose("hole"), FIT.peg_from_tcp(twin.world), 0.0)
    for distance in (-0.02, SEATED + 0.004):
        beside = at_mouth @ Pose(np.array([0.0, 0.075, distance]), np.array([1.0, 0.0, 0.0, 0.0]))
        _play(twin, together(hands, hands[1].move(beside, 1.5)))
        _play(twin, together(hands, hands[1].wait(1.2)))
    assert FIT.depth(twin.world) > SEATED
    assert not twin.progress().success
