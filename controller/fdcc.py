"""Forward Dynamics Compliance Control: pose and wrench errors to joint commands through a virtual arm.

Scherzinger, Roennau, Dillmann, "Forward Dynamics Compliance Control (FDCC): a new approach to Cartesian
compliance for robotic manipulators", IROS 2017, doi 10.1109/IROS.2017.8206325. Where paper and program
differ we follow the authors' program, github.com/fzi-forschungszentrum-informatik/cartesian_controllers
(branch ros2, commit f53f798), its stale pose and its counting of time in cycles included.
`tests/check_fdcc_vectors.py` compares the two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from controller.model import ArmModel
from controller.types import Array, Pose, Stiffness

MAX_TRANSLATION = 1.0  # [m] longer position errors count as this long
MAX_ROTATION = 1.0  # [rad] larger rotation errors count as this large
DEAD_ZONE = 1e-6  # [m], and twice the sine of an angle: errors below count as zero, as in KDL 1.5.1
LINK_INERTIA = 1e-6  # [kg·m²] of each moving virtual link, all axes
END_MASS = 1.0  # [kg] at the end effector's origin
END_INERTIA = 1.0  # [kg·m²] of the virtual end effector, all axes

Vector = tuple[float, float, float]
Gains = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class FdccConfig:
    """Gains and the virtual model.

    p and d are the Comp-ACT authors' gains on their real arms (omron-sinicx/osx_robot_ros_core, commit
    95fafd1). Their error_scale of 0.8 chatters in simulated contact; 0.3 leaves a margin of two with our hand
    and servos (docs/contact.md). Time counts in cycles, not seconds: an iteration advances `internal_dt`
    whatever the loop rate, so half the rate is half the speed.
    """

    p_gains: Gains = (0.035, 0.035, 0.035, 0.5, 0.5, 0.5)  # per base axis, translations then rotations
    d_gains: Gains = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # [s of internal time]
    error_scale: float = 0.3
    iterations: int = 1  # of the virtual arm per control cycle
    internal_dt: float = 0.02  # [s] fixed in the reference
    damping: float = 0.9  # velocity kept per iteration: a factor per cycle, fixed in the reference
    link_mass: float = 0.1  # [kg] of each moving virtual link
    hand_frame_control: bool = False  # target wrench in end-effector axes instead of base axes

    def __post_init__(self) -> None:
        for name in ("p_gains", "d_gains"):
            gains = getattr(self, name)
            if len(gains) != 6 or not all(math.isfinite(gain) and gain >= 0.0 for gain in gains):
                raise ValueError(f"{name} must be six numbers >= 0, not {gains}.")
        if not (math.isfinite(self.error_scale) and self.error_scale >= 0.0):
            raise ValueError(f"error_scale must be >= 0, not {self.error_scale}.")
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, not {self.iterations}.")
        if not (math.isfinite(self.internal_dt) and self.internal_dt > 0.0):
            raise ValueError(f"internal_dt must be above 0 s, not {self.internal_dt}.")
        if not 0.0 <= self.damping <= 1.0:
            raise ValueError(f"damping is the share of velocity kept, 0..1, not {self.damping}.")
        if not (math.isfinite(self.link_mass) and self.link_mass > 0.0):
            raise ValueError(f"link_mass must be above 0 kg, not {self.link_mass}.")


def virtual_arm(arm: ArmModel, link_mass: float) -> pin.Model:
    """The arm's joints and frames with FDCC's virtual masses in place of its own, and no gravity.

    Each moving link is `link_mass` at its link frame's origin; fixed links weigh nothing; the last link, the
    end effector, is 1 kg and 1 kg·m² whatever it was. So a wrench moves the end effector nearly like a free
    body, in every configuration.
    """
    model = arm.kinematics.copy()
    model.gravity = pin.Motion.Zero()
    for segment in arm.segments[:-1]:
        if segment.axis is not None:
            _put_mass(model, arm.frame_id(segment.link), link_mass, LINK_INERTIA)
    _put_mass(model, arm.frame_id(arm.end_effector), END_MASS, END_INERTIA)
    return model


def _put_mass(model: pin.Model, frame_id: int, mass: float, inertia: float) -> None:
    frame = model.frames[frame_id]
    model.appendBodyToJoint(
        frame.parentJoint, pin.Inertia(mass, np.zeros(3), inertia * np.eye(3)), frame.placement
    )


class Fdcc:
    """Cartesian compliance of one arm. Base axes unless said otherwise, vectors [linear; angular].

    E is the end effector, C the frame whose axes carry the stiffness, S the F/T sensor's frame. One control
    cycle starts at the feedback q and repeats `iterations` times

        e_m = [clamp(p_t - p_E); clamp(log(R_t R_E^T))]         motion error, 1 m and 1 rad at most
        e   = blk(R_C) K blk(R_C)^T e_m + blk(R_C) w_s + w_t    net wrench
        u   = error_scale (p e + d (e - e_last) / dt)           PD, per base axis
        a   = H(q)^-1 J(q)^T u                                  virtual arm: no gravity, Coriolis, friction
        q  <- clamp(q + v dt) ; v <- 0.9 (v + a dt)             Euler with the old velocity, joint limits

    with blk(R) = diag(R, R), the sensed wrench w_s moved from S to C, and the target wrench w_t turned by
    R_E if `hand_frame_control`. Both wrenches are what acts on the robot, so a constant w_s deflects the arm
    by K^-1 w_s; p, d and error_scale only set how fast.

    Kept from the reference: in a cycle's first iteration p_E, R_E in e_m are those of the *previous command*,
    not of the feedback; S is placed relative to C once, with all joints at zero; v is not stopped at joint
    limits; pose errors below 1e-6 m or rad count as zero, as in KDL.
    """

    def __init__(
        self,
        arm: ArmModel,
        q: Array,
        config: FdccConfig | None = None,
        *,
        compliance_frame: str | None = None,
        sensor_frame: str | None = None,
    ) -> None:
        """Start at rest at joints q (n,) [rad]. Frames are links; the end effector where not given."""
        self._arm = arm
        self._lower, self._upper = arm.lower.tolist(), arm.upper.tolist()
        self._end = arm.frame_id(arm.end_effector)
        self._compliance = arm.frame_id(compliance_frame or arm.end_effector)
        zero = np.zeros(arm.n_joints)
        base_from_compliance = arm.forward_kinematics(zero, compliance_frame)
        compliance_from_sensor = base_from_compliance.inverse() @ arm.forward_kinematics(zero, sensor_frame)
        # In C axes, net wrench (6,) = law (6, 12) @ inputs (12,): motion error, then the sensor's wrench.
        self._law, self._inputs, self._net = np.zeros((6, 12)), np.zeros(12), np.zeros(6)
        self._law[:, 6:] = _wrench_transform(compliance_from_sensor)
        self._motion = np.zeros(6)  # base axes
        # Views of these, (2, 3): a linear and an angular row.
        self._motion_rows, self._net_rows = self._motion.reshape(2, 3), self._net.reshape(2, 3)
        self._motion_input, self._sensor_input = self._inputs[:6].reshape(2, 3), self._inputs[6:]
        self._stiffness: Stiffness | None = None
        self.configure(config or FdccConfig())
        self.reset(q)

    @property
    def config(self) -> FdccConfig:
        return self._config

    def configure(self, config: FdccConfig) -> None:
        """Use other gains or masses from the next step on; joints, velocity and error memory stay."""
        self._config = config
        self._p = config.error_scale * np.array(config.p_gains)
        self._d = config.error_scale / config.internal_dt * np.array(config.d_gains)
        self._has_d = any(config.d_gains)
        self._model = virtual_arm(self._arm, config.link_mass)
        self._data = self._model.createData()
        # Live views of the data: Pinocchio writes through them.
        self._base_from_end = self._data.oMf[self._end]
        self._end_rotation = self._base_from_end.rotation  # (3, 3)
        self._compliance_rotation = self._data.oMf[self._compliance].rotation  # (3, 3)

    def reset(self, q: Array) -> None:
        """Come to rest at joints q (n,) [rad], brought within limits, without memory of earlier errors."""
        self._q: list[float] = np.clip(q, self._lower, self._upper).tolist()
        self._v = [0.0] * len(self._q)
        self._error = np.zeros(6)

    @property
    def q(self) -> Array:
        """(n,) [rad] the last joint command."""
        return np.array(self._q)

    @property
    def velocity(self) -> Array:
        """(n,) [rad per second of internal time]; in real time `velocity * internal_dt / control period`.

        With more than one iteration that counts the last one; a cycle moves by the sum over all.
        """
        return np.array(self._v)

    def limit_velocity(self, limits: list[float]) -> bool:
        """Slow all joints alike until none moves faster than `limits` (n,) [rad/s of internal time].

        Called after a step, like `applyJointVelocityLimits` in the Comp-ACT authors' fork (github.com/
        omron-sinicx/cartesian_controllers, commit bfd5415): the next step then moves within the limits.
        Returns whether it had to.
        """
        excess = max(abs(s) / limit for s, limit in zip(self._v, limits, strict=True))
        if excess <= 1.0:
            return False
        self._v = [s / excess for s in self._v]
        return True

    def state(self) -> Array:
        """(2 n + 6,) everything that decides later steps: command, velocity, last net wrench."""
        return np.concatenate((self._q, self._v, self._error))

    def restore(self, state: Array) -> None:
        """Continue from a `state()`, to the bit."""
        n = len(self._q)
        if np.shape(state) != (2 * n + 6,):
            raise ValueError(f"A state for {n} joints has shape ({2 * n + 6},), not {np.shape(state)}.")
        self._q, self._v = state[:n].tolist(), state[n : 2 * n].tolist()
        self._error = np.array(state[2 * n :], dtype=float)

    def step(
        self,
        q: Array,
        base_from_target: Pose,
        stiffness: Stiffness,
        sensor_wrench: Array | None = None,
        target_wrench: Array | None = None,
    ) -> Array:
        """One control cycle; return the joint command (n,) [rad].

        q is the feedback (n,) [rad]: measured joints, or the last command (`self.q`), which hides servo lag
        and droop from the controller. The stiffness is in the axes of the compliance frame. `sensor_wrench`
        (6,) [N, N·m] is what the environment exerts on the robot, about the sensor frame's origin and in its
        axes; `target_wrench` (6,) is what the robot shall be pulled with. Both are zero if not given.

        Raises FloatingPointError, and keeps its state, where the command would not be finite.
        """
        if stiffness is not self._stiffness:
            self._law[:3, :3], self._law[3:, 3:6] = stiffness.translational, stiffness.rotational
            self._stiffness = stiffness
        self._sensor_input[:] = 0.0 if sensor_wrench is None else sensor_wrench

        model, data = self._model, self._data
        joints, velocity, last_error = q.tolist(), self._v, self._error
        is_stale = joints != self._q
        for _ in range(self._config.iterations):
            if is_stale:  # e_m starts from the last command, all else from the feedback
                pin.framesForwardKinematics(model, data, np.array(self._q))
                self._motion[:] = _motion_error(base_from_target, self._base_from_end)
            jacobian = pin.computeFrameJacobian(model, data, q, self._end, pin.LOCAL_WORLD_ALIGNED)
            if not is_stale:
                self._motion[:] = _motion_error(base_from_target, self._base_from_end)
            error = self._net_wrench(target_wrench)
            pull = self._p * error
            if self._has_d:
                pull += self._d * (error - last_error)
            # H = U D U^T and a solve take two thirds of the time of pin.aba, which has velocity terms.
            pin.crba(model, data, q)
            pin.cholesky.decompose(model, data)
            acceleration = pin.cholesky.solve(model, data, pull.dot(jacobian))
            joints, velocity = self._integrate(joints, velocity, acceleration.tolist())
            q, last_error, is_stale = np.array(joints), error, False
        if not math.isfinite(sum(velocity)):  # it depends on all joints, and so on all that went in
            raise FloatingPointError(f"FDCC's command is not finite: {joints}; check feedback and wrenches.")
        self._q, self._v, self._error = joints, velocity, last_error
        return q

    def _net_wrench(self, target_wrench: Array | None) -> Array:
        """(6,) e, base axes, with the virtual arm placed at q."""
        if self._compliance != self._end:
            pin.updateFramePlacement(self._model, self._data, self._compliance)
        rotation = self._compliance_rotation
        self._motion_rows.dot(rotation, self._motion_input)  # rows times R are R^T times columns
        self._law.dot(self._inputs, self._net)
        net: Array = self._net_rows.dot(rotation.T).ravel()
        if target_wrench is not None:
            if self._config.hand_frame_control:
                target_wrench = target_wrench.reshape(2, 3).dot(self._end_rotation.T).ravel()
            net += target_wrench
        return net

    def _integrate(
        self, q: list[float], v: list[float], acceleration: list[float]
    ) -> tuple[list[float], list[float]]:
        """Euler with the old velocity, joint limits, damping."""
        dt, damping = self._config.internal_dt, self._config.damping
        q_next, v_next = [], []
        for x, s, a, low, high in zip(q, v, acceleration, self._lower, self._upper, strict=True):
            moved = x + s * dt
            q_next.append(low if moved < low else high if moved > high else moved)
            v_next.append(damping * (s + a * dt))
        return q_next, v_next


def _motion_error(base_from_target: Pose, base_from_end: pin.SE3) -> tuple[float, ...]:
    """e_m: translation [m] and rotation vector [rad], base axes."""
    tx, ty, tz = base_from_target.position.tolist()
    tw, ta, tb, tc = base_from_target.wxyz.tolist()
    x, y, z, a, b, c, w = pin.SE3ToXYZQUATtuple(base_from_end)
    translation = _clamped_translation(tx - x, ty - y, tz - z)
    rotation = _clamped_rotation(  # of the target's quaternion times the conjugate of the end effector's
        tw * w + ta * a + tb * b + tc * c,
        ta * w - tw * a - tb * c + tc * b,
        tb * w - tw * b - tc * a + ta * c,
        tc * w - tw * c - ta * b + tb * a,
    )
    return *translation, *rotation


def _clamped_translation(x: float, y: float, z: float) -> Vector:
    """(x, y, z) [m], no longer than MAX_TRANSLATION; zero in the dead zone, which KDL has larger along x."""
    distance = math.sqrt(x * x + y * y + z * z)
    if distance < DEAD_ZONE or (abs(x) < DEAD_ZONE and abs(y) <= abs(x) >= abs(z)):
        return 0.0, 0.0, 0.0
    scale = MAX_TRANSLATION / distance if distance > MAX_TRANSLATION else 1.0
    return x * scale, y * scale, z * scale


def _clamped_rotation(w: float, x: float, y: float, z: float) -> Vector:
    """Rotation vector [rad] of a unit quaternion, no longer than MAX_ROTATION; zero in the dead zone."""
    half_sine = math.sqrt(x * x + y * y + z * z)
    angle = min(2.0 * math.atan2(half_sine, abs(w)), MAX_ROTATION)
    sign = w
    if 4.0 * abs(w) * max(abs(x), abs(y), abs(z)) < DEAD_ZONE:  # twice the sine of the whole angle
        if half_sine < 0.5:
            return 0.0, 0.0, 0.0
        sign = max(x, y, z, key=abs)  # half a turn: KDL takes the axis whose largest component is positive
    scale = math.copysign(angle / half_sine, sign)
    return x * scale, y * scale, z * scale


def _wrench_transform(parent_from_child: Pose) -> Array:
    """(6, 6): a wrench about the child's origin, in its axes, to one about the parent's, in the parent's."""
    transform: Array = pin.SE3(parent_from_child.rotation, parent_from_child.position).toDualActionMatrix()
    return transform
