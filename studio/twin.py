"""The MuJoCo twin: one or two UR5e in a task's scene, as a Robot.

One physics step is one fast step of the servos (2 ms). Everything that decides the future is in `save`:
MuJoCo's integration state, the servos, the task's own state and the F/T tare.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Protocol

import mujoco
import numpy as np

from controller.model import ArmModel, ur5e
from controller.servo import ArmServo, ServoConfig
from controller.stiffness import stiffness_of
from controller.types import (
    ARM_ROW_WIDTH,
    Action,
    Applied,
    ArmAction,
    ArmState,
    Array,
    Image,
    Limit,
    Observation,
    Pose,
    Snapshot,
    StiffnessMode,
    Wrench,
)
from studio import models
from studio.tasks import ArmSetup, CameraView, Grasp, Progress, Task, World

# Share of the servo's velocity lag (kv / kp) that is fed forward. With none of it, or with half, presses
# chatter from FDCC's error_scale 0.4 on; with 0.3 they are quiet up to 0.7 (docs/contact.md).
VELOCITY_FEEDFORWARD = 0.3

# Integral action of the joint servos, as industrial arms have it: a droop under load is made up for within
# this time [s]. Without it the TCP yields by 4 % of the press at 750 N/m.
DROOP_TIME = 0.2
MAX_DROOP = 0.02  # [rad] most that is made up for

GRAVITY = 9.81  # [m/s²]

GRASP_CLOSING = 0.6  # [s] simulated at reset, with the part fixed to the flange
GRASP_SETTLING = 0.4  # [s] simulated at reset, with the part held by friction alone

HOME_Q = np.array([0.0, -1.2, 1.9, -2.27, -1.57, 0.0])  # [rad] elbow up, tool down, hand in front (+x)


class Cameras(Protocol):
    """Where the twin's images come from: `studio.cameras` renders them."""

    def newest(self, twin: Twin) -> Mapping[str, Image]:
        """The newest image of each camera for the state now; never raises."""


