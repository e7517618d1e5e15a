"""The drawing task: the smile is reached by drawing it and by nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from controller.stiffness import stiffness_of
from controller.types import ARM_ROW, Action, ArmAction, Array, CartesianTarget, Pose, StiffnessMode
from studio.board import Board
from studio.inputs.scripted import ScriptedAgent
from studio.session import CONTROL_PERIOD
from studio.tasks.drawing import ALIKE, BOARD_CENTER, INK_FORCE, LINE_RADIUS, Task, likeness, smile
from studio.twin import Twin


@pytest.fixture(scope="module")
def twin() -> Twin:
    return Twin(Task())


def _demonstrate(twin: Twin, seed: int, seconds: float = 60.0) -> list[Array]:
    """Run the demonstrator; returns the trace (n, 33) of each period."""
    twin.reset(seed)
    agent = ScriptedAgent(twin, seed)
    agent.reset(twin.observe())
    traces = []
    for _ in range(round(seconds / CONTROL_PERIOD)):
        if (action := agent.act(twin.observe())) is None:
            break
        traces.append(twin.apply(action).trace[0])
    return traces


def _drawn(lines: Sequence[Array], radius: float = LINE_RADIUS) -> float:
    board = Board()
    for line in lines:
        board.draw(np.atleast_2d(line), radius)
    return likeness(board.grid)


@pytest.mark.parametrize("seed", [20000, 20001, 20002])
def test_demonstrator_draws_the_smile(twin: Twin, seed: int) -> None:
    wrenches = np.concatenate(_demonstrate(twin, seed))[:, ARM_ROW["wrench"]]
    assert twin.progress().success
    force = np.linalg.norm(wrenches[:, :3], axis=1)
    assert force.max() < 10.0
    pressing = force[force > INK_FORCE]
    assert 1.0 < pressing.mean() < 3.0  # 250 N/m times 8 mm, less friction and what the nib gives


def test_both_styles_are_shown(twin: Twin) -> None:
    first_eye = [_first_ink(twin, seed) for seed in range(6)]
    assert {bool(x < BOARD_CENTER[0]) for x in first_eye} == {True, False}


def _first_ink(twin: Twin, seed: int) -> float:
    """x [m] in the world where the pen first presses."""
    trace = np.concatenate(_demonstrate(twin, seed, 5.0))
    down = np.flatnonzero(np.abs(trace[:, ARM_ROW["wrench"]][:, 2]) > INK_FORCE)
    return float(trace[down[0], ARM_ROW["base_from_tcp"]][0])


def test_same_seed_gives_same_state(twin: Twin) -> None:
    digests = []
    for _ in range(2):
        _demonstrate(twin, 3, 4.0)
        digests.append(twin.digest())
    assert digests[0] == digests[1]


def test_start_varies_and_spread_widens_it() -> None:
    twin = Twin(Task())
    starts = {}
    for spread in (1.0, 2.0):
        points = []
        for seed in range(4):
            twin.reset(seed, spread)
            points.append(twin.world.tcp("right").position)
        starts[spread] = np.std(points, axis=0)
    assert (starts[1.0] > 0.003).all()
    assert starts[2.0] == pytest.approx(2 * starts[1.0], rel=0.05)


def test_restoring_in_the_middle_of_a_stroke_continues_to_the_bit(twin: Twin) -> None:
    _demonstrate(twin, 4, 4.5)
    assert twin.progress().phase == "stroke 1"
    snapshot = twin.save()
    slide = _at(twin, twin.world.tcp("right").position + np.array([0.01, 0.02, -0.008]))
    digests = []
    for _ in range(2):
        twin.restore(snapshot)
        for _ in range(50):
            twin.apply(slide)
        digests.append(twin.digest())
    assert digests[0] == digests[1]


def test_doing_nothing_fails(twin: Twin) -> None:
    twin.reset(0)
    rest = _at(twin, twin.world.tcp("right").position)
    for _ in range(100):
        twin.apply(rest)
    progress = twin.progress()
    assert not progress.success
    assert progress.value < 0.1


def test_pen_above_the_board_leaves_no_ink(twin: Twin) -> None:
    twin.reset(0)
    start = twin.world.tcp("right").position
    for x in np.linspace(0.0, 0.05, 100):
        twin.apply(_at(twin, np.array([start[0] + x, start[1], BOARD_CENTER[2] + 0.01])))
    assert not np.any(twin.task.state()["ink"])


def test_line_widens_with_force(twin: Twin) -> None:
    inked = []
    for depth in (0.004, 0.008):
        twin.reset(0)
        _press(twin, twin.world.tcp("right").position[:2], depth)
        inked.append(int(twin.task.state()["ink"].astype(int).sum()))
    assert inked[1] > 1.5 * inked[0]


def _press(twin: Twin, point: Array, depth: float) -> None:
    """Go straight down at `point` (2,) [m] to a target `depth` [m] below the board, and wait there."""
    down = np.linspace(twin.world.tcp("right").position[2], BOARD_CENTER[2] - depth, 200)
    for z in np.concatenate((down, np.repeat(down[-1], 100))):
        twin.apply(_at(twin, np.array([*point, z])))


def _at(twin: Twin, position: Array) -> Action:
    pose = Pose(position, twin.task.arms[0].world_from_home.wxyz)
    return Action((ArmAction(CartesianTarget(pose, stiffness_of(StiffnessMode.LOW)), 0.0),))


# Likeness: what counts as this smile


def test_likeness_of_the_reference_is_one_and_of_a_blank_board_nothing() -> None:
    assert _drawn(smile()) == pytest.approx(1.0)
    assert _drawn([]) < 0.1


def test_small_errors_of_a_human_hand_count() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        assert _drawn([line + rng.normal(0, 0.0015, 2) for line in smile()]) > ALIKE
    assert _drawn([line + np.array([0.002, 0.002]) for line in smile()]) > ALIKE
    assert _drawn(smile(), radius=0.003) > ALIKE


def _scribble() -> Array:
    x = np.linspace(-0.05, 0.05, 20)
    return np.stack((x, 0.05 * (-1.0) ** np.arange(20)), axis=1)


LEFT, RIGHT, MOUTH = smile()
WRONG = {
    "scribble": [_scribble()],
    "scribble over a smile": [LEFT, RIGHT, MOUTH, _scribble()],
    "three dots": [line[[len(line) // 2] * 2] for line in smile()],
    "dots for eyes": [LEFT[[4, 4]], RIGHT[[4, 4]], MOUTH],
    "shifted 7 mm": [line + np.array([0.0, 0.007]) for line in smile()],
    "shifted 7 mm up": [line + np.array([0.007, 0.0]) for line in smile()],
    "shifted 3 cm": [line + np.array([0.02, -0.02]) for line in smile()],
    "one stroke through all": [np.concatenate((LEFT, RIGHT, MOUTH))],
    "only the mouth": [MOUTH],
    "no mouth": [LEFT, RIGHT],
    "one eye": [LEFT, MOUTH],
    "half a mouth": [LEFT, RIGHT, MOUTH[:16]],
    "sad": [LEFT, RIGHT, MOUTH * np.array([-1.0, 1.0]) + np.array([0.058, 0.0])],
    "straight mouth": [LEFT, RIGHT, np.array([[0.03, -0.04], [0.03, 0.04]])],
    "enlarged": [1.15 * line for line in smile()],
}


@pytest.mark.parametrize("how", WRONG)
def test_wrong_drawings_fail(how: str) -> None:
    assert _drawn(WRONG[how]) < ALIKE - 0.015


def test_success_waits_for_the_pen_to_leave_the_board(twin: Twin) -> None:
    _demonstrate(twin, 5)
    assert twin.progress().success
    start = twin.world.tcp("right").position
    _press(twin, start[:2], 0.008)
    assert not twin.progress().success
