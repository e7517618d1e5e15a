"""Picking and insertion: the peg must be gripped, carried, felt into the hole and let go."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from controller.stiffness import stiffness_of
from controller.types import (
    ARM_ROW,
    Action,
    ArmAction,
    CartesianTarget,
    Pose,
    StiffnessMode,
    quaternion_from_rotation_vector,
)
from studio import models
from studio.inputs.scripted import demonstration
from studio.session import CONTROL_PERIOD
from studio.tasks.pick_insert import BOARD_LIFT, GRASPED, HOLE_DEPTH, PEG_LENGTH, SEATED, SETTLED, Task
from studio.twin import Twin


@pytest.fixture(scope="module")
def twin() -> Twin:
    return Twin(Task())


@pytest.mark.parametrize("seed", [20000, 20002, 20005])
def test_the_demonstrator_inserts_and_lets_go_gently(twin: Twin, seed: int) -> None:
    """Rigid parts enter one another by less than half a millimetre, the finger pads by less than one."""
    twin.reset(seed)
    pads = np.zeros(twin.model.ngeom, bool)
    pads[[twin.model.geom(f"right_hand_{pad}").id for pad in models.PADS]] = True
    force = rigid = soft = 0.0
    for action in demonstration(twin, seed):
        wrenches = twin.apply(action).trace[0][:, ARM_ROW["wrench"]]
        force = max(force, float(np.linalg.norm(wrenches[:, :3], axis=1).max()))
        contact = twin.data.contact
        on_pad = pads[contact.geom].any(axis=1)
        rigid = max(rigid, -float(contact.dist[~on_pad].min(initial=0.0)))
        soft = max(soft, -float(contact.dist[on_pad].min(initial=0.0)))
    assert twin.progress().success
    assert force < 40.0
    assert rigid < 0.0005
    assert soft < 0.001


def test_nothing_but_friction_holds_the_peg(twin: Twin) -> None:
    assert (twin.model.eq_type != mujoco.mjtEq.mjEQ_WELD).all()
    twin.reset(1)
    for action in demonstration(twin, 1):
        twin.apply(action)
        if twin.world.pose("peg").position[2] > 0.08:
            break
    (held,) = action.arms
    for _ in range(60):
        twin.apply(Action((ArmAction(held.target, 1.0),)))
    assert twin.world.pose("peg").position[2] < 0.06
    assert not twin.progress().success


def test_the_picture_of_the_board_does_not_tell_how_it_lies(twin: Twin) -> None:
    heights, pictures = set(), set()
    for seed in range(3):
        twin.reset(seed)
        heights.add(float(twin.world.pose("board").position[2]))
        pictures.add(twin.data.geom("board_picture").xpos.tobytes())
    assert len(heights) == 3
    assert max(heights) - min(heights) <= 2 * BOARD_LIFT
    assert len(pictures) == 1
    assert twin.model.geom("board").rgba[3] == 0.0


@pytest.mark.parametrize("seed", [1, 4])
def test_the_hand_takes_the_peg_as_it_lies(twin: Twin, seed: int) -> None:
    """Otherwise the board could not hide how high and how tilted the peg is held."""

    def square_end() -> tuple[float, float]:
        """Height [mm] and tilt [deg]"""
        peg = twin.world.pose("peg")
        return 1e3 * peg.apply(np.array([0.0, 0.0, -GRASPED]))[2], math.degrees(math.asin(peg.rotation[2, 2]))

    twin.reset(seed)
    height, tilt = square_end()
    closed = 0
    for action in demonstration(twin, seed):
        twin.apply(action)
        closed += action.arms[0].gripper == 0.0
        if closed == 25:  # before it is lifted
            break
    assert square_end() == (pytest.approx(height, abs=0.4), pytest.approx(tilt, abs=0.6))


@pytest.mark.parametrize("seed", [0, 3])
def test_nothing_moves_by_itself(twin: Twin, seed: int) -> None:
    twin.reset(seed)
    peg, box = twin.world.pose("peg"), twin.world.pose("box")
    _rest(twin, 3.0)
    assert not twin.progress().success
    assert twin.progress().value == 0.0
    assert twin.world.pose("peg").position == pytest.approx(peg.position, abs=1e-4)
    assert twin.world.pose("box").position == pytest.approx(box.position, abs=1e-4)
    for body in ("peg", "box"):
        assert np.abs(twin.data.joint(body).qvel).max() < 1e-4  # [m/s], [rad/s]: no chatter


def test_spread_widens_where_things_lie(twin: Twin) -> None:
    scatter = {}
    for spread in (1.0, 1.5):
        places = []
        for seed in range(6):
            twin.reset(seed, spread)
            places.append(np.concatenate((twin.world.pose("peg").position, twin.world.pose("box").position)))
        scatter[spread] = np.std(places, axis=0)[[1, 2, 3, 4]]
    assert scatter[1.5] == pytest.approx(1.5 * scatter[1.0], rel=0.1)


def _rest(twin: Twin, seconds: float) -> None:
    target = CartesianTarget(twin.world.tcp("right"), stiffness_of(StiffnessMode.MEDIUM))
    for _ in range(round(seconds / CONTROL_PERIOD)):
        twin.apply(Action((ArmAction(target, 1.0),)))


def _place(twin: Twin, box_from_peg: Pose) -> None:
    """Put the peg somewhere in the box's frame and let it come to rest."""
    twin.world.place("peg", twin.world.pose("box") @ box_from_peg)
    _rest(twin, SETTLED + 0.3)


def _pointing_in(x: float, y: float, depth: float) -> Pose:
    turn = quaternion_from_rotation_vector(np.array([0.0, math.pi, 0.0]))
    return Pose(np.array([x, y, -depth]), turn)


def test_a_peg_in_the_hole_with_the_hand_away_counts(twin: Twin) -> None:
    twin.reset(0)
    _place(twin, _pointing_in(0.0, 0.0, SEATED + 0.005))
    assert twin.progress().success


@pytest.mark.parametrize(
    ("where", "box_from_peg"),
    [
        ("beside the box", _pointing_in(0.075, -0.02, HOLE_DEPTH)),
        ("on top of the box", _pointing_in(0.0, 0.056, HOLE_DEPTH)),
        ("not deep enough", _pointing_in(0.0, 0.0, SEATED - 0.006)),
        ("its end first", Pose(np.array([0.0, 0.0, PEG_LENGTH - 0.03]), np.array([1.0, 0.0, 0.0, 0.0]))),
    ],
)
def test_a_peg_that_is_not_in_the_hole_fails(twin: Twin, where: str, box_from_peg: Pose) -> None:
    twin.reset(0)
    _place(twin, box_from_peg)
    assert not twin.progress().success


def test_inserted_but_not_let_go_fails(twin: Twin) -> None:
    twin.reset(5)
    for action in demonstration(twin, 5):
        twin.apply(action)
        if twin.progress().phase == "let go":
            break
    for _ in range(100):
        twin.apply(action)
    assert not twin.progress().success
    assert twin.progress().phase == "let go"