class Twin:
    """The simulated robot and the world of one task. One thread owns it."""

    def __init__(self, task: Task, config: ServoConfig | None = None, cameras: Cameras | None = None) -> None:
        """Without `cameras` observations carry no images."""
        self.task = task
        self.config = config or ServoConfig()
        self.model = build_model(task)
        self.data = mujoco.MjData(self.model)
        self.world = World(self.model, self.data, task.arms, self.config.stiffness_table)
        self.arms = tuple(_Arm(i, setup, self.world, self.config) for i, setup in enumerate(task.arms))
        self.seed = 0
        self.spread = 1.0
        self.cameras = cameras
        self._fresh = False  # whether mj_step1 has run for the present state
        self._objects = [
            self.model.body(int(self.model.jnt_bodyid[j])).name
            for j in range(self.model.njnt)
            if self.model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE
        ]
        task.bind(self.world)
        self.reset(0)

    # Life

    def reset(self, seed: int, spread: float = 1.0) -> None:
        """Draw the task's instance `seed`; close the hands on what they hold; tare the F/T sensors."""
        if spread <= 0:
            raise ValueError(f"Spread must be above 0, not {spread}; 1 is the task's own randomisation.")
        self.seed, self.spread = seed, spread
        rng = np.random.default_rng(seed)
        mujoco.mj_resetData(self.model, self.data)
        starts = self.task.start_poses(rng, spread)
        for arm, world_from_start in zip(self.arms, starts, strict=True):
            arm.place(world_from_start, rng, spread)
        mujoco.mj_forward(self.model, self.data)
        for arm in self.arms:
            arm.present_part(True)
        self._idle(GRASP_CLOSING)
        for arm in self.arms:
            arm.present_part(False)
        self._idle(GRASP_SETTLING)
        self.task.initialize(self.world, rng, spread)
        self.data.time = 0.0
        mujoco.mj_forward(self.model, self.data)
        for arm in self.arms:
            arm.tare()
        self._fresh = False

    def observe(self) -> Observation:
        self._refresh()
        arms = tuple(arm.observe(self.data.time) for arm in self.arms)
        images = self.cameras.newest(self) if self.cameras else {}
        return Observation(self.data.time, arms, images)

    def apply(self, action: Action) -> Applied:
        """Command one control period: `fast_steps` physics steps with one servo step each."""
        if len(action.arms) != len(self.arms):
            raise ValueError(f"{len(action.arms)} arm actions for {len(self.arms)} arms.")
        self._refresh()
        applied = Action(tuple(arm.begin(wanted) for arm, wanted in zip(self.arms, action.arms, strict=True)))
        n = self.config.fast_steps
        trace = np.empty((len(self.arms), n, ARM_ROW_WIDTH))
        for k in range(n):
            self._refresh()
            for index, arm in enumerate(self.arms):
                arm.step(trace[index, k], self.data.time)
            mujoco.mj_step2(self.model, self.data)
            self._fresh = False
        # Before the next mj_step1 lays out new contacts: poses, contacts and forces of the last step agree.
        self.task.update(self.world)
        limits: tuple[Limit, ...] = tuple(limit for arm in self.arms for limit in arm.servo.limits)
        return Applied(applied, limits, trace)

    def hold(self) -> None:
        for arm in self.arms:
            arm.servo.hold()

    def restart_time(self) -> None:
        """Count time from here, as a take does. Nothing else depends on time."""
        self.data.time = 0.0

    @property
    def grippers(self) -> tuple[float, ...]:
        """What each hand is commanded; one that holds a part is measured wider open."""
        return tuple(arm.servo.gripper for arm in self.arms)

    def progress(self) -> Progress:
        """How far the task is."""
        return self.task.progress(self.world)

    # State

    def task_state(self) -> dict[str, Array]:
        """The task's own state and the pose (7,) of every free object, world axes."""
        poses = {f"pose/{name}": self.world.pose(name).vector for name in self._objects}
        return {**self.task.state(), **poses}

    def save(self) -> Snapshot:
        arrays = {"physics": self._physics(), "sensors": self.data.sensordata.copy(), **self.task.state()}
        for arm in self.arms:
            arrays[f"servo/{arm.setup.name}"] = arm.servo.state()
            arrays[f"tare/{arm.setup.name}"] = arm.tare_wrench.copy()
            arrays[f"droop/{arm.setup.name}"] = arm.droop.copy()
        return Snapshot(arrays)

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a `save` of a twin of the same task, to the bit."""
        arrays = snapshot.arrays
        physics = np.asarray(arrays["physics"])
        if physics.shape != self._physics().shape:
            raise ValueError(
                f"The snapshot holds {physics.size} numbers of physics, task {self.task.name!r} has "
                f"{self._physics().size}: another task or another version of it."
            )
        mujoco.mj_setState(self.model, self.data, physics, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, physics, mujoco.mjtState.mjSTATE_INTEGRATION)
        self.data.sensordata[:] = arrays["sensors"]  # forces are those of the step before, see `_Arm.measure`
        for arm in self.arms:
            arm.servo.restore(arrays[f"servo/{arm.setup.name}"])
            arm.tare_wrench = np.array(arrays[f"tare/{arm.setup.name}"])
            arm.droop = np.array(arrays[f"droop/{arm.setup.name}"])
        self.task.restore(arrays)
        self._fresh = False

    def digest(self) -> bytes:
        digest = hashlib.blake2b(digest_size=8)
        for name, array in self.save().arrays.items():
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.digest()

    def _physics(self) -> Array:
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, state, kind)
        return state

    def _refresh(self) -> None:
        """Kinematics, contacts and sensors of the present state; the first half of a physics step."""
        if not self._fresh:
            mujoco.mj_step1(self.model, self.data)
            for arm in self.arms:
                arm.measure()
            self._fresh = True

    def _idle(self, seconds: float) -> None:
        """Let the arms stay where they are put, until hands have closed and droops are made up for."""
        for _ in range(round(seconds / self.config.fast_period)):
            for arm in self.arms:
                arm.stay()
            mujoco.mj_step(self.model, self.data)


class _Arm:
    """One arm in the simulation: its servo, its slices of MuJoCo's arrays, its F/T sensor."""

    def __init__(self, index: int, setup: ArmSetup, world: World, config: ServoConfig) -> None:
        model, data = world.model, world.data
        self.setup = setup
        self.kinematics: ArmModel = ur5e(setup.flange_from_tcp)
        low, high = (corner - setup.base_position for corner in setup.workspace)
        self._medium = stiffness_of(StiffnessMode.MEDIUM, config.stiffness_table)
        self._home = self._solve(setup.world_from_home, _towards(setup))
        self.servo = ArmServo(index, self.kinematics, config, (low, high), self._home, self._medium)
        self.tare_wrench = np.zeros(6)  # (6,) [N, N·m] sensor reading at rest, flange axes

        name = setup.name
        joints = [model.joint(f"{name}_{joint}") for joint in models.ARM_JOINTS]
        first_q, first_v = joints[0].qposadr[0], joints[0].dofadr[0]
        first_u = model.actuator(f"{name}_shoulder_pan").id
        self._q = data.qpos[first_q : first_q + 6]
        self._dq = data.qvel[first_v : first_v + 6]
        self._ctrl = data.ctrl[first_u : first_u + 6]
        self._hand = data.ctrl[(hand := model.actuator(f"{name}_hand_fingers_actuator").id) : hand + 1]
        driver = model.joint(f"{name}_hand_right_driver_joint").qposadr[0]
        self._finger = data.qpos[driver : driver + 1]
        sensor = model.sensor(f"{name}_force").adr[0]
        self._sensor = data.sensordata[sensor : sensor + 6]
        tcp, flange = model.site(f"{name}_tcp").id, model.site(f"{name}_flange").id
        self._tcp_position, self._tcp_matrix = data.site_xpos[tcp], data.site_xmat[tcp]
        self._flange_position, self._flange_matrix = data.site_xpos[flange], data.site_xmat[flange]
        self._gripping = _gripping_geoms(model, setup)
        self._friction = model.geom_friction[self._gripping].copy()
        self._data = data
        self._model = model
        # [s] how far the servo's target is put ahead of the command, per joint
        kp, kv = np.repeat(models.SERVO_KP, 3), np.repeat(models.SERVO_KV, 3)
        self._lead = VELOCITY_FEEDFORWARD * kv / kp
        self._lag = kv / kp  # (6,) [s] of a servo without feed-forward
        self._droop_gain = config.fast_period / DROOP_TIME
        self.droop = np.zeros(6)  # (6,) [rad] integral action
        self._wrench_flange = np.zeros(6)  # external, tared, flange axes
        self._wrench = np.zeros(6)  # external, tared, about the TCP, base axes
        self._payload = _weight_of_hand(model, name) + _weight_of(setup.grasp)

    def place(self, world_from_tcp: Pose, rng: np.random.Generator, spread: float) -> None:
        """Put the arm at rest with its TCP at a pose, and the part it holds into the open hand."""
        q = self._solve(world_from_tcp, self._home)
        gripper = 0.0 if self.setup.grasp else self.setup.gripper
        self.servo.reset(q, self._medium, gripper)
        self.droop[:] = 0.0
        self._q[:], self._ctrl[:] = q, q
        self._hand[:] = models.GRIPPER_RANGE * (1.0 - gripper)
        if (grasp := self.setup.grasp) is not None:
            world_from_flange = world_from_tcp @ self.setup.flange_from_tcp.inverse()
            flange_from_body = grasp.draw(rng, spread)
            part = self._model.joint(grasp.body).qposadr[0]
            self._data.qpos[part : part + 7] = (world_from_flange @ flange_from_body).vector
            presented = self._model.equality(f"{self.setup.name}_presented").id
            self._model.eq_data[presented, 3:10] = flange_from_body.vector

    def present_part(self, fixed: bool) -> None:
        """Fix the held part to the flange while the hand closes, or leave it to the fingers.

        While it is fixed the pads slide on it, as closing fingers also travel along the part.
        """
        if self.setup.grasp is not None:
            self._data.eq_active[self._model.equality(f"{self.setup.name}_presented").id] = fixed
            self._model.geom_friction[self._gripping] = 1e-3 if fixed else self._friction

    def tare(self) -> None:
        """Take what the sensor reads now, the part's weight apart, as its zero."""
        self.tare_wrench = self._external_wrench()

    def begin(self, action: ArmAction) -> ArmAction:
        return self.servo.begin(action, self._pose(), Wrench.from_vector(self._wrench))

    def step(self, row: Array, time: float) -> None:
        """Fill one trace row with the present state and command the next physics step."""
        self._fill(row, time)
        self.servo.step(self._q, self._wrench_flange)
        self.stay()
        self._hand[0] = models.GRIPPER_RANGE * (1.0 - self.servo.gripper)

    def stay(self) -> None:
        """Drive the joint servos to the joint command, with feed-forward and integral action."""
        lead = self._lead * self.servo.dq_command
        deflection = self.servo.q_command - self._q + lead - self._lag * self._dq
        droop = self.droop + self._droop_gain * deflection
        self.droop = np.minimum(np.maximum(droop, -MAX_DROOP), MAX_DROOP)
        self._ctrl[:] = self.servo.q_command + lead + self.droop

    def observe(self, time: float) -> ArmState:
        row = np.empty(ARM_ROW_WIDTH)
        self._fill(row, time)
        return ArmState.from_row(row)

    def _fill(self, row: Array, time: float) -> None:
        row[0] = time
        row[1:7] = self._q
        row[7:13] = self._dq
        row[13:19] = self.servo.q_command
        row[19:22] = self._tcp_position - self.setup.base_position
        self._orientation(row[22:26])
        row[26:32] = self._wrench
        row[32] = 1.0 - self._finger[0] / models.GRIPPER_CLOSED

    def _pose(self) -> Pose:
        wxyz = np.empty(4)
        self._orientation(wxyz)
        return Pose(self._tcp_position - self.setup.base_position, wxyz)

    def _orientation(self, wxyz: Array) -> None:
        """Write base_from_tcp's quaternion, on the half of the sphere around home: no jumps of sign."""
        mujoco.mju_mat2Quat(wxyz, self._tcp_matrix)
        if wxyz.dot(self.setup.world_from_home.wxyz) < 0.0:
            np.negative(wxyz, out=wxyz)

    def measure(self) -> None:
        """Read the F/T sensor, as of the last physics step: one step old, like a real sensor's."""
        self._wrench_flange = self._external_wrench() - self.tare_wrench
        rotation = self._flange_matrix.reshape(3, 3)
        self._wrench[:] = self._wrench_flange.reshape(2, 3).dot(rotation.T).ravel()
        # From the flange's origin to the TCP: torque += (flange - tcp) x force.
        ax, ay, az = (self._flange_position - self._tcp_position).tolist()
        fx, fy, fz, tx, ty, tz = self._wrench.tolist()
        self._wrench[3:] = tx + ay * fz - az * fy, ty + az * fx - ax * fz, tz + ax * fy - ay * fx

    def _external_wrench(self) -> Array:
        """(6,) what the environment exerts on hand and held part, their weight apart, in flange axes.

        MuJoCo's sensor gives what the arm exerts on the hand, its weight included, although the joints are
        spared that (`gravcomp`).
        """
        wrench: Array = -self._sensor - self._payload.dot(self._flange_matrix[6:])
        return wrench

    def _solve(self, world_from_tcp: Pose, q_start: Array) -> Array:
        base_from_tcp = Pose(world_from_tcp.position - self.setup.base_position, world_from_tcp.wxyz)
        return self.kinematics.inverse_kinematics(base_from_tcp, q_start)


def _towards(setup: ArmSetup) -> Array:
    """Joints (6,) from which the search for home starts: the arm turned towards where its hand will be."""
    if setup.near is not None:
        return setup.near
    world_from_flange = setup.world_from_home @ setup.flange_from_tcp.inverse()
    x, y, _ = world_from_flange.position - setup.base_position
    start = HOME_Q.copy()
    start[0] += math.atan2(y, x)
    return start


def _gripping_geoms(model: mujoco.MjModel, setup: ArmSetup) -> list[int]:
    """Ids of the finger pads and of the held part's geoms."""
    pads = [model.geom(f"{setup.name}_hand_{pad}").id for pad in models.PADS]
    if setup.grasp is None:
        return pads
    part = model.body(setup.grasp.body)
    return [*pads, *range(int(part.geomadr[0]), int(part.geomadr[0] + part.geomnum[0]))]


def _weight(mass: float, center: Array) -> Array:
    """(6, 3): the world's upward direction in flange axes to a mass's weight as a wrench there.

    `center` (3,) [m] of the mass in the flange frame.
    """
    x, y, z = center.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return -GRAVITY * mass * np.vstack((np.eye(3), cross))


def _weight_of_hand(model: mujoco.MjModel, arm: str) -> Array:
    """With the fingers open; closing them moves its centre of mass by millimetres."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    flange = model.body(f"{arm}_flange").id
    world_from_flange = Pose(data.xpos[flange], data.xquat[flange])
    return _weight(
        float(model.body_subtreemass[flange]), world_from_flange.inverse().apply(data.subtree_com[flange])
    )


def _weight_of(grasp: Grasp | None) -> Array:
    if grasp is None:
        return np.zeros((6, 3))
    return _weight(grasp.mass, grasp.flange_from_body.apply(grasp.center))


def build_model(task: Task) -> mujoco.MjModel:
    """The task's scene: table, arms, objects, cameras."""
    spec = models.new_spec()
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(1.2, 1.2, 0.05),
        rgba=(0.42, 0.40, 0.38, 1),
    )
    spec.worldbody.add_light(pos=(0.3, -0.6, 2.0), dir=(0.1, 0.3, -1.0), castshadow=False, diffuse=(0.5,) * 3)
    for arm in task.arms:
        models.add_arm(spec, arm.name, arm.base_position, arm.flange_from_tcp)
    task.build(spec)
    for arm in task.arms:
        if arm.grasp is not None:
            _add_presentation(spec, arm.name, arm.grasp.body, arm.grasp.flange_from_body)
    for view in task.cameras:
        _add_camera(spec, view)
    return spec.compile()


def _add_presentation(spec: mujoco.MjSpec, arm: str, body: str, flange_from_body: Pose) -> None:
    """A weld that holds a part while the hand closes at reset; it is off in every scored period."""
    data = np.zeros(12)  # anchor, relative pose, torque scale
    data[3:10] = flange_from_body.vector
    data[10] = 1.0
    spec.add_equality(
        name=f"{arm}_presented",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=f"{arm}_flange",
        name2=body,
        data=data,
        solref=(0.004, 1.0),  # stiff: closing fingers drag the part along the tool
        solimp=(0.95, 0.99, 0.001, 0.5, 2.0),
        active=False,
    )


def _add_camera(spec: mujoco.MjSpec, view: CameraView) -> None:
    backwards = view.position - view.look_at
    z = backwards / np.linalg.norm(backwards)
    x = np.cross(view.up, z)
    x /= np.linalg.norm(x)
    pose = Pose.of(np.stack((x, np.cross(z, x), z), axis=1), view.position)
    body = spec.body(f"{view.arm}_flange") if view.arm else spec.worldbody
    body.add_camera(name=view.name, pos=pose.position, quat=pose.wxyz, fovy=view.fovy)
